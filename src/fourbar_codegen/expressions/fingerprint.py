"""A digest of nested plain data and SymPy expressions, the same on every machine and in every process."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass

import sympy as sm
from sympy.core.function import AppliedUndef

__all__ = ["fingerprint"]


def fingerprint(data: object) -> str:
    """Digest dataclasses, tuples, mappings, strings, numbers and SymPy expressions.

    Fields of dataclasses with ``hash=False`` do not count.

    Parameters
    ----------
    data : object

    Returns
    -------
    str
        64 hexadecimal digits.

    Notes
    -----
    An expression is digested as a graph, every distinct node once, because the expressions of chained
    frames are exponentially larger as trees.

    Examples
    --------
    >>> import sympy as sm
    >>> x, y = sm.symbols("x y")
    >>> fingerprint((x + y, 1)) == fingerprint((y + x, 1)) != fingerprint((x - y, 1))
    True
    """
    writer = _Writer()
    writer.write(data)
    return writer.hash.hexdigest()


class _Writer:
    def __init__(self) -> None:
        self.hash = hashlib.sha256()
        self.numbers: dict[sm.Basic, int] = {}

    def line(self, *words: object) -> None:
        # repr delimits the words, so that different sequences of words have different texts.
        self.hash.update(repr(words).encode())

    def write(self, data: object) -> None:
        if isinstance(data, sm.Basic):
            self.line("expression", self.node(data))
        elif is_dataclass(data) and not isinstance(data, type):
            digested = [field for field in fields(data) if field.hash is not False]
            self.line(type(data).__name__, len(digested))
            for field in digested:
                self.line(field.name)
                self.write(getattr(data, field.name))
        elif isinstance(data, Mapping):
            self.line("mapping", len(data))
            for key, value in data.items():
                self.write(key)
                self.write(value)
        elif isinstance(data, tuple | list):
            self.line("sequence", len(data))
            for item in data:
                self.write(item)
        elif data is None or isinstance(data, bool | int | float | str):
            self.line(type(data).__name__, data)
        else:
            raise TypeError(f"Cannot digest a {type(data).__name__}.")

    def node(self, expr: sm.Basic) -> int:
        # Depth first without recursion, each node after its arguments.
        stack = [expr]
        while stack:
            node = stack[-1]
            if node in self.numbers:
                stack.pop()
            elif missing := [argument for argument in node.args if argument not in self.numbers]:
                stack.extend(reversed(missing))
            else:
                self.line(_head(node), *(self.numbers[argument] for argument in node.args))
                self.numbers[node] = len(self.numbers)
        return self.numbers[expr]


def _head(node: sm.Basic) -> str:
    if isinstance(node, AppliedUndef):
        return f"function {node.func.__name__}"
    if isinstance(node, sm.Dummy):  # numbered by first appearance, since its index differs between processes
        return f"dummy {sm.srepr(sm.Symbol(node.name, **node.assumptions0))}"
    return type(node).__name__ if node.args else sm.srepr(node)
