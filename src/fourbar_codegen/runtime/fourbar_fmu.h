/* What FMUs of both versions of FMI have in common: an instance around a mechanism, its modes, and its variables.
 *
 * Included by fourbar_fmi2.h or fourbar_fmi3.h, in a source that includes the header of the model as a C library, and
 * defines FB_MODEL, FB_POTENTIAL (whether the potential energy is known) and fmu_token. Value references are numbers in
 * this order: time, states, their derivatives, parameters, inputs, outputs, energies, points.
 *
 * Source: Modelica Association, Functional Mock-up Interface, versions 2.0.5 and 3.0.2, https://fmi-standard.org.
 */
#ifndef FOURBAR_FMU_H
#define FOURBAR_FMU_H

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define FB_JOINED(model, name) model##_##name
#define FB_NAMED(model, name) FB_JOINED(model, name)
#define FB_PUBLIC(name) FB_NAMED(FB_MODEL, name)

enum {
    N_X = FB_PUBLIC(n_x),
    N_P = FB_PUBLIC(n_p),
    N_R = FB_PUBLIC(n_r),
    N_Y = FB_PUBLIC(n_y),
    N_POINTS = FB_PUBLIC(n_points),
    OF_STATES = 1,
    OF_RATES = OF_STATES + N_X,
    OF_PARAMETERS = OF_RATES + N_X,
    OF_INPUTS = OF_PARAMETERS + N_P,
    OF_OUTPUTS = OF_INPUTS + N_R,
    OF_ENERGIES = OF_OUTPUTS + N_Y,
    OF_POINTS = OF_ENERGIES + 2,
    N_VARIABLES = OF_POINTS + 3 * N_POINTS
};

/* Relative violation of the constraints from which on model exchange asks for a projection, and tolerance of
 * co-simulation unless the importer states one. */
#define FB_VIOLATED 1e-10
#define FB_TOLERANCE 1e-6

enum fmu_mode {
    FMU_INSTANTIATED = 1,
    FMU_INITIALIZATION = 2,
    FMU_EVENT = 4,
    FMU_CONTINUOUS = 8,
    FMU_STEP = 16,
    FMU_TERMINATED = 32,
    FMU_INITIALIZED = FMU_EVENT | FMU_CONTINUOUS | FMU_STEP
};

/* All that a saved state contains. */
typedef struct fmu_state {
    FB_MODEL model;
    int mode;
    int is_open; /* whether loops are to be closed from the independent values, as during initialization */
    double tolerance;
    /* values that follow from the state; not valid after a change */
    int are_valid;
    double rates[N_X], outputs[N_Y > 0 ? N_Y : 1], energies[2], points[N_POINTS > 0 ? 3 * N_POINTS : 1];
} fmu_state;

typedef struct fmu {
    fmu_state state;
    int is_cosimulation;
    int logs;
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
    f->is_cosimulation = is_cosimulation;
    return f;
}

static void fmu_reset(fmu *f)
{
    memset(&f->state, 0, sizeof f->state);
    FB_PUBLIC(init)(&f->state.model);
    f->state.mode = FMU_INSTANTIATED;
    f->state.is_open = 1;
    f->state.tolerance = FB_TOLERANCE;
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
    const FB_MODEL *const m = &f->state.model;
    return status == 0 || fmu_fail(f, "At t = %.9g: %s.", m->t, FB_PUBLIC(message)(status));
}

/* Closes the loops, during initialization after each change. */
static int fmu_close(fmu *f)
{
    if (f->state.is_open) {
        if (!fmu_check(f, FB_PUBLIC(update)(&f->state.model)) || !fmu_check(f, FB_PUBLIC(close)(&f->state.model)))
            return 0;
        f->state.is_open = 0;
    }
    return 1;
}

