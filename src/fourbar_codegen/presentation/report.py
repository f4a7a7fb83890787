"""Trajectory -> an interactive report: one HTML file that works offline."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fourbar_codegen.presentation.drawing import drawing, panels
from fourbar_codegen.presentation.html_page import frame_times, html_text, packed, scene_data
from fourbar_codegen.presentation.storage import attributes

if TYPE_CHECKING:
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["SCRIPTS", "report_text", "run_rows"]

SCRIPTS = ("drawing.js", "report.js")


def report_text(trajectory: Trajectory) -> str:
    """The report as HTML: the moving mechanism, traces, plots that follow the time, and a table of the run.

    Parameters
    ----------
    trajectory : Trajectory
        Shown at equally spaced times; see `Trajectory.resample`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If there is nothing to show: no points with known positions, or no states.
    """
    drawn = drawing(trajectory, frame_times)
    data = {
        "times": packed(drawn.shown.t, "<f8"),
        # Relative to the size of the mechanism, because of the range of single precision.
        "positions": packed(np.moveaxis(drawn.scene.positions, 2, 0) / drawn.scene.size),
        "scene": scene_data(drawn.scene, drawn.arrows, drawn.scene.unit / drawn.scene.size),
        "plots": _plots(drawn.shown),
        "table": run_rows(trajectory),
    }
    return html_text("report.html", trajectory.model.name, data, SCRIPTS)


def _plots(shown: Trajectory) -> list[dict[str, Any]]:
    return [
        {
            "title": panel.title,
            "log": panel.is_logarithmic,
            "open": panel.is_open,
            "curves": [
                {"name": name, "values": packed(np.log10(values) if panel.is_logarithmic else values)}
                for name, values in panel.curves.items()
            ],
        }
        for panel in panels(shown)
    ]


def run_rows(trajectory: Trajectory) -> list[tuple[str, str]]:
    """The table of a run: names and texts."""
    model, run = trajectory.model, attributes(trajectory)
    rows = [("model", run["model"]), ("fingerprint", run["fingerprint"][:16])]
    rows += [(name, str(value)) for name, value in run["settings"].items()]
    rows += [
        ("ended", run["message"]),
        ("evaluations", str(run["nfev"])),
        ("stored states", str(len(trajectory.t))),
    ]
    if trajectory.constraint_residual.size:
        rows.append(
            (f"{trajectory.residual_label.lower()} at most", f"{np.abs(trajectory.constraint_residual).max():.2e}")
        )
    if trajectory.energy_without:
        rows.append(("energy without", ", ".join(trajectory.energy_without)))
    rows += [(name, " ".join((f"{value:g}", model.units[name])).strip()) for name, value in run["parameters"].items()]
    return rows + list(run["versions"].items())
