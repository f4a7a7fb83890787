"""Equations -> Program: one straight-line function for everything that is evaluated together.

For each function: keep the operations it needs, add angles, move subexpressions of parameters alone into `prepare`,
and eliminate common subexpressions.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from fourbar_codegen.dynamics.derivatives import Derivatives
from fourbar_codegen.dynamics.equations import Equations, results_of
from fourbar_codegen.dynamics.products import Products
from fourbar_codegen.dynamics.recursion import Recursion
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.tape import ONE, Leaf, Result, Scalar, Tape, operands, operations_of
from fourbar_codegen.lowering.angles import add_angles
from fourbar_codegen.lowering.cse import eliminate_common_subexpressions
from fourbar_codegen.lowering.program import (
    Array,
    Factors,
    Function,
    Program,
    Sizes,
    Statements,
    Structure,
    fits_lanes,
)
from fourbar_codegen.lowering.solution_form import choose_form
from fourbar_codegen.runtime.enumerations import Needs, Role

__all__ = ["lower", "lower_derivatives", "lower_drawing", "lower_products"]

VECTORIZED = {
    Role.DEFAULT_INPUTS, Role.DYNAMICS, Role.CONSTRAINT_VIOLATION, Role.CONSTRAINT_SCALE, Role.INVARIANT_CORRECTION,
    Role.COORDINATE_CHANGE, Role.STATE_RATES, Role.OUTPUT,
}  # fmt: skip
"""The functions that are also evaluated for batches of states, in the lanes of vectors; see lanes/lane_equations.h."""


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
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> [f.name for f in lower("four_bar", form_equations(four_bar())).functions][:2]
    ['prepare', 'default_inputs']
    """
    e, v, chosen = equations, equations.variables, choose_form(name, equations, form)
    is_redundant = chosen.rank < len(e.velocities.bias.entries)
    state_rates = e.dynamics.state_rates.entries
    states_need_multipliers = e.tape.depends(state_rates, v.multipliers)
    _check_determined(e, is_redundant, states_need_multipliers)
    pool = _Nodes(e.tape, {leaf.node for leaf in v.parameters}.__contains__)
    drafts = _Drafts(e, pool.contains)
    recursion = e.dynamics.recursion if chosen.kind == "recursive" else None
    factors = _draft_functions(drafts, chosen.structure, recursion)
    constants, prepare = _constants(e, pool, drafts)
    return Program(
        name=name,
        sizes=_sizes(e, chosen.rank, len(constants.nodes)),
        functions=(prepare, *drafts.functions(constants)),
        constants=constants,
        position_rows=e.positions.rows,
        pivot_order=chosen.pivot_order,
        structure=chosen.structure,
        factors=factors,
        states_need_solution=e.tape.depends(state_rates, (*v.accelerations, *v.multipliers)),
        states_need_multipliers=states_need_multipliers,
        outputs_need_solution=(outputs_need := e.tape.depends(e.outputs.entries, (*v.accelerations, *v.multipliers))),
        outputs_need_inputs=outputs_need or e.tape.depends(e.outputs.entries, v.inputs),
        forces_are_linear=e.driving_forces.are_linear,
    )


def _check_determined(e: Equations, is_redundant: bool, states_need_multipliers: bool) -> None:
    """Raise if the motion depends on multipliers that redundant constraints leave undetermined."""
    what = ""
    if states_need_multipliers:
        what = "State equations contain multipliers, which"
    elif any(e.driving_forces.constraint_jacobian.entries):
        what = "Unknown forces that drive the motion depend on multipliers, which"
    if is_redundant and what:
        raise ModelError(f"{what} redundant constraints leave undetermined: leave out the redundant ones.")


