"""Unknown forces from auxiliary speeds: reactions, which follow from the motion, or forces that drive it.

An auxiliary speed w is zero at all times. Its row of Kane's equations, Q - M_a u' + J_a^T lambda = 0, is an equation
for an unknown force n, such as the normal force at a contact. If n does no work in the motion, it follows from u' and
lambda. If it does, as with friction mu n, u' depends on n, and both are found together, in C: see
``kernel/unknown_forces.h``.

Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, sections 4.9 and 5.9.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain, islice

import numpy as np
import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.dynamics.constraints import Constraints
from fourbar_codegen.dynamics.kane import AppliedLoad, Kane, loads_power
from fourbar_codegen.dynamics.kinematics import INERTIAL, Kinematics
from fourbar_codegen.dynamics.random_states import RandomStates
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp, jacobian
from fourbar_codegen.expressions.identities import is_zero
from fourbar_codegen.expressions.linear import TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.mechanism import Mechanism, walk
from fourbar_codegen.modeling.model import Model

__all__ = [
    "GeneralizedForces",
    "UnknownForces",
    "find_forces_at_moving_points",
    "forces_along_auxiliary_speeds",
    "form_generalized_forces",
    "form_unknown_forces",
]

N_STATES = 5
ZERO_RTOL = 1e-6
"""Components below this fraction of a vector are rounding errors."""


@dataclass(frozen=True)
class UnknownForces:
    """The forces that keep the auxiliary speeds zero.

    Attributes
    ----------
    values : tuple of Scalar
        The forces; generalized ones, Q = M u' - f - J^T lambda, if the loads contain no unknown forces.
    driving : tuple of Scalar
        The leaves of those that drive the motion: all of them, or none.
    effect : tuple of Scalar
        F(n), their contribution to f, (n_u,).
    forcing : tuple of Scalar
        Q(n) of their rows Q - M_a u' + J_a^T lambda = 0, (n_n,).
    mass, constraint_jacobian : tuple of tuple of Scalar
        M_a, (n_n, n_u), and J_a^T, (n_n, n_c).
    rows : tuple of Scalar
        The residuals of these rows for given u' and lambda, (n_n,).
    """

    values: tuple[Scalar, ...]
    driving: tuple[Scalar, ...]
    effect: tuple[Scalar, ...]
    forcing: tuple[Scalar, ...]
    mass: tuple[tuple[Scalar, ...], ...]
    constraint_jacobian: tuple[tuple[Scalar, ...], ...]
    rows: tuple[Scalar, ...]


def forces_along_auxiliary_speeds(mechanism: Mechanism, candidates: Sequence[sm.Expr]) -> tuple[sm.Expr, ...]:
    """The functions of time in the loads that do work at nonzero auxiliary speeds.

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
    [gradient] = jacobian(tape, [loads_power(kinematics, mechanism.loads)], auxiliary)
    return tuple(f for f in candidates if tape.depends(gradient, [leaves[f]]))


@dataclass(frozen=True)
class GeneralizedForces:
    """Rows of Kane's equations, of speeds and then of auxiliary speeds, with unknown forces kept separate.

    Attributes
    ----------
    known : tuple of Scalar
        f without the unknown forces.
    balance : tuple of Scalar
        f - M u' without them.
    acting : tuple of Scalar
        The contribution of the unknown forces.
    power : Scalar
        Power of the loads without them; see `Kane.power`.
    are_linear : bool
        Whether that contribution is linear in them.
    """

    known: tuple[Scalar, ...]
    balance: tuple[Scalar, ...]
    acting: tuple[Scalar, ...]
    power: Scalar
    are_linear: bool


