/* Units of the rows and columns of J, in which metres and radians, and constraints of any size, can be compared.
 */
#ifndef FOURBAR_UNITS_H
#define FOURBAR_UNITS_H

#include "elimination.h"

/* The units of J: the largest entries of its columns so far, and, in these units, of its rows. */
typedef struct fb_units {
    double column[N_U], row[FB_AT_LEAST_1(N_C)];
} fb_units;

/* Returns a bound of the factor by which quantities in units that were known before have become smaller. */
static inline double fb_note_units(const double *restrict jacobian, fb_units *restrict units)
{
    double by_columns = 1.0, by_rows = 1.0;
    for (int j = 0; j < N_U; ++j) {
        const double before = units->column[j];
        for (int i = 0; i < N_C; ++i)
            units->column[j] = fb_max(units->column[j], fabs(jacobian[i * N_U + j]));
        if (before > 0.0)
            by_columns = fb_max(by_columns, units->column[j] / before);
    }
    for (int i = 0; i < N_C; ++i) {
        const double before = units->row[i];
        for (int j = 0; j < N_U; ++j)
            if (fabs(jacobian[i * N_U + j]) > units->row[i] * units->column[j])
                units->row[i] = fabs(jacobian[i * N_U + j]) / units->column[j];
        if (before > 0.0)
            by_rows = fb_max(by_rows, units->row[i] / before);
    }
    return by_columns * by_rows;
}

/* J with its rows and columns in these units; zeros in those that are zero. */
static inline void fb_in_units(const double *jacobian, const fb_units *units, double *scaled)
{
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_U; ++j) {
            const double unit = units->row[i] * units->column[j];
            scaled[i * N_U + j] = unit > 0.0 ? jacobian[i * N_U + j] / unit : 0.0;
        }
}

#endif
