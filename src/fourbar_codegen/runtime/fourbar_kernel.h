/* The interface between a compiled model and its callers (ABI).
 *
 * The order of arguments is (t, x, constants, r):
 *   t          time
 *   x          state, coordinates q, speeds u, then auxiliary states z, n_x values
 *   constants  n_constants values that `prepare` derives from the n_p parameters p
 *   r          inputs, n_r values
 *   work       workspace of work_size bytes, aligned for double, for one call at a time
 * Matrices are stored row by row. Functions that can fail return an FB_STATUS.
 */
#ifndef FOURBAR_KERNEL_H
#define FOURBAR_KERNEL_H

#include "fourbar_enums.h"

#include <stddef.h>
#include <stdint.h>

#define FB_ABI_VERSION 26
#define FB_CAPSULE_NAME "fourbar_codegen.kernel"

/* Long functions are printed in parts, which the compiler must not inline. */
#if defined(__GNUC__)
#define FB_PART __attribute__((noinline))
#else
#define FB_PART
#endif

/* The instruction set that a kernel was compiled for, beyond the baseline of its architecture. */
enum FB_INSTRUCTION_SET { FB_BASELINE = 0, FB_AVX2 = 1, FB_AVX512 = 2 };

/* A result that contains x', for which the equations are solved. */
typedef int fb_evaluation(double t, const double *x, const double *constants, const double *r, double *result,
                          void *work);

/* Where a function of the table is evaluated. A pointer that it does not need may be NULL.
 *
 * The residual, of which some are derivatives, is (f - M u' + J^T lambda, -(J u' + gamma), z'). If unknown forces n
 * drive the motion (kernel/unknown_forces.h), they follow lambda in all arrays of multipliers; their effect is added to
 * f, and the rows Q - M_a u' + J_a^T lambda of the auxiliary speeds follow those of J. */
typedef struct fb_at {
    double t;
    const double *x, *constants, *r;
    const double *accelerations, *multipliers; /* u', and lambda with unknown forces behind it */
    int32_t n_directions; /* of JVPs: the columns of directions and results, FB_DIRECTIONS at most */
} fb_at;

/* The name and the shape of an argument or a result; a vector has FB_VECTOR columns. */
typedef struct fb_array {
    const char *name;
    int32_t rows, columns;
} fb_array;

/* A function of a state. Its role is its place in the table; see fourbar_enums.h. */
typedef struct fb_function {
    /* returns an FB_STATUS; NULL in a kernel or part that has no function of that role */
    int (*call)(const fb_at *at, const double *const *arguments, double *const *results, void *work);
    int32_t needs; /* of fb_at: FB_NEEDS */
    int32_t n_arguments, n_results;
    const fb_array *arguments, *results;
} fb_function;

/* Functions that a simulation by an explicit method does not need, which may be in a library of their own. */
typedef struct fb_part {
    int32_t abi_version;
    int64_t struct_size;
    fb_function functions[FB_N_ROLES];
} fb_part;

/* Adds the functions of a part to a table; returns whether it was built with these headers, as it must be. */
static inline int fb_attach(fb_function *functions, const fb_part *part)
{
    if (part->abi_version != FB_ABI_VERSION || part->struct_size != (int64_t)sizeof(fb_part))
        return 0;
    for (int role = 0; role < FB_N_ROLES; ++role)
        if (part->functions[role].call != NULL)
            functions[role] = part->functions[role];
    return 1;
}

/* The last call with the same `work`, if that helps: rhs at the same state, or project, which led there. */
enum FB_LAST { FB_LAST_ANY = 0, FB_LAST_RHS = 1, FB_LAST_PROJECT = 2 };

/* Whether a state is the first one of a run, one of its states, or none. */
enum FB_LOOK { FB_LOOK_FIRST, FB_LOOK_ALONG, FB_LOOK_ASIDE };

typedef struct fb_batch_functions fb_batch_functions; /* lanes/batch.h */

