"""Simulation: arguments checked and bound, and handed to an integrator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import (
    Values,
    finite_number,
    flag,
    is_mapping,
    longest_step,
    name_of,
    named,
    named_array,
    numbers,
    one_of,
    positive,
    sample_times,
    time_span,
    tolerance,
)
from fourbar_codegen.discontinuities import jumps
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.integrate import (
    FIXED_STEP,
    METHODS,
    NOT_RATES,
    SOLVERS,
    Event,
    Result,
    consistent,
    integrate,
    most_steps,
)
from fourbar_codegen.progress import Progress
from fourbar_codegen.runtime.evaluator import is_finite
from fourbar_codegen.runtime.integrator import Ode, Stepper, Table
from fourbar_codegen.trajectory import Trajectory

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel

__all__ = [
    "EventLike",
    "InputSource",
    "along",
    "bind",
    "by_name",
    "input_sources",
    "make_stepper",
    "own_source",
    "projects",
    "simulate",
]

Floats = NDArray[np.float64]

GROWN = 1e3
"""The energy of a run has grown beyond reason where it ends with so many times the largest kinetic energy of its first
half, and the range of its potential energy. A constant force makes 4 times that of the first half, a constant power
twice as much; what a load feeds that goes with the motion grows exponentially."""

SAMPLES = 100
"""States along a run that tell it."""

COORDINATES_ALONE = " In index 3 the tolerance holds for the coordinates of a step alone; speeds are less exact."

EventLike = Event | str | Callable[[float, Floats], float]
InputSource = float | tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, str] | Callable[[float, Floats], float]
InterpolationTable = tuple[Floats, Floats] | tuple[Floats, Floats, str]

KINDS = ("linear", "pchip", "cubic")
"""What is laid through a table: lines; the monotone cubics of PCHIP, which do not overshoot; a cubic spline."""


def bind(model: CompiledModel, parameters: Values | None, inputs: Mapping[Any, InputSource] | None) -> Ode:
    """The right-hand side with parameters and inputs bound; see `CompiledModel.ode`."""
    sources = [None] * model.n_r if inputs is None else input_sources(model, inputs)
    missing = [
        entry["name"]
        for entry, source in zip(model.manifest["inputs"], sources, strict=True)
        if entry["expression"] is None and source is None and not entry["order"]
    ]
    if missing:
        raise ModelError(f"No source for input {', '.join(missing)}: give one in inputs=, there is no expression.")
    return Ode(model, parameters, sources)


def along(
    model: CompiledModel, parameters: Values | None, t: Floats, r: Floats, inputs: Mapping[Any, InputSource] | None
) -> tuple[Ode, bool]:
    """The right-hand side with the inputs of a run, and whether one that prescribes a motion is interpolated.

    They come from their sources. Where these are not known, r in columns at times t, they are those of their
    expressions where that gives the same, and interpolated linearly otherwise.
    """
    if inputs is not None:
        return bind(model, parameters, inputs), False
    t, forward = np.unique(t, return_index=True)
    r = r[:, forward]
    expressions = np.reshape([model.default_inputs(time, parameters) for time in t], r.T.shape).T
    sources: list[object] = []
    for values, expected in zip(r, expressions, strict=True):
        if np.array_equal(values, expected):
            sources.append(None)
        else:
            sources.append(float(values[0]) if len(t) == 1 else _linear(t, values))
    entries = model.manifest["inputs"]
    prescribing = {entry["of"] for entry in entries if entry["order"]}
    interpolated = {entry["of"] for entry, source in zip(entries, sources, strict=True) if source is not None}
    return Ode(model, parameters, sources), bool(prescribing & interpolated)


def by_name(model: CompiledModel, inputs: Mapping[Any, Any] | None) -> Mapping[Any, Any]:
    """The inputs' sources, by name."""
    if inputs is not None and not is_mapping(inputs):
        names = ", ".join(entry["name"] for entry in model.manifest["inputs"] if not entry["order"])
        raise ModelError(f"inputs must be a mapping from the inputs' names ({names}), not {shown(inputs)}.")
    return {} if inputs is None else inputs


