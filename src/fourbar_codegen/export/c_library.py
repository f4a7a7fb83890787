"""A model as a C library: its header, sources, an example, and how to build them, as text."""

from __future__ import annotations

import posixpath
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from string import Template

from fourbar_codegen.codegen.c_source import derivatives_text, header_text, kernel_text
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.export.definitions import definitions_text
from fourbar_codegen.layout import Layout
from fourbar_codegen.lowering.program import Program
from fourbar_codegen.lowering.schedule import Schedule, ScheduledFunction
from fourbar_codegen.runtime.enumerations import QUANTITIES, Method, Role, Status, Watched

__all__ = ["FOLDER", "library_texts"]

FOLDER = "runtime/"
"""Of the headers that the sources include, beside these."""

KEYWORDS = """
    alignas alignof and asm auto bitand bitor bool break case catch char class compl concept const consteval
    constexpr constinit continue decltype default delete do double else enum explicit export extern false float for
    friend goto if inline int long mutable namespace new noexcept not nullptr operator or private protected public
    register requires restrict return short signed sizeof static struct switch template this throw true try typedef
    typeid typename typeof union unsigned using virtual void volatile while xor
"""
"""Of C, C++ and C's next version."""

HEADERS_AND_TARGETS = """
    errno i386 linux mips sparc stderr stdin stdout sun unix
    alloca assert complex ctype endian features fenv inttypes limits locale math memory setjmp signal stdarg stdbool
    stddef stdint stdio stdlib string tgmath threads time uchar wchar wctype windows
    main all clean help install m package test
"""
"""Macros of compilers, headers of systems, and what programs and targets of CMake are called."""

FUNCTIONS = """
    a64l abort abs acos acosf acosh acoshf acoshl acosl arc4random asctime asin asinf asinh asinhf asinhl asinl atan
    atan2 atan2f atan2l atanf atanh atanhf atanhl atanl atexit atof atoi atol atoll bcmp bcopy bsearch bzero calloc
    cbrt cbrtf cbrtl ceil ceilf ceill clearenv clearerr clock copysign copysignf copysignl cos cosf cosh coshf coshl
    cosl ctermid ctime daylight difftime div dprintf drand48 drem dremf dreml dysize ecvt erand48 erf erfc erfcf
    erfcl erff erfl exit exp exp2 exp2f exp2l expf expl expm1 expm1f expm1l fabs fabsf fabsl fclose fcvt fdim fdimf
    fdiml fdopen feof ferror fflush ffs ffsl ffsll fgetc fgetpos fgets fileno finite finitef finitel flockfile floor
    floorf floorl fma fmaf fmal fmax fmaxf fmaxl fmemopen fmin fminf fminl fmod fmodf fmodl fopen fprintf fputc
    fputs fread free freopen frexp frexpf frexpl fscanf fseek fseeko fsetpos ftell ftello ftrylockfile funlockfile
    fwrite gamma gammaf gammal gcvt getc getchar getdelim getenv getline getloadavg gets getsubopt getw gmtime hypot
    hypotf hypotl ilogb ilogbf ilogbl index initstate isinf isinff isinfl isnan isnanf isnanl j0 j0f j0l j1 j1f j1l
    jn jnf jnl jrand48 l64a labs lcong48 ldexp ldexpf ldexpl ldiv lgamma lgammaf lgammal llabs lldiv llrint llrintf
    llrintl llround llroundf llroundl localtime log log10 log10f log10l log1p log1pf log1pl log2 log2f log2l logb
    logbf logbl logf logl lrand48 lrint lrintf lrintl lround lroundf lroundl malloc mblen mbstowcs mbtowc memccpy
    memchr memcmp memcpy memmove memset mkdtemp mkstemp mkstemps mktemp mktime modf modff modfl mrand48 nan nanf
    nanl nanosleep nearbyint nearbyintf nearbyintl nextafter nextafterf nextafterl nexttoward nexttowardf
    nexttowardl nrand48 pclose perror popen pow powf powl printf pselect putc putchar putenv puts putw qecvt qfcvt
    qgcvt qsort rand random realloc reallocarray realpath remainder remainderf remainderl remove remquo remquof
    remquol rename renameat rewind rindex rint rintf rintl round roundf roundl rpmatch scalb scalbf scalbl scalbln
    scalblnf scalblnl scalbn scalbnf scalbnl scanf seed48 select setbuf setbuffer setenv setlinebuf setstate setvbuf
    signgam significand significandf significandl sin sinf sinh sinhf sinhl sinl snprintf sprintf sqrt sqrtf sqrtl
    srand srand48 srandom sscanf stpcpy stpncpy strcasecmp strcat strchr strcmp strcoll strcpy strcspn strdup
    strerror strftime strlen strncasecmp strncat strncmp strncpy strndup strnlen strpbrk strrchr strsep strsignal
    strspn strstr strtod strtof strtok strtol strtold strtoll strtoq strtoul strtoull strtouq strxfrm system tan
    tanf tanh tanhf tanhl tanl tempnam tgamma tgammaf tgammal timegm timelocal timezone tmpfile tmpnam trunc truncf
    truncl tzname tzset ungetc unsetenv valloc vdprintf vfprintf vfscanf vprintf vscanf vsnprintf vsprintf vsscanf
    wcstombs wctomb y0 y0f y0l y1 y1f y1l yn ynf ynl
"""
"""What the headers <math.h>, <stdio.h>, <stdlib.h>, <string.h> and <time.h> declare, also beyond the standard."""

