"""(s I - A) x = b of linear_algebra/shifted_equations.h, against numpy, and which unknowns are eliminated first.

The first unknowns are eliminated with the pivot s: errors of solutions are bounded as in test_elimination.py where the
entries of A are not much larger than that.
"""

import numpy as np
import pytest

ROUNDING = np.finfo(float).eps / 2.0
SHIFTS = np.array([3.6, 2.7, -3.1])
"""Of the size of those of Radau IIA: a real number, and the parts of a complex one."""


def second_order(random, n):
    """q' = u in any order, and u' of all."""
    matrix = random.normal(size=(2 * n, 2 * n))
    matrix[:n] = 0.0
    matrix[np.arange(n), n + random.permutation(n)] = 1.0
    return matrix, n


def with_rates(random, n):
    """The same with coordinates whose rates depend on these, such as those of quaternions."""
    matrix, left = second_order(random, n)
    matrix[0, : 2 * n] = random.normal(size=2 * n)
    return matrix, left + 1


def full(random, n):
    return random.normal(size=(n, n)), n


def of_constants(random, n):
    """Rows without an entry, one of them the partner of another row."""
    matrix = random.normal(size=(n + 3, n + 3))
    matrix[:3] = 0.0
    matrix[0, 2] = 2.0
    return matrix, n + 1


def chain(_, n):
    """x1' = x2, x2' = x3, ...: of each pair one is eliminated."""
    return np.eye(n, k=1), n // 2


def shuffled(random, n):
    matrix, left = second_order(random, n)
    order = random.permutation(2 * n)
    return matrix[np.ix_(order, order)], left


@pytest.mark.parametrize("make", [second_order, with_rates, full, of_constants, chain, shuffled])
@pytest.mark.parametrize("n", [1, 2, 3, 7, 12])
def test_solutions_agree_with_numpy(shims, make, n):
    random = np.random.default_rng(n)
    for _ in range(5):
        matrix, left = make(random, n)
        size = len(matrix)
        sides, solutions = random.normal(size=(3, size)), np.full((3, size), np.nan)
        assert shims.solve_shifted(size, np.ascontiguousarray(matrix), SHIFTS, sides, solutions) == left
        real, other = SHIFTS[0] * np.eye(size) - matrix, (SHIFTS[1] + 1j * SHIFTS[2]) * np.eye(size) - matrix
        for system, side, found in (
            (real, sides[0], solutions[0]),
            (other, sides[1] + 1j * sides[2], solutions[1] + 1j * solutions[2]),
        ):
            expected = np.linalg.solve(system, side)
            limit = 100.0 * size * ROUNDING * np.linalg.cond(system, np.inf)
            assert np.abs(found - expected).max() <= limit * np.abs(expected).max()


def test_a_matrix_without_entries_leaves_no_unknowns(shims):
    sides, solutions = np.arange(1.0, 7.0).reshape(3, 2), np.full((3, 2), np.nan)
    assert shims.solve_shifted(2, np.zeros((2, 2)), SHIFTS, sides, solutions) == 0
    np.testing.assert_allclose(solutions[0], sides[0] / SHIFTS[0], rtol=1e-15)
    complex_ones = (sides[1] + 1j * sides[2]) / (SHIFTS[1] + 1j * SHIFTS[2])
    np.testing.assert_allclose(solutions[1] + 1j * solutions[2], complex_ones, rtol=1e-15)


def test_a_singular_matrix_is_told(shims):
    """s is an eigenvalue of A."""
    matrix = np.diag([SHIFTS[0], 1.0])
    assert shims.solve_shifted(2, matrix, SHIFTS, np.ones((3, 2)), np.zeros((3, 2))) == -1
