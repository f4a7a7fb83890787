"""The four-bar linkage of the SymBRiM tutorial.

Four thin uniform rods in a plane. Link 1 is the ground; pin joints join link 1 to link 2, link 2 to
link 3, and link 3 to link 4; the last pin, from link 4 back to link 1, is two holonomic constraints.

Source: SymBRiM tutorial "Four-bar Linkage", https://mechmotum.github.io/symbrim/tutorials/four_bar_linkage.html
"""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["four_bar"]


def four_bar() -> Model:
    """Model the tutorial's four-bar linkage, with its numbers as defaults.

    Returns
    -------
    Model
        Coordinates q1, q2, q3 (rad), the angles of links 2, 3 and 4 relative to the previous link; q1 is
        independent. Speeds u1, u2, u3 (rad/s), their rates. Input F (N), a horizontal force at the third joint.

    Notes
    -----
    As in the tutorial's code, the torque of spring and damper acts between links 2 and 1, but depends on the angle q2
    and its rate, which are between links 3 and 2. So the damper adds energy instead of dissipating it: with F = 0, the
    energy grows from -697 J to 1083 J in 7.34 s with c = 10, and stays below -697 J with c = 0.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.four_bar().coordinates
    ('q1', 'q2', 'q3')
    """
    rho, l1, l2, l3, l4, g, k, c = sm.symbols("rho l1:5 g k c")
    q1, q2, q3, u1, u2, u3 = me.dynamicsymbols("q1:4 u1:4")
    force = me.dynamicsymbols("F")
    t = me.dynamicsymbols._t

    # Bodies: thin rods along their x axis. Planar motion needs only the inertia about z.
    frame_1 = me.ReferenceFrame("N")
    masscenter_1 = me.Point("mc1")
    inertia_1 = me.Inertia.from_inertia_scalars(masscenter_1, frame_1, 0, 0, rho * l1**3 / 12)
    link1 = me.RigidBody("link1", masscenter_1, frame_1, rho * l1, inertia_1)
    link2 = me.RigidBody("link2", mass=rho * l2)
    link3 = me.RigidBody("link3", mass=rho * l3)
    link4 = me.RigidBody("link4", mass=rho * l4)
    for link, length in ((link2, l2), (link3, l3), (link4, l4)):
        link.central_inertia = me.inertia(link.frame, 0, 0, rho * length**3 / 12)
    system = System(link1.frame, link1.masscenter)
    system.add_bodies(link1, link2, link3, link4)

    # First joint, by hand.
    link2.frame.orient_axis(link1.frame, link1.z, q1)
    link2.frame.set_ang_vel(link1.frame, u1 * link1.z)
    joint1 = link1.masscenter.locatenew("P1", l1 / 2 * link1.x)
    link2.masscenter.set_pos(joint1, l2 / 2 * link2.x)
    link1.masscenter.set_vel(link1.frame, 0)
    joint1.set_vel(link1.frame, 0)
    link2.masscenter.v2pt_theory(joint1, link1.frame, link2.frame)
    system.add_coordinates(q1)
    system.add_speeds(u1)
    system.add_kdes(u1 - q1.diff(t))

    # Second and third joint.
    joint2 = me.PinJoint(
        "joint2",
        link2,
        link3,
        coordinates=q2,
        speeds=u2,
        parent_point=link2.masscenter.locatenew("P2", l2 / 2 * link2.x),
        child_point=-l3 / 2 * link3.x,
        joint_axis=link2.z,
    )
    joint3 = me.PinJoint("joint3", link3, link4, q3, u3, l3 / 2 * link3.x, -l4 / 2 * link4.x, joint_axis=link3.z)
    system.add_joints(joint2, joint3)

    # The joint's velocity follows from link 3 and from link 4; name one, so that SymPy need not choose.
    joint3.parent_point.v2pt_theory(link3.masscenter, link1.frame, link3.frame)

    # Loads: gravity, the horizontal force at the third joint, and the spring-damper.
    system.apply_uniform_gravity(-g * link1.y)
    system.add_loads(me.Force(joint3.parent_point, force * link1.x))
    # The tutorial's text places the spring between links 1 and 2; its code, kept here, takes the angle q2
    # between links 2 and 3 and applies the torque to link 2 with the reaction on link 1.
    system.add_actuators(me.TorqueActuator(-k * q2 - c * u2, joint2.joint_axis, link2, link1))

    # The loop: the end of link 4 stays at the start of link 1.
    start = me.Point("P41")
    start.set_pos(link1.masscenter, -l1 / 2 * link1.x)
    end = me.Point("P44")
    end.set_pos(link4.masscenter, l4 / 2 * link4.x)
    loop = end.pos_from(start)
    system.add_holonomic_constraints(loop.dot(link1.x), loop.dot(link1.y))

    system.q_ind, system.q_dep = [q1], [q2, q3]
    system.u_ind, system.u_dep = [u1], [u2, u3]
    system.validate_system()

    return Model(
        system,
        name="four_bar",
        parameters={
            rho: Parameter(100.0, "kg/m", "mass of a link per length"),
            l1: Parameter(0.8, "m", "length of link 1, the ground"),
            l2: Parameter(0.5, "m", "length of link 2"),
            l3: Parameter(1.0, "m", "length of link 3"),
            l4: Parameter(0.7, "m", "length of link 4"),
            k: Parameter(100.0, "N m/rad", "stiffness of the spring"),
            c: Parameter(10.0, "N m s/rad", "coefficient of the damper"),
            g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
        },
        inputs={force: 100 * sm.sin(sm.pi * t)},
        initial={q1: -0.5, q2: -1.5, q3: -1.5, u1: -0.1},
    )
