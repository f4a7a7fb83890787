"""Constraints -> Corrections: which velocity constraints keep the positions, and corrections of position violations.

Along a motion, Phi' = D u + d with D = Phi_q K and d = Phi_q k + Phi_t, for q' = K u + k. A model may state velocity
constraints S u + b = 0 of its own. They keep Phi if each row of [D d] is a linear combination of rows of [S b]. This
need not show in the expressions, so it is tested numerically: at random states and, if it does not hold at all of them,
at random states that satisfy the position constraints.

A violation Phi is corrected by a change v of the speeds' integrals with D v = -Phi and R v = 0, where rows R of S
complete the independent rows of D to a basis. The equations of motion are solved with the rows of S. There, S v = -w
has the same solution if

    w = G Phi    with    S = G D + H R.

A position constraint whose rate is zero for all speeds, such as the norm of a quaternion, is an invariant of the
kinematic equations. No change of the speeds corrects it. It is corrected by the shortest change of the coordinates,
dq = -Phi_q^T (Phi_q Phi_q^T)^-1 Phi.

Source: invariants and projections: E. Hairer, C. Lubich, G. Wanner, *Geometric Numerical Integration*, 2nd ed. 2006,
sections IV.1 and IV.4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice

import numpy as np
import sympy as sm
from numpy.typing import NDArray

from fourbar_codegen.dynamics.constraints import Constraints
from fourbar_codegen.dynamics.random_states import RandomStates
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.expressions.convert import substitute
from fourbar_codegen.expressions.derivatives import Rounding, absolute, jacobian
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.linear import MAX_COUPLED, TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Number, Scalar, Tape

__all__ = ["Corrections", "form_corrections"]

Floats = NDArray[np.float64]

N_STATES = 8
"""Number of states at which rows are compared."""
DEPENDENCE_RTOL = 1e-8
"""Relative tolerance for a row to be a linear combination of others."""
CONSTANT_RTOL = 1e-9
"""Relative tolerance for a coefficient to be the same at all states."""
MAX_DENOMINATOR = 64
"""Largest denominator of fractions that constant coefficients are rounded to, within the same tolerance."""


@dataclass(frozen=True)
class Corrections:
    """Corrections of position violations.

    Attributes
    ----------
    violation : tuple of Scalar
        w of J v = -w, zero in rows that keep no position constraint; then the invariants, (n_c + n_i,).
    scale : tuple of Scalar
        Their rounding errors, by which they are measured.
    rows : tuple of (int or None)
        For each position constraint the row of J that keeps it, possibly together with other rows. None for invariants
        and redundant constraints.
    invariants : tuple of int
        Numbers of the position constraints that are invariants.
    coordinate_change : tuple of Scalar
        The change of the coordinates that corrects the invariants, (n_q,).
    """

    violation: tuple[Scalar, ...]
    scale: tuple[Scalar, ...]
    rows: tuple[int | None, ...]
    invariants: tuple[int, ...]
    coordinate_change: tuple[Scalar, ...]


def form_corrections(
    tape: Tape,
    constraints: Constraints,
    q: Sequence[Scalar],
    u: Sequence[Scalar],
    *,
    rounding: Rounding,
    values: Mapping[Scalar, float],
    expressions: Sequence[sm.Expr],
) -> Corrections:
    """Form the corrections of position violations.

    Parameters
    ----------
    tape : Tape
    constraints : Constraints
    q, u : sequence of Scalar
        The coordinates' and the speeds' leaves.
    rounding : Rounding
        Gives the rounding errors of scalars.
    values : mapping of Scalar to float
        Values of leaves near which the equations are defined.
    expressions : sequence of Expr
        The position constraints, for messages.

    Returns
    -------
    Corrections

    Raises
    ------
    ModelError
        If the velocity constraints do not keep a position constraint.
    """
    positions, invariants = constraints.positions, constraints.invariants
    kept = [k for k in range(len(positions)) if k not in invariants]
    n_c = len(constraints.velocities)
    combined = _one_by_one(tape, constraints, kept)
    if combined is None:
        combined = _combinations(tape, constraints, kept, u, values, expressions)
    violation, scale = [tape.zero] * n_c, [tape.zero] * n_c
    for row, terms in combined.items():
        violation[row] = tape.sum([factor * positions[k] for k, factor in terms.items()])
        scale[row] = tape.sum([absolute(tape, factor) * rounding(positions[k]) for k, factor in terms.items()])
    return Corrections(
        (*violation, *(positions[k] for k in invariants)),
        (*scale, *(rounding(positions[k]) for k in invariants)),
        _assigned(combined, len(positions)),
        invariants,
        _shortest_change(tape, [positions[k] for k in invariants], q),
    )


_Combinations = dict[int, dict[int, Scalar]]
"""G: for each row number in J, the coefficients of the position constraints by their numbers."""


def _one_by_one(tape: Tape, constraints: Constraints, kept: Sequence[int]) -> _Combinations | None:
    """G, if each position constraint has a row of J that is its rate or the negative rate; else None."""
    if constraints.derived:
        return {row: {k: tape.one} for row, k in enumerate(kept)}
    found: _Combinations = {}
    for k in kept:
        free = [row for row in range(len(constraints.velocities)) if row not in found]
        for sign in (1, -1):
            same = is_zero(tape, [constraints.velocities[row] - constraints.rates[k] * sign for row in free])
            if any(same):
                found[free[same.index(True)]] = {k: tape.number(sign)}
                break
        else:
            return None
    return found


def _combinations(
    tape: Tape,
    constraints: Constraints,
    kept: Sequence[int],
    u: Sequence[Scalar],
    values: Mapping[Scalar, float],
    expressions: Sequence[sm.Expr],
) -> _Combinations:
    """G, with rows of J as combinations of rates and of rows that keep no position constraint."""
    rates, velocities = [constraints.rates[k] for k in kept], constraints.velocities
    rows = [*jacobian(tape, rates, u), *map(list, constraints.jacobian)]
    biases = substitute(tape, [*rates, *velocities], dict.fromkeys(u, tape.zero))
    entries = [entry for row, bias in zip(rows, biases, strict=True) for entry in (*row, bias)]
    states = RandomStates(tape, constraints, values, entries)
    n_k = len(kept)
    matrices = _kept(states, len(rows), {k: expressions[k] for k in kept})
    independent, others = _basis(matrices[0], n_k)
    basis = [*independent, *others]
    found: _Combinations = {}
    for row in range(n_k, len(rows)):
        if row in others:
            continue
        coefficients = np.array([_coefficients(matrix[basis], matrix[row]) for matrix in matrices])
        sizes = np.array([np.linalg.norm(m[basis], axis=1) / np.linalg.norm(m[row]) for m in matrices])
        needed = np.flatnonzero((np.abs(coefficients) * sizes > DEPENDENCE_RTOL).any(axis=0))
        members = [basis[place] for place in needed]
        factors = [_constant(tape, coefficients[:, place]) for place in needed]
        if any(factor is None for factor, member in zip(factors, members, strict=True) if member < n_k):
            formed = tape.reach([*chain.from_iterable(rows)])
            factors = [*deduplicate(tape, _least_squares(tape, [rows[k] for k in members], rows[row]), formed)]
        pairs = zip(members, factors, strict=True)
        found[row - n_k] = {kept[member]: factor for member, factor in pairs if member < n_k and factor is not None}
    return found


def _kept(states: RandomStates, n_rows: int, positions: Mapping[int, sm.Expr]) -> list[Floats]:
    """Rows of rates, then of velocity constraints, at states where the rates are combinations of the latter."""
    n_k, labels = len(positions), [f"holonomic constraint {k + 1}, {shown(e)}," for k, e in positions.items()]
    left, tried = np.full(n_k, np.inf), "at random states"
    for points, where in ((states.anywhere(), tried), (states.closed(), "at random states that satisfy the positions")):
        matrices = [np.reshape(numbers, (n_rows, -1)) for numbers in islice(points, N_STATES)]
        if not matrices:
            continue
        left, tried = np.max([_left(matrix, n_k) for matrix in matrices], axis=0), where
        if (left <= DEPENDENCE_RTOL).all():
            return matrices
    if not np.isfinite(left).all():
        raise ModelError(
            f"Whether the velocity constraints keep {' '.join(labels)} is not known: the expressions have no value at "
            "random states, nor near the given values."
        )
    if tried != where:
        raise ModelError(
            f"Whether the velocity constraints keep {labels[int(np.argmax(left))]} at zero is not known: {tried}, its "
            "rate is no linear combination of them, and no state was found that satisfies the position constraints. "
            "Give the Model initial= values that do, or let a System derive the rates of its holonomic constraints, as "
            "it does where velocity_constraints is not set."
        )
    raise ModelError(
        f"The velocity constraints do not keep {labels[int(np.argmax(left))]} at zero: {tried}, its rate is no "
        "linear combination of them, so the motion would violate it. Add its rate, Phi.diff(t), to the velocity "
        "constraints; or let a System derive the rates of its holonomic constraints, as it does where "
        "velocity_constraints is not set; or leave the holonomic constraint out, if it only serves to find an initial "
        "state. (Rows that are right in only one of several assembly modes are refused as well.)"
    )


def _left(matrix: Floats, n_k: int) -> Floats:
    """The part of each of the first n_k rows that is no combination of the others, relative to the row's norm."""
    matrix = matrix / _units(matrix)
    rates, rows = matrix[:n_k], matrix[n_k:]
    sizes = np.linalg.norm(rates, axis=1)
    if not len(rows):
        return np.ones(n_k)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), np.finfo(float).tiny)
    combined = np.linalg.lstsq(rows.T, rates.T, rcond=DEPENDENCE_RTOL)[0].T @ rows
    return np.asarray(np.linalg.norm(rates - combined, axis=1) / np.where(sizes > 0.0, sizes, 1.0))


