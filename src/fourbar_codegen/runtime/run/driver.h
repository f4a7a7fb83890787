/* The loop over the steps of a run; each part of it is in a file of its own. */
#ifndef FOURBAR_DRIVER_H
#define FOURBAR_DRIVER_H

#include "accepted_step.h"
#include "events.h"
#include "segments.h"
#include "singular_stop.h"
#include "step_collapse.h"

/* Looks at the last step: FB_RUN_PAUSED if there is nothing to examine. */
static inline int fb_look(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_watch *const watch = &r->watch;
    const int finds_singular = watch->singular.least_pivot != NULL;
    /* Methods that pass singular positions need not detect them. */
    watch->toggled = s->method->projects ? 0 : s->problem->kernel->toggled(s->problem->work);
    if (watch->toggled)
        watch->toggled = fb_toggled_within(r);
    if (watch->toggled < 0)
        return watch->toggled;
    if (watch->toggled && finds_singular) {
        const int passes = fb_passes_singular_position(r);
        if (passes != 0)
            return passes < 0 ? passes : FB_RUN_SINGULAR;
    }
    watch->searched = 0.0;
    const int events = watch->n_events > 0 ? fb_find_events(r) : 0;
    if (events < 0)
        return events;
    if (finds_singular)
        fb_note_pivot(r);
    return watch->look_at_all || events || (watch->toggled && !finds_singular) ? FB_RUN_EVENT : FB_RUN_PAUSED;
}

/* Whether an observer has no room for another step. */
static inline int fb_is_full(const fb_run *r)
{
    for (const fb_observer *o = r->observers; o; o = o->next)
        if (o->is_full && o->is_full(o->of))
            return 1;
    return 0;
}

/* Up to n steps; returns an FB_RUN, or negative from the callback of inputs. */
static inline int fb_run_on(fb_run *r, int64_t n)
{
    for (;;) {
        if (r->watch.n_found > 0) { /* what is left of the last step */
            const int found = fb_find_events(r);
            if (found != 0)
                return found < 0 ? found : FB_RUN_EVENT;
        }
        if (r->samples.pending) {
            const int status = fb_sample(r);
            if (status != FB_RUN_PAUSED)
                return status;
        }
        if (r->stepper.t == r->t_bound)
            return FB_RUN_END;
        if (n-- <= 0)
            return FB_RUN_PAUSED;
        if (fb_is_full(r))
            return FB_RUN_FULL;
        if (fb_has_collapsed(r))
            return FB_RUN_COLLAPSED;
        int status = fb_observed_step(r);
        if (status > FB_RUN_PAUSED && fb_fails_near_singular_position(r))
            return FB_RUN_SINGULAR;
        if (status != FB_RUN_PAUSED)
            return status;
        status = fb_look(r);
        if (status == FB_RUN_SINGULAR)
            fb_undo(r); /* the run ends before it */
        if (status != FB_RUN_PAUSED)
            return status;
    }
}

#endif
