"""Forces in joints: auxiliary speeds, multipliers, and outputs."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

t = me.dynamicsymbols._t
g, rho = sm.symbols("g rho")
lengths = sm.symbols("l1:5")


def closed_by_auxiliary_speeds(*, unknown_forces):
    """Four uniform bars in a plane, the closing joint given a velocity (u_x, u_y) that is zero."""
    l1, *moving = lengths
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    ux, uy, fx, fy = me.dynamicsymbols("u_x u_y F_x F_y")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    parent, joint = ground, origin
    for i, length in enumerate(moving):
        bar, center, end = me.ReferenceFrame(f"B{i}"), me.Point(f"C{i}"), me.Point(f"P{i}")
        bar.orient_axis(parent, ground.z, q[i])
        bar.set_ang_vel(parent, u[i] * ground.z)
        center.set_pos(joint, length / 2 * bar.x)
        end.set_pos(joint, length * bar.x)
        center.v2pt_theory(joint, ground, bar)
        end.v2pt_theory(joint, ground, bar)
        inertia = (me.inertia(bar, 0, 0, rho * length**3 / 12), center)
        system.add_bodies(me.RigidBody(f"bar{i}", center, bar, rho * length, inertia))
        parent, joint = bar, end
    system.apply_uniform_gravity(-g * ground.y)
    if unknown_forces:
        system.add_loads(me.Force(joint, fx * ground.x + fy * ground.y))
    loop = joint.pos_from(origin) - l1 * ground.x
    system.add_holonomic_constraints(loop.dot(ground.x), loop.dot(ground.y))
    slip = joint.vel(ground) - ux * ground.x - uy * ground.y
    system.velocity_constraints = [slip.dot(ground.x), slip.dot(ground.y)]
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:1], q[1:], u[:1], u[1:]
    system.u_aux = [ux, uy]
    system.add_kdes(*(ui - qi.diff(t) for qi, ui in zip(q, u, strict=True)))
    values = {**dict(zip(lengths, (2.0, 1.0, 2.0, 1.0), strict=True)), rho: 5.0, g: 9.81}
    return fb.Model(
        system,
        name="closed_by_auxiliary_speeds",
        parameters=values,
        outputs=fb.joint_force("closing", {1: ground.x, 2: ground.y}, ground),
    )


# SymPy's documentation, four_bar_linkage_example: upright rectangle at rest. Link 4 presses on the ground with
# its own weight and half of that of link 3: 5 * 9.81 * (1 + 2 / 2) N.
RECTANGLE = [np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("unknown_forces", [True, False])
def test_closing_joint_force_of_sympys_documentation(unknown_forces):
    linkage = fb.compile_model(closed_by_auxiliary_speeds(unknown_forces=unknown_forces))
    names = ("F_x", "F_y") if unknown_forces else ("u_x", "u_y")
    assert linkage.outputs == (*names, "closing_x", "closing_y", "closing_z")
    np.testing.assert_allclose(linkage.rhs(0.0, RECTANGLE), 0.0, atol=1e-13)
    by_auxiliary_speeds, by_multipliers = np.split(linkage.output(0.0, RECTANGLE), [2])
    # The force on the end of link 4; the documentation prints the opposite, the force on the ground.
    np.testing.assert_allclose(by_multipliers, [0.0, 98.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(by_auxiliary_speeds, [0.0, 98.1], atol=1e-12)


def test_force_in_a_joint_of_the_tree():
    # A pendulum whose pivot is given auxiliary speeds. In polar form: the rod pulls the bob with
    # m (l u^2 + g cos q) towards the pivot, and the pivot's force on the rod is the same.
    q, u, ux, uy, fx, fy = me.dynamicsymbols("q u u_x u_y F_x F_y")
    m, length = sm.symbols("m l")
    ground, rod = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, pivot, bob = me.Point("O"), me.Point("P"), me.Point("Q")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    pivot.set_pos(origin, 0 * ground.x)
    pivot.set_vel(ground, ux * ground.x + uy * ground.y)
    bob.set_pos(pivot, -length * rod.y)
    bob.v2pt_theory(pivot, ground, rod)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.add_loads(me.Force(pivot, fx * ground.x + fy * ground.y))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_auxiliary_speeds(ux, uy)
    system.add_kdes(u - q.diff(t))
    along_rod = {"tension": m * (length * u**2 + g * sm.cos(q)), "tangential": m * length * u.diff(t)}
    model = fb.Model(system, name="pivoted", parameters={m: 2.0, length: 0.5, g: 9.81}, outputs=along_rod)
    pendulum = fb.compile_model(model)
    for angle, speed in ((0.0, 0.0), (0.7, -1.3), (2.5, 4.0)):
        force_x, force_y, tension, tangential = pendulum.output(0.0, [angle, speed])
        assert tension == pytest.approx(2.0 * (0.5 * speed**2 + 9.81 * np.cos(angle)), rel=1e-14)
        assert tangential == pytest.approx(-2.0 * 9.81 * np.sin(angle), rel=1e-14)
        np.testing.assert_allclose([force_x, force_y], tension * np.array([-np.sin(angle), np.cos(angle)]), atol=1e-13)


def test_outputs_along_a_trajectory(tmp_path):
    linkage = fb.compile_model(closed_by_auxiliary_speeds(unknown_forces=True))
    x0 = linkage.initial_state([2.0], [1.0], guess=[-2.0, -1.0])
    run = linkage.simulate((0.0, 0.3), x0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run["F_x"], run["closing_x"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.multipliers, run.outputs[:2], rtol=1e-9, atol=1e-9)
    assert "F_y" in run.save(tmp_path / "run.csv").read_text().splitlines()[0].split(",")


def test_forces_that_are_not_determined():
    model = closed_by_auxiliary_speeds(unknown_forces=True)
    system = model.system
    system.velocity_constraints = [entry.subs(me.dynamicsymbols("u_x"), 0) for entry in system.velocity_constraints]
    with pytest.raises(fb.ModelError, match=r"F_x, F_y do not follow from the auxiliary speeds u_x, u_y"):
        fb.generate_sources(fb.Model(system))
    system.u_aux = system.u_aux[:1]
    with pytest.raises(fb.ModelError, match=r"2 functions of time .* for 1 auxiliary"):
        fb.Model(system, inputs={})
