/* Arrays whose lengths the model gives: C has none of length zero, and results are checked for being numbers. */
#ifndef FOURBAR_ARRAY_H
#define FOURBAR_ARRAY_H

#include "fourbar_kernel.h"

#include <math.h>

#define FB_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* Of the largest row of J: what a row of zeros may be off by. A row between this and where rows count is refused rather
 * than dropped, since it may be one in other units: constraints need units of like size. */
#define FB_ROW_OF_ZEROS 4e-15

/* Corrections of a projection that are tried with one factorization, and factorizations. */
enum { CORRECTIONS = 8, FACTORIZATIONS = 3 };
/* A state is on the constraints where they are violated by no more than this share of the coordinates or speeds, ... */
#define FB_CLOSED 1e-13
/* ... or where rounding errors allow no better, by no more than this one. */
#define FB_NEARLY_CLOSED 1e-9

static inline int all_finite(const double *values, const int n)
{
    for (int i = 0; i < n; ++i)
        if (!isfinite(values[i]))
            return FB_NOT_FINITE;
    return FB_OK;
}

#endif
