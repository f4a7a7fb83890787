"""Schedule -> C text: a kernel's header and source, the same on every machine and in every process.

`c_expressions` prints the expressions; the templates are here.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fourbar_codegen.codegen.c_expressions import ANGLES, CARRIED, Text
from fourbar_codegen.lowering.program import Array, Function, PivotOrder, Structure
from fourbar_codegen.lowering.schedule import (
    ANGLES_PER_VECTOR,
    Assign,
    Carry,
    Clear,
    EvaluateAngles,
    Load,
    Part,
    Resume,
    Schedule,
    ScheduledFunction,
    Store,
)
from fourbar_codegen.runtime.enumerations import DIRECTIONS, VECTOR, Needs, Role

__all__ = [
    "batch_text",
    "derivatives_text",
    "drawing_text",
    "header_text",
    "kernel_sources",
    "kernel_text",
    "products_text",
    "version_texts",
]

INSTRUCTION_SETS = {
    "avx2": ("FB_AVX2", "AVX2 and FMA", ("__AVX2__", "__FMA__")),
    "avx512": ("FB_AVX512", "AVX-512", ("__AVX512F__", "__AVX512DQ__", "__AVX512VL__", "__FMA__")),
}
"""In order of speed: the constant in the headers, a description, and the macros by which compilers announce it."""

LINE_LENGTH = 110

UNLESS_VERSION = "#ifndef FB_TABLE /* as in the versions for processors with more instructions */"
"""Begins what a source defines unless a version of it, which includes it, did so."""

ALONG = {Role.RESIDUAL_JVP, Role.CONSTRAINT_JVP}
"""Functions that are applied to directions, instead of filling a matrix."""

GIVEN = {name: f"at->{name}" for name in ("t", "x", "constants", "r", "accelerations", "multipliers")} | {"q": "at->x"}
"""Where functions of the table find arguments of these names; others are further arguments."""


def kernel_sources(scheduled: Schedule, names: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """The C sources of a model's kernel, with batches of states if that gains anything: text by file name."""
    name, batch = scheduled.program.name, batch_text(scheduled)
    return {
        f"{name}_kernel.c": kernel_text(scheduled, names),
        **({f"{name}_batch.c": batch} if batch else {}),
        f"{name}_kernel.h": header_text(scheduled, names),
    }