def _draft_functions(drafts: _Drafts, structure: Structure | None, recursion: Recursion | None) -> Factors | None:
    """Draft all functions that a simulation by an explicit method needs; return the factors of M if they replace M."""
    e, add, factors = drafts.equations, drafts.add, None
    rates, forcing, bias = e.dynamics.coordinate_rates, e.dynamics.forcing, e.velocities.acceleration_bias
    mass_matrix, constraint_jacobian = _entries(e, structure)
    if recursion is not None:
        forcing, factors, mass_matrix = recursion.forcing, *_draft_recursion(drafts, recursion)
    add(Role.DEFAULT_INPUTS, e.inputs.default)
    add(Role.BREAKPOINTS, e.inputs.breakpoints)
    add(Role.DYNAMICS, rates, mass_matrix, forcing, constraint_jacobian, bias)
    add(Role.POSITION, e.positions.constraints, e.positions.jacobian)
    add(Role.VELOCITY, e.velocities.jacobian, e.velocities.bias)
    add(Role.CONSTRAINT_VIOLATION, e.positions.violation, e.velocities.violation)
    add(Role.CONSTRAINT_SCALE, e.positions.scale, e.positions.violation_scale, e.velocities.violation_scale)
    add(Role.INVARIANT_CORRECTION, e.positions.invariant_correction)
    add(Role.COORDINATE_CHANGE, e.dynamics.coordinate_change, further=_array("change", e.variables.accelerations))
    add(Role.CONDITIONS, e.conditions)
    add(Role.ENERGY, e.energy.energies)
    add(Role.OUTPUT, e.outputs)
    add(Role.STATE_RATES, e.dynamics.state_rates)
    unknown = e.variables.multipliers[len(e.velocities.bias.entries) :]
    add(Role.UNKNOWN_FORCES, *results_of(e.driving_forces), further=_array("forces", unknown))
    for role, results in e.quantities.items():
        add(role, *results)
    return factors


def _draft_recursion(drafts: _Drafts, recursion: Recursion) -> tuple[Factors, Result]:
    """Draft products with M and its inverse; what they need of a state, and that as a result of `dynamics`."""
    functions = {
        "mass_solve": ("M^-1 times a vector, with factors of M.", [recursion.solution]),
        "mass_product": ("M times a vector.", [recursion.product]),
    }
    [solve, multiply], nodes = drafts.products(functions, _array("side", recursion.side))
    drafts.drafts += [replace(solve, is_vectorized=True), multiply]
    entries = (*recursion.pivots.entries, *(Scalar(drafts.equations.tape, 1, node) for node in nodes))
    return Factors(nodes), Result("mass_factors", (len(entries),), entries)


def _sizes(e: Equations, rank: int, n_constants: int) -> Sizes:
    v = e.variables
    return Sizes(
        n_q=len(v.coordinates),
        n_u=len(v.speeds),
        n_z=len(v.auxiliary_states),
        n_p=len(v.parameters),
        n_r=len(v.inputs),
        n_h=len(e.positions.constraints.entries),
        n_c=len(e.velocities.bias.entries),
        n_n=len(e.driving_forces.forcing.entries),
        n_i=len(e.positions.invariants),
        n_o=len(e.outputs.entries),
        n_points=len(e.drawing.picture.points),
        n_forces=len(e.drawing.forced),
        n_breakpoints=len(e.inputs.breakpoints.entries),
        n_conditions=len(e.conditions.entries),
        rank=rank,
        n_constants=n_constants,
    )


def lower_drawing(program: Program, equations: Equations) -> tuple[Function, ...]:
    """Lower what pictures need.

    They use the constants of the program's functions; they evaluate other subexpressions of parameters themselves.

    Parameters
    ----------
    program : Program
        As `lower` has made it of the equations.
    equations : Equations

    Returns
    -------
    tuple of Function

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> equations = form_equations(four_bar())
    >>> [f.name for f in lower_drawing(lower("four_bar", equations), equations)]
    ['drawing', 'orientations', 'mass_properties']
    """
    drafts = _Drafts(equations, {ONE, *program.constants.nodes}.__contains__)
    _draft_drawing(drafts)
    return drafts.functions(program.constants)


def _draft_drawing(drafts: _Drafts) -> None:
    e = drafts.equations
    drafts.add(Role.DRAWING, e.drawing.points, e.drawing.forces)
    drafts.add(Role.ORIENTATIONS, e.bodies.orientations)
    drafts.add(Role.MASS_PROPERTIES, e.bodies.masses, e.bodies.inertias)


