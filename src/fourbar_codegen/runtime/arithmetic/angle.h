/* Inline sine and cosine for code that needs both of many angles, by arithmetic/sine.inc: four angles in the lanes of a
 * SIMD vector, or, for batches, one angle of each state. Angles that are large or not finite are left to the library.
 */
#ifndef FOURBAR_ANGLE_H
#define FOURBAR_ANGLE_H

#include "real.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#define FB_MAX_ANGLE 1e6

typedef struct fb_angles {
    fb_real sin[4], cos[4];
} fb_angles;

#ifndef FB_LANES

#if FLT_EVAL_METHOD == 0
#define FB_REAL double
#define FB_BITS uint64_t
#define FB_SINE fb_sine_1
#include "sine.inc"
#else
/* If intermediate results have more digits than double, their rounding is unknown. */
static FB_INLINE void fb_sine_1(const double *restrict angle, double *restrict sine, double *restrict cosine)
{
    *sine = sin(*angle);
    *cosine = cos(*angle);
}
#endif

#if defined(__GNUC__) && FLT_EVAL_METHOD == 0 && !defined(FB_LIBRARY) /* which is C99 */
#ifdef __AVX__
#define FB_PACKED 4
#else
#define FB_PACKED 2
#endif
typedef double fb_pack __attribute__((vector_size(FB_PACKED * sizeof(double))));
typedef uint64_t fb_pack_bits __attribute__((vector_size(FB_PACKED * sizeof(uint64_t))));
#define FB_REAL fb_pack
#define FB_BITS fb_pack_bits
#define FB_SINE fb_sine_pack
#include "sine.inc"
#else
#define FB_PACKED 1
#endif

static FB_INLINE double fb_sin(const double x)
{
    double s, c;
    fb_sine_1(&x, &s, &c);
    return fabs(x) < FB_MAX_ANGLE ? s : sin(x);
}

static FB_INLINE double fb_cos(const double x)
{
    double s, c;
    fb_sine_1(&x, &s, &c);
    return fabs(x) < FB_MAX_ANGLE ? c : cos(x);
}

/* One by one, if an angle is large or not finite. Not inline, since compilers would repeat it in every function. */
static FB_CALLED void fb_large_angles(const double *x, fb_angles *angles)
{
    for (int i = 0; i < 4; ++i) {
        angles->sin[i] = fb_sin(x[i]);
        angles->cos[i] = fb_cos(x[i]);
    }
}

static FB_INLINE fb_angles fb_angles_of(const double x0, const double x1, const double x2, const double x3)
{
    /* Entry by entry: compilers keep these in registers. */
#if FB_PACKED == 4
    const fb_pack x = {x0, x1, x2, x3};
    fb_pack s, c;
    fb_sine_pack(&x, &s, &c);
    fb_angles angles = {{s[0], s[1], s[2], s[3]}, {c[0], c[1], c[2], c[3]}};
#elif FB_PACKED == 2
    const fb_pack x = {x0, x1}, y = {x2, x3};
    fb_pack s, c, sy, cy;
    fb_sine_pack(&x, &s, &c);
    fb_sine_pack(&y, &sy, &cy);
    fb_angles angles = {{s[0], s[1], sy[0], sy[1]}, {c[0], c[1], cy[0], cy[1]}};
#else
    fb_angles angles;
    fb_sine_1(&x0, angles.sin, angles.cos);
    fb_sine_1(&x1, angles.sin + 1, angles.cos + 1);
    fb_sine_1(&x2, angles.sin + 2, angles.cos + 2);
    fb_sine_1(&x3, angles.sin + 3, angles.cos + 3);
#endif
    /* One comparison for all four; false if one is NaN. */
    if (!(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 < FB_MAX_ANGLE * FB_MAX_ANGLE)) {
        const double each[4] = {x0, x1, x2, x3};
        fb_large_angles(each, &angles);
    }
    return angles;
}

#else

#define FB_REAL fb_real
#define FB_BITS fb_bits
#define FB_SINE fb_sine_lanes
#include "sine.inc"

/* The library's values for the lanes with large angles. */
static __attribute__((noinline)) void fb_large_angles(const fb_real *angle, fb_real *sine, fb_real *cosine)
{
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        if (!(fabs((*angle)[lane]) < FB_MAX_ANGLE)) {
            (*sine)[lane] = sin((*angle)[lane]);
            (*cosine)[lane] = cos((*angle)[lane]);
        }
}

static FB_INLINE void fb_sine_and_cosine(const fb_real *angle, fb_real *sine, fb_real *cosine)
{
    fb_sine_lanes(angle, sine, cosine);
    if (fb_any(~(fb_abs(*angle) < FB_MAX_ANGLE)))
        fb_large_angles(angle, sine, cosine);
}

static FB_INLINE fb_real fb_sin(const fb_real x)
{
    fb_real s, c;
    fb_sine_and_cosine(&x, &s, &c);
    return s;
}

static FB_INLINE fb_real fb_cos(const fb_real x)
{
    fb_real s, c;
    fb_sine_and_cosine(&x, &s, &c);
    return c;
}

static FB_INLINE fb_angles fb_angles_of(const fb_real x0, const fb_real x1, const fb_real x2, const fb_real x3)
{
    const fb_real x[4] = {x0, x1, x2, x3};
    fb_angles angles;
    for (int i = 0; i < 4; ++i)
        fb_sine_lanes(x + i, angles.sin + i, angles.cos + i);
    if (fb_any(~(x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3 < FB_MAX_ANGLE * FB_MAX_ANGLE)))
        for (int i = 0; i < 4; ++i)
            fb_large_angles(x + i, angles.sin + i, angles.cos + i);
    return angles;
}

#endif

#endif
