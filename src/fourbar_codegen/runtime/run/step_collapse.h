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

/* Steps take too long, so that a jump of the equations may be the reason, if so many of them are shorter than a
 * fraction of the average over time, or the run would take more than so many. */
enum { FB_SHORT_STEPS = 20 };
#define FB_SHORT_RATIO 1e-4
#define FB_TOO_MANY 1e6

/* Notes the length of a step, whose number it is; returns whether the last ones were so short: their mean, or 0. */
static inline double fb_short_steps(fb_step_lengths *lengths, const double h, const int64_t number,
                                    const double length_of_run)
{
    lengths->sum += fabs(h);
    lengths->squares += h * h;
    if (number % FB_SHORT_STEPS != 0)
        return 0.0;
    const double mean = (lengths->sum - lengths->looked) / FB_SHORT_STEPS;
    lengths->looked = lengths->sum;
    return mean * lengths->sum < FB_SHORT_RATIO * lengths->squares || mean * FB_TOO_MANY < length_of_run ? mean : 0.0;
}

#endif
