"""Consistent initial states: independent values in, states with the loops closed out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.arguments import Values, named_array
from fourbar_codegen.errors import AssemblyError
from fourbar_codegen.kernel.dependent import INDEPENDENT, SINGULAR, row_sizes, solve_dependent
from fourbar_codegen.kernel.inputs import InputSource, inputs_at
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.progress import Progress

if TYPE_CHECKING:
    from fourbar_codegen.analysis.assembly_modes import AssemblyModes

__all__ = ["initial_state", "initial_states"]

Floats = NDArray[np.float64]

FURTHER_GUESSES = 40
"""Guesses tried before a loop is said not to close, beside the one that was given."""

CONSISTENT = 1e-10
"""Velocity constraints count as satisfied to this share of their terms."""


def initial_state(
    model: Kernel,
    coordinates: Values | None = None,
    speeds: Values | None = None,
    *,
    t: float,
    guess: Values | None = None,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """A state that satisfies all constraints; see `CompiledModel.initial_state`."""
    loops, u_i, start = _given(model, coordinates, speeds, t, guess, parameters, inputs)
    q = loops.coordinates(_close(loops, start) if model.n_h else start)
    return np.concatenate((q, _dependent_speeds(loops, q, u_i)))


def initial_states(
    model: Kernel,
    coordinates: Values | None,
    speeds: Values | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> AssemblyModes:
    """All states with these independent values; see `CompiledModel.initial_states`."""
    from fourbar_codegen.analysis.assembly_modes import DISTINCT, AssemblyModes, closed_coordinates

    loops, u_i, start = _given(model, coordinates, speeds, t, None, parameters, inputs)
    with Progress(f"{model.name}: ways to close the loops") as progress:
        found, is_complete = closed_coordinates(loops, start, progress) if model.n_h else ([start], True)
    states = []
    for dependent in found:
        q = loops.coordinates(dependent)
        try:
            u = _dependent_speeds(loops, q, u_i, DISTINCT)  # in a dead point, positions are right to half of all digits
        except UndeterminedSpeedsError:
            u = np.concatenate((u_i, np.full(model.n_u - len(u_i), np.nan)))
        states.append(np.concatenate((q, u)))
    return AssemblyModes(model, loops.t, np.reshape(states, (len(states), model.n_x)), is_complete, loops.p, loops.r)


def _given(
    model: Kernel,
    coordinates: Values | None,
    speeds: Values | None,
    t: float,
    guess: Values | None,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> tuple[Loops, Floats, Floats]:
    """The loops to be closed, the independent speeds, and the guess of the dependent coordinates."""
    n_qi = model.n_q - model.manifest["n_dependent_coordinates"]
    n_ui = model.n_u - model.manifest["n_dependent_speeds"]
    initial = model.manifest["initial"]
    p = model.parameter_vector(parameters)
    q_i = named_array(coordinates, model.coordinates[:n_qi], initial, "independent coordinate")
    u_i = named_array(speeds, model.speeds[:n_ui], initial, "independent speed")
    dependent = model.coordinates[n_qi:]
    start = named_array(guess, dependent, {**dict.fromkeys(dependent, 0.0), **initial}, "dependent coordinate")
    return Loops(model, t, q_i, p, inputs_at(model, t, p, inputs)), u_i, start


def _close(loops: Loops, start: Floats) -> Floats:
    """Dependent coordinates that satisfy the position constraints, from a guess of them."""
    dependent = loops.search(start)
    if dependent is not None:
        return dependent
    model, q_i = loops.model, loops.q_i
    names = model.coordinates[len(q_i) :]
    generator = np.random.default_rng(0)
    attempts = [loops.closest(start + generator.uniform(-np.pi, np.pi, len(start))) for _ in range(FURTHER_GUESSES)]
    found = loops.closest(start)
    error = loops.residual(found)
    message = (
        f"The loop does not close from the guess {_named(names, start)} with "
        f"{_named(model.coordinates[: len(q_i)], q_i)}: the position constraints keep the residual {error} "
        f"at {_named(names, found)}."
    )
    others = [attempt for attempt in attempts if loops.are_closed(attempt)]
    if others:
        message += (
            f" It closes from other guesses, for instance guess={others[0].round(3).tolist()}; initial_states lists "
            "the ways in which it closes."
        )
    else:
        error = min((error, *map(loops.residual, attempts)), key=lambda e: float(np.abs(e).max()))
        message += (
            f" The loop cannot be closed from {FURTHER_GUESSES} other guesses either; the smallest residual is {error}."
            " Check the parameters (a link may be too long or too short) and the independent coordinates."
        )
    raise AssemblyError(message, error)


class UndeterminedSpeedsError(AssemblyError):
    """The dependent speeds do not follow from the independent ones in a configuration."""


def _dependent_speeds(loops: Loops, q: Floats, u_i: Floats, singular: float = SINGULAR) -> Floats:
    """All speeds: the dependent ones solve J_d u_d = -(J_i u_i + b), and are determined by that."""
    model, n_i = loops.model, len(u_i)
    jacobian, bias = model.velocity(loops.t, np.concatenate((q, np.zeros(model.n_u))), loops.p, loops.r)
    if not model.n_c:
        return u_i
    size = row_sizes(jacobian)
    jacobian, bias = jacobian / size, bias / size[:, 0]
    rank = int(np.linalg.matrix_rank(jacobian, rtol=INDEPENDENT))
    if rank > model.n_u - n_i:
        raise AssemblyError(model.too_few_dependent(f"at {_named(model.coordinates, q)}", rank))
    known = jacobian[:, :n_i] @ u_i + bias
    u_d, determined = solve_dependent(jacobian, n_i, known, singular)
    error = np.abs(jacobian[:, n_i:] @ u_d + known).max()
    terms = max(np.abs(jacobian[:, n_i:]).max() * np.abs(u_d).max(), np.abs(known).max())
    if determined < len(u_d) or not error <= CONSISTENT * terms:
        raise UndeterminedSpeedsError(
            f"The dependent speeds ({', '.join(model.speeds[n_i:])}) do not follow from the independent ones at "
            f"{_named(model.coordinates, q)}: the constraints' Jacobian with respect to them is singular. Start from "
            "another configuration, or choose other independent speeds."
        )
    return np.concatenate((u_i, u_d))


def _named(names: tuple[Any, ...], values: Floats) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, values, strict=True)) or "none"
