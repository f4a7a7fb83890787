/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with products of M and M^-1 instead of M.
 *
 * The generated functions mass_solve and mass_product evaluate M^-1 v and M v by recursion over the bodies, with
 * factors that `dynamics` returns: N_U pivots, then what both functions take. mass_solve_simd and mass_product do so
 * for FB_SIMD_WIDTH vectors, one in each lane. With W = M^-1 J^T and A = J W,
 *
 *     lambda = -A^-1 (J M^-1 f + gamma),     u' = M^-1 f + W lambda,
 *
 * where one step of iterative refinement removes the errors of A^-1. The condition of A is the square of that of J. So
 * nothing about the rank of J is concluded from A: if a pivot of A is small, M is formed, and
 * linear_algebra/dense_equations.h solves the dense equations.
 *
 * Source: R. Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 8; iterative refinement: N. J. Higham,
 * Accuracy and Stability of Numerical Algorithms, 2nd ed. 2002, chapter 12.
 */
#ifndef FOURBAR_RECURSIVE_EQUATIONS_H
#define FOURBAR_RECURSIVE_EQUATIONS_H

#include "../arithmetic/array.h"
#include "../arithmetic/columns.h"
#include "../fourbar_kernel.h"
#include "dense_equations.h"

#include <string.h>

/* Right-hand sides, those of the constraints and then f, in the lanes of vectors. */
enum { N_GROUPS = (N_C + FB_SIMD_WIDTH) / FB_SIMD_WIDTH, N_LANES = N_GROUPS * FB_SIMD_WIDTH };

typedef struct fb_recursive_factors {
    const double *constants, *mass, *jacobian;  /* of the state */
    int is_dense;                               /* whether the dense factors are used */
    double response[N_U * N_LANES];             /* W and M^-1 f, in rows */
    double normal[FB_AT_LEAST_1(N_C)][N_LANES]; /* A = L D L^T: L below the diagonal, 1/D on it */
    fb_dense_factors dense;
} fb_recursive_factors;

#define FB_VALUE double
#define FB_SIDE double
#define FB_FACTORS fb_recursive_factors
#define FB_OF(name) name##_normal
#define FB_NORMAL_STRIDE N_LANES
#define FB_RESPONSE(s, j, i) (s)->response[(j) * N_LANES + (i)]
#define FB_REQUIRE(s, condition, status)                                                                               \
    if (!(condition))                                                                                                  \
    return status
#include "normal_equations.inc"

#if FB_SIMD_WIDTH > 1
#define FB_VALUE double
#define FB_SIDE fb_simd
#define FB_FACTORS fb_recursive_factors
#define FB_OF(name) name##_normal_simd
#define FB_SOLVE_ONLY
#include "normal_equations.inc"
#else
#define fb_constrain_normal_simd fb_constrain_normal
#endif

/* M, with a column in each lane. */
static FB_CALLED void fb_form_mass(const double *restrict constants, const double *restrict mass,
                                   double *restrict mass_matrix)
{
    for (int begin = 0; begin < N_U; begin += FB_SIMD_WIDTH) {
        const int count = N_U - begin < FB_SIMD_WIDTH ? N_U - begin : FB_SIMD_WIDTH;
        fb_simd speeds[N_U], product[N_U];
        for (int j = 0; j < N_U; ++j)
            speeds[j] = fb_all(0.0);
        for (int lane = 0; lane < count; ++lane)
            fb_lane(speeds[begin + lane], lane) = 1.0;
        mass_product(constants, mass, speeds, product);
        fb_store_columns(product, N_U, N_U, begin, mass_matrix);
    }
}

/* M, and J as it is. */
static inline void fb_recursive_fill(const double *constants, const double *restrict mass,
                                     const double *restrict jacobian, double *restrict mass_matrix,
                                     double *restrict constraint_jacobian)
{
    fb_form_mass(constants, mass + N_U, mass_matrix);
    memcpy(constraint_jacobian, jacobian, N_JACOBIAN * sizeof *jacobian);
}

