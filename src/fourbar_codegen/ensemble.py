"""Many states and many runs at once: side by side in vectors, and on all cores."""

from __future__ import annotations

import itertools
import math
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import (
    Values,
    flag,
    is_integer,
    is_mapping,
    longest_step,
    name_of,
    named,
    named_columns,
    numbers,
    one_of,
    sample_times,
    time_span,
    tolerance,
)
from fourbar_codegen.discontinuities import boundary, discontinuities
from fourbar_codegen.errors import AssemblyError, FourbarError, ModelError, shown
from fourbar_codegen.integrate import METHODS, REACHED_END, is_rounded, most_steps
from fourbar_codegen.progress import PATIENCE
from fourbar_codegen.runtime.batch import DONE, Batch, Members, width
from fourbar_codegen.simulate import InputSource, bind, by_name, input_sources, own_source, projects
from fourbar_codegen.trajectory import Trajectory

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel

__all__ = ["Ensemble", "evaluate", "run"]

Floats = NDArray[np.float64]

BLOCK = 1024
"""States that a thread evaluates at a time, members that a process runs at a time."""

PAUSE = 0.05
"""Seconds between two looks at how far the threads are."""


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Runs of one mechanism over the same time, members in rows.

    Attributes
    ----------
    model : CompiledModel
    t : ndarray, shape (n_t,)
        Times, s.
    y : ndarray, shape (n, n_x, n_t)
        ``y[i]`` are the states of member i as those of a `Trajectory`; NaN from where it failed on.
    success : ndarray of bool, shape (n,)
        Whether each member has reached the end.
    messages : tuple of str
        Why each has ended.
    nfev : ndarray of int, shape (n,)
        Numbers of evaluations of the right-hand side.
    parameters : ndarray, shape (n, n_p)
    inputs : mapping
        Sources of the inputs as they were given, in copies.
    settings : dict
        How the runs were asked for, as of a `Trajectory`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> ensemble = four_bar.ensemble((0.0, 1.0), parameters={"k": [2.0, 3.0, 4.0]}, t_eval=[0.0, 0.5, 1.0])
    >>> ensemble.y.shape, ensemble["q1"].shape, ensemble.success.all()
    ((3, 6, 3), (3, 3), np.True_)
    """

    model: CompiledModel
    t: Floats = field(repr=False)
    y: Floats = field(repr=False)
    success: NDArray[np.bool_]
    messages: tuple[str, ...] = field(repr=False)
    nfev: NDArray[np.int_] = field(repr=False)
    parameters: Floats = field(repr=False)
    inputs: Mapping[Any, Any] = field(repr=False)
    settings: Mapping[str, Any] = field(repr=False)

    def __len__(self) -> int:
        return len(self.y)

    def __getitem__(self, key: Any) -> Any:
        """A member as a `Trajectory`, by its number; or a coordinate or speed of all, shape (n, n_t), by its name."""
        if not is_integer(key):
            if isinstance(key, slice):
                raise ModelError("Members are had one by one: slice ensemble.y, or index with a number.")
            if name_of(key) in self.model.states:
                return self.y[:, self.model.states.index(name_of(key))]
            raise ModelError(f"There is no state {name_of(key)!r}; there are {', '.join(self.model.states)}.")
        n = len(self)
        if not -n <= key < n:
            raise IndexError(f"member {key} of {n}")
        member = int(key) % n
        reached = np.isfinite(self.y[member]).all(axis=0)
        t, y = self.t[reached], self.y[member][:, reached]
        parameters, inputs = self.parameters[member].copy(), _inputs_of(self.inputs, member)
        ode = bind(self.model, parameters, inputs)
        success = bool(self.success[member])
        return Trajectory(
            model=self.model, parameters=parameters, t=t, y=y, r=ode.inputs_along(t, y), sol=None, t_events=None,
            y_events=None, nfev=int(self.nfev[member]), njev=0, nlu=0, status=0 if success else -1, success=success,
            message=self.messages[member], settings=dict(self.settings), inputs=inputs,
        )  # fmt: skip

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[member] for member in range(len(self)))


def evaluate(
    model: CompiledModel,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None,
    r: Values | None,
    *,
    out: Floats | None,
    workers: int | None,
) -> Floats:
    """The right-hand side at many states; see `CompiledModel.rhs_batch`."""
    states = named_columns(x, model.states, {}, "state")
    if states.ndim != 2:
        raise ModelError(f"The states must have shape ({model.n_x}, n), not {states.shape}.")
    n = states.shape[1]
    times = numbers(t, "The times")
    if times.shape not in {(), (n,)}:
        raise ModelError(f"The times must be a number or have shape ({n},), not {times.shape}.")
    if p is None:
        model.parameter_vector(None)  # raises where one has no default
        parameters = np.array(list(model.defaults.values()), dtype=float)
    else:
        parameters = named_columns(p, model.parameters, model.defaults, "parameter", n)
    inputs = None
    if r is not None:
        inputs = named_columns(_with_defaults(model, times, parameters, r, n), model.inputs, {}, "input", n)
    elif any(entry["expression"] is None for entry in model.manifest["inputs"]):
        raise ModelError(model.missing())
    if out is None:
        out = np.empty(states.shape)
    elif not (isinstance(out, np.ndarray) and out.shape == states.shape and out.dtype == float and out.flags.carray):
        raise ModelError(f"out must be a contiguous, writable array of double of the shape {states.shape}.")
    # For arrays that are contiguous, as these are, the bounds tell it.
    elif any(np.may_share_memory(out, given) for given in (times, states, parameters, inputs) if given is not None):
        raise ModelError("out must not share memory with t, x, p or r.")
    model.require_lanes()
    batch = Batch(model, times, states, parameters, inputs, out)
    n_threads = min(_workers(workers), -(-n // BLOCK))
    if n_threads < 2:
        batch.evaluate(0, n)
    else:
        with ThreadPoolExecutor(n_threads) as pool:
            list(pool.map(lambda begin: batch.evaluate(begin, min(begin + BLOCK, n)), range(0, n, BLOCK)))
    return out


def _with_defaults(model: CompiledModel, times: Floats, parameters: Floats, r: Values, n: int) -> Values:
    """Inputs by name with those that are left out: their expressions' values, rates of given motions 0."""
    if not is_mapping(r):
        return r
    given = model.rates_at_rest(r) | named(r, model.inputs, "input")
    entries = enumerate(model.manifest["inputs"])
    expressions = [i for i, entry in entries if entry["name"] not in given and entry["expression"] is not None]
    if not expressions:
        return given
    if times.ndim or parameters.ndim == 2:
        t, p = np.broadcast_to(times, n), np.broadcast_to(parameters.T, (n, model.n_p))
        values = np.reshape([model.default_inputs(*at) for at in zip(t, p, strict=True)], (n, model.n_r)).T
    else:
        values = model.default_inputs(float(times), parameters)
    return {model.inputs[i]: values[i] for i in expressions} | given


