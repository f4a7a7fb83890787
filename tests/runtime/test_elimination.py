"""Eliminations of linear_algebra/elimination.h, against mpmath and against the structure of matrices.

Gaussian elimination with partial pivoting solves a neighbouring system exactly, whose entries differ by at most 3 n
units of rounding, 1.1e-16, times the growth of entries (N. J. Higham, Accuracy and Stability of Numerical Algorithms,
2nd ed. 2002, theorem 9.5). The growth of random matrices of this size is below 10 (section 9.4); so errors of solutions
are below 30 n 1.1e-16 times the condition number.
"""

import ctypes

import mpmath
import numpy as np
import pytest

ROUNDING = np.finfo(float).eps / 2.0
DETERMINED = 1e-10
"""FB_CLOSURE_PIVOT_RATIO: pivots up to it count as zero in `fb_eliminate_rows`."""


def solved(matrix, side):
    """By mpmath, to 40 digits."""
    with mpmath.workdps(40):
        return np.array(mpmath.lu_solve(mpmath.matrix(matrix.tolist()), mpmath.matrix(side.tolist())), dtype=float)


def full(shims, matrix, side, least=0.0):
    """The status and the solution."""
    solution = np.array(side, dtype=float)
    status = shims.eliminate_full(len(solution), np.array(matrix, dtype=float, order="C"), solution, least)
    return status, solution


def rows(shims, matrix, sides):
    """The rank, the solutions, the order of the columns, and the last pivot."""
    (m, n), k = matrix.shape, sides.shape[1]
    order, solution, last = np.zeros(n, dtype=np.intc), np.full((n, k), np.nan), np.full(1, np.nan)
    rank = shims.eliminate_rows(m, n, k, matrix.copy(), sides.copy(), order, solution, last)
    return rank, solution, order, last[0]


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 13])
def test_elimination_of_random_matrices_agrees_with_mpmath(shims, n):
    random = np.random.default_rng(n)
    for _ in range(5):
        matrix, side = random.normal(size=(n, n)), random.normal(size=n)
        status, found = full(shims, matrix, side)
        expected = solved(matrix, side)
        assert status == 1
        limit = 30.0 * n * ROUNDING * np.linalg.cond(matrix, np.inf)
        assert np.abs(found - expected).max() <= limit * np.abs(expected).max()


def test_elimination_of_a_hilbert_matrix_leaves_a_small_residual(shims):
    """Its condition number is 1.7e10; the residual of elimination does not grow with that."""
    matrix = 1.0 / (np.arange(8)[:, np.newaxis] + np.arange(8) + 1.0)
    side = np.array([1.0, -2.0, 3.0, -4.0, 5.0, -6.0, 7.0, -8.0])
    status, found = full(shims, matrix, side)
    assert status == 1
    residual = np.abs(matrix @ found - side).max()
    assert residual <= 30 * 8 * ROUNDING * np.linalg.norm(matrix, np.inf) * np.abs(found).max()
    expected = solved(matrix, side)
    assert np.abs(found - expected).max() <= 30 * 8 * ROUNDING * 1.7e10 * np.abs(expected).max()


def test_elimination_of_a_permutation_is_exact(shims):
    random = np.random.default_rng(0)
    for n in range(1, 9):
        order = random.permutation(n)
        side = random.normal(size=n)
        status, found = full(shims, np.eye(n)[order], side)
        assert status == 1
        np.testing.assert_array_equal(found[order], side)


def test_elimination_takes_the_largest_pivot_of_a_column(shims):
    """With the first pivot, 1e-20, the second equation would be lost: x = (1, 1) would become (0, 1)."""
    status, found = full(shims, [[1e-20, 1.0], [1.0, 1.0]], [1.0, 2.0])
    assert status == 1
    np.testing.assert_allclose(found, [1.0, 1.0], rtol=4.0 * ROUNDING)


