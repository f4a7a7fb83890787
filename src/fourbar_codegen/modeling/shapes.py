"""What is drawn between the points of a mechanism: its links and guides.

A link is a set of points with constant distances: those that vectors with constant components connect, in one frame or
in frames that do not turn relative to it. Joints show where links share points, whatever made them: a PinJoint, or
`Point.set_pos` by hand. A point whose position from another varies along one constant direction slides on a guide.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.modeling.mechanism import (
    Body,
    Components,
    DrawnPoint,
    Frame,
    Shape,
    Vector,
    entries_of,
    walk,
)

__all__ = ["find_shapes"]


@dataclass(frozen=True)
class _Slide:
    """A point that slides, the one that its position varies from, and the frame and components of the direction."""

    point: int
    base: int
    frame: int
    direction: Components


def find_shapes(
    frames: Sequence[Frame], points: Sequence[DrawnPoint], bodies: Iterable[Body], pathways: Iterable[Shape] = ()
) -> tuple[tuple[DrawnPoint, ...], tuple[Shape, ...]]:
    """Ground, links and sliders, and unnamed points in the directions of guides.

    Parameters
    ----------
    frames : sequence of Frame
    points : sequence of DrawnPoint
        The first one is at rest.
    bodies : iterable of Body
    pathways : iterable of Shape
        Springs, dampers and other actuators between points: what they hold without a body beside them has no guide.

    Returns
    -------
    tuple of DrawnPoint
        Their numbers follow those of the given points.
    tuple of Shape
    """
    if not points:
        return (), ()
    unturned, places, rigid = _Classes(), _Classes(), _Classes()
    connected = [(number, point.parent) for number, point in enumerate(points) if point.parent is not None]
    for number, frame in enumerate(frames):
        if frame.dcm is not None and not _functions(frame.dcm):
            unturned.join(number, frame.parent)
    for number, parent in connected:
        if not any(entries_of(points[number].offset)):
            places.join(number, parent)

    def fixed(point: int, frame: int) -> tuple[int, int]:
        return unturned.of(frame), places.of(point)

    slides: list[_Slide] = []
    for number, parent in connected:
        offset = points[number].offset
        if len({unturned.of(frame) for frame, _ in offset}) == 1:  # in one frame, or as good as that
            if _functions(entries_of(offset)):
                slides += _slides(number, parent, offset)
            else:
                rigid.join(fixed(number, offset[0][0]), fixed(parent, offset[0][0]))
    # A place is drawn by one point, which is a mass centre only if there is no other.
    at: dict[Any, list[int]] = {}
    for number in sorted(range(len(points)), key=lambda number: points[number].body is not None):
        at.setdefault(places.of(number), []).append(number)
    links: dict[Any, dict[Any, int]] = {rigid.of(fixed(0, 0)): {places.of(0): 0}}
    for node in rigid.known():
        links.setdefault(rigid.of(node), {})[node[1]] = at[node[1]][0]
    numbers = {point.number: number for number, point in enumerate(points) if point.number is not None}
    names: dict[Any, list[str]] = {}
    centres: dict[Any, set[Any]] = {}
    for body in bodies:
        if body.point in numbers and body.frame is not None:
            node = fixed(numbers[body.point], body.frame)
            names.setdefault(rigid.of(node), []).append(body.name)
            if body.mass != 0:
                centres.setdefault(rigid.of(node), set()).add(node[1])
    shapes = []
    shared = Counter(place for members in links.values() for place in members)
    for number, (link, members) in enumerate(links.items()):
        # Mass centres that are no joints are not on the outline.
        inner = {place for place in centres.get(link, ()) if shared[place] == len(at[place]) == 1}
        ends = [n for place, n in members.items() if place not in inner]
        vertices = tuple(sorted(ends if len(ends) > 1 else members.values()))
        name = " and ".join(names.get(link, [frames[link[0]].name]))
        if number == 0 or len(vertices) > 1:
            shapes.append(Shape("link" if number else "ground", name, vertices))
    tips = []
    held = {frozenset((shape.points[0], shape.points[-1])) for shape in pathways}
    for slide in slides:
        guide = rigid.of(fixed(slide.base, slide.frame))
        alone = guide not in names and len(links.get(guide, ())) < 2 and unturned.of(slide.frame) != unturned.of(0)
        if alone and frozenset((slide.point, slide.base)) in held:  # a spring pendulum
            continue
        # The guide is on the ground, or on the link that has more to it, such as a rod that slides through a block.
        sizes = [len(links.get(rigid.of(fixed(n, slide.frame)), ())) for n in (slide.point, slide.base)]
        swapped = sizes[0] > sizes[1] and unturned.of(slide.frame) != unturned.of(0)
        moved, base = (slide.base, slide.point) if swapped else (slide.point, slide.base)
        tips.append(DrawnPoint("", base, ((slide.frame, slide.direction),), None, None))
        shapes.append(Shape("slider", points[moved].name, (moved, base, len(points) + len(tips) - 1)))
    return tuple(tips), tuple(shapes)


def _functions(expressions: Iterable[sm.Expr]) -> set[sm.Expr]:
    """The functions of time in expressions, and their derivatives."""
    return {node for node in walk(expressions) if isinstance(node, AppliedUndef | sm.Derivative)}


def _slides(point: int, base: int, offset: Vector) -> Iterator[_Slide]:
    """How a point slides, if its position varies along one constant direction."""
    varying = [(frame, components) for frame, components in offset if _functions(components)]
    functions = _functions(entries_of(offset))
    if len(varying) == len(functions) == 1:
        [(frame, components)], [function] = varying, functions
        direction = tuple(sm.diff(component, function) for component in components)
        if not _functions(direction):
            yield _Slide(point, base, frame, direction)


class _Classes:
    """Classes of equivalent items."""

    def __init__(self) -> None:
        self._next: dict[Any, Any] = {}

    def of(self, item: Any) -> Any:
        """The item that stands for the class of an item."""
        while (following := self._next.get(item, item)) != item:
            item = following
        return item

    def join(self, item: Any, other: Any) -> None:
        """Make two items equivalent."""
        for each in (item, other):
            self._next.setdefault(each, each)
        self._next[self.of(item)] = self.of(other)

    def known(self) -> list[Any]:
        """All items that were joined to others."""
        return list(self._next)
