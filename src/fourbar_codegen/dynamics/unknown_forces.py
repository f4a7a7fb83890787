"""Unknown forces that auxiliary speeds bring out: reactions, which follow from the motion, or forces that drive it.

An auxiliary speed w is zero and stays so. Its row of Kane's equations, Q - M_a u' + J_a^T lambda = 0, is an equation
for an unknown force n, such as the normal force at a contact. Where that does no work in the motion itself, it follows
when u' and lambda are known. Where it does, as with friction mu n, u' depends on n: both are found together, in C, see
``fourbar_forces.h``.

Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, sections 4.9 and 5.9.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.dynamics.constraints import Constraints
from fourbar_codegen.dynamics.kane import loads_power
from fourbar_codegen.dynamics.kinematics import Kinematics
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.derivatives import Jvp, jacobian
from fourbar_codegen.expressions.identities import is_zero
from fourbar_codegen.expressions.linear import TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.modeling.system_reader import Mechanism, walk

__all__ = [
    "auxiliary_rows",
    "derivatives_by_forces",
    "driving_effect",
    "forces_along_auxiliary_speeds",
    "unknown_forces",
]


def forces_along_auxiliary_speeds(mechanism: Mechanism, candidates: Sequence[sm.Expr]) -> tuple[sm.Expr, ...]:
    """Those functions of time in the loads that do work where auxiliary speeds are not zero.

    Parameters
    ----------
    mechanism : Mechanism
    candidates : sequence of Expr

    Returns
    -------
    tuple of Expr
        In the order of the candidates.
    """
    tape, t = Tape(), mechanism.time
    labelled = chain(mechanism.labelled_loads(), mechanism.labelled_structure())
    nodes = walk(chain.from_iterable(expressions for _, expressions in labelled))
    symbols = {node for node in nodes if isinstance(node, sm.Symbol | AppliedUndef | sm.Derivative)}
    symbols |= {t, *mechanism.coordinates, *(q.diff(t) for q in mechanism.coordinates)}
    leaves = {symbol: tape.leaf("p", str(symbol)) for symbol in sorted(symbols, key=sm.srepr)}
    rates = {leaves[q]: leaves[q.diff(t)] for q in mechanism.coordinates}
    kinematics = Kinematics(tape, mechanism, Conversion(tape, leaves), Jvp(tape, {leaves[t]: tape.one, **rates}))
    auxiliary = [leaves[w] for w in mechanism.auxiliary_speeds if w in leaves]
    [gradient] = jacobian(tape, [loads_power(kinematics)], auxiliary)
    return tuple(f for f in candidates if tape.depends(gradient, [leaves[f]]))


def derivatives_by_forces(tape: Tape, rows: Sequence[Scalar], unknown: Sequence[Scalar]) -> list[list[Scalar]]:
    """The derivatives of the rows with respect to each of the unknown forces."""
    gradients = jacobian(tape, rows, unknown)
    return [[gradient[i] for gradient in gradients] for i in range(len(unknown))]


def unknown_forces(
    tape: Tape,
    model: Model,
    unknown: tuple[Scalar, ...],
    columns: Sequence[Sequence[Scalar]],
    constraints: Constraints,
    rest: Sequence[Scalar],
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...]]:
    """What keeps the auxiliary speeds zero: Q = M u' - f - J^T lambda in their rows, or the forces that give it.

    And the unknown forces that drive the motion: all of them, or none.
    """
    if not model.noncontributing:
        return tuple(-row for row in rest), ()
    mechanism = model.mechanism
    n_i, n_u = len(mechanism.speeds) - mechanism.n_dependent_speeds, len(mechanism.speeds)
    if not tape.depends([*chain(*columns)], unknown):
        forces = _noncontributing(tape, columns, constraints, rest, n_i)
        if forces is not None:
            return forces, ()
    idle = [str(f.func) for f, column in zip(model.noncontributing, columns, strict=True) if not any(column[n_u:])]
    if idle:
        raise ModelError(
            f"The unknown forces {', '.join(idle)} do not follow from the auxiliary speeds "
            f"{', '.join(str(w.func) for w in mechanism.auxiliary_speeds)}: at none of these do they do work. Forces "
            "that are known are named in inputs=."
        )
    return unknown, unknown


def driving_effect(
    tape: Tape,
    columns: Sequence[Sequence[Scalar]],
    with_unknown: Sequence[Scalar],
    without: Sequence[Scalar],
    driving: Sequence[Scalar],
) -> list[Scalar]:
    """What unknown forces that drive the motion add to f; nothing where there are none."""
    if not driving:
        return [tape.zero for _ in without]
    if tape.depends([*chain(*columns)], driving):
        return [tape.sum([a, -b]) for a, b in zip(with_unknown, without, strict=True)]
    pairs = [*zip(driving, columns, strict=True)]
    return [tape.sum([force * column[i] for force, column in pairs]) for i in range(len(without))]


def auxiliary_rows(
    tape: Tape,
    forcing: Sequence[Scalar],
    balance: Sequence[Scalar],
    constraints: Constraints,
    accelerations: Sequence[Scalar],
    driving: Sequence[Scalar],
) -> tuple[list[list[Scalar]], list[list[Scalar]], list[list[Scalar]]]:
    """dQ/dn, M_a and J_a^T of the auxiliary speeds' rows Q - M_a u' + J_a^T lambda, for Q and its sum with -M_a u'."""
    mass = [[-entry for entry in gradient] for gradient in jacobian(tape, balance, accelerations)]
    transposed = [[row[i] for row in constraints.auxiliary_jacobian] for i in range(len(forcing))]
    return jacobian(tape, forcing, driving), mass, transposed


def _noncontributing(
    tape: Tape,
    columns: Sequence[Sequence[Scalar]],
    constraints: Constraints,
    rest: Sequence[Scalar],
    n_i: int,
) -> tuple[Scalar, ...] | None:
    """The unknown forces F that keep the auxiliary speeds zero; None if they are not determined.

    They act as B F on the speeds and as B_a F on the auxiliary ones. Forces that do no work in the motion are
    reactions, B = J^T C, so that lambda, found without them, includes C F. What is left in the rows of the
    auxiliary speeds is (B_a - J_a^T C) F + rest = 0, with rest = f_a - M_a u' + J_a^T lambda.

    Source: Kane and Levinson 1985, section 4.9, with constraints as multipliers.
    """
    rows, n_c = constraints.rows(), len(constraints.jacobian)
    n_u = len(columns[0]) - len(rest)
    work: list[Scalar] = []
    matrix: list[list[Scalar]] = [[] for _ in rest]
    try:
        for column in columns:
            reaction: tuple[Scalar, ...] = (tape.zero,) * n_c
            if any(column[:n_u]):
                of_dependent = [[row[i] for row in rows] for i in range(n_i, n_u)]
                reaction = solve_linear(tape, of_dependent, [-entry for entry in column[n_i:n_u]])
            for i, entry in enumerate(column):
                terms = [row[i] * c for row, c in zip(rows, reaction, strict=True)]
                difference = tape.sum([entry, *(-term for term in terms)])
                if i < n_i:
                    work.append(difference)
                elif i >= n_u:
                    matrix[i - n_u].append(difference)
        return solve_linear(tape, matrix, rest) if all(is_zero(tape, work)) else None
    except (UndeterminedError, TooManyCoupledError):
        return None
