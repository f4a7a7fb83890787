/* Jumps of the speeds, where the rates of prescribed motions jump.
 *
 * With the kinetic energy T = u^T M u / 2 + m^T u + T_0 and the constraints J u + b = 0, at fixed positions,
 *
 *     M du = -dm + J^T Lambda,     J du = -db.
 *
 * m and b are linear in the rates, and the equations of motion in the same way in the second derivatives. The jump du
 * is therefore u' with the jumps of the rates as second derivatives, minus u' with zeros, in which all else cancels;
 * its derivatives are those of u'.
 *
 * Source: F. Pfeiffer, C. Glocker, Multibody Dynamics with Unilateral Contacts, Wiley, 1996, section 8.2.
 */
#ifndef FOURBAR_VELOCITY_JUMP_H
#define FOURBAR_VELOCITY_JUMP_H

#include "../kernel/problem.h"

typedef struct fb_velocity_jump {
    double t_before, t_after; /* the last time of the inputs before, and the first one after */
    const int *rate;          /* (n_r,): for an input that is a second derivative, the place of the rate; or -1 */
    double *before,
        *change; /* (n_r,): the inputs before; the jumps of the rates, in the places of second derivatives */
} fb_velocity_jump;

/* The inputs are those after the jump; without callables, which prescribe no motion. */
static inline void fb_fill_jump(fb_problem *p, fb_velocity_jump *jump, const double *x)
{
    const int n_r = p->kernel->n_r;
    fb_fill_inputs(p, jump->t_before, x);
    for (int i = 0; i < n_r; ++i)
        jump->before[i] = p->inputs[i];
    fb_fill_inputs(p, jump->t_after, x);
    for (int i = 0; i < n_r; ++i)
        jump->change[i] = jump->rate[i] < 0 ? 0.0 : p->inputs[jump->rate[i]] - jump->before[jump->rate[i]];
}

/* The second derivatives of the inputs become the jumps of the rates, or 0. */
static inline void fb_set_jump(fb_problem *p, const fb_velocity_jump *jump, const int jumps)
{
    for (int i = 0; i < p->kernel->n_r; ++i)
        if (jump->rate[i] >= 0)
            p->inputs[i] = jumps ? jump->change[i] : 0.0;
}

/* The jump of the speeds, (n_u,), for a state before it; `scratch` is of the size n_u + n_l. */
static inline int fb_speed_jump(fb_problem *p, fb_velocity_jump *jump, const double *x, double *of_speeds,
                                double *scratch)
{
    const fb_kernel *const k = p->kernel;
    fb_fill_jump(p, jump, x);
    fb_set_jump(p, jump, 1);
    int status = k->accelerations(jump->t_after, x, p->constants, p->inputs, of_speeds, scratch + k->n_u, p->work);
    fb_set_jump(p, jump, 0);
    if (status == FB_OK)
        status = k->accelerations(jump->t_after, x, p->constants, p->inputs, scratch, scratch + k->n_u, p->work);
    for (int i = 0; i < k->n_u; ++i)
        of_speeds[i] -= scratch[i];
    return status;
}

#endif
