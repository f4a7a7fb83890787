"""Straight-line code under construction, with hash-consing: every expression is stored once.

The expressions of chained reference frames are small as graphs and exponential as trees. A tape keeps them as a
graph: each operation is stored as a node at its first appearance and reused afterwards. Nodes are plain tuples of
numbers, a hundred times cheaper to make than SymPy's expressions. SymPy is only used inside the functions, such as sin
or Piecewise.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from operator import or_
from typing import Any, NamedTuple

import numpy as np
import sympy as sm

from fourbar_codegen.expressions.numeric import Floats, Function, function

__all__ = [
    "ONE",
    "Call",
    "Leaf",
    "Node",
    "Number",
    "Product",
    "Reciprocal",
    "Result",
    "Scalar",
    "Sum",
    "Tape",
    "operands",
    "operations_of",
    "placeholder",
]

Number = int | Fraction | float
ONE = 0
"""The node whose multiples are the numbers."""


class Leaf(NamedTuple):
    """An argument of the program: time, a coordinate, a parameter, ...

    Attributes
    ----------
    kind : str
        What it is, in one or two letters.
    name : str
        Its name in the model, or its number.
    """

    kind: str
    name: str


class Sum(NamedTuple):
    """A linear combination of nodes.

    Attributes
    ----------
    terms : tuple of (int, Number)
        Node and coefficient, in the order of the nodes.
    """

    terms: tuple[tuple[int, Number], ...]


class Product(NamedTuple):
    """The product of nodes.

    Attributes
    ----------
    factors : tuple of int
        In order of their numbers; a square has its factor twice.
    """

    factors: tuple[int, ...]


class Reciprocal(NamedTuple):
    """One over a node.

    Attributes
    ----------
    node : int
    """

    node: int


class Call(NamedTuple):
    """A function of nodes that is not arithmetic.

    Attributes
    ----------
    expression : Expr
        In ``placeholder(0)``, ``placeholder(1)``, ..., which stand for the arguments.
    arguments : tuple of int
    """

    expression: sm.Expr
    arguments: tuple[int, ...]


Node = Leaf | Sum | Product | Reciprocal | Call


def operands(operation: Node) -> tuple[int, ...]:
    """The nodes that an operation refers to."""
    kind = type(operation)
    if kind is Product:
        return operation.factors  # type: ignore[union-attr]
    if kind is Sum:
        return tuple([term for term, _ in operation.terms if term != ONE])  # type: ignore[union-attr]
    if kind is Call:
        return operation.arguments  # type: ignore[union-attr]
    return (operation.node,) if kind is Reciprocal else ()  # type: ignore[union-attr]


def operations_of(operation: Node) -> int:
    """Number of operations of one node."""
    match operation:
        case Sum(terms):
            return len(terms) - 1 + sum(node != ONE and abs(coefficient) != 1 for node, coefficient in terms)
        case Product(factors):
            return len(factors) - 1
        case Call(expression, _):
            return int(sm.count_ops(expression))
        case Reciprocal():
            return 1
    return 0


def placeholder(position: int) -> sm.Symbol:
    """The symbol that stands for an argument in the expression of a `Call`."""
    return sm.Symbol(f"_{position:03d}", real=True)


class Scalar:
    """A number times a node of a tape; arithmetic on scalars stores nodes on the tape.

    Numerical factors stay outside of nodes, so that ``x``, ``-x`` and ``2*x`` share one node.
    """

    __slots__ = ("coefficient", "node", "tape")

    def __init__(self, tape: Tape, coefficient: Number, node: int) -> None:
        self.tape = tape
        self.coefficient = coefficient
        self.node = node

    @property
    def is_number(self) -> bool:
        """Whether no node is involved."""
        return self.node == ONE

    @property
    def is_nan(self) -> bool:
        """Whether it is NaN."""
        return self.coefficient != self.coefficient

    def __bool__(self) -> bool:
        return self.coefficient != 0

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Scalar):
            return self.node == other.node and self.coefficient == other.coefficient
        return NotImplemented

    def __hash__(self) -> int:
        return hash((self.node, self.coefficient))

    def __neg__(self) -> Scalar:
        return Scalar(self.tape, -self.coefficient, self.node)

    def __add__(self, other: Scalar) -> Scalar:
        return self.tape.sum((self, other))

    def __sub__(self, other: Scalar) -> Scalar:
        return self.tape.sum((self, -other))

    def __mul__(self, other: Scalar | Number) -> Scalar:
        return self.tape.product((self, other)) if isinstance(other, Scalar) else self._times(other)

    def __rmul__(self, other: Number) -> Scalar:
        return self._times(other)

    def __truediv__(self, other: Scalar | Number) -> Scalar:
        if isinstance(other, Scalar):
            return self * other.tape.power(other, -1)
        return self._times(_inverse(other))

    def _times(self, factor: Number) -> Scalar:
        coefficient = self.coefficient * factor
        return Scalar(self.tape, coefficient, self.node if coefficient else ONE)

    def __repr__(self) -> str:
        return f"{self.coefficient} {self.tape.nodes[self.node]}"


@dataclass(frozen=True)
class Result:
    """A named array of scalars, row by row.

    Attributes
    ----------
    name : str
    shape : tuple of int
    entries : tuple of Scalar
    """

    name: str
    shape: tuple[int, ...]
    entries: tuple[Scalar, ...]


class Tape:
    """Nodes in topological order: each refers only to earlier nodes.

    Attributes
    ----------
    nodes : list of Node
        Number 0 is `ONE`.
    """

    def __init__(self) -> None:
        self.nodes: list[Node] = [Product(())]
        self._operands: list[tuple[int, ...]] = [()]
        self._numbers: dict[tuple[type, Any], int] = {}
        self._functions: dict[sm.Expr, Function] = {}
        self.zero = Scalar(self, 0, ONE)
        self.one = Scalar(self, 1, ONE)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_functions": {}}  # which are made again where they are needed

    def number(self, value: Number) -> Scalar:
        """A number."""
        return Scalar(self, value, ONE)

    def leaf(self, kind: str, name: object) -> Scalar:
        """An argument of the program."""
        return self._node(Leaf(kind, str(name)))

    def store(self, operation: Node) -> int:
        """The number of an operation, which has its operands in order and no numerical factor."""
        key = (type(operation), operation)
        known = self._numbers.get(key)
        if known is None:
            known = self._numbers[key] = len(self.nodes)
            self.nodes.append(operation)
            self._operands.append(operands(operation))
        return known

    def operands(self, node: int) -> tuple[int, ...]:
        """The nodes that a node refers to."""
        return self._operands[node]

    def _node(self, operation: Node) -> Scalar:
        return Scalar(self, 1, self.store(operation))

    def sum(self, terms: Iterable[Scalar]) -> Scalar:
        """The sum of any number of scalars; like terms are collected."""
        total: dict[int, Number] = {}
        for term in terms:
            if term.coefficient:
                total[term.node] = total.get(term.node, 0) + term.coefficient
        items = sorted((node, coefficient) for node, coefficient in total.items() if coefficient)
        if len(items) < 2:
            return Scalar(self, items[0][1], items[0][0]) if items else self.zero
        # The sign of the first term and a factor common to all terms are taken out of the node.
        size = magnitude(items[0][1])
        factor: Number = size if all(magnitude(coefficient) == size for _, coefficient in items) else 1
        if items[0][1] < 0:
            factor = -factor
        if factor != 1:
            inverse = _inverse(factor)
            items = [(node, _plain(coefficient * inverse)) for node, coefficient in items]
        return self._node(Sum(tuple(items)))._times(factor)

    def product(self, factors: Iterable[Scalar]) -> Scalar:
        """The product of any number of scalars; powers of one node are collected."""
        coefficient: Number = 1
        powers: dict[int, int] = {}
        for factor in factors:
            coefficient = coefficient * factor.coefficient
            if not coefficient:
                return self.zero
            node, exponent = factor.node, 1
            if node != ONE:
                operation = self.nodes[node]
                if type(operation) is Reciprocal:
                    node, exponent = operation.node, -1
                powers[node] = powers.get(node, 0) + exponent
        nodes: list[int] = []
        for node, exponent in powers.items():
            nodes += self._power(node, exponent)
        return Scalar(self, _plain(coefficient), self._product(nodes))

    def _product(self, nodes: list[int]) -> int:
        if len(nodes) < 2:
            return nodes[0] if nodes else ONE
        return self._node(Product(tuple(sorted(nodes)))).node

    def _power(self, node: int, exponent: int) -> list[int]:
        """Factors of an integer power, by squaring."""
        if exponent < 0:
            node, exponent = self._node(Reciprocal(node)).node, -exponent
        factors = []
        while exponent > 2:
            if exponent % 2:
                factors.append(node)
            node, exponent = self._product([node, node]), exponent // 2
        return [*factors, *[node] * exponent]

    def power(self, base: Scalar, exponent: int) -> Scalar:
        """An integer power."""
        factor: Number = _inverse(base.coefficient) if exponent < 0 else base.coefficient
        coefficient: Number = factor ** abs(exponent)
        if base.node == ONE or not exponent:
            return self.number(_plain(coefficient))
        node, operation = base.node, self.nodes[base.node]
        if type(operation) is Reciprocal:
            node, exponent = operation.node, -exponent
        return Scalar(self, _plain(coefficient), self._product(self._power(node, exponent)))

    def call(self, expression: sm.Expr, arguments: tuple[int, ...]) -> Scalar:
        """A function that is not arithmetic, see `Call`; `convert.apply` recognizes arithmetic."""
        return self._node(Call(expression, arguments))

    def multiple(self, scalar: Scalar) -> Scalar:
        """A scalar as a node of its own, its numerical factor inside."""
        return scalar if scalar.coefficient == 1 else self._node(Sum(((scalar.node, scalar.coefficient),)))

    def reach(self, scalars: Iterable[Scalar], known: Container[int] = ()) -> list[int]:
        """All nodes that the scalars need, in topological order, including leaves, but without known nodes."""
        found: set[int] = set()
        stack = [scalar.node for scalar in scalars]
        while stack:
            node = stack.pop()
            if node not in found and node not in known and node != ONE:
                found.add(node)
                stack += self._operands[node]
        return sorted(found)

    def count_operations(self, scalars: Iterable[Scalar]) -> int:
        """Number of operations that the scalars need."""
        return sum([operations_of(self.nodes[node]) for node in self.reach(scalars)])

    def depends(self, scalars: Iterable[Scalar], leaves: Iterable[Scalar]) -> bool:
        """Whether the scalars depend on any of the leaves."""
        return not {leaf.node for leaf in leaves}.isdisjoint(self.reach(scalars))

    def dependent(self, nodes: Iterable[int], leaves: Iterable[Scalar]) -> set[int]:
        """The nodes that depend on any of the leaves; the nodes are given in topological order."""
        found = {leaf.node for leaf in leaves}
        for node in nodes:
            if not found.isdisjoint(self._operands[node]):
                found.add(node)
        return found

    def spread(self, nodes: Iterable[int], masks: dict[int, int]) -> None:
        """Give each node, in topological order, the union of the masks of what it depends on; leaves have theirs."""
        for node in nodes:
            if node not in masks:
                masks[node] = reduce(or_, (masks.get(operand, 0) for operand in self._operands[node]), 0)

    def evaluate(self, scalars: Sequence[Scalar], values: Mapping[Scalar, float]) -> list[float]:
        """Numbers for scalars, for given numbers of all leaves that they depend on.

        As in C, what has no real value is not a number.
        """
        return [float(number) for number in self.evaluate_at(scalars, values)]

    def evaluate_at(self, scalars: Iterable[Scalar], values: Mapping[Scalar, float | Floats]) -> list[Floats]:
        """The same at many points: for arrays of numbers, whose shapes are broadcast."""
        scalars = list(scalars)
        known: dict[int, Any] = {leaf.node: np.float64(value) for leaf, value in values.items()}
        known[ONE] = np.float64(1.0)
        with np.errstate(all="ignore"):
            for node in self.reach(scalars, known):
                operation = self.nodes[node]
                match operation:
                    case Sum(terms):
                        known[node] = sum([known[term] * _in_double(factor) for term, factor in terms])
                    case Product(factors):
                        known[node] = math.prod([known[factor] for factor in factors])
                    case Reciprocal(denominator):
                        known[node] = 1.0 / known[denominator]
                    case Call(expression, arguments):
                        called = self._functions.get(expression)
                        if called is None:
                            symbols = [placeholder(i) for i in range(len(arguments))]
                            called = self._functions[expression] = function(symbols, expression)
                        known[node] = called(*[known[argument] for argument in arguments])
                    case Leaf():
                        raise ValueError(f"no value for {operation.name}")
            return [known[scalar.node] * _in_double(scalar.coefficient) for scalar in scalars]


def _inverse(value: Number) -> Number:
    if not value:
        raise ZeroDivisionError("a scalar divided by the number zero")
    return 1.0 / value if isinstance(value, float) else _plain(1 / Fraction(value))


def _in_double(value: Number) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def magnitude(value: Number) -> Number:
    """The absolute value; type checkers do not know abs of fractions."""
    return -value if value < 0 else value


def _plain(value: Number) -> Number:
    """A fraction with an integer value as an int."""
    return value.numerator if isinstance(value, Fraction) and value.denominator == 1 else value
