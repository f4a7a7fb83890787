"""The mass matrix by composite rigid bodies.

Where a speed moves the whole subtree of a point as one rigid body, its partial velocities are those of this composite.
The momentum of the composite follows from 10 inertial parameters. Entries of the mass matrix follow from this momentum,
carried like a force and a torque towards the root of the tree of points. The number of operations is quadratic in the
length of a chain; that of the sum over bodies is cubic.

Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 6.2 (composite-rigid-body algorithm); here
along inertial axes, and about the points of the mechanism.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.kinematics import (
    INERTIAL,
    Components,
    Kinematics,
    Rotation,
    add,
    cross,
    differentiate,
    dot,
    multiply,
    scale,
)
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.tape import Scalar

__all__ = ["CompositeBodies"]


@dataclass(frozen=True)
class _Field:
    """The rigid motion of a subtree that one speed causes.

    Attributes
    ----------
    anchor : int
        The reference point of this motion.
    turn, drift : Components
        Partial angular velocity, and partial velocity of the anchor, in the inertial frame.
    branches : tuple of int
        The children of the anchor that are moved, each with its subtree.
    bodies : tuple of int
        The moved bodies at the anchor.
    n_bodies : int
        Number of all moved bodies.
    """

    anchor: int
    turn: Components
    drift: Components
    branches: tuple[int, ...]
    bodies: tuple[int, ...]
    n_bodies: int


@dataclass(frozen=True)
class _Composite:
    """Inertial parameters of a composite body about some point, in the inertial frame.

    Attributes
    ----------
    mass : Scalar
    first_moment : Components
        Mass times the position of the mass centre.
    inertia : Rotation
    """

    mass: Scalar
    first_moment: Components
    inertia: Rotation


class CompositeBodies:
    """Composite rigid bodies of a mechanism, for the speeds that move a subtree as one rigid body.

    Parameters
    ----------
    kinematics : Kinematics
    along : sequence of Jvp
        Differentiation with respect to each speed.
    rate : Jvp
        Differentiation with respect to time.
    """

    def __init__(self, kinematics: Kinematics, along: Sequence[Jvp], rate: Jvp) -> None:
        self.kinematics = kinematics
        self.tape = kinematics.tape
        self._rate = rate
        points, bodies = kinematics.mechanism.points, kinematics.mechanism.bodies
        self._children: list[list[int]] = [[] for _ in points]
        for point in kinematics.moving:
            base, _ = kinematics.step(point)
            if base is not None:
                self._children[base].append(point)
        self._bodies_at: list[list[int]] = [[] for _ in points]
        for number, body in enumerate(bodies):
            self._bodies_at[body.point].append(number)
        self._below: dict[int, _Composite] = {}
        self.fields = [self._field(direction) for direction in along]

    @property
    def largest(self) -> int:
        """The number of bodies in the largest composite."""
        return max((field.n_bodies for field in self.fields if field is not None), default=0)

    def entries(self) -> dict[tuple[int, int], Scalar]:
        """Entries of the mass matrix by pairs of speed numbers, the greater first, if both speeds have a field."""
        entries: dict[tuple[int, int], Scalar] = {}
        for s, field in enumerate(self.fields):
            if field is None:
                continue
            body = self._sum(field.branches, field.bodies)
            force = add(scale(body.mass, field.drift), cross(field.turn, body.first_moment))
            torque = add(cross(body.first_moment, field.drift), multiply(body.inertia, field.turn))
            point: int | None = field.anchor
            came_from: int | None = None
            while point is not None:
                for r, other in enumerate(self.fields):
                    if other is None or other.anchor != point or (max(r, s), min(r, s)) in entries:
                        continue
                    if came_from in other.branches or (came_from is None and _contains(other, field)):
                        product = dot(torque, other.turn) + dot(force, other.drift)
                        entries[max(r, s), min(r, s)] = product
                came_from = point
                arm = self._offset(point)
                torque = add(torque, cross(arm, force))
                point, _ = self.kinematics.step(point)
        # Subtrees are nested or disjoint; speeds that move disjoint ones are not coupled.
        for s, field in enumerate(self.fields):
            for r, other in enumerate(self.fields[:s]):
                if field is not None and other is not None and not _overlap(field, other):
                    entries.setdefault((s, r), self.tape.zero)
        return entries

    def _field(self, along: Jvp) -> _Field | None:
        """The field of a speed; None if it does not move its bodies as one rigid body."""
        kinematics = self.kinematics
        frames, points = kinematics.mechanism.frames, kinematics.mechanism.points
        turn = kinematics.zero
        turned: set[int] = set()
        for number, frame in enumerate(frames):
            if frame.angular_velocity is None:
                continue
            relative = [(f, differentiate(along, c)) for f, c in kinematics.relative_angular_velocity(number)]
            if any(any(components) for _, components in relative):
                if turned:
                    return None
                turn = kinematics.express(tuple(relative), INERTIAL)
                turned.add(number)
            elif number != INERTIAL and frame.reference in turned:
                turned.add(number)

        moved: set[int] = set()
        anchors: dict[int, Components] = {}
        branches: list[int] = []
        for point in kinematics.moving:
            base, parts = kinematics.step(point)
            drift = [(frame, differentiate(along, components)) for frame, components in parts]
            rigid = base is not None and self._is_rigid(point, turned, along)
            if base in moved:
                if not rigid:
                    return None
                moved.add(point)
            elif rigid and base is not None and turned and points[point].offset:
                # It turns with the frames, even if it lies on the axis and has no partial velocity.
                moved.add(point)
                anchors[base] = kinematics.zero
                branches.append(point)
            elif any(any(components) for _, components in drift):
                moved.add(point)
                anchors[point] = kinematics.express(tuple(drift), INERTIAL)
        if len(anchors) != 1:
            return None
        [(anchor, drift_of_anchor)] = anchors.items()
        if anchor in moved:
            branches = self._children[anchor]

        at_anchor: list[int] = []
        count = 0
        for number, body in enumerate(kinematics.mechanism.bodies):
            turns = body.frame in turned
            if body.point not in moved and not turns:
                continue
            count += 1
            if body.point == anchor:
                at_anchor.append(number)
            elif body.point not in moved:
                return None
            if bool(turned) != turns and body.frame is not None:
                return None
        return _Field(anchor, turn, drift_of_anchor, tuple(branches), tuple(at_anchor), count)

    def _is_rigid(self, point: int, turned: set[int], along: Jvp) -> bool:
        """Whether the speed leaves the offset of a point from its base unchanged, in frames that turn with it."""
        for frame, components in self.kinematics.vector(self.kinematics.mechanism.points[point].offset):
            if any(components) and bool(turned) != (frame in turned):
                return False
            if any(along(self._rate(entry)) for entry in components):
                return False
        return True

    def _sum(self, branches: Sequence[int], bodies: Sequence[int]) -> _Composite:
        """The composite of bodies at a point and of the subtrees of its children."""
        parts = [self._body(number) for number in bodies]
        parts += [self._shifted(self._hanging(branch), self._offset(branch)) for branch in branches]
        zero = self.kinematics.zero
        return _Composite(
            self.tape.sum([part.mass for part in parts]),
            add(zero, *(part.first_moment for part in parts)),
            _matrix([add(zero, *(part.inertia[i] for part in parts)) for i in range(3)]),
        )

    def _hanging(self, point: int) -> _Composite:
        """The composite of the subtree of a point, about that point."""
        known = self._below.get(point)
        if known is None:
            known = self._below[point] = self._sum(self._children[point], self._bodies_at[point])
        return known

    def _body(self, number: int) -> _Composite:
        body = self.kinematics.mechanism.bodies[number]
        inertia: Rotation = (self.kinematics.zero,) * 3
        if body.inertia is not None:
            assert body.inertia_frame is not None
            # I = R I' R^T
            rotation = self.kinematics.rotation(body.inertia_frame, INERTIAL)
            within = self.kinematics.matrix(body.inertia)
            columns = [multiply(within, row) for row in rotation]
            upper = {(i, j): dot(rotation[i], columns[j]) for i in range(3) for j in range(i, 3)}
            inertia = _matrix([[upper[min(i, j), max(i, j)] for j in range(3)] for i in range(3)])
        return _Composite(self.kinematics.convert(body.mass), self.kinematics.zero, inertia)

    def _shifted(self, body: _Composite, arm: Components) -> _Composite:
        """The composite about another point; `arm` is the vector from there to the present one.

        With g = m r + 2 h, the parallel axis theorem reads I + (r . g) 1 - (r g^T + g r^T) / 2.
        """
        moment = scale(body.mass, arm)
        g = add(moment, body.first_moment, body.first_moment)
        # Diagonal entries have r . g without the i-th term.
        products = [a * b for a, b in zip(arm, g, strict=True)]
        rows: list[list[Scalar]] = []
        for i in range(3):
            row = []
            for j in range(3):
                if i == j:
                    more = self.tape.sum([products[k] for k in range(3) if k != i])
                else:
                    more = (arm[i] * g[j] + arm[j] * g[i]) / -2
                row.append(body.inertia[i][j] + more)
            rows.append(row)
        return _Composite(body.mass, add(body.first_moment, moment), _matrix(rows))

    def _offset(self, point: int) -> Components:
        """The position of a point relative to its base, in the inertial frame."""
        base, _ = self.kinematics.step(point)
        if base is None:
            return self.kinematics.zero
        return self.kinematics.express(self.kinematics.vector(self.kinematics.mechanism.points[point].offset), INERTIAL)


def _contains(outer: _Field, inner: _Field) -> bool:
    """Whether a field moves everything that another one with the same anchor moves."""
    return set(inner.branches) <= set(outer.branches) and set(inner.bodies) <= set(outer.bodies)


def _overlap(a: _Field, b: _Field) -> bool:
    """Whether two fields have the same anchor and move something in common."""
    common = not set(a.branches).isdisjoint(b.branches) or not set(a.bodies).isdisjoint(b.bodies)
    return a.anchor == b.anchor and common


def _matrix(rows: Sequence[Sequence[Scalar]]) -> Rotation:
    x, y, z = ((row[0], row[1], row[2]) for row in rows)
    return x, y, z
