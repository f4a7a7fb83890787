"""Ensembles: many members in SIMD lanes, on all cores, or with an engine of joblib."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state
from fourbar_codegen.errors import AssemblyError, FourbarError, ModelError, shown
from fourbar_codegen.interface.arguments import flag, is_mapping, name_of, named_columns, numbers
from fourbar_codegen.interface.progress import QUIET_SECONDS
from fourbar_codegen.kernel.consistency import is_rounded, projects
from fourbar_codegen.kernel.discontinuities import boundary, discontinuities
from fourbar_codegen.kernel.inputs import InputSource, bind, by_member, by_name, input_sources, inputs_of, is_by_member
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.runtime import batch
from fourbar_codegen.runtime.batch import Members, width
from fourbar_codegen.runtime.enumerations import EXPLICIT
from fourbar_codegen.simulation.batch import BLOCK, n_workers
from fourbar_codegen.simulation.events import Event, EventLike, event_rows, touched
from fourbar_codegen.simulation.integrate import REACHED_END, TERMINATED
from fourbar_codegen.simulation.methods import IN_C, MethodLike
from fourbar_codegen.simulation.run_options import RunOptions, RunStart
from fourbar_codegen.simulation.simulate import run

__all__ = ["ensemble"]

Floats = NDArray[np.float64]

PAUSE = 0.05
"""Seconds between two updates of the progress bar."""


def ensemble(
    model: Kernel,
    t_span: Sequence[float],
    x0: ArrayLike | Mapping[Any, ArrayLike] | None = None,
    *,
    method: MethodLike = "DOP853",
    parameters: ArrayLike | Mapping[Any, ArrayLike] | None = None,
    inputs: Mapping[Any, InputSource | Floats] | None = None,
    t_eval: ArrayLike | None = None,
    events: EventLike | Sequence[EventLike] | None = None,
    rtol: float | None = None,
    atol: float | ArrayLike | None = None,
    constraints: str = "project",
    max_step: float | None = None,
    max_steps: int | Literal["auto"] | None = "auto",
    workers: int | None = None,
    parallel: Any = None,
    progress: bool = True,
) -> Ensemble:
    """Simulate many members over the same time span, in SIMD lanes and on all cores.

    Models with redundant or with many constraints run one member at a time on each core.

    Parameters
    ----------
    t_span : (float, float)
        First and last time, s.
    x0 : array_like, shape (n_x,) or (n, n_x), or mapping, optional
        One initial state for all members, or one for each; in a mapping, numbers or arrays of length n. By default,
        `initial_state` is solved for each set of parameters.
    method : {"DOP853", "RK45", "Tsit5", "Radau", "ALI3P"}, or an object of these names, optional
        Radau and ALI3P run one member at a time on each core.
    parameters : array_like, shape (n_p,) or (n, n_p), or mapping, optional
        Likewise; the defaults otherwise.
    inputs : mapping of input to source, optional
        As for `simulate`, or an array of shape (n,) with a number for each member. With callables, members run
        one after another.
    t_eval : array_like, optional
        Times at which to store the states; by default the first and the last one.
    events : str, callable, `Event`, or list of these, optional
        As for `simulate`. A terminal event ends its member alone.
    rtol, atol, constraints, max_step, max_steps
        As for `simulate`.
    workers : int, optional
        Number of threads; by default one per core.
    parallel : joblib.Parallel, optional
        An engine that runs blocks of members in place of threads, with any backend: in processes, or on a cluster.
        A worker that does not find the compiled model builds it from its sources, once on each node.
    progress : bool, optional
        Whether to show a progress bar on a terminal if the simulation takes longer than a second.

    Returns
    -------
    Ensemble
        A member that fails is marked; the others continue. Results are bitwise independent of the batch and of the
        number of threads. They agree with `simulate` up to rounding errors, which kinks of an input or nearby
        singular positions can amplify.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite.
    AssemblyError
        If `x0` is left out and the loops of a member do not close.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> ensemble = fb.load("four_bar").ensemble((0.0, 4.0), parameters={"k": np.linspace(2.0, 4.0, 100)})
    >>> ensemble.success.all(), ensemble["q1"].shape
    (np.True_, (100, 2))
    """
    options = RunOptions.of(
        model, t_span, method=method, allowed=IN_C, t_eval=t_eval, events=events, rtol=rtol, atol=atol,
        constraints=constraints, max_step=max_step, max_steps=max_steps,
    )  # fmt: skip
    projects(model, constraints)  # "baumgarte" is allowed for single runs only
    if options.t_eval is None:
        options = replace(options, t_eval=np.array(options.t_span))
    assert options.t_eval is not None
    workers = n_workers(workers)
    shows_bar = flag(progress, "progress")
    if not (parallel is None or _is_engine(parallel)):
        raise ModelError(f"parallel must be a joblib.Parallel or None, not {shown(parallel)}.")
    # One-dimensional arrays contain a number for each member.
    inputs = {key: by_member(key, source) for key, source in by_name(model, inputs).items()}
    p, states, n = _members(model, options.t_span[0], x0, parameters, inputs)
    if n:
        bind(model, p[0], inputs_of(inputs, 0))  # raises if an input has no source
    runs = _Runs(model, options, states, p, inputs)
    from tqdm import tqdm

    # disable=None: no progress bar without a terminal.
    with tqdm(total=n, desc=model.name, unit="run", delay=QUIET_SECONDS, disable=None if shows_bar else True) as bar:
        found = _on_threads(runs, workers, bar) if parallel is None or not n else _on_engine(runs, parallel, bar)
    return Ensemble(
        kernel=model, t=options.t_eval, y=found.y, n_events=None if options.events is None else len(options.events),
        events=found.events, status=found.status, messages=tuple(found.messages), nfev=found.nfev, parameters=p,
        inputs=inputs, settings=options.settings(inputs),
    )  # fmt: skip


def _is_engine(parallel: object) -> bool:
    """Whether the object is a joblib.Parallel; False without joblib."""
    try:
        from joblib import Parallel
    except ImportError:
        return False
    return isinstance(parallel, Parallel)


def _members(
    model: Kernel, t: float, x0: Any, parameters: Any, inputs: Mapping[Any, Any]
) -> tuple[Floats, Floats, int]:
    """Parameters and initial states of all members, shapes (n, n_p) and (n, n_x), and n."""
    p = named_columns(
        _columns({} if parameters is None else parameters, "parameters", model.n_p),
        model.parameters,
        model.defaults,
        "parameter",
    )
    x = None if x0 is None else named_columns(_columns(x0, "x0", model.n_x), model.states, {}, "state")
    varied = [key for key, source in inputs.items() if is_by_member(source)]
    lengths = [(f"input {name_of(key)}", len(inputs[key])) for key in varied]
    lengths += [(w, len(rows.T)) for w, rows in (("parameters", p), ("x0", x)) if rows is not None and rows.ndim == 2]
    if len({length for _, length in lengths}) > 1:
        raise ModelError(
            "Values for each member must have the same length: "
            + ", ".join(f"{name} has {length}" for name, length in lengths)
        )
    n = lengths[0][1] if lengths else 1
    for what, rows in (("parameters", p), ("x0", x)):
        if rows is not None and not np.isfinite(rows).all():
            raise ModelError(f"{what} must be finite.")
    # Always copies, also if the memory layout is already right.
    p = np.array(np.broadcast_to(p.T, (n, model.n_p)), order="C")
    if x is not None:
        return p, np.array(np.broadcast_to(x.T, (n, model.n_x)), order="C"), n
    known: dict[bytes, Floats] = {}
    states = np.empty((n, model.n_x))
    for member in range(n):
        key = p[member].tobytes() + b"".join(inputs[name][member].tobytes() for name in varied)
        if key not in known:
            try:
                known[key] = initial_state(model, t=t, parameters=p[member], inputs=inputs_of(inputs, member))
            except AssemblyError as error:
                raise AssemblyError(f"Member {member}: {error}", error.residual) from error
        states[member] = known[key]
    return p, states, n


def _columns(given: Any, what: str, n: int) -> Any:
    """Values by name unchanged; an array with members in rows is transposed."""
    if is_mapping(given):
        return given
    values = numbers(given, what)
    if not 1 <= values.ndim <= 2 or values.shape[-1] != n:
        raise ModelError(f"{what} must have shape ({n},), or (members, {n}), not {values.shape}.")
    return values.T


def _sources(model: Kernel, inputs: Mapping[Any, Any], n: int) -> list[object]:
    """For each input None, a Table, a callable, or an array with a value for each member."""
    varied = {name_of(key): value for key, value in inputs.items() if is_by_member(value)}
    sources = input_sources(model, inputs_of(inputs, 0) if n else {})
    for place, entry in enumerate(model.layout.inputs):
        if entry.of in varied and not entry.order:
            sources[place] = varied[entry.of]
    return sources


@dataclass(frozen=True)
class _Results:
    """Samples, statuses, messages and numbers of evaluations of all members, and the rows of an `Ensemble`'s events."""

    y: Floats
    status: NDArray[np.int_]
    messages: list[str]
    nfev: NDArray[np.int_]
    events: Floats


