"""Runs with any method: samples, events, discontinuities, dense output, and the final message."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import SimulationError
from fourbar_codegen.kernel.consistency import consistent, left
from fourbar_codegen.kernel.discontinuities import Pieces, discontinuities, snapped
from fourbar_codegen.kernel.inputs import bind
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import Directions, locked_parameters, with_probes
from fourbar_codegen.results.gradient import EventSensitivity, KeptSteps, output_sensitivity
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import STIFF, StopReason, Watched
from fourbar_codegen.runtime.integrator import Ode, Run
from fourbar_codegen.simulation.events import Watch, watched_quantity
from fourbar_codegen.simulation.methods import FIXED_STEP, SOLVERS
from fourbar_codegen.simulation.run_options import RunOptions, RunStart
from fourbar_codegen.simulation.singularity import singular_message

if TYPE_CHECKING:
    from fourbar_codegen.simulation.foreign import ForeignMethod

__all__ = ["REACHED_END", "TERMINATED", "integrate"]

Floats = NDArray[np.float64]

# An attribute of an enumeration takes as long as ten comparisons in the loop below.
END, PAUSED, FULL, EVENT = StopReason.END, StopReason.PAUSED, StopReason.FULL, StopReason.EVENT

PAUSE_SECONDS = 0.02
"""Seconds after which a run in C returns to Python, for keyboard interrupts and progress."""

REACHED_END = "The solver successfully reached the end of the integration interval."
TERMINATED = "A termination event occurred."
NOT_SOLVED = (
    "The equations of a step could not be solved: use a shorter step, such as {:.1e}. If the motion passes no "
    'singular position, method="DOP853" selects its step size itself.'
)
CHATTERING = (
    "The equations jump at {}, and lead the motion back to the jump from both sides, as dry friction does where it "
    "sticks (the condition is {:.1e} there): the run would go on in ever more steps. Make the force continuous, for "
    "instance by tanh(v/v_0) with a small speed v_0 instead of sign(v), or end the run by a terminal event and go on "
    "with a model that sticks."
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
STIFF_EQUATIONS = (
    " The equations are stiff: stability limits the steps of {}, not the tolerances. {} takes longer ones."
)
COORDINATES_ALONE = " In index 3 the tolerance applies to the coordinates only; the speeds are less accurate."

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
    start: RunStart,
    *,
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
    start : RunStart
    progress : callable of the time, or None
    directions : Directions, optional
        Of sensitivities, at the beginning.

    Returns
    -------
    Trajectory
    """
    integration = _Integration(model, ode, x0, options, start, directions)
    integration.go(progress)
    return integration.trajectory()


