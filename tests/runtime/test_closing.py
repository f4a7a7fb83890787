"""Loop closure in C, kernel/loop_closure.h, on the pendulum: y = +- sqrt(l^2 - x^2), u_y = -x u_x / y."""

import ctypes

import numpy as np
import pytest

OK, DEPENDENT, NOT_FINITE, NOT_CLOSED = 0, 1, 3, 4
"""FB_STATUS."""


def close(closing, x, y, u_x=0.0, length=1.0):
    state = np.array([x, y, u_x, np.pi])
    status = closing.close_pendulum(np.array([length, 9.81, 1.0]), state)
    return status, state


@pytest.mark.parametrize("guess", [-0.8, -0.1, -1e-3, 0.02, 0.6, 40.0])
@pytest.mark.parametrize("x", [0.0, 0.3, -0.9, 0.999])
def test_the_closed_coordinate_is_on_the_side_of_its_guess(closing, x, guess):
    """A guess near 0 makes Newton's first step long, and the next ones halve it: y keeps its sign all along. Phi is
    closed to 1e-14 of its terms, here 2, which changes y by as much over its derivative.
    """
    status, found = close(closing, x, guess, u_x=2.0)
    y = np.sign(guess) * np.sqrt(1.0 - x**2)
    assert status == OK
    np.testing.assert_array_equal(found[[0, 2]], [x, 2.0])
    assert found[1] == pytest.approx(y, abs=1e-14 / abs(y))
    assert found[3] == pytest.approx(-x * 2.0 / y, abs=1e-13 / abs(y) ** 3)


@pytest.mark.parametrize("length", [1e-6, 1e6])
def test_units_of_length_do_not_matter(closing, length):
    status, found = close(closing, 0.6 * length, -0.2 * length, u_x=length, length=length)
    assert status == OK
    np.testing.assert_allclose(found / length, [0.6, -0.8, 1.0, 0.75], rtol=1e-13)


def test_a_coordinate_beyond_the_circle_is_not_closed(closing):
    assert close(closing, 1.1, -0.5)[0] == NOT_CLOSED


def test_a_guess_where_newtons_method_has_no_direction_is_not_closed(closing):
    """At y = 0 the derivative with respect to y is zero."""
    assert close(closing, 0.6, 0.0)[0] == NOT_CLOSED


def test_a_speed_that_no_constraint_determines_is_reported(closing):
    """At x = l, y = 0 the position is closed, and the derivative with respect to y is zero."""
    assert close(closing, 1.0, 0.0, u_x=1.0)[0] == DEPENDENT


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_not_finite_has_its_status(closing, place, value):
    state = [0.3, -0.8, 1.0]
    state[place] = value
    assert close(closing, *state)[0] == NOT_FINITE


@pytest.mark.parametrize(
    ("x", "other", "expected"),
    [
        ((0.6, 0.8), (0.6, 0.8), 1.0),
        ((0.3, 0.2), (0.6, 0.8), 0.5),
        ((0.0, 1e-3), (1.0, 1.0), 1e-3),
        ((0.0, 0.0), (1.0, 1.0), 0.0),
        ((0.0, 1e-11), (1.0, 1.0), 0.0),
    ],
)
def test_the_least_pivot_is_the_largest_entry_in_the_units_of_the_run(closing, x, other, expected):
    """J = (2 x, 2 y), with columns in units of those at another state; 0 for a pivot that counts as zero."""
    found = closing.pivot_in_units(np.array([*x, 0.0, 0.0]), np.array([*other, 0.0, 0.0]), returns=ctypes.c_double)
    assert found == pytest.approx(expected, rel=1e-14)
