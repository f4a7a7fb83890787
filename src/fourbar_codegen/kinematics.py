"""The kinematic differential equations K_q q' + K_u u + k = 0, solved for q' on the tape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.mechanism import Mechanism
from fourbar_codegen.tape import Direction, Tape

__all__ = ["solve_kinematics"]

LARGEST_BLOCK = 6
"""Expansion by minors grows as n!; coupled coordinates come in threes (attitude) and rarely in sixes."""


def solve_kinematics(
    tape: Tape, mechanism: Mechanism, leaves: Mapping[sm.Basic, sm.Expr], u: Sequence[sm.Symbol]
) -> tuple[sm.Expr, ...]:
    """Solve the kinematic differential equations for the coordinates' rates.

    Equations that share no rate are solved apart. Within a block, Cramer's rule needs no pivot that might
    vanish at some configuration; where the block's determinant vanishes, the rates are not finite, and the
    evaluation says so.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    leaves : mapping of Basic to Expr
        What stands on the tape for time, coordinates, speeds and parameters.
    u : sequence of Symbol
        The speeds' leaves.

    Returns
    -------
    tuple of Expr
        q', shape (n_q,).

    Raises
    ------
    ModelError
        If an equation is not linear in q' and u, or the equations do not determine q'.
    """
    rates = [coordinate.diff(mechanism.time) for coordinate in mechanism.coordinates]
    symbols = [sm.Symbol(f"v:{number}", real=True) for number in range(len(rates))]
    with_rates = {**leaves, **dict(zip(rates, symbols, strict=True))}
    without_rates = {**leaves, **dict.fromkeys(rates, sm.S.Zero)}
    along = [Direction(tape, {symbol: sm.S.One}) for symbol in symbols]
    along_u = [Direction(tape, {symbol: sm.S.One}) for symbol in u]

    matrix: list[list[sm.Expr]] = []
    rest: list[sm.Expr] = []
    for number, equation in enumerate(mechanism.kinematic_equations, start=1):
        converted = tape.convert(equation, with_rates)
        row = [d(converted) for d in along]
        if tape.depends([*row, *(d(converted) for d in along_u)], {*symbols, *u}):
            raise ModelError(
                f"Kinematic differential equation {number}, {equation}, is not linear in the coordinates' rates and "
                "the speeds."
            )
        matrix.append(row)
        rest.append(tape.convert(equation, without_rates))

    solution: dict[int, sm.Expr] = {}
    for rows, columns in _blocks(matrix):
        determinant = _determinant(tape, matrix, rows, columns) if len(rows) == len(columns) else sm.S.Zero
        if determinant.is_zero:
            unknown = ", ".join(str(mechanism.coordinates[column].func) for column in columns)
            numbers = ", ".join(str(row + 1) for row in rows) or "none"
            raise ModelError(
                f"The kinematic differential equations do not determine the rates of ({unknown}); the equations that "
                f"contain them are number {numbers}."
            )
        for k, column in enumerate(columns):
            # Cramer's rule: cofactors of the column, times the right-hand sides -rest.
            terms = [
                (-1) ** (i + k + 1) * rest[row] * _determinant(tape, matrix, _without(rows, i), _without(columns, k))
                for i, row in enumerate(rows)
            ]
            solution[column] = tape.define(tape.define(sm.Add(*terms)) / determinant)
    return tuple(solution[column] for column in range(len(rates)))


def _blocks(matrix: Sequence[Sequence[sm.Expr]]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Rows and columns of the matrix's independent blocks, in order of their first column."""
    size = len(matrix)
    blocks: list[tuple[set[int], set[int]]] = [(set(), {column}) for column in range(size)]
    for row, entries in enumerate(matrix):
        columns = {column for column, entry in enumerate(entries) if not entry.is_zero}
        joined = [block for block in blocks if block[1] & columns]
        blocks = [block for block in blocks if not block[1] & columns]
        blocks.append(({row}.union(*(rows for rows, _ in joined)), columns.union(*(own for _, own in joined))))
    for rows, _ in blocks:
        if len(rows) > LARGEST_BLOCK:
            raise ModelError(
                f"{len(rows)} kinematic differential equations are coupled; at most {LARGEST_BLOCK} coordinates' rates "
                "may depend on each other."
            )
    return sorted((tuple(sorted(rows)), tuple(sorted(columns))) for rows, columns in blocks)


def _determinant(
    tape: Tape, matrix: Sequence[Sequence[sm.Expr]], rows: tuple[int, ...], columns: tuple[int, ...]
) -> sm.Expr:
    """Expansion along the first row; the tape stores each smaller determinant once."""
    if not rows:
        return sm.S.One
    terms = [
        (-1) ** k * matrix[rows[0]][column] * _determinant(tape, matrix, rows[1:], _without(columns, k))
        for k, column in enumerate(columns)
        if not matrix[rows[0]][column].is_zero
    ]
    return tape.define(sm.Add(*terms))


def _without(numbers: tuple[int, ...], position: int) -> tuple[int, ...]:
    return numbers[:position] + numbers[position + 1 :]
