/* A kernel written by hand: a point mass on a massless rod, in Cartesian coordinates.
 *
 *   q = (x, y), y upwards from the pivot; u = q'. Parameters l, g, m; input F, a horizontal force.
 *   Phi = x^2 + y^2 - l^2 = 0, so that J = (2 x, 2 y) and gamma = 2 (u_x^2 + u_y^2).
 *   M = diag(m, m), f = (F, -m g); outputs: height y + l, and tension -2 l lambda.
 *
 * With -DTWICE the constraint is written twice, so that one of its rows is redundant. With -DFB_LANES these are
 * the functions for batches of states. kernel/kernel.h solves the equations.
 */
#include "arithmetic/real.h"
#include "fourbar_kernel.h"

#include <math.h>
#include <string.h>

#ifdef TWICE
#define ROWS 2
#else
#define ROWS 1
#endif

#define FB_OUTPUTS_NEED_SOLUTION
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
    N_CONDITIONS = 0,
    N_POINTS = 2,
    N_FORCES = 1,
    N_RANK = 1,
    N_CONSTANTS = 4
};
enum { LENGTH, GRAVITY, MASS, WEIGHT };

#define FB_TABLE(name) pendulum_##name
#define FB_DERIVATIVES pendulum_derivatives
#ifndef ALONE /* without functions for batches of states */
#define FB_HAS_BATCH_FUNCTIONS
#endif
#define FB_INSTRUCTIONS FB_BASELINE
#define FB_FASTER NULL

extern const fb_kernel pendulum_kernel;
extern const fb_part pendulum_derivatives, pendulum_products;
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

#ifdef FB_LANES
#include "lanes/lane_equations.h"
#else
static void breakpoints(double t, const double *restrict constants, double *restrict times)
{
    (void)t, (void)constants, (void)times;
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

static void momenta(double t, const double *restrict x, const double *restrict constants, const double *restrict r,
                    double *restrict momentum, double *restrict angular_momentum, double *restrict spin)
{
    (void)t, (void)r;
    for (int i = 0; i < 3; ++i) {
        momentum[i] = i < 2 ? constants[MASS] * x[2 + i] : 0.0;
        angular_momentum[i] = spin[i] = 0.0; /* of a point mass about itself */
    }
    angular_momentum[2] = constants[MASS] * (x[0] * x[3] - x[1] * x[2]);
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

static void state_rates(double t, const double *x, const double *constants, const double *r, const double *a,
                        const double *multipliers, double *rates)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers, (void)rates;
}

static void unknown_forces(double t, const double *x, const double *constants, const double *r, const double *forces,
                           double *effect, double *wrt_forces, double *rest, double *rest_wrt_forces, double *mass,
                           double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)forces;
    (void)wrt_forces, (void)rest, (void)rest_wrt_forces, (void)mass, (void)jacobian;
    effect[0] = effect[1] = 0.0;
}

/* Functions as the table has them: their name, what they are called with, what it needs of FB_NEEDS, and the names and
 * shapes of their results. */
#define ARRAYS(...) ((const fb_array[]){__VA_ARGS__})
#define COUNT(...) (int)(sizeof(ARRAYS(__VA_ARGS__)) / sizeof(fb_array))
#define CALL(name, ...)                                                                                                \
    static int call_##name(const fb_at *at, const double *const *arguments, double *const *results, void *work)        \
    {                                                                                                                  \
        (void)at, (void)arguments, (void)work;                                                                         \
        name(__VA_ARGS__);                                                                                             \
        return FB_OK;                                                                                                  \
    }
#define OF_STATE at->t, at->x, at->constants, at->r
#define OF_SOLUTION OF_STATE, at->accelerations, at->multipliers
#define ROW(name, needs, ...) {call_##name, needs, 0, COUNT(__VA_ARGS__), NULL, ARRAYS(__VA_ARGS__)}
#define ROW_OF(given, name, needs, ...) {call_##name, needs, 1, COUNT(__VA_ARGS__), ARRAYS(given), ARRAYS(__VA_ARGS__)}
#define STATE FB_NEEDS_STATE
#define ALL STATE | FB_NEEDS_INPUTS
#define SOLVED ALL | FB_NEEDS_ACCELERATIONS | FB_NEEDS_MULTIPLIERS
#define VECTOR(name, rows) {#name, rows, FB_VECTOR}
#define MATRIX(name, rows, columns) {#name, rows, columns}

