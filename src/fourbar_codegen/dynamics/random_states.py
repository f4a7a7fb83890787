"""Random states of a mechanism, also states that satisfy its constraints, and the values of expressions there."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.dynamics.constraints import Constraints
from fourbar_codegen.expressions.derivatives import jacobian
from fourbar_codegen.expressions.tape import Leaf, Scalar, Tape

__all__ = ["RandomStates", "close", "closed_states"]

Floats = NDArray[np.float64]
Point = dict[Scalar, float]

MAX_STATES = 60
"""Number of states that are drawn; at some of them expressions have no value, or loops do not close."""
CLOSURE_RTOL = 1e-12
"""Largest violation of a constraint, relative to its scale; smallest singular value that counts."""
MAX_CORRECTIONS = 40
"""Iterations of Newton's method to satisfy the constraints."""
MIN_STEP_FRACTION = 1e-5
"""Smallest fraction of a Newton step that is tried."""


class RandomStates:
    """Random values of the leaves, including parameters, and the scalars' values there.

    Parameters
    ----------
    tape : Tape
    constraints : Constraints
    values : mapping of Scalar to float
        Values of leaves near which expressions are defined; the second half of the states is drawn there.
    scalars : sequence of Scalar
    more : sequence of Scalar, optional
        Further scalars that are zero at closed states, like the position constraints.
    """

    def __init__(
        self,
        tape: Tape,
        constraints: Constraints,
        values: Mapping[Scalar, float],
        scalars: Sequence[Scalar],
        more: Sequence[Scalar] = (),
    ) -> None:
        self.tape, self.constraints, self.values, self.scalars = tape, constraints, values, scalars
        self._closing = [*constraints.positions, *more]
        self._jacobian = [*chain.from_iterable(constraints.jacobian)]
        entries = [*self._closing, *constraints.velocities, *constraints.acceleration_bias, *scalars]
        operations = {node: tape.nodes[node] for node in tape.reach(entries)}
        self._kinds = {Scalar(tape, 1, node): op.kind for node, op in operations.items() if isinstance(op, Leaf)}

    def anywhere(self) -> Iterator[Floats]:
        """At states that need not satisfy the constraints."""
        for point in self._points():
            yield from self._at(point)

    def closed(self) -> Iterator[Floats]:
        """At closed states: coordinates and parameters are changed until the position constraints are satisfied."""
        for point in self._closed():
            yield from self._at(point)

    def moving(self, speeds: Sequence[Scalar], accelerations: Sequence[Scalar]) -> Iterator[Floats]:
        """At closed states that also satisfy the velocity constraints, with accelerations that keep them."""
        constraints, n_u = self.constraints, len(speeds)
        for point in self._closed():
            point.update((leaf, point.get(leaf, self._draw("u"))) for leaf in (*speeds, *accelerations))
            for leaves, violation in ((speeds, constraints.velocities), (accelerations, constraints.acceleration_bias)):
                numbers = _numbers(self.tape, [*violation, *self._jacobian], point)
                if numbers is None:
                    break
                left, matrix = numbers[: len(violation)], numbers[len(violation) :].reshape(-1, n_u)
                if leaves is accelerations:
                    left = left + matrix @ [point[leaf] for leaf in leaves]
                for leaf, change in zip(leaves, np.linalg.lstsq(matrix, left, rcond=CLOSURE_RTOL)[0], strict=True):
                    point[leaf] -= float(change)
            else:
                yield from self._at(point)

    def _closed(self) -> Iterator[Point]:
        closing = set(self.tape.reach(self._closing))
        moved = [leaf for leaf, kind in self._kinds.items() if leaf.node in closing and kind in "qp"]
        slopes = [*chain.from_iterable(jacobian(self.tape, self._closing, moved))]
        for point in self._points():
            if not self._closing or _newton(self.tape, self._closing, slopes, moved, point):
                yield point

    def _draw(self, kind: str) -> float:
        """A random value of either sign; positive for parameters, which are usually lengths and masses."""
        size = self._generator.uniform(0.2, 1.5)
        return size if kind == "p" else self._generator.choice((size, -size))

    def _points(self) -> Iterator[Point]:
        """Random values of the leaves, the second half near the given values; the same in each call."""
        self._generator = random.Random(0)
        for number in range(MAX_STATES):
            near = self.values if number >= MAX_STATES // 2 else {}
            yield {
                leaf: near[leaf] + self._generator.uniform(-0.1, 0.1) if leaf in near else self._draw(kind)
                for leaf, kind in self._kinds.items()
            }

    def _at(self, point: Point) -> Iterator[Floats]:
        numbers = _numbers(self.tape, self.scalars, point)
        if numbers is not None:
            yield numbers


