/* Explicit Runge-Kutta methods with an embedded error estimate, and steps of fixed length.
 *
 * Error norm, first step and step control are those of SciPy's RK45 and DOP853 (E. Hairer, S. P. Norsett, G. Wanner,
 * Solving Ordinary Differential Equations I, sections II.4 and II.5), so that a run without projection takes the same
 * steps.
 */
#ifndef FOURBAR_RUNGE_KUTTA_H
#define FOURBAR_RUNGE_KUTTA_H

#include "../kernel/breakpoints.h"
#include "step_control.h"
#include "stepper.h"

/* The root mean square of x - y in units of the tolerances at the state reached; y may be NULL. */
static inline double fb_rms(const fb_stepper *s, const double *x, const double *y)
{
    double sum = 0.0;
    for (int i = 0; i < s->n; ++i) {
        const double scaled = (x[i] - (y ? y[i] : 0.0)) / (s->atol[i] + fabs(s->x[i]) * s->rtol[i]);
        sum += scaled * scaled;
    }
    return sqrt(sum / s->n);
}

static inline int fb_runge_kutta_init(fb_stepper *s, const double direction, const double interval,
                                      const double max_step, double *h_abs)
{
    double *const f0 = s->stages, *const f1 = s->stages + s->padded;
    int status = fb_evaluate(s, s->t, s->x, f0);
    if (status < 0)
        return status;
    s->problem->kernel->toggled(s->problem->work);
    const double of_state = fb_rms(s, s->x, NULL), of_rates = fb_rms(s, f0, NULL);
    const double trial = fb_trial_length(of_state, of_rates, interval);
    for (int i = 0; i < s->padded; ++i)
        s->x_new[i] = s->x[i] + trial * direction * f0[i];
    status = fb_evaluate(s, s->t + trial * direction, s->x_new, f1);
    if (status < 0)
        return status;
    *h_abs = fb_initial_length(trial, of_rates, fb_rms(s, f1, f0) / trial, s->tableau->order, interval, max_step);
    return 0;
}

/* The stages of a step of length h, and x at its end in `x_new`. */
static inline int fb_stages(fb_stepper *s, const double h)
{
    return fb_take_stages(s, s->tableau, &s->weights, s->padded, s->stages, s->t, h, s->x, s->x_new);
}

/* The root mean square of the error estimate in units of the tolerances. */
static inline double fb_error_of(const fb_stepper *s, const double h)
{
    double sums[2];
    fb_estimate_error(s->tableau, &s->weights, s->padded, s->stages, h, s->n, s->rtol, s->atol, s->x, s->x_new,
                      s->interpolant, sums);
    return fb_error_norm(s->n, s->tableau->n_errors, h, sums[0], sums[1]);
}

static inline int fb_runge_kutta_attempt(fb_stepper *s, const double t_new, double *error)
{
    const fb_weights *const estimate = s->weights.error;
    const double h = t_new - s->t;
    int status = fb_stages(s, h);
    /* With projection x' at the end is evaluated after it, unless the error estimate needs it. */
    if (status == 0 && (!s->project || estimate->stage[estimate->n - 1] == s->tableau->n_stages))
        status = fb_evaluate(s, t_new, s->x_new, fb_end_rates(s));
    if (status == 0)
        *error = fb_error_of(s, h);
    return status;
}

static inline double fb_runge_kutta_length(const fb_stepper *s, const double h_abs, const double error,
                                           const int rejected)
{
    return h_abs * fb_change(fb_step_factor(s->tableau->order, error), error < 1.0, rejected);
}

static const fb_method fb_runge_kutta = {.init = fb_runge_kutta_init,
                                         .attempt = fb_runge_kutta_attempt,
                                         .stages = fb_stages,
                                         .restart = fb_evaluate,
                                         .next_length = fb_runge_kutta_length,
                                         .interpolate = fb_interpolate_step};

/* The tolerance of the equations of an implicit step, relative and absolute, and the most halvings of it. */
#define FB_STEP_TOLERANCE 1e-8
enum { FB_STEP_HALVINGS = 40 };

/* The time after n steps of length h, rounded once; sums of h could miss the end of a run by a step. */
static inline double fb_fixed_time(const double t_begin, const double h, const int64_t n)
{
    return t_begin + (double)n * h;
}

/* A step of length h to t_new without an error estimate; the status of the kernel if it fails. */
static inline int fb_fixed_step(fb_stepper *s, const double h, const double t_new)
{
    fb_problem *const p = s->problem;
    int status = fb_evaluate(s, s->t, s->x, s->stages);
    if (status == 0)
        status = s->method->stages(s, h);
    if (status != 0)
        return status;
    if (p->status != FB_OK || !fb_finite(s->x_new, s->n))
        return p->status != FB_OK ? p->status : FB_NOT_FINITE;
    if (s->project) {
        status = fb_problem_project(p, t_new, s->x_new, 1);
        if (status != FB_OK)
            return status;
    }
    fb_accept(s, t_new);
    return FB_OK;
}

/* The same, or a shorter step where the equations of an implicit method have no solution: half as long, and so on. */
static inline int fb_fixed_part(fb_stepper *s, double h, const double t_new)
{
    int status = fb_fixed_step(s, h, t_new);
    for (int k = 0; k < FB_STEP_HALVINGS && status > FB_OK && s->own != NULL; ++k) {
        h *= 0.5;
        if (s->t + h == s->t)
            return status;
        s->problem->status = FB_OK;
        status = fb_fixed_step(s, h, s->t + h);
    }
    return status;
}

/* Enters the part of a step of length h from t_old to t_new that ends at the next breakpoint, or with the step; returns
 * its length. */
static inline double fb_enter_part(fb_stepper *s, const double h, const double t_old, const double t_new,
                                   fb_next_segment *next, void *of, double *t_bound)
{
    const fb_segment segment = next(of, s->t, t_new);
    fb_enter_clock(&s->problem->clock, &segment);
    *t_bound = segment.t_bound;
    return s->t == t_old && segment.t_bound == t_new ? h : segment.t_bound - s->t;
}

/* A step of length h to t_new across breakpoints, which divide it, in parts as `fb_fixed_part`. */
static inline int fb_fixed_step_across(fb_stepper *s, const double h, const double t_new, fb_next_segment *next,
                                       void *of)
{
    const double t_old = s->t;
    int status = FB_OK;
    while (status == FB_OK && s->t != t_new) {
        double t_bound;
        const double length = fb_enter_part(s, h, t_old, t_new, next, of, &t_bound);
        status = fb_fixed_part(s, length, t_bound);
    }
    return status;
}

#endif
