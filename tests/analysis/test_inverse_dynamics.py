"""The inputs that a motion needs: closed forms of textbooks, drives that tell their torque, and what is refused."""

import warnings
from bisect import bisect
from math import pi, sqrt

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.friction import MU, box, compiled
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

RATE = 10.0
ANGLES = np.linspace(0.0, 2 * pi, 73)


def slider_crank(rod_mass=None, piston=2.0, torque="torque"):
    """Crank of 1 m, rod of 3 m."""
    points = {"O": (0, 0), "A": (0, 1), "C": (sqrt(8), 0)}
    linkage = fb.Linkage("engine", points=points, ground="O", links=["OA"])
    linkage.bar("A", "C", mass=rod_mass)
    linkage.slider("C", along=(1, 0), mass=piston)
    linkage.torque("O", torque)
    return linkage


def piston(angle):
    """x' and x'' of the slider by the crank's angle."""
    s = np.sqrt(9 - np.sin(angle) ** 2)
    first = -np.sin(angle) * (1 + np.cos(angle) / s)
    return first, -np.cos(angle) - np.cos(2 * angle) / s - np.sin(2 * angle) ** 2 / (4 * s**3)


@pytest.mark.slow
def test_torque_of_a_slider_crank_equals_the_closed_form_also_at_dead_points():
    """T = m w^2 x' x'', which follows from the kinetic energy; also at dead points, where no inertia is left.

    A. Ghosh and A. K. Mallik, Theory of Mechanisms and Machines, chapter on dynamic force analysis.
    """
    model = fb.compile_model(slider_crank().model())
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    first, second = piston(ANGLES)
    torque = model.inverse_dynamics(branch)["torque"]
    # Terms of the equations are as large as m w^2 r^2 = 200 N m.
    np.testing.assert_allclose(torque, 2.0 * RATE**2 * first * second, rtol=0, atol=1e-12 * 200)


@pytest.mark.slow
def test_torque_of_a_slider_crank_with_a_heavy_rod_equals_the_closed_form():
    """T = 1/2 w^2 dI/dt, with the inertia I reduced to the crank: of a uniform rod, differentiated by SymPy."""
    t = sm.Symbol("t")
    s = sm.sqrt(9 - sm.sin(t) ** 2)
    x = sm.cos(t) + s
    center = ((sm.cos(t) + x) / 2, sm.sin(t) / 2)
    inertia = 1.5 * sum(c.diff(t) ** 2 for c in center) + 1.5 * 9 / 12 * (sm.cos(t) / s) ** 2
    expected = sm.lambdify(t, (inertia / 2).diff(t) * RATE**2)
    model = fb.compile_model(slider_crank(1.5, None).model())
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    torque = model.inverse_dynamics(branch, "torque")["torque"]
    np.testing.assert_allclose(torque, expected(ANGLES), rtol=0, atol=1e-12 * 150)


@pytest.mark.slow
def test_torque_of_a_driven_run_equals_the_drives_multiplier():
    """A run in which a drive turns the crank, and its multiplier; the same run, of the model with a torque."""
    driven = slider_crank(1.5)
    driven.drive("O", speed=RATE)
    run = fb.compile_model(driven.model()).simulate((0.0, 1.0), rtol=1e-12, atol=1e-12)
    model = fb.compile_model(slider_crank(1.5).model())
    torque = model.inverse_dynamics(run)["torque"]
    np.testing.assert_allclose(torque, run["torque_O"], rtol=0, atol=1e-9 * np.ptp(torque))


@pytest.mark.slow
def test_inverse_dynamics_of_a_run_use_its_own_inputs_and_parameters():
    """The load and the masses of the run count, not the model's defaults."""
    linkage = slider_crank(1.5)
    linkage.force("C", ("load", 0))
    model = fb.compile_model(linkage.model())
    run = model.simulate(
        (0.0, 1.0), inputs={"load": lambda t, x: 50.0 * x[0], "torque": 40.0}, parameters={"m_AC": 2.5}, rtol=1e-10
    )
    np.testing.assert_allclose(model.inverse_dynamics(run, "torque")["torque"], 40.0, rtol=1e-9)
    np.testing.assert_allclose(
        model.inverse_dynamics(run, "torque", inputs={"load": 0.0})["torque"][0],
        40.0 + run["load"][0] * piston(run["q_OA"][0])[0],
        rtol=1e-9,
    )


