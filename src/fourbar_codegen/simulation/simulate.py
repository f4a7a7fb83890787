"""Simulation: a right-hand side is made of the options, and handed to an integrator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state
from fourbar_codegen.arguments import Values, finite_number, named_array
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.consistency import check_start, consistent, projects
from fourbar_codegen.kernel.inputs import InputSource, bind
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.progress import PATIENCE, Progress
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.integrator import Ode, Stepper
from fourbar_codegen.simulation.discontinuities import jumps
from fourbar_codegen.simulation.integrate import Result, integrate
from fourbar_codegen.simulation.options import FIXED_STEP, RunOptions

__all__ = ["make_stepper", "simulate"]

Floats = NDArray[np.float64]

GROWN = 1e3
"""The energy of a run has grown beyond reason where it ends with so many times the largest kinetic energy of its first
half, and the range of its potential energy. A constant force makes 4 times that of the first half, a constant power
twice as much; what a load feeds that goes with the motion grows exponentially."""

SAMPLES = 100
"""States along a run whose energies are compared."""

COORDINATES_ALONE = " In index 3 the tolerance holds for the coordinates of a step alone; speeds are less exact."


def simulate(model: Kernel, options: RunOptions) -> Trajectory:
    """Integrate the equations of motion; see `CompiledModel.simulate`."""
    (start, end), p, inputs = options.t_span, options.parameters, options.inputs
    state = initial_state(model, t=start, parameters=p, inputs=inputs) if options.x0 is None else options.x0
    ode = bind(model, p, inputs)
    if options.stabilization is not None:
        ode.stabilization = options.stabilization
    check_start(model, ode, start, state, p, passes=options.method == FIXED_STEP)
    with Progress(model.name, unwatched=PATIENCE) as progress:

        def show(t: float) -> None:
            progress.stage(f"simulating, t = {t:.6g} of {end:g} s")

        report = show if options.progress is None else options.progress or None
        result = integrate(model, ode, state, options, report)
    message = result.message + _growth(model, ode, result)
    return Trajectory(
        model=model,
        parameters=p,
        t=result.t,
        y=result.y,
        r=ode.inputs_along(result.t, result.y),
        sol=result.sol,
        t_events=result.t_events,
        y_events=result.y_events,
        nfev=result.nfev,
        njev=result.njev,
        nlu=result.nlu,
        status=result.status,
        success=result.status >= 0,
        message=message + (COORDINATES_ALONE if options.formulation == "index-3" else ""),
        settings=options.settings(),
        inputs=inputs or {},
    )


def _growth(model: Kernel, ode: Ode, result: Result) -> str:
    """A sentence, if the energy has grown beyond reason; see GROWN."""
    end, _ = result.last

    def energies(t: float, x: Floats) -> tuple[float, float]:
        kinetic, potential = ode.energies(t, x)
        return kinetic, potential if model.manifest["has_potential_energy"] else 0.0

    n = len(result.t)
    if not n:
        return ""
    first, last = energies(result.t[0], result.y[:, 0]), energies(*result.last)
    if last[0] <= GROWN * first[0]:  # of most runs the ends tell it
        return ""
    samples = np.linspace(0, n - 1, min(n, SAMPLES), dtype=int)
    passed = [(result.t[i], *energies(result.t[i], result.y[:, i])) for i in samples]
    first_half = [kinetic for t, kinetic, _ in passed if abs(t - passed[0][0]) <= abs(end - t)]
    potentials = [last[1], *(potential for *_, potential in passed)]
    if not 0.0 < GROWN * max(*first_half, max(potentials) - min(potentials)) < last[0]:
        return ""
    return f" The energy has grown from {sum(first):.6g} J to {sum(last):.6g} J: loads feed the motion, or errors do."


def make_stepper(
    model: Kernel,
    h: float,
    x0: ArrayLike | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    constraints: str,
) -> Stepper:
    """Steps of one length; see `CompiledModel.stepper`."""
    h, t = finite_number(h, "h"), finite_number(t, "t")
    if h == 0.0:
        raise ModelError("The step h must not be 0.")
    closes = projects(model, constraints)
    p = model.parameter_vector(parameters)
    if x0 is None:
        state = initial_state(model, t=t, parameters=p, inputs=inputs)
    else:
        state = named_array(x0, model.states, {}, "state")
    ode = bind(model, p, inputs)
    check_start(model, ode, t, state, p)
    start = consistent(ode, t, state) if closes else state
    boundaries = jumps(ode, t, math.copysign(math.inf, h), start)
    return Stepper(ode, h, t, start, closes, jumps=[(at.end, at.begin) for at in boundaries])
