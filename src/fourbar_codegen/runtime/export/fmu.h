/* What FMUs of both versions of FMI have in common: an instance around a mechanism, its modes, and its variables.
 *
 * Included by export/fmi2.h or export/fmi3.h, in a source that includes the header of the model as a C library, and
 * defines FB_MODEL, fmu_token, fmu_method, FMU_IS_STIFF, fmu_has_rates, what results an FMU has: FMU_N_RESULTS, in
 * groups that are evaluated at once by fmu_fill, and end before the numbers in fmu_ends; and its events: FMU_N_EVENTS,
 * fmu_events, and fmu_indicators, their value references. Value references are numbers in this order: time, states,
 * their derivatives, parameters, inputs, results.
 *
 * Source: Modelica Association, Functional Mock-up Interface, versions 2.0.5 and 3.0.2, https://fmi-standard.org.
 */
#ifndef FOURBAR_FMU_H
#define FOURBAR_FMU_H

#include <math.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "public_names.h"

enum {
    N_X = FB_PUBLIC(n_x),
    N_P = FB_PUBLIC(n_p),
    N_R = FB_PUBLIC(n_r),
    OF_STATES = 1,
    OF_RATES = OF_STATES + N_X,
    OF_PARAMETERS = OF_RATES + N_X,
    OF_INPUTS = OF_PARAMETERS + N_P,
    OF_RESULTS = OF_INPUTS + N_R,
    N_VARIABLES = OF_RESULTS + FMU_N_RESULTS
};

/* The tolerance of co-simulation unless the importer states one; and the violation of the constraints, relative to
 * their terms, from which on model exchange asks for a projection. If the importer states a tolerance, it is that: an
 * integrator begins anew after a projection, so that a smaller violation than its own errors would cost accuracy. */
#define FB_FMU_RTOL 1e-6
#define FB_FMU_VIOLATION_RTOL 1e-9

/* The most events of a communication step that are stored at once; and the relative difference of times that are equal
 * but for rounding errors. */
enum { FMU_ROOM = 16 };
#define FMU_SAME_RTOL 1e-10

/* Where an event indicator is below this fraction of its largest value, an importer has found its root. */
#define FMU_ROOT_RTOL 1e-9

/* How serialized states begin; the number changes with their contents. */
#define FMU_KIND "fourbar state 2"
#define FMU_AT_LEAST_1(n) ((n) > 0 ? (n) : 1)

/* The interval of `between`, in export/c_library.h. */
void FB_PUBLIC(get_interval)(const struct FB_MODEL *model, double *interval);
void FB_PUBLIC(set_interval)(struct FB_MODEL *model, const double *interval);

enum fmu_mode {
    FMU_INSTANTIATED = 1,
    FMU_INITIALIZATION = 2,
    FMU_EVENT = 4,
    FMU_CONTINUOUS = 8,
    FMU_STEP = 16,
    FMU_TERMINATED = 32,
    FMU_INITIALIZED = FMU_EVENT | FMU_CONTINUOUS | FMU_STEP
};

/* What was seen of an event indicator. */
typedef struct fmu_indicator {
    double largest;        /* its largest value */
    int32_t sign, at_zero; /* its last sign, 0 before the first; whether that is the next one, at a root */
    int64_t count;         /* of events */
} fmu_indicator;

/* All that a saved state contains. */
typedef struct fmu_state {
    struct FB_MODEL model;
    int is_cosimulation;
    int mode;
    int is_open;       /* whether loops are to be closed from the start values, as during initialization */
    double given[N_X]; /* these: independent values and guesses */
    double tolerance, start, stop;
    int valid; /* whether the rates are those of the present state, in bit 0; each group of results, in the next ones */
    double rates[N_X], results[FMU_N_RESULTS];
    fmu_indicator indicators[FMU_AT_LEAST_1(FMU_N_EVENTS)];
    int is_over; /* whether a terminal event has occurred */
} fmu_state;

typedef struct fmu {
    fmu_state state;
    int logs, returns_early; /* whether steps of co-simulation may end at events */
    double work[FMU_AT_LEAST_1(FMU_N_EVENTS) * FB_PUBLIC(event_work)];
    double stiff_work[FMU_IS_STIFF ? FB_PUBLIC(stiff_work) : 1];
    char *name;
    void *environment;
    void (*write)(struct fmu *fmu, int is_error, const char *text);
    void (*callback)(void);
} fmu;

