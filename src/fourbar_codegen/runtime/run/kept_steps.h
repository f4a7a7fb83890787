/* An observer that keeps the steps of a run, from which derivatives/adjoint_sensitivity.h goes backwards. */
#ifndef FOURBAR_KEPT_STEPS_H
#define FOURBAR_KEPT_STEPS_H

#include "run.h"

/* A row has the time at the end of a step, its length and the state; the length is 0 where the run begins, or continues
 * from another state. */
typedef struct fb_kept_steps {
    int64_t n, room;
    double *rows;        /* (room, 2 + n_x) */
    int64_t *sample_row; /* for each sample in the room of fb_samples: the number of the last row, and the time */
    double *sample_t;
} fb_kept_steps;

/* Keeps the state reached by a step of length h. */
static inline void fb_keep_step(fb_kept_steps *kept, const fb_stepper *s, const double h)
{
    double *const row = kept->rows + kept->n++ * (2 + s->n);
    row[0] = s->t;
    row[1] = h;
    memcpy(row + 2, s->x, (size_t)s->n * sizeof *row);
}

static inline int fb_kept_after_step(void *of, fb_stepper *s, const double soon, double *error)
{
    (void)soon, (void)error;
    fb_keep_step(of, s, s->h);
    return 0;
}

static inline void fb_kept_take_back(void *of)
{
    ((fb_kept_steps *)of)->n -= 1;
}

static inline int fb_kept_at_sample(void *of, fb_stepper *s, const int64_t sample, const double t, const double *x)
{
    fb_kept_steps *const kept = of;
    (void)s, (void)x;
    kept->sample_row[sample] = kept->n - 1;
    kept->sample_t[sample] = t;
    return 0;
}

static inline int fb_kept_at_restart(void *of, fb_stepper *s, const int moved)
{
    if (moved)
        fb_keep_step(of, s, 0.0);
    return 0;
}

static inline int fb_kept_are_full(const void *of)
{
    const fb_kept_steps *const kept = of;
    return kept->n == kept->room;
}

static inline fb_observer fb_kept_steps_observer(fb_kept_steps *kept)
{
    return (fb_observer){.of = kept,
                         .after_step = fb_kept_after_step,
                         .take_back = fb_kept_take_back,
                         .at_sample = fb_kept_at_sample,
                         .at_restart = fb_kept_at_restart,
                         .is_full = fb_kept_are_full};
}

#endif
