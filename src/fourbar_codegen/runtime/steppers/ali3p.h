/* Fixed steps that pass singular positions: the index-3 augmented Lagrangian formulation, with mass-orthogonal
 * projections of positions, velocities and accelerations.
 *
 * The trapezoidal rule turns M u' = f + J^T lambda into an equation for the speeds at the step's end; positions and
 * accelerations there are functions of these. It is solved by Newton's method, with lambda = lambda* - alpha g for each
 * constraint g = 0. Since alpha J^T J is added to a positive definite matrix, J need not have full rank, and redundant
 * constraints are allowed. lambda* is updated to lambda in each iteration, so that g vanishes without a large penalty
 * alpha. Then positions, speeds and accelerations are projected onto their constraints, orthogonally in the metric of
 * M. lambda* starts as the minimum-norm multipliers with the same effect, since components in the null space of J^T
 * would grow without bound at a singular position.
 *
 * Auxiliary states follow the trapezoidal rule too, and are unknowns of Newton's method beside the speeds.
 * Accelerations and multipliers in their equations are those of the state, not those of the rule.
 *
 * Rows of J that keep positions are scaled to similar size if they differ much: a common penalty would be negligible
 * for small rows, or too large for large ones. Multipliers are those of the scaled rows.
 *
 * The mass matrix must be positive definite without the constraints.
 *
 * Source: E. Bayo, R. Ledesma, "Augmented Lagrangian and mass-orthogonal projection methods for constrained multibody
 * dynamics", Nonlinear Dynamics 9 (1996); J. Cuadrado, J. Cardenal, E. Bayo, "Modeling and solution methods for
 * efficient real-time simulation of multibody dynamics", Multibody System Dynamics 1 (1997).
 */
#ifndef FOURBAR_ALI3P_H
#define FOURBAR_ALI3P_H

#include "../linear_algebra/elimination.h"
#include "step_control.h"
#include "stepper.h"

/* The penalty of constraints in units of the mass matrix, for Newton's method and for projections. */
#define FB_PENALTY 1e6
#define FB_PROJECTION_PENALTY 1e10
/* Newton's method has converged if speeds change by at most the first fraction, and has failed above the second.
 * Changes below the third are ignored: rounding errors of the positions, as speeds over a step. */
#define FB_CONVERGED 1e-9
#define FB_DIVERGED 1e-6
#define FB_ROUNDING 1e-14
/* Steps are halved down to this fraction of max_step. */
#define FB_MIN_STEP 1e-3
/* A remainder below this fraction of a step is not worth a step of its own. */
#define FB_SAME_TIME 1e-3
/* A projection must not change positions or speeds by more than this fraction of the step's change, or of its rounding
 * errors. */
#define FB_CORRECTION 0.1
/* Relative to the trace of J J^T: multipliers for singular values below its square root are left out. */
#define FB_SHORTEST 1e-10

/* Rows are scaled if they are this many times smaller than the largest. */
#define FB_UNLIKE 100.0

enum { FB_MAX_ITERATIONS = 12, FB_MAX_PROJECTIONS = 20, FB_REFINEMENTS = 3 };

typedef struct fb_augmented {
    double *mass_matrix, *forcing, *jacobian, *bias; /* M, f, J, gamma */
    double *positions, *velocities;                  /* position violations in the rows of J, (n_c + n_i,), J u + b */
    double *scales;                                  /* scales of position violations, (n_c + n_i,), and of others */
    double *multipliers, *multipliers_old;           /* lambda*, and that of the step's beginning, (n_c,) */
    double *penalized;                               /* lambda* - alpha g, (n_c,) */
    double *matrix, *normal;                         /* (n_u + n_z, n_u + n_z), (n_c, n_c) */
    double *change, *unit;                           /* (n_u + n_z,), (n_u,) */
    double *coordinate_change, *correction;          /* (n_q,) */
    double *rate_jacobian, *residual_jacobian;       /* (n_q, n_x), (n_u + n_l + n_z, n_x) */
    double *kept;                                    /* multipliers, (n_c,) */
    double *accelerations;                           /* those of a state, (n_u,) */
    double *row_unit, *lambda;                       /* factors of rows, and the kernel's multipliers, (n_c,) */
    int64_t n_jacobians, n_factorizations;
} fb_augmented;

