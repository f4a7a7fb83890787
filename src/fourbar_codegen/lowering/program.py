"""The intermediate representation: straight-line functions between arrays.

Plain frozen data. `lower` decides what is printed, `c_source` how. A Program checks its own consistency.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from fourbar_codegen.expressions.tape import ONE, Call, Leaf, Node, Result, operands, operations_of
from fourbar_codegen.layout import Form
from fourbar_codegen.runtime.enumerations import Role

__all__ = [
    "Array",
    "Entries",
    "Factors",
    "Function",
    "PivotOrder",
    "Program",
    "Sizes",
    "Statements",
    "Structure",
    "fits_lanes",
]

MAX_ARGUMENTS = 4
"""Most arguments of functions that arithmetic/real.h can evaluate lane by lane."""

Statements = tuple[tuple[int, Node], ...]
"""Nodes and what they are, in order of evaluation."""

Entries = tuple[tuple[int, int], ...]
"""Rows and columns of the entries of a matrix that are not zero."""


def fits_lanes(statements: Statements) -> bool:
    """Whether all functions that are called can be evaluated lane by lane."""
    return all(len(o.arguments) <= MAX_ARGUMENTS for _, o in statements if isinstance(o, Call))


@dataclass(frozen=True)
class Array:
    """An argument that holds one node in each entry.

    Attributes
    ----------
    name : str
    nodes : tuple of int
    leaves : tuple of Leaf or None
        The name of each entry; None for a constant that is derived from parameters.
    """

    name: str
    nodes: tuple[int, ...]
    leaves: tuple[Leaf | None, ...]


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
        Number of operations if every result were written out in full, without common subexpressions.
    role : Role or None
        What it computes; None for what only other functions call.
    is_vectorized : bool
        Whether it is also evaluated for batches of states, in the lanes of vectors.
    factors : Function or None
        Of products of derivatives with a direction: what they need of a state, which is their argument `factors`.
    """

    name: str
    summary: str
    arguments: tuple[Array, ...]
    statements: Statements
    results: tuple[Result, ...]
    operations_before_sharing: int
    role: Role | None = None
    is_vectorized: bool = False
    factors: Function | None = None

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
        """Number of additions, multiplications, divisions and function calls, for one direction."""
        counted = 0 if self.factors is None else self.factors.operations
        counted += sum(map(operations_of, (operation for _, operation in self.statements)))
        entries = [entry for result in self.results for entry in result.entries]
        return counted + sum(not entry.is_number and entry.coefficient != 1 for entry in entries)


@dataclass(frozen=True)
class Structure:
    """A fixed elimination order of the unknowns, numbered u' first, then -lambda.

    Attributes
    ----------
    mass_entries, jacobian_entries : tuple of (int, int)
        Rows and columns of the entries that are not zero: of M on and below the diagonal, and of J row by row.
    order : tuple of int
        The unknown that each step eliminates.
    below : tuple of tuple of int
        For each step, the later ones that have an entry in its column.
    """

    mass_entries: Entries
    jacobian_entries: Entries
    order: tuple[int, ...]
    below: tuple[tuple[int, ...], ...]

    @property
    def is_early(self) -> bool:
        """Whether a constraint comes before a speed in it, so that it may not be independent with those before it."""
        n_u = len(self.order) - len({row for row, _ in self.jacobian_entries})
        step = {unknown: k for k, unknown in enumerate(self.order)}
        return any(step[n_u + row] < step[speed] for row, speed in self.jacobian_entries)

    def tables(self) -> dict[str, list[int]]:
        """The index tables of linear_algebra/sparse_equations.h.

        In memory, the diagonal in the order of the steps comes first, then the columns below it.
        """
        n_u = len(self.order) - len({row for row, _ in self.jacobian_entries})
        step = {unknown: k for k, unknown in enumerate(self.order)}
        starts = [0]
        for rows in self.below:
            starts.append(starts[-1] + len(rows))
        place = {(k, k): k for k in range(len(self.order))}
        for k, rows in enumerate(self.below):
            place.update({(row, k): len(self.order) + starts[k] + i for i, row in enumerate(rows)})

        def at(a: int, b: int) -> int:
            return place[max(step[a], step[b]), min(step[a], step[b])]

        rows_of_jacobian = [[c for r, c in self.jacobian_entries if r == row] for row in range(len(self.order) - n_u)]
        pairs = [at(a, b) for columns in rows_of_jacobian for i, a in enumerate(columns) for b in columns[: i + 1]]
        row_starts = [0]
        for columns in rows_of_jacobian:
            row_starts.append(row_starts[-1] + len(columns))
        # The last row first, so that a column can be scaled in place while it is used.
        targets = [
            place[rows[i], rows[j]] for rows in self.below for i in reversed(range(len(rows))) for j in range(i + 1)
        ]
        return {
            "mass_row": [row for row, _ in self.mass_entries],
            "mass_column": [column for _, column in self.mass_entries],
            "mass_place": [at(row, column) for row, column in self.mass_entries],
            "jacobian_row": row_starts,
            "jacobian_column": [column for _, column in self.jacobian_entries],
            "jacobian_place": [at(n_u + row, column) for row, column in self.jacobian_entries],
            "pair_place": pairs,
            "unknown": list(self.order),
            "column": starts,
            "below": [row for rows in self.below for row in rows],
            "target": targets,
        }


