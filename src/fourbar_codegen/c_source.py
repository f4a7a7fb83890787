"""Program -> C text: a kernel's header and source, the same on every machine and in every process.

SymPy's C99 printer prints the expressions, the templates here lay them out.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import sympy as sm
from sympy.printing.c import C99CodePrinter
from sympy.printing.codeprinter import PrintMethodNotImplementedError

from fourbar_codegen.errors import ModelError
from fourbar_codegen.program import Array, Function, Program
from fourbar_codegen.structure import Structure
from fourbar_codegen.tape import (
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
    operands,
    placeholder,
)

__all__ = ["derivatives_text", "header_text", "kernel_text"]

LINE = 110

LONGEST = 500
"""Statements in one C function. Compilers need more than linear time for longer ones."""

PART = 200
"""Statements in each part of a longer one."""

ZEROS = 32
"""Zeros in a result that are stored one by one."""

INLINED = 8
"""Operands of the longest expression that stands in another one, instead of on a line of its own."""

CARRIED = "carried"
"""The array through which the parts of a longer function hand on values."""

RESERVED = frozenset(
    # C keywords, the macros of <math.h>, and those that compilers define for their system
    "auto break case char const continue default do double else enum extern float for goto if inline int long "
    "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "NAN INFINITY HUGE_VAL bool true false asm typeof NULL unix linux i386 errno signgam math_errhandling "
    # names that the templates and the runtime's headers use
    "t x q p r constants accelerations multipliers work status i j k carried "
    # functions that the printer may call
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs floor fma fmax "
    "fmin fmod hypot lgamma log log10 log1p log2 pow round sin sinh sqrt tan tanh tgamma trunc main".split()
)


class _Printer(C99CodePrinter):
    """C99 with numbers as literals, placeholders by the text of their arguments, and a prefix for sin and cos."""

    def __init__(self, arguments: Mapping[sm.Symbol, str], angles: str) -> None:
        # No macros such as M_PI: they are not part of C99.
        super().__init__({"strict": True, "math_macros": {}})
        self.arguments = arguments
        self.angles = angles

    def _print_sin(self, expr: sm.sin) -> str:
        return f"{self.angles}sin({self._print(expr.args[0])})"

    def _print_cos(self, expr: sm.cos) -> str:
        return f"{self.angles}cos({self._print(expr.args[0])})"

    def _print_Symbol(self, expr: sm.Symbol) -> str:
        return self.arguments[expr]

    def _print_NumberSymbol(self, expr: sm.NumberSymbol) -> str:
        return repr(float(expr))

    def _print_Integer(self, expr: sm.Integer) -> str:
        # Beyond the range of int, a literal needs to be one of double.
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
        return super()._print_Piecewise(expr)  # type: ignore[no-any-return]

    def _print_NaN(self, _: sm.Expr) -> str:
        return "NAN"

    def _print_Pow(self, expr: sm.Pow) -> str:
        if expr.exp == sm.Rational(1, 3):
            # Not cbrt: of a negative number, the root is not a number in SymPy.
            return f"pow({self._print(expr.base)}, 1.0/3.0)"
        return super()._print_Pow(expr)  # type: ignore[no-any-return]


def kernel_text(program: Program, names: Mapping[str, Sequence[str]]) -> str:
    """The C source of a model's kernel.

    Parameters
    ----------
    program : Program
    names : mapping of str to sequence of str
        What the model calls its `coordinates`, `speeds`, `parameters`, `inputs` and `outputs`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If an expression has no counterpart in C99.
    """
    sizes = program.sizes
    functions = "\n\n".join(_function_text(function, function.name, "static ", "fb_") for function in program.functions)
    return f"""\
/* Equations of motion of the model "{program.name}", generated by fourbar_codegen. Do not edit.
 *
{_layout_comment(names)}
 *
 * The functions below evaluate straight-line code; fourbar_model.h, included at the end, solves the
 * equations that they set up. Matrices are stored row by row.
 */
#include "{program.name}_kernel.h"
#include "fourbar_angle.h"

#include <math.h>

enum {{
    N_Q = {sizes.n_q},
    N_U = {sizes.n_u},
    N_P = {sizes.n_p},
    N_R = {sizes.n_r},
    N_H = {sizes.n_h},
    N_C = {sizes.n_c},
    N_O = {sizes.n_o},
    N_RANK = {sizes.rank},
    N_CONSTANTS = {sizes.n_constants}
}};
{_structure_text(program.structure)}
{functions}

