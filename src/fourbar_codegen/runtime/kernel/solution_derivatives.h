/* Derivatives of the solution: products with directions and with weights, and Jacobians. */
#ifndef FOURBAR_SOLUTION_DERIVATIVES_H
#define FOURBAR_SOLUTION_DERIVATIVES_H

#include "solution.h"

#if N_Z + N_N == 0
/* A column of the multipliers' derivatives, for one of the accelerations'. Not inline, since it is rarely needed. */
FB_PART static void store_multipliers(const fb_work *w, const double *forcing, const double *accelerations, const int n,
                                      double *column)
{
    double multipliers[FB_AT_LEAST_1(N_C)];
    FB_FORM(multipliers)(w->mass_matrix, forcing, accelerations, &w->factors, multipliers);
    for (int i = 0; i < N_C; ++i)
        column[i * n] = multipliers[i];
}
#endif

/* Differentiating M u' = f + J^T lambda and J u' + gamma = 0 in some direction gives equations for the changes of u'
 * and lambda with the same matrices; the right-hand sides are the n columns of `residual`. The rows of z' there are
 * completed with these changes. The equations are those of the last call of `accelerations`. */
static int solve_columns(const fb_function *functions, const int n, double t, const double *x, const double *constants,
                         const double *r, const double *residual, double *matrix, double *multiplier_jacobian,
                         fb_work *w)
{
    (void)t, (void)x, (void)constants, (void)r; /* used with unknown forces and state equations */
#if N_N > 0
    fb_response *const s = &w->response;
    if (!fb_evaluate_forces(t, x, constants, r, w->multipliers + N_C, s))
        return FB_NOT_FINITE;
    fb_form_response(w->mass_matrix, &w->factors, s);
#endif
#if N_Z + N_N > 0
    double multipliers[FB_AT_LEAST_1(N_L)];
#endif
#if N_Z > 0
    const fb_at held = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const of_state_rates[] = {w->state_rate_acceleration_jacobian, w->state_rate_multiplier_jacobian};
    functions[FB_STATE_RATE_PARTIALS].call(&held, NULL, of_state_rates, w);
#else
    (void)functions;
#endif
    /* Redundant rows hold in every direction in which the state can move. */
    FB_FORM(solve_directions)(n, residual, &w->factors, matrix + N_Q * n);
    if (N_Z + N_N == 0 && multiplier_jacobian == NULL)
        return all_finite(matrix, N_X * n);
    for (int j = 0; j < n; ++j) {
        double forcing[N_U], solution[N_U];
        for (int i = 0; i < N_U; ++i) {
            forcing[i] = residual[i * n + j];
            solution[i] = matrix[(N_Q + i) * n + j];
        }
#if N_Z + N_N > 0
        FB_FORM(multipliers)(w->mass_matrix, forcing, solution, &w->factors, multipliers);
#endif
#if N_N > 0
        double unused = 0.0, *const forces = multipliers + N_C;
        for (int i = 0; i < N_N; ++i)
            forces[i] = fb_auxiliary_row(s, i, residual[(N_U + N_C + i) * n + j], solution, multipliers, &unused);
        const int found = fb_respond(s, forces, solution, multipliers);
        if (found != FB_OK)
            return found;
#endif
#if N_Z + N_N > 0
        for (int i = 0; i < N_L && multiplier_jacobian; ++i)
            multiplier_jacobian[i * n + j] = multipliers[i];
#else
        if (multiplier_jacobian)
            store_multipliers(w, forcing, solution, n, multiplier_jacobian + j);
#endif
        for (int i = 0; i < N_U; ++i)
            matrix[(N_Q + i) * n + j] = solution[i];
#if N_Z > 0
        for (int i = 0; i < N_Z; ++i) {
            double sum = residual[(N_U + N_L + i) * n + j];
            for (int k = 0; k < N_U; ++k)
                sum += w->state_rate_acceleration_jacobian[i * N_U + k] * solution[k];
            for (int k = 0; k < N_L; ++k)
                sum += w->state_rate_multiplier_jacobian[i * N_L + k] * multipliers[k];
            matrix[(N_Q + N_U + i) * n + j] = sum;
        }
#endif
    }
    return all_finite(matrix, N_X * n);
}

