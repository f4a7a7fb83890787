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

#include <stddef.h>

#define FB_ABI_VERSION 20
#define FB_CAPSULE_NAME "fourbar_codegen.kernel"

/* Long functions are printed in parts, which the compiler must not inline. */
#if defined(__GNUC__)
#define FB_PART __attribute__((noinline))
#else
#define FB_PART
#endif

/* The most directions that variations take at once: the columns of their arguments and results, stored row by row. */
enum { FB_DIRECTIONS = 8 };

/* The instruction set that a kernel was compiled for, beyond the baseline of its architecture. */
enum FB_INSTRUCTION_SET { FB_BASELINE = 0, FB_AVX2 = 1, FB_AVX512 = 2 };

enum FB_STATUS {
    FB_OK = 0,
    FB_CONSTRAINTS_DEPENDENT = 1,   /* J has lost rank, or J u' + gamma = 0 has no solution */
    FB_MASS_SINGULAR = 2,           /* T^T M T is not positive definite */
    FB_NOT_FINITE = 3,              /* a result is infinite or not a number */
    FB_NOT_CLOSED = 4,              /* no state nearby satisfies the constraints */
    FB_CONSTRAINTS_INDEPENDENT = 5, /* J has a larger rank than the model has dependent speeds */
    FB_FORCES_UNDETERMINED = 6,     /* no unknown forces keep the auxiliary speeds zero, or many do */
    FB_FORCES_NOT_FOUND = 7         /* Newton's method does not find unknown forces that do */
};

/* A result that contains x', for which the equations are solved. */
typedef int fb_evaluation(double t, const double *x, const double *constants, const double *r, double *result,
                          void *work);
/* Derivatives of q' and of (f - M u' + J^T lambda, -(J u' + gamma), z'), with u' and lambda held. If unknown forces n
 * drive the motion (fourbar_forces.h), they follow lambda, here and in all arrays of multipliers; their effect is added
 * to f, and the rows of the auxiliary speeds follow those of J. */
typedef void fb_sensitivity(double t, const double *x, const double *constants, const double *r,
                            const double *accelerations, const double *multipliers, double *coordinate_rate_jacobian,
                            double *residual_jacobian);

/* Derivatives of the outputs, with u' and lambda held. */
typedef void fb_output_sensitivity(double t, const double *x, const double *constants, const double *r,
                                   const double *accelerations, const double *multipliers, double *output_jacobian);

/* Derivatives and data for drawings, which a simulation by an explicit method does not need. */
typedef struct fb_derivatives {
    int abi_version;
    size_t struct_size;
    fb_sensitivity *sensitivity, *parameter_sensitivity, *input_sensitivity; /* with respect to x, p and r */
    /* dr/dp of the default inputs, n_r by n_p */
    void (*default_input_sensitivity)(double t, const double *constants, double *default_input_jacobian);
    /* d(J u + b)/dq, dPhi/dr and d(J u + b)/dr */
    void (*constraint_sensitivity)(double t, const double *x, const double *constants, const double *r,
                                   double *velocity_jacobian, double *position_input_jacobian,
                                   double *velocity_input_jacobian);
    /* dz'/du' and dz'/dlambda; NULL without auxiliary states */
    void (*state_rate_sensitivity)(double t, const double *x, const double *constants, const double *r,
                                   const double *accelerations, const double *multipliers,
                                   double *state_rate_acceleration_jacobian, double *state_rate_multiplier_jacobian);
    /* of the outputs, with respect to x, p and r, and to u' and lambda; NULL without outputs */
    fb_output_sensitivity *output_sensitivity, *output_parameter_sensitivity, *output_input_sensitivity;
    void (*output_solution_sensitivity)(double t, const double *x, const double *constants, const double *r,
                                        const double *accelerations, const double *multipliers,
                                        double *output_acceleration_jacobian, double *output_multiplier_jacobian);
    /* positions (n_points, 3) and forces (n_forces, 3) in the inertial frame */
    void (*drawing)(double t, const double *x, const double *constants, const double *r, double *points,
                    double *forces);
    /* q'' (n_q), and velocities and accelerations of the drawn points, (n_points, 3) each, with u' given */
    void (*motion)(double t, const double *x, const double *constants, const double *r, const double *accelerations,
                   double *coordinate_accelerations, double *point_velocities, double *point_accelerations);
} fb_derivatives;

