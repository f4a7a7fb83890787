"""Equations -> Program: one straight-line function for everything that is evaluated together.

For each function: keep the operations it needs, add angles, move subexpressions of parameters alone into `prepare`,
and eliminate common subexpressions.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from fourbar_codegen.dynamics.derivatives import Derivatives
from fourbar_codegen.dynamics.equations import Equations
from fourbar_codegen.dynamics.recursion import Recursion
from fourbar_codegen.dynamics.variations import Variations
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.identities import rank as find_rank
from fourbar_codegen.expressions.tape import ONE, Leaf, Result, Scalar, Tape, operands, operations_of
from fourbar_codegen.layout import Needs, Role
from fourbar_codegen.lowering.angles import add_angles
from fourbar_codegen.lowering.cse import eliminate_common_subexpressions
from fourbar_codegen.lowering.elimination import (
    MAX_CONSTRAINTS,
    find_pivot_order,
    find_structure,
    recursive_cost,
    solution_cost,
)
from fourbar_codegen.lowering.program import (
    COLUMNS,
    FACTORS,
    Array,
    Factors,
    Function,
    PivotOrder,
    Program,
    Sizes,
    Statements,
    Structure,
)

__all__ = ["lower", "lower_derivatives", "lower_variations"]

REGULAR = 1e-9
"""Smallest pivot of M relative to its diagonal; that of the first link of a chain is of the order 1 / n^3."""

# Measured with the models of benchmarks/forms.py: by these, each is printed in its fastest form or in one that takes at
# most a fifth more.
RECURSIVE = 0.87
"""Share of the dense form's operations up to which the recursive form is faster."""
ELIMINATION = 1.5
"""Operations in straight-line code that take the time of one multiplication of a dense elimination, and ..."""
LOOPS = 3
"""... of one multiplication in the short loops for constraints of a recursion."""

_Specification = tuple[str, str, Sequence[Array], Sequence[Array], Sequence[Result]]
"""Of a function: name, summary, arguments before and after the constants, results."""

ROLES = {role.name.lower(): role for role in Role if role is not Role.DYNAMICS}  # that is assembled in C
"""Of functions of the kernel's table, by name."""

KINEMATIC = {
    Role.BREAKPOINTS, Role.DEFAULT_INPUTS, Role.POSITION, Role.VELOCITY, Role.CONSTRAINT_VIOLATION,
    Role.CONSTRAINT_SCALE, Role.INVARIANT_CORRECTION, Role.ENERGY, Role.DRAWING, Role.MOTION,
    Role.DEFAULT_INPUT_PARTIALS, Role.CONSTRAINT_PARTIALS, Role.CONSTRAINT_JVP, Role.CONSTRAINT_VJP,
}  # fmt: skip
"""Of functions that need only inputs which prescribe motions; others are in single entries, such as an energy."""

HELD = {"x": Needs.STATE, "accelerations": Needs.ACCELERATIONS, "multipliers": Needs.MULTIPLIERS}
"""What arguments of these names stand for."""

EXAMPLES = 4
"""Points at which sparse Jacobians are evaluated."""

POINTS = 8
"""Pairs of random points at which the constraints' Jacobian is evaluated."""