/* Reports a mistake or failure to the importer; 0, so that callers can return it. */
static int fmu_fail(fmu *f, const char *format, ...)
{
    char text[512];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof text, format, arguments);
    va_end(arguments);
    if (f->write)
        f->write(f, 1, text);
    return 0;
}

/* What this FMU does not have, as its description says. */
static int fmu_lacks(fmu *f, const char *what)
{
    return f != NULL && fmu_fail(f, "This FMU does not have %s.", what);
}

/* All variables are real: there are none of other types, unless none is asked for. */
static int fmu_lacks_type(fmu *f, const size_t n, const char *type)
{
    return f != NULL && (n == 0 || fmu_fail(f, "There are no variables of the type %s.", type));
}

/* Whether a function may be called now. */
static int fmu_may(fmu *f, const char *function, const int modes)
{
    static const char *const names[] = {"instantiated",         "initialization mode", "event mode",
                                        "continuous-time mode", "step mode",           "terminated"};
    if (f == NULL)
        return 0;
    if (f->state.mode & modes)
        return 1;
    int number = 0;
    while (number < 5 && !(f->state.mode & (1 << number)))
        ++number;
    return fmu_fail(f, "%s must not be called here: the mechanism is in the state \"%s\".", function, names[number]);
}

static fmu *fmu_new(const char *name, const char *token, const int is_cosimulation)
{
    if (token == NULL || strcmp(token, fmu_token) != 0)
        return NULL; /* binary and description are of different models */
    fmu *const f = calloc(1, sizeof *f);
    const size_t length = name ? strlen(name) : 0;
    if (f == NULL)
        return NULL;
    f->name = malloc(length + 1);
    if (f->name == NULL) {
        free(f);
        return NULL;
    }
    memcpy(f->name, name ? name : "", length);
    f->name[length] = '\0';
    f->state.is_cosimulation = is_cosimulation;
    return f;
}

static void fmu_reset(fmu *f)
{
    const int is_cosimulation = f->state.is_cosimulation;
    memset(&f->state, 0, sizeof f->state);
    f->state.is_cosimulation = is_cosimulation;
    FB_PUBLIC(init)(&f->state.model);
    f->state.model.method = fmu_method;
    memcpy(f->state.given, f->state.model.x, sizeof f->state.given);
    f->state.stop = INFINITY;
    for (int k = 0; k < N_R; ++k) /* inputs without an expression start at 0, as the description says */
        if (f->state.model.r[k] != f->state.model.r[k])
            f->state.model.r[k] = 0.0;
    f->state.mode = FMU_INSTANTIATED;
    f->state.is_open = 1;
    f->state.tolerance = is_cosimulation ? FB_FMU_RTOL : FB_FMU_VIOLATION_RTOL;
}

static void fmu_free(fmu *f)
{
    if (f)
        free(f->name);
    free(f);
}

/* Reports a status of the mechanism; whether it is success. */
static int fmu_check(fmu *f, const int status)
{
    const struct FB_MODEL *const m = &f->state.model;
    return status == 0 || fmu_fail(f, "At t = %.9g: %s.", m->t, FB_PUBLIC(message)(status));
}

/* Closes the loops, during initialization after each change. */
static int fmu_close(fmu *f)
{
    if (f->state.is_open) {
        memcpy(f->state.model.x, f->state.given, sizeof f->state.given);
        if (!fmu_check(f, FB_PUBLIC(update)(&f->state.model)) || !fmu_check(f, FB_PUBLIC(close)(&f->state.model)))
            return 0;
        f->state.is_open = 0;
    }
    return 1;
}

/* Evaluates the derivatives of the states. */
static int fmu_evaluate_rates(fmu *f)
{
    fmu_state *const s = &f->state;
    struct FB_MODEL *const m = &s->model;
    if (!fmu_close(f))
        return 0;
    if (!(s->valid & 1) && !fmu_check(f, FB_PUBLIC(rhs)(m, m->t, m->x, s->rates)))
        return 0;
    s->valid |= 1;
    return 1;
}

