"""Assembly modes: all the ways in which the loops close for given independent coordinates.

Where one or two constraints hold no more unknown coordinates than that, as in the loops of dyads (four-bar linkage,
slider-crank, and all that is composed of them), and are polynomials in exp(i angle) and in displacements, all solutions
are found: their degrees are known from the equations, their coefficients from as many compiled residuals, and the roots
of their resultant are all there are. What is left, if anything, is searched from many beginnings, which finds a lower
bound.

Source: dyads are solved in the order in which they hang on each other as Assur groups of the second class (J. M.
McCarthy and G. S. Soh, *Geometric Design of Linkages*, 2nd ed., 2011, chapter 2, has the four-bar's two modes); two
polynomials by Sylvester's resultant (D. Cox, J. Little, D. O'Shea, *Ideals, Varieties, and Algorithms*, chapter 3).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.initial import Loops

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fourbar_codegen.compiled import CompiledModel
    from fourbar_codegen.progress import Progress

__all__ = ["AssemblyModes", "closed_coordinates"]

Floats = NDArray[np.float64]
Complex = NDArray[np.complex128]

HIGHEST_HARMONIC = 4
HIGHEST_POWER = 8
"""Roots of polynomials of higher degree are too sensitive to their coefficients to be called all there are."""

ROUNDING = 1e-13
"""The share of its terms to which a constraint is satisfied in a mode, and below which a coefficient is nothing."""

NEAR = 0.02
"""A root counts as real if it is so by this share: a root of multiplicity 4 is wrong by eps^(1/4), 1e-4. Newton's
method decides then."""

DISTINCT = 1e-5
"""Modes that differ by less are one. Where two meet, constraints are satisfied to ROUNDING within its root, 3e-7."""

FLAT = 1e-6
"""Polynomials, the largest of whose coefficients is 1, vanish along a line where they are less than this on it."""

VANISHING = 1e-11
"""Resultants below this share of what they could be are rounding errors."""

SMALLEST, LARGEST = 1e-100, 1e100
"""Between these, units of displacements are sought."""

DEAD = 1e-5
"""Where singular values of a group's slopes have this ratio, two modes meet, or are not known to more digits."""

MOST = 1024
"""No more modes than these are made: they multiply with the number of loops."""

WITHOUT_NEWS = 100
"""So many beginnings in a row that lead to nothing new end a search."""

MOST_BEGINNINGS = 3000


@dataclass(frozen=True, eq=False)
class AssemblyModes:
    """The ways in which the loops close for the same independent coordinates and speeds.

    Made by `CompiledModel.initial_states`: it has a length, and states by number, ordered by their dependent
    coordinates, angles between -pi and pi.

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
    >>> modes[0].round(6).tolist()
    [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
    """

    model: CompiledModel
    t: float
    x: Floats
    is_complete: bool
    parameters: Floats | None
    inputs: Floats | None

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
        return f"{len(self)}, and no others" if self.is_complete else f"at least {len(self)}"

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
        from fourbar_codegen.visual import plot_modes

        return plot_modes(self)


def closed_coordinates(loops: Loops, start: Floats, progress: Progress) -> tuple[list[Floats], bool]:
    """All values of the dependent coordinates that are found to close the loops, and whether there are no others.

    Parameters
    ----------
    loops : Loops
    start : ndarray, shape (n,)
        Around which displacements are tried, where beginnings have to be.
    progress : Progress
        Is told how many there are so far.

    Returns
    -------
    list of ndarray
        In ascending order, angles between -pi and pi.
    bool
    """
    generator = np.random.default_rng(0)
    loops = _turned_back(loops)
    chart = _Chart.of(loops, start, generator)
    groups, rest = _groups(chart, generator)
    partial = [np.zeros(len(start))]
    complete = True
    for number, group in enumerate(groups):
        extended: list[Floats] = []
        for dependent in partial:
            progress.stage(f"{len(extended)} of {', '.join(chart.names[j] for j in group.unknowns)}")
            roots = _roots(chart, group, dependent)
            if roots is None:  # of infinitely many ways, or at the edge of that
                complete, rest = False, [*rest, *group.unknowns]
                roots = [dependent]
            elif not roots and any(_is_dead(loops, before, dependent) for before in groups[:number]):
                complete = False  # what comes before is known to half of all digits
            extended += roots
        complete &= len(extended) <= MOST
        partial = extended[:MOST]
    if rest and partial:
        complete = False
        found = _search(chart, partial, rest, start, generator, progress)
    else:
        found = [dependent for dependent in partial if loops.are_closed(dependent)]
    sizes = np.abs(found).max(axis=0, initial=1e-300) if found else 1.0
    return sorted(found, key=lambda dependent: tuple(np.round(dependent / sizes, 6))), complete


