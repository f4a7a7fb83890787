"""MP4: animations, by Matplotlib and FFmpeg."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.figures import require_figures, write_animation

__all__ = ["require", "write_trajectory"]


def require() -> None:
    """Raise a ModelError if what draws or writes them is missing."""
    require_figures("mp4")


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The animation of a run."""
    write_animation(trajectory, Path(file.name), "mp4")
