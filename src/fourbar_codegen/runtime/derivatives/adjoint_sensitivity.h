/* The gradient of a cost of a run's samples, by one sweep backwards over its steps.
 *
 * The Runge-Kutta steps are differentiated as they were taken, with their lengths held: the discrete adjoint. With l,
 * the gradient with respect to the state at the end of a step, and stages k_j = f(X_j), X_j = x + h sum_i a_ji k_i,
 *
 *     g_j = h (b_j l + sum_i>j a_ij f_x(X_i)^T g_i),     l_old = l + sum_j f_x(X_j)^T g_j,
 *
 * and f_p(X_j)^T g_j is added to the gradient with respect to parameters. Before it, the VJP of the projection is
 * applied to l, as derivatives/forward_sensitivity.h differentiates it. The states at the ends of steps are the
 * checkpoints: stages are evaluated again.
 *
 * Source: A. Walther, "Automatic differentiation of explicit Runge-Kutta methods for optimal control", Computational
 * Optimization and Applications 36 (2007).
 */
#ifndef FOURBAR_ADJOINT_SENSITIVITY_H
#define FOURBAR_ADJOINT_SENSITIVITY_H

#include "../steppers/runge_kutta.h"
#include "velocity_jump.h"

typedef struct fb_adjoint {
    const double *rows;    /* (n_rows, 2 + n_x), as of `fb_kept_steps` */
    fb_velocity_jump jump; /* at the beginning of the present piece */
    /* the samples: the row whose step contains each, and its time; the cost's derivatives with respect to states and
     * outputs there */
    const int64_t *sample_row;
    const double *sample_t, *wrt_states, *wrt_outputs; /* the latter (n_samples, n_o), or NULL */
    const double *output_t; /* their absolute times: at the end of a piece, outputs may be those after it */
    /* the results: with respect to the state where the sweep has arrived, to parameters, and for each source of an
     * input to its value or its table's coefficients, then its values before and after */
    double *wrt_state, *wrt_parameters, **wrt_source;
    /* scratch */
    double *gradient, *other;                      /* (n_x + n_p + n_r,) */
    double *weights;                               /* (n_x + n_l,) */
    double *wrt_stages, *wrt_pieces;               /* (n_rows of stages or interpolant, padded) */
    double *wrt_start, *wrt_end, *at, *wrt_sample; /* (padded,) */
    double *jacobian, *input_jacobian;             /* (n_o, n_x, n_p, n_r or n_u + n_l), (n_r, n_p) */
    double *solution;                              /* (n_u + n_l,) */
} fb_adjoint;

/* A gradient with respect to inputs becomes one with respect to what they are made of. */
static inline void fb_inputs_vjp(const fb_problem *p, fb_adjoint *a, const double t, double *wrt_inputs)
{
    const fb_kernel *const k = p->kernel;
    for (int i = 0; i < p->n_sources; ++i) {
        const fb_source *const source = p->sources + i;
        const double wrt_input = wrt_inputs[source->input];
        double *const to = a->wrt_source[i];
        wrt_inputs[source->input] = 0.0;
        if (source->table == NULL) {
            to[0] += wrt_input;
            continue;
        }
        const fb_table *const table = source->table;
        const int n = table->n_coefficients, size = table->n_intervals * n;
        if (t < table->times[0])
            to[size] += wrt_input;
        else if (t > table->times[table->n_intervals])
            to[size + 1] += wrt_input;
        else {
            double power = wrt_input;
            for (int j = n - 1; j >= 0; --j, power *= t - table->times[source->interval])
                to[source->interval * n + j] += power;
        }
    }
    if (p->n_sources == k->n_r)
        return;
    fb_problem_results(p, FB_DEFAULT_INPUT_PARTIALS, t, NULL, NULL, NULL, NULL, &a->input_jacobian);
    for (int i = 0; i < k->n_r; ++i)
        for (int j = 0; j < k->n_p && wrt_inputs[i] != 0.0; ++j)
            a->wrt_parameters[j] += a->input_jacobian[i * k->n_p + j] * wrt_inputs[i];
}

