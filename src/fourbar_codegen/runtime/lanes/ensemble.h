/* Runs of an ensemble: the steps of steppers/runge_kutta.h with a run in each SIMD lane, with its own time and step.
 * When a run ends, the next one takes its lane. A run with a special case (a singular position, collapsing steps, a
 * failed projection, NaN) is marked and leaves its lane, to be run alone.
 */

#include "lanes.h"

/* The segment in which a lane is, which its clock enters; returns its end. */
static inline double fb_lanes_segment(fb_lanes *c, const fb_ensemble *e, const int lane)
{
    const fb_segment segment = fb_segment_behind(&e->breaks, c->next_break[lane], 0.0, e->t_bound, e->origin);
    fb_clock clock;
    fb_enter_clock(&clock, &segment);
    c->clocks.first[lane] = clock.first;
    c->clocks.last[lane] = clock.last;
    return segment.t_bound;
}

/* x' of the requested lanes. */
static __attribute__((noinline)) void fb_lanes_rates(fb_lanes *restrict c, const fb_ensemble *e, const fb_real since,
                                                     const fb_real *x, const fb_mask asked, fb_real *rates)
{
    const fb_real t = fb_lanes_time(c, e, since);
    fb_lanes_inputs(c, e, t);
    fb_lane_rates(&c->equations, t, x, asked, rates);
    c->n_evaluations -= asked;
}

/* Lanes that ask for x'. */
typedef struct fb_asked {
    fb_lanes *c;
    const fb_ensemble *e;
    fb_mask lanes;
} fb_asked;

static inline int fb_lanes_evaluate(const fb_asked *asked, const int row, const fb_real since, const fb_real *x)
{
    fb_lanes_rates(asked->c, asked->e, since, x, asked->lanes, asked->c->stages[row]);
    return 0;
}

#define FB_VALUE fb_real
#define FB_OF(name) name##_lanes
#define FB_MAGNITUDE(value) fb_abs(value)
#define FB_LARGER(a, b) fb_greater(b, a)
#define FB_UNIT(value) (1.0 / (value)) /* divisions take long in lanes */
#define FB_IN_UNITS(value, unit) ((value) * (unit))
#define FB_AT_ONCE ((N_X + (N_X + 7) / 8 - 1) / ((N_X + 7) / 8)) /* blocks of one size, of 8 entries at most */
#define FB_CALLER const fb_asked
#define FB_EVALUATE(caller, row, t, x) fb_lanes_evaluate(caller, row, t, x)
#include "../steppers/stages.inc"

/* The error estimates in units of the tolerances. */
static inline void fb_lanes_error(const fb_lanes *restrict c, const fb_ensemble *e, const fb_real h,
                                  const fb_real *restrict x_new, double *restrict errors)
{
    fb_real scratch[2 * N_X], sums[2];
    fb_estimate_error_lanes(e->method, &c->alone.stepper.weights, N_X, c->stages[0], h, N_X, e->rtol, e->atol, c->x,
                            x_new, scratch, sums);
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        errors[lane] = fb_error_norm(N_X, e->method->n_errors, h[lane], sums[0][lane], sums[1][lane]);
}

#define FB_VALUE fb_real
#define FB_OF(name) name##_lanes
#define FB_FACTORS fb_lane_factors
#define FB_TRUTHS fb_mask
#define FB_TRUTH(condition) (condition)
#define FB_CHOOSE(truths, yes, no) fb_select(truths, yes, no)
#define FB_ANY(truths) fb_any(truths)
#define FB_MAGNITUDE(value) fb_abs(value)
#define FB_LARGER(a, b) fb_greater(a, b)
#define FB_SOLVE(w, factors, change) fb_solve_lanes(NULL, w, factors, change)
#include "../kernel/newton.inc"

/* Projects the states of the requested lanes onto the constraints, by the kernel for single states where necessary;
 * `factors_valid` says whether the factors are those of a state nearby. Returns the lanes that are closed; states that
 * cannot be projected are unchanged, or NaN where the constraints have no value. */
