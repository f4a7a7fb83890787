"""The interface of a running integration, in C or with one of SciPy's solvers."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.roles import StopReason
from fourbar_codegen.runtime.integrator import Ode

__all__ = ["Integration"]

Floats = NDArray[np.float64]


class Integration(Protocol):
    """A run that advances by some steps at a time; documented in runtime/integrator.pyx."""

    ode: Ode

    @property
    def t(self) -> float:
        """The time reached."""

    @property
    def x(self) -> Floats:
        """The state at that time, shape (n_x,)."""

    @property
    def n_steps(self) -> int:
        """Number of steps."""

    @property
    def n_evaluations(self) -> int:
        """Number of evaluations of the right-hand side, or of the residual."""

    @property
    def n_jacobians(self) -> int:
        """Number of evaluations of its Jacobian."""

    @property
    def n_factorizations(self) -> int:
        """Number of matrix factorizations, if the method counts them."""

    @property
    def event_values(self) -> tuple[Any, Any]:
        """Values of the event functions at the start and at the end of the last step."""

    @property
    def toggled(self) -> bool:
        """Whether the sign of det J_d may have changed in the last step."""

    def begin(self) -> None:
        """Prepare for the first step."""

    def enter(self, t: float, t_bound: float, first: float, last: float, x: ArrayLike | None = None) -> bool:
        """Continue from the time of a boundary to another time; from state x, if given."""

    def on(self, steps: int) -> StopReason | str:
        """Take some steps; returns why it stopped."""

    def time_within(self, share: float) -> float:
        """The time at a fraction of the last step."""

    def state_within(self, share: float) -> Floats:
        """The state at a fraction of the last step, shape (n_x,)."""

    def event_values_within(self, share: float) -> Any:
        """Values of the event functions at a fraction of the last step."""

    def stop_within(self, share: float) -> None:
        """End the run at a fraction of the last step: the state there is the last sample."""

    def discard(self) -> None:
        """Discard the last step; the run ends before it."""

    def take_samples(self) -> tuple[Floats, Floats]:
        """Times and states since the last call, shapes (n,) and (n, n_x)."""

    def dense_output(self) -> Any:
        """An object that stores the interpolants of all steps."""