def kernel_text(
    scheduled: Schedule, names: Mapping[str, Sequence[str]], folder: str = "", before: str = "", after: str = ""
) -> str:
    """The C source of a model's kernel.

    Parameters
    ----------
    scheduled : Schedule
    names : mapping of str to sequence of str
        Names of the model's `coordinates`, `speeds`, `auxiliary_states`, `parameters`, `inputs` and `outputs`.
    folder : str, optional
        Of the headers, relative to the source, with a slash.
    before, after : str, optional
        Further text, before the first header and after the last one.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If an expression has no counterpart in C99.
    """
    program, sizes, has_batches = scheduled.program, scheduled.program.sizes, scheduled.has_batches
    lanes, others = (
        "\n\n".join(
            _function_text(f, f.function.name, "static ", "fb_real" if both and has_batches else "double")
            for f in scheduled.functions
            if f.function.is_vectorized is both and f.function.name != "mass_product"
        )
        for both in (True, False)
    )
    if program.factors is not None:
        solve, multiply = (f for f in scheduled.functions if f.function.name in ("mass_solve", "mass_product"))
        for function, name in ((solve, "mass_solve_simd"), (multiply, "mass_product")):
            others += "\n\n" + _function_text(function, name, "static FB_CALLED ", "fb_simd")
    # kernel/kernel.h has an entry for the dynamics, whose matrices are not formed in each form.
    functions = [f.function for f in scheduled.functions if f.function.role not in (None, Role.DYNAMICS)]
    entries = [*map(_Entry.of, functions)]
    table = _entries_text(entries, "static ")
    others += f"\n\n#if !defined(FB_RHS_ONLY) && !defined(FB_LIBRARY)\n{table}\n#endif\n"
    others += f'\n#include "{folder}kernel/kernel.h"'
    tables = _position_rows_text(program.position_rows)
    if program.factors is not None:
        tables += _factors_text(program.sizes.n_u + len(program.factors.nodes))
    tables += _structure_text(program.structure)
    if program.structure is None or program.structure.is_early:
        tables += _pivot_order_text(program.pivot_order)
    note, batch_functions = "", f"#define FB_TABLE(name) {program.name}_##name"
    if has_batches:
        batch_functions = f"""\
#define FB_HAS_BATCH_FUNCTIONS
{UNLESS_VERSION}
#define FB_TABLE(name) {program.name}_##name
#define FB_INSTRUCTIONS FB_BASELINE
#define FB_FASTER &{program.name}_kernel_{next(iter(INSTRUCTION_SETS))}
#endif"""
        others = f'#ifdef FB_LANES\n#include "lanes/lane_equations.h"\n#else\n{others}\n#endif'
        note = "\n * fb_real is double, or a SIMD vector with a state in each lane; see arithmetic/real.h."
    return f"""\
/* Equations of motion of the model "{program.name}", generated by fourbar_codegen. Do not edit.
 *
{_layout_comment(names)}
 *
 * The functions below evaluate straight-line code; kernel/kernel.h, included at the end, solves the
 * equations that they set up. Matrices are stored row by row.{note}
 */
{_macros(scheduled)}{before}#include "{folder}{program.name}_kernel.h"
#include "{folder}arithmetic/angle.h"

#include <math.h>

enum {{
    N_Q = {sizes.n_q},
    N_U = {sizes.n_u},
    N_P = {sizes.n_p},
    N_R = {sizes.n_r},
    N_H = {sizes.n_h},
    N_C = {sizes.n_c},
    N_I = {sizes.n_i},
    N_O = {sizes.n_o},
    N_BREAKPOINTS = {sizes.n_breakpoints},
    N_CONDITIONS = {sizes.n_conditions},
    N_POINTS = {sizes.n_points},
    N_FORCES = {sizes.n_forces},
    N_RANK = {sizes.rank},
    N_CONSTANTS = {sizes.n_constants}
}};
#define FB_DERIVATIVES {program.name}_derivatives
{batch_functions}
{tables}
{lanes}

{others}
{after}"""


def _macros(scheduled: Schedule) -> str:
    """What the headers are told of the equations."""
    program, sizes = scheduled.program, scheduled.program.sizes
    told = {
        "FB_SHORT": scheduled.is_short,
        f"N_Z {sizes.n_z}": sizes.n_z,
        f"N_N {sizes.n_n}": sizes.n_n,
        "FB_FORCES_LINEAR": sizes.n_n and program.forces_are_linear,
        "FB_STATES_NEED_SOLUTION": program.states_need_solution,
        "FB_STATES_NEED_MULTIPLIERS": program.states_need_multipliers,
        "FB_OUTPUTS_IN_LANES": any(f.role is Role.OUTPUT and f.is_vectorized for f in program.functions),
        "FB_OUTPUTS_NEED_SOLUTION": program.outputs_need_solution,
        "FB_OUTPUTS_NEED_INPUTS": program.outputs_need_inputs,
    }
    return "".join(f"#define {macro}\n" for macro, is_told in told.items() if is_told)


def batch_text(scheduled: Schedule) -> str | None:
    """The C source that compiles a kernel for batches of states; None if that gains nothing."""
    if not scheduled.has_batches:
        return None
    name = scheduled.program.name
    return f"""\
/* Equations of motion of the model "{name}" for batches of states, generated by
 * fourbar_codegen. Do not edit.
 */
#include "{name}_kernel.h"

#if defined(__GNUC__)
#define FB_LANES
#include "{name}_kernel.c"
#else /* without vectors */
#include "lanes/batch.h"
const fb_batch_functions {name}_batch_functions = {{.layout = FB_LAYOUT}};
#endif
"""