class _Integration:
    """A run of the driver in C, and what the reasons mean for which it stops.

    Attributes
    ----------
    status : int or None
        As of `Trajectory`; None while the run goes on.
    message : str
    singular : str
        The message of a singular position, or an empty text.
    """

    __slots__ = (
        "dense", "differentiates", "directions", "examined", "foreign", "message", "model", "ode", "options",
        "pieces", "run", "samples", "singular", "start", "status", "t_eval", "watch",
    )  # fmt: skip

    def __init__(
        self, model: Kernel, ode: Ode, x0: Floats, options: RunOptions, start: RunStart, directions: Directions | None
    ) -> None:
        self.model, self.ode, self.options, self.start, self.directions = model, ode, options, start, directions
        self.differentiates = options.gradient or directions is not None
        self.status: int | None = None
        self.message = self.singular = ""
        self.examined = 0
        self.samples: list[tuple[Floats, Floats]] = []
        self.watch = Watch(model, options.events, differentiates=directions is not None) if options.events else None
        later = discontinuities(ode, *options.t_span, varied=self.differentiates)
        self.t_eval = options.t_eval
        if self.t_eval is not None and later:
            self.t_eval = snapped(self.t_eval, later)
        self.foreign = self._foreign_method() if options.method in SOLVERS else None
        self.run = run = self._make_run(x0)
        run.begin()
        others = _other_values(model, options.gradient, start, directions) if later else {}
        self.pieces = Pieces(ode, options.t_span, later, others) if later else None
        if self.pieces:
            self.pieces.begin(run)
        self.dense: Any = run.dense_output() if options.dense_output else None

    def _foreign_method(self) -> ForeignMethod:
        from fourbar_codegen.simulation.foreign import ForeignMethod

        options = self.options
        self.ode.projects, self.ode.in_pieces = options.project, True
        given: dict[str, Any] = {"rtol": options.rtol, "atol": options.atol, "max_step": options.max_step}
        if options.formulation is not None:
            given["formulation"] = options.formulation
        return ForeignMethod(self.ode, options.method, given)

    def _make_run(self, x0: Floats) -> Run:
        options, start, watch = self.options, self.start, self.watch
        begin, end = options.t_span
        # ALI3P satisfies the position constraints by itself, with or without projection.
        closes = options.project or options.method == FIXED_STEP
        run = Run(
            self.ode,
            self.foreign or options.method,
            begin,
            consistent(self.ode, begin, x0) if closes else x0,
            end,
            options.max_step,
            options.rtol,
            options.atol,
            options.project,
            self.t_eval,
            watch.rows if watch else (),
            options.dense_output,
        )
        varied = self.directions
        if options.gradient:
            run.keep_steps()
            locked = locked_parameters(self.model, [(begin, run.x)], start.parameters, start.inputs)
            varied = with_probes(self.model, varied, start.parameters, start.inputs, locked)
        if varied is not None:
            run.differentiate_along(varied)
        return run

    def go(self, progress: Callable[[float], object] | None) -> None:
        """Run to the end, or to where it stops."""
        run, max_steps = self.run, self.options.max_steps
        n_steps, noted = 16, time.perf_counter()
        while self.status is None:
            begin = time.perf_counter()
            reason = run.on(n_steps if max_steps is None else min(n_steps, max_steps - run.n_steps))
            now = time.perf_counter()
            if progress is not None and now - noted >= PAUSE_SECONDS:
                progress(run.t)
                noted = now
            if reason is PAUSED:
                n_steps = round(min(max(n_steps * PAUSE_SECONDS / (now - begin), 1), 4 * n_steps))
                if run.n_steps == max_steps:
                    self.status, self.message = -1, f"max_steps = {max_steps} is reached; None is no limit."
            elif reason is EVENT:
                self._examine()
            elif reason is FULL:
                self._make_room()
            elif reason is END:
                self._end_piece()
            else:
                self._fail(reason)
        while run.on(0) is FULL:
            self._make_room()
        self._make_room()

    def _make_room(self) -> None:
        self.samples.append(self.run.take_samples())

    def _examine(self) -> None:
        """The last step has events; the dense output has it too."""
        run = self.run
        is_new, self.examined = run.n_steps != self.examined, run.n_steps  # or what is left of the events in a step
        if is_new and self.dense is not None:
            self.dense.add(run)
        end = self.watch.look(run) if self.watch else None
        if end is not None:
            run.stop_within(end)
            self.status, self.message = 1, TERMINATED

    def _end_piece(self) -> None:
        """The end of the run, or a discontinuity."""
        run, pieces = self.run, self.pieces
        if not (pieces and pieces.ahead):
            self.status, self.message = 0, REACHED_END
            return
        self._make_room()
        try:
            closed = pieces.go_on(run)
        except SimulationError as error:
            self.status, self.message = -1, str(error)
            return
        if not closed:
            self.status, self.message = -1, FAILED[StopReason.OPEN]
        unknown = pieces.unknown.intersection(self.directions.names if self.directions else ())
        if unknown:
            self.status, self.message = -1, UNKNOWN_JUMP.format(", ".join(sorted(unknown)))

    def _fail(self, reason: StopReason) -> None:
        """The next step cannot be taken, passes a singular position, or steps have collapsed."""
        run = self.run
        if reason is StopReason.DIVERGED:
            self.status, self.message = -1, run.ode.failure or NOT_SOLVED.format(self.options.max_step / 10.0)
            return
        if reason is StopReason.SINGULAR:
            if self.watch:
                self.watch.forget(run, self.options.t_span[1] - self.options.t_span[0])
            self.status, self.singular = -1, singular_message(self.model, run)
            self.message = self.singular
        elif reason is StopReason.CHATTERING:
            number, value = run.jump
            condition = self.model.layout.breakpoints.conditions[number]
            self.status, self.message = -1, CHATTERING.format(condition, value)
        elif reason is not StopReason.COLLAPSED:
            own = self.foreign.message if self.foreign and reason is StopReason.FAILED else FAILED.get(reason, "")
            self.status, self.message = -1, run.ode.failure or own

    def trajectory(self) -> Trajectory:
        """The run as a result."""
        run, options, start, directions = self.run, self.options, self.start, self.directions
        ode, watch = self.ode, self.watch
        t, y, input_times, n_eval = self._sampled()
        ode.clock = ALL_TIME  # from here on, its times are absolute
        status, message = self._final(y, input_times)
        sensitivity = None
        if directions is not None:
            derivatives = run.sensitivities[: directions.matrix.shape[1], :, : t.size]
            sensitivity = directions.by_name(derivatives)
            # Once they are not finite, they do not become finite again.
            if t.size and status >= 0 and not np.isfinite(derivatives[..., -1]).all():
                message += NOT_FINITE.format(t[np.flatnonzero(~np.isfinite(derivatives).all(axis=(0, 1)))[0]])
        return Trajectory(
            kernel=self.model,
            parameters=start.parameters,
            t=t,
            y=y,
            r=ode.inputs_along(input_times, y),
            sol=self.dense or None,  # None if there are no steps
            t_events=None if options.events is None else [np.array(times) for times in watch.times] if watch else [],
            y_events=None if options.events is None else watch.state_arrays() if watch else [],
            nfev=run.n_evaluations,
            njev=run.n_jacobians,
            nlu=run.n_factorizations,
            status=status,
            message=message + COORDINATES_ALONE if options.formulation == "index-3" else message,
            settings=options.settings(start.inputs),
            inputs=start.inputs or {},
            event_sensitivity=_of_events(self.model, ode, watch, directions, start)
            if watch and directions is not None
            else None,
            sensitivity=sensitivity,
            directions=directions,
            steps=self._kept_steps(input_times[:n_eval]) if options.gradient else None,
        )

    def _sampled(self) -> tuple[Floats, Floats, Floats, int]:
        """Times and states of the samples, times of their inputs, and the number of those that were asked for."""
        samples, asked = self.samples, self.options.t_eval
        t, y = samples[0] if len(samples) == 1 else map(np.concatenate, zip(*samples, strict=True))
        y = y.T
        input_times = self.pieces.input_times(t) if self.pieces else t
        n = t.size
        if asked is not None and self.t_eval is not None:
            if self.status == 1 and n and (n > self.t_eval.size or t[-1] != self.t_eval[n - 1]):
                n -= 1  # the last one is at a terminal event
                t = np.append(asked[:n], t[n])
            else:
                t = asked[:n]
        return t, y, input_times, n

    def _final(self, y: Floats, input_times: Floats) -> tuple[int, str]:
        """Status and message."""
        options, model, message = self.options, self.model, self.message
        status = self.status or 0
        if status < 0:
            message = f"The integration stopped at t = {self.run.t:.9g}: {message}"
            if self.singular and self.differentiates:
                message += NO_DERIVATIVE
        if options.project and model.layout.constraints.are_stated and status >= 0:
            sentence = left(model, self.ode, input_times, y, self.start.parameters)
            status, message = (-1, sentence) if sentence else (status, message)
        end = (self.run.t, self.run.x) if self.status != 1 else (float(input_times[-1]), y[:, -1])
        message += self.watch.touched(self.run, options.t_span[0], end[0]) if self.watch else ""
        if self.run.is_stiff and not self.differentiates:  # Radau has no derivatives
            message += STIFF_EQUATIONS.format(options.method, f'method="{STIFF}"')
        if not self.singular:  # near singular positions speeds grow for that reason
            message += _growth(self.ode, input_times, y, end, by_steps=self.t_eval is None)
        return status, message

    def _kept_steps(self, times: Floats) -> KeptSteps:
        options, start = self.options, self.start
        return KeptSteps(
            model=self.model,
            steps=self.run.steps_kept(times),
            t=options.t_span[0],
            n_t=times.size,
            parameters=start.parameters,
            inputs=start.inputs or {},
            starts_from_x0=start.x0 is not None,
            dx0=start.dx0,
            unknown=frozenset(self.pieces.unknown if self.pieces else ()),
        )


