"""Groups of one or two position constraints that determine as many coordinates, one group after another.

In the loops of dyads (four-bar linkage, slider-crank, and their combinations) each group's constraints are polynomials
in exp(i angle) and in displacements, once the coordinates of earlier groups are known. If constraints close loops with
paths in common, such groups are found among their sums and differences.

Source: dyads are solved one after another as Assur groups of the second class (J. M. McCarthy and G. S. Soh, *Geometric
Design of Linkages*, 2nd ed., 2011, chapter 2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.analysis.polynomials import Constraints, Polynomial, real_roots

__all__ = ["DISTINCT_ATOL", "ROUNDING_RTOL", "Chart", "Group", "Solved", "leaf_values", "solving_order"]

Floats = NDArray[np.float64]

ROUNDING_RTOL = 1e-13
"""Violation of a constraint in a mode, relative to its terms."""

DISTINCT_ATOL = 1e-5
"""Modes that differ by more are always distinct, even if they are not known that well. Where two meet, constraints are
satisfied to ROUNDING_RTOL within sqrt(ROUNDING_RTOL) = 3e-7."""

CANCELLATION_RTOL = 1e-12
"""Derivatives of a sum of constraints, relative to its terms, where a coordinate cancels."""

EPS = float(np.finfo(float).eps)


def leaf_values(loops: Loops) -> dict[tuple[str, str], float]:
    """Values of the leaves of the constraints' formulas, with dependent coordinates of 1 until they are known."""
    model = loops.model
    parameters, inputs = model.layout.parameters, model.layout.inputs
    p = [entry.default for entry in parameters] if loops.p is None else loops.p
    r = model.default_inputs(loops.t, loops.p) if loops.r is None else loops.r
    q = loops.coordinates(np.ones(loops.n_dependent))
    values = {("t", ""): loops.t}
    values |= {("q", name): value for name, value in zip(model.coordinates, q, strict=True)}
    values |= {("p", entry.name): value for entry, value in zip(parameters, p, strict=True)}
    values |= {("r", entry.name): value for entry, value in zip(inputs, r, strict=True)}
    return values


