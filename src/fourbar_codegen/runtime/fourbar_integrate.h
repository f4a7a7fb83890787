/* A run of an explicit Runge-Kutta method: steps, projection onto the constraints, interpolation, samples.
 *
 * Error norm, first step and step control are those of SciPy's RK45 and DOP853 (E. Hairer, S. P. Norsett, G. Wanner,
 * Solving Ordinary Differential Equations I, sections II.4 and II.5), so that a run without projection takes the same
 * steps. Arrays of states are padded to whole blocks with zeros.
 */
#ifndef FOURBAR_INTEGRATE_H
#define FOURBAR_INTEGRATE_H

#include "fourbar_problem.h"
#include "fourbar_real.h"
#include "fourbar_tableau.h"

#include <math.h>
#include <string.h>

/* Step control: safety factor of a step's length, and limits of its change. */
#define FB_SAFETY 0.9
#define FB_MIN_FACTOR 0.2
#define FB_MAX_FACTOR 10.0

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

enum { FB_BLOCK = 8, FB_MAX_STAGES = 16 };

/* States along a step at which the sign of det J_d is evaluated, if the ends are not conclusive. */
enum { FB_LOOKS = 8 };

/* The weights of a linear combination of stages, without zeros. */
typedef struct fb_weights {
    int n;
    int stage[FB_MAX_STAGES];
    double weight[FB_MAX_STAGES];
} fb_weights;

/* The steps taken, from which fourbar_adjoint.h goes backwards. A row has the time at the end of a step, its length and
 * the state; the length is 0 where the run begins, or continues from another state. */
typedef struct fb_steps {
    long n, room;
    double *rows;     /* (room, 2 + n_x) */
    long *sample_row; /* for each sample in the room of fb_run: the number of the last row, and the time */
    double *sample_t;
} fb_steps;

/* An evaluation of x' that is needed again: its state, and the inputs and workspace that it leaves. */
typedef struct fb_kept {
    double *x;      /* (padded,) */
    double *inputs; /* (n_r,) */
    double *work;
} fb_kept;

struct fb_augmented;
struct fb_forward;

typedef struct fb_run fb_run;

struct fb_run {
    fb_problem *problem;
    const fb_tableau *method;
    int (*step)(fb_run *run);       /* one accepted step: FB_RUN_PAUSED, or the reason of failure */
    struct fb_augmented *augmented; /* for fourbar_augmented.h, or NULL */
    /* sensitivities, by fourbar_forward.h, or NULL: them, and what is done after a step, which is repeated with a
     * shorter one unless the error is below 1, and, if not NULL, for a sample at t, x */
    struct fb_forward *forward;
    int (*step_jvp)(fb_run *run, double soon, double *error);
    int (*sample_jvp)(fb_run *run, double t, const double *x);
    fb_kept *kept;   /* for each row of `stages`, or NULL */
    fb_steps *steps; /* or NULL */
    fb_weights stage[FB_MAX_STAGES], error[2], more[4], dense[4];
    int n, padded;
    double direction, t_bound, max_step;
    const double *rtol, *atol; /* (padded,), the padding not 0 */
    int project;
    /* the state, the last step, and the proposal for the next */
    double t, t_old, h, h_abs;
    double *x, *x_old, *scratch; /* (padded,) */
    double *along;               /* (2, padded): a state within the last step, and x' there */
    double *stages;              /* (s + 1 + n_extra, padded): x' at the beginning, the stages, x' at the end */
    double *interpolant;         /* (n_dense + 3, padded) */
    int fsal;                    /* whether x' at the end of the last step is that at the beginning of the next one */
    int interpolant_valid;
    long n_evaluations, n_steps;
    double t_begin;
    int collapsed;          /* whether that was reported */
    long n_limited, marked; /* the steps limited by derivatives since a step, its number and time */
    double marked_t;
    /* samples at given times, or after each step */
    const double *times; /* or NULL */
    long n_times, next_time;
    double *sample_t, *sample_x; /* (room,), (room, n) */
    long room, n_samples;
    int pending;     /* whether the last step's samples are still to be taken */
    double until;    /* no samples after this time */
    int toggled;     /* whether the sign of det J_d has changed in the last step */
    int look_at_all; /* whether to examine every step */
    /* outputs whose changes of sign are events */
    int n_events;
    const int *event_output, *event_direction;
    double *event_value, *event_old; /* (n_events,) */
    double *outputs;                 /* (n_u + n_l + n_o,), scratch */
};

