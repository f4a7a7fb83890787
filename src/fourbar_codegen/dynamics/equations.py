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

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice
from typing import Any

import numpy as np
import sympy as sm
from numpy.typing import NDArray

from fourbar_codegen.dynamics.constraints import form_constraints, position_jacobian
from fourbar_codegen.dynamics.contradictions import find_contradictions
from fourbar_codegen.dynamics.corrections import form_corrections
from fourbar_codegen.dynamics.drawn_points import applied_forces, drawn_points
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematic_equations import solve_kinematics
from fourbar_codegen.dynamics.kinematics import Kinematics
from fourbar_codegen.dynamics.random_states import RandomStates
from fourbar_codegen.dynamics.unknown_forces import form_generalized_forces, form_unknown_forces
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.breakpoints import breakpoints
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp, Rounding, jacobian, vjp
from fourbar_codegen.expressions.formulas import formulas
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.tape import Result, Scalar, Tape
from fourbar_codegen.modeling.model import InputEntry, Model, multiplier
from fourbar_codegen.modeling.system_reader import DrawnPoint

__all__ = ["Equations", "check_velocity_constraints", "form_equations", "matrix"]

MOTIONS = 5
ROUNDED = 1e-9
"""What terms that cancel may leave of their size: states satisfy the constraints to some 1e-12."""


WITH_FORCES = frozenset(
    {"outputs", "state_rates", "residual", "force_effect", "force_effect_jacobian", "auxiliary_forcing"}
    | {"auxiliary_forcing_jacobian"}
)
"""The results that unknown forces which drive the motion may stand in."""


