"""Runs in C: SciPy's steps, loops that stay closed, singular positions, events."""

import _thread
import dataclasses
import re
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import on_a_line
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
import fourbar_codegen.simulation.integrate
import fourbar_codegen.simulation.run_options

METHODS = ["RK45", "DOP853"]

MODELS = {
    "four_bar": (fb.models.four_bar, None, None),
    "chain": (lambda: fb.models.chain(3), None, None),
    "slider_crank": (fb.models.slider_crank, None, None),
    "rolling_disc": (fb.models.rolling_disc, {"q3": 0.4}, None),
    "whipple_bicycle": (fb.models.whipple_bicycle, {"q4": 0.1}, {"u6": -15.0, "u4": 0.3}),
    "n_four_bar": (lambda: fb.models.n_four_bar(4), {"p0": 0.1}, None),  # for half a second: it is singular when level
    "cartesian_pendulum": (fb.models.cartesian_pendulum, {"y": 0.0}, None),
}


@pytest.fixture(scope="module", params=MODELS)
def case(request):
    """A compiled model, a state that it is in motion from, and for how long to simulate it."""
    make, coordinates, speeds = MODELS[request.param]
    compiled = fb.compile_model(make())
    duration = 0.5 if request.param == "n_four_bar" else 1.0
    return compiled, compiled.initial_state(coordinates, speeds), duration


@pytest.mark.parametrize("method", METHODS)
def test_tableau_coefficients_of_each_method_equal_scipys_to_the_bit(method):
    text = (Path(fb.get_include()) / "steppers/tableaus.h").read_text()

    def array(name):
        numbers = re.search(rf"\bfb_{method.lower()}_{name}\[\d+\] = {{(.*?)}};", text, flags=re.DOTALL)[1]
        return np.array([float(number) for number in numbers.split(",")])

    scipys = getattr(scipy.integrate, method)
    stages = scipys.n_stages
    np.testing.assert_array_equal(array("a").reshape(stages, stages)[:, : scipys.A.shape[1]], scipys.A)
    np.testing.assert_array_equal(array("b"), scipys.B)
    np.testing.assert_array_equal(array("c"), scipys.C)
    if method == "RK45":
        np.testing.assert_array_equal(array("error"), scipys.E)
        np.testing.assert_array_equal(array("dense"), scipys.P.T.ravel())
    else:
        np.testing.assert_array_equal(array("error"), [*scipys.E5, *scipys.E3])
        np.testing.assert_array_equal(array("dense"), scipys.D.ravel())
        np.testing.assert_array_equal(array("a_extra"), scipys.A_EXTRA.ravel())
        np.testing.assert_array_equal(array("c_extra"), scipys.C_EXTRA)


@pytest.mark.slow(
    but=[
        "cartesian_pendulum-False-0.001-DOP853",
        "cartesian_pendulum-False-0.001-RK45",
        "cartesian_pendulum-False-1e-06-DOP853",
        "cartesian_pendulum-False-1e-06-RK45",
    ]
)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("forward", [True, False])
def test_runs_without_projection_take_scipys_steps(case, method, tolerance, forward):
    compiled, x0, duration = case
    end = duration if forward else -0.7 * duration
    how = {"rtol": tolerance, "atol": np.full(compiled.n_x, tolerance), "max_step": 0.4, "dense_output": True}
    scipys = solve_ivp(compiled.ode(), (0.0, end), x0, method=method, **how)
    ours = compiled.simulate((0.0, end), x0, method=method, constraints="none", **how)
    assert (ours.nfev, len(ours.t), ours.status) == (scipys.nfev, len(scipys.t), 0)
    # The error estimate is a difference of sums of the size of 1, of which rounding errors of 1e-16 remain: where it is
    # 1e-9, seven digits are known, and where it happens to vanish, none. So steps may differ a little, and solutions by
    # as much as these change their truncation errors, which are of the size of the tolerance. (Where none vanishes,
    # steps agree to 1e-6: test_simulate.py, test_steps_in_c_are_scipys.)
    times = np.linspace(0.0, end, 50)
    scale = np.abs(scipys.y).max()
    np.testing.assert_allclose(ours.sol(times), scipys.sol(times), rtol=0, atol=0.1 * tolerance * scale)
    sampled = compiled.simulate((0.0, end), x0, method=method, constraints="none", t_eval=times, **how)
    # At the ends of steps, the interpolant rounds once more.
    np.testing.assert_allclose(sampled.y, ours.sol(times), rtol=0, atol=1e-15 * scale)
    np.testing.assert_array_equal(sampled.t, times)


@pytest.mark.slow(but=["cartesian_pendulum-DOP853", "cartesian_pendulum-Radau"])
@pytest.mark.parametrize("method", [*METHODS, "Radau"])
def test_states_at_steps_samples_and_between_them_satisfy_the_constraints(case, method):
    compiled, x0, duration = case
    times = np.linspace(0.0, duration, 33)
    how = {"method": method, "rtol": 1e-4, "atol": 1e-5}
    sampled = compiled.simulate((0.0, duration), x0, t_eval=times, **how)
    stepped = compiled.simulate((0.0, duration), x0, dense_output=method in METHODS, **how)
    assert sampled.success
    assert stepped.success
    states = [*zip(sampled.t, sampled.y.T, strict=True), *zip(stepped.t, stepped.y.T, strict=True)]
    if method in METHODS:
        states += list(zip(times, stepped.sol(times).T, strict=True))
        # Of the end of a step, the interpolant is another approximation by rounding errors, and is projected itself.
        np.testing.assert_allclose(stepped.sol(times), sampled.y, rtol=0, atol=1e-12 * np.abs(sampled.y).max())
    for t, x in states:
        positions, velocities = compiled.kernel.constraint_violation(t, x)
        jacobian, _ = compiled.kernel.velocity(t, x)
        # Rounding errors of a few dozen operations on coordinates and speeds.
        size = np.abs(jacobian).max(initial=0.0) * np.abs(x).max()
        assert np.abs(positions).max(initial=0.0) <= 1e-12 * size
        assert np.abs(velocities).max(initial=0.0) <= 1e-12 * size