def _turned_back(loops: Loops) -> Loops:
    """With independent angles between -pi and pi: sines of large ones are known to fewer digits."""
    is_angle = _degrees(loops, "is_periodic")[:, : len(loops.q_i)].all(axis=0)
    return replace(loops, q_i=np.where(is_angle, np.remainder(loops.q_i + np.pi, 2 * np.pi) - np.pi, loops.q_i))


def _degrees(loops: Loops, kind: str) -> Floats:
    """What the equations say of each constraint in each coordinate, shape (n_h, n_q): infinite where it has none."""
    rows = loops.model.manifest["position_degrees"]
    return np.array([[np.inf if entry[kind] is None else entry[kind] for entry in row] for row in rows], dtype=float)


@dataclass(frozen=True)
class _Chart:
    """The loops with what is known of their dependent coordinates.

    Attributes
    ----------
    loops : Loops
    held : ndarray of bool, shape (n_h, n)
        Which constraint holds which coordinate.
    degree : ndarray of float, shape (n_h, n)
        The highest harmonic, of an angle, or the highest power; infinite where a constraint is neither.
    is_angle : ndarray of bool, shape (n,)
        Whether nothing changes with it by 2 pi.
    scales : ndarray, shape (n,)
        A usual value: 1 of angles, and of displacements about what it takes to close a loop.
    """

    loops: Loops
    held: NDArray[np.bool_]
    degree: Floats
    is_angle: NDArray[np.bool_]
    scales: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """What the dependent coordinates are called."""
        return self.loops.model.coordinates[-self.loops.n_dependent :]

    @classmethod
    def of(cls, loops: Loops, start: Floats, generator: np.random.Generator) -> _Chart:
        """From what the equations say of their degrees, and the constraints at random coordinates."""
        power, harmonic, periodic = (
            _degrees(loops, kind)[:, len(loops.q_i) :] for kind in ("power", "harmonic", "is_periodic")
        )
        is_angle: NDArray[np.bool_] = np.all(periodic, axis=0)
        degree = np.where(is_angle, harmonic, power)
        points = np.where(is_angle, generator.uniform(-np.pi, np.pi, (4, len(start))), start)
        known = [loops.position(point) for point in points]
        gaps = np.array([np.abs(error).max() for error, _ in known])
        rates = np.array([np.abs(slopes).max(axis=0) for _, slopes in known])
        with np.errstate(all="ignore"):
            reach = np.median(gaps[:, None] / rates, axis=0)
        scales = np.where(is_angle | ~np.isfinite(reach) | (reach == 0.0), 1.0, reach)
        return cls(loops, degree > 0, degree, is_angle, scales)

    def wrapped(self, dependent: Floats) -> Floats:
        """With angles between -pi and pi, where -pi is pi."""
        turns = np.ceil((dependent - np.pi) / (2 * np.pi) - DISTINCT)
        return np.where(self.is_angle, dependent - 2 * np.pi * turns, dependent)

    def add(self, dependent: Floats, found: list[Floats]) -> bool:
        """Append it unless it is there already."""
        for other in found:
            difference = dependent - other
            turns = np.where(self.is_angle, np.round(difference / (2 * np.pi)), 0.0)
            sizes = np.where(self.is_angle, 1.0, np.maximum(np.abs(other), self.scales))
            if np.abs((difference - 2 * np.pi * turns) / sizes).max() < DISTINCT:
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
    rows = list(range(len(chart.held)))
    highest = np.where(chart.is_angle, HIGHEST_HARMONIC, HIGHEST_POWER)
    within = chart.degree <= highest

    def next_group() -> _Group | None:
        for size in (1, 2):
            for chosen in combinations(rows, size):
                held = [j for j in sorted(unknown) if chart.held[list(chosen), j].any()]
                group = _Group(chosen, tuple(held))
                if len(held) == size and within[np.ix_(chosen, held)].all():
                    anywhere = generator.uniform(-np.pi, np.pi, chart.loops.n_dependent) * chart.scales
                    # Redundant constraints have infinitely many common roots wherever they are looked at.
                    if _candidates(*_polynomials(chart, group, anywhere)) is not None:
                        return group
        return None

    while unknown and (group := next_group()) is not None:
        groups.append(group)
        unknown -= set(group.unknowns)
        rows = [row for row in rows if row not in group.rows]
    return groups, sorted(unknown)