def _other_values(model: Kernel, gradient: bool, start: RunStart, directions: Directions | None) -> dict[str, Ode]:
    """For each parameter of derivatives of a model with jumps, the right-hand side with another value of it."""
    if not model.layout.breakpoints.n_motion_breakpoints:
        return {}
    p = parameter_array(model, start.parameters)
    names = model.parameters if gradient else directions.names if directions else ()
    found = {}
    for name in names:
        if name in model.parameters:
            place, other = model.parameters.index(name), p.copy()
            other[place] += abs(p[place]) or 1.0
            found[name] = bind(model, other, start.inputs)
    return found


def _of_events(
    model: Kernel, ode: Ode, watch: Watch, directions: Directions, start: RunStart
) -> list[dict[str, EventSensitivity]]:
    """The derivatives of times and states of events, by names.

    An event function g(t, x, p) = 0 holds: dt/dp = -(g_x S + g_p) / (dg/dt along the motion), and the state at that
    time changes by S + x' dt/dp.
    """
    n, p, inputs = directions.matrix.shape[1], start.parameters, start.inputs or {}
    found = []
    for place, event in enumerate(watch.events):
        times, states = watch.times[place], watch.states[place]
        of_times, of_states = np.zeros((n, len(times))), np.zeros((n, model.n_x, len(times)))
        quantity, row = watched_quantity(model, str(event.function))
        for i, (t, x, (s, slope, rates)) in enumerate(zip(times, states, watch.derivatives[place], strict=True)):
            r, at = ode.input_values(t, x)[:, np.newaxis], np.array([t])
            by = s.T[:n]  # without probes
            if quantity is Watched.OUTPUT:
                changes = output_sensitivity(
                    model,
                    at,
                    x[:, np.newaxis],
                    r,
                    parameters=p,
                    inputs=inputs,
                    directions=directions,
                    sensitivity=by[..., np.newaxis],
                )[:, row, 0]
            else:
                changes = by[:, row]
            of_times[:, i] = -changes / (slope or math.nan)  # 0 at a multiple root
            of_states[..., i] = by + np.outer(of_times[:, i], rates)
        by_names = zip(directions.by_name(of_times).items(), directions.by_name(of_states).values(), strict=True)
        found.append({name: EventSensitivity(of_time, of_state) for (name, of_time), of_state in by_names})
    return found


def _growth(ode: Ode, t: Floats, y: Floats, final: tuple[float, Floats], *, by_steps: bool) -> str:
    """A warning if the energy has grown suspiciously up to the final time and state, or an empty text; see GROWN."""
    n, end = len(t), final[0]
    kinetic, potential = reached = ode.energies(*final)
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
