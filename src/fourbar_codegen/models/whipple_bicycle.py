"""The Whipple bicycle: frame with rigid rider, front fork with handlebar, and two thin wheels.

Source: J. K. Moore, *Human Control of a Bicycle*, PhD thesis, University of California Davis, 2012, chapter 2, for
coordinates and geometry; J. P. Meijaard, J. M. Papadopoulos, A. Ruina, A. L. Schwab, "Linearized dynamics
equations for the balance and steer of a bicycle", *Proc. R. Soc. A* 463 (2007), Table 1, for the numbers.
"""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["whipple_bicycle"]


def whipple_bicycle() -> Model:
    """Model a bicycle that rolls without slip on a horizontal plane.

    The inertial z axis points down. One holonomic constraint keeps the front wheel on the ground, four
    nonholonomic ones keep the wheels from slipping.

    Returns
    -------
    Model
        Coordinates q1, q2 (m), the position of the rear contact; q3, q4, q5 (rad), yaw, roll and pitch of the
        rear frame; q6 (rad), the rear wheel's angle; q7 (rad), steer; q8 (rad), the front wheel's angle.
        Speeds u1 to u8, their rates. The independent speeds are roll, rear wheel and steer.
        It begins upright, at 5 m/s.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.whipple_bicycle().mechanism.n_dependent_speeds
    5
    """
    q = q1, q2, q3, q4, q5, q6, q7, q8 = me.dynamicsymbols("q1:9")
    u = u1, u2, u3, u4, u5, u6, u7, u8 = me.dynamicsymbols("u1:9")
    t = me.dynamicsymbols._t
    rr, rf, d1, d2, d3, l1, l2, l3, l4, g = sm.symbols("rr rf d1 d2 d3 l1 l2 l3 l4 g")
    mc, md, m_e, mf = sm.symbols("mc md me mf")
    id11, id22, if11, if22 = sm.symbols("id11 id22 if11 if22")
    ic11, ic22, ic33, ic31, ie11, ie22, ie33, ie31 = sm.symbols("ic11 ic22 ic33 ic31 ie11 ie22 ie33 ie31")

    # Orientation: yaw and roll, then pitch of the rear frame, steer of the fork, and the wheels' angles.
    ground, yawed, rolled = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.ReferenceFrame("B")
    frame, rear, fork, front = (me.ReferenceFrame(name) for name in "CDEF")
    for child, parent, angle, rate, axis in (
        (yawed, ground, q3, u3, ground.z),
        (rolled, yawed, q4, u4, yawed.x),
        (frame, rolled, q5, u5, rolled.y),
        (rear, frame, q6, u6, frame.y),
        (fork, frame, q7, u7, frame.z),
        (front, fork, q8, u8, fork.y),
    ):
        child.orient_axis(parent, axis, angle)
        child.set_ang_vel(parent, rate * axis)

    # Points: from the rear contact up to the wheel's centre, along the frame and the steer axis, and down again.
    origin = me.Point("O")
    rear_contact = origin.locatenew("dn", q1 * ground.x + q2 * ground.y)
    rear_center = rear_contact.locatenew("do", -rr * rolled.z)
    frame_center = rear_center.locatenew("co", l1 * frame.x + l2 * frame.z)
    steer_axis = rear_center.locatenew("ce", d1 * frame.x)
    front_center = steer_axis.locatenew("fo", d3 * fork.x + d2 * fork.z)
    fork_center = front_center.locatenew("eo", l3 * fork.x + l4 * fork.z)
    # The lowest point of the front wheel lies from its centre along the part of the vertical in the wheel's plane.
    downwards = ground.z - fork.y.dot(ground.z) * fork.y
    front_contact = front_center.locatenew("fn", rf * downwards.normalize())

    # Velocities follow from the centre of the rear wheel; those of the material points in contact are zero.
    origin.set_vel(ground, 0)
    rear_center.set_vel(ground, u1 * ground.x + u2 * ground.y + rolled.ang_vel_in(ground).cross(-rr * rolled.z))
    frame_center.v2pt_theory(rear_center, ground, frame)
    steer_axis.v2pt_theory(rear_center, ground, frame)
    front_center.v2pt_theory(steer_axis, ground, fork)
    fork_center.v2pt_theory(front_center, ground, fork)
    rear_slip = rear_center.vel(ground) + rear.ang_vel_in(ground).cross(rr * rolled.z)
    front_slip = front_center.vel(ground) + front.ang_vel_in(ground).cross(front_contact.pos_from(front_center))

    system = System(ground, origin)
    for name, center, carrier, mass, axes, scalars in (
        ("rear frame", frame_center, frame, mc, frame, (ic11, ic22, ic33, 0, 0, ic31)),
        ("front frame", fork_center, fork, m_e, fork, (ie11, ie22, ie33, 0, 0, ie31)),
        # A wheel's inertia is the same in the frame that does not spin with it, where expressions are shorter.
        ("rear wheel", rear_center, rear, md, frame, (id11, id22, id11)),
        ("front wheel", front_center, front, mf, fork, (if11, if22, if11)),
    ):
        system.add_bodies(me.RigidBody(name, center, carrier, mass, (me.inertia(axes, *scalars), center)))
    system.apply_uniform_gravity(g * ground.z)
    system.q_ind, system.q_dep = [q1, q2, q3, q4, q6, q7, q8], [q5]
    system.u_ind, system.u_dep = [u4, u6, u7], [u1, u2, u3, u5, u8]
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    system.add_holonomic_constraints(front_contact.pos_from(rear_contact).dot(ground.z))
    system.add_nonholonomic_constraints(
        rear_slip.dot(ground.x), rear_slip.dot(ground.y), front_slip.dot(ground.x), front_slip.dot(ground.y)
    )
    return Model(
        system,
        name="whipple_bicycle",
        parameters={
            rr: Parameter(0.3, "m", "radius of the rear wheel"),
            rf: Parameter(0.35, "m", "radius of the front wheel"),
            d1: Parameter(0.9534570696121849, "m", "from the rear wheel's centre to the steer axis, at right angles"),
            d2: Parameter(0.2676445084476887, "m", "along the steer axis, between the wheels' centres"),
            d3: Parameter(0.03207142672761929, "m", "from the steer axis to the front wheel's centre"),
            l1: Parameter(
                0.4707271515135145, "m", "rear frame's mass centre from the rear wheel's, along the frame's x"
            ),
            l2: Parameter(-0.47792881146460797, "m", "the same along z"),
            l3: Parameter(-0.00597083392418685, "m", "front frame's mass centre from the front wheel's, along its x"),
            l4: Parameter(-0.3699518200282974, "m", "the same along z"),
            mc: Parameter(85.0, "kg", "mass of the rear frame with the rider"),
            md: Parameter(2.0, "kg", "mass of the rear wheel"),
            m_e: Parameter(4.0, "kg", "mass of the front frame"),
            mf: Parameter(3.0, "kg", "mass of the front wheel"),
            id11: Parameter(0.0603, "kg m^2", "rear wheel, about a diameter"),
            id22: Parameter(0.12, "kg m^2", "rear wheel, about its axle"),
            if11: Parameter(0.1405, "kg m^2", "front wheel, about a diameter"),
            if22: Parameter(0.28, "kg m^2", "front wheel, about its axle"),
            ic11: Parameter(7.178169776497895, "kg m^2", "rear frame"),
            ic22: Parameter(11.0, "kg m^2", "rear frame"),
            ic33: Parameter(4.821830223502103, "kg m^2", "rear frame"),
            ic31: Parameter(3.8225535938357873, "kg m^2", "rear frame"),
            ie11: Parameter(0.05841337700152972, "kg m^2", "front frame"),
            ie22: Parameter(0.06, "kg m^2", "front frame"),
            ie33: Parameter(0.007586622998470264, "kg m^2", "front frame"),
            ie31: Parameter(0.009119225261946298, "kg m^2", "front frame"),
            g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
        },
        initial={**dict.fromkeys(q, 0), q5: sm.pi / 10, u4: 0.0, u6: -5.0 / 0.3, u7: 0.0},
    )
