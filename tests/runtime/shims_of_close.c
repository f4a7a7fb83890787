/* Loop closure in C for the pendulum. */
#define ALONE
#include "hand_written_pendulum.c"

enum { N_DEPENDENT_COORDINATES = 1, N_DEPENDENT_SPEEDS = 1 };
#include "kernel/loop_closure.h"

/* x, y, u_x, u_y, of which y is a guess and u_y is overwritten. */
int close_pendulum(const double *p, double *x)
{
    double constants[N_CONSTANTS], r[N_R];
    prepare(p, constants);
    default_inputs(0.0, constants, r);
    return fb_close(0.0, x, constants, r);
}

/* The least pivot of J at a state, in the units of J at another one. */
double pivot_in_units(const double *x, const double *other)
{
    const double p[N_P] = {1.0, 1.0, 1.0};
    double constants[N_CONSTANTS], r[N_R] = {0.0}, jacobian[N_C * N_U], bias[N_C];
    static fb_pivot_history history;
    memset(&history, 0, sizeof history);
    prepare(p, constants);
    velocity(0.0, other, constants, r, jacobian, bias);
    fb_note_units(jacobian, &history.units);
    return fb_least_pivot(0.0, x, constants, r, FB_LOOK_ASIDE, &history);
}

void balance(int m, int n, double *a, double *b, double *unit)
{
    fb_balance(m, n, a, b, unit);
}
