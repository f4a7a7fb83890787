"""States of static equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.arguments import Values, finite_number, named_array
from fourbar_codegen.errors import ModelError, SimulationError
from fourbar_codegen.kernel.inputs import InputSource, bind, input_sources
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["equilibrium"]

Floats = NDArray[np.float64]

# Tolerance of an equilibrium: for the loops relative to their scales; for accelerations relative to those at the start
# of the search, or to the changes that the coordinates' own magnitudes would cause.
COORDINATE_TOLERANCE = 1e-9
# Smallest eigenvalue of the mass matrix, relative to the largest.
LIGHT = 1e-12


def equilibrium(
    model: Kernel,
    guess: Values | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """A state of static equilibrium; see `CompiledModel.equilibrium`."""
    from scipy.optimize import least_squares

    if not model.n_q:
        raise ModelError(f"The model {model.name} has no coordinates, so it has no equilibrium to search for.")
    if model.n_q - model.manifest["n_dependent_coordinates"] > model.n_u:
        raise ModelError(
            f"The model {model.name} has more independent coordinates than speeds, so an equilibrium does not "
            "determine them. Make the relation between them (such as the norm of a quaternion) a holonomic constraint."
        )
    t = finite_number(t, "t")
    if any(map(callable, input_sources(model, inputs))):
        raise ModelError(
            "An equilibrium can be searched with inputs that are numbers, tables or expressions, not callables."
        )
    names, n_q, last = (*model.coordinates, *model.auxiliary_states), model.n_q, model.n_q + model.n_u
    defaults = {**dict.fromkeys(names, 0.0), **model.manifest["initial"]}
    start = named_array(guess, names, {n: defaults[n] for n in names}, "coordinate or auxiliary state")
    p = model.parameter_vector(parameters)
    r = bind(model, p, inputs).input_values(t, np.zeros(model.n_x))

    def at_rest(unknown: Floats) -> Floats:
        return np.concatenate((unknown[:n_q], np.zeros(model.n_u), unknown[n_q:]))

    def evaluated(unknown: Floats) -> Floats:
        x = at_rest(unknown)
        rates, accelerations, state_rates = np.split(model.rhs(t, x, p, r), [n_q, last])
        loops, velocities = model.position_constraints(t, x[:n_q], p, r) / size, model.velocity_constraints(t, x, p, r)
        return np.concatenate((loops, velocities, rates, weights @ accelerations, state_rates))

    def residual(unknown: Floats) -> Floats:
        try:
            return evaluated(unknown)
        except SimulationError:  # the search takes a shorter step
            return np.full(model.n_h + model.n_c + model.n_x, np.inf)

    def slopes(unknown: Floats) -> Floats:
        x = at_rest(unknown)
        by_state = np.delete(model.jacobian(t, x, p, r), slice(n_q, last), axis=1)
        rates, accelerations, state_rates = np.split(by_state, [n_q, last])
        constraints = np.vstack(
            (
                model.position(t, x[:n_q], p, r)[1] / size[:, np.newaxis],
                model.constraint_sensitivity(t, x, p, r)[0],
            )
        )
        constraints = np.hstack((constraints, np.zeros((len(constraints), model.n_z))))
        return np.vstack((constraints, rates, weights @ accelerations, state_rates))

    begin = start
    if model.n_h and model.manifest["n_dependent_speeds"] < model.n_c:
        # Where loops are open, redundant constraints are independent, and the equations have no solution.
        n_qi = model.n_q - model.manifest["n_dependent_coordinates"]
        loops = Loops(model, t, start[:n_qi], p, r)
        dependent = loops.search(start[n_qi:n_q])
        begin = start if dependent is None else np.concatenate((loops.coordinates(dependent), start[n_q:]))
    # Scales that do not depend on the units of length, mass and time: loops relative to their terms, accelerations in
    # the metric of the mass matrix, relative to their norm at the start of the search.
    size, *_ = model.constraint_scale(t, at_rest(begin), p, r)
    size[~(size > 0.0)] = 1.0
    masses, axes = np.linalg.eigh(model.tree_mass_matrix(t, at_rest(begin), p))
    weights = np.sqrt(np.maximum(masses, LIGHT * masses.max(initial=0.0)))[:, np.newaxis] * axes.T
    weights /= np.linalg.norm(weights @ model.rhs(t, at_rest(begin), p, r)[n_q:last]) or 1.0
    found = least_squares(residual, begin, jac=slopes, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    errors, scales = np.abs(residual(found)), np.abs(slopes(found)) @ np.abs(found)
    if not (errors <= COORDINATE_TOLERANCE * np.maximum(scales, 1.0)).all():
        ended = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, found, strict=True))
        raise SimulationError(
            f"No equilibrium was found from the guess {start.tolist()}: the search ended at {ended}, where up to "
            f"{errors.max():.3g} is left of the scales of constraints and rates. Give another guess, or "
            "inputs that hold the mechanism."
        )
    return at_rest(found)
