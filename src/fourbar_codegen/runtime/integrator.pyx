# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""The right-hand side with parameters and inputs bound, and its integration in C."""

cimport cython
cimport numpy as cnp
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.math cimport INFINITY, NAN, fabs, fmax
from libc.stdint cimport int64_t
from libc.string cimport memcpy, memset

from fourbar_codegen.runtime.evaluator cimport (
    FB_BREAKPOINTS, FB_CONSTRAINT_JVP, FB_ENERGY, FB_LAST, FB_LAST_ANY, FB_OK, FB_STATE_PARTIALS, Evaluator, data,
    fb_all_time, fb_clock, fb_fill_inputs, fb_finite, fb_function, fb_kernel, fb_problem, fb_problem_jacobian,
    fb_problem_project, fb_problem_rates, fb_problem_results, fb_source, fb_table, fb_time, new_array, number, numbers,
    rows, time_of, vector)

import numpy as np

from fourbar_codegen.errors import ModelError, SimulationError
from fourbar_codegen.runtime.enumerations import Method, Singular, StopReason

cnp.import_array()

cdef extern from "steppers/stepper.h":
    int FB_MAX_STAGES
    ctypedef struct fb_method:
        int (*init)(fb_stepper *, double, double, double, double *) noexcept nogil
        int (*restart)(fb_stepper *, double, const double *, double *) noexcept nogil
        int (*interpolate)(fb_stepper *, double, double *) noexcept nogil
        int (*advance)(fb_stepper *, double, double *) noexcept nogil
    ctypedef struct fb_stepper:
        fb_problem *problem
        const fb_tableau *tableau
        void *own
        int n, padded, project
        const double *rtol
        const double *atol
        double t, t_old, h
        double *x
        double *x_old
        double *x_new
        double *stages
        double *interpolant
        int fsal
        int64_t n_evaluations, n_steps
    int FB_PADDED(int) noexcept nogil
    size_t fb_place_stepper(fb_stepper *, const fb_method *, const fb_tableau *, int, double *) noexcept nogil
    int fb_evaluate(fb_stepper *, double, const double *, double *) noexcept nogil
    int fb_project_sample(fb_problem *, double, double *) noexcept nogil
    double fb_time_of_fraction(const fb_stepper *, double) noexcept nogil
    int fb_state_at(fb_stepper *, double, double *) noexcept nogil
    int fb_prepare_interpolant(fb_stepper *) noexcept nogil
    void fb_interpolate(const fb_tableau *, const double *, int, int, const double *, double, double *) noexcept nogil

cdef extern from "kernel/breakpoints.h":
    ctypedef struct fb_segment:
        double t, t_bound, first, last
    ctypedef struct fb_passed:
        const fb_breaks *breaks
        int n
    fb_segment fb_segment_ahead(void *, double, double) noexcept nogil

cdef extern from "steppers/runge_kutta.h":
    double fb_enter_part(fb_stepper *, double, double, double, fb_segment (void *, double, double) noexcept nogil,
                         void *, double *) noexcept nogil
    const fb_method fb_runge_kutta
    double fb_fixed_time(double, double, int64_t) noexcept nogil
    double FB_STEP_TOLERANCE
    int fb_fixed_step(fb_stepper *, double, double) noexcept nogil
    int fb_fixed_part(fb_stepper *, double, double) noexcept nogil

cdef extern from "steppers/ali3p.h":
    const fb_method fb_augmented_lagrangian
    ctypedef struct fb_augmented:
        int64_t n_jacobians, n_factorizations
    size_t fb_place_augmented(const fb_kernel *, fb_augmented *, double *) noexcept nogil

cdef extern from "steppers/radau.h":
    const fb_tableau fb_radau_iia
    const fb_method fb_radau_method
    ctypedef struct fb_radau:
        const fb_function *functions
        int64_t n_jacobians, n_factorizations
    size_t fb_place_radau(int, fb_radau *, double *) noexcept nogil

cdef extern from "run/driver.h":
    int FB_RUN_PAUSED
    ctypedef struct fb_samples:
        const double *times
        int64_t n_times
        double *t
        double *x
        int64_t room, n
        int pending
        double until
    ctypedef struct fb_found:
        int event, jumps
        double fraction
    ctypedef int fb_called_event(void *, int, double, const double *, double *) noexcept nogil
    ctypedef struct fb_singular:
        int how
        double ratio, t
        double *x
    ctypedef struct fb_watch:
        int n_events
        fb_event *events
        fb_found *found
        double *values
        double *ends
        double *polished
        double *scratch
        int n_found, ended_by
        double searched
        fb_called_event *call
        void *caller
        int probes
        double *along
        int look_at_all
        fb_singular singular
    ctypedef struct fb_chattering:
        double *values
        int condition
        double value
    ctypedef struct fb_stiffness:
        int is_stiff
    ctypedef struct fb_observer:
        fb_observer *next
    ctypedef struct fb_run:
        fb_stepper stepper
        double direction, t_bound, t_end, max_step, h_abs
        fb_samples samples
        fb_watch watch
        fb_chattering chattering
        fb_stiffness stiffness
        fb_observer *observers
    int fb_begin(fb_run *) noexcept nogil
    int fb_step(fb_run *) noexcept nogil
    int fb_run_on(fb_run *, int64_t) noexcept nogil
    int fb_enter(fb_run *, const fb_segment *, const double *) noexcept nogil
    int fb_stop_within(fb_run *, double) noexcept nogil
    int FB_ALL_EVENTS
    int fb_event_scratch(const fb_kernel *) noexcept nogil
    size_t fb_place_events(fb_watch *, int, int, double *) noexcept nogil
    int fb_event_values(fb_run *, double, const double *, int, double *) noexcept nogil
    int fb_find_events(fb_run *) noexcept nogil

cdef extern from "run/watched_step.h":
    int fb_watched_step(fb_run *, double, double) noexcept nogil

cdef extern from "run/kept_steps.h":
    ctypedef struct fb_kept_steps:
        int64_t n, room
        double *rows
        int64_t *sample_row
        double *sample_t
    void fb_keep_step(fb_kept_steps *, const fb_stepper *, double) noexcept nogil
    fb_observer fb_kept_steps_observer(fb_kept_steps *) noexcept nogil

cdef extern from "derivatives/velocity_jump.h":
    ctypedef struct fb_velocity_jump:
        double t_before, t_after
        const int *rate
        double *before
        double *change
    int fb_speed_jump(fb_problem *, fb_velocity_jump *, const double *, double *, double *) noexcept nogil

cdef extern from "derivatives/forward_sensitivity.h":
    ctypedef struct fb_forward:
        int n_blocks, width, size, fsal
        double *directions
        const double **source_changes
        double *relative
        double *interpolant
        double *s
        double *s_old
        double *samples
    int fb_forward_restart(void *, fb_stepper *, int) noexcept nogil
    fb_observer fb_forward_observer(fb_forward *, int) noexcept nogil
    int fb_forward_at(fb_stepper *, fb_forward *, double, FB_LAST, const double *, double *) noexcept nogil
    int fb_forward_close(fb_stepper *, fb_forward *, double, FB_LAST, const double *, double *) noexcept nogil
    int fb_forward_jump(fb_stepper *, fb_forward *, fb_velocity_jump *, const double *, double *) noexcept nogil
    int fb_forward_prepare_interpolant(fb_stepper *, fb_forward *) noexcept nogil
    size_t fb_place_forward(fb_stepper *, int, fb_forward *, double *) noexcept nogil

cdef extern from "derivatives/adjoint_sensitivity.h":
    ctypedef struct fb_adjoint:
        const double *rows
        fb_velocity_jump jump
        const int64_t *sample_row
        const double *sample_t
        const double *wrt_states
        const double *wrt_outputs
        const double *output_t
        double *wrt_state
        double *wrt_parameters
        double **wrt_source
    int fb_step_vjp(fb_stepper *, fb_adjoint *, int64_t, int64_t *) noexcept nogil
    size_t fb_place_adjoint(const fb_stepper *, fb_adjoint *, double *) noexcept nogil


def check_within(times, begin, end):
    """Raise a ModelError if times are outside of a run by more than rounding errors."""
    allowed = 1e-12 * max(abs(begin), abs(end))
    if not ((times >= min(begin, end) - allowed) & (times <= max(begin, end) + allowed)).all():
        raise ModelError(f"The run goes from t = {begin:.15g} to {end:.15g}; it has no states at the times {times}.")


def steps_at(times, direction, bounds, since):
    """The numbers of the steps that contain times; `bounds` are the beginning of the first step, and the ends of all.

    Decided by `since`, the bounds relative to the beginning of the run, which have a higher resolution. If these are
    equal on both sides of a jump, the times themselves decide.
    """
    ends, at = direction * np.array(since), direction * (times - bounds[0])
    steps = np.clip(np.searchsorted(ends, at) - 1, 0, len(ends) - 2)
    after = (ends[steps + 1] == at) & (direction * times > direction * np.array(bounds)[steps + 1])
    return np.minimum(steps + after, len(ends) - 2)