def input_sources(model: CompiledModel, inputs: Mapping[Any, InputSource] | None) -> list[object]:
    """For each entry of the inputs r None (its expression), a float, a Table or a callable."""
    entries = model.manifest["inputs"]
    names = [entry["name"] for entry in entries if not entry["order"]]
    orders = {name: [entry["order"] for entry in entries if entry["of"] == name] for name in names}
    sources: dict[str, list[object]] = {name: [None] * len(orders[name]) for name in names}
    for name, given in named(by_name(model, inputs), names, "input").items():
        prescribed = len(orders[name]) > 1
        source = own_source(name, given)
        if callable(source):
            if prescribed:
                raise ModelError(
                    f"Input {name} prescribes a motion, so that its rates are needed: give a number or a table (times, "
                    "values) or (times, values, kind), not a callable."
                )
            sources[name] = [source]
        elif isinstance(source, tuple):
            kind = source[2] if len(source) == 3 else "cubic" if prescribed else "linear"
            sources[name] = list(_interpolants(source[0], source[1], kind, len(orders[name])))
        else:
            sources[name] = [source if order == 0 else 0.0 for order in orders[name]]
    return [source for name in names for source in sources[name]]


def own_source(name: str, source: Any) -> float | InterpolationTable | Callable[[float, Floats], float]:
    """The source of an input, checked, with nothing of the caller's in it but a callable."""
    if callable(source):
        return source  # type: ignore[no-any-return]
    if isinstance(source, tuple | list):
        return _table(name, source)
    return finite_number(source, f"input {name}")


