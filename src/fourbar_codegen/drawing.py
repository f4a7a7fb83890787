"""What there is to draw of a trajectory: the mechanism's points at equally spaced times."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.trajectory import Trajectory

__all__ = ["Drawing", "drawing", "equal_times"]

Floats = NDArray[np.float64]

PLANAR = 1e-9
"""Points that leave the plane of x and y, or their places, by less than this share of the mechanism's size do not."""


@dataclass(frozen=True)
class Drawing:
    """A trajectory at the times at which it is shown, and where its points are.

    Attributes
    ----------
    shown : Trajectory
    positions : ndarray, shape (n_points, 3, n_t)
        In the inertial frame, m.
    size : float
        The largest extent along one of its axes, m.
    """

    shown: Trajectory
    positions: Floats
    size: float

    @property
    def is_planar(self) -> bool:
        """Whether all points stay in one plane z = constant."""
        return bool(np.ptp(self.positions[:, 2]) <= PLANAR * self.size)

    def moves(self, point: int) -> bool:
        """Whether a point does not stay where it is."""
        return bool(np.ptp(self.positions[point], axis=1).max() > PLANAR * self.size)

    def points(self) -> Iterator[tuple[int, str, int | None, str | None]]:
        """Number, name, number of the point from which a line leads to it, and body of each point."""
        for number, entry in enumerate(self.shown.model.manifest["points"]):
            yield number, entry["name"], entry["parent"], entry["body"]


def equal_times(start: float, end: float, rate: float, most: int | None = None) -> Floats:
    """Equally spaced times from start to end, about so many in a second, and no more than `most`."""
    if start == end:
        return np.array([start])
    n = 1 + max(1, round(abs(end - start) * rate))
    return np.linspace(start, end, n if most is None else min(n, most))


def drawing(trajectory: Trajectory, rate: float, most: int | None = None) -> Drawing:
    """What there is to draw, so many times in a second of the run.

    Parameters
    ----------
    trajectory : Trajectory
    rate : float
    most : int, optional
        No more times than these.

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
    shown = trajectory.resample(equal_times(t[0], t[-1], rate, most))
    positions = np.array([shown.points[name] for name in model.points])
    return Drawing(shown, positions, float(np.ptp(positions, axis=(0, 2)).max()) or 1.0)
