"""The right-hand side at many states, in SIMD batches and on all cores."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, is_integer, is_mapping, named, named_columns, numbers
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.batch import Batch

__all__ = ["BLOCK", "evaluate", "n_workers"]

Floats = NDArray[np.float64]

BLOCK = 1024
"""Number of states in a task of a thread, and of members in a task of a process."""


def evaluate(
    model: Kernel,
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
        model.parameter_vector(None)  # raises if a parameter has no default
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
    # For contiguous arrays, as these are, the bounds are sufficient.
    elif any(np.may_share_memory(out, given) for given in (times, states, parameters, inputs) if given is not None):
        raise ModelError("out must not share memory with t, x, p or r.")
    model.require_batch_functions()
    batch = Batch(model, times, states, parameters, inputs, out)
    n_threads = min(n_workers(workers), -(-n // BLOCK))
    if n_threads < 2:
        batch.evaluate(0, n)
    else:
        with ThreadPoolExecutor(n_threads) as pool:
            list(pool.map(lambda begin: batch.evaluate(begin, min(begin + BLOCK, n)), range(0, n, BLOCK)))
    return out


def _with_defaults(model: Kernel, times: Floats, parameters: Floats, r: Values, n: int) -> Values:
    """Inputs by name, completed by the values of their expressions; rates of given motions are 0."""
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


def n_workers(workers: int | None) -> int:
    """The number of threads; None is one per core."""
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not is_integer(workers) or workers < 1:
        raise ModelError(f"workers must be a positive number of threads or None, for all cores, not {shown(workers)}.")
    return int(workers)
