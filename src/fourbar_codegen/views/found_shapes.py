"""Shapes of bodies that nobody has given: wheels, rods between joints, boxes, and balls for particles.

They are found from positions and orientations at random states, so a loaded model needs no SymPy for them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.body_shapes import BodyShape, Box, Disc, Line, Sphere, Torus, Wheel
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["Contact", "States", "bodies_of_points", "contacts", "found_shapes", "parts_of", "random_states"]

Floats = NDArray[np.float64]

N_STATES = 20
RTOL = 1e-9
"""Tolerance for what is constant at all states, relative to lengths."""

ROD = 0.022
BALL = 0.045
"""Radii of rods and of particles, relative to the longest link."""

MOST = 2.2
"""Largest ratio of radii of rods."""

DENSITY = 1000.0
"""Of limbs, kg/m^3."""

LONGER = 1.1
"""Ratio by which a parameter is changed to see whether it is a radius."""

THIN = 0.03
"""Least thickness of boxes and discs, relative to their size."""

SAMPLES, STEP, ROLLING = 3, 1e-4, 1e-6
"""States at which rolling is looked at, by central differences with this step and this relative error."""

CORRECTIONS = 8
"""Of invariants, such as the norms of quaternions, by Newton's method."""


@dataclass(frozen=True)
class Contact:
    """A wheel on the ground.

    Attributes
    ----------
    body, center, point : int
        The wheel, among the drawn bodies; its centre and contact point, among the drawn points.
    axis : ndarray, shape (3,)
        Its axis in the body.
    radius, tube_radius : float
        The contact point lies a radius from the centre, in the direction of steepest descent in the wheel's plane, and
        then a tube's radius downwards.
    up : ndarray, shape (3,)
        The normal of the ground, away from it.
    """

    body: int
    center: int
    point: int
    axis: Floats
    radius: float
    tube_radius: float
    up: Floats


@dataclass(frozen=True)
class States:
    """Where points and bodies are at random states.

    Attributes
    ----------
    points : ndarray, shape (n_states, n_points, 3)
        The drawn points.
    rotations : ndarray, shape (n_states, n_bodies, 3, 3)
        Of the drawn bodies.
    centers : tuple of (int or None)
        For each of these, the number of its mass centre; None where it is not drawn, or two bodies have one name.
    size : float
        The largest distance of two points along an axis, m.
    t : ndarray, shape (n_states,)
    x, r : ndarray, shape (n_x, n_states) and (n_r, n_states)
    p : ndarray, shape (n_p,)
        Times, states, inputs and parameters.
    """

    points: Floats
    rotations: Floats
    centers: tuple[int | None, ...]
    size: float
    t: Floats
    x: Floats
    r: Floats
    p: Floats

    def local(self, body: int, center: int) -> Floats:
        """The points along a body's axes, from one of them, (n_states, n_points, 3)."""
        return np.asarray((self.points - self.points[:, [center]]) @ self.rotations[:, body])

    def fixed(self, body: int, center: int) -> NDArray[np.bool_]:
        """The points that are fixed on a body, of which one is given."""
        return np.asarray(np.ptp(self.local(body, center), axis=0).max(axis=1) <= RTOL * self.size)

    @property
    def bodies(self) -> list[tuple[int, int]]:
        """The numbers of the bodies and of their mass centres, as far as their places and orientations are known."""
        return [
            (body, center)
            for body, center in enumerate(self.centers)
            if center is not None
            and np.isfinite(self.points[:, center]).all()
            and np.isfinite(self.rotations[:, body]).all()
        ]

    def axis(self, body: int) -> Floats | None:
        """The axis, in the body, that keeps its direction in the inertial frame; zero if all do, None if none does."""
        changes = (self.rotations[:, body] - self.rotations[0, body]).reshape(-1, 3)
        _, extents, axes = np.linalg.svd(changes)
        if extents[2] > RTOL:
            return None
        return np.asarray(axes[2] if extents[1] > RTOL else np.zeros(3))

    def goes(self, point: int) -> bool:
        """Whether a point's place is known and changes."""
        places = self.points[:, point]
        return bool(np.isfinite(places).all() and np.ptp(places, axis=0).max(initial=0.0) > RTOL * self.size)

    def moves(self, body: int, center: int) -> bool:
        """Whether a body moves."""
        turns = np.ptp(self.rotations[:, body], axis=0).max(initial=0.0)
        return bool(turns > RTOL or self.goes(center))


