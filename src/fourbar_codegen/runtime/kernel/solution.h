/* u', multipliers and z' of a state: the equations of motion, set up by generated functions, solved in their form. */
#ifndef FOURBAR_SOLUTION_H
#define FOURBAR_SOLUTION_H

#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"
#include "../linear_algebra/equations.h"

#ifndef N_Z
#define N_Z 0
#endif
#ifndef N_N /* unknown forces that drive the motion */
#define N_N 0
#endif
enum {
    N_L = N_C + N_N,
    N_X = N_Q + N_U + N_Z,
    N_COLUMNS = N_X > N_P ? (N_X > N_R ? N_X : N_R) : (N_P > N_R ? N_P : N_R)
};

#include "singular_positions.h"
#if N_N > 0
#include "unknown_forces.h"
#endif

typedef struct fb_work {
    double coordinate_rates[FB_AT_LEAST_1(N_Q)];
    double mass_matrix[N_MASS];
    double forcing[N_U];
    double constraint_jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double acceleration_bias[FB_AT_LEAST_1(N_C)];
    fb_factors factors;
    double accelerations[N_U];
    double multipliers[FB_AT_LEAST_1(N_L)];
    double residual_jacobian[(N_U + N_L + N_Z) * N_COLUMNS];
#ifndef FB_LIBRARY
    double residual_tangent[(N_U + N_L + N_Z) * FB_DIRECTIONS], gradient[N_X + N_P + N_R];
#endif
#if N_Z > 0
    double state_rate_acceleration_jacobian[N_Z * N_U], state_rate_multiplier_jacobian[FB_AT_LEAST_1(N_Z * N_L)];
#endif
#if N_N > 0
    fb_response response;
#endif
    fb_pivot_history pivots; /* in all calls of `toggled` */
    double drift;            /* the relative constraint violation where the last projection took its factors */
} fb_work;

#ifndef FB_DENSE
/* M and J with all their entries. */
static void full_dynamics(double t, const double *x, const double *constants, const double *r, double *coordinate_rates,
                          double *mass_matrix, double *forcing, double *constraint_jacobian, double *acceleration_bias)
{
    double mass[N_MASS], jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    dynamics(t, x, constants, r, coordinate_rates, mass, forcing, jacobian, acceleration_bias);
    FB_FORM(fill)(constants, mass, jacobian, mass_matrix, constraint_jacobian);
}
#else
#define full_dynamics dynamics
#endif

/* The factors at a state. Constraints that are redundant only on the constraint manifold become independent where loops
 * are open, which is distinguished from constraints that always were. */
static inline int factor_at(double t, const double *x, const double *constants, const double *r, fb_work *restrict w)
{
#ifdef FB_RECURSIVE
    w->factors.constants = constants;
#endif
    const int status = FB_FORM(factor)(w->mass_matrix, w->constraint_jacobian, w->forcing, &w->factors);
#ifdef FB_DENSE
    if (N_RANK < N_C && status == FB_OK && w->factors.left > FB_REDUNDANCY_RTOL) {
        double positions[FB_AT_LEAST_1(N_H)], slopes[FB_AT_LEAST_1(N_H * N_Q)], scale[FB_AT_LEAST_1(N_H)];
        double unused[2][FB_AT_LEAST_1(N_C + N_I)];
        position(t, x, constants, r, positions, slopes);
        constraint_scale(t, x, constants, r, scale, unused[0], unused[1]);
        /* The effect of a violation on rows grows by the division by pivots. */
        const double inverse = N_RANK > 0 ? fabs(w->factors.inverse[FB_AT_LEAST_1(N_RANK) - 1]) : 1.0;
        if (!(w->factors.left <= FB_REDUNDANCY_RTOL + FB_OPEN_FACTOR * inverse * fb_violation(positions, scale, N_H)))
            return FB_CONSTRAINTS_INDEPENDENT;
    }
#else
    (void)t, (void)x, (void)constants, (void)r;
#endif
    return status;
}

/* u' for known factors; with unknown forces, also lambda and these. */
static inline int solve_once(double t, const double *restrict x, const double *restrict constants,
                             const double *restrict r, double *restrict rates, fb_work *restrict w)
{
#if N_N > 0
    return fb_solve_with_forces(t, x, constants, r, w->mass_matrix, w->forcing, w->acceleration_bias, &w->factors,
                                &w->response, rates, w->multipliers);
#else
    (void)t, (void)x, (void)constants, (void)r;
    return FB_FORM(solve_first)(w->forcing, w->acceleration_bias, &w->factors, rates);
#endif
}

#ifndef FB_SPARSE /* which has no redundant rows */
/* The size of the terms of gamma, quadratic in the speeds. For a constraint Phi = 0 whose terms have the size l, and
 * those of its rate the size v, it is v^2 / l. */
