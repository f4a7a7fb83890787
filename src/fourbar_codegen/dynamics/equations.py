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

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import Any

import sympy as sm

from fourbar_codegen.dynamics.constraints import form_constraints, position_jacobian
from fourbar_codegen.dynamics.contradictions import find_contradictions
from fourbar_codegen.dynamics.corrections import form_corrections
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematic_equations import solve_kinematics
from fourbar_codegen.dynamics.kinematics import Kinematics
from fourbar_codegen.dynamics.picture import Picture, applied_forces, find_picture
from fourbar_codegen.dynamics.potential import Potential, find_potential
from fourbar_codegen.dynamics.random_states import RandomStates, closed_states
from fourbar_codegen.dynamics.recursion import Recursion, form_recursion
from fourbar_codegen.dynamics.unknown_forces import (
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
from fourbar_codegen.expressions.tape import Result, Scalar, Tape
from fourbar_codegen.modeling.model import InputEntry, Model, multiplier

__all__ = ["Equations", "check_velocity_constraints", "form_equations", "matrix", "vector"]

CLOSED_STATES = 4
"""States at which redundant constraints are known, for a pivot order."""

WITH_FORCES = frozenset(
    {"outputs", "state_rates", "residual", "force_effect", "force_effect_jacobian", "auxiliary_forcing"}
    | {"auxiliary_forcing_jacobian"}
)
"""Results that may contain unknown forces that drive the motion."""


@dataclass(frozen=True)
class Equations:
    """The equations of a mechanism over one tape.

    Attributes
    ----------
    tape : Tape
    time : Scalar
    coordinates, speeds, auxiliary_states, parameters, inputs : tuple of Scalar
        The leaves, in the order of the state and argument arrays. Parameters are those that the model names or the
        equations need. Inputs that prescribe a motion are followed by their rates.
    input_rates : tuple of (int, int)
        Numbers of the inputs whose rates are inputs too, and of these.
    moving : tuple of int
        The inputs that positions, velocities or constraints depend on.
    accelerations : tuple of Scalar
        Leaves for u' in `residual`, `state_rates` and `outputs`.
    multipliers : tuple of Scalar
        Leaves for the constraints' multipliers there, then for unknown forces n that drive the motion, (n_c + n_n,).
    n_dependent_speeds : int
    velocity_constraints_derived : bool
        Whether the velocity constraints begin with the rates of the position constraints, except invariants.
    position_rows : tuple of (int or None)
        For each position constraint the row of J that keeps it; None for invariants and redundant constraints.
    invariants : tuple of int
        The position constraints whose rates are zero for all speeds.
    default_inputs : Result
        The inputs' expressions, (n_r,); NaN for inputs without one.
    breakpoints : Result
        Times at which the results have a jump or a kink, as far as these follow from parameters, (n_breakpoints,).
    n_jumps : int
        The number of breakpoints of positions or velocities, which come first.
    outputs : Result
        The outputs, (n_o,), in terms of `accelerations` and `multipliers`.
    state_rates : Result
        z', (n_z,), likewise.
    coordinate_rates : Result
        q', (n_q,).
    mass_matrix, forcing : Result
        M, (n_u, n_u), and f, (n_u,), without unknown forces.
    recursion : Recursion or None
        f, and products with M and its inverse, without M; None for few speeds, or bodies without mass.
    force_effect, force_effect_jacobian : Result
        F(n), (n_u,), the contribution of unknown forces that drive the motion to f, and dF/dn, (n_u, n_n).
    auxiliary_forcing, auxiliary_forcing_jacobian, auxiliary_mass, auxiliary_constraint_jacobian : Result
        Q(n), (n_n,), dQ/dn, (n_n, n_n), M_a, (n_n, n_u), and J_a^T, (n_n, n_c), of the auxiliary speeds' rows
        Q - M_a u' + J_a^T lambda = 0; empty if no unknown force drives the motion.
    forces_are_linear : bool
        Whether F and Q are linear in n.
    position_constraints, position_jacobian : Result
        Phi, (n_h,), and dPhi/dq, (n_h, n_q).
    position_formulas : dict
        Phi as plain data, made by `formulas`.
    constraint_jacobian, velocity_bias, acceleration_bias : Result
        J, (n_c, n_u); b and gamma, (n_c,). Rows of holonomic constraints first, if they are derived.
    position_violation, velocity_violation : Result
        Constraint violations: w of `Corrections` in the rows of J, then the invariants, (n_c + n_i,); and J u + b,
        (n_c,).
    position_scale, position_violation_scale, velocity_violation_scale : Result
        Scales of `position_constraints`, (n_h,), `position_violation` and `velocity_violation`: their rounding errors,
        by which violations are measured.
    invariant_correction : Result
        The change of the coordinates that corrects violations of the invariants, (n_q,).
    coordinate_change : Result
        K v, (n_q,), the change of the coordinates for a change v of the speeds' integrals; v is in `accelerations`.
    energies : Result
        Kinetic and potential energy, (2,); the latter NaN if it is not known.
    power : Result
        Power of the loads without unknown forces, (1,), only for tests of the other results; see `Kane.power`.
    picture : Picture
    points : Result
        Their positions in the inertial frame, (n_points, 3).
    forced : tuple of int
        Numbers of the drawn points at which forces of inputs act.
    forces : Result
        These forces in the inertial frame, (n_forces, 3).
    not_orthonormal : tuple of Scalar
        Scalars that are zero where direction cosines are orthonormal, but not identically.
    closed_states : tuple of dict
        Some states at which the position constraints hold, if fewer speeds are dependent than there are constraints.
    warnings : tuple of str
        A sentence for each inconsistency of the kinematics.
    energy_without : tuple of str
        Springs that the potential energy leaves out, since no antiderivative of their force was found.
    residual : Result
        (f + F - M u' + J^T lambda, -(J u' + gamma), Q - M_a u' + J_a^T lambda, z') for u' and multipliers in
        `accelerations` and `multipliers`, (n_u + n_c + n_n + n_z,), to be differentiated.
    """

    tape: Tape
    time: Scalar
    coordinates: tuple[Scalar, ...]
    speeds: tuple[Scalar, ...]
    auxiliary_states: tuple[Scalar, ...]
    parameters: tuple[Scalar, ...]
    inputs: tuple[Scalar, ...]
    input_rates: tuple[tuple[int, int], ...]
    moving: tuple[int, ...]
    accelerations: tuple[Scalar, ...]
    multipliers: tuple[Scalar, ...]
    n_dependent_speeds: int
    velocity_constraints_derived: bool
    position_rows: tuple[int | None, ...]
    invariants: tuple[int, ...]
    default_inputs: Result
    breakpoints: Result
    n_jumps: int
    outputs: Result
    state_rates: Result
    coordinate_rates: Result
    mass_matrix: Result
    forcing: Result
    recursion: Recursion | None
    force_effect: Result
    force_effect_jacobian: Result
    auxiliary_forcing: Result
    auxiliary_forcing_jacobian: Result
    auxiliary_mass: Result
    auxiliary_constraint_jacobian: Result
    forces_are_linear: bool
    position_constraints: Result
    position_jacobian: Result
    position_formulas: dict[str, Any]
    constraint_jacobian: Result
    velocity_bias: Result
    acceleration_bias: Result
    position_violation: Result
    velocity_violation: Result
    position_scale: Result
    position_violation_scale: Result
    velocity_violation_scale: Result
    invariant_correction: Result
    coordinate_change: Result
    energies: Result
    power: Result
    picture: Picture
    points: Result
    forced: tuple[int, ...]
    forces: Result
    residual: Result
    not_orthonormal: tuple[Scalar, ...]
    closed_states: tuple[dict[Scalar, float], ...]
    warnings: tuple[str, ...]
    energy_without: tuple[str, ...]

    @property
    def of_unknown_forces(self) -> tuple[Result, ...]:
        """Results for unknown forces that drive the motion; without such forces F is zero, and the others are empty."""
        return (
            self.force_effect,
            self.force_effect_jacobian,
            self.auxiliary_forcing,
            self.auxiliary_forcing_jacobian,
            self.auxiliary_mass,
            self.auxiliary_constraint_jacobian,
        )


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
    >>> form_equations(four_bar()).constraint_jacobian.shape
    (2, 3)
    """
    mechanism = model.mechanism
    tape = Tape()
    v = _variables(tape, model)
    leaves, q_rates, rate, total_rate = _rates(tape, model, v)
    leaves.update(zip(model.noncontributing, v.unknown, strict=True))
    convert = convert_virtual = Conversion(tape, leaves)

    kinematics = virtual = Kinematics(tape, mechanism, convert, rate)
    if v.aux:
        convert_virtual = Conversion(tape, {**leaves, **dict(zip(mechanism.auxiliary_speeds, v.aux, strict=True))})
        virtual = Kinematics(tape, mechanism, convert_virtual, rate)
    reactions = [leaf for f, leaf in zip(model.noncontributing, v.unknown, strict=True) if f in (model.reactions or ())]
    kane = Kane(tape, kinematics, virtual, v.u, v.aux, rate, reactions)
    kane.use_poisson_rates([rate, total_rate])
    mass_matrix = kane.mass_matrix()
    # f, and f - M u' with the rows of the auxiliary speeds last.
    generalized = form_generalized_forces(kane, rate, total_rate, v.unknown)
    forcing, balance = generalized.known[: len(v.u)], [*generalized.balance]
    not_orthonormal = kinematics.not_orthonormal()
    side = tuple(tape.leaf("s", number) for number in range(len(v.u)))
    recursion = form_recursion(kane, rate, forcing, side, complete=not v.unknown)
    if recursion is not None and recursion.is_local:
        balance = kane.generalized_forces(total_rate, local=True)
    if not_orthonormal:
        # Where quaternions are not normalized, sums formed in other frames differ. All forms of M and f must agree.
        inertia = [tape.sum([entry * a for entry, a in zip(row, v.a, strict=True)]) for row in mass_matrix]
        if recursion is not None:
            forcing, mass_matrix = recursion.forcing.entries, jacobian(tape, recursion.product.entries, side)
            inertia = [*substitute(tape, recursion.product.entries, dict(zip(side, v.a, strict=True)))]
        balance[: len(v.u)] = [force - of_u for force, of_u in zip(forcing, inertia, strict=True)]
    if tape.depends([*chain(*mass_matrix), *balance, *generalized.acting], v.aux):
        raise ModelError("Velocities must be linear in the auxiliary speeds.")

    formed = tape.reach([*q_rates, *chain(*mass_matrix), *forcing])
    constraints = form_constraints(tape, mechanism, convert, convert_virtual, v.q, v.u, v.aux, rate, formed)
    lam = tuple(tape.leaf("l", number) for number in range(len(constraints.velocities)))
    # f - M u' + J^T lambda; and -(J u' + gamma), the rate of the constraints for given u'.
    of_constraints = vjp(tape, list(zip(constraints.virtual_velocities, lam, strict=True)), (*v.u, *v.aux))
    dynamic = [row + reaction for row, reaction in zip(balance[: len(v.u)], of_constraints, strict=False)]
    kinematic = [-total_rate(expr) for expr in constraints.velocities]

    forces = form_unknown_forces(tape, model, v.unknown, v.a, constraints, generalized, of_constraints)
    # From here on, unknown forces that do not drive the motion are replaced by their solution.
    leaves.update(zip(model.noncontributing, forces.values, strict=False))
    dynamic = [row + force for row, force in zip(dynamic, forces.effect, strict=True)]
    leaves.update(zip((speed.diff(mechanism.time) for speed in mechanism.speeds), v.a, strict=True))
    leaves.update({multiplier(number): symbol for number, symbol in enumerate(lam, start=1)})
    convert = Conversion(tape, leaves)
    state_rates = [convert(expr) for expr in model.state_equations.values()]
    leaves.update(zip((z.diff(mechanism.time) for z in model.state_equations), state_rates, strict=True))
    convert = Conversion(tape, leaves)
    values = _values(model, v)
    states = partial(RandomStates, tape, constraints, values, more=not_orthonormal)
    if model.potential_energy is not None:
        potential = Potential(convert(model.potential_energy), ())
    else:
        changing = (v.time, *v.r, *v.a, *lam, *v.unknown)
        potential = find_potential(
            kinematics,
            rate,
            v.q,
            v.u,
            v.z,
            changing,
            _input_rates(model, v).values(),
            lambda terms, number: islice(states(terms).moving(v.u, v.a), number),
        )
    energies = [kane.kinetic_energy(), potential.energy]
    rounding = Rounding(tape)
    corrections = form_corrections(tape, constraints, v.q, v.u, rounding, values, mechanism.holonomic_constraints)
    with_rates = convert
    was_set = any((body.acceleration, body.angular_acceleration) != (None, None) for body in mechanism.bodies)
    if was_set or mechanism.acceleration_constraints:
        second = zip(
            (q.diff((mechanism.time, 2)) for q in mechanism.coordinates), map(total_rate, q_rates), strict=True
        )
        zeros = dict.fromkeys((w.diff(mechanism.time) for w in mechanism.auxiliary_speeds), tape.zero)
        with_rates = Conversion(tape, {**leaves, **dict(second), **zeros})
    warnings = find_contradictions(
        kinematics,
        constraints,
        rate,
        total_rate,
        with_rates,
        v.u,
        v.a,
        values,
        not_orthonormal,
        lambda: _default_motions(model, v, convert),
    )
    if model.reactions is None and v.unknown:
        warnings += find_forces_at_moving_points(kane, model, rate, v.unknown, constraints, states)
    n_q, n_u, n_n = len(v.q), len(v.u), len(forces.driving)
    picture = find_picture(mechanism, kinematics)
    points = picture.positions
    applied = applied_forces(tape, mechanism, kinematics, picture.points, v.r, (*v.aux, *v.unknown))
    results = [
        vector("outputs", [*forces.values, *(convert(expr) for expr in model.output_expressions.values())]),
        vector("state_rates", state_rates),
        vector("coordinate_rates", q_rates),
        matrix("mass_matrix", mass_matrix, n_u),
        vector("forcing", forcing),
        vector("force_effect", forces.effect),
        matrix("force_effect_jacobian", jacobian(tape, forces.effect, forces.driving), n_n),
        vector("auxiliary_forcing", forces.forcing),
        matrix("auxiliary_forcing_jacobian", jacobian(tape, forces.forcing, forces.driving), n_n),
        matrix("auxiliary_mass", forces.mass, n_u),
        matrix("auxiliary_constraint_jacobian", forces.constraint_jacobian, len(lam)),
        vector("position_constraints", constraints.positions),
        matrix("position_jacobian", position_jacobian(tape, constraints, v.q, q_rates, v.u), n_q),
        matrix("constraint_jacobian", constraints.jacobian, n_u),
        vector("velocity_bias", substitute(tape, constraints.velocities, dict.fromkeys(v.u, tape.zero))),
        vector("acceleration_bias", constraints.acceleration_bias),
        vector("position_violation", corrections.violation),
        vector("velocity_violation", constraints.velocities),
        vector("position_scale", map(rounding, constraints.positions)),
        vector("position_violation_scale", corrections.scale),
        vector("velocity_violation_scale", map(rounding, constraints.velocities)),
        vector("invariant_correction", corrections.coordinate_change),
        vector("coordinate_change", map(Jvp(tape, dict(zip(v.u, v.a, strict=True))), q_rates)),
        vector("energies", energies),
        vector("power", [generalized.power]),
        matrix("points", points, 3),
        matrix("forces", list(applied.values()), 3),
        vector("residual", (*dynamic, *kinematic, *forces.rows, *state_rates)),
    ]
    _check_places(tape, model, v.unknown, results)
    entries = [*chain.from_iterable(result.entries for result in results)]
    closing = (*constraints.positions, *constraints.velocities)
    inputs = _inputs(tape, model, v, entries, closing)
    moving = [*closing, energies[0], *chain(*points)]
    moved = set(tape.reach(moving))
    nan = tape.number(float("nan"))
    defaults = [nan if e.expression is None else convert(e.expression) for e in inputs.values()]
    default_inputs = vector("inputs", defaults)
    entries += defaults
    moving += [default for leaf, default in zip(inputs, defaults, strict=True) if leaf.node in moved]
    jumps, is_complete = breakpoints(tape, v.time, moving)
    if not is_complete:
        pairs = zip(inputs.values(), defaults, strict=True)
        names = {entry.of for entry, default in pairs if not breakpoints(tape, v.time, [default])[1]}
        raise ModelError(
            f"A prescribed motion{', of input ' * bool(names)}{', '.join(sorted(names))} changes its form "
            "at times that cannot be derived, and its rate may jump there. Write its conditions linear or quadratic "
            f"in {mechanism.time}, with coefficients of parameters, or give a table for it."
        )
    others, _ = breakpoints(tape, v.time, [*dynamic, *kinematic, *forces.rows, *state_rates, *q_rates, *defaults])
    times = dict.fromkeys([*jumps, *others])
    reached, rates = set(tape.reach(entries)), _input_rates(model, v)
    needed = tuple(
        leaf
        for symbol, leaf in zip(model.parameter_symbols, v.p, strict=True)
        if symbol in model.named_parameters or leaf.node in reached
    )
    closed: Iterator[dict[Scalar, float]] = iter(())
    if mechanism.n_dependent_speeds < len(lam):
        zero = [*constraints.positions, *not_orthonormal]
        closed = closed_states(tape, zero, v.q, v.p, (v.time, *v.u, *v.r), values)
    return Equations(
        tape=tape,
        time=v.time,
        coordinates=v.q,
        speeds=v.u,
        auxiliary_states=v.z,
        parameters=needed,
        inputs=tuple(inputs),
        input_rates=tuple(
            (place, [*inputs].index(rates[leaf])) for place, leaf in enumerate(inputs) if rates.get(leaf) in inputs
        ),
        moving=tuple(place for place, leaf in enumerate(inputs) if leaf.node in moved),
        accelerations=v.a,
        multipliers=(*lam, *forces.driving),
        forces_are_linear=generalized.are_linear,
        n_dependent_speeds=mechanism.n_dependent_speeds,
        velocity_constraints_derived=mechanism.velocity_constraints_derived,
        position_rows=corrections.rows,
        invariants=corrections.invariants,
        default_inputs=default_inputs,
        breakpoints=vector("breakpoints", times),
        n_jumps=len(jumps),
        position_formulas=formulas(tape, constraints.positions),
        picture=picture,
        forced=tuple(applied),
        not_orthonormal=tuple(not_orthonormal),
        recursion=recursion,
        closed_states=tuple(islice(closed, CLOSED_STATES)),
        warnings=warnings,
        energy_without=potential.without,
        **{result.name: result for result in results},
    )


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
    v = _variables(tape, model)
    leaves, _, rate, _ = _rates(tape, model, v)
    convert = Conversion(tape, leaves)
    constraints = form_constraints(tape, mechanism, convert, convert, v.q, v.u, (), rate, ())
    values, expressions = _values(model, v), mechanism.holonomic_constraints
    form_corrections(tape, constraints, v.q, v.u, Rounding(tape), values, expressions)


@dataclass(frozen=True)
class _Variables:
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


def _variables(tape: Tape, model: Model) -> _Variables:
    return _Variables(
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


def _leaves(tape: Tape, model: Model, v: _Variables) -> dict[sm.Basic, Scalar]:
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


def _rates(tape: Tape, model: Model, v: _Variables) -> tuple[dict[sm.Basic, Scalar], tuple[Scalar, ...], Jvp, Jvp]:
    """The leaves with the coordinates' rates, these rates, and two differentiations with respect to time.

    Both are for functions of (q, u, r, t): one at constant u, one for given u'. Inputs whose rates are no inputs count
    as constant.
    """
    mechanism = model.mechanism
    leaves = _leaves(tape, model, v)
    q_rates = tuple(deduplicate(tape, solve_kinematics(tape, mechanism, leaves, v.u)))
    leaves.update(zip((c.diff(mechanism.time) for c in mechanism.coordinates), q_rates, strict=True))
    held = {v.time: tape.one, **dict(zip(v.q, q_rates, strict=True)), **_input_rates(model, v)}
    return leaves, q_rates, Jvp(tape, held), Jvp(tape, {**held, **dict(zip(v.u, v.a, strict=True))})


def _values(model: Model, v: _Variables) -> dict[Scalar, float]:
    """The values that the model gives to leaves."""
    values = {leaf: model.parameters[name].value for leaf, name in zip(v.p, model.parameters, strict=True)}
    values.update((leaf, model.initial.get(name)) for leaf, name in zip(v.q, model.coordinates, strict=True))
    return {leaf: float(value) for leaf, value in values.items() if value is not None}


def _check_places(tape: Tape, model: Model, unknown: Sequence[Scalar], results: Sequence[Result]) -> None:
    """Raise if unknown forces appear in results that are evaluated before they are known."""
    for result in results:
        if result.name not in WITH_FORCES and tape.depends(result.entries, unknown):
            raise ModelError(
                f"The unknown forces {', '.join(str(f.func) for f in model.noncontributing)} appear in the "
                f"{result.name.replace('_', ' ')}: they may appear only in loads, state equations and outputs."
            )


def _input_rates(model: Model, v: _Variables) -> dict[Scalar, Scalar]:
    """The rates of those inputs whose rates are inputs too."""
    leaf_of = {entry.function: leaf for entry, leaf in zip(model.input_entries, v.r, strict=True)}
    rates = {leaf: leaf_of.get(function.diff(model.mechanism.time)) for function, leaf in leaf_of.items()}
    return {leaf: rate for leaf, rate in rates.items() if rate is not None}


def _default_motions(model: Model, v: _Variables, convert: Conversion) -> dict[Scalar, Scalar]:
    """The inputs with a default expression of time, and their rates."""
    expressions = {str(function.func): expr for function, expr in model.input_expressions.items()}
    found = {}
    for leaf, entry in zip(v.r, model.input_entries, strict=True):
        base, own = expressions[entry.of], entry.expression
        if base is None or own is None or not base.has(model.mechanism.time) or own.has(sm.Derivative, sm.Subs):
            continue
        found[leaf] = convert(own)
    return found


def _inputs(
    tape: Tape, model: Model, v: _Variables, entries: Sequence[Scalar], closing: Sequence[Scalar]
) -> dict[Scalar, InputEntry]:
    """The inputs by their leaves; those that prescribe a motion are followed by their rates.

    An input prescribes a motion if one of its rates appears in the equations (`entries`), or if it appears in the
    constraints: where rows of J are not the constraints' rates, the rates of the input do not appear in them.
    """
    of_leaf = dict(zip(v.r, model.input_entries, strict=True))
    reached, closed = set(tape.reach(entries)), set(tape.reach(closing))
    prescribing = {e.of for leaf, e in of_leaf.items() if leaf.node in (reached if e.order else closed)}
    needed = {leaf: entry for leaf, entry in of_leaf.items() if not entry.order or entry.of in prescribing}
    for entry in needed.values():
        if entry.order and entry.expression is not None and entry.expression.has(sm.Derivative, sm.Subs):
            raise ModelError(
                f"Input {entry.of} prescribes a motion, so its first two derivatives are needed, but its expression "
                f"{model.input_expressions[entry.function.expr]} does not have them everywhere."
            )
    return needed


def vector(name: str, entries: Iterable[Scalar]) -> Result:
    """A result of one dimension."""
    entries = tuple(entries)
    return Result(name, (len(entries),), entries)


def matrix(name: str, rows: Sequence[Sequence[Scalar]], columns: int) -> Result:
    """A result with given rows; the number of columns counts where there are none."""
    return Result(name, (len(rows), columns), tuple(entry for row in rows for entry in row))
