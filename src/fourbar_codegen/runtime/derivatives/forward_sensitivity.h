/* Forward sensitivities of a run: the derivatives S of the state along directions of initial values, parameters and
 * inputs.
 *
 * The Runge-Kutta steps are differentiated as they were taken, with their lengths held (internal numerical
 * differentiation: H. G. Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", 1981). With
 * K_j = f_x S_j + f_p P at the states of the stages,
 *
 *     S_k = S + h sum_j a_kj K_j,     S_new = S + h sum_j b_j K_j.
 *
 * After a projection S is moved onto the constraints' tangent by the same orthogonal projection. What is left out is
 * proportional to the correction of the state, which is below the tolerance of the step. The embedded error estimates
 * of S limit the steps, with ten times the tolerances: where the state rests, or moves steadily, its own do not.
 * Directions of inputs are those of their tables' coefficients, which do not depend on the state.
 */
#ifndef FOURBAR_FORWARD_SENSITIVITY_H
#define FOURBAR_FORWARD_SENSITIVITY_H

#include "../run/run.h"
#include "../steppers/step_control.h"
#include "velocity_jump.h"

#include <float.h>

/* Relative tolerances of derivatives are so many times those of states, between limits; ... */
#define FB_FORWARD_SHARE 10.0
#define FB_MOST_FORWARD_RTOL 1e-2
#define FB_LEAST_FORWARD_RTOL 1e-11
/* ... absolute ones, for which there is no natural size, are for rounding errors of what is zero; ... */
#define FB_FORWARD_ATOL 1e-5
#define FB_FORWARD_ROUNDING 1e-13
#define FB_FORWARD_NOISE 1e-14
/* ... and sizes before the last step count less from step to step. */
#define FB_FORWARD_FADING 0.8

/* Blocks are so wide if that is enough. */
enum { FB_FEW_DIRECTIONS = 4 };

typedef struct fb_forward {
    int n_blocks, width; /* of blocks: FB_DIRECTIONS, or FB_FEW_DIRECTIONS if these are enough */
    int size;            /* of a row: (n_blocks, n_x, width), padded to whole FB_BLOCKs */
    /* (n_blocks, n_x + n_p + n_r, width): the rows of p are given, those of the others are filled */
    double *directions;
    /* for each source of an input NULL, or the changes of its value, or of its table's coefficients, interval by
     * interval, and then of its values before and after; rows of n_blocks * width */
    const double **source_changes;
    double *input_jacobian;       /* (n_r, n_p), dr/dp of the inputs' expressions */
    double *before;               /* (n_blocks, n_r, width): of the inputs before a jump */
    double *relative;             /* (n_blocks * width,): directions' relative changes of what is varied */
    double *lately;               /* (size,): the largest |S| of the last steps, fading */
    double *s, *s_old, *scratch;  /* (size,) */
    double *stages, *interpolant; /* as in fb_stepper, with rows of `size` */
    double *samples;              /* (room, size) */
    fb_kept kept[FB_MAX_STAGES];  /* those of fb_stepper */
    int fsal, interpolant_valid;
    int has_avx2; /* whether the processor has these instructions */
} fb_forward;

/* Derivatives have long rows: combinations and interpolants are compiled for AVX2 too, if the compiler can. */
#if defined(__x86_64__) && defined(__GNUC__)
#define FB_AVX2_FUNCTION __attribute__((target("avx2,fma")))
static inline int fb_has_avx2(void)
{
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
}
#else
#define FB_AVX2_FUNCTION
static inline int fb_has_avx2(void)
{
    return 0;
}
#endif

FB_AVX2_FUNCTION static inline void fb_combine_avx2(const double *rows, const int n, const fb_weights *w,
                                                    const double factor, const double *base, double *restrict result)
{
    fb_combine_rows(rows, n, w, factor, base, result);
}

FB_AVX2_FUNCTION static inline void fb_interpolate_avx2(const fb_tableau *m, const double *coefficients, const int n,
                                                        const int padded, const double *x_old, const double y,
                                                        double *restrict x)
{
    fb_interpolate(m, coefficients, n, padded, x_old, y, x);
}

