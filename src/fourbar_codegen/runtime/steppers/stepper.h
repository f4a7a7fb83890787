/* The steps of a method of integration: what all methods have in common, the last step and its interpolant.
 *
 * Arrays of states are padded to whole blocks with zeros.
 */
#ifndef FOURBAR_STEPPER_H
#define FOURBAR_STEPPER_H

#include "../arithmetic/array.h"
#include "../arithmetic/real.h"
#include "../kernel/problem.h"
#include "tableaus.h"

#include <math.h>
#include <string.h>

enum { FB_BLOCK = 8 };

/* The length of n states padded to whole blocks, and the most rows of that length that `fb_place_stepper` places. */
#define FB_PADDED(n) (((n) + FB_BLOCK - 1) / FB_BLOCK * FB_BLOCK)
enum { FB_STEPPER_ROWS = 3 + FB_MAX_STAGES + FB_MAX_DENSE + 3 };

/* The weights of a linear combination of stages, without zeros. */
typedef struct fb_weights {
    int n;
    int stage[FB_MAX_STAGES];
    double weight[FB_MAX_STAGES];
} fb_weights;

/* Those of a tableau: for the state of each stage and, after the last one, at the end of a step; for the error
 * estimates; for the states of further stages; and for the coefficients of the interpolant. */
typedef struct fb_combinations {
    fb_weights stage[FB_MAX_STAGES], error[2], extra[FB_MAX_EXTRA], dense[FB_MAX_DENSE];
} fb_combinations;

/* An evaluation of x' that is needed again: its state, and the inputs and workspace that it leaves. */
typedef struct fb_kept {
    double *x;      /* (padded,) */
    double *inputs; /* (n_r,) */
    double *work;
} fb_kept;

typedef struct fb_stepper fb_stepper;

/* A method. Its functions return 0, a reason why a run cannot go on, or a negative status of the callback of inputs. */
typedef struct fb_method {
    /* x' at the beginning of a run of a direction and a length, and the length of the first step */
    int (*init)(fb_stepper *s, double direction, double interval, double max_step, double *h_abs);
    /* a step to t_new: the state there, not projected, in `x_new`, and its error in units of the tolerances: a step is
     * accepted if that is below 1, so not if it is NaN */
    int (*attempt)(fb_stepper *s, double t_new, double *error);
    /* the error of the last attempt's interpolant within the step to t_new, where that is larger, or NULL: a step is
     * accepted by its end, unless values between are asked for */
    int (*between)(fb_stepper *s, double t_new, double *error);
    /* a step of length h without an error estimate: the state at its end, not projected, in `x_new`, from x' at its
     * beginning; a status of the kernel. NULL if there are no such steps */
    int (*stages)(fb_stepper *s, double h);
    /* x' at a state that is not the end of the last step, where a run goes on, or after a projection */
    int (*restart)(fb_stepper *s, double t, const double *x, double *rates);
    /* the length of the next attempt, or of the next step, after one of the length h_abs with this error */
    double (*next_length)(const fb_stepper *s, double h_abs, double error, int rejected);
    /* x at a time within the last step, not projected */
    int (*interpolate)(fb_stepper *s, double t, double *x);
    /* of methods with a step control of their own, or NULL: a step towards t_bound, as `attempt`, to a time of its own
     * choice; an FB_RUN, where FB_RUN_PAUSED means success */
    int (*advance)(fb_stepper *s, double t_bound, double *t_new);
    int projects;         /* whether attempts project the state by themselves, and pass singular positions */
    double least_share;   /* of max_step: shorter steps are not attempted */
    double largest_share; /* of max_step: a step that would end so near to the end of the run goes on to it */
} fb_method;

/* How a run takes its steps: the method, its coefficients and its workspace, or NULL. */
typedef struct fb_steps {
    const fb_method *method;
    const fb_tableau *tableau;
    void *own;
} fb_steps;

