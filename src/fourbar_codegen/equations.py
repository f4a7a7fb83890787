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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.kane import Kane
from fourbar_codegen.kinematics import solve_kinematics
from fourbar_codegen.linear import TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.mechanism import Mechanism
from fourbar_codegen.model import Model, multiplier
from fourbar_codegen.program import Result
from fourbar_codegen.tape import Direction, Tape

__all__ = ["Equations", "form_equations"]


@dataclass(frozen=True)
class Equations:
    """The equations of a mechanism over one tape.

    Attributes
    ----------
    tape : Tape
    time : Symbol
    coordinates, speeds, parameters, inputs : tuple of Symbol
        The leaves, in the order of the state and argument arrays. Of the parameters, those that the model
        names or the equations need.
    accelerations : tuple of Symbol
        Leaves that stand for u' in `residual_jacobian`.
    multipliers : tuple of Symbol
        Leaves that stand for the constraints' multipliers there.
    n_dependent_speeds : int
    default_inputs : Result
        The inputs' expressions, (n_r,); NaN where there is none.
    outputs : Result
        The outputs, (n_o,), for u' and multipliers in `accelerations` and `multipliers`.
    coordinate_rates : Result
        q', (n_q,).
    mass_matrix, forcing : Result
        M, (n_u, n_u), and f, (n_u,).
    position_constraints, position_jacobian : Result
        Phi, (n_h,), and dPhi/dq, (n_h, n_q).
    constraint_jacobian, velocity_bias, acceleration_bias : Result
        J, (n_c, n_u); b and gamma, (n_c,). Rows of holonomic constraints first, if they are derived.
    energies : Result
        Kinetic and potential energy, (2,); the latter NaN if a position that it needs is not defined.
    velocity_jacobian, velocity_input_jacobian : Result
        d(J u + b)/dq, (n_c, n_q), and d(J u + b)/dr, (n_c, n_r).
    position_input_jacobian : Result
        dPhi/dr, (n_h, n_r).
    coordinate_rate_jacobian, coordinate_rate_parameter_jacobian, coordinate_rate_input_jacobian : Result
        Derivatives of q' with respect to x, p and r, (n_q, n_x), (n_q, n_p) and (n_q, n_r).
    residual_jacobian, residual_parameter_jacobian, residual_input_jacobian : Result
        Derivatives of (f - M u' + J^T lambda, -(J u' + gamma)) at fixed u' and lambda, (n_u + n_c, n_x),
        (n_u + n_c, n_p) and (n_u + n_c, n_r).
    """

    tape: Tape
    time: sm.Symbol
    coordinates: tuple[sm.Symbol, ...]
    speeds: tuple[sm.Symbol, ...]
    parameters: tuple[sm.Symbol, ...]
    inputs: tuple[sm.Symbol, ...]
    accelerations: tuple[sm.Symbol, ...]
    multipliers: tuple[sm.Symbol, ...]
    n_dependent_speeds: int
    default_inputs: Result
    outputs: Result
    coordinate_rates: Result
    mass_matrix: Result
    forcing: Result
    position_constraints: Result
    position_jacobian: Result
    constraint_jacobian: Result
    velocity_bias: Result
    acceleration_bias: Result
    energies: Result
    velocity_jacobian: Result
    velocity_input_jacobian: Result
    position_input_jacobian: Result
    coordinate_rate_jacobian: Result
    coordinate_rate_parameter_jacobian: Result
    coordinate_rate_input_jacobian: Result
    residual_jacobian: Result
    residual_parameter_jacobian: Result
    residual_input_jacobian: Result


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
        constraint is not linear in u, or unknown forces do not follow from the auxiliary speeds' equations.

    Examples
    --------
    >>> from fourbar_codegen.models import four_bar
    >>> form_equations(four_bar()).constraint_jacobian.shape
    (2, 3)
    """
    mechanism = model.mechanism
    tape = Tape()
    time = sm.Symbol("t:", real=True)
    q = tuple(sm.Symbol(f"q:{name}", real=True) for name in model.coordinates)
    u = tuple(sm.Symbol(f"u:{name}", real=True) for name in model.speeds)
    p = tuple(sm.Symbol(f"p:{name}", real=True) for name in model.parameters)
    r = tuple(sm.Symbol(f"r:{name}", real=True) for name in model.inputs)
    speeds = mechanism.speeds
    aux = tuple(sm.Symbol(f"w:{number}", real=True) for number in range(len(mechanism.auxiliary_speeds)))
    n_q, n_u = len(q), len(u)

    leaves: dict[sm.Basic, sm.Expr] = {mechanism.time: time}
    leaves.update(zip(mechanism.coordinates, q, strict=True))
    leaves.update(zip(speeds, u, strict=True))
    leaves.update(dict.fromkeys(mechanism.auxiliary_speeds, sm.S.Zero))
    leaves.update(zip(model.parameter_symbols, p, strict=True))
    for symbol, expr in model.derived_parameters.items():
        leaves[symbol] = tape.convert(expr, leaves)
    r_of = {entry.function: symbol for entry, symbol in zip(model.input_entries, r, strict=True)}
    leaves.update(r_of)
    q_rates = solve_kinematics(tape, mechanism, leaves, u)
    leaves.update(zip((c.diff(mechanism.time) for c in mechanism.coordinates), q_rates, strict=True))
    unknown = tuple(sm.Symbol(f"n:{number}", real=True) for number in range(len(model.noncontributing)))
    leaves.update(zip(model.noncontributing, unknown, strict=True))

    along = {symbol: Direction(tape, {symbol: sm.S.One}) for symbol in (*q, *u, *aux, *unknown)}
    along_u = [along[symbol] for symbol in u]
    # The rate of a function of (q, u, r, t) while u is held: of the inputs, those whose rates are inputs too.
    r_rates = {symbol: r_of[f.diff(mechanism.time)] for f, symbol in r_of.items() if f.diff(mechanism.time) in r_of}
    rate = Direction(tape, {time: sm.S.One, **dict(zip(q, q_rates, strict=True)), **r_rates})

    auxiliary = dict(zip(mechanism.auxiliary_speeds, aux, strict=True))
    kane = Kane(tape, mechanism, leaves, auxiliary, [along[symbol] for symbol in (*u, *aux)], rate)
    kane.use_poisson_rates()
    mass_matrix, forcing = kane.mass_matrix_and_forcing()
    constraints = _constraints(tape, mechanism, leaves, auxiliary, along_u, [along[symbol] for symbol in aux], rate)
    for number, row in enumerate(constraints.jacobian, start=1):
        if tape.depends(row, u):
            raise ModelError(f"Velocity constraint {number} is not linear in the generalized speeds.")
    n_c = len(constraints.velocities)
    at_rest = dict.fromkeys(u, sm.S.Zero)
    velocity_bias = tuple(_substitute(tape, expr, at_rest) for expr in constraints.velocities)

    a = tuple(sm.Symbol(f"a:{name}", real=True) for name in model.speeds)
    lam = tuple(sm.Symbol(f"l:{number}", real=True) for number in range(n_c))

    # The unknown forces, which auxiliary speeds bring out, act through these columns.
    balance = kane.balance(a)
    columns = [[along[symbol](entry) for entry in balance] for symbol in unknown]
    balance = [_substitute(tape, entry, dict.fromkeys(unknown, sm.S.Zero)) for entry in balance]
    forcing = [_substitute(tape, entry, dict.fromkeys(unknown, sm.S.Zero)) for entry in forcing]
    if tape.depends([*chain(*mass_matrix, *columns), *balance], {*aux, *unknown}):
        raise ModelError("Velocities must be linear in the auxiliary speeds, and loads in the unknown forces.")

    # f - M u' + J^T lambda, the rows of the auxiliary speeds last; and -(J u' + gamma).
    lines = constraints.rows()
    dynamic = [
        tape.define(row + sum(tape.define(line[i] * symbol) for line, symbol in zip(lines, lam, strict=True)))
        for i, row in enumerate(balance)
    ]
    kinematic = [
        tape.define(-bias - sum(tape.define(entry * symbol) for entry, symbol in zip(row, a, strict=True)))
        for row, bias in zip(constraints.jacobian, constraints.acceleration_bias, strict=True)
    ]

    # What keeps the auxiliary speeds zero: Q = M u' - f - J^T lambda in their rows, or the forces that give it.
    forces: tuple[sm.Expr, ...] | None = tuple(tape.define(-row) for row in dynamic[n_u:])
    if unknown:
        forces = _noncontributing(tape, columns, constraints, dynamic[n_u:], n_u - mechanism.n_dependent_speeds)
    if forces is None:
        names = ", ".join(str(f.func) for f in model.noncontributing)
        raise ModelError(
            f"The unknown forces {names} do not follow from the auxiliary speeds "
            f"{', '.join(str(w.func) for w in mechanism.auxiliary_speeds)}: they do work in the motion itself, "
            "or at no auxiliary speed. Forces that are known are named in inputs=."
        )
    leaves.update(zip(model.noncontributing, forces, strict=False))
    leaves.update(zip((speed.diff(mechanism.time) for speed in speeds), a, strict=True))
    leaves.update({multiplier(number): symbol for number, symbol in enumerate(lam, start=1)})
    outputs = (*forces, *(tape.convert(expr, leaves) for expr in model.output_expressions.values()))

    changing = {time, *q, *u, *r, *a, *lam}
    defaults = [sm.S.NaN if e.expression is None else tape.convert(e.expression, leaves) for e in model.input_entries]
    results = {
        "default_inputs": _vector("inputs", defaults),
        "outputs": _vector("outputs", outputs),
        "coordinate_rates": _vector("coordinate_rates", q_rates),
        "mass_matrix": _matrix("mass_matrix", mass_matrix, n_u),
        "forcing": _vector("forcing", forcing),
        "position_constraints": _vector("position_constraints", constraints.positions),
        "position_jacobian": _matrix(
            "position_jacobian", [[along[s](e) for s in q] for e in constraints.positions], n_q
        ),
        "constraint_jacobian": _matrix("constraint_jacobian", constraints.jacobian, n_u),
        "velocity_bias": _vector("velocity_bias", velocity_bias),
        "acceleration_bias": _vector("acceleration_bias", constraints.acceleration_bias),
        "energies": _vector(
            "energies", [kane.kinetic_energy(), kane.potential_energy(model.potential_energy, changing)]
        ),
        "velocity_jacobian": _matrix(
            "velocity_jacobian", [[along[s](e) for s in q] for e in constraints.velocities], n_q
        ),
    }
    along_r = [Direction(tape, {symbol: sm.S.One}) for symbol in r]
    for kind, rows in (("velocity", constraints.velocities), ("position", constraints.positions)):
        result = f"{kind}_input_jacobian"
        results[result] = _matrix(result, [[d(e) for d in along_r] for e in rows], len(r))
    entries = [entry for result in results.values() for entry in result.entries]
    needed = tuple(
        leaf
        for symbol, leaf in zip(model.parameter_symbols, p, strict=True)
        if symbol in model.named_parameters or tape.depends(entries, {leaf})
    )
    for kind, variables in (("", (*q, *u)), ("_parameter", needed), ("_input", r)):
        directions = [along.get(s) or Direction(tape, {s: sm.S.One}) for s in variables]
        for name, rows in (("coordinate_rate", q_rates), ("residual", (*dynamic[:n_u], *kinematic))):
            result = f"{name}{kind}_jacobian"
            results[result] = _matrix(result, [[d(e) for d in directions] for e in rows], len(variables))
    return Equations(
        tape=tape,
        time=time,
        coordinates=q,
        speeds=u,
        parameters=needed,
        inputs=r,
        accelerations=a,
        multipliers=lam,
        n_dependent_speeds=mechanism.n_dependent_speeds,
        **results,
    )


@dataclass(frozen=True)
class _Constraints:
    """Positions Phi, velocities J u + b, J by speeds and by auxiliary speeds, and gamma."""

    positions: tuple[sm.Expr, ...]
    velocities: tuple[sm.Expr, ...]
    jacobian: tuple[tuple[sm.Expr, ...], ...]
    auxiliary_jacobian: tuple[tuple[sm.Expr, ...], ...]
    acceleration_bias: tuple[sm.Expr, ...]

    def rows(self) -> list[tuple[sm.Expr, ...]]:
        """The rows of both Jacobians as one."""
        return [(*row, *more) for row, more in zip(self.jacobian, self.auxiliary_jacobian, strict=True)]


def _constraints(
    tape: Tape,
    mechanism: Mechanism,
    leaves: Mapping[sm.Basic, sm.Expr],
    auxiliary: Mapping[sm.Basic, sm.Expr],
    along_u: Sequence[Direction],
    along_auxiliary: Sequence[Direction],
    rate: Direction,
) -> _Constraints:
    positions = tuple(tape.convert(expr, leaves) for expr in mechanism.holonomic_constraints)
    velocities = tuple(tape.convert(expr, leaves) for expr in mechanism.velocity_constraints)
    # The same with the auxiliary speeds, which the rates of positions do not have.
    general = tuple(tape.convert(expr, {**leaves, **auxiliary}) for expr in mechanism.velocity_constraints)
    if mechanism.velocity_constraints_derived:
        velocities = (*(rate(expr) for expr in positions), *velocities)
        general = (*(sm.S.Zero for _ in positions), *general)
    return _Constraints(
        positions,
        velocities,
        tuple(tuple(d(expr) for d in along_u) for expr in velocities),
        tuple(tuple(d(expr) for d in along_auxiliary) for expr in general),
        tuple(rate(expr) for expr in velocities),
    )


def _noncontributing(
    tape: Tape,
    columns: Sequence[Sequence[sm.Expr]],
    constraints: _Constraints,
    rest: Sequence[sm.Expr],
    n_i: int,
) -> tuple[sm.Expr, ...] | None:
    """The unknown forces F that keep the auxiliary speeds zero; None if they are not determined.

    They act as B F on the speeds and as B_a F on the auxiliary ones. Forces that do no work in the motion are
    reactions, B = J^T C, so that lambda, found without them, includes C F. What is left in the rows of the
    auxiliary speeds is (B_a - J_a^T C) F + rest = 0, with rest = f_a - M_a u' + J_a^T lambda.

    Source: Kane and Levinson 1985, section 4.9, with constraints as multipliers.
    """
    rows, n_c = constraints.rows(), len(constraints.jacobian)
    n_u = len(columns[0]) - len(rest)
    work: list[sm.Expr] = []
    matrix: list[list[sm.Expr]] = [[] for _ in rest]
    try:
        for column in columns:
            reaction: tuple[sm.Expr, ...] = (sm.S.Zero,) * n_c
            if any(column[:n_u]):
                of_dependent = [[row[i] for row in rows] for i in range(n_i, n_u)]
                reaction = solve_linear(tape, of_dependent, [-entry for entry in column[n_i:n_u]])
            for i, entry in enumerate(column):
                terms = (tape.define(row[i] * c) for row, c in zip(rows, reaction, strict=True))
                difference = tape.define(entry - sum(terms))
                if i < n_i:
                    work.append(difference)
                elif i >= n_u:
                    matrix[i - n_u].append(difference)
        return solve_linear(tape, matrix, rest) if all(tape.vanish(work)) else None
    except (UndeterminedError, TooManyCoupledError):
        return None


def _vector(name: str, entries: Sequence[sm.Expr]) -> Result:
    return Result(name, (len(entries),), tuple(entries))


def _matrix(name: str, rows: Sequence[Sequence[sm.Expr]], columns: int) -> Result:
    return Result(name, (len(rows), columns), tuple(entry for row in rows for entry in row))


def _substitute(tape: Tape, expr: sm.Expr, values: dict[sm.Symbol, sm.Expr]) -> sm.Expr:
    """The expression with leaves replaced, statement by statement."""
    known: dict[sm.Basic, sm.Expr] = dict(values)
    for symbol in tape.reach([expr]):
        known[symbol] = tape.define(tape.statements[symbol].xreplace(known))
    return tape.define(expr.xreplace(known))
