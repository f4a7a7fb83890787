/* A kernel written by hand: a point mass on a massless rod, in Cartesian coordinates.
 *
 *   q = (x, y), y upwards from the pivot; u = q'. Parameters l, g, m; input F, a horizontal force.
 *   Phi = x^2 + y^2 - l^2 = 0, so that J = (2 x, 2 y) and gamma = 2 (u_x^2 + u_y^2).
 *   M = diag(m, m), f = (F, -m g); outputs: height y + l, and tension -2 l lambda.
 *
 * With -DTWICE the constraint is written twice, so that one of its rows is redundant. With -DFB_SIDE_BY_SIDE these are
 * the functions for several states side by side. fourbar_model.h solves the equations.
 */
#include "fourbar_kernel.h"
#include "fourbar_real.h"

#include <math.h>
#include <string.h>

#ifdef TWICE
#define ROWS 2
#else
#define ROWS 1
#endif

enum {
    N_Q = 2,
    N_U = 2,
    N_P = 3,
    N_R = 1,
    N_H = ROWS,
    N_C = ROWS,
    N_I = 0,
    N_O = 2,
    N_BREAKPOINTS = 0,
    N_POINTS = 2,
    N_FORCES = 1,
    N_RANK = 1,
    N_CONSTANTS = 4
};
enum { LENGTH, GRAVITY, MASS, WEIGHT };

#define FB_TABLE(name) pendulum_##name
#define FB_DERIVATIVES pendulum_derivatives
#ifndef ALONE /* without functions for several states */
#define FB_HAS_BATCH_FUNCTIONS
#endif
#define FB_INSTRUCTIONS FB_BASELINE
#define FB_FASTER NULL

extern const fb_kernel pendulum_kernel;
extern const fb_derivatives pendulum_derivatives;
extern const fb_variations pendulum_variations;
extern const fb_batch_functions pendulum_batch_functions;

#ifdef TWICE
static const int position_row[] = {0, 1}, static_pivot_row[] = {0, 1};
#else
static const int position_row[] = {0}, static_pivot_row[] = {0};
#endif
static const int static_pivot_speed[] = {1, 0};

static void prepare(const fb_real *restrict p, fb_real *restrict constants)
{
    for (int i = 0; i < N_P; ++i)
        constants[i] = p[i];
    constants[WEIGHT] = p[MASS] * p[GRAVITY];
}

static void default_inputs(fb_real t, const fb_real *restrict constants, fb_real *restrict inputs)
{
    (void)t, (void)constants;
    inputs[0] = fb_number(0.0);
}

static void dynamics(fb_real t, const fb_real *restrict x, const fb_real *restrict constants, const fb_real *restrict r,
                     fb_real *restrict coordinate_rates, fb_real *restrict mass_matrix, fb_real *restrict forcing,
                     fb_real *restrict constraint_jacobian, fb_real *restrict acceleration_bias)
{
    (void)t;
    coordinate_rates[0] = x[2];
    coordinate_rates[1] = x[3];
    mass_matrix[0] = mass_matrix[3] = constants[MASS];
    mass_matrix[1] = mass_matrix[2] = fb_number(0.0);
    forcing[0] = r[0];
    forcing[1] = -constants[WEIGHT];
    for (int i = 0; i < N_C; ++i) {
        constraint_jacobian[2 * i] = 2.0 * x[0];
        constraint_jacobian[2 * i + 1] = 2.0 * x[1];
        acceleration_bias[i] = 2.0 * (x[2] * x[2] + x[3] * x[3]);
    }
}

static void constraint_violation(fb_real t, const fb_real *restrict x, const fb_real *restrict constants,
                                 const fb_real *restrict r, fb_real *restrict position_violation,
                                 fb_real *restrict velocity_violation)
{
    (void)t, (void)r;
    for (int i = 0; i < N_C; ++i) {
        position_violation[i] = x[0] * x[0] + x[1] * x[1] - constants[LENGTH] * constants[LENGTH];
        velocity_violation[i] = 2.0 * (x[0] * x[2] + x[1] * x[3]);
    }
}