@dataclass(frozen=True)
class Equations:
    """The equations of a mechanism over one tape.

    Attributes
    ----------
    tape : Tape
    time : Scalar
    coordinates, speeds, auxiliary_states, parameters, inputs : tuple of Scalar
        The leaves, in the order of the state and argument arrays. Of the parameters, those that the model
        names or the equations need; of the inputs' rates, those of inputs that prescribe a motion.
    moving : tuple of int
        The inputs that positions, velocities or constraints depend on.
    accelerations : tuple of Scalar
        Leaves that stand for u' in `residual`, `state_rates` and `outputs`.
    multipliers : tuple of Scalar
        Leaves that stand for the constraints' multipliers there, and behind them for unknown forces n that drive the
        motion, (n_c + n_n,).
    n_dependent_speeds : int
    velocity_constraints_derived : bool
        Whether the velocity constraints begin with the rates of the position constraints but the invariants.
    position_rows : tuple of (int or None)
        For each position constraint the row of J that keeps it; None for invariants, and for redundant ones.
    invariants : tuple of int
        The position constraints whose rates are zero for all speeds.
    default_inputs : Result
        The inputs' expressions, (n_r,); NaN where there is none.
    breakpoints : Result
        The times at which any of these results has a jump or a kink, as far as they follow from parameters,
        (n_breakpoints,).
    n_jumps : int
        How many of these, which come first, are of positions or velocities.
    outputs : Result
        The outputs, (n_o,), for u' and multipliers in `accelerations` and `multipliers`.
    state_rates : Result
        z', (n_z,), likewise.
    coordinate_rates : Result
        q', (n_q,).
    mass_matrix, forcing : Result
        M, (n_u, n_u), and f, (n_u,), without unknown forces.
    force_effect, force_effect_jacobian : Result
        F(n), (n_u,), what unknown forces that drive the motion add to f, and dF/dn, (n_u, n_n).
    auxiliary_forcing, auxiliary_forcing_jacobian, auxiliary_mass, auxiliary_constraint_jacobian : Result
        Q(n), (n_n,), dQ/dn, (n_n, n_n), M_a, (n_n, n_u), and J_a^T, (n_n, n_c), of the auxiliary speeds' rows
        Q - M_a u' + J_a^T lambda = 0; none where no unknown force drives the motion.
    forces_are_linear : bool
        Whether these forces stand linearly in F and Q.
    position_constraints, position_jacobian : Result
        Phi, (n_h,), and dPhi/dq, (n_h, n_q).
    position_formulas : dict
        Phi as `formulas` writes it.
    constraint_jacobian, velocity_bias, acceleration_bias : Result
        J, (n_c, n_u); b and gamma, (n_c,). Rows of holonomic constraints first, if they are derived.
    position_violation, velocity_violation : Result
        By how much the constraints are violated, row by row as in J: Phi where a row is its rate, else 0, and behind
        them the invariants, (n_c + n_i,); and J u + b, (n_c,).
    position_scale, position_violation_scale, velocity_violation_scale : Result
        What violations of `position_constraints`, (n_h,), `position_violation` and `velocity_violation` are measured
        by: what rounding errors make of them.
    invariant_correction : Result
        The change of the coordinates that corrects violations of the invariants, (n_q,).
    coordinate_change : Result
        K du, (n_q,), the change of the coordinates that goes with a change of the speeds' integrals, which stands in
        `accelerations`.
    energies : Result
        Kinetic and potential energy, (2,); the latter NaN if it is not known.
    power : Result
        What all loads do, (1,); NaN if that is not what changes the kinetic energy. It is made into nothing but a test
        of the other results.
    drawn_points : tuple of DrawnPoint
    points : Result
        Their positions in the inertial frame, (n_points, 3).
    forced : tuple of int
        The points at which inputs' forces act.
    forces : Result
        These forces in the inertial frame, (n_forces, 3).
    not_orthonormal : tuple of Scalar
        What is zero where direction cosines are such, if that is not everywhere.
    warnings : tuple of str
        Where kinematics contradict themselves.
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
    drawn_points: tuple[DrawnPoint, ...]
    points: Result
    forced: tuple[int, ...]
    forces: Result
    residual: Result
    not_orthonormal: tuple[Scalar, ...]
    warnings: tuple[str, ...]

    @property
    def of_unknown_forces(self) -> tuple[Result, ...]:
        """What unknown forces that drive the motion make, all of it empty without them but F, which is zero then."""
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
        If the kinematic equations do not determine q', or are not linear in q' and u, or a velocity
        constraint is not linear in u, or unknown forces do not follow from the auxiliary speeds' equations, or
        the expression of an input that prescribes a motion does not have its rates everywhere.

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
    kane = Kane(tape, kinematics, virtual, v.u, v.aux, rate)
    kane.use_poisson_rates([rate, total_rate])
    mass_matrix = kane.mass_matrix()
    # f, and f - M u' with the rows of the auxiliary speeds last.
    generalized = form_generalized_forces(kane, rate, total_rate, v.unknown)
    forcing, balance = generalized.known[: len(v.u)], [*generalized.balance]
    not_orthonormal = kinematics.not_orthonormal()
    if not_orthonormal:
        # Off the norm of a quaternion, sums that go by other frames are others: derivatives are to be those of M and f.
        balance[: len(v.u)] = [
            tape.sum([force, *(-(entry * a) for entry, a in zip(row, v.a, strict=True))])
            for force, row in zip(forcing, mass_matrix, strict=True)
        ]
    if tape.depends([*chain(*mass_matrix), *balance, *generalized.acting], v.aux):
        raise ModelError("Velocities must be linear in the auxiliary speeds.")

    formed = tape.reach([*q_rates, *chain(*mass_matrix), *forcing])
    constraints = form_constraints(tape, mechanism, convert, convert_virtual, v.q, v.u, v.aux, rate, formed)
    lam = tuple(tape.leaf("l", number) for number in range(len(constraints.velocities)))
    # f - M u' + J^T lambda; and -(J u' + gamma), the rate of the constraints for given u'.
    reactions = vjp(tape, list(zip(constraints.virtual_velocities, lam, strict=True)), (*v.u, *v.aux))
    dynamic = [row + reaction for row, reaction in zip(balance[: len(v.u)], reactions, strict=False)]
    kinematic = [-total_rate(expr) for expr in constraints.velocities]

    forces = form_unknown_forces(tape, model, v.unknown, v.a, constraints, generalized, reactions)
    # From here on the unknown forces stand for themselves no more, but for those that drive the motion.
    leaves.update(zip(model.noncontributing, forces.values, strict=False))
    dynamic = [row + force for row, force in zip(dynamic, forces.effect, strict=True)]
    leaves.update(zip((speed.diff(mechanism.time) for speed in mechanism.speeds), v.a, strict=True))
    leaves.update({multiplier(number): symbol for number, symbol in enumerate(lam, start=1)})
    convert = Conversion(tape, leaves)
    state_rates = [convert(expr) for expr in model.state_equations.values()]
    leaves.update(zip((z.diff(mechanism.time) for z in model.state_equations), state_rates, strict=True))
    convert = Conversion(tape, leaves)
    changing = (v.time, *v.q, *v.u, *v.z, *v.r, *v.a, *lam, *v.unknown)
    values = _values(model, v)
    states = partial(RandomStates, tape, constraints, values, more=not_orthonormal)
    if model.potential_energy is not None:
        potential = convert(model.potential_energy)
    else:
        potential = _first_true(tape, kane.potential_energies(changing), lambda terms: states(terms).moving(v.u, v.a))
    energies = [kane.kinetic_energy(), potential]
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
        kinematics, constraints, rate, total_rate, with_rates, v.u, v.a, values, not_orthonormal
    )
    n_q, n_u, n_n = len(v.q), len(v.u), len(forces.driving)
    drawn, points, numbers = drawn_points(mechanism, kinematics)
    applied = applied_forces(tape, mechanism, kinematics, numbers, v.r, (*v.aux, *v.unknown))
    results = [
        _vector("outputs", [*forces.values, *(convert(expr) for expr in model.output_expressions.values())]),
        _vector("state_rates", state_rates),
        _vector("coordinate_rates", q_rates),
        matrix("mass_matrix", mass_matrix, n_u),
        _vector("forcing", forcing),
        _vector("force_effect", forces.effect),
        matrix("force_effect_jacobian", jacobian(tape, forces.effect, forces.driving), n_n),
        _vector("auxiliary_forcing", forces.forcing),
        matrix("auxiliary_forcing_jacobian", jacobian(tape, forces.forcing, forces.driving), n_n),
        matrix("auxiliary_mass", forces.mass, n_u),
        matrix("auxiliary_constraint_jacobian", forces.constraint_jacobian, len(lam)),
        _vector("position_constraints", constraints.positions),
        matrix("position_jacobian", position_jacobian(tape, constraints, v.q, q_rates, v.u), n_q),
        matrix("constraint_jacobian", constraints.jacobian, n_u),
        _vector("velocity_bias", substitute(tape, constraints.velocities, dict.fromkeys(v.u, tape.zero))),
        _vector("acceleration_bias", constraints.acceleration_bias),
        _vector("position_violation", corrections.violation),
        _vector("velocity_violation", constraints.velocities),
        _vector("position_scale", map(rounding, constraints.positions)),
        _vector("position_violation_scale", corrections.scale),
        _vector("velocity_violation_scale", map(rounding, constraints.velocities)),
        _vector("invariant_correction", corrections.coordinate_change),
        _vector("coordinate_change", map(Jvp(tape, dict(zip(v.u, v.a, strict=True))), q_rates)),
        _vector("energies", energies),
        _vector("power", [generalized.power]),
        matrix("points", points, 3),
        matrix("forces", list(applied.values()), 3),
        _vector("residual", (*dynamic, *kinematic, *forces.rows, *state_rates)),
    ]
    _check_places(tape, model, v.unknown, results)
    entries = [*chain.from_iterable(result.entries for result in results)]
    closing = (*constraints.positions, *constraints.velocities)
    inputs = _inputs(tape, model, v, entries, closing)
    moving = [*closing, energies[0], *chain(*points)]
    moved = set(tape.reach(moving))
    nan = tape.number(float("nan"))
    defaults = [nan if e.expression is None else convert(e.expression) for e in inputs.values()]
    default_inputs = _vector("inputs", defaults)
    entries += defaults
    moving += [default for leaf, default in zip(inputs, defaults, strict=True) if leaf.node in moved]
    jumps, is_complete = breakpoints(tape, v.time, moving)
    if not is_complete:
        pairs = zip(inputs.values(), defaults, strict=True)
        names = {entry.of for entry, default in pairs if not breakpoints(tape, v.time, [default])[1]}
        raise ModelError(
            f"A prescribed motion{', of input ' * bool(names)}{', '.join(sorted(names))} changes its form "
            "at times that cannot be read off, and its rate may jump there: its conditions may be linear or quadratic "
            f"in {mechanism.time}, with coefficients of parameters, or a table may be given for it."
        )
    others, _ = breakpoints(tape, v.time, [*dynamic, *kinematic, *forces.rows, *state_rates, *q_rates, *defaults])
    times = dict.fromkeys([*jumps, *others])
    reached = set(tape.reach(entries))
    needed = tuple(
        leaf
        for symbol, leaf in zip(model.parameter_symbols, v.p, strict=True)
        if symbol in model.named_parameters or leaf.node in reached
    )
    return Equations(
        tape=tape,
        time=v.time,
        coordinates=v.q,
        speeds=v.u,
        auxiliary_states=v.z,
        parameters=needed,
        inputs=tuple(inputs),
        moving=tuple(place for place, leaf in enumerate(inputs) if leaf.node in moved),
        accelerations=v.a,
        multipliers=(*lam, *forces.driving),
        forces_are_linear=generalized.are_linear,
        n_dependent_speeds=mechanism.n_dependent_speeds,
        velocity_constraints_derived=mechanism.velocity_constraints_derived,
        position_rows=corrections.rows,
        invariants=corrections.invariants,
        default_inputs=default_inputs,
        breakpoints=_vector("breakpoints", times),
        n_jumps=len(jumps),
        position_formulas=formulas(tape, constraints.positions),
        drawn_points=drawn,
        forced=tuple(applied),
        not_orthonormal=tuple(not_orthonormal),
        warnings=warnings,
        **{result.name: result for result in results},
    )


def check_velocity_constraints(model: Model) -> None:
    """Raise where the velocity constraints of a model do not keep its position constraints.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ModelError
        Likewise if the kinematic equations do not determine q', or a velocity constraint is not linear in u.

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
    """What stands on the tape for the model's symbols and functions of time; auxiliary speeds are zero."""
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
    """The leaves with the coordinates' rates, those rates, and differentiation with respect to time.

    That of a function of (q, u, r, t) with u held, or with u' given: of the inputs, those whose rates are inputs.
    """
    mechanism = model.mechanism
    leaves = _leaves(tape, model, v)
    q_rates = tuple(deduplicate(tape, solve_kinematics(tape, mechanism, leaves, v.u)))
    leaves.update(zip((c.diff(mechanism.time) for c in mechanism.coordinates), q_rates, strict=True))
    held = {v.time: tape.one, **dict(zip(v.q, q_rates, strict=True)), **_input_rates(model, v)}
    return leaves, q_rates, Jvp(tape, held), Jvp(tape, {**held, **dict(zip(v.u, v.a, strict=True))})