def test_torques_of_a_robots_arm_equal_the_closed_form():
    """The joint torques in closed form: J. J. Craig, Introduction to Robotics, 2005, example 6.7."""
    l1, l2, m1, m2, g = 0.4, 0.3, 3.0, 2.0, 9.81
    linkage = fb.Linkage("arm", gravity=g)
    linkage.ground("A", (0, 0))
    linkage.joint("B", (l1, 0), mass=m1)
    linkage.joint("C", (l1 + l2, 0), mass=m2)
    linkage.bar("A", "B")
    linkage.bar("B", "C")
    linkage.torque("A", "shoulder")
    linkage.torque("B", "elbow", link="BC")
    model = fb.compile_model(linkage.model())
    t = np.linspace(0.0, 2.0, 21)
    one, two = 0.7 * np.sin(3 * t), 0.4 + 0.9 * np.cos(2 * t)  # the second is relative to the first link
    d1, d2 = 2.1 * np.cos(3 * t), -1.8 * np.sin(2 * t)
    a1, a2 = -6.3 * np.sin(3 * t), -3.6 * np.cos(2 * t)
    c2, s2, c12 = np.cos(two), np.sin(two), np.cos(one + two)
    elbow = m2 * l1 * l2 * (c2 * a1 + s2 * d1**2) + m2 * l2 * g * c12 + m2 * l2**2 * (a1 + a2)
    shoulder = (
        m2 * l2**2 * (a1 + a2) + m2 * l1 * l2 * c2 * (2 * a1 + a2) + (m1 + m2) * l1**2 * a1
        - m2 * l1 * l2 * s2 * (d2**2 + 2 * d1 * d2) + m2 * l2 * g * c12 + (m1 + m2) * l1 * g * np.cos(one)
    )  # fmt: skip
    states = {"q_AB": one, "q_BC": one + two, "u_AB": d1, "u_BC": d1 + d2}
    found = model.inverse_dynamics((t, states, {"u_AB": a1, "u_BC": a1 + a2}))
    np.testing.assert_allclose(found["shoulder"], shoulder, rtol=0, atol=1e-12 * np.ptp(shoulder))
    np.testing.assert_allclose(found["elbow"], elbow, rtol=0, atol=1e-12 * np.ptp(shoulder))
    found = model.kinematics(
        {"q_AB": one, "q_BC": one + two},
        rates={"q_AB": d1, "q_BC": d1 + d2},
        accelerations={"q_AB": a1, "q_BC": a1 + a2},
    )
    torque = model.inverse_dynamics(found[0], ["elbow", "shoulder"])
    assert [*torque] == ["elbow", "shoulder"]
    np.testing.assert_allclose(torque["elbow"], elbow, rtol=0, atol=1e-12 * np.ptp(shoulder))
    one_state = model.inverse_dynamics((0.0, [0.0, 0.0, 0.0, 0.0], [0.0, 0.0]))
    assert one_state["shoulder"] == pytest.approx((m1 + m2) * l1 * g + m2 * l2 * g, rel=1e-14)


@pytest.mark.slow
def test_torque_with_redundant_constraints_equals_the_closed_form():
    """A parallelogram with a bar too many: the coupler of 1 kg on two cranks, T = m l^2 w' + m g l cos(q)."""
    points = {"A": (0, 0), "B": (0, 1), "C": (1, 1), "D": (1, 0), "E": (0.5, 0), "F": (0.5, 1)}
    linkage = fb.Linkage("redundant", points=points, ground="AED", links=["AB", "CD", "EF"], gravity=9.81)
    linkage.plate("B", "F", "C", mass=1.0)
    linkage.torque("A", "torque")
    model = fb.compile_model(linkage.model())
    angles = np.linspace(0.5, 2.5, 9)
    branch = model.kinematics({"q_AB": angles}, rates={"q_AB": 3.0}, accelerations={"q_AB": 2.0})[0]
    torque = model.inverse_dynamics(branch)["torque"]
    np.testing.assert_allclose(torque, 2.0 + 9.81 * np.cos(angles), rtol=0, atol=1e-11)


