"""Kinematics that contradict themselves are compiled as they were set, and not without a word."""

import re
import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.kanes_methods import disc_without_an_angle
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t


def pendulum(*, turns=1, moves=1, acceleration=None, angular=None, name="swing"):
    """A rigid bar on a pin whose angular velocity and velocity are set, times factors that should be 1."""
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    ground, bar, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("bar"), me.Point("O"), me.Point("C")
    bar.orient_axis(ground, ground.z, q)
    bar.set_ang_vel(ground, turns * u * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, -length * bar.y)
    center.set_vel(ground, moves * length * u * bar.x)
    if acceleration is not None:
        center.set_acc(ground, acceleration(center, origin, ground, bar))
    if angular is not None:
        bar.set_ang_acc(ground, angular * u.diff(T) * ground.z)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("bar", center, bar, m, (me.inertia(bar, 0, 0, m * length**2 / 12), center)))
    system.apply_uniform_gravity(-g * ground.y)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(T))
    return fb.Model(system, name=name, parameters={m: 1.0, g: 9.81, length: 0.5})


def of_the_point(center, origin, ground, bar):
    return center.a2pt_theory(origin, ground, bar)


def twice(center, origin, ground, bar):
    return 2 * center.a2pt_theory(origin, ground, bar)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"turns": 2}, r"angular velocity that was set for frame bar differs .* orientation"),
        ({"moves": 2}, r"velocity that was set for point C differs .* position"),
        ({"acceleration": twice}, r"acceleration that was set for point C .*a2pt_theory.* SymPy's use the former"),
        ({"angular": 2}, r"angular acceleration that was set for frame bar .* SymPy's use the former"),
    ],
)
def test_kinematics_that_contradict_each_other_compile_with_a_warning(changes, sentence, tmp_path, unoptimized):
    model = pendulum(**changes, name=f"contradicts_{next(iter(changes))}")
    for _ in range(2):  # also where it comes from the cache
        with pytest.warns(fb.ModelWarning, match=sentence) as caught:
            fb.compile_model(model)
        assert [warning.filename for warning in caught] == [__file__]
        # The vectors are those of the state: one is twice the other.
        a, b = (np.fromstring(text, sep=",") for text in re.findall(r"\(([-\d., e]+)\)", str(caught[0].message)))
        np.testing.assert_allclose(a, 2 * b, rtol=0.02)
    with pytest.warns(fb.ModelWarning, match=sentence):
        fb.generate_sources(model)
    with pytest.warns(fb.ModelWarning, match=sentence):
        fb.build_model(model, tmp_path)