/* The values that follow from the state. */
static int fmu_evaluate(fmu *f)
{
    fmu_state *const s = &f->state;
    FB_MODEL *const m = &s->model;
    if (!fmu_close(f))
        return 0;
    if (s->are_valid)
        return 1;
    if (!fmu_check(f, FB_PUBLIC(rhs)(m, m->t, m->x, s->rates)))
        return 0;
#ifdef FB_OUTPUTS
    if (!fmu_check(f, FB_PUBLIC(outputs)(m, s->outputs)))
        return 0;
#endif
    FB_PUBLIC(energies)(m, s->energies, s->energies + 1);
    FB_PUBLIC(points)(m, s->points);
    s->are_valid = 1;
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
        else if (v >= OF_INPUTS && v < OF_OUTPUTS)
            values[i] = FB_PUBLIC(input)(&s->model, (int)(v - OF_INPUTS));
        else {
            if (!fmu_evaluate(f))
                return 0;
            values[i] = v < OF_PARAMETERS ? s->rates[v - OF_RATES]
                        : v < OF_ENERGIES ? s->outputs[v - OF_OUTPUTS]
                        : v < OF_POINTS   ? s->energies[v - OF_ENERGIES]
                                          : s->points[v - OF_POINTS];
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
        if (v >= OF_INPUTS && v < OF_OUTPUTS) {
            s->model.r[v - OF_INPUTS] = values[i];
            s->model.held[v - OF_INPUTS] = 1;
            s->model.slope[v - OF_INPUTS] = 0.0;
        } else if (v >= OF_STATES && v < OF_RATES && is_before)
            s->model.x[v - OF_STATES] = values[i];
        else if (v >= OF_PARAMETERS && v < OF_INPUTS && is_before)
            s->model.p[v - OF_PARAMETERS] = values[i];
        else
            return fmu_fail(f, "The variable with the value reference %u cannot be set%s.", v,
                            v < OF_RATES || (v >= OF_PARAMETERS && v < OF_INPUTS) ? " after initialization" : "");
        s->is_open |= is_before;
        s->are_valid = 0;
    }
    return 1;
}

/* Inputs that change linearly in the next step of co-simulation. */
static int fmu_set_slopes(fmu *f, const unsigned *references, const size_t n, const int *orders, const double *values)
{
    FB_MODEL *const m = &f->state.model;
    for (size_t i = 0; i < n; ++i) {
        if (references[i] < OF_INPUTS || references[i] >= OF_OUTPUTS)
            return fmu_fail(f, "The variable with the value reference %u is no input.", references[i]);
        if (orders[i] != 1 || !isfinite(values[i]))
            return fmu_fail(f, "An input has a finite derivative of order 1, not %g of order %d.", values[i],
                            orders[i]);
        m->slope[references[i] - OF_INPUTS] = values[i];
    }
    m->since = m->t;
    f->state.are_valid = 0;
    return 1;
}

/* The change of a variable that follows from the state, by central differences along the seed. */
static int fmu_difference(fmu *f, const unsigned unknown, const unsigned *knowns, const size_t n, const double *seed,
                          double *change)
{
    const fmu_state kept = f->state;
    double values[2], size = 0.0;
    int succeeds = 1;
    for (size_t j = 0; j < n; ++j)
        size = fabs(seed[j]) > size ? fabs(seed[j]) : size;
    const double h = 6e-6 / (size > 0.0 ? size : 1.0); /* the third root of the precision of double */
    for (int side = 0; side < 2 && succeeds; ++side) {
        FB_MODEL *const m = &f->state.model;
        f->state = kept;
        f->state.are_valid = 0;
        for (int k = 0; k < N_R; ++k)
            m->r[k] = FB_PUBLIC(input)(m, k);
        for (size_t j = 0; j < n; ++j) {
            const double moved = (side ? h : -h) * seed[j];
            if (knowns[j] < OF_RATES)
                m->x[knowns[j] - OF_STATES] += moved;
            else {
                m->r[knowns[j] - OF_INPUTS] += moved;
                m->held[knowns[j] - OF_INPUTS] = 1;
                m->slope[knowns[j] - OF_INPUTS] = 0.0;
            }
        }
        succeeds = fmu_get(f, &unknown, 1, values + side);
    }
    f->state = kept;
    *change = (values[1] - values[0]) / (2.0 * h);
    return succeeds;
}

