"""Curves F(z) = 0 in n + 1 unknowns, traced by arc length through folds.

A step along the tangent is corrected by the Gauss-Newton method with steps of minimum norm. At a fold the last unknown,
the parameter of the curve, has an extreme value; where two curves cross, the trace goes straight on. Where curves pass
near each other, the smallest singular value of the Jacobian is proportional to their distance, and steps are shorter.

Source: E. L. Allgower and K. Georg, Introduction to Numerical Continuation Methods, SIAM 2003, chapters 3 and 6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

__all__ = ["Curve", "null_space", "solve_at", "trace"]

Floats = NDArray[np.float64]
Function = Callable[[Floats], tuple[Floats, Floats]]
"""F and its Jacobian; unknowns and rows are scaled to the order of 1."""

MAX_STEP_LENGTH = 0.1
MIN_STEP_LENGTH = 1e-7
"""Largest and smallest length of a step."""

CROSSING_RATIO = 5.0
"""Steps are shorter where the smallest singular value is smaller than the largest one on the curve by this factor."""

CROSSING_ATOL = 1e-5
"""Curves that are nearer to each other than steps of this length can tell cross."""

OVERSTEP = 0.02
OVERSTEP_GROWTH = 1.37
MAX_OVERSTEPS = 4
"""Length of a step over a crossing, and by what it is longer if it ends at another one, so many times."""

MIN_TANGENT_COSINE = 0.98
"""Smallest cosine of the angle between the tangents at the ends of a step."""

MAX_ITERATIONS = 12
MAX_STEPS = 100_000
SOLUTION_ATOL = 1e-12
"""Largest component of F at a solution. Newton's method then goes on while it halves that."""

RANK_RTOL = 1e-9
"""Smallest singular value that counts, relative to the largest."""

REACHED_ATOL = 1e-9
"""Largest distance of a point from a curve through it."""

FOLD_ATOL = 1e-10
"""Component of the tangent along the parameter at a fold."""

NEAR_FOLD_ATOL = 1e-3
"""Component of the tangent along the parameter near a fold."""


@dataclass(frozen=True)
class Curve:
    """A piece of a curve, from one end of the parameter's range to another, or closed.

    Attributes
    ----------
    points : ndarray, shape (n_points, n + 1)
    folds : tuple of int
        Numbers of the points that are folds.
    is_closed : bool
    ends_early : bool
        Whether it ends where no further point was found.
    """

    points: Floats
    folds: tuple[int, ...]
    is_closed: bool
    ends_early: bool

    def branches(self) -> list[Floats]:
        """The parts in which the parameter increases all the way, between folds and ends; turned round if needed."""
        points, folds = self.points, [*self.folds]
        if self.is_closed and folds:  # begin with a fold; a turn later, angles are larger by a whole turn
            turn = points[-1] - points[0]
            points = np.concatenate((points[folds[0] : -1], points[: folds[0] + 1] + turn))
            folds = [fold - folds[0] for fold in folds]
        limits = sorted({0, *folds, len(points) - 1})
        parts = [points[a : b + 1] for a, b in pairwise(limits)]
        return [part if part[-1, -1] >= part[0, -1] else part[::-1] for part in parts]


def null_space(jacobian: Floats, rank: float = RANK_RTOL) -> Floats:
    """An orthonormal basis in columns; singular values count from the fraction `rank` of the largest."""
    return _null_space(jacobian, rank)[0]


def _null_space(jacobian: Floats, rank: float = RANK_RTOL) -> tuple[Floats, Floats]:
    """The basis, and the singular values."""
    _, sizes, basis = np.linalg.svd(jacobian)
    return np.asarray(basis[int((sizes > rank * sizes.max(initial=0.0)).sum()) :].T), sizes


def _correct(function: Function, z: Floats, held: bool = False) -> Floats | None:
    """A solution near z by minimum-norm steps, without a change of the parameter if it is held; None without one."""
    value, jacobian = function(z)
    for _ in range(MAX_ITERATIONS):
        size = np.abs(value).max(initial=0.0)
        if not np.isfinite(size):
            return None
        free = jacobian[:, :-1] if held else jacobian
        step = np.linalg.lstsq(free, value, rcond=RANK_RTOL)[0]
        tried = z - (np.append(step, 0.0) if held else step)
        value_there, jacobian_there = function(tried)
        if size <= SOLUTION_ATOL and not np.abs(value_there).max(initial=0.0) < 0.5 * size:
            return z
        z, value, jacobian = tried, value_there, jacobian_there
    return z if np.abs(value).max(initial=0.0) <= SOLUTION_ATOL else None


def solve_at(function: Function, guess: Floats, parameter: float) -> Floats | None:
    """The solution near a guess for a value of the parameter; None without one."""
    return _correct(function, np.append(guess[:-1], parameter), held=True)


def _tangent(function: Function, z: Floats, before: Floats) -> tuple[Floats, float]:
    """The unit tangent, in the direction of the one before; and the smallest singular value, of as many as unknowns.

    Where curves cross, the tangent is the nearest to the one before.
    """
    basis, sizes = _null_space(function(z)[1])
    largest, n = sizes.max(initial=0.0), len(before) - 1
    along = basis @ (basis.T @ before)
    size = np.linalg.norm(along)
    smallest = float(sizes[n - 1] / largest) if len(sizes) >= n and largest else 0.0
    return np.asarray(along / size) if size else before, smallest