static inline void fb_forward_combine(const fb_forward *f, const fb_weights *w, const double factor, const double *base,
                                      double *restrict result)
{
    if (f->has_avx2)
        fb_combine_avx2(f->stages, f->size, w, factor, base, result);
    else
        fb_combine_rows(f->stages, f->size, w, factor, base, result);
}

/* dr/dp of the inputs at a time; 0 for those with a source. */
static inline void fb_forward_inputs(fb_stepper *stepper, fb_forward *f, const double t)
{
    fb_problem *const p = stepper->problem;
    const int n_p = p->kernel->n_p;
    if (p->kernel->n_r == 0)
        return;
    fb_problem_results(p, FB_DEFAULT_INPUT_PARTIALS, t, NULL, NULL, NULL, NULL, &f->input_jacobian);
    for (int i = 0; i < p->n_sources; ++i)
        memset(f->input_jacobian + p->sources[i].input * n_p, 0, (size_t)n_p * sizeof *f->input_jacobian);
}

/* The directions of an input in a block, by those of its source. */
static inline void fb_source_direction(const fb_forward *f, const fb_source *source, const double *changes,
                                       const int block, const double t, double *direction)
{
    const int columns = f->n_blocks * f->width;
    const double *row = changes + block * f->width;
    const fb_table *const table = source->table;
    int n = 1;
    double since = 0.0;
    if (table && t < table->times[0])
        row += table->n_intervals * table->n_coefficients * columns;
    else if (table && t > table->times[table->n_intervals])
        row += (table->n_intervals * table->n_coefficients + 1) * columns;
    else if (table) {
        n = table->n_coefficients;
        row += source->interval * n * columns;
        since = t - table->times[source->interval];
    }
    for (int j = 0; j < f->width; ++j)
        direction[j] = row[j];
    for (int i = 1; i < n; ++i)
        for (int j = 0; j < f->width; ++j)
            direction[j] = direction[j] * since + row[i * columns + j];
}

/* The directions of a block, whose rows of x are given. Those of r follow from p, or from the sources, whose values at
 * this time were the last ones. */
static inline double *fb_forward_directions(fb_stepper *stepper, fb_forward *f, const int block, const double t,
                                            const double *s)
{
    fb_problem *const p = stepper->problem;
    const fb_kernel *const k = p->kernel;
    const int n_x = k->n_x, n_p = k->n_p, n_r = k->n_r;
    double *const directions = f->directions + block * (n_x + n_p + n_r) * f->width;
    double *const of_inputs = directions + (n_x + n_p) * f->width;
    memcpy(directions, s + block * n_x * f->width, (size_t)(n_x * f->width) * sizeof *s);
    for (int i = 0; i < n_r; ++i)
        for (int j = 0; j < f->width; ++j) {
            double sum = 0.0;
            for (int l = 0; l < n_p; ++l)
                sum += f->input_jacobian[i * n_p + l] * directions[(n_x + l) * f->width + j];
            of_inputs[i * f->width + j] = sum;
        }
    for (int i = 0; i < p->n_sources; ++i)
        if (f->source_changes[i])
            fb_source_direction(f, p->sources + i, f->source_changes[i], block, t,
                                of_inputs + p->sources[i].input * f->width);
    return directions;
}

/* A row of the derivatives' stages, f_x S + f_p P + f_r R at the state x of a row of the run's stages; NaN where the
 * equations cannot be differentiated. `is_known`: the problem's inputs and workspace are those of that row. */
static inline int fb_forward_rates(fb_stepper *stepper, fb_forward *f, const int row, const int is_known,
                                   const double since, const double *x, const double *s)
{
    fb_problem *const p = stepper->problem;
    const double t = fb_time(&p->clock, since);
    const double *const known = is_known ? stepper->stages + row * stepper->padded + p->kernel->n_q : NULL;
    double *const rates = f->stages + row * f->size;
    /* The intervals of tables are those of the last call. */
    const int called = is_known && p->n_sources == 0 ? 0 : fb_fill_inputs(p, t, x);
    if (called < 0)
        return called;
    fb_forward_inputs(stepper, f, t);
    for (int block = 0; block < f->n_blocks; ++block) {
        const int n = p->kernel->n_x * f->width;
        const double *const directions = fb_forward_directions(stepper, f, block, t, s);
        if (p->kernel->jvp(p->kernel->functions, t, x, p->constants, p->inputs, known, f->width, directions,
                           rates + block * n, p->work) != FB_OK)
            for (int i = 0; i < n; ++i)
                rates[block * n + i] = NAN;
    }
    return 0;
}