/* Places the arrays in memory, unless that is NULL; returns their number of doubles. */
static inline size_t fb_place_augmented(const fb_kernel *k, fb_augmented *a, double *memory)
{
    const int q = k->n_q, u = k->n_u, z = k->n_z, c = k->n_c, i = k->n_i, x = k->n_x;
    const fb_place places[] = {
        {&a->mass_matrix, u * u},
        {&a->forcing, u},
        {&a->jacobian, u * c},
        {&a->bias, c},
        {&a->positions, c + i},
        {&a->velocities, c},
        {&a->multipliers, c},
        {&a->multipliers_old, c},
        {&a->penalized, c},
        {&a->matrix, (u + z) * (u + z)},
        {&a->normal, c * c},
        {&a->change, u + z},
        {&a->unit, u},
        {&a->coordinate_change, q},
        {&a->correction, q},
        {&a->rate_jacobian, q * x},
        {&a->residual_jacobian, (u + k->n_l + z) * x},
        {&a->kept, c},
        {&a->accelerations, u},
        {&a->row_unit, c},
        {&a->lambda, c},
        {&a->scales, c + i + c + k->n_h},
    };
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

/* The penalty for which J^T J has `weight` times the size of M. */
static inline double fb_penalty(const fb_kernel *k, const fb_augmented *a, const double weight)
{
    double mass = 0.0, jacobian = 0.0;
    for (int i = 0; i < k->n_u; ++i)
        mass += a->mass_matrix[i * k->n_u + i];
    for (int i = 0; i < k->n_c * k->n_u; ++i)
        jacobian += a->jacobian[i] * a->jacobian[i];
    return jacobian > 0.0 ? weight * mass / jacobian : 0.0;
}

/* Copies M to the upper left of a matrix with n columns. */
static inline void fb_take_mass(const fb_kernel *k, const fb_augmented *a, const int n, double *restrict matrix)
{
    for (int i = 0; i < k->n_u; ++i)
        memcpy(matrix + i * n, a->mass_matrix + i * k->n_u, (size_t)k->n_u * sizeof(double));
}

/* Adds penalty J^T J there. */
static inline void fb_penalize(const fb_kernel *k, const fb_augmented *a, const double penalty, const int n,
                               double *restrict matrix)
{
    for (int row = 0; row < k->n_c; ++row) {
        const double *const j = a->jacobian + row * k->n_u;
        for (int i = 0; i < k->n_u; ++i)
            for (int l = 0; l < k->n_u; ++l)
                matrix[i * n + l] += penalty * j[i] * j[l];
    }
}

/* Solves matrix x = b for n unknowns; 0 if the matrix is singular. */
static inline int fb_solve_matrix(fb_augmented *a, const int n, double *b)
{
    a->n_factorizations += 1;
    return fb_eliminate_full(n, a->matrix, b, 0.0);
}

/* Mass-orthogonal correction: `change` with J change = -violation, as far as possible, and minimum norm in the metric
 * of M. */
static inline int fb_least_change(const fb_kernel *k, fb_augmented *a, const double *restrict violation)
{
    const double penalty = fb_penalty(k, a, FB_PROJECTION_PENALTY);
    fb_take_mass(k, a, k->n_u, a->matrix);
    fb_penalize(k, a, penalty, k->n_u, a->matrix);
    for (int i = 0; i < k->n_u; ++i) {
        a->change[i] = 0.0;
        for (int row = 0; row < k->n_c; ++row)
            a->change[i] -= penalty * a->jacobian[row * k->n_u + i] * violation[row];
    }
    return fb_solve_matrix(a, k->n_u, a->change);
}

/* M, f, J, gamma and violations at the state x; a negative status comes from the callback of inputs. */
static inline int fb_augmented_equations(fb_stepper *s, const double t, const double *x, double *coordinate_rates)
{
    fb_problem *const p = s->problem;
    fb_augmented *const a = s->own;
    const int called = fb_fill_inputs(p, t, x);
    if (called < 0)
        return called;
    p->kernel->dynamics(t, x, p->constants, p->inputs, coordinate_rates, a->mass_matrix, a->forcing, a->jacobian,
                        a->bias);
    p->kernel->constraint_violation(t, x, p->constants, p->inputs, a->positions, a->velocities);
    for (int row = 0; row < p->kernel->n_c; ++row) {
        for (int i = 0; i < p->kernel->n_u; ++i)
            a->jacobian[row * p->kernel->n_u + i] *= a->row_unit[row];
        a->bias[row] *= a->row_unit[row];
        a->positions[row] *= a->row_unit[row];
        a->velocities[row] *= a->row_unit[row];
    }
    s->n_evaluations += 1;
    fb_note_failure(p, fb_finite(a->forcing, p->kernel->n_u) ? FB_OK : FB_NOT_FINITE, t, x);
    return 0;
}

/* The multipliers of the kernel's own rows. */
static inline const double *fb_kernels_multipliers(const fb_kernel *k, fb_augmented *a, const double *multipliers)
{
    for (int row = 0; row < k->n_c; ++row)
        a->lambda[row] = a->row_unit[row] * multipliers[row];
    return a->lambda;
}

/* The violation of J u' + gamma = 0 by accelerations, stored in `positions`. */
static inline void fb_acceleration_violation(const fb_kernel *k, fb_augmented *a, const double *accelerations)
{
    for (int row = 0; row < k->n_c; ++row) {
        a->positions[row] = a->bias[row];
        for (int i = 0; i < k->n_u; ++i)
            a->positions[row] += a->jacobian[row * k->n_u + i] * accelerations[i];
    }
}

/* lambda* as the minimum-norm multipliers with J^T lambda = M u' - f, from their normal equations. */
static inline void fb_shortest_multipliers(const fb_kernel *k, fb_augmented *a, const double *accelerations)
{
    const int n_u = k->n_u, n_c = k->n_c;
    double trace = 0.0;
    for (int i = 0; i < n_u; ++i) {
        a->unit[i] = -a->forcing[i];
        for (int j = 0; j < n_u; ++j)
            a->unit[i] += a->mass_matrix[i * n_u + j] * accelerations[j];
    }
    for (int row = 0; row < n_c; ++row) {
        a->multipliers[row] = 0.0;
        for (int i = 0; i < n_u; ++i)
            a->multipliers[row] += a->jacobian[row * n_u + i] * a->unit[i];
        for (int other = 0; other < n_c; ++other) {
            a->normal[row * n_c + other] = 0.0;
            for (int i = 0; i < n_u; ++i)
                a->normal[row * n_c + other] += a->jacobian[row * n_u + i] * a->jacobian[other * n_u + i];
        }
        trace += a->normal[row * n_c + row];
    }
    for (int row = 0; row < n_c; ++row)
        a->normal[row * n_c + row] += FB_SHORTEST * trace;
    if (!fb_eliminate_full(n_c, a->normal, a->multipliers, 0.0))
        memset(a->multipliers, 0, (size_t)n_c * sizeof(double));
}

/* Accelerations projected onto J u' + gamma = 0, and their multipliers. */
static inline int fb_project_accelerations(fb_stepper *s, double *restrict accelerations)
{
    const fb_kernel *const k = s->problem->kernel;
    fb_augmented *const a = s->own;
    for (int i = 0; i < FB_REFINEMENTS && k->n_c > 0; ++i) {
        fb_acceleration_violation(k, a, accelerations);
        if (!fb_least_change(k, a, a->positions))
            return FB_RUN_DIVERGED;
        for (int j = 0; j < k->n_u; ++j)
            accelerations[j] += a->change[j];
    }
    fb_shortest_multipliers(k, a, accelerations);
    return FB_RUN_PAUSED;
}

/* u' and lambda* of a state whose equations are known, projected onto the constraints from
 * M u' = f - alpha J^T (J u' + gamma). */
static inline int fb_augmented_solution(fb_stepper *s, double *restrict accelerations)
{
    const fb_kernel *const k = s->problem->kernel;
    fb_augmented *const a = s->own;
    const double penalty = fb_penalty(k, a, FB_PENALTY);
    fb_take_mass(k, a, k->n_u, a->matrix);
    fb_penalize(k, a, penalty, k->n_u, a->matrix);
    for (int i = 0; i < k->n_u; ++i) {
        accelerations[i] = a->forcing[i];
        for (int row = 0; row < k->n_c; ++row)
            accelerations[i] -= penalty * a->jacobian[row * k->n_u + i] * a->bias[row];
    }
    return fb_solve_matrix(a, k->n_u, accelerations) ? fb_project_accelerations(s, accelerations) : FB_RUN_DIVERGED;
}

/* z' for accelerations and the multipliers lambda*. */
static inline void fb_augmented_state_rates(fb_stepper *s, const double t, const double *x, const double *accelerations,
                                            double *restrict rates)
{
    const fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    fb_augmented *const a = s->own;
    double *const results[] = {rates + k->n_q + k->n_u};
    if (k->n_z > 0)
        fb_problem_results(p, FB_STATE_RATES, t, x, accelerations, fb_kernels_multipliers(k, a, a->multipliers), NULL,
                           results);
}

/* The size of a row of J, by its largest entry. */
static inline double fb_row_size(const fb_kernel *k, const fb_augmented *a, const int row)
{
    double size = 0.0;
    for (int i = 0; i < k->n_u; ++i)
        size = fb_max(size, fabs(a->jacobian[row * k->n_u + i]));
    return size;
}

/* Scales rows that keep positions to about the size of the largest, if both J and the scales of violations are smaller:
 * entries of J may vanish in a singular position, and terms in a plane of symmetry. Other rows are not scaled. Factors
 * are powers of two, which cause no rounding errors. */
static inline void fb_choose_row_units(fb_stepper *s, const double t, const double *x)
{
    const fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    fb_augmented *const a = s->own;
    const int n = k->n_c + k->n_i;
    double scale = 0.0, size = 0.0, *const scales[] = {a->scales + n + k->n_c, a->scales, a->scales + n};
    fb_problem_results(p, FB_CONSTRAINT_SCALE, t, x, NULL, NULL, NULL, scales);
    for (int row = 0; row < k->n_c; ++row)
        if (a->scales[row] > 0.0) {
            scale = fb_max(scale, a->scales[row]);
            size = fb_max(size, fb_row_size(k, a, row));
        }
    for (int row = 0; row < k->n_c; ++row) {
        const double by_size = size / fb_row_size(k, a, row), by_scale = scale / a->scales[row];
        const double share = by_size < by_scale ? by_size : by_scale;
        a->row_unit[row] = isfinite(share) && share > FB_UNLIKE ? exp2(round(log2(share))) : 1.0;
    }
}

/* x' at a state where a run begins, or goes on. */
static inline int fb_augmented_restart(fb_stepper *s, const double since, const double *x, double *rates)
{
    const fb_kernel *const k = s->problem->kernel;
    double *const accelerations = rates + k->n_q;
    fb_augmented *const a = s->own;
    const double t = fb_time(&s->problem->clock, since);
    for (int row = 0; row < k->n_c; ++row)
        a->row_unit[row] = 1.0;
    int called = fb_augmented_equations(s, t, x, rates);
    if (called < 0)
        return called;
    fb_choose_row_units(s, t, x);
    called = fb_augmented_equations(s, t, x, rates);
    if (called < 0)
        return called;
    if (fb_augmented_solution(s, accelerations) != FB_RUN_PAUSED)
        memset(accelerations, 0, (size_t)k->n_u * sizeof(double));
    fb_augmented_state_rates(s, t, x, accelerations, rates);
    return 0;
}

static inline int fb_augmented_init(fb_stepper *s, const double direction, const double interval, const double max_step,
                                    double *h_abs)
{
    (void)direction, (void)interval;
    *h_abs = max_step;
    return fb_augmented_restart(s, s->t, s->x, s->stages);
}

/* The matrix of Newton's method: half a step times the derivatives of M u' - f - J^T lambda with respect to the speeds
 * and the auxiliary states; and those of the rule's residual for the auxiliary states, with u' and lambda held. */
static inline void fb_newton_matrix(fb_stepper *s, const double t, const double h, const double penalty,
                                    const double *x, const double *accelerations)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    fb_augmented *const a = s->own;
    const int n_q = k->n_q, n_u = k->n_u, n_z = k->n_z, n_x = k->n_x, n = n_u + n_z;
    a->n_jacobians += 1;
    fb_take_mass(k, a, n, a->matrix);
    double *const partials[] = {a->rate_jacobian, a->residual_jacobian};
    fb_problem_results(p, FB_STATE_PARTIALS, t, x, accelerations, fb_kernels_multipliers(k, a, a->penalized), NULL,
                       partials);
    for (int j = 0; j < n_u; ++j) {
        memset(a->unit, 0, (size_t)n_u * sizeof(double));
        a->unit[j] = 1.0;
        k->coordinate_change(t, x, p->constants, p->inputs, a->unit, a->coordinate_change);
        for (int i = 0; i < n; ++i) {
            const double *const row = a->residual_jacobian + (i < n_u ? i : k->n_l + i) * n_x;
            double by_positions = 0.0;
            for (int l = 0; l < n_q; ++l)
                by_positions += row[l] * a->coordinate_change[l];
            const double change = 0.5 * h * (row[n_q + j] + 0.5 * h * by_positions);
            a->matrix[i * n + j] = (i < n_u ? a->matrix[i * n + j] : 0.0) - change;
        }
    }
    for (int j = n_u; j < n; ++j)
        for (int i = 0; i < n; ++i)
            a->matrix[i * n + j] =
                (i == j) - 0.5 * h * a->residual_jacobian[(i < n_u ? i : k->n_l + i) * n_x + n_q + j];
    fb_penalize(k, a, penalty, n, a->matrix);
}

