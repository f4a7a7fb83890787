"""Rotations, angular velocities and velocities on a tape, formed along the trees of frames and points.

Nothing is expanded. A vector stays a sum of components in the frames it was written in. It is transformed with the
direction cosines of neighbouring frames only where a dot product needs a common frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.identities import is_zero
from fourbar_codegen.expressions.tape import Scalar, Tape
from fourbar_codegen.modeling import mechanism as stored
from fourbar_codegen.modeling.mechanism import Mechanism

__all__ = [
    "INERTIAL",
    "Accumulated",
    "Components",
    "Kinematics",
    "Rotation",
    "Vector",
    "add",
    "cross",
    "differentiate",
    "dot",
    "merged",
    "multiply",
    "negative",
    "scale",
]

INERTIAL = 0
Components = tuple[Scalar, Scalar, Scalar]
"""Components of a vector along the axes of one frame."""
Vector = tuple[tuple[int, Components], ...]
"""A sum of components, each in the frame of the given number."""
Rotation = tuple[Components, Components, Components]
Step = tuple[int | None, Vector | None]
UNKNOWN: Step = (None, None)


def dot(a: Components, b: Components) -> Scalar:
    """A . b, in one frame."""
    return a[0].tape.sum([x * y for x, y in zip(a, b, strict=True)])


def cross(a: Components, b: Components) -> Components:
    """A x b, in one frame."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def add(*vectors: Components) -> Components:
    """The sum of vectors in one frame."""
    return _three([entries[0].tape.sum(entries) for entries in zip(*vectors, strict=True)])


def scale(factor: Scalar, a: Components) -> Components:
    """A number times a vector."""
    return factor * a[0], factor * a[1], factor * a[2]


def multiply(matrix: Rotation, a: Components) -> Components:
    """A matrix times a vector."""
    return _three([dot(row, a) for row in matrix])


def differentiate(derivative: Callable[[Scalar], Scalar], a: Components) -> Components:
    """The derivatives of components."""
    return derivative(a[0]), derivative(a[1]), derivative(a[2])


def negative(a: Components) -> Components:
    """-a."""
    return -a[0], -a[1], -a[2]


def merged(vector: Sequence[tuple[int, Components]]) -> Vector:
    """A vector with one part in each frame."""
    parts: dict[int, Components] = {}
    for frame, components in vector:
        parts[frame] = add(parts[frame], components) if frame in parts else components
    return tuple((frame, components) for frame, components in parts.items() if any(components))


