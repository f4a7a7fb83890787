"""Mechanism: the content of a SymPy System as plain data.

Everything that the equations depend on is in a `Mechanism`, so its fingerprint is the fingerprint of the equations.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.interface.registered import Registered

__all__ = [
    "Body",
    "Components",
    "DrawnPoint",
    "Frame",
    "LengthLaw",
    "Load",
    "Mechanism",
    "Point",
    "Shape",
    "Vector",
    "entries_of",
    "walk",
]

Components = tuple[sm.Expr, sm.Expr, sm.Expr]
"""Components of a vector along the axes of one frame."""

Vector = tuple[tuple[int, Components], ...]
"""A vector as SymPy stores it: a sum of components, each in the frame of the given number."""


@dataclass(frozen=True)
class Frame:
    """A reference frame: its direction cosines relative to its parent, and its angular velocity.

    Attributes
    ----------
    name : str
    parent : int
        Number of the parent frame; the inertial frame, number 0, is its own parent.
    dcm : tuple of Expr or None
        The 9 entries, row by row, of the matrix whose row i holds axis i of this frame in the parent's axes. None if
        the frame has an angular velocity but no orientation; no vector is written in such a frame.
    angular_velocity : Vector or None
        Relative to the frame `reference`; None if SymPy knows none.
    reference : int
        The parent frame, or the inertial one if that gives fewer components.
    """

    name: str
    parent: int
    dcm: tuple[sm.Expr, ...] | None
    angular_velocity: Vector | None
    reference: int


@dataclass(frozen=True)
class Point:
    """A point that a body or a load needs, or that connects two of these.

    Attributes
    ----------
    name : str
    parent : int or None
        Number of the point, smaller than its own, that its position is relative to.
    offset : Vector
        Its position from the parent.
    velocity : Vector or None
        In the inertial frame, as it was set; None if it follows from the parent's velocity or is not needed.
    derived : bool
        Whether the velocity is needed and follows from the parent's.
    """

    name: str
    parent: int | None
    offset: Vector
    velocity: Vector | None
    derived: bool


@dataclass(frozen=True)
class DrawnPoint:
    """A point in drawings.

    Attributes
    ----------
    name : str
        Empty for a point that results do not list.
    parent : int or None
        Number of the point, smaller than its own, that its position is relative to; None for the first, the origin.
    offset : Vector
        Its position from the parent.
    body : str or None
        The body whose mass centre it is.
    number : int or None
        Its number among the mechanism's points, if the equations need it.
    is_required : bool
        Whether it has to be drawn: symbols in its position are parameters of the model.
    """

    name: str
    parent: int | None
    offset: Vector
    body: str | None
    number: int | None
    is_required: bool = False


@dataclass(frozen=True)
class Shape:
    """A part of the picture of a mechanism.

    Attributes
    ----------
    kind : {"ground", "link", "slider", "spring", "damper", "actuator", "line"}
        The ground and links have any number of points, with constant distances. A slider has three: the one that
        slides, one on its guide, and one in the direction of the guide from there. The others go from point to point.
    name : str
        That of the bodies, or of the frame of a link without mass.
    points : tuple of int
        Numbers of drawn points.
    """

    kind: Literal["ground", "link", "slider", "spring", "damper", "actuator", "line"]
    name: str
    points: tuple[int, ...]


@dataclass(frozen=True)
class Body:
    """A rigid body, or a particle (whose `inertia` is None).

    Attributes
    ----------
    name : str
    mass : Expr
    point : int
        The mass centre.
    frame : int or None
        The body-fixed frame.
    inertia_frame : int or None
        The frame in whose axes the central inertia is given.
    inertia : tuple of Expr or None
        The 9 entries of the central inertia.
    potential_energy : Expr
    acceleration, angular_acceleration : Vector or None
        Of the mass centre and the frame, in the inertial frame, if set. The equations do not depend on them.
    """

    name: str
    mass: sm.Expr
    point: int
    frame: int | None
    inertia_frame: int | None
    inertia: tuple[sm.Expr, ...] | None
    potential_energy: sm.Expr
    acceleration: Vector | None
    angular_acceleration: Vector | None


@dataclass(frozen=True)
class Load:
    """A force at a point or a torque on a frame.

    Attributes
    ----------
    kind : {"force", "torque"}
    name : str
    vector : Vector
    target : int
        The point that the force acts on, or the frame that the torque acts on.
    position : Vector or None
        The point's position relative to the System's fixed point, or to a point at rest if there is none, as in a
        KanesMethod. None for a torque, or if SymPy knows none.
    """

    kind: Literal["force", "torque"]
    name: str
    vector: Vector
    target: int
    position: Vector | None


@dataclass(frozen=True)
class LengthLaw:
    """The force of an actuator along a pathway, which has a potential if it depends on the length alone.

    Attributes
    ----------
    name : str
    force, length : Expr
    loads : tuple of int
        Numbers of the loads that the actuator consists of.
    """

    name: str
    force: sm.Expr
    length: sm.Expr
    loads: tuple[int, ...]


@dataclass(frozen=True)
class Mechanism:
    """All that the equations of motion of a System depend on.

    Attributes
    ----------
    time : Symbol
    coordinates, speeds : tuple of Expr
        Generalized coordinates and speeds; the independent ones first.
    n_dependent_coordinates, n_dependent_speeds : int
    auxiliary_speeds : tuple of Expr
        Speeds that are zero, used in velocities to find the forces that keep them zero.
    kinematic_equations, holonomic_constraints, velocity_constraints : tuple of Expr
        Expressions to be zero. If `velocity_constraints_derived`, rates of the holonomic constraints come first, in
        their order, and `velocity_constraints` has only the nonholonomic ones, which follow.
    fixed_point : int or None
        Number of the System's fixed point, which positions of loads are relative to; a KanesMethod has none. A point
        whose velocity is set to zero need not be fixed, for example the contact point of a wheel.
    state_equations : tuple of (Expr, Expr)
        States of actuators beside coordinates and speeds, with their rates: activations and fibre lengths of muscles.
    excitations : tuple of Expr
        The functions of time that drive these.
    acceleration_constraints : tuple of Expr
        Those given to a KanesMethod, to be zero. The equations do not depend on them.
    drawn : tuple of DrawnPoint
        The points with positions relative to the System's fixed point, or else to a point at rest. Used only for
        drawings, like the rest.
    shapes : tuple of Shape
        What is drawn between them.
    not_drawn : tuple of str
        Names of points that are not drawn since nothing else uses a frame in which their positions are written.
    length_laws : tuple of LengthLaw
        For the potential energy. They are left out of the fingerprint, so that runs that were saved without them load.
    is_origin_fixed : bool or None
        Whether positions of drawn points are relative to the System's fixed point, or to another point at rest since
        that is not connected to the bodies; None for a KanesMethod, which has no fixed point. Also left out.
    placed : tuple of (str, str)
        For each shape in a frame at a point, the names of the body or frame, and of the point. Also left out.
    """

    time: sm.Symbol
    coordinates: tuple[sm.Expr, ...]
    speeds: tuple[sm.Expr, ...]
    n_dependent_coordinates: int
    n_dependent_speeds: int
    auxiliary_speeds: tuple[sm.Expr, ...]
    frames: tuple[Frame, ...]
    points: tuple[Point, ...]
    bodies: tuple[Body, ...]
    loads: tuple[Load, ...]
    kinematic_equations: tuple[sm.Expr, ...]
    holonomic_constraints: tuple[sm.Expr, ...]
    velocity_constraints: tuple[sm.Expr, ...]
    velocity_constraints_derived: bool
    fixed_point: int | None
    state_equations: tuple[tuple[sm.Expr, sm.Expr], ...]
    excitations: tuple[sm.Expr, ...]
    acceleration_constraints: tuple[sm.Expr, ...]
    drawn: tuple[DrawnPoint, ...]
    shapes: tuple[Shape, ...]
    not_drawn: tuple[str, ...]
    length_laws: tuple[LengthLaw, ...] = field(hash=False)
    is_origin_fixed: bool | None = field(hash=False)
    placed: tuple[tuple[str, str], ...] = field(hash=False)

    # By the mechanics, which stand above.
    forces_along_auxiliary_speeds = Registered[[Sequence[sm.Expr]], tuple[sm.Expr, ...]]()

    @property
    def states_velocity_constraints(self) -> bool:
        """Whether the model states velocity constraints that should keep its position constraints."""
        return bool(self.holonomic_constraints) and not self.velocity_constraints_derived

    def labelled_loads(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        """The loads' vectors, with a description of their place in the System."""
        for load in self.loads:
            yield f"the {load.name}", entries_of(load.vector)

    def labelled_structure(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        """All other expressions, with the same kind of description."""
        for frame in self.frames[1:]:
            yield f"the orientation of frame {frame.name}", frame.dcm or ()
            yield f"the angular velocity of frame {frame.name}", entries_of(frame.angular_velocity)
        for point in self.points:
            yield f"the velocity of point {point.name}", entries_of(point.velocity)
            yield f"the position of point {point.name}", entries_of(point.offset if point.derived else None)
        for body in self.bodies:
            yield f"the mass of body {body.name}", (body.mass,)
            yield f"the inertia of body {body.name}", body.inertia or ()
            yield f"the potential energy of body {body.name}", (body.potential_energy,)
        for load in self.loads:
            yield f"the position of the {load.name}", entries_of(load.position)
        for drawn in self.drawn:
            yield f"the position of point {drawn.name}", entries_of(drawn.offset if drawn.is_required else None)
        for label, group in (
            ("kinematic differential equation", self.kinematic_equations),
            ("holonomic constraint", self.holonomic_constraints),
            ("velocity constraint", self.velocity_constraints),
        ):
            for number, expr in enumerate(group, start=1):
                yield f"{label} {number}", (expr,)


def entries_of(vector: Vector | None) -> Iterator[sm.Expr]:
    """The components of a vector."""
    for _, components in vector or ():
        yield from components


def walk(expressions: Iterable[sm.Basic]) -> Iterator[sm.Basic]:
    """Every distinct subexpression once, without arguments of functions of time and of derivatives.

    Expressions of chained frames are small as graphs but exponential as trees, so `atoms` and
    `free_symbols`, which visit trees, would take too long.
    """
    seen: set[sm.Basic] = set()
    stack = list(expressions)
    while stack:
        node = stack.pop()
        if node in seen:
            continue
        seen.add(node)
        yield node
        if not isinstance(node, AppliedUndef | sm.Derivative):
            stack.extend(node.args)