/* Evaluates a result, with its group. It may be infinite or not a number: that is a value, too. */
static int fmu_evaluate_result(fmu *f, const int number)
{
    fmu_state *const s = &f->state;
    int group = 0;
    while (number >= fmu_ends[group])
        ++group;
    if (!fmu_close(f))
        return 0;
    if (s->valid & (2 << group))
        return 1;
    for (int i = group ? fmu_ends[group - 1] : 0; i < fmu_ends[group]; ++i)
        s->results[i] = NAN;
    const int status = fmu_fill(&s->model, group, s->results);
    if (status != 0 && status != FB_PUBLIC(not_finite))
        return fmu_check(f, status);
    s->valid |= 2 << group;
    return 1;
}

static int fmu_get(fmu *f, const unsigned *references, const size_t n, double *values)
{
    fmu_state *const s = &f->state;
    for (size_t i = 0; i < n; ++i) {
        const unsigned v = references[i];
        if (v >= N_VARIABLES)
            return fmu_fail(f, "There is no real variable with the value reference %u.", v);
        if (v == 0)
            values[i] = s->model.t;
        else if (v < OF_RATES) {
            if (!fmu_close(f))
                return 0;
            values[i] = s->model.x[v - OF_STATES];
        } else if (v >= OF_PARAMETERS && v < OF_INPUTS)
            values[i] = s->model.p[v - OF_PARAMETERS];
        else if (v >= OF_INPUTS && v < OF_RESULTS) {
            if (s->is_open)
                FB_PUBLIC(update)(&s->model); /* its expression may contain parameters */
            values[i] = FB_PUBLIC(input)(&s->model, (int)(v - OF_INPUTS));
        } else if (v < OF_PARAMETERS) {
            if (!fmu_evaluate_rates(f))
                return 0;
            values[i] = s->rates[v - OF_RATES];
        } else {
            if (!fmu_evaluate_result(f, (int)(v - OF_RESULTS)))
                return 0;
            values[i] = s->results[v - OF_RESULTS];
        }
    }
    return 1;
}

static int fmu_set(fmu *f, const unsigned *references, const size_t n, const double *values)
{
    fmu_state *const s = &f->state;
    const int is_before = s->mode & (FMU_INSTANTIATED | FMU_INITIALIZATION);
    for (size_t i = 0; i < n; ++i) {
        const unsigned v = references[i];
        if (v >= N_VARIABLES)
            return fmu_fail(f, "There is no real variable with the value reference %u.", v);
        if (!isfinite(values[i]))
            return fmu_fail(f, "The variable with the value reference %u cannot be %g.", v, values[i]);
        if (v >= OF_INPUTS && v < OF_RESULTS) {
            const int number = (int)(v - OF_INPUTS);
            s->model.r[number] = values[i];
            s->model.held[number] = 1;
            for (int k = 1; k <= 2 && fmu_has_rates[number]; ++k)
                if (!s->model.held[number + k]) { /* a prescribed motion is at rest unless its rates are set */
                    s->model.r[number + k] = 0.0;
                    s->model.held[number + k] = 1;
                }
        } else if (v >= OF_STATES && v < OF_RATES && is_before)
            s->given[v - OF_STATES] = values[i];
        else if (v >= OF_PARAMETERS && v < OF_INPUTS && is_before)
            s->model.p[v - OF_PARAMETERS] = values[i];
        else
            return fmu_fail(f, "The variable with the value reference %u cannot be set%s.", v,
                            v < OF_RATES || (v >= OF_PARAMETERS && v < OF_INPUTS) ? " after initialization" : "");
        s->is_open |= is_before;
        s->valid = 0;
    }
    return 1;
}

