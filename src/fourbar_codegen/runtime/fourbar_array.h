/* Arrays whose lengths depend on the model: declared with one entry at least, since C has no arrays of length 0;
 * several in one block of memory; checked for infinities and NaN. Also tolerances of constraint violations. */
#ifndef FOURBAR_ARRAY_H
#define FOURBAR_ARRAY_H

#include "fourbar_kernel.h"

#include <math.h>
#include <stddef.h>

#define FB_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* Iterations of a projection with one factorization, and number of factorizations. */
enum { MAX_CORRECTIONS = 8, MAX_FACTORIZATIONS = 3 };
/* Tolerance of constraint violations relative to their scales, 45 times the precision of double, ... */
#define FB_CLOSURE_RTOL 1e-14
/* ... and the tolerance if rounding errors prevent further progress. */
#define FB_LOOSE_CLOSURE_RTOL 1e-9
/* Pivots below this fraction of the largest do not determine an unknown. */
#define FB_CLOSURE_PIVOT_RATIO 1e-10

/* Not fmax, which is a library call since it has to skip NaN. */
static inline double fb_max(double a, double b)
{
    return a > b ? a : b;
}

static inline int all_finite(const double *values, const int n)
{
    for (int i = 0; i < n; ++i)
        if (!isfinite(values[i]))
            return FB_NOT_FINITE;
    return FB_OK;
}

/* The largest of n violations relative to its scale; NaN if one is NaN. */
static inline double fb_violation(const double *restrict violations, const double *restrict scales, const int n)
{
    double largest = 0.0;
    for (int i = 0; i < n; ++i) {
        const double share = violations[i] == 0.0 ? 0.0 : fabs(violations[i]) / scales[i];
        if (!(share <= largest))
            largest = share;
        if (share != share)
            return share;
    }
    return largest;
}

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

/* An array and its length. */
typedef struct fb_place {
    double **array;
    int size;
} fb_place;

/* The total length of n arrays, which are placed in memory one after the other, unless that is NULL. */
static inline size_t fb_place_all(const fb_place *places, const size_t n, double *memory)
{
    size_t length = 0;
    for (size_t i = 0; i < n; ++i) {
        if (memory)
            *places[i].array = memory + length;
        length += (size_t)places[i].size;
    }
    return length;
}

#endif