@pytest.mark.parametrize("changes", [{}, {"acceleration": of_the_point}, {"angular": 1}])
def test_kinematics_set_as_they_follow_give_no_warning(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(pendulum(**changes))


@pytest.mark.slow(but=["cartesian_pendulum", "chain", "slider_crank"])
@pytest.mark.parametrize("name", fb.models.__all__)
def test_models_of_the_package_give_no_warning(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(getattr(fb.models, name)())


def test_contact_of_a_disc_gives_a_warning_only_if_accelerations_use_it():
    """Of SymPy's disc, a2pt_theory from the contact, which is fixed in no body, gives equations with 2 u2 u3 in the
    place of 6/5 u2 u3; Kane's own are the latter."""
    kane, values = disc_without_an_angle()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(fb.Model(kane, parameters=values))
    [body] = kane.bodies
    contact = next(iter(body.masscenter._pos_dict))
    body.masscenter.a2pt_theory(contact, kane._inertial, body.frame)
    with pytest.warns(fb.ModelWarning, match="acceleration that was set for point O"):
        fb.generate_sources(fb.Model(kane, parameters=values))


def test_velocity_of_rolling_gives_no_warning_where_the_constraint_holds():
    """A wheel whose velocity is that of rolling, beside coordinates of its place and the constraint that it rolls."""
    x, turn, v, spin = me.dynamicsymbols("x turn v spin")
    m, r = sm.symbols("m r")
    ground, wheel, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("W"), me.Point("O"), me.Point("C")
    wheel.orient_axis(ground, ground.z, turn)
    wheel.set_ang_vel(ground, spin * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, x * ground.x + r * ground.y)
    center.set_vel(ground, -r * spin * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("wheel", center, wheel, m, (me.inertia(wheel, 0, 0, m * r**2 / 2), center)))
    system.q_ind, system.u_ind, system.u_dep = [x, turn], [spin], [v]
    system.add_kdes(v - x.diff(T), spin - turn.diff(T))
    system.add_nonholonomic_constraints(v + r * spin)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(fb.Model(system, name="wheel"))
    system.nonholonomic_constraints = [v + 2 * r * spin]
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point C"):
        fb.generate_sources(fb.Model(system, name="wheel"))


def disc_that_slides(*, contact_velocity=1):
    """A disc in its plane on the ground, with friction at the point of it that touches the ground."""
    x, turn, v, spin = me.dynamicsymbols("x turn v spin")
    m, r, b = sm.symbols("m r b")
    ground, disc, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("D"), me.Point("O"), me.Point("C")
    disc.orient_axis(ground, ground.z, turn)
    disc.set_ang_vel(ground, spin * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, x * ground.x + r * ground.y)
    center.set_vel(ground, v * ground.x)
    contact = center.locatenew("K", -r * ground.y)
    contact.v2pt_theory(center, ground, disc)
    contact.set_vel(ground, contact_velocity * contact.vel(ground))
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("disc", center, disc, m, (me.inertia(disc, 0, 0, m * r**2 / 2), center)))
    system.add_loads(me.Force(contact, -b * contact.vel(ground)))
    system.add_coordinates(x, turn)
    system.add_speeds(v, spin)
    system.add_kdes(v - x.diff(T), spin - turn.diff(T))
    return fb.Model(system, name="slides")


def test_contact_that_is_a_bodys_point_for_a_moment_warns_only_if_wrong():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(disc_that_slides())
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point K"):
        fb.generate_sources(disc_that_slides(contact_velocity=2))


def test_velocity_that_is_wrong_on_one_side_alone_gives_a_warning():
    q = me.dynamicsymbols("q")
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point C"):
        fb.generate_sources(pendulum(moves=sm.sign(q)))


def test_angular_velocity_of_a_torques_frame_that_is_wrong_gives_a_warning():
    model = pendulum()
    bar = model.system.bodies[0].frame
    handle = bar.orientnew("handle", "Axis", [0.3, bar.z])
    handle.set_ang_vel(model.system.frame, 3 * me.dynamicsymbols("u") * bar.z)
    model.system.add_loads(me.Torque(handle, bar.z))
    with pytest.warns(fb.ModelWarning, match="angular velocity that was set for frame handle"):
        fb.generate_sources(fb.Model(model.system, name="turned"))


def particle_on_a_rod(moves, *, as_system, length=0.5):
    """A pendulum, as KanesMethod or as a System on a point at rest that is not its own."""
    q, u = me.dynamicsymbols("q u")
    ground, rod, origin, point = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O"), me.Point("P")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    point.set_pos(origin, -length * rod.y)
    point.set_vel(ground, moves * length * u * rod.x)
    gravity, bob = -9.81 * ground.y, me.Particle("bob", point, 1)
    if as_system:
        elsewhere = me.Point("Q")
        elsewhere.set_vel(ground, 0)
        system = System(ground, elsewhere)
        system.add_bodies(bob)
        system.add_loads(me.Force(point, gravity))
        system.add_coordinates(q)
        system.add_speeds(u)
        system.add_kdes(u - q.diff(T))
    else:
        system = me.KanesMethod(ground, [q], [u], kd_eqs=[u - q.diff(T)], bodies=[bob], forcelist=[(point, gravity)])
    return fb.Model(system, name="rod")


@pytest.mark.parametrize("as_system", [False, True])
@pytest.mark.parametrize("moves", [-1, 2])
def test_velocity_from_a_point_at_rest_warns_only_if_it_contradicts_positions(as_system, moves):
    fb.generate_sources(particle_on_a_rod(1, as_system=as_system))
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point P .* its position relative to point O"):
        fb.generate_sources(particle_on_a_rod(moves, as_system=as_system))


@pytest.mark.parametrize("set_to", ["turning rod", "moving bead"])
def test_bead_on_its_rod_with_the_velocity_of_a_rods_point_gives_a_warning(set_to):
    """v2pt_theory is for two points of one body; that the bead is none of the rod nobody says."""
    q, u, x, v = me.dynamicsymbols("q u x v")
    ground, rod, origin, bead = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O"), me.Point("P")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    bead.set_pos(origin, x * rod.x)
    bead.v2pt_theory(origin, ground, rod)
    if set_to == "moving bead":
        bead.set_vel(ground, v * rod.x + x * u * rod.y)
    inertia = (me.inertia(rod, 0, 0, 1), origin)
    bodies = [me.RigidBody("rod", origin, rod, 1, inertia), me.Particle("bead", bead, 1)]
    kane = me.KanesMethod(
        ground, [q, x], [u, v], kd_eqs=[u - q.diff(T), v - x.diff(T)], bodies=bodies,
        forcelist=[(bead, sm.Symbol("F") * rod.x)],
    )  # fmt: skip
    if set_to == "moving bead":
        fb.generate_sources(fb.Model(kane, name="bead"))
    else:
        with pytest.warns(fb.ModelWarning, match="velocity that was set for point P"):
            fb.generate_sources(fb.Model(kane, name="bead"))


def disc_on_a_curve(*, as_system, rolls):
    """A disc on a curve, by the place x of its contact. It rolls: its centre moves with the rate of its position, and
    it turns so that the point at the contact is at rest. Or v2pt_theory takes the contact for a point of the disc."""
    x, u = me.dynamicsymbols("x u")
    m, radius, g = sm.symbols("m r g")
    height = sum(sm.sin(sm.Rational(9, 10) * j * x) / j for j in (1, 2, 3)) + (sm.Rational(9, 40) * x) ** 2
    slope, root = height.diff(x), sm.sqrt(1 + height.diff(x) ** 2)
    ground, disc, origin = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O")
    origin.set_vel(ground, 0)
    along = root * u * (1 - radius * slope.diff(x) / root**3)  # of the centre, on the parallel curve
    disc.set_ang_vel(ground, -along / radius * ground.z)
    contact = origin.locatenew("C", x * ground.x + height * ground.y)
    contact.set_vel(ground, u * ground.x + slope * u * ground.y)
    center = contact.locatenew("P", radius / root * (ground.y - slope * ground.x))
    if rolls:
        center.set_vel(ground, along / root * (ground.x + slope * ground.y))
    else:
        center.v2pt_theory(contact, ground, disc)
    body = me.RigidBody("disc", center, disc, m, (me.inertia(ground, 0, 0, m * radius**2 / 2), center))
    gravity = me.Force(center, -m * g * ground.y)
    if as_system:
        system = System(ground, origin)
        system.add_bodies(body)
        system.add_loads(gravity)
        system.add_coordinates(x)
        system.add_speeds(u)
        system.add_kdes(u - x.diff(T))
    else:
        system = me.KanesMethod(ground, [x], [u], kd_eqs=[u - x.diff(T)], bodies=[body], forcelist=[gravity])
    return fb.Model(system, name="disc", parameters={m: 1, radius: 2, g: 9.8}, initial={x: 7.5, u: 3.5})


@pytest.mark.slow(but=["True"])
@pytest.mark.parametrize("as_system", [False, True])
def test_contact_point_that_moves_on_a_curve_warns_and_rolling_keeps_energy(as_system):
    """As in issue 24669 of SymPy, whose equations lose or gain energy then."""
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point P .* follows from its position, in m/s"):
        fb.generate_sources(disc_on_a_curve(as_system=as_system, rolls=False))
    if as_system:
        return
    run = fb.compile_model(disc_on_a_curve(as_system=as_system, rolls=True)).simulate((0, 0.3), rtol=1e-10, atol=1e-10)
    x = run["x"]
    height = sum(np.sin(0.9 * j * x) / j for j in (1, 2, 3)) + (0.225 * x) ** 2
    slope = sum(0.9 * np.cos(0.9 * j * x) for j in (1, 2, 3)) + 0.10125 * x
    bend = sum(-0.81 * j * np.sin(0.9 * j * x) for j in (1, 2, 3)) + 0.10125
    root = np.sqrt(1 + slope**2)
    energy = 0.75 * (root * run["u"] * (1 - 2 * bend / root**3)) ** 2 + 9.8 * (height + 2 / root)
    # Some 100 steps of relative error 1e-10; soon after, the curve bends as much as the disc, which gets stuck.
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    np.testing.assert_allclose(run.energy, energy, rtol=1e-12)


@pytest.mark.parametrize(("motion", "is_right"), [(2 * T, True), (3 * T, False), (None, False)])
def test_angular_velocity_set_as_a_number_warns_unless_the_default_input_fits(motion, is_right, recwarn):
    """A platform turns by s(t), with an angular velocity of 2 rad/s that was set as a number."""
    s, q, u = me.dynamicsymbols("s q u")
    ground, platform, body, origin = *map(me.ReferenceFrame, "NAB"), me.Point("O")
    origin.set_vel(ground, 0)
    platform.orient_axis(ground, ground.z, s)
    platform.set_ang_vel(ground, 2 * ground.z)
    body.orient_axis(platform, platform.x, q)
    body.set_ang_vel(platform, u * platform.x)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("body", origin, body, 1, (me.inertia(body, 1, 1, 2), origin)))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(T))
    fb.generate_sources(fb.Model(system, name="spun", inputs={s: motion}))
    assert [warning.category for warning in recwarn] == [] if is_right else [fb.ModelWarning]