def version_texts(scheduled: Schedule) -> dict[str, str]:
    """The C sources that compile a kernel for processors with more instructions, by the suffixes of their names.

    All include the same text. A source compiles to nothing unless the compiler is told to use the instructions, by
    options such as ``-mavx2 -mfma``. A kernel without batch functions has no such sources.
    """
    if not scheduled.has_batches:
        return {}
    name, sets = scheduled.program.name, list(INSTRUCTION_SETS)
    texts = {}
    for version, faster in zip(sets, (*sets[1:], None), strict=True):
        constant, words, macros = INSTRUCTION_SETS[version]
        for part in ("kernel", "batch", "products"):
            otherwise = f"#else\nconst fb_kernel {name}_kernel_{version} = {{0}};\n" if part == "kernel" else ""
            texts[f"_{part}_{version}.c"] = f"""\
/* {name}_{part}.c for processors with {words}, generated by fourbar_codegen. Do not edit. */
#include "{name}_kernel.h"

#if {" && ".join(f"defined({macro})" for macro in macros)}
#define FB_INSTRUCTIONS {constant}
#define FB_TABLE(name) {name}_##name##_{version}
#define FB_FASTER {f"&{name}_kernel_{faster}" if faster else "NULL"}
#include "{name}_{part}.c"
{otherwise}#endif
"""
    return texts


def _position_rows_text(rows: Sequence[int | None]) -> str:
    """The table that kernel/kernel.h needs."""
    numbers = ", ".join("-1" if row is None else str(row) for row in rows or (None,))
    return f"""
/* The row of J that keeps each position constraint; -1 for invariants and redundant constraints. */
static const int position_row[] = {{{numbers}}};
"""


def _pivot_order_text(order: PivotOrder) -> str:
    """The tables that linear_algebra/dense_equations.h needs."""
    rows, speeds = (", ".join(map(str, numbers or (0,))) for numbers in (order.rows, order.speeds))
    return f"""\

/* The fixed pivot order: constraints; the speeds that they are solved for, then the others. */
static const int static_pivot_row[] = {{{rows}}};
static const int static_pivot_speed[] = {{{speeds}}};
"""


def _factors_text(length: int) -> str:
    """What linear_algebra/recursive_equations.h needs."""
    return f"""
/* M is not formed: `dynamics` returns {length} factors of it; see linear_algebra/recursive_equations.h. */
#define FB_RECURSIVE
enum {{ N_MASS = {length} }};
"""


def _structure_text(structure: Structure | None) -> str:
    """The tables that linear_algebra/sparse_equations.h needs."""
    if structure is None:
        return ""
    tables = structure.tables()
    lines = [
        "",
        "/* The nonzero entries of M and J, and the elimination order; see linear_algebra/sparse_equations.h. */",
        "#define FB_SPARSE",
        *(["#define FB_EARLY /* constraints come before some of their speeds */"] if structure.is_early else []),
        (
            f"enum {{ N_MASS = {len(structure.mass_entries)}, N_JACOBIAN = {len(structure.jacobian_entries)}, "
            f"N_BELOW = {len(tables['below'])} }};"
        ),
    ]
    for name, values in tables.items():
        text = f"static const int {name}[{max(len(values), 1)}] = {{{', '.join(map(str, values or [0]))}}};"
        lines += textwrap.wrap(text, LINE_LENGTH, subsequent_indent="    ")
    return "\n".join(lines) + "\n"


def derivatives_text(
    name: str,
    derivatives: Sequence[ScheduledFunction],
    names: Mapping[str, Sequence[str]],
    folder: str = "",
    before: str = "",
    after: str = "",
) -> str:
    """The C source of a model's derivatives, and of what pictures need.

    Parameters
    ----------
    name : str
        The model's.
    derivatives : sequence of ScheduledFunction
    names, folder, before, after
        As for `kernel_text`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If an expression has no counterpart in C99.
    """
    about = "Derivatives of the equations of motion of the model {name}; positions and orientations"
    return _table_text(
        f"{name}_derivatives", about, name, derivatives, names, folder=folder, before=before, after=after
    )


def drawing_text(name: str, drawing: Sequence[ScheduledFunction], names: Mapping[str, Sequence[str]]) -> str:
    """The C source of what pictures of a model need, for a library of its own.

    Parameters, result and errors are as for `derivatives_text`.
    """
    about = "Positions and orientations of the model {name}, for pictures"
    return _table_text(f"{name}_drawing", about, name, drawing, names)


def products_text(name: str, products: Sequence[ScheduledFunction], names: Mapping[str, Sequence[str]]) -> str:
    """The C source of products of a model's derivatives with directions and weights.

    Parameters, result and errors are as for `derivatives_text`.
    """
    about = "Products of the derivatives of the equations of motion of the model {name} with directions and weights"
    define = f"{UNLESS_VERSION}\n#define FB_TABLE(name) {name}_##name\n#endif\n"
    return _table_text("FB_TABLE(products)", about, name, products, names, before=define)


