"""Generated kernels and the runtime's C under the sanitizers of addresses, undefined behaviour and threads."""

import os
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
import sympy as sm
from builders.exported import driven
from builders.forms import of_form
from builders.friction import MU, model_of, rod
from builders.state_equations import cartesian, motor
from builders.systems import parallelogram
from harness.programs import compile_c

import fourbar_codegen as fb

pytestmark = pytest.mark.slow

# All functions of a kernel, what follows from independent values, a projected run by each method with interpolated
# samples, and its derivatives forwards and backwards, Jacobians at a batch of states, steps of one length, the
# equations for implicit solvers, and, in batches on three threads, more states than there are lanes, more runs, with
# samples, a table and an input held, and none at all.
PROGRAM = """
#include "fourbar_kernel.h"
#include "derivatives/adjoint_sensitivity.h"
#include "steppers/ali3p.h"
#include "steppers/radau.h"
#include "lanes/batch.h"
#include "derivatives/dependent_variables.h"
#include "derivatives/forward_sensitivity.h"
#include "derivatives/implicit_residual.h"
#include "run/driver.h"
#include "run/kept_steps.h"
#include "lanes/jacobians.h"
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>

extern const fb_kernel *const tested;

static const double table_times[] = {0.0, 0.2, 0.5}, slopes_and_values[] = {15.0, 0.0, -20.0, 3.0};
static const fb_table table = {2, 2, table_times, slopes_and_values, 0.0, -3.0};

static double *doubles(const int n)
{
    double *const array = calloc((size_t)(n > 0 ? n : 1), sizeof(double));
    for (int i = 0; i < n; ++i)
        array[i] = 0.3 + 0.1 * i - 0.17 * (i % 5);
    return array;
}

static double evaluate(const fb_kernel *k, const double *p)
{
    const int n_x = k->n_x, n[3] = {n_x, k->n_p, k->n_r};
    double *x = doubles(n_x), *c = doubles(k->n_constants), *r = doubles(k->n_r), *a = doubles(k->n_u);
    double *l = doubles(k->n_l), *rates = doubles(n_x);
    void *work = calloc(1, k->work_size);
    double sum = 0.0;
    k->prepare(p, c);
    k->default_inputs(0.5, c, r);
    k->rhs(0.5, x, c, r, rates, work);
    k->accelerations(0.5, x, c, r, a, l, work);
    const fb_at at = {0.5, x, c, r, a, l, FB_DIRECTIONS};
    for (int role = 0; role < FB_N_ROLES; ++role) {
        const fb_function *const f = k->functions + role;
        const double *arguments[8];
        double *results[8];
        for (int i = 0; i < f->n_arguments; ++i)
            arguments[i] = doubles(f->arguments[i].rows * abs(f->arguments[i].columns));
        for (int i = 0; i < f->n_results; ++i)
            results[i] = doubles(f->results[i].rows * abs(f->results[i].columns));
        f->call(&at, arguments, results, work);
        for (int i = 0; i < f->n_arguments; ++i)
            free((void *)arguments[i]);
        for (int i = 0; i < f->n_results; ++i) {
            sum += f->results[i].rows * f->results[i].columns ? results[i][0] : 0.0;
            free(results[i]);
        }
    }
    for (int i = 0; i < 3; ++i) {
        double *all = doubles(n_x * n[i]), *of_l = doubles(k->n_l * n[i]);
        k->differentiate(k->functions, FB_STATE_PARTIALS + i, n[i], 0.5, x, c, r, all, NULL, work);
        k->differentiate(k->functions, FB_STATE_PARTIALS + i, n[i], 0.5, x, c, r, all, of_l, work);
        sum += n[i] ? all[0] : 0.0;
        free(all), free(of_l);
    }
    double *weights = doubles(n_x + k->n_l), *gradient = doubles(n_x + k->n_p + k->n_r);
    for (int n = 1; n <= FB_DIRECTIONS; ++n) {
        double *directions = doubles((n_x + k->n_p + k->n_r) * n), *varied = doubles(n_x * n);
        k->jvp(k->functions, 0.5, x, c, r, NULL, n, directions, varied, work);
        k->rhs(0.5, x, c, r, rates, work);
        k->jvp(k->functions, 0.5, x, c, r, rates + k->n_q, n, directions, varied, work);
        k->projection_jvp(k->functions, 0.5, x, c, r, FB_LAST_RHS, n, directions, work);
        k->projection_jvp(k->functions, 0.5, x, c, r, FB_LAST_ANY, n, directions, work);
        sum += varied[0] + directions[0];
        free(directions), free(varied);
    }
    k->vjp(k->functions, 0.5, x, c, r, weights, gradient, work);
    k->projection_vjp(k->functions, 0.5, x, c, r, gradient, work);
    sum += gradient[0];
    free(weights), free(gradient);
    int order[1];
    fb_dependent dependent = {.n_qd = k->n_q > 1, .n_ud = k->n_u > 1, .n = FB_DIRECTIONS, .order = order};
    double *const memory = doubles((int)fb_place_dependent(k, &dependent, NULL));
    fb_place_dependent(k, &dependent, memory);
    sum += fb_implicit_derivatives(k, 0.5, x, c, r, &dependent) + dependent.corrections[0] + dependent.directions[0];
    free(memory);
    k->toggled(work);
    k->project(0.5, x, c, r, 0, work);
    sum += rates[0];
    free(x), free(c), free(r), free(a), free(l), free(rates);
    free(work);
    return sum;
}

static double run(const fb_kernel *k, const double *p, const double *x0, const fb_tableau *method, const int by_table)
{
    const fb_method *const steps_of = method == &fb_trapezoid   ? &fb_augmented_lagrangian
                                      : method == &fb_radau_iia ? &fb_radau_method
                                                                : &fb_runge_kutta;
    const int n = k->n_x, padded = FB_PADDED(n);
    fb_source source = {.table = &table};
    fb_problem problem = {.kernel = k, .clock = fb_all_time, .constants = doubles(k->n_constants),
                          .inputs = doubles(k->n_r),
                          .work = calloc(1, k->work_size), .failed_x = doubles(n), .moved_x = doubles(n),
                          .sources = &source, .n_sources = by_table && k->n_r > 0};
    fb_run s = {.direction = 1.0, .t_bound = 0.5, .max_step = INFINITY};
    fb_stepper *const stepper = &s.stepper;
    const size_t length = fb_place_stepper(stepper, steps_of, method, n, NULL);
    double *const state = calloc(length + 4 * (size_t)padded, sizeof(double)), *const tolerance = doubles(n);
    double times[50], *const t = doubles(50), *const samples = doubles(50 * n);
    k->prepare(p, problem.constants);
    for (int i = 0; i < n; ++i)
        tolerance[i] = 1e-6;
    for (int i = 0; i < 50; ++i)
        times[i] = 0.01 * i;
    fb_place_stepper(stepper, steps_of, method, n, state);
    stepper->problem = &problem;
    stepper->rtol = stepper->atol = tolerance;
    stepper->project = k->n_c > 0;
    memcpy(stepper->x, x0, (size_t)n * sizeof *x0);
    s.watch.along = state + length;
    s.watch.singular.x = s.watch.along + 2 * padded;
    s.samples = (fb_samples){
        .times = times, .n_times = 50, .t = t, .x = samples, .room = 50, .pending = 1, .until = 0.5};
    if (method == &fb_rk4)
        for (int i = 0; i < 50; ++i)
            fb_fixed_step(stepper, 0.01, 0.01 * (i + 1));
    else if (method == &fb_trapezoid) {
        fb_augmented augmented;
        double *const memory = doubles((int)fb_place_augmented(k, &augmented, NULL));
        fb_place_augmented(k, &augmented, memory);
        stepper->own = &augmented;
        s.max_step = 0.01;
        fb_begin(&s);
        fb_run_on(&s, 10000);
        free(memory);
    } else if (method == &fb_radau_iia) {
        fb_radau radau = {.functions = k->functions};
        double *const memory = calloc(FB_RADAU_LENGTH(n), sizeof(double));
        fb_place_radau(n, &radau, memory);
        stepper->own = &radau;
        fb_begin(&s);
        fb_run_on(&s, 10000);
        free(memory);
    } else {
        fb_forward forward;
        const int n_directions = by_table ? 3 : FB_DIRECTIONS + 1;
        double *const varied = doubles((int)fb_place_forward(stepper, n_directions, &forward, NULL));
        fb_place_forward(stepper, n_directions, &forward, varied);
        forward.samples = doubles(50 * forward.size);
        double *const changes = doubles(6 * forward.n_blocks * forward.width);
        const double *of_sources[1] = {changes};
        forward.source_changes = of_sources;
        int *const rate = calloc((size_t)k->n_r + 1, sizeof(int));
        for (int i = 0; i < k->n_r; ++i)
            rate[i] = i == 2 ? 1 : -1;
        forward.fsal = forward.interpolant_valid = 0;
        fb_kept_steps record = {.room = 10000, .rows = doubles(10000 * (2 + n)), .sample_t = doubles(50),
                          .sample_row = calloc(50, sizeof(int64_t))};
        fb_observer differentiates = fb_forward_observer(&forward, 1), keeps = fb_kept_steps_observer(&record);
        differentiates.next = &keeps;
        s.observers = &differentiates;
        fb_keep_step(&record, stepper, 0.0);
        fb_begin(&s);
        if (by_table) { /* in two pieces */
            s.t_bound = s.samples.until = table_times[1];
            problem.clock.last = nextafter(table_times[1], 0.0);
            fb_run_on(&s, 10000);
            const fb_segment rest = {table_times[1], 0.5, nextafter(table_times[1], 1.0), INFINITY};
            fb_enter(&s, &rest, NULL);
        }
        fb_adjoint adjoint;
        double *const memory = doubles((int)fb_place_adjoint(stepper, &adjoint, NULL));
        double *const weights = doubles(50 * k->n_o), *wrt_source = doubles(6);
        double *const of_speeds = doubles(k->n_u), *const scratch = doubles(k->n_u + k->n_l);
        fb_place_adjoint(stepper, &adjoint, memory);
        adjoint.jump.t_before = nextafter(table_times[1], 0.0);
        adjoint.jump.t_after = nextafter(table_times[1], 1.0);
        adjoint.jump.rate = rate;
        if (by_table) {
            fb_speed_jump(&problem, &adjoint.jump, stepper->x, of_speeds, scratch);
            fb_forward_jump(stepper, &forward, &adjoint.jump, stepper->x, forward.s);
            fb_keep_step(&record, stepper, 0.0);
        }
        fb_run_on(&s, 10000);
        adjoint.rows = record.rows;
        adjoint.sample_row = record.sample_row;
        adjoint.sample_t = adjoint.output_t = record.sample_t;
        adjoint.wrt_states = samples;
        adjoint.wrt_outputs = k->n_o ? weights : NULL;
        adjoint.wrt_source = &wrt_source;
        int64_t sample = s.samples.n;
        const double reached = stepper->x[0];
        problem.clock = fb_all_time;
        for (int64_t row = record.n - 1; row >= 0; --row)
            fb_step_vjp(stepper, &adjoint, row, &sample);
        free(varied), free(forward.samples), free(record.rows), free(record.sample_t), free(record.sample_row);
        free(memory), free(weights), free(wrt_source), free(changes), free(rate), free(of_speeds), free(scratch);
        stepper->x[0] = reached;
    }
    const double end = stepper->x[0];
    free(problem.constants), free(problem.inputs), free(problem.work), free(problem.failed_x), free(problem.moved_x);
    free(state), free(tolerance), free(t), free(samples);
    return end;
}

static double implicit(const fb_kernel *k, const double *p, const double *x0)
{
    double sum = 0.0;
    for (int formulation = FB_INDEX_1; formulation <= FB_INDEX_3; ++formulation) {
        fb_problem problem = {.kernel = k, .clock = fb_all_time, .constants = doubles(k->n_constants),
                              .inputs = doubles(k->n_r)};
        fb_implicit s;
        double *const memory = doubles((int)fb_place_implicit(&problem, formulation, &s, NULL));
        k->prepare(p, problem.constants);
        fb_place_implicit(&problem, formulation, &s, memory);
        double *const z = doubles(s.n_y), *const rate = doubles(s.n_y), *const f = doubles(s.n_y);
        double *const matrix = doubles(s.n_y * s.n_y);
        memcpy(z, x0, (size_t)k->n_x * sizeof *x0);
        fb_implicit_scale(&s, 0.1, 10.0, z, rate, x0, x0, matrix);
        fb_implicit_residual(&s, 0.1, z, rate, f);
        fb_implicit_jacobian(&s, 0.1, 10.0, z, rate, matrix);
        sum += f[0] + matrix[0];
        free(problem.constants), free(problem.inputs), free(memory), free(z), free(rate), free(f), free(matrix);
    }
    return sum;
}

static double jacobians(const fb_kernel *k, const double *p, const double *x0)
{
    enum { N = 3 };
    const int n_y = k->n_x + k->n_l, sizes[3] = {k->n_x, k->n_p, k->n_r};
    double *const x = doubles(N * k->n_x), *const zero = doubles(N * (n_y + 1)), *const f = doubles(N * n_y);
    double *const by_x = doubles(N * n_y * n_y), *const wrt_rate = doubles(N * n_y * n_y), t[N] = {0.0, 0.1, 0.2};
    double *const by_p = doubles(N * n_y * k->n_p), *const by_r = doubles(N * n_y * k->n_r), sum = 0.0;
    char *const in_force = calloc((size_t)k->n_r + 1, 1);
    for (int i = 0; i < k->n_x; ++i)
        for (int j = 0; j < N; ++j)
            x[i * N + j] = x0[i] + 0.01 * j;
    fb_jacobians b = {.kernel = k, .n = N, .t = {t, N}, .x = {x, N}, .p = {p, 0}, .rates = {zero, N},
                      .multipliers = {zero, N}, .in_force = in_force};
    for (int i = 0; i < k->n_r; ++i)
        in_force[i] = 1;
    for (int i = 0; i < 3; ++i) {
        b.variables = i;
        b.of_rates = doubles(N * k->n_x * sizes[i]);
        b.of_outputs = doubles(N * k->n_o * sizes[i]);
        fb_evaluate_jacobians(&b, 0, N);
        sum += sizes[i] ? b.of_rates[0] : 0.0;
        free(b.of_rates), free(b.of_outputs);
    }
    b.of_rates = NULL;
    b.residual = f, b.wrt_state = by_x, b.wrt_rate = wrt_rate, b.wrt_parameters = by_p, b.wrt_inputs = by_r;
    for (b.formulation = FB_INDEX_1; b.formulation <= FB_INDEX_3; b.formulation += FB_INDEX_3 - FB_INDEX_1)
        fb_evaluate_jacobians(&b, 0, N);
    sum += f[0] + by_x[0];
    free(x), free(zero), free(f), free(by_x), free(wrt_rate), free(by_p), free(by_r), free(in_force);
    return sum;
}

typedef struct work {
    const fb_batch_functions *batch_functions;
    const fb_batch *batch;
    const fb_ensemble *ensemble;
    int64_t begin, end;
} work;

static void *on_thread(void *given)
{
    const work *const w = given;
    if (w->batch)
        w->batch_functions->batch(w->batch, w->begin, w->end);
    else
        w->batch_functions->run(w->ensemble);
    return NULL;
}

static void on_threads(const fb_kernel *k, const fb_batch *batch, const fb_ensemble *ensemble, const int64_t n)
{
    pthread_t threads[3];
    work works[3];
    if (k->batch_functions == NULL || k->batch_functions->width == 0)
        return;
    for (int i = 0; i < 3; ++i) {
        works[i] = (work){k->batch_functions, batch, ensemble, n * i / 3, n * (i + 1) / 3};
        pthread_create(threads + i, NULL, on_thread, works + i);
    }
    for (int i = 0; i < 3; ++i)
        pthread_join(threads[i], NULL);
}

static double together(const fb_kernel *k, const double *p, const double *x0, const fb_tableau *method)
{
    enum { N = 19 };
    const int n_x = k->n_x;
    double *const x = doubles(N * n_x), *const ps = doubles(N * k->n_p), *const rates = doubles(N * n_x), t[N];
    double *const samples = doubles(N * n_x * 3), *const values = doubles(N * 2), *const tolerance = doubles(n_x);
    const double times[3] = {0.0, 0.123, 0.5};
    const int stop = 0;
    int8_t status[N] = {0};
    int64_t counts[N], next = 0, ended = 0;
    double sum = 0.0;
    for (int i = 0; i < N; ++i) {
        t[i] = 0.1 * i;
        for (int j = 0; j < n_x; ++j)
            x[j * N + i] = x0[j] + 0.01 * i;
        for (int j = 0; j < k->n_p; ++j)
            ps[j * N + i] = p[j];
    }
    const fb_batch batch = {k, N, {t, N}, {x, N}, {ps, N}, {NULL, 0}, rates};
    const fb_batch held = {k, N, {t, 0}, {x, N}, {p, 0}, {NULL, 0}, rates};
    const fb_batch none = {k, 0, {t, 0}, {x + N * n_x, 0}, {ps + N * k->n_p, 0}, {NULL, 0}, rates};
    fb_batch_one_by_one(&batch, 0, N);
    on_threads(k, &batch, NULL, N);
    on_threads(k, &held, NULL, N);
    fb_batch_one_by_one(&none, 0, 0);
    on_threads(k, &none, NULL, 0);
    sum += rates[N];
    for (int i = 0; i < n_x; ++i)
        tolerance[i] = 1e-6;
    for (int i = 0; i < N; ++i) {
        memcpy(x + i * n_x, x0, (size_t)n_x * sizeof *x0);
        memcpy(ps + i * k->n_p, p, (size_t)k->n_p * sizeof *p);
    }
    x[5 * n_x] = NAN;
    const fb_source sources[] = {{.table = &table}, {.input = k->n_r - 1}};
    fb_ensemble e = {
        .kernel = k, .n = N, .x = x, .p = ps, .n_sources = k->n_r < 2 ? k->n_r : 2, .sources = sources,
        .values = values,
        .method = method, .project = k->n_c > 0, .t_bound = 0.5, .max_step = INFINITY,
        .breaks = {.n = 1, .times = table_times + 1, .before = table_times + 1, .after = table_times + 1,
                   .first = -INFINITY, .last = INFINITY},
        .rtol = tolerance, .atol = tolerance, .times = times, .n_times = 3, .samples = samples,
        .status = status, .n_evaluations = counts, .counters = {&next, &ended, &stop},
    };
    on_threads(k, NULL, &e, 0);
    sum += samples[2];
    e.n = next = ended = 0;
    on_threads(k, NULL, &e, 0);
    /* with events, first those that are known in lanes */
    const fb_event events[] = {
        {.quantity = FB_WATCHED_STATE, .all_roots = 1, .touched = NAN},
        {.quantity = FB_WATCHED_TIME, .all_roots = 1, .touched = NAN},
        {.quantity = k->n_o > 0 ? FB_WATCHED_OUTPUT : FB_WATCHED_STATE, .all_roots = 1, .terminal = 2, .touched = NAN},
        {.quantity = FB_WATCHED_ENERGY, .row = 1, .at_start = 1, .touched = NAN},
    };
    for (int i = 3; i < 5; ++i) {
        fb_found_rows *found = NULL;
        e.events = (fb_ensemble_events){i, events, fb_begin_events, fb_excludes_events, fb_find_events, &found};
        e.n = N, next = ended = 0;
        memset(status, 0, sizeof status);
        on_threads(k, NULL, &e, 0);
        while (found) {
            fb_found_rows *const rest = found->next;
            sum += (double)found->n;
            free(found->rows), free(found);
            found = rest;
        }
    }
    free(x), free(ps), free(rates), free(samples), free(values), free(tolerance);
    return sum;
}

int main(int argc, char **argv)
{
    fb_kernel own = *tested;
    fb_function functions[FB_N_ROLES];
    memcpy(functions, tested->functions, sizeof functions);
    fb_attach(functions, tested->derivatives);
    fb_attach(functions, tested->products);
    own.functions = functions;
    const fb_kernel *const k = &own;
    double *const p = doubles(k->n_p), *const x0 = doubles(k->n_x);
    if (argc != 1 + k->n_p + k->n_x)
        return 2;
    for (int i = 0; i < k->n_p; ++i)
        p[i] = atof(argv[1 + i]);
    for (int i = 0; i < k->n_x; ++i)
        x0[i] = atof(argv[1 + k->n_p + i]);
    printf("%.17g", evaluate(k, p));
    printf(" %.17g %.17g %.17g", run(k, p, x0, &fb_rk4, 0), run(k, p, x0, &fb_rk45, 0), run(k, p, x0, &fb_dop853, 0));
    printf(" %.17g %.17g", run(k, p, x0, &fb_trapezoid, 0), run(k, p, x0, &fb_radau_iia, 0));
    printf(" %.17g", run(k, p, x0, &fb_rk45, 1));
    printf(" %.17g %.17g\\n", implicit(k, p, x0), jacobians(k, p, x0));
    printf("%.17g %.17g\\n", together(k, p, x0, &fb_rk45), together(k, p, x0, &fb_dop853));
    free(p), free(x0);
    return 0;
}
"""


