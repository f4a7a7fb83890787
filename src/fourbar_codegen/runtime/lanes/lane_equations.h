/* The equations of motion of FB_WIDTH states, a state in each SIMD lane of fb_real.
 *
 * Results of a lane are bitwise independent of the other lanes. The equations are solved as for single states, dense
 * ones with the static pivot order; a lane with too small pivots is left to the kernel for single states.
 */
#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"
#include "batch.h"
#ifndef FB_SPARSE
#include "../linear_algebra/signed_pivot.h"
#endif

#include <math.h>
#include <stdlib.h>
#include <string.h>

#ifndef N_Z
#define N_Z 0
#endif
enum { N_X = N_Q + N_U + N_Z };

#if defined(FB_SPARSE)
#include "../linear_algebra/sparse_lanes.h"
#elif defined(FB_RECURSIVE)
#include "../linear_algebra/recursive_lanes.h"
#else
#include "../linear_algebra/dense_lanes.h"
#endif

/* z', for a solution u'; it needs no multipliers. */
static FB_INLINE void fb_fill_state_rates(const fb_real t, const fb_real *restrict x, const fb_real *restrict constants,
                                          const fb_real *restrict r, fb_real *restrict rates)
{
#if N_Z > 0
    fb_real multipliers[FB_AT_LEAST_1(N_C)];
    for (int i = 0; i < N_C; ++i)
        multipliers[i] = fb_number(0.0);
    state_rates(t, x, constants, r, rates + N_Q, multipliers, rates + N_Q + N_U);
#else
    (void)t, (void)x, (void)constants, (void)r, (void)rates;
#endif
}

/* The equations of the states in the lanes, and the kernel for one state with its memory. */
typedef struct fb_lane_equations {
    const fb_kernel *kernel; /* for one state */
    fb_real constants[FB_AT_LEAST_1(N_CONSTANTS)], inputs[FB_AT_LEAST_1(N_R)];
    fb_real mass_matrix[N_MASS], forcing[N_U];
    fb_real constraint_jacobian[FB_AT_LEAST_1(N_JACOBIAN)], acceleration_bias[FB_AT_LEAST_1(N_C)];
    fb_lane_factors factors; /* of the last evaluation */
    double lane_x[N_X], lane_constants[FB_AT_LEAST_1(N_CONSTANTS)], lane_inputs[FB_AT_LEAST_1(N_R)], lane_rates[N_X];
    void *work, *memory;
} fb_lane_equations;

static inline void fb_take_lane(const fb_real *restrict from, const int lane, const int n, double *restrict to)
{
    for (int i = 0; i < n; ++i)
        to[i] = from[i][lane];
}

static inline void fb_put_lane(const double *restrict from, const int lane, const int n, fb_real *restrict to)
{
    for (int i = 0; i < n; ++i)
        to[i][lane] = from[i];
}

/* x' of one lane by the kernel for one state. */
static __attribute__((noinline)) void fb_single_rates(fb_lane_equations *s, const double t, const fb_real *x,
                                                      const int lane, fb_real *rates)
{
    fb_take_lane(x, lane, N_X, s->lane_x);
    fb_take_lane(s->constants, lane, N_CONSTANTS, s->lane_constants);
    fb_take_lane(s->inputs, lane, N_R, s->lane_inputs);
    const int status = s->kernel->rhs(t, s->lane_x, s->lane_constants, s->lane_inputs, s->lane_rates, s->work);
    if (status != FB_OK)
        for (int i = 0; i < N_X; ++i)
            s->lane_rates[i] = NAN;
    fb_put_lane(s->lane_rates, lane, N_X, rates);
}

/* Sets up the equations, for known inputs, and factors them. Not inline, so that it is compiled once, and stays in the
 * instruction cache. */
static __attribute__((noinline)) FB_FLATTEN void fb_form_lane_equations(fb_lane_equations *restrict s, const fb_real t,
                                                                        const fb_real *restrict x,
                                                                        fb_real *restrict coordinate_rates)
{
    dynamics(t, x, s->constants, s->inputs, coordinate_rates, s->mass_matrix, s->forcing, s->constraint_jacobian,
             s->acceleration_bias);
    fb_factor_lanes(s->constants, s->mass_matrix, s->constraint_jacobian, &s->factors);
}

/* x' of the requested lanes, for known inputs. */
static inline void fb_lane_rates(fb_lane_equations *restrict s, const fb_real t, const fb_real *restrict x,
                                 const fb_mask asked, fb_real *restrict rates)
{
    fb_form_lane_equations(s, t, x, rates);
    fb_solve_lanes(s->forcing, s->acceleration_bias, &s->factors, rates + N_Q);
    fb_fill_state_rates(t, x, s->constants, s->inputs, rates);
    if (fb_any(asked & ~s->factors.good))
        for (int lane = 0; lane < FB_WIDTH; ++lane)
            if (asked[lane] & ~s->factors.good[lane])
                fb_single_rates(s, t[lane], x, lane, rates);
}

static void fb_free_lane_equations(fb_lane_equations *s)
{
    if (s) {
        free(s->work);
        free(s->memory);
    }
}

/* Memory of `size` bytes that begin with an fb_lane_equations, aligned for fb_real; NULL without memory. */
static fb_lane_equations *fb_new_lane_equations(const fb_kernel *kernel, const size_t size)
{
    char *const memory = calloc(1, size + sizeof(fb_real));
    if (memory == NULL)
        return NULL;
    fb_lane_equations *const s =
        (fb_lane_equations *)(void *)(memory + (sizeof(fb_real) - (uintptr_t)memory % sizeof(fb_real)));
    s->memory = memory;
    s->kernel = kernel;
    s->work = calloc(1, kernel->work_size);
    if (s->work == NULL) {
        fb_free_lane_equations(s);
        return NULL;
    }
    return s;
}