/* The same with the workspace of a kept row, in which its evaluation is, or is repeated. */
static inline int fb_forward_row(fb_stepper *stepper, fb_forward *f, const int row, const int is_known,
                                 const double since, const double *x, const double *s)
{
    fb_swap_kept(stepper->problem, stepper->kept + row);
    const int status = fb_forward_rates(stepper, f, row, is_known, since, x, s);
    fb_swap_kept(stepper->problem, stepper->kept + row);
    return status;
}

/* S after a jump of the speeds, for the state before it: the jump's derivatives are added. */
static inline int fb_forward_jump(fb_stepper *stepper, fb_forward *f, fb_velocity_jump *jump, const double *x,
                                  double *s)
{
    fb_problem *const p = stepper->problem;
    const fb_kernel *const k = p->kernel;
    const int n_r = k->n_r, first = (k->n_x + k->n_p) * f->width, n = k->n_x * f->width;
    const size_t size = (size_t)(n_r * f->width) * sizeof *s;
    int status = FB_OK;
    fb_fill_inputs(p, jump->t_before, x);
    fb_forward_inputs(stepper, f, jump->t_before);
    for (int block = 0; block < f->n_blocks; ++block)
        memcpy(f->before + block * n_r * f->width, fb_forward_directions(stepper, f, block, jump->t_before, s) + first,
               size);
    fb_fill_jump(p, jump, x);
    fb_forward_inputs(stepper, f, jump->t_after);
    for (int block = 0; block < f->n_blocks && status == FB_OK; ++block) {
        double *const directions = fb_forward_directions(stepper, f, block, jump->t_after, s);
        double *const of_inputs = directions + first;
        const double *const before = f->before + block * n_r * f->width;
        double *const rates = f->scratch + block * n, *const others = f->s_old + block * n;
        for (int jumps = 1; jumps >= 0 && status == FB_OK; --jumps) {
            fb_set_jump(p, jump, jumps);
            for (int i = 0; i < n_r; ++i)
                for (int j = 0; j < f->width && jump->rate[i] >= 0; ++j) {
                    const int place = jump->rate[i] * f->width + j;
                    of_inputs[i * f->width + j] = jumps ? of_inputs[place] - before[place] : 0.0;
                }
            status = k->jvp(k->functions, jump->t_after, x, p->constants, p->inputs, NULL, f->width, directions,
                            jumps ? rates : others, p->work);
        }
        for (int i = k->n_q * f->width; i < (k->n_q + k->n_u) * f->width; ++i)
            s[block * n + i] += rates[i] - others[i];
    }
    return status;
}

/* Moves S at a state that satisfies the constraints onto their tangent; `last` is the last call with the problem. */
static inline int fb_forward_close(fb_stepper *stepper, fb_forward *f, const double since, const enum FB_LAST last,
                                   const double *x, double *s)
{
    fb_problem *const p = stepper->problem;
    const double t = fb_time(&p->clock, since);
    const int called = last != FB_LAST_ANY && p->n_sources == 0 ? 0 : fb_fill_inputs(p, t, x);
    if (called < 0)
        return called;
    fb_forward_inputs(stepper, f, t);
    for (int block = 0; block < f->n_blocks; ++block) {
        const int n = p->kernel->n_x * f->width;
        double *const directions = fb_forward_directions(stepper, f, block, t, s);
        if (p->kernel->projection_jvp(p->kernel->functions, t, x, p->constants, p->inputs, last, f->width, directions,
                                      p->work) == FB_OK)
            memcpy(s + block * n, directions, (size_t)n * sizeof *s);
        else
            for (int i = 0; i < n; ++i)
                s[block * n + i] = NAN;
    }
    return 0;
}

