"""SciPy's integrators for a compiled right-hand side.

Subclasses that replace `_step_impl`, the documented extension point of ``scipy.integrate.OdeSolver``. Everything else
is SciPy's: options, step size control, events and dense output. Results differ by rounding errors. Hooks of explicit
methods, such as `_estimate_error_norm`, are not called. Solvers in several threads may use the same right-hand side.

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

import importlib
import math
import operator
from collections.abc import Callable
from copy import copy
from typing import Any

import numpy as np
import scipy.integrate
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import (
    finite_number,
    longest_step,
    number,
    numbers,
    one_of,
    positive,
    tolerance,
)
from fourbar_codegen.kernel.consistency import consistent
from fourbar_codegen.kernel.discontinuities import boundaries
from fourbar_codegen.runtime.enumerations import StopReason
from fourbar_codegen.runtime.evaluator import is_finite
from fourbar_codegen.runtime.implicit import FORMULATIONS, Rates, Residual
from fourbar_codegen.runtime.integrator import EmbeddedSteps, Ode

__all__ = ["BDF", "CVODE", "DOP853", "IDA", "LSODA", "RK23", "RK45", "Radau"]

LOOKED = 100.0
"""Assumed number of steps of a run, for the scaling of IDA's equations; some powers of ten do not matter."""

NOT_CONTROLLED = 1e150
"""An absolute tolerance that excludes a variable from the error control."""


class _Compiled(scipy.integrate.OdeSolver):
    """An integrator with a compiled right-hand side.

    Attributes
    ----------
    ode : Ode
        A copy of the right-hand side.
    """

    t: float
    y: NDArray[np.float64]

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        if not isinstance(fun, Ode):
            name = type(self).__name__
            other = f": for other functions, use scipy.integrate.{name}" if hasattr(scipy.integrate, name) else ""
            raise ModelError(
                f"fourbar_codegen.solvers.{name} integrates what CompiledModel.ode() returns, without args=, not "
                f"{fun!r}{other}."
            )
        y0 = numbers(y0, "The state y0")
        if y0.shape != (fun.n_x,) or not is_finite(y0):
            raise ModelError(f"The state y0 must be finite and have shape ({fun.n_x},), not {shown(y0)}.")
        for name in options.keys() & {"rtol", "atol"}:
            options[name] = numbers(options[name], name)[()]
            if np.shape(options[name]) not in {(), (fun.n_x,)} or not np.all(
                (options[name] >= 0) & np.isfinite(options[name])
            ):
                raise ModelError(f"{name} must be a nonnegative number, or an array of these, of shape ({fun.n_x},).")
        if "max_step" in options:
            options["max_step"] = longest_step(options["max_step"])
        if options.get("first_step") is not None:
            options["first_step"] = positive(options["first_step"], "first_step")
        t0, t_bound = finite_number(t0, "t0"), number(t_bound, "t_bound")
        if math.isnan(t_bound):
            raise ModelError("The end t_bound must be a number or infinite, not nan.")
        if not fun.in_pieces:
            for at in boundaries(fun, t0, t_bound, y0)[0]:
                raise ModelError(
                    f"The rate of a prescribed motion jumps at t = {at.begin:.9g}, and so do the speeds: use "
                    "CompiledModel.simulate, which passes the jump, or end the run there."
                )
        # A copy with its own memory: the given one may be in use in other threads, except by a run of its own.
        self.ode = fun if fun.in_pieces else copy(fun)
        self._complete(options)
        super().__init__(self.ode, t0, y0, t_bound, **options)

    def _complete(self, options: dict[str, Any]) -> None:
        """Add options that depend on the right-hand side."""

    def _project(self) -> None:
        """Project the state reached onto the constraints, and evaluate it again."""
        self.y = self.ode.project(self.t, self.y)
        self.f = self.fun(self.t, self.y)


