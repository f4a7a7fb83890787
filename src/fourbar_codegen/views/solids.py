"""Shapes of bodies -> solids: triangles that move with points and frames of the picture."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen import body_shapes as shapes
from fourbar_codegen.body_shapes import BodyShape, CoordinateFrame, Line, check_names
from fourbar_codegen.body_shapes import Mesh as FileMesh
from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.extras import imported
from fourbar_codegen.interface.paths import path_of
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import ShapeKind
from fourbar_codegen.views import meshes
from fourbar_codegen.views.meshes import Mesh

__all__ = ["Change", "Solid", "solids_of"]

Floats = NDArray[np.float64]

PALETTE = ("#4c78a8", "#e0913a", "#5a9e6f", "#c0504d", "#8b6bb1", "#9c755f", "#3d9aa8", "#c9659a", "#8a9a3c", "#7b8794")
"""Of bodies, in order."""

MOST_VERTICES = 65_536
"""Of a mesh, whose numbers have 16 bits in pages."""

ROUND = "#7a8490"
"""Of wheels."""


@dataclass(frozen=True, eq=False)
class Change:
    """How a solid changes with a parameter, on which its vertices and its place depend linearly.

    Attributes
    ----------
    parameter : str
    value : float
        That with which the solid was made.
    vertices : ndarray, shape (n, 3)
    offset : ndarray, shape (3,)
        Derivatives by the parameter.
    """

    parameter: str
    value: float
    vertices: Floats
    offset: Floats


@dataclass(frozen=True, eq=False)
class Solid:
    """Triangles of one colour that move with the mechanism.

    Attributes
    ----------
    name : str
        Of the body or the link.
    mesh : Mesh
        About the origin and the z axis of the shape.
    color : str
        ``#rrggbb``.
    row : int
        The row of positions where it is, in the scene.
    turn : int or None
        The number of the rotation that it has; None for a rod.
    offset : ndarray, shape (3,)
        From the row to its centre, along the body's axes.
    rotation : ndarray, shape (3, 3)
        Takes components along its own axes to the body's.
    to : int or None
        The row of the other end of a rod, whose z axis goes from `row` to it, and whose centre is halfway.
    length : float
        Of a rod.
    changes : tuple of Change
        Those by parameters that are sizes, for pages in which these change.
    """

    name: str
    mesh: Mesh
    color: str
    row: int
    turn: int | None
    offset: Floats
    rotation: Floats
    to: int | None = None
    length: float = 0.0
    changes: tuple[Change, ...] = ()

    def stretch(self, positions: Floats) -> Floats:
        """How much longer it is along its z axis than its mesh, shape (n_t,); rods between points may change."""
        if self.to is None:
            return np.ones(positions.shape[2])
        lengths = np.linalg.norm(positions[self.to] - positions[self.row], axis=0)
        return np.asarray(lengths / self.length if self.length else np.ones_like(lengths))

    @property
    def corners(self) -> Floats:
        """The corners of the box about it along its own axes, shape (8, 3)."""
        ends = np.array([self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)])
        return np.array([[ends[(k >> j) & 1, j] for j in range(3)] for k in range(8)])

    def placed(self, positions: Floats, rotations: Floats) -> tuple[Floats, Floats]:
        """Its place, shape (3, n_t), and rotation matrix, (3, 3, n_t), for positions and rotations of a scene."""
        at = positions[self.row]
        if self.to is not None:
            way = positions[self.to] - at
            with np.errstate(all="ignore"):
                z = way / np.linalg.norm(way, axis=0)
                # At right angles to the axis that is farthest from the rod's direction.
                x = np.where(np.abs(z[0]) < 0.9, np.cross([1.0, 0.0, 0.0], z.T).T, np.cross([0.0, 1.0, 0.0], z.T).T)
                x /= np.linalg.norm(x, axis=0)
            return at + way / 2.0, np.stack((x, np.cross(z, x, axis=0), z), axis=1)
        assert self.turn is not None
        turn = rotations[self.turn]
        return at + np.einsum("ijt,j->it", turn, self.offset), np.einsum("ijt,jk->ikt", turn, self.rotation)


def solids_of(model: Kernel, found: Mapping[str, Sequence[BodyShape]], p: Floats, positions: Floats) -> Iterator[Solid]:
    """The solids of shapes by the names of bodies and links.

    Parameters
    ----------
    model : Kernel
    found : mapping of str to sequence of BodyShape
    p : ndarray, shape (n_p,)
        Values of parameters that are sizes.
    positions : ndarray, shape (n_points, 3, n_t)
        Of drawn points, m, for the lengths of rods.

    Raises
    ------
    ModelError
        If a shape names a parameter or a point that does not exist.
    """
    drawing, values = model.layout.drawing, dict(zip(model.parameters, p.tolist(), strict=True))
    rows: dict[str, int] = {}
    for row, point in enumerate(drawing.points):
        if point.name:
            rows.setdefault(point.name, row)
    centers = {point.body: row for row, point in enumerate(drawing.points) if point.body}
    ground = next((shape.name for shape in drawing.shapes if shape.kind == ShapeKind.GROUND), "")
    centers.setdefault(ground, 0)  # the fixed point comes first

    check_names(found, values, rows)
    for number, (name, of_body) in enumerate(found.items()):
        for shape in of_body:
            is_round = isinstance(shape, shapes.Wheel | shapes.Torus | shapes.Disc)
            color = shapes.COLORS.get(shape.color, shape.color) or (
                ROUND if is_round else PALETTE[number % len(PALETTE)]
            )
            if isinstance(shape, Line):
                for row, to in itertools.pairwise(rows[point] for point in shape.points):
                    lengths = np.linalg.norm(positions[to] - positions[row], axis=0)
                    known = lengths[np.isfinite(lengths)]
                    length = float(known.mean()) if known.size else 0.0
                    rod = partial(meshes.capsule, length=length)
                    mesh, offset, changes = _placed(shape, rod, values)
                    yield Solid(name, mesh, color, row, None, offset, np.eye(3), to, length, changes)
                continue
            # The last rotation of a scene is that of a particle and of the ground.
            turn = drawing.bodies.index(name) if name in drawing.bodies else len(drawing.bodies)
            at = rows[shape.at] if isinstance(shape.at, str) else centers.get(name)
            if at is None:
                continue  # a body whose position is not known
            make = partial(_of_file, shape.path) if isinstance(shape, FileMesh) else MADE_BY[type(shape)]
            mesh, offset, changes = _placed(shape, make, values)
            parts = [(color, _axes(shape))]
            if isinstance(shape, CoordinateFrame):  # the z axis of an arrow is that axis of the frame
                axes = (np.roll(parts[0][1], 2 - column, axis=1) for column in range(3))
                parts = list(zip(map(shapes.COLORS.__getitem__, ("red", "green", "blue")), axes, strict=True))
            for tone, axes_of_part in parts:
                yield Solid(name, mesh, tone, at, turn, offset, axes_of_part, changes=changes)


def _placed(
    shape: BodyShape, make: Callable[..., Mesh], values: Mapping[str, float]
) -> tuple[Mesh, Floats, tuple[Change, ...]]:
    """The triangles of a shape, its offset in the body, and the changes of both by parameters."""

    def made(values: Mapping[str, float]) -> tuple[Mesh, Floats]:
        sizes = [_length(getattr(shape, name), values) for name in shape.sizes]
        for name, size in zip(shape.sizes, sizes, strict=True):
            if not size > 0.0:
                raise ModelError(f"The size {getattr(shape, name)} of a shape is {size:g}: it must be positive.")
        at = (0.0, 0.0, 0.0) if isinstance(shape.at, str) else shape.at
        return make(*sizes), np.array([_length(part, values) for part in at])

    mesh, offset = made(values)
    places = () if isinstance(shape.at, str) else shape.at
    given = (*(getattr(shape, size) for size in shape.sizes), *places)
    changes = []
    for name in dict.fromkeys(size for size in given if isinstance(size, str)):
        step = 1e-3 * values[name] or 1.0
        other, moved = made({**values, name: values[name] + step})
        vertices = (other.vertices - mesh.vertices) / step
        changes.append(Change(name, values[name], vertices, (moved - offset) / step))
    return mesh, offset, tuple(changes)


def _length(value: float | str, values: Mapping[str, float]) -> float:
    return values[value] if isinstance(value, str) else value


MADE_BY: dict[type[BodyShape], Callable[..., Mesh]] = {
    shapes.Sphere: meshes.sphere,
    shapes.Ellipsoid: meshes.ellipsoid,
    shapes.Box: meshes.box,
    shapes.Cylinder: meshes.cylinder,
    shapes.Capsule: meshes.capsule,
    shapes.Cone: meshes.cone,
    shapes.Disc: meshes.disc,
    shapes.Wheel: meshes.wheel,
    shapes.Torus: meshes.torus,
    shapes.Plane: meshes.plane,
    shapes.Arrow: meshes.arrow,
    shapes.CoordinateFrame: meshes.arrow,
}
"""What makes the triangles of a shape of its sizes."""


def _of_file(path: str, scale: float) -> Mesh:
    """The triangles of a file."""
    trimesh = imported("trimesh", "Meshes of files", "meshes")
    try:
        loaded = trimesh.load_mesh(path_of(path))
        loaded = getattr(loaded, "smooth_shaded", loaded)  # with sharp edges where faces meet at large angles
    except Exception as error:  # which one depends on the kind of the file
        raise ModelError(f"The mesh {path} cannot be read: {error}.") from error
    faces = np.array(getattr(loaded, "faces", ()), dtype=np.int64)
    if not faces.size:
        raise ModelError(f"The mesh {path} has no triangles.")
    if len(loaded.vertices) > MOST_VERTICES:
        raise ModelError(
            f"The mesh {path} has {len(loaded.vertices)} vertices, more than {MOST_VERTICES}: simplify it."
        )
    return Mesh(np.array(loaded.vertices) * scale, np.array(loaded.vertex_normals), faces)


def _axes(shape: BodyShape) -> Floats:
    """The rotation matrix that takes a shape's axes to the body's."""
    z = np.array(shape.axis) / np.linalg.norm(shape.axis)
    if shape.x_axis is None and z[2] == 1.0:
        return np.eye(3)
    least = np.eye(3)[np.abs(z).argmin()] if shape.x_axis is None else np.array(shape.x_axis)
    x = least - (least @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))