/* The largest error norm of the directions in `FB_FEW_DIRECTIONS` columns from `first` on. */
static FB_INLINE double fb_forward_error_of(const fb_stepper *stepper, const fb_forward *f, const double *error,
                                            const double *error3, const double largest_x, const double soon,
                                            const int first, const double *relative)
{
    const double *const rates_old = f->stages, *const rates = f->stages + stepper->tableau->n_stages * f->size;
    double sum[FB_FEW_DIRECTIONS] = {0.0}, sum3[FB_FEW_DIRECTIONS] = {0.0}, largest[FB_FEW_DIRECTIONS] = {0.0};
    double worst = 0.0;
    for (int i = 0; i < stepper->n; ++i) {
        const double *const s = f->s + first + i * f->width;
        for (int j = 0; j < FB_FEW_DIRECTIONS; ++j)
            largest[j] = fb_max(fabs(s[j]), largest[j]);
    }
    for (int i = 0; i < stepper->n; ++i) {
        const int row = first + i * f->width;
        const double own = FB_FORWARD_SHARE * stepper->rtol[i];
        const double rtol = own < FB_LEAST_FORWARD_RTOL  ? FB_LEAST_FORWARD_RTOL
                            : own > FB_MOST_FORWARD_RTOL ? FB_MOST_FORWARD_RTOL
                                                         : own;
        const double atol = FB_FORWARD_ATOL * stepper->atol[i] + FB_FORWARD_NOISE * largest_x;
        for (int j = 0; j < FB_FEW_DIRECTIONS; ++j) {
            const double now = fabs(f->s[row + j]), before = fabs(f->s_old[row + j]);
            const double rate = fb_max(fabs(rates_old[row + j]), fabs(rates[row + j]));
            const double size = fb_max(fb_max(fb_max(now, before), f->lately[row + j]), soon * rate);
            const double scale = rtol * size + FB_FORWARD_ROUNDING * largest[j] + atol * relative[j] + DBL_MIN;
            const double part = error[row + j] / scale, part3 = error3[row + j] / scale;
            sum[j] += part * part;
            sum3[j] += part3 * part3;
        }
    }
    for (int j = 0; j < FB_FEW_DIRECTIONS; ++j) /* without those that are NaN */
        worst = fmax(worst, fb_error_norm(stepper->n, stepper->tableau->n_errors, stepper->h, sum[j], sum3[j]));
    return worst;
}

/* The error estimate of S in units of its tolerances, for the direction in which it is largest. Derivatives pass
 * through zero more often than states: each is compared with the largest value that it has had lately. */
static FB_INLINE double fb_forward_error_with(fb_stepper *stepper, fb_forward *f, const double soon)
{
    const int two = stepper->tableau->n_errors == 2;
    double *const error = f->scratch, *const error3 = f->interpolant;
    double largest_x = 0.0, worst = 0.0;
    fb_combine_rows(f->stages, f->size, stepper->weights.error, two ? 1.0 : stepper->h, NULL, error);
    if (two)
        fb_combine_rows(f->stages, f->size, stepper->weights.error + 1, 1.0, NULL, error3);
    for (int i = 0; i < stepper->n; ++i)
        largest_x = fb_max(fabs(stepper->x[i]), largest_x);
    for (int block = 0; block < f->n_blocks; ++block)
        for (int j = 0; j < f->width; j += FB_FEW_DIRECTIONS)
            worst =
                fmax(worst, fb_forward_error_of(stepper, f, error, two ? error3 : error, largest_x, soon,
                                                block * stepper->n * f->width + j, f->relative + block * f->width + j));
    return worst;
}

FB_AVX2_FUNCTION static inline double fb_forward_error_avx2(fb_stepper *stepper, fb_forward *f, const double soon)
{
    return fb_forward_error_with(stepper, f, soon);
}

static inline double fb_forward_error(fb_stepper *stepper, fb_forward *f, const double soon)
{
    return f->has_avx2 ? fb_forward_error_avx2(stepper, f, soon) : fb_forward_error_with(stepper, f, soon);
}

