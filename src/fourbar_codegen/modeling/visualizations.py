"""Visualizations of other packages -> shapes, points and lines: `pydy.viz`, and symmeplot, with which SymBRiM plots.

Neither is imported: who has such objects has the package.

Sources: the pages of `pydy.viz <https://pydy.readthedocs.io/en/stable/viz/index.html>`_ and of `symmeplot
<https://tjstienstra.github.io/symmeplot/>`_, for what the attributes mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import sympy.physics.mechanics as me

from fourbar_codegen.body_shapes import COLORS, BodyShape, Box, Cone, Cylinder, Disc, Sphere, Torus
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_mapping

__all__ = ["NOTHING", "Placed", "Visualization", "read_visualization"]

THIN = 1e-3
"""Thickness of circles and planes, m."""

MADE_FROM: dict[str, Callable[[Any], BodyShape]] = {
    "Box": lambda shape: Box(shape.width, shape.height, shape.depth),
    "Circle": lambda shape: Disc(shape.radius, THIN),
    "Cone": lambda shape: Cone(shape.radius, shape.length, axis=(0.0, 1.0, 0.0)),
    "Cube": lambda shape: Box(shape.length, shape.length, shape.length),
    "Cylinder": lambda shape: Cylinder(shape.radius, shape.length, axis=(0.0, 1.0, 0.0)),
    "Plane": lambda shape: Box(shape.width, shape.length, THIN),
    "Sphere": lambda shape: Sphere(shape.radius),
    "Torus": lambda shape: Torus(shape.radius, shape.tube_radius),
}
"""Shapes from those of `pydy.viz.shapes`; lengths of cylinders and cones are along y."""


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
        return Visualization({key: _known(value) for key, value in given.items()})
    if hasattr(given, "inertial_frame") and hasattr(given, "plot_objects"):
        return Visualization({}, lines=tuple(_lines(given)))
    frames = getattr(given, "visualization_frames", given)
    if not isinstance(frames, list | tuple) or not all(
        _is_pydy(frame) and hasattr(frame, "origin") for frame in frames
    ):
        raise ModelError(
            "shapes= is a mapping of bodies to shapes, such as {body: Sphere(0.1)}, a list of pydy's visualization "
            f"frames, or a scene of pydy or symmeplot, not {shown(given)}."
        )
    placed = (Placed(frame.reference_frame, frame.origin, _made(frame.shape)) for frame in frames)
    return Visualization({}, tuple(placed))


def _lines(scene: Any) -> Iterator[tuple[me.Point, ...]]:
    """The lines of a plot object and of those in it."""
    for plotted in scene.children:
        line = getattr(plotted, "line", None)
        if isinstance(line, tuple) and len(line) > 1:
            yield line
        yield from _lines(plotted)


def _is_pydy(value: Any) -> bool:
    return any(base.__module__.startswith("pydy.viz") for base in type(value).__mro__)


def _known(value: Any) -> Any:
    """A shape or a sequence of shapes, of which those of pydy are replaced."""
    if isinstance(value, list | tuple):
        return [_made(each) if _is_pydy(each) else each for each in value]
    return _made(value) if _is_pydy(value) else value


def _made(shape: Any) -> BodyShape:
    """A shape from one of pydy."""
    kind = type(shape).__name__
    if kind not in MADE_FROM:
        raise ModelError(
            f"There is no shape like the {kind} of pydy.viz; there are {', '.join(MADE_FROM)}. Others are meshes: "
            'Mesh("part.stl").'
        )
    made = MADE_FROM[kind](shape)
    return type(made)(**{**vars(made), "color": shape.color if shape.color in COLORS else ""})