static inline void fb_weights_of(const double *dense, const int n, fb_weights *weights)
{
    weights->n = 0;
    for (int i = 0; i < n; ++i)
        if (dense[i] != 0.0) {
            weights->stage[weights->n] = i;
            weights->weight[weights->n++] = dense[i];
        }
}

static inline void fb_prepare_method(fb_run *s)
{
    const fb_tableau *const m = s->method;
    const int n = m->n_stages;
    for (int k = 1; k < n; ++k)
        fb_weights_of(m->a + k * n, k, s->stage + k);
    fb_weights_of(m->b, n, s->stage + n);
    for (int i = 0; i < m->n_errors; ++i)
        fb_weights_of(m->error + i * (n + 1), n + 1, s->error + i);
    for (int i = 0; i < m->n_extra; ++i)
        fb_weights_of(m->a_extra + i * (n + 1 + m->n_extra), n + 1 + i, s->more + i);
    for (int i = 0; i < m->n_dense; ++i)
        fb_weights_of(m->dense + i * (n + 1 + m->n_extra), n + 1 + m->n_extra, s->dense + i);
}

/* base + factor times the weighted sum of rows of length n, whole blocks; base may be NULL. */
static FB_INLINE void fb_combine_rows(const double *rows, const int n, const fb_weights *w, const double factor,
                                      const double *base, double *restrict result)
{
    for (int i = 0; i < n; i += FB_BLOCK) {
        double sum[FB_BLOCK] = {0.0};
        for (int j = 0; j < w->n; ++j) {
            const double *const row = rows + w->stage[j] * n + i;
            const double weight = w->weight[j];
            for (int k = 0; k < FB_BLOCK; ++k)
                sum[k] += weight * row[k];
        }
        for (int k = 0; k < FB_BLOCK; ++k)
            result[i + k] = (base ? base[i + k] : 0.0) + factor * sum[k];
    }
}

static inline void fb_combine(const fb_run *s, const fb_weights *w, const double factor, const double *base,
                              double *restrict result)
{
    fb_combine_rows(s->stages, s->padded, w, factor, base, result);
}

static inline int fb_evaluate(fb_run *s, const double t, const double *x, double *rates)
{
    s->n_evaluations += 1;
    return fb_problem_rates(s->problem, t, x, rates);
}

/* Makes a problem use the inputs and the workspace of a kept evaluation; a second call takes that back. */
static inline void fb_swap_kept(fb_problem *p, fb_kept *kept)
{
    double *const inputs = p->inputs, *const work = p->work;
    p->inputs = kept->inputs;
    p->work = kept->work;
    kept->inputs = inputs;
    kept->work = work;
}

/* Evaluates a row of `stages`, and keeps the evaluation if that is asked for. */
static inline int fb_evaluate_row(fb_run *s, const int row, const double t, const double *x)
{
    double *const rates = s->stages + row * s->padded;
    if (!s->kept)
        return fb_evaluate(s, t, x, rates);
    fb_kept *const kept = s->kept + row;
    memcpy(kept->x, x, (size_t)s->n * sizeof *x);
    fb_swap_kept(s->problem, kept);
    const int status = fb_evaluate(s, t, x, rates);
    fb_swap_kept(s->problem, kept);
    return status;
}

/* The error estimate of a step from sums of squares of its parts in units of the tolerances. */
static inline double fb_error_norm(const fb_run *s, const double h, const double sum, const double sum3)
{
    if (s->method->n_errors < 2)
        return sqrt(sum / s->n);
    return sum == 0.0 && sum3 == 0.0 ? 0.0 : fabs(h) * sum / sqrt((sum + 0.01 * sum3) * s->n);
}

