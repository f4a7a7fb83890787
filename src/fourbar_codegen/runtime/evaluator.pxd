# cython: language_level=3
"""Declarations shared by the runtime's extension modules."""

cimport numpy as cnp

cdef extern from "fourbar_kernel.h":
    const int FB_ABI_VERSION
    const char *FB_CAPSULE_NAME
    int FB_DIRECTIONS
    int FB_OK
    int FB_CONSTRAINTS_DEPENDENT
    int FB_MASS_SINGULAR
    int FB_NOT_FINITE
    int FB_NOT_CLOSED
    int FB_CONSTRAINTS_INDEPENDENT
    int FB_FORCES_UNDETERMINED
    int FB_FORCES_NOT_FOUND
    enum FB_LAST:
        FB_LAST_ANY
    ctypedef struct fb_batch_functions
    ctypedef int fb_evaluation(double, const double *, const double *, const double *, double *, void *) noexcept nogil
    ctypedef void fb_sensitivity(double, const double *, const double *, const double *, const double *,
                                 const double *, double *, double *) noexcept nogil
    ctypedef void fb_output_sensitivity(double, const double *, const double *, const double *, const double *,
                                        const double *, double *) noexcept nogil
    ctypedef struct fb_derivatives:
        int abi_version
        size_t struct_size
        fb_sensitivity *sensitivity
        fb_sensitivity *parameter_sensitivity
        fb_sensitivity *input_sensitivity
        void (*default_input_sensitivity)(double, const double *, double *) noexcept nogil
        void (*constraint_sensitivity)(double, const double *, const double *, const double *, double *, double *,
                                       double *) noexcept nogil
        void (*state_rate_sensitivity)(double, const double *, const double *, const double *, const double *,
                                       const double *, double *, double *) noexcept nogil
        fb_output_sensitivity *output_sensitivity
        fb_output_sensitivity *output_parameter_sensitivity
        fb_output_sensitivity *output_input_sensitivity
        void (*output_solution_sensitivity)(double, const double *, const double *, const double *, const double *,
                                            const double *, double *, double *) noexcept nogil
        void (*drawing)(double, const double *, const double *, const double *, double *, double *) noexcept nogil
        void (*motion)(double, const double *, const double *, const double *, const double *, double *, double *,
                       double *) noexcept nogil
    ctypedef struct fb_variations:
        int abi_version
        size_t struct_size
        void (*variation)(double, const double *, const double *, const double *, const double *, const double *, int,
                          const double *, double *, double *) noexcept nogil
        void (*constraint_variation)(double, const double *, const double *, const double *, int, const double *,
                                     double *, double *) noexcept nogil
        void (*pullback)(double, const double *, const double *, const double *, const double *, const double *,
                         const double *, double *) noexcept nogil
        void (*constraint_pullback)(double, const double *, const double *, const double *, const double *,
                                    double *) noexcept nogil
    ctypedef struct fb_kernel:
        int abi_version
        size_t struct_size
        size_t work_size
        int n_q, n_u, n_z, n_x, n_p, n_r, n_h, n_c, n_l, n_i, n_o, n_breakpoints, n_points, n_forces, n_constants
        int states_need_solution
        const int *position_row
        void (*prepare)(const double *, double *) noexcept nogil
        void (*default_inputs)(double, const double *, double *) noexcept nogil
        void (*breakpoints)(const double *, double *) noexcept nogil
        fb_evaluation *rhs
        int (*stabilized)(double, const double *, const double *, const double *, double, double *,
                          void *) noexcept nogil
        int (*differentiate)(const fb_derivatives *, fb_sensitivity *, int, double, const double *, const double *,
                             const double *, double *, double *, void *) noexcept nogil
        int (*vary)(const fb_derivatives *, const fb_variations *, double, const double *, const double *,
                    const double *, const double *, int, const double *, double *, void *) noexcept nogil
        int (*vary_closed)(const fb_derivatives *, const fb_variations *, double, const double *, const double *,
                           const double *, FB_LAST, int, double *, void *) noexcept nogil
        int (*pull_back)(const fb_derivatives *, const fb_variations *, double, const double *, const double *,
                         const double *, const double *, double *, void *) noexcept nogil
        int (*pull_back_closed)(const fb_derivatives *, const fb_variations *, double, const double *, const double *,
                                const double *, double *, void *) noexcept nogil
        int (*accelerations)(double, const double *, const double *, const double *, double *, double *,
                             void *) noexcept nogil
        void (*state_rates)(double, const double *, const double *, const double *, const double *, const double *,
                            double *) noexcept nogil
        void (*dynamics)(double, const double *, const double *, const double *, double *, double *, double *,
                         double *, double *) noexcept nogil
        void (*unknown_forces)(double, const double *, const double *, const double *, const double *, double *,
                               double *, double *, double *, double *, double *) noexcept nogil
        void (*position)(double, const double *, const double *, const double *, double *, double *) noexcept nogil
        void (*velocity)(double, const double *, const double *, const double *, double *, double *) noexcept nogil
        void (*constraint_violation)(double, const double *, const double *, const double *, double *,
                                     double *) noexcept nogil
        void (*constraint_scale)(double, const double *, const double *, const double *, double *, double *,
                                 double *) noexcept nogil
        void (*invariant_correction)(double, const double *, const double *, const double *, double *) noexcept nogil
        void (*coordinate_change)(double, const double *, const double *, const double *, const double *,
                                  double *) noexcept nogil
        int (*project)(double, double *, const double *, const double *, int, void *) noexcept nogil
        int (*orientation_changed)(void *) noexcept nogil
        void (*energy)(double, const double *, const double *, const double *, double *) noexcept nogil
        void (*output)(double, const double *, const double *, const double *, const double *, const double *,
                       double *) noexcept nogil
        const fb_derivatives *derivatives
        const fb_variations *variations
        const fb_batch_functions *batch_functions
        int batch_functions_apart
        int one_machine
        int instructions
        const fb_kernel *faster
    bint fb_runs_here(const fb_kernel *) noexcept nogil

