"""Where the equations of motion jump at times that are not known beforehand, as with dry friction; numerically."""

from __future__ import annotations

import itertools
import random
from collections.abc import Collection, Iterator, Mapping, Sequence

import sympy as sm

from fourbar_codegen.dynamics.equations import Equations
from fourbar_codegen.expressions.breakpoints import are_known, sides
from fourbar_codegen.expressions.convert import apply
from fourbar_codegen.expressions.tape import Call, Leaf, Reciprocal, Scalar, Tape

__all__ = ["jumps"]

ATTEMPTS = 24
"""Random lines along which a condition may switch, ..."""

ORDERS = 3
"""... every other one with variables of different orders of magnitude, up to this power of ten."""

DISTANCES = sorted([0.0, *(sign * 10.0**k for k in range(-6, 13) for sign in (1.0, -1.0))])
"""Along a line, for conditions in any units."""

HALVINGS = 70
"""Of the line between two of these, down to neighbouring numbers."""

NEAR, NEXT = 1e-12, 1e-9
"""Relative distances from a condition, beyond its rounding errors, of values on both sides and of the next ones, which
show how rows change there: a square root differs by 1e-6 and 3e-5."""

STEADY = 10.0
"""A jump is larger than so many of these changes, ..."""

ROUNDING = 1e-12
"""... and than this fraction of the row's values."""


def jumps(
    equations: Equations, states: Sequence[str], inputs: Sequence[str], parameters: Mapping[Scalar, float]
) -> list[tuple[str, str, bool]]:
    """The functions at which q', the residual of the equations of motion, or the expression of an input jumps.

    Without those that jump at times that follow from parameters alone.

    Parameters
    ----------
    equations : Equations
    states, inputs : sequence of str
        Their names.
    parameters : mapping of Scalar to float
        Values of parameters' leaves, where these are known.

    Returns
    -------
    list of (str, str, bool)
        Such as "sign of u1"; the name of the input in whose expression it stands, or ""; and whether it jumps with
        these values of parameters, not only with others.
    """
    e, tape = equations, equations.tape
    leaves = (*e.coordinates, *e.speeds, *e.auxiliary_states, *e.inputs, e.time)
    names = (*states, *inputs, "t")
    equations_of_motion = [("", (*e.coordinate_rates.entries, *e.residual.entries))]
    found: dict[tuple[str, str], bool] = {}
    for of, rows in (*equations_of_motion, *((n, (d,)) for n, d in zip(inputs, e.default_inputs.entries, strict=True))):
        nodes = tape.reach(rows)
        moving = tape.dependent(nodes, leaves)
        for node in nodes:
            operation = tape.nodes[node]
            if not isinstance(operation, Call) or node not in moving:
                continue
            arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
            affected = [row for row in rows if tape.depends([row], [Scalar(tape, 1, node)])]
            has_poles = _has_poles(tape, arguments, moving)
            for boundary in (apply(tape, side, arguments) for side in _boundaries(operation.expression, has_poles)):
                by = [name for name, leaf in zip(names, leaves, strict=True) if tape.depends([boundary], [leaf])]
                if not by or are_known(tape, e.time, boundary):
                    continue
                key = f"{type(operation.expression).__name__} of {', '.join(by)}", of
                if _jumps_at(e, boundary, affected, parameters):
                    found[key] = True
                elif _jumps_at(e, boundary, affected, {}):
                    found.setdefault(key, False)
    return [(*key, by_these) for key, by_these in found.items()]


def _has_poles(tape: Tape, arguments: Sequence[Scalar], moving: Collection[int]) -> bool:
    """Whether arguments have poles in what moves."""
    operations = (tape.nodes[node] for node in tape.reach(arguments) if node in moving)
    return any(
        isinstance(o, Reciprocal) or (isinstance(o, Call) and isinstance(o.expression, sm.tan)) for o in operations
    )


def _boundaries(function: sm.Expr, has_poles: bool) -> Iterator[sm.Expr]:
    """Expressions that change sign where a function may jump."""
    yield from sides(function)
    if isinstance(function, sm.floor | sm.ceiling):
        yield sm.sin(sm.pi * function.args[0])
    elif isinstance(function, sm.atan2 | sm.acot):
        yield function.args[0]
    elif has_poles and isinstance(function, sm.atan | sm.tanh | sm.erf):
        yield 1 / function.args[0]


def _jumps_at(e: Equations, boundary: Scalar, rows: Sequence[Scalar], parameters: Mapping[Scalar, float]) -> bool:
    """Whether the rows jump at a sign change of a scalar on one of several random lines."""
    tape, generator = e.tape, random.Random(0)
    leaves = [Scalar(tape, 1, n) for n in tape.reach([boundary, *rows]) if isinstance(tape.nodes[n], Leaf)]
    for attempt in range(ATTEMPTS):
        known = {leaf: parameters[leaf] if leaf in parameters else generator.uniform(0.5, 1.5) for leaf in e.parameters}
        sizes = [10.0 ** generator.uniform(-ORDERS, ORDERS) if attempt % 2 else 1.0 for _ in leaves]
        line = {
            leaf: (size * generator.uniform(-1.0, 1.0), size * generator.uniform(-1.0, 1.0))
            for leaf, size in zip(leaves, sizes, strict=True)
        }
        line |= {leaf: (value, 0.0) for leaf, value in known.items()}
        ends = _switch({share: _is_positive(boundary, line, share) for share in DISTANCES})
        if ends is None:
            continue
        low, high = ends
        before = _is_positive(boundary, line, low)
        for _ in range(HALVINGS):
            middle = (low + high) / 2.0
            low, high = (middle, high) if _is_positive(boundary, line, middle) == before else (low, middle)
        far = max(abs(low), abs(high))
        places = (ends[0], low - NEXT * far, low - NEAR * far, high + NEAR * far, high + NEXT * far, ends[1])
        of_all = [_values(rows, line, share) for share in places]
        if None in of_all:
            continue
        for first, earlier, last, then, later, end in zip(*filter(None, of_all), strict=True):
            steady = STEADY * (abs(last - earlier) + abs(later - then))
            if abs(then - last) > steady + ROUNDING * max(map(abs, (first, earlier, last, then, later, end))):
                return True
    return False


Line = Mapping[Scalar, tuple[float, float]]
"""For each leaf its value at the origin of a line, and its change along it."""


def _values(scalars: Sequence[Scalar], line: Line, share: float) -> list[float] | None:
    """Values at a place of a line, or None where they have none."""
    try:
        return scalars[0].tape.evaluate(scalars, {leaf: start + share * way for leaf, (start, way) in line.items()})
    except (ArithmeticError, ValueError, TypeError):
        return None


def _is_positive(boundary: Scalar, line: Line, share: float) -> bool | None:
    values = _values([boundary], line, share)
    return None if values is None else values[0] > 0.0


def _switch(signs: Mapping[float, bool | None]) -> tuple[float, float] | None:
    """The places next to zero between which a sign changes."""
    pairs = itertools.pairwise(signs)
    found = [(a, b) for a, b in pairs if None not in (signs[a], signs[b]) and signs[a] != signs[b]]
    return min(found, key=lambda pair: min(map(abs, pair)), default=None)
