/* Loop closure in C: the dependent coordinates by Newton's method from a guess, then the dependent speeds; and the
 * distance from a singular position.
 */
#ifndef FOURBAR_LOOP_CLOSURE_H
#define FOURBAR_LOOP_CLOSURE_H

#include "../arithmetic/array.h"
#include "../fourbar_kernel.h"
#include "../linear_algebra/elimination.h"

#include <math.h>
#include <string.h>

/* Iterations of Newton's method, and how often a step of it is halved. */
enum { FB_CLOSE_STEPS = 100, FB_CLOSE_HALVINGS = 20 };

/* Violations of the position constraints, relative to their scales. */
static double fb_open(const double t, const double *x, const double *constants, const double *r, double *errors,
                      double *slopes)
{
    double scale[FB_AT_LEAST_1(N_H)], unused[2][FB_AT_LEAST_1(N_C + N_I)];
    position(t, x, constants, r, errors, slopes);
    constraint_scale(t, x, constants, r, scale, unused[0], unused[1]);
    return fb_violation(errors, scale, N_H);
}

/* Closes the loops: the last N_DEPENDENT_COORDINATES coordinates, which are guesses, by Newton's method, whose steps
 * are halved while they open the loops, and the last N_DEPENDENT_SPEEDS speeds by linear equations. */
static int fb_close(const double t, double *x, const double *constants, const double *r)
{
    enum { N_DQ = N_DEPENDENT_COORDINATES, N_DU = N_DEPENDENT_SPEEDS };
    double errors[FB_AT_LEAST_1(N_H)], slopes[FB_AT_LEAST_1(N_H * N_Q)], last;
    double matrix[FB_AT_LEAST_1(N_H * N_DQ)], unit[FB_AT_LEAST_1(N_DQ)], change[FB_AT_LEAST_1(N_DQ)];
    int order[FB_AT_LEAST_1(N_DQ)];
    if (all_finite(x, N_X) != FB_OK)
        return FB_NOT_FINITE;
    double open = N_H > 0 ? fb_open(t, x, constants, r, errors, slopes) : 0.0;
    for (int i = 0; i < FB_CLOSE_STEPS && open > FB_CLOSURE_RTOL; ++i) {
        double begin[FB_AT_LEAST_1(N_DQ)], before = open;
        for (int row = 0; row < N_H; ++row)
            for (int j = 0; j < N_DQ; ++j)
                matrix[row * N_DQ + j] = slopes[row * N_Q + N_Q - N_DQ + j];
        fb_balance(N_H, N_DQ, matrix, errors, unit);
        fb_eliminate_rows(N_H, N_DQ, 1, matrix, errors, order, change, &last);
        memcpy(begin, x + N_Q - N_DQ, N_DQ * sizeof *begin);
        double length = 1.0;
        for (int halving = 0; halving <= FB_CLOSE_HALVINGS; ++halving) {
            for (int j = 0; j < N_DQ; ++j)
                x[N_Q - N_DQ + j] = begin[j] - (unit[j] > 0.0 ? length * change[j] / unit[j] : 0.0);
            open = fb_open(t, x, constants, r, errors, slopes);
            if (open < before || before <= FB_LOOSE_CLOSURE_RTOL)
                break;
            length *= 0.5;
        }
        if (!(open < before)) { /* rounding errors, or no way on */
            if (before <= FB_LOOSE_CLOSURE_RTOL)
                break;
            return FB_NOT_CLOSED;
        }
    }
    if (!(open <= FB_LOOSE_CLOSURE_RTOL))
        return open == open ? FB_NOT_CLOSED : FB_NOT_FINITE;
    double jacobian[FB_AT_LEAST_1(N_C * N_U)], bias[FB_AT_LEAST_1(N_C)], of_speeds[FB_AT_LEAST_1(N_C * N_DU)];
    double speed_unit[FB_AT_LEAST_1(N_DU)], speeds[FB_AT_LEAST_1(N_DU)];
    int speed_order[FB_AT_LEAST_1(N_DU)];
    if (N_C == 0)
        return FB_OK;
    velocity(t, x, constants, r, jacobian, bias);
    for (int i = 0; i < N_C; ++i) {
        for (int j = 0; j < N_U - N_DU; ++j)
            bias[i] += jacobian[i * N_U + j] * x[N_Q + j];
        for (int j = 0; j < N_DU; ++j)
            of_speeds[i * N_DU + j] = jacobian[i * N_U + N_U - N_DU + j];
    }
    fb_balance(N_C, N_DU, of_speeds, bias, speed_unit);
    if (fb_eliminate_rows(N_C, N_DU, 1, of_speeds, bias, speed_order, speeds, &last) < N_DU)
        return FB_CONSTRAINTS_DEPENDENT;
    for (int j = 0; j < N_DU; ++j)
        x[N_Q + N_U - N_DU + j] = -speeds[j] / speed_unit[j];
    double position_violations[FB_AT_LEAST_1(N_C + N_I)], velocity_violations[FB_AT_LEAST_1(N_C)];
    double unused[FB_AT_LEAST_1(N_H)], position_scale[FB_AT_LEAST_1(N_C + N_I)], velocity_scale[FB_AT_LEAST_1(N_C)];
    constraint_violation(t, x, constants, r, position_violations, velocity_violations);
    constraint_scale(t, x, constants, r, unused, position_scale, velocity_scale);
    return fb_violation(velocity_violations, velocity_scale, N_C) <= FB_LOOSE_CLOSURE_RTOL ? all_finite(x, N_X)
                                                                                           : FB_CONSTRAINTS_DEPENDENT;
}

#endif
