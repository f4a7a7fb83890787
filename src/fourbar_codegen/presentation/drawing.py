"""The data of pictures: the points of the mechanism at equally spaced times, and curves over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["Drawing", "Panel", "drawing", "equal_times", "extent", "panels"]

Floats = NDArray[np.float64]

PLANAR = 1e-9
"""Relative tolerance, of the size of the mechanism, for planar mechanisms and for points at rest."""

ARROW = 0.25
"""Length of the largest force's arrow, relative to the size of the mechanism."""


@dataclass(frozen=True)
class Drawing:
    """A trajectory at the times that are shown, with the positions of its points.

    Attributes
    ----------
    shown : Trajectory
    positions : ndarray, shape (n_points, 3, n_t)
        In the inertial frame, m.
    arrows : dict of int to ndarray, shape (3, n_t)
        Tips of the arrows of forces that depend on inputs, m, by the number of the point where they start.
    size : float
    is_planar : bool
        As returned by `extent`.
    """

    shown: Trajectory
    positions: Floats
    arrows: dict[int, Floats]
    size: float
    is_planar: bool

    def moves(self, point: int) -> bool:
        """Whether a point moves."""
        return bool(np.ptp(self.positions[point], axis=1).max() > PLANAR * self.size)

    def traced(self) -> dict[int, str]:
        """Number and name of the points with a trace by default.

        Moving joints and ends of links, one for each position; the mass centres if there are none.
        """
        moving = [(number, name, body) for number, name, _, body in self.points() if self.moves(number)]
        joints: dict[int, str] = {}
        for number, name, body in moving:
            path = self.positions[number]
            if body is None and not any(np.abs(path - self.positions[k]).max() <= PLANAR * self.size for k in joints):
                joints[number] = name
        return joints or {number: name for number, name, _ in moving}

    def points(self) -> Iterator[tuple[int, str, int | None, str | None]]:
        """For each point: number, name, number of the point that a line connects it to, and body."""
        for number, entry in enumerate(self.shown.model.manifest["points"]):
            yield number, entry["name"], entry["parent"], entry["body"]


def extent(positions: Floats) -> tuple[float, bool]:
    """The largest extent along an axis, m, and whether all points stay in one plane z = constant.

    Parameters
    ----------
    positions : ndarray, shape (n_points, 3, n_t)
    """
    size = float(np.ptp(positions, axis=(0, 2)).max()) or 1.0
    return size, bool(np.ptp(positions[:, 2]) <= PLANAR * size)


def equal_times(start: float, end: float, rate: float) -> Floats:
    """Equally spaced times from start to end, with about this rate per second."""
    return np.linspace(start, end, 1 + max(1, round(abs(end - start) * rate)) if start != end else 1)


def drawing(trajectory: Trajectory, times: Callable[[float, float], Floats]) -> Drawing:
    """The data of pictures at certain times.

    Parameters
    ----------
    trajectory : Trajectory
    times : callable
        Function of the first and last time of the run; returns the times to show.

    Returns
    -------
    Drawing

    Raises
    ------
    ModelError
        If there is nothing to draw.
    """
    model, t = trajectory.model, trajectory.t
    if not model.points:
        raise ModelError(f"There is nothing of {model.name} to draw: no positions are given from a point at rest.")
    if not len(t):
        raise ModelError(f"There is nothing of {model.name} to draw: the run has no states.")
    shown = trajectory.resample(times(t[0], t[-1]))
    positions = np.array([shown.points[name] for name in model.points])
    size, is_planar = extent(positions)
    # Forces that are not finite have no arrow.
    forces = {name: np.where(np.isfinite(force).all(axis=0), force, 0.0) for name, force in shown.forces.items()}
    greatest = max((np.abs(force).max() for force in forces.values()), default=0.0)
    if greatest:
        forces = {name: force / greatest for name, force in forces.items()}
        longest = max(np.linalg.norm(force, axis=0).max() for force in forces.values())
        forces = {name: ARROW * size * force / longest for name, force in forces.items()}
    arrows = {model.points.index(name): shown.points[name] + force for name, force in forces.items() if greatest}
    return Drawing(shown, positions, arrows, size, is_planar)


@dataclass(frozen=True)
class Panel:
    """Curves in the same axes.

    Attributes
    ----------
    title : str
    curves : dict of str to ndarray, shape (n_t,)
    is_logarithmic : bool
        Whether the vertical axis is logarithmic.
    """

    title: str
    curves: dict[str, Floats]
    is_logarithmic: bool = False


def panels(trajectory: Trajectory) -> list[Panel]:
    """All curves of a trajectory over time: states, inputs, outputs, energy, multipliers, residual."""
    model = trajectory.model
    energies = {
        "kinetic": trajectory.kinetic_energy,
        "potential": trajectory.potential_energy,
        "sum": trajectory.energy,
    }
    found = [
        Panel("Coordinates (rad or m)", dict(zip(model.coordinates, trajectory.q, strict=True))),
        Panel("Speeds (rad/s or m/s)", dict(zip(model.speeds, trajectory.u, strict=True))),
        Panel("Auxiliary states", dict(zip(model.auxiliary_states, trajectory.z, strict=True))),
        Panel("Inputs", dict(zip(model.inputs, trajectory.r, strict=True))),
        Panel("Outputs", dict(zip(model.outputs, trajectory.outputs, strict=True))),
        Panel("Energy (J)", {name: row for name, row in energies.items() if np.isfinite(row).any()}),
        Panel(
            "Multipliers of the constraints",
            {f"lambda{number}": row for number, row in enumerate(trajectory.multipliers, start=1)},
        ),
    ]
    if len(trajectory.constraint_residual):
        # Zero is replaced by half the machine epsilon, for the logarithmic axis.
        largest = np.maximum(np.abs(trajectory.constraint_residual).max(axis=0), np.finfo(float).eps / 2)
        found.append(Panel(f"{trajectory.residual_label} (units of the constraints)", {"largest": largest}, True))
    return [panel for panel in found if panel.curves]
