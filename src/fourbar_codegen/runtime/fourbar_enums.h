/* Enumerations that C and Python share, written by `python -m fourbar_codegen.roles`. */
#ifndef FOURBAR_ENUMS_H
#define FOURBAR_ENUMS_H

/* clang-format off */
enum { FB_DIRECTIONS = 8 }; /* The most columns of directions of JVPs. */

enum { FB_VECTOR = -1 }; /* The columns of a vector. */

/* What functions of a kernel return, and, from 20 on, those of a C library; the comment is its message. */
enum FB_STATUS {
    FB_OK = 0, /* success */
    FB_CONSTRAINTS_DEPENDENT = 1, /* the constraints' Jacobian has lost rank, or the constraints contradict each other */
    FB_MASS_SINGULAR = 2, /* the mass matrix of the independent speeds is not positive definite */
    FB_NOT_FINITE = 3, /* a parameter, an input or a result is infinite or not a number */
    FB_NOT_CLOSED = 4, /* no state nearby satisfies the constraints */
    FB_CONSTRAINTS_INDEPENDENT = 5, /* there are more independent constraints than dependent speeds */
    FB_FORCES_UNDETERMINED = 6, /* no unknown forces keep the auxiliary speeds zero, or many do */
    FB_FORCES_NOT_FOUND = 7, /* Newton's method does not find the unknown forces */
    FB_INVALID_ARGUMENT = 20, /* an argument is outside of its range */
    FB_STEP_TOO_SMALL = 21, /* the required step size is less than the spacing between numbers */
    FB_TOO_MANY_STEPS = 22, /* the largest number of steps is reached */
    FB_SINGULAR_POSITION = 23, /* the mechanism reaches a singular position, where it may go on in more than one way */
    FB_SPEEDS_JUMP = 24, /* the speed of a prescribed motion jumps in the step or run, or at its end; the speeds after it are unknown */
};

/* What a function of a kernel computes: its place in the table of functions. */
enum FB_ROLE {
    FB_BREAKPOINTS = 0, /* Times at which expressions have a jump or a kink. */
    FB_DEFAULT_INPUTS = 1, /* The inputs' expressions; NaN for inputs without one. */
    FB_DYNAMICS = 2, /* q', M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0. */
    FB_POSITION = 3, /* Holonomic constraints Phi(q, t) and dPhi/dq. */
    FB_VELOCITY = 4, /* J and b of the velocity constraints J u + b = 0. */
    FB_CONSTRAINT_VIOLATION = 5, /* w of J v = -w, which corrects Phi, then the invariants; J u + b. */
    FB_CONSTRAINT_SCALE = 6, /* Rounding errors, over the precision of double, of Phi and of both results of constraint_violation. */
    FB_INVARIANT_CORRECTION = 7, /* The change of q that corrects the invariants. */
    FB_COORDINATE_CHANGE = 8, /* K v, the change of q for a change v of the speeds' integrals, for q' = K u + k. */
    FB_ENERGY = 9, /* Kinetic and potential energy. */
    FB_OUTPUT = 10, /* The outputs. */
    FB_STATE_RATES = 11, /* z'. */
    FB_UNKNOWN_FORCES = 12, /* F(n), dF/dn of unknown forces n; Q(n), dQ/dn, M_a, J_a^T of Q - M_a u' + J_a^T lambda = 0. */
    FB_DRAWING = 13, /* Positions of drawn points, and the inputs' forces on them. */
    FB_MOTION = 14, /* q''; velocities and accelerations of drawn points. */
    FB_STATE_PARTIALS = 15, /* d/dx of q' and of the residual, with u' and lambda held. */
    FB_PARAMETER_PARTIALS = 16, /* d/dp of q' and of the residual, with u' and lambda held. */
    FB_INPUT_PARTIALS = 17, /* d/dr of q' and of the residual, with u' and lambda held. */
    FB_DEFAULT_INPUT_PARTIALS = 18, /* d/dp of the inputs' expressions; zero without one. */
    FB_CONSTRAINT_PARTIALS = 19, /* d(J u + b)/dq, dPhi/dr and d(J u + b)/dr. */
    FB_STATE_RATE_PARTIALS = 20, /* dz'/du' and dz'/dlambda. */
    FB_OUTPUT_STATE_PARTIALS = 21, /* d/dx of the outputs, with u' and lambda held. */
    FB_OUTPUT_PARAMETER_PARTIALS = 22, /* d/dp of the outputs, with u' and lambda held. */
    FB_OUTPUT_INPUT_PARTIALS = 23, /* d/dr of the outputs, with u' and lambda held. */
    FB_OUTPUT_SOLUTION_PARTIALS = 24, /* d/du' and d/dlambda of the outputs. */
    FB_RESIDUAL_JVP = 25, /* The JVP of q' and of the residual along directions of (x, p, r), with u', lambda held. */
    FB_CONSTRAINT_JVP = 26, /* The JVP of constraint_violation along directions of (x, p, r). */
    FB_RESIDUAL_VJP = 27, /* The gradient with respect to (x, p, r) of weights times q' and the residual. */
    FB_CONSTRAINT_VJP = 28, /* The gradient with respect to (x, p, r) of weights times constraint_violation. */
    FB_N_ROLES = 29
};

/* What a function of a kernel takes, besides time and parameters. */
enum FB_NEEDS {
    FB_NEEDS_COORDINATES = 1, /* q, the first entries of x. */
    FB_NEEDS_STATE = 2, /* All of x. */
    FB_NEEDS_INPUTS = 4, /* All inputs, not only those that prescribe motions. */
    FB_NEEDS_ACCELERATIONS = 8, /* u'. */
    FB_NEEDS_MULTIPLIERS = 16, /* lambda, and unknown forces that drive the motion behind it. */
};

static inline const char *fb_message(const int status)
{
    switch (status) {
    case FB_OK: return "success";
    case FB_CONSTRAINTS_DEPENDENT: return "the constraints' Jacobian has lost rank, or the constraints contradict each other";
    case FB_MASS_SINGULAR: return "the mass matrix of the independent speeds is not positive definite";
    case FB_NOT_FINITE: return "a parameter, an input or a result is infinite or not a number";
    case FB_NOT_CLOSED: return "no state nearby satisfies the constraints";
    case FB_CONSTRAINTS_INDEPENDENT: return "there are more independent constraints than dependent speeds";
    case FB_FORCES_UNDETERMINED: return "no unknown forces keep the auxiliary speeds zero, or many do";
    case FB_FORCES_NOT_FOUND: return "Newton's method does not find the unknown forces";
    case FB_INVALID_ARGUMENT: return "an argument is outside of its range";
    case FB_STEP_TOO_SMALL: return "the required step size is less than the spacing between numbers";
    case FB_TOO_MANY_STEPS: return "the largest number of steps is reached";
    case FB_SINGULAR_POSITION: return "the mechanism reaches a singular position, where it may go on in more than one way";
    case FB_SPEEDS_JUMP: return "the speed of a prescribed motion jumps in the step or run, or at its end; the speeds after it are unknown";
    default: return "unknown status";
    }
}
/* clang-format on */

#endif
