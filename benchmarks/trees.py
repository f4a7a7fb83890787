"""Models of trees of bodies, for benchmarks and tests: chains, arms that are joined at their tips, a humanoid."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

__all__ = ["HUMANOID", "LINK", "humanoid", "joined_arms", "revolute_chain"]

LINK = (1.3, 0.4, 9.81, 0.11, 0.12, 0.03, 0.004, -0.006, 0.005)
"""Mass, length, gravity, and the inertia about the mass center: xx, yy, zz, xy, yz, zx."""


def revolute_chain(links: int) -> fb.Model:
    """A chain in space, one link below the other, on pins about x, y, x, y, ... of the link before."""
    q, u = me.dynamicsymbols(f"q1:{links + 1}"), me.dynamicsymbols(f"u1:{links + 1}")
    m, length, g = sm.symbols("m l g")
    inertia = sm.symbols("i_xx i_yy i_zz i_xy i_yz i_zx")
    ground, joint = me.ReferenceFrame("N"), me.Point("O")
    joint.set_vel(ground, 0)
    system = System(ground, joint)
    parent = ground
    for i, (angle, rate) in enumerate(zip(q, u, strict=True), start=1):
        link, center, end = me.ReferenceFrame(f"B{i}"), me.Point(f"C{i}"), me.Point(f"P{i}")
        axis = parent.x if i % 2 else parent.y
        link.orient_axis(parent, axis, angle)
        link.set_ang_vel(parent, rate * axis)
        for point, distance in ((center, length / 2), (end, length)):
            point.set_pos(joint, -distance * link.z)
        system.add_bodies(me.RigidBody(f"link{i}", center, link, m, (me.inertia(link, *inertia), center)))
        parent, joint = link, end
    system.apply_uniform_gravity(-g * ground.z)
    system.add_coordinates(*q)
    system.add_speeds(*u)
    system.add_kdes(*(rate - angle.diff() for angle, rate in zip(q, u, strict=True)))
    return fb.Model(
        system, name=f"revolute_chain_{links}", parameters=dict(zip((m, length, g, *inertia), LINK, strict=True))
    )


def joined_arms(arms: int = 4, links: int = 8) -> fb.Model:
    """Arms in a plane, on pins on the ground, each of whose tips is pinned to that of the next arm.

    Each points from its pin to the first one's tip, which its last two links reach: their angles close the loops.
    """
    count = arms * links
    q, u = me.dynamicsymbols(f"q1:{count + 1}"), me.dynamicsymbols(f"u1:{count + 1}")
    m, length, d, g = sm.symbols("m l d g")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    tips, dependent = [], []
    for arm in range(arms):
        parent, joint = ground, origin.locatenew(f"A{arm}", arm * d * ground.x)
        joint.set_vel(ground, 0)
        for i in range(arm * links, (arm + 1) * links):
            bar, center, end = me.ReferenceFrame(f"B{i}"), me.Point(f"C{i}"), me.Point(f"P{i}")
            bar.orient_axis(parent, parent.z, q[i])
            bar.set_ang_vel(parent, u[i] * parent.z)
            for point, distance in ((center, length / 2), (end, length)):
                point.set_pos(joint, distance * bar.x)
            inertia = me.inertia(bar, 0, 0, m * length**2 / 12)
            system.add_bodies(me.RigidBody(f"bar{i}", center, bar, m, (inertia, center)))
            parent, joint = bar, end
        tips.append(joint)
        dependent += [(arm + 1) * links - 2, (arm + 1) * links - 1] if arm else []
    for before, after in itertools.pairwise(tips):
        gap = after.pos_from(before)
        system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    independent = [i for i in range(count) if i not in dependent]
    system.apply_uniform_gravity(-g * ground.y)
    system.q_ind, system.q_dep = [q[i] for i in independent], [q[i] for i in dependent]
    system.u_ind, system.u_dep = [u[i] for i in independent], [u[i] for i in dependent]
    system.add_kdes(*(rate - angle.diff() for angle, rate in zip(q, u, strict=True)))
    bar_length, distance, lean = 0.3, 0.5, 0.6
    tip = (links * bar_length * math.cos(lean), links * bar_length * math.sin(lean))
    initial = {q[i]: -0.1 * (-1) ** i for i in range(count)}
    initial |= {q[arm * links]: math.atan2(tip[1], tip[0] - arm * distance) for arm in range(arms)}
    initial |= {q[i]: 1.5 for i in dependent}  # a guess, elbows bent
    return fb.Model(
        system,
        name=f"joined_arms_{arms}_{links}",
        parameters={m: 1.0, length: bar_length, d: distance, g: 9.81},
        initial=initial,
    )


Joint = tuple[str, str, str, tuple[float, float, float]]

_LEG: Sequence[tuple[str, str, tuple[float, float, float]]] = (
    ("hip_yaw", "z", (0.0, 0.1, -0.1)),
    ("hip_roll", "x", (0.0, 0.0, -0.05)),
    ("hip_pitch", "y", (0.0, 0.0, -0.05)),
    ("knee", "y", (0.0, 0.0, -0.4)),
    ("ankle_pitch", "y", (0.0, 0.0, -0.4)),
    ("ankle_roll", "x", (0.02, 0.0, -0.05)),
)
_ARM: Sequence[tuple[str, str, tuple[float, float, float]]] = (
    ("shoulder_pitch", "y", (0.0, 0.2, 0.3)),
    ("shoulder_roll", "x", (0.0, 0.05, 0.0)),
    ("shoulder_yaw", "z", (0.0, 0.0, -0.1)),
    ("elbow", "y", (0.0, 0.0, -0.2)),
    ("forearm", "z", (0.0, 0.0, -0.1)),
    ("wrist_pitch", "y", (0.0, 0.0, -0.1)),
    ("wrist_roll", "x", (0.0, 0.0, -0.05)),
)
_TRUNK: Sequence[tuple[str, str, tuple[float, float, float]]] = (
    ("waist", "z", (0.0, 0.0, 0.1)),
    ("chest", "y", (0.0, 0.0, 0.1)),
    ("neck", "z", (0.0, 0.0, 0.4)),
    ("head", "y", (0.0, 0.0, 0.1)),
)


def _joints() -> list[Joint]:
    """Name, parent, axis and place in the parent of each joint; a link has the name of its joint."""
    joints: list[Joint] = []
    for part, root, side in (
        (_TRUNK, "pelvis", ""),
        *((_LEG, "pelvis", s) for s in "lr"),
        *((_ARM, "chest", s) for s in "lr"),
    ):
        parent = root
        for name, axis, (x, y, z) in part:
            joints.append((f"{side}_{name}".strip("_"), parent, axis, (x, -y if side == "r" else y, z)))
            parent = joints[-1][0]
    return joints


HUMANOID = _joints()
"""The 30 joints of `humanoid`."""


def humanoid() -> fb.Model:
    """A pelvis that moves freely, and 30 links on it: trunk, head, legs and arms.

    The coordinates are the place and the quaternion (scalar last) of the pelvis, then the joints' angles; the speeds
    are its velocity and angular velocity along its own axes, then the angles' rates, as in robotics engines.
    """
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    place, quaternion = me.dynamicsymbols("x y z"), me.dynamicsymbols("e1 e2 e3 e0")
    velocity, turning = me.dynamicsymbols("v1:4"), me.dynamicsymbols("w1:4")
    m, g = sm.symbols("m g")
    moments = sm.symbols("i_xx i_yy i_zz")
    e1, e2, e3, e0 = quaternion
    pelvis, center = me.ReferenceFrame("pelvis"), me.Point("P")
    pelvis.orient_quaternion(ground, (e0, e1, e2, e3))
    pelvis.set_ang_vel(ground, sum((w * axis for w, axis in zip(turning, pelvis, strict=True)), me.Vector(0)))
    center.set_pos(origin, sum((p * axis for p, axis in zip(place, ground, strict=True)), me.Vector(0)))
    moving = sum((v * axis for v, axis in zip(velocity, pelvis, strict=True)), me.Vector(0))
    center.set_vel(ground, moving)
    w1, w2, w3 = turning
    rates = sm.Matrix(
        [
            (e0 * w1 - e3 * w2 + e2 * w3) / 2,
            (e3 * w1 + e0 * w2 - e1 * w3) / 2,
            (-e2 * w1 + e1 * w2 + e0 * w3) / 2,
            (-e1 * w1 - e2 * w2 - e3 * w3) / 2,
        ]
    )
    system.add_kdes(*(moving.dot(axis) - p.diff() for p, axis in zip(place, ground, strict=True)))
    system.add_kdes(*(rate - e.diff() for e, rate in zip(quaternion, rates, strict=True)))
    frames, points = {"pelvis": pelvis}, {"pelvis": center}
    q = me.dynamicsymbols([f"q_{name}" for name, *_ in HUMANOID])
    u = me.dynamicsymbols([f"u_{name}" for name, *_ in HUMANOID])
    system.add_bodies(me.RigidBody("pelvis", center, pelvis, 5 * m, (me.inertia(pelvis, *moments), center)))
    for (name, parent, axis, offset), angle, rate in zip(HUMANOID, q, u, strict=True):
        before, frame = frames[parent], me.ReferenceFrame(name)
        about = getattr(before, axis)
        frame.orient_axis(before, about, angle)
        frame.set_ang_vel(before, rate * about)
        joint = points[parent].locatenew(
            f"J_{name}", sum((d * e for d, e in zip(offset, before, strict=True)), me.Vector(0))
        )
        mass_center = joint.locatenew(f"C_{name}", -sm.Rational(1, 20) * frame.z)
        system.add_bodies(me.RigidBody(name, mass_center, frame, m, (me.inertia(frame, *moments), mass_center)))
        frames[name], points[name] = frame, joint
    system.apply_uniform_gravity(-g * ground.z)
    system.add_coordinates(*place, *quaternion, *q)
    system.add_speeds(*velocity, *turning, *u)
    system.add_kdes(*(rate - angle.diff() for angle, rate in zip(q, u, strict=True)))
    values = dict(zip((m, g, *moments), (1.2, 9.81, 0.02, 0.03, 0.01), strict=True))
    return fb.Model(system, name="humanoid", parameters=values)
