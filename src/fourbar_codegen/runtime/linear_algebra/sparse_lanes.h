/* The sparse equations of FB_WIDTH states; a lane whose factorization fails is not good. */
#ifndef FOURBAR_SPARSE_LANES_H
#define FOURBAR_SPARSE_LANES_H

#include "../arithmetic/array.h"
#include "../arithmetic/real.h"

enum { N_STEPS = N_U + N_C };

typedef struct fb_lane_factors {
    fb_mask good;
    fb_real entries[N_STEPS + N_BELOW]; /* the inverse of D, and L column by column */
    fb_real jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    fb_real weight[FB_AT_LEAST_1(N_C)];
} fb_lane_factors;

#define FB_VALUE fb_real
#define FB_FACTORS fb_lane_factors
#define FB_OF(name) name##_lanes
#define FB_ABS(value) fb_abs(value)
#define FB_SELECT(condition, yes, no) fb_select(condition, yes, no)
#define FB_REQUIRE(s, condition, status) (s)->good &= (condition)
#include "sparse_ldl.inc"

static FB_INLINE void fb_factor_lanes(const fb_real *restrict constants, const fb_real *restrict mass_matrix,
                                      const fb_real *restrict jacobian, fb_lane_factors *restrict s)
{
    (void)constants;
    s->good = (fb_mask)(fb_bits){0} == 0;
    fb_factor_ordered_lanes(mass_matrix, jacobian, s);
}

#define fb_solve_lanes fb_solve_ordered_lanes

#endif
