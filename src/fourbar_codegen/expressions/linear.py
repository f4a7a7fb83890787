"""Small sparse systems of linear equations, solved symbolically on the tape."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_codegen.expressions.tape import Scalar, Tape

__all__ = ["MAX_COUPLED", "TooManyCoupledError", "UndeterminedError", "solve_linear"]

MAX_COUPLED = 6
"""Expansion by minors grows as n!. Coupled coordinates come in threes (attitude), rarely in sixes."""


class UndeterminedError(Exception):
    """Some unknowns do not follow from the equations.

    Parameters
    ----------
    rows, columns : tuple of int
        The equations and unknowns of the part without a unique solution.
    """

    def __init__(self, rows: tuple[int, ...], columns: tuple[int, ...]) -> None:
        self.rows = rows
        self.columns = columns
        super().__init__(f"equations {rows} do not determine unknowns {columns}")


class TooManyCoupledError(Exception):
    """More equations depend on each other than `MAX_COUPLED`; the argument is their number."""


def solve_linear(tape: Tape, matrix: Sequence[Sequence[Scalar]], constants: Sequence[Scalar]) -> tuple[Scalar, ...]:
    """Solve ``matrix @ unknowns + constants = 0``.

    Equations with one unknown are solved first, then each independent block. Within a block, Cramer's rule needs no
    pivot that might vanish for some values of the leaves. Where the block's determinant vanishes, the unknowns are not
    finite.

    Parameters
    ----------
    tape : Tape
    matrix : sequence of sequence of Scalar, shape (n, n)
    constants : sequence of Scalar, shape (n,)

    Returns
    -------
    tuple of Scalar
        The unknowns.

    Raises
    ------
    UndeterminedError
        If the equations do not determine them for any values of the leaves.
    TooManyCoupledError
        If a block is too large for expansion by minors.
    """
    rows = [{column: entry for column, entry in enumerate(row) if entry} for row in matrix]
    rest = list(constants)
    solution: dict[int, Scalar] = {}

    # Equations with one unknown, as long as there are any; this alone solves triangular systems.
    remaining = list(range(len(rows)))
    while (single := next((row for row in remaining if len(rows[row]) == 1), None)) is not None:
        [(unknown, entry)] = rows[single].items()
        solution[unknown] = -rest[single] / entry
        remaining.remove(single)
        for row in remaining:
            if unknown in rows[row]:
                rest[row] = rest[row] + rows[row].pop(unknown) * solution[unknown]

    for block, columns in _blocks(rows, remaining, [c for c in range(len(rows)) if c not in solution]):
        determinant = _determinant(tape, rows, block, columns) if len(block) == len(columns) else tape.zero
        if not determinant:
            raise UndeterminedError(block, columns)
        for k, column in enumerate(columns):
            # Cramer's rule: cofactors of the column, times the right-hand sides -rest.
            terms = [
                (-1) ** (i + k + 1) * rest[row] * _determinant(tape, rows, _without(block, i), _without(columns, k))
                for i, row in enumerate(block)
            ]
            solution[column] = tape.sum(terms) / determinant
    return tuple(solution[column] for column in range(len(rows)))


def _blocks(
    matrix: Sequence[dict[int, Scalar]], rows: Sequence[int], columns: Sequence[int]
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Rows and columns of the matrix's independent blocks."""
    blocks: list[tuple[set[int], set[int]]] = [(set(), {column}) for column in columns]
    for row in rows:
        own = set(matrix[row])
        joined = [block for block in blocks if block[1] & own]
        blocks = [block for block in blocks if not block[1] & own]
        blocks.append(({row}.union(*(r for r, _ in joined)), own.union(*(c for _, c in joined))))
    for block_rows, _ in blocks:
        if len(block_rows) > MAX_COUPLED:
            raise TooManyCoupledError(len(block_rows))
    return sorted((tuple(sorted(r)), tuple(sorted(c))) for r, c in blocks)


def _determinant(
    tape: Tape, matrix: Sequence[dict[int, Scalar]], rows: tuple[int, ...], columns: tuple[int, ...]
) -> Scalar:
    """Expansion along the first row; the tape stores each smaller determinant once."""
    if not rows:
        return tape.one
    first = matrix[rows[0]]
    return tape.sum(
        (-1) ** k * first[column] * _determinant(tape, matrix, rows[1:], _without(columns, k))
        for k, column in enumerate(columns)
        if column in first
    )


def _without(numbers: tuple[int, ...], position: int) -> tuple[int, ...]:
    return numbers[:position] + numbers[position + 1 :]