/* The root mean square of the error estimate in units of the tolerances. */
static inline double fb_error_of(const fb_run *s, const double h, const double *x, const double *x_new,
                                 double *restrict error, double *restrict error3)
{
    const int two = s->method->n_errors == 2;
    fb_combine(s, s->error, two ? 1.0 : h, NULL, error);
    if (two)
        fb_combine(s, s->error + 1, 1.0, NULL, error3);
    double sum = 0.0, sum3 = 0.0;
    for (int i = 0; i < s->n; ++i) {
        const double size = fabs(x[i]), size_new = fabs(x_new[i]);
        const double scale = s->atol[i] + (size > size_new ? size : size_new) * s->rtol[i];
        sum += (error[i] / scale) * (error[i] / scale);
        if (two)
            sum3 += (error3[i] / scale) * (error3[i] / scale);
    }
    return fb_error_norm(s, h, sum, sum3);
}

static inline double fb_rms(const fb_run *s, const double *x, const double *y, const double *scale_by)
{
    double sum = 0.0;
    for (int i = 0; i < s->n; ++i) {
        const double scaled = (x[i] - (y ? y[i] : 0.0)) / (s->atol[i] + fabs(scale_by[i]) * s->rtol[i]);
        sum += scaled * scaled;
    }
    return sqrt(sum / s->n);
}

/* x' at the beginning, and the length of the first step. */
static inline int fb_begin(fb_run *s)
{
    double *const f0 = s->stages, *const f1 = s->stages + s->padded;
    int status = fb_evaluate(s, s->t, s->x, f0);
    if (status < 0)
        return status;
    s->problem->kernel->toggled(s->problem->work);
    const double interval = fabs(s->t_bound - s->t);
    const double d0 = fb_rms(s, s->x, NULL, s->x), d1 = fb_rms(s, f0, NULL, s->x);
    double h0 = d0 < 1e-5 || d1 < 1e-5 ? 1e-6 : 0.01 * d0 / d1;
    h0 = interval < h0 ? interval : h0;
    for (int i = 0; i < s->padded; ++i)
        s->scratch[i] = s->x[i] + h0 * s->direction * f0[i];
    status = fb_evaluate(s, s->t + h0 * s->direction, s->scratch, f1);
    if (status < 0)
        return status;
    const double d2 = fb_rms(s, f1, f0, s->x) / h0;
    /* Compares like Python: NaN, from a trial step outside of the equations' domain, is ignored. */
    const double largest = d2 > d1 ? d2 : d1;
    double h1 = d1 <= 1e-15 && d2 <= 1e-15 ? (h0 * 1e-3 > 1e-6 ? h0 * 1e-3 : 1e-6)
                                           : pow(0.01 / largest, 1.0 / (s->method->order + 1.0));
    h1 = h1 < 100.0 * h0 ? h1 : 100.0 * h0;
    h1 = interval < h1 ? interval : h1;
    s->h_abs = s->max_step < h1 ? s->max_step : h1;
    return 0;
}

/* The stages of a step of length h, and x at its end in `scratch`. The projection there needs the workspace of the last
 * stage, which is not kept. */
static inline int fb_stages(fb_run *s, const double h)
{
    const fb_tableau *const m = s->method;
    for (int k = 1; k <= m->n_stages; ++k) {
        fb_combine(s, s->stage + k, h, s->x, s->scratch);
        if (k < m->n_stages) {
            const double t = s->t + m->c[k] * h;
            const int is_last = k == m->n_stages - 1;
            const int status = is_last ? fb_evaluate(s, t, s->scratch, s->stages + k * s->padded)
                                       : fb_evaluate_row(s, k, t, s->scratch);
            if (status < 0)
                return status;
        }
    }
    return 0;
}

/* Accepts the step to t + h. x' at its end, in the last row of stages, is moved to the first row at the next step. */
static inline void fb_accept(fb_run *s, const double t_new)
{
    double *const x_new = s->scratch;
    s->scratch = s->x_old;
    s->x_old = s->x;
    s->x = x_new;
    s->t_old = s->t;
    s->h = t_new - s->t;
    s->t = t_new;
    s->n_steps += 1;
    s->interpolant_valid = 0;
    s->fsal = 1;
    s->pending = 1;
}

