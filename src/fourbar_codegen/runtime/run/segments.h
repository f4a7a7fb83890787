/* The beginning of a run, its segments between breakpoints, restarts, and its end within a step. */
#ifndef FOURBAR_SEGMENTS_H
#define FOURBAR_SEGMENTS_H

#include "../kernel/breakpoints.h"
#include "events.h"
#include "run.h"
#include "samples.h"
#include "singular_stop.h"

/* x' at the beginning, and the length of the first step. */
static inline int fb_begin(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    s->fsal = 0;
    int status = s->problem->kernel->least_pivot ? fb_note_pivot(r, FB_LOOK_FIRST) : 0;
    if (status >= 0)
        status = s->method->init(s, r->direction, fabs(r->t_bound - s->t), r->max_step, &r->h_abs);
    if (status < 0)
        return status;
    r->watch.ended_by = -1;
    r->watch.n_found = 0;
    fb_chattering *const c = &r->chattering;
    c->lengths = (fb_step_lengths){0.0, 0.0, 0.0};
    c->mean = 0.0;
    c->in_a_row = 0;
    c->noted = s->n_steps;
    r->stiffness = (fb_stiffness){0, 0, 0};
    return fb_begin_events(r);
}

/* The segment in which the run goes on. */
static inline void fb_set_segment(fb_run *r, const fb_segment *segment)
{
    fb_enter_clock(&r->stepper.problem->clock, segment);
    r->stepper.t = segment->t;
    r->t_bound = r->samples.until = segment->t_bound;
}

/* Goes on in a segment, from the state reached or from x; FB_RUN_OPEN if no state nearby satisfies the constraints. */
static inline int fb_enter(fb_run *r, const fb_segment *segment, const double *x)
{
    fb_stepper *const s = &r->stepper;
    fb_set_segment(r, segment);
    if (x) {
        memcpy(s->x, x, (size_t)s->n * sizeof *x);
        r->samples.pending = 1;
        const int status = s->project ? fb_problem_project(s->problem, s->t, s->x, 0) : FB_OK;
        if (status != FB_OK)
            return status < 0 ? status : FB_RUN_OPEN;
    }
    for (const fb_observer *o = r->observers; o; o = o->next) {
        const int status = o->at_restart ? o->at_restart(o->of, s, x != NULL) : 0;
        if (status < 0)
            return status;
    }
    int status = fb_resume(s);
    if (status == 0)
        status = fb_begin_events(r);
    return status < 0 ? status : FB_RUN_PAUSED;
}

/* Ends the run at a time within the last step, whose state is the last one. There are no samples after it. */
static inline int fb_stop_within(fb_run *r, const double t)
{
    fb_stepper *const s = &r->stepper;
    double *const along = r->watch.along;
    r->samples.until = r->t_bound = t;
    if (r->samples.times) { /* samples within the step, which need its end, are still to be taken */
        r->samples.pending = 1;
        return 0;
    }
    int status = fb_state_at(s, t, along);
    for (const fb_observer *o = r->observers; o && status >= 0; o = o->next)
        status = o->at_end ? o->at_end(o->of, s, t, along) : 0;
    if (status < 0)
        return status;
    memcpy(s->x, along, (size_t)s->n * sizeof *along);
    s->t = t;
    r->samples.pending &= t != s->t_old; /* the beginning of a step has been sampled */
    return 0;
}

#endif