cdef class Table:
    """A function of time by polynomials between given times, both ends included, constant before and after.

    Parameters
    ----------
    times : ndarray, shape (n,)
        Strictly increasing; the last one may be infinite, if the last polynomial is constant.
    coefficients : ndarray, shape (k + 1, n - 1)
        For the powers k to 0 of the time since the beginning of each interval, as in ``scipy.interpolate.PPoly``.
    before, after : float
        Values outside.
    """

    def __cinit__(self, times, coefficients, double before, double after):
        self.times = np.array(times, dtype=np.float64)
        self.coefficients = np.array(np.transpose(coefficients), dtype=np.float64, order="C")
        if np.ndim(self.coefficients) != 2 or np.shape(self.coefficients)[0] != np.size(self.times) - 1:
            raise ModelError("A table of n times has coefficients for n - 1 intervals.")
        self.table = fb_table(
            n_intervals=cnp.PyArray_DIM(self.coefficients, 0), n_coefficients=cnp.PyArray_DIM(self.coefficients, 1),
            times=data(self.times), coefficients=data(self.coefficients), before=before, after=after)

    def jumps(self, bint varied=False):
        """Whether it jumps at each of its times, shape (n,); or, varied, would jump there with other values."""
        if varied:
            return np.isin(np.arange(len(self.times)), [0, len(self.times) - 1]) | (self.table.n_coefficients == 1)
        lengths = np.diff(self.times)
        ends = np.zeros_like(lengths)
        for coefficients in self.coefficients.T:
            ends = ends * lengths + coefficients
        left = np.append(self.table.before, ends)
        right = np.append(self.coefficients[:, np.shape(self.coefficients)[1] - 1], self.table.after)
        return np.abs(right - left) > 1e-9 * (np.abs(right) + np.abs(left))

    def bends(self, bint varied=False):
        """Whether it may jump or have a kink at each of its times, shape (n,); varied, with any values."""
        if varied or self.table.n_coefficients > 1:
            return np.ones(len(self.times), dtype=bool)
        return np.diff(np.concatenate(([self.table.before], self.coefficients[:, 0], [self.table.after]))) != 0.0

    def interval(self, double t):
        """The number of the interval that gives the value at a time: -1 before, n - 1 after."""
        if t > self.times[len(self.times) - 1]:
            return len(self.times) - 1
        return min(np.searchsorted(self.times, t, side="right") - 1, len(self.times) - 2)

    def __reduce__(self):
        return Table, (self.times, np.transpose(self.coefficients), self.table.before, self.table.after)


cdef int _call_inputs(fb_problem *problem, double t, const double *x) noexcept with gil:
    return (<Ode>problem.caller)._call(t, x)


@cython.final
cdef class Ode:
    """The right-hand side with parameters and inputs bound: f(t, x) for an integrator.

    Where the equations cannot be evaluated, it returns NaN, so that an integrator with step control rejects
    the step; `failure` then gives the reason. If `projects`, the solvers of `fourbar_codegen.solvers` project each
    state onto the constraints; if `in_pieces`, steps already end at discontinuities. `clock` has the time at which the
    integrator's time is zero, and the interval in which inputs are evaluated; methods for inputs take absolute time.

    Threads may share an Ode: calls are serialized, `failure` is that of the last call, and a solver of
    `fourbar_codegen.solvers` takes a copy with its own workspace. All of them call a callable input, which may itself
    call the right-hand side.

    Parameters
    ----------
    evaluator : Evaluator
    p : array_like or None
    sources : sequence of length n_r
        For each input None (its expression), a float, a `Table` or a callable of (t, x).
    """

    # All calls share one set of buffers. Callables, which run Python and may switch threads, are called first; no
    # Python runs between filling the buffers and reading them. Code that releases the GIL while it computes needs a
    # copy.

    def __cinit__(self, Evaluator evaluator not None, p, sources):
        cdef cnp.ndarray parameters = evaluator.parameter_vector(p)  # a copy, which copies of the Ode need later
        cdef int i
        self.evaluator, self.parameters = evaluator, parameters
        self.problem.kernel, self.problem.clock = evaluator.kernel, fb_all_time
        cdef int n_constants = evaluator.kernel.n_constants
        self.problem.constants = <double *>PyMem_Calloc(
            n_constants + evaluator.n_r + 2 * evaluator.n_x + 1, sizeof(double))
        self.problem.sources = <fb_source *>PyMem_Calloc(evaluator.n_r + 1, sizeof(fb_source))
        self.problem.work = PyMem_Calloc(1, evaluator.kernel.work_size)
        if not (self.problem.constants and self.problem.sources and self.problem.work):
            raise MemoryError
        self.problem.inputs = self.problem.constants + n_constants
        self.problem.failed_x = self.problem.inputs + evaluator.n_r
        self.problem.moved_x = self.problem.failed_x + evaluator.n_x
        memcpy(self.problem.constants, evaluator._prepare(parameters), n_constants * sizeof(double))
        self.sources = tuple(sources)
        self.callables, self.error = [], None
        if len(self.sources) != evaluator.n_r:
            raise ModelError(f"{evaluator.n_r} inputs need as many sources, not {len(self.sources)}.")
        for i in range(evaluator.n_r):
            given = self.sources[i]
            if given is None:
                continue
            self.problem.sources[self.problem.n_sources].input = i
            if type(given) is Table:
                self.problem.sources[self.problem.n_sources].table = &(<Table>given).table
                self.has_tables = True
            elif callable(given):
                what = f"What the callable of input {self._name(i)} returns"
                self.callables.append((self.problem.n_sources, given, what))
            else:
                self.problem.sources[self.problem.n_sources].value = number(given, f"Input {self._name(i)}")
            self.problem.n_sources += 1
        if self.callables:
            self.problem.called_inputs, self.problem.caller = _call_inputs, <void *>self

    def __reduce__(self):
        return _ode, (
            self.evaluator, self.parameters, self.sources, self.stabilization, bool(self.projects),
            bool(self.in_pieces), self.clock)

    def __dealloc__(self):
        PyMem_Free(self.problem.constants)
        PyMem_Free(self.problem.sources)
        PyMem_Free(self.problem.work)

    def _name(self, int i):
        names = getattr(self.evaluator, "inputs", None)  # a bare evaluator has none
        return names[i] if names else i + 1

    cdef int _call(self, double t, const double *x) noexcept:
        """The callables' values; all are called first, since they may run any Python code."""
        cdef cnp.ndarray state
        cdef list called = []
        cdef tuple given
        cdef int i
        try:
            time = t
            for given in self.callables:
                state = new_array(self.evaluator.n_x)  # a copy for each, which it may modify
                memcpy(data(state), x, self.evaluator.n_x * sizeof(double))
                value = given[1](time, state)
                called.append(value if type(value) is float else number(value, given[2]))
        except BaseException as error:
            self.problem.status = FB_OK  # the callable has failed, not the equations
            self.error = error
            return -1
        for i in range(len(called)):
            self.problem.sources[<int>(<tuple>self.callables[i])[0]].value = called[i]
        return 0

    cdef int check(self, int status) except -2:
        """The status of a call that may have called inputs; raises the exceptions of these."""
        if status < 0 and self.error is not None:
            error, self.error = self.error, None
            raise error
        return status

    @property
    def clock(self):
        """The time at which the integrator's time is zero, and the first and last time that inputs are evaluated at."""
        return self.problem.clock.origin, self.problem.clock.first, self.problem.clock.last

    @clock.setter
    def clock(self, times):
        origin, first, last = times
        self.problem.clock = fb_clock(origin=origin, first=first, last=last)

    def breakpoints(self):
        """The breakpoints, times at which expressions may not be smooth, shape (n_breakpoints,)."""
        cdef cnp.ndarray times = new_array(self.problem.kernel.n_breakpoints)
        cdef double *results[1]
        results[0] = data(times)
        fb_problem_results(&self.problem, FB_BREAKPOINTS, 0.0, NULL, NULL, NULL, NULL, results)
        return times

    @property
    def layout(self):
        """The description of the model."""
        return self.evaluator.layout

    @property
    def n_breakpoints(self):
        """The number of breakpoints."""
        return self.problem.kernel.n_breakpoints

    @property
    def n_q(self):
        """The number of coordinates."""
        return self.evaluator.n_q

    @property
    def n_u(self):
        """The number of speeds."""
        return self.evaluator.n_u

    @property
    def n_x(self):
        """The number of coordinates, speeds and auxiliary states."""
        return self.evaluator.n_x

    @property
    def stabilization(self):
        """The rate of Baumgarte's stabilization of the constraints, 1/s; 0 for none."""
        return self.problem.stabilization

    @stabilization.setter
    def stabilization(self, rate):
        self.problem.stabilization = number(rate, "The stabilization")

    @property
    def has_jacobian(self):
        """Whether `jac` is the derivative: it does not include callable inputs or a stabilization."""
        return not self.callables and self.problem.stabilization == 0.0

    @property
    def failure(self):
        """The reason why the last evaluation of the equations failed, or None."""
        cdef cnp.ndarray x
        if self.problem.status == FB_OK:
            return None
        x = new_array(self.evaluator.n_x)
        memcpy(data(x), self.problem.failed_x, self.evaluator.n_x * sizeof(double))
        return self.evaluator.failure(self.problem.status, self.problem.failed_t, x)

    def explain(self, int status, double t, x):
        """A sentence for a status of the kernel."""
        return self.evaluator.failure(status, t, x)

    def input_values(self, t, x):
        """The inputs at one time and state, shape (n_r,)."""
        t = time_of(t)
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x")
        cdef cnp.ndarray result = new_array(self.evaluator.n_r)
        self.check(fb_fill_inputs(&self.problem, t, data(state)))
        memcpy(data(result), self.problem.inputs, self.evaluator.n_r * sizeof(double))
        return result

    def inputs_along(self, times, states):
        """The inputs at times, for states in columns, shape (n_r, n)."""
        cdef cnp.ndarray t = numbers(times, "The times")
        cdef cnp.ndarray x = rows(states, "The states")
        cdef int i, n = cnp.PyArray_SIZE(t), n_x = self.evaluator.n_x, n_r = self.evaluator.n_r
        cdef cnp.ndarray result = new_array(n, n_r)
        if cnp.PyArray_NDIM(x) != 2 or cnp.PyArray_DIM(x, 0) != n or cnp.PyArray_DIM(x, 1) != n_x:
            raise ModelError(f"{n} times need states of shape ({n_x}, {n}), not {np.shape(states)}.")
        if not fb_finite(data(t), n):
            raise ModelError("The times must be finite.")
        for i in range(n):
            self.check(fb_fill_inputs(&self.problem, data(t)[i], data(x) + i * n_x))
            memcpy(data(result) + i * n_r, self.problem.inputs, n_r * sizeof(double))
        return result.T

    def toggled(self):
        """Whether the sign of det J_d may have changed since the last call: see `fb_kernel`."""
        return bool(self.problem.kernel.toggled(self.problem.work))

    def closest(self, t, x):
        """The kernel's status, and the state projected onto the constraints, shape (n_x,)."""
        t = time_of(t)
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x").copy()
        cdef int status = self.check(fb_problem_project(&self.problem, t, data(state), 0))
        return status, state

    def project(self, t, x):
        """The state projected onto the constraints, shape (n_x,); unchanged if that fails."""
        t = time_of(t)
        status, state = self.closest(t, x)
        return np.array(x) if status else state

    def __call__(self, t, x):
        """x', shape (n_x,), a fresh array."""
        t = time_of(t)
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x")
        cdef cnp.ndarray result = new_array(self.evaluator.n_x)
        self.check(fb_problem_rates(&self.problem, t, data(state), data(result)))
        return result

    def multipliers(self, t, x):
        """x', shape (n_x,), and the multipliers followed by unknown forces, shape (n_l,)."""
        t = time_of(t)
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x")
        cdef cnp.ndarray accelerations = new_array(self.evaluator.n_u), result = new_array(self.evaluator.n_l)
        cdef cnp.ndarray rates = self(t, state)
        cdef int status = self.problem.kernel.accelerations(
            fb_time(&self.problem.clock, t), data(state), self.problem.constants, self.problem.inputs,
            data(accelerations), data(result), self.problem.work)
        if status != FB_OK:
            raise SimulationError(self.evaluator.failure(status, t, state))
        return rates, result

    def energies(self, t, x):
        """Kinetic and potential energy at one time; NaN if unknown."""
        t = time_of(t)
        cdef double[2] found
        cdef double *results[1]
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x")
        self.check(fb_fill_inputs(&self.problem, t, data(state)))
        results[0] = found
        fb_problem_results(&self.problem, FB_ENERGY, t, data(state), NULL, NULL, NULL, results)
        return found[0], found[1]

    def jac(self, t, x):
        """d f / d x, shape (n_x, n_x)."""
        t = time_of(t)
        cdef cnp.ndarray state = vector(x, self.evaluator.n_x, "The state x")
        cdef cnp.ndarray result = new_array(self.evaluator.n_x, self.evaluator.n_x)
        self.evaluator.function(FB_STATE_PARTIALS)
        self.check(fb_problem_jacobian(
            &self.problem, self.evaluator.functions, t, data(state), data(result)))
        return result


