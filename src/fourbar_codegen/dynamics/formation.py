"""Model -> Equations: Kane's equations and the constraints, as straight-line code.

Kane's method with intermediate variables (T. R. Kane and D. A. Levinson, *Dynamics: Theory and
Applications*, 1985, chapters 4 to 6), with all generalized speeds treated as independent:

    M(q, t, p) u' = f(q, u, t, p, r)

    M_rs = sum over bodies of  m v_r . v_s + w_r . I . w_s
    f_r  = sum over loads of  F . v_r + T . w_r  -  sum over bodies of  v_r . P* + w_r . H*

with partial velocities v_r = dv/du_r and w_r, and the rates P* of m v and H* of I . w for u' = 0. The
constraints J u + b = 0 enter as rows J u' + gamma = 0; they are solved numerically, in C.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, islice

import sympy as sm

from fourbar_codegen.dynamics.constraints import Constraints, form_constraints, position_jacobian
from fourbar_codegen.dynamics.contradictions import find_contradictions
from fourbar_codegen.dynamics.corrections import Corrections, form_corrections
from fourbar_codegen.dynamics.drawn_bodies import form_bodies
from fourbar_codegen.dynamics.drawn_positions import applied_forces, find_drawn_positions
from fourbar_codegen.dynamics.equations import (
    Drawing,
    DrivingForces,
    Dynamics,
    Energy,
    Equations,
    Inputs,
    PositionConstraints,
    Variables,
    VelocityConstraints,
    matrix,
    results_of,
    vector,
)
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematic_equations import solve_kinematics
from fourbar_codegen.dynamics.kinematics import Kinematics
from fourbar_codegen.dynamics.momenta import form_momenta
from fourbar_codegen.dynamics.potential import Potential, find_potential
from fourbar_codegen.dynamics.random_states import RandomStates, closed_states
from fourbar_codegen.dynamics.recursion import Recursion, form_recursion
from fourbar_codegen.dynamics.state_jumps import state_jumps
from fourbar_codegen.dynamics.unknown_forces import (
    GeneralizedForces,
    UnknownForces,
    find_forces_at_moving_points,
    form_generalized_forces,
    form_unknown_forces,
)
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.breakpoints import breakpoints
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp, Rounding, jacobian, vjp
from fourbar_codegen.expressions.formulas import formulas
from fourbar_codegen.expressions.identities import deduplicate
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.mechanism import Mechanism
from fourbar_codegen.modeling.model import InputEntry, Model, multiplier
from fourbar_codegen.runtime.enumerations import Role

__all__ = ["check_velocity_constraints", "form_equations"]

WITH_FORCES = ("state_rates", "residual")
"""Results of these parts that may contain unknown forces that drive the motion."""

N_CLOSED_STATES = 4
"""States at which redundant constraints are known, for a pivot order."""


def form_equations(model: Model) -> Equations:
    """Form the equations of motion of a model.

    Parameters
    ----------
    model : Model

    Returns
    -------
    Equations

    Raises
    ------
    ModelError
        If the kinematic equations do not determine q' or are not linear in q' and u; a velocity constraint is not
        linear in u; unknown forces do not follow from the auxiliary speeds' equations; or the expression of an input
        that prescribes a motion cannot be differentiated twice everywhere.

    Examples
    --------
    >>> from fourbar_codegen.models import four_bar
    >>> form_equations(four_bar()).velocities.jacobian.shape
    (2, 3)
    """
    m = _motion(model)
    kane = _kanes_equations(m)
    solved = _solved(m, kane)
    energy = _energy(m, kane, solved)
    rounding = Rounding(m.tape)
    corrections = form_corrections(
        m.tape,
        solved.constraints,
        m.v.q,
        m.v.u,
        rounding=rounding,
        values=solved.values,
        expressions=model.mechanism.holonomic_constraints,
    )
    warnings = _contradictions(m, kane, solved)
    drawing = _drawing(m)
    outputs = vector("outputs", [*solved.forces.values, *map(solved.convert, model.output_expressions.values())])
    driving_forces = _driving_forces(m, kane, solved)
    positions = _position_constraints(m, kane, solved, corrections, rounding)
    velocities = _velocity_constraints(m, solved, rounding)
    dynamics = _dynamics(m, kane, solved)
    _check_places(m, (dynamics, positions, velocities, energy, drawing))
    results = [outputs, *results_of(dynamics, driving_forces, positions, velocities, energy, drawing)]
    entries = [entry for result in results for entry in result.entries]
    closing = (*positions.constraints.entries, *velocities.violation.entries)
    moving = [*closing, energy.energies.entries[0], *drawing.points.entries]
    others = [*dynamics.residual.entries, *dynamics.coordinate_rates.entries]
    entry_of, inputs = _inputs(m, solved.convert, entries, closing, moving, others)
    variables = _variables(m, solved, tuple(entry_of), [*entries, *inputs.default.entries])
    equations = Equations(
        tape=m.tape,
        variables=variables,
        inputs=inputs,
        dynamics=dynamics,
        driving_forces=driving_forces,
        positions=replace(positions, closed_states=_closed_states(m, kane, solved)),
        velocities=velocities,
        outputs=outputs,
        energy=energy,
        quantities={Role.MOMENTA: form_momenta(kane.kane, drawing.picture, variables)},
        drawing=drawing,
        bodies=form_bodies(kane.kane, variables, model.drawn_frames),
        warnings=warnings,
        jumps=(),
        conditions=vector("conditions", ()),
    )
    jumps = state_jumps(
        equations, {leaf: solved.values[leaf] for leaf in variables.parameters if leaf in solved.values}
    )
    conditions = dict.fromkeys(jump.condition for jump in jumps if jump.leaves != (variables.time,))
    return replace(equations, jumps=jumps, conditions=vector("conditions", conditions))


@dataclass(frozen=True)
class _Leaves:
    """The leaves of the tape: time, q, u, z, parameters, inputs, u', auxiliary speeds, unknown forces."""

    time: Scalar
    q: tuple[Scalar, ...]
    u: tuple[Scalar, ...]
    z: tuple[Scalar, ...]
    p: tuple[Scalar, ...]
    r: tuple[Scalar, ...]
    a: tuple[Scalar, ...]
    aux: tuple[Scalar, ...]
    unknown: tuple[Scalar, ...]


