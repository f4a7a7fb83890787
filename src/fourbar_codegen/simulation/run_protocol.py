"""An integration under way: what a run in C and a run by one of SciPy's solvers both are."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.runtime.integrator import Ode

__all__ = ["Integration"]

Floats = NDArray[np.float64]


class Integration(Protocol):
    """A run, some steps at a time; documented where it is in C, in runtime/integrator.pyx."""

    ode: Ode

    @property
    def t(self) -> float:
        """The time that was reached."""

    @property
    def x(self) -> Floats:
        """The state there, shape (n_x,)."""

    @property
    def n_steps(self) -> int:
        """Steps so far."""

    @property
    def n_evaluations(self) -> int:
        """Evaluations of the right-hand side, or of the residual."""

    @property
    def n_jacobians(self) -> int:
        """Evaluations of its derivatives."""

    @property
    def n_factorizations(self) -> int:
        """Of matrices, where the method counts them."""

    @property
    def event_values(self) -> tuple[Any, Any]:
        """The event functions at the beginning and at the end of the last step."""

    @property
    def orientation_changed(self) -> bool:
        """Whether the constraints have changed their orientation over the last step."""

    def begin(self) -> None:
        """Before the first step."""

    def enter(self, t: float, t_bound: float, first: float, last: float, x: ArrayLike | None = None) -> bool:
        """Go on from a time, that of a boundary, to another one; with a state x, from there."""

    def on(self, steps: int) -> str:
        """Some steps; why it stopped."""

    def time_within(self, share: float) -> float:
        """The time at a share of the last step."""

    def state_within(self, share: float) -> Floats:
        """The state at a share of the last step, shape (n_x,)."""

    def event_values_within(self, share: float) -> Any:
        """The event functions at a share of the last step."""

    def stop_within(self, share: float) -> None:
        """End the run at a share of the last step."""

    def discard(self) -> None:
        """Go back to before the last step, where the run ends."""

    def take_samples(self) -> tuple[Floats, Floats]:
        """Times and states since the last call, shapes (n,) and (n, n_x)."""

    def dense_output(self) -> Any:
        """What keeps the interpolants of all steps."""
