/* Events: all changes of sign of functions along a step.
 *
 * A function is evaluated at states of the step's interpolant, at the points of a Chebyshev series whose degree is
 * doubled until it is known. Where the series changes its sign, a root of the function itself is solved for, at states
 * that satisfy the constraints.
 *
 * At both ends of a segment rounding errors may put a function on either side of zero. A value that may consist of them
 * counts as zero, and zero has no sign: an event is a change between two signs.
 */
#ifndef FOURBAR_EVENTS_H
#define FOURBAR_EVENTS_H

#include "roots.h"
#include "run.h"

/* A series is known if its last two coefficients are below this fraction of its values. Before that, roots are excluded
 * if so many times these coefficients do not suffice for one, and a second root if that many of the next number do not
 * for a zero of the slope. */
#define FB_SERIES_RTOL 1e-13
#define FB_SERIES_MARGIN 100.0
#define FB_SLOPE_MARGIN 300.0

/* Rounding errors, relative to a function's terms or to times; and the relative change of t and x by which the size of
 * these terms is found. */
#define FB_ROUNDING_RTOL (64.0 * DBL_EPSILON)
#define FB_TERM_CHANGE 1e-6

/* Values above this may have series that are not finite. */
#define FB_LARGEST_VALUE 1e300

/* A bracket of a root is this part of a step at most, for a line between its ends. */
#define FB_ROOT_ATOL 1e-12

/* Where a function touches zero, it is smaller by this factor than at this distance, for a part of length 2. */
#define FB_BESIDE 1e-3

/* A part of a step in which a function has no series is halved if it is longer than this fraction of the step;
 * otherwise the signs at its points decide. */
#define FB_LEAST_PART (1.0 / 1024.0)

/* A function that is zero at the end of a part, y = 1, and before this place, stays zero. */
#define FB_BEFORE_END (1.0 - 1e-6)

/* A jump of a function at a discontinuity is larger than this fraction of its change over the step before. */
#define FB_CONTINUOUS_RTOL 1e-9

/* Which event functions are evaluated: one by its number, those with all roots, or all. */
enum { FB_ALL_EVENTS = -1, FB_ALL_ROOTS = -2 };

static inline int fb_is_asked(const fb_event *e, const int i, const int which)
{
    return which == FB_ALL_EVENTS || which == i || (which == FB_ALL_ROOTS && e->all_roots);
}

/* The values of event functions at a time and state. */
static inline int fb_event_values(fb_run *r, const double since, const double *x, const int which, double *values)
{
    fb_problem *const p = r->stepper.problem;
    const fb_watch *const watch = &r->watch;
    const fb_kernel *const k = p->kernel;
    double *const accelerations = watch->scratch, *const multipliers = accelerations + k->n_u;
    double *outputs = multipliers + k->n_l, *const energies = outputs + k->n_o, *const momenta = energies + 3;
    double *const found[] = {momenta, momenta + 3, momenta + 6};
    const double t = fb_time(&p->clock, since);
    unsigned needs = 0;
    for (int i = 0; i < watch->n_events; ++i)
        if (fb_is_asked(watch->events + i, i, which))
            needs |= 1U << watch->events[i].quantity;
    /* States need no inputs, and callables have their own. */
    const unsigned without_inputs = 1U << FB_WATCHED_TIME | 1U << FB_WATCHED_STATE | 1U << FB_WATCHED_CALLABLE |
                                    (k->outputs_need_inputs ? 0U : 1U << FB_WATCHED_OUTPUT);
    const int called = needs & ~without_inputs ? fb_fill_inputs(p, t, x) : 0;
    if (called < 0)
        return called;
    if (needs & (1U << FB_WATCHED_MULTIPLIER) || (needs & (1U << FB_WATCHED_OUTPUT) && k->outputs_need_solution))
        k->accelerations(t, x, p->constants, p->inputs, accelerations, multipliers, p->work);
    if (needs & 1U << FB_WATCHED_OUTPUT)
        fb_problem_results(p, FB_OUTPUT, t, x, accelerations, multipliers, NULL, &outputs);
    if (needs & 1U << FB_WATCHED_ENERGY) {
        fb_problem_results(p, FB_ENERGY, t, x, NULL, NULL, NULL, (double *const[]){energies});
        energies[2] = energies[0] + energies[1];
    }
    if (needs & 1U << FB_WATCHED_MOMENTUM)
        fb_problem_results(p, FB_MOMENTA, t, x, NULL, NULL, NULL, found);
    const double time = p->clock.origin + since;
    const double *const quantities[] = {&time, x, p->inputs, outputs, multipliers, energies, momenta};
    for (int i = 0; i < watch->n_events; ++i) {
        const fb_event *const e = watch->events + i;
        if (!fb_is_asked(e, i, which))
            continue;
        if (e->quantity != FB_WATCHED_CALLABLE)
            values[i] = quantities[e->quantity][e->row];
        else {
            const int status = watch->call(watch->caller, e->row, since, x, values + i);
            if (status < 0)
                return status;
        }
    }
    return 0;
}

