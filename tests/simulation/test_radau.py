"""Radau IIA of order 5: order, stiff problems with published values, linear systems, loops, ensembles."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import circling, on_a_line, oscillator
from builders.state_equations import first_order, hires, robertson, van_der_pol
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import fourbar_codegen as fb

LINEAR = 3
"""States of the linear systems."""


PROBLEMS = {
    "HIRES": (hires, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057], 321.8122, {2: 7.371312573325668e-4, 9: 2.8500016e-3}),
    "Robertson": (robertson, [1.0, 0.0, 0.0], 40.0, {2: 0.7158270688, 3: 9.185534765e-6, 4: 0.2841637457}),
}
"""E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.10, and the Test Set for IVP Solvers;
the states before those of the equations are of a mass at rest."""


def errors_of_steps(run, exact, lengths):
    """The errors at the end of runs with steps of fixed lengths: tolerances so wide that max_step decides."""
    return np.array([np.abs(run(max_step=h, rtol=0.9, atol=1e3).y[:, -1] - exact).max() for h in lengths])


def test_the_order_is_five():
    """On x = 0.3 cos 2 t: errors of steps that are half as long are 2^-5 of these."""
    model = fb.compile_model(oscillator())
    exact = [0.3 * np.cos(4.0), -0.6 * np.sin(4.0)]
    errors = errors_of_steps(
        lambda **how: model.simulate((0.0, 2.0), method="Radau", **how), exact, 0.2 / 2.0 ** np.arange(3)
    )
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize("constraints", ["project", "none"])
def test_the_order_is_five_with_a_loop(constraints):
    model, parameters, x0, exact = circling()
    errors = errors_of_steps(
        lambda **how: model.simulate(
            (0.0, 2.0), x0, method="Radau", parameters=parameters, constraints=constraints, **how
        ),
        exact,
        0.4 / 2.0 ** np.arange(3),
    )
    assert np.log2(errors[:-1] / errors[1:]) == pytest.approx(5.0, abs=0.3)


@pytest.mark.parametrize("name", PROBLEMS)
def test_published_values_of_stiff_problems(name):
    rates, start, end, expected = PROBLEMS[name]
    model = fb.compile_model(first_order(name.lower(), rates, start))
    run = model.simulate((0.0, end), method="Radau", rtol=1e-9, atol=1e-14)
    assert run.success, run.message
    for state, value in expected.items():
        assert run.y[state, -1] == pytest.approx(value, rel=1e-7)
    assert len(run.t) < 2000


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_van_der_pols_equation_forwards_and_backwards(direction):
    """Backwards with the rates reversed."""
    model = first_order("van_der_pol", lambda *y: [direction * rate for rate in van_der_pol(*y)], [2.0, 0.0])
    run = fb.compile_model(model).simulate((0.0, 2.0 * direction), method="Radau", rtol=1e-10, atol=1e-10)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[2:, -1], [1.706167732170483, -0.892809701024795], rtol=1e-7)
    assert len(run.t) < 20_000


@pytest.fixture(scope="module")
def linear():
    """x' = A x, with the entries of A as parameters."""
    entries = sm.Matrix(LINEAR, LINEAR, sm.symbols(f"a:{LINEAR**2}"))
    values = dict.fromkeys(entries, 0.0)
    model = first_order("linear", lambda *x: list(entries * sm.Matrix(x)), [1.0] * LINEAR, parameters=values)
    return fb.compile_model(model)


def test_a_thousand_stiff_linear_systems_are_the_exponential(linear):
    """Decays of 1e0 to 1e6 1/s, some of which turn; in one ensemble on all cores. Errors are some steps' tolerances."""
    generator = np.random.default_rng(0)
    matrices = []
    for _ in range(1000):
        basis = np.linalg.qr(generator.normal(size=(LINEAR, LINEAR)))[0] + 0.3 * generator.normal(size=(LINEAR, LINEAR))
        decay, turn = 10.0 ** generator.uniform(0.0, 6.0, 2)
        block = np.zeros((LINEAR, LINEAR))
        block[0, 0] = -(10.0 ** generator.uniform(-1.0, 1.0))
        block[1:, 1:] = [[-decay, min(turn, decay)], [-min(turn, decay), -decay]]
        matrices.append(basis @ block @ np.linalg.inv(basis))
    matrices = np.array(matrices)
    names = {f"a{i}": matrices.reshape(1000, -1)[:, i] for i in range(LINEAR**2)}
    x0 = np.concatenate((np.zeros(2), np.ones(LINEAR)))
    ensemble = linear.ensemble(
        (0.0, 1.0), np.tile(x0, (1000, 1)), parameters=names, method="Radau", rtol=1e-8, atol=1e-10, progress=False
    )
    assert ensemble.success.all()
    exact = np.array([expm(matrix) @ np.ones(LINEAR) for matrix in matrices])
    error = np.abs(ensemble.y[:, 2:, -1] - exact) / np.abs(x0).max()
    assert error.max() < 1e-6
    assert np.median(error.max(axis=1)) < 1e-8
    assert np.median(ensemble.nfev) < 3000


