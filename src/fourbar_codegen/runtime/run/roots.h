/* All changes of sign of a function along a step, which is known by a Chebyshev series.
 *
 * A piece of the series has no root if |c_0| > |c_1| + ... + |c_n|, since |T_k| <= 1; by the same test of its
 * derivative it is monotone, and has a root if the signs at its ends differ. Other pieces are halved, until they are
 * zero to within the error of the series.
 */
#ifndef FOURBAR_ROOTS_H
#define FOURBAR_ROOTS_H

#include "../arithmetic/chebyshev.h"

#include <float.h>
#include <stdint.h>

/* Pieces are not halved more often: their ends are then neighbouring numbers. */
enum { FB_MOST_HALVINGS = 50 };

/* Of solving for a root: more than bisection needs. */
enum { FB_MOST_ITERATIONS = 200 };

/* The most changes of sign of a series and of its value at the beginning. */
enum { FB_MOST_CROSSINGS = FB_MOST_DEGREE + 2 };

/* A series, and the error of its values. */
typedef struct fb_series {
    int n;
    double c[FB_MOST_DEGREE + 1], error;
} fb_series;

/* The function changes its sign between two places, -1 <= low <= high <= 1: to this one. */
typedef struct fb_crossing {
    double low, high;
    int sign;
} fb_crossing;

/* A walk along a step, over places at which the sign is known. */
typedef struct fb_walk {
    int sign, counts; /* the last sign, 0 before the first one; whether that is a change of sign */
    double threshold;
    double from;    /* the place of the last sign */
    int doubtful;   /* whether the function has been zero since then, to within its error */
    double doubt;   /* where it was */
    double touched; /* where it was, and then had the same sign as before; or NaN */
    int n;
    fb_crossing found[FB_MOST_CROSSINGS];
} fb_walk;

/* Begins at y = -1 with the last sign; `counts` is whether a first sign is a change of it. Values up to the threshold
 * have no sign. */
static inline void fb_begin_walk(fb_walk *w, const int sign, const int counts, const double threshold)
{
    w->sign = sign;
    w->counts = counts;
    w->threshold = threshold;
    w->from = -1.0;
    w->doubtful = w->n = 0;
    w->touched = NAN;
}

/* Takes note of a value, whose sign is known if it is larger than its error. */
static inline void fb_walk_to(fb_walk *w, const double y, const double value, const double error)
{
    if (fabs(value) <= error) {
        w->doubtful = 1;
        w->doubt = y;
    }
    if (!(fabs(value) > fmax(error, w->threshold))) /* also if it is NaN */
        return;
    const int sign = value > 0.0 ? 1 : -1;
    const int is_first = w->sign == 0;
    if ((is_first ? w->counts && w->doubtful : sign != w->sign) && w->n < FB_MOST_CROSSINGS)
        w->found[w->n++] = (fb_crossing){w->from, is_first ? w->from : y, sign};
    else if (!is_first && w->doubtful)
        w->touched = w->doubt;
    w->sign = sign;
    w->from = y;
    w->doubtful = 0;
}

/* Walks along a series, between its ends. */
static inline void fb_walk_along(fb_walk *w, const fb_series *series)
{
    double values[FB_MOST_DEGREE + 1], slope[FB_MOST_DEGREE + 1], piece[FB_MOST_DEGREE + 1];
    const int n = series->n;
    int64_t place = 0; /* of the piece, in lengths of it */
    int halvings = 0;
    do {
        const double length = ldexp(2.0, -halvings), low = -1.0 + (double)place * length;
        for (int j = 0; j <= n; ++j)
            values[j] = fb_chebyshev_value(n, series->c, low + 0.5 * length * (1.0 + fb_chebyshev_point(n, j)));
        fb_chebyshev_fit(n, values, piece);
        fb_chebyshev_slope(n, piece, slope);
        const double range = fb_chebyshev_range(n, piece);
        const int excluded = fabs(piece[0]) > range + series->error;
        const int unknown = range <= series->error || halvings == FB_MOST_HALVINGS;
        if (!excluded && !unknown && !(fabs(slope[0]) > fb_chebyshev_range(n - 1, slope))) {
            place *= 2;
            halvings += 1;
            continue;
        }
        if (!excluded && unknown)
            fb_walk_to(w, low + 0.5 * length, 0.0, 0.0);
        if (low + length < 1.0)
            fb_walk_to(w, low + length, values[0], series->error);
        for (place += 1; halvings > 0 && place % 2 == 0; place /= 2)
            halvings -= 1;
    } while (halvings > 0 || place == 0);
}

/* A function of which a root is found; a negative status ends the search. */
typedef int fb_root_function(void *of, double y, double *value);

/* Whether there is a root between two places with these values. */
static inline int fb_is_bracket(const double fa, const double fb)
{
    return (fa <= 0.0 && fb >= 0.0) || (fa >= 0.0 && fb <= 0.0);
}

/* A root between a and b, where the function has the values fa and fb, of different signs or zero.
 *
 * T. R. Chandrupatla, A new hybrid quadratic/bisection algorithm for finding the zero of a nonlinear function without
 * using derivatives, Advances in Engineering Software 28, 1997. */
static inline int fb_solve_bracketed(fb_root_function *function, void *of, double a, double fa, double b, double fb,
                                     double *root)
{
    double c = a, fc = fa, share = 0.5;
    *root = fa == 0.0 ? a : b;
    for (int i = 0; i < FB_MOST_ITERATIONS && fa != 0.0 && fb != 0.0; ++i) {
        const double y = a + share * (b - a);
        double value;
        const int status = function(of, y, &value);
        if (status < 0)
            return status;
        const int is_beyond = (value > 0.0) == (fa > 0.0);
        c = is_beyond ? a : b;
        fc = is_beyond ? fa : fb;
        if (!is_beyond) {
            b = a;
            fb = fa;
        }
        a = y;
        fa = value;
        *root = fabs(fa) <= fabs(fb) ? a : b;
        const double least = 4.0 * DBL_EPSILON / fabs(b - a);
        if (least > 0.5 || value != value)
            break;
        const double xi = (a - b) / (c - b), phi = (fa - fb) / (fc - fb);
        share = 0.5;
        if (phi * phi < xi && (1.0 - phi) * (1.0 - phi) < 1.0 - xi) /* inverse quadratic interpolation is monotone */
            share = fa / (fb - fa) * fc / (fb - fc) + (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb);
        share = share < least ? least : share > 1.0 - least ? 1.0 - least : share;
    }
    return 0;
}

/* A series as an fb_root_function. */
static inline int fb_value_of_series(void *of, const double y, double *value)
{
    const fb_series *const series = of;
    *value = fb_chebyshev_value(series->n, series->c, y);
    return 0;
}

#endif
