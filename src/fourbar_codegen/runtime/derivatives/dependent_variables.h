/* Dependent coordinates and speeds near a state: by how much they violate the constraints, and their implicit
 * derivatives with respect to the independent ones, parameters and inputs.
 *
 * For dependent q_d, u_d, and derivatives of the constraint violations w and J u + b along directions,
 *
 *     w_qd [dq_d, c_q] = -[dw, w],    J_ud [du_d, c_u] = -[d(J u + b), J u + b] - (J u + b)_qd [dq_d, c_q].
 *
 * The last column, c, is a step of Newton's method for the state itself. Constraints may be redundant.
 */
#ifndef FOURBAR_DEPENDENT_VARIABLES_H
#define FOURBAR_DEPENDENT_VARIABLES_H

#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"
#include "../linear_algebra/elimination.h"

#include <string.h>

enum FB_DEPENDENT { FB_DETERMINED = 0, FB_COORDINATES_UNDETERMINED = 1, FB_SPEEDS_UNDETERMINED = 2 };

typedef struct fb_dependent {
    int n_qd, n_ud, n; /* the numbers of dependent coordinates and speeds, and of directions */
    /* (n_x + n_p + n_r, n_qd + n_ud + n): directions in the last n columns. The rows of dependent values are filled
     * there, and those columns before are scratch. */
    double *directions;
    double *corrections; /* (n_qd + n_ud,): c */
    double pivot;        /* the least one, as a fraction of the largest */
    double *left;        /* (n + 1,): the largest of what redundant rows violate, relative to their entries */
    /* scratch, for n_d the larger number of dependent values: */
    double *block;    /* (n_x + n_p + n_r, FB_DIRECTIONS) */
    double *of_block; /* (2 n_c + n_i, FB_DIRECTIONS) */
    double *changes;  /* (2 n_c + n_i, n_qd + n_ud + n + 1) */
    double *size;     /* (n_c + n_i,) */
    double *matrix;   /* (n_c + n_i, n_d) */
    double *sides;    /* (n_c + n_i, n + 1) */
    double *solution; /* (n_d, n + 1) */
    int *order;       /* (max(n_qd, n_ud),), of who calls */
} fb_dependent;

