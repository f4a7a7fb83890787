"""SymPy expressions -> nodes of a tape."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction

import sympy as sm
from sympy.core.function import AppliedUndef
from sympy.functions.elementary.piecewise import ExprCondPair
from sympy.functions.special.delta_functions import DiracDelta
from sympy.logic.boolalg import Boolean

from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.tape import (
    ONE,
    Call,
    Leaf,
    Node,
    Number,
    Product,
    Reciprocal,
    Scalar,
    Sum,
    Tape,
    placeholder,
)

__all__ = [
    "Conversion",
    "apply",
    "expression_of",
    "is_computable",
    "make_again",
    "smooth_sinc",
    "substitute",
    "without_impulses",
]

OPERATIONS = (
    *(sm.Add, sm.Mul, sm.Pow, sm.NumberSymbol, sm.Max, sm.Min, sm.UnevaluatedExpr),
    *(ExprCondPair, Boolean),  # of a Piecewise
)
"""Nodes of expressions beside numbers, functions and leaves."""


class Conversion:
    """Converts expressions to nodes of a tape, each subexpression once.

    Parameters
    ----------
    tape : Tape
    leaves : mapping of Basic to Scalar
        Scalars of the tape for symbols and functions of time. It may grow while in use.
    """

    def __init__(self, tape: Tape, leaves: Mapping[sm.Basic, Scalar]) -> None:
        self.tape = tape
        self.leaves = leaves
        self._known: dict[sm.Basic, Scalar] = {}

    def __call__(self, expression: sm.Expr) -> Scalar:
        """The scalar for an expression.

        Raises
        ------
        ModelError
            If it contains something that is neither a leaf nor computable.
        """
        known, leaves = self._known, self.leaves
        # Depth first without recursion, since expressions of long chains are deep.
        stack = [expression]
        while stack:
            node = stack[-1]
            if node in known:
                stack.pop()
            elif node in leaves:
                known[node] = leaves[node]
            elif not is_computable(node):
                raise ModelError(f"{node} in {expression} cannot be compiled.")
            elif missing := [argument for argument in _arguments(node) if argument not in known]:
                stack.extend(reversed(missing))
            else:
                try:
                    known[node] = self._operation(node)
                except (ZeroDivisionError, TypeError):
                    raise ModelError(f"{node} in {expression} cannot be compiled: it has no real value.") from None
        return known[expression]

    def _operation(self, node: sm.Expr) -> Scalar:
        known, tape = self._known, self.tape
        if node.is_Add:
            return tape.sum([known[argument] for argument in node.args])
        if node.is_Mul:
            return tape.product([known[argument] for argument in node.args])
        if isinstance(node, sm.UnevaluatedExpr):
            return known[node.args[0]]
        if node.is_number:
            return tape.number(_number(node))
        if node.is_Pow:
            base, exponent = node.args
            if exponent.is_Integer:
                return tape.power(known[base], int(exponent))
            if _is_even_power(base) and (base.exp * exponent).is_Integer:
                # of real numbers: the derivative of (x^2)^(1/2) is NaN where x is 0
                size = apply(tape, sm.Abs(placeholder(0)), [known[base.base]])
                return tape.power(size, int(base.exp * exponent))
            if exponent.is_Rational and exponent < 0:
                # A normalized vector and its rates have E^(-1/2), E^(-3/2), ...: powers of one square root. Positive
                # powers stay, since the derivative of E^(3/2) is 0 where E is 0, but that of the root is not.
                root, power = (sm.S.Half, exponent.p) if exponent.q == 2 else (-exponent, -1)
                return tape.power(apply(tape, sm.Pow(placeholder(0), root), [known[base]]), power)
        if isinstance(node, sm.Piecewise):
            return self._piecewise(node)
        arguments = _arguments(node)
        stand_ins = {argument: placeholder(i) for i, argument in enumerate(arguments)}
        return apply(tape, _with_arguments(node, stand_ins), [known[argument] for argument in arguments])

    def _piecewise(self, node: sm.Piecewise) -> Scalar:
        """Branch by branch, "if ... else ...": so derivatives of n branches have n parts, not n^2."""
        known, otherwise = self._known, list[Scalar]()  # no value, if the last condition does not hold either
        for branch, condition in reversed(node.args):
            if condition == sm.true:
                otherwise = [known[branch]]
                continue
            values = [known[branch], *otherwise]
            arguments = _arguments(condition)
            stand_ins = {argument: placeholder(len(values) + i) for i, argument in enumerate(arguments)}
            conditions = [_with_arguments(condition, stand_ins), sm.true][: len(values)]
            choice = sm.Piecewise(*[(placeholder(i), each) for i, each in enumerate(conditions)])
            otherwise = [apply(self.tape, choice, [*values, *[known[argument] for argument in arguments]])]
        return otherwise[0]


RECIPROCALS = {sm.sech: sm.cosh, sm.csch: sm.sinh, sm.coth: sm.tanh}
OF_RECIPROCALS = {sm.acoth: sm.atanh, sm.asech: sm.acosh, sm.acsch: sm.asinh}
"""C functions for what SymPy would print as exponentials, which overflow, and logarithms, which cancel."""

CURVES = "sympy.physics.biomechanics.curve"
"""Muscles' characteristic curves: names of formulas. The module takes 0.1 s to import, which only muscles need."""