MACROS_AND_TYPES = """
    BUFSIZ BYTE_ORDER CHAR_BIT CLOCKS_PER_SEC DECIMAL_DIG EOF FILE HUGE_VAL HUGE_VALF HUGE_VALL INFINITY L_ctermid
    L_cuserid L_tmpnam NAN NFDBITS NULL PIPE_BUF P_tmpdir TIMER_ABSTIME TIME_UTC WCONTINUED WEXITED WEXITSTATUS
    WIFCONTINUED WIFEXITED WIFSIGNALED WIFSTOPPED WNOHANG WNOWAIT WSTOPPED WSTOPSIG WTERMSIG WUNTRACED
    be16toh be32toh be64toh drand48_data fd_mask fd_set fpclassify htobe16 htobe32 htobe64 htole16 htole32 htole64
    isfinite isgreater isgreaterequal isless islessequal islessgreater isnormal isunordered itimerspec le16toh le32toh
    le64toh math_errhandling offsetof random_data signbit timespec timeval tm u_char u_int u_long u_short uint ulong
    ushort va_arg va_copy va_end va_list va_start
"""
"""What these headers, <float.h>, <limits.h>, <stdarg.h>, <stddef.h> and <stdint.h> define besides."""

RESERVED = frozenset(f"{KEYWORDS} {HEADERS_AND_TARGETS} {FUNCTIONS} {MACROS_AND_TYPES}".split())
"""Names that a model cannot have in C or C++, whose programs may include these headers, besides those in the texts."""

RESERVED_FAMILIES = re.compile(
    r"(CLOCK|DBL|EXIT|FD|FLT|FP|LDBL|M|MATH|MB|PTHREAD|SEEK)_[A-Z0-9_]+|[A-Z0-9_]+_(ENDIAN|MAX|MIN)|U?INT[A-Z0-9]+_C"
    r"|\w+_t"
)
"""Other ones: constants such as DBL_MAX, INT8_MAX and M_PI; types."""


