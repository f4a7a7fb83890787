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

from collections.abc import Sequence
from dataclasses import dataclass

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.kane import Kane
from fourbar_codegen.kinematics import solve_kinematics
from fourbar_codegen.model import Model
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
    default_inputs : Result
        The inputs' expressions, (n_r,); NaN where there is none.
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
    coordinate_rate_jacobian : Result
        dq'/dx, (n_q, n_x).
    residual_jacobian : Result
        d/dx of (f - M u' + J^T lambda, -(J u' + gamma)) at fixed u' and lambda, (n_u + n_c, n_x).
    """

    tape: Tape
    time: sm.Symbol
    coordinates: tuple[sm.Symbol, ...]
    speeds: tuple[sm.Symbol, ...]
    parameters: tuple[sm.Symbol, ...]
    inputs: tuple[sm.Symbol, ...]
    accelerations: tuple[sm.Symbol, ...]
    multipliers: tuple[sm.Symbol, ...]
    default_inputs: Result
    coordinate_rates: Result
    mass_matrix: Result
    forcing: Result
    position_constraints: Result
    position_jacobian: Result
    constraint_jacobian: Result
    velocity_bias: Result
    acceleration_bias: Result
    energies: Result
    coordinate_rate_jacobian: Result
    residual_jacobian: Result


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
        constraint is not linear in u.

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
    n_u = len(u)

    leaves: dict[sm.Basic, sm.Expr] = {mechanism.time: time}
    leaves.update(zip(mechanism.coordinates, q, strict=True))
    leaves.update(zip(mechanism.speeds, u, strict=True))
    leaves.update(zip(model.parameter_symbols, p, strict=True))
    leaves.update(zip(model.input_expressions, r, strict=True))
    q_rates = solve_kinematics(tape, mechanism, leaves, u)
    leaves.update(zip((c.diff(mechanism.time) for c in mechanism.coordinates), q_rates, strict=True))

    along_q = [Direction(tape, {symbol: sm.S.One}) for symbol in q]
    along_u = [Direction(tape, {symbol: sm.S.One}) for symbol in u]
    # The rate of a function of (q, u, t) while u is held.
    rate = Direction(tape, {time: sm.S.One, **dict(zip(q, q_rates, strict=True))})

    kane = Kane(tape, mechanism, leaves, along_u, rate)
    kane.use_poisson_rates()
    mass_matrix, forcing = kane.mass_matrix_and_forcing()

    positions = tuple(tape.convert(expr, leaves) for expr in mechanism.holonomic_constraints)
    velocities = tuple(tape.convert(expr, leaves) for expr in mechanism.velocity_constraints)
    if mechanism.velocity_constraints_derived:
        velocities = tuple(rate(expr) for expr in positions) + velocities
    jacobian = tuple(tuple(d(expr) for d in along_u) for expr in velocities)
    for number, row in enumerate(jacobian, start=1):
        if tape.depends(row, u):
            raise ModelError(f"Velocity constraint {number} is not linear in the generalized speeds.")
    at_rest = dict.fromkeys(u, sm.S.Zero)
    velocity_bias = tuple(_substitute(tape, expr, at_rest) for expr in velocities)
    acceleration_bias = tuple(rate(expr) for expr in velocities)
    n_c = len(velocities)

    a = tuple(sm.Symbol(f"a:{name}", real=True) for name in model.speeds)
    lam = tuple(sm.Symbol(f"l:{number}", real=True) for number in range(n_c))
    dynamic = tuple(
        tape.define(
            forcing[i]
            - sum(tape.define(mass_matrix[i][j] * a[j]) for j in range(n_u))
            + sum(tape.define(jacobian[k][i] * lam[k]) for k in range(n_c))
        )
        for i in range(n_u)
    )
    kinematic = tuple(
        tape.define(-acceleration_bias[k] - sum(tape.define(jacobian[k][j] * a[j]) for j in range(n_u)))
        for k in range(n_c)
    )

    inputs = [sm.S.NaN if e is None else tape.convert(e, leaves) for e in model.input_expressions.values()]
    results = {
        "default_inputs": _vector("inputs", inputs),
        "coordinate_rates": _vector("coordinate_rates", q_rates),
        "mass_matrix": _matrix("mass_matrix", mass_matrix, n_u),
        "forcing": _vector("forcing", forcing),
        "position_constraints": _vector("position_constraints", positions),
        "position_jacobian": _matrix("position_jacobian", [[d(e) for d in along_q] for e in positions], len(q)),
        "constraint_jacobian": _matrix("constraint_jacobian", jacobian, n_u),
        "velocity_bias": _vector("velocity_bias", velocity_bias),
        "acceleration_bias": _vector("acceleration_bias", acceleration_bias),
        "energies": _vector(
            "energies", [kane.kinetic_energy(), kane.potential_energy(model.potential_energy, {time, *q, *u, *r})]
        ),
        "coordinate_rate_jacobian": _matrix(
            "coordinate_rate_jacobian", [[d(e) for d in (*along_q, *along_u)] for e in q_rates], len(q) + n_u
        ),
        "residual_jacobian": _matrix(
            "residual_jacobian",
            [[d(e) for d in (*along_q, *along_u)] for e in (*dynamic, *kinematic)],
            len(q) + n_u,
        ),
    }
    entries = [entry for result in results.values() for entry in result.entries]
    return Equations(
        tape=tape,
        time=time,
        coordinates=q,
        speeds=u,
        parameters=tuple(
            leaf
            for symbol, leaf in zip(model.parameter_symbols, p, strict=True)
            if symbol in model.named_parameters or tape.depends(entries, {leaf})
        ),
        inputs=r,
        accelerations=a,
        multipliers=lam,
        **results,
    )


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
