"""Parts that are compiled after the kernel, compared with it: derivatives with differences, batches with single states.

The kernel itself was compared with the equations when it was compiled; see `verify`. These parts are compiled later,
when neither SymPy nor the equations are available.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import BuildError, SimulationError
from fourbar_codegen.runtime.batch import Batch, width
from fourbar_codegen.runtime.evaluator import Evaluator

__all__ = ["compare_batch_functions", "compare_derivatives", "compare_variations"]

Floats = NDArray[np.float64]

STATES = 2
ATTEMPTS = 8
STEP = 2e-4
"""Step h of central differences, relative to large variables. After extrapolation, the truncation error is h^4 / 480
times the fifth derivative, and the rounding error about 1e-12."""

TOLERANCE = 1e-6
"""Tolerance for derivatives against accurate differences, relative to the largest entry of the matrix."""

ROUNDED = 4 * np.finfo(float).eps
"""Smallest relative rounding error of a function's value; differences of forces of 1e20 N show no changes by others."""

ALONE = 1e-8
"""Relative tolerance for rates of states side by side against those of single states: sines differ in the last bit, and
the equations may be ill-conditioned."""


DEFECT = "That is a defect of the C compiler, its flags, or this package. Try other CFLAGS, or another compiler in CC."


def compare_derivatives(model: Evaluator) -> None:
    """Compare derivatives with extrapolated differences of the kernel's functions, at random states.

    Differences on which two step sizes disagree, as near singular positions and kinks, are skipped.

    Parameters
    ----------
    model : Evaluator
        With derivatives attached.

    Raises
    ------
    BuildError
        If one differs.

    Source: L. F. Richardson, "The approximate arithmetical solution by finite differences of physical problems",
    *Philosophical Transactions of the Royal Society A* 210 (1911).
    """
    _compare(model, _compare_derivatives_at)


def compare_variations(model: Evaluator) -> None:
    """Compare products of derivatives with random vectors: with matrices, differences, and reverse with forward mode.

    Parameters
    ----------
    model : Evaluator
        With derivatives and variations attached.

    Raises
    ------
    BuildError
        If one differs.
    """
    _compare(model, _compare_variations_at)


def _compare(model: Evaluator, at: Callable[[Evaluator, float, Floats, Floats, Floats], None]) -> None:
    generator, compared = random.Random(0), 0
    for _ in range(ATTEMPTS):
        t, x, p, r = _arguments(model, generator)
        try:
            with np.errstate(all="ignore"):
                at(model, t, x, p, r)
        except SimulationError:  # the equations have no value there
            continue
        compared += 1
        if compared >= STATES:
            return


def _compare_variations_at(model: Evaluator, t: float, x: Floats, p: Floats, r: Floats) -> None:
    generator = np.random.default_rng(0)
    sizes = (model.n_x, model.n_p, model.n_r)
    dx, dp, dr = (generator.uniform(-1.0, 1.0, size) for size in sizes)
    w, v = generator.uniform(-1.0, 1.0, model.n_x), generator.uniform(-1.0, 1.0, 2 * model.n_c + model.n_i)

    def violations(s: Floats) -> Floats:
        return np.concatenate(model.constraint_violation(t, x + s * dx, p + s * dp, r))

    matrices = (model.jacobian(t, x, p, r), model.parameter_jacobian(t, x, p, r), model.input_jacobian(t, x, p, r))
    rates = model.jvp(t, x, dx, dp, dr, p, r)
    products = [matrix * part for matrix, part in zip(matrices, (dx, dp, dr), strict=True)]
    gradient = np.concatenate([w @ matrix for matrix in matrices])
    changes = np.concatenate(model.constraint_variation(t, x, np.concatenate((dx, dp))[:, np.newaxis], p, r))[:, 0]
    pulled = model.constraint_pullback(t, x, v, p, r)[: model.n_x + model.n_p]
    expected, sure = _differences(violations, np.zeros(1))
    for what, got, wanted, size in (
        ("dx' along a direction", rates, sum(part.sum(axis=1) for part in products), np.hstack(products)),
        ("gradient of weights times x'", np.concatenate(model.vjp(t, x, w, p, r)), gradient, gradient),
        ("constraint violations along a direction", changes[sure[:, 0]], expected[sure], expected),
        ("gradient of constraint violations", pulled @ np.concatenate((dx, dp)), v @ changes, changes),
    ):
        largest = np.abs(size[np.isfinite(size)]).max(initial=0.0)
        if not (np.abs(got - wanted) <= TOLERANCE * (1.0 + largest))[np.isfinite(wanted)].all():
            raise BuildError(
                f"The compiled product {what} of the model {model.manifest['name']} is\n{got}\nat a random state, "
                f"where it should be\n{wanted}\n{DEFECT}"
            )