HEADER = Template(
    """\
/* The mechanism "$name" as a C library, generated by fourbar_codegen $version. Do not edit.
 *
 * Model $fingerprint. C99, without memory allocation, global variables and vectors. Functions that
 * can fail return 0, or a status that ${name}_message explains; the mechanism is then as it was, unless said otherwise.
 * Of two mechanisms, each needs its own `$name`. A copy of it is a copy of the mechanism in its present state.
 * Quantities are in the units of the model, angles in rad, times in s. Matrices are stored row by row.
 */
#ifndef FOURBAR_CODEGEN_${name}_H
#define FOURBAR_CODEGEN_${name}_H

#ifdef __cplusplus
extern "C" {
#endif

/* Numbers of coordinates, speeds, states, parameters, inputs, outputs, multipliers and points; values of workspace for
 * an event, and for a run by ${name}_simulate_stiff. */
enum ${name}_sizes {
    ${name}_n_q = $n_q,
    ${name}_n_u = $n_u,
    ${name}_n_x = $n_x,
    ${name}_n_p = $n_p,
    ${name}_n_r = $n_r,
    ${name}_n_y = $n_y,
    ${name}_n_l = $n_l,
    ${name}_n_points = $n_points,
    ${name}_event_work = $event_work,
    ${name}_stiff_work = $stiff_work
};

/* Statuses; ${name}_message explains them. */
enum ${name}_statuses {
$statuses};

/* Methods of ${name}_simulate, with step control. */
enum ${name}_methods {
$methods};
$entries
struct $name {
$members    union {
        double alignment;
        unsigned char bytes[$bytes];
    } memory; /* not for you */
};
#ifndef FB_WITHOUT_TYPE /* only in the library's own sources, where another name may be the same */
typedef struct $name $name;
#endif

/* Defaults of the parameters, and the model's initial values at t = 0, which need not close the loops. Inputs with an
 * expression follow it; others are held, and not a number until they are set. */
void ${name}_init(struct $name *model);

/* Derives constants from the parameters. */
int ${name}_update(struct $name *model);

/* Closes the loops: the last $n_dependent_coordinates coordinates by Newton's method, from the values in
 * x as guesses, and the last $n_dependent_speeds speeds, from the other ones. */
int ${name}_close(struct $name *model);

/* One step of length h: the Runge-Kutta method of order 4 (four evaluations) or 8 (twelve), then a projection onto the
 * constraints. Held inputs are constant in it, or linear. Its work depends on the state only in the projection.
 */
int ${name}_step(struct $name *model, double h, int order);

/* A run to t_end by the method chosen, with step control, projected onto the constraints after each step. The states at
 * n_times times between, in the order of the run, are stored in rows of `states`. On failure the mechanism is where the
 * run ended; rows of later times are not written. */
int ${name}_simulate(struct $name *model, double t_end, double rtol, double atol, const double *times, long n_times,
    double *states);

/* What an event is a change of sign of. */
enum ${name}_quantities {
$watched};

/* An event; members that are 0 are those of most events. */
struct ${name}_event {
    int quantity, number; /* one of ${name}_quantities, and its number */
    int direction;        /* 1: only changes to positive values; -1: only those to negative ones; 0: both */
    int ends_only;        /* whether to look at the ends of steps alone, where all roots within a step are found else */
    int at_start;         /* whether a value of 0 at the start counts */
    long terminal;        /* the number of events that end the run, or 0 */
    double (*function)(void *of, double t, const double *x); /* of ${name}_quantity_callable */
    void *of;                                                /* what it is called with */
};

/* Where an event is, and the state there. */
struct ${name}_found {
    int event;
    double t, x[$n_x];
};

/* The events of a run, n of them, and what was found. The workspace has ${name}_event_work values for each event; the
 * first `room` events are stored, in the order of times, of n_found. */
struct ${name}_events {
    int n;
    const struct ${name}_event *event;
    double *work;
    struct ${name}_found *found;
    long room, n_found;
    int ended_by; /* the event that has ended the run, or -1 */
};

/* The same with events. A terminal one is a success: the mechanism is there then. */
int ${name}_simulate_events(struct $name *model, double t_end, double rtol, double atol, const double *times,
    long n_times, double *states, struct ${name}_events *events);

/* The last time in that run at which the quantity of an event, by its number, was 0, to within rounding errors, with
 * the same sign before and after, which is no event; or not a number. */
double ${name}_touched(struct $name *model, const struct ${name}_events *events, int event);

/* dx/dt at another time and state, with the inputs as they are held. */
int ${name}_rhs(struct $name *model, double t, const double *x, double *rates);

/* The derivatives of the speeds, ${name}_n_u values, and the multipliers of the constraints, ${name}_n_l values. */
int ${name}_solution(struct $name *model, double *accelerations, double *multipliers);
$outputs
/* Kinetic and potential energy; not a number if unknown.$left_out */
void ${name}_energies(struct $name *model, double *kinetic, double *potential);

$quantities
/* The largest violation of a constraint, of position or velocity. */
double ${name}_violation(struct $name *model);

/* The same relative to the terms of the constraint. */
double ${name}_relative_violation(struct $name *model);

/* The present value of an input, held or not; not a number if there is no such input. */
double ${name}_input(struct $name *model, int number);

/* Whether the speed of a prescribed motion jumps at the present time. */
int ${name}_jumps(struct $name *model);

/* The next time at which a condition in an expression changes, as far as it is linear or quadratic in time; infinite if
 * there is none. */
double ${name}_next_breakpoint(struct $name *model);

/* From now on, and until the next run, inputs are evaluated between two discontinuities in time only: at these they are
 * what they are just after the first, and just before the second. For callers that integrate by themselves. */
void ${name}_between(struct $name *model, double begin, double end);

/* Moves the state onto the constraints nearby, orthogonally with respect to the mass matrix. */
int ${name}_project(struct $name *model);

/* What a status means. */
const char *${name}_message(int status);

/* In ${name}_derivatives.c, which may be left out: the derivatives of dx/dt with respect to states, parameters and
 * inputs, ${name}_n_x rows each, those with respect to parameters also through the expressions of inputs that are not
 * held; and the positions of points, three coordinates each$points. */
int ${name}_jacobian(struct $name *model, double *jacobian);
int ${name}_parameter_jacobian(struct $name *model, double *jacobian);
int ${name}_input_jacobian(struct $name *model, double *jacobian);
void ${name}_points(struct $name *model, double *points);

/* In ${name}_stiff.c, which needs those: for stiff equations, by Radau IIA of order 5, with the Jacobian of each step.
 * A run as ${name}_simulate_events, whose `events` may be NULL; and a step of length h, made of shorter ones where its
 * equations cannot be solved. The workspace has ${name}_stiff_work values. */
int ${name}_simulate_stiff(struct $name *model, double t_end, double rtol, double atol, const double *times,
    long n_times, double *states, struct ${name}_events *events, double *work);
int ${name}_step_stiff(struct $name *model, double h, double *work);

#ifdef __cplusplus
}
#endif

#endif
"""
)
"""The header for users."""