/* The functions at the state reached, at the beginning or the end of a segment; a value that may be a rounding error
 * becomes zero. The changes of values by the tolerances of the state are stored, too. */
static inline int fb_event_values_at_end(fb_run *r, const int is_begin, double *values, double *tolerances)
{
    fb_watch *const watch = &r->watch;
    fb_stepper *const s = &r->stepper;
    const int n = watch->n_events;
    double *const there = watch->values + n, *const size = there + n, *const x = watch->along;
    int status = fb_event_values(r, s->t, s->x, FB_ALL_EVENTS, values);
    for (int i = 0; i < n; ++i)
        size[i] = tolerances[i] = 0.0;
    for (int j = -1; j < s->n && status >= 0; ++j) { /* t, then the state */
        const double now = fabs(j < 0 ? s->problem->clock.origin + s->t : s->x[j]);
        const double term = j < 0 || is_begin ? now : fmax(now, fabs(s->x_old[j])); /* its error is that of the step */
        const double tolerance = j < 0 || !s->atol ? 0.0 : s->atol[j] + s->rtol[j] * term;
        double t = s->t, change = FB_TERM_CHANGE * (term + tolerance);
        if (j < 0 && !is_begin) /* within the step, but by more than rounding errors */
            change = fmin(change, fmax(FB_TERM_CHANGE * fabs(s->h), FB_ROUNDING_RTOL * term));
        if (!(change > 0.0))
            continue;
        memcpy(x, s->x, (size_t)s->n * sizeof *x);
        *(j < 0 ? &t : x + j) += is_begin ? r->direction * change : -r->direction * change;
        watch->probes = 1;
        status = fb_event_values(r, t, x, FB_ALL_EVENTS, there);
        watch->probes = 0;
        for (int i = 0; i < n; ++i) {
            const double slope = fabs(there[i] - values[i]) / change;
            if (slope < INFINITY) {
                size[i] += slope * term;
                tolerances[i] += slope * tolerance;
            }
        }
    }
    for (int i = 0; i < n; ++i)
        if (fabs(values[i]) <= FB_ROUNDING_RTOL * size[i])
            values[i] = 0.0;
    return status;
}

/* Evaluates the functions where a run begins or goes on. */
static inline int fb_begin_events(fb_run *r)
{
    fb_watch *const watch = &r->watch;
    double *const begin = watch->ends, *const tolerances = watch->polished;
    if (watch->n_events == 0)
        return 0;
    const int status = fb_event_values_at_end(r, 1, begin, tolerances);
    if (status < 0)
        return status;
    for (int i = 0; i < watch->n_events; ++i) {
        fb_event *const e = watch->events + i;
        e->jumps = e->sign != 0 && !(fabs(begin[i] - e->value) <= FB_CONTINUOUS_RTOL * e->change);
        e->value = fabs(begin[i]) <= FB_ROUNDING_RTOL * e->change ? 0.0 : begin[i];
        e->begins = e->sign == 0 && !e->at_start;
        e->left = e->begins && e->value == 0.0 ? tolerances[i] : 0.0;
        e->mismatch = 0.0;
    }
    return 0;
}