def _workers(workers: int | None) -> int:
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not is_integer(workers) or workers < 1:
        raise ModelError(f"workers must be a positive number of threads or None, for all cores, not {shown(workers)}.")
    return int(workers)


def _is_engine(parallel: object) -> bool:
    """Whether it is a joblib.Parallel; without joblib, there is none."""
    try:
        from joblib import Parallel
    except ImportError:
        return False
    return isinstance(parallel, Parallel)


def run(
    model: CompiledModel,
    t_span: Sequence[float],
    x0: ArrayLike | Mapping[Any, ArrayLike] | None,
    *,
    method: str,
    parameters: ArrayLike | Mapping[Any, ArrayLike] | None,
    inputs: Mapping[Any, InputSource | Floats] | None,
    t_eval: ArrayLike | None,
    rtol: float,
    atol: float | ArrayLike,
    constraints: str,
    max_step: float,
    max_steps: int | str | None,
    workers: int | None,
    parallel: Any,
    progress: bool,
) -> Ensemble:
    """Many runs at once; see `CompiledModel.ensemble`."""
    one_of(method, tuple(METHODS), "method for ensembles")
    projects(model, constraints)
    start, end = time_span(t_span)
    times = np.array([start, end]) if t_eval is None else sample_times(t_eval, start, end)
    relative, absolute = float(tolerance(rtol, "rtol")), tolerance(atol, "atol", model.n_x)
    max_step = longest_step(max_step)
    workers = _workers(workers)
    shows_bar = flag(progress, "progress")
    if not (parallel is None or _is_engine(parallel)):
        raise ModelError(f"parallel must be a joblib.Parallel or None, not {shown(parallel)}.")
    # Arrays of one dimension have a number for each member.
    inputs = {key: _by_member(key, source) for key, source in by_name(model, inputs).items()}
    p, states, n = _members(model, start, x0, parameters, inputs)
    if n:
        bind(model, p[0], _inputs_of(inputs, 0))  # raises where an input has no source
    how = {
        "method": method, "t_eval": times, "rtol": relative, "atol": np.array(np.broadcast_to(absolute, model.n_x)),
        "constraints": constraints, "max_step": max_step,
        "max_steps": most_steps(max_steps, method, (start, end), max_step),
    }  # fmt: skip
    runs = _Runs(model, (start, end), states, p, inputs, how)
    from tqdm import tqdm

    # Silent where nobody watches: disable=None looks whether there is a terminal.
    with tqdm(total=n, desc=model.name, unit="run", delay=PATIENCE, disable=None if shows_bar else True) as bar:
        if parallel is None or not n:
            y, success, messages, nfev = _on_threads(runs, workers, bar)
        else:
            y, success, messages, nfev = _on_engine(runs, parallel, bar)
    return Ensemble(
        model=model, t=times, y=y, success=success, messages=messages, nfev=nfev, parameters=p, inputs=inputs,
        settings={
            "method": method, "t_span": (start, end), "rtol": relative, "atol": absolute.tolist(),
            "constraints": constraints, **({"max_step": max_step} if max_step < math.inf else {}),
        },
    )  # fmt: skip