EVENT_WORK = 256
"""Doubles of workspace for an event: c_library.h checks that they suffice."""


def library_texts(
    scheduled: Schedule,
    derivatives: Sequence[ScheduledFunction],
    names: Mapping[str, Sequence[str]],
    layout: Layout,
    version: str,
    runtime: Mapping[str, str],
    *,
    main: str | None = None,
) -> dict[str, str]:
    """The files of a library, by their paths.

    Parameters
    ----------
    scheduled : Schedule
    derivatives : sequence of ScheduledFunction
    names : mapping of str to sequence of str
        As for `kernel_text`.
    layout : Layout
    version : str
        Of fourbar_codegen.
    runtime : mapping of str to str
        Text of the headers of the runtime, by name; a library has those that its sources include.
    main : str, optional
        The text of a source besides, for others than users of C: numbers of array entries then have no names in C,
        which the model's names would have to be.

    Returns
    -------
    dict of str to str

    Raises
    ------
    ModelError
        If names are none in C, or a parameter has no default.
    """
    name = scheduled.program.name
    missing = [entry.name for entry in layout.parameters if entry.default is None]
    if missing:
        raise ModelError(
            f"A C library begins with defaults: give {', '.join(missing)} values in Model(parameters=...)."
        )
    sizes = scheduled.program.sizes
    empty = {role for role, n in ((Role.STATE_RATES, sizes.n_z), (Role.UNKNOWN_FORCES, sizes.n_n)) if n == 0}
    functions_of_library = tuple(f for f in scheduled.functions if f.function.role not in empty)
    scalar = replace(scheduled, has_batches=False, functions=functions_of_library)
    header = f'#define FB_WITHOUT_TYPE\n#include "{name}.h"\n'
    texts = {
        f"{name}.h": _header(scheduled.program, {} if main else names, layout, version),
        f"{name}.c": kernel_text(
            scalar,
            names,
            FOLDER,
            f"#define FB_LIBRARY\n{header}",
            f"{definitions_text(layout)}\n#define FB_MODEL {name}\n{_internal(name)}"
            f'#include "{FOLDER}export/c_library.h"\n{_quantities(name)}',
        ),
        f"{name}_derivatives.c": derivatives_text(name, derivatives, names, FOLDER, header, _derivatives(name)),
        f"{name}_stiff.c": _stiff(name),
        f"{FOLDER}{name}_kernel.h": header_text(scalar, names),
        "main.c": _example(name, layout),
        "CMakeLists.txt": _cmake(name),
        "README.md": _readme(name, layout, version),
    }
    headers = _included("\n".join((*texts.values(), main or "")), runtime)
    _check_name(name, texts, headers)
    return texts | {f"{FOLDER}{file}": text for file, text in headers.items()}