@dataclass(frozen=True)
class _Motion:
    """How the mechanism moves.

    Attributes
    ----------
    model : Model
    tape : Tape
    v : _Leaves
    leaves : dict
        Scalars for symbols and functions of time, to which those are added that are solved for.
    q_rates : tuple of Scalar
        q'.
    rate, total_rate : Jvp
        Differentiation with respect to time of functions of (q, u, r, t), at constant u and for given u'. Inputs whose
        rates are no inputs count as constant.
    convert, convert_virtual : Conversion
        Without auxiliary speeds, and with them.
    kinematics, virtual : Kinematics
        Likewise.
    """

    model: Model
    tape: Tape
    v: _Leaves
    leaves: dict[sm.Basic, Scalar]
    q_rates: tuple[Scalar, ...]
    rate: Jvp
    total_rate: Jvp
    convert: Conversion
    convert_virtual: Conversion
    kinematics: Kinematics
    virtual: Kinematics

    @property
    def mechanism(self) -> Mechanism:
        """That of the model."""
        return self.model.mechanism


@dataclass(frozen=True)
class _KanesEquations:
    """Kane's equations with all speeds independent.

    Attributes
    ----------
    kane : Kane
    mass_matrix : list of list of Scalar
    forcing : sequence of Scalar
        f without unknown forces.
    balance : sequence of Scalar
        f - M u' without unknown forces, for given u'.
    generalized : GeneralizedForces
    recursion : Recursion or None
    not_orthonormal : sequence of Scalar
    """

    kane: Kane
    mass_matrix: Sequence[Sequence[Scalar]]
    forcing: Sequence[Scalar]
    balance: Sequence[Scalar]
    generalized: GeneralizedForces
    recursion: Recursion | None
    not_orthonormal: Sequence[Scalar]


