"""Mechanism -> its constraints: positions, velocities, Jacobians, and the accelerations' bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.derivatives import Jvp, jacobian
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.system_reader import Mechanism

__all__ = ["Constraints", "form_constraints", "position_jacobian", "position_violation"]


@dataclass(frozen=True)
class Constraints:
    """Positions Phi, velocities J u + b, J by speeds and by auxiliary speeds, and gamma.

    The velocities begin with the rates of the positions if they are `derived`; `virtual_velocities` are the velocities
    with the auxiliary speeds where they are not zero.
    """

    positions: tuple[Scalar, ...]
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
    u: Sequence[Scalar],
    aux: Sequence[Scalar],
    rate: Jvp,
    formed: Sequence[int],
) -> Constraints:
    """The constraints of a mechanism, each once.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    convert, convert_virtual : Conversion
        The latter with the auxiliary speeds, where there are some.
    u, aux : sequence of Scalar
        Generalized and auxiliary speeds.
    rate : Jvp
        The rate of what depends on coordinates, speeds and time, with the speeds held.
    formed : sequence of int
        Nodes that stand already, for expressions that are equal to one of them.

    Raises
    ------
    ModelError
        If a velocity constraint is not linear in the speeds.
    """
    positions = deduplicate(tape, [convert(expr) for expr in mechanism.holonomic_constraints], formed)
    velocities = deduplicate(tape, [convert(expr) for expr in mechanism.velocity_constraints], formed)
    virtual = (
        deduplicate(tape, [convert_virtual(expr) for expr in mechanism.velocity_constraints], formed)
        if aux
        else velocities
    )
    if mechanism.velocity_constraints_derived:
        # The rates of positions do not have the auxiliary speeds.
        derived = [rate(expr) for expr in positions]
        velocities, virtual = [*derived, *velocities], [*derived, *virtual]
    gradients = jacobian(tape, virtual, (*u, *aux))
    for number, gradient in enumerate(gradients, start=1):
        if tape.depends(gradient[: len(u)], u):
            raise ModelError(f"Velocity constraint {number} is not linear in the generalized speeds.")
    return Constraints(
        tuple(positions),
        mechanism.velocity_constraints_derived,
        tuple(velocities),
        tuple(virtual),
        tuple(tuple(gradient[: len(u)]) for gradient in gradients),
        tuple(tuple(gradient[len(u) :]) for gradient in gradients),
        tuple(rate(expr) for expr in velocities),
    )


def position_violation(tape: Tape, constraints: Constraints, rate: Jvp) -> list[Scalar]:
    """For each velocity constraint the position constraint, or its negative, that it is the rate of, or zero."""
    rows = [tape.zero] * len(constraints.velocities)
    if constraints.derived:
        rows[: len(constraints.positions)] = constraints.positions
        return rows
    for position in constraints.positions:
        derived = rate(position)
        free = [k for k, row in enumerate(rows) if not row]
        for sign in (1, -1):
            same = is_zero(tape, [constraints.velocities[k] - derived * sign for k in free])
            if any(same):
                rows[free[same.index(True)]] = position * sign
                break
    return rows


def position_jacobian(
    tape: Tape, constraints: Constraints, q: Sequence[Scalar], q_rates: Sequence[Scalar], u: Sequence[Scalar]
) -> list[list[Scalar]]:
    """dPhi/dq; a coordinate whose rate is a speed of its own has that speed's column of J, which stands already."""
    rows = jacobian(tape, constraints.positions, q)
    if constraints.derived:
        for j, rate in enumerate(q_rates):
            if rate in u and not tape.depends([*q_rates[:j], *q_rates[j + 1 :]], [rate]):
                for row, of_speeds in zip(rows, constraints.jacobian, strict=False):
                    row[j] = of_speeds[u.index(rate)]
    return rows