/* Whether a row of J is the rate of a position constraint. */
static inline int fb_is_rate(const fb_kernel *k, const int row)
{
    for (int i = 0; i < k->n_h; ++i)
        if (k->position_row[i] == row)
            return 1;
    return 0;
}

/* Newton's method for speeds and auxiliary states at the step's end, in x with the positions, and accelerations in x'.
 */
static inline int fb_augmented_newton(fb_stepper *s, const double t, const double h, double *restrict x,
                                      double *restrict rates)
{
    const fb_kernel *const k = s->problem->kernel;
    fb_augmented *const a = s->own;
    const int n_q = k->n_q, n_u = k->n_u, n_x = k->n_x;
    const double *const x_old = s->x, *const f_old = s->stages;
    double penalty = 0.0, size = 0.0, changed = INFINITY, rounding = 0.0;
    double share = 0.0; /* relative change of auxiliary states */
    for (int i = 0; i < n_q; ++i)
        rounding = fb_max(rounding, FB_ROUNDING * fabs(x_old[i] / h));
    for (int i = 0; i < n_x; ++i)
        x[i] = x_old[i] + h * f_old[i];
    for (int iteration = 0;
         iteration < FB_MAX_ITERATIONS && !(changed <= FB_CONVERGED * size + rounding && share <= FB_CONVERGED);
         ++iteration) {
        const int called = fb_augmented_equations(s, t, x, rates);
        if (called < 0)
            return called;
        if (iteration == 0)
            penalty = fb_penalty(k, a, FB_PENALTY);
        size = 0.0;
        for (int i = 0; i < n_u; ++i) {
            rates[n_q + i] = 2.0 / h * (x[n_q + i] - x_old[n_q + i]) - f_old[n_q + i];
            size = fb_max(size, fb_max(fabs(x[n_q + i]), fabs(h * rates[n_q + i])));
        }
        for (int row = 0; row < k->n_c; ++row) {
            const double force =
                penalty * (fb_is_rate(k, row) ? 4.0 / (h * h) * a->positions[row] : 2.0 / h * a->velocities[row]);
            /* lambda <- lambda - penalty (4 Phi / h^2 or 2 (J u + b) / h): the penalty's force becomes part of the
             * multiplier, so that the next iteration does not need it. */
            a->multipliers[row] -= iteration > 0 ? force : 0.0;
            a->penalized[row] = a->multipliers[row] - force;
        }
        if (k->states_need_solution) {
            memcpy(a->kept, a->multipliers, (size_t)k->n_c * sizeof(double));
            if (fb_augmented_solution(s, a->accelerations) != FB_RUN_PAUSED)
                return FB_RUN_DIVERGED;
        }
        fb_augmented_state_rates(s, t, x, a->accelerations, rates);
        if (k->states_need_solution)
            memcpy(a->multipliers, a->kept, (size_t)k->n_c * sizeof(double));
        fb_newton_matrix(s, t, h, penalty, x, rates + n_q);
        for (int i = 0; i < n_u; ++i) {
            double residual = a->forcing[i];
            for (int j = 0; j < n_u; ++j)
                residual -= a->mass_matrix[i * n_u + j] * rates[n_q + j];
            for (int row = 0; row < k->n_c; ++row)
                residual += a->jacobian[row * n_u + i] * a->penalized[row];
            a->change[i] = 0.5 * h * residual;
        }
        for (int i = n_q + n_u; i < n_x; ++i)
            a->change[i - n_q] = x_old[i] - x[i] + 0.5 * h * (f_old[i] + rates[i]);
        if (!fb_solve_matrix(a, n_x - n_q, a->change))
            return FB_RUN_DIVERGED;
        k->coordinate_change(t, x, s->problem->constants, s->problem->inputs, a->change, a->coordinate_change);
        changed = 0.0;
        for (int i = 0; i < n_u; ++i) {
            x[n_q + i] += a->change[i];
            changed = fb_max(changed, fabs(a->change[i]));
        }
        share = 0.0;
        for (int i = n_q + n_u; i < n_x; ++i) {
            const double change = fabs(a->change[i - n_q]);
            x[i] += a->change[i - n_q];
            share = change > 0.0 ? fb_max(share, change / fb_max(fabs(x[i]), fabs(h * rates[i]))) : share;
        }
        /* By the rule, for the speeds of the last iteration, plus the effect of their change. */
        for (int i = 0; i < n_q; ++i) {
            const double ruled = x_old[i] + 0.5 * h * (f_old[i] + rates[i]);
            changed = fb_max(changed, fabs(ruled - x[i]) / fabs(h));
            x[i] = ruled + 0.5 * h * a->coordinate_change[i];
        }
    }
    for (int i = 0; i < n_u; ++i)
        rates[n_q + i] = 2.0 / h * (x[n_q + i] - x_old[n_q + i]) - f_old[n_q + i];
    return changed <= FB_DIVERGED * size + 1000.0 * rounding && share <= FB_DIVERGED ? FB_RUN_PAUSED : FB_RUN_DIVERGED;
}