@dataclass(frozen=True)
class Chart:
    """The loops, with properties of their dependent coordinates.

    Attributes
    ----------
    loops : Loops
    weights : ndarray, shape (n_h, n_h)
        Of the position constraints in those that are solved, in rows: sums and differences of loops.
    constraints : Constraints
        These, as polynomials.
    held : ndarray of bool, shape (n_h, n)
        Which of these contains which coordinate.
    is_angle : ndarray of bool, shape (n,)
        Whether the constraints are periodic in it by 2 pi.
    scales : ndarray, shape (n,)
        Typical values: 1 for angles; for displacements the median of residuals over derivatives, about the displacement
        that closes a loop.
    """

    loops: Loops
    weights: Floats
    constraints: Constraints
    held: NDArray[np.bool_]
    is_angle: NDArray[np.bool_]
    scales: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dependent coordinates."""
        return self.loops.names

    @classmethod
    def of(cls, loops: Loops, start: Floats, generator: np.random.Generator) -> Chart:
        """A chart from the structure of the constraints, and their values at random coordinates."""
        rows = range(loops.model.n_h)
        constraints = Constraints(loops.model.layout.constraints.positions, leaf_values(loops))
        names = loops.names
        given = [name for name in loops.model.coordinates if name not in names]
        # Independent angles between -pi and pi, since sines of large ones have fewer digits in double precision.
        turns = [all(constraints.is_periodic(row, name) for row in rows) for name in given]
        loops = replace(loops, q_i=np.where(turns, np.remainder(loops.q_i + np.pi, 2 * np.pi) - np.pi, loops.q_i))
        constraints = constraints.with_values({("q", name): q for name, q in zip(given, loops.q_i, strict=True)})
        held = np.array([[constraints.depends(row, name) for name in names] for row in rows], dtype=bool)
        is_angle = np.array([all(constraints.is_periodic(row, name) for row in rows) for name in names], dtype=bool)
        points = np.where(is_angle, generator.uniform(-np.pi, np.pi, (4, len(start))), start)
        known = [loops.position(point) for point in points]
        gaps = np.array([np.abs(error).max() for error, _ in known])
        rates = np.array([np.abs(slopes).max(axis=0) for _, slopes in known])
        with np.errstate(all="ignore"):
            reach = np.median(gaps[:, None] / rates, axis=0)
        scales = np.where(is_angle | ~np.isfinite(reach) | (reach == 0.0), 1.0, reach)
        return cls(loops, np.eye(len(rows)), constraints, held, is_angle, scales)

    def combined(self, generator: np.random.Generator) -> Chart:
        """A chart of sums and differences of the constraints that contain fewer coordinates.

        The closures of two loops with a path in common differ by that of a third loop without it.
        """
        points = generator.uniform(-np.pi, np.pi, (4, self.loops.n_dependent)) * self.scales
        slopes = np.stack([self.loops.jacobian(point) for point in points], axis=1)
        weights = _fewest_coordinates(slopes)
        sums = np.einsum("ij,jkl->ikl", weights, slopes)
        terms = np.einsum("ij,jkl->ikl", np.abs(weights), np.abs(slopes))
        alone = (np.abs(weights).sum(axis=1) == 1.0)[:, None]
        held = np.where(alone, self.held, (np.abs(sums) > CANCELLATION_RTOL * terms).any(axis=1))
        return replace(self, weights=weights, constraints=self.constraints.combined(weights), held=held)

    def position(self, dependent: Floats) -> tuple[Floats, Floats]:
        """The residual of the constraints that are solved, and its derivatives."""
        error, slopes = self.loops.position(dependent)
        return self.weights @ error, self.weights @ slopes

    def terms(self, dependent: Floats) -> Floats:
        """The scales of the constraints that are solved."""
        return np.asarray(np.abs(self.weights) @ self.loops.scale(self.loops.coordinates(dependent)))

    def polynomials(self, group: Group, dependent: Floats) -> list[Polynomial] | None:
        """The group's constraints as polynomials in its unknowns; None if they are no polynomials."""
        known = {("q", name): float(dependent[j]) for j, name in enumerate(self.names) if j not in group.unknowns}
        return self.constraints.with_values(known).polynomials(group.rows, self.unknowns(group))

    def unknowns(self, group: Group) -> list[tuple[str, bool]]:
        """Names of the group's coordinates, and whether each is an angle."""
        return [(self.names[j], bool(self.is_angle[j])) for j in group.unknowns]

    def candidates(self, group: Group, polynomials: list[Polynomial] | None) -> list[tuple[float, ...]] | None:
        """Values of the group's unknowns that may be a common root; None if there may be infinitely many."""
        is_angle = [is_angle for _, is_angle in self.unknowns(group)]
        return None if polynomials is None else real_roots(polynomials, is_angle)

    def wrapped(self, dependent: Floats) -> Floats:
        """The coordinates with angles between -pi and pi, and pi for -pi."""
        turns = np.ceil((dependent - np.pi) / (2 * np.pi) - DISTINCT_ATOL)
        return np.where(self.is_angle, dependent - 2 * np.pi * turns, dependent)

    def add(self, dependent: Floats, found: list[Floats], solved: Solved | None = None) -> bool:
        """Append a solution unless it was found already."""
        if found:
            reach = self._uncertainty(dependent, solved or Solved.all_of(self, dependent))
            for other in found:
                difference = dependent - other
                turns = np.where(self.is_angle, np.round(difference / (2 * np.pi)), 0.0)
                if (np.abs(difference - 2 * np.pi * turns) <= reach).all():
                    return False
        found.append(self.wrapped(dependent))
        return True

    def _uncertainty(self, dependent: Floats, solved: Solved) -> Floats:
        """How far a solution moves if each constraint changes by `ROUNDING_RTOL` of its terms; at most
        `DISTINCT_ATOL`.
        """
        error, slopes = self.position(dependent)
        rows, columns = list(solved.rows), list(solved.unknowns)
        error, slopes = error[rows], slopes[rows][:, columns]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            alone = np.where(slopes != 0.0, solved.terms[:, None] / np.abs(slopes), 0.0).max(axis=0)
        most = DISTINCT_ATOL * np.where(self.is_angle[columns], 1.0, np.maximum(np.abs(dependent[columns]), alone))
        try:
            inverse = np.abs(np.linalg.pinv(slopes, rcond=EPS))
        except np.linalg.LinAlgError:
            inverse = np.full(slopes.T.shape, np.inf)
        reach = EPS * np.abs(dependent)
        reach[columns] += np.minimum(inverse @ (ROUNDING_RTOL * solved.terms + np.abs(error)), most)
        return reach


