"""Where the equations of motion jump at times that are not known beforehand, as with dry friction; numerically."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from functools import cache, partial

import numpy as np
import sympy as sm
from numpy.typing import NDArray

from fourbar_codegen.dynamics.equations import Equations, Jump
from fourbar_codegen.expressions.breakpoints import are_known, sides
from fourbar_codegen.expressions.convert import apply
from fourbar_codegen.expressions.tape import Call, Leaf, Reciprocal, Scalar, Tape

__all__ = ["state_jumps"]

Floats = NDArray[np.float64]

N_LINES = 24
"""Random lines along which a condition may switch, ..."""

MAX_ORDER = 3
"""... every other one with variables of different orders of magnitude, up to this power of ten."""

DISTANCES = np.array(sorted([0.0, *(sign * 10.0**k for k in range(-6, 13) for sign in (1.0, -1.0))]))
"""Along a line, for conditions in any units."""

DIVISIONS, PARTS = 14, np.linspace(0.0, 1.0, 33)
"""How often the line between two of these is divided, and where: down to neighbouring numbers."""

NEAR, NEXT = 1e-12, 1e-9
"""Relative distances from a condition, beyond its rounding errors, of values on both sides and of the next ones, which
show how rows change there: a square root differs by 1e-6 and 3e-5."""

JUMP_RATIO = 10.0
"""A jump is larger than so many of these changes, ..."""

ROUNDING_RTOL = 1e-12
"""... and than this fraction of the row's values."""


class Outcome(Enum):
    """Of a search for a jump."""

    STEADY = auto()
    JUMPS = auto()
    UNKNOWN = auto()
    """Wherever the function may jump, the rows have no real value."""


def state_jumps(equations: Equations, parameters: Mapping[Scalar, float]) -> tuple[Jump, ...]:
    """Where q', the residual of the equations of motion, or the expression of an input jumps.

    Without jumps at times that follow from parameters alone.

    Parameters
    ----------
    equations : Equations
    parameters : mapping of Scalar to float
        Values of parameters' leaves, where these are known.
    """
    e, tape = equations, equations.tape
    leaves = (*e.variables.state, *e.variables.inputs, e.variables.time)
    equations_of_motion = [(None, (*e.dynamics.coordinate_rates.entries, *e.dynamics.residual.entries))]

    @cache
    def outcomes(boundary: Scalar, affected: tuple[Scalar, ...]) -> tuple[Outcome, Outcome]:
        """With the known values of parameters, and with others."""
        own = _look(e, boundary, affected, parameters)
        return own, own if own is Outcome.JUMPS else _look(e, boundary, affected, {})

    found: list[Jump] = []
    for of, rows in (*equations_of_motion, *((i, (default,)) for i, default in enumerate(e.inputs.default.entries))):
        nodes = tape.reach(rows)
        calls = [*_moving_boundaries(tape, nodes, leaves)]
        affected: dict[int, tuple[Scalar, ...]] = {}
        within: dict[int, set[int]] = {}
        for call in dict.fromkeys(call for call, _, _ in calls):
            within[call] = tape.dependent(nodes, [Scalar(tape, 1, call)])
            affected[call] = tuple(row for row in rows if row.node in within[call])
        for call, function, boundary in calls:
            reached = set(tape.reach([boundary]))
            by = tuple(leaf for leaf in leaves if leaf.node in reached)
            if not by or are_known(tape, e.variables.time, boundary):
                continue
            # A function within another one that switches at the same place, such as a root in a branch, is not named.
            if any(
                other != call and there.node == boundary.node and other in within[call]
                for other, _, there in calls
                if affected[other] == affected[call]
            ):
                continue
            own, other = outcomes(boundary, affected[call])
            if Outcome.JUMPS in (own, other) or {own, other} == {Outcome.UNKNOWN}:
                is_known, by_default = own is not Outcome.UNKNOWN, own is not Outcome.STEADY
                found.append(Jump(type(function).__name__, boundary, by, of, by_default, is_known))
    return tuple(found)


def _moving_boundaries(
    tape: Tape, nodes: Sequence[int], leaves: Sequence[Scalar]
) -> Iterator[tuple[int, sm.Expr, Scalar]]:
    """Calls among nodes that depend on leaves, each with the scalars at whose sign changes it may jump."""
    moving = tape.dependent(nodes, leaves)
    for node in nodes:
        operation = tape.nodes[node]
        if isinstance(operation, Call) and node in moving:
            arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
            sides = _boundaries(operation.expression, partial(_have_poles, tape, arguments, moving))
            for boundary in dict.fromkeys(apply(tape, side, arguments) for side in sides):
                yield node, operation.expression, boundary


def _have_poles(tape: Tape, arguments: Sequence[Scalar], moving: Collection[int]) -> bool:
    """Whether arguments have poles in what moves."""
    operations = (tape.nodes[node] for node in tape.reach(arguments) if node in moving)
    return any(
        isinstance(o, Reciprocal) or (isinstance(o, Call) and isinstance(o.expression, sm.tan)) for o in operations
    )


def _boundaries(function: sm.Expr, have_poles: Callable[[], bool]) -> Iterator[sm.Expr]:
    """Expressions that change sign where a function may jump."""
    yield from sides(function)
    if isinstance(function, sm.floor | sm.ceiling):
        yield sm.sin(sm.pi * function.args[0])
    elif isinstance(function, sm.atan2 | sm.acot):
        yield function.args[0]
    elif isinstance(function, sm.atan | sm.tanh | sm.erf) and have_poles():
        yield 1 / function.args[0]


