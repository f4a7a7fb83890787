/* Stiff equations in an explicit method: stability limits its steps, not the tolerances.
 *
 * Two states at the end of a step, that of the last stage and the one that the step takes, differ along the direction
 * in which x' changes fastest. The ratio of the changes of x' and x between them estimates the largest eigenvalue, and
 * its product with the step's length lies at the border of the method's region of stability for as long as that limits
 * the steps (E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 2nd ed. 1996, section IV.2, whose counts
 * these are).
 */
#ifndef FOURBAR_STIFFNESS_H
#define FOURBAR_STIFFNESS_H

#include "../steppers/runge_kutta.h"
#include "run.h"

/* Every so many steps there is a look, and at each step after one that was at the border. So many steps at the border
 * are stiff, if no run of so many within was between. A run of fewer steps takes no time that a method could save. */
enum { FB_STEPS_BETWEEN = 1000, FB_STIFF_STEPS = 15, FB_STEPS_WITHIN = 6 };

/* The ratio depends on units, and may be far above the eigenvalue where the two states differ in other directions: in
 * the end, so many power iterations decide. */
enum { FB_POWER_ITERATIONS = 30 };

/* The part of the region of stability, along the real axis, beyond which a step is at its border: there lengths of
 * steps vary by a tenth. */
#define FB_BORDER 0.8

/* The product of a step's length and the largest eigenvalue, as the last step shows it; NaN if it does not. */
static inline double fb_stability_measure(const fb_stepper *s)
{
    const int last = s->tableau->n_stages - 1;
    double *const x = s->x_new; /* between steps, of no one */
    fb_combine(s, s->weights.stage + last, s->h, s->x_old, x);
    return fabs(s->h) * fb_rms(s, fb_end_rates(s), s->stages + last * s->padded) / fb_rms(s, s->x, x);
}

/* The largest eigenvalue of dx'/dx at the state reached, by power iterations with differences of x'. Its size is the
 * mean growth in the last of them, since the norm turns with complex eigenvalues, and depends on units. Evaluations are
 * not counted, and may fail: then it is NaN; negative from a callback. */
static inline int fb_largest_eigenvalue(fb_run *r, double *eigenvalue)
{
    fb_stepper *const s = &r->stepper;
    const int64_t n_evaluations = s->n_evaluations;
    double *const x = r->watch.along, *const change = x + s->padded, *const rates = x + 2 * s->padded;
    double growth = 0.0;
    int status = 0;
    for (int i = 0; i < s->n; ++i)
        change[i] = s->x[i] - s->x_new[i]; /* that of the two states above */
    for (int k = 0; k < FB_POWER_ITERATIONS && status >= 0; ++k) {
        const double size = fb_rms(s, change, NULL);
        growth += k >= FB_POWER_ITERATIONS / 3 ? log(size) : 0.0;
        for (int i = 0; i < s->n; ++i)
            x[i] = s->x[i] + change[i] / size;
        status = fb_evaluate(s, s->t, x, rates);
        for (int i = 0; i < s->n; ++i)
            change[i] = rates[i] - fb_end_rates(s)[i];
    }
    if (status >= 0) /* the workspace of the equations is that of the state reached again */
        status = fb_evaluate(s, s->t, s->x, rates);
    s->problem->status = FB_OK;
    s->n_evaluations = n_evaluations;
    *eigenvalue = exp(growth / (FB_POWER_ITERATIONS - FB_POWER_ITERATIONS / 3));
    return status;
}

/* Notes whether the last step was at the border; negative from a callback. */
static inline int fb_note_stability(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_stiffness *const f = &r->stiffness;
    double eigenvalue = NAN;
    int status = 0;
    if (!(s->tableau->stability > 0.0) || f->is_stiff || (f->at_border == 0 && s->n_steps % FB_STEPS_BETWEEN != 0))
        return 0;
    if (fb_stability_measure(s) > FB_BORDER * s->tableau->stability) {
        f->within = 0;
        f->at_border += 1;
        if (f->at_border == FB_STIFF_STEPS) {
            status = fb_largest_eigenvalue(r, &eigenvalue);
            f->is_stiff = fabs(s->h) * eigenvalue > FB_BORDER * s->tableau->stability;
            f->at_border = 0;
        }
    } else if (f->at_border > 0) {
        f->within += 1;
        if (f->within == FB_STEPS_WITHIN)
            f->at_border = f->within = 0;
    }
    return status;
}

#endif
