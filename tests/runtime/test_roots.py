"""Chebyshev series and their roots alone, against numpy.polynomial and functions whose roots are known."""

import ctypes

import numpy as np
import pytest
from numpy.polynomial import chebyshev, polynomial

EPS = np.finfo(float).eps
DEGREES = (8, 16, 32, 64)
FUNCTION = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)


def fitted(shims, n, f):
    points = [shims.chebyshev_point(n, j, returns=ctypes.c_double) for j in range(n + 1)]
    c = np.zeros(n + 1)
    shims.chebyshev_fit(n, np.array([float(f(y)) for y in points]), c, returns=None)
    return c


def changes(shims, c, error):
    low, high, touched = np.zeros(70), np.zeros(70), np.zeros(1)
    n = shims.changes_of_sign(len(c) - 1, c, float(error), low, high, touched)
    return low[:n], high[:n], touched[0]


@pytest.mark.parametrize("n", DEGREES)
def test_series_values_and_slopes_are_those_of_numpy(shims, n):
    rng = np.random.default_rng(n)
    wanted = rng.normal(size=n + 1)
    found = fitted(shims, n, lambda y: chebyshev.chebval(y, wanted))
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=n * n * EPS)  # sums of n values of size sqrt(n)
    slope = np.zeros(n + 1)
    shims.chebyshev_slope(n, wanted, slope, returns=None)
    np.testing.assert_allclose(slope[:n], chebyshev.chebder(wanted), rtol=0.0, atol=n**3 * EPS)
    for y in rng.uniform(-1.0, 1.0, 20):
        value = shims.chebyshev_value(n, wanted, float(y), returns=ctypes.c_double)
        assert value == pytest.approx(chebyshev.chebval(y, wanted), abs=n * n * EPS)


def test_points_are_those_of_numpy_in_the_opposite_order(shims):
    for n in DEGREES:
        points = [shims.chebyshev_point(n, j, returns=ctypes.c_double) for j in range(n, -1, -1)]
        np.testing.assert_allclose(points, chebyshev.chebpts2(n + 1), rtol=0.0, atol=2.0 * EPS)


@pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, 1e-4])
def test_each_simple_root_of_random_polynomials_is_alone_between_two_signs(shims, gap):
    """A pair of roots at a distance, and up to two others, in the polynomial's own scale."""
    rng = np.random.default_rng(round(1.0 / gap))
    for _ in range(200):
        first = rng.uniform(-0.9, 0.9)
        roots = np.sort([first, first + gap, *rng.uniform(-0.99, 0.99, rng.integers(0, 3))])
        if np.diff(roots).min() < 0.99 * gap:
            continue
        c = fitted(shims, 8, lambda y, roots=roots: np.prod(y - roots))
        low, high, _ = changes(shims, c, 64.0 * EPS * np.abs(c).max())
        assert len(low) == len(roots)
        assert ((low <= roots) & (roots <= high)).all()


@pytest.mark.parametrize("power", [2, 4, 6])
def test_a_function_that_touches_zero_has_no_change_of_sign_and_says_where(shims, power):
    c = fitted(shims, 8, lambda y: (y - 0.3) ** power)
    low, _, touched = changes(shims, c, 1e-13)
    assert len(low) == 0
    assert touched == pytest.approx(0.3, abs=2.0 * (1e-13) ** (1.0 / power))  # where it is less than the error


@pytest.mark.parametrize("power", [1, 3, 5])
def test_an_odd_root_is_one_change_of_sign(shims, power):
    low, high, touched = changes(shims, fitted(shims, 8, lambda y: (y - 0.3) ** power), 1e-13)
    assert len(low) == 1
    assert low[0] <= 0.3 <= high[0]
    assert np.isnan(touched)


def test_zero_and_constants_have_no_roots(shims):
    for value in (0.0, 1e-20, 1.0, -2.0):
        low, _, touched = changes(shims, fitted(shims, 8, lambda y, value=value: value), 1e-13)
        assert len(low) == 0
        assert np.isnan(touched)


def test_as_many_roots_as_a_series_has(shims):
    """T_64 has 64 simple roots, cos((2 k + 1) pi / 128)."""
    c = np.zeros(65)
    c[64] = 1.0
    low, high, _ = changes(shims, c, 1e-13)
    roots = np.cos((2.0 * np.arange(64) + 1.0) * np.pi / 128.0)[::-1]
    assert len(low) == 64
    assert ((low <= roots) & (roots <= high)).all()


@pytest.mark.parametrize(
    ("function", "a", "b", "root"),
    [
        (lambda y: y**3 - 2.0 * y - 5.0, 2.0, 3.0, 2.0945514815423265),  # Wallis's
        (lambda y: y * np.exp(y) - 1.0, 0.0, 1.0, 0.5671432904097838),  # Lambert's W(1)
        (lambda y: np.cos(y) - y, 0.0, 1.0, 0.7390851332151607),  # Dottie's number
        (lambda y: -1.0 if y < 0.3 else 1.0, -1.0, 1.0, 0.3),
        (lambda y: (y - 0.3) ** 9, -1.0, 1.0, None),
        (lambda y: polynomial.polyval(y, [-1e-9, 1.0]), -1.0, 1.0, 1e-9),
    ],
)
def test_bracketed_roots_of_known_equations(shims, function, a, b, root):
    found = np.zeros(1)
    n = shims.solve_bracketed(FUNCTION(lambda y: float(function(y))), a, b, found)
    if root is not None:
        assert found[0] == pytest.approx(root, abs=8.0 * EPS * max(abs(a), abs(b)))
    assert abs(function(found[0])) <= abs(function(a))
    assert n <= 60  # bisection takes 53