class _Explicit(_Compiled):
    """Stages and step size control in C: see ``runtime/steppers/runge_kutta.h``."""

    # Attributes of scipy.integrate.RungeKutta, which has no type annotations.
    h_abs: float
    f: NDArray[np.float64]

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        super().__init__(fun, t0, y0, t_bound, **options)
        self._settings: tuple[Any, ...] = ()

    def _make_stepper(self) -> EmbeddedSteps:
        weights = np.zeros((self.n_stages, self.n_stages))
        weights[:, : self.A.shape[1]] = self.A
        return EmbeddedSteps(
            self.ode,
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
        # Users may change them between steps.
        settings = (self.t_bound, self.direction, self.max_step, self.rtol, self.atol)
        if not self._settings or not all(map(operator.is_, settings, self._settings)):
            self._settings, self._stepper = settings, self._make_stepper()
        self.K[0] = self.f
        t, h, h_abs, y, evaluations, reason = self._stepper.step(self.t, self.h_abs, self.y, self.K)
        self.nfev += evaluations
        if reason == StopReason.INFINITE:
            return False, "The step size is not finite: give a finite end, or max_step."
        if reason != StopReason.PAUSED:
            return False, self.TOO_SMALL_STEP
        self.h_previous, self.y_old = h, self.y
        self.t, self.h_abs, self.y, self.f = t, h_abs, y, self.K[-1].copy()
        return True, None


class RK23(_Explicit, scipy.integrate.RK23):
    """Explicit Runge-Kutta method of order 3(2), Bogacki and Shampine: ``scipy.integrate.RK23`` with steps in C."""


class RK45(_Explicit, scipy.integrate.RK45):
    """Explicit Runge-Kutta method of order 5(4), Dormand and Prince: ``scipy.integrate.RK45`` with steps in C."""


class DOP853(_Explicit, scipy.integrate.DOP853):
    """Explicit Runge-Kutta method of order 8(5, 3), Hairer: ``scipy.integrate.DOP853`` with steps in C."""

    def _error_weights(self) -> ArrayLike:
        return [self.E5, self.E3]


class _Implicit(_Compiled):
    """Uses the compiled Jacobian, and ends the run, with its results, if the equations cannot be evaluated.

    Explicit methods reject a step with NaN and reduce the step size. Without this class, Radau and BDF would end with
    an exception of the factorization, and LSODA would continue with NaN.
    """

    def _complete(self, options: dict[str, Any]) -> None:
        banded = options.get("lband") is not None or options.get("uband") is not None
        if options.get("jac") is None and self.ode.has_jacobian and not banded:
            options["jac"] = self.ode.jac

    def _step_impl(self) -> tuple[bool, str | None]:
        before = self.t, self.y
        try:
            success, message = super()._step_impl()
        except ValueError as error:
            if self.ode.failure is None and "infs or NaNs" not in str(error):
                raise
            return False, self.ode.failure or "intermediate results exceed the range of double"
        if is_finite(self.y):
            if success and self.ode.projects:
                self._project()
            return success, message
        self.t, self.y = before
        return False, self.ode.failure or "the state is not finite"


class Radau(_Implicit, scipy.integrate.Radau):
    """Implicit Runge-Kutta method Radau IIA of order 5: ``scipy.integrate.Radau`` with the compiled Jacobian."""


class BDF(_Implicit, scipy.integrate.BDF):
    """Backward differentiation formulas of order 1 to 5: ``scipy.integrate.BDF`` with the compiled Jacobian."""

    def _project(self) -> None:
        # The method stores differences, the first of which is the state itself.
        self.y = self.D[0] = self.ode.project(self.t, self.y)


class LSODA(_Implicit, scipy.integrate.LSODA):
    """Automatic switching between Adams and BDF, from ODEPACK: ``scipy.integrate.LSODA`` with the compiled Jacobian.

    Its history cannot be modified, so states are not projected between steps.
    """

    def _project(self) -> None:
        pass


class _Sundials(_Compiled):
    """A solver of SUNDIALS, through scikit-sundae; its history cannot be modified, so states are not projected."""

    _solver: Any
    njev = nlu = 0

    def __init__(
        self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, *, rtol: float = 1e-3, atol: ArrayLike = 1e-6,
        max_step: float = math.inf, first_step: float | None = None, vectorized: bool = False,
    ) -> None:  # fmt: skip
        super().__init__(fun, t0, y0, t_bound, vectorized=vectorized)
        if not math.isfinite(t_bound):
            raise ModelError(f"{type(self).__name__} needs a finite end, not {t_bound}.")
        longest = longest_step(max_step)
        self._options = {
            "rtol": float(tolerance(rtol, "rtol")),
            "max_step": 0.0 if longest == math.inf else longest,
            "first_step": 0.0 if first_step is None else positive(first_step, "first_step"),
            "max_num_steps": 10_000,  # within a single step, with its repetitions
        }
        self._atol = np.array(np.broadcast_to(tolerance(atol, "atol", self.n), self.n))

    def _step_impl(self) -> tuple[bool, str | None]:
        try:
            result = self._solver.step(self.t_bound, method="onestep", tstop=self.t_bound)
        except KeyError as error:  # an error code that scikit-sundae does not know
            return False, f"SUNDIALS ends with error {error}: the interval may be too short."
        self.nfev, self.njev = result.nfev, result.njev
        if result.status < 0 or not is_finite(result.y):
            return False, self.ode.failure or result.message
        if result.t == self.t:  # SUNDIALS would never end
            return False, self.ode.failure or self.TOO_SMALL_STEP
        self.t, self.y = result.t, result.y[: self.n].copy()
        return True, None

    def _dense_output_impl(self) -> scipy.integrate.DenseOutput:
        return _Polynomial(self.t_old, self.t, self._interpolated)

    def _interpolated(self, t: float) -> NDArray[np.float64]:
        """The solver's interpolant at a time within the last step."""
        return self._solver.step(t, method="normal").y[: self.n].copy()  # type: ignore[no-any-return]


class _Polynomial(scipy.integrate.DenseOutput):
    """The polynomial of degree 5 through the solver's interpolant, of degree at most 5, at Chebyshev points.

    Source: L. N. Trefethen, *Approximation Theory and Approximation Practice*, SIAM, 2013, chapter 3.
    """

    NODES = -np.cos(np.pi * np.arange(6) / 5.0)
    COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(NODES, 5))

    def __init__(self, t_old: float, t: float, value: Callable[[float], NDArray[np.float64]]) -> None:
        super().__init__(t_old, t)
        times = t_old + (t - t_old) * (1.0 + self.NODES) / 2.0
        times[-1] = t  # read last, because the solver continues from there
        self._coefficients = self.COEFFICIENTS @ [value(time) for time in times]

    def _call_impl(self, t: Any) -> NDArray[np.float64]:
        place = 2.0 * ((t - self.t_old) / (self.t - self.t_old)) - 1.0
        return np.asarray(chebyshev.chebval(place, self._coefficients))


