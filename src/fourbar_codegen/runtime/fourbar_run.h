/* A run: steps of a method of step control, projection onto the constraints, samples, events, and what observes it. */
#ifndef FOURBAR_RUN_H
#define FOURBAR_RUN_H

#include "fourbar_runge_kutta.h"

/* Attempts at a step that errors of derivatives may usually need, and the fraction of the first one's length in which
 * derivatives grow to the size with which errors of further attempts are compared. */
#define FB_USUAL_ATTEMPTS 3
#define FB_SOON 1e-2

/* Fractions of the average step below which the steps have collapsed, and above which they have recovered. */
#define FB_COLLAPSE 1e-9
#define FB_RECOVERY 1e-3

/* Derivatives have collapsed if their errors limit half of so many steps, and these are so small a fraction of
 * the average step: next to a singular position rounding errors of derivatives do not fall as the steps do. */
#define FB_SLOW 3e-2
enum { FB_WINDOW = 100 };

/* States along a step at which the sign of det J_d is evaluated, if the ends are not conclusive. */
enum { FB_LOOKS = 8 };

/* A position is singular if the least pivot of J is below this fraction of its mean over a run: within a step after
 * which the sign of det J_d is another one, and where a step fails. */
#define FB_PASSED_RATIO 1e-4
#define FB_FAILED_RATIO 1e-3

/* Samples at given times, or after each step. */
typedef struct fb_samples {
    const double *times; /* or NULL */
    long n_times, next_time;
    double *t, *x; /* (room,) or NULL, (room, n) */
    long room, n;
    int pending;  /* whether the last step's samples are still to be taken */
    double until; /* no samples after this time */
} fb_samples;

/* The part of a run between two boundaries: its beginning and end, by the run's clock; and the first and the last time,
 * in the order of the run, at which inputs are evaluated. */
typedef struct fb_segment {
    double t, t_bound, first, last;
} fb_segment;

/* How the run itself finds singular positions: by the least pivot of J, relative to its geometric mean over time. */
typedef struct fb_singular {
    double (*least_pivot)(fb_stepper *s, double t, const double *x); /* or NULL: who examines the steps finds them */
    double typical, integral;                                        /* the mean, and the integral of the logarithm */
} fb_singular;

/* What may end a run within a step: outputs whose changes of sign are events, and det J_d. */
typedef struct fb_watch {
    int n_events;
    const int *output, *direction;
    double *value, *old; /* (n_events,): at the end and at the beginning of the last step */
    double *outputs;     /* (n_u + n_l + n_o,), scratch */
    double *along;       /* (2, padded): a state within the last step, and x' there */
    int look_at_all;     /* whether to examine every step */
    int toggled;         /* whether the sign of det J_d has changed in the last step */
    fb_singular singular;
} fb_watch;

/* How fast a run proceeds, by which its steps are found to have collapsed. */
typedef struct fb_pace {
    double t_begin;
    int collapsed; /* whether that was reported */
    /* the steps limited by derivatives since a step, its number and time */
    long n_limited, marked;
    double marked_t;
} fb_pace;

/* The steps taken, from which fourbar_adjoint.h goes backwards. A row has the time at the end of a step, its length and
 * the state; the length is 0 where the run begins, or continues from another state. */
typedef struct fb_record {
    long n, room;
    double *rows;     /* (room, 2 + n_x) */
    long *sample_row; /* for each sample in the room of fb_samples: the number of the last row, and the time */
    double *sample_t;
} fb_record;

struct fb_forward;

/* Sensitivities, by fourbar_forward.h: what is done after a step, which is repeated with a shorter one unless the error
 * is below 1; where the last step is taken back; for a sample at t, x, if not NULL; where the run goes on, from another
 * state if it has moved; and where it ends, at t, x within the last step. */
typedef struct fb_observer {
    struct fb_forward *forward; /* or NULL */
    int (*after_step)(fb_stepper *s, struct fb_forward *forward, double soon, double *error);
    void (*take_back)(struct fb_forward *forward);
    int (*at_sample)(fb_stepper *s, struct fb_forward *forward, long sample, double t, const double *x);
    int (*at_restart)(fb_stepper *s, struct fb_forward *forward, int moved);
    int (*at_end)(fb_stepper *s, struct fb_forward *forward, double t, const double *x);
} fb_observer;

typedef struct fb_run {
    fb_stepper stepper;
    double direction, t_bound, max_step;
    double h_abs; /* the proposal for the next step */
    fb_samples samples;
    fb_watch watch;
    fb_pace pace;
    fb_observer observer;
    fb_record *record; /* or NULL */
} fb_run;

/* x' at the beginning, and the length of the first step. */
static inline int fb_begin(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    s->fsal = 0;
    const int status = s->method->init(s, r->direction, fabs(r->t_bound - s->t), r->max_step, &r->h_abs);
    fb_singular *const singular = &r->watch.singular;
    if (status == 0 && singular->least_pivot) {
        singular->typical = singular->least_pivot(s, s->t, s->x);
        singular->integral = 0.0;
    }
    return status;
}

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
        double t_new = s->t + h_abs * r->direction, error = NAN;
        if (r->direction * (t_new - r->t_bound) > -margin) {
            t_new = r->t_bound;
            proposed = rejected ? 0.0 : h_abs;
        }
        h_abs = fabs(t_new - s->t);
        if (!isfinite(h_abs))
            return FB_RUN_INFINITE;
        int status = method->attempt(s, t_new, &error);
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

