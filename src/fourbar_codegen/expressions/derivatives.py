"""Derivatives on the tape, node by node, by the chain rule.

Source: Griewank and Walther, *Evaluating Derivatives*, 2nd ed. 2008, sections 3.1 (forward) and 3.2 (reverse). Both
cost a small multiple of what they differentiate.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import sympy as sm

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.convert import Conversion, apply, without_impulses
from fourbar_codegen.expressions.tape import (
    ONE,
    Call,
    Leaf,
    Node,
    Product,
    Reciprocal,
    Scalar,
    Sum,
    Tape,
    magnitude,
    operands,
    placeholder,
)

__all__ = ["Jvp", "Rounding", "absolute", "jacobian", "vjp"]

MIN_MAGNITUDE = 1e-12
"""Smallest magnitude of a leaf in `Rounding`, since a value that should be zero has rounding errors."""


class Jvp:
    """Differentiation along one direction in the space of the leaves.

    Parameters
    ----------
    tape : Tape
    seed : mapping of Scalar to Scalar
        The derivative of each leaf; leaves not named have none.
    """

    def __init__(self, tape: Tape, seed: Mapping[Scalar, Scalar]) -> None:
        self.tape = tape
        self._known: dict[int, Scalar] = {leaf.node: rate for leaf, rate in seed.items()}
        self._known[ONE] = tape.zero

    def __call__(self, scalar: Scalar) -> Scalar:
        """The derivative of a scalar."""
        known, tape = self._known, self.tape
        if scalar.node not in known:
            for node in tape.reach([scalar], known):
                known[node] = self._rate(node)
        return known[scalar.node] * scalar.coefficient

    def give(self, scalar: Scalar, rate: Scalar) -> None:
        """Take a derivative that is known from elsewhere instead of forming it by the chain rule."""
        if not scalar.is_number:
            self._known.setdefault(scalar.node, rate / scalar.coefficient)

    def _rate(self, node: int) -> Scalar:
        known, tape = self._known, self.tape
        operation = tape.nodes[node]
        for operand in tape.operands(node):  # most nodes do not depend on the leaves that change
            if known[operand].coefficient:
                break
        else:
            return tape.zero
        if isinstance(operation, Sum):
            return tape.sum([known[term] * coefficient for term, coefficient in operation.terms])
        if isinstance(operation, Call) and _is_piecewise(operation):
            # Branch by branch, since a branch that is not taken may have a derivative of NaN.
            return _piecewise_rate(tape, operation, [known[argument] for argument in operation.arguments])
        terms = [(known[operand], partial) for operand, partial in _partials(tape, node)]
        return tape.sum([partial * rate for rate, partial in terms if rate])


class Rounding:
    """Rounding errors of scalars, in units of the precision of double.

    First-order bounds: the error of a node is the sum, over its operands, of |derivative| times the operand's error. A
    leaf v has the error |v| + MIN_MAGNITUDE; sines and cosines have 1, even at angles of zero; other functions have
    their own magnitude. So a constraint Phi has at least sum_j |dPhi/dq_j| |q_j|, and terms that cancel, or constants,
    count with their magnitude. A constraint that is violated by only a few of these units is satisfied to rounding.

    Source: N. J. Higham, *Accuracy and Stability of Numerical Algorithms*, 2nd ed. 2002, section 3.3, running error
    analysis.

    Parameters
    ----------
    tape : Tape
    """

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self._known: dict[int, Scalar] = {ONE: tape.one}

    def __call__(self, scalar: Scalar) -> Scalar:
        """The error of a scalar."""
        known = self._known
        for node in self.tape.reach([scalar], known):
            known[node] = self._error(node)
        return known[scalar.node] * magnitude(scalar.coefficient)

    def _error(self, node: int) -> Scalar:
        known, tape = self._known, self.tape
        operation = tape.nodes[node]
        if isinstance(operation, Leaf):
            return absolute(tape, Scalar(tape, 1, node)) + tape.number(MIN_MAGNITUDE)
        if isinstance(operation, Sum):
            return tape.sum([known[term] * magnitude(coefficient) for term, coefficient in operation.terms])
        if isinstance(operation, Call) and _is_piecewise(operation):
            return absolute(
                tape, _piecewise_rate(tape, operation, [known[argument] for argument in operation.arguments])
            )
        errors = [known[operand] * absolute(tape, partial) for operand, partial in _partials(tape, node)]
        if isinstance(operation, Call):
            angle = isinstance(operation.expression, sm.sin | sm.cos)
            errors.append(tape.one if angle else absolute(tape, Scalar(tape, 1, node)))
        return tape.sum(errors)


def absolute(tape: Tape, scalar: Scalar) -> Scalar:
    """The absolute value."""
    return apply(tape, sm.Abs(placeholder(0)), [scalar])


def jacobian(tape: Tape, rows: Iterable[Scalar], leaves: Sequence[Scalar]) -> list[list[Scalar]]:
    """The derivatives of scalars, in rows, with respect to leaves, each row by one reverse pass."""
    return [vjp(tape, [(row, tape.one)], leaves) for row in rows]


def vjp(tape: Tape, scalars: Sequence[tuple[Scalar, Scalar]], leaves: Sequence[Scalar]) -> list[Scalar]:
    """The sums of weights times derivatives of scalars, for each leaf, by one reverse pass.

    Parameters
    ----------
    tape : Tape
    scalars : sequence of (Scalar, Scalar)
        What to differentiate, and its weight.
    leaves : sequence of Scalar

    Returns
    -------
    list of Scalar
    """
    nodes = tape.reach([scalar for scalar, _ in scalars])
    dependent = tape.dependent(nodes, leaves)
    # What only branches of Piecewise contain may have a derivative of NaN where these are not taken.
    branches = [n for node in nodes if _is_piecewise(tape.nodes[node]) for n in operands(tape.nodes[node])]
    conditional = set(tape.reach([Scalar(tape, 1, node) for node in branches])) if branches else set()
    parts: dict[int, list[Scalar]] = {}
    for scalar, weight in scalars:
        if scalar.node in dependent and weight:
            parts.setdefault(scalar.node, []).append(weight * scalar.coefficient)
    for node in reversed(nodes):
        if node not in parts:
            continue
        adjoint = tape.sum(parts[node])
        parts[node] = [adjoint]
        if not adjoint:
            continue
        operation = tape.nodes[node]
        if isinstance(operation, Call) and _is_piecewise(operation):
            for operand, part in _piecewise_parts(tape, operation, adjoint):
                if operand in dependent:
                    parts.setdefault(operand, []).append(part)
            continue
        for operand, partial in _partials(tape, node):
            if operand in dependent:
                part = partial * adjoint
                if node in conditional and not isinstance(operation, Sum):
                    part = _unless_zero(tape, part, adjoint)
                parts.setdefault(operand, []).append(part)
    return [tape.sum(parts.get(leaf.node, ())) for leaf in leaves]


def _is_piecewise(operation: Node) -> bool:
    return isinstance(operation, Call) and isinstance(operation.expression, sm.Piecewise)


def _partials(tape: Tape, node: int) -> list[tuple[int, Scalar]]:
    """The derivatives of a node with respect to its operands."""
    match tape.nodes[node]:
        case Sum(terms):
            return [(term, tape.number(coefficient)) for term, coefficient in terms if term != ONE]
        case Product(factors):
            partials = []
            for factor in dict.fromkeys(factors):
                others = list(factors)
                others.remove(factor)
                rest = tape.product([Scalar(tape, 1, other) for other in others])
                partials.append((factor, rest * factors.count(factor)))
            return partials
        case Reciprocal(denominator):
            return [(denominator, -tape.power(Scalar(tape, 1, denominator), -2))]
        case Call(expression, arguments):
            scalars = [Scalar(tape, 1, argument) for argument in arguments]
            return [
                (argument, _converted(tape, _derivative(expression, placeholder(i)), scalars))
                for i, argument in enumerate(arguments)
            ]
    return []


def _converted(tape: Tape, expression: sm.Expr, arguments: Sequence[Scalar]) -> Scalar:
    return Conversion(tape, {placeholder(i): argument for i, argument in enumerate(arguments)})(expression)


def _piecewise_rate(tape: Tape, call: Call, rates: Sequence[Scalar]) -> Scalar:
    """A Piecewise of the branches' derivatives; the branches are multiples of placeholders, or numbers."""
    arguments = [Scalar(tape, 1, argument) for argument in call.arguments]
    branches = []
    for branch, condition in call.expression.args:
        factor, symbol = branch.as_coeff_Mul()
        if symbol.is_Symbol:
            position = next(i for i in range(len(call.arguments)) if placeholder(i) == symbol)
            branches.append((factor * placeholder(len(call.arguments) + position), condition))
        else:
            branches.append((sm.S.Zero, condition))
    return apply(tape, sm.Piecewise(*branches), [*arguments, *rates])


