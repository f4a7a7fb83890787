"""What C and Python share: roles, needs and results of a kernel's functions; why runs stop; thresholds.

``setup.py`` writes them to ``fourbar_enums.h`` when the package is built.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Any, NamedTuple, Self

__all__ = [
    "DIRECTIONS",
    "EXPLICIT",
    "QUANTITIES",
    "STEP_CONTROLLED",
    "STIFF",
    "VECTOR",
    "VECTORS",
    "EventRow",
    "Method",
    "Needs",
    "Quantity",
    "Role",
    "Singular",
    "Status",
    "StopReason",
    "Threshold",
    "Watched",
    "enums_text",
]

DIRECTIONS = 8
"""The most directions that JVPs take at once: the columns of their arguments and results."""

VECTOR = -1
"""Instead of the number of columns of a vector."""


class _Enum(IntEnum):
    """An enumeration of the C interface, whose members have a comment."""

    comment: str

    def __new__(cls, value: int, comment: str) -> Self:
        member = int.__new__(cls, value)
        member._value_, member.comment = value, comment
        return member


class Status(_Enum):
    """What functions of a kernel return, and, from 20 on, those of a C library; the comment is its message."""

    OK = 0, "success"
    CONSTRAINTS_DEPENDENT = 1, "the constraints' Jacobian has lost rank, or the constraints contradict each other"
    MASS_SINGULAR = 2, "the mass matrix of the independent speeds is not positive definite"
    NOT_FINITE = 3, "a parameter, an input or a result is infinite or not a number"
    NOT_CLOSED = 4, "no state nearby satisfies the constraints"
    CONSTRAINTS_INDEPENDENT = 5, "there are more independent constraints than dependent speeds"
    FORCES_UNDETERMINED = 6, "no unknown forces keep the auxiliary speeds zero, or many do"
    FORCES_NOT_FOUND = 7, "Newton's method does not find the unknown forces"
    NOT_SOLVED = 8, "the equations of an implicit step could not be solved, not even in a much shorter one"
    INVALID_ARGUMENT = 20, "an argument is outside of its range"
    STEP_TOO_SMALL = 21, "the required step size is less than the spacing between numbers"
    TOO_MANY_STEPS = 22, "the largest number of steps is reached"
    SINGULAR_POSITION = 23, "the mechanism reaches a singular position, where it may go on in more than one way"
    SPEEDS_JUMP = (
        24,
        "the speed of a prescribed motion jumps in the step or run, or at its end; the speeds after it are unknown",
    )
    CHATTERING = (
        25,
        "the motion is led back to a jump of the equations from both sides, as where dry friction sticks",
    )


class Method(_Enum):
    """Explicit Runge-Kutta methods with step control; the comment is for users of a C library."""

    DOP853 = 0, "of order 8(5, 3), by Hairer, Norsett and Wanner"
    RK45 = 1, "of order 5(4), by Dormand and Prince"
    Tsit5 = 2, "of order 5(4), by Tsitouras"


EXPLICIT = tuple(method.name for method in Method)
"""Their names in Python."""

STIFF = "Radau"
"""The method for stiff equations; see ``steppers/radau.h``."""

STEP_CONTROLLED = (*EXPLICIT, STIFF)
"""All methods with step control in C: those of pages and FMUs."""


class StopReason(_Enum):
    """Why a run stops between two steps."""

    END = 0, "t_bound is reached"
    PAUSED = 1, "as many steps as asked for"
    FULL = 2, "no room for another sample, or for another step to keep"
    EVENT = 3, "events were found in the last step, or it is to be examined"
    TOO_SMALL = 4, "the step control asks for less than the spacing of doubles"
    INFINITE = 5, "the step's length is not finite"
    COLLAPSED = 6, "steps have become much smaller than they were on average"
    DIVERGED = 7, "the equations of an implicit step could not be solved"
    OPEN = 8, "the constraint violation is too large to be corrected: after a step by Python's solvers, or after a jump"
    SINGULAR = 9, "a singular position is reached"
    FAILED = 10, "a method with its own step control has failed, and says why"
    CHATTERING = 11, "the motion is led back to a jump of the equations from both sides, by ever more steps"


class Watched(_Enum):
    """What an event is a change of sign of: one of the values of a quantity, by its number."""

    TIME = 0, "of one value, t"
    STATE = 1, "x"
    INPUT = 2, "r"
    OUTPUT = 3, "outputs"
    MULTIPLIER = 4, "multipliers, and unknown forces that drive the motion behind them"
    ENERGY = 5, "kinetic, potential, total"
    MOMENTUM = 6, "momentum, angular momentum and spin: three components each"
    CALLABLE = 7, "a function of the caller"


class EventRow(NamedTuple):
    """An event, as runs and libraries in C take it.

    Attributes
    ----------
    quantity : Watched
    number : int or callable
        Of its values; the function of the caller itself.
    direction, terminal : int
        1, -1, or 0 for both; the number of events that end the run, or 0.
    at_start, all_roots : bool
        Whether a value of zero at the start counts; whether all roots within steps are found.
    """

    quantity: Watched
    number: Any
    direction: int
    terminal: int
    at_start: bool
    all_roots: bool


class Singular(_Enum):
    """How a run has met a singular position."""

    PASSED = 0, "a step passes it"
    JUMPED = 1, "a step has jumped past it, to another assembly mode"
    COLLAPSED = 2, "steps collapse or fail there"
    VARIED = 3, "steps collapse near it, because of derivatives"
    NEAR = 4, "a step fails near it"


class Threshold(float, Enum):
    """Bounds of relative errors and ratios; members of equal value are distinct."""

    comment: str

    def __new__(cls, value: float, comment: str) -> Self:
        """A member with a comment."""
        member = float.__new__(cls, value)
        member._value_, member.comment = len(cls.__members__), comment
        return member

    ROW_RTOL = 2e-13, "Rows and pivots of J, and pivots of M, below this fraction are rounding errors: 1000 eps."
    # At a singular position, constraints are squares of coordinates, which are then known to the root of eps, 1.5e-8.
    DETERMINED_RATIO = 1e-7, "Larger pivots and singular values, relative to the largest, determine dependent values."
    REDUNDANCY_RTOL = 1e-7, "Redundant constraints are satisfied if they are below this fraction of their terms."
    STATIC_PIVOT_RATIO = (
        0.25,
        "A static pivot order is used if pivots are at least this share of their row's largest.",
    )
    SAME_SPACINGS = (
        4.0,
        "Times that differ by so many spacings of the latest of them are equal but for rounding errors.",
    )
    # Of singular positions: the least pivot of J, relative to its geometric mean over a run, is below ...
    PASSED_RATIO = 1e-4, "... within a step after which the sign of det J_d is another one;"
    COLLAPSED_RATIO = 1e-3, "... where steps collapse or fail;"
    VARIED_RATIO = 3e-2, "... where steps collapse because of derivatives, whose rounding errors grow earlier;"
    NEAR_RATIO = 0.3, "... where a step fails although the equations can be evaluated."
    JUMP_RTOL = 1e-9, "Changes between times that are equal so are jumps if they are larger than this fraction ..."
    STEADY_RATIO = 10.0, "... and than so many times the changes on both sides, since large times are widely spaced."


class Needs(_Enum):
    """What a function of a kernel takes, besides time and parameters."""

    COORDINATES = 1, "q, the first entries of x."
    STATE = 2, "All of x."
    INPUTS = 4, "All inputs, not only those that prescribe motions."
    ACCELERATIONS = 8, "u'."
    MULTIPLIERS = 16, "lambda, and unknown forces that drive the motion behind it."


_HELD = Needs.STATE | Needs.INPUTS | Needs.ACCELERATIONS | Needs.MULTIPLIERS


class Role(_Enum):
    """What a function of a kernel computes: its place in the table of functions."""

    needs: int
    """Of `Needs`, in any combination."""

    def __new__(cls, needs: int, comment: str) -> Self:
        """A member with the next number."""
        member = int.__new__(cls, len(cls.__members__))
        member._value_, member.needs, member.comment = len(cls.__members__), needs, comment
        return member

    BREAKPOINTS = 0, "Breakpoints, times at which expressions of time may have a jump or a kink."
    DEFAULT_INPUTS = 0, "The inputs' expressions; NaN for inputs without one."
    DYNAMICS = Needs.STATE | Needs.INPUTS, "q', M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0."
    POSITION = Needs.COORDINATES, "Holonomic constraints Phi(q, t) and dPhi/dq."
    VELOCITY = Needs.STATE, "J and b of the velocity constraints J u + b = 0."
    CONSTRAINT_VIOLATION = Needs.STATE, "w of J v = -w, which corrects Phi, then the invariants; J u + b."
    CONSTRAINT_SCALE = (
        Needs.STATE,
        "Rounding errors, over the precision of double, of Phi and of both results of constraint_violation.",
    )
    INVARIANT_CORRECTION = Needs.COORDINATES, "The change of q that corrects the invariants."
    COORDINATE_CHANGE = (
        Needs.STATE | Needs.INPUTS,
        "K v, the change of q for a change v of the speeds' integrals, for q' = K u + k.",
    )
    CONDITIONS = (
        Needs.STATE | Needs.INPUTS,
        "Where these change their signs, the equations of motion jump at times that are not known beforehand.",
    )
    ENERGY = Needs.STATE, "Kinetic and potential energy."
    MOMENTA = Needs.STATE, "Linear momentum; angular momentum about the fixed point, and about the mass centre."
    OUTPUT = _HELD, "The outputs."
    STATE_RATES = _HELD, "z'."
    UNKNOWN_FORCES = (
        Needs.STATE | Needs.INPUTS,
        "F(n), dF/dn of unknown forces n; Q(n), dQ/dn, M_a, J_a^T of Q - M_a u' + J_a^T lambda = 0.",
    )
    # In the part `drawing`.
    DRAWING = Needs.STATE, "Positions of drawn points, and the inputs' forces on them."
    ORIENTATIONS = Needs.STATE, "Rotation matrices of the bodies, which take components to the inertial frame."
    MASS_PROPERTIES = Needs.STATE, "Masses and central inertias of the bodies."
    # In the part `derivatives`.
    MOTION = Needs.STATE | Needs.ACCELERATIONS, "q''; velocities and accelerations of drawn points."
    STATE_PARTIALS = _HELD, "d/dx of q' and of the residual, with u' and lambda held."
    PARAMETER_PARTIALS = _HELD, "d/dp of q' and of the residual, with u' and lambda held."
    INPUT_PARTIALS = _HELD, "d/dr of q' and of the residual, with u' and lambda held."
    DEFAULT_INPUT_PARTIALS = 0, "d/dp of the inputs' expressions; zero without one."
    CONSTRAINT_PARTIALS = Needs.STATE, "d(J u + b)/dq, dPhi/dr and d(J u + b)/dr."
    STATE_RATE_PARTIALS = _HELD, "dz'/du' and dz'/dlambda."
    OUTPUT_STATE_PARTIALS = _HELD, "d/dx of the outputs, with u' and lambda held."
    OUTPUT_PARAMETER_PARTIALS = _HELD, "d/dp of the outputs, with u' and lambda held."
    OUTPUT_INPUT_PARTIALS = _HELD, "d/dr of the outputs, with u' and lambda held."
    OUTPUT_SOLUTION_PARTIALS = _HELD, "d/du' and d/dlambda of the outputs."
    # In the part `products`.
    RESIDUAL_JVP = _HELD, "The JVP of q' and of the residual along directions of (x, p, r), with u', lambda held."
    CONSTRAINT_JVP = Needs.STATE, "The JVP of constraint_violation along directions of (x, p, r)."
    RESIDUAL_VJP = _HELD, "The gradient with respect to (x, p, r) of weights times q' and the residual."
    CONSTRAINT_VJP = Needs.STATE, "The gradient with respect to (x, p, r) of weights times constraint_violation."

    @property
    def function(self) -> str:
        """The function's name in C."""
        return self.name.lower()

    @property
    def part(self) -> str:
        """Where the function is: in the ``kernel``, or in a part that may be compiled later."""
        firsts = {"kernel": 0, "drawing": Role.DRAWING, "derivatives": Role.MOTION, "products": Role.RESIDUAL_JVP}
        return [part for part, first in firsts.items() if self >= first][-1]


