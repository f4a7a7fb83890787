"""The potential energy of a mechanism: of its bodies, of constant forces, and of springs.

A spring is a force or torque that depends on a length or an angle s alone, with the power f(s) s'. Its potential is the
negative integral of f. Springs are found in what actuators and loads are at rest, so without dampers and inputs:

- an actuator along a pathway, whose force depends on the pathway's length;
- components of loads that depend on one coordinate, or on a linear combination of coordinates, if they do work in
  proportion to its rate: `TorqueActuator` at a pin, torques and their reactions, forces along a guide;
- other loads, if their generalized forces Q_i by coordinates have dQ_i/dq_j = dQ_j/dq_i. Where the speeds do not
  determine these forces, as with fewer speeds than coordinates, the potential is not known.

Torques that are constant count as motors.

The bodies' own potentials may include those of forces and springs, of their terms, or of some of several equal ones, or
not: the loads' work tells.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.dynamics.kane import loads_power
from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Kinematics, Vector, dot
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.antiderivatives import MAX_SECONDS, antiderivative
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp, jacobian, vjp
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.linear import TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Call, Product, Scalar, Sum, Tape, placeholder
from fourbar_codegen.modeling.mechanism import LengthLaw, Load

__all__ = ["Potential", "find_potential"]

Floats = NDArray[np.float64]

CANCELLATION_RTOL = 1e-9
"""Relative tolerance for terms to cancel; states satisfy the constraints to about 1e-12."""

N_MOTIONS = 5
"""Random motions in which the loads' work is compared with the loss of potential energy."""

TINY = 1e-300

MAX_SEARCH_RATIO = 3
"""Longest search for the antiderivatives of all loads with respect to coordinates, as a multiple of MAX_SECONDS."""


@dataclass(frozen=True)
class Potential:
    """The potential energy.

    Attributes
    ----------
    energy : Scalar
        NaN if it is not known.
    without : tuple of str
        Springs that it leaves out, since no antiderivative of their force was found, and loads of which it is not
        known whether they have a potential.
    """

    energy: Scalar
    without: tuple[str, ...]


@dataclass(frozen=True)
class _Part:
    """Loads that have a potential.

    Attributes
    ----------
    names : tuple of str
        Of the loads.
    energy : Scalar or None
        None if it is not known.
    power : Scalar
        Of the loads.
    """

    names: tuple[str, ...]
    energy: Scalar | None
    power: Scalar


Motions = Callable[[Sequence[Scalar], int], Iterable[Floats]]
"""Takes scalars to their values in a number of random motions that satisfy the constraints."""


def find_potential(
    kinematics: Kinematics,
    rate: Jvp,
    *,
    coordinates: Sequence[Scalar],
    speeds: Sequence[Scalar],
    auxiliary_states: Sequence[Scalar],
    others: Sequence[Scalar],
    input_rates: Iterable[Scalar],
    motions: Motions,
) -> Potential:
    """Find the potential energy.

    Parameters
    ----------
    kinematics : Kinematics
    rate : Jvp
        Differentiation with respect to time, with u' = 0.
    coordinates, speeds : sequence of Scalar
        The leaves of q and u.
    auxiliary_states, others : sequence of Scalar
        Those of z, and all others that may change during a motion.
    input_rates : iterable of Scalar
        Those of the others that are zero at rest.
    motions : callable
        Takes scalars to their values in a number of random motions that satisfy the constraints, or in fewer.

    Returns
    -------
    Potential
    """
    tape, mechanism = kinematics.tape, kinematics.mechanism
    foreign = (*auxiliary_states, *others)
    until = time.thread_time() + MAX_SEARCH_RATIO * MAX_SECONDS
    loads = _Loads(kinematics, rate, coordinates, speeds, foreign, dict.fromkeys(input_rates), motions, until)
    constant = {number: load for number, load in enumerate(mechanism.loads) if loads.is_constant(load)}
    pathways, taken = list[_Part](), {*constant}
    for law in mechanism.length_laws:
        if tape.depends([kinematics.convert(law.force)], auxiliary_states):  # a muscle
            taken |= {*law.loads}
        elif (spring := loads.along_pathway(law)) is not None:
            pathways.append(spring)
            taken |= {*law.loads}
    names = {number: law.name for law in mechanism.length_laws for number in law.loads}
    left = [(names.get(n, load.name), load) for n, load in enumerate(mechanism.loads) if n not in taken]
    own = tape.sum([kinematics.convert(body.potential_energy) for body in mechanism.bodies])
    # The bodies' potentials include those of the loads whose work they lose, or of terms of these.
    for apart in (False, True):
        components = loads.components(left, apart)
        found = loads.of_components(components)
        parts = [part for part in (*loads.of_forces([*constant.values()], apart), *pathways, *found) if part.power]
        if all(body.potential_energy.is_zero for body in mechanism.bodies) or not parts:
            return _sum(own, parts)
        rest = tape.sum([*(c.force * c.velocity for c in components), *(-part.power for part in found)])
        for lost in ([rate(own)], [rate(own), rest]):
            shares = loads.shares(lost, [part.power for part in parts])
            if shares is not None:
                return _sum(own, parts, shares)
    return Potential(tape.number(math.nan), ())


