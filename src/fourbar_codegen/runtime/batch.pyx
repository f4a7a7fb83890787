# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Batches of states, and ensembles of runs: see ``lanes/batch.h``."""

cimport cython
cimport numpy as cnp
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.stdint cimport int8_t, int64_t
from libc.stdlib cimport free
from libc.string cimport memcpy

from fourbar_codegen.runtime.evaluator cimport (
    FB_CONSTRAINT_JVP, FB_STATE_PARTIALS, Evaluator, data, fb_batch_functions, fb_kernel, fb_source)
from fourbar_codegen.runtime.integrator cimport Table, fb_breaks, fb_event, fb_tableau, set_event, tableau_of

import numpy as np

cnp.import_array()

cdef extern from "lanes/batch.h":
    ctypedef struct fb_batch_array:
        const double *values
        int64_t stride
    ctypedef struct fb_batch:
        const fb_kernel *kernel
        int64_t n
        fb_batch_array t, x, p, r
        double *rates
    int fb_batch_one_by_one(const fb_batch *, int64_t, int64_t) noexcept nogil
    const int FB_MEMBER_DONE
    const int FB_MEMBER_TERMINATED
    ctypedef struct fb_run
    ctypedef struct fb_found_rows:
        fb_found_rows *next
        double *rows
        int64_t n, room
    ctypedef struct fb_ensemble_events:
        int n
        const fb_event *events
        int (*begin)(fb_run *) noexcept nogil
        int (*excludes)(fb_run *) noexcept nogil
        int (*find)(fb_run *) noexcept nogil
        fb_found_rows **found
    ctypedef struct fb_counters:
        int64_t *next
        int64_t *n_ended
        const int *stop
    ctypedef struct fb_ensemble:
        const fb_kernel *kernel
        int64_t n
        double *x
        const double *p
        int n_sources
        const fb_source *sources
        const double *values
        const fb_tableau *method
        int project
        double origin, t_bound, max_step
        fb_breaks breaks
        int64_t max_steps
        const double *rtol
        const double *atol
        const double *times
        int64_t n_times
        fb_ensemble_events events
        double *samples
        int8_t *status
        int64_t *n_evaluations
        fb_counters counters
    ctypedef struct fb_batch_functions:
        int width
        int (*batch)(const fb_batch *, int64_t, int64_t) noexcept nogil
        int (*run)(const fb_ensemble *) noexcept nogil

cdef extern from "run/events.h":
    int fb_begin_events(fb_run *) noexcept nogil
    int fb_excludes_events(fb_run *) noexcept nogil
    int fb_find_events(fb_run *) noexcept nogil

cdef extern from "lanes/jacobians.h":
    const int FB_INDEX_1
    const int FB_INDEX_3
    ctypedef struct fb_jacobians:
        const fb_kernel *kernel
        int64_t n
        fb_batch_array t, x, p, r, rates, multipliers
        const char *in_force
        int variables
        double *of_rates
        double *of_outputs
        int formulation
        double *residual
        double *wrt_state
        double *wrt_rate
        double *wrt_parameters
        double *wrt_inputs
    int fb_evaluate_jacobians(const fb_jacobians *, int64_t, int64_t) noexcept nogil

DONE, TERMINATED = FB_MEMBER_DONE, FB_MEMBER_TERMINATED


cdef const fb_batch_functions *_batch_functions(Evaluator evaluator) noexcept:
    """The functions for batches of states, or NULL."""
    cdef const fb_batch_functions *functions = evaluator.kernel.batch_functions
    return functions if functions != NULL and functions.width > 1 else NULL


def width(Evaluator evaluator not None):
    """The number of lanes, with a state in each."""
    return _batch_functions(evaluator).width if _batch_functions(evaluator) != NULL else 1


cdef fb_batch_array _batch_array(cnp.ndarray array, int axes):
    """Values of each state in the columns of an array with that number of axes, or one column common to all."""
    cdef fb_batch_array result
    result.values = data(array)
    result.stride = cnp.PyArray_DIM(array, axes - 1) if cnp.PyArray_NDIM(array) == axes else 0
    return result


@cython.final
cdef class Batch:
    """The right-hand side at a batch of states; arrays are of double and contiguous, see `_batch_array`.

    Parameters
    ----------
    evaluator : Evaluator
    t : ndarray, shape () or (n,)
    x : ndarray, shape (n_x, n)
    p : ndarray, shape (n_p,) or (n_p, n)
    r : ndarray, shape (n_r,) or (n_r, n), or None
        None for the inputs' expressions.
    rates : ndarray, shape (n_x, n)
        The array for the results.
    """

    cdef fb_batch batch
    cdef Evaluator evaluator
    cdef list kept

    def __cinit__(self, Evaluator evaluator not None, t, x, p, r, cnp.ndarray rates not None):
        self.evaluator, self.kept = evaluator, [t, x, p, r, rates]
        self.batch.kernel, self.batch.n, self.batch.rates = evaluator.kernel, np.shape(x)[1], data(rates)
        self.batch.t, self.batch.x, self.batch.p = _batch_array(t, 1), _batch_array(x, 2), _batch_array(p, 2)
        if r is not None:
            self.batch.r = _batch_array(r, 2)

    def evaluate(self, int64_t begin, int64_t end):
        """Evaluate the states from begin to end; other threads may evaluate others at the same time."""
        cdef const fb_batch_functions *functions = _batch_functions(self.evaluator)
        cdef int status
        with nogil:
            if functions != NULL:
                status = functions.batch(&self.batch, begin, end)
            else:
                status = fb_batch_one_by_one(&self.batch, begin, end)
        if status:
            raise MemoryError


