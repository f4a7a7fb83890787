"""A bead on a curve."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

length, gap, width = sm.symbols("l gap width")


x, y, angle, vx, vy, spin = me.dynamicsymbols("x y a v_x v_y w")


def bead_and_wheel(constraint, name):
    """A bead on a curve in the plane, x independent, beside a wheel that turns freely."""
    ground, body, origin, point = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x + y * ground.y)
    point.set_vel(ground, vx * ground.x + vy * ground.y)
    body.orient_axis(ground, ground.z, angle)
    body.set_ang_vel(ground, spin * ground.z)
    system = System(ground, origin)
    wheel = me.RigidBody("wheel", origin, body, 1, (me.inertia(body, 0, 0, 1), origin))
    system.add_bodies(me.Particle("bead", point, 1), wheel)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x, angle], [y], [vx, spin], [vy]
    t = me.dynamicsymbols._t
    system.add_kdes(vx - x.diff(t), vy - y.diff(t), spin - angle.diff(t))
    system.add_holonomic_constraints(constraint)
    return fb.Model(system, name=name, parameters={s: 1.0 for s in (length, gap, width) if constraint.has(s)})