/* Products of derivatives with directions and weights, which derivatives of simulations need. */
typedef struct fb_variations {
    int abi_version;
    size_t struct_size;
    /* Those of fb_sensitivity along n <= FB_DIRECTIONS directions of (x, p, r); ... */
    void (*variation)(double t, const double *x, const double *constants, const double *r, const double *accelerations,
                      const double *multipliers, int n, const double *directions, double *coordinate_rate_variation,
                      double *residual_variation);
    /* ... and those of the results of constraint_violation */
    void (*constraint_variation)(double t, const double *x, const double *constants, const double *r, int n,
                                 const double *directions, double *position_variation, double *velocity_variation);
    /* For reverse derivatives: the gradient by (x, p, r) of the sum of weights times q' and the residual, ... */
    void (*pullback)(double t, const double *x, const double *constants, const double *r, const double *accelerations,
                     const double *multipliers, const double *weights, double *gradient);
    /* ... and of weights times the results of constraint_violation */
    void (*constraint_pullback)(double t, const double *x, const double *constants, const double *r,
                                const double *weights, double *gradient);
} fb_variations;

/* The last call with the same `work`, if that helps: rhs at the same state, or project, which led there. */
enum FB_LAST { FB_LAST_ANY = 0, FB_LAST_RHS = 1, FB_LAST_PROJECT = 2 };

typedef struct fb_batch_functions fb_batch_functions; /* fourbar_batch.h */

