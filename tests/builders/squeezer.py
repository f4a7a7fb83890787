"""Andrews' squeezing mechanism: seven bodies, three loops, a motor and a spring.

Source: W. Schiehlen, ed., Multibody Systems Handbook, 1990, as stated by E. Hairer, G. Wanner, Solving Ordinary
Differential Equations II, 2nd ed. 1996, section VII.7, with their names; the values at the end of the run are those of
F. Mazzia, C. Magherini, Test Set for Initial Value Problem Solvers, release 2.4.
"""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

ANGLES = ("beta", "Theta", "gamma", "Phi", "delta", "Omega", "epsilon")

START = (
    -0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449, 0.222668390165885884674473185609,
    0.487364979543842550225598953530, -0.222668390165885884674473185609, 1.23054744454982119249735015568,
)  # fmt: skip
"""Of the angles; the mechanism is at rest."""

END = 0.03
"""Of the run, s."""

ANGLES_AT_END = (
    15.81077119629904, -15.75637105984298, 0.04082224013073101, -0.5347301163226948, 0.5244099658805304,
    0.5347301163226948, 1.048080741042263,
)  # fmt: skip
SPEEDS_AT_END = (
    1139.920302151208, -1424.379294994111, 11.03291221937134, 19.29337464421385, 0.5735699284790808,
    -19.29337464421385, 0.3231791658026955,
)  # fmt: skip


def squeezer():
    """The mechanism, in SI units."""
    masses = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)
    inertias = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)
    n, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(n, 0)
    q, u = me.dynamicsymbols(ANGLES), me.dynamicsymbols([f"{name}_rate" for name in ANGLES])
    frames = {k: me.ReferenceFrame(f"K{k}") for k in range(1, 8)}
    for k, parent in {1: n, 2: frames[1], 3: n, 5: n, 4: frames[5], 7: n, 6: frames[7]}.items():
        frames[k].orient_axis(parent, n.z, q[k - 1])
        frames[k].set_ang_vel(parent, u[k - 1] * n.z)

    def at(start, name, frame, x, y=0.0):
        return start.locatenew(name, sm.Float(x) * frame.x + sm.Float(y) * frame.y)

    a, b, c = (at(origin, name, n, *place) for name, place in
               (("A", (-0.06934, -0.00227)), ("B", (-0.03635, 0.03273)), ("C", (0.014, 0.072))))  # fmt: skip
    crank = at(origin, "crank_end", frames[1], 7e-3)
    arm, fork = at(a, "arm_end", frames[5], 4e-2), at(a, "fork_end", frames[7], 0.0, -4e-2)
    tips = [
        at(crank, "P", frames[2], -28e-3), at(b, "P3", frames[3], 0.0, -35e-3), at(arm, "P4", frames[4], 0.0, -2e-2),
        at(fork, "P6", frames[6], 2e-2),
    ]  # fmt: skip
    spring = at(b, "D", frames[3], 2e-2, -18e-3)
    centers = {
        1: (origin, 92e-5, 0.0), 2: (crank, -115e-4, 0.0), 3: (b, 1874e-5, 1043e-5), 4: (arm, 0.0, -(2e-2 - 1421e-5)),
        5: (a, 2308e-5, 916e-5), 6: (fork, 2e-2 - 1421e-5, 0.0), 7: (a, 1228e-5, 449e-5),
    }  # fmt: skip
    system = System(n, origin)
    for k, (start, x, y) in centers.items():
        center = at(start, f"center{k}", frames[k], x, y)
        inertia = me.inertia(frames[k], 0, 0, sm.Float(inertias[k - 1]))
        system.add_bodies(me.RigidBody(f"body{k}", center, frames[k], sm.Float(masses[k - 1]), (inertia, center)))
    system.add_actuators(me.LinearSpring(sm.Float(4530.0), me.LinearPathway(c, spring), sm.Float(7785e-5)))
    system.add_loads(me.Torque(frames[1], sm.Float(33e-3) * n.z))
    system.add_holonomic_constraints(*(tips[0].pos_from(tip).dot(axis) for tip in tips[1:] for axis in (n.x, n.y)))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:1], q[1:], u[:1], u[1:]
    system.add_kdes(*(speed - angle.diff() for angle, speed in zip(q, u, strict=True)))
    return fb.Model(system, name="squeezer", initial=dict(zip((*q, *u), (*START, *[0.0] * 7), strict=True)))