/* Takes the last step back, to be repeated with another length. x' at its beginning is still in the first row. */
static inline void fb_take_back(fb_run *s, const double h_abs)
{
    double *const x_new = s->x;
    s->x = s->x_old;
    s->x_old = s->scratch;
    s->scratch = x_new;
    s->t = s->t_old;
    s->n_steps -= 1;
    s->fsal = 0;
    s->pending = 0;
    s->h_abs = h_abs;
}

/* x' where a run continues after a breakpoint, with unchanged step length. */
static inline int fb_resume(fb_run *s)
{
    s->fsal = 0;
    return fb_evaluate(s, s->t, s->x, s->stages);
}

/* The smallest length of a step from t, ... */
static inline double fb_least_step(const double t, const double direction)
{
    return 10.0 * fabs(nextafter(t, direction * INFINITY) - t);
}

/* ... the first length that is tried for a proposed one, ... */
static inline double fb_first_length(const double h_abs, const double max_step, const double min_step)
{
    return h_abs > max_step ? max_step : h_abs < min_step ? min_step : h_abs;
}

/* ... and its change, for a factor from the error estimate; NaN means an unknown error. */
static inline double fb_change(const double factor, const int taken, const int rejected)
{
    if (!taken)
        return factor > FB_MIN_FACTOR ? factor : FB_MIN_FACTOR;
    const double largest = rejected ? 1.0 : FB_MAX_FACTOR;
    return factor < largest ? factor : largest;
}

/* The factor of a step's length by which the error estimate would become 1, but for the safety factor. */
static inline double fb_step_factor(const fb_run *s, const double error)
{
    return error == 0.0 ? FB_MAX_FACTOR : FB_SAFETY * pow(error, -1.0 / (s->method->order + 1.0));
}

/* One accepted step; an FB_RUN, or negative from the callback of inputs. */
static inline int fb_step_on(fb_run *s)
{
    const fb_tableau *const m = s->method;
    const double min_step = fb_least_step(s->t, s->direction);
    double *const end = s->stages + m->n_stages * s->padded;
    double *const error = s->interpolant, *const error3 = s->interpolant + s->padded;
    double h_abs = fb_first_length(s->h_abs, s->max_step, min_step);
    double proposed = 0.0; /* for a step that ends with the run, or at a breakpoint */
    int rejected = 0;
    s->interpolant_valid = 0;
    if (s->fsal)
        memcpy(s->stages, end, (size_t)s->padded * sizeof *end);
    for (;;) {
        /* Also if it is NaN. */
        if (!(h_abs >= min_step))
            return FB_RUN_TOO_SMALL;
        double t_new = s->t + h_abs * s->direction;
        if (s->direction * (t_new - s->t_bound) > 0.0) {
            t_new = s->t_bound;
            proposed = rejected ? 0.0 : h_abs;
        }
        const double h = t_new - s->t;
        h_abs = fabs(h);
        if (!isfinite(h))
            return FB_RUN_INFINITE;
        int status = fb_stages(s, h);
        /* With projection x' at the end is evaluated after it, unless the error estimate needs it. */
        const int first = !s->project || s->error[0].stage[s->error[0].n - 1] == m->n_stages;
        if (status == 0 && first)
            status = fb_evaluate(s, t_new, s->scratch, end);
        if (status < 0)
            return status;
        double error_norm = fb_error_of(s, h, s->x, s->scratch, error, error3);
        if (error_norm < 1.0 && s->project) {
            status = fb_problem_project(s->problem, t_new, s->scratch, 1);
            if (status < 0)
                return status;
            if (status == FB_OK) {
                status = fb_evaluate(s, t_new, s->scratch, end);
                if (status < 0)
                    return status;
            } else
                error_norm = NAN;
        }
        if (error_norm < 1.0 && !fb_finite(end, s->n))
            error_norm = NAN;
        h_abs *= fb_change(fb_step_factor(s, error_norm), error_norm < 1.0, rejected);
        if (error_norm < 1.0) {
            s->h_abs = h_abs > proposed ? h_abs : proposed;
            fb_accept(s, t_new);
            return FB_RUN_PAUSED;
        }
        rejected = 1;
        proposed = 0.0; /* too long, as it turned out */
    }
}

