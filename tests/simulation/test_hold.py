"""Tables of the kind "hold": zero-order holds of inputs, wherever inputs are tables."""

import pickle

import numpy as np
import pytest
from builders.oscillators import driven_oscillator
from builders.prescribed import driven_pendulum
from scipy.linalg import solve_continuous_are

import fourbar_codegen as fb

TIMES = np.array([0.2, 0.5, 0.6, 1.1])
VALUES = np.array([3.0, -2.0, 4.0, 1.0])
TABLE = {"F": (TIMES, VALUES, "hold")}
MASS = 2.0
TIGHT = {"rtol": 1e-10, "atol": 1e-12}


@pytest.fixture(scope="module")
def free():
    """A mass without a spring, x'' = F / m: its motion is of second degree between the points of a table."""
    return fb.compile_model(driven_oscillator(parameters={"k": 0.0}))


def changes(t):
    """The derivatives of x and v, from rest at t = 0, with respect to the values of the table, shape (4, 2, n_t)."""
    begins, ends = np.array([0.0, *TIMES[1:]]), np.array([*TIMES[1:], np.inf])
    since, until = (np.maximum(t - at[:, np.newaxis], 0.0) for at in (begins, ends))
    return np.stack([since**2 - until**2, 2.0 * (since - until)], axis=1) / (2.0 * MASS)


def motion(t):
    return np.einsum("i,ixt->xt", VALUES, changes(t))


METHODS = {name: {"method": name, **TIGHT} for name in ("RK45", "DOP853", "Tsit5", "Radau", "CVODE", "IDA")} | {
    "ALI3P": {"method": "ALI3P", "max_step": 1e-3}
}


@pytest.mark.parametrize("method", METHODS)
def test_held_table_in_every_method_holds_each_value_until_the_next(free, method):
    t = np.array([0.0, 0.1, 0.3, *TIMES[1:], 1.3])
    run = free.simulate((0.0, 1.3), inputs=TABLE, t_eval=t, **METHODS[method])
    # Multistep methods and the trapezoidal rule have errors of their tolerances, 1e-10, over some hundred steps.
    np.testing.assert_allclose(run.y, motion(t), rtol=0, atol=1e-8)
    np.testing.assert_array_equal(run["F"], [3.0, 3.0, 3.0, -2.0, 4.0, 1.0, 1.0])
    back = free.simulate((1.3, 0.0), motion(t[-1:])[:, 0], inputs=TABLE, t_eval=t[::-1], **METHODS[method])
    np.testing.assert_allclose(back.y, motion(t)[:, ::-1], rtol=0, atol=1e-8)


def test_held_table_ends_steps_only_where_its_value_changes(free):
    held = free.simulate((0.0, 2.0), inputs={"F": (np.linspace(0.0, 2.0, 2001), np.full(2001, 3.0), "hold")}, **TIGHT)
    assert held.nfev == free.simulate((0.0, 2.0), inputs={"F": 3.0}, **TIGHT).nfev
    assert set(TIMES[1:]) <= set(free.simulate((0.0, 2.0), inputs=TABLE, **TIGHT).t)