def _table_text(
    table: str,
    about: str,
    name: str,
    scheduled: Sequence[ScheduledFunction],
    names: Mapping[str, Sequence[str]],
    *,
    folder: str = "",
    before: str = "",
    after: str = "",
) -> str:
    """The C source of functions and of their table."""
    texts: list[str] = []
    for each in scheduled:
        function = each.function
        if each.factors is None or function.factors is None:
            texts.append(_function_text(each, function.name, "static ", "double"))
        else:
            texts.append(_function_text(each.factors, f"{function.name}_factors", "static ", "double"))
            texts.append(_function_text(each, f"{function.name}_simd", "static ", "fb_simd"))
            texts.append(_columns_text(function, function.factors))
    entries = [_Entry.of(each.function) for each in scheduled]
    headers = ["arithmetic/angle.h"] if any(each.inline_angles for each in scheduled) else []
    headers += ["arithmetic/columns.h"] if any(each.factors for each in scheduled) else []
    functions = "\n\n".join([*texts, _entries_text(entries)])
    title = f"{about}, generated by fourbar_codegen. Do not edit.".replace("{name}", f'"{name}"')
    summary = textwrap.wrap(title, LINE_LENGTH)
    return f"""\
/* {f"{chr(10)} * ".join(summary)}
 *
{_layout_comment(names)}
 *
 * kernel/kernel.h, in {name}_kernel.c, solves the equations that they set up. Matrices are stored row by row.
 */
{before}#include "{folder}{name}_kernel.h"
{"".join(f'#include "{folder}{header}"{chr(10)}' for header in headers)}
#include <math.h>

{functions}

const fb_part {table} = {{
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_part),
    .functions = {{
{_rows_text(entries, 8)}
    }},
}};
{after}"""


def _columns_text(function: Function, factors: Function) -> str:
    """The function that fills matrices of derivatives, or applies them to directions, from products with vectors."""
    name, results = function.name, function.results
    [_, nodes, direction] = function.arguments
    along = function.role in ALONG
    given = [_parameter(array, "double") for array in factors.arguments]
    given += ["int n", "const double *restrict directions"] if along else []
    given += [f"double *restrict {result.name}" for result in results]
    sizes = [(direction.name, len(direction.nodes)), *((f"of_{r.name}", len(r.entries)) for r in results)]
    call = [f"{name}_simd", "constants", "factors", f"{len(direction.nodes)}", direction.name]
    call += ["n", "directions"] if along else []
    call += [f"{len(result.entries)}, of_{result.name}" for result in results]
    call += [result.name for result in results]
    arguments = ", ".join(array.name for array in factors.arguments)
    lines = [
        f"double factors[{len(nodes.nodes)}];" if nodes.nodes else "double factors[1] = {0.0}; /* none */",
        f"fb_simd {', '.join(f'{array}[{max(size, 1)}]' for array, size in sizes)};",
        f"{name}_factors({arguments}, factors);",
        f"{'fb_apply_columns' if along else 'fb_fill_columns'}({', '.join(call)});",
    ]
    return "\n".join([*_lines_of_head(f"static void {name}", given), "{", *map(_wrapped, lines), "}"])


@dataclass(frozen=True)
class _Entry:
    """A function as an entry of the kernel's table.

    Attributes
    ----------
    role : Role
    passed : tuple of str
        What it is called with, before its results.
    arguments, results : tuple of (str, int, int)
        Names, rows and columns.
    """

    role: Role
    passed: tuple[str, ...]
    arguments: tuple[tuple[str, int, int], ...]
    results: tuple[tuple[str, int, int], ...]

    @property
    def name(self) -> str:
        """That of the function."""
        return self.role.function

    @property
    def arrays(self) -> tuple[tuple[str, tuple[tuple[str, int, int], ...]], ...]:
        """The arguments and the results, with the ends of their names."""
        return ("arguments", self.arguments), ("results", self.results)

    @classmethod
    def of(cls, function: Function) -> _Entry:
        """That of a function with a role."""
        assert function.role is not None
        of_state = function.factors or function
        further = [(array.name, len(array.nodes), VECTOR) for array in of_state.arguments if array.name not in GIVEN]
        passed = [GIVEN.get(array.name, "arguments[0]") for array in of_state.arguments]
        results = [(r.name, r.shape[0], r.shape[1] if len(r.shape) > 1 else VECTOR) for r in function.results]
        if function.factors is not None:
            columns = len(function.arguments[-1].nodes)
            if function.role in ALONG:
                further.append(("directions", columns, DIRECTIONS))
                passed += ["at->n_directions", "arguments[0]"]
                columns = DIRECTIONS
            results = [(name, rows, columns) for name, rows, _ in results]
        return cls(function.role, tuple(passed), tuple(further), tuple(results))