@pytest.mark.slow(but=["cartesian_pendulum-DOP853", "cartesian_pendulum-RK45", "chain-DOP853"])
@pytest.mark.parametrize("method", METHODS)
def test_runs_with_projection_are_as_accurate_as_without(case, method):
    compiled, x0, duration = case
    exact = solve_ivp(compiled.ode(), (0.0, duration), x0, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    errors = {}
    for constraints in ("none", "project"):
        run = compiled.simulate((0.0, duration), x0, method=method, rtol=1e-7, atol=1e-7, constraints=constraints)
        errors[constraints] = np.abs(run.y[:, -1] - exact).max()
    # Both stay within the tolerances of some dozen steps; neither is the other's measure.
    assert errors["project"] <= 2.0 * errors["none"] + 1e-9 * np.abs(exact).max()


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
@pytest.mark.parametrize("method", METHODS)
def test_tutorial_linkage_run_over_20_s_stops_at_its_singular_position(four_bar, method, tolerance):
    # It is a change-point linkage, l1 + l4 = l2 + l3: whenever q1 reaches pi, all bars are collinear.
    run = four_bar.simulate((0.0, 20.0), method=method, rtol=tolerance, atol=1e-3 * tolerance)
    assert not run.success
    assert run.status == -1
    assert 5.3 < run.t[-1] < 6.0
    assert f"stopped at t = {run.t[-1]:.9g}" in run.message
    time, angle = re.search(r"singular position at t = (.*?), q1 = (.*?),", run.message).groups()
    assert abs(float(time) - run.t[-1]) < 0.3
    assert abs(np.sin(float(angle))) < 1e-3
    # Without projection SciPy's RK45 needs 290,858 evaluations to get through to t = 20 s.
    assert run.nfev < 10000


def test_four_bar_that_misses_a_singular_position_by_a_millimetre_passes_it(four_bar):
    # A millimetre more of l1 and the bars never are collinear. (The tutorial's spring feeds energy into a linkage that
    # turns around: it is left out.)
    parameters = {"l1": 0.801, "k": 0.0, "c": 0.0}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    run = four_bar.simulate((0.0, 20.0), x0, parameters=parameters, inputs={"F": 0.0}, rtol=1e-8, atol=1e-8)
    assert run.success
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=1e-4)
    assert np.abs(run.constraint_residual).max() < 1e-12


def linkage(driven):
    """A four-bar of massless-free textbook form, its angles from the ground, with one of them independent.

    Two pivots on the ground, ends of bars at angles q1 and q2, q3 for the bar between them.
    """
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    ground_length, a, b, c, m = sm.symbols("d a b c m")
    t = me.dynamicsymbols._t
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    ends = []
    for i, (base, length) in enumerate(((0, a), (ground_length * ground.x, b))):
        frame, end = me.ReferenceFrame(f"A{i}"), me.Point(f"E{i}")
        frame.orient_axis(ground, ground.z, q[i])
        frame.set_ang_vel(ground, u[i] * ground.z)
        end.set_pos(origin, base + length * frame.x)
        end.set_vel(ground, length * u[i] * frame.y)
        system.add_bodies(me.Particle(f"P{i}", end, m))
        ends.append((frame, end))
    coupler = me.ReferenceFrame("C")
    coupler.orient_axis(ground, ground.z, q[2])
    coupler.set_ang_vel(ground, u[2] * ground.z)
    gap = ends[1][1].pos_from(ends[0][1]) - c * coupler.x
    system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    order = [driven, *(i for i in range(3) if i != driven)]
    system.q_ind, system.q_dep = [q[driven]], [q[i] for i in order[1:]]
    system.u_ind, system.u_dep = [u[driven]], [u[i] for i in order[1:]]
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    return fb.compile_model(fb.Model(system, name=f"linkage_{driven}", inputs={}))


