/* The dense equations of FB_WIDTH states, with the static pivot order: a lane with too small pivots is not good. */
#ifndef FOURBAR_DENSE_LANES_H
#define FOURBAR_DENSE_LANES_H

#include "dense_equations.h"

/* Smallest ratio of a pivot to the sum of its row, which takes less time than the largest entry. The limit is lower
 * than in linear_algebra/dense_equations.h, at the cost of a digit or two, since all lanes wait if one needs other
 * pivots. */
#define FB_LANE_PIVOT_RATIO 0.01

typedef struct fb_lane_factors {
    fb_mask good;
    fb_real size[FB_AT_LEAST_1(N_C - N_RANK)]; /* the sums of the redundant rows of J */
    fb_real inverse[FB_AT_LEAST_1(N_C)];       /* 1 / the diagonal of U_d */
    fb_real lu[FB_AT_LEAST_1(N_C)][N_U];       /* L below the diagonal, U_d on and above it, then A */
    fb_real mass[N_U][N_U];                    /* Q^T M Q */
    fb_real reduced[N_U][N_U];                 /* T^T M T = L D L^T: L below the diagonal, 1/D on it */
} fb_lane_factors;

#define FB_VALUE fb_real
#define FB_SIDE fb_real
#define FB_FACTORS fb_lane_factors
#define FB_OF(name) name##_lanes
#define FB_REQUIRE(s, condition, status) (s)->good &= (condition)
#include "null_space.inc"

static FB_INLINE void fb_factor_lanes(const fb_real *restrict constants, const fb_real *restrict mass_matrix,
                                      const fb_real *restrict jacobian, fb_lane_factors *restrict s)
{
    (void)constants;
    fb_real size[FB_AT_LEAST_1(N_C)], sizes = fb_number(0.0);
    s->good = (fb_mask)(fb_bits){0} == 0;
    for (int i = 0; i < N_C; ++i) {
        size[i] = fb_number(0.0);
        for (int j = 0; j < N_U; ++j) {
            s->lu[i][j] = jacobian[static_pivot_row[i] * N_U + static_pivot_speed[j]];
            size[i] += fb_abs(s->lu[i][j]);
        }
        sizes += size[i];
    }
    for (int k = 0; k < N_RANK; ++k) {
        fb_real left = FB_NEAR_DEPENDENCE_RTOL * size[k];
        s->good &= size[k] > FB_NEAR_DEPENDENCE_RTOL * sizes;
        for (int j = k; j < N_U; ++j)
            left += fb_abs(s->lu[k][j]);
        s->good &= fb_abs(s->lu[k][k]) > FB_LANE_PIVOT_RATIO * left;
        fb_eliminate_below_lanes(s->lu, s->inverse, k);
    }
    /* Whether redundant rows may be larger, since loops are open, is decided for single states. */
    for (int i = N_RANK; i < N_C; ++i) {
        s->size[i - N_RANK] = size[i];
        for (int j = N_RANK; j < N_U; ++j)
            s->good &= fb_abs(s->lu[i][j]) <= FB_REDUNDANCY_RTOL / N_U * size[i];
    }
    fb_reduce_lanes(mass_matrix, s, static_pivot_speed);
}

/* u' for one right-hand side (f, gamma); NULL for f means zeros. A lane is not good if u' does not satisfy the
 * redundant constraints. */
static FB_INLINE void fb_solve_lanes(const fb_real *restrict forcing, const fb_real *restrict acceleration_bias,
                                     fb_lane_factors *restrict s, fb_real *restrict accelerations)
{
    fb_real w[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i) {
        w[i] = acceleration_bias[static_pivot_row[i]];
        for (int k = 0; k < i && k < N_RANK; ++k)
            w[i] -= s->lu[i][k] * w[k];
    }
    fb_back_lanes(forcing, w, s, accelerations, static_pivot_speed);
    if (N_RANK < N_C && forcing) {
        fb_real size = fb_number(0.0);
        for (int i = 0; i < N_U; ++i)
            size = fb_greater(fb_abs(accelerations[i]), size);
        for (int i = N_RANK; i < N_C; ++i)
            s->good &= fb_abs(w[i]) <= FB_DRIFT_RTOL * size * s->size[i - N_RANK] + FB_DRIFT_ATOL;
    }
}

/* The pivots of J; the factors have them. */
static FB_INLINE void fb_pivots_lanes(const fb_lane_factors *restrict s, fb_real *restrict pivots)
{
    for (int k = 0; k < N_C; ++k)
        pivots[k] = s->lu[k][k];
}

#endif