def lower(name: str, equations: Equations, form: str | None = None) -> Program:
    """Lower equations to a program.

    Parameters
    ----------
    name : str
        The model's name.
    equations : Equations
    form : {"dense", "sparse", "recursive"}, optional
        How accelerations are solved for. By default the form with the fewest operations.

    Returns
    -------
    Program
        With functions `prepare`, `default_inputs`, `dynamics`, and the others below.

    Raises
    ------
    ModelError
        If state equations or unknown forces depend on multipliers that redundant constraints leave undetermined; if the
        equations do not have that form.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.equations import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> [f.name for f in lower("four_bar", form_equations(four_bar())).functions][:2]
    ['prepare', 'default_inputs']
    """
    e = equations
    time = _array("t", (e.time,))
    state = _array("x", (*e.coordinates, *e.speeds, *e.auxiliary_states))
    coordinates = _array("q", e.coordinates)
    inputs = _array("r", e.inputs)
    held = _held(e)
    rank = _rank(e)
    states_need_multipliers = e.tape.depends(e.state_rates.entries, e.multipliers)
    is_redundant = rank < len(e.velocity_bias.entries)
    if is_redundant and e.tape.depends(e.state_rates.entries, e.multipliers):
        raise ModelError(
            "State equations contain multipliers, which redundant constraints leave undetermined: leave out the "
            "redundant ones."
        )
    if is_redundant and any(e.auxiliary_constraint_jacobian.entries):
        raise ModelError(
            "Unknown forces that drive the motion depend on multipliers, which redundant constraints leave "
            "undetermined: leave out the redundant ones."
        )
    structure = _structure(e, rank)
    costs = _costs(e, rank, structure)
    form = form or min(costs, key=costs.__getitem__)
    if form not in costs:
        raise ModelError(f"{name} has no {form} form; it has: {', '.join(costs)}.")
    if form != "sparse":
        structure = None
    parameters = {leaf.node for leaf in e.parameters}
    pool = _Nodes(e.tape, parameters.__contains__)
    products: list[_Lowered] = []
    factors = None
    forcing = e.forcing
    mass_matrix, constraint_jacobian = _entries(e, structure)
    if form == "recursive" and e.recursion is not None:
        forcing = e.recursion.forcing
        products, factors, mass_matrix = _recursive(e, e.recursion, pool.contains)
    n_n = len(e.auxiliary_forcing.entries)
    unknown = e.multipliers[len(e.multipliers) - n_n :]
    specifications: list[_Specification] = [
        ("default_inputs", "Inputs r from their expressions; NaN without one.", [time], [], [e.default_inputs]),
        ("breakpoints", "Times at which expressions have a jump or a kink.", [], [], [e.breakpoints]),
        (
            "dynamics",
            "q', and M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0.",
            [time, state],
            [inputs],
            [e.coordinate_rates, mass_matrix, forcing, constraint_jacobian, e.acceleration_bias],
        ),
        (
            "position",
            "Holonomic constraints Phi(q, t) and dPhi/dq.",
            [time, coordinates],
            [inputs],
            [e.position_constraints, e.position_jacobian],
        ),
        (
            "velocity",
            "J and b of the velocity constraints J u + b = 0.",
            [time, state],
            [inputs],
            [e.constraint_jacobian, e.velocity_bias],
        ),
        (
            "constraint_violation",
            "Constraint violations: w of J v = -w, which corrects Phi, then those that no speed changes; J u + b.",
            [time, state],
            [inputs],
            [e.position_violation, e.velocity_violation],
        ),
        (
            "constraint_scale",
            "Scales of violations: of the position constraints, and of the rows of `constraint_violation`.",
            [time, state],
            [inputs],
            [e.position_scale, e.position_violation_scale, e.velocity_violation_scale],
        ),
        (
            "invariant_correction",
            "The change of the coordinates that corrects position constraints which no speed changes.",
            [time, coordinates],
            [inputs],
            [e.invariant_correction],
        ),
        (
            "coordinate_change",
            "K v, the change of the coordinates for a change v of the speeds' integrals.",
            [time, state],
            [inputs, _array("change", e.accelerations)],
            [e.coordinate_change],
        ),
        ("energy", "Kinetic and potential energy.", [time, state], [inputs], [e.energies]),
        ("output", "The outputs, with u' and lambda given.", [time, state], [*held], [e.outputs]),
        ("state_rates", "z', with u' and lambda given.", [time, state], [*held], [e.state_rates]),
        (
            "unknown_forces",
            "Unknown forces n: F(n), added to f; Q(n) - M_a u' + J_a^T lambda = 0 of the auxiliary speeds.",
            [time, state],
            [inputs, _array("forces", unknown)],
            [*e.of_unknown_forces],
        ),
    ]
    lowered = _lowered(e.tape, specifications, pool.contains)
    lowered += [statements for _, statements in products]
    specifications += [specification for specification, _ in products]
    constants, prepare = _constants(e, pool, lowered)
    sizes = Sizes(
        n_q=len(e.coordinates),
        n_u=len(e.speeds),
        n_z=len(e.auxiliary_states),
        n_p=len(e.parameters),
        n_r=len(e.inputs),
        n_h=len(e.position_constraints.entries),
        n_c=len(e.velocity_bias.entries),
        n_n=n_n,
        n_i=len(e.invariants),
        n_o=len(e.outputs.entries),
        n_points=len(e.picture.points),
        n_forces=len(e.forced),
        n_breakpoints=len(e.breakpoints.entries),
        rank=rank,
        n_constants=len(constants.nodes),
    )
    return Program(
        name=name,
        sizes=sizes,
        functions=(prepare, *_functions(e.tape, specifications, lowered, constants)),
        constants=constants,
        position_rows=e.position_rows,
        pivot_order=_pivot_order(e, rank, structure),
        structure=structure,
        factors=factors,
        states_need_solution=e.tape.depends(e.state_rates.entries, (*e.accelerations, *e.multipliers)),
        states_need_multipliers=states_need_multipliers,
        forces_are_linear=e.forces_are_linear,
    )