/* FB_WIDTH states from number i on, with the last one repeated if there are fewer; contiguous states are read directly.
 */
static FB_INLINE void fb_load(const fb_batch_array *array, const int rows, const int64_t i, const int count,
                              fb_real *restrict to)
{
    double copies[FB_AT_LEAST_1(N_X + N_P + N_R)][FB_WIDTH];
    const double *from = array->values + (array->stride ? i : 0);
    int64_t apart = array->stride;
    if (apart == 0 || count < FB_WIDTH) {
        for (int row = 0; row < rows; ++row)
            for (int lane = 0; lane < FB_WIDTH; ++lane)
                copies[row][lane] = apart ? from[row * apart + (lane < count ? lane : count - 1)] : from[row];
        from = copies[0];
        apart = FB_WIDTH;
    }
    for (int row = 0; row < rows; ++row)
        memcpy(to + row, from + row * apart, sizeof *to);
}

/* Rows of FB_WIDTH numbers, from column i on. */
static FB_INLINE void fb_store_lanes(const fb_real *restrict from, const int rows, const int64_t n, const int64_t i,
                                     const int count, double *restrict to)
{
    for (int row = 0; row < rows; ++row)
        if (count == FB_WIDTH)
            memcpy(to + row * n + i, from + row, sizeof *from);
        else
            memcpy(to + row * n + i, from + row, (size_t)count * sizeof(double));
}

/* Lanes with too small pivots or rates that are not finite, by the kernel for single states. */
static __attribute__((noinline)) void fb_repair(const fb_batch *b, const int64_t i, const int count, const fb_real *t,
                                                const fb_real *x, const fb_mask *good, fb_real *rates,
                                                fb_lane_equations *s)
{
    fb_real p[FB_AT_LEAST_1(N_P)];
    fb_load(&b->p, N_P, i, count, p);
    prepare(p, s->constants);
    if (b->r.values == NULL)
        default_inputs(*t, s->constants, s->inputs);
    else
        fb_load(&b->r, N_R, i, count, s->inputs);
    for (int lane = 0; lane < FB_WIDTH; ++lane)
        if (!(*good)[lane])
            fb_single_rates(s, (*t)[lane], x, lane, rates);
    fb_mask finite = *t - *t == 0.0;
    for (int j = 0; j < N_X; ++j)
        finite &= rates[j] - rates[j] == 0.0;
    for (int j = 0; j < N_X; ++j)
        rates[j] = fb_select(finite, rates[j], fb_number(NAN));
}

/* States from begin to end, with parameters of their own or common to all. */
static FB_INLINE void fb_batch_of(const fb_batch *b, const int64_t begin, const int64_t end, const int own,
                                  fb_lane_equations *s)
{
    fb_real p[FB_AT_LEAST_1(N_P)], constants[FB_AT_LEAST_1(N_CONSTANTS)], r[FB_AT_LEAST_1(N_R)];
    if (!own) {
        fb_load(&b->p, N_P, begin, FB_WIDTH, p);
        prepare(p, constants);
    }
    /* At first as many as align the others with cache lines. */
    const uintptr_t place = (uintptr_t)((own ? b->p.values : b->x.values) + begin) / sizeof(double);
    int count = FB_WIDTH - (int)(place % FB_WIDTH);
    for (int64_t i = begin; i < end; i += count, count = FB_WIDTH) {
        count = end - i < count ? (int)(end - i) : count;
        fb_real t, x[N_X], rates[N_X], mass_matrix[N_MASS], forcing[N_U];
        fb_real constraint_jacobian[FB_AT_LEAST_1(N_JACOBIAN)], acceleration_bias[FB_AT_LEAST_1(N_C)];
        fb_lane_factors factors;
        fb_load(&b->t, 1, i, count, &t);
        fb_load(&b->x, N_X, i, count, x);
        if (own) {
            fb_load(&b->p, N_P, i, count, p);
            prepare(p, constants);
        }
        if (b->r.values == NULL)
            default_inputs(t, constants, r);
        else
            fb_load(&b->r, N_R, i, count, r);
        dynamics(t, x, constants, r, rates, mass_matrix, forcing, constraint_jacobian, acceleration_bias);
        fb_factor_lanes(constants, mass_matrix, constraint_jacobian, &factors);
        fb_solve_lanes(forcing, acceleration_bias, &factors, rates + N_Q);
        fb_fill_state_rates(t, x, constants, r, rates);
        fb_real sum = t;
        for (int j = 0; j < N_X; ++j)
            sum += rates[j];
        /* The sum may also overflow although all rates are finite; then nothing is changed. */
        if (fb_any(~(factors.good & (sum - sum == 0.0))))
            fb_repair(b, i, count, &t, x, &factors.good, rates, s);
        fb_store_lanes(rates, N_X, b->n, i, count, b->rates);
    }
}

static FB_FLATTEN int batch(const fb_batch *b, const int64_t begin, const int64_t end)
{
    if (begin >= end)
        return 0; /* without states, not even parameters can be read */
    fb_lane_equations *const s = fb_new_lane_equations(b->kernel, sizeof *s); /* for single states */
    if (s == NULL)
        return -1;
#ifdef FB_SHORT
    if (b->p.stride == 0)
        fb_batch_of(b, begin, end, 0, s);
    else
        fb_batch_of(b, begin, end, 1, s);
#else
    fb_batch_of(b, begin, end, b->p.stride != 0, s);
#endif
    fb_free_lane_equations(s);
    return 0;
}

#include "ensemble.h"

const fb_batch_functions FB_TABLE(batch_functions) = {
    .layout = FB_LAYOUT, .width = FB_WIDTH, .batch = batch, .run = run};
