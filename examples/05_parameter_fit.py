"""Identification of the stiffness and damping of the four-bar linkage from a noisy angle, by least squares."""

from __future__ import annotations

import time

import numpy as np

import fourbar_codegen as fb

TRUE = {"k": 130.0, "c": 6.0}
NOISE = 0.01  # rad


def main() -> None:
    four_bar = fb.load("four_bar")
    times = np.linspace(0.0, 4.0, 201)
    run = four_bar.simulate((0.0, 4.0), parameters=TRUE, t_eval=times, rtol=1e-9, atol=1e-9)
    measured = run["q1"] + np.random.default_rng(1).normal(0.0, NOISE, times.size)
    begin = time.perf_counter()
    fit = fb.fit(four_bar, {"t": times, "q1": measured}, {"k": 80.0, "c": 15.0}, sigma={"q1": NOISE})
    seconds = time.perf_counter() - begin
    for name, value in fit.values.items():
        print(f"{name} = {value:.3f} +- {fit.stderr[name]:.3f}, measured with {TRUE[name]}")
    print(f"chi^2 = {2 * fit.cost / (times.size - 2):.2f} per degree of freedom")
    print(f"{fit.nfev} simulations with derivatives in {1e3 * seconds:.0f} ms")


if __name__ == "__main__":
    main()