/* Whether the pivots of M are larger than rounding errors of its diagonal, FB_ROW_RTOL. */
static FB_CALLED int fb_is_regular(const double *restrict constants, const double *restrict mass)
{
    double mass_matrix[N_U * N_U];
    fb_form_mass(constants, mass + N_U, mass_matrix);
    for (int i = 0; i < N_U; ++i)
        if (!(mass[i] > FB_ROW_RTOL * mass_matrix[i * N_U + i]))
            return 0;
    return 1;
}

/* W, M^-1 f and A. */
static FB_CALLED void fb_form_normal(const double *restrict forcing, fb_recursive_factors *restrict s)
{
    fb_simd unit[FB_SIMD_WIDTH];
    for (int lane = 0; lane < FB_SIMD_WIDTH; ++lane) {
        unit[lane] = fb_all(0.0);
        fb_lane(unit[lane], lane) = 1.0;
    }
    for (int group = 0; group < N_GROUPS; ++group) {
        fb_simd side[N_U], solution[N_U];
        const int begin = group * FB_SIMD_WIDTH, last = group == N_GROUPS - 1, n = last ? N_C - begin : FB_SIMD_WIDTH;
        /* Multiples of unit vectors: a load of what has just been stored in pieces would wait. */
        for (int j = 0; j < N_U; ++j)
            side[j] = last * forcing[j] * unit[last * n];
        for (int lane = 0; lane < n; ++lane)
            for (int j = 0; j < N_U; ++j)
                side[j] += s->jacobian[(begin + lane) * N_U + j] * unit[lane];
        mass_solve_simd(s->constants, s->mass + N_U, side, solution);
        for (int j = 0; j < N_U; ++j)
            fb_store_simd(solution[j], s->response + j * N_LANES + begin);
    }
    for (int i = 0; i < N_C; ++i)
        for (int begin = 0; begin <= i; begin += FB_SIMD_WIDTH) {
            fb_simd sum = s->jacobian[i * N_U] * fb_load_simd(s->response + begin);
            for (int j = 1; j < N_U; ++j)
                if (s->jacobian[i * N_U + j] != 0.0) /* a loop of a large tree moves few bodies */
                    sum += s->jacobian[i * N_U + j] * fb_load_simd(s->response + j * N_LANES + begin);
            fb_store_simd(sum, s->normal[i] + begin);
        }
}

static inline int fb_recursive_factor(const double *restrict mass, const double *restrict jacobian,
                                      const double *restrict forcing, fb_recursive_factors *restrict s)
{
    double smallest = INFINITY, largest = 0.0;
    s->mass = mass;
    s->jacobian = jacobian;
    s->is_dense = 0;
    for (int i = 0; i < N_U; ++i) {
        if (mass[i] != mass[i])
            return FB_NOT_FINITE;
        smallest = mass[i] < smallest ? mass[i] : smallest;
        largest = fb_max(mass[i], largest);
    }
    const int is_positive =
        smallest > FB_SUSPICIOUS_PIVOT_RATIO * largest || (smallest > 0.0 && fb_is_regular(s->constants, mass));
    if (N_C == 0)
        return is_positive ? FB_OK : FB_MASS_SINGULAR;
    if (all_finite(jacobian, N_JACOBIAN) != FB_OK)
        return FB_NOT_FINITE;
    /* With constraints, M itself may be singular. */
    if (is_positive)
        fb_form_normal(forcing, s);
    s->is_dense = !(is_positive && fb_factor_ldl_normal(s, s->normal[0], N_LANES, 0, N_C) == FB_OK);
    if (!s->is_dense)
        return FB_OK;
    double mass_matrix[N_U * N_U];
    fb_form_mass(s->constants, mass + N_U, mass_matrix);
    return fb_dense_factor(mass_matrix, jacobian, forcing, &s->dense);
}

/* The speeds that complete pivoting of J takes as dependent, first of all; NULL if J has lost rank. */
static inline const int *fb_recursive_columns(const double *restrict jacobian, fb_recursive_factors *restrict s)
{
    const int is_known = s->is_dense || fb_dense_eliminate(jacobian, &s->dense) == FB_OK;
    return is_known ? s->dense.column : NULL;
}

