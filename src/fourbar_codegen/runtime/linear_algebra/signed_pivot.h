/* The sign of the determinant of the dependent speeds' columns of J, and its least pivot, in units of their own.
 */
#ifndef FOURBAR_SIGNED_PIVOT_H
#define FOURBAR_SIGNED_PIVOT_H

#include "dense_equations.h"
#include "units.h"

/* A singular position is nearby if the smallest pivot is below this fraction of its largest value in a run. That is
 * smaller than where positions count as singular, and larger than the gap between two branches that meet there, since
 * rounding errors of closed loops separate the branches by the square root of their size. */
#define FB_NEAR_SINGULAR_RATIO 1e-5

/* The sign of the determinant of the dependent speeds' columns of J, times their smallest pivot, with columns and rows
 * in their units: it passes through or near 0 at a singular position. */
static inline double fb_signed_pivot(const double *restrict jacobian, const fb_units *restrict units,
                                     const int *restrict columns)
{
    double a[FB_AT_LEAST_1(N_C * N_C)];
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_C; ++j)
            a[i * N_C + j] = jacobian[i * N_U + columns[j]] / (units->column[columns[j]] * units->row[i]);
    return fb_signed_least_pivot(N_C, a);
}

/* Whether J is close to losing rank, given the largest signed pivot of the run, for the pivots that are largest in
 * these units. Another choice of the dependent speeds can be small where J has full rank. */
static inline int fb_is_near_singular(const double *restrict jacobian, const fb_units *restrict units,
                                      const double largest)
{
    double scaled[FB_AT_LEAST_1(N_C * N_U)];
    fb_dense_factors factors;
    fb_in_units(jacobian, units, scaled);
    return fb_dense_eliminate(scaled, &factors) != FB_OK ||
           fabs(fb_signed_pivot(jacobian, units, factors.column)) < FB_NEAR_SINGULAR_RATIO * largest;
}

#endif