static __attribute__((noinline)) fb_mask fb_lanes_project(fb_lanes *restrict c, const fb_ensemble *e,
                                                          const fb_real since, fb_real *restrict x, const fb_mask asked,
                                                          const int factors_valid)
{
    fb_lane_equations *const s = &c->equations;
    const fb_real t = fb_lanes_time(c, e, since);
    fb_lanes_inputs(c, e, t);
    if (!factors_valid) {
        fb_real coordinate_rates[FB_AT_LEAST_1(N_Q)];
        fb_form_lane_equations(s, t, x, coordinate_rates);
    }
    fb_real given[N_X];
    memcpy(given, x, sizeof given);
    fb_real size[2];
    fb_mask closed = fb_newton_lanes(t, x, s->constants, s->inputs, &s->factors, asked & s->factors.good, size);
    if (fb_any(asked & ~closed))
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (asked[lane] & ~closed[lane]) {
                fb_take_lane(given, lane, N_X, s->lane_x);
                fb_take_lane(s->constants, lane, N_CONSTANTS, s->lane_constants);
                fb_take_lane(s->inputs, lane, N_R, s->lane_inputs);
                const int status =
                    s->kernel->project(t[lane], s->lane_x, s->lane_constants, s->lane_inputs, 0, s->work);
                closed[lane] = status == FB_OK ? -1 : 0;
                for (int i = 0; i < N_X; ++i)
                    x[i][lane] = status == FB_OK ? s->lane_x[i] : status == FB_NOT_FINITE ? NAN : given[i][lane];
            }
    return closed;
}

static inline void fb_leave(fb_lanes *c, const fb_ensemble *e, const int lane, const enum FB_MEMBER how)
{
    const int64_t member = c->member[lane];
    e->n_evaluations[member] = (int64_t)c->n_evaluations[lane];
    e->status[member] = (int8_t)how;
    __atomic_fetch_add(e->counters.n_ended, 1, __ATOMIC_RELAXED);
    c->active[lane] = 0;
}

/* The next sample of the run in a lane. */
static inline void fb_store(fb_lanes *c, const fb_ensemble *e, const int lane, const fb_real *x)
{
    double *const samples = e->samples + c->member[lane] * N_X * e->n_times + c->next_time[lane];
    for (int i = 0; i < N_X; ++i)
        samples[i * e->n_times] = x[i][lane];
    c->next_time[lane] += 1;
}

#include "lane_events.h"

