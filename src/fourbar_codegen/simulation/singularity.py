"""What is said of singular positions, where the Jacobian of the constraints loses rank, which runs find."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.enumerations import Singular
from fourbar_codegen.runtime.integrator import Run

__all__ = ["singular_message"]

Floats = NDArray[np.float64]

LOCKED = 0.05
"""A prescribed motion cannot go on if the velocity that it prescribes has this share along the direction in which the
Jacobian loses rank; where a mechanism passes such a position, the share vanishes with the singular value."""

PASSING = "method=fb.ALI3P(step=1e-3) passes it (fourbar: --method ALI3P --max-step 1e-3)."
"""Advice in messages."""

SENTENCES = {
    Singular.PASSED: ("passes", ", and may go on in more than one way"),
    Singular.COLLAPSED: ("runs into", ", and the steps collapse"),
    Singular.VARIED: ("comes close to", ", and the steps that its derivatives need collapse"),
    Singular.NEAR: ("comes close to", ", and the next step fails: try smaller tolerances"),
}


def singular_message(model: Kernel, run: Run) -> str:
    """What is said of a run that has met a singular position."""
    how, ratio, t, x = run.singular
    if how is Singular.JUMPED:
        return (
            f"A step has jumped to another assembly mode at t = {t:.6g}, past a singular position: use smaller "
            "tolerances."
        )
    verb, more = SENTENCES[how]
    advice = f" {PASSING}" if model.n_l == model.n_c else ""  # ALI3P has no unknown forces that drive the motion
    if _is_locked(model, run, t, x):
        verb, more = "reaches", ""
        advice = " The prescribed motion cannot go on from there: no speeds satisfy the constraints."
    where = ", ".join(f"{name} = {value:.6g}" for name, value in zip(model.coordinates, x, strict=False))
    return (
        f"The mechanism {verb} a singular position at t = {t:.6g}, {where}: the constraints' Jacobian loses rank "
        f"(its least pivot is {ratio:.1e} of its mean over the run){more}.{advice}"
    )


def _is_locked(model: Kernel, run: Run, t: float, x: Floats) -> bool:
    """Whether no speeds satisfy the constraints: b has a component along n, where n^T J = 0."""
    ode = run.ode
    jacobian, bias = model.velocity(t, x, ode.parameters, ode.input_values(t, x))
    column = np.abs(jacobian).max(axis=0)
    scaled = jacobian / np.where(column > 0.0, column, 1.0)
    row = np.abs(scaled).max(axis=1)
    row[row == 0.0] = 1.0
    lost = np.linalg.svd(scaled / row[:, np.newaxis], full_matrices=False)[0][:, model.layout.n_dependent_speeds - 1]
    return bool(abs(lost @ (bias / row)) > LOCKED * np.linalg.norm(bias / row))
