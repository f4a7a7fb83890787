/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with sparse M and J; see fourbar_ordered.h. If the factorization
 * fails, the constraints are dependent at this state.
 */
#ifndef FOURBAR_SPARSE_H
#define FOURBAR_SPARSE_H

#include "fourbar_array.h"
#include "fourbar_kernel.h"

#include <math.h>

enum { N_STEPS = N_U + N_C };

typedef struct fb_factors {
    double entries[N_STEPS + N_BELOW]; /* the inverse of D, and L column by column */
    double jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double weight[FB_AT_LEAST_1(N_C)];
} fb_factors;

#define FB_VALUE double
#define FB_FACTORS fb_factors
#define FB_OF(name) name
#define FB_ABS(value) fabs(value)
#define FB_SELECT(condition, yes, no) ((condition) ? (yes) : (no))
#define FB_REQUIRE(s, condition, status)                                                                               \
    if (!(condition))                                                                                                  \
    return status
#include "fourbar_ordered.h"

static inline int fb_factor(const double *restrict mass_matrix, const double *restrict constraint_jacobian,
                            const double *restrict forcing, fb_factors *restrict s)
{
    (void)forcing;
    if (all_finite(constraint_jacobian, N_JACOBIAN) != FB_OK)
        return FB_NOT_FINITE;
    return fb_factor_ordered(mass_matrix, constraint_jacobian, s);
}

/* u' for one right-hand side (f, gamma). */
static inline int fb_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                           const fb_factors *restrict s, double *restrict accelerations)
{
    fb_solve_ordered(forcing, acceleration_bias, s, accelerations);
    return FB_OK;
}

/* The same for f as in `fb_factor`. */
static inline int fb_solve_first(const double *restrict forcing, const double *restrict acceleration_bias,
                                 const fb_factors *restrict s, double *restrict accelerations)
{
    return fb_solve(forcing, acceleration_bias, s, accelerations);
}

/* The multipliers of J^T lambda = M u' - f: with M u' - f as right-hand side and zero gamma, u' is zero. */
static inline void fb_multipliers(const double *restrict mass_matrix, const double *restrict forcing,
                                  const double *restrict accelerations, const fb_factors *restrict s,
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
    for (int k = 0; k < N_STEPS; ++k)
        y[k] = side[unknown[k]];
    fb_substitute(s, y);
    for (int k = 0; k < N_STEPS; ++k)
        if (unknown[k] >= N_U)
            multipliers[unknown[k] - N_U] = y[k];
}

#endif