def _ode(evaluator, p, sources, double stabilization, bint projects, bint in_pieces, clock):
    """Restores a copied or pickled Ode."""
    cdef Ode ode = Ode(evaluator, p, sources)
    ode.stabilization, ode.projects, ode.in_pieces, ode.clock = stabilization, projects, in_pieces, clock
    return ode


cdef class EmbeddedSteps:
    """Steps of an explicit Runge-Kutta method, without Python between their stages.

    Parameters
    ----------
    ode : Ode
        The right-hand side; nothing else may call it during a step.
    tableau : (array_like, array_like, array_like), shapes (s, s), (s,), (s,)
        The method's coefficients a, b, c.
    error : array_like, shape (s + 1,) or (2, s + 1)
        Weights of the error estimate; two rows are the estimates of fifth and third order of DOP853.
    error_exponent : float
        Exponent of the step control.
    t_bound : float
        The end of the run.
    direction : float
        1, or -1 for a run backwards.
    max_step : float
        The longest step.
    rtol, atol : array_like, shape () or (n_x,)
        Relative and absolute tolerance.
    """

    cdef fb_run run
    cdef fb_tableau tableau
    cdef Ode ode
    cdef list kept
    cdef bint busy

    def __cinit__(self, Ode ode not None, tableau, error, double error_exponent, double t_bound, double direction,
                  double max_step, rtol, atol):
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef int n = ode.evaluator.n_x
        cdef double *tolerances
        self.ode, self.kept = ode, [np.array(part, dtype=np.float64, order="C") for part in (*tableau, error)]
        a, b, c, errors = self.kept
        n_stages = np.size(b)
        if (np.shape(a) != (n_stages, n_stages) or np.shape(c) != (n_stages,)
                or np.shape(errors) not in {(n_stages + 1,), (2, n_stages + 1)}):
            raise ModelError("The shapes of a Runge-Kutta method's coefficients do not agree.")
        if not 0 < n_stages < FB_MAX_STAGES:
            raise ModelError(f"A Runge-Kutta method has 1 to {FB_MAX_STAGES - 1} stages, not {n_stages}.")
        self.tableau = fb_tableau(
            n_stages=n_stages, a=data(a), b=data(b), c=data(c), n_errors=np.ndim(errors), error=data(errors),
            order=-1.0 / error_exponent - 1.0, n_extra=0, hermite=0, n_dense=0)
        self.kept.append(_place(stepper, ode, &fb_runge_kutta, &self.tableau, 2 * n, &tolerances))
        stepper.project = ode.projects
        stepper.rtol, stepper.atol = _fill(tolerances, rtol, n), _fill(tolerances + n, atol, n)
        run.direction, run.t_bound, run.max_step = direction, t_bound, max_step

    def step(self, double t, double h_abs, x, cnp.ndarray stages not None):
        """One accepted step.

        Parameters
        ----------
        t, h_abs : float
            Time and the step's proposed length.
        x : array_like, shape (n_x,)
        stages : ndarray, shape (s + 1, n_x)
            The first row is x' at t; the others are filled.

        Returns
        -------
        t, h, h_abs : float
            The time reached, the step taken, the next step's proposed length.
        x : ndarray, shape (n_x,)
        n_evaluations : int
        reason : StopReason
            ``PAUSED`` after an accepted step; otherwise what is wrong with its length.
        """
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef cnp.ndarray state = vector(x, stepper.n, "The state x")
        cdef int k, status, n_stages = self.tableau.n_stages
        if (cnp.PyArray_NDIM(stages) != 2 or cnp.PyArray_TYPE(stages) != cnp.NPY_DOUBLE
                or not cnp.PyArray_ISCARRAY(stages) or cnp.PyArray_DIM(stages, 0) != n_stages + 1
                or cnp.PyArray_DIM(stages, 1) != stepper.n):
            raise ModelError(f"The stages must be a contiguous array of {n_stages + 1} states.")
        _enter(&self.busy)
        run.h_abs = h_abs
        stepper.t, stepper.n_evaluations, stepper.n_steps, stepper.fsal = t, 0, 0, 0
        memcpy(stepper.x, data(state), stepper.n * sizeof(double))
        memcpy(stepper.stages, data(stages), stepper.n * sizeof(double))
        with nogil:
            status = fb_step(run)
        self.busy = False
        self.ode.check(status)
        for k in range(n_stages + 1):
            memcpy(data(stages) + k * stepper.n, stepper.stages + k * stepper.padded, stepper.n * sizeof(double))
        return (stepper.t, stepper.h, run.h_abs, _state_of(stepper), stepper.n_evaluations, _REASONS[status])


cdef int _enter(bint *busy) except -1:
    """Begin a step; raise if a callable input within a step, or another thread, requests another one."""
    if busy[0]:
        raise SimulationError(
            "A step of this run is under way, in another thread or because a callable input has asked for one within "
            "it: take one step after the other, or use a stepper or solver for each thread.")
    busy[0] = True
    return 0


cdef cnp.ndarray _place(fb_stepper *stepper, Ode ode, const fb_method *method, const fb_tableau *tableau, int more,
                        double **rest):
    """Set a stepper's problem, method and memory; the latter is returned, with more doubles at its end."""
    cdef int n = ode.evaluator.n_x
    cdef cnp.npy_intp[1] size = [fb_place_stepper(stepper, method, tableau, n, NULL)]
    size[0] += more
    cdef cnp.ndarray memory = cnp.PyArray_ZEROS(1, size, cnp.NPY_DOUBLE, 0)
    stepper.problem = &ode.problem
    rest[0] = data(memory) + fb_place_stepper(stepper, method, tableau, n, data(memory))
    return memory


cdef dict _METHODS = {method.name: int(method) for method in Method}


cdef const fb_tableau *tableau_of(str method) except NULL:
    """The coefficients of a method in C."""
    if method == "ALI3P":
        return &fb_trapezoid
    if method == "RK4":
        return &fb_rk4
    return &fb_radau_iia if method == "Radau" else fb_tableaus[<int>_METHODS[method]]


cdef const fb_method *_steps_of(str method) noexcept:
    """How a method takes its steps."""
    if method == "ALI3P":
        return &fb_augmented_lagrangian
    return &fb_radau_method if method == "Radau" else &fb_runge_kutta


cdef cnp.ndarray _place_radau(fb_stepper *stepper, Ode ode, fb_radau *radau):
    """Set the workspace of Radau IIA, and its memory, which is returned."""
    cdef cnp.ndarray memory = np.zeros(fb_place_radau(stepper.n, radau, NULL))
    fb_place_radau(stepper.n, radau, data(memory))
    stepper.own = radau
    ode.evaluator.function(FB_STATE_PARTIALS)
    radau.functions = ode.evaluator.functions if ode.has_jacobian else NULL
    return memory


cdef int set_event(fb_event *event, row, int place) except -1:
    """An event by an `EventRow`; a callable is called by its place."""
    of = row.number
    event.quantity, event.row = row.quantity, place if callable(of) else of
    event.direction, event.terminal = row.direction, row.terminal
    event.at_start, event.all_roots = row.at_start, row.all_roots
    event.touched = NAN
    return 0


cdef cnp.ndarray _place_events(fb_watch *watch, Ode ode, events):
    """Set the events of a run, and their memory, which is returned."""
    cdef int i, n = len(events), n_scratch = fb_event_scratch(ode.evaluator.kernel)
    cdef cnp.ndarray memory = np.zeros(fb_place_events(watch, n, n_scratch, NULL))
    fb_place_events(watch, n, n_scratch, data(memory))
    for i, event in enumerate(events):
        set_event(watch.events + i, event, i)
    return memory


