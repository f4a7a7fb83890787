"""The right-hand side, its Jacobians and the residual at batches of states, on one core or more."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import Values, is_integer, is_mapping, named, named_columns, numbers, one_of
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.runtime.batch import Batch, Jacobians

__all__ = [
    "BLOCK",
    "differentiate",
    "input_jacobian_batch",
    "jacobian_batch",
    "n_workers",
    "parameter_jacobian_batch",
    "residual",
    "residual_batch",
    "residual_jacobian_batch",
    "residual_sparsity",
    "rhs_batch",
]

Floats = NDArray[np.float64]

BLOCK = 1024
"""Number of states in a task of a thread, and of members in a task of a process."""


def rhs_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None = None,
    r: Values | None = None,
    *,
    out: Floats | None = None,
    workers: int | None = 1,
) -> Floats:
    """The right-hand side x' = f(t, x) at a batch of states, in SIMD lanes.

    Parameters
    ----------
    t : float or array_like, shape (n,)
    x : array_like, shape (n_x, n)
        States in columns; or a mapping from names to arrays.
    p : array_like, shape (n_p,) or (n_p, n), or mapping to numbers or arrays of length n, optional
        Parameters; the defaults otherwise.
    r : array_like, shape (n_r,) or (n_r, n), or mapping, optional
        Inputs; their expressions otherwise.
    out : ndarray, shape (n_x, n), optional
        Array for the result: contiguous, without memory shared with the arguments; a new array otherwise.
    workers : int or None, optional
        Number of threads; None for one per core.

    Returns
    -------
    ndarray, shape (n_x, n)
        x', with NaN in the columns of states at which the equations cannot be evaluated. Results are bitwise
        independent of the other states.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
    >>> four_bar.rhs_batch(0.0, states, {"k": np.linspace(1.0, 5.0, 1000)}).shape
    (6, 1000)
    """
    times, states, parameters, inputs = given = _arguments(model, t, x, p, r)
    if out is None:
        out = np.empty(states.shape)
    elif (
        not (isinstance(out, np.ndarray) and out.dtype == float and out.flags.carray)
        or out.shape != states.shape
        or np.ma.is_masked(out)
    ):
        raise ModelError(f"out must be a contiguous, writable array of double of the shape {states.shape}.")
    # For contiguous arrays, as these are, the bounds are sufficient.
    elif any(np.may_share_memory(out, array) for array in given if array is not None):
        raise ModelError("out must not share memory with t, x, p or r.")
    model.require_batch_functions()
    _in_threads(Batch(model, times, states, parameters, inputs, out), states.shape[1], workers)
    return out


def jacobian_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None = None,
    r: Values | None = None,
    *,
    workers: int | None = 1,
) -> Floats:
    """The derivatives of the right-hand side with respect to the state, at a batch of states.

    Parameters
    ----------
    t, x, p, r, workers
        As for `rhs_batch`.

    Returns
    -------
    ndarray, shape (n_x, n_x, n)
        dx'/dx, with NaN for states at which the equations cannot be evaluated.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
    >>> four_bar.jacobian_batch(0.0, states).shape
    (6, 6, 1000)
    """
    return differentiate(model, "state", t, x, p, r, outputs=False, workers=workers)[0]


def parameter_jacobian_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None = None,
    r: Values | None = None,
    *,
    workers: int | None = 1,
) -> Floats:
    """The derivatives of the right-hand side with respect to the parameters, at a batch of states.

    Total derivatives, as `parameter_jacobian` has them; parameters, shape and errors are those of `jacobian_batch`.

    Returns
    -------
    ndarray, shape (n_x, n_p, n)

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
    >>> four_bar.parameter_jacobian_batch(0.0, states).shape
    (6, 8, 1000)
    """
    return differentiate(model, "parameters", t, x, p, r, outputs=False, workers=workers)[0]


def input_jacobian_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None = None,
    r: Values | None = None,
    *,
    workers: int | None = 1,
) -> Floats:
    """The derivatives of the right-hand side with respect to the inputs, at a batch of states.

    Parameters, shape and errors are those of `jacobian_batch`.

    Returns
    -------
    ndarray, shape (n_x, n_r, n)

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
    >>> four_bar.input_jacobian_batch(0.0, states).shape
    (6, 1, 1000)
    """
    return differentiate(model, "inputs", t, x, p, r, outputs=False, workers=workers)[0]


def residual_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    rates: ArrayLike,
    multipliers: ArrayLike | None = None,
    p: Values | None = None,
    r: Values | None = None,
    *,
    formulation: str = "index-3",
    workers: int | None = 1,
) -> Floats:
    """The residual of the equations of motion at a batch of states, for direct collocation.

    Its rows are q' - K u - k; M u' - f - J^T lambda; z' minus its expression; then for each constraint "index-3"
    Phi, or J u + b if it is nonholonomic, and for "index-1" J u' + gamma; then the rows of unknown forces that
    drive the motion. No matrix is inverted, so that singular positions and massless parts do no harm.

    Parameters
    ----------
    t : float or array_like, shape (n,)
    x, rates : array_like, shape (n_x, n)
        States, and their rates x', such as differences between neighbours.
    multipliers : array_like, shape (n_l, n), optional
        Lagrange multipliers of the constraints, then unknown forces; may be left out if there are none.
    p, r, workers
        As for `rhs_batch`.
    formulation : {"index-3", "index-1"}, optional

    Returns
    -------
    ndarray, shape (n_x + n_l, n)

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name.

    Source: J. T. Betts, *Practical Methods for Optimal Control and Estimation Using Nonlinear Programming*, 2nd
    ed., SIAM 2010, chapter 4.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> x = four_bar.initial_state()
    >>> rates, multipliers = four_bar.rhs(0.0, x), four_bar.multipliers(0.0, x)
    >>> residual = four_bar.residual_batch(0.0, x[:, None], rates[:, None], multipliers[:, None])
    >>> residual.shape, bool(np.abs(residual).max() < 1e-12)
    ((8, 1), True)
    """
    found = residual(model, t, x, rates, multipliers, p, r, formulation=formulation, workers=workers)
    return found["residual"]


def residual_jacobian_batch(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    rates: ArrayLike,
    multipliers: ArrayLike | None = None,
    p: Values | None = None,
    r: Values | None = None,
    *,
    formulation: str = "index-3",
    wrt: Sequence[str] = ("x", "rates", "multipliers", "p", "r"),
    workers: int | None = 1,
) -> dict[str, Floats]:
    """The Jacobians of `residual_batch`, which has the same other parameters and errors.

    `residual_sparsity` tells which entries are always 0.

    Parameters
    ----------
    wrt : sequence of {"x", "rates", "multipliers", "p", "r"}, optional
        What to differentiate with respect to; by default all, of which parameters take most of the time.

    Returns
    -------
    dict of str to ndarray, shape (n_x + n_l, m, n)
        By each of `wrt`; by "p" also through inputs whose expressions are in force.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> x = four_bar.initial_state()[:, None]
    >>> found = four_bar.residual_jacobian_batch(0.0, x, 0.0 * x, [[1.0], [2.0]])
    >>> {name: jacobian.shape for name, jacobian in found.items()}
    {'x': (8, 6, 1), 'rates': (8, 6, 1), 'multipliers': (8, 2, 1), 'p': (8, 8, 1), 'r': (8, 1, 1)}
    """
    return residual(model, t, x, rates, multipliers, p, r, formulation=formulation, workers=workers, wrt=wrt)


def differentiate(
    model: Kernel,
    variables: str,
    t: ArrayLike,
    x: ArrayLike,
    p: Values | None,
    r: Values | None,
    *,
    outputs: bool,
    workers: int | None,
) -> list[Floats]:
    """The Jacobians of x', and of the outputs, at a batch of states, each of shape (rows, m, n).

    By "state", "parameters" or "inputs"; see `CompiledModel.jacobian_batch`.
    """
    times, states, parameters, inputs = _arguments(model, t, x, p, r)
    jacobians = Jacobians(model, times, states, parameters, inputs, np.array(model.defaults_in_force(r), dtype=bool))
    jacobians.differentiate(variables, outputs)
    _in_threads(jacobians, states.shape[1], workers)
    return [np.moveaxis(result, 0, -1) for result in jacobians.results]


def residual(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike,
    rates: ArrayLike,
    multipliers: ArrayLike | None,
    p: Values | None,
    r: Values | None,
    *,
    formulation: str,
    workers: int | None,
    wrt: str | Sequence[str] | None = None,
) -> dict[str, Floats]:
    """The "residual" of the equations of motion at a batch of states, or its Jacobians by the names of `wrt`.

    See `CompiledModel.residual_batch` and `CompiledModel.residual_jacobian_batch`.
    """
    names = (wrt,) if isinstance(wrt, str) else () if wrt is None else tuple(wrt)
    for name in names:
        one_of(name, ("x", "rates", "multipliers", "p", "r"), "wrt")
    if wrt is not None and not names:
        raise ModelError("wrt names nothing to differentiate with respect to.")
    # Those with respect to x and the multipliers are found together.
    together = [*dict.fromkeys("y" if name in ("x", "multipliers") else name for name in names)]
    times, states, parameters, inputs = _arguments(model, t, x, p, r)
    n = states.shape[1]
    one_of(formulation, ("index-1", "index-3"), "formulation")
    if multipliers is None:
        if model.n_l:
            raise ModelError(
                f"The model has {model.n_l} multipliers: give them, as an array of shape ({model.n_l}, n)."
            )
        multipliers = np.zeros((0, n))
    arrays: list[Floats] = []
    for values, rows, what in ((rates, model.n_x, "rates of the states"), (multipliers, model.n_l, "multipliers")):
        array = np.ascontiguousarray(numbers(values, f"The {what}"))
        if array.shape != (rows, n):
            raise ModelError(f"The {what} must have shape ({rows}, {n}), like {n} states, not {array.shape}.")
        arrays.append(array)
    batch = Jacobians(model, times, states, parameters, inputs, np.array(model.defaults_in_force(r), dtype=bool))
    batch.form(arrays[0], arrays[1], formulation, together)
    _in_threads(batch, n, workers)
    results = [np.moveaxis(result, 0, -1) for result in batch.results]
    if wrt is None:
        return {"residual": results[0]}
    by = dict(zip(together, results, strict=True))
    if "y" in by:
        by |= {"x": by["y"][:, : model.n_x], "multipliers": by["y"][:, model.n_x :]}
    if "rates" in by:
        by["rates"] = by["rates"][:, : model.n_x]
    return {name: by[name] for name in names}


def residual_sparsity(model: Kernel, formulation: str = "index-3") -> dict[str, NDArray[np.bool_]]:
    """Which entries of the Jacobians of `residual_batch` may differ from 0.

    Parameters
    ----------
    formulation : {"index-3", "index-1"}, optional

    Returns
    -------
    dict of str to ndarray of bool, shape (n_x + n_l, m)
        By the names of `residual_jacobian_batch`.

    Raises
    ------
    ModelError
        If there is no such formulation.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").residual_sparsity()["r"].ravel().tolist()  # a force on two links
    [False, False, False, True, True, False, False, False]
    """
    one_of(formulation, ("index-1", "index-3"), "formulation")
    n_q, n_u, n_z, n_x, n_c, n_l = model.n_q, model.n_u, model.n_z, model.n_x, model.n_c, model.n_l
    n_p, n_r = model.n_p, model.n_r
    sizes = (n_x, n_p, n_r, n_u, n_l)

    def bits(name: str) -> NDArray[np.bool_]:
        """The rows of a result by all variables."""
        rows = model.layout.dependencies.rows[name]
        return np.array([[mask >> place & 1 for place in range(sum(sizes))] for mask in rows], dtype=bool).reshape(
            -1, sum(sizes)
        )

    residual, positions, velocities = bits("residual"), bits("position_violation"), bits("velocity_violation")
    closed = residual[n_u : n_u + n_c]
    if formulation == "index-3":
        kept = [row in model.layout.constraints.position_rows for row in range(n_c)]
        closed = np.where(np.array(kept, dtype=bool)[:, np.newaxis], positions[:n_c], velocities)
    rows = np.vstack(
        (bits("coordinate_rates"), residual[:n_u], residual[n_u + n_l :], closed, residual[n_u + n_c : n_u + n_l])
    )
    wrt_state, wrt_parameters, wrt_inputs, wrt_accelerations, wrt_multipliers = np.split(
        rows, np.cumsum(sizes)[:-1], axis=1
    )
    wrt_rates = np.zeros((n_x + n_l, n_x), dtype=bool)
    wrt_rates[:, n_q : n_q + n_u] = wrt_accelerations
    own = [*range(n_q), *range(n_q + n_u, n_q + n_u + n_z)]
    wrt_rates[own, own] = True
    through_inputs = wrt_inputs @ bits("default_inputs")[:, n_x : n_x + n_p]
    return {
        "x": wrt_state,
        "rates": wrt_rates,
        "multipliers": wrt_multipliers,
        "p": wrt_parameters | through_inputs,
        "r": wrt_inputs,
    }


def _arguments(
    model: Kernel, t: ArrayLike, x: ArrayLike, p: Values | None, r: Values | None
) -> tuple[Floats, Floats, Floats, Floats | None]:
    """Times, states, parameters and inputs as contiguous arrays."""
    states = named_columns(x, model.states, {}, "state")
    if states.ndim != 2:
        raise ModelError(f"The states must have shape ({model.n_x}, n), not {states.shape}.")
    n = states.shape[1]
    times = numbers(t, "The times")
    if times.shape not in {(), (n,)}:
        raise ModelError(f"The times must be a number or have shape ({n},), not {times.shape}.")
    if p is None:
        parameters = parameter_array(model, model.parameter_vector(None))  # raises if a parameter has no default
    else:
        parameters = named_columns(p, model.parameters, model.defaults, "parameter", n)
    inputs = None
    if r is not None:
        inputs = named_columns(_with_defaults(model, times, parameters, r, n), model.inputs, {}, "input", n)
    elif not model.has_inputs:
        raise ModelError(model.missing())
    return times, states, parameters, inputs


def _in_threads(batch: Batch | Jacobians, n: int, workers: int | None) -> None:
    n_threads = min(n_workers(workers), -(-n // BLOCK))
    if n_threads < 2:
        batch.evaluate(0, n)
    else:
        with ThreadPoolExecutor(n_threads) as pool:
            list(pool.map(lambda begin: batch.evaluate(begin, min(begin + BLOCK, n)), range(0, n, BLOCK)))


def _with_defaults(model: Kernel, times: Floats, parameters: Floats, r: Values, n: int) -> Values:
    """Inputs by name, completed by the values of their expressions; rates of given motions are 0."""
    if not is_mapping(r):
        return r
    given = model.rates_at_rest(r) | named(r, model.inputs, "input")
    entries = enumerate(model.layout.inputs)
    expressions = [i for i, entry in entries if entry.name not in given and entry.expression is not None]
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