/* The change of a variable along a seed, by central differences. During initialization, loops are closed anew. */
static int fmu_difference(fmu *f, const unsigned unknown, const unsigned *knowns, const size_t n, const double *seed,
                          double *change)
{
    const fmu_state kept = f->state;
    double values[2], h = 1.0; /* the third root of the precision of double, in units of what is moved least */
    int succeeds = 1;
    for (size_t j = 0; j < n && succeeds; ++j) {
        succeeds = fmu_get(f, knowns + j, 1, values);
        const double size = fabs(values[0]) > 1.0 ? fabs(values[0]) : 1.0;
        if (seed[j] != 0.0 && !(h <= 6e-6 * size / fabs(seed[j])))
            h = 6e-6 * size / fabs(seed[j]);
    }
    for (int side = 0; side < 2 && succeeds; ++side) {
        struct FB_MODEL *const m = &f->state.model;
        f->state = kept;
        f->state.valid = 0;
        for (size_t j = 0; j < n; ++j) {
            const double moved = (side ? h : -h) * seed[j];
            if (knowns[j] < OF_RATES) {
                m->x[knowns[j] - OF_STATES] += moved;
                f->state.given[knowns[j] - OF_STATES] += moved;
            } else if (knowns[j] < OF_INPUTS)
                m->p[knowns[j] - OF_PARAMETERS] += moved;
            else {
                const int k = (int)(knowns[j] - OF_INPUTS);
                m->r[k] = FB_PUBLIC(input)(m, k) + moved;
                m->held[k] = 1;
                m->slope[k] = 0.0;
            }
        }
        f->state.is_open = kept.mode == FMU_INITIALIZATION;
        succeeds = fmu_get(f, &unknown, 1, values + side);
    }
    f->state = kept;
    *change = (values[1] - values[0]) / (2.0 * h);
    return succeeds;
}

/* Derivatives along a seed: of the rates by states and inputs by the Jacobians; all others by differences. */
static int fmu_directional_derivative(fmu *f, const unsigned *unknowns, const size_t n_unknowns, const unsigned *knowns,
                                      const size_t n_knowns, const double *seed, double *result)
{
    fmu_state *const s = &f->state;
    const int begins = s->mode == FMU_INITIALIZATION;
    double wrt_states[N_X * N_X], wrt_inputs[FMU_AT_LEAST_1(N_X * N_R)];
    if (!fmu_close(f) || (!begins && (!fmu_check(f, FB_PUBLIC(jacobian)(&s->model, wrt_states)) ||
                                      (N_R > 0 && !fmu_check(f, FB_PUBLIC(input_jacobian)(&s->model, wrt_inputs))))))
        return 0;
    for (size_t j = 0; j < n_knowns; ++j) {
        const int is_state = knowns[j] >= OF_STATES && knowns[j] < OF_RATES;
        const int is_parameter = knowns[j] >= OF_PARAMETERS && knowns[j] < OF_INPUTS;
        const int is_input = knowns[j] >= OF_INPUTS && knowns[j] < OF_RESULTS;
        if (!is_state && !is_input && !(begins && is_parameter))
            return fmu_fail(f, "There is no derivative with respect to the variable with the value reference %u.",
                            knowns[j]);
    }
    for (size_t i = 0; i < n_unknowns; ++i) {
        const unsigned u = unknowns[i];
        if (u < OF_STATES || u >= N_VARIABLES || (u >= OF_PARAMETERS && u < OF_RESULTS))
            return fmu_fail(f, "There is no derivative of the variable with the value reference %u.", u);
        result[i] = 0.0;
        if (begins || u >= OF_RESULTS) {
            if (!fmu_difference(f, u, knowns, n_knowns, seed, result + i))
                return 0;
            continue;
        }
        for (size_t j = 0; j < n_knowns; ++j) {
            const unsigned k = knowns[j];
            if (u < OF_RATES)
                result[i] += u == k ? seed[j] : 0.0;
            else
                result[i] += seed[j] * (k < OF_RATES ? wrt_states[(u - OF_RATES) * N_X + k - OF_STATES]
                                                     : wrt_inputs[(u - OF_RATES) * N_R + k - OF_INPUTS]);
        }
    }
    return 1;
}

/* The values of the event indicators. */
static int fmu_get_indicators(fmu *f, double *indicators, const size_t n)
{
    if (n != FMU_N_EVENTS)
        return fmu_fail(f, "There are %d event indicators, not %d.", (int)FMU_N_EVENTS, (int)n);
    return fmu_get(f, fmu_indicators, n, indicators);
}

/* Takes note of an event; the last one of a terminal kind ends the simulation. */
static void fmu_count(fmu *f, const int event)
{
    const long terminal = fmu_events[event].terminal;
    f->state.indicators[event].count += 1;
    f->state.is_over |= terminal > 0 && f->state.indicators[event].count >= terminal;
}

