"""A model as a C library: its header, sources, an example, and how to build them, as text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from fourbar_codegen.codegen.c_source import derivatives_text, header_text, kernel_text
from fourbar_codegen.definitions import definitions_text
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.lowering.program import Program
from fourbar_codegen.lowering.schedule import Schedule, ScheduledFunction

__all__ = ["FOLDER", "HEADERS", "library_texts", "names_in"]

FOLDER = "runtime/"
"""Of the headers that the sources include, beside these."""

HEADERS = (
    "fourbar_angle.h", "fourbar_array.h", "fourbar_close.h", "fourbar_columns.h", "fourbar_forces.h",
    "fourbar_integrate.h", "fourbar_kernel.h", "fourbar_library.h", "fourbar_model.h", "fourbar_normal.h",
    "fourbar_ordered.h", "fourbar_pivoted.h", "fourbar_problem.h", "fourbar_real.h", "fourbar_recursive.h",
    "fourbar_sine.h", "fourbar_solve.h", "fourbar_sparse.h", "fourbar_tableau.h",
)  # fmt: skip
"""The runtime of a library."""

STATUSES = {
    "ok": 0, "constraints_dependent": 1, "mass_singular": 2, "not_finite": 3, "not_closed": 4,
    "constraints_independent": 5, "forces_undetermined": 6, "forces_not_found": 7, "invalid_argument": 20,
    "step_too_small": 21, "too_many_steps": 22, "singular_position": 23, "speeds_jump": 24,
}  # fmt: skip
"""As in fourbar_kernel.h and fourbar_close.h."""

RESERVED = {
    "alignas", "alignof", "and", "asm", "auto", "bool", "break", "case", "catch", "char", "class", "const", "constexpr",
    "continue", "default", "delete", "do", "double", "else", "enum", "errno", "explicit", "export", "extern", "false",
    "float", "for", "friend", "goto", "if", "inline", "int", "linux", "long", "main", "mutable", "namespace", "new",
    "not", "nullptr", "operator", "or", "private", "protected", "public", "register", "restrict", "return", "short",
    "signed", "sizeof", "static", "struct", "switch", "template", "this", "throw", "true", "try", "typedef", "typename",
    "union", "unix", "unsigned", "using", "virtual", "void", "volatile", "while", "xor",
    # names of the standard library, and of targets of CMake
    "abs", "acos", "acosh", "all", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "clean", "copysign",
    "cos", "cosh", "ctype", "erf", "erfc", "exit", "exp", "exp2", "expm1", "fabs", "fdim", "floor", "fma", "fmax",
    "fmin", "fmod", "free", "frexp", "gamma", "help", "hypot", "index", "install", "isnan", "j0", "j1", "jn", "ldexp",
    "lgamma", "limits", "locale", "log", "log10", "log1p", "log2", "logb", "lrint", "lround", "m", "malloc", "math",
    "memcpy", "memset", "modf", "nan", "nearbyint", "package", "pow", "printf", "puts", "remainder", "rint", "round",
    "scalbn", "setjmp", "signal", "sin", "sinh", "sqrt", "stdarg", "stdbool", "stddef", "stderr", "stdin", "stdint",
    "stdio", "stdlib", "stdout", "string", "strlen", "tan", "tanh", "test", "tgamma", "time", "trunc", "y0", "y1",
    "yn",
}  # fmt: skip
"""Names that a model cannot have in C or C++, besides those in the texts themselves."""


def library_texts(
    scheduled: Schedule,
    derivatives: Sequence[ScheduledFunction],
    names: Mapping[str, Sequence[str]],
    manifest: Mapping[str, Any],
    version: str,
    taken: frozenset[str],
) -> dict[str, str]:
    """The files of a library, besides the `HEADERS` of its runtime, by their paths.

    Parameters
    ----------
    scheduled : Schedule
    derivatives : sequence of ScheduledFunction
    names : mapping of str to sequence of str
        As for `kernel_text`.
    manifest : mapping
    version : str
        Of fourbar_codegen.
    taken : frozenset of str
        Names in the kernel and in the runtime.

    Returns
    -------
    dict of str to str

    Raises
    ------
    ModelError
        If names are none in C, or a parameter has no default.
    """
    name = scheduled.program.name
    missing = [entry["name"] for entry in manifest["parameters"] if entry["default"] is None]
    if missing:
        raise ModelError(
            f"A C library begins with defaults: give {', '.join(missing)} values in Model(parameters=...)."
        )
    scalar = replace(scheduled, has_batches=False)
    if name in RESERVED | taken:
        raise ModelError(f"{name!r} is a name in C or of its library: give the Model another name to export it.")
    header = f'#include "{name}.h"\n'
    return {
        f"{name}.h": _header(scheduled.program, names, manifest, version),
        f"{name}.c": kernel_text(
            scalar,
            names,
            FOLDER,
            f"#define FB_LIBRARY\n{header}",
            f'{definitions_text(manifest)}{_internal(name)}#include "{FOLDER}fourbar_library.h"\n',
        ),
        f"{name}_derivatives.c": derivatives_text(name, derivatives, names, FOLDER, header, _derivatives(name)),
        f"{FOLDER}{name}_kernel.h": header_text(scalar, names),
        "main.c": _example(name, manifest),
        "CMakeLists.txt": _cmake(name),
        "README.md": _readme(name, manifest, version),
    }


def _words(text: str) -> frozenset[str]:
    """The names in C text, without comments."""
    return frozenset(re.findall(r"[A-Za-z_]\w*", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)))


def names_in(texts: Iterable[str]) -> frozenset[str]:
    """The names in C texts."""
    return frozenset().union(*map(_words, texts))


def _identifiers(prefix: str, names: Sequence[str]) -> list[str]:
    """Names of array entries in C."""
    found: dict[str, str] = {}
    for name in names:
        words = name.replace("''", "_acceleration").replace("'", "_rate")
        words = re.sub(r"[{}^\-+ \\]", "_", words)
        if not re.fullmatch(r"\w+", words, flags=re.ASCII):
            raise ModelError(
                f"{shown(name)} is no name in C: use letters from a to z, digits and underscores to export the model."
            )
        if words in found:
            raise ModelError(
                f"{shown(name)} and {shown(found[words])} are the same name in C, {words}: rename one of them."
            )
        found[words] = name
    return [f"{prefix}_{words}" for words in found]


def _states(names: Mapping[str, Sequence[str]]) -> list[str]:
    return [*names["coordinates"], *names["speeds"], *names["auxiliary_states"]]


def _header(program: Program, names: Mapping[str, Sequence[str]], manifest: Mapping[str, Any], version: str) -> str:
    name, sizes = program.name, program.sizes
    n_x = sizes.n_q + sizes.n_u + sizes.n_z
    described = [
        ("x", "States: coordinates, speeds, then auxiliary states", _states(names), [""] * n_x),
        (
            "p",
            "Parameters, with their units and defaults",
            names["parameters"],
            [
                ", ".join(filter(None, (f"{e['default']:.10g} {e['unit'] or ''}".strip(), e["description"])))
                for e in manifest["parameters"]
            ],
        ),
        ("r", "Inputs", names["inputs"], [e["expression"] or "" for e in manifest["inputs"]]),
        ("y", "Outputs", names["outputs"], [""] * sizes.n_o),
    ]
    enums = ""
    for letter, title, entries, comments in described:
        identifiers = _identifiers(f"{name}_{letter}", entries)
        lines = [
            f"    {identifier} = {k}{',' if k + 1 < len(entries) else ''}{f' /* {_plain(c)} */' if c else ''}\n"
            for k, (identifier, c) in enumerate(zip(identifiers, comments, strict=True))
        ]
        if lines:
            enums += f"\n/* {title}. */\nenum {name}_{letter}_names {{\n{''.join(lines)}}};\n"
    outputs = ""
    if sizes.n_o:
        outputs = (
            f"\n/* The outputs in the present state, {name}_n_y values. */\n"
            f"int {name}_outputs({name} *model, double *outputs);\n"
        )
    n_p, n_r = max(sizes.n_p, 1), max(sizes.n_r, 1)
    members = "".join(
        f"    {member + ';':<18}{f'/* {comment} */' if comment else ''}".rstrip() + "\n"
        for member, comment in (
            ("double t", "time"),
            (f"double x[{n_x}]", "state"),
            (f"double p[{n_p}]", f"parameters; call {name}_update after a change"),
            (f"double r[{n_r}]", "values of inputs that are held"),
            (f"double slope[{n_r}]", "by which held inputs change with time, from `since` on; 0 at first"),
            ("double since", ""),
            (f"int held[{n_r}]", "whether each input is held, or follows its expression of time"),
        )
    )
    statuses = "".join(f"    {name}_{word} = {number},\n" for word, number in STATUSES.items())
    statuses = statuses.rstrip(",\n") + "\n"
    guard = f"{name}_h".upper()
    return f"""\
