"""Operations -> C expressions, and C names for what they refer to.

SymPy's C99 printer prints the functions; sums, products and divisions are written here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction

import sympy as sm
from sympy.printing.c import C99CodePrinter
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from fourbar_codegen.errors import ModelError, shown
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
    magnitude,
    placeholder,
)
from fourbar_codegen.lowering.program import Function
from fourbar_codegen.lowering.schedule import ScheduledFunction

__all__ = ["ANGLES", "CARRIED", "Text"]

CARRIED = "carried"
"""The array that passes values between the parts of a long function."""

MAX_EXACT_INTEGER = 2**53
"""Integers below this are exact in double."""

ANGLES = "angles"
"""Name of the variables for sines and cosines that are evaluated together, followed by a number."""

OF_NUMBER = {"fb_real": "fb_number", "fb_simd": "fb_all"}
"""Functions that make vectors of numbers."""

RESERVED = frozenset(
    # C keywords, the macros of <math.h>, and those that compilers define for their system
    "auto break case char const continue default do double else enum extern float for goto if inline int long "
    "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "NAN INFINITY HUGE_VAL bool true false asm typeof NULL unix linux i386 errno signgam math_errhandling "
    # names that the templates and the runtime's headers use
    "t x q p r constants accelerations multipliers work status i j k carried "
    "mass_row mass_column mass_place jacobian_row jacobian_column jacobian_place pair_place unknown column below "
    "target each lane "
    # functions that the printer may call
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs floor fma fmax "
    "fmin fmod hypot lgamma log log10 log1p log2 pow round sin sinh sqrt tan tanh tgamma trunc main".split()
)


class Text:
    """The text of a function's values.

    Parameters
    ----------
    scheduled : ScheduledFunction
    real : {"fb_real", "fb_simd", "double"}, optional
        The type of its values.

    Attributes
    ----------
    names : dict of int to str
        Names of the arguments and of the nodes that have a line of their own.
    """

    def __init__(self, scheduled: ScheduledFunction, real: str = "double") -> None:
        self.real = real
        self.inline_angles = scheduled.inline_angles
        self.operations = dict(scheduled.function.statements)
        self.names = _argument_names(scheduled.function)
        self.names.update((node, f"z{position}") for position, node in enumerate(scheduled.lines))

    def value(self, line: int) -> str:
        """The right-hand side of a line."""
        operation, text = self.operations[line], self._operation(self.operations[line])[0]
        if not isinstance(operation, Call) or self.real != "fb_real" or _is_inlined_call(operation):
            return text
        # C has these functions for double only.
        arguments = [self.names[argument] for argument in operation.arguments]
        if not arguments:
            return f"fb_number({text})"
        return f"FB_EACH_{len(arguments)}(({text}), {', '.join(arguments)})"

    def number(self, value: Number) -> str:
        """A number as a value of the function's type."""
        return _literal(value) if self.real == "double" else f"{OF_NUMBER[self.real]}({_literal(value)})"

    def scalar(self, scalar: Scalar) -> str:
        """A result."""
        if scalar.is_number:
            return self.number(scalar.coefficient)
        return self._multiple(scalar.coefficient, scalar.node)

    def _multiple(self, coefficient: Number, node: int) -> str:
        if coefficient == 1:
            return self._node(node)[0]
        text = self._within_product(node)
        return f"-{text}" if coefficient == -1 else f"{_literal(coefficient)}*{text}"

    def _within_product(self, node: int) -> str:
        text, is_sum = self._node(node)
        return f"({text})" if is_sum else text

    def _node(self, node: int) -> tuple[str, bool]:
        """The text of an operand, and whether it is a sum, which needs parentheses in products."""
        name = self.names.get(node)
        return (name, False) if name is not None else self._operation(self.operations[node])

    def _operation(self, operation: Node) -> tuple[str, bool]:
        match operation:
            case Sum(terms):
                text = ""
                for node, coefficient in terms:
                    number = magnitude(coefficient)
                    sign = "-" if coefficient < 0 else "+"
                    term = _literal(number) if node == ONE else self._term(number, node)
                    text += f" {sign} {term}" if text else ("-" if coefficient < 0 else "") + term
                return text, True
            case Product(factors):
                over = [f for f in factors if f not in self.names and isinstance(self.operations[f], Reciprocal)]
                above = "*".join(self._within_product(factor) for factor in factors if factor not in over)
                below = "".join(f"/{self._denominator(factor)}" for factor in over)
                return (above or "1.0") + below, False
            case Reciprocal():
                return f"1.0/{self._below(operation.node)}", False
            case Call(expression, arguments):
                names = {placeholder(i): self._node(argument)[0] for i, argument in enumerate(arguments)}
                inline = self.inline_angles and (self.real == "double" or _is_inlined_call(operation))
                return _print(_Printer(names, "fb_" if inline else "", OF_NUMBER.get(self.real, "")), expression), False
        raise TypeError(f"{operation} has no text")

    def _term(self, number: Number, node: int) -> str:
        """A term of a sum: a nested sum gets parentheses, whatever its sign."""
        return self._within_product(node) if number == 1 else self._multiple(number, node)

    def _denominator(self, reciprocal: int) -> str:
        operation = self.operations[reciprocal]
        assert isinstance(operation, Reciprocal)
        return self._below(operation.node)

    def _below(self, node: int) -> str:
        return self._node(node)[0] if node in self.names else f"({self._node(node)[0]})"


