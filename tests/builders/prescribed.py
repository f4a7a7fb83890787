"""Mechanisms with a prescribed motion s(t)."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

t = me.dynamicsymbols._t


q, u, s = me.dynamicsymbols("q u s")


m, length, g, w, a = sm.symbols("m l g w a")


def driven_pendulum(default, s=s):
    """A pendulum whose pivot moves along x as s(t): l q'' = -g sin q - s'' cos q."""
    ground, rod = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, pivot, bob = me.Point("O"), me.Point("P"), me.Point("Q")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    pivot.set_pos(origin, s * ground.x)
    pivot.set_vel(ground, s.diff(t) * ground.x)
    bob.set_pos(pivot, -length * rod.y)
    bob.v2pt_theory(pivot, ground, rod)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(t))
    values = {m: 2.0, length: 0.5, g: 9.81} | ({} if default is None else {a: 0.1, w: 5.0})
    inputs = {s: default} if s.is_Function else {}
    return fb.Model(system, name="driven_pendulum", parameters=values, inputs=inputs)


def driven_slider_crank(default=w * t):
    """Crank angle and slider of a slider-crank in plane, the crank's angle held by a constraint to s(t)."""
    angle, x, rate, v = me.dynamicsymbols("angle x rate v")
    crank, rod, mass = sm.symbols("r l m")
    ground, arm = me.ReferenceFrame("N"), me.ReferenceFrame("A")
    origin, pin, slider = me.Point("O"), me.Point("P"), me.Point("S")
    arm.orient_axis(ground, ground.z, angle)
    arm.set_ang_vel(ground, rate * ground.z)
    origin.set_vel(ground, 0)
    pin.set_pos(origin, crank * arm.x)
    pin.v2pt_theory(origin, ground, arm)
    slider.set_pos(origin, x * ground.x)
    slider.set_vel(ground, v * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("pin", pin, mass), me.Particle("slider", slider, mass))
    distance = slider.pos_from(pin)
    system.add_holonomic_constraints(angle - s, distance.dot(distance) - rod**2)
    system.q_dep, system.u_dep = [angle, x], [rate, v]
    system.add_kdes(rate - angle.diff(t), v - x.diff(t))
    return fb.Model(system, name="driven_crank", parameters={crank: 0.2, rod: 0.7, mass: 3.0}, inputs={s: default})
