/* A run, as all parts of the driver see it: its stepper, end, samples, events, limits and observers. */
#ifndef FOURBAR_RUN_H
#define FOURBAR_RUN_H

#include "../steppers/stepper.h"
#include "roots.h"

/* Samples at given times, or after each step. */
typedef struct fb_samples {
    const double *times; /* or NULL */
    int64_t n_times, next_time;
    double *t, *x; /* (room,) or NULL, (room, n) */
    int64_t room, n;
    int pending;  /* whether the last step's samples are still to be taken */
    double until; /* no samples after this time */
} fb_samples;

/* Singular positions: the least pivot of J, relative to its geometric mean over time. */
typedef struct fb_singular {
    double typical, integral; /* the mean, and the integral of the logarithm, ... */
    double noted;             /* ... up to this time */
    int64_t next;             /* the number of the step after which it is noted again */
    /* where the run ends: an FB_SINGULAR, the ratio to the mean, the time and the state, (padded,) */
    int how;
    double ratio, t, *x;
} fb_singular;

/* An event: a change of sign of a quantity. */
typedef struct fb_event {
    int32_t quantity, row; /* an FB_WATCHED and its number; that of a callable is the caller's */
    int32_t direction;     /* of the changes that count: to 1, to -1, or 0 for both */
    int64_t terminal;      /* the number of events that end the run, or 0 */
    int32_t at_start;      /* whether a value of zero at the start counts */
    int32_t all_roots;     /* or only changes between the ends of steps */
    /* in a run, whose memory was zeroed */
    int32_t sign;          /* the last sign, 0 before the first one */
    int32_t begins, jumps; /* whether a run has begun, and whether the function has jumped where it goes on */
    int32_t degree;        /* of its series in a part of a step; 0 if none is needed, -1 if none is known */
    double value, change;  /* at the end of what was searched of the last step, and the change there */
    double left;           /* how large it becomes where it leaves zero after a start */
    double mismatch;       /* between the ends of a step and its interpolant */
    int64_t n_found;
    double touched; /* the last time at which it was zero and had the same sign before and after, or NaN */
} fb_event;

typedef struct fb_found {
    int32_t event, jumps;
    double fraction; /* of the last step */
} fb_found;

typedef int fb_called_event(void *caller, int number, double t, const double *x, double *value);

/* What may end a run within a step: events, and det J_d. */
typedef struct fb_watch {
    int n_events;
    fb_event *events;
    fb_found *found;  /* (FB_MOST_CROSSINGS * n_events,): the events of the last part of a step */
    double *values;   /* (FB_MOST_DEGREE + 1, n_events): of the functions, at the points of that part */
    double *ends;     /* (n_events,), at the end of the step */
    double *polished; /* (n_events,), scratch */
    int is_known;     /* whether `values` has those of the whole last step for the least degree, and `ends` its ends */
    double *scratch;  /* (n_u + n_l + n_o + 12,) */
    int n_found;
    double searched; /* the fraction of the last step in which all events were found, ... */
    double length;   /* ... and that of its last part */
    int ended_by;    /* the number of the event that ends the run, or -1 */
    fb_called_event *call;
    void *caller;
    int probes;    /* whether functions are evaluated beside the run, where they may have no value */
    double *along; /* (4, padded): a state within the last step, x' there, the state at a singular position, scratch */
    double closed_at; /* the fraction of the step at which `along` is closed, or NaN where nobody asked for that */
    int look_at_all;  /* whether to examine every step */
    int is_singular;  /* whether the last step passes a singular position */
    fb_singular singular;
} fb_watch;

/* The length of the scratch that functions of events need. */
static inline int fb_event_scratch(const fb_kernel *k)
{
    return k->n_u + k->n_l + k->n_o + 12;
}

/* Places the arrays of n events, besides `along`, in memory, unless that is NULL; returns its length in doubles. */
static inline size_t fb_place_events(fb_watch *w, const int n, const int n_scratch, double *memory)
{
    const size_t of_events = (size_t)n * sizeof(fb_event) / sizeof(double);
    const size_t of_found = FB_MOST_CROSSINGS * (size_t)n * sizeof(fb_found) / sizeof(double);
    const fb_place places[] = {
        {&w->values, (FB_MOST_DEGREE + 1) * n}, {&w->ends, n}, {&w->polished, n}, {&w->scratch, n_scratch}};
    const size_t length = fb_place_all(places, sizeof places / sizeof *places, memory);
    if (memory) {
        w->n_events = n;
        w->events = (fb_event *)(void *)(memory + length);
        w->found = (fb_found *)(void *)(memory + length + of_events);
    }
    return length + of_events + of_found;
}

/* The sums of the lengths of steps and of their squares, and the first one at the last look. */
typedef struct fb_step_lengths {
    double sum, squares, looked;
} fb_step_lengths;

/* Chattering at a jump of the equations of motion. */
typedef struct fb_chattering {
    double *values; /* (4, n_conditions): of the conditions, and how fast they change, on both sides */
    fb_step_lengths lengths;
    double mean;   /* of the last steps' lengths, 0 unless these are short */
    int64_t noted; /* the number of the last step in these */
    int in_a_row;  /* looks in a row that found the run beside a jump */
    int condition; /* where the run ends: the number of the condition, and its value */
    double value;
} fb_chattering;

/* How fast a run proceeds, by which its steps are found to have collapsed. */
typedef struct fb_pace {
    double t_begin;
    int collapsed; /* whether that was reported */
    /* the steps limited by derivatives since a step, its number and time */
    int64_t n_limited, marked;
    double marked_t;
} fb_pace;

/* What observes a run. Of its functions, each of which may be NULL, those that return a status return a negative one if
 * a callback fails. */
typedef struct fb_observer {
    struct fb_observer *next; /* or NULL */
    void *of;                 /* what the functions are called with */
    /* after a step, which is repeated with a shorter one unless `error` stays below 1; errors of values that have just
     * begun to grow are in units of what they are after a time `soon` */
    int (*after_step)(void *of, fb_stepper *s, double soon, double *error);
    void (*take_back)(void *of); /* the last step is taken back */
    int (*at_sample)(void *of, fb_stepper *s, int64_t sample, double t, const double *x);
    int (*at_restart)(void *of, fb_stepper *s, int moved);             /* whether from another state */
    int (*at_end)(void *of, fb_stepper *s, double t, const double *x); /* the run ends within the last step */
    int (*is_full)(const void *of);                                    /* no other step can be taken */
} fb_observer;

/* Whether stability limits the steps of an explicit method. */
typedef struct fb_stiffness {
    int at_border, within; /* steps at the border of the region of stability, and steps within since the last of them */
    int is_stiff;
} fb_stiffness;

typedef struct fb_run {
    fb_stepper stepper;
    double direction, t_bound, t_end, max_step; /* the end of the segment, and of the run */
    double h_abs;                               /* the proposal for the next step */
    fb_samples samples;
    fb_watch watch;
    fb_pace pace;
    fb_chattering chattering;
    fb_stiffness stiffness;
    fb_observer *observers; /* the first, or NULL */
} fb_run;

/* The state at an event of those found last. */
static inline int fb_state_of_event(fb_run *r, const fb_found *found, double *x)
{
    fb_stepper *const s = &r->stepper;
    if (found->fraction != r->watch.closed_at)
        return fb_state_at(s, fb_time_of_fraction(s, found->fraction), x);
    memcpy(x, r->watch.along, (size_t)s->n * sizeof *x);
    return 0;
}

#endif
