/* The equations of motion as a differential-algebraic system F(t, y, y') = 0, and its Jacobian, for implicit solvers.
 *
 * y = [x; lambda; mu]. Each formulation has M u' = f + J^T lambda, the equations for z', and
 *
 *   index 1                        q' = K u + k                J u' + gamma = 0
 *   index 2, Gear-Gupta-Leimkuhler q' = K (u + D J^T mu) + k   J u + b = 0, Phi = 0
 *   index 3                        q' = K u + k                Phi = 0, and J u + b = 0 in nonholonomic rows
 *
 * mu belongs to the rows that keep positions, and vanishes along the solution. It prevents the drift of positions that
 * remains if only the speeds satisfy their constraints. The diagonal matrix D has the squares of the speeds' absolute
 * tolerances, relative to the largest one, so that corrections are distributed according to the tolerances; it is the
 * identity if they are equal. Invariants, such as norms of quaternions, add Phi_q^T mu to q' in index 2, and are not
 * corrected in index 3.
 *
 * Unknown forces n that drive the motion follow lambda, with the rows of the auxiliary speeds; see
 * kernel/unknown_forces.h.
 *
 * Source: C. W. Gear, B. Leimkuhler, G. K. Gupta, "Automatic integration of Euler-Lagrange equations with constraints",
 * Journal of Computational and Applied Mathematics 12-13 (1985).
 */
#ifndef FOURBAR_IMPLICIT_RESIDUAL_H
#define FOURBAR_IMPLICIT_RESIDUAL_H

#include "../kernel/problem.h"

enum FB_FORMULATION { FB_INDEX_1 = 1, FB_INDEX_2 = 2, FB_INDEX_3 = 3 };

/* Unknown forces n at a state, with what they depend on. */
typedef struct fb_forces_at {
    double *effect, *effect_jacobian;                       /* F, dF/dn */
    double *auxiliary_forcing, *auxiliary_forcing_jacobian; /* Q, dQ/dn */
    double *auxiliary_mass, *auxiliary_constraint_jacobian; /* M_a, J_a^T */
} fb_forces_at;

typedef struct fb_implicit {
    fb_problem *problem;
    int formulation; /* an FB_FORMULATION */
    int n_y;
    double *coordinate_rates, *mass_matrix, *forcing, *jacobian, *bias; /* q', M, f, J, gamma */
    double *positions, *position_jacobian;                              /* Phi, dPhi/dq */
    double *velocities, *velocity_jacobian;                             /* J u + b, its derivative with respect to q */
    double *rate_jacobian, *residual_jacobian;                          /* from FB_STATE_PARTIALS */
    double *state_rates, *wrt_accelerations, *wrt_multipliers;          /* z', dz'/du', dz'/dlambda */
    fb_forces_at forces;
    double *change, *coordinate_change, *unused;
    double *row;    /* the factor of each equation */
    double *metric; /* the diagonal of D */
} fb_implicit;

/* Places the arrays in memory, unless that is NULL; returns their number of doubles. */
static inline size_t fb_place_implicit(fb_problem *problem, const int formulation, fb_implicit *s, double *memory)
{
    const fb_kernel *const k = problem->kernel;
    const int q = k->n_q, u = k->n_u, z = k->n_z, c = k->n_c, l = k->n_l, h = k->n_h, x = k->n_x;
    const int n = l - c;
    const fb_place places[] = {
        {&s->coordinate_rates, q},
        {&s->mass_matrix, u * u},
        {&s->forcing, u},
        {&s->jacobian, u * c},
        {&s->bias, c},
        {&s->positions, h},
        {&s->position_jacobian, h * q},
        {&s->velocities, c},
        {&s->velocity_jacobian, c * q},
        {&s->rate_jacobian, q * x},
        {&s->residual_jacobian, (u + l + z) * x},
        {&s->state_rates, z},
        {&s->wrt_accelerations, z * u},
        {&s->wrt_multipliers, z * l},
        {&s->forces.effect, u},
        {&s->forces.effect_jacobian, u * n},
        {&s->forces.auxiliary_forcing, n},
        {&s->forces.auxiliary_forcing_jacobian, n * n},
        {&s->forces.auxiliary_mass, n * u},
        {&s->forces.auxiliary_constraint_jacobian, n * c},
        {&s->change, u},
        {&s->coordinate_change, q},
        {&s->unused, (h + c) * k->n_r},
        {&s->row, x + l + h},
        {&s->metric, u},
    };
    s->problem = problem;
    s->formulation = formulation;
    s->n_y = x + l + (formulation == FB_INDEX_2 ? h : 0);
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

static inline int fb_implicit_equations(fb_implicit *s, const double t, const double *y)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    const int called = fb_fill_inputs(p, t, y);
    if (called < 0)
        return called;
    k->dynamics(t, y, p->constants, p->inputs, s->coordinate_rates, s->mass_matrix, s->forcing, s->jacobian, s->bias);
    const double *const forces[] = {y + k->n_x + k->n_c};
    double *const of_forces[] = {s->forces.effect,
                                 s->forces.effect_jacobian,
                                 s->forces.auxiliary_forcing,
                                 s->forces.auxiliary_forcing_jacobian,
                                 s->forces.auxiliary_mass,
                                 s->forces.auxiliary_constraint_jacobian};
    if (k->n_l > k->n_c)
        fb_problem_results(p, FB_UNKNOWN_FORCES, t, y, NULL, NULL, forces, of_forces);
    if (s->formulation != FB_INDEX_1)
        k->position(t, y, p->constants, p->inputs, s->positions, s->position_jacobian);
    return 0;
}