/* Starts the next waiting member in a free lane. */
static inline void fb_lanes_enter(fb_lanes *c, const fb_ensemble *e, const int lane)
{
    fb_lane_equations *const s = &c->equations;
    fb_stepper *const b = &c->alone.stepper;
    for (;;) {
        const int64_t member = __atomic_fetch_add(e->counters.next, 1, __ATOMIC_RELAXED);
        if (member >= e->n)
            return;
        c->member[lane] = member;
        c->next_time[lane] = c->n_steps[lane] = 0;
        c->rejected[lane] = c->next_break[lane] = 0;
        c->lengths[lane] = (fb_step_lengths){0.0, 0.0, 0.0};
        c->bound[lane] = fb_lanes_segment(c, e, lane);
        c->problem.clock = (fb_clock){e->origin, c->clocks.first[lane], c->clocks.last[lane]};
        double *const x = e->x + member * N_X;
        s->kernel->prepare(e->p + member * N_P, s->lane_constants);
        for (int k = 0; k < e->n_sources; ++k) {
            c->sources[lane][k] = e->sources[k];
            c->sources[lane][k].value = e->values[member * e->n_sources + k];
        }
        c->problem.sources = c->sources[lane];
        c->problem.status = FB_OK;
        b->t = 0.0;
        b->n_evaluations = 0;
        int status = e->project ? fb_problem_project(&c->problem, 0.0, x, 0) : FB_OK;
        memcpy(b->x, x, N_X * sizeof *x);
        double h_abs = NAN;
        if (status == FB_OK)
            status = fb_runge_kutta_init(b, e->t_bound > 0.0 ? 1.0 : -1.0, fabs(e->t_bound), e->max_step, &h_abs);
        c->n_evaluations[lane] = b->n_evaluations;
        c->search.begins[lane] = 1;
        if (e->events.n > 0)
            memcpy(c->search.events + lane * e->events.n, e->events.events, (size_t)e->events.n * sizeof(fb_event));
        if (status != FB_OK || !fb_finite(b->stages, N_X) || !isfinite(h_abs)) {
            fb_leave(c, e, lane, FB_MEMBER_LEFT);
            continue;
        }
        c->active[lane] = -1;
        c->t[lane] = 0.0;
        c->h_abs[lane] = h_abs;
        fb_put_lane(x, lane, N_X, c->x);
        fb_put_lane(b->stages, lane, N_X, c->stages[0]);
        fb_put_lane(s->lane_constants, lane, N_CONSTANTS, s->constants);
#ifndef FB_SPARSE
        double jacobian[FB_AT_LEAST_1(N_JACOBIAN)], bias[FB_AT_LEAST_1(N_C)];
        const double t = fb_time(&c->problem.clock, 0.0);
        fb_fill_inputs(&c->problem, t, x);
        s->kernel->velocity(t, x, s->lane_constants, s->lane_inputs, jacobian, bias);
        fb_put_lane(jacobian, lane, N_JACOBIAN, c->signs.jacobian_before);
        c->signs.signed_pivot[lane] = NAN;
        c->signs.largest_pivot[lane] = 0.0;
        for (int j = 0; j < N_U; ++j)
            c->signs.column_unit[j][lane] = 0.0;
        for (int i = 0; i < N_C; ++i)
            c->signs.row_unit[i][lane] = 0.0;
#endif
        while (c->next_time[lane] < e->n_times && e->times[c->next_time[lane]] == 0.0)
            fb_store(c, e, lane, c->x);
        return;
    }
}

/* Whether det J_d of the last evaluation has another sign than at the beginning of the step, as in
 * kernel/singular_positions.h. In the requested lanes it is kept for the next step. */