def _members(
    model: CompiledModel, t: float, x0: Any, parameters: Any, inputs: Mapping[Any, Any]
) -> tuple[Floats, Floats, int]:
    """Parameters and initial states of all members, shapes (n, n_p) and (n, n_x), and n."""
    p = named_columns(
        _columns({} if parameters is None else parameters, "parameters", model.n_p),
        model.parameters,
        model.defaults,
        "parameter",
    )
    x = None if x0 is None else named_columns(_columns(x0, "x0", model.n_x), model.states, {}, "state")
    by_member = [key for key, source in inputs.items() if _is_by_member(source)]
    lengths = [(f"input {name_of(key)}", len(inputs[key])) for key in by_member]
    lengths += [(w, len(rows.T)) for w, rows in (("parameters", p), ("x0", x)) if rows is not None and rows.ndim == 2]
    if len({length for _, length in lengths}) > 1:
        raise ModelError(
            "All that is given for each member must have the same length: "
            + ", ".join(f"{name} has {length}" for name, length in lengths)
        )
    n = lengths[0][1] if lengths else 1
    for what, rows in (("parameters", p), ("x0", x)):
        if rows is not None and not np.isfinite(rows).all():
            raise ModelError(f"{what} must be finite.")
    # Copies, also where a single row or column already lies as it is needed.
    p = np.array(np.broadcast_to(p.T, (n, model.n_p)), order="C")
    if x is not None:
        return p, np.array(np.broadcast_to(x.T, (n, model.n_x)), order="C"), n
    known: dict[bytes, Floats] = {}
    states = np.empty((n, model.n_x))
    for member in range(n):
        key = p[member].tobytes() + b"".join(inputs[name][member].tobytes() for name in by_member)
        if key not in known:
            try:
                known[key] = model.initial_state(t=t, parameters=p[member], inputs=_inputs_of(inputs, member))
            except AssemblyError as error:
                raise AssemblyError(f"Member {member}: {error}", error.residual) from error
        states[member] = known[key]
    return p, states, n


def _columns(given: Any, what: str, n: int) -> Any:
    """Values by name, or those of members in rows, as columns."""
    if is_mapping(given):
        return given
    values = numbers(given, what)
    if not 1 <= values.ndim <= 2 or values.shape[-1] != n:
        raise ModelError(f"{what} must have shape ({n},), or (members, {n}), not {values.shape}.")
    return values.T


def _by_member(name: object, source: Any) -> Any:
    """The source of an input, or an array with a number for each member; a copy of what is the caller's."""
    if not _is_by_member(source):
        return own_source(name_of(name), source)
    values = np.array(numbers(source, f"The values of input {name_of(name)}"))
    if not np.isfinite(values).all():
        raise ModelError(f"The values of input {name_of(name)} must be finite.")
    return values


def _is_by_member(source: object) -> bool:
    return isinstance(source, np.ndarray) and source.ndim == 1


def _inputs_of(inputs: Mapping[Any, Any], members: Any) -> dict[Any, Any]:
    """The sources of one member, or of some."""
    return {key: value[members] if _is_by_member(value) else value for key, value in inputs.items()}


def _sources(model: CompiledModel, inputs: Mapping[Any, Any], n: int) -> list[object]:
    """For each input None, a Table, a callable, or an array with a value for each member."""
    by_member = {name_of(key): value for key, value in inputs.items() if _is_by_member(value)}
    sources = input_sources(model, _inputs_of(inputs, 0) if n else {})
    for place, entry in enumerate(model.manifest["inputs"]):
        if entry["of"] in by_member and not entry["order"]:
            sources[place] = by_member[entry["of"]]
    return sources


Results = tuple[Floats, NDArray[np.bool_], tuple[str, ...], NDArray[np.int_]]
"""States, success, messages and numbers of evaluations of all members."""


@dataclass(frozen=True)
class _Runs:
    """What is to be run, members in rows, and how: the arguments that `simulate` and `ensemble` share."""

    model: CompiledModel
    span: tuple[float, float]
    states: Floats
    parameters: Floats
    inputs: Mapping[Any, Any]
    how: Mapping[str, Any]

    def block(self, members: slice) -> _Runs:
        """Some of the members."""
        inputs = _inputs_of(self.inputs, members)
        return replace(self, states=self.states[members], parameters=self.parameters[members], inputs=inputs)