static inline double terms_of_bias(double t, const double *x, const double *constants, const double *r,
                                   const double *scale, const int *row)
{
    double unused[FB_AT_LEAST_1(N_H)], lengths[FB_AT_LEAST_1(N_C + N_I)], speeds[FB_AT_LEAST_1(N_C)], size = 0.0;
    constraint_scale(t, x, constants, r, unused, lengths, speeds);
    for (int i = 0; i < N_C; ++i)
        if (lengths[row[i]] > 0.0)
            size = fb_max(size, scale[i] * speeds[row[i]] * speeds[row[i]] / lengths[row[i]]);
    return size;
}
#endif

/* u' at a state whose equations are set up and factored. */
static inline int solve_factored(double t, const double *restrict x, const double *restrict constants,
                                 const double *restrict r, double *restrict rates, fb_work *restrict w)
{
    int status = solve_once(t, x, constants, r, rates, w);
#ifndef FB_SPARSE
    if (N_RANK < N_C && status == FB_CONSTRAINTS_DEPENDENT) {
        fb_dense_factors *const s = FB_FORM(dense)(&w->factors);
        s->terms = terms_of_bias(t, x, constants, r, s->scale, s->row);
        status = solve_once(t, x, constants, r, rates, w);
    }
#endif
    return status;
}

static inline int solve_accelerations(double t, const double *restrict x, const double *restrict constants,
                                      const double *restrict r, double *restrict coordinate_rates,
                                      double *restrict rates, fb_work *restrict w)
{
    dynamics(t, x, constants, r, coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    const int status = factor_at(t, x, constants, r, w);
    if (status != FB_OK)
        return status;
    return solve_factored(t, x, constants, r, rates, w);
}

/* z', for a solution u'. */
static inline void fill_state_rates(double t, const double *restrict x, const double *restrict constants,
                                    const double *restrict r, double *restrict rates, fb_work *restrict w)
{
#if defined(FB_STATES_NEED_MULTIPLIERS) && N_N == 0
    FB_FORM(multipliers)(w->mass_matrix, w->forcing, rates + N_Q, &w->factors, w->multipliers);
#endif
#if N_Z > 0
    state_rates(t, x, constants, r, rates + N_Q, w->multipliers, rates + N_Q + N_U);
#else
    (void)t, (void)x, (void)constants, (void)r, (void)rates, (void)w;
#endif
}

#if defined(FB_RHS_ONLY) || defined(FB_WITHOUT_RHS)
#define FB_RHS FB_TABLE(rhs)
fb_evaluation FB_RHS;
#else
#define FB_RHS rhs
static fb_evaluation FB_RHS;
#endif

#ifndef FB_WITHOUT_RHS
FB_FLATTEN int FB_RHS(double t, const double *x, const double *constants, const double *r, double *rates, void *work)
{
    fb_work *const w = work;
    double *const coordinate_rates = N_Q > 0 ? rates : w->coordinate_rates;
    const int status = solve_accelerations(t, x, constants, r, coordinate_rates, rates + N_Q, w);
    if (status != FB_OK)
        return status;
    fill_state_rates(t, x, constants, r, rates, w);
    return all_finite(rates, N_X);
}
#endif

#ifndef FB_RHS_ONLY
static int stabilized(double t, const double *x, const double *constants, const double *r, double a, double *rates,
                      void *work)
{
    fb_work *const w = work;
    double positions[FB_AT_LEAST_1(N_C + N_I)], velocities[FB_AT_LEAST_1(N_C)];
    dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    constraint_violation(t, x, constants, r, positions, velocities);
    for (int i = 0; i < N_C; ++i)
        w->acceleration_bias[i] += 2.0 * a * velocities[i] + a * a * positions[i];
    int status = factor_at(t, x, constants, r, w);
    if (status == FB_OK)
        status = solve_factored(t, x, constants, r, rates + N_Q, w);
    for (int i = 0; i < N_Q; ++i)
        rates[i] = w->coordinate_rates[i];
    if (status == FB_OK)
        fill_state_rates(t, x, constants, r, rates, w);
    return status == FB_OK ? all_finite(rates, N_X) : status;
}

static int accelerations(double t, const double *x, const double *constants, const double *r, double *rates,
                         double *multipliers, void *work)
{
    fb_work *const w = work;
    const int status = solve_accelerations(t, x, constants, r, w->coordinate_rates, rates, w);
    if (status != FB_OK)
        return status;
#if N_N > 0
    for (int i = 0; i < N_L; ++i)
        multipliers[i] = w->multipliers[i];
#else
    FB_FORM(multipliers)(w->mass_matrix, w->forcing, rates, &w->factors, multipliers);
#endif
    return all_finite(rates, N_U) == FB_OK ? all_finite(multipliers, N_L) : FB_NOT_FINITE;
}
#endif

#endif