@dataclass(frozen=True)
class _Solved:
    """The constraints, and the residual of all equations for given u' and multipliers.

    Attributes
    ----------
    constraints : Constraints
    multipliers : tuple of Scalar
        The leaves of lambda.
    forces : UnknownForces
    state_rates, residual : sequence of Scalar
    convert : Conversion
        Of expressions that contain u', lambda, unknown forces and z'.
    values : dict
        The values that the model gives to leaves.
    states : callable
        Random states that satisfy the constraints, for scalars.
    """

    constraints: Constraints
    multipliers: tuple[Scalar, ...]
    forces: UnknownForces
    state_rates: Sequence[Scalar]
    residual: Sequence[Scalar]
    convert: Conversion
    values: dict[Scalar, float]
    states: Callable[[Sequence[Scalar]], RandomStates]


def _motion(model: Model) -> _Motion:
    mechanism, tape = model.mechanism, Tape()
    v = _leaves_of(tape, model)
    leaves, q_rates, rate, total_rate = _rates(tape, model, v)
    leaves.update(zip(model.noncontributing, v.unknown, strict=True))
    convert = convert_virtual = Conversion(tape, leaves)
    kinematics = virtual = Kinematics(tape, mechanism, convert, rate)
    if v.aux:
        convert_virtual = Conversion(tape, {**leaves, **dict(zip(mechanism.auxiliary_speeds, v.aux, strict=True))})
        virtual = Kinematics(tape, mechanism, convert_virtual, rate)
    return _Motion(model, tape, v, leaves, q_rates, rate, total_rate, convert, convert_virtual, kinematics, virtual)


def _kanes_equations(m: _Motion) -> _KanesEquations:
    model, tape, v = m.model, m.tape, m.v
    reactions = [leaf for f, leaf in zip(model.noncontributing, v.unknown, strict=True) if f in (model.reactions or ())]
    kane = Kane(tape, m.kinematics, m.virtual, v.u, v.aux, m.rate, reactions=reactions)
    kane.use_poisson_rates([m.rate, m.total_rate])
    mass_matrix = kane.mass_matrix()
    # f, and f - M u' with the rows of the auxiliary speeds last.
    generalized = form_generalized_forces(kane, m.rate, m.total_rate, v.unknown)
    forcing, balance = generalized.known[: len(v.u)], [*generalized.balance]
    not_orthonormal = m.kinematics.not_orthonormal()
    side = tuple(tape.leaf("s", number) for number in range(len(v.u)))
    recursion = form_recursion(kane, m.rate, forcing, side, complete=not v.unknown)
    if recursion is not None and recursion.is_local:
        balance = kane.generalized_forces(m.total_rate, local=True)
    if not_orthonormal:
        # Where quaternions are not normalized, sums formed in other frames differ. All forms of M and f must agree.
        inertia = [tape.sum([entry * a for entry, a in zip(row, v.a, strict=True)]) for row in mass_matrix]
        if recursion is not None:
            forcing, mass_matrix = recursion.forcing.entries, jacobian(tape, recursion.product.entries, side)
            inertia = [*substitute(tape, recursion.product.entries, dict(zip(side, v.a, strict=True)))]
        balance[: len(v.u)] = [force - of_u for force, of_u in zip(forcing, inertia, strict=True)]
    if tape.depends([*chain(*mass_matrix), *balance, *generalized.acting], v.aux):
        raise ModelError("Velocities must be linear in the auxiliary speeds.")
    return _KanesEquations(kane, mass_matrix, forcing, balance, generalized, recursion, not_orthonormal)


