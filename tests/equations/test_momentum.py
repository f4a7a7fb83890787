"""Momenta of bodies, against closed forms: free bodies, tops, bodies that fall and swing."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders import systems
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t
MASS, INERTIA = 2.0, (1.0, 2.0, 3.0)


def free_body():
    """A body in space without loads: three coordinates, and Euler angles with the body's angular velocity."""
    q, v = me.dynamicsymbols("x y z a b c"), me.dynamicsymbols("v1:4 w1:4")
    ground, body = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, centre = me.Point("O"), me.Point("C")
    body.orient_body_fixed(ground, q[3:], "123")
    rates = body.ang_vel_in(ground)
    spin = sum((speed * axis for speed, axis in zip(v[3:], body, strict=True)), 0 * body.x)
    body.set_ang_vel(ground, spin)
    origin.set_vel(ground, 0)
    centre.set_pos(origin, sum((each * axis for each, axis in zip(q[:3], ground, strict=True)), 0 * ground.x))
    centre.set_vel(ground, sum((each * axis for each, axis in zip(v[:3], ground, strict=True)), 0 * ground.x))
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("body", centre, body, MASS, (me.inertia(body, *INERTIA), centre)))
    system.q_ind, system.u_ind = q, v
    system.add_kdes(
        *(each.diff(T) - speed for each, speed in zip(q[:3], v[:3], strict=True)),
        *((rates - spin).dot(axis) for axis in body),
    )
    return fb.Model(system, name="free_body")


def test_momenta_of_a_free_body_stay_those_of_its_initial_state():
    body = fb.compile_model(free_body())
    position, velocity, rates = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2]), np.array([0.4, 2.0, 0.1])
    x0 = np.concatenate((position, [0.0, 0.0, 0.0], velocity, rates))
    run = body.simulate((0.0, 5.0), x0, rtol=1e-11, atol=1e-13)
    spin = INERTIA * rates  # the body's axes are those of the ground at first
    about_origin = np.cross(position, MASS * velocity) + spin
    assert np.ptp(run["a"]) > 0.1  # it tumbles
    # Of double: the state's rounding. Of a run: its tolerance times the rates, over 5 s.
    for name, expected in (("momentum", MASS * velocity), ("angular_momentum", about_origin), ("spin", spin)):
        np.testing.assert_allclose(run[name][:, 0], expected, rtol=1e-15, atol=1e-15)
        np.testing.assert_allclose(run[name], expected[:, None] + 0.0 * run[name], atol=1e-9)
    np.testing.assert_array_equal(run["spin_y"], run["spin"][1])


def test_spinning_top_keeps_the_vertical_component_of_its_angular_momentum():
    top = fb.compile_model(fb.Model(systems.quaternion_top(), name="top"))
    turn = np.array([np.cos(0.2), np.sin(0.2), 0.0, 0.0])
    run = top.simulate((0.0, 3.0), np.concatenate((turn, [0.1, 0.2, 20.0])), rtol=1e-11, atol=1e-13)
    about_pivot = run["angular_momentum"]
    np.testing.assert_allclose(about_pivot[2], about_pivot[2, 0], rtol=1e-9)
    assert np.ptp(about_pivot[0]) > 0.1  # gravity turns the rest
    # I_C w + r x m v, with m = 1 at the distance 1, is the inertia about the pivot times w, in the body's axes.
    expected = np.array([2.0, 3.0, 3.0]) * [0.1, 0.2, 20.0]
    assert np.linalg.norm(about_pivot[:, 0]) == pytest.approx(np.linalg.norm(expected), rel=1e-14)


def test_momenta_change_by_the_external_forces_alone():
    """Two particles on a spring fall: p' is their weight, and the spin about their mass centre stays."""
    q, u = me.dynamicsymbols("x1 y1 x2 y2"), me.dynamicsymbols("u1:5")
    m1, m2, k, g = sm.symbols("m1 m2 k g")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    points = [me.Point(f"P{number}") for number in (1, 2)]
    for number, point in enumerate(points):
        own, speeds = q[2 * number : 2 * number + 2], u[2 * number : 2 * number + 2]
        point.set_pos(origin, own[0] * ground.x + own[1] * ground.y)
        point.set_vel(ground, speeds[0] * ground.x + speeds[1] * ground.y)
    system = System(ground, origin)
    system.add_bodies(*(me.Particle(str(mass), point, mass) for mass, point in zip((m1, m2), points, strict=True)))
    system.q_ind, system.u_ind = q, u
    system.add_kdes(*(each.diff(T) - speed for each, speed in zip(q, u, strict=True)))
    between = points[1].pos_from(points[0])
    system.add_loads(me.Force(points[0], k * between), me.Force(points[1], -k * between))
    system.apply_uniform_gravity(-g * ground.y)
    pair = fb.compile_model(fb.Model(system, name="pair", parameters={m1: 1.0, m2: 3.0, k: 5.0, g: 9.81}))
    run = pair.simulate((0.0, 2.0), [0.0, 0.0, 1.0, 0.5, 0.2, 3.0, -0.1, 1.0], rtol=1e-11, atol=1e-13)
    momentum = np.array([0.2 - 0.3, 6.0, 0.0])[:, None] + np.array([0.0, -4.0 * 9.81, 0.0])[:, None] * run.t
    np.testing.assert_allclose(run["momentum"], momentum, atol=1e-9)
    # m1 m2 / (m1 + m2) times the relative position and velocity
    np.testing.assert_allclose(run["spin_z"], 0.75 * (1.0 * (1.0 - 3.0) - 0.5 * (-0.1 - 0.2)), rtol=1e-9)