def _piecewise_parts(tape: Tape, call: Call, adjoint: Scalar) -> Iterator[tuple[int, Scalar]]:
    """The adjoint of a Piecewise for the operand of each branch, 0 where another branch is taken.

    Where no condition holds it is NaN, as the value is, unless the adjoint is 0: this Piecewise may be in a branch of
    another one that is not taken, and the parts of all branches are added.
    """
    arguments = [Scalar(tape, 1, argument) for argument in call.arguments]
    symbols = [placeholder(i) for i in range(len(arguments) + 1)]
    *_, (_, last) = call.expression.args
    rest = [] if last == sm.true else [(0, sm.Eq(symbols[-1], 0))]
    for place, argument in enumerate(call.arguments):
        branches = [
            (expression.diff(symbols[place]) * symbols[-1], condition) for expression, condition in call.expression.args
        ]
        if any(branch for branch, _ in branches):
            yield argument, apply(tape, sm.Piecewise(*branches, *rest), [*arguments, adjoint])


def _unless_zero(tape: Tape, part: Scalar, adjoint: Scalar) -> Scalar:
    """A product with an adjoint, or 0 if that is 0, even if the other factor is NaN."""
    condition = sm.Ne(placeholder(1), 0)
    return apply(tape, sm.Piecewise((placeholder(0), condition), (0, True)), [part, adjoint])


def _derivative(expression: sm.Expr, symbol: sm.Symbol) -> sm.Expr:
    if isinstance(expression, sm.floor | sm.ceiling):
        return sm.S.Zero
    if expression.is_Pow and symbol not in expression.exp.free_symbols:
        # SymPy's n x**n / x is NaN at x = 0.
        base, exponent = expression.args
        return exponent * base ** (exponent - 1) * base.diff(symbol)
    if expression.is_Pow and symbol not in expression.base.free_symbols:
        # x**n log(x) is NaN at x = 0, where x**n is 0 for every n > 0.
        base, exponent = expression.args
        return exponent.diff(symbol) * sm.Piecewise((expression * sm.log(base), base > 0), (0, True))
    derivative = expression.diff(symbol)
    if derivative.has(sm.Derivative, sm.Subs):
        raise ModelError(f"The model contains {type(expression).__name__}, whose derivative C99 does not have.")
    return without_impulses(derivative)