def _entries_text(entries: Sequence[_Entry], storage: str = "") -> str:
    """The functions of the table in its one signature; as static storage, the table as well."""
    texts = []
    for entry in entries:
        unused = [f"(void){name}" for name in ("arguments", "work") if not (name == "arguments" and entry.arguments)]
        passed = [*entry.passed, *(f"results[{i}]" for i in range(len(entry.results)))]
        text = [_arrays_text(f"{entry.name}_{kind}", arrays) for kind, arrays in entry.arrays if arrays]
        head = "const fb_at *at, const double *const *arguments, double *const *results, void *work"
        text += [
            *_lines_of_head(f"static int call_{entry.name}", head.split(", ")),
            "{",
            f"    {', '.join(unused)};",
            _wrapped(f"{entry.name}({', '.join(passed)});"),
            "    return FB_OK;",
            "}",
        ]
        texts.append("\n".join(text))
    if storage:
        texts.append(f"""\
static int call_dynamics(const fb_at *, const double *const *, double *const *, void *);
static const fb_array dynamics_results[5];
static const fb_function own_functions[FB_N_ROLES] = {{
    [FB_DYNAMICS] = {{call_dynamics, {_needs_text(Role.DYNAMICS)}, 0, 5, NULL, dynamics_results}},
{_rows_text(entries, 4)}
}};""")
    return "\n\n".join(texts)


def _arrays_text(name: str, arrays: Sequence[tuple[str, int, int]]) -> str:
    rows = ", ".join(f'{{"{array}", {rows}, {columns}}}' for array, rows, columns in arrays)
    text = f"static const fb_array {name}[] = {{{rows}}};"
    return "\n".join(textwrap.wrap(text, LINE_LENGTH, subsequent_indent="    "))


def _needs_text(role: Role) -> str:
    return " | ".join(f"FB_NEEDS_{need.name}" for need in Needs if role.needs & need) or "0"


def _rows_text(entries: Sequence[_Entry], indent: int) -> str:
    """The rows of a table."""
    rows = []
    for entry in entries:
        arrays = ", ".join(f"{entry.name}_{kind}" if of else "NULL" for kind, of in entry.arrays)
        counts = f"{len(entry.arguments)}, {len(entry.results)}"
        called = f"call_{entry.name}, {_needs_text(entry.role)}, {counts}, {arrays}"
        text = f"{' ' * indent}[FB_{entry.role.name}] = {{{called}}},"
        rows += textwrap.wrap(text, LINE_LENGTH, subsequent_indent=" " * (indent + 4))
    return "\n".join(rows)


def header_text(scheduled: Schedule, names: Mapping[str, Sequence[str]]) -> str:
    """The C header that declares a model's kernel."""
    program = scheduled.program
    more = ""
    if scheduled.has_batches:
        kernels = ", ".join(f"{program.name}_kernel_{version}" for version in INSTRUCTION_SETS)
        products = ", ".join(f"{program.name}_products_{version}" for version in INSTRUCTION_SETS)
        functions = ", ".join(f"{program.name}_batch_functions{v}" for v in ("", *(f"_{s}" for s in INSTRUCTION_SETS)))
        more = (
            f"\nextern const fb_kernel {kernels};\nextern const fb_part {products};"
            f"\nextern const fb_batch_functions {functions};"
        )
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
extern const fb_part {program.name}_drawing, {program.name}_derivatives, {program.name}_products;{more}

