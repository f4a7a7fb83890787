"""Products with M and its inverse by the articulated-body algorithm, without forming M.

The partial velocities of bodies follow from those of other bodies and from a few speeds each,

    w_f = R w_reference + W u,        v_p = R v_base + w_f x r + D u.

Twice the kinetic energy of partial velocities y, u^T M u = y^T B y, is a quadratic form in their components; B has one
block for each body. From the ends of the trees inwards, each partial velocity is replaced by those it follows from,
B' = T^T B T, and each speed is eliminated as soon as no other one depends on it, B' = B - b b^T / d. What is left then
for one body is the inertia of an articulated body. No structure of joints is assumed: absolute angular rates, several
speeds at a joint and floating bases are cases of the same elimination. A speed that acts at several places remains up
to the last of them; if all speeds do, this is the elimination of the dense M. Structural zeros stay zeros on the tape,
and the number of operations is proportional to the number of bodies.

Source: R. Featherstone, *Rigid Body Dynamics Algorithms*, 2008, chapter 7 (articulated-body algorithm). As a sparse
elimination: D. Baraff, "Linear-time dynamics using Lagrange multipliers", *SIGGRAPH 96*, section 6.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import sympy as sm

from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Kinematics, Rotation
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.tape import Call, Scalar

__all__ = ["ArticulatedBodies", "MasslessError"]


class MasslessError(ArithmeticError):
    """A speed moves no mass: M is singular everywhere."""


class _Motion(NamedTuple):
    """A partial velocity along the axes of a frame.

    Attributes
    ----------
    kind : {"w", "v"}
        Angular velocity of a frame, or velocity of a point after one of its steps.
    of, step : int
        The frame, with step 0; or the point and its step.
    axes : int
    """

    kind: str
    of: int
    step: int
    axes: int


class _Component(NamedTuple):
    """A component of a partial velocity."""

    motion: _Motion
    axis: int


_Variable = _Component | int
"""A component of a partial velocity, or the number of a speed."""
_Terms = dict[_Variable, Scalar]
"""A linear combination."""


@dataclass(frozen=True)
class _Substitution:
    """Components of partial velocities as linear combinations of others and of speeds."""

    terms: dict[_Component, _Terms]


@dataclass(frozen=True)
class _Elimination:
    """A speed, one over its pivot, and the multiples of the other variables in its row."""

    speed: int
    inverse: Scalar
    multiples: _Terms


@dataclass(frozen=True)
class _Turn:
    """A rotation about one axis: a' = c a + s b, b' = -s a + c b."""

    a: int
    b: int
    sine: Scalar
    cosine: Scalar


class ArticulatedBodies:
    """The elimination of all speeds of a mechanism.

    Parameters
    ----------
    kinematics : Kinematics
    speeds : sequence of Scalar
        The leaves of the generalized speeds.
    masses : sequence of Scalar
    inertias : sequence of Rotation or None
        Those of the bodies.

    Attributes
    ----------
    pivots : dict of int to Scalar
        The pivot of each speed, positive where M is positive definite.

    Raises
    ------
    MasslessError
        If a speed moves no mass.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        speeds: Sequence[Scalar],
        masses: Sequence[Scalar],
        inertias: Sequence[Rotation | None],
    ) -> None:
        self.kinematics = kinematics
        self.tape = kinematics.tape
        self.pivots: dict[int, Scalar] = {}
        self._speeds = tuple(speeds)
        self._along = [Jvp(self.tape, {speed: self.tape.one}) for speed in speeds]
        # Velocities of points along the axes of their own frames take fewer operations in chains of joints; along the
        # inertial axes, if the angular rates are absolute.
        self._local = any(
            self._turns(frame.reference) for frame in kinematics.mechanism.frames if frame.angular_velocity is not None
        )
        self._known: dict[_Motion, list[_Terms]] = {}
        self._form: dict[_Variable, _Terms] = {}  # B, row by row
        self._steps: list[_Substitution | _Elimination] = []
        self._inertia: list[tuple[_Component, _Component, Scalar]] = []  # B at first, on and below the diagonal
        for body, mass, inertia in zip(kinematics.mechanism.bodies, masses, inertias, strict=True):
            velocity = self._velocity_of(body.point)
            if velocity is not None and self._moves(velocity):
                self._inertia += [(_Component(velocity, i), _Component(velocity, i), mass) for i in range(3)]
            if inertia is None:
                continue
            assert body.frame is not None
            assert body.inertia_frame is not None
            turn = _Motion("w", body.frame, 0, body.inertia_frame)
            if self._moves(turn):
                components = [_Component(turn, i) for i in range(3)]
                self._inertia += [(components[i], components[j], inertia[i][j]) for i in range(3) for j in range(i + 1)]
        for a, b, value in self._inertia:
            self._add(a, b, value)
        self._eliminate_all()

    def solve(self, side: Sequence[Scalar]) -> list[Scalar]:
        """M^-1 times a vector."""
        tape = self.tape
        sides: dict[_Variable, list[Scalar]] = {r: [value] for r, value in enumerate(side)}
        scaled: dict[int, Scalar] = {}
        for step in self._steps:
            if isinstance(step, _Substitution):
                self._project(step, sides)
                continue
            value = tape.sum(sides.pop(step.speed))
            scaled[step.speed] = value * step.inverse
            for other, factor in step.multiples.items():
                sides.setdefault(other, []).append(-(factor * value))
        found: dict[_Variable, Scalar] = {}
        for step in reversed(self._steps):
            if isinstance(step, _Substitution):
                self._follow(step, found)
            else:
                terms = [-(factor * found[other]) for other, factor in step.multiples.items()]
                found[step.speed] = tape.sum([scaled[step.speed], *terms])
        return [found[r] for r in range(len(side))]

    def multiply(self, speeds: Sequence[Scalar]) -> list[Scalar]:
        """M times a vector."""
        tape = self.tape
        found: dict[_Variable, Scalar] = dict(enumerate(speeds))
        substitutions = [step for step in self._steps if isinstance(step, _Substitution)]
        for step in reversed(substitutions):
            self._follow(step, found)
        sides: dict[_Variable, list[Scalar]] = {}
        for a, b, value in self._inertia:
            sides.setdefault(a, []).append(value * found[b])
            if a != b:
                sides.setdefault(b, []).append(value * found[a])
        for step in substitutions:
            self._project(step, sides)
        return [tape.sum(sides.get(r, ())) for r in range(len(speeds))]

    def _follow(self, step: _Substitution, found: dict[_Variable, Scalar]) -> None:
        """Values of partial velocities from those they follow from."""
        for component, combination in step.terms.items():
            found[component] = self.tape.sum([found[v] * factor for v, factor in combination.items()])

    def _project(self, step: _Substitution, sides: dict[_Variable, list[Scalar]]) -> None:
        """Forces along partial velocities as forces along those they follow from."""
        for component, combination in step.terms.items():
            value = self.tape.sum(sides.pop(component, ()))
            for variable, factor in combination.items():
                sides.setdefault(variable, []).append(value * factor)

    # ---- how partial velocities follow from others

    def _velocity_of(self, point: int, step: int | None = None) -> _Motion | None:
        """The velocity of a point, after all its steps by default, in its home; None if the point is at rest."""
        base, parts = self.kinematics.step(point)
        last = len(parts) - 1 if step is None else step
        if last >= 0:
            return _Motion("v", point, last, parts[last][0] if self._local else INERTIAL)
        return None if base is None else self._velocity_of(base)

    def _turns(self, frame: int) -> bool:
        """Whether an angular velocity depends on the speeds."""
        return frame != INERTIAL and self.tape.depends(self.kinematics.angular_velocity(frame), self._speeds)

    def _moves(self, motion: _Motion) -> bool:
        return any(self._rows(motion))

    def _rows(self, motion: _Motion) -> list[_Terms]:
        """What the three components of a partial velocity follow from."""
        known = self._known.get(motion)
        if known is None:
            home = self._home(motion)
            if home == motion.axes:
                known = self._angular_velocity(motion) if motion.kind == "w" else self._velocity(motion)
            else:
                kinematics = self.kinematics
                before = motion._replace(axes=kinematics.neighbour(motion.axes, home))
                rotation = kinematics.turn(before.axes, motion.axes)
                known = [
                    {_Component(before, j): entry for j, entry in enumerate(row) if entry and self._moves(before)}
                    for row in rotation
                ]
            self._known[motion] = known
        return known

    def _home(self, motion: _Motion) -> int:
        """The axes in which a partial velocity follows from others; in other axes, it is turned."""
        if motion.kind == "w":
            return motion.of
        _, parts = self.kinematics.step(motion.of)
        return parts[motion.step][0] if self._local else INERTIAL

    def _angular_velocity(self, motion: _Motion) -> list[_Terms]:
        kinematics, frame = self.kinematics, motion.of
        if frame == INERTIAL:
            return [{}, {}, {}]
        rows = self._of_speeds(kinematics.express(kinematics.relative_angular_velocity(frame), frame))
        self._include(rows, motion._replace(of=kinematics.mechanism.frames[frame].reference))
        return rows

    def _velocity(self, motion: _Motion) -> list[_Terms]:
        kinematics, axes = self.kinematics, motion.axes
        base, parts = kinematics.step(motion.of)
        frame, components = parts[motion.step]
        if base is None:
            rows = self._of_speeds(kinematics.express(((frame, components),), axes))
            before = self._velocity_of(motion.of, motion.step - 1) if motion.step else None
        else:
            _, offset = kinematics.vector(kinematics.mechanism.points[motion.of].offset)[motion.step]
            x, y, z = offset
            rates = (kinematics.rate(x), kinematics.rate(y), kinematics.rate(z))
            rows = self._of_speeds(kinematics.express(((frame, rates),), axes))
            turn = _Motion("w", frame, 0, frame)
            if self._moves(turn):
                zero = self.tape.zero
                # The columns of w x r = -r x w.
                arms = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
                for j, arm in enumerate(arms):
                    for row, entry in zip(rows, kinematics.express(((frame, arm),), axes), strict=True):
                        if entry:
                            row[_Component(turn, j)] = entry
            before = self._velocity_of(motion.of, motion.step - 1) if motion.step else self._velocity_of(base)
        if before is not None:
            self._include(rows, before._replace(axes=axes))
        return rows

    def _of_speeds(self, components: Components) -> list[_Terms]:
        rows: list[_Terms] = []
        for entry in components:
            rates = ((r, along(entry)) for r, along in enumerate(self._along))
            rows.append({r: rate for r, rate in rates if rate})
        return rows

    def _include(self, rows: Sequence[_Terms], motion: _Motion) -> None:
        if self._moves(motion):
            for axis, row in enumerate(rows):
                row[_Component(motion, axis)] = self.tape.one

    # ---- elimination

    def _eliminate_all(self) -> None:
        """Replace partial velocities, and eliminate speeds, from the ends of the trees inwards."""
        before = {motion: self._motions_before(motion) for motion in self._needed()}
        waiting = Counter(other for others in before.values() for other in others)
        places = Counter(speed for motion in before for speed in self._speeds_in(motion))
        ready = [motion for motion in before if not waiting[motion]]
        while ready:
            # Turns come last, after the elimination of the speeds at a joint: this leaves zeros for its axis.
            steps = [motion for motion in ready if self._home(motion) == motion.axes]
            group = steps[:1] or self._turning_alike(ready)
            self._replace(group)
            for motion in group:
                ready.remove(motion)
                for other in before[motion]:
                    waiting[other] -= 1
                    if not waiting[other]:
                        ready.append(other)
                for speed in self._speeds_in(motion):
                    places[speed] -= 1
                    if not places[speed]:
                        self._eliminate(speed)
        if len(self.pivots) < len(self._along):
            raise MasslessError

    def _needed(self) -> list[_Motion]:
        """The partial velocities of bodies, and all that these follow from."""
        found: dict[_Motion, None] = {}
        stack = [a.motion for a, _, _ in reversed(self._inertia)]
        while stack:
            motion = stack.pop()
            if motion not in found:
                found[motion] = None
                stack += self._motions_before(motion)
        return [*found]

    def _motions_before(self, motion: _Motion) -> list[_Motion]:
        variables = (v for row in self._rows(motion) for v in row)
        return [*dict.fromkeys(v.motion for v in variables if isinstance(v, _Component))]

    def _speeds_in(self, motion: _Motion) -> list[int]:
        return [*dict.fromkeys(v for row in self._rows(motion) for v in row if isinstance(v, int))]

    def _turning_alike(self, ready: Sequence[_Motion]) -> list[_Motion]:
        """Motions that are turned between the same axes."""
        kinematics = self.kinematics
        ways = [(kinematics.neighbour(motion.axes, self._home(motion)), motion.axes) for motion in ready]
        return [motion for motion, way in zip(ready, ways, strict=True) if way == ways[0]]

    def _replace(self, group: Sequence[_Motion]) -> None:
        """Replace motions by what they follow from."""
        terms = {_Component(motion, axis): row for motion in group for axis, row in enumerate(self._rows(motion))}
        self._steps.append(_Substitution(terms))
        turn = self._turn(group[0])
        if turn is None:
            self._transform(terms)
        else:
            self._rotate([(motion, self._motions_before(motion)[0]) for motion in group], turn)
        self._remove(terms)

    def _turn(self, motion: _Motion) -> _Turn | None:
        """The rotation from which a motion follows, if that is one about an axis by an angle."""
        home = self._home(motion)
        if home == motion.axes:
            return None
        rotation = self.kinematics.turn(self.kinematics.neighbour(motion.axes, home), motion.axes)
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            c, s = rotation[a][a], rotation[a][b]
            fixed = (rotation[k][a], rotation[k][b], rotation[a][k], rotation[b][k])
            alike = rotation[b][b] == c and rotation[b][a] == -s and rotation[k][k] == self.tape.one
            if alike and not any(fixed) and self._are_of_one_angle(s, c):
                return _Turn(a, b, s, c)
        return None

    def _are_of_one_angle(self, sine: Scalar, cosine: Scalar) -> bool:
        """Whether two scalars are the sine and cosine of the same angle, so that their squares add up to 1."""
        x, y = self.tape.nodes[sine.node], self.tape.nodes[cosine.node]
        if not isinstance(x, Call) or not isinstance(y, Call) or (abs(sine.coefficient), cosine.coefficient) != (1, 1):
            return False
        functions = isinstance(x.expression, sm.sin) and isinstance(y.expression, sm.cos)
        return functions and x.arguments == y.arguments and x.expression.args == y.expression.args

    def _transform(self, terms: Mapping[_Component, _Terms]) -> None:
        """B' = T^T B T, besides the rows and columns that are removed."""
        form, tape = self._form, self.tape
        parts: dict[tuple[_Variable, _Variable], list[Scalar]] = {}
        for component, combination in terms.items():
            # The products B T of this row; twice those with other variables, since B is symmetric.
            products: dict[_Variable, list[Scalar]] = {}
            for other, value in form.get(component, {}).items():
                if isinstance(other, _Component) and other in terms:
                    for variable, factor in terms[other].items():
                        products.setdefault(variable, []).append(value * factor)
                    continue
                for variable, factor in combination.items():
                    product = value * factor
                    parts.setdefault((other, variable), []).append(product)
                    parts.setdefault((variable, other), []).append(product)
            for variable, values in products.items():
                total = tape.sum(values)
                for other, factor in combination.items():
                    parts.setdefault((other, variable), []).append(total * factor)
        for (a, b), values in parts.items():
            if a == b or (b, a) not in parts or _comes_first(a, b):
                self._add(a, b, tape.sum(values))

    def _rotate(self, pairs: Sequence[tuple[_Motion, _Motion]], turn: _Turn) -> None:
        """The same for rotations about one axis of several motions at once.

        With g = s (A - D) + c (C + E), a block [[A, C], [E, D]] becomes [[A - s g, c g - E], [c g - C, D + s g]], since
        its trace, and the difference of C and E, do not change.
        """
        form, zero = self._form, self.tape.zero
        a, b, s, c = turn.a, turn.b, turn.sine, turn.cosine
        k = 3 - a - b
        turned = dict(pairs)

        def entry(x: _Variable, y: _Variable) -> Scalar:
            return form.get(x, {}).get(y, zero)

        new: list[tuple[_Variable, _Variable, Scalar]] = []

        def turn_row(x: _Variable, to: _Variable, motion: _Motion) -> None:
            first, second = entry(x, _Component(motion, a)), entry(x, _Component(motion, b))
            after = turned[motion]
            new.append((to, _Component(after, a), first * c - second * s))
            new.append((to, _Component(after, b), first * s + second * c))

        for i, (motion, after) in enumerate(pairs):
            for other, other_after in pairs[: i + 1]:
                aa, ac, ca, cc = (entry(_Component(motion, x), _Component(other, y)) for x in (a, b) for y in (a, b))
                kk = entry(_Component(motion, k), _Component(other, k))
                g = (aa - cc) * s + (ac + ca) * c
                new.append((_Component(after, a), _Component(other_after, a), aa - s * g))
                new.append((_Component(after, b), _Component(other_after, b), cc + s * g))
                new.append((_Component(after, a), _Component(other_after, b), c * g - ca))
                new.append((_Component(after, k), _Component(other_after, k), kk))
                turn_row(_Component(motion, k), _Component(after, k), other)
                if motion != other:
                    new.append((_Component(after, b), _Component(other_after, a), c * g - ac))
                    turn_row(_Component(other, k), _Component(other_after, k), motion)
            coupled = dict.fromkeys(x for axis in range(3) for x in form.get(_Component(motion, axis), {}))
            for x in coupled:
                if isinstance(x, _Component) and x.motion in turned:
                    continue
                begin = len(new)
                turn_row(x, x, motion)
                new.append((x, _Component(after, k), entry(x, _Component(motion, k))))
                # Where x is a component of `after`, the entry is on the diagonal, and comes from both sides of it.
                new[begin:] = [(x, y, value * 2 if x == y else value) for x, y, value in new[begin:]]
        for x, y, value in new:
            self._add(x, y, value)

    def _eliminate(self, speed: int) -> None:
        """B' = B - b b^T / d."""
        row = self._form.get(speed, {})
        pivot = row.get(speed)
        if pivot is None:
            raise MasslessError
        self.pivots[speed] = pivot
        inverse = self.tape.power(pivot, -1)
        others = [(variable, value) for variable, value in row.items() if variable != speed]
        multiples = {variable: value * inverse for variable, value in others}
        self._steps.append(_Elimination(speed, inverse, multiples))
        self._remove([speed])
        for i, (a, _) in enumerate(others):
            for b, value in others[: i + 1]:
                self._add(a, b, -(multiples[a] * value))

    def _add(self, a: _Variable, b: _Variable, value: Scalar) -> None:
        """Add to an entry of B and to the one across the diagonal."""
        for x, y in {(a, b), (b, a)}:
            row = self._form.setdefault(x, {})
            total = row[y] + value if y in row else value
            if total:
                row[y] = total
            else:
                row.pop(y, None)

    def _remove(self, variables: Iterable[_Variable]) -> None:
        for variable in variables:
            for other in self._form.pop(variable, {}):
                if other != variable:
                    self._form[other].pop(variable, None)


def _comes_first(a: _Variable, b: _Variable) -> bool:
    """An order of variables, to count a pair once."""
    return _rank(a) < _rank(b)


def _rank(variable: _Variable) -> tuple[object, ...]:
    return (0, variable) if isinstance(variable, int) else (1, *variable.motion, variable.axis)
