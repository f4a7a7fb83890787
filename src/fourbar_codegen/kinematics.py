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

    Equations with one unknown rate are solved first, then blocks that share no rate, each apart. Within a
    block, Cramer's rule needs no pivot that might vanish at some configuration; where the block's determinant
    vanishes, the rates are not finite, and the evaluation says so.

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

    def move_known(row: int) -> None:
        """Take the rates that are solved for to the right-hand side."""
        for column in [c for c, entry in enumerate(matrix[row]) if c in solution and not entry.is_zero]:
            rest[row] = tape.define(rest[row] + tape.define(matrix[row][column] * solution[column]))
            matrix[row][column] = sm.S.Zero

    # Equations with one unknown rate, as long as there are any: triangular ones are solved by that alone.
    open_rows = list(range(len(matrix)))
    while singles := [row for row in open_rows if sum(not entry.is_zero for entry in matrix[row]) == 1]:
        single = singles[0]
        unknown = next(column for column, entry in enumerate(matrix[single]) if not entry.is_zero)
        solution[unknown] = tape.define(-rest[single] / matrix[single][unknown])
        open_rows.remove(single)
        for number in open_rows:
            move_known(number)

    for rows, columns in _blocks(matrix, open_rows, [c for c in range(len(rates)) if c not in solution]):
        determinant = _determinant(tape, matrix, rows, columns) if len(rows) == len(columns) else sm.S.Zero
        if determinant.is_zero:
            names = ", ".join(str(mechanism.coordinates[column].func) for column in columns) or "none"
            numbers = ", ".join(str(row + 1) for row in rows) or "none"
            raise ModelError(
                f"The kinematic differential equations do not determine the rates of ({names}); the equations left "
                f"for them are number {numbers}."
            )
        for k, column in enumerate(columns):
            # Cramer's rule: cofactors of the column, times the right-hand sides -rest.
            terms = [
                (-1) ** (i + k + 1) * rest[row] * _determinant(tape, matrix, _without(rows, i), _without(columns, k))
                for i, row in enumerate(rows)
            ]
            solution[column] = tape.define(tape.define(sm.Add(*terms)) / determinant)
    return tuple(solution[column] for column in range(len(rates)))


def _blocks(
    matrix: Sequence[Sequence[sm.Expr]], rows: Sequence[int], columns: Sequence[int]
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Rows and columns of the matrix's independent blocks."""
    blocks: list[tuple[set[int], set[int]]] = [(set(), {column}) for column in columns]
    for row in rows:
        own = {column for column in columns if not matrix[row][column].is_zero}
        joined = [block for block in blocks if block[1] & own]
        blocks = [block for block in blocks if not block[1] & own]
        blocks.append(({row}.union(*(r for r, _ in joined)), own.union(*(c for _, c in joined))))
    for block_rows, _ in blocks:
        if len(block_rows) > LARGEST_BLOCK:
            raise ModelError(
                f"{len(block_rows)} kinematic differential equations are coupled; at most {LARGEST_BLOCK} coordinates' "
                "rates may depend on each other."
            )
    return sorted((tuple(sorted(r)), tuple(sorted(c))) for r, c in blocks)


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