def apply(tape: Tape, function: sm.Expr, arguments: Sequence[Scalar]) -> Scalar:
    """The value of a function, given as an expression in ``placeholder(0)``, ``placeholder(1)``, ..."""
    nodes = list(dict.fromkeys(argument.node for argument in arguments if argument.node != ONE))
    stand_ins = [
        expression_of(a.coefficient) * (sm.S.One if a.node == ONE else placeholder(nodes.index(a.node)))
        for a in arguments
    ]
    # Here SymPy takes out signs and factors: sin(-x) = -sin(x).
    built = function.xreplace({placeholder(i): stand_in for i, stand_in in enumerate(stand_ins)})
    factor, rest = built.as_coeff_Mul()
    if isinstance(rest, sm.Max | sm.Min):
        # Their derivatives are step functions; those of Piecewise are Piecewise.
        rest = rest.rewrite(sm.Piecewise)
    elif rest.func in RECIPROCALS:
        rest = 1 / RECIPROCALS[rest.func](*rest.args)
    elif rest.func in OF_RECIPROCALS:
        rest = OF_RECIPROCALS[rest.func](1 / rest.args[0])
    elif type(rest).__module__ == CURVES:
        rest = rest.doit(deep=False, evaluate=False)
    elif isinstance(rest, sm.sinc):
        rest = smooth_sinc(*rest.args)
    elif isinstance(rest, sm.Mod):
        # C's fmod has the sign of the dividend, SymPy's Mod that of the divisor.
        dividend, divisor = rest.args
        rest = dividend - divisor * sm.floor(dividend / divisor)
    leaves = {placeholder(i): Scalar(tape, 1, node) for i, node in enumerate(nodes)}
    arithmetic = rest.is_Atom or rest.is_Add or rest.is_Mul or rest.is_number
    power = rest.is_Pow and rest.exp.is_Rational and (rest.exp.is_Integer or rest.exp < 0)
    many = isinstance(rest, sm.Piecewise) and len(rest.args) > 2
    if arithmetic or power or many or not all(_is_multiple(argument) for argument in _arguments(rest)):
        return Conversion(tape, leaves)(rest) * _number(factor)
    used = sorted(rest.free_symbols, key=lambda symbol: symbol.name)
    called = rest.xreplace({symbol: placeholder(i) for i, symbol in enumerate(used)})
    return tape.call(called, tuple(leaves[symbol].node for symbol in used)) * _number(factor)


def without_impulses(derivative: sm.Expr) -> sm.Expr:
    """A derivative without the impulses of jumps, which are zero everywhere else."""
    return derivative.replace(DiracDelta, lambda *_: sm.S.Zero) if derivative.has(DiracDelta) else derivative


def smooth_sinc(x: sm.Expr) -> sm.Expr:
    """sin(x) / x with a smooth branch at 0, where derivatives of the quotient are 0 / 0.

    A truncated power series for |x| < 1. The truncation changes third derivatives by less than 1e-17.
    """
    series = sum((sm.Rational((-1) ** k, sm.factorial(2 * k + 1)) * placeholder(0) ** k for k in range(11)), sm.S.Zero)
    return sm.Piecewise((sm.sin(x) / x, x**2 > 1), (sm.horner(series).xreplace({placeholder(0): x**2}), True))


