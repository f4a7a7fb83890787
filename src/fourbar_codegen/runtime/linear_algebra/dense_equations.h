/* Solves M u' = f + J^T lambda, J u' + gamma = 0 for the sizes N_U and N_C.
 *
 * The speeds are split into N_C dependent and the other, independent ones by Gaussian elimination of J with
 * complete pivoting: P S J Q = L [U_d U_i], S a scaling of the rows. With A = -U_d^-1 U_i, T = [A; 1] and
 * e = -U_d^-1 L^-1 P S gamma, every u' = T u_i' + [e; 0] satisfies the constraints, and T^T J^T = 0 leaves
 *
 *     (T^T M T) u_i' = T^T (f - M [e; 0]),
 *
 * symmetric and positive definite even if M alone is singular. Dependent speeds come first here.
 * u' does not depend on the split. A static pivot order, in the tables static_pivot_row and static_pivot_speed, is
 * fixed at code generation, so that indices are known at compile time. Where its pivots are too small, complete
 * pivoting is the fallback, so that toggle positions are harmless.
 */
#ifndef FOURBAR_DENSE_EQUATIONS_H
#define FOURBAR_DENSE_EQUATIONS_H

#include "../arithmetic/array.h"
#include "../arithmetic/real.h"
#include "../fourbar_kernel.h"
#include "elimination.h"

#include <math.h>

#ifndef FB_SPARSE
enum { N_JACOBIAN = N_C * N_U };
#ifndef FB_RECURSIVE
enum { N_MASS = N_U * N_U };
#endif
#endif

/* If the model has fewer dependent speeds than constraints, the others are redundant: after elimination, their rows of
 * the scaled J must vanish, and they must be satisfied, to this fraction of gamma and u', or of the terms of gamma,
 * which may cancel. They may be redundant only on the constraint manifold, from which a run drifts. */
#define FB_DRIFT_RTOL 1e-3
/* The absolute tolerance for that, for rounding errors if gamma and u' are zero. */
#define FB_DRIFT_ATOL 1e-12

/* Whether the static pivot order is tried first: with many constraints its code becomes long. */
#if defined(FB_RECURSIVE) || defined(FB_SPARSE) /* which come here only where pivots are small */
#define FB_TRY_STATIC 0
#else
#define FB_TRY_STATIC (N_C > 0 && N_C <= 8 && N_RANK == N_C)
#endif
/* The static pivot order is used if no row is below this fraction of the largest, and no pivot below this fraction of
 * its row's size before elimination. */
#define FB_NEAR_DEPENDENCE_RTOL 1e-6

/* The bound of redundant rows of J after elimination is FB_REDUNDANCY_RTOL for closed loops; for open loops, this
 * multiple of their violation is added. */
#define FB_OPEN_FACTOR 1e4

/* Without a mass matrix, a pivot of M below this fraction of the largest one, which may have another unit, is compared
 * with M: if M is singular, rounding errors decide about the sign of its pivots. */
#define FB_SUSPICIOUS_PIVOT_RATIO 1e-9

typedef struct fb_dense_factors {
    double left;                              /* largest entry of the scaled J in redundant rows */
    double terms;                             /* size of the terms of the scaled gamma, or 0 if it is not needed */
    int is_static;                            /* whether the pivot order is the static one */
    int row[FB_AT_LEAST_1(N_C)], column[N_U]; /* P, Q */
    double scale[FB_AT_LEAST_1(N_C)];         /* S, in the order of the rows of L */
    double inverse[FB_AT_LEAST_1(N_C)];       /* 1 / the diagonal of U_d */
    double lu[FB_AT_LEAST_1(N_C)][N_U];       /* L below the diagonal, U_d on and above it, then A */
    double mass[N_U][N_U];                    /* Q^T M Q */
    double reduced[N_U][N_U];                 /* T^T M T = L D L^T: L below the diagonal, 1/D on it */
} fb_dense_factors;

#define FB_VALUE double
#define FB_SIDE double
#define FB_FACTORS fb_dense_factors
#define FB_OF(name) name
#define FB_REQUIRE(s, condition, status)                                                                               \
    if (!(condition))                                                                                                  \
    return status
#include "null_space.inc"

