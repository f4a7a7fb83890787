"""The potential energy of a mechanism: of its bodies, of constant forces, and of springs.

A spring is a force or torque that depends on a length or an angle s alone, with the power f(s) s'. Its potential is the
negative integral of f. Springs are found in what actuators and loads are at rest, so without dampers and inputs:

- an actuator along a pathway, whose force depends on the pathway's length;
- components of loads that depend on one coordinate, or on a linear combination of coordinates, if they do work in
  proportion to its rate: `TorqueActuator` at a pin, torques and their reactions, forces along a guide;
- other loads, if their generalized forces Q_i by coordinates have dQ_i/dq_j = dQ_j/dq_i. Where the speeds do not
  determine these forces, as with fewer speeds than coordinates, the potential is not known.

Torques that are constant count as motors.

The bodies' own potentials may include those of forces and springs, or not: the loads' work tells.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, combinations

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.dynamics.kane import loads_power
from fourbar_codegen.dynamics.kinematics import INERTIAL, Components, Kinematics, Vector, dot
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.antiderivatives import PATIENCE, antiderivative
from fourbar_codegen.expressions.convert import Conversion, substitute
from fourbar_codegen.expressions.derivatives import Jvp, jacobian, vjp
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.linear import TooManyCoupledError, UndeterminedError, solve_linear
from fourbar_codegen.expressions.tape import Call, Product, Scalar, Sum, Tape, placeholder
from fourbar_codegen.modeling.mechanism import LengthLaw, Load

__all__ = ["Potential", "find_potential"]

Floats = NDArray[np.float64]

ROUNDED = 1e-9
"""Relative tolerance for terms to cancel; states satisfy the constraints to about 1e-12."""

MAX_APART = 10
"""Largest number of parts of which all combinations are tried."""

LONGEST = 3
"""Longest search for the antiderivatives by coordinates of all loads, in searches for one."""


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


Motions = Callable[[Sequence[Scalar]], Iterable[Floats]]
"""Takes scalars to their values in random motions that satisfy the constraints."""


def find_potential(
    kinematics: Kinematics,
    rate: Jvp,
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
        Takes scalars to their values in random motions that satisfy the constraints.

    Returns
    -------
    Potential
    """
    tape, mechanism = kinematics.tape, kinematics.mechanism
    foreign = (*auxiliary_states, *others)
    until = time.thread_time() + LONGEST * PATIENCE
    loads = _Loads(kinematics, rate, coordinates, speeds, foreign, dict.fromkeys(input_rates), motions, until)
    constant = {number: load for number, load in enumerate(mechanism.loads) if loads.is_constant(load)}
    parts = loads.of_forces([*constant.values()])
    taken = {*constant}
    for law in mechanism.length_laws:
        if tape.depends([kinematics.convert(law.force)], auxiliary_states):  # a muscle
            taken |= {*law.loads}
        elif (spring := loads.along_pathway(law)) is not None:
            parts.append(spring)
            taken |= {*law.loads}
    names = {number: law.name for law in mechanism.length_laws for number in law.loads}
    components = loads.components(
        [(names.get(n, load.name), load) for n, load in enumerate(mechanism.loads) if n not in taken]
    )
    found = loads.of_components(components)
    parts = [part for part in (*parts, *found) if part.power]
    own = tape.sum([kinematics.convert(body.potential_energy) for body in mechanism.bodies])
    if all(body.potential_energy.is_zero for body in mechanism.bodies) or not parts:
        return _sum(own, parts)
    # The bodies' potentials include those of the loads whose work they lose.
    power = [part.power for part in parts]
    rest = tape.sum([*(c.force * c.velocity for c in components), *(-part.power for part in found)])
    terms = [rate(own), rest, *power]
    values = np.array([*motions(terms)]).reshape(-1, len(terms))
    for added in _combinations(len(parts)):
        included = [number + 2 for number in range(len(parts)) if number not in added]
        for columns in ([0, *included], [0, 1, *included]):
            total = tape.sum([terms[column] for column in columns])
            if _cancel(values[:, columns]) if len(values) else all(is_zero(tape, [total])):
                return _sum(own, [parts[number] for number in added])
    return Potential(tape.number(math.nan), ())


def _sum(own: Scalar, parts: Sequence[_Part]) -> Potential:
    """The sum of the bodies' potentials and others."""
    energies = [part.energy for part in parts if part.energy is not None]
    unknown = next((energy for energy in energies if energy.is_nan), None)
    without = chain.from_iterable(part.names for part in parts if part.energy is None)
    return Potential(unknown or own.tape.sum([own, *energies]), tuple(dict.fromkeys(without)))


def _combinations(n: int) -> Iterator[tuple[int, ...]]:
    """Numbers of parts, small sets first: all sets of a few; of many none, the first, the others, or all."""
    if n <= MAX_APART:
        for size in range(n + 1):
            yield from combinations(range(n), size)
    else:
        yield from ((), (0,), tuple(range(1, n)), tuple(range(n)))


def _cancel(values: Floats) -> bool:
    """Whether the values in each row, of which there are some, add up to zero."""
    sums, sizes = np.abs(values.sum(axis=1)), np.abs(values).sum(axis=1)
    return len(values) > 0 and bool((sums <= ROUNDED * sizes).all())


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
        Processor time until which antiderivatives by coordinates are searched for.
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
        return all(is_zero(self.tape, [self.tape.sum(terms)])) or _cancel(
            np.array([*self.motions(terms)]).reshape(-1, len(terms))
        )

    def is_constant(self, load: Load) -> bool:
        """Whether a load is a force that is constant in the inertial frame, at a point that moves."""
        if load.kind == "torque" or not self.kinematics.velocity(load.target):
            return False
        force = self._in_inertial_frame(self.kinematics.vector(load.vector))
        return any(force) and not self._depends(force)

    def of_forces(self, loads: Sequence[Load]) -> list[_Part]:
        """The part of constant forces; its energy is NaN if their points' velocities are not rates of positions.

        The potential is -F.r, r the position of the point. Its rate is -F.v if the velocity is the rate of the
        position, which is not so for the contact point of a wheel.
        """
        if not loads:
            return []
        kinematics = self.kinematics
        pairs = [(load, self._in_inertial_frame(kinematics.vector(load.vector))) for load in loads]
        power = [loads_power(kinematics, [load]) for load in loads]
        energy = self.tape.number(math.nan)
        if all(load.position is not None for load in loads):
            energy = self.tape.sum([self._of_force(load, force) for load, force in pairs])
            if not self.cancel([self.rate(energy), *power]):
                energy = self.tape.number(math.nan)
        return [_Part(("constant forces",), energy, self.tape.sum(power))]

    def _of_force(self, load: Load, force: Components) -> Scalar:
        assert load.position is not None
        return -dot(force, self._in_inertial_frame(self.kinematics.vector(load.position)))

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

    def components(self, loads: Iterable[tuple[str, Load]]) -> list[_Component]:
        """The components of loads, with their names, that do work at rest."""
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
                    if force:
                        along = kinematics.express(velocity, frame)[axis]
                        if along:
                            found.append(_Component(number, name, not is_force, force, along))
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
        """The part of components whose generalized forces are the derivatives of a potential by coordinates."""
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
            patience = min(PATIENCE, self.until - time.thread_time())
            found = antiderivative(tape, substitute(tape, [force], {**at_origin, q: place})[0], place, patience)
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
