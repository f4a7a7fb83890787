"""Equations -> Program: one straight-line function for everything that is evaluated together.

For each function: keep the statements it needs, put those used once where they are used, move what depends
on parameters alone into `prepare`, and let SymPy's `cse` share what is left in common. Derivatives go without
`cse`: the tape has shared what is equal, and 3 % of the operations are not worth as much time as forming them.
"""

from __future__ import annotations

import itertools
import operator
from collections import Counter
from collections.abc import Sequence

import sympy as sm

from fourbar_codegen.equations import Equations
from fourbar_codegen.program import Array, Function, Program, Result, Sizes
from fourbar_codegen.tape import Tape, free_symbols

__all__ = ["lower"]

Statements = tuple[tuple[sm.Symbol, sm.Expr], ...]


def lower(name: str, equations: Equations) -> Program:
    """Lower equations to a program.

    Parameters
    ----------
    name : str
        The model's name.
    equations : Equations

    Returns
    -------
    Program
        With functions `prepare`, `default_inputs`, `dynamics`, and the others below.

    Examples
    --------
    >>> from fourbar_codegen.equations import form_equations
    >>> from fourbar_codegen.models import four_bar
    >>> [f.name for f in lower("four_bar", form_equations(four_bar())).functions][:2]
    ['prepare', 'default_inputs']
    """
    e = equations
    time = Array("t", (e.time,))
    state = Array("x", (*e.coordinates, *e.speeds))
    coordinates = Array("q", e.coordinates)
    inputs = Array("r", e.inputs)
    held = (inputs, Array("accelerations", e.accelerations), Array("multipliers", e.multipliers))
    # name, summary, arguments before and after the constants, results
    specifications: list[tuple[str, str, list[Array], list[Array], list[Result]]] = [
        ("default_inputs", "Inputs r from their expressions; NaN without one.", [time], [], [e.default_inputs]),
        (
            "dynamics",
            "q', and M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0.",
            [time, state],
            [inputs],
            [e.coordinate_rates, e.mass_matrix, e.forcing, e.constraint_jacobian, e.acceleration_bias],
        ),
        (
            "position",
            "Holonomic constraints Phi(q, t) and dPhi/dq.",
            [time, coordinates],
            [inputs],
            [e.position_constraints, e.position_jacobian],
        ),
        (
            "velocity",
            "J and b of the velocity constraints J u + b = 0.",
            [time, state],
            [inputs],
            [e.constraint_jacobian, e.velocity_bias],
        ),
        ("energy", "Kinetic and potential energy.", [time, state], [inputs], [e.energies]),
        ("output", "The outputs, with u' and lambda given.", [time, state], [*held], [e.outputs]),
        (
            "sensitivity",
            "d/dx of q', and of f - M u' + J^T lambda and -(J u' + gamma) with u' and lambda held.",
            [time, state],
            [*held],
            [e.coordinate_rate_jacobian, e.residual_jacobian],
        ),
        (
            "parameter_sensitivity",
            "The same derivatives with respect to the parameters.",
            [time, state],
            [*held],
            [e.coordinate_rate_parameter_jacobian, e.residual_parameter_jacobian],
        ),
        (
            "input_sensitivity",
            "The same derivatives with respect to the inputs.",
            [time, state],
            [*held],
            [e.coordinate_rate_input_jacobian, e.residual_input_jacobian],
        ),
        (
            "constraint_sensitivity",
            "d/dq of the velocity constraints J u + b; d/dr of the position constraints and of J u + b.",
            [time, state],
            [inputs],
            [e.velocity_jacobian, e.position_input_jacobian, e.velocity_input_jacobian],
        ),
    ]
    pool = _Constants(e.tape, e.parameters)
    first = next(i for i, (name, *_) in enumerate(specifications) if name == "sensitivity")
    lowered = [
        _lower_results(e.tape, pool, results, joint_cse=i < first) for i, (*_, results) in enumerate(specifications)
    ]
    constants, prepare = pool.finish(lowered)
    written_out = _WrittenOut(e.tape)
    functions = tuple(
        Function(name, summary, (*before, constants, *after), statements, results, written_out.operations(formed))
        for (name, summary, before, after, formed), (statements, results) in zip(specifications, lowered, strict=True)
    )
    sizes = Sizes(
        n_q=len(e.coordinates),
        n_u=len(e.speeds),
        n_p=len(e.parameters),
        n_r=len(e.inputs),
        n_h=len(e.position_constraints.entries),
        n_c=len(e.velocity_bias.entries),
        n_o=len(e.outputs.entries),
        rank=e.n_dependent_speeds,
        n_constants=len(constants.symbols),
    )
    return Program(name, sizes, (prepare, *functions[:first]), functions[first:])