def lower_derivatives(program: Program, equations: Equations, derivatives: Derivatives) -> tuple[Function, ...]:
    """Lower derivatives and data for drawings, which a simulation by an explicit method does not need.

    They use the constants of the program's functions; they evaluate other subexpressions of parameters themselves.

    Parameters
    ----------
    program : Program
        As `lower` has made it of the equations.
    equations : Equations
    derivatives : Derivatives

    Returns
    -------
    tuple of Function

    Examples
    --------
    >>> from fourbar_codegen.dynamics.derivatives import form_derivatives
    >>> from fourbar_codegen.dynamics.equations import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> equations = form_equations(four_bar())
    >>> functions = lower_derivatives(lower("four_bar", equations), equations, form_derivatives(equations))
    >>> [f.name for f in functions][:2]
    ['drawing', 'motion']
    """
    e, d = equations, derivatives
    time, inputs = _array("t", (e.time,)), _array("r", e.inputs)
    state = _array("x", (*e.coordinates, *e.speeds, *e.auxiliary_states))
    residual = _residual(e)
    held = _held(e)
    known = {ONE, *program.constants.nodes}
    sensitivities, columns = _sensitivities(e, d, known.__contains__, residual)
    specifications: list[_Specification] = [
        (
            "drawing",
            "Positions of the drawn points, and the inputs' forces on them.",
            [time, state],
            [inputs],
            [e.points, e.forces],
        ),
        (
            "motion",
            "q'', and velocities and accelerations of the drawn points, with u' given.",
            [time, state],
            [inputs, _array("accelerations", e.accelerations)],
            [d.coordinate_accelerations, d.point_velocities, d.point_accelerations],
        ),
        *sensitivities,
        (
            "default_input_partials",
            "d/dp of the inputs' expressions; zero without one.",
            [time],
            [],
            [d.default_input_jacobian],
        ),
        (
            "constraint_partials",
            "d/dq of the velocity constraints J u + b; d/dr of the position constraints and of J u + b.",
            [time, state],
            [inputs],
            [d.velocity_jacobian, d.position_input_jacobian, d.velocity_input_jacobian],
        ),
        (
            "state_rate_partials",
            "d/du' and d/dlambda of z'.",
            [time, state],
            [*held],
            [d.state_rate_acceleration_jacobian, d.state_rate_multiplier_jacobian],
        ),
    ]
    partials = (
        ("output_state_partials", "d/dx of the outputs with u' and lambda held.", d.output_jacobian),
        ("output_parameter_partials", "d/dp of the same.", d.output_parameter_jacobian),
        ("output_input_partials", "d/dr of the same.", d.output_input_jacobian),
    )
    specifications += [(name, summary, [time, state], [*held], [result]) for name, summary, result in partials]
    by_solution = [d.output_acceleration_jacobian, d.output_multiplier_jacobian]
    specifications.append(
        ("output_solution_partials", "d/du' and d/dlambda of the outputs.", [time, state], [*held], by_solution)
    )
    lowered = _lowered(e.tape, specifications, known.__contains__)
    specifications += [specification for specification, _ in columns]
    lowered += [statements for _, statements in columns]
    return _functions(e.tape, specifications, lowered, program.constants)


