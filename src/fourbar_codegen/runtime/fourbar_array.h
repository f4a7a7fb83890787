/* Arrays whose lengths the model gives: C has none of length zero, and results are checked for being numbers. */
#ifndef FOURBAR_ARRAY_H
#define FOURBAR_ARRAY_H

#include "fourbar_kernel.h"

#include <math.h>

#define FB_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

static inline int all_finite(const double *values, const int n)
{
    for (int i = 0; i < n; ++i)
        if (!isfinite(values[i]))
            return FB_NOT_FINITE;
    return FB_OK;
}

#endif
