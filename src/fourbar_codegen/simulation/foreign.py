"""Methods of `fourbar_codegen.solvers` for the driver of runs: steps with their own step control, and dense output."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import DenseOutput

from fourbar_codegen import solvers
from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.arguments import numbers
from fourbar_codegen.runtime.enumerations import StopReason
from fourbar_codegen.runtime.integrator import Ode, Run, check_within, steps_at

__all__ = ["ForeignMethod"]

Floats = NDArray[np.float64]

SHORT = 16
"""A step of this many spacings of doubles is too short for all solvers."""


class ForeignMethod:
    """A method of `fourbar_codegen.solvers`, whose steps the driver takes, projects and looks at.

    Times are relative to the beginning of the run, so that their resolution does not depend on it.

    Parameters
    ----------
    ode : Ode
        The right-hand side, that of the run.
    name : str
        The solver's.
    options : dict
        Of the solver.

    Attributes
    ----------
    t : float
        The time reached by the last step.
    x : ndarray, shape (n_x,)
        The state there, as the solver has it.
    message : str
        Why the solver has failed.
    """

    def __init__(self, ode: Ode, name: str, options: dict[str, Any]) -> None:
        self._ode, self._make = ode, functools.partial(getattr(solvers, name), **options)
        self._solver: Any = None
        self._counted = [0, 0, 0]
        self._interpolant: DenseOutput | None = None
        self.t, self.x, self.message = 0.0, np.empty(0), ""

    @property
    def counts(self) -> list[int]:
        """Evaluations of the right-hand side or the residual; of Jacobians; and factorizations, if they are counted."""
        solver = self._solver
        now = (solver.nfev, solver.njev, solver.nlu) if solver else (0, 0, 0)
        return [before + int(n) for before, n in zip(self._counted, now, strict=True)]

    def start(self, t: float, x: Floats, t_bound: float) -> None:
        """Begin, also anew, at a time and state, towards another time."""
        self._counted, self._solver = self.counts, None
        self._solver = self._make(self._ode, t, x, t_bound)
        self._interpolant = None

    def step(self) -> StopReason:
        """Take a step; ``PAUSED`` if that succeeds."""
        before = float(self._solver.t)
        message = self._solver.step()
        self._interpolant = None
        if self._solver.status == "failed":
            if self._ode.failure is None:
                # The last evaluation may be just before one that fails, with steps that became too short.
                ahead = before + self._solver.direction * SHORT * np.spacing(abs(before))
                self._ode(ahead, self._solver.y)
            self.message = message or "The solver has failed."
            return StopReason.FAILED
        self.t, self.x = float(self._solver.t), np.array(self._solver.y)
        return StopReason.TOO_SMALL if self.t == before else StopReason.PAUSED

    def interpolant(self) -> DenseOutput:
        """The interpolant of the last step."""
        if self._interpolant is None:
            self._interpolant = self._solver.dense_output()
        return self._interpolant

    def dense_output(self, t: float, project: bool) -> _Solution:
        """An object that stores the interpolants of all steps from an absolute time on."""
        return _Solution(self._ode, project, t)


class _Solution:
    """Dense output: the state at any time of a run."""

    def __init__(self, ode: Ode, project: bool, t: float) -> None:
        self._ode, self._project, self._times, self._ends = ode, project, [t], [0.0]
        self._interpolants: list[DenseOutput] = []

    def __len__(self) -> int:
        return len(self._interpolants)

    def add(self, run: Run) -> None:
        """Add the last step of a run."""
        last = run.foreign.interpolant()
        self._times.append(run.t)
        self._ends.append(last.t)
        self._interpolants.append(last)

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