/* The time after n steps of length h, rounded once; sums of h could miss the end of a run by a step. */
static inline double fb_fixed_time(const fb_run *s, const double h, const long n)
{
    return s->t_begin + (double)n * h;
}

/* A step of length h to t_new by a method without an error estimate; the status of the kernel if it fails. */
static inline int fb_step_to(fb_run *s, const double h, const double t_new)
{
    fb_problem *const p = s->problem;
    int status = fb_evaluate(s, s->t, s->x, s->stages);
    if (status == 0)
        status = fb_stages(s, h);
    if (status < 0)
        return status;
    if (p->status != FB_OK || !fb_finite(s->scratch, s->n))
        return p->status != FB_OK ? p->status : FB_NOT_FINITE;
    if (s->project) {
        status = fb_problem_project(p, t_new, s->scratch, 1);
        if (status != FB_OK)
            return status;
    }
    fb_accept(s, t_new);
    return FB_OK;
}

static inline int fb_fixed_step(fb_run *s, const double h)
{
    return fb_step_to(s, h, fb_fixed_time(s, h, s->n_steps + 1));
}

/* The coefficients of the last step's interpolant. */
static inline int fb_prepare_interpolant(fb_run *s)
{
    const fb_tableau *const m = s->method;
    if (s->interpolant_valid)
        return 0;
    if (!m->hermite) {
        for (int i = 0; i < m->n_dense; ++i)
            fb_combine(s, s->dense + i, s->h, NULL, s->interpolant + i * s->padded);
    } else {
        for (int i = 0; i < m->n_extra; ++i) {
            fb_combine(s, s->more + i, s->h, s->x_old, s->scratch);
            const int status = fb_evaluate_row(s, m->n_stages + 1 + i, s->t_old + m->c_extra[i] * s->h, s->scratch);
            if (status < 0)
                return status;
        }
        const double *const f_old = s->stages, *const f = s->stages + m->n_stages * s->padded;
        for (int i = 0; i < s->padded; ++i) {
            const double change = s->x[i] - s->x_old[i];
            s->interpolant[i] = change;
            s->interpolant[s->padded + i] = s->h * f_old[i] - change;
            s->interpolant[2 * s->padded + i] = 2.0 * change - s->h * (f[i] + f_old[i]);
        }
        for (int i = 0; i < m->n_dense; ++i)
            fb_combine(s, s->dense + i, s->h, NULL, s->interpolant + (3 + i) * s->padded);
    }
    s->interpolant_valid = 1;
    return 0;
}

/* The interpolant: rows of coefficients for t in (t_old, t_old + h). */
static FB_INLINE void fb_interpolate(const fb_tableau *m, const double *coefficients, const int n, const int padded,
                                     const double *x_old, const double y, double *restrict x)
{
    const int last = m->n_dense - 1 + (m->hermite ? 3 : 0);
    for (int i = 0; i < n; ++i)
        x[i] = 0.0;
    for (int k = last; k >= 0; --k) {
        const double *const row = coefficients + k * padded;
        const double factor = m->hermite && (last - k) % 2 ? 1.0 - y : y;
        for (int i = 0; i < n; ++i)
            x[i] = (x[i] + row[i]) * factor;
    }
    for (int i = 0; i < n; ++i)
        x[i] += x_old[i];
}

/* Projects an interpolant onto the constraints. It is unchanged if no state nearby satisfies them, and NaN where they
 * have no value. */
static inline int fb_project_sample(fb_problem *p, const double t, double *x)
{
    const int closed = fb_problem_project(p, t, x, 0);
    if (closed == FB_NOT_FINITE)
        for (int i = 0; i < p->kernel->n_x; ++i)
            x[i] = NAN;
    return closed < 0 ? closed : 0;
}

/* The state at a time in the last step; the present state if there was no step since the start or continuation. */
static inline int fb_state_at(fb_run *s, const double t, double *x)
{
    if (t == s->t || !s->fsal) {
        memcpy(x, s->x, (size_t)s->n * sizeof *x);
        return 0;
    }
    const int status = fb_prepare_interpolant(s);
    if (status < 0)
        return status;
    fb_interpolate(s->method, s->interpolant, s->n, s->padded, s->x_old, (t - s->t_old) / s->h, x);
    if (!s->project)
        return 0;
    return fb_project_sample(s->problem, t, x);
}

