"""RunOptions and RunStart: the checked arguments of a run."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import (
    flag,
    is_integer,
    is_mapping,
    longest_step,
    name_of,
    named,
    named_array,
    numbers,
    positive,
    sample_times,
    time_span,
    tolerance,
)
from fourbar_codegen.kernel.consistency import projects
from fourbar_codegen.kernel.inputs import held_inputs, own_sources
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.sensitivity import differentiable
from fourbar_codegen.runtime.enumerations import EXPLICIT
from fourbar_codegen.simulation.events import Event, events_of
from fourbar_codegen.simulation.methods import FIXED_STEP, IN_C, NAMES, SOLVERS, MethodLike, name_and_options

__all__ = ["RunOptions", "RunStart"]

Floats = NDArray[np.float64]

MAX_STEPS = dict.fromkeys(IN_C, 1_000_000) | dict.fromkeys(SOLVERS, 100_000)
"""Default for the largest number of steps: seconds of computing time for mechanisms of a few bodies; ..."""

MARGIN = 10
"""... or this many times the number that max_step requires, if that is more."""


@dataclass(frozen=True)
class RunOptions:
    """How runs are made, checked: the arguments of `CompiledModel.simulate` that many runs can have in common.

    Attributes
    ----------
    project : bool
        Whether states are projected onto the constraints.
    """

    t_span: tuple[float, float]
    method: str
    t_eval: Floats | None
    rtol: float | Floats
    atol: float | Floats
    events: list[Event] | None
    constraints: str
    stabilization: float | None
    dense_output: bool
    max_step: float
    max_steps: int | None
    formulation: str | None
    progress: Callable[[float], object] | Literal[False] | None
    sensitivities: tuple[str, ...]
    gradient: bool
    project: bool

    @classmethod
    def of(
        cls,
        model: Kernel,
        t_span: Any,
        *,
        method: MethodLike,
        allowed: tuple[str, ...] = NAMES,
        tolerances: tuple[float, float] = (1e-6, 1e-9),
        rtol: Any = None,
        atol: Any = None,
        t_eval: Any = None,
        events: Any = None,
        constraints: str = "project",
        stabilization: Any = 10.0,
        dense_output: bool = False,
        max_step: float | None = None,
        max_steps: Any = "auto",
        formulation: str | None = None,
        progress: Any = None,
        sensitivities: Any = (),
        gradient: bool = False,
    ) -> RunOptions:
        """Check the given arguments.

        `allowed` are the names of methods, and `tolerances` the relative and absolute ones by default.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, is not finite, is given twice, or is not supported by the method.
        """
        given = {
            "rtol": rtol, "atol": atol, "max_step": max_step, "max_steps": max_steps, "formulation": formulation
        }  # fmt: skip
        method, own = name_and_options(method, given, allowed, "method" if allowed is NAMES else "method for ensembles")
        if not (own["formulation"] is None or method == "IDA"):
            raise ModelError(f"A formulation is for IDA; {method} has none.")
        project = projects(model, constraints, stabilizes=method not in (FIXED_STEP, "IDA"))
        span = time_span(t_span)
        stabilization = positive(stabilization, "stabilization")
        longest = math.inf if own["max_step"] is None else longest_step(own["max_step"])
        if method == FIXED_STEP and longest == math.inf:
            raise ModelError(
                f"{FIXED_STEP} has a fixed step size: give it, as {FIXED_STEP}(step=...) or max_step= "
                "(fourbar: --max-step)."
            )
        if not (progress is None or progress is False or callable(progress)):
            raise ModelError(f"progress must be a callable of the time, False or None, not {shown(progress)}.")
        return cls(
            t_span=span,
            method=method,
            t_eval=None if t_eval is None else sample_times(t_eval, *span),
            rtol=tolerances[0] if own["rtol"] is None else tolerance(own["rtol"], "rtol"),
            atol=tolerances[1] if own["atol"] is None else tolerance(own["atol"], "atol", model.n_x),
            events=None if events is None else events_of(model, events),
            constraints=constraints,
            stabilization=stabilization if constraints == "baumgarte" else None,
            dense_output=flag(dense_output, "dense_output"),
            max_step=longest,
            max_steps=_max_steps(own["max_steps"], method, span, longest),
            formulation=own["formulation"],
            progress=progress,
            sensitivities=_sensitivities(sensitivities, gradient, method, constraints),
            gradient=flag(gradient, "gradient"),
            project=project,
        )

    def settings(self, inputs: Mapping[Any, Any] | None = None) -> dict[str, Any]:
        """The arguments that a result stores, with the names of inputs that were held tables."""
        settings: dict[str, Any] = {
            "method": self.method,
            "t_span": self.t_span,
            "rtol": self.rtol,
            "atol": self.atol.tolist() if isinstance(self.atol, np.ndarray) else self.atol,
            "constraints": self.constraints,
        }
        if self.stabilization is not None:
            settings["stabilization"] = self.stabilization
        if self.max_step < math.inf:
            settings["max_step"] = self.max_step
        if self.formulation is not None:
            settings["formulation"] = self.formulation
        if held := held_inputs(inputs):
            settings["held"] = held
        return settings


@dataclass(frozen=True)
class RunStart:
    """What a run starts from, checked: what differs between runs with the same options."""

    x0: Floats | None
    parameters: Floats | None
    inputs: Mapping[Any, Any] | None
    dx0: Mapping[str, Floats]

    @classmethod
    def of(
        cls,
        model: Kernel,
        options: RunOptions,
        x0: Any = None,
        parameters: Any = None,
        inputs: Any = None,
        dx0: Any = None,
    ) -> RunStart:
        """Check the given arguments.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        """
        if inputs is not None:
            inputs = own_sources(model, inputs)
        derivatives = {}
        if dx0 is not None:
            if not (options.sensitivities or options.gradient):
                raise ModelError("dx0 counts for derivatives of a run: give sensitivities= or gradient=True as well.")
            names = options.sensitivities or differentiable(model, inputs)
            derivatives = _derivatives(model, dx0, x0, names, inputs or {})
        state = None if x0 is None else named_array(x0, model.states, {}, "state")
        return cls(state, model.parameter_vector(parameters), inputs, derivatives)


def _sensitivities(given: Any, gradient: bool, method: str, constraints: str) -> tuple[str, ...]:
    if is_mapping(given):
        raise ModelError(f"sensitivities must be names of parameters, initial values and inputs, not {shown(given)}.")
    try:
        names = (given,) if isinstance(given, str) else tuple(given)
    except TypeError:
        names = (given,)
    what = "sensitivities" if names else "gradient"
    if (names or gradient) and method not in EXPLICIT:
        raise ModelError(f"{method} has no {what}: use {' or '.join(EXPLICIT)}.")
    if (names or gradient) and constraints == "baumgarte":
        raise ModelError(f'constraints="baumgarte" has no {what}: use "project" or "none".')
    return tuple(map(name_of, names))


def _derivatives(
    model: Kernel, given: Any, x0: Any, names: tuple[str, ...], inputs: Mapping[Any, Any]
) -> dict[str, Floats]:
    """The derivatives of an initial state, by names."""
    if x0 is None:
        raise ModelError("dx0 are the derivatives of x0, which is not given: leave both out, or give both.")
    if not is_mapping(given):
        raise ModelError(f"dx0 must be a mapping from names to arrays of shape ({model.n_x},), not {shown(given)}.")
    tables = {name_of(key): len(source[0]) for key, source in inputs.items() if isinstance(source, tuple)}
    found = {}
    for name, value in named(given, names, "name to differentiate with respect to").items():
        what = f"derivative with respect to {name} of state"
        if name not in tables:
            found[name] = named_array(value, model.states, {}, what)
            continue
        found[name] = numbers(value, f"The {what}")
        if found[name].shape != (tables[name], model.n_x) or not np.isfinite(found[name]).all():
            raise ModelError(
                f"dx0 of the table {name} must be finite, of the shape ({tables[name]}, {model.n_x}), not "
                f"{found[name].shape}."
            )
    return found


def _max_steps(given: object, method: str, span: tuple[float, float], max_step: float) -> int | None:
    """The largest number of steps of a run: by default that of its method."""
    if max_step == math.inf and type(given) is str and given == "auto":  # the usual case
        return MAX_STEPS[method]
    length = abs(span[1] - span[0])
    if max_step < math.ulp(length):
        raise ModelError(f"max_step = {max_step:g} is below the rounding error of the run's {length:g} s.")
    if isinstance(given, str) and given == "auto":
        return max(MAX_STEPS[method], int(min(MARGIN * length / max_step, sys.maxsize)))
    if given is None:
        return None
    if not is_integer(given) or given < 1:
        raise ModelError(f"max_steps must be a positive integer, 'auto', or None for no limit, not {shown(given)}.")
    return min(int(given), sys.maxsize)
