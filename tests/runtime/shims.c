/* Functions of the runtime's headers that depend on no model, with names to call them by. */
#include "arithmetic/angle.h"
#include "derivatives/velocity_jump.h"
#include "lanes/batch.h"
#include "linear_algebra/shifted_equations.h"
#include "run/driver.h"
#include "steppers/ali3p.h"

#include <stdlib.h>

/* arithmetic/array.h */

int eliminate_full(int n, double *a, double *b, double least)
{
    return fb_eliminate_full(n, a, b, least);
}

int eliminate_rows(int m, int n, int k, double *a, double *b, int *order, double *solution, double *last)
{
    return fb_eliminate_rows(m, n, k, a, b, order, solution, last);
}

/* Solutions for a real number and for a complex one; returns the number of unknowns that are left, or -1. */
int solve_shifted(int n, const double *matrix, const double *shifts, const double *sides, double *solutions)
{
    fb_shifted equations;
    double *const memory = calloc(FB_SHIFTED_LENGTH(n), sizeof *memory);
    const int fits = (int)fb_place_shifted(&equations, n, memory) == FB_SHIFTED_LENGTH(n);
    memcpy(equations.matrix, matrix, (size_t)(n * n) * sizeof *matrix);
    fb_order_shifted(&equations);
    const int left = equations.n_left, solved = fits && fb_factor_shifted(&equations, shifts[0], shifts[1], shifts[2]);
    if (solved) {
        fb_solve_shifted(&equations, sides, solutions);
        fb_solve_shifted_complex(&equations, sides + n, sides + 2 * n, solutions + n, solutions + 2 * n);
    }
    free(memory);
    return solved ? left : -1;
}

double violation(const double *violations, const double *scales, int n)
{
    return fb_violation(violations, scales, n);
}

int all_are_finite(const double *values, int n)
{
    return all_finite(values, n);
}

/* arithmetic/angle.h */

void sines(int n, const double *x, double *sine, double *cosine)
{
    for (int i = 0; i < n; ++i) {
        sine[i] = fb_sin(x[i]);
        cosine[i] = fb_cos(x[i]);
    }
}

void sines_of_four(int n, const double *x, double *sine, double *cosine)
{
    for (int i = 0; i + 4 <= n; i += 4) {
        const fb_angles angles = fb_angles_of(x[i], x[i + 1], x[i + 2], x[i + 3]);
        memcpy(sine + i, angles.sin, sizeof angles.sin);
        memcpy(cosine + i, angles.cos, sizeof angles.cos);
    }
}

/* kernel/problem.h */

double table_value(int n_intervals, int n_coefficients, const double *times, const double *coefficients, double before,
                   double after, double t, int *interval)
{
    const fb_table table = {n_intervals, n_coefficients, times, coefficients, before, after};
    return fb_table_value(&table, t, interval);
}

double time_within(double origin, double first, double last, double since)
{
    const fb_clock clock = {origin, first, last};
    return fb_time(&clock, since);
}

/* lanes/batch.h */

double entry(const double *values, int stride, int row, int i)
{
    const fb_batch_array columns = {values, stride};
    return fb_entry(&columns, row, i);
}

/* steppers/step_control.h */

double change(double factor, int taken, int rejected)
{
    return fb_change(factor, taken, rejected);
}

/* arithmetic/chebyshev.h, run/roots.h */

void chebyshev_fit(int n, const double *values, double *c)
{
    fb_chebyshev_fit(n, values, c);
}

double chebyshev_point(int n, int j)
{
    return fb_chebyshev_point(n, j);
}

double chebyshev_value(int n, const double *c, double y)
{
    return fb_chebyshev_value(n, c, y);
}

void chebyshev_slope(int n, const double *c, double *slope)
{
    fb_chebyshev_slope(n, c, slope);
}

/* The changes of sign of a series, and where it touches zero. */
int changes_of_sign(int n, const double *c, double error, double *low, double *high, double *touched)
{
    fb_series series = {.n = n, .error = error};
    memcpy(series.c, c, (size_t)(n + 1) * sizeof *c);
    fb_walk walk;
    fb_begin_walk(&walk, 0, 0, 0.0);
    fb_walk_to(&walk, -1.0, fb_chebyshev_value(n, c, -1.0), error);
    fb_walk_along(&walk, &series);
    fb_walk_to(&walk, 1.0, fb_chebyshev_value(n, c, 1.0), error);
    for (int i = 0; i < walk.n; ++i) {
        low[i] = walk.found[i].low;
        high[i] = walk.found[i].high;
    }
    *touched = walk.touched;
    return walk.n;
}

