/* A model as a C library: closing loops, steps of fixed length, and runs with step control.
 *
 * Included once, after kernel/kernel.h, by a source that defines FB_MODEL, the name of the model and of the structure
 * that its header declares (FB_WITHOUT_HEADER declares it here); N_DEPENDENT_COORDINATES, N_DEPENDENT_SPEEDS and
 * N_MOTION_BREAKPOINTS; and initial_state, default_parameters, has_expression and has_next_rate. Public names begin
 * with that of the model. Memory is the caller's, in one piece, whose pointers are set anew in each call, so that a
 * copy of it is a copy of the mechanism in its present state. Every loop ends after a constant number of turns.
 */
#ifndef FOURBAR_LIBRARY_H
#define FOURBAR_LIBRARY_H

#include "../kernel/loop_closure.h"
#include "../run/driver.h"
#include "public_names.h"

/* Who includes this may set the values of inputs by a function of its own, and then define FB_CHANGES, the largest
 * number of their breakpoints, and FB_NEXT_CHANGE, the next of these times between two others, or the second one. */
#ifndef FB_CHANGES
#define FB_CHANGES 0
#define FB_CALLED_INPUTS NULL
#define FB_NEXT_CHANGE(begin, end) (end)
#endif

/* The most steps of a run. */
#ifndef FB_MAX_RUN_STEPS
#define FB_MAX_RUN_STEPS 1000000
#endif

/* The rows of a run: those of its stepper, and three that it looks along. */
enum { N_PADDED = FB_PADDED(N_X), N_ROWS = FB_STEPPER_ROWS + 4 };

/* What a mechanism needs between calls: the constants, the workspace of the equations, and the state and the stages of
 * a step. */
typedef struct fb_own {
    double constants[FB_AT_LEAST_1(N_CONSTANTS)];
    double rows[N_ROWS * N_PADDED];
    double rtol[N_X], atol[N_X];
    double failed_x[N_X], moved_x[N_X];
    double conditions[FB_AT_LEAST_1(4 * N_CONDITIONS)];
    double inputs[FB_AT_LEAST_1(N_R)];
    fb_source sources[FB_AT_LEAST_1(N_R)];
    fb_table tables[FB_AT_LEAST_1(N_R)];
    double lines[FB_AT_LEAST_1(N_R)][4]; /* of inputs with a slope: the times, slope and value */
    fb_clock clock;                      /* the interval between two discontinuities in which an importer integrates */
    fb_problem problem;
    fb_run run;
    fb_work work;
} fb_own;

#ifdef FB_WITHOUT_HEADER
struct FB_MODEL {
    double t, x[N_X], p[FB_AT_LEAST_1(N_P)], r[FB_AT_LEAST_1(N_R)];
    double slope[FB_AT_LEAST_1(N_R)], since;
    int held[FB_AT_LEAST_1(N_R)];
    int method;
    union {
        double alignment;
        unsigned char bytes[sizeof(fb_own)];
    } memory;
};
struct FB_EVENT {
    int quantity, number, direction, ends_only, at_start;
    long terminal;
    double (*function)(void *of, double t, const double *x);
    void *of;
};
struct FB_FOUND {
    int event;
    double t, x[N_X];
};
struct FB_EVENTS {
    int n;
    const struct FB_EVENT *event;
    double *work;
    struct FB_FOUND *found;
    long room, n_found;
    int ended_by;
};
#else
/* The workspace of an event, in doubles: its values, at the points of a series, at the end, and scratch; itself; and
 * its changes of sign. */
typedef char fb_event_work_is_enough[(FB_MOST_DEGREE + 3) * sizeof(double) + sizeof(fb_event) +
                                                 FB_MOST_CROSSINGS * sizeof(fb_found) <=
                                             FB_PUBLIC(event_work) * sizeof(double)
                                         ? 1
                                         : -1];
/* The memory that the header declares is large enough: otherwise this array has a negative size. */
typedef char fb_memory_is_large_enough[sizeof(fb_own) <= sizeof(((struct FB_MODEL *)0)->memory) ? 1 : -1];
#endif

static fb_own *own_of(struct FB_MODEL *model)
{
    return (fb_own *)(void *)model->memory.bytes;
}

