/* The loop over the steps of a run; each part of it is in a file of its own. */
#ifndef FOURBAR_DRIVER_H
#define FOURBAR_DRIVER_H

#include "accepted_step.h"
#include "chattering.h"
#include "events.h"
#include "segments.h"
#include "singular_stop.h"
#include "step_collapse.h"
#include "stiffness.h"

/* Looks for events in what is left of the last step: FB_RUN_PAUSED if there are none. A singular position ends the run
 * before the step, unless an event ends it before that position. */
static inline int fb_look_for_events(fb_run *r)
{
    fb_watch *const watch = &r->watch;
    int found = 0;
    do {
        found = watch->n_events > 0 ? fb_find_events(r) : 0;
        if (found > 0 && watch->is_singular)
            found = fb_forget_events(r, watch->singular.t);
    } while (found == 0 && watch->is_singular && watch->n_events > 0 && watch->searched < 1.0);
    if (watch->ended_by >= 0)
        watch->is_singular = 0;
    if (found != 0)
        return found < 0 ? found : FB_RUN_EVENT;
    if (!watch->is_singular)
        return FB_RUN_PAUSED;
    watch->is_singular = 0;
    fb_undo(r);
    return FB_RUN_SINGULAR;
}

/* Looks at the last step: FB_RUN_PAUSED if there is nothing to examine. */
static inline int fb_look(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_watch *const watch = &r->watch;
    /* Methods that pass singular positions need not detect them. */
    int toggled = s->method->projects ? 0 : s->problem->kernel->toggled(s->problem->work);
    if (toggled)
        toggled = fb_toggled_within(r);
    if (toggled > 0)
        toggled = fb_passes_singular_position(r);
    if (toggled < 0)
        return toggled;
    watch->is_singular = toggled;
    watch->searched = 0.0;
    const int status = fb_look_for_events(r);
    if (status < 0 || status == FB_RUN_SINGULAR)
        return status;
    if (s->n_steps >= watch->singular.next && s->problem->kernel->least_pivot) {
        const int noted = fb_note_pivot(r, FB_LOOK_ALONG);
        if (noted < 0)
            return noted;
    }
    return watch->look_at_all ? FB_RUN_EVENT : status;
}

/* Whether an observer has no room for another step. */
static inline int fb_is_full(const fb_run *r)
{
    for (const fb_observer *o = r->observers; o; o = o->next)
        if (o->is_full && o->is_full(o->of))
            return 1;
    return 0;
}

/* Why a step fails, or steps collapse: at a singular position, beside a jump of the equations, or for a reason of their
 * own. */
static inline int fb_cause(fb_run *r, const int reason)
{
    const int is_singular = fb_stops_at_singular_position(r, reason);
    if (is_singular != 0)
        return is_singular < 0 ? is_singular : FB_RUN_SINGULAR;
    const int chatters = reason == FB_RUN_COLLAPSED ? 0 : fb_fails_beside_jump(r, reason);
    return chatters < 0 ? chatters : chatters ? FB_RUN_CHATTERING : reason;
}

/* Up to n steps; returns an FB_RUN, or negative from the callback of inputs. */
static inline int fb_run_on(fb_run *r, int64_t n)
{
    for (;;) {
        if (r->watch.n_found > 0) { /* more may be left of the last step */
            const int status = fb_look_for_events(r);
            if (status != FB_RUN_PAUSED)
                return status;
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
        int status = fb_look_for_chattering(r);
        if (status != FB_RUN_PAUSED)
            return status;
        status = fb_has_collapsed(r) ? FB_RUN_COLLAPSED : fb_observed_step(r);
        if (status > FB_RUN_PAUSED)
            return fb_cause(r, status);
        if (status == FB_RUN_PAUSED) {
#ifndef FB_LIBRARY /* which has no sentences */
            status = fb_note_stability(r);
            if (status < 0)
                return status;
#endif
            status = fb_look(r);
        }
        if (status != FB_RUN_PAUSED)
            return status;
    }
}

#endif
