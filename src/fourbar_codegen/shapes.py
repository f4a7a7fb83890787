"""Shapes of bodies in pictures: spheres, boxes, wheels and others, as plain data.

Sizes are numbers, m, or names of parameters, so that they follow a run's. Axes are those of the body, and places are
from its mass centre.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import name_of, number

__all__ = [
    "KINDS",
    "Arrow",
    "BodyShape",
    "Box",
    "Capsule",
    "Cone",
    "CoordinateFrame",
    "Cylinder",
    "Disc",
    "Ellipsoid",
    "Line",
    "Mesh",
    "Plane",
    "Sphere",
    "Torus",
    "Wheel",
]

Size = float | str
"""A number or the name of a parameter."""

Place = tuple[Size, Size, Size] | str
"""Coordinates from the mass centre along the body's axes, or the name of a point."""

COLORS = ("black", "white", "grey", "red", "green", "blue", "orange", "yellow", "purple", "brown", "cyan", "pink")
"""Names of colours, besides ``#rrggbb``."""


@dataclass(frozen=True, kw_only=True)
class BodyShape:
    """What all shapes have.

    Attributes
    ----------
    at : tuple of three sizes, or str
        The place of its centre from the body's mass centre, along the body's axes, m; or the name of a point.
    axis : tuple of three numbers
        The direction of its own axis, along the body's axes; of shapes without an axis of their own, that of their z.
    x_axis : tuple of three numbers, optional
        That of their x, as far as it is at right angles to the axis.
    color : str
        ``"#rrggbb"``, or one of black, white, grey, red, green, blue, orange, yellow, purple, brown, cyan, pink. By
        default bodies have different colours.
    """

    sizes: ClassVar[tuple[str, ...]] = ()

    at: Place = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    x_axis: tuple[float, float, float] | None = None
    color: str = ""

    def __post_init__(self) -> None:
        for name in self.sizes:
            object.__setattr__(self, name, _size(getattr(self, name), f"{name} of a {type(self).__name__}"))
        what = f"at of a {type(self).__name__}"
        object.__setattr__(self, "at", _place(self.at, what))
        object.__setattr__(self, "axis", _direction(self.axis, f"axis of a {type(self).__name__}"))
        if self.x_axis is not None:
            object.__setattr__(self, "x_axis", _direction(self.x_axis, f"x_axis of a {type(self).__name__}"))
        is_hex = isinstance(self.color, str) and len(self.color) == 7 and self.color[0] == "#"
        if self.color and not (self.color in COLORS or (is_hex and _is_hexadecimal(self.color[1:]))):
            raise ModelError(f"A colour is #rrggbb or one of {', '.join(COLORS)}, not {shown(self.color)}.")

    def to_json(self) -> dict[str, Any]:
        """The shape as data that JSON can hold."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {"kind": type(self).__name__} | {k: [*v] if isinstance(v, tuple) else v for k, v in values.items()}

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> BodyShape:
        """The shape of data that `to_json` has made.

        Raises
        ------
        ModelError
            If there is no such shape.
        """
        kind = KINDS.get(data["kind"])
        if kind is None:
            raise ModelError(f"There is no shape {data['kind']!r}; there are {', '.join(KINDS)}.")
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items() if k != "kind"}
        return kind(**values)


@dataclass(frozen=True)
class Sphere(BodyShape):
    """A sphere.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.Sphere(0.1, color="red").radius
    0.1
    """

    sizes = ("radius",)
    radius: Size


@dataclass(frozen=True)
class Ellipsoid(BodyShape):
    """An ellipsoid with its half axes along the body's."""

    sizes = ("x", "y", "z")
    x: Size
    y: Size
    z: Size


@dataclass(frozen=True)
class Box(BodyShape):
    """A box with the lengths of its edges along the body's axes."""

    sizes = ("x", "y", "z")
    x: Size
    y: Size
    z: Size


@dataclass(frozen=True)
class Cylinder(BodyShape):
    """A cylinder about its axis."""

    sizes = ("radius", "length")
    radius: Size
    length: Size


