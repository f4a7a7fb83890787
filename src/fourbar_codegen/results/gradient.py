"""Gradients of costs of a run: the discrete adjoint in C, then what initial states and inputs are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import is_mapping, name_of, named, numbers
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.inputs import by_values
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.sensitivity import differentiable, initial_derivatives, moving_breakpoints
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
        The number of samples.
    parameters, inputs
        As for `CompiledModel.simulate`.
    starts_from_x0 : bool
        Whether the initial state was given, and depends on no parameter.
    dx0 : mapping of str to ndarray, shape (n_x,)
        Its derivatives, where these are given.
    """

    model: Kernel
    steps: Steps
    t: float
    n_t: int
    parameters: Floats | None
    inputs: Mapping[Any, Any]
    starts_from_x0: bool
    dx0: Mapping[str, Floats]

    def gradient(self, cost: Any) -> dict[str, Any]:
        """The gradient of a cost; see `Trajectory.gradient`."""
        model, parameters = self.model, self.parameters
        start, by_parameters, by_sources = self.steps.gradient(*self._by_samples(cost))
        found: dict[str, Any] = dict(zip(model.parameters, by_parameters.tolist(), strict=True))
        # A given state depends on no parameter, except as dx0 says.
        names = [n for n in differentiable(model) if n not in self.dx0]
        moved = [n for n in names if not (self.starts_from_x0 and n in model.parameters)]
        followed = initial_derivatives(model, self.t, self.steps.start, parameters, self.inputs, moved)
        for name, derivative in (followed | dict(self.dx0)).items():
            found[name] = found.get(name, 0.0) + float(start @ derivative)
        for name in moving_breakpoints(model, parameters, model.parameters):
            del found[name]
        return found | by_values(model, self.inputs, by_sources)

    def _by_samples(self, cost: Any) -> tuple[Floats, Floats | None]:
        """The cost's derivatives by the samples' states and outputs, a row for each sample."""
        model, n_t = self.model, self.n_t
        by_states, by_outputs = np.zeros((n_t, model.n_x)), np.zeros((n_t, model.n_o))
        if is_mapping(cost):
            for name, values in named(cost, (*model.states, *model.outputs), "state or output").items():
                row = numbers(values, f"The derivative of the cost by {name}")
                if row.shape not in ((), (n_t,)):
                    raise ModelError(
                        f"The derivative of the cost by {name} must have the shape ({n_t},), not {row.shape}."
                    )
                of, names = (by_states, model.states) if name in model.states else (by_outputs, model.outputs)
                of[:, names.index(name)] = row
        else:
            by_states = numbers(cost, "The derivatives of the cost").T
            if by_states.shape != (n_t, model.n_x):
                raise ModelError(
                    f"The derivatives of the cost by the states must have the shape ({model.n_x}, {n_t}) of the states "
                    f"over time, not {by_states.T.shape}; or give a mapping from names of states and outputs to arrays "
                    f"of shape ({n_t},)."
                )
        if not (np.isfinite(by_states).all() and np.isfinite(by_outputs).all()):
            raise ModelError("The derivatives of the cost must be finite.")
        return by_states, by_outputs if by_outputs.any() else None


def output_sensitivity(
    model: Kernel,
    t: Floats,
    y: Floats,
    r: Floats,
    parameters: Floats | None,
    inputs: Mapping[Any, Any],
    sensitivity: Mapping[str, Floats],
) -> dict[str, Floats]:
    """The derivatives of the outputs at samples, (n_o, n_t), from those of the states; by names."""
    model.require_output_derivatives(model.outputs)
    given = {name_of(key) for key in inputs}
    in_force = np.array([entry["of"] not in given for entry in model.manifest["inputs"]], dtype=bool)
    p = np.array([*model.defaults.values()], dtype=float) if parameters is None else parameters
    jacobians = Jacobians(model, t, np.ascontiguousarray(y), p, np.ascontiguousarray(r), in_force)
    by_variables = []
    for variables in ("state", "parameters"):
        jacobians.differentiate(variables, True)
        jacobians.evaluate(0, len(t))
        by_variables.append(jacobians.results[1])
    by_state, by_parameters = by_variables
    found = {}
    for name, changes in sensitivity.items():
        found[name] = np.einsum("nox,xn->on", by_state, changes)
        if name in model.parameters:
            found[name] += by_parameters[:, :, model.parameters.index(name)].T
    return found