def form_generalized_forces(kane: Kane, rate: Jvp, total_rate: Jvp, unknown: Sequence[Scalar]) -> GeneralizedForces:
    """The generalized active and inertia forces.

    Loads that are not linear in the unknown forces may have no value where these are zero. Then each load that contains
    unknown forces counts as a whole as their contribution.

    Parameters
    ----------
    kane : Kane
    rate, total_rate : Jvp
        Differentiation with respect to time, with u' = 0 and with u' given.
    unknown : sequence of Scalar
        The leaves of the unknown forces.
    """
    tape = kane.tape
    rows, moving = kane.generalized_forces(rate), kane.generalized_forces(total_rate)
    if not unknown:
        return GeneralizedForces(tuple(rows), tuple(moving), (tape.zero,) * len(rows), kane.power(), True)
    gradients = jacobian(tape, rows, unknown)
    if _are_linear(tape, rows, gradients, unknown):
        none = dict.fromkeys(unknown, tape.zero)
        acting = [
            tape.sum([slope * force for slope, force in zip(gradient, unknown, strict=True)]) for gradient in gradients
        ]
        known, balance = substitute(tape, rows, none), substitute(tape, moving, none)
        [power] = substitute(tape, [kane.power()], none)
        return GeneralizedForces(tuple(known), tuple(balance), tuple(acting), power, True)
    of_unknown = [tape.depends([e for _, entries in load.vector for e in entries], unknown) for load in kane.loads]
    others = [load for load, depends in zip(kane.loads, of_unknown, strict=True) if not depends]
    those = [load for load, depends in zip(kane.loads, of_unknown, strict=True) if depends]
    return GeneralizedForces(
        tuple(kane.generalized_forces(rate, others)),
        tuple(kane.generalized_forces(total_rate, others)),
        tuple(kane.generalized_forces(rate, those, inertia=False)),
        kane.power(others),
        False,
    )


def find_forces_at_moving_points(
    kane: Kane,
    model: Model,
    rate: Jvp,
    unknown: Sequence[Scalar],
    constraints: Constraints,
    states: Callable[[Sequence[Scalar]], RandomStates],
) -> tuple[str, ...]:
    """Find unknown forces along directions in which their point moves without the auxiliary speeds, too.

    Such a force may drive the motion. If it is meant as the force between the two bodies of a joint, the opposite force
    on the other body is missing.

    Parameters
    ----------
    kane : Kane
    model : Model
    rate : Jvp
        Differentiation with respect to time, with u' = 0.
    unknown : sequence of Scalar
        The leaves of the unknown forces.
    constraints : Constraints
    states : callable
        Random states, of the scalars to be evaluated there.

    Returns
    -------
    tuple of str
        A sentence if there are any.
    """
    tape, n_u, n_c = kane.tape, len(kane.speeds), len(constraints.jacobian)
    columns, places = [], []
    for force in unknown:
        loads = []
        for applied in kane.loads:
            along = kane.reaction(applied.load, force)
            if any(along):
                vector = ((INERTIAL, along),)
                loads.append(AppliedLoad(applied.load, vector, vector))
        columns.append(kane.generalized_forces(rate, loads, inertia=False)[:n_u])
        places.append([applied.load.name for applied in loads])
    moving = [number for number, column in enumerate(columns) if not all(is_zero(tape, column))]
    if not moving:
        return ()
    scalars = [*chain.from_iterable(columns[number] for number in moving), *chain.from_iterable(constraints.jacobian)]
    found: set[int] = set()
    drawn = [*islice(states(scalars).closed(), N_STATES)]
    for values in drawn:
        rows, matrix = values[: n_u * len(moving)].reshape(-1, n_u), values[n_u * len(moving) :].reshape(n_c, n_u)
        # What a constraint J u = 0 does not keep from moving: the part of the column orthogonal to the rows of J.
        left = rows.T - matrix.T @ np.linalg.lstsq(matrix.T, rows.T, rcond=None)[0] if n_c else rows.T
        sizes = np.linalg.norm(rows, axis=1)
        found.update(np.flatnonzero(np.linalg.norm(left, axis=0) > ZERO_RTOL * sizes).tolist())
    if not found and drawn:
        return ()
    those = [moving[number] for number in sorted(found)] or moving
    names = [str(model.noncontributing[number].func) for number in those]
    where = ", ".join(dict.fromkeys(chain.from_iterable(places[number] for number in those)))
    return (
        (
            f"The unknown forces {', '.join(names)} ({where}) act along directions in which the motion itself moves "
            "their point, too. They are taken for forces on this one body, which drive the motion. If they are the "
            "forces between the two bodies of a joint, the opposite ones are missing: name them in "
            f"Model(reactions={names!r}), so that they stand in the equations of the auxiliary speeds alone. If they "
            "do drive the motion, Model(reactions=[]) says so."
        ),
    )


