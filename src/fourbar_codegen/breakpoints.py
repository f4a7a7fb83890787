"""Times at which expressions have a jump or a kink, as far as these can be read off.

A condition of a Piecewise, and what stands in an absolute value, a sign or a step function, changes where its two
sides are equal. Where the difference of these is a + b t, and a and b depend on parameters alone, that is at
t = -a / b.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import sympy as sm
from sympy.core.relational import Relational

from fourbar_codegen.convert import apply, substitute
from fourbar_codegen.derivatives import Direction
from fourbar_codegen.tape import Call, Leaf, Scalar, Tape

__all__ = ["breakpoints"]


def breakpoints(tape: Tape, time: Scalar, scalars: Iterable[Scalar]) -> list[Scalar]:
    """The times at which any of the scalars has a jump or a kink.

    Parameters
    ----------
    tape : Tape
    time : Scalar
        Its leaf.
    scalars : iterable of Scalar

    Returns
    -------
    list of Scalar
        Each in terms of parameters alone, once, in the order of the scalars' nodes.

    Examples
    --------
    >>> import sympy as sm
    >>> from fourbar_codegen.convert import Conversion
    >>> tape = Tape()
    >>> t, end = sm.symbols("t end")
    >>> leaves = {t: tape.leaf("t", ""), end: tape.leaf("p", "end")}
    >>> pulse = Conversion(tape, leaves)(sm.Piecewise((1, (t >= 1) & (t < end)), (0, True)))
    >>> found = breakpoints(tape, leaves[t], [pulse])
    >>> sorted(tape.evaluate(found, {leaves[end]: 3.0}))
    [1.0, 3.0]
    """
    derivative = Direction(tape, {time: tape.one})
    times: dict[Scalar, None] = {}
    for node in tape.reach(scalars):
        operation = tape.nodes[node]
        if isinstance(operation, Call):
            arguments = [Scalar(tape, 1, argument) for argument in operation.arguments]
            for side in _sides(operation):
                boundary = apply(tape, side, arguments)
                slope = derivative(boundary)
                if slope and _of_parameters(slope):
                    [start] = substitute(tape, [boundary], {time: tape.zero})
                    if _of_parameters(start):
                        times[-start / slope] = None
    return list(times)


def _sides(call: Call) -> Iterator[sm.Expr]:
    """What changes its sign where a function may have a jump or a kink, in the function's placeholders."""
    function = call.expression
    if isinstance(function, sm.Abs | sm.sign | sm.Heaviside):
        yield function.args[0]
    for condition in sorted(function.atoms(Relational), key=sm.default_sort_key):
        yield condition.lhs - condition.rhs


def _of_parameters(scalar: Scalar) -> bool:
    """Whether it depends on parameters alone."""
    nodes = scalar.tape.nodes
    leaves = (nodes[node] for node in scalar.tape.reach([scalar]))
    return all(leaf.kind == "p" for leaf in leaves if isinstance(leaf, Leaf))
