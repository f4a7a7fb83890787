"""Program -> Schedule: the order in which each function evaluates, stores and passes on its values.

A value that is used once is written inline, unless the expression becomes long. Long functions are split into parts, so
that compilers take linear time. Sines and cosines of several angles are evaluated together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy as sm

from fourbar_codegen.expressions.tape import ONE, Call, Scalar, operands
from fourbar_codegen.lowering.elimination import MAX_CONSTRAINTS
from fourbar_codegen.lowering.program import Function, Program, fits_lanes
from fourbar_codegen.runtime.enumerations import Role

__all__ = [
    "ANGLES_PER_VECTOR",
    "Assign",
    "Carry",
    "Clear",
    "EvaluateAngles",
    "Load",
    "Part",
    "Resume",
    "Schedule",
    "ScheduledFunction",
    "Step",
    "Store",
    "schedule",
    "schedule_function",
]

MAX_INLINED_OPERANDS = 8
"""Most operands of an expression that is written inline instead of on a line of its own."""

MAX_STATEMENTS = 500
"""Statements in one C function. Compilers need more than linear time for longer ones."""

STATEMENTS_PER_PART = 200
"""Statements in each part of a longer one."""

ANGLES_PER_VECTOR = 4
"""Angles whose sines and cosines `fb_angles_of` evaluates in the lanes of a vector."""

MAX_SINGLE_ZEROS = 32
"""Zeros in a result that are stored one by one."""

MAX_INLINED_OPERATIONS = 600
"""Most operations of equations that are inlined into their callers. For batches of states, this gains 7 % for a chain
of eight links (527), and 3 % for the bicycle (1301), which then takes 50 % longer to compile."""


@dataclass(frozen=True)
class Load:
    """Give an entry of an argument its name."""

    node: int
    array: str
    position: int


@dataclass(frozen=True)
class Resume:
    """Give a value from an earlier part its name."""

    node: int
    place: int


@dataclass(frozen=True)
class EvaluateAngles:
    """Evaluate the sines and cosines of several angles together."""

    group: int
    angles: tuple[int, ...]


@dataclass(frozen=True)
class Assign:
    """Evaluate a node; or take it from a group of angles: the group, "sin" or "cos", and the position in it."""

    node: int
    angle: tuple[int, str, int] | None = None


@dataclass(frozen=True)
class Clear:
    """Set all entries of a result to zero."""

    result: str
    length: int


@dataclass(frozen=True)
class Store:
    """Store an entry of a result."""

    result: str
    position: int
    value: Scalar


@dataclass(frozen=True)
class Carry:
    """Pass a value on to later parts."""

    node: int
    place: int


Step = Load | Resume | EvaluateAngles | Assign | Clear | Store | Carry


@dataclass(frozen=True)
class Part:
    """A function, or a part of a longer one.

    Attributes
    ----------
    unused : tuple of str
        Arguments and results that it does not use.
    steps : tuple of Step
    """

    unused: tuple[str, ...]
    steps: tuple[Step, ...]


@dataclass(frozen=True)
class ScheduledFunction:
    """A function in the order in which it is evaluated.

    Attributes
    ----------
    function : Function
    lines : tuple of int
        The nodes that are given a name, in order of evaluation; the others are evaluated where they are used.
    parts : tuple of Part
    n_carried : int
        Number of values that parts pass on to later ones.
    inline_angles : bool
        Whether sines and cosines are those of arithmetic/angle.h instead of the library's.
    factors : ScheduledFunction or None
        `Function.factors`.
    """

    function: Function
    lines: tuple[int, ...]
    parts: tuple[Part, ...]
    n_carried: int
    inline_angles: bool
    factors: ScheduledFunction | None


@dataclass(frozen=True)
class Schedule:
    """All functions of a program as they are evaluated.

    Attributes
    ----------
    program : Program
    functions : tuple of ScheduledFunction
    has_batches : bool
        Whether there are functions for batches of states. There must be a fixed pivot order, x' must not need
        multipliers or unknown forces, and no function of many arguments may be called.
    is_short : bool
        Whether the equations are inlined into their callers; see arithmetic/real.h.
    """

    program: Program
    functions: tuple[ScheduledFunction, ...]
    has_batches: bool
    is_short: bool


def schedule(program: Program) -> Schedule:
    """Schedule the functions of a program.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.lowering.lower import lower
    >>> from fourbar_codegen.models import four_bar
    >>> scheduled = schedule(lower("four_bar", form_equations(four_bar())))
    >>> scheduled.has_batches, [function.function.name for function in scheduled.functions[:3]]
    (True, ['prepare', 'default_inputs', 'breakpoints'])
    """
    sizes, functions = program.sizes, program.functions
    few_arguments = all(fits_lanes(f.statements) for f in functions if f.is_vectorized)
    can_solve = program.form == "sparse" or sizes.n_c <= MAX_CONSTRAINTS
    return Schedule(
        program=program,
        functions=tuple(schedule_function(f, inline_angles=True) for f in functions),
        has_batches=few_arguments and can_solve and not (program.states_need_multipliers or sizes.n_n),
        is_short=next(f for f in functions if f.role is Role.DYNAMICS).operations <= MAX_INLINED_OPERATIONS,
    )


def schedule_function(function: Function, *, inline_angles: bool) -> ScheduledFunction:
    """Schedule a function.

    Arguments are loaded where they are first used. Results are stored as soon as they are known, those that are
    arguments last. Compilers keep this order, and it needs few registers.
    """
    lines = _Lines(function, inline_angles)
    blocks = _blocks(function, lines)
    later: set[int] = set()
    carried: list[int] = []
    for block in reversed(blocks):
        carried += [node for node in block.lines if node in later]
        later |= block.used
    places = {node: place for place, node in enumerate(carried)}
    return ScheduledFunction(
        function=function,
        lines=tuple(lines.lines),
        parts=tuple(_part(function, block, lines, places) for block in blocks),
        n_carried=len(carried),
        inline_angles=inline_angles,
        factors=None if function.factors is None else schedule_function(function.factors, inline_angles=inline_angles),
    )


class _Lines:
    """The nodes of a function that get a name, and the names that each of them uses."""

    def __init__(self, function: Function, inline_angles: bool) -> None:
        self.inline_angles = inline_angles
        self.operations = dict(function.statements)
        uses = Counter(operand for operation in self.operations.values() for operand in operands(operation))
        uses.update(entry.node for result in function.results for entry in result.entries)
        named = {a for o in self.operations.values() if isinstance(o, Call) for a in o.arguments}
        named.update(node for node, count in uses.items() if count > 1)
        lengths: dict[int, int] = {}  # operands in the text of inline nodes
        for node, operation in self.operations.items():
            length = sum(lengths.get(operand, 1) for operand in operands(operation))
            if node not in named and not isinstance(operation, Call) and length <= MAX_INLINED_OPERANDS:
                lengths[node] = length
        self.lines = [node for node in self.operations if node not in lengths]
        self.named = {*self.lines, *(node for array in function.arguments for node in array.nodes)}

    def referred(self, node: int) -> set[int]:
        """The named nodes in the text of a node; a named node itself."""
        found: set[int] = set()
        stack = [node]
        while stack:
            node = stack.pop()
            if node in self.named:
                found.add(node)
            elif node != ONE:
                stack.extend(operands(self.operations[node]))
        return found

    def referred_by(self, line: int) -> set[int]:
        """The named nodes on the right-hand side of a line."""
        return {name for operand in operands(self.operations[line]) for name in self.referred(operand)}

    def angle(self, line: int) -> tuple[str, int] | None:
        """The function and the argument of a line that is an inline sine or cosine."""
        operation = self.operations[line]
        if not self.inline_angles or not isinstance(operation, Call):
            return None
        function = operation.expression
        inline = isinstance(function, (sm.sin, sm.cos)) and function.args[0].is_Symbol
        return (str(function.func), operation.arguments[0]) if inline else None


@dataclass(frozen=True)
class _Block:
    """Consecutive lines of a function, and the entries of its results that can be stored after them."""

    lines: tuple[int, ...]
    cleared: tuple[Clear, ...]
    stores: tuple[Store, ...]
    used: frozenset[int]
    """The nodes that lines and stores name."""


def _blocks(function: Function, lines: _Lines) -> list[_Block]:
    count = 1 if len(lines.lines) <= MAX_STATEMENTS else -(-len(lines.lines) // STATEMENTS_PER_PART)
    size = max(1, -(-len(lines.lines) // count))
    defined_in = {node: position // size for position, node in enumerate(lines.lines)}
    stores: list[list[Store]] = [[] for _ in range(count)]
    used: list[set[int]] = [set() for _ in range(count)]
    cleared: list[Clear] = []
    for result in function.results:
        sparse = sum(not entry for entry in result.entries) > MAX_SINGLE_ZEROS
        if sparse:
            cleared.append(Clear(result.name, len(result.entries)))
        for position, entry in enumerate(result.entries):
            if sparse and not entry:
                continue
            referred = lines.referred(entry.node)
            block = max((defined_in.get(node, 0) for node in referred), default=0)
            stores[block].append(Store(result.name, position, entry))
            used[block] |= referred
    blocks = []
    for i in range(count):
        own = tuple(lines.lines[i * size : (i + 1) * size])
        names = used[i].union(*(lines.referred_by(line) for line in own))
        blocks.append(_Block(own, tuple(cleared if i == 0 else ()), tuple(stores[i]), frozenset(names)))
    return blocks


def _part(function: Function, block: _Block, lines: _Lines, carried: Mapping[int, int]) -> Part:
    """The steps of a block, in topological order."""
    given: dict[int, Step] = {
        node: Load(node, array.name, position)
        for array in function.arguments
        for position, node in enumerate(array.nodes)
        if node in block.used and not _is_time(array.leaves[position])
    }
    given.update((node, Resume(node, carried[node])) for node in (block.used - set(block.lines)) & set(carried))
    stored = {step.result for step in block.cleared} | {step.result for step in block.stores}
    unused = [array.name for array in function.arguments if block.used.isdisjoint(array.nodes)]
    unused += [result.name for result in function.results if result.name not in stored]
    assigned = _assignments(block, lines)
    places = {step.node: place for place, (step, _) in enumerate(assigned, start=1) if isinstance(step, Assign)}
    behind: list[list[tuple[Step, set[int]]]] = [[] for _ in range(len(assigned) + 1)]
    for store in block.stores:
        reads = lines.referred(store.value.node)
        place = max((places[node] for node in reads if node in places), default=len(assigned))
        behind[place].append((store, reads))
    for node in block.lines:
        if node in carried:
            behind[places[node]].append((Carry(node, carried[node]), {node}))
    steps: list[Step] = [*block.cleared]
    for place, stores in enumerate(behind):
        for step, reads in (*assigned[place - 1 : place], *stores):
            steps += [given.pop(node) for node in sorted(reads & given.keys())]
            steps.append(step)
    return Part(tuple(unused), tuple(steps))


def _is_time(leaf: object) -> bool:
    """Whether an argument is time, which is no array."""
    return getattr(leaf, "kind", None) == "t"


def _assignments(block: _Block, lines: _Lines) -> Sequence[tuple[Step, set[int]]]:
    """A step for each line, and what it reads; sines and cosines of several angles come before the lines using them."""
    inline = {line: call for line in block.lines if (call := lines.angle(line))}
    behind: set[int] = set()  # the lines that need a sine or a cosine
    for line in block.lines:
        if line in inline or not behind.isdisjoint(lines.referred_by(line)):
            behind.add(line)
    angles = list(dict.fromkeys(angle for _, angle in inline.values() if angle not in behind))
    if len(angles) == 1:
        angles = []
    taken: dict[int, tuple[int, str, int]] = {}
    evaluated: list[tuple[Step, set[int]]] = []
    for group, start in enumerate(range(0, len(angles), ANGLES_PER_VECTOR)):
        members = angles[start : start + ANGLES_PER_VECTOR]
        evaluated.append((EvaluateAngles(group, tuple(members)), set(members)))
        for line, (function, angle) in inline.items():
            if angle in members:
                taken[line] = group, function, members.index(angle)
    needed = set(angles)
    for line in reversed(block.lines):
        if line in needed:
            needed |= lines.referred_by(line)
    first: list[tuple[Step, set[int]]] = []
    second: list[tuple[Step, set[int]]] = []
    for line in block.lines:
        reads = set() if line in taken else lines.referred_by(line)
        (first if line in needed else second).append((Assign(line, taken.get(line)), reads))
    return [*first, *evaluated, *second]
