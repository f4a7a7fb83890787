"""Bodies in Matplotlib's axes: shaded triangles, sorted by depth, and the ground."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.views.scene import Scene

__all__ = ["CAMERA", "draw_solids", "ground_lines", "seen_obliquely"]

Floats = NDArray[np.float64]

HOME = (-0.6, -1.15)
"""Turn about the vertical, and tilt of the vertical away from the reader, rad, as in solid_pictures.js."""

LIGHT = np.array([0.30, 0.60, 0.74])
"""To the right, upwards, to the reader; as in solid_pictures.js."""

AMBIENT, DIFFUSE, HEMISPHERE = 0.42, 0.5, 0.13
LINES = 8
"""About the number of lines of the ground's grid along the longer side."""


def _camera() -> Floats:
    """From above the side: the rotation to coordinates to the right, upwards, and to the reader."""
    (c, s), (ct, st) = ((np.cos(angle), np.sin(angle)) for angle in HOME)
    return np.array([[c, -s, 0.0], [s * ct, c * ct, -st], [s * st, c * st, ct]])


CAMERA = _camera()


def seen_obliquely(drawn: Scene) -> Scene:
    """A scene in space as it is seen from above the side, in a plane whose third coordinate is the depth."""
    return replace(
        drawn,
        positions=np.einsum("ij,njt->nit", CAMERA, drawn.positions),
        rotations=np.einsum("ij,bjkt->bikt", CAMERA, drawn.rotations),
        view=replace(drawn.view, turn=CAMERA @ drawn.view.turn, is_planar=True),
    )


def draw_solids(axes: Any, drawn: Scene) -> Callable[[int], None]:
    """Draw the solids of a scene at its first instant, and return a function that shows them at another.

    The triangles that face the reader are sorted by the depth of their centres, so bodies that intersect are right to
    the size of a triangle. In axes in space, Matplotlib sorts them.
    """
    colors = importlib.import_module("matplotlib.colors")
    tones = [np.array(colors.to_rgb(solid.color)) for solid in drawn.solids]
    placed = [solid.placed(drawn.positions, drawn.rotations) for solid in drawn.solids]
    right, up, reader = np.eye(3)
    if not drawn.is_planar:
        elevation, azimuth = np.radians(axes.elev), np.radians(axes.azim)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        reader = np.array([np.cos(elevation) * right[1], -np.cos(elevation) * right[0], np.sin(elevation)])
        up = np.cross(reader, right)
    light = LIGHT @ (right, up, reader)

    def triangles(instant: int) -> tuple[Floats, Floats]:
        corners, shades = [], []
        for solid, tone, (places, rotations) in zip(drawn.solids, tones, placed, strict=True):
            rotation, faces = rotations[:, :, instant], solid.mesh.faces
            outwards = (solid.mesh.normals @ rotation.T)[faces].mean(axis=1)
            seen = outwards @ reader > 0.0
            vertices = solid.mesh.vertices @ rotation.T + places[:, instant]
            corners.append(vertices[faces[seen]])
            bright = AMBIENT + DIFFUSE * np.maximum(outwards[seen] @ light, 0.0) + HEMISPHERE * (outwards[seen] @ up)
            shades.append(np.clip(bright[:, np.newaxis] * tone, 0.0, 1.0))
        found, rgb = np.concatenate(corners), np.concatenate(shades)
        order = np.argsort(found.mean(axis=1) @ reader)
        order = order[np.isfinite(found[order]).all(axis=(1, 2))]
        return found[order], rgb[order]

    if drawn.is_planar:
        collection = importlib.import_module("matplotlib.collections").PolyCollection([], linewidth=0.4, zorder=2)
        axes.add_collection(collection, autolim=False)
    else:
        collection = importlib.import_module("mpl_toolkits.mplot3d.art3d").Poly3DCollection([], linewidth=0.4)
        axes.add_collection3d(collection)

    def show(instant: int) -> None:
        corners, rgb = triangles(instant)
        collection.set_verts(corners[:, :, :2] if drawn.is_planar else corners)
        collection.set_facecolor(rgb)
        collection.set_edgecolor(rgb)

    show(0)
    return show


def ground_lines(drawn: Scene) -> Floats:
    """A grid in the plane where wheels touch the ground, under all that is shown in space: ends, shape (n, 2, 3)."""
    heights = drawn.positions[list(drawn.contacts), 2, 0]
    heights = heights[np.isfinite(heights)]
    if not heights.size:
        return np.zeros((0, 2, 3))
    lows, highs = drawn.limits()
    low, high = np.nanmin(lows, axis=1), np.nanmax(highs, axis=1)
    step, z = float((high - low)[:2].max()) / LINES, heights.min()
    x, y = (
        np.arange(np.floor(a / step), np.ceil(b / step) + 1.0) * step for a, b in zip(low[:2], high[:2], strict=True)
    )
    along = [[(at, y[0], z), (at, y[-1], z)] for at in x]
    return np.array(along + [[(x[0], at, z), (x[-1], at, z)] for at in y])
