"""Trajectory -> an interactive report: one HTML file that works offline."""

from __future__ import annotations

import base64
import html
import json
from dataclasses import asdict
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.presentation.drawing import drawing, panels
from fourbar_codegen.presentation.scene import SYMBOLS
from fourbar_codegen.presentation.storage import attributes

if TYPE_CHECKING:
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["frame_times", "report_text", "run_rows"]

Floats = NDArray[np.float64]

FRAMES_PER_SECOND = 60
MIN_FRAMES = 241
"""Smallest number of frames, so that curves of short runs are smooth."""
MAX_FRAMES = 601
"""Largest number of frames: long runs are shown with fewer per second."""


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
    found = drawn.scene
    traced = found.traced()
    data = {
        "times": _packed(drawn.shown.t, "<f8"),
        # Relative to the size of the mechanism, because of the range of single precision.
        "positions": _packed(np.moveaxis(found.positions, 2, 0) / found.size),
        "unit": found.unit / found.size,
        "planar": found.is_planar,
        "arrows": list(drawn.arrows.items()),
        "points": [
            {"name": name, "body": body, "traced": row in traced}
            for row, (name, body) in enumerate(zip(found.names, found.bodies, strict=True))
        ],
        "lines": [{"kind": line.kind, "rows": line.rows, "closed": line.is_closed} for line in found.lines],
        "symbols": [asdict(symbol) for symbol in found.symbols],
        "outlines": SYMBOLS,
        "plots": _plots(drawn.shown),
        "table": run_rows(trajectory),
    }
    # "<" could end the HTML element that contains the data.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = resources.files("fourbar_codegen.presentation").joinpath("report.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", html.escape(trajectory.model.name)).replace("@DATA@", text)


def frame_times(start: float, end: float) -> Floats:
    """The times of the frames of a run from start to end."""
    n = np.clip(round(abs(end - start) * FRAMES_PER_SECOND), MIN_FRAMES, MAX_FRAMES) if start != end else 1
    return np.linspace(start, end, int(n))


def _packed(values: Any, dtype: str = "<f4") -> str:
    """Numbers in the format of the page."""
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
    rows += [(name, " ".join((f"{value:g}", model.units[name])).strip()) for name, value in run["parameters"].items()]
    return rows + list(run["versions"].items())