/* The mechanism "{name}" as a C library, generated by fourbar_codegen {version}. Do not edit.
 *
 * Model {manifest["fingerprint"][:16]}. C99, without memory allocation, global variables and vectors. Functions that
 * can fail return 0, or a status that {name}_message explains; the mechanism is then as it was, unless said otherwise.
 * Of two mechanisms, each needs its own `{name}`. A copy of it is a copy of the mechanism in its present state.
 * Quantities are in the units of the model, angles in rad, times in s. Matrices are stored row by row.
 */
#ifndef {guard}
#define {guard}

#ifdef __cplusplus
extern "C" {{
#endif

/* Numbers of coordinates, speeds, states, parameters, inputs, outputs, multipliers and points. */
enum {name}_sizes {{
    {name}_n_q = {sizes.n_q},
    {name}_n_u = {sizes.n_u},
    {name}_n_x = {n_x},
    {name}_n_p = {sizes.n_p},
    {name}_n_r = {sizes.n_r},
    {name}_n_y = {sizes.n_o},
    {name}_n_l = {sizes.n_c + sizes.n_n},
    {name}_n_points = {sizes.n_points}
}};

/* Statuses; {name}_message explains them. */
enum {name}_statuses {{
{statuses}}};
{enums}
typedef struct {name} {{
{members}    union {{
        double alignment;
        unsigned char bytes[{_memory(program)}];
    }} memory; /* not for you */
}} {name};

/* Defaults of the parameters, and the model's initial values at t = 0, which need not close the loops. Inputs with an
 * expression follow it; others are held, and not a number until they are set. */
void {name}_init({name} *model);

/* Derives constants from the parameters. */
int {name}_update({name} *model);

/* Closes the loops: the last {manifest["n_dependent_coordinates"]} coordinates by Newton's method, from the values in
 * x as guesses, and the last {manifest["n_dependent_speeds"]} speeds, from the other ones. */
int {name}_close({name} *model);

/* One step of length h: the Runge-Kutta method of order 4 (four evaluations) or 8 (twelve), then a projection onto the
 * constraints. Held inputs are constant in it, or linear. Its work depends on the state only in the projection.
 */
int {name}_step({name} *model, double h, int order);

/* A run to t_end by the method DOP853 with step control, projected onto the constraints after each step. The states at
 * n_times times between, in the order of the run, are stored in rows of `states`. On failure the mechanism is where the
 * run ended; rows of later times are not written. */
int {name}_simulate({name} *model, double t_end, double rtol, double atol, const double *times, long n_times,
    double *states);

/* dx/dt at another time and state, with the inputs as they are held. */
int {name}_rhs({name} *model, double t, const double *x, double *rates);

/* The derivatives of the speeds, {name}_n_u values, and the multipliers of the constraints, {name}_n_l values. */
int {name}_solution({name} *model, double *accelerations, double *multipliers);
{outputs}
/* Kinetic and potential energy; not a number if unknown.{_left_out(manifest)} */
void {name}_energies({name} *model, double *kinetic, double *potential);

/* The largest violation of a constraint, of position or velocity. */
double {name}_violation({name} *model);

/* The same relative to the terms of the constraint. */
double {name}_relative_violation({name} *model);

/* The present value of an input, held or not; not a number if there is no such input. */
double {name}_input({name} *model, int number);

/* Whether the speed of a prescribed motion jumps at the present time. */
int {name}_jumps({name} *model);

/* The next time at which a condition in an expression changes, as far as it is linear or quadratic in time; infinite if
 * there is none. */
double {name}_next_breakpoint({name} *model);

/* From now on, and until the next run, inputs are evaluated between two discontinuities in time only: at these they are
 * what they are just after the first, and just before the second. For callers that integrate by themselves. */
void {name}_between({name} *model, double begin, double end);

/* Moves the state onto the constraints nearby, orthogonally with respect to the mass matrix. */
int {name}_project({name} *model);

/* What a status means. */
const char *{name}_message(int status);

/* In {name}_derivatives.c, which may be left out: the derivatives of dx/dt with respect to states, parameters and
 * inputs, {name}_n_x rows each, those by parameters also through the expressions of inputs that are not held; and the
 * positions of points, three coordinates each. */
int {name}_jacobian({name} *model, double *jacobian);
int {name}_parameter_jacobian({name} *model, double *jacobian);
int {name}_input_jacobian({name} *model, double *jacobian);
void {name}_points({name} *model, double *points);

#ifdef __cplusplus
}}
#endif

