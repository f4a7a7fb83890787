"""Mechanism -> Constraints: on positions and velocities, with Jacobians and acceleration bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.derivatives import Jvp, jacobian
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.mechanism import Mechanism
from fourbar_codegen.modeling.system_reader import wrong_number

__all__ = ["Constraints", "form_constraints", "position_jacobian"]


@dataclass(frozen=True)
class Constraints:
    """Position constraints Phi, their rates, velocity constraints J u + b, their Jacobians, and gamma.

    `invariants` are the position constraints whose rates are zero for all speeds. If `derived`, the velocity
    constraints begin with the rates of the others. `virtual_velocities` are the velocity constraints with nonzero
    auxiliary speeds.
    """

    positions: tuple[Scalar, ...]
    rates: tuple[Scalar, ...]
    invariants: tuple[int, ...]
    derived: bool
    velocities: tuple[Scalar, ...]
    virtual_velocities: tuple[Scalar, ...]
    jacobian: tuple[tuple[Scalar, ...], ...]
    auxiliary_jacobian: tuple[tuple[Scalar, ...], ...]
    acceleration_bias: tuple[Scalar, ...]

    def rows(self) -> list[tuple[Scalar, ...]]:
        """The rows of both Jacobians as one."""
        return [(*row, *more) for row, more in zip(self.jacobian, self.auxiliary_jacobian, strict=True)]


def form_constraints(
    tape: Tape,
    mechanism: Mechanism,
    convert: Conversion,
    convert_virtual: Conversion,
    *,
    q: Sequence[Scalar],
    u: Sequence[Scalar],
    aux: Sequence[Scalar],
    rate: Jvp,
    formed: Sequence[int],
) -> Constraints:
    """Form the constraints of a mechanism.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    convert, convert_virtual : Conversion
        `convert` takes the auxiliary speeds as zero, `convert_virtual` does not.
    q, u, aux : sequence of Scalar
        Coordinates, generalized and auxiliary speeds.
    rate : Jvp
        Differentiation with respect to time at constant speeds.
    formed : sequence of int
        Existing nodes, which are reused for equal expressions.

    Raises
    ------
    ModelError
        If a velocity constraint is not linear in the speeds, or the number of dependent speeds is wrong.
    """
    positions = deduplicate(tape, [convert(expr) for expr in mechanism.holonomic_constraints], formed)
    velocities = deduplicate(tape, [convert(expr) for expr in mechanism.velocity_constraints], formed)
    virtual = (
        deduplicate(tape, [convert_virtual(expr) for expr in mechanism.velocity_constraints], formed)
        if aux
        else velocities
    )
    rates = [rate(expr) for expr in positions]
    still = is_zero(tape, rates)
    invariants = tuple(k for k, expr in enumerate(positions) if still[k] and tape.depends([expr], q))
    if mechanism.velocity_constraints_derived:
        # The rates of position constraints do not contain auxiliary speeds.
        derived = [expr for k, expr in enumerate(rates) if k not in invariants]
        velocities, virtual = [*derived, *velocities], [*derived, *virtual]
    dependent = mechanism.speeds[len(u) - mechanism.n_dependent_speeds :]
    problem = wrong_number("velocity", len(velocities), "u", dependent)
    if problem:
        raise ModelError(f"The System cannot be compiled: {problem}.")
    gradients = jacobian(tape, virtual, (*u, *aux))
    for number, gradient in enumerate(gradients, start=1):
        if tape.depends(gradient[: len(u)], u):
            raise ModelError(f"Velocity constraint {number} is not linear in the generalized speeds.")
    return Constraints(
        tuple(positions),
        tuple(rates),
        invariants,
        mechanism.velocity_constraints_derived,
        tuple(velocities),
        tuple(virtual),
        tuple(tuple(gradient[: len(u)]) for gradient in gradients),
        tuple(tuple(gradient[len(u) :]) for gradient in gradients),
        tuple(rate(expr) for expr in velocities),
    )


def position_jacobian(
    tape: Tape, constraints: Constraints, q: Sequence[Scalar], q_rates: Sequence[Scalar], u: Sequence[Scalar]
) -> list[list[Scalar]]:
    """dPhi/dq. Where the rate of a coordinate is one of the speeds, the speed's column of J is reused."""
    rows = jacobian(tape, constraints.positions, q)
    if constraints.derived:
        for j, rate in enumerate(q_rates):
            if rate in u and not tape.depends([*q_rates[:j], *q_rates[j + 1 :]], [rate]):
                kept = [row for k, row in enumerate(rows) if k not in constraints.invariants]
                for row, of_speeds in zip(kept, constraints.jacobian, strict=False):
                    row[j] = of_speeds[u.index(rate)]
    return rows
