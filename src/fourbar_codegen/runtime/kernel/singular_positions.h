/* Singular positions, where J loses rank: found by the sign of the determinant of the dependent speeds' columns of J,
 * which changes there, and by the least pivot of J, which becomes zero.
 */
#ifndef FOURBAR_SINGULAR_POSITIONS_H
#define FOURBAR_SINGULAR_POSITIONS_H

#include "../linear_algebra/elimination.h"
#include "../linear_algebra/equations.h"
#include "../linear_algebra/units.h"
#ifndef FB_SPARSE
#include "../linear_algebra/signed_pivot.h"
#endif

/* What was seen of J in a run; zeroed before it. */
typedef struct fb_pivot_history {
    fb_units units;
#ifndef FB_SPARSE
    double jacobian[FB_AT_LEAST_1(N_JACOBIAN)]; /* at the last state */
    double signed_pivot;
    int was_static;
#endif
    double largest; /* of all signed pivots, in the present units; 0 before the first */
} fb_pivot_history;

/* Whether the sign of det J_d may have changed since the last state, or J is close to losing rank. */
static inline int fb_note_pivots(const double *restrict jacobian, fb_factors *restrict factors,
                                 fb_pivot_history *restrict h)
{
    int result = 0;
#ifndef FB_SPARSE
    if (N_C > 0 && N_RANK == N_C) {
        /* Near a pole of J, units grow without bound. */
        h->largest /= fb_note_units(jacobian, &h->units);
        const int *const columns = FB_FORM(columns)(jacobian, factors);
        if (columns == NULL)
            return 1;
        const double now = fb_signed_pivot(jacobian, &h->units, columns);
        result =
            fabs(now) < FB_NEAR_SINGULAR_RATIO * h->largest && fb_is_near_singular(jacobian, &h->units, h->largest);
        if (h->largest > 0.0) {
            /* It is known if both have the static pivot order. */
            const int known = FB_FORM(is_static)(factors) && h->was_static;
            result |= now * (known ? h->signed_pivot : fb_signed_pivot(h->jacobian, &h->units, columns)) < 0.0;
        }
        double changed = 0.0, size = 0.0;
        for (int i = 0; i < N_C; ++i)
            for (int j = 0; j < N_U; ++j) {
                const double entry = jacobian[i * N_U + j];
                const double unit = h->units.row[i] * h->units.column[j];
                if (unit > 0.0) {
                    changed += fabs(entry - h->jacobian[i * N_U + j]) / unit;
                    size += fabs(entry) / unit;
                }
                h->jacobian[i * N_U + j] = entry;
            }
        result |= h->largest > 0.0 && changed > size;
        h->signed_pivot = now;
        h->was_static = FB_FORM(is_static)(factors);
        h->largest = fb_max(fabs(now), h->largest);
    }
#else
    (void)jacobian, (void)factors, (void)h;
#endif
    return result;
}

/* The least pivot of J, in the units of its rows and columns in a run: zero where it loses rank, and not a number where
 * J is none. */
static inline double fb_least_pivot(const double t, const double *x, const double *constants, const double *r,
                                    const enum FB_LOOK look, fb_pivot_history *h)
{
    double jacobian[FB_AT_LEAST_1(N_C * N_U)], bias[FB_AT_LEAST_1(N_C)], least;
    int order[N_U];
    velocity(t, x, constants, r, jacobian, bias);
    if (all_finite(jacobian, N_C * N_U) != FB_OK)
        return NAN;
    if (look == FB_LOOK_FIRST)
        memset(h, 0, sizeof *h);
    if (look != FB_LOOK_ASIDE)
        h->largest /= fb_note_units(jacobian, &h->units);
    fb_in_units(jacobian, &h->units, jacobian);
    /* Those beyond the rank are rounding errors. */
    return fb_reduce_rows(N_C, N_U, 0, N_RANK, jacobian, bias, order, &least) < N_RANK ? 0.0 : least;
}

#endif
