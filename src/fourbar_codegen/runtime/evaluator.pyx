# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Calls kernels: argument checks, evaluation, and the right-hand side as a callable for an integrator."""

cimport cython
cimport numpy as cnp
from cpython.mem cimport PyMem_Calloc, PyMem_Free, PyMem_Malloc
from cpython.pycapsule cimport PyCapsule_GetPointer
from libc.math cimport NAN

import numpy as np

from fourbar_codegen.errors import ModelError, SimulationError

cnp.import_array()

cdef extern from "fourbar_kernel.h":
    const int FB_ABI_VERSION
    const char *FB_CAPSULE_NAME
    int FB_OK
    int FB_CONSTRAINTS_DEPENDENT
    int FB_MASS_SINGULAR
    int FB_NOT_FINITE
    ctypedef int fb_evaluation(double, const double *, const double *, const double *, double *, void *) noexcept nogil
    ctypedef void fb_sensitivity(double, const double *, const double *, const double *, const double *,
                                 const double *, double *, double *) noexcept nogil
    ctypedef struct fb_kernel:
        int abi_version
        size_t struct_size
        size_t work_size
        int n_q, n_u, n_p, n_r, n_h, n_c, n_o, n_constants
        void (*prepare)(const double *, double *) noexcept nogil
        void (*default_inputs)(double, const double *, double *) noexcept nogil
        fb_evaluation *rhs
        fb_evaluation *jacobian
        fb_evaluation *parameter_jacobian
        fb_evaluation *input_jacobian
        int (*accelerations)(double, const double *, const double *, const double *, double *, double *,
                             void *) noexcept nogil
        void (*dynamics)(double, const double *, const double *, const double *, double *, double *, double *,
                         double *, double *) noexcept nogil
        void (*position)(double, const double *, const double *, const double *, double *, double *) noexcept nogil
        void (*velocity)(double, const double *, const double *, const double *, double *, double *) noexcept nogil
        void (*constraint_sensitivity)(double, const double *, const double *, const double *, double *, double *,
                                       double *) noexcept nogil
        void (*energy)(double, const double *, const double *, const double *, double *) noexcept nogil
        void (*output)(double, const double *, const double *, const double *, const double *, const double *,
                       double *) noexcept nogil
        fb_sensitivity *sensitivity
        fb_sensitivity *parameter_sensitivity
        fb_sensitivity *input_sensitivity

cdef extern from "fourbar_runge_kutta.h":
    int FB_STEP_ACCEPTED
    int FB_STEP_TOO_SMALL
    ctypedef int (*fb_function)(void *, double, const double *, double *) except -1
    ctypedef struct fb_runge_kutta:
        int n_stages
        const double *a
        const double *b
        const double *c
        const double *error
        int n_errors
        double error_exponent
        int n
        fb_function function
        void *context
        double t_bound, direction, max_step
        const double *rtol
        const double *atol
        double t, h, h_abs
        int n_evaluations
    int fb_step(fb_runge_kutta *, const double *, double *, double *) except -1


cdef cnp.ndarray _new(int rows, int columns=-1):
    cdef cnp.npy_intp shape[2]
    shape[0] = rows
    shape[1] = columns
    return cnp.PyArray_EMPTY(1 if columns < 0 else 2, shape, cnp.NPY_DOUBLE, 0)


cdef inline double *_data(cnp.ndarray array) noexcept:
    return <double *>cnp.PyArray_DATA(array)


cdef cnp.ndarray _vector(object values, int n, str what):
    """The values as a contiguous array of n doubles: the same array if it is one already."""
    cdef cnp.ndarray array
    if (cnp.PyArray_CheckExact(values) and cnp.PyArray_TYPE(values) == cnp.NPY_DOUBLE
            and cnp.PyArray_ISCARRAY_RO(values)):
        array = <cnp.ndarray>values
    else:
        try:
            given = np.asarray(values)
            if given.dtype.kind not in "biufO":  # not complex, text, time
                raise TypeError(given.dtype)
            array = np.array(given, dtype=np.float64, order="C")
        except (TypeError, ValueError, OverflowError) as error:
            raise ModelError(f"{what} must be {n} real numbers, not {values!r}.") from error
    if cnp.PyArray_NDIM(array) != 1 or cnp.PyArray_DIM(array, 0) != n:
        raise ModelError(f"{what} must have shape ({n},), not {(<object>array).shape}.")
    return array


