/* Events of the runs in lanes: functions are evaluated in all lanes at the points of the least degree of a series, by
 * which most steps have no event; the others are searched as those of a run alone.
 */

#include "lanes.h"

/* The weights of an interpolant's coefficients at the points within a step. */
static void fb_place_points(fb_lane_search *search, const fb_tableau *m)
{
    const int n = m->n_dense + (m->hermite ? 3 : 0);
    for (int j = 1; j < FB_LEAST_DEGREE; ++j) {
        double weights[3 + FB_MAX_DENSE];
        for (int k = 0; k < n; ++k) {
            double coefficients[3 + FB_MAX_DENSE] = {0.0};
            const double zero = 0.0;
            coefficients[k] = 1.0;
            fb_interpolate(m, coefficients, 1, 1, &zero, 0.5 * (1.0 + fb_chebyshev_point(FB_LEAST_DEGREE, j)),
                           weights + k);
        }
        fb_weights_of(weights, n, search->within + j);
    }
}

/* Makes room for the events of all lanes, and of a run alone; returns 0, or -1 without memory. */
static int fb_begin_search(fb_lane_search *search, const fb_ensemble *e, fb_run *alone)
{
    const fb_ensemble_events *const events = &e->events;
    const int n = events->n, n_scratch = fb_event_scratch(e->kernel);
    fb_watch *const watch = &alone->watch;
    watch->n_events = n;
    if (n == 0)
        return 0;
    search->in_lanes = 1;
    for (int i = 0; i < n; ++i) {
        const int quantity = events->events[i].quantity;
        search->needs_outputs |= quantity == FB_WATCHED_OUTPUT;
        search->needs_inputs |=
            quantity == FB_WATCHED_INPUT || (quantity == FB_WATCHED_OUTPUT && e->kernel->outputs_need_inputs);
        search->in_lanes &= quantity == FB_WATCHED_TIME || quantity == FB_WATCHED_STATE || quantity == FB_WATCHED_INPUT
#ifdef FB_OUTPUTS_IN_LANES
                            || quantity == FB_WATCHED_OUTPUT
#endif
            ;
    }
    const fb_place places[] = {
        {&search->values, FB_WIDTH * (FB_LEAST_DEGREE + 1) * n},
        {&watch->along, FB_PADDED(N_X)},
    };
    const int n_places = sizeof places / sizeof *places;
    const size_t placed = fb_place_all(places, n_places, NULL), of_alone = fb_place_events(watch, n, n_scratch, NULL);
    search->memory = calloc(placed + of_alone, sizeof(double));
    search->events = calloc((size_t)(FB_WIDTH * n), sizeof *search->events);
    search->found = calloc(1, sizeof *search->found);
    if (search->memory == NULL || search->events == NULL || search->found == NULL)
        return -1;
    fb_place_all(places, n_places, search->memory);
    fb_place_events(watch, n, n_scratch, search->memory + placed);
    fb_place_points(search, e->method);
    return 0;
}

/* Hands over what was found. */
static void fb_end_search(const fb_lane_search *search, const fb_ensemble *e)
{
    free(search->memory);
    free(search->events);
    if (search->found) {
        search->found->next = __atomic_load_n(e->events.found, __ATOMIC_RELAXED);
        while (!__atomic_compare_exchange_n(e->events.found, &search->found->next, search->found, 0, __ATOMIC_RELEASE,
                                            __ATOMIC_RELAXED))
            continue;
    }
}

/* A row for an event at a time since the start of all runs, and a state. */
static void fb_add_found(fb_lane_search *search, const int64_t member, const int event, const double since,
                         const double *x)
{
    fb_found_rows *const found = search->found;
    if (found->n == found->room) {
        const int64_t room = 2 * found->room + 64;
        double *const rows = realloc(found->rows, (size_t)room * (3 + N_X) * sizeof *rows);
        search->failed |= rows == NULL;
        if (rows == NULL)
            return;
        found->rows = rows;
        found->room = room;
    }
    double *const row = found->rows + (3 + N_X) * found->n++;
    row[0] = (double)member;
    row[1] = event;
    row[2] = since;
    memcpy(row + 3, x, N_X * sizeof *x);
}

/* The run alone becomes that in a lane, at a time: its events, inputs and constants. */
static void fb_enter_alone(fb_lanes *c, const fb_ensemble *e, const int lane, const double t)
{
    fb_run *const r = &c->alone;
    r->watch.events = c->search.events + lane * e->events.n;
    r->t_bound = c->bound[lane];
    r->stepper.t = t;
    c->problem.clock = (fb_clock){e->origin, c->clocks.first[lane], c->clocks.last[lane]};
    c->problem.sources = c->sources[lane];
    fb_take_lane(c->equations.constants, lane, N_CONSTANTS, c->equations.lane_constants);
}

/* The outputs and the inputs at times and states of all lanes, where they are needed. */
static void fb_lanes_outputs(fb_lanes *c, const fb_ensemble *e, const fb_real t, const fb_real *x, fb_real *outputs)
{
    fb_lane_equations *const s = &c->equations;
    if (c->search.needs_inputs)
        fb_lanes_inputs(c, e, t);
#ifdef FB_OUTPUTS_IN_LANES
    if (c->search.needs_outputs) {
        fb_real rates[N_X], multipliers[1] = {fb_number(0.0)};
#ifdef FB_OUTPUTS_NEED_SOLUTION
        fb_lane_rates(s, t, x, c->active, rates);
#else
        rates[N_X - 1] = fb_number(0.0);
#endif
        output(t, x, s->constants, s->inputs, rates + N_Q, multipliers, outputs);
    }
#else
    (void)s, (void)x, (void)outputs;
#endif
}