/* Places the arrays in memory, unless that is NULL; returns their number of doubles. */
static inline size_t fb_place_dependent(const fb_kernel *k, fb_dependent *f, double *memory)
{
    const int rows = k->n_x + k->n_p + k->n_r, columns = f->n_qd + f->n_ud + f->n;
    const int n_d = f->n_qd > f->n_ud ? f->n_qd : f->n_ud, n_p = k->n_c + k->n_i;
    const fb_place places[] = {
        {&f->directions, rows * columns},
        {&f->corrections, f->n_qd + f->n_ud},
        {&f->left, f->n + 1},
        {&f->block, rows * FB_DIRECTIONS},
        {&f->of_block, (n_p + k->n_c) * FB_DIRECTIONS},
        {&f->changes, (n_p + k->n_c) * (columns + 1)},
        {&f->size, n_p},
        {&f->matrix, n_p * n_d},
        {&f->sides, n_p * (f->n + 1)},
        {&f->solution, n_d * (f->n + 1)},
    };
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

/* The dependent values' changes in `solution`, for the rows of `changes` from `first` on, whose unknowns are n_d
 * columns from `column` on; whether they are determined. Rows are scaled by their largest entries; rows of rounding
 * errors are left out. */
static inline int fb_solve_dependent(fb_dependent *f, const int first, const int n_rows, const int column,
                                     const int n_d)
{
    const int columns = f->n_qd + f->n_ud + f->n + 1, n = f->n + 1;
    double largest_row = 0.0, largest = 0.0, last;
    for (int i = 0; i < n_rows; ++i) {
        const double *const row = f->changes + (first + i) * columns;
        f->size[i] = 0.0;
        for (int j = 0; j < n_d; ++j)
            f->size[i] = fb_max(f->size[i], fabs(row[column + j]));
        for (int j = 0; j < f->n; ++j)
            f->size[i] = fb_max(f->size[i], fabs(row[columns - n + j]));
        largest_row = fb_max(largest_row, f->size[i]);
    }
    for (int i = 0; i < n_rows; ++i) {
        const double *const row = f->changes + (first + i) * columns;
        const double unit = f->size[i] > FB_ROW_RTOL * largest_row ? 1.0 / f->size[i] : 0.0;
        for (int j = 0; j < n_d; ++j) {
            f->matrix[i * n_d + j] = unit * row[column + j];
            largest = fb_max(largest, fabs(f->matrix[i * n_d + j]));
        }
        for (int j = 0; j < n; ++j)
            f->sides[i * n + j] = -unit * row[columns - n + j];
    }
    for (int i = 0; i < n_rows * n_d && largest > 0.0; ++i)
        f->matrix[i] /= largest;
    const int rank = fb_eliminate_rows(n_rows, n_d, n, f->matrix, f->sides, f->order, f->solution, &last);
    f->pivot = last < f->pivot ? last : f->pivot;
    for (int i = 0; i < n_d * n; ++i)
        f->solution[i] /= largest;
    for (int i = n_d; i < n_rows; ++i)
        for (int j = 0; j < n; ++j)
            f->left[j] = fb_max(f->left[j], fabs(f->sides[i * n + j]));
    return rank == n_d && last > FB_DETERMINED_RATIO && all_finite(f->solution, n_d * n) == FB_OK;
}

/* Stores the changes of values from `row` of the state on. */
static inline void fb_store_dependent(fb_dependent *f, const int row, const int n_d, double *corrections)
{
    const int columns = f->n_qd + f->n_ud + f->n;
    for (int i = 0; i < n_d; ++i) {
        memcpy(f->directions + (row + i) * columns + columns - f->n, f->solution + i * (f->n + 1),
               (size_t)f->n * sizeof(double));
        corrections[i] = f->solution[i * (f->n + 1) + f->n];
    }
}

/* Fills the dependent rows of directions; an FB_DEPENDENT. */
static inline int fb_implicit_derivatives(const fb_kernel *k, const double t, const double *x, const double *constants,
                                          const double *r, fb_dependent *f)
{
    const int rows = k->n_x + k->n_p + k->n_r, columns = f->n_qd + f->n_ud + f->n;
    const int n_p = k->n_c + k->n_i, q_d = k->n_q - f->n_qd, u_d = k->n_q + k->n_u - f->n_ud;
    double *const of_block = f->of_block, *const velocities = of_block + n_p * FB_DIRECTIONS;
    f->pivot = 1.0;
    memset(f->corrections, 0, (size_t)(f->n_qd + f->n_ud) * sizeof(double));
    memset(f->left, 0, (size_t)(f->n + 1) * sizeof(double));
    for (int i = 0; i < rows; ++i)
        memset(f->directions + i * columns, 0, (size_t)(f->n_qd + f->n_ud) * sizeof(double));
    for (int i = 0; i < f->n_qd; ++i)
        f->directions[(q_d + i) * columns + i] = 1.0;
    for (int i = 0; i < f->n_ud; ++i)
        f->directions[(u_d + i) * columns + f->n_qd + i] = 1.0;
    for (int begin = 0; begin < columns; begin += FB_DIRECTIONS) {
        const int n = columns - begin < FB_DIRECTIONS ? columns - begin : FB_DIRECTIONS;
        for (int i = 0; i < rows; ++i)
            memcpy(f->block + i * n, f->directions + i * columns + begin, (size_t)n * sizeof(double));
        const fb_at at = {t, x, constants, r, NULL, NULL, n};
        const double *const directions[] = {f->block};
        double *const products[] = {of_block, velocities};
        k->functions[FB_CONSTRAINT_JVP].call(&at, directions, products, NULL);
        for (int i = 0; i < n_p; ++i)
            memcpy(f->changes + i * (columns + 1) + begin, of_block + i * n, (size_t)n * sizeof(double));
        for (int i = 0; i < k->n_c; ++i)
            memcpy(f->changes + (n_p + i) * (columns + 1) + begin, velocities + i * n, (size_t)n * sizeof(double));
    }
    k->constraint_violation(t, x, constants, r, of_block, velocities);
    for (int i = 0; i < n_p; ++i)
        f->changes[i * (columns + 1) + columns] = of_block[i];
    for (int i = 0; i < k->n_c; ++i)
        f->changes[(n_p + i) * (columns + 1) + columns] = velocities[i];
    if (f->n_qd > 0) {
        if (!fb_solve_dependent(f, 0, n_p, 0, f->n_qd))
            return FB_COORDINATES_UNDETERMINED;
        fb_store_dependent(f, q_d, f->n_qd, f->corrections);
        for (int i = n_p; i < n_p + k->n_c; ++i)
            for (int j = 0; j < f->n_qd; ++j)
                for (int l = 0; l <= f->n; ++l)
                    f->changes[i * (columns + 1) + columns - f->n + l] +=
                        f->changes[i * (columns + 1) + j] * f->solution[j * (f->n + 1) + l];
    }
    if (f->n_ud > 0) {
        if (!fb_solve_dependent(f, n_p, k->n_c, f->n_qd, f->n_ud))
            return FB_SPEEDS_UNDETERMINED;
        fb_store_dependent(f, u_d, f->n_ud, f->corrections + f->n_qd);
    }
    return FB_DETERMINED;
}

#endif