@dataclass(frozen=True)
class _Runs:
    """The members to simulate, in rows, with their options."""

    model: Kernel
    options: RunOptions
    states: Floats
    parameters: Floats
    inputs: Mapping[Any, Any]

    def of(self, member: int) -> RunStart:
        """What a member starts from."""
        return RunStart(self.states[member], self.parameters[member], inputs_of(self.inputs, member), {})

    def block(self, members: slice) -> _Runs:
        """Some of the members."""
        inputs = inputs_of(self.inputs, members)
        return replace(self, states=self.states[members], parameters=self.parameters[members], inputs=inputs)


def _on_threads(runs: _Runs, workers: int, bar: Any) -> _Results:
    """Simulate in SIMD lanes where possible, the other members one by one."""
    model, options, states, n = runs.model, runs.options, runs.states, len(runs.states)
    assert options.t_eval is not None
    y: Floats | None = None
    status, nfev, messages = np.full(n, -1), np.zeros(n, dtype=int), [REACHED_END] * n
    events = options.events or []
    occurred = [np.empty((0, 3 + model.n_x))]
    rows = event_rows(model, events)
    stopped = threading.Event()

    def check(_: float) -> None:
        if stopped.is_set():
            raise _StoppedError

    silent = replace(options, progress=check)

    def alone(member: int) -> None:
        try:
            found = run(model, silent, runs.of(member))
        except FourbarError as error:
            messages[member] = str(error)
            return
        assert y is not None
        assert options.t_eval is not None
        n_samples = len(found.t) - (found.status == 1 and found.t[-1] not in options.t_eval)
        y[member, :, :n_samples] = found.y[:, :n_samples]
        status[member], messages[member], nfev[member] = found.status, found.message, found.nfev
        for k, (times, states) in enumerate(zip(found.t_events or (), found.y_events or (), strict=True)):
            if times.size:
                occurred.append(np.column_stack((np.full(len(times), member), np.full(len(times), k), times, states)))

    sources = _sources(model, runs.inputs, n)
    called = any(map(callable, (*sources, *(row[1] for row in rows))))
    if not called:
        model.require_batch_functions()
    waiting = np.arange(n)
    members = None
    tasks: list[Future[None]] = []
    # Callables may have internal state, so members with callables do not run concurrently.
    with ThreadPoolExecutor(1 if called else workers) as pool:
        try:
            in_lanes = options.method in EXPLICIT and width(model) > 1 and not called
            breaks = _breaks(runs) if in_lanes else None
            if breaks is not None:
                moved = states.copy()
                rtol, atol = (np.array(np.broadcast_to(value, model.n_x)) for value in (options.rtol, options.atol))
                members = Members(
                    model, options.method, *options.t_span, moved, runs.parameters, sources, options.max_step, rtol,
                    atol, options.project, options.t_eval, breaks, options.max_steps or 0, rows,
                )  # fmt: skip
                tasks = [pool.submit(members.run) for _ in range(min(workers, n))]
                for _ in _finished(tasks):
                    bar.update(members.n_ended - bar.n)
                closed = is_rounded(model.n_q, model.n_u, states, moved)
                status[(members.status == batch.DONE) & closed] = 0
                status[(members.status == batch.TERMINATED) & closed] = 1
                y, nfev = members.samples, members.n_evaluations
                waiting = np.flatnonzero(status < 0)
                messages[:] = [TERMINATED if ended == 1 else REACHED_END for ended in status.tolist()]
                if events:
                    occurred.append(_events_in_lanes(members.found, events, status, messages))
                y[waiting], nfev[waiting] = np.nan, 0
            else:
                y = np.full((n, model.n_x, len(options.t_eval)), np.nan)
            bar.n = n - len(waiting)  # members that are repeated do not count twice
            tasks = [pool.submit(alone, int(member)) for member in waiting]
            for finished in _finished(tasks):
                bar.update(finished)
        except BaseException:
            stopped.set()
            if members is not None:
                members.stop()
            for task in tasks:
                task.cancel()
            raise
    assert y is not None
    found = np.concatenate(occurred)
    return _Results(y, status, messages, nfev, found[np.lexsort((found[:, 0], found[:, 1]))])


