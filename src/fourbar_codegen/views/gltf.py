"""Trajectory -> glTF 2.0: bodies and points as nodes with an animation, for Blender, slides and viewers.

Source: Khronos Group, *glTF 2.0 Specification*, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.extras import imported
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.frames import equal_times, frames_of
from fourbar_codegen.views.html_page import quaternions
from fourbar_codegen.views.meshes import Mesh

__all__ = ["gltf_of"]

Floats = NDArray[np.float64]

RATE = 60.0
"""Keyframes per second; viewers interpolate between them."""

STRETCHED = 1e-6
"""Least change of a rod's length that is animated, relative to it: rods between joints have rounding errors."""

Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From coordinates whose z axis points upwards to those of glTF."""


class _Buffer:
    """The numbers of a file, and the accessors that say where they are."""

    def __init__(self, library: Any, gltf: Any) -> None:
        self.library, self.gltf, self.data = library, gltf, bytearray()

    def add(self, values: NDArray[Any], kind: str, target: int | None = None, *, has_range: bool = False) -> int:
        """Add an array of scalars or vectors; returns the number of its accessor."""
        codes = {"<f4": self.library.FLOAT, "<u4": self.library.UNSIGNED_INT}
        self.data += b"\0" * (-len(self.data) % 4)
        view = self.library.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target)
        self.gltf.bufferViews.append(view)
        accessor = self.library.Accessor(
            bufferView=len(self.gltf.bufferViews) - 1,
            componentType=codes[values.dtype.str],
            count=len(values),
            type=kind,
        )
        if has_range:
            rows = values.reshape(len(values), -1)
            accessor.min, accessor.max = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.gltf.accessors.append(accessor)
        self.data += values.tobytes()
        return len(self.gltf.accessors) - 1


def gltf_of(trajectory: Trajectory) -> Any:
    """The run as a ``pygltflib.GLTF2``: a node for each point and each shape, which move with the bodies.

    Coordinates of nodes are those of the inertial frame, m; their parent turns the vertical upwards.

    Raises
    ------
    ModelError
        If there is nothing to draw, or pygltflib is not installed.
    """
    library = imported("pygltflib", "glTF files", "meshes")
    drawn = frames_of(trajectory, lambda start, end: equal_times(start, end, RATE), in_space=True)
    scene, times = drawn.scene, drawn.shown.t
    if len(times) > 1 and times[-1] < times[0]:
        raise ModelError("glTF has no animations backwards in time: save a run from an earlier to a later time.")
    gltf = library.GLTF2(asset=library.Asset(version="2.0", generator="fourbar_codegen"))
    buffer, back = _Buffer(library, gltf), scene.view.turn.T
    keys = buffer.add((times - times[0]).astype("<f4"), library.SCALAR, has_range=True)
    animation = library.Animation(name=trajectory.kernel.name)

    def animate(node: int, path: str, values: Floats, kind: str) -> None:
        sampler = library.AnimationSampler(input=keys, output=buffer.add(values.astype("<f4"), kind))
        animation.samplers.append(sampler)
        target = library.AnimationChannelTarget(node=node, path=path)
        animation.channels.append(library.AnimationChannel(sampler=len(animation.samplers) - 1, target=target))

    def node_of(name: str, places: Floats, **more: Any) -> int:
        """A node that is moved, for places of shape (3, n_t)."""
        path = _held(places.T)
        gltf.nodes.append(library.Node(name=name, translation=path[0].tolist(), **more))
        if np.ptp(path, axis=0).any():
            animate(len(gltf.nodes) - 1, "translation", path, library.VEC3)
        return len(gltf.nodes) - 1

    whole = quaternions((Y_UP @ scene.view.turn)[np.newaxis, :, :, np.newaxis])[0, 0]
    gltf.nodes.append(library.Node(name=trajectory.kernel.name, rotation=whole.tolist(), children=[]))
    for name, row in zip(scene.names, scene.positions, strict=False):
        gltf.nodes[0].children.append(node_of(name, back @ row))
    for solid in scene.solids:
        places, rotations = solid.placed(scene.positions, scene.rotations)
        turns = _continuous(quaternions(np.einsum("ij,jkt->ikt", back, rotations)[np.newaxis])[:, 0])
        _add_mesh(library, gltf, buffer, solid.mesh, solid.color)
        node = node_of(solid.name, back @ places, mesh=len(gltf.meshes) - 1, rotation=turns[0].tolist())
        if np.ptp(turns, axis=0).any():
            animate(node, "rotation", turns, library.VEC4)
        scales = np.ones((len(times), 3))
        scales[:, 2] = _held(solid.stretch(scene.positions)[:, np.newaxis])[:, 0]
        if np.abs(scales - 1.0).max() > STRETCHED:
            gltf.nodes[node].scale = scales[0].tolist()
            animate(node, "scale", scales, library.VEC3)
        gltf.nodes[0].children.append(node)
    if animation.channels:
        gltf.animations.append(animation)
    gltf.scenes.append(library.Scene(nodes=[0]))
    gltf.scene = 0
    gltf.buffers.append(library.Buffer(byteLength=len(buffer.data)))
    gltf.set_binary_blob(bytes(buffer.data))
    return gltf


def _add_mesh(library: Any, gltf: Any, buffer: _Buffer, mesh: Mesh, color: str) -> None:
    """Add a mesh of one colour."""
    position = buffer.add(mesh.vertices.astype("<f4"), library.VEC3, library.ARRAY_BUFFER, has_range=True)
    normal = buffer.add(mesh.normals.astype("<f4"), library.VEC3, library.ARRAY_BUFFER)
    indices = buffer.add(mesh.faces.ravel().astype("<u4"), library.SCALAR, library.ELEMENT_ARRAY_BUFFER)
    # Colours of glTF are linear: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#metallic-roughness-material
    parts = np.array([int(color[at : at + 2], 16) / 255.0 for at in (1, 3, 5)])
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    roughness = library.PbrMetallicRoughness(
        baseColorFactor=[*linear.tolist(), 1.0], metallicFactor=0.1, roughnessFactor=0.7
    )
    gltf.materials.append(library.Material(pbrMetallicRoughness=roughness))
    primitive = library.Primitive(
        attributes=library.Attributes(POSITION=position, NORMAL=normal),
        indices=indices,
        material=len(gltf.materials) - 1,
    )
    gltf.meshes.append(library.Mesh(primitives=[primitive]))


def _held(path: Floats) -> Floats:
    """A path, shape (n_t, 3), that stays where it was last known while it is not."""
    known = np.isfinite(path).all(axis=1)
    if not known.any():
        return np.zeros_like(path)
    last = np.maximum.accumulate(np.where(known, np.arange(len(path)), known.argmax()))
    return path[last]


def _continuous(turns: Floats) -> Floats:
    """Quaternions without changes of sign, shape (n_t, 4)."""
    turns = _held(turns)
    turns[~turns.any(axis=1)] = (0.0, 0.0, 0.0, 1.0)
    signs = np.sign((turns[1:] * turns[:-1]).sum(axis=1))
    turns[1:] *= np.cumprod(np.where(signs == 0.0, 1.0, signs))[:, np.newaxis]
    return turns