#endif
"""


def _plain(text: str) -> str:
    """Text that is safe in a comment of C99."""
    return re.sub(r"[^ -~]", "?", text).replace("*/", "* /").replace("/*", "/ *")


def _left_out(manifest: Mapping[str, Any]) -> str:
    """A sentence on what the potential energy leaves out, if anything."""
    without = ", ".join(manifest["energy_without"])
    return f" The latter is without {_plain(without)}." if without else ""


def _memory(program: Program) -> int:
    """Bytes that fb_own of fourbar_library.h needs at most: eight for each number."""
    s = program.sizes
    n_x, n_l, c, u, n = s.n_q + s.n_u + s.n_z, s.n_c + s.n_n, s.n_c, s.n_u, s.n_n
    padded = (n_x + 7) // 8 * 8
    structure = program.structure
    if program.factors is not None:
        n_mass, n_jacobian = u + len(program.factors.nodes), c * u
        lanes = (c + 8) // 8 * 8
        factors = 4 + (u + c) * lanes + 2 + 4 * c + u + c * u + 2 * u * u
    elif structure is None:
        n_mass, n_jacobian = u * u, c * u
        factors = 2 + 4 * c + u + c * u + 2 * u * u
    else:
        n_mass, n_jacobian = len(structure.mass_entries), len(structure.jacobian_entries)
        factors = u + c + len(structure.tables()["below"]) + n_jacobian + c
    work = s.n_q + n_mass + 2 * n_jacobian + 2 * u + c + n_l + (u + n_l + s.n_z) * max(n_x, s.n_p, s.n_r) + factors
    work += s.n_z * (u + n_l) + u * (1 + n) + n * (2 + 2 * n + u + c) + n * (u + c + n + 2) + u + c
    own = s.n_constants + 34 * padded + 2 * n_x + 16 * s.n_r
    constant = 900  # the run with its weights, the problem, and arrays of length 1 instead of 0
    return 8 * (work + own + constant)


def _internal(name: str) -> str:
    """Declarations of what the derivatives' source needs from the other one."""
    return f"""
int {name}_differentiate({name} *model, const fb_derivatives *derivatives, fb_sensitivity *function, int n,
    double *matrix);
int {name}_differentiate_by_parameters({name} *model, const fb_derivatives *derivatives, double *matrix);
void {name}_draw({name} *model, const fb_derivatives *derivatives, double *points);
"""