/* The problem with the inputs as they are held now; pointers are set anew, since the mechanism may be a copy. */
static fb_problem *problem_of(struct FB_MODEL *model)
{
    fb_own *const own = own_of(model);
    fb_problem *const problem = &own->problem;
    problem->kernel = &FB_TABLE(kernel);
    problem->constants = own->constants;
    problem->inputs = own->inputs;
    problem->work = &own->work;
    problem->clock = own->clock;
    problem->stabilization = 0.0;
    problem->sources = own->sources;
    problem->n_sources = 0;
    for (int i = 0; i < N_R; ++i)
        if (model->held[i]) {
            fb_source *const source = own->sources + problem->n_sources++;
            source->input = i;
            source->value = model->r[i];
            source->table = NULL;
            if (model->slope[i] != 0.0 && model->since < INFINITY) { /* from `since` on, before that the value itself */
                fb_table *const table = own->tables + i;
                double *const line = own->lines[i];
                line[0] = model->since;
                line[1] = INFINITY;
                line[2] = model->slope[i];
                line[3] = model->r[i];
                table->n_intervals = 1;
                table->n_coefficients = 2;
                table->times = line;
                table->coefficients = line + 2;
                table->before = table->after = model->r[i];
                source->table = table;
                source->interval = 0;
            }
        }
    problem->called_inputs = FB_CALLED_INPUTS;
    problem->status = FB_OK;
    problem->failed_x = own->failed_x;
    problem->moved_x = own->moved_x;
    return problem;
}

/* The same, with the inputs of the present time, between the discontinuities that an importer stated. */
static fb_problem *problem_now(struct FB_MODEL *model, double *t)
{
    fb_problem *const problem = problem_of(model);
    *t = fb_time(&problem->clock, model->t);
    fb_fill_inputs(problem, *t, model->x);
    return problem;
}

/* The run at the present state. */
static fb_run *run_of(struct FB_MODEL *model, const fb_steps *steps)
{
    fb_own *const own = own_of(model);
    fb_run *const run = &own->run;
    fb_stepper *const stepper = &run->stepper;
    stepper->problem = problem_of(model);
    stepper->project = N_C + N_I > 0;
    run->watch.along = own->rows + fb_place_stepper(stepper, steps->method, steps->tableau, N_X, own->rows);
    stepper->own = steps->own;
    stepper->rtol = own->rtol;
    stepper->atol = own->atol;
    memset(stepper->x, 0, N_PADDED * sizeof *stepper->x);
    memcpy(stepper->x, model->x, sizeof model->x);
    stepper->t = run->pace.t_begin = model->t;
    stepper->n_steps = stepper->n_evaluations = 0;
    stepper->fsal = stepper->interpolant_valid = run->pace.collapsed = 0;
    run->watch.singular.x = run->watch.along + 2 * N_PADDED;
    run->chattering.values = own->conditions;
    return run;
}

/* Takes over the state that a run has reached. */
static void reach(struct FB_MODEL *model, const fb_run *run, const double t)
{
    memcpy(model->x, run->stepper.x, sizeof model->x);
    model->t = t;
}

/* The larger of two; NaN if one is NaN. */
static double fb_larger(const double a, const double b)
{
    return a != a || a > b ? a : b;
}

int FB_PUBLIC(update)(struct FB_MODEL *model)
{
    fb_own *const own = own_of(model);
    prepare(model->p, own->constants);
    return all_finite(model->p, N_P) == FB_OK ? all_finite(own->constants, N_CONSTANTS) : FB_NOT_FINITE;
}

void FB_PUBLIC(init)(struct FB_MODEL *model)
{
    fb_own *const own = own_of(model);
    memset(model, 0, sizeof *model);
    memcpy(model->p, default_parameters, sizeof model->p);
    memcpy(model->x, initial_state, sizeof model->x);
    own->clock = fb_all_time;
    FB_PUBLIC(update)(model);
    default_inputs(0.0, own->constants, model->r);
    for (int i = 0; i < N_R; ++i)
        model->held[i] = !has_expression[i];
}

