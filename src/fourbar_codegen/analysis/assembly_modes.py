"""Assembly modes: all ways to close the loops for given independent coordinates.

If one constraint contains one unknown coordinate, or two contain two, as in the loops of dyads (four-bar linkage,
slider-crank, and their combinations), and they are polynomials in exp(i angle) and in displacements, all solutions are
found: as roots of the resultant, with enough digits to separate them. Remaining coordinates, if any, need a multistart
search, which gives a lower bound of the number of modes.

If the Jacobian has a null vector at a solution, and there are solutions at finite steps along it, the solutions form a
curve: a degree of freedom is left, and the search ends. Where two modes meet there is a null vector as well, but no
solution along it.

Source: J. M. McCarthy and G. S. Soh, *Geometric Design of Linkages*, 2nd ed., 2011, chapter 2, has the four-bar's two
modes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.continuation import null_space
from fourbar_codegen.analysis.groups import DISTINCT_ATOL, ROUNDING_RTOL, Chart, Group, Solved, solving_order
from fourbar_codegen.analysis.loop_closure import MAX_CORRECTIONS, SINGULAR_RATIO, Loops
from fourbar_codegen.analysis.polynomials import terms_of
from fourbar_codegen.kernel.dependent import SINGULAR_RTOL, row_sizes

if TYPE_CHECKING:
    from fourbar_codegen.interface.progress import Progress

__all__ = ["closed_coordinates"]

Floats = NDArray[np.float64]

N_WITNESSES = 12
"""Starting points of a numerical search that must find no further solutions."""

MAX_MODES = 1024
"""Largest number of modes, which grows exponentially with the number of loops."""

MAX_FRUITLESS_STARTS = 100
"""A search ends after this number of consecutive starting points without a new solution."""

MAX_STARTING_POINTS = 3000

STEPS = (0.05, 0.2)
"""Steps along a null vector of the Jacobian, in rad or typical displacements, at which a curve of solutions has points.
At the larger one even a root of multiplicity 16 violates its constraint by more than ROUNDING_RTOL."""


def closed_coordinates(loops: Loops, start: Floats, progress: Progress) -> tuple[list[Floats], bool, tuple[str, ...]]:
    """All values of the dependent coordinates found to close the loops, and whether there are no others.

    Parameters
    ----------
    loops : Loops
    start : ndarray, shape (n,)
        Centre of the random starting points, for displacements.
    progress : Progress
        Shows the number found so far.

    Returns
    -------
    list of ndarray
        In ascending order, angles between -pi and pi.
    bool
    tuple of str
        Names of those that can move in a solution; see `AssemblyModes.free`.
    """
    if not loops.model.n_h:
        return [start], True, ()
    generator = np.random.default_rng(0)
    chart, groups, rest = solving_order(loops, start, generator)
    loops = chart.loops
    partial = [np.zeros(len(start))]
    complete, free = True, np.zeros(len(start), dtype=bool)
    for number, group in enumerate(groups):
        extended: list[Floats] = []
        for dependent in partial:
            progress.stage(f"{len(extended)} of {', '.join(chart.names[j] for j in group.unknowns)}")
            roots = _roots(chart, group, dependent)
            if roots is None:  # infinitely many solutions, or nearly
                complete, rest = False, [*rest, *group.unknowns]
                roots = [dependent]
            elif not roots and any(_is_dead(chart, before, dependent) for before in groups[:number]):
                complete = False  # earlier coordinates are known only to half of all digits
            extended += roots
        complete &= len(extended) <= MAX_MODES
        partial = extended[:MAX_MODES]
    if rest and partial:
        complete = False
        found, free = _search(chart, partial, rest, start, generator, progress)
    else:
        found = [dependent for dependent in partial if loops.are_closed(dependent)]
        everything = Group(tuple(range(loops.model.n_h)), tuple(range(len(start))))
        for begin in islice(_starting_points(chart, [start], range(len(start)), start, generator), N_WITNESSES):
            witness = loops.search(begin)
            # Where two modes meet, further solutions nearby are rounding errors, unless none was found at all.
            if witness is None or not _is_exact(loops, witness) or (found and _is_dead(chart, everything, witness)):
                continue
            complete &= not chart.add(witness, found)
        for dependent in found:
            free |= _free(chart, dependent)
        complete &= not free.any()
    sizes = np.abs(found).max(axis=0, initial=1e-300) if found else 1.0
    modes = sorted(found, key=lambda dependent: tuple(np.round(dependent / sizes, 6)))
    return modes, complete, tuple(name for name, is_free in zip(chart.names, free, strict=True) if is_free)


def _roots(chart: Chart, group: Group, dependent: Floats) -> list[Floats] | None:
    """The dependent coordinates with each solution for a group's unknowns; None if solutions are not isolated."""
    loops, rows, columns = chart.loops, list(group.rows), list(group.unknowns)
    polynomials = chart.polynomials(group, dependent)
    candidates = chart.candidates(group, polynomials)
    if polynomials is None or candidates is None:
        return None
    found: list[Floats] = []
    for candidate in candidates:
        point = dependent.copy()
        point[columns] = candidate
        # Terms of the polynomial, and those in its coefficients. Where a root is zero these may have cancelled, and
        # only rounding errors of the constraints are left.
        q = loops.coordinates(point)
        error, slopes = loops.model.position(loops.t, q, loops.p, loops.r)
        error, slopes = chart.weights @ error, np.abs(chart.weights) @ np.abs(slopes)
        at = [1.0 if chart.is_angle[j] else abs(value) for j, value in zip(columns, candidate, strict=True)]
        terms = slopes[rows] @ np.abs(q) + [terms_of(polynomial, at) for polynomial in polynomials]
        if (np.abs(error[rows]) <= ROUNDING_RTOL * np.maximum(terms, chart.terms(point)[rows])).all():
            chart.add(point, found, Solved(rows, columns, terms))
    return found