/* Takes what the kernel has put into `gradient`: the part of x is added to `wrt_state`. */
static inline void fb_take_gradient(const fb_problem *p, fb_adjoint *a, const double t, double *wrt_state)
{
    const fb_kernel *const k = p->kernel;
    for (int i = 0; i < k->n_x; ++i)
        wrt_state[i] += a->gradient[i];
    for (int i = 0; i < k->n_p; ++i)
        a->wrt_parameters[i] += a->gradient[k->n_x + i];
    if (k->n_r > 0)
        fb_inputs_vjp(p, a, t, a->gradient + k->n_x + k->n_p);
}

/* Adds f_x^T g to `wrt_state`. */
static inline int fb_rates_vjp(fb_problem *p, fb_adjoint *a, const double since, const double *x,
                               const double *wrt_rates, double *wrt_state)
{
    const fb_kernel *const k = p->kernel;
    const double t = fb_time(&p->clock, since);
    fb_fill_inputs(p, t, x);
    memcpy(a->weights, wrt_rates, (size_t)k->n_x * sizeof *wrt_rates);
    memset(a->weights + k->n_x, 0, (size_t)k->n_l * sizeof *wrt_rates);
    const int status = k->vjp(k->functions, t, x, p->constants, p->inputs, a->weights, a->gradient, p->work);
    if (status == FB_OK)
        fb_take_gradient(p, a, t, wrt_state);
    return status;
}

/* A gradient at a state that satisfies the constraints, before the state was projected. */
static inline int fb_projection_vjp(fb_problem *p, fb_adjoint *a, const double since, const double *x,
                                    double *wrt_state)
{
    const fb_kernel *const k = p->kernel;
    const double t = fb_time(&p->clock, since);
    fb_fill_inputs(p, t, x);
    memcpy(a->gradient, wrt_state, (size_t)k->n_x * sizeof *wrt_state);
    memset(a->gradient + k->n_x, 0, (size_t)(k->n_p + k->n_r) * sizeof *wrt_state);
    memset(wrt_state, 0, (size_t)k->n_x * sizeof *wrt_state);
    const int status = k->projection_vjp(k->functions, t, x, p->constants, p->inputs, a->gradient, p->work);
    if (status == FB_OK)
        fb_take_gradient(p, a, t, wrt_state);
    return status;
}

/* A gradient after a jump of the speeds becomes one before it, where the state is x: du and its derivatives as in
 * derivatives/velocity_jump.h. */
static inline int fb_jump_vjp(fb_problem *p, fb_adjoint *a, const double *x, double *wrt_state)
{
    const fb_kernel *const k = p->kernel;
    fb_velocity_jump *const jump = &a->jump;
    const int n_x = k->n_x, n_p = k->n_p, n_r = k->n_r;
    double *const g = a->gradient, *const wrt_inputs = g + n_x + n_p, *const of_rates = a->other + n_x + n_p;
    memset(a->weights, 0, (size_t)(n_x + k->n_l) * sizeof *g);
    memcpy(a->weights + k->n_q, wrt_state + k->n_q, (size_t)k->n_u * sizeof *g);
    fb_fill_jump(p, jump, x);
    fb_set_jump(p, jump, 0);
    int status = k->vjp(k->functions, jump->t_after, x, p->constants, p->inputs, a->weights, a->other, p->work);
    fb_set_jump(p, jump, 1);
    if (status == FB_OK)
        status = k->vjp(k->functions, jump->t_after, x, p->constants, p->inputs, a->weights, g, p->work);
    if (status != FB_OK)
        return status;
    for (int i = 0; i < n_x + n_p; ++i)
        g[i] -= a->other[i];
    /* the derivatives with respect to second derivatives are those with respect to the rates after, and minus those
     * before */
    for (int i = 0; i < n_r; ++i)
        if (jump->rate[i] < 0)
            wrt_inputs[i] -= of_rates[i];
    memset(of_rates, 0, (size_t)n_r * sizeof *g);
    for (int i = 0; i < n_r; ++i)
        if (jump->rate[i] >= 0) {
            of_rates[jump->rate[i]] -= wrt_inputs[i];
            wrt_inputs[jump->rate[i]] += wrt_inputs[i];
            wrt_inputs[i] = 0.0;
        }
    fb_take_gradient(p, a, jump->t_after, wrt_state);
    fb_fill_inputs(p, jump->t_before, x);
    fb_inputs_vjp(p, a, jump->t_before, of_rates);
    return FB_OK;
}