class Kinematics:
    """How the frames and points of a mechanism move.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    convert : Conversion
        Takes the System's symbols to the tape, rates of coordinates included.
    rate : callable
        Differentiation with respect to time, with u' = 0.
    """

    def __init__(self, tape: Tape, mechanism: Mechanism, convert: Conversion, rate: Callable[[Scalar], Scalar]) -> None:
        self.tape = tape
        self.mechanism = mechanism
        self.convert = convert
        self.zero: Components = (tape.zero,) * 3
        self.rate = rate
        self._rotations: dict[tuple[int, int], Rotation] = {}
        self._in_frame: dict[tuple[int, Components, int], Components] = {}
        self._angular_velocities: dict[int, Components] = {}
        self._steps: list[Step] = []
        self._form_steps()
        self.turning_as_oriented = frozenset({INERTIAL})  # their angular velocity follows from orientation
        self.velocity = Accumulated(self, lambda _, components: components)

    def vector(self, vector: stored.Vector, convert: Conversion | None = None) -> Vector:
        """A vector on the tape; a conversion may be given that knows more symbols."""
        convert = convert or self.convert
        return tuple((frame, _three([convert(e) for e in components])) for frame, components in vector)

    def matrix(self, entries: Sequence[sm.Expr]) -> Rotation:
        """A matrix of 9 entries on the tape."""
        converted = [self.convert(entry) for entry in entries]
        return _three(converted[0:3]), _three(converted[3:6]), _three(converted[6:9])

    def rotation(self, source: int, target: int) -> Rotation:
        """The matrix that takes components in frame `source` to components in frame `target`.

        It goes up or down the tree of frames, one neighbour at a time, so that chains share their products.
        """
        known = self._rotations.get((source, target))
        if known is None:
            frames = self.mechanism.frames
            if source == target:
                zero, one = self.tape.zero, self.tape.one
                known = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
            elif target > source:
                # A parent's number is smaller than its child's: the greater one is not an ancestor of the other.
                above = _transpose(self.rotation(source, frames[target].parent))
                known = _three_rows([[dot(row, column) for column in above] for row in self.dcm(target)])
            else:
                known = _transpose(self.rotation(target, source))
            self._rotations[source, target] = known
        return known

    def neighbour(self, frame: int, target: int) -> int:
        """The next frame on the way from a frame to another one, in the tree of frames."""
        at = target
        while at > frame:
            parent = self.mechanism.frames[at].parent
            if parent == frame:
                return at
            at = parent
        return self.mechanism.frames[frame].parent

    def turn(self, source: int, target: int) -> Rotation:
        """The same as `rotation`, for neighbours in the tree of frames."""
        return self.dcm(target) if target > source else _transpose(self.dcm(source))

    def dcm(self, frame: int) -> Rotation:
        """The direction cosines of a frame in its parent; the identity for a frame without orientation."""
        stored_dcm = self.mechanism.frames[frame].dcm
        return self.rotation(frame, frame) if stored_dcm is None else self.matrix(stored_dcm)

    def express(self, vector: Vector, frame: int) -> Components:
        """Components of a vector along the axes of one frame."""
        parts = []
        for source, components in vector:
            key = (source, components, frame)
            if key not in self._in_frame:
                self._in_frame[key] = (
                    components if source == frame else multiply(self.rotation(source, frame), components)
                )
            parts.append(self._in_frame[key])
        return add(self.zero, *parts)

    def express_stepwise(self, vector: Vector, frame: int) -> Components:
        """The same as `express`, from neighbour to neighbour in the tree of frames."""
        parts = []
        for source, components in vector:
            at, here = source, components
            while at != frame:
                before, at = at, self.neighbour(at, frame)
                key = (before, here, at)
                if key not in self._in_frame:
                    self._in_frame[key] = multiply(self.turn(before, at), here)
                here = self._in_frame[key]
            parts.append(here)
        return add(self.zero, *parts)

    def angular_velocity(self, frame: int) -> Components:
        """The angular velocity of a frame, in its own axes."""
        known = self._angular_velocities.get(frame)
        if known is None:
            reference = self.mechanism.frames[frame].reference
            relative = self.express(self.relative_angular_velocity(frame), frame)
            known = relative
            if frame != INERTIAL and reference != INERTIAL:
                known = add(multiply(self.rotation(reference, frame), self.angular_velocity(reference)), relative)
            self._angular_velocities[frame] = known
        return known

    def angular_velocity_in(self, frame: int, axes: int) -> Components:
        """The angular velocity of a frame along the axes of another one, by the relative ones between them."""
        difference: list[Components] = []
        a, b = frame, axes
        while a != b:
            further = max(a, b)
            relative = self.express(self.relative_angular_velocity(further), axes)
            reference = self.mechanism.frames[further].reference
            if further == a:
                difference.append(relative)
                a = reference
            else:
                difference.append(negative(relative))
                b = reference
        return add(self.angular_velocity(axes), *difference)

    def derivative(self, rate: Callable[[Scalar], Scalar], frame: int, components: Components) -> Components:
        """The derivative, in the inertial frame, of a vector that is written in a frame: r* + w x r."""
        return add(differentiate(rate, components), cross(self.angular_velocity(frame), components))

    def relative_angular_velocity(self, frame: int) -> Vector:
        """The angular velocity of a frame in its reference."""
        vector = self.mechanism.frames[frame].angular_velocity
        if vector is None:
            name = self.mechanism.frames[frame].name
            raise ModelError(f"The angular velocity of frame {name} is not defined: call {name}.set_ang_vel.")
        return self.vector(vector)

    def angular_velocity_in_parent(self, frame: int) -> Components:
        """The angular velocity of a frame relative to its parent, along the parent's axes."""
        stored_frame = self.mechanism.frames[frame]
        relative = self.express(self.relative_angular_velocity(frame), stored_frame.parent)
        if stored_frame.reference == stored_frame.parent:
            return relative
        return add(relative, negative(self.angular_velocity(stored_frame.parent)))

    def is_oriented(self, frame: int) -> bool:
        """Whether the orientation of a frame in the inertial one is known."""
        stored_frame = self.mechanism.frames[frame]
        return frame == INERTIAL or (stored_frame.dcm is not None and self.is_oriented(stored_frame.parent))

    def not_orthonormal(self) -> list[Scalar]:
        """Scalars that are zero where direction cosines are orthonormal, but not identically, as with quaternions."""
        entries: list[Scalar] = []
        for number, frame in enumerate(self.mechanism.frames):
            if number != INERTIAL and frame.dcm is not None:
                rows = self.dcm(number)
                products = [(dot(rows[i], rows[j]), i == j) for i in range(3) for j in range(i + 1)]
                entries += [product - self.tape.one if is_one else product for product, is_one in products]
        return [entry for entry, is_so in zip(entries, is_zero(self.tape, entries), strict=True) if not is_so]

    @property
    def moving(self) -> list[int]:
        """The points whose velocity is known; of others, only the position is needed."""
        return [point for point, step in enumerate(self._steps) if step != UNKNOWN]

    def step(self, point: int) -> tuple[int | None, Vector]:
        """A point's velocity: a base point whose velocity it includes, or None, and the vector to add."""
        base, parts = self._steps[point]
        assert parts is not None  # the reader has read all velocities that bodies and loads need
        return base, parts

    def dot(self, a: Vector, b: Vector) -> Scalar:
        """The dot product a . b, in the common frame of both, else in the inertial one."""
        frames = {frame for frame, _ in (*a, *b)}
        frame = frames.pop() if len(frames) == 1 else INERTIAL
        return dot(self.express(a, frame), self.express(b, frame))

    def home(self, point: int) -> int:
        """The frame that the last step to a point is written in; the inertial one if there is none."""
        base, parts = self.step(point)
        if parts:
            return parts[-1][0]
        return INERTIAL if base is None else self.home(base)

    def moves(self, point: int) -> bool:
        """Whether the velocity of a point may be nonzero."""
        base, parts = self.step(point)
        return any(any(components) for _, components in parts) or (base is not None and self.moves(base))

    def moves_as_placed(self, point: int) -> bool:
        """Whether the velocity of a point is known to be the rate of its position relative to a point at rest."""
        base, parts = self._steps[point]
        if base is None:
            return self.mechanism.points[point].parent is None and parts is not None and not self.moves(point)
        frames = {frame for frame, _ in self.mechanism.points[point].offset}
        return frames <= self.turning_as_oriented and self.moves_as_placed(base)

    def _form_steps(self) -> None:
        """Find the points whose velocity follows from that of their parent.

        Point b, at the offset r from point a, has v_b = v_a + r* + w x r in each frame that r is written in (Kane and
        Levinson 1985, section 2.7), unless a user set another velocity, for example with a constraint substituted into
        it. A numerical identity test decides.
        """
        differences: list[Components] = []
        tested: list[int] = []
        for number, point in enumerate(self.mechanism.points):
            given = None if point.velocity is None else self.vector(point.velocity)
            step: Step = (None, given)
            if point.parent is not None and self._steps[point.parent] != UNKNOWN:
                try:
                    step = (point.parent, self._rate_of_offset(point.offset))
                except ModelError:  # an offset may have symbols that the equations do not know
                    if point.derived:
                        raise
            self._steps.append(step)
            base, parts = step
            if given is not None and base is not None:
                tested.append(number)
                steps = [*self._path(base), *(parts or ()), *((f, negative(c)) for f, c in given)]
                difference = merged(steps)
                frame = difference[0][0] if len(difference) == 1 else INERTIAL
                differences.append(self.express(difference, frame))
        are_zero = iter(is_zero(self.tape, [entry for difference in differences for entry in difference]))
        for number in tested:
            entries = [next(are_zero) for _ in range(3)]
            if not all(entries):
                self._steps[number] = (None, self._path(number))

    def _path(self, point: int) -> Vector:
        """A point's velocity as SymPy has it, else by adding steps along the tree of points."""
        given = self.mechanism.points[point].velocity
        if given is not None:
            return self.vector(given)
        base, parts = self.step(point)
        return parts if base is None else (*self._path(base), *parts)

    def _rate_of_offset(self, offset: stored.Vector) -> Vector:
        return tuple((frame, self.derivative(self.rate, frame, c)) for frame, c in self.vector(offset))