def lower_derivatives(program: Program, equations: Equations, derivatives: Derivatives) -> tuple[Function, ...]:
    """Lower derivatives, which a simulation by an explicit method does not need, and what pictures need.

    Parameters and result are as for `lower_drawing`, with the derivatives of the equations.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.derivatives import form_derivatives
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> equations = form_equations(four_bar())
    >>> functions = lower_derivatives(lower("four_bar", equations), equations, form_derivatives(equations))
    >>> [f.name for f in functions][:2]
    ['state_partials', 'parameter_partials']
    """
    e, d = equations, derivatives
    drafts = _Drafts(e, {ONE, *program.constants.nodes}.__contains__)
    roles = (Role.STATE_PARTIALS, Role.PARAMETER_PARTIALS, Role.INPUT_PARTIALS)
    if d.tangents:
        for role, tangent in zip(roles, d.tangents, strict=True):
            direction = _array("direction", tangent.direction)
            drafts.add_jvp(role, [tangent.coordinate_rates, tangent.residual], direction)
    else:
        pairs = (
            (d.coordinate_rate_jacobian, d.residual_jacobian),
            (d.coordinate_rate_parameter_jacobian, d.residual_parameter_jacobian),
            (d.coordinate_rate_input_jacobian, d.residual_input_jacobian),
        )
        for role, results in zip(roles, pairs, strict=True):
            drafts.add(role, *(result for result in results if result is not None))
    _draft_drawing(drafts)
    drafts.add(Role.MOTION, d.coordinate_accelerations, d.point_velocities, d.point_accelerations)
    drafts.add(Role.DEFAULT_INPUT_PARTIALS, d.default_input_jacobian)
    drafts.add(Role.CONSTRAINT_PARTIALS, d.velocity_jacobian, d.position_input_jacobian, d.velocity_input_jacobian)
    drafts.add(Role.STATE_RATE_PARTIALS, d.state_rate_acceleration_jacobian, d.state_rate_multiplier_jacobian)
    drafts.add(Role.OUTPUT_STATE_PARTIALS, d.output_jacobian)
    drafts.add(Role.OUTPUT_PARAMETER_PARTIALS, d.output_parameter_jacobian)
    drafts.add(Role.OUTPUT_INPUT_PARTIALS, d.output_input_jacobian)
    drafts.add(Role.OUTPUT_SOLUTION_PARTIALS, d.output_acceleration_jacobian, d.output_multiplier_jacobian)
    return drafts.functions(program.constants)


def lower_products(program: Program, equations: Equations, products: Products) -> tuple[Function, ...]:
    """Lower products of derivatives with vectors, which derivatives of simulations need.

    Parameters and result are as for `lower_derivatives`.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.dynamics.products import form_products
    >>> from fourbar_codegen.models import four_bar
    >>> equations = form_equations(four_bar())
    >>> functions = lower_products(lower("four_bar", equations), equations, form_products(equations))
    >>> [f.name for f in functions][:2]
    ['residual_jvp', 'constraint_jvp']
    """
    tangent, pulled, closed = products.tangent, products.residual_vjp, products.constraint_vjp
    drafts = _Drafts(equations, {ONE, *program.constants.nodes}.__contains__)
    direction = _array("direction", tangent.direction)
    drafts.add_jvp(Role.RESIDUAL_JVP, [tangent.coordinate_rates, tangent.residual], direction)
    drafts.add_jvp(Role.CONSTRAINT_JVP, [products.positions, products.velocities], direction)
    drafts.add(Role.RESIDUAL_VJP, pulled.gradient, further=_array("weights", pulled.weights))
    drafts.add(Role.CONSTRAINT_VJP, closed.gradient, further=_array("weights", closed.weights))
    return drafts.functions(program.constants)


@dataclass(frozen=True)
class _Draft:
    """A function without the constants, which are not known before all functions are drafted."""

    name: str
    summary: str
    before: tuple[Array, ...]
    after: tuple[Array, ...]
    statements: Statements
    results: tuple[Result, ...]
    written_out: tuple[Result, ...]
    role: Role | None = None
    is_vectorized: bool = False
    factors: Result | None = None


