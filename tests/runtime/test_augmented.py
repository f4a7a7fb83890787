"""The linear algebra of steppers/ali3p.h alone: penalties, mass-orthogonal corrections and shortest multipliers.

A penalty of w times the size of M leaves an error of the order of 1 / w: FB_PROJECTION_PENALTY = 1e10, in three
repetitions for accelerations, and FB_SHORTEST = 1e-10 for multipliers. Errors of rounding grow with w as well:
1e-16 w = 1e-6, also less with each repetition.
"""

import ctypes

import numpy as np
import pytest


def system(seed, n_u=5, n_c=2, repeated=0):
    """M, J with some rows repeated, f and gamma; and J without these."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(n_u, n_u))
    J = random.normal(size=(n_c, n_u))
    weights = random.normal(size=(repeated, n_c))
    gamma = random.normal(size=n_c)
    rows = np.ascontiguousarray(np.vstack((J, weights @ J)))
    return root @ root.T + np.eye(n_u), rows, random.normal(size=n_u), np.append(gamma, weights @ gamma), J


@pytest.mark.parametrize("weight", [1.0, 1e6])
def test_the_penalty_makes_constraints_as_large_as_masses(shims, weight):
    M, J, _, _, _ = system(0)
    found = shims.penalty(5, 2, M, J, weight, returns=ctypes.c_double)
    assert found == pytest.approx(weight * np.trace(M) / np.trace(J.T @ J), rel=1e-14)


def test_there_is_no_penalty_without_constraints(shims):
    assert shims.penalty(5, 2, np.eye(5), np.zeros((2, 5)), 1.0, returns=ctypes.c_double) == 0.0


@pytest.mark.parametrize("repeated", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_the_least_change_is_the_shortest_in_the_metric_of_masses(shims, seed, repeated):
    """v = -M^-1 J^T (J M^-1 J^T)^-1 w; of a repeated row, too."""
    M, rows, _, violations, J = system(seed, repeated=repeated)
    found = np.full(5, np.nan)
    assert shims.least_change(5, 2 + repeated, M, rows, violations, found) == 1
    inverse = np.linalg.inv(M) @ J.T
    expected = -inverse @ np.linalg.solve(J @ inverse, violations[:2])
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("repeated", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_accelerations_satisfy_their_constraints_and_multipliers_are_the_shortest(shims, seed, repeated):
    """The equations of motion by NumPy, without repeated rows, and the pseudoinverse of all rows."""
    M, rows, f, gamma, J = system(seed, repeated=repeated)
    u, multipliers = np.full(5, np.nan), np.full(2 + repeated, np.nan)
    assert shims.augmented_solution(5, 2 + repeated, M, f, rows, gamma, u, multipliers) == 1  # FB_RUN_PAUSED
    matrix = np.block([[M, -J.T], [J, np.zeros((2, 2))]])
    expected = np.linalg.solve(matrix, np.concatenate((f, -gamma[:2])))[:5]
    np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
    force = M @ expected - f
    np.testing.assert_allclose(rows.T @ multipliers, force, rtol=0.0, atol=1e-8 * np.abs(force).max())
    # What has no effect is known up to rounding errors over FB_SHORTEST.
    shortest = np.linalg.pinv(rows.T) @ force
    np.testing.assert_allclose(multipliers, shortest, rtol=0.0, atol=1e-5 * np.abs(shortest).max())
