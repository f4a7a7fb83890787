"""The intermediate representation: straight-line functions between arrays.

Plain frozen data over SymPy expressions. What can be printed is decided by what builds it (`lower`), how it
is printed by what reads it (`c_source`); in between, a Program checks itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy as sm

__all__ = ["Array", "Function", "Program", "Result", "Sizes"]


@dataclass(frozen=True)
class Array:
    """An argument that holds one symbol in each entry.

    Attributes
    ----------
    name : str
    symbols : tuple of Symbol
    """

    name: str
    symbols: tuple[sm.Symbol, ...]


@dataclass(frozen=True)
class Result:
    """A named array of expressions, row by row.

    Attributes
    ----------
    name : str
    shape : tuple of int
    entries : tuple of Expr
    """

    name: str
    shape: tuple[int, ...]
    entries: tuple[sm.Expr, ...]


@dataclass(frozen=True)
class Function:
    """Statements that take argument arrays to result arrays.

    Attributes
    ----------
    name : str
    summary : str
        A sentence on what it computes.
    arguments : tuple of Array
    statements : tuple of (Symbol, Expr)
        In order of evaluation; every symbol is assigned once.
    results : tuple of Result
    operations_before_sharing : int
        Number of operations if every result were written out in full, nothing evaluated once for two places.
    """

    name: str
    summary: str
    arguments: tuple[Array, ...]
    statements: tuple[tuple[sm.Symbol, sm.Expr], ...]
    results: tuple[Result, ...]
    operations_before_sharing: int

    def __post_init__(self) -> None:
        known = [symbol for array in self.arguments for symbol in array.symbols]
        defined = set(known)
        if len(defined) != len(known):
            raise ValueError(f"{self.name}: an argument symbol stands in two places")
        for symbol, expr in self.statements:
            if symbol in defined:
                raise ValueError(f"{self.name}: {symbol} is assigned twice")
            self._check_defined(expr, defined)
            defined.add(symbol)
        for result in self.results:
            size = 1
            for length in result.shape:
                size *= length
            if size != len(result.entries):
                raise ValueError(f"{self.name}: {result.name} has {len(result.entries)} entries, shape {result.shape}")
            for expr in result.entries:
                self._check_defined(expr, defined)

    def _check_defined(self, expr: sm.Expr, defined: set[sm.Symbol]) -> None:
        missing = expr.free_symbols - defined
        if missing:
            raise ValueError(f"{self.name}: {sorted(map(str, missing))} used before definition")

    @property
    def operations(self) -> int:
        """Number of additions, multiplications, divisions and function calls."""
        expressions = [expr for _, expr in self.statements]
        expressions += [expr for result in self.results for expr in result.entries]
        return sum(int(sm.count_ops(expr)) for expr in expressions)


@dataclass(frozen=True)
class Sizes:
    """Lengths of the arrays.

    Attributes
    ----------
    n_q, n_u, n_p, n_r : int
        Coordinates, speeds, parameters, inputs.
    n_h, n_c, n_o : int
        Position constraints; velocity constraints; outputs.
    rank : int
        The number of velocity constraints that are not redundant: that of dependent speeds.
    n_constants : int
        Parameters and what is derived from them alone.
    """

    n_q: int
    n_u: int
    n_p: int
    n_r: int
    n_h: int
    n_c: int
    n_o: int
    rank: int
    n_constants: int


@dataclass(frozen=True)
class Program:
    """All functions of one model.

    Attributes
    ----------
    name : str
    sizes : Sizes
    functions : tuple of Function
        `prepare` first, which derives the constants that all others take.
    derivatives : tuple of Function
        Those that give derivatives: longer than the others, and called less often.
    """

    name: str
    sizes: Sizes
    functions: tuple[Function, ...]
    derivatives: tuple[Function, ...]
