"""Linearization about a state, in the independent coordinates and speeds, and states of equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, named_array
from fourbar_codegen.errors import SimulationError
from fourbar_codegen.initial import inputs_at

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel
    from fourbar_codegen.simulate import InputSource

__all__ = ["equilibrium", "linearize"]

Floats = NDArray[np.float64]

# An equilibrium counts as found if the coordinates are right to this, in their units.
COORDINATE_TOLERANCE = 1e-9


def linearize(
    model: CompiledModel, t: float, x: ArrayLike, p: Values | None, r: Values | None
) -> tuple[Floats, Floats]:
    """A and B of the motion near a state; see `CompiledModel.linearize`."""
    state = np.asarray(x, dtype=float)
    n_q, n_u = model.n_q, model.n_u
    n_qi = n_q - model.manifest["n_dependent_coordinates"]
    n_ui = n_u - model.manifest["n_dependent_speeds"]
    by_state = model.jacobian(t, state, p, r)
    by_inputs = model.input_jacobian(t, state, p, r)
    # Phi_q dq = 0 and J du + d(J u + b)/dq dq = 0 give all coordinates and speeds in terms of the independent ones.
    dq = np.vstack((np.eye(n_qi), model.eliminate(model.position(t, state[:n_q], p, r)[1], n_qi, model.coordinates)))
    constraints, _ = model.velocity(t, state, p, r)
    by_speeds = model.eliminate(constraints, n_ui, model.speeds)
    change = model.velocity_sensitivity(t, state, p, r) @ dq
    by_coordinates = model.eliminate(
        np.hstack((change, constraints[:, n_ui:])), n_qi, (*n_qi * ("",), *model.speeds[n_ui:])
    )
    tangent = np.block(
        [
            [dq, np.zeros((n_q, n_ui))],
            [np.zeros((n_ui, n_qi)), np.eye(n_ui)],
            [by_coordinates, by_speeds],
        ]
    )
    independent = [*range(n_qi), *range(n_q, n_q + n_ui)]
    return (by_state @ tangent)[independent], by_inputs[independent]


def equilibrium(
    model: CompiledModel,
    guess: Values | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """A state of rest that lasts; see `CompiledModel.equilibrium`."""
    from scipy.optimize import least_squares

    defaults = {**dict.fromkeys(model.coordinates, 0.0), **model.manifest["initial"]}
    start = named_array(guess, model.coordinates, {n: defaults[n] for n in model.coordinates}, "coordinate")
    p = model.parameter_vector(parameters)
    r = inputs_at(model, t, p, inputs)

    def at_rest(q: Floats) -> Floats:
        return np.concatenate((q, np.zeros(model.n_u)))

    def residual(q: Floats) -> Floats:
        x = at_rest(q)
        return np.concatenate(
            (
                model.position_constraints(t, q, p, r),
                model.velocity_constraints(t, x, p, r),
                model.rhs(t, x, p, r)[model.n_q :],
            )
        )

    def slopes(q: Floats) -> Floats:
        x = at_rest(q)
        return np.vstack(
            (
                model.position(t, q, p, r)[1],
                model.velocity_sensitivity(t, x, p, r),
                model.jacobian(t, x, p, r)[model.n_q :, : model.n_q],
            )
        )

    found = least_squares(residual, start, jac=slopes, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    error, scale = np.abs(residual(found)).max(), np.abs(slopes(found)).max()
    if not error <= COORDINATE_TOLERANCE * max(scale, 1.0):
        names = ", ".join(f"{name} = {value:.6g}" for name, value in zip(model.coordinates, found, strict=True))
        raise SimulationError(
            f"No equilibrium was found from the guess {start.tolist()}: the search ended at {names}, where constraints "
            f"and accelerations are up to {error:.3g} instead of 0. Give another guess, or inputs that hold the "
            "mechanism."
        )
    return at_rest(found)
