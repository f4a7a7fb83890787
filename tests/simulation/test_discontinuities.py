"""Jumps and kinks in time: where steps end, what speeds do, and large times."""

import pickle

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.prescribed import driven_pendulum, driven_slider_crank
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

t = me.dynamicsymbols._t
m, k, T = sm.symbols("m k T")
q, u, z, w, s, F = me.dynamicsymbols("q u z w s F")

TIGHT = {"rtol": 1e-9, "atol": 1e-9}
METHODS = {name: {"method": name, **TIGHT} for name in ("RK45", "DOP853", "Tsit5", "Radau", "CVODE", "IDA")} | {
    "ALI3P": {"method": "ALI3P", "max_step": 1e-3}
}
ERROR = dict.fromkeys(METHODS, 1e-6)
"""Some hundred steps' tolerance; of ALI3P, of order 2, h^2 t / 12 times the third derivative: 4 at most."""


@pytest.fixture(params=METHODS)
def method(request):
    """Arguments of `simulate`, for a model without position constraints, and the error to expect."""
    return METHODS[request.param], ERROR[request.param]


def without_loops(how):
    return how | ({"formulation": "index-1"} if how["method"] == "IDA" else {})


def sprung(motion, *, held=False):
    """A mass on a spring whose other end is moved, by coordinates relative to that end; or in space, held to it."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    hand = origin.locatenew("hand", (z if held else motion) * frame.x)
    hand.set_vel(frame, (w if held else motion.diff(t)) * frame.x)
    mass = hand.locatenew("mass", q * frame.x)
    mass.set_vel(frame, hand.vel(frame) + u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("mass", mass, m), me.Particle("hand", hand, m))
    system.add_loads(me.Force(mass, -k * q * frame.x), me.Force(hand, k * q * frame.x))
    system.q_ind, system.u_ind = [q], [u]
    system.add_kdes(u - q.diff(t))
    if held:
        system.q_dep, system.u_dep = [z], [w]
        system.add_kdes(w - z.diff(t))
        system.add_holonomic_constraints(z - motion)
    return system


def compiled(motion, default=None, *, held=False):
    name = f"sprung_{held:d}{default is None:d}"
    inputs = {s: default} if motion == s else {}
    return fb.compile_model(fb.Model(sprung(motion, held=held), name=name, parameters={m: 1.0, k: 4.0}, inputs=inputs))


def moved(expression, how):
    """The motion as "an input" or as "time itself"; or as an input of "a constraint"."""
    return compiled(expression) if how == "time itself" else compiled(s, expression, held=how == "a constraint")


def kicked(times, kicks, end, start=(0.3, 0.0)):
    """The mass relative to the hand at the end: it swings with 2 rad/s, and u falls by what the hand's rate rises."""
    x, at = np.array(start, dtype=float), 0.0
    for time, kick in [*zip(times, kicks, strict=True), (end, 0.0)]:
        angle = 2.0 * (time - at)
        x = np.array([[np.cos(angle), np.sin(angle) / 2.0], [-2.0 * np.sin(angle), np.cos(angle)]]) @ x
        x[1] -= kick
        at = time
    return x


STARTS = sm.Piecewise((0, t < sm.Rational(1, 2)), (t - sm.Rational(1, 2), True))
STARTS_LATE = sm.Piecewise((0, t <= sm.Rational(1, 2)), (t - sm.Rational(1, 2), True))


