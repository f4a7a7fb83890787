/* Jacobians at a batch of states, by the kernel for single states: of x', of outputs, and of the residual of the
 * equations of motion as derivatives/implicit_residual.h has it. */
#ifndef FOURBAR_JACOBIANS_H
#define FOURBAR_JACOBIANS_H

#include "../derivatives/implicit_residual.h"
#include "batch.h"

enum FB_VARIABLES { FB_WRT_STATE = 0, FB_WRT_PARAMETERS = 1, FB_WRT_INPUTS = 2 };

typedef struct fb_jacobians {
    const fb_kernel *kernel; /* with derivatives, and with their products for the residual */
    int64_t n;
    fb_batch_array t, x, p, r;         /* as in fb_batch */
    fb_batch_array rates, multipliers; /* (n_x, n), (n_l, n), for the residual */
    const char *in_force;              /* (n_r,): whether an input follows the parameters by its expression */
    int variables;                     /* FB_VARIABLES, of the first two results */
    double *of_rates, *of_outputs;     /* (n, n_x, m), (n, n_o, m); NaN where there are none; NULL for the residual */
    int formulation;                   /* FB_FORMULATION of the residual */
    double *residual;                  /* (n, n_y), or NULL */
    /* with respect to (x, lambda) and to x', (n, n_y, n_y); to p and r, (n, n_y, n_p), (n, n_y, n_r); or NULL */
    double *wrt_state, *wrt_rate, *wrt_parameters, *wrt_inputs;
} fb_jacobians;

typedef struct fb_jacobian_work {
    double *x, *rates, *p, *r, *constants, *accelerations, *multipliers, *of_multipliers, *more;
    double *input_jacobian, *partial, *wrt_accelerations, *wrt_multipliers, *directions, *changes;
    double *wrt_state, *wrt_inputs;
    void *work;
} fb_jacobian_work;

/* c += a b, for a of shape (n, m) and b of shape (m, k). */
static inline void fb_add_product(const int n, const int m, const int k, const double *a, const double *b, double *c)
{
    for (int i = 0; i < n; ++i)
        for (int l = 0; l < m; ++l)
            for (int j = 0; j < k && a[i * m + l] != 0.0; ++j)
                c[i * k + j] += a[i * m + l] * b[l * k + j];
}

/* The results of a function of the kernel's table; JVPs are those of FB_DIRECTIONS. */
static inline void fb_call_at(const fb_kernel *k, const fb_jacobian_work *w, const enum FB_ROLE role, const double t,
                              const double *accelerations, const double *multipliers, const double *const *arguments,
                              double *const *results)
{
    const fb_at at = {t, w->x, w->constants, w->r, accelerations, multipliers, FB_DIRECTIONS};
    k->functions[role].call(&at, arguments, results, w->work);
}

/* dr/dp of the inputs that follow their expressions, zero for the others; whether any is not zero. */
static inline int fb_input_changes(const fb_jacobians *b, fb_jacobian_work *w, const double t)
{
    const fb_kernel *const k = b->kernel;
    int follows = 0;
    fb_call_at(k, w, FB_DEFAULT_INPUT_PARTIALS, t, NULL, NULL, NULL, &w->input_jacobian);
    for (int i = 0; i < k->n_r * k->n_p; ++i) {
        w->input_jacobian[i] = b->in_force[i / k->n_p] ? w->input_jacobian[i] : 0.0;
        follows |= w->input_jacobian[i] != 0.0;
    }
    return follows;
}

/* Of x' and the outputs by one kind of variables; u' and the multipliers are known if there are outputs. */
static inline int fb_total_jacobians(const fb_jacobians *b, fb_jacobian_work *w, const int variables, const double t,
                                     double *of_rates, double *of_outputs)
{
    const fb_kernel *const k = b->kernel;
    const enum FB_ROLE roles[] = {FB_STATE_PARTIALS, FB_PARAMETER_PARTIALS, FB_INPUT_PARTIALS};
    const enum FB_ROLE outputs[] = {FB_OUTPUT_STATE_PARTIALS, FB_OUTPUT_PARAMETER_PARTIALS, FB_OUTPUT_INPUT_PARTIALS};
    const int sizes[] = {k->n_x, k->n_p, k->n_r}, m = sizes[variables], n_q = k->n_q;
    const int status = k->differentiate(k->functions, roles[variables], m, t, w->x, w->constants, w->r, of_rates,
                                        of_outputs ? w->of_multipliers : NULL, w->work);
    if (status != FB_OK || of_outputs == NULL || k->n_o == 0)
        return status;
    fb_call_at(k, w, outputs[variables], t, w->accelerations, w->multipliers, NULL, &of_outputs);
    fb_add_product(k->n_o, k->n_u, m, w->wrt_accelerations, of_rates + n_q * m, of_outputs);
    fb_add_product(k->n_o, k->n_l, m, w->wrt_multipliers, w->of_multipliers, of_outputs);
    return FB_OK;
}

