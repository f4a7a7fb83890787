/* A model as a module of WebAssembly, for pages in a browser: one mechanism, whose parameters, state and inputs
 * JavaScript writes into memory, and runs of it at given times.
 *
 * Included once, after kernel/kernel.h and the model's derivatives, in place of export/c_library.h, by a source that
 * defines what that needs, also FB_WITHOUT_HEADER, `velocity_rows` (N_VELOCITY_ROWS), and `fill_vectors` (N_VECTORS).
 * JavaScript provides the memory of times, states and rows, behind `__heap_base`.
 */
#ifndef FOURBAR_PAGE_H
#define FOURBAR_PAGE_H

#define FB_CALLED_INPUTS signal_inputs
#define FB_CHANGES most_changes()
#define FB_NEXT_CHANGE next_change
#define FB_MAX_RUN_STEPS 50000 /* many for each frame; sliders should not wait for more */
#define FB_EXPORT(name) __attribute__((export_name(#name))) name

#include "../kernel/loop_closure.h"
#include "../linear_algebra/elimination.h"
#include "../run/driver.h"

/* An input as a function of time, or a derivative of one, with coefficients a, b, c, d. */
enum FB_SIGNAL {
    FB_OWN_EXPRESSION = 0,
    FB_CONSTANT = 1,  /* a */
    FB_SINE_WAVE = 2, /* a + b sin(2 pi c t + d) */
    FB_STEP = 3,      /* a before t = c, b from then on */
    FB_RAMP = 4,      /* a until t = c, b from t = d on, linear between; c < d */
    FB_LINE = 5,      /* a + b t */
    FB_HOLD = 6       /* of a times, from number b of the tables on, and as many values after them */
};

typedef struct fb_signal {
    double kind, order, a, b, c, d;
} fb_signal;

static fb_signal signals[FB_AT_LEAST_1(N_R)];
static const double *held_tables;

/* The value of the last time that is not later; before all of them the first one. */
static double held_value(const double *times, const int n, const double t)
{
    int low = 0, high = n;
    while (high - low > 1) {
        const int middle = (low + high) / 2;
        if (t < times[middle])
            high = middle;
        else
            low = middle;
    }
    return times[n + low];
}

static double signal_value(const fb_signal *s, const double t)
{
    const double turn = 6.283185307179586477 * s->c;
    switch ((enum FB_SIGNAL)s->kind) {
    case FB_SINE_WAVE:
        return s->order == 0.0   ? s->a + s->b * sin(turn * t + s->d)
               : s->order == 1.0 ? s->b * turn * cos(turn * t + s->d)
                                 : -s->b * turn * turn * sin(turn * t + s->d);
    case FB_STEP:
        return t < s->c ? s->a : s->b;
    case FB_RAMP:
        return t <= s->c ? s->a : t >= s->d ? s->b : s->a + (s->b - s->a) * ((t - s->c) / (s->d - s->c));
    case FB_HOLD:
        return held_value(held_tables + (int)s->b, (int)s->a, t);
    case FB_LINE:
        return s->order == 0.0 ? s->a + s->b * t : s->order == 1.0 ? s->b : 0.0;
    default:
        return s->order == 0.0 ? s->a : 0.0;
    }
}

static int signal_inputs(fb_problem *problem, const double t, const double *x)
{
    (void)x;
    for (int i = 0; i < problem->n_sources; ++i)
        problem->sources[i].value = signal_value(signals + problem->sources[i].input, t);
    return 0;
}

static int changes_of(const fb_signal *s)
{
    return s->kind == FB_STEP ? 1 : s->kind == FB_RAMP ? 2 : s->kind == FB_HOLD ? (int)s->a : 0;
}

static int most_changes(void)
{
    int n = 0;
    for (int i = 0; i < N_R; ++i)
        n += changes_of(signals + i);
    return n;
}

static double next_change(const double begin, const double end)
{
    double next = end;
    for (int i = 0; i < N_R; ++i) {
        const fb_signal *const s = signals + i;
        for (int k = 0; k < changes_of(s); ++k) {
            const double time = s->kind == FB_HOLD ? held_tables[(int)s->b + k] : k == 0 ? s->c : s->d;
            if (time > fb_min(begin, next) && time < fb_max(begin, next))
                next = time;
        }
    }
    return next;
}

#include "c_library.h"

#include "stiff_run.h"