@pytest.mark.slow
@pytest.mark.parametrize("expression", [STARTS, STARTS_LATE, sm.Max(0, t - sm.Rational(1, 2))])
@pytest.mark.parametrize("how", ["an input", "time itself", "a constraint"])
def test_motion_that_starts_at_once_makes_speeds_jump_by_its_rate(expression, how):
    model = moved(expression, how)
    x0 = dict.fromkeys(model.states, 0.0) | {"q": 0.3}
    run = model.simulate((0.0, 1.0), x0, **TIGHT)
    np.testing.assert_allclose([run["q"][-1], run["u"][-1]], kicked([0.5], [1.0], 1.0), atol=1e-7)
    # Before the jump and after it, times that differ by their last bit; each state agrees with what holds there.
    jump = np.argmin(np.abs(run.t - 0.5))
    assert (np.diff(run.t) > 0.0).all()
    assert np.ptp(run.t[np.abs(run.t - 0.5) < 1e-12]) < 10 * np.spacing(1.0)
    assert np.ptp(run["u"][jump - 1 : jump + 2]) == pytest.approx(1.0, abs=0.2)
    assert np.abs(run.velocity_residual).max(initial=0.0) < 1e-12
    assert np.abs(run.constraint_residual).max(initial=0.0) < 1e-12
    # At the time of the jump itself, too; but for Max, whose rate is half of both there.
    at = model.simulate((0.0, 1.0), x0, t_eval=[0.25, 0.5, 0.75], **TIGHT)
    assert np.abs(at.velocity_residual).max(initial=0.0) < (1e-12 if expression.is_Piecewise else 0.6)
    for method in ("RK45", "DOP853", "Radau"):
        at = model.simulate((0.0, 1.0), x0, t_eval=[0.25, 0.5, 0.75], method=method, **TIGHT)
        before, behind = kicked([], [], 0.5), kicked([0.5], [1.0], 0.5)
        np.testing.assert_allclose(at["q"][1], behind[0], atol=1e-7)
        np.testing.assert_allclose(at["u"][1], before[1] if expression == STARTS_LATE else behind[1], atol=1e-6)
    # And the way back.
    back = model.simulate((1.0, 0.0), run.y[:, -1], **TIGHT)
    np.testing.assert_allclose(back.y[:, -1], list(x0.values()), atol=1e-6)
    # What is between states: swinging, on either side.
    dense = model.simulate((0.0, 1.0), x0, dense_output=True, **TIGHT)
    for time in (0.2, 0.499, 0.501, 0.9):
        expected = kicked([0.5], [1.0], time) if time > 0.5 else kicked([], [], time)
        np.testing.assert_allclose(dense.sol(time)[model.states.index("q")], expected[0], atol=1e-6)


@pytest.mark.slow(but=["DOP853", "ALI3P", "Radau"])
def test_motion_that_starts_at_once_makes_speeds_jump_by_every_method(method):
    how, error = method
    relative, held = compiled(s, STARTS), compiled(s, STARTS, held=True)
    run = relative.simulate((0.0, 1.0), [0.3, 0.0], **without_loops(how))
    np.testing.assert_allclose(run.y[:, -1], kicked([0.5], [1.0], 1.0), atol=error)
    run = held.simulate((0.0, 1.0), {"q": 0.3, "u": 0.0, "z": 0.0, "w": 0.0}, **how)
    np.testing.assert_allclose([run["q"][-1], run["u"][-1]], kicked([0.5], [1.0], 1.0), atol=error)
    assert run["w"][-1] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow(but=["linear", "pchip"])
@pytest.mark.parametrize("kind", ["cubic", "linear", "pchip"])
def test_table_of_a_motion_makes_speeds_jump_where_it_begins_and_ends(kind):
    model = compiled(s, None)
    table = (np.linspace(0.2, 0.6, 9), np.linspace(0.0, 0.4, 9), kind)  # a straight line: each kind of it is exact
    run = model.simulate((0.0, 1.0), [0.3, 0.0], inputs={"s": table}, **TIGHT)
    np.testing.assert_allclose(run.y[:, -1], kicked([0.2, 0.6], [1.0, -1.0], 1.0), atol=1e-7)
    # A run within the table has none, nor one that ends with it.
    within = model.simulate((0.2, 0.6), [0.3, -1.0], inputs={"s": table}, **TIGHT)
    np.testing.assert_allclose(within.y[:, -1], kicked([], [], 0.4, start=(0.3, -1.0)), atol=1e-7)
    ensemble = model.ensemble((0.0, 1.0), [0.3, 0.0], inputs={"s": table}, parameters={"k": [4.0, 4.0]}, **TIGHT)
    np.testing.assert_allclose(ensemble.y[0, :, -1], run.y[:, -1], rtol=0, atol=0)