cdef extern from "fourbar_problem.h":
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
    int fb_problem_rates(void *, double, const double *, double *) noexcept nogil
    int fb_problem_jacobian(fb_problem *, double, const double *, double *) noexcept nogil
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
    cdef readonly object capsule
    cdef readonly dict manifest
    cdef readonly int n_q, n_u, n_z, n_x, n_p, n_r, n_h, n_c, n_l, n_i, n_o
    cdef double *default_constants
    cdef double *constants
    cdef double *inputs
    cdef void *work
    cdef cnp.ndarray default_parameters
    cdef bint has_defaults
    cdef readonly bint has_inputs
    cdef readonly bint states_need_solution
    cdef bint has_motions
    cdef cnp.ndarray _parameters(self, object p)
    cdef cnp.ndarray _inputs(self, double t, cnp.ndarray parameters, object r, bint known)
    cdef cnp.ndarray _state(self, double t, object x, int n)
    cdef const double *_prepare(self, cnp.ndarray parameters) noexcept
    cdef const double *_fill(self, double t, const double *constants, cnp.ndarray inputs) noexcept
    cdef int _check_columns(self, cnp.ndarray t, cnp.ndarray x, cnp.ndarray r) except -1
    cdef cnp.ndarray _output(self, object out, cnp.ndarray state, cnp.ndarray parameters, cnp.ndarray inputs)
    cdef const fb_derivatives *derivatives(self) except NULL
    cdef const fb_variations *variations(self) except NULL
    cdef cnp.ndarray _differentiate(self, fb_sensitivity *function, int columns, double t, x, p, r)
    cdef cnp.ndarray _differentiate_outputs(
        self, fb_sensitivity *function, fb_output_sensitivity *outputs, int columns, double t, x, p, r)
    cdef cnp.ndarray _through_inputs(self, cnp.ndarray by_inputs, cnp.ndarray by_parameters, list changing)