static struct FB_MODEL mechanism;
static double stiff_work[FB_RADAU_LENGTH(N_X)];

/* The events of runs. */
static struct FB_EVENTS watched;

/* Places n events, and the first ones that a run finds, up to `room`, in memory, unless that is NULL; returns its
 * length in doubles. */
long FB_EXPORT(place_events)(double *memory, const int n, const long room)
{
    fb_watch watch;
    const size_t of_events = ((size_t)n * sizeof(struct FB_EVENT) + sizeof(double) - 1) / sizeof(double);
    const size_t of_found = (size_t)room * sizeof(struct FB_FOUND) / sizeof(double);
    if (memory)
        watched = (struct FB_EVENTS){.n = n,
                                     .event = (struct FB_EVENT *)(void *)(memory + of_found),
                                     .work = memory + of_found + of_events,
                                     .found = (struct FB_FOUND *)(void *)memory,
                                     .room = room,
                                     .ended_by = -1};
    return (long)(of_found + of_events + fb_place_events(&watch, n, 0, NULL));
}

void FB_EXPORT(set_event)(const int i, const int quantity, const int number, const int direction, const int terminal,
                          const int at_start, const int all_roots)
{
    ((struct FB_EVENT *)watched.event)[i] = (struct FB_EVENT){.quantity = quantity,
                                                              .number = number,
                                                              .direction = direction,
                                                              .ends_only = !all_roots,
                                                              .at_start = at_start,
                                                              .terminal = terminal};
}

/* How many the last run has found, and the one that has ended it, or -1. */
long FB_EXPORT(events_found)(void)
{
    return watched.n_found;
}

int FB_EXPORT(ended_by)(void)
{
    return watched.ended_by;
}

/* The time at which an event's quantity was zero with the same sign before and after, or not a number. */
double FB_EXPORT(event_touched)(const int event)
{
    return FB_PUBLIC(touched)(&mechanism, &watched, event);
}

/* The event that was found, its time and state. */
int FB_EXPORT(event_number)(const long found)
{
    return watched.found[found].event;
}

double FB_EXPORT(event_time)(const long found)
{
    return watched.found[found].t;
}

const double *FB_EXPORT(event_state)(const long found)
{
    return watched.found[found].x;
}

/* Takes over parameters and inputs. */
int FB_EXPORT(update)(void)
{
    for (int i = 0; i < N_R; ++i) {
        mechanism.held[i] = signals[i].kind != FB_OWN_EXPRESSION;
        mechanism.slope[i] = 0.0;
    }
    return FB_PUBLIC(update)(&mechanism);
}

double *FB_EXPORT(parameters)(void)
{
    return mechanism.p;
}

double *FB_EXPORT(state)(void)
{
    return mechanism.x;
}

fb_signal *FB_EXPORT(inputs)(void)
{
    return signals;
}

/* Where JavaScript puts the times and values of inputs that are held. */
void FB_EXPORT(set_tables)(const double *given)
{
    held_tables = given;
}

/* The numbers of a row of `observe`. */
int FB_EXPORT(row_length)(void)
{
    return N_X + N_R + N_O + 3 + N_C + 1 + 3 * N_VECTORS + 3 * N_POINTS + 3 * N_FORCES + 9 * N_BODIES;
}

double FB_EXPORT(time_reached)(void)
{
    return mechanism.t;
}

/* Of the last run: evaluations of the equations of motion, and states that were stored. */
long FB_EXPORT(evaluations_of_run)(void)
{
    return own_of(&mechanism)->run.stepper.n_evaluations;
}

long FB_EXPORT(states_stored)(void)
{
    return own_of(&mechanism)->run.samples.next_time;
}

const char *FB_EXPORT(message)(const int status)
{
    return FB_PUBLIC(message)(status);
}

/* Begins anew with the defaults. */
void FB_EXPORT(reset)(void)
{
    FB_PUBLIC(init)(&mechanism);
}

int FB_EXPORT(close_loops)(const double t)
{
    mechanism.t = t;
    own_of(&mechanism)->clock = fb_all_time;
    return FB_PUBLIC(close)(&mechanism);
}

/* The sign of the determinant of the derivatives of the position constraints with respect to the dependent coordinates:
 * an assembly mode keeps it as long as it is not followed through a singular position. 0 if unknown. */
