/* Radau IIA of order 5, for stiff equations: three implicit stages, with step control and a Jacobian of each step.
 *
 * The stages Z_i = x(t + c_i h) - x solve Z = h (A x I) f(x + Z) by simplified Newton iterations. In W = T^-1 Z the
 * matrix A^-1 has one real and one pair of complex eigenvalues, so that an iteration solves a real and a complex system
 * of n equations. A Jacobian costs a few evaluations of x', so that each step has its own.
 *
 * Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 2nd ed. 1996, section IV.8; the step
 * control is that of K. Gustafsson, "Control-theoretic techniques for stepsize selection in implicit Runge-Kutta
 * methods", ACM Transactions on Mathematical Software 20 (1994). Constants as in SciPy's Radau.
 */
#ifndef FOURBAR_RADAU_H
#define FOURBAR_RADAU_H

#include "../linear_algebra/shifted_equations.h"
#include "runge_kutta.h"

#include <float.h>

/* Difference quotients are over this part of a state, or of its change in a step; and over that of its tolerance. */
#define FB_STATE_CHANGE 1.5e-8
#define FB_TOLERANCE_CHANGE 0.1

enum { FB_RADAU_STAGES = 3, FB_NEWTON_ITERATIONS = 7 };

/* The eigenvalues of A^-1: a real one, and the complex one with a negative imaginary part. */
#define FB_RADAU_REAL 3.6378342527444957
#define FB_RADAU_RE 2.6810828736277521
#define FB_RADAU_IM (-3.0504301992474105)

static const double fb_radau_c[3] = {0.15505102572168219, 0.6449489742783178, 1.0};

/* Z = T W, and its inverse. */
static const double fb_radau_t[9] = {
    0.09443876248897524,
    -0.14125529502095421,
    0.03002919410514742,
    0.25021312296533332,
    0.20412935229379994,
    -0.38294211275726192,
    1.0,
    1.0,
    0.0,
};
static const double fb_radau_inverse[9] = {
    4.17871859155190428, 0.32768282076106237, 0.52337644549944951,  -4.17871859155190428, -0.32768282076106237,
    0.47662355450055044, 0.50287263494578682, -2.57192694985560522, 0.59603920482822492,
};

/* The weights of Z in the error estimate. */
static const double fb_radau_error[3] = {-10.048809399827416, 1.3821427331607489, -1.0 / 3.0};

/* The collocation polynomial: its coefficients by the stages, which are rows 1 to 3. */
static const double fb_radau_dense[15] = {
    0.0, 10.048809399827416,  -1.3821427331607489, 1.0 / 3.0,  0.0,
    0.0, -25.629591447076638, 10.296258113743304,  -8.0 / 3.0, 0.0,
    0.0, 15.580782047249222,  -8.9141153805825554, 10.0 / 3.0, 0.0,
};

/* Where (y - c_1)(y - c_2)(y - 1) y is largest: 4 y^3 - 5.4 y^2 + 1.8 y - 0.1 = 0. */
#define FB_RADAU_BETWEEN 0.86116015830076985

static const double fb_radau_none[16] = {0.0};

static const fb_tableau fb_radau_iia = {.n_stages = FB_AT_MOST(4, FB_MAX_STAGES - 1),
                                        .a = fb_radau_none,
                                        .b = fb_radau_none,
                                        .c = fb_radau_none,
                                        .order = 3.0,
                                        .n_dense = FB_AT_MOST(3, FB_MAX_DENSE),
                                        .dense = fb_radau_dense};

/* Newton's iterations begin at the polynomial of the step before. Where a force is stiff, that may be away from its
 * balance by more than what zero is, so that they diverge: where they converge from zero, so many steps begin there. */
enum { FB_STEPS_FROM_ZERO = 20 };

typedef struct fb_radau {
    const fb_function *functions; /* of the model's derivatives, or NULL: then by difference quotients */
    fb_shifted equations;         /* of the Jacobian */
    double *z, *w, *change;       /* (3, n) */
    double *rates;                /* (3, n) */
    double *last;                 /* (3, padded): the polynomial of the step before */
    double *scale, *side;         /* (n,) */
    double *stage;                /* (padded,) */
    double h_last;                /* the length of the step before, with its sign; 0 if there is none */
    double h_abs, error;          /* of the last accepted step, for the step control; 0 before the first one */
    int64_t step;                 /* the number of the step whose Jacobian it is, or -1 */
    int rejected;
    int iterations; /* of the last attempt, 0 if its equations were not solved */
    int from_zero;  /* the number of steps whose iterations begin from zero */
    int64_t n_jacobians, n_factorizations;
} fb_radau;

/* The length of the arrays for n states, in doubles. */
#define FB_RADAU_LENGTH(n) (FB_SHIFTED_LENGTH(n) + 14 * (n) + 4 * FB_PADDED(n))

