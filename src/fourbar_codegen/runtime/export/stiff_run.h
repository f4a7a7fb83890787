/* Steps and runs of a model's C library by Radau IIA, for stiff equations.
 *
 * Included by a source of its own, which a program may leave out. It defines FB_MODEL and FB_DERIVATIVES, the table of
 * the model's derivatives.
 */
#ifndef FOURBAR_STIFF_RUN_H
#define FOURBAR_STIFF_RUN_H

#include "../steppers/radau.h"
#include "public_names.h"

#ifndef FB_WITHOUT_HEADER
/* The workspace that the header declares is large enough: otherwise this array has a negative size. */
typedef char fb_stiff_work_is_enough[FB_RADAU_LENGTH(FB_PUBLIC(n_x)) <= FB_PUBLIC(stiff_work) ? 1 : -1];
#endif

/* In export/c_library.h. */
int FB_PUBLIC(advance)(struct FB_MODEL *model, const fb_steps *steps, double h);
int FB_PUBLIC(run)(struct FB_MODEL *model, const fb_steps *steps, double t_end, double rtol, double atol,
                   const double *times, long n_times, double *states, struct FB_EVENTS *events);

/* The method, in the caller's workspace. */
static fb_steps implicit_steps(fb_radau *radau, double *work)
{
    memset(radau, 0, sizeof *radau);
    fb_place_radau(sizeof((struct FB_MODEL *)0)->x / sizeof(double), radau, work);
    radau->functions = FB_DERIVATIVES.functions;
    return (fb_steps){&fb_radau_method, &fb_radau_iia, radau};
}

int FB_PUBLIC(step_stiff)(struct FB_MODEL *model, const double h, double *work)
{
    fb_radau radau;
    if (work == NULL)
        return FB_INVALID_ARGUMENT;
    const fb_steps steps = implicit_steps(&radau, work);
    return FB_PUBLIC(advance)(model, &steps, h);
}

int FB_PUBLIC(simulate_stiff)(struct FB_MODEL *model, const double t_end, const double rtol, const double atol,
                              const double *times, const long n_times, double *states, struct FB_EVENTS *events,
                              double *work)
{
    fb_radau radau;
    if (work == NULL)
        return FB_INVALID_ARGUMENT;
    const fb_steps steps = implicit_steps(&radau, work);
    return FB_PUBLIC(run)(model, &steps, t_end, rtol, atol, times, n_times, states, events);
}

#endif
