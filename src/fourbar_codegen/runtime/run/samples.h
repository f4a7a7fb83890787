/* Samples of a run, and the steps that it keeps. */
#ifndef FOURBAR_SAMPLES_H
#define FOURBAR_SAMPLES_H

#include "run.h"

/* Keeps the state reached by a step of length h. */
static inline void fb_keep_step(fb_run *r, const double h)
{
    const fb_stepper *const s = &r->stepper;
    double *const row = r->record->rows + r->record->n++ * (2 + s->n);
    row[0] = s->t;
    row[1] = h;
    memcpy(row + 2, s->x, (size_t)s->n * sizeof *row);
}

/* Ends a sample at t, whose state is stored already: notes where it lies among the steps, and its derivatives. */
static inline int fb_end_sample(fb_run *r, const double t)
{
    fb_samples *const samples = &r->samples;
    fb_stepper *const s = &r->stepper;
    if (r->record) {
        r->record->sample_row[samples->n] = r->record->n - 1;
        r->record->sample_t[samples->n] = t;
    }
    if (samples->t)
        samples->t[samples->n] = t;
    const double *const x = samples->x + samples->n * s->n;
    const int status = r->observer.at_sample ? r->observer.at_sample(s, r->observer.forward, samples->n, t, x) : 0;
    samples->n += status >= 0;
    return status;
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