def _sensitivities(
    e: Equations, d: Derivatives, is_constant: Callable[[int], bool], residual: str
) -> tuple[list[_Specification], list[_Lowered]]:
    """The functions for derivatives of q' and the residual; for products with directions, those are lowered."""
    before, after = [_array("t", (e.time,)), _array("x", (*e.coordinates, *e.speeds, *e.auxiliary_states))], _held(e)
    names = ("state_partials", "parameter_partials", "input_partials")
    if not d.tangents:
        summaries = (
            f"d/dx of q', and of {residual} with u' and lambda held.",
            "The same derivatives with respect to the parameters.",
            "The same derivatives with respect to the inputs.",
        )
        results = (
            [d.coordinate_rate_jacobian, d.residual_jacobian],
            [d.coordinate_rate_parameter_jacobian, d.residual_parameter_jacobian],
            [d.coordinate_rate_input_jacobian, d.residual_input_jacobian],
        )
        pairs = zip(names, summaries, results, strict=True)
        return [(name, summary, before, after, [r for r in of if r is not None]) for name, summary, of in pairs], []
    specifications: list[_Specification] = []
    columns: list[_Lowered] = []
    for name, variables, tangent in zip(names, ("x", "p", "r"), d.tangents, strict=True):
        summary = f"q', and {residual} with u' and lambda held, differentiated along a direction of {variables}."
        function = (f"{name}_columns", summary, [tangent.coordinate_rates, tangent.residual])
        product, nodes = _products(e.tape, is_constant, [function], _array("direction", tangent.direction))
        columns += product
        factors = Result("factors", (len(nodes),), tuple(Scalar(e.tape, 1, node) for node in nodes))
        specifications.append((f"{name}_factors", f"What {name}_columns needs of a state.", before, after, [factors]))
    return specifications, columns


def lower_variations(program: Program, equations: Equations, variations: Variations) -> tuple[Function, ...]:
    """Lower products of derivatives with vectors, which derivatives of simulations need.

    Parameters and result are as for `lower_derivatives`.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.equations import form_equations
    >>> from fourbar_codegen.dynamics.variations import form_variations
    >>> from fourbar_codegen.models import four_bar
    >>> equations = form_equations(four_bar())
    >>> functions = lower_variations(lower("four_bar", equations), equations, form_variations(equations))
    >>> [f.name for f in functions][:2]
    ['residual_vjp', 'constraint_vjp']
    """
    e, v, residual = equations, variations.variation, _residual(equations)
    before = [_array("t", (e.time,)), _array("x", (*e.coordinates, *e.speeds, *e.auxiliary_states))]
    inputs, held = _array("r", e.inputs), _held(e)
    known = {ONE, *program.constants.nodes}
    pulled, closed = variations.pullback, variations.constraint_pullback
    specifications: list[_Specification] = [
        (
            "residual_vjp",
            f"The gradient by x, p and r of the weighted sum of q', and {residual} with u' and lambda held.",
            before,
            [*held, _array("weights", pulled.weights)],
            [pulled.gradient],
        ),
        (
            "constraint_vjp",
            "The gradient by x, p and r of the weighted sum of the results of constraint_violation.",
            before,
            [inputs, _array("weights", closed.weights)],
            [closed.gradient],
        ),
    ]
    columns: list[_Lowered] = []
    direction = _array("direction", v.direction)
    for name, summary, after, results in (
        (
            "residual_jvp",
            f"q', and {residual} with u' and lambda held, differentiated along a direction of x, p and r.",
            held,
            [v.coordinate_rates, v.residual],
        ),
        (
            "constraint_jvp",
            "The results of constraint_violation differentiated along a direction of x, p and r.",
            (inputs,),
            [v.positions, v.velocities],
        ),
    ):
        product, nodes = _products(e.tape, known.__contains__, [(f"{name}_columns", summary, results)], direction)
        columns += product
        factors = Result("factors", (len(nodes),), tuple(Scalar(e.tape, 1, node) for node in nodes))
        specifications.append((f"{name}_factors", f"What {name}_columns needs of a state.", before, after, [factors]))
    lowered = _lowered(e.tape, specifications, known.__contains__)
    specifications += [specification for specification, _ in columns]
    lowered += [statements for _, statements in columns]
    return _functions(e.tape, specifications, lowered, program.constants)


def _residual(e: Equations) -> str:
    """What the rows of the residual are."""
    rows = ["f - M u' + J^T lambda", "-(J u' + gamma)"]
    if e.auxiliary_forcing.entries:
        rows = ["f + F - M u' + J^T lambda", "-(J u' + gamma)", "Q - M_a u' + J_a^T lambda"]
    if e.auxiliary_states:
        rows.append("z'")
    return f"{', '.join(rows[:-1])} and {rows[-1]}"