def _values(model: Model, v: _Variables) -> dict[Scalar, float]:
    """What the model gives values to."""
    values = {leaf: model.parameters[name].value for leaf, name in zip(v.p, model.parameters, strict=True)}
    values.update((leaf, model.initial.get(name)) for leaf, name in zip(v.q, model.coordinates, strict=True))
    return {leaf: float(value) for leaf, value in values.items() if value is not None}


def _check_places(tape: Tape, model: Model, unknown: Sequence[Scalar], results: Sequence[Result]) -> None:
    """Raise where unknown forces stand in what is evaluated before they are known."""
    for result in results:
        if result.name not in WITH_FORCES and tape.depends(result.entries, unknown):
            raise ModelError(
                f"The unknown forces {', '.join(str(f.func) for f in model.noncontributing)} stand in what makes the "
                f"{result.name.replace('_', ' ')}: they may stand in loads, state equations and outputs."
            )


def _input_rates(model: Model, v: _Variables) -> dict[Scalar, Scalar]:
    """The rates of those inputs whose rates are inputs too."""
    leaf_of = {entry.function: leaf for entry, leaf in zip(model.input_entries, v.r, strict=True)}
    rates = {leaf: leaf_of.get(function.diff(model.mechanism.time)) for function, leaf in leaf_of.items()}
    return {leaf: rate for leaf, rate in rates.items() if rate is not None}