/* Projects the state onto the constraints, positions first. */
static inline int fb_augmented_project(fb_stepper *s, const double t, double *restrict x,
                                       double *restrict coordinate_rates)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    fb_augmented *const a = s->own;
    for (int i = 0; i < FB_MAX_PROJECTIONS; ++i) {
        const int called = fb_augmented_equations(s, t, x, coordinate_rates);
        if (called < 0)
            return called;
        const int n = k->n_c + k->n_i;
        double *const scales[] = {a->scales + n + k->n_c, a->scales, a->scales + n};
        fb_problem_results(p, FB_CONSTRAINT_SCALE, t, x, NULL, NULL, NULL, scales);
        for (int row = 0; row < k->n_c; ++row)
            a->scales[row] *= a->row_unit[row];
        const double violation = fb_violation(a->positions, a->scales, n);
        if (violation != violation)
            return FB_RUN_DIVERGED;
        if (violation <= FB_CLOSURE_RTOL)
            break;
        if (!fb_least_change(k, a, a->positions))
            return FB_RUN_DIVERGED;
        k->coordinate_change(t, x, p->constants, p->inputs, a->change, a->coordinate_change);
        fb_problem_results(p, FB_INVARIANT_CORRECTION, t, x, NULL, NULL, NULL, &a->correction);
        for (int j = 0; j < k->n_q; ++j)
            x[j] += a->coordinate_change[j] + a->correction[j];
        if (i == FB_MAX_PROJECTIONS - 1 && !(violation <= FB_LOOSE_CLOSURE_RTOL))
            return FB_RUN_DIVERGED;
    }
    for (int i = 0; i < FB_REFINEMENTS && k->n_c > 0; ++i) {
        if (!fb_least_change(k, a, a->velocities))
            return FB_RUN_DIVERGED;
        for (int j = 0; j < k->n_u; ++j)
            x[k->n_q + j] += a->change[j];
        const int called = fb_augmented_equations(s, t, x, coordinate_rates);
        if (called < 0)
            return called;
    }
    return FB_RUN_PAUSED;
}

