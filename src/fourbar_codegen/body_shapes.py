"""Shapes of bodies in pictures: spheres, boxes, wheels and others, as plain data.

Sizes are numbers, m, or names of parameters, so that they follow a run's. Axes are those of the body, and places are
from its mass centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any, ClassVar

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import finite_number, is_mapping, name_of, named, number

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
    "check_names",
    "data_of",
    "is_of_pydy",
    "made_from",
    "named_shapes",
    "shapes_of",
]

Size = float | str
"""A number or the name of a parameter."""

Place = tuple[Size, Size, Size] | str
"""Coordinates from the mass centre along the body's axes, or the name of a point."""

SMALLEST = 1e-100
"""Length of a direction, whose square is not zero."""

COLORS = {
    "black": "#222222", "white": "#f4f4f4", "grey": "#8a8f96", "red": "#c8423b", "green": "#4b9a5a", "blue": "#4474b8",
    "orange": "#e0913a", "yellow": "#e3c13d", "purple": "#8b6bb1", "brown": "#8a6248", "cyan": "#3d9aa8",
    "pink": "#d77ba8",
}  # fmt: skip
"""Colours by their names, besides ``#rrggbb``."""


@dataclass(frozen=True, kw_only=True, repr=False)
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
    """Names of the fields that are sizes."""

    at: Place = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    x_axis: tuple[float, float, float] | None = None
    color: str = ""

    def __init_subclass__(cls) -> None:
        cls.sizes = tuple(name for name, kind in cls.__annotations__.items() if kind == "Size")

    def __post_init__(self) -> None:
        for name in self.sizes:
            object.__setattr__(self, name, _size(getattr(self, name), f"{name} of a {type(self).__name__}"))
        what = f"at of a {type(self).__name__}"
        object.__setattr__(self, "at", _place(self.at, what))
        object.__setattr__(self, "axis", _direction(self.axis, f"axis of a {type(self).__name__}"))
        if self.x_axis is not None:
            what = f"x_axis of a {type(self).__name__}"
            object.__setattr__(self, "x_axis", _direction(self.x_axis, what))
            if _is_parallel(self.axis, self.x_axis):
                raise ModelError(f"{what} is a direction that is not that of its axis, not {shown(self.x_axis)}.")
        is_hex = isinstance(self.color, str) and len(self.color) == 7 and self.color[0] == "#"
        if self.color and not (self.color in COLORS or (is_hex and _is_hexadecimal(self.color[1:]))):
            raise ModelError(f"A colour is #rrggbb or one of {', '.join(COLORS)}, not {shown(self.color)}.")

    def __repr__(self) -> str:
        own, common = list[str](), list[str]()
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.default is MISSING or value != entry.default:
                (common if entry.kw_only else own).append(f"{entry.name}={value!r}")
        return f"{type(self).__name__}({', '.join(own + common)})"

    def as_data(self) -> dict[str, Any]:
        """The shape as data that JSON can hold."""
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {"kind": type(self).__name__} | {k: [*v] if isinstance(v, tuple) else v for k, v in values.items()}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> BodyShape:
        """The shape of data that `as_data` has made.

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


@dataclass(frozen=True, repr=False)
class Sphere(BodyShape):
    """A sphere.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.Sphere(0.1, color="red").radius
    0.1
    """

    radius: Size


@dataclass(frozen=True, repr=False)
class Ellipsoid(BodyShape):
    """An ellipsoid with its half axes along the body's."""

    x: Size
    y: Size
    z: Size


@dataclass(frozen=True, repr=False)
class Box(BodyShape):
    """A box with the lengths of its edges along the body's axes."""

    x: Size
    y: Size
    z: Size


@dataclass(frozen=True, repr=False)
class Cylinder(BodyShape):
    """A cylinder about its axis."""

    radius: Size
    length: Size


@dataclass(frozen=True, repr=False)
class Capsule(BodyShape):
    """A rod with round ends; `length` is that between their centres."""

    radius: Size
    length: Size


@dataclass(frozen=True, repr=False)
class Cone(BodyShape):
    """A cone with its tip in the direction of its axis; `at` is halfway up."""

    radius: Size
    length: Size


@dataclass(frozen=True, repr=False)
class Disc(BodyShape):
    """A disc with a sharp edge, on which it rolls."""

    radius: Size
    thickness: Size


@dataclass(frozen=True, repr=False)
class Wheel(BodyShape):
    """A wheel with spokes and a sharp rim, on whose edge it rolls."""

    radius: Size


@dataclass(frozen=True, repr=False)
class Torus(BodyShape):
    """A torus, such as a tyre; `radius` is that of the circle in its tube."""

    radius: Size
    tube_radius: Size


@dataclass(frozen=True, repr=False)
class Plane(BodyShape):
    """A thin square at right angles to its axis."""

    length: Size


@dataclass(frozen=True, repr=False)
class Arrow(BodyShape):
    """An arrow from `at` in the direction of its axis."""

    length: Size


@dataclass(frozen=True, repr=False)
class CoordinateFrame(BodyShape):
    """The axes of the body: x red, y green, z blue."""

    length: Size


@dataclass(frozen=True, repr=False)
class Line(BodyShape):
    """A rod between points of the mechanism, by their names."""

    points: tuple[str, ...]
    radius: Size

    def __post_init__(self) -> None:
        names = self.points
        if not isinstance(names, list | tuple) or len(names) < 2:
            raise ModelError(f"points of a Line are two names or more, not {shown(names)}.")
        object.__setattr__(self, "points", tuple(map(name_of, names)))
        super().__post_init__()


