"""PNG: plots, by Matplotlib."""

from __future__ import annotations

from typing import IO

from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.figures import plot_ensemble, plot_trajectory, require_figures

__all__ = ["require", "write_ensemble", "write_trajectory"]

DPI = 120


def require() -> None:
    """Raise a ModelError if Matplotlib is missing."""
    require_figures("png")


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The plot of a run."""
    plot_trajectory(trajectory).savefig(file, dpi=DPI, format="png")


def write_ensemble(ensemble: Ensemble, file: IO[bytes]) -> None:
    """The plot of its members."""
    plot_ensemble(ensemble).savefig(file, dpi=DPI, format="png")