def test_mass_centre_that_was_set_at_rest_gives_a_warning():
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point C"):
        fb.generate_sources(pendulum(moves=0, name="at_rest"))


@pytest.mark.parametrize("turns", [1, -1])
def test_angular_velocity_of_an_inertias_frame_warns_only_if_wrong(turns):
    """A rotor in a gimbal, with its inertia along the gimbal's axes."""
    (a, s), (u, w), (m, i, k) = me.dynamicsymbols("a s"), me.dynamicsymbols("u w"), sm.symbols("m I K")
    ground, gimbal, rotor, center = *map(me.ReferenceFrame, "NLR"), me.Point("O")
    gimbal.orient_axis(ground, ground.x, a)
    rotor.orient_axis(gimbal, gimbal.z, s)
    gimbal.set_ang_vel(ground, turns * u * ground.x)
    rotor.set_ang_vel(ground, u * ground.x + w * gimbal.z)
    center.set_vel(ground, 0)
    body = me.RigidBody("rotor", center, rotor, m, (me.inertia(gimbal, i, i, k), center))
    kdes = [u - a.diff(T), w - s.diff(T)]
    kane = me.KanesMethod(ground, [a, s], [u, w], kd_eqs=kdes, bodies=[body], forcelist=[(rotor, ground.x)])
    if turns == 1:
        fb.generate_sources(fb.Model(kane, name="gimbal"))
    else:
        with pytest.warns(fb.ModelWarning, match="angular velocity that was set for frame L"):
            fb.generate_sources(fb.Model(kane, name="gimbal"))