cdef cnp.ndarray _copy(const double *values, int n):
    cdef cnp.ndarray array = _new(n)
    cdef int i
    for i in range(n):
        _data(array)[i] = values[i]
    return array


cdef inline bint _finite(const double *values, int n) noexcept:
    cdef double zero = 0.0
    cdef int i
    for i in range(n):
        zero += 0.0 * values[i]
    return zero == 0.0


cdef class Evaluator:
    """Evaluates one kernel.

    Parameters
    ----------
    capsule : object
        The kernel, as a generated module exports it.
    manifest : dict
        The manifest of the same module, decoded.
    """

    cdef const fb_kernel *kernel
    cdef object capsule
    cdef readonly int n_q, n_u, n_x, n_p, n_r, n_h, n_c, n_o
    cdef double *default_constants
    cdef double *constants
    cdef double *inputs
    cdef void *work
    cdef bint defaults_known
    cdef bint inputs_known
    cdef bint prescribed_known

    # One set of buffers serves all threads: a method first gets its arguments, which may run Python and let
    # another thread in, then fills the buffers and calls the kernel without a step of Python in between.

    def __cinit__(self, capsule, manifest):
        cdef const fb_kernel *kernel = <const fb_kernel *>PyCapsule_GetPointer(capsule, FB_CAPSULE_NAME)
        if kernel.abi_version != FB_ABI_VERSION or kernel.struct_size != sizeof(fb_kernel):
            raise ModelError(
                f"The compiled model has kernel interface {kernel.abi_version}, this package has {FB_ABI_VERSION}: "
                "build the model again."
            )
        self.kernel = kernel
        self.capsule = capsule
        self.n_q, self.n_u, self.n_p, self.n_r = kernel.n_q, kernel.n_u, kernel.n_p, kernel.n_r
        self.n_h, self.n_c, self.n_o, self.n_x = kernel.n_h, kernel.n_c, kernel.n_o, kernel.n_q + kernel.n_u
        self.default_constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.inputs = <double *>PyMem_Calloc(self.n_r + 1, sizeof(double))
        self.work = PyMem_Malloc(kernel.work_size)
        if not (self.default_constants and self.constants and self.inputs and self.work):
            raise MemoryError
        values = [NAN if entry["default"] is None else entry["default"] for entry in manifest["parameters"]]
        cdef cnp.ndarray defaults = _vector(values, self.n_p, "The default parameters")
        self.defaults_known = _finite(_data(defaults), self.n_p)
        prescribed = {entry["of"] for entry in manifest["inputs"] if entry["order"]}
        unknown = {entry["of"] for entry in manifest["inputs"] if entry["expression"] is None}
        self.inputs_known, self.prescribed_known = not unknown, not unknown & prescribed
        kernel.prepare(_data(defaults), self.default_constants)

    def __dealloc__(self):
        PyMem_Free(self.default_constants)
        PyMem_Free(self.constants)
        PyMem_Free(self.inputs)
        PyMem_Free(self.work)

    def parameter_values(self, p):
        """All parameter values in order; a subclass that knows their names also takes mappings."""
        return p

    def input_values(self, r, defaults):
        """All input values in order; likewise, with the values of the expressions as defaults."""
        return r

    def missing(self):
        """A sentence that names what has no default."""
        return "A parameter or an input has no default and was not given."

    cdef cnp.ndarray _parameters(self, object p):
        """All parameters, or None for the defaults."""
        cdef cnp.ndarray values
        if p is None:
            if not self.defaults_known:
                raise ModelError(self.missing())
            return None
        if type(p) is not np.ndarray:
            p = self.parameter_values(p)
        values = _vector(p, self.n_p, "The parameters p")
        if not _finite(_data(values), self.n_p):
            raise ModelError(f"The parameters p must be finite, not {p!r}.")
        return values

    cdef cnp.ndarray _inputs(self, double t, cnp.ndarray parameters, object r, bint known):
        """All inputs, or None for their expressions, as far as these are known."""
        cdef cnp.ndarray values
        if r is None:
            if not known:
                raise ModelError(self.missing())
            return None
        if type(r) is not np.ndarray:
            values = _new(self.n_r)
            self.kernel.default_inputs(t, self._prepare(parameters), _data(values))
            r = self.input_values(r, values.tolist())
        values = _vector(r, self.n_r, "The inputs r")
        if not _finite(_data(values), self.n_r):
            raise ModelError(f"The inputs r must be finite, not {r!r}.")
        return values

    cdef cnp.ndarray _state(self, double t, object x, int n):
        cdef cnp.ndarray values = _vector(x, n, "The state x" if n == self.n_x else "The coordinates q")
        if not (_finite(_data(values), n) and _finite(&t, 1)):
            raise ModelError(f"Time and state must be finite, not t = {t}, x = {x!r}.")
        return values

    cdef const double *_prepare(self, cnp.ndarray parameters) noexcept:
        """The constants of the parameters, in the buffer."""
        if parameters is None:
            return self.default_constants
        self.kernel.prepare(_data(parameters), self.constants)
        return self.constants

    cdef const double *_fill(self, double t, const double *constants, cnp.ndarray inputs) noexcept:
        """The inputs, or their expressions' values in the buffer."""
        if inputs is None:
            self.kernel.default_inputs(t, constants, self.inputs)
            return self.inputs
        return _data(inputs)

    def rhs(self, double t, x, p=None, r=None, out=None):
        """The right-hand side of x' = f(t, x).

        Parameters
        ----------
        t : float
            Time, s.
        x : array_like, shape (n_x,)
            State: coordinates, then speeds.
        p : array_like, shape (n_p,), or mapping, optional
            Parameters: all in order, or some by name; the defaults otherwise.
        r : array_like, shape (n_r,), or mapping, optional
            Inputs; their expressions otherwise.
        out : ndarray, shape (n_x,), optional
            Where to write the result; contiguous, of floats.

        Returns
        -------
        ndarray, shape (n_x,)
            x'; a fresh array unless `out` is given.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        SimulationError
            If the mechanism is in a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x0 = four_bar.initial_state([-0.5], [-0.1])
        >>> four_bar.rhs(0.0, x0).round(6).tolist()
        [-0.1, 0.071583, -0.027469, -9.269182, 6.637037, -2.55111]
        """
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.inputs_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray result = _new(self.n_x) if out is None else self._output(out, state)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.rhs(
            t, _data(state), constants, self._fill(t, constants, inputs), _data(result), self.work)
        if status != FB_OK:
            raise SimulationError(failure(status, t, x))
        return result

    cdef cnp.ndarray _output(self, object out, cnp.ndarray state):
        if not (isinstance(out, np.ndarray) and out.dtype == np.float64 and out.shape == (self.n_x,)
                and cnp.PyArray_ISCARRAY(out)):
            raise ModelError(f"out must be a contiguous, writable array of {self.n_x} floats.")
        if abs(_data(out) - _data(state)) < self.n_x:
            raise ModelError("out must not share memory with x.")
        return out

    def jacobian(self, double t, x, p=None, r=None):
        """The derivatives of the right-hand side with respect to the state.

        They follow from M u' = f + J^T lambda and J u' + gamma = 0, differentiated in C.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_x, n_x)
            Entry (i, j) is the derivative of x'_i with respect to x_j.

        Raises
        ------
        ModelError, SimulationError
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.jacobian(0.0, four_bar.initial_state([-0.5], [-0.1])).shape
        (6, 6)
        """
        return self._differentiate(self.kernel.jacobian, self.n_x, t, x, p, r)

    def parameter_jacobian(self, double t, x, p=None, r=None):
        """The derivatives of the right-hand side with respect to the parameters.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_x, n_p)

        Raises
        ------
        ModelError, SimulationError
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.parameter_jacobian(0.0, four_bar.initial_state([-0.5], [-0.1])).shape
        (6, 8)
        """
        return self._differentiate(self.kernel.parameter_jacobian, self.n_p, t, x, p, r)

    def input_jacobian(self, double t, x, p=None, r=None):
        """The derivatives of the right-hand side with respect to the inputs.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_x, n_r)

        Raises
        ------
        ModelError, SimulationError
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.input_jacobian(0.0, four_bar.initial_state([-0.5], [-0.1]))[:3].tolist()
        [[0.0], [0.0], [0.0]]
        """
        return self._differentiate(self.kernel.input_jacobian, self.n_r, t, x, p, r)

    cdef cnp.ndarray _differentiate(self, fb_evaluation *function, int columns, double t, x, p, r):
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.inputs_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray result = _new(self.n_x, columns)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = function(
            t, _data(state), constants, self._fill(t, constants, inputs), _data(result), self.work)
        if status != FB_OK:
            raise SimulationError(failure(status, t, x))
        return result

    def accelerations(self, double t, x, p=None, r=None):
        """u', shape (n_u,), and the constraints' multipliers lambda, shape (n_c,)."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.inputs_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray accelerations = _new(self.n_u)
        cdef cnp.ndarray multipliers = _new(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.accelerations(
            t, _data(state), constants, self._fill(t, constants, inputs), _data(accelerations), _data(multipliers),
            self.work)
        if status != FB_OK:
            raise SimulationError(failure(status, t, x))
        return accelerations, multipliers

    def dynamics(self, double t, x, p=None, r=None):
        """q', M, f, J and gamma of M u' = f + J^T lambda, J u' + gamma = 0."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.inputs_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray rates = _new(self.n_q)
        cdef cnp.ndarray mass_matrix = _new(self.n_u, self.n_u)
        cdef cnp.ndarray forcing = _new(self.n_u)
        cdef cnp.ndarray jacobian = _new(self.n_c, self.n_u)
        cdef cnp.ndarray bias = _new(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.dynamics(t, _data(state), constants, self._fill(t, constants, inputs), _data(rates),
                             _data(mass_matrix), _data(forcing), _data(jacobian), _data(bias))
        return rates, mass_matrix, forcing, jacobian, bias

    def position(self, double t, q, p=None, r=None):
        """The position constraints, shape (n_h,), and their derivatives by q, shape (n_h, n_q)."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.prescribed_known)
        cdef cnp.ndarray coordinates = self._state(t, q, self.n_q)
        cdef cnp.ndarray constraints = _new(self.n_h)
        cdef cnp.ndarray jacobian = _new(self.n_h, self.n_q)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.position(t, _data(coordinates), constants, self._fill(t, constants, inputs), _data(constraints),
                             _data(jacobian))
        return constraints, jacobian

    def velocity(self, double t, x, p=None, r=None):
        """J, shape (n_c, n_u), and b, shape (n_c,), of the velocity constraints J u + b = 0."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.prescribed_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray jacobian = _new(self.n_c, self.n_u)
        cdef cnp.ndarray bias = _new(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.velocity(t, _data(state), constants, self._fill(t, constants, inputs), _data(jacobian),
                             _data(bias))
        return jacobian, bias

    def constraint_sensitivity(self, double t, x, p=None, r=None):
        """d(J u + b)/dq, shape (n_c, n_q), dPhi/dr, shape (n_h, n_r), and d(J u + b)/dr, shape (n_c, n_r)."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.prescribed_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray by_coordinates = _new(self.n_c, self.n_q)
        cdef cnp.ndarray positions, velocities
        positions, velocities = _new(self.n_h, self.n_r), _new(self.n_c, self.n_r)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.constraint_sensitivity(t, _data(state), constants, self._fill(t, constants, inputs),
                                           _data(by_coordinates), _data(positions), _data(velocities))
        return by_coordinates, positions, velocities

    def energy(self, double t, x, p=None, r=None):
        """Kinetic and potential energy, shape (2,)."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.prescribed_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray energies = _new(2)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.energy(t, _data(state), constants, self._fill(t, constants, inputs), _data(energies))
        return energies

    def held(self, double t, x, accelerations, multipliers, p=None, r=None):
        """What is evaluated for given u' and lambda: the outputs, and the sensitivities by x, p and r.

        The latter are dq', shape (n_q, n), and d(f - M u' + J^T lambda, -(J u' + gamma)), shape (n_u + n_c, n).
        """
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.inputs_known)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = _vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray l = _vector(multipliers, self.n_c, "The multipliers")
        cdef cnp.ndarray outputs = _new(self.n_o)
        cdef cnp.ndarray rates, residuals
        cdef list results = [outputs]
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        cdef fb_sensitivity *functions[3]
        cdef int i
        cdef int columns[3]
        functions[0], columns[0] = self.kernel.sensitivity, self.n_x
        functions[1], columns[1] = self.kernel.parameter_sensitivity, self.n_p
        functions[2], columns[2] = self.kernel.input_sensitivity, self.n_r
        self.kernel.output(t, _data(state), constants, filled, _data(a), _data(l), _data(outputs))
        for i in range(3):
            rates, residuals = _new(self.n_q, columns[i]), _new(self.n_u + self.n_c, columns[i])
            functions[i](t, _data(state), constants, filled, _data(a), _data(l), _data(rates), _data(residuals))
            results += [rates, residuals]
        return results

    def parameter_vector(self, p):
        """The parameters as `rhs` takes them, checked, as an array of their own; None for the defaults."""
        cdef cnp.ndarray values = self._parameters(p)
        return None if values is None else np.array(values)

    def default_inputs(self, double t, p=None):
        """The inputs' expressions at one time, shape (n_r,); NaN where there is none."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = _new(self.n_r)
        self.kernel.default_inputs(t, self._prepare(parameters), _data(inputs))
        return inputs

    def along(self, times, states, inputs, p=None):
        """Position constraints, (n_h, n_t), energies, (2, n_t), multipliers, (n_c, n_t), and outputs, (n_o, n_t).

        States and inputs stand in columns. Multipliers and outputs are NaN where the accelerations cannot be
        evaluated.
        """
        cdef cnp.ndarray t = np.ascontiguousarray(times, dtype=np.float64)
        cdef cnp.ndarray x = np.ascontiguousarray(np.transpose(states), dtype=np.float64)
        cdef cnp.ndarray r = np.ascontiguousarray(np.transpose(inputs), dtype=np.float64)
        cdef cnp.ndarray parameters = self._parameters(p)
        if np.ndim(t) != 1 or np.shape(x) != (np.size(t), self.n_x) or np.shape(r) != (np.size(t), self.n_r):
            raise ModelError(
                f"{np.size(t)} times need states of shape ({self.n_x}, {np.size(t)}), not {np.shape(states)}, and "
                f"inputs of shape ({self.n_r}, {np.size(t)}), not {np.shape(inputs)}.")
        cdef int n_t = cnp.PyArray_DIM(t, 0)
        cdef cnp.ndarray constraints = _new(n_t, self.n_h)
        cdef cnp.ndarray energies = _new(n_t, 2)
        cdef cnp.ndarray multipliers = np.full((n_t, self.n_c), NAN)
        cdef cnp.ndarray outputs = np.full((n_t, self.n_o), NAN)
        cdef cnp.ndarray jacobian = _new(self.n_h, self.n_q)
        cdef cnp.ndarray accelerations = _new(self.n_u)
        cdef const double *constants = self._prepare(parameters)
        cdef const double *x_i
        cdef const double *r_i
        cdef double *lambda_i
        cdef double t_i
        cdef int i
        for i in range(n_t):
            t_i, x_i, r_i = _data(t)[i], _data(x) + i * self.n_x, _data(r) + i * self.n_r
            lambda_i = _data(multipliers) + i * self.n_c
            self.kernel.position(t_i, x_i, constants, r_i, _data(constraints) + i * self.n_h, _data(jacobian))
            self.kernel.energy(t_i, x_i, constants, r_i, _data(energies) + 2 * i)
            if self.kernel.accelerations(t_i, x_i, constants, r_i, _data(accelerations), lambda_i, self.work) == FB_OK:
                self.kernel.output(t_i, x_i, constants, r_i, _data(accelerations), lambda_i,
                                   _data(outputs) + i * self.n_o)
        return constraints.T, energies.T, multipliers.T, outputs.T


def failure(int status, double t, x):
    """A sentence for a kernel's status."""
    if not np.isfinite(np.asarray(x, dtype=np.float64)).all():
        status = FB_NOT_FINITE
    where = f"at t = {t:.9g}, x = {np.array2string(np.asarray(x), precision=6, separator=', ')}"
    if status == FB_CONSTRAINTS_DEPENDENT:
        return (
            f"The mechanism is in a singular position {where}: the constraints' Jacobian has lost rank, and no "
            "acceleration satisfies them all. (Or one constraint is smaller than another by the precision of double: "
            "then give them units of like size.)"
        )
    if status == FB_MASS_SINGULAR:
        return (
            f"The mass matrix is not positive definite {where}: some motion that the constraints allow moves no mass, "
            "or a mass or inertia is negative."
        )
    return (
        f"The equations of motion, or their derivatives, are not finite {where}: a division by zero, a coordinate beyond its range, "
        "or an input that is not finite."
    )


@cython.final
cdef class Ode:
    """The right-hand side with parameters and inputs bound: f(t, x) for an integrator.

    Where the equations cannot be evaluated, it returns NaN, so that an integrator with step control rejects
    the step; `failure` then says why. `time` is the time of the last call.

    Parameters
    ----------
    evaluator : Evaluator
    p : array_like or None
    sources : sequence of length n_r
        For each input None (its expression), a float, a table (times, values) or a callable of (t, x).
    """

    cdef Evaluator evaluator
    cdef double *constants
    cdef double *inputs
    cdef list fixed
    cdef list tables
    cdef list callables
    cdef tuple names
    cdef readonly object failure
    cdef readonly double time

    def __cinit__(self, Evaluator evaluator not None, p, sources):
        cdef cnp.ndarray parameters = evaluator._parameters(p)
        cdef const double *constants
        cdef int i
        self.evaluator = evaluator
        self.constants = <double *>PyMem_Calloc(evaluator.kernel.n_constants + 1, sizeof(double))
        self.inputs = <double *>PyMem_Calloc(evaluator.n_r + 1, sizeof(double))
        if not (self.constants and self.inputs):
            raise MemoryError
        constants = evaluator._prepare(parameters)
        for i in range(evaluator.kernel.n_constants):
            self.constants[i] = constants[i]
        self.fixed, self.tables, self.callables = [], [], []
        self.names = getattr(evaluator, "inputs", None) or tuple(range(1, evaluator.n_r + 1))
        for i, source in zip(range(evaluator.n_r), sources, strict=True):
            if type(source) is Table:
                self.tables.append((i, source))
            elif callable(source):
                self.callables.append((i, source))
            elif source is not None:
                self.fixed.append((i, float(source)))
        self.failure = None

    def __dealloc__(self):
        PyMem_Free(self.constants)
        PyMem_Free(self.inputs)

    cdef list _called(self, double t, object x):
        """The values of the callables, which run Python, before the buffer is filled."""
        cdef list called = []
        for i, source in self.callables:
            try:
                value = source(t, np.array(x, dtype=np.float64))  # a copy: what it does to it stays its own affair
            except BaseException:
                self.failure = None  # the equations have not failed, the callable has
                raise
            try:
                called.append((i, <double>value))
            except (TypeError, OverflowError) as error:
                self.failure = None
                raise ModelError(f"The callable of input {self.names[i]} must return a number, not {value!r}.") from error
        return called

    cdef int _fill(self, double t, list called) except -1:
        cdef int i
        self.evaluator.kernel.default_inputs(t, self.constants, self.inputs)
        for i, value in self.fixed:
            self.inputs[i] = value
        for i, table in self.tables:
            self.inputs[i] = (<Table>table).value(t)
        for i, value in called:
            self.inputs[i] = value
        return 0

    @property
    def has_callables(self):
        """Whether an input is a callable, whose dependence on the state `jac` does not know of."""
        return bool(self.callables)

    def input_values(self, double t, x):
        """The inputs at one time and state, shape (n_r,)."""
        cdef cnp.ndarray result = _new(self.evaluator.n_r)
        cdef int i
        self._fill(t, self._called(t, x))
        for i in range(self.evaluator.n_r):
            _data(result)[i] = self.inputs[i]
        return result

    cdef int _fail(self, int status, double t, const double *x, double *result, int n, double value) except -1:
        # Integrators go on from NaN with states of NaN; what is to be reported is how it began.
        cdef int i
        if self.failure is None or _finite(x, self.evaluator.n_x):
            self.failure = failure(status, t, _copy(x, self.evaluator.n_x))
        for i in range(n):
            result[i] = value
        return 0

    cdef int _rates(self, double t, const double *x, list called, double *result) except -1:
        cdef Evaluator evaluator = self.evaluator
        self.time = t
        self._fill(t, called)
        cdef int status = evaluator.kernel.rhs(t, x, self.constants, self.inputs, result, evaluator.work)
        if status != FB_OK:
            return self._fail(status, t, x, result, evaluator.n_x, NAN)
        if self.failure is not None:
            self.failure = None
        return 0

    def __call__(self, double t, x):
        """x', shape (n_x,), a fresh array."""
        cdef list called = self._called(t, x) if self.callables else self.callables
        cdef cnp.ndarray state = _vector(x, self.evaluator.n_x, "The state x")
        cdef cnp.ndarray result = _new(self.evaluator.n_x)
        self._rates(t, _data(state), called, _data(result))
        return result

    def jac(self, double t, x):
        """d f / d x, shape (n_x, n_x)."""
        cdef Evaluator evaluator = self.evaluator
        cdef list called = self._called(t, x) if self.callables else self.callables
        cdef cnp.ndarray state = _vector(x, evaluator.n_x, "The state x")
        cdef cnp.ndarray result = _new(evaluator.n_x, evaluator.n_x)
        self._fill(t, called)
        cdef int status = evaluator.kernel.jacobian(
            t, _data(state), self.constants, self.inputs, _data(result), evaluator.work)
        if status != FB_OK:
            # Zeros, since factorizations refuse NaN; the right-hand side is NaN here and fails the step.
            self._fail(status, t, _data(state), _data(result), evaluator.n_x * evaluator.n_x, 0.0)
        return result


cdef int _stage(void *context, double t, const double *x, double *result) except -1:
    """An `Ode` as the function of a Runge-Kutta step."""
    cdef Ode ode = <Ode>context
    cdef list called = ode.callables
    if called:
        called = ode._called(t, _copy(x, ode.evaluator.n_x))
    return ode._rates(t, x, called, result)


cdef class Stepper:
    """Steps of an explicit Runge-Kutta method, without Python between their stages.

    Parameters
    ----------
    ode : Ode
        The right-hand side.
    tableau : (array_like, array_like, array_like), shapes (s, s), (s,), (s,)
        The method's coefficients a, b, c.
    error : array_like, shape (s + 1,) or (2, s + 1)
        Weights of the error estimate; with two rows, of those of fifth and third order of DOP853.
    error_exponent : float
        Of the step control.
    t_bound : float
        The end of the run.
    direction : float
        1, or -1 for a run backwards.
    max_step : float
        The longest step.
    rtol, atol : array_like, shape () or (n_x,)
        Relative and absolute tolerance.
    """

    cdef fb_runge_kutta method
    cdef tuple kept

    def __cinit__(self, Ode ode not None, tableau, error, double error_exponent, double t_bound, double direction,
                  double max_step, rtol, atol):
        cdef int n = ode.evaluator.n_x
        cdef cnp.ndarray a, b, c, errors, relative, absolute
        a, b, c = (np.array(part, dtype=np.float64, order="C") for part in tableau)
        errors = np.array(error, dtype=np.float64, order="C")
        relative, absolute = np.full(n, rtol, dtype=np.float64), np.full(n, atol, dtype=np.float64)
        self.kept = (ode, a, b, c, errors, relative, absolute)
        cdef int n_stages = np.size(b)
        if (np.shape(a) != (n_stages, n_stages) or np.shape(c) != (n_stages,)
                or np.shape(errors) not in {(n_stages + 1,), (2, n_stages + 1)}):
            raise ModelError("The shapes of a Runge-Kutta method's coefficients do not agree.")
        self.method = fb_runge_kutta(
            n_stages=n_stages, a=_data(a), b=_data(b), c=_data(c), error=_data(errors),
            n_errors=cnp.PyArray_NDIM(errors), error_exponent=error_exponent, n=n, function=_stage, context=<void *>ode, t_bound=t_bound,
            direction=direction, max_step=max_step, rtol=_data(relative),
            atol=_data(absolute), t=0.0, h=0.0, h_abs=0.0, n_evaluations=0)

    def step(self, double t, double h_abs, x, cnp.ndarray stages not None):
        """One accepted step.

        Parameters
        ----------
        t, h_abs : float
            Time and the step's proposed length.
        x : array_like, shape (n_x,)
        stages : ndarray, shape (s + 1, n_x)
            Its first row is x' at t; the others are written.

        Returns
        -------
        t, h, h_abs : float
            The time reached, the step taken, the next step's proposed length.
        x : ndarray, shape (n_x,)
        n_evaluations : int
        problem : {"", "too small", "infinite"}
            Of the step's length; otherwise the step was accepted.
        """
        cdef cnp.ndarray state = _vector(x, self.method.n, "The state x")
        cdef cnp.ndarray x_new = _new(self.method.n)
        if (cnp.PyArray_NDIM(stages) != 2 or cnp.PyArray_TYPE(stages) != cnp.NPY_DOUBLE
                or not cnp.PyArray_ISCARRAY(stages) or cnp.PyArray_DIM(stages, 0) != self.method.n_stages + 1
                or cnp.PyArray_DIM(stages, 1) != self.method.n):
            raise ModelError(f"The stages must be a contiguous array of {self.method.n_stages + 1} states.")
        self.method.t, self.method.h_abs, self.method.n_evaluations = t, h_abs, 0
        cdef int status = fb_step(&self.method, _data(state), _data(x_new), _data(stages))
        return (self.method.t, self.method.h, self.method.h_abs, x_new, self.method.n_evaluations,
                "" if status == FB_STEP_ACCEPTED else "too small" if status == FB_STEP_TOO_SMALL else "infinite")


cdef class Table:
    """A function of time by polynomials between given times, constant before the first and after the last.

    Parameters
    ----------
    times : ndarray, shape (n,)
        Strictly increasing.
    coefficients : ndarray, shape (k + 1, n - 1)
        Of the powers k to 0 of the time since the beginning of each interval, as ``scipy.interpolate.PPoly``
        has them.
    before, after : float
        Values outside.
    """

    cdef cnp.ndarray times
    cdef cnp.ndarray coefficients
    cdef double before, after
    cdef int position

    def __cinit__(self, times, coefficients, double before, double after):
        self.times = np.array(times, dtype=np.float64)
        self.coefficients = np.array(np.transpose(coefficients), dtype=np.float64, order="C")
        self.before, self.after = before, after
        self.position = 0
        if np.ndim(self.coefficients) != 2 or np.shape(self.coefficients)[0] != np.size(self.times) - 1:
            raise ModelError("A table of n times has coefficients for n - 1 intervals.")

    cdef double value(self, double t) noexcept:
        cdef const double *times = _data(self.times)
        cdef int last = cnp.PyArray_DIM(self.times, 0) - 1
        cdef int n = cnp.PyArray_DIM(self.coefficients, 1)
        cdef int low = 0, high = last, middle, i
        cdef const double *coefficients
        cdef double result
        if t < times[0]:
            return self.before
        if not t <= times[last]:
            return self.after
        middle = self.position  # integrators move on slowly: the interval of the last call is the first guess
        if t == times[last]:
            middle = last - 1
        while not (times[middle] <= t <= times[middle + 1]):
            if t < times[middle]:
                high = middle
            else:
                low = middle + 1
            middle = (low + high) // 2
        self.position = middle
        coefficients = _data(self.coefficients) + middle * n
        result = coefficients[0]
        for i in range(1, n):
            result = result * (t - times[middle]) + coefficients[i]
        return result
