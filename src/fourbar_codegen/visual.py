"""Pictures of trajectories, with Matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fourbar_codegen.errors import ModelError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fourbar_codegen.trajectory import Trajectory

__all__ = ["plot_trajectory"]


def plot_trajectory(trajectory: Trajectory) -> Figure:
    """Coordinates, loop residual (where there are loops) and energy over time, one above the other.

    Parameters
    ----------
    trajectory : Trajectory

    Returns
    -------
    matplotlib.figure.Figure
        Made without pyplot: it appears on no screen by itself and needs not be closed.

    Raises
    ------
    ModelError
        If Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ModelError("Plots need Matplotlib: pip install 'fourbar_codegen[visual]'.") from error

    model = trajectory.model
    panels = 3 if model.n_h else 2
    figure = Figure(figsize=(7.0, 2.5 * panels), layout="constrained")
    coordinates, *residuals, energy = figure.subplots(panels, 1, sharex=True)
    for name, values in zip(model.coordinates, trajectory.q, strict=True):
        coordinates.plot(trajectory.t, values, label=name)
    coordinates.set_ylabel("coordinates (rad or m)")
    coordinates.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    for residual in residuals:
        # Zero has no place on a logarithmic axis; half the smallest normal step of double around 1 stands for it.
        size = np.abs(trajectory.constraint_residual).max(axis=0)
        residual.semilogy(trajectory.t, np.maximum(size, np.finfo(float).eps / 2), color="tab:red")
        residual.set_ylabel("loop residual (constraints' unit)")
    for label, values in (
        ("kinetic", trajectory.kinetic_energy),
        ("potential", trajectory.potential_energy),
        ("sum", trajectory.energy),
    ):
        if np.isfinite(values).any():
            energy.plot(trajectory.t, values, label=label)
    energy.set_ylabel("energy (J)")
    energy.set_xlabel("time (s)")
    energy.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(model.name)
    return figure
