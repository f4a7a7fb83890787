/* The type of values in the equations of motion: fb_real is double, or, in a source that defines FB_LANES, a
 * vector of FB_WIDTH doubles, as many as a SIMD register holds, with a state in each lane.
 */
#ifndef FOURBAR_REAL_H
#define FOURBAR_REAL_H

#include <float.h>
#include <math.h>
#include <string.h>

/* NaN must be detected, and rounding is part of the method. */
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) ||                                                         \
    (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0)
#error "Results would be wrong with -ffast-math or -Ofast: leave them out, or let " \
    "-fno-fast-math -fno-finite-math-only -fno-unsafe-math-optimizations follow them."
#elif defined(__clang__) && !defined(__arm__) && !defined(__wasm__) /* defines no macros for some such options */
#pragma float_control(precise, on)
#endif

/* An error with -fsingle-precision-constant: the array has a negative size. */
typedef char fb_constants_are_of_type_double[sizeof(1.0) == sizeof(double) ? 1 : -1];

#if defined(__GNUC__)
#define FB_INLINE inline __attribute__((always_inline))
#else
#define FB_INLINE inline
#endif

/* A function that is not inlined, since compilers would repeat it; not every model calls it. */
#if defined(__GNUC__)
#define FB_CALLED __attribute__((noinline, unused))
#else
#define FB_CALLED
#endif

/* Short equations are inlined into their callers: values stay in registers, and unused results are left out. */
#if defined(FB_SHORT) && defined(__GNUC__)
#define FB_FLATTEN __attribute__((flatten))
#else
#define FB_FLATTEN
#endif

#ifndef FB_LANES

typedef double fb_real;

/* A SIMD vector with a right-hand side of the equations of one state in each lane. */
#if defined(__AVX512F__)
#include <immintrin.h>
#define FB_SIMD_WIDTH 8
#elif defined(__AVX__)
#define FB_SIMD_WIDTH 4
#elif defined(__GNUC__)
#define FB_SIMD_WIDTH 2
#else
#define FB_SIMD_WIDTH 1
#endif
#if FB_SIMD_WIDTH > 1
typedef double fb_simd __attribute__((vector_size(FB_SIMD_WIDTH * sizeof(double))));
#define fb_lane(value, lane) (value)[lane]
#else
typedef double fb_simd;
#define fb_lane(value, lane) (*((void)(lane), &(value)))
#endif

static FB_INLINE fb_simd fb_all(const double value)
{
    return value + (fb_simd){0.0};
}

static FB_INLINE fb_simd fb_load_simd(const double *from)
{
    fb_simd value;
    memcpy(&value, from, sizeof value);
    return value;
}

static FB_INLINE void fb_store_simd(const fb_simd value, double *to)
{
    memcpy(to, &value, sizeof value);
}

/* The same for the first `count` lanes; the others are 0. Half of a register needs no mask, which takes longer. */
static FB_INLINE fb_simd fb_load_some(const double *from, const int count)
{
#if FB_SIMD_WIDTH == 8
    if (count == 4)
        return (fb_simd)_mm512_zextpd256_pd512(_mm256_loadu_pd(from));
    return (fb_simd)_mm512_maskz_loadu_pd((__mmask8)((1 << count) - 1), from);
#else
    fb_simd value = fb_all(0.0);
    for (int lane = 0; lane < count; ++lane)
        fb_lane(value, lane) = from[lane];
    return value;
#endif
}

static FB_INLINE void fb_store_some(const fb_simd value, const int count, double *to)
{
#if FB_SIMD_WIDTH == 8
    if (count == 4)
        _mm256_storeu_pd(to, _mm512_castpd512_pd256((__m512d)value));
    else
        _mm512_mask_storeu_pd(to, (__mmask8)((1 << count) - 1), (__m512d)value);
#else
    for (int lane = 0; lane < count; ++lane)
        to[lane] = fb_lane(value, lane);
#endif
}

#define fb_number(value) (value)
#define fb_abs(value) fabs(value)
#define FB_EACH_1(value, a) (value)
#define FB_EACH_2(value, a, b) (value)
#define FB_EACH_3(value, a, b, c) (value)
#define FB_EACH_4(value, a, b, c, d) (value)

#else

#include <stdint.h>

#if defined(__AVX512F__)
#define FB_WIDTH 8
#elif defined(__AVX__)
#define FB_WIDTH 4
#else
#define FB_WIDTH 2
#endif

typedef double fb_real __attribute__((vector_size(FB_WIDTH * sizeof(double))));
typedef int64_t fb_mask __attribute__((vector_size(FB_WIDTH * sizeof(int64_t)))); /* in each lane 0 or -1 */
typedef uint64_t fb_bits __attribute__((vector_size(FB_WIDTH * sizeof(uint64_t))));

static FB_INLINE fb_real fb_number(const double value)
{
    return value - (fb_real){0.0};
}

static FB_INLINE fb_real fb_select(const fb_mask mask, const fb_real yes, const fb_real no)
{
    return (fb_real)(((fb_mask)yes & mask) | ((fb_mask)no & ~mask));
}

static FB_INLINE fb_real fb_abs(const fb_real value)
{
    return (fb_real)((fb_bits)value & (UINT64_MAX >> 1));
}

static FB_INLINE fb_real fb_greater(const fb_real a, const fb_real b)
{
    return fb_select(a > b, a, b);
}

static FB_INLINE int fb_any(const fb_mask mask)
{
#if defined(__AVX512DQ__)
    typedef long long fb_words __attribute__((vector_size(sizeof mask)));
    return __builtin_ia32_cvtq2mask512((fb_words)mask) != 0;
#elif defined(__AVX__) && !defined(__AVX512F__)
    return __builtin_ia32_movmskpd256((fb_real)mask) != 0;
#elif defined(__SSE2__) && !defined(__AVX__)
    return __builtin_ia32_movmskpd((fb_real)mask) != 0;
#else
    int64_t any = 0;
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        any |= mask[lane];
    return any != 0;
#endif
}

/* An expression of doubles, evaluated lane by lane, followed by its variables. */
#define FB_LANE_BY_LANE(outside, inside, value)                                                                        \
    __extension__({                                                                                                    \
        fb_real each;                                                                                                  \
        outside for (int lane = 0; lane < FB_WIDTH; ++lane)                                                            \
        {                                                                                                              \
            inside each[lane] = (value);                                                                               \
        }                                                                                                              \
        each;                                                                                                          \
    })
#define FB_OUTSIDE(a) const fb_real each_##a = a;
#define FB_INSIDE(a) const double a = each_##a[lane];
#define FB_EACH_1(value, a) FB_LANE_BY_LANE(FB_OUTSIDE(a), FB_INSIDE(a), value)
#define FB_EACH_2(value, a, b) FB_LANE_BY_LANE(FB_OUTSIDE(a) FB_OUTSIDE(b), FB_INSIDE(a) FB_INSIDE(b), value)
#define FB_EACH_3(value, a, b, c)                                                                                      \
    FB_LANE_BY_LANE(FB_OUTSIDE(a) FB_OUTSIDE(b) FB_OUTSIDE(c), FB_INSIDE(a) FB_INSIDE(b) FB_INSIDE(c), value)
#define FB_EACH_4(value, a, b, c, d)                                                                                   \
    FB_LANE_BY_LANE(FB_OUTSIDE(a) FB_OUTSIDE(b) FB_OUTSIDE(c) FB_OUTSIDE(d),                                           \
                    FB_INSIDE(a) FB_INSIDE(b) FB_INSIDE(c) FB_INSIDE(d), value)

#endif

#endif
