"""Checks of the compiled functions against their equations, and of these against mechanics, after compilation.

Common subexpression elimination, hoisting, printing, splitting and the C compiler are checked by evaluating the
equations in Python, node by node as they were formed, at random states. The equations are checked by identities that do
not depend on how they were formed: the kinetic energy is w^T M w / 2 in each direction w of the speeds; its rate is the
power of the loads and of M u' - f; and rates of the constraints equal their differences between states.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import nearest_closed
from fourbar_codegen.dynamics.derivatives import Derivatives
from fourbar_codegen.dynamics.equations import Equations, results_of
from fourbar_codegen.dynamics.random_states import close
from fourbar_codegen.errors import BuildError, ModelError, SimulationError
from fourbar_codegen.expressions.tape import Result, Scalar
from fourbar_codegen.kernel.dependent import INDEPENDENCE_RTOL, row_sizes
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.enumerations import Role

__all__ = ["DISTANCES", "N_STATES", "verify"]

Floats = NDArray[np.float64]

N_STATES = 2
"""Number of states that are compared, if there are as many."""
STEP = 1e-4
DISTANCES = (None,) * 4 + (0.1, 1e-2, 1e-3, 1e-4, 0.0)
"""Distances of the states from the initial values, which are needed where expressions have values only near these, or
there alone."""
MAX_CLOSURES = 16
PARTIALS = (Role.STATE_PARTIALS, Role.PARAMETER_PARTIALS, Role.INPUT_PARTIALS)
OF_MOTION = ("coordinate_rates", "mass_matrix", "forcing", "constraint_jacobian", "acceleration_bias")
# Both sides have different rounding errors, and terms may cancel. A wrong sign or symbol gives far larger differences.
COMPARISON_RTOL = 1e-7
ROUNDING_RTOL = 1e-13
"""Relative rounding errors of a sum's terms, which are results of some hundred operations."""


def verify(compiled: Kernel, equations: Equations, derivatives: Derivatives | None = None) -> int:
    """Compare the functions of a compiled model with its equations.

    Parameters
    ----------
    compiled : Kernel
    equations : Equations
    derivatives : Derivatives, optional
        For a model whose derivatives are compiled. Otherwise they are compared when they are compiled; see
        `kernel.comparison`.

    Returns
    -------
    int
        At how many states the equations of motion have real values, and were compared; 0 if at none.

    Raises
    ------
    BuildError
        If one differs; the message names the function and shows both values.
    ModelError
        If more velocity constraints are independent than the model has dependent speeds, at random states that satisfy
        the position constraints.

    Notes
    -----
    Where the equations have no real value, the compiled functions must have none. Half of the states are near the
    initial values, and the last is at these.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> verify(fb.load("four_bar").kernel, form_equations(fb.models.four_bar()))
    2
    """
    generator, formed = random.Random(0), _formed(equations, derivatives)
    compared = 0
    for near in DISTANCES:
        values = _random_values(equations, compiled, generator, near)
        for tangent in () if derivatives is None else derivatives.tangents:
            values.update((leaf, generator.uniform(-1.0, 1.0)) for leaf in tangent.direction)
        if not close(equations.tape, equations.positions.not_orthonormal, equations.variables.coordinates, values):
            continue
        expected = _evaluate(equations, formed.values(), values)
        for function, name, got in _compiled_results(equations, derivatives, compiled, values):
            _compare(compiled.name, function, formed[name], got, expected[name])
        if not all(np.isfinite(expected[name]).all() for name in OF_MOTION):  # an expression is undefined there
            continue
        _compare_solution(compiled, expected, values, equations)
        _check_identities(compiled, expected, values, equations)
        compared += 1
        if compared == N_STATES:
            break
    _check_rank(equations, compiled, generator)
    logging.getLogger("fourbar_codegen").info("%s: compared with its equations at %d states", compiled.name, compared)
    return compared


def _random_values(
    e: Equations, compiled: Kernel, generator: random.Random, near: float | None = None
) -> dict[Scalar, float]:
    v = e.variables
    leaves = (v.time, *v.state, *v.inputs, *v.accelerations, *v.multipliers)
    values = {leaf: generator.uniform(-1.0, 1.0) for leaf in leaves}
    if near is not None:
        initial = compiled.layout.initial
        for leaf, name in zip(v.state, compiled.states, strict=True):
            values[leaf] = near * values[leaf] + initial.get(name, 0.0)
    for leaf, default in zip(v.parameters, compiled.defaults.values(), strict=True):
        values[leaf] = generator.uniform(0.5, 1.5) if default is None else default
    return values


def _formed(e: Equations, d: Derivatives | None) -> dict[str, Result]:
    """All results of the equations by name, also of products with directions."""
    parts = () if d is None else (d, *d.tangents)
    return {result.name: result for result in (*e.results, *results_of(*parts))}


def _evaluate(e: Equations, formed: Iterable[Result], values: Mapping[Scalar, float]) -> dict[str, Floats]:
    results = [*formed]
    numbers = iter(e.tape.evaluate([entry for result in results for entry in result.entries], values))
    return {r.name: np.array([next(numbers) for _ in r.entries]).reshape(r.shape) for r in results}


def _arrays(e: Equations, values: Mapping[Scalar, float]) -> list[Floats]:
    v = e.variables
    groups = (v.state, v.parameters, v.inputs, v.accelerations, v.multipliers)
    return [np.array([values[leaf] for leaf in group]) for group in groups]


def _compiled_results(
    e: Equations, d: Derivatives | None, compiled: Kernel, values: Mapping[Scalar, float]
) -> Iterator[tuple[str, str, Floats]]:
    """Function, name and value of every result of the kernel's table, as far as there are equations for it."""
    t = values[e.variables.time]
    x, p, r, accelerations, multipliers = _arrays(e, values)
    further = {Role.COORDINATE_CHANGE: (accelerations,), Role.UNKNOWN_FORCES: (multipliers[compiled.n_c :],)}
    tangents = {} if d is None else dict(zip(PARTIALS, d.tangents, strict=False))
    for role in Role:
        if role.part == "products" or (role.part in ("drawing", "derivatives") and d is None):
            continue
        takes_state, names = compiled.described(role)
        state = x if takes_state else x[: compiled.n_q]
        results = compiled.evaluate(role, t, state, p, r, accelerations, multipliers, further.get(role, ()))
        if role in tangents:  # a matrix, of which products with a direction are formed
            tangent = tangents[role]
            direction = np.array([values[leaf] for leaf in tangent.direction])
            names, results = (tangent.coordinate_rates.name, tangent.residual.name), [m @ direction for m in results]
        yield from ((role.function, name, got) for name, got in zip(names, results, strict=True))


def _compare(model: str, function: str, result: Result, got: Floats, expected: Floats) -> None:
    known = np.array([not entry.is_nan for entry in result.entries], dtype=bool).reshape(result.shape)
    finite = np.isfinite(expected)
    error = np.abs(np.subtract(got, expected, where=known & finite, out=np.zeros(result.shape)))
    size = 1.0 + np.abs(expected[finite]).max(initial=0.0)
    agree = (error <= COMPARISON_RTOL * size) & (finite == np.isfinite(got)) | ~known
    if not agree.all():
        _fail(model, f"function {function}, result {result.name},", got, expected)


def _compare_solution(
    compiled: Kernel, expected: Mapping[str, Floats], values: Mapping[Scalar, float], e: Equations
) -> None:
    """M u' = f + J^T lambda and J u' + gamma = 0 for the results of the compiled solve."""
    x, p, r, *_ = _arrays(e, values)
    try:
        accelerations, unknowns = compiled.accelerations(values[e.variables.time], x, p, r)
    except SimulationError:
        return  # a singular state
    jacobian = expected["constraint_jacobian"]
    multipliers, forces = np.split(unknowns, [compiled.n_c])
    effect, _, rest, _, mass, reaction = compiled.unknown_forces(values[e.variables.time], x, forces, p, r)
    reactions = jacobian.T @ multipliers
    inertia = expected["mass_matrix"] @ accelerations
    sizes = [np.abs(matrix) @ np.abs(accelerations) for matrix in (expected["mass_matrix"], mass, jacobian)]
    # Light parts have large accelerations, whose products with J cancel.
    balance, auxiliary, constraints = (ROUNDING_RTOL * float(size.max(initial=0.0)) for size in sizes)
    name, forcing = compiled.name, expected["forcing"] + effect + reactions
    _compare_sum(name, "M u' = f + J^T lambda", inertia, forcing, balance)
    _compare_sum(name, "Q - M_a u' + J_a^T lambda = 0", mass @ accelerations, rest + reaction @ multipliers, auxiliary)
    _compare_sum(name, "J u' + gamma = 0", jacobian @ accelerations, -expected["acceleration_bias"], constraints)


