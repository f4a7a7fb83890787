"""Energies against closed forms and against each other through the motion."""

import gc
import time

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations
from fourbar_codegen.expressions.antiderivatives import antiderivative
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.tape import Tape
from fourbar_codegen.linkage.linkage import Linkage


def test_energies_of_the_four_bar_at_random_states_equal_closed_forms(four_bar):
    # Thin rods of mass rho l: T = sum m v.v / 2 + m l^2/12 w^2 / 2, V = sum m g y, heights from the centre of link 1.
    generator = np.random.default_rng(3)
    rho, g = 100.0, 9.81
    lengths = np.array([0.5, 1.0, 0.7])
    for x in generator.uniform(-2.0, 2.0, (20, 6)):
        angles, rates = np.cumsum(x[:3]), np.cumsum(x[3:])
        along = lengths * np.exp(1j * angles)
        velocities = 1j * rates * along
        centre_velocities = np.cumsum(velocities) - velocities / 2
        heights = (np.cumsum(along) - along / 2).imag
        masses = rho * lengths
        kinetic = (masses * np.abs(centre_velocities) ** 2 / 2 + masses * lengths**2 / 12 * rates**2 / 2).sum()
        potential = (masses * g * heights).sum()
        # A dozen terms of up to 1e4 J.
        assert four_bar.kinetic_energy(0.0, x) == pytest.approx(kinetic, rel=1e-13)
        assert four_bar.potential_energy(0.0, x) == pytest.approx(potential, rel=1e-13, abs=1e-11)


def test_energy_is_conserved_without_loads(four_bar):
    parameters = {"k": 0.0, "c": 0.0}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    run = four_bar.simulate((0.0, 4.0), x0, parameters=parameters, inputs={"F": 0.0}, rtol=1e-11, atol=1e-11)
    assert run.success
    # Steps of relative error 1e-11 in states around 1, energies of several hundred joules.
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-6)


def test_energy_changes_by_the_work_of_the_force(four_bar):
    # With the spring-damper off, d(T + V)/dt = F v_x at the third joint.
    parameters = {"k": 0.0, "c": 0.0}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    t = np.linspace(0.0, 1.0, 2001)
    run = four_bar.simulate((0.0, 1.0), x0, parameters=parameters, rtol=1e-11, atol=1e-11, t_eval=t)
    q, u = np.cumsum(run.q, axis=0), np.cumsum(run.u, axis=0)
    velocity = -0.5 * u[0] * np.sin(q[0]) - 1.0 * u[1] * np.sin(q[1])
    power = 100 * np.sin(np.pi * t) * velocity
    work = np.concatenate(([0.0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(t))))
    # The trapezoidal rule errs by h^2/12 times the power's second derivative, here below 1e5.
    np.testing.assert_allclose(run.energy - run.energy[0], work, atol=5e-3)


def test_power_with_an_absolute_rate_of_a_relative_angle_equals_the_closed_form():
    """Of a torque on the second bar, at its absolute rate; it is known as the rate follows from both angles."""
    (q1, q2), (u1, u2), torque = me.dynamicsymbols("q1 q2"), me.dynamicsymbols("u1 u2"), sm.Symbol("torque")
    n, a, b, origin = *(me.ReferenceFrame(name) for name in "NAB"), me.Point("O")
    a.orient_axis(n, n.z, q1)
    b.orient_axis(a, n.z, q2)
    a.set_ang_vel(n, u1 * n.z)
    b.set_ang_vel(n, u2 * n.z)
    origin.set_vel(n, 0)
    system = System(n, origin)
    system.add_bodies(*(me.RigidBody(bar.name, origin, bar, 1, (me.inertia(bar, 0, 0, 1), origin)) for bar in (a, b)))
    system.add_coordinates(q1, q2)
    system.add_speeds(u1, u2)
    system.add_kdes(u1 - q1.diff(), u2 - q1.diff() - q2.diff())
    system.add_loads(me.Torque(b, torque * n.z))
    equations = form_equations(fb.Model(system, name="absolute"))
    leaves = (*equations.variables.coordinates, *equations.variables.speeds, *equations.variables.parameters)
    at = dict(zip(leaves, (0.3, -0.5, 2.0, 0.7, 11.0), strict=True))
    assert equations.tape.evaluate(equations.energy.power.entries, at) == pytest.approx([11.0 * 0.7], rel=1e-15)


