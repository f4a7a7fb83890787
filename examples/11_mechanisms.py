"""Eleven planar mechanisms by their points, a double wishbone in space: positions along a drive, and pictures.

Dimensions: crank-rocker, R. L. Norton, Design of Machinery, table P4-1; Jansen, https://www.strandbeest.com/explains;
Klann, US patent 6,260,862; Chebyshev, https://en.wikipedia.org/wiki/Chebyshev_linkage.
"""

from math import cos, pi, sin, sqrt
from pathlib import Path

import numpy as np
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def crank_rocker():
    points = {"O": (0, 0), "A": (sqrt(3), 1), "B": (1.8740988308191908, 7.998558591530878), "R": (6, 0), "P": (5, 5)}
    return fb.Linkage("crank_rocker", points=points, ground="OR", links=["OA", "ABP", "BR"])


def slider_crank():
    points = {"O": (0, 0), "A": (0.5, sqrt(3) / 2), "C": (3.3722813232690143, 0)}
    linkage = fb.Linkage("piston", points=points, ground="O", links=["OA", "AC"])
    linkage.slider("C", along=(1, 0))
    return linkage


def quick_return():
    """A crank turns a slotted lever, which moves a ram: slowly to the left, in half of that time back."""
    points = {"O": (0, 2), "A": (1, 2), "L": (0, 0), "B": (4 / sqrt(5), 8 / sqrt(5)), "C": (3.228184126011713, 4)}
    linkage = fb.Linkage("quick_return", points=points, ground="OL", links=["OA", "LB", "BC"])
    linkage.slider("A", along="LB")
    linkage.slider("C", along=(1, 0))
    return linkage


def peaucellier():
    """D moves on a straight line, exactly."""
    x, y = 25 / 6, 2.7638539919628324
    points = {"O": (0, 0), "Q": (1.5, 0), "B": (3, 0), "A": (x, y), "C": (x, -y), "D": (16 / 3, 0)}
    return fb.Linkage("peaucellier", points=points, ground="OQ", links=["QB", "OA", "OC", "AB", "BC", "CD", "DA"])


def jansen():
    """The leg of a beach animal; its foot is H."""
    points = {
        "O": (0, 0), "G": (-38, -7.8), "A": (15, 0), "C": (-24.013535097127793, 31.272097454842683),
        "E": (-74.79436538093606, 8.143170205896139), "D": (-26.952107031572965, -45.51517017008116),
        "F": (-59.23151496141502, -28.052930230747776), "H": (-43.1601105241047, -91.75693292612323),
    }  # fmt: skip
    return fb.Linkage("jansen", points=points, ground="OG", links=["OA", "AC", "AD", "GCE", "GD", "EF", "FDH"])


def klann():
    """A leg with one crank and two rockers; its foot is H."""
    points = {
        "O": (1.599, 0.75), "A": (1.331, 0.75), "B": (0.741, 0.75), "C": (0.232, 0.866), "D": (0.866, 1.5),
        "H": (0, 0), "E": (1.009, 0.574), "F": (1.366, 1.366),
    }  # fmt: skip
    return fb.Linkage("klann", points=points, ground="OEF", links=["OA", "ABC", "BE", "DF", "CDH"])


def pantograph():
    """Q draws what P draws, two and a half times as large; a crank moves P on a circle."""
    points = {
        "O": (0, 0), "M": (2.5, 1), "P": (3, 1), "A": (1.112701665379258, 1.661895003862225),
        "C": (2.781754163448145, 4.154737509655563), "B": (4.669052498068887, 3.492842505793338), "Q": (7.5, 2.5),
    }  # fmt: skip
    return fb.Linkage("pantograph", points=points, ground="OM", links=["MP", "OAC", "CBQ", "AP", "PB"])


def scissor_lift():
    """Three stages; the platform is T, on arms of 2 m."""
    width, height = 2 * cos(pi / 6), 2 * sin(pi / 6)
    points = {f"L{i}": (0, i * height) for i in range(4)} | {f"R{i}": (width, i * height) for i in range(4)}
    points |= {f"C{i}": (width / 2, (i + 0.5) * height) for i in range(3)} | {"T": (2, 3 * height)}
    arms = [(f"{a}{i}", f"C{i}", f"{b}{i + 1}") for i in range(3) for a, b in ("LR", "RL")]
    linkage = fb.Linkage("scissor_lift", points=points, ground=["L0"], links=[*arms, ("L3", "T")])
    linkage.slider("R0", along=(1, 0))
    linkage.slider("R3", along=("L3", "T"))
    return linkage


def watt():
    """The middle of the coupler is near a straight line, to the fifth order."""
    points = {"O": (-2.5, 0.5), "A": (0, 0.5), "P": (0, 0), "B": (0, -0.5), "R": (2.5, -0.5)}
    return fb.Linkage("watt", points=points, ground="OR", links=["OA", "APB", "BR"])


def chebyshev():
    points = {"O": (0, 0), "A": (3, 4), "P": (2, 4), "B": (1, 4), "R": (4, 0)}
    return fb.Linkage("chebyshev", points=points, ground="OR", links=["OA", "APB", "BR"])


def hoeken():
    """P moves on a straight line at a nearly constant speed for half a turn of the crank."""
    points = {"O": (0, 0), "A": (-1, 0), "B": (0.5, 2), "P": (2, 4), "R": (2, 0)}
    return fb.Linkage("hoeken", points=points, ground="OR", links=["OA", "ABP", "RB"])