def _solved(m: _Motion, kane: _KanesEquations) -> _Solved:
    model, mechanism, tape, v, leaves = m.model, m.mechanism, m.tape, m.v, m.leaves
    formed = tape.reach([*m.q_rates, *chain(*kane.mass_matrix), *kane.forcing])
    constraints = form_constraints(
        tape, mechanism, m.convert, m.convert_virtual, q=v.q, u=v.u, aux=v.aux, rate=m.rate, formed=formed
    )
    lam = tuple(tape.leaf("l", number) for number in range(len(constraints.velocities)))
    # f - M u' + J^T lambda; and -(J u' + gamma), the rate of the constraints for given u'.
    reactions = vjp(tape, list(zip(constraints.virtual_velocities, lam, strict=True)), (*v.u, *v.aux))
    dynamic = [row + reaction for row, reaction in zip(kane.balance[: len(v.u)], reactions, strict=False)]
    kinematic = [-m.total_rate(expr) for expr in constraints.velocities]
    forces = form_unknown_forces(
        tape, model, v.unknown, v.a, constraints, generalized=kane.generalized, reactions=reactions
    )
    # From here on, unknown forces that do not drive the motion are replaced by their solution.
    leaves.update(zip(model.noncontributing, forces.values, strict=False))
    dynamic = [row + force for row, force in zip(dynamic, forces.effect, strict=True)]
    leaves.update(zip((speed.diff(mechanism.time) for speed in mechanism.speeds), v.a, strict=True))
    leaves.update({multiplier(number): symbol for number, symbol in enumerate(lam, start=1)})
    convert = Conversion(tape, leaves)
    state_rates = [convert(expr) for expr in model.state_equations.values()]
    leaves.update(zip((z.diff(mechanism.time) for z in model.state_equations), state_rates, strict=True))
    values = _values(model, v)
    return _Solved(
        constraints=constraints,
        multipliers=lam,
        forces=forces,
        state_rates=state_rates,
        residual=(*dynamic, *kinematic, *forces.rows, *state_rates),
        convert=Conversion(tape, leaves),
        values=values,
        states=partial(RandomStates, tape, constraints, values, more=kane.not_orthonormal),
    )


def _energy(m: _Motion, kane: _KanesEquations, solved: _Solved) -> Energy:
    v, expression = m.v, m.model.potential_energy
    if expression is not None:
        potential = Potential(solved.convert(expression), ())
    else:
        potential = find_potential(
            m.kinematics,
            m.rate,
            coordinates=v.q,
            speeds=v.u,
            auxiliary_states=v.z,
            others=(v.time, *v.r, *v.a, *solved.multipliers, *v.unknown),
            input_rates=_input_rates(m.model, v).values(),
            motions=lambda terms, number: islice(solved.states(terms).moving(v.u, v.a), number),
        )
    energies = vector("energies", [kane.kane.kinetic_energy(), potential.energy])
    return Energy(energies, potential.without, vector("power", [kane.generalized.power]))


def _contradictions(m: _Motion, kane: _KanesEquations, solved: _Solved) -> tuple[str, ...]:
    """A sentence for each inconsistency of the kinematics."""
    mechanism, v, with_rates = m.mechanism, m.v, solved.convert
    was_set = any((body.acceleration, body.angular_acceleration) != (None, None) for body in mechanism.bodies)
    if was_set or mechanism.acceleration_constraints:
        second = zip(
            (q.diff((mechanism.time, 2)) for q in mechanism.coordinates), map(m.total_rate, m.q_rates), strict=True
        )
        zeros = dict.fromkeys((w.diff(mechanism.time) for w in mechanism.auxiliary_speeds), m.tape.zero)
        with_rates = Conversion(m.tape, {**m.leaves, **dict(second), **zeros})
    warnings = find_contradictions(
        m.kinematics,
        solved.constraints,
        m.rate,
        m.total_rate,
        with_rates,
        speeds=v.u,
        accelerations=v.a,
        values=solved.values,
        not_orthonormal=kane.not_orthonormal,
        motions=lambda: _default_motions(m.model, v, solved.convert),
    )
    if m.model.reactions is None and v.unknown:
        warnings += find_forces_at_moving_points(
            kane.kane, m.model, m.rate, v.unknown, solved.constraints, solved.states
        )
    return warnings


def _drawing(m: _Motion) -> Drawing:
    picture = find_drawn_positions(m.mechanism, m.kinematics)
    points = matrix("points", picture.positions, 3)
    unknown = (*m.v.aux, *m.v.unknown)
    applied = applied_forces(m.tape, m.mechanism, m.kinematics, picture.points, m.v.r, unknown)
    return Drawing(picture, points, tuple(applied), matrix("forces", list(applied.values()), 3))


def _driving_forces(m: _Motion, kane: _KanesEquations, solved: _Solved) -> DrivingForces:
    tape, forces, n_n = m.tape, solved.forces, len(solved.forces.driving)
    return DrivingForces(
        effect=vector("force_effect", forces.effect),
        effect_jacobian=matrix("force_effect_jacobian", jacobian(tape, forces.effect, forces.driving), n_n),
        forcing=vector("auxiliary_forcing", forces.forcing),
        forcing_jacobian=matrix("auxiliary_forcing_jacobian", jacobian(tape, forces.forcing, forces.driving), n_n),
        mass=matrix("auxiliary_mass", forces.mass, len(m.v.u)),
        constraint_jacobian=matrix(
            "auxiliary_constraint_jacobian", forces.constraint_jacobian, len(solved.multipliers)
        ),
        are_linear=kane.generalized.are_linear,
    )