def _included(text: str, runtime: Mapping[str, str]) -> dict[str, str]:
    """The headers of the runtime that a text includes, by path, in alphabetic order; also those that these include."""
    found: dict[str, str] = {}
    waiting = [(text, "")]
    while waiting:
        including, folder = waiting.pop()
        names = re.findall(r'^ *# *include "([^"]+)"', including, flags=re.MULTILINE)
        paths = {posixpath.normpath(posixpath.join(folder, name.removeprefix(FOLDER))) for name in names}
        for path in (runtime.keys() & paths) - found.keys():
            found[path] = runtime[path]
            waiting.append((runtime[path], posixpath.dirname(path)))
    return dict(sorted(found.items()))


def _check_name(name: str, texts: Mapping[str, str], runtime: Mapping[str, str]) -> None:
    """Raise if C or the texts use the name of a model, or a name that begins with it, for something else.

    The texts have the model's structure, but not the type of that name, so that their functions may have it, too.
    """
    code = re.sub(r"/\*.*?\*/", "", "\n".join((*texts.values(), *runtime.values())), flags=re.DOTALL)
    code = re.sub(r'"[^"\n]*"', '""', code)
    macros = set(re.findall(r"^ *# *define +(\w+)", code, flags=re.MULTILINE))
    tags = set(re.findall(r"\b(?:struct|union|enum) +(\w+)", "\n".join(runtime.values())))
    declared = " ".join(re.findall(r"^(?:static|typedef|\})([^(\n]*)", code, flags=re.MULTILINE))
    public = {f"{name}_{word}" for word in re.findall(r"FB_PUBLIC\((\w+)\)", code)}
    public |= set(re.findall(rf"\b{name}_\w+", texts[f"{name}.h"]))
    if (
        name in RESERVED | macros | tags
        or RESERVED_FAMILIES.fullmatch(name)
        or public & (macros | set(re.findall(r"\w+", declared)))
        or texts.keys() & {f"{FOLDER}{file}" for file in runtime}
    ):
        raise ModelError(f"{name!r} is a name in C or of its library: give the Model another name to export it.")


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


def _enumerators(entries: Sequence[tuple[str, int, str]]) -> str:
    """Lines of an enumeration: names, values and comments."""
    last = len(entries) - 1
    return "".join(
        f"    {name} = {value}{',' if k < last else ''}{f' /* {_plain(comment)} */' if comment else ''}\n"
        for k, (name, value, comment) in enumerate(entries)
    )


def _entries(name: str, names: Mapping[str, Sequence[str]], layout: Layout) -> str:
    """Enumerations of the entries of arrays."""
    parameters = [
        ", ".join(filter(None, (f"{e.default:.10g} {e.unit or ''}".strip(), e.description))) for e in layout.parameters
    ]
    states = ("coordinates", "speeds", "auxiliary_states")
    described: tuple[tuple[str, str, Sequence[str], Sequence[str] | None], ...] = (
        ("x", "States: coordinates, speeds, then auxiliary states", states, None),
        ("p", "Parameters, with their units and defaults", ("parameters",), parameters),
        ("r", "Inputs", ("inputs",), [e.expression or "" for e in layout.inputs]),
        ("y", "Outputs", ("outputs",), None),
    )
    text = ""
    for letter, title, kinds, comments in described:
        entries = [entry for kind in kinds for entry in names.get(kind, ())]
        identifiers = _identifiers(f"{name}_{letter}", entries)
        comments = comments or [""] * len(entries)
        lines = _enumerators(list(zip(identifiers, range(len(entries)), comments, strict=False)))
        if lines:
            text += f"\n/* {title}. */\nenum {name}_{letter}_names {{\n{lines}}};\n"
    return text


