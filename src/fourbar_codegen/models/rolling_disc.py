"""A thin disc that rolls without slip on a horizontal plane.

Source: the rolling disc of SymPy's documentation and tests (sympy/physics/mechanics/tests/test_kane5.py); T. R. Kane
and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, section 3.7 and problem set 5.
"""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["rolling_disc"]


def rolling_disc() -> Model:
    """Model a disc with two nonholonomic constraints and implicit kinematics.

    Returns
    -------
    Model
        Coordinates q1, q2, q3 (rad), yaw, lean and spin; q4, q5 (m), the point of contact. Speeds u1, u2, u3
        (rad/s), the angular velocity along the disc's own axes; u4, u5 (m/s), dependent, the rates of q4, q5.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.rolling_disc().speeds
    ('u1', 'u2', 'u3', 'u4', 'u5')
    """
    q1, q2, q3, q4, q5, u1, u2, u3, u4, u5 = me.dynamicsymbols("q1:6 u1:6")
    t = me.dynamicsymbols._t
    g, r, m = sm.symbols("g r m")

    ground, leaning, disc = me.ReferenceFrame("N"), me.ReferenceFrame("L"), me.ReferenceFrame("D")
    leaning.orient_body_fixed(ground, (q1, q2, 0), "zxy")
    disc.orient_axis(leaning, leaning.y, q3)
    by_rates = disc.ang_vel_in(ground)
    by_speeds = u1 * disc.x + u2 * disc.y + u3 * disc.z
    disc.set_ang_vel(ground, by_speeds)

    origin, center = me.Point("O"), me.Point("C")
    origin.set_vel(ground, 0)
    contact = origin.locatenew("P", q4 * ground.x + q5 * ground.y)
    contact.set_vel(ground, u4 * ground.x + u5 * ground.y)
    center.set_pos(contact, r * leaning.z)
    # The rolling constraint is substituted here, so the mass matrix has rows of zeros for u4 and u5.
    center.set_vel(ground, by_speeds.cross(r * leaning.z))
    slip = contact.vel(ground) + disc.ang_vel_in(leaning).cross(-r * leaning.z)

    system = System(ground, origin)
    inertia = me.inertia(disc, m * r**2 / 4, m * r**2 / 2, m * r**2 / 4)
    system.add_bodies(me.RigidBody("disc", center, disc, m, (inertia, center)))
    system.apply_uniform_gravity(-g * ground.z)
    system.q_ind = [q1, q2, q3, q4, q5]
    system.u_ind, system.u_dep = [u1, u2, u3], [u4, u5]
    system.add_kdes(*((by_rates - by_speeds).dot(axis) for axis in disc), q4.diff(t) - u4, q5.diff(t) - u5)
    system.add_nonholonomic_constraints(slip.dot(ground.x), slip.dot(ground.y))
    return Model(
        system,
        name="rolling_disc",
        parameters={
            g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
            r: Parameter(0.26, "m", "radius"),
            m: Parameter(3.43, "kg", "mass"),
        },
        initial={q1: 0.0, q2: 0.1, q3: 0.0, q4: 0.0, q5: 0.0, u1: 0.0, u2: 5.0, u3: 0.0},
    )