def _inputs(
    tape: Tape, model: Model, v: _Variables, entries: Sequence[Scalar], closing: Sequence[Scalar]
) -> dict[Scalar, InputEntry]:
    """The inputs, and behind each that prescribes a motion its rates, by their leaves.

    It does where a rate of it has come into the equations, of which these are the entries. An input in the constraints
    does in any case: where the rows of J are others than the constraints' rates, its own rates do not stand in them.
    """
    of_leaf = dict(zip(v.r, model.input_entries, strict=True))
    reached, closed = set(tape.reach(entries)), set(tape.reach(closing))
    prescribing = {e.of for leaf, e in of_leaf.items() if leaf.node in (reached if e.order else closed)}
    needed = {leaf: entry for leaf, entry in of_leaf.items() if not entry.order or entry.of in prescribing}
    for entry in needed.values():
        if entry.order and entry.expression is not None and entry.expression.has(sm.Derivative, sm.Subs):
            raise ModelError(
                f"Input {entry.of} prescribes a motion, so that its first two rates are needed; its expression "
                f"{model.input_expressions[entry.function.expr]} does not have them everywhere."
            )
    return needed


def _first_true(
    tape: Tape,
    candidates: Iterable[tuple[Scalar, list[Scalar]]],
    motions: Callable[[Sequence[Scalar]], Iterator[NDArray[np.float64]]],
) -> Scalar:
    """The first of which the terms add up to zero, identically or in random motions; NaN if there is none."""
    for candidate, terms in candidates:
        if all(is_zero(tape, [tape.sum(terms)])):
            return candidate
        values = [*islice(motions(terms), MOTIONS)]
        if values and all(abs(v.sum()) <= ROUNDED * np.abs(v).sum() for v in values):
            return candidate
    return tape.number(float("nan"))


def _vector(name: str, entries: Iterable[Scalar]) -> Result:
    entries = tuple(entries)
    return Result(name, (len(entries),), entries)


def matrix(name: str, rows: Sequence[Sequence[Scalar]], columns: int) -> Result:
    """A result of given rows; there may be none, so that the number of columns is given as well."""
    return Result(name, (len(rows), columns), tuple(entry for row in rows for entry in row))
