"""Parts that are compiled after the kernel, compared with it: derivatives with differences, batches with single states.

The kernel itself was compared with the equations when it was compiled; see `verify`. These parts are compiled later,
when neither SymPy nor the equations are available.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import BuildError, SimulationError
from fourbar_codegen.layout import ShapeKind
from fourbar_codegen.runtime.batch import Batch, width
from fourbar_codegen.runtime.functions import Functions

__all__ = ["compare_batch_functions", "compare_derivatives", "compare_drawing", "compare_products"]

Floats = NDArray[np.float64]
Function = Callable[..., Floats]
Products = list[tuple[str, Floats, Floats, Floats]]

N_STATES = 2
MAX_ATTEMPTS = 8
STEP = 2e-4
"""Step h of central differences, relative to large variables. After extrapolation, the truncation error is h^4 / 480
times the fifth derivative, and the rounding error about 1e-12."""

RIGID_RTOL = 1e-9
"""Tolerance for lengths of links and for rotations, which follow from some hundred operations."""

NARROW_STEP = 1e-8
"""Step of one-sided differences, for functions with stairs, such as readings of an encoder: their derivative is that
between jumps, but differences wider than a stair give the mean slope."""

DERIVATIVE_RTOL = 1e-6
"""Tolerance for derivatives against accurate differences, relative to the largest entry of the matrix."""

ROUNDING_RTOL = 4 * np.finfo(float).eps
"""Smallest relative rounding error of a function's value; differences of forces of 1e20 N show no changes by others."""

BATCH_RTOL = 1e-8
"""Relative tolerance for rates of batches of states against those of single states: sines differ in the last bit, and
the equations may be ill-conditioned."""


N_NEIGHBOURS = 4
"""Number of states whose arguments differ from those of a state by rounding errors, to see what becomes of these."""

NEIGHBOUR_RATIO = 16.0
"""Multiple of the largest change among neighbours that rounding errors may reach, since they are only a sample."""

DEFECT = (
    "That is a defect of the C compiler, its flags, or this package. Try other CFLAGS, or another compiler in CC; "
    "check=False compiles without this comparison."
)


def compare_derivatives(model: Functions) -> None:
    """Compare derivatives with extrapolated differences of the kernel's functions, at random states.

    Differences on which two step sizes disagree, as near singular positions and kinks, are skipped.

    Parameters
    ----------
    model : Functions
        With derivatives attached.

    Raises
    ------
    BuildError
        If one differs.

    Source: L. F. Richardson, "The approximate arithmetical solution by finite differences of physical problems",
    *Philosophical Transactions of the Royal Society A* 210 (1911).
    """
    _compare(model, "derivatives of x'", _compare_derivatives_at)


def compare_drawing(model: Functions) -> None:
    """Compare positions and orientations at random states: links keep their lengths, and rotations are orthonormal.

    States with invariants that do not hold, such as quaternions of other norms than one, are skipped.

    Parameters
    ----------
    model : Functions
        With positions and orientations attached.

    Raises
    ------
    BuildError
        If a link has other lengths at another state, or a matrix is no rotation.
    """
    generator, links = random.Random(0), [[*s.points] for s in model.layout.drawing.shapes if s.kind == ShapeKind.LINK]
    before: list[Floats] = []
    _, _, p, _ = _arguments(model, generator)
    for attempt in range(MAX_ATTEMPTS):
        t, x, _, r = _arguments(model, generator, at_beginning=attempt == 0)
        with np.errstate(all="ignore"):
            if not (np.abs(model.constraint_violation(t, x, p, r)[0][model.n_c :]) <= RIGID_RTOL).all():
                continue
            positions, _ = model.drawing(t, x, p, r)
            rotations = model.orientations_along([t], x[:, np.newaxis], r[:, np.newaxis], p)[..., 0]
            lengths = [np.linalg.norm(positions[link][:, np.newaxis] - positions[link], axis=2) for link in links]
            error = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
            size = 1.0 + np.abs(positions[np.isfinite(positions)]).max(initial=0.0)
        changes = [np.abs(a - b).max() for a, b in zip(before, lengths, strict=False)]
        if error > RIGID_RTOL or any(change > RIGID_RTOL * size for change in changes):
            raise BuildError(
                f"The compiled positions and orientations of the model {model.layout.name} are\n{positions}\n"
                f"{rotations}\nat a random state, where a link is not as long as at another one, or a matrix is no "
                f"rotation.\n{DEFECT}"
            )
        before = lengths


