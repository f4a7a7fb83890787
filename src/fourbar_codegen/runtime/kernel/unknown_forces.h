/* Unknown forces n that drive the motion, such as the normal force of a contact with friction: they keep auxiliary
 * speeds zero, and also act on the motion.
 *
 *   M u' = f + F(n) + J^T lambda,    J u' + gamma = 0,    Q(n) - M_a u' + J_a^T lambda = 0
 *
 * With the factors of M and J, u' = a + A dn and lambda = l + L dn for a change dn of the forces: each column of A and
 * L is the solution for a column of F_n. The residual of the auxiliary speeds' rows changes by G dn, with the small
 * unsymmetric matrix G = Q_n - M_a A + J_a^T L. If F and Q are linear, one step of Newton's method from n = 0 is the
 * solution. Otherwise more steps are needed, always from the same starting forces, so that x' is a function of the
 * state alone.
 *
 * Included by kernel/solution.h, if the model has such forces.
 *
 * Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, sections 4.9 and 5.9
 * (noncontributing forces brought into evidence by auxiliary speeds).
 */
#ifndef FOURBAR_UNKNOWN_FORCES_H
#define FOURBAR_UNKNOWN_FORCES_H

#include "../linear_algebra/elimination.h"

/* Tolerance of Newton's method: residuals of the rows relative to their terms, ... */
#define FB_FORCES_RTOL 1e-13
/* ... and the tolerance if rounding errors prevent further progress. */
#define FB_FORCES_LOOSE_RTOL 1e-9
/* Forces are undetermined if a pivot of G, with rows and columns in units of their terms, is smaller. */
#define FB_FORCES_PIVOT_RATIO 1e-12
/* Iterations, and iterations that may increase the residual, usually over the kink of an absolute value. */
enum { FB_MAX_STEPS = 40, FB_FREE_STEPS = 8 };

typedef struct fb_response {
    double effect[N_U], effect_jacobian[N_U * N_N];                                 /* F, dF/dn */
    double auxiliary_forcing[N_N], auxiliary_forcing_jacobian[N_N * N_N];           /* Q, dQ/dn */
    double auxiliary_mass[N_N * N_U];                                               /* M_a */
    double auxiliary_constraint_jacobian[FB_AT_LEAST_1(N_N * N_C)];                 /* J_a^T */
    double wrt_accelerations[N_N * N_U], wrt_multipliers[N_N * FB_AT_LEAST_1(N_C)]; /* A, L, column by column */
    double matrix[N_N * N_N], row_unit[N_N], column_unit[N_N]; /* G, in units of the terms in its rows and columns */
} fb_response;

/* The residual of an auxiliary speed's row without `forcing`; `size` is the sum of the terms' magnitudes. */
static inline double fb_auxiliary_row(const fb_response *s, const int row, const double forcing,
                                      const double *accelerations, const double *multipliers, double *size)
{
    double sum = forcing;
    for (int i = 0; i < N_U; ++i) {
        const double term = s->auxiliary_mass[row * N_U + i] * accelerations[i];
        sum -= term;
        *size += fabs(term);
    }
    for (int i = 0; i < N_C; ++i) {
        const double term = s->auxiliary_constraint_jacobian[row * N_C + i] * multipliers[i];
        sum += term;
        *size += fabs(term);
    }
    return sum;
}

/* A, L and G at forces at which F, Q and their derivatives were evaluated. */
static inline void fb_form_response(const double *mass_matrix, const fb_factors *factors, fb_response *restrict s)
{
    static const double at_rest[FB_AT_LEAST_1(N_C)] = {0.0};
    for (int j = 0; j < N_N; ++j) {
        double column[N_U];
        for (int i = 0; i < N_U; ++i)
            column[i] = s->effect_jacobian[i * N_N + j];
        FB_FORM(solve)(column, at_rest, factors, s->wrt_accelerations + j * N_U);
        FB_FORM(multipliers)(mass_matrix, column, s->wrt_accelerations + j * N_U, factors,
                             s->wrt_multipliers + j * N_C);
    }
    double sizes[N_N * N_N];
    for (int row = 0; row < N_N; ++row) {
        double largest = 0.0;
        for (int j = 0; j < N_N; ++j) {
            const double forcing = s->auxiliary_forcing_jacobian[row * N_N + j];
            sizes[row * N_N + j] = fabs(forcing);
            s->matrix[row * N_N + j] = fb_auxiliary_row(s, row, forcing, s->wrt_accelerations + j * N_U,
                                                        s->wrt_multipliers + j * N_C, &sizes[row * N_N + j]);
            largest = fb_max(largest, sizes[row * N_N + j]);
        }
        s->row_unit[row] = largest > 0.0 ? 1.0 / largest : 1.0;
    }
    for (int j = 0; j < N_N; ++j) {
        double largest = 0.0;
        for (int row = 0; row < N_N; ++row)
            largest = fb_max(largest, s->row_unit[row] * sizes[row * N_N + j]);
        s->column_unit[j] = largest > 0.0 ? 1.0 / largest : 1.0;
        for (int row = 0; row < N_N; ++row)
            s->matrix[row * N_N + j] *= s->row_unit[row] * s->column_unit[j];
    }
}

