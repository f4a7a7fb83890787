/* Runs whose steps have become too small to go on. */
#ifndef FOURBAR_STEP_COLLAPSE_H
#define FOURBAR_STEP_COLLAPSE_H

#include "run.h"

/* Fractions of the average step below which the steps have collapsed, and above which they have recovered. */
#define FB_COLLAPSE 1e-9
#define FB_RECOVERY 1e-3

/* Derivatives have collapsed if their errors limit half of so many steps, and these are so small a fraction of
 * the average step: next to a singular position rounding errors of derivatives do not fall as the steps do. */
#define FB_SLOW 3e-2
enum { FB_WINDOW = 100 };

/* Whether the errors of derivatives have made the steps of a window collapse. */
static inline int fb_derivatives_collapsed(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_pace *const pace = &r->pace;
    const double length = fabs(s->t - pace->marked_t) / FB_WINDOW;
    const double average = fabs(s->t - pace->t_begin) / (double)s->n_steps;
    const int collapsed = 2 * pace->n_limited >= FB_WINDOW && length < FB_SLOW * average;
    pace->n_limited = 0;
    pace->marked = s->n_steps;
    pace->marked_t = s->t;
    return collapsed;
}

/* Whether the steps have collapsed; said once for each collapse. */
static inline int fb_has_collapsed(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_pace *const pace = &r->pace;
    const double share = s->n_steps > 9 ? r->h_abs * (double)s->n_steps / fabs(s->t - pace->t_begin) : 1.0;
    if (share < FB_COLLAPSE && !pace->collapsed) {
        pace->collapsed = 1;
        return 1;
    }
    if (share > FB_RECOVERY)
        pace->collapsed = 0;
    return r->observers && s->n_steps - pace->marked == FB_WINDOW && fb_derivatives_collapsed(r);
}

#endif