int FB_PUBLIC(close)(struct FB_MODEL *model)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    double x[N_X];
    memcpy(x, model->x, sizeof x);
    const int status = fb_close(t, x, problem->constants, problem->inputs);
    if (status == FB_OK)
        memcpy(model->x, x, sizeof x);
    return status;
}

int FB_PUBLIC(rhs)(struct FB_MODEL *model, const double time, const double *x, double *rates)
{
    fb_problem *const problem = problem_of(model);
    const double t = fb_time(&problem->clock, time);
    fb_fill_inputs(problem, t, x);
    return FB_RHS(t, x, problem->constants, problem->inputs, rates, problem->work);
}

int FB_PUBLIC(solution)(struct FB_MODEL *model, double *rates, double *multipliers)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    return accelerations(t, model->x, problem->constants, problem->inputs, rates, multipliers, problem->work);
}

int FB_PUBLIC(outputs)(struct FB_MODEL *model, double *outputs)
{
    fb_problem *const problem = problem_of(model);
    double rates[N_U], multipliers[FB_AT_LEAST_1(N_L)];
    const int status = FB_PUBLIC(solution)(model, rates, multipliers);
    if (status != FB_OK)
        return status;
    output(fb_time(&problem->clock, model->t), model->x, problem->constants, problem->inputs, rates, multipliers,
           outputs);
    return all_finite(outputs, N_O);
}

void FB_PUBLIC(energies)(struct FB_MODEL *model, double *kinetic, double *potential)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    double found[2];
    energy(t, model->x, problem->constants, problem->inputs, found);
    *kinetic = found[0];
    *potential = found[1];
}

double FB_PUBLIC(violation)(struct FB_MODEL *model)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    double position_violations[FB_AT_LEAST_1(N_C + N_I)], velocity_violations[FB_AT_LEAST_1(N_C)], largest = 0.0;
    constraint_violation(t, model->x, problem->constants, problem->inputs, position_violations, velocity_violations);
    for (int i = 0; i < N_C + N_I; ++i)
        largest = fb_larger(largest, fabs(position_violations[i]));
    for (int i = 0; i < N_C; ++i)
        largest = fb_larger(largest, fabs(velocity_violations[i]));
    return largest;
}

double FB_PUBLIC(relative_violation)(struct FB_MODEL *model)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    double positions[FB_AT_LEAST_1(N_C + N_I)], velocities[FB_AT_LEAST_1(N_C)], unused[FB_AT_LEAST_1(N_H)];
    double position_scale[FB_AT_LEAST_1(N_C + N_I)], velocity_scale[FB_AT_LEAST_1(N_C)];
    constraint_violation(t, model->x, problem->constants, problem->inputs, positions, velocities);
    constraint_scale(t, model->x, problem->constants, problem->inputs, unused, position_scale, velocity_scale);
    return fb_larger(fb_violation(positions, position_scale, N_C + N_I), fb_violation(velocities, velocity_scale, N_C));
}

double FB_PUBLIC(input)(struct FB_MODEL *model, const int number)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    if (number < 0 || number >= N_R)
        return NAN;
    return problem->inputs[number];
}

int FB_PUBLIC(project)(struct FB_MODEL *model)
{
    return fb_problem_project(problem_of(model), model->t, model->x, 0);
}

/* Up to so many seconds, two times are equal but for rounding errors, and so are the sides of a condition there. */
static double rounding_of(const double begin, const double end)
{
    const double latest = isfinite(end) ? fb_max(fabs(begin), fabs(end)) : fabs(begin);
    return FB_SAME_SPACINGS * (nextafter(latest, INFINITY) - latest);
}

/* Whether a prescribed position or speed jumps at a time: the change between neighbouring times is larger than those on
 * both sides. */
