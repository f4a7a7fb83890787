"""The bodies of a mechanism in pictures: how they are turned, and what box has their mass and inertia."""

from __future__ import annotations

from collections.abc import Sequence

from fourbar_codegen.dynamics.equations import DrawnBodies, Variables, of_known, vector
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Rotation, multiply
from fourbar_codegen.expressions.tape import Result, Scalar

__all__ = ["form_bodies"]


def form_bodies(kane: Kane, variables: Variables, frames: Sequence[str] = ()) -> DrawnBodies:
    """Orientations, masses and central inertias of the bodies with a frame.

    Parameters
    ----------
    kane : Kane
    variables : Variables
    frames : sequence of str
        Names of further frames whose orientations are wanted; they have no mass.

    Returns
    -------
    DrawnBodies
        Entries that contain other parameters or inputs than `variables` are NaN: nobody has asked for values of these.
    """
    kinematics = kane.kinematics
    names, rotations, masses, inertias = list[str](), list[list[Scalar]](), list[Scalar](), list[list[Scalar]]()
    for body, mass, inertia in kane.mass_properties():
        if body.frame is None or not kinematics.is_oriented(body.frame):
            continue
        names.append(body.name)
        masses.append(mass)
        rotations.append(_row_by_row(kinematics.rotation(body.frame, INERTIAL)))
        if inertia is None:
            inertias.append([kinematics.tape.zero] * 9)
        else:  # R I R^T, whose rows are those of R (R I^T)^T
            turn = kinematics.rotation(inertia.frame, body.frame)
            turned = _columns([multiply(turn, row) for row in inertia.matrix])
            inertias.append(_row_by_row(_columns([multiply(turn, row) for row in turned])))
    for number, frame in enumerate(kane.mechanism.frames):
        if frame.name in frames and frame.name not in names and kinematics.is_oriented(number):
            names.append(frame.name)
            masses.append(kinematics.tape.zero)
            rotations.append(_row_by_row(kinematics.rotation(number, INERTIAL)))
            inertias.append([kinematics.tape.zero] * 9)
    return DrawnBodies(
        tuple(names),
        _rows("orientations", variables, rotations),
        vector("masses", of_known(variables, masses)),
        _rows("inertias", variables, inertias),
    )


def _row_by_row(matrix: Rotation) -> list[Scalar]:
    return [entry for row in matrix for entry in row]


def _columns(rows: list[Components]) -> Rotation:
    """The transpose."""
    a, b, c = zip(*rows, strict=True)
    return a, b, c


def _rows(name: str, variables: Variables, rows: list[list[Scalar]]) -> Result:
    return Result(name, (len(rows), 9), tuple(of_known(variables, [entry for row in rows for entry in row])))