@dataclass(frozen=True)
class Lines:
    """Lines in the space of the leaves.

    Attributes
    ----------
    origins, ways : dict of Scalar to ndarray, shape (lines, 1)
        For each leaf its values at the lines' origins, and its changes along these.
    """

    origins: dict[Scalar, Floats]
    ways: dict[Scalar, Floats]

    def values(self, scalars: Sequence[Scalar], shares: Floats) -> Floats:
        """Values of scalars at places of the lines, shape (lines, places): shape (scalars, lines, places)."""
        tape = scalars[0].tape
        leaves = [leaf for leaf in (Scalar(tape, 1, node) for node in tape.reach(scalars)) if leaf in self.origins]
        point = {leaf: self.origins[leaf] + shares * self.ways[leaf] for leaf in leaves}
        return np.array([np.broadcast_to(value, shares.shape) for value in tape.evaluate_at(scalars, point)])

    def only(self, lines: NDArray[np.intp]) -> Lines:
        """Some of the lines."""
        origins, ways = ({leaf: all_[lines] for leaf, all_ in of.items()} for of in (self.origins, self.ways))
        return Lines(origins, ways)


def _random_lines(e: Equations, scalars: Sequence[Scalar], parameters: Mapping[Scalar, float]) -> Lines:
    tape, generator = e.tape, random.Random(0)
    leaves = [Scalar(tape, 1, n) for n in tape.reach(scalars) if isinstance(tape.nodes[n], Leaf)]
    lines: dict[Scalar, list[tuple[float, float]]] = {leaf: [] for leaf in leaves}
    for attempt in range(N_LINES):
        given = e.variables.parameters
        known = {leaf: parameters[leaf] if leaf in parameters else generator.uniform(0.5, 1.5) for leaf in given}
        sizes = [10.0 ** generator.uniform(-MAX_ORDER, MAX_ORDER) if attempt % 2 else 1.0 for _ in leaves]
        for leaf, size in zip(leaves, sizes, strict=True):
            drawn = size * generator.uniform(-1.0, 1.0), size * generator.uniform(-1.0, 1.0)
            lines[leaf].append((known[leaf], 0.0) if leaf in known else drawn)
    columns = {leaf: np.array(pairs)[..., np.newaxis] for leaf, pairs in lines.items()}
    origins, ways = ({leaf: pairs[:, i] for leaf, pairs in columns.items()} for i in (0, 1))
    return Lines(origins, ways)


def _look(e: Equations, boundary: Scalar, rows: Sequence[Scalar], parameters: Mapping[Scalar, float]) -> Outcome:
    """Whether the rows jump at a sign change of a scalar on one of several random lines."""
    lines = _random_lines(e, [boundary, *rows], parameters)
    [values] = lines.values([boundary], np.tile(DISTANCES, (N_LINES, 1)))
    known, positive = np.isfinite(values), values > 0.0
    switches = known[:, :-1] & known[:, 1:] & (positive[:, :-1] != positive[:, 1:])
    chosen = np.flatnonzero(switches.any(axis=1))
    if not len(chosen):
        return Outcome.STEADY if known.any(axis=1).all() else Outcome.UNKNOWN
    lines = lines.only(chosen)
    distances = np.minimum(np.abs(DISTANCES[:-1]), np.abs(DISTANCES[1:]))
    places = np.where(switches[chosen], distances, np.inf).argmin(axis=1)[:, np.newaxis]  # the nearest
    begin, end = DISTANCES[places], DISTANCES[places + 1]
    low, high = _switch(lines, boundary, begin, end, np.take_along_axis(positive[chosen], places, axis=1))
    far = np.maximum(np.abs(low), np.abs(high))
    around = [begin, low - NEXT * far, low - NEAR * far, high + NEAR * far, high + NEXT * far, end]
    values = lines.values(rows, np.hstack(around))
    earlier, last, then, later = np.moveaxis(values[..., 1:-1], 2, 0)
    with np.errstate(invalid="ignore"):  # where a row has no real value, comparisons are false
        steady = JUMP_RATIO * (np.abs(last - earlier) + np.abs(later - then))
        if (np.abs(then - last) > steady + ROUNDING_RTOL * np.abs(values).max(axis=2)).any():
            return Outcome.JUMPS
    # At the edge of its domain, such as that of a root, a row has values on one side.
    has_values = (np.isfinite(earlier) & np.isfinite(last)) | (np.isfinite(then) & np.isfinite(later))
    return Outcome.STEADY if has_values.all(axis=0).any() else Outcome.UNKNOWN


def _switch(
    lines: Lines, boundary: Scalar, low: Floats, high: Floats, before: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Neighbouring numbers between which a sign changes from what it is before."""
    for _ in range(DIVISIONS):
        places = low + (high - low) * PARTS
        [values] = lines.values([boundary], places[:, 1:-1])
        switched = np.hstack(((values > 0.0) != before, np.ones_like(before))).argmax(axis=1)[:, np.newaxis]
        low, high = (np.take_along_axis(places, switched + i, axis=1) for i in (0, 1))
    return low, high
