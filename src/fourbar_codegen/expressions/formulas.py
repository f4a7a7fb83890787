"""Expressions of a tape as plain data, which can be evaluated in any arithmetic when the compiled model is used.

C evaluates the constraints in double precision. Finding all assembly modes needs more digits, and polynomials instead
of numbers (see `polynomials`), where SymPy's expressions are no longer available.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import sympy as sm

from fourbar_codegen.expressions.tape import ONE, Call, Leaf, Node, Number, Product, Reciprocal, Scalar, Sum, Tape
from fourbar_codegen.layout import Formulas, Json

__all__ = ["formulas"]

FUNCTIONS = {
    sm.sin: "sin", sm.cos: "cos", sm.tan: "tan", sm.asin: "asin", sm.acos: "acos", sm.atan: "atan", sm.atan2: "atan2",
    sm.sinh: "sinh", sm.cosh: "cosh", sm.tanh: "tanh", sm.exp: "exp", sm.log: "log", sm.Abs: "fabs", sm.sign: "sign",
    sm.floor: "floor", sm.ceiling: "ceil",
}  # fmt: skip
"""Their names in mpmath."""


def formulas(tape: Tape, scalars: Sequence[Scalar]) -> Formulas:
    """The scalars as data that JSON can hold.

    Parameters
    ----------
    tape : Tape
    scalars : sequence of Scalar

    Returns
    -------
    Formulas
        ``operations``, each of which refers to earlier operations by their numbers: ``["q", "q1"]`` is a leaf;
        ``["+", [[0, 2], [1, -1]], constant]`` a sum of operations 0 and 1 with factors, and a number; ``["*", [0, 1]]``
        a product; ``["/", 0]`` a reciprocal; ``["sin", argument]`` a function, and likewise others, whose arguments are
        nested lists of functions, ``"+"``, ``"*"``, ``"^"``, numbers ``["=", 2]`` and operations ``["@", 0]``;
        ``["?", [0, 1]]`` is anything that cannot be encoded in these. ``results`` has a pair of operation and factor
        for each scalar; the operation None is the number 1.

    Examples
    --------
    >>> import sympy as sm
    >>> from fourbar_codegen.expressions.convert import Conversion
    >>> tape = Tape()
    >>> q, l = sm.symbols("q l")
    >>> leaves = {q: tape.leaf("q", "q"), l: tape.leaf("p", "l")}
    >>> formulas(tape, [Conversion(tape, leaves)(3 * l * sm.cos(2 * q))])
    Formulas(operations=[['q', 'q'], ['p', 'l'], ['cos', [['*', [['=', 2], ['@', 0]]]]], ['*', [1, 2]]],
             results=[[3, 3]])
    """
    places: dict[int, int | None] = {ONE: None}
    operations: list[Json] = []
    for node in tape.reach(scalars):
        operations.append(_operation(tape.nodes[node], places))
        places[node] = len(operations) - 1
    results: list[Json] = [[places[scalar.node], _plain(scalar.coefficient)] for scalar in scalars]
    return Formulas(operations, results)


def _operation(node: Node, places: dict[int, int | None]) -> list[Json]:
    match node:
        case Leaf(kind, name):
            return [kind, name]
        case Sum(terms):
            constant = sum(coefficient for operand, coefficient in terms if operand == ONE)
            return ["+", [[places[n], _plain(c)] for n, c in terms if n != ONE], _plain(constant)]
        case Product(factors):
            return ["*", [places[factor] for factor in factors]]
        case Reciprocal(operand):
            return ["/", places[operand]]
        case Call(expression, arguments):
            operands = [places[argument] for argument in arguments]
            encoded = _encoded(expression, operands)
            return ["?", operands] if encoded is None else encoded
    raise AssertionError(node)


def _encoded(expr: sm.Expr, operands: list[int | None]) -> list[Json] | None:
    if expr.is_Symbol:
        return ["@", operands[int(expr.name[1:])]]
    if expr.is_Rational:
        return ["=", _plain(Fraction(int(expr.p), int(expr.q)))]
    if expr.is_Float:
        return ["=", float(expr)]
    name = {sm.Add: "+", sm.Mul: "*", sm.Pow: "^", **FUNCTIONS}.get(expr.func)
    arguments = [_encoded(argument, operands) for argument in expr.args]
    return None if name is None or not arguments or None in arguments else [name, arguments]


def _plain(number: Number) -> int | float | list[int]:
    """A fraction as a pair, an integer as an int."""
    if isinstance(number, Fraction):
        return int(number) if number.denominator == 1 else [number.numerator, number.denominator]
    return number
