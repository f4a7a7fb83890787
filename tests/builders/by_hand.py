"""Planar mechanisms as one writes them in SymPy, without the linkage builder: frames, points, rods, loops by hand.

Each function returns a Model and the points of the mechanism. Links are uniform rods of RHO, plates three rods.
"""

from math import atan2, dist, sqrt

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

RHO, G = 2.0, 9.81


class Bench:
    """A System in the making: angles, rods and gaps are collected, and its guess of angles."""

    def __init__(self, n):
        self.q, self.u = me.dynamicsymbols(f"q1:{n + 1}"), me.dynamicsymbols(f"u1:{n + 1}")
        self.frame, self.origin = me.ReferenceFrame("N"), me.Point("O")
        self.origin.set_vel(self.frame, 0)
        self.system = System(self.frame, self.origin)
        self.guess = {}

    def turned(self, number, parent, angle):
        """A frame that turns about its parent's z axis."""
        frame = me.ReferenceFrame(f"R{number}")
        frame.orient_axis(parent, parent.z, self.q[number - 1])
        frame.set_ang_vel(parent, self.u[number - 1] * parent.z)
        self.guess[f"q{number}"] = angle
        return frame

    def rod(self, frame, a, b, length):
        """A uniform rod from a to b, fixed on a frame."""
        center = a.locatenew(f"center_{a.name}{b.name}_{frame.name}", b.pos_from(a) / 2)
        mass = RHO * length
        bar = me.RigidBody(f"rod_{a.name}{b.name}_{frame.name}", center, frame, mass,
                           (me.inertia(frame, 0, 0, mass * length**2 / 12), center))  # fmt: skip
        self.system.add_bodies(bar)
        self.system.add_loads(me.Force(center, -mass * G * self.frame.y))

    def model(self, name, gaps):
        closing = [a.pos_from(b).dot(axis) for a, b in gaps for axis in (self.frame.x, self.frame.y)]
        system, n = self.system, len(self.q) - len(closing)
        system.add_holonomic_constraints(*closing)
        system.q_ind, system.q_dep = self.q[:n], self.q[n:]
        system.u_ind, system.u_dep = self.u[:n], self.u[n:]
        system.add_kdes(*(w - c.diff() for c, w in zip(self.q, self.u, strict=True)))
        return fb.Model(system, name=name, initial=self.guess | dict.fromkeys([f"u{k + 1}" for k in range(n)], 0.0))


def angle(a, b):
    return atan2(b[1] - a[1], b[0] - a[0])


def at(start, name, frame, x, y=0):
    return start.locatenew(name, x * frame.x + y * frame.y)


def peaucellier():
    """Arms OA, OC of 5 m, a rhombus of 3 m, and the crank QB of 1.5 m; rods of the rhombus turn about the arms."""
    bench = Bench(7)
    a, b, d = (25 / 6, sqrt(25 - (25 / 6) ** 2)), (3.0, 0.0), (16 / 3, 0.0)
    c = (a[0], -a[1])
    crank = bench.turned(1, bench.frame, 0.0)
    up = bench.turned(2, bench.frame, angle((0, 0), a))
    down = bench.turned(3, bench.frame, angle((0, 0), c))
    ab = bench.turned(4, up, angle(a, b) - angle((0, 0), a))
    ad = bench.turned(5, up, angle(a, d) - angle((0, 0), a))
    cb = bench.turned(6, down, angle(c, b) - angle((0, 0), c))
    cd = bench.turned(7, down, angle(c, d) - angle((0, 0), c))
    o, Q = bench.origin, at(bench.origin, "Q", bench.frame, 1.5)
    B, A, C = at(Q, "B", crank, 1.5), at(o, "A", up, 5), at(o, "C", down, 5)
    B1, B2, D, D1 = at(A, "B1", ab, 3), at(C, "B2", cb, 3), at(A, "D", ad, 3), at(C, "D1", cd, 3)
    for frame, start, end, length in (
        (crank, Q, B, 1.5), (up, o, A, 5.0), (down, o, C, 5.0), (ab, A, B1, 3.0), (cb, C, B2, 3.0), (ad, A, D, 3.0),
        (cd, C, D1, 3.0),
    ):  # fmt: skip
        bench.rod(frame, start, end, length)
    bench.system.add_loads(me.Force(B, 3 * bench.frame.x - bench.frame.y))
    return bench.model("peaucellier_by_hand", [(B1, B), (B2, B), (D1, D)])