class _Drafts:
    """Drafts of the functions of a library.

    Parameters
    ----------
    equations : Equations
    is_constant : callable
        Whether `prepare` computes a node.
    """

    def __init__(self, equations: Equations, is_constant: Callable[[int], bool]) -> None:
        self.equations, self._is_constant = equations, is_constant
        self.drafts: list[_Draft] = []

    def functions(self, constants: Array) -> tuple[Function, ...]:
        """The functions, with the constants between their other arguments."""
        written_out = _WrittenOut(self.equations.tape)
        return tuple(self._function(draft, constants, written_out) for draft in self.drafts)

    def _function(self, draft: _Draft, constants: Array, written_out: _WrittenOut) -> Function:
        factors = None
        if draft.role is not None and draft.factors is not None:
            factors = self._function(self._of_state(draft.role, [draft.factors], ()), constants, written_out)
        return Function(
            name=draft.name,
            summary=draft.summary,
            arguments=(*draft.before, constants, *draft.after),
            statements=draft.statements,
            results=draft.results,
            operations_before_sharing=written_out.operations(draft.written_out)
            + (0 if factors is None else factors.operations_before_sharing),
            role=draft.role,
            is_vectorized=draft.is_vectorized,
            factors=factors,
        )

    def add(self, role: Role, *results: Result, further: Array | None = None) -> None:
        """Draft a function of a state, with a further vector if it takes one."""
        draft = self._of_state(role, results, () if further is None else (further,))
        entries = [entry for result in results for entry in result.entries]
        is_vectorized = role in VECTORIZED and (bool(entries) or role not in {Role.STATE_RATES, Role.OUTPUT})
        if role is Role.OUTPUT:  # batches can do without, and multipliers are not solved for in lanes
            needs_multipliers = self.equations.tape.depends(entries, self.equations.variables.multipliers)
            is_vectorized &= fits_lanes(draft.statements) and not needs_multipliers
        self.drafts.append(replace(draft, role=role, is_vectorized=is_vectorized))

    def add_jvp(self, role: Role, results: Sequence[Result], direction: Array) -> None:
        """Draft products of derivatives with directions, and what they need of a state."""
        [draft], nodes = self.products({role.function: (role.comment, results)}, direction)
        factors = Result("factors", (len(nodes),), tuple(Scalar(self.equations.tape, 1, node) for node in nodes))
        self.drafts.append(replace(draft, role=role, factors=factors))

    def products(
        self, functions: Mapping[str, tuple[str, Sequence[Result]]], vector: Array
    ) -> tuple[list[_Draft], tuple[int, ...]]:
        """Functions that are linear in a vector, by name, with summaries; and what they need of a state, `factors`."""
        tape, within = self.equations.tape, {*vector.nodes}
        given = _Nodes(tape, lambda node: node not in within)
        lowered = [
            eliminate_common_subexpressions(tape, [e for r in results for e in r.entries], given.contains)
            for _, results in functions.values()
        ]
        nodes = tuple(node for node in given.used(lowered) if not self._is_constant(node))
        factors = Array("factors", nodes, tuple(Leaf("f", f"factor{i}") for i in range(len(nodes))))
        drafts = [
            _Draft(name, summary, (), (factors, vector), statements, _shaped(results, entries), (*results,))
            for (name, (summary, results)), (statements, entries) in zip(functions.items(), lowered, strict=True)
        ]
        return drafts, nodes

    def _of_state(self, role: Role, results: Sequence[Result], further: tuple[Array, ...]) -> _Draft:
        e, is_constant = self.equations, self._is_constant
        entries = add_angles(e.tape, [entry for result in results for entry in result.entries], is_constant)
        statements, entries = eliminate_common_subexpressions(e.tape, entries, is_constant)
        v = e.variables
        before, after = [_array("t", (v.time,))], []
        if role.needs & Needs.STATE:
            before.append(_array("x", e.variables.state))
        elif role.needs & Needs.COORDINATES:
            before.append(_array("q", e.variables.coordinates))
        if len(before) > 1:
            after.append(_array("r", e.variables.inputs))
        if role.needs & Needs.ACCELERATIONS:
            after.append(_array("accelerations", e.variables.accelerations))
        if role.needs & Needs.MULTIPLIERS:
            after.append(_array("multipliers", e.variables.multipliers))
        return _Draft(
            role.function,
            role.comment,
            (*before,),
            (*after, *further),
            statements,
            _shaped(results, entries),
            (*results,),
        )


def _entries(e: Equations, structure: Structure | None) -> tuple[Result, Result]:
    """The mass matrix and the constraint Jacobian in the form that `dynamics` returns."""
    if structure is None:
        return e.dynamics.mass_matrix, e.velocities.jacobian
    n_u = len(e.variables.speeds)
    mass = tuple(e.dynamics.mass_matrix.entries[i * n_u + j] for i, j in structure.mass_entries)
    jacobian = tuple(e.velocities.jacobian.entries[i * n_u + j] for i, j in structure.jacobian_entries)
    return Result("mass_matrix", (len(mass),), mass), Result("constraint_jacobian", (len(jacobian),), jacobian)


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


def _constants(e: Equations, pool: _Nodes, drafts: _Drafts) -> tuple[Array, Function]:
    """The array of constants that the drafted functions use, and the function that fills it."""
    lowered = [(draft.statements, [e for r in draft.results for e in r.entries]) for draft in drafts.drafts]
    nodes = tuple(dict.fromkeys([*(parameter.node for parameter in e.variables.parameters), *pool.used(lowered)]))
    statements, entries = eliminate_common_subexpressions(
        e.tape, [Scalar(e.tape, 1, node) for node in nodes], lambda _: False
    )
    prepare = Function(
        "prepare",
        "The parameters, then all constants derived from them.",
        (_array("p", e.variables.parameters),),
        statements,
        (Result("constants", (len(nodes),), tuple(entries)),),
        operations_before_sharing=0,  # what it computes is counted where it is used
        is_vectorized=True,
    )
    n_p = len(e.variables.parameters)
    leaves = (*(_leaf(parameter) for parameter in e.variables.parameters), *[None] * (len(nodes) - n_p))
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