def _events_in_lanes(rows: Floats, events: Sequence[Event], status: NDArray[np.int_], messages: list[str]) -> Floats:
    """What was found in lanes, unless the member has to run again; messages tell where a function touches zero."""
    rows = rows[status[rows[:, 0].astype(int)] >= 0]
    touching = rows[:, 1] < 0
    of_members = sorted(rows[touching, :3].tolist(), key=lambda row: (row[0], -row[1]))
    for member, of in itertools.groupby(of_members, key=lambda row: int(row[0])):
        messages[member] += touched([(events[-1 - int(event)], t) for _, event, t in of])
    return rows[~touching]


def _breaks(runs: _Runs) -> Floats | None:
    """Times at which the steps of all members end, and the limits of the values before and after, in three rows.

    None if the times differ between members, or if velocities may jump.
    """
    begin, end = runs.options.t_span
    by_parameters = runs.model.layout.breakpoints.n > 0
    alike = np.unique(runs.parameters, axis=0) if by_parameters else runs.parameters[:1]
    found: list[Any] = []
    for p in alike:
        ode = bind(runs.model, p, inputs_of(runs.inputs, 0))
        marks = discontinuities(ode, begin, end)
        if any(mark.moves for mark in marks):
            return None
        sides = [boundary(ode, mark, math.copysign(math.inf, end - begin), runs.states[0]) for mark in marks]
        found.append([(side.end, side.last, side.first) for side in sides])
    if not found or any(breaks != found[0] for breaks in found):
        return None
    return np.reshape(np.array(found[0], dtype=float), (-1, 3)).T