/* A part of the last step, from one fraction of it to another. */
typedef struct fb_part_of_step {
    fb_run *run;
    double begin, end;
    int event;
} fb_part_of_step;

/* A fraction of the step, for -1 <= y <= 1. */
static inline double fb_fraction(const fb_part_of_step *part, const double y)
{
    return part->begin + 0.5 * (1.0 + y) * (part->end - part->begin);
}

/* The value of the part's event function where the constraints are satisfied; an fb_root_function. */
static inline int fb_value_in_part(void *of, const double y, double *value)
{
    const fb_part_of_step *const part = of;
    fb_watch *const watch = &part->run->watch;
    fb_stepper *const s = &part->run->stepper;
    const double fraction = fb_fraction(part, y);
    if (fraction == 0.0 || fraction == 1.0) {
        *value = fraction == 0.0 ? watch->events[part->event].value : watch->ends[part->event];
        return 0;
    }
    const double t = fb_time_of_fraction(s, fraction);
    watch->closed_at = NAN;
    int status = fb_state_at(s, t, watch->along);
    if (status < 0)
        return status;
    watch->closed_at = fraction;
    status = fb_event_values(part->run, t, watch->along, part->event, watch->polished);
    *value = watch->polished[part->event];
    return status;
}

/* The rounding errors of places in a part, -1 <= y <= 1, by those of times. */
static inline double fb_rounding_of_places(const fb_part_of_step *part)
{
    const fb_stepper *const s = &part->run->stepper;
    return 2.0 * DBL_EPSILON * fabs((s->problem->clock.origin + s->t) / ((part->end - part->begin) * s->h));
}

/* The series of an event function in a part by its points for degree n: returns n, or 0 for a function without roots,
 * or -1 if it is not known. */
static inline int fb_series_of(const fb_part_of_step *part, const int i, const int n, fb_series *series)
{
    const fb_run *const r = part->run;
    const fb_watch *const watch = &r->watch;
    const int quantity = watch->events[i].quantity;
    double values[FB_MOST_DEGREE + 1], slope[FB_MOST_DEGREE + 1], largest = 0.0;
    for (int j = 0; j <= n; ++j) {
        values[j] = watch->values[j * (FB_MOST_DEGREE / n) * watch->n_events + i];
        largest = fabs(values[j]) > largest ? fabs(values[j]) : largest; /* fmax takes longer than the rest */
    }
    if (!(largest <= FB_LARGEST_VALUE))
        return -1;
    fb_chebyshev_fit(n, values, series->c);
    /* Times and states are polynomials of degree 7 at most, besides those of methods with a step control of their own.
     */
    const int is_known = (quantity == FB_WATCHED_TIME || quantity == FB_WATCHED_STATE) && !r->stepper.method->advance;
    const double last = (is_known ? 0.0 : fabs(series->c[n - 1])) + fabs(series->c[n]);
    if (fabs(series->c[0]) > fb_chebyshev_range(n, series->c) + FB_SERIES_MARGIN * last)
        return 0;
    fb_chebyshev_slope(n, series->c, slope);
    const double range = fb_chebyshev_range(n - 1, slope), steepest = fabs(slope[0]) + range;
    series->n = n;
    series->error = last + FB_ROUNDING_RTOL * largest + fb_rounding_of_places(part) * steepest;
    if (last <= FB_SERIES_RTOL * largest)
        return n;
    /* Where a slope that is known well enough keeps its sign, there is one root at most: T_k' is k^2 at most. */
    return fabs(slope[0]) > range + 4.0 * n * n * FB_SLOPE_MARGIN * last ? n : -1;
}