def _position_constraints(
    m: _Motion, kane: _KanesEquations, solved: _Solved, corrections: Corrections, rounding: Rounding
) -> PositionConstraints:
    tape, constraints = m.tape, solved.constraints
    rows = position_jacobian(tape, constraints, m.v.q, m.q_rates, m.v.u)
    return PositionConstraints(
        constraints=vector("position_constraints", constraints.positions),
        jacobian=matrix("position_jacobian", rows, len(m.v.q)),
        formulas=formulas(tape, constraints.positions),
        rows=corrections.rows,
        invariants=corrections.invariants,
        violation=vector("position_violation", corrections.violation),
        scale=vector("position_scale", map(rounding, constraints.positions)),
        violation_scale=vector("position_violation_scale", corrections.scale),
        invariant_correction=vector("invariant_correction", corrections.coordinate_change),
        not_orthonormal=tuple(kane.not_orthonormal),
        closed_states=(),
    )


def _velocity_constraints(m: _Motion, solved: _Solved, rounding: Rounding) -> VelocityConstraints:
    constraints = solved.constraints
    bias = substitute(m.tape, constraints.velocities, dict.fromkeys(m.v.u, m.tape.zero))
    return VelocityConstraints(
        jacobian=matrix("constraint_jacobian", constraints.jacobian, len(m.v.u)),
        bias=vector("velocity_bias", bias),
        acceleration_bias=vector("acceleration_bias", constraints.acceleration_bias),
        violation=vector("velocity_violation", constraints.velocities),
        violation_scale=vector("velocity_violation_scale", map(rounding, constraints.velocities)),
        n_dependent_speeds=m.mechanism.n_dependent_speeds,
        are_derived=m.mechanism.velocity_constraints_derived,
    )


def _dynamics(m: _Motion, kane: _KanesEquations, solved: _Solved) -> Dynamics:
    along = Jvp(m.tape, dict(zip(m.v.u, m.v.a, strict=True)))
    return Dynamics(
        coordinate_rates=vector("coordinate_rates", m.q_rates),
        coordinate_change=vector("coordinate_change", map(along, m.q_rates)),
        mass_matrix=matrix("mass_matrix", kane.mass_matrix, len(m.v.u)),
        forcing=vector("forcing", kane.forcing),
        recursion=kane.recursion,
        state_rates=vector("state_rates", solved.state_rates),
        residual=vector("residual", solved.residual),
    )


def _inputs(
    m: _Motion,
    convert: Conversion,
    entries: Sequence[Scalar],
    closing: Sequence[Scalar],
    moving: Sequence[Scalar],
    others: Sequence[Scalar],
) -> tuple[dict[Scalar, InputEntry], Inputs]:
    """The inputs that the equations need, and what is known of them.

    Parameters
    ----------
    m : _Motion
    convert : Conversion
    entries : sequence of Scalar
        All entries of results.
    closing, moving, others : sequence of Scalar
        The constraints; these and what else moves; the rest of the equations of motion.
    """
    tape, v = m.tape, m.v
    entry_of = _needed_inputs(m, entries, closing)
    nan = tape.number(float("nan"))
    defaults = [nan if e.expression is None else convert(e.expression) for e in entry_of.values()]
    moved = set(tape.reach(moving))
    prescribed = [default for leaf, default in zip(entry_of, defaults, strict=True) if leaf.node in moved]
    jumps, is_complete = breakpoints(tape, v.time, [*moving, *prescribed])
    if not is_complete:
        pairs = zip(entry_of.values(), defaults, strict=True)
        names = {entry.of for entry, default in pairs if not breakpoints(tape, v.time, [default])[1]}
        raise ModelError(
            f"A prescribed motion{', of input ' * bool(names)}{', '.join(sorted(names))} changes its form "
            "at times that cannot be derived, and its rate may jump there. Write its conditions linear or quadratic "
            f"in {m.mechanism.time}, with coefficients of parameters, or give a table for it."
        )
    kinks, _ = breakpoints(tape, v.time, [*others, *defaults])
    places, rates = {leaf: place for place, leaf in enumerate(entry_of)}, _input_rates(m.model, v)
    return entry_of, Inputs(
        default=vector("inputs", defaults),
        rates=tuple((place, places[rates[leaf]]) for leaf, place in places.items() if rates.get(leaf) in places),
        prescribed=tuple(place for leaf, place in places.items() if leaf.node in moved),
        breakpoints=vector("breakpoints", dict.fromkeys([*jumps, *kinks])),
        n_motion_breakpoints=len(jumps),
    )