static int jumps_at(const fb_problem *problem, const double t)
{
    const double step = rounding_of(t, t);
    double values[4][FB_AT_LEAST_1(N_R)], apart[2][FB_AT_LEAST_1(N_R)];
    for (int k = 0; k < 4; ++k)
        default_inputs(t + step * (k < 2 ? k - 2 : k - 1), problem->constants, values[k]);
    for (int k = 0; k < 2; ++k) /* for the size of the motion, which may be zero at t itself */
        default_inputs(t + (k ? 0.1 : -0.1) * fabs(t), problem->constants, apart[k]);
    for (int i = 0; i < N_R; ++i) {
        const double jump = fabs(values[2][i] - values[1][i]);
        double size = fb_max(fabs(values[1][i]), fabs(values[2][i]));
        for (int k = 0; k < 2; ++k)
            size = isfinite(apart[k][i]) ? fb_max(size, fabs(apart[k][i])) : size;
        const double around = fabs(values[1][i] - values[0][i]) + fabs(values[3][i] - values[2][i]);
        int held = 0;
        for (int k = 0; k < problem->n_sources; ++k)
            held |= problem->sources[k].input == i;
        if (has_next_rate[i] && !held && !(jump <= FB_JUMP_RTOL * size + FB_STEADY_RATIO * around))
            return 1;
    }
    return 0;
}

/* Whether it jumps after one time, or at the other one. The speeds after a jump follow from an impulse. */
static int jumps_between(const fb_problem *problem, const double begin, const double end)
{
    double times[FB_AT_LEAST_1(N_BREAKPOINTS)];
    breakpoints(0.0, problem->constants, times);
    for (int i = 0; i < N_MOTION_BREAKPOINTS; ++i)
        if (times[i] >= fb_min(begin, end) && times[i] <= fb_max(begin, end) && times[i] != begin &&
            jumps_at(problem, times[i]))
            return 1;
    return 0;
}

/* The next breakpoint between two times, or the second time. */
static double next_breakpoint(const fb_problem *problem, const double begin, const double end)
{
    double times[FB_AT_LEAST_1(N_BREAKPOINTS)], next = end;
    breakpoints(0.0, problem->constants, times);
    for (int i = 0; i < N_BREAKPOINTS; ++i)
        if (times[i] > fb_min(begin, next) && times[i] < fb_max(begin, next))
            next = times[i];
    return FB_NEXT_CHANGE(begin, next);
}

/* The segment from one time towards another: inputs are those between two discontinuities. */
static fb_segment segment_from(void *of, const double begin, const double end)
{
    const fb_problem *const problem = of;
    const double towards = end < begin ? -INFINITY : INFINITY;
    if (N_BREAKPOINTS + FB_CHANGES == 0)
        return (fb_segment){begin, end, -towards, towards};
    const double until = next_breakpoint(problem, begin, end);
    const double rounding = copysign(rounding_of(begin, until), towards);
    return (fb_segment){begin, until, begin + rounding, until - rounding};
}

int FB_PUBLIC(jumps)(struct FB_MODEL *model)
{
    const fb_problem *const problem = problem_of(model);
    const double rounding = rounding_of(model->t, model->t);
    double times[FB_AT_LEAST_1(N_BREAKPOINTS)];
    breakpoints(0.0, problem->constants, times);
    for (int i = 0; i < N_MOTION_BREAKPOINTS; ++i)
        if (fabs(times[i] - model->t) <= rounding && jumps_at(problem, times[i]))
            return 1;
    return 0;
}

double FB_PUBLIC(next_breakpoint)(struct FB_MODEL *model)
{
    return next_breakpoint(problem_of(model), model->t, INFINITY);
}

void FB_PUBLIC(between)(struct FB_MODEL *model, const double begin, const double end)
{
    fb_clock *const clock = &own_of(model)->clock;
    const double rounding = rounding_of(begin, end);
    clock->first = N_BREAKPOINTS > 0 ? begin + rounding : -INFINITY;
    clock->last = N_BREAKPOINTS > 0 ? end - rounding : INFINITY;
}

/* The ends of that interval as they are kept, for those who store a mechanism. */
void FB_PUBLIC(get_interval)(const struct FB_MODEL *model, double *interval)
{
    const fb_clock *const clock = &((const fb_own *)(const void *)model->memory.bytes)->clock;
    interval[0] = clock->first;
    interval[1] = clock->last;
}

void FB_PUBLIC(set_interval)(struct FB_MODEL *model, const double *interval)
{
    fb_clock *const clock = &own_of(model)->clock;
    clock->first = interval[0];
    clock->last = interval[1];
}