def random_states(model: Kernel, p: Floats) -> States:
    """Where points and bodies are at 20 random states, at which invariants, such as norms of quaternions, hold."""
    generator, times = np.random.default_rng(0), np.linspace(0.0, 1.0, N_STATES)
    x, r = generator.uniform(-1.0, 1.0, (model.n_x, N_STATES)), generator.uniform(-1.0, 1.0, (model.n_r, N_STATES))
    if model.n_i:
        for k in range(N_STATES):
            for _ in range(CORRECTIONS):
                x[: model.n_q, k] += model.invariant_correction(times[k], x[: model.n_q, k], p, r[:, k])
    points = np.moveaxis(model.drawing_along(times, x, r, p)[0], 2, 0)
    rotations = np.moveaxis(model.orientations_along(times, x, r, p), 3, 0)
    # States at which all is known that is ever known; what never is, since nobody has asked for it, counts as unknown.
    known = np.full(N_STATES, fill_value=True)
    for values in (points.reshape(N_STATES, -1), rotations.reshape(N_STATES, -1)):
        finite = np.isfinite(values)
        known &= (finite | ~finite.any(axis=0)).all(axis=1)
    points, rotations = points[known], rotations[known]
    bodies = [point.body for point in model.layout.drawing.points]
    of = {body: number for number, body in enumerate(bodies) if body and bodies.count(body) == 1}
    placed = points[:, np.isfinite(points).all(axis=(0, 2))]
    size = float(np.ptp(placed, axis=1).max(initial=0.0)) or 1.0 if placed.size else 1.0
    centers = tuple(map(of.get, model.layout.drawing.bodies))
    return States(points, rotations, centers, size, times[known], x[:, known], r[:, known], p)


def bodies_of_points(model: Kernel, states: States) -> tuple[str, ...]:
    """For each point with a name, the body that it is fixed on; of joints the first one; empty for others."""
    found = [""] * len(model.points)
    for body, center in states.bodies if len(states.points) > 1 else ():
        for point in np.flatnonzero(states.fixed(body, center)[: len(found)]):
            found[point] = found[point] or model.layout.drawing.bodies[body]
    return tuple(found)


def contacts(model: Kernel, states: States) -> tuple[Contact, ...]:
    """The wheels of a model that roll on the ground, one for each contact point.

    Parameters
    ----------
    model : Kernel
    states : States

    Returns
    -------
    tuple of Contact
        A contact point is no mass centre, and fixed on no body, nor, with the wheel's centre, on the ground. It is
        where the tangent of a wheel, a circle or a torus about an axis of the body, is horizontal: C - P = R e_r - r n,
        with the upward normal n, and e_r the direction of -n in the wheel's plane. That holds to 1e-9 of the radius at
        20 random states.

    Notes
    -----
    Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina, A. L. Schwab, "Linearized dynamics equations for the balance
    and steer of a bicycle", Proceedings of the Royal Society A 463 (2007), for knife-edge wheels.
    """
    if len(states.points) < 2:
        return ()
    candidates = [
        _Candidate(body, center, states.fixed(body, center), states.axis(body)) for body, center in states.bodies
    ]
    best: dict[int, tuple[float, Contact]] = {}
    for point, entry in enumerate(model.layout.drawing.points[: len(model.points)]):
        places = states.points[:, point]
        if entry.body is not None:
            continue  # a mass, such as a cart under the pivot of its pole
        if any(candidate.fixed[point] for candidate in candidates) or not np.isfinite(places).all():
            continue
        normals, line = _grounds(model, places, states.size)
        for candidate in candidates:
            axis, across = candidate.axis, []
            if axis is not None and not axis.any():
                continue
            if axis is not None and line is not None:  # the point moves along a line, beside the axis of a wheel
                normal = np.cross(states.rotations[0, candidate.body] @ axis, line)
                across = [normal, -normal]
            for up in (*normals, *across):
                for found, spin in _wheels(states, candidate, point, up):
                    if axis is not None and not _rolls(model, states, found):
                        continue
                    if spin > best.get(point, (0.0, None))[0]:
                        best[point] = spin, found
    taken: dict[int, Contact] = {}
    for _, contact in best.values():
        taken.setdefault(contact.body, contact)
    return tuple(taken.values())


@dataclass(frozen=True)
class _Candidate:
    """A body that may be a wheel: its number and mass centre, the points fixed on it, and `States.axis`."""

    body: int
    center: int
    fixed: NDArray[np.bool_]
    axis: Floats | None


