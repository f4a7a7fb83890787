"""Trajectories of times and states that were not simulated here: measured ones, or the steps of a control loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.arguments import Values, named_columns, numbers
from fourbar_codegen.kernel.inputs import InputSource, bind, held_inputs, own_sources
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.trajectory import GIVEN, Trajectory

__all__ = ["trajectory"]

Floats = NDArray[np.float64]


def trajectory(
    model: Kernel,
    t: ArrayLike,
    x: ArrayLike | Mapping[Any, ArrayLike],
    *,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
) -> Trajectory:
    """A trajectory of given times and states, such as the steps of a control loop, to show, evaluate and save.

    Parameters
    ----------
    t : array_like, shape (n_t,)
        Times in one direction, s.
    x : array_like, shape (n_x, n_t), or mapping from names to arrays of shape (n_t,)
        States in columns. They need not satisfy the constraints: ``constraint_residual`` tells.
    parameters : array_like or mapping, optional
        The defaults otherwise.
    inputs : mapping, optional
        The sources of the inputs, as for `simulate`; what a controller has held are tables of the kind "hold".

    Returns
    -------
    Trajectory
        Without interpolant, events and sensitivities.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite; or the times do not go in one direction.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> import numpy as np
    >>> four_bar = fb.load("four_bar")
    >>> stepper, times, states, forces = four_bar.stepper(0.01), [], [], []
    >>> for _ in range(100):
    ...     times.append(stepper.t)
    ...     states.append(stepper.x.copy())
    ...     forces.append(-20.0 * stepper.x[3])
    ...     x = stepper.step({"F": forces[-1]})
    >>> held = {"F": (times, forces, "hold")}
    >>> run = four_bar.trajectory(times, np.transpose(states), inputs=held)
    >>> run["energy"].shape, bool(abs(run.constraint_residual).max() < 1e-12)
    ((100,), True)
    """
    times = numbers(t, "The times t").copy()
    if times.ndim != 1 or not times.size:
        raise ModelError(f"The times t must have shape (n_t,) with n_t > 0, not {times.shape}.")
    if not np.isfinite(times).all():
        raise ModelError(f"The times t must be finite; t[{int(np.argmin(np.isfinite(times)))}] is not.")
    steps = np.diff(times)
    if not ((steps >= 0.0).all() or (steps <= 0.0).all()):
        raise ModelError("The times t must go in one direction.")
    states = named_columns(x, model.states, {}, "state", times.size)
    if states.shape != (model.n_x, times.size):
        raise ModelError(f"The states x must have shape {(model.n_x, times.size)}, not {states.shape}.")
    if not np.isfinite(states).all():
        row, column = np.argwhere(~np.isfinite(states))[0].tolist()
        raise ModelError(f"The states x must be finite; {model.states[row]} at t[{column}] is not.")
    p = model.parameter_vector(parameters)
    sources = own_sources(model, inputs)
    settings: dict[str, Any] = {"method": GIVEN, "t_span": (float(times[0]), float(times[-1])), "constraints": "none"}
    if held := held_inputs(sources):
        settings["held"] = held
    return Trajectory(
        kernel=model,
        parameters=p,
        t=times,
        y=states.copy(),
        r=bind(model, p, sources).inputs_along(times, states),
        status=0,
        message="The times and states were given.",
        settings=settings,
        inputs=sources,
    )
