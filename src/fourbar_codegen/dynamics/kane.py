"""Mass matrix, forcing and energies by Kane's method.

Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, chapters 4 to 6.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.articulated_bodies import ArticulatedBodies
from fourbar_codegen.dynamics.composite_bodies import CompositeBodies
from fourbar_codegen.dynamics.kinematics import (
    INERTIAL,
    Accumulated,
    Components,
    Kinematics,
    Rotation,
    Vector,
    add,
    cross,
    differentiate,
    dot,
    merged,
    multiply,
    negative,
    scale,
)
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import substitute
from fourbar_codegen.expressions.derivatives import Jvp, vjp
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.tape import Leaf, Scalar, Tape
from fourbar_codegen.modeling.mechanism import Body, Load, Mechanism

__all__ = ["AppliedLoad", "Kane", "loads_power"]

MIN_COMPOSITE = 8
"""If the largest composite has this many bodies, composites take fewer operations than the sum over bodies; with fewer
bodies, the operations of both are counted."""


@dataclass(frozen=True)
class Inertia:
    """A body's central inertia, and its angular velocity and momentum along the same axes.

    Attributes
    ----------
    frame : int
        The axes.
    matrix : Rotation
    angular_velocity, momentum : Components
    """

    frame: int
    matrix: Rotation
    angular_velocity: Components
    momentum: Components


@dataclass(frozen=True)
class AppliedLoad:
    """A load on the tape.

    Attributes
    ----------
    load : Load
    vector : Vector
    in_motion : Vector
        Without reactions, which stand in the rows of the auxiliary speeds alone.
    """

    load: Load
    vector: Vector
    in_motion: Vector


class Kane:
    """The kinetics of a mechanism on a tape.

    Parameters
    ----------
    tape : Tape
    kinematics, virtual : Kinematics
        Those of the mechanism; and with nonzero auxiliary speeds, for partial velocities.
    speeds, auxiliary : sequence of Scalar
        The leaves of the generalized speeds, and of the auxiliary ones.
    rate : Jvp
        Differentiation with respect to time, with u' = 0.
    reactions : sequence of Scalar, optional
        The leaves of forces that act between the two bodies of a joint.
    """

    def __init__(
        self,
        tape: Tape,
        kinematics: Kinematics,
        virtual: Kinematics,
        speeds: Sequence[Scalar],
        auxiliary: Sequence[Scalar],
        rate: Jvp,
        *,
        reactions: Sequence[Scalar] = (),
    ) -> None:
        self.tape = tape
        self.kinematics = kinematics
        self.virtual = virtual
        self.mechanism: Mechanism = kinematics.mechanism
        self.speeds = tuple(speeds)
        self.auxiliary = tuple(auxiliary)
        self.rate = rate
        self._masses = [kinematics.convert(body.mass) for body in self.mechanism.bodies]
        self._inertias = [self._inertia(body) for body in self.mechanism.bodies]
        self._reactions = tuple(reactions)
        self._directions: dict[Scalar, dict[str, list[Components]]] = {}

    @functools.cached_property
    def loads(self) -> tuple[AppliedLoad, ...]:
        """The mechanism's loads."""
        loads = self.mechanism.loads
        vectors = [self.kinematics.vector(load.vector) for load in loads]
        in_motion = [*vectors]
        for force in self._reactions:
            parts = [self.reaction(load, force) for load in loads]
            if not any(map(any, parts)):
                leaf = self.tape.nodes[force.node]
                assert isinstance(leaf, Leaf)
                raise ModelError(
                    f"{leaf.name} in reactions= acts along no auxiliary speed: the loads contain it in laws only, such "
                    "as friction, or at points that auxiliary speeds do not move."
                )
            in_motion = [
                self._without_reaction(vector, self._slope(load, force), part, force) if any(part) else vector
                for load, vector, part in zip(loads, in_motion, parts, strict=True)
            ]
        return tuple(map(AppliedLoad, loads, vectors, in_motion))

    def use_poisson_rates(self, rates: Iterable[Jvp]) -> None:
        """Let derivatives with respect to time take the rates of direction cosines from the angular velocities.

        Poisson's equations, R* = R [w x] (Kane, Likins and Levinson, *Spacecraft Dynamics*, 1983, chapter 1),
        are far shorter than the chain rule applied to products of direction cosines, which constraints are full
        of. They hold where a frame's angular velocity follows from its orientation. Where a user set another one
        (with a constraint substituted into it, for example), the chain rule is used.
        """
        kinematics, frames = self.kinematics, self.mechanism.frames
        rates = list(rates)
        known = [frame.angular_velocity is not None for frame in frames]
        candidates = [n for n, frame in enumerate(frames) if n != INERTIAL and known[n] and known[frame.parent]]
        # The rates of each frame's axes in its parent, by the chain rule and by the angular velocities.
        differences: list[Scalar] = []
        for number in candidates:
            relative = kinematics.angular_velocity_in_parent(number)
            for axis in kinematics.dcm(number):
                expected = cross(relative, axis)
                differences += [rates[0](x) - y for x, y in zip(axis, expected, strict=True)]
        are_zero = iter(is_zero(self.tape, differences))
        consistent = {INERTIAL}
        for number in candidates:
            agree = [next(are_zero) for _ in range(9)]
            if all(agree) and frames[number].parent in consistent:
                consistent.add(number)
                angular_velocity = kinematics.angular_velocity(number)
                for row in kinematics.rotation(number, INERTIAL):
                    for entry, derivative in zip(row, cross(row, angular_velocity), strict=True):
                        for rate in rates:
                            rate.give(entry, derivative)
        kinematics.turning_as_oriented = frozenset(consistent)

    def mass_matrix(self) -> list[list[Scalar]]:
        """M of M u' = f, shape (n_u, n_u).

        M_rs = sum of m v_r . v_s + w_r . I . w_s over the bodies, with partial velocities v_r = dv/du_r, w_r = dw/du_r.

        Source: Kane and Levinson 1985, section 4.11 (generalized inertia forces).
        """
        tape, n_u = self.tape, len(self.speeds)
        along = [Jvp(tape, {speed: tape.one}) for speed in self.speeds]
        composites = CompositeBodies(self.kinematics, along, self.rate)
        entries = self._entries_by_bodies(along, composites.entries())
        if composites.largest < MIN_COMPOSITE:
            apart = self._entries_by_bodies(along, {})
            entries = min(entries, apart, key=lambda e: tape.count_operations(e.values()))
        return [[entries[max(r, s), min(r, s)] for s in range(n_u)] for r in range(n_u)]

    def articulated_bodies(self) -> ArticulatedBodies:
        """The elimination of all speeds, without M; see `ArticulatedBodies`."""
        inertias = [None if inertia is None else inertia.matrix for inertia in self._inertias]
        return ArticulatedBodies(self.kinematics, self.speeds, self._masses, inertias)

    def _entries_by_bodies(
        self, along: Sequence[Jvp], known: Mapping[tuple[int, int], Scalar]
    ) -> dict[tuple[int, int], Scalar]:
        """The entries M_rs, r >= s; those that are not known are sums over the bodies."""
        partials = [Accumulated(self.kinematics, functools.partial(_rates_of_part, d)) for d in along]
        terms: dict[tuple[int, int], list[Scalar]] = {(r, s): [] for r in range(len(along)) for s in range(r + 1)}
        for body, mass, inertia in zip(self.mechanism.bodies, self._masses, self._inertias, strict=True):
            moving = [s for s, partial in enumerate(partials) if partial(body.point)]
            for i, r in enumerate(moving):
                for s in moving[: i + 1]:
                    if (r, s) not in known:
                        product = self.kinematics.dot(partials[r](body.point), partials[s](body.point))
                        terms[r, s].append(mass * product)
            if inertia is None:
                continue
            turns = [differentiate(d, inertia.angular_velocity) for d in along]
            turning = [s for s, turn in enumerate(turns) if any(turn)]
            momenta = {s: multiply(inertia.matrix, turns[s]) for s in turning}
            for i, r in enumerate(turning):
                for s in turning[: i + 1]:
                    if (r, s) not in known:
                        terms[r, s].append(dot(momenta[s], turns[r]))
        return {pair: known.get(pair) or self.tape.sum(entry) for pair, entry in terms.items()}

    def generalized_forces(
        self, rate: Jvp, loads: Sequence[AppliedLoad] | None = None, *, inertia: bool = True, local: bool = False
    ) -> list[Scalar]:
        """Generalized active and inertia forces, shape (n_u + n_aux,): f, or f - M u' for given u'.

        The sum of (F - P*) . v_r + (T - H*) . w_r over the bodies, P* and H* the rates of momentum. The rows of the
        auxiliary speeds come last.

        Parameters
        ----------
        rate : Jvp
            Differentiation with respect to time: with u' = 0, or given u'.
        loads : sequence of AppliedLoad, optional
            All of the mechanism's by default.
        inertia : bool, optional
            Whether to include the inertia forces.
        local : bool, optional
            Whether accelerations and forces are added up in the points' own frames, as in `Accumulated`.

        Source: Kane and Levinson 1985, sections 4.4 (active forces), 4.9 (noncontributing ones) and 4.11 (inertia
        forces). Forces on the bodies beyond a point are added up before they are projected, from the ends of
        the chains inwards, as by Luh, Walker and Paul, "On-line computational scheme for mechanical
        manipulators", *J. Dynamic Systems, Measurement, and Control* 102 (1980).
        """
        loads = self.loads if loads is None else loads
        rows = self._rows(rate, [(applied.load, applied.vector) for applied in loads], inertia, local)
        if any(applied.in_motion is not applied.vector for applied in loads):
            moving = self._rows(rate, [(applied.load, applied.in_motion) for applied in loads], inertia, local)
            rows[: len(self.speeds)] = moving[: len(self.speeds)]
        return rows

    def _rows(self, rate: Jvp, loads: Sequence[tuple[Load, Vector]], inertia: bool, local: bool) -> list[Scalar]:
        """The rows of all speeds for loads with given vectors."""
        kinematics, virtual = self.kinematics, self.virtual
        express = kinematics.express_stepwise if local else kinematics.express
        forces: list[list[tuple[int, Components]]] = [[] for _ in self.mechanism.points]
        projections: list[tuple[Scalar, Scalar]] = []  # velocities, and forces along them
        for load, vector in loads:
            if load.kind == "force":
                forces[load.target] += vector
            else:
                torque = kinematics.express(vector, load.target)
                projections += zip(virtual.angular_velocity(load.target), torque, strict=True)

        accelerations = Accumulated(kinematics, functools.partial(kinematics.derivative, rate), local=local)
        bodies = zip(self.mechanism.bodies, self._masses, self._inertias, strict=True)
        for body, mass, central in bodies if inertia else ():
            forces[body.point] += _scaled(-mass, accelerations(body.point))
            mass_rate = rate(mass)
            if mass_rate:
                forces[body.point] += _scaled(-mass_rate, kinematics.velocity(body.point))
            if central is not None:
                assert body.frame is not None
                torque = kinematics.derivative(rate, central.frame, central.momentum)
                virtual_velocity = virtual.angular_velocity_in(body.frame, central.frame)
                projections += zip(virtual_velocity, negative(torque), strict=True)
        for point in reversed(range(len(forces))):
            total = merged(forces[point])
            if not total:
                continue
            base, parts = virtual.step(point)
            if base is not None and virtual.moves(base):
                here, there = (virtual.home(point), virtual.home(base)) if local else (INERTIAL, INERTIAL)
                total = ((here, express(total, here)),)
                forces[base].append((there, express(total, there)))
            for frame, components in parts:
                projections += zip(components, express(total, frame), strict=True)
        return vjp(self.tape, projections, (*self.speeds, *self.auxiliary))

    def reaction(self, load: Load, force: Scalar) -> Components:
        """What a load has, for an unknown force n of 1, where auxiliary speeds move the points that n acts on.

        Laws of n, which are not linear in n or depend on speeds, have nothing there: |n|, or friction against a slip.
        Along one of several directions, a factor such as mu is a law too, unless the load of n has a constant length.

        Parameters
        ----------
        load : Load
        force : Scalar
            The leaf of the unknown force.

        Returns
        -------
        Components
            Along inertial axes.
        """
        tape, part = self.tape, self.kinematics.zero
        slope = self._slope(load, force)
        directions = self._auxiliary_directions(force)[load.kind]
        if not any(slope) or not directions:
            return part
        [squared] = deduplicate(tape, [dot(slope, slope)])
        kinds = ("t", "q", "p", "r") if len(directions) == 1 or squared.is_number else ("t", "q")
        for direction in directions:
            share = self._without_laws(dot(slope, direction) / dot(direction, direction), kinds)
            part = add(part, scale(share, direction))
        x, y, z = (tape.zero if zero else entry for entry, zero in zip(part, is_zero(tape, part), strict=True))
        return x, y, z

    def _slope(self, load: Load, force: Scalar) -> Components:
        """The derivative of a load with respect to an unknown force, along inertial axes."""
        slope = Jvp(self.tape, {force: self.tape.one})
        parts = merged([(frame, differentiate(slope, c)) for frame, c in merged(self.kinematics.vector(load.vector))])
        return self.kinematics.express(parts, INERTIAL)

    def _without_laws(self, scalar: Scalar, kinds: Sequence[str]) -> Scalar:
        """A scalar that depends on leaves of some kinds alone, even if its expression contains others; else zero."""
        tape = self.tape
        leaves = [
            node
            for node in tape.reach([scalar])
            if isinstance(leaf := tape.nodes[node], Leaf) and leaf.kind not in kinds
        ]
        others = [Scalar(tape, 1, node) for node in leaves]
        if not others:
            return scalar
        if not all(is_zero(tape, vjp(tape, [(scalar, tape.one)], others))):
            return tape.zero
        try:
            return substitute(tape, [scalar], dict.fromkeys(others, tape.zero))[0]
        except (ArithmeticError, ModelError, TypeError):  # it has no value there
            return tape.zero

    def _auxiliary_directions(self, force: Scalar) -> dict[str, list[Components]]:
        """Where auxiliary speeds move the points that an unknown force acts on, or turn the frames.

        For the kinds of loads, orthogonal vectors along inertial axes; they span the partial velocities.
        """
        known = self._directions.get(force)
        if known is not None:
            return known
        virtual, tape = self.virtual, self.tape
        directions: dict[str, list[Components]] = {"force": [], "torque": []}
        for load in self.mechanism.loads:
            if not any(self._slope(load, force)):
                continue
            velocity = (
                virtual.velocity(load.target)
                if load.kind == "force"
                else ((load.target, virtual.angular_velocity(load.target)),)
            )
            rows = [vjp(tape, [(v, tape.one)], self.auxiliary) for v in virtual.express(velocity, INERTIAL)]
            for x, y, z in zip(*rows, strict=True):
                # Gram and Schmidt.
                shares = [scale(dot((x, y, z), e) / dot(e, e), e) for e in directions[load.kind]]
                rest = add((x, y, z), *map(negative, shares))
                if not all(is_zero(tape, rest)):
                    directions[load.kind].append(rest)
        self._directions[force] = directions
        return directions

    def _without_reaction(self, vector: Vector, slope: Components, part: Components, force: Scalar) -> Vector:
        """A load without a part of its slope by an unknown force."""
        tape = self.tape
        if tape.depends(slope, [force]):
            return merged([*vector, (INERTIAL, scale(-force, part))])
        # Linear in the force: without it, and with what is left of its slope, so that what cancels is not formed.
        rest = [(frame, substitute(tape, components, {force: tape.zero})) for frame, components in vector]
        across = add(slope, negative(part))
        x, y, z = (tape.zero if zero else force * c for c, zero in zip(across, is_zero(tape, across), strict=True))
        return merged([*((frame, (a, b, c)) for frame, (a, b, c) in rest), (INERTIAL, (x, y, z))])

    def power(self, loads: Sequence[AppliedLoad] | None = None) -> Scalar:
        """The sum of F . v + T . w over all or some loads, with the parts of v and w that the speeds give.

        NaN if the kinetic energy also changes otherwise: if a mass varies, an angular velocity does not follow from
        the frame's orientation, or a body's inertia is given in a frame other than the body's.
        """
        kinematics = self.kinematics
        within = all(body.inertia_frame == body.frame for body in self.mechanism.bodies)
        is_consistent = len(kinematics.turning_as_oriented) == len(self.mechanism.frames)
        if not (within and is_consistent) or any(map(self.rate, self._masses)):
            return self.tape.number(float("nan"))
        by_speeds = Jvp(self.tape, {speed: speed for speed in self.speeds})
        return loads_power(
            kinematics, [applied.load for applied in (self.loads if loads is None else loads)], by_speeds
        )

    def kinetic_energy(self) -> Scalar:
        """The sum of m v.v / 2 + w.I.w / 2 over the bodies."""
        terms = []
        for body, mass, inertia in zip(self.mechanism.bodies, self._masses, self._inertias, strict=True):
            velocity = self.kinematics.velocity(body.point)
            terms.append(mass * self.kinematics.dot(velocity, velocity))
            if inertia is not None:
                terms.append(dot(inertia.momentum, inertia.angular_velocity))
        return self.tape.sum(terms) / 2

    def bodies(self) -> Iterator[tuple[Body, Scalar, Vector]]:
        """The bodies with their masses and central angular momenta."""
        for body, mass, inertia in zip(self.mechanism.bodies, self._masses, self._inertias, strict=True):
            yield body, mass, () if inertia is None else ((inertia.frame, inertia.momentum),)

    def mass_properties(self) -> Iterator[tuple[Body, Scalar, Inertia | None]]:
        """The bodies with their masses and central inertias."""
        yield from zip(self.mechanism.bodies, self._masses, self._inertias, strict=True)

    def _inertia(self, body: Body) -> Inertia | None:
        if body.inertia is None:
            return None
        assert body.frame is not None
        assert body.inertia_frame is not None
        matrix = self.kinematics.matrix(body.inertia)
        angular_velocity = self.kinematics.angular_velocity_in(body.frame, body.inertia_frame)
        return Inertia(body.inertia_frame, matrix, angular_velocity, multiply(matrix, angular_velocity))


def loads_power(kinematics: Kinematics, loads: Sequence[Load], part: Jvp | None = None) -> Scalar:
    """The sum of F . v + T . w over loads, or of a part of v and w that is linear in them."""
    terms = []
    for load in loads:
        vector = kinematics.vector(load.vector)
        if load.kind == "force":
            velocity = kinematics.velocity(load.target)
        else:
            vector = ((load.target, kinematics.express(vector, load.target)),)
            velocity = ((load.target, kinematics.angular_velocity(load.target)),)
        if part is not None:
            velocity = tuple((frame, differentiate(part, components)) for frame, components in velocity)
        terms.append(kinematics.dot(vector, velocity))
    return kinematics.tape.sum(terms)


def _scaled(factor: Scalar, vector: Vector) -> Vector:
    return tuple((frame, scale(factor, components)) for frame, components in vector)


def _rates_of_part(rate: Jvp, _: int, components: Components) -> Components:
    return differentiate(rate, components)
