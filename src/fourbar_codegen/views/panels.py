"""The panels of plots: curves over time in the same axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.kernel import ENERGIES, Kernel, parameter_array
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import VECTORS, Quantity
from fourbar_codegen.views.moved_bodies import moved_bodies

__all__ = ["ENERGY", "FEW", "Panel", "bodies_of_curves", "panel_names", "panels", "title_with_unit", "vector_title"]

Floats = NDArray[np.float64]

ENERGY = "Energy (J)"

FEW = 8
"""Most curves whose legend is a line of names."""


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
    bodies : dict of str to str
        The body that each curve belongs to, if there are many curves, as far as it is known.
    """

    title: str
    curves: dict[str, Floats]
    is_logarithmic: bool = False
    is_open: bool = True
    bodies: dict[str, str] = field(default_factory=dict)


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


def bodies_of_curves(model: Kernel, parameters: Floats | None) -> dict[str, str]:
    """The bodies that coordinates and speeds move, if there are many of these, and positions are compiled."""
    values = parameter_array(model, parameters)
    if max(model.n_q, model.n_u) <= FEW or not model.points or model.lacks_drawing or np.isnan(values).any():
        return {}
    return moved_bodies(model, values)


def title_with_unit(model: Kernel, name: str) -> str:
    """The title of a quantity, with its unit as far as that is known."""
    title = model.title(name)
    if name in model.coordinates:
        return f"{title} ({'rad' if name in model.layout.angles else 'rad or m'})"
    if name in model.speeds:
        return f"{title} (rad/s or m/s)"
    if name in (*model.auxiliary_states, *model.inputs, *model.outputs):
        return title
    units = {
        "t": "s",
        **dict.fromkeys((*ENERGIES, "kinetic_energy", "kinetic energy"), "J"),
        **dict.fromkeys(model.points, "m"),
    }
    for vector in VECTORS:
        units |= dict.fromkeys((vector.name, *vector.components), vector.unit)
    return f"{title} ({units[name]})" if name in units else title


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
    bodies = bodies_of_curves(trajectory.kernel, trajectory.parameters)
    found = [
        Panel(
            title,
            {n: row for n, row in zip(names, rows, strict=False) if np.isfinite(row).any()},
            is_logarithmic,
            bodies={name: bodies[name] for name in names if name in bodies},
        )
        for (title, names, is_logarithmic), rows in zip(panel_names(trajectory.kernel), values, strict=True)
    ]
    for vector in VECTORS:
        rows = dict(zip(vector.components, trajectory.vectors[vector.name], strict=True))
        known = {name: row for name, row in rows.items() if np.isfinite(row).any()}
        found.append(Panel(vector_title(vector), known, is_open=False))
    return [panel for panel in found if panel.curves]