class Accumulated:
    """A vector for each point: that of the preceding point, plus the contribution of the step between both.

    A vector in a single frame stays there. Others are added up in the inertial frame, or in the points' own ones, so
    that points share the sum over the common part of their paths.

    Parameters
    ----------
    kinematics : Kinematics
    added : callable
        Takes a frame, and components of a velocity step in it, to the components to add in that frame.
    local : bool, optional
        Whether to add up in the points' own frames, `Kinematics.home`. Along chains of joints this takes fewer
        operations, since a joint turns about one axis.
    """

    def __init__(
        self, kinematics: Kinematics, added: Callable[[int, Components], Components], *, local: bool = False
    ) -> None:
        self._kinematics = kinematics
        self._added = added
        self._local = local
        self._known: dict[int, Vector] = {}

    def __call__(self, point: int) -> Vector:
        """The vector of a point."""
        known = self._known.get(point)
        if known is None:
            kinematics = self._kinematics
            base, parts = kinematics.step(point)
            before = self(base) if base is not None else ()
            step = merged([(frame, self._added(frame, components)) for frame, components in parts])
            known = merged([*before, *step])
            if len(known) > 1:
                frame = kinematics.home(point) if self._local else INERTIAL
                express = kinematics.express_stepwise if self._local else kinematics.express
                known = ((frame, add(express(before, frame), express(step, frame))),)
            self._known[point] = known
        return known


def _three(entries: Sequence[Scalar]) -> Components:
    x, y, z = entries
    return x, y, z


def _three_rows(rows: Sequence[Sequence[Scalar]]) -> Rotation:
    x, y, z = map(_three, rows)
    return x, y, z


def _transpose(matrix: Rotation) -> Rotation:
    return _three_rows(list(zip(*matrix, strict=True)))
