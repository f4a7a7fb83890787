/* Arrays whose lengths the model gives: C has none of length zero, and results are checked for being numbers. */
#ifndef FOURBAR_ARRAY_H
#define FOURBAR_ARRAY_H

#include "fourbar_kernel.h"

#include <math.h>

#define FB_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* Of the largest row of J: what a row of zeros may be off by. A row between this and where rows count is refused rather
 * than dropped, since it may be one in other units: constraints need units of like size. */
#define FB_ROW_OF_ZEROS 4e-15

static inline int all_finite(const double *values, const int n)
{
    for (int i = 0; i < n; ++i)
        if (!isfinite(values[i]))
            return FB_NOT_FINITE;
    return FB_OK;
}

#endif