/* In model exchange: counts the event indicators that change their sign, in event mode at the root itself. */
static int fmu_note_signs(fmu *f, const int is_event)
{
    double values[FMU_AT_LEAST_1(FMU_N_EVENTS)];
    if (!fmu_get_indicators(f, values, FMU_N_EVENTS))
        return 0;
    for (int i = 0; i < FMU_N_EVENTS; ++i) {
        fmu_indicator *const seen = f->state.indicators + i;
        const int32_t before = seen->sign, sign = values[i] > 0.0 ? 1 : -1;
        seen->largest = fmax(seen->largest, fabs(values[i]));
        if (!(fabs(values[i]) > FMU_ROOT_RTOL * seen->largest)) {
            if (!is_event || before == 0 || seen->at_zero)
                continue;
            seen->at_zero = 1;
            seen->sign = -before;
        } else {
            seen->sign = sign;
            if (before == 0 || before == sign || seen->at_zero) {
                seen->at_zero = 0;
                continue;
            }
        }
        if (seen->sign * fmu_events[i].direction >= 0)
            fmu_count(f, i);
    }
    return 1;
}

/* The mechanism is where an event was found. */
static void fmu_move_to(struct FB_MODEL *m, const struct FB_FOUND *found)
{
    m->t = found->t;
    memcpy(m->x, found->x, sizeof m->x);
}

/* Runs to the end of a communication step, or to an event at which it ends; the status of the mechanism. Events at the
 * same time to within rounding errors count together, since a run that begins there has them no more. */
static int fmu_run(fmu *f, const double end)
{
    fmu_state *const s = &f->state;
    struct FB_MODEL *const m = &s->model;
    struct FB_EVENT event[FMU_AT_LEAST_1(FMU_N_EVENTS)];
    struct FB_FOUND found[FMU_ROOM];
    struct FB_EVENTS events = {.n = FMU_N_EVENTS, .event = event, .work = f->work, .found = found, .room = FMU_ROOM};
    for (;;) {
        memcpy(event, fmu_events, sizeof event);
        for (int i = 0; i < FMU_N_EVENTS; ++i) {
            event[i].terminal = 0;
            event[i].at_start &= m->t == s->start;
        }
        const int status =
            FMU_IS_STIFF
                ? FB_PUBLIC(simulate_stiff)(m, end, s->tolerance, s->tolerance, NULL, 0, NULL, &events, f->stiff_work)
                : FB_PUBLIC(simulate_events)(m, end, s->tolerance, s->tolerance, NULL, 0, NULL, &events);
        const int n = events.n_found < FMU_ROOM ? (int)events.n_found : FMU_ROOM;
        for (int k = 0; k < n; ++k) {
            fmu_count(f, found[k].event);
            const int is_last = k + 1 == n || found[k + 1].t - found[k].t > FMU_SAME_RTOL * (1.0 + fabs(found[k].t));
            if (is_last && (s->is_over || f->returns_early)) {
                fmu_move_to(m, found + k);
                return 0;
            }
        }
        if (events.n_found <= FMU_ROOM)
            return status;
        fmu_move_to(m, found + n - 1);
    }
}

/* Advances by a communication step, or to an event within it; 0 if it must not be taken, -1 if it fails. */
static int fmu_step(fmu *f, const double begin, const double length, double *reached)
{
    fmu_state *const s = &f->state;
    struct FB_MODEL *const m = &s->model;
    const double end = begin + length, rounding = 1e-9 * (1.0 + fabs(m->t));
    *reached = m->t;
    if (!(fabs(begin - m->t) <= rounding))
        return fmu_fail(f, "The step begins at t = %.9g, but the mechanism is at t = %.9g.", begin, m->t);
    if (!(length > 0.0))
        return fmu_fail(f, "The length of a step is %g: it must be positive.", length);
    if (!(end <= s->stop + rounding))
        return fmu_fail(f, "The step ends at t = %.9g, after the stop time, %.9g.", end, s->stop);
    const int status = fmu_run(f, end);
    for (int k = 0; k < N_R; ++k) { /* derivatives of inputs are those in one step */
        m->r[k] += m->slope[k] != 0.0 ? m->slope[k] * (m->t - m->since) : 0.0;
        m->slope[k] = 0.0;
    }
    s->valid = 0;
    *reached = m->t;
    return fmu_check(f, status) ? 1 : -1;
}

