"""Detection of singular positions, where the Jacobian of the constraints loses rank."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.consistency import ROUNDING_ATOL
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Ode, Run

__all__ = ["Singular"]

Floats = NDArray[np.float64]
Samples = Sequence[tuple[Floats, Floats]]
"""Times and states of a run up to now, piece by piece."""

# A position counts as singular if the smallest singular value of J, relative to its median over the run, is below:
COLLAPSED = 1e-3
"""... if the steps collapse;"""

PASSED = 1e-4
"""... within a step in which the sign of det J_d has changed;"""

VARIED = 3e-2
"""... if the steps collapse because of derivatives, whose rounding errors grow before those of the motion;"""

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
    each row, is scaled by its largest entry in the run, so that metres and radians are comparable. Since a run may pass
    many poles of J, which are looked at like singular positions, scales and median are found anew only where the run
    has become twice as long.

    Parameters
    ----------
    model : Kernel
    """

    def __init__(self, model: Kernel) -> None:
        self.model = model
        self.rank = model.layout.n_dependent_speeds
        self.known = 0.0
        """Duration of the run for which scales and median are known."""

    def here(self, run: Run, samples: Samples, *, collapsed: bool, varied: bool = False) -> str:
        """A message if the state at which steps collapse or fail is singular, otherwise an empty text.

        In a run with derivatives, `varied`, it counts as singular further away.
        """
        if not self.rank:
            return ""
        self._learn(run, samples)
        at = self._message("runs into", run.ode, run.t, run.x, COLLAPSED, ", and the steps collapse")
        if not at and collapsed and varied:
            more = ", and the steps that its derivatives need collapse"
            at = self._message("comes close to", run.ode, run.t, run.x, VARIED, more)
        if at or collapsed or run.ode.failure:
            return at
        more = ", and the next step fails: try smaller tolerances"
        return self._message("comes close to", run.ode, run.t, run.x, NEAR, more)

    def within_step(self, run: Run, samples: Samples) -> str:
        """A message if the last step of a run has passed a singular position, otherwise an empty text.

        Then J loses rank at a state within the step, or neighbouring states within the step are in different assembly
        modes.
        """
        self._learn(run, samples)
        shares = jump_shares = np.linspace(0.0, 1.0, 33)
        jumped = []
        for _ in range(5):  # to within 1e-6 of the step
            inner = [(run.time_within(share), run.state_within(share)) for share in shares[1:-1]]
            least = 1 + int(np.argmin(self._ratios(run.ode, inner)))
            t, x = inner[least - 1]
            shares = np.linspace(shares[least - 1], shares[least + 1], 33)
            states = [run.state_within(share)[: self.model.n_q] for share in jump_shares]
            changes = np.abs(np.diff(states, axis=0)).max(axis=1)
            largest = int(np.argmax(changes))
            jumped.append(changes[largest])
            jump_shares = np.linspace(jump_shares[largest], jump_shares[largest + 1], 33)
        passed = self._message("passes", run.ode, t, x, PASSED, ", and may go on in more than one way")
        if passed or not jumped[-1] > JUMPED * jumped[0] + ROUNDING_ATOL:
            return passed
        return (
            f"A step has jumped to another assembly mode at t = {run.time_within(jump_shares[0]):.6g}, past a singular "
            "position: use smaller tolerances."
        )

    def _learn(self, run: Run, samples: Samples) -> None:
        """The scales of J and the median of the measure over the run up to now."""
        times, states = map(np.concatenate, zip(*samples, strict=True))
        if times.size == 0:
            times, states = np.array([run.t]), run.x[np.newaxis]
        since = np.abs(times - times[0])
        if 0.0 < since[-1] < 2.0 * self.known:
            return
        self.known = float(since[-1])
        # At equally spaced times, since the last states of a collapsing run are almost equal; between states along
        # straight lines, since a few long steps may be most of the run.
        at = np.linspace(0.0, since[-1], STATES)
        between = np.stack([np.interp(at, since, row) for row in states.T], axis=1)
        jacobians = self._jacobians(run.ode, zip(np.interp(at, since, times), between, strict=True))
        column = np.abs(jacobians).max(axis=(0, 1))
        column[column == 0.0] = 1.0
        row = np.abs(jacobians / column).max(axis=(0, 2))
        row[row == 0.0] = 1.0
        self.row, self.size = row, row[:, np.newaxis] * column
        self.median = float(np.median(self._least(jacobians)))

    def _jacobians(self, ode: Ode, places: Iterable[tuple[float, Floats]]) -> Floats:
        return np.array([self.model.velocity(t, x, ode.parameters, ode.input_values(t, x))[0] for t, x in places])

    def _least(self, jacobians: Floats) -> Floats:
        singular_values: Floats = np.linalg.svd(jacobians / self.size, compute_uv=False)
        return singular_values[:, self.rank - 1]

    def _ratios(self, ode: Ode, places: Sequence[tuple[float, Floats]]) -> Floats:
        """The measure at several times and states; infinite where a run diverges, so that its position is unknown."""
        jacobians = self._jacobians(ode, places)
        known = np.isfinite(jacobians).all(axis=(1, 2))
        ratios = np.full(len(places), np.inf)
        ratios[known] = self._least(jacobians[known]) / self.median if self.median else 0.0
        return ratios

    def _is_locked(self, ode: Ode, t: float, x: Floats) -> bool:
        """Whether no speeds satisfy the constraints: b has a component along n, where n^T J = 0."""
        jacobian, bias = self.model.velocity(t, x, ode.parameters, ode.input_values(t, x))
        lost = np.linalg.svd(jacobian / self.size, full_matrices=False)[0][:, self.rank - 1]
        scaled = bias / self.row
        return bool(abs(lost @ scaled) > LOCKED * np.linalg.norm(scaled))

    def _message(self, verb: str, ode: Ode, t: float, x: Floats, threshold: float, more: str) -> str:
        ratio = self._ratios(ode, [(t, x)])[0]
        if not ratio < threshold:
            return ""
        if self._is_locked(ode, t, x):
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
