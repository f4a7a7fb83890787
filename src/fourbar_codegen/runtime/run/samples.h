/* Samples of a run. */
#ifndef FOURBAR_SAMPLES_H
#define FOURBAR_SAMPLES_H

#include "run.h"

/* Ends a sample at t, whose state is stored already. */
static inline int fb_end_sample(fb_run *r, const double t)
{
    fb_samples *const samples = &r->samples;
    fb_stepper *const s = &r->stepper;
    const double *const x = samples->x + samples->n * s->n;
    if (samples->t)
        samples->t[samples->n] = t;
    for (const fb_observer *o = r->observers; o; o = o->next) {
        const int status = o->at_sample ? o->at_sample(o->of, s, samples->n, t, x) : 0;
        if (status < 0)
            return status;
    }
    samples->n += 1;
    return 0;
}

/* The samples of the last step; FB_RUN_FULL if there is no room for them. */
static inline int fb_sample(fb_run *r)
{
    fb_samples *const samples = &r->samples;
    fb_stepper *const s = &r->stepper;
    if (samples->times == NULL) {
        if (samples->n == samples->room)
            return FB_RUN_FULL;
        memcpy(samples->x + samples->n * s->n, s->x, (size_t)s->n * sizeof *s->x);
        const int status = fb_end_sample(r, s->t);
        if (status < 0)
            return status;
    } else {
        while (samples->next_time < samples->n_times) {
            const double t = samples->times[samples->next_time];
            if (r->direction * (t - s->t) > 0.0 || r->direction * (t - samples->until) > 0.0)
                break;
            if (samples->n == samples->room)
                return FB_RUN_FULL;
            int status = fb_state_at(s, t, samples->x + samples->n * s->n);
            if (status == 0)
                status = fb_end_sample(r, t);
            if (status < 0)
                return status;
            samples->next_time += 1;
        }
    }
    samples->pending = 0;
    return FB_RUN_PAUSED;
}

#endif
