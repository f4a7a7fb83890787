/* A kernel with its parameters and inputs: x' = f(t, x) for an integrator. */
#ifndef FOURBAR_PROBLEM_H
#define FOURBAR_PROBLEM_H

#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"

#include <math.h>
#include <string.h>

/* A function of time by polynomials between given times, both ends included, constant before and after. */
typedef struct fb_table {
    int32_t n_intervals, n_coefficients;
    const double *times; /* (n_intervals + 1,), strictly increasing */
    const double
        *coefficients; /* (n_intervals, n_coefficients), highest power first, of the time since the beginning */
    double before, after;
} fb_table;

static inline double fb_table_value(const fb_table *table, const double t, int *interval)
{
    const double *times = table->times;
    const int last = table->n_intervals;
    if (t < times[0])
        return table->before;
    if (!(t <= times[last]))
        return table->after;
    /* Integrators advance slowly, so the interval of the last call is the first guess. */
    int low = 0, high = last, middle = t == times[last] ? last - 1 : *interval;
    while (!(times[middle] <= t && (t < times[middle + 1] || middle == last - 1))) {
        if (t < times[middle])
            high = middle;
        else
            low = middle + 1;
        middle = (low + high) / 2;
    }
    *interval = middle;
    const double *coefficients = table->coefficients + middle * table->n_coefficients;
    double value = coefficients[0];
    for (int i = 1; i < table->n_coefficients; ++i)
        value = value * (t - times[middle]) + coefficients[i];
    return value;
}

/* The time at which an integrator's time is zero, and the present interval between discontinuities: beyond its ends,
 * inputs are not evaluated. */
typedef struct fb_clock {
    double origin, first, last;
} fb_clock;

static const fb_clock fb_all_time = {0.0, -INFINITY, INFINITY};

static inline double fb_time(const fb_clock *clock, const double since)
{
    const double t = clock->origin + since;
    return t < clock->first ? clock->first : t > clock->last ? clock->last : t;
}

/* The source of an input that is not given by its expression. */
typedef struct fb_source {
    int32_t input;
    double value;          /* if there is no table */
    const fb_table *table; /* or NULL */
    int32_t interval;
} fb_source;

typedef struct fb_problem fb_problem;

/* Callback that sets the values of computed inputs at (t, x); a negative status stops the integration. */
typedef int fb_called_inputs(fb_problem *problem, double t, const double *x);

struct fb_problem {
    const fb_kernel *kernel;
    double *constants; /* (n_constants,) */
    double *inputs;    /* (n_r,) */
    void *work;
    fb_clock clock;
    double stabilization; /* the rate a of Baumgarte's stabilization, 1/s; 0 for none */
    int n_sources;
    fb_source *sources;
    fb_called_inputs *called_inputs; /* or NULL */
    void *caller;
    int status; /* of the last evaluation; if it is not FB_OK, the first failed time and state follow */
    double failed_t;
    double *failed_x; /* (n_x,) */
    double *moved_x;  /* (n_x,), scratch */
};

static inline int fb_fill_inputs(fb_problem *s, const double t, const double *x)
{
    if (s->kernel->n_r == 0)
        return 0;
    const int called = s->called_inputs ? s->called_inputs(s, t, x) : 0;
    if (called < 0)
        return called;
    s->kernel->default_inputs(t, s->constants, s->inputs);
    for (int i = 0; i < s->n_sources; ++i) {
        fb_source *const source = s->sources + i;
        s->inputs[source->input] = source->table ? fb_table_value(source->table, t, &source->interval) : source->value;
    }
    return 0;
}

static inline int fb_finite(const double *values, const int n)
{
    return all_finite(values, n) == FB_OK;
}

/* After NaN, integrators continue with states of NaN; the first failure is the one to report. */
static inline void fb_note_failure(fb_problem *s, const int status, const double t, const double *x)
{
    const int n = s->kernel->n_x;
    if (status != FB_OK && (s->status == FB_OK || fb_finite(x, n))) {
        s->failed_t = t;
        memcpy(s->failed_x, x, (size_t)n * sizeof *x);
        s->status = status;
    } else if (status == FB_OK)
        s->status = FB_OK;
}

/* x', NaN where the equations cannot be evaluated. */
static inline int fb_problem_rates(void *problem, const double since, const double *x, double *rates)
{
    fb_problem *const s = problem;
    const double t = fb_time(&s->clock, since);
    const int called = fb_fill_inputs(s, t, x);
    if (called < 0)
        return called;
    const int status = s->stabilization > 0.0
                           ? s->kernel->stabilized(t, x, s->constants, s->inputs, s->stabilization, rates, s->work)
                           : s->kernel->rhs(t, x, s->constants, s->inputs, rates, s->work);
    if (status != FB_OK || s->status != FB_OK)
        fb_note_failure(s, status, t, x);
    if (status != FB_OK)
        for (int i = 0; i < s->kernel->n_x; ++i)
            rates[i] = NAN;
    return 0;
}

/* The results of a function of the kernel's table, with the inputs as they are. */
static inline void fb_problem_results(const fb_problem *s, const enum FB_ROLE role, const double t, const double *x,
                                      const double *accelerations, const double *multipliers,
                                      const double *const *arguments, double *const *results)
{
#ifdef FB_LIBRARY /* which has no table */
    (void)arguments;
    if (role == FB_OUTPUT)
        output(t, x, s->constants, s->inputs, accelerations, multipliers, results[0]);
    else if (role == FB_CONDITIONS)
        conditions(t, x, s->constants, s->inputs, results[0]);
    else if (role == FB_ENERGY)
        energy(t, x, s->constants, s->inputs, results[0]);
    else if (role == FB_MOMENTA)
        momenta(t, x, s->constants, s->inputs, results[0], results[1], results[2]);
#else
    const fb_at at = {t, x, s->constants, s->inputs, accelerations, multipliers, 0};
    s->kernel->functions[role].call(&at, arguments, results, s->work);
#endif
}

/* dx'/dx by the functions of a table or a part; zeros where the equations cannot be evaluated, since factorizations
 * refuse NaN. x' is NaN there, and fails the step. */
static inline int fb_problem_jacobian(fb_problem *s, const fb_function *functions, const double since, const double *x,
                                      double *matrix)
{
    const double t = fb_time(&s->clock, since);
    const int n = s->kernel->n_x;
    const int called = fb_fill_inputs(s, t, x);
    if (called < 0)
        return called;
    const int status =
        s->kernel->differentiate(functions, FB_STATE_PARTIALS, n, t, x, s->constants, s->inputs, matrix, NULL, s->work);
    if (status != FB_OK) {
        fb_note_failure(s, status, t, x);
        memset(matrix, 0, (size_t)(n * n) * sizeof *matrix);
    }
    return 0;
}

/* Projects x onto the constraints; x is unchanged if that fails. `factors_valid` as for the kernel's function. */
static inline int fb_problem_project(fb_problem *s, const double since, double *x, const int factors_valid)
{
    const double t = fb_time(&s->clock, since);
    const size_t size = (size_t)(s->kernel->n_x) * sizeof *x;
    const int called = fb_fill_inputs(s, t, x);
    if (called < 0)
        return called;
    memcpy(s->moved_x, x, size);
    const int status = s->kernel->project(t, s->moved_x, s->constants, s->inputs, factors_valid, s->work);
    if (status == FB_OK)
        memcpy(x, s->moved_x, size);
    return status;
}

#endif