static int differentiate(const fb_function *functions, enum FB_ROLE role, int n, double t, const double *x,
                         const double *constants, const double *r, double *matrix, double *multiplier_jacobian,
                         void *work)
{
    fb_work *const w = work;
    const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
    if (status != FB_OK)
        return status;
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const partials[] = {matrix, w->residual_jacobian};
    functions[role].call(&at, NULL, partials, work);
    return solve_columns(functions, n, t, x, constants, r, w->residual_jacobian, matrix, multiplier_jacobian, w);
}

#ifndef FB_LIBRARY
static int jvp(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *known, int n, const double *directions, double *rates, void *work)
{
    fb_work *const w = work;
    if (known == NULL) {
        const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
        if (status != FB_OK)
            return status;
    } else {
        for (int i = 0; i < N_U; ++i)
            w->accelerations[i] = known[i];
#if N_N == 0
        FB_FORM(multipliers)(w->mass_matrix, w->forcing, known, &w->factors, w->multipliers);
#endif
    }
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, n};
    double *const products[] = {rates, w->residual_tangent};
    functions[FB_RESIDUAL_JVP].call(&at, &directions, products, work);
    return solve_columns(functions, n, t, x, constants, r, w->residual_tangent, rates, NULL, w);
}

/* With the changes of u' and lambda as in `solve_columns`, and weights a of u' and l of lambda, the weighted sum is
 * that of the residual's rows with weights v and m that solve the transposed equations, M v + J^T m = a, -J v = l.
 * These are the equations of motion with f = a, gamma = l and lambda = -m. Unknown forces n: from G dn = -(their rows).
 */
static int vjp(const fb_function *functions, double t, const double *x, const double *constants, const double *r,
               const double *weights, double *gradient, void *work)
{
    fb_work *const w = work;
    const int status = accelerations(t, x, constants, r, w->accelerations, w->multipliers, work);
    if (status != FB_OK)
        return status;
    double of_accelerations[N_U], of_multipliers[FB_AT_LEAST_1(N_L)], rows[N_Q + N_U + N_L + N_Z];
    double *const of_residual = rows + N_Q;
    for (int i = 0; i < N_Q; ++i)
        rows[i] = weights[i];
    for (int i = 0; i < N_U; ++i)
        of_accelerations[i] = weights[N_Q + i];
    for (int i = 0; i < N_L; ++i)
        of_multipliers[i] = weights[N_X + i];
#if N_Z > 0
    const fb_at held = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    double *const of_state_rates[] = {w->state_rate_acceleration_jacobian, w->state_rate_multiplier_jacobian};
    functions[FB_STATE_RATE_PARTIALS].call(&held, NULL, of_state_rates, w);
    for (int k = 0; k < N_Z; ++k) {
        const double weight = of_residual[N_U + N_L + k] = weights[N_Q + N_U + k];
        for (int i = 0; i < N_U; ++i)
            of_accelerations[i] += w->state_rate_acceleration_jacobian[k * N_U + i] * weight;
        for (int i = 0; i < N_L; ++i)
            of_multipliers[i] += w->state_rate_multiplier_jacobian[k * N_L + i] * weight;
    }
#endif
#if N_N > 0
    fb_response *const s = &w->response;
    if (!fb_evaluate_forces(t, x, constants, r, w->multipliers + N_C, s))
        return FB_NOT_FINITE;
    fb_form_response(w->mass_matrix, &w->factors, s);
    const int found = fb_forces_vjp(s, of_accelerations, of_multipliers, of_residual + N_U + N_C);
    if (found != FB_OK)
        return found;
#endif
    /* Redundant rows: gradients along the tangent do not depend on which of their multipliers are taken. */
    FB_FORM(solve)(of_accelerations, of_multipliers, &w->factors, of_residual);
    FB_FORM(multipliers)(w->mass_matrix, of_accelerations, of_residual, &w->factors, of_residual + N_U);
    for (int i = 0; i < N_C; ++i)
        of_residual[N_U + i] *= -1.0;
    const fb_at at = {t, x, constants, r, w->accelerations, w->multipliers, 0};
    const double *const of_rows[] = {rows};
    functions[FB_RESIDUAL_VJP].call(&at, of_rows, &gradient, work);
    return all_finite(gradient, N_X + N_P + N_R);
}
#endif

#endif
