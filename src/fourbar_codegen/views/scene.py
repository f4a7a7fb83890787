"""What a picture of a mechanism shows: links, guides, pins, blocks, springs and the ground, as lines and symbols.

Every picture is drawn from a `Scene`: plots, animations, reports, and assembly modes.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.body_shapes import BodyShape
from fourbar_codegen.errors import ModelError, ModelWarning, shown
from fourbar_codegen.interface.arguments import listed
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import Point, Shape
from fourbar_codegen.views.found_shapes import bodies_of_points, contacts, found_shapes, parts_of, random_states
from fourbar_codegen.views.solids import Solid, solids_of

__all__ = ["Line", "Scene", "Symbol", "View", "extent", "known_points", "scene", "view_of"]

Floats = NDArray[np.float64]

PLANAR = 1e-9
"""Relative tolerance, of the size of the mechanism, for planar mechanisms and for points at rest."""

UNIT = 0.03
"""Size of the symbols for pins, blocks and springs, relative to the size of the mechanism."""

LINKS = 4.0
"""Size of a mechanism that travels, relative to its largest link."""

MOST_TIPS = 3
"""Most ends of links in space with a trace by default."""

ASIDE = 0.2
"""Distance of a mass centre from the line between two joints at which it is another corner, relative to the line."""

TOUCHING = 1e-6
"""Largest distance of two points that a pin joins, relative to the size of the mechanism; loops may close worse."""

Template = tuple[tuple[tuple[float, float, float], ...], ...]
"""Lines of a symbol. Each point has a fraction of the way from the symbol's place to the point that it is directed to,
and displacements along and across that direction in units of the symbols' size."""

COILS = (6, 20)
"""Least and largest number of coils of a spring; between these, a coil is as long as it is wide."""
SPACE = 1.6
"""Distance of springs and dampers side by side."""


def _coil(coils: int) -> Template:
    """A spring with a number of coils."""
    turns = [(0.2 + 0.6 * (i + 0.5) / (2 * coils), 0.0, 0.5 * (-1.0) ** i) for i in range(2 * coils)]
    return (((0.0, 0.0, 0.0), (0.2, 0.0, 0.0), *turns, (0.8, 0.0, 0.0), (1.0, 0.0, 0.0)),)


