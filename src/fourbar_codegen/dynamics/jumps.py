"""Where the equations of motion jump with the state, as with dry friction: found numerically at random states."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence

import sympy as sm

from fourbar_codegen.dynamics.equations import Equations
from fourbar_codegen.expressions.breakpoints import sides
from fourbar_codegen.expressions.convert import apply
from fourbar_codegen.expressions.tape import Call, Leaf, Scalar

__all__ = ["jumps"]

ATTEMPTS = 40
"""Pairs of random states between which a condition may switch."""

HALVINGS = 60
"""Of the line between them, down to neighbouring numbers."""

JUMP = 1e-6
"""Smallest jump, relative to the largest row; a square root differs by 1e-8 there."""


def jumps(equations: Equations, names: Sequence[str], parameters: Mapping[Scalar, float]) -> list[str]:
    """The functions with a jump at which q' or the residual of the equations of motion jumps.

    Parameters
    ----------
    equations : Equations
    names : sequence of str
        Of the states.
    parameters : mapping of Scalar to float
        Values of parameters' leaves, where these are known.

    Returns
    -------
    list of str
        Such as "sign of u1".
    """
    e, tape = equations, equations.tape
    states = (*e.coordinates, *e.speeds, *e.auxiliary_states)
    rows = (*e.coordinate_rates.entries, *e.residual.entries)
    nodes = tape.reach(rows)
    moving = tape.dependent(nodes, states)
    found: dict[str, None] = {}
    for node in nodes:
        operation = tape.nodes[node]
        if not isinstance(operation, Call) or node not in moving:
            continue
        expression = operation.expression
        if not isinstance(expression, sm.sign | sm.Heaviside | sm.Piecewise | sm.floor | sm.ceiling):
            continue
        arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
        rounds = isinstance(expression, sm.floor | sm.ceiling)
        boundaries = [expression.args[0] - sm.Rational(1, 2)] if rounds else sides(expression)
        for boundary in (apply(tape, side, arguments) for side in boundaries):
            if rounds or _jumps_at(e, boundary, rows, parameters):
                of = [name for name, leaf in zip(names, states, strict=True) if tape.depends([boundary], [leaf])]
                found[f"{type(expression).__name__} of {', '.join(of)}"] = None
    return list(found)


def _jumps_at(e: Equations, boundary: Scalar, rows: Sequence[Scalar], parameters: Mapping[Scalar, float]) -> bool:
    """Whether the rows differ on both sides of a sign change of a scalar between random states."""
    tape, generator = e.tape, random.Random(0)
    leaves = [Scalar(tape, 1, n) for n in tape.reach([boundary, *rows]) if isinstance(tape.nodes[n], Leaf)]
    for _ in range(ATTEMPTS):
        known = {leaf: parameters.get(leaf, generator.uniform(0.5, 1.5)) for leaf in e.parameters}
        ends = [{leaf: known.get(leaf, generator.uniform(-1.0, 1.0)) for leaf in leaves} for _ in range(2)]

        def at(share: float, ends: Sequence[Mapping[Scalar, float]] = ends) -> dict[Scalar, float]:
            return {leaf: value + share * (ends[1][leaf] - value) for leaf, value in ends[0].items()}

        try:
            low, high = 0.0, 1.0
            [before], [after] = (tape.evaluate([boundary], at(share)) for share in (low, high))
            if (before > 0.0) == (after > 0.0):
                continue
            for _ in range(HALVINGS):
                middle = (low + high) / 2.0
                [value] = tape.evaluate([boundary], at(middle))
                low, high = (middle, high) if (value > 0.0) == (before > 0.0) else (low, middle)
            first, second = (tape.evaluate(rows, at(share)) for share in (low, high))
        except (ArithmeticError, ValueError, TypeError):  # there it has no value
            continue
        if max(abs(a - b) for a, b in zip(first, second, strict=True)) > JUMP * (1.0 + max(map(abs, first))):
            return True
    return False