static int fmu_has_states(fmu *f, const size_t n)
{
    return n == N_X || fmu_fail(f, "There are %d continuous states, not %d.", (int)N_X, (int)n);
}

static int fmu_set_states(fmu *f, const double *x, const size_t n)
{
    if (!fmu_has_states(f, n))
        return 0;
    memcpy(f->state.model.x, x, sizeof f->state.model.x);
    f->state.valid = 0;
    return 1;
}

static int fmu_set_time(fmu *f, const double t)
{
    if (!isfinite(t))
        return fmu_fail(f, "The time cannot be %g.", t);
    f->state.model.t = t;
    f->state.valid = 0;
    return 1;
}

static int fmu_begin(fmu *f, const double t, const int has_tolerance, const double tolerance, const int has_stop,
                     const double stop)
{
    if (!fmu_set_time(f, t))
        return 0;
    if (has_tolerance && !(tolerance > 0.0))
        return fmu_fail(f, "The tolerance is %g: it must be positive.", tolerance);
    if (has_tolerance)
        f->state.tolerance = tolerance;
    if (has_stop && !(stop > t))
        return fmu_fail(f, "The stop time, %g, is not after the start time, %g.", stop, t);
    if (has_stop)
        f->state.stop = stop;
    f->state.start = t;
    f->state.mode = FMU_INITIALIZATION;
    f->state.is_open = 1;
    return 1;
}

/* The derivatives of the states alone: an integrator asks for these often. */
static int fmu_rates(fmu *f, double *rates)
{
    if (!fmu_evaluate_rates(f))
        return 0;
    memcpy(rates, f->state.rates, N_X * sizeof *rates);
    return 1;
}

static int fmu_save(fmu *f, void **saved)
{
    if (*saved == NULL)
        *saved = malloc(sizeof f->state);
    if (*saved == NULL)
        return fmu_fail(f, "There is no memory for a copy of the state.");
    memcpy(*saved, &f->state, sizeof f->state);
    return 1;
}

/* A serialized state: what tells that it is one of this model, whole; then all from which the rest follows. Its
 * numbers are no pointers and no places in arrays, so that none of them can do harm. */
typedef struct fmu_record {
    char kind[sizeof FMU_KIND], model[sizeof fmu_token];
    uint64_t size, sum; /* of the record; of its other bytes */
    double t, since, tolerance, start, stop, interval[2];
    double x[N_X], given[N_X], p[FMU_AT_LEAST_1(N_P)], r[FMU_AT_LEAST_1(N_R)], slope[FMU_AT_LEAST_1(N_R)];
    fmu_indicator indicators[FMU_AT_LEAST_1(FMU_N_EVENTS)];
    int32_t is_over;
    int32_t held[FMU_AT_LEAST_1(N_R)], is_cosimulation, mode, is_open;
} fmu_record;

/* Source: G. Fowler, L. C. Noll, K.-P. Vo, D. Eastlake, "The FNV Non-Cryptographic Hash Algorithm", FNV-1a, 64 bits. */
static uint64_t fmu_sum(const fmu_record *record)
{
    const size_t place = offsetof(fmu_record, sum);
    uint64_t sum = 14695981039346656037u;
    for (size_t i = 0; i < sizeof *record; ++i) {
        const int is_summed = i < place || i >= place + sizeof record->sum;
        sum = (sum ^ (is_summed ? ((const unsigned char *)record)[i] : 0u)) * 1099511628211u;
    }
    return sum;
}

static int fmu_serialize(fmu *f, const fmu_state *saved, void *bytes, const size_t size)
{
    const struct FB_MODEL *const m = &saved->model;
    fmu_record record;
    if (size < sizeof record)
        return fmu_fail(f, "A serialized state has %d bytes, not %d.", (int)sizeof record, (int)size);
    memset(&record, 0, sizeof record); /* and what is between its members */
    memcpy(record.kind, FMU_KIND, sizeof record.kind);
    memcpy(record.model, fmu_token, sizeof record.model);
    record.size = sizeof record;
    record.t = m->t;
    record.since = m->since;
    record.tolerance = saved->tolerance;
    record.start = saved->start;
    record.stop = saved->stop;
    FB_PUBLIC(get_interval)(m, record.interval);
    memcpy(record.x, m->x, sizeof record.x);
    memcpy(record.given, saved->given, sizeof record.given);
    memcpy(record.p, m->p, sizeof record.p);
    memcpy(record.r, m->r, sizeof record.r);
    memcpy(record.slope, m->slope, sizeof record.slope);
    for (int k = 0; k < N_R; ++k)
        record.held[k] = m->held[k];
    memcpy(record.indicators, saved->indicators, sizeof record.indicators);
    record.is_over = saved->is_over;
    record.is_cosimulation = saved->is_cosimulation;
    record.mode = saved->mode;
    record.is_open = saved->is_open;
    record.sum = fmu_sum(&record);
    memcpy(bytes, &record, sizeof record);
    return 1;
}

