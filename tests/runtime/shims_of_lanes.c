/* Sine and cosine of angles in the lanes of vectors. */
#define FB_LANES
#include "arithmetic/angle.h"

int width(void)
{
    return FB_WIDTH;
}

void sines(int n, const double *x, double *sine, double *cosine)
{
    for (int i = 0; i + FB_WIDTH <= n; i += FB_WIDTH) {
        fb_real angle;
        memcpy(&angle, x + i, sizeof angle);
        const fb_real s = fb_sin(angle), c = fb_cos(angle);
        memcpy(sine + i, &s, sizeof s);
        memcpy(cosine + i, &c, sizeof c);
    }
}

void sines_of_four(int n, const double *x, double *sine, double *cosine)
{
    for (int i = 0; i + 4 * FB_WIDTH <= n; i += 4 * FB_WIDTH) {
        fb_real angle[4];
        memcpy(angle, x + i, sizeof angle);
        const fb_angles angles = fb_angles_of(angle[0], angle[1], angle[2], angle[3]);
        memcpy(sine + i, angles.sin, sizeof angles.sin);
        memcpy(cosine + i, angles.cos, sizeof angles.cos);
    }
}
