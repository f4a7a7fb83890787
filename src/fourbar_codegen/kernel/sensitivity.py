"""What a run can be differentiated by: parameters, and initial values, from which dependent ones follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import Values, name_of
from fourbar_codegen.errors import AssemblyError, ModelError, meant
from fourbar_codegen.kernel.inputs import InputSource, inputs_at
from fourbar_codegen.kernel.kernel import Kernel

__all__ = [
    "Directions",
    "differentiable",
    "directions_of",
    "follow",
    "independent_states",
    "initial_derivatives",
    "moving_breakpoints",
]

Floats = NDArray[np.float64]

SINGULAR = 1e-9
"""Singular values of the constraints' derivatives below this fraction of the largest one count as zero."""


@dataclass(frozen=True)
class Directions:
    """Directions of initial states and parameters.

    Attributes
    ----------
    names : tuple of str
    matrix : ndarray, shape (n_x + n_p, n)
        In columns.
    """

    names: tuple[str, ...]
    matrix: Floats


def directions_of(model: Kernel, names: Sequence[Any]) -> Directions:
    """The unit directions of parameters and of independent states.

    Raises
    ------
    ModelError
        If a name is unknown, that of a dependent state, or repeated.
    """
    independent = _independent(model)
    known = (*model.states, *model.parameters)
    given = tuple(map(name_of, names))
    for name in given:
        if name in model.states and name not in independent:
            raise ModelError(
                f"{name!r} is dependent: its initial value follows from {', '.join((*independent, 'the parameters'))}."
            )
        if name not in known:
            raise ModelError(
                f"There is no parameter and no initial value {name!r}.{meant(name, known)} There are "
                f"{', '.join((*independent, *model.parameters))}."
            )
        if given.count(name) > 1:
            raise ModelError(f"{name!r} is given twice.")
    directions = np.zeros((len(known), len(given)))
    directions[[known.index(name) for name in given], range(len(given))] = 1.0
    return Directions(given, directions)


def follow(
    model: Kernel,
    t: float,
    x: Floats,
    directions: Floats,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """Directions of (x, p) whose dependent coordinates and speeds follow, by the implicit function theorem.

    With dPhi/dq_d dq_d = -(dPhi/dq_i dq_i + dPhi/dp dp), and the same for the speeds by J u + b = 0. Redundant
    constraints are satisfied as well.

    Parameters
    ----------
    model : Kernel
    t : float
    x : ndarray, shape (n_x,)
        A state that satisfies the constraints.
    directions : ndarray, shape (n_x + n_p, n)
        Zero in the rows of dependent coordinates and speeds.
    parameters, inputs
        As for `CompiledModel.simulate`.

    Raises
    ------
    AssemblyError
        If the dependent values cannot be differentiated, at a singular position.
    """
    manifest, n_q, n_u = model.manifest, model.n_q, model.n_u
    found, r = directions.copy(), inputs_at(model, t, model.parameter_vector(parameters), inputs)
    for rows, which, kind in (
        (range(n_q - manifest["n_dependent_coordinates"], n_q), 0, "coordinates"),
        (range(n_q + n_u - manifest["n_dependent_speeds"], n_q + n_u), 1, "speeds"),
    ):
        if not rows:
            continue
        units = np.zeros((len(found), len(rows)))
        units[rows, range(len(rows))] = 1.0
        both = model.constraint_variation(t, x, np.hstack((units, found)), parameters, r)[which]
        size = np.abs(both).max(axis=1, keepdims=True)
        both = both / np.where(size > 0.0, size, 1.0)
        by_dependent, by_others = both[:, : len(rows)], both[:, len(rows) :]
        changes, _, rank, _ = np.linalg.lstsq(by_dependent, -by_others, rcond=SINGULAR)
        if rank < len(rows):
            raise AssemblyError(
                f"The dependent {kind} have no derivative at the initial state, which is a singular position: start "
                "from another one, or choose other independent values."
            )
        found[rows] = changes
    return found


def initial_derivatives(
    model: Kernel,
    t: float,
    x: Floats,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    names: Sequence[str] | None = None,
) -> dict[str, Floats]:
    """The derivatives of an initial state with respect to names, by default all of `differentiable`."""
    names = differentiable(model) if names is None else names
    directions = directions_of(model, names)
    found = follow(model, t, x, directions.matrix, parameters, inputs)
    return dict(zip(names, found[: model.n_x].T, strict=True))


def moving_breakpoints(model: Kernel, parameters: Floats | None, names: Sequence[str]) -> list[str]:
    """The parameters on which the times of jumps and kinks of the model's expressions depend."""
    p = np.array([*model.defaults.values()], dtype=float) if parameters is None else parameters
    before, found = model.breakpoints(p), []
    for name in names if before.size else ():
        changed, place = p.copy(), model.parameters.index(name)
        changed[place] += 1e-6 * (abs(p[place]) or 1.0)
        if not np.array_equal(before, model.breakpoints(changed), equal_nan=True):
            found.append(name)
    return found


def independent_states(model: Kernel) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The names of the independent coordinates and speeds, and of the auxiliary states."""
    manifest = model.manifest
    n_qi, n_ui = model.n_q - manifest["n_dependent_coordinates"], model.n_u - manifest["n_dependent_speeds"]
    return model.coordinates[:n_qi], model.speeds[:n_ui], model.auxiliary_states


def differentiable(model: Kernel) -> tuple[str, ...]:
    """The names of independent and auxiliary states, and of parameters."""
    return (*_independent(model), *model.parameters)


def _independent(model: Kernel) -> tuple[str, ...]:
    """The names of `independent_states` in one."""
    q, u, z = independent_states(model)
    return (*q, *u, *z)