cdef int _value_of_event(Ode ode, const fb_watch *watch, function, double t, const double *x, double *value) noexcept:
    """The value of an event's callable; negative if it fails."""
    cdef cnp.ndarray state
    try:
        state = new_array(ode.evaluator.n_x)
        memcpy(data(state), x, ode.evaluator.n_x * sizeof(double))
        value[0] = number(function(t, state), "The value of an event's callable")
        return 0
    except BaseException as error:
        if watch.probes and isinstance(error, Exception):
            value[0] = NAN
            return 0
        ode.error = error
        return -1


cdef const double *_fill(double *to, values, int n) except NULL:
    """Tolerances for n states, from a number or n numbers."""
    cdef cnp.ndarray given
    cdef int i, step
    cdef double one
    if type(values) is float:
        one = values
        for i in range(n):
            to[i] = one
        return to
    given = numbers(values, "A tolerance")
    step = cnp.PyArray_SIZE(given) != 1
    if step and cnp.PyArray_SIZE(given) != n:
        raise ModelError(f"A tolerance is a number or {n} numbers, not {cnp.PyArray_SIZE(given)}.")
    for i in range(n):
        to[i] = data(given)[i * step]
    return to


cdef cnp.ndarray _state_of(const fb_stepper *stepper):
    """A copy of the state reached."""
    cdef cnp.ndarray x = new_array(stepper.n)
    memcpy(data(x), stepper.x, stepper.n * sizeof(double))
    return x


cdef int _prepare_forward(fb_stepper *stepper, fb_forward *forward, Ode ode, directions, list kept) except -1:
    """Set the derivatives of steps, at the beginning; `kept` holds their memory."""
    cdef const fb_kernel *kernel = ode.evaluator.kernel
    cdef int n_x = kernel.n_x, n_p = kernel.n_p, n = np.shape(directions.matrix)[1]
    cdef cnp.ndarray memory = np.zeros(fb_place_forward(stepper, n, forward, NULL)), first, changes
    cdef cnp.ndarray places = np.zeros(kernel.n_r + 1, dtype=np.uintp)
    cdef int width = forward.width
    fb_place_forward(stepper, n, forward, data(memory))
    ode.evaluator.function(FB_CONSTRAINT_JVP)
    padded = np.zeros((forward.n_blocks, n_x + n_p + kernel.n_r, width))
    for block in range(forward.n_blocks):
        columns = directions.matrix[:, block * width:(block + 1) * width]
        padded[block, :n_x + n_p, :columns.shape[1]] = columns
    memory[:padded.size] = padded.ravel()
    first = np.ascontiguousarray(padded[:, :n_x])
    memcpy(forward.s, data(first), first.size * sizeof(double))
    kept += [memory, places]
    given = [changes for source, changes in zip(ode.sources, directions.sources) if source is not None]
    for i, of_source in enumerate(given):
        if of_source is not None:
            changes = np.zeros((len(of_source), forward.n_blocks * width))
            changes[:, :n] = of_source
            places[i] = changes.ctypes.data
            kept.append(changes)
    forward.source_changes = <const double **>cnp.PyArray_DATA(places)
    _fill_relative_changes(forward, ode, directions)
    return 0


cdef int _fill_relative_changes(fb_forward *forward, Ode ode, directions) except -1:
    """The relative change along each direction: of a parameter, or of the values of an input; 1 for initial values and
    for what is below 1, since it may be small only now. CVODES scales the absolute tolerances of sensitivities by
    typical values of parameters."""
    cdef const fb_kernel *kernel = ode.evaluator.kernel
    cdef cnp.ndarray parameters = ode.evaluator.default_parameters if ode.parameters is None else ode.parameters
    cdef const double *p = data(parameters)
    cdef const double *changes
    cdef int block, i, j, width = forward.width, length = kernel.n_x + kernel.n_p + kernel.n_r
    cdef double largest
    for block in range(forward.n_blocks):
        for j in range(width):
            changes, largest = forward.directions + (block * length + kernel.n_x) * width + j, 0.0
            for i in range(kernel.n_p):
                largest = fmax(largest, fabs(changes[i * width]) / (fabs(p[i]) if p[i] != 0.0 else 1.0))
            forward.relative[block * width + j] = largest
    for source, of_source in zip(ode.sources, directions.sources):
        if of_source is not None:
            values = [source]
            if isinstance(source, Table):  # at the beginning of each interval, before and after
                i = (<Table>source).table.n_coefficients
                values = (<Table>source).coefficients[:, i - 1]
                of_source = np.vstack((of_source[i - 1:len(of_source) - 2:i], of_source[len(of_source) - 2:]))
            for j, change in enumerate(np.abs(of_source).max(axis=0) / (np.abs(values).max() or 1.0)):
                forward.relative[j] = fmax(forward.relative[j], change)
    for j in range(forward.n_blocks * width):
        if not 0.0 < forward.relative[j] < 1.0:
            forward.relative[j] = 1.0
    return 0


cdef _by_directions(samples, const fb_forward *forward, int n_x, directions):
    """Rows of samples of derivatives as an array of shape (n, n_x, n_t)."""
    cdef int n_blocks = forward.n_blocks, width = forward.width
    blocks = samples[:, :n_blocks * n_x * width].reshape(len(samples), n_blocks, n_x, width)
    derivatives = blocks.transpose(1, 3, 2, 0).reshape(n_blocks * width, n_x, len(samples))
    return derivatives[:directions.matrix.shape[1]]


def _rates_of(Ode ode):
    """For each input that is a second derivative the place of the rate, otherwise -1."""
    entries = ode.evaluator.layout.inputs
    places = {(entry.of, entry.order): place for place, entry in enumerate(entries)}
    rates = [places.get((entry.of, 1), -1) if entry.order == 2 else -1 for entry in entries]
    return np.array([*rates, -1], dtype=np.intc)


_REASONS = tuple(StopReason)
_SINGULAR = tuple(Singular)


# A foreign method: Python objects with a step control of their own. These functions keep exceptions for `Ode.check`.

cdef int _foreign_init(fb_stepper *stepper, double direction, double interval, double max_step,
                       double *h_abs) noexcept nogil:
    cdef int status = fb_evaluate(stepper, stepper.t, stepper.x, stepper.stages)
    stepper.problem.kernel.toggled(stepper.problem.work)
    h_abs[0] = INFINITY  # nothing is proposed
    return status


cdef int _foreign_advance(fb_stepper *stepper, double t_bound, double *t_new) noexcept with gil:
    cdef Run run = <Run>stepper.own
    cdef cnp.ndarray x
    try:
        reason = run.foreign.step()
        if reason == StopReason.PAUSED:
            t_new[0] = run.foreign.t
            x = vector(run.foreign.x, stepper.n, "The state x")
            memcpy(stepper.x_new, data(x), stepper.n * sizeof(double))
        return reason
    except BaseException as error:
        run.ode.error = error
        return -1


cdef int _foreign_interpolate(fb_stepper *stepper, double t, double *result) noexcept with gil:
    cdef Run run = <Run>stepper.own
    cdef cnp.ndarray x
    try:
        x = vector(run.foreign.interpolant()(t), stepper.n, "The state x")
        memcpy(result, data(x), stepper.n * sizeof(double))
        return 0
    except BaseException as error:
        run.ode.error = error
        return -1


cdef int _call_event(void *caller, int place, double since, const double *x, double *value) noexcept with gil:
    cdef Run run = <Run>caller
    return _value_of_event(run.ode, &run.run.watch, run.events[place].number, run._at(since), x, value)


cdef fb_method _foreign_method
_foreign_method.init, _foreign_method.restart = _foreign_init, fb_evaluate
_foreign_method.interpolate, _foreign_method.advance = _foreign_interpolate, _foreign_advance


