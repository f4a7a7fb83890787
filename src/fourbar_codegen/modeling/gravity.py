"""The direction of gravity, which pictures show downwards."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.modeling.mechanism import Body, Load, walk

__all__ = ["gravity"]

Triple = tuple[float, float, float]

SAME_RTOL = 1e-9
"""Relative tolerance for accelerations that are the same, and for their components along other axes."""

ON_EARTH = (9.7, 9.9)
"""Of bodies whose masses are numbers, accelerations that are gravity, m/s^2."""


def gravity(
    loads: Iterable[Load], bodies: Iterable[Body], values: Mapping[sm.Basic, sm.Basic], time: sm.Symbol
) -> tuple[int, int, int] | None:
    """The axis of the inertial frame, with its sign, along which gravity acts.

    Gravity is the constant part of forces at mass centres that is proportional to the masses, whatever the symbols in
    these are. Where masses are numbers, it is that with an acceleration as on the earth.

    Parameters
    ----------
    loads : iterable of Load
    bodies : iterable of Body
    values : mapping
        Values of parameters; others count as 1.
    time : Symbol

    Returns
    -------
    tuple of int, or None if there is no such force, or they differ, or are along no axis.
    """
    masses: dict[int, list[sm.Expr]] = {}
    for body in bodies:
        masses.setdefault(body.point, []).append(body.mass)
    by_symbols, by_numbers = list[Triple](), list[Triple]()
    for load in loads:
        if load.kind == "force" and load.target in masses and [frame for frame, _ in load.vector] == [0]:
            [(_, components)] = load.vector
            parts = [_constant(component, time) for component in components]
            for mass in masses[load.target]:
                found = _acceleration(parts, mass, values)
                if found is not None and any(found):
                    (by_symbols if _symbols(mass) else by_numbers).append(found)
    if not by_symbols:
        by_symbols = [a for a in by_numbers if ON_EARTH[0] < sum(part**2 for part in a) ** 0.5 < ON_EARTH[1]]
    if not by_symbols:
        return None
    first, largest = by_symbols[0], max(abs(part) for found in by_symbols for part in found)
    if any(abs(a - b) > SAME_RTOL * largest for found in by_symbols for a, b in zip(first, found, strict=True)):
        return None
    x, y, z = ((part > 0) - (part < 0) if abs(part) > SAME_RTOL * largest else 0 for part in first)
    return (x, y, z) if abs(x) + abs(y) + abs(z) == 1 else None


def _constant(component: sm.Expr, time: sm.Symbol) -> sm.Expr:
    """The terms of a sum without time and functions of it."""
    terms = sm.Add.make_args(sm.sympify(component))
    return sm.Add(*(e for e in terms if not any(n == time or isinstance(n, AppliedUndef) for n in walk([e]))))


def _symbols(expression: sm.Expr) -> list[sm.Symbol]:
    return [node for node in walk([sm.sympify(expression)]) if isinstance(node, sm.Symbol)]


def _acceleration(parts: list[sm.Expr], mass: sm.Expr, values: Mapping[sm.Basic, sm.Basic]) -> Triple | None:
    """A force by the mass; None if it is not proportional to it, for other values of the symbols in the mass, too."""
    generator, of_mass = random.Random(0), _symbols(mass)
    first: Triple | None = None
    for _ in range(3 if of_mass else 1):
        known = dict(values)
        if first is not None:
            known |= {s: sm.Float(generator.uniform(0.5, 2.0)) * known.get(s, 1) for s in of_mass}
        size, *force = (_number(e, known) for e in (mass, *parts))
        if not size or None in force:
            return None
        x, y, z = (part / size for part in force if part is not None)
        if first is None:
            first = (x, y, z)
        elif max(abs(x - first[0]), abs(y - first[1]), abs(z - first[2])) > SAME_RTOL * max(map(abs, first)):
            return None
    return first


def _number(expression: sm.Expr, values: Mapping[sm.Basic, sm.Basic]) -> float | None:
    known = sm.sympify(expression).xreplace(values)
    known = known.xreplace(dict.fromkeys(_symbols(known), sm.S.One))
    return float(known) if known.is_number and known.is_real and known.is_finite else None
