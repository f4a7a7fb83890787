/* Sine and cosine of FB_REAL, a double or a vector of them, where |x| < FB_MAX_ANGLE. FB_BITS is the unsigned
 * integer of the same size, FB_SINE the name to define.
 *
 * x = n pi/2 + r with |r| <= pi/4; pi/2 is taken in three parts, of which the first two have 33 bits, so that their
 * products with n are exact (Cody and Waite, Software Manual for the Elementary Functions, 1980, chapter 8). sin r and
 * cos r are polynomials that interpolate at Chebyshev points, within 2e-17. The error is below 1.6 units in the last
 * place.
 */
static FB_INLINE void FB_SINE(const FB_REAL *restrict angle, FB_REAL *restrict sine, FB_REAL *restrict cosine)
{
    const FB_REAL x = *angle;
    /* Adding 1.5 * 2^52 rounds to the nearest integer n, and leaves it in the last bits. */
    const FB_REAL shifted = x * 0x1.45f306dc9c883p-1 + 0x1.8p52;
    const FB_REAL n = shifted - 0x1.8p52;
    const FB_REAL high = x - n * 0x1.921fb544p+0, middle = n * 0x1.0b4611a6p-34, near = high - middle;
    const FB_REAL r = near - (n * 0x1.3198a2e037073p-69 - ((high - near) - middle));
    const FB_REAL z = r * r, zz = z * z;
    const FB_REAL p = (-0x1.5555555555555p-3 + z * 0x1.1111111110babp-7) +
                      zz * ((-0x1.a01a019e820acp-13 + z * 0x1.71de37946eb45p-19) +
                            zz * (-0x1.ae6008d0f0520p-26 + z * 0x1.5e0a4fb47ace3p-33));
    const FB_REAL q = (0x1.5555555555555p-5 + z * -0x1.6c16c16c16963p-10) +
                      zz * ((0x1.a01a019f4ddfdp-16 + z * -0x1.27e4fa16cc1bcp-22) +
                            zz * (0x1.1eeb67d014ecep-29 + z * -0x1.907cd8f26aa3fp-37));
    const FB_REAL half = 0.5 * z, above = 1.0 - half;
    const FB_REAL sine_r = r + r * z * p, cosine_r = above + (((1.0 - above) - half) + zz * q);
    FB_BITS s, c, sign, quadrant;
    memcpy(&s, &sine_r, sizeof s);
    memcpy(&c, &cosine_r, sizeof c);
    memcpy(&sign, &r, sizeof sign);
    memcpy(&quadrant, &shifted, sizeof quadrant);
    /* The sum above has lost the sign of -0. */
    s |= sign & (UINT64_C(1) << 63);
    /* In every other quadrant both are swapped; in two of four each changes its sign. */
    const FB_BITS change = (s ^ c) & (UINT64_C(0) - (quadrant & UINT64_C(1)));
    s ^= change ^ ((quadrant & UINT64_C(2)) << 62);
    c ^= change ^ (((quadrant + UINT64_C(1)) & UINT64_C(2)) << 62);
    memcpy(sine, &s, sizeof s);
    memcpy(cosine, &c, sizeof c);
}

#undef FB_REAL
#undef FB_BITS
#undef FB_SINE
