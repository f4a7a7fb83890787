"""SciPy's integrators for a compiled right-hand side.

Subclasses that replace `_step_impl`, which ``scipy.integrate.OdeSolver`` documents as the place for a method
of one's own. All else is SciPy's: the options, the choice of steps, events and dense output; numbers differ by
rounding errors. Of the explicit ones, hooks such as `_estimate_error_norm` are not called.

Examples
--------
>>> import fourbar_codegen as fb
>>> from scipy.integrate import solve_ivp
>>> four_bar = fb.load("four_bar")
>>> ode, x0 = four_bar.ode(), four_bar.initial_state()
>>> compiled = solve_ivp(ode, (0.0, 4.0), x0, method=fb.solvers.RK45)
>>> compiled.nfev == solve_ivp(ode, (0.0, 4.0), x0, method="RK45").nfev
True
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import scipy.integrate
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.runtime.integrator import EmbeddedSteps, Ode

__all__ = ["BDF", "DOP853", "LSODA", "RK23", "RK45", "Radau"]


class _Compiled(scipy.integrate.OdeSolver):
    """An integrator that knows that its right-hand side is compiled."""

    t: float
    y: NDArray[np.float64]

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        if not isinstance(fun, Ode):
            name = type(self).__name__
            raise ModelError(
                f"fourbar_codegen.solvers.{name} integrates what CompiledModel.ode() returns, without args=, not "
                f"{fun!r}: for other functions there is scipy.integrate.{name}."
            )
        self._ode = fun
        super().__init__(fun, t0, y0, t_bound, **options)

    def _project(self) -> None:
        """Move the state that was reached onto the constraints, and evaluate it anew."""
        self.y = self._ode.project(self.t, self.y)
        self.f = self.fun(self.t, self.y)


class _Explicit(_Compiled):
    """The stages of a step, and its control, in C: see ``runtime/fourbar_integrate.h``."""

    # Of scipy.integrate.RungeKutta, which has no types.
    h_abs: float
    f: NDArray[np.float64]

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        super().__init__(fun, t0, y0, t_bound, **options)
        self._settings: tuple[Any, ...] = ()

    def _make_stepper(self) -> EmbeddedSteps:
        weights = np.zeros((self.n_stages, self.n_stages))
        weights[:, : self.A.shape[1]] = self.A
        return EmbeddedSteps(
            self._ode,
            (weights, self.B, self.C),
            self._error_weights(),
            self.error_exponent,
            self.t_bound,
            self.direction,
            self.max_step,
            self.rtol,
            self.atol,
        )

    def _error_weights(self) -> ArrayLike:
        return self.E  # type: ignore[no-any-return]

    def _step_impl(self) -> tuple[bool, str | None]:
        # They may be changed between steps.
        settings = (self.t_bound, self.direction, self.max_step, self.rtol, self.atol)
        if not self._settings or not all(map(operator.is_, settings, self._settings)):
            self._settings, self._stepper = settings, self._make_stepper()
        self.K[0] = self.f
        t, h, h_abs, y, evaluations, problem = self._stepper.step(self.t, self.h_abs, self.y, self.K)
        self.nfev += evaluations
        if problem == "infinite":
            return False, "The step's length is not finite: give a finite end, or max_step."
        if problem:
            return False, self.TOO_SMALL_STEP
        self.h_previous, self.y_old = h, self.y
        self.t, self.h_abs, self.y, self.f = t, h_abs, y, self.K[-1].copy()
        return True, None


class RK23(_Explicit, scipy.integrate.RK23):
    """Runge-Kutta of order 3(2) by Bogacki and Shampine: ``scipy.integrate.RK23`` with its steps in C."""


class RK45(_Explicit, scipy.integrate.RK45):
    """Runge-Kutta of order 5(4) by Dormand and Prince: ``scipy.integrate.RK45`` with its steps in C."""


class DOP853(_Explicit, scipy.integrate.DOP853):
    """Runge-Kutta of order 8(5, 3) by Hairer: ``scipy.integrate.DOP853`` with its steps in C."""

    def _error_weights(self) -> ArrayLike:
        return [self.E5, self.E3]


class _Implicit(_Compiled):
    """The compiled Jacobian, and an end, with what there is, where the equations cannot be evaluated.

    The explicit methods reject a step that is not a number and go down with their step size. Of the implicit
    ones, Radau and BDF stop with an exception from the factorization, and LSODA goes on with what is not a
    number.
    """

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        banded = options.get("lband") is not None or options.get("uband") is not None
        if options.get("jac") is None and isinstance(fun, Ode) and fun.has_jacobian and not banded:
            options["jac"] = fun.jac
        super().__init__(fun, t0, y0, t_bound, **options)

    def _step_impl(self) -> tuple[bool, str | None]:
        try:
            success, message = super()._step_impl()
        except ValueError as error:
            if self._ode.failure is None and "infs or NaNs" not in str(error):
                raise
            return False, self._ode.failure or "the method's own numbers are beyond the range of double"
        if np.isfinite(self.y).all():
            if success and self._ode.projects:
                self._project()
            return success, message
        return False, self._ode.failure or "the state is not finite"


class Radau(_Implicit, scipy.integrate.Radau):
    """Implicit Runge-Kutta of Radau IIA, order 5: ``scipy.integrate.Radau`` with the compiled Jacobian."""


class BDF(_Implicit, scipy.integrate.BDF):
    """Backward differentiation of order 1 to 5: ``scipy.integrate.BDF`` with the compiled Jacobian."""

    def _project(self) -> None:
        # Its history are differences, of which the first is the state itself.
        self.y = self.D[0] = self._ode.project(self.t, self.y)


class LSODA(_Implicit, scipy.integrate.LSODA):
    """Adams and BDF by turns, from ODEPACK: ``scipy.integrate.LSODA`` with the compiled Jacobian.

    Its history is its own, so that nothing is moved onto the constraints between its steps.
    """

    def _project(self) -> None:
        pass