#define FB_NAME(function) {program.name}_##function
#include "fourbar_model.h"
"""


def _structure_text(structure: Structure | None) -> str:
    """The tables of fourbar_sparse.h."""
    if structure is None:
        return ""
    tables = structure.tables()
    lines = [
        "",
        "/* M and J by their entries that are not zero, and the order of elimination; see fourbar_sparse.h. */",
        "#define FB_SPARSE",
        (
            f"enum {{ N_MASS = {len(structure.mass_entries)}, N_JACOBIAN = {len(structure.jacobian_entries)}, "
            f"N_BELOW = {len(tables['below'])} }};"
        ),
    ]
    for name, values in tables.items():
        text = f"static const int {name}[{max(len(values), 1)}] = {{{', '.join(map(str, values or [0]))}}};"
        lines += textwrap.wrap(text, LINE, subsequent_indent="    ")
    return "\n".join(lines) + "\n"


def derivatives_text(program: Program, names: Mapping[str, Sequence[str]]) -> str:
    """The C source of a model's derivatives, compiled beside the kernel, which takes about as long.

    Parameters
    ----------
    program, names
        As for `kernel_text`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If an expression has no counterpart in C99.
    """
    functions = "\n\n".join(_function_text(f, f"{program.name}_{f.name}", "", "") for f in program.derivatives)
    return f"""\
/* Derivatives of the equations of motion of the model "{program.name}", generated by fourbar_codegen. Do not edit.
 *
{_layout_comment(names)}
 *
 * fourbar_model.h, in {program.name}_kernel.c, solves the equations that they set up. Matrices are stored row by row.
 */
#include "{program.name}_kernel.h"

#include <math.h>

{functions}
"""


def header_text(program: Program, names: Mapping[str, Sequence[str]]) -> str:
    """The C header that declares a model's kernel."""
    guard = f"FOURBAR_CODEGEN_{program.name}_KERNEL_H"
    return f"""\
/* Kernel of the model "{program.name}", generated by fourbar_codegen. Do not edit.
 *
{_layout_comment(names)}
 *
 * fourbar_kernel.h says how to call it.
 */
#ifndef {guard}
#define {guard}

#include "fourbar_kernel.h"

extern const fb_kernel {program.name}_kernel;

fb_sensitivity {program.name}_sensitivity, {program.name}_parameter_sensitivity, {program.name}_input_sensitivity;
fb_constraint_sensitivity {program.name}_constraint_sensitivity;

#endif
"""


def _layout_comment(names: Mapping[str, Sequence[str]]) -> str:
    rows = (
        ("x", "state", (*names["coordinates"], *names["speeds"])),
        ("p", "parameters", names["parameters"]),
        ("r", "inputs", names["inputs"]),
        ("outputs", "", names["outputs"]),
    )
    lines = []
    for letter, word, entries in rows:
        text = f"{letter}{word and ', '}{word}: " + (", ".join(map(_comment, entries)) or "none")
        lines += textwrap.wrap(text, 96, initial_indent=" *   ", subsequent_indent=" *     ", break_on_hyphens=False)
    return "\n".join([" * Arguments", *lines])


def _comment(name: str) -> str:
    """A user's name as it may stand in a comment: printable, and unable to end it."""
    return re.sub(r"[^\w{}^'\-+ ]", "_", name, flags=re.ASCII)


def _function_text(function: Function, name: str, storage: str, angles: str) -> str:
    text = _Text(function, angles)
    parts = _parts(function, text)
    last = len(parts) - 1
    carried = _carried(parts)
    if not last:
        head = _head(function, f"{storage}void {name}", [])
        return "\n".join([f"/* {function.summary} */", *head, "{", *_body(function, parts[0], text, carried), "}"])
    texts = []
    for number, part in enumerate(parts, start=1):
        head = _head(function, f"static FB_PART void {function.name}_{number}", [f"double *restrict {CARRIED}"])
        texts.append("\n".join([*head, "{", *_body(function, part, text, carried), "}"]))
    arguments = [array.name for array in function.arguments] + [result.name for result in function.results]
    calls = [f"    {function.name}_{number + 1}({', '.join([*arguments, CARRIED])});" for number in range(last + 1)]
    head = _head(function, f"{storage}void {name}", [])
    texts.append("\n".join([*head, "{", f"    double {CARRIED}[{max(len(carried), 1)}];", *calls, "}"]))
    texts[0] = f"/* {function.summary} */\n{texts[0]}"
    return "\n\n".join(texts)


