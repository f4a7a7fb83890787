"""The data of pictures of a run: the mechanism at equally spaced times, and curves over time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import VECTORS, Quantity
from fourbar_codegen.views.scene import Scene, scene

__all__ = ["Drawing", "Panel", "drawing", "equal_times", "panel_names", "panels", "vector_title"]

Floats = NDArray[np.float64]

ENERGY = "Energy (J)"

ARROW = 0.25
"""Length of the largest force's arrow, relative to the size of the mechanism."""


@dataclass(frozen=True)
class Drawing:
    """A trajectory at the times that are shown.

    Attributes
    ----------
    shown : Trajectory
    scene : Scene
        Its last rows are the tips of the arrows.
    arrows : dict of int to int
        For each force that depends on inputs, the rows of the point where it acts and of the tip of its arrow.
    """

    shown: Trajectory
    scene: Scene
    arrows: dict[int, int]


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
    model, t = trajectory.kernel, trajectory.t
    if not len(t):
        raise ModelError(f"There is nothing of {model.name} to draw: the run has no states.")
    shown = trajectory.resample(times(t[0], t[-1]))
    positions, _ = model.drawing_along(shown.t, shown.y, shown.r, shown.parameters)
    found = scene(model, positions)
    # Forces that are not finite have no arrow.
    forces = {name: np.where(np.isfinite(force).all(axis=0), force, 0.0) for name, force in shown.forces.items()}
    greatest = max((np.abs(force).max() for force in forces.values()), default=0.0)
    if greatest:
        forces = {name: force / greatest for name, force in forces.items()}
        longest = max(np.linalg.norm(force, axis=0).max() for force in forces.values())
        forces = {name: ARROW * found.size * force / longest for name, force in forces.items()}
    tips = {
        model.points.index(name): found.view(shown.points[name] + force) for name, force in forces.items() if greatest
    }
    arrows = {point: len(found.positions) + number for number, point in enumerate(tips)}
    return Drawing(shown, replace(found, positions=np.array([*found.positions, *tips.values()])), arrows)


@dataclass(frozen=True)
class Panel:
    """Curves in the same axes.

    Attributes
    ----------
    title : str
    curves : dict of str to ndarray, shape (n_t,)
    is_logarithmic : bool
        Whether the vertical axis is logarithmic.
    is_open : bool
        Whether it is shown at first.
    """

    title: str
    curves: dict[str, Floats]
    is_logarithmic: bool = False
    is_open: bool = True


def panel_names(model: Kernel) -> list[tuple[str, tuple[str, ...], bool]]:
    """All curves over time: titles, the names of their curves, and whether the axis is logarithmic."""
    energies = ("kinetic energy", model.title("potential energy"), model.title("total energy"))
    return [
        ("Coordinates (rad or m)", model.coordinates, False),
        ("Speeds (rad/s or m/s)", model.speeds, False),
        ("Auxiliary states", model.auxiliary_states, False),
        ("Inputs", model.inputs, False),
        ("Outputs", model.outputs, False),
        (ENERGY, energies, False),
        ("Multipliers of the constraints", tuple(f"lambda{number + 1}" for number in range(model.n_c)), False),
        (f"{model.residual_label} (units of the constraints)", ("largest residual",), True),
    ]


def vector_title(vector: Quantity) -> str:
    """The title of the panel of a vector's components."""
    return f"{vector.description[0].upper()}{vector.description[1:]} ({vector.unit})"


def panels(trajectory: Trajectory) -> list[Panel]:
    """All curves of a trajectory over time: states, inputs, outputs, energy, multipliers, residual; momenta."""
    residual = np.abs(trajectory.constraint_residual)
    energies = (trajectory.kinetic_energy, trajectory.potential_energy, trajectory.energy)
    # Zero is replaced by half the machine epsilon, for the logarithmic axis.
    largest = [np.maximum(residual.max(axis=0), np.finfo(float).eps / 2)] if len(residual) else []
    values: list[Sequence[Floats] | Floats] = [trajectory.q, trajectory.u, trajectory.z, trajectory.r]
    values += [trajectory.outputs, energies, trajectory.multipliers, largest]
    found = [
        Panel(title, {n: row for n, row in zip(names, rows, strict=False) if np.isfinite(row).any()}, is_logarithmic)
        for (title, names, is_logarithmic), rows in zip(panel_names(trajectory.kernel), values, strict=True)
    ]
    for vector in VECTORS:
        rows = dict(zip(vector.components, trajectory.vectors[vector.name], strict=True))
        known = {name: row for name, row in rows.items() if np.isfinite(row).any()}
        found.append(Panel(vector_title(vector), known, is_open=False))
    return [panel for panel in found if panel.curves]
