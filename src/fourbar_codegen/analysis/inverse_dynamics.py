"""Inverse dynamics: the inputs, such as motor torques, that a given motion needs.

In the equations M u' = f(r) + F(n, r) + J^T lambda and 0 = Q(n, r) - M_a u' + J_a^T lambda, the motion is known, and
unknown are some inputs r, the multipliers lambda, and the unknown forces n that drive the motion. Projected onto the
left null space of (J^T, F_n; J_a^T, Q_n), they are as many equations as there are degrees of freedom, for the inputs
alone. The mass matrix is not inverted, so that inertia may vanish, as that of a piston does at its dead points. One
step of Newton's method is exact where inputs and forces enter linearly.

Source: J. Garcia de Jalon and E. Bayo, *Kinematic and Dynamic Simulation of Multibody Systems*, Springer 1994,
chapter 6.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.loop_closure import require_closed
from fourbar_codegen.arguments import Values, is_mapping, name_of, named, named_columns, numbers
from fourbar_codegen.errors import ModelError, SimulationError, meant, shown
from fourbar_codegen.kernel.dependent import solve_redundant
from fourbar_codegen.kernel.inputs import InputSource, bind, by_name
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["inverse_dynamics"]

Floats = NDArray[np.float64]

RANK = 1e-10
"""Smallest singular value that counts, relative to the largest, of matrices with scaled rows and columns."""

SMALL = 1e-3
"""Columns are scaled up from this size, where rows have the size 1: an input at a dead point has a column of rounding
errors, which should not count."""

CONSISTENT = 1e-6
"""Largest violation of the constraints by given accelerations, relative to its terms."""

BALANCED = 1e-9
"""Largest residual of the equations, relative to its terms."""

MAX_ITERATIONS = 30


def inverse_dynamics(
    model: Kernel,
    motion: Branch | Trajectory | tuple[ArrayLike, Any, Any],
    find: Any,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> dict[str, Floats]:
    """Inputs that a motion needs; see `CompiledModel.inverse_dynamics`."""
    names = _unknown(model, find, inputs)
    given = _motion(model, motion)
    if parameters is None or is_mapping(parameters):
        parameters = given.parameters | named(parameters or {}, model.parameters, "parameter")
    p = model.parameter_vector(parameters)
    entries, sources = model.manifest["inputs"], by_name(model, inputs)
    replaced = {*names, *map(name_of, sources)}
    carried = {
        k: given.inputs[e["name"]]
        for k, e in enumerate(entries)
        if e["of"] not in replaced and e["name"] in given.inputs
    }
    ode = bind(model, p, {**sources, **dict.fromkeys([*names, *(entries[k]["of"] for k in carried)], 0.0)})
    rows = [model.inputs.index(name) for name in names]
    found = np.full((len(names), *given.states.shape[1:]), np.nan)
    for k in np.ndindex(given.states.shape[1:]):
        t, x, rates = float(given.times[k]), given.states[:, *k], given.rates[:, *k]
        if np.isfinite(x).all() and np.isfinite(rates).all():
            r = ode.input_values(t, x)
            r[[*carried]] = [values[k] for values in carried.values()]
            require_closed(model, t, x, p, r)
            all_rates = _accelerations(model, t, x, given.rows, rates, p, r)
            if all_rates is not None:
                found[:, *k] = _balance(model, t, x, all_rates, p, r, rows)
    if not np.isfinite(found).any():
        raise SimulationError(
            f"{', '.join(names)} cannot bring about this motion: the equations determine them at none of its "
            f"{found[0].size} states. Inputs that act through auxiliary states, or in a singular position, do not "
            "change accelerations."
        )
    return dict(zip(names, found, strict=True))


@dataclass(frozen=True)
class _Motion:
    """A motion as it was given.

    Attributes
    ----------
    times : ndarray, shape (...)
    states : ndarray, shape (n_x, ...)
    rows : list of int
        Numbers of the speeds with given rates.
    rates : ndarray, shape (n_rows, ...)
    parameters : dict of str to float
        Those of the motion that the model has, too.
    inputs : dict of str to ndarray, shape (...)
        Likewise.
    """

    times: Floats
    states: Floats
    rows: list[int]
    rates: Floats
    parameters: dict[str, float]
    inputs: dict[str, Floats]


def _unknown(model: Kernel, find: Any, inputs: Mapping[Any, InputSource] | None) -> list[str]:
    """The names of the inputs to find, as many as there are degrees of freedom."""
    freedom = model.n_u - model.manifest["n_dependent_speeds"]
    moving = {model.inputs[place] for place in model.manifest["moving_inputs"]}
    known = [entry["name"] for entry in model.manifest["inputs"] if not entry["order"]]
    forces = [name for name in known if name not in moving]
    given = named(by_name(model, inputs), known, "input")
    if find is None:
        names = [name for name in forces if name not in given]
    else:
        names = [
            name_of(name) for name in ([find] if isinstance(find, str) or not isinstance(find, Iterable) else find)
        ]
        for name in names:
            if name not in forces:
                why = "prescribes a motion" if name in moving else f"is no input.{meant(name, forces)}"
                raise ModelError(f"{name} cannot be found: it {why}. There are {', '.join(forces) or 'none'}.")
            if name in given or names.count(name) > 1:
                raise ModelError(f"{name} is given twice: name it once, in find= or in inputs=.")
    if len(names) != freedom or not names:
        raise ModelError(
            f"The motion of {model.name} has {freedom} degrees of freedom, so it determines as many inputs, not "
            f"{len(names)} ({', '.join(names) or 'none'}). "
            + (
                "Name them in find=, and give the others in inputs=."
                if len(forces) >= freedom > 0
                else "What holds prescribed motions is told by their multipliers and outputs."
                if not freedom
                else "Make forces or torques functions of time, which are inputs."
            )
        )
    return names


def _motion(model: Kernel, motion: Any) -> _Motion:
    """The given motion, in the order of the model's states."""
    all_speeds = list(range(model.n_u))
    if isinstance(motion, Branch | Trajectory):
        source = motion.model
        missing = [name for name in model.states if name not in source.states]
        if missing:
            raise ModelError(
                f"The motion of {source.name} does not tell {', '.join(missing)} of {model.name}; it has "
                f"{', '.join(source.states)}."
            )
        order = [source.states.index(name) for name in model.states]
        speeds = [source.speeds.index(name) for name in model.speeds]
        shared = [name for name in source.parameters if name in model.parameters]
        if isinstance(motion, Branch):
            if model.n_z:
                raise ModelError(f"Positions along a drive do not tell {', '.join(model.auxiliary_states)}.")
            states = np.concatenate((motion.q, motion.u, np.full((source.n_z, motion.q.shape[1]), np.nan)))
            times, rates = np.full(states.shape[1], motion.t), motion.ud
            shared = [name for name in shared if name not in motion.without_value]
            inherited = {source.inputs[place] for place in source.manifest["moving_inputs"]}
            values = dict(zip(source.parameters, motion.p.tolist(), strict=True))
        else:
            times, states, first = motion.t, motion.y, source.n_q
            inherited = {*source.inputs}
            rates = np.reshape(
                [
                    source.rhs(t, x, motion.parameters, r)[first : first + source.n_u]
                    for t, x, r in zip(times, states.T, motion.r.T, strict=True)
                ],
                (len(times), source.n_u),
            ).T
            own = source.defaults.values() if motion.parameters is None else motion.parameters.tolist()
            values = dict(zip(source.parameters, own, strict=True))
        own_inputs = {n: row for n, row in zip(source.inputs, motion.r, strict=True) if n in inherited}
        return _Motion(
            times, states[order], all_speeds, rates[speeds], {name: values[name] for name in shared}, own_inputs
        )
    if not isinstance(motion, tuple) or len(motion) != 3:
        raise ModelError(f"A motion is a Branch, a Trajectory, or (t, x, accelerations), not {shown(motion)}.")
    states = named_columns(motion[1], model.states, {}, "state")
    shape = states.shape[1:]
    times = numbers(motion[0], "The times")
    if times.shape not in {(), shape}:
        raise ModelError(f"The times must be a number or have shape {shape}, not {times.shape}.")
    rows, names = all_speeds, model.speeds
    if is_mapping(motion[2]):
        given = named(motion[2], model.speeds, "speed")
        rows = [row for row in all_speeds if model.speeds[row] in given]
        names = tuple(model.speeds[row] for row in rows)
    rates = named_columns(motion[2], names, {}, "acceleration", *shape)
    rates = np.broadcast_to(rates.reshape(len(names), *(rates.shape[1:] or [1] * len(shape))), (len(names), *shape))
    return _Motion(np.broadcast_to(times, shape), states, rows, rates, {}, {})