static inline void fb_add_products(const double *matrix, const double *weights, const int rows, const int columns,
                                   double *sums)
{
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < columns && weights[i] != 0.0; ++j)
            sums[j] += weights[i] * matrix[i * columns + j];
}

/* Adds the gradient with respect to x of weighted outputs to `wrt_state`. */
static inline int fb_outputs_vjp(fb_problem *p, fb_adjoint *a, const double t, const double *x,
                                 const double *wrt_outputs, double *wrt_state)
{
    const fb_kernel *const k = p->kernel;
    const int n_x = k->n_x, n_p = k->n_p, n_r = k->n_r, n_o = k->n_o;
    double *const u = a->solution, *const l = a->solution + k->n_u, *const c = p->constants, *const g = a->gradient;
    fb_fill_inputs(p, t, x);
    int status = k->accelerations(t, x, c, p->inputs, u, l, p->work);
    if (status != FB_OK)
        return status;
    memset(g, 0, (size_t)(n_x + n_p + n_r) * sizeof *g);
    fb_problem_results(p, FB_OUTPUT_STATE_PARTIALS, t, x, u, l, NULL, &a->jacobian);
    fb_add_products(a->jacobian, wrt_outputs, n_o, n_x, g);
    fb_problem_results(p, FB_OUTPUT_PARAMETER_PARTIALS, t, x, u, l, NULL, &a->jacobian);
    fb_add_products(a->jacobian, wrt_outputs, n_o, n_p, g + n_x);
    fb_problem_results(p, FB_OUTPUT_INPUT_PARTIALS, t, x, u, l, NULL, &a->jacobian);
    fb_add_products(a->jacobian, wrt_outputs, n_o, n_r, g + n_x + n_p);
    fb_take_gradient(p, a, t, wrt_state);
    double *const wrt_solution[] = {a->jacobian, a->jacobian + n_o * k->n_u};
    fb_problem_results(p, FB_OUTPUT_SOLUTION_PARTIALS, t, x, u, l, NULL, wrt_solution);
    memset(a->weights, 0, (size_t)(n_x + k->n_l) * sizeof *g);
    fb_add_products(a->jacobian, wrt_outputs, n_o, k->n_u, a->weights + k->n_q);
    fb_add_products(a->jacobian + n_o * k->n_u, wrt_outputs, n_o, k->n_l, a->weights + n_x);
    status = k->vjp(k->functions, t, x, c, p->inputs, a->weights, g, p->work);
    if (status == FB_OK)
        fb_take_gradient(p, a, t, wrt_state);
    return status;
}

/* The cost's derivative with respect to the state at a sample. */
static inline int fb_sample_vjp(fb_problem *p, fb_adjoint *a, const int64_t sample, const double *x, double *wrt_state)
{
    const int n_x = p->kernel->n_x, n_o = p->kernel->n_o;
    for (int i = 0; i < n_x; ++i)
        wrt_state[i] += a->wrt_states[sample * n_x + i];
    if (a->wrt_outputs == NULL)
        return FB_OK;
    return fb_outputs_vjp(p, a, a->output_t[sample], x, a->wrt_outputs + sample * n_o, wrt_state);
}

static inline void fb_add_scaled(const int n, const double factor, const double *from, double *to)
{
    for (int i = 0; i < n; ++i)
        to[i] += factor * from[i];
}

/* Adds the weighted gradient with respect to a combination of stages to those with respect to the stages. */
static inline void fb_spread(const fb_stepper *s, const fb_weights *w, const double factor, const double *from,
                             fb_adjoint *a)
{
    for (int j = 0; j < w->n; ++j)
        fb_add_scaled(s->n, factor * w->weight[j], from, a->wrt_stages + w->stage[j] * s->padded);
}

/* Gradients with respect to the interpolant's coefficients, its start and its end become those with respect to its
 * stages. */
