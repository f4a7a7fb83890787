"""Systems that several tests use."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def pendulum(**changes):
    """A pendulum's System with something left out or added."""
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    frame, bar = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, bob = me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    if "no orientation" not in changes:
        bar.orient_axis(frame, frame.z, q)
        bar.set_ang_vel(frame, u * frame.z)
    if "no velocity" not in changes:
        bob.set_pos(origin, length * bar.x)
        bob.set_vel(frame, length * u * bar.y)
    system = System(frame, origin)
    system.add_bodies(me.Particle("bob", bob, changes.get("mass", m)))
    system.add_loads(me.Force(bob, changes.get("force", m * g * frame.x)))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(changes.get("kde", u - q.diff(me.dynamicsymbols._t)))
    return system


def slider(change=""):
    """A block on a wall and a bar pinned to it, with one thing changed."""
    q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
    t = me.dynamicsymbols._t
    force = me.dynamicsymbols("F")
    m, length, k, c, g = sm.symbols("m l k c g")
    wall, turned = me.ReferenceFrame("N"), me.ReferenceFrame("A")
    origin, block, tip = me.Point("O"), me.Point("B"), me.Point("T")
    origin.set_vel(wall, 0)
    turned.orient_axis(wall, wall.z, 2 * q2 if change == "orientation" else q2)
    turned.set_ang_vel(wall, (2 if change == "angular velocity" else 1) * u2 * wall.z)
    block.set_pos(origin, (q1 + (1 if change == "position" else 0)) * wall.x)
    block.set_vel(wall, u1 * (wall.x + (wall.y if change == "velocity" else 0)))
    tip.set_pos(block, length * turned.x)
    tip.v2pt_theory(block, wall, turned)
    system = System(wall, origin)
    system.add_bodies(me.Particle("block", block, 2 * m if change == "mass" else m))
    inertia = me.inertia(turned, 0, 0, m * length**2 / (3 if change == "inertia" else 12))
    system.add_bodies(me.RigidBody("bar", tip, turned, m, (inertia, tip)))
    if change == "body":
        system.add_bodies(me.Particle("another", tip, m))
    system.add_loads(me.Force(block, (force + (k if change == "load" else 0)) * wall.x))
    system.add_loads(me.Force(block if change == "point of a load" else tip, -m * g * wall.y))
    system.add_loads(me.Force(block, -c * wall.x))
    torque = -k * q2 - (c * u2 if change == "actuator" else 0)
    system.add_actuators(me.TorqueActuator(torque, wall.z, turned, wall))
    first, second = (q2, q1) if change == "partition of the coordinates" else (q1, q2)
    system.q_ind, system.q_dep = [first], [second]
    first, second = (u2, u1) if change == "partition of the speeds" else (u1, u2)
    system.u_ind, system.u_dep = [first], [second]
    factor = 2 if change == "kinematic equation" else 1
    system.add_kdes(*(factor * u - q.diff(t) for q, u in ((q1, u1), (q2, u2))))
    system.add_holonomic_constraints(q1 - length * sm.cos(q2) - (1 if change == "holonomic constraint" else 0))
    if change == "velocity constraint":
        system.velocity_constraints = [u1 + length * u2]
    parameters = {m: 1.0, length: 0.5, k: 2.0, c: 0.1, g: 9.81}
    if change == "default":
        parameters[m] = 1.5
    if change == "unit":
        parameters[m] = fb.Parameter(1.0, "kg")
    if change == "order of the parameters":
        parameters = dict(reversed(parameters.items()))
    return fb.Model(
        system,
        name="another_name" if change == "name" else "slider",
        parameters=parameters,
        inputs={force: sm.cos(t) if change == "input" else sm.sin(t)},
        initial={q2: 0.1 if change == "initial value" else 0.2},
        potential_energy=m * g * q1 if change == "potential energy" else None,
    )


def rolling_disc():
    """A disc on a horizontal plane, with implicit kinematics and the constraints substituted into a velocity.

    As in SymPy, test_kane5.py: yaw q1, lean q2, spin q3, contact point (q4, q5); u1 to u3 are the components of
    the angular velocity along the disc's own axes, so that the mass matrix has rows of zeros for u4 and u5.
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
    return fb.Model(system, name="rolling_disc", parameters={g: 9.81, r: 0.26, m: 3.43})


def cartesian_pendulum():
    """IFToMM benchmark A01: a particle on a circle, one holonomic constraint, starting from (-1, 0) at rest."""
    x, y, vx, vy = me.dynamicsymbols("x y v_x v_y")
    t = me.dynamicsymbols._t
    m, length, g = sm.symbols("m l g")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, x * frame.x + y * frame.y)
    point.set_vel(frame, vx * frame.x + vy * frame.y)
    system = System(frame, origin)
    system.add_bodies(me.Particle("bob", point, m))
    system.apply_uniform_gravity(-g * frame.y)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [y], [x], [vy], [vx]
    system.add_kdes(vy - y.diff(t), vx - x.diff(t))
    system.add_holonomic_constraints(x**2 + y**2 - length**2)
    return fb.Model(system, name="pendulum", parameters={m: 1.0, length: 1.0, g: 9.81}, initial={x: -1.0, y: 0.0})


def fixed():
    """A pendulum held by a constraint: no degree of freedom."""
    q, u = me.dynamicsymbols("q u")
    system = pendulum()
    system.add_holonomic_constraints(q - 1)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [], [q], [], [u]
    return fb.Model(system, name="fixed")


def coordinate_free():
    """A block whose position nobody asks for: a speed and no coordinate."""
    v = me.dynamicsymbols("v")
    m, b = sm.symbols("m b")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_vel(frame, v * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("block", point, m))
    system.add_speeds(v)
    system.add_loads(me.Force(point, -b * v * frame.x))
    return fb.Model(system, name="coordinate_free", parameters={m: 2.0, b: 3.0})