def test_energy_growth_is_reported_for_negative_damping_and_not_for_forces():
    """A mass from rest by forces t^n has 4^(n + 1) times the kinetic energy at the end that it had half way, though
    its steps grow so that none ends near there; what a negative damping feeds has grown."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    x, u, force = me.dynamicsymbols("x u F")
    place = origin.locatenew("P", x * frame.x)
    origin.set_vel(frame, 0)
    place.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("P", place, sm.S.One))
    system.add_coordinates(x)
    system.add_speeds(u)
    system.add_kdes(u - x.diff())
    system.add_loads((place, force * frame.x))
    mass = fb.compile_model(fb.Model(system, name="pushed", inputs={force: 0.0}, initial={x: 0.0, u: 0.0}))
    for n in range(4):
        for span, rtol in (((0.0, 10.0), 1e-6), ((0.0, 10.0), 1e-10), ((0.0, -10.0), 1e-6)):
            run = mass.simulate(span, inputs={"F": lambda t, _, n=n: t**n}, rtol=rtol)
            assert run.kinetic_energy[-1] == pytest.approx((10.0 ** (n + 1) / (n + 1)) ** 2 / 2, rel=1e-4)
            assert "has grown" not in run.message
    fed = mass.simulate((0.0, 10.0), [0.0, 1e-3], inputs={"F": lambda _, x: 2.0 * x[1]})
    assert "has grown" in fed.message


@pytest.mark.slow
def test_energy_of_a_mechanism_at_rest_is_constant_without_a_report_of_growth():
    """Three cranks stand upright below a bar: 2 kg/m (3 0.2 m 0.1 m + 0.6 m 0.2 m) g, and nothing moves."""
    points = {"A": (0, 0), "B": (0, 0.2), "C": (0.3, 0), "D": (0.3, 0.2), "E": (0.6, 0), "F": (0.6, 0.2)}
    links = ["AB", "CD", "EF", "BDF"]
    model = Linkage("upright", points=points, ground="ACE", links=links, density=2.0, gravity=9.81).model()
    run = fb.compile_model(model).simulate((0.0, 2.0), rtol=1e-9, atol=1e-9)
    assert run.energy[[0, -1]] == pytest.approx(2 * 0.18 * 9.81, rel=1e-12)
    assert "has grown" not in run.message


VALUES = {"m": 2.0, "g": 9.81, "k": 30.0, "a": 7.0, "l": 0.6, "s": 0.4, "c": 3.0}


def oscillators(*, own=None, law=None):
    """A block on a rail, a ball in the plane of the rail, and a wheel; springs and dampers hold them."""
    m, g, k, a, free, s, c = sm.symbols("m g k a l s c")
    (x, y, z, turn), (vx, vy, vz, spin) = me.dynamicsymbols("x y z turn"), me.dynamicsymbols("vx vy vz spin")
    push = me.dynamicsymbols("push")
    ground, origin, wheel = me.ReferenceFrame("N"), me.Point("O"), me.ReferenceFrame("W")
    origin.set_vel(ground, 0)
    wheel.orient_axis(ground, ground.z, turn)
    wheel.set_ang_vel(ground, spin * ground.z)
    ball, block = origin.locatenew("ball", x * ground.x + y * ground.y), origin.locatenew("block", z * ground.x)
    ball.set_vel(ground, vx * ground.x + vy * ground.y)
    block.set_vel(ground, vz * ground.x)
    system = System(ground, origin)
    rim = me.RigidBody("wheel", origin, wheel, m, (me.inertia(wheel, 0, 0, m), origin))
    bodies = me.Particle("ball", ball, m), me.Particle("block", block, m), rim
    system.add_bodies(*bodies)
    system.add_coordinates(x, y, z, turn)
    system.add_speeds(vx, vy, vz, spin)
    system.add_kdes(vx - x.diff(), vy - y.diff(), vz - z.diff(), spin - turn.diff())
    path = me.LinearPathway(origin, ball)
    stretch, rate = path.length - free, path.extension_velocity
    if law is not None:
        system.add_actuators(me.ForceActuator(law(path.length), path))
    else:
        system.add_actuators(
            me.LinearSpring(k, path, free),
            me.ForceActuator(-a * stretch**3 - c * rate, path),
            me.DuffingSpring(2 * k, a, me.LinearPathway(block, ball)),  # its cube of the length is (x^2)^(3/2)
            me.DuffingSpring(5, 3, me.LinearPathway(origin, block), 1),
            me.TorqueActuator(-k * (2 * turn - s) - c * spin, wheel.z, wheel, ground),
        )
        system.add_loads((ball, (m * g - k * x - k * (x - z) - c * vx) * ground.x), (block, k * (x - z) * ground.x))
        system.add_loads((block, (push - a * sm.Max(0, z - free)) * ground.x))
    if own is not None:
        bodies[0].potential_energy = own(k, path.length, free, a)
    return fb.Model(
        system, name="oscillators", parameters=VALUES, inputs={push: 0.0} if law is None else None, extra="ignore"
    )


def potential(x, y, z, turn):
    """By hand."""
    m, g, k, a, free, s, _ = VALUES.values()
    length, between, beyond = np.hypot(x, y), np.hypot(x - z, y), np.maximum(0.0, z - free)
    energy = k * (length - free) ** 2 / 2 + a * (length - free) ** 4 / 4 + k * between**2 + a * between**4 / 4
    energy += 5 * (abs(z) - 1) ** 2 / 2 + 3 * (abs(z) - 1) ** 4 / 4 + k * (2 * turn - s) ** 2 / 4
    return energy - m * g * x + k * x**2 / 2 + k * (x - z) ** 2 / 2 + a * beyond**2 / 2


def energies(model, states):
    """The potential energy, evaluated without C."""
    equations = form_equations(model)
    values = {leaf: VALUES[name] for leaf, name in zip(equations.variables.parameters, model.parameters, strict=True)}
    leaves = (*equations.variables.coordinates, *equations.variables.speeds)
    points = ({**values, **dict(zip(leaves, x, strict=True))} for x in states)
    return np.array([equations.tape.evaluate([equations.energy.energies.entries[1]], point)[0] for point in points])


def test_potential_energy_of_springs_equals_the_closed_form_and_is_conserved():
    """Along a length, about an axis, by hand in loads; without dampers and inputs that act in the same actuator."""
    compiled = fb.compile_model(oscillators())
    assert compiled.energy_without == ()
    states = np.random.default_rng(1).uniform(-1.5, 1.5, (30, 8))
    found = [compiled.potential_energy(0.0, state) for state in states]
    expected = [potential(*state[:4]) for state in states]
    # A constant is free. Terms of some 100 J, each to rounding.
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=0, atol=1e-11)
    x0 = [0.9, 0.3, 0.5, 0.2, 0.0, 1.0, 0.0, -1.0]
    run = compiled.simulate((0.0, 3.0), x0, parameters={"c": 0.0}, rtol=1e-11, atol=1e-11)
    assert np.ptp(run.kinetic_energy) > 5.0
    # Some 300 steps of relative error 1e-11; the stop at l is a kink of the force.
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_potential_of_a_spring_that_a_body_states_is_not_counted_twice():
    states = np.random.default_rng(1).uniform(-1.5, 1.5, (10, 8))
    expected = [potential(*state[:4]) for state in states]
    model = oscillators(own=lambda k, length, free, _: k * (length - free) ** 2 / 2)
    np.testing.assert_allclose(np.diff(energies(model, states)), np.diff(expected), rtol=0, atol=1e-11)
    both = oscillators(own=lambda k, length, free, a: k * (length - free) ** 2 / 2 + a * (length - free) ** 4 / 4)
    np.testing.assert_allclose(np.diff(energies(both, states)), np.diff(expected), rtol=0, atol=1e-11)
    other = oscillators(own=lambda k, length, free, a: k * length**3)  # no load's
    assert np.isnan(energies(other, states)).all()


def test_potential_energy_of_a_linkages_springs_equals_the_closed_form():
    linkage = Linkage("sprung", points={"A": (0, 0), "B": (1, 0), "C": (1, 1)}, ground="AC", links=["AB"], density=3.0)
    linkage.spring("B", "C", 40.0, length=0.8)
    linkage.torque("A", -5.0 * (linkage.q["AB"] - 0.3))
    run = fb.compile_model(linkage.model()).simulate((0.0, 2.0), rtol=1e-11, atol=1e-11)
    angle = run["q_AB"]
    stretch = np.hypot(np.cos(angle) - 1.0, np.sin(angle) - 1.0) - 0.8
    expected = 20.0 * stretch**2 + 2.5 * (angle - 0.3) ** 2
    np.testing.assert_allclose(run.potential_energy - run.potential_energy[0], expected - expected[0], atol=1e-12)
    assert np.ptp(run.kinetic_energy) > 0.5
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-8)  # steps of relative error 1e-11


@pytest.mark.slow
def test_spring_without_antiderivative_is_named_in_runs_files_and_plots(tmp_path):
    """In runs, files, tables and plots, also after a run was saved and read."""
    model = oscillators(law=lambda length: -30 * sm.sin(sm.exp(length)) / (1 + length**4))
    run = fb.compile_model(model).simulate((0.0, 1.0), [0.9, 0.3, 0.5, 0.2, 0.0, 1.0, 0.0, -1.0])
    name = "ForceActuator O - ball"
    assert run.energy_without == (name,)
    assert (run.potential_energy == 0.0).all()
    text = run.save(tmp_path / "run.csv").read_text()
    assert f",potential_energy without {name} [J],energy without {name} [J]," in text
    assert name in run.save(tmp_path / "run.html").read_text()
    assert run.to_xarray().potential_energy.attrs["without"] == name
    for suffix in (".npz", ".nc"):
        assert fb.load_trajectory(run.save(tmp_path / f"run{suffix}")).energy_without == (name,)
    assert [axes.get_title(loc="left") for axes in run.plot(["x", "energy"]).axes] == [
        "x (rad or m)",
        f"energy without {name} (J)",
    ]


def disc(*loads, rates="inertial"):
    """A body in the plane: speeds along the axes, or of the body, or a sum of rates. Loads are functions of its frames,
    points and coordinates."""
    (x, y, turn), (a, b, spin) = me.dynamicsymbols("x y turn"), me.dynamicsymbols("a b spin")
    ground, body, origin = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O")
    body.orient_axis(ground, ground.z, turn)
    body.set_ang_vel(ground, spin * ground.z)
    centre = origin.locatenew("C", x * ground.x + y * ground.y)
    velocity = {
        "inertial": a * ground.x + b * ground.y,
        "body": a * body.x + b * body.y,
        "sums": a * ground.x + (b - a) * ground.y,
    }[rates]
    origin.set_vel(ground, 0)
    centre.set_vel(ground, velocity)
    rim = centre.locatenew("R", body.x / 2)
    rim.v2pt_theory(centre, ground, body)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("disc", centre, body, sm.S(2), (me.inertia(body, 0, 0, 1), centre)))
    system.add_coordinates(x, y, turn)
    system.add_speeds(a, b, spin)
    system.add_kdes(x.diff() - velocity.dot(ground.x), y.diff() - velocity.dot(ground.y), turn.diff() - spin)
    system.add_loads(*(load(ground, body, origin, centre, rim, x, y, turn) for load in loads))
    initial = {x: 0.7, y: 0.2, turn: 0.3, a: 0.2, b: -0.4, spin: 2.0}
    return fb.Model(system, name="disc", initial=initial)


def radial(n, _b, origin, centre, *_):
    arm = centre.pos_from(origin)
    return me.Force(centre, -10 * (arm.magnitude() - 0.4) * arm.normalize())


@pytest.mark.slow
@pytest.mark.parametrize("rates", ["inertial", "body", "sums"])
def test_springs_as_loads_have_a_potential_with_every_choice_of_speeds(rates):
    """A spring at the centre, one at the rim, and a force and a torque that have a potential together alone."""
    model = disc(
        radial,
        lambda n, b, o, c, rim, *_: me.Force(rim, -8 * (rim.pos_from(o) - 3 * n.y)),
        lambda n, b, o, c, rim, x, y, turn: me.Force(c, -5 * turn * sm.cos(x) * n.x),
        lambda n, b, o, c, rim, x, y, turn: me.Torque(b, -5 * sm.sin(x) * n.z),
        rates=rates,
    )
    compiled = fb.compile_model(model)
    assert compiled.energy_without == ()
    run = compiled.simulate((0.0, 1.0), rtol=1e-11, atol=1e-11)
    x, y, turn = run.q
    rim = np.array([x + np.cos(turn) / 2, y + np.sin(turn) / 2 - 3.0])
    expected = 5 * (np.hypot(x, y) - 0.4) ** 2 + 4 * (rim**2).sum(axis=0) + 5 * turn * np.sin(x)
    assert np.ptp(run.kinetic_energy) > 5.0
    # Terms of some 50 J to rounding, and some 100 steps of relative error 1e-11.
    np.testing.assert_allclose(run.potential_energy - run.potential_energy[0], expected - expected[0], atol=1e-11)
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("rates", ["inertial", "body"])
def test_loads_without_potential_leave_that_of_a_spring_beside_them(rates):
    """A force with curl, one that turns with the body, a damper and a motor, beside a spring of two components."""
    model = disc(
        lambda n, b, o, c, rim, x, y, turn: me.Force(c, 3 * x * y * n.x),
        lambda n, b, o, c, rim, *_: me.Force(rim, 5 * b.y),
        lambda n, b, o, c, *_: me.Force(c, -2 * c.vel(n)),
        lambda n, b, *_: me.Torque(b, (3 - b.ang_vel_in(n).dot(n.z)) * n.z),
        radial,
        rates=rates,
    )
    compiled = fb.compile_model(model)
    assert compiled.energy_without == ()
    states = np.random.default_rng(2).uniform(-1.5, 1.5, (10, 6))
    found = [compiled.potential_energy(0.0, state) for state in states]
    expected = [5 * (np.hypot(*state[:2]) - 0.4) ** 2 for state in states]
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=0, atol=1e-12)  # 20 J, to rounding


@pytest.mark.slow
@pytest.mark.parametrize("relative", [True, False])
def test_spring_whose_integral_is_not_found_is_named_with_any_speeds(relative):
    """The loads of an actuator at a double pendulum, as KanesMethod takes them; its speeds are relative or absolute."""
    (q1, q2), (u1, u2) = me.dynamicsymbols("q1 q2"), me.dynamicsymbols("u1 u2")
    n, a, b, origin = *(me.ReferenceFrame(name) for name in "NAB"), me.Point("O")
    a.orient_axis(n, n.z, q1)
    b.orient_axis(a, n.z, q2)
    a.set_ang_vel(n, u1 * n.z)
    b.set_ang_vel(n, (u1 + u2 if relative else u2) * n.z)
    origin.set_vel(n, 0)
    elbow = origin.locatenew("P", -a.y)
    elbow.v2pt_theory(origin, n, a)
    tip, hook = elbow.locatenew("Q", -b.y), origin.locatenew("H", 1.5 * n.x)
    tip.v2pt_theory(elbow, n, b)
    hook.set_vel(n, 0)
    kinematic = [u1 - q1.diff(), u2 - q2.diff() - (0 if relative else q1.diff())]
    method = me.KanesMethod(
        n,
        [q1, q2],
        [u1, u2],
        kd_eqs=kinematic,
        bodies=[me.Particle("p", elbow, sm.S(1)), me.Particle("q", tip, sm.S(1))],
        forcelist=me.LinearSpring(20, me.LinearPathway(tip, hook), 0.4).to_loads(),
    )
    assert form_equations(fb.Model(method)).energy.without == ("force at point Q",)


def test_load_with_fewer_speeds_than_coordinates_is_named_unless_constant():
    """Two speeds of a skate with three coordinates; a constant thrust is no spring."""
    (x, y, turn), (v, spin) = me.dynamicsymbols("x y turn"), me.dynamicsymbols("v spin")
    n, b, origin = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O")
    b.orient_axis(n, n.z, turn)
    b.set_ang_vel(n, spin * n.z)
    skate = origin.locatenew("C", x * n.x + y * n.y)
    origin.set_vel(n, 0)
    skate.set_vel(n, v * b.x)
    for force, named in (
        (-10 * (skate.pos_from(origin).magnitude()) ** 2 * skate.pos_from(origin), True),
        (b.x, False),
    ):
        system = System(n, origin)
        system.add_bodies(me.RigidBody("skate", skate, b, sm.S(2), (me.inertia(b, 0, 0, 1), skate)))
        system.add_coordinates(x, y, turn)
        system.add_speeds(v, spin)
        system.add_kdes(x.diff() - v * sm.cos(turn), y.diff() - v * sm.sin(turn), turn.diff() - spin)
        system.add_loads(me.Force(skate, force))
        assert form_equations(fb.Model(system)).energy.without == (("force at point C",) if named else ())


def pulled(own, *forces):
    """A particle with a potential energy of its own on a vertical rail, with coordinate x; forces along it."""
    x, u = me.dynamicsymbols("x u")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    place = origin.locatenew("P", x * ground.x)
    origin.set_vel(ground, 0)
    place.set_vel(ground, u * ground.x)
    body = me.Particle("P", place, sm.Symbol("m"))
    body.potential_energy = own(x)
    system = System(ground, origin)
    system.add_bodies(body)
    system.add_coordinates(x)
    system.add_speeds(u)
    system.add_kdes(u - x.diff())
    system.add_loads(*(me.Force(place, force(x) * ground.x) for force in forces))
    return fb.Model(system, name="pulled", parameters=VALUES, extra="ignore")


M, G, K, A = sm.symbols("m g k a")


@pytest.mark.parametrize(
    ("own", "forces", "expected"),
    [
        # Of one load, the body has a term alone: of gravity and a spring, and of two constant forces.
        (lambda x: M * G * x, [lambda x: -M * G - K * x], lambda x: 2 * 9.81 * x + 15 * x**2),
        (lambda x: K * x**2 / 2, [lambda x: -M * G - K * x], lambda x: 2 * 9.81 * x + 15 * x**2),
        (lambda x: M * G * x, [lambda x: -M * G + A], lambda x: (2 * 9.81 - 7) * x),
        # It has one of two equal springs, and of two equal weights.
        (lambda x: K * x**2 / 2, [lambda x: -K * x] * 2, lambda x: 30 * x**2),
        (lambda x: M * G * x, [lambda _: -M * G] * 2, lambda x: 4 * 9.81 * x),
        # It has all of one load, and a potential that is not the load's.
        (lambda x: M * G * x + K * x**2 / 2, [lambda x: -M * G - K * x], lambda x: 2 * 9.81 * x + 15 * x**2),
        (lambda x: K * x**2, [lambda x: -K * x], lambda x: np.nan * x),
        (lambda x: K * x**4, [lambda x: -M * G - K * x], lambda x: np.nan * x),
    ],
)
def test_potential_of_a_body_with_some_of_the_loads_terms_counts_each_once(own, forces, expected):
    states = np.random.default_rng(1).uniform(-1.5, 1.5, (10, 2))
    found = energies(pulled(own, *forces), states)
    # A constant is free; terms of 100 J to rounding.
    np.testing.assert_allclose(np.diff(found), np.diff(expected(states[:, 0])), rtol=0, atol=1e-12)


@pytest.mark.slow
def test_antiderivatives_of_spring_laws_equal_closed_forms_or_none():
    x, b = sm.symbols("x b", real=True)
    for function, expected in (
        (1e6 * (x - b), lambda x, b: 5e5 * (x - b) ** 2),
        (sm.Max(0, x - b) ** sm.Rational(3, 2), lambda x, b: 0.4 * max(0.0, x - b) ** 2.5),  # Hertz
        (sm.Heaviside(x - b) * x, lambda x, b: (x**2 - b**2) / 2 if x > b else 0.0),
        (sm.exp(b * x) - 1, lambda x, b: np.exp(b * x) / b - x),
        (b * sm.atan(3 * x), lambda x, b: b * (x * np.arctan(3 * x) - np.log(9 * x * x + 1) / 6)),
        (sm.sin(sm.exp(x)) / (1 + x**4), None),
        (sm.sqrt(b + sm.sin(x) ** 2), None),  # an elliptic integral, which C does not have
    ):
        tape = Tape()
        place, other = tape.leaf("y", "x"), tape.leaf("p", "b")
        found = antiderivative(tape, Conversion(tape, {x: place, b: other})(function), place)
        assert (found is None) == (expected is None), function
        if found is not None:
            values = [tape.evaluate([found], {place: at, other: 0.7})[0] for at in (-0.4, 0.7001, 1.9)]
            # Near its free length a stiff spring's energy has all its digits.
            np.testing.assert_allclose(np.diff(values), np.diff([expected(at, 0.7) for at in (-0.4, 0.7001, 1.9)]))
    assert tape.evaluate([antiderivative(tape, (place - other) * 2, place)], {place: 0.7 + 1e-9, other: 0.7}) == [
        pytest.approx(1e-18, rel=1e-6, abs=0)  # the difference of the arguments has 7 digits
    ]


def test_search_for_an_antiderivative_ends_although_the_garbage_collector_calls_functions(monkeypatch):
    # Python ignores what a callback of the collector raises, as JAX's is; the search is to be stopped later.
    def search(_integrand, x):
        end = time.thread_time() + 0.02
        while time.thread_time() < end:
            pass
        gc.collect()
        for _ in range(1000):
            sm.cos(x).diff(x)
        return x**2

    def collected(_phase, _details):
        calls.append(None)

    calls = []
    monkeypatch.setattr(sm, "integrate", search)
    tape = Tape()
    x = sm.Symbol("x", real=True)
    place = tape.leaf("y", "x")
    integrand = Conversion(tape, {x: place})(sm.sin(x))
    gc.callbacks.append(collected)
    try:
        assert antiderivative(tape, integrand, place, max_seconds=0.001) is None
    finally:
        gc.callbacks.remove(collected)
    assert calls