static inline fb_mask fb_toggled(fb_lanes *c, const fb_mask asked)
{
    fb_mask changed = asked & 0;
#ifndef FB_SPARSE
    const fb_lane_equations *const s = &c->equations;
    fb_real signed_pivot = fb_number(INFINITY), sign = fb_number(1.0);
    if (N_C == 0 || N_RANK < N_C)
        return changed;
    /* See fb_note_units; only the units of pivots matter here. */
    fb_real units_before[FB_AT_LEAST_1(N_C)], growth = fb_number(1.0);
    for (int k = 0; k < N_C; ++k)
        units_before[k] = c->signs.column_unit[static_pivot_speed[k]] * c->signs.row_unit[static_pivot_row[k]];
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_U; ++j) {
            const fb_real size = fb_greater(fb_abs(s->constraint_jacobian[i * N_U + j]), c->signs.column_unit[j]);
            c->signs.column_unit[j] = fb_select(asked, size, c->signs.column_unit[j]);
        }
    for (int i = 0; i < N_C; ++i)
        for (int j = 0; j < N_U; ++j) {
            /* 0 / 0 is not greater. */
            const fb_real share = fb_abs(s->constraint_jacobian[i * N_U + j]) / c->signs.column_unit[j];
            c->signs.row_unit[i] = fb_select(asked, fb_greater(share, c->signs.row_unit[i]), c->signs.row_unit[i]);
        }
    fb_real pivots[FB_AT_LEAST_1(N_C)];
    fb_pivots_lanes(&s->factors, pivots);
    for (int k = 0; k < N_C; ++k) {
        const fb_real unit = c->signs.column_unit[static_pivot_speed[k]] * c->signs.row_unit[static_pivot_row[k]];
        const fb_real pivot = fb_abs(pivots[k]) / unit;
        growth = fb_greater(unit / units_before[k], growth);
        signed_pivot = fb_select(pivot < signed_pivot, pivot, signed_pivot);
        sign = fb_select(pivots[k] < 0.0, -sign, sign);
    }
    signed_pivot = fb_select(s->factors.good, sign * signed_pivot, fb_number(NAN));
    const fb_real both = signed_pivot * c->signs.signed_pivot;
    changed = asked & (both < 0.0);
    c->signs.largest_pivot =
        fb_select(asked, fb_greater(fb_abs(signed_pivot), c->signs.largest_pivot / growth), c->signs.largest_pivot);
    const fb_mask close = fb_abs(signed_pivot) < FB_NEAR_SINGULAR_RATIO * c->signs.largest_pivot;
    const fb_mask unknown = asked & ((both != both) | close);
    if (fb_any(unknown))
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (unknown[lane]) {
                double now[FB_AT_LEAST_1(N_JACOBIAN)], before[FB_AT_LEAST_1(N_JACOBIAN)];
                fb_units units;
                fb_dense_factors factors;
                fb_take_lane(c->signs.column_unit, lane, N_U, units.column);
                fb_take_lane(c->signs.row_unit, lane, N_C, units.row);
                fb_take_lane(s->constraint_jacobian, lane, N_JACOBIAN, now);
                fb_take_lane(c->signs.jacobian_before, lane, N_JACOBIAN, before);
                if (fb_dense_eliminate(now, &factors) != FB_OK ||
                    fb_signed_pivot(now, &units, factors.column) * fb_signed_pivot(before, &units, factors.column) <
                        0.0 ||
                    fb_is_near_singular(now, &units, c->signs.largest_pivot[lane]))
                    changed[lane] = -1;
            }
    for (int i = 0; i < N_JACOBIAN; ++i)
        c->signs.jacobian_before[i] = fb_select(asked, s->constraint_jacobian[i], c->signs.jacobian_before[i]);
    c->signs.signed_pivot = fb_select(asked, signed_pivot, c->signs.signed_pivot);
#else
    (void)c;
#endif
    return changed;
}

/* The interpolants of the steps in the requested lanes. */
static void fb_lanes_prepare(fb_lanes *restrict c, const fb_ensemble *e, const fb_real h, const fb_real *x_new,
                             const fb_mask asked)
{
    const fb_asked asking = {c, e, asked};
    fb_real scratch[N_X];
    fb_form_interpolant_lanes(&asking, e->method, &c->alone.stepper.weights, N_X, c->stages[0], c->t, h, c->x, x_new,
                              scratch, c->interpolant[0]);
}

/* The samples within the steps from t to t_new that were accepted in the requested lanes, up to the ends of their runs;
 * `prepared` is whether the interpolants are known. */
static inline void fb_lanes_sample(fb_lanes *restrict c, const fb_ensemble *e, const fb_real h, const double *t_new,
                                   const double *until, const fb_real *x_new, const fb_mask asked, int prepared)
{
    const double direction = e->t_bound > 0.0 ? 1.0 : -1.0;
    for (;;) {
        fb_mask within = asked & 0;
        fb_real t = c->t, x[N_X];
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (asked[lane] && c->next_time[lane] < e->n_times) {
                const double sample = e->times[c->next_time[lane]];
                if (direction * (sample - until[lane]) > 0.0)
                    continue;
                if (sample == t_new[lane])
                    fb_store(c, e, lane, x_new);
                else {
                    within[lane] = -1;
                    t[lane] = sample;
                }
            }
        if (!fb_any(within))
            return;
        if (!prepared)
            fb_lanes_prepare(c, e, h, x_new, within);
        prepared = 1; /* also for later rounds, which have fewer lanes */
        fb_interpolate_lanes(e->method, c->interpolant[0], N_X, N_X, c->x, (t - c->t) / h, x);
        if (e->project)
            fb_lanes_project(c, e, t, x, within, 0);
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (within[lane])
                fb_store(c, e, lane, x);
    }
}

