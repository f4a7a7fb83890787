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
#define FB_CLOSED 1e-14
/* ... and the tolerance if rounding errors prevent further progress. */
#define FB_NEARLY_CLOSED 1e-9

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
