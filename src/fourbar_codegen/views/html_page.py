"""What reports and live pages have in common: one HTML file of a template, styles, scripts and data."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from importlib import resources
from typing import Any

import numpy as np

from fourbar_codegen.views.scene import Scene

__all__ = ["frame_times", "html_file", "html_text", "packed", "scene_data"]

FRAMES_PER_SECOND = 60
MIN_FRAMES = 241
"""Smallest number of frames, so that curves of short runs are smooth."""
MAX_FRAMES = 601
"""Largest number of frames: long runs are shown with fewer per second."""


def frame_times(start: float, end: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The times of the frames of a run from start to end."""
    n = np.clip(round(abs(end - start) * FRAMES_PER_SECOND), MIN_FRAMES, MAX_FRAMES) if start != end else 1
    return np.linspace(start, end, int(n))


def packed(values: Any, dtype: str = "<f4") -> str:
    """Numbers in the format of the scripts."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def scene_data(scene: Scene, arrows: Mapping[int, int], unit: float) -> dict[str, Any]:
    """What `mechanismPicture` of svg_pictures.js takes; `unit` is the size of symbols in the unit of the positions."""
    traced = scene.traced()
    return {
        "unit": unit,
        "planar": scene.is_planar,
        "arrows": list(arrows.items()),
        "points": [
            {"name": name, "body": body, "traced": row in traced}
            for row, (name, body) in enumerate(zip(scene.names, scene.bodies, strict=True))
        ],
        "lines": [{"kind": line.kind, "rows": line.rows, "closed": line.is_closed} for line in scene.lines],
        "symbols": [asdict(symbol) for symbol in scene.symbols],
        "shown": scene.shown,
    }


def html_text(template: str, title: str, data: Mapping[str, Any], scripts: Iterable[str], **texts: str) -> str:
    """A page that needs nothing else.

    Parameters
    ----------
    template : str
        Path of an HTML file in the package, with ``@TITLE@``, ``@STYLE@``, ``@PLAYER@``, ``@DATA@`` and
        ``@SCRIPT@``.
    title : str
    data : mapping
        Plain data that JSON can hold.
    scripts : iterable of str
        Paths of files in the package, one after the other.
    **texts : str
        Further texts, by their names in the template.
    """
    # "<" could end the HTML element that contains the data.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = html_file(template).replace("@TITLE@", html.escape(title))
    for name, more in {
        "STYLE": html_file("views/style.css"),
        "PLAYER": html_file("views/player.html"),
        **texts,
    }.items():
        page = page.replace(f"@{name}@", more)
    return page.replace("@SCRIPT@", "\n".join(map(html_file, scripts))).replace("@DATA@", text)


def html_file(name: str) -> str:
    """The text of a file of the package, by its path there."""
    return resources.files("fourbar_codegen").joinpath(name).read_text(encoding="utf-8")