def substitute(tape: Tape, scalars: Sequence[Scalar], values: Mapping[Scalar, Scalar]) -> list[Scalar]:
    """The scalars with leaves replaced."""
    known = {leaf.node: value for leaf, value in values.items()}
    known[ONE] = tape.one
    for node in tape.reach(scalars, known):
        operation = tape.nodes[node]
        known[node] = (
            Scalar(tape, 1, node) if isinstance(operation, Leaf) else make_again(tape, operation, known.__getitem__)
        )
    return [known[scalar.node] * scalar.coefficient for scalar in scalars]


def make_again(tape: Tape, operation: Node, value: Callable[[int], Scalar]) -> Scalar:
    """An operation (not a leaf) with new operands."""
    match operation:
        case Sum(terms):
            return tape.sum([value(term) * coefficient for term, coefficient in terms])
        case Product(factors):
            return tape.product([value(factor) for factor in factors])
        case Reciprocal(denominator):
            return tape.power(value(denominator), -1)
        case Call(expression, arguments):
            return apply(tape, expression, [value(argument) for argument in arguments])
    raise TypeError(f"{operation} is not an operation")


def expression_of(value: Number) -> sm.Expr:
    """A number as a SymPy expression."""
    return sm.Rational(value.numerator, value.denominator) if isinstance(value, Fraction) else sm.sympify(value)


def written_out(scalar: Scalar) -> sm.Expr:
    """A scalar as a SymPy expression, with symbols of their names for leaves."""
    known: dict[int, sm.Expr] = {ONE: sm.S.One}
    for node in scalar.tape.reach([scalar]):
        match scalar.tape.nodes[node]:
            case Sum(terms):
                known[node] = sm.Add(*[known[term] * expression_of(factor) for term, factor in terms])
            case Product(factors):
                known[node] = sm.Mul(*[known[factor] for factor in factors])
            case Reciprocal(denominator):
                known[node] = 1 / known[denominator]
            case Call(expression, arguments):
                known[node] = expression.xreplace({placeholder(i): known[a] for i, a in enumerate(arguments)})
            case Leaf(kind, name):
                known[node] = sm.Symbol(name or kind)
    return known[scalar.node] * expression_of(scalar.coefficient)


def _is_even_power(expression: sm.Expr) -> bool:
    return bool(expression.is_Pow and expression.exp.is_Integer and expression.exp.is_even)


def _number(expression: sm.Expr) -> Number:
    if expression.is_Integer:
        return int(expression)
    if expression.is_Rational:
        return Fraction(int(expression.p), int(expression.q))
    return float(expression)


def _arguments(node: sm.Basic) -> list[sm.Expr]:
    """The expressions that a node consists of, including those in its conditions and tuples."""
    found: dict[sm.Expr, None] = {}
    for argument in node.args:
        found.update(dict.fromkeys([argument] if isinstance(argument, sm.Expr) else _arguments(argument)))
    return list(found)


def _with_arguments(node: sm.Basic, arguments: Mapping[sm.Expr, sm.Expr]) -> sm.Basic:
    """The node with new expressions for those that `_arguments` finds."""
    if not node.args:
        return node
    return node.func(*[arguments[a] if isinstance(a, sm.Expr) else _with_arguments(a, arguments) for a in node.args])


def _is_multiple(argument: sm.Expr) -> bool:
    return bool(argument.is_number or argument.as_coeff_Mul()[1].is_Symbol)


def is_computable(node: sm.Basic) -> bool:
    """Whether a node can be evaluated in double arithmetic if its arguments can: not symbols and functions of time."""
    if isinstance(node, sm.Number):
        value = abs(_in_double(node))
        return math.isfinite(value) and (value > 0.0 or node.is_zero is True)
    if isinstance(node, sm.Symbol | AppliedUndef):
        return False
    if isinstance(node, sm.Function):
        return type(node).__module__.startswith("sympy.")
    return isinstance(node, OPERATIONS)


def _in_double(value: sm.Number) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf
