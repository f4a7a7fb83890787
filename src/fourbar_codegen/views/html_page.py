"""What reports and live pages have in common: one HTML file of a template, styles, scripts and data."""

from __future__ import annotations

import base64
import html
import importlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.views.scene import Scene
from fourbar_codegen.views.solids import Solid

__all__ = ["frame_times", "html_file", "html_text", "packed", "quaternions", "scene_data"]

Floats = NDArray[np.float64]

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


def scene_data(scene: Scene, arrows: Mapping[int, int], scale: float, *, is_live: bool = False) -> dict[str, Any]:
    """What `mechanismPicture` of svg_pictures.js and `solidPicture` of solid_pictures.js take.

    Parameters
    ----------
    scene : Scene
    arrows : mapping of int to int
    scale : float
        Of lengths, so that they are in the unit of the positions that the scripts have.
    is_live : bool, optional
        Whether parameters that are sizes change.
    """
    traced = scene.traced()
    return {
        "unit": scene.unit * scale,
        "planar": scene.is_planar,
        "arrows": list(arrows.items()),
        "points": [
            {"name": name, "body": body, "traced": row in traced, "holder": scene.holders[row]}
            for row, (name, body) in enumerate(zip(scene.names, scene.bodies, strict=True))
        ],
        "lines": [{"kind": line.kind, "rows": line.rows, "closed": line.is_closed} for line in scene.lines],
        "symbols": [asdict(symbol) for symbol in scene.symbols],
        "shown": scene.shown,
        **_solids(scene.solids, scale, is_live),
        "ground": [*scene.contacts],
        "groundAxes": scene.ground_axes.tolist(),
    }


def _solids(solids: Sequence[Solid], scale: float, is_live: bool) -> dict[str, Any]:
    """Meshes, each once, and the solids that have them."""
    meshes: dict[tuple[Any, ...], int] = {}
    entries = []
    for solid in solids:
        changes = solid.changes if is_live else ()
        mesh = (
            packed(solid.mesh.vertices * scale),
            packed(np.round(solid.mesh.normals * 127.0), "<i1"),
            packed(solid.mesh.faces, "<u2"),
            tuple((change.parameter, change.value, packed(change.vertices * scale)) for change in changes),
        )
        entries.append(
            {
                "name": solid.name,
                "mesh": meshes.setdefault(mesh, len(meshes)),
                "color": solid.color,
                "row": solid.row,
                "turn": solid.turn,
                "offset": (solid.offset * scale).tolist(),
                "rotation": solid.rotation.ravel().tolist(),
                "to": solid.to,
                "length": solid.length * scale,
                "changes": [(c.parameter, c.value, (c.offset * scale).tolist()) for c in changes],
            }
        )
    parts = ("vertices", "normals", "faces", "changes")
    return {"meshes": [dict(zip(parts, mesh, strict=True)) for mesh in meshes], "solids": entries}


def quaternions(rotations: Floats) -> Floats:
    """Quaternions (x, y, z, w) of rotation matrices of shape (n_bodies, 3, 3, n_t), shape (n_t, n_bodies, 4)."""
    n_bodies, _, _, n = rotations.shape
    matrices = np.moveaxis(rotations, 3, 0).reshape(-1, 3, 3)
    known, found = np.isfinite(matrices).all(axis=(1, 2)), np.full((len(matrices), 4), np.nan)
    if known.any():
        found[known] = (
            importlib.import_module("scipy.spatial.transform").Rotation.from_matrix(matrices[known]).as_quat()
        )
    return found.reshape(n, n_bodies, 4)


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
