"""GLB: glTF 2.0 in one binary file, an animation for Blender, slides and viewers."""

from __future__ import annotations

from typing import IO

from fourbar_codegen.interface.extras import imported
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.views.gltf import gltf_of

__all__ = ["require", "write_trajectory"]


def require() -> None:
    """Raise a ModelError if pygltflib is missing."""
    imported("pygltflib", "glTF files", "meshes")


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The animation of a run."""
    file.write(b"".join(gltf_of(trajectory).save_to_bytes()))