/* Whether the interpolant differs from the states at the ends of the step: that of a method with a step control of its
 * own, and that of states before a projection. */
static inline int fb_interpolant_jumps(const fb_stepper *s)
{
    return s->method->advance != NULL || (s->project && !s->method->projects && !s->tableau->hermite);
}

/* The state of the interpolant at a time, in `along`. */
static inline int fb_interpolate_along(fb_run *r, const double t)
{
    r->watch.closed_at = NAN;
    return r->stepper.method->interpolate(&r->stepper, t, r->watch.along);
}

/* The functions along the interpolant at both ends of a part, as values of their series, if these differ from those of
 * the states there; by how much is stored. */
static inline int fb_values_of_interpolant(const fb_part_of_step *part, double *first, double *last)
{
    fb_run *const r = part->run;
    fb_watch *const watch = &r->watch;
    fb_stepper *const s = &r->stepper;
    for (int end = 0; end < 2; ++end) {
        double *const values = end ? last : first;
        if (!(end ? part->end == 1.0 : part->begin == 0.0))
            continue;
        const double t = end ? s->t : s->t_old;
        int status = fb_interpolate_along(r, t);
        if (status >= 0)
            status = fb_event_values(r, t, watch->along, FB_ALL_ROOTS, values);
        if (status < 0)
            return status;
        for (int i = 0; i < watch->n_events; ++i) {
            fb_event *const e = watch->events + i;
            if (e->all_roots)
                e->mismatch = fmax(e->mismatch, fabs(values[i] - (end ? watch->ends[i] : e->value)));
        }
    }
    return 0;
}

/* Evaluates the functions at the points of a part until their series are known; returns whether that is so. */
static inline int fb_know_part(const fb_part_of_step *part)
{
    fb_run *const r = part->run;
    fb_watch *const watch = &r->watch;
    fb_stepper *const s = &r->stepper;
    const int n_events = watch->n_events;
    fb_series series;
    double *const first = watch->values + FB_MOST_DEGREE * n_events, *const last = watch->values;
    const int is_whole = part->begin == 0.0 && part->end == 1.0;
    int open = 0, status = 0;
    for (int i = 0; i < n_events; ++i) {
        watch->events[i].degree = watch->events[i].all_roots ? -1 : 0;
        open += watch->events[i].all_roots;
        first[i] = watch->events[i].value;
        last[i] = watch->ends[i];
    }
    if (open > 0 && fb_interpolant_jumps(s))
        status = fb_values_of_interpolant(part, first, last);
    for (int n = FB_LEAST_DEGREE; n <= FB_MOST_DEGREE && open > 0 && status >= 0; n *= 2) {
        /* Points with an even number are those of half the degree; the last one is the beginning. */
        const int is_first = n == FB_LEAST_DEGREE, is_known = is_first && is_whole && watch->is_known;
        for (int j = is_first && part->end < 1.0 ? 0 : 1; j < n && !is_known; j += is_first ? 1 : 2) {
            const double t = fb_time_of_fraction(s, fb_fraction(part, fb_chebyshev_point(n, j)));
            status = fb_interpolate_along(r, t);
            if (status >= 0)
                status = fb_event_values(r, t, watch->along, j == 0 ? FB_ALL_EVENTS : FB_ALL_ROOTS,
                                         watch->values + j * (FB_MOST_DEGREE / n) * n_events);
            if (status < 0)
                return status;
        }
        for (int i = 0; i < n_events; ++i)
            if (watch->events[i].degree < 0) {
                watch->events[i].degree = fb_series_of(part, i, n, &series);
                open -= watch->events[i].degree >= 0;
            }
    }
    return status < 0 ? status : open == 0;
}

/* The root of the part's event function near that of its series, where its values at both ends of the crossing have
 * different signs: by the slope of the series, then by a secant, whose change is doubled so that it passes the root.
 * Returns 0 if it does not. */
