/* Changes of sign of event functions at the ends of a step. */
#ifndef FOURBAR_EVENTS_H
#define FOURBAR_EVENTS_H

#include "run.h"

/* The values of the outputs that are event functions. */
static inline int fb_event_values(fb_run *r, const double since, const double *x, double *values)
{
    fb_problem *const p = r->stepper.problem;
    const fb_watch *const watch = &r->watch;
    const fb_kernel *const k = p->kernel;
    double *const accelerations = watch->outputs, *const multipliers = accelerations + k->n_u;
    double *const outputs = multipliers + k->n_l;
    const double t = fb_time(&p->clock, since);
    const int called = fb_fill_inputs(p, t, x);
    if (called < 0)
        return called;
    k->accelerations(t, x, p->constants, p->inputs, accelerations, multipliers, p->work);
    fb_problem_results(p, FB_OUTPUT, t, x, accelerations, multipliers, NULL, &outputs);
    for (int i = 0; i < watch->n_events; ++i)
        values[i] = outputs[watch->output[i]];
    return 0;
}

/* Whether a function with these values at both ends of a step has an event in it, by the rule of solve_ivp. */
static inline int fb_is_event(const double before, const double after, const int direction)
{
    return (before <= 0.0 && after >= 0.0 && direction >= 0) || (before >= 0.0 && after <= 0.0 && direction <= 0);
}

/* Evaluates the event functions at the state reached; their values there before are kept. */
static inline int fb_move_events_on(fb_run *r)
{
    const fb_watch *const watch = &r->watch;
    if (watch->n_events == 0)
        return 0;
    memcpy(watch->old, watch->value, (size_t)watch->n_events * sizeof *watch->old);
    return fb_event_values(r, r->stepper.t, r->stepper.x, watch->value);
}

/* Whether event functions may have changed their signs in the last step. */
static inline int fb_events_within(fb_run *r)
{
    const fb_watch *const watch = &r->watch;
    const int status = fb_move_events_on(r);
    int found = 0;
    for (int i = 0; i < watch->n_events; ++i)
        found |= fb_is_event(watch->old[i], watch->value[i], watch->direction[i]);
    return status < 0 ? status : found;
}

#endif