typedef struct fb_kernel {
    int abi_version;
    size_t struct_size;
    size_t work_size;
    int n_q, n_u, n_z; /* coordinates, speeds, auxiliary states */
    int n_x;           /* all of these */
    int n_p, n_r;
    int states_need_solution; /* whether z' contains u' or lambda */
    int n_h;                  /* position constraints */
    int n_c;                  /* velocity constraints */
    int n_l;                  /* multipliers: n_c, then unknown forces that drive the motion */
    int n_i;                  /* invariants: position constraints that no speed changes, such as norms of quaternions */
    int n_o;                  /* outputs */
    int n_breakpoints;        /* times at which expressions have a jump or a kink */
    int n_points;             /* drawn points */
    int n_forces;             /* drawn points on which forces of inputs act */
    int n_constants;
    const int *position_row; /* for each position constraint the row of J that keeps it, or -1 */

    void (*prepare)(const double *p, double *constants);
    void (*default_inputs)(double t, const double *constants, double *r);
    void (*breakpoints)(const double *constants, double *times);
    fb_evaluation *rhs; /* x' */
    /* the same, with gamma + 2 a (J u + b) + a^2 Phi instead of gamma, so that violations Phi decay as
     * Phi'' + 2 a Phi' + a^2 Phi = 0 (J. Baumgarte, "Stabilization of constraints and integrals of motion in dynamical
     * systems", Computer Methods in Applied Mechanics and Engineering 1, 1972) */
    int (*stabilized)(double t, const double *x, const double *constants, const double *r, double a, double *rates,
                      void *work);
    /* dx'/dx, dx'/dp or dx'/dr, each n_x by n, from the sensitivity with respect to n quantities; and the multipliers'
     * derivatives, n_l by n, unless multiplier_jacobian is NULL */
    int (*differentiate)(const fb_derivatives *derivatives, fb_sensitivity *sensitivity, int n, double t,
                         const double *x, const double *constants, const double *r, double *matrix,
                         double *multiplier_jacobian, void *work);
    /* the changes of x' along n <= FB_DIRECTIONS directions of (x, p, r); `known` is NULL, or the u' of the last rhs
     * with the same `work`, at the same state */
    int (*vary)(const fb_derivatives *derivatives, const fb_variations *variations, double t, const double *x,
                const double *constants, const double *r, const double *known, int n, const double *directions,
                double *rates, void *work);
    /* moves the directions' rows of coordinates and speeds onto the constraints' tangent, mass-orthogonally */
    int (*vary_closed)(const fb_derivatives *derivatives, const fb_variations *variations, double t, const double *x,
                       const double *constants, const double *r, enum FB_LAST last, int n, double *directions,
                       void *work);
    /* The transposes of both. The gradient by (x, p, r) of the sum of weights times x', n_x, then times the
     * multipliers, n_l; ... */
    int (*pull_back)(const fb_derivatives *derivatives, const fb_variations *variations, double t, const double *x,
                     const double *constants, const double *r, const double *weights, double *gradient, void *work);
    /* ... and from a gradient by (x, p, r) where x is on the tangent, the one where x is any direction */
    int (*pull_back_closed)(const fb_derivatives *derivatives, const fb_variations *variations, double t,
                            const double *x, const double *constants, const double *r, double *gradient, void *work);
    /* u' and the multipliers lambda of M u' = f + J^T lambda */
    int (*accelerations)(double t, const double *x, const double *constants, const double *r, double *accelerations,
                         double *multipliers, void *work);
    /* z', for given u' and lambda; NULL without auxiliary states */
    void (*state_rates)(double t, const double *x, const double *constants, const double *r,
                        const double *accelerations, const double *multipliers, double *state_rates);
    /* q', M, f, J, gamma of M u' = f + J^T lambda, J u' + gamma = 0 */
    void (*dynamics)(double t, const double *x, const double *constants, const double *r, double *coordinate_rates,
                     double *mass_matrix, double *forcing, double *constraint_jacobian, double *acceleration_bias);
    /* Unknown forces n: F(n) of M u' = f + F + J^T lambda, its derivative, and Q(n), its derivative, M_a and J_a^T of
     * the auxiliary speeds' rows Q - M_a u' + J_a^T lambda = 0; NULL without such forces */
    void (*unknown_forces)(double t, const double *x, const double *constants, const double *r, const double *forces,
                           double *effect, double *effect_jacobian, double *auxiliary_forcing,
                           double *auxiliary_forcing_jacobian, double *auxiliary_mass,
                           double *auxiliary_constraint_jacobian);
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
    /* scales of Phi, n_h values, and of both results of constraint_violation: their rounding errors, in units of the
     * precision of double */
    void (*constraint_scale)(double t, const double *x, const double *constants, const double *r,
                             double *position_scale, double *position_violation_scale,
                             double *velocity_violation_scale);
    /* the change of q that corrects the invariants */
    void (*invariant_correction)(double t, const double *q, const double *constants, const double *r,
                                 double *invariant_correction);
    /* K v for q' = K u + k */
    void (*coordinate_change)(double t, const double *q, const double *constants, const double *r, const double *change,
                              double *coordinate_change);
    /* Mass-orthogonal projection of x, which has drifted, onto the constraints. `factors_valid`: rhs was called with
     * the same `work` at a state close to x. */
    int (*project)(double t, double *x, const double *constants, const double *r, int factors_valid, void *work);
    /* Whether the orientation of the constraints may have changed since the last call: whether the determinant of the
     * columns of J that the last rhs with `work` took as dependent has changed its sign. Then J has lost rank in
     * between, or a long step has passed a toggle position of these speeds. Also true if J has changed by as much as
     * its own size, so that the sign is not conclusive; or if J is close to losing rank, where rounding errors of
     * closed loops may lead around the singular position. */
    int (*orientation_changed)(void *work);
    /* kinetic and potential energy */
    void (*energy)(double t, const double *x, const double *constants, const double *r, double *energies);
    /* the outputs, for given u' and lambda */
    void (*output)(double t, const double *x, const double *constants, const double *r, const double *accelerations,
                   const double *multipliers, double *outputs);
    const fb_derivatives *derivatives;         /* or NULL, if they are in a library of their own; ... */
    const fb_variations *variations;           /* ... likewise */
    const fb_batch_functions *batch_functions; /* the same for several states side by side, or NULL */
    int batch_functions_apart;                 /* whether they are in a library of their own */
    int one_machine;                /* whether it was compiled for the processor of one machine; else it is portable */
    int instructions;               /* an FB_INSTRUCTION_SET */
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

/* dx'/dx, dx'/dp and dx'/dr; the kernel needs its derivatives. */
static inline int fb_jacobian(const fb_kernel *k, double t, const double *x, const double *constants, const double *r,
                              double *matrix, void *work)
{
    return k->differentiate(k->derivatives, k->derivatives->sensitivity, k->n_x, t, x, constants, r, matrix, NULL,
                            work);
}

static inline int fb_parameter_jacobian(const fb_kernel *k, double t, const double *x, const double *constants,
                                        const double *r, double *matrix, void *work)
{
    return k->differentiate(k->derivatives, k->derivatives->parameter_sensitivity, k->n_p, t, x, constants, r, matrix,
                            NULL, work);
}

static inline int fb_input_jacobian(const fb_kernel *k, double t, const double *x, const double *constants,
                                    const double *r, double *matrix, void *work)
{
    return k->differentiate(k->derivatives, k->derivatives->input_sensitivity, k->n_r, t, x, constants, r, matrix, NULL,
                            work);
}

/* Adds to derivatives by the parameters, (rows, n_p), those through the inputs' expressions, by their dr/dp. */
static inline void fb_add_through_inputs(const fb_kernel *k, const int rows, const double *by_inputs,
                                         const double *input_jacobian, double *by_parameters)
{
    for (int l = 0; l < k->n_r; ++l)
        for (int j = 0; j < k->n_p; ++j)
            if (input_jacobian[l * k->n_p + j] != 0.0) /* the derivative by other inputs may be infinite */
                for (int i = 0; i < rows; ++i)
                    by_parameters[i * k->n_p + j] += by_inputs[i * k->n_r + l] * input_jacobian[l * k->n_p + j];
}

#endif
