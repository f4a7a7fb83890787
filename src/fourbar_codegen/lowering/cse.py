"""Common subexpression elimination: common parts of sums and products, factoring, grouping of constants.

The tape shares subexpressions that are equal as a whole. Here, its nested sums and products are flattened, and split
again along the parts that several of them have in common.

Source: Hosangadi, Fallah and Kastner, "Optimizing polynomial expressions by algebraic factorization and common
subexpression elimination", *IEEE Transactions on CAD* 25 (2006); the greedy choice of the most frequent pair is theirs.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import TypeVar

from fourbar_codegen.expressions.convert import make_again
from fourbar_codegen.expressions.tape import ONE, Leaf, Node, Number, Product, Scalar, Sum, Tape, operands
from fourbar_codegen.lowering.program import Statements

__all__ = ["eliminate_common_subexpressions"]

Operand = TypeVar("Operand")
Pair = TypeVar("Pair", bound=tuple[Number, ...])

MAX_OPERATIONS = 5000
"""With more operations, products are left as they are: this would take half of the time and save a few per cent."""

MAX_OPERANDS = 40
"""Sums and products of more operands are left as they are: they have too many pairs."""


def eliminate_common_subexpressions(
    tape: Tape, roots: Sequence[Scalar], is_constant: Callable[[int], bool]
) -> tuple[Statements, list[Scalar]]:
    """The operations that the roots need, in topological order, and the roots in terms of these.

    Parameters
    ----------
    tape : Tape
    roots : sequence of Scalar
    is_constant : callable
        Whether a node depends on parameters alone; such nodes are taken as given, and new ones may arise.

    Returns
    -------
    statements : tuple of (int, Node)
    roots : list of Scalar
    """
    block = _Block(tape, _Flattening(tape, roots, is_constant).roots, is_constant)
    thorough = len(block.operations) <= MAX_OPERATIONS
    if thorough:
        block.eliminate_common_products()
    block.factor_sums()
    block.eliminate_common_sums()
    if thorough:
        block.eliminate_common_products()
    return tuple(block.operations.items()), block.roots


class _Flattening:
    """The roots with nested products and nested sums merged, where the inner one is used once.

    The constants of each are grouped, numerical factors included.
    """

    def __init__(self, tape: Tape, roots: Sequence[Scalar], is_constant: Callable[[int], bool]) -> None:
        self.tape = tape
        self.is_constant = is_constant
        nodes = [node for node in tape.reach(roots) if tape.operands(node) and not is_constant(node)]
        self.uses = Counter(root.node for root in roots)
        for node in nodes:
            self.uses.update(tape.operands(node))
        self._terms: dict[int, list[Scalar]] = {}
        self._factors: dict[int, list[Scalar]] = {}
        self._made: dict[int, Scalar] = {}
        for node in nodes:
            self._visit(node)
        self.roots = [self._multiple(root.node, root.coefficient) for root in roots]

    def _visit(self, node: int) -> None:
        match self.tape.nodes[node]:
            case Sum(terms):
                self._terms[node] = []
                for term, coefficient in terms:
                    if self.uses[term] == 1 and term in self._terms and abs(coefficient) == 1:
                        self._terms[node] += [part * coefficient for part in self._terms[term]]
                    else:
                        self._terms[node].append(self._multiple(term, coefficient))
            case Product(factors):
                self._factors[node] = []
                for factor in factors:
                    inner = self._factors.get(factor) if self.uses[factor] == 1 else None
                    self._factors[node] += inner or [self._value(factor)]
            case operation:
                self._made[node] = make_again(self.tape, operation, self._value)

    def _value(self, node: int) -> Scalar:
        """The replacement of a node; not called for sums and products that are merged into others."""
        if node not in self._made:
            if node in self._terms:
                self._made[node] = self._sum(self._terms[node])
            elif node in self._factors:
                self._made[node] = self._product(self._factors[node])
            else:
                self._made[node] = Scalar(self.tape, 1, node)
        return self._made[node]

    def _multiple(self, node: int, coefficient: Number) -> Scalar:
        """A multiple of a node; a product that is used nowhere else absorbs the coefficient in its constant."""
        if node in self._factors and self.uses[node] == 1:
            return self._product([*self._factors[node], self.tape.number(coefficient)], absorb=True)
        return self._value(node) * coefficient

    def _product(self, factors: Sequence[Scalar], *, absorb: bool = False) -> Scalar:
        tape = self.tape
        product = tape.product(factors)
        operation = tape.nodes[product.node]
        if not isinstance(operation, Product):
            return product
        constants = [factor for factor in operation.factors if self.is_constant(factor)]
        varying = [factor for factor in operation.factors if not self.is_constant(factor)]
        constant = tape.product([Scalar(tape, 1, factor) for factor in constants])
        if constants and varying and absorb and abs(product.coefficient) != 1:
            constant = tape.multiple(constant * product.coefficient)
            product = tape.one
        return tape.product([constant, *(Scalar(tape, 1, factor) for factor in varying)]) * product.coefficient

    def _sum(self, terms: Sequence[Scalar]) -> Scalar:
        tape = self.tape
        total = tape.sum(terms)
        operation = tape.nodes[total.node]
        if not isinstance(operation, Sum):
            return total
        constant = tape.sum([Scalar(tape, c, node) for node, c in operation.terms if self.is_constant(node)])
        varying = [Scalar(tape, c, node) for node, c in operation.terms if not self.is_constant(node)]
        if varying and not constant.is_number and constant.coefficient != -1:
            constant = tape.multiple(constant)
        return tape.sum([constant, *varying]) * total.coefficient


class _Block:
    """The operations of one function, by their nodes.

    A pass changes operations, but never the value of a node. Afterwards the tape stores them again, merges those that
    became equal, and propagates zeros and ones.
    """

    def __init__(self, tape: Tape, roots: Sequence[Scalar], is_constant: Callable[[int], bool]) -> None:
        self.tape = tape
        self.roots = list(roots)
        self.is_constant = is_constant
        self.operations = self._reached({})

    def _reached(self, changed: Mapping[int, Node]) -> dict[int, Node]:
        """The operations that the roots need, depth first, so that values are used soon after evaluation."""
        nodes = self.tape.nodes
        ordered: dict[int, Node] = {}
        for root in self.roots:
            stack = [(root.node, False)]
            while stack:
                node, ready = stack.pop()
                if node in ordered or node == ONE or self.is_constant(node):
                    continue
                operation = changed.get(node, nodes[node])
                if ready:
                    ordered[node] = operation
                elif not isinstance(operation, Leaf):
                    stack.append((node, True))
                    needed = operands(operation) if node in changed else self.tape.operands(node)
                    stack += [(operand, False) for operand in reversed(needed)]
        return ordered

    def _take_up(self) -> None:
        """Store the operations as they are now, and keep those that the roots need."""
        tape = self.tape
        made: dict[int, Scalar] = {}  # replacements of the nodes that changed

        def value(node: int) -> Scalar:
            known = made.get(node)
            return Scalar(tape, 1, node) if known is None else known

        for node, operation in self._reached(self.operations).items():
            if operation == tape.nodes[node] and made.keys().isdisjoint(operands(operation)):
                continue
            made[node] = make_again(tape, operation, value)
        self.roots = [value(root.node) * root.coefficient for root in self.roots]
        self.operations = self._reached({})

    def eliminate_common_products(self) -> None:
        """Extract pairs of factors that several products share."""
        items = {n: list(o.factors) for n, o in self.operations.items() if isinstance(o, Product)}

        def keys(factors: Sequence[int]) -> set[tuple[int, int]]:
            return {(a, b) for i, a in enumerate(factors) for b in factors[i + 1 :]}

        def replace(factors: list[int], key: tuple[int, int], new: int) -> list[int]:
            rest = list(factors)
            rest.remove(key[0])
            rest.remove(key[1])
            return sorted((*rest, new))

        _extract_pairs(items, keys, lambda key: self._store(Product(key)), replace)
        self.operations.update((node, Product(tuple(factors))) for node, factors in items.items())
        self._take_up()

    def eliminate_common_sums(self) -> None:
        """Extract pairs of terms, or multiples of pairs, that several sums share."""
        items = {n: list(o.terms) for n, o in self.operations.items() if isinstance(o, Sum)}

        def keys(terms: Sequence[tuple[int, Number]]) -> set[tuple[int, int, Number]]:
            return {(a, b, _ratio(d, c)) for i, (a, c) in enumerate(terms) for b, d in terms[i + 1 :]}

        def extract(key: tuple[int, int, Number]) -> int:
            return self._store(Sum(((key[0], 1), (key[1], key[2]))))

        def replace(
            terms: list[tuple[int, Number]], key: tuple[int, int, Number], new: int
        ) -> list[tuple[int, Number]]:
            rest = {n: c for n, c in terms if n not in key[:2]}
            # The pair may already be a term of the sum.
            rest[new] = rest.get(new, 0) + dict(terms)[key[0]]
            return sorted((n, c) for n, c in rest.items() if c)

        _extract_pairs(items, keys, extract, replace)
        self.operations.update((node, Sum(tuple(terms))) for node, terms in items.items())
        self._take_up()

    def factor_sums(self) -> None:
        """Factor out what several terms of a sum share: a b + a c = a (b + c)."""
        uses = Counter(root.node for root in self.roots)
        for operation in self.operations.values():
            uses.update(operands(operation))
        pending = [node for node, operation in self.operations.items() if isinstance(operation, Sum)]
        while pending:
            node = pending.pop()
            operation = self.operations[node]
            assert isinstance(operation, Sum)
            products: dict[int, tuple[int, ...]] = {}
            for term, _ in operation.terms:
                inner = self.operations.get(term)
                if isinstance(inner, Product) and uses[term] == 1:
                    products[term] = inner.factors
            frequency = Counter(factor for factors in products.values() for factor in dict.fromkeys(factors))
            factor, count = min(frequency.items(), key=lambda item: (-item[1], item[0]), default=(ONE, 0))
            if count < 2:
                continue
            inside: list[Scalar] = []
            outside: list[tuple[int, Number]] = []
            for term, coefficient in operation.terms:
                if factor not in products.get(term, ()):
                    outside.append((term, coefficient))
                    continue
                rest = list(products[term])
                rest.remove(factor)
                del self.operations[term]
                new = self._store(Product(tuple(rest))) if len(rest) > 1 else rest[0]
                uses[new] += 1
                inside.append(Scalar(self.tape, coefficient, new))
            bracket = self.tape.sum(inside)
            if bracket.node not in self.operations and not self.is_constant(bracket.node):
                pending.append(self._store(self.tape.nodes[bracket.node]))
            uses[bracket.node] += 1
            product = self._store(Product(tuple(sorted((factor, bracket.node)))))
            uses[product] += 1
            self.operations[node] = Sum(tuple(sorted((*outside, (product, bracket.coefficient)))))
            if outside:
                pending.append(node)
        self._take_up()

    def _store(self, operation: Node) -> int:
        node = self.tape.store(operation)
        if not self.is_constant(node):
            self.operations.setdefault(node, operation)
        return node


def _extract_pairs(
    items: dict[int, list[Operand]],
    keys: Callable[[Sequence[Operand]], set[Pair]],
    extract: Callable[[Pair], int],
    replace: Callable[[list[Operand], Pair, int], list[Operand]],
) -> None:
    """Replace the most frequent pair of operands by one, until no pair occurs twice."""
    holders: dict[Pair, set[int]] = {}
    for node, item in items.items():
        if len(item) <= MAX_OPERANDS:
            for key in keys(item):
                holders.setdefault(key, set()).add(node)
    heap = [(-len(nodes), key) for key, nodes in holders.items() if len(nodes) > 1]
    heapq.heapify(heap)
    while heap:
        count, key = heapq.heappop(heap)
        current = len(holders[key])
        if current < 2:
            continue
        if current != -count:
            heapq.heappush(heap, (-current, key))
            continue
        new = extract(key)
        changed: set[Pair] = set()
        for node in sorted(holders[key] - {new}):
            before = keys(items[node])
            items[node] = replace(items[node], key, new)
            after = keys(items[node])
            for gone in before - after:
                holders[gone].discard(node)
            for come in after - before:
                holders.setdefault(come, set()).add(node)
            changed |= after - before
        for pair in sorted(changed):
            if len(holders[pair]) > 1:
                heapq.heappush(heap, (-len(holders[pair]), pair))


def _ratio(a: Number, b: Number) -> Number:
    if isinstance(a, float) or isinstance(b, float):
        return a / b
    if type(a) is type(b) is int and not a % b:  # the usual case, faster than with a Fraction
        return a // b
    ratio = Fraction(a) / Fraction(b)
    return ratio.numerator if ratio.denominator == 1 else ratio