def _held(e: Equations) -> tuple[Array, ...]:
    """The arguments after the constants if u' and the multipliers are given."""
    return _array("r", e.inputs), _array("accelerations", e.accelerations), _array("multipliers", e.multipliers)


def _lowered(
    tape: Tape, specifications: Sequence[_Specification], is_constant: Callable[[int], bool]
) -> list[tuple[Statements, list[Scalar]]]:
    """The statements and entries of functions."""
    return [
        eliminate_common_subexpressions(tape, add_angles(tape, entries, is_constant), is_constant)
        for entries in ([entry for result in results for entry in result.entries] for *_, results in specifications)
    ]


def _functions(
    tape: Tape,
    specifications: Sequence[_Specification],
    lowered: Sequence[tuple[Statements, list[Scalar]]],
    constants: Array,
) -> tuple[Function, ...]:
    written_out = _WrittenOut(tape)
    return tuple(
        Function(
            name,
            summary,
            (*before, constants, *after),
            statements,
            _shaped(results, entries),
            written_out.operations(results),
            role := ROLES.get(name.removesuffix(FACTORS).removesuffix(COLUMNS)),
            _needs(role, (*before, *after)),
        )
        for (name, summary, before, after, results), (statements, entries) in zip(specifications, lowered, strict=True)
    )


def _needs(role: Role | None, arguments: Sequence[Array]) -> int:
    """What a function needs to know, by its role and its arguments besides the constants."""
    inputs = 0 if role in KINEMATIC else Needs.INPUTS
    return inputs | sum(HELD.get(array.name, 0) for array in arguments)


def _rank(e: Equations) -> int:
    """The number of constraints that are not redundant: that of dependent speeds, or the rank of J if it is smaller.

    The rank is that at a random point. `verify` tests it at states that satisfy the constraints.
    """
    n_u = len(e.speeds)
    entries = e.constraint_jacobian.entries
    return min(e.n_dependent_speeds, find_rank(e.tape, [entries[i : i + n_u] for i in range(0, len(entries), n_u)]))


def _pivot_order(e: Equations, rank: int, structure: Structure | None) -> PivotOrder:
    """A pivot order for J at random points, some of them near zero coordinates, where models often start.

    Constraints may be redundant only where loops are closed: then it is that at closed states, if any are known.
    """
    n_u, n_c = len(e.speeds), len(e.velocity_bias.entries)
    if structure is not None or n_c > MAX_CONSTRAINTS:
        return find_pivot_order(n_c, n_u, rank, [])  # it is not used
    entries = e.constraint_jacobian.entries
    closed = [*_evaluated(e, entries, e.closed_states if rank < n_c else ())]
    jacobians = [
        [numbers[i : i + n_u] for i in range(0, len(numbers), n_u)]
        for numbers in closed or _at_random_points(e, entries)
    ]
    return find_pivot_order(n_c, n_u, rank, jacobians)


def _at_random_points(e: Equations, entries: Sequence[Scalar]) -> Iterator[list[float]]:
    """Numbers for scalars at random points; where they have no value, none."""
    return _evaluated(e, entries, _random_points(e))


def _random_points(e: Equations) -> Iterator[dict[Scalar, float]]:
    """Random points, some of them near zero coordinates."""
    generator = random.Random(0)
    for size in (0.05, 1.0) * POINTS:
        values = {leaf: generator.uniform(0.1, 1.0) for leaf in (e.time, *e.speeds, *e.parameters, *e.inputs)}
        yield values | {leaf: generator.uniform(-size, size) for leaf in e.coordinates}


def _evaluated(
    e: Equations, entries: Sequence[Scalar], points: Iterable[Mapping[Scalar, float]]
) -> Iterator[list[float]]:
    for values in points:
        numbers = e.tape.evaluate(entries, values)
        if all(map(math.isfinite, numbers)):  # some expressions have no value there
            yield numbers


