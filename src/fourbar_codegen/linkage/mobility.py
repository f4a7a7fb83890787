"""How a linkage can move: degrees of freedom and redundant constraints, by rank at closed positions.

Counting (Gruebler) misses special lengths: a parallelogram with a bar too many moves, and three bars can be drawn in
line. The Jacobian of the loops tells the instantaneous mobility at one position; at positions nearby, reached by finite
steps along its null space and closed again, it tells the mobility of the linkage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mobility", "find_mobility"]

Floats = NDArray[np.float64]
Gaps = Callable[[Floats], tuple[Floats, Floats]]

RANK = 1e-7
"""Smallest singular value that counts, relative to the largest."""

SMALLEST = 0.05
"""Smallest part of a column that is independent of others, for a choice of dependent coordinates far from singular."""

STEPS = (0.02, 0.1, 0.3)
"""Lengths of steps to positions nearby: rad, or lengths relative to the size of the linkage."""

ATTEMPTS = 4
MAX_ITERATIONS = 50
CLOSED = 1e-11
"""Largest gap of a closed position, relative to the size of the linkage."""


@dataclass(frozen=True)
class Mobility:
    """How a linkage can move.

    Attributes
    ----------
    gruebler : int
        Degrees of freedom by counting: coordinates minus constraints, 3 (n - 1) - 2 j for n links with j pins.
    degrees_of_freedom : int
        By the rank of the constraints at closed positions near the drawn one, drives not counted.
    left : int
        Degrees of freedom that the drives leave.
    independent : tuple of int
        Numbers of the coordinates that determine the others, as many as are left.
    redundant : tuple of int
        Numbers of the constraints that follow from others.
    is_singular : bool
        Whether it is drawn at a singular position, such as a dead point: there the constraints have a smaller rank.
    motions : ndarray, shape (n, degrees_of_freedom)
        Rates of the coordinates in independent motions at a position nearby, drives not counted.
    """

    gruebler: int
    degrees_of_freedom: int
    left: int
    independent: tuple[int, ...]
    redundant: tuple[int, ...]
    is_singular: bool
    motions: Floats


def find_mobility(
    gaps: Gaps, values: Floats, scales: Floats, driven: Sequence[int], preferred: Sequence[int]
) -> Mobility:
    """Find how a linkage can move.

    Parameters
    ----------
    gaps : callable
        Function of the coordinates; returns the constraints, relative to the size, and their Jacobian.
    values : ndarray, shape (n,)
        The coordinates as drawn, where the constraints hold.
    scales : ndarray, shape (n,)
        Typical changes of the coordinates: 1 rad, or the size of the linkage.
    driven : sequence of int
        Numbers of the driven coordinates, one for each drive.
    preferred : sequence of int
        All coordinates, those first that should be independent.

    Returns
    -------
    Mobility
    """
    _, drawn = gaps(values)
    drawn = drawn * scales
    free = _null_space(drawn)
    nearby = [jacobian * scales for jacobian in _nearby(gaps, values, scales, free)]
    # The rank is larger almost everywhere than at singular positions. With no position nearby, nothing moves.
    generic = max([drawn, *nearby], key=_rank) if nearby or not free.size else np.vstack([drawn, free.T])
    drives = np.zeros((len(driven), len(values)))
    drives[np.arange(len(driven)), list(driven)] = 1.0
    held = np.vstack([generic, drives])
    is_singular = _rank(drawn) < _rank(generic)
    chosen = held if is_singular else np.vstack([drawn, drives])
    left = len(values) - _rank(held)
    return Mobility(
        gruebler=len(values) - len(drawn),
        degrees_of_freedom=len(values) - _rank(generic),
        left=left,
        independent=_independent(chosen, left, preferred),
        redundant=_dependent_rows(generic[: len(drawn)]),
        is_singular=is_singular,
        motions=_null_space(generic),
    )


def _rank(matrix: Floats) -> int:
    sizes = np.linalg.svd(matrix, compute_uv=False) if matrix.size else np.zeros(0)
    return int((sizes > RANK * sizes.max(initial=0.0)).sum())


def _null_space(matrix: Floats) -> Floats:
    """An orthonormal basis, in columns."""
    return np.asarray(np.linalg.svd(matrix)[2][_rank(matrix) :].T) if matrix.size else np.eye(matrix.shape[1])


def _nearby(gaps: Gaps, values: Floats, scales: Floats, free: Floats) -> Iterator[Floats]:
    """The Jacobian at closed positions that are reached by steps along random free motions."""
    generator = np.random.default_rng(0)
    for length in STEPS * ATTEMPTS * bool(free.size):
        step = free @ generator.standard_normal(free.shape[1])
        moved = values + scales * length * step / np.linalg.norm(step)
        for _ in range(MAX_ITERATIONS):
            gap, jacobian = gaps(moved)
            if np.abs(gap).max(initial=0.0) <= CLOSED:
                if np.linalg.norm((moved - values) / scales) > length / 2.0:
                    yield jacobian
                break
            moved = moved - scales * np.linalg.lstsq(jacobian * scales, gap, rcond=RANK)[0]


def _independent(matrix: Floats, count: int, preferred: Sequence[int]) -> tuple[int, ...]:
    """Numbers of columns that determine the others, those first that are preferred.

    The other columns are chosen from the end of the preferred ones, each if it is independent of those chosen by then.
    Near a singular choice, smaller independent parts count.
    """
    for smallest in (SMALLEST, RANK):
        basis: list[Floats] = []
        dependent = []
        for column in reversed(preferred):
            rest = matrix[:, column]
            for _ in range(2):  # twice is enough
                rest = rest - sum((b * (b @ rest) for b in basis), np.zeros(len(rest)))
            if np.linalg.norm(rest) > smallest * np.linalg.norm(matrix[:, column]):
                basis.append(rest / np.linalg.norm(rest))
                dependent.append(column)
        independent = tuple(sorted(set(preferred) - set(dependent)))
        if len(independent) == count:
            break
    return independent


def _dependent_rows(matrix: Floats) -> tuple[int, ...]:
    """Numbers of the rows in linear combinations that vanish."""
    combinations = _null_space(matrix.T)
    return tuple(int(row) for row in np.flatnonzero(np.abs(combinations).max(axis=1, initial=0.0) > RANK))
