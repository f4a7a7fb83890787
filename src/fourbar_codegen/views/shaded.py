"""Bodies in Matplotlib's axes: shaded triangles and lines with a depth buffer, and the ground."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.views.scene import Scene

__all__ = ["CAMERA", "Stroke", "draw_solids", "draw_solids_in_space", "ground", "seen_obliquely"]

Floats = NDArray[np.float64]

HOME = (-0.6, -1.15)
"""Turn about the vertical, and tilt of the vertical away from the reader, rad, as in solid_pictures.js."""

LIGHT = np.array([0.30, 0.60, 0.74])
"""To the right, upwards, to the reader; as in solid_pictures.js."""

AMBIENT, DIFFUSE, HEMISPHERE = 0.42, 0.5, 0.13
LINES = 8
"""About the number of lines of the ground's grid along the longer side."""

PIXELS = 960
"""Of the longer side of an image; Matplotlib reduces it, which smooths edges."""

PIECE = 24.0
"""Longest piece of a line, in pixels."""

TILE = 4
"""Least side of the squares of pixels, which double, in which triangles are filled."""


def _camera() -> Floats:
    """From above the side: the rotation to coordinates to the right, upwards, and to the reader."""
    (c, s), (ct, st) = ((np.cos(angle), np.sin(angle)) for angle in HOME)
    return np.array([[c, -s, 0.0], [s * ct, c * ct, -st], [s * st, c * st, ct]])


CAMERA = _camera()


def seen_obliquely(drawn: Scene) -> Scene:
    """A scene in space as it is seen from above the side, in a plane whose third coordinate is the depth."""
    return replace(_along(drawn, CAMERA), view=replace(drawn.view, turn=CAMERA @ drawn.view.turn, is_planar=True))


def _along(drawn: Scene, axes: Floats) -> Scene:
    """A scene in coordinates along other axes, the rows of a matrix."""
    return replace(
        drawn,
        positions=np.einsum("ij,njt->nit", axes, drawn.positions),
        rotations=np.einsum("ij,bjkt->bikt", axes, drawn.rotations),
    )


@dataclass(frozen=True, eq=False)
class Stroke:
    """A line among bodies.

    Attributes
    ----------
    points : ndarray, shape (3, n)
        To the right, upwards, to the reader; not a number where the line is interrupted.
    color : str
    width : float
        In points of the figure.
    """

    points: Floats
    color: str
    width: float


def ground(drawn: Scene) -> list[Stroke]:
    """A grid in the plane where wheels touch the ground, under all that is shown, of a scene in space."""
    axes = drawn.ground_axes
    heights = drawn.positions[list(drawn.contacts), :, 0] @ axes[2]
    heights = heights[np.isfinite(heights)]
    if not heights.size:
        return []
    lows, highs = _along(drawn, axes).limits()
    low, high = np.fmin.reduce(lows, axis=1), np.fmax.reduce(highs, axis=1)
    step, z = float((high - low)[:2].max()) / LINES, heights.min()
    x, y = (np.arange(np.floor(low[k] / step), np.ceil(high[k] / step) + 1.0) * step for k in range(2))
    lines = [[(at, y[0], z), (at, y[-1], z)] for at in x] + [[(x[0], at, z), (x[-1], at, z)] for at in y]
    return [Stroke(CAMERA @ axes.T @ np.transpose(ends), "0.85", 0.8) for ends in lines]


