"""Inconsistent kinematics: velocities that a user set, against those that follow from orientations and positions.

Angular velocities and velocities may be set, with a constraint or a generalized speed substituted into them. Kane's
equations are formed with what was set. Where all constraints are satisfied, it must equal what follows from orientation
and position. This is tested numerically for the frames of bodies and inertias, for mass centres, and for points that
forces act on. A point whose velocity was set to zero is usually the contact point of a wheel, which is at rest while
its position moves. It is not tested, unless it is a mass centre.

Positions may be given relative to such a contact point, without a connection to a fixed point, as in many uses of
KanesMethod. Then each velocity is compared with that of the preceding point. They differ by the rate of the relative
position, or by w x r where both are points of one body and r has constant length. Where another point moves away from a
point at rest with the rate of its position, that point is fixed, as the fixed point of a System is.

Here, linear and angular accelerations follow from velocities. SymPy uses those that were set, by
``Point.a2pt_theory`` for example. They differ if the reference point is not fixed in the body.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.dynamics.constraints import Constraints
from fourbar_codegen.dynamics.kinematics import (
    INERTIAL,
    Accumulated,
    Kinematics,
    Vector,
    differentiate,
    dot,
)
from fourbar_codegen.dynamics.random_states import RandomStates
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.identities import is_zero
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling import mechanism as stored

__all__ = ["find_contradictions"]

Floats = NDArray[np.float64]

N_STATES = 5
AGREEMENT_RTOL = 1e-6
"""Vectors agree if they differ by at most this fraction of the larger one."""
MIN_MAGNITUDE = 1e-3
"""Smallest magnitude that differences are compared with; states are of the order of 1."""


def find_contradictions(
    kinematics: Kinematics,
    constraints: Constraints,
    rate: Jvp,
    total_rate: Jvp,
    convert: Conversion,
    *,
    speeds: Sequence[Scalar],
    accelerations: Sequence[Scalar],
    values: Mapping[Scalar, float],
    not_orthonormal: Sequence[Scalar],
    motions: Callable[[], Mapping[Scalar, Scalar]],
) -> tuple[str, ...]:
    """Find inconsistent kinematics of a mechanism.

    Parameters
    ----------
    kinematics : Kinematics
    constraints : Constraints
    rate, total_rate : Jvp
        Differentiation with respect to time with u' = 0, and with u' given.
    convert : Conversion
        Converts u' and q'' as well.
    speeds, accelerations : sequence of Scalar
        The leaves of u and u'.
    values : mapping of Scalar to float
        Values of leaves near which the equations are defined.
    not_orthonormal : sequence of Scalar
        Scalars that are zero where direction cosines are orthonormal.
    motions : callable
        Returns what takes the place of inputs with a default expression of time, and of their rates. Others have any
        value, and any rate.

    Returns
    -------
    tuple of str
        A sentence for each inconsistency.
    """
    numbers = _Numbers(kinematics, rate)
    claims = [*_of_frames(numbers), *_of_points(numbers), *_of_accelerations(numbers, total_rate, convert)]
    claims += _of_acceleration_constraints(numbers, convert)
    if not claims:
        return ()
    numbers.place_orientations()
    tape, by_default = kinematics.tape, motions()
    scalars, more = (substitute(tape, group, by_default) for group in (numbers.scalars, not_orthonormal))
    states = RandomStates(tape, _substituted(tape, constraints, by_default), values, scalars, more)
    found: dict[str, str] = {}
    values_there = None
    for values_there in islice(states.moving(speeds, accelerations), N_STATES):
        at = (values_there, *numbers.orientations(values_there))
        for claim in claims:
            was_set, follows = claim.was_set(*at), [vector(*at) for vector in claim.follows]
            if all(_differ(was_set, vector) for vector in follows):
                found.setdefault(
                    claim.sentence,
                    f"{claim.sentence} At a random state that satisfies all constraints, the values are "
                    f"{_shown(was_set)} and {_shown(follows[0])}.",
                )
    if values_there is None:
        found[""] = (
            "Velocities or angular velocities that were set could not be compared with those that follow from "
            "positions and orientations: no random state was found that satisfies all constraints. Give the Model "
            "initial= values that do."
        )
    return tuple(found.values())


def _substituted(tape: Tape, constraints: Constraints, values: Mapping[Scalar, Scalar]) -> Constraints:
    """The constraints with leaves replaced, as far as random states need them."""
    return replace(
        constraints,
        positions=tuple(substitute(tape, constraints.positions, values)),
        velocities=tuple(substitute(tape, constraints.velocities, values)),
        acceleration_bias=tuple(substitute(tape, constraints.acceleration_bias, values)),
        jacobian=tuple(tuple(substitute(tape, row, values)) for row in constraints.jacobian),
    )


def _differ(a: Floats, b: Floats) -> bool:
    """Whether two vectors differ, or one of them is NaN."""
    size = max(float(np.linalg.norm(a)), float(np.linalg.norm(b)), MIN_MAGNITUDE)
    return not float(np.linalg.norm(a - b)) <= AGREEMENT_RTOL * size


def _shown(vector: Floats) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in vector.round(12) + 0.0) + ")"


_Evaluated = Callable[[Floats, Mapping[int, Floats], Mapping[int, Floats]], Floats]
"""Takes values of scalars, and the frames' axes and angular velocities, to a vector in inertial axes."""


