"""Antiderivatives on the tape, found by SymPy and checked with numbers."""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable
from inspect import CO_GENERATOR
from itertools import count, pairwise
from types import FrameType
from typing import Any

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion, expression_of, substitute
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.numeric import FUNCTIONS
from fourbar_codegen.expressions.tape import (
    ONE,
    Call,
    Leaf,
    Number,
    Product,
    Reciprocal,
    Scalar,
    Sum,
    Tape,
    placeholder,
)

__all__ = ["MAX_SECONDS", "antiderivative"]

MAX_SECONDS = 1.0
"""Longest search for one antiderivative, seconds of processor time."""

CALLS_PER_CLOCK = 256
"""Number of calls and returns of functions, some microseconds each, after which the clock is read."""

INTEGRABLE = ("sympy.functions.elementary", "sympy.functions.special.delta_functions")
"""Modules of functions for which SymPy has rules; not curves of muscles, for example."""

N_DRAWS = 3
MAX_ARGUMENT = 3.0
N_POINTS = 90
AGREEMENT_RTOL = 1e-7
"""Of the derivative of an antiderivative and its integrand, relative."""


def antiderivative(tape: Tape, integrand: Scalar, variable: Scalar, max_seconds: float = MAX_SECONDS) -> Scalar | None:
    """A continuous function whose derivative is the integrand.

    Parameters
    ----------
    tape : Tape
    integrand : Scalar
        A function of the variable; everything else in it counts as constant.
    variable : Scalar
        A leaf.
    max_seconds : float, optional
        Longest search, seconds of processor time. Polynomials take none.

    Returns
    -------
    Scalar, or None if SymPy finds none in that time, or one that C cannot evaluate.

    Examples
    --------
    >>> tape = Tape()
    >>> x, a = tape.leaf("y", "x"), tape.leaf("p", "a")
    >>> found = antiderivative(tape, (x - a) * 6, x)
    >>> tape.evaluate([found], {x: 3.0, a: 1.0})
    [12.0]
    """
    # Of a (x - b) the antiderivative is a (x - b)^2 / 2, which does not cancel as a x^2 / 2 - a b x does.
    inner, offset, slope = _shift(tape, integrand, variable)
    place = tape.leaf("y", "shifted")
    [outer] = substitute(tape, [integrand], {variable: (place - offset) / slope})
    x = sm.Dummy("x", real=True)
    leaves: dict[sm.Basic, Scalar] = {x: inner}
    expression = _expression(tape, outer, {place.node: x}, leaves)
    if expression.is_polynomial(x):
        terms = sm.Poly(expression, x).terms()
        found = sm.Add(*(coefficient * x ** (n + 1) / (n + 1) for (n,), coefficient in terms))
        return Conversion(tape, leaves)(found) / slope
    own = {*map(type, expression.atoms(sm.Function))}
    if not all(function.__module__.startswith(INTEGRABLE) for function in own):
        return None
    found = _within(max_seconds, lambda: sm.integrate(expression.rewrite(sm.Piecewise), x))
    known = {*own, *FUNCTIONS, sm.Piecewise, sm.Max, sm.Min}
    if found is None or found.has(sm.Integral) or not {*map(type, found.atoms(sm.Function))} <= known:
        return None
    if found.has(sm.Piecewise):
        # All branches are evaluated, so a root of what is negative elsewhere is written as of zero there.
        found = found.replace(_is_root, lambda root: sm.Max(0, root.base) ** root.exp)
    try:
        result = Conversion(tape, leaves)(found) / slope
        return result if _is_continuous_antiderivative(tape, result, integrand, variable) else None
    except ModelError:  # it has infinite values, or no real ones
        return None


def _is_root(expression: sm.Expr) -> bool:
    return bool(
        expression.is_Pow and expression.exp.is_number and expression.exp > 0 and int(expression.exp) != expression.exp
    )


def _shift(tape: Tape, scalar: Scalar, variable: Scalar) -> tuple[Scalar, Scalar, Number]:
    """The first a x + b in a scalar with a number a, for a variable x; its b; and a."""
    nodes = tape.reach([scalar])
    dependent = tape.dependent(nodes, [variable])
    for node in nodes:
        if isinstance(operation := tape.nodes[node], Sum) and node in dependent:
            terms = dict(operation.terms)
            slope = terms.pop(variable.node, 0)
            if slope and dependent.isdisjoint(terms):
                return Scalar(tape, 1, node), tape.sum([Scalar(tape, c, n) for n, c in terms.items()]), slope
    return variable, tape.zero, 1


