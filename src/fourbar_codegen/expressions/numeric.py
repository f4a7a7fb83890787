"""Expressions as numbers, in double precision and without C, as a reference for compiled functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import sympy as sm
from sympy.logic.boolalg import Boolean, BooleanFunction

__all__ = ["number"]

FUNCTIONS: dict[type, Callable[..., float]] = {
    sm.sin: math.sin,
    sm.cos: math.cos,
    sm.tan: math.tan,
    sm.asin: math.asin,
    sm.acos: math.acos,
    sm.atan: math.atan,
    sm.atan2: math.atan2,
    sm.sinh: math.sinh,
    sm.cosh: math.cosh,
    sm.tanh: math.tanh,
    sm.exp: math.exp,
    sm.log: math.log,
    sm.Abs: abs,
    sm.floor: math.floor,
    sm.ceiling: math.ceil,
    sm.sign: lambda x: (x > 0) - (x < 0),
}
"""All others are evaluated by SymPy itself."""


def number(expr: sm.Expr, values: Mapping[sm.Symbol, float]) -> float:
    """The value of an expression.

    Parameters
    ----------
    expr : Expr
    values : mapping of Symbol to float

    Returns
    -------
    float

    Raises
    ------
    ArithmeticError, ValueError, TypeError
        Where it has no real and finite value.

    Examples
    --------
    >>> x = sm.Symbol("x")
    >>> number(sm.sqrt(x) + 1, {x: 4.0})
    3.0
    """
    if expr.is_Symbol:
        return values[expr]
    if expr.is_Add:
        return math.fsum(number(argument, values) for argument in expr.args)
    if expr.is_Mul:
        return math.prod(number(argument, values) for argument in expr.args)
    if not expr.args:
        return float(expr)
    if expr.is_Pow:
        base, exponent = expr.args
        # Unlike **, math.pow refuses a negative base with a non-integer exponent.
        return math.pow(number(base, values), number(exponent, values))
    if isinstance(expr, sm.Piecewise):
        return next((number(branch, values) for branch, condition in expr.args if _holds(condition, values)), math.nan)
    arguments = [number(argument, values) for argument in expr.args]
    function = FUNCTIONS.get(type(expr))
    return float(function(*arguments) if function else expr.func(*map(sm.Float, arguments)))


def _holds(condition: Boolean, values: Mapping[sm.Symbol, float]) -> bool:
    if isinstance(condition, BooleanFunction):
        known = condition.func(*(sm.true if _holds(part, values) else sm.false for part in condition.args))
    elif condition.is_Relational:
        known = condition.func(*(sm.Float(number(side, values)) for side in condition.args))
    else:
        known = condition
    if known not in (sm.true, sm.false):  # bool() would be true for any other object
        raise TypeError(f"It is not known whether {condition} holds.")
    return bool(known)