def test_angular_momenta_without_positions_and_without_mass_are_nan():
    block = fb.compile_model(systems.coordinate_free())
    momentum, about_origin, about_centre = block.momentum(0.0, [1.5])
    assert momentum.tolist() == [3.0, 0.0, 0.0]
    assert np.isnan(about_origin).all()
    assert np.isnan(about_centre).all()


def test_angular_momentum_about_a_fixed_point_that_is_not_connected_is_nan():
    """A KanesMethod has no fixed point: there it is about the point at rest that positions refer to, m l^2 u."""
    system, parameters = systems.pendulum(), {"m": 2.0, "g": 9.81, "l": 0.5}
    elsewhere = System(system.frame, me.Point("elsewhere"))
    elsewhere.add_bodies(*system.bodies)
    elsewhere.add_loads(*system.loads)
    elsewhere.q_ind, elsewhere.u_ind, elsewhere.kdes = system.q, system.u, system.kdes
    system.form_eoms()
    for given, about_origin in ((elsewhere, [np.nan] * 3), (system.eom_method, [0.0, 0.0, 2.0 * 0.25 * 3.0])):
        model = fb.compile_model(fb.Model(given, name="swing", parameters=parameters))
        momentum, about, about_centre = model.momentum(0.0, [0.0, 3.0])
        np.testing.assert_allclose(momentum, [0.0, 2.0 * 0.5 * 3.0, 0.0], rtol=1e-15)
        np.testing.assert_array_equal(about, about_origin)
        np.testing.assert_array_equal(about_centre, np.zeros(3))


