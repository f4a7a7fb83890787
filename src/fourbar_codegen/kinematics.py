"""The kinematic differential equations K_q q' + K_u u + k = 0, solved for q' on the tape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.linear import LARGEST_BLOCK, TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.mechanism import Mechanism
from fourbar_codegen.tape import Direction, Tape

__all__ = ["solve_kinematics"]


def solve_kinematics(
    tape: Tape, mechanism: Mechanism, leaves: Mapping[sm.Basic, sm.Expr], u: Sequence[sm.Symbol]
) -> tuple[sm.Expr, ...]:
    """Solve the kinematic differential equations for the coordinates' rates.

    See `solve_linear` for how. Where a determinant vanishes, the rates are not finite, and the evaluation says so.

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

    try:
        return solve_linear(tape, matrix, rest)
    except UndeterminedError as undetermined:
        names = ", ".join(str(mechanism.coordinates[column].func) for column in undetermined.columns) or "none"
        numbers = ", ".join(str(row + 1) for row in undetermined.rows) or "none"
        raise ModelError(
            f"The kinematic differential equations do not determine the rates of ({names}); the equations left for "
            f"them are number {numbers}."
        ) from None
    except TooManyCoupledError as coupled:
        raise ModelError(
            f"{coupled} kinematic differential equations are coupled; at most {LARGEST_BLOCK} coordinates' rates may "
            "depend on each other."
        ) from None