def _accelerations(
    model: Kernel, t: float, x: Floats, rows: list[int], rates: Floats, p: Floats | None, r: Floats
) -> Floats | None:
    """All u' with J u' + gamma = 0 and the given ones; None if these do not determine the others."""
    *_, jacobian, bias = model.dynamics(t, x, p, r)
    matrix = np.vstack((jacobian, np.eye(model.n_u)[rows]))
    found = solve_redundant(matrix, np.concatenate((-bias, rates)))
    if found is None:
        return None
    violation = jacobian @ found + bias
    size = np.abs(jacobian) @ np.abs(found) + np.abs(bias) + np.abs(jacobian).max(axis=1, initial=0.0)
    away = np.abs(found[rows] - rates)
    if (np.abs(violation) > CONSISTENT * size).any() or (away > CONSISTENT * (1.0 + np.abs(rates))).any():
        told = ", ".join(f"{model.speeds[row]}' = {rate:.6g}" for row, rate in zip(rows, rates, strict=True))
        raise ModelError(
            f"The accelerations {told} at t = {t:g} violate the constraints: J u' + gamma = {violation}. Give those of "
            "the independent speeds by name: the others follow."
        )
    return found


def _balance(model: Kernel, t: float, x: Floats, rates: Floats, p: Floats | None, r: Floats, rows: list[int]) -> Floats:
    """The inputs in these rows for which the equations hold; NaN if they do not determine them."""
    n_u, n_c, k = model.n_u, model.n_c, len(rows)
    unknown, r = np.zeros(k + model.n_l), r.copy()
    for iteration in range(MAX_ITERATIONS):
        r[rows], multipliers, forces = unknown[:k], unknown[k : k + n_c], unknown[k + n_c :]
        _, mass, forcing, jacobian, _ = model.dynamics(t, x, p, r)
        effect, by_forces, rest, rest_by_forces, other_mass, other_jacobian = model.unknown_forces(t, x, forces, p, r)
        equations = [*range(n_u), *range(n_u + n_c, n_u + model.n_l)]
        by_inputs = model.sensitivities(t, x, rates, unknown[k:], p, r)[5][equations][:, rows]
        reactions = np.block([[jacobian.T, by_forces], [other_jacobian, rest_by_forces]])
        known, inertial = np.concatenate((forcing + effect, rest)), np.vstack((mass, other_mass)) @ rates
        residual = known + reactions[:, :n_c] @ multipliers - inertial
        # Inputs may balance other forces within `forcing`.
        terms = np.abs(known) + np.abs(inertial) + np.abs(np.hstack((by_inputs, reactions))) @ np.abs(unknown)
        if iteration and (np.abs(residual) <= BALANCED * terms.max(initial=0.0)).all():
            return unknown[:k]
        step = _step(by_inputs, reactions, residual)
        if step is None:
            break
        unknown = unknown + step
    return np.full(k, np.nan)


def _step(by_inputs: Floats, reactions: Floats, residual: Floats) -> Floats | None:
    """The change of inputs and reactions that balances the residual; None if inputs are not determined.

    They are if no combination of their columns is one of the reactions' columns. Reactions of redundant constraints are
    those of minimum norm.
    """
    matrix, k = np.hstack((by_inputs, reactions)), by_inputs.shape[1]
    rows = np.abs(matrix).max(axis=1, initial=0.0)
    rows[rows == 0.0] = 1.0
    columns = np.maximum(np.abs(matrix / rows[:, None]).max(axis=0, initial=0.0), SMALL)
    scaled = matrix / rows[:, None] / columns
    step, _, rank, _ = np.linalg.lstsq(scaled, -residual / rows, rcond=RANK)
    if rank < k + np.linalg.matrix_rank(scaled[:, k:], rtol=RANK):
        return None
    return np.asarray(step / columns)
