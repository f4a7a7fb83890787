"""Detection of singular positions, where the Jacobian of the constraints loses rank."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.consistency import FLOOR
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Ode
from fourbar_codegen.simulation.run_protocol import Integration

__all__ = ["Singular"]

Floats = NDArray[np.float64]

# A position counts as singular if the smallest singular value of J, relative to its median over the run, is below:
COLLAPSED = 1e-3
"""... if the steps collapse;"""

PASSED = 1e-4
"""... within a step in which the orientation of the constraints has changed;"""

NEAR = 0.2
"""... if a step fails."""

JUMPED = 1e-3
"""The states within a step jump if, after five refinements of 32 intervals each, the largest change between neighbours
exceeds this fraction of that in the first refinement."""

LOCKED = 0.05
"""A prescribed motion cannot go on if the velocity that it prescribes has this share along the direction in which the
Jacobian loses rank; where a mechanism passes such a position, the share vanishes with the singular value."""

PASSING = 'method="ALI3P" with max_step=1e-3 passes it (fourbar: --method ALI3P --max-step 1e-3).'
"""Advice in messages."""

STATES = 100
"""Number of states of the run for the median."""


class Singular:
    """Detects whether a run has reached a singular position, where the Jacobian of the constraints loses rank.

    The measure is the smallest singular value of J, relative to its median over the run. Each column of J, and then
    each row, is scaled by its largest entry in the run, so that metres and radians are comparable.

    Parameters
    ----------
    model : Kernel
    ode : Ode
    passed : sequence of (float, ndarray)
        Times and states of the run up to now.
    """

    def __init__(self, model: Kernel, ode: Ode, passed: Sequence[tuple[float, Floats]]) -> None:
        self.model, self.ode = model, ode
        self.rank = model.manifest["n_dependent_speeds"]
        if self.rank:
            # The last states of a collapsing run are almost equal, so states are sampled at equally spaced times.
            since = [abs(t - passed[0][0]) for t, _ in passed]
            order = np.searchsorted(since, np.linspace(0.0, since[-1], STATES))
            jacobians = np.array([self._jacobian(*passed[min(i, len(passed) - 1)]) for i in order])
            column = np.abs(jacobians).max(axis=(0, 1))
            column[column == 0.0] = 1.0
            row = np.abs(jacobians / column).max(axis=(0, 2))
            row[row == 0.0] = 1.0
            self.row, self.size = row, row[:, np.newaxis] * column
            self.median = float(np.median([self._least(jacobian) for jacobian in jacobians]))

    def _velocity_constraints(self, t: float, x: Floats) -> tuple[Floats, Floats]:
        """J and b of J u + b = 0."""
        return self.model.velocity(t, x, self.ode.parameters, self.ode.input_values(t, x))

    def _jacobian(self, t: float, x: Floats) -> Floats:
        return self._velocity_constraints(t, x)[0]

    def _is_locked(self, t: float, x: Floats) -> bool:
        """Whether no speeds satisfy the constraints: b has a component along n, where n^T J = 0."""
        jacobian, bias = self._velocity_constraints(t, x)
        lost = np.linalg.svd(jacobian / self.size, full_matrices=False)[0][:, self.rank - 1]
        scaled = bias / self.row
        return bool(abs(lost @ scaled) > LOCKED * np.linalg.norm(scaled))

    def _least(self, jacobian: Floats) -> float:
        return float(np.linalg.svd(jacobian / self.size, compute_uv=False)[self.rank - 1])

    def _ratio(self, t: float, x: Floats) -> float:
        if not np.isfinite(x).all():
            return np.inf  # the run diverges; its position is unknown
        return self._least(self._jacobian(t, x)) / self.median if self.median else 0.0

    def here(self, t: float, x: Floats, *, collapsed: bool) -> str:
        """A message if the state at which steps collapse or fail is singular, otherwise an empty text."""
        if not self.rank:
            return ""
        at = self._message("runs into", t, x, COLLAPSED, ", and the steps collapse")
        if at or collapsed or self.ode.failure:
            return at
        return self._message("comes close to", t, x, NEAR, ", and the next step fails: try smaller tolerances")

    def within_step(self, run: Integration) -> str:
        """A message if the last step of a run has passed a singular position, otherwise an empty text.

        Then J loses rank at a state within the step, or neighbouring states within the step are in different assembly
        modes.
        """
        shares = jump_shares = np.linspace(0.0, 1.0, 33)
        jumped = []
        for _ in range(5):  # to within 1e-6 of the step
            ratios = [self._ratio(run.time_within(share), run.state_within(share)) for share in shares[1:-1]]
            least = 1 + int(np.argmin(ratios))
            at = float(shares[least])
            shares = np.linspace(shares[least - 1], shares[least + 1], 33)
            states = [run.state_within(share)[: self.model.n_q] for share in jump_shares]
            changes = np.abs(np.diff(states, axis=0)).max(axis=1)
            largest = int(np.argmax(changes))
            jumped.append(changes[largest])
            jump_shares = np.linspace(jump_shares[largest], jump_shares[largest + 1], 33)
        t, x = run.time_within(at), run.state_within(at)
        passed = self._message("passes", t, x, PASSED, ", and may go on in more than one way")
        if passed or not jumped[-1] > JUMPED * jumped[0] + FLOOR:
            return passed
        return (
            f"A step has jumped to another assembly mode at t = {run.time_within(jump_shares[0]):.6g}, past a singular "
            "position: use smaller tolerances."
        )

    def _message(self, verb: str, t: float, x: Floats, threshold: float, more: str) -> str:
        ratio = self._ratio(t, x)
        if not ratio < threshold:
            return ""
        if self._is_locked(t, x):
            verb, more, advice = (
                "reaches",
                "",
                " The prescribed motion cannot go on from there: no speeds satisfy the constraints.",
            )
        elif self.model.n_l == self.model.n_c:  # ALI3P does not support unknown forces that drive the motion
            advice = f" {PASSING}"
        else:
            advice = ""
        where = ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.model.coordinates, x, strict=False))
        return (
            f"The mechanism {verb} a singular position at t = {t:.6g}, {where}: the constraints' Jacobian loses rank "
            f"(its smallest singular value is {ratio:.1e} of its median over the run){more}.{advice}"
        )