/* Places the arrays in memory, unless that is NULL; returns their number of doubles. */
static inline size_t fb_place_radau(const int n, fb_radau *m, double *memory)
{
    const int padded = FB_PADDED(n);
    const fb_place places[] = {
        {&m->z, 3 * n},         {&m->w, 3 * n}, {&m->change, 3 * n}, {&m->rates, 3 * n},
        {&m->last, 3 * padded}, {&m->scale, n}, {&m->side, n},       {&m->stage, padded},
    };
    const size_t length = fb_place_all(places, sizeof places / sizeof *places, memory);
    m->step = -1;
    return length + fb_place_shifted(&m->equations, n, memory ? memory + length : NULL);
}

/* dx'/dx at the beginning of a step of length h. */
static inline int fb_radau_jacobian(fb_stepper *s, fb_radau *m, const double h)
{
    const int n = s->n;
    double *const x = m->stage, *const rates = m->rates, *const jacobian = m->equations.matrix;
    m->n_jacobians += 1;
    if (m->functions)
        return fb_problem_jacobian(s->problem, m->functions, s->t, s->x, jacobian);
    memcpy(x, s->x, (size_t)n * sizeof *x);
    for (int j = 0; j < n; ++j) {
        const double size = fb_max(fabs(s->x[j]), fabs(h * s->stages[j]));
        x[j] += copysign(fb_max(FB_STATE_CHANGE * size, FB_TOLERANCE_CHANGE * m->scale[j]), h * s->stages[j]);
        const double change = x[j] - s->x[j];
        const int status = fb_evaluate(s, s->t, x, rates);
        if (status < 0)
            return status;
        for (int i = 0; i < n; ++i)
            jacobian[i * n + j] = change != 0.0 ? (rates[i] - s->stages[i]) / change : 0.0;
        x[j] = s->x[j];
    }
    return 0;
}

/* What changes with a step: the polynomial of the one before, the units of Newton's method and the Jacobian. */
static inline int fb_begin_radau(fb_stepper *s, fb_radau *m, const double h)
{
    m->h_last = s->fsal ? s->h : 0.0;
    for (int k = 0; k < 3 && s->fsal; ++k) /* its stages are still there */
        fb_combine(s, s->weights.dense + k, s->h, NULL, m->last + k * s->padded);
    for (int i = 0; i < s->n; ++i)
        m->scale[i] = s->atol[i] + s->rtol[i] * fabs(s->x[i]);
    m->step = s->n_steps;
    m->rejected = 0;
    m->from_zero -= m->from_zero > 0;
    const int status = fb_radau_jacobian(s, m, h);
    if (status == 0)
        fb_order_shifted(&m->equations);
    return status;
}

/* The matrices of Newton's method for a step of length h; returns 0 if one is singular. */
static inline int fb_factor_radau(fb_radau *m, const double h)
{
    m->n_factorizations += 2;
    return fb_factor_shifted(&m->equations, FB_RADAU_REAL / h, FB_RADAU_RE / h, FB_RADAU_IM / h);
}

/* result = matrix rows, of three rows. */
static inline void fb_combine_three(const int n, const double *matrix, const double *rows, double *restrict result)
{
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < n; ++i)
            result[k * n + i] =
                matrix[3 * k] * rows[i] + matrix[3 * k + 1] * rows[n + i] + matrix[3 * k + 2] * rows[2 * n + i];
}

/* The stages by the polynomial of the step before, or zero. */
static inline void fb_guess_radau(const fb_stepper *s, fb_radau *m, const double h, const int is_zero)
{
    const int n = s->n;
    const double *const last = m->last;
    for (int k = 0; k < 3; ++k) {
        const double y = is_zero ? 1.0 : 1.0 + fb_radau_c[k] * h / m->h_last;
        const double a = y - 1.0, b = y * y - 1.0, c = y * y * y - 1.0;
        for (int i = 0; i < n; ++i)
            m->z[k * n + i] = is_zero ? 0.0 : a * last[i] + b * last[s->padded + i] + c * last[2 * s->padded + i];
    }
    fb_combine_three(n, fb_radau_inverse, m->z, m->w);
}

/* x' at the stages; 1 if it is finite. */
static inline int fb_radau_rates(fb_stepper *s, fb_radau *m, const double h)
{
    for (int k = 0; k < 3; ++k) {
        for (int i = 0; i < s->n; ++i)
            m->stage[i] = s->x[i] + m->z[k * s->n + i];
        const int status = fb_evaluate(s, s->t + fb_radau_c[k] * h, m->stage, m->rates + k * s->n);
        if (status < 0)
            return status;
    }
    return fb_finite(m->rates, 3 * s->n);
}