@dataclass(frozen=True)
class _Unknown:
    """A coordinate in which constraints are polynomials.

    Attributes
    ----------
    is_angle : bool
    degree : int
        The highest harmonic, or the highest power.
    scale : float
        The unit of a displacement.
    """

    is_angle: bool
    degree: int
    scale: float

    def samples(self) -> Floats:
        """Values at which a polynomial is known altogether: equal steps of an angle, Chebyshev's points."""
        if self.is_angle:
            steps: Floats = 2 * np.pi * np.arange(2 * self.degree + 1) / (2 * self.degree + 1)
            return steps
        nodes: Floats = self.scale * np.cos(np.pi * (np.arange(self.degree + 1) + 0.5) / (self.degree + 1))
        return nodes

    def powers(self, x: float | Floats) -> Complex:
        """exp(i k x) of an angle, k from -degree on, or powers of a displacement in units of its scale, from 0 on."""
        x = np.asarray(x)[..., None]
        k = np.arange(2 * self.degree + 1) - self.degree if self.is_angle else np.arange(self.degree + 1)
        powers: Complex = np.exp(1j * k * x) if self.is_angle else (x / self.scale) ** k.astype(complex)
        return powers

    def real_roots(self, coefficients: Complex) -> list[float]:
        """The roots that stand for a real angle or displacement, of a polynomial with its lowest power first."""
        roots = np.roots(coefficients[::-1])
        if self.is_angle:
            return list(np.angle(roots[np.abs(np.abs(roots) - 1.0) <= NEAR]))
        return list(self.scale * roots.real[np.abs(roots.imag) <= NEAR * np.maximum(np.abs(roots), 1.0)])


def _polynomials(chart: _Chart, group: _Group, dependent: Floats) -> tuple[list[_Unknown], list[Complex]]:
    """The group's constraints as polynomials in its unknowns: their coefficients, by the powers of each.

    Displacements are in units of which the roots are some, by which coefficients are of like size.
    """
    rows = list(group.rows)
    unknowns = [
        _Unknown(bool(chart.is_angle[j]), int(chart.degree[rows, j].max()), chart.scales[j]) for j in group.unknowns
    ]
    for place, unknown in enumerate(unknowns):
        if not unknown.is_angle:
            unknowns[place] = _in_its_scale(chart, group, dependent, unknowns, place)
    return unknowns, _coefficients(chart, group, dependent, unknowns)