def test_rolling_disc_has_a_momentum_and_a_spin_but_no_velocities_relative_to_its_contact_point():
    """SymPy's rolling disc, with the contact point as origin, which is at rest for a moment: p = m w x r, S = I w.

    Source: https://docs.sympy.org/latest/explanation/modules/physics/mechanics/examples/rollingdisc_example_kane.html
    """
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    r, m, g = sm.symbols("r m g")
    ground = me.ReferenceFrame("N")
    yaw = ground.orientnew("Y", "Axis", [q[0], ground.z])
    lean = yaw.orientnew("L", "Axis", [q[1], yaw.x])
    disc = lean.orientnew("R", "Axis", [q[2], lean.y])
    disc.set_ang_vel(ground, u[0] * lean.x + u[1] * lean.y + u[2] * lean.z)
    contact = me.Point("C")
    contact.set_vel(ground, 0)
    centre = contact.locatenew("centre", r * lean.z)
    centre.v2pt_theory(contact, ground, disc)
    inertia = me.inertia(lean, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4)
    kinematic = [
        q[0].diff(T) - u[2] / sm.cos(q[1]),
        q[1].diff(T) - u[0],
        q[2].diff(T) - u[1] + u[2] * sm.tan(q[1]),
    ]
    body = me.RigidBody("disc", centre, disc, m, (inertia, centre))
    kane = me.KanesMethod(
        ground, q_ind=q, u_ind=u, kd_eqs=kinematic, bodies=[body], forcelist=[(centre, -m * g * ground.z)]
    )
    model = fb.compile_model(fb.Model(kane, name="rolling", parameters={r: 0.5, m: 2.0, g: 9.81}))
    x = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    momentum, about_contact, spin = model.momentum(0.0, x)
    turned = sm.lambdify([q], ground.dcm(lean))(x[:3])
    np.testing.assert_allclose(momentum, 2.0 * turned @ np.cross(x[3:], [0.0, 0.0, 0.5]), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(spin, turned @ (0.5 * np.array([0.25, 0.5, 0.25]) * x[3:]), rtol=1e-13, atol=1e-15)
    assert np.isnan(about_contact).all()
    run = model.simulate((0.0, 0.5), x)
    assert run.points["centre"].shape == run.velocities["centre"].shape == (3, len(run.t))
    assert np.isnan(run.velocities["centre"]).all()
    assert np.isnan(run.accelerations["centre"]).all()


def test_components_with_parameters_that_nothing_else_needs_are_nan():
    """SymPy's RigidBody has six symbols of inertia; of a rod that turns about one axis, the motion needs one."""
    m, g = sm.symbols("m g")
    q, u = me.dynamicsymbols("q u")
    wall, rod = me.RigidBody("wall"), me.RigidBody("rod", mass=m)
    system = System.from_newtonian(wall)
    system.add_joints(me.PinJoint("pin", wall, rod, q, u, child_point=-0.5 * rod.x, joint_axis=wall.z))
    system.apply_uniform_gravity(-g * wall.y)
    pendulum = fb.compile_model(fb.Model(system, name="rod", parameters={m: 2.0, g: 9.81, "rod_izz": 0.1}))
    momentum, about_origin, about_centre = pendulum.momentum(0.0, [0.0, 3.0])
    np.testing.assert_allclose(momentum, [0.0, 2.0 * 0.5 * 3.0, 0.0], rtol=1e-15)
    np.testing.assert_allclose([about_origin[2], about_centre[2]], [(0.1 + 2.0 * 0.25) * 3.0, 0.3], rtol=1e-14)
    assert np.isnan([about_origin[:2], about_centre[:2]]).all()


def test_mass_centre_is_not_known_where_the_mass_of_a_rotor_on_a_fixed_axis_is_not_named():
    m, mass, inertia = sm.symbols("m M J")
    q, u = me.dynamicsymbols("x a"), me.dynamicsymbols("v w")
    ground, turning, origin = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O")
    block = origin.locatenew("P", q[0] * ground.x)
    turning.orient_axis(ground, ground.z, q[1])
    turning.set_ang_vel(ground, u[1] * ground.z)
    origin.set_vel(ground, 0)
    block.set_vel(ground, u[0] * ground.x)
    system = System(ground, origin)
    rotor = me.RigidBody("rotor", origin, turning, mass, (me.inertia(turning, 0, 0, inertia), origin))
    system.add_bodies(me.Particle("block", block, m), rotor)
    system.q_ind, system.u_ind = q, u
    system.add_kdes(*(each.diff(me.dynamicsymbols._t) - speed for each, speed in zip(q, u, strict=True)))
    values = {m: 2.0, inertia: 3.0}
    momentum, about_origin, about_centre = fb.compile_model(
        fb.Model(system, name="rotor_and_block", parameters=values)
    ).momentum(0.0, [1.0, 0.0, 0.5, 4.0])
    assert (momentum[0], about_origin[2]) == (1.0, 12.0)
    assert about_centre[2] == 12.0  # r x p is zero: they are parallel
    named = fb.compile_model(fb.Model(system, name="rotor_and_block", parameters={**values, mass: 5.0}))
    assert named.momentum(0.0, [1.0, 0.0, 0.5, 4.0])[2].tolist() == [0.0, 0.0, 12.0]


@pytest.mark.parametrize("pulled", [False, True])
def test_pivot_with_an_auxiliary_speed_is_at_rest(pulled):
    q, u, u_aux, force = me.dynamicsymbols("q u u_aux force")
    ground, arm, pivot = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O")
    arm.orient_axis(ground, ground.z, q)
    arm.set_ang_vel(ground, u * ground.z)
    pivot.set_vel(ground, u_aux * ground.y if pulled else 0)
    end = pivot.locatenew("P", -0.5 * arm.y)
    end.v2pt_theory(pivot, ground, arm)
    kane = me.KanesMethod(
        ground,
        [q],
        [u],
        [q.diff(T) - u],
        u_auxiliary=[u_aux] if pulled else None,
        bodies=[me.Particle("bob", end, MASS)],
        forcelist=[(end, -9.81 * MASS * ground.y), *([(pivot, force * ground.y)] if pulled else [])],
    )
    pendulum = fb.compile_model(fb.Model(kane, name="pulled"))
    momentum, about_pivot, spin = pendulum.momentum(0.0, [0.3, 2.0])
    np.testing.assert_allclose(momentum, MASS * 0.5 * 2.0 * np.array([np.cos(0.3), np.sin(0.3), 0.0]), rtol=1e-15)
    np.testing.assert_allclose(about_pivot, [0.0, 0.0, MASS * 0.25 * 2.0], rtol=1e-15)
    np.testing.assert_allclose(spin, 0.0, atol=1e-15)


def test_inputs_of_forces_need_no_value_for_momenta():
    q, u, angle, force = me.dynamicsymbols("q u angle force")
    ground, disk, origin = me.ReferenceFrame("N"), me.ReferenceFrame("D"), me.Point("O")
    disk.orient_axis(ground, ground.z, angle)
    system = System(ground, origin)
    origin.set_vel(ground, 0)
    slot = origin.locatenew("P", q * disk.x)
    slot.set_vel(ground, u * disk.x + q * angle.diff(T) * disk.y)
    system.add_bodies(me.Particle("slot", slot, MASS))
    system.q_ind, system.u_ind = [q], [u]
    system.add_kdes(q.diff(T) - u)
    system.add_loads((slot, force * disk.x))
    model = fb.compile_model(fb.Model(system, name="slot", inputs={angle: 3 * T**2, force: None}))
    # Held at an angle of pi / 2, the disk's x axis is the ground's y axis.
    momentum, *_ = model.momentum(1.5, [1.0, 2.0], r={"angle": np.pi / 2})
    np.testing.assert_allclose(momentum, [0.0, MASS * 2.0, 0.0], atol=1e-15)
    with pytest.raises(fb.ModelError, match="No value for input force"):
        model.rhs(1.5, [1.0, 2.0], r={"angle": np.pi / 2})