def bob_on_a_circle(length, *, moves=1, accelerations=None):
    x, y, u, v = me.dynamicsymbols("x y u v")
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x + y * ground.y)
    point.set_vel(ground, moves * u * ground.x + v * ground.y)
    kane = me.KanesMethod(
        ground, [x], [u], kd_eqs=[u - x.diff(T), v - y.diff(T)], q_dependent=[y], u_dependent=[v],
        configuration_constraints=[x**2 + y**2 - length**2],
        velocity_constraints=[u * sm.sqrt(length**2 - y**2) * sm.sign(x) + v * y],
        acceleration_constraints=accelerations and [accelerations(x, y, u, v)],
        bodies=[me.Particle("bob", point, 1)], forcelist=[(point, -9810 * ground.y)],
    )  # fmt: skip
    return fb.Model(kane, name="circle")


@pytest.mark.slow(but=["1", "100", "30"])
@pytest.mark.parametrize("length", [1, 30, 100, 5000])
def test_contradictions_are_found_at_every_size_of_the_mechanism(length):
    """Hard-coded ones, so that random states have to find them; the row is a rate on closed loops alone."""
    fb.generate_sources(bob_on_a_circle(length))
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point P"):
        fb.generate_sources(bob_on_a_circle(length, moves=2))


@pytest.mark.parametrize("sign", [1, -1])
def test_acceleration_constraints_of_a_kanes_method_warn_only_if_not_rates(sign):
    model = bob_on_a_circle(1, accelerations=lambda x, y, u, v: x * u.diff(T) + y * v.diff(T) + sign * (u**2 + v**2))
    if sign == 1:
        fb.generate_sources(model)
    else:
        with pytest.warns(fb.ModelWarning, match="acceleration constraints that were given are not the rates"):
            fb.generate_sources(model)
