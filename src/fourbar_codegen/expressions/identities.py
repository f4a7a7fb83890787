"""Identities between expressions, decided by their values at a random point.

Trigonometric identities, which SymPy needs minutes to prove and straight-line code does not show, are found this way in
a millisecond. The values are exact integers modulo a prime of 127 bits. Every angle has sine and cosine
2 t / (1 + t^2) and (1 - t^2) / (1 + t^2) with a random t; every variable and every other function has a random value.
Different rational functions have equal values with a probability of about 10^-30. An identity that holds for random
values of a function holds for every function.

Source: J. T. Schwartz, "Fast probabilistic algorithms for verification of polynomial identities", *Journal of the ACM*
27 (1980).
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from fractions import Fraction

import sympy as sm

from fourbar_codegen.expressions.convert import substitute
from fourbar_codegen.expressions.tape import ONE, Call, Leaf, Number, Product, Reciprocal, Scalar, Sum, Tape

__all__ = ["deduplicate", "is_zero", "rank"]

PRIME = 0x6A09E667F3BCC908B2FB1366EA957D67
"""The first prime after the digits of the square root of 2; modulo 2**127 - 1, for example, 2**127 would be 1."""

N_POINTS = 8
"""Random points at which expressions are compared."""
IDENTITY_ATOL = 1e-9
"""Largest value of a zero there."""
MODERATE_RATIO = 1e-6
"""Smallest coefficient, and reciprocal of the largest, of plain sums."""


def deduplicate(tape: Tape, scalars: Sequence[Scalar], known: Iterable[int] = ()) -> list[Scalar]:
    """The scalars, with nodes of equal value replaced by known or earlier nodes, or by zero or one.

    For example, a constraint from dot products along a chain of frames has products of direction cosines in another
    order than the equations of motion, and therefore quadratically many of them.
    """
    reached = tape.reach(scalars)
    given = set(known)
    values = _exact_values(tape, sorted(given.union(reached)))
    nodes = {1: ONE}
    same: dict[Scalar, Scalar] = {}
    for node in (*sorted(given), *(node for node in reached if node not in given)):
        value = values[node]
        if value is None:
            continue
        if node not in given:
            if not value:
                same[Scalar(tape, 1, node)] = tape.zero
                continue
            for sign, other in ((1, nodes.get(value)), (-1, nodes.get(PRIME - value))):
                if other is not None:
                    same[Scalar(tape, 1, node)] = Scalar(tape, sign, other)
                    break
        nodes.setdefault(value, node)
    return substitute(tape, scalars, same)


def is_zero(tape: Tape, scalars: Sequence[Scalar]) -> list[bool]:
    """Whether each scalar is zero for all values of the leaves."""
    nodes = tape.reach(scalars)
    values = _exact_values(tape, nodes)
    # With numbers such as the cosine of 0.3, identities of sines and cosines hold only to rounding.
    inexact = iter(_is_zero_to_rounding(tape, scalars, nodes))
    return [nearly or not scalar or values[scalar.node] == 0 for scalar, nearly in zip(scalars, inexact, strict=True)]


def rank(tape: Tape, rows: Sequence[Sequence[Scalar]]) -> int:
    """The rank of a matrix at a random point; full rank if it has no value there or it is not known.

    Examples
    --------
    >>> tape = Tape()
    >>> x, y = tape.leaf("q", "x"), tape.leaf("q", "y")
    >>> rank(tape, [[x, y], [x * y, y * y], [tape.zero, tape.zero]])
    1
    """
    known = _exact_values(tape, tape.reach([entry for row in rows for entry in row]))
    matrix: list[list[int]] = []
    for row in rows:
        values = [(known[entry.node], _residue(entry.coefficient)) for entry in row]
        if any(value is None or factor is None for value, factor in values):
            return min(len(rows), max(map(len, rows)))
        matrix.append([value * factor % PRIME for value, factor in values])  # type: ignore[operator]
    found = 0
    for column in range(max(map(len, matrix), default=0)):
        pivot = next((i for i in range(found, len(matrix)) if matrix[i][column]), None)
        if pivot is None:
            continue
        matrix[found], matrix[pivot] = matrix[pivot], matrix[found]
        inverse = pow(matrix[found][column], -1, PRIME)
        for other in matrix[found + 1 :]:
            factor = other[column] * inverse % PRIME
            if factor:
                other[:] = [(a - factor * b) % PRIME for a, b in zip(other, matrix[found], strict=True)]
        found += 1
    return found


def _exact_values(tape: Tape, nodes: Sequence[int]) -> dict[int, int | None]:
    """The nodes' values at a random point modulo the prime; None where there is none, or it is not known."""
    generator = random.Random(1)
    angles: dict[tuple[sm.Expr, tuple[int, ...]], tuple[int, int]] = {}
    known: dict[int, int | None] = {ONE: 1}
    for node in nodes:
        operation = tape.nodes[node]
        value: int | None = 0
        match operation:
            case Sum(terms):
                for term, coefficient in terms:
                    part, factor = known[term], _residue(coefficient)
                    value = None if value is None or part is None or factor is None else value + part * factor
            case Product(factors):
                value = 1
                for factor_node in factors:
                    part = known[factor_node]
                    value = None if value is None or part is None else value * part % PRIME
            case Reciprocal(denominator):
                part = known[denominator]
                value = pow(part, -1, PRIME) if part else None
            case Call(expression, arguments) if isinstance(expression, sm.sin | sm.cos):
                angle = (expression.args[0], arguments)
                if angle not in angles:
                    t = generator.randrange(PRIME)
                    norm = pow(1 + t * t, -1, PRIME)
                    angles[angle] = 2 * t * norm, (1 - t * t) * norm
                value = angles[angle][isinstance(expression, sm.cos)]
            case _:
                value = generator.randrange(PRIME)
        known[node] = None if value is None else value % PRIME
    return known