/* Solves G dn = -`rest`, which is overwritten by dn, and updates u' and lambda. */
static inline int fb_respond(const fb_response *s, double *restrict rest, double *restrict accelerations,
                             double *restrict multipliers)
{
    double matrix[N_N * N_N];
    for (int i = 0; i < N_N * N_N; ++i)
        matrix[i] = s->matrix[i];
    for (int j = 0; j < N_N; ++j)
        rest[j] *= -s->row_unit[j];
    if (!fb_eliminate_full(N_N, matrix, rest, FB_FORCES_PIVOT_RATIO))
        return all_finite(matrix, N_N * N_N) == FB_OK ? FB_FORCES_UNDETERMINED : FB_NOT_FINITE;
    for (int j = 0; j < N_N; ++j) {
        rest[j] *= s->column_unit[j];
        for (int i = 0; i < N_U; ++i)
            accelerations[i] += s->wrt_accelerations[j * N_U + i] * rest[j];
        for (int i = 0; i < N_C; ++i)
            multipliers[i] += s->wrt_multipliers[j * N_C + i] * rest[j];
    }
    return FB_OK;
}

#ifndef FB_LIBRARY
/* From weights of u', lambda and n, the weights of the auxiliary speeds' rows, and those of u' and lambda for held n.
 */
static inline int fb_forces_vjp(const fb_response *s, double *restrict of_accelerations,
                                double *restrict of_multipliers, double *restrict rows)
{
    double transposed[N_N * N_N];
    for (int j = 0; j < N_N; ++j) {
        double sum = of_multipliers[N_C + j];
        for (int i = 0; i < N_U; ++i)
            sum += s->wrt_accelerations[j * N_U + i] * of_accelerations[i];
        for (int i = 0; i < N_C; ++i)
            sum += s->wrt_multipliers[j * N_C + i] * of_multipliers[i];
        rows[j] = -s->column_unit[j] * sum;
        for (int i = 0; i < N_N; ++i)
            transposed[j * N_N + i] = s->matrix[i * N_N + j];
    }
    if (!fb_eliminate_full(N_N, transposed, rows, FB_FORCES_PIVOT_RATIO))
        return all_finite(transposed, N_N * N_N) == FB_OK ? FB_FORCES_UNDETERMINED : FB_NOT_FINITE;
    for (int j = 0; j < N_N; ++j) {
        rows[j] *= s->row_unit[j];
        for (int i = 0; i < N_U; ++i)
            of_accelerations[i] -= s->auxiliary_mass[j * N_U + i] * rows[j];
        for (int i = 0; i < N_C; ++i)
            of_multipliers[i] += s->auxiliary_constraint_jacobian[j * N_C + i] * rows[j];
    }
    return FB_OK;
}
#endif

/* F, Q and their derivatives at forces n; whether they are finite. */
static inline int fb_evaluate_forces(double t, const double *x, const double *constants, const double *r,
                                     const double *forces, fb_response *restrict s)
{
    unknown_forces(t, x, constants, r, forces, s->effect, s->effect_jacobian, s->auxiliary_forcing,
                   s->auxiliary_forcing_jacobian, s->auxiliary_mass, s->auxiliary_constraint_jacobian);
    return all_finite(s->effect, N_U) == FB_OK && all_finite(s->effect_jacobian, N_U * N_N) == FB_OK &&
           all_finite(s->auxiliary_forcing, N_N) == FB_OK &&
           all_finite(s->auxiliary_forcing_jacobian, N_N * N_N) == FB_OK;
}

/* u' and lambda for evaluated forces, and the residuals of the auxiliary speeds' rows; `size` is the largest residual
 * relative to the row's terms. Terms of Q are its linear terms at n, and the rest. */