def _sum(own: Scalar, parts: Sequence[_Part], shares: Sequence[Fraction] = ()) -> Potential:
    """The sum of the bodies' potentials and others, of which the former may include shares."""
    shares = shares or [Fraction(0)] * len(parts)
    left = [(part, 1 - share) for part, share in zip(parts, shares, strict=True) if share != 1]
    energies = [part.energy * share for part, share in left if part.energy is not None]
    unknown = next((energy for energy in energies if energy.is_nan), None)
    without = chain.from_iterable(part.names for part, _ in left if part.energy is None)
    return Potential(unknown or own.tape.sum([own, *energies]), tuple(dict.fromkeys(without)))


def _cancel(values: Floats) -> bool:
    """Whether the values in each row, of which there are some, add up to zero."""
    sums, sizes = np.abs(values.sum(axis=1)), np.abs(values).sum(axis=1)
    return len(values) > 0 and bool((sums <= CANCELLATION_RTOL * sizes).all())


@dataclass(frozen=True)
class _Component:
    """A component of a load at rest, and the velocity that it does work with."""

    load: int
    name: str
    is_torque: bool
    force: Scalar
    velocity: Scalar


@dataclass(frozen=True)
class _Loads:
    """The loads of a mechanism, and what potentials they have; arguments as in `find_potential`.

    Attributes
    ----------
    foreign : sequence of Scalar
        What no potential depends on, though it may change.
    until : float
        Processor time until which antiderivatives with respect to coordinates are searched for.
    """

    kinematics: Kinematics
    rate: Jvp
    coordinates: Sequence[Scalar]
    speeds: Sequence[Scalar]
    foreign: Sequence[Scalar]
    input_rates: Iterable[Scalar]
    motions: Motions
    until: float

    @property
    def tape(self) -> Tape:
        return self.kinematics.tape

    def cancel(self, terms: Sequence[Scalar]) -> bool:
        """Whether terms add up to zero, identically or in random motions."""
        return all(is_zero(self.tape, [self.tape.sum(terms)])) or _cancel(self._values(terms, N_MOTIONS))

    def shares(self, lost: Sequence[Scalar], powers: Sequence[Scalar]) -> list[Fraction] | None:
        """The shares of powers that cancel what is lost; None if there are none.

        A share between 0 and 1 is that of some of several equal loads.
        """
        total = self.tape.sum(lost)
        values = self._values([total, *powers], N_MOTIONS + len(powers))
        tried = [[Fraction(0)] * len(powers), [Fraction(1)] * len(powers)]
        if len(values) > len(powers):
            values /= np.abs(values).max(axis=1, keepdims=True, initial=TINY)
            sizes = np.abs(values[:, 1:]).max(axis=0, initial=TINY)
            found = np.linalg.lstsq(values[:, 1:] / sizes, -values[:, 0], rcond=CANCELLATION_RTOL)[0] / sizes
            most = len(self.kinematics.mechanism.loads)
            tried.append([Fraction(float(share)).limit_denominator(most) for share in found])
        for shares in tried:
            included = [power * share for power, share in zip(powers, shares, strict=True)]
            if all(0 <= share <= 1 for share in shares) and self.cancel([*lost, *included]):
                return shares
        return None

    def _values(self, scalars: Sequence[Scalar], number: int) -> Floats:
        """The values of scalars in random motions, in rows."""
        return np.array([*self.motions(scalars, number)]).reshape(-1, len(scalars))

    def is_constant(self, load: Load) -> bool:
        """Whether a load is a force that is constant in the inertial frame, at a point that moves."""
        if load.kind == "torque" or not self.kinematics.velocity(load.target):
            return False
        force = self._in_inertial_frame(self.kinematics.vector(load.vector))
        return any(force) and not self._depends(force)

    def of_forces(self, loads: Sequence[Load], apart: bool) -> list[_Part]:
        """The part of constant forces, or the parts of their terms."""
        forces = [(load, self._in_inertial_frame(self.kinematics.vector(load.vector))) for load in loads]
        if not apart:
            return [self._of_forces(forces)] if forces else []
        none, parts = self.tape.zero, list[_Part]()
        for load, (x, y, z) in forces:
            terms = [(term, none, none) for term in self._terms(x)]
            terms += [(none, term, none) for term in self._terms(y)]
            terms += [(none, none, term) for term in self._terms(z)]
            parts += [self._of_forces([(load, term)]) for term in terms]
        return parts

    def _of_forces(self, forces: Sequence[tuple[Load, Components]]) -> _Part:
        """The part of constant forces; its energy is NaN if their points' velocities are not rates of positions.

        The potential is -F.r, r the position of the point. Its rate is -F.v if the velocity is the rate of the
        position, which is not so for the contact point of a wheel.
        """
        kinematics, energy = self.kinematics, self.tape.number(math.nan)
        power = [kinematics.dot(((INERTIAL, force),), kinematics.velocity(load.target)) for load, force in forces]
        positions = [load.position for load, _ in forces if load.position is not None]
        if len(positions) == len(forces):
            pairs = zip(forces, positions, strict=True)
            work = [dot(force, self._in_inertial_frame(kinematics.vector(position))) for (_, force), position in pairs]
            energy = -self.tape.sum(work)
            if not self.cancel([self.rate(energy), *power]):
                energy = self.tape.number(math.nan)
        return _Part(("constant forces",), energy, self.tape.sum(power))

    def _terms(self, force: Scalar) -> list[Scalar]:
        """The terms of a sum."""
        operation = self.tape.nodes[force.node]
        if not isinstance(operation, Sum):
            return [force] if force else []
        return [Scalar(self.tape, c, term) * force.coefficient for term, c in operation.terms]

    def along_pathway(self, law: LengthLaw) -> _Part | None:
        """The part of an actuator whose force depends on the length of its pathway alone; else None."""
        tape, convert = self.tape, self.kinematics.convert
        length, force = convert(law.length), convert(law.force)
        rate = self.rate(length)
        if length.is_number or not rate:
            return None
        place = tape.leaf("y", "length")
        at_rest = self._at_rest(substitute(tape, [force], _replacement(tape, length, place))[0])
        if not tape.depends([at_rest], [place]) or self._depends([at_rest]):
            return None
        loads = [self.kinematics.mechanism.loads[number] for number in law.loads]
        if not self.cancel([loads_power(self.kinematics, loads), -(force * rate)]):
            return None
        [static] = substitute(tape, [at_rest], {place: length})
        return self._spring(law.name, at_rest, place, length, static * rate, tape.one)

    def _spring(
        self, name: str, force: Scalar, place: Scalar, argument: Scalar, power: Scalar, factor: Scalar
    ) -> _Part:
        """The part of a force f(s), with a leaf in the place of s, that has the power c f(s) s'."""
        found = antiderivative(self.tape, force, place)
        if found is None:
            return _Part((name,), None, power)
        [energy] = substitute(self.tape, [-(found * factor)], {place: argument})
        return _Part((name,), energy, power)

    def components(self, loads: Iterable[tuple[str, Load]], apart: bool) -> list[_Component]:
        """The components of loads, with their names, that do work at rest; or the terms of these."""
        kinematics, found = self.kinematics, []
        for number, (name, load) in enumerate(loads):
            is_force = load.kind == "force"
            velocity = (
                kinematics.velocity(load.target)
                if is_force
                else ((load.target, kinematics.angular_velocity(load.target)),)
            )
            for frame, vector in kinematics.vector(load.vector):
                for axis, component in enumerate(vector):
                    force = self._at_rest(component)
                    if force and (along := kinematics.express(velocity, frame)[axis]):
                        terms = self._terms(force) if apart else [force]
                        found += [_Component(number, name, not is_force, term, along) for term in terms]
        return found

    def of_components(self, components: Sequence[_Component]) -> list[_Part]:
        """The parts of components that depend on one combination of coordinates, and of all others together."""
        laws: dict[int, list[_Component]] = {}
        for component in components:
            laws.setdefault(component.force.node, []).append(component)
        parts, others = list[_Part](), list[list[_Component]]()
        for node, members in laws.items():
            velocity = self.tape.sum([member.velocity * member.force.coefficient for member in members])
            part = self._of_angle(members[0].name, Scalar(self.tape, 1, node), velocity)
            if part is not None:
                parts.append(part)
            elif not self._depends([members[0].force]):
                others.append([member for member in members if not member.is_torque])
            else:
                others.append(members)
        # If a part of what has a potential has one, so does what is left: small groups first.
        for join in (list, _joined, lambda left: [[*chain(*left)]]):
            tried = [(group, self._of_coordinates(group)) for group in join(others)]
            parts += [part for _, part in tried if part is not None]
            others = [group for group, part in tried if part is None]
        return parts

    def _of_coordinates(self, components: Sequence[_Component]) -> _Part | None:
        """The part of components whose generalized forces are the derivatives of a potential with respect to q."""
        tape = self.tape
        power = tape.sum([component.force * component.velocity for component in components])
        names = tuple(dict.fromkeys(component.name for component in components))
        known = tape.reach([component.force for component in components])
        forces = self._by_coordinates(power, known)
        if forces is None:  # it may have a potential, unless it is constant
            return _Part(names, None, power) if self._depends([component.force for component in components]) else None
        on = [*forces, *(q for q in self.coordinates if q not in forces and tape.depends([*forces.values()], [q]))]
        slopes = jacobian(tape, [forces.get(q, tape.zero) for q in on], on)
        curl = [slopes[i][j] - slopes[j][i] for i in range(len(on)) for j in range(i)]
        if not forces or not all(is_zero(tape, curl)):
            return None
        # Without what a prescribed motion gives.
        power = tape.sum([force * self.rate(q) for q, force in forces.items()])
        # The work on the way from the origin, along one coordinate after another.
        place, at_origin = tape.leaf("y", "coordinate"), dict[Scalar, Scalar]()
        work = []
        for q, force in forces.items():
            max_seconds = min(MAX_SECONDS, self.until - time.thread_time())
            found = antiderivative(tape, substitute(tape, [force], {**at_origin, q: place})[0], place, max_seconds)
            at_origin[q] = tape.zero
            try:
                ends = [] if found is None else [substitute(tape, [found], {place: end})[0] for end in (q, tape.zero)]
            except (ArithmeticError, ModelError, TypeError):  # it is infinite at the origin
                ends = []
            if not ends:
                return _Part(names, None, power)
            work.append(ends[0] - ends[1])
        energy = -tape.sum(work)
        return _Part(names, energy if self.cancel([self.rate(energy), power]) else None, power)

    def _by_coordinates(self, power: Scalar, known: Iterable[int]) -> dict[Scalar, Scalar] | None:
        """The forces Q, by their coordinates, that have a power Q.q'; None if the speeds do not determine them.

        From q' = K u + b, the forces by the speeds are K^T Q. Of these equations, those are solved that are coupled to
        one with a force. The known nodes take the place of equal ones.
        """
        tape, slopes = self.tape, self._slopes
        of_speeds = vjp(tape, [(power, tape.one)], self.speeds)
        rows, more = set[int](), {row for row, force in enumerate(of_speeds) if force}
        while more != rows:
            rows = more
            columns = sorted({column for row in rows for column in slopes[row]})
            more = {row for row, entries in enumerate(slopes) if row in rows or not entries.keys().isdisjoint(columns)}
        if not rows:
            return {}
        if len(rows) != len(columns):
            return None
        matrix = [[slopes[row].get(column, tape.zero) for column in columns] for row in sorted(rows)]
        try:
            found = solve_linear(tape, matrix, [-of_speeds[row] for row in sorted(rows)])
        except (UndeterminedError, TooManyCoupledError):
            return None
        forces = deduplicate(tape, found, known)
        return {self.coordinates[column]: force for column, force in zip(columns, forces, strict=True) if force}

    @cached_property
    def _slopes(self) -> list[dict[int, Scalar]]:
        """For each speed, the derivatives of the coordinates' rates that are not zero, by the coordinates' numbers."""
        rows = jacobian(self.tape, [self.rate(q) for q in self.coordinates], self.speeds)
        return [{n: row[i] for n, row in enumerate(rows) if row[i]} for i in range(len(self.speeds))]

    def _of_angle(self, name: str, law: Scalar, velocity: Scalar) -> _Part | None:
        """The part of a law of a combination s of coordinates, of loads that do work in proportion to s'."""
        tape = self.tape
        on = [q for q in self.coordinates if tape.depends([law], [q])]
        if not on:
            return None
        slopes = vjp(tape, [(law, tape.one)], on) if len(on) > 1 else [tape.one]
        if not slopes[0]:  # it is constant piece by piece, so that derivatives do not tell the combination
            return None
        ratios = deduplicate(tape, [slope / slopes[0] for slope in slopes])
        if self._depends(ratios):
            return None
        argument = tape.sum([q * ratio for q, ratio in zip(on, ratios, strict=True)])
        place = tape.leaf("y", "angle")
        [at] = substitute(tape, [law], {on[0]: place, **dict.fromkeys(on[1:], tape.zero)})
        rate = self.rate(argument)
        along = next((Jvp(tape, {u: tape.one}) for u in self.speeds if Jvp(tape, {u: tape.one})(rate)), None)
        if along is None:
            return None
        [factor] = deduplicate(tape, [along(velocity) / along(rate)])
        same = [law - substitute(tape, [at], {place: argument})[0], velocity - factor * rate]
        if self._depends([factor]) or not all(is_zero(tape, same)):
            return None
        return self._spring(name, at, place, argument, law * velocity, factor)

    def _at_rest(self, force: Scalar) -> Scalar:
        """A force where all rates are zero, without terms that depend on what is foreign, such as inputs and time."""
        tape = self.tape
        changing = (*self.foreign, *self.speeds)
        if not tape.depends([force], changing):
            return force
        operation = tape.nodes[force.node]
        if isinstance(operation, Sum):
            return tape.sum([self._at_rest(Scalar(tape, c, term)) for term, c in operation.terms]) * force.coefficient
        if isinstance(operation, Product):
            factors = [Scalar(tape, 1, factor) for factor in operation.factors]
            varying = [factor for factor in factors if tape.depends([factor], changing)]
            if len(varying) == 1 and isinstance(tape.nodes[varying[0].node], Sum):
                fixed = [factor for factor in factors if factor is not varying[0]]
                return tape.product([*fixed, self._at_rest(varying[0])]) * force.coefficient
        try:
            [at_rest] = substitute(tape, [force], dict.fromkeys((*self.speeds, *self.input_rates), tape.zero))
        except (ArithmeticError, ModelError, TypeError):  # it is infinite
            return tape.zero
        return tape.zero if at_rest.is_nan or tape.depends([at_rest], self.foreign) else at_rest

    def _in_inertial_frame(self, vector: Vector) -> Components:
        return self.kinematics.express(vector, INERTIAL)

    def _depends(self, scalars: Sequence[Scalar]) -> bool:
        return self.tape.depends(scalars, (*self.foreign, *self.speeds, *self.coordinates))


