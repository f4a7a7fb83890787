"""Identities between expressions, told by their values at random points.

Functions that are not the same everywhere differ at a random point with probability one. Trigonometric identities,
which SymPy needs minutes to prove and straight-line code does not show, are found this way in a millisecond.

Source: J. T. Schwartz, "Fast probabilistic algorithms for verification of polynomial identities", *Journal of the ACM*
27 (1980).
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import sympy as sm

from fourbar_codegen.convert import substitute
from fourbar_codegen.tape import ONE, Call, Leaf, Product, Reciprocal, Scalar, Sum, Tape, magnitude

__all__ = ["recognize", "vanish"]

POINTS = 8
FEWEST = 3
EPS = 2.0**-52
SAFETY = 100.0
"""Differences up to so many times the bound of their rounding errors, which is one to first order, are none."""

RELIABLE = 1e-6
"""Nothing is said where that is more than this share of the terms."""

ENTIRE = (sm.sin, sm.cos, sm.exp, sm.sinh, sm.cosh)
"""Functions for which an identity that holds in some region holds everywhere."""


def vanish(tape: Tape, scalars: Sequence[Scalar]) -> list[bool]:
    """Whether each scalar is zero wherever the leaves are.

    Where fewer than three of the points can be evaluated, nothing is said to vanish that is not the number zero.
    """
    return [not scalar for scalar in _recognize(tape, scalars, (), entire=False)]


def recognize(tape: Tape, scalars: Sequence[Scalar], known: Iterable[int] = ()) -> list[Scalar]:
    """The scalars with known nodes, or with zero, in place of nodes that have the same values or none.

    Nodes are known that are given, or that come first. A constraint that was dotted out of a chain of frames, for
    example, has products of direction cosines in another order than the one in which the equations of motion need them,
    and so quadratically many of them.
    """
    return _recognize(tape, scalars, known, entire=True)


def _recognize(tape: Tape, scalars: Sequence[Scalar], known: Iterable[int], *, entire: bool) -> list[Scalar]:
    reached = tape.reach(scalars)
    known = set(known)
    nodes = sorted(known.union(reached))
    samples = _samples(tape, nodes, entire=entire)
    if len(samples) < FEWEST:
        return list(scalars)
    alike: dict[float, list[int]] = {}
    same: dict[Scalar, Scalar] = {}
    for node in (*sorted(known), *(node for node in reached if node not in known)):
        operation = tape.nodes[node]
        if isinstance(operation, Sum) and all(_cancels(operation, node, sample) for sample in samples):
            same[Scalar(tape, 1, node)] = tape.zero
            continue
        # Values that agree to more digits than these have the same key, but for one in a million.
        candidates = alike.setdefault(float(f"{abs(samples[0].values[node]):.5e}"), [])
        for candidate in candidates if node not in known else ():
            sign = 1 if samples[0].values[node] * samples[0].values[candidate] > 0 else -1
            if all(_equal(node, sign, candidate, sample) for sample in samples):
                same[Scalar(tape, 1, node)] = Scalar(tape, sign, candidate)
                break
        else:
            candidates.append(node)
    return substitute(tape, scalars, same)


@dataclass(frozen=True)
class _Sample:
    """The nodes' values at a random point, and bounds of their rounding errors."""

    values: dict[int, float]
    errors: dict[int, float]


def _cancels(operation: Sum, node: int, sample: _Sample) -> bool:
    largest = max(abs(sample.values[term] * coefficient) for term, coefficient in operation.terms)
    error = SAFETY * sample.errors[node]
    return abs(sample.values[node]) <= error <= RELIABLE * largest


def _equal(node: int, sign: int, other: int, sample: _Sample) -> bool:
    values = sample.values
    error = SAFETY * (sample.errors[node] + sample.errors[other])
    return abs(values[node] - sign * values[other]) <= error <= RELIABLE * abs(values[node])


def _samples(tape: Tape, nodes: Sequence[int], *, entire: bool) -> list[_Sample]:
    """The nodes at random points, as far as they have values there.

    Where identities are to hold everywhere, functions that are not entire are taken as independent variables.
    """
    generator = random.Random(1)
    samples = []
    for _ in range(POINTS):
        free: dict[Scalar, float] = {}
        for node in nodes:
            operation = tape.nodes[node]
            opaque = entire and isinstance(operation, Call) and not isinstance(operation.expression, ENTIRE)
            if isinstance(operation, Leaf) or opaque:
                free[Scalar(tape, 1, node)] = generator.uniform(-3.0, 3.0)
        try:
            values = tape.evaluate_nodes(nodes, free)
            samples.append(_Sample(values, _errors(tape, nodes, values)))
        except (ArithmeticError, ValueError, TypeError):
            continue  # outside of a function's range
    return samples


def _errors(tape: Tape, nodes: Sequence[int], values: dict[int, float]) -> dict[int, float]:
    """Bounds of rounding errors to first order (Higham, *Accuracy and Stability*, 2nd ed. 2002, section 3.3)."""
    errors: dict[int, float] = {ONE: 0.0}
    for node in nodes:
        value = values[node]
        match tape.nodes[node]:
            case Sum(terms):
                errors[node] = sum([magnitude(c) * (errors[term] + EPS * abs(values[term])) for term, c in terms])
            case Product(factors):
                errors[node] = EPS * abs(value) + sum(
                    [
                        abs(math.prod([values[f] for f in _without(factors, i)])) * errors[f]
                        for i, f in enumerate(factors)
                    ]
                )
            case Reciprocal(denominator):
                errors[node] = value**2 * errors[denominator] + EPS * abs(value)
            case Call(_, arguments):
                # Functions of slopes around 1; elsewhere the bound is only a guess, and so less is found.
                errors[node] = EPS * abs(value) + sum([errors[argument] for argument in arguments])
            case Leaf():
                errors[node] = 0.0
    return errors


def _without(factors: tuple[int, ...], position: int) -> tuple[int, ...]:
    return factors[:position] + factors[position + 1 :]
