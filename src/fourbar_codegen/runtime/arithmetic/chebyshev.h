/* Functions on -1 <= y <= 1 by Chebyshev series c_0 + c_1 T_1(y) + ... + c_n T_n(y).
 *
 * L. N. Trefethen, Approximation Theory and Approximation Practice, SIAM 2013, chapters 3, 4 and 18. The degree n is a
 * power of two, so that the points of a series are among those of one of twice its degree.
 */
#ifndef FOURBAR_CHEBYSHEV_H
#define FOURBAR_CHEBYSHEV_H

#include <math.h>

enum { FB_LEAST_DEGREE = 8, FB_MOST_DEGREE = 64 };

/* cos(j pi / 64) */
static const double fb_cosines[FB_MOST_DEGREE + 1] = {
    1.0,
    0.9987954562051724,
    0.9951847266721969,
    0.989176509964781,
    0.9807852804032304,
    0.970031253194544,
    0.9569403357322088,
    0.9415440651830208,
    0.9238795325112867,
    0.9039892931234433,
    0.881921264348355,
    0.8577286100002721,
    0.8314696123025452,
    0.8032075314806449,
    0.773010453362737,
    0.7409511253549591,
    0.7071067811865476,
    0.6715589548470183,
    0.6343932841636455,
    0.5956993044924335,
    0.5555702330196023,
    0.5141027441932217,
    0.4713967368259978,
    0.4275550934302822,
    0.38268343236508984,
    0.33688985339222005,
    0.29028467725446233,
    0.24298017990326398,
    0.19509032201612833,
    0.14673047445536175,
    0.09801714032956077,
    0.049067674327418126,
    0.0,
    -0.049067674327418126,
    -0.09801714032956077,
    -0.14673047445536175,
    -0.19509032201612833,
    -0.24298017990326398,
    -0.29028467725446233,
    -0.33688985339222005,
    -0.38268343236508984,
    -0.4275550934302822,
    -0.4713967368259978,
    -0.5141027441932217,
    -0.5555702330196023,
    -0.5956993044924335,
    -0.6343932841636455,
    -0.6715589548470183,
    -0.7071067811865476,
    -0.7409511253549591,
    -0.773010453362737,
    -0.8032075314806449,
    -0.8314696123025452,
    -0.8577286100002721,
    -0.881921264348355,
    -0.9039892931234433,
    -0.9238795325112867,
    -0.9415440651830208,
    -0.9569403357322088,
    -0.970031253194544,
    -0.9807852804032304,
    -0.989176509964781,
    -0.9951847266721969,
    -0.9987954562051724,
    -1.0,
};

/* Point j of a series of degree n, from 1 to -1. */
static inline double fb_chebyshev_point(const int n, const int j)
{
    return fb_cosines[j * (FB_MOST_DEGREE / n)];
}

/* The series of degree n through values at its points. */
static inline void fb_chebyshev_fit(const int n, const double *values, double *restrict c)
{
    const int stride = FB_MOST_DEGREE / n;
    for (int k = 0; k <= n; ++k) {
        double sum = 0.5 * (values[0] + (k % 2 ? -values[n] : values[n]));
        for (int j = 1; j < n; ++j) {
            const int turns = j * k & (2 * n - 1); /* of pi / n; n is a power of two */
            sum += values[j] * fb_cosines[(turns > n ? 2 * n - turns : turns) * stride];
        }
        c[k] = (k % n ? 2.0 : 1.0) / n * sum;
    }
}

/* Its value, by Clenshaw's recurrence. */
static inline double fb_chebyshev_value(const int n, const double *c, const double y)
{
    double b = 0.0, last = 0.0;
    for (int k = n; k > 0; --k) {
        const double next = 2.0 * y * b - last + c[k];
        last = b;
        b = next;
    }
    return y * b - last + c[0];
}

/* The series of its derivative, of degree n - 1. */
static inline void fb_chebyshev_slope(const int n, const double *c, double *restrict slope)
{
    slope[n] = 0.0;
    slope[n - 1] = 2.0 * n * c[n];
    for (int k = n - 2; k >= 0; --k)
        slope[k] = slope[k + 2] + 2.0 * (k + 1) * c[k + 1];
    slope[0] *= 0.5;
}

/* The largest change from c_0, at most: |T_k| <= 1. */
static inline double fb_chebyshev_range(const int n, const double *c)
{
    double sum = 0.0;
    for (int k = 1; k <= n; ++k)
        sum += fabs(c[k]);
    return sum;
}

#endif