typedef struct fb_kernel {
    int32_t abi_version;
    int64_t struct_size;
    int32_t n_roles; /* FB_N_ROLES */
    int64_t work_size;
    int32_t n_q, n_u, n_z; /* coordinates, speeds, auxiliary states */
    int32_t n_x;           /* all of these */
    int32_t n_p, n_r;
    int32_t states_need_solution, outputs_need_solution; /* whether z', and outputs, contain u' or lambda */
    int32_t outputs_need_inputs;                         /* whether outputs depend on r */
    int32_t n_h;                                         /* position constraints */
    int32_t n_c;                                         /* velocity constraints */
    int32_t n_l;           /* multipliers: n_c, then unknown forces that drive the motion */
    int32_t n_i;           /* invariants: position constraints that no speed changes, such as norms of quaternions */
    int32_t n_o;           /* outputs */
    int32_t n_breakpoints; /* times at which expressions of time may have a jump or a kink */
    int32_t n_conditions;  /* of jumps of the equations of motion at times that are not known beforehand */
    int32_t n_points;      /* drawn points */
    int32_t n_forces;      /* drawn points on which forces of inputs act */
    int32_t n_constants;
    const int32_t *position_row; /* for each position constraint the row of J that keeps it, or -1 */

    void (*prepare)(const double *p, double *constants);
    void (*default_inputs)(double t, const double *constants, double *r);
    fb_evaluation *rhs; /* x' */
    /* the same, with gamma + 2 a (J u + b) + a^2 Phi instead of gamma, so that violations Phi decay as
     * Phi'' + 2 a Phi' + a^2 Phi = 0 (J. Baumgarte, "Stabilization of constraints and integrals of motion in dynamical
     * systems", Computer Methods in Applied Mechanics and Engineering 1, 1972) */
    int (*stabilized)(double t, const double *x, const double *constants, const double *r, double a, double *rates,
                      void *work);
    /* In the following, `functions` is a table that has those of the parts, FB_..._PARTIALS and FB_..._JVP.
     *
     * dx'/dx, dx'/dp or dx'/dr, each n_x by n, for the role of the partial Jacobian with n columns; and the
     * multipliers' derivatives, n_l by n, unless multiplier_jacobian is NULL */
    int (*differentiate)(const fb_function *functions, enum FB_ROLE role, int n, double t, const double *x,
                         const double *constants, const double *r, double *matrix, double *multiplier_jacobian,
                         void *work);
    /* the JVP of x': its changes along n <= FB_DIRECTIONS directions of (x, p, r); `known` is NULL, or the u' of the
     * last rhs with the same `work`, at the same state */
    int (*jvp)(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *known, int n, const double *directions, double *rates, void *work);
    /* that of `project`: moves the directions' rows of coordinates and speeds onto the constraints' tangent,
     * mass-orthogonally */
    int (*projection_jvp)(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, enum FB_LAST last, int n, double *directions, void *work);
    /* The VJPs of both. The gradient with respect to (x, p, r) of the sum of weights times x', n_x, then times the
     * multipliers, n_l; ... */
    int (*vjp)(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *weights, double *gradient, void *work);
    /* ... and from a gradient with respect to (x, p, r) where x is on the tangent, the one where x is any direction */
    int (*projection_vjp)(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, double *gradient, void *work);
    /* u' and the multipliers lambda of M u' = f + J^T lambda */
    int (*accelerations)(double t, const double *x, const double *constants, const double *r, double *accelerations,
                         double *multipliers, void *work);
    /* q', M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0 */
    void (*dynamics)(double t, const double *x, const double *constants, const double *r, double *coordinate_rates,
                     double *mass_matrix, double *forcing, double *constraint_jacobian, double *acceleration_bias);
    /* Phi(q, t) and dPhi/dq */
    void (*position)(double t, const double *q, const double *constants, const double *r, double *position_constraints,
                     double *position_jacobian);
    /* J and b of J u + b = 0 */
    void (*velocity)(double t, const double *x, const double *constants, const double *r, double *constraint_jacobian,
                     double *velocity_bias);
    /* constraint violations: w in the n_c rows of J, where a change v of the speeds' integrals with J v = -w corrects
     * Phi (w = Phi in rows that are its rates), then the n_i invariants; and J u + b */
    void (*constraint_violation)(double t, const double *x, const double *constants, const double *r,
                                 double *position_violation, double *velocity_violation);
    /* K v for q' = K u + k */
    void (*coordinate_change)(double t, const double *q, const double *constants, const double *r, const double *change,
                              double *coordinate_change);
    /* Mass-orthogonal projection of x, which has drifted, onto the constraints. `factors_valid`: rhs was called with
     * the same `work` at a state close to x. */
    int (*project)(double t, double *x, const double *constants, const double *r, int factors_valid, void *work);
    /* Whether the sign of det J_d may have changed since the last call: whether the determinant of the columns of J
     * that the last rhs with `work` took as dependent has changed its sign. Then J has lost rank in between, or a long
     * step has passed a toggle position of these speeds. Also true if J has changed by as much as its own size, so that
     * the sign is not conclusive; or if J is close to losing rank, where rounding errors of closed loops may lead
     * around the singular position. */
    int (*toggled)(void *work);
    /* The least pivot of J, with rows and columns in units of their largest entries in a run, those of this state
     * included or not; not a number where J is none. It is zero at singular positions. NULL without constraints. */
    double (*least_pivot)(double t, const double *x, const double *constants, const double *r, enum FB_LOOK look,
                          void *work);
    const fb_function *functions;              /* FB_N_ROLES */
    const fb_part *derivatives;                /* or NULL, if they are in a library of their own; ... */
    const fb_part *products;                   /* ... likewise */
    const fb_batch_functions *batch_functions; /* the same for batches of states, or NULL */
    int32_t batch_functions_apart;             /* whether they are in a library of their own */
    int32_t one_machine;            /* whether it was compiled for the processor of one machine; else it is portable */
    int32_t instructions;           /* an FB_INSTRUCTION_SET */
    const struct fb_kernel *faster; /* the same for processors with more instructions, or NULL; empty, with abi_version
                                     * 0, if the compiler was not told to use them */
} fb_kernel;