/* Derivatives along a seed of states and inputs: of the rates by the Jacobians, of outputs by differences. */
static int fmu_directional_derivative(fmu *f, const unsigned *unknowns, const size_t n_unknowns, const unsigned *knowns,
                                      const size_t n_knowns, const double *seed, double *result)
{
    fmu_state *const s = &f->state;
    double by_states[N_X * N_X], by_inputs[N_R > 0 ? N_X * N_R : 1];
    if (!fmu_close(f) || !fmu_check(f, FB_PUBLIC(jacobian)(&s->model, by_states)) ||
        (N_R > 0 && !fmu_check(f, FB_PUBLIC(input_jacobian)(&s->model, by_inputs))))
        return 0;
    for (size_t j = 0; j < n_knowns; ++j)
        if (!(knowns[j] >= OF_STATES && knowns[j] < OF_RATES) && !(knowns[j] >= OF_INPUTS && knowns[j] < OF_OUTPUTS))
            return fmu_fail(f, "There is no derivative with respect to the variable with the value reference %u.",
                            knowns[j]);
    for (size_t i = 0; i < n_unknowns; ++i) {
        const unsigned u = unknowns[i];
        if (u < OF_STATES || u >= N_VARIABLES || (u >= OF_PARAMETERS && u < OF_OUTPUTS))
            return fmu_fail(f, "There is no derivative of the variable with the value reference %u.", u);
        result[i] = 0.0;
        if (u >= OF_OUTPUTS && !fmu_difference(f, u, knowns, n_knowns, seed, result + i))
            return 0;
        for (size_t j = 0; j < n_knowns && u < OF_OUTPUTS; ++j) {
            const unsigned k = knowns[j];
            if (u < OF_RATES)
                result[i] += u == k ? seed[j] : 0.0;
            else
                result[i] += seed[j] * (k < OF_RATES ? by_states[(u - OF_RATES) * N_X + k - OF_STATES]
                                                     : by_inputs[(u - OF_RATES) * N_R + k - OF_INPUTS]);
        }
    }
    return 1;
}

/* Advances by a communication step. */
static int fmu_step(fmu *f, const double begin, const double length, double *reached)
{
    fmu_state *const s = &f->state;
    FB_MODEL *const m = &s->model;
    *reached = m->t;
    if (!(fabs(begin - m->t) <= 1e-9 * (1.0 + fabs(m->t))))
        return fmu_fail(f, "The step begins at t = %.9g, but the mechanism is at t = %.9g.", begin, m->t);
    if (!(length > 0.0))
        return fmu_fail(f, "The length of a step is %g: it must be positive.", length);
    const double tolerance = s->tolerance;
    const int status = FB_PUBLIC(simulate)(m, begin + length, tolerance, tolerance, NULL, 0, NULL);
    s->are_valid = 0;
    *reached = m->t;
    return fmu_check(f, status);
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
    f->state.are_valid = 0;
    return 1;
}

static int fmu_set_time(fmu *f, const double t)
{
    if (!isfinite(t))
        return fmu_fail(f, "The time cannot be %g.", t);
    f->state.model.t = t;
    f->state.are_valid = 0;
    return 1;
}

static int fmu_begin(fmu *f, const double t, const int has_tolerance, const double tolerance)
{
    if (!fmu_set_time(f, t))
        return 0;
    if (has_tolerance && !(tolerance > 0.0))
        return fmu_fail(f, "The tolerance is %g: it must be positive.", tolerance);
    if (has_tolerance)
        f->state.tolerance = tolerance;
    f->state.mode = FMU_INITIALIZATION;
    f->state.is_open = 1;
    return 1;
}

/* The derivatives of the states alone: an integrator asks for these often. */
static int fmu_rates(fmu *f, double *rates)
{
    FB_MODEL *const m = &f->state.model;
    if (!f->state.are_valid && !fmu_check(f, FB_PUBLIC(rhs)(m, m->t, m->x, f->state.rates)))
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

/* Pointers in a saved state are set anew before they are used, so that its bytes mean the same in another process. */
static int fmu_serialize(fmu *f, const void *saved, void *bytes, const size_t size)
{
    if (size < sizeof(fmu_state))
        return fmu_fail(f, "A serialized state has %d bytes, not %d.", (int)sizeof(fmu_state), (int)size);
    memcpy(bytes, saved, sizeof(fmu_state));
    return 1;
}

static int fmu_deserialize(fmu *f, const void *bytes, const size_t size, void **saved)
{
    if (size != sizeof(fmu_state))
        return fmu_fail(f, "A serialized state has %d bytes, not %d.", (int)sizeof(fmu_state), (int)size);
    if (*saved == NULL)
        *saved = malloc(size);
    if (*saved == NULL)
        return fmu_fail(f, "There is no memory for a copy of the state.");
    memcpy(*saved, bytes, size);
    return 1;
}

/* At an event the state is moved onto the constraints. */
static int fmu_handle_event(fmu *f, int *has_changed, int *has_next, double *next)
{
    FB_MODEL *const m = &f->state.model;
    *has_changed = FB_PUBLIC(violation)(m) > 0.0;
    if (*has_changed && !fmu_check(f, FB_PUBLIC(project)(m)))
        return 0;
    *next = FB_PUBLIC(next_breakpoint)(m);
    *has_next = *next > m->t && *next < INFINITY;
    f->state.are_valid = 0;
    return 1;
}

#endif
