/* Matrices of derivatives, and products with given directions, with a column in each of FB_SIMD_WIDTH lanes. */
#ifndef FOURBAR_COLUMNS_H
#define FOURBAR_COLUMNS_H

#include "../fourbar_kernel.h"
#include "real.h"

/* Derivatives of q' and of the residual along directions; `factors` are the derivatives' factors at a state. */
typedef void fb_columns_of(const double *constants, const double *factors, const fb_simd *direction, fb_simd *rates,
                           fb_simd *residual);

/* FB_SIMD_WIDTH columns from number `begin` on of a matrix with n columns, as far as it has them. */
static inline void fb_load_columns(const double *from, const int rows, const int n, const int begin, fb_simd *to)
{
    const int count = n - begin < FB_SIMD_WIDTH ? n - begin : FB_SIMD_WIDTH;
    for (int i = 0; i < rows; ++i, from += n)
        to[i] = count == FB_SIMD_WIDTH ? fb_load_simd(from + begin) : fb_load_some(from + begin, count);
}

/* The same the other way round. */
static inline void fb_store_columns(const fb_simd *from, const int rows, const int n, const int begin, double *to)
{
    const int count = n - begin < FB_SIMD_WIDTH ? n - begin : FB_SIMD_WIDTH;
    for (int i = 0; i < rows; ++i, to += n)
        if (count == FB_SIMD_WIDTH)
            fb_store_simd(from[i], to + begin);
        else
            fb_store_some(from[i], count, to + begin);
}

static inline void fb_fill_columns(fb_columns_of *columns, const double *constants, const double *factors, const int n,
                                   fb_simd *direction, const int n_rates, fb_simd *rates, const int n_residual,
                                   fb_simd *residual, double *rate_jacobian, double *residual_jacobian)
{
    for (int begin = 0; begin < n; begin += FB_SIMD_WIDTH) {
        for (int i = 0; i < n; ++i)
            direction[i] = fb_all(0.0);
        for (int lane = 0; lane < FB_SIMD_WIDTH && begin + lane < n; ++lane)
            fb_lane(direction[begin + lane], lane) = 1.0;
        columns(constants, factors, direction, rates, residual);
        fb_store_columns(rates, n_rates, n, begin, rate_jacobian);
        fb_store_columns(residual, n_residual, n, begin, residual_jacobian);
    }
}

/* The products of n directions, the columns of `directions` and of the results. */
static inline void fb_apply_columns(fb_columns_of *columns, const double *constants, const double *factors,
                                    const int size, fb_simd *direction, const int n, const double *directions,
                                    const int n_rates, fb_simd *rates, const int n_residual, fb_simd *residual,
                                    double *rate_changes, double *residual_changes)
{
    for (int begin = 0; begin < n; begin += FB_SIMD_WIDTH) {
        fb_load_columns(directions, size, n, begin, direction);
        columns(constants, factors, direction, rates, residual);
        fb_store_columns(rates, n_rates, n, begin, rate_changes);
        fb_store_columns(residual, n_residual, n, begin, residual_changes);
    }
}

#endif