static inline int fb_solve_near_series(fb_part_of_step *part, const fb_crossing *crossing, fb_series *series,
                                       const double at_a, double *root)
{
    const double a = crossing->low, b = crossing->high;
    const double near_a = fb_chebyshev_value(series->n, series->c, a);
    const double near_b = fb_chebyshev_value(series->n, series->c, b);
    const double least = 4.0 * (DBL_EPSILON + fb_rounding_of_places(part));
    double slope[FB_MOST_DEGREE + 1], old = a, at_old, at = 0.0, at_far;
    if (!fb_is_bracket(near_a, near_b))
        return 0;
    fb_solve_bracketed(fb_value_of_series, series, a, near_a, b, near_b, &old);
    int status = fb_value_in_part(part, old, &at_old);
    fb_chebyshev_slope(series->n, series->c, slope);
    const double y = old - at_old / fb_chebyshev_value(series->n - 1, slope, old);
    if (status < 0 || !(y >= a && y <= b))
        return status < 0 ? status : 0;
    status = fb_value_in_part(part, y, &at);
    *root = y;
    const double change = fabs(at * (y - old) / (at - at_old)); /* NaN where the function does not change */
    if (status < 0 || at == 0.0 || change <= least)
        return status < 0 ? status : 1;
    const double length = change > least ? 2.0 * change : least;
    const double far = (at > 0.0) == (at_a > 0.0) ? fmin(y + length, b) : fmax(y - length, a);
    status = fb_value_in_part(part, far, &at_far);
    if (status < 0 || !fb_is_bracket(at, at_far))
        return status < 0 ? status : 0;
    if (length > fmax(FB_ROOT_ATOL, least))
        status = fb_solve_bracketed(fb_value_in_part, part, y, at, far, at_far, root);
    else
        *root = y + (far - y) * (at / (at - at_far));
    return status < 0 ? status : 1;
}

/* A root of the part's event function where it crosses zero by its series, or by its values at points. Returns 0 if it
 * has the same sign at both ends of the crossing. */
static inline int fb_solve_for_root(fb_part_of_step *part, const fb_crossing *crossing, fb_series *series, double *root)
{
    const double a = crossing->low, b = crossing->high;
    double at_a, at_b;
    *root = a;
    if (a == b)
        return 1;
    int status = fb_value_in_part(part, a, &at_a);
    if (status < 0 || at_a == 0.0)
        return status < 0 ? status : 1;
    status = fb_value_in_part(part, b, &at_b);
    if (status < 0 || !fb_is_bracket(at_a, at_b))
        return status < 0 ? status : 0;
    status = series ? fb_solve_near_series(part, crossing, series, at_a, root) : 0;
    if (status == 0)
        status = fb_solve_bracketed(fb_value_in_part, part, a, at_a, b, at_b, root);
    return status < 0 ? status : 1;
}

/* Whether a function touches zero at a place where its series does: its value is small beside those next to it. */
static inline int fb_touches_zero(fb_part_of_step *part, const double y)
{
    double at, beside;
    int status = fb_value_in_part(part, y, &at);
    for (int side = -1; side <= 1 && status >= 0; side += 2) {
        const double there = y + side * FB_BESIDE;
        if (fabs(there) > 1.0)
            continue;
        status = fb_value_in_part(part, there, &beside);
        if (status >= 0 && !(fabs(at) <= FB_BESIDE * fabs(beside)))
            return 0;
    }
    return status < 0 ? status : 1;
}

/* Stores an event, in the order of times. */
static inline void fb_add_event(fb_watch *watch, const fb_found found)
{
    int place = watch->n_found++;
    for (; place > 0 && watch->found[place - 1].fraction > found.fraction; --place)
        watch->found[place] = watch->found[place - 1];
    watch->found[place] = found;
}