def _is_inlined_call(call: Call) -> bool:
    """Whether it is a sine, a cosine or an absolute value, which the runtime evaluates in the lanes of vectors."""
    return isinstance(call.expression, sm.sin | sm.cos | sm.Abs) and len(call.arguments) == 1


def _literal(value: Number) -> str:
    if math.isnan(value):
        return "NAN"
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number) or (value != 0 and number == 0.0):
        raise ModelError(f"The model contains {shown(value)}, which is beyond the range of double.")
    if isinstance(value, Fraction) and max(abs(value.numerator), value.denominator) < MAX_EXACT_INTEGER:
        return f"({float(value.numerator)!r}/{float(value.denominator)!r})"
    return repr(number)


class _Printer(C99CodePrinter):
    """C99 with numbers as literals, and placeholders by the text of their arguments.

    Parameters
    ----------
    arguments : mapping of Symbol to str
    prefix : str
        Of sin, cos and abs.
    of_number : str
        The function that makes a branch of a Piecewise of a number, where other branches are vectors.
    """

    def __init__(self, arguments: Mapping[sm.Symbol, str], prefix: str, of_number: str = "") -> None:
        # No macros such as M_PI: they are not part of C99.
        super().__init__({"strict": True, "math_macros": {}})
        self.arguments: dict[sm.Symbol, str] = dict(arguments)
        self.prefix = prefix
        self.of_number = of_number

    def _print_sin(self, expr: sm.sin) -> str:
        return f"{self.prefix}sin({self._print(expr.args[0])})"

    def _print_cos(self, expr: sm.cos) -> str:
        return f"{self.prefix}cos({self._print(expr.args[0])})"

    def _print_Abs(self, expr: sm.Abs) -> str:
        return f"{self.prefix or 'f'}abs({self._print(expr.args[0])})"

    def _print_Symbol(self, expr: sm.Symbol) -> str:
        return self.arguments[expr]

    def _print_NumberSymbol(self, expr: sm.NumberSymbol) -> str:
        return repr(float(expr))

    def _print_Integer(self, expr: sm.Integer) -> str:
        # Beyond the range of int, the literal must be a double.
        return str(expr) if abs(int(expr)) < 2**31 else repr(float(expr))

    def _print_ImaginaryUnit(self, expr: sm.Expr) -> str:
        raise PrintMethodNotImplementedError(f"{expr} is not real")

    def _print_Float(self, expr: sm.Float) -> str:
        if not math.isfinite(float(expr)):
            raise OverflowError(f"{expr} is beyond the range of double")
        return super()._print_Float(expr)  # type: ignore[no-any-return]

    def _print_Piecewise(self, expr: sm.Piecewise) -> str:
        if expr.args[-1].cond != sm.true:
            # Outside of all conditions, such as beyond the ends of a spline, it has no value.
            expr = sm.Piecewise(*expr.args, (sm.nan, True), evaluate=False)
        if self.of_number == OF_NUMBER["fb_simd"]:
            # The conditions are those of one state, so that whole vectors are chosen.
            branches = []
            for number, (branch, condition) in enumerate(expr.args):
                symbol = sm.Symbol(f"number{number}")
                self.arguments[symbol] = f"{self.of_number}({self._print(branch)})"
                branches.append((symbol if branch.is_number else branch, condition))
            expr = sm.Piecewise(*branches, evaluate=False)
        return super()._print_Piecewise(expr)  # type: ignore[no-any-return]

    def _print_NaN(self, _: sm.Expr) -> str:
        return "NAN"

    def _print_Pow(self, expr: sm.Pow) -> str:
        if expr.exp == sm.Rational(1, 3):
            # Not cbrt: the root of a negative number is not real in SymPy.
            return f"pow({self._print(expr.base)}, 1.0/3.0)"
        return super()._print_Pow(expr)  # type: ignore[no-any-return]


def _print(printer: _Printer, expr: sm.Expr) -> str:
    try:
        return printer.doprint(expr)  # type: ignore[no-any-return]
    except (PrintMethodNotImplementedError, OverflowError) as error:
        reason = str(error).partition("\n")[0]  # the rest is about options of the printer
        raise ModelError(
            f"The model contains {type(expr).__name__} or an expression in it that C99 does not have: {reason}"
        ) from error


def _argument_names(function: Function) -> dict[int, str]:
    """C identifiers for all arguments of a function: the user's own names where C allows them, all distinct."""
    names: dict[int, str] = {}
    taken = set(RESERVED) | {result.name for result in function.results} | {array.name for array in function.arguments}
    for array in function.arguments:
        for position, (node, leaf) in enumerate(zip(array.nodes, array.leaves, strict=True)):
            kind, name = leaf or Leaf("k", f"k{position}")
            if kind == "t":
                names[node] = "t"
                continue
            if kind == "a":
                name = f"{name}_rate"
            elif kind == "l":
                name = f"lambda{name}"
            identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
            if not re.match(r"[A-Za-z]", identifier) or re.fullmatch(rf"(z|{ANGLES})\d+|[A-Z0-9_]+|fb_\w*", identifier):
                # Avoids leading digits and underscores, the temporaries' names, macros (in capitals), and the runtime's
                # functions.
                identifier = f"{kind}_{identifier}"
            while identifier in taken:
                identifier += "_"
            taken.add(identifier)
            names[node] = identifier
    return names