def double_wishbone():
    """A suspension in space, by SymPy's System: arms AB-C and DE-F, a tie rod RQ, an upright with the wheel's centre W.

    The wheel's axle goes from W to T. Dimensions in metres, x forwards, y to the left, z upwards.
    """
    lower, upper, roll, pitch, yaw = q = me.dynamicsymbols("lower upper roll pitch yaw")
    u = me.dynamicsymbols("u1:6")
    places = {
        "A": (-0.251, 0.320, -0.080), "B": (0.148, 0.320, -0.094), "C": (0.013, 0.737, -0.145),
        "D": (-0.105, 0.435, 0.196), "E": (0.122, 0.435, 0.230), "F": (-0.025, 0.680, 0.162),
        "R": (-0.150, 0.380, -0.038), "Q": (-0.137, 0.690, -0.088), "W": (0.0, 0.768, 0.0),
    }  # fmt: skip
    axle = np.array([0.0, 1.0, -0.8 * pi / 180])
    places["T"] = tuple(0.1 * axle / np.linalg.norm(axle) + places["W"])
    body, arm, other, upright = map(me.ReferenceFrame, ("N", "lower arm", "upper arm", "upright"))

    def vector(frame, end, start=None):
        way = np.array(places[end]) - np.array(places[start] if start else (0.0, 0.0, 0.0))
        return sum((float(value) * axis for value, axis in zip(way, frame, strict=True)), me.Vector(0))

    arm.orient_axis(body, vector(body, "B", "A"), lower)
    other.orient_axis(body, vector(body, "E", "D"), upper)
    upright.orient_body_fixed(body, (roll, pitch, yaw), "XYZ")
    origin = me.Point("origin")
    origin.set_vel(body, 0)
    on_body = {name: origin.locatenew(name, vector(body, name)) for name in "ABDER"}
    c = on_body["A"].locatenew("C", vector(arm, "C", "A"))
    rear = on_body["A"].locatenew("Al", 0 * arm.x), on_body["A"].locatenew("Bl", vector(arm, "B", "A"))
    f = on_body["D"].locatenew("F", vector(other, "F", "D"))
    front = on_body["D"].locatenew("Du", 0 * other.x), on_body["D"].locatenew("Eu", vector(other, "E", "D"))
    held = {name: c.locatenew(name if name != "F" else "Fu", vector(upright, name, "C")) for name in "FQWT"}
    system = System(body, origin)
    mass = me.inertia(upright, 1, 1, 1)
    system.add_bodies(
        me.RigidBody("upright", held["W"], upright, 20, (mass, held["W"])),
        me.RigidBody("lower arm", c, arm, 0, (me.inertia(arm, 0, 0, 0), c)),
        me.RigidBody("upper arm", f, other, 0, (me.inertia(other, 0, 0, 0), f)),
    )
    gap, rod = held["F"].pos_from(f), held["Q"].pos_from(on_body["R"])
    length = float(np.linalg.norm(np.array(places["Q"]) - places["R"]))
    system.add_holonomic_constraints(*(gap.dot(axis) for axis in body), rod.dot(rod) - length**2)
    system.q_ind, system.q_dep = q[:1], q[1:]
    system.u_ind, system.u_dep = u[:1], u[1:]
    system.add_kdes(*(w - c.diff() for c, w in zip(q, u, strict=True)))
    points = [*rear, *front, *held.values(), on_body["R"]]
    return fb.Model(system, name="double_wishbone", points=points, lines=[("R", "Q")])


def wave(middle, reach):
    """Values to and fro."""
    return middle + reach * np.sin(np.linspace(-pi / 2, pi / 2, 181))


turn = np.linspace(0.0, 2 * pi, 361)
MECHANISMS = {
    crank_rocker: ("q_OA", turn, ["P"]),
    slider_crank: ("q_OA", turn, ["A", "C"]),
    quick_return: ("q_OA", turn, ["B", "C"]),
    peaucellier: ("q_QB", wave(0.0, 1.6), ["B", "D"]),
    jansen: ("q_OA", turn, ["H", "F", "C"]),
    klann: ("q_OA", turn, ["H"]),
    pantograph: ("q_MP", turn, ["P", "Q"]),
    scissor_lift: ("q_R0", wave(-0.4, 0.5), ["T", "R1"]),
    watt: ("q_OA", wave(-0.2, 0.6), ["P"]),
    chebyshev: ("q_OA", np.radians(wave(69.2, 32.3)), ["P"]),
    hoeken: ("q_OA", turn, ["P"]),
    double_wishbone: ("lower", np.radians(wave(0.0, 10.0)), ["W"]),
}
"""Each with its driven coordinate, the values of that, and the points whose paths are drawn."""


def main():
    folder = Path("results/mechanisms")
    folder.mkdir(parents=True, exist_ok=True)
    for make, (drive, values, points) in MECHANISMS.items():
        made = make()
        model = fb.compile_model(made if isinstance(made, fb.Model) else made.model())
        found = model.kinematics({drive: values})
        path = found[0].plot_paths(points)
        print(f"{make.__name__}: {len(found)} branches, {len(found.dead_points)} dead points")
        name = folder / f"{make.__name__}.png"
        path.savefig(name, dpi=80)
        print(name)


if __name__ == "__main__":
    main()
