/* Singular positions of a run, where J loses rank, by one measure: its least pivot, relative to the geometric mean of
 * that over the time of the run.
 */
#ifndef FOURBAR_SINGULAR_STOP_H
#define FOURBAR_SINGULAR_STOP_H

#include "run.h"

/* States along a step at which the sign of det J_d is evaluated, if the ends are not conclusive. */
enum { FB_LOOKS = 8 };

/* Parts of an interval within a step that is looked at, and how often that is refined: to 1e-6 of the step. */
enum { FB_PARTS = 32, FB_TURNS = 5 };

/* The states within a step jump if the largest change of a coordinate between neighbours, after all refinements,
 * exceeds this fraction of that in the first one, and this. */
#define FB_JUMPED_RATIO 1e-3
#define FB_JUMPED_ATOL 1e-9

/* The least pivot at a time and state of a run. */
static inline int fb_pivot_at(fb_run *r, const double since, const double *x, const enum FB_LOOK look, double *pivot)
{
    fb_problem *const p = r->stepper.problem;
    const double t = fb_time(&p->clock, since);
    const int status = fb_fill_inputs(p, t, x);
    if (status >= 0)
        *pivot = p->kernel->least_pivot(t, x, p->constants, p->inputs, look, p->work);
    return status;
}

/* The same relative to its mean; infinite where J has no value. */
static inline int fb_pivot_ratio(fb_run *r, const double since, const double *x, double *ratio)
{
    double pivot;
    const int status = fb_pivot_at(r, since, x, FB_LOOK_ASIDE, &pivot);
    if (status < 0)
        return status;
    const double typical = r->watch.singular.typical;
    *ratio = pivot != pivot ? INFINITY : typical > 0.0 ? pivot / typical : 0.0;
    return 0;
}

/* Takes the least pivot at the state reached into its mean: after fewer and fewer steps. */
static inline int fb_note_pivot(fb_run *r, const enum FB_LOOK look)
{
    const fb_stepper *const s = &r->stepper;
    fb_singular *const singular = &r->watch.singular;
    double pivot;
    const int status = fb_pivot_at(r, s->t, s->x, look, &pivot);
    if (status < 0)
        return status;
    if (look == FB_LOOK_FIRST) {
        singular->typical = pivot;
        singular->integral = 0.0;
    } else if (pivot > 0.0) {
        singular->integral += fabs(s->t - singular->noted) * log(pivot);
        singular->typical = exp(singular->integral / fabs(s->t - r->pace.t_begin));
    }
    singular->noted = s->t;
    singular->next = s->n_steps + s->n_steps / 2 + 1;
    return 0;
}

/* Ends the run at a singular position. */
static inline int fb_set_singular(fb_run *r, const enum FB_SINGULAR how, const double ratio, const double t,
                                  const double *x)
{
    fb_singular *const singular = &r->watch.singular;
    singular->how = how;
    singular->ratio = ratio;
    singular->t = t;
    memcpy(singular->x, x, (size_t)r->stepper.n * sizeof *x);
    return 1;
}

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

/* An interval of time within the last step, that of neighbours at which a value is the least or the largest. */
typedef struct fb_interval {
    double low, high;
} fb_interval;

/* Looks for the least pivot, refining the interval around it. */
static inline int fb_find_least_pivot(fb_run *r, fb_interval *at, double *least)
{
    double *const along = r->watch.along;
    *least = INFINITY;
    const fb_interval within = *at;
    const double part = (within.high - within.low) / FB_PARTS;
    for (int i = 1; i < FB_PARTS; ++i) {
        const double t = within.low + i * part;
        double ratio = INFINITY;
        int status = fb_state_at(&r->stepper, t, along);
        if (status == 0)
            status = fb_pivot_ratio(r, t, along, &ratio);
        if (status < 0)
            return status;
        if (ratio < *least || i == 1) {
            *least = ratio;
            *at = (fb_interval){t - part, t + part};
        }
    }
    return 0;
}

/* Looks for the largest change of a coordinate between neighbours, refining the interval between these. */
static inline int fb_find_largest_change(fb_run *r, fb_interval *at, double *largest)
{
    fb_stepper *const s = &r->stepper;
    double *const x = r->watch.along, *const before = x + s->padded;
    const int n_q = s->problem->kernel->n_q;
    const fb_interval within = *at;
    const double part = (within.high - within.low) / FB_PARTS;
    *largest = -1.0;
    for (int i = 0; i <= FB_PARTS; ++i) {
        const double t = i == FB_PARTS ? within.high : within.low + i * part;
        if (t == s->t_old)
            memcpy(x, s->x_old, (size_t)s->n * sizeof *x);
        else {
            const int status = fb_state_at(s, t, x);
            if (status < 0)
                return status;
        }
        double change = 0.0;
        for (int k = 0; k < n_q; ++k)
            change = fmax(change, fabs(x[k] - before[k]));
        if (i > 0 && change > *largest) {
            *largest = change;
            *at = (fb_interval){t - part, t};
        }
        memcpy(before, x, (size_t)s->n * sizeof *x);
    }
    return 0;
}

/* Whether J loses rank within the last step, in which the sign of det J_d has changed, or neighbouring states within it
 * are in different assembly modes. */
static inline int fb_passes_singular_position(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_interval least_at = {s->t_old, s->t}, jump_at = least_at;
    double least = INFINITY, change = 0.0, first_change = 0.0;
    for (int turn = 0; turn < FB_TURNS; ++turn) {
        int status = fb_find_least_pivot(r, &least_at, &least);
        if (status == 0)
            status = fb_find_largest_change(r, &jump_at, &change);
        if (status < 0)
            return status;
        if (turn == 0)
            first_change = change;
    }
    const double t = 0.5 * (least_at.low + least_at.high);
    if (least < FB_PASSED_RATIO) {
        const int status = fb_state_at(s, t, r->watch.along);
        return status < 0 ? status : fb_set_singular(r, FB_SINGULAR_PASSED, least, t, r->watch.along);
    }
    if (change > FB_JUMPED_RATIO * first_change + FB_JUMPED_ATOL)
        return fb_set_singular(r, FB_SINGULAR_JUMPED, least, jump_at.low, s->x);
    return 0;
}

/* Whether the state reached, where steps collapse or one fails, is next to a singular position. */
static inline int fb_stops_at_singular_position(fb_run *r, const int reason)
{
    const fb_stepper *const s = &r->stepper;
    double ratio;
    if (!s->problem->kernel->least_pivot || reason == FB_RUN_DIVERGED)
        return 0;
    const int status = fb_pivot_ratio(r, s->t, s->x, &ratio);
    if (status < 0)
        return status;
    if (ratio < FB_COLLAPSED_RATIO)
        return fb_set_singular(r, FB_SINGULAR_COLLAPSED, ratio, s->t, s->x);
    if (reason == FB_RUN_COLLAPSED)
        return r->observers && ratio < FB_VARIED_RATIO ? fb_set_singular(r, FB_SINGULAR_VARIED, ratio, s->t, s->x) : 0;
    return s->problem->status == FB_OK && ratio < FB_NEAR_RATIO
               ? fb_set_singular(r, FB_SINGULAR_NEAR, ratio, s->t, s->x)
               : 0;
}

#endif
