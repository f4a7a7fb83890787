"""Breakpoints, times at which expressions may have a jump or a kink, as far as these can be derived.

A condition of a Piecewise switches where its two sides are equal; an absolute value, a sign, a step function or a root
has a jump or kink where its argument is zero. If the difference or argument is a + b t + c t^2, with coefficients of
parameters alone, these times are its roots. An expression with branches, such as a minimum, may equal any of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import sympy as sm
from sympy.core.relational import Relational

from fourbar_codegen.expressions.convert import apply, substitute
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.tape import Call, Leaf, Scalar, Tape, placeholder

__all__ = ["are_known", "breakpoints", "sides"]

MAX_ALTERNATIVES = 64
"""Most alternatives of an expression with nested conditions."""


def breakpoints(tape: Tape, time: Scalar, scalars: Iterable[Scalar]) -> tuple[list[Scalar], bool]:
    """The breakpoints of scalars: times at which any of them may have a jump or a kink.

    Parameters
    ----------
    tape : Tape
    time : Scalar
        Its leaf.
    scalars : iterable of Scalar

    Returns
    -------
    list of Scalar
        Each in terms of parameters alone, in the order of the scalars' nodes. Some may turn out to be smooth.
    bool
        Whether there are no others, apart from those that depend on the state.

    Examples
    --------
    >>> import sympy as sm
    >>> from fourbar_codegen.expressions.convert import Conversion
    >>> tape = Tape()
    >>> t, end = sm.symbols("t end")
    >>> leaves = {t: tape.leaf("t", ""), end: tape.leaf("p", "end")}
    >>> pulse = Conversion(tape, leaves)(sm.Piecewise((1, (t >= 1) & (t < end)), (0, True)))
    >>> found, is_complete = breakpoints(tape, leaves[t], [pulse])
    >>> sorted(tape.evaluate(found, {leaves[end]: 3.0})), is_complete
    ([1.0, 3.0], True)
    """
    derivative = Jvp(tape, {time: tape.one})
    times: dict[Scalar, None] = {}
    is_complete = True
    for node in tape.reach(scalars):
        operation = tape.nodes[node]
        if isinstance(operation, Call):
            arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
            for side in sides(operation.expression) if _is_of_time(tape, time, *arguments) else ():
                for boundary in _alternatives(tape, time, apply(tape, side, arguments)):
                    roots = _roots(tape, time, boundary, derivative)
                    times |= dict.fromkeys(roots or ())
                    # Powers are usually smooth wherever they have a value.
                    is_complete &= roots is not None or operation.expression.is_Pow
            if isinstance(operation.expression, sm.floor | sm.ceiling):
                is_complete &= not _is_of_time(tape, time, *arguments)
    return list(times), is_complete


def sides(function: sm.Expr) -> Iterator[sm.Expr]:
    """Expressions in the function's placeholders that change sign where the function may have a jump or a kink."""
    if isinstance(function, sm.Abs | sm.sign | sm.Heaviside):
        yield function.args[0]
    elif function.is_Pow and not function.exp.is_Integer:
        yield function.base
    for condition in sorted(function.atoms(Relational), key=sm.default_sort_key):
        yield condition.lhs - condition.rhs


def are_known(tape: Tape, time: Scalar, boundary: Scalar) -> bool:
    """Whether a scalar changes sign at times that can be derived from parameters."""
    parts, derivative = _alternatives(tape, time, boundary), Jvp(tape, {time: tape.one})
    return all(_is_prescribed(part) and _roots(tape, time, part, derivative) is not None for part in parts)


def _alternatives(tape: Tape, time: Scalar, scalar: Scalar) -> list[Scalar]:
    """The expressions that a scalar may equal, depending on the conditions in it."""
    waiting = [scalar]
    found: list[Scalar] = []
    while waiting:
        part = waiting.pop()
        # The last node first: what is not chosen there need not be decided.
        choices = ((node, _choices(tape, time, node)) for node in reversed(tape.reach([part])))
        node, chosen = next((choice for choice in choices if choice[1]), (None, []))
        if node is None or len(waiting) + len(found) >= MAX_ALTERNATIVES:
            found.append(part)
        else:
            waiting += [substitute(tape, [part], {Scalar(tape, 1, node): each})[0] for each in chosen]
    return found


def _choices(tape: Tape, time: Scalar, node: int) -> list[Scalar]:
    """The expressions that a node may equal, by its conditions, if it depends on time; none otherwise."""
    operation = tape.nodes[node]
    if not isinstance(operation, Call) or not _is_of_time(tape, time, Scalar(tape, 1, node)):
        return []
    function, first = operation.expression, placeholder(0)
    if isinstance(function, sm.Piecewise):
        chosen = [branch for branch, _ in function.args]
    elif isinstance(function, sm.Abs) and function.args[0] == first:
        chosen = [first, -first]
    elif isinstance(function, sm.sign | sm.Heaviside):
        chosen = [sm.S.NegativeOne, sm.S.Zero, sm.S.One]
    else:
        return []
    arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
    return [apply(tape, each, arguments) for each in chosen]


def _roots(tape: Tape, time: Scalar, boundary: Scalar, derivative: Jvp) -> list[Scalar] | None:
    """The times at which a scalar is zero, or may touch zero; None if these are not known."""
    if not _is_of_time(tape, time, boundary) or not _is_prescribed(boundary):
        return []
    slope = derivative(boundary)
    curvature = derivative(slope)
    highest = curvature or slope  # of a polynomial of degree 2 or 1
    if not highest or _is_of_time(tape, time, highest):
        return None

    def at(t: Scalar) -> Scalar:
        [value] = substitute(tape, [boundary], {time: t})
        return value

    if not curvature:
        return [-at(tape.zero) / slope]
    [slope_at_zero] = substitute(tape, [slope], {time: tape.zero})
    vertex = -slope_at_zero / curvature
    # Without a root, the vertex is returned twice, which does no harm.
    square = sm.Piecewise((placeholder(0), placeholder(0) > 0), (0, True))
    reach = apply(tape, sm.sqrt(placeholder(0)), [apply(tape, square, [at(vertex) * -2 / curvature])])
    return [vertex - reach, vertex + reach]


def _is_of_time(tape: Tape, time: Scalar, *scalars: Scalar) -> bool:
    return tape.depends(scalars, {time})


def _is_prescribed(scalar: Scalar) -> bool:
    """Whether it depends on time and parameters alone."""
    nodes = scalar.tape.nodes
    leaves = (nodes[node] for node in scalar.tape.reach([scalar]))
    return all(leaf.kind in ("t", "p") for leaf in leaves if isinstance(leaf, Leaf))
