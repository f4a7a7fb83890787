"""glTF 2.0 in one file of JSON, an animation for Blender, slides and viewers."""

from __future__ import annotations

from typing import IO

from fourbar_codegen.files.formats.glb import require
from fourbar_codegen.interface.extras import imported
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.gltf import gltf_of

__all__ = ["require", "write_trajectory"]


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The animation of a run."""
    gltf = gltf_of(trajectory)
    gltf.convert_buffers(imported("pygltflib", "glTF files", "meshes").BufferFormat.DATAURI)
    file.write(gltf.gltf_to_json().encode("utf-8"))
