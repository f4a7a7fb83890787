"""KanesMethod as input, read again instead of its projected matrices."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.kanes_methods import disc_without_an_angle, kanes_method
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


@pytest.mark.slow(but=["cartesian_pendulum"])
@pytest.mark.parametrize("name", ["four_bar", "rolling_disc", "whipple_bicycle", "cartesian_pendulum"])
def test_rates_from_kanes_method_equal_those_from_its_system(name):
    model = getattr(fb.models, name)()
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    kane = kanes_method(model.system)
    from_kane = fb.compile_model(fb.Model(kane, name="from_kane", parameters=values, inputs=model.input_expressions))
    from_system = fb.compile_model(model)
    assert from_kane.states == from_system.states
    generator = np.random.default_rng(3)
    for x in generator.uniform(-1.0, 1.0, (5, from_system.n_x)):
        expected = from_system.rhs(0.3, x)
        # Two solves of the same equations, rounded in another order.
        tolerance = 1e-13 * np.linalg.cond(from_system.mass_matrix(0.3, x)) * np.abs(expected).max()
        np.testing.assert_allclose(from_kane.rhs(0.3, x), expected, rtol=0, atol=tolerance)


def test_rates_of_a_simple_pendulum_equal_those_of_its_kanes_method():
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    t = me.dynamicsymbols._t
    ground, rod, origin, bob = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O"), me.Point("P")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    bob.set_pos(origin, -length * rod.y)
    bob.v2pt_theory(origin, ground, rod)
    particle = me.Particle("bob", bob, m)
    kane = me.KanesMethod(
        ground, [q], [u], kd_eqs=[u - q.diff(t)], bodies=[particle], forcelist=[(bob, -m * g * ground.y)]
    )
    kane.kanes_equations()
    compiled = fb.compile_model(fb.Model(kane, name="simple", parameters={m: 2.0, g: 9.81, length: 0.7}))
    expected = kane.rhs().subs({q: 0.4, u: 1.0, g: 9.81, length: 0.7, m: 2.0})
    np.testing.assert_allclose(compiled.rhs(0.0, [0.4, 1.0]), np.array(expected, dtype=float).ravel(), rtol=1e-14)


def test_kanes_method_without_bodies_or_kinematics_is_refused():
    model = fb.models.four_bar()
    with pytest.raises(fb.ModelError, match="no bodies"):
        fb.Model(kanes_method(model.system, bodies=None))
    with pytest.raises(fb.ModelError, match=r"3 generalized coordinates .* but 0 kinematic"):
        fb.Model(kanes_method(model.system, kd_eqs=None))


def test_frame_without_orientation_gives_sympys_rates_and_keeps_energy():
    kane, values = disc_without_an_angle()
    kane.kanes_equations()
    compiled = fb.compile_model(fb.Model(kane, name="no_angle", parameters=values))
    x = dict(zip((*kane.q, *kane.u), (0.3, 0.4, -0.6, 2.0, 0.5), strict=True))
    expected = np.array(kane.rhs().subs(x).subs(values), dtype=float).ravel()
    np.testing.assert_allclose(compiled.rhs(0.0, list(x.values())), expected, rtol=1e-13)
    run = compiled.simulate((0.0, 2.0), list(x.values()), parameters={"drive": 0.0}, rtol=1e-10, atol=1e-10)
    # Rolling does no work: kinetic energy and m g r cos(lean) add up to what they were.
    height = 1.5 * 9.81 * 0.35 * np.cos(run["lean"])
    np.testing.assert_allclose(run.kinetic_energy + height, run.kinetic_energy[0] + height[0], rtol=1e-8)


def test_inertia_in_a_frame_without_orientation_is_refused():
    kane, values = disc_without_an_angle(inertia_in="disc")
    with pytest.raises(fb.ModelError, match=r"Frame disc, used by body disc, is not oriented .* inertia in a frame"):
        fb.Model(kane, parameters=values)


def test_potential_energy_of_gravity_with_a_moving_contact_exists_only_if_level():
    """Positions are given from a point at rest, which has to be one."""
    kane, values = disc_without_an_angle()
    disc = fb.compile_model(fb.Model(kane, name="on_level_ground", parameters=values))
    # The disc's contact moves, but not along gravity: m g r cos(lean).
    assert disc.potential_energy(0.0, [0.3, 0.4, 1.0, 2.0, 3.0]) == pytest.approx(1.5 * 9.81 * 0.35 * np.cos(0.4))
    [body], [_, torque] = kane.bodies, kane.forcelist
    slope = kane._inertial.x
    forces = [(body.masscenter, -sm.Symbol("m") * sm.Symbol("g") * slope), torque]
    other = me.KanesMethod(
        kane._inertial, kane.q[:], kane.u[:], kd_eqs=[a - b for a, b in kane.kindiffdict().items()], bodies=[body],
        forcelist=forces,
    )  # fmt: skip
    on_a_wall = fb.compile_model(fb.Model(other, name="on_a_wall", parameters=values))
    with pytest.raises(fb.ModelError, match="potential_energy="):
        on_a_wall.potential_energy(0.0, [0.3, 0.4, 1.0, 2.0, 3.0])


def masses_on_a_line(*, includes_gravity):
    """Two, a spring at the first one, which has a potential."""
    (q1, q2), (u1, u2), (m, g, k) = me.dynamicsymbols("q1:3"), me.dynamicsymbols("u1:3"), sm.symbols("m g k")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    for q, u in ((q1, u1), (q2, u2)):
        point = origin.locatenew(f"P_{q.func}", q * ground.y)
        point.set_vel(ground, u * ground.y)
        body = me.Particle(f"mass_{q.func}", point, m)
        body.potential_energy = (k * q**2 / 2 if q == q1 else 0) + (m * g * q if includes_gravity else 0)
        system.add_bodies(body)
        system.add_loads(me.Force(point, -m * g * ground.y), me.Force(point, (-k * q if q == q1 else 0) * ground.y))
    system.add_coordinates(q1, q2)
    system.add_speeds(u1, u2)
    system.add_kdes(u1 - q1.diff(), u2 - q2.diff())
    return fb.Model(system, name="line", parameters={m: 1.0, g: 9.81, k: 10.0})


@pytest.mark.parametrize("includes_gravity", [False, True])
def test_potentials_of_bodies_that_may_include_gravity_give_the_same_energy(includes_gravity):
    """Whether bodies' potentials include those of constant forces, the forces' work tells."""
    model = fb.compile_model(masses_on_a_line(includes_gravity=includes_gravity))
    energy = model.potential_energy(0.0, [0.3, 0.4, 0.0, 0.0])
    assert energy == pytest.approx(0.5 * 10.0 * 0.3**2 + 9.81 * (0.3 + 0.4), rel=1e-14)


def test_constant_force_at_a_contact_leaves_the_potential_energy_unknown():
    """It does no work, wherever the contact is."""
    x, theta, v, omega = me.dynamicsymbols("x theta v omega")
    m, inertia, radius, force = sm.symbols("m J r F")
    ground, wheel, origin = me.ReferenceFrame("N"), me.ReferenceFrame("W"), me.Point("O")
    origin.set_vel(ground, 0)
    wheel.orient_axis(ground, ground.z, theta)
    wheel.set_ang_vel(ground, omega * ground.z)
    center = origin.locatenew("C", x * ground.x + radius * ground.y)
    center.set_vel(ground, v * ground.x)
    contact = center.locatenew("K", -radius * ground.y)
    contact.v2pt_theory(center, ground, wheel)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("wheel", center, wheel, m, (me.inertia(wheel, 0, 0, inertia), center)))
    system.q_ind, system.u_ind, system.u_dep = [x, theta], [omega], [v]
    system.add_kdes(x.diff() - v, theta.diff() - omega)
    system.add_nonholonomic_constraints(v + radius * omega)
    system.add_loads(me.Force(contact, force * ground.x))
    model = fb.compile_model(fb.Model(system, name="pushed", parameters={m: 1, inertia: 0.1, radius: 0.3, force: 2.0}))
    with pytest.raises(fb.ModelError, match="potential_energy="):
        model.potential_energy(0.0, [0.0, 0.0, 1.0, -0.3])


def test_system_with_derivatives_as_speeds_for_lagrange_is_refused():
    m, g = sm.symbols("m g")
    x = me.dynamicsymbols("x")
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x)
    point.set_vel(ground, x.diff(me.dynamicsymbols._t) * ground.x)
    block = me.Particle("block", point, m)
    block.potential_energy = m * g * x
    lagrange = me.LagrangesMethod(me.Lagrangian(ground, block), [x], bodies=[block], frame=ground)
    with pytest.raises(fb.ModelError, match=r"LagrangesMethod cannot be read.*Kane's method.*u - q' = 0"):
        fb.Model(lagrange)
    wall, slider = me.RigidBody("wall"), me.RigidBody("slider", mass=m)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, slider, x, x.diff(me.dynamicsymbols._t)))
    system.form_eoms(eom_method=me.LagrangesMethod)
    with pytest.raises(fb.ModelError, match=r"Derivative\(x\(t\), t\) are derivatives, as for LagrangesMethod"):
        fb.Model(system)