def sliding_rod():
    return model_of(rod(lambda n: MU * n, "sliding_rod"))


def pressed_rod():
    return model_of(rod(lambda n: MU * sm.tanh(n), "pressed_rod"))


MODELS = {
    "four_bar": (fb.models.four_bar, None),
    "slider_crank": (fb.models.slider_crank, None),
    "rolling_disc": (fb.models.rolling_disc, {"q3": 0.4}),
    "chain": (lambda: fb.models.chain(2), None),
    "recursive": (lambda: of_form("recursive in the plane"), None),
    "recursive with a loop": (lambda: of_form("recursive with a loop"), None),
    "redundant": (parallelogram, {"q_AB": 1.2}),
    "sparse": (lambda: of_form("sparse"), {"p0": 0.1}),
    "whipple_bicycle": (fb.models.whipple_bicycle, None),
    "cartesian_pendulum": (fb.models.cartesian_pendulum, {"y": 0.0}),
    "motor": (motor, None),
    "multipliers in state equations": (cartesian, None),
    "unknown forces": (sliding_rod, None),
    "unknown forces that are not linear": (pressed_rod, None),
}


CPUINFO = Path("/proc/cpuinfo")
PROCESSOR = CPUINFO.read_text(encoding="utf-8").split() if CPUINFO.is_file() else []
# What tells the number of lanes: 2, 4 or 8.
WIDTHS = [[], *([f"-m{words}"] for words in ("avx2", "avx512f") if words in PROCESSOR)]