def _variables(m: _Motion, solved: _Solved, inputs: tuple[Scalar, ...], entries: Sequence[Scalar]) -> Variables:
    """The leaves; of the parameters those that are named, or that entries of results depend on."""
    model, v, reached = m.model, m.v, set(m.tape.reach(entries))
    return Variables(
        time=v.time,
        coordinates=v.q,
        speeds=v.u,
        auxiliary_states=v.z,
        parameters=tuple(
            leaf
            for symbol, leaf in zip(model.parameter_symbols, v.p, strict=True)
            if symbol in model.named_parameters or leaf.node in reached
        ),
        inputs=inputs,
        accelerations=v.a,
        multipliers=(*solved.multipliers, *solved.forces.driving),
    )


def _closed_states(m: _Motion, kane: _KanesEquations, solved: _Solved) -> tuple[dict[Scalar, float], ...]:
    """Some closed states, where constraints may be redundant."""
    if m.mechanism.n_dependent_speeds >= len(solved.multipliers):
        return ()
    zero, v = [*solved.constraints.positions, *kane.not_orthonormal], m.v
    states = closed_states(m.tape, zero, v.q, v.p, (v.time, *v.u, *v.r), solved.values)
    return tuple(islice(states, N_CLOSED_STATES))


def check_velocity_constraints(model: Model) -> None:
    """Raise if the velocity constraints of a model do not keep its position constraints.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ModelError
        Also if the kinematic equations do not determine q', or a velocity constraint is not linear in u.

    Examples
    --------
    >>> from fourbar_codegen.models import four_bar
    >>> check_velocity_constraints(four_bar())
    """
    mechanism = model.mechanism
    tape = Tape()
    v = _leaves_of(tape, model)
    leaves, _, rate, _ = _rates(tape, model, v)
    convert = Conversion(tape, leaves)
    constraints = form_constraints(tape, mechanism, convert, convert, q=v.q, u=v.u, aux=(), rate=rate, formed=())
    form_corrections(
        tape,
        constraints,
        v.q,
        v.u,
        rounding=Rounding(tape),
        values=_values(model, v),
        expressions=mechanism.holonomic_constraints,
    )


def _leaves_of(tape: Tape, model: Model) -> _Leaves:
    return _Leaves(
        time=tape.leaf("t", ""),
        q=tuple(tape.leaf("q", name) for name in model.coordinates),
        u=tuple(tape.leaf("u", name) for name in model.speeds),
        z=tuple(tape.leaf("z", name) for name in model.auxiliary_states),
        p=tuple(tape.leaf("p", name) for name in model.parameters),
        r=tuple(tape.leaf("r", name) for name in model.inputs),
        a=tuple(tape.leaf("a", name) for name in model.speeds),
        aux=tuple(tape.leaf("w", number) for number in range(len(model.mechanism.auxiliary_speeds))),
        unknown=tuple(tape.leaf("n", str(force.func)) for force in model.noncontributing),
    )


def _symbols(tape: Tape, model: Model, v: _Leaves) -> dict[sm.Basic, Scalar]:
    """The model's symbols and functions of time as scalars of the tape; auxiliary speeds are zero."""
    mechanism = model.mechanism
    leaves: dict[sm.Basic, Scalar] = {mechanism.time: v.time}
    leaves.update(zip(mechanism.coordinates, v.q, strict=True))
    leaves.update(zip(mechanism.speeds, v.u, strict=True))
    leaves.update(zip(model.state_equations, v.z, strict=True))
    leaves.update(dict.fromkeys(mechanism.auxiliary_speeds, tape.zero))
    leaves.update(zip(model.parameter_symbols, v.p, strict=True))
    for symbol, expr in model.derived_parameters.items():
        leaves[symbol] = Conversion(tape, leaves)(expr)
    leaves.update(zip((entry.function for entry in model.input_entries), v.r, strict=True))
    return leaves


