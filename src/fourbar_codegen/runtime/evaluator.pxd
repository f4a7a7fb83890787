# cython: language_level=3
"""Declarations shared by the runtime's extension modules."""

cimport numpy as cnp
from libc.stdint cimport int64_t

cdef extern from "fourbar_kernel.h":
    const int FB_ABI_VERSION
    const char *FB_CAPSULE_NAME
    int FB_DIRECTIONS
    int FB_N_ROLES
    int FB_VECTOR
    int FB_OK
    int FB_CONSTRAINTS_DEPENDENT
    int FB_MASS_SINGULAR
    int FB_NOT_FINITE
    int FB_NOT_CLOSED
    int FB_NOT_SOLVED
    int FB_CONSTRAINTS_INDEPENDENT
    int FB_FORCES_UNDETERMINED
    int FB_FORCES_NOT_FOUND
    int FB_NEEDS_STATE
    int FB_NEEDS_COORDINATES
    int FB_NEEDS_INPUTS
    int FB_NEEDS_ACCELERATIONS
    int FB_NEEDS_MULTIPLIERS
    enum FB_LAST:
        FB_LAST_ANY
    int FB_BREAKPOINTS
    int FB_ENERGY
    int FB_DRAWING, FB_MOTION
    int FB_STATE_PARTIALS
    int FB_PARAMETER_PARTIALS
    int FB_INPUT_PARTIALS
    int FB_DEFAULT_INPUT_PARTIALS
    int FB_OUTPUT_STATE_PARTIALS
    int FB_OUTPUT_PARAMETER_PARTIALS
    int FB_OUTPUT_INPUT_PARTIALS
    int FB_OUTPUT_SOLUTION_PARTIALS
    int FB_RESIDUAL_JVP
    int FB_CONSTRAINT_JVP
    ctypedef struct fb_batch_functions
    ctypedef int fb_evaluation(double, const double *, const double *, const double *, double *, void *) noexcept nogil
    ctypedef struct fb_at:
        double t
        const double *x
        const double *constants
        const double *r
        const double *accelerations
        const double *multipliers
        int n_directions
    ctypedef struct fb_array:
        const char *name
        int rows, columns
    ctypedef struct fb_function:
        int (*call)(const fb_at *, const double *const *, double *const *, void *) noexcept nogil
        int needs, n_arguments, n_results
        const fb_array *arguments
        const fb_array *results
    ctypedef struct fb_part
    bint fb_attach(fb_function *, const fb_part *) noexcept nogil
    ctypedef struct fb_kernel:
        int abi_version
        int64_t struct_size
        int n_roles
        int64_t work_size
        int n_q, n_u, n_z, n_x, n_p, n_r, n_h, n_c, n_l, n_i, n_o, n_breakpoints, n_conditions, n_constants
        int states_need_solution, outputs_need_solution, outputs_need_inputs
        void (*prepare)(const double *, double *) noexcept nogil
        void (*default_inputs)(double, const double *, double *) noexcept nogil
        fb_evaluation *rhs
        int (*differentiate)(const fb_function *, int, int, double, const double *, const double *, const double *,
                             double *, double *, void *) noexcept nogil
        int (*jvp)(const fb_function *, double, const double *, const double *, const double *, const double *, int,
                   const double *, double *, void *) noexcept nogil
        int (*vjp)(const fb_function *, double, const double *, const double *, const double *, const double *,
                   double *, void *) noexcept nogil
        int (*accelerations)(double, const double *, const double *, const double *, double *, double *,
                             void *) noexcept nogil
        int (*toggled)(void *) noexcept nogil
        const fb_function *functions
        const fb_part *derivatives
        const fb_part *products
        const fb_batch_functions *batch_functions
        int batch_functions_apart
        int one_machine
        int instructions
        const fb_kernel *faster
    bint fb_runs_here(const fb_kernel *) noexcept nogil

cdef enum:
    FB_ARRAYS = 8  # results or arguments of a function, at most

cdef extern from "kernel/problem.h":
    ctypedef struct fb_table:
        int n_intervals, n_coefficients
        const double *times
        const double *coefficients
        double before, after
    ctypedef struct fb_source:
        int input
        double value
        const fb_table *table
        int interval
    ctypedef struct fb_clock:
        double origin, first, last
    const fb_clock fb_all_time
    double fb_time(const fb_clock *, double) noexcept nogil
    ctypedef struct fb_problem
    ctypedef int fb_called_inputs(fb_problem *, double, const double *) noexcept nogil
    ctypedef struct fb_problem:
        const fb_kernel *kernel
        double *constants
        double *inputs
        void *work
        fb_clock clock
        double stabilization
        int n_sources
        fb_source *sources
        fb_called_inputs *called_inputs
        void *caller
        int status
        double failed_t
        double *failed_x
        double *moved_x
    int fb_fill_inputs(fb_problem *, double, const double *) noexcept nogil
    void fb_problem_results(const fb_problem *, int, double, const double *, const double *, const double *,
                            const double *const *, double *const *) noexcept nogil
    int fb_problem_rates(void *, double, const double *, double *) noexcept nogil
    int fb_problem_jacobian(fb_problem *, const fb_function *, double, const double *, double *) noexcept nogil
    int fb_problem_project(fb_problem *, double, double *, int) noexcept nogil
    int fb_finite(const double *, int) noexcept nogil


cdef cnp.ndarray new_array(int rows, int columns=*)
cdef inline double *data(cnp.ndarray array) noexcept:
    return <double *>cnp.PyArray_DATA(array)

cpdef cnp.ndarray numbers(object values, str what)
cpdef object number(object value, str what)
cdef inline object time_of(object t):
    return t if type(t) is float else number(t, "The time t")
cdef cnp.ndarray rows(object columns, str what)
cdef cnp.ndarray vector(object values, int n, str what)


cdef class Evaluator:
    cdef const fb_kernel *kernel
    cdef fb_kernel own
    cdef fb_function *functions
    cdef readonly object capsule
    cdef readonly object layout
    cdef readonly int n_q, n_u, n_z, n_x, n_p, n_r, n_h, n_c, n_l, n_i, n_o
    cdef double *default_constants
    cdef double *constants
    cdef double *inputs
    cdef void *work
    cdef cnp.ndarray default_parameters
    cdef bint has_defaults
    cdef readonly bint has_inputs
    cdef readonly bint states_need_solution
    cdef bint has_prescribed
    cdef cnp.ndarray _parameters(self, object p)
    cdef cnp.ndarray _inputs(self, double t, cnp.ndarray parameters, object r, bint known, bint all_count=*)
    cdef cnp.ndarray _state(self, double t, object x, int n)
    cdef const double *_prepare(self, cnp.ndarray parameters) noexcept
    cdef const double *_fill(self, double t, const double *constants, cnp.ndarray inputs) noexcept
    cdef int _check_columns(self, cnp.ndarray t, cnp.ndarray x, cnp.ndarray r) except -1
    cdef cnp.ndarray _output(self, object out, cnp.ndarray state, cnp.ndarray parameters, cnp.ndarray inputs)
    cdef const fb_function *function(self, int role) except NULL
    cdef cnp.ndarray _differentiate(self, int role, int columns, double t, x, p, r, cnp.ndarray multipliers=*)
    cdef cnp.ndarray _differentiate_outputs(self, int role, int outputs, int columns, double t, x, p, r)
    cdef cnp.ndarray _through_inputs(self, cnp.ndarray wrt_inputs, cnp.ndarray wrt_parameters, list changing)
