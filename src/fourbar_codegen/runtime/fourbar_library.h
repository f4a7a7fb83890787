/* A model as a C library: closing loops, steps of fixed length, and runs with step control.
 *
 * Included once, after fourbar_model.h, by a source that defines FB_MODEL, the name of the model and of the structure
 * that its header declares (FB_WITHOUT_HEADER declares it here); N_DEPENDENT_COORDINATES, N_DEPENDENT_SPEEDS and
 * N_MOTION_BREAKPOINTS; and initial_state, default_parameters, has_expression and has_next_rate. Public names begin
 * with that of the model. Memory is the caller's, in one piece, whose pointers are set anew in each call, so that a
 * copy of it is a copy of the mechanism in its present state. Every loop ends after a constant number of turns.
 */
#ifndef FOURBAR_LIBRARY_H
#define FOURBAR_LIBRARY_H

#include "fourbar_close.h"
#include "fourbar_integrate.h"

#define FB_JOINED(model, name) model##_##name
#define FB_NAMED(model, name) FB_JOINED(model, name)
#define FB_PUBLIC(name) FB_NAMED(FB_MODEL, name)

/* Who includes this may set the values of inputs by a function of its own, and then define FB_CHANGES, the largest
 * number of their breakpoints, and next_change, the next of these times between two others, or the second one. */
#ifndef FB_CHANGES
#define FB_CHANGES 0
#define FB_CALLED_INPUTS NULL
#define next_change(begin, end) (end)
#endif

enum { N_PADDED = (N_X + FB_BLOCK - 1) / FB_BLOCK * FB_BLOCK, N_ROWS = 32 };

/* What a mechanism needs between calls: the constants, the workspace of the equations, and the state and the stages of
 * a step. */
typedef struct fb_own {
    double constants[FB_AT_LEAST_1(N_CONSTANTS)];
    double rows[N_ROWS * N_PADDED];
    double rtol[N_PADDED], atol[N_PADDED];
    double failed_x[N_X], moved_x[N_X];
    double inputs[FB_AT_LEAST_1(N_R)];
    fb_source sources[FB_AT_LEAST_1(N_R)];
    fb_table tables[FB_AT_LEAST_1(N_R)];
    double lines[FB_AT_LEAST_1(N_R)][4]; /* of inputs with a slope: the times, slope and value */
    fb_clock clock;                      /* the interval between two discontinuities in which an importer integrates */
    fb_problem problem;
    fb_run run;
    int prepared; /* the order of the method whose weights the run has */
    fb_work work;
} fb_own;

#ifdef FB_WITHOUT_HEADER
struct FB_MODEL {
    double t, x[N_X], p[FB_AT_LEAST_1(N_P)], r[FB_AT_LEAST_1(N_R)];
    double slope[FB_AT_LEAST_1(N_R)], since;
    int held[FB_AT_LEAST_1(N_R)];
    union {
        double alignment;
        unsigned char bytes[sizeof(fb_own)];
    } memory;
};
#else
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

/* The run at the present state, by a method of order 4 or 8. Its weights are prepared when the method changes. */
static fb_run *run_of(struct FB_MODEL *model, const int order)
{
    fb_own *const own = own_of(model);
    fb_run *const run = &own->run;
    run->problem = problem_of(model);
    run->method = order == 8 ? &fb_dop853 : &fb_rk4;
    if (own->prepared != order)
        fb_prepare_method(run);
    own->prepared = order;
    run->step = fb_step_on;
    run->augmented = NULL;
    run->n = N_X;
    run->padded = N_PADDED;
    run->project = N_C + N_I > 0;
    run->rtol = own->rtol;
    run->atol = own->atol;
    run->x = own->rows;
    run->x_old = own->rows + N_PADDED;
    run->scratch = own->rows + 2 * N_PADDED;
    run->along = own->rows + 3 * N_PADDED;
    run->interpolant = own->rows + 5 * N_PADDED;
    run->stages = own->rows + 12 * N_PADDED;
    own->work.largest_pivot = 0.0; /* no step was taken yet */
    memset(run->x, 0, N_PADDED * sizeof *run->x);
    memcpy(run->x, model->x, sizeof model->x);
    run->t = run->t_begin = model->t;
    run->n_steps = run->n_evaluations = 0;
    run->fsal = run->interpolant_valid = run->collapsed = run->look_at_all = run->n_events = 0;
    return run;
}