/* The sums of the terms' absolute values. */
static void constraint_scale(fb_real t, const fb_real *restrict x, const fb_real *restrict constants,
                             const fb_real *restrict r, fb_real *restrict position_scale,
                             fb_real *restrict position_violation_scale, fb_real *restrict velocity_violation_scale)
{
    (void)t, (void)r;
    for (int i = 0; i < N_C; ++i) {
        position_scale[i] = x[0] * x[0] + x[1] * x[1] + constants[LENGTH] * constants[LENGTH];
        position_violation_scale[i] = position_scale[i];
        velocity_violation_scale[i] =
            2.0 * ((fb_abs(x[0]) + 1e-12) * (fb_abs(x[2]) + 1e-12) + (fb_abs(x[1]) + 1e-12) * (fb_abs(x[3]) + 1e-12));
    }
}

static void invariant_correction(fb_real t, const fb_real *restrict q, const fb_real *restrict constants,
                                 const fb_real *restrict r, fb_real *restrict correction)
{
    (void)t, (void)q, (void)constants, (void)r;
    correction[0] = correction[1] = fb_number(0.0);
}

static void coordinate_change(fb_real t, const fb_real *restrict q, const fb_real *restrict constants,
                              const fb_real *restrict r, const fb_real *restrict change, fb_real *restrict result)
{
    (void)t, (void)q, (void)constants, (void)r;
    result[0] = change[0];
    result[1] = change[1];
}

#ifdef FB_SIDE_BY_SIDE
#include "fourbar_side_by_side.h"
#else
static void breakpoints(const double *restrict constants, double *restrict times)
{
    (void)constants, (void)times;
}

static void position(double t, const double *restrict q, const double *restrict constants, const double *restrict r,
                     double *restrict position_constraints, double *restrict position_jacobian)
{
    (void)t, (void)r;
    for (int i = 0; i < N_H; ++i) {
        position_constraints[i] = q[0] * q[0] + q[1] * q[1] - constants[LENGTH] * constants[LENGTH];
        position_jacobian[2 * i] = 2.0 * q[0];
        position_jacobian[2 * i + 1] = 2.0 * q[1];
    }
}

static void velocity(double t, const double *restrict x, const double *restrict constants, const double *restrict r,
                     double *restrict constraint_jacobian, double *restrict velocity_bias)
{
    (void)t, (void)constants, (void)r;
    for (int i = 0; i < N_C; ++i) {
        constraint_jacobian[2 * i] = 2.0 * x[0];
        constraint_jacobian[2 * i + 1] = 2.0 * x[1];
        velocity_bias[i] = 0.0;
    }
}

static void energy(double t, const double *restrict x, const double *restrict constants, const double *restrict r,
                   double *restrict energies)
{
    (void)t, (void)r;
    energies[0] = 0.5 * constants[MASS] * (x[2] * x[2] + x[3] * x[3]);
    energies[1] = constants[WEIGHT] * x[1];
}

static double sum_of(const double *multipliers)
{
    double sum = 0.0;
    for (int i = 0; i < N_C; ++i)
        sum += multipliers[i];
    return sum;
}

static void output(double t, const double *restrict x, const double *restrict constants, const double *restrict r,
                   const double *restrict accelerations, const double *restrict multipliers, double *restrict outputs)
{
    (void)t, (void)r, (void)accelerations;
    outputs[0] = x[1] + constants[LENGTH];
    outputs[1] = -2.0 * constants[LENGTH] * sum_of(multipliers);
}

#include "fourbar_model.h"

/* Derivatives: columns are x, p, r; rows are those of q', of f - M u' + J^T lambda and -(J u' + gamma), ... */
enum { N_ALL = N_X + N_P + N_R, N_ROWS = N_Q + N_U + N_C };