@pytest.mark.parametrize("how", [{}, {"constraints": "none"}])
def test_sensitivities_and_gradients_by_held_values_equal_closed_forms(free, how):
    t = np.array([0.1, 0.5, 0.55, 1.1, 1.3])
    run = free.simulate((0.0, 1.3), inputs=TABLE, t_eval=t, sensitivities=["F", "m"], gradient=True, **TIGHT, **how)
    # Polynomials of degree two, which Runge-Kutta methods integrate to rounding errors.
    np.testing.assert_allclose(run.sensitivity["F"], changes(t), rtol=0, atol=1e-14)
    np.testing.assert_allclose(run.sensitivity["m"], -motion(t) / MASS, rtol=0, atol=1e-14)
    cost = np.random.default_rng(1).standard_normal((2, len(t)))
    np.testing.assert_allclose(run.gradient(cost)["F"], (changes(t) * cost).sum(axis=(1, 2)), rtol=0, atol=1e-14)
    # At a point of equal values, the run does not change, but its derivatives do.
    alike = {"F": (TIMES, np.full(4, 3.0), "hold")}
    run = free.simulate((0.0, 1.3), inputs=alike, t_eval=t, sensitivities=["F"], gradient=True, **TIGHT, **how)
    np.testing.assert_allclose(run.sensitivity["F"], changes(t), rtol=0, atol=1e-14)
    np.testing.assert_allclose(run.gradient(cost)["F"], (changes(t) * cost).sum(axis=(1, 2)), rtol=0, atol=1e-14)
    # Dense output, and runs that go backwards.
    run = free.simulate((1.3, 0.0), motion(t[-1:])[:, 0], inputs=TABLE, sensitivities=["F"], dense_output=True, **TIGHT)
    by_values = changes(t)
    late = by_values[:, :, -1:]  # with the state at 1.3 held: v(t) less v(1.3), and x(t) less that of a straight line
    by_values[:, 0] -= late[:, 0] + late[:, 1] * (t - 1.3)
    by_values[:, 1] -= late[:, 1]
    np.testing.assert_allclose(run.sol.sensitivity(t)["F"], by_values, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_gradient_by_ten_thousand_held_values_equals_the_closed_form(free):
    """Of ten thousand values, in memory that is proportional to their number."""
    times = np.arange(10_000) * 1e-3
    force = np.cos(times)
    run = free.simulate((0.0, 10.0), inputs={"F": (times, force, "hold")}, t_eval=[10.0], gradient=True)
    np.testing.assert_allclose(run.gradient({"v": [1.0]})["F"], 1e-3 / MASS, rtol=1e-9)
    np.testing.assert_allclose(run["v"][-1], force.sum() * 1e-3 / MASS, rtol=0, atol=1e-12)


def test_members_of_an_ensemble_with_a_held_table_equal_closed_forms(free):
    t, masses = np.array([0.0, 0.5, 0.7, 1.3]), np.linspace(1.0, 4.0, 9)
    ensemble = free.ensemble((0.0, 1.3), [0.0, 0.0], parameters={"m": masses}, inputs=TABLE, t_eval=t, **TIGHT)
    assert ensemble.success.all()
    for member, mass in enumerate(masses):
        np.testing.assert_allclose(ensemble.y[member], motion(t) * MASS / mass, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(ensemble[3]["F"], [3.0, -2.0, 4.0, 1.0])


@pytest.mark.parametrize("h", [0.05, 0.1, 0.13, -0.1])
def test_stepper_with_a_held_table_is_exact_across_its_jumps(free, h):
    """Also within a step, and the last stage of a step that ends there has the value before it."""
    start = 0.0 if h > 0.0 else 1.3
    stepper = free.stepper(h, motion(np.array([start]))[:, 0], t=start, inputs=TABLE)
    for k in range(1, 13):
        if k == 5:
            stepper = pickle.loads(pickle.dumps(stepper))
        stepper.step()
        assert stepper.t == start + k * h
        np.testing.assert_allclose(stepper.x, motion(np.array([stepper.t]))[:, 0], rtol=0, atol=1e-14)


def test_stepper_with_a_held_table_far_into_the_future_keeps_earlier_times_apart(free):
    """Times far ahead do not make those before them equal."""
    stepper = free.stepper(0.25, [0.0, 0.0], inputs={"F": ([0.0, 0.5, 1e300], [4.0, 0.0, 1.0], "hold")})
    for _ in range(4):
        stepper.step()
    np.testing.assert_allclose(stepper.x, [0.75, 1.0], rtol=0, atol=1e-15)


def upright_linkage():
    """The linkage of examples/06_feedback_control.py, its gains and its state of rest."""
    four_bar, loose = fb.load("four_bar"), {"k": 0.0, "c": 0.0}
    upright = four_bar.equilibrium([0.8, 1.6, 1.2], parameters=loose, inputs={"F": 0.0})
    A, B = four_bar.linearize(0.0, upright, loose, {"F": 0.0})
    gain = B.T @ solve_continuous_are(A, B, np.diag([1.0, 0.1]), np.array([[1e-6]])) / 1e-6
    start = four_bar.initial_state([upright[0] + 0.1], [0.0], guess=upright[1:3], parameters=loose)
    return four_bar, loose, start, lambda x: float((gain @ (upright - x)[[0, 3]])[0])


def test_held_table_of_recorded_controls_repeats_the_control_loop_by_every_method():
    """A controller of 1 kHz; with ten steps a sample, the error of RK4, h^4 / 120 times the fifth derivative, is below
    1e-14 a second."""
    four_bar, loose, start, force = upright_linkage()
    stepper, times, forces, states = four_bar.stepper(1e-4, start, parameters=loose), [], [], []
    for _ in range(1000):
        times.append(stepper.t)
        states.append(stepper.x)
        forces.append(force(stepper.x))
        for _ in range(10):
            stepper.step({"F": forces[-1]})
    table = {"F": (times, forces, "hold")}
    how = {"parameters": loose, "inputs": table, "t_eval": times, "rtol": 1e-13, "atol": 1e-13}
    span = (0.0, times[-1])
    for method in ("DOP853", "RK45", "Tsit5"):
        run = four_bar.simulate(span, start, method=method, **how)
        np.testing.assert_allclose(run.y, np.transpose(states), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(run["F"], forces)
    ensemble = four_bar.ensemble(span, np.tile(start, (5, 1)), **how)
    assert ensemble.success.all()
    np.testing.assert_allclose(ensemble.y[4], np.transpose(states), rtol=0, atol=1e-12)
    again = four_bar.stepper(1e-4, start, parameters=loose, inputs=table)
    for state in states:
        np.testing.assert_array_equal(again.x, state)
        for _ in range(10):
            again.step()


@pytest.mark.slow(but=[".csv", ".npz"])
@pytest.mark.parametrize("suffix", [".npz", ".nc", ".csv"])
def test_run_with_a_held_table_read_from_a_file_holds_values_between_samples(free, tmp_path, suffix):
    """A run that was read from a file still holds the values between its samples."""
    run = free.simulate((0.0, 1.3), inputs=TABLE, **TIGHT)
    path = run.save(tmp_path / f"run{suffix}")
    if suffix == ".csv":
        rows = np.genfromtxt(path, delimiter=",", names=True)
        np.testing.assert_array_equal(rows["F"], run["F"])
        return
    read = fb.load_trajectory(path, free)
    np.testing.assert_array_equal(read["F"], run["F"])
    t = np.array([0.1, 0.4, 0.5, 0.55, 1.2])
    for one in (run, read):
        np.testing.assert_array_equal(one.resample(t)["F"], [3.0, 3.0, -2.0, -2.0, 1.0])
        np.testing.assert_allclose(one.resample(t).y, motion(t), rtol=0, atol=1e-12)


def test_held_table_for_a_prescribed_motion_is_refused():
    pendulum = fb.compile_model(driven_pendulum(None))
    with pytest.raises(fb.ModelError, match=r"s prescribes a motion, which cannot jump .* linear, pchip or cubic"):
        pendulum.simulate((0.0, 1.0), [0.0, 0.0], inputs={"s": ([0.0, 0.5], [0.0, 0.1], "hold")})


def test_gradient_by_held_values_in_jax_equals_the_closed_form(free):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    try:
        simulate = fb.to_jax(free).simulation((0.0, 1.3), [1.3], inputs=TABLE)
        gradient = jax.grad(lambda force: simulate(inputs={"F": force})["x"][0])(VALUES)
    finally:
        jax.config.update("jax_enable_x64", False)
    np.testing.assert_allclose(gradient, changes(np.array([1.3]))[:, 0, 0], rtol=0, atol=1e-12)


def test_member_of_an_ensemble_read_from_a_file_holds_values_between_samples(four_bar, tmp_path):
    held = {"F": (np.array([0.0, 0.5, 1.0]), np.array([1.0, 0.6, 0.2]), "hold")}
    member = four_bar.ensemble((0.0, 1.0), inputs=held, t_eval=np.linspace(0.0, 1.0, 11))[0]
    back = fb.load_trajectory(member.save(tmp_path / "member.npz"))
    np.testing.assert_array_equal(back.resample([0.48, 0.52])["F"], [1.0, 0.6])
