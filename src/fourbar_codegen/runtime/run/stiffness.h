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

#include "run.h"

/* Every so many steps there is a look, and at each step after one that was at the border. So many steps at the border
 * are stiff, if no run of so many within was between. A run of fewer steps takes no time that a method could save. */
enum { FB_STEPS_BETWEEN = 1000, FB_STIFF_STEPS = 15, FB_STEPS_WITHIN = 6 };

/* The part of the region of stability, along the real axis, beyond which a step is at its border: there lengths of
 * steps vary by a tenth. */
#define FB_BORDER 0.8

/* The product of a step's length and the largest eigenvalue, as the last step shows it; NaN if it does not. */
static inline double fb_stability_measure(const fb_stepper *s)
{
    const int last = s->tableau->n_stages - 1;
    const double *const rates = s->stages + last * s->padded, *const end = fb_end_rates(s);
    double *const x = s->x_new; /* between steps, of no one */
    double of_states = 0.0, of_rates = 0.0;
    fb_combine(s, s->weights.stage + last, s->h, s->x_old, x);
    for (int i = 0; i < s->n; ++i) {
        const double unit = s->atol[i] + s->rtol[i] * fabs(s->x[i]);
        const double state = (s->x[i] - x[i]) / unit, rate = (end[i] - rates[i]) / unit;
        of_states += state * state;
        of_rates += rate * rate;
    }
    return fabs(s->h) * sqrt(of_rates / of_states);
}

/* Notes whether the last step was at the border. */
static inline void fb_note_stability(fb_run *r)
{
    const fb_stepper *const s = &r->stepper;
    fb_stiffness *const f = &r->stiffness;
    if (!(s->tableau->stability > 0.0) || f->is_stiff || (f->at_border == 0 && s->n_steps % FB_STEPS_BETWEEN != 0))
        return;
    if (fb_stability_measure(s) > FB_BORDER * s->tableau->stability) {
        f->within = 0;
        f->at_border += 1;
        f->is_stiff = f->at_border == FB_STIFF_STEPS;
    } else if (f->at_border > 0) {
        f->within += 1;
        if (f->within == FB_STEPS_WITHIN)
            f->at_border = f->within = 0;
    }
}

#endif