/* One iteration of Newton's method; returns the root mean square of its change in units of the tolerances. */
static inline double fb_iterate_radau(const fb_stepper *s, fb_radau *m, const double h)
{
    const int n = s->n;
    double *const f = m->change, sum = 0.0; /* T^-1 f, then the right-hand sides */
    fb_combine_three(n, fb_radau_inverse, m->rates, f);
    for (int i = 0; i < n; ++i) {
        const double re = m->w[n + i], im = m->w[2 * n + i];
        f[i] -= FB_RADAU_REAL / h * m->w[i];
        f[n + i] -= (FB_RADAU_RE * re - FB_RADAU_IM * im) / h;
        f[2 * n + i] -= (FB_RADAU_RE * im + FB_RADAU_IM * re) / h;
    }
    double *const d = m->z; /* formed anew below */
    fb_solve_shifted(&m->equations, f, d);
    fb_solve_shifted_complex(&m->equations, f + n, f + 2 * n, d + n, d + 2 * n);
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < n; ++i) {
            const double share = d[k * n + i] / m->scale[i];
            sum += share * share;
            m->w[k * n + i] += d[k * n + i];
        }
    fb_combine_three(n, fb_radau_t, m->w, m->z);
    return sqrt(sum / (3 * n));
}

/* Newton's method: 1 if it converges. */
static inline int fb_solve_radau(fb_stepper *s, fb_radau *m, const double h)
{
    double last = 0.0, rtol = 1.0;
    for (int i = 0; i < s->n; ++i)
        rtol = s->rtol[i] > 0.0 ? fb_min(rtol, s->rtol[i]) : rtol;
    const double tolerance = fb_max(10.0 * DBL_EPSILON / rtol, fb_min(0.03, sqrt(rtol)));
    /* Without a step before, the first change may be small by chance, so that the second one is no reason to give up.
     */
    const int first = m->h_last == 0.0 ? 2 : 1;
    for (int k = 0; k < FB_NEWTON_ITERATIONS; ++k) {
        const int status = fb_radau_rates(s, m, h);
        if (status <= 0)
            return status;
        const double change = fb_iterate_radau(s, m, h), rate = change / last;
        m->iterations = k + 1;
        if (change <= 1e-3 * tolerance || (k > 0 && rate < 1.0 && rate / (1.0 - rate) * change < tolerance))
            return 1;
        if (k >= first && !(pow(rate, FB_NEWTON_ITERATIONS - 1 - k) / (1.0 - rate) * change <= tolerance))
            return 0; /* also if the rate is 1 or more, or NaN */
        if (k >= first && !(rate < 1.0))
            return 0;
        last = change;
    }
    return 0;
}

/* An error in units of the tolerances: the root mean square of `change`, by the larger of both ends of a step. */
static inline double fb_radau_norm(const fb_stepper *s, const fb_radau *m)
{
    double sum = 0.0;
    for (int i = 0; i < s->n; ++i) {
        const double size = fb_max(fabs(s->x[i]), fabs(s->x_new[i]));
        const double share = m->change[i] / (s->atol[i] + s->rtol[i] * size);
        sum += share * share;
    }
    return sqrt(sum / s->n);
}

/* The error of a step in units of the tolerances, by the embedded formula, filtered by the real matrix. */
static inline int fb_radau_error_of(fb_stepper *s, fb_radau *m, const double h, double *error)
{
    const int n = s->n;
    const double *rates = s->stages;
    for (int pass = 0; pass < 2; ++pass) {
        for (int i = 0; i < n; ++i)
            m->side[i] = rates[i] + (fb_radau_error[0] * m->z[i] + fb_radau_error[1] * m->z[n + i] +
                                     fb_radau_error[2] * m->z[2 * n + i]) /
                                        h;
        fb_solve_shifted(&m->equations, m->side, m->change);
        *error = fb_radau_norm(s, m);
        if (*error < 1.0 || !(m->rejected || m->h_last == 0.0) || pass > 0)
            return 0;
        for (int i = 0; i < n; ++i)
            m->stage[i] = s->x[i] + m->change[i];
        const int status = fb_evaluate(s, s->t, m->stage, m->rates);
        if (status < 0)
            return status;
        rates = m->rates;
    }
    return 0;
}

/* The stages and the end of a step: 1 if its equations are solved. */
static inline int fb_take_radau(fb_stepper *s, fb_radau *m, const double h)
{
    const int n = s->n;
    if (!fb_factor_radau(m, h))
        return 0;
    const int is_first = m->h_last == 0.0, is_zero = is_first || m->from_zero > 0;
    fb_guess_radau(s, m, h, is_zero);
    int status = fb_solve_radau(s, m, h);
    if (status == 0 && !is_first) {
        fb_guess_radau(s, m, h, !is_zero);
        status = fb_solve_radau(s, m, h);
        m->from_zero = status > 0 ? !is_zero * FB_STEPS_FROM_ZERO : m->from_zero;
    }
    for (int i = 0; i < n && status > 0; ++i) {
        s->x_new[i] = s->x[i] + m->z[2 * n + i];
        for (int k = 0; k < 3; ++k)
            s->stages[(k + 1) * s->padded + i] = m->z[k * n + i] / h;
    }
    return status;
}

