/* Sine and cosine, inline, for code that needs both of many angles. The error is below 1.5 units in the last place.
 *
 * x = n pi/2 + r with |r| <= pi/4; pi/2 is taken in three parts, of which the first two have 33 bits, so that their
 * products with n are exact (Cody and Waite, Software Manual for the Elementary Functions, 1980, chapter 8). sin r and
 * cos r are polynomials that interpolate at Chebyshev points, within 2e-17. Where n has more than 20 bits, or x is not
 * finite, the library takes over.
 */
#ifndef FOURBAR_ANGLE_H
#define FOURBAR_ANGLE_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define FB_LARGEST_ANGLE 1e6

typedef struct fb_angle {
    double sin, cos;
} fb_angle;

static inline uint64_t fb_bits(const double value)
{
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static inline double fb_double(const uint64_t bits)
{
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline fb_angle fb_angle_of(const double x)
{
    /* Adding 1.5 * 2^52 rounds to the nearest integer n, and leaves it in the last bits. */
    const double shifted = x * 0x1.45f306dc9c883p-1 + 0x1.8p52;
    const double n = shifted - 0x1.8p52;
    const double high = x - n * 0x1.921fb544p+0, middle = n * 0x1.0b4611a6p-34, near = high - middle;
    const double r = near + (((high - near) - middle) - n * 0x1.3198a2e037073p-69);
    const double z = r * r, zz = z * z;
    const double p = (-0x1.5555555555555p-3 + z * 0x1.1111111110babp-7)
                     + zz * ((-0x1.a01a019e820acp-13 + z * 0x1.71de37946eb45p-19)
                             + zz * (-0x1.ae6008d0f0520p-26 + z * 0x1.5e0a4fb47ace3p-33));
    const double q = (0x1.5555555555555p-5 + z * -0x1.6c16c16c16963p-10)
                     + zz * ((0x1.a01a019f4ddfdp-16 + z * -0x1.27e4fa16cc1bcp-22)
                             + zz * (0x1.1eeb67d014ecep-29 + z * -0x1.907cd8f26aa3fp-37));
    const double half = 0.5 * z, above = 1.0 - half;
    const uint64_t s = fb_bits(r + r * z * p), c = fb_bits(above + (((1.0 - above) - half) + zz * q));
    /* In every other quadrant both change places; in two of four each changes its sign. */
    const uint64_t quadrant = fb_bits(shifted), change = (s ^ c) & (UINT64_C(0) - (quadrant & 1));
    fb_angle angle = {fb_double((s ^ change) ^ ((quadrant & 2) << 62)),
                      fb_double((c ^ change) ^ (((quadrant + 1) & 2) << 62))};
    if (!(fabs(x) < FB_LARGEST_ANGLE)) {
        angle.sin = sin(x);
        angle.cos = cos(x);
    }
    return angle;
}

static inline double fb_sin(const double x)
{
    return fb_angle_of(x).sin;
}

static inline double fb_cos(const double x)
{
    return fb_angle_of(x).cos;
}

#endif
