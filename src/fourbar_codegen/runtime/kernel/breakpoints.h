/* Breakpoints, where x' jumps or has a kink: steps end there, and inputs are evaluated on the side of the step. */
#ifndef FOURBAR_BREAKPOINTS_H
#define FOURBAR_BREAKPOINTS_H

#include "problem.h"

/* The part of a run between two boundaries: its beginning and end, by the run's clock; and the first and the last time,
 * in the order of the run, at which inputs are evaluated. */
typedef struct fb_segment {
    double t, t_bound, first, last;
} fb_segment;

/* The segment from a time towards another one, where it ends at the latest. */
typedef fb_segment fb_next_segment(void *of, double t, double t_end);

/* Times between the ends of runs, in their order, at which steps end; inputs are evaluated from `first` on, at each of
 * the times up to `before` and then from `after` on, up to `last`. */
typedef struct fb_breaks {
    int32_t n;
    const double *times, *before, *after; /* (n,) */
    double first, last;
} fb_breaks;

/* The segment behind so many of them; their times are those of the clock plus an origin. */
static inline fb_segment fb_segment_behind(const fb_breaks *b, const int n_passed, const double t, const double t_end,
                                           const double origin)
{
    return (fb_segment){.t = t,
                        .t_bound = n_passed < b->n ? b->times[n_passed] - origin : t_end,
                        .first = n_passed > 0 ? b->after[n_passed - 1] : b->first,
                        .last = n_passed < b->n ? b->before[n_passed] : b->last};
}

/* How many of them were passed. */
typedef struct fb_passed {
    const fb_breaks *breaks;
    int n;
} fb_passed;

/* An fb_next_segment of fb_passed. A segment that would end between a breakpoint and the first time after it ends at
 * that time. */
static inline fb_segment fb_segment_ahead(void *of, const double t, const double t_end)
{
    fb_passed *const passed = of;
    const fb_breaks *const b = passed->breaks;
    const double direction = t_end < t ? -1.0 : 1.0;
    while (passed->n < b->n && direction * t >= direction * b->before[passed->n])
        passed->n += 1;
    fb_segment segment = fb_segment_behind(b, passed->n, t, t_end, 0.0);
    if (passed->n < b->n && !(direction * t_end > direction * b->after[passed->n]))
        segment.t_bound = t_end;
    return segment;
}

/* Inputs are evaluated within a segment. */
static inline void fb_enter_clock(fb_clock *clock, const fb_segment *segment)
{
    clock->first = segment->first < segment->last ? segment->first : segment->last;
    clock->last = segment->first < segment->last ? segment->last : segment->first;
}

#endif
