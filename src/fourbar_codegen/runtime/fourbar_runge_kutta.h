/* One accepted step of an explicit Runge-Kutta method with an embedded estimate of its error.
 *
 * Error norm and step control are those of SciPy's RK23, RK45 and DOP853 (E. Hairer, S. P. Norsett, G. Wanner,
 * Solving Ordinary Differential Equations I, sections II.4 and II.5), so that a run takes the same steps.
 */
#ifndef FOURBAR_RUNGE_KUTTA_H
#define FOURBAR_RUNGE_KUTTA_H

#include <math.h>

/* Of the step control: by how much a step is kept shorter than the estimate allows, and changes at most. */
#define FB_SAFETY 0.9
#define FB_MIN_FACTOR 0.2
#define FB_MAX_FACTOR 10.0

enum { FB_STEP_ACCEPTED = 0, FB_STEP_TOO_SMALL = 1, FB_STEP_INFINITE = 2 };

/* x' at (t, x), not a number where it cannot be evaluated; negative stops the step and is handed on. */
typedef int (*fb_function)(void *context, double t, const double *x, double *rates);

typedef struct fb_runge_kutta {
    /* the method: s = n_stages, and the derivative at the step's end as row s of the stages */
    int n_stages;
    const double *a, *b, *c; /* (s, s) strictly lower triangular, (s,), (s,) */
    const double *error;     /* (s + 1,), or of DOP853 (2, s + 1): the weights of the error estimates */
    int n_errors;            /* 1 or 2 */
    double error_exponent;
    /* the problem */
    int n;
    fb_function function;
    void *context;
    double t_bound, direction, max_step;
    const double *rtol, *atol; /* (n,) */
    /* the step: from t with a proposed length; after it the time reached, the step taken, the next proposal */
    double t, h, h_abs;
    int n_evaluations;
} fb_runge_kutta;

/* The root mean square of the error estimate in units of the tolerances. */
static inline double fb_error_norm(const fb_runge_kutta *s, double h, const double *x, const double *x_new,
                                   const double *stages)
{
    double sum = 0.0, sum3 = 0.0;
    for (int i = 0; i < s->n; ++i) {
        const double size = fabs(x[i]), size_new = fabs(x_new[i]);
        const double scale = s->atol[i] + (size > size_new ? size : size_new) * s->rtol[i];
        double error = 0.0, error3 = 0.0;
        for (int k = 0; k <= s->n_stages; ++k) {
            error += stages[k * s->n + i] * s->error[k];
            if (s->n_errors == 2)
                error3 += stages[k * s->n + i] * s->error[s->n_stages + 1 + k];
        }
        /* The step counts before the square, which may overflow; but not in DOP853, as in SciPy. */
        const double weighted = s->n_errors == 1 ? error * h / scale : error / scale;
        sum += weighted * weighted;
        sum3 += (error3 / scale) * (error3 / scale);
    }
    if (s->n_errors == 1)
        return sqrt(sum / s->n);
    return sum == 0.0 && sum3 == 0.0 ? 0.0 : fabs(h) * sum / sqrt((sum + 0.01 * sum3) * s->n);
}

/* From x to x_new; `stages` has n_stages + 1 rows, the first of them x' at the beginning. */
static inline int fb_step(fb_runge_kutta *s, const double *x, double *x_new, double *stages)
{
    const int n = s->n;
    const double t = s->t;
    const double min_step = 10.0 * fabs(nextafter(t, s->direction * INFINITY) - t);
    double h_abs = s->h_abs > s->max_step ? s->max_step : s->h_abs < min_step ? min_step : s->h_abs;
    int rejected = 0;
    for (;;) {
        /* Also where it is not a number. */
        if (!(h_abs >= min_step))
            return FB_STEP_TOO_SMALL;
        double t_new = t + h_abs * s->direction;
        if (s->direction * (t_new - s->t_bound) > 0.0)
            t_new = s->t_bound;
        const double h = t_new - t;
        h_abs = fabs(h);
        if (!isfinite(h))
            return FB_STEP_INFINITE;
        for (int k = 1; k <= s->n_stages; ++k) {
            const double *weights = k < s->n_stages ? s->a + k * s->n_stages : s->b;
            for (int i = 0; i < n; ++i) {
                double sum = 0.0;
                for (int j = 0; j < k; ++j)
                    sum += stages[j * n + i] * weights[j];
                x_new[i] = x[i] + h * sum;
            }
            const double t_stage = k < s->n_stages ? t + s->c[k] * h : t + h;
            const int status = s->function(s->context, t_stage, x_new, stages + k * n);
            s->n_evaluations += 1;
            if (status < 0)
                return status;
        }
        const double error_norm = fb_error_norm(s, h, x, x_new, stages);
        const double factor = error_norm == 0.0 ? FB_MAX_FACTOR : FB_SAFETY * pow(error_norm, s->error_exponent);
        if (error_norm < 1.0) {
            const double largest = rejected ? 1.0 : FB_MAX_FACTOR;
            s->h_abs = h_abs * (factor < largest ? factor : largest);
            s->t = t_new;
            s->h = h;
            return FB_STEP_ACCEPTED;
        }
        h_abs *= factor > FB_MIN_FACTOR ? factor : FB_MIN_FACTOR;
        rejected = 1;
    }
}

#endif
