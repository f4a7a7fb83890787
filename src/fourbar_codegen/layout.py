"""What both halves of the package, and the C between them, know of a compiled model.

The enumerations are those of ``fourbar_enums.h``, which ``python -m fourbar_codegen.layout`` writes.
"""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Self

__all__ = ["Needs", "Role", "Status", "enums_text"]


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
    INVALID_ARGUMENT = 20, "an argument is outside of its range"
    STEP_TOO_SMALL = 21, "the required step size is less than the spacing between numbers"
    TOO_MANY_STEPS = 22, "the largest number of steps is reached"
    SINGULAR_POSITION = 23, "the mechanism reaches a singular position, where it may go on in more than one way"
    SPEEDS_JUMP = (
        24,
        "the speed of a prescribed motion jumps in the step or run, or at its end; the speeds after it are unknown",
    )


class Needs(_Enum):
    """What a function of a kernel needs to know, besides time, state and parameters."""

    STATE = 8, "all of x, not only q"
    INPUTS = 1, "all inputs, not only those that prescribe motions"
    ACCELERATIONS = 2, "u'"
    MULTIPLIERS = 4, "lambda, and unknown forces behind it"


class Role(_Enum):
    """What a function of a kernel computes: its place in the table of functions."""

    BREAKPOINTS = 0, "times at which expressions have a jump or a kink"
    DEFAULT_INPUTS = 1, "the inputs' expressions"
    DYNAMICS = 2, "q', M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0"
    POSITION = 3, "Phi(q, t) and dPhi/dq"
    VELOCITY = 4, "J and b of J u + b = 0"
    CONSTRAINT_VIOLATION = 5, "w of J v = -w, then the invariants; J u + b"
    CONSTRAINT_SCALE = 6, "sizes of Phi and of both results of CONSTRAINT_VIOLATION"
    INVARIANT_CORRECTION = 7, "the change of q that corrects the invariants"
    COORDINATE_CHANGE = 8, "K v of a change v of the speeds' integrals, for q' = K u + k"
    ENERGY = 9, "kinetic and potential energy"
    OUTPUT = 10, "the outputs"
    STATE_RATES = 11, "z'"
    UNKNOWN_FORCES = 12, "F(n), dF/dn; Q(n), dQ/dn, M_a and J_a^T of Q - M_a u' + J_a^T lambda = 0"
    # In the part `derivatives`.
    DRAWING = 13, "positions of drawn points, and the inputs' forces on them"
    MOTION = 14, "q''; velocities and accelerations of drawn points"
    STATE_PARTIALS = 15, "d/dx of q', and of (f - M u' + J^T lambda, -(J u' + gamma), z')"
    PARAMETER_PARTIALS = 16, "d/dp of the same"
    INPUT_PARTIALS = 17, "d/dr of the same"
    DEFAULT_INPUT_PARTIALS = 18, "d/dp of the inputs' expressions"
    CONSTRAINT_PARTIALS = 19, "d(J u + b)/dq, dPhi/dr and d(J u + b)/dr"
    STATE_RATE_PARTIALS = 20, "dz'/du' and dz'/dlambda"
    OUTPUT_STATE_PARTIALS = 21, "d/dx of the outputs"
    OUTPUT_PARAMETER_PARTIALS = 22, "d/dp of the outputs"
    OUTPUT_INPUT_PARTIALS = 23, "d/dr of the outputs"
    OUTPUT_SOLUTION_PARTIALS = 24, "d/du' and d/dlambda of the outputs"
    # In the part `products`.
    RESIDUAL_JVP = 25, "the products of the first three with directions of (x, p, r)"
    CONSTRAINT_JVP = 26, "those of the derivatives of CONSTRAINT_VIOLATION"
    RESIDUAL_VJP = 27, "the gradient with respect to (x, p, r) of weights times q' and the residual"
    CONSTRAINT_VJP = 28, "that of weights times the results of CONSTRAINT_VIOLATION"

    @property
    def part(self) -> str:
        """Where the function is: in the ``kernel``, or in a part that may be compiled later."""
        if self < Role.DRAWING:
            return "kernel"
        return "derivatives" if self < Role.RESIDUAL_JVP else "variations"


def enums_text() -> str:
    """The C header with the enumerations."""
    texts = []
    for kind, name, prefix in ((Status, "FB_STATUS", "FB"), (Role, "FB_ROLE", "FB"), (Needs, "FB_NEEDS", "FB_NEEDS")):
        rows = [f"    {prefix}_{member.name} = {member.value}, /* {member.comment} */" for member in kind]
        rows += [f"    FB_N_ROLES = {len(Role)}"] if kind is Role else []
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
/* Enumerations that C and Python share, written by `python -m fourbar_codegen.layout`. */
#ifndef FOURBAR_ENUMS_H
#define FOURBAR_ENUMS_H

/* clang-format off */
{body}
/* clang-format on */

#endif
"""


if __name__ == "__main__":
    Path(__file__).with_name("runtime").joinpath("fourbar_enums.h").write_text(enums_text(), encoding="utf-8")