/* S along the last accepted step, right after it, and its error; S is that before the step unless this is below 1.
 * Sizes are at least those of rates within `soon`; any error is accepted if that is infinite. */
static inline int fb_forward_step(void *of, fb_stepper *stepper, const double soon, double *step_error)
{
    fb_forward *const f = of;
    const fb_tableau *const m = stepper->tableau;
    double *const end = f->stages + m->n_stages * f->size;
    int status = 0;
    double *const s_old = f->s;
    f->s = f->s_old;
    f->s_old = s_old;
    f->interpolant_valid = 0;
    if (f->fsal)
        memcpy(f->stages, end, (size_t)f->size * sizeof *end);
    else
        status = fb_forward_row(stepper, f, 0, 0, stepper->t_old, stepper->x_old, s_old);
    for (int k = 1; k < m->n_stages && status == 0; ++k) {
        const int is_known = k < m->n_stages - 1;
        if (!is_known)
            fb_combine(stepper, stepper->weights.stage + k, stepper->h, stepper->x_old, stepper->kept[k].x);
        fb_forward_combine(f, stepper->weights.stage + k, stepper->h, s_old, f->s);
        status =
            fb_forward_row(stepper, f, k, is_known, stepper->t_old + m->c[k] * stepper->h, stepper->kept[k].x, f->s);
    }
    fb_forward_combine(f, stepper->weights.stage + m->n_stages, stepper->h, s_old, f->s);
    /* The last evaluation was that of x' at the end. */
    if (status == 0 && stepper->project)
        status = fb_forward_close(stepper, f, stepper->t, FB_LAST_RHS, stepper->x, f->s);
    if (status == 0)
        status = fb_forward_rates(stepper, f, m->n_stages, 1, stepper->t, stepper->x, f->s);
    if (status < 0)
        return status;
    *step_error = isfinite(soon) ? fb_forward_error(stepper, f, soon) : 0.0;
    f->fsal = !(*step_error >= 1.0);
    for (int i = 0; i < f->size && f->fsal; ++i) {
        const double size = fabs(f->s[i]), faded = FB_FORWARD_FADING * f->lately[i];
        f->lately[i] = size > faded ? size : faded;
    }
    return status;
}

static inline int fb_forward_prepare_interpolant(fb_stepper *stepper, fb_forward *f)
{
    const fb_tableau *const m = stepper->tableau;
    int status = fb_prepare_interpolant(stepper);
    if (f->interpolant_valid || status < 0)
        return status;
    if (!m->hermite) {
        for (int i = 0; i < m->n_dense; ++i)
            fb_forward_combine(f, stepper->weights.dense + i, stepper->h, NULL, f->interpolant + i * f->size);
    } else {
        for (int i = 0; i < m->n_extra; ++i) {
            const int row = m->n_stages + 1 + i;
            fb_forward_combine(f, stepper->weights.extra + i, stepper->h, f->s_old, f->scratch);
            status = fb_forward_row(stepper, f, row, 1, stepper->t_old + m->c_extra[i] * stepper->h,
                                    stepper->kept[row].x, f->scratch);
            if (status < 0)
                return status;
        }
        fb_hermite_rows(f->size, stepper->h, f->s_old, f->s, f->stages, f->stages + m->n_stages * f->size,
                        f->interpolant);
        for (int i = 0; i < m->n_dense; ++i)
            fb_forward_combine(f, stepper->weights.dense + i, stepper->h, NULL, f->interpolant + (3 + i) * f->size);
    }
    f->interpolant_valid = 1;
    return 0;
}

/* S at a time in the last step, at which the state is x; `last` as above. */
static inline int fb_forward_at(fb_stepper *stepper, fb_forward *f, const double t, const enum FB_LAST last,
                                const double *x, double *s)
{
    if (t == stepper->t || !f->fsal) {
        memcpy(s, f->s, (size_t)f->size * sizeof *s);
        return 0;
    }
    const int status = fb_forward_prepare_interpolant(stepper, f);
    if (status < 0)
        return status;
    const double share = (t - stepper->t_old) / stepper->h;
    if (f->has_avx2)
        fb_interpolate_avx2(stepper->tableau, f->interpolant, f->size, f->size, f->s_old, share, s);
    else
        fb_interpolate(stepper->tableau, f->interpolant, f->size, f->size, f->s_old, share, s);
    return stepper->project ? fb_forward_close(stepper, f, t, last, x, s) : 0;
}

