/* Microseconds of a step and of a run of the exported four-bar: of the C library, of the same kernel stepped as the
 * package's Stepper does, or of its FMU's co-simulation.
 *
 * exported step ORDER | run TOLERANCE | stepper | fmu LIBRARY TOKEN TOLERANCE STEPS
 */
#include "four_bar.h"

#include "run/driver.h"
#include "four_bar_kernel.h"

#include <dlfcn.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { STEPS = 20000, RUNS = 100 };

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

static double step(const int order)
{
    static four_bar model;
    double begin;
    four_bar_init(&model);
    four_bar_close(&model);
    begin = now();
    for (int k = 0; k < STEPS; ++k)
        if (four_bar_step(&model, 1e-4, order) != 0)
            exit(1);
    return (now() - begin) / STEPS;
}

static double run(const double tolerance)
{
    static four_bar model, begin_state;
    double begin;
    four_bar_init(&begin_state);
    four_bar_close(&begin_state);
    begin = now();
    for (int k = 0; k < RUNS; ++k) {
        model = begin_state;
        if (four_bar_simulate(&model, 4.0, tolerance, tolerance, NULL, 0, NULL) != 0)
            exit(2);
    }
    return (now() - begin) / RUNS;
}

/* As runtime/integrator.pyx calls it. */
static double steps(void)
{
    static four_bar model;
    static double constants[1000], inputs[8], failed[8], moved[8], memory[20 * FB_BLOCK];
    static fb_stepper stepper;
    const fb_kernel *const kernel = fb_fastest(&four_bar_kernel);
    void *const work = calloc(1, kernel->work_size);
    fb_problem problem = {.kernel = kernel, .constants = constants, .inputs = inputs, .work = work};
    double begin;
    four_bar_init(&model);
    four_bar_close(&model);
    kernel->prepare(model.p, constants);
    problem.clock = fb_all_time;
    problem.failed_x = failed;
    problem.moved_x = moved;
    fb_place_stepper(&stepper, &fb_runge_kutta, &fb_rk4, kernel->n_x, memory);
    stepper.problem = &problem;
    stepper.project = 1;
    memcpy(stepper.x, model.x, sizeof model.x);
    begin = now();
    for (int k = 0; k < STEPS; ++k)
        if (fb_fixed_step(&stepper, 1e-4, 1e-4 * (k + 1)) != 0)
            exit(3);
    return (now() - begin) / STEPS;
}

typedef void *instance;

static double fmu(const char *library, const char *token, const double tolerance, const int steps)
{
    void *const loaded = dlopen(library, RTLD_NOW);
    if (loaded == NULL)
        exit(4);
    instance (*const make)(const char *, const char *, const char *, bool, bool, bool, bool, const unsigned *, size_t,
                           void *, void *, void *) = dlsym(loaded, "fmi3InstantiateCoSimulation");
    int (*const enter)(instance, bool, double, double, bool, double) = dlsym(loaded, "fmi3EnterInitializationMode");
    int (*const leave)(instance) = dlsym(loaded, "fmi3ExitInitializationMode");
    int (*const reset)(instance) = dlsym(loaded, "fmi3Reset");
    int (*const do_step)(instance, double, double, bool, bool *, bool *, bool *, double *) =
        dlsym(loaded, "fmi3DoStep");
    const instance f = make("", token, "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    double sum = 0.0;
    for (int k = 0; k < RUNS; ++k) {
        bool event, ends, early;
        double last, begin;
        if (f == NULL || reset(f) || enter(f, true, tolerance, 0.0, false, 0.0) || leave(f))
            exit(5);
        begin = now();
        for (int i = 0; i < steps; ++i)
            if (do_step(f, 4.0 * i / steps, 4.0 / steps, true, &event, &ends, &early, &last))
                exit(6);
        sum += now() - begin;
    }
    return sum / RUNS;
}

int main(int n, char **words)
{
    const char *const what = n > 1 ? words[1] : "";
    double found = -1.0;
    if (n == 3 && !strcmp(what, "step"))
        found = step(atoi(words[2]));
    if (n == 3 && !strcmp(what, "run"))
        found = run(atof(words[2]));
    if (n == 2 && !strcmp(what, "stepper"))
        found = steps();
    if (n == 6 && !strcmp(what, "fmu"))
        found = fmu(words[2], words[3], atof(words[4]), atoi(words[5]));
    printf("%.9g\n", found);
    return found < 0.0;
}