/* Keeps the state reached by a step of length h. */
static inline void fb_keep_step(fb_run *s, const double h)
{
    double *const row = s->steps->rows + s->steps->n++ * (2 + s->n);
    row[0] = s->t;
    row[1] = h;
    memcpy(row + 2, s->x, (size_t)s->n * sizeof *row);
}

/* Notes where a sample lies among the steps, and its derivatives. */
static inline int fb_note_sample(fb_run *s, const double t, const double *x)
{
    if (s->steps) {
        s->steps->sample_row[s->n_samples] = s->steps->n - 1;
        s->steps->sample_t[s->n_samples] = t;
    }
    return s->sample_jvp ? s->sample_jvp(s, t, x) : 0;
}

/* The samples of the last step; FB_RUN_FULL if there is no room for them. */
static inline int fb_sample(fb_run *s)
{
    if (s->times == NULL) {
        if (s->n_samples == s->room)
            return FB_RUN_FULL;
        s->sample_t[s->n_samples] = s->t;
        memcpy(s->sample_x + s->n_samples * s->n, s->x, (size_t)s->n * sizeof *s->x);
        const int status = fb_note_sample(s, s->t, s->x);
        if (status < 0)
            return status;
        s->n_samples += 1;
    } else {
        while (s->next_time < s->n_times) {
            const double t = s->times[s->next_time];
            if (s->direction * (t - s->t) > 0.0 || s->direction * (t - s->until) > 0.0)
                break;
            if (s->n_samples == s->room)
                return FB_RUN_FULL;
            double *const x = s->sample_x + s->n_samples * s->n;
            int status = fb_state_at(s, t, x);
            if (status == 0)
                status = fb_note_sample(s, t, x);
            if (status < 0)
                return status;
            s->sample_t[s->n_samples++] = t;
            s->next_time += 1;
        }
    }
    s->pending = 0;
    return FB_RUN_PAUSED;
}

/* The values of the outputs that are event functions. */
static inline int fb_event_values(fb_run *s, const double since, const double *x, double *values)
{
    fb_problem *const p = s->problem;
    const fb_kernel *const k = p->kernel;
    double *const accelerations = s->outputs, *const multipliers = accelerations + k->n_u;
    double *const outputs = multipliers + k->n_l;
    const double t = fb_time(&p->clock, since);
    const int called = fb_fill_inputs(p, t, x);
    if (called < 0)
        return called;
    k->accelerations(t, x, p->constants, p->inputs, accelerations, multipliers, p->work);
    fb_problem_results(p, FB_OUTPUT, t, x, accelerations, multipliers, NULL, &outputs);
    for (int i = 0; i < s->n_events; ++i)
        values[i] = outputs[s->event_output[i]];
    return 0;
}

/* Whether a function with these values at both ends of a step has an event in it, by the rule of solve_ivp. */
static inline int fb_is_event(const double before, const double after, const int direction)
{
    return (before <= 0.0 && after >= 0.0 && direction >= 0) || (before >= 0.0 && after <= 0.0 && direction <= 0);
}

/* Whether the sign of det J_d has also changed between neighbours of several states along the last step. If
 * not, J kept its rank, and the step was only long. Ends with an evaluation at the state reached. */
static inline int fb_toggled_within(fb_run *s)
{
    const long n_evaluations = s->n_evaluations; /* these evaluations are not counted, like those for events */
    int toggled = 0;
    for (int i = 0; i <= FB_LOOKS; ++i) {
        const double since = i == FB_LOOKS ? s->t : s->t_old + s->h * i / FB_LOOKS;
        int status = 0;
        if (i == 0)
            memcpy(s->along, s->x_old, (size_t)s->n * sizeof *s->along);
        else
            status = fb_state_at(s, since, s->along);
        if (status == 0)
            status = fb_evaluate(s, since, s->along, s->along + s->padded);
        if (status < 0)
            return status;
        toggled |= s->problem->kernel->toggled(s->problem->work) && i > 0;
    }
    s->n_evaluations = n_evaluations;
    s->interpolant_valid = 0;
    return toggled;
}