def test_force_against_friction_by_a_normal_force_equals_the_closed_form():
    """F = m (u' + mu g), whatever the normal force is written as."""
    push = me.dynamicsymbols("F")
    model = compiled(box(lambda n, u: push - MU * n, name="pushed"), inputs={push: 0.0})
    t = np.linspace(0.0, 1.0, 5)
    states = {"q": t**2, "u": 2 * t}
    found = model.inverse_dynamics((t, states, {"u": 2.0}))
    np.testing.assert_allclose(found["F"], 2.0 * (2.0 + 0.3 * 9.81), rtol=1e-14)


@pytest.mark.slow
def test_torque_against_a_given_load_balances_its_power():
    """A load on the piston, as a function of time: its power is the torque's, without inertia."""
    linkage = slider_crank(piston=None)
    linkage.force("C", ("load", 0))
    model = fb.compile_model(linkage.model())
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    torque = model.inverse_dynamics(branch, "torque", inputs={"load": -40.0})["torque"]
    np.testing.assert_allclose(torque, 40.0 * piston(ANGLES)[0], rtol=0, atol=1e-12 * 40)
    load = model.inverse_dynamics(branch, "load", inputs={"torque": 5.0})["load"]
    dead = np.abs(np.sin(ANGLES)) < 1e-9
    assert np.isnan(load[dead]).all()
    np.testing.assert_allclose(load[~dead], -5.0 / piston(ANGLES[~dead])[0], rtol=1e-11)


@pytest.mark.slow
def test_load_as_array_callable_or_table_along_a_branch_gives_one_torque():
    """The array, the callable of the position, and the table of a motion in time are one load.

    Power balance: T = m w^2 x' x'' - cut x', with x' and x'' by the crank's angle.
    """
    linkage = slider_crank()
    linkage.force("C", ("cut", 0))
    model = fb.compile_model(linkage.model())
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    cut, times = -40.0 * np.sin(ANGLES) ** 2, ANGLES / RATE
    motion = (times, np.vstack((branch.q, branch.u)), branch.ud)
    first, second = piston(ANGLES)
    for how, load in (
        (branch, cut),
        (branch, lambda _, x: -40.0 * np.sin(x[0]) ** 2),
        (motion, (times, cut)),
        (motion, cut),
    ):
        torque = model.inverse_dynamics(how, "torque", inputs={"cut": load})["torque"]
        # Terms of the equations are as large as m w^2 r^2 = 200 N m.
        np.testing.assert_allclose(torque, (200.0 * second - cut) * first, rtol=0, atol=1e-12 * 200)
    ways = "an array with a value for each position, a callable of .t, x. .* the motion as .t, x, accelerations."
    with pytest.raises(fb.ModelError, match=f"cut is a table of time, but .* at its time, t = 0 s. Give {ways}"):
        model.inverse_dynamics(branch, "torque", inputs={"cut": (times, cut)})
    with pytest.warns(fb.ModelWarning, match="cut depends on time"):
        model.inverse_dynamics(branch, "torque", inputs={"cut": lambda t, _: -40.0 * t})
    for load, message in ((cut[:5], r"shape is \(73,\), not \(5,\)"), (np.where(cut < -39, np.nan, cut), "be finite")):
        with pytest.raises(fb.ModelError, match=message):
            model.inverse_dynamics(branch, "torque", inputs={"cut": load})
    # A position alone has the time at which it was found.
    place = model.kinematics({"q_OA": ANGLES[9]}, rates={"q_OA": RATE}, t=times[9])[0]
    torque = model.inverse_dynamics(place, "torque", inputs={"cut": (times, cut)})["torque"]
    assert torque == pytest.approx((200.0 * second[9] - cut[9]) * first[9], rel=1e-12)


def of_numbers(load):
    """A load that takes numbers alone, as compiled functions do."""

    def function(t, x):
        if not isinstance(t, float):
            raise TypeError
        return load(t, x)

    return function