def _table(name: str, source: Sequence[Any]) -> InterpolationTable:
    """Times and values of a table, and the kind of interpolation if that is given, checked."""
    what = f"Input {name} must be a number, a table (times, values) or (times, values, kind), or a callable of (t, x)."
    if len(source) not in {2, 3}:
        raise ModelError(f"{what} A table has two arrays of numbers, not {len(source)}.")
    if len(source) == 3 and not (isinstance(source[2], str) and source[2] in KINDS):
        raise ModelError(f"{what} A table's kind is one of {', '.join(KINDS)}, not {shown(source[2])}.")
    times, values = (
        numbers(column, f"{what} A table's {part}").copy()
        for column, part in zip(source[:2], ("times", "values"), strict=True)
    )
    if times.shape != values.shape or times.ndim != 1 or len(times) < 2:
        raise ModelError(
            f"{what} A table has two arrays of the same length, two or more, not of the shapes {times.shape} and "
            f"{values.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise ModelError(f"{what} A table has finite values and strictly increasing times.")
    return (times, values, str(source[2])) if len(source) == 3 else (times, values)


def _linear(times: Floats, values: Floats) -> Table:
    [table] = _interpolants(times, values, "linear", 1)
    return table


def _interpolants(times: Floats, values: Floats, kind: str, orders: int) -> Iterator[Table]:
    """What is laid through a table, and its derivatives; at rest outside.

    Source: F. N. Fritsch, J. Butland, "A method for constructing local monotone piecewise cubic interpolants", *SIAM
    Journal on Scientific and Statistical Computing* 5 (1984), as ``scipy.interpolate.PchipInterpolator`` has it.
    """
    if kind == "linear":
        coefficients = np.array([np.diff(values) / np.diff(times), values[:-1]])
    else:
        from scipy.interpolate import CubicSpline, PchipInterpolator

        coefficients = (CubicSpline if kind == "cubic" else PchipInterpolator)(times, values).c
    before, after = values[0], values[-1]
    for _ in range(orders):
        yield Table(times, coefficients, before, after)
        powers = np.arange(len(coefficients) - 1, 0, -1)
        derivative = coefficients[:-1] * powers[:, np.newaxis]
        coefficients = derivative if len(powers) else np.zeros((1, len(times) - 1))
        before = after = 0.0


def simulate(
    model: CompiledModel,
    t_span: Sequence[float],
    x0: ArrayLike | None,
    *,
    method: str,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    t_eval: ArrayLike | None,
    rtol: float,
    atol: float | ArrayLike,
    events: EventLike | Sequence[EventLike] | None,
    constraints: str,
    stabilization: float,
    dense_output: bool,
    max_step: float,
    max_steps: int | str | None,
    formulation: str | None,
    progress: Callable[[float], object] | bool | None,
) -> Trajectory:
    """Integrate the equations of motion; see `CompiledModel.simulate`."""
    methods = (*METHODS, FIXED_STEP, *SOLVERS)
    one_of(method, methods, "method")
    if not (formulation is None or method == "IDA"):
        raise ModelError(f"A formulation is for IDA; {method} has none.")
    closes = projects(model, constraints, *(() if method in (FIXED_STEP, "IDA") else ("baumgarte",)))
    start, end = time_span(t_span)
    times = None if t_eval is None else sample_times(t_eval, start, end)
    p = model.parameter_vector(parameters)
    if inputs is not None:
        inputs = {key: own_source(name_of(key), source) for key, source in by_name(model, inputs).items()}
    state = _state(model, x0, start, p, inputs)
    ode = bind(model, p, inputs)
    if constraints == "baumgarte":
        ode.stabilization = positive(stabilization, "stabilization")
    _check_start(model, ode, start, state, p, passes=method == FIXED_STEP)
    watched = _events(model, events)
    tolerances = tolerance(rtol, "rtol"), tolerance(atol, "atol", model.n_x)
    max_step = longest_step(max_step)
    if method == FIXED_STEP and max_step == math.inf:
        raise ModelError(f"{FIXED_STEP} takes steps of one length: give it as max_step.")
    dense_output = flag(dense_output, "dense_output")
    limit = most_steps(max_steps, method, (start, end), max_step)
    if not (progress is None or progress is False or callable(progress)):
        raise ModelError(f"progress must be a callable of the time, False or None, not {shown(progress)}.")
    with ExitStack() as stack:
        bars: list[Progress] = []  # made where a run is a long one

        def show(t: float) -> None:
            if not bars:
                bars.append(stack.enter_context(Progress(model.name, unwatched=True)))
            bars[0].stage(f"simulating, t = {t:.6g} of {end:g} s")

        result = integrate(
            model, ode, (start, end), state, method=method, t_eval=times, rtol=tolerances[0], atol=tolerances[1],
            events=watched, project=closes, dense_output=dense_output, max_step=max_step, max_steps=limit,
            options={} if formulation is None else {"formulation": formulation},
            progress=show if progress is None else progress or None,
        )  # fmt: skip
    return Trajectory(
        model=model,
        parameters=p,
        t=result.t,
        y=result.y,
        r=ode.inputs_along(result.t, result.y),
        sol=result.sol,
        t_events=result.t_events,
        y_events=result.y_events,
        nfev=result.nfev,
        njev=result.njev,
        nlu=result.nlu,
        status=result.status,
        success=result.status >= 0,
        message=result.message + _growth(model, ode, result) + (COORDINATES_ALONE if formulation == "index-3" else ""),
        settings={
            "method": method,
            "t_span": (start, end),
            "rtol": float(tolerances[0]),
            "atol": tolerances[1].tolist(),
            "constraints": constraints,
            **({"stabilization": float(stabilization)} if constraints == "baumgarte" else {}),
            **({"max_step": max_step} if max_step < math.inf else {}),
            **({"formulation": formulation} if formulation is not None else {}),
        },
        inputs=inputs or {},
    )


def _growth(model: CompiledModel, ode: Ode, result: Result) -> str:
    """A sentence, if the energy has grown beyond reason; see GROWN."""
    end, _ = result.last

    def energies(t: float, x: Floats) -> tuple[float, float]:
        kinetic, potential = model.energy(t, x, ode.parameters, ode.input_values(t, x)).tolist()
        return kinetic, potential if model.manifest["has_potential_energy"] else 0.0

    n = len(result.t)
    if not n:
        return ""
    first, last = energies(result.t[0], result.y[:, 0]), energies(*result.last)
    if last[0] <= GROWN * first[0]:  # of most runs the ends tell it
        return ""
    samples = np.linspace(0, n - 1, min(n, SAMPLES), dtype=int)
    passed = [(result.t[i], *energies(result.t[i], result.y[:, i])) for i in samples]
    first_half = [kinetic for t, kinetic, _ in passed if abs(t - passed[0][0]) <= abs(end - t)]
    potentials = [last[1], *(potential for *_, potential in passed)]
    if not 0.0 < GROWN * max(*first_half, max(potentials) - min(potentials)) < last[0]:
        return ""
    return f" The energy has grown from {sum(first):.6g} J to {sum(last):.6g} J: loads feed the motion, or errors do."


def make_stepper(
    model: CompiledModel,
    h: float,
    x0: ArrayLike | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    constraints: str,
) -> Stepper:
    """Steps of one length; see `CompiledModel.stepper`."""
    h, t = finite_number(h, "h"), finite_number(t, "t")
    if h == 0.0:
        raise ModelError("The step h must not be 0.")
    closes = projects(model, constraints)
    p = model.parameter_vector(parameters)
    state = _state(model, x0, t, p, inputs)
    ode = bind(model, p, inputs)
    _check_start(model, ode, t, state, p)
    start = consistent(ode, t, state) if closes else state
    boundaries = jumps(ode, t, math.copysign(math.inf, h), start)
    return Stepper(ode, h, t, start, closes, jumps=[(at.end, at.begin) for at in boundaries])


def projects(model: CompiledModel, constraints: str, *more: str) -> bool:
    """Whether states are to be moved onto the constraints."""
    allowed = ("project", *more, "none")
    if not isinstance(constraints, str) or constraints not in allowed:
        raise ModelError(f"constraints must be {' or '.join(map(repr, allowed))}, not {shown(constraints)}.")
    if constraints == "none" or not model.n_c + model.n_h:
        return False
    if not model.manifest["can_project"]:
        raise ModelError(
            f"{NOT_RATES}, so that it is not known how these are violated: take constraints='none', or state them as "
            "rates."
        )
    return constraints == "project"


def _state(
    model: CompiledModel,
    x0: ArrayLike | None,
    t: float,
    p: Floats | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    if x0 is None:
        return model.initial_state(t=t, parameters=p, inputs=inputs)
    return named_array(x0, model.states, {}, "state")


def _events(model: CompiledModel, events: object) -> list[Event] | None:
    if events is None:
        return None
    watched = []
    for event in events if isinstance(events, list | tuple) else [events]:
        if not isinstance(event, Event):
            given: Any = event
            event = Event(given, getattr(given, "terminal", False), getattr(given, "direction", 0.0))
        if not callable(event.function):
            name = name_of(event.function)
            if name not in model.outputs:
                known = ", ".join(model.outputs) or "none"
                raise ModelError(
                    f"events must be callables of (t, x) or names of outputs ({known}), not {shown(event.function)}."
                )
            event = replace(event, function=name)
        watched.append(event)
    return watched


def _check_start(
    model: CompiledModel, ode: Ode, t: float, state: Floats, p: Floats | None, *, passes: bool = False
) -> None:
    """Raise where the first evaluation would fail: an integrator could not even choose a first step.

    What passes singular positions may begin at one.
    """
    if is_finite(state) and is_finite(ode(t, state)):
        return
    r = ode.input_values(t, state)
    if not (passes and all(map(is_finite, model.dynamics(t, state, p, r)))):
        model.rhs(t, state, p, r)