static inline int fb_jacobians_at(const fb_jacobians *b, fb_jacobian_work *w, const int64_t i, const double t)
{
    const fb_kernel *const k = b->kernel;
    const int sizes[] = {k->n_x, k->n_p, k->n_r}, m = sizes[b->variables];
    double *const of_rates = b->of_rates + i * k->n_x * m;
    double *const of_outputs = b->of_outputs ? b->of_outputs + i * k->n_o * m : NULL;
    if (of_outputs && k->n_o > 0) {
        const int status = k->accelerations(t, w->x, w->constants, w->r, w->accelerations, w->multipliers, w->work);
        if (status != FB_OK)
            return status;
        double *const wrt_solution[] = {w->wrt_accelerations, w->wrt_multipliers};
        fb_call_at(k, w, FB_OUTPUT_SOLUTION_PARTIALS, t, w->accelerations, w->multipliers, NULL, wrt_solution);
    }
    int status = fb_total_jacobians(b, w, b->variables, t, of_rates, of_outputs);
    if (status != FB_OK || b->variables != FB_WRT_PARAMETERS || k->n_r == 0)
        return status;
    if (!fb_input_changes(b, w, t))
        return FB_OK;
    double *const of_more = of_outputs ? w->more + k->n_x * k->n_r : NULL;
    status = fb_total_jacobians(b, w, FB_WRT_INPUTS, t, w->more, of_more);
    fb_add_through_inputs(k, k->n_x, w->more, w->input_jacobian, of_rates);
    if (of_outputs)
        fb_add_through_inputs(k, k->n_o, of_more, w->input_jacobian, of_outputs);
    return status;
}