@pytest.mark.parametrize("exponent", [-300, -40, 40, 300])
def test_powers_of_two_in_columns_pass_through_elimination_exactly(shims, exponent):
    """Partial pivoting compares entries of one column, so that scaled columns change nothing but their unknowns."""
    random = np.random.default_rng(7)
    matrix, side = random.normal(size=(6, 6)), random.normal(size=6)
    scales = np.ldexp(np.ones(6), [0, exponent, 0, -exponent, exponent // 2, 1])
    np.testing.assert_array_equal(full(shims, matrix * scales, side)[1] * scales, full(shims, matrix, side)[1])


@pytest.mark.parametrize(
    "matrix",
    [
        [[0.0]],
        [[1.0, 2.0], [2.0, 4.0]],
        [[0.0, 1.0], [0.0, 3.0]],
        [[2.0, 3.0, 4.0], [4.0, 2.0, 8.0], [1.0, 0.5, 2.0]],
        [[np.nan, 1.0], [np.nan, 2.0]],
    ],
)
def test_elimination_of_a_singular_matrix_reports_it(shims, matrix):
    """Factors are powers of two here: no rounding error hides a pivot of 0."""
    assert full(shims, matrix, [1.0] * len(matrix))[0] == 0


@pytest.mark.parametrize(("pivot", "status"), [(0.9e-12, 0), (1e-12, 0), (1.1e-12, 1)])
def test_elimination_needs_pivots_above_the_given_bound(shims, pivot, status):
    assert full(shims, [[1.0, 0.0], [0.0, -pivot]], [1.0, 1.0], least=1e-12)[0] == status


@pytest.mark.parametrize(("m", "n", "k"), [(1, 1, 1), (3, 3, 1), (5, 3, 2), (8, 8, 3), (12, 7, 1)])
def test_elimination_with_complete_pivoting_solves_consistent_rows(shims, m, n, k):
    """Rows beyond the unknowns are combinations of the others. Growth is smaller than with partial pivoting."""
    random = np.random.default_rng(10 * m + n)
    independent = random.uniform(-1.0, 1.0, (n, n))
    matrix = np.vstack((independent, random.uniform(-1.0, 1.0, (m - n, n)) @ independent / n))
    expected = random.normal(size=(n, k))
    rank, found, order, last = rows(shims, matrix, matrix @ expected)
    assert rank == n
    assert sorted(order) == list(range(n))
    assert last > DETERMINED
    limit = 30.0 * m * ROUNDING * np.linalg.cond(matrix)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=limit * np.abs(expected).max())


@pytest.mark.parametrize("rank", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("shape", [(4, 6), (6, 4), (5, 5)])
def test_elimination_of_a_matrix_without_full_rank_reports_its_rank(shims, rank, shape):
    """Unknowns of columns without a pivot are 0, and the others satisfy the rows nevertheless."""
    random = np.random.default_rng(rank)
    matrix = random.uniform(-1.0, 1.0, (shape[0], rank)) @ random.uniform(-1.0, 1.0, (rank, shape[1])) / max(rank, 1)
    sides = matrix @ random.normal(size=(shape[1], 2))
    found_rank, found, order, last = rows(shims, matrix, sides)
    assert found_rank == np.linalg.matrix_rank(matrix) == rank
    assert (last > DETERMINED) == (rank == min(shape))
    assert not found[order[rank:]].any()
    np.testing.assert_allclose(matrix @ found, sides, rtol=0.0, atol=1e-12)  # pivots are above 1e-3, entries about 1


def test_elimination_of_fewer_rows_than_unknowns_sets_the_others_to_zero(shims):
    """The largest entry is the first pivot: 3 x_2 = 6."""
    rank, found, order, last = rows(shims, np.array([[1.0, -2.0, 3.0]]), np.array([[6.0]]))
    assert (rank, order[0], last) == (1, 2, 3.0)
    np.testing.assert_array_equal(found, [[0.0], [0.0], [2.0]])


def test_the_last_pivot_of_a_diagonal_is_its_smallest_entry(shims):
    matrix = np.diag([0.5, -0.01, 0.25])
    rank, found, order, last = rows(shims, matrix, np.ones((3, 1)))
    assert (rank, last) == (3, 0.01)
    np.testing.assert_array_equal(order, [0, 2, 1])
    np.testing.assert_allclose(found[:, 0], [2.0, -100.0, 4.0], rtol=2.0 * ROUNDING)


@pytest.mark.parametrize(("pivot", "rank"), [(0.5e-10, 1), (1e-10, 1), (2e-10, 2), (np.nan, 1)])
def test_pivots_that_count_as_zero_end_the_elimination(shims, pivot, rank):
    found_rank, found, _, last = rows(shims, np.diag([1.0, pivot]), np.ones((2, 1)))
    assert found_rank == rank
    assert found[0, 0] == 1.0
    if np.isfinite(pivot):
        assert last == pivot
        assert found[1, 0] == (0.0 if rank == 1 else 1.0 / pivot)


def test_elimination_without_unknowns_has_rank_zero(shims):
    rank, _, _, last = rows(shims, np.zeros((2, 0)), np.zeros((2, 1)))
    assert (rank, last) == (0, 1.0)


def test_balanced_rows_and_columns_have_entries_up_to_one_and_the_same_solution(closing):
    random = np.random.default_rng(1)
    matrix, scale = random.normal(size=(3, 3)), 10.0 ** np.array([-8.0, 0.0, 9.0])
    scaled = np.ascontiguousarray(scale[:, np.newaxis] * matrix * scale[::-1])
    side = scale * random.normal(size=3)
    expected = solved(scaled, side)
    balanced, balanced_side, unit = scaled.copy(), side.copy(), np.zeros(3)
    closing.balance(3, 3, balanced, balanced_side, unit, returns=None)
    np.testing.assert_array_equal(unit, np.abs(scaled).max(axis=0))
    np.testing.assert_allclose(np.abs(balanced).max(axis=1), 1.0, rtol=2.0 * ROUNDING)
    limit = 100.0 * ROUNDING * np.linalg.cond(balanced)
    np.testing.assert_allclose(np.linalg.solve(balanced, balanced_side) / unit, expected, rtol=limit)


def test_balancing_leaves_zeros_as_they_are(closing):
    matrix, side, unit = np.array([[0.0, 4.0], [0.0, 0.0]]), np.array([2.0, 3.0]), np.zeros(2)
    closing.balance(2, 2, matrix, side, unit, returns=None)
    np.testing.assert_array_equal(matrix, [[0.0, 1.0], [0.0, 0.0]])
    np.testing.assert_array_equal(side, [2.0, 3.0])
    np.testing.assert_array_equal(unit, [0.0, 4.0])


@pytest.mark.parametrize(
    ("violations", "scales", "expected"),
    [
        ([1e-3, -4e-3], [1.0, 2.0], 2e-3),
        ([0.0, 0.0], [0.0, 1.0], 0.0),
        ([1.0, 0.0], [0.0, 1.0], np.inf),
        ([1.0, np.nan, 5.0], [1.0, 1.0, 1.0], np.nan),
        ([], [], 0.0),
    ],
)
def test_the_violation_is_the_largest_relative_to_its_scale(shims, violations, scales, expected):
    found = shims.violation(np.array(violations), np.array(scales), len(scales), returns=ctypes.c_double)
    np.testing.assert_equal(found, expected)


@pytest.mark.parametrize(
    ("values", "status"), [([0.0, -1e308], 0), ([np.inf, 0.0], 3), ([0.0, np.nan], 3), ([-np.inf], 3), ([], 0)]
)
def test_values_that_are_not_finite_have_their_status(shims, values, status):
    assert shims.all_are_finite(np.array(values), len(values)) == status