def _on_threads(runs: _Runs, workers: int, bar: Any) -> Results:
    """Side by side those that can be, the others alone."""
    model, states, how, n = runs.model, runs.states, runs.how, len(runs.states)
    y: Floats | None = None
    success, nfev, messages = np.zeros(n, dtype=bool), np.zeros(n, dtype=int), [REACHED_END] * n
    stopped = threading.Event()

    def check(_: float) -> None:
        if stopped.is_set():
            raise _StoppedError

    def alone(member: int) -> None:
        try:
            inputs = _inputs_of(runs.inputs, member)
            found = model.simulate(
                runs.span, states[member], parameters=runs.parameters[member], inputs=inputs, progress=check, **how
            )
        except FourbarError as error:
            messages[member] = str(error)
            return
        assert y is not None
        y[member, :, : len(found.t)] = found.y
        success[member], messages[member], nfev[member] = found.success, found.message, found.nfev

    sources = _sources(model, runs.inputs, n)
    called = any(map(callable, sources))
    if not called:
        model.require_lanes()
    waiting = np.arange(n)
    members = None
    tasks: list[Future[None]] = []
    # Callables may have a memory: they get no two members at once.
    with ThreadPoolExecutor(1 if called else workers) as pool:
        try:
            breaks = _breaks(runs) if width(model) > 1 and not called else None
            if breaks is not None:
                moved = states.copy()
                rtol = np.full(model.n_x, how["rtol"])
                members = Members(
                    model, how["method"], *runs.span, moved, runs.parameters, sources, how["max_step"], rtol,
                    how["atol"], how["constraints"] == "project" and bool(model.n_c), how["t_eval"],
                    breaks, how["max_steps"] or 0,
                )  # fmt: skip
                tasks = [pool.submit(members.run) for _ in range(min(workers, n))]
                for _ in _finished(tasks):
                    bar.update(members.n_ended - bar.n)
                success = (members.status == DONE) & is_rounded(model.n_q, states, moved)
                y, nfev = members.samples, members.n_evaluations
                waiting = np.flatnonzero(~success)
                y[waiting], nfev[waiting] = np.nan, 0
            else:
                y = np.full((n, model.n_x, len(how["t_eval"])), np.nan)
            bar.n = n - len(waiting)  # members that have to run again do not count twice
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
    return y, success, tuple(messages), nfev


def _breaks(runs: _Runs) -> Floats | None:
    """Where the steps of all members end, and the times up to which and from which on values belong to either side.

    In rows. None where members do not end them at the same times, or velocities may jump.
    """
    by_parameters = runs.model.manifest["n_breakpoints"] > 0
    alike = np.unique(runs.parameters, axis=0) if by_parameters else runs.parameters[:1]
    found: list[Any] = []
    for p in alike:
        ode = bind(runs.model, p, _inputs_of(runs.inputs, 0))
        marks = discontinuities(ode, *runs.span)
        if any(mark.moves for mark in marks):
            return None
        towards = math.copysign(math.inf, runs.span[1] - runs.span[0])
        sides = [boundary(ode, mark, towards, runs.states[0]) for mark in marks]
        found.append([(side.end, side.last, side.first) for side in sides])
    if not found or any(breaks != found[0] for breaks in found):
        return None
    return np.reshape(np.array(found[0], dtype=float), (-1, 3)).T


class _StoppedError(Exception):
    """The user has interrupted all runs."""


def _finished(tasks: Sequence[Future[None]]) -> Iterator[int]:
    """Looks up now and then, also for an interrupt from the keyboard, until all tasks are done: how many more are."""
    pending: Any = tasks
    while pending:
        done, pending = wait(pending, timeout=PAUSE)
        for task in done:
            task.result()
        yield len(done)


def _on_engine(runs: _Runs, parallel: Any, bar: Any) -> Results:
    """By joblib, in blocks of members."""
    from joblib import delayed

    blocks = [slice(begin, begin + BLOCK) for begin in range(0, len(runs.states), BLOCK)]
    tasks = (delayed(_block)(number, runs.block(members)) for number, members in enumerate(blocks))
    parts: dict[int, Results] = {}
    for number, part in parallel(tasks):  # in the order in which they come
        parts[number] = part
        bar.update(len(part[0]))
    y, success, messages, nfev = zip(*(parts[number] for number in range(len(blocks))), strict=True)
    return np.concatenate(y), np.concatenate(success), tuple(itertools.chain(*messages)), np.concatenate(nfev)


def _block(number: int, runs: _Runs) -> tuple[int, Results]:
    found = runs.model.ensemble(
        runs.span, runs.states, parameters=runs.parameters, inputs=runs.inputs, workers=1, progress=False, **runs.how
    )
    return number, (found.y, found.success, found.messages, found.nfev)
