"""Visualizations of other packages -> shapes, points and lines: `pydy.viz`, and symmeplot, with which SymBRiM plots.

Neither is imported: who has such objects has the package.

Sources: the pages of `pydy.viz <https://pydy.readthedocs.io/en/stable/viz/index.html>`_ and of `symmeplot
<https://tjstienstra.github.io/symmeplot/>`_, for what the attributes mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import sympy.physics.mechanics as me

from fourbar_codegen.body_shapes import BodyShape, is_of_pydy, made_from
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_mapping

__all__ = ["NOTHING", "Placed", "Visualization", "read_visualization"]


@dataclass(frozen=True)
class Placed:
    """A shape in a frame, at a point.

    Attributes
    ----------
    frame : ReferenceFrame
    point : Point
    shape : BodyShape
    """

    frame: me.ReferenceFrame
    point: me.Point
    shape: BodyShape


@dataclass(frozen=True)
class Visualization:
    """What ``shapes=`` of a Model says.

    Attributes
    ----------
    shapes : mapping
        Bodies, frames or names with their shapes.
    placed : tuple of Placed
        Visualization frames.
    lines : tuple of tuple of Point
    """

    shapes: Mapping[Any, Any]
    placed: tuple[Placed, ...] = ()
    lines: tuple[tuple[me.Point, ...], ...] = ()

    @property
    def frames(self) -> tuple[me.ReferenceFrame, ...]:
        """The frames that have shapes."""
        keys = (key for key in self.shapes if isinstance(key, me.ReferenceFrame))
        return (*(placed.frame for placed in self.placed), *keys)


NOTHING = Visualization({})


def read_visualization(given: Any) -> Visualization:
    """Read the shapes of a Model.

    Parameters
    ----------
    given : mapping, sequence of VisualizationFrame, pydy.viz.Scene, symmeplot scene, or None
        Of a scene of symmeplot, such as ``Plotter.from_model(bicycle)`` of SymBRiM, the lines.

    Returns
    -------
    Visualization

    Raises
    ------
    ModelError
        If it is none of these, or there is no such shape.
    """
    if given is None:
        return NOTHING
    if is_mapping(given):
        return Visualization(given)
    if hasattr(given, "inertial_frame") and hasattr(given, "plot_objects"):
        return Visualization({}, lines=tuple(_lines(given)))
    frames = getattr(given, "visualization_frames", given)
    if not isinstance(frames, list | tuple) or not all(
        is_of_pydy(frame) and hasattr(frame, "origin") for frame in frames
    ):
        raise ModelError(
            "shapes= is a mapping of bodies to shapes, such as {body: Sphere(0.1)}, a list of pydy's visualization "
            f"frames, or a scene of pydy or symmeplot, not {shown(given)}."
        )
    placed = (Placed(frame.reference_frame, frame.origin, made_from(frame.shape)) for frame in frames)
    return Visualization({}, tuple(placed))


def _lines(scene: Any) -> Iterator[tuple[me.Point, ...]]:
    """The lines of a plot object and of those in it."""
    for plotted in scene.children:
        line = getattr(plotted, "line", None)
        if isinstance(line, tuple) and len(line) > 1:
            yield line
        yield from _lines(plotted)