@pytest.mark.slow
@pytest.mark.parametrize(
    "lengths",
    [
        {"d": 4.0, "a": 1.0, "b": 3.0, "c": 3.5},  # Grashof: bar 1 turns around, bar 2 rocks
        {"d": 4.0, "a": 3.0, "b": 2.5, "c": 2.0},  # not Grashof: all bars rock
    ],
    ids=["crank-rocker", "non-Grashof"],
)
def test_four_bar_passes_dead_points_whichever_coordinate_is_independent(lengths):
    # Driven from bar 2, the dependent speeds do not follow from the independent one wherever it turns around; driven
    # from bar 1, the same where that does. The motion is one and the same.
    parameters = {**lengths, "m": 1.0}
    first, second = linkage(0), linkage(1)
    x1 = first.initial_state({"q1": 0.5}, {"u1": 1.5}, guess={"q2": 1.5, "q3": 0.5}, parameters=parameters)
    named = dict(zip(first.states, x1, strict=True))
    x2 = np.array([named[name] for name in second.states])
    how = {"parameters": parameters, "rtol": 1e-10, "atol": 1e-10, "t_eval": np.linspace(0.0, 20.0, 401)}
    runs = [first.simulate((0.0, 20.0), x1, **how), second.simulate((0.0, 20.0), x2, **how)]
    u2 = runs[0]["u2"]
    assert (u2[:-1] * u2[1:] < 0).sum() > 3  # it has turned around there
    for run in runs:
        assert run.success
        assert run.nfev < 20000
        # Nothing but the constraints acts: the energy stays, up to the tolerances of some hundred steps.
        np.testing.assert_allclose(run.kinetic_energy, run.kinetic_energy[0], rtol=1e-7)
        assert np.abs(run.constraint_residual).max() < 1e-11
    for name in first.states:
        np.testing.assert_allclose(runs[0][name], runs[1][name], rtol=0, atol=1e-6)


def test_conservative_four_bar_over_1000_s_keeps_its_energy(four_bar):
    parameters = {"k": 0.0, "c": 0.0, "l1": 0.9}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    run = four_bar.simulate((0.0, 1000.0), x0, parameters=parameters, inputs={"F": 0.0}, rtol=1e-10, atol=1e-10)
    assert run.success
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=1e-7)