@dataclass(frozen=True)
class _Claim:
    """A vector that was set, and those that follow from elsewhere: it must agree with one of these."""

    sentence: str
    was_set: _Evaluated
    follows: tuple[_Evaluated, ...]


class _Numbers:
    """Scalars that are evaluated together, and the orientations that follow from direction cosines."""

    def __init__(self, kinematics: Kinematics, rate: Jvp) -> None:
        self.kinematics, self.rate = kinematics, rate
        self.scalars: list[Scalar] = []
        self._dcms: list[tuple[int, slice, slice]] = []
        self._unoriented: list[int] = []

    def place(self, scalars: Sequence[Scalar]) -> slice:
        """Add scalars; where their values will be."""
        self.scalars += scalars
        return slice(len(self.scalars) - len(scalars), len(self.scalars))

    def vector(self, vector: Vector) -> _Evaluated:
        """A vector, from its components."""
        parts = [(frame, self.place(components)) for frame, components in vector]
        return lambda values, axes, _: np.sum([values[part] @ axes[f] for f, part in parts] or [np.zeros(3)], axis=0)

    def rate_of_vector(self, vector: Vector) -> _Evaluated:
        """The time derivative of a vector, with angular velocities that follow from direction cosines."""
        parts = [(f, self.place(c), self.place(differentiate(self.rate, c))) for f, c in vector]
        return lambda values, axes, turning: np.sum(
            [values[rates] @ axes[f] + np.cross(turning[f], values[part] @ axes[f]) for f, part, rates in parts]
            or [np.zeros(3)],
            axis=0,
        )

    def angular_velocity(self, frame: int) -> _Evaluated:
        """The angular velocity of a frame that follows from its orientation."""
        return lambda _, __, turning: turning[frame]

    def place_orientations(self) -> None:
        """Add the direction cosines of all frames, and their rates."""
        for number, frame in enumerate(self.kinematics.mechanism.frames):
            if number != INERTIAL and frame.dcm is not None:
                entries = [entry for row in self.kinematics.dcm(number) for entry in row]
                self._dcms.append((number, self.place(entries), self.place([self.rate(entry) for entry in entries])))
            elif number != INERTIAL:
                self._unoriented.append(number)

    def orientations(self, values: Floats) -> tuple[dict[int, Floats], dict[int, Floats]]:
        """The frames' axes, in rows, and angular velocities: 2 w = sum of a_i x a_i', since a_i' = w x a_i.

        A frame without orientation has the axes of its parent.
        """
        axes, turning = {INERTIAL: np.eye(3)}, {INERTIAL: np.zeros(3)}
        frames = self.kinematics.mechanism.frames
        for number, dcm, rates in self._dcms:
            parent = frames[number].parent
            rows, row_rates = values[dcm].reshape(3, 3), values[rates].reshape(3, 3)
            axes[number] = rows @ axes[parent]
            turning[number] = turning[parent] + np.cross(rows, row_rates).sum(axis=0) / 2.0 @ axes[parent]
        for number in self._unoriented:
            axes[number] = axes[frames[number].parent]
        return axes, turning


