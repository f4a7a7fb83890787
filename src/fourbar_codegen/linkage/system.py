"""Parts of a planar linkage and their spanning tree -> a SymPy System, with values for its symbols."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.linkage.parts import Link, Parts, new_symbol
from fourbar_codegen.linkage.tree import GROUND, Tree
from fourbar_codegen.modeling.model import Parameter

__all__ = ["Geometry", "build_system", "coordinate", "geometry", "speed"]

ON_LINE_RTOL = 1e-9
"""Largest distance of a point from a line on which it lies, relative to the size of the link."""

Vector = tuple[sm.Expr, sm.Expr]
"""Components in a link's frame, or in that of the ground."""


def coordinate(name: str) -> sm.Expr:
    """The angle of a link, or the displacement of a block."""
    return me.dynamicsymbols(f"q_{name}")


def speed(name: str) -> sm.Expr:
    """Its rate."""
    return me.dynamicsymbols(f"u_{name}")


@dataclass(frozen=True)
class Geometry:
    """Where the points of links are, by symbols for lengths.

    Attributes
    ----------
    local : dict of (str, str) to Vector
        By link and point: from the link's first point, along the axes of its frame, whose x axis points to its second.
    guides : dict of str to (Vector, Vector)
        By block: the base, from the place that its position is relative to, and the direction, in the link's frame.
    lengths : dict of (str, frozenset of str) to Symbol
        By link and two of its points.
    parameters : dict of Symbol to Parameter
        Lengths, and the coordinates of points that follow from them.
    """

    local: dict[tuple[str, str], Vector]
    guides: dict[str, tuple[Vector, Vector]]
    lengths: dict[tuple[str, frozenset[str]], sm.Symbol]
    parameters: dict[sm.Symbol, Parameter]


def geometry(tree: Tree, ground: Sequence[str], taken: Container[sm.Symbol]) -> Geometry:
    """Symbols for all lengths, with those that were drawn as values.

    A point of a plate is placed by its distances from the first two points, on the side where it was drawn. A point on
    the line through these is placed by one distance. No symbol has a name that is `taken`.
    """
    local: dict[tuple[str, str], Vector] = {}
    lengths: dict[tuple[str, frozenset[str]], sm.Symbol] = {}
    parameters: dict[sm.Symbol, Parameter] = {}

    def symbol(name: str, value: float | sm.Expr, what: str, unit: str = "m") -> sm.Symbol:
        new = new_symbol(name, parameters, taken)
        parameters[new] = Parameter(value, unit, what)
        return new

    def length(link: str, a: str, b: str) -> sm.Symbol:
        key = link, frozenset((a, b))
        if key not in lengths:
            name = f"l_{link}" if set(tree.links[link]) == {a, b} else _side(a, b)
            drawn = abs(tree.points[b] - tree.points[a])
            lengths[key] = symbol(name, drawn, f"distance of {a} and {b} on link {link}")
        return lengths[key]

    for point in (*ground, *(slide.point for slide in tree.slides.values() if slide.ends is None)):
        drawn, what = tree.points[point], "the ground's point" if point in ground else "the guide of"
        x = symbol(f"x_{point}", drawn.real, f"x of {what} {point}")
        local[GROUND, point] = (x, symbol(f"y_{point}", drawn.imag, f"y of {what} {point}"))
    for link, (first, second, *others) in tree.links.items():
        base = length(link, first, second)
        local[link, first], local[link, second] = (sm.S.Zero, sm.S.Zero), (base, sm.S.Zero)
        for point in others:
            way = (tree.points[point] - tree.points[first]) / tree.direction(link)
            from_first = length(link, first, point)
            if abs(way.imag) <= ON_LINE_RTOL * abs(way):
                local[link, point] = (from_first if way.real > 0.0 else -from_first, sm.S.Zero)
                continue
            from_second = length(link, second, point)
            x = (base**2 + from_first**2 - from_second**2) / (2 * base)
            x = symbol(f"x_{point}_{link}", x, f"{point} on link {link}, from {first} towards {second}")
            y = sm.sqrt(from_first**2 - x**2)
            y = symbol(f"y_{point}_{link}", y if way.imag > 0.0 else -y, f"{point} on link {link}, across")
            local[link, point] = (x, y)
    guides: dict[str, tuple[Vector, Vector]] = {}
    for slide in tree.slides.values():
        if slide.ends is None:
            angle = symbol(
                f"a_{slide.point}", float(np.angle(slide.along)), f"angle of the guide of {slide.point}", "rad"
            )
            guides[slide.point] = local[GROUND, slide.point], (sm.cos(angle), sm.sin(angle))
        else:
            (x0, y0), (x1, y1) = (local[slide.on, end] for end in slide.ends)
            x, y = x1 - x0, y1 - y0
            size = sm.sqrt(x**2 + y**2)
            guides[slide.point] = (sm.S.Zero, sm.S.Zero), (x / size, y / size)
    return Geometry(local, guides, lengths, parameters)


def _side(a: str, b: str) -> str:
    return f"l_{a}{b}" if len(a) == len(b) == 1 else f"l_{a}_{b}"