def test_events_without_projection_equal_those_of_solve_ivp(four_bar):
    def turning(t, x):
        return x[3]

    def falling(t, x):
        return x[0] + 1.0

    falling.direction = -1.0
    x0 = four_bar.initial_state()
    how = {"rtol": 1e-10, "atol": 1e-10, "events": [turning, falling]}
    scipys = solve_ivp(four_bar.ode(), (0.0, 4.0), x0, method="DOP853", **how)
    ours = four_bar.simulate((0.0, 4.0), x0, constraints="none", **how)
    assert [len(times) for times in ours.t_events] == [len(times) for times in scipys.t_events]
    assert len(ours.t_events[0]) > 0
    for times, expected in zip(ours.t_events, scipys.t_events, strict=True):
        # Errors of 1e-10 in states that change by 1 per second.
        np.testing.assert_allclose(times, expected, rtol=0, atol=1e-8)
    for states, expected in zip(ours.y_events, scipys.y_events, strict=True):
        np.testing.assert_allclose(states, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("method", ["RK45", "DOP853", "CVODE"])
def test_terminal_event_at_a_step_boundary_is_kept_once_in_the_times_of_a_run(four_bar, method):
    steps = four_bar.simulate((0.0, 2.0), method=method).t
    for dense_output in (False, True):
        event = fb.Event(lambda t, x: t - steps[3], terminal=np.int64(1))
        run = four_bar.simulate((0.0, 2.0), method=method, events=event, dense_output=dense_output)
        np.testing.assert_array_equal(run.t_events[0], [steps[3]])
        np.testing.assert_array_equal(run.t, steps[:4])
        assert run.y.shape == (6, 4)


@pytest.mark.parametrize("t_eval", [None, np.linspace(0.0, 3.0, 61)])
def test_run_with_an_output_as_terminal_event_ends_at_its_second_sign_change(t_eval):
    crank = fb.compile_model(fb.models.slider_crank())
    name = crank.outputs[0]
    x0 = crank.initial_state()
    free = crank.simulate((0.0, 3.0), x0, t_eval=np.linspace(0.0, 3.0, 3001))
    values = free[name]
    crossings = np.flatnonzero(values[:-1] * values[1:] < 0)
    assert len(crossings) >= 2
    run = crank.simulate((0.0, 3.0), x0, t_eval=t_eval, events=fb.Event(name, terminal=2))
    assert (run.status, run.success) == (1, True)
    assert free.t[crossings[1]] <= run.t_events[0][1] <= free.t[crossings[1] + 1]
    assert len(run.t_events[0]) == 2
    assert run.t[-1] == run.t_events[0][1]
    assert abs(run[name][-1]) < 1e-8 * np.abs(values).max()
    if t_eval is not None:
        n = run.t.size - 1
        np.testing.assert_array_equal(run.t[:n], t_eval[:n])
        assert run.t[-1] < t_eval[n]
    rising = crank.simulate((0.0, 3.0), x0, events=[fb.Event(name, direction=1), fb.Event(name, direction=-1)])
    up, down = rising.t_events
    assert len(up) + len(down) == len(crossings)
    assert all(values[np.searchsorted(free.t, t)] >= 0 for t in up)


def falling(*further, **more):
    """x'' = -g + c x'^2, a fall with drag; and further forces."""
    (x, v), (g, c) = me.dynamicsymbols("x v"), sm.symbols("g c")
    system = on_a_line(1, c * v**2 - g + sum(further))
    more = {"outputs": {"height": x}, **more}
    return fb.Model(system, name="falling", parameters={g: 10.0, c: 0.01}, initial={x: 1000.0, v: 0.0}, **more)


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5", "Radau", "CVODE", "IDA", "ALI3P"])
@pytest.mark.parametrize("function", ["height", lambda t, x: x[0]])
def test_the_last_sample_is_the_state_at_a_terminal_event(method, function):
    """The height is 1000 m - ln(cosh(sqrt(g c) t)) / c, until t = 33.81470044 s at the ground."""
    model, t_eval = fb.compile_model(falling()), np.linspace(0.0, 40.0, 100)
    ground = np.arccosh(np.exp(0.01 * 1000.0)) / np.sqrt(0.1)
    assert ground == pytest.approx(33.81470044, abs=5e-9)
    how = {"max_step": 1e-2} if method == "ALI3P" else {"rtol": 1e-9, "atol": 1e-9}
    run = model.simulate((0.0, 40.0), method=method, t_eval=t_eval, events=fb.Event(function, terminal=True), **how)
    assert run.status == 1
    assert run.t[-1] == run.t_events[0][0] == pytest.approx(ground, abs=1e-4 if method == "ALI3P" else 1e-6)
    np.testing.assert_array_equal(run.y[:, -1], run.y_events[0][0])
    assert run.r.shape[1] == run.y.shape[1] == run.t.size
    n = np.searchsorted(t_eval, ground)
    np.testing.assert_array_equal(run.t[:-1], t_eval[:n])


def test_a_sample_asked_for_at_a_terminal_event_is_not_taken_twice(four_bar):
    """Within a step, at the end of one, and at the start of the run."""
    steps = four_bar.simulate((0.0, 1.0)).t
    for method in ("DOP853", "Radau"):
        for at in (0.5, float(steps[3]), 0.0):
            event = fb.Event(lambda t, x, at=at: t - at, terminal=True)
            times = np.array([0.0, 0.1, 0.25, at, 1.0]) if at else np.array([0.0, 1.0])
            event = dataclasses.replace(event, at_start=True)
            run = four_bar.simulate((0.0, 1.0), method=method, t_eval=np.unique(times), events=event)
            asked = np.unique(times)[np.unique(times) < run.t_events[0][0]]
            np.testing.assert_array_equal(run.t, [*asked, run.t_events[0][0]])


def test_a_terminal_event_before_all_samples_is_the_only_one(four_bar):
    for method in ("DOP853", "Radau"):
        event = fb.Event(lambda t, x: t - 0.5, terminal=True)
        run = four_bar.simulate((0.0, 1.0), method=method, t_eval=[0.9], events=event)
        assert run.t.tolist() == [run.t_events[0][0]]


def test_a_terminal_event_at_a_jump_of_an_input_is_the_last_sample():
    """An output that jumps with the force, at t = 0.5."""
    force = me.dynamicsymbols("F")
    pushed = fb.compile_model(falling(force, inputs="auto", outputs={"push": force - 1}))
    inputs = {"F": ([0.0, 0.5], [0.0, 2.0], "hold")}
    for method in ("DOP853", "Radau"):
        run = pushed.simulate(
            (0.0, 1.0), method=method, t_eval=[0.2, 0.9], inputs=inputs, events=fb.Event("push", terminal=True)
        )
        assert run.status == 1
        np.testing.assert_allclose(run.t, [0.2, 0.5], rtol=0.0, atol=1e-12)
        assert run.y.shape == (2, 2)


@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_a_message_has_the_energy_at_a_terminal_event_and_not_that_of_the_step_beyond_it(method):
    """A cart pushed by 1 N from 0.03 m/s: the kinetic energy grows 280-fold until 0.5 m/s, and further in the step."""
    x, v = me.dynamicsymbols("x v")
    cart = fb.compile_model(fb.Model(on_a_line(1, 1), name="cart", initial={x: 0.0, v: 0.03}))
    event = fb.Event(lambda t, x: x[1] - 0.5, terminal=True)
    messages = {
        cart.simulate((0.0, 100.0), method=method, t_eval=t_eval, events=event).message for t_eval in (None, [0.0, 9.0])
    }
    assert messages == {"A termination event occurred."}


def test_gradients_refer_to_the_samples_before_a_terminal_event():
    """d/dg of the height at 1 s, the only sample asked for before the end, by finite differences of the closed form."""
    model = fb.compile_model(falling())
    run = model.simulate(
        (0.0, 40.0), t_eval=[1.0, 35.0], events=fb.Event("height", terminal=True), gradient=True, rtol=1e-10, atol=1e-10
    )
    assert run.t.size == 2

    def height(g):
        return 1000.0 - np.log(np.cosh(np.sqrt(g * 0.01) * 1.0)) / 0.01

    slope = (height(10.0 + 1e-4) - height(10.0 - 1e-4)) / 2e-4
    assert run.gradient({"x": [1.0]})["g"] == pytest.approx(slope, rel=1e-6)
    with pytest.raises(fb.ModelError, match=r"shape \(2, 1\) of the states over time, without one at a terminal event"):
        run.gradient(np.ones((2, 2)))


def test_constraint_violation_with_baumgarte_decays_as_the_closed_form(four_bar):
    # Phi'' + 2 a Phi' + a^2 Phi = 0, whatever the motion: Phi = (Phi_0 + (Phi_0' + a Phi_0) t) exp(-a t).
    a, x0 = 8.0, np.add(four_bar.initial_state(), [0.01, -0.02, 0.03, 0.2, -0.1, 0.3])
    t = np.linspace(0.0, 2.0, 21)
    how = {"constraints": "baumgarte", "stabilization": a, "t_eval": t, "rtol": 1e-11, "atol": 1e-11}
    for method in ("DOP853", "Radau"):
        run = four_bar.simulate((0.0, 2.0), x0, method=method, **how | ({"rtol": 1e-8} if method == "Radau" else {}))
        position, velocity = run.constraint_residual[:, :1], run.velocity_residual[:, :1]
        expected = (position + (velocity + a * position) * t) * np.exp(-a * t)
        # Errors of 1e-8 per step of Radau in coordinates, whose changes the violations are.
        np.testing.assert_allclose(run.constraint_residual, expected, rtol=0, atol=1e-6 if method == "Radau" else 1e-9)
    with pytest.raises(fb.ModelError, match="stabilization must be positive"):
        four_bar.simulate((0.0, 1.0), constraints="baumgarte", stabilization=0.0)


@pytest.mark.parametrize("direction", [-1, 0, 1])
def test_events_of_an_output_in_each_direction_equal_those_of_solve_ivp(direction):
    crank = fb.compile_model(fb.models.slider_crank())
    ode, x0 = crank.ode(), crank.initial_state()

    def pin(t, x):
        return crank.output(t, x, r=ode.input_values(t, x))[crank.outputs.index("pin_x")]

    pin.direction = direction
    how = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-9}
    (expected,) = solve_ivp(ode, (0.0, 2.0), x0, events=pin, **how).t_events
    assert len(expected) > 2
    for dense_output in (False, True):
        run = crank.simulate(
            (0.0, 2.0), x0, events=fb.Event("pin_x", direction=direction), dense_output=dense_output, **how
        )
        np.testing.assert_allclose(run.t_events[0], expected, rtol=0, atol=1e-6)  # tolerances of some dozen steps


