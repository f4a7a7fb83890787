"""Runs of all methods: events, samples, dense output, and what there is to say at the end."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import finite_number, is_integer, number
from fourbar_codegen.discontinuities import Pieces
from fourbar_codegen.errors import ModelError, SimulationError, shown
from fourbar_codegen.runtime.evaluator import NOT_CLOSED, OK
from fourbar_codegen.runtime.integrator import Ode, Run

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel
    from fourbar_codegen.solver_run import SolverRun

__all__ = [
    "FIXED_STEP",
    "METHODS",
    "NOT_RATES",
    "REACHED_END",
    "SOLVERS",
    "Event",
    "Result",
    "Singular",
    "consistent",
    "integrate",
    "is_rounded",
    "most_steps",
]

Floats = NDArray[np.float64]

METHODS = ("DOP853", "RK45")
"""Explicit methods with step control, in C."""

FIXED_STEP = "ALI3P"
"""The method that passes singular positions, by steps of one length; see ``fourbar_augmented.h``."""

SOLVERS = ("RK23", "Radau", "BDF", "LSODA", "CVODE", "IDA")
"""Those of `fourbar_codegen.solvers` that are not in C as a whole."""

STEPS = dict.fromkeys((*METHODS, FIXED_STEP), 1_000_000) | dict.fromkeys(SOLVERS, 100_000)
"""The most steps of a run that gives no other number: seconds of computing, for mechanisms of a few bodies; ..."""

MARGIN = 10
"""... or so many times those that max_step asks for, where these are more."""

PAUSE = 0.02
"""Seconds after which a run in C looks up: for an interrupt from the keyboard, and to say how far it is."""

COLLAPSED, PASSED, NEAR = 1e-3, 1e-4, 0.2
"""A position is singular where the smallest singular value of J is below this share of what it usually was in the run:
where the steps' length collapses; within a step over which the constraints have changed their orientation; or is close
where a step fails."""

JUMPED = 1e-3
"""The share of the largest change between neighbouring states of a step that is left when one has looked closer five
times: of what is continuous, a thirty-second remains each time."""

STATES = 100
"""States along the run that tell what it usually was."""

CONSISTENT = 1e-3
"""By what share of the coordinates or speeds projection may move the state that a run begins from."""

FLOOR = 1e-12
"""And by how much in any case: rounding errors, which are no jumps either."""

REACHED_END = "The solver successfully reached the end of the integration interval."
TERMINATED = "A termination event occurred."
DIVERGED = "The equations of a step could not be solved: take a shorter max_step."
FAILED = {
    "too small": "Required step size is less than spacing between numbers.",
    "infinite": "The step's length is not finite: give a finite end, or max_step.",
    "open": "A step has opened the loops too far to be closed again: take smaller tolerances.",
}
NOT_RATES = "The velocity constraints of this model are not the rates of its position constraints, one by one"


@dataclass(frozen=True)
class Event:
    """Something to find the times of: where a function changes its sign.

    Parameters
    ----------
    function : str or callable
        The name of an output, which is evaluated in C; or a function of (t, x).
    terminal : bool or int, optional
        Whether the run ends with it; a number ends it with the event of that number.
    direction : float, optional
        Positive for changes from negative to positive alone, negative for the opposite ones, 0 for both.
    """

    function: str | Callable[[float, Floats], float]
    terminal: bool | int = False
    direction: float = 0.0

    def __post_init__(self) -> None:
        finite_number(self.direction, "an event's direction")
        if not isinstance(self.terminal, int) or self.terminal < 0:
            raise ModelError(
                f"An event's terminal must be True, False or a number of events, not {shown(self.terminal)}."
            )


@dataclass(frozen=True)
class Result:
    """What a run gives; the names are those of ``solve_ivp``."""

    t: Floats
    y: Floats
    sol: Callable[[Any], Floats] | None
    t_events: list[Floats] | None
    y_events: list[Floats] | None
    nfev: int
    njev: int
    nlu: int
    status: int
    message: str
    last: tuple[float, Floats]
    """Time and state that were reached, whatever the times of the samples."""


def integrate(
    model: CompiledModel,
    ode: Ode,
    span: tuple[float, float],
    x0: Floats,
    *,
    method: str,
    t_eval: Floats | None,
    rtol: ArrayLike,
    atol: ArrayLike,
    events: Sequence[Event] | None,
    project: bool,
    dense_output: bool,
    max_step: float,
    max_steps: int | None,
    options: dict[str, Any],
    progress: Callable[[float], object] | None,
) -> Result:
    """Integrate from one time to another.

    Parameters
    ----------
    model : CompiledModel
    ode : Ode
        The right-hand side; nothing else may use it during the run.
    span : (float, float)
    x0 : ndarray, shape (n_x,)
    method : str
        Of METHODS, FIXED_STEP or SOLVERS.
    t_eval : ndarray or None
    rtol, atol : array_like
    events : sequence of Event or None
    project : bool
        Whether states are moved onto the constraints.
    dense_output : bool
    max_step : float
    max_steps : int or None
    options : dict
        More for those of SOLVERS.
    progress : callable of the time, or None

    Returns
    -------
    Result
    """
    watch = _Watch(model, events or ())
    # ALI3P closes positions by itself, whatever is done with its states.
    closes = project or (method == FIXED_STEP and model.manifest["can_project"])
    start = consistent(ode, span[0], x0) if closes else x0
    arguments = method, span[0], start, span[1], max_step, rtol, atol, project, t_eval
    run: Run | SolverRun
    if method in SOLVERS:
        from fourbar_codegen.solver_run import SolverRun

        run = SolverRun(model, ode, *arguments, [place for place, _ in watch.outputs], options)
    else:
        run = Run(ode, *arguments, watch.outputs, bool(watch.callables) or dense_output)
    run.begin()
    watch.begin(run)
    pieces = Pieces(ode, span)
    pieces.begin(run)
    dense: Any = run.dense_output() if dense_output else None  # which takes steps of this kind of run
    samples: list[tuple[Floats, Floats]] = []
    ending: tuple[int, str] | None = None
    steps, noted = 16, time.perf_counter()
    while ending is None:
        begin = time.perf_counter()
        reason = run.on(steps if max_steps is None else min(steps, max_steps - run.n_steps))
        now = time.perf_counter()
        if progress is not None and now - noted >= PAUSE:
            progress(run.t)
            noted = now
        if reason == "event":
            if run.turned:
                samples.append(run.take_samples())
                singular = Singular(model, run.ode, _passed(run, samples)).within_step(run)
                if singular:
                    run.discard()
                    ending = -1, singular
                    break
            if dense is not None:
                dense.add(run)
            end = watch.look(run)
            if end is not None:
                run.stop_within(end)
                ending = 1, TERMINATED
        elif reason == "full":
            samples.append(run.take_samples())
        elif reason == "paused":
            steps = round(min(max(steps * PAUSE / (now - begin), 1), 4 * steps))
            if run.n_steps == max_steps:
                ending = -1, f"It has taken max_steps = {max_steps} steps; None is no limit."
        elif reason == "end":
            if not pieces.ahead:
                ending = 0, REACHED_END
                continue
            samples.append(run.take_samples())
            try:
                closed = pieces.go_on(run)
            except SimulationError as error:
                ending = -1, str(error)
            else:
                ending = (1, TERMINATED) if watch.across(run) else None if closed else (-1, FAILED["open"])
        elif reason == "diverged":
            ending = -1, run.ode.failure or DIVERGED
        else:
            samples.append(run.take_samples())
            at = Singular(model, run.ode, _passed(run, samples))
            singular = at.here(run.t, run.x, collapsed=reason == "collapsed")
            if singular or reason != "collapsed":
                ending = -1, singular or run.ode.failure or FAILED.get(reason, reason)
    status, message = ending
    while run.on(0) == "full":
        samples.append(run.take_samples())
    samples.append(run.take_samples())
    pieces.end(run)
    if status < 0:
        message = f"The integration stopped at t = {run.t:.9g}: {message}"
    t = np.concatenate([times for times, _ in samples])
    y = np.concatenate([states for _, states in samples]).T
    if dense is not None and t_eval is None and t.size > 1 and t[-1] == t[-2]:
        t, y = t[:-1], y[:, :-1]  # an event where a step begins; SciPy leaves that time away as well, beside `sol`
    return Result(
        t=t,
        y=y,
        sol=dense or None,  # without a step there is nothing between states
        t_events=None if events is None else [np.array(times) for times in watch.times],
        y_events=None if events is None else [np.array(states) for states in watch.states],
        nfev=run.n_evaluations,
        njev=run.n_jacobians,
        nlu=run.n_factorizations,
        status=status,
        message=message,
        last=(run.t, run.x),
    )


def most_steps(given: object, method: str, span: tuple[float, float], max_step: float) -> int | None:
    """The most steps that a run may take: as `CompiledModel.simulate` is given them, by default those of its method.

    Raises
    ------
    ModelError
        If it is no such number, or steps are so short that no number of them would do.
    """
    length = abs(span[1] - span[0])
    if max_step < np.spacing(length):
        raise ModelError(f"max_step = {max_step:g} is lost in the rounding of the run's {length:g} s.")
    if isinstance(given, str) and given == "auto":
        return max(STEPS[method], int(min(MARGIN * length / max_step, sys.maxsize)))
    if given is None:
        return None
    if not is_integer(given) or given < 1:
        raise ModelError(f"max_steps must be a positive integer, 'auto', or None for no limit, not {shown(given)}.")
    return min(int(given), sys.maxsize)


def consistent(ode: Ode, t: float, x0: Floats) -> Floats:
    """The state to begin from, moved onto the constraints.

    Parameters
    ----------
    ode : Ode
    t : float
    x0 : ndarray, shape (n_x,)

    Returns
    -------
    ndarray, shape (n_x,)

    Raises
    ------
    ModelError
        If it violates them by more than what rounding to four digits does.
    SimulationError
        If the equations cannot be evaluated there.
    """
    status, x = ode.closest(t, x0)
    if status == OK and np.abs(x - x0).max(initial=0.0) <= FLOOR:
        return x
    if status == NOT_CLOSED or not is_rounded(ode.n_q, x0, x):
        raise ModelError(
            f"The state x0 = {np.array2string(x0, precision=6, separator=', ')} violates the constraints: "
            + (f"the nearest one that does not differs by {np.abs(x - x0).max():.2g}. " if status == OK else "")
            + "CompiledModel.initial_state() makes consistent states; constraints='none' takes x0 as it is, unless the "
            "method is ALI3P, or IDA in a formulation other than index-1."
        )
    if status != OK:
        raise SimulationError(ode.explain(status, t, x0))
    return x


def is_rounded(n_q: int, x0: Floats, x: Floats) -> Any:
    """Whether states, or each of those in rows, differ from consistent ones by no more than rounding to four digits."""
    moved = np.abs(x - x0)
    if (moved <= FLOOR).all():
        return np.ones(x0.shape[:-1], dtype=bool)[()]
    # Of angles, whole turns say nothing; of what is small as a whole, small changes are large.
    size = np.empty_like(x0)
    for part in (slice(None, n_q), slice(n_q, None)):
        size[..., part] = np.minimum(1.0, np.abs(x0[..., part]).max(axis=-1, keepdims=True, initial=0.0))
    size[..., n_q:] = np.maximum(size[..., n_q:], np.abs(x0[..., n_q:]))
    return (moved <= CONSISTENT * size + FLOOR).all(axis=-1)


def _passed(run: Run | SolverRun, samples: Sequence[tuple[Floats, Floats]]) -> list[tuple[float, Floats]]:
    """Times and states of the run so far."""
    passed = [sample for times, states in samples for sample in zip(times, states, strict=True)]
    return passed or [(run.t, run.x)]


class Singular:
    """Tells whether a run has come to a singular position, where the constraints' Jacobian loses rank.

    The measure is the smallest singular value of J by what it has been in the run (the median), with each column of J,
    and then each row, in units of its largest entry in the run: metres and radians count alike.

    Parameters
    ----------
    model : CompiledModel
    ode : Ode
    passed : sequence of (float, ndarray)
        Times and states of the run so far.
    """

    def __init__(self, model: CompiledModel, ode: Ode, passed: Sequence[tuple[float, Floats]]) -> None:
        self.model, self.ode = model, ode
        self.rank = model.manifest["n_dependent_speeds"]
        if self.rank:
            # The last states of a run that collapses are all alike: those before count by the time they stand for.
            since = [abs(t - passed[0][0]) for t, _ in passed]
            order = np.searchsorted(since, np.linspace(0.0, since[-1], STATES))
            jacobians = np.array([self._jacobian(*passed[min(i, len(passed) - 1)]) for i in order])
            column = np.abs(jacobians).max(axis=(0, 1))
            column[column == 0.0] = 1.0
            row = np.abs(jacobians / column).max(axis=(0, 2))
            row[row == 0.0] = 1.0
            self.size = row[:, np.newaxis] * column
            self.usual = float(np.median([self._least(jacobian) for jacobian in jacobians]))

    def _jacobian(self, t: float, x: Floats) -> Floats:
        return self.model.velocity(t, x, self.ode.parameters, self.ode.input_values(t, x))[0]

    def _least(self, jacobian: Floats) -> float:
        return float(np.linalg.svd(jacobian / self.size, compute_uv=False)[self.rank - 1])

    def _ratio(self, t: float, x: Floats) -> float:
        if not np.isfinite(x).all():
            return np.inf  # of a run that explodes; nothing is known of its position
        return self._least(self._jacobian(t, x)) / self.usual if self.usual else 0.0

    def here(self, t: float, x: Floats, *, collapsed: bool) -> str:
        """A sentence, if it is at a state at which steps collapse, or close to one behind which there is no next."""
        if not self.rank:
            return ""
        at = self._sentence("runs into", t, x, COLLAPSED, ", and the steps collapse")
        if at or collapsed or self.ode.failure:
            return at
        return self._sentence("comes close to", t, x, NEAR, ", and the next step fails: try smaller tolerances")

    def within_step(self, run: Run | SolverRun) -> str:
        """A sentence, if it has been passed in the last step of a run.

        There the loops' states have a position of less rank between them; or one of them is followed by another one, by
        which the loops close in another way.
        """
        shares = jump_shares = np.linspace(0.0, 1.0, 33)
        jumped = []
        for _ in range(5):  # to within 1e-6 of the step
            ratios = [self._ratio(run.time_within(share), run.state_within(share)) for share in shares[1:-1]]
            least = 1 + int(np.argmin(ratios))
            at = float(shares[least])
            shares = np.linspace(shares[least - 1], shares[least + 1], 33)
            states = [run.state_within(share)[: self.model.n_q] for share in jump_shares]
            changes = np.abs(np.diff(states, axis=0)).max(axis=1)
            largest = int(np.argmax(changes))
            jumped.append(changes[largest])
            jump_shares = np.linspace(jump_shares[largest], jump_shares[largest + 1], 33)
        t, x = run.time_within(at), run.state_within(at)
        passed = self._sentence("passes", t, x, PASSED, ", and may go on in more than one way")
        if passed or not jumped[-1] > JUMPED * jumped[0] + FLOOR:
            return passed
        return (
            f"A step has crossed to another way of closing the loops at t = {run.time_within(jump_shares[0]):.6g}, "
            "past a singular position: take smaller tolerances."
        )

    def _sentence(self, verb: str, t: float, x: Floats, threshold: float, more: str) -> str:
        ratio = self._ratio(t, x)
        if not ratio < threshold:
            return ""
        where = ", ".join(f"{name} = {value:.6g}" for name, value in zip(self.model.coordinates, x, strict=False))
        return (
            f"The mechanism {verb} a singular position at t = {t:.6g}, {where}: the constraints' Jacobian loses rank "
            f"(its smallest singular value is {ratio:.1e} of what it usually was){more}."
        )


class _Watch:
    """Events as ``solve_ivp`` has them: found between the ends of each step, by Brent's method on the interpolant."""

    def __init__(self, model: CompiledModel, events: Sequence[Event]) -> None:
        self.events = events
        self.times: list[Any] = [[] for _ in events]
        self.states: list[Any] = [[] for _ in events]
        self.callables = [(i, e.function) for i, e in enumerate(events) if callable(e.function)]
        self.named = [i for i, e in enumerate(events) if not callable(e.function)]
        self.outputs = [
            (model.outputs.index(events[i].function), int(np.sign(events[i].direction))) for i in self.named
        ]
        self.values = [0.0] * len(events)
        self.went_on = np.nan
        """Where the present piece of the run begins, behind another one."""

    def begin(self, run: Run | SolverRun) -> None:
        """The functions' values at the beginning."""
        for place, i in enumerate(self.named):
            self.values[i] = run.event_values[1][place]
        for i, function in self.callables:
            self.values[i] = self._call(function, run.t, run.x)

    def _call(self, function: Callable[[float, Floats], float], t: float, x: Floats) -> float:
        return number(function(t, x), "What the callable of an event returns")

    def look(self, run: Run | SolverRun) -> float | None:
        """Note the events of the last step; at which share of it the one is that ends the run."""
        before = self._move_on(run)
        for share, i in sorted((self._root(run, i, before[i]), i) for i in self._changed(before)):
            if share == 0.0 and self.times[i] and self.times[i][-1] == self.went_on == run.time_within(share):
                continue  # found where the piece before ended
            if self._note(i, run.time_within(share), run.state_within(share)):
                return share
        return None

    def across(self, run: Run | SolverRun) -> bool:
        """Note the events of a jump to the state that a run goes on from; whether one of them ends it."""
        before, self.went_on = self._move_on(run), run.t
        changed = [i for i in self._changed(before) if before[i] != self.values[i]]
        ends = [self._note(i, run.t, run.x) for i in changed]
        return any(ends)

    def _move_on(self, run: Run | SolverRun) -> list[float]:
        """Evaluate the functions where the run is; their values before."""
        before = list(self.values)
        for place, i in enumerate(self.named):  # the steps between were not looked at
            before[i] = run.event_values[0][place]
        self.begin(run)
        return before

    def _changed(self, before: Sequence[float]) -> list[int]:
        """The events whose functions have changed their sign."""
        found = []
        for i, event in enumerate(self.events):
            up, down = before[i] <= 0.0 <= self.values[i], before[i] >= 0.0 >= self.values[i]
            if (up and event.direction >= 0) or (down and event.direction <= 0):
                found.append(i)
        return found

    def _note(self, i: int, t: float, x: Floats) -> bool:
        """An event, and whether it ends the run."""
        self.times[i].append(t)
        self.states[i].append(x)
        terminal = self.events[i].terminal
        return bool(terminal) and len(self.times[i]) >= int(terminal)

    def _root(self, run: Run | SolverRun, i: int, before: float) -> float:
        """The share of the last step at which a function is zero."""
        from scipy.optimize import brentq

        known = {0.0: before, 1.0: self.values[i]}

        def value(share: float) -> float:
            if share in known:
                return known[share]
            if i in self.named:
                return float(run.event_values_within(share)[self.named.index(i)])
            function: Any = self.events[i].function
            return self._call(function, run.time_within(share), run.state_within(share))

        precision = 4 * np.finfo(float).eps
        return float(brentq(value, 0.0, 1.0, xtol=precision, rtol=precision))