typedef double function_of(double y);

typedef struct counted {
    function_of *function;
    int n;
} counted;

static int counted_value(void *of, double y, double *value)
{
    counted *const c = of;
    c->n += 1;
    *value = c->function(y);
    return 0;
}

int solve_bracketed(function_of *function, double a, double b, double *root)
{
    counted c = {function, 0};
    fb_solve_bracketed(counted_value, &c, a, function(a), b, function(b), root);
    return c.n;
}

double least_step(double t, double direction)
{
    return fb_least_step(t, direction);
}

double first_length(double h_abs, double max_step, double min_step)
{
    return fb_first_length(h_abs, max_step, min_step);
}

/* steppers/tableaus.h: the arrays of a method, by their names in fb_tableau */

static const fb_tableau *const METHODS[] = {&fb_rk45, &fb_dop853, &fb_rk4, &fb_tsit5};

static int copy(const double *from, const int n, double *to)
{
    memcpy(to, from, (size_t)n * sizeof *to);
    return n;
}

int tableau(int method, char name, double *values)
{
    const fb_tableau *const m = METHODS[method];
    const int n = m->n_stages, all = n + 1 + m->n_extra;
    switch (name) {
    case 'a':
        return copy(m->a, n * n, values);
    case 'b':
        return copy(m->b, n, values);
    case 'c':
        return copy(m->c, n, values);
    case 'e':
        return copy(m->error, m->n_errors * (n + 1), values);
    case 'x':
        return copy(m->a_extra, m->n_extra * all, values);
    case 'y':
        return copy(m->c_extra, m->n_extra, values);
    default:
        return copy(m->dense, m->n_dense * all, values);
    }
}

/* run/driver.h: runs of x' = f(t, x) for any function f, as a kernel without constraints */

enum { MOST = 8, WIDTH = FB_BLOCK, SAMPLES = 64 };

typedef int rates_of(double t, const double *x, double *rates);

typedef struct run {
    fb_run run;
    fb_problem problem;
    fb_kernel kernel;
    double memory[(FB_STEPPER_ROWS + 4) * WIDTH], tolerances[2 * WIDTH], failed[MOST], moved[MOST];
    double sample_t[SAMPLES], sample_x[SAMPLES * MOST], scratch[MOST + 12];
    double event_values[(FB_MOST_DEGREE + 1) * MOST], event_ends[MOST], polished[MOST];
    fb_event events[MOST];
    fb_found found[FB_MOST_CROSSINGS * MOST];
    rates_of *rates;
} run;

/* The kernel's functions find f as their workspace. */
static int mock_rhs(double t, const double *x, const double *constants, const double *r, double *rates, void *work)
{
    (void)constants, (void)r;
    return ((run *)work)->rates(t, x, rates);
}

static int mock_toggled(void *work)
{
    (void)work;
    return 0;
}

static int mock_accelerations(double t, const double *x, const double *constants, const double *r, double *a,
                              double *multipliers, void *work)
{
    (void)t, (void)x, (void)constants, (void)r, (void)a, (void)multipliers, (void)work;
    return FB_OK;
}

/* The outputs are the state. */
static int mock_output(const fb_at *at, const double *const *arguments, double *const *results, void *work)
{
    (void)arguments, (void)work;
    memcpy(results[0], at->x, MOST * sizeof *at->x);
    return FB_OK;
}

static const fb_function mock_functions[FB_N_ROLES] = {[FB_OUTPUT] = {.call = mock_output}};