def compare_products(model: Functions) -> None:
    """Compare products of derivatives with random vectors: with matrices, differences, and reverse with forward mode.

    Parameters
    ----------
    model : Functions
        With derivatives and their products attached.

    Raises
    ------
    BuildError
        If one differs.
    """
    _compare(model, "products of derivatives of x' with vectors", _compare_products_at)


def _compare(model: Functions, what: str, at: Callable[[Functions, float, Floats, Floats, Floats], None]) -> None:
    generator, compared, is_defined = random.Random(0), 0, False
    # Derivatives with redundant constraints are unique along the constraints only.
    is_redundant = model.n_c > model.layout.n_dependent_speeds
    attempts = MAX_ATTEMPTS if is_redundant else MAX_ATTEMPTS + 1
    for attempt in range(attempts):
        t, x, p, r = _arguments(model, generator, at_beginning=attempt == MAX_ATTEMPTS)
        try:
            with np.errstate(all="ignore"):
                at(model, t, x, p, r)
        except SimulationError:  # the equations have no value there, or no solution: perhaps nothing has a mass
            is_defined |= all(np.isfinite(part).all() for part in model.dynamics(t, x, p, r))
            continue
        compared += 1
        if compared >= N_STATES:
            return
    if not compared:
        message = "%s: %s not compared, since the equations have no solution at any of %d states"
        level = logging.INFO if is_defined else logging.WARNING
        logging.getLogger("fourbar_codegen").log(level, message, model.layout.name, what, attempts)


def _compare_products_at(model: Functions, t: float, x: Floats, p: Floats, r: Floats) -> None:
    generator = np.random.default_rng(0)
    sizes = (model.n_x, model.n_p, model.n_r)
    dx, dp, dr = (generator.uniform(-1.0, 1.0, size) for size in sizes)
    w, v = generator.uniform(-1.0, 1.0, model.n_x), generator.uniform(-1.0, 1.0, 2 * model.n_c + model.n_i)

    along = np.concatenate((dx, dp))

    # What is compared, the result, the expected one, and the terms of both.
    def of_constraints(x: Floats, p: Floats, r: Floats) -> Products:
        changes = np.concatenate(model.constraint_jvp(t, x, along[:, np.newaxis], p, r))[:, 0]
        pulled = model.constraint_vjp(t, x, v, p, r)[: model.n_x + model.n_p]
        return [
            ("constraint violations along a direction", changes, changes, changes),
            ("gradient of constraint violations", np.atleast_1d(pulled @ along), np.atleast_1d(v @ changes), changes),
        ]

    def of_rates(x: Floats, p: Floats, r: Floats) -> Products:
        matrices = (model.jacobian(t, x, p, r), model.parameter_jacobian(t, x, p, r), model.input_jacobian(t, x, p, r))
        terms = [matrix * part for matrix, part in zip(matrices, (dx, dp, dr), strict=True)]
        gradient = np.concatenate([w @ matrix for matrix in matrices])
        rates = sum((part.sum(axis=1) for part in terms), np.zeros(model.n_x))
        return [
            ("dx' along a direction", model.jvp(t, x, dx, dp, dr, p, r), rates, np.hstack(terms)),
            ("gradient of weights times x'", np.concatenate(model.vjp(t, x, w, p, r)), gradient, gradient),
        ]

    def violations(s: Floats) -> Floats:
        return np.concatenate(model.constraint_violation(t, x + s * dx, p + s * dp, r))

    def compare(products: Callable[[Floats, Floats, Floats], Products], found: Products) -> None:
        for place, (what, got, wanted, size) in enumerate(found):

            def both(*arguments: Floats, place: int = place) -> Floats:
                return np.concatenate(products(*arguments)[place][1:3])

            largest = np.abs(size[np.isfinite(size)]).max(initial=0.0)
            if not _agree(got, wanted, DERIVATIVE_RTOL * (1.0 + largest), partial(_rounding, both, x, p, r)):
                raise BuildError(
                    f"The compiled product {what} of the model {model.layout.name} is\n{got}\nat a random state, "
                    f"where it should be\n{wanted}\n{DEFECT}"
                )

    [(what, changes, *_), *others] = of_constraints(x, p, r)
    expected, sure = _differences(violations, np.zeros(1))
    compare(of_constraints, [(what, changes, np.where(sure[:, 0], expected[:, 0], changes), expected), *others])
    compare(of_rates, of_rates(x, p, r))  # which needs a solution of the equations