@cython.final
cdef class Run:
    """A run of a method in C, without Python between its steps: see ``run/driver.h``.

    Parameters
    ----------
    ode : Ode
        The right-hand side; nothing else may call it during the run.
    method : str or ForeignMethod
        Of `Method`, "Radau", or "ALI3P".
    t, t_bound : float
        Beginning and end.
    x : array_like, shape (n_x,)
        The initial state.
    max_step : float
        The longest step; for ALI3P, the length of all steps but the last.
    rtol, atol : array_like, shape () or (n_x,)
        Relative and absolute tolerance.
    project : bool
        Whether states are projected onto the constraints after each step.
    times : array_like, shape (n,), or None
        Times of the samples; None for a sample after each step.
    events : sequence of (int, int or callable, int, int, bool, bool)
        Of each event the `Watched` quantity; its row, or the callable; the direction of its changes of sign that
        count: 1, -1, or 0 for both; the number of events that end the run, or 0; whether a zero at the start counts;
        and whether to find all roots within a step, or only changes between its ends.
    look_at_all : bool
        Whether to stop after each step.
    """

    cdef fb_run run
    cdef fb_observer differentiates, keeps
    cdef fb_augmented augmented
    cdef fb_radau radau
    cdef readonly Ode ode
    cdef object method
    cdef readonly object foreign
    cdef object events
    cdef list kept
    cdef double origin, t_begin, t_bound
    cdef double since_begin
    cdef object times
    cdef int64_t n_taken
    cdef cnp.ndarray kept_t
    cdef cnp.ndarray kept_x
    cdef fb_forward forward
    cdef object directions
    cdef cnp.ndarray kept_s
    cdef list varied
    cdef fb_kept_steps steps
    cdef cnp.ndarray kept_rows
    cdef cnp.ndarray kept_places
    cdef cnp.ndarray kept_since
    cdef list places
    cdef list clocks

    # In C, times are relative to the beginning, so that their resolution does not depend on it; outside, absolute.

    def __cinit__(self, Ode ode not None, method, double t, x, double t_bound, double max_step, rtol, atol,
                  bint project, times, events, bint look_at_all):
        cdef int n = ode.evaluator.n_x
        cdef cnp.ndarray state = vector(x, n, "The state x")
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef fb_watch *watch = &run.watch
        cdef double *memory
        cdef const fb_method *steps
        cdef const fb_tableau *tableau = &fb_trapezoid
        self.ode, self.method, self.kept = ode, method, []
        if type(method) is str:
            tableau, steps = tableau_of(method), _steps_of(method)
        else:
            self.foreign, steps, stepper.own = method, &_foreign_method, <void *>self
        ode.problem.clock = fb_clock(origin=t, first=-INFINITY, last=INFINITY)
        self.origin, self.t_begin, self.since_begin, self.t_bound, self.times = t, t, 0.0, t_bound, times
        self.kept.append(_place(stepper, ode, steps, tableau, 4 * FB_PADDED(n) + 2 * n, &memory))
        stepper.project = project
        stepper.rtol, stepper.atol = _fill(memory, rtol, n), _fill(memory + n, atol, n)
        watch.along = memory + 2 * n
        watch.singular.x = watch.along + 2 * FB_PADDED(n)
        run.chattering.values = <double *>self._keep(np.zeros(4 * ode.evaluator.kernel.n_conditions))
        memcpy(stepper.x, data(state), n * sizeof(double))
        run.direction, run.t_bound, run.max_step = 1.0 if t_bound > t else -1.0, t_bound - t, max_step
        run.samples.until = run.t_end = run.t_bound
        if times is not None:
            run.samples.times = <const double *>self._keep(np.array(times, dtype=np.float64) - t)
            run.samples.n_times = np.size(times)
        watch.look_at_all = look_at_all
        if events:
            self.events = events
            self.kept.append(_place_events(watch, ode, events))
            watch.call, watch.caller = _call_event, <void *>self
        if type(method) is str:
            self._place_own(method)
        self._make_room(run.samples.n_times if times is not None else 256)

    cdef _place_own(self, str method):
        """The workspace of an implicit method, and the derivatives that it needs."""
        cdef fb_stepper *stepper = &self.run.stepper
        cdef const fb_kernel *kernel = self.ode.evaluator.kernel
        if method == "Radau":
            self.kept.append(_place_radau(stepper, self.ode, &self.radau))
        elif method == "ALI3P":
            stepper.own = &self.augmented
            memory = np.zeros(fb_place_augmented(kernel, &self.augmented, NULL))
            fb_place_augmented(kernel, &self.augmented, <double *>self._keep(memory))
            self.ode.evaluator.function(FB_STATE_PARTIALS)

    @property
    def found(self):
        """The events found last, in the order of times: number, fraction of the last step, and whether the function
        has jumped there."""
        cdef fb_watch *watch = &self.run.watch
        cdef int i
        return [(watch.found[i].event, watch.found[i].fraction, bool(watch.found[i].jumps))
                for i in range(watch.n_found)]

    @property
    def ended_by(self):
        """The number of the event that ends the run, or -1."""
        return self.run.watch.ended_by

    @property
    def touched(self):
        """For each event the last time at which its function was zero without a change of sign, or NaN."""
        cdef int i
        return [self.origin + self.run.watch.events[i].touched for i in range(self.run.watch.n_events)]

    def differentiate_along(self, directions):
        """Also integrate derivatives along directions of (x, p) and of inputs, before `begin`. Without names they are
        not kept: they only make the steps short enough for derivatives."""
        _prepare_forward(&self.run.stepper, &self.forward, self.ode, directions, self.kept)
        self._observe(&self.differentiates, fb_forward_observer(&self.forward, bool(directions.places)))
        if directions.places:
            self.directions, self.varied = directions, []
        self.ode.check(fb_forward_restart(&self.forward, &self.run.stepper, True))
        self._make_room(self.run.samples.room)

    def keep_steps(self):
        """Also keep the steps, for `Steps`, before `begin`."""
        self.places, self.clocks = [], [(0, -INFINITY, INFINITY, 0.0, 0.0)]
        self.kept_rows = new_array(256, 2 + self.run.stepper.n)
        self.steps.rows, self.steps.room = data(self.kept_rows), 256
        self._observe(&self.keeps, fb_kept_steps_observer(&self.steps))
        self._make_room(self.run.samples.room)
        fb_keep_step(&self.steps, &self.run.stepper, 0.0)

    cdef int _observe(self, fb_observer *place, fb_observer observer) except -1:
        place[0], place.next, self.run.observers = observer, self.run.observers, place
        return 0

    cdef int _make_room_for_steps(self) except -1:
        cdef cnp.ndarray larger
        if self.steps.n == self.steps.room:
            larger = new_array(2 * self.steps.room, 2 + self.run.stepper.n)
            memcpy(data(larger), self.steps.rows, self.steps.n * (2 + self.run.stepper.n) * sizeof(double))
            self.kept_rows = larger
            self.steps.rows, self.steps.room = data(larger), 2 * self.steps.room
        return 0

    def steps_kept(self, t):
        """The steps, and the samples up to the number of their absolute times."""
        places, times = (np.concatenate(parts)[:len(t)] for parts in zip(*self.places))
        return Steps(self.ode, self.method, bool(self.run.stepper.project), self.origin,
                     self.kept_rows[:self.steps.n].copy(), places, times, t, self.clocks)

    @property
    def sensitivities(self):
        """The derivatives at all samples taken, shape (n, n_x, n_t)."""
        samples = self.varied[0] if len(self.varied) == 1 else np.concatenate(self.varied)
        return _by_directions(samples, &self.forward, self.run.stepper.n, self.directions)

    cdef void *_keep(self, cnp.ndarray array):
        self.kept.append(array)
        return cnp.PyArray_DATA(array)

    def take_samples(self):
        """The samples since the last call, shapes (n,) and (n, n_x)."""
        cdef int64_t i, n = self.run.samples.n
        cdef cnp.ndarray times, states
        if self.times is None:
            times = new_array(n)
            for i in range(n):
                data(times)[i] = self._at(self.run.samples.t[i])
        else:
            times = self.times[self.n_taken:self.n_taken + n].copy()
        self.n_taken += n
        states = new_array(n, self.run.stepper.n)
        memcpy(data(states), self.run.samples.x, n * self.run.stepper.n * sizeof(double))
        samples = (times, states)
        is_last = self.times is not None and self.n_taken == len(self.times)
        if self.varied is not None:
            self.varied.append(self.kept_s[:n] if is_last else self.kept_s[:n].copy())
        if self.places is not None:
            self.places.append((self.kept_places[:n].copy(), self.kept_since[:n].copy()))
            self._make_room_for_steps()
        if n == self.run.samples.room and not is_last:
            self._make_room(2 * n if n else 1)
        self.run.samples.n = 0
        return samples

    cdef int _make_room(self, int64_t room) except -1:
        self.kept_t, self.kept_x = new_array(room), new_array(room, self.run.stepper.n)
        self.run.samples.t, self.run.samples.x, self.run.samples.room = data(self.kept_t), data(self.kept_x), room
        if self.varied is not None:
            self.kept_s = new_array(room, self.forward.size)
            self.forward.samples = data(self.kept_s)
        if self.places is not None:
            self.kept_places, self.kept_since = np.empty(room, dtype=np.int64), new_array(room)
            self.steps.sample_row = <int64_t *>cnp.PyArray_DATA(self.kept_places)
            self.steps.sample_t = data(self.kept_since)
        return 0

    def begin(self):
        """Choose the first step."""
        self.run.samples.pending = 1
        self._start_foreign()
        self.ode.check(fb_begin(&self.run))

    def enter(self, double t, double t_bound, double first, double last, x=None):
        """Continue from one boundary to the next, from the present state or from x.

        Take the samples before. Inputs are evaluated from the first time to the last one. Returns whether a state
        nearby satisfies the constraints.
        """
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef cnp.ndarray state
        cdef const fb_clock *clock = &self.ode.problem.clock
        cdef double before = clock.last if run.direction > 0.0 else clock.first
        cdef fb_segment segment = fb_segment(t=t - self.origin, t_bound=t_bound - self.origin, first=first, last=last)
        if x is not None:
            state = vector(x, stepper.n, "The state x")
            if run.observers:
                self._pass_jump(before, first, state)
        self.t_begin, self.since_begin, self.t_bound = t, segment.t, t_bound
        if self.times is not None:  # absolute times, since relative ones may be equal on both sides of a jump
            run.samples.n_times = np.searchsorted(run.direction * self.times, run.direction * t_bound, side="right")
        if self.clocks is not None:
            self.clocks.append((self.steps.n, min(first, last), max(first, last), before, first))
            self._make_room_for_steps()
        if self.ode.check(fb_enter(run, &segment, NULL if x is None else data(state))) != FB_RUN_PAUSED:
            return False
        if t != t_bound:
            self._start_foreign()
        return True

    cdef int _start_foreign(self) except -1:
        """Make a foreign method begin at the state reached."""
        if self.foreign is not None:
            self.foreign.start(self.run.stepper.t, self.x, self.run.t_bound)
        return 0

    cdef int _pass_jump(self, double before, double after, cnp.ndarray x) except -1:
        """The derivatives after a jump of the speeds to a state x."""
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef int i, n_q = self.ode.evaluator.n_q, n_u = self.ode.evaluator.n_u
        cdef fb_velocity_jump jump
        cdef cnp.ndarray memory = np.zeros((2, self.ode.evaluator.n_r + 1)), places = _rates_of(self.ode)
        cdef cnp.ndarray speeds = np.zeros(n_u), scratch = np.zeros(n_u + self.ode.evaluator.n_l)
        cdef int status
        jump.t_before, jump.t_after, jump.rate = before, after, <const int *>cnp.PyArray_DATA(places)
        jump.before, jump.change = data(memory), data(memory) + self.ode.evaluator.n_r + 1
        status = fb_speed_jump(stepper.problem, &jump, stepper.x, data(speeds), data(scratch))
        if status != FB_OK:
            raise SimulationError(self.ode.evaluator.failure(status, after, _state_of(stepper)))
        change = (x - _state_of(stepper))[n_q:n_q + n_u]
        size = np.abs(change).max(initial=0.0) + np.abs(speeds).max(initial=0.0)
        if not np.abs(change - speeds).max(initial=0.0) <= 1e-6 * size + 1e-9:
            raise SimulationError(
                f"The speeds jump at t = {after:.9g} by an expression of time in the model, which has no derivatives: "
                "prescribe the motion by an input.")
        if self.forward.s and fb_forward_jump(
                stepper, &self.forward, &jump, stepper.x, self.forward.s) != FB_OK:
            for i in range(self.forward.size):
                self.forward.s[i] = NAN
        return 0

    def on(self, int64_t steps):
        """Take up to this number of steps; returns the `StopReason`."""
        cdef int status
        with nogil:
            status = fb_run_on(&self.run, steps)
        return _REASONS[self.ode.check(status)]

    cdef double _at(self, double since):
        """The absolute time of a relative one: exact at the beginning and the end, and never outside of these."""
        if since == self.run.t_bound:
            return self.t_bound
        if since == self.since_begin:
            return self.t_begin
        cdef double t = self.origin + since
        return min(max(t, min(self.t_begin, self.t_bound)), max(self.t_begin, self.t_bound))

    def time_within(self, double share):
        """The time at a fraction of the last step."""
        return self._at(fb_time_of_fraction(&self.run.stepper, share))

    def state_within(self, double share):
        """The state at a fraction of the last step, shape (n_x,)."""
        cdef cnp.ndarray x = new_array(self.run.stepper.n)
        self.ode.check(fb_state_at(&self.run.stepper, fb_time_of_fraction(&self.run.stepper, share), data(x)))
        return x

    def rates_within(self, double share):
        """x' at a fraction of the last step, shape (n_x,): at its ends, that on the side of the step."""
        return self.ode(fb_time_of_fraction(&self.run.stepper, share), self.state_within(share))

    def sensitivity_within(self, double share):
        """The derivatives at a fraction of the last step, shape (n_x, n)."""
        cdef cnp.ndarray x = self.state_within(share), s = new_array(self.forward.size)
        cdef fb_stepper *stepper = &self.run.stepper
        self.ode.check(fb_forward_at(
            stepper, &self.forward, fb_time_of_fraction(stepper, share), FB_LAST_ANY, data(x), data(s)))
        return _by_directions(s[np.newaxis], &self.forward, self.run.stepper.n, self.directions)[..., 0].T

    def event_values_within(self, double share):
        """The event functions at a fraction of the last step, shape (n_events,)."""
        cdef cnp.ndarray x = self.state_within(share)
        cdef cnp.ndarray values = new_array(self.run.watch.n_events)
        cdef double since = fb_time_of_fraction(&self.run.stepper, share)
        self.ode.check(fb_event_values(&self.run, since, data(x), FB_ALL_EVENTS, data(values)))
        return values

    def stop_within(self, double share):
        """End the run at a fraction of the last step: the state there is the last one, and the last sample."""
        cdef double t = self.time_within(share)
        cdef cnp.ndarray since
        self.ode.check(fb_stop_within(&self.run, fb_time_of_fraction(&self.run.stepper, share)))
        self.t_bound = t
        if self.times is not None:
            taken = self.n_taken + self.run.samples.n
            before = max(taken, np.searchsorted(self.run.direction * self.times, self.run.direction * t))
            is_taken = taken and self.times[taken - 1] == t
            self.times = np.append(self.times[:before], [] if is_taken else [t])
            since = self.times - self.origin
            if len(since) > taken:
                data(since)[len(since) - 1] = self.run.t_bound
            self.run.samples.times, self.run.samples.n_times = <const double *>self._keep(since), len(since)

    def dense_output(self):
        """An empty dense output from the present time on, to which steps are added."""
        if self.foreign is not None:
            return self.foreign.dense_output(self.t, bool(self.run.stepper.project))
        return DenseOutput(self.ode, self.method, self.run.direction, self.run.stepper.project, [self.t],
                           [self.run.stepper.t], [], self.directions)

    @property
    def singular(self):
        """How a run has met a singular position, the least pivot relative to its mean, the time, and the state."""
        cdef fb_singular *singular = &self.run.watch.singular
        cdef cnp.ndarray x = new_array(self.run.stepper.n)
        memcpy(data(x), singular.x, self.run.stepper.n * sizeof(double))
        return _SINGULAR[singular.how], singular.ratio, self.origin + singular.t, x

    @property
    def jump(self):
        """The number of the condition of a jump beside which a run chatters, and its value."""
        return self.run.chattering.condition, self.run.chattering.value

    @property
    def is_stiff(self):
        """Whether stability, not accuracy, has limited the steps of an explicit method."""
        return bool(self.run.stiffness.is_stiff)

    @property
    def t(self):
        """The time reached."""
        return self._at(self.run.stepper.t)

    @property
    def t_old(self):
        """The beginning of the last step."""
        return self._at(self.run.stepper.t_old)

    @property
    def h(self):
        """The length of the last step."""
        return self.run.stepper.h

    @property
    def n_steps(self):
        """Number of steps."""
        return self.run.stepper.n_steps

    @property
    def n_evaluations(self):
        """Number of evaluations of the right-hand side."""
        return self.run.stepper.n_evaluations if self.foreign is None else self.foreign.counts[0]

    @property
    def n_jacobians(self):
        """Number of evaluations of its derivatives."""
        if self.foreign is not None:
            return self.foreign.counts[1]
        return self.augmented.n_jacobians + self.radau.n_jacobians

    @property
    def n_factorizations(self):
        """Number of factorizations for Newton's method and projections, without those of the right-hand side."""
        if self.foreign is not None:
            return self.foreign.counts[2]
        return self.augmented.n_factorizations + self.radau.n_factorizations

    @property
    def x(self):
        """The state reached, shape (n_x,)."""
        return _state_of(&self.run.stepper)


