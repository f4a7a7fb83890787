"""Triangles of simple shapes, about their centres and the z axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Mesh", "arrow", "box", "capsule", "cone", "cylinder", "disc", "ellipsoid", "joined", "moved", "plane", "sphere",
    "torus", "wheel",
]  # fmt: skip

Floats = NDArray[np.float64]
Profile = Sequence[tuple[float, float]]

AROUND = 64
"""Segments of the circle of a wheel: its polygon is within 0.12 % of the radius."""
FEW = 32
"""Segments of round bodies, of which nothing rolls on its edge."""
SLIM = 20
"""Segments of rods, of which there are many."""
ARC = 6
"""Segments of a quarter of a circle along a profile."""
SPOKES = 16


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles.

    Attributes
    ----------
    vertices, normals : ndarray, shape (n, 3)
        Normals of length one point outwards.
    faces : ndarray, shape (m, 3)
        Numbers of vertices, counterclockwise as seen from outside.
    """

    vertices: Floats
    normals: Floats
    faces: NDArray[np.int64]


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
    )


def moved(mesh: Mesh, rotation: Floats, shift: Floats) -> Mesh:
    """A mesh that is turned and then moved."""
    return Mesh(mesh.vertices @ rotation.T + shift, mesh.normals @ rotation.T, mesh.faces)


def box(x: float, y: float, z: float) -> Mesh:
    """A box with these lengths of its edges."""
    vertices, normals, faces = list[Floats](), list[Floats](), list[tuple[int, int, int]]()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.zeros(3)
            normal[axis] = sign
            a, b = np.roll(np.eye(3)[0], axis + 1), np.roll(np.eye(3)[0], axis + 2)
            start = len(vertices)
            for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                vertices.append((normal + u * sign * a + v * b) * (x / 2, y / 2, z / 2))
                normals.append(normal)
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    return Mesh(np.array(vertices), np.array(normals), np.array(faces))


def _turned(profiles: Sequence[Profile], around: int = FEW) -> Mesh:
    """The surface of revolution of profiles (r, z) about the z axis, upwards if it bulges outwards.

    The edges between profiles are sharp.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, around + 1)
    meshes = []
    for profile in profiles:
        points = np.array(profile, dtype=float)
        along = np.gradient(points, axis=0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        r, z = points.T
        out, up = along[:, 1], -along[:, 0]
        x, y = np.cos(angle), np.sin(angle)
        n, m = len(points), len(angle)
        vertices = np.stack((np.outer(x, r), np.outer(y, r), np.broadcast_to(z, (m, n))), axis=2)
        normals = np.stack((np.outer(x, out), np.outer(y, out), np.broadcast_to(up, (m, n))), axis=2)
        i, j = (part.ravel() for part in np.meshgrid(np.arange(m - 1), np.arange(n - 1), indexing="ij"))
        a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1
        faces = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
        corners = vertices.reshape(-1, 3)[faces]
        has_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0.0
        meshes.append(Mesh(vertices.reshape(-1, 3), normals.reshape(-1, 3), faces[has_area]))
    return joined(meshes)


def _arc(radius: float, start: float, end: float, r: float = 0.0, z: float = 0.0) -> list[tuple[float, float]]:
    """A profile along a circle about (r, z), between two angles from the plane, rad."""
    steps = max(1, round(abs(end - start) / (np.pi / 2.0) * ARC))
    angles = np.linspace(start, end, steps + 1)
    return [(max(r + radius * np.cos(a), 0.0), z + radius * np.sin(a)) for a in angles]


def sphere(radius: float) -> Mesh:
    """A sphere."""
    return _turned([_arc(radius, -np.pi / 2.0, np.pi / 2.0)])


def ellipsoid(x: float, y: float, z: float) -> Mesh:
    """An ellipsoid with these half axes."""
    ball, axes = sphere(1.0), np.array([x, y, z])
    normals = ball.normals / np.maximum(axes, np.finfo(float).tiny)
    return Mesh(ball.vertices * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True), ball.faces)


def plane(length: float) -> Mesh:
    """A square that is so thin that it looks like a plane."""
    return box(length, length, 1e-3 * length)


def cylinder(radius: float, length: float) -> Mesh:
    """A cylinder."""
    h = length / 2.0
    return _turned([[(0.0, -h), (radius, -h)], [(radius, -h), (radius, h)], [(radius, h), (0.0, h)]])


def capsule(radius: float, length: float) -> Mesh:
    """A cylinder of a length with half spheres at its ends."""
    h = length / 2.0
    below, above = _arc(radius, -np.pi / 2.0, 0.0, 0.0, -h), _arc(radius, 0.0, np.pi / 2.0, 0.0, h)
    return _turned([[*below[::2], *above[::2]]], SLIM)


def arrow(length: float) -> Mesh:
    """An arrow from the origin along the z axis."""
    head, radius = 0.25 * length, 0.025 * length
    shaft = moved(cylinder(radius, length - head), np.eye(3), np.array([0.0, 0.0, (length - head) / 2.0]))
    return joined([shaft, moved(cone(3.0 * radius, head), np.eye(3), np.array([0.0, 0.0, length - head / 2.0]))])


def cone(radius: float, length: float) -> Mesh:
    """A cone with its tip at the upper end."""
    h = length / 2.0
    return _turned([[(0.0, -h), (radius, -h)], [(radius, -h), (0.0, h)]])


def disc(radius: float, thickness: float) -> Mesh:
    """A disc with a sharp edge, which is a circle, so that it rolls as a knife edge does."""
    h, flat = thickness / 2.0, 0.9 * radius
    return _turned([[(0.0, -h), (flat, -h)], [(flat, -h), (radius, 0.0)], [(radius, 0.0), (flat, h)],
                    [(flat, h), (0.0, h)]], AROUND)  # fmt: skip


def torus(radius: float, tube_radius: float) -> Mesh:
    """A torus; `radius` is that of the circle in its tube."""
    return _turned([_arc(tube_radius, -np.pi, np.pi, radius)], AROUND)


def wheel(radius: float) -> Mesh:
    """A rim with a sharp edge, a hub and spokes, so that it can be seen how it turns."""
    rim = 0.045 * radius
    h, inner = 0.4 * rim, radius - 2.0 * rim
    edge: list[Profile] = [
        [(inner, -h), (radius - rim, -h)],
        [(radius - rim, -h), (radius, 0.0)],
        [(radius, 0.0), (radius - rim, h)],
        [(radius - rim, h), (inner, h)],
        [(inner, h), (inner, -h)],
    ]
    hub = cylinder(0.08 * radius, 0.2 * radius)
    spoke = box(0.012 * radius, 0.012 * radius, inner)
    shift = np.array([inner / 2.0, 0.0, 0.0])
    spokes = []
    for k in range(SPOKES):
        c, s = np.cos(2.0 * np.pi * k / SPOKES), np.sin(2.0 * np.pi * k / SPOKES)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        lying = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        spokes.append(moved(spoke, turn @ lying, turn @ shift))
    return joined([_turned(edge, AROUND), hub, *spokes])