class _Text:
    """The text of a function's operations, those used once written where they are used.

    Attributes
    ----------
    names : dict of int to str
        What the arguments and the nodes that have a line of their own are called.
    lines : list of int
        The latter nodes, in order of evaluation.
    """

    def __init__(self, function: Function, angles: str) -> None:
        self.angles = angles
        self.operations = dict(function.statements)
        self.names = _argument_names(function)
        uses = Counter(operand for operation in self.operations.values() for operand in operands(operation))
        uses.update(entry.node for result in function.results for entry in result.entries)
        named = {a for o in self.operations.values() if isinstance(o, Call) for a in o.arguments}
        named.update(node for node, count in uses.items() if count > 1)
        lengths: dict[int, int] = {}  # operands in the text of what has no line of its own
        for node, operation in self.operations.items():
            length = sum(lengths.get(operand, 1) for operand in operands(operation))
            if node not in named and not isinstance(operation, Call) and length <= INLINED:
                lengths[node] = length
        self.lines = [node for node in self.operations if node not in lengths]
        self.names.update((node, f"z{position}") for position, node in enumerate(self.lines))

    def referred(self, node: int) -> set[int]:
        """The nodes that the text of a node names; of one that has a name, itself."""
        found: set[int] = set()
        stack = [node]
        while stack:
            node = stack.pop()
            if node in self.names:
                found.add(node)
            elif node != ONE:
                stack.extend(operands(self.operations[node]))
        return found

    def referred_by(self, line: int) -> set[int]:
        """The nodes that a line names on its right-hand side."""
        return {name for operand in operands(self.operations[line]) for name in self.referred(operand)}

    def value(self, line: int) -> str:
        """The right-hand side of a line."""
        return self._operation(self.operations[line])[0]

    def scalar(self, scalar: Scalar) -> str:
        """A result."""
        if scalar.is_number:
            return _literal(scalar.coefficient)
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
        """The text of an operand, and whether it is a sum, which products put in parentheses."""
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
                return _print(_Printer(names, self.angles), expression), False
        raise TypeError(f"{operation} has no text")

    def _term(self, number: Number, node: int) -> str:
        """A term of a sum: a sum in it stands in parentheses, whatever its sign."""
        return self._within_product(node) if number == 1 else self._multiple(number, node)

    def _denominator(self, reciprocal: int) -> str:
        operation = self.operations[reciprocal]
        assert isinstance(operation, Reciprocal)
        return self._below(operation.node)

    def _below(self, node: int) -> str:
        return self._node(node)[0] if node in self.names else f"({self._node(node)[0]})"


def _literal(value: Number) -> str:
    if isinstance(value, Fraction):
        return f"({float(value.numerator)!r}/{float(value.denominator)!r})"
    if math.isnan(value):
        return "NAN"
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ModelError(f"The model contains {value}, which is beyond the range of double.")
    return repr(number)


@dataclass(frozen=True)
class _Part:
    """Consecutive lines of a function, and the entries of its results that can be stored behind them.

    Attributes
    ----------
    lines : tuple of int
    cleared : tuple of (str, int)
        Name and length of results that are set to zero before anything is stored in them.
    stores : tuple of (str, int, Scalar)
        Name of the result, position in it, value.
    used : frozenset of int
        The nodes that lines and stores name.
    """

    lines: tuple[int, ...]
    cleared: tuple[tuple[str, int], ...]
    stores: tuple[tuple[str, int, Scalar], ...]
    used: frozenset[int]


