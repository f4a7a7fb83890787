/* Solves M u' = f + J^T lambda, J u' + gamma = 0 with sparse M and J.
 *
 * With a weight w > 0 for each constraint, u' and lambda solve
 *
 *     [M + J^T w J   J^T] [  u'   ]   [f - J^T w gamma]
 *     [     J         0 ] [-lambda] = [    -gamma     ]
 *
 * The matrix is factored as L D L^T in an order that was fixed at code generation. No pivoting is needed: the upper
 * left block is positive definite wherever the equations determine u', and each constraint comes after all speeds in
 * it. If the factorization fails, the constraints are dependent at this state.
 *
 * Included once, by fourbar_model.h, after the tables of the model:
 *   mass_row, mass_column         rows and columns of the entries of M on and below the diagonal
 *   jacobian_row, jacobian_column the entries of J: the first of each row, and the columns
 *   unknown                       the unknown of each step: speeds, then N_U and more for constraints
 *   column, below                 the later steps with an entry in a step's column: the first of them, and all
 *   mass_place, jacobian_place, pair_place, target
 *                                 places of M, J, the products of J^T w J, and of what a step subtracts
 */
#ifndef FOURBAR_SPARSE_H
#define FOURBAR_SPARSE_H

#include "fourbar_array.h"
#include "fourbar_kernel.h"

#include <math.h>

enum { N_STEPS = N_U + N_C };

/* Rows of J below this fraction of the largest are rounding errors. */
#define FB_ROW_TOLERANCE 2e-13
/* Pivots below this fraction of the terms subtracted from them are rounding errors. */
#define FB_PIVOT_TOLERANCE 1e-13

typedef struct fb_factors {
    double entries[N_STEPS + N_BELOW]; /* the inverse of D, and L column by column */
    double jacobian[FB_AT_LEAST_1(N_JACOBIAN)];
    double weight[FB_AT_LEAST_1(N_C)];
} fb_factors;

/* The weights, which give both terms of M + J^T w J similar size; returns 0 if a row is only rounding errors. */
static inline int fb_weigh(const double *restrict diagonal, const double *restrict jacobian, double *restrict weight)
{
    double size[FB_AT_LEAST_1(N_C)], largest = 0.0;
    int all_count = 1;
    for (int row = 0; row < N_C; ++row) {
        size[row] = 0.0;
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            size[row] += jacobian[i] * jacobian[i];
        largest = size[row] > largest ? size[row] : largest;
    }
    for (int row = 0; row < N_C; ++row) {
        double mass = 0.0;
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            mass += diagonal[jacobian_column[i]];
        all_count &= size[row] > FB_ROW_TOLERANCE * FB_ROW_TOLERANCE * largest;
        weight[row] = (mass > 0.0 ? mass : 1.0) / size[row];
    }
    return all_count;
}

static inline int fb_factor(const double *restrict mass_matrix, const double *restrict constraint_jacobian,
                            fb_factors *restrict s)
{
    if (all_finite(constraint_jacobian, N_JACOBIAN) != FB_OK)
        return FB_NOT_FINITE;
    double *restrict const entries = s->entries;
    double diagonal[N_U] = {0.0}, size[N_STEPS];
    for (int i = 0; i < N_STEPS + N_BELOW; ++i)
        entries[i] = 0.0;
    for (int i = 0; i < N_MASS; ++i) {
        entries[mass_place[i]] += mass_matrix[i];
        if (mass_row[i] == mass_column[i])
            diagonal[mass_row[i]] = mass_matrix[i];
    }
    if (!fb_weigh(diagonal, constraint_jacobian, s->weight))
        return FB_CONSTRAINTS_DEPENDENT;
    for (int row = 0, pair = 0; row < N_C; ++row) {
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i) {
            s->jacobian[i] = constraint_jacobian[i];
            entries[jacobian_place[i]] = constraint_jacobian[i];
            const double weighted = s->weight[row] * constraint_jacobian[i];
            for (int j = jacobian_row[row]; j <= i; ++j)
                entries[pair_place[pair++]] += weighted * constraint_jacobian[j];
        }
    }
    for (int k = 0; k < N_STEPS; ++k)
        size[k] = fabs(entries[k]);
    for (int k = 0, next = 0; k < N_STEPS; ++k) {
        const double pivot = unknown[k] < N_U ? entries[k] : -entries[k];
        if (!(pivot > FB_PIVOT_TOLERANCE * size[k]))
            return unknown[k] < N_U ? FB_MASS_SINGULAR : FB_CONSTRAINTS_DEPENDENT;
        const double inverse = entries[k] = 1.0 / entries[k];
        double *restrict const l = entries + N_STEPS + column[k];
        const int *restrict const later = below + column[k];
        for (int i = column[k + 1] - column[k] - 1; i >= 0; --i) {
            const double scaled = l[i] * inverse;
            size[later[i]] += fabs(scaled * l[i]);
            for (int j = 0; j <= i; ++j)
                entries[target[next++]] -= scaled * l[j];
            l[i] = scaled;
        }
    }
    return FB_OK;
}

/* The unknowns for right-hand sides in the order of the steps. */
static inline void fb_substitute(const fb_factors *restrict s, double *restrict y)
{
    const double *restrict const l = s->entries + N_STEPS;
    for (int k = 0; k < N_STEPS; ++k) {
        for (int i = column[k]; i < column[k + 1]; ++i)
            y[below[i]] -= l[i] * y[k];
        y[k] *= s->entries[k];
    }
    for (int k = N_STEPS - 1; k >= 0; --k)
        for (int i = column[k]; i < column[k + 1]; ++i)
            y[k] -= l[i] * y[below[i]];
}

/* u' for one right-hand side (f, gamma). */
static inline int fb_solve(const double *restrict forcing, const double *restrict acceleration_bias,
                           const fb_factors *restrict s, double *restrict accelerations)
{
    double side[N_STEPS], y[N_STEPS];
    for (int i = 0; i < N_U; ++i)
        side[i] = forcing[i];
    for (int row = 0; row < N_C; ++row) {
        side[N_U + row] = -acceleration_bias[row];
        for (int i = jacobian_row[row]; i < jacobian_row[row + 1]; ++i)
            side[jacobian_column[i]] -= s->jacobian[i] * s->weight[row] * acceleration_bias[row];
    }
    for (int k = 0; k < N_STEPS; ++k)
        y[k] = side[unknown[k]];
    fb_substitute(s, y);
    for (int k = 0; k < N_STEPS; ++k)
        if (unknown[k] < N_U)
            accelerations[unknown[k]] = y[k];
    return FB_OK;
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
