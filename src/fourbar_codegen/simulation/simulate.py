"""Simulation: makes a right-hand side of the options and passes it to an integrator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state
from fourbar_codegen.arguments import Values, finite_number, name_of, named_array, one_of
from fourbar_codegen.errors import ModelError, ModelWarning
from fourbar_codegen.kernel.consistency import check_start, consistent, projects
from fourbar_codegen.kernel.inputs import InputSource, bind
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import (
    Directions,
    directions_of,
    implicit_derivatives,
    locked_parameters,
    require_derivatives,
    require_fixed_breakpoints,
)
from fourbar_codegen.layout import StateJump
from fourbar_codegen.progress import QUIET_SECONDS, Progress
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.roles import STIFF
from fourbar_codegen.runtime.integrator import Stepper
from fourbar_codegen.simulation.discontinuities import boundaries, jumping_inputs
from fourbar_codegen.simulation.events import EventLike, event_rows, events_of
from fourbar_codegen.simulation.integrate import integrate
from fourbar_codegen.simulation.options import FIXED_STEP, RunOptions

__all__ = ["make_stepper", "simulate"]

Floats = NDArray[np.float64]

STEPS = ("RK4", STIFF)
"""Methods of steppers."""


def simulate(model: Kernel, options: RunOptions, directions: Directions | None = None) -> Trajectory:
    """Integrate the equations of motion; see `CompiledModel.simulate`.

    Directions are those of the sensitivities at the beginning, if they are known.
    """
    if options.method == FIXED_STEP and model.n_l > model.n_c:
        names = ", ".join(model.outputs[: model.n_l - model.n_c])
        raise ModelError(
            f"{FIXED_STEP} does not support unknown forces that drive the motion ({names}): all other methods do."
        )
    (start, end), p, inputs, report = options.t_span, options.parameters, options.inputs, options.progress
    state = initial_state(model, t=start, parameters=p, inputs=inputs) if options.x0 is None else options.x0
    ode = bind(model, p, inputs)
    if options.stabilization is not None:
        ode.stabilization = options.stabilization
    check_start(model, ode, start, state, p, passes=options.method == FIXED_STEP)
    if options.sensitivities or options.gradient:
        _check_differentiable(model, options)
    if options.sensitivities and directions is None:
        directions = _directions(model, options, state)
    if report is not None:
        run = integrate(model, ode, state, options, report or None, directions)
    else:
        with Progress(model.name, unwatched=QUIET_SECONDS) as progress:

            def told(t: float) -> None:
                progress.stage(f"simulating, t = {t:.6g} of {end:g} s")

            run = integrate(model, ode, state, options, told, directions)
    if directions is not None:
        states = [(start, state), *zip(run.t[-1:].tolist(), run.y[:, -1:].T, strict=True)]
        locked = locked_parameters(model, states, p, inputs)
        require_derivatives([name for name in directions.names if name in locked])
    return run


def _check_differentiable(model: Kernel, options: RunOptions) -> None:
    jumps = _state_jumps(model, options) if model.layout.breakpoints.state_jumps else []
    for sentence, is_known in (
        ("jump at times that are not known beforehand ({})", True),
        ("may jump ({}): where they might, they have no real value at any of the random states that were tried", False),
    ):
        functions = "; ".join(entry.function for entry in jumps if entry.known is is_known)
        if functions:
            warnings.warn(
                f"The equations of {model.name} {sentence.format(functions)}. If the run passes a jump, its "
                "derivatives leave out the change of the time of the jump: make forces continuous, for instance by "
                "tanh instead of sign.",
                ModelWarning,
                stacklevel=4,
            )
    known = (*model.states, *model.outputs)
    if options.sensitivities and not all(event.function in known for event in options.events or ()):
        raise ModelError(
            "Times of events have derivatives if these are of states or outputs: make the function an output of the "
            "model."
        )
    for key, source in (options.inputs or {}).items():
        if callable(source):
            raise ModelError(f"Input {name_of(key)} is a callable, whose derivatives are not known: use a table.")


def _state_jumps(model: Kernel, options: RunOptions) -> list[StateJump]:
    """The jumps that count with these parameters and inputs."""
    given = {name_of(key) for key in options.inputs or ()}
    p, defaults = options.parameters, parameter_array(model, None)
    has_others = p is not None and not np.array_equal(p, defaults, equal_nan=True)
    return [
        entry
        for entry in model.layout.breakpoints.state_jumps
        if entry.input not in given and (entry.by_default or has_others)
    ]


def _directions(model: Kernel, options: RunOptions, state: Floats) -> Directions:
    """The directions of sensitivities at the beginning."""
    found = directions_of(model, options.sensitivities, options.inputs)
    require_fixed_breakpoints(model, options.parameters, [n for n in found.names if n in model.parameters])
    # Parameters and inputs do not move a given initial state, except onto the constraints.
    held = np.zeros(found.matrix.shape[1], dtype=bool)
    if options.x0 is not None:
        held[:] = ~found.matrix[: model.n_x].any(axis=0)
    for name in options.dx0:
        held[found.places[name]] = True
    matrix = found.matrix.copy()
    if not held.all():
        matrix[:, ~held] = implicit_derivatives(
            model, options.t_span[0], state, found, options.parameters, options.inputs
        )[:, ~held]
    for name, derivative in options.dx0.items():
        matrix[: model.n_x, found.places[name]] = derivative.T
    return Directions(found.places, matrix, found.sources)


def make_stepper(
    model: Kernel,
    h: float,
    x0: ArrayLike | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    events: EventLike | Sequence[EventLike] | None,
    constraints: str,
    method: str,
) -> Stepper:
    """A stepper with a fixed step size; see `CompiledModel.stepper`."""
    h, t = finite_number(h, "h"), finite_number(t, "t")
    if h == 0.0:
        raise ModelError("The step h must not be 0.")
    one_of(method, STEPS, "method")
    watched = event_rows(model, events_of(model, events) or ())
    closes = projects(model, constraints)
    p = model.parameter_vector(parameters)
    if x0 is None:
        state = initial_state(model, t=t, parameters=p, inputs=inputs)
    else:
        state = named_array(x0, model.states, {}, "state")
    ode = bind(model, p, inputs)
    check_start(model, ode, t, state, p)
    start = consistent(ode, t, state) if closes else state
    jumps, kinks = boundaries(ode, t, math.copysign(math.inf, h), start)
    jumping = [(at.end, at.begin, jumping_inputs(ode, at, start)) for at in jumps]
    breakpoints = np.array([(at.end, at.last, at.first) for at in kinks]).reshape(-1, 3).T
    return Stepper(ode, h, t, start, closes, jumps=jumping, breakpoints=breakpoints, events=watched, method=method)
