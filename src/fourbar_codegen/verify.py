"""The compiled functions against the equations they were made from, right after compilation.

What lies between both is SymPy's `cse` and printer, hoisting, inlining, splitting, and the C compiler. The equations
are evaluated in Python, statement by statement as they were formed, at random states.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.equations import Equations
from fourbar_codegen.errors import BuildError, SimulationError
from fourbar_codegen.program import Result
from fourbar_codegen.tape import Scalar

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel

__all__ = ["verify"]

Floats = NDArray[np.float64]

STATES = 2
ATTEMPTS = 8
# Both sides round differently, and terms may cancel; a wrong sign or symbol is off by far more.
TOLERANCE = 1e-7


def verify(equations: Equations, compiled: CompiledModel) -> None:
    """Compare all functions of a compiled model with its equations.

    Parameters
    ----------
    equations : Equations
    compiled : CompiledModel

    Raises
    ------
    BuildError
        If one does not agree; it names the function and shows both values.

    Notes
    -----
    States at which the equations have no real value are passed over. Where none of them has one, nothing is
    compared.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> from fourbar_codegen.equations import form_equations
    >>> verify(form_equations(fb.models.four_bar()), fb.load("four_bar"))
    """
    generator = random.Random(0)
    compared = 0
    for _ in range(ATTEMPTS):
        values = _random_values(equations, compiled, generator)
        try:
            expected = _evaluate(equations, values)
        except (ArithmeticError, ValueError, TypeError):
            continue
        for function, results in _compiled_results(equations, compiled, values).items():
            for result, got in results:
                _compare(compiled.name, function, result, got, expected[result.name])
        _compare_solution(compiled, expected, values, equations)
        compared += 1
        if compared == STATES:
            return


def _random_values(e: Equations, compiled: CompiledModel, generator: random.Random) -> dict[Scalar, float]:
    values = {
        leaf: generator.uniform(-1.0, 1.0)
        for leaf in (e.time, *e.coordinates, *e.speeds, *e.inputs, *e.accelerations, *e.multipliers)
    }
    for leaf, default in zip(e.parameters, compiled.defaults.values(), strict=True):
        values[leaf] = generator.uniform(0.5, 1.5) if default is None else default
    return values


def _results(e: Equations) -> list[Result]:
    return [value for value in vars(e).values() if isinstance(value, Result)]


def _evaluate(e: Equations, values: Mapping[Scalar, float]) -> dict[str, Floats]:
    results = _results(e)
    numbers = iter(e.tape.evaluate([entry for result in results for entry in result.entries], values))
    return {r.name: np.array([next(numbers) for _ in r.entries]).reshape(r.shape) for r in results}


def _arrays(e: Equations, values: Mapping[Scalar, float]) -> list[Floats]:
    groups = ((*e.coordinates, *e.speeds), e.parameters, e.inputs, e.accelerations, e.multipliers)
    return [np.array([values[leaf] for leaf in group]) for group in groups]


def _compiled_results(
    e: Equations, compiled: CompiledModel, values: Mapping[Scalar, float]
) -> dict[str, Sequence[tuple[Result, Floats]]]:
    """What every compiled function gives, beside the results that it is to give."""
    t = values[e.time]
    x, p, r, accelerations, multipliers = _arrays(e, values)
    outputs, *sensitivities = compiled.held(t, x, accelerations, multipliers, p, r)
    got = {
        "default_inputs": ([e.default_inputs], [compiled.default_inputs(t, p)]),
        "dynamics": (
            [e.coordinate_rates, e.mass_matrix, e.forcing, e.constraint_jacobian, e.acceleration_bias],
            compiled.dynamics(t, x, p, r),
        ),
        "position": ([e.position_constraints, e.position_jacobian], compiled.position(t, x[: compiled.n_q], p, r)),
        "velocity": ([e.constraint_jacobian, e.velocity_bias], compiled.velocity(t, x, p, r)),
        "constraint_sensitivity": (
            [e.velocity_jacobian, e.position_input_jacobian, e.velocity_input_jacobian],
            compiled.constraint_sensitivity(t, x, p, r),
        ),
        "energy": ([e.energies], [compiled.energy(t, x, p, r)]),
        "output": ([e.outputs], [outputs]),
        "sensitivity": ([e.coordinate_rate_jacobian, e.residual_jacobian], sensitivities[0:2]),
        "parameter_sensitivity": (
            [e.coordinate_rate_parameter_jacobian, e.residual_parameter_jacobian],
            sensitivities[2:4],
        ),
        "input_sensitivity": ([e.coordinate_rate_input_jacobian, e.residual_input_jacobian], sensitivities[4:6]),
    }
    return {function: tuple(zip(results, arrays, strict=True)) for function, (results, arrays) in got.items()}


def _compare(model: str, function: str, result: Result, got: Floats, expected: Floats) -> None:
    known = np.array([not entry.is_nan for entry in result.entries], dtype=bool).reshape(result.shape)
    error = np.where(known, np.abs(got - expected), 0.0)
    finite = expected[np.isfinite(expected)]
    agree = (error <= TOLERANCE * (1.0 + np.abs(finite).max(initial=0.0))) | (np.isnan(got) & np.isnan(expected))
    if not agree.all():
        _fail(model, f"function {function}, result {result.name},", got, expected)


def _compare_solution(
    compiled: CompiledModel, expected: Mapping[str, Floats], values: Mapping[Scalar, float], e: Equations
) -> None:
    """M u' = f + J^T lambda and J u' + gamma = 0 for what the compiled solve gives."""
    x, p, r, *_ = _arrays(e, values)
    try:
        accelerations, multipliers = compiled.accelerations(values[e.time], x, p, r)
    except SimulationError:
        return  # a singular state
    jacobian = expected["constraint_jacobian"]
    reactions = jacobian.T @ multipliers
    inertia = expected["mass_matrix"] @ accelerations
    _compare_sum(compiled.name, "M u' = f + J^T lambda", inertia, expected["forcing"] + reactions)
    _compare_sum(compiled.name, "J u' + gamma = 0", jacobian @ accelerations, -expected["acceleration_bias"])


def _compare_sum(model: str, what: str, got: Floats, expected: Floats) -> None:
    size = max(np.abs(got).max(initial=0.0), np.abs(expected).max(initial=0.0))
    if not (np.abs(got - expected) <= 1e-3 * (1.0 + size)).all():
        _fail(model, f"solution of {what}", got, expected)


def _fail(model: str, what: str, got: Floats, expected: Floats) -> None:
    raise BuildError(
        f"The compiled {what} of model {model} gives\n{got}\ninstead of\n{expected}\nat a random state: a defect of "
        "the C compiler, its flags, or this package. Try other CFLAGS, or another compiler in CC; check=False "
        "compiles without this comparison."
    )
