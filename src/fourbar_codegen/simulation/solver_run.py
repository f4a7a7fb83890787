"""Runs with `fourbar_codegen.solvers`, with the same interface as `runtime.integrator.Run` for the methods in C."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import DenseOutput

from fourbar_codegen.arguments import numbers
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.roles import StopReason
from fourbar_codegen.runtime.evaluator import OK
from fourbar_codegen.runtime.integrator import Ode, check_within, steps_at
from fourbar_codegen.simulation import solvers

__all__ = ["SolverRun"]

Floats = NDArray[np.float64]

SHORT = 16
"""A step of this many spacings of doubles is too short for all solvers."""

LOOKS = 8
"""Number of states within a step at which the sign of det J_d is checked, if necessary."""


class SolverRun:
    """A run with one of `fourbar_codegen.solvers`, step by step.

    Parameters
    ----------
    model : Kernel
    ode : Ode
        The right-hand side; the run's attribute ``ode`` is a copy.
    method : str
        The solver's name.
    t : float
    x : ndarray, shape (n_x,)
    t_bound, max_step : float
    rtol, atol : array_like
    project : bool
        Whether every state is projected onto the constraints.
    times : ndarray or None
        Times of the samples; None for a sample after each step.
    outputs : sequence of int
        Indices of the outputs that are event functions.
    options : dict
        Further options of the solver.
    """

    def __init__(
        self, model: Kernel, ode: Ode, method: str, t: float, x: Floats, t_bound: float, max_step: float,
        rtol: ArrayLike, atol: ArrayLike, project: bool, times: Floats | None, outputs: Sequence[int],
        options: dict[str, Any],
    ) -> None:  # fmt: skip
        self._model, self._project, self._outputs = model, project, outputs
        ode.projects, ode.in_pieces, ode.clock = project, True, (t, -math.inf, math.inf)
        # The solver's time starts at 0, so that its resolution does not depend on the time.
        self._origin = t
        options = {"rtol": rtol, "atol": atol, "max_step": max_step, **options}
        self._make = functools.partial(getattr(solvers, method), **options)
        self._solver = self._make(ode, 0.0, x, t_bound - t)
        self._counted = [0, 0, 0]
        self.ode: Ode = self._solver.ode
        self.t, self.t_old, self._since, self._since_old = t, t, 0.0, 0.0
        self.n_steps, self.toggled = 0, False
        self._x = self._x_old = np.array(x)
        self._t_bound, self._bound, self._until = t_bound, t_bound - t, t_bound - t
        self._times, self._next = times, 0
        self._pending, self._interpolant = True, None
        self._samples: list[tuple[float, Floats]] = []

    @property
    def x(self) -> Floats:
        """The state reached, shape (n_x,), as a copy."""
        return self._x.copy()

    @property
    def n_evaluations(self) -> int:
        """Number of evaluations of the right-hand side, or of the residual."""
        return self._counted[0] + int(self._solver.nfev)

    @property
    def n_jacobians(self) -> int:
        """Number of evaluations of its Jacobian."""
        return self._counted[1] + int(self._solver.njev)

    @property
    def n_factorizations(self) -> int:
        """Number of matrix factorizations, if the solver counts them."""
        return self._counted[2] + int(self._solver.nlu)

    def begin(self) -> None:
        """Prepare for the first step."""
        self._toggled()
        values = self._event_values(self.t, self._x)
        self.event_values = values, values

    def enter(self, t: float, t_bound: float, first: float, last: float, x: ArrayLike | None = None) -> bool:
        """Continue from the time of a boundary to another time; from state x, if given.

        Take the samples before. Until the next boundary, inputs are evaluated between the times first and last.
        Returns whether the state could be projected onto the constraints.
        """
        ode = self.ode
        ode.clock = self._origin, min(first, last), max(first, last)
        self.t, self._t_bound = t, t_bound
        self._since, self._bound = t - self._origin, t_bound - self._origin
        self._since_old = self._since
        self._until = self._bound
        if x is not None:
            self._x, self._pending, self._interpolant = np.array(x, dtype=float), True, None
            if self._project:
                status, self._x = ode.closest(self._since, self._x)
                if status != OK:
                    return False
        if t != t_bound:
            self._counted = [self.n_evaluations, self.n_jacobians, self.n_factorizations]
            self._solver = self._make(ode, self._since, self._x, self._bound)
            self.ode = self._solver.ode
        before = self.event_values[1]
        self.begin()
        self.event_values = before, self.event_values[1]
        return True

    def on(self, steps: int) -> StopReason | str:
        """Take a step, if any is left; returns why it stopped, or the message of a solver that fails."""
        if self._pending:
            self._sample()
        if self._since == self._bound:
            return StopReason.END
        if steps <= 0:
            return StopReason.PAUSED
        message = self._solver.step()
        if self._solver.status == "failed":
            if self.ode.failure is None:
                # The last evaluation may be just before one that fails, with steps that became too short.
                since = self._since + self._solver.direction * SHORT * np.spacing(abs(self._since))
                self.ode(since, self._x)
            return message or "The solver has failed."
        since, x = float(self._solver.t), np.array(self._solver.y)
        if since == self._since:
            return StopReason.TOO_SMALL
        if self._project:
            status, x = self.ode.closest(since, x)
            if status != OK:
                return StopReason.OPEN
        self.t_old, self._since_old, self._x_old = self.t, self._since, self._x
        self.t, self._since, self._x = self._at(since), since, x
        self.n_steps += 1
        self._pending, self._interpolant = True, None
        self.toggled = self._toggled()
        if self._outputs:
            self.event_values = self.event_values[1], self._event_values(self.t, x)
        return StopReason.EVENT

    def _at(self, since: float) -> float:
        return self._t_bound if since == self._bound else self._origin + since

    def _toggled(self) -> bool:
        """Whether the sign of det J_d may have changed since the last call, also within the step."""
        if not self._toggled_at(1.0) or self.n_steps == 0:
            return False
        self.ode(self._since_old, self._x_old)
        self.ode.toggled()
        turned = [
            self._toggled_at(look / LOOKS) for look in range(1, LOOKS + 1)
        ]  # up to the end, where the run continues
        return any(turned)

    def _toggled_at(self, share: float) -> bool:
        self.ode(self._within(share), self.state_within(share))
        return self.ode.toggled()

    def _sample(self) -> None:
        """Store the samples of the last step."""
        direction, self._pending = self._solver.direction, False
        if self._times is None:
            self._samples.append((self.t, self._x))
            return
        last, end = min(direction * self._since, direction * self._until), direction * self._t_bound
        while self._next < len(self._times):
            t = float(self._times[self._next])
            # Compare the time itself, too: relative times on both sides of a jump may be equal.
            if direction * t > end or direction * (t - self._origin) > last:
                break
            self._samples.append((t, self._state_at(t - self._origin)))
            self._next += 1

    def take_samples(self) -> tuple[Floats, Floats]:
        """The samples since the last call, shapes (n,) and (n, n_x)."""
        samples, self._samples = self._samples, []
        return np.array([t for t, _ in samples]), np.reshape([x for _, x in samples], (-1, len(self._x)))

    def interpolant(self) -> DenseOutput:
        """The interpolant of the last step."""
        if self._interpolant is None:
            self._interpolant = self._solver.dense_output()
        return self._interpolant

    def _state_at(self, since: float) -> Floats:
        """The state at a time within the last step."""
        if since == self._since or self._since == self._since_old:  # no step since the run was started or continued
            return self.x
        x: Floats = self.interpolant()(since)
        return self.ode.project(since, x) if self._project else x

    def _within(self, share: float) -> float:
        return self._since if share == 1.0 else self._since_old + share * (self._since - self._since_old)

    def time_within(self, share: float) -> float:
        """The time at a fraction of the last step."""
        return self._at(self._within(share))

    def state_within(self, share: float) -> Floats:
        """The state at a fraction of the last step, shape (n_x,)."""
        return self._state_at(self._within(share))

    def event_values_within(self, share: float) -> Floats:
        """Values of the event functions at a fraction of the last step, shape (n_events,)."""
        return self._event_values(self.time_within(share), self.state_within(share))

    def _event_values(self, t: float, x: Floats) -> Floats:
        if not self._outputs:
            return np.empty(0)
        values = self._model.output(t, x, self.ode.parameters, self.ode.input_values(t, x))
        return values[list(self._outputs)]

    def stop_within(self, share: float) -> None:
        """End the run at a fraction of the last step: the state there is the last sample."""
        t, x = self.time_within(share), self.state_within(share)
        self._until = self._within(share)
        if self._times is None:
            self.t, self._x = t, x
            return
        self._sample()
        if not self._next or self._times[self._next - 1] != t:
            self._samples.append((t, x))

    def discard(self) -> None:
        """Discard the last step; the run ends before it."""
        self.t, self._x, self._pending = self.t_old, self._x_old, False

    def dense_output(self) -> _Solution:
        """An object that stores the interpolants of all steps."""
        return _Solution(self.ode, self._project, self.t)


class _Solution:
    """Dense output: the state at any time of a run."""

    def __init__(self, ode: Ode, project: bool, t: float) -> None:
        self._ode, self._project, self._times, self._ends = ode, project, [t], [0.0]
        self._interpolants: list[DenseOutput] = []

    def __len__(self) -> int:
        return len(self._interpolants)

    def add(self, run: SolverRun) -> None:
        """Add the last step of a run."""
        self._times.append(run.t)
        self._ends.append(run.interpolant().t)
        self._interpolants.append(run.interpolant())

    def __call__(self, t: Any) -> Floats:
        """The state at times t: shape (n_x,) for a number, (n_x, n) for n of them."""
        times = np.atleast_1d(numbers(t, "The times"))
        if times.ndim != 1:
            raise ModelError(f"Times must be a number or an array of one dimension, not of shape {np.shape(t)}.")
        begin, end = self._times[0], self._times[-1]
        check_within(times, begin, end)
        steps = steps_at(times, float(np.sign(end - begin)), self._times, self._ends)
        states = [self._state(time, self._interpolants[i](time - begin)) for time, i in zip(times, steps, strict=True)]
        return states[0] if np.ndim(t) == 0 else np.reshape(states, (-1, self._ode.n_x)).T

    def _state(self, t: float, x: Floats) -> Floats:
        if not self._project:
            return x
        # Use the time itself: the relative time may be on the other side of a jump.
        self._ode.clock = t, -math.inf, math.inf
        return self._ode.project(0.0, x)