def _faces(drawn: Scene, reader: Floats, up: Floats, light: Floats) -> Callable[[int], tuple[Floats, Floats]]:
    """The triangles that face the reader, shape (n, 3, 3), and their colours, (n, 3), at an instant."""
    colors = importlib.import_module("matplotlib.colors")
    tones = [np.array(colors.to_rgb(solid.color)) for solid in drawn.solids]
    placed = [solid.placed(drawn.positions, drawn.rotations) for solid in drawn.solids]
    stretched = [solid.stretch(drawn.positions) for solid in drawn.solids]

    def triangles(instant: int) -> tuple[Floats, Floats]:
        corners, shades = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
        for solid, tone, (places, rotations), longer in zip(drawn.solids, tones, placed, stretched, strict=True):
            rotation, faces = rotations[:, :, instant], solid.mesh.faces
            outwards = (solid.mesh.normals @ rotation.T)[faces].mean(axis=1)
            seen = outwards @ reader > 0.0
            vertices = solid.mesh.vertices * (1.0, 1.0, longer[instant]) @ rotation.T + places[:, instant]
            corners.append(vertices[faces[seen]])
            bright = AMBIENT + DIFFUSE * np.maximum(outwards[seen] @ light, 0.0) + HEMISPHERE * (outwards[seen] @ up)
            shades.append(np.clip(bright[:, np.newaxis] * tone, 0.0, 1.0))
        found, rgb = np.concatenate(corners), np.concatenate(shades)
        known = np.isfinite(found).all(axis=(1, 2))
        return found[known], rgb[known]

    return triangles


def draw_solids(
    axes: Any, drawn: Scene, strokes: Callable[[int], Sequence[Stroke]]
) -> Callable[[int, Floats, Floats], None]:
    """Draw bodies and lines of a scene that is seen obliquely, as an image: what is nearer hides the rest.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    drawn : Scene
    strokes : callable
        The lines at an instant.

    Returns
    -------
    callable
        Shows an instant, in a window of the coordinates: its middle and half of its sizes, shape (2,) each.
    """
    colors = importlib.import_module("matplotlib.colors")
    _, up, reader = np.eye(3)
    triangles = _faces(drawn, reader, up, LIGHT)
    image = axes.imshow(np.zeros((1, 1, 4)), origin="lower", zorder=1, interpolation="antialiased", aspect="equal")

    def show(instant: int, middle: Floats, half: Floats) -> None:
        scale = PIXELS / (2.0 * half.max())
        size = np.maximum(1, np.round(2.0 * half * scale)).astype(int)
        corners, rgb = triangles(instant)
        per_point = PIXELS / (72.0 * float(max(axes.figure.get_size_inches())))
        pixels, tones = [corners * scale], [rgb]
        for stroke in strokes(instant):
            pixels.append(_quads(stroke.points * scale, 0.5 * stroke.width * per_point))
            tones.append(np.repeat([colors.to_rgb(stroke.color)], len(pixels[-1]), axis=0))
        in_window = np.concatenate(pixels)
        in_window[:, :, :2] -= (middle - half) * scale
        image.set_data(_filled(in_window, np.concatenate(tones), size[0], size[1]))
        low, high = middle - half, middle + half
        image.set_extent((low[0], high[0], low[1], high[1]))

    return show


