"""Assembly modes: all ways to close the loops for given independent coordinates.

If one constraint contains one unknown coordinate, or two contain two, as in the loops of dyads (four-bar linkage,
slider-crank, and their combinations), and they are polynomials in exp(i angle) and in displacements, all solutions are
found: as roots of the resultant, with enough digits to separate them. Remaining coordinates, if any, need a multistart
search, which gives a lower bound of the number of modes.

If the Jacobian has a null vector at a solution, and there are solutions at finite steps along it, the solutions form a
curve: a degree of freedom is left, and the search ends. Where two modes meet there is a null vector as well, but no
solution along it.

Source: dyads are solved one after another as Assur groups of the second class (J. M. McCarthy and G. S. Soh, *Geometric
Design of Linkages*, 2nd ed., 2011, chapter 2, has the four-bar's two modes); two polynomials by Sylvester's resultant
(D. Cox, J. Little, D. O'Shea, *Ideals, Varieties, and Algorithms*, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.continuation import null_space
from fourbar_codegen.analysis.loop_closure import DEAD, MAX_CORRECTIONS, Loops
from fourbar_codegen.analysis.polynomials import Constraints, Polynomial, real_roots, terms_of
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.kernel.dependent import SINGULAR, row_sizes
from fourbar_codegen.kernel.kernel import Kernel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fourbar_codegen.progress import Progress

__all__ = ["AssemblyModes", "closed_coordinates"]

Floats = NDArray[np.float64]

ROUNDING = 1e-13
"""Violation of a constraint in a mode, relative to its terms."""

WITNESSES = 12
"""Starting points of a numerical search that must find no further solutions."""

DISTINCT = 1e-5
"""Modes that differ by more are always distinct, even if they are not known that well. Where two meet, constraints are
satisfied to ROUNDING within sqrt(ROUNDING) = 3e-7."""

EPS = float(np.finfo(float).eps)

MAX_MODES = 1024
"""Largest number of modes, which grows exponentially with the number of loops."""

WITHOUT_NEWS = 100
"""A search ends after this number of consecutive starting points without a new solution."""

MAX_STARTING_POINTS = 3000

STEPS = (0.05, 0.2)
"""Steps along a null vector of the Jacobian, in rad or typical displacements, at which a curve of solutions has points.
At the larger one even a root of multiplicity 16 violates its constraint by more than ROUNDING."""


@dataclass(frozen=True, eq=False)
class AssemblyModes:
    """All states for the same independent coordinates and speeds.

    Returned by `CompiledModel.initial_states`. A sequence of states, sorted by their dependent coordinates, with angles
    between -pi and pi.

    Attributes
    ----------
    model : CompiledModel
    t : float
        Time, s.
    x : ndarray, shape (n, n_x)
        The states. Dependent speeds are NaN in a mode where they do not follow from the independent ones.
    is_complete : bool
        Whether there are no other modes. If False, their number is a lower bound.
    parameters, inputs : ndarray or None
        As given, in order.
    free : tuple of str
        The dependent coordinates that can move while the independent ones are held, in at least one of the modes; empty
        if modes are isolated. Otherwise they are infinitely many, and `x` has examples, found until the first that can
        move: isolated modes may be missing. Dependent speeds are NaN in those that can move.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> modes = fb.load("four_bar").initial_states({"q1": -0.5}, {"u1": -0.1})
    >>> modes
    <AssemblyModes of four_bar: 2, and no others>
    >>> modes[0].round(6).tolist()
    [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
    """

    model: Kernel
    t: float
    x: Floats
    is_complete: bool
    parameters: Floats | None
    inputs: Floats | None
    free: tuple[str, ...] = ()

    def __getitem__(self, number: int) -> Floats:
        """The state of a mode."""
        try:
            state: Floats = self.x[number]
        except ValueError as error:  # NumPy's, for ragged lists
            raise ModelError(f"A mode is known by its number, below {len(self)}, not by {shown(number)}.") from error
        return state

    def __len__(self) -> int:
        """The number of modes."""
        return len(self.x)

    def __iter__(self) -> Iterator[Floats]:
        """The states of all modes."""
        return iter(self.x)

    def __repr__(self) -> str:
        return f"<AssemblyModes of {self.model.name}: {self._number()}>"

    def _number(self) -> str:
        if not len(self):
            return "the loops cannot be closed" if self.is_complete else "none found"
        if self.free:
            return f"{len(self)} of infinitely many; {self.freedom}"
        return f"{len(self)}, and no others" if self.is_complete else f"at least {len(self)}"

    @property
    def freedom(self) -> str:
        """The degree of freedom that is left, in words; empty if `free` is."""
        if not self.free:
            return ""
        held = self.model.coordinates[: self.model.n_q - self.model.manifest["n_dependent_coordinates"]]
        moving = f"{', '.join(self.free)} move{'s' if len(self.free) == 1 else ''}"
        fixed = f"{', '.join(held) or 'nothing'} {'are' if len(held) > 1 else 'is'} held"
        return f"a degree of freedom is left: {moving} while {fixed}"

    def _repr_html_(self) -> str:
        from fourbar_codegen.tables import table

        rows = [(f"{i}", *(f"{value:.6g}" for value in x)) for i, x in enumerate(self.x)]
        return table(f"Assembly modes of {self.model.name}: {self._number()}", ("mode", *self.model.states), rows)

    def plot(self) -> Figure:
        """Draw the mechanism in each of its modes, the first 24 of them; needs the extra ``visual``.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ModelError
            If there is nothing to draw, or Matplotlib is not installed.
        """
        from fourbar_codegen.presentation.figures import plot_modes

        return plot_modes(self)


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
    chart = _Chart.of(loops, start, generator)
    loops = chart.loops
    groups, rest = _groups(chart, generator)
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
            elif not roots and any(_is_dead(loops, before, dependent) for before in groups[:number]):
                complete = False  # earlier coordinates are known only to half of all digits
            extended += roots
        complete &= len(extended) <= MAX_MODES
        partial = extended[:MAX_MODES]
    if rest and partial:
        complete = False
        found, free = _search(chart, partial, rest, start, generator, progress)
    else:
        found = [dependent for dependent in partial if loops.are_closed(dependent)]
        everything = _Group(tuple(range(loops.model.n_h)), tuple(range(len(start))))
        for begin in islice(_starting_points(chart, [start], range(len(start)), start, generator), WITNESSES):
            witness = loops.search(begin)
            # Where two modes meet, further solutions nearby are rounding errors, unless none was found at all.
            if witness is None or not _is_exact(loops, witness) or (found and _is_dead(loops, everything, witness)):
                continue
            complete &= not chart.add(witness, found)
        for dependent in found:
            free |= _free(chart, dependent)
        complete &= not free.any()
    sizes = np.abs(found).max(axis=0, initial=1e-300) if found else 1.0
    modes = sorted(found, key=lambda dependent: tuple(np.round(dependent / sizes, 6)))
    return modes, complete, tuple(name for name, is_free in zip(chart.names, free, strict=True) if is_free)


def _constraints(loops: Loops) -> Constraints:
    """The position constraints as formulas, with dependent coordinates of 1 until they are known."""
    model = loops.model
    parameters, inputs = model.manifest["parameters"], model.manifest["inputs"]
    p = [entry["default"] for entry in parameters] if loops.p is None else loops.p
    r = model.default_inputs(loops.t, loops.p) if loops.r is None else loops.r
    q = loops.coordinates(np.ones(loops.n_dependent))
    values = {("t", ""): loops.t}
    values |= {("q", name): value for name, value in zip(model.coordinates, q, strict=True)}
    values |= {("p", entry["name"]): value for entry, value in zip(parameters, p, strict=True)}
    values |= {("r", entry["name"]): value for entry, value in zip(inputs, r, strict=True)}
    return Constraints(model.manifest["position_constraints"], values)


@dataclass(frozen=True)
class _Chart:
    """The loops, with properties of their dependent coordinates.

    Attributes
    ----------
    loops : Loops
    constraints : Constraints
        As polynomials.
    held : ndarray of bool, shape (n_h, n)
        Which constraint contains which coordinate.
    is_angle : ndarray of bool, shape (n,)
        Whether the constraints are periodic in it by 2 pi.
    scales : ndarray, shape (n,)
        Typical values: 1 for angles; for displacements the median of residuals over derivatives, about the displacement
        that closes a loop.
    """

    loops: Loops
    constraints: Constraints
    held: NDArray[np.bool_]
    is_angle: NDArray[np.bool_]
    scales: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dependent coordinates."""
        return self.loops.names

    @classmethod
    def of(cls, loops: Loops, start: Floats, generator: np.random.Generator) -> _Chart:
        """A chart from the structure of the constraints, and their values at random coordinates."""
        constraints, rows = _constraints(loops), range(loops.model.n_h)
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
        return cls(loops, constraints, held, is_angle, scales)

    def wrapped(self, dependent: Floats) -> Floats:
        """The coordinates with angles between -pi and pi, and pi for -pi."""
        turns = np.ceil((dependent - np.pi) / (2 * np.pi) - DISTINCT)
        return np.where(self.is_angle, dependent - 2 * np.pi * turns, dependent)

    def add(self, dependent: Floats, found: list[Floats], solved: _Solved | None = None) -> bool:
        """Append a solution unless it was found already."""
        if found:
            reach = self._uncertainty(dependent, solved or _Solved.all_of(self, dependent))
            for other in found:
                difference = dependent - other
                turns = np.where(self.is_angle, np.round(difference / (2 * np.pi)), 0.0)
                if (np.abs(difference - 2 * np.pi * turns) <= reach).all():
                    return False
        found.append(self.wrapped(dependent))
        return True

    def _uncertainty(self, dependent: Floats, solved: _Solved) -> Floats:
        """How far a solution moves if each constraint changes by `ROUNDING` of its terms; at most `DISTINCT`."""
        error, slopes = self.loops.position(dependent)
        rows, columns = list(solved.rows), list(solved.unknowns)
        error, slopes = error[rows], slopes[rows][:, columns]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            alone = np.where(slopes != 0.0, solved.terms[:, None] / np.abs(slopes), 0.0).max(axis=0)
        most = DISTINCT * np.where(self.is_angle[columns], 1.0, np.maximum(np.abs(dependent[columns]), alone))
        try:
            inverse = np.abs(np.linalg.pinv(slopes, rcond=EPS))
        except np.linalg.LinAlgError:
            inverse = np.full(slopes.T.shape, np.inf)
        reach = EPS * np.abs(dependent)
        reach[columns] += np.minimum(inverse @ (ROUNDING * solved.terms + np.abs(error)), most)
        return reach


@dataclass(frozen=True)
class _Group:
    """One or two constraints, and as many coordinates, determined by these if those of earlier groups are known."""

    rows: tuple[int, ...]
    unknowns: tuple[int, ...]


@dataclass(frozen=True)
class _Solved:
    """Constraints, the coordinates that they were solved for, and the size of the constraints' terms there."""

    rows: Sequence[int]
    unknowns: Sequence[int]
    terms: Floats

    @classmethod
    def all_of(cls, chart: _Chart, dependent: Floats) -> _Solved:
        """All constraints, solved for all dependent coordinates."""
        terms = chart.loops.scale(chart.loops.coordinates(dependent))
        return cls(range(len(terms)), range(len(dependent)), terms)


def _groups(chart: _Chart, generator: np.random.Generator) -> tuple[list[_Group], list[int]]:
    """The groups in the order of their solution, and the coordinates that are in none."""
    groups: list[_Group] = []
    unknown = set(range(chart.loops.n_dependent))
    rows = list(range(len(chart.held)))

    def next_group() -> _Group | None:
        for size in (1, 2):
            for chosen in combinations(rows, size):
                held = [j for j in sorted(unknown) if chart.held[list(chosen), j].any()]
                if len(held) == size:
                    group = _Group(chosen, tuple(held))
                    anywhere = generator.uniform(-np.pi, np.pi, chart.loops.n_dependent) * chart.scales
                    # Redundant constraints have infinitely many common roots everywhere.
                    if _candidates(chart, group, _polynomials(chart, group, anywhere)) is not None:
                        return group
        return None

    while unknown and (group := next_group()) is not None:
        groups.append(group)
        unknown -= set(group.unknowns)
        rows = [row for row in rows if row not in group.rows]
    return groups, sorted(unknown)


def _polynomials(chart: _Chart, group: _Group, dependent: Floats) -> list[Polynomial] | None:
    """The group's constraints as polynomials in its unknowns; None if they are no polynomials."""
    names = chart.names
    known = {("q", names[j]): float(dependent[j]) for j in range(len(names)) if j not in group.unknowns}
    unknowns = [(names[j], bool(chart.is_angle[j])) for j in group.unknowns]
    return chart.constraints.with_values(known).polynomials(group.rows, unknowns)


def _candidates(chart: _Chart, group: _Group, polynomials: list[Polynomial] | None) -> list[tuple[float, ...]] | None:
    """Values of the group's unknowns that may be a common root; None if there may be infinitely many."""
    is_angle = [bool(chart.is_angle[j]) for j in group.unknowns]
    return None if polynomials is None else real_roots(polynomials, is_angle)


def _roots(chart: _Chart, group: _Group, dependent: Floats) -> list[Floats] | None:
    """The dependent coordinates with each solution for a group's unknowns; None if solutions are not isolated."""
    loops, rows, columns = chart.loops, list(group.rows), list(group.unknowns)
    polynomials = _polynomials(chart, group, dependent)
    candidates = _candidates(chart, group, polynomials)
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
        at = [1.0 if chart.is_angle[j] else abs(value) for j, value in zip(columns, candidate, strict=True)]
        terms = np.abs(slopes[rows]) @ np.abs(q) + [terms_of(polynomial, at) for polynomial in polynomials]
        if (np.abs(error[rows]) <= ROUNDING * np.maximum(terms, loops.scale(q)[rows])).all():
            chart.add(point, found, _Solved(rows, columns, terms))
    return found


def _is_exact(loops: Loops, dependent: Floats) -> bool:
    """Whether it satisfies the constraints as well as a mode does."""
    return bool((np.abs(loops.residual(dependent)) <= ROUNDING * loops.scale(loops.coordinates(dependent))).all())


def _is_dead(loops: Loops, group: _Group, dependent: Floats) -> bool:
    """Whether the configuration is singular or nearly so for a group: two of its solutions meet."""
    slopes = loops.jacobian(dependent)[np.ix_(group.rows, group.unknowns)]
    sizes = np.linalg.svd(slopes, compute_uv=False)
    return bool(sizes[-1] <= DEAD * sizes[0])


def _free(chart: _Chart, dependent: Floats) -> NDArray[np.bool_]:
    """Which coordinates change along curves of solutions through one; none if it is isolated.

    Tangents of such curves are null vectors of the Jacobian, so any basis of these has one that is not normal to the
    tangent. Redundant constraints make rows dependent, not columns.
    """
    free = np.zeros(len(dependent), dtype=bool)
    scales = np.where(chart.is_angle, 1.0, np.maximum(chart.scales, np.abs(dependent)))
    slopes = chart.loops.jacobian(dependent) * scales
    if not np.isfinite(slopes).all():
        return free
    directions = null_space(slopes / row_sizes(slopes), DEAD).T
    for direction in [*directions, *-directions]:
        moved = _moved(chart.loops, dependent, scales, direction)
        if moved is not None:
            free |= np.abs(moved) > DISTINCT
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
            if abs(off) <= DISTINCT and _is_exact(loops, dependent + scales * moved):
                break
            size = row_sizes(slopes * scales)
            rows, gaps = np.vstack((slopes * scales / size, direction)), np.append(error / size[:, 0], off)
            moved = moved - np.linalg.lstsq(rows, gaps, rcond=SINGULAR)[0]
        else:
            return None
        if np.linalg.norm(moved) > 2.0 * step:
            return None
    return moved


def _starting_points(
    chart: _Chart, partial: list[Floats], rest: Sequence[int], start: Floats, generator: np.random.Generator
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
    chart: _Chart,
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
        if in_vain >= max(WITHOUT_NEWS, 2 * len(partial)) or len(found) >= MAX_MODES:
            break
    return found, free