/* The ends of the next steps, that of a lane without a run where it is; and the lengths proposed for steps that end
 * with their run, or at a breakpoint. Runs whose steps cannot be taken, or have collapsed, leave their lanes. */
static void fb_lanes_propose(fb_lanes *restrict c, const fb_ensemble *e, double *t_new, double *proposed)
{
    const double direction = e->t_bound > 0.0 ? 1.0 : -1.0;
    for (int lane = 0; lane < FB_WIDTH; ++lane) {
        const double t = c->t[lane];
        t_new[lane] = t;
        proposed[lane] = 0.0;
        if (!c->active[lane])
            continue;
        const double min_step = fb_least_step(t, direction);
        if (!c->rejected[lane])
            c->h_abs[lane] = fb_first_length(c->h_abs[lane], e->max_step, min_step);
        const double share = c->n_steps[lane] > 9 ? c->h_abs[lane] * c->n_steps[lane] / fabs(t) : 1.0;
        /* Also if it is NaN. */
        if (!(c->h_abs[lane] >= min_step) || !isfinite(c->h_abs[lane]) || share < FB_COLLAPSE ||
            (e->max_steps > 0 && c->n_steps[lane] >= e->max_steps)) {
            fb_leave(c, e, lane, FB_MEMBER_LEFT);
            continue;
        }
        t_new[lane] =
            fb_step_end(t, &c->h_abs[lane], direction, c->bound[lane], 0.0, c->rejected[lane], &proposed[lane]);
    }
}

/* The lengths of the next steps, by the errors of these, of which some were taken; returns the lanes that have passed a
 * breakpoint. */
static fb_mask fb_lanes_control(fb_lanes *restrict c, const fb_ensemble *e, const fb_real h, const double *errors,
                                const fb_mask taken, const double *t_new, const double *proposed)
{
    fb_mask passed = taken & 0;
    for (int lane = 0; lane < FB_WIDTH; ++lane) {
        if (!c->active[lane])
            continue;
        /* If a step could not be taken although its error allowed it, the error is unknown. */
        const double error = errors[lane] < 1.0 && !taken[lane] ? NAN : errors[lane];
        c->h_abs[lane] *= fb_change(fb_step_factor(e->method->order, error), taken[lane] != 0, c->rejected[lane]);
        c->rejected[lane] = !taken[lane];
        if (taken[lane]) {
            c->n_steps[lane] += 1;
            c->h_abs[lane] = c->h_abs[lane] > proposed[lane] ? c->h_abs[lane] : proposed[lane];
            if (t_new[lane] == e->t_bound) {
                fb_note_touched(c, e, lane, e->t_bound);
                fb_leave(c, e, lane, FB_MEMBER_DONE);
            } else if (t_new[lane] == c->bound[lane]) {
                c->next_break[lane] += 1;
                c->bound[lane] = fb_lanes_segment(c, e, lane);
                passed[lane] = -1;
            }
            if (N_CONDITIONS > 0 && c->active[lane] &&
                fb_short_steps(&c->lengths[lane], h[lane], c->n_steps[lane], fabs(e->t_bound)) > 0.0)
                fb_leave(c, e, lane, FB_MEMBER_LEFT); /* it may chatter */
        }
    }
    return passed;
}