def close(tape: Tape, closing: Sequence[Scalar], moved: Sequence[Scalar], point: Point) -> bool:
    """Change leaves by Newton's method with minimum-norm steps until scalars are zero; whether that succeeds.

    Parameters
    ----------
    tape : Tape
    closing, moved : sequence of Scalar
        The scalars to make zero, and the leaves to change.
    point : dict of Scalar to float
        Values of all leaves, changed in place.
    """
    return not closing or _newton(tape, closing, [*chain.from_iterable(jacobian(tape, closing, moved))], moved, point)


def closed_states(
    tape: Tape,
    closing: Sequence[Scalar],
    coordinates: Sequence[Scalar],
    parameters: Sequence[Scalar],
    others: Sequence[Scalar],
    values: Mapping[Scalar, float],
) -> Iterator[Point]:
    """States of a mechanism with its own parameters at which scalars are zero; none if these have no value.

    Parameters
    ----------
    tape : Tape
    closing : sequence of Scalar
        The scalars, which are functions of the coordinates.
    coordinates, parameters, others : sequence of Scalar
        Leaves to change, from near their given values on; to leave at these; and with any value.
    values : mapping of Scalar to float
    """
    generator = random.Random(0)
    slopes = [*chain.from_iterable(jacobian(tape, closing, coordinates))]
    is_given = not tape.depends(closing, [leaf for leaf in parameters if leaf not in values])
    for number in range(MAX_STATES if is_given else 0):
        size = 0.1 if number % 2 else 1.0
        point = {leaf: generator.uniform(0.1, 1.0) for leaf in (*others, *parameters)} | dict(values)
        point |= {q: values.get(q, 0.0) + generator.uniform(-size, size) for q in coordinates}
        if _newton(tape, closing, slopes, coordinates, point):
            yield point


def _newton(
    tape: Tape, closing: Sequence[Scalar], slopes: Sequence[Scalar], moved: Sequence[Scalar], point: Point
) -> bool:
    found = _violation(tape, closing, slopes, point)
    for _ in range(MAX_CORRECTIONS):
        if found is None:
            return False
        violation, matrix, sizes = found
        if (np.abs(violation) <= CLOSURE_RTOL * sizes).all():
            return True
        step = -np.linalg.lstsq(matrix, violation, rcond=CLOSURE_RTOL)[0]
        share, found = 1.0, None
        while found is None and share > MIN_STEP_FRACTION:
            there = {leaf: point[leaf] + share * float(change) for leaf, change in zip(moved, step, strict=True)}
            found = _violation(tape, closing, slopes, {**point, **there})
            # Sufficient decrease, in the scales before the step.
            if found is not None and np.linalg.norm(found[0] / sizes) > (1.0 - 0.1 * share) * np.linalg.norm(
                violation / sizes
            ):
                found = None
            share *= 0.5
        point.update(there)
    return False


def _violation(
    tape: Tape, closing: Sequence[Scalar], slopes: Sequence[Scalar], point: Point
) -> tuple[Floats, Floats, Floats] | None:
    """The violation, its derivatives, and its scales."""
    numbers = _numbers(tape, [*closing, *slopes], point)
    if numbers is None:
        return None
    violation, matrix = numbers[: len(closing)], numbers[len(closing) :].reshape(len(closing), -1)
    return violation, matrix, 1.0 + np.abs(matrix).sum(axis=1)


def _numbers(tape: Tape, scalars: Sequence[Scalar], point: Point) -> Floats | None:
    numbers = np.array(tape.evaluate(scalars, point))
    return numbers if np.isfinite(numbers).all() else None