/* P S J Q = L [U_d U_i]. */
static inline int fb_dense_eliminate(const double *restrict jacobian, fb_dense_factors *restrict s)
{
    double largest = 0.0;
    for (int j = 0; j < N_U; ++j)
        s->column[j] = j;
    for (int i = 0; i < N_C; ++i) {
        double size = 0.0;
        for (int j = 0; j < N_U; ++j)
            size = fb_max(size, fabs(jacobian[i * N_U + j]));
        s->scale[i] = size;
        largest = fb_max(largest, size);
    }
    for (int i = 0; i < N_C; ++i) {
        /* A row of rounding errors must not be scaled up to look like a constraint. */
        s->scale[i] = s->scale[i] > FB_ROW_RTOL * largest ? 1.0 / s->scale[i] : 0.0;
        s->row[i] = i;
        for (int j = 0; j < N_U; ++j)
            s->lu[i][j] = s->scale[i] * jacobian[i * N_U + j];
    }
    for (int k = 0; k < N_RANK; ++k) {
        int row, column;
        if (!(fb_pivot_completely(N_C, N_U, s->lu[0], k, &row, &column) > FB_ROW_RTOL))
            return FB_CONSTRAINTS_DEPENDENT;
        fb_swap_int(&s->row[k], &s->row[row]);
        fb_swap_double(&s->scale[k], &s->scale[row]);
        fb_swap_int(&s->column[k], &s->column[column]);
        fb_eliminate_below(s->lu, s->inverse, k);
    }
    s->left = s->terms = 0.0;
    for (int i = N_RANK; i < N_C; ++i)
        for (int j = N_RANK; j < N_U; ++j)
            s->left = fb_max(s->left, fabs(s->lu[i][j]));
    return s->left <= FB_DRIFT_RTOL ? FB_OK : FB_CONSTRAINTS_INDEPENDENT;
}

/* With all indices known, compilers that unroll loops early keep values in registers, which saves a tenth to a sixth of
 * an evaluation. */
#if defined(__clang__)
#define FB_UNROLL _Pragma("unroll(8)")
#elif defined(__GNUC__) && defined(__OPTIMIZE__)
#define FB_UNROLL _Pragma("GCC unroll 8")
#else
#define FB_UNROLL
#endif

/* P J Q = L [U_d U_i] by the static pivot order; returns whether its pivots are large enough. With a given order of
 * rows, and each pivot compared with its own row, no scaling is needed. */
static inline int fb_eliminate_static(const double *restrict jacobian, fb_dense_factors *restrict s)
{
    double lu[FB_AT_LEAST_1(N_C)][N_U], size[FB_AT_LEAST_1(N_C)], largest = 0.0;
    FB_UNROLL
    for (int i = 0; i < N_C; ++i) {
        size[i] = 0.0;
        FB_UNROLL
        for (int j = 0; j < N_U; ++j)
            size[i] = fb_max(size[i], fabs(jacobian[static_pivot_row[i] * N_U + j]));
        largest = fb_max(largest, size[i]);
    }
    FB_UNROLL
    for (int i = 0; i < N_C; ++i) {
        if (!(size[i] > FB_NEAR_DEPENDENCE_RTOL * largest))
            return 0;
        s->scale[i] = 1.0;
        FB_UNROLL
        for (int j = 0; j < N_U; ++j)
            lu[i][j] = jacobian[static_pivot_row[i] * N_U + static_pivot_speed[j]];
    }
    FB_UNROLL
    for (int k = 0; k < N_C; ++k) {
        double pivot = FB_NEAR_DEPENDENCE_RTOL * size[k];
        FB_UNROLL
        for (int j = k; j < N_U; ++j)
            pivot = fb_max(pivot, fabs(lu[k][j]));
        if (!(fabs(lu[k][k]) > FB_STATIC_PIVOT_RATIO * pivot))
            return 0;
        fb_eliminate_below(lu, s->inverse, k);
    }
    FB_UNROLL
    for (int i = 0; i < N_C; ++i) {
        s->row[i] = static_pivot_row[i];
        FB_UNROLL
        for (int j = 0; j < N_U; ++j)
            s->lu[i][j] = lu[i][j];
    }
    FB_UNROLL
    for (int j = 0; j < N_U; ++j)
        s->column[j] = static_pivot_speed[j];
    return 1;
}

/* w = L^-1 P S gamma; returns the size of P S gamma. */
static inline double fb_forward(const double *restrict acceleration_bias, const fb_dense_factors *restrict s,
                                double *restrict w, const int is_static)
{
    double size = 0.0;
    FB_UNROLL
    for (int i = 0; i < N_C; ++i) {
        w[i] = s->scale[i] * acceleration_bias[is_static ? static_pivot_row[i] : s->row[i]];
        if (N_RANK < N_C && s->scale[i] == 0.0)
            w[i] = acceleration_bias[s->row[i]];
        size = fb_max(size, fabs(w[i]));
        FB_UNROLL
        for (int k = 0; k < i && k < N_RANK; ++k)
            w[i] -= s->lu[i][k] * w[k];
    }
    return size;
}