@dataclass(frozen=True)
class Factors:
    """Factors of M for the recursive form, in which `dynamics` returns them instead of M.

    Attributes
    ----------
    nodes : tuple of int
        What `mass_solve` and `mass_product` need of a state, besides constants; they follow the pivots.
    """

    nodes: tuple[int, ...]


@dataclass(frozen=True)
class PivotOrder:
    """A pivot order in which dense constraints are solved for as many speeds.

    Attributes
    ----------
    rows : tuple of int
        The constraints, in the order of elimination.
    speeds : tuple of int
        The speeds that they are solved for, in that order, then the others.
    """

    rows: tuple[int, ...]
    speeds: tuple[int, ...]


@dataclass(frozen=True)
class Sizes:
    """Lengths of the arrays.

    Attributes
    ----------
    n_q, n_u, n_z, n_p, n_r : int
        Coordinates, speeds, auxiliary states, parameters, inputs.
    n_h, n_c, n_n, n_i, n_o : int
        Position constraints; velocity constraints; unknown forces that drive the motion; position constraints that no
        speed changes; outputs.
    n_points, n_forces : int
        Drawn points, and those of them with forces of inputs.
    n_breakpoints : int
        Breakpoints, times at which expressions of time may have a jump or a kink.
    n_conditions : int
        Of jumps of the equations of motion at times that are not known beforehand.
    rank : int
        The number of velocity constraints that are not redundant: that of dependent speeds, or fewer.
    n_constants : int
        Parameters and what is derived from them alone.
    """

    n_q: int
    n_u: int
    n_z: int
    n_p: int
    n_r: int
    n_h: int
    n_c: int
    n_n: int
    n_i: int
    n_o: int
    n_points: int
    n_forces: int
    n_breakpoints: int
    n_conditions: int
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
        First `prepare`, which derives the constants that all others take.
    constants : Array
        These constants.
    position_rows : tuple of (int or None)
        For each position constraint the row of J that keeps it, if one does.
    pivot_order : PivotOrder
        The order in which the constraints are eliminated from dense equations.
    structure : Structure or None
        The sparse elimination order of the equations in `dynamics`, which then returns only the nonzero entries of M
        and J; None for dense or recursive equations.
    factors : Factors or None
        For recursive equations, the factors of M in `dynamics`; None for others.
    states_need_solution, states_need_multipliers : bool
        Whether state equations contain u' or multipliers; whether they contain multipliers.
    outputs_need_solution, outputs_need_inputs : bool
        Whether outputs contain u' or multipliers; whether they depend on inputs.
    forces_are_linear : bool
        Whether the equations are linear in the unknown forces that drive the motion.
    """

    name: str
    sizes: Sizes
    functions: tuple[Function, ...]
    constants: Array
    position_rows: tuple[int | None, ...]
    pivot_order: PivotOrder
    structure: Structure | None
    factors: Factors | None
    states_need_solution: bool
    states_need_multipliers: bool
    outputs_need_solution: bool
    outputs_need_inputs: bool
    forces_are_linear: bool

    @property
    def form(self) -> Form:
        """How accelerations are solved for."""
        if self.factors is not None:
            return Form.RECURSIVE
        return Form.DENSE if self.structure is None else Form.SPARSE

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
