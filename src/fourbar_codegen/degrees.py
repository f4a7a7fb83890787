"""How expressions depend on a coordinate: as polynomials in it, or in exp(i q) of it as an angle.

Of what a tape shows: sums and products of what has a degree have one, sines and cosines of whole multiples of the
coordinate are harmonics. Terms that would cancel count, so that degrees are upper bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fourbar_codegen.angles import COSINE, SINE
from fourbar_codegen.tape import Call, Leaf, Node, Number, Product, Scalar, Sum, Tape, operands

__all__ = ["Degree", "degrees"]


@dataclass(frozen=True)
class Degree:
    """What an expression is in a coordinate; what does not depend on it is both, of degree zero.

    Attributes
    ----------
    power : int or None
        Of a polynomial in it.
    harmonic : int or None
        The highest one of a trigonometric polynomial in it.
    is_periodic : bool
        Whether nothing changes with it by 2 pi.
    """

    power: int | None
    harmonic: int | None
    is_periodic: bool


@dataclass(frozen=True)
class _Dependence:
    """A degree, and the number a of an expression a q + b, b independent of q; None where it is of another form."""

    degree: Degree
    slope: Number | None


CONSTANT = _Dependence(Degree(0, 0, True), 0)


def degrees(tape: Tape, scalars: Sequence[Scalar], coordinate: Scalar) -> list[Degree]:
    """The degree of each scalar in a coordinate.

    Parameters
    ----------
    tape : Tape
    scalars : sequence of Scalar
    coordinate : Scalar
        A leaf.

    Returns
    -------
    list of Degree

    Examples
    --------
    >>> import sympy as sm
    >>> from fourbar_codegen.convert import Conversion
    >>> tape = Tape()
    >>> q, s, l = sm.symbols("q s l")
    >>> leaves = {symbol: tape.leaf("q", symbol.name) for symbol in (q, s, l)}
    >>> expression = Conversion(tape, leaves)(s**2 * sm.cos(2 * q + s) + l * sm.cos(q))
    >>> [degrees(tape, [expression], leaves[symbol])[0] for symbol in (q, s, l)]
    [Degree(power=None, harmonic=2, is_periodic=True), Degree(power=None, harmonic=None, is_periodic=False),
     Degree(power=1, harmonic=None, is_periodic=False)]
    """
    known = {0: CONSTANT, coordinate.node: _Dependence(Degree(1, None, False), 1)}
    for node in tape.reach(scalars):
        if node not in known:
            known[node] = _dependence(tape.nodes[node], known)
    return [known[scalar.node].degree for scalar in scalars]


def _dependence(operation: Node, known: dict[int, _Dependence]) -> _Dependence:
    match operation:
        case Leaf():
            return CONSTANT
        case Sum(terms):
            parts = [known[node] for node, _ in terms]
            slopes = [part.slope for part in parts]
            slope: Number | None = None
            if all(s is not None for s in slopes):
                slope = sum(c * s for (_, c), s in zip(terms, slopes, strict=True) if s is not None)
            return _Dependence(_combined(max, parts), slope)
        case Product(factors):
            degree = _combined(sum, [known[node] for node in factors])
            return CONSTANT if degree == CONSTANT.degree else _Dependence(degree, None)
        case Call(expression, (angle,)) if expression in (SINE, COSINE) and known[angle] != CONSTANT:
            slope = known[angle].slope
            if slope is not None and slope == int(slope):
                return _Dependence(Degree(None, abs(int(slope)), True), None)
    arguments = [known[node] for node in operands(operation)]
    if all(argument == CONSTANT for argument in arguments):
        return CONSTANT
    return _Dependence(Degree(None, None, all(argument.degree.is_periodic for argument in arguments)), None)


def _combined(function: Callable[[list[int]], int], parts: list[_Dependence]) -> Degree:
    """Of a sum or a product."""
    found = [part.degree for part in parts]
    powers = [degree.power for degree in found if degree.power is not None]
    harmonics = [degree.harmonic for degree in found if degree.harmonic is not None]
    return Degree(
        function(powers) if len(powers) == len(found) else None,
        function(harmonics) if len(harmonics) == len(found) else None,
        all(degree.is_periodic for degree in found),
    )