def _expression(tape: Tape, scalar: Scalar, known: dict[int, sm.Expr], leaves: dict[sm.Basic, Scalar]) -> sm.Expr:
    """A scalar as an expression; what depends on none of the known nodes becomes a symbol, which is added to leaves."""
    nodes = tape.reach([scalar], known)
    dependent = tape.dependent(nodes, [Scalar(tape, 1, node) for node in known])

    def at(node: int) -> sm.Expr:
        if node == ONE:
            return sm.S.One
        if node not in known:
            known[node] = sm.Dummy(f"c{len(leaves)}", real=True)
            leaves[known[node]] = Scalar(tape, 1, node)
        return known[node]

    for node in nodes:
        if node not in dependent:
            continue
        match tape.nodes[node]:
            case Sum(terms):
                known[node] = sm.Add(*(expression_of(factor) * at(term) for term, factor in terms))
            case Product(factors):
                known[node] = sm.Mul(*map(at, factors))
            case Reciprocal(denominator):
                known[node] = 1 / at(denominator)
            case Call(function, arguments):
                values = {placeholder(i): at(argument) for i, argument in enumerate(arguments)}
                known[node] = function.xreplace(values)
            case Leaf():
                raise TypeError("a leaf depends on nothing")
    return expression_of(scalar.coefficient) * at(scalar.node)


class _TooLong(BaseException):
    """Not an Exception, which SymPy would take for a failure of one of its methods."""


def _is_of_sympy(frame: FrameType) -> bool:
    return str(frame.f_globals.get("__name__")).startswith("sympy.")


def _within(seconds: float, search: Callable[[], sm.Expr]) -> sm.Expr | None:
    """What a search finds, or None if it takes longer; a profiler that is running is not disturbed."""
    if sys.getprofile() is not None:
        return search()
    end, calls, late = time.thread_time() + seconds, count(), False

    def watch(frame: FrameType, event: str, _argument: Any) -> None:
        nonlocal late
        # The clock takes longer than most calls.
        late = late or (next(calls) % CALLS_PER_CLOCK == 0 and time.thread_time() > end)
        # Where it would be swallowed, and the search would go on unwatched, it is not raised: in a generator, which may
        # be being closed, and in functions that are not SymPy's, which the garbage collector may have called.
        if late and event == "call" and not frame.f_code.co_flags & CO_GENERATOR and _is_of_sympy(frame):
            raise _TooLong

    sys.setprofile(watch)
    try:
        return search()
    except _TooLong:
        return None
    finally:
        sys.setprofile(None)


def _is_continuous_antiderivative(tape: Tape, found: Scalar, integrand: Scalar, variable: Scalar) -> bool:
    """Whether a derivative is right, and its antiderivative has no jump, with random constants.

    A jump is a change between two points that is greater than the integrand there explains.
    """
    rate = Jvp(tape, {variable: tape.one})(found)
    generator, tested = random.Random(0), 0
    leaves = [Scalar(tape, 1, n) for n in tape.reach([found, integrand, rate]) if isinstance(tape.nodes[n], Leaf)]
    for _ in range(N_DRAWS):
        point = {leaf: generator.uniform(0.2, 1.5) for leaf in leaves}
        values: list[tuple[float, float, float] | None] = []
        for i in range(N_POINTS):
            x = MAX_ARGUMENT * ((i + 0.5) / N_POINTS * 2.0 - 1.0)
            value, slope, expected = tape.evaluate([found, rate, integrand], {**point, variable: x})
            if not all(map(math.isfinite, (value, slope, expected))):
                values.append(None)
                continue
            if not abs(slope - expected) <= AGREEMENT_RTOL * max(abs(expected), 1.0):
                return False
            values.append((x, value, expected))
            tested += 1
        for before, after in pairwise(values):
            if before is not None and after is not None:
                step = after[0] - before[0]
                most = 2.0 * step * (abs(before[2]) + abs(after[2])) + AGREEMENT_RTOL * max(1.0, abs(before[1]))
                if abs(after[1] - before[1]) > most:
                    return False
    return tested > 0