/* A step of length h by any method. */
int FB_PUBLIC(advance)(struct FB_MODEL *model, const fb_steps *steps, const double h)
{
    fb_own *const own = own_of(model);
    fb_run *const run = run_of(model, steps);
    if (!isfinite(h) || !isfinite(model->t))
        return FB_INVALID_ARGUMENT;
    for (int i = 0; i < N_X; ++i)
        own->rtol[i] = own->atol[i] = FB_STEP_TOLERANCE;
    if (N_MOTION_BREAKPOINTS > 0 && jumps_between(run->stepper.problem, model->t, model->t + h))
        return FB_SPEEDS_JUMP;
    const double t_end = model->t + h;
    fb_stepper *const stepper = &run->stepper;
    const int status = fb_fixed_step_across(stepper, h, t_end, segment_from, stepper->problem);
    if (status == FB_OK)
        reach(model, run, t_end);
    return status;
}

int FB_PUBLIC(step)(struct FB_MODEL *model, const double h, const int order)
{
    if (order != 4 && order != 8)
        return FB_INVALID_ARGUMENT;
    const fb_steps steps = {&fb_runge_kutta, order == 8 ? &fb_dop853 : &fb_rk4, NULL};
    return FB_PUBLIC(advance)(model, &steps, h);
}

/* Whether a run to t_end can store its states at these times, which are in its order. */
static int is_run(const struct FB_MODEL *model, const double t_end, const double *times, const long n_times,
                  const double *states)
{
    const double begin = model->t;
    if (!isfinite(begin) || !isfinite(t_end))
        return 0;
    if (n_times < 0 || (n_times > 0 && (times == NULL || states == NULL)))
        return 0;
    for (long i = 0; i < n_times; ++i)
        if (!(times[i] >= fb_min(begin, t_end) && times[i] <= fb_max(begin, t_end)) ||
            (i > 0 && (times[i] - times[i - 1]) * (t_end - begin) < 0.0))
            return 0;
    return 1;
}

/* What it means that a run has stopped before its end. */
static int status_of_stop(fb_run *run, const int reason)
{
    const int status = run->stepper.problem->status;
    if (reason == FB_RUN_SINGULAR || (reason == FB_RUN_PAUSED && fb_stops_at_singular_position(run, reason) > 0))
        return FB_SINGULAR_POSITION;
    if (reason == FB_RUN_CHATTERING)
        return FB_CHATTERING;
    return status != FB_OK ? status : reason == FB_RUN_PAUSED ? FB_TOO_MANY_STEPS : FB_STEP_TOO_SMALL;
}

/* Calls an event's function of the caller. */
static int call_event(void *events, const int number, const double t, const double *x, double *value)
{
    const struct FB_EVENT *const event = ((struct FB_EVENTS *)events)->event + number;
    *value = event->function(event->of, t, x);
    return 0;
}

/* The rows of each quantity. */
static int has_quantity(const struct FB_EVENT *event)
{
    static const int rows[FB_N_WATCHEDS] = {
        [FB_WATCHED_TIME] = 1,         [FB_WATCHED_STATE] = N_X, [FB_WATCHED_INPUT] = N_R,  [FB_WATCHED_OUTPUT] = N_O,
        [FB_WATCHED_MULTIPLIER] = N_L, [FB_WATCHED_ENERGY] = 3,  [FB_WATCHED_MOMENTUM] = 9, [FB_WATCHED_CALLABLE] = 1};
    const int quantity = event->quantity;
    if (quantity < 0 || quantity >= FB_N_WATCHEDS || event->number < 0 || event->number >= rows[quantity])
        return 0;
    return (quantity != FB_WATCHED_CALLABLE || event->function != NULL) && event->terminal >= 0;
}

