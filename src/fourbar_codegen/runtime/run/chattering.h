/* Chattering: if the equations of motion jump, and lead the motion back to the jump from both sides, as dry friction
 * does where it sticks, then the motion slides along the jump (A. F. Filippov, "Differential equations with
 * discontinuous righthand sides", 1988), and a method with step control goes on in ever more steps.
 */
#ifndef FOURBAR_CHATTERING_H
#define FOURBAR_CHATTERING_H

#include "run.h"
#include "step_collapse.h"

/* A run chatters if so many looks in a row have found it beside such a jump: that is reached within the length of so
 * many of the last steps. */
enum { FB_LOOKS_IN_A_ROW = 20 };
#define FB_STEPS_TO_JUMP 20.0

/* There is a look in each FB_SHORT_STEPS steps, each time so many steps later in these: not at the same phase of a
 * periodic motion. */
enum { FB_LATER = 7 };

/* The fraction of the time to a jump over which the changes of conditions are taken. */
#define FB_AHEAD 1e-2

static inline int fb_n_conditions(const fb_run *r)
{
#ifdef FB_LIBRARY /* whose code is that of one model */
    (void)r;
    return N_CONDITIONS;
#else
    return r->stepper.problem->kernel->n_conditions;
#endif
}

/* The conditions' values at a time and state of a run. */
static inline int fb_conditions(fb_run *r, const double since, const double *x, double *values)
{
    fb_problem *const p = r->stepper.problem;
    const double t = fb_time(&p->clock, since);
    const int status = fb_fill_inputs(p, t, x);
    if (status >= 0)
        fb_problem_results(p, FB_CONDITIONS, t, x, NULL, NULL, NULL, &values);
    return status;
}

/* How fast a condition changes at a time and state of a run, along the motion: by its values there, which are given,
 * and a time later. x' is returned, too. */
static inline int fb_condition_rates(fb_run *r, const double since, const double *x, const double later,
                                     const double *values, double *rates, double *of_conditions)
{
    fb_stepper *const s = &r->stepper;
    double *const ahead = r->watch.along;
    int status = fb_evaluate(s, since, x, rates);
    for (int i = 0; i < s->n; ++i)
        ahead[i] = x[i] + later * rates[i];
    if (status >= 0)
        status = fb_conditions(r, since + later, ahead, of_conditions);
    for (int i = 0; i < fb_n_conditions(r); ++i)
        of_conditions[i] = (of_conditions[i] - values[i]) / later;
    return status;
}

/* Whether the equations lead back to the sign change of a condition from both sides of it, which the motion reaches
 * after a time, to or past it by at least another one; negative from a callback. */
static inline int fb_leads_back(fb_run *r, const int condition, const double to_jump, const double later,
                                const double *forward)
{
    fb_stepper *const s = &r->stepper;
    const int n = fb_n_conditions(r);
    double *const values = r->chattering.values + 2 * n, *const changes = values + n;
    double *const x = r->watch.singular.x, *const rates = x + s->padded;
    double sides[2];
    for (int side = 0; side < 2; ++side) {
        const double away = fabs(to_jump) > fabs(later) ? to_jump : later;
        const double by = side == 0 ? to_jump - away : to_jump + away;
        for (int i = 0; i < s->n; ++i)
            x[i] = s->x[i] + by * forward[i];
        int status = fb_conditions(r, s->t + by, x, values);
        if (status >= 0)
            status = fb_condition_rates(r, s->t + by, x, later, values, rates, changes);
        if (status < 0)
            return status;
        sides[side] = values[condition];
        if (!(values[condition] * changes[condition] * r->direction < 0.0))
            return 0;
    }
    return (sides[0] < 0.0) != (sides[1] < 0.0); /* their product may underflow */
}

/* Whether the equations jump at a condition that changes its sign within a time, and lead back to it from both sides;
 * negative from a callback. These evaluations are not counted, like those for events, and may fail. */
static inline int fb_is_beside_jump(fb_run *r, const double reach)
{
    fb_stepper *const s = &r->stepper;
    fb_chattering *const c = &r->chattering;
    const int n = fb_n_conditions(r);
    double *const values = c->values, *const changes = values + n, *const forward = r->watch.along + s->padded;
    const double later = r->direction * FB_AHEAD * reach;
    const int64_t n_evaluations = s->n_evaluations;
    int found = 0;
    if (s->problem->status != FB_OK)
        return 0;
    int status = fb_conditions(r, s->t, s->x, values);
    if (status >= 0)
        status = fb_condition_rates(r, s->t, s->x, later, values, forward, changes);
    for (int i = 0; i < n && found == 0 && status >= 0; ++i) {
        const double to_jump = -values[i] / changes[i];
        if (fabs(to_jump) <= reach && to_jump * r->direction >= 0.0) {
            status = found = fb_leads_back(r, i, to_jump, later, forward);
            c->condition = i;
            c->value = values[i];
        }
    }
    if (status >= 0) /* the workspace of the equations is that of the state reached again */
        status = fb_evaluate(s, s->t, s->x, forward);
    s->problem->status = FB_OK;
    s->n_evaluations = n_evaluations;
    return status < 0 ? status : found;
}

/* Notes the last step, and looks where steps are short: FB_RUN_PAUSED if the run goes on. */
static inline int fb_look_for_chattering(fb_run *r)
{
    fb_stepper *const s = &r->stepper;
    fb_chattering *const c = &r->chattering;
    if (fb_n_conditions(r) == 0 || s->n_steps == c->noted)
        return FB_RUN_PAUSED;
    c->noted = s->n_steps;
    const double mean = fb_short_steps(&c->lengths, s->h, s->n_steps, fabs(r->t_end - r->pace.t_begin));
    const int64_t phase = s->n_steps % FB_SHORT_STEPS;
    if (phase == 0)
        c->mean = mean;
    if (phase != FB_LATER * (s->n_steps / FB_SHORT_STEPS) % FB_SHORT_STEPS)
        return FB_RUN_PAUSED;
    const int found = c->mean > 0.0 ? fb_is_beside_jump(r, FB_STEPS_TO_JUMP * c->mean) : 0;
    c->in_a_row = found > 0 ? c->in_a_row + 1 : 0;
    return found < 0 ? found : c->in_a_row == FB_LOOKS_IN_A_ROW ? FB_RUN_CHATTERING : FB_RUN_PAUSED;
}

/* Whether the state reached, where a step fails, is beside such a jump; a step of fixed length may reach it only at its
 * end. */
static inline int fb_fails_beside_jump(fb_run *r, const int reason)
{
    const fb_step_lengths *const lengths = &r->chattering.lengths;
    if (fb_n_conditions(r) == 0 || !(lengths->sum > 0.0))
        return 0;
    return fb_is_beside_jump(r, (reason == FB_RUN_DIVERGED ? 1.0 : FB_SHORT_RATIO) * lengths->squares / lengths->sum);
}

#endif