static void slopes(const double *x, const double *constants, const double *a, const double *multipliers,
                   double rows[N_ROWS][N_ALL])
{
    memset(rows, 0, sizeof(double[N_ROWS][N_ALL]));
    for (int i = 0; i < 2; ++i) {
        rows[i][N_Q + i] = 1.0;
        rows[N_Q + i][i] = 2.0 * sum_of(multipliers);
        rows[N_Q + i][N_X + MASS] = -a[i];
        for (int k = 0; k < N_C; ++k) {
            rows[N_Q + N_U + k][i] = -2.0 * a[i];
            rows[N_Q + N_U + k][N_Q + i] = -4.0 * x[N_Q + i];
        }
    }
    rows[N_Q][N_X + N_P] = 1.0;
    rows[N_Q + 1][N_X + GRAVITY] = -constants[MASS];
    rows[N_Q + 1][N_X + MASS] -= constants[GRAVITY];
}

/* ... and those of `constraint_violation`. */
static void violation_slopes(const double *x, const double *constants, double rows[2 * N_C][N_ALL])
{
    memset(rows, 0, sizeof(double[2 * N_C][N_ALL]));
    for (int k = 0; k < N_C; ++k) {
        for (int i = 0; i < 2; ++i) {
            rows[k][i] = rows[N_C + k][N_Q + i] = 2.0 * x[i];
            rows[N_C + k][i] = 2.0 * x[N_Q + i];
        }
        rows[k][N_X + LENGTH] = -2.0 * constants[LENGTH];
    }
}

static void columns_of(double rows[N_ROWS][N_ALL], const int first, const int n, double *of_rates, double *of_residual)
{
    for (int i = 0; i < N_ROWS; ++i)
        memcpy(i < N_Q ? of_rates + i * n : of_residual + (i - N_Q) * n, rows[i] + first, (size_t)n * sizeof(double));
}

#define SENSITIVITY(name, first, n)                                                                                    \
    static void name(double t, const double *x, const double *constants, const double *r, const double *a,             \
                     const double *multipliers, double *of_rates, double *of_residual)                                 \
    {                                                                                                                  \
        double rows[N_ROWS][N_ALL];                                                                                    \
        (void)t, (void)r;                                                                                              \
        slopes(x, constants, a, multipliers, rows);                                                                    \
        columns_of(rows, first, n, of_rates, of_residual);                                                             \
    }
SENSITIVITY(sensitivity, 0, N_X)
SENSITIVITY(parameter_sensitivity, N_X, N_P)
SENSITIVITY(input_sensitivity, N_X + N_P, N_R)

static void default_input_sensitivity(double t, const double *constants, double *jacobian)
{
    (void)t, (void)constants;
    memset(jacobian, 0, N_R * N_P * sizeof(double));
}

static void constraint_sensitivity(double t, const double *x, const double *constants, const double *r,
                                   double *velocity_jacobian, double *by_input, double *velocity_by_input)
{
    (void)t, (void)constants, (void)r;
    for (int k = 0; k < N_C; ++k) {
        velocity_jacobian[2 * k] = 2.0 * x[2];
        velocity_jacobian[2 * k + 1] = 2.0 * x[3];
        by_input[k] = velocity_by_input[k] = 0.0;
    }
}

static void output_sensitivity(double t, const double *x, const double *constants, const double *r, const double *a,
                               const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers;
    memset(jacobian, 0, N_O * N_X * sizeof(double));
    jacobian[1] = 1.0;
}

static void output_parameter_sensitivity(double t, const double *x, const double *constants, const double *r,
                                         const double *a, const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a;
    memset(jacobian, 0, N_O * N_P * sizeof(double));
    jacobian[LENGTH] = 1.0;
    jacobian[N_P + LENGTH] = -2.0 * sum_of(multipliers);
}

static void output_input_sensitivity(double t, const double *x, const double *constants, const double *r,
                                     const double *a, const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers;
    jacobian[0] = jacobian[1] = 0.0;
}

static void output_solution_sensitivity(double t, const double *x, const double *constants, const double *r,
                                        const double *a, const double *multipliers, double *by_accelerations,
                                        double *by_multipliers)
{
    (void)t, (void)x, (void)r, (void)a, (void)multipliers;
    memset(by_accelerations, 0, N_O * N_U * sizeof(double));
    for (int k = 0; k < N_C; ++k) {
        by_multipliers[k] = 0.0;
        by_multipliers[N_C + k] = -2.0 * constants[LENGTH];
    }
}