def particle(force, constraints, n_independent):
    """A particle in space with constraints of its Cartesian coordinates, under a force."""
    q, u = me.dynamicsymbols("x y z"), me.dynamicsymbols("v_x v_y v_z")
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    axes = (ground.x, ground.y, ground.z)
    point.set_pos(origin, sum((c * axis for c, axis in zip(q, axes, strict=True)), me.Vector(0)))
    point.set_vel(ground, sum((c * axis for c, axis in zip(u, axes, strict=True)), me.Vector(0)))
    system = System(ground, origin)
    system.add_bodies(me.Particle("particle", point, sm.Symbol("m")))
    system.add_loads(me.Force(point, sum((c * a for c, a in zip(force(q), axes, strict=True)), me.Vector(0))))
    system.add_holonomic_constraints(*constraints(q))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = (
        q[:n_independent], q[n_independent:], u[:n_independent], u[n_independent:],
    )  # fmt: skip
    t = me.dynamicsymbols._t
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    return system


def test_constraints_that_always_are_nearly_parallel_are_not_singular():
    # J = [0 1 0; 0 1 1e-3]; its singular values' ratio is 5e-4 for ever, and steps collapse where the force jumps.
    force = me.dynamicsymbols("F")
    system = particle(lambda q: (force - q[0], 0, 0), lambda q: (q[1], q[1] + q[2] / 1000), 1)
    compiled = fb.compile_model(fb.Model(system, parameters={sm.Symbol("m"): 1.0}, inputs={force: 0}))
    inputs = {"F": lambda t, x: 0.0 if t < 5.0123456 else 1e3}
    run = compiled.simulate((0.0, 20.0), [1.0, 0, 0, 0.5, 0, 0], inputs=inputs)
    assert run.success
    # x'' = F - x from the jump on.
    a, b, s = np.cos(5.0123456) + 0.5 * np.sin(5.0123456), 0.5 * np.cos(5.0123456) - np.sin(5.0123456), 20 - 5.0123456
    exact = 1e3 + (a - 1e3) * np.cos(s) + b * np.sin(s)
    assert run["x"][-1] == pytest.approx(exact, rel=1e-4)


def test_run_to_where_a_single_constraint_vanishes_stops_at_a_singular_position():
    # x z = 0: two planes that cross. A particle on one of them comes to where they do.
    system = particle(lambda q: (0, 0, 0), lambda q: (q[0] * q[2],), 2)
    compiled = fb.compile_model(fb.Model(system, parameters={sm.Symbol("m"): 1.0}))
    x0 = dict.fromkeys(compiled.states, 0.0) | {"x": 1.0, "v_x": -1.0}
    run = compiled.simulate((0.0, 3.0), x0, method="RK45")
    assert not run.success
    assert "singular position at t = 1" in run.message


@pytest.mark.parametrize("miss", [1e-5, -1e-5])
@pytest.mark.parametrize("method", METHODS)
def test_four_bar_that_misses_a_singular_position_by_10_um_passes_it(four_bar, method, miss):
    parameters = {"l1": 0.8 + miss, "c": 0.0}
    x0 = four_bar.initial_state(speeds={"u1": 6.0}, parameters=parameters)
    how = {"parameters": parameters, "inputs": {"F": 0.0}, "method": method, "atol": 1e-12}
    runs = [four_bar.simulate((0.0, 0.9), x0, rtol=rtol, **how) for rtol in (1e-6, 1e-9)]
    assert all(run.success for run in runs)
    assert np.abs(np.sin(runs[0].q[0])).min() < 0.3
    np.testing.assert_allclose(runs[0].y[:3, -1], runs[1].y[:3, -1], rtol=0, atol=1e-3)