def _coefficients(chart: _Chart, group: _Group, dependent: Floats, unknowns: list[_Unknown]) -> list[Complex]:
    """From residuals at all combinations of the unknowns' samples."""
    grid = np.meshgrid(*(unknown.samples() for unknown in unknowns), indexing="ij")
    points = np.tile(dependent, (grid[0].size, 1))
    points[:, list(group.unknowns)] = np.stack([axis.ravel() for axis in grid], axis=1)
    values = np.array([chart.loops.residual(point)[list(group.rows)] for point in points])
    polynomials = []
    for row in values.T:
        coefficients = row.reshape(grid[0].shape).astype(complex)
        for unknown in unknowns:  # each contraction puts the powers of its coordinate last
            inverse = np.linalg.inv(unknown.powers(unknown.samples()))
            with np.errstate(invalid="ignore"):  # where a constraint is infinite
                coefficients = np.tensordot(coefficients, inverse, axes=(0, 1))
        polynomials.append(coefficients)
    return polynomials


def _in_its_scale(chart: _Chart, group: _Group, dependent: Floats, unknowns: list[_Unknown], place: int) -> _Unknown:
    """A displacement with the unit and the degree that its roots have for these values of the others.

    The roots of c_0 + ... + c_d s^d are within twice the largest |c_k / c_d|^(1 / (d - k)) (M. Fujiwara, "Ueber die
    obere Schranke des absoluten Betrages der Wurzeln einer algebraischen Gleichung", *Tohoku Math. J.* 10, 1916). In
    units far from that, the highest or the lowest coefficients are lost in rounding errors, so that it is approached
    in steps. Where the highest coefficient is nothing in any unit, the degree is less.
    """
    unknown, j = unknowns[place], group.unknowns[place]
    while unknown.degree:
        tried = unknown
        for _ in range(16):
            others = [*unknowns[:place], tried, *unknowns[place + 1 :]]
            bounds = []
            for row, polynomial in zip(group.rows, _coefficients(chart, group, dependent, others), strict=True):
                sizes = np.abs(polynomial).max(axis=1 - place) if polynomial.ndim == 2 else np.abs(polynomial)
                d = min(int(chart.degree[row, j]), tried.degree)
                if d and sizes[d] > ROUNDING * sizes.max():
                    bounds.append(float(((sizes[:d] / sizes[d]) ** (1.0 / (d - np.arange(d)))).max()))
            # A root of all is within the least bound. The highest coefficients may stand out in larger units.
            step = (min(bounds) or 1.0) if bounds else 1e4
            if 0.1 <= step <= 10.0:
                return tried
            if not SMALLEST < tried.scale * step < LARGEST:
                break
            tried = replace(tried, scale=tried.scale * step)
        unknown = replace(unknown, degree=unknown.degree - 1)
    return unknown


def _candidates(unknowns: list[_Unknown], polynomials: list[Complex]) -> list[Floats] | None:
    """Values of the unknowns close to which a common root may be; None if there may be infinitely many."""
    if not all(np.isfinite(polynomial).all() for polynomial in polynomials):
        return None
    if len(unknowns) == 1:
        [unknown], [polynomial] = unknowns, polynomials
        return [np.array([x]) for x in unknown.real_roots(polynomial)] if polynomial.any() else None
    first, second = unknowns
    swapped = not first.is_angle and second.is_angle
    if swapped:  # the resultant is one in the other unknown: roots on a circle are better known
        first, second = second, first
        polynomials = [polynomial.T for polynomial in polynomials]
    sizes = [np.abs(polynomial).max() for polynomial in polynomials]
    if not all(sizes):
        return None
    polynomials = [polynomial / size for polynomial, size in zip(polynomials, sizes, strict=True)]
    resultant = _resultant([_stripped(polynomial) for polynomial in polynomials])
    if resultant is None:
        return None
    found = []
    for x in first.real_roots(resultant):
        lines = [first.powers(x) @ polynomial for polynomial in polynomials]
        lines = [line for line in lines if np.abs(line).max() > FLAT]
        if not lines:
            return None
        others = [y for line in lines for y in second.real_roots(line)]
        found += [np.array([y, x] if swapped else [x, y]) for y in others]
    return found


