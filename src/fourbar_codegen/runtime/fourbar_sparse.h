/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with sparse M and J; see fourbar_ordered.h. If the factorization
 * fails, the constraints are dependent at this state; or, with FB_EARLY, the dense equations are solved by
 * fourbar_solve.h.
 */
#ifndef FOURBAR_SPARSE_H
#define FOURBAR_SPARSE_H

#include "fourbar_array.h"
#include "fourbar_kernel.h"

#include <math.h>

#ifdef FB_EARLY
#define fb_factors fb_dense_factors
#define fb_factor fb_dense_factor
#define fb_solve fb_dense_solve
#define fb_solve_first fb_dense_solve_first
#define fb_multipliers fb_dense_multipliers
#define fb_reactions fb_dense_reactions
#define fb_solve_directions fb_dense_solve_directions
#include "fourbar_solve.h"
#undef fb_factors
#undef fb_factor
#undef fb_solve
#undef fb_solve_first
#undef fb_multipliers
#undef fb_reactions
#undef fb_solve_directions
#endif

enum { N_STEPS = N_U + N_C };

typedef struct fb_factors {
    double entries[N_STEPS + N_BELOW]; /* the inverse of D, and L column by column */
    double jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double weight[FB_AT_LEAST_1(N_C)];
#ifdef FB_EARLY
    int is_dense; /* whether the dense factors are used */
    fb_dense_factors dense;
#endif
} fb_factors;

/* M and J with their zeros. */
static inline void fb_fill(const double *restrict mass, const double *restrict jacobian, double *restrict mass_matrix,
                           double *restrict constraint_jacobian)
{
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
#define FB_FACTORS fb_factors
#define FB_OF(name) name
#define FB_ABS(value) fabs(value)
#define FB_SELECT(condition, yes, no) ((condition) ? (yes) : (no))
#define FB_REQUIRE(s, condition, status)                                                                               \
    if (!(condition))                                                                                                  \
    return status
#include "fourbar_ordered.h"

#ifdef FB_EARLY
static FB_CALLED int fb_factor_filled(const double *restrict mass, const double *restrict jacobian,
                                      fb_factors *restrict s)
{
    double mass_matrix[N_U * N_U], constraint_jacobian[N_C * N_U];
    fb_fill(mass, jacobian, mass_matrix, constraint_jacobian);
    return fb_dense_factor(mass_matrix, constraint_jacobian, NULL, &s->dense);
}
#endif

static inline int fb_factor(const double *restrict mass_matrix, const double *restrict constraint_jacobian,
                            const double *restrict forcing, fb_factors *restrict s)
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
static inline int fb_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                           const fb_factors *restrict s, double *restrict accelerations)
{
#ifdef FB_EARLY
    if (s->is_dense)
        return fb_dense_solve(forcing, acceleration_bias, &s->dense, accelerations);
#endif
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