def _joined(groups: Iterable[list[_Component]]) -> list[list[_Component]]:
    """Groups of components, those of the same loads together."""
    joined: list[list[_Component]] = []
    for group in groups:
        loads, apart = {component.load for component in group}, list[list[_Component]]()
        for other in joined:
            if loads.isdisjoint(component.load for component in other):
                apart.append(other)
            else:
                group = [*other, *group]
        joined = [*apart, group]
    return joined


def _replacement(tape: Tape, length: Scalar, place: Scalar) -> dict[Scalar, Scalar]:
    """What to replace by what, for a leaf to take the place of a length.

    Even powers of a square root are powers of its argument. A sum of lengths, along obstacles, stands in other sums
    with its terms: the last one becomes the leaf without the others.
    """
    operation, whole = tape.nodes[length.node], place / length.coefficient
    if isinstance(operation, Sum):
        *others, (node, coefficient) = operation.terms
        before = tape.sum([Scalar(tape, c, term) for term, c in others])
        return {Scalar(tape, 1, node): (whole - before) / coefficient}
    found = {Scalar(tape, 1, length.node): whole}
    if isinstance(operation, Call) and len(operation.arguments) == 1:
        factor, squared = (operation.expression**2).as_coeff_Mul()
        if squared == placeholder(0):
            found[Scalar(tape, 1, operation.arguments[0])] = whole * whole / Conversion(tape, {})(factor)
    return found
