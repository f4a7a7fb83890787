"""Trajectory -> an interactive report: one HTML file that needs no network and no server."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.presentation.drawing import drawing, panels
from fourbar_codegen.presentation.storage import attributes

if TYPE_CHECKING:
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["frame_times", "report_text", "run_rows"]

Floats = NDArray[np.float64]

FRAMES_PER_SECOND = 60
MIN_FRAMES = 241
"""Short runs are shown at more times, so that their curves are smooth."""
MAX_FRAMES = 601
"""More than these are not embedded: longer runs are shown at fewer times."""


def report_text(trajectory: Trajectory) -> str:
    """The report as HTML: the moving mechanism, traces of its points, plots that follow, and a table of the run.

    Parameters
    ----------
    trajectory : Trajectory
        It is shown at equally spaced times; see `Trajectory.resample`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If there is nothing to show: no points whose positions are known, or no states.
    """
    drawn = drawing(trajectory, frame_times)
    traced = drawn.traced()
    data = {
        "times": _packed(drawn.shown.t, "<f8"),
        # In units of the mechanism's size: single precision has a smaller range.
        "positions": _packed(np.moveaxis(np.array([*drawn.positions, *drawn.arrows.values()]), 2, 0) / drawn.size),
        "planar": drawn.is_planar,
        # Their tips stand behind the points.
        "arrows": list(drawn.arrows),
        "points": [
            {"name": name, "parent": parent, "body": body, "traced": number in traced}
            for number, name, parent, body in drawn.points()
        ],
        "plots": _plots(drawn.shown),
        "table": run_rows(trajectory),
    }
    # "<" would end the element that the data stands in.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = resources.files("fourbar_codegen.presentation").joinpath("report.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", html.escape(trajectory.model.name)).replace("@DATA@", text)


def frame_times(start: float, end: float) -> Floats:
    """The times at which a run from start to end is shown."""
    n = np.clip(round(abs(end - start) * FRAMES_PER_SECOND), MIN_FRAMES, MAX_FRAMES) if start != end else 1
    return np.linspace(start, end, int(n))


def _packed(values: Any, dtype: str = "<f4") -> str:
    """Numbers as the page reads them."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def _plots(shown: Trajectory) -> list[dict[str, Any]]:
    return [
        {
            "title": panel.title,
            "log": panel.is_logarithmic,
            "curves": [
                {"name": name, "values": _packed(np.log10(values) if panel.is_logarithmic else values)}
                for name, values in panel.curves.items()
            ],
        }
        for panel in panels(shown)
    ]


def run_rows(trajectory: Trajectory) -> list[tuple[str, str]]:
    """What a run was, and what it took, as names and texts."""
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
    rows += [(name, " ".join((f"{value:g}", model.units[name])).strip()) for name, value in run["parameters"].items()]
    return rows + list(run["versions"].items())