class _StoppedError(Exception):
    """The user interrupted all runs."""


def _finished(tasks: Sequence[Future[None]]) -> Iterator[int]:
    """Wait for all tasks, with breaks for keyboard interrupts; yields the number of newly finished tasks."""
    pending: Any = tasks
    while pending:
        done, pending = wait(pending, timeout=PAUSE)
        for task in done:
            task.result()
        yield len(done)


def _on_engine(runs: _Runs, parallel: Any, bar: Any) -> _Results:
    """Simulate blocks of members with joblib."""
    from joblib import delayed

    blocks = [slice(begin, begin + BLOCK) for begin in range(0, len(runs.states), BLOCK)]
    tasks = (delayed(_block)(number, runs.block(members)) for number, members in enumerate(blocks))
    arrived: dict[int, _Results] = {}
    for number, part in parallel(tasks):  # in order of arrival
        arrived[number] = part
        bar.update(len(part.y))
    parts = [arrived[number] for number in range(len(blocks))]
    events = np.concatenate([part.events for part in parts])
    events[:, 0] += np.repeat([block.start for block in blocks], [len(part.events) for part in parts])
    return _Results(
        y=np.concatenate([part.y for part in parts]),
        status=np.concatenate([part.status for part in parts]),
        messages=[message for part in parts for message in part.messages],
        nfev=np.concatenate([part.nfev for part in parts]),
        events=events[np.argsort(events[:, 1], kind="stable")],
    )


def _block(number: int, runs: _Runs) -> tuple[int, _Results]:
    from tqdm import tqdm

    return number, _on_threads(runs, 1, tqdm(disable=True))
