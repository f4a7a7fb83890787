"""The kinematic differential equations K_q q' + K_u u + k = 0, solved for q' on the tape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.derivatives import vjp
from fourbar_codegen.expressions.linear import MAX_COUPLED, TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.mechanism import Mechanism

__all__ = ["solve_kinematics"]


def solve_kinematics(
    tape: Tape, mechanism: Mechanism, leaves: Mapping[sm.Basic, Scalar], u: Sequence[Scalar]
) -> tuple[Scalar, ...]:
    """Solve the kinematic differential equations for the coordinates' rates.

    By `solve_linear`. Where a determinant vanishes, the rates are not finite, and the evaluation reports an error.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    leaves : mapping of Basic to Scalar
        Time, coordinates, speeds and parameters as scalars of the tape.
    u : sequence of Scalar
        The speeds' leaves.

    Returns
    -------
    tuple of Scalar
        q', shape (n_q,).

    Raises
    ------
    ModelError
        If an equation is not linear in q' and u, or the equations do not determine q'.
    """
    rates = [coordinate.diff(mechanism.time) for coordinate in mechanism.coordinates]
    unknown = [tape.leaf("v", number) for number in range(len(rates))]
    with_rates = Conversion(tape, {**leaves, **dict(zip(rates, unknown, strict=True))})
    without_rates = Conversion(tape, {**leaves, **dict.fromkeys(rates, tape.zero)})

    matrix: list[list[Scalar]] = []
    rest: list[Scalar] = []
    for number, equation in enumerate(mechanism.kinematic_equations, start=1):
        gradient = vjp(tape, [(with_rates(equation), tape.one)], [*unknown, *u])
        if tape.depends(gradient, [*unknown, *u]):
            raise ModelError(
                f"Kinematic differential equation {number}, {equation}, is not linear in the coordinates' rates and "
                "the speeds."
            )
        matrix.append(gradient[: len(rates)])
        rest.append(without_rates(equation))

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
            f"{coupled} kinematic differential equations are coupled; at most {MAX_COUPLED} coordinates' rates may "
            "depend on each other."
        ) from None
