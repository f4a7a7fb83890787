"""Steppers by Radau IIA: order, stiff forces and feedback, contacts, events, tables, copies."""

import pickle

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import circling, on_a_line, oscillator
from builders.state_equations import first_order
from scipy.integrate import solve_ivp

import fourbar_codegen as fb


def end_of(stepper, steps, r=None):
    for _ in range(steps):
        stepper.step(r)
    return stepper.x


def test_the_order_is_five():
    """On x = 0.3 cos 2 t: errors of steps that are half as long are 2^-5 of these."""
    model, exact = fb.compile_model(oscillator()), [0.3 * np.cos(4.0), -0.6 * np.sin(4.0)]
    errors = np.array([np.abs(end_of(model.stepper(2.0 / n, method="Radau"), n) - exact).max() for n in (10, 20, 40)])
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("constraints", ["project", "none"])
def test_the_order_is_five_with_a_loop(constraints):
    model, parameters, x0, exact = circling()
    how = {"parameters": parameters, "constraints": constraints, "method": "Radau"}
    errors = np.array([np.abs(end_of(model.stepper(2.0 / n, x0, **how), n) - exact).max() for n in (5, 10, 20)])
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(5.0, abs=0.3)


def test_steps_are_a_thousand_times_longer_than_the_stability_of_rk4():
    """y' = -k (y - cos t) with k = 1e6: y = (k² cos t + k sin t) / (k² + 1), but for what has decayed."""
    k, h = 1e6, 0.01
    start = [k**2 / (k**2 + 1.0)]
    model = fb.compile_model(first_order("relaxation", lambda y: [-k * (y - sm.cos(me.dynamicsymbols._t))], start))
    x = end_of(model.stepper(h, method="Radau"), 200)
    assert x[2] == pytest.approx((k**2 * np.cos(2.0) + k * np.sin(2.0)) / (k**2 + 1.0), rel=0, abs=1e-10)
    with pytest.raises(fb.SimulationError, match="not finite"):
        end_of(model.stepper(h), 200)  # grows by (k h)^4 / 24 in each step


def test_stiff_feedback_that_is_held_and_that_is_not(four_bar):
    """A damper by a callable is in the Jacobian, by difference quotients; held inputs are constant in a step."""
    gain, x0 = 1e5, four_bar.initial_state()
    damped = four_bar.stepper(0.02, x0, inputs={"F": lambda t, x: -gain * x[3]}, method="Radau")
    ode = four_bar.ode(inputs={"F": lambda t, x: -gain * x[3]})
    exact = solve_ivp(ode, (0.0, 1.0), x0, method="LSODA", rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(end_of(damped, 50), exact.y[:, -1], rtol=0, atol=1e-6)
    held = four_bar.stepper(0.02, x0, method="Radau")
    table = ([0.0, 1.0], [3.0, 3.0])
    exact = four_bar.simulate((0.0, 1.0), x0, inputs={"F": table}, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(end_of(held, 50, {"F": 3.0}), exact.y[:, -1], rtol=0, atol=1e-6)


def test_a_contact_in_long_steps():
    """A mass falls from 1 m on a spring of 1e6 N/m with a damper, until it rests on it at -m g / k. Equations of steps
    that reach the contact have no solution; shorter ones have."""
    x, v = me.dynamicsymbols("x v")
    force = sm.Piecewise((-1e6 * x - 1e4 * v, x < 0), (0, True)) - sm.Float(9.81)
    model = fb.compile_model(fb.Model(on_a_line(1, force), name="lands", initial={x: 1.0, v: 0.0}))
    stepper = model.stepper(0.05, method="Radau")
    end_of(stepper, 100)
    assert stepper.t == pytest.approx(5.0, rel=1e-15)
    np.testing.assert_allclose(stepper.x, [-9.81e-6, 0.0], rtol=0, atol=1e-9)


def test_events_tables_and_copies(four_bar):
    """Events by the collocation polynomial, of order 3; a table's point divides a step; copies go on to the bit."""
    model = fb.compile_model(oscillator())
    stepper, found = model.stepper(0.05, method="Radau", events=["x"]), []
    for _ in range(100):
        stepper.step()
        found += [float(t) for t in stepper.t_events[0]]
    np.testing.assert_allclose(found, np.pi / 4.0 + np.pi / 2.0 * np.arange(3), rtol=0, atol=1e-6)
    x0, table = four_bar.initial_state(), ([0.0, 0.155, 0.3], [0.0, 5.0, -5.0])
    first = four_bar.stepper(0.01, x0, inputs={"F": table}, method="Radau")
    end_of(first, 10)
    second = pickle.loads(pickle.dumps(first))
    np.testing.assert_array_equal(end_of(first, 20), end_of(second, 20))
    exact = four_bar.simulate((0.0, 0.3), x0, inputs={"F": table}, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(first.x, exact.y[:, -1], rtol=0, atol=1e-9)


def test_a_step_that_cannot_be_taken_changes_nothing():
    """v' = -sqrt(0.5 - x) has no value beyond x = 0.5."""
    x = me.dynamicsymbols("x")
    model = fb.compile_model(fb.Model(on_a_line(1, -sm.sqrt(0.5 - x)), name="ends"))
    stepper = model.stepper(0.1, [0.4, 2.0], method="Radau")
    with pytest.raises(fb.SimulationError, match="t = 0"):
        stepper.step()
    assert stepper.t == 0.0
    np.testing.assert_array_equal(stepper.x, [0.4, 2.0])
    with pytest.raises(fb.ModelError, match=r"'Euler'.*RK4, Radau"):
        model.stepper(0.1, [0.4, 2.0], method="Euler")