@cython.final
cdef class Jacobians:
    """Jacobians at a batch of states; arrays are of double and contiguous, see `Batch`.

    Parameters
    ----------
    evaluator : Evaluator
    t, x, p, r
        As for `Batch`.
    in_force : ndarray of bool, shape (n_r,)
        The inputs that follow the parameters by their expressions.

    Attributes
    ----------
    results : list of ndarray
        Of `differentiate`: the Jacobians of x', (n, n_x, m), and of the outputs, (n, n_o, m). Of `form`: the residual,
        (n, n_x + n_l), or its Jacobians, in the order asked for.
    """

    cdef fb_jacobians batch
    cdef Evaluator evaluator
    cdef list kept
    cdef readonly list results

    def __cinit__(self, Evaluator evaluator not None, t, x, p, r, cnp.ndarray in_force not None):
        self.evaluator, self.kept = evaluator, [t, x, p, r, in_force]
        evaluator.function(FB_STATE_PARTIALS)
        self.batch.kernel, self.batch.n = evaluator.kernel, np.shape(x)[1]
        self.batch.t, self.batch.x, self.batch.p = _batch_array(t, 1), _batch_array(x, 2), _batch_array(p, 2)
        self.batch.in_force = <const char *>cnp.PyArray_DATA(in_force)
        if r is not None:
            self.batch.r = _batch_array(r, 2)

    def differentiate(self, str variables, bint outputs):
        """Prepare derivatives with respect to "state", "parameters" or "inputs"."""
        cdef int places = ("state", "parameters", "inputs").index(variables)
        cdef Evaluator e = self.evaluator
        cdef int m = (e.n_x, e.n_p, e.n_r)[places]
        cdef cnp.ndarray rates = np.empty((self.batch.n, e.n_x, m)), of_outputs
        self.batch.variables, self.batch.of_rates, self.results = places, data(rates), [rates]
        if outputs:
            of_outputs = np.empty((self.batch.n, e.n_o, m))
            self.batch.of_outputs = data(of_outputs)
            self.results.append(of_outputs)

    def form(self, rates, multipliers, str formulation, wrt):
        """Prepare the residual, for x' and multipliers in columns, or its Jacobians.

        They are by "y" for (x, multipliers), "rates", "p" or "r". Without any of these, it is the residual.
        """
        cdef Evaluator e = self.evaluator
        cdef int n_y = e.n_x + e.n_l
        cdef cnp.ndarray part
        cdef double *result
        e.function(FB_CONSTRAINT_JVP)
        self.kept += [rates, multipliers]
        self.batch.rates, self.batch.multipliers = _batch_array(rates, 2), _batch_array(multipliers, 2)
        self.batch.formulation = FB_INDEX_1 if formulation == "index-1" else FB_INDEX_3
        self.results = []
        if not wrt:
            part = np.empty((self.batch.n, n_y))
            self.batch.residual = data(part)
            self.results.append(part)
        for name in wrt:
            part = np.zeros((self.batch.n, n_y, {"y": n_y, "rates": n_y, "p": e.n_p, "r": e.n_r}[name]))
            result = data(part)
            self.results.append(part)
            if name == "y":
                self.batch.wrt_state = result
            elif name == "rates":
                self.batch.wrt_rate = result
            elif name == "p":
                self.batch.wrt_parameters = result
            else:
                self.batch.wrt_inputs = result

    def evaluate(self, int64_t begin, int64_t end):
        """Evaluate the states from begin to end; other threads may evaluate others at the same time."""
        cdef int status
        with nogil:
            status = fb_evaluate_jacobians(&self.batch, begin, end)
        if status:
            raise MemoryError