/* A step in each lane, accepted where its error allows. */
static void fb_lanes_step(fb_lanes *restrict c, const fb_ensemble *e)
{
    const fb_tableau *const m = e->method;
    double t_new[FB_WIDTH], proposed[FB_WIDTH], errors[FB_WIDTH];
    fb_real t_end, x_new[N_X], *const end = c->stages[m->n_stages];
    fb_lanes_propose(c, e, t_new, proposed);
    memcpy(&t_end, t_new, sizeof t_end);
    const fb_real h = t_end - c->t;
    const fb_asked asking = {c, e, c->active};
    fb_take_stages_lanes(&asking, m, &c->alone.stepper.weights, N_X, c->stages[0], c->t, h, c->x, x_new);
    if (!e->project || c->alone.stepper.weights.error[0].stage[c->alone.stepper.weights.error[0].n - 1] == m->n_stages)
        fb_lanes_rates(c, e, t_end, x_new, c->active, end);
    fb_lanes_error(c, e, h, x_new, errors);
    fb_mask taken = c->active;
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        taken[lane] &= errors[lane] < 1.0 ? -1 : 0;
    if (e->project && fb_any(taken)) {
        taken = fb_lanes_project(c, e, t_end, x_new, taken, 1);
        fb_lanes_rates(c, e, t_end, x_new, taken, end);
    }
    for (int i = 0; i < N_X; ++i)
        taken &= end[i] - end[i] == 0.0;
    const fb_mask changed = fb_toggled(c, taken);
    if (fb_any(changed))
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (changed[lane]) {
                fb_leave(c, e, lane, FB_MEMBER_LEFT);
                taken[lane] = 0;
            }
    double until[FB_WIDTH];
    memcpy(until, t_new, sizeof until);
    const int has_events = e->events.n > 0 && fb_any(taken);
    fb_mask ended = taken & 0;
    if (has_events) {
        fb_lanes_prepare(c, e, h, x_new, taken);
        ended = fb_lanes_find_events(c, e, h, t_new, x_new, taken, until);
    }
    fb_lanes_sample(c, e, h, t_new, until, x_new, taken, has_events);
    if (fb_any(ended))
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (ended[lane]) {
                fb_note_touched(c, e, lane, until[lane]);
                fb_leave(c, e, lane, FB_MEMBER_TERMINATED);
                taken[lane] = 0;
            }
    for (int i = 0; i < N_X; ++i) {
        c->x[i] = fb_select(taken, x_new[i], c->x[i]);
        c->stages[0][i] = fb_select(taken, end[i], c->stages[0][i]);
    }
    c->t = fb_select(taken, t_end, c->t);
    const fb_mask passed = fb_lanes_control(c, e, h, errors, taken, t_new, proposed);
    if (fb_any(passed)) { /* see fb_resume */
        fb_real rates[N_X];
        fb_lanes_rates(c, e, c->t, c->x, passed, rates);
        for (int i = 0; i < N_X; ++i)
            c->stages[0][i] = fb_select(passed, rates[i], c->stages[0][i]);
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (passed[lane] && e->events.n > 0) {
                fb_enter_alone(c, e, lane, c->t[lane]);
                fb_take_lane(c->x, lane, N_X, c->alone.stepper.x);
                e->events.begin(&c->alone);
            }
    }
}

static int run(const fb_ensemble *e)
{
    fb_lanes *const c = (fb_lanes *)fb_new_lane_equations(e->kernel, sizeof *c);
    if (c == NULL)
        return -1;
    fb_stepper *const b = &c->alone.stepper;
    const fb_problem problem = {
        .kernel = e->kernel,
        .constants = c->equations.lane_constants,
        .inputs = c->equations.lane_inputs,
        .work = c->equations.work,
        .n_sources = e->n_sources,
        .failed_x = c->lane_failed,
        .moved_x = c->lane_moved,
    };
    c->problem = problem;
    b->problem = &c->problem;
    b->rtol = e->rtol;
    b->atol = e->atol;
    fb_place_stepper(b, &fb_runge_kutta, e->method, N_X, c->rows);
    b->project = e->project;
    c->alone.direction = e->t_bound > 0.0 ? 1.0 : -1.0;
    c->alone.t_end = e->t_bound;
    int status = fb_begin_search(&c->search, e, &c->alone);
    while (status == 0) {
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (!c->active[lane])
                fb_lanes_enter(c, e, lane);
        if (!fb_any(c->active) || __atomic_load_n(e->counters.stop, __ATOMIC_RELAXED) || c->search.failed)
            break;
        fb_lanes_step(c, e);
    }
    fb_end_search(&c->search, e);
    status |= c->search.failed ? -1 : 0;
    fb_free_lane_equations(&c->equations);
    return status;
}