class Quantity(NamedTuple):
    """A vector that is known at each state, in the inertial frame: a result of a function of the kernel's table.

    Attributes
    ----------
    name : str
    unit : str
    description : str
    """

    name: str
    unit: str
    description: str

    @property
    def components(self) -> tuple[str, ...]:
        """The names of its components."""
        return tuple(f"{self.name}_{axis}" for axis in "xyz")


QUANTITIES = {
    Role.MOMENTA: (
        Quantity("momentum", "kg m/s", "linear momentum"),
        Quantity("angular_momentum", "kg m^2/s", "angular momentum about the fixed point"),
        Quantity("spin", "kg m^2/s", "angular momentum about the mass centre"),
    ),
}
"""The results of functions of a state that runs, tables and exported libraries have besides energies."""

VECTORS = tuple(quantity for of_role in QUANTITIES.values() for quantity in of_role)
"""All of them, in order."""


def enums_text() -> str:
    """The C header with the enumerations and thresholds."""
    constants = (
        ("FB_DIRECTIONS", DIRECTIONS, "The most columns of directions of JVPs."),
        ("FB_VECTOR", VECTOR, "The columns of a vector."),
    )
    texts = [f"enum {{ {name} = {value} }}; /* {comment} */" for name, value, comment in constants]
    texts += [f"#define FB_{bound.name} {float(bound)!r} /* {bound.comment} */" for bound in Threshold]
    kinds = (
        (Status, "FB_STATUS", "FB"),
        (Method, "FB_METHOD", "FB_METHOD"),
        (StopReason, "FB_RUN", "FB_RUN"),
        (Role, "FB_ROLE", "FB"),
        (Needs, "FB_NEEDS", "FB_NEEDS"),
        (Watched, "FB_WATCHED", "FB_WATCHED"),
        (Singular, "FB_SINGULAR", "FB_SINGULAR"),
    )
    for kind, name, prefix in kinds:
        rows = [f"    {prefix}_{member.name.upper()} = {member.value}, /* {member.comment} */" for member in kind]
        rows += [f"    FB_N_{name.removeprefix('FB_')}S = {len(kind)}"] if kind in {Method, Role, Watched} else []
        texts.append("\n".join([f"/* {kind.__doc__} */", f"enum {name} {{", *rows, "};"]))
    cases = "\n".join(f'    case FB_{s.name}: return "{s.comment}";' for s in Status)
    texts.append(f"""\
static inline const char *fb_message(const int status)
{{
    switch (status) {{
{cases}
    default: return "unknown status";
    }}
}}""")
    body = "\n\n".join(texts)
    return f"""\
/* Enumerations and thresholds that C and Python share, which setup.py writes by enumerations.py. */
#ifndef FOURBAR_ENUMS_H
#define FOURBAR_ENUMS_H

/* clang-format off */
{body}
/* clang-format on */

#endif
"""
