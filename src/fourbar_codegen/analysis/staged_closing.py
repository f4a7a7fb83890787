"""Loops closed one after another, in a block triangular form.

A rider on a bicycle has a loop for each arm and leg, which depend on the bicycle's pitch but not on each other. From a
poor guess, one such loop often converges, but all together rarely do. Constraints and the coordinates in them form a
bipartite graph. A maximum matching assigns a constraint to each coordinate; the strongly connected components of the
matched graph are the blocks of a block triangular form (A. L. Dulmage, N. S. Mendelsohn, "Coverings of bipartite
graphs", Canadian Journal of Mathematics 10, 1958). If there is no perfect matching, for example with redundant
constraints, the connected components are solved separately.

Each block is solved by damped least squares within the coordinates' bounds (SciPy's ``least_squares``: M. A. Branch,
T. F. Coleman, Y. Li, SIAM Journal on Scientific Computing 21, 1999), from the guess and, if that fails, from others
about it. The solution nearest to the guess is returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from graphlib import TopologicalSorter

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import PERIOD_RTOL, TURN, Loops

__all__ = ["OpenLoop", "close_in_stages", "stages", "turned_towards"]

Floats = NDArray[np.float64]

N_POINTS = 4
"""Random configurations at which the Jacobian is evaluated to find its structure."""


@dataclass(frozen=True)
class OpenLoop:
    """Constraints that were not closed.

    Attributes
    ----------
    rows, columns : tuple of int
        The position constraints, and the dependent coordinates that were to close them.
    residual : ndarray
        The smallest residual that was found.
    """

    rows: tuple[int, ...]
    columns: tuple[int, ...]
    residual: Floats


def stages(incidence: NDArray[np.bool_]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Rows and columns of blocks, each of which contains only columns of its own and of earlier blocks.

    Parameters
    ----------
    incidence : ndarray of bool, shape (n_h, n)
        Which constraint contains which coordinate.

    Examples
    --------
    >>> import numpy as np
    >>> stages(np.array([[True, True, False], [False, True, False], [False, True, True]]))
    [((1,), (1,)), ((0,), (0,)), ((2,), (2,))]
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

    n_h, n = incidence.shape
    matched = maximum_bipartite_matching(csr_array(incidence), perm_type="column")
    if n_h != n or (matched < 0).any():
        both = np.block([[np.zeros((n_h, n_h), dtype=bool), incidence], [incidence.T, np.zeros((n, n), dtype=bool)]])
        count, labels = connected_components(csr_array(both), directed=False)
        parts = [(np.flatnonzero(labels[:n_h] == k), np.flatnonzero(labels[n_h:] == k)) for k in range(count)]
        return [(_numbers(rows), _numbers(columns)) for rows, columns in parts if len(rows)]
    # Row i depends on row j if it contains the coordinate that is matched to j.
    needs = incidence[:, matched]
    count, labels = connected_components(csr_array(needs), directed=True, connection="strong")
    order = TopologicalSorter({k: set() for k in range(count)})
    for i, j in np.argwhere(needs):
        if labels[i] != labels[j]:
            order.add(labels[i], labels[j])
    blocks = [np.flatnonzero(labels == k) for k in order.static_order()]
    return [(_numbers(rows), _numbers(np.sort(matched[rows]))) for rows in blocks]


def close_in_stages(
    loops: Loops, start: Floats, further: int, bounds: tuple[Floats, Floats] | None = None
) -> tuple[Floats, list[OpenLoop]]:
    """Dependent coordinates with all loops closed that can be closed.

    Parameters
    ----------
    loops : Loops
    start : ndarray
        The guess.
    further : int
        How many other guesses are tried for each block.
    bounds : (ndarray, ndarray), optional
        The smallest and the largest value of each dependent coordinate.

    Returns
    -------
    dependent : ndarray
    open_loops : list of OpenLoop
        Those that were not closed.
    """
    generator = np.random.default_rng(0)
    slopes = [loops.position(start + generator.uniform(-1.0, 1.0, len(start)))[1] for _ in range(N_POINTS)]
    incidence = np.any([matrix != 0.0 for matrix in slopes], axis=0)
    lower, upper = bounds if bounds else (np.full(len(start), -np.inf), np.full(len(start), np.inf))
    dependent, open_loops = np.clip(start, lower, upper), []
    for rows, columns in stages(incidence):
        block = _Block(loops, dependent, list(rows), list(columns), lower[list(columns)], upper[list(columns)])
        closed, residual = block.solve(further, generator)
        dependent[block.columns] = closed
        if residual is not None:
            open_loops.append(OpenLoop(rows, columns, residual))
    return dependent, open_loops


def turned_towards(loops: Loops, dependent: Floats, guess: Floats) -> Floats:
    """The same configuration, with angles turned towards a guess by multiples of one or two turns.

    Two turns are the period of angles that enter the constraints as half angles.
    """
    far = np.flatnonzero(np.abs(dependent - guess) > np.pi)
    if not len(far):
        return dependent
    result = dependent.copy()
    known = np.column_stack(loops.position(result))
    for column in far:
        for period in (TURN, 2.0 * TURN):
            before = result[column]
            result[column] -= period * np.round((before - guess[column]) / period)
            if np.allclose(np.column_stack(loops.position(result)), known, rtol=PERIOD_RTOL, atol=PERIOD_RTOL):
                break
            result[column] = before
    return result


@dataclass(frozen=True)
class _Block:
    """Constraints, and the coordinates that they are solved for; the others are fixed."""

    loops: Loops
    dependent: Floats
    rows: list[int]
    columns: list[int]
    lower: Floats
    upper: Floats

    def solve(self, further: int, generator: np.random.Generator) -> tuple[Floats, Floats | None]:
        """The solution nearest to the present coordinates; the residual if it is not closed, else None."""
        begin = self.dependent[self.columns]
        found = [self._end(begin)]
        if not self._is_closed(found[0]):
            low, high = np.maximum(self.lower, begin - np.pi), np.minimum(self.upper, begin + np.pi)
            found += [self._end(generator.uniform(low, high)) for _ in range(further)]
        closed = [some for some in found if self._is_closed(some)]
        if closed:
            return min(closed, key=lambda some: float(np.abs(some - begin).max())), None
        residuals = [self._position(some)[0] for some in found]
        best = int(np.argmin([np.abs(residual).max() for residual in residuals]))
        return found[best], residuals[best]

    def _full(self, some: Floats) -> Floats:
        full = self.dependent.copy()
        full[self.columns] = some
        return full

    def _position(self, some: Floats) -> tuple[Floats, Floats]:
        error, slopes = self.loops.position(self._full(some))
        return error[self.rows], slopes[np.ix_(self.rows, self.columns)]

    def _end(self, begin: Floats) -> Floats:
        """The last iterate of the least squares from a start, with angles turned towards the guess."""
        from scipy.optimize import least_squares

        error, slopes = self._position(begin)
        if not self.columns or not (np.isfinite(error).all() and np.isfinite(slopes).all()):
            return begin
        found = least_squares(
            lambda some: self._position(some)[0],
            begin,
            jac=lambda some: self._position(some)[1],
            bounds=(self.lower, self.upper),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        ).x
        turned = turned_towards(self.loops, self._full(found), self.dependent)[self.columns]
        return np.where((turned >= self.lower) & (turned <= self.upper), turned, found)

    def _is_closed(self, some: Floats) -> bool:
        return bool(self.loops.hold(self._full(some))[self.rows].all())


def _numbers(values: NDArray[np.integer]) -> tuple[int, ...]:
    return tuple(int(value) for value in values)