def _of_frames(numbers: _Numbers) -> Iterator[_Claim]:
    kinematics, mechanism = numbers.kinematics, numbers.kinematics.mechanism
    needed = [frame for body in mechanism.bodies for frame in (body.frame, body.inertia_frame) if frame is not None]
    needed += [load.target for load in mechanism.loads if load.kind == "torque"]
    for number in dict.fromkeys(needed):
        frame = mechanism.frames[number]
        if number not in kinematics.turning_as_oriented and frame.dcm is not None:
            yield _Claim(
                f"The angular velocity that was set for frame {frame.name} differs from the one that follows from its "
                "orientation, in rad/s; the equations use the one that was set.",
                numbers.vector(((number, kinematics.angular_velocity(number)),)),
                (numbers.angular_velocity(number),),
            )


def _of_points(numbers: _Numbers) -> Iterator[_Claim]:
    kinematics, mechanism = numbers.kinematics, numbers.kinematics.mechanism
    centres = [body.point for body in mechanism.bodies]
    forced = [load.target for load in mechanism.loads if load.kind == "force"]
    asked = [*dict.fromkeys((*centres, *forced))]
    origin = mechanism.fixed_point if mechanism.fixed_point is not None else _fixed_point(kinematics)
    for point in asked:  # it grows by the points that others are compared with
        if kinematics.moves_as_placed(point):
            continue
        velocity, is_centre = kinematics.velocity(point), point in centres
        offsets = None if origin is None else _offsets(kinematics, point, origin)
        if offsets is not None:
            base = None
            follows: tuple[_Evaluated, ...] = (numbers.rate_of_vector(offsets),)
        else:
            base = _before(kinematics, point)
            offsets = None if base is None else _offsets(kinematics, point, base)
            if base is None or offsets is None:
                continue
            asked += [base] if base not in asked else []
            before, change = numbers.vector(kinematics.velocity(base)), numbers.rate_of_vector(offsets)
            follows = (_sum(before, change), *_of_turning(numbers, before, offsets, change))
        if not is_centre:
            # A contact force on a wheel acts on the material point that is in contact at this instant.
            follows += tuple(_of_bodies(numbers, point))
        if velocity or is_centre:
            name = mechanism.points[point].name
            yield _Claim(
                f"The velocity that was set for point {name} differs from the one that follows from its position"
                f"{f' relative to point {mechanism.points[base].name}' if base is not None else ''}, in m/s; the "
                "equations use the one that was set.",
                numbers.vector(velocity),
                follows,
            )


def _fixed_point(kinematics: Kinematics) -> int | None:
    """A point of a KanesMethod that is fixed: at rest, and another one leaves it with the rate of its position.

    A contact point, at rest for a moment, has other points at constant distances.
    """
    points, tape = kinematics.mechanism.points, kinematics.tape
    for number in kinematics.moving:
        parent = points[number].parent
        if parent is None or not kinematics.moves_as_placed(number) or kinematics.moves(parent):
            continue
        offset = kinematics.express(kinematics.vector(points[number].offset), INERTIAL)
        if not all(is_zero(tape, [kinematics.rate(dot(offset, offset))])):
            while (before := points[parent].parent) is not None:
                parent = before
            return parent
    return None


def _before(kinematics: Kinematics, point: int) -> int | None:
    """The nearest ancestor in the tree of positions whose velocity is known."""
    points, moving = kinematics.mechanism.points, kinematics.moving
    parent = points[point].parent
    while parent is not None and parent not in moving:
        parent = points[parent].parent
    return parent


def _offsets(kinematics: Kinematics, point: int, origin: int | None) -> Vector | None:
    """The position of a point relative to an ancestor in the tree of positions; None if that is unknown."""
    points, path = kinematics.mechanism.points, [point]
    while path[-1] != origin:
        parent = points[path[-1]].parent
        if parent is None:
            return None
        path.append(parent)
    try:
        return tuple(part for member in path[:-1] for part in kinematics.vector(points[member].offset))
    except ModelError:  # symbols that the equations do not know
        return None


def _of_bodies(numbers: _Numbers, point: int) -> Iterator[_Evaluated]:
    """The velocity of each body's material point at the position of a point: v + w x r from the mass centre."""
    kinematics, root = numbers.kinematics, point
    while (parent := kinematics.mechanism.points[root].parent) is not None:
        root = parent
    offsets = _offsets(kinematics, point, root)
    for body in kinematics.mechanism.bodies:
        from_root = _offsets(kinematics, body.point, root)
        if body.frame is not None and offsets is not None and from_root is not None:
            place, centre = numbers.vector(offsets), numbers.vector(from_root)
            yield _rigid(place, centre, numbers.vector(kinematics.velocity(body.point)), _turning(numbers, body.frame))


