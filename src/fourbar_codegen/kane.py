"""Mass matrix, forcing and energies by Kane's method, from the vectors as SymPy stores them.

Nothing is expanded: a vector stays a sum of components in the frames it was written in, and goes through
the direction cosines of neighbouring frames only where a dot product needs one common frame.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.mechanism import Body, Components, Mechanism, Vector
from fourbar_codegen.tape import Direction, Tape

__all__ = ["Kane"]

INERTIAL = 0
ZERO: Components = (sm.S.Zero, sm.S.Zero, sm.S.Zero)
Rotation = tuple[Components, Components, Components]


@dataclass(frozen=True)
class _Inertia:
    """A momentum, times `weight`: of the mass centre, or about it.

    Attributes
    ----------
    weight : Expr
    partials : list of Vector
        Partial velocities, or partial angular velocities, with respect to all speeds.
    momenta : list of Vector
        What the momentum gains with each speed, auxiliary ones apart.
    rate : Vector
        The momentum's rate in the inertial frame for u' = 0.
    """

    weight: sm.Expr
    partials: Sequence[Vector]
    momenta: Sequence[Vector]
    rate: Vector


class Kane:
    """The kinetics of a mechanism on a tape.

    Parameters
    ----------
    tape : Tape
    mechanism : Mechanism
    leaves : mapping of Basic to Expr
        What stands on the tape for the System's symbols, coordinates' rates included.
    auxiliary : mapping of Basic to Symbol
        What stands there for the auxiliary speeds, where they are not zero: in partial velocities.
    along_u : sequence of Direction
        Differentiation with respect to each generalized speed, then each auxiliary one.
    rate : Direction
        Differentiation with respect to time while the speeds are held.
    """

    def __init__(
        self,
        tape: Tape,
        mechanism: Mechanism,
        leaves: Mapping[sm.Basic, sm.Expr],
        auxiliary: Mapping[sm.Basic, sm.Symbol],
        along_u: Sequence[Direction],
        rate: Direction,
    ) -> None:
        self.tape = tape
        self.mechanism = mechanism
        self.leaves = leaves
        self.leaves_of_partials = {**leaves, **auxiliary}
        self.n_u = len(along_u) - len(auxiliary)
        self.along_u = along_u
        self.rate = rate
        self._rotations: dict[tuple[int, int], Rotation] = {}
        self._in_frame: dict[tuple[Vector, int], Components] = {}

    def use_poisson_rates(self) -> None:
        """Let `rate` take the rates of direction cosines from the angular velocities.

        Poisson's equations, R* = R [w x] (Kane, Likins and Levinson, *Spacecraft Dynamics*, 1983, chapter 1),
        are far shorter than what the chain rule makes of products of direction cosines, and constraints are
        full of those. They hold where a frame's angular velocity is the one that follows from its orientation;
        where a user set another one (with a constraint substituted into it, say), the chain rule stays.
        """
        frames = self.mechanism.frames
        candidates = [
            number
            for number, frame in enumerate(frames)
            if number != INERTIAL
            and frame.angular_velocity is not None
            and frames[frame.parent].angular_velocity is not None
        ]
        # The rates of each frame's axes in its parent, by the chain rule and by the angular velocities.
        differences: list[sm.Expr] = []
        for number in candidates:
            parent = frames[number].parent
            relative = self._subtract(
                self._express(self._angular_velocity(number), parent),
                self._express(self._angular_velocity(parent), parent),
            )
            for axis in self._dcm(number):
                expected = self._cross(relative, axis)
                differences += [self.rate(x) - y for x, y in zip(axis, expected, strict=True)]
        vanishing = iter(self.tape.vanish(differences))
        consistent = {INERTIAL}
        for number in candidates:
            agree = [next(vanishing) for _ in range(9)]
            if all(agree) and frames[number].parent in consistent:
                consistent.add(number)
                angular_velocity = self._express(self._angular_velocity(number), number)
                for row in self._rotation(number, INERTIAL):
                    for entry, derivative in zip(row, self._cross(row, angular_velocity), strict=True):
                        self.rate.give(entry, derivative)

    def mass_matrix_and_forcing(self) -> tuple[list[list[sm.Expr]], list[sm.Expr]]:
        """M, shape (n_u, n_u), and f, shape (n_u,), of M u' = f.

        Source: Kane and Levinson 1985, sections 4.11 (generalized inertia forces) and 4.4 (active forces).
        """
        define, n_u = self.tape.define, self.n_u
        inertias = self._inertias()
        active = self.active_forces()
        lower = [
            [
                define(sm.Add(*(define(i.weight * self._dot(i.momenta[s], i.partials[r])) for i in inertias)))
                for s in range(r + 1)
            ]
            for r in range(n_u)
        ]
        forcing = [
            define(active[r] - sm.Add(*(define(i.weight * self._dot(i.partials[r], i.rate)) for i in inertias)))
            for r in range(n_u)
        ]
        return [[lower[max(r, s)][min(r, s)] for s in range(n_u)] for r in range(n_u)], forcing

    def balance(self, accelerations: Sequence[sm.Expr]) -> list[sm.Expr]:
        """The forces f - M u' for given u', shape (n_u + n_aux,), without M: of each body in each partial velocity.

        The rows of the auxiliary speeds, which are zero and stay so, stand last.

        Source: Kane and Levinson 1985, sections 4.11 and 4.9 (bringing noncontributing forces into evidence).
        """
        define = self.tape.define
        terms: list[list[sm.Expr]] = [[force] for force in self.active_forces()]
        for inertia in self._inertias():
            total = inertia.rate
            for momentum, acceleration in zip(inertia.momenta, accelerations, strict=True):
                total = self._sum(total, self._scale(acceleration, momentum))
            for row, partial in zip(terms, inertia.partials, strict=True):
                row.append(-define(inertia.weight * self._dot(partial, total)))
        return [define(sm.Add(*row)) for row in terms]

    def active_forces(self) -> list[sm.Expr]:
        """The sum of F . v_r + T . w_r over the loads, shape (n_u + n_aux,)."""
        terms: list[list[sm.Expr]] = [[] for _ in self.along_u]
        for load in self.mechanism.loads:
            vector = self._convert(load.vector)
            for row, partial in zip(terms, self._partials(load.velocity), strict=True):
                row.append(self._dot(vector, partial))
        return [self.tape.define(sm.Add(*row)) for row in terms]

    def _inertias(self) -> list[_Inertia]:
        """Translation and rotation of every body."""
        inertias = []
        for body in self.mechanism.bodies:
            mass = self.tape.convert(body.mass, self.leaves)
            velocity = self._convert(body.velocity)
            partials = self._partials(body.velocity)
            inertias.append(_Inertia(mass, partials, partials[: self.n_u], self._differentiate(velocity)))
            mass_rate = self.rate(mass)
            if mass_rate:
                inertias.append(_Inertia(mass_rate, partials, [()] * self.n_u, velocity))
            if body.inertia is not None:
                frame, inertia = self._inertia(body)
                stored = self._stored_angular_velocity(body.frame)
                partials = [((frame, self._express(partial, frame)),) for partial in self._partials(stored)]
                momenta = [((frame, self._multiply(inertia, partial[0][1])),) for partial in partials[: self.n_u]]
                momentum = self._multiply(inertia, self._express(self._convert(stored), frame))
                inertias.append(_Inertia(sm.S.One, partials, momenta, self._differentiate(((frame, momentum),))))
        return inertias

    def kinetic_energy(self) -> sm.Expr:
        """The sum of m v.v / 2 + w.I.w / 2 over the bodies."""
        terms = []
        for body in self.mechanism.bodies:
            mass = self.tape.convert(body.mass, self.leaves)
            velocity = self._convert(body.velocity)
            terms.append(mass * self._dot(velocity, velocity) / 2)
            if body.inertia is not None:
                frame, inertia = self._inertia(body)
                angular_velocity = self._express(self._angular_velocity(body.frame), frame)
                momentum = self._multiply(inertia, angular_velocity)
                terms.append(self._dot(((frame, momentum),), ((frame, angular_velocity),)) / 2)
        return self.tape.define(sm.Add(*(self.tape.define(term) for term in terms)))

    def potential_energy(self, given: sm.Expr | None, variables: Collection[sm.Symbol]) -> sm.Expr:
        """The given expression, or what the bodies carry, or -F.r of every constant force; NaN if not known.

        A force that is constant in the inertial frame has the potential -F.r, r the position of its point.
        `variables` are the leaves that may change during a motion.
        """
        if given is not None:
            return self.tape.convert(given, self.leaves)
        of_bodies = [self.tape.convert(body.potential_energy, self.leaves) for body in self.mechanism.bodies]
        if not all(term.is_zero for term in of_bodies):
            return self.tape.define(sm.Add(*of_bodies))
        terms = []
        for load in self.mechanism.loads:
            if load.kind == "torque" or not load.velocity:
                continue
            force = self._express(self._convert(load.vector), INERTIAL)
            if self.tape.depends(force, variables):
                continue
            if load.position is None:
                return sm.S.NaN
            terms.append(-self._dot(((INERTIAL, force),), self._convert(load.position)))
        return self.tape.define(sm.Add(*terms))

    # Vectors on the tape.

    def _convert(self, vector: Vector, leaves: Mapping[sm.Basic, sm.Expr] | None = None) -> Vector:
        leaves = self.leaves if leaves is None else leaves
        return tuple(
            (frame, _three([self.tape.convert(e, leaves) for e in components])) for frame, components in vector
        )

    def _angular_velocity(self, frame: int | None) -> Vector:
        return self._convert(self._stored_angular_velocity(frame))

    def _stored_angular_velocity(self, frame: int | None) -> Vector:
        assert frame is not None
        vector = self.mechanism.frames[frame].angular_velocity
        if vector is None:
            name = self.mechanism.frames[frame].name
            raise ModelError(f"The angular velocity of frame {name} is not defined: call {name}.set_ang_vel.")
        return vector

    def _inertia(self, body: Body) -> tuple[int, Rotation]:
        """The frame in whose axes the central inertia is given, and its matrix there."""
        assert body.inertia is not None
        assert body.inertia_frame is not None
        return body.inertia_frame, self._convert_matrix(body.inertia)

    def _rotation(self, source: int, target: int) -> Rotation:
        """The matrix that takes components in frame `source` to components in frame `target`.

        It goes up or down the tree of frames, one neighbour at a time, so that chains share their products.
        """
        known = self._rotations.get((source, target))
        if known is not None:
            return known
        frames = self.mechanism.frames
        if source == target:
            matrix: Rotation = tuple(_three([sm.Integer(i == j) for j in range(3)]) for i in range(3))  # type: ignore[assignment]
        elif target > source:
            # A parent's number is smaller than its child's: the greater one is not an ancestor of the other.
            above = self._rotation(source, frames[target].parent)
            matrix = self._product(self._dcm(target), above)
        else:
            matrix = _transpose(self._rotation(target, source))
        self._rotations[source, target] = matrix
        return matrix

    def _dcm(self, frame: int) -> Rotation:
        return self._convert_matrix(self.mechanism.frames[frame].dcm)

    def _convert_matrix(self, entries: Sequence[sm.Expr]) -> Rotation:
        converted = [self.tape.convert(entry, self.leaves) for entry in entries]
        return (_three(converted[0:3]), _three(converted[3:6]), _three(converted[6:9]))

    def _express(self, vector: Vector, frame: int) -> Components:
        """Components of a vector along the axes of one frame."""
        total = ZERO
        for source, components in vector:
            key = (((source, components),), frame)
            if key not in self._in_frame:
                self._in_frame[key] = self._multiply(self._rotation(source, frame), components)
            total = self._add(total, self._in_frame[key])
        return total

    def _partials(self, velocity: Vector) -> list[Vector]:
        """Derivatives of a velocity, as it is stored, with respect to all speeds."""
        velocity = self._convert(velocity, self.leaves_of_partials)
        partials = []
        for d in self.along_u:
            parts = [(frame, _three([d(entry) for entry in components])) for frame, components in velocity]
            partials.append(tuple(part for part in parts if part[1] != ZERO))
        return partials

    def _differentiate(self, vector: Vector) -> Vector:
        """The rate of a vector in the inertial frame, speeds held: in each part's frame, c* + w x c."""
        parts = []
        for frame, components in vector:
            angular_velocity = self._express(self._angular_velocity(frame), frame)
            rates = _three([self.rate(entry) for entry in components])
            parts.append((frame, self._add(rates, self._cross(angular_velocity, components))))
        return tuple(parts)

    def _dot(self, a: Vector, b: Vector) -> sm.Expr:
        """The dot product, in the frame that both vectors are written in or else in the inertial one."""
        frames = {frame for frame, _ in (*a, *b)}
        frame = frames.pop() if len(frames) == 1 else INERTIAL
        return self._inner(self._express(a, frame), self._express(b, frame))

    def _inner(self, a: Components, b: Components) -> sm.Expr:
        return self.tape.define(sm.Add(*(self.tape.define(x * y) for x, y in zip(a, b, strict=True))))

    def _scale(self, factor: sm.Expr, vector: Vector) -> Vector:
        return tuple(
            (frame, _three([self.tape.define(factor * c) for c in components])) for frame, components in vector
        )

    def _sum(self, a: Vector, b: Vector) -> Vector:
        total = dict(a)
        for frame, components in b:
            total[frame] = self._add(total[frame], components) if frame in total else components
        return tuple(total.items())

    def _cross(self, a: Components, b: Components) -> Components:
        define = self.tape.define
        return _three([define(define(a[i] * b[j]) - define(a[j] * b[i])) for i, j in ((1, 2), (2, 0), (0, 1))])

    def _add(self, a: Components, b: Components) -> Components:
        return _three([self.tape.define(x + y) for x, y in zip(a, b, strict=True)])

    def _subtract(self, a: Components, b: Components) -> Components:
        return _three([self.tape.define(x - y) for x, y in zip(a, b, strict=True)])

    def _multiply(self, matrix: Rotation, a: Components) -> Components:
        return _three([self._inner(row, a) for row in matrix])

    def _product(self, a: Rotation, b: Rotation) -> Rotation:
        columns = _transpose(b)
        return tuple(_three([self._inner(row, column) for column in columns]) for row in a)  # type: ignore[return-value]


def _three(entries: Sequence[sm.Expr]) -> Components:
    x, y, z = entries
    return x, y, z


def _transpose(matrix: Rotation) -> Rotation:
    return tuple(zip(*matrix, strict=True))  # type: ignore[return-value]
