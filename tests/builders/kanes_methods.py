"""Mechanisms as KanesMethod instead of System."""

import sympy as sm
import sympy.physics.mechanics as me


def kanes_method(system, **changes):
    """The KanesMethod that a System makes of itself, with its own velocity constraints spelled out."""
    arguments = {
        "kd_eqs": system.kdes[:],
        "q_dependent": system.q_dep[:],
        "configuration_constraints": system.holonomic_constraints[:],
        "u_dependent": system.u_dep[:],
        "velocity_constraints": system.velocity_constraints[:],
        "bodies": system.bodies,
        "forcelist": [*system.loads, *system.actuators],
        "explicit_kinematics": False,
        "constraint_solver": "CRAMER",
    } | changes
    return me.KanesMethod(system.frame, system.q_ind[:], system.u_ind[:], **arguments)


def disc_without_an_angle(inertia_in="leaning"):
    """A disc that rolls: its wheel frame has an angular velocity and no orientation."""
    t = me.dynamicsymbols._t
    yaw, lean, u1, u2, u3 = me.dynamicsymbols("yaw lean u1 u2 u3")
    m, r, g, drive = sm.symbols("m r g drive")
    frames = {name: me.ReferenceFrame(name) for name in ("ground", "heading", "leaning", "disc")}
    ground, heading, leaning, disc = frames.values()
    heading.orient_axis(ground, ground.z, yaw)
    leaning.orient_axis(heading, heading.x, lean)
    disc.set_ang_vel(leaning, u2 * leaning.y)
    contact, center = me.Point("C"), me.Point("O")
    contact.set_vel(ground, 0)
    center.set_pos(contact, r * leaning.z)
    center.v2pt_theory(contact, ground, disc)
    inertia = me.inertia(frames[inertia_in], m * r**2 / 4, m * r**2 / 2, m * r**2 / 4)
    kane = me.KanesMethod(
        ground, [yaw, lean], [u1, u2, u3], kd_eqs=[lean.diff(t) - u1, yaw.diff(t) - u3],
        bodies=[me.RigidBody("disc", center, disc, m, (inertia, center))],
        forcelist=[(center, -m * g * heading.z), (disc, drive * leaning.y)],
    )  # fmt: skip
    return kane, {m: 1.5, r: 0.35, g: 9.81, drive: 0.4}