/* J v of one row. */
static inline double fb_row_times(const fb_implicit *s, const int row, const double *v)
{
    const int n = s->problem->kernel->n_u;
    double sum = 0.0;
    for (int i = 0; i < n; ++i)
        sum += s->jacobian[row * n + i] * v[i];
    return sum;
}

static inline int fb_implicit_form(fb_implicit *s, const double t, const double *restrict y,
                                   const double *restrict y_rate, double *restrict residual)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    const int n_q = k->n_q, n_u = k->n_u, n_z = k->n_z, n_x = k->n_x, n_c = k->n_c, n_l = k->n_l, n_h = k->n_h;
    const double *const lambda = y + n_x, *const mu = lambda + n_l;
    const int called = fb_implicit_equations(s, t, y);
    if (called < 0)
        return called;
    for (int i = 0; i < n_q; ++i)
        residual[i] = y_rate[i] - s->coordinate_rates[i];
    if (s->formulation == FB_INDEX_2) {
        memset(s->change, 0, (size_t)n_u * sizeof(double));
        for (int i = 0; i < n_h; ++i)
            for (int j = 0; j < n_u && k->position_row[i] >= 0; ++j)
                s->change[j] += s->metric[j] * s->jacobian[k->position_row[i] * n_u + j] * mu[i];
        k->coordinate_change(t, y, p->constants, p->inputs, s->change, s->coordinate_change);
        for (int i = 0; i < n_h; ++i)
            for (int j = 0; j < n_q && k->position_row[i] < 0; ++j)
                s->coordinate_change[j] += s->position_jacobian[i * n_q + j] * mu[i];
        for (int i = 0; i < n_q; ++i)
            residual[i] -= s->coordinate_change[i];
    }
    for (int i = 0; i < n_u; ++i) {
        double sum = -(s->forcing[i] + (n_l > n_c ? s->forces.effect[i] : 0.0));
        for (int j = 0; j < n_u; ++j)
            sum += s->mass_matrix[i * n_u + j] * y_rate[n_q + j];
        for (int row = 0; row < n_c; ++row)
            sum -= s->jacobian[row * n_u + i] * lambda[row];
        residual[n_q + i] = sum;
    }
    if (n_z > 0)
        fb_problem_results(p, FB_STATE_RATES, t, y, y_rate + n_q, lambda, NULL, &s->state_rates);
    for (int i = n_x - n_z; i < n_x; ++i)
        residual[i] = y_rate[i] - s->state_rates[i - (n_x - n_z)];
    for (int row = 0; row < n_l - n_c; ++row) {
        double sum = s->forces.auxiliary_forcing[row];
        for (int j = 0; j < n_u; ++j)
            sum -= s->forces.auxiliary_mass[row * n_u + j] * y_rate[n_q + j];
        for (int j = 0; j < n_c; ++j)
            sum += s->forces.auxiliary_constraint_jacobian[row * n_c + j] * lambda[j];
        residual[n_x + n_c + row] = sum;
    }
    if (s->formulation == FB_INDEX_1) {
        for (int row = 0; row < n_c; ++row)
            residual[n_x + row] = s->bias[row] + fb_row_times(s, row, y_rate + n_q);
        return 0;
    }
    k->velocity(t, y, p->constants, p->inputs, s->jacobian, s->velocities); /* J again, and b */
    for (int row = 0; row < n_c; ++row)
        residual[n_x + row] = s->velocities[row] + fb_row_times(s, row, y + n_q);
    for (int i = 0; i < n_h; ++i)
        if (s->formulation == FB_INDEX_2)
            residual[n_x + n_l + i] = s->positions[i];
        else if (k->position_row[i] >= 0)
            residual[n_x + k->position_row[i]] = s->positions[i];
    return 0;
}