@dataclass(frozen=True)
class Capsule(BodyShape):
    """A rod with round ends; `length` is that between their centres."""

    sizes = ("radius", "length")
    radius: Size
    length: Size


@dataclass(frozen=True)
class Cone(BodyShape):
    """A cone with its tip in the direction of its axis; `at` is halfway up."""

    sizes = ("radius", "length")
    radius: Size
    length: Size


@dataclass(frozen=True)
class Disc(BodyShape):
    """A disc with a sharp edge, on which it rolls."""

    sizes = ("radius", "thickness")
    radius: Size
    thickness: Size


@dataclass(frozen=True)
class Wheel(BodyShape):
    """A wheel with spokes and a sharp rim, on whose edge it rolls."""

    sizes = ("radius",)
    radius: Size


@dataclass(frozen=True)
class Torus(BodyShape):
    """A torus, such as a tyre; `radius` is that of the circle in its tube."""

    sizes = ("radius", "tube_radius")
    radius: Size
    tube_radius: Size


@dataclass(frozen=True)
class Plane(BodyShape):
    """A thin square at right angles to its axis."""

    sizes = ("length",)
    length: Size


@dataclass(frozen=True)
class Arrow(BodyShape):
    """An arrow from `at` in the direction of its axis."""

    sizes = ("length",)
    length: Size


@dataclass(frozen=True)
class CoordinateFrame(BodyShape):
    """The axes of the body: x red, y green, z blue."""

    sizes = ("length",)
    length: Size


@dataclass(frozen=True)
class Line(BodyShape):
    """A rod between points of the mechanism, by their names."""

    points: tuple[str, ...] = ()
    radius: Size = 0.0
    sizes = ("radius",)

    def __post_init__(self) -> None:
        names = self.points
        if not isinstance(names, Sequence) or isinstance(names, str) or len(names) < 2:
            raise ModelError(f"points of a Line are two names or more, not {shown(names)}.")
        object.__setattr__(self, "points", tuple(map(name_of, names)))
        super().__post_init__()


@dataclass(frozen=True)
class Mesh(BodyShape):
    """Triangles from a file (STL, OBJ, GLB, ...), in the body's axes; needs the extra ``meshes``.

    Attributes
    ----------
    path : str
    scale : number or parameter
        A file in millimetres has the scale 0.001.
    """

    sizes = ("scale",)
    path: str
    scale: Size = 1.0


KINDS: dict[str, type[BodyShape]] = {
    kind.__name__: kind
    for kind in (
        Arrow, Box, Capsule, Cone, CoordinateFrame, Cylinder, Disc, Ellipsoid, Line, Mesh, Plane, Sphere, Torus, Wheel,
    )
}  # fmt: skip
"""All shapes by their names."""


def _size(value: Any, what: str) -> Size:
    """A size: a positive number, or the name of a parameter."""
    if isinstance(value, str) or hasattr(value, "name"):
        return name_of(value)
    size = number(value, what)
    if not (math.isfinite(size) and size >= 0.0):
        raise ModelError(f"The {what} is a number that is not negative, m, or a parameter, not {shown(value)}.")
    return size


def _place(place: Any, what: str) -> Place:
    if isinstance(place, str) or hasattr(place, "name"):
        return name_of(place)
    if not isinstance(place, Sequence) or len(place) != 3:
        raise ModelError(f"{what} is a point or three coordinates, not {shown(place)}.")
    x, y, z = (name_of(p) if isinstance(p, str) or hasattr(p, "name") else number(p, what) for p in place)
    return x, y, z


def _direction(values: Any, what: str) -> tuple[float, float, float]:
    if not isinstance(values, Sequence) or len(values) != 3 or isinstance(values, str) or not any(values):
        raise ModelError(f"{what} is a direction with three components, not {shown(values)}.")
    x, y, z = (number(value, what) for value in values)
    return x, y, z


def _is_hexadecimal(text: str) -> bool:
    return all(letter in "0123456789abcdefABCDEF" for letter in text)