/* Whether projections have changed the step's result (`before` them) by little compared with the step. */
static inline int fb_is_correction(const fb_stepper *s, const double *before, const double h)
{
    double changed = 0.0, corrected = 0.0;
    const fb_kernel *const k = s->problem->kernel;
    for (int i = 0; i < k->n_q + k->n_u; ++i) {
        const double scale = i < k->n_q ? 1.0 : fabs(h);
        changed = fb_max(changed, scale * fabs(s->x_new[i] - s->x[i]));
        corrected = fb_max(corrected, scale * fabs(s->x_new[i] - before[i]));
    }
    return corrected <= FB_CORRECTION * changed;
}

/* A step from the last state to a time, in `x_new` and the last row of stages. */
static inline int fb_augmented_try(fb_stepper *s, const double t_new)
{
    double *const end = fb_end_rates(s);
    const double t = fb_time(&s->problem->clock, t_new);
    int status = fb_augmented_newton(s, t, t_new - s->t, s->x_new, end);
    memcpy(s->x_old, s->x_new, (size_t)s->n * sizeof(double)); /* free until the step is accepted */
    if (status == FB_RUN_PAUSED && s->project)
        status = fb_augmented_project(s, t, s->x_new, end);
    if (status == FB_RUN_PAUSED && !fb_is_correction(s, s->x_old, t_new - s->t))
        status = FB_RUN_DIVERGED;
    if (status == FB_RUN_PAUSED)
        status = fb_project_accelerations(s, end + s->problem->kernel->n_q);
    if (status == FB_RUN_PAUSED)
        fb_augmented_state_rates(s, t, s->x_new, end + s->problem->kernel->n_q, end);
    return status == FB_RUN_PAUSED && !(fb_finite(s->x_new, s->n) && fb_finite(end, s->n)) ? FB_RUN_DIVERGED : status;
}

