/* Sine and cosine, inline, for code that needs both of many angles: fourbar_sine.h for one angle, and for four of them
 * side by side in vectors as long as the machine's. Where an angle is large or not finite, the library takes over.
 */
#ifndef FOURBAR_ANGLE_H
#define FOURBAR_ANGLE_H

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__GNUC__)
#define FB_INLINE inline __attribute__((always_inline))
#else
#define FB_INLINE inline
#endif

#define FB_LARGEST_ANGLE 1e6

#if FLT_EVAL_METHOD == 0
#define FB_REAL double
#define FB_BITS uint64_t
#define FB_SINE fb_sine_1
#include "fourbar_sine.h"
#else
/* Where intermediate results have more digits than double, it cannot be told how they are rounded. */
static FB_INLINE void fb_sine_1(const double *restrict angle, double *restrict sine, double *restrict cosine)
{
    *sine = sin(*angle);
    *cosine = cos(*angle);
}
#endif

#if defined(__GNUC__) && FLT_EVAL_METHOD == 0
#ifdef __AVX__
#define FB_LANES 4
#else
#define FB_LANES 2
#endif
typedef double fb_lanes __attribute__((vector_size(FB_LANES * sizeof(double))));
typedef uint64_t fb_lane_bits __attribute__((vector_size(FB_LANES * sizeof(uint64_t))));
#define FB_REAL fb_lanes
#define FB_BITS fb_lane_bits
#define FB_SINE fb_sine_lanes
#include "fourbar_sine.h"
#else
#define FB_LANES 1
#endif

static FB_INLINE double fb_sin(const double x)
{
    double s, c;
    fb_sine_1(&x, &s, &c);
    return fabs(x) < FB_LARGEST_ANGLE ? s : sin(x);
}

static FB_INLINE double fb_cos(const double x)
{
    double s, c;
    fb_sine_1(&x, &s, &c);
    return fabs(x) < FB_LARGEST_ANGLE ? c : cos(x);
}

typedef struct fb_angles {
    double sin[4], cos[4];
} fb_angles;

static FB_INLINE fb_angles fb_angles_of(const double x0, const double x1, const double x2, const double x3)
{
    /* Entry by entry: compilers keep these in registers. */
#if FB_LANES == 4
    const fb_lanes x = {x0, x1, x2, x3};
    fb_lanes s, c;
    fb_sine_lanes(&x, &s, &c);
    fb_angles angles = {{s[0], s[1], s[2], s[3]}, {c[0], c[1], c[2], c[3]}};
#elif FB_LANES == 2
    const fb_lanes x = {x0, x1}, y = {x2, x3};
    fb_lanes s, c, sy, cy;
    fb_sine_lanes(&x, &s, &c);
    fb_sine_lanes(&y, &sy, &cy);
    fb_angles angles = {{s[0], s[1], sy[0], sy[1]}, {c[0], c[1], cy[0], cy[1]}};
#else
    fb_angles angles;
    fb_sine_1(&x0, angles.sin, angles.cos);
    fb_sine_1(&x1, angles.sin + 1, angles.cos + 1);
    fb_sine_1(&x2, angles.sin + 2, angles.cos + 2);
    fb_sine_1(&x3, angles.sin + 3, angles.cos + 3);
#endif
    /* One comparison for the four; not true either where one is not a number. */
    if (!(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 < FB_LARGEST_ANGLE * FB_LARGEST_ANGLE)) {
        const fb_angles each = {{fb_sin(x0), fb_sin(x1), fb_sin(x2), fb_sin(x3)},
                                {fb_cos(x0), fb_cos(x1), fb_cos(x2), fb_cos(x3)}};
        return each;
    }
    return angles;
}

#endif