def _rolls(model: Kernel, states: States, wheel: Contact) -> bool:
    """Whether the material point of a wheel at its contact point is at rest in all motions that constraints allow.

    Of wheels that never lean, since points at a constant distance below an axle are not only contact points. Velocities
    are central differences along q' = K u with J u = 0.
    """
    moved = False
    for k in range(min(SAMPLES, len(states.t))):
        t, x, r = states.t[k], states.x[:, k], states.r[:, k]
        jacobian = model.velocity(t, x, states.p, r)[0] if model.n_c else np.zeros((1, model.n_u))
        _, extents, directions = np.linalg.svd(jacobian)
        for direction in directions[np.count_nonzero(extents > RTOL * extents.max()) :]:
            change = model.coordinate_change(t, x, direction, states.p, r)
            near = np.repeat(x[:, np.newaxis], 2, axis=1)
            near[: model.n_q] += STEP * change[:, np.newaxis] * (-1.0, 1.0)
            columns = np.full(2, t), near, np.repeat(r[:, np.newaxis], 2, axis=1), states.p
            center = np.diff(model.drawing_along(*columns)[0][wheel.center])[:, 0] / (2.0 * STEP)
            turning = np.diff(model.orientations_along(*columns)[wheel.body])[..., 0] / (2.0 * STEP)
            arm = states.points[k, wheel.point] - states.points[k, wheel.center]
            around = turning @ states.rotations[k, wheel.body].T @ arm  # omega x (P - C)
            speed = max(np.abs(center).max(), np.abs(around).max())
            if np.abs(center + around).max() > ROLLING * max(speed, states.size):
                return False
            moved |= bool(speed > ROLLING * states.size)
    return moved


def _grounds(model: Kernel, places: Floats, size: float) -> tuple[list[Floats], Floats | None]:
    """Normals that the ground may have under a point with places of shape (n_states, 3), and its line if it has one."""
    gravity = model.layout.drawing.gravity
    if gravity is None:
        level = [sign * axis for axis in np.eye(3)[::-1] for sign in (1.0, -1.0)]
    else:
        level = [-np.array(gravity, dtype=float) / np.linalg.norm(gravity)]
    _, extents, axes = np.linalg.svd(places - places.mean(axis=0))
    if extents[1] > RTOL * extents[0] >= extents[2]:  # it moves in a plane, such as a slope
        return [*level, axes[2], -axes[2]], None
    return level, np.asarray(axes[0]) if extents[0] > RTOL * size and extents[1] <= RTOL * extents[0] else None


def _wheels(states: States, candidate: _Candidate, point: int, up: Floats) -> Iterator[tuple[Contact, float]]:
    """How a point may be the contact point of a body, if it is, and how far the wheel turns past it."""
    body, center = candidate.body, candidate.center
    rotations = states.rotations[:, body]
    # The wheel's centre: its mass centre, or another point of the body, which cannot spin as fast as a wheel does.
    for place in (center, *(k for k in np.flatnonzero(candidate.fixed).tolist() if k != center)):
        if not (states.goes(point) or states.goes(place)):
            continue  # pins on the ground
        way = states.points[:, point] - states.points[:, place]
        local = np.einsum("nji,nj->ni", rotations, way)
        if np.linalg.norm(way, axis=1).min() <= 1e3 * RTOL * states.size:
            continue
        own = (*np.eye(3), np.linalg.svd(local)[2][-1]) if candidate.axis is None else (candidate.axis,)
        for axis in own:
            along = rotations @ axis
            if np.abs((np.cross(along, up) * way).sum(axis=1)).max() > RTOL * states.size:
                continue
            steepest = -up + (along @ up)[:, np.newaxis] * along
            length = np.linalg.norm(steepest, axis=1, keepdims=True)
            if length.min() < RTOL:
                continue
            columns = np.stack([(steepest / length).ravel(), np.tile(-up, len(way))], axis=1)
            if np.abs(steepest / length + up).max() <= RTOL:  # a wheel that never leans: both directions are the same
                columns[:, 1] = 0.0
            (radius, tube), *_ = np.linalg.lstsq(columns, way.ravel(), rcond=None)
            error = np.abs(columns @ (radius, tube) - way.ravel()).max()
            if radius > 0.0 and error <= RTOL * radius and -RTOL * radius <= tube < radius:
                spin = float(np.ptp(local, axis=0).max()) * (1.0 if place == center else 1e-3)
                tube = 0.0 if tube <= RTOL * radius else float(tube)
                yield Contact(body, place, point, axis, float(radius), tube, up), spin
                return