def test_linear_table_of_a_motion_makes_speeds_jump_at_each_point():
    model = compiled(s, None)
    table = ([0.0, 0.25, 0.5, 1.0], [0.0, 0.1, 0.0, 0.5], "linear")
    run = model.simulate((0.0, 1.0), [0.3, 0.0], inputs={"s": table}, **TIGHT)
    np.testing.assert_allclose(run.y[:, -1], kicked([0.25, 0.5], [-0.8, 1.4], 1.0), atol=1e-7)


def test_pchip_table_of_a_motion_does_not_overshoot_where_a_cubic_does():
    model = compiled(s, None)
    times, values = np.array([0.0, 0.4, 0.5, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
    at = np.linspace(0.0, 1.0, 201)
    cubic = model.simulate((0.0, 1.0), [0.3, 0.0], inputs={"s": (times, values)}, t_eval=at)
    monotone = model.simulate((0.0, 1.0), [0.3, 0.0], inputs={"s": (times, values, "pchip")}, t_eval=at)
    assert cubic["s"].max() > 1.5
    assert monotone["s"].min() == 0.0
    assert monotone["s"].max() == 1.0
    with pytest.raises(fb.ModelError, match="linear"):
        model.simulate((0.0, 1.0), [0.3, 0.0], inputs={"s": (times, values, "quadratic")})


def test_pivot_that_starts_at_once_keeps_the_bobs_momentum_along_its_path():
    """The bob's momentum along its path is kept: l u+ + v cos q = l u-; as a pivot that gathers speed within 1e-6 s."""
    pendulum = fb.compile_model(driven_pendulum(None))
    table = ([0.0, 0.3, 1.0], [0.0, 0.0, 1.4], "linear")
    run = pendulum.simulate((0.0, 1.0), [0.8, 0.5], inputs={"s": table}, t_eval=[0.3 - 1e-9, 0.3 + 1e-9, 1.0], **TIGHT)
    angle = run["q"][0]
    assert np.diff(run["u"])[0] == pytest.approx(-2.0 * np.cos(angle) / 0.5, rel=1e-6)

    def motion(time, x, rise=1e-6):
        acceleration = 2.0 / rise if 0.3 < time < 0.3 + rise else 0.0
        return [x[1], (-9.81 * np.sin(x[0]) - acceleration * np.cos(x[0])) / 0.5]

    x, at = np.array([0.8, 0.5]), 0.0
    for end in (0.3, 0.3 + 1e-6, 1.0):
        x, at = solve_ivp(motion, (at, end), x, rtol=1e-11, atol=1e-11, first_step=min(1e-7, end - at)).y[:, -1], end
    np.testing.assert_allclose(run.y[:, -1], x, atol=2e-5)  # the rise of 1e-6 s, some ten times


@pytest.mark.slow
def test_driven_crank_that_starts_at_once_moves_the_slider_as_the_loop_requires():
    """Loops: the slider's speed follows from the crank's, v = dx/da w, and the energy from both."""
    crank = fb.compile_model(driven_slider_crank(None))
    table = ([0.0, 0.5, 1.0], [0.7, 0.7, 2.2], "linear")
    x0 = crank.initial_state(guess=[0.7, 0.9], inputs={"s": table})
    run = crank.simulate((0.0, 1.0), x0, inputs={"s": table}, t_eval=[0.25, 0.5, 0.75, 1.0], **TIGHT)
    assert run.success
    angle = 0.7 + 3.0 * np.array([0.25, 0.5])
    root = np.sqrt(0.49 - 0.04 * np.sin(angle) ** 2)
    np.testing.assert_allclose(run["x"][2:], 0.2 * np.cos(angle) + root, atol=1e-9)
    np.testing.assert_allclose(run["v"][2:], 3 * (-0.2 * np.sin(angle) - 0.02 * np.sin(2 * angle) / root), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("jump", [sm.Piecewise((0, t < 1), (1, True)), sm.Piecewise((0, t <= 1), (t - 2, True))])
@pytest.mark.parametrize("how", ["an input", "time itself", "a constraint"])
def test_run_with_a_prescribed_position_that_jumps_ends_there_with_a_message(jump, how):
    model = moved(jump, how)
    run = model.simulate((0.0, 2.0), dict.fromkeys(model.states, 0.0))
    assert not run.success
    assert "jumps at t = 1, which no finite force can cause" in run.message
    assert run.t[-1] == pytest.approx(1.0, rel=1e-15)


def pushed(force=None):
    """A mass on a line, and a force."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    mass = origin.locatenew("mass", q * frame.x)
    mass.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("mass", mass, m))
    system.add_loads(me.Force(mass, (F if force is None else force) * frame.x))
    system.q_ind, system.u_ind = [q], [u]
    system.add_kdes(u - q.diff(t))
    numbers = sorted(force.free_symbols - {t}, key=str) if force is not None else []
    parameters = {m: 1.0} | dict.fromkeys(numbers, 0.3)
    inputs = {F: 0} if force is None else {}
    return fb.compile_model(fb.Model(system, name="pushed", parameters=parameters, inputs=inputs))


PULSE = ([0.0, 0.499, 0.5, 0.501, 1.0], [0.0, 0.0, 1e5, 0.0, 0.0])


@pytest.mark.slow(but=["ALI3P", "CVODE", "DOP853", "Radau"])
def test_pulse_of_2_ms_in_a_table_is_integrated_by_every_method(method):
    how, error = method
    model = pushed()
    for span, sign in (((0.0, 1.0), 1.0), ((1.0, 0.0), -1.0)):
        run = model.simulate(span, [0.0, 0.0], inputs={"F": PULSE}, **without_loops(how))
        # Half of 1e5 N times 2 ms, and from its middle on as far.
        np.testing.assert_allclose(run.y[:, -1], [50.0, sign * 100.0], rtol=10 * error)


@pytest.mark.slow
def test_pulse_of_2_ms_in_a_table_is_integrated_in_ensembles():
    model, masses = pushed(), np.array([1.0, 2.0, 4.0, 5.0, 8.0])
    for span in ((0.0, 1.0), (1.0, 0.0)):
        ensemble = model.ensemble(span, [0.0, 0.0], inputs={"F": PULSE}, parameters={"m": masses})
        np.testing.assert_allclose(np.abs(ensemble["u"][:, -1]), 100.0 / masses, rtol=1e-9)
        np.testing.assert_allclose(ensemble["q"][:, -1], 50.0 / masses, rtol=1e-9)


def test_table_with_a_thousand_kinks_takes_a_thousand_exact_steps():
    times = np.linspace(0.0, 10.0, 1001)
    values = np.sin(3 * times) + 0.1 * (-1.0) ** np.arange(1001)
    run = pushed().simulate((0.0, 10.0), [0.0, 0.0], inputs={"F": (times, values)})
    assert len(run.t) - 1 <= 1010
    assert run["u"][-1] == pytest.approx(np.trapezoid(values, times), rel=1e-12)


@pytest.mark.slow
def test_steps_end_where_a_condition_in_a_force_changes_also_by_parameters():
    """Also where parameters say when."""
    model = pushed(sm.Piecewise((1e3, (t >= T) & (t < T + sm.Rational(1, 1000))), (0, True)))
    for start in (0.1, 0.3, 0.99):
        run = model.simulate((0.0, 1.0), [0.0, 0.0], parameters={"T": start})
        assert run["u"][-1] == pytest.approx(1.0, rel=1e-12)
        assert start in run.t
    ensemble = model.ensemble((0.0, 1.0), [0.0, 0.0], parameters={"T": [0.1, 0.3, 0.99]})
    np.testing.assert_allclose(ensemble["u"][:, -1], 1.0, rtol=1e-12)


@pytest.mark.slow
def test_condition_whose_rounding_exceeds_that_of_time_switches_at_its_time():
    """7.5 t - 0.39 < 6.2 t until t = 0.3, by products whose rounding is several of t's own."""
    a, b, c = sm.symbols("a b c")
    model = pushed(sm.Piecewise((1e3, a * t - b < c * t), (0, True)))
    values = {"a": 7.5, "b": 0.39, "c": 6.2}
    run = model.simulate((0.0, 1.0), [0.0, 0.0], parameters=values)
    assert run["u"][-1] == pytest.approx(300.0, rel=1e-12)
    ensemble = model.ensemble((0.0, 1.0), [0.0, 0.0], parameters={name: [v, v] for name, v in values.items()})
    np.testing.assert_allclose(ensemble["u"][:, -1], 300.0, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("jump", [sm.Heaviside(t - T), (1 + sm.sign(t - T)) / 2, sm.Piecewise((0, t < T), (1, True))])
def test_steps_end_at_jumps_and_kinks_by_heaviside_sign_and_abs(jump):
    pulsed, kinked = pushed(1e3 * (jump - jump.subs(T, T + sm.Rational(1, 1000)))), pushed(sm.Abs(t - T) - t + T)
    assert pulsed.simulate((0.0, 1.0), [0.0, 0.0])["u"][-1] == pytest.approx(1.0, rel=1e-12)
    run = kinked.simulate((0.0, 1.0), [0.0, 0.0])
    assert run["u"][-1] == pytest.approx(0.09, rel=1e-12)
    assert 0.3 in run.t
    for model, end in ((pulsed, 1.0), (kinked, 0.09)):
        stepper = model.stepper(0.1, [0.0, 0.0])
        for _ in range(10):
            stepper.step()
        assert stepper.x[1] == pytest.approx(end, rel=1e-12)


def test_event_of_a_speed_that_changes_sign_in_a_jump_is_at_the_jump():
    event = fb.Event(lambda time, x: x[1] + 0.7, terminal=True)
    run = compiled(s, STARTS).simulate((0.0, 1.0), [0.3, 0.0], events=event, **TIGHT)
    assert run.status == 1
    assert run.t_events[0].tolist() == [pytest.approx(0.5, rel=1e-15)]
    assert run.y_events[0][0][1] == pytest.approx(-0.6 * np.sin(1.0) - 1.0, abs=1e-7)
    assert run.t[-1] == run.t_events[0][0]


def test_steppers_and_solve_ivp_refuse_steps_across_a_jump_of_speeds():
    model = compiled(s, STARTS)
    stepper = model.stepper(0.3, [0.3, 0.0])
    stepper.step()
    for ready in (stepper, pickle.loads(pickle.dumps(stepper))):
        with pytest.raises(fb.SimulationError, match=r"jumps at t = 0.5, .* within the step from 0.3 to 0.6"):
            ready.step()
        assert ready.t == 0.3
    with pytest.raises(fb.ModelError, match=r"jumps at t = 0.5"):
        solve_ivp(model.ode(), (0.0, 1.0), [0.3, 0.0], method=fb.solvers.RK45)
    for span in ((0.0, 0.5), (0.5, 1.0)):
        assert solve_ivp(model.ode(), span, [0.3, 0.0], method=fb.solvers.RK45).success


@pytest.mark.slow(but=["ALI3P--1.0-1.0-0.001", "ALI3P-0.2-0.9-0.9", "ALI3P-1.0-0.0-0.5", "DOP853--1.0-1.0-0.001"])
@pytest.mark.parametrize(
    ("begin", "end", "jump"), [(0.2, 1.5, 0.9), (0.6, 2.5, 2.0), (1.0, 0.0, 0.5), (-1.0, 1.0, 0.001), (0.2, 0.9, 0.9)]
)
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Radau", "CVODE", "IDA", "ALI3P"])
def test_states_beside_a_jump_are_told_apart_by_their_times_in_every_method(begin, end, jump, method, tmp_path):
    """Also where rounding makes the same of both, counted from the beginning. No finite force: u + s' is continuous."""
    model = compiled(s, None)
    motion = {"s": ([jump, jump + 1.0], [0.0, 0.5], "linear")}
    how = without_loops(METHODS[method])
    run = model.simulate((begin, end), [0.3, 0.5], inputs=motion, dense_output=True, **how)
    assert (np.sign(end - begin) * np.diff(run.t) > 0.0).all()
    assert {jump} <= set(run.t)
    absolute = run["u"] + run["s'"]
    assert np.ptp(absolute[np.abs(run.t - jump) < 1e-12]) < 1e-12
    assert np.ptp(run["u"][np.abs(run.t - jump) < 1e-12]) == pytest.approx(0.5, rel=1e-9)
    away = np.sign(end - begin) * np.array([-1e-14, 0.0, 1e-14])
    around = (jump + away)[: 2 if jump == end else 3]
    sampled = model.simulate((begin, end), [0.3, 0.5], inputs=motion, t_eval=around, **how)
    assert np.ptp(sampled["u"] + sampled["s'"]) < 1e-12
    if jump != end:  # where there is nothing to interpolate after it
        np.testing.assert_allclose(run.sol(around), sampled.y, rtol=1e-12)
    assert fb.load_trajectory(run.save(tmp_path / "run.npz")).t.tolist() == run.t.tolist()


RAMP = (t - sm.Rational(3, 10)) / sm.Rational(2, 5) / 5
KINKED = {
    "a ramp": (5 * sm.Max(0, sm.Min(sm.Rational(1, 5), RAMP)), [(0.3, 2.5), (0.7, -2.5)]),
    "a ramp, inside out": (5 * sm.Min(sm.Rational(1, 5), sm.Max(0, RAMP)), [(0.3, 2.5), (0.7, -2.5)]),
    "a condition of a maximum": (sm.Piecewise((0, sm.Max(t, 0) < T), (t - T, True)), [(0.3, 1.0)]),
    "the largest of three": (sm.Max(t, T, 2 * t - sm.Rational(7, 10)), [(0.3, 1.0), (0.7, 1.0)]),
    "a distance": (sm.Abs(t - T), [(0.3, 2.0)]),
    "a distance by its square": (sm.sqrt((t - T) ** 2), [(0.3, 2.0)]),
    "a triangle": (sm.Max(0, 1 - 5 * sm.Abs(t - sm.Rational(1, 2))), [(0.3, 5.0), (0.5, -10.0), (0.7, 5.0)]),
    "distances of distances": (
        sm.Abs(sm.Abs(t - sm.Rational(1, 2)) - sm.Rational(1, 5)), [(0.3, 2.0), (0.5, -2.0), (0.7, 2.0)]
    ),
    "steps of a ramp": (
        (t - T) * sm.Heaviside(t - T) - (t - sm.Rational(7, 10)) * sm.Heaviside(t - sm.Rational(7, 10)),
        [(0.3, 1.0), (0.7, -1.0)],
    ),
    "a square": (sm.Piecewise((0, t**2 < T**2), (t - T, True)), [(0.3, 1.0)]),
    "a product": (sm.Piecewise((t, (t - T) * (t - sm.Rational(7, 10)) < 0), (T, t < T), (sm.Rational(7, 10), True)),
                  [(0.3, 1.0), (0.7, -1.0)]),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "how"),
    [
        (name, how)
        for name, (expression, _) in KINKED.items()
        for how in ("an input", "time itself", "a constraint")
        # Of an absolute value or a step of time itself, SymPy makes rates for complex times, or impulses.
        if how != "time itself" or not expression.diff(t).has(sm.Derivative, sm.DiracDelta)
    ],
)
def test_kinks_of_nested_conditions_in_a_motion_make_speeds_jump(name, how):
    expression, kinks = KINKED[name]
    model = moved(expression.subs(T, sm.Rational(3, 10)), how)
    x0 = dict.fromkeys(model.states, 0.0) | {"q": 0.3}
    if how == "a constraint":
        rest = model.initial_state({"q": 0.3}, {"u": 0.0})
        x0 |= dict(zip(model.states, rest, strict=True))
    run = model.simulate((0.0, 1.0), x0, **TIGHT)
    times, jumps = zip(*kinks, strict=True)
    np.testing.assert_allclose([run["q"][-1], run["u"][-1]], kicked(times, jumps, 1.0), atol=1e-7)


@pytest.mark.parametrize(
    "expression",
    [
        sm.Abs(sm.sin(7 * t)),
        sm.Max(0, sm.sin(7 * t)),
        sm.Piecewise((0, sm.exp(t) < 2), (sm.exp(t) - 2, True)),
        sm.Max(0, t**3 - t),
    ],
)
@pytest.mark.parametrize("how", ["an input", "time itself", "a constraint"])
def test_motions_with_kinks_at_unknown_times_are_refused(expression, how):
    refused = "Derivative.re.t.*cannot be compiled|" * (how == "time itself")  # what SymPy makes of an absolute value
    refused += "A prescribed motion.* changes its form at times that cannot be derived"
    with pytest.raises(fb.ModelError, match=refused):
        moved(expression, how)


def test_motion_with_a_root_that_never_vanishes_has_no_jumps():
    """Most roots are: that of a crank's slider is known to have no kink only by its numbers."""
    model = compiled(s, sm.cos(3 * t) / 5 + sm.sqrt(sm.Rational(1, 4) - sm.sin(3 * t) ** 2 / 25))
    assert model.manifest["n_motion_breakpoints"] == 0
    assert model.simulate((0.0, 1.0), [0.3, 0.0]).success


def test_pulses_and_tables_at_unix_times_are_integrated_to_rounding():
    """At Unix times as well, to what these are rounded to: 2e-7 s, of a millisecond."""
    model = pushed(sm.Piecewise((1e3, (t >= T) & (t < T + sm.Rational(1, 1000))), (0, True)))
    begin, start = 1.7e9, 1.7e9 + 0.3
    rounding = 2 * np.spacing(begin) * 1e3
    for method in METHODS:
        run = model.simulate(
            (begin, begin + 1.0), [0.0, 0.0], parameters={"T": start}, **without_loops(METHODS[method])
        )
        assert run["u"][-1] == pytest.approx(1.0, abs=rounding), method
    ensemble = model.ensemble((begin, begin + 1.0), [0.0, 0.0], parameters={"T": [start, start + 0.2]})
    np.testing.assert_allclose(ensemble["u"][:, -1], 1.0, atol=rounding)
    # Tables of a kilohertz, as motions: a straight line.
    times = begin + np.arange(1001) / 1000
    run = compiled(s, None).simulate(
        (begin, begin + 1.0), [0.3, -1.0], inputs={"s": (times, times - begin, "linear")}, **TIGHT
    )
    assert run.success
    np.testing.assert_allclose(run.y[:, -1], kicked([], [], 1.0, start=(0.3, -1.0)), atol=1e-3)


def test_a_change_of_sign_where_a_force_begins_is_one_event():
    """Where a step happens to end at a zero, it counts twice, as in SciPy; here a step of every run does."""
    model = pushed(sm.Piecewise((1.0, t >= T), (0, True)))
    events = [fb.Event(lambda time, x: time - 0.3), fb.Event(lambda time, x: time - 0.3, terminal=2)]
    for method in METHODS:
        run = model.simulate((0.0, 1.0), [0.0, 0.0], events=events, **without_loops(METHODS[method]))
        assert [times.tolist() for times in run.t_events] == [[0.3], [0.3]]
        assert run.t[-1] == 1.0


def test_event_that_falls_to_zero_where_a_force_begins_does_not_count_as_rising():
    """A step ends at the zero and another one begins there: between both, it is zero before and after."""
    model = pushed(sm.Piecewise((1.0, t >= T), (0, True)))
    events = [fb.Event(lambda time, x: 0.3 - time, direction=direction) for direction in (1, -1)]
    run = model.simulate((0.0, 1.0), [0.0, 0.0], events=events)
    assert [times.tolist() for times in run.t_events] == [[], [0.3]]


def test_motion_in_smooth_parts_makes_no_speeds_jump_and_steps_end_at_its_parts():
    """A rise from 0 to 1 within a second, with no jump of its acceleration either."""
    since = t - 1
    rise = sm.Piecewise((0, t < 1), (10 * since**3 - 15 * since**4 + 6 * since**5, t < 2), (1, True))
    model = compiled(s, rise)
    run = model.simulate((0.0, 3.0), [0.3, 0.0], **TIGHT)
    assert {1.0, 2.0} <= set(run.t.tolist())

    def motion(time, x):
        since = time - 1
        return [x[1], -4 * x[0] - (60 * since - 180 * since**2 + 120 * since**3 if 1 < time < 2 else 0.0)]

    x = [0.3, 0.0]
    for span in ((0.0, 1.0), (1.0, 2.0), (2.0, 3.0)):
        x = solve_ivp(motion, span, x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], x, atol=1e-7)
    stepper = model.stepper(1e-2, [0.3, 0.0])
    while stepper.t < 3.0 - 1e-9:
        stepper.step()
    np.testing.assert_allclose(stepper.x, x, atol=1e-5)
    assert solve_ivp(model.ode(), (0.0, 3.0), [0.3, 0.0], method=fb.solvers.RK45).success


@pytest.mark.slow(
    but=["ALI3P-1700000000.0", "DOP853-1000000000000000.0", "DOP853-1700000000.0", "Radau-1000000000000000.0"]
)
@pytest.mark.parametrize("origin", [1.7e9, 1e15])
def test_runs_at_large_times_equal_runs_from_zero_by_every_method(four_bar, method, origin):
    how, _ = method
    inputs, times = {"F": 0.5}, np.array([0.0, 1.0, 2.0])
    early = four_bar.simulate((0.0, 2.0), inputs=inputs, t_eval=times, events=lambda t, x: x[3], **how)
    late = four_bar.simulate(
        (origin, origin + 2.0), inputs=inputs, t_eval=origin + times, events=lambda t, x: x[3], dense_output=True, **how
    )
    assert late.success
    assert late.t.tolist() == (origin + times).tolist()
    np.testing.assert_array_equal(late.y, early.y)
    np.testing.assert_array_equal(late.y_events[0], early.y_events[0])
    np.testing.assert_allclose(late.t_events[0] - origin, early.t_events[0], atol=np.spacing(origin))
    np.testing.assert_array_equal(late.sol(origin + 1.0), early.y[:, 1])


def test_ensembles_at_large_times_equal_ensembles_from_zero(four_bar):
    times = np.array([0.0, 1.0, 2.0])
    how = {"inputs": {"F": 0.5}, "parameters": {"k": [2.0, 3.0, 4.0]}}
    early = four_bar.ensemble((0.0, 2.0), t_eval=times, **how)
    late = four_bar.ensemble((1.7e9, 1.7e9 + 2.0), t_eval=1.7e9 + times, **how)
    assert late.success.all()
    np.testing.assert_array_equal(late.y, early.y)


@pytest.mark.parametrize("speed", [6.5, 8.0, 20.0, 100.0])
def test_long_steps_around_a_circle_pass_no_singular_position(speed):
    """A pendulum by Cartesian coordinates takes steps of a quarter turn; its constraint keeps its rank."""
    model = fb.compile_model(fb.models.cartesian_pendulum())
    x0 = {"x": 0.0, "y": -1.0, "v_x": speed, "v_y": 0.0}
    run = model.simulate((0.0, 100.0), x0, method="DOP853", rtol=1e-3, atol=1e-3)
    assert run.success
    assert np.abs(np.diff(np.unwrap(np.arctan2(run["y"], run["x"])))).max() > 0.5