def _is_exact(loops: Loops, dependent: Floats) -> bool:
    """Whether it satisfies the constraints as well as a mode does."""
    return bool((np.abs(loops.residual(dependent)) <= ROUNDING_RTOL * loops.scale(loops.coordinates(dependent))).all())


def _is_dead(chart: Chart, group: Group, dependent: Floats) -> bool:
    """Whether the configuration is singular or nearly so for a group: two of its solutions meet."""
    slopes = chart.position(dependent)[1][np.ix_(group.rows, group.unknowns)]
    sizes = np.linalg.svd(slopes, compute_uv=False)
    return bool(sizes[-1] <= SINGULAR_RATIO * sizes[0])


def _free(chart: Chart, dependent: Floats) -> NDArray[np.bool_]:
    """Which coordinates change along curves of solutions through one; none if it is isolated.

    Tangents of such curves are null vectors of the Jacobian, so any basis of these has one that is not normal to the
    tangent. Redundant constraints make rows dependent, not columns.
    """
    free = np.zeros(len(dependent), dtype=bool)
    scales = np.where(chart.is_angle, 1.0, np.maximum(chart.scales, np.abs(dependent)))
    slopes = chart.loops.jacobian(dependent) * scales
    if not np.isfinite(slopes).all():
        return free
    directions = null_space(slopes / row_sizes(slopes), SINGULAR_RATIO).T
    for direction in [*directions, *-directions]:
        moved = _moved(chart.loops, dependent, scales, direction)
        if moved is not None:
            free |= np.abs(moved) > DISTINCT_ATOL
    return free


def _moved(loops: Loops, dependent: Floats, scales: Floats, direction: Floats) -> Floats | None:
    """The motion, in units of scales, from a solution to that at the last of `STEPS`; None unless there is one at each.

    It is sought in the plane that is normal to the direction, at that distance, by the Gauss-Newton method.
    """
    for step in STEPS:
        moved = step * direction
        for _ in range(MAX_CORRECTIONS):
            error, slopes = loops.position(dependent + scales * moved)
            if not np.isfinite(slopes).all():
                return None
            off = direction @ moved - step
            if abs(off) <= DISTINCT_ATOL and _is_exact(loops, dependent + scales * moved):
                break
            size = row_sizes(slopes * scales)
            rows, gaps = np.vstack((slopes * scales / size, direction)), np.append(error / size[:, 0], off)
            moved = moved - np.linalg.lstsq(rows, gaps, rcond=SINGULAR_RTOL)[0]
        else:
            return None
        if np.linalg.norm(moved) > 2.0 * step:
            return None
    return moved


def _starting_points(
    chart: Chart, partial: list[Floats], rest: Sequence[int], start: Floats, generator: np.random.Generator
) -> Iterator[Floats]:
    """The known coordinates, and random values of the others."""
    others = list(rest)
    yield start
    for number in range(MAX_STARTING_POINTS):
        begin = partial[number % len(partial)].copy()
        reach = chart.scales * np.where(chart.is_angle, 1.0, 10.0 ** generator.uniform(-1.0, 1.0))
        middle = np.where(chart.is_angle, 0.0, start)
        begin[others] = (middle + reach * generator.uniform(-np.pi, np.pi, len(start)))[others]
        yield begin


def _search(
    chart: Chart,
    partial: list[Floats],
    rest: Sequence[int],
    start: Floats,
    generator: np.random.Generator,
    progress: Progress,
) -> tuple[list[Floats], NDArray[np.bool_]]:
    """Solutions by a multistart search, and which coordinates can move in one of them, with which the search ends."""
    found: list[Floats] = []
    free = np.zeros(len(start), dtype=bool)
    in_vain = 0
    others = _starting_points(chart, partial, rest, start, generator)
    for number, begin in enumerate(chain(partial, others), start=1):
        progress.stage(f"{len(found)} found")
        dependent = chart.loops.search(begin)
        if dependent is not None and chart.add(dependent, found):
            in_vain = 0
            free |= _free(chart, dependent)
        else:
            in_vain += 1
        if free.any() and number >= len(partial):
            break
        if in_vain >= max(MAX_FRUITLESS_STARTS, 2 * len(partial)) or len(found) >= MAX_MODES:
            break
    return found, free