def _units(matrix: Floats) -> Floats:
    """Column scales, so that metres and radians count alike: the largest entries, but not of tiny columns."""
    size = np.abs(matrix).max(axis=0)
    return np.asarray(np.where(size > DEPENDENCE_RTOL * size.max(initial=0.0), size, size.max(initial=0.0) or 1.0))


def _basis(matrix: Floats, n_k: int) -> tuple[list[int], list[int]]:
    """Independent rows among the first n_k, and those of the others that complete them to a basis."""
    left = matrix / _units(matrix)
    left = left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), np.finfo(float).tiny)
    chosen: tuple[list[int], list[int]] = [], []
    for group, members in zip(chosen, (range(n_k), range(n_k, len(matrix))), strict=True):
        for _ in members:
            sizes = np.linalg.norm(left[members.start : members.stop], axis=1)
            if sizes.max() <= DEPENDENCE_RTOL:
                break
            pivot = members[int(np.argmax(sizes))]
            direction = left[pivot] / np.linalg.norm(left[pivot])
            left = left - np.outer(left @ direction, direction)
            group.append(pivot)
    return sorted(chosen[0]), sorted(chosen[1])


def _coefficients(basis: Floats, row: Floats) -> Floats:
    """The coefficients of a row in a basis."""
    units = _units(np.vstack((basis, row)))
    sizes = np.linalg.norm(basis / units, axis=1)
    found = np.linalg.lstsq((basis / units).T / sizes, row / units, rcond=None)[0]
    return np.asarray(found / sizes)