def _compare_derivatives_at(model: Functions, t: float, x: Floats, p: Floats, r: Floats) -> None:
    n_q, n_u = model.n_q, model.n_u

    def velocities(x: Floats, r: Floats) -> Floats:
        jacobian, bias = model.velocity(t, x, p, r)
        return jacobian @ x[n_q : n_q + n_u] + bias

    def outputs(x: Floats, p: Floats, r: Floats) -> Floats:
        return model.outputs_for(t, x, *model.accelerations(t, x, p, r), p, r)

    def at(q: Floats) -> Floats:
        return np.concatenate((q, x[n_q:]))

    of_constraints, of_inputs = model.constraint_partials, model.default_input_partials
    pairs: list[tuple[str, Function, Function, Floats]] = [  # first what needs no solution of the equations
        ("d(J u + b)/dq", lambda *a: of_constraints(t, *a)[0], lambda q: velocities(at(q), r), x[:n_q]),
        ("d(J u + b)/dr", lambda *a: of_constraints(t, *a)[2], lambda r: velocities(x, r), r),
        ("dPhi/dr", lambda *a: of_constraints(t, *a)[1], lambda r: model.position(t, x[:n_q], p, r)[0], r),
        ("dr/dp", lambda *a: of_inputs(t, a[1]), lambda p: model.default_inputs(t, p), p),
        ("dx'/dx", lambda *a: model.jacobian(t, *a), lambda x: model.rhs(t, x, p, r), x),
        ("dx'/dp", lambda *a: model.parameter_jacobian(t, *a), lambda p: model.rhs(t, x, p, r), p),
        ("dx'/dr", lambda *a: model.input_jacobian(t, *a), lambda r: model.rhs(t, x, p, r), r),
    ]
    if model.n_o and not model.layout.undetermined_outputs:
        pairs += [
            ("dy/dx", lambda *a: model.output_jacobian(t, *a), lambda x: outputs(x, p, r), x),
            ("dy/dp", lambda *a: model.output_parameter_jacobian(t, *a), lambda p: outputs(x, p, r), p),
            ("dy/dr", lambda *a: model.output_input_jacobian(t, *a), lambda r: outputs(x, p, r), r),
        ]
    for what, derivative, function, point in pairs:
        got = derivative(x, p, r)
        expected, sure = _differences(function, point)
        largest = np.abs(expected[np.isfinite(expected)]).max(initial=0.0)

        def rounding(derivative: Function = derivative, function: Function = function, point: Floats = point) -> float:
            """Of the derivative, and of the differences."""
            return _rounding(derivative, x, p, r) + _rounding(function, point) / STEP

        tolerance = DERIVATIVE_RTOL * (1.0 + largest)
        wanted = np.where(sure, expected, got)
        if _agree(got, wanted, tolerance, rounding):
            continue
        tolerated = tolerance + NEIGHBOUR_RATIO * _rounding(function, point) / NARROW_STEP
        is_right = (np.abs(_one_sided_differences(function, point) - got) <= tolerated).any(axis=0)
        if not _agree(got, np.where(is_right, got, wanted), tolerance, rounding):
            raise BuildError(
                f"The compiled derivative {what} of the model {model.layout.name} is\n{got}\nat a random state, "
                f"where differences give\n{expected}\n{DEFECT}"
            )


def _agree(got: Floats, wanted: Floats, tolerance: float, rounding: Callable[[], float]) -> bool:
    """Whether results agree to a tolerance, or else to rounding errors, which are found only then."""
    errors = np.abs(got - wanted)[np.isfinite(wanted)]
    return bool((errors <= tolerance).all() or (errors <= tolerance + NEIGHBOUR_RATIO * rounding()).all())