def jansen(points):
    """The leg with its crank OA, on the published lengths, which the points have."""
    bench = Bench(7)
    A, C, D, E, F, G1, H = (points[name] for name in "ACDEFGH")
    crank = bench.turned(1, bench.frame, angle((0, 0), A))
    ac = bench.turned(2, crank, angle(A, C) - angle((0, 0), A))
    ad = bench.turned(3, crank, angle(A, D) - angle((0, 0), A))
    upper = bench.turned(4, bench.frame, angle(G1, C))
    gd = bench.turned(5, bench.frame, angle(G1, D))
    ef = bench.turned(6, upper, angle(E, F) - angle(G1, C))
    foot = bench.turned(7, gd, angle(D, F) - angle(G1, D))

    def beyond(first, second, third):
        """A plate's third point, by the cosine law, on the left of the way from the first to the second."""
        base, near, far = dist(first, second), dist(first, third), dist(second, third)
        x = (base**2 + near**2 - far**2) / (2 * base)
        return x, sqrt(near**2 - x**2)

    ground = at(bench.origin, "G", bench.frame, *G1)
    a = at(bench.origin, "A", crank, dist((0, 0), A))
    c, e = at(ground, "C", upper, dist(G1, C)), at(ground, "E", upper, *beyond(G1, C, E))
    c1, d1 = at(a, "C1", ac, dist(A, C)), at(a, "D1", ad, dist(A, D))
    d = at(ground, "D", gd, dist(G1, D))
    f, f1 = at(d, "F", foot, dist(D, F)), at(e, "F1", ef, dist(E, F))
    h = at(d, "H", foot, *beyond(D, F, H))
    for frame, start, end, length in (
        (crank, bench.origin, a, dist((0, 0), A)), (ac, a, c1, dist(A, C)), (ad, a, d1, dist(A, D)),
        (upper, ground, c, dist(G1, C)), (upper, c, e, dist(C, E)), (upper, e, ground, dist(E, G1)),
        (gd, ground, d, dist(G1, D)), (ef, e, f1, dist(E, F)), (foot, d, f, dist(D, F)), (foot, f, h, dist(F, H)),
        (foot, h, d, dist(H, D)),
    ):  # fmt: skip
        bench.rod(frame, start, end, length)
    bench.system.add_loads(me.Force(a, 3 * bench.frame.x - bench.frame.y))
    return bench.model("jansen_by_hand", [(c1, c), (d1, d), (f1, f)])


def quick_return(points):
    """A crank's pin slides on a slotted lever, whose end moves a ram on a horizontal guide."""
    bench = Bench(5)  # crank, lever, connecting rod; displacements of the pin on the lever and of the ram
    M, A, L, B, C = (points[name] for name in "OALBC")
    crank = bench.turned(1, bench.frame, angle(M, A))
    lever = bench.turned(2, bench.frame, angle(L, B))
    rod = bench.turned(3, lever, angle(B, C) - angle(L, B))
    bench.guess |= {"q4": dist(L, A), "q5": C[0]}
    center = at(bench.origin, "M", bench.frame, *M)
    a = at(center, "A", crank, dist(M, A))
    pivot = at(bench.origin, "L", bench.frame, *L)
    b, slot = at(pivot, "B", lever, dist(L, B)), at(pivot, "A1", lever, bench.q[3])
    c, ram = at(b, "C", rod, dist(B, C)), at(bench.origin, "C1", bench.frame, bench.q[4], C[1])
    bench.rod(crank, center, a, dist(M, A))
    bench.rod(lever, pivot, b, dist(L, B))
    bench.rod(rod, b, c, dist(B, C))
    bench.system.add_loads(me.Force(a, 3 * bench.frame.x - bench.frame.y))
    return bench.model("quick_return_by_hand", [(slot, a), (ram, c)])


def double_wishbone(points):
    """The front view of a suspension: two arms, the upright with the wheel's centre, a spring and a damper."""
    bench = Bench(3)
    A, C, D, F, W, K = (points[name] for name in "ACDFWK")
    lower = bench.turned(1, bench.frame, angle(A, C))
    upright = bench.turned(2, lower, angle(C, F) - angle(A, C))
    upper = bench.turned(3, bench.frame, angle(D, F))
    chassis = {name: at(bench.origin, name, bench.frame, *points[name]) for name in "ADS"}
    c = at(chassis["A"], "C", lower, dist(A, C))
    k = at(chassis["A"], "K", lower, dist(A, K))
    base, near, far = dist(C, F), dist(C, W), dist(F, W)
    x = (base**2 + near**2 - far**2) / (2 * base)
    side = 1 if (F[0] - C[0]) * (W[1] - C[1]) > (F[1] - C[1]) * (W[0] - C[0]) else -1
    f, w = at(c, "F", upright, base), at(c, "W", upright, x, side * sqrt(near**2 - x**2))
    f1 = at(chassis["D"], "F1", upper, dist(D, F))
    bench.rod(lower, chassis["A"], c, dist(A, C))
    bench.rod(upper, chassis["D"], f1, dist(D, F))
    for start, end, length in ((c, f, base), (f, w, far), (w, c, near)):
        bench.rod(upright, start, end, length)
    strut = me.LinearPathway(chassis["S"], k)
    bench.system.add_actuators(me.LinearSpring(400, strut, sm.Float(0.4)), me.LinearDamper(15, strut))
    return bench.model("double_wishbone_by_hand", [(f1, f)])
