"""Sine and cosine of arithmetic/sine.inc and arithmetic/angle.h against mpmath, in units in the last place.

arithmetic/sine.inc states an error below 1.6 units; beyond FB_MAX_ANGLE = 1e6 the C library answers, within 1 unit (GNU
C
Library manual, "Known Maximum Errors in Math Functions").
"""

from functools import cache
from pathlib import Path

import mpmath
import numpy as np
import pytest
from harness.shims import Shims

LIMIT = 1.6
MEAN_LIMIT = 0.39
"""Of the root mean square. The last sum is rounded by 1 / sqrt(12) = 0.29 units, and what it adds has errors of its own
of up to as much, at its share of the result: some sqrt(0.29^2 + 0.21^2) = 0.36 together. Without the terms for what the
reduction or the sum of the cosine rounds away it would be 0.41, although the limit above may hold.
"""


def has(flag):
    try:
        return flag in Path("/proc/cpuinfo").read_text(encoding="ascii").split()
    except OSError:
        return False


@pytest.fixture(scope="module", params=["single", "lanes", "avx2", "lanes, avx2"])
def sines(request, shared):
    """The functions for single angles or for vectors, with and without fused multiplication."""
    avx2 = "avx2" in request.param
    if avx2 and not (has("avx2") and has("fma")):
        pytest.skip("the processor has no AVX2")
    source = "shims_of_lanes.c" if "lanes" in request.param else "shims.c"
    return Shims(shared("sines", source, options=("-mavx2", "-mfma") if avx2 else ()))


def near_multiples(count, most):
    """The doubles next to multiples of pi/2, where the result is small and the reduction loses most."""
    n = np.unique(np.random.default_rng(1).integers(1, most, count))
    with mpmath.workdps(40):
        nearest = np.array([float(int(k) * mpmath.pi / 2) for k in n])
    return np.concatenate((nearest, np.nextafter(nearest, np.inf)))


BATTERIES = {
    "up to a turn": np.linspace(-2.0 * np.pi, 2.0 * np.pi, 604),
    "of all sizes": np.random.default_rng(2).choice([-1.0, 1.0], 600) * 2.0 ** np.linspace(-60.0, 19.9, 600),
    "next to multiples of a right angle": near_multiples(300, 630000),
    "next to odd multiples of half a right angle": (2.0 * np.arange(300) + 1.0) * np.pi / 4.0,
    "at random": np.random.default_rng(3).uniform(-1e6, 1e6, 3008),
    "large, next to multiples of a right angle": near_multiples(300, 600000000),
    "large": np.array([999999.0, 1e6, -1e6, 1234567.8, -1e9, 1e15, 1e22, -1.7e308]),
}


def padded(values):
    """To a multiple of four vectors."""
    return np.resize(values, -(-len(values) // 32) * 32)


@cache
def exact(battery):
    """Sines and cosines to more than 20 digits after all that the reduction takes away, and the distances of the
    doubles next to them.
    """
    x = BATTERIES[battery].tolist()
    with mpmath.workprec(1200 if battery == "large" else 200):  # the largest double has 1024 bits before the point
        values = [[f(mpmath.mpf(value)) for value in x] for f in (mpmath.sin, mpmath.cos)]
    return values, np.spacing(np.abs(np.array(values, dtype=float)))


@pytest.mark.parametrize("function", ["sines", "sines_of_four"])
@pytest.mark.parametrize("battery", BATTERIES)
def test_sines_and_cosines_are_within_their_units_in_the_last_place(sines, function, battery):
    x, (references, units) = padded(BATTERIES[battery]), exact(battery)
    found = np.full((2, x.size), np.nan)
    getattr(sines, function)(x.size, x, found[0], found[1], returns=None)
    with mpmath.workprec(200):
        errors = [
            [float(mpmath.mpf(value) - reference) for value, reference in zip(row, exact_row, strict=False)]
            for row, exact_row in zip(found.tolist(), references, strict=True)
        ]
    assert np.abs(errors / units).max() < LIMIT
    if battery == "at random":
        assert np.sqrt(np.mean((errors / units) ** 2)) < MEAN_LIMIT


@pytest.mark.parametrize("function", ["sines", "sines_of_four"])
def test_the_sine_of_zero_keeps_its_sign(sines, function):
    x = padded(np.array([0.0, -0.0]))
    found = np.full((2, x.size), np.nan)
    getattr(sines, function)(x.size, x, found[0], found[1], returns=None)
    np.testing.assert_array_equal(np.signbit(found[0]), np.signbit(x))
    np.testing.assert_array_equal(found, [0.0 * x, x * 0.0 + 1.0])


@pytest.mark.parametrize("function", ["sines", "sines_of_four"])
@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf])
def test_angles_without_a_sine_give_nan_and_leave_their_neighbours(sines, function, odd):
    x = padded(np.array([0.3, odd, -2.0, 5.0, 1e7, 0.1, 0.2]))
    found = np.full((2, x.size), 7.0)
    getattr(sines, function)(x.size, x, found[0], found[1], returns=None)
    good = np.isfinite(x)
    assert np.isnan(found[:, ~good]).all()
    np.testing.assert_allclose(found[:, good], [np.sin(x[good]), np.cos(x[good])], rtol=1e-15)


@pytest.mark.parametrize("function", ["sines", "sines_of_four"])
@pytest.mark.parametrize("large", [1.9e8, -1.9e8])
def test_a_large_angle_is_reduced_in_any_place(sines, function, large):
    """Alone among small ones, in each place of four vectors. Both answers are within a unit or two."""
    for place in range(32):
        x = np.full(32, 0.5)
        x[place] = large
        found = np.full((2, 32), np.nan)
        getattr(sines, function)(32, x, found[0], found[1], returns=None)
        np.testing.assert_allclose(found, [np.sin(x), np.cos(x)], rtol=1e-15)