def _are_linear(
    tape: Tape, rows: Sequence[Scalar], gradients: Sequence[Sequence[Scalar]], unknown: Sequence[Scalar]
) -> bool:
    """Whether rows are linear in the unknown forces, by derivatives and by values (derivatives do not show jumps)."""
    if tape.depends([*chain(*gradients)], unknown):
        return False
    try:
        at_zero = substitute(tape, rows, dict.fromkeys(unknown, tape.zero))
    except (ArithmeticError, ModelError):  # they have no value there
        return False
    left = [
        tape.sum([row, -rest, *(-slope * force for slope, force in zip(gradient, unknown, strict=True))])
        for row, rest, gradient in zip(rows, at_zero, gradients, strict=True)
    ]
    return all(is_zero(tape, left))


def form_unknown_forces(
    tape: Tape,
    model: Model,
    unknown: tuple[Scalar, ...],
    accelerations: Sequence[Scalar],
    constraints: Constraints,
    *,
    generalized: GeneralizedForces,
    reactions: Sequence[Scalar],
) -> UnknownForces:
    """Form the unknown forces from the rows of Kane's equations, of speeds and then of auxiliary speeds.

    Parameters
    ----------
    tape : Tape
    model : Model
    unknown, accelerations : sequence of Scalar
        The leaves of the unknown forces and of u'.
    constraints : Constraints
    generalized : GeneralizedForces
    reactions : sequence of Scalar
        J^T lambda.

    Raises
    ------
    ModelError
        If an unknown force does no work at any auxiliary speed.
    """
    mechanism, n_u = model.mechanism, len(accelerations)
    balance, acting = generalized.balance, generalized.acting
    rest = [row + reaction for row, reaction in zip(balance[n_u:], reactions[n_u:], strict=True)]
    if not unknown:
        return _reactions(tape, [-row for row in rest], n_u)
    gradients = jacobian(tape, acting, unknown)
    columns = [[gradient[i] for gradient in gradients] for i in range(len(unknown))]
    if generalized.are_linear:
        found = _noncontributing(tape, columns, constraints, rest, n_u - mechanism.n_dependent_speeds)
        if found is not None:
            return _reactions(tape, found, n_u)
    idle = [
        str(f.func)
        for f, leaf in zip(model.noncontributing, unknown, strict=True)
        if not tape.depends(acting[n_u:], [leaf])
    ]
    if idle:
        raise ModelError(
            f"The unknown forces {', '.join(idle)} do not follow from the auxiliary speeds "
            f"{', '.join(str(w.func) for w in mechanism.auxiliary_speeds)}: they do no work at any of these. Name "
            "forces that are known in inputs=."
        )
    return UnknownForces(
        unknown,
        unknown,
        tuple(acting[:n_u]),
        tuple(row + force for row, force in zip(generalized.known[n_u:], acting[n_u:], strict=True)),
        tuple(tuple(-entry for entry in row) for row in jacobian(tape, balance[n_u:], accelerations)),
        tuple(zip(*constraints.auxiliary_jacobian, strict=True)) or ((),) * len(unknown),
        tuple(row + force for row, force in zip(rest, acting[n_u:], strict=True)),
    )


def _reactions(tape: Tape, forces: Sequence[Scalar], n_u: int) -> UnknownForces:
    """Unknown forces that do not drive the motion."""
    return UnknownForces(tuple(forces), (), (tape.zero,) * n_u, (), (), (), ())


def _noncontributing(
    tape: Tape,
    columns: Sequence[Sequence[Scalar]],
    constraints: Constraints,
    rest: Sequence[Scalar],
    n_i: int,
) -> tuple[Scalar, ...] | None:
    """The unknown forces F that keep the auxiliary speeds zero; None if they are not determined.

    They contribute B F to the rows of the speeds and B_a F to those of the auxiliary speeds. Forces that do no work in
    the motion are reactions, B = J^T C, so lambda, found without them, includes C F. The rows of the auxiliary speeds
    become (B_a - J_a^T C) F + rest = 0, with rest = f_a - M_a u' + J_a^T lambda.

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
