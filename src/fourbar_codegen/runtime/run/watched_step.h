/* A step of fixed length with events. */
#ifndef FOURBAR_WATCHED_STEP_H
#define FOURBAR_WATCHED_STEP_H

#include "../steppers/runge_kutta.h"
#include "events.h"

/* A step of length h to t_bound, or a shorter one as `fb_fixed_part`, as a segment of its own, since inputs may jump
 * where it begins, and x' at its end for its interpolant; its events are still to be found. Returns the status of the
 * kernel. */
static inline int fb_watched_step(fb_run *r, const double h, const double t_bound)
{
    fb_stepper *const s = &r->stepper;
    r->t_bound = t_bound;
    int status = fb_begin_events(r);
    s->problem->status = FB_OK; /* functions are evaluated beside the run, too, where equations may have no value */
    if (status >= 0)
        status = fb_fixed_part(s, h, t_bound);
    r->t_bound = s->t;
    if (status == FB_OK)
        status = fb_evaluate(s, s->t, s->x, fb_end_rates(s));
    r->watch.searched = 0.0;
    return status;
}

#endif