def _members(name: str, n_x: int, n_p: int, n_r: int) -> str:
    """The members of the mechanism's type that are for users."""
    return "".join(
        f"    {member + ';':<18}{f'/* {comment} */' if comment else ''}".rstrip() + "\n"
        for member, comment in (
            ("double t", "time"),
            (f"double x[{n_x}]", "state"),
            (f"double p[{n_p}]", f"parameters; call {name}_update after a change"),
            (f"double r[{n_r}]", "values of inputs that are held"),
            (f"double slope[{n_r}]", "by which held inputs change with time, from `since` on; 0 at first"),
            ("double since", ""),
            (f"int held[{n_r}]", "whether each input is held, or follows its expression of time"),
            ("int method", f"of {name}_simulate, one of {name}_methods"),
        )
    )


def _header(program: Program, names: Mapping[str, Sequence[str]], layout: Layout, version: str) -> str:
    name, sizes = program.name, program.sizes
    n_x = sizes.n_q + sizes.n_u + sizes.n_z
    outputs = (
        f"\n/* The outputs in the present state, {name}_n_y values. */\n"
        f"int {name}_outputs(struct {name} *model, double *outputs);\n"
    )
    return HEADER.substitute(
        name=name,
        version=version,
        fingerprint=layout.fingerprint[:16],
        n_q=sizes.n_q,
        n_u=sizes.n_u,
        n_x=n_x,
        n_p=sizes.n_p,
        n_r=sizes.n_r,
        n_y=sizes.n_o,
        n_l=sizes.n_c + sizes.n_n,
        n_points=sizes.n_points,
        n_dependent_coordinates=layout.n_dependent_coordinates,
        n_dependent_speeds=layout.n_dependent_speeds,
        methods=_enumerators([(f"{name}_{each.name.lower()}", each.value, each.comment) for each in Method]),
        watched=_enumerators([(f"{name}_quantity_{each.name.lower()}", each.value, each.comment) for each in Watched]),
        event_work=EVENT_WORK,
        stiff_work=4 * n_x**2 + 19 * n_x + 4 * ((n_x + 7) // 8 * 8 + (n_x + 1) // 2),
        statuses=_enumerators([(f"{name}_{each.name.lower()}", each.value, "") for each in Status]),
        entries=_entries(name, names, layout),
        members=_members(name, n_x, max(sizes.n_p, 1), max(sizes.n_r, 1)),
        bytes=_memory(program),
        outputs=outputs if sizes.n_o else "",
        left_out=_left_out(layout),
        points=_points(layout),
        quantities=_declared_quantities(name),
    )


def _plain(text: str) -> str:
    """Text that is safe in a comment of C99."""
    return re.sub(r"[^ -~]", "?", text).replace("*/", "* /").replace("/*", "/ *")


def _head_of(name: str, role: Role) -> str:
    results = ", ".join(f"double *{quantity.name}" for quantity in QUANTITIES[role])
    return f"void {name}_{role.function}(struct {name} *model, {results})"


def _declared_quantities(name: str) -> str:
    """Declarations of functions for vectors in a state."""
    text = ""
    for role, quantities in QUANTITIES.items():
        words = "; ".join(f"{quantity.description}, {quantity.unit}" for quantity in quantities)
        comment = textwrap.wrap(
            f"{words}. Three values each, along the axes of the inertial frame; not a number if not known.", 100
        )
        text += f"/* {(chr(10) + ' * ').join([comment[0][0].upper() + comment[0][1:], *comment[1:]])} */\n"
        text += f"{_head_of(name, role)};\n"
    return text


def _quantities(name: str) -> str:
    """Functions for vectors in a state."""
    text = ""
    for role, quantities in QUANTITIES.items():
        results = ", ".join(quantity.name for quantity in quantities)
        text += f"""
{_head_of(name, role)}
{{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    {role.function}(t, model->x, problem->constants, problem->inputs, {results});
}}
"""
    return text


def _points(layout: Layout) -> str:
    """The names of points in their order, for a comment."""
    names = ", ".join(_plain(point.name) or f"point {k}" for k, point in enumerate(layout.drawing.points))
    return ":\n * " + "\n * ".join(textwrap.wrap(names, 110)) if names else ""


def _left_out(layout: Layout) -> str:
    """A sentence on what the potential energy leaves out, if anything."""
    without = ", ".join(layout.potential_energy.without)
    return f" The latter is without {_plain(without)}." if without else ""


def _memory(program: Program) -> int:
    """Bytes that fb_own of export/c_library.h needs at most: eight for each number."""
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
int {name}_differentiate(struct {name} *model, const fb_part *derivatives, enum FB_ROLE role, int n,
    double *matrix);
int {name}_differentiate_by_parameters(struct {name} *model, const fb_part *derivatives, double *matrix);
void {name}_draw(struct {name} *model, const fb_part *derivatives, double *points);
"""


def _derivatives(name: str) -> str:
    """The functions of the derivatives' source."""
    of = f"{name}_derivatives"
    return f"""{_internal(name)}
int {name}_jacobian(struct {name} *model, double *jacobian)
{{
    return {name}_differentiate(model, &{of}, FB_STATE_PARTIALS, {name}_n_x, jacobian);
}}

int {name}_parameter_jacobian(struct {name} *model, double *jacobian)
{{
    return {name}_differentiate_by_parameters(model, &{of}, jacobian);
}}

int {name}_input_jacobian(struct {name} *model, double *jacobian)
{{
    return {name}_differentiate(model, &{of}, FB_INPUT_PARTIALS, {name}_n_r, jacobian);
}}

void {name}_points(struct {name} *model, double *points)
{{
    {name}_draw(model, &{name}_derivatives, points);
}}
"""


def _stiff(name: str) -> str:
    """The source of steps and runs for stiff equations."""
    return f"""\
/* Steps and runs of the mechanism "{name}" by an implicit method, generated by fourbar_codegen. Do not edit. */
#define FB_WITHOUT_TYPE
#include "{name}.h"
#include "{FOLDER}{name}_kernel.h"

#define FB_MODEL {name}
#define FB_DERIVATIVES {name}_derivatives
#include "{FOLDER}export/stiff_run.h"
"""


def _example(name: str, layout: Layout) -> str:
    shown_states = min(len(layout.coordinates), 6)
    unset = [k for k, entry in enumerate(layout.inputs) if entry.expression is None]
    zero = "".join(f"    model.r[{k}] = 0.0; /* {_plain(layout.inputs[k].name)} */\n" for k in unset)
    columns = ", ".join(_plain(n) for n in layout.coordinates[:shown_states])
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

add_library({name} STATIC {name}.c {name}_derivatives.c {name}_stiff.c)
target_include_directories({name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}})
if(UNIX)
  target_link_libraries({name} PUBLIC m)
endif()

add_executable({name}_example main.c)
target_link_libraries({name}_example {name})
"""


def _readme(name: str, layout: Layout, version: str) -> str:
    return f"""\
# {name}

The mechanism {name} as a C library, generated by fourbar_codegen {version} (model {layout.fingerprint[:16]}).

    gcc -std=c99 -O2 *.c -o example -lm && ./example

or `cmake -B build && cmake --build build`. `{name}.h` declares and explains the functions; `main.c` is an
example, for your program to take its place: it is written only where there is none. All other files are replaced by the
next export.

| File | |
|---|---|
| `{name}.h` | what a program includes |
| `{name}.c` | the equations of motion, loop closure, steps and runs |
| `{name}_derivatives.c` | derivatives and positions of points; may be left out |
| `{name}_stiff.c` | steps and runs for stiff equations, which need the derivatives; may be left out |
| `runtime/` | headers that these sources include, the same for every model |

Compile without `-ffast-math` and `-Ofast`: infinities and NaN must be detected.
"""