cdef class Steps:
    """The steps of a run, to differentiate costs of its samples backwards: see ``derivatives/adjoint_sensitivity.h``.

    Parameters
    ----------
    ode : Ode
    method : str
        Of `Method`.
    project : bool
    origin : float
        The beginning of the run, to which times are relative.
    ends : ndarray, shape (n, 2 + n_x)
        Time and state at the ends of steps, and their lengths before the state; the length is 0 where the run begins,
        or continues from another state.
    places : ndarray of int, shape (n_t,)
        For each sample the number of the row whose step contains it.
    times, absolute_times : ndarray, shape (n_t,)
        Of the samples.
    clocks : list of (int, float, float, float, float)
        The first row of each piece between discontinuities; the first and last time at which inputs are evaluated; the
        last time of the piece before in the direction of the run, and the first one of this piece.
    """

    cdef Ode ode
    cdef str method
    cdef bint project
    cdef double origin
    cdef cnp.ndarray ends
    cdef cnp.ndarray places
    cdef cnp.ndarray times
    cdef cnp.ndarray absolute_times
    cdef list clocks

    def __cinit__(self, Ode ode not None, str method, bint project, double origin, ends, places, times,
                  absolute_times, list clocks):
        self.ode, self.method, self.project, self.origin = ode, method, project, origin
        self.ends, self.places, self.times, self.clocks = ends, places, times, clocks
        self.absolute_times = absolute_times

    def __reduce__(self):
        return Steps, (self.ode, self.method, bool(self.project), self.origin, self.ends, self.places, self.times,
                       self.absolute_times, self.clocks)

    @property
    def start(self):
        """The initial state, shape (n_x,)."""
        return np.array(self.ends[0, 2:])

    @property
    def end(self):
        """The last state, shape (n_x,), and its time since the beginning."""
        cdef int64_t last = len(self.ends) - 1
        return np.array(self.ends[last, 2:]), float(self.ends[last, 0])

    def gradient(self, wrt_states, wrt_outputs=None):
        """The gradient of a cost, from its derivatives at the samples.

        Parameters
        ----------
        wrt_states : array_like, shape (n_t, n_x)
        wrt_outputs : array_like, shape (n_t, n_o), optional

        Returns
        -------
        wrt_start : ndarray, shape (n_x,)
            With respect to the initial state.
        wrt_parameters : ndarray, shape (n_p,)
        wrt_sources : list of ndarray
            For each input, with respect to its value, shape (1,); or to the coefficients of its table, interval by
            interval, then its values before and after; None without a source.

        Raises
        ------
        SimulationError
            If the equations have no derivative at a state of the run.
        """
        cdef Ode ode = _ode(*self.ode.__reduce__()[1])  # with buffers of its own
        cdef fb_stepper stepper
        cdef fb_adjoint adjoint
        cdef cnp.ndarray state_seeds = np.ascontiguousarray(wrt_states, dtype=np.float64), output_seeds
        cdef cnp.ndarray memory, _steps, part, rates
        cdef int64_t row, sample = np.size(self.times), until
        cdef int status = FB_OK
        cdef double *rest
        memset(&stepper, 0, sizeof(stepper))
        memset(&adjoint, 0, sizeof(adjoint))
        _steps = _place(&stepper, ode, &fb_runge_kutta, tableau_of(self.method), 0, &rest)
        stepper.project = self.project
        memory = np.zeros(fb_place_adjoint(&stepper, &adjoint, NULL))
        fb_place_adjoint(&stepper, &adjoint, data(memory))
        ode.evaluator.function(FB_CONSTRAINT_JVP)
        adjoint.rows = data(self.ends)
        adjoint.sample_row, adjoint.sample_t = <const int64_t *>cnp.PyArray_DATA(self.places), data(self.times)
        adjoint.wrt_states = data(state_seeds)
        if wrt_outputs is not None:
            output_seeds = np.ascontiguousarray(wrt_outputs, dtype=np.float64)
            adjoint.wrt_outputs, adjoint.output_t = data(output_seeds), data(self.absolute_times)
        wrt_sources = [None if source is None else np.zeros(
            np.size((<Table>source).coefficients) + 2 if type(source) is Table else 1) for source in ode.sources]
        cdef cnp.ndarray addresses = np.array([part.ctypes.data for part in wrt_sources if part is not None] or [0],
                                              dtype=np.uintp)
        adjoint.wrt_source = <double **>cnp.PyArray_DATA(addresses)
        rates = _rates_of(ode)
        adjoint.jump.rate = <const int *>cnp.PyArray_DATA(rates)
        row = np.shape(self.ends)[0] - 1
        for first_row, first, last, before, after in reversed(self.clocks):
            ode.problem.clock = fb_clock(origin=self.origin, first=first, last=last)
            adjoint.jump.t_before, adjoint.jump.t_after = before, after
            while row >= first_row and status == FB_OK:
                until = max(first_row, row - 1000)  # then interrupts are possible
                with nogil:
                    while row >= until and status == FB_OK:
                        status = fb_step_vjp(&stepper, &adjoint, row, &sample)
                        row -= 1
        if status != FB_OK:
            raise SimulationError(
                f"There is no gradient: {ode.evaluator.failure(status, self.origin + stepper.t, _state_of(&stepper))}")
        start, wrt_parameters = new_array(stepper.n), new_array(ode.evaluator.n_p)
        part = start
        memcpy(data(part), adjoint.wrt_state, stepper.n * sizeof(double))
        part = wrt_parameters
        memcpy(data(part), adjoint.wrt_parameters, ode.evaluator.n_p * sizeof(double))
        return start, wrt_parameters, wrt_sources