def build_system(
    parts: Parts, tree: Tree, shape: Geometry, independent: Sequence[str], redundant: bool
) -> tuple[System, list[me.Point]]:
    """The System: bodies, joints of the tree by positions, cut joints and drives by constraints, loads.

    Parameters
    ----------
    parts : Parts
    tree : Tree
    shape : Geometry
    independent : sequence of str
        Links and blocks with independent coordinates.
    redundant : bool
        Whether constraints follow from others, which SymPy's own equations do not allow.

    Returns
    -------
    System
    list of Point
        Those with names.
    """
    t, ground = me.dynamicsymbols._t, me.ReferenceFrame("N")
    origin = me.Point("")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    frames = {GROUND: ground}
    for link in tree.links:
        frames[link] = me.ReferenceFrame(link)
        frames[link].orient_axis(ground, ground.z, coordinate(link))
        frames[link].set_ang_vel(ground, speed(link) * ground.z)
    known: dict[str, me.Point] = {}
    carried: list[me.Point] = []
    for place in tree.places:
        parent = origin if place.parent is None else carried[place.parent]
        point = me.Point("" if place.point in known else place.point)
        slide = tree.slides.get(place.carrier)
        frame = frames[place.carrier if slide is None else slide.on]
        if slide is None:
            x, y = shape.local[place.carrier, place.point]
            x0, y0 = (0, 0) if place.parent is None else shape.local[place.carrier, tree.places[place.parent].point]
            point.set_pos(parent, (x - x0) * frame.x + (y - y0) * frame.y)
            point.v2pt_theory(parent, ground, frame)
        else:
            (x, y), (along_x, along_y) = shape.guides[slide.point]
            along = along_x * frame.x + along_y * frame.y
            point.set_pos(parent, x * frame.x + y * frame.y + coordinate(slide.point) * along)
            point.set_vel(frame, speed(slide.point) * along)
            point.v1pt_theory(parent, ground, frame)
        carried.append(point)
        known.setdefault(place.point, point)
    for name, part in parts.links.items():
        first = carried[tree.of_link[name, part.points[0]]]
        mass, (x, y), inertia = distribution(part, name, shape, tree)
        center = first
        if mass != 0:
            center = first.locatenew(f"{name}_masscenter", x * frames[name].x + y * frames[name].y)
            center.v2pt_theory(first, ground, frames[name])
        tensor = me.inertia(frames[name], 0, 0, inertia)
        system.add_bodies(me.RigidBody(name, center, frames[name], mass, (tensor, center)))
    system.add_bodies(*(me.Particle(f"mass_{point}", known[point], mass) for point, mass in parts.masses.items()))
    if parts.gravity is not None:
        heavy = [body for body in system.bodies if body.mass != 0]
        system.add_loads(*(me.Force(body.masscenter, -body.mass * parts.gravity * ground.y) for body in heavy))
    for force in parts.forces:
        system.add_loads(me.Force(known[force.point], force.x * ground.x + force.y * ground.y))
    for torque in parts.torques:
        for link, sign in ((torque.link, 1), (torque.reaction, -1)):
            if link != GROUND:
                system.add_loads(me.Torque(frames[link], sign * torque.value * ground.z))
    for strut in parts.struts:
        pathway = me.LinearPathway(*(known[end] for end in strut.ends))
        spring = me.LinearSpring(strut.coefficient, pathway, strut.length)
        system.add_actuators(spring if strut.kind == "spring" else me.LinearDamper(strut.coefficient, pathway))
    gaps = [carried[a].pos_from(carried[b]) for a, b in tree.cuts]
    closing = [gap.dot(axis) for gap in gaps for axis in (ground.x, ground.y)]
    system.add_holonomic_constraints(*closing, *(coordinate(drive.of) - drive.function for drive in parts.drives))
    names = [*independent, *(name for name in tree.coordinates if name not in independent)]
    q, u = [coordinate(name) for name in names], [speed(name) for name in names]
    system.q_ind, system.q_dep = q[: len(independent)], q[len(independent) :]
    system.u_ind, system.u_dep = u[: len(independent)], u[len(independent) :]
    system.add_kdes(*(w - c.diff(t) for c, w in zip(q, u, strict=True)))
    if not redundant:
        system.validate_system()
    return system, list(known.values())


def distribution(link: Link, name: str, shape: Geometry, tree: Tree) -> tuple[sm.Expr, Vector, sm.Expr]:
    """Mass, mass centre and inertia about it: as given, or of uniform bars between the link's points.

    A link with points on a line is one bar; the bars of others are the sides of the polygon of their points.
    """
    local = {point: shape.local[name, point] for point in link.points}
    if all(y == 0 for _, y in local.values()):
        along = sorted(link.points, key=lambda point: (tree.points[point] / tree.direction(name)).real)
        sides = [(along[0], along[-1])]
    else:
        sides = [*pairwise(link.points), (link.points[-1], link.points[0])]
    lengths = [_distance(a, b, name, shape) for a, b in sides]
    middles = [tuple((local[a][k] + local[b][k]) / 2 for k in (0, 1)) for a, b in sides]
    total = sm.Add(*lengths)
    mass = link.mass if link.density is None else link.density * total
    if mass is None:
        return sm.S.Zero, (sm.S.Zero, sm.S.Zero), link.inertia or sm.S.Zero
    x, y = (sm.Add(*(size * middle[k] for size, middle in zip(lengths, middles, strict=True))) / total for k in (0, 1))
    inertia = link.inertia
    if link.center is not None:
        x, y = link.center
    if inertia is None:
        inertia = sm.Add(
            *(
                mass * size / total * (size**2 / 12 + (middle[0] - x) ** 2 + (middle[1] - y) ** 2)
                for size, middle in zip(lengths, middles, strict=True)
            )
        )
    return mass, (x, y), inertia


def _distance(a: str, b: str, link: str, shape: Geometry) -> sm.Expr:
    """The symbol for a distance on a link, or its expression."""
    (ax, ay), (bx, by) = shape.local[link, a], shape.local[link, b]
    known = shape.lengths.get((link, frozenset((a, b))))
    return sm.sqrt((bx - ax) ** 2 + (by - ay) ** 2) if known is None else known