static inline fb_dense_factors *fb_recursive_dense(fb_recursive_factors *s)
{
    return &s->dense;
}

static inline int fb_recursive_is_static(const fb_recursive_factors *s)
{
    (void)s;
    return 0;
}

/* u' for one right-hand side (f, gamma). */
static inline int fb_recursive_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                                     const fb_recursive_factors *restrict s, double *restrict accelerations)
{
    if (s->is_dense)
        return fb_dense_solve(forcing, acceleration_bias, &s->dense, accelerations);
    mass_solve(s->constants, s->mass + N_U, forcing, accelerations);
    fb_constrain_normal(acceleration_bias, s, accelerations);
    return FB_OK;
}

/* The same for f as in `fb_recursive_factor`. */
static inline int fb_recursive_solve_first(const double *restrict forcing, const double *restrict acceleration_bias,
                                           const fb_recursive_factors *restrict s, double *restrict accelerations)
{
    if (N_C == 0 || s->is_dense)
        return fb_recursive_solve(forcing, acceleration_bias, s, accelerations);
    for (int j = 0; j < N_U; ++j)
        accelerations[j] = FB_RESPONSE(s, j, N_C);
    fb_constrain_normal(acceleration_bias, s, accelerations);
    return FB_OK;
}

/* u' for n right-hand sides (f, -gamma) in the columns of a matrix. */
static FB_CALLED void fb_recursive_solve_directions(const int n, const double *restrict sides,
                                                    const fb_recursive_factors *restrict s,
                                                    double *restrict accelerations)
{
    if (s->is_dense) {
        fb_dense_solve_directions(n, sides, &s->dense, accelerations);
        return;
    }
    for (int begin = 0; begin < n; begin += FB_SIMD_WIDTH) {
        fb_simd side[N_U + N_C], solution[N_U];
        fb_load_columns(sides, N_U + N_C, n, begin, side);
        mass_solve_simd(s->constants, s->mass + N_U, side, solution);
        for (int i = N_U; i < N_U + N_C; ++i)
            side[i] = -side[i];
        fb_constrain_normal_simd(side + N_U, s, solution);
        fb_store_columns(solution, N_U, n, begin, accelerations);
    }
}

/* The multipliers of J^T lambda = M u' - f: A lambda = W^T (M u' - f). */
static inline void fb_recursive_multipliers(const double *restrict mass, const double *restrict forcing,
                                            const double *restrict accelerations,
                                            const fb_recursive_factors *restrict s, double *restrict multipliers)
{
    double residual[N_U], left[N_U], v[FB_AT_LEAST_1(N_C)];
    fb_simd speeds[N_U], product[N_U];
    if (N_C == 0)
        return;
    for (int j = 0; j < N_U; ++j)
        speeds[j] = fb_all(accelerations[j]);
    mass_product(s->constants, mass + N_U, speeds, product);
    for (int j = 0; j < N_U; ++j)
        residual[j] = fb_lane(product[j], 0) - forcing[j];
    if (s->is_dense) {
        fb_dense_reactions(residual, &s->dense, multipliers);
        return;
    }
    for (int i = 0; i < N_C; ++i)
        multipliers[i] = 0.0;
    for (int refinement = 0; refinement < 2; ++refinement) {
        for (int j = 0; j < N_U; ++j) {
            left[j] = -residual[j];
            for (int i = 0; i < N_C; ++i)
                left[j] += s->jacobian[i * N_U + j] * multipliers[i];
        }
        for (int i = 0; i < N_C; ++i) {
            v[i] = 0.0;
            for (int j = 0; j < N_U; ++j)
                v[i] += FB_RESPONSE(s, j, i) * left[j];
        }
        fb_solve_ldl_normal(s->normal[0], N_LANES, 0, N_C, v);
        for (int i = 0; i < N_C; ++i)
            multipliers[i] -= v[i];
    }
}

#endif
