"""HTML: interactive reports."""

from __future__ import annotations

from typing import IO

from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.report import report_text

__all__ = ["write_trajectory"]


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The report of a run."""
    file.write(report_text(trajectory).encode("utf-8"))
