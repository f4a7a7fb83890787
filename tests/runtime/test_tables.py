"""Tables of inputs: fb_table_value of kernel/problem.h against SciPy, and their kinds as a kernel's inputs.

Values are sums of four terms, evaluated in another order than SciPy's: 1e-14 of their size.
"""

import ctypes

import numpy as np
import pytest
from builders.hand_written_pendulum import states_at
from scipy.interpolate import CubicSpline, PchipInterpolator, PPoly

import fourbar_codegen as fb

TIMES = np.array([-1.0, 0.0, 0.3, 1.7, 1.8, 4.0])
VALUES = np.array([2.0, -1.0, 0.5, 0.6, -3.0, 1.0])


def value(shims, times, coefficients, t, interval=0, before=7.0, after=9.0):
    """The value and the interval in which it was found; coefficients as in PPoly."""
    found = np.array([interval], dtype=np.intc)
    rows = np.ascontiguousarray(np.transpose(coefficients))
    n, k = rows.shape
    result = shims.table_value(n, k, times, rows, before, after, float(t), found, returns=ctypes.c_double)
    return result, found[0]


@pytest.mark.parametrize("power", range(5))
def test_values_of_a_table_are_those_of_its_polynomials(shims, power):
    coefficients = np.random.default_rng(power).normal(size=(power + 1, 5))
    expected = PPoly(coefficients, TIMES)
    interval = 0
    for t in np.linspace(-1.0, 4.0, 101):
        found, interval = value(shims, TIMES, coefficients, t, interval)
        assert found == pytest.approx(float(expected(t)), rel=1e-14, abs=1e-13)


@pytest.mark.parametrize("guess", range(5))
@pytest.mark.parametrize("t", [-1.0, -0.5, 0.0, 0.29, 0.3, 1.75, 1.8, 3.9, 4.0])
def test_the_interval_of_a_time_is_found_from_any_guess(shims, t, guess):
    """An interval begins at its first time; only the last one contains its end."""
    coefficients = np.arange(5.0)[np.newaxis]
    expected = min(np.searchsorted(TIMES, t, side="right") - 1, 4)
    assert value(shims, TIMES, coefficients, t, guess) == (expected, expected)


@pytest.mark.parametrize(("t", "expected"), [(-1.0000001, 7.0), (-np.inf, 7.0), (4.0000001, 9.0), (np.inf, 9.0)])
def test_a_table_is_constant_outside_of_its_times(shims, t, expected):
    assert value(shims, TIMES, np.zeros((2, 5)), t)[0] == expected


def test_a_table_of_many_times_is_searched_in_logarithmically_many_steps(shims):
    """Of 100,000 intervals: any wrong bisection would end in another one or not at all."""
    times = np.cumsum(np.random.default_rng(0).uniform(0.1, 1.0, 100001))
    coefficients = np.arange(100000.0)[np.newaxis]
    for place in (0, 1, 49999, 50000, 99998, 99999):
        t = (times[place] + times[place + 1]) / 2.0
        for guess in (0, 50000, 99999):
            assert value(shims, times, coefficients, t, guess)[0] == place


INTERPOLANTS = {
    "linear": lambda t: np.interp(t, TIMES, VALUES),
    "cubic": CubicSpline(TIMES, VALUES),
    "pchip": PchipInterpolator(TIMES, VALUES),
    "hold": lambda t: VALUES[np.clip(np.searchsorted(TIMES, t, side="right") - 1, 0, 5)],
}


@pytest.mark.parametrize("kind", INTERPOLANTS)
def test_a_table_as_an_input_has_the_values_of_scipys_interpolant(pendulum, kind):
    """And those of its ends outside: the input at the states of a run."""
    t = np.linspace(-2.0, 5.0, 57)
    run = pendulum.simulate(
        (-2.0, 5.0), states_at(0.8, 0.3, 0.0), inputs={"F": (TIMES, VALUES, kind)}, t_eval=t, rtol=1e-4, atol=1e-4
    )
    expected = INTERPOLANTS[kind](np.clip(t, TIMES[0], TIMES[-1]))
    np.testing.assert_allclose(run.r[0], expected, rtol=0.0, atol=1e-14 * 10.0)


@pytest.mark.parametrize("kind", INTERPOLANTS)
@pytest.mark.parametrize("times", [[0.0, 0.0, 1.0], [0.0, -1.0, 1.0], [0.0, np.nan, 1.0]])
def test_times_of_a_table_that_do_not_increase_are_refused(pendulum, kind, times):
    with pytest.raises(fb.ModelError, match=r"increas|finite"):
        pendulum.simulate((0.0, 1.0), states_at(0.8, 0.3, 0.0), inputs={"F": (times, [1.0, 2.0, 3.0], kind)})


@pytest.mark.parametrize(("since", "expected"), [(0.25, 10.25), (-5.0, 9.5), (3.0, 10.75), (-0.5, 9.5), (0.75, 10.75)])
def test_a_clock_stays_between_its_discontinuities(shims, since, expected):
    """With the origin at 10, between 9.5 and 10.75."""
    assert shims.time_within(10.0, 9.5, 10.75, since, returns=ctypes.c_double) == expected


@pytest.mark.parametrize(("stride", "expected"), [(0, 2.0), (4, 9.0)])
def test_an_entry_of_states_in_columns_is_shared_or_its_own(shims, stride, expected):
    """Row 2 at state 1: of values that all states share, or of a row of four."""
    assert shims.entry(np.arange(12.0), stride, 2, 1, returns=ctypes.c_double) == expected