class Program:
    """A model's sources with the program above, under a sanitizer."""

    def __init__(self, model, folder, sanitizer):
        self.model, self.folder = model, folder
        for file, text in fb.generate_sources(model).items():
            (folder / file).write_text(text)
        (folder / "common").mkdir()
        (folder / "common" / "program.c").write_text(PROGRAM)
        named = f'#include "{model.name}_kernel.h"\nconst fb_kernel *const tested = &{model.name}_kernel;\n'
        (folder / "tested.c").write_text(named)
        # Optimization would only take away what the sanitizers look at, and takes them a minute for the bicycle.
        self.command = [os.environ.get("CC", "cc"), "-std=c11", "-O0", "-g", f"-fsanitize={sanitizer}", "-pthread"]
        self.command += ["-fno-sanitize-recover=all"]
        self.batch_functions = folder / f"{model.name}_batch.c"
        self.objects = [self.compiled(path) for path in sorted(folder.glob("*.c")) if path != self.batch_functions]
        # It is the same for all models, so that it is compiled once.
        self.objects.append(self.compiled(folder / "common" / "program.c", include=[fb.get_include()]))

    def compiled(self, path, *flags, include=None):
        compile_c([*self.command, *flags, "-c"], [path], f"{path}.o", include or [fb.get_include(), self.folder])
        return f"{path}.o"

    def run(self, flags, values):
        """What it prints, with the functions for batches of states compiled with more flags."""
        batch = [self.compiled(self.batch_functions, *flags)] if self.batch_functions.is_file() else []
        program = str(self.folder / "program")
        subprocess.run([*self.command, *self.objects, *batch, "-o", program, "-lm"], check=True)
        done = subprocess.run([program, *values], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return [float(word) for word in done.stdout.split()]


def arguments(compiled, x0):
    return [repr(float(value)) for value in (*compiled.defaults.values(), *x0)]


@pytest.mark.parametrize("name", MODELS)
def test_kernels_and_runs_under_address_sanitizers_end_as_in_python(tmp_path, name):
    make, coordinates = MODELS[name]
    model = make()
    program = Program(model, tmp_path, "address,undefined")
    compiled = fb.compile_model(model)
    x0 = compiled.initial_state(coordinates)
    for flags in WIDTHS:
        numbers = program.run(flags, arguments(compiled, x0))
    # The same runs by the package, built without sanitizers; rounding differs with the flags.
    _, _, *ends, by_table, _, _, _, _ = numbers
    table = {name: ([0.0, 0.2, 0.5], [0.0, 3.0, -3.0]) for name in compiled.inputs[:1]}
    for method, end, inputs in zip(
        ("RK45", "DOP853", "ALI3P", "Radau", "RK45"), (*ends, by_table), (*4 * [None], table), strict=True
    ):
        if method == "ALI3P" and compiled.n_l > compiled.n_c:
            continue
        how = {"method": method, "rtol": 1e-6, "atol": 1e-6, "max_step": 0.01 if method == "ALI3P" else np.inf}
        run = compiled.simulate((0.0, 0.5), x0, inputs=inputs, **how)
        assert end == pytest.approx(run.y[0, -1], rel=1e-6, abs=1e-8)


def test_kernel_in_threads_under_the_thread_sanitizer_has_no_races(tmp_path, four_bar):
    Program(fb.models.four_bar(), tmp_path, "thread").run([], arguments(four_bar, four_bar.initial_state()))


# Serialized states of an FMU, damaged at random: refused, or, where their sum is right, states like others. Each is in
# a piece of memory of its own size, so that a byte read beyond it is seen.
DAMAGED = """
#include "driven_fmu.c"
#if FMI == 2
static int step(fmu *f, double *x) { (void)x; return fmi2DoStep(f, f->state.model.t, 1e-3, 0); }
static void *made(void)
{
    static fmi2CallbackFunctions callbacks;
    void *const f = fmi2Instantiate("a", fmi2CoSimulation, fmu_token, "", &callbacks, 0, 0);
    return fmi2SetupExperiment(f, 0, 0.0, 0.0, 0, 0.0) || fmi2EnterInitializationMode(f) ||
        fmi2ExitInitializationMode(f) ? NULL : f;
}
#define fmi3GetFMUState fmi2GetFMUstate
#define fmi3SetFMUState fmi2SetFMUstate
#define fmi3FreeFMUState fmi2FreeFMUstate
#define fmi3FreeInstance fmi2FreeInstance
#define fmi3SerializedFMUStateSize fmi2SerializedFMUstateSize
#define fmi3SerializeFMUState fmi2SerializeFMUstate
#define fmi3DeserializeFMUState fmi2DeSerializeFMUstate
#else
static int step(fmu *f, double *x)
{
    fmi3Boolean no[3];
    return fmi3DoStep(f, f->state.model.t, 1e-3, true, no, no + 1, no + 2, x);
}
static void *made(void)
{
    void *const f = fmi3InstantiateCoSimulation("a", fmu_token, "", 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    return fmi3EnterInitializationMode(f, 0, 0.0, 0.0, 0, 0.0) || fmi3ExitInitializationMode(f) ? NULL : f;
}
#endif

static uint64_t state = 1;
static unsigned at_random(const unsigned n)
{
    state = state * 6364136223846793005u + 1442695040888963407u;
    return (unsigned)(state >> 33) % n;
}

int main(void)
{
    fmu *const f = made();
    void *saved = NULL, *found = NULL;
    size_t size;
    double x;
    if (f == NULL || step(f, &x) || fmi3GetFMUState(f, &saved) || fmi3SerializedFMUStateSize(f, saved, &size))
        return 2;
    unsigned char *const whole = malloc(size);
    if (fmi3SerializeFMUState(f, saved, (void *)whole, size))
        return 3;
    int accepted = 0;
    for (int k = 0; k < 3000; ++k) {
        const size_t n = at_random(4) ? size : at_random(2 * (unsigned)size);
        unsigned char *const bytes = calloc(n ? n : 1, 1);
        memcpy(bytes, whole, n < size ? n : size);
        for (int i = at_random(4); i >= 0 && n > 0; --i)
            bytes[at_random((unsigned)n)] ^= (unsigned char)(1 + at_random(255));
        const int forged = n == size && at_random(2);
        if (forged)
            ((fmu_record *)(void *)bytes)->sum = fmu_sum((void *)bytes);
        found = NULL;
        if (fmi3DeserializeFMUState(f, (void *)bytes, n, &found) == 0) {
            ++accepted;
            if (!forged || found == NULL)
                return 4;
            if (fmi3SetFMUState(f, found) == 0) {
                for (unsigned v = 0; v < N_VARIABLES; ++v)
                    fmu_get(f, &v, 1, &x);
                if (f->state.tolerance > 1e-12)
                    step(f, &x);
            }
            fmi3FreeFMUState(f, &found);
        } else if (found != NULL)
            return 5;
        free(bytes);
    }
    if (fmi3SetFMUState(f, saved) || step(f, &x))
        return 6;
    fmi3FreeFMUState(f, &saved);
    fmi3FreeInstance(f);
    free(whole);
    return accepted > 100 ? 0 : 7;
}
"""


@pytest.mark.parametrize("fmi", [2, 3])
def test_fmu_states_with_damaged_bytes_are_refused_under_sanitizers(tmp_path, fmi):
    with zipfile.ZipFile(fb.export_fmu(driven(), tmp_path / "driven.fmu", fmi=fmi)) as archive:
        archive.extractall(tmp_path, [name for name in archive.namelist() if name.startswith("sources/")])
    folder = tmp_path / "sources"
    (folder / "program.c").write_text(DAMAGED)
    flags = ["-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", f"-DFMI={fmi}"]
    sources = [folder / name for name in ("program.c", "driven.c", "driven_derivatives.c", "driven_stiff.c")]
    compile_c([os.environ.get("CC", "cc"), *flags, "-lm"], sources, tmp_path / "program", [folder / "runtime"])
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