static int call_dynamics(const fb_at *, const double *const *, double *const *, void *);
CALL(breakpoints, at->t, at->constants, results[0])
CALL(default_inputs, at->t, at->constants, results[0])
CALL(position, OF_STATE, results[0], results[1])
CALL(velocity, OF_STATE, results[0], results[1])
CALL(constraint_violation, OF_STATE, results[0], results[1])
CALL(constraint_scale, OF_STATE, results[0], results[1], results[2])
CALL(invariant_correction, OF_STATE, results[0])
CALL(coordinate_change, OF_STATE, arguments[0], results[0])
CALL(energy, OF_STATE, results[0])
CALL(momenta, OF_STATE, results[0], results[1], results[2])
CALL(output, OF_SOLUTION, results[0])
CALL(state_rates, OF_SOLUTION, results[0])
CALL(unknown_forces, OF_STATE, arguments[0], results[0], results[1], results[2], results[3], results[4], results[5])

static const fb_function own_functions[FB_N_ROLES] = {
    [FB_BREAKPOINTS] = ROW(breakpoints, 0, VECTOR(breakpoints, 0)),
    [FB_DEFAULT_INPUTS] = ROW(default_inputs, 0, VECTOR(default_inputs, N_R)),
    [FB_DYNAMICS] = ROW(dynamics, ALL, VECTOR(coordinate_rates, N_Q), MATRIX(mass_matrix, N_U, N_U),
                        VECTOR(forcing, N_U), MATRIX(constraint_jacobian, N_C, N_U), VECTOR(acceleration_bias, N_C)),
    [FB_POSITION] =
        ROW(position, FB_NEEDS_COORDINATES, VECTOR(position_constraints, N_H), MATRIX(position_jacobian, N_H, N_Q)),
    [FB_VELOCITY] = ROW(velocity, STATE, MATRIX(constraint_jacobian, N_C, N_U), VECTOR(velocity_bias, N_C)),
    [FB_CONSTRAINT_VIOLATION] =
        ROW(constraint_violation, STATE, VECTOR(position_violation, N_C), VECTOR(velocity_violation, N_C)),
    [FB_CONSTRAINT_SCALE] = ROW(constraint_scale, STATE, VECTOR(position_scale, N_H),
                                VECTOR(position_violation_scale, N_C), VECTOR(velocity_violation_scale, N_C)),
    [FB_INVARIANT_CORRECTION] = ROW(invariant_correction, FB_NEEDS_COORDINATES, VECTOR(invariant_correction, N_Q)),
    [FB_COORDINATE_CHANGE] = ROW_OF(VECTOR(change, N_U), coordinate_change, ALL, VECTOR(coordinate_change, N_Q)),
    [FB_ENERGY] = ROW(energy, STATE, VECTOR(energies, 2)),
    [FB_MOMENTA] = ROW(momenta, STATE, VECTOR(momentum, 3), VECTOR(angular_momentum, 3), VECTOR(spin, 3)),
    [FB_OUTPUT] = ROW(output, SOLVED, VECTOR(outputs, N_O)),
    [FB_STATE_RATES] = ROW(state_rates, SOLVED, VECTOR(state_rates, 0)),
    [FB_UNKNOWN_FORCES] =
        ROW_OF(VECTOR(forces, 0), unknown_forces, ALL, VECTOR(force_effect, N_U), MATRIX(force_effect_jacobian, N_U, 0),
               VECTOR(auxiliary_forcing, 0), MATRIX(auxiliary_forcing_jacobian, 0, 0), MATRIX(auxiliary_mass, 0, N_U),
               MATRIX(auxiliary_constraint_jacobian, 0, N_C)),
};

#include "kernel/kernel.h"

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

#define PARTIALS(name, first, n)                                                                                       \
    static void name(double t, const double *x, const double *constants, const double *r, const double *a,             \
                     const double *multipliers, double *of_rates, double *of_residual)                                 \
    {                                                                                                                  \
        double rows[N_ROWS][N_ALL];                                                                                    \
        (void)t, (void)r;                                                                                              \
        slopes(x, constants, a, multipliers, rows);                                                                    \
        columns_of(rows, first, n, of_rates, of_residual);                                                             \
    }
PARTIALS(state_partials, 0, N_X)
PARTIALS(parameter_partials, N_X, N_P)
PARTIALS(input_partials, N_X + N_P, N_R)

static void default_input_partials(double t, const double *constants, double *jacobian)
{
    (void)t, (void)constants;
    memset(jacobian, 0, N_R * N_P * sizeof(double));
}

