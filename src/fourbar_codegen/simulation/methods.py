"""Methods of integration, as objects with the options that they have."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_integer, longest_step, one_of, positive, tolerance
from fourbar_codegen.runtime.enumerations import STEP_CONTROLLED, STIFF
from fourbar_codegen.runtime.evaluator import numbers

__all__ = [
    "ALI3P",
    "CVODE",
    "DOP853",
    "FIXED_STEP",
    "IDA",
    "IN_C",
    "NAMES",
    "RK45",
    "SOLVERS",
    "Method",
    "MethodLike",
    "Radau",
    "Tsit5",
    "name_alone",
    "name_and_options",
]

FIXED_STEP = "ALI3P"
"""The method that passes singular positions, with a fixed step size; see ``steppers/ali3p.h``."""

IN_C = (*STEP_CONTROLLED, FIXED_STEP)
"""Methods that are entirely in C: those of ensembles."""

SOLVERS = ("CVODE", "IDA")
"""The others, of `fourbar_codegen.solvers`."""

NAMES = (*IN_C, *SOLVERS)

FORMULATIONS = ("gear-gupta-leimkuhler", "index-1", "index-3")
"""Of IDA."""

SCIPYS = {"RK23": "", "BDF": ", jac=ode.jac", "LSODA": ", jac=ode.jac"}
"""Methods of SciPy alone, with their arguments in ``solve_ivp``."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method of integration with its options.

    Attributes
    ----------
    max_steps : int, "auto" or None
        The largest number of steps; None is no limit. By default 1,000,000 for methods in C and 100,000 for those of
        SUNDIALS, or ten times the number that the longest step requires, if that is more.
    """

    max_steps: int | Literal["auto"] | None = "auto"

    def __post_init__(self) -> None:
        most = self.max_steps
        if not (most is None or (isinstance(most, str) and most == "auto") or (is_integer(most) and most > 0)):
            raise ModelError(f"max_steps must be a positive integer, 'auto', or None for no limit, not {shown(most)}.")


@dataclass(frozen=True, kw_only=True)
class _WithStepControl(Method):
    """A method that chooses the lengths of its steps by their estimated errors.

    Attributes
    ----------
    rtol : float
        Relative tolerance of a step; by default 1e-6.
    atol : float or array_like, shape (n_x,)
        Absolute tolerance of a step; by default 1e-9.
    max_step : float
        The longest step, s; by default there is no limit.
    """

    rtol: float | None = None
    atol: float | ArrayLike | None = None
    max_step: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rtol is not None:
            tolerance(self.rtol, "rtol")
        if self.atol is not None:
            given = numbers(self.atol, "atol")
            if given.ndim > 1 or not ((given > 0.0) & (given < np.inf)).all():
                raise ModelError(
                    f"atol must be a positive number, or an array of positive numbers, not {shown(self.atol)}."
                )
            each = tolerance(self.atol, "atol", given.size)
            object.__setattr__(self, "atol", each if isinstance(each, float) else tuple(each.tolist()))
        if self.max_step is not None:
            longest_step(self.max_step)


@dataclass(frozen=True, kw_only=True)
class DOP853(_WithStepControl):
    """The explicit Runge-Kutta method of order 8 by Dormand and Prince, with the step size control of SciPy.

    Attributes
    ----------
    rtol, atol : float, optional
        Relative and absolute tolerance of a step; by default 1e-6 and 1e-9.
    max_step : float, optional
        The longest step, s.
    max_steps : int, "auto" or None, optional
        The largest number of steps; see `CompiledModel.simulate`.

    Source: E. Hairer, S. P. Norsett, G. Wanner, *Solving Ordinary Differential Equations I*, 2nd ed., 1993.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0), method=fb.DOP853(max_step=0.01))
    >>> bool(abs(run.t[1:] - run.t[:-1]).max() < 0.0101)
    True
    """


@dataclass(frozen=True, kw_only=True)
class RK45(_WithStepControl):
    """The explicit Runge-Kutta method of order 5 by Dormand and Prince, with the step size control of SciPy.

    Attributes
    ----------
    rtol, atol, max_step, max_steps
        As of `DOP853`.

    Source: J. R. Dormand, P. J. Prince, "A family of embedded Runge-Kutta formulae", *Journal of Computational and
    Applied Mathematics* 6 (1980).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.RK45(rtol=1e-3)).success
    True
    """


@dataclass(frozen=True, kw_only=True)
class Tsit5(_WithStepControl):
    """The explicit Runge-Kutta method of order 5 by Tsitouras, with smaller error coefficients than `RK45`.

    Attributes
    ----------
    rtol, atol, max_step, max_steps
        As of `DOP853`.

    Source: Ch. Tsitouras, "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption",
    *Computers & Mathematics with Applications* 62 (2011).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.Tsit5(rtol=1e-3)).success
    True
    """


@dataclass(frozen=True, kw_only=True)
class Radau(_WithStepControl):
    """Radau IIA of order 5, for stiff equations.

    Attributes
    ----------
    rtol, atol, max_step, max_steps
        As of `DOP853`.

    Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, 2nd ed., 1996, section IV.8.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.Radau(rtol=1e-8, atol=1e-8)).success
    True
    """


@dataclass(frozen=True, kw_only=True)
class ALI3P(Method):
    """An augmented Lagrangian formulation of index 3 with the trapezoidal rule and projections.

    It passes singular positions, in steps of fixed length.

    Attributes
    ----------
    step : float
        The length of a step, s. A step whose equations cannot be solved is made of shorter ones.
    max_steps : int, "auto" or None, optional
        As of `DOP853`.

    Source: E. Bayo, R. Ledesma, "Augmented Lagrangian and mass-orthogonal projection methods for constrained multibody
    dynamics", *Nonlinear Dynamics* 9 (1996).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.ALI3P(step=1e-3)).success
    True
    """

    step: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.step is not None:
            positive(self.step, "step")


@dataclass(frozen=True, kw_only=True)
class CVODE(_WithStepControl):
    """The backward differentiation formulas of SUNDIALS, for stiff equations; needs the extra ``dae``.

    Attributes
    ----------
    rtol, atol, max_step, max_steps
        As of `DOP853`.

    Source: A. C. Hindmarsh et al., "SUNDIALS: Suite of nonlinear and differential/algebraic equation solvers", *ACM
    Transactions on Mathematical Software* 31 (2005).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.CVODE(rtol=1e-8)).success
    True
    """


@dataclass(frozen=True, kw_only=True)
class IDA(_WithStepControl):
    """The differential-algebraic solver of SUNDIALS; needs the extra ``dae``.

    Attributes
    ----------
    formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
        What satisfies the constraints in each step: positions and velocities, the default; only accelerations, so that
        the loops drift open; or only positions, with error control of the coordinates only. See
        `fourbar_codegen.solvers.IDA`.
    rtol, atol, max_step, max_steps
        As of `DOP853`.

    Source: as of `CVODE`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0), method=fb.IDA(formulation="index-1")).success
    True
    """

    formulation: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.formulation is not None:
            one_of(self.formulation, FORMULATIONS, "formulation")


MethodLike = str | Method | type[Method]
"""A method by its name, with its options, or with its defaults."""

KNOWN = (DOP853, RK45, Tsit5, Radau, ALI3P, CVODE, IDA)


def name_and_options(method: object, given: dict[str, Any], allowed: tuple[str, ...] = NAMES, what: str = "method"
) -> tuple[str, dict[str, Any]]:  # fmt: skip
    """The name of a method, and its options: those of the object, and those that were given beside it.

    Parameters
    ----------
    method : str or Method
    given : dict
        Options by name as arguments of `CompiledModel.simulate`, with their defaults where they were not given.
    allowed : tuple of str
        Names of methods.
    what : str
        The kind of these, for messages.

    Raises
    ------
    ModelError
        If there is no such method, or an option is given twice.
    """
    if isinstance(method, str) and method in SCIPYS and allowed is NAMES:
        raise ModelError(
            f"{method} is a method of SciPy, not of simulate: solve_ivp(ode, t_span, x0, "
            f'method="{method}"{SCIPYS[method]}, rtol=..., atol=...) with ode = model.ode(parameters, inputs) '
            f"integrates without closing loops. Methods are {', '.join(NAMES)}; "
            f'method="{STIFF}" is for stiff equations.'
        )
    if isinstance(method, type) and issubclass(method, KNOWN):
        method = method()
    if not isinstance(method, KNOWN):
        if getattr(method, "__module__", "").startswith("fourbar_codegen.solvers"):
            name = getattr(method, "__name__", "")
            raise ModelError(f"fb.solvers.{name} is for solve_ivp; a method of runs is {name!r}, or fb.{name}(...).")
        return str(one_of(method, allowed, what)), given
    name = str(one_of(_name(method), allowed, what))
    options = dict(given)
    for option in fields(method):
        value, unset = getattr(method, option.name), option.default
        if _is(value, unset):
            continue
        place = "max_step" if option.name == "step" else option.name  # which is how the step of ALI3P was called
        if not _is(options[place], unset):
            raise ModelError(
                f"The {option.name} of {name} is given twice, as {name}({option.name}={shown(value)}) and as "
                f"{place}={shown(options[place])}: give it once."
            )
        options[place] = value
    return name, options


def name_alone(method: object, allowed: tuple[str, ...], what: str) -> str:
    """The name of a method where it has no options: a name, or an object without any.

    Raises
    ------
    ModelError
        If there is no such method, or the object has options.
    """
    if isinstance(method, type) and issubclass(method, KNOWN):
        method = method()
    if not isinstance(method, KNOWN):
        return str(one_of(method, allowed, what))
    name = str(one_of(_name(method), allowed, what))
    own = [option.name for option in fields(method) if not _is(getattr(method, option.name), option.default)]
    if own:
        raise ModelError(f"The {what} {name} has no options here, such as {own[0]}.")
    return name


def _name(method: Method) -> str:
    return next(kind.__name__ for kind in KNOWN if isinstance(method, kind))


def _is(value: object, unset: object) -> bool:
    """Whether an option has its default, None or a text; its value may be an array."""
    return value is unset or (isinstance(value, str) and value == unset)
