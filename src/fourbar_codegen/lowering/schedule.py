"""Program -> Schedule: in which order each function evaluates, stores and hands on its values.

What is used once is evaluated where it is used, unless the expression becomes long. Long functions are divided into
parts, which compilers translate in linear time. Sines and cosines of several angles are evaluated together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import sympy as sm

from fourbar_codegen.expressions.tape import ONE, Call, Scalar, operands
from fourbar_codegen.lowering.elimination import MAX_CONSTRAINTS
from fourbar_codegen.lowering.program import Function, Program

__all__ = [
    "TOGETHER",
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

INLINED = 8
"""Operands of the longest expression that stands in another one, instead of on a line of its own."""

MAX_STATEMENTS = 500
"""Statements in one C function. Compilers need more than linear time for longer ones."""

PART = 200
"""Statements in each part of a longer one."""

TOGETHER = 4
"""Angles whose sines and cosines `fb_angles_of` evaluates side by side."""

ZEROS = 32
"""Zeros in a result that are stored one by one."""

SIDE_BY_SIDE = (
    "prepare",
    "default_inputs",
    "dynamics",
    "constraint_violation",
    "constraint_scale",
    "coordinate_change",
    "invariant_correction",
    "state_rates",
)
"""The functions that are compiled for several states side by side as well; fourbar_side_by_side.h says what for."""

SHORT = 600
"""Operations of equations that are compiled into what calls them. Side by side that gains 7 % for a chain of eight
links (527), and 3 % for the bicycle (1301), which takes half as long again to compile."""

MAX_ARGUMENTS = 4
"""Arguments of the functions that fourbar_real.h can evaluate lane by lane."""


@dataclass(frozen=True)
class Load:
    """An entry of an argument is given its name."""

    node: int
    array: str
    position: int


@dataclass(frozen=True)
class Resume:
    """A value that an earlier part has handed on is given its name."""

    node: int
    place: int


@dataclass(frozen=True)
class EvaluateAngles:
    """Sines and cosines of several angles together."""

    group: int
    angles: tuple[int, ...]


@dataclass(frozen=True)
class Assign:
    """A node is evaluated; or taken from a group of angles: the group, "sin" or "cos", and the position in it."""

    node: int
    angle: tuple[int, str, int] | None = None


@dataclass(frozen=True)
class Clear:
    """All entries of a result are set to zero."""

    result: str
    length: int


@dataclass(frozen=True)
class Store:
    """An entry of a result is stored."""

    result: str
    position: int
    value: Scalar


@dataclass(frozen=True)
class Carry:
    """A value is handed on to later parts."""

    node: int
    place: int


Step = Load | Resume | EvaluateAngles | Assign | Clear | Store | Carry


@dataclass(frozen=True)
class Part:
    """A function, or a part of a longer one.

    Attributes
    ----------
    unused : tuple of str
        Arguments and results that it has no use for.
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
        Values that parts hand on to later ones.
    side_by_side : bool
        Whether it is compiled for several states side by side as well.
    inline_angles : bool
        Whether sines and cosines are those of fourbar_angle.h, or the library's.
    """

    function: Function
    lines: tuple[int, ...]
    parts: tuple[Part, ...]
    n_carried: int
    side_by_side: bool
    inline_angles: bool


@dataclass(frozen=True)
class Schedule:
    """All functions of a program as they are evaluated.

    Attributes
    ----------
    program : Program
    functions : tuple of ScheduledFunction
    has_batches : bool
        Whether there are functions for several states side by side: the equations are solved without pivoting as a
        rule, x' needs no multipliers or unknown forces, and none calls a function of many arguments.
    is_short : bool
        Whether the equations are compiled into what calls them; fourbar_real.h says how.
    """

    program: Program
    functions: tuple[ScheduledFunction, ...]
    has_batches: bool
    is_short: bool


def schedule(program: Program) -> Schedule:
    """In which order the functions of a program are evaluated.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.equations import form_equations
    >>> from fourbar_codegen.lowering.lower import lower
    >>> from fourbar_codegen.models import four_bar
    >>> scheduled = schedule(lower("four_bar", form_equations(four_bar())))
    >>> scheduled.has_batches, [function.function.name for function in scheduled.functions[:3]]
    (True, ['prepare', 'default_inputs', 'breakpoints'])
    """
    sizes, functions = program.sizes, program.functions
    calls = (o for f in functions if f.name in SIDE_BY_SIDE for _, o in f.statements if isinstance(o, Call))
    few_arguments = all(len(call.arguments) <= MAX_ARGUMENTS for call in calls)
    can_solve = program.structure is None and sizes.rank == sizes.n_c <= MAX_CONSTRAINTS
    return Schedule(
        program=program,
        functions=tuple(schedule_function(f, inline_angles=True) for f in functions),
        has_batches=few_arguments and can_solve and not (program.states_need_multipliers or sizes.n_n),
        is_short=next(f for f in functions if f.name == "dynamics").operations <= SHORT,
    )


def schedule_function(function: Function, *, inline_angles: bool) -> ScheduledFunction:
    """In which order a function is evaluated.

    Arguments are named where they are first used, and results stored as soon as they are known, what is an argument
    itself at last: compilers keep this order, and in it few values wait in registers.
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
        side_by_side=function.name in SIDE_BY_SIDE,
        inline_angles=inline_angles,
    )


class _Lines:
    """Which nodes of a function are given a name, and what each refers to by name."""

    def __init__(self, function: Function, inline_angles: bool) -> None:
        self.inline_angles = inline_angles
        self.operations = dict(function.statements)
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
        self.named = {*self.lines, *(node for array in function.arguments for node in array.nodes)}

    def referred(self, node: int) -> set[int]:
        """The nodes that the text of a node names; of one that has a name, itself."""
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
        """The nodes that a line names on its right-hand side."""
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
    """Consecutive lines of a function, and the entries of its results that can be stored behind them."""

    lines: tuple[int, ...]
    cleared: tuple[Clear, ...]
    stores: tuple[Store, ...]
    used: frozenset[int]
    """The nodes that lines and stores name."""


def _blocks(function: Function, lines: _Lines) -> list[_Block]:
    count = 1 if len(lines.lines) <= MAX_STATEMENTS else -(-len(lines.lines) // PART)
    size = max(1, -(-len(lines.lines) // count))
    defined_in = {node: position // size for position, node in enumerate(lines.lines)}
    stores: list[list[Store]] = [[] for _ in range(count)]
    used: list[set[int]] = [set() for _ in range(count)]
    cleared: list[Clear] = []
    for result in function.results:
        sparse = sum(not entry for entry in result.entries) > ZEROS
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
    """The steps of a block, each behind those that give what it refers to."""
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
    """A step for each line, and what it reads; before those that need sines and cosines, these of several angles."""
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
    for group, start in enumerate(range(0, len(angles), TOGETHER)):
        members = angles[start : start + TOGETHER]
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
