"""Assembly modes: all the ways in which the loops close for given independent coordinates.

Where one or two constraints hold no more unknown coordinates than that, as in the loops of dyads (four-bar linkage,
slider-crank, and all that is composed of them), all solutions are found: the constraints are polynomials in
exp(i angle) and in displacements, sampled from the compiled residuals, and the roots of their resultant are all there
are. What is left, if anything, is searched from many beginnings, which finds a lower bound.

Source: dyads are solved in the order in which they hang on each other as Assur groups of the second class (J. M.
McCarthy and G. S. Soh, *Geometric Design of Linkages*, 2nd ed., 2011, chapter 2, has the four-bar's two modes); two
polynomials by Sylvester's resultant (D. Cox, J. Little, D. O'Shea, *Ideals, Varieties, and Algorithms*, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, overload

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.initial import Loops

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fourbar_codegen.compiled import CompiledModel

__all__ = ["AssemblyModes", "closed_coordinates"]

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

HIGHEST = 4
POWERS = 2 * HIGHEST + 1
"""Constraints are taken for polynomials with harmonics of an angle up to HIGHEST, and so many powers of a displacement;
whether that holds is tested."""

NEGLIGIBLE = 1e-11
"""Coefficients below this share of the largest are rounding errors of the sampling."""

SAME = 1e-9
"""By this share of the largest value two evaluations of the constraints may differ that are to be equal."""

NEAR = 0.02
"""A root counts as real if it is so by this share: a root of multiplicity 4 is wrong by eps^(1/4), 1e-4. Newton's
method decides then."""

DISTINCT = 1e-6
"""Modes that differ by less are one: a double root, where two modes meet, is found to half of all digits."""

MOST = 1024
"""No more modes than these are made: they multiply with the number of loops."""

WITHOUT_NEWS = 100
"""So many beginnings in a row that lead to nothing new end a search."""

MOST_BEGINNINGS = 3000


@dataclass(frozen=True, eq=False)
class AssemblyModes(Sequence[Floats]):
    """The ways in which the loops close for the same independent coordinates and speeds.

    Made by `CompiledModel.initial_states`: a sequence of states, ordered by their dependent coordinates, angles between
    -pi and pi.

    Attributes
    ----------
    model : CompiledModel
    t : float
        Time, s.
    x : ndarray, shape (n, n_x)
        The states. Dependent speeds are NaN in a mode in which they do not follow from the independent ones.
    is_complete : bool
        Whether there are no others. Otherwise their number is a lower bound.
    parameters, inputs : ndarray or None
        As they were given, in order.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> modes = fb.load("four_bar").initial_states({"q1": -0.5}, {"u1": -0.1})
    >>> modes
    <AssemblyModes of four_bar: 2, and no others>
    >>> modes.x.round(6).tolist()[0]
    [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
    """

    model: CompiledModel
    t: float
    x: Floats
    is_complete: bool
    parameters: Floats | None = field(repr=False)
    inputs: Floats | None = field(repr=False)

    @overload
    def __getitem__(self, index: int) -> Floats: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Floats]: ...
    def __getitem__(self, index: int | slice) -> Floats | Sequence[Floats]:
        """The state, or the states, of modes by number."""
        return self.x[index]

    def __len__(self) -> int:
        """The number of modes."""
        return len(self.x)

    def __repr__(self) -> str:
        return f"<AssemblyModes of {self.model.name}: {self._number()}>"

    def _number(self) -> str:
        if not len(self):
            return "the loops cannot be closed" if self.is_complete else "none found"
        return f"{len(self)}, and no others" if self.is_complete else f"at least {len(self)}"

    def _repr_html_(self) -> str:
        from fourbar_codegen.tables import table

        rows = [(f"{i}", *(f"{value:.6g}" for value in x)) for i, x in enumerate(self.x)]
        return table(f"Assembly modes of {self.model.name}: {self._number()}", ("mode", *self.model.states), rows)

    def plot(self) -> Figure:
        """Draw the mechanism in each of its modes; needs the extra ``visual``.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ModelError
            If there is nothing to draw, or Matplotlib is not installed.
        """
        from fourbar_codegen.visual import plot_modes

        return plot_modes(self)


def closed_coordinates(loops: Loops, start: Floats) -> tuple[list[Floats], bool]:
    """All values of the dependent coordinates that are found to close the loops, and whether there are no others.

    Parameters
    ----------
    loops : Loops
    start : ndarray, shape (n_h,)
        Around which displacements are tried, where beginnings have to be.

    Returns
    -------
    list of ndarray
        In ascending order, angles between -pi and pi.
    bool
    """
    generator = np.random.default_rng(0)
    chart = _Chart.of(loops, generator)
    groups, rest = _groups(chart, generator)
    partial = [np.zeros(len(start))]
    complete = True
    for group in groups:
        extended: list[Floats] = []
        for dependent in partial:
            roots = _roots(chart, group, dependent)
            if roots is None:  # of infinitely many ways, or at the edge of that
                complete, rest = False, [*rest, *group.unknowns]
                roots = [dependent]
            extended += roots
        complete &= len(extended) <= MOST
        partial = extended[:MOST]
    if rest and partial:
        complete = False
        found = _search(chart, partial, rest, start, generator)
    else:
        found = [dependent for dependent in partial if loops.are_closed(dependent)]
    return sorted(found, key=lambda dependent: tuple(np.round(dependent / chart.scales, 6))), complete


@dataclass(frozen=True)
class _Chart:
    """The loops with what is known of their dependent coordinates.

    Attributes
    ----------
    loops : Loops
    pattern : ndarray of bool, shape (n_h, n)
        Which constraint holds which coordinate.
    is_angle : ndarray of bool, shape (n,)
        Whether nothing changes with it by 2 pi.
    scales : ndarray, shape (n,)
        What is a usual value: 1 of angles, and of displacements what it takes to close a loop.
    """

    loops: Loops
    pattern: NDArray[np.bool_]
    is_angle: NDArray[np.bool_]
    scales: Floats

    @classmethod
    def of(cls, loops: Loops, generator: np.random.Generator) -> _Chart:
        """Found by evaluating the constraints at random coordinates."""
        n = loops.n_dependent
        points = generator.uniform(-np.pi, np.pi, (4, n))
        errors, slopes = (np.array(values) for values in zip(*map(loops.position, points), strict=True))
        turned = np.abs([[loops.residual(point + turn) for turn in 2 * np.pi * np.eye(n)] - error
                         for point, error in zip(points, errors, strict=True)])  # fmt: skip
        sizes = np.abs(slopes).max(axis=0)
        is_angle = (turned.max(axis=0) <= SAME * np.abs(errors).max(axis=0)).all(axis=1)
        at_zero = np.where(is_angle, points, 0.0)
        gaps, rates = (np.abs(values) for values in zip(*map(loops.position, at_zero), strict=True))
        reach = np.median(np.max(gaps, axis=1)[:, None] / np.maximum(np.max(rates, axis=1), 1e-300), axis=0)
        scales = np.where(is_angle | ~((reach > 0.0) & (reach < 1e100)), 1.0, reach)
        return cls(loops, sizes > NEGLIGIBLE * sizes.max(initial=0.0), is_angle, scales)

    def wrapped(self, dependent: Floats) -> Floats:
        """With angles between -pi and pi, where -pi is pi."""
        turns = np.ceil((dependent - np.pi) / (2 * np.pi) - DISTINCT)
        return np.where(self.is_angle, dependent - 2 * np.pi * turns, dependent)

    def add(self, dependent: Floats, found: list[Floats]) -> bool:
        """Append it unless it is there already."""
        for other in found:
            difference = dependent - other
            turns = np.where(self.is_angle, np.round(difference / (2 * np.pi)), 0.0)
            if np.abs((difference - 2 * np.pi * turns) / self.scales).max() < DISTINCT:
                return False
        found.append(self.wrapped(dependent))
        return True


@dataclass(frozen=True)
class _Group:
    """One or two constraints and as many coordinates that they determine once those of earlier groups are known."""

    rows: tuple[int, ...]
    unknowns: tuple[int, ...]


def _groups(chart: _Chart, generator: np.random.Generator) -> tuple[list[_Group], list[int]]:
    """The groups in the order of their solution, and the coordinates that are in none."""
    groups: list[_Group] = []
    unknown = set(range(chart.loops.n_dependent))
    rows = list(range(len(chart.pattern)))

    def next_group() -> _Group | None:
        for size in (1, 2):
            for chosen in combinations(rows, size):
                held = [j for j in sorted(unknown) if chart.pattern[list(chosen), j].any()]
                group = _Group(chosen, tuple(held))
                if len(held) == size:
                    anywhere = generator.uniform(-np.pi, np.pi, chart.loops.n_dependent) * chart.scales
                    polynomials = _polynomials(chart, group, anywhere)
                    if (
                        _are_polynomials(chart, group, anywhere, polynomials, generator)
                        and _candidates(chart, group, polynomials) is not None
                    ):
                        return group
        return None

    while unknown and (group := next_group()) is not None:
        groups.append(group)
        unknown -= set(group.unknowns)
        rows = [row for row in rows if row not in group.rows]
    return groups, sorted(unknown)


def _samples(chart: _Chart, j: int) -> Floats:
    """Values of a coordinate at which constraints are evaluated: equal steps of an angle, Chebyshev's points."""
    equal: Floats = 2 * np.pi * np.arange(POWERS) / POWERS
    return equal if chart.is_angle[j] else chart.scales[j] * np.cos(np.pi * (np.arange(POWERS) + 0.5) / POWERS)


def _powers(chart: _Chart, j: int, x: float | Floats) -> Complex:
    """exp(i k x) for an angle, k from -HIGHEST on, or powers of a displacement in units of its scale, from 0 on."""
    x = np.asarray(x)[..., None]
    k = np.arange(POWERS)
    powers: Complex = (
        np.exp(1j * (k - HIGHEST) * x) if chart.is_angle[j] else (x / chart.scales[j]) ** k.astype(complex)
    )
    return powers


def _polynomials(chart: _Chart, group: _Group, dependent: Floats) -> list[Complex]:
    """The coefficients of the group's constraints as polynomials in its unknowns, by the powers of each."""
    unknowns = list(group.unknowns)
    grid = np.meshgrid(*(_samples(chart, j) for j in unknowns), indexing="ij")
    points = np.tile(dependent, (grid[0].size, 1))
    points[:, unknowns] = np.stack([axis.ravel() for axis in grid], axis=1)
    values = np.array([chart.loops.residual(point)[list(group.rows)] for point in points])
    polynomials = []
    for row in values.T:
        coefficients = row.reshape(grid[0].shape).astype(complex)
        for j in unknowns:  # each contraction puts the powers of its coordinate last
            inverse = np.linalg.inv(_powers(chart, j, _samples(chart, j)))
            coefficients = np.tensordot(coefficients, inverse, axes=(0, 1))
        coefficients[np.abs(coefficients) <= NEGLIGIBLE * np.abs(coefficients).max()] = 0.0
        polynomials.append(coefficients)
    return polynomials


def _are_polynomials(
    chart: _Chart, group: _Group, dependent: Floats, polynomials: list[Complex], generator: np.random.Generator
) -> bool:
    """Whether the constraints are these polynomials, at random values of the unknowns as well."""
    unknowns = list(group.unknowns)
    reach = np.where(chart.is_angle, np.pi, chart.scales)[unknowns]
    for _ in range(8):
        point = dependent.copy()
        point[unknowns] = generator.uniform(-1.0, 1.0, len(unknowns)) * reach
        for polynomial, exact in zip(polynomials, chart.loops.residual(point)[list(group.rows)], strict=True):
            value = polynomial
            for j in unknowns:
                value = np.tensordot(_powers(chart, j, point[j]), value, axes=(0, 0))
            if not abs(value - exact) <= SAME * np.abs(polynomial).sum():
                return False
    return True


def _candidates(chart: _Chart, group: _Group, polynomials: list[Complex]) -> list[Floats] | None:
    """Values of the group's unknowns close to which a solution may be; None if there may be infinitely many."""
    if len(group.unknowns) == 1:
        [j], [polynomial] = group.unknowns, polynomials
        return [np.array([x]) for x in _real_roots(chart, j, polynomial)] if polynomial.any() else None
    first, second = group.unknowns
    swapped = not chart.is_angle[first] and bool(chart.is_angle[second])
    if swapped:  # the resultant is one in the other unknown: roots on a circle are better known
        first, second = second, first
        polynomials = [polynomial.T for polynomial in polynomials]
    resultant = _resultant([_stripped(polynomial, axis=1) for polynomial in polynomials])
    if resultant is None:
        return None
    found = []
    for x in _real_roots(chart, first, resultant):
        lines = [_powers(chart, first, x) @ polynomial for polynomial in polynomials]
        sizes = [np.abs(polynomial).max() for polynomial in polynomials]
        if all(np.abs(line).max() <= DISTINCT * size for line, size in zip(lines, sizes, strict=True)):
            return None
        others = [y for line, size in zip(lines, sizes, strict=True) if np.abs(line).max() > DISTINCT * size
                  for y in _real_roots(chart, second, line)]  # fmt: skip
        found += [np.array([y, x] if swapped else [x, y]) for y in others]
    return found


def _stripped(polynomial: Complex, axis: int) -> Complex:
    """Without the lowest and highest powers whose coefficients are zero."""
    other = np.abs(polynomial).max(axis=1 - axis)
    [held] = np.nonzero(other)
    return polynomial.take(range(held[0], held[-1] + 1), axis=axis) if len(held) else polynomial[:, :1]


def _resultant(polynomials: list[Complex]) -> Complex | None:
    """The coefficients of the resultant, a polynomial in the first unknown; None if it vanishes.

    The determinant of Sylvester's matrix, evaluated at roots of unity.
    """
    f, g = polynomials
    m, k = f.shape[1] - 1, g.shape[1] - 1
    if m + k == 0:
        return None
    n = len(f) * (m + k) + 1
    z = np.exp(2j * np.pi * np.arange(n) / n)[:, None] ** np.arange(len(f))
    sylvester = np.zeros((n, m + k, m + k), dtype=complex)
    for row in range(k):
        sylvester[:, row, row : row + m + 1] = z @ f
    for row in range(m):
        sylvester[:, k + row, row : row + k + 1] = z @ g
    values = np.linalg.det(sylvester)
    largest = np.prod(np.linalg.norm(sylvester, axis=2), axis=1).max()  # Hadamard's bound
    if not np.abs(values).max() > NEGLIGIBLE * largest:
        return None
    coefficients: Complex = np.fft.fft(values) / n
    coefficients[np.abs(coefficients) <= NEGLIGIBLE * np.abs(coefficients).max()] = 0.0
    return coefficients


def _real_roots(chart: _Chart, j: int, coefficients: Complex) -> list[float]:
    """The roots that stand for a real angle or displacement, of a polynomial with its lowest power first."""
    roots = np.roots(coefficients[::-1])
    if chart.is_angle[j]:
        return list(np.angle(roots[np.abs(np.abs(roots) - 1.0) <= NEAR]))
    return list(chart.scales[j] * roots.real[np.abs(roots.imag) <= NEAR * np.maximum(np.abs(roots), 1.0)])


def _roots(chart: _Chart, group: _Group, dependent: Floats) -> list[Floats] | None:
    """The dependent coordinates with each of the solutions for a group's unknowns; None if they are not isolated."""
    candidates = _candidates(chart, group, _polynomials(chart, group, dependent))
    if candidates is None:
        return None
    rows, unknowns = list(group.rows), list(group.unknowns)
    found: list[Floats] = []
    for candidate in candidates:
        point = dependent.copy()
        point[unknowns] = candidate
        for _ in range(30):  # at a double root each step halves the error
            error, slopes = chart.loops.position(point)
            step = np.linalg.lstsq(slopes[np.ix_(rows, unknowns)], -error[rows], rcond=1e-14)[0]
            point[unknowns] += step
            if np.abs(step / chart.scales[unknowns]).max() <= 1e-15:
                break
        if np.isfinite(point).all() and chart.loops.are_closed(point, rows):
            chart.add(point, found)
    return found


def _search(
    chart: _Chart, partial: list[Floats], rest: Sequence[int], start: Floats, generator: np.random.Generator
) -> list[Floats]:
    """Solutions from many beginnings: what is known of the coordinates, and others at random."""
    found: list[Floats] = []
    others = list(rest)

    def beginnings() -> Iterator[Floats]:
        yield start
        for number in range(MOST_BEGINNINGS):
            begin = partial[number % len(partial)].copy()
            begin[others] = np.where(chart.is_angle, 0.0, start)[others] + chart.scales[others] * generator.uniform(
                -np.pi, np.pi, len(others)
            )
            yield begin

    in_vain = 0
    for begin in beginnings():
        dependent = chart.loops.search(begin)
        news = dependent is not None and chart.add(dependent, found)
        in_vain = 0 if news else in_vain + 1
        if in_vain >= max(WITHOUT_NEWS, 2 * len(partial)) or len(found) >= MOST:
            break
    return found