static inline int fb_interpolant_vjp(fb_stepper *s, fb_adjoint *a)
{
    const fb_tableau *const m = s->tableau;
    const int n = s->n, padded = s->padded, end = m->n_stages;
    int status = FB_OK;
    const double *pieces = a->wrt_pieces;
    if (m->hermite) {
        const double *const p0 = pieces, *const p1 = pieces + padded, *const p2 = pieces + 2 * padded;
        for (int i = 0; i < n; ++i) {
            const double wrt_change = p0[i] - p1[i] + 2.0 * p2[i];
            a->wrt_end[i] += wrt_change;
            a->wrt_start[i] -= wrt_change;
            a->wrt_stages[i] += s->h * (p1[i] - p2[i]);
            a->wrt_stages[end * padded + i] -= s->h * p2[i];
        }
        pieces += 3 * padded;
    }
    for (int i = 0; i < m->n_dense; ++i)
        fb_spread(s, s->weights.dense + i, s->h, pieces + i * padded, a);
    for (int i = m->n_extra - 1; i >= 0 && status == FB_OK; --i) {
        fb_combine(s, s->weights.extra + i, s->h, s->x_old, s->x_new);
        memset(a->at, 0, (size_t)n * sizeof *a->at);
        status = fb_rates_vjp(s->problem, a, s->t_old + m->c_extra[i] * s->h, s->x_new,
                              a->wrt_stages + (end + 1 + i) * padded, a->at);
        fb_add_scaled(n, 1.0, a->at, a->wrt_start);
        fb_spread(s, s->weights.extra + i, s->h, a->at, a);
    }
    if (status == FB_OK)
        status = fb_rates_vjp(s->problem, a, s->t, s->x, a->wrt_stages + end * padded, a->wrt_end);
    return status;
}

/* The samples within a step, at states that the interpolant gives. */
static inline int fb_samples_within_vjp(fb_stepper *s, fb_adjoint *a, const int64_t first, const int64_t end)
{
    const fb_tableau *const m = s->tableau;
    const int n = s->n, n_pieces = m->n_dense + (m->hermite ? 3 : 0);
    int status = fb_evaluate(s, s->t, s->x, s->stages + m->n_stages * s->padded);
    memset(a->wrt_pieces, 0, (size_t)(n_pieces * s->padded) * sizeof *a->wrt_pieces);
    for (int64_t sample = first; sample < end && status == FB_OK; ++sample) {
        double *const at = a->at, *const wrt_sample = a->wrt_sample;
        status = fb_state_at(s, a->sample_t[sample], at);
        memset(wrt_sample, 0, (size_t)n * sizeof *wrt_sample);
        if (status == FB_OK)
            status = fb_sample_vjp(s->problem, a, sample, at, wrt_sample);
        if (status == FB_OK && s->project)
            status = fb_projection_vjp(s->problem, a, a->sample_t[sample], at, wrt_sample);
        /* the factors of fb_interpolate */
        const double y = (a->sample_t[sample] - s->t_old) / s->h;
        double factor = 1.0;
        for (int k = 0; k < n_pieces; ++k) {
            factor *= m->hermite && (n_pieces - 1 - k) % 2 ? 1.0 - y : y;
            fb_add_scaled(n, factor, wrt_sample, a->wrt_pieces + k * s->padded);
        }
        fb_add_scaled(n, 1.0, wrt_sample, a->wrt_start);
    }
    return status == FB_OK ? fb_interpolant_vjp(s, a) : status;
}

