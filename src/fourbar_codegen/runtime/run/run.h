/* A run, as all parts of the driver see it: its stepper, end, samples, events, limits and observer. */
#ifndef FOURBAR_RUN_H
#define FOURBAR_RUN_H

#include "../steppers/stepper.h"

/* Samples at given times, or after each step. */
typedef struct fb_samples {
    const double *times; /* or NULL */
    long n_times, next_time;
    double *t, *x; /* (room,) or NULL, (room, n) */
    long room, n;
    int pending;  /* whether the last step's samples are still to be taken */
    double until; /* no samples after this time */
} fb_samples;

/* How the run itself finds singular positions: by the least pivot of J, relative to its geometric mean over time. */
typedef struct fb_singular {
    double (*least_pivot)(fb_stepper *s, double t, const double *x); /* or NULL: who examines the steps finds them */
    double typical, integral;                                        /* the mean, and the integral of the logarithm */
} fb_singular;

/* What may end a run within a step: outputs whose changes of sign are events, and det J_d. */
typedef struct fb_watch {
    int n_events;
    const int *output, *direction;
    double *value, *old; /* (n_events,): at the end and at the beginning of the last step */
    double *outputs;     /* (n_u + n_l + n_o,), scratch */
    double *along;       /* (2, padded): a state within the last step, and x' there */
    int look_at_all;     /* whether to examine every step */
    int toggled;         /* whether the sign of det J_d has changed in the last step */
    fb_singular singular;
} fb_watch;

/* How fast a run proceeds, by which its steps are found to have collapsed. */
typedef struct fb_pace {
    double t_begin;
    int collapsed; /* whether that was reported */
    /* the steps limited by derivatives since a step, its number and time */
    long n_limited, marked;
    double marked_t;
} fb_pace;

/* The steps taken, from which derivatives/adjoint_sensitivity.h goes backwards. A row has the time at the end of a
 * step, its length and the state; the length is 0 where the run begins, or continues from another state. */
typedef struct fb_record {
    long n, room;
    double *rows;     /* (room, 2 + n_x) */
    long *sample_row; /* for each sample in the room of fb_samples: the number of the last row, and the time */
    double *sample_t;
} fb_record;

struct fb_forward;

/* Sensitivities, by derivatives/forward_sensitivity.h: what is done after a step, which is repeated with a shorter one
 * unless the error is below 1; where the last step is taken back; for a sample at t, x, if not NULL; where the run goes
 * on, from another state if it has moved; and where it ends, at t, x within the last step. */
typedef struct fb_observer {
    struct fb_forward *forward; /* or NULL */
    int (*after_step)(fb_stepper *s, struct fb_forward *forward, double soon, double *error);
    void (*take_back)(struct fb_forward *forward);
    int (*at_sample)(fb_stepper *s, struct fb_forward *forward, long sample, double t, const double *x);
    int (*at_restart)(fb_stepper *s, struct fb_forward *forward, int moved);
    int (*at_end)(fb_stepper *s, struct fb_forward *forward, double t, const double *x);
} fb_observer;

typedef struct fb_run {
    fb_stepper stepper;
    double direction, t_bound, max_step;
    double h_abs; /* the proposal for the next step */
    fb_samples samples;
    fb_watch watch;
    fb_pace pace;
    fb_observer observer;
    fb_record *record; /* or NULL */
} fb_run;

#endif