static void drawing(double t, const double *x, const double *constants, const double *r, double *points, double *forces)
{
    (void)t, (void)constants;
    const double places[] = {0.0, 0.0, 0.0, x[0], x[1], 0.0};
    memcpy(points, places, sizeof places);
    forces[0] = r[0];
    forces[1] = forces[2] = 0.0;
}

static void motion(double t, const double *x, const double *constants, const double *r, const double *a,
                   double *coordinate_accelerations, double *velocities, double *accelerations)
{
    (void)t, (void)constants, (void)r;
    memset(velocities, 0, 3 * N_POINTS * sizeof(double));
    memset(accelerations, 0, 3 * N_POINTS * sizeof(double));
    for (int i = 0; i < 2; ++i) {
        velocities[3 + i] = x[N_Q + i];
        coordinate_accelerations[i] = accelerations[3 + i] = a[i];
    }
}

const fb_derivatives pendulum_derivatives = {
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_derivatives),
    .sensitivity = sensitivity,
    .parameter_sensitivity = parameter_sensitivity,
    .input_sensitivity = input_sensitivity,
    .default_input_sensitivity = default_input_sensitivity,
    .constraint_sensitivity = constraint_sensitivity,
    .output_sensitivity = output_sensitivity,
    .output_parameter_sensitivity = output_parameter_sensitivity,
    .output_input_sensitivity = output_input_sensitivity,
    .output_solution_sensitivity = output_solution_sensitivity,
    .drawing = drawing,
    .motion = motion,
};

/* Products of the same rows with n directions, and with weights. */
static void along(double rows[][N_ALL], const int count, const int n, const double *directions, double *result)
{
    for (int i = 0; i < count; ++i)
        for (int j = 0; j < n; ++j) {
            result[i * n + j] = 0.0;
            for (int k = 0; k < N_ALL; ++k)
                result[i * n + j] += rows[i][k] * directions[k * n + j];
        }
}

static void back(double rows[][N_ALL], const int count, const double *weights, double *gradient)
{
    for (int k = 0; k < N_ALL; ++k) {
        gradient[k] = 0.0;
        for (int i = 0; i < count; ++i)
            gradient[k] += weights[i] * rows[i][k];
    }
}

static void variation(double t, const double *x, const double *constants, const double *r, const double *a,
                      const double *multipliers, int n, const double *directions, double *of_rates, double *of_residual)
{
    double rows[N_ROWS][N_ALL];
    (void)t, (void)r;
    slopes(x, constants, a, multipliers, rows);
    along(rows, N_Q, n, directions, of_rates);
    along(rows + N_Q, N_U + N_C, n, directions, of_residual);
}

static void constraint_variation(double t, const double *x, const double *constants, const double *r, int n,
                                 const double *directions, double *of_positions, double *of_velocities)
{
    double rows[2 * N_C][N_ALL];
    (void)t, (void)r;
    violation_slopes(x, constants, rows);
    along(rows, N_C, n, directions, of_positions);
    along(rows + N_C, N_C, n, directions, of_velocities);
}

static void pullback(double t, const double *x, const double *constants, const double *r, const double *a,
                     const double *multipliers, const double *weights, double *gradient)
{
    double rows[N_ROWS][N_ALL];
    (void)t, (void)r;
    slopes(x, constants, a, multipliers, rows);
    back(rows, N_ROWS, weights, gradient);
}

static void constraint_pullback(double t, const double *x, const double *constants, const double *r,
                                const double *weights, double *gradient)
{
    double rows[2 * N_C][N_ALL];
    (void)t, (void)r;
    violation_slopes(x, constants, rows);
    back(rows, 2 * N_C, weights, gradient);
}

const fb_variations pendulum_variations = {
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_variations),
    .variation = variation,
    .constraint_variation = constraint_variation,
    .pullback = pullback,
    .constraint_pullback = constraint_pullback,
};
#endif