def test_run_whose_first_trial_step_leaves_the_domain_goes_on_as_scipys():
    # The first step is chosen by a trial that leaves y > 0; SciPy goes on from there.
    system = particle(lambda q: (0, 1 / sm.sqrt(q[1]), 0), lambda q: (q[2],), 2)
    compiled = fb.compile_model(fb.Model(system, parameters={sm.Symbol("m"): 1.0}))
    how = {"method": "DOP853", "rtol": 1e-3, "atol": np.array([1e-6, 1e-6, 1.0, 1.0, 1e3, 1.0])}
    x0 = np.array([1000.0, 1e-6, 0.0, 0.0, -1e-2, 0.0])
    scipys = solve_ivp(compiled.ode(), (0.0, 0.01), x0, **how)
    ours = compiled.simulate((0.0, 0.01), x0, constraints="none", **how)
    assert scipys.success
    assert (ours.success, len(ours.t)) == (True, len(scipys.t))


def test_samples_that_cannot_be_projected_are_the_interpolants():
    system = particle(lambda q: (0, 0, 0), lambda q: (q[0] ** 2 + q[1] ** 2 - 1, q[2]), 1)
    compiled = fb.compile_model(fb.Model(system, parameters={sm.Symbol("m"): 1.0}))
    x0 = dict.fromkeys(compiled.states, 0.0) | {"x": 1.0, "v_y": 10.0}
    run = compiled.simulate((0.0, 10.0), x0, rtol=1.0, atol=1.0, t_eval=np.linspace(0.0, 10.0, 5000))
    assert np.abs(run.q).max() < 100.0  # on a circle of radius 1, at tolerances of 1


def test_run_with_max_steps_or_max_step_keeps_them(four_bar):
    run = four_bar.simulate((0.0, 4.0), max_steps=7)
    assert not run.success
    assert len(run.t) == 8
    assert "max_steps = 7" in run.message
    run = four_bar.simulate((0.0, 4.0), max_step=0.01)
    assert np.diff(run.t).max() <= 0.01 * (1 + 1e-12)
    assert len(run.t) >= 401


@pytest.mark.slow(but=["Radau"])
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_run_that_stops_before_its_first_step_has_no_dense_output(method):
    # A parallelogram: the first step passes the position in which all bars are level, and is discarded.
    loop = fb.compile_model(fb.models.n_four_bar(1))
    x0 = np.zeros(loop.n_x)
    x0[:2], x0[loop.n_q : loop.n_q + 2] = np.pi / 2 - 1e-3, 1.0
    run = loop.simulate((0.0, 1.0), x0, method=method, dense_output=True)
    assert "passes a singular position" in run.message
    assert run.t.tolist() == [0.0]
    assert run.sol is None


def test_default_limit_of_steps_depends_on_the_method_and_max_step(four_bar, monkeypatch):
    monkeypatch.setitem(fourbar_codegen.simulation.run_options.MAX_STEPS, "DOP853", 7)
    monkeypatch.setitem(fourbar_codegen.simulation.run_options.MAX_STEPS, "ALI3P", 7)
    assert "max_steps = 7 " in four_bar.simulate((0.0, 4.0)).message
    assert four_bar.simulate((0.0, 4.0), max_steps=None).success
    # What max_step asks for is no explosion, whatever the direction.
    assert four_bar.simulate((0.0, -4.0), max_step=0.04).success
    assert four_bar.simulate((0.0, 1.0), method="ALI3P", max_step=0.01).success


def test_steps_that_rounding_swallows_are_refused(four_bar):
    """Of the run's length, which times are counted in: those of a late run may be shorter than its times tell apart."""
    for run in (four_bar.simulate, four_bar.ensemble):
        for shortest in (1e-300, 1e-17):
            with pytest.raises(fb.ModelError, match=r"max_step = .* is below the rounding error of the run's 0.1 s"):
                run((1.0, 1.1), max_step=shortest)
    late = four_bar.simulate((1e12, 1e12 + 0.01), max_step=5e-5)  # half of what is between two times
    early = four_bar.simulate((0.0, 0.01), max_step=5e-5)
    assert late.success
    assert late.nfev >= 12 * 195
    # The end itself is rounded, by half of what is between two times.
    rounding = np.spacing(1e12) * np.abs(four_bar.rhs(0.01, early.y[:, -1])).max()
    np.testing.assert_allclose(late.y[:, -1], early.y[:, -1], atol=rounding)


def test_run_whose_energy_grows_without_loads_says_so_in_its_message(four_bar):
    # The tutorial's damper feeds the motion, which begins with -685 J: see its model.
    unstable = {"k": 50.0, "l2": 0.45}
    run = four_bar.simulate((0.0, 10.0), parameters=unstable, t_eval=[0.0, 5.0])
    assert run.success
    end = four_bar.simulate((0.0, 10.0), parameters=unstable, t_eval=[0.0, 10.0])
    assert f"from {end.energy[0]:.6g} J to {end.energy[1]:.6g} J" in run.message
    assert end.message == run.message
    # No more than forces do: from rest, and at once from rest.
    still = {"c": 0.0, "k": 0.0, "g": 0.0, "l1": 0.9}
    x0 = four_bar.initial_state(speeds=[0.0], parameters=still)
    for force in (1e5, lambda t, x: 1e5 if t > 0.9 else 0.0):
        driven = four_bar.simulate((0.0, 1.0), x0, parameters=still, inputs={"F": force}, max_step=0.05)
        assert driven.kinetic_energy[-1] > 1e3
        assert driven.message == fourbar_codegen.simulation.integrate.REACHED_END


