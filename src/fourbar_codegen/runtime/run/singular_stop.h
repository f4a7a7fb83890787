/* Singular positions within a step. */
#ifndef FOURBAR_SINGULAR_STOP_H
#define FOURBAR_SINGULAR_STOP_H

#include "run.h"

/* States along a step at which the sign of det J_d is evaluated, if the ends are not conclusive. */
enum { FB_LOOKS = 8 };

/* A position is singular if the least pivot of J is below this fraction of its mean over a run: within a step after
 * which the sign of det J_d is another one, and where a step fails. */
#define FB_PASSED_RATIO 1e-4
#define FB_FAILED_RATIO 1e-3

/* Whether the sign of det J_d has also changed between neighbours of several states along the last step. If
 * not, J kept its rank, and the step was only long. Ends with an evaluation at the state reached. */
static inline int fb_toggled_within(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    double *const along = r->watch.along;
    const int64_t n_evaluations = s->n_evaluations; /* these evaluations are not counted, like those for events */
    int toggled = 0;
    for (int i = 0; i <= FB_LOOKS; ++i) {
        const double since = i == FB_LOOKS ? s->t : s->t_old + s->h * i / FB_LOOKS;
        int status = 0;
        if (i == 0)
            memcpy(along, s->x_old, (size_t)s->n * sizeof *along);
        else
            status = fb_state_at(s, since, along);
        if (status == 0)
            status = fb_evaluate(s, since, along, along + s->padded);
        if (status < 0)
            return status;
        toggled |= s->problem->kernel->toggled(s->problem->work) && i > 0;
    }
    s->n_evaluations = n_evaluations;
    s->interpolant_valid = 0;
    return toggled;
}

/* Whether J loses rank within the last step, in which the sign of det J_d has changed: at one of many states, those
 * near the least of them looked at more closely. */
static inline int fb_passes_singular_position(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_problem *const problem = s->problem;
    const fb_singular *const singular = &r->watch.singular;
    double *const along = r->watch.along;
    double low = s->t_old, high = s->t, least = INFINITY;
    for (int turn = 0; turn < 5; ++turn) {
        const double part = (high - low) / 32.0, begin = low;
        double smallest = INFINITY;
        for (int i = 1; i < 32; ++i) {
            const double t = begin + i * part;
            const int status = fb_state_at(s, t, along);
            if (status < 0)
                return status;
            fb_fill_inputs(problem, t, along);
            const double pivot = singular->least_pivot(s, t, along);
            if (pivot < smallest) {
                smallest = pivot;
                low = t - part;
                high = t + part;
            }
        }
        least = smallest < least ? smallest : least;
    }
    return least < FB_PASSED_RATIO * singular->typical;
}

/* Whether a step failed because the state reached is next to a singular position. */
static inline int fb_fails_near_singular_position(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    const fb_singular *const singular = &r->watch.singular;
    return singular->least_pivot && singular->least_pivot(s, s->t, s->x) < FB_FAILED_RATIO * singular->typical;
}

/* Takes the least pivot at the state reached into its mean. */
static inline void fb_note_pivot(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_singular *const singular = &r->watch.singular;
    singular->integral += fabs(s->h) * log(singular->least_pivot(s, s->t, s->x));
    singular->typical = exp(singular->integral / fabs(s->t - r->pace.t_begin));
}

#endif
