"""Trajectory -> an interactive report: one HTML file that works offline."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_integer
from fourbar_codegen.interface.notebook import Page, table
from fourbar_codegen.results.provenance import attributes
from fourbar_codegen.views.frames import frames_of
from fourbar_codegen.views.html_page import frame_times, html_text, packed, quaternions, scene_data
from fourbar_codegen.views.model_shapes import ShapesLike
from fourbar_codegen.views.panels import panels

if TYPE_CHECKING:
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["SCRIPTS", "report", "report_text", "table_of_run"]

SCRIPTS = ("views/svg_pictures.js", "views/solid_pictures.js", "views/report.js")


def report(trajectory: Trajectory, *, height: int = 900, shapes: ShapesLike | None = None) -> Page:
    """The interactive report in a notebook: the moving mechanism, traces, plots and a table of the run.

    The same page as ``save("run.html")``; it needs no network, no extra and no running kernel.

    Parameters
    ----------
    height : int, optional
        Height in the notebook, pixels.
    shapes : mapping of body, frame or str to shape or sequence of shapes, optional
        What bodies look like in space, instead of `CompiledModel.shapes`.

    Returns
    -------
    Page
        Displayed if it is the last expression of a cell.

    Raises
    ------
    ModelError
        If height is not a positive integer, or there is nothing to show: no points with known positions, or no
        states.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").simulate((0.0, 1.0)).report()
    <Report of four_bar, 900 pixels high>
    """
    if not is_integer(height) or height < 1:
        raise ModelError(f"height must be a positive number of pixels, not {shown(height)}.")
    return Page(f"Report of {trajectory.kernel.name}", report_text(trajectory, shapes), int(height))


def table_of_run(trajectory: Trajectory) -> str:
    """The table of a run as HTML."""
    return table("Trajectory", (), _rows(trajectory))


def report_text(trajectory: Trajectory, shapes: ShapesLike | None = None) -> str:
    """The report as HTML: the moving mechanism, traces, plots that follow the time, and a table of the run.

    Parameters
    ----------
    trajectory : Trajectory
        Shown at equally spaced times; see `Trajectory.resample`.
    shapes : mapping, optional
        As for `report`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If there is nothing to show: no points with known positions, or no states.
    """
    drawn = frames_of(trajectory, frame_times, shapes)
    data = {
        "times": packed(drawn.shown.t, "<f8"),
        # Relative to the size of the mechanism, because of the range of single precision.
        "positions": packed(np.moveaxis(drawn.scene.positions, 2, 0) / drawn.scene.size),
        "rotations": packed(quaternions(drawn.scene.rotations)),
        "scene": scene_data(drawn.scene, drawn.arrows, 1.0 / drawn.scene.size),
        "longest": drawn.longest,
        "plots": _plots(drawn.shown),
        "table": _rows(trajectory),
    }
    return html_text("views/report.html", trajectory.kernel.name, data, SCRIPTS)


def _plots(shown: Trajectory) -> list[dict[str, Any]]:
    return [
        {
            "title": panel.title,
            "log": panel.is_logarithmic,
            "open": panel.is_open,
            "bodies": [panel.bodies.get(name, "") for name in panel.curves],
            "curves": [
                {"name": name, "values": packed(np.log10(values) if panel.is_logarithmic else values)}
                for name, values in panel.curves.items()
            ],
        }
        for panel in panels(shown)
    ]


def _rows(trajectory: Trajectory) -> list[tuple[str, str]]:
    """The table of a run: names and texts."""
    model, run = trajectory.kernel, attributes(trajectory)
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