run *new_run(rates_of *rates, int method, int n, double t, const double *x, double t_bound, double max_step,
             double rtol, double atol)
{
    run *const s = calloc(1, sizeof *s);
    if (s == NULL)
        return NULL;
    s->rates = rates;
    s->kernel.n_x = n;
    s->kernel.n_o = MOST;
    s->kernel.rhs = mock_rhs;
    s->kernel.toggled = mock_toggled;
    s->kernel.accelerations = mock_accelerations;
    s->kernel.functions = mock_functions;
    s->problem.kernel = &s->kernel;
    s->problem.work = s;
    s->problem.clock = fb_all_time;
    s->problem.failed_x = s->failed;
    s->problem.moved_x = s->moved;
    fb_run *const r = &s->run;
    fb_stepper *const stepper = &r->stepper;
    stepper->problem = &s->problem;
    const size_t length = fb_place_stepper(stepper, &fb_runge_kutta, METHODS[method], n, s->memory);
    if (length + 4 * WIDTH > sizeof s->memory / sizeof *s->memory)
        abort();
    stepper->rtol = s->tolerances;
    stepper->atol = s->tolerances + WIDTH;
    stepper->t = r->pace.t_begin = t;
    memcpy(stepper->x, x, (size_t)n * sizeof *x);
    for (int i = 0; i < WIDTH; ++i) {
        s->tolerances[i] = rtol;
        s->tolerances[WIDTH + i] = atol;
    }
    r->direction = t_bound >= t ? 1.0 : -1.0;
    r->t_bound = r->t_end = t_bound;
    r->max_step = max_step;
    r->samples.until = r->direction * INFINITY;
    r->samples.t = s->sample_t;
    r->samples.x = s->sample_x;
    r->samples.room = SAMPLES;
    r->watch.along = s->memory + length;
    r->watch.singular.x = r->watch.along + 2 * WIDTH;
    r->watch.scratch = s->scratch;
    r->watch.values = s->event_values;
    r->watch.ends = s->event_ends;
    r->watch.polished = s->polished;
    r->watch.events = s->events;
    r->watch.found = s->found;
    return s;
}

void free_run(run *s)
{
    free(s);
}

int begin_run(run *s)
{
    return fb_begin(&s->run);
}

/* Goes on from another state, with a proposal for the length of the next step. */
int go_on_from(run *s, double t, const double *x, double h_abs)
{
    fb_stepper *const stepper = &s->run.stepper;
    stepper->t = t;
    s->run.h_abs = h_abs;
    memcpy(stepper->x, x, (size_t)stepper->n * sizeof *x);
    return fb_resume(stepper);
}

void sample_at(run *s, const double *times, int n)
{
    s->run.samples.times = times;
    s->run.samples.n_times = n;
}

int watch_state(run *s, int i, int direction)
{
    const int place = s->run.watch.n_events++;
    s->events[place] = (fb_event){.quantity = FB_WATCHED_OUTPUT, .row = i, .direction = direction, .all_roots = 1};
    return fb_begin_events(&s->run);
}

int advance(run *s, int steps)
{
    return fb_run_on(&s->run, steps);
}

int fixed_step(run *s, double h)
{
    fb_stepper *const stepper = &s->run.stepper;
    return fb_fixed_step(stepper, h, fb_fixed_time(s->run.pace.t_begin, h, stepper->n_steps + 1));
}

int state_at(run *s, double t, double *x)
{
    return fb_state_at(&s->run.stepper, t, x);
}

/* t, the step's length and the proposal for the next; the numbers of evaluations, steps and samples. */
void read_run(const run *s, double *times, double *x, int *counts)
{
    const fb_stepper *const stepper = &s->run.stepper;
    times[0] = stepper->t;
    times[1] = stepper->h;
    times[2] = s->run.h_abs;
    memcpy(x, stepper->x, (size_t)stepper->n * sizeof *x);
    counts[0] = (int)stepper->n_evaluations;
    counts[1] = (int)stepper->n_steps;
    counts[2] = (int)s->run.samples.n;
}

void read_samples(const run *s, double *t, double *x)
{
    memcpy(t, s->sample_t, (size_t)s->run.samples.n * sizeof *t);
    memcpy(x, s->sample_x, (size_t)(s->run.samples.n * s->run.stepper.n) * sizeof *x);
}

/* steppers/ali3p.h: the linear algebra of a state, given M, f, J and gamma */

