"""Equations -> Products: products of derivatives with directions and with weights, for derivatives of simulations.

A direction, or the gradient that weights give, is in the space of states, parameters and inputs together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.derivatives import Tangent, form_tangent
from fourbar_codegen.dynamics.equations import Equations, vector
from fourbar_codegen.expressions.derivatives import vjp
from fourbar_codegen.expressions.tape import Result, Scalar

__all__ = ["Products", "Vjp", "form_products"]


@dataclass(frozen=True)
class Vjp:
    """The gradient of a weighted sum: the product of weights with a Jacobian, by one reverse pass.

    Attributes
    ----------
    weights : tuple of Scalar
        Leaves: a weight for each row.
    gradient : Result
        By x, p and r, (n_x + n_p + n_r,).
    """

    weights: tuple[Scalar, ...]
    gradient: Result


@dataclass(frozen=True)
class Products:
    """Products of derivatives with vectors, on the tape of the equations.

    Attributes
    ----------
    tangent : Tangent
        Along a direction of x, p and r.
    positions, velocities : Result
        The derivatives of `PositionConstraints.violation`, (n_c + n_i,), and of J u + b, (n_c,), along it.
    residual_vjp : Vjp
        Of q' and `Dynamics.residual` at fixed u' and multipliers.
    constraint_vjp : Vjp
        Of the violations of positions, (n_c + n_i,), and velocities, (n_c,).
    """

    tangent: Tangent
    positions: Result
    velocities: Result
    residual_vjp: Vjp
    constraint_vjp: Vjp


def form_products(equations: Equations) -> Products:
    """Differentiate the equations of motion and the constraints along one direction, and in reverse.

    Parameters
    ----------
    equations : Equations

    Returns
    -------
    Products

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> form_products(form_equations(four_bar())).residual_vjp.gradient.shape
    (15,)
    """
    e = equations
    leaves = (*e.variables.state, *e.variables.parameters, *e.variables.inputs)
    tangent, along = form_tangent(e, "", leaves)
    return Products(
        tangent,
        vector("position_tangent", map(along, e.positions.violation.entries)),
        vector("velocity_tangent", map(along, e.velocities.violation.entries)),
        _vjp(e, "dynamics", (*e.dynamics.coordinate_rates.entries, *e.dynamics.residual.entries), leaves),
        _vjp(e, "constraints", (*e.positions.violation.entries, *e.velocities.violation.entries), leaves),
    )


def _vjp(e: Equations, kind: str, rows: Sequence[Scalar], leaves: Sequence[Scalar]) -> Vjp:
    weights = tuple(e.tape.leaf("g", f"{kind}{number}") for number in range(len(rows)))
    return Vjp(weights, vector("gradient", vjp(e.tape, list(zip(rows, weights, strict=True)), leaves)))
