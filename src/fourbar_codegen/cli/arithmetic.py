"""Arithmetic expressions in command line options: a whitelist of Python's syntax, evaluated without eval."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from fourbar_codegen.errors import ModelError, meant, shown

__all__ = ["Arithmetic", "parse"]

Values = Mapping[str, float]
Function = Callable[[Values], float]

CONSTANTS = {"pi": math.pi}
FUNCTIONS: dict[str, Callable[..., float]] = {
    "abs": abs, "min": min, "max": max,
    **{
        name: getattr(math, name)
        for name in (
            "acos", "asin", "atan", "atan2", "cos", "cosh", "exp", "hypot", "log", "sin", "sinh", "sqrt", "tan", "tanh",
        )
    },
}  # fmt: skip
OPERATORS: dict[type, Callable[..., float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,  # which, unlike Python's own, has no complex values
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}

MAX_LENGTH = 1000
"""Largest number of characters: Python's parser is recursive."""


@dataclass(frozen=True)
class Arithmetic:
    """An expression of numbers and names.

    Attributes
    ----------
    text : str
        As it was written.
    names : frozenset of str
        The names in the expression that need values.
    """

    text: str
    names: frozenset[str]
    function: Function

    def __call__(self, values: Values) -> float:
        """The value of the expression for given values of the names.

        Raises
        ------
        ModelError
            If it has no real value, for instance because of a division by zero.
        """
        try:
            value = self.function(values)
        except (ArithmeticError, ValueError, TypeError) as error:
            value, reason = math.nan, str(error)
        else:
            reason = "it is not a real number" if isinstance(value, complex) else ""
        if reason:
            where = ", ".join(f"{name} = {values[name]:g}" for name in sorted(self.names))
            raise ModelError(f"{self.text} has no value{f' at {where}' if where else ''}: {reason}.")
        return float(value)


def parse(text: str, names: Collection[str]) -> Arithmetic:
    """Parse an arithmetic expression.

    Parameters
    ----------
    text : str
        Numbers, names, ``+ - * / **``, parentheses, ``pi``, and the functions of `FUNCTIONS`.
    names : collection of str
        Names that may occur. If ``pi`` is one of them, it replaces the constant.

    Raises
    ------
    ModelError
        If the text is not such an expression.

    Examples
    --------
    >>> parse("50*sin(pi*t)", {"t"})({"t": 0.5})
    50.0
    """
    if len(text) > MAX_LENGTH:
        raise ModelError(f"An expression has at most {MAX_LENGTH} characters, not {len(text)}.")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise ModelError(f"{shown(text)} is not an arithmetic expression: {getattr(error, 'msg', error)}.") from error
    found: set[str] = set()
    try:
        function = _function(tree, text, names, found)
    except RecursionError as error:
        raise ModelError(f"{shown(text)} is not an arithmetic expression: it is nested too deeply.") from error
    return Arithmetic(text, frozenset(found), function)


def _function(node: ast.expr, text: str, names: Collection[str], found: set[str]) -> Function:
    """The function that a node of the syntax tree computes; the names in it are added to `found`."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        try:
            number = float(node.value)
        except OverflowError as error:
            raise ModelError(f"In {shown(text)}, a number is too large.") from error
        return lambda _: number
    if isinstance(node, ast.Name):
        name = node.id
        if name in names:
            found.add(name)
            return lambda values: values[name]
        if name in CONSTANTS:
            number = CONSTANTS[name]
            return lambda _: number
        raise _unknown(name, text, names)
    parts: list[ast.expr] = []
    operation: Callable[..., float] | None = None
    if isinstance(node, ast.BinOp | ast.UnaryOp):
        parts = [node.left, node.right] if isinstance(node, ast.BinOp) else [node.operand]
        operation = OPERATORS.get(type(node.op))
        if isinstance(node.op, ast.BitXor):
            raise ModelError(f"In {shown(text)}, write ** for a power, not ^.")
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        if node.func.id not in FUNCTIONS:
            raise _unknown(node.func.id, text, names)
        parts, operation = node.args, FUNCTIONS[node.func.id]
    if operation is None or not parts:
        raise ModelError(
            f"In {shown(text)}, {ast.unparse(node)!r} is not allowed: an expression has numbers, names "
            f"({', '.join([*names, *CONSTANTS])}), + - * / **, parentheses and the functions "
            f"{', '.join(sorted(FUNCTIONS))}."
        )
    functions = [_function(part, text, names, found) for part in parts]
    apply = operation
    if len(functions) == 1:
        [only] = functions
        return lambda values: apply(only(values))
    if len(functions) == 2:
        first, second = functions
        return lambda values: apply(first(values), second(values))
    return lambda values: apply(*(function(values) for function in functions))


def _unknown(name: str, text: str, names: Collection[str]) -> ModelError:
    if name in FUNCTIONS:
        return ModelError(f"In {shown(text)}, {name} is a function: write {name}(...).")
    if name in {*names, *CONSTANTS}:
        return ModelError(f"In {shown(text)}, {name} is not a function: write {name}*(...) for a product.")
    return ModelError(
        f"In {shown(text)}, there is no {name}.{meant(name, [*names, *CONSTANTS, *FUNCTIONS])} There are "
        f"{', '.join([*names, *CONSTANTS])}, and the functions {', '.join(sorted(FUNCTIONS))}."
    )
