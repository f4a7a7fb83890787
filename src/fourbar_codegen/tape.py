"""Straight-line code under construction: every expression once, derivatives statement by statement.

The expressions of chained reference frames are small as graphs and exponential as trees. A tape keeps them as
graphs: each compound expression is stored under a symbol the first time it is met (hash-consing), and
larger expressions refer to the symbol. Derivatives are taken on the tape by the chain rule (forward
accumulation; Griewank and Walther, *Evaluating Derivatives*, 2nd ed. 2008, section 3.1), so they cost a
small multiple of what they differentiate.
"""

from __future__ import annotations

import random
from collections.abc import Collection, Container, Iterable, Mapping, Sequence

import sympy as sm
from sympy.concrete.expr_with_limits import ExprWithLimits
from sympy.functions.special.delta_functions import DiracDelta

from fourbar_codegen.errors import ModelError
from fourbar_codegen.numeric import number

__all__ = ["Direction", "Tape", "free_symbols"]


def free_symbols(expr: sm.Basic) -> list[sm.Symbol]:
    """The symbols of a small expression in an order that does not depend on hashes."""
    return sorted(expr.free_symbols, key=lambda symbol: symbol.name)


class Tape:
    """Statements ``symbol = expression`` in order of evaluation.

    Attributes
    ----------
    statements : dict of Symbol to Expr
        Each expression refers to leaf symbols and to symbols that were stored before.
    """

    def __init__(self) -> None:
        self.statements: dict[sm.Symbol, sm.Expr] = {}
        self._position: dict[sm.Symbol, int] = {}
        self._symbols: dict[sm.Expr, sm.Symbol] = {}
        self._partials: dict[sm.Symbol, tuple[tuple[sm.Symbol, sm.Expr], ...]] = {}

    def define(self, expr: sm.Expr) -> sm.Expr:
        """Store an expression unless it is stored already; return what stands for it.

        That is a number, a symbol, or a symbol times a number: numerical factors stay outside, so that
        ``x``, ``-x`` and ``2*x`` share one statement.
        """
        if expr.is_Atom:
            return expr
        factor, rest = expr.as_coeff_Mul()
        if rest.could_extract_minus_sign():
            factor, rest = -factor, -rest
        if rest.is_Atom:
            return factor * rest
        symbol = self._symbols.get(rest)
        if symbol is None:
            # No leaf has such a name: theirs contain a colon. Digits of fixed width make SymPy's ordering of
            # arguments the order of definition.
            symbol = sm.Symbol(f"z_{len(self.statements):08d}", real=True)
            self._symbols[rest] = symbol
            self._position[symbol] = len(self.statements)
            self.statements[symbol] = rest
        return factor * symbol

    def convert(self, expr: sm.Expr, leaves: Mapping[sm.Basic, sm.Expr]) -> sm.Expr:
        """Store an expression node by node, with `leaves` in place of its symbols and functions of time.

        Raises
        ------
        ModelError
            If it contains something that is neither a leaf nor computable.
        """
        memo: dict[sm.Basic, sm.Basic] = {}

        def visit(node: sm.Basic) -> sm.Basic:
            done = memo.get(node)
            if done is None:
                if node in leaves:
                    done = leaves[node]
                elif not _computable(node):
                    raise ModelError(f"{node} in {expr} cannot be compiled.")
                elif not node.args:
                    done = node
                else:
                    done = node.func(*[visit(argument) for argument in node.args])
                    if isinstance(done, sm.Max | sm.Min):
                        # Their derivatives are step functions; those of Piecewise are Piecewise.
                        done = done.rewrite(sm.Piecewise)
                    elif isinstance(done, sm.Mod):
                        # C's fmod has the sign of the dividend, SymPy's Mod that of the divisor.
                        dividend, divisor = done.args
                        done = dividend - divisor * self.define(sm.floor(self.define(dividend / divisor)))
                    if isinstance(done, sm.Expr):
                        done = self.define(done)
                memo[node] = done
            return done

        return visit(expr)

    def reach(self, expressions: Iterable[sm.Basic], known: Container[sm.Symbol] = ()) -> list[sm.Symbol]:
        """Symbols of all statements that the expressions need, in order of evaluation, short of what is known."""
        found: set[sm.Symbol] = set()
        stack = [symbol for expr in expressions for symbol in expr.free_symbols]
        while stack:
            symbol = stack.pop()
            if symbol in self.statements and symbol not in found and symbol not in known:
                found.add(symbol)
                stack.extend(self.statements[symbol].free_symbols)
        return sorted(found, key=self._position.__getitem__)

    def depends(self, expressions: Iterable[sm.Expr], leaves: Collection[sm.Symbol]) -> bool:
        """Whether any of the leaves takes part in the expressions' values."""
        expressions = tuple(expressions)
        used = {s for expr in expressions for s in expr.free_symbols}
        used.update(s for symbol in self.reach(expressions) for s in self.statements[symbol].free_symbols)
        return not used.isdisjoint(leaves)

    def partials(self, symbol: sm.Symbol) -> tuple[tuple[sm.Symbol, sm.Expr], ...]:
        """Derivatives of one statement with respect to the symbols in it."""
        known = self._partials.get(symbol)
        if known is None:
            expr = self.statements[symbol]
            known = tuple((s, self.define(_derivative(expr, s))) for s in free_symbols(expr))
            self._partials[symbol] = known
        return known

    def evaluate(self, expressions: Sequence[sm.Expr], values: Mapping[sm.Symbol, float]) -> list[float]:
        """Numbers for expressions, given one for every leaf that they depend on."""
        known = dict(values)
        for symbol in self.reach(expressions):
            known[symbol] = number(self.statements[symbol], known)
        return [number(expr, known) for expr in expressions]

    def vanish(self, expressions: Sequence[sm.Expr]) -> list[bool]:
        """Whether each expression is zero wherever the leaves are, as told by its values at random points.

        A function that is not identically zero is zero at a random point with probability zero; the
        tolerance allows for rounding errors in expressions of terms around 1. Where fewer than three of the
        points can be evaluated, nothing is said to vanish that SymPy does not know to.
        """
        leaves = sorted(
            {s for e in expressions for s in e.free_symbols}.union(
                *(self.statements[s].free_symbols for s in self.reach(expressions))
            )
            - self.statements.keys(),
            key=lambda symbol: symbol.name,
        )
        generator = random.Random(1)
        samples = []
        for _ in range(8):
            try:
                samples.append(self.evaluate(expressions, {leaf: generator.uniform(-3.0, 3.0) for leaf in leaves}))
            except (ArithmeticError, ValueError, TypeError):
                continue  # outside of a function's range
        if len(samples) < 3:
            return [expression.is_zero is True for expression in expressions]
        return [all(abs(value) < 1e-9 for value in values) for values in zip(*samples, strict=True)]