def _structure(e: Equations, rank: int) -> Structure | None:
    n_u, n_c = len(e.speeds), len(e.velocity_bias.entries)
    if rank < n_c:
        return None  # redundant constraints need pivoting
    mass = tuple((i, j) for i in range(n_u) for j in range(i + 1) if e.mass_matrix.entries[i * n_u + j])
    jacobian = tuple((i, j) for i in range(n_c) for j in range(n_u) if e.constraint_jacobian.entries[i * n_u + j])
    examples = [_example(e, values) for values in itertools.islice(_random_points(e), EXAMPLES if n_c else 0)]
    return find_structure(n_u, n_c, mass, jacobian, examples)


def _example(e: Equations, values: Mapping[Scalar, float]) -> list[list[float]]:
    """J at a point, with random entries in rows that have no value there: parameters need not fit each other."""
    n_u, entries, generator = len(e.speeds), e.constraint_jacobian.entries, random.Random(0)
    rows = []
    for row in (entries[i : i + n_u] for i in range(0, len(entries), n_u)):
        found = next(_evaluated(e, row, [values]), None)
        rows.append(found or [generator.uniform(0.5, 1.0) if entry else 0.0 for entry in row])
    return rows


def _entries(e: Equations, structure: Structure | None) -> tuple[Result, Result]:
    """The mass matrix and the constraint Jacobian in the form that `dynamics` returns."""
    if structure is None:
        return e.mass_matrix, e.constraint_jacobian
    n_u = len(e.speeds)
    mass = tuple(e.mass_matrix.entries[i * n_u + j] for i, j in structure.mass_entries)
    jacobian = tuple(e.constraint_jacobian.entries[i * n_u + j] for i, j in structure.jacobian_entries)
    return Result("mass_matrix", (len(mass),), mass), Result("constraint_jacobian", (len(jacobian),), jacobian)


def _costs(e: Equations, rank: int, structure: Structure | None) -> dict[str, float]:
    """The time to form and solve the equations in each form they have, in operations of straight-line code."""
    n_u, n_c = len(e.speeds), len(e.velocity_bias.entries)
    common = (*e.coordinate_rates.entries, *e.constraint_jacobian.entries, *e.acceleration_bias.entries)
    count, recursion = e.tape.count_operations, e.recursion
    formed = count([*common, *e.forcing.entries, *e.mass_matrix.entries])
    costs = {"dense": formed + ELIMINATION * solution_cost(n_u, n_c, None)}
    if structure is not None:
        costs["sparse"] = formed + ELIMINATION * solution_cost(n_u, n_c, structure)
    # Redundant constraints need pivoting, and a recursion a regular M.
    if recursion is not None and rank == n_c and _is_regular(e, recursion):
        n_jacobian = sum(map(bool, e.constraint_jacobian.entries))
        of_solution = count(recursion.solution.entries) - count(recursion.pivots.entries)
        formed = count([*common, *recursion.forcing.entries, *recursion.solution.entries])
        costs["recursive"] = (formed + LOOPS * recursive_cost(n_u, n_c, n_jacobian, of_solution)) / RECURSIVE
    return costs


def _is_regular(e: Equations, recursion: Recursion) -> bool:
    """Whether M is regular beyond rounding errors at random points: constraints may be substituted into velocities.

    Random numbers need not be the inertia of a body, so pivots may be negative.
    """
    n_u = len(e.speeds)
    diagonal = [e.mass_matrix.entries[i * n_u + i] for i in range(n_u)]
    pairs = [
        (pivot, size)
        for numbers in itertools.islice(_at_random_points(e, [*recursion.pivots.entries, *diagonal]), 2)
        for pivot, size in zip(numbers[:n_u], numbers[n_u:], strict=True)
    ]
    return all(abs(pivot) > REGULAR * abs(size) for pivot, size in pairs)


def _recursive(
    e: Equations, recursion: Recursion, is_constant: Callable[[int], bool]
) -> tuple[list[_Lowered], Factors, Result]:
    """The functions for products with M and its inverse; what they need of a state; and that as a result."""
    products, nodes = _products(
        e.tape,
        is_constant,
        (
            ("mass_solve", "M^-1 times a vector, with factors of M.", [recursion.solution]),
            ("mass_product", "M times a vector.", [recursion.product]),
        ),
        _array("side", recursion.side),
    )
    entries = (*recursion.pivots.entries, *(Scalar(e.tape, 1, node) for node in nodes))
    return products, Factors(nodes), Result("mass_factors", (len(entries),), entries)


_Lowered = tuple[_Specification, tuple[Statements, list[Scalar]]]


