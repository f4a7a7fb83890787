"""Runs with any method: samples, events, discontinuities, dense output, and the final message."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import SimulationError
from fourbar_codegen.kernel.consistency import consistent, left
from fourbar_codegen.kernel.inputs import bind
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import Directions, locked_parameters, with_probes
from fourbar_codegen.results.gradient import EventSensitivity, KeptSteps, output_sensitivity
from fourbar_codegen.results.trajectory import Trajectory, make_trajectory
from fourbar_codegen.roles import StopReason
from fourbar_codegen.runtime.integrator import Ode, Run
from fourbar_codegen.simulation.discontinuities import Pieces, discontinuities, snapped
from fourbar_codegen.simulation.events import Watch
from fourbar_codegen.simulation.options import FIXED_STEP, SOLVERS, RunOptions
from fourbar_codegen.simulation.run_protocol import Integration
from fourbar_codegen.simulation.singularity import Singular

__all__ = ["REACHED_END", "integrate"]

Floats = NDArray[np.float64]

# An attribute of an enumeration takes as long as ten comparisons in the loop below.
END, PAUSED, FULL, EVENT = StopReason.END, StopReason.PAUSED, StopReason.FULL, StopReason.EVENT
COLLAPSED, DIVERGED = StopReason.COLLAPSED, StopReason.DIVERGED

PAUSE_SECONDS = 0.02
"""Seconds after which a run in C returns to Python, for keyboard interrupts and progress."""

REACHED_END = "The solver successfully reached the end of the integration interval."
TERMINATED = "A termination event occurred."
ZERO_AT_START = (
    " Its function, {}, is zero at the start, t = {:.9g}, which counts as an event, so that the run ends at once. To "
    "go on to the next one, count it with terminal=2, or take changes of the other direction only, or begin elsewhere."
)
NOT_SOLVED = (
    "The equations of a step could not be solved: use a shorter max_step, such as {:.1e}. If the motion passes no "
    'singular position, method="DOP853" selects its step size itself.'
)
FAILED = {
    StopReason.TOO_SMALL: "Required step size is less than spacing between numbers. Is an input or a load "
    "discontinuous there? Jumps of tables and of the model's expressions are found, those of callables are not: end "
    "the run there with a terminal event and start a new one, or hold the inputs over each step with "
    "CompiledModel.stepper.",
    StopReason.INFINITE: "The step size is not finite: give a finite end, or max_step.",
    StopReason.OPEN: "After a step the constraint violation is too large to be corrected: use smaller tolerances.",
}
NOT_FINITE = (
    " Sensitivities are not finite from t = {:.9g} on: they have outgrown the range of numbers, as in long chaotic "
    "motions, or the equations cannot be differentiated there."
)

UNKNOWN_JUMP = (
    "With another value of {} the speeds would jump by an expression of time in the model, which has no derivatives: "
    "prescribe the motion by an input."
)
NO_DERIVATIVE = " The motion has no derivative there, and ALI3P no sensitivities."
COORDINATES_ALONE = " In index 3 the tolerance applies to the coordinates only; the speeds are less accurate."

ROUNDED = 1e-9
"""An event in this fraction of the first step is at the start: its function differs from zero by rounding errors."""

ALL_TIME = (0.0, -math.inf, math.inf)
"""The clock of a right-hand side of absolute times, without discontinuities at which inputs are held."""

GROWN = 1e3
"""The energy of a run has grown suspiciously if the final kinetic energy exceeds this many times both the largest
kinetic energy of the first half and the range of the potential energy. With a constant force the factor is 4, with a
constant power 2; energy that loads supply in proportion to the motion grows exponentially."""

VISIBLE = 1e-5
"""Smallest growth to tell of, relative to the energy: kinetic energy from rest may be no more than rounding errors."""

SAMPLES = 100
"""Number of states of a run at which energies are compared."""


def integrate(
    model: Kernel,
    ode: Ode,
    x0: Floats,
    options: RunOptions,
    progress: Callable[[float], object] | None,
    directions: Directions | None = None,
) -> Trajectory:
    """Integrate from one time to another.

    Parameters
    ----------
    model : Kernel
    ode : Ode
        The right-hand side; for exclusive use during the run.
    x0 : ndarray, shape (n_x,)
    options : RunOptions
    progress : callable of the time, or None
    directions : Directions, optional
        Of sensitivities, at the beginning.

    Returns
    -------
    Trajectory
    """
    span, method, max_steps, t_eval = options.t_span, options.method, options.max_steps, options.t_eval
    watch = Watch(model, options.events, differentiates=directions is not None) if options.events else None
    # ALI3P satisfies the position constraints by itself, with or without projection.
    closes = options.project or method == FIXED_STEP
    start = consistent(ode, span[0], x0) if closes else x0
    (t_begin, t_bound), max_step, rtol, atol = span, options.max_step, options.rtol, options.atol
    outputs = watch.outputs if watch else ()
    later = discontinuities(ode, *span, varied=options.gradient or directions is not None)
    if t_eval is not None and later:
        t_eval = snapped(t_eval, later)
    run: Integration
    if method in SOLVERS:
        from fourbar_codegen.simulation.solver_run import SolverRun

        more = {} if options.formulation is None else {"formulation": options.formulation}
        places = [place for place, _ in outputs]
        run = SolverRun(
            model, ode, method, t_begin, start, t_bound, max_step, rtol, atol, options.project, t_eval, places, more
        )
    else:
        look = options.dense_output or (watch is not None and bool(watch.callables))
        run = Run(ode, method, t_begin, start, t_bound, max_step, rtol, atol, options.project, t_eval, outputs, look)
        varied = directions
        if options.gradient:
            run.keep_steps()
            locked = locked_parameters(model, [(t_begin, start)], options.parameters, options.inputs)
            varied = with_probes(model, directions, options.parameters, options.inputs, locked)
        if varied is not None:
            run.differentiate_along(varied)
    run.begin()
    if watch:
        watch.begin(run)
    others = _other_values(model, options, directions) if later else {}
    pieces = Pieces(ode, span, later, others) if later else None
    if pieces:
        pieces.begin(run)
    dense: Any = run.dense_output() if options.dense_output else None  # stores steps of this kind of run
    samples: list[tuple[Floats, Floats]] = []
    outcome: tuple[int, str] | None = None
    looks, singular = Singular(model), ""
    steps, noted = 16, time.perf_counter()
    while outcome is None:
        begin = time.perf_counter()
        reason = run.on(steps if max_steps is None else min(steps, max_steps - run.n_steps))
        now = time.perf_counter()
        if progress is not None and now - noted >= PAUSE_SECONDS:
            progress(run.t)
            noted = now
        if reason is EVENT:
            if run.toggled:
                samples.append(run.take_samples())
                singular = looks.within_step(run, samples)
                if singular:
                    run.discard()
                    outcome = -1, singular
                    break
            if dense is not None:
                dense.add(run)
            end = watch.look(run) if watch else None
            if end is not None:
                run.stop_within(end)
                outcome = 1, TERMINATED + _at_start(watch.ended_by if watch else "", run, end, t_begin)
        elif reason is FULL:
            samples.append(run.take_samples())
        elif reason is PAUSED:
            steps = round(min(max(steps * PAUSE_SECONDS / (now - begin), 1), 4 * steps))
            if run.n_steps == max_steps:
                outcome = -1, f"max_steps = {max_steps} is reached; None is no limit."
        elif reason is END:
            if not (pieces and pieces.ahead):
                outcome = 0, REACHED_END
                continue
            samples.append(run.take_samples())
            if watch is not None:
                watch.leave(run)
            try:
                closed = pieces.go_on(run)
            except SimulationError as error:
                outcome = -1, str(error)
            else:
                ends = watch is not None and watch.across(run)
                if ends:
                    run.stop_within(1.0)
                outcome = (1, TERMINATED) if ends else None if closed else (-1, FAILED[StopReason.OPEN])
                unknown = pieces.unknown.intersection(directions.names if directions else ())
                if unknown:
                    outcome = -1, UNKNOWN_JUMP.format(", ".join(sorted(unknown)))
        elif reason is DIVERGED:
            outcome = -1, run.ode.failure or NOT_SOLVED.format(options.max_step / 10.0)
        else:
            samples.append(run.take_samples())
            differentiates = options.gradient or directions is not None
            singular = looks.here(run, samples, collapsed=reason is COLLAPSED, varied=differentiates)
            if singular or reason is not COLLAPSED:
                outcome = -1, singular or run.ode.failure or _failure(reason)
    status, message = outcome
    while run.on(0) is FULL:
        samples.append(run.take_samples())
    samples.append(run.take_samples())
    ode.clock = ALL_TIME  # from here on, its times are absolute
    if status < 0:
        message = f"The integration stopped at t = {run.t:.9g}: {message}"
        if singular and (directions is not None or options.gradient):
            message += NO_DERIVATIVE
    t, y = samples[0] if len(samples) == 1 else map(np.concatenate, zip(*samples, strict=True))
    y = y.T
    if dense is not None and t_eval is None and t.size > 1 and t[-1] == t[-2]:
        t, y = t[:-1], y[:, :-1]  # an event at the start of a step, which SciPy omits as well if there is `sol`
    input_times = pieces.input_times(t) if pieces else t
    n_eval = t.size
    if t_eval is not None and options.t_eval is not None:
        if n_eval and (n_eval > t_eval.size or t[-1] != t_eval[n_eval - 1]):
            n_eval -= 1  # the last sample is at a terminal event
        t = np.append(options.t_eval[:n_eval], t[n_eval:])
    if options.project and model.layout.constraints.are_stated and status >= 0:
        sentence = left(model, ode, input_times, y, options.parameters)
        status, message = (-1, sentence) if sentence else (status, message)
    if not singular:  # near singular positions speeds grow for that reason
        message += _growth(ode, input_times, y, run, by_steps=t_eval is None)
    sensitivity = None
    if directions is not None and isinstance(run, Run):
        derivatives = run.sensitivities[: directions.matrix.shape[1], :, : t.size]
        sensitivity = directions.by_name(derivatives)
        if t.size and status >= 0 and not np.isfinite(derivatives[..., -1]).all():  # they do not become finite again
            message += NOT_FINITE.format(t[np.flatnonzero(~np.isfinite(derivatives).all(axis=(0, 1)))[0]])
    return make_trajectory(
        model=model,
        parameters=options.parameters,
        t=t,
        y=y,
        r=ode.inputs_along(input_times, y),
        sol=dense or None,  # None if there are no steps
        t_events=None if options.events is None else [np.array(times) for times in watch.times] if watch else [],
        y_events=None if options.events is None else [np.array(states) for states in watch.states] if watch else [],
        nfev=run.n_evaluations,
        njev=run.n_jacobians,
        nlu=run.n_factorizations,
        status=status,
        success=status >= 0,
        message=message + COORDINATES_ALONE if options.formulation == "index-3" else message,
        settings=options.settings(),
        inputs=options.inputs or {},
        event_sensitivity=_of_events(model, ode, watch, directions, options)
        if watch and directions is not None
        else None,
        sensitivity=sensitivity,
        directions=directions,
        steps=KeptSteps(
            model=model,
            steps=run.steps_kept(input_times[:n_eval]),
            t=t_begin,
            n_t=n_eval,
            parameters=options.parameters,
            inputs=options.inputs or {},
            starts_from_x0=options.x0 is not None,
            dx0=options.dx0,
            unknown=frozenset(pieces.unknown if pieces else ()),
        )
        if options.gradient and isinstance(run, Run)
        else None,
    )


def _other_values(model: Kernel, options: RunOptions, directions: Directions | None) -> dict[str, Ode]:
    """For each parameter of derivatives of a model with jumps, the right-hand side with another value of it."""
    if not model.layout.breakpoints.n_motion_breakpoints:
        return {}
    p = parameter_array(model, options.parameters)
    names = model.parameters if options.gradient else directions.names if directions else ()
    found = {}
    for name in names:
        if name in model.parameters:
            place, other = model.parameters.index(name), p.copy()
            other[place] += abs(p[place]) or 1.0
            found[name] = bind(model, other, options.inputs)
    return found


def _at_start(function: str, run: Integration, share: float, begin: float) -> str:
    """A sentence if the terminal event in the last step is at the start of the run, otherwise an empty text."""
    return ZERO_AT_START.format(function, begin) if run.n_steps == 1 and share <= ROUNDED else ""


def _of_events(
    model: Kernel, ode: Ode, watch: Watch, directions: Directions, options: RunOptions
) -> list[dict[str, EventSensitivity]]:
    """The derivatives of times and states of events, by names.

    An event function g(t, x, p) = 0 holds: dt/dp = -(g_x S + g_p) / (dg/dt along the motion), and the state at that
    time changes by S + x' dt/dp.
    """
    n, p, inputs = directions.matrix.shape[1], options.parameters, options.inputs or {}
    found = []
    for place, event in enumerate(watch.events):
        times, states = watch.times[place], watch.states[place]
        of_times, of_states = np.zeros((n, len(times))), np.zeros((n, model.n_x, len(times)))
        row = model.outputs.index(str(event.function))
        for i, (t, x, (s, slope, rates)) in enumerate(zip(times, states, watch.derivatives[place], strict=True)):
            r, at = ode.input_values(t, x)[:, np.newaxis], np.array([t])
            by = s.T[:n]  # without probes
            changes = output_sensitivity(
                model,
                at,
                x[:, np.newaxis],
                r,
                parameters=p,
                inputs=inputs,
                directions=directions,
                sensitivity=by[..., np.newaxis],
            )
            of_times[:, i] = -changes[:, row, 0] / (slope or math.nan)  # 0 for an output that is constantly zero
            of_states[..., i] = by + np.outer(of_times[:, i], rates)
        by_names = zip(directions.by_name(of_times).items(), directions.by_name(of_states).values(), strict=True)
        found.append({name: EventSensitivity(of_time, of_state) for (name, of_time), of_state in by_names})
    return found


def _failure(reason: StopReason | str) -> str:
    """What is wrong where a run cannot go on: a sentence, or the message of a solver that is not ours."""
    return FAILED[reason] if isinstance(reason, StopReason) else reason


def _growth(ode: Ode, t: Floats, y: Floats, run: Integration, *, by_steps: bool) -> str:
    """A warning if the energy has grown suspiciously, or an empty text; see GROWN."""
    n, end = len(t), run.t
    kinetic, potential = reached = ode.energies(end, run.x)
    largest, low, high = 0.0, potential, potential  # NaN if unknown
    for i in range(0, n, n // SAMPLES + 1):
        found = ode.energies(t[i], y[:, i])
        if found[0] > largest and abs(t[i] - t[0]) <= abs(end - t[i]):
            largest = found[0]
        if found[1] < low:
            low = found[1]
        elif found[1] > high:
            high = found[1]
        if kinetic <= GROWN * largest or kinetic <= GROWN * (high - low):
            return ""  # for most runs at the first state
    if by_steps and n > 1:  # from rest, steps may grow to half of the run
        half = (t[0] + end) / 2.0
        there = [np.interp(abs(half - t[0]), np.abs(t - t[0]), row) for row in y]
        if kinetic <= GROWN * ode.energies(half, np.array(there))[0]:
            return ""
    if not (n and max(largest, high - low) > 0.0 and not np.isnan(kinetic)):
        return ""
    before, after = map(np.nansum, (ode.energies(t[0], y[:, 0]), reached))
    if not after - before > VISIBLE * abs(before):
        return ""
    return f" The energy has grown from {before:.6g} J to {after:.6g} J, because of loads or of integration errors."
