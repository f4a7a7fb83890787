"""What is wrong with a linkage, or probably not meant, by the names of its parts."""

from __future__ import annotations

import warnings

import numpy as np

from fourbar_codegen.errors import ModelError, ModelWarning
from fourbar_codegen.linkage.mobility import Mobility
from fourbar_codegen.linkage.parts import Parts
from fourbar_codegen.linkage.tree import GROUND, Tree

__all__ = ["SAME_RTOL", "check_mobility", "check_parts", "size_of"]

SAME_RTOL = 1e-9
"""Largest distance of points that are one, or of a point from its guide, relative to the size of the linkage."""

MIXED_UNITS_RATIO = 500.0
"""Ratio of lengths above which units are probably mixed."""


def size_of(parts: Parts) -> float:
    """The larger side of a rectangle about all points, m."""
    drawn = np.array(list(parts.points.values()))
    return float(max(np.ptp(drawn.real), np.ptp(drawn.imag), 1e-300))


def check_parts(name: str, parts: Parts) -> None:
    """Check that all parts are of use, and that links have lengths.

    Raises
    ------
    ModelError
        If there is no ground or link; a point or block is on no link; nothing has a mass that gravity could act on; or
        a link has two points at one place, or connects points of the ground only.
    """
    if not parts.ground and all(slide.on != GROUND for slide in parts.slides.values()):
        raise ModelError("There is no ground: state the points that do not move, by ground(...) or ground=.")
    if not parts.links:
        raise ModelError("There is no link: state bars or plates.")
    used = {point for link in parts.links.values() for point in link.points}
    lost = [point for point in parts.points if point not in used | {*parts.ground, *parts.slides}]
    if lost:
        raise ModelError(f"Points {', '.join(lost)} are on no link: leave them out, or name them in a link.")
    idle = [point for point in parts.slides if point not in used]
    if idle:
        raise ModelError(f"No link is pinned to the blocks at {', '.join(idle)}.")
    for point, slide in parts.slides.items():
        if point in parts.carriers[slide.on]:
            raise ModelError(f"{point} is a point of {slide.on} itself: a block there cannot move along its guide.")
        if point in parts.links:
            raise ModelError(f"{point} is the name of a block and of a link: give the link another name.")
    has_mass = parts.masses or any(link.density is not None or link.mass for link in parts.links.values())
    if parts.gravity is not None and not has_mass:
        raise ModelError("There is gravity, but nothing has a mass: give a density, or masses of links or points.")
    size, distances = size_of(parts), {}
    for link, stated in parts.links.items():
        if {*stated.points} <= {*parts.ground}:
            raise ModelError(f"Link {link} connects points of the ground only: leave it out.")
        for k, a in enumerate(stated.points):
            for b in stated.points[k + 1 :]:
                distances[link, a, b] = abs(parts.points[a] - parts.points[b])
    for (link, a, b), distance in distances.items():
        if distance <= SAME_RTOL * size:
            raise ModelError(
                f"Link {link} has no length from {a} to {b}: both are at ({parts.points[a].real:g}, "
                f"{parts.points[a].imag:g}). For a joint of links, give one point to both."
            )
    longest, shortest = (f(distances, key=lambda key: distances[key]) for f in (max, min))
    if distances[longest] > MIXED_UNITS_RATIO * distances[shortest]:
        _warn(
            f"Lengths of {name} differ by a factor of {distances[longest] / distances[shortest]:.0f}: "
            f"{distances[longest]:g} m from {longest[1]} to {longest[2]}, {distances[shortest]:g} m from "
            f"{shortest[1]} to {shortest[2]}. Coordinates are in metres; are units mixed?"
        )


def check_mobility(name: str, parts: Parts, tree: Tree, mobility: Mobility) -> None:
    """Check that the linkage can move, and its drives with it; warn of bars that cannot move relative to each other.

    Raises
    ------
    ModelError
        If no link can move, or drives are more than the degrees of freedom of what they drive.
    """
    counted = f"By counting it has {mobility.gruebler} degrees of freedom."
    if mobility.redundant:
        counted += f" Constraints of the joints {', '.join(mobility.redundant)} follow from others."
    if mobility.degrees_of_freedom == 0:
        raise ModelError(
            f"{name} is rigid: no link can move. {counted} Leave out a bar, or give links lengths with which they can "
            "move."
        )
    driven = [drive.of for drive in parts.drives]
    moving = {link for part, _ in mobility.parts for link in part}
    for link in driven:
        if link not in moving:
            raise ModelError(f"The drive of {link} can move nothing: {link} is rigidly connected to the ground.")
    if mobility.degrees_of_freedom - len(mobility.independent) < len(driven):
        raise ModelError(
            f"{name} has {mobility.degrees_of_freedom} degrees of freedom, and the drives of {', '.join(driven)} are "
            "more than these can follow: leave out one."
        )
    for group in mobility.rigid:
        bars = [link for link in group if link != GROUND]
        points = dict.fromkeys(point for link in bars for point in tree.links[link])
        if GROUND in group:
            _warn(f"Links {', '.join(bars)} of {name} cannot move: they hold each other on the ground.")
        else:
            _warn(
                f"Links {', '.join(bars)} of {name} move as one rigid part, as they are drawn. If that is meant, state "
                f"a plate of the points {', '.join(points)}: it has this motion, with fewer coordinates."
            )


def _warn(message: str) -> None:
    warnings.warn(message, ModelWarning, stacklevel=6)
