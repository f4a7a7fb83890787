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
        system.velocity_constraints = [2 * (u1 + length * sm.sin(q2) * u2)]
    parameters = {m: 1.0, length: 0.5, k: 2.0, c: 0.1, g: 9.81}
    if change == "default":
        parameters[m] = 1.5
    if change == "unit":
        parameters[m] = fb.Parameter(1.0, "kg")
    if change == "parameter as an expression":
        parameters[c] = k / 20
    if change == "order of the parameters":
        parameters = dict(reversed(parameters.items()))
    return fb.Model(
        system,
        name="another_name" if change == "name" else "slider",
        parameters=parameters,
        inputs={force: sm.cos(t) if change == "input" else sm.sin(t)},
        initial={q2: 0.1 if change == "initial value" else 0.2},
        potential_energy=m * g * q1 if change == "potential energy" else None,
        outputs={"height": length * sm.sin(q2)} if change == "output" else None,
    )


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


def closed_by_auxiliary_speeds(*, unknown_forces):
    """Four uniform bars in a plane, the closing joint given a velocity (u_x, u_y) that is zero."""
    g, rho = sm.symbols("g rho")
    l1, *moving = lengths = sm.symbols("l1:5")
    t = me.dynamicsymbols._t
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


def quaternion_top():
    """A body on a ball joint in quaternions: four coordinates, three speeds, implicit kinematics."""
    e, w = me.dynamicsymbols("e0:4"), me.dynamicsymbols("w1:4")
    ground, body = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    body.orient_quaternion(ground, e)
    by_rates = body.ang_vel_in(ground)
    by_speeds = sum((speed * axis for speed, axis in zip(w, body, strict=True)), 0 * body.x)
    body.set_ang_vel(ground, by_speeds)
    origin, center = me.Point("O"), me.Point("C")
    origin.set_vel(ground, 0)
    center.set_pos(origin, -body.z)
    center.v2pt_theory(origin, ground, body)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("b", center, body, 1, (me.inertia(body, 1, 2, 3), center)))
    system.apply_uniform_gravity(-9.81 * ground.z)
    system.q_ind, system.u_ind = e, w
    norm = sum(entry * entry.diff(me.dynamicsymbols._t) for entry in e)
    system.add_kdes(*((by_rates - by_speeds).dot(axis) for axis in body), norm)
    return system


def spatial_four_bar():
    """The tutorial's linkage without spring, damper and force, in a plane that leans, closed as a spatial one: by all
    three coordinates of the last joint's place, and by the two of its axis. Two of the five rows are independent."""
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    rho, l1, l2, l3, l4, g = sm.symbols("rho l1:5 g")
    ground, plane, origin = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O")
    plane.orient_body_fixed(ground, (sm.Rational(2, 5), sm.Rational(3, 10), 0), "xyz")
    plane.set_ang_vel(ground, 0)
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    before, joint = plane, origin.locatenew("P1", l1 * plane.x)
    joint.set_vel(ground, 0)
    for i, (angle, rate, length) in enumerate(zip(q, u, (l2, l3, l4), strict=True), start=2):
        link = me.ReferenceFrame(f"L{i}")
        link.orient_axis(before, before.z, angle)
        link.set_ang_vel(before, rate * before.z)
        center, end = joint.locatenew(f"C{i}", length / 2 * link.x), joint.locatenew(f"P{i}", length * link.x)
        for point in (center, end):
            point.v2pt_theory(joint, ground, link)
        across = rho * length**3 / 12
        system.add_bodies(
            me.RigidBody(f"link{i}", center, link, rho * length, (me.inertia(link, 0, across, across), center))
        )
        before, joint = link, end
    gap = joint.pos_from(origin)
    system.add_holonomic_constraints(*(gap.dot(axis) for axis in ground))
    for axis in (plane.x, plane.y):  # by numbers, as a drawing gives them
        across = sum(float(axis.dot(e)) * e for e in ground)
        system.add_holonomic_constraints(before.z.dot(across))
    system.apply_uniform_gravity(-g * plane.y)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:1], q[1:], u[:1], u[1:]
    system.add_kdes(*(rate - angle.diff() for angle, rate in zip(q, u, strict=True)))
    values = {rho: 100.0, l1: 0.8, l2: 0.5, l3: 1.0, l4: 0.7, g: 9.81}
    return fb.Model(system, name="spatial_four_bar", parameters=values, initial={q[0]: -0.5, q[1]: -1.5, q[2]: -1.5})


def parallelogram():
    """With a bar too many: two of six constraints are redundant."""
    points = {"A": (0, 0), "B": (0, 1), "C": (2, 1), "D": (2, 0), "E": (1, 0), "F": (1, 1)}
    linkage = fb.Linkage("parallelogram", points=points, ground="AED", links=["AB", "BFC", "CD", "EF"], density=1.0)
    linkage.torque("A", "M")
    return linkage.model()


def masses_on_a_line(constraints, coordinates):
    """With constraints between their places, or whatever the coordinates are taken for; the first is independent."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    speeds = me.dynamicsymbols(f"u:{len(coordinates)}")
    system = System(frame, origin)
    for number, (coordinate, speed) in enumerate(zip(coordinates, speeds, strict=True)):
        place = origin.locatenew(f"P{number}", coordinate * frame.x)
        place.set_vel(frame, speed * frame.x)
        system.add_bodies(me.Particle(f"P{number}", place, 1))
    system.add_holonomic_constraints(*constraints)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = coordinates[:1], coordinates[1:], speeds[:1], speeds[1:]
    system.add_kdes(*(u - q.diff() for q, u in zip(coordinates, speeds, strict=True)))
    return system