/* Places the memory of one worker; returns the number of doubles. */
static inline size_t fb_place_jacobians(const fb_kernel *k, fb_jacobian_work *w, double *memory)
{
    const int x = k->n_x, p = k->n_p, r = k->n_r, u = k->n_u, l = k->n_l, o = k->n_o;
    const int widest = x > p ? (x > r ? x : r) : (p > r ? p : r);
    const fb_place places[] = {
        {&w->x, x + l},
        {&w->rates, x},
        {&w->p, p},
        {&w->r, r},
        {&w->constants, k->n_constants},
        {&w->accelerations, u},
        {&w->multipliers, l},
        {&w->of_multipliers, l * widest},
        {&w->more, (x + o) * r},
        {&w->input_jacobian, r * p},
        {&w->wrt_accelerations, o * u},
        {&w->wrt_multipliers, o * l},
        {&w->partial, (x + l) * widest},
        {&w->directions, (x + p + r) * FB_DIRECTIONS},
        {&w->changes, (k->n_c + k->n_i + k->n_c) * FB_DIRECTIONS},
        {&w->wrt_state, (x + l) * (x + l)},
        {&w->wrt_inputs, (x + l) * r},
    };
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

/* The Jacobians of the residual with respect to parameters or inputs; the rows of constraints are JVPs. */
static inline void fb_residual_partials(const fb_jacobians *b, fb_jacobian_work *w, const int variables, const double t,
                                        double *result)
{
    const fb_kernel *const k = b->kernel;
    const int n_q = k->n_q, n_u = k->n_u, n_z = k->n_z, n_x = k->n_x, n_c = k->n_c, n_l = k->n_l;
    const int m = variables == FB_WRT_PARAMETERS ? k->n_p : k->n_r;
    const int first = n_x + (variables == FB_WRT_PARAMETERS ? 0 : k->n_p);
    double *const of_coordinates = w->partial, *const of_residual = w->partial + n_q * m;
    const enum FB_ROLE role = variables == FB_WRT_PARAMETERS ? FB_PARAMETER_PARTIALS : FB_INPUT_PARTIALS;
    double *const partials[] = {of_coordinates, of_residual};
    fb_call_at(k, w, role, t, w->rates + n_q, w->x + n_x, NULL, partials);
    for (int j = 0; j < n_q * m; ++j)
        result[j] = -of_coordinates[j];
    for (int j = 0; j < n_u * m; ++j)
        result[n_q * m + j] = -of_residual[j];
    for (int j = 0; j < n_z * m; ++j)
        result[(n_q + n_u) * m + j] = -of_residual[(n_u + n_l) * m + j];
    for (int j = 0; j < n_c * m; ++j)
        result[n_x * m + j] = -of_residual[n_u * m + j];
    for (int j = n_c * m; j < n_l * m; ++j)
        result[n_x * m + j] = of_residual[n_u * m + j];
    if (b->formulation == FB_INDEX_1)
        return;
    double *const positions = w->changes, *const velocities = w->changes + (n_c + k->n_i) * FB_DIRECTIONS;
    for (int begin = 0; begin < m; begin += FB_DIRECTIONS) {
        const int count = m - begin < FB_DIRECTIONS ? m - begin : FB_DIRECTIONS;
        memset(w->directions, 0, (size_t)((n_x + k->n_p + k->n_r) * FB_DIRECTIONS) * sizeof(double));
        for (int j = 0; j < count; ++j)
            w->directions[(first + begin + j) * FB_DIRECTIONS + j] = 1.0;
        const double *const directions[] = {w->directions};
        double *const products[] = {positions, velocities};
        fb_call_at(k, w, FB_CONSTRAINT_JVP, t, NULL, NULL, directions, products);
        for (int row = 0; row < n_c; ++row)
            for (int j = 0; j < count; ++j)
                result[(n_x + row) * m + begin + j] = velocities[row * FB_DIRECTIONS + j];
        for (int h = 0; h < k->n_h; ++h)
            for (int j = 0; j < count && k->position_row[h] >= 0; ++j)
                result[(n_x + k->position_row[h]) * m + begin + j] = positions[k->position_row[h] * FB_DIRECTIONS + j];
    }
}

/* The residual and those of its Jacobians that are asked for. */
static inline void fb_residual_at(const fb_jacobians *b, fb_jacobian_work *w, fb_implicit *s, const int64_t i,
                                  const double t)
{
    const fb_kernel *const k = b->kernel;
    const int n_p = k->n_p, n = s->n_y;
    if (b->residual)
        fb_implicit_form(s, t, w->x, w->rates, b->residual + i * n);
    if (b->wrt_state || b->wrt_rate)
        fb_implicit_derivative(s, t, w->x, w->rates, b->wrt_state ? b->wrt_state + i * n * n : w->wrt_state);
    if (b->wrt_rate)
        fb_implicit_add_rates(s, 1.0, b->wrt_rate + i * n * n);
    if (b->wrt_parameters)
        fb_residual_partials(b, w, FB_WRT_PARAMETERS, t, b->wrt_parameters + i * n * n_p);
    double *const wrt_inputs = b->wrt_inputs ? b->wrt_inputs + i * n * k->n_r : w->wrt_inputs;
    if (k->n_r > 0 && (b->wrt_inputs || b->wrt_parameters))
        fb_residual_partials(b, w, FB_WRT_INPUTS, t, wrt_inputs);
    if (k->n_r > 0 && b->wrt_parameters && fb_input_changes(b, w, t))
        fb_add_through_inputs(k, n, wrt_inputs, w->input_jacobian, b->wrt_parameters + i * n * n_p);
}

/* The states from begin to end; returns 0, or -1 without memory. Other threads may evaluate others. */
static inline int fb_evaluate_jacobians(const fb_jacobians *b, const int64_t begin, const int64_t end)
{
    const fb_kernel *const k = b->kernel;
    const int sizes[] = {k->n_x, k->n_p, k->n_r}, m = sizes[b->variables];
    fb_jacobian_work w;
    fb_implicit implicit;
    fb_problem problem = {.kernel = k};
    memset(&w, 0, sizeof w);
    const size_t size = fb_place_jacobians(k, &w, NULL);
    const size_t more = b->of_rates == NULL ? fb_place_implicit(&problem, b->formulation, &implicit, NULL) : 0;
    double *const memory = calloc(size + more + 1, sizeof(double));
    fb_source *const sources = calloc((size_t)k->n_r + 1, sizeof(fb_source));
    w.work = calloc(1, k->work_size);
    if (memory == NULL || w.work == NULL || sources == NULL) {
        free(memory), free(w.work), free(sources);
        return -1;
    }
    fb_place_jacobians(k, &w, memory);
    if (b->of_rates == NULL)
        fb_place_implicit(&problem, b->formulation, &implicit, memory + size);
    for (int j = 0; j < k->n_r; ++j)
        sources[j].input = j;
    problem.constants = w.constants, problem.inputs = w.r, problem.work = w.work;
    problem.sources = sources, problem.n_sources = k->n_r;
    for (int64_t i = begin; i < end; ++i) {
        const double t = fb_entry(&b->t, 0, i);
        for (int j = 0; j < k->n_x; ++j)
            w.x[j] = fb_entry(&b->x, j, i);
        if (b->p.stride || i == begin) {
            for (int j = 0; j < k->n_p; ++j)
                w.p[j] = fb_entry(&b->p, j, i);
            k->prepare(w.p, w.constants);
        }
        if (b->r.values == NULL)
            k->default_inputs(t, w.constants, w.r);
        else
            for (int j = 0; j < k->n_r; ++j)
                w.r[j] = fb_entry(&b->r, j, i);
        if (b->of_rates == NULL) {
            for (int j = 0; j < k->n_x; ++j)
                w.rates[j] = fb_entry(&b->rates, j, i);
            for (int j = 0; j < k->n_l; ++j)
                w.x[k->n_x + j] = fb_entry(&b->multipliers, j, i);
            for (int j = 0; j < k->n_r; ++j)
                sources[j].value = w.r[j];
            fb_residual_at(b, &w, &implicit, i, t);
        } else if (fb_jacobians_at(b, &w, i, t) != FB_OK || !isfinite(t)) {
            for (int j = 0; j < k->n_x * m; ++j)
                b->of_rates[i * k->n_x * m + j] = NAN;
            for (int j = 0; j < k->n_o * m && b->of_outputs; ++j)
                b->of_outputs[i * k->n_o * m + j] = NAN;
        }
    }
    free(memory), free(w.work), free(sources);
    return 0;
}

#endif