def _constant(tape: Tape, values: Floats) -> Scalar | None:
    """A coefficient as a number, if it is the same at all states."""
    first = float(values[0])
    if not (np.abs(values - first) <= CONSTANT_RTOL * abs(first)).all():
        return None
    fraction = Fraction(first).limit_denominator(MAX_DENOMINATOR)
    value: Number = fraction if abs(fraction - first) <= CONSTANT_RTOL * abs(first) else first
    return tape.number(value.numerator if isinstance(value, Fraction) and value.denominator == 1 else value)


def _least_squares(tape: Tape, basis: Sequence[Sequence[Scalar]], row: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """The coefficients of a row that is a combination of others, by the normal equations."""

    def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
        return tape.sum([x * y for x, y in zip(a, b, strict=True)])

    try:
        return solve_linear(tape, [[dot(a, b) for b in basis] for a in basis], [-dot(a, row) for a in basis])
    except TooManyCoupledError as coupled:
        raise ModelError(
            f"A velocity constraint combines the rates of {coupled} constraints with coefficients that depend on the "
            f"state; at most {MAX_COUPLED} can be separated. State the rates of the position constraints one by one."
        ) from None


def _assigned(combined: _Combinations, n_positions: int) -> tuple[int | None, ...]:
    """A different row for each position constraint."""
    rows: list[int | None] = [None] * n_positions
    for row, terms in sorted(combined.items(), key=lambda item: len(item[1])):
        k = next((k for k in terms if rows[k] is None), None)
        if k is not None:
            rows[k] = row
    return tuple(rows)


def _shortest_change(tape: Tape, invariants: Sequence[Scalar], q: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """The change -Phi_q^T (Phi_q Phi_q^T)^-1 Phi."""
    if not invariants:
        return (tape.zero,) * len(q)
    slopes = jacobian(tape, invariants, q)
    gram = [[tape.sum([x * y for x, y in zip(a, b, strict=True)]) for b in slopes] for a in slopes]
    try:
        multipliers = solve_linear(tape, gram, invariants)
    except (UndeterminedError, TooManyCoupledError):
        raise ModelError(
            "Position constraints whose rates are zero for all speeds, such as norms of quaternions, depend on each "
            "other. Leave redundant ones out."
        ) from None
    return tuple(
        tape.sum([slope[j] * factor for slope, factor in zip(slopes, multipliers, strict=True)]) for j in range(len(q))
    )