/* The speeds that the factors take as dependent, first of all; and whether these are those of the static pivot order.
 */
static inline const int *fb_dense_columns(const double *restrict jacobian, fb_dense_factors *restrict s)
{
    (void)jacobian;
    return s->column;
}

static inline fb_dense_factors *fb_dense_dense(fb_dense_factors *s)
{
    return s;
}

static inline int fb_dense_is_static(const fb_dense_factors *s)
{
    return s->is_static;
}

/* The factors of M and J, for any number of right-hand sides. */
static inline int fb_dense_factor(const double *restrict mass_matrix, const double *restrict constraint_jacobian,
                                  const double *restrict forcing, fb_dense_factors *restrict s)
{
    (void)forcing;
    s->is_static = FB_TRY_STATIC && fb_eliminate_static(constraint_jacobian, s);
    if (s->is_static) {
        const int status = fb_reduce(mass_matrix, s, static_pivot_speed);
        return status == FB_OK || all_finite(constraint_jacobian, N_C * N_U) == FB_OK ? status : FB_NOT_FINITE;
    }
    if (all_finite(constraint_jacobian, N_C * N_U) != FB_OK)
        return FB_NOT_FINITE;
    const int status = fb_dense_eliminate(constraint_jacobian, s);
    return status == FB_OK ? fb_reduce(mass_matrix, s, s->column) : status;
}

/* u' for one right-hand side (f, gamma). */
static inline int fb_dense_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                                 const fb_dense_factors *restrict s, double *restrict accelerations)
{
    double w[FB_AT_LEAST_1(N_C)];
    if (FB_TRY_STATIC && s->is_static) {
        fb_forward(acceleration_bias, s, w, 1);
        fb_back(forcing, w, s, accelerations, static_pivot_speed);
        return FB_OK;
    }
    double size = fb_forward(acceleration_bias, s, w, 0);
    fb_back(forcing, w, s, accelerations, s->column);
    /* The rows beyond the rank must be satisfied by themselves. */
    for (int i = 0; i < N_U && N_RANK < N_C; ++i)
        size = fb_max(size, fabs(accelerations[i]));
    size = N_RANK < N_C ? fb_max(size, s->terms) : size;
    for (int i = N_RANK; i < N_C; ++i)
        if (!(fabs(w[i]) <= FB_DRIFT_RTOL * size + FB_DRIFT_ATOL))
            return FB_CONSTRAINTS_DEPENDENT;
    return FB_OK;
}

#ifndef FB_LANES
#include "../arithmetic/columns.h"
#define FB_VALUE double
#define FB_SIDE fb_simd
#define FB_FACTORS fb_dense_factors
#define FB_OF(name) name##_simd
#define FB_SOLVE_ONLY
#include "null_space.inc"

/* u' for right-hand sides f, -gamma by a pivot order; redundant rows hold in every direction in which the state can
 * move. */
static FB_INLINE void fb_solve_simd(const fb_simd *restrict forcing, const fb_simd *restrict given,
                                    const fb_dense_factors *restrict s, fb_simd *restrict solution, const int *rows,
                                    const int *columns)
{
    fb_simd w[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i) {
        w[i] = s->scale[i] * -given[rows[i]];
        for (int k = 0; k < i && k < N_RANK; ++k)
            w[i] -= s->lu[i][k] * w[k];
    }
    fb_back_simd(forcing, w, s, solution, columns);
}

/* The same in n columns of matrices. */
static FB_CALLED void fb_dense_solve_directions(const int n, const double *restrict sides,
                                                const fb_dense_factors *restrict s, double *restrict accelerations)
{
    for (int begin = 0; begin < n; begin += FB_SIMD_WIDTH) {
        fb_simd forcing[N_U], given[FB_AT_LEAST_1(N_C)], solution[N_U];
        fb_load_columns(sides, N_U, n, begin, forcing);
        fb_load_columns(sides + N_U * n, N_C, n, begin, given);
        if (FB_TRY_STATIC && s->is_static)
            fb_solve_simd(forcing, given, s, solution, static_pivot_row, static_pivot_speed);
        else
            fb_solve_simd(forcing, given, s, solution, s->row, s->column);
        fb_store_columns(solution, N_U, n, begin, accelerations);
    }
}
#endif

