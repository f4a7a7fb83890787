"""Eigenvalues of a bicycle over its speed, and the speed range in which it is self-stable.

Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina, A. L. Schwab, "Linearized dynamics equations for the balance and
steer of a bicycle: a benchmark and review", *Proc. R. Soc. A* 463 (2007), Table 2 and Figure 2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

import fourbar_codegen as fb

PUBLISHED = {"weave": 4.292382536341111, "capsize": 6.024262015388255}


def main() -> None:
    bicycle = fb.compile_model(fb.models.whipple_bicycle())

    def eigenvalues(speed: float) -> np.ndarray:
        """The four eigenvalues of lean and steer; those of position, heading and wheel angles are zero."""
        x = bicycle.initial_state(speeds={"u6": -speed / bicycle.defaults["rr"]})
        A, _ = bicycle.linearize(0.0, x)
        names = ["q4", "q7", "u4", "u7"]
        n = len(bicycle.coordinates) - 1  # pitch is dependent
        place = [[*bicycle.coordinates[:n], *bicycle.speeds].index(name) for name in names]
        return np.linalg.eigvals(A[np.ix_(place, place)])

    def growth(speed: float) -> float:
        return float(eigenvalues(speed).real.max())

    found = {"weave": brentq(growth, 4.0, 5.0, xtol=1e-14), "capsize": brentq(growth, 5.5, 7.0, xtol=1e-14)}
    for name, speed in found.items():
        print(f"{name} speed {speed:.9f} m/s, published {PUBLISHED[name]:.9f} m/s")

    speeds = np.linspace(0.0, 10.0, 401)
    values = np.array([eigenvalues(speed) for speed in speeds])
    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.add_subplot(xlabel="speed (m/s)", ylabel="eigenvalue (1/s)", ylim=(-10.0, 10.0))
    axes.plot(speeds, values.real, ".", color="tab:blue", markersize=2)
    axes.plot(speeds, np.where(values.imag > 0, values.imag, np.nan), ".", color="tab:orange", markersize=2)
    axes.axvspan(*found.values(), color="tab:green", alpha=0.2, label="self-stable")
    axes.legend()
    path = Path("results/04_bicycle_eigenvalues.png")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