/* The event functions at a fraction of the steps of all lanes: column j of their values; at the end, x is the state. */
static void fb_lanes_event_values(fb_lanes *c, const fb_ensemble *e, const fb_real h, const int j, const fb_real *end)
{
    const double fraction = j == 0                 ? 1.0
                            : j == FB_LEAST_DEGREE ? 0.0
                                                   : 0.5 * (1.0 + fb_chebyshev_point(FB_LEAST_DEGREE, j));
    const fb_real since = c->t + fraction * h;
    const int n = e->events.n;
    fb_real within[N_X], outputs[FB_AT_LEAST_1(N_O)] = {fb_number(0.0)};
    const fb_real *const x = j == 0 ? end : j == FB_LEAST_DEGREE ? c->x : within;
    if (x == within)
        fb_combine_rows_lanes(c->interpolant[0], N_X, c->search.within + j, fb_number(1.0), c->x, within);
    fb_lanes_outputs(c, e, fb_lanes_time(c, e, since), x, outputs);
    for (int i = 0; i < n; ++i) {
        const int quantity = e->events.events[i].quantity, row = e->events.events[i].row;
        const fb_real values = quantity == FB_WATCHED_TIME    ? e->origin + since
                               : quantity == FB_WATCHED_STATE ? x[row]
                               : quantity == FB_WATCHED_INPUT ? c->equations.inputs[row]
                                                              : outputs[row];
        memcpy(c->search.values + (j * n + i) * FB_WIDTH, &values, sizeof values);
    }
}

/* Whether the functions of a lane have no root by their values, as far as these are known. */
static int fb_lane_has_no_events(fb_lanes *c, const fb_ensemble *e, const int lane)
{
    fb_watch *const watch = &c->alone.watch;
    const int n = e->events.n;
    watch->events = c->search.events + lane * n;
    for (int i = 0; i < n; ++i) {
        const double *const values = c->search.values + i * FB_WIDTH + lane;
        watch->values[FB_MOST_DEGREE * n + i] =
            c->search.begins[lane] ? values[FB_LEAST_DEGREE * n * FB_WIDTH] : watch->events[i].value;
        watch->ends[i] = values[0];
        for (int j = 0; j < FB_LEAST_DEGREE; ++j)
            watch->values[j * (FB_MOST_DEGREE / FB_LEAST_DEGREE) * n + i] = values[j * n * FB_WIDTH];
    }
    return e->events.excludes(&c->alone);
}

/* Finds the events of the step in a lane; returns whether one of them ends the run, and when. */
static int fb_find_events_in_lane(fb_lanes *c, const fb_ensemble *e, const int lane, const fb_real h,
                                  const double *t_new, const fb_real *x_new, double *until)
{
    fb_run *const r = &c->alone;
    fb_watch *const watch = &r->watch;
    fb_stepper *const b = &r->stepper;
    watch->is_known = c->search.in_lanes && !c->search.begins[lane] && t_new[lane] != c->bound[lane];
    if (c->search.begins[lane]) {
        fb_enter_alone(c, e, lane, c->t[lane]);
        fb_take_lane(c->x, lane, N_X, b->x);
        e->events.begin(r);
    }
    fb_enter_alone(c, e, lane, t_new[lane]);
    b->t_old = c->t[lane];
    b->h = h[lane];
    fb_take_lane(c->x, lane, N_X, b->x_old);
    fb_take_lane(x_new, lane, N_X, b->x);
    for (int k = 0; k < e->method->n_dense + 3; ++k)
        fb_take_lane(c->interpolant[k], lane, N_X, b->interpolant + k * b->padded);
    b->interpolant_valid = b->fsal = 1;
    watch->searched = 0.0;
    watch->ended_by = -1;
    while (watch->ended_by < 0 && e->events.find(r) > 0)
        for (int k = 0; k < watch->n_found; ++k) {
            const fb_found *const found = watch->found + k;
            const double t = fb_time_of_fraction(b, found->fraction);
            double x[N_X];
            fb_state_of_event(r, found, x);
            fb_add_found(&c->search, c->member[lane], found->event, t, x);
            *until = watch->ended_by >= 0 ? t : *until;
        }
    return watch->ended_by >= 0;
}

/* Finds the events of the steps that were taken; returns the lanes whose runs end, and until when these go. */
static fb_mask fb_lanes_find_events(fb_lanes *c, const fb_ensemble *e, const fb_real h, const double *t_new,
                                    const fb_real *x_new, const fb_mask taken, double *until)
{
    fb_mask ended = taken & 0;
    int last = FB_LEAST_DEGREE - 1; /* the beginning is the end of the step before */
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        last += taken[lane] && c->search.begins[lane] && last < FB_LEAST_DEGREE;
    for (int j = 0; j <= last && c->search.in_lanes; ++j)
        fb_lanes_event_values(c, e, h, j, x_new);
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        if (taken[lane]) {
            if (!(c->search.in_lanes && fb_lane_has_no_events(c, e, lane)))
                ended[lane] = fb_find_events_in_lane(c, e, lane, h, t_new, x_new, until + lane) ? -1 : 0;
            c->search.begins[lane] = 0;
        }
    return ended;
}

/* The functions of a lane that were zero without a change of sign in its run, which ends at a time. */
static void fb_note_touched(fb_lanes *c, const fb_ensemble *e, const int lane, const double until)
{
    for (int i = 0; i < e->events.n; ++i) {
        const double touched = c->search.events[lane * e->events.n + i].touched;
        if (c->alone.direction * (until - touched) >= 0.0)
            fb_add_found(&c->search, c->member[lane], -1 - i, touched, c->equations.lane_x);
    }
}