@cython.final
cdef class Members:
    """Runs of a method of `Method`, a run in each lane; arrays are of double and contiguous.

    Parameters
    ----------
    evaluator : Evaluator
    method : str
    t, t_bound : float
        Beginning and end.
    x : ndarray, shape (n, n_x)
        The initial states, which are projected onto the constraints.
    p : ndarray, shape (n, n_p)
    sources : sequence of length n_r
        For each input None (its expression), an array of shape (n,), or a `Table`.
    max_step : float
    rtol, atol : ndarray, shape (n_x,)
    project : bool
    times : ndarray, shape (n_t,)
    breaks : ndarray, shape (3, n)
        Sorted breakpoints of inputs, at which steps end; the times up to which inputs are evaluated before
        them; and those from which on after them.
    max_steps : int
        After this number of steps a member has to be run alone; 0 for no limit.
    events : sequence of EventRow
        Callables are not called.

    Attributes
    ----------
    samples : ndarray, shape (n, n_x, n_t)
        NaN for missing samples.
    status : ndarray of int8, shape (n,)
        `DONE`, `TERMINATED` by an event, or something else.
    n_evaluations : ndarray of int, shape (n,)
    """

    cdef fb_ensemble ensemble
    cdef Evaluator evaluator
    cdef fb_source *sources
    cdef fb_event *events
    cdef fb_found_rows *rows
    cdef int64_t next, ended
    cdef int stopped
    cdef list kept
    cdef readonly object samples, status, n_evaluations

    def __cinit__(self, Evaluator evaluator not None, str method, double t, double t_bound, x, p, sources,
                  double max_step, rtol, atol, bint project, times, breaks, int64_t max_steps, events):
        cdef fb_ensemble *e = &self.ensemble
        cdef int64_t n = len(x)
        cdef int k = 0
        cdef cnp.ndarray samples = np.full((n, evaluator.n_x, len(times)), np.nan)
        cdef cnp.ndarray status = np.zeros(n, dtype=np.int8)
        cdef cnp.ndarray n_evaluations = np.zeros(n, dtype=np.int64)
        given = [(i, source) for i, source in enumerate(sources) if source is not None]
        cdef cnp.ndarray values = np.zeros((n, len(given)))
        towards = np.copysign(np.inf, t_bound - t)
        ends, before, after = breaks
        e.breaks.first = after[0] if t in ends else -towards
        e.breaks.last = before[len(ends) - 1] if t_bound in ends else towards
        breaks, times = np.ascontiguousarray(breaks[:, (ends != t) & (ends != t_bound)]), times - t
        self.evaluator, self.kept = evaluator, [x, p, rtol, atol, times, breaks, values, given]
        self.samples, self.status, self.n_evaluations = samples, status, n_evaluations
        self.sources = <fb_source *>PyMem_Calloc(len(given) + 1, sizeof(fb_source))
        self.events = <fb_event *>PyMem_Calloc(len(events) + 1, sizeof(fb_event))
        if self.sources == NULL or self.events == NULL:
            raise MemoryError
        for k, event in enumerate(events):
            set_event(self.events + k, event, k)
        e.events.n, e.events.events, e.events.found = len(events), self.events, &self.rows
        e.events.begin, e.events.excludes = fb_begin_events, fb_excludes_events
        e.events.find = fb_find_events
        for k, (i, source) in enumerate(given):
            self.sources[k].input = i
            if type(source) is Table:
                self.sources[k].table = &(<Table>source).table
            else:
                values[:, k] = source
        e.kernel, e.n, e.x, e.p = evaluator.kernel, n, data(x), data(p)
        e.n_sources, e.sources, e.values = len(given), self.sources, data(values)
        e.method = tableau_of(method)
        if not e.method.n_errors:
            raise ValueError(f"no step control for many runs: {method}")
        e.project, e.origin, e.t_bound, e.max_step, e.max_steps = project, t, t_bound - t, max_step, max_steps
        e.breaks.n, e.breaks.times = np.shape(breaks)[1], data(breaks)
        e.breaks.before, e.breaks.after = data(breaks) + e.breaks.n, data(breaks) + 2 * e.breaks.n
        e.rtol, e.atol, e.times, e.n_times = data(rtol), data(atol), data(times), len(times)
        e.samples, e.status = data(samples), <int8_t *>cnp.PyArray_DATA(status)
        e.n_evaluations = <int64_t *>cnp.PyArray_DATA(n_evaluations)
        e.counters = fb_counters(next=&self.next, n_ended=&self.ended, stop=&self.stopped)

    def __dealloc__(self):
        cdef fb_found_rows *rows = self.rows
        PyMem_Free(self.sources)
        PyMem_Free(self.events)
        while rows != NULL:
            self.rows = rows.next
            free(rows.rows)
            free(rows)
            rows = self.rows

    @property
    def found(self):
        """The events found, in rows of the member, the event, the time and the state, in the order of times for each
        member; event -1 - i has the last time at which function i was zero with the same sign before and after."""
        cdef fb_found_rows *rows = self.rows
        cdef cnp.ndarray part
        cdef int n_columns = 3 + self.evaluator.n_x
        parts = [np.empty((0, n_columns))]
        while rows != NULL:
            part = np.empty((rows.n, n_columns))
            if rows.n:
                memcpy(data(part), rows.rows, rows.n * n_columns * sizeof(double))
            part[:, 2] += self.ensemble.origin
            parts.append(part)
            rows = rows.next
        return np.concatenate(parts)

    def run(self):
        """Run members until none is waiting; other threads may do so at the same time."""
        cdef const fb_batch_functions *functions = _batch_functions(self.evaluator)
        cdef int status = 0
        if functions != NULL:
            with nogil:
                status = functions.run(&self.ensemble)
        if status:
            raise MemoryError

    def stop(self):
        """Stop all threads after their next step."""
        self.stopped = 1

    @property
    def n_ended(self):
        """The number of members that have ended."""
        return self.ended