/* Makes a run look for events in the caller's memory; returns whether they are complete. */
static int watch_events(fb_run *run, struct FB_EVENTS *events, double *scratch)
{
    fb_watch *const watch = &run->watch;
    watch->n_events = 0;
    if (events == NULL)
        return 1;
    const int n = events->n;
    if (n < 0 || (n > 0 && (events->event == NULL || events->work == NULL)) ||
        (events->room > 0 && events->found == NULL))
        return 0;
    for (int i = 0; i < n; ++i)
        if (!has_quantity(events->event + i))
            return 0;
    fb_place_events(watch, n, 0, events->work);
    watch->n_events = n;
    watch->scratch = scratch;
    watch->call = call_event;
    watch->caller = events;
    for (int i = 0; i < n; ++i) {
        const struct FB_EVENT *const event = events->event + i;
        watch->events[i] = (fb_event){.quantity = event->quantity,
                                      .row = event->quantity == FB_WATCHED_CALLABLE ? i : event->number,
                                      .direction = (event->direction > 0) - (event->direction < 0),
                                      .terminal = event->terminal,
                                      .at_start = event->at_start,
                                      .all_roots = !event->ends_only,
                                      .touched = NAN};
    }
    events->n_found = 0;
    events->ended_by = -1;
    return 1;
}

/* Stores the events found last; returns whether one of them ends the run, which is there then. */
static int note_events(struct FB_MODEL *model, fb_run *run, struct FB_EVENTS *events)
{
    const fb_watch *const watch = &run->watch;
    fb_stepper *const stepper = &run->stepper;
    double t = stepper->t;
    for (int k = 0; k < watch->n_found; ++k) {
        t = fb_time_of_fraction(stepper, watch->found[k].fraction);
        if (events->n_found < events->room) {
            struct FB_FOUND *const found = events->found + events->n_found;
            found->event = watch->found[k].event;
            found->t = t;
            fb_state_at(stepper, t, found->x);
        }
        events->n_found += 1;
    }
    if (watch->ended_by < 0)
        return 0;
    events->ended_by = watch->ended_by;
    fb_stop_within(run, t);
    fb_run_on(run, 0); /* the samples before it */
    fb_state_at(stepper, t, model->x);
    model->t = t;
    return 1;
}

/* A run by any method. */
int FB_PUBLIC(run)(struct FB_MODEL *model, const fb_steps *steps, const double t_end, const double rtol,
                   const double atol, const double *times, const long n_times, double *states, struct FB_EVENTS *events)
{
    fb_own *const own = own_of(model);
    double scratch[N_U + N_L + N_O + 12];
    own->clock = fb_all_time;
    if (!is_run(model, t_end, times, n_times, states) || !(rtol > 0.0 && rtol < INFINITY) ||
        !(atol > 0.0 && atol < INFINITY))
        return FB_INVALID_ARGUMENT;
    fb_run *const run = run_of(model, steps);
    fb_stepper *const stepper = &run->stepper;
    const double begin = model->t;
    if (!watch_events(run, events, scratch))
        return FB_INVALID_ARGUMENT;
    if (N_MOTION_BREAKPOINTS > 0 && jumps_between(stepper->problem, begin, t_end))
        return FB_SPEEDS_JUMP;
    for (int i = 0; i < N_X; ++i) {
        own->rtol[i] = rtol;
        own->atol[i] = atol;
    }
    run->direction = t_end >= begin ? 1.0 : -1.0;
    run->t_end = t_end;
    run->max_step = INFINITY;
    run->samples =
        (fb_samples){.times = times ? times : &begin, .n_times = n_times, .x = states, .room = n_times, .pending = 1};
    int status = stepper->project ? fb_problem_project(stepper->problem, begin, stepper->x, 0) : FB_OK;
    if (status != FB_OK)
        return status;
    for (int piece = 0; piece <= N_BREAKPOINTS + FB_CHANGES; ++piece) {
        const fb_segment segment = segment_from(stepper->problem, stepper->t, t_end);
        if (piece == 0) {
            fb_set_segment(run, &segment);
            fb_begin(run);
        } else
            fb_enter(run, &segment, NULL);
        int reason;
        do
            reason = fb_run_on(run, FB_MAX_RUN_STEPS - stepper->n_steps);
        while (reason == FB_RUN_COLLAPSED || (reason == FB_RUN_EVENT && !note_events(model, run, events)));
        if (reason == FB_RUN_EVENT)
            return FB_OK;
        if (reason != FB_RUN_END) {
            reach(model, run, stepper->t);
            if (events) /* those of a step that was taken back */
                for (; events->n_found > 0 && events->n_found <= events->room &&
                       run->direction * (events->found[events->n_found - 1].t - model->t) > 0.0;
                     --events->n_found)
                    ;
            return status_of_stop(run, reason);
        }
        if (segment.t_bound == t_end)
            break;
    }
    reach(model, run, t_end);
    return FB_OK;
}