/* There is no error estimate: a step is accepted if its equations could be solved. */
static inline int fb_augmented_attempt(fb_stepper *s, const double t_new, double *error)
{
    fb_augmented *const a = s->own;
    const size_t size = (size_t)s->problem->kernel->n_c * sizeof(double);
    if (!(fabs(t_new - s->t) >= fb_least_step(s->t, t_new - s->t)))
        return FB_RUN_TOO_SMALL;
    memcpy(a->multipliers_old, a->multipliers, size);
    const int status = fb_augmented_try(s, t_new);
    *error = status == FB_RUN_PAUSED ? 0.0 : NAN;
    if (status == FB_RUN_DIVERGED)
        memcpy(a->multipliers, a->multipliers_old, size);
    return status < 0 ? status : 0;
}

/* Half the length after a step that could not be solved; otherwise max_step, which is the limit. */
static inline double fb_augmented_length(const fb_stepper *s, const double h_abs, const double error,
                                         const int rejected)
{
    (void)s, (void)rejected;
    return error < 1.0 ? INFINITY : h_abs / 2;
}

static const fb_method fb_augmented_lagrangian = {.init = fb_augmented_init,
                                                  .attempt = fb_augmented_attempt,
                                                  .restart = fb_augmented_restart,
                                                  .next_length = fb_augmented_length,
                                                  .interpolate = fb_interpolate_step,
                                                  .projects = 1,
                                                  .least_share = FB_MIN_STEP,
                                                  .largest_share = FB_SAME_TIME};

#endif
