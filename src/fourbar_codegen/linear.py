"""Small sparse systems of linear equations, solved on the tape."""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sm

from fourbar_codegen.tape import Tape

__all__ = ["LARGEST_BLOCK", "TooManyCoupledError", "UndeterminedError", "solve_linear"]

LARGEST_BLOCK = 6
"""Expansion by minors grows as n!; coupled coordinates come in threes (attitude) and rarely in sixes."""


class UndeterminedError(Exception):
    """Some unknowns do not follow from the equations.

    Parameters
    ----------
    rows, columns : tuple of int
        The equations and unknowns of the part that has no solution.
    """

    def __init__(self, rows: tuple[int, ...], columns: tuple[int, ...]) -> None:
        self.rows = rows
        self.columns = columns
        super().__init__(f"equations {rows} do not determine unknowns {columns}")


class TooManyCoupledError(Exception):
    """More equations depend on each other than `LARGEST_BLOCK`; the argument is their number."""


def solve_linear(tape: Tape, matrix: Sequence[Sequence[sm.Expr]], constants: Sequence[sm.Expr]) -> tuple[sm.Expr, ...]:
    """Solve ``matrix @ unknowns + constants = 0``.

    Equations with one unknown are solved first, then blocks that share no unknown, each apart. Within a
    block, Cramer's rule needs no pivot that might vanish for some values of the leaves; where the block's
    determinant vanishes, the unknowns are not finite.

    Parameters
    ----------
    tape : Tape
    matrix : sequence of sequence of Expr, shape (n, n)
    constants : sequence of Expr, shape (n,)

    Returns
    -------
    tuple of Expr
        The unknowns.

    Raises
    ------
    UndeterminedError
        If the equations do not determine them, whatever the leaves are.
    TooManyCoupledError
        If a block is too large for expansion by minors.
    """
    rows = [list(row) for row in matrix]
    rest = list(constants)
    solution: dict[int, sm.Expr] = {}

    def move_known(row: int) -> None:
        """Take the unknowns that are solved for to the right-hand side."""
        for column in [c for c, entry in enumerate(rows[row]) if c in solution and entry]:
            rest[row] = tape.define(rest[row] + tape.define(rows[row][column] * solution[column]))
            rows[row][column] = sm.S.Zero

    # Equations with one unknown, as long as there are any: triangular ones are solved by that alone.
    remaining = list(range(len(rows)))
    while singles := [row for row in remaining if sum(bool(entry) for entry in rows[row]) == 1]:
        single = singles[0]
        unknown = next(column for column, entry in enumerate(rows[single]) if entry)
        solution[unknown] = tape.define(-rest[single] / rows[single][unknown])
        remaining.remove(single)
        for number in remaining:
            move_known(number)

    for block, columns in _blocks(rows, remaining, [c for c in range(len(rows)) if c not in solution]):
        determinant = _determinant(tape, rows, block, columns) if len(block) == len(columns) else sm.S.Zero
        if not determinant:
            raise UndeterminedError(block, columns)
        for k, column in enumerate(columns):
            # Cramer's rule: cofactors of the column, times the right-hand sides -rest.
            terms = [
                (-1) ** (i + k + 1) * rest[row] * _determinant(tape, rows, _without(block, i), _without(columns, k))
                for i, row in enumerate(block)
            ]
            solution[column] = tape.define(tape.define(sm.Add(*terms)) / determinant)
    return tuple(solution[column] for column in range(len(rows)))


def _blocks(
    matrix: Sequence[Sequence[sm.Expr]], rows: Sequence[int], columns: Sequence[int]
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Rows and columns of the matrix's independent blocks."""
    blocks: list[tuple[set[int], set[int]]] = [(set(), {column}) for column in columns]
    for row in rows:
        own = {column for column in columns if matrix[row][column]}
        joined = [block for block in blocks if block[1] & own]
        blocks = [block for block in blocks if not block[1] & own]
        blocks.append(({row}.union(*(r for r, _ in joined)), own.union(*(c for _, c in joined))))
    for block_rows, _ in blocks:
        if len(block_rows) > LARGEST_BLOCK:
            raise TooManyCoupledError(len(block_rows))
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
        if matrix[rows[0]][column]
    ]
    return tape.define(sm.Add(*terms))


def _without(numbers: tuple[int, ...], position: int) -> tuple[int, ...]:
    return numbers[:position] + numbers[position + 1 :]
