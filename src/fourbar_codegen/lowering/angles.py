"""Addition theorems: sums of angles for products of their sines and cosines.

The direction cosines of a chain of frames that turn about the same axis are multiplied link by link,

    sin(a + b) = sin a cos b + cos a sin b,    cos(a + b) = cos a cos b - sin a sin b.

Adding the angles takes one operation instead of six, and the sines of all links can be evaluated in the lanes of
vectors. The rounding error of a sum is about 1e-16 of the largest angle, the same as that of an angle itself after many
turns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import sympy as sm

from fourbar_codegen.expressions.convert import apply, make_again
from fourbar_codegen.expressions.tape import Call, Leaf, Node, Product, Scalar, Sum, Tape, operations_of, placeholder

__all__ = ["add_angles"]

SINE, COSINE = sm.sin(placeholder(0)), sm.cos(placeholder(0))


def add_angles(tape: Tape, roots: Sequence[Scalar], is_constant: Callable[[int], bool]) -> list[Scalar]:
    """The roots with sums of angles, where this needs no more sines and cosines, and fewer operations.

    Parameters
    ----------
    tape : Tape
    roots : sequence of Scalar
    is_constant : callable
        Whether a node depends on parameters alone; such nodes are not changed.

    Returns
    -------
    list of Scalar
    """
    made: dict[int, Scalar] = {}  # replacements of the nodes that changed

    def value(node: int) -> Scalar:
        known = made.get(node)
        return Scalar(tape, 1, node) if known is None else known

    for node in tape.reach(roots):
        operation = tape.nodes[node]
        if isinstance(operation, Leaf) or is_constant(node):
            continue
        again = make_again(tape, operation, value)
        added = _added(tape, tape.nodes[again.node])
        made[node] = again if added is None else added * again.coefficient
    changed = [value(root.node) * root.coefficient for root in roots]

    def cost(scalars: Sequence[Scalar]) -> tuple[int, int]:
        nodes = [tape.nodes[node] for node in tape.reach(scalars) if not is_constant(node)]
        angles = {found[0] for node in nodes if (found := _angle(node))}
        return len(angles), sum(map(operations_of, nodes))

    return min(list(roots), changed, key=cost)


def _added(tape: Tape, operation: Node) -> Scalar | None:
    """A sum by an addition theorem; None if none applies."""
    match operation:
        case Sum(((first, 1), (second, 1 | -1 as sign))):
            one, other = _two_angles(tape, first), _two_angles(tape, second)
        case _:
            return None
    if one is None or other is None or one.keys() != other.keys() or len(one) != 2:
        return None
    (a, function_of_a), (b, function_of_b) = one.items()
    if other[a] == function_of_a or other[b] == function_of_b:
        return None
    if function_of_a == function_of_b:
        # cos a cos b -+ sin a sin b = cos(a +- b), the other way round with the sign of the sum
        angle = Scalar(tape, 1, a) - Scalar(tape, sign, b)
        return apply(tape, COSINE, [angle]) * (1 if function_of_a == COSINE else sign)
    if function_of_a == COSINE:
        a, b = b, a
    # sin a cos b +- cos a sin b = sin(a +- b)
    return apply(tape, SINE, [Scalar(tape, 1, a) + Scalar(tape, sign, b)])


def _two_angles(tape: Tape, node: int) -> dict[int, sm.Expr] | None:
    """The angles in a product of two sines or cosines, each with its function."""
    match tape.nodes[node]:
        case Product((factor, other)):
            found = [_angle(tape.nodes[factor]), _angle(tape.nodes[other])]
            return None if None in found else dict(pair for pair in found if pair)
    return None


def _angle(operation: Node) -> tuple[int, sm.Expr] | None:
    """The angle and the function of a sine or cosine."""
    match operation:
        case Call(expression, (angle,)) if expression in (SINE, COSINE):
            return angle, expression
    return None