struct fb_stepper {
    fb_problem *problem;
    const fb_method *method;
    const fb_tableau *tableau;
    fb_combinations weights;
    void *own;     /* the method's workspace, or NULL */
    fb_kept *kept; /* for each row of `stages`, or NULL */
    int n, padded;
    int project;               /* whether states are projected onto the constraints */
    const double *rtol, *atol; /* (n,), if the method has step control */
    /* the state, and the last step */
    double t, t_old, h;
    double *x, *x_old, *x_new; /* (padded,) */
    double *stages;            /* (s + 1 + n_extra, padded): x' at the beginning, the stages, x' at the end */
    double *interpolant;       /* (n_dense + 3, padded) */
    int fsal;                  /* whether x' at the end of the last step is that at the beginning of the next one */
    int interpolant_valid;
    int64_t n_evaluations, n_steps;
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

static inline void fb_prepare_weights(fb_stepper *s)
{
    const fb_tableau *const m = s->tableau;
    const int n = m->n_stages, all = n + 1 + m->n_extra;
    for (int k = 1; k < n; ++k)
        fb_weights_of(m->a + k * n, k, s->weights.stage + k);
    fb_weights_of(m->b, n, s->weights.stage + n);
    for (int i = 0; i < m->n_errors; ++i)
        fb_weights_of(m->error + i * (n + 1), n + 1, s->weights.error + i);
    for (int i = 0; i < m->n_extra; ++i)
        fb_weights_of(m->a_extra + i * all, n + 1 + i, s->weights.extra + i);
    for (int i = 0; i < m->n_dense; ++i)
        fb_weights_of(m->dense + i * all, all, s->weights.dense + i);
}

/* Prepares the steps of a method for n states, whose arrays are placed in memory, unless that is NULL; returns their
 * number of doubles. The memory and the stepper must be zeros before its first use. */
static inline size_t fb_place_stepper(fb_stepper *s, const fb_method *method, const fb_tableau *tableau, const int n,
                                      double *memory)
{
    const int padded = FB_PADDED(n);
    const fb_place places[] = {
        {&s->x, padded},
        {&s->x_old, padded},
        {&s->x_new, padded},
        {&s->stages, (tableau->n_stages + 1 + tableau->n_extra) * padded},
        {&s->interpolant, (tableau->n_dense + 3) * padded},
    };
    if (memory && s->tableau != tableau) {
        s->tableau = tableau;
        fb_prepare_weights(s);
    }
    s->method = method;
    s->n = n;
    s->padded = padded;
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

static inline int fb_evaluate(fb_stepper *s, const double t, const double *x, double *rates)
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
static inline int fb_evaluate_row(fb_stepper *s, const int row, const double t, const double *x)
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

/* The same but for the last stage: a projection at the end of the step needs its workspace. */
static inline int fb_evaluate_stage(fb_stepper *s, const int row, const double t, const double *x)
{
    return row == s->tableau->n_stages - 1 ? fb_evaluate(s, t, x, s->stages + row * s->padded)
                                           : fb_evaluate_row(s, row, t, x);
}

#define FB_VALUE double
#define FB_OF(name) name
#define FB_MAGNITUDE(value) fabs(value)
#define FB_LARGER(a, b) ((a) > (b) ? (a) : (b))
#define FB_UNIT(value) (value)
#define FB_IN_UNITS(value, unit) ((value) / (unit))
#define FB_AT_ONCE FB_BLOCK
#define FB_CALLER fb_stepper
#define FB_EVALUATE(caller, row, t, x) fb_evaluate_stage(caller, row, t, x)
#include "stages.inc"

static inline void fb_combine(const fb_stepper *s, const fb_weights *w, const double factor, const double *base,
                              double *restrict result)
{
    fb_combine_rows(s->stages, s->padded, w, factor, base, result);
}

/* x' at the end of the last attempt. */
static inline double *fb_end_rates(const fb_stepper *s)
{
    return s->stages + s->tableau->n_stages * s->padded;
}

/* Before a step from the state reached: x' at its beginning, if it is that at the end of the last one. */
static inline void fb_move_on(fb_stepper *s)
{
    s->interpolant_valid = 0;
    if (s->fsal)
        memcpy(s->stages, fb_end_rates(s), (size_t)s->padded * sizeof *s->stages);
}

/* Accepts the step to t_new. */
static inline void fb_accept(fb_stepper *s, const double t_new)
{
    double *const x_new = s->x_new;
    s->x_new = s->x_old;
    s->x_old = s->x;
    s->x = x_new;
    s->t_old = s->t;
    s->h = t_new - s->t;
    s->t = t_new;
    s->n_steps += 1;
    s->interpolant_valid = 0;
    s->fsal = 1;
}

/* Takes the last step back, to be repeated with another length. x' at its beginning is still in the first row. */
static inline void fb_take_back(fb_stepper *s)
{
    double *const x_new = s->x;
    s->x = s->x_old;
    s->x_old = s->x_new;
    s->x_new = x_new;
    s->t = s->t_old;
    s->n_steps -= 1;
    s->fsal = 0;
}

/* Goes on from the present state, which is not the end of the last step, with unchanged length of steps. */
static inline int fb_resume(fb_stepper *s)
{
    s->fsal = 0;
    return s->method->restart(s, s->t, s->x, s->stages);
}

/* The coefficients of the last step's interpolant. */
static inline int fb_prepare_interpolant(fb_stepper *s)
{
    if (s->interpolant_valid)
        return 0;
    const int status = fb_form_interpolant(s, s->tableau, &s->weights, s->padded, s->stages, s->t_old, s->h, s->x_old,
                                           s->x, s->x_new, s->interpolant);
    if (status < 0)
        return status;
    s->interpolant_valid = 1;
    return 0;
}

/* The state at a time in the last step by the coefficients of its interpolant, of methods that have one. */
static inline int fb_interpolate_step(fb_stepper *s, const double t, double *x)
{
    const int status = fb_prepare_interpolant(s);
    if (status == 0)
        fb_interpolate(s->tableau, s->interpolant, s->n, s->padded, s->x_old, (t - s->t_old) / s->h, x);
    return status;
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

/* The time at a fraction of the last step. */
static inline double fb_time_of_fraction(const fb_stepper *s, const double fraction)
{
    return fraction == 1.0 ? s->t : s->t_old + fraction * s->h;
}

/* The state at a time in the last step; the present state if there was no step since the start or continuation. */
static inline int fb_state_at(fb_stepper *s, const double t, double *x)
{
    if (t == s->t || !s->fsal) {
        memcpy(x, s->x, (size_t)s->n * sizeof *x);
        return 0;
    }
    const int status = s->method->interpolate(s, t, x);
    if (status < 0 || !s->project)
        return status;
    return fb_project_sample(s->problem, t, x);
}

#endif