class _Constants:
    """What depends on parameters alone, collected from all functions for `prepare`."""

    def __init__(self, tape: Tape, parameters: tuple[sm.Symbol, ...]) -> None:
        self.tape = tape
        self.parameters = parameters
        self.values: dict[sm.Symbol, sm.Expr] = {}
        self._symbols: dict[sm.Expr, sm.Symbol] = {}
        self._known: set[sm.Symbol] = set(parameters)
        self._of_statement: dict[sm.Symbol, sm.Expr] = {}

    def is_constant(self, expr: sm.Basic) -> bool:
        return bool(expr.free_symbols <= self._known)

    def define(self, expr: sm.Expr) -> sm.Expr:
        """Store a constant expression; signs, single symbols and numbers stay where they are."""
        if expr.is_number or expr.is_Atom or (-expr).is_Atom:
            return expr
        if expr.could_extract_minus_sign():
            return -self.define(-expr)
        symbol = self._symbols.get(expr)
        if symbol is None:
            symbol = self._symbols[expr] = sm.Symbol(f"k:{len(self.values):08d}", real=True)
            self.values[symbol] = expr
            self._known.add(symbol)
        return symbol

    def split_statements(self, symbols: Sequence[sm.Symbol]) -> tuple[Statements, dict[sm.Symbol, sm.Expr]]:
        """The statements that vary in time, and what stands for those that do not."""
        varying = []
        for symbol in symbols:
            if symbol in self._of_statement:
                continue
            expr = self.tape.statements[symbol].xreplace(self._of_statement)
            if self.is_constant(expr):
                self._of_statement[symbol] = self.define(expr)
            else:
                varying.append((symbol, expr))
        return tuple(varying), self._of_statement

    def hoist(self, expr: sm.Expr) -> sm.Expr:
        """The expression with its constant factors and terms, gathered, replaced by one symbol each."""
        if not expr.args or expr.is_number:
            return expr
        if self.is_constant(expr):
            return self.define(expr)
        if isinstance(expr, sm.Add | sm.Mul):
            constants = [a for a in expr.args if self.is_constant(a)]
            varying = [a for a in expr.args if not self.is_constant(a)]
            return expr.func(self.define(expr.func(*constants)), *map(self.hoist, varying))
        return expr.func(*(self.hoist(a) if isinstance(a, sm.Expr) else a for a in expr.args))

    def finish(self, lowered: Sequence[tuple[Statements, tuple[Result, ...]]]) -> tuple[Array, Function]:
        """The array of constants that the lowered functions use, and the function that fills it."""
        used: set[sm.Basic] = set()
        for statements, results in lowered:
            used.update(*(expr.free_symbols for _, expr in statements))
            used.update(*(entry.free_symbols for result in results for entry in result.entries))
        derived = tuple(symbol for symbol in self.values if symbol in used)
        entries = (*self.parameters, *derived)
        body, assigned = _share(tuple(self.values.items()), entries, joint_cse=True)
        prepare = Function(
            "prepare",
            "The parameters, and behind them all that is derived from them alone.",
            (Array("p", self.parameters),),
            body,
            (Result("constants", (len(entries),), assigned),),
            0,  # what it computes is counted where it is used
        )
        return Array("constants", entries), prepare