SYMBOLS: dict[str, Template] = {
    "ground": (
        ((0.0, 0.0, 0.0), (0.0, -0.6, -1.0), (0.0, 0.6, -1.0), (0.0, 0.0, 0.0)),
        ((0.0, -1.1, -1.0), (0.0, 1.1, -1.0)),
        *(((0.0, x, -1.0), (0.0, x - 0.4, -1.5)) for x in (-0.7, -0.1, 0.5, 1.1)),
    ),
    "slider": (((0.0, -1.0, -0.6), (0.0, 1.0, -0.6), (0.0, 1.0, 0.6), (0.0, -1.0, 0.6), (0.0, -1.0, -0.6)),),
    "damper": (
        ((0.0, 0.0, 0.0), (0.35, 0.0, 0.0)),
        ((0.35, 0.0, -0.5), (0.35, 0.0, 0.5)),
        ((0.65, 0.0, -0.5), (0.35, 0.0, -0.5)),
        ((0.65, 0.0, 0.5), (0.35, 0.0, 0.5)),
        ((0.5, 0.0, -0.4), (0.5, 0.0, 0.4)),
        ((0.5, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ),
}


@dataclass(frozen=True)
class Line:
    """A line or an area of a picture.

    Attributes
    ----------
    kind : {"link", "guide", "actuator", "line"}
    rows : tuple of int
        Rows of the positions that it connects.
    is_closed : bool
        Whether it is the outline of an area.
    """

    kind: str
    rows: tuple[int, ...]
    is_closed: bool = False


@dataclass(frozen=True)
class Symbol:
    """A symbol of a picture.

    Attributes
    ----------
    kind : {"ground", "pin", "mass", "slider", "spring", "damper"}
    at : int
        Row of the position where it stands.
    toward : int or None
        Row of the position that it is directed to; None for the x axis.
    shift : float
        Displacement across, in units of the symbols' size, of several between the same points.
    outline : Template
        Its lines; empty for a circle.
    """

    kind: str
    at: int
    toward: int | None = None
    shift: float = 0.0
    outline: Template = ()


@dataclass(frozen=True)
class View:
    """How pictures show the axes of the inertial frame.

    Gravity along an axis is shown downwards, and a mechanism whose points stay in a plane of two axes in this plane.

    Attributes
    ----------
    turn : ndarray, shape (3, 3)
        A rotation. The first two of the new coordinates are shown to the right and upwards if the mechanism is planar;
        otherwise the third one is upwards.
    labels : tuple of str
        Of the new coordinates.
    is_planar : bool
    """

    turn: Floats
    labels: tuple[str, ...]
    is_planar: bool

    @property
    def axes(self) -> str:
        """Matplotlib's names of the new coordinates that are shown."""
        return "xy" if self.is_planar else "xyz"

    def __call__(self, positions: Floats) -> Floats:
        """Positions in the new coordinates, shape (..., 3, n_t)."""
        return np.asarray(self.turn @ positions)


_told: set[str] = set()
"""Fingerprints of the models whose points that are not drawn were named."""


def view_of(model: Kernel, positions: Floats, *, in_space: bool = False) -> View:
    """The view of a model's points, shape (n_points, 3, n_t); in space even if they stay in a plane, as wheels do."""
    size, extents = extent(positions)
    flat = [axis for axis in (2, 1, 0) if extents[axis] <= PLANAR * size and not in_space]
    axes, gravity = np.eye(3), model.layout.drawing.gravity
    down = None if gravity is None else np.array(gravity, dtype=float)
    if flat:
        normal = next((axis for axis in flat if down is None or not down[axis]), flat[0])
        up = axes[1 if normal == 2 else 2] if down is None or down[normal] else -down
        right = next(axis for number, axis in enumerate(axes) if number != normal and not axis @ up)
        turn, is_planar = np.array([right, up, np.cross(right, up)]), True
    else:
        up = axes[2] if down is None else -down
        right = next(axis for axis in axes if not axis @ up)
        turn, is_planar = np.array([right, np.cross(up, right), up]), False
    labels = tuple(("-" if row.sum() < 0 else "") + "xyz"[int(np.abs(row).argmax())] for row in turn)
    return View(turn, labels, is_planar)


@dataclass(frozen=True)
class Scene:
    """A mechanism at several instants: what every picture of it shows.

    Attributes
    ----------
    names : tuple of str
        Names of the first rows of `positions`, the mechanism's points.
    bodies : tuple of str or None
        The bodies whose mass centres they are.
    positions : ndarray, shape (n_rows, 3, n_t)
        In the coordinates of the view, m.
    lines : tuple of Line
    symbols : tuple of Symbol
    size : float
    view : View
    unit : float
        Size of the symbols, m.
    shapes : dict of str to tuple of BodyShape
        Of bodies and links in space, by their names.
    solids : tuple of Solid
        These as triangles.
    rotations : ndarray, shape (n_bodies + 1, 3, 3, n_t)
        Of the drawn bodies and of the inertial frame; they take components to the coordinates of the view.
    contacts : tuple of int
        Rows of the points where wheels touch the ground.
    ground_axes : ndarray, shape (3, 3)
        Two directions in the ground, and its normal, as rows.
    tips : tuple of int
        Rows of the ends of links that no other link or the ground holds.
    holders : tuple of str
        For each of `names` the body that holds it; empty if there is none.
    """

    names: tuple[str, ...]
    bodies: tuple[str | None, ...]
    positions: Floats
    lines: tuple[Line, ...]
    symbols: tuple[Symbol, ...]
    size: float
    view: View
    unit: float
    shapes: Mapping[str, tuple[BodyShape, ...]] = field(default_factory=dict)
    solids: tuple[Solid, ...] = ()
    rotations: Floats = field(default_factory=lambda: np.zeros((0, 3, 3, 0)))
    contacts: tuple[int, ...] = ()
    ground_axes: Floats = field(default_factory=lambda: np.eye(3))
    tips: tuple[int, ...] = ()
    holders: tuple[str, ...] = ()

    @property
    def is_planar(self) -> bool:
        """Whether it is shown in the plane of its first two coordinates."""
        return self.view.is_planar

    def moves(self, row: int) -> bool:
        """Whether a point moves."""
        path = self.positions[row]
        path = path[:, np.isfinite(path).all(axis=0)]
        return bool(path.size and np.ptp(path, axis=1).max() > PLANAR * self.size)

    def traced(self) -> dict[int, str]:
        """Row and name of the points with a trace by default.

        Moving joints and ends of links, one for each position; the mass centres if there are none.
        """
        moving = {row: name for row, name in enumerate(self.names) if self.moves(row)}
        if self.solids:  # in space, few points
            tips, centers = ([row for row in rows if row in moving] for rows in (self.tips, range(len(self.names))))
            centers = [row for row in centers if self.bodies[row] is not None]
            few = [*self.contacts] or (tips if len(tips) <= MOST_TIPS else centers)[:MOST_TIPS]
            return {row: self.names[row] for row in few if row < len(self.names)} or moving
        joints: dict[int, str] = {}
        for row, name in moving.items():
            elsewhere = not any(_coincide(self.positions, row, other, PLANAR * self.size) for other in joints)
            if self.bodies[row] is None and elsewhere:
                joints[row] = name
        return joints or moving

    @property
    def shown(self) -> list[int]:
        """Rows that are in the picture: not points without a symbol, nor those that guides are directed to."""
        rows = {row for line in self.lines for row in line.rows} | {symbol.at for symbol in self.symbols}
        return sorted(rows | set(self.traced()))

    def limits(self, rows: Sequence[int] | None = None) -> tuple[Floats, Floats]:
        """The least and largest coordinates of rows and of all solids at each instant, shape (3, n_t) each.

        By default of all rows that are shown.
        """
        points = self.positions[self.shown if rows is None else list(rows)]
        low, high = [*points], [*points]
        for solid in self.solids:
            places, rotations = solid.placed(self.positions, self.rotations)
            rotations[:, 2] *= solid.stretch(self.positions)
            corners = np.einsum("ijt,nj->nit", rotations, solid.corners) + places
            low += [*corners]
            high += [*corners]
        if not low:
            low = high = [np.full((3, self.positions.shape[2]), np.nan)]
        return np.fmin.reduce(low), np.fmax.reduce(high)

    @property
    def body_size(self) -> float:
        """The size of what moves, m: in space at one instant, since vehicles go far."""
        if not self.solids:
            return self.size
        low, high = self.limits([row for row in self.shown if self.moves(row)])
        sizes = (high - low).max(axis=0)
        return float(np.median(sizes[np.isfinite(sizes)])) if np.isfinite(sizes).any() else self.size

    def outline(self, symbol: Symbol) -> Floats:
        """The lines of a symbol, one after the other with NaN between them, shape (3, n_points, n_t)."""
        at = self.positions[symbol.at]
        way = np.zeros_like(at) if symbol.toward is None else self.positions[symbol.toward] - at
        with np.errstate(all="ignore"):
            along = np.array([[1.0], [0.0], [0.0]]) if symbol.toward is None else way / np.linalg.norm(way, axis=0)
            # A quarter turn about z; in space, ground symbols stand upright, and what points along z has none.
            across = np.array([-along[1], along[0], 0.0 * along[0]]) / np.hypot(along[0], along[1])
            if not self.is_planar:
                upright = symbol.toward is None or np.abs(along[2]) > 1.0 - PLANAR
                across = np.where(upright, np.roll(along, 2, axis=0), across)
        pieces = []
        for line in symbol.outline:
            steps = [at + part * way + self.unit * (x * along + (y + symbol.shift) * across) for part, x, y in line]
            pieces += [*steps, np.full_like(at, np.nan)]
        return np.stack(pieces[:-1], axis=1)


def scene(
    model: Kernel,
    positions: Floats,
    view: View | None = None,
    *,
    rotations: Floats | None = None,
    p: Floats | None = None,
    given: Mapping[str, tuple[BodyShape, ...]] | None = None,
    in_space: bool = False,
) -> Scene:
    """What pictures of a model show at several instants.

    Parameters
    ----------
    model : Kernel
    positions : ndarray, shape (n_points, 3, n_t)
        Of the model's points, those without names included, in the inertial frame, m.
    view : View, optional
        By default that of these positions.
    rotations : ndarray, shape (n_bodies, 3, 3, n_t), optional
        Of the model's drawn bodies. Without them, there are lines in space instead of bodies.
    p : ndarray, shape (n_p,), optional
        The parameters' values, with rotations.
    given : mapping of str to tuple of BodyShape, optional
        Shapes that replace those that are found.
    in_space : bool, optional
        Whether bodies have shapes even if they move in a plane.

    Returns
    -------
    Scene

    Raises
    ------
    ModelError
        If there is nothing to draw.
    """
    if not model.points:
        raise ModelError(f"There is nothing of {model.name} to draw: no positions are given from a point at rest.")
    if model.layout.drawing.not_drawn and model.layout.fingerprint not in _told:
        _told.add(model.layout.fingerprint)
        warnings.warn(
            f"Points of {model.name} that are not drawn: {', '.join(model.layout.drawing.not_drawn)}. Their positions "
            "take frames, parameters without values or inputs that nothing else needs. Model(points=[...]) draws them.",
            ModelWarning,
            stacklevel=5,
        )
    named = positions[: len(model.points)]
    states = None if rotations is None or p is None else random_states(model, p)
    on_ground = () if states is None else contacts(model, states)
    if view is None:
        view = view_of(model, named, in_space=bool(in_space or on_ground or given))
        if rotations is not None and view.is_planar and _leave_plane(rotations, view.turn[2]):
            view = view_of(model, named, in_space=True)
    size, positions = extent(named)[0], view(positions)
    # Of a vehicle that goes far, symbols are as large as the vehicle needs.
    links = [positions[list(shape.points)] for shape in model.layout.drawing.shapes if shape.kind == "link"]
    longest = max((extent(link[:, :, :1])[0] for link in links), default=size)
    unit = UNIT * min(size, LINKS * longest)
    rows, lines, symbols = list(positions), list[Line](), list[Symbol]()
    holders: dict[int, set[int]] = {}
    """Points, one for each position, and the numbers of the shapes that have a point there."""
    kinds: dict[str, set[int]] = {}
    for number, shape in enumerate(model.layout.drawing.shapes):
        kind, points = shape.kind, shape.points
        kinds.setdefault(kind, set()).add(number)
        for point in points[:1] if kind == "slider" else points:
            same = (other for other in holders if _coincide(positions, point, other, TOUCHING * size))
            holders.setdefault(next(same, point), set()).add(number)
        if kind == "link":
            lines += _outline(positions, points, size)
        elif kind == "slider":
            lines.append(Line("guide", (len(rows), len(rows) + 1)))
            symbols.append(Symbol("slider", points[0], len(rows) + 1, outline=SYMBOLS["slider"]))
            rows += _guide(positions[[*points]], 2.0 * unit)
        elif kind in ("spring", "damper"):
            beside = sum({s.at, s.toward} == {points[0], points[-1]} for s in symbols)
            outline = SYMBOLS[kind] if kind == "damper" else _coil(_coils(positions, points, unit))
            symbols.append(Symbol(kind, points[0], points[-1], beside * SPACE, outline))
        elif kind != "ground":
            lines.append(Line(kind, points))
    ground = kinds.get("ground", set())
    jointed = ground | kinds.get("link", set()) | kinds.get("slider", set())
    shared = {point: numbers for point, numbers in holders.items() if len(numbers) > 1}
    symbols += [
        Symbol("ground", point, outline=SYMBOLS["ground"]) for point, numbers in shared.items() if numbers & ground
    ]
    symbols += [Symbol("pin", point) for point, numbers in shared.items() if len(numbers & jointed) > 1]
    entries = model.layout.drawing.points
    masses = [point for point, entry in enumerate(entries) if entry.body is not None]
    still = [point for point in masses if np.ptp(positions[point], axis=1).max(initial=0.0) <= PLANAR * size]
    symbols += [Symbol("mass", point) for point in masses if point not in still or len(still) == len(masses)]
    bodies = tuple(entry.body for entry in entries[: len(model.points)])
    held = ("",) * len(model.points) if states is None else bodies_of_points(model, states)
    found = Scene(model.points, bodies, np.array(rows), tuple(lines), tuple(symbols), size, view, unit, holders=held)
    if view.is_planar or rotations is None or p is None or states is None:
        return found
    tips = tuple(point for point, numbers in holders.items() if len(numbers & jointed) == 1)
    touching = tuple(contact.point for contact in on_ground)
    axes = _level(view.turn @ on_ground[0].up) if on_ground else np.eye(3)
    found = replace(found, contacts=touching, ground_axes=axes, tips=tips)
    bodies_of = found_shapes(model, states, longest, on_ground, _edges(model, positions, size))
    return _with_bodies(found, model, p, rotations, bodies_of, given or {})


def _level(normal: Floats) -> Floats:
    """Axes whose third one is a normal, and whose first one is as near to x as can be, or to y."""
    first = np.eye(3)[0 if abs(normal[0]) < 0.9 else 1]
    along = first - (first @ normal) * normal
    along /= np.linalg.norm(along)
    return np.array([along, np.cross(normal, along), normal])


def _edges(model: Kernel, positions: Floats, size: float) -> list[tuple[str, float, str, str]]:
    """The edges of links: the link's name, the length, and the names of the ends."""
    entries = model.layout.drawing.points
    return [
        (shape.name, _distance(positions, a, b), entries[a].name, entries[b].name)
        for shape in model.layout.drawing.shapes
        if shape.kind == "link"
        for line in _outline(positions, _with_center(positions, shape, entries), size)
        for a, b in pairwise((*line.rows, *line.rows[: line.is_closed and len(line.rows) > 2]))
    ]


def _with_bodies(
    drawn: Scene,
    model: Kernel,
    p: Floats,
    rotations: Floats,
    found: Mapping[str, tuple[BodyShape, ...]],
    given: Mapping[str, tuple[BodyShape, ...]],
) -> Scene:
    """A scene in space with bodies, whose shapes are those that were given, or else found."""
    shapes = {
        name: of_body
        for name, of_body in found.items()
        if given.keys().isdisjoint((name, *parts_of(name, model.layout.drawing.bodies)))
    }
    shapes |= given
    fixed = np.repeat(np.eye(3)[np.newaxis, :, :, np.newaxis], rotations.shape[3], axis=3)  # to the ground
    return replace(
        drawn,
        shapes=shapes,
        solids=tuple(solids_of(model, shapes, p, drawn.positions)),
        rotations=np.einsum("ij,bjkt->bikt", drawn.view.turn, np.concatenate((rotations, fixed))),
    )


def _leave_plane(rotations: Floats, normal: Floats) -> bool:
    """Whether bodies turn about other axes than the normal of a plane."""
    if not rotations.size:
        return False
    of_bodies = np.einsum("bjit,j->bit", rotations, normal)  # the normal in the bodies' axes, which is constant
    changes = np.abs(of_bodies - of_bodies[:, :, :1])
    return bool((changes[np.isfinite(changes)] > PLANAR).any())


def known_points(model: Kernel, points: Iterable[str]) -> list[str]:
    """Names of points of a model, checked."""
    what = "Points are given as a sequence of their names"
    names = listed(points, what)
    if not all(isinstance(name, str) for name in names) or not (names or isinstance(points, list | tuple)):
        raise ModelError(f"{what}, not {shown(points)}.")
    unknown = [name for name in names if name not in model.points]
    if unknown:
        raise ModelError(f"There is no point {', '.join(map(str, unknown))}; there are {', '.join(model.points)}.")
    return names


def _coincide(positions: Floats, point: int, other: int, tolerance: float) -> bool:
    """Whether two points are at the same place at every instant at which they have one."""
    distance = np.abs(positions[point] - positions[other]).max(axis=0)
    known = distance[np.isfinite(distance)]
    return bool(known.size and known.max() <= tolerance)


def _coils(positions: Floats, points: tuple[int, ...], unit: float) -> int:
    """The number of coils of a spring, as long as it is on average."""
    lengths = np.linalg.norm(positions[points[-1]] - positions[points[0]], axis=0)
    known = lengths[np.isfinite(lengths)]
    return int(np.clip(round(0.6 * np.mean(known) / unit), *COILS)) if known.size else COILS[0]


def _guide(positions: Floats, margin: float) -> tuple[Floats, Floats]:
    """The ends of a guide that is as long as the way of the point that slides on it, and a margin."""
    moved, base, tip = positions
    with np.errstate(all="ignore"):
        along = (tip - base) / np.linalg.norm(tip - base, axis=0)
        way = ((moved - base) * along).sum(axis=0)
        low, high = np.nanmin(way, initial=np.inf) - margin, np.nanmax(way, initial=-np.inf) + margin
    return moved + (low - way) * along, moved + (high - way) * along


def _distance(positions: Floats, a: int, b: int) -> float:
    """The distance of two points on a link."""
    lengths = np.linalg.norm(positions[b] - positions[a], axis=0)
    return float(lengths[np.isfinite(lengths)].mean()) if np.isfinite(lengths).any() else 1.0


def _with_center(positions: Floats, shape: Shape, entries: Sequence[Point]) -> tuple[int, ...]:
    """The points of a link, and its mass centre if that is far from the line between two of them."""
    centers = [row for row, entry in enumerate(entries) if entry.body == shape.name and row not in shape.points]
    instants = np.flatnonzero(np.isfinite(positions).all(axis=(0, 1)))
    if len(shape.points) != 2 or len(centers) != 1 or not instants.size:
        return shape.points
    a, b, center = positions[[*shape.points, centers[0]], :, instants[0]]
    length = np.linalg.norm(b - a)
    far = np.linalg.norm(np.cross(b - a, center - a)) > ASIDE * length**2
    return (*shape.points, centers[0]) if far else shape.points


def _outline(positions: Floats, points: tuple[int, ...], size: float) -> Iterator[Line]:
    """The lines of a link: a line through points on a line, else their convex hull."""
    finite = np.flatnonzero(np.isfinite(positions[list(points)]).all(axis=(0, 1)))
    if len(points) == 2 or not finite.size:
        yield Line("link", points)
        return
    corners = positions[list(points), :, finite[0]]
    _, extents, axes = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)
    dimensions = max(1, int((extents > TOUCHING * size).sum()))
    along = (corners - corners.mean(axis=0)) @ axes[:dimensions].T
    if dimensions == 1:
        order = np.argsort(along[:, 0])
        yield Line("link", tuple(points[k] for k in order))
    elif len(points) == 3:
        yield Line("link", points, is_closed=True)
    else:
        hull = importlib.import_module("scipy.spatial").ConvexHull(along)
        if dimensions == 2:
            yield Line("link", tuple(points[k] for k in hull.vertices), is_closed=True)
        else:
            edges = {tuple(sorted(edge)) for facet in hull.simplices for edge in combinations(facet.tolist(), 2)}
            for a, b in sorted(edges):
                yield Line("link", (points[a], points[b]))


def extent(positions: Floats) -> tuple[float, Floats]:
    """The largest extent along an axis, m, and those along all axes.

    Parameters
    ----------
    positions : ndarray, shape (n_points, 3, n_t)
    """
    finite = positions[:, :, np.isfinite(positions).all(axis=(0, 1))]
    if not finite.size:
        return 1.0, np.zeros(3)
    extents = np.ptp(finite, axis=(0, 2))
    return float(extents.max()) or 1.0, extents
