"""Identification of the stiffness and damping of the four-bar linkage from a noisy angle, by least squares."""

from __future__ import annotations

import time

import numpy as np
from scipy.optimize import least_squares

import fourbar_codegen as fb

TRUE = {"k": 130.0, "c": 6.0}
NOISE = 0.01  # rad


def main() -> None:
    four_bar = fb.load("four_bar")
    times = np.linspace(0.0, 4.0, 201)
    x0 = four_bar.initial_state()
    runs = 0

    def angle(k: float, c: float) -> np.ndarray:
        nonlocal runs
        runs += 1
        run = four_bar.simulate((0.0, 4.0), x0, parameters={"k": k, "c": c}, t_eval=times, rtol=1e-9, atol=1e-9)
        return run["q1"]

    measured = angle(**TRUE) + np.random.default_rng(1).normal(0.0, NOISE, times.size)
    runs = 0
    begin = time.perf_counter()
    fit = least_squares(lambda p: (angle(*p) - measured) / NOISE, [80.0, 15.0], x_scale=[100.0, 10.0])
    seconds = time.perf_counter() - begin
    deviations = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    for name, value, deviation in zip(TRUE, fit.x, deviations, strict=True):
        print(f"{name} = {value:.3f} +- {deviation:.3f}, measured with {TRUE[name]}")
    print(f"chi^2 = {2 * fit.cost / (times.size - 2):.2f} per degree of freedom")
    print(f"{runs} simulations in {1e3 * seconds:.0f} ms")


if __name__ == "__main__":
    main()