/* F(t, y, y'); a negative status comes from the callback of inputs. */
static inline int fb_implicit_residual(fb_implicit *s, const double since, const double *restrict y,
                                       const double *restrict y_rate, double *restrict residual)
{
    const double t = fb_time(&s->problem->clock, since);
    const int called = fb_implicit_form(s, t, y, y_rate, residual);
    for (int i = 0; i < s->n_y && called == 0; ++i)
        residual[i] *= s->row[i];
    if (called == 0)
        fb_note_failure(s->problem, all_finite(residual, s->n_y), t, y);
    return called;
}

/* Adds c dF/dy' to a matrix, after `fb_implicit_derivative` at the same state. */
static inline void fb_implicit_add_rates(const fb_implicit *s, const double c, double *restrict matrix)
{
    const fb_kernel *const k = s->problem->kernel;
    const int n_q = k->n_q, n_u = k->n_u, n_z = k->n_z, n_x = k->n_x, n_c = k->n_c, n = s->n_y;
    for (int i = 0; i < n_q; ++i)
        matrix[i * n + i] += c;
    for (int i = 0; i < n_u; ++i)
        for (int j = 0; j < n_u; ++j)
            matrix[(n_q + i) * n + n_q + j] += c * s->mass_matrix[i * n_u + j];
    for (int i = 0; i < k->n_l - n_c; ++i)
        for (int j = 0; j < n_u; ++j)
            matrix[(n_x + n_c + i) * n + n_q + j] -= c * s->forces.auxiliary_mass[i * n_u + j];
    for (int i = 0; i < n_z; ++i) {
        double *const row = matrix + (n_x - n_z + i) * n;
        row[n_x - n_z + i] += c;
        for (int j = 0; j < n_u; ++j)
            row[n_q + j] -= c * s->wrt_accelerations[i * n_u + j];
    }
    for (int i = 0; i < n_c && s->formulation == FB_INDEX_1; ++i)
        for (int j = 0; j < n_u; ++j)
            matrix[(n_x + i) * n + n_q + j] += c * s->jacobian[i * n_u + j];
}