def _quads(points: Floats, half: float) -> Floats:
    """Triangles of a line of a width, all in pixels, shape (n, 3, 3)."""
    a, b = points[:, :-1].T, points[:, 1:].T
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    a, b = a[known], b[known]
    # In short pieces, which lie in small squares of pixels.
    counts = np.maximum(1, np.ceil(np.linalg.norm((b - a)[:, :2], axis=1) / PIECE)).astype(int)
    which = np.repeat(np.arange(len(a)), counts)
    part = (np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[which]
    start, way = a[which], (b - a)[which]
    a = start + part[:, np.newaxis] * way
    b = a + way / counts[which][:, np.newaxis]
    along = (b - a)[:, :2]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    across = np.zeros_like(a)
    across[:, :2] = half * np.stack((-along[:, 1], along[:, 0]), axis=1) / np.maximum(length, np.finfo(float).tiny)
    first, second = np.stack((a - across, a + across, b + across), 1), np.stack((a - across, b + across, b - across), 1)
    return np.concatenate((first, second))


def _filled(corners: Floats, rgb: Floats, width: int, height: int) -> Floats:
    """An image, shape (height, width, 4), of triangles in pixels, with a depth buffer.

    Triangles are filled in squares of pixels that contain them, all triangles with squares of the same size at once. A
    pixel is inside where it is on the same side of all edges, and its depth follows from barycentric coordinates.

    Source: J. Pineda, "A parallel algorithm for polygon rasterization", *SIGGRAPH Computer Graphics* 22 (1988).
    """
    image = np.zeros((height * width, 4))
    if not len(corners):
        return image.reshape(height, width, 4)
    low, high = corners[:, :, :2].min(axis=1), corners[:, :, :2].max(axis=1)
    inside = (high >= 0.0).all(axis=1) & (low <= (width, height)).all(axis=1)
    corners, rgb, low, high = corners[inside], rgb[inside], low[inside], high[inside]
    # Squares begin at a whole pixel; of triangles at the edge only what is in the image counts.
    start = np.clip(np.floor(low), 0, (width, height)).astype(int)
    end = np.clip(np.ceil(high), 0, (width, height)).astype(int)
    sides = np.maximum(end - start + 1, 1).max(axis=1, initial=1)
    classes = np.maximum(np.ceil(np.log2(sides / TILE)), 0).astype(int)
    pixels, depths, owners = [], [], []
    for size in np.unique(classes):
        [chosen] = np.nonzero(classes == size)
        steps = np.arange(TILE * 2**size)
        for part in np.array_split(chosen, max(1, len(chosen) * len(steps) ** 2 // 4_000_000)):
            x = start[part, 0][:, np.newaxis, np.newaxis] + steps
            y = start[part, 1][:, np.newaxis, np.newaxis] + steps[:, np.newaxis]
            a, b, c = (corners[part, k][:, :, np.newaxis, np.newaxis] for k in range(3))
            area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
            px, py = x + 0.5, y + 0.5
            with np.errstate(all="ignore"):
                v = ((px - a[:, 0]) * (c[:, 1] - a[:, 1]) - (py - a[:, 1]) * (c[:, 0] - a[:, 0])) / area
                w = ((b[:, 0] - a[:, 0]) * (py - a[:, 1]) - (b[:, 1] - a[:, 1]) * (px - a[:, 0])) / area
                hit = (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0) & (x < width) & (y < height)
            which, row, column = np.nonzero(hit)
            z = a[which, 2, 0, 0] + v[hit] * (b - a)[which, 2, 0, 0] + w[hit] * (c - a)[which, 2, 0, 0]
            pixels.append((start[part[which], 1] + row) * width + start[part[which], 0] + column)
            depths.append(z)
            owners.append(part[which])
    if pixels:
        order = np.argsort(np.concatenate(depths), kind="stable")  # the nearest one is written last
        where, which = np.concatenate(pixels)[order], np.concatenate(owners)[order]
        image[where, :3], image[where, 3] = rgb[which], 1.0
    return image.reshape(height, width, 4)


def draw_solids_in_space(axes: Any, drawn: Scene) -> Callable[[int], None]:
    """Draw the solids of a scene in Matplotlib's axes in space, which sort triangles by the depth of their centres.

    Returns
    -------
    callable
        Shows an instant.
    """
    elevation, azimuth = np.radians(axes.elev), np.radians(axes.azim)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    reader = np.array([np.cos(elevation) * right[1], -np.cos(elevation) * right[0], np.sin(elevation)])
    up = np.cross(reader, right)
    triangles = _faces(drawn, reader, up, LIGHT @ (right, up, reader))
    collection = importlib.import_module("mpl_toolkits.mplot3d.art3d").Poly3DCollection([], linewidth=0.4)
    axes.add_collection3d(collection)

    def show(instant: int) -> None:
        corners, rgb = triangles(instant)
        collection.set_verts(corners)
        collection.set_facecolor(rgb)
        collection.set_edgecolor(rgb)

    show(0)
    return show