def _rounding(function: Function, *arguments: Floats) -> float:
    """The largest change of a function's values where its arguments change by rounding errors.

    Where terms cancel, as in the equations of a body far lighter than others, it is far larger than the precision.

    Source: D. S. Parker, "Monte Carlo arithmetic: exploiting randomness in floating-point arithmetic", University of
    California, Los Angeles, CSD-970002 (1997).
    """
    generator, values = np.random.default_rng(0), function(*arguments)
    changes = [
        function(*(each * (1.0 + ROUNDING_RTOL * generator.uniform(-1.0, 1.0, each.shape)) for each in arguments))
        - values
        for _ in range(N_NEIGHBOURS)
    ]
    return float(np.abs(changes)[np.isfinite(changes)].max(initial=0.0))


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
            return (ahead - behind) / width, ROUNDING_RTOL * np.maximum(np.abs(ahead), np.abs(behind)) / width

        (coarse, _), (fine, _), (finest, rounded) = slope(2.0 * step), slope(step), slope(0.5 * step)
        before, after = fine + (fine - coarse) / 3.0, finest + (finest - fine) / 3.0
        columns.append(after)
        sure.append(np.abs(after - before) + rounded <= 0.1 * DERIVATIVE_RTOL * (1.0 + np.abs(after).max(initial=0.0)))
    if not columns:
        return np.zeros((*size, 0)), np.zeros((*size, 0), dtype=bool)
    return np.stack(columns, axis=-1), np.stack(sure, axis=-1)


def _one_sided_differences(function: Function, point: Floats) -> Floats:
    """Narrow differences of a function ahead of a point and behind it, one of which at most reaches across a jump."""
    here, sides = function(point), []
    for step in (NARROW_STEP, -NARROW_STEP):
        moved = point + np.diag(step * np.maximum(np.abs(point), 1.0))
        widths = np.diag(moved) - point
        sides.append(np.stack([(function(x) - here) / width for x, width in zip(moved, widths, strict=True)], axis=-1))
    return np.array(sides)


def compare_batch_functions(model: Functions) -> None:
    """Compare rates of a batch of states with those of single states, at random states.

    Raises
    ------
    BuildError
        If they differ.
    """
    generator = random.Random(0)
    n = 2 * width(model) + 1  # full vectors and a remainder
    arguments = [_arguments(model, generator, at_beginning=i == n - 1) for i in range(n)]
    t, x, p, r = (np.array(columns).T.copy() for columns in zip(*arguments, strict=True))
    rates = np.empty_like(x)
    Batch(model, t, x, p, r, rates).evaluate(0, n)
    for i, (time, state, parameters, inputs) in enumerate(arguments):

        def single(*arguments: Floats, time: float = time) -> Floats:
            return model.rhs(time, *arguments)

        try:
            expected = single(state, parameters, inputs)
            rounding = partial(_rounding, single, state, parameters, inputs)
            agree = _agree(rates[:, i], expected, BATCH_RTOL * (1.0 + np.abs(expected).max(initial=0.0)), rounding)
        except SimulationError:
            continue
        if not agree:
            raise BuildError(
                f"The compiled right-hand side of the model {model.layout.name} for batches of states "
                f"gives\n{rates[:, i]}\nat a random state, and that for one state\n{expected}\n{DEFECT}"
            )


def _arguments(
    model: Functions, generator: random.Random, *, at_beginning: bool = False
) -> tuple[float, Floats, Floats, Floats]:
    """Time, state, parameters and inputs, as `verify` takes them; the state may be that of the initial values."""

    def numbers(n: int, low: float, high: float) -> Floats:
        return np.array([generator.uniform(low, high) for _ in range(n)])

    defaults = np.array([entry.default for entry in model.layout.parameters], dtype=float)
    p = np.where(np.isnan(defaults), numbers(model.n_p, 0.5, 1.5), defaults)
    t, x, r = generator.uniform(-1.0, 1.0), numbers(model.n_x, -1.0, 1.0), numbers(model.n_r, -1.0, 1.0)
    if at_beginning:
        initial = model.layout.initial
        x = np.array([initial.get(name, 0.0) for name in model.layout.states])
    return t, x, p, r