def _parts(function: Function, text: _Text) -> list[_Part]:
    count = 1 if len(text.lines) <= LONGEST else -(-len(text.lines) // PART)
    size = max(1, -(-len(text.lines) // count))
    defined_in = {node: position // size for position, node in enumerate(text.lines)}
    stores: list[list[tuple[str, int, Scalar]]] = [[] for _ in range(count)]
    used: list[set[int]] = [set() for _ in range(count)]
    cleared: list[tuple[str, int]] = []
    for result in function.results:
        sparse = sum(not entry for entry in result.entries) > ZEROS
        if sparse:
            cleared.append((result.name, len(result.entries)))
        for position, entry in enumerate(result.entries):
            if sparse and not entry:
                continue
            referred = text.referred(entry.node)
            part = max((defined_in.get(node, 0) for node in referred), default=0)
            stores[part].append((result.name, position, entry))
            used[part] |= referred
    parts = []
    for i in range(count):
        lines = tuple(text.lines[i * size : (i + 1) * size])
        names = used[i].union(*(text.referred_by(line) for line in lines))
        parts.append(_Part(lines, tuple(cleared if i == 0 else ()), tuple(stores[i]), frozenset(names)))
    return parts


def _carried(parts: Sequence[_Part]) -> dict[int, int]:
    """The places of the values that one part hands on to later ones."""
    later: set[int] = set()
    carried: list[int] = []
    for part in reversed(parts):
        carried += [node for node in part.lines if node in later]
        later |= part.used
    return {node: place for place, node in enumerate(carried)}


def _body(function: Function, part: _Part, text: _Text, carried: Mapping[int, int]) -> list[str]:
    """The lines of a function, or of a part of one."""
    names, own = text.names, set(part.lines)
    body = [line for array in function.arguments for line in _unpack(array, part.used, names)]
    outside = sorted((carried[node], node) for node in part.used - own if node in carried)
    body += [f"    const double {names[node]} = {CARRIED}[{place}];" for place, node in outside]
    body += [_statement(f"const double {names[line]} = {text.value(line)};") for line in part.lines]
    body += [f"    {CARRIED}[{carried[line]}] = {names[line]};" for line in part.lines if line in carried]
    for name, length in part.cleared:
        body += [f"    for (int i = 0; i < {length}; ++i)", f"        {name}[i] = 0.0;"]
    stored = {name for name, *_ in (*part.cleared, *part.stores)}
    body += [f"    (void){result.name};" for result in function.results if result.name not in stored]
    body += [_statement(f"{name}[{position}] = {text.scalar(entry)};") for name, position, entry in part.stores]
    return body


def _head(function: Function, declared: str, more: Sequence[str]) -> list[str]:
    parameters = [_parameter(array) for array in function.arguments]
    parameters += [f"double *restrict {result.name}" for result in function.results]
    parameters += more
    # No line breaks within a parameter: textwrap leaves the spaces alone that are not ASCII.
    text = f"{declared}(".replace(" ", "\xa0") + ", ".join(p.replace(" ", "\xa0") for p in parameters)
    wrapped = textwrap.wrap(f"{text})", LINE, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)
    return [line.replace("\xa0", " ") for line in wrapped]


def _print(printer: _Printer, expr: sm.Expr) -> str:
    try:
        return printer.doprint(expr)  # type: ignore[no-any-return]
    except (PrintMethodNotImplementedError, OverflowError) as error:
        kind = type(expr).__name__
        raise ModelError(f"The model contains {kind} or an expression in it that C99 does not have: {error}") from error


def _statement(text: str) -> str:
    lines = textwrap.wrap(text, LINE - 4, break_long_words=False, break_on_hyphens=False)
    return "\n".join(("    " if not number else "        ") + line for number, line in enumerate(lines))


def _parameter(array: Array) -> str:
    return "double t" if array.name == "t" else f"const double *restrict {array.name}"


def _unpack(array: Array, used: Collection[int], names: Mapping[int, str]) -> list[str]:
    """Names for the entries of an argument that the function reads."""
    if array.name == "t":
        return [] if array.nodes[0] in used else ["    (void)t;"]
    lines = [
        f"    const double {names[node]} = {array.name}[{position}];"
        for position, node in enumerate(array.nodes)
        if node in used
    ]
    return lines or [f"    (void){array.name};"]


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
            if not re.match(r"[A-Za-z]", identifier) or re.fullmatch(r"z\d+|[A-Z0-9_]+", identifier):
                # Leading digits and underscores; the temporaries' names; macros, which are written in capitals.
                identifier = f"{kind}_{identifier}"
            while identifier in taken:
                identifier += "_"
            taken.add(identifier)
            names[node] = identifier
    return names
