/* Gaussian elimination of small dense matrices of any size: with partial pivoting for a square one, with complete
 * pivoting for the rank and the unknowns of m equations. Matrices are stored row by row, and overwritten.
 */
#ifndef FOURBAR_ELIMINATION_H
#define FOURBAR_ELIMINATION_H

#include "../arithmetic/array.h"

#include <math.h>

static inline void fb_swap_double(double *a, double *b)
{
    const double c = *a;
    *a = *b;
    *b = c;
}

static inline void fb_swap_int(int *a, int *b)
{
    const int c = *a;
    *a = *b;
    *b = c;
}

/* Solves A x = b by Gaussian elimination with partial pivoting; A and b are overwritten. Returns 0 if A is singular:
 * a pivot is no larger than `least`. */
static inline int fb_eliminate_full(const int n, double *restrict a, double *restrict b, const double least)
{
    for (int k = 0; k < n; ++k) {
        int pivot = k;
        for (int i = k + 1; i < n; ++i)
            pivot = fabs(a[i * n + k]) > fabs(a[pivot * n + k]) ? i : pivot;
        if (!(fabs(a[pivot * n + k]) > least))
            return 0;
        for (int j = k; j < n && pivot != k; ++j)
            fb_swap_double(a + k * n + j, a + pivot * n + j);
        fb_swap_double(b + k, b + pivot);
        for (int i = k + 1; i < n; ++i) {
            const double factor = a[i * n + k] / a[k * n + k];
            for (int j = k + 1; j < n; ++j)
                a[i * n + j] -= factor * a[k * n + j];
            b[i] -= factor * b[k];
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        for (int j = k + 1; j < n; ++j)
            b[k] -= a[k * n + j] * b[j];
        b[k] /= a[k * n + k];
    }
    return 1;
}

/* Gaussian elimination with complete pivoting of m rows and n columns with k right-hand sides. Stops after n pivots, or
 * at one that is not above FB_CLOSURE_PIVOT_RATIO, and returns their number; the last one is stored. The unknowns, of
 * shape (n, k), solve the rows of the pivots; others are 0. */
static inline int fb_eliminate_rows(const int m, const int n, const int k, double *restrict a, double *restrict b,
                                    int *restrict order, double *restrict solution, double *last)
{
    for (int j = 0; j < n; ++j)
        order[j] = j;
    for (int j = 0; j < n * k; ++j)
        solution[j] = 0.0;
    int rank = 0;
    *last = n > 0 ? 0.0 : 1.0;
    for (int p = 0; p < n && p < m; ++p) {
        int row = p, column = p;
        for (int i = p; i < m; ++i)
            for (int j = p; j < n; ++j)
                if (fabs(a[i * n + j]) > fabs(a[row * n + column])) {
                    row = i;
                    column = j;
                }
        *last = fabs(a[row * n + column]);
        if (!(*last > FB_CLOSURE_PIVOT_RATIO))
            break;
        for (int j = 0; j < n && row != p; ++j)
            fb_swap_double(a + p * n + j, a + row * n + j);
        for (int j = 0; j < k && row != p; ++j)
            fb_swap_double(b + p * k + j, b + row * k + j);
        for (int i = 0; i < m && column != p; ++i)
            fb_swap_double(a + i * n + p, a + i * n + column);
        fb_swap_int(order + p, order + column);
        for (int i = p + 1; i < m; ++i) {
            const double factor = a[i * n + p] / a[p * n + p];
            for (int j = p; j < n; ++j)
                a[i * n + j] -= factor * a[p * n + j];
            for (int j = 0; j < k; ++j)
                b[i * k + j] -= factor * b[p * k + j];
        }
        rank = p + 1;
    }
    for (int p = rank - 1; p >= 0; --p)
        for (int j = 0; j < k; ++j) {
            double sum = b[p * k + j];
            for (int i = p + 1; i < rank; ++i)
                sum -= a[p * n + i] * solution[order[i] * k + j];
            solution[order[p] * k + j] = sum / a[p * n + p];
        }
    return rank;
}

/* Divides m rows and n columns, and a right-hand side, by their largest entries. */
static inline void fb_balance(const int m, const int n, double *restrict a, double *restrict b, double *restrict unit)
{
    for (int j = 0; j < n; ++j) {
        unit[j] = 0.0;
        for (int i = 0; i < m; ++i)
            unit[j] = fb_max(unit[j], fabs(a[i * n + j]));
    }
    for (int i = 0; i < m; ++i) {
        double size = 0.0;
        for (int j = 0; j < n; ++j) {
            a[i * n + j] /= unit[j] > 0.0 ? unit[j] : 1.0;
            size = fb_max(size, fabs(a[i * n + j]));
        }
        for (int j = 0; j < n && size > 0.0; ++j)
            a[i * n + j] /= size;
        b[i] /= size > 0.0 ? size : 1.0;
    }
}

#endif