@pytest.mark.parametrize(
    "load",
    [
        lambda t, _: np.interp(t, [0.2, 0.3, 0.4], [0.0, -100.0, 0.0]),
        lambda t, _: -100.0 * (0.2 < t < 0.4),
        lambda t, _: [0.0, -100.0, 0.0][np.searchsorted([0.2, 0.4], t)],
        lambda t, _: [0.0, -100.0, 0.0][bisect([0.2, 0.4], t)],
        lambda t, x: float(np.exp(-((t - x[0]) ** 2))) if x[0] > 3.0 else 0.0,
        of_numbers(lambda t, _: -100.0 * (12.0 < t < 12.6)),
    ],
)
def test_callable_load_of_time_for_states_at_one_time_gives_a_warning(load):
    """It is zero at almost all times, so that it is not seen at a few."""
    model = particles(F + G, inputs={F: 0.0, G: 0.0})
    branch = model.kinematics({"q1": np.linspace(0.0, 6.0, 13)}, accelerations={"q1": 4.0})[0]
    with pytest.warns(fb.ModelWarning, match=r"Input G depends on time, but all positions of a Branch .*, t = 0 s"):
        model.inverse_dynamics(branch, "F", inputs={"G": load})
    motion = (0.0, np.vstack((branch.q, branch.u)), branch.ud)
    with pytest.warns(fb.ModelWarning, match=r"Input G depends on time, but all states are at one time, t = 0 s"):
        model.inverse_dynamics(motion, "F", inputs={"G": load})


@pytest.mark.parametrize(
    "load",
    [
        lambda t, x: 3.0 * x[0],
        lambda t, x: 3.0 * x[0] if f"{t:g} {t}" else 0.0,
        of_numbers(lambda _, x: 3.0 * x[0]),
    ],
)
def test_callable_load_of_the_position_alone_gives_no_warning(load):
    """m q'' = F + 3 q at any time: there are no warnings."""
    model = particles(F + G, inputs={F: 0.0, G: 0.0})
    branch = model.kinematics({"q1": [0.0, 1.0]}, accelerations={"q1": 4.0})[0]
    for motion in (branch, (0.0, np.vstack((branch.q, branch.u)), branch.ud)):
        np.testing.assert_allclose(model.inverse_dynamics(motion, "F", inputs={"G": load})["F"], [8, 5], rtol=1e-14)


def test_loads_of_time_have_their_values_at_the_times_of_the_states():
    """A table, and expressions with a pulse, have a value at each time; several accelerations are of one state."""
    pulse = sm.Piecewise((100, (T > 0.2) & (T < 0.4)), (0, True))
    table, states = ([0.2, 0.3, 0.4], [0.0, 100.0, 0.0]), np.array([[0.0, 1.0, 2.0], [0.0, 0.0, 0.0]])
    times, of_pulse = [0.1, 0.3, 0.5], [8.0, -92.0, 8.0]
    model = particles(F + G, inputs={F: 0.0, G: pulse})
    for inputs in ({}, {"G": table}):
        found = model.inverse_dynamics((times, states, [4.0]), "F", inputs=inputs)["F"]
        np.testing.assert_allclose(found, of_pulse, rtol=1e-14)
    branch = model.kinematics({"q1": states[0]}, accelerations={"q1": 4.0})[0]
    for motion, words in ((branch, "all positions of a Branch"), ((0.0, states, [4.0]), "all states are at one time")):
        with pytest.warns(fb.ModelWarning, match=f"Input G depends on time, but {words}"):
            model.inverse_dynamics(motion, "F")
        with pytest.raises(fb.ModelError, match=f"Input G is a table of time, but {words}"):
            model.inverse_dynamics(motion, "F", inputs={"G": table})
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model.inverse_dynamics(motion, "F", inputs={"G": 0.0})
            model.inverse_dynamics(motion, "G", inputs={"F": 0.0})
    found = model.inverse_dynamics((0.3, states[:, 0], [[4.0, 5.0]]), "F", inputs={"G": table})["F"]
    np.testing.assert_allclose(found, [-92.0, -90.0], rtol=1e-14)
    written = particles(F + pulse, inputs={F: 0.0})
    np.testing.assert_allclose(written.inverse_dynamics((times, states, [4.0]))["F"], of_pulse, rtol=1e-14)
    with pytest.warns(fb.ModelWarning, match="equations of particles depend on time, but all positions of a Branch"):
        written.inverse_dynamics(branch)


