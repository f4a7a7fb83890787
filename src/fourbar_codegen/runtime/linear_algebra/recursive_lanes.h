/* The equations of FB_WIDTH states with products of M^-1; a lane whose factors are not accurate is not good. */
#ifndef FOURBAR_RECURSIVE_LANES_H
#define FOURBAR_RECURSIVE_LANES_H

#include "dense_equations.h"

typedef struct fb_lane_factors {
    fb_mask good;
    const fb_real *constants, *mass, *jacobian;
    fb_real response[FB_AT_LEAST_1(N_U * N_C)];             /* W */
    fb_real normal[FB_AT_LEAST_1(N_C)][FB_AT_LEAST_1(N_C)]; /* A = L D L^T: L below the diagonal, 1/D on it */
} fb_lane_factors;

#define FB_VALUE fb_real
#define FB_SIDE fb_real
#define FB_FACTORS fb_lane_factors
#define FB_OF(name) name##_lanes
#define FB_REQUIRE(s, condition, status) (s)->good &= (condition)
#define FB_NORMAL_STRIDE FB_AT_LEAST_1(N_C)
#define FB_RESPONSE(s, j, i) (s)->response[(j) * N_C + (i)]
#include "dense_lu.inc"
#include "normal_equations.inc"

static FB_INLINE void fb_factor_lanes(const fb_real *restrict constants, const fb_real *restrict mass,
                                      const fb_real *restrict jacobian, fb_lane_factors *restrict s)
{
    s->good = (fb_mask)(fb_bits){0} == 0;
    s->constants = constants;
    s->mass = mass;
    s->jacobian = jacobian;
    fb_real largest = mass[0];
    for (int i = 1; i < N_U; ++i)
        largest = fb_greater(mass[i], largest);
    for (int i = 0; i < N_U; ++i)
        s->good &= (mass[i] > 0.0) & (mass[i] > FB_SUSPICIOUS_PIVOT_RATIO * largest);
    for (int k = 0; k < N_C; ++k) {
        fb_real column[N_U];
        mass_solve(constants, mass + N_U, jacobian + k * N_U, column);
        for (int j = 0; j < N_U; ++j)
            s->response[j * N_C + k] = column[j];
    }
    for (int i = 0; i < N_C; ++i)
        for (int k = 0; k <= i; ++k) {
            s->normal[i][k] = fb_number(0.0);
            for (int j = 0; j < N_U; ++j)
                s->normal[i][k] += jacobian[i * N_U + j] * s->response[j * N_C + k];
        }
    fb_factor_ldl_lanes(s, s->normal[0], FB_NORMAL_STRIDE, 0, N_C);
}

/* u' for one right-hand side (f, gamma); NULL for f means zeros. */
static FB_INLINE void fb_solve_lanes(const fb_real *restrict forcing, const fb_real *restrict acceleration_bias,
                                     const fb_lane_factors *restrict s, fb_real *restrict accelerations)
{
    if (forcing)
        mass_solve(s->constants, s->mass + N_U, forcing, accelerations);
    else
        for (int j = 0; j < N_U; ++j)
            accelerations[j] = fb_number(0.0);
    fb_constrain_lanes(acceleration_bias, s, accelerations);
}

/* The pivots of J in the static pivot order, which is only a way to find the sign of det J_d. */
static inline void fb_pivots_lanes(const fb_lane_factors *restrict s, fb_real *restrict pivots)
{
    fb_real lu[FB_AT_LEAST_1(N_C)][N_U], inverse[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_U; ++j)
            lu[i][j] = s->jacobian[static_pivot_row[i] * N_U + static_pivot_speed[j]];
    for (int k = 0; k < N_C; ++k) {
        pivots[k] = lu[k][k];
        fb_eliminate_below_lanes(lu, inverse, k);
    }
}

#endif