/* Whether a kernel exists, and the processor has the instructions that it was compiled for. */
static inline int fb_runs_here(const fb_kernel *k)
{
    if (k == NULL || k->abi_version != FB_ABI_VERSION)
        return 0;
#if defined(__GNUC__) && (defined(__x86_64__) || defined(__i386__))
    __builtin_cpu_init();
    const int avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (k->instructions == FB_AVX512)
        return avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
               __builtin_cpu_supports("avx512vl");
    if (k->instructions == FB_AVX2)
        return avx2;
#endif
    return k->instructions == FB_BASELINE;
}

/* The fastest version of a kernel that the processor can run. */
static inline const fb_kernel *fb_fastest(const fb_kernel *kernel)
{
    while (fb_runs_here(kernel->faster))
        kernel = kernel->faster;
    return kernel;
}

/* Description of a shared library without Python: the symbol `fourbar_library`. */
typedef struct fb_library {
    const fb_kernel *kernel;
    const char *const *structure; /* of the manifest, lines of JSON, ended by NULL */
} fb_library;

/* Adds to derivatives with respect to the parameters, (rows, n_p), those through the inputs' expressions, by their
 * dr/dp. */
static inline void fb_add_through_inputs(const fb_kernel *k, const int rows, const double *wrt_inputs,
                                         const double *input_jacobian, double *wrt_parameters)
{
    for (int l = 0; l < k->n_r; ++l)
        for (int j = 0; j < k->n_p; ++j)
            if (input_jacobian[l * k->n_p + j] != 0.0) /* the derivative with respect to other inputs may be infinite */
                for (int i = 0; i < rows; ++i)
                    wrt_parameters[i * k->n_p + j] += wrt_inputs[i * k->n_r + l] * input_jacobian[l * k->n_p + j];
}

#endif