/* The error of the collocation polynomial u between its stages. Where equations are stiff, steps may be longer than the
 * motion that a state follows, whose values at the stages are right: the defect f(u) - u' there is -J times the error
 * of u, and (s I - J)^-1 of the defect is this error. It is taken where the error of u is largest at first order, so
 * that u' is right, and the defect of states that are not stiff is of higher order. */
static inline int fb_radau_between(fb_stepper *s, const double t_new, double *error)
{
    fb_radau *const m = s->own;
    const int n = s->n;
    const double h = t_new - s->t, y = FB_RADAU_BETWEEN;
    double value[3], slope[3];
    for (int k = 0; k < 3; ++k) { /* of each stage, by the columns of the dense output */
        const double a = fb_radau_dense[k + 1], b = fb_radau_dense[6 + k], c = fb_radau_dense[11 + k];
        value[k] = y * (a + y * (b + y * c));
        slope[k] = a + y * (2.0 * b + 3.0 * y * c);
    }
    for (int i = 0; i < n; ++i)
        m->stage[i] = s->x[i] + value[0] * m->z[i] + value[1] * m->z[n + i] + value[2] * m->z[2 * n + i];
    const int status = fb_evaluate(s, s->t + y * h, m->stage, m->rates);
    if (status < 0)
        return status;
    for (int i = 0; i < n; ++i)
        m->side[i] = m->rates[i] - (slope[0] * m->z[i] + slope[1] * m->z[n + i] + slope[2] * m->z[2 * n + i]) / h;
    fb_solve_shifted(&m->equations, m->side, m->change);
    const double found = fb_radau_norm(s, m);
    *error = found <= *error ? *error : found; /* also if it is NaN */
    m->rejected |= !(*error < 1.0);
    return 0;
}

static inline int fb_radau_attempt(fb_stepper *s, const double t_new, double *error)
{
    fb_radau *const m = s->own;
    const double h = t_new - s->t;
    int status = m->step == s->n_steps ? 0 : fb_begin_radau(s, m, h);
    if (status == 0)
        status = fb_take_radau(s, m, h);
    if (status <= 0) {
        m->iterations = 0;
        return status;
    }
    status = fb_radau_error_of(s, m, h, error);
    m->rejected |= !(*error < 1.0);
    return status < 0 || s->project ? status : fb_evaluate(s, t_new, s->x_new, fb_end_rates(s));
}

/* The iterations begin from zero: inputs that are held may have changed, and copies go on alike. */
static inline int fb_radau_stages(fb_stepper *s, const double h)
{
    s->fsal = 0;
    int status = fb_begin_radau(s, s->own, h);
    if (status == 0)
        status = fb_take_radau(s, s->own, h);
    if (status == 0) /* also where the equations have no value at a stage */
        return s->problem->status != FB_OK ? s->problem->status : FB_NOT_SOLVED;
    return status < 0 ? status : FB_OK;
}

static inline int fb_radau_restart(fb_stepper *s, const double t, const double *x, double *rates)
{
    ((fb_radau *)s->own)->step = -1;
    return fb_evaluate(s, t, x, rates);
}

static inline double fb_radau_length(const fb_stepper *s, const double h_abs, const double error, const int rejected)
{
    fb_radau *const m = s->own;
    const double safety = FB_SAFETY * (2 * FB_NEWTON_ITERATIONS + 1) / (2 * FB_NEWTON_ITERATIONS + m->iterations);
    if (m->iterations == 0)
        return 0.5 * h_abs;
    if (!(error < 1.0))
        return h_abs * fb_change(safety / sqrt(sqrt(error)), 0, rejected);
    const double predicted = m->h_abs > 0.0 && error > 0.0 ? h_abs / m->h_abs * sqrt(sqrt(m->error / error)) : 1.0;
    const double factor = error > 0.0 ? safety * fb_min(1.0, predicted) / sqrt(sqrt(error)) : FB_MAX_FACTOR;
    m->h_abs = h_abs;
    m->error = error;
    return h_abs * fb_change(factor, 1, rejected);
}

static const fb_method fb_radau_method = {.init = fb_runge_kutta_init,
                                          .attempt = fb_radau_attempt,
                                          .between = fb_radau_between,
                                          .stages = fb_radau_stages,
                                          .restart = fb_radau_restart,
                                          .next_length = fb_radau_length,
                                          .interpolate = fb_interpolate_step};

#endif