/* Takes the last step back, and its derivatives. */
static inline void fb_undo(fb_run *r)
{
    fb_take_back(&r->stepper);
    if (r->observer.forward)
        r->observer.take_back(r->observer.forward);
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
        if (status != FB_RUN_PAUSED || !r->observer.forward)
            return status;
        if (attempt == 0)
            soon = FB_SOON * fabs(s->h);
        const int is_least = fabs(s->h) * FB_MIN_FACTOR < fb_least_step(s->t_old, r->direction);
        double error = 0.0;
        status = r->observer.after_step(s, r->observer.forward,
                                        is_least                      ? INFINITY
                                        : attempt < FB_USUAL_ATTEMPTS ? 0.0
                                                                      : soon,
                                        &error);
        if (status < 0)
            return status;
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

/* Whether the sign of det J_d has also changed between neighbours of several states along the last step. If
 * not, J kept its rank, and the step was only long. Ends with an evaluation at the state reached. */
static inline int fb_toggled_within(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    double *const along = r->watch.along;
    const long n_evaluations = s->n_evaluations; /* these evaluations are not counted, like those for events */
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

/* Looks at the last step: FB_RUN_PAUSED if there is nothing to examine. */
static inline int fb_look(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_watch *const watch = &r->watch;
    const int finds_singular = watch->singular.least_pivot != NULL;
    /* Methods that pass singular positions need not detect them. */
    watch->toggled = s->method->projects ? 0 : s->problem->kernel->toggled(s->problem->work);
    if (watch->toggled)
        watch->toggled = fb_toggled_within(r);
    if (watch->toggled < 0)
        return watch->toggled;
    if (watch->toggled && finds_singular) {
        const int passes = fb_passes_singular_position(r);
        if (passes != 0)
            return passes < 0 ? passes : FB_RUN_SINGULAR;
    }
    const int events = fb_events_within(r);
    if (events < 0)
        return events;
    if (finds_singular)
        fb_note_pivot(r);
    return watch->look_at_all || events || (watch->toggled && !finds_singular) ? FB_RUN_EVENT : FB_RUN_PAUSED;
}

/* Whether the errors of derivatives have made the steps of a window collapse. */
static inline int fb_derivatives_collapsed(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_pace *const pace = &r->pace;
    const double length = fabs(s->t - pace->marked_t) / FB_WINDOW;
    const double average = fabs(s->t - pace->t_begin) / (double)s->n_steps;
    const int collapsed = 2 * pace->n_limited >= FB_WINDOW && length < FB_SLOW * average;
    pace->n_limited = 0;
    pace->marked = s->n_steps;
    pace->marked_t = s->t;
    return collapsed;
}

/* Whether the steps have collapsed; said once for each collapse. */
static inline int fb_has_collapsed(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_pace *const pace = &r->pace;
    const double share = s->n_steps > 9 ? r->h_abs * (double)s->n_steps / fabs(s->t - pace->t_begin) : 1.0;
    if (share < FB_COLLAPSE && !pace->collapsed) {
        pace->collapsed = 1;
        return 1;
    }
    if (share > FB_RECOVERY)
        pace->collapsed = 0;
    return r->observer.forward && s->n_steps - pace->marked == FB_WINDOW && fb_derivatives_collapsed(r);
}

/* Discards the last step: the run ends before it. */
static inline void fb_discard(fb_run *r)
{
    fb_undo(r);
    if (r->record)
        r->record->n -= 1;
}

/* Up to n steps; returns an FB_RUN, or negative from the callback of inputs. */
static inline int fb_run_on(fb_run *r, long n)
{
    for (;;) {
        if (r->samples.pending) {
            const int status = fb_sample(r);
            if (status != FB_RUN_PAUSED)
                return status;
        }
        if (r->stepper.t == r->t_bound)
            return FB_RUN_END;
        if (n-- <= 0)
            return FB_RUN_PAUSED;
        if (r->record && r->record->n == r->record->room)
            return FB_RUN_FULL;
        if (fb_has_collapsed(r))
            return FB_RUN_COLLAPSED;
        int status = fb_observed_step(r);
        if (status > FB_RUN_PAUSED && fb_fails_near_singular_position(r))
            return FB_RUN_SINGULAR;
        if (status != FB_RUN_PAUSED)
            return status;
        if (r->record)
            fb_keep_step(r, r->stepper.h);
        status = fb_look(r);
        if (status == FB_RUN_SINGULAR)
            fb_discard(r);
        if (status != FB_RUN_PAUSED)
            return status;
    }
}

/* The segment in which the run goes on. */
static inline void fb_set_segment(fb_run *r, const fb_segment *segment)
{
    fb_clock *const clock = &r->stepper.problem->clock;
    clock->first = segment->first < segment->last ? segment->first : segment->last;
    clock->last = segment->first < segment->last ? segment->last : segment->first;
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
    int status = r->observer.forward ? r->observer.at_restart(s, r->observer.forward, x != NULL) : 0;
    if (status < 0)
        return status;
    if (r->record && x)
        fb_keep_step(r, 0.0);
    status = fb_resume(s);
    if (status == 0)
        status = fb_move_events_on(r);
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
    if (status < 0)
        return status;
    if (r->observer.forward)
        status = r->observer.at_end(s, r->observer.forward, t, along);
    memcpy(s->x, along, (size_t)s->n * sizeof *along);
    s->t = t;
    return status;
}

#endif