def test_members_of_an_ensemble_are_single_runs(linear):
    names = {"a0": [-1e5, -1e3], "a4": [-2.0, -3.0], "a8": [-4.0, -5.0], "a1": [1e3, 10.0]}
    how = {"method": "Radau", "rtol": 1e-6, "t_eval": np.linspace(0.0, 1.0, 11), "events": "y1"}
    ensemble = linear.ensemble((0.0, 1.0), parameters=names, **how)
    for member in range(2):
        run = linear.simulate((0.0, 1.0), parameters={name: each[member] for name, each in names.items()}, **how)
        np.testing.assert_array_equal(ensemble.y[member], run.y)
        assert ensemble.nfev[member] == run.nfev


def test_counts_and_interpolant_of_a_run():
    """A Jacobian in each step, and two factorizations for each of its attempts."""
    model = fb.compile_model(oscillator())
    run = model.simulate((0.0, 2.0), method="Radau", rtol=1e-8, atol=1e-8, dense_output=True)
    steps = len(run.t) - 1
    assert run.njev == steps
    assert steps <= run.nlu / 2 <= 1.5 * steps
    assert 6 * steps < run.nfev < 25 * steps
    # The collocation polynomial is of order 3 between the ends of steps.
    times = np.linspace(0.0, 2.0, 201)
    np.testing.assert_allclose(run.sol(times)[0], 0.3 * np.cos(2.0 * times), rtol=0, atol=1e-5)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
def test_values_between_steps_that_are_longer_than_the_motion(tolerance):
    """y' = k (sin 5 t - y) from y = -5 k / (k² + 25): where values between steps are asked for, their errors limit the
    steps, as nothing else does."""
    k, t = 1e6, me.dynamicsymbols._t
    lag = fb.compile_model(first_order("lag", lambda y: [k * (sm.sin(5 * t) - y)], [-5.0 * k / (k**2 + 25.0)]))

    def exact(t):
        return (k**2 * np.sin(5.0 * t) - 5.0 * k * np.cos(5.0 * t)) / (k**2 + 25.0)

    how = {"method": "Radau", "rtol": tolerance, "atol": tolerance}
    times = np.linspace(0.0, 10.0, 501)
    sampled = lag.simulate((0.0, 10.0), t_eval=times, **how)
    dense = lag.simulate((0.0, 10.0), dense_output=True, events=["y1"], **how)
    for values in (sampled.y[2], dense.sol(times)[2], lag.ensemble((0.0, 10.0), t_eval=times, **how).y[0, 2]):
        np.testing.assert_allclose(values, exact(times), rtol=0, atol=10.0 * tolerance)
    # The error of a time is that of the state over its rate, 5/s.
    np.testing.assert_allclose(dense.t_events[0], np.pi / 5.0 * np.arange(16) + 1.0 / k, rtol=0, atol=2.0 * tolerance)
    assert len(lag.simulate((0.0, 10.0), **how).t) < len(dense.t)


def test_stiff_feedback_by_a_callable_is_in_the_jacobian(four_bar):
    """As many steps as by an input of the equations: a Jacobian without feedback would need thousands."""
    gain, x0 = 1e5, four_bar.initial_state()
    how = {"method": "Radau", "rtol": 1e-7, "atol": 1e-8}
    run = four_bar.simulate((0.0, 1.0), x0, inputs={"F": lambda t, x: -gain * x[3]}, **how)
    assert run.success
    assert len(run.t) < 150
    ode = four_bar.ode(inputs={"F": lambda t, x: -gain * x[3]})
    exact = solve_ivp(ode, (0.0, 1.0), x0, method="LSODA", rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run.y[:, -1], exact.y[:, -1], rtol=0, atol=1e-6)


def test_a_stiff_stabilization_is_in_the_jacobian(four_bar):
    how = {"method": "Radau", "constraints": "baumgarte", "stabilization": 1e4, "rtol": 1e-8, "atol": 1e-8}
    run = four_bar.simulate((0.0, 1.0), **how)
    assert run.success
    assert len(run.t) < 1000
    exact = four_bar.simulate((0.0, 1.0), rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(run.y[:, -1], exact.y[:, -1], rtol=0, atol=1e-7)


def test_a_bouncing_mass_returns_to_its_height():
    """1 kg falls from 10 m, to a speed v, on a spring of 1e7 N/m: a bounce lasts 2 (pi - atan(v w / g)) / w."""
    x, stiffness, g, height = me.dynamicsymbols("x"), 1e7, 9.81, 10.0
    force = sm.Piecewise((-stiffness * x, x < 0), (0, True)) - sm.Float(g)
    model = fb.compile_model(fb.Model(on_a_line(1, force), name="bounces"))
    fall, speed, w = np.sqrt(2.0 * height / g), np.sqrt(2.0 * g * height), np.sqrt(stiffness)
    period = 2.0 * fall + 2.0 / w * (np.pi - np.arctan(speed * w / g))
    run = model.simulate((0.0, 2.0 * period), [height, 0.0], method="Radau", rtol=1e-8, atol=1e-8)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[:, -1], [height, 0.0], rtol=0, atol=1e-5)


def test_methods_without_sensitivities_name_those_that_have_them(four_bar):
    with pytest.raises(fb.ModelError, match="Radau has no sensitivities: use DOP853"):
        four_bar.simulate((0.0, 1.0), method="Radau", sensitivities=["k"])
    with pytest.raises(fb.ModelError, match="Radau has no gradient: use DOP853"):
        four_bar.simulate((0.0, 1.0), method="Radau", gradient=True)