def trace(function: Function, begin: Floats, low: float, high: float, periods: Floats) -> Curve:
    """Trace a curve in both directions from a point, until the parameter leaves its range or the curve closes.

    Parameters
    ----------
    function : callable
    begin : ndarray, shape (n + 1,)
        A solution.
    low, high : float
        The range of the parameter.
    periods : ndarray, shape (n + 1,)
        Of unknowns in which F is periodic, such as angles; infinite for the others.

    Returns
    -------
    Curve
    """
    tangent = null_space(function(begin)[1])[:, 0]
    if abs(tangent[-1]) < NEAR_FOLD_ATOL:  # a fold, or near to one: begin beside it, so that it is passed
        beside = _correct(function, begin + 0.5 * MAX_STEP_LENGTH * tangent)
        if beside is not None and low <= beside[-1] <= high:
            begin, tangent = beside, _tangent(function, beside, tangent)[0]
    forward, folds, is_closed, early = _follow(function, begin, tangent, low, high, periods)
    if is_closed:
        return Curve(np.array(forward), tuple(folds), True, early)
    backward, others, _, early_too = _follow(function, begin, -tangent, low, high, periods)
    n = len(backward) - 1
    points = np.array([*backward[:0:-1], *forward])
    return Curve(points, (*sorted(n - k for k in others), *(n + k for k in folds)), False, early or early_too)


def _follow(
    function: Function, begin: Floats, tangent: Floats, low: float, high: float, periods: Floats
) -> tuple[list[Floats], list[int], bool, bool]:
    """Points in one direction, numbers of folds, and whether it is closed or ends early."""
    points, folds = [begin], list[int]()
    first, step = tangent, MAX_STEP_LENGTH
    regular = distance = _tangent(function, begin, tangent)[1]

    def add_fold(z: Floats, tangent: Floats, step: float) -> None:
        fold = _fold(function, z, tangent, step)
        if fold is not None and low <= fold[-1] <= high:
            points.append(fold)
            folds.append(len(points) - 1)

    def allowed(distance: float) -> float:
        return MAX_STEP_LENGTH * min(1.0, CROSSING_RATIO * distance / regular) if regular else MAX_STEP_LENGTH

    crosses, longer = allowed(distance) < CROSSING_ATOL, 0
    for _ in range(MAX_STEPS):
        z = points[-1]
        step = step if crosses else min(step, allowed(distance))
        moved = _correct(function, z + step * tangent)
        turned, there = (tangent, 0.0) if moved is None else _tangent(function, moved, tangent)
        is_near = moved is not None and np.linalg.norm(moved - z - step * tangent) < 0.5 * step
        if moved is not None and is_near and allowed(there) < CROSSING_ATOL and longer < MAX_OVERSTEPS:
            # It ends where curves cross.
            crosses, step, longer = True, max(OVERSTEP, step * OVERSTEP_GROWTH), longer + 1
            continue
        is_straight = turned @ tangent >= MIN_TANGENT_COSINE
        if moved is None or not is_near or not is_straight or not (crosses or step <= 2 * allowed(there)):
            step *= 0.5
            if step < (CROSSING_ATOL if crosses else MIN_STEP_LENGTH):
                return points, folds, False, True
            continue
        turns = np.where(np.isfinite(periods), periods, 0.0) * np.round((z - begin) / periods)
        end, forth = begin + turns, first @ tangent > MIN_TANGENT_COSINE and first @ turned > MIN_TANGENT_COSINE
        if forth and first @ (end - z) > 0.0 >= first @ (end - moved) and _reaches(function, z, tangent, end):
            if first[-1] * tangent[-1] < 0.0:
                add_fold(z, tangent, float(np.linalg.norm(end - z)))
            return [*points, end], folds, True, False
        if turned[-1] * tangent[-1] < 0.0:
            add_fold(z, tangent, step)
        if not low <= moved[-1] <= high:
            last = solve_at(function, moved, low if moved[-1] < low else high)
            if last is not None:
                points.append(last)
            return points, folds, False, last is None
        points.append(moved)
        tangent, distance, regular = turned, there, max(regular, there)
        crosses, longer = allowed(distance) < CROSSING_ATOL, 0
        step = OVERSTEP if crosses else min(MAX_STEP_LENGTH, 1.5 * step)
    return points, folds, False, True


def _reaches(function: Function, z: Floats, tangent: Floats, end: Floats) -> bool:
    """Whether a curve goes through a point ahead, and not beside it."""
    for _ in range(MAX_ITERATIONS):
        gap = end - z
        if np.linalg.norm(gap) <= REACHED_ATOL:
            return True
        moved = _correct(function, z + (gap @ tangent) * tangent)
        if moved is None:
            return False
        z, tangent = moved, _tangent(function, moved, tangent)[0]
    return False


def _fold(function: Function, z: Floats, tangent: Floats, step: float) -> Floats | None:
    """The point between two others where the tangent has no component along the parameter, by bisection."""
    low, high, sign = 0.0, step, tangent[-1]
    found = None
    for _ in range(60):
        middle = (low + high) / 2.0
        found = _correct(function, z + middle * tangent)
        if found is None:
            return None
        slope = _tangent(function, found, tangent)[0][-1]
        if abs(slope) <= FOLD_ATOL:
            break
        low, high = (middle, high) if slope * sign > 0.0 else (low, middle)
    return found