/* S for a sample. */
static inline int fb_forward_sample(void *of, fb_stepper *stepper, const int64_t sample, const double t,
                                    const double *x)
{
    fb_forward *const f = of;
    /* Within a step, x was projected. */
    return fb_forward_at(stepper, f, t, FB_LAST_PROJECT, x, f->samples + sample * f->size);
}

static inline void fb_forward_take_back(void *of)
{
    fb_forward *const f = of;
    double *const s = f->s;
    f->s = f->s_old;
    f->s_old = s;
    f->fsal = 0;
}

/* Goes on from the state reached; if that has moved, S moves onto the tangent of the constraints. */
static inline int fb_forward_restart(void *of, fb_stepper *stepper, const int moved)
{
    fb_forward *const f = of;
    f->fsal = 0;
    return moved && stepper->project ? fb_forward_close(stepper, f, stepper->t, FB_LAST_ANY, stepper->x, f->s) : 0;
}

/* S at the end of a run, at t, x within the last step. */
static inline int fb_forward_end(void *of, fb_stepper *stepper, const double t, const double *x)
{
    fb_forward *const f = of;
    const int status = fb_forward_at(stepper, f, t, FB_LAST_ANY, x, f->scratch);
    if (status == 0)
        memcpy(f->s, f->scratch, (size_t)f->size * sizeof *f->s);
    return status;
}

/* Without samples, derivatives only make the steps short enough for them. */
static inline fb_observer fb_forward_observer(fb_forward *f, const int with_samples)
{
    return (fb_observer){.of = f,
                         .after_step = fb_forward_step,
                         .take_back = fb_forward_take_back,
                         .at_sample = with_samples ? fb_forward_sample : NULL,
                         .at_restart = fb_forward_restart,
                         .at_end = fb_forward_end};
}

/* Places the arrays for n directions in memory, the directions first, unless that is NULL, and makes the stepper keep
 * the evaluations of its steps there; returns their number of doubles. */
static inline size_t fb_place_forward(fb_stepper *stepper, const int n, fb_forward *f, double *memory)
{
    const fb_kernel *const k = stepper->problem->kernel;
    f->width = n <= FB_FEW_DIRECTIONS ? FB_FEW_DIRECTIONS : FB_DIRECTIONS;
    f->n_blocks = (n + f->width - 1) / f->width;
    f->size = (f->n_blocks * k->n_x * f->width + FB_BLOCK - 1) / FB_BLOCK * FB_BLOCK;
    const int n_blocks = f->n_blocks, size = f->size;
    const fb_place places[] = {
        {&f->directions, n_blocks * (k->n_x + k->n_p + k->n_r) * f->width},
        {&f->input_jacobian, k->n_r * k->n_p},
        {&f->before, n_blocks * k->n_r * f->width},
        {&f->relative, n_blocks * f->width},
        {&f->lately, size},
        {&f->s, size},
        {&f->s_old, size},
        {&f->scratch, size},
        {&f->stages, (stepper->tableau->n_stages + 1 + stepper->tableau->n_extra) * size},
        {&f->interpolant, (stepper->tableau->n_dense + 3) * size},
    };
    size_t length = fb_place_all(places, sizeof places / sizeof *places, memory);
    const int work_size = (int)((k->work_size + sizeof(double) - 1) / sizeof(double));
    for (int row = 0; row <= stepper->tableau->n_stages + stepper->tableau->n_extra; ++row) {
        fb_kept *const kept = f->kept + row;
        const fb_place of_row[] = {{&kept->x, stepper->padded}, {&kept->inputs, k->n_r}, {&kept->work, work_size}};
        length += fb_place_all(of_row, sizeof of_row / sizeof *of_row, memory ? memory + length : NULL);
    }
    stepper->kept = f->kept;
    f->has_avx2 = fb_has_avx2();
    return length;
}

#endif
