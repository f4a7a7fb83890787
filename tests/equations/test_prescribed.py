"""Prescribed motion: inputs whose rates enter; and parameters that follow from others."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.prescribed import a, driven_pendulum, driven_slider_crank, g, length, m, q, s, t, u, w
from scipy.interpolate import CubicSpline
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


@pytest.mark.slow
def test_table_of_a_motion_that_comes_to_rest_at_zero_does_not_jump():
    """Beside zero, rounding errors of an interpolant are no jump; the motion is that of a pivot one metre away."""
    model = fb.compile_model(driven_pendulum(None))
    times, values = np.array([0.0, 0.1, 0.2, 0.3]), np.array([0.0, 0.7, 0.0, 0.0])
    runs = [
        model.simulate((0.0, 0.5), [0.0, 0.0], inputs={"s": (times, values + away, "pchip")}, rtol=1e-10, atol=1e-10)
        for away in (0.0, 1.0)
    ]
    assert [run.message for run in runs if not run.success] == []
    np.testing.assert_allclose(runs[0].y[:, -1], runs[1].y[:, -1], rtol=0, atol=1e-8)


def test_rates_of_a_prescribed_motion_are_inputs_of_the_equations():
    pendulum = fb.compile_model(driven_pendulum(a * sm.sin(w * t)))
    assert pendulum.inputs == ("s", "s'", "s''")
    for time, angle, speed in ((0.0, 0.3, 1.0), (0.7, -1.2, 0.5)):
        acceleration = -0.1 * 25 * np.sin(5 * time)
        expected = (-9.81 * np.sin(angle) - acceleration * np.cos(angle)) / 0.5
        x = [angle, speed]
        assert pendulum.rhs(time, x)[1] == pytest.approx(expected, rel=1e-13)
        assert pendulum.rhs(time, x, r=[9.0, 9.0, acceleration])[1] == pytest.approx(expected, rel=1e-13)
        # At rest where it is given without its rates.
        assert pendulum.rhs(time, x, r={"s": 3.0})[1] == pytest.approx(-9.81 * np.sin(angle) / 0.5, rel=1e-13)
        np.testing.assert_allclose(
            pendulum.input_jacobian(time, x), [[0, 0, 0], [0, 0, -np.cos(angle) / 0.5]], rtol=1e-13
        )
        # v = (s' + l u cos q, l u sin q)
        rate = 0.5 * np.cos(5 * time)
        energy = 0.5 * 2 * ((rate + 0.5 * speed * np.cos(angle)) ** 2 + (0.5 * speed * np.sin(angle)) ** 2)
        assert pendulum.kinetic_energy(time, x) == pytest.approx(energy, rel=1e-13)


def test_kinetic_energy_of_a_moved_pivot_counts_at_the_runs_own_times():
    # Drawn along the rod, the bob moves as its pivot does: T = m s'^2 / 2, whose largest value is at t = 0. Counted
    # from the beginning as well, the run would end there.
    model = fb.compile_model(driven_pendulum(0, a / (1 + sm.exp(-2 * w * t))))
    run = model.simulate((-1.0, 1.0), [np.pi / 2, 0.0], parameters={"g": 0.0, "a": 1.0, "w": 10.0}, rtol=1e-10)
    rate = 5.0 / np.cosh(10.0 * run.t) ** 2
    np.testing.assert_allclose(run.kinetic_energy, rate**2, rtol=1e-12)  # m = 2
    assert "has grown" not in run.message


@pytest.mark.slow
def test_batch_with_a_prescribed_motion_equals_closed_forms_of_single_states():
    """At rest where a motion is given without its rates; its expression where it is left out, at each time."""
    pendulum = fb.compile_model(driven_pendulum(a * sm.sin(w * t)))
    times, x = np.array([0.0, 0.7, 2.0]), np.array([[0.3, -1.2, 2.0], [1.0, 0.5, -3.0]])
    at_rest = -9.81 * np.sin(x[0]) / 0.5
    driven = at_rest + 0.1 * 25 * np.sin(5 * times) * np.cos(x[0]) / 0.5
    several = {"a": np.full(3, 0.1)}  # of which each state has its own
    for p in (None, several):
        np.testing.assert_allclose(pendulum.rhs_batch(times, x, p, r={s: 3.0})[1], at_rest, rtol=1e-13)
        np.testing.assert_allclose(pendulum.rhs_batch(0.7, x, p, r={s: times})[1], at_rest, rtol=1e-13)
        np.testing.assert_allclose(pendulum.rhs_batch(times, x, p, r={})[1], driven, rtol=1e-13)
        own = pendulum.rhs_batch(times, x, p, r={"s''": -2.5 * np.sin(5 * times)})[1]
        np.testing.assert_allclose(own, driven, rtol=1e-13)
    bare = fb.compile_model(driven_pendulum(None))
    with pytest.raises(fb.ModelError, match="No value for input s"):
        bare.rhs_batch(0.0, x, r={})


def test_parameter_jacobian_through_a_motions_rates_equals_the_closed_form():
    pendulum = fb.compile_model(driven_pendulum(a * sm.sin(w * t)))
    time, angle, speed, p = 0.7, -1.2, 0.5, {m: 2.0, length: 0.5, g: 9.81, a: 0.1, w: 5.0}
    pivot = sm.Function("pivot")(t)
    law = (-g * sm.sin(angle) - pivot.diff(t, 2) * sm.cos(angle)) / length

    def columns(motion):
        rate = law.subs(pivot, motion).doit()
        return [float(rate.diff(symbol).subs({**p, t: time})) for symbol in p]

    x = [angle, speed]
    np.testing.assert_allclose(
        pendulum.parameter_jacobian(time, x), [[0.0] * 5, columns(a * sm.sin(w * t))], rtol=1e-12, atol=1e-12
    )
    # Given, a motion does not follow from the parameters; the value and the first rate do not reach x' here.
    for r, motion in (
        ([0.1, 0.2, 3.0], 1.5 * t**2),
        ({"s''": 3.0}, 1.5 * t**2),
        ({"s": 0.1}, sm.Float(0.1)),
        ({"s'": 0.2}, a * sm.sin(w * t)),
    ):
        expected = [[0.0] * 5, columns(motion)]
        np.testing.assert_allclose(pendulum.parameter_jacobian(time, x, r=r), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_parameter_jacobian_through_forces_of_time_equals_the_closed_form():
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=m)
    F, G = me.dynamicsymbols("F G")
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    system.add_loads(me.Force(block.masscenter, (F + q * G) * wall.x))
    b, frequency = sm.symbols("b nu")
    values = {m: 2.0, a: 3.0, w: 2 * sm.pi * frequency, frequency: 0.4, b: 5.0}
    inputs = {F: a * sm.sin(w * t), G: sm.Piecewise((b * t**2, t < 1), (b, True))}
    model = fb.compile_model(fb.Model(system, name="forced_block", parameters=values, inputs=inputs))
    assert model.parameters == ("m", "a", "nu", "b")
    time, x = 0.3, [0.7, 0.0]
    omega = 2 * np.pi * 0.4
    sine, cosine, slope = np.sin(omega * time), np.cos(omega * time), time**2
    # u' = (a sin(2 pi nu t) + q b t^2) / m
    by_a, by_nu, by_b = sine / 2, 3 * cosine * 2 * np.pi * time / 2, 0.7 * slope / 2
    for r, expected in (
        (None, [-(3 * sine + 0.7 * 5 * slope) / 4, by_a, by_nu, by_b]),
        ({F: 1.0}, [-(1.0 + 0.7 * 5 * slope) / 4, 0.0, 0.0, by_b]),
        ({"G": 1.0}, [-(3 * sine + 0.7) / 4, by_a, by_nu, 0.0]),
        ({}, [-(3 * sine + 0.7 * 5 * slope) / 4, by_a, by_nu, by_b]),
        ((1.0, 2.0), [-(1.0 + 1.4) / 4, 0.0, 0.0, 0.0]),
    ):
        np.testing.assert_allclose(model.parameter_jacobian(time, x, r=r), [[0.0] * 4, expected], rtol=1e-13)
    # At other parameters than the defaults.
    p = {"nu": 0.2, "b": 1.0}
    np.testing.assert_allclose(
        model.parameter_jacobian(2.0, x, p)[1],
        [
            -(3 * np.sin(0.8 * np.pi) + 0.7) / 4,
            np.sin(0.8 * np.pi) / 2,
            3 * np.cos(0.8 * np.pi) * 4 * np.pi / 2,
            0.35,
        ],
        rtol=1e-13,
    )


def test_cubic_table_of_a_motion_gives_the_motion_of_the_expression():
    pendulum = fb.compile_model(driven_pendulum(None))
    times = np.linspace(0.0, 2.0, 401)
    spline = (times, 0.1 * np.sin(5 * times))
    expected = fb.compile_model(driven_pendulum(a * sm.sin(w * t))).simulate((0.0, 2.0), [0.3, 0.0], rtol=1e-10)
    run = pendulum.simulate((0.0, 2.0), [0.3, 0.0], inputs={"s": spline}, rtol=1e-10, t_eval=expected.t)
    # The second derivative of a cubic spline errs by h^2 / 12 times the fourth: 1.3e-4 of 2.5, and more at the
    # ends; over two seconds that makes less than 1e-3 of the motion.
    np.testing.assert_allclose(run.y, expected.y, atol=1e-3)
    np.testing.assert_allclose(run["s"], 0.1 * np.sin(5 * run.t), atol=1e-8)
    np.testing.assert_allclose(run["s'"], 0.5 * np.cos(5 * run.t), atol=1e-5)


@pytest.mark.slow
def test_prescribed_motion_without_rates_is_refused():
    pendulum = fb.compile_model(driven_pendulum(None))
    with pytest.raises(fb.ModelError, match="s prescribes a motion"):
        pendulum.simulate((0.0, 1.0), [0.0, 0.0], inputs={"s": lambda t, x: 0.0})
    with pytest.raises(fb.ModelError, match="Input s has no source"):
        pendulum.simulate((0.0, 1.0), [0.0, 0.0])
    with pytest.raises(fb.ModelError, match="inputs s"):
        pendulum.kinetic_energy(0.0, [0.0, 0.0])
    # Also where others are given.
    crank = driven_slider_crank(None)
    F = me.dynamicsymbols("F")
    crank.system.add_loads(me.Force(crank.system.bodies[0].masscenter, F * crank.system.frame.x))
    values = {symbol: parameter.value for symbol, parameter in crank.parameter_symbols.items()}
    pushed = fb.compile_model(fb.Model(crank.system, name="pushed", parameters=values, inputs={s: None, F: None}))
    with pytest.raises(fb.ModelError, match="Input s has no value at t = 0"):
        pushed.initial_state(guess=[0.3, 0.9], inputs={"F": 1.0})
    np.testing.assert_allclose(pushed.initial_state(guess=[0.3, 0.9], inputs={"s": 0.3})[0], 0.3, rtol=1e-9)


def test_constraint_that_prescribes_a_motion_gives_closed_form_kinematics():
    crank = fb.compile_model(driven_slider_crank())
    p = {"w": 4.0}
    for time in (0.0, 0.3, 1.0):
        x0 = crank.initial_state(t=time, guess=[4.0 * time, 0.9], parameters=p)
        # Slider-crank kinematics: x = r cos(a) + sqrt(l^2 - r^2 sin(a)^2), differentiated twice for a = w t.
        angle = sm.Symbol("a")
        position = 0.2 * sm.cos(angle) + sm.sqrt(0.49 - 0.04 * sm.sin(angle) ** 2)
        expected = [float((4.0**k * position.diff((angle, k))).subs(angle, 4.0 * time)) for k in range(3)]
        np.testing.assert_allclose(x0, [4.0 * time, expected[0], 4.0, expected[1]], atol=1e-9)
        np.testing.assert_allclose(crank.rhs(time, x0, p)[2:], [0.0, expected[2]], atol=1e-8)
        # The driving torque does the slider's work: power m v v', over w.
        torque = 3.0 * expected[1] * expected[2] / 4.0
        assert crank.multipliers(time, x0, p)[0] == pytest.approx(torque, abs=1e-8)
    spline = (np.linspace(0.0, 1.0, 30), 4.0 * np.linspace(0.0, 1.0, 30))
    x0 = crank.initial_state(t=0.3, guess=[1.2, 0.9], parameters={"w": 0.0}, inputs={"s": spline})
    assert x0[2] == pytest.approx(4.0, rel=1e-12)


@pytest.mark.slow
def test_parameter_jacobian_through_a_driving_constraint_equals_the_closed_form():
    crank = fb.compile_model(driven_slider_crank(w * t**2))
    p = {"w": 4.0}
    x0 = crank.initial_state(t=0.3, guess=[0.36, 0.9], parameters=p)
    # The crank's acceleration is s'' = 2 w; the slider's has that times dx/ds, x = r cos(s) + sqrt(l^2 - r^2 sin(s)^2).
    s = 4.0 * 0.3**2
    slope = -0.2 * np.sin(s) - 0.04 * np.sin(s) * np.cos(s) / np.sqrt(0.49 - 0.04 * np.sin(s) ** 2)
    column = crank.parameter_jacobian(0.3, x0, p)[:, crank.parameters.index("w")]
    # The loop is closed to 1e-10.
    np.testing.assert_allclose(column, [0.0, 0.0, 2.0, 2.0 * slope], rtol=1e-9, atol=1e-12)


def drifting(*, carried=False, coupled=False):
    """Two masses at constant speeds, q' = u + s and z' = s v, of which positions, or a loop q = z, may take up s."""
    z, v, M = *me.dynamicsymbols("z v"), sm.Symbol("M")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    first, second = me.Point("P"), me.Point("Q")
    first.set_vel(ground, u * ground.x)
    second.set_vel(ground, v * ground.x)
    if carried:
        first.set_pos(origin, q * ground.x)
        first.set_vel(ground, q.diff(t) * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("first", first, m), me.Particle("second", second, M))
    system.add_kdes(q.diff(t) - u - s, z.diff(t) - (v if coupled else s * v))
    system.q_ind, system.u_ind = [q, z], [u, v]
    if coupled:
        system.q_ind, system.q_dep, system.u_ind, system.u_dep = [q], [z], [u], [v]
        system.add_holonomic_constraints(q - z)
    values = {m: 2.0, M: 3.0}
    return fb.Model(system, name=f"drifting_{carried:d}{coupled:d}", parameters=values, inputs={s: None})


@pytest.mark.slow
def test_input_of_kinematic_equations_alone_needs_no_rates():
    model = fb.compile_model(drifting())
    assert model.inputs == ("s",)
    # From 0 to 1 within 1 ms; a cubic spline through this table goes to 1000 and beyond.
    times, values = np.array([0.0, 1.0, 1.001, 1.1, 3.0]), np.array([0.0, 0.0, 1.0, 1.0, 1.0])
    x0 = [0.5, -0.25, 2.0, 3.0]  # q, z, u, v
    t_eval = np.linspace(0.0, 3.0, 31)
    integral = np.where(t_eval <= 1.0, 0.0, t_eval - 1.0005)
    expected = [0.5 + 2 * t_eval + integral, -0.25 + 3 * integral, np.full(31, 2.0), np.full(31, 3.0)]
    how = {"t_eval": t_eval, "rtol": 1e-8, "atol": 1e-10, "max_step": 0.02}
    for source in ((times, values), lambda time, x: np.interp(time, times, values)):
        run = model.simulate((0.0, 3.0), x0, inputs={"s": source}, **how)
        assert run["s"].min() == 0.0
        assert run["s"].max() == 1.0
        # A step that crosses the jump errs by what the tolerance allows.
        np.testing.assert_allclose(run.y, expected, atol=1e-6)
        np.testing.assert_array_equal(run.resample([0.5, 2.0])["s"], [0.0, 1.0])
    ensemble = model.ensemble((0.0, 3.0), x0, inputs={"s": (times, values)}, **how)
    np.testing.assert_allclose(ensemble.y[0], expected, atol=1e-6)
    np.testing.assert_allclose(model.input_jacobian(0.0, x0, r=[0.5]).T, [[1.0, 3.0, 0.0, 0.0]], rtol=1e-15)
    assert model.kinetic_energy(0.0, x0) == pytest.approx(0.5 * 2 * 4 + 0.5 * 3 * 9, rel=1e-15)


@pytest.mark.slow
def test_expression_without_rates_is_accepted_only_where_none_are_needed():
    switched = fb.Model(drifting().system, name="switched", inputs={s: sm.Heaviside(t - w)}, parameters={w: 1.0})
    model = fb.compile_model(switched)
    assert model.inputs == ("s",)
    x, p = [0.5, -0.25, 2.0, 3.0], {"m": 2.0, "M": 3.0}
    for time, expected in ((0.9, [2.0, 0.0]), (1.1, [3.0, 3.0])):
        np.testing.assert_array_equal(model.rhs(time, x, p), [*expected, 0.0, 0.0])
    carried = fb.Model(
        drifting(carried=True).system, name="carried", inputs={s: sm.Heaviside(t - w)}, parameters={w: 1.0}
    )
    run = fb.compile_model(carried).simulate((0.0, 2.0), x, parameters=p)
    assert run.t[-1] == pytest.approx(1.0, rel=1e-14)
    assert "Input s jumps at t = 1, which no finite force can cause" in run.message
    floored = fb.Model(drifting(carried=True).system, name="floored", inputs={s: sm.floor(t)})
    with pytest.raises(fb.ModelError, match="s prescribes a motion"):
        fb.compile_model(floored)


@pytest.mark.slow
def test_input_in_velocities_or_constraints_prescribes_a_motion_with_rates():
    # v = q' = u + s: the momentum m v is conserved.
    carried = fb.compile_model(drifting(carried=True))
    assert carried.inputs == ("s", "s'", "s''")
    np.testing.assert_allclose(carried.rhs(0.0, [0, 0, 1.0, 1.0], r=[0.5, 0.7, 0.9]), [1.5, 0.5, -0.7, 0], rtol=1e-14)
    assert carried.kinetic_energy(0.0, [0, 0, 1.0, 1.0], r={"s": 0.5}) == pytest.approx(1.5**2 + 1.5, rel=1e-14)
    with pytest.raises(fb.ModelError, match="inputs s"):
        carried.kinetic_energy(0.0, [0, 0, 1.0, 1.0])
    # u + s = v: m u' = -M v' with v' = u' + s'.
    coupled = fb.compile_model(drifting(coupled=True))
    assert coupled.inputs == ("s", "s'", "s''")
    rates = coupled.rhs(0.0, [0, 0, 1.0, 1.5], r=[0.5, 0.7, 0.9])
    np.testing.assert_allclose(rates, [1.5, 1.5, -0.7 * 3 / 5, 0.7 * 2 / 5], rtol=1e-14)
    for model in (carried, coupled):
        with pytest.raises(fb.ModelError, match="s prescribes a motion"):
            model.simulate((0.0, 1.0), np.zeros(4), inputs={"s": lambda t, x: 0.0})
    times = np.linspace(0.0, 1.0, 101)
    run = coupled.simulate((0.0, 1.0), np.zeros(4), inputs={"s": (times, times**3)}, rtol=1e-10, atol=1e-12)
    # A cubic spline through a cubic is that cubic.
    np.testing.assert_allclose(run["s'"], 3 * run.t**2, atol=1e-9)
    np.testing.assert_allclose(run.u, [-(run.t**3) * 3 / 5, run.t**3 * 2 / 5], atol=1e-9)


def test_parameter_that_is_an_expression_of_others_follows_them():
    density = sm.Symbol("density")
    values = {m: density * length, length: 0.5, g: 9.81, density: 4.0}
    model = fb.Model(driven_pendulum(None).system, name="derived", parameters=values, inputs={s: 0})
    pendulum = fb.compile_model(model)
    assert pendulum.parameters == ("l", "g", "density")
    assert pendulum.manifest["derived_parameters"] == {"m": "density*l"}
    # m l^2 u^2 / 2 for m = density l
    assert pendulum.kinetic_energy(0.0, [0.0, 2.0]) == pytest.approx(4.0 * 0.5**3 * 2.0**2 / 2, rel=1e-14)
    assert pendulum.kinetic_energy(0.0, [0.0, 2.0], {"l": 0.25}) == pytest.approx(4.0 * 0.25**3 * 2.0**2 / 2, rel=1e-14)
    with pytest.raises(fb.ModelError, match="no parameter 'm'"):
        pendulum.rhs(0.0, [0.0, 0.0], {"m": 1.0})


def test_inputs_auto_declares_functions_of_time_that_nobody_declared():
    """A spring and damper whose constants are functions of time, as SymBRiM's are; a constant for one of them stands
    among the parameters, beside names of other models."""
    q, u, k, c, q_ref = me.dynamicsymbols("q u k c q_ref")
    m = sm.Symbol("m")
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, q * ground.x)
    point.set_vel(ground, u * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("block", point, m))
    system.add_loads(me.Force(point, (-k * (q - q_ref) - c * u) * ground.x))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(t))
    values = {m: 2.0, k: 8.0, sm.Symbol("other_m"): 3.0}
    model = fb.compile_model(fb.Model(system, name="undeclared", parameters=values, inputs="auto", extra="ignore"))
    assert (model.parameters, model.inputs) == (("m",), ("c", "k", "q_ref"))
    # q'' = -4 (q - 1) from rest at 0
    run = model.simulate((0.0, 3.0), [0.0, 0.0], inputs={"q_ref": 1.0}, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run["q"], 1.0 - np.cos(2.0 * run.t), rtol=0, atol=1e-8)
    for others, sentence in (
        ({sm.Function("k", real=True)(t): 8.0}, "k has other assumptions in parameters="),
        ({me.dynamicsymbols("kk"): 8.0}, r"kk \(the nearest is k\)"),
    ):
        extra = "ignore" if "assumptions" in sentence else "raise"
        with pytest.raises(fb.ModelError, match=sentence):
            fb.Model(system, parameters={m: 2.0, **others}, inputs="auto", extra=extra)
    system.add_loads(me.Force(point, sm.Function("q", real=True)(t) * ground.x))
    with pytest.raises(fb.ModelError, match="has other assumptions than the state of that name"):
        fb.Model(system, parameters=values, inputs="auto", extra="ignore")


@pytest.mark.slow(but=["1000000.0-DOP853", "500000.0-DOP853", "1700000000.0-DOP853", "0.0-Radau"])
@pytest.mark.parametrize("method", ["DOP853", "Radau"])
@pytest.mark.parametrize("t_0", [0.0, 5e5, 1e6, 1.7e9])
def test_sample_at_the_end_of_a_motions_table_is_the_state_before_the_jump(t_0, method):
    """At times such as time stamps too, which are whole numbers of spacings of doubles apart from t_0.

    x = r cos(a) + sqrt(l^2 - r^2 sin(a)^2), with a and its rate by SciPy's spline. A sample that is a rounding error
    after the end is the one there.
    """
    crank = fb.compile_model(driven_slider_crank())
    p, since, values = {"w": 1.0}, np.array([0.0, 0.25, 0.5, 1.0]), np.array([0.0, 0.3, 0.9, 1.5])
    table = {"s": (t_0 + since, values, "cubic")}
    x0 = crank.initial_state(t=t_0, guess=[0.0, 0.9], parameters=p, inputs=table)
    end = t_0 + 1.0
    a, rate = 1.5, CubicSpline(since, values)(1.0, 1)
    root = np.sqrt(0.49 - 0.04 * np.sin(a) ** 2)
    v = rate * (-0.2 * np.sin(a) - 0.04 * np.sin(a) * np.cos(a) / root)
    wanted = [a, 0.2 * np.cos(a) + root, rate, v]
    how = {"method": method, "parameters": p, "inputs": table, "rtol": 1e-9, "atol": 1e-9}
    for stop, times in ((end, None), (end, [end]), (t_0 + 1.5, [end]), (t_0 + 1.5, [np.nextafter(end, np.inf)])):
        run = crank.simulate((t_0, stop), x0, t_eval=times, **how)
        assert run.success, run.message
        at = 0 if times else np.flatnonzero(run.t == end)[-1]
        # Up to the spacing of times, by which stages are rounded.
        np.testing.assert_allclose(run.y[:, at], wanted, atol=1e-8 + 4.0 * np.spacing(t_0))
        np.testing.assert_allclose(run.r[:2, at], [a, rate], atol=1e-8 + 4.0 * np.spacing(t_0))
        if times:
            assert run.t.tolist() == times
    backwards = crank.simulate((end, t_0), wanted, t_eval=[end], **how)
    np.testing.assert_allclose(backwards.y[:, 0], wanted, atol=1e-8 + 4.0 * np.spacing(t_0))


@pytest.mark.slow(but=["1000000.0"])
@pytest.mark.parametrize("t_0", [0.0, 1e6])
def test_inputs_at_samples_where_rates_jump_are_those_after_the_jump(t_0):
    """A crank that starts to turn: at a table's inner point, where the later interval counts, and by Heaviside.

    The value of Heaviside itself is the mean there; the states are those after the jump, and so are the inputs.
    """
    start = t_0 + 1.0
    turning = fb.compile_model(driven_slider_crank((t - w) * sm.Heaviside(t - w) / 5))
    by_table = {"s": ([t_0, start, start + 1.0], [0.0, 0.0, 0.2], "linear")}
    for inputs in (by_table, None):
        how = {"parameters": {"w": start}, "inputs": inputs}
        x0 = turning.initial_state(t=t_0, guess=[0.0, 0.9], **how)
        for time in (start, np.nextafter(start, -np.inf), np.nextafter(start, np.inf)):
            run = turning.simulate((t_0, t_0 + 1.5), x0, t_eval=[time], **how)
            assert run["rate"][0] == pytest.approx(0.2, rel=1e-9)
            assert run["s'"][0] == pytest.approx(0.2, rel=1e-9)
            assert run.t.tolist() == [time]
            assert np.abs(run.constraint_residual).max() < 1e-12 + np.spacing(t_0)


def test_input_at_the_end_of_a_run_where_its_rate_jumps_is_that_before_the_jump():
    """The state there is that before it, too; the value of Heaviside itself is the mean of both sides."""
    turning = fb.compile_model(driven_slider_crank((t - w) * sm.Heaviside(t - w) / 5))
    run = turning.simulate(
        (0.0, 1.0), turning.initial_state(guess=[0.0, 0.9], parameters={"w": 1.0}), parameters={"w": 1.0}
    )
    assert run.t[-1] == 1.0
    assert run["s'"][-1] == 0.0
    assert run["rate"][-1] == pytest.approx(0.0, abs=1e-12)  # at rest, to rounding