@pytest.fixture
def keyboard_interrupts():
    """Also where a shell has started the tests in the background, and has SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("keyboard_interrupts")
def test_long_run_reports_progress_and_ends_on_keyboard_interrupt(four_bar):
    # A run of minutes, stopped from the keyboard when it has told five times how far it is.
    seen, on_its_way = [], threading.Event()
    parameters = {"l1": 0.9, "k": 0.0, "c": 0.0}

    def progress(t):
        seen.append(t)
        if len(seen) == 5:
            on_its_way.set()

    keyboard = threading.Thread(target=lambda: on_its_way.wait() and _thread.interrupt_main(), daemon=True)
    keyboard.start()
    with pytest.raises(KeyboardInterrupt):
        four_bar.simulate((0.0, 1e6), parameters=parameters, inputs={"F": 0.0}, progress=progress)
    keyboard.join()
    assert len(seen) >= 5
    assert seen == sorted(seen)
    assert 0.0 < seen[-1] < 5e5  # not at its end
    del seen[:]
    four_bar.simulate((0.0, 2e3), parameters=parameters, inputs={"F": 0.0}, progress=seen.append, dense_output=True)
    assert seen


def test_run_from_a_state_far_from_the_constraints_is_refused_a_rounded_one_not(four_bar):
    with pytest.raises(fb.ModelError, match="initial_state"):
        four_bar.simulate((0.0, 1.0), [0.1] * 6)
    turned = np.add(four_bar.initial_state(), [200 * np.pi, 0, 0.3, 0, 0, 0])
    with pytest.raises(fb.ModelError, match="violates the constraints"):
        four_bar.simulate((0.0, 1.0), turned)
    rounded = four_bar.initial_state().round(4)
    assert four_bar.simulate((0.0, 1.0), rounded).success


def test_run_with_projection_stays_closed_in_as_many_steps_as_the_tutorials(four_bar):
    """Without, it takes 18 steps and is open by 1.56e-2 m at 4 s: published/test_symbrim_tutorial.py."""
    closed = four_bar.simulate((0.0, 4.0), method="RK45", rtol=1e-3, atol=1e-6)
    assert np.abs(closed.constraint_residual).max() < 1e-14
    assert len(closed.t) == 19


def rk4(function, t, x, h):
    """The classical Runge-Kutta method, as textbooks have it."""
    k1 = function(t, x)
    k2 = function(t + h / 2, x + h / 2 * k1)
    k3 = function(t + h / 2, x + h / 2 * k2)
    k4 = function(t + h, x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def test_stepper_without_projection_equals_the_classical_runge_kutta_method(four_bar):
    ode, x = four_bar.ode(), four_bar.initial_state()
    stepper = four_bar.stepper(0.01, x, t=0.3, constraints="none")
    for i in range(100):
        x = rk4(ode, 0.3 + 0.01 * i, x, 0.01)
        for state in (stepper.step(), stepper.x):
            np.testing.assert_allclose(state, x, rtol=0, atol=1e-12)  # rounding errors of 100 steps
    assert stepper.t == pytest.approx(1.3, abs=1e-13)


def test_stepper_counts_its_time_exactly_forwards_and_backwards(four_bar):
    stepper = four_bar.stepper(0.01)
    steps = 0
    while stepper.t < 5.0:
        stepper.step()
        steps += 1
    assert (steps, stepper.t) == (500, 5.0)
    back = four_bar.stepper(-0.1, t=0.7)
    while back.t > -0.2:
        back.step()
    assert back.t == 0.7 - 9 * 0.1


def test_stepper_holds_inputs_and_keeps_loops_closed(four_bar):
    stepper = four_bar.stepper(1e-3)
    forces = np.repeat(np.random.default_rng(2).normal(scale=50.0, size=20), 50)
    states = np.array([stepper.step([force] if i % 2 else {"F": force}) for i, force in enumerate(forces)])
    for t, x in zip(1e-3 * np.arange(1, 1001), states, strict=True):
        positions, velocities = four_bar.kernel.constraint_violation(t, x)
        # 1e-13 of coordinates of 3 rad, of speeds of 10 rad/s.
        assert np.abs(positions).max() < 1e-12
        assert np.abs(velocities).max() < 1e-11
    # The same force, piecewise constant, by DOP853 from jump to jump.
    x = four_bar.initial_state()
    for i, force in enumerate(forces[::50]):
        x = four_bar.simulate((0.05 * i, 0.05 * (i + 1)), x, inputs={"F": force}, rtol=1e-11, atol=1e-11).y[:, -1]
    # Fourth order: errors of h^4 = 1e-12, times the fifth derivatives' 1e4.
    np.testing.assert_allclose(states[-1], x, rtol=0, atol=1e-7)


def test_stepper_with_given_inputs_holds_them_instead_of_calling_sources(four_bar):
    called = []
    source = {"F": lambda t, x: called.append(t) or 7.0}
    stepper, constant = four_bar.stepper(1e-3, inputs=source), four_bar.stepper(1e-3)
    del called[:]
    np.testing.assert_array_equal(stepper.step([30.0]), constant.step([30.0]))
    assert not called
    np.testing.assert_array_equal(stepper.step(), constant.step([7.0]))
    assert called


def carried_pendulum():
    """A pendulum of 1 kg and 0.5 m in Cartesian coordinates, at whose bob f pulls along x, below a support at s(t)."""
    x, y, u, v, s, f = me.dynamicsymbols("x y u v s f")
    ground, origin, bob = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    bob.set_pos(origin, x * ground.x + y * ground.y)
    bob.set_vel(ground, u * ground.x + v * ground.y)
    system = me.System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, 1.0))
    system.add_loads(me.Force(bob, f * ground.x - 9.81 * ground.y))
    system.add_holonomic_constraints((x - s) ** 2 + y**2 - sm.Rational(1, 4))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x], [y], [u], [v]
    system.add_kdes(u - x.diff(), v - y.diff())
    t = me.dynamicsymbols._t
    return fb.Model(system, name="carried", inputs={s: sm.sin(3 * t) / 5, f: None})


def test_stepper_takes_inputs_that_a_step_does_not_name_from_their_sources():
    """The force of a sampled controller; l a'' = -g sin a + (f - s'') cos a by SciPy, from sample to sample."""
    model, period = fb.compile_model(carried_pendulum()), 0.02
    x0 = model.initial_state({"x": 0.0}, {"u": 0.6}, guess=[-0.5])
    forces = 3.0 * np.cos(np.arange(50.0))

    def swing(time, state, force):
        angle, rate = state
        moved = -1.8 * np.sin(3.0 * time)
        return rate, (-9.81 * np.sin(angle) + (force - moved) * np.cos(angle)) / 0.5

    state = (0.0, 0.0)  # u = s'
    for i, force in enumerate(forces):
        span = (period * i, period * (i + 1))
        state = solve_ivp(swing, span, state, method="DOP853", rtol=1e-12, atol=1e-12, args=(force,)).y[:, -1]
    errors = []
    for more in (1, 2):  # steps in each period
        stepper = model.stepper(period / more, x0, inputs={"f": 0.0})
        for force in np.repeat(forces, more):
            x = stepper.step({"f": force})
            positions, velocities = model.kernel.constraint_violation(stepper.t, x)
            assert max(np.abs(positions).max(), np.abs(velocities).max()) < 1e-12
        errors.append(abs(x[0] - np.sin(3.0 * stepper.t) / 5.0 - 0.5 * np.sin(state[0])))
    assert errors[1] < 1e-7
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.5)  # of order 4
    # The same by a callable that knows the samples, a table of the support, and steps that name nothing.
    table = (np.linspace(0.0, 1.0, 6), np.linspace(0.0, 0.3, 6))
    start = model.initial_state({"x": 0.0}, {"u": 0.3}, guess=[-0.5], inputs={"s": table})
    named = model.stepper(period, start, inputs={"s": table, "f": 0.0})
    own = model.stepper(period, start, inputs={"s": table, "f": lambda t, x: force})
    without = model.stepper(period, start, inputs={"s": table, "f": lambda t, x: force})
    for force in forces[:10]:
        wanted = named.step({"f": force})
        np.testing.assert_array_equal(own.step(), wanted)
        np.testing.assert_array_equal(without.step({}), wanted)
    # A support that is named rests, as everywhere.
    held = model.stepper(period, [0.0, -0.5, 0.0, 0.0], inputs={"f": lambda t, x: 9.81})
    for _ in range(100):
        x = held.step({"s": 0.0})
    assert x[0] ** 2 + x[1] ** 2 == pytest.approx(0.25, rel=1e-12)
    # Energy, with f and m g along the axes; each of 100 steps loses about (w h)^6 / 144 of it, with w^2 = 28 / s^2.
    assert (x[2] ** 2 + x[3] ** 2) / 2.0 == pytest.approx(9.81 * (x[0] - x[1] - 0.5), rel=1e-4)


def test_stepper_passes_a_jump_of_a_motion_only_if_the_step_holds_it():
    """A support that starts to move at t = 0.05 makes speeds jump, unless it is held."""
    model, x0 = fb.compile_model(carried_pendulum()), [0.3, -0.4, 0.0, 0.0]
    table = {"s": ([0.05, 1.0], [0.0, 1.0], "linear"), "f": 0.0}
    stepper, at_rest = model.stepper(0.1, x0, inputs=table), model.stepper(0.1, x0, inputs={"s": 0.0, "f": 0.0})
    for request in (None, {}, {"f": 1.0}):
        with pytest.raises(fb.SimulationError, match=r"jumps at t = 0\.05"):
            stepper.step(request)
    assert stepper.t == 0.0
    np.testing.assert_array_equal(stepper.step({"s": 0.0}), at_rest.step())


def test_stepper_called_from_its_own_input_is_refused_and_keeps_its_state(four_bar):
    # A callable input runs Python in the middle of a step: it may ask for another one, or let another thread in.
    asking = False
    stepper = four_bar.stepper(1e-3, inputs={"F": lambda t, x: stepper.step({"F": 1.0})[0] if asking else 0.0})
    x0, asking = stepper.x, True
    with pytest.raises(fb.SimulationError, match="is under way"):
        stepper.step()
    np.testing.assert_array_equal(stepper.x, x0)
    assert stepper.t == 0.0
    alone = four_bar.stepper(1e-3)
    np.testing.assert_array_equal(stepper.step([7.0]), alone.step([7.0]))


def test_stepper_with_wrong_inputs_keeps_its_state(four_bar):
    stepper = four_bar.stepper(1e-3)
    stepper.step()
    before = stepper.x.tolist()
    with pytest.raises(fb.ModelError, match="'G'"):
        stepper.step({"G": 1.0})
    with pytest.raises(fb.ModelError, match="finite"):
        stepper.step([np.nan])
    assert (stepper.t, stepper.x.tolist()) == (1e-3, before)
    large = four_bar.stepper(1e200)
    with pytest.raises(fb.SimulationError):
        large.step()
    assert large.t == 0.0