def particles(*loads, place=0, mass=2, **options):
    """Particles on the x axis, each with a force, and a motion of the axis that is added to all positions."""
    n = len(loads)
    q, u = me.dynamicsymbols(f"q1:{n + 1}"), me.dynamicsymbols(f"u1:{n + 1}")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    system = System(frame, origin)
    masses = mass if isinstance(mass, tuple) else (mass,) * n
    for k, (load, m) in enumerate(zip(loads, masses, strict=True)):
        point = origin.locatenew(f"P{k + 1}", (q[k] + place) * frame.x)
        point.set_vel(frame, (u[k] + sm.sympify(place).diff(T)) * frame.x)
        system.add_bodies(me.Particle(f"P{k + 1}", point, m))
        system.add_loads(me.Force(point, load * frame.x))
    system.add_coordinates(*q)
    system.add_speeds(*u)
    system.add_kdes(*(w - c.diff(T) for c, w in zip(q, u, strict=True)))
    return fb.compile_model(fb.Model(system, name="particles", initial=dict.fromkeys((*q, *u), 0), **options))


T = me.dynamicsymbols._t
F, G, A = me.dynamicsymbols("F G A")


@pytest.mark.slow(but=["law1-8.0", "law0-10.0"])
@pytest.mark.parametrize(
    ("law", "force"),
    [(F + F**3, 10.0), (F**3, 8.0), (sm.sqrt(F), 3.0), (1 / F, 0.5), (F * sm.Abs(F), 9.0), (sm.exp(F), 5.0)],
)
def test_input_that_enters_nonlinearly_is_found_by_newtons_method(law, force):
    """By Newton's method, from several guesses; the law at what was found is the force."""
    model = particles(law, inputs={F: 0.0})
    found = model.inverse_dynamics((0.0, [0.0, 0.0], [force / 2.0]))["F"]
    assert float(law.subs(F, found)) == pytest.approx(force, rel=1e-8)


@pytest.mark.slow(but=["law0", "law2"])
@pytest.mark.parametrize("law", [F**3, F * sm.Abs(F), sm.sqrt(F), sm.sign(F) * sm.sqrt(sm.Abs(F)), F**2])
def test_input_that_enters_nonlinearly_is_zero_for_a_zero_load(law):
    """0 is the solution, although the derivative there is 0 or infinite."""
    model = particles(law, inputs={F: 2.0})
    assert model.inverse_dynamics((0.0, [0.0, 0.0], [0.0]))["F"] == 0.0


@pytest.mark.parametrize("law", [1 / F, sm.exp(F)])
def test_load_that_no_input_brings_about_is_refused(law):
    model = particles(law, inputs={F: 0.0})
    with pytest.raises(fb.SimulationError, match="F cannot bring about this motion"):
        model.inverse_dynamics((0.0, [0.0, 0.0], [0.0]))


def test_input_that_is_a_small_difference_of_spring_forces_is_found_to_rounding():
    """m g = (k (s - h) - F) q / s on a spring of length s, across a gap h: F is a small difference, down to 0."""
    q = me.dynamicsymbols("q1")
    k, g, h = sm.symbols("k g h")
    s = sm.sqrt(q**2 + h**2)
    law = (F - k * (s - h)) * q / s + 2 * g
    model = particles(law, inputs={F: 0.0}, parameters={k: 200.0, g: 9.81, h: 0.37})
    generator = np.random.default_rng(0)
    for place in generator.uniform(0.2, 1.2, 40):
        length = np.hypot(place, 0.37)
        stiffness = 2 * 9.81 * length / place / (length - 0.37)
        places = place * (1 + np.arange(-3, 4) * 2.0**-52)
        force = model.inverse_dynamics((0.0, [places, 0 * places], [0.0]), parameters={"k": stiffness})["F"]
        # Rounding errors of the spring's force and of its change over the distances of the places.
        np.testing.assert_allclose(force, 0.0, rtol=0, atol=20 * 2.0**-52 * stiffness)