#endif
"""


def _layout_comment(names: Mapping[str, Sequence[str]]) -> str:
    rows = (
        ("x", "state", (*names["coordinates"], *names["speeds"], *names["auxiliary_states"])),
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
    """A user's name in a form that is safe in a comment: printable, and unable to end it."""
    return re.sub(r"[^\w{}^'\-+ ]", "_", name, flags=re.ASCII)


def _function_text(scheduled: ScheduledFunction, name: str, storage: str, real: str) -> str:
    function, parts, text = scheduled.function, scheduled.parts, Text(scheduled, real)
    if len(parts) == 1:
        head = _head(function, real, f"{storage}void {name}", [])
        return "\n".join([f"/* {function.summary} */", *head, "{", *_body(parts[0], text), "}"])
    texts = []
    for number, part in enumerate(parts, start=1):
        head = _head(function, real, f"static FB_PART void {name}_{number}", [f"{real} *restrict {CARRIED}"])
        texts.append("\n".join([*head, "{", *_body(part, text), "}"]))
    arguments = [array.name for array in function.arguments] + [result.name for result in function.results]
    calls = [f"    {name}_{i + 1}({', '.join([*arguments, CARRIED])});" for i in range(len(parts))]
    head = _head(function, real, f"{storage}void {name}", [])
    texts.append("\n".join([*head, "{", f"    {real} {CARRIED}[{max(scheduled.n_carried, 1)}];", *calls, "}"]))
    texts[0] = f"/* {function.summary} */\n{texts[0]}"
    return "\n\n".join(texts)


def _body(part: Part, text: Text) -> list[str]:
    """The lines of a function, or of a part of one."""
    names, real = text.names, text.real
    body = [f"    (void){name};" for name in part.unused]
    for step in part.steps:
        match step:
            case Load(node, array, position):
                body.append(f"    const {_type_of(array, real)} {names[node]} = {array}[{position}];")
            case Resume(node, place):
                body.append(f"    const {real} {names[node]} = {CARRIED}[{place}];")
            case Clear(result, length):
                body += [f"    for (int i = 0; i < {length}; ++i)", f"        {result}[i] = {text.number(0)};"]
            case EvaluateAngles(group, angles):
                arguments = [names[angle] for angle in angles] + [text.number(0)] * (ANGLES_PER_VECTOR - len(angles))
                body.append(_wrapped(f"const fb_angles {ANGLES}{group} = fb_angles_of({', '.join(arguments)});"))
            case Assign(node, None):
                body.append(_wrapped(f"const {real} {names[node]} = {text.value(node)};"))
            case Assign(node, (group, function, position)):
                body.append(_wrapped(f"const {real} {names[node]} = {ANGLES}{group}.{function}[{position}];"))
            case Store(result, position, value):
                body.append(_wrapped(f"{result}[{position}] = {text.scalar(value)};"))
            case Carry(node, place):
                body.append(_wrapped(f"{CARRIED}[{place}] = {names[node]};"))
    return body


def _head(function: Function, real: str, declared: str, more: Sequence[str]) -> list[str]:
    parameters = [_parameter(array, real) for array in function.arguments]
    parameters += [f"{real} *restrict {result.name}" for result in function.results]
    return _lines_of_head(declared, [*parameters, *more])


def _lines_of_head(declared: str, parameters: Sequence[str]) -> list[str]:
    # No line breaks within a parameter: textwrap does not break at non-ASCII spaces.
    text = f"{declared}(".replace(" ", "\xa0") + ", ".join(p.replace(" ", "\xa0") for p in parameters)
    wrapped = textwrap.wrap(
        f"{text})", LINE_LENGTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return [line.replace("\xa0", " ") for line in wrapped]


def _wrapped(text: str) -> str:
    lines = textwrap.wrap(text, LINE_LENGTH - 4, break_long_words=False, break_on_hyphens=False)
    return "\n".join(("    " if not number else "        ") + line for number, line in enumerate(lines))


def _parameter(array: Array, real: str) -> str:
    return f"{real} t" if array.name == "t" else f"const {_type_of(array.name, real)} *restrict {array.name}"


def _type_of(array: str, real: str) -> str:
    """The type of an argument's entries: of many right-hand sides, factors and constants are common to all."""
    return "double" if real == "fb_simd" and array in ("constants", "factors") else real