@dataclass(frozen=True, repr=False)
class Mesh(BodyShape):
    """Triangles from a file (STL, OBJ, GLB, ...), in the body's axes; needs the extra ``meshes``.

    Attributes
    ----------
    path : str
    scale : number or parameter
        A file in millimetres has the scale 0.001.
    """

    path: str
    scale: Size = 1.0


KINDS: dict[str, type[BodyShape]] = {
    kind.__name__: kind for kind in sorted(BodyShape.__subclasses__(), key=lambda kind: kind.__name__)
}
"""All shapes by their names."""


THIN = 1e-3
"""Thickness of circles and planes of pydy, m."""

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
"""Shapes from those of `pydy.viz <https://pydy.readthedocs.io/en/stable/viz/index.html>`_ by the names of these;
cylinders and cones are along y."""


def is_of_pydy(value: Any) -> bool:
    """Whether it is an object of pydy.viz, which need not be installed."""
    return any(base.__module__.startswith("pydy.viz") for base in type(value).__mro__)


def made_from(shape: Any) -> BodyShape:
    """The shape like one of pydy.viz.

    Raises
    ------
    ModelError
        If there is none.
    """
    kind = type(shape).__name__
    if kind not in MADE_FROM:
        raise ModelError(
            f"There is no shape like the {kind} of pydy.viz; there are {', '.join(MADE_FROM)}. Others are meshes: "
            'Mesh("part.stl").'
        )
    made = MADE_FROM[kind](shape)
    return replace(made, color=shape.color if shape.color in COLORS else "")


def data_of(shapes: Mapping[str, Sequence[BodyShape]]) -> dict[str, list[dict[str, Any]]]:
    """Shapes by names of bodies as data that JSON can hold."""
    return {name: [shape.as_data() for shape in of_body] for name, of_body in shapes.items()}


def shapes_of(data: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, tuple[BodyShape, ...]]:
    """The shapes of data that `data_of` has made."""
    return {name: tuple(map(BodyShape.from_data, of_body)) for name, of_body in data.items()}


def named_shapes(given: Any, names: Collection[str]) -> dict[str, tuple[BodyShape, ...]]:
    """Shapes by names, of a mapping of bodies, frames or their names to a shape or a sequence of shapes.

    Raises
    ------
    ModelError
        If a name is not among those given, or what stands for it is no shape.
    """
    if not is_mapping(given):
        raise ModelError(
            f"shapes= is a mapping of bodies to shapes, such as {{body: Sphere(0.1)}}, not {shown(given)}."
        )
    found: dict[str, tuple[BodyShape, ...]] = {}
    for name, shape in named(given, names, "body or frame").items():
        several = shape if isinstance(shape, list | tuple) else [shape]
        of_body = tuple(made_from(each) if is_of_pydy(each) else each for each in several)
        for each in of_body:
            if not isinstance(each, BodyShape):
                raise ModelError(f"The shape of {name} is one of {', '.join(KINDS)}, not {shown(each)}.")
        found[name] = of_body
    return found


def check_names(
    shapes: Mapping[str, Sequence[BodyShape]], parameters: Collection[str], points: Collection[str]
) -> None:
    """Raise a ModelError if a size of a shape is no parameter, or a place no point."""
    for name, of_body in shapes.items():
        for shape in of_body:
            places = [shape.at] if isinstance(shape.at, str) else []
            sizes = [getattr(shape, size) for size in shape.sizes] + ([] if places else [*shape.at])
            for size in sizes:
                if isinstance(size, str) and size not in parameters:
                    known = ", ".join(parameters) or "none"
                    raise ModelError(
                        f"The shape of {name} has the size {size}, which is no parameter; there are {known}."
                    )
            for point in (*places, *(shape.points if isinstance(shape, Line) else ())):
                if point not in points:
                    known = ", ".join(points) or "none"
                    raise ModelError(
                        f"The shape of {name} names a point {point}, which is not drawn; there are {known}."
                    )


def _size(value: Any, what: str) -> Size:
    """A size: a positive number, or the name of a parameter."""
    if isinstance(value, str) or hasattr(value, "name"):
        return name_of(value)
    size = math.nan if getattr(value, "free_symbols", None) else number(value, what)
    if not (math.isfinite(size) and size > 0.0):
        raise ModelError(f"The {what} is a positive number, m, or a parameter, not {shown(value)}.")
    return size


def _place(place: Any, what: str) -> Place:
    if isinstance(place, str) or hasattr(place, "name"):
        return name_of(place)
    parts = [*place] if hasattr(place, "__len__") else []
    if len(parts) != 3:
        raise ModelError(f"{what} is a point or three coordinates, not {shown(place)}.")
    x, y, z = (name_of(p) if isinstance(p, str) or hasattr(p, "name") else finite_number(p, what) for p in parts)
    return x, y, z


def _direction(values: Any, what: str) -> tuple[float, float, float]:
    parts = [*values] if hasattr(values, "__len__") and not isinstance(values, str) else []
    if len(parts) != 3:
        raise ModelError(f"{what} is a direction with three components, not {shown(values)}.")
    x, y, z = (finite_number(value, what) for value in parts)
    length = math.hypot(x, y, z)
    if not SMALLEST < length < 1.0 / SMALLEST:
        raise ModelError(f"{what} is a direction with three components, not {shown(values)}.")
    return x, y, z


def _is_parallel(a: tuple[float, float, float], b: tuple[float, float, float]) -> bool:
    """Whether two directions are the same, or opposite, but for rounding errors."""
    along = abs(sum(x * y for x, y in zip(a, b, strict=True))) / (math.hypot(*a) * math.hypot(*b))
    return along > 1.0 - 1e-12


def _is_hexadecimal(text: str) -> bool:
    return all(letter in "0123456789abcdefABCDEF" for letter in text)
