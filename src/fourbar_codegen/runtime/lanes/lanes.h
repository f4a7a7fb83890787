/* Runs in SIMD lanes: what a lane holds of its run, and the time and the inputs there. */
#ifndef FOURBAR_LANES_H
#define FOURBAR_LANES_H

#include "../run/step_collapse.h"
#include "../steppers/runge_kutta.h"

/* By which changes of the sign of det J_d are found: J at the beginning of the step; the signed pivot of its columns in
 * the static pivot order, see `fb_signed_pivot`, NaN if unknown; the largest one of the run; and the units. */
typedef struct fb_lane_signs {
    fb_real jacobian_before[FB_AT_LEAST_1(N_JACOBIAN)], signed_pivot, largest_pivot;
    fb_real column_unit[N_U], row_unit[FB_AT_LEAST_1(N_C)];
} fb_lane_signs;

/* Between which times the right-hand sides are evaluated; see fb_clock. */
typedef struct fb_lane_clocks {
    fb_real first, last;
} fb_lane_clocks;

/* What finds the events of the runs in lanes. */
typedef struct fb_lane_search {
    int in_lanes;                       /* whether all functions are known in lanes */
    int needs_inputs;                   /* whether some need inputs, ... */
    int needs_outputs;                  /* ... and outputs */
    double *memory;                     /* of the following, and of the arrays of the run alone */
    double *values;                     /* (FB_LEAST_DEGREE + 1, n_events, FB_WIDTH) */
    fb_weights within[FB_LEAST_DEGREE]; /* of the interpolant's coefficients at the points within a step */
    fb_event *events;                   /* (FB_WIDTH, n_events) */
    int begins[FB_WIDTH];               /* whether a run has not taken its first step */
    fb_found_rows *found;               /* those of this worker */
    int failed;                         /* without memory */
} fb_lane_search;

typedef struct fb_lanes {
    fb_lane_equations equations; /* must come first */
    fb_real stages[FB_MAX_STAGES][N_X], interpolant[3 + FB_MAX_DENSE][N_X];
    fb_real x[N_X], t; /* the runs' states and times */
    fb_mask active;
    fb_mask n_evaluations;
    int64_t member[FB_WIDTH], next_time[FB_WIDTH], n_steps[FB_WIDTH];
    double h_abs[FB_WIDTH], bound[FB_WIDTH];
    int rejected[FB_WIDTH], next_break[FB_WIDTH];
    fb_step_lengths lengths[FB_WIDTH];
    fb_lane_clocks clocks;
    fb_lane_signs signs; /* not of sparse equations */
    fb_source sources[FB_WIDTH][FB_AT_LEAST_1(N_R)];
    /* for the beginning of a run, and for events */
    fb_problem problem;
    fb_run alone;
    fb_lane_search search;
    double rows[FB_STEPPER_ROWS * FB_PADDED(N_X)];
    double lane_failed[N_X], lane_moved[N_X];
} fb_lanes;

static inline void fb_lanes_inputs(fb_lanes *restrict c, const fb_ensemble *e, const fb_real t)
{
    if (N_R == 0)
        return;
    default_inputs(t, c->equations.constants, c->equations.inputs);
    for (int k = 0; k < e->n_sources; ++k)
        for (int lane = 0; lane < FB_WIDTH; ++lane) {
            fb_source *const source = &c->sources[lane][k];
            c->equations.inputs[source->input][lane] =
                source->table ? fb_table_value(source->table, t[lane], &source->interval) : source->value;
        }
}

/* See fb_time. */
static inline fb_real fb_lanes_time(const fb_lanes *c, const fb_ensemble *e, const fb_real since)
{
    const fb_real t = e->origin + since;
    return fb_select(t < c->clocks.first, c->clocks.first, fb_select(t > c->clocks.last, c->clocks.last, t));
}

#endif