def _stripped(polynomial: Complex) -> Complex:
    """Without the lowest and highest powers of the second unknown whose coefficients are nothing."""
    sizes = np.abs(polynomial).max(axis=0)
    [held] = np.nonzero(sizes > ROUNDING * sizes.max())
    return polynomial[:, held[0] : held[-1] + 1]


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
    if not np.abs(values).max() > VANISHING * largest:
        return None
    coefficients: Complex = np.fft.fft(values) / n
    return coefficients


def _roots(chart: _Chart, group: _Group, dependent: Floats) -> list[Floats] | None:
    """The dependent coordinates with each of the solutions for a group's unknowns; None if they are not isolated."""
    loops, rows, columns = chart.loops, list(group.rows), list(group.unknowns)
    unknowns, polynomials = _polynomials(chart, group, dependent)
    candidates = _candidates(unknowns, polynomials)
    if candidates is None:
        return None
    scales = chart.scales.copy()
    scales[columns] = [unknown.scale for unknown in unknowns]
    chart = replace(chart, scales=scales)
    found: list[Floats] = []
    for candidate in candidates:
        point = dependent.copy()
        point[columns] = candidate
        for _ in range(40):  # at a double root each step halves the error
            error, slopes = loops.position(point)
            step = np.linalg.lstsq(slopes[np.ix_(rows, columns)], -error[rows], rcond=1e-15)[0]
            point[columns] += step
            if not np.abs(step / scales[columns]).max() > 1e-16:
                break
        # What the terms of a constraint are: those of the polynomial, and those that its coefficients consist of.
        error, slopes = loops.model.position(loops.t, loops.coordinates(point), loops.p, loops.r)
        sizes = np.concatenate((np.abs(loops.q_i), np.where(chart.is_angle, 1.0, np.maximum(np.abs(point), scales))))
        terms = np.abs(slopes[rows]) @ sizes
        for place, polynomial in enumerate(polynomials):
            of_polynomial = np.abs(polynomial)
            for unknown, x in zip(unknowns, point[columns], strict=True):
                of_polynomial = np.tensordot(np.abs(unknown.powers(x)), of_polynomial, axes=(0, 0))
            terms[place] += of_polynomial
        if (np.abs(error[rows]) <= ROUNDING * terms).all():
            chart.add(point, found)
    return found


def _is_dead(loops: Loops, group: _Group, dependent: Floats) -> bool:
    """Whether two solutions of a group meet there, or nearly."""
    slopes = loops.jacobian(dependent)[np.ix_(group.rows, group.unknowns)]
    sizes = np.linalg.svd(slopes, compute_uv=False)
    return bool(sizes[-1] <= DEAD * sizes[0])


def _search(
    chart: _Chart,
    partial: list[Floats],
    rest: Sequence[int],
    start: Floats,
    generator: np.random.Generator,
    progress: Progress,
) -> list[Floats]:
    """Solutions from many beginnings: what is known of the coordinates, and others at random."""
    found: list[Floats] = []
    others = list(rest)

    def beginnings() -> Iterator[Floats]:
        yield start
        for number in range(MOST_BEGINNINGS):
            begin = partial[number % len(partial)].copy()
            reach = chart.scales * np.where(chart.is_angle, 1.0, 10.0 ** generator.uniform(-1.0, 1.0))
            middle = np.where(chart.is_angle, 0.0, start)
            begin[others] = (middle + reach * generator.uniform(-np.pi, np.pi, len(start)))[others]
            yield begin

    in_vain = 0
    for begin in beginnings():
        progress.stage(f"{len(found)} found")
        dependent = chart.loops.search(begin)
        news = dependent is not None and chart.add(dependent, found)
        in_vain = 0 if news else in_vain + 1
        if in_vain >= max(WITHOUT_NEWS, 2 * len(partial)) or len(found) >= MOST:
            break
    return found
