/* Projection onto the constraints, and its derivatives. */
#ifndef FOURBAR_PROJECTION_H
#define FOURBAR_PROJECTION_H

#include "solution.h"
#include "solution_derivatives.h"

/* Factors of a state with a smaller violation serve for the tangent of the closed one: what they leave of a direction's
 * violation is this fraction of it. */
#define FB_SLIGHT_DRIFT_RTOL 1e-9

static const double fb_at_rest[N_U + N_C + N_N + 1]; /* zeros */

#define FB_VALUE double
#define FB_OF(name) name
#define FB_FACTORS fb_factors
#define FB_TRUTHS int
#define FB_TRUTH(condition) (-(condition))
#define FB_CHOOSE(truths, yes, no) ((truths) ? (yes) : (no))
#define FB_ANY(truths) (truths)
#define FB_MAGNITUDE(value) fabs(value)
#define FB_LARGER(a, b) fb_max(a, b)
#define FB_SOLVE(w, factors, change) FB_FORM(solve)(fb_at_rest, w, factors, change)
#include "newton.inc"

/* Constraint stabilization by mass-orthogonal projection, with new factors where those of a state nearby do not lead
 * to a closed state. */
static int project(double t, double *x, const double *constants, const double *r, int factors_valid, void *work)
{
    fb_work *const w = work;
    if (N_C + N_I == 0)
        return FB_OK;
#ifdef FB_RECURSIVE
    w->factors.constants = constants; /* those of valid factors may have been elsewhere */
#endif
    w->drift = INFINITY;
    for (int attempt = 0; attempt < MAX_FACTORIZATIONS; ++attempt) {
        const int is_new = attempt > 0 || !factors_valid;
        int status = FB_OK;
        if (is_new) {
            dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
                     w->acceleration_bias);
            status = factor_at(t, x, constants, r, w);
        }
        double size[2];
        const int closed = fb_newton(t, x, constants, r, &w->factors, status == FB_OK ? -1 : 0, size);
        if (size[1] != size[1])
            return FB_NOT_FINITE;
        if (is_new && status == FB_OK)
            w->drift = size[0];
        /* Closed states at singular positions are accepted. */
        if (closed || (status != FB_NOT_FINITE && size[1] <= FB_CLOSURE_RTOL))
            return FB_OK;
        if (status != FB_OK)
            return status;
    }
    return FB_NOT_CLOSED;
}

#ifndef FB_LIBRARY
/* The changes of coordinates and speeds that lead along directions onto the constraints' tangent: those of `project`
 * for the derivatives of the violations, by the same orthogonality. */
static int projection_jvp(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, enum FB_LAST last, int n, double *directions, void *work)
{
    fb_work *const w = work;
    /* f = 0, then the violations: in solutions for -gamma, signs are reversed */
    double sides[(N_U + FB_AT_LEAST_1(N_C + N_I)) * FB_DIRECTIONS] = {0.0}, unused[FB_AT_LEAST_1(N_C) * FB_DIRECTIONS];
    double *const violations = sides + N_U * n;
    double changes[N_U * FB_DIRECTIONS], change[N_U], coordinate_changes[FB_AT_LEAST_1(N_Q)];
    const fb_at at = {t, x, constants, r, NULL, NULL, n};
    const double *const given[] = {directions};
    if (N_C + N_I == 0)
        return FB_OK;
    if (!(last == FB_LAST_RHS || (last == FB_LAST_PROJECT && w->drift <= FB_SLIGHT_DRIFT_RTOL))) {
        dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
                 w->acceleration_bias);
        const int status = factor_at(t, x, constants, r, w);
        if (status != FB_OK)
            return status;
    }
    double *const of_positions[] = {violations, unused};
    functions[FB_CONSTRAINT_JVP].call(&at, given, of_positions, work);
    FB_FORM(solve_directions)(n, sides, &w->factors, changes);
    for (int j = 0; j < n; ++j) {
        for (int i = 0; i < N_U; ++i)
            change[i] = changes[i * n + j];
        coordinate_change(t, x, constants, r, change, coordinate_changes);
        for (int i = 0; i < N_Q; ++i)
            directions[i * n + j] -= coordinate_changes[i];
    }
    /* The speeds' constraints depend on the coordinates as well. */
    double positions[FB_AT_LEAST_1(N_C + N_I) * FB_DIRECTIONS];
    double *const of_speeds[] = {positions, violations};
    functions[FB_CONSTRAINT_JVP].call(&at, given, of_speeds, work);
    FB_FORM(solve_directions)(n, sides, &w->factors, changes);
    for (int i = 0; i < N_U * n; ++i)
        directions[N_Q * n + i] -= changes[i];
    return FB_OK;
}

/* The weighted sum of changes v with M v = J^T lambda, J v + w = 0, with weights a, is that of the rows of w with the
 * multipliers of the equations of motion for f = a, gamma = 0. */
static int projection_vjp(const fb_function *functions, double t, const double *x, const double *constants,
                          const double *r, double *gradient, void *work)
{
    fb_work *const w = work;
    double rows[FB_AT_LEAST_1(2 * N_C + N_I)] = {0.0}, of_dynamics[N_Q + N_U + N_L + N_Z] = {0.0}, change[N_U];
    const fb_at at = {t, x, constants, r, fb_at_rest, fb_at_rest, 0};
    const double *const of_violations[] = {rows}, *const of_residual[] = {of_dynamics};
    double *const result[] = {w->gradient};
    if (N_C + N_I == 0)
        return FB_OK;
    dynamics(t, x, constants, r, w->coordinate_rates, w->mass_matrix, w->forcing, w->constraint_jacobian,
             w->acceleration_bias);
    const int status = factor_at(t, x, constants, r, w);
    if (status != FB_OK)
        return status;
    /* the speeds, which projection_jvp moves last */
    FB_FORM(solve)(gradient + N_Q, fb_at_rest, &w->factors, change);
    FB_FORM(multipliers)(w->mass_matrix, gradient + N_Q, change, &w->factors, rows + N_C + N_I);
    functions[FB_CONSTRAINT_VJP].call(&at, of_violations, result, work);
    for (int i = 0; i < N_X + N_P + N_R; ++i)
        gradient[i] += w->gradient[i];
    /* the coordinates: q' = K u + k, so K^T is in the derivatives of q' with respect to u */
    for (int i = 0; i < N_Q; ++i)
        of_dynamics[i] = gradient[i];
    functions[FB_RESIDUAL_VJP].call(&at, of_residual, result, work);
    FB_FORM(solve)(w->gradient + N_Q, fb_at_rest, &w->factors, change);
    for (int i = 0; i < 2 * N_C + N_I; ++i)
        rows[i] = 0.0;
    FB_FORM(multipliers)(w->mass_matrix, w->gradient + N_Q, change, &w->factors, rows);
    functions[FB_CONSTRAINT_VJP].call(&at, of_violations, result, work);
    for (int i = 0; i < N_X + N_P + N_R; ++i)
        gradient[i] += w->gradient[i];
    return all_finite(gradient, N_X + N_P + N_R);
}
#endif

#endif