def _residue(value: Number) -> int | None:
    if isinstance(value, int):
        return value
    if isinstance(value, float) and not math.isfinite(value):
        return None
    fraction = Fraction(value)
    if fraction.denominator % PRIME == 0:
        return None
    return fraction.numerator * pow(fraction.denominator, -1, PRIME)


def _is_zero_to_rounding(tape: Tape, scalars: Sequence[Scalar], nodes: Sequence[int]) -> list[bool]:
    """Whether scalars vanish up to rounding errors, for scalars of sines, cosines and numbers around 1."""
    plain = _plain_nodes(tape, nodes)
    tested = [Scalar(tape, 1, scalar.node) for scalar in scalars if scalar.node in plain]
    leaves = [Scalar(tape, 1, node) for node in nodes if isinstance(tape.nodes[node], Leaf)]
    generator = random.Random(1)
    found = {scalar.node for scalar in tested}
    for _ in range(N_POINTS):
        point = {leaf: generator.uniform(-3.0, 3.0) for leaf in leaves}
        values = tape.evaluate(tested, point)
        found -= {scalar.node for scalar, value in zip(tested, values, strict=True) if not abs(value) <= IDENTITY_ATOL}
    return [scalar.node in found for scalar in scalars]


def _plain_nodes(tape: Tape, nodes: Sequence[int]) -> set[int]:
    plain = {ONE}
    for node in nodes:
        match tape.nodes[node]:
            case Leaf():
                plain.add(node)
            case Sum(terms):
                if all(term in plain and MODERATE_RATIO < abs(float(c)) < 1 / MODERATE_RATIO for term, c in terms):
                    plain.add(node)
            case Product(factors):
                if plain.issuperset(factors):
                    plain.add(node)
            case Call(expression, arguments):
                if isinstance(expression, sm.sin | sm.cos) and plain.issuperset(arguments):
                    plain.add(node)
    return plain
