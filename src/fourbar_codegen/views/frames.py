"""The frames of moving pictures: a run at the times that are shown, its scene, and arrows of forces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import parameter_array
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.model_shapes import ShapesLike, given_shapes
from fourbar_codegen.views.scene import Scene, scene

__all__ = ["ARROW", "Frames", "equal_times", "frames_of"]

Floats = NDArray[np.float64]

ARROW = 0.25
"""Length of the largest force's arrow, relative to the size of the mechanism."""


@dataclass(frozen=True)
class Frames:
    """A trajectory at the times that are shown.

    Attributes
    ----------
    shown : Trajectory
    scene : Scene
        Its last rows are the tips of the arrows.
    arrows : dict of int to int
        For each force that depends on inputs, the rows of the point where it acts and of the tip of its arrow.
    longest : float
        The magnitude of the force with the longest arrow, N.
    """

    shown: Trajectory
    scene: Scene
    arrows: dict[int, int]
    longest: float


def equal_times(start: float, end: float, rate: float) -> Floats:
    """Equally spaced times from start to end, with about this rate per second."""
    return np.linspace(start, end, 1 + max(1, round(abs(end - start) * rate)) if start != end else 1)


def frames_of(
    trajectory: Trajectory,
    times: Callable[[float, float], Floats],
    shapes: ShapesLike | None = None,
    *,
    in_space: bool = False,
) -> Frames:
    """A run at the times of its frames.

    Parameters
    ----------
    trajectory : Trajectory
    times : callable
        Function of the first and last time of the run; returns the times to show.
    shapes : mapping, optional
        What bodies look like, as for `Model`, instead of the model's shapes.
    in_space : bool, optional
        Whether planar mechanisms also have bodies with shapes.

    Returns
    -------
    Frames

    Raises
    ------
    ModelError
        If there is nothing to draw.
    """
    model, t = trajectory.kernel, trajectory.t
    if not len(t):
        raise ModelError(f"There is nothing of {model.name} to draw: the run has no states.")
    shown = trajectory.resample(times(t[0], t[-1]))
    positions, _ = model.drawing_along(shown.t, shown.y, shown.r, shown.parameters)
    values = parameter_array(model, shown.parameters)
    rotations = model.orientations_along(shown.t, shown.y, shown.r, shown.parameters)
    found = scene(model, positions, rotations=rotations, p=values, given=given_shapes(model, shapes), in_space=in_space)
    # Forces that are not finite have no arrow.
    forces = {name: np.where(np.isfinite(force).all(axis=0), force, 0.0) for name, force in shown.forces.items()}
    greatest = max((np.abs(force).max() for force in forces.values()), default=0.0)
    strongest = 0.0
    if greatest:
        forces = {name: force / greatest for name, force in forces.items()}
        longest = max(np.linalg.norm(force, axis=0).max() for force in forces.values())
        strongest = float(greatest * longest)
        forces = {name: ARROW * found.body_size * force / longest for name, force in forces.items()}
    tips = {
        model.points.index(name): found.view(shown.points[name] + force) for name, force in forces.items() if greatest
    }
    arrows = {point: len(found.positions) + number for number, point in enumerate(tips)}
    return Frames(shown, replace(found, positions=np.array([*found.positions, *tips.values()])), arrows, strongest)
