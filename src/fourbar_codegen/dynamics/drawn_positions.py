"""What is drawn of a mechanism: its points with their positions, shapes between them, and forces of inputs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Kinematics, add
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling.mechanism import DrawnPoint, Mechanism, Shape

__all__ = ["DrawnPositions", "applied_forces", "find_drawn_positions"]


@dataclass(frozen=True)
class DrawnPositions:
    """What is drawn of a mechanism.

    Attributes
    ----------
    points : tuple of DrawnPoint
        Those with names come first.
    positions : tuple of Components
        Of these points, in the inertial frame, m.
    shapes : tuple of Shape
        Links, guides, springs and dampers, by the points' numbers.
    not_drawn : tuple of str
        Names of the points that are left out.
    is_at_rest : bool
        Whether the point that positions are relative to stays at rest: the System's fixed point, or one of which the
        positions of bodies change with their velocities. A wheel's contact point is at rest for a moment.
    """

    points: tuple[DrawnPoint, ...]
    positions: tuple[Components, ...]
    shapes: tuple[Shape, ...]
    not_drawn: tuple[str, ...]
    is_at_rest: bool


def find_drawn_positions(mechanism: Mechanism, kinematics: Kinematics) -> DrawnPositions:
    """The drawn points with their positions, and the shapes between them.

    Points whose positions contain symbols unknown to the model are left out, and what is drawn between them.
    """
    positions: dict[int, Components] = {}
    for number, point in enumerate(mechanism.drawn):
        if point.parent is None or point.parent in positions:
            with suppress(ModelError):
                offset = kinematics.express(kinematics.vector(point.offset), INERTIAL)
                positions[number] = offset if point.parent is None else add(positions[point.parent], offset)
    order = sorted(positions, key=lambda number: not mechanism.drawn[number].name)
    places = {number: place for place, number in enumerate(order)}
    shapes = []
    for shape in mechanism.shapes:
        known = tuple(places[number] for number in shape.points if number in places)
        if len(known) == len(shape.points) or (shape.kind in ("ground", "link") and known):
            shapes.append(replace(shape, points=known))
    unknown = [point.name for number, point in enumerate(mechanism.drawn) if number not in positions and point.name]
    moving = [body.point for body in mechanism.bodies if kinematics.moves(body.point)]
    return DrawnPositions(
        tuple(mechanism.drawn[number] for number in order),
        tuple(positions[number] for number in order),
        tuple(shapes),
        (*mechanism.not_drawn, *unknown),
        bool(mechanism.is_origin_fixed) or all(map(kinematics.moves_as_placed, moving)),
    )


def applied_forces(
    tape: Tape,
    mechanism: Mechanism,
    kinematics: Kinematics,
    points: Sequence[DrawnPoint],
    inputs: Sequence[Scalar],
    unknown: Sequence[Scalar],
) -> dict[int, Components]:
    """The sum of the forces that depend on inputs, for each drawn point, by its number."""
    numbers = {point.number: place for place, point in enumerate(points) if point.number is not None}
    forces: dict[int, Components] = {}
    for load in mechanism.loads:
        if load.kind == "force" and load.target in numbers:
            force = kinematics.express(kinematics.vector(load.vector), INERTIAL)
            if tape.depends(force, set(inputs)) and not tape.depends(force, set(unknown)):
                number = numbers[load.target]
                forces[number] = add(forces[number], force) if number in forces else force
    return forces