static void constraint_partials(double t, const double *x, const double *constants, const double *r,
                                double *velocity_jacobian, double *wrt_input, double *velocity_by_input)
{
    (void)t, (void)constants, (void)r;
    for (int k = 0; k < N_C; ++k) {
        velocity_jacobian[2 * k] = 2.0 * x[2];
        velocity_jacobian[2 * k + 1] = 2.0 * x[3];
        wrt_input[k] = velocity_by_input[k] = 0.0;
    }
}

static void output_state_partials(double t, const double *x, const double *constants, const double *r, const double *a,
                                  const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers;
    memset(jacobian, 0, N_O * N_X * sizeof(double));
    jacobian[1] = 1.0;
}

static void output_parameter_partials(double t, const double *x, const double *constants, const double *r,
                                      const double *a, const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a;
    memset(jacobian, 0, N_O * N_P * sizeof(double));
    jacobian[LENGTH] = 1.0;
    jacobian[N_P + LENGTH] = -2.0 * sum_of(multipliers);
}

static void output_input_partials(double t, const double *x, const double *constants, const double *r, const double *a,
                                  const double *multipliers, double *jacobian)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers;
    jacobian[0] = jacobian[1] = 0.0;
}

static void output_solution_partials(double t, const double *x, const double *constants, const double *r,
                                     const double *a, const double *multipliers, double *wrt_accelerations,
                                     double *wrt_multipliers)
{
    (void)t, (void)x, (void)r, (void)a, (void)multipliers;
    memset(wrt_accelerations, 0, N_O * N_U * sizeof(double));
    for (int k = 0; k < N_C; ++k) {
        wrt_multipliers[k] = 0.0;
        wrt_multipliers[N_C + k] = -2.0 * constants[LENGTH];
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

static void orientations(double t, const double *x, const double *constants, const double *r, double *rotations)
{
    (void)t, (void)x, (void)constants, (void)r;
    for (int i = 0; i < 9; ++i)
        rotations[i] = i % 4 == 0;
}

static void mass_properties(double t, const double *x, const double *constants, const double *r, double *masses,
                            double *inertias)
{
    (void)t, (void)x, (void)r;
    masses[0] = constants[MASS];
    memset(inertias, 0, 9 * sizeof(double));
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

static void state_rate_partials(double t, const double *x, const double *constants, const double *r, const double *a,
                                const double *multipliers, double *wrt_accelerations, double *wrt_multipliers)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers, (void)wrt_accelerations;
    (void)wrt_multipliers;
}

CALL(drawing, OF_STATE, results[0], results[1])
CALL(orientations, OF_STATE, results[0])
CALL(mass_properties, OF_STATE, results[0], results[1])
CALL(motion, OF_STATE, at->accelerations, results[0], results[1], results[2])
CALL(state_partials, OF_SOLUTION, results[0], results[1])
CALL(parameter_partials, OF_SOLUTION, results[0], results[1])
CALL(input_partials, OF_SOLUTION, results[0], results[1])
CALL(default_input_partials, at->t, at->constants, results[0])
CALL(constraint_partials, OF_STATE, results[0], results[1], results[2])
CALL(state_rate_partials, OF_SOLUTION, results[0], results[1])
CALL(output_state_partials, OF_SOLUTION, results[0])
CALL(output_parameter_partials, OF_SOLUTION, results[0])
CALL(output_input_partials, OF_SOLUTION, results[0])
CALL(output_solution_partials, OF_SOLUTION, results[0], results[1])

#define PARTIALS_ROW(name, n)                                                                                          \
    ROW(name, SOLVED, MATRIX(coordinate_rate_jacobian, N_Q, n), MATRIX(residual_jacobian, N_U + N_C, n))

const fb_part pendulum_derivatives = {
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_part),
    .functions =
        {
            [FB_DRAWING] = ROW(drawing, STATE, MATRIX(points, N_POINTS, 3), MATRIX(forces, N_FORCES, 3)),
            [FB_ORIENTATIONS] = ROW(orientations, STATE, MATRIX(orientations, 1, 9)),
            [FB_MASS_PROPERTIES] = ROW(mass_properties, STATE, VECTOR(masses, 1), MATRIX(inertias, 1, 9)),
            [FB_MOTION] = ROW(motion, STATE | FB_NEEDS_ACCELERATIONS, VECTOR(coordinate_accelerations, N_Q),
                              MATRIX(point_velocities, N_POINTS, 3), MATRIX(point_accelerations, N_POINTS, 3)),
            [FB_STATE_PARTIALS] = PARTIALS_ROW(state_partials, N_X),
            [FB_PARAMETER_PARTIALS] = PARTIALS_ROW(parameter_partials, N_P),
            [FB_INPUT_PARTIALS] = PARTIALS_ROW(input_partials, N_R),
            [FB_DEFAULT_INPUT_PARTIALS] = ROW(default_input_partials, 0, MATRIX(default_input_jacobian, N_R, N_P)),
            [FB_CONSTRAINT_PARTIALS] =
                ROW(constraint_partials, STATE, MATRIX(velocity_jacobian, N_C, N_Q),
                    MATRIX(position_input_jacobian, N_H, N_R), MATRIX(velocity_input_jacobian, N_C, N_R)),
            [FB_STATE_RATE_PARTIALS] =
                ROW(state_rate_partials, SOLVED, MATRIX(wrt_accelerations, 0, N_U), MATRIX(wrt_multipliers, 0, N_C)),
            [FB_OUTPUT_STATE_PARTIALS] = ROW(output_state_partials, SOLVED, MATRIX(output_jacobian, N_O, N_X)),
            [FB_OUTPUT_PARAMETER_PARTIALS] =
                ROW(output_parameter_partials, SOLVED, MATRIX(output_parameter_jacobian, N_O, N_P)),
            [FB_OUTPUT_INPUT_PARTIALS] = ROW(output_input_partials, SOLVED, MATRIX(output_input_jacobian, N_O, N_R)),
            [FB_OUTPUT_SOLUTION_PARTIALS] = ROW(output_solution_partials, SOLVED, MATRIX(wrt_accelerations, N_O, N_U),
                                                MATRIX(wrt_multipliers, N_O, N_C)),
        },
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

static void residual_jvp(double t, const double *x, const double *constants, const double *r, const double *a,
                         const double *multipliers, int n, const double *directions, double *of_rates,
                         double *of_residual)
{
    double rows[N_ROWS][N_ALL];
    (void)t, (void)r;
    slopes(x, constants, a, multipliers, rows);
    along(rows, N_Q, n, directions, of_rates);
    along(rows + N_Q, N_U + N_C, n, directions, of_residual);
}

static void constraint_jvp(double t, const double *x, const double *constants, const double *r, int n,
                           const double *directions, double *of_positions, double *of_velocities)
{
    double rows[2 * N_C][N_ALL];
    (void)t, (void)r;
    violation_slopes(x, constants, rows);
    along(rows, N_C, n, directions, of_positions);
    along(rows + N_C, N_C, n, directions, of_velocities);
}

static void residual_vjp(double t, const double *x, const double *constants, const double *r, const double *a,
                         const double *multipliers, const double *weights, double *gradient)
{
    double rows[N_ROWS][N_ALL];
    (void)t, (void)r;
    slopes(x, constants, a, multipliers, rows);
    back(rows, N_ROWS, weights, gradient);
}

static void constraint_vjp(double t, const double *x, const double *constants, const double *r, const double *weights,
                           double *gradient)
{
    double rows[2 * N_C][N_ALL];
    (void)t, (void)r;
    violation_slopes(x, constants, rows);
    back(rows, 2 * N_C, weights, gradient);
}

CALL(residual_jvp, OF_SOLUTION, at->n_directions, arguments[0], results[0], results[1])
CALL(constraint_jvp, OF_STATE, at->n_directions, arguments[0], results[0], results[1])
CALL(residual_vjp, OF_SOLUTION, arguments[0], results[0])
CALL(constraint_vjp, OF_STATE, arguments[0], results[0])

const fb_part pendulum_products = {
    .abi_version = FB_ABI_VERSION,
    .struct_size = sizeof(fb_part),
    .functions =
        {
            [FB_RESIDUAL_JVP] =
                ROW_OF(MATRIX(directions, N_ALL, FB_DIRECTIONS), residual_jvp, SOLVED,
                       MATRIX(coordinate_rates, N_Q, FB_DIRECTIONS), MATRIX(residual, N_U + N_C, FB_DIRECTIONS)),
            [FB_CONSTRAINT_JVP] = ROW_OF(MATRIX(directions, N_ALL, FB_DIRECTIONS), constraint_jvp, STATE,
                                         MATRIX(positions, N_C, FB_DIRECTIONS), MATRIX(velocities, N_C, FB_DIRECTIONS)),
            [FB_RESIDUAL_VJP] = ROW_OF(VECTOR(weights, N_ROWS), residual_vjp, SOLVED, VECTOR(gradient, N_ALL)),
            [FB_CONSTRAINT_VJP] = ROW_OF(VECTOR(weights, 2 * N_C), constraint_vjp, STATE, VECTOR(gradient, N_ALL)),
        },
};
#endif