/* The same for f as in `fb_dense_factor`. */
static inline int fb_dense_solve_first(const double *restrict forcing, const double *restrict acceleration_bias,
                                       const fb_dense_factors *restrict s, double *restrict accelerations)
{
    return fb_dense_solve(forcing, acceleration_bias, s, accelerations);
}

/* The minimum-norm lambda with y = K^T lambda, K = S^-1 P^T L. With K = G U by elimination with row pivoting, it is
 * lambda = G (G^T G)^-1 U^-T y, where the entries of G are at most 1: in K^T K, what rows of small units add to those
 * of large ones would be rounded away. Redundant rows leave lambda undetermined; with full rank it is unique.
 *
 * Source: G. Peters, J. H. Wilkinson, "The least squares problem and pseudo-inverses", Computer Journal 13 (1970). */
static inline void fb_shortest(const fb_dense_factors *restrict s, const double *restrict y,
                               double *restrict multipliers)
{
    double k[FB_AT_LEAST_1(N_C)][FB_AT_LEAST_1(N_RANK)], normal[FB_AT_LEAST_1(N_RANK)][FB_AT_LEAST_1(N_RANK)];
    double z[FB_AT_LEAST_1(N_RANK)];
    int row[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i) {
        row[i] = s->row[i];
        for (int j = 0; j < N_RANK; ++j)
            k[i][j] = s->scale[i] == 0.0 || j > i ? 0.0 : (j == i ? 1.0 : s->lu[i][j]) / s->scale[i];
    }
    fb_factor_lu(N_C, N_RANK, k[0], NULL, row, 0.0);
    for (int j = 0; j < N_RANK; ++j) { /* z = U^-T y */
        z[j] = y[j];
        for (int i = 0; i < j; ++i)
            z[j] -= k[i][j] * z[i];
        z[j] /= k[j][j];
    }
    for (int j = 0; j < N_RANK; ++j) /* only G is left */
        for (int i = 0; i <= j; ++i)
            k[i][j] = i == j ? 1.0 : 0.0;
    for (int i = 0; i < N_RANK; ++i)
        for (int j = 0; j <= i; ++j) {
            normal[i][j] = 0.0;
            for (int m = 0; m < N_C; ++m)
                normal[i][j] += k[m][i] * k[m][j];
        }
    fb_factor_ldl(NULL, normal[0], FB_AT_LEAST_1(N_RANK), 0, N_RANK);
    fb_solve_ldl(normal[0], FB_AT_LEAST_1(N_RANK), 0, N_RANK, z);
    for (int i = 0; i < N_C; ++i) {
        double sum = 0.0;
        for (int j = 0; j < N_RANK; ++j)
            sum += k[i][j] * z[j];
        multipliers[row[i]] = sum;
    }
}

/* The multipliers of J_d^T lambda = (M u' - f)_d, given the right-hand side; the minimum-norm ones if rows are
 * redundant. */
static inline void fb_dense_reactions(const double *restrict side, const fb_dense_factors *restrict s,
                                      double *restrict multipliers)
{
    double y[FB_AT_LEAST_1(N_C)] = {0.0};
    for (int k = 0; k < N_RANK; ++k) {
        double sum = side[s->column[k]];
        for (int i = 0; i < k; ++i)
            sum -= s->lu[i][k] * y[i];
        y[k] = sum * s->inverse[k];
    }
    if (N_RANK < N_C) {
        fb_shortest(s, y, multipliers);
        return;
    }
    for (int k = N_C - 1; k >= 0; --k) {
        for (int i = k + 1; i < N_C; ++i)
            y[k] -= s->lu[i][k] * y[i];
        multipliers[s->row[k]] = s->scale[k] * y[k];
    }
}

/* The same, given u'. */
static inline void fb_dense_multipliers(const double *restrict mass_matrix, const double *restrict forcing,
                                        const double *restrict accelerations, const fb_dense_factors *restrict s,
                                        double *restrict multipliers)
{
    double side[N_U];
    for (int k = 0; k < N_RANK; ++k) {
        const int j = s->column[k];
        side[j] = -forcing[j];
        for (int i = 0; i < N_U; ++i)
            side[j] += mass_matrix[j * N_U + i] * accelerations[i];
    }
    fb_dense_reactions(side, s, multipliers);
}

#endif