int FB_EXPORT(sign_of_determinant)(void)
{
    enum { N = N_DEPENDENT_COORDINATES };
    double t, errors[FB_AT_LEAST_1(N_H)], slopes[FB_AT_LEAST_1(N_H * N_Q)], matrix[FB_AT_LEAST_1(N * N)];
    fb_problem *const problem = problem_now(&mechanism, &t);
    if (N != N_H)
        return 0;
    position(t, mechanism.x, problem->constants, problem->inputs, errors, slopes);
    for (int i = 0; i < N; ++i)
        memcpy(matrix + i * N, slopes + i * N_Q + N_Q - N, N * sizeof *matrix);
    const double pivot = fb_signed_least_pivot(N, matrix);
    return (pivot > 0.0) - (pivot < 0.0);
}

/* The value of an input at the time of the present state. */
double FB_EXPORT(input_value)(const int number)
{
    return FB_PUBLIC(input)(&mechanism, number);
}

int FB_EXPORT(evaluate)(const double t, const double *x, double *rates)
{
    return FB_PUBLIC(rhs)(&mechanism, t, x, rates);
}

/* A run from the present state by one of FB_METHOD, or by Radau IIA, whose number is the next one; with the states at n
 * times in rows. Where it fails, `time_reached` is where it ended.
 */
int FB_EXPORT(simulate)(const int method, const double begin, const double end, const double rtol, const double atol,
                        const double *times, const long n, double *states)
{
    mechanism.method = method;
    mechanism.t = begin;
    own_of(&mechanism)->run.samples.next_time = own_of(&mechanism)->run.stepper.n_evaluations =
        0; /* if it does not begin */
    return method == FB_N_METHODS
               ? FB_PUBLIC(simulate_stiff)(&mechanism, end, rtol, atol, times, n, states, &watched, stiff_work)
               : FB_PUBLIC(simulate_events)(&mechanism, end, rtol, atol, times, n, states, &watched);
}

/* Of the position constraints, and of those of velocity that keep no position, as `Trajectory.constraint_residual`. */
static double largest_residual(const double t, const double *x, const double *constants, const double *r)
{
    double errors[FB_AT_LEAST_1(N_H)], slopes[FB_AT_LEAST_1(N_H * N_Q)], largest = 0.0;
    double positions[FB_AT_LEAST_1(N_C + N_I)], velocities[FB_AT_LEAST_1(N_C)];
    position(t, x, constants, r, errors, slopes);
    constraint_violation(t, x, constants, r, positions, velocities);
    for (int i = 0; i < N_H; ++i)
        largest = fb_larger(largest, fabs(errors[i]));
    for (int i = 0; i < N_VELOCITY_ROWS; ++i)
        largest = fb_larger(largest, fabs(velocities[velocity_rows[i]]));
    return largest;
}

/* For each of n states: itself, inputs, outputs, kinetic and potential energy and their sum, multipliers, the largest
 * residual of a constraint, vectors, points, forces, and rotation matrices of bodies; not numbers where they cannot be
 * evaluated. */
void FB_EXPORT(observe)(const double *times, const double *states, const long n, double *rows)
{
    own_of(&mechanism)->clock = fb_all_time;
    for (long i = 0; i < n; ++i) {
        double t, rates[N_U], solved[FB_AT_LEAST_1(N_L)], *row = rows + i * row_length();
        mechanism.t = times[i];
        memcpy(mechanism.x, states + i * N_X, sizeof mechanism.x);
        fb_problem *const problem = problem_now(&mechanism, &t);
        const double *const x = mechanism.x, *const c = problem->constants, *const r = problem->inputs;
        const int status = accelerations(t, x, c, r, rates, solved, problem->work);
        for (int k = 0; k < N_X; ++k)
            *row++ = x[k];
        for (int k = 0; k < N_R; ++k)
            *row++ = r[k];
        output(t, x, c, r, rates, solved, row);
        for (int k = 0; k < N_O; ++k, ++row)
            *row = status == FB_OK ? *row : NAN;
        energy(t, x, c, r, row);
        row[2] = row[0] + row[1];
        row += 3;
        for (int k = 0; k < N_C; ++k)
            *row++ = status == FB_OK ? solved[k] : NAN;
        *row++ = largest_residual(t, x, c, r);
        fill_vectors(t, x, c, r, row);
        row += 3 * N_VECTORS;
        drawing(t, x, c, r, row, row + 3 * N_POINTS);
        orientations(t, x, c, r, row + 3 * (N_POINTS + N_FORCES));
    }
}

#endif