def _check_identities(
    compiled: Kernel, expected: Mapping[str, Floats], values: Mapping[Scalar, float], e: Equations
) -> None:
    """Energy and constraints, whose rates are differences between neighbouring states."""
    t = values[e.variables.time]
    x, p, r, accelerations, _ = _arrays(e, values)
    q_rates, mass_matrix, forcing = (expected[name] for name in ("coordinate_rates", "mass_matrix", "forcing"))
    jacobian, bias = expected["constraint_jacobian"], expected["velocity_bias"]
    n_q, n_u = compiled.n_q, compiled.n_u
    u, z = x[n_q : n_q + n_u], x[n_q + n_u :]
    by_name = dict(zip(compiled.inputs, r, strict=True))
    r_rates = np.array([by_name.get(f"{name}'", 0.0) for name in compiled.inputs])

    def energy(speeds: Floats) -> float:
        return float(compiled.energy(t, np.concatenate((x[:n_q], speeds, z)), p, r)[0])

    rest = energy(0.0 * u)
    for direction in (u, accelerations):
        double = np.array(energy(direction) + energy(-direction) - 2.0 * rest)
        _expect(compiled.name, "w^T M w = 2 T(w)", np.array(direction @ mass_matrix @ direction), double)

    def at(step: float, function: Callable[[float, Floats, Floats, Floats], Floats]) -> Floats:
        moved = x + step * np.concatenate((q_rates, accelerations, 0.0 * z))
        return np.asarray(function(t + step, moved, p, r + step * r_rates))

    def changes(function: Callable[[float, Floats, Floats, Floats], Floats]) -> Floats | None:
        """A derivative with respect to time, if two steps agree on it."""
        coarse, fine = ((at(h, function) - at(-h, function)) / (2.0 * h) for h in (STEP, STEP / 4.0))
        agree = np.abs(coarse - fine) <= 1e-4 * (1.0 + np.abs(fine).max(initial=0.0))
        return fine if agree.all() else None

    terms = 0.0  # of sums that may be far smaller than their terms
    checks: list[tuple[str, Callable[[float, Floats, Floats, Floats], Floats], Floats]] = []
    if e.velocities.are_derived:
        places = [place for place, row in enumerate(e.positions.rows) if row is not None]
        rates = (jacobian @ u + bias)[: len(places)]
        checks.append(("dPhi/dt = J u + b", lambda t, x, p, r: compiled.position(t, x[:n_q], p, r)[0][places], rates))
    if compiled.n_c:
        rates = jacobian @ accelerations + expected["acceleration_bias"]
        checks.append(("d(J u + b)/dt = J u' + gamma", lambda t, x, p, r: _velocities(compiled, t, x, p, r), rates))
    if rest == 0.0 and not e.energy.power.entries[0].is_nan:
        # All motion is by the speeds: the power of the loads, and of the forces that are missing for this u', is the
        # rate of the kinetic energy.
        gain = expected["power"] + u @ (mass_matrix @ accelerations - forcing)
        terms = float(np.abs(expected["power"]).max() + np.abs(u) @ np.abs(forcing))
        checks.append(("dT/dt = P + u^T (M u' - f)", lambda t, x, p, r: compiled.energy(t, x, p, r)[:1], gain))
    for what, function, rates in checks:
        found = changes(function)
        if found is not None:
            _expect(compiled.name, what, found, rates, ROUNDING_RTOL * terms)


def _check_rank(e: Equations, compiled: Kernel, generator: random.Random) -> None:
    """The rank of J at random closed states, against the number of dependent speeds.

    The smallest rank counts: a mobile loop with as many constraints as coordinates may have other assembly modes in
    which it is rigid.
    """
    # Only with redundant constraints can the rank be too large. Coordinates with relations of their own, such as
    # quaternions, would lose these while loops are closed.
    if compiled.n_c == compiled.layout.n_dependent_speeds or compiled.n_q != compiled.n_u:
        return
    initial = compiled.layout.initial
    ranks = []
    for _ in range(MAX_CLOSURES):
        values = _random_values(e, compiled, generator)
        t, (x, p, r, *_) = values[e.variables.time], _arrays(e, values)
        begin = x[: compiled.n_q] + [initial.get(name, 0.0) for name in compiled.coordinates]
        closed = nearest_closed(compiled, t, begin, p, r)
        if closed is None:
            continue
        jacobian, _ = compiled.velocity(t, np.concatenate((closed, np.zeros(compiled.n_x - compiled.n_q))), p, r)
        if np.isfinite(jacobian).all():
            ranks.append(int(np.linalg.matrix_rank(jacobian / row_sizes(jacobian), rtol=INDEPENDENCE_RTOL)))
    if min(ranks, default=0) > compiled.layout.n_dependent_speeds:
        raise ModelError(compiled.too_few_dependent("at states that satisfy the position constraints", min(ranks)))


def _velocities(compiled: Kernel, t: float, x: Floats, p: Floats, r: Floats) -> Floats:
    jacobian, bias = compiled.velocity(t, x, p, r)
    return jacobian @ x[compiled.n_q : compiled.n_q + compiled.n_u] + bias


def _expect(model: str, identity: str, left: Floats, right: Floats, rounded: float = 0.0) -> None:
    if not _alike(left, right, rounded):
        raise BuildError(
            f"The equations of model {model} do not satisfy {identity} at a random state:\n{left}\n"
            f"instead of\n{right}\n"
            f"That is a defect of this package, or the model has terms that change within {STEP} s, too fast for this "
            "test; check=False compiles without it."
        )


def _compare_sum(model: str, what: str, got: Floats, expected: Floats, rounded: float) -> None:
    if not _alike(got, expected, rounded):
        _fail(model, f"solution of {what}", got, expected)


def _alike(a: Floats, b: Floats, rounded: float = 0.0) -> bool:
    size = max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
    return bool((np.abs(a - b) <= 1e-3 * (1.0 + size) + rounded).all())


def _fail(model: str, what: str, got: Floats, expected: Floats) -> None:
    raise BuildError(
        f"The compiled {what} of model {model} gives\n{got}\ninstead of\n{expected}\nat a random state: a defect of "
        "the C compiler, its flags, or this package. Try other CFLAGS, or another compiler in CC; check=False "
        "compiles without this comparison."
    )
