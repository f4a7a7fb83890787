/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with sparse M and J; see linear_algebra/sparse_ldl.inc. If the
 * factorization fails, the constraints are dependent at this state; or, with FB_EARLY, the dense equations are solved
 * by linear_algebra/dense_equations.h.
 */
#ifndef FOURBAR_SPARSE_EQUATIONS_H
#define FOURBAR_SPARSE_EQUATIONS_H

#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"

#include <math.h>

#ifdef FB_EARLY
#include "dense_equations.h"
#endif

enum { N_STEPS = N_U + N_C };

typedef struct fb_sparse_factors {
    double entries[N_STEPS + N_BELOW]; /* the inverse of D, and L column by column */
    double jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double weight[FB_AT_LEAST_1(N_C)];
#ifdef FB_EARLY
    int is_dense; /* whether the dense factors are used */
    fb_dense_factors dense;
#endif
} fb_sparse_factors;

/* M and J with their zeros. */
static inline void fb_sparse_fill(const double *constants, const double *restrict mass, const double *restrict jacobian,
                                  double *restrict mass_matrix, double *restrict constraint_jacobian)
{
    (void)constants;
    for (int i = 0; i < N_U * N_U; ++i)
        mass_matrix[i] = 0.0;
    for (int i = 0; i < N_MASS; ++i)
        mass_matrix[mass_row[i] * N_U + mass_column[i]] = mass_matrix[mass_column[i] * N_U + mass_row[i]] = mass[i];
    for (int i = 0; i < N_C * N_U; ++i)
        constraint_jacobian[i] = 0.0;
    for (int row = 0; row < N_C; ++row)
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            constraint_jacobian[row * N_U + jacobian_column[i]] = jacobian[i];
}

#define FB_VALUE double
#define FB_FACTORS fb_sparse_factors
#define FB_OF(name) name
#define FB_ABS(value) fabs(value)
#define FB_SELECT(condition, yes, no) ((condition) ? (yes) : (no))
#define FB_REQUIRE(s, condition, status)                                                                               \
    if (!(condition))                                                                                                  \
    return status
#include "sparse_ldl.inc"

#ifdef FB_EARLY
static FB_CALLED int fb_factor_filled(const double *restrict mass, const double *restrict jacobian,
                                      fb_sparse_factors *restrict s)
{
    double mass_matrix[N_U * N_U], constraint_jacobian[N_C * N_U];
    fb_sparse_fill(NULL, mass, jacobian, mass_matrix, constraint_jacobian);
    return fb_dense_factor(mass_matrix, constraint_jacobian, NULL, &s->dense);
}
#endif

static inline int fb_sparse_factor(const double *restrict mass_matrix, const double *restrict constraint_jacobian,
                                   const double *restrict forcing, fb_sparse_factors *restrict s)
{
    (void)forcing;
    if (all_finite(constraint_jacobian, N_JACOBIAN) != FB_OK)
        return FB_NOT_FINITE;
    const int status = fb_factor_ordered(mass_matrix, constraint_jacobian, s);
#ifdef FB_EARLY
    s->is_dense = status != FB_OK;
    if (s->is_dense)
        return fb_factor_filled(mass_matrix, constraint_jacobian, s);
#endif
    return status;
}

/* u' for one right-hand side (f, gamma). */
static inline int fb_sparse_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                                  const fb_sparse_factors *restrict s, double *restrict accelerations)
{
#ifdef FB_EARLY
    if (s->is_dense)
        return fb_dense_solve(forcing, acceleration_bias, &s->dense, accelerations);
#endif
    fb_solve_ordered(forcing, acceleration_bias, s, accelerations);
    return FB_OK;
}

/* The same for f as in `fb_sparse_factor`. */
static inline int fb_sparse_solve_first(const double *restrict forcing, const double *restrict acceleration_bias,
                                        const fb_sparse_factors *restrict s, double *restrict accelerations)
{
    return fb_sparse_solve(forcing, acceleration_bias, s, accelerations);
}

/* u' for n right-hand sides (f, -gamma) in the columns of a matrix. */
static inline void fb_sparse_solve_directions(const int n, const double *restrict sides,
                                              const fb_sparse_factors *restrict s, double *restrict accelerations)
{
    for (int j = 0; j < n; ++j) {
        double forcing[N_U], bias[FB_AT_LEAST_1(N_C)], solution[N_U];
        for (int i = 0; i < N_U; ++i)
            forcing[i] = sides[i * n + j];
        for (int i = 0; i < N_C; ++i)
            bias[i] = -sides[(N_U + i) * n + j];
        fb_sparse_solve(forcing, bias, s, solution);
        for (int i = 0; i < N_U; ++i)
            accelerations[i * n + j] = solution[i];
    }
}

/* The multipliers of J^T lambda = M u' - f: with M u' - f as right-hand side and zero gamma, u' is zero. */
static inline void fb_sparse_multipliers(const double *restrict mass_matrix, const double *restrict forcing,
                                         const double *restrict accelerations, const fb_sparse_factors *restrict s,
                                         double *restrict multipliers)
{
    double side[N_STEPS] = {0.0}, y[N_STEPS];
    for (int i = 0; i < N_U; ++i)
        side[i] = -forcing[i];
    for (int i = 0; i < N_MASS; ++i) {
        side[mass_row[i]] += mass_matrix[i] * accelerations[mass_column[i]];
        if (mass_row[i] != mass_column[i])
            side[mass_column[i]] += mass_matrix[i] * accelerations[mass_row[i]];
    }
#ifdef FB_EARLY
    if (s->is_dense) {
        fb_dense_reactions(side, &s->dense, multipliers);
        return;
    }
#endif
    for (int k = 0; k < N_STEPS; ++k)
        y[k] = side[unknown[k]];
    fb_substitute(s, y);
    for (int k = 0; k < N_STEPS; ++k)
        if (unknown[k] >= N_U)
            multipliers[unknown[k] - N_U] = y[k];
}

#endif
