"""Model, Equations and Program -> Layout, the description of a compiled model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import or_
from typing import Any

import sympy as sm
from sympy.functions.elementary.trigonometric import TrigonometricFunction

from fourbar_codegen.dynamics.equations import Equations, Jump
from fourbar_codegen.expressions.convert import written_out
from fourbar_codegen.expressions.tape import Call, Product, Scalar, Sum, operands
from fourbar_codegen.layout import (
    Breakpoints,
    Constraints,
    Dependencies,
    Drawing,
    Input,
    Layout,
    Operations,
    Parameter,
    Point,
    PotentialEnergy,
    Shape,
    ShapeKind,
    StateJump,
)
from fourbar_codegen.lowering.program import Function, Program
from fourbar_codegen.modeling import model as modeling
from fourbar_codegen.modeling.gravity import gravity
from fourbar_codegen.modeling.mechanism import Mechanism, entries_of
from fourbar_codegen.modeling.model import Model

__all__ = ["layout_of", "names_of", "operations_of"]

LONGEST = 80
"""Characters of a condition that a message writes out; of longer ones it names the variables."""


def names_of(model: Model, program: Program) -> dict[str, tuple[str, ...]]:
    """Names of the entries of all arguments and outputs, in order."""
    return {
        "coordinates": model.coordinates,
        "speeds": model.speeds,
        "auxiliary_states": model.auxiliary_states,
        "parameters": tuple(leaf.name for leaf in program.parameters),
        "inputs": tuple(leaf.name for leaf in program.inputs),
        "outputs": model.outputs,
    }


def layout_of(
    model: Model, equations: Equations, program: Program, names: Mapping[str, Sequence[str]], fingerprint: str
) -> Layout:
    """The description of a compiled model, with operation counts of the program's functions.

    Parameters
    ----------
    model : Model
    equations : Equations
    program : Program
    names : mapping of str to sequence of str
        The model's `coordinates`, `speeds`, `auxiliary_states`, `parameters`, `inputs` and `outputs`, as compiled.
    fingerprint : str
        The digest of everything that the model's equations depend on.

    Returns
    -------
    Layout
    """
    mechanism = model.mechanism
    energies = equations.energy.energies.entries
    return Layout(
        name=model.name,
        fingerprint=fingerprint,
        form=program.form,
        coordinates=(*names["coordinates"],),
        speeds=(*names["speeds"],),
        auxiliary_states=(*names["auxiliary_states"],),
        n_dependent_coordinates=mechanism.n_dependent_coordinates,
        n_dependent_speeds=mechanism.n_dependent_speeds,
        angles=_angles(model, equations, names["coordinates"]),
        parameters=tuple(_parameter(name, model.parameters[name]) for name in names["parameters"]),
        derived_parameters={symbol.name: str(expr) for symbol, expr in model.derived_parameters.items()},
        geometry=_geometry(equations, names["parameters"]),
        inputs=_inputs(model, equations, names["inputs"]),
        outputs=(*names["outputs"],),
        undetermined_outputs=_undetermined_outputs(equations, program, names["outputs"]),
        constraints=_constraints(model, equations, program),
        breakpoints=Breakpoints(
            n=program.sizes.n_breakpoints,
            n_motion_breakpoints=equations.inputs.n_motion_breakpoints,
            conditions=_conditions(equations),
            state_jumps=_state_jumps(model, equations, names),
        ),
        drawing=_drawing(model, equations),
        potential_energy=PotentialEnergy(is_known=not energies[1].is_nan, without=equations.energy.without),
        initial=model.initial,
        warnings=equations.warnings,
        compared=None,  # known only after compilation
        dependencies=_dependencies(model, equations, names),
        operations=operations_of(program.functions),
    )


def _parameter(name: str, parameter: modeling.Parameter) -> Parameter:
    return Parameter(name, parameter.value, parameter.unit, parameter.description, parameter.range)


def _inputs(model: Model, equations: Equations, names: Sequence[str]) -> tuple[Input, ...]:
    entries = [entry for entry in model.input_entries if entry.name in names]
    expressions = (None if entry.expression is None else str(entry.expression) for entry in entries)
    prescribed = equations.inputs.prescribed
    return tuple(
        Input(entry.name, expression, entry.of, entry.order, place in prescribed)
        for place, (entry, expression) in enumerate(zip(entries, expressions, strict=True))
    )


def _constraints(model: Model, equations: Equations, program: Program) -> Constraints:
    violation = equations.positions.violation.entries[: program.sizes.n_c]
    return Constraints(
        positions=equations.positions.formulas,
        position_rows=program.position_rows,
        invariants=equations.positions.invariants,
        are_stated=model.mechanism.states_velocity_constraints,
        velocity_rows=tuple(row for row, entry in enumerate(violation) if not entry),
    )


def _drawing(model: Model, equations: Equations) -> Drawing:
    picture, mechanism = equations.drawing.picture, model.mechanism
    return Drawing(
        points=tuple(Point(point.name, point.body) for point in picture.points),
        shapes=tuple(Shape(ShapeKind(shape.kind), shape.name, tuple(shape.points)) for shape in picture.shapes),
        not_drawn=tuple(picture.not_drawn),
        is_at_rest=picture.is_at_rest,
        forced_points=equations.drawing.forced,
        bodies=equations.bodies.names,
        body_shapes={},  # the C code does not depend on them
        gravity=gravity(mechanism.loads, mechanism.bodies, _values(model), mechanism.time),
    )


def _conditions(equations: Equations) -> tuple[str, ...]:
    """What the conditions of jumps belong to."""
    texts: dict[Scalar, str] = {}
    for jump in equations.jumps:
        text = f"{jump.function} of {written_out(jump.condition)}"
        is_plain = jump.function not in ("floor", "ceiling") and len(text) <= LONGEST
        texts.setdefault(jump.condition, text if is_plain else _of_leaves(jump))
    return tuple(texts[condition] for condition in equations.conditions.entries)


def _of_leaves(jump: Jump) -> str:
    return f"{jump.function} of {', '.join(map(str, map(written_out, jump.leaves)))}"


def _state_jumps(model: Model, equations: Equations, names: Mapping[str, Sequence[str]]) -> tuple[StateJump, ...]:
    """What jumps at times that are not known beforehand, in the equations or in the expression of an input."""
    inputs = _base_names(model, names["inputs"])
    found: dict[tuple[str, str, bool], bool] = {}
    for jump in equations.jumps:
        key = _of_leaves(jump), "" if jump.input is None else inputs[jump.input], jump.is_known
        found[key] = found.get(key, False) or jump.by_default
    return tuple(StateJump(name, of, by_default, known) for (name, of, known), by_default in found.items())


def _dependencies(model: Model, equations: Equations, names: Mapping[str, Sequence[str]]) -> Dependencies:
    e, tape, v = equations, equations.tape, equations.variables
    leaves = (*v.state, *v.parameters, *v.inputs, *v.accelerations, *v.multipliers, v.time)
    masks = {leaf.node: 1 << place for place, leaf in enumerate(leaves)}
    rows = {
        "coordinate_rates": e.dynamics.coordinate_rates.entries,
        "residual": e.dynamics.residual.entries,
        "position_violation": e.positions.violation.entries,
        "velocity_violation": e.velocities.violation.entries,
        "default_inputs": e.inputs.default.entries,
    }
    tape.spread(tape.reach(entry for entries in rows.values() for entry in entries), masks)
    timed, timed_by = _timed(model, equations, names)
    bits = {name: tuple(masks.get(entry.node, 0) for entry in entries) for name, entries in rows.items()}
    return Dependencies(bits, timed, timed_by)


def _base_names(model: Model, inputs: Sequence[str]) -> list[str]:
    """The names of the inputs of which these are, or are rates."""
    of = {entry.name: entry.of for entry in model.input_entries}
    return [of[name] for name in inputs]


def _timed(
    model: Model, equations: Equations, names: Mapping[str, Sequence[str]]
) -> tuple[tuple[str, ...], dict[str, tuple[str, ...]]]:
    """The parameters and inputs in terms that depend on time explicitly, or by an input's expression, such as the
    amplitude of a force; and those in terms that depend on each input, which may be given as a table of time.
    """
    e, tape = equations, equations.tape
    inputs = _base_names(model, names["inputs"])
    named = list(zip((*names["parameters"], *inputs), (*e.variables.parameters, *e.variables.inputs), strict=True))
    constraints = (*e.positions.violation.entries, *e.velocities.violation.entries)
    entries = [*e.dynamics.coordinate_rates.entries, *e.dynamics.residual.entries, *constraints]
    entries += e.inputs.default.entries
    nodes = tape.reach(entries)
    everything = {leaf.node: 1 << place for place, (_, leaf) in enumerate(named)}  # what a node depends on
    tape.spread(nodes, everything)

    def beside(leaves: Sequence[Scalar]) -> tuple[str, ...]:
        """What is in terms with these leaves: of a sum only those, of a product all factors, or terms of a factor."""
        dependent = tape.dependent(nodes, leaves)
        masks = {leaf.node: everything.get(leaf.node, 0) for leaf in leaves}
        for node in nodes:
            if node in dependent and node not in masks:
                operation, mask = tape.nodes[node], 0
                if isinstance(operation, Sum | Product):
                    for each in operands(operation):
                        is_factor = isinstance(operation, Product) and each not in dependent
                        mask |= masks.get(each, 0) | (everything.get(each, 0) if is_factor else 0)
                else:
                    mask = everything[node]
                masks[node] = mask
        found = reduce(or_, (masks.get(entry.node, 0) for entry in entries), 0)
        return tuple(dict.fromkeys(name for place, (name, _) in enumerate(named) if found >> place & 1))

    pairs = list(zip(inputs, e.variables.inputs, e.inputs.default.entries, strict=True))
    driven = [leaf for _, leaf, default in pairs if tape.depends([default], [e.variables.time])]
    by_input = {name: beside([leaf for other, leaf, _ in pairs if other == name]) for name in dict.fromkeys(inputs)}
    return beside([e.variables.time, *driven]), by_input


def _values(model: Model) -> dict[sm.Basic, Any]:
    """Numbers for parameters, also for those that are expressions of others."""
    values = {symbol: p.value for symbol, p in model.parameter_symbols.items() if p.value is not None}
    for symbol, expression in model.derived_parameters.items():
        values[symbol] = expression.xreplace(values)
    return {symbol: sm.sympify(value) for symbol, value in values.items()}


def _angles(model: Model, equations: Equations, names: Sequence[str]) -> tuple[str, ...]:
    """The coordinates whose sines or cosines the equations take, or of sums with numbers as factors.

    Not lengths along curves: x in sin(k x), where k may have any unit, or an x by which a point moves on after a turn.
    """
    tape = equations.tape
    calls = (node for node in tape.nodes if isinstance(node, Call) and node.expression.func in (sm.sin, sm.cos))
    arguments = {argument for call in calls for argument in call.arguments}
    for node in list(arguments):
        if isinstance(operation := tape.nodes[node], Sum):
            arguments.update(term for term, _ in operation.terms)
    leaves = zip(names, model.mechanism.coordinates, equations.variables.coordinates, strict=True)
    taken = {coordinate: name for name, coordinate, q in leaves if q.node in arguments}
    turning = _turning(model.mechanism)  # also if it rolls, as a wheel does
    return tuple(name for each, name in taken.items() if each in turning or not _moves_on(model.mechanism, each))


def _moves_on(mechanism: Mechanism, coordinate: sm.Expr) -> bool:
    """Whether a position or velocity has a coordinate beside its sines in a component, or a velocity its rate."""

    def has_beside_sines(entry: sm.Expr, instead: sm.Expr, *parts: sm.Expr) -> bool:
        calls = (call for call in entry.atoms(TrigonometricFunction) if call.has(coordinate))
        return bool(entry.has(*parts) and entry.xreplace(dict.fromkeys(calls, instead)).has(*parts))

    rate = coordinate.diff(mechanism.time)
    equations = [equation for equation in mechanism.kinematic_equations if equation.atoms(sm.Derivative) == {rate}]
    rates = {rate, *(speed for speed in mechanism.speeds if any(equation.has(speed) for equation in equations))}
    offsets = [point.offset for point in mechanism.points] + [point.offset for point in mechanism.drawn]
    places = [entry for offset in offsets for entry in entries_of(offset)]
    velocities = [entry for point in mechanism.points for entry in entries_of(point.velocity)]
    return any(has_beside_sines(entry, sm.Dummy(), coordinate) for entry in places + velocities) or any(
        has_beside_sines(entry, sm.S.Zero, *rates) for entry in velocities
    )


def _turning(mechanism: Mechanism) -> set[sm.Expr]:
    """What frames turn by: their direction cosines are polynomials in sines, unlike those of a curve's tangent."""
    found: set[sm.Expr] = set()
    for frame in mechanism.frames[1:]:
        for entry in frame.dcm or ():
            calls = entry.atoms(sm.sin, sm.cos)
            if entry.is_polynomial(*calls):
                terms = (term for call in calls for term in sm.Add.make_args(call.args[0]))
                found.update(term.as_coeff_Mul()[1] for term in terms)
    return found


def _geometry(equations: Equations, names: Sequence[str]) -> tuple[str, ...]:
    """The parameters that positions, velocity constraints and coordinates' rates depend on: lengths, not masses."""
    e = equations
    constraints = (e.positions.constraints, e.velocities.violation)
    results = (*constraints, e.dynamics.coordinate_rates, e.drawing.points, e.inputs.default)
    reached = {*e.tape.reach(entry for result in results for entry in result.entries)}
    return tuple(name for name, leaf in zip(names, e.variables.parameters, strict=True) if leaf.node in reached)


def _undetermined_outputs(equations: Equations, program: Program, names: Sequence[str]) -> tuple[str, ...]:
    """The outputs with multipliers that redundant constraints leave undetermined."""
    if program.sizes.rank == program.sizes.n_c:
        return ()
    pairs = zip(names, equations.outputs.entries, strict=True)
    return tuple(name for name, entry in pairs if equations.tape.depends([entry], equations.variables.multipliers))


def operations_of(functions: Sequence[Function]) -> Operations:
    """The operation counts of functions."""
    return Operations(
        counts={function.name: function.operations for function in functions},
        before_sharing={function.name: function.operations_before_sharing for function in functions},
    )