def _products(
    tape: Tape,
    is_constant: Callable[[int], bool],
    functions: Sequence[tuple[str, str, Sequence[Result]]],
    vector: Array,
) -> tuple[list[_Lowered], tuple[int, ...]]:
    """Functions that are linear in a vector, with all factors that do not depend on it as an argument; these nodes."""
    within = {*vector.nodes}
    given = _Nodes(tape, lambda node: node not in within)
    lowered = [
        eliminate_common_subexpressions(tape, [e for result in results for e in result.entries], given.contains)
        for *_, results in functions
    ]
    nodes = tuple(node for node in given.used(lowered) if not is_constant(node))
    factors = Array("factors", nodes, tuple(Leaf("f", f"factor{i}") for i in range(len(nodes))))
    specifications: list[_Specification] = [
        (name, summary, [], [factors, vector], results) for name, summary, results in functions
    ]
    return [*zip(specifications, lowered, strict=True)], nodes


class _Nodes:
    """Nodes that depend on certain leaves alone.

    Parameters
    ----------
    tape : Tape
    is_given : callable
        Whether a leaf's node is one of these.
    """

    def __init__(self, tape: Tape, is_given: Callable[[int], bool]) -> None:
        self.tape = tape
        self._is_given = is_given
        self._known: list[bool] = [True]

    def contains(self, node: int) -> bool:
        """Whether a node depends on the given leaves alone."""
        known, nodes = self._known, self.tape.nodes
        for number, operation in enumerate(nodes[len(known) : node + 1], start=len(known)):
            if isinstance(operation, Leaf):
                known.append(self._is_given(number))
            else:
                known.append(all(map(known.__getitem__, self.tape.operands(number))))
        return known[node]

    def used(self, lowered: Sequence[tuple[Statements, list[Scalar]]]) -> list[int]:
        """Those that lowered functions use, in the order of their first use."""
        found: dict[int, None] = {}
        for statements, entries in lowered:
            needed = [operand for _, operation in statements for operand in operands(operation)]
            found.update((n, None) for n in (*needed, *(e.node for e in entries)) if n != ONE and self.contains(n))
        return [*found]


def _constants(
    e: Equations, pool: _Nodes, lowered: Sequence[tuple[Statements, list[Scalar]]]
) -> tuple[Array, Function]:
    """The array of constants that the lowered functions use, and the function that fills it."""
    nodes = tuple(dict.fromkeys([*(parameter.node for parameter in e.parameters), *pool.used(lowered)]))
    statements, entries = eliminate_common_subexpressions(
        e.tape, [Scalar(e.tape, 1, node) for node in nodes], lambda _: False
    )
    prepare = Function(
        "prepare",
        "The parameters, then all constants derived from them.",
        (_array("p", e.parameters),),
        statements,
        (Result("constants", (len(nodes),), tuple(entries)),),
        0,  # what it computes is counted where it is used
    )
    n_p = len(e.parameters)
    leaves = (*(_leaf(parameter) for parameter in e.parameters), *[None] * (len(nodes) - n_p))
    return Array("constants", nodes, leaves), prepare


class _WrittenOut:
    """Counts the operations of expressions that are written out in full."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self._known: list[int] = [0]

    def operations(self, results: Sequence[Result]) -> int:
        known = self._known
        entries = [entry for result in results for entry in result.entries]
        for operation in self.tape.nodes[len(known) : max((entry.node for entry in entries), default=0) + 1]:
            known.append(operations_of(operation) + sum([known[operand] for operand in operands(operation)]))
        return sum(known[entry.node] + (not entry.is_number and entry.coefficient != 1) for entry in entries)


def _array(name: str, leaves: Sequence[Scalar]) -> Array:
    return Array(name, tuple(leaf.node for leaf in leaves), tuple(map(_leaf, leaves)))


def _leaf(scalar: Scalar) -> Leaf:
    leaf = scalar.tape.nodes[scalar.node]
    assert isinstance(leaf, Leaf)
    return leaf


def _shaped(results: Sequence[Result], entries: Sequence[Scalar]) -> tuple[Result, ...]:
    """The results with other entries, given as one sequence."""
    remaining = iter(entries)
    return tuple(Result(r.name, r.shape, tuple(itertools.islice(remaining, len(r.entries)))) for r in results)