def test_free_length_that_balances_an_arm_is_zero_in_all_positions():
    """A spring without free length balances an arm in all positions if k a b = m g l; its free length is the input."""
    points = {"O": (0, 0), "A": (0.6, 0), "B": (1, 0), "C": (0, 0.5)}
    linkage = fb.Linkage("balanced", points=points, ground=["O", "C"], gravity=9.81)
    linkage.plate("O", "A", "B", mass=3.0, center=(1, 0), inertia=0)
    linkage.spring("C", "A", 3.0 * 9.81 / (0.6 * 0.5), length="free")
    model = fb.compile_model(linkage.model())
    angles = np.linspace(-1.5, 1.5, 31)
    free = model.inverse_dynamics((0.0, [angles, 0 * angles], [0.0]))["free"]
    np.testing.assert_allclose(free, 0.0, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_voltage_of_a_quadratic_torque_passes_zero_at_dead_points():
    """A torque of 3 V |V|, as of a fan or an orifice: at the dead points no torque is needed, so V = 0."""
    V = me.dynamicsymbols("V")
    model = fb.compile_model(slider_crank(torque=3 * V * sm.Abs(V)).model(inputs={V: 0.0}))
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    first, second = piston(ANGLES)
    V = model.inverse_dynamics(branch)["V"]
    np.testing.assert_allclose(3.0 * V * np.abs(V), 2.0 * RATE**2 * first * second, rtol=0, atol=1e-12 * 200)


def test_inputs_of_very_different_sizes_are_each_found_to_rounding():
    """1000 tonnes beside 10 grams, of which the force is nonlinear in the input: G + G^3 = 1 N and 0.2 N."""
    model = particles(F, G + G**3, mass=(1e6, 0.01), inputs={F: 0.0, G: 0.0})
    for rates in ([1000.0, 100.0], [10.0, 20.0]):
        found = model.inverse_dynamics((0.0, np.zeros(4), rates))
        assert found["G"] + found["G"] ** 3 == pytest.approx(0.01 * rates[1], rel=1e-9)
        assert found["F"] == pytest.approx(1e6 * rates[0], rel=1e-12)


def test_force_beside_a_prescribed_motion_counts_its_second_rate():
    """F = m (q'' + A''), where A is given by its expression, or by the drive."""
    model = particles(F, place=A, inputs={A: sm.sin(T), F: 0.0})
    found = model.kinematics({"q1": [0.0, 1.0]}, t=1.0)[0]
    np.testing.assert_allclose(model.inverse_dynamics(found)["F"], -2.0 * np.sin(1.0), rtol=1e-14)
    how = {"rates": {"q1": 1.0}, "accelerations": {"A": 5.0, "q1": 1.0}}
    found = model.kinematics({"q1": [0.0, 1.0], "A": [0.0, 0.0]}, **how)[0]
    np.testing.assert_allclose(model.inverse_dynamics(found)["F"], 12.0, rtol=1e-14)
    with pytest.raises(fb.ModelError, match="A cannot be found: it prescribes a motion"):
        model.inverse_dynamics(found, "A")


def test_input_whose_rate_acts_on_the_motion_is_refused_as_unknown():
    """The other end of a damper moves by an input: its rate is an input of its own."""
    q, u = me.dynamicsymbols("q1 u1")
    model = particles(F - 3 * (u - A.diff(T)) - 5 * (q - A), inputs={F: 0.0, A: sm.sin(3 * T)})
    run = model.simulate((0.0, 1.0), inputs={"F": 2.0})
    np.testing.assert_allclose(model.inverse_dynamics(run)["F"], 2.0, rtol=1e-12)
    with pytest.raises(fb.ModelError, match="A cannot be found: it prescribes a motion"):
        model.inverse_dynamics(run, "A")


def test_run_without_the_rates_that_a_model_needs_is_refused():
    """A spring's end whose rate one model needs, and another has not."""
    q, u = me.dynamicsymbols("q1 u1")
    spring = particles(F - 5 * (q - A), inputs={F: 1.0, A: sm.sin(3 * T)})
    damped = particles(F - 3 * (u - A.diff(T)) - 5 * (q - A), inputs={F: 0.0, A: sm.sin(3 * T)})
    run = spring.simulate((0.0, 1.0))
    with pytest.raises(fb.ModelError, match="tells A, but not A'"):
        damped.inverse_dynamics(run)
    table = (np.linspace(0.0, 1.0, 201), np.sin(3 * np.linspace(0.0, 1.0, 201)))
    force = damped.inverse_dynamics(run, inputs={"A": table})["F"]
    expected = 1.0 + 3.0 * (run["u1"] - 3.0 * np.cos(3.0 * run.t))
    # The spline's derivative errs by h^3 / 24 times the fourth derivative.
    np.testing.assert_allclose(force[5:-5], expected[5:-5], rtol=0, atol=0.005**3 * 81 * 3)


def test_inverse_dynamics_of_a_branch_use_its_inputs_and_refuse_missing_ones():
    """A force that is given with the positions, and one without a value there."""
    model = particles(F + G, inputs={F: 0.0, G: None})
    found = model.kinematics({"q1": [0.0]}, accelerations={"q1": 4.0}, inputs={"G": 5.0})[0]
    assert model.inverse_dynamics(found, "F")["F"] == pytest.approx(3.0)
    found = model.kinematics({"q1": [0.0]}, accelerations={"q1": 4.0})[0]
    with pytest.raises(fb.ModelError, match="G has no source"):
        model.inverse_dynamics(found, "F")


def test_load_of_time_on_a_branch_counts_at_its_time_with_a_warning():
    """All positions are at the branch's time, which is said, since it may not be meant."""
    model = particles(F + G, inputs={F: 0.0, G: 3 * T})
    found = model.kinematics({"q1": [0.0, 1.0]}, accelerations={"q1": 4.0}, t=2.0)[0]
    with pytest.warns(fb.ModelWarning, match="G depends on time, but all positions .* at its time, t = 2 s"):
        np.testing.assert_allclose(model.inverse_dynamics(found, "F")["F"], [2.0, 2.0])
    np.testing.assert_allclose(model.inverse_dynamics(found, "F", inputs={"G": np.array([1.0, 5.0])})["F"], [7.0, 3.0])
    with pytest.raises(fb.ModelError, match="A prescribes a motion: an array does not tell its rates"):
        particles(F, place=A, inputs={A: 0, F: 0}).inverse_dynamics(
            (0.0, np.zeros((2, 2)), [0.0]), "F", inputs={"A": np.zeros(2)}
        )


def test_inverse_dynamics_of_one_state_take_several_accelerations():
    model = particles(F, inputs={F: 0.0})
    np.testing.assert_allclose(model.inverse_dynamics((0.0, {"q1": 0.0, "u1": 0.0}, {"u1": [1.0, 2.0]}))["F"], [2, 4])
    np.testing.assert_allclose(model.inverse_dynamics(([0.0, 1.0], [0.0, 0.0], [3.0]))["F"], [6.0, 6.0])


@pytest.mark.slow
def test_inverse_dynamics_with_wrong_motions_or_inputs_are_refused():
    model = fb.compile_model(slider_crank().model())
    branch = model.kinematics({"q_OA": ANGLES}, rates={"q_OA": RATE})[0]
    x = np.concatenate((branch.q, branch.u))
    for motion, find, more, message in (
        (branch, "T", {}, "no input 'T'. There are torque"),
        (branch, ["torque", "torque"], {}, "torque is given twice"),
        (branch, "torque", {"inputs": {"torque": 1.0}}, "torque is given twice"),
        (branch, None, {"inputs": {"torque": 1.0}}, "1 degrees of freedom, so it determines as many inputs, not 0"),
        (x, None, {}, "A motion is a Branch, a Trajectory, or"),
        ((0.0, x, branch.ud[:, :3]), None, {}, "as many instants, or of one"),
        ((0.0, np.zeros((6, 0)), np.zeros((3, 0))), None, {}, "at none of its 0 states: there are none"),
        ((0.0, x, {}), None, {}, "rates of speeds that determine all"),
        ((0.0, x, branch.ud + 1.0), None, {}, "violate the constraints: J u' [+] gamma"),
        ((0.0, x + 0.1, branch.ud), None, {}, "violates the constraints at t = 0"),
        ((np.zeros(3), x, branch.ud), None, {}, "as many instants, or of one"),
    ):
        with pytest.raises(fb.ModelError, match=message):
            model.inverse_dynamics(motion, find, **more)
    other = fb.compile_model(fb.models.slider_crank())
    with pytest.raises(fb.ModelError, match="do not tell crank, rod, slide, crank_rate"):
        other.inverse_dynamics(branch, "torque")


@pytest.mark.slow
def test_inverse_dynamics_without_masses_are_refused_until_given():
    system = fb.models.four_bar().system
    lengths = {"l1": 0.8, "l2": 0.2, "l3": 0.7, "l4": 0.6}
    model = fb.compile_model(fb.Model(system, name="no_masses", parameters=lengths, inputs="auto"))
    branch = model.kinematics({"q1": np.linspace(0.1, 1.0, 4)})[0]
    with pytest.raises(fb.ModelError, match="No value for parameter"):
        model.inverse_dynamics(branch, "F")
    values = {name: 1.0 for name, value in model.defaults.items() if value is None}
    assert np.isfinite(model.inverse_dynamics(branch, "F", parameters=values)["F"]).all()