def found_shapes(
    model: Kernel,
    states: States,
    size: float,
    on_ground: Sequence[Contact],
    edges: Sequence[tuple[str, float, str, str]],
) -> dict[str, tuple[BodyShape, ...]]:
    """Shapes of all bodies of a model, by the names of bodies and of links without mass.

    Parameters
    ----------
    model : Kernel
    states : States
    size : float
        That of the longest link, m.
    on_ground : sequence of Contact
    edges : sequence of (str, float, str, str)
        The name of a link, a length, and the names of two points, for each edge of the link.

    Returns
    -------
    dict of str to tuple of BodyShape
        Of wheels, wheels with spokes if their axle is held by another body, discs otherwise; of links, rods along their
        edges; of bodies without either, the uniform box of the same mass and central inertia; of particles, balls.
    """
    found: dict[str, tuple[BodyShape, ...]] = {}
    drawing = model.layout.drawing
    for contact in on_ground:
        name, radius = drawing.bodies[contact.body], _named(model, states.p, contact)
        at, axis = drawing.points[contact.center].name, _three(contact.axis)
        others = [(body, centre) for body, centre in states.bodies if body != contact.body]
        is_held = any(states.fixed(body, centre)[contact.center] for body, centre in others)
        if contact.tube_radius:
            found[name] = (Torus(radius, contact.tube_radius, at=at, axis=axis),)
            if is_held:
                found[name] += (Wheel(radius, at=at, axis=axis),)
        elif is_held:
            found[name] = (Wheel(radius, at=at, axis=axis),)
        else:
            found[name] = (Disc(radius, THIN * contact.radius, at=at, axis=axis),)
    touching = {drawing.points[contact.point].name for contact in on_ground}
    wheels, counts = {*found}, Counter(name for name, *_ in edges)
    masses, inertias = model.mass_properties(0.0, np.zeros(model.n_x), states.p, np.zeros(model.n_r))
    mass_of = dict(zip(drawing.bodies, np.nan_to_num(masses), strict=True))
    for link, length, *ends in edges:
        # Bodies without mass, as in the frames between joints, give a link no name if others do.
        name = " and ".join(part for part in parts_of(link, drawing.bodies) if mass_of.get(part, 1.0)) or link
        if touching.isdisjoint(ends) and all(ends) and name not in wheels:
            radius = ROD * size
            if counts[link] == 1:  # a limb of a mass has about the density of water
                limb = np.sqrt(mass_of.get(name, 0.0) / (DENSITY * np.pi * length))
                radius = float(np.clip(limb, radius, MOST * radius))
            radius = float(f"{radius:.3g}")
            found[name] = (*found.get(name, ()), Line(points=tuple(ends), radius=radius))
    linked = {body for name in found for body in parts_of(name, drawing.bodies)}
    for body, center in states.bodies:
        name, mass, inertia = drawing.bodies[body], masses[body], inertias[body]
        has_extent = mass > 0.0 and np.isfinite(inertia).all() and inertia.any()
        if name not in linked and has_extent and states.moves(body, center):
            found[name] = (_box(mass, inertia),)
    for point in drawing.points:
        if point.body is not None and point.body not in drawing.bodies:
            found.setdefault(point.body, (Sphere(BALL * size, at=point.name),))
    return found


def _named(model: Kernel, p: Floats, contact: Contact) -> float | str:
    """A wheel's radius: the parameter that it is, if it changes as that does, or its value."""
    for place, name in enumerate(model.parameters):
        if abs(p[place] - contact.radius) <= RTOL * contact.radius:
            other = p.copy()
            other[place] *= LONGER
            radii = [c.radius for c in contacts(model, random_states(model, other)) if c.body == contact.body]
            if radii and abs(radii[0] - other[place]) <= RTOL * radii[0]:
                return name
    return float(f"{contact.radius:.12g}")


def parts_of(link: str, bodies: Sequence[str]) -> list[str]:
    """The names of the bodies that a link consists of."""
    return [link] if link in bodies else link.split(" and ")


def _box(mass: float, inertia: Floats) -> Box:
    """The uniform box with a mass and a central inertia: I_x = m (y^2 + z^2) / 12, and so on."""
    moments, axes = np.linalg.eigh((inertia + inertia.T) / 2.0)
    if np.count_nonzero(inertia - np.diag(np.diag(inertia))) == 0:
        moments, axes = np.diag(inertia), np.eye(3)
    edges = np.sqrt(np.maximum(6.0 * (moments.sum() - 2.0 * moments) / mass, 0.0))
    x, y, z = np.maximum(edges, THIN * edges.max())
    return Box(x, y, z, axis=_three(axes[:, 2]), x_axis=_three(axes[:, 0]))


def _three(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
