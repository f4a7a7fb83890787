"""Equations -> Derivatives: of q', of the residual of the equations of motion, and of the constraints.

A simulation by an explicit method needs none of them. `compile_model` forms them at their first use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.equations import Equations, matrix, vector
from fourbar_codegen.expressions.derivatives import Jvp, jacobian
from fourbar_codegen.expressions.tape import Result, Scalar

__all__ = ["Derivatives", "Tangent", "form_derivatives", "form_tangent"]


@dataclass(frozen=True)
class Tangent:
    """Derivatives along one direction.

    Attributes
    ----------
    direction : tuple of Scalar
        The leaves of a direction in the space of the states, the parameters or the inputs.
    coordinate_rates, residual : Result
        The derivatives of q' and of `Dynamics.residual` at fixed u' and multipliers along it.
    """

    direction: tuple[Scalar, ...]
    coordinate_rates: Result
    residual: Result


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of a mechanism's equations, on their tape.

    Attributes
    ----------
    coordinate_rate_jacobian, coordinate_rate_parameter_jacobian, coordinate_rate_input_jacobian : Result or None
        Derivatives of q' with respect to x, p and r, (n_q, n_x), (n_q, n_p) and (n_q, n_r).
    residual_jacobian, residual_parameter_jacobian, residual_input_jacobian : Result or None
        Derivatives of `Dynamics.residual` at fixed u' and multipliers with respect to x, p and r.
    tangents : tuple of Tangent
        Instead of these six matrices, their products with vectors, for x, p and r; empty if there are the matrices.
    state_rate_acceleration_jacobian, state_rate_multiplier_jacobian : Result
        Derivatives of z' with respect to u' and multipliers, (n_z, n_u) and (n_z, n_c + n_n).
    output_jacobian, output_parameter_jacobian, output_input_jacobian : Result
        Derivatives of the outputs at fixed u' and multipliers with respect to x, p and r.
    output_acceleration_jacobian, output_multiplier_jacobian : Result
        Derivatives of the outputs with respect to u' and multipliers, (n_o, n_u) and (n_o, n_c + n_n).
    default_input_jacobian : Result
        Derivatives of the inputs' expressions with respect to p, (n_r, n_p); zero for inputs without an expression.
    velocity_jacobian, velocity_input_jacobian : Result
        d(J u + b)/dq, (n_c, n_q), and d(J u + b)/dr, (n_c, n_r).
    position_input_jacobian : Result
        dPhi/dr, (n_h, n_r).
    coordinate_accelerations : Result
        q'' for given u', (n_q,).
    point_velocities, point_accelerations : Result
        Of the drawn points, for given u', (n_points, 3). Inputs whose rates are no inputs count as constant.
    """

    coordinate_rate_jacobian: Result | None
    coordinate_rate_parameter_jacobian: Result | None
    coordinate_rate_input_jacobian: Result | None
    residual_jacobian: Result | None
    residual_parameter_jacobian: Result | None
    residual_input_jacobian: Result | None
    tangents: tuple[Tangent, ...]
    state_rate_acceleration_jacobian: Result
    state_rate_multiplier_jacobian: Result
    output_jacobian: Result
    output_parameter_jacobian: Result
    output_input_jacobian: Result
    output_acceleration_jacobian: Result
    output_multiplier_jacobian: Result
    default_input_jacobian: Result
    velocity_jacobian: Result
    velocity_input_jacobian: Result
    position_input_jacobian: Result
    coordinate_accelerations: Result
    point_velocities: Result
    point_accelerations: Result


def form_derivatives(equations: Equations, *, by_columns: bool = False) -> Derivatives:
    """Differentiate the equations of motion of a model.

    Parameters
    ----------
    equations : Equations
    by_columns : bool, optional
        Whether to form products of the large matrices with vectors instead, whose number of operations grows like that
        of the equations.

    Returns
    -------
    Derivatives

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> form_derivatives(form_equations(four_bar())).residual_jacobian.shape
    (5, 6)
    """
    e, v = equations, equations.variables

    def backwards(name: str, of: Result, variables: Sequence[Scalar]) -> Result:
        return matrix(name, jacobian(e.tape, of.entries, variables), len(variables))

    formed: dict[str, Result | None] = {}
    tangents = []
    for kind, variables in (("", v.state), ("_parameter", v.parameters), ("_input", v.inputs)):
        if by_columns:
            tangents.append(form_tangent(e, kind, variables)[0])
        # Forward mode: all rows of both results share the subexpressions of each direction.
        directions = [] if by_columns else [Jvp(e.tape, {variable: e.tape.one}) for variable in variables]
        for name, of in (("coordinate_rate", e.dynamics.coordinate_rates), ("residual", e.dynamics.residual)):
            key, rows = f"{name}{kind}_jacobian", [[d(row) for d in directions] for row in of.entries]
            formed[key] = None if by_columns else matrix(key, rows, len(variables))
    rate = Jvp(
        e.tape,
        {
            v.time: e.tape.one,
            **dict(zip(v.coordinates, e.dynamics.coordinate_rates.entries, strict=True)),
            **dict(zip(v.speeds, v.accelerations, strict=True)),
            **{v.inputs[place]: v.inputs[of_rate] for place, of_rate in e.inputs.rates},
        },
    )
    velocities = [rate(entry) for entry in e.drawing.points.entries]
    return Derivatives(
        coordinate_accelerations=vector("coordinate_accelerations", map(rate, e.dynamics.coordinate_rates.entries)),
        point_velocities=Result("point_velocities", e.drawing.points.shape, tuple(velocities)),
        point_accelerations=Result("point_accelerations", e.drawing.points.shape, tuple(map(rate, velocities))),
        output_jacobian=backwards("output_jacobian", e.outputs, v.state),
        output_parameter_jacobian=backwards("output_parameter_jacobian", e.outputs, v.parameters),
        output_input_jacobian=backwards("output_input_jacobian", e.outputs, v.inputs),
        output_acceleration_jacobian=backwards("output_acceleration_jacobian", e.outputs, v.accelerations),
        output_multiplier_jacobian=backwards("output_multiplier_jacobian", e.outputs, v.multipliers),
        state_rate_acceleration_jacobian=backwards(
            "state_rate_acceleration_jacobian", e.dynamics.state_rates, v.accelerations
        ),
        state_rate_multiplier_jacobian=backwards(
            "state_rate_multiplier_jacobian", e.dynamics.state_rates, v.multipliers
        ),
        default_input_jacobian=backwards("default_input_jacobian", e.inputs.default, v.parameters),
        velocity_jacobian=backwards("velocity_jacobian", e.velocities.violation, v.coordinates),
        velocity_input_jacobian=backwards("velocity_input_jacobian", e.velocities.violation, v.inputs),
        position_input_jacobian=backwards("position_input_jacobian", e.positions.constraints, v.inputs),
        tangents=tuple(tangents),
        **formed,
    )


def form_tangent(e: Equations, kind: str, variables: Sequence[Scalar]) -> tuple[Tangent, Jvp]:
    """The derivatives along a direction of variables, and the differentiation along it."""
    direction = tuple(e.tape.leaf("d", f"{kind}{number}") for number in range(len(variables)))
    along = Jvp(e.tape, dict(zip(variables, direction, strict=True)))
    tangent = Tangent(
        direction,
        vector(f"coordinate_rate{kind}_tangent", map(along, e.dynamics.coordinate_rates.entries)),
        vector(f"residual{kind}_tangent", map(along, e.dynamics.residual.entries)),
    )
    return tangent, along
