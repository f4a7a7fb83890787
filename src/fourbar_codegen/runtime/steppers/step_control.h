/* Step control: pure functions from error estimates to lengths of steps.
 *
 * Those of SciPy's RK45 and DOP853: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
 * section II.4. Lengths are positive in both directions of time.
 */
#ifndef FOURBAR_STEP_CONTROL_H
#define FOURBAR_STEP_CONTROL_H

#include <math.h>

/* Safety factor of a step's length, and limits of its change. */
#define FB_SAFETY 0.9
#define FB_MIN_FACTOR 0.2
#define FB_MAX_FACTOR 10.0

/* The smallest length of a step from t, ... */
static inline double fb_least_step(const double t, const double direction)
{
    return 10.0 * fabs(nextafter(t, direction * INFINITY) - t);
}

/* ... the first length that is tried for a proposed one, ... */
static inline double fb_first_length(const double h_abs, const double max_step, const double min_step)
{
    return h_abs > max_step ? max_step : h_abs < min_step ? min_step : h_abs;
}

/* ... the end of a step of that length, which is shortened to end at t_bound; a length that was not rejected before is
 * proposed for the step after that one. `margin`: a step that would end so near to it ends there. */
static inline double fb_step_end(const double t, double *h_abs, const double direction, const double t_bound,
                                 const double margin, const int rejected, double *proposed)
{
    double t_new = t + *h_abs * direction;
    if (direction * (t_new - t_bound) > -margin) {
        t_new = t_bound;
        *proposed = rejected ? 0.0 : *h_abs;
    }
    *h_abs = fabs(t_new - t);
    return t_new;
}

/* ... and its change, for a factor from the error estimate; NaN means an unknown error. */
static inline double fb_change(const double factor, const int taken, const int rejected)
{
    if (!taken)
        return factor > FB_MIN_FACTOR ? factor : FB_MIN_FACTOR;
    const double largest = rejected ? 1.0 : FB_MAX_FACTOR;
    return factor < largest ? factor : largest;
}

/* The factor of a step's length by which an error estimate of some order would become 1, but for the safety factor. */
static inline double fb_step_factor(const double order, const double error)
{
    return error == 0.0 ? FB_MAX_FACTOR : FB_SAFETY * pow(error, -1.0 / (order + 1.0));
}

/* The length of the explicit Euler step by which the first length is found, from the norms of x and x' in units of the
 * tolerances; ... */
static inline double fb_trial_length(const double of_state, const double of_rates, const double interval)
{
    const double length = of_state < 1e-5 || of_rates < 1e-5 ? 1e-6 : 0.01 * of_state / of_rates;
    return interval < length ? interval : length;
}

/* ... and the first length, from the norm of x'' over this step. */
static inline double fb_initial_length(const double trial, const double of_rates, const double of_second,
                                       const double order, const double interval, const double max_step)
{
    /* Compares like Python: NaN, from a trial step outside of the equations' domain, is ignored. */
    const double largest = of_second > of_rates ? of_second : of_rates;
    double length = of_rates <= 1e-15 && of_second <= 1e-15 ? (trial * 1e-3 > 1e-6 ? trial * 1e-3 : 1e-6)
                                                            : pow(0.01 / largest, 1.0 / (order + 1.0));
    length = length < 100.0 * trial ? length : 100.0 * trial;
    length = interval < length ? interval : length;
    return max_step < length ? max_step : length;
}

/* The error estimate of a step of n states from sums of squares of its parts in units of the tolerances: one sum, or
 * those of the estimates of fifth and third order of DOP853. */
static inline double fb_error_norm(const int n, const int n_errors, const double h, const double sum, const double sum3)
{
    if (n_errors < 2)
        return sqrt(sum / n);
    return sum == 0.0 && sum3 == 0.0 ? 0.0 : fabs(h) * sum / sqrt((sum + 0.01 * sum3) * n);
}

#endif
