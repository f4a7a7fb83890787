"""Dependent coordinates and speeds from linear constraints, by singular value decomposition."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import SimulationError
from fourbar_codegen.runtime.enumerations import Threshold

__all__ = ["INDEPENDENCE_RTOL", "SINGULAR_RTOL", "eliminate", "row_sizes", "solve_dependent", "solve_redundant"]

Floats = NDArray[np.float64]

SINGULAR_RTOL = 1e-12
"""Singular values below this fraction of the largest are rounding errors."""

INDEPENDENCE_RTOL = 1e-6
"""Rows are independent if singular values exceed this fraction of the largest: rows that are redundant only on the
constraint manifold differ by the error of the position."""


def row_sizes(matrix: Floats) -> Floats:
    """The largest entry of each row, for comparing constraints in different units, shape (n, 1).

    Infinite for rows of rounding errors.
    """
    size = np.abs(matrix).max(axis=1, keepdims=True, initial=0.0)
    return np.where(size > Threshold.ROW_RTOL * size.max(initial=0.0), size, np.inf)


def solve_dependent(
    matrix: Floats, n_independent: int, known: Floats, singular: float = SINGULAR_RTOL
) -> tuple[Floats, int]:
    """The v_d with ``matrix[:, n_independent:] @ v_d + known = 0`` by least squares, and the rank of the columns.

    Rows must be scaled by `row_sizes`. Columns are scaled by their largest entries, so that metres and radians count
    alike. Variables whose columns are only rounding errors are 0. Of several solutions, the minimum-norm one in these
    units is returned.
    """
    dependent = matrix[:, n_independent:]
    size = np.abs(dependent).max(axis=0, initial=0.0)
    unit = np.where(size > Threshold.ROW_RTOL, size, np.inf)
    scaled = dependent / unit
    solution, _, rank, _ = np.linalg.lstsq(scaled, -known, rcond=singular)
    # One step of iterative refinement: entries that are small beside others become accurate by themselves.
    solution = solution - np.linalg.lstsq(scaled, scaled @ solution + known, rcond=singular)[0]
    return np.asarray(solution / unit.reshape(-1, *[1] * (known.ndim - 1)), dtype=np.float64), int(rank)


def eliminate(matrix: Floats, n_independent: int, names: Sequence[str]) -> Floats:
    """The dependent variables of ``matrix @ variables = 0`` in terms of the independent ones, which stand first.

    Parameters
    ----------
    matrix : ndarray, shape (n_c, n)
    n_independent : int
    names : sequence of str
        Names of the dependent variables.

    Returns
    -------
    ndarray, shape (n - n_independent, n_independent)

    Raises
    ------
    SimulationError
        If they do not follow from the independent ones.

    Examples
    --------
    >>> import numpy as np
    >>> eliminate(np.array([[2.0, -4.0]]), 1, ["q2"]).tolist()
    [[0.5]]
    """
    scaled = matrix / row_sizes(matrix)
    solution, rank = solve_dependent(scaled, n_independent, scaled[:, :n_independent])
    if rank < matrix.shape[1] - n_independent:
        raise SimulationError(
            f"The dependent variables ({', '.join(names)}) do not follow from the independent ones "
            "in this configuration: the constraints' Jacobian with respect to them is singular."
        )
    return solution


def solve_redundant(matrix: Floats, right: Floats, size: Floats) -> Floats | None:
    """The solution of equations that may be redundant; None if they do not determine it.

    Parameters
    ----------
    matrix : ndarray, shape (m, n)
    right : ndarray, shape (m,)
    size : ndarray, shape (m,)
        Typical sizes of the rows: not their own, since at a change point a row of rounding errors should not count, nor
        at a dead point a column of these.

    Returns
    -------
    ndarray, shape (n,), or None
    """
    if not np.isfinite(matrix).all() or not np.isfinite(right).all():
        return None
    solution, _, rank, _ = np.linalg.lstsq(matrix / size[:, None], right / size, rcond=Threshold.DETERMINED_RATIO)
    return np.asarray(solution) if rank == matrix.shape[1] else None