/* Where the part's event function, whose value at the end is zero, loses its sign, after a place where it has it. */
static inline int fb_find_zero(fb_part_of_step *part, double low, const int sign, double *root)
{
    *root = 1.0;
    for (int i = 0; i < FB_MOST_HALVINGS; ++i) {
        const double middle = 0.5 * (low + *root);
        double value;
        const int status = fb_value_in_part(part, middle, &value);
        if (status < 0)
            return status;
        *(value * sign > 0.0 ? &low : root) = middle;
    }
    return 0;
}

/* Whether a place in the first step is the start of the run, to within rounding errors of its times. */
static inline int fb_is_at_start(const fb_run *r, const double fraction)
{
    const double origin = r->stepper.problem->clock.origin;
    const double latest = fmax(fabs(origin + r->stepper.t_old), fabs(origin + r->t_bound));
    return fabs(fraction * r->stepper.h) <= FB_ROUNDING_RTOL * latest;
}

/* Zero at the end of a part is an event at the end of the run, and where the function stays zero. */
static inline int fb_find_last_zero(fb_part_of_step *part, fb_walk *walk)
{
    fb_run *const r = part->run;
    const fb_event *const e = r->watch.events + part->event;
    double root;
    if (walk->sign == 0)
        return 0;
    const int status = fb_find_zero(part, walk->from, walk->sign, &root);
    const int is_end = part->end == 1.0 && r->stepper.t == r->t_end;
    if (status < 0 || !(is_end || root < FB_BEFORE_END))
        return status;
    if (e->direction * walk->sign <= 0)
        fb_add_event(&r->watch, (fb_found){part->event, 0, fb_fraction(part, root)});
    walk->sign = 0;
    return 0;
}

/* Finds the events of one function in a part whose series are known. */
static inline int fb_find_events_of(fb_part_of_step *part)
{
    fb_run *const r = part->run;
    fb_watch *const watch = &r->watch;
    fb_event *const e = watch->events + part->event;
    const double end = part->end == 1.0 ? watch->ends[part->event] : watch->values[part->event];
    fb_series series;
    fb_walk walk;
    fb_begin_walk(&walk, e->sign, e->at_start, fmax(e->left, e->mismatch));
    fb_walk_to(&walk, -1.0, e->value, 0.0);
    if (e->degree > 0) {
        fb_series_of(part, part->event, e->degree, &series);
        fb_walk_along(&walk, &series);
    }
    for (int j = FB_MOST_DEGREE - 1; e->degree < 0 && j > 0; --j)
        fb_walk_to(&walk, fb_cosines[j], watch->values[j * watch->n_events + part->event], 0.0);
    fb_walk_to(&walk, 1.0, end, 0.0);
    for (int k = 0; k < walk.n; ++k) {
        fb_crossing *const crossing = walk.found + k;
        fb_series *const known = e->degree > 0 ? &series : NULL;
        double root;
        if (e->direction * crossing->sign < 0)
            continue;
        int status = fb_solve_for_root(part, crossing, known, &root);
        if (status == 0 && walk.n == 1) { /* the signs at the ends of the part decide */
            *crossing = (fb_crossing){-1.0, 1.0, crossing->sign};
            status = fb_solve_for_root(part, crossing, known, &root);
        }
        if (status < 0)
            return status;
        if (status == 0)
            continue;
        if (k == 0 && e->begins && fb_is_at_start(r, fb_fraction(part, root)))
            continue;
        const int jumps = crossing->low == crossing->high && e->jumps;
        fb_add_event(watch, (fb_found){part->event, jumps, fb_fraction(part, root)});
    }
    if (end == 0.0) {
        const int status = fb_find_last_zero(part, &walk);
        if (status < 0)
            return status;
    }
    if (walk.sign != 0)
        e->left = 0.0;
    e->at_start &= walk.sign == 0;
    e->begins = 0;
    const int touches = walk.touched == walk.touched ? fb_touches_zero(part, walk.touched) : 0;
    if (touches < 0)
        return touches;
    if (touches)
        e->touched = fb_time_of_fraction(&r->stepper, fb_fraction(part, walk.touched));
    e->change = isfinite(end - e->value) ? fabs(end - e->value) : 0.0;
    e->sign = walk.sign;
    e->value = end;
    return 0;
}

