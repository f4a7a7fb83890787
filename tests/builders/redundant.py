"""Mechanisms with constraints that repeat each other."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def pendulum(*constraints):
    """The pendulum in Cartesian coordinates with constraints of one's own, one dependent coordinate."""
    x, y, vx, vy = me.dynamicsymbols("x y v_x v_y")
    m, length, g = sm.symbols("m l g")
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x + y * ground.y)
    point.set_vel(ground, vx * ground.x + vy * ground.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", point, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [y], [x], [vy], [vx]
    t = me.dynamicsymbols._t
    system.add_kdes(vy - y.diff(t), vx - x.diff(t))
    circle = x**2 + y**2 - length**2
    system.add_holonomic_constraints(*(c.subs(sm.Symbol("circle"), circle) for c in constraints))
    return fb.Model(system, name="pendulum", parameters={m: 1.0, length: 1.0, g: 9.81}, initial={x: -1.0})


circle = sm.Symbol("circle")


def three_uprights():
    """Three uprights under one bar across: two loops, four constraints, of which three are independent."""
    p, v = me.dynamicsymbols("p0:3"), me.dynamicsymbols("v0:3")
    c, w = me.dynamicsymbols("c w")
    t = me.dynamicsymbols._t
    m, length, g = sm.symbols("m l g")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    tops = []
    for i in range(3):
        bar, top = me.ReferenceFrame(f"B{i}"), me.Point(f"T{i}")
        bar.orient_axis(ground, ground.z, -p[i])
        bar.set_ang_vel(ground, -v[i] * ground.z)
        foot = origin.locatenew(f"A{i}", i * length * ground.x)
        foot.set_vel(ground, 0)
        top.set_pos(foot, length * bar.y)
        top.v2pt_theory(foot, ground, bar)
        system.add_bodies(me.Particle(f"top{i}", top, m))
        tops.append(top)
    across = me.ReferenceFrame("C")
    across.orient_axis(ground, ground.z, -c)
    across.set_ang_vel(ground, -w * ground.z)
    for i in (1, 2):
        gap = tops[0].pos_from(origin) + i * length * across.x - tops[i].pos_from(origin)
        system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    system.apply_uniform_gravity(-g * ground.y)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = p[:1], [*p[1:], c], v[:1], [*v[1:], w]
    system.add_kdes(*(ui - qi.diff(t) for qi, ui in zip((*p, c), (*v, w), strict=True)))
    return fb.Model(system, name="parallelogram", parameters={m: 1.0, length: 1.0, g: 9.81})