static inline int fb_balance_forces(const double *mass_matrix, const double *forcing, const double *acceleration_bias,
                                    const fb_factors *factors, const fb_response *restrict s,
                                    double *restrict accelerations, double *restrict multipliers, double *restrict rest,
                                    double *restrict size)
{
    const double *const forces = multipliers + N_C;
    double total[N_U];
    for (int i = 0; i < N_U; ++i)
        total[i] = forcing[i] + s->effect[i];
    const int status = FB_FORM(solve)(total, acceleration_bias, factors, accelerations);
    if (status != FB_OK)
        return status;
    FB_FORM(multipliers)(mass_matrix, total, accelerations, factors, multipliers);
    *size = 0.0;
    for (int row = 0; row < N_N; ++row) {
        double terms = 0.0, others = s->auxiliary_forcing[row];
        for (int j = 0; j < N_N; ++j) {
            const double term = s->auxiliary_forcing_jacobian[row * N_N + j] * forces[j];
            terms += fabs(term);
            others -= term;
        }
        terms += fabs(others);
        rest[row] = fb_auxiliary_row(s, row, s->auxiliary_forcing[row], accelerations, multipliers, &terms);
        *size = fb_max(*size, rest[row] == 0.0 ? 0.0 : fabs(rest[row]) / terms);
    }
    return all_finite(rest, N_N);
}

/* u', and lambda followed by n, by Newton's method from equal starting forces. */
static inline int fb_newton_for_forces(double t, const double *x, const double *constants, const double *r,
                                       const double *mass_matrix, const double *forcing,
                                       const double *acceleration_bias, const fb_factors *factors, const double start,
                                       fb_response *restrict s, double *restrict accelerations,
                                       double *restrict multipliers)
{
    double *const forces = multipliers + N_C;
    double before[N_N], change[N_N], rest[N_N];
    double last = INFINITY, share = 1.0, size;
    for (int j = 0; j < N_N; ++j) {
        before[j] = start;
        change[j] = 0.0;
    }
    for (int step = 0; step < FB_MAX_STEPS; ++step) {
        for (int j = 0; j < N_N; ++j)
            forces[j] = before[j] + share * change[j];
        const int is_finite = fb_evaluate_forces(t, x, constants, r, forces, s);
        if (!is_finite && step == 0)
            return FB_NOT_FINITE;
        if (is_finite) {
            const int status = fb_balance_forces(mass_matrix, forcing, acceleration_bias, factors, s, accelerations,
                                                 multipliers, rest, &size);
            if (status != FB_OK)
                return status;
            if (size <= FB_FORCES_RTOL || (size <= FB_FORCES_LOOSE_RTOL && !(size < 0.5 * last)))
                return FB_OK;
        }
        if (!is_finite || (step >= FB_FREE_STEPS && !(size < last))) {
            share *= 0.5;
            continue;
        }
        fb_form_response(mass_matrix, factors, s);
        const int status = fb_respond(s, rest, accelerations, multipliers);
        if (status != FB_OK)
            return status;
        last = size;
        share = 1.0;
        for (int j = 0; j < N_N; ++j) {
            before[j] = forces[j];
            change[j] = rest[j];
        }
#ifdef FB_FORCES_LINEAR
        for (int j = 0; j < N_N; ++j)
            forces[j] += change[j];
        return FB_OK;
#endif
    }
    return FB_FORCES_NOT_FOUND;
}

/* The same, for known factors of M and J, f and gamma. */
static inline int fb_solve_with_forces(double t, const double *x, const double *constants, const double *r,
                                       const double *mass_matrix, const double *forcing,
                                       const double *acceleration_bias, const fb_factors *factors,
                                       fb_response *restrict s, double *restrict accelerations,
                                       double *restrict multipliers)
{
#ifdef FB_FORCES_LINEAR
    enum { N_STARTS = 1 };
#else
    enum { N_STARTS = 5 };
#endif
    /* In N or N m. Force laws with a root or a quotient of the forces have no value or derivative at 0, and from 0
     * Newton's method may fail at kinks. */
    static const double starts[] = {0.0, 1e-8, -1e-8, 1.0, 1e3};
    int first = FB_NOT_FINITE;
    for (int i = 0; i < N_STARTS; ++i) {
        const int status = fb_newton_for_forces(t, x, constants, r, mass_matrix, forcing, acceleration_bias, factors,
                                                starts[i], s, accelerations, multipliers);
        if (status == FB_OK)
            return FB_OK;
        if (first == FB_NOT_FINITE)
            first = status;
    }
    return first;
}

#endif
