"""Path synthesis: link lengths of a four-bar whose coupler point passes five points at given crank angles.

Problem: A. Kunjur, S. Krishnamurty, "Genetic algorithms in mechanical synthesis", Journal of Applied Mechanisms and
Robotics 4 (1997); as in J. A. Cabrera, A. Simon, M. Prado, "Optimal synthesis of mechanisms with genetic algorithms",
Mechanism and Machine Theory 37 (2002), where the length of each link is at most 50.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from matplotlib.figure import Figure

import fourbar_codegen as fb

ANGLES = np.pi * np.array([1 / 6, 1 / 4, 1 / 3, 5 / 12, 1 / 2])
POINTS = np.array([(3.0, 3.0), (2.759, 3.363), (2.372, 3.663), (1.890, 3.862), (1.355, 3.943)])
BOUNDS = {"l1": (0.1, 50.0), "l2": (0.1, 50.0), "l3": (0.1, 50.0), "l4": (0.1, 50.0), "a": (-50.0, 50.0),
          "b": (-50.0, 50.0)}  # fmt: skip
STARTS = 10


def linkage() -> fb.Model:
    """A crank that turns as prescribed, a coupler with a point (a, b) on it, and a rocker."""
    q3, q4, u3, u4, crank = me.dynamicsymbols("q3 q4 u3 u4 crank")
    l1, l2, l3, l4, a, b = sm.symbols("l1 l2 l3 l4 a b")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    arms = [ground.orientnew(name, "Axis", (q, ground.z)) for name, q in zip("ABC", (crank, q3, q4), strict=True)]
    pin = origin.locatenew("A", l2 * arms[0].x)
    point = pin.locatenew("P", a * arms[1].x + b * arms[1].y)
    gap = pin.locatenew("B", l3 * arms[1].x).pos_from(origin.locatenew("D", l1 * ground.x)) - l4 * arms[2].x
    loop = [gap.dot(ground.x), gap.dot(ground.y)]
    system = me.System(ground, origin)
    system.add_coordinates(q3, q4, independent=[False, False])
    system.add_speeds(u3, u4, independent=[False, False])
    system.add_kdes(u3 - q3.diff(), u4 - q4.diff())
    system.add_holonomic_constraints(*loop)
    system.add_bodies(me.Particle("coupler", point, 1), me.Particle("rocker", pin.locatenew("B2", l3 * arms[1].x), 1))
    x, y = (point.pos_from(origin).dot(axis) for axis in (ground.x, ground.y))
    return fb.Model(
        system,
        name="path_synthesis",
        parameters={l1: 4.0, l2: 2.0, l3: 4.0, l4: 3.0, a: 2.0, b: 2.0},
        inputs={crank: me.dynamicsymbols._t},  # the angle is the time, in rad
        outputs={"x_P": x, "y_P": y},
    )


def main() -> None:
    model = fb.compile_model(linkage())
    generator = np.random.default_rng(1)
    wanted = {"t": ANGLES, "x_P": POINTS[:, 0], "y_P": POINTS[:, 1]}
    found: list[fb.Fit] = []
    for _ in range(STARTS):
        start = dict(zip(BOUNDS, generator.uniform(1.0, 6.0, len(BOUNDS)), strict=True))
        try:
            found.append(fb.fit(model, wanted, start, bounds=BOUNDS, max_nfev=200))
        except (fb.AssemblyError, fb.SimulationError):  # the loop does not close at all five angles
            continue
        print(f"sum of squares {2.0 * found[-1].cost:.3e} after {found[-1].njev} gradients")
    best = min(found, key=lambda fit: fit.cost)
    print(f"{len(found)} of {STARTS} starts close; the best: {2.0 * best.cost:.3e}")
    print(", ".join(f"{name} = {value:.4f}" for name, value in best.values.items()))

    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    axes = figure.add_subplot(xlabel="x", ylabel="y", aspect="equal", title="Coupler curves that pass five points")
    angles = np.linspace(ANGLES[0], ANGLES[-1], 101)
    for fit in sorted(found, key=lambda fit: -fit.cost):
        run = model.simulate(
            (angles[0], angles[-1]), fit.runs[0].y[:, 0], parameters=fit.values, t_eval=angles, rtol=1e-8
        )
        axes.plot(run["x_P"], run["y_P"], color="tab:blue" if fit is best else "lightgray")
    axes.plot(*POINTS.T, "o", color="black")
    path = Path("results/12_path_synthesis.png")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