def _derivatives(name: str) -> str:
    """The functions of the derivatives' source."""
    of = f"{name}_derivatives"
    return f"""{_internal(name)}
int {name}_jacobian({name} *model, double *jacobian)
{{
    return {name}_differentiate(model, &{of}, {of}.sensitivity, {name}_n_x, jacobian);
}}

int {name}_parameter_jacobian({name} *model, double *jacobian)
{{
    return {name}_differentiate_by_parameters(model, &{of}, jacobian);
}}

int {name}_input_jacobian({name} *model, double *jacobian)
{{
    return {name}_differentiate(model, &{of}, {of}.input_sensitivity, {name}_n_r, jacobian);
}}

void {name}_points({name} *model, double *points)
{{
    {name}_draw(model, &{name}_derivatives, points);
}}
"""


def _example(name: str, manifest: Mapping[str, Any]) -> str:
    shown_states = min(len(manifest["coordinates"]), 6)
    unset = [k for k, entry in enumerate(manifest["inputs"]) if entry["expression"] is None]
    zero = "".join(f"    model.r[{k}] = 0.0; /* {_plain(manifest['inputs'][k]['name'])} */\n" for k in unset)
    columns = ", ".join(_plain(n) for n in manifest["coordinates"][:shown_states])
    return f"""\
/* Prints a second of the motion of "{name}": t, {columns}. */
#include "{name}.h"

#include <stdio.h>

int main(void)
{{
    static {name} model; /* too large for some stacks */
    {name}_init(&model);
{zero}    int status = {name}_close(&model);
    for (int i = 0; i <= 100 && status == 0; ++i) {{
        printf("%.3f", model.t);
        for (int k = 0; k < {shown_states}; ++k)
            printf(" %.15g", model.x[k]);
        printf("\\n");
        for (int k = 0; k < 10 && status == 0; ++k)
            status = {name}_step(&model, 1e-3, 4);
    }}
    if (status != 0)
        fprintf(stderr, "t = %g: %s\\n", model.t, {name}_message(status));
    return status;
}}
"""


def _cmake(name: str) -> str:
    return f"""\
cmake_minimum_required(VERSION 3.10)
project({name} C)

set(CMAKE_C_STANDARD 99)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()

add_library({name} STATIC {name}.c {name}_derivatives.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()

add_executable({name}_example main.c)
target_link_libraries({name}_example {name})
"""


def _readme(name: str, manifest: Mapping[str, Any], version: str) -> str:
    return f"""\
# {name}

The mechanism {name} as a C library, generated by fourbar_codegen {version} (model {manifest["fingerprint"][:16]}).

    gcc -std=c99 -O2 *.c -o example -lm && ./example

or `cmake -B build && cmake --build build`. `{name}.h` declares and explains the functions; `main.c` is an
example, for your program to take its place: it is written only where there is none. All other files are replaced by the
next export.

| File | |
|---|---|
| `{name}.h` | what a program includes |
| `{name}.c` | the equations of motion, loop closure, steps and runs |
| `{name}_derivatives.c` | derivatives and positions of points; may be left out |
| `runtime/` | headers that these sources include, the same for every model |

Compile without `-ffast-math` and `-Ofast`: infinities and NaN must be detected.
"""
