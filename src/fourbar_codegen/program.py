"""The intermediate representation: straight-line functions between arrays.

Plain frozen data. What can be printed is decided by what builds it (`lower`), how it
is printed by what reads it (`c_source`); in between, a Program checks itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from fourbar_codegen.share import Statements
from fourbar_codegen.structure import Split, Structure
from fourbar_codegen.tape import ONE, Leaf, Scalar, operands, operations_of

__all__ = ["Array", "Function", "Place", "Program", "Result", "Sizes"]


@dataclass(frozen=True)
class Array:
    """An argument that holds one node in each entry.

    Attributes
    ----------
    name : str
    nodes : tuple of int
    leaves : tuple of Leaf or None
        What each entry is called; None for a constant that is derived from parameters.
    """

    name: str
    nodes: tuple[int, ...]
    leaves: tuple[Leaf | None, ...]


@dataclass(frozen=True)
class Result:
    """A named array of expressions, row by row.

    Attributes
    ----------
    name : str
    shape : tuple of int
    entries : tuple of Scalar
    """

    name: str
    shape: tuple[int, ...]
    entries: tuple[Scalar, ...]


@dataclass(frozen=True)
class Function:
    """Statements that take argument arrays to result arrays.

    Attributes
    ----------
    name : str
    summary : str
        A sentence on what it computes.
    arguments : tuple of Array
    statements : tuple of (int, Node)
        The nodes in order of evaluation; every one is assigned once.
    results : tuple of Result
    operations_before_sharing : int
        Number of operations if every result were written out in full, nothing evaluated once for two places.
    """

    name: str
    summary: str
    arguments: tuple[Array, ...]
    statements: Statements
    results: tuple[Result, ...]
    operations_before_sharing: int

    def __post_init__(self) -> None:
        known = [node for array in self.arguments for node in array.nodes]
        defined = {ONE, *known}
        if len(defined) != len(known) + 1:
            raise ValueError(f"{self.name}: an argument stands in two places")
        for node, operation in self.statements:
            if node in defined:
                raise ValueError(f"{self.name}: node {node} is assigned twice")
            self._check_defined(operands(operation), defined)
            defined.add(node)
        for result in self.results:
            if math.prod(result.shape) != len(result.entries):
                raise ValueError(f"{self.name}: {result.name} has {len(result.entries)} entries, shape {result.shape}")
            self._check_defined([entry.node for entry in result.entries], defined)

    def _check_defined(self, nodes: Iterable[int], defined: set[int]) -> None:
        missing = set(nodes) - defined
        if missing:
            raise ValueError(f"{self.name}: nodes {sorted(missing)} used before definition")

    @property
    def operations(self) -> int:
        """Number of additions, multiplications, divisions and function calls."""
        counted = sum(map(operations_of, (operation for _, operation in self.statements)))
        entries = [entry for result in self.results for entry in result.entries]
        return counted + sum(not entry.is_number and entry.coefficient != 1 for entry in entries)


@dataclass(frozen=True)
class Place:
    """A point that is drawn.

    Attributes
    ----------
    name : str
    parent : int or None
        The point from which a line leads to it; None for the origin.
    body : str or None
        The body whose mass centre it is.
    """

    name: str
    parent: int | None
    body: str | None


@dataclass(frozen=True)
class Sizes:
    """Lengths of the arrays.

    Attributes
    ----------
    n_q, n_u, n_p, n_r : int
        Coordinates, speeds, parameters, inputs.
    n_h, n_c, n_o : int
        Position constraints; velocity constraints; outputs.
    n_breakpoints : int
        Times at which expressions have a jump or a kink.
    rank : int
        The number of velocity constraints that are not redundant: that of dependent speeds, or fewer.
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
    n_breakpoints: int
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
        Those that give derivatives or are for pictures: longer than the others, or called less often.
    split : Split
        The order in which `dynamics`' constraints are eliminated from full equations.
    structure : Structure or None
        How the equations of `dynamics` are solved, if not as full ones. Then that function gives the entries of M and J
        that are not zero, one after another.
    position_formulas : dict
        The position constraints as `formulas` writes them.
    moving : tuple of int
        The inputs that positions, velocities or constraints depend on.
    n_jumps : int
        How many of the breakpoints, which come first, are of positions or velocities.
    places : tuple of Place
        What `drawing` gives the positions of.
    forced : tuple of int
        Those of them that it gives forces on.
    """

    name: str
    sizes: Sizes
    functions: tuple[Function, ...]
    derivatives: tuple[Function, ...]
    split: Split
    structure: Structure | None
    position_formulas: dict[str, Any]
    moving: tuple[int, ...]
    n_jumps: int
    places: tuple[Place, ...]
    forced: tuple[int, ...]

    @property
    def parameters(self) -> tuple[Leaf, ...]:
        """The parameters, in order."""
        [array] = self.functions[0].arguments
        return tuple(leaf for leaf in array.leaves if leaf is not None)

    @property
    def inputs(self) -> tuple[Leaf, ...]:
        """The inputs, in order, with the rates of those that prescribe a motion."""
        arrays = (array for function in self.functions for array in function.arguments)
        return tuple(leaf for leaf in next(array for array in arrays if array.name == "r").leaves if leaf is not None)