def _compare_derivatives_at(model: Evaluator, t: float, x: Floats, p: Floats, r: Floats) -> None:
    n_q, n_u = model.n_q, model.n_u

    def velocities(x: Floats, r: Floats) -> Floats:
        jacobian, bias = model.velocity(t, x, p, r)
        return jacobian @ x[n_q : n_q + n_u] + bias

    def outputs(x: Floats, p: Floats, r: Floats) -> Floats:
        return model.outputs_for(t, x, *model.accelerations(t, x, p, r), p, r)

    def at(q: Floats) -> Floats:
        return np.concatenate((q, x[n_q:]))

    by_coordinates, positions_by_inputs, velocities_by_inputs = model.constraint_sensitivity(t, x, p, r)
    pairs: list[tuple[str, Floats, Callable[[Floats], Floats], Floats]] = [
        ("dx'/dx", model.jacobian(t, x, p, r), lambda x: model.rhs(t, x, p, r), x),
        ("dx'/dp", model.parameter_jacobian(t, x, p, r), lambda p: model.rhs(t, x, p, r), p),
        ("dx'/dr", model.input_jacobian(t, x, p, r), lambda r: model.rhs(t, x, p, r), r),
        ("d(J u + b)/dq", by_coordinates, lambda q: velocities(at(q), r), x[:n_q]),
        ("d(J u + b)/dr", velocities_by_inputs, lambda r: velocities(x, r), r),
        ("dPhi/dr", positions_by_inputs, lambda r: model.position(t, x[:n_q], p, r)[0], r),
        ("dr/dp", model.default_input_sensitivity(t, p), lambda p: model.default_inputs(t, p), p),
    ]
    if model.n_o and not model.manifest["open_outputs"]:
        pairs += [
            ("dy/dx", model.output_jacobian(t, x, p, r), lambda x: outputs(x, p, r), x),
            ("dy/dp", model.output_parameter_jacobian(t, x, p, r), lambda p: outputs(x, p, r), p),
            ("dy/dr", model.output_input_jacobian(t, x, p, r), lambda r: outputs(x, p, r), r),
        ]
    for what, got, function, point in pairs:
        expected, sure = _differences(function, point)
        largest = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)
        wrong = sure & ~(np.abs(got - expected) <= TOLERANCE * (1.0 + largest))
        if wrong.any():
            raise BuildError(
                f"The compiled derivative {what} of the model {model.manifest['name']} is\n{got}\nat a random state, "
                f"where differences give\n{expected}\n{DEFECT}"
            )


def _differences(function: Callable[[Floats], Floats], point: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """The derivatives of a function at a point, by central differences, and for which of them two step sizes agree."""
    columns, sure = [], []
    size = np.shape(function(point))
    for i in range(len(point)):
        step = STEP * max(abs(point[i]), 1.0)

        def slope(h: float, i: int = i) -> tuple[Floats, Floats]:
            """A difference quotient, and its rounding error."""
            moved = [point.copy(), point.copy()]
            moved[0][i] += h
            moved[1][i] -= h
            ahead, behind = map(function, moved)
            width = float(moved[0][i] - moved[1][i])
            return (ahead - behind) / width, ROUNDED * np.maximum(np.abs(ahead), np.abs(behind)) / width

        (coarse, _), (fine, _), (finest, rounded) = slope(2.0 * step), slope(step), slope(0.5 * step)
        before, after = fine + (fine - coarse) / 3.0, finest + (finest - fine) / 3.0
        columns.append(after)
        sure.append(np.abs(after - before) + rounded <= 0.1 * TOLERANCE * (1.0 + np.abs(after).max(initial=0.0)))
    if not columns:
        return np.zeros((*size, 0)), np.zeros((*size, 0), dtype=bool)
    return np.stack(columns, axis=-1), np.stack(sure, axis=-1)


def compare_batch_functions(model: Evaluator) -> None:
    """Compare rates of states side by side with those of single states, at random states.

    Raises
    ------
    BuildError
        If they differ.
    """
    generator = random.Random(0)
    n = 2 * width(model) + 1  # full vectors and a remainder
    arguments = [_arguments(model, generator) for _ in range(n)]
    t, x, p, r = (np.array(columns).T.copy() for columns in zip(*arguments, strict=True))
    rates = np.empty_like(x)
    Batch(model, t, x, p, r, rates).evaluate(0, n)
    for i, (time, state, parameters, inputs) in enumerate(arguments):
        try:
            expected: Any = model.rhs(time, state, parameters, inputs)
        except SimulationError:
            continue
        if not (np.abs(rates[:, i] - expected) <= ALONE * (1.0 + np.abs(expected).max(initial=0.0))).all():
            raise BuildError(
                f"The compiled right-hand side of the model {model.manifest['name']} for several states side by side "
                f"gives\n{rates[:, i]}\nat a random state, and that for one state\n{expected}\n{DEFECT}"
            )


def _arguments(model: Evaluator, generator: random.Random) -> tuple[float, Floats, Floats, Floats]:
    """Time, state, parameters and inputs, as `verify` takes them."""

    def numbers(n: int, low: float, high: float) -> Floats:
        return np.array([generator.uniform(low, high) for _ in range(n)])

    defaults = np.array([entry["default"] for entry in model.manifest["parameters"]], dtype=float)
    p = np.where(np.isnan(defaults), numbers(model.n_p, 0.5, 1.5), defaults)
    return generator.uniform(-1.0, 1.0), numbers(model.n_x, -1.0, 1.0), p, numbers(model.n_r, -1.0, 1.0)