def _rates(tape: Tape, model: Model, v: _Leaves) -> tuple[dict[sm.Basic, Scalar], tuple[Scalar, ...], Jvp, Jvp]:
    """The leaves with the coordinates' rates, these rates, and two differentiations with respect to time.

    Both are for functions of (q, u, r, t): one at constant u, one for given u'. Inputs whose rates are no inputs count
    as constant.
    """
    mechanism = model.mechanism
    leaves = _symbols(tape, model, v)
    q_rates = tuple(deduplicate(tape, solve_kinematics(tape, mechanism, leaves, v.u)))
    leaves.update(zip((c.diff(mechanism.time) for c in mechanism.coordinates), q_rates, strict=True))
    held = {v.time: tape.one, **dict(zip(v.q, q_rates, strict=True)), **_input_rates(model, v)}
    return leaves, q_rates, Jvp(tape, held), Jvp(tape, {**held, **dict(zip(v.u, v.a, strict=True))})


def _values(model: Model, v: _Leaves) -> dict[Scalar, float]:
    """The values that the model gives to leaves."""
    values = {leaf: model.parameters[name].value for leaf, name in zip(v.p, model.parameters, strict=True)}
    values.update((leaf, model.initial.get(name)) for leaf, name in zip(v.q, model.coordinates, strict=True))
    return {leaf: float(value) for leaf, value in values.items() if value is not None}


def _check_places(m: _Motion, parts: Sequence[object]) -> None:
    """Raise if unknown forces appear in results that are evaluated before they are known."""
    for result in results_of(*parts):
        if result.name not in WITH_FORCES and m.tape.depends(result.entries, m.v.unknown):
            raise ModelError(
                f"The unknown forces {', '.join(str(f.func) for f in m.model.noncontributing)} appear in the "
                f"{result.name.replace('_', ' ')}: they may appear only in loads, state equations and outputs."
            )


def _input_rates(model: Model, v: _Leaves) -> dict[Scalar, Scalar]:
    """The rates of those inputs whose rates are inputs too."""
    leaf_of = {entry.function: leaf for entry, leaf in zip(model.input_entries, v.r, strict=True)}
    rates = {leaf: leaf_of.get(function.diff(model.mechanism.time)) for function, leaf in leaf_of.items()}
    return {leaf: rate for leaf, rate in rates.items() if rate is not None}


def _default_motions(model: Model, v: _Leaves, convert: Conversion) -> dict[Scalar, Scalar]:
    """The inputs with a default expression of time, and their rates."""
    expressions = {str(function.func): expr for function, expr in model.input_expressions.items()}
    found = {}
    for leaf, entry in zip(v.r, model.input_entries, strict=True):
        base, own = expressions[entry.of], entry.expression
        if base is None or own is None or not base.has(model.mechanism.time) or own.has(sm.Derivative, sm.Subs):
            continue
        found[leaf] = convert(own)
    return found


def _needed_inputs(m: _Motion, entries: Sequence[Scalar], closing: Sequence[Scalar]) -> dict[Scalar, InputEntry]:
    """The inputs by their leaves; those that prescribe a motion are followed by their rates.

    An input prescribes a motion if one of its rates appears in the equations (`entries`), or if it appears in the
    constraints: where rows of J are not the constraints' rates, the rates of the input do not appear in them.
    """
    of_leaf = dict(zip(m.v.r, m.model.input_entries, strict=True))
    reached, closed = set(m.tape.reach(entries)), set(m.tape.reach(closing))
    prescribing = {e.of for leaf, e in of_leaf.items() if leaf.node in (reached if e.order else closed)}
    needed = {leaf: entry for leaf, entry in of_leaf.items() if not entry.order or entry.of in prescribing}
    for entry in needed.values():
        if entry.order and entry.expression is not None and entry.expression.has(sm.Derivative, sm.Subs):
            raise ModelError(
                f"Input {entry.of} prescribes a motion, so its first two derivatives are needed, but its expression "
                f"{m.model.input_expressions[entry.function.expr]} does not have them everywhere."
            )
    return needed