/* Finds events in the rest of the last step, in the order of times, up to one that ends the run; returns their number.
 * If there are any, a part of the step may still be left. */
static inline int fb_find_events(fb_run *r)
{
    fb_watch *const watch = &r->watch;
    fb_stepper *const s = &r->stepper;
    watch->n_found = 0;
    watch->closed_at = NAN;
    int status = 0;
    if (watch->searched == 0.0) {
        if (!watch->is_known)
            status = s->t == r->t_bound ? fb_event_values_at_end(r, 0, watch->ends, watch->polished)
                                        : fb_event_values(r, s->t, s->x, FB_ALL_EVENTS, watch->ends);
        for (int i = 0; i < watch->n_events; ++i)
            watch->events[i].mismatch = 0.0;
    }
    while (status >= 0 && watch->searched < 1.0 && watch->n_found == 0) {
        /* a part that is next to a short one may be longer */
        const double length = watch->searched > 0.0 ? 2.0 * watch->length : 1.0;
        fb_part_of_step part = {r, watch->searched, fmin(watch->searched + length, 1.0), 0};
        for (;;) {
            status = fb_know_part(&part);
            if (status != 0 || part.end - part.begin <= FB_LEAST_PART)
                break;
            part.end = 0.5 * (part.begin + part.end);
        }
        for (; status >= 0 && part.event < watch->n_events; ++part.event)
            status = fb_find_events_of(&part);
        watch->length = part.end - part.begin;
        watch->searched = part.end;
    }
    if (status < 0)
        return status;
    for (int k = 0; k < watch->n_found; ++k) {
        fb_event *const e = watch->events + watch->found[k].event;
        e->n_found += 1;
        if (e->terminal > 0 && e->n_found >= e->terminal) {
            watch->n_found = k + 1;
            watch->ended_by = watch->found[k].event;
            watch->searched = 1.0;
        }
    }
    return watch->n_found;
}

/* Whether no function changes its sign in the last step, by its values at the points of the least degree; then the step
 * counts as searched. A value at an end that may consist of rounding errors does not exclude a root. */
static inline int fb_excludes_events(fb_run *r)
{
    const fb_watch *const watch = &r->watch;
    const double *const begin = watch->values + FB_MOST_DEGREE * watch->n_events;
    const fb_part_of_step whole = {r, 0.0, 1.0, 0};
    fb_series series;
    for (int i = 0; i < watch->n_events; ++i) {
        const fb_event *const e = watch->events + i;
        const int sign = e->sign != 0 ? e->sign : (begin[i] > 0.0) - (begin[i] < 0.0);
        if (e->left > 0.0 || !(begin[i] * sign > 0.0 && watch->ends[i] * sign > 0.0) ||
            fb_series_of(&whole, i, FB_LEAST_DEGREE, &series) != 0)
            return 0;
    }
    for (int i = 0; i < watch->n_events; ++i) {
        fb_event *const e = watch->events + i;
        e->sign = watch->ends[i] > 0.0 ? 1 : -1;
        e->at_start = e->begins = 0;
        e->change = fabs(watch->ends[i] - begin[i]);
        e->value = watch->ends[i];
    }
    return 1;
}

/* Drops the events found last that are after a time; returns the number of those that are left. */
static inline int fb_forget_events(fb_run *r, const double t)
{
    fb_watch *const watch = &r->watch;
    for (; watch->n_found > 0; --watch->n_found) {
        const double last = fb_time_of_fraction(&r->stepper, watch->found[watch->n_found - 1].fraction);
        if (r->direction * (last - t) <= 0.0)
            break;
        watch->ended_by = -1;
    }
    return watch->n_found;
}

#endif