int FB_PUBLIC(simulate_events)(struct FB_MODEL *model, const double t_end, const double rtol, const double atol,
                               const double *times, const long n_times, double *states, struct FB_EVENTS *events)
{
    if (model->method < 0 || model->method >= FB_N_METHODS)
        return FB_INVALID_ARGUMENT;
    const fb_steps steps = {&fb_runge_kutta, fb_tableaus[model->method], NULL};
    return FB_PUBLIC(run)(model, &steps, t_end, rtol, atol, times, n_times, states, events);
}

double FB_PUBLIC(touched)(struct FB_MODEL *model, const struct FB_EVENTS *events, const int event)
{
    const fb_run *const run = &own_of(model)->run;
    if (run->watch.values != events->work || event < 0 || event >= run->watch.n_events)
        return NAN; /* the last run was another one */
    const double t = run->watch.events[event].touched;
    return run->direction * (model->t - t) >= 0.0 ? t : NAN;
}

int FB_PUBLIC(simulate)(struct FB_MODEL *model, const double t_end, const double rtol, const double atol,
                        const double *times, const long n_times, double *states)
{
    return FB_PUBLIC(simulate_events)(model, t_end, rtol, atol, times, n_times, states, NULL);
}

/* For the source of the derivatives. */
int FB_PUBLIC(differentiate)(struct FB_MODEL *model, const fb_part *derivatives, const enum FB_ROLE role, const int n,
                             double *matrix)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    return differentiate(derivatives->functions, role, n, t, model->x, problem->constants, problem->inputs, matrix,
                         NULL, problem->work);
}

/* By the parameters, also through the expressions of inputs that are not held. */
int FB_PUBLIC(differentiate_by_parameters)(struct FB_MODEL *model, const fb_part *derivatives, double *matrix)
{
    double wrt_inputs[FB_AT_LEAST_1(N_X * N_R)], input_jacobian[FB_AT_LEAST_1(N_R * N_P)];
    int follows = 0;
    int status = FB_PUBLIC(differentiate)(model, derivatives, FB_PARAMETER_PARTIALS, N_P, matrix);
    if (status != FB_OK)
        return status;
    const fb_problem *const problem = &own_of(model)->problem;
    const fb_at at = {fb_time(&problem->clock, model->t), NULL, problem->constants, NULL, NULL, NULL, 0};
    double *const results[] = {input_jacobian};
    derivatives->functions[FB_DEFAULT_INPUT_PARTIALS].call(&at, NULL, results, problem->work);
    for (int i = 0; i < N_R * N_P; ++i) {
        input_jacobian[i] = model->held[i / FB_AT_LEAST_1(N_P)] ? 0.0 : input_jacobian[i];
        follows |= input_jacobian[i] != 0.0;
    }
    if (!follows)
        return FB_OK;
    status = FB_PUBLIC(differentiate)(model, derivatives, FB_INPUT_PARTIALS, N_R, wrt_inputs);
    if (status != FB_OK)
        return status;
    fb_add_through_inputs(problem->kernel, N_X, wrt_inputs, input_jacobian, matrix);
    return all_finite(matrix, N_X * N_P);
}

void FB_PUBLIC(draw)(struct FB_MODEL *model, const fb_part *derivatives, double *points)
{
    double t;
    fb_problem *const problem = problem_now(model, &t);
    double forces[FB_AT_LEAST_1(3 * N_FORCES)];
    const fb_at at = {t, model->x, problem->constants, problem->inputs, NULL, NULL, 0};
    double *const results[] = {points, forces};
    derivatives->functions[FB_DRAWING].call(&at, NULL, results, problem->work);
}

const char *FB_PUBLIC(message)(const int status)
{
    return fb_message(status);
}

#endif