class Direction:
    """Differentiation along one direction in the space of the leaves.

    Parameters
    ----------
    tape : Tape
    seed : mapping of Symbol to Expr
        The derivative of each leaf; leaves not named have none.
    """

    def __init__(self, tape: Tape, seed: Mapping[sm.Symbol, sm.Expr]) -> None:
        self.tape = tape
        self._known: dict[sm.Symbol, sm.Expr] = dict(seed)

    def __call__(self, expr: sm.Expr) -> sm.Expr:
        """The derivative of an expression in leaves and tape symbols."""
        known, tape = self._known, self.tape
        for symbol in tape.reach([expr], known):
            statement = tape.statements[symbol]
            if isinstance(statement, sm.Piecewise):
                # Branch by branch: a branch that is not taken may have a derivative that is not a number.
                known[symbol] = tape.define(
                    sm.Piecewise(*((self._of_expression(branch), condition) for branch, condition in statement.args))
                )
            else:
                known[symbol] = tape.define(self._chain(tape.partials(symbol)))
        return self._of_expression(expr)

    def _of_expression(self, expr: sm.Expr) -> sm.Expr:
        """The derivative of an expression whose tape symbols are differentiated already."""
        return self.tape.define(self._chain((s, _derivative(expr, s)) for s in free_symbols(expr)))

    def give(self, expr: sm.Expr, derivative: sm.Expr) -> None:
        """Take a derivative that is known from elsewhere instead of forming it by the chain rule."""
        factor, symbol = expr.as_coeff_Mul()
        if symbol in self.tape.statements:
            self._known.setdefault(symbol, self.tape.define(derivative / factor))

    def _chain(self, partials: Iterable[tuple[sm.Symbol, sm.Expr]]) -> sm.Expr:
        terms = []
        for symbol, partial in partials:
            rate = self._known.get(symbol, sm.S.Zero)
            if rate:  # asking an expression is_zero starts a search through its assumptions
                terms.append(self.tape.define(partial * rate))
        return sm.Add(*terms)


def _computable(node: sm.Basic) -> bool:
    """Whether a node has a value in double arithmetic, its arguments apart."""
    if isinstance(node, ExprWithLimits) or node is sm.nan:
        return False
    if isinstance(node, sm.Function):
        return type(node).__module__.startswith("sympy.")
    return bool(node.args) or not (isinstance(node, sm.Symbol) or node.is_finite is False)


def _derivative(expr: sm.Expr, symbol: sm.Symbol) -> sm.Expr:
    """The derivative of a statement; sums and products at hand, since SymPy's own way takes most of the time."""
    if expr.is_Atom:
        return sm.Integer(expr == symbol)
    containing = [argument for argument in expr.args if symbol in argument.free_symbols]
    if expr.is_Add:
        return sm.Add(*(_derivative(term, symbol) for term in containing))
    if expr.is_Mul:
        products = []
        for factor in containing:
            others = [argument for argument in expr.args if argument is not factor]
            products.append(sm.Mul(_derivative(factor, symbol), *others))
        return sm.Add(*products)
    if isinstance(expr, sm.floor | sm.ceiling):
        return sm.S.Zero
    if expr.is_Pow and expr.base == symbol and symbol not in expr.exp.free_symbols:
        # SymPy's n x**n / x is not a number at x = 0.
        return expr.exp * symbol ** (expr.exp - 1)
    derivative = expr.diff(symbol)
    # A jump has no derivative where it jumps; everywhere else it is zero.
    return derivative.replace(DiracDelta, lambda *_: sm.S.Zero) if derivative.has(DiracDelta) else derivative
