/* The sign of the determinant of the dependent speeds' columns of J, and its least pivot, in units of their own.
 */
#ifndef FOURBAR_SIGNED_PIVOT_H
#define FOURBAR_SIGNED_PIVOT_H

#include "dense_equations.h"

/* A singular position is nearby if the smallest pivot is below this fraction of its largest value in a run. That is
 * smaller than where positions count as singular, and larger than the gap between two branches that meet there, since
 * rounding errors of closed loops separate the branches by the square root of their size. */
#define FB_NEAR_SINGULAR_RATIO 1e-5

/* The units of J: the largest entries of its columns so far, and, in these units, of its rows. */
typedef struct fb_units {
    double column[N_U], row[FB_AT_LEAST_1(N_C)];
} fb_units;

/* Returns a bound of the factor by which quantities in units that were known before have become smaller. */
static inline double fb_note_units(const double *restrict jacobian, fb_units *restrict units)
{
    double by_columns = 1.0, by_rows = 1.0;
    for (int j = 0; j < N_U; ++j) {
        const double before = units->column[j];
        for (int i = 0; i < N_C; ++i)
            units->column[j] = fb_max(units->column[j], fabs(jacobian[i * N_U + j]));
        if (before > 0.0)
            by_columns = fb_max(by_columns, units->column[j] / before);
    }
    for (int i = 0; i < N_C; ++i) {
        const double before = units->row[i];
        for (int j = 0; j < N_U; ++j)
            if (fabs(jacobian[i * N_U + j]) > units->row[i] * units->column[j])
                units->row[i] = fabs(jacobian[i * N_U + j]) / units->column[j];
        if (before > 0.0)
            by_rows = fb_max(by_rows, units->row[i] / before);
    }
    return by_columns * by_rows;
}

/* J with its rows and columns in these units; zeros in those that are zero. */
static inline void fb_in_units(const double *jacobian, const fb_units *units, double *scaled)
{
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_U; ++j) {
            const double unit = units->row[i] * units->column[j];
            scaled[i * N_U + j] = unit > 0.0 ? jacobian[i * N_U + j] / unit : 0.0;
        }
}

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
