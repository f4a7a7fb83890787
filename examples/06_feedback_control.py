"""A controller, sampled at 1 kHz, that stabilizes the upright four-bar linkage by the force on its third joint.

The linkage is linearized about its unstable equilibrium. The gains are those of a linear quadratic regulator. The
simulation uses the nonlinear equations.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_are

import fourbar_codegen as fb


def main() -> None:
    four_bar = fb.load("four_bar")
    loose = {"k": 0.0, "c": 0.0}
    upright = four_bar.equilibrium([0.8, 1.6, 1.2], parameters=loose, inputs={"F": 0.0})
    A, B = four_bar.linearize(0.0, upright, loose, {"F": 0.0})
    print(f"Eigenvalues without control: {np.sort(np.linalg.eigvals(A).real).round(2).tolist()} 1/s")

    weights, effort = np.diag([1.0, 0.1]), np.array([[1e-6]])
    gain = np.linalg.solve(effort, B.T @ solve_continuous_are(A, B, weights, effort))
    print(f"with it: {np.sort(np.linalg.eigvals(A - B @ gain).real).round(2).tolist()} 1/s")

    begin = four_bar.initial_state([upright[0] + 0.1], [0.0], guess=upright[1:3], parameters=loose)
    stepper = four_bar.stepper(1e-3, begin, parameters=loose)
    greatest = 0.0
    while stepper.t < 4.0:
        error = stepper.x[[0, 3]] - upright[[0, 3]]
        force = float(-(gain @ error)[0])
        greatest = max(greatest, abs(force))
        stepper.step({"F": force})
    gap = abs(four_bar.position_constraints(stepper.t, stepper.x[:3], loose)).max()
    print(f"After {stepper.t:.1f} s it is {abs(stepper.x[0] - upright[0]):.1e} rad from upright.")
    print(f"The largest force is {greatest:.0f} N. The constraint violation is {gap:.0e} m.")


if __name__ == "__main__":
    main()
