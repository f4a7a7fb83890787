"""Data for drawings of a mechanism: positions of its points, and forces of inputs on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Kinematics, add
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.system_reader import DrawnPoint, Mechanism

__all__ = ["applied_forces", "drawn_points"]


def drawn_points(
    mechanism: Mechanism, kinematics: Kinematics
) -> tuple[tuple[DrawnPoint, ...], list[Components], dict[int, int]]:
    """The drawn points, their positions, and the mechanism's point numbers mapped to theirs.

    Points whose positions contain symbols unknown to the model are left out.
    """
    drawn: list[DrawnPoint] = []
    positions: list[Components] = []
    of_points: dict[int, int] = {}
    numbers: dict[int | None, int | None] = {None: None}
    for number, point in enumerate(mechanism.drawn):
        if point.parent not in numbers:
            continue
        try:
            offset = kinematics.express(kinematics.vector(point.offset), INERTIAL)
        except ModelError:
            continue
        parent = numbers[point.parent]
        numbers[number] = len(drawn)
        if point.number is not None:
            of_points[point.number] = len(drawn)
        drawn.append(replace(point, parent=parent))
        positions.append(offset if parent is None else add(positions[parent], offset))
    return tuple(drawn), positions, of_points


def applied_forces(
    tape: Tape,
    mechanism: Mechanism,
    kinematics: Kinematics,
    numbers: Mapping[int, int],
    inputs: Sequence[Scalar],
    unknown: Sequence[Scalar],
) -> dict[int, Components]:
    """The sum of the forces that depend on inputs, for each drawn point, by its number."""
    forces: dict[int, Components] = {}
    for load in mechanism.loads:
        if load.kind == "force" and load.target in numbers:
            force = kinematics.express(kinematics.vector(load.vector), INERTIAL)
            if tape.depends(force, set(inputs)) and not tape.depends(force, set(unknown)):
                number = numbers[load.target]
                forces[number] = add(forces[number], force) if number in forces else force
    return forces