/* One accepted step, and its derivatives, whose errors may ask for shorter ones: where the state rests, or moves
 * steadily, its own errors do not limit the steps at all. At a kink of a force, a derivative that was zero before may
 * have an error of its own size at any length of the step: after some attempts, it is compared with the size that it
 * reaches within a fraction of the first of them. */
static inline int fb_differentiated_step_on(fb_run *s)
{
    double soon = 0.0;
    for (int attempt = 0;; ++attempt) {
        int status = s->step(s);
        if (status != FB_RUN_PAUSED || !s->forward)
            return status;
        if (attempt == 0)
            soon = FB_SOON * fabs(s->h);
        const int is_least = fabs(s->h) * FB_MIN_FACTOR < fb_least_step(s->t_old, s->direction);
        double error = 0.0;
        status = s->step_jvp(s, is_least ? INFINITY : attempt < FB_USUAL_ATTEMPTS ? 0.0 : soon, &error);
        if (status < 0)
            return status;
        /* Derivatives that are not finite ask for nothing. */
        const double factor = fb_step_factor(s, error), length = fabs(s->h) * fb_change(factor, error < 1.0, 0);
        if (!(error >= 1.0)) {
            const int limits = factor < FB_MAX_FACTOR && length < s->h_abs;
            if (limits)
                s->h_abs = length;
            s->n_limited += limits || attempt > 0;
            return FB_RUN_PAUSED;
        }
        fb_take_back(s, length);
    }
}

/* Whether the errors of derivatives have made the steps of a window collapse. */
static inline int fb_derivatives_collapsed(fb_run *s)
{
    const double length = fabs(s->t - s->marked_t) / FB_WINDOW, average = fabs(s->t - s->t_begin) / (double)s->n_steps;
    const int collapsed = 2 * s->n_limited >= FB_WINDOW && length < FB_SLOW * average;
    s->n_limited = 0;
    s->marked = s->n_steps;
    s->marked_t = s->t;
    return collapsed;
}

/* Up to n steps; returns an FB_RUN, or negative from the callback of inputs. */
static inline int fb_run_on(fb_run *s, long n)
{
    for (;;) {
        if (s->pending) {
            const int status = fb_sample(s);
            if (status != FB_RUN_PAUSED)
                return status;
        }
        if (s->t == s->t_bound)
            return FB_RUN_END;
        if (n-- <= 0)
            return FB_RUN_PAUSED;
        if (s->steps && s->steps->n == s->steps->room)
            return FB_RUN_FULL;
        /* Reported once for each collapse. */
        const double share = s->n_steps > 9 ? s->h_abs * s->n_steps / fabs(s->t - s->t_begin) : 1.0;
        if (share < FB_COLLAPSE && !s->collapsed) {
            s->collapsed = 1;
            return FB_RUN_COLLAPSED;
        }
        if (share > FB_RECOVERY)
            s->collapsed = 0;
        if (s->forward && s->n_steps - s->marked == FB_WINDOW && fb_derivatives_collapsed(s))
            return FB_RUN_COLLAPSED;
        int status = fb_differentiated_step_on(s);
        if (status != FB_RUN_PAUSED)
            return status;
        if (s->steps)
            fb_keep_step(s, s->h);
        /* Methods that pass singular positions need not detect them. */
        s->toggled = s->augmented ? 0 : s->problem->kernel->toggled(s->problem->work);
        if (s->toggled)
            s->toggled = fb_toggled_within(s);
        if (s->toggled < 0)
            return s->toggled;
        int look = s->look_at_all | s->toggled;
        if (s->n_events > 0) {
            memcpy(s->event_old, s->event_value, (size_t)s->n_events * sizeof *s->event_old);
            status = fb_event_values(s, s->t, s->x, s->event_value);
            if (status < 0)
                return status;
            for (int i = 0; i < s->n_events; ++i)
                look |= fb_is_event(s->event_old[i], s->event_value[i], s->event_direction[i]);
        }
        if (look)
            return FB_RUN_EVENT;
    }
}

#endif