class CVODE(_Sundials):
    """Backward differentiation formulas of order 1 to 5, from SUNDIALS, with compiled right-hand side and Jacobian.

    Needs scikit-sundae: ``pip install 'fourbar_codegen[dae]'``.

    Source: A. C. Hindmarsh and others, "SUNDIALS: Suite of Nonlinear and Differential/Algebraic Equation Solvers", *ACM
    Transactions on Mathematical Software* 31 (2005).
    """

    def __init__(self, fun: Ode, t0: float, y0: ArrayLike, t_bound: float, **options: Any) -> None:
        super().__init__(fun, t0, y0, t_bound, **options)
        cvode = _sundae("cvode")
        rates = Rates(self.ode)
        jacobian = {"jacfn": rates.jacobian} if self.ode.has_jacobian else {}
        self._solver = cvode.CVODE(rates.evaluate, method="BDF", atol=self._atol, **self._options, **jacobian)
        self._solver.init_step(t0, self.y)


class IDA(_Sundials):
    """Differential-algebraic solver of order 1 to 5, from SUNDIALS: keeps the constraints as equations.

    Residual and Jacobian are compiled. Constraints must not be redundant. Needs scikit-sundae:
    ``pip install 'fourbar_codegen[dae]'``.

    Parameters
    ----------
    fun, t0, y0, t_bound, rtol, atol, max_step, first_step
        As for ``scipy.integrate.OdeSolver``; ``y0`` must satisfy the constraints.
    formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
        What satisfies the constraints at each step: positions and velocities (index 2); only accelerations, so that
        the loops drift open; or only positions. Tolerances apply to the state; multipliers follow.

    Notes
    -----
    Tolerances limit the error of a step. Velocities that satisfy their constraints exactly follow the errors of
    positions: if these change fast, IDA takes several times as many steps in its default formulation as in index 1.
    For non-stiff problems, DOP853 is more accurate and faster.
    """

    def __init__(
        self,
        fun: Ode,
        t0: float,
        y0: ArrayLike,
        t_bound: float,
        *,
        formulation: str = "gear-gupta-leimkuhler",
        **options: Any,
    ) -> None:
        super().__init__(fun, t0, y0, t_bound, **options)
        ode, layout = self.ode, self.ode.layout
        one_of(formulation, FORMULATIONS, "formulation")
        if formulation == "index-3" and ode.evaluator.states_need_solution:
            raise ModelError(
                "In formulation='index-3' accelerations and multipliers are not accurate enough for state equations "
                "that contain them: use another formulation."
            )
        if formulation != "index-1":
            self.y = consistent(ode, t0, self.y)
        rates, multipliers = ode.multipliers(t0, self.y)
        without_row = layout.constraints.position_rows.count(None) - len(layout.constraints.invariants)
        if without_row or layout.n_dependent_speeds < ode.evaluator.n_c:
            raise ModelError(
                "IDA solves for all multipliers, which redundant constraints do not determine: use another method."
            )
        ida = _sundae("ida")
        residual = Residual(ode, formulation)
        y, y_rate = np.zeros(residual.n_y), np.zeros(residual.n_y)
        y[: self.n], y[self.n : self.n + len(multipliers)], y_rate[: self.n] = self.y, multipliers, rates
        weights = self._atol + self._options["rtol"] * np.abs(self.y)
        weights = np.where(weights > 0.0, weights, 1.0)
        speeds = slice(ode.n_q, ode.n_q + ode.n_u)
        tolerances = self._atol[speeds]
        metric = np.square(tolerances / tolerances.max()) if tolerances.all() else np.ones(len(tolerances))
        residual.scale(t0, LOOKED / (abs(t_bound - t0) or 1.0), y, y_rate, weights, metric)
        atol = np.full(residual.n_y, NOT_CONTROLLED)
        atol[: self.n] = self._atol
        if formulation == "index-3":
            atol[speeds] = NOT_CONTROLLED
        self._solver = ida.IDA(
            residual.evaluate,
            atol=atol,
            algebraic_idx=np.arange(self.n, residual.n_y),
            jacfn=residual.jacobian,
            **self._options,
        )
        self._solver.init_step(t0, y, y_rate)


def _sundae(name: str) -> Any:
    try:
        return importlib.import_module(f"sksundae.{name}")
    except ImportError as error:
        raise ModelError(f"method={name.upper()!r} needs scikit-sundae: pip install 'fourbar_codegen[dae]'.") from error