static fb_augmented augmented_of(fb_kernel *k, double **memory, int n_u, int n_c, const double *mass_matrix,
                                 const double *forcing, const double *jacobian, const double *bias)
{
    fb_augmented a = {0};
    k->n_u = n_u;
    k->n_c = k->n_l = n_c;
    k->n_x = n_u;
    *memory = calloc(fb_place_augmented(k, &a, NULL), sizeof(double));
    if (*memory == NULL)
        abort();
    fb_place_augmented(k, &a, *memory);
    memcpy(a.mass_matrix, mass_matrix, (size_t)(n_u * n_u) * sizeof(double));
    memcpy(a.forcing, forcing, (size_t)n_u * sizeof(double));
    memcpy(a.jacobian, jacobian, (size_t)(n_u * n_c) * sizeof(double));
    memcpy(a.bias, bias, (size_t)n_c * sizeof(double));
    return a;
}

double penalty(int n_u, int n_c, const double *mass_matrix, const double *jacobian, double weight)
{
    fb_kernel k = {0};
    double *memory;
    const fb_augmented a = augmented_of(&k, &memory, n_u, n_c, mass_matrix, mass_matrix, jacobian, jacobian);
    const double found = fb_penalty(&k, &a, weight);
    free(memory);
    return found;
}

int least_change(int n_u, int n_c, const double *mass_matrix, const double *jacobian, const double *violations,
                 double *change_of_speeds)
{
    fb_kernel k = {0};
    double *memory;
    fb_augmented a = augmented_of(&k, &memory, n_u, n_c, mass_matrix, mass_matrix, jacobian, violations);
    const int found = fb_least_change(&k, &a, violations);
    memcpy(change_of_speeds, a.change, (size_t)n_u * sizeof(double));
    free(memory);
    return found;
}

/* u' and the multipliers of least norm. */
int augmented_solution(int n_u, int n_c, const double *mass_matrix, const double *forcing, const double *jacobian,
                       const double *bias, double *accelerations, double *multipliers)
{
    fb_kernel k = {0};
    double *memory;
    fb_augmented a = augmented_of(&k, &memory, n_u, n_c, mass_matrix, forcing, jacobian, bias);
    fb_problem problem = {.kernel = &k};
    fb_stepper s = {.problem = &problem, .own = &a};
    const int found = fb_augmented_solution(&s, accelerations);
    memcpy(multipliers, a.multipliers, (size_t)n_c * sizeof(double));
    free(memory);
    return found;
}

/* derivatives/velocity_jump.h: for u' = A r + b with two speeds and four inputs r, of which the last two are second
 * derivatives of motions, and the first two their rates, 10 t + i before a jump at t = 1 and i^2 after it. */

enum { JUMP_SPEEDS = 2, JUMP_INPUTS = 4 };

static const double *jump_matrix;

static int jump_accelerations(double t, const double *x, const double *constants, const double *r, double *a,
                              double *multipliers, void *work)
{
    (void)t, (void)constants, (void)multipliers, (void)work;
    for (int i = 0; i < JUMP_SPEEDS; ++i) {
        a[i] = x[0];
        for (int j = 0; j < JUMP_INPUTS; ++j)
            a[i] += jump_matrix[i * JUMP_INPUTS + j] * r[j];
    }
    return FB_OK;
}

static void jump_inputs(double t, const double *constants, double *r)
{
    (void)constants;
    for (int i = 0; i < JUMP_INPUTS; ++i)
        r[i] = t < 1.0 ? 10.0 * t + i : i * i;
}

int speed_jump(const double *matrix, double t_before, double t_after, double *of_speeds)
{
    static const int rate[JUMP_INPUTS] = {-1, -1, 0, 1};
    const double x[1] = {0.7};
    double inputs[JUMP_INPUTS], before[JUMP_INPUTS], change_of_rates[JUMP_INPUTS], scratch[2 * JUMP_SPEEDS];
    const fb_kernel kernel = {
        .n_u = JUMP_SPEEDS, .n_r = JUMP_INPUTS, .accelerations = jump_accelerations, .default_inputs = jump_inputs};
    fb_problem problem = {.kernel = &kernel, .inputs = inputs, .clock = fb_all_time};
    fb_velocity_jump jump = {t_before, t_after, rate, before, change_of_rates};
    jump_matrix = matrix;
    return fb_speed_jump(&problem, &jump, x, of_speeds, scratch);
}
