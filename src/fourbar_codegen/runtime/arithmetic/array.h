/* Arrays whose lengths depend on the model: declared with one entry at least, since C has no arrays of length 0;
 * several in one block of memory; checked for infinities and NaN. Also tolerances of constraint violations. */
#ifndef FOURBAR_ARRAY_H
#define FOURBAR_ARRAY_H

#include "../fourbar_kernel.h"

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

static inline double fb_min(const double a, const double b)
{
    return a < b ? a : b;
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