/* dF/dy, row by row, (n_y, n_y), without the derivative of J^T mu with respect to q, since mu vanishes. */
static inline int fb_implicit_derivative(fb_implicit *s, const double t, const double *restrict y,
                                         const double *restrict y_rate, double *restrict matrix)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    const int n_q = k->n_q, n_u = k->n_u, n_z = k->n_z, n_x = k->n_x, n_c = k->n_c, n_l = k->n_l, n_h = k->n_h;
    const int n_n = n_l - n_c, n = s->n_y;
    const int called = fb_implicit_equations(s, t, y);
    if (called < 0)
        return called;
    double *const partials[] = {s->rate_jacobian, s->residual_jacobian};
    fb_problem_results(p, FB_STATE_PARTIALS, t, y, y_rate + n_q, y + n_x, NULL, partials);
    memset(matrix, 0, (size_t)(n * n) * sizeof *matrix);
    for (int i = 0; i < n_q; ++i)
        for (int j = 0; j < n_x; ++j)
            matrix[i * n + j] = -s->rate_jacobian[i * n_x + j];
    for (int i = 0; i < n_u; ++i) {
        double *const row = matrix + (n_q + i) * n;
        for (int j = 0; j < n_x; ++j)
            row[j] = -s->residual_jacobian[i * n_x + j];
        for (int j = 0; j < n_c; ++j)
            row[n_x + j] = -s->jacobian[j * n_u + i];
        for (int j = 0; j < n_n; ++j)
            row[n_x + n_c + j] = -s->forces.effect_jacobian[i * n_n + j];
    }
    for (int i = 0; i < n_n; ++i) {
        double *const row = matrix + (n_x + n_c + i) * n;
        memcpy(row, s->residual_jacobian + (n_u + n_c + i) * n_x, (size_t)n_x * sizeof *row);
        memcpy(row + n_x, s->forces.auxiliary_constraint_jacobian + i * n_c, (size_t)n_c * sizeof *row);
        memcpy(row + n_x + n_c, s->forces.auxiliary_forcing_jacobian + i * n_n, (size_t)n_n * sizeof *row);
    }
    double *const of_state_rates[] = {s->wrt_accelerations, s->wrt_multipliers};
    if (n_z > 0)
        fb_problem_results(p, FB_STATE_RATE_PARTIALS, t, y, y_rate + n_q, y + n_x, NULL, of_state_rates);
    for (int i = 0; i < n_z; ++i) {
        double *const row = matrix + (n_x - n_z + i) * n;
        for (int j = 0; j < n_x; ++j)
            row[j] = -s->residual_jacobian[(n_u + n_l + i) * n_x + j];
        for (int j = 0; j < n_l; ++j)
            row[n_x + j] = -s->wrt_multipliers[i * n_l + j];
    }
    if (s->formulation == FB_INDEX_1) {
        for (int i = 0; i < n_c; ++i) {
            double *const row = matrix + (n_x + i) * n;
            for (int j = 0; j < n_x; ++j)
                row[j] = -s->residual_jacobian[(n_u + i) * n_x + j];
        }
        return 0;
    }
    double *const of_constraints[] = {s->velocity_jacobian, s->unused, s->unused + n_h * k->n_r};
    fb_problem_results(p, FB_CONSTRAINT_PARTIALS, t, y, NULL, NULL, NULL, of_constraints);
    for (int i = 0; i < n_c; ++i) {
        double *const row = matrix + (n_x + i) * n;
        memcpy(row, s->velocity_jacobian + i * n_q, (size_t)n_q * sizeof *row);
        memcpy(row + n_q, s->jacobian + i * n_u, (size_t)n_u * sizeof *row);
    }
    for (int i = 0; i < n_h; ++i) {
        const int kept_by = k->position_row[i];
        const double *const slopes = s->position_jacobian + i * n_q;
        if (s->formulation == FB_INDEX_2) {
            memcpy(matrix + (n_x + n_l + i) * n, slopes, (size_t)n_q * sizeof *matrix);
            for (int j = 0; j < n_u && kept_by >= 0; ++j)
                s->change[j] = s->metric[j] * s->jacobian[kept_by * n_u + j];
            k->coordinate_change(t, y, p->constants, p->inputs, s->change, s->coordinate_change);
            for (int j = 0; j < n_q; ++j)
                matrix[j * n + n_x + n_l + i] = kept_by >= 0 ? -s->coordinate_change[j] : -slopes[j];
        } else if (kept_by >= 0) {
            double *const row = matrix + (n_x + kept_by) * n;
            memset(row, 0, (size_t)n_x * sizeof *row);
            memcpy(row, slopes, (size_t)n_q * sizeof *row);
        }
    }
    return 0;
}

static inline int fb_implicit_jacobian(fb_implicit *s, const double since, const double c, const double *restrict y,
                                       const double *restrict y_rate, double *restrict matrix)
{
    const int called = fb_implicit_derivative(s, fb_time(&s->problem->clock, since), y, y_rate, matrix);
    if (called == 0)
        fb_implicit_add_rates(s, c, matrix);
    for (int i = 0; i < s->n_y && called == 0; ++i)
        for (int j = 0; j < s->n_y; ++j)
            matrix[i * s->n_y + j] *= s->row[i];
    return called;
}

/* Takes the diagonal of D, and scales each equation so that its largest derivative with respect to the states, in units
 * of their weights, is 1. Then pivoting does not depend on the units, from micrometres to kilometres. */
static inline int fb_implicit_scale(fb_implicit *s, const double since, const double c, const double *restrict y,
                                    const double *restrict y_rate, const double *restrict weights,
                                    const double *restrict metric, double *restrict matrix)
{
    const int n_u = s->problem->kernel->n_u, n_x = s->problem->kernel->n_x;
    const double t = fb_time(&s->problem->clock, since);
    for (int j = 0; j < n_u; ++j)
        s->metric[j] = metric[j];
    const int called = fb_implicit_derivative(s, t, y, y_rate, matrix);
    if (called == 0)
        fb_implicit_add_rates(s, c, matrix);
    for (int i = 0; i < s->n_y; ++i) {
        double size = 0.0;
        for (int j = 0; j < n_x && called == 0; ++j)
            size = fmax(size, fabs(matrix[i * s->n_y + j]) * weights[j]);
        s->row[i] = size > 0.0 && isfinite(size) ? 1.0 / size : 1.0;
    }
    return called;
}

#endif