class _WrittenOut:
    """Counts the operations of expressions with everything that they refer to put in its place."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self._known: dict[sm.Basic, int] = {}

    def operations(self, results: Sequence[Result]) -> int:
        entries = [entry for result in results for entry in result.entries]
        for symbol in self.tape.reach(entries, self._known):
            self._known[symbol] = self._count(self.tape.statements[symbol])
        return sum(map(self._count, entries))

    def _count(self, expr: sm.Expr) -> int:
        leaves = (node for node in sm.preorder_traversal(expr) if node.is_Symbol)
        return int(sm.count_ops(expr)) + sum(self._known.get(leaf, 0) for leaf in leaves)


def _lower_results(
    tape: Tape, constants: _Constants, results: Sequence[Result], *, joint_cse: bool
) -> tuple[Statements, tuple[Result, ...]]:
    entries = [entry for result in results for entry in result.entries]
    statements, replaced = constants.split_statements(tape.reach(entries))
    statements, entries = _inline(statements, [entry.xreplace(replaced) for entry in entries])
    statements = tuple((symbol, constants.hoist(expr)) for symbol, expr in statements)
    statements, shared = _share(statements, [constants.hoist(entry) for entry in entries], joint_cse=joint_cse)
    lowered, position = [], 0
    for result in results:
        size = len(result.entries)
        lowered.append(Result(result.name, result.shape, shared[position : position + size]))
        position += size
    return statements, tuple(lowered)


def _inline(statements: Statements, entries: Sequence[sm.Expr]) -> tuple[Statements, list[sm.Expr]]:
    """Put products and sums that are used once into the products and sums that use them.

    The longer sums and products are what `cse` finds common parts in. A sum stays out of a product, which
    it would be multiplied out with.
    """
    uses: Counter[sm.Basic] = Counter()
    for expr in [*(expr for _, expr in statements), *entries]:
        uses.update(node for node in sm.preorder_traversal(expr) if node.is_Symbol)
    pending: dict[sm.Expr, sm.Expr] = {}

    def visit(expr: sm.Expr) -> sm.Expr:
        if not isinstance(expr, sm.Add | sm.Mul):
            return expr
        arguments = []
        for argument in map(visit, expr.args):
            factor, rest = argument.as_coeff_Mul()
            value = pending.get(rest)
            if value is not None and (value.is_Mul or (expr.is_Add and abs(factor) == 1)):
                argument = factor * pending.pop(rest)
            arguments.append(argument)
        return expr if all(map(operator.is_, arguments, expr.args)) else expr.func(*arguments)

    kept: dict[sm.Symbol, sm.Expr | None] = {}
    for symbol, statement in statements:
        expr = visit(statement)
        if uses[symbol] == 1 and isinstance(expr, sm.Add | sm.Mul):
            pending[symbol] = expr
            kept[symbol] = None
        else:
            kept[symbol] = expr
    entries = [visit(entry) for entry in entries]
    # What found no place to go stays where it was.
    kept.update(pending)
    return tuple((symbol, expr) for symbol, expr in kept.items() if expr is not None), entries


def _share(
    statements: Statements, entries: Sequence[sm.Expr], *, joint_cse: bool
) -> tuple[Statements, tuple[sm.Expr, ...]]:
    """Joint common subexpression elimination, then statements in order of use, numbered anew."""
    reduced = [*(expr for _, expr in statements), *entries]
    replacements: list[tuple[sm.Symbol, sm.Expr]] = []
    if joint_cse:
        names = (sm.Symbol(f"x:{number:08d}", real=True) for number in itertools.count())
        replacements, reduced = sm.cse(reduced, symbols=names, order="canonical", list=True)
    values = dict(replacements)
    values.update(zip((symbol for symbol, _ in statements), reduced, strict=False))
    renamed: dict[sm.Basic, sm.Expr] = {}
    ordered: list[tuple[sm.Symbol, sm.Expr]] = []

    def emit(roots: sm.Expr) -> None:
        # Depth first without recursion: programs are thousands of statements deep.
        stack = [(roots, False)]
        while stack:
            expr, ready = stack.pop()
            if ready:
                value = values[expr].xreplace(renamed)
                # Conditions stay where they are used: a statement holds a number.
                if not isinstance(value, sm.Expr) or value.is_Atom or (-value).is_Atom:
                    renamed[expr] = value
                    continue
                symbol = sm.Symbol(f"z:{len(ordered):08d}", real=True)
                ordered.append((symbol, value))
                renamed[expr] = symbol
                continue
            if expr in values:
                if expr in renamed:
                    continue
                stack.append((expr, True))
                expr = values[expr]
            stack.extend((s, False) for s in reversed(free_symbols(expr)) if s in values and s not in renamed)

    for entry in reduced[len(statements) :]:
        emit(entry)
    results = tuple(entry.xreplace(renamed) for entry in reduced[len(statements) :])
    # Terms that cancelled on the way leave statements that nothing uses.
    used = {symbol for entry in results for symbol in entry.free_symbols}
    for symbol, value in reversed(ordered):
        if symbol in used:
            used.update(value.free_symbols)
    return tuple((symbol, value) for symbol, value in ordered if symbol in used), results
