"""Equations -> Variations: products of derivatives with directions and with weights, for derivatives of simulations.

A direction, or the gradient that weights give, is in the space of states, parameters and inputs together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.equations import Equations, vector
from fourbar_codegen.expressions.derivatives import Jvp, vjp
from fourbar_codegen.expressions.tape import Result, Scalar

__all__ = ["Pullback", "Variation", "Variations", "form_variations"]


@dataclass(frozen=True)
class Variation:
    """Derivatives along one direction.

    Attributes
    ----------
    direction : tuple of Scalar
        Its leaves, in the order x, p, r.
    coordinate_rates, residual : Result
        The derivatives of q' and of `Equations.residual` at fixed u' and multipliers along it.
    positions, velocities : Result
        The derivatives of `Equations.position_violation`, (n_c + n_i,), and of J u + b, (n_c,).
    """

    direction: tuple[Scalar, ...]
    coordinate_rates: Result
    residual: Result
    positions: Result
    velocities: Result


@dataclass(frozen=True)
class Pullback:
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
class Variations:
    """Products of derivatives with vectors, on the tape of the equations.

    Attributes
    ----------
    variation : Variation
    pullback : Pullback
        Of q' and `Equations.residual` at fixed u' and multipliers.
    constraint_pullback : Pullback
        Of the violations of positions, (n_c + n_i,), and velocities, (n_c,).
    """

    variation: Variation
    pullback: Pullback
    constraint_pullback: Pullback


def form_variations(equations: Equations) -> Variations:
    """Differentiate the equations of motion and the constraints along one direction, and in reverse.

    Parameters
    ----------
    equations : Equations

    Returns
    -------
    Variations

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> form_variations(form_equations(four_bar())).pullback.gradient.shape
    (15,)
    """
    e = equations
    leaves = (*e.variables.state, *e.variables.parameters, *e.variables.inputs)
    direction = tuple(e.tape.leaf("d", str(number)) for number in range(len(leaves)))
    along = Jvp(e.tape, dict(zip(leaves, direction, strict=True)))
    return Variations(
        Variation(
            direction,
            vector("coordinate_rate_variation", map(along, e.dynamics.coordinate_rates.entries)),
            vector("residual_variation", map(along, e.dynamics.residual.entries)),
            vector("position_variation", map(along, e.positions.violation.entries)),
            vector("velocity_variation", map(along, e.velocities.violation.entries)),
        ),
        _pullback(e, "dynamics", (*e.dynamics.coordinate_rates.entries, *e.dynamics.residual.entries), leaves),
        _pullback(e, "constraints", (*e.positions.violation.entries, *e.velocities.violation.entries), leaves),
    )


def _pullback(e: Equations, kind: str, rows: Sequence[Scalar], leaves: Sequence[Scalar]) -> Pullback:
    weights = tuple(e.tape.leaf("g", f"{kind}{number}") for number in range(len(rows)))
    return Pullback(weights, vector("gradient", vjp(e.tape, list(zip(rows, weights, strict=True)), leaves)))
