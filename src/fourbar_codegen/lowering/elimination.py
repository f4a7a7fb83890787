"""Elimination orders for M u' = f + J^T lambda, J u' + gamma = 0: sparse, and of dense constraints.

With a weight w > 0 for each constraint, u' and lambda solve

    [M + J^T w J   J^T] [  u'   ]   [f - J^T w gamma]
    [     J         0 ] [-lambda] = [    -gamma     ]

The upper left block is positive definite wherever the equations determine u', even if M is singular. So Gaussian
elimination needs no pivoting if each constraint comes after all speeds in it: its pivot is negative as long as the
constraints are independent. If it comes after some of them, that holds as long as constraints are independent with
these speeds alone; where they are not, dense equations are solved. The order is chosen once, at code generation, by
minimum degree. The number of operations for a row of loops, or of loops on one crank, is linear in their number.

Source: the augmented Lagrangian for saddle point systems, Benzi, Golub and Liesen, "Numerical solution of saddle point
problems", *Acta Numerica* 14 (2005), section 3.5; minimum degree, Davis, *Direct Methods for Sparse Linear Systems*,
2006, chapter 7.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence

from fourbar_codegen.lowering.program import Entries, PivotOrder, Structure
from fourbar_codegen.runtime.enumerations import Threshold

__all__ = ["MAX_CONSTRAINTS", "find_pivot_order", "find_structure", "recursive_cost", "solution_cost"]

Matrix = Sequence[Sequence[float]]

MIN_SPEEDS = 8
MAX_CONSTRAINTS = 24
"""Most constraints of dense equations for which a pivot order is fixed at code generation. Batches of states need it;
linear_algebra/dense_equations.h uses it for fewer."""

NOISE_RTOL = 1e-9
"""Rows below this fraction of their size before are rounding errors of redundant ones."""

MIN_PIVOT_RATIO = 1e-12
"""Ratio of a pivot to the largest entry of its row below which it is only rounding errors."""

MIN_SPARSE_GAIN = 4
"""Sparse elimination must need this many times fewer multiplications, since it looks up indices."""

MIN_EARLY_GAIN = 2
"""An order in which constraints come before some of their speeds must take this many times fewer operations: it has
another solution to fall back on."""

COLUMNS_PER_VECTOR = 4
"""Columns of M^-1 J^T that take the time of one, in the lanes of vectors."""


def find_structure(
    n_u: int, n_c: int, mass_entries: Entries, jacobian_entries: Entries, jacobians: Sequence[Matrix] = ()
) -> Structure | None:
    """A sparse elimination order; None if the matrices are too small for a gain.

    If it takes far fewer operations, constraints come before some of their speeds, such as that of a crank which many
    loops have in common.

    Parameters
    ----------
    n_u, n_c : int
        Numbers of speeds and of constraints, none of them redundant.
    mass_entries, jacobian_entries : tuple of (int, int)
        Rows and columns of the entries that are not zero, as in `Structure`.
    jacobians : sequence of n_c rows of n_u numbers, optional
        Examples of J, which tell with which speeds constraints are independent.

    Returns
    -------
    Structure or None

    Examples
    --------
    >>> tree = tuple((i, j) for i in range(9) for j in range(i + 1) if j in (0, i))
    >>> find_structure(9, 0, tree, ()).below[:2]
    ((7,), (7,))
    """
    if n_u < MIN_SPEEDS:
        return None
    columns: list[set[int]] = [set() for _ in range(n_c)]
    for row, column in jacobian_entries:
        columns[row].add(column)
    if not all(columns):
        return None  # a constraint without speeds

    def structure(is_ready: Callable[[int, set[int]], bool]) -> Structure:
        order, below = _minimum_degree(n_u, mass_entries, columns, is_ready)
        return Structure(mass_entries, jacobian_entries, order, below)

    def cost(structure: Structure) -> int:
        return solution_cost(n_u, n_c, structure)

    found = structure(lambda row, eliminated: columns[row] <= eliminated)
    if jacobians:
        early = structure(_Early(jacobians).is_ready)
        found = early if MIN_EARLY_GAIN * cost(early) <= cost(found) else found
    return found


def _minimum_degree(
    n_u: int, mass_entries: Entries, columns: Sequence[set[int]], is_ready: Callable[[int, set[int]], bool]
) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """The order, and the later steps in the column of each; constraints are asked for in it when they are ready."""
    neighbours: list[set[int]] = [set() for _ in range(n_u + len(columns))]

    def join(members: Iterable[int]) -> None:
        members = set(members)
        for member in members:
            neighbours[member] |= members
            neighbours[member].discard(member)

    for entry in mass_entries:
        join(entry)
    for row, speeds in enumerate(columns):
        join([*speeds, n_u + row])
    order: list[int] = []
    below: list[set[int]] = []
    waiting, eliminated = set(range(n_u + len(columns))), set[int]()
    while waiting:
        for unknown in sorted(waiting, key=lambda candidate: (len(neighbours[candidate]), candidate)):
            if unknown < n_u or is_ready(unknown - n_u, eliminated):
                break
        waiting.discard(unknown)
        eliminated.add(unknown)
        order.append(unknown)
        below.append(neighbours[unknown])
        for neighbour in neighbours[unknown]:
            neighbours[neighbour].discard(unknown)
        join(neighbours[unknown])
    step = {unknown: k for k, unknown in enumerate(order)}
    return tuple(order), tuple(tuple(sorted(step[unknown] for unknown in column)) for column in below)


class _Early:
    """Which constraints are independent of those before them already with the speeds that were eliminated.

    By Gaussian elimination of examples of J: a pivot among these speeds must not be small in its row.
    """

    def __init__(self, jacobians: Sequence[Matrix]) -> None:
        self.matrices = [[list(row) for row in jacobian] for jacobian in jacobians]
        self.done: set[int] = set()
        self.taken: set[int] = set()

    def is_ready(self, row: int, eliminated: set[int]) -> bool:
        """Whether a constraint is ready; then it is eliminated."""
        speeds = [speed for speed in eliminated - self.taken if speed < len(self.matrices[0][0])]
        largest = [max(map(abs, matrix[row])) for matrix in self.matrices]
        shares = {
            speed: sum(_share(m[row][speed], size) for m, size in zip(self.matrices, largest, strict=True))
            for speed in speeds
        }
        if not shares:
            return False
        pivot = max(shares, key=shares.__getitem__)
        if shares[pivot] < math.log(Threshold.STATIC_PIVOT_RATIO) * len(self.matrices):
            return False
        self.done.add(row)
        self.taken.add(pivot)
        for matrix in self.matrices:
            for other in range(len(matrix)):
                if other not in self.done and matrix[other][pivot]:
                    factor = matrix[other][pivot] / (matrix[row][pivot] or math.inf)
                    matrix[other] = [a - factor * b for a, b in zip(matrix[other], matrix[row], strict=True)]
        return True


def solution_cost(n_u: int, n_c: int, structure: Structure | None) -> int:
    """The number of multiplications for one solution, in units of those of dense equations.

    Parameters
    ----------
    n_u, n_c : int
        Numbers of speeds and of constraints.
    structure : Structure or None
        A sparse elimination order, or None for dense equations.

    Returns
    -------
    int

    Examples
    --------
    >>> solution_cost(3, 2, None)
    22
    """
    if structure is not None:
        return MIN_SPARSE_GAIN * sum(len(rows) * (len(rows) + 3) // 2 for rows in structure.below)
    n_i = n_u - n_c
    return n_c**2 * n_u + n_c * n_i * n_u + n_i * n_u**2 // 2 + n_i**3 // 6


def recursive_cost(n_u: int, n_c: int, n_jacobian: int, operations: int) -> int:
    """The same for a recursion, besides the solution for one right-hand side; see linear_algebra/recursive_equations.h.

    Parameters
    ----------
    n_u, n_c : int
    n_jacobian : int
        Number of entries of J that are not zero.
    operations : int
        Those of M^-1 times a vector.

    Returns
    -------
    int

    Examples
    --------
    >>> recursive_cost(32, 0, 0, 1000)
    0
    """
    by_vectors = n_c * (operations // 2 + n_jacobian)
    return by_vectors // COLUMNS_PER_VECTOR + n_c**3 // 6 + 2 * (n_c**2 + n_c * n_u + n_jacobian)


def find_pivot_order(n_c: int, n_u: int, rank: int, jacobians: Sequence[Matrix]) -> PivotOrder:
    """A pivot order with large pivots relative to their rows, for some examples of J.

    Each step takes the constraint and the speed with the largest product, over the examples, of the ratios of pivot to
    largest entry in the row. Only dependent speeds, which come last, are candidates, or all speeds if these give small
    pivots. Redundant constraints come last.

    Parameters
    ----------
    n_c, n_u, rank : int
        Numbers of constraints, of speeds, and of dependent ones.
    jacobians : sequence of n_c rows of n_u numbers

    Returns
    -------
    PivotOrder

    Examples
    --------
    >>> find_pivot_order(2, 3, 2, [[[1.0, 0.0, 2.0], [0.5, 1.0, 1.0]]])
    PivotOrder(rows=(0, 1), speeds=(2, 1, 0))
    """
    dependent, order = range(n_u - rank, n_u), list(zip(range(n_c), range(n_u - rank, n_u), strict=False))
    if jacobians:
        order, worst = _pivot(jacobians, n_c, dependent, rank)
        if worst < Threshold.STATIC_PIVOT_RATIO:
            order, _ = _pivot(jacobians, n_c, range(n_u), rank)
    rows, speeds = [row for row, _ in order], [speed for _, speed in order]
    return PivotOrder(
        (*rows, *(row for row in range(n_c) if row not in rows)),
        (*speeds, *(speed for speed in range(n_u) if speed not in speeds)),
    )


def _pivot(
    jacobians: Sequence[Matrix], n_c: int, speeds: Sequence[int], rank: int
) -> tuple[list[tuple[int, int]], float]:
    """Pairs of row and speed in pivot order; the smallest pivot ratio of all steps, as a mean over the examples."""
    matrices = [[list(row) for row in jacobian] for jacobian in jacobians]
    noise = [[NOISE_RTOL * max(map(abs, row)) for row in matrix] for matrix in matrices]
    waiting, worst = list(itertools.product(range(n_c), speeds)), 0.0
    order: list[tuple[int, int]] = []
    while waiting and len(order) < rank:
        largest = [
            [size if (size := max(map(abs, row))) > least else 0.0 for row, least in zip(*pair, strict=True)]
            for pair in zip(matrices, noise, strict=True)
        ]
        shares = {
            (row, speed): sum(_share(m[row][speed], size[row]) for m, size in zip(matrices, largest, strict=True))
            for row, speed in waiting
        }
        pivot = row, speed = max(shares, key=shares.__getitem__)
        worst = min(worst, shares[pivot])
        order.append(pivot)
        waiting = [pair for pair in waiting if pair[0] != row and pair[1] != speed]
        for matrix in matrices:
            for other in {pair[0] for pair in waiting}:
                factor = matrix[other][speed] / (matrix[row][speed] or math.inf)
                matrix[other] = [a - factor * b for a, b in zip(matrix[other], matrix[row], strict=True)]
    return order, math.exp(worst / len(matrices))


def _share(entry: float, largest: float) -> float:
    """The logarithm of the ratio of an entry to the largest remaining one in its row."""
    return math.log(max(abs(entry) / largest, MIN_PIVOT_RATIO) if largest else MIN_PIVOT_RATIO)
