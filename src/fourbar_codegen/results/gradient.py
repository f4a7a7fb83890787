"""Gradients of costs of a run: the discrete adjoint in C, then what initial states and inputs are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.arguments import is_mapping, name_of, named, numbers
from fourbar_codegen.kernel.inputs import wrt_values
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import (
    Directions,
    differentiable,
    initial_derivatives,
    locked_parameters,
    moving_breakpoints,
)
from fourbar_codegen.runtime.batch import Jacobians
from fourbar_codegen.runtime.integrator import Steps

__all__ = ["EventSensitivity", "KeptSteps", "output_sensitivity"]

Floats = NDArray[np.float64]


class EventSensitivity(NamedTuple):
    """Derivatives of an event.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Of the times at which it occurs.
    y : ndarray, shape (n_x, n)
        Of the states at these times.

    For the values of a table, these are the last axes. NaN where the event function does not change with time.
    """

    t: Floats
    y: Floats


@dataclass(frozen=True, repr=False)
class KeptSteps:
    """What a run keeps for gradients.

    Attributes
    ----------
    model : Kernel
    steps : Steps
    t : float
        The beginning.
    n_t : int
        The number of samples, without that at a terminal event besides those asked for.
    parameters, inputs
        As for `CompiledModel.simulate`.
    starts_from_x0 : bool
        Whether the initial state was given, and depends on no parameter.
    dx0 : mapping of str to ndarray, shape (n_x,) or (n, n_x)
        Its derivatives, where these are given.
    unknown : frozenset of str
        Parameters with respect to which there are no derivatives.
    """

    model: Kernel
    steps: Steps
    t: float
    n_t: int
    parameters: Floats | None
    inputs: Mapping[Any, Any]
    starts_from_x0: bool
    dx0: Mapping[str, Floats]
    unknown: frozenset[str]

    def gradient(self, cost: Any) -> dict[str, Any]:
        """The gradient of a cost; see `Trajectory.gradient`."""
        model, parameters = self.model, self.parameters
        start, wrt_parameters, wrt_sources = self.steps.gradient(*self._by_samples(cost))
        found: dict[str, Any] = dict(zip(model.parameters, wrt_parameters.tolist(), strict=True))
        for key, source in self.inputs.items():
            found[name_of(key)] = wrt_values(model, name_of(key), source, wrt_sources)
        # A given state depends on no parameter and no input, except as dx0 says.
        names = [n for n in differentiable(model, self.inputs) if n not in self.dx0]
        moved = [n for n in names if n in model.states or not self.starts_from_x0]
        derivatives = initial_derivatives(model, self.t, self.steps.start, parameters, self.inputs, moved)
        for name, derivative in (derivatives | dict(self.dx0)).items():
            wrt_start = derivative @ start
            found[name] = found.get(name, 0.0) + (wrt_start if wrt_start.shape else float(wrt_start))
        end, duration = self.steps.end
        states = [(self.t, self.steps.start), (self.t + duration, end)]
        locked = locked_parameters(model, states, parameters, self.inputs)
        for name in locked.union(moving_breakpoints(model, parameters, model.parameters), self.unknown):
            del found[name]
        return found

    def _by_samples(self, cost: Any) -> tuple[Floats, Floats | None]:
        """The cost's derivatives with respect to the samples' states and outputs, a row for each sample."""
        model, n_t = self.model, self.n_t
        wrt_states, wrt_outputs = np.zeros((n_t, model.n_x)), np.zeros((n_t, model.n_o))
        if is_mapping(cost):
            for name, values in named(cost, (*model.states, *model.outputs), "state or output").items():
                row = numbers(values, f"The derivative of the cost with respect to {name}")
                if row.shape not in ((), (n_t,)):
                    raise ModelError(
                        f"The derivative of the cost with respect to {name} must have the shape ({n_t},), not "
                        f"{row.shape}."
                    )
                of, names = (wrt_states, model.states) if name in model.states else (wrt_outputs, model.outputs)
                of[:, names.index(name)] = row
        else:
            wrt_states = numbers(cost, "The derivatives of the cost").T
            if wrt_states.shape != (n_t, model.n_x):
                raise ModelError(
                    f"The derivatives of the cost with respect to the states must have the shape ({model.n_x}, {n_t}) "
                    f"of the states over time, without one at a terminal event that t_eval does not have, not "
                    f"{wrt_states.T.shape}; or give a mapping from names of states and outputs to arrays of shape "
                    f"({n_t},)."
                )
        if not (np.isfinite(wrt_states).all() and np.isfinite(wrt_outputs).all()):
            raise ModelError("The derivatives of the cost must be finite.")
        return wrt_states, wrt_outputs if wrt_outputs.any() else None


def output_sensitivity(
    model: Kernel,
    t: Floats,
    y: Floats,
    r: Floats,
    *,
    parameters: Floats | None,
    inputs: Mapping[Any, Any],
    directions: Directions,
    sensitivity: Floats,
) -> Floats:
    """The derivatives of the outputs at samples along directions, shape (n, n_o, n_t).

    Parameters
    ----------
    model : Kernel
    t, y, r, parameters, inputs
        As in `Trajectory`.
    directions : Directions
    sensitivity : ndarray, shape (n, n_x, n_t)
        The derivatives of the states.
    """
    model.require_output_derivatives(model.outputs)
    p = parameter_array(model, parameters)
    held = np.zeros(model.n_r, dtype=bool)  # that inputs follow parameters is in the directions
    jacobians = Jacobians(model, t, np.ascontiguousarray(y), p, np.ascontiguousarray(r), held)
    found = np.zeros((len(t), model.n_o, len(sensitivity)))
    for variables, changes in (
        ("state", sensitivity.transpose(2, 1, 0)),
        ("parameters", directions.matrix[model.n_x :]),
        ("inputs", directions.of_inputs(model, t, p, inputs).transpose(2, 0, 1)),
    ):
        if changes.any():
            jacobians.differentiate(variables, True)
            jacobians.evaluate(0, len(t))
            found += jacobians.results[1] @ changes
    return found.transpose(2, 1, 0)