@cython.final
cdef class Stepper:
    """Advances a mechanism by fixed steps, for control loops and real time.

    Each step is one of the classical Runge-Kutta method (four evaluations), or of Radau IIA for stiff equations,
    without error control, followed by a projection of the state onto the constraints; or several, which end at the
    breakpoints of forces and tables, or are shorter because the equations of an implicit step have no solution. It is
    one run: each thread needs a stepper of its own.

    Attributes
    ----------
    t : float
        Time, s: the initial time plus the number of steps times their length; that of an event which ended the run.
    x : ndarray, shape (n_x,)
        The state: coordinates, then speeds.
    status : int
        1 once a terminal event has ended the run, otherwise 0, as for ``solve_ivp``.
    t_events : list of ndarray, shape (n_found,)
        For each event its times within the last step.
    y_events : list of ndarray, shape (n_found, n_x)
        The states there, by the cubic Hermite polynomial through both ends of the step, or the collocation polynomial
        of Radau IIA, projected onto the constraints.

    Source: E. Hairer, S. P. Norsett, G. Wanner, *Solving Ordinary Differential Equations I*, sections II.1 and II.6;
    E. Hairer, G. Wanner, *Solving Ordinary Differential Equations II*, section IV.8.
    """

    cdef Ode ode
    cdef fb_run run
    cdef fb_radau radau
    cdef str method
    cdef object events
    cdef readonly list t_events
    cdef readonly list y_events
    cdef bint has_found  # whether there may be any
    cdef fb_source *sources
    cdef double h, t_begin
    cdef tuple jumps
    cdef cnp.ndarray breakpoints
    cdef fb_breaks breaks
    cdef int n_passed
    cdef list kept
    cdef bint busy

    # The rows of breakpoints are the times, the last ones before them, and the first ones after them.

    def __cinit__(self, Ode ode not None, double h, double t, x, bint project, int64_t n_steps=0, jumps=(),
                  breakpoints=((), (), ()), events=(), str method="RK4"):
        cdef int n = ode.evaluator.n_x
        cdef cnp.ndarray state = vector(x, n, "The state x")
        cdef fb_stepper *stepper = &self.run.stepper
        cdef fb_watch *watch = &self.run.watch
        cdef double *tolerance
        self.ode, self.h, self.jumps, self.t_begin, self.events, self.method = (
            ode, h, tuple(jumps), t, tuple(events), method)
        self.breakpoints = np.array(breakpoints, dtype=np.float64, order="C")
        self.breaks.n, self.breaks.times = self.breakpoints.shape[1], data(self.breakpoints)
        self.breaks.before = self.breaks.times + self.breaks.n
        self.breaks.after = self.breaks.before + self.breaks.n
        self.breaks.first, self.breaks.last = -np.copysign(INFINITY, h), np.copysign(INFINITY, h)
        self.kept = [_place(
            stepper, ode, _steps_of(method), tableau_of(method), 4 * FB_PADDED(n) + n, &watch.along)]
        if method == "Radau":
            tolerance = watch.along + 4 * FB_PADDED(n)
            stepper.rtol = stepper.atol = _fill(tolerance, FB_STEP_TOLERANCE, n)
            self.kept.append(_place_radau(stepper, ode, &self.radau))
        stepper.project, stepper.n_steps, stepper.t = project, n_steps, fb_fixed_time(t, h, n_steps)
        memcpy(stepper.x, data(state), n * sizeof(double))
        self.run.direction, self.run.t_end, watch.ended_by = np.copysign(1.0, h), self.breaks.last, -1
        if events:
            self.kept.append(_place_events(watch, ode, events))
            watch.call, watch.caller = _call_event_of_stepper, <void *>self
        self._list_events(())
        self.sources = <fb_source *>PyMem_Calloc(2 * ode.evaluator.n_r + 1, sizeof(fb_source))
        if not self.sources:
            raise MemoryError

    def __reduce__(self):
        cdef fb_stepper *stepper = &self.run.stepper
        run = (self.t_begin, self.x, bool(stepper.project), stepper.n_steps, self.jumps, self.breakpoints, self.events,
               self.method)
        state = (stepper.t, self._stored_events(), self.run.watch.ended_by, self.t_events, self.y_events)
        return Stepper, (self.ode, self.h, *run), state

    def __setstate__(self, state):
        self.run.stepper.t, events, self.run.watch.ended_by, self.t_events, self.y_events = state
        self._restore_events(events)
        self.has_found = True

    def __dealloc__(self):
        PyMem_Free(self.sources)

    def step(self, r=None):
        """Advance by one step.

        Parameters
        ----------
        r : array_like, shape (n_r,), or mapping, optional
            Inputs to hold constant during the step: all in order, or some by name. The others come from the stepper's
            sources, or from the model's expressions, at the time of each stage, as all do by default. The rates of an
            input that is given by name are 0 unless they are given too.

        Returns
        -------
        ndarray, shape (n_x,)
            The state at its end.

        Raises
        ------
        ModelError
            If an input has a wrong name, or is not finite.
        SimulationError
            If the equations cannot be evaluated, or no state nearby satisfies the constraints; if speeds jump within
            the step, with the rate of a prescribed motion; or if a step is under way already, in another thread, or
            because a callable input requests one; or if an event has ended the run. The state does not change then.
        """
        cdef Evaluator evaluator = self.ode.evaluator
        cdef fb_problem *problem = &self.ode.problem
        cdef fb_problem own = problem[0]
        cdef list callables = self.ode.callables, held = None
        cdef cnp.ndarray values = None  # of all inputs
        cdef fb_stepper *stepper = &self.run.stepper
        cdef int status
        if self.run.watch.ended_by >= 0:
            raise SimulationError(
                f"Event {self.run.watch.ended_by} of this stepper, counted from 0, has ended the run at "
                f"t = {stepper.t:.9g}: a new stepper goes on from its time and state, t and x.")
        if r is not None:
            held = None if type(r) is np.ndarray else evaluator.held_inputs(r)
            if held is None:
                values = evaluator._inputs(stepper.t, self.ode.parameters, r, True)
        if self.jumps:
            self._check_jumps({place for place, _ in held or ()} if values is None else set(range(evaluator.n_r)))
        _enter(&self.busy)
        if values is not None:
            self._hold_all(values)
        elif held:
            self._hold(held)
        problem.status = FB_OK
        if self.breaks.n or self.events or stepper.own != NULL:
            status = self._step_in_parts()
        else:
            status = fb_fixed_step(stepper, self.h, self._time_after(1))
        if held:  # the tables' intervals
            memcpy(own.sources, self.sources, own.n_sources * sizeof(fb_source))
        problem.sources, problem.n_sources, problem.called_inputs = own.sources, own.n_sources, own.called_inputs
        self.ode.callables = callables
        self.busy = False
        self.ode.check(status)
        if status != FB_OK:
            raise SimulationError(self.ode.failure or evaluator.failure(status, stepper.t, self.x))
        return _state_of(stepper)

    cdef int _hold_all(self, cnp.ndarray values) except -1:
        cdef fb_problem *problem = &self.ode.problem
        cdef int i
        for i in range(self.ode.evaluator.n_r):
            self.sources[i] = fb_source(input=i, value=data(values)[i], table=NULL, interval=0)
        problem.sources, problem.n_sources, problem.called_inputs = self.sources, self.ode.evaluator.n_r, NULL
        return 0

    cdef int _hold(self, list held) except -1:
        """Hold some inputs: of several sources of an input, the last one counts."""
        cdef fb_problem *problem = &self.ode.problem
        cdef int place
        memcpy(self.sources, problem.sources, problem.n_sources * sizeof(fb_source))
        if problem.called_inputs:
            places = {place for place, _ in held}
            self.ode.callables = [
                given for given in self.ode.callables if self.sources[<int>given[0]].input not in places]
            if not self.ode.callables:
                problem.called_inputs = NULL
        for place, value in held:
            self.sources[problem.n_sources] = fb_source(input=place, value=value, table=NULL, interval=0)
            problem.n_sources += 1
        problem.sources = self.sources
        return 0

    cdef int _step_in_parts(self) noexcept:
        """A step in parts that end at breakpoints, each with the inputs on its own side of these, or are shorter
        because their equations have no solution, up to an event that ends the run; the kernel's status."""
        cdef fb_run *run = &self.run
        cdef fb_stepper *stepper = &run.stepper
        cdef cnp.ndarray start = _state_of(stepper)
        cdef bytes events = self._stored_events()
        cdef double t_old = stepper.t, t_new = self._time_after(1), t_bound = stepper.t, h
        cdef int64_t n_steps = stepper.n_steps
        cdef fb_passed passed = fb_passed(breaks=&self.breaks, n=self.n_passed)
        cdef list found = []
        cdef int status = FB_OK
        while status == FB_OK and stepper.t != t_new and run.watch.ended_by < 0:
            h = fb_enter_part(stepper, self.h, t_old, t_new, fb_segment_ahead, &passed, &t_bound)
            if not self.events:
                status = fb_fixed_part(stepper, h, t_bound)
            else:
                status = fb_watched_step(run, h, t_bound)
                if status == FB_OK:
                    status = self._find_events(found)
        stepper.problem.clock.first, stepper.problem.clock.last = -INFINITY, INFINITY
        if status == FB_OK:
            self.n_passed = passed.n
            if found or self.has_found:
                self._list_events(found)
        else:  # as it was
            memcpy(stepper.x, data(start), stepper.n * sizeof(double))
            stepper.t, run.watch.ended_by = t_old, -1
            self._restore_events(events)
        stepper.n_steps = n_steps + (status == FB_OK)
        return status

    cdef int _find_events(self, list found) noexcept:
        """Find the events of the last part of a step: number, time and state of each. The step ends at one that ends
        the run."""
        cdef fb_stepper *stepper = &self.run.stepper
        cdef fb_watch *watch = &self.run.watch
        cdef cnp.ndarray x
        cdef double t
        cdef int i, n, status
        while watch.searched < 1.0:
            n = status = fb_find_events(&self.run)
            for i in range(n):
                x, t = new_array(stepper.n), fb_time_of_fraction(stepper, watch.found[i].fraction)
                status = fb_state_at(stepper, t, data(x))
                if status < 0:
                    break
                found.append((watch.found[i].event, t, x))
            if status < 0:
                return status
        if watch.ended_by >= 0:
            memcpy(stepper.x, data(x), stepper.n * sizeof(double))
            stepper.t = t
        return FB_OK

    cdef _list_events(self, found):
        """Set the times and states of the events found in a step."""
        cdef int i, n_x = self.run.stepper.n
        self.t_events, self.y_events, self.has_found = [], [], len(found) > 0
        for i in range(len(self.events)):
            self.t_events.append(np.array([t for k, t, _ in found if k == i]))
            self.y_events.append(np.array([x for k, _, x in found if k == i]).reshape(-1, n_x))

    cdef bytes _stored_events(self):
        """What is known of the events, to be restored."""
        return (<char *>self.run.watch.events)[:self.run.watch.n_events * sizeof(fb_event)]

    cdef _restore_events(self, bytes events):
        memcpy(self.run.watch.events, <char *>events, len(events))

    cdef double _time_after(self, int64_t steps) noexcept:
        """The time after so many more steps."""
        return fb_fixed_time(self.t_begin, self.h, self.run.stepper.n_steps + steps)

    def _check_jumps(self, held):
        """Raise if speeds jump within the next step by something else than inputs that are held, a set of places."""
        cdef double next_time = self._time_after(1)
        for end, begin, inputs in self.jumps:
            if inputs and held.issuperset(inputs):
                continue
            if min(self.t, next_time) < max(end, begin) and max(self.t, next_time) > min(end, begin):
                raise SimulationError(
                    f"The rate of a prescribed motion jumps at t = {begin:.9g}, and speeds with it, within the step "
                    f"from {self.t:.9g} to {next_time:.9g}: CompiledModel.simulate passes it, from where a new "
                    "stepper goes on.")

    @property
    def t(self):
        return self.run.stepper.t

    @property
    def x(self):
        return _state_of(&self.run.stepper)

    @property
    def status(self):
        return 1 if self.run.watch.ended_by >= 0 else 0