/* Takes over the state that a run has reached. */
static void reach(struct FB_MODEL *model, const fb_run *run, const double t)
{
    memcpy(model->x, run->x, sizeof model->x);
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

/* Whether a prescribed position or speed jumps at a time: the change between neighbouring times is larger than those on
 * both sides. */
static int jumps_at(const fb_problem *problem, const double t)
{
    const double step = 4.0 * (nextafter(fabs(t), INFINITY) - fabs(t));
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
        if (has_next_rate[i] && !held && !(jump <= 1e-9 * size + 10.0 * around))
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
    return next_change(begin, next);
}

/* The end of the piece from one time towards another: inputs are those between two discontinuities. */
static double begin_piece(fb_problem *problem, const double begin, const double end)
{
    if (N_BREAKPOINTS + FB_CHANGES == 0)
        return end;
    const double until = next_breakpoint(problem, begin, end);
    problem->clock.first = nextafter(fb_min(begin, until), INFINITY);
    problem->clock.last = nextafter(fb_max(begin, until), -INFINITY);
    return until;
}

int FB_PUBLIC(jumps)(struct FB_MODEL *model)
{
    const fb_problem *const problem = problem_of(model);
    const double spacing = 4.0 * (nextafter(fabs(model->t), INFINITY) - fabs(model->t));
    double times[FB_AT_LEAST_1(N_BREAKPOINTS)];
    breakpoints(0.0, problem->constants, times);
    for (int i = 0; i < N_MOTION_BREAKPOINTS; ++i)
        if (fabs(times[i] - model->t) <= spacing && jumps_at(problem, times[i]))
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
    clock->first = N_BREAKPOINTS > 0 ? nextafter(begin, INFINITY) : -INFINITY;
    clock->last = N_BREAKPOINTS > 0 ? nextafter(end, -INFINITY) : INFINITY;
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

int FB_PUBLIC(step)(struct FB_MODEL *model, const double h, const int order)
{
    fb_run *const run = run_of(model, order == 8 ? 8 : 4);
    if (!(order == 4 || order == 8) || !isfinite(h) || !isfinite(model->t))
        return FB_INVALID_ARGUMENT;
    if (N_MOTION_BREAKPOINTS > 0 && jumps_between(run->problem, model->t, model->t + h))
        return FB_SPEEDS_JUMP;
    const double t_end = model->t + h;
    int status = FB_OK;
    for (int piece = 0; piece <= N_BREAKPOINTS + FB_CHANGES && status == FB_OK && run->t != t_end; ++piece) {
        const double until = begin_piece(run->problem, run->t, t_end);
        status = fb_step_to(run, piece == 0 && until == t_end ? h : until - run->t, until);
    }
    if (status == FB_OK)
        reach(model, run, t_end);
    return status;
}

/* Whether the constraints lose rank within the last step, in which the sign of det J_d has changed: at one of many
 * states, those near the least of them looked at more closely. */
static int passes_singular_position(fb_run *run, const double typical)
{
    double low = run->t_old, high = run->t, least = INFINITY;
    for (int turn = 0; turn < 5; ++turn) {
        const double part = (high - low) / 32.0, begin = low;
        double smallest = INFINITY;
        for (int i = 1; i < 32; ++i) {
            const double t = begin + i * part;
            if (fb_state_at(run, t, run->along) < 0)
                return 0;
            fb_fill_inputs(run->problem, t, run->along);
            const double pivot =
                fb_least_pivot(t, run->along, run->problem->constants, run->problem->inputs, run->problem->work);
            if (pivot < smallest) {
                smallest = pivot;
                low = t - part;
                high = t + part;
            }
        }
        least = smallest < least ? smallest : least;
    }
    return least < FB_PASSED_RATIO * typical;
}

static double least_pivot_of(const fb_run *run)
{
    if (N_RANK == 0)
        return 1.0;
    return fb_least_pivot(run->t, run->x, run->problem->constants, run->problem->inputs, run->problem->work);
}

int FB_PUBLIC(simulate)(struct FB_MODEL *model, const double t_end, const double rtol, const double atol,
                        const double *times, const long n_times, double *states)
{
    fb_own *const own = own_of(model);
    own->clock = fb_all_time;
    fb_run *const run = run_of(model, 8);
    const double begin = model->t;
    double unused, here = begin;
    if (!isfinite(begin) || !isfinite(t_end) || !(rtol > 0.0) || !(atol > 0.0))
        return FB_INVALID_ARGUMENT;
    if (n_times < 0 || (n_times > 0 && (times == NULL || states == NULL)))
        return FB_INVALID_ARGUMENT;
    for (long i = 0; i < n_times; ++i)
        if (!(times[i] >= fb_min(begin, t_end) && times[i] <= fb_max(begin, t_end)) ||
            (i > 0 && (times[i] - times[i - 1]) * (t_end - begin) < 0.0))
            return FB_INVALID_ARGUMENT;
    if (N_MOTION_BREAKPOINTS > 0 && jumps_between(run->problem, begin, t_end))
        return FB_SPEEDS_JUMP;
    for (int i = 0; i < N_PADDED; ++i) {
        own->rtol[i] = i < N_X ? rtol : 1.0;
        own->atol[i] = i < N_X ? atol : 1.0;
    }
    run->direction = t_end >= begin ? 1.0 : -1.0;
    run->max_step = INFINITY;
    run->times = times;
    run->n_times = times ? n_times : 0;
    run->next_time = run->n_samples = 0;
    run->sample_t = &unused;
    run->sample_x = states;
    run->room = 1;
    if (times == NULL)
        run->times = &unused;
    int status = run->project ? fb_problem_project(run->problem, begin, run->x, 0) : FB_OK;
    if (status != FB_OK)
        return status;
    long counted = 0;
    double typical = 0.0, sum = 0.0; /* the geometric mean over the run of the least pivot of J */
    for (int piece = 0; piece <= N_BREAKPOINTS + FB_CHANGES; ++piece) {
        const double until = begin_piece(run->problem, here, t_end);
        run->t_bound = run->until = until;
        run->pending = piece == 0;
        if (piece == 0) {
            fb_begin(run);
            typical = least_pivot_of(run);
        } else
            fb_resume(run);
        for (;;) {
            const int reason = fb_run_on(run, 1);
            if (reason == FB_RUN_EVENT && passes_singular_position(run, typical)) {
                memcpy(run->x, run->x_old, sizeof model->x);
                reach(model, run, run->t_old);
                return FB_SINGULAR_POSITION;
            }
            if (run->n_steps > counted) {
                counted = run->n_steps;
                sum += fabs(run->h) * log(least_pivot_of(run));
                typical = exp(sum / fabs(run->t - begin));
            }
            if (reason == FB_RUN_END)
                break;
            if (reason == FB_RUN_FULL) {
                run->sample_x += N_X;
                run->n_samples = 0;
                continue;
            }
            if (reason != FB_RUN_TOO_SMALL && reason != FB_RUN_INFINITE && run->n_steps < FB_MAX_RUN_STEPS)
                continue;
            if (run->pending) { /* to where the last samples were taken */
                memcpy(run->x, run->x_old, sizeof model->x);
                run->t = run->t_old;
            }
            reach(model, run, run->t);
            if (least_pivot_of(run) < FB_FAILED_RATIO * typical)
                return FB_SINGULAR_POSITION;
            return run->problem->status != FB_OK      ? run->problem->status
                   : run->n_steps >= FB_MAX_RUN_STEPS ? FB_TOO_MANY_STEPS
                                                      : FB_STEP_TOO_SMALL;
        }
        here = until;
        if (until == t_end)
            break;
    }
    reach(model, run, t_end);
    return FB_OK;
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