@dataclass(frozen=True)
class Group:
    """One or two constraints, and as many coordinates, determined by these if those of earlier groups are known."""

    rows: tuple[int, ...]
    unknowns: tuple[int, ...]


@dataclass(frozen=True)
class Solved:
    """Constraints, the coordinates that they were solved for, and the size of the constraints' terms there."""

    rows: Sequence[int]
    unknowns: Sequence[int]
    terms: Floats

    @classmethod
    def all_of(cls, chart: Chart, dependent: Floats) -> Solved:
        """All constraints, solved for all dependent coordinates."""
        terms = chart.terms(dependent)
        return cls(range(len(terms)), range(len(dependent)), terms)


def solving_order(loops: Loops, start: Floats, generator: np.random.Generator) -> tuple[Chart, list[Group], list[int]]:
    """The chart, groups in the order of their solution, and the coordinates that are in none."""
    chart = Chart.of(loops, start, generator)
    groups, rest = _groups(chart, generator)
    if rest:
        other = chart.combined(generator)
        more, less = _groups(other, generator)
        if len(less) < len(rest):
            return other, more, less
    return chart, groups, rest


def _fewest_coordinates(slopes: Floats) -> Floats:
    """Weights of 1, 0 and -1, by which one constraint after another is added to or subtracted from others.

    Parameters
    ----------
    slopes : ndarray, shape (n_h, n_points, n)
        Derivatives of the constraints at some points.
    """
    sums, terms, weights = slopes.copy(), np.abs(slopes), np.eye(len(slopes))
    while True:
        counts = (np.abs(sums) > CANCELLATION_RTOL * terms).any(axis=1).sum(axis=1)
        best, change = (0, 0, 0.0), 0
        for sign in (1.0, -1.0):
            both = sums[:, None] + sign * sums[None]
            held = (np.abs(both) > CANCELLATION_RTOL * (terms[:, None] + terms[None])).any(axis=2)
            fewer = counts[:, None] - held.sum(axis=2)
            np.fill_diagonal(fewer, 0)
            i, j = (int(k) for k in np.unravel_index(np.argmax(fewer), fewer.shape))
            if fewer[i, j] > change:
                best, change = (i, j, sign), int(fewer[i, j])
        if not change:
            return weights
        i, j, sign = best
        sums[i] += sign * sums[j]
        terms[i] += terms[j]
        weights[i] += sign * weights[j]


def _groups(chart: Chart, generator: np.random.Generator) -> tuple[list[Group], list[int]]:
    """The groups in the order of their solution, and the coordinates that are in none."""
    groups: list[Group] = []
    unknown = set(range(chart.loops.n_dependent))
    rows = list(range(len(chart.held)))

    def next_group() -> Group | None:
        for size in (1, 2):
            for chosen in combinations(rows, size):
                held = [j for j in sorted(unknown) if chart.held[list(chosen), j].any()]
                if len(held) == size:
                    group = Group(chosen, tuple(held))
                    anywhere = generator.uniform(-np.pi, np.pi, chart.loops.n_dependent) * chart.scales
                    # Redundant constraints have infinitely many common roots everywhere.
                    if chart.candidates(group, chart.polynomials(group, anywhere)) is not None:
                        return group
        return None

    while unknown and (group := next_group()) is not None:
        groups.append(group)
        unknown -= set(group.unknowns)
        rows = [row for row in rows if row not in group.rows]
    return groups, sorted(unknown)
