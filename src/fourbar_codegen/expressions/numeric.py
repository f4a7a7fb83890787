"""Expressions as numbers, in double precision and without C, as a reference for compiled functions.

All at once for arrays of arguments. As in C, what has no real value is not a number, so that a root in the branch of a
Piecewise that is not taken does no harm.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import sympy as sm
from numpy.typing import NDArray
from sympy.codegen import cfunctions
from sympy.logic.boolalg import Boolean, BooleanFunction

from fourbar_codegen.errors import ModelError

__all__ = ["Floats", "Function", "function"]

Floats = NDArray[np.float64]
Function = Callable[..., Any]
"""Of arrays, to an array: of numbers, or of truth values for conditions."""


def _by_element(function: Callable[..., float]) -> Function:
    """A function of numbers for arrays."""

    def guarded(*arguments: float) -> float:
        try:
            return function(*arguments)
        except (ArithmeticError, ValueError):
            return math.nan

    return np.vectorize(guarded, otypes=[float])


FUNCTIONS: dict[type, Function] = {
    sm.Add: lambda *terms: functools.reduce(np.add, terms),
    sm.Mul: lambda *factors: functools.reduce(np.multiply, factors),
    sm.Pow: np.power,
    sm.sin: np.sin,
    sm.cos: np.cos,
    sm.tan: np.tan,
    sm.cot: lambda x: 1.0 / np.tan(x),
    sm.sec: lambda x: 1.0 / np.cos(x),
    sm.csc: lambda x: 1.0 / np.sin(x),
    sm.asin: np.arcsin,
    sm.acos: np.arccos,
    sm.atan: np.arctan,
    sm.acot: lambda x: np.arctan(1.0 / x),
    sm.asec: lambda x: np.arccos(1.0 / x),
    sm.acsc: lambda x: np.arcsin(1.0 / x),
    sm.atan2: np.arctan2,
    sm.sinh: np.sinh,
    sm.cosh: np.cosh,
    sm.tanh: np.tanh,
    sm.asinh: np.arcsinh,
    sm.acosh: np.arccosh,
    sm.atanh: np.arctanh,
    sm.exp: np.exp,
    sm.log: np.log,
    sm.Abs: np.abs,
    sm.floor: np.floor,
    sm.ceiling: np.ceil,
    sm.sign: np.sign,
    sm.Heaviside: np.heaviside,
    sm.Max: lambda *choices: functools.reduce(np.maximum, choices),
    sm.Min: lambda *choices: functools.reduce(np.minimum, choices),
    sm.erf: _by_element(math.erf),
    sm.erfc: _by_element(math.erfc),
    sm.gamma: _by_element(math.gamma),
    sm.loggamma: _by_element(math.lgamma),
    cfunctions.exp2: np.exp2,
    cfunctions.expm1: np.expm1,
    cfunctions.log2: np.log2,
    cfunctions.log10: np.log10,
    cfunctions.log1p: np.log1p,
    cfunctions.hypot: np.hypot,
    cfunctions.Cbrt: np.cbrt,
    sm.Gt: np.greater,
    sm.Ge: np.greater_equal,
    sm.Lt: np.less,
    sm.Le: np.less_equal,
    sm.Eq: np.equal,
    sm.Ne: np.not_equal,
    sm.And: lambda *parts: functools.reduce(np.logical_and, parts),
    sm.Or: lambda *parts: functools.reduce(np.logical_or, parts),
    sm.Xor: lambda *parts: functools.reduce(np.logical_xor, parts),
    sm.Not: np.logical_not,
    sm.ITE: np.where,
}
"""All others are evaluated by SymPy itself, number by number."""


def function(arguments: Sequence[sm.Symbol], expression: sm.Basic) -> Function:
    """An expression or a condition as a function of arrays.

    Parameters
    ----------
    arguments : sequence of Symbol
    expression : Expr or Boolean

    Returns
    -------
    callable
        Of one number or array for each argument. Where it has no real value, its value is not a number.

    Raises
    ------
    ModelError
        If it contains a condition or a symbol of which no value is known.

    Examples
    --------
    >>> x = sm.Symbol("x")
    >>> function([x], sm.sqrt(x) + 1)(np.array([4.0, 9.0])).tolist()
    [3.0, 4.0]
    """
    places = {symbol: place for place, symbol in enumerate(arguments)}

    def of(node: sm.Basic) -> Function:
        if node in places:
            place = places[node]
            return lambda *values: values[place]
        if node in (sm.true, sm.false):
            return lambda *_: np.bool_(node)
        if node.is_Number or node.is_NumberSymbol:
            number = float(node)
            return lambda *_: np.float64(number)
        if isinstance(node, sm.Piecewise):
            branches = [of(branch) for branch, _ in node.args]
            conditions = [of(condition) for _, condition in node.args]
            return lambda *values: np.select(
                [condition(*values) for condition in conditions], [branch(*values) for branch in branches], np.nan
            )
        if isinstance(node, BooleanFunction) and node.func not in FUNCTIONS:  # Implies, Equivalent, ...
            return of(node.to_nnf(simplify=False))
        if not node.args or (isinstance(node, Boolean) and node.func not in FUNCTIONS):
            raise ModelError(f"{node} cannot be compiled: its value is not known.")
        parts, known = [of(part) for part in node.args], FUNCTIONS.get(node.func) or _by_sympy(node)
        return lambda *values: known(*[part(*values) for part in parts])

    return of(expression)


def _by_sympy(node: sm.Basic) -> Function:
    def value(*numbers: float) -> float:
        found = node.func(*map(sm.Float, numbers)).evalf()
        return float(found) if found.is_Number else math.nan  # a complex number, or one that SymPy does not know

    return _by_element(value)
