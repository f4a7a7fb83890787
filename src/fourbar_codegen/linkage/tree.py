"""The points and links of a planar linkage -> its spanning tree and its cut joints, with positions in numbers.

Positions in the plane are complex numbers, x + i y. Each link turns by one angle from the x axis, and each block moves
along its guide by one displacement; these are the coordinates. A link is placed where the tree reaches it first. Each
of its other points that is known already is a cut joint: two places of one point, which coincide in a closed position.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

__all__ = ["GROUND", "Place", "Slide", "Tree", "spanning_tree"]

Floats = NDArray[np.float64]

GROUND = "ground"
"""The name of the link that does not move."""


@dataclass(frozen=True)
class Slide:
    """A block that moves along a straight guide, with a pin on it.

    Attributes
    ----------
    point : str
        The pin, which names the block.
    on : str
        The link that carries the guide.
    base : complex
        As drawn, where the displacement is zero.
    along : complex
        Unit vector in the direction of the guide, as drawn.
    ends : (str, str) or None
        Two points of that link on the guide, the first at the base. None for a guide of the ground that is given by a
        direction: its base is where the pin is drawn.
    """

    point: str
    on: str
    base: complex
    along: complex
    ends: tuple[str, str] | None


@dataclass(frozen=True)
class Place:
    """A point as one link, or one block, carries it.

    Attributes
    ----------
    point : str
    carrier : str
        A link, or the point that names a block.
    parent : int or None
        Number of the place that its position is relative to; None for the origin.
    """

    point: str
    carrier: str
    parent: int | None


@dataclass(frozen=True)
class Tree:
    """A linkage without its cut joints.

    Attributes
    ----------
    points : dict of str to complex
        As drawn, m.
    links : dict of str to tuple of str
        Points of the moving links.
    slides : dict of str to Slide
        By the blocks' points.
    places : tuple of Place
        Parents first.
    cuts : tuple of (int, int)
        Places of one point that coincide; the second is the one that the tree reached first.
    of_link : dict of (str, str) to int
        The places by carrier and point; of a link, also where it is reached.
    values : ndarray, shape (n,)
        The coordinates as drawn: angles of links, rad, then displacements of blocks, m. The angle between a link and
        the one that it is reached by is between -pi and pi.
    unreached : tuple of str
        Links that no joint connects to the ground, not even through others.
    """

    points: Mapping[str, complex]
    links: Mapping[str, tuple[str, ...]]
    slides: Mapping[str, Slide]
    places: tuple[Place, ...]
    cuts: tuple[tuple[int, int], ...]
    of_link: Mapping[tuple[str, str], int]
    values: Floats
    unreached: tuple[str, ...]

    @property
    def coordinates(self) -> tuple[str, ...]:
        """What has a coordinate: links, then blocks."""
        return (*self.links, *self.slides)

    def direction(self, link: str) -> complex:
        """Unit vector along a link as drawn: from its first to its second point."""
        first, second = self.links[link][:2]
        way = self.points[second] - self.points[first]
        return way / abs(way)

    def positions(self, values: Floats) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Positions of the places, and their derivatives with respect to the coordinates.

        Parameters
        ----------
        values : ndarray, shape (n,)

        Returns
        -------
        ndarray, shape (n_places,)
        ndarray, shape (n_places, n)
        """
        number = {name: k for k, name in enumerate(self.coordinates)}
        z = np.zeros(len(self.places), dtype=complex)
        dz = np.zeros((len(self.places), len(values)), dtype=complex)
        for k, place in enumerate(self.places):
            slide = self.slides.get(place.carrier)
            on = place.carrier if slide is None else slide.on
            start = 0.0 if place.parent is None else z[place.parent]
            if place.parent is not None:
                dz[k] = dz[place.parent]
            drawn = self.points[place.point] if slide is None else slide.base
            offset = drawn - (0.0 if place.parent is None else self.points[self.places[place.parent].point])
            if slide is not None:
                offset += values[number[place.carrier]] * slide.along
            turn = 1.0 if on == GROUND else np.exp(1j * values[number[on]]) / self.direction(on)
            z[k] = start + turn * offset
            if on != GROUND:
                dz[k, number[on]] += 1j * turn * offset
            if slide is not None:
                dz[k, number[place.carrier]] += turn * slide.along
        return z, dz

    def gaps(self, values: Floats) -> tuple[Floats, Floats]:
        """The distances in the cut joints along x and y, two rows each, and their Jacobian.

        Parameters
        ----------
        values : ndarray, shape (n,)

        Returns
        -------
        ndarray, shape (2 n_cuts,)
        ndarray, shape (2 n_cuts, n)
        """
        z, dz = self.positions(values)
        first, second = np.array(self.cuts, dtype=int).reshape(-1, 2).T
        gap, slopes = z[first] - z[second], dz[first] - dz[second]
        rows = np.stack([slopes.real, slopes.imag], axis=1).reshape(2 * len(first), len(values))
        return np.stack([gap.real, gap.imag], axis=1).ravel(), rows


def spanning_tree(
    points: Mapping[str, complex], ground: tuple[str, ...], links: Mapping[str, tuple[str, ...]], slides: list[Slide]
) -> Tree:
    """Reach the links from the ground, by pins first, in the order of their definition.

    Parameters
    ----------
    points : mapping of str to complex
    ground : tuple of str
        Points of the ground.
    links : mapping of str to tuple of str
    slides : list of Slide

    Returns
    -------
    Tree
    """
    places: list[Place] = []
    known: dict[str, int] = {}
    of_link: dict[tuple[str, str], int] = {}
    cuts: list[tuple[int, int]] = []
    angles: dict[str, float] = {GROUND: 0.0}
    waiting = {slide.point: slide for slide in slides}
    tree = Tree(points, links, dict(waiting), (), (), of_link, np.zeros(0), ())

    def add(point: str, carrier: str, parent: int | None) -> None:
        places.append(Place(point, carrier, parent))
        of_link[carrier, point] = len(places) - 1
        if point in known:
            cuts.append((len(places) - 1, known[point]))
        known.setdefault(point, len(places) - 1)

    for point in ground:
        add(point, GROUND, None)
    while True:
        link = next((name for name in links if name not in angles and known.keys() & {*links[name]}), None)
        if link is not None:
            entry = min(known[point] for point in links[link] if point in known)
            carrier = places[entry].carrier
            before = angles[tree.slides[carrier].on if carrier in tree.slides else carrier]
            turn = np.angle(tree.direction(link)) - before
            angles[link] = before + np.pi - np.remainder(np.pi - turn, 2.0 * np.pi)
            of_link[link, places[entry].point] = entry
            for point in links[link]:
                if point != places[entry].point:
                    add(point, link, entry)
            continue
        # Blocks come last, those first that are the only way on.
        ready = sorted((s for s in waiting.values() if s.on in angles), key=lambda s: s.point in known)
        if not ready:
            break
        slide = waiting.pop(ready[0].point)
        add(slide.point, slide.point, None if slide.ends is None else of_link[slide.on, slide.ends[0]])
    unreached = tuple(name for name in links if name not in angles)
    of_blocks = [0.0 if s.ends is None else _along(points[s.point] - s.base, s.along) for s in slides]
    values = np.array([*(angles.get(name, 0.0) for name in links), *of_blocks])
    return replace(tree, places=tuple(places), cuts=tuple(cuts), values=values, unreached=unreached)


def _along(way: complex, direction: complex) -> float:
    """The component of a vector in a direction."""
    return (way * direction.conjugate()).real
