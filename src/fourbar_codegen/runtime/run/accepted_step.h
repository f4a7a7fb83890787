/* One accepted step of a run: attempts, projection onto the constraints, step control, derivatives. */
#ifndef FOURBAR_ACCEPTED_STEP_H
#define FOURBAR_ACCEPTED_STEP_H

#include "../steppers/runge_kutta.h"
#include "run.h"

/* Attempts at a step that errors of derivatives may usually need, and the fraction of the first one's length in which
 * derivatives grow to the size with which errors of further attempts are compared. */
#define FB_USUAL_ATTEMPTS 3
#define FB_SOON 1e-2

/* Projects the end of an attempt onto the constraints, and evaluates x' there; the error becomes NaN where that fails.
 */
static inline int fb_complete(fb_stepper *s, const double t_new, double *error)
{
    int status = fb_problem_project(s->problem, t_new, s->x_new, 1);
    if (status < 0)
        return status;
    if (status == FB_OK)
        return s->method->restart(s, t_new, s->x_new, fb_end_rates(s));
    *error = NAN;
    return 0;
}

/* One step of a method with a step control of its own, and x' at its end. */
static inline int fb_advance(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    double t_new = s->t;
    int status = s->method->advance(s, r->t_bound, &t_new);
    if (status != FB_RUN_PAUSED)
        return status;
    status = s->project ? fb_problem_project(s->problem, t_new, s->x_new, 0) : FB_OK;
    if (status != FB_OK)
        return status < 0 ? status : FB_RUN_OPEN;
    fb_accept(s, t_new);
    r->samples.pending = 1;
    status = s->method->restart(s, t_new, s->x, fb_end_rates(s));
    return status < 0 ? status : FB_RUN_PAUSED;
}

/* Whether values within a step to t_new are asked for: samples, events, or its interpolant. */
static inline int fb_asks_between(const fb_run *r, const double t_new)
{
    const fb_samples *const samples = &r->samples;
    return r->watch.n_events > 0 || r->watch.look_at_all ||
           (samples->times && samples->next_time < samples->n_times &&
            r->direction * (samples->times[samples->next_time] - t_new) < 0.0);
}

/* One accepted step; an FB_RUN, or negative from a callback. */
static inline int fb_step(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    const fb_method *const method = s->method;
    if (method->advance)
        return fb_advance(r);
    const double min_step = fb_least_step(s->t, r->direction);
    const double margin = method->largest_share > 0.0 ? method->largest_share * r->max_step : 0.0;
    double h_abs = fb_first_length(r->h_abs, r->max_step, min_step);
    double proposed = 0.0; /* for a step that ends with the run, or at a breakpoint */
    int rejected = 0;
    fb_move_on(s);
    for (;;) {
        if (method->least_share > 0.0 && !(h_abs >= method->least_share * r->max_step))
            return FB_RUN_DIVERGED;
        /* Also if it is NaN. */
        if (!(h_abs >= min_step))
            return FB_RUN_TOO_SMALL;
        const double t_new = fb_step_end(s->t, &h_abs, r->direction, r->t_bound, margin, rejected, &proposed);
        double error = NAN;
        if (!isfinite(h_abs))
            return FB_RUN_INFINITE;
        int status = method->attempt(s, t_new, &error);
        if (status == 0 && error < 1.0 && method->between && fb_asks_between(r, t_new))
            status = method->between(s, t_new, &error);
        if (status == 0 && error < 1.0 && s->project && !method->projects)
            status = fb_complete(s, t_new, &error);
        if (status != 0)
            return status;
        if (error < 1.0 && !fb_finite(fb_end_rates(s), s->n))
            error = NAN;
        h_abs = method->next_length(s, h_abs, error, rejected);
        if (error < 1.0) {
            r->h_abs = h_abs > proposed ? h_abs : proposed;
            fb_accept(s, t_new);
            r->samples.pending = 1;
            return FB_RUN_PAUSED;
        }
        rejected = 1;
        proposed = 0.0; /* too long, as it turned out */
    }
}

/* Takes the last step back. */
static inline void fb_undo(fb_run *r)
{
    fb_take_back(&r->stepper);
    for (const fb_observer *o = r->observers; o; o = o->next)
        if (o->take_back)
            o->take_back(o->of);
    r->samples.pending = 0;
}

/* One accepted step, and its derivatives, whose errors may ask for shorter ones: where the state rests, or moves
 * steadily, its own errors do not limit the steps at all. At a kink of a force, a derivative that was zero before may
 * have an error of its own size at any length of the step: after some attempts, it is compared with the size that it
 * reaches within a fraction of the first of them. */
static inline int fb_observed_step(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    double soon = 0.0;
    for (int attempt = 0;; ++attempt) {
        int status = fb_step(r);
        if (status != FB_RUN_PAUSED || !r->observers)
            return status;
        if (attempt == 0)
            soon = FB_SOON * fabs(s->h);
        const int is_least = fabs(s->h) * FB_MIN_FACTOR < fb_least_step(s->t_old, r->direction);
        const double within = is_least ? INFINITY : attempt < FB_USUAL_ATTEMPTS ? 0.0 : soon;
        double error = 0.0;
        for (const fb_observer *o = r->observers; o; o = o->next) {
            status = o->after_step ? o->after_step(o->of, s, within, &error) : 0;
            if (status < 0)
                return status;
        }
        /* Derivatives that are not finite ask for nothing. */
        const double factor = fb_step_factor(s->tableau->order, error);
        const double length = fabs(s->h) * fb_change(factor, error < 1.0, 0);
        if (!(error >= 1.0)) {
            const int limits = factor < FB_MAX_FACTOR && length < r->h_abs;
            if (limits)
                r->h_abs = length;
            r->pace.n_limited += limits || attempt > 0;
            return FB_RUN_PAUSED;
        }
        fb_undo(r);
        r->h_abs = length;
    }
}

#endif
