/* Arguments and results of a kernel's functions for a batch of states, and for an ensemble of runs. */
#ifndef FOURBAR_BATCH_H
#define FOURBAR_BATCH_H

#include "../kernel/breakpoints.h"
#include "../run/run.h"
#include "../steppers/tableaus.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* An array of a batch, with a column for each state: `stride` is the number of states, or 0 if all states share the
 * values. */
typedef struct fb_batch_array {
    const double *values;
    int64_t stride;
} fb_batch_array;

static inline double fb_entry(const fb_batch_array *array, const int row, const int64_t i)
{
    return array->values[array->stride ? row * array->stride + i : row];
}

/* The right-hand side at n states. */
typedef struct fb_batch {
    const fb_kernel *kernel;
    int64_t n;
    /* (1, n), (n_x, n), (n_p, n), (n_r, n); r.values may be NULL, for the inputs' expressions */
    fb_batch_array t, x, p, r;
    double *rates; /* (n_x, n), NaN where the equations cannot be evaluated */
} fb_batch;

enum FB_MEMBER {
    FB_MEMBER_WAITING = 0,
    FB_MEMBER_DONE = 1,
    FB_MEMBER_LEFT = 2, /* has to be run alone, which handles special cases */
    FB_MEMBER_TERMINATED = 3
};

/* Events that a worker has found: rows of the member, the event, its time since the start of all runs, and the state; a
 * function that was zero without a change of sign has the event -1 - i. */
typedef struct fb_found_rows fb_found_rows;
struct fb_found_rows {
    fb_found_rows *next; /* those of another worker */
    double *rows;        /* (room, 3 + n_x) */
    int64_t n, room;
};

/* The events of an ensemble. How they are found in a run is compiled once, for all models. */
typedef struct fb_ensemble_events {
    int32_t n;
    const fb_event *events;       /* (n,), as they are before a run */
    int (*begin)(fb_run *run);    /* fb_begin_events, ... */
    int (*excludes)(fb_run *run); /* fb_excludes_events */
    int (*find)(fb_run *run);     /* and fb_find_events */
    fb_found_rows **found;        /* the first of those of all workers */
} fb_ensemble_events;

/* What all workers share: counters of members, and whether to stop early. */
typedef struct fb_counters {
    int64_t *next, *n_ended;
    const int32_t *stop;
} fb_counters;

/* n runs of an explicit Runge-Kutta method over the same time, with samples at the same times. */
typedef struct fb_ensemble {
    const fb_kernel *kernel; /* for one state */
    int64_t n;
    double *x;       /* (n, n_x): the initial states, projected onto the constraints at the start of each run */
    const double *p; /* (n, n_p) */
    int32_t n_sources;
    const fb_source *sources; /* of inputs that are not given by their expressions */
    const double *values;     /* (n, n_sources): those of sources without a table */
    const fb_tableau *method;
    int32_t project;
    double origin, t_bound, max_step; /* the start of all runs; the end, like all times of the runs, since the start */
    fb_breaks breaks;
    int64_t max_steps;         /* of each; 0 for no limit */
    const double *rtol, *atol; /* (n_x,) */
    const double *times;       /* (n_times,), in the order of the run */
    int64_t n_times;
    fb_ensemble_events events;
    double *samples;        /* (n, n_x, n_times) */
    int8_t *status;         /* (n,): FB_MEMBER */
    int64_t *n_evaluations; /* (n,) */
    fb_counters counters;
} fb_ensemble;

/* The sizes of all types passed to a model's functions for batches of states, which may have been built with other
 * headers than the caller. */
typedef struct fb_layout {
    int32_t abi_version;
    int64_t batch_functions; /* of fb_batch_functions itself: the following sizes are read only if this one agrees */
    int64_t kernel, batch, batch_array, ensemble, source, table, tableau, run;
} fb_layout;

#define FB_LAYOUT                                                                                                      \
    {.abi_version = FB_ABI_VERSION,                                                                                    \
     .batch_functions = sizeof(fb_batch_functions),                                                                    \
     .kernel = sizeof(fb_kernel),                                                                                      \
     .batch = sizeof(fb_batch),                                                                                        \
     .batch_array = sizeof(fb_batch_array),                                                                            \
     .ensemble = sizeof(fb_ensemble),                                                                                  \
     .source = sizeof(fb_source),                                                                                      \
     .table = sizeof(fb_table),                                                                                        \
     .tableau = sizeof(fb_tableau),                                                                                    \
     .run = sizeof(fb_run)}

/* A model's functions for batches of states; width 0 if the compiler has no vectors. */
struct fb_batch_functions {
    fb_layout layout;
    int32_t width;
    /* the states from begin to end; returns 0, or -1 without memory */
    int (*batch)(const fb_batch *batch, int64_t begin, int64_t end);
    /* runs members until none is waiting; returns 0, or -1 without memory. Workers call it concurrently. */
    int (*run)(const fb_ensemble *ensemble);
};

/* Whether a model's functions for batches of states were built with these headers. */
static inline int fb_batch_functions_agree(const fb_batch_functions *functions)
{
    const fb_layout own = FB_LAYOUT, *const built = &functions->layout;
    return built->abi_version == own.abi_version && built->batch_functions == own.batch_functions &&
           built->kernel == own.kernel && built->batch == own.batch && built->batch_array == own.batch_array &&
           built->ensemble == own.ensemble && built->source == own.source && built->table == own.table &&
           built->tableau == own.tableau && built->run == own.run;
}

/* The same by the kernel for single states. */
static inline int fb_batch_one_by_one(const fb_batch *b, const int64_t begin, const int64_t end)
{
    const fb_kernel *const k = b->kernel;
    const int n_x = k->n_x;
    double *const memory = malloc((size_t)(2 * n_x + k->n_p + k->n_r + k->n_constants) * sizeof(double) + k->work_size);
    if (memory == NULL)
        return -1;
    double *const x = memory, *const rates = x + n_x, *const p = rates + n_x, *const r = p + k->n_p;
    double *const constants = r + k->n_r;
    void *const work = constants + k->n_constants;
    memset(work, 0, k->work_size);
    for (int64_t i = begin; i < end; ++i) {
        const double t = b->t.values[b->t.stride ? i : 0];
        for (int j = 0; j < n_x; ++j)
            x[j] = fb_entry(&b->x, j, i);
        if (b->p.stride || i == begin) {
            for (int j = 0; j < k->n_p; ++j)
                p[j] = fb_entry(&b->p, j, i);
            k->prepare(p, constants);
        }
        if (b->r.values == NULL)
            k->default_inputs(t, constants, r);
        else
            for (int j = 0; j < k->n_r; ++j)
                r[j] = fb_entry(&b->r, j, i);
        const int status = k->rhs(t, x, constants, r, rates, work);
        for (int j = 0; j < n_x; ++j)
            b->rates[j * b->n + i] = status == FB_OK && isfinite(t) ? rates[j] : NAN;
    }
    free(memory);
    return 0;
}

#endif