static int fmu_deserialize(fmu *f, const void *bytes, const size_t size, void **saved)
{
    fmu_record record;
    if (bytes == NULL || size < sizeof record.kind || memcmp(bytes, FMU_KIND, sizeof record.kind) != 0)
        return fmu_fail(f, "The %d bytes are no serialized state of this version: they do not begin with \"%s\".",
                        (int)size, FMU_KIND);
    memset(&record, 0, sizeof record);
    memcpy(&record, bytes, size < sizeof record ? size : sizeof record);
    if (memcmp(record.model, fmu_token, sizeof record.model) != 0)
        return fmu_fail(f, "The serialized state is one of another model than %s.", fmu_token);
    if (size != sizeof record || record.size != sizeof record)
        return fmu_fail(f, "A serialized state has %d bytes, not %d.", (int)sizeof record, (int)size);
    if (record.sum != fmu_sum(&record))
        return fmu_fail(f, "The serialized state is damaged: its bytes have another sum than it says.");
    if (*saved == NULL)
        *saved = malloc(sizeof(fmu_state));
    if (*saved == NULL)
        return fmu_fail(f, "There is no memory for a copy of the state.");
    fmu_state *const s = *saved;
    struct FB_MODEL *const m = &s->model;
    memset(s, 0, sizeof *s);
    FB_PUBLIC(init)(m);
    memcpy(m->p, record.p, sizeof record.p);
    FB_PUBLIC(update)(m);
    m->t = record.t;
    m->since = record.since;
    s->tolerance = record.tolerance;
    s->start = record.start;
    s->stop = record.stop;
    FB_PUBLIC(set_interval)(m, record.interval);
    memcpy(m->x, record.x, sizeof record.x);
    memcpy(s->given, record.given, sizeof record.given);
    memcpy(m->r, record.r, sizeof record.r);
    memcpy(m->slope, record.slope, sizeof record.slope);
    for (int k = 0; k < N_R; ++k)
        m->held[k] = record.held[k];
    memcpy(s->indicators, record.indicators, sizeof record.indicators);
    s->is_over = record.is_over;
    s->is_cosimulation = record.is_cosimulation;
    s->mode = record.mode;
    s->is_open = record.is_open;
    return 1;
}

/* Whether model exchange needs a projection. */
static int fmu_is_open(fmu *f)
{
    return !(FB_PUBLIC(relative_violation)(&f->state.model) <= f->state.tolerance);
}

/* A saved state belongs to instances of the same kind. */
static int fmu_restore(fmu *f, const fmu_state *saved)
{
    if (saved->is_cosimulation != f->state.is_cosimulation)
        return fmu_fail(f, "The state is one of %s.", saved->is_cosimulation ? "co-simulation" : "model exchange");
    f->state = *saved;
    return 1;
}

/* At an event the state is moved onto the constraints. */
static int fmu_handle_event(fmu *f, int *has_changed, int *has_next, double *next)
{
    struct FB_MODEL *const m = &f->state.model;
    if (m->t > f->state.start && FB_PUBLIC(jumps)(m))
        return fmu_check(f, FB_PUBLIC(speeds_jump));
    *has_changed = fmu_is_open(f);
    if (*has_changed && !fmu_check(f, FB_PUBLIC(project)(m)))
        return 0;
    *next = FB_PUBLIC(next_breakpoint)(m);
    *has_next = *next > m->t && *next < INFINITY;
    FB_PUBLIC(between)(m, m->t, *next);
    f->state.valid = 0;
    return fmu_note_signs(f, 1);
}

#endif