/* From the end of the step of a row to its beginning; the samples before number `*sample` belong to it. */
static inline int fb_step_vjp(fb_stepper *s, fb_adjoint *a, const int64_t row, int64_t *sample)
{
    const fb_tableau *const m = s->tableau;
    const int n = s->n, width = 2 + n, n_stages = m->n_stages;
    const double *const to = a->rows + row * width;
    int status = FB_OK;
    s->t = to[0];
    memcpy(s->x, to + 2, (size_t)n * sizeof *to);
    const int begins = to[1] == 0.0; /* the run, or a piece of it after a jump: samples differ by rounding errors */
    while (*sample > 0 && a->sample_row[*sample - 1] == row && (begins || a->sample_t[*sample - 1] == s->t) &&
           status == FB_OK)
        status = fb_sample_vjp(s->problem, a, --*sample, s->x, a->wrt_state);
    if (status == FB_OK && begins && s->project)
        status = fb_projection_vjp(s->problem, a, s->t, s->x, a->wrt_state);
    if (status == FB_OK && begins && row > 0)
        status = fb_jump_vjp(s->problem, a, to - width + 2, a->wrt_state);
    if (status != FB_OK || begins)
        return status;
    const int64_t last = *sample;
    while (*sample > 0 && a->sample_row[*sample - 1] == row)
        --*sample;
    /* the stages again */
    const double *const from = to - width;
    memcpy(s->x_old, from + 2, (size_t)n * sizeof *to);
    double *const x = s->x;
    s->t_old = s->t = from[0];
    s->x = s->x_old;
    s->h = to[1];
    s->fsal = 1;
    s->interpolant_valid = 0;
    status = fb_evaluate(s, s->t, s->x, s->stages);
    if (status == 0)
        status = fb_stages(s, s->h);
    s->x = x;
    s->t = to[0];
    memset(a->wrt_stages, 0, (size_t)((n_stages + 1 + m->n_extra) * s->padded) * sizeof *a->wrt_stages);
    memset(a->wrt_start, 0, (size_t)n * sizeof *a->wrt_start);
    memcpy(a->wrt_end, a->wrt_state, (size_t)n * sizeof *a->wrt_end);
    if (status == FB_OK && *sample < last)
        status = fb_samples_within_vjp(s, a, *sample, last);
    if (status == FB_OK && s->project)
        status = fb_projection_vjp(s->problem, a, s->t, s->x, a->wrt_end);
    fb_add_scaled(n, 1.0, a->wrt_end, a->wrt_start);
    fb_spread(s, s->weights.stage + n_stages, s->h, a->wrt_end, a);
    for (int k = n_stages - 1; k >= 0 && status == FB_OK; --k) {
        if (k > 0)
            fb_combine(s, s->weights.stage + k, s->h, s->x_old, s->x_new);
        else
            memcpy(s->x_new, s->x_old, (size_t)n * sizeof *to);
        memset(a->at, 0, (size_t)n * sizeof *a->at);
        status = fb_rates_vjp(s->problem, a, s->t_old + m->c[k] * s->h, s->x_new, a->wrt_stages + k * s->padded, a->at);
        fb_add_scaled(n, 1.0, a->at, a->wrt_start);
        if (k > 0)
            fb_spread(s, s->weights.stage + k, s->h, a->at, a);
    }
    memcpy(a->wrt_state, a->wrt_start, (size_t)n * sizeof *a->wrt_state);
    return status;
}

/* Places the results and the scratch memory, unless that is NULL; returns the number of doubles. */
static inline size_t fb_place_adjoint(const fb_stepper *s, fb_adjoint *a, double *memory)
{
    const fb_kernel *const k = s->problem->kernel;
    const int x = k->n_x, p = k->n_p, r = k->n_r, u = k->n_u, l = k->n_l, padded = s->padded;
    const int of_variables = x > p ? (x > r ? x : r) : (p > r ? p : r);
    const fb_place places[] = {
        {&a->wrt_stages, (s->tableau->n_stages + 1 + s->tableau->n_extra) * padded},
        {&a->wrt_pieces, (s->tableau->n_dense + 3) * padded},
        {&a->wrt_start, padded},
        {&a->wrt_end, padded},
        {&a->at, padded},
        {&a->wrt_sample, padded},
        {&a->wrt_state, padded},
        {&a->wrt_parameters, p},
        {&a->gradient, x + p + r},
        {&a->other, x + p + r},
        {&a->jump.before, r},
        {&a->jump.change, r},
        {&a->weights, x + l},
        {&a->solution, u + l},
        {&a->input_jacobian, r * p},
        {&a->jacobian, k->n_o * (of_variables > u + l ? of_variables : u + l)},
    };
    return fb_place_all(places, sizeof places / sizeof *places, memory);
}

#endif