def _of_turning(numbers: _Numbers, velocity: _Evaluated, offsets: Vector, change: _Evaluated) -> Iterator[_Evaluated]:
    """For each body, the velocity of a point fixed in it, at an offset of constant length from another point."""
    place, origin = numbers.vector(offsets), numbers.vector(())
    for body in numbers.kinematics.mechanism.bodies:
        if body.frame is not None:
            yield _where_constant(_rigid(place, origin, velocity, _turning(numbers, body.frame)), place, change)


def _turning(numbers: _Numbers, frame: int) -> _Evaluated:
    """The angular velocity that was set."""
    return numbers.vector(((frame, numbers.kinematics.angular_velocity(frame)),))


def _rigid(place: _Evaluated, centre: _Evaluated, velocity: _Evaluated, turning: _Evaluated) -> _Evaluated:
    return lambda *at: velocity(*at) + np.cross(turning(*at), place(*at) - centre(*at))


def _sum(a: _Evaluated, b: _Evaluated) -> _Evaluated:
    return lambda *at: a(*at) + b(*at)


def _where_constant(vector: _Evaluated, offset: _Evaluated, change: _Evaluated) -> _Evaluated:
    """A vector where the length of an offset is constant; NaN elsewhere."""

    def evaluated(*at: Any) -> Floats:
        r, rate = offset(*at), change(*at)
        size = max(float(np.linalg.norm(rate)), MIN_MAGNITUDE)
        is_constant = abs(r @ rate) <= AGREEMENT_RTOL * np.linalg.norm(r) * size
        return vector(*at) if is_constant else np.full(3, np.nan)

    return evaluated


def _of_accelerations(numbers: _Numbers, total_rate: Jvp, convert: Conversion) -> Iterator[_Claim]:
    kinematics = numbers.kinematics
    of_point = Accumulated(kinematics, partial(kinematics.derivative, total_rate))

    def of_frame(frame: int) -> Vector:
        return ((frame, kinematics.derivative(total_rate, frame, kinematics.angular_velocity(frame))),)

    for body in kinematics.mechanism.bodies:
        name = kinematics.mechanism.points[body.point].name
        what = f"The acceleration that was set for point {name} (by a2pt_theory, for example)", "velocity, in m/s^2"
        yield from _of_acceleration(numbers, body.acceleration, partial(of_point, body.point), *what, convert)
        if body.frame is not None:
            name = kinematics.mechanism.frames[body.frame].name
            what = f"The angular acceleration that was set for frame {name}", "angular velocity, in rad/s^2"
            follows = partial(of_frame, body.frame)
            yield from _of_acceleration(numbers, body.angular_acceleration, follows, *what, convert)


def _of_acceleration(
    numbers: _Numbers,
    given: stored.Vector | None,
    follows: Callable[[], Vector],
    what: str,
    whose: str,
    convert: Conversion,
) -> Iterator[_Claim]:
    kinematics = numbers.kinematics
    if given is None:
        return
    try:
        was_set = kinematics.vector(given, convert)
    except ModelError:  # symbols that the equations do not know
        return
    both = [kinematics.express(vector, INERTIAL) for vector in (was_set, follows())]
    if not all(is_zero(kinematics.tape, [a - b for a, b in zip(*both, strict=True)])):
        first, second = (numbers.vector(((INERTIAL, components),)) for components in both)
        yield _Claim(
            f"{what} differs from the one that follows from its {whose}; the equations use the latter, SymPy's use the "
            "former.",
            first,
            (second,),
        )


def _of_acceleration_constraints(numbers: _Numbers, convert: Conversion) -> Iterator[_Claim]:
    given = numbers.kinematics.mechanism.acceleration_constraints
    if given:
        try:
            left = numbers.place([convert(expr) for expr in given])
        except ModelError:  # symbols that the equations do not know
            return
        yield _Claim(
            "The acceleration constraints that were given are not the rates of the velocity constraints; the equations "
            "use the latter, SymPy's use the former. Their residuals are compared with zero, for accelerations that "
            "keep the velocity constraints.",
            lambda values, *_: values[left],
            (lambda *_: np.zeros(len(given)),),
        )