cdef int _call_event_of_stepper(void *caller, int place, double t, const double *x, double *value) noexcept with gil:
    cdef Stepper stepper = <Stepper>caller
    return _value_of_event(stepper.ode, &stepper.run.watch, stepper.events[place].number, t, x, value)


@cython.final
cdef class DenseOutput:
    """The state at any time of a run, by the method's interpolant, projected onto the constraints if the run's are.

    Parameters
    ----------
    ode : Ode
    method : str
        As for `Run`.
    direction : float
    project : bool
    times : list of float
        The beginning of the run, and the end of each step.
    ends : list of float
        The same relative to the beginning of the run: with a higher resolution, except on both sides of a jump.
    steps : list of ndarray
        For each step, the interpolant's coefficients, the state at its beginning, its beginning relative to that of the
        run, and its length.
    directions : Directions, optional
        Along which there are derivatives.
    varied : list of ndarray, optional
        For each step, the coefficients of the derivatives' interpolant, and the derivatives at its beginning.
    """

    cdef Ode ode
    cdef str method
    cdef const fb_tableau *tableau
    cdef double direction
    cdef bint project
    cdef int rows, padded
    cdef list times
    cdef list ends
    cdef list steps
    cdef object directions
    cdef list varied

    def __cinit__(self, Ode ode not None, str method, double direction, bint project, list times, list ends,
                  list steps, directions=None, varied=()):
        self.ode, self.method, self.direction, self.project = ode, method, direction, project
        self.times, self.ends, self.steps = times, ends, steps
        self.directions, self.varied = directions, list(varied)
        self.tableau, self.padded = tableau_of(method), FB_PADDED(ode.evaluator.n_x)
        self.rows = self.tableau.n_dense + (3 if self.tableau.hermite else 0)

    def __reduce__(self):
        return DenseOutput, (
            self.ode, self.method, self.direction, bool(self.project), self.times, self.ends, self.steps,
            self.directions, self.varied)

    def __len__(self):
        return len(self.steps)

    def add(self, Run last not None):
        """Add the last step of a run."""
        cdef fb_stepper *stepper = &last.run.stepper
        cdef double *end
        cdef cnp.ndarray step = new_array(self.rows + 2, self.padded)
        last.ode.check(fb_prepare_interpolant(stepper))
        memcpy(data(step), stepper.interpolant, self.rows * self.padded * sizeof(double))
        memcpy(data(step) + self.rows * self.padded, stepper.x_old, self.padded * sizeof(double))
        end = data(step) + (self.rows + 1) * self.padded
        end[0], end[1] = stepper.t_old, stepper.h
        self.times.append(last.t)
        self.ends.append(stepper.t)
        self.steps.append(step)
        if self.directions is not None:
            last.ode.check(fb_forward_prepare_interpolant(stepper, &last.forward))
            step = new_array(self.rows + 1, last.forward.size)
            memcpy(data(step), last.forward.interpolant, self.rows * last.forward.size * sizeof(double))
            memcpy(data(step) + self.rows * last.forward.size, last.forward.s_old, last.forward.size * sizeof(double))
            self.varied.append(step)

    def __call__(self, t):
        """The state at times t: shape (n_x,) for a number, (n_x, n) for n of them.

        Raises
        ------
        ModelError
            If a time is outside of the run, since the interpolants are not valid there.
        """
        cdef cnp.ndarray at = self._checked(t)
        cdef int i, n = self.ode.evaluator.n_x
        cdef cnp.ndarray x = np.empty((np.size(at), n))
        places = steps_at(at, self.direction, self.times, self.ends)
        for i in range(np.size(at)):
            self._state_at(data(at)[i], places[i], data(x) + i * n)
        return np.array(x.T) if np.ndim(t) else x[0]

    def sensitivity(self, t):
        """The derivatives of the state at times t, as `Trajectory.sensitivity` has them.

        Parameters
        ----------
        t : float or array_like, shape (n_t,)

        Returns
        -------
        dict of str to ndarray, shape (n_x,) for a number, (n_x, n_t) for n_t of them
            With a leading axis for the values of a table.

        Raises
        ------
        ModelError
            If a time is outside of the run, or the run has no sensitivities.
        """
        if self.directions is None:
            raise ModelError("The run has no sensitivities: simulate(..., sensitivities=[...]) finds them.")
        cdef cnp.ndarray at = self._checked(t)
        cdef Ode ode = self.ode
        cdef int i, n = ode.evaluator.n_x
        cdef cnp.ndarray x = np.empty((np.size(at), n)), s, step
        cdef fb_stepper stepper
        cdef double *rest
        cdef fb_forward forward
        cdef double *end
        cdef list kept = []
        memset(&stepper, 0, sizeof(stepper))
        memset(&forward, 0, sizeof(forward))
        kept.append(_place(&stepper, ode, &fb_runge_kutta, self.tableau, 0, &rest))
        _prepare_forward(&stepper, &forward, ode, self.directions, kept)
        s = np.empty((np.size(at), forward.size))
        places = steps_at(at, self.direction, self.times, self.ends)
        for i in range(np.size(at)):
            end = self._state_at(data(at)[i], places[i], data(x) + i * n)
            step = self.varied[places[i]]
            fb_interpolate(self.tableau, data(step), forward.size, forward.size, data(step) + self.rows * forward.size,
                           (data(at)[i] - self.times[0] - end[0]) / end[1], data(s) + i * forward.size)
            if self.project:
                ode.check(fb_forward_close(
                    &stepper, &forward, 0.0, FB_LAST_ANY, data(x) + i * n, data(s) + i * forward.size))
        derivatives = _by_directions(s, &forward, n, self.directions)
        return self.directions.by_name(derivatives if np.ndim(t) else derivatives[..., 0])

    cdef cnp.ndarray _checked(self, t):
        """Times within the run, as an array of one dimension."""
        cdef cnp.ndarray at = np.atleast_1d(numbers(t, "The times"))
        if np.ndim(at) != 1:
            raise ModelError(f"Times must be a number or an array of one dimension, not of shape {np.shape(t)}.")
        check_within(at, self.times[0], self.times[len(self.times) - 1])  # without wraparound
        return at

    cdef double *_state_at(self, double t, int64_t place, double *x) except NULL:
        """The state at a time in a step; returns the step's beginning and length."""
        cdef cnp.ndarray step = self.steps[place]
        cdef int n = self.ode.evaluator.n_x
        cdef double origin = self.times[0]
        cdef double *end = data(step) + (self.rows + 1) * self.padded
        fb_interpolate(self.tableau, data(step), n, self.padded, data(step) + self.rows * self.padded,
                       (t - origin - end[0]) / end[1], x)
        if self.project:
            # At the absolute time, since the relative one may be on the other side of a jump.
            self.ode.clock = t, -INFINITY, INFINITY
            self.ode.check(fb_project_sample(&self.ode.problem, 0.0, x))
        return end
