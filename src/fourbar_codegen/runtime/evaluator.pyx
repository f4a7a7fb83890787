# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Checks arguments and evaluates kernels."""

cimport numpy as cnp
from cpython.mem cimport PyMem_Calloc, PyMem_Free, PyMem_Malloc
from cpython.pycapsule cimport PyCapsule_GetPointer, PyCapsule_New
from libc.math cimport NAN, fabs
from libc.string cimport memcpy

import sys

import numpy as np

from fourbar_codegen.errors import ModelError, SimulationError, shown

cnp.import_array()

cdef extern from "derivatives/dependent_variables.h":
    int FB_DETERMINED
    int FB_COORDINATES_UNDETERMINED
    int FB_SPEEDS_UNDETERMINED
    ctypedef struct fb_dependent:
        int n_qd, n_ud, n
        double *directions
        double *corrections
        double *left
        double pivot
        int *order
    size_t fb_place_dependent(const fb_kernel *, fb_dependent *, double *) noexcept nogil
    int fb_implicit_derivatives(const fb_kernel *, double, const double *, const double *, const double *,
                                fb_dependent *) noexcept nogil

cdef extern from "lanes/batch.h":
    int fb_batch_functions_agree(const fb_batch_functions *) noexcept nogil

_UNDETERMINED = {FB_DETERMINED: "", FB_COORDINATES_UNDETERMINED: "coordinates", FB_SPEEDS_UNDETERMINED: "speeds"}

OK, NOT_CLOSED, NOT_FINITE = FB_OK, FB_NOT_CLOSED, FB_NOT_FINITE


cdef object _other_layout(layout):
    return ModelError(
        f"The compiled model {layout.name} was built with another version of this package, and its data have another "
        f"layout than those of the kernel interface {FB_ABI_VERSION} of this version: build it again.")


cdef cnp.ndarray new_array(int rows, int columns=-1):
    cdef cnp.npy_intp shape[2]
    shape[0] = rows
    shape[1] = columns
    return cnp.PyArray_EMPTY(1 if columns < 0 else 2, shape, cnp.NPY_DOUBLE, 0)


cdef bint is_ready(object values) noexcept:
    """Whether values are an array that C can use directly."""
    return (cnp.PyArray_CheckExact(values) and cnp.PyArray_TYPE(values) == cnp.NPY_DOUBLE
            and cnp.PyArray_ISCARRAY_RO(values))


cpdef cnp.ndarray numbers(object values, str what):
    """Real numbers as a native, aligned and contiguous array of double; such an array is returned itself.

    All numbers given by users are read here.

    Parameters
    ----------
    values : array_like
    what : str
        Their name, the subject of error messages.

    Returns
    -------
    ndarray
        Of the same shape. Infinities and NaN are allowed.

    Raises
    ------
    ModelError
        If there are complex numbers, text, times, masked entries, None or numbers beyond the range of double among
        them, or rows of different lengths.
    """
    if is_ready(values):
        return values
    try:
        return _read(values)
    except Exception as error:  # float() may raise anything for objects
        raise ModelError(f"{what} must be real numbers, not {shown(values)}.") from error


cpdef object number(object value, str what):
    """A real number as a float, read as `numbers` are."""
    cdef cnp.ndarray array
    try:
        if isinstance(value, (float, int)):
            return float(value)
        array = _read(value)
        if cnp.PyArray_NDIM(array):
            raise TypeError(f"of shape {np.shape(array)}")
    except Exception as error:
        raise ModelError(f"{what} must be a real number, not {shown(value)}.") from error
    return data(array)[0]


cdef cnp.ndarray _read(object values):
    cdef cnp.ndarray given = np.asarray(values)
    if _masked(values, cnp.PyArray_NDIM(given)):
        raise TypeError("masked")
    kind = given.dtype.kind
    if kind == "O":
        given = np.reshape([_real(entry) for entry in given.ravel()], np.shape(given))
    elif kind not in "biuf":  # not complex, text, time
        raise TypeError(kind)
    return cnp.PyArray_FROM_OTF(given, cnp.NPY_DOUBLE, cnp.NPY_ARRAY_CARRAY_RO | cnp.NPY_ARRAY_FORCECAST)


cdef double _real(object entry) except? -1.0:
    """An entry of an array of objects; float() alone would accept text, times, and real parts of complex numbers."""
    if isinstance(entry, np.ndarray) and entry.ndim == 0 and not _masked(entry, 0):
        entry = entry[()]
    if isinstance(entry, (str, bytes, bytearray)) or _masked(entry, 0):
        raise TypeError(type(entry))
    if isinstance(entry, np.generic) and entry.dtype.kind not in "biuf":
        raise TypeError(entry.dtype)
    return float(entry)


cdef bint _masked(object values, int depth):
    """Whether entries are masked, also in arrays inside lists of `depth` dimensions: NumPy would drop the masks."""
    masked = sys.modules.get("numpy.ma")  # if it is not imported, there are no masks
    if masked is None:
        return False
    if isinstance(values, masked.MaskedArray):
        return masked.is_masked(values)
    if depth > 0 and isinstance(values, (list, tuple)):
        for value in values:
            if type(value) is not float and _masked(value, depth - 1):
                return True
    return False


cdef cnp.ndarray rows(object columns, str what):
    """Real numbers, read by `numbers`, transposed."""
    cdef cnp.ndarray given = columns if cnp.PyArray_CheckExact(columns) else numbers(columns, what)
    return numbers(given.T, what)  # arrays returned to users, with states in columns, are not copied


cdef cnp.ndarray vector(object values, int n, str what):
    """Real numbers, read by `numbers`, of the shape (n,)."""
    cdef cnp.ndarray array = <cnp.ndarray>values if is_ready(values) else numbers(values, what)
    if cnp.PyArray_NDIM(array) != 1 or cnp.PyArray_DIM(array, 0) != n:
        raise ModelError(f"{what} must have shape ({n},), not {(<object>array).shape}.")
    return array


cdef bint _overlap(cnp.ndarray a, cnp.ndarray b) noexcept:
    """Whether two contiguous arrays share memory."""
    cdef Py_ssize_t n = cnp.PyArray_SIZE(a), m = cnp.PyArray_SIZE(b)
    return n > 0 and m > 0 and data(a) < data(b) + m and data(b) < data(a) + n


def is_finite(cnp.ndarray values not None):
    """Whether all entries of a contiguous array of double are finite; ten times faster than NumPy for short arrays."""
    return bool(fb_finite(data(values), cnp.PyArray_SIZE(values)))


def finite_copy(object values, int n):
    """A copy of n finite numbers in an array that C can use directly; None for anything else."""
    cdef cnp.ndarray given, copy
    if not is_ready(values):
        return None
    given = values
    if cnp.PyArray_NDIM(given) != 1 or cnp.PyArray_DIM(given, 0) != n or not fb_finite(data(given), n):
        return None
    copy = new_array(n)
    memcpy(data(copy), data(given), n * sizeof(double))
    return copy


def largest_difference(cnp.ndarray a not None, cnp.ndarray b not None):
    """The largest difference of two contiguous arrays of double of equal length; NaN if one is NaN."""
    cdef double largest = 0.0, difference
    cdef Py_ssize_t i
    for i in range(cnp.PyArray_SIZE(a)):
        difference = fabs(data(a)[i] - data(b)[i])
        if not difference <= largest:
            largest = difference
            if difference != difference:
                break
    return largest


def kernel_at(size_t address):
    """The capsule of a kernel in a library that stays loaded, like those of extension modules."""
    return PyCapsule_New(<void *>address, FB_CAPSULE_NAME, NULL)


cdef const fb_kernel *_kernel_in(object capsule) except NULL:
    return <const fb_kernel *>PyCapsule_GetPointer(capsule, FB_CAPSULE_NAME)


def versions(capsule not None):
    """The capsules of a kernel's versions that the processor can run, each faster than the one before.

    The first is the given one, for all processors of its kind.
    """
    cdef const fb_kernel *kernel = _kernel_in(capsule)
    found = [capsule]
    # Another layout may have other data in that place; an Evaluator reports it.
    while kernel.struct_size == sizeof(fb_kernel) and fb_runs_here(kernel) and fb_runs_here(kernel.faster):
        kernel = kernel.faster
        found.append(kernel_at(<size_t>kernel))
    return found


cdef class Evaluator:
    """Evaluates one kernel.

    Parameters
    ----------
    capsule : object
        The kernel that a generated module exports.
    layout : Layout
        The description that comes with it.
    """

    # All threads share one set of buffers. A method first reads its arguments, which may run Python and switch
    # threads, then fills the buffers and calls the kernel without running Python in between.

    def __cinit__(self, capsule, layout, *further):  # subclasses may take more
        cdef const fb_kernel *kernel = _kernel_in(capsule)
        if (kernel.abi_version != FB_ABI_VERSION or kernel.struct_size != sizeof(fb_kernel)
                or kernel.n_roles != FB_N_ROLES):
            raise _other_layout(layout)
        if kernel.batch_functions != NULL and not fb_batch_functions_agree(kernel.batch_functions):
            raise _other_layout(layout)
        self.functions = <fb_function *>PyMem_Calloc(FB_N_ROLES, sizeof(fb_function))
        if not self.functions:
            raise MemoryError
        memcpy(self.functions, kernel.functions, FB_N_ROLES * sizeof(fb_function))
        self.own = kernel[0]  # a copy, to which parts that are built separately are attached
        self.own.functions = self.functions
        self.kernel = &self.own
        self.capsule, self.layout = capsule, layout
        for part in (<size_t>kernel.derivatives, <size_t>kernel.products):
            if part:
                self.attach(part)
        self.n_q, self.n_u, self.n_p, self.n_r = kernel.n_q, kernel.n_u, kernel.n_p, kernel.n_r
        self.n_h, self.n_c, self.n_l, self.n_i, self.n_o = kernel.n_h, kernel.n_c, kernel.n_l, kernel.n_i, kernel.n_o
        self.n_z, self.n_x, self.states_need_solution = kernel.n_z, kernel.n_x, kernel.states_need_solution
        self.default_constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.inputs = <double *>PyMem_Calloc(self.n_r + 1, sizeof(double))
        self.work = PyMem_Malloc(kernel.work_size)
        if not (self.default_constants and self.constants and self.inputs and self.work):
            raise MemoryError
        values = [NAN if entry.default is None else entry.default for entry in layout.parameters]
        self.default_parameters = vector(values, self.n_p, "The default parameters")
        self.has_defaults = fb_finite(data(self.default_parameters), self.n_p)
        unknown = {place for place, entry in enumerate(layout.inputs) if entry.expression is None}
        self.has_inputs, self.has_prescribed = not unknown, not unknown & set(layout.prescribed_places)
        kernel.prepare(data(self.default_parameters), self.default_constants)

    def __dealloc__(self):
        PyMem_Free(self.functions)
        PyMem_Free(self.default_constants)
        PyMem_Free(self.constants)
        PyMem_Free(self.inputs)
        PyMem_Free(self.work)

    @property
    def lacks_batch_functions(self):
        """Whether the functions for batches of states are in a library that is not attached yet."""
        return self.kernel.batch_functions == NULL and self.kernel.batch_functions_apart != 0

    @property
    def lacks_drawing(self):
        """Whether positions and orientations for pictures are in a library that is not attached yet."""
        return self.functions[FB_DRAWING].call == NULL

    @property
    def lacks_derivatives(self):
        """Whether derivatives are in a library that is not attached yet."""
        return self.functions[FB_STATE_PARTIALS].call == NULL

    @property
    def lacks_products(self):
        """Whether products of derivatives with vectors are in a library that is not attached yet."""
        return self.functions[FB_RESIDUAL_JVP].call == NULL

    @property
    def is_portable(self):
        """Whether it runs on other machines, and was not built for the processor of one machine."""
        return self.kernel.one_machine == 0

    @property
    def instructions(self):
        """The instruction set: "native" for the processor of this machine; for a portable module "baseline", "avx2" or
        "avx512", the best that the processor has.
        """
        return "native" if self.kernel.one_machine else ("baseline", "avx2", "avx512")[self.kernel.instructions]

    def attach_batch_functions(self, size_t address):
        """Attach an ``fb_batch_functions`` that was built separately: functions for batches of states.

        Raises
        ------
        ModelError
            If they were built with another version of the package.
        """
        if not fb_batch_functions_agree(<const fb_batch_functions *>address):
            raise _other_layout(self.layout)
        self.own.batch_functions = <const fb_batch_functions *>address

    def attach(self, size_t address):
        """Attach the functions of an ``fb_part``.

        Raises
        ------
        ModelError
            If it was built with another version of the package.
        """
        if not fb_attach(self.functions, <const fb_part *>address):
            raise _other_layout(self.layout)

    def require_drawing(self):
        """Attach positions and orientations for pictures; a subclass that has their sources builds them."""
        raise ModelError("Positions and orientations for pictures are in a library of their own: attach it.")

    def require_derivatives(self):
        """Attach the derivatives; a subclass that has their sources builds them."""
        raise ModelError("The derivatives are in a library of their own: attach it.")

    def attach_parts_of(self, Evaluator other not None):
        """Attach the parts that another evaluator of the same kernel has."""
        memcpy(self.functions, other.functions, FB_N_ROLES * sizeof(fb_function))

    def require_products(self):
        """Attach the products of derivatives with vectors; a subclass that has their sources builds them."""
        raise ModelError("The products of derivatives with vectors are in a library of their own: attach it.")

    cdef const fb_function *function(self, int role) except NULL:
        """A function of the table; the part that has it is built first if necessary."""
        if not 0 <= role < FB_N_ROLES:
            raise ModelError(f"The roles of functions are 0 to {FB_N_ROLES - 1}, not {role}.")
        if self.functions[role].call == NULL:
            if role < FB_MOTION:
                self.require_drawing()
            elif role < FB_RESIDUAL_JVP:
                self.require_derivatives()
            else:
                self.require_products()
            if self.functions[role].call == NULL:
                raise ModelError(f"The compiled model {self.layout.name} has no function of the role {role}.")
        return self.functions + role

    def described(self, int role):
        """Whether a function of the table takes all of x, not only q; and the names of its results."""
        cdef const fb_function *f = self.function(role)
        cdef int i
        return bool(f.needs & FB_NEEDS_STATE), tuple([f.results[i].name.decode() for i in range(f.n_results)])

    def evaluate(self, int role, t, x=None, p=None, r=None, accelerations=None, multipliers=None, arguments=()):
        """The results of a function of the table.

        Parameters
        ----------
        role : Role
        t : float
        x : array_like, shape (n_x,) or (n_q,), optional
            The state, or coordinates; with those functions that take one.
        p, r
            As for `rhs`.
        accelerations, multipliers : array_like, shape (n_u,), (n_l,), optional
            u' and lambda, where they are needed.
        arguments : sequence of array_like
            Further vectors.

        Returns
        -------
        list of ndarray
        """
        t = time_of(t)
        cdef const fb_function *f = self.function(role)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = None, state = None, held = None, forces = None, array
        cdef const double *given[FB_ARRAYS]
        cdef double *found[FB_ARRAYS]
        cdef fb_at at
        cdef int i, status
        cdef list read = None, results = [None] * f.n_results
        if f.needs & (FB_NEEDS_STATE | FB_NEEDS_COORDINATES):
            if f.needs & FB_NEEDS_INPUTS:
                inputs = self._inputs(t, parameters, r, self.has_inputs)
            else:
                inputs = self._inputs(t, parameters, r, self.has_prescribed, False)
            state = self._state(t, x, self.n_x if f.needs & FB_NEEDS_STATE else self.n_q)
        if f.needs & FB_NEEDS_ACCELERATIONS:
            held = vector(accelerations, self.n_u, "The accelerations")
        if f.needs & FB_NEEDS_MULTIPLIERS:
            forces = vector(multipliers, self.n_l, "The multipliers")
        if len(arguments) != f.n_arguments:
            raise ModelError(f"A function of the role {role} takes {f.n_arguments} arguments, not {len(arguments)}.")
        if f.n_arguments:
            read = [vector(arguments[i], f.arguments[i].rows, f"The {f.arguments[i].name.decode()}")
                    for i in range(f.n_arguments)]
            for i in range(f.n_arguments):
                given[i] = data(read[i])
        for i in range(f.n_results):
            array = new_array(f.results[i].rows, f.results[i].columns)
            results[i] = array
            found[i] = data(array)
        at.t, at.n_directions = t, 0
        at.constants = self._prepare(parameters)
        at.x = NULL if state is None else data(state)
        at.r = NULL
        if state is not None:
            at.r = self._fill(t, at.constants, inputs)
        at.accelerations = NULL if held is None else data(held)
        at.multipliers = NULL if forces is None else data(forces)
        status = f.call(&at, given, found, self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        return results

    def parameter_values(self, p):
        """All parameter values in order; a subclass that knows their names also takes mappings."""
        return p

    def input_values(self, r, defaults, all_count=True):
        """All input values in order; a subclass also takes mappings, with the expressions' values as defaults.

        If not all count, those that prescribe no motion may be left out."""
        return r

    def held_inputs(self, r):
        """Places and values of the inputs that a mapping names; None for an array of all. A subclass takes mappings."""
        return None

    def defaults_in_force(self, r):
        """For each input, whether its expression is used, for the argument r of a call; a subclass takes mappings."""
        return [r is None] * self.n_r

    def missing(self):
        """A sentence about missing parameters and inputs."""
        return "A parameter or an input has no default and was not given."

    def failure(self, int status, double t, x):
        """A sentence for a status of the kernel."""
        if not np.isfinite(np.asarray(x, dtype=np.float64)).all():
            status = FB_NOT_FINITE
        where = f"at t = {t:.9g}, x = {np.array2string(np.asarray(x), precision=6, separator=', ')}"
        if status == FB_CONSTRAINTS_DEPENDENT:
            return (
                f"The mechanism is in a singular position {where}: the constraints' Jacobian has lost rank, so that "
                "the accelerations are not determined, or no acceleration satisfies all constraints. (Or one "
                "constraint is smaller than another by the precision of double: then give them similar units.)"
            )
        if status == FB_CONSTRAINTS_INDEPENDENT:
            return self.too_few_dependent(where)
        if status == FB_MASS_SINGULAR:
            return (
                f"The mass matrix is not positive definite {where}: some motion that the constraints allow moves no "
                "mass, or a mass or inertia is negative."
            )
        if status == FB_FORCES_UNDETERMINED:
            return (
                f"The unknown forces are not determined {where}: none, or more than one set of them, keeps the "
                "auxiliary speeds zero, as in Painleve's paradox."
            )
        if status == FB_FORCES_NOT_FOUND:
            return (
                f"No unknown forces were found {where} that keep the auxiliary speeds zero: Newton's method, from 0, "
                "has not converged. There may be none, as in Painleve's paradox, or the loads change too abruptly with "
                "them."
            )
        if status == FB_NOT_SOLVED:
            return (
                f"The equations of a step cannot be solved {where}, not even of much shorter ones: the motion may "
                "end there, or forces may jump with the state.")
        if status == FB_NOT_CLOSED:
            return f"The loops cannot be closed {where}: no state nearby satisfies the constraints."
        return (
            f"The equations of motion, their derivatives, or what else follows from them, are not finite {where}: a "
            "division by zero, an overflow, a coordinate beyond its range, or an input that is not finite."
        )

    def too_few_dependent(self, where, rank=None):
        """A sentence for a rank of the velocity constraints that is larger than the number of dependent speeds."""
        n = self.layout.n_dependent_speeds
        dependent = self.layout.speeds[self.n_u - n:]
        return (
            f"{rank or f'More than {n}'} velocity constraints are independent of each other {where}, but the model has "
            f"{n} dependent speed{'' if n == 1 else 's'} ({', '.join(dependent) or 'none'}): name one for each."
        )

    cdef cnp.ndarray _parameters(self, object p):
        """All parameters, or None for the defaults."""
        cdef cnp.ndarray values
        if p is None:
            if not self.has_defaults:
                raise ModelError(self.missing())
            return None
        if type(p) is not np.ndarray:
            p = self.parameter_values(p)
        values = vector(p, self.n_p, "The parameters p")
        if not fb_finite(data(values), self.n_p):
            raise ModelError(f"The parameters p must be finite, not {shown(p)}.")
        return values

    cdef cnp.ndarray _inputs(self, double t, cnp.ndarray parameters, object r, bint known, bint all_count=True):
        """All inputs, or None for their expressions, as far as these are known; or those that prescribe motions."""
        cdef cnp.ndarray values
        if r is None:
            if not known:
                raise ModelError(self.missing())
            return None
        if type(r) is not np.ndarray:
            values = new_array(self.n_r)
            self.kernel.default_inputs(t, self._prepare(parameters), data(values))
            r = self.input_values(r, values.tolist(), bool(all_count))
        values = vector(r, self.n_r, "The inputs r")
        if not fb_finite(data(values), self.n_r):
            raise ModelError(f"The inputs r must be finite, not {shown(r)}.")
        return values

    cdef cnp.ndarray _state(self, double t, object x, int n):
        cdef cnp.ndarray values = vector(x, n, "The state x" if n == self.n_x else "The coordinates q")
        if not (fb_finite(data(values), n) and fb_finite(&t, 1)):
            raise ModelError(f"Time and state must be finite, not t = {t}, x = {shown(x)}.")
        return values

    cdef const double *_prepare(self, cnp.ndarray parameters) noexcept:
        """The constants of the parameters, in the buffer."""
        if parameters is None:
            return self.default_constants
        self.kernel.prepare(data(parameters), self.constants)
        return self.constants

    cdef const double *_fill(self, double t, const double *constants, cnp.ndarray inputs) noexcept:
        """The inputs, or their expressions' values in the buffer."""
        if inputs is None:
            self.kernel.default_inputs(t, constants, self.inputs)
            return self.inputs
        return data(inputs)

    def rhs(self, t, x, p=None, r=None, out=None):
        """The right-hand side of x' = f(t, x).

        Parameters
        ----------
        t : float
            Time, s.
        x : array_like, shape (n_x,)
            State: coordinates, speeds, then auxiliary states.
        p : array_like, shape (n_p,), or mapping, optional
            Parameters: all in order, or some by name; the defaults otherwise.
        r : array_like, shape (n_r,), or mapping, optional
            Inputs; their expressions otherwise.
        out : ndarray, shape (n_x,), optional
            Where to write the result; contiguous, of floats, without memory shared with `x`, `p` or `r`.

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
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray result
        result = new_array(self.n_x) if out is None else self._output(out, state, parameters, inputs)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.rhs(
            t, data(state), constants, self._fill(t, constants, inputs), data(result), self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        return result

    cdef cnp.ndarray _output(self, object out, cnp.ndarray state, cnp.ndarray parameters, cnp.ndarray inputs):
        if not (cnp.PyArray_Check(out) and cnp.PyArray_TYPE(out) == cnp.NPY_DOUBLE and cnp.PyArray_ISCARRAY(out)
                and cnp.PyArray_NDIM(out) == 1 and cnp.PyArray_DIM(out, 0) == self.n_x
                and (cnp.PyArray_CheckExact(out) or not _masked(out, 0))):
            raise ModelError(f"out must be a contiguous, writable array of {self.n_x} floats.")
        if (_overlap(out, state) or (parameters is not None and _overlap(out, parameters))
                or (inputs is not None and _overlap(out, inputs))):
            raise ModelError("out must not share memory with x, p or r.")
        return out

    def jacobian(self, t, x, p=None, r=None):
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
        t = time_of(t)
        return self._differentiate(FB_STATE_PARTIALS, self.n_x, t, x, p, r)

    def parameter_jacobian(self, t, x, p=None, r=None):
        """The derivatives of the right-hand side with respect to the parameters.

        They are total derivatives of x' at the state x. They include parameters that are expressions of others, and
        the expressions of inputs and of the rates of prescribed motions: dx'/dp + dx'/dr dr/dp. Inputs given in `r` do
        not change with the parameters: all inputs if it is an array; if it is a mapping, those in it, with their rates.

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
        t = time_of(t)
        cdef cnp.ndarray result = self._differentiate(FB_PARAMETER_PARTIALS, self.n_p, t, x, p, r)
        cdef cnp.ndarray wrt_inputs
        cdef cnp.ndarray wrt_parameters = self._default_input_partials(t, p)
        cdef list changing = self._changing(wrt_parameters, r)
        if not changing:
            return result
        wrt_inputs = self._differentiate(FB_INPUT_PARTIALS, self.n_r, t, x, p, r)
        return self._finite_or_raise(result + self._through_inputs(wrt_inputs, wrt_parameters, changing), t, x)

    def _changing(self, wrt_parameters, r):
        """The inputs whose expressions change with the parameters; others are skipped, since dx'/dr may be infinite."""
        in_force = self.defaults_in_force(r)
        return [j for j in range(self.n_r) if in_force[j] and wrt_parameters[j].any()]

    cdef cnp.ndarray _through_inputs(self, cnp.ndarray wrt_inputs, cnp.ndarray wrt_parameters, list changing):
        """The derivatives with respect to the parameters through inputs' expressions."""
        return np.matmul(wrt_inputs[:, changing], wrt_parameters[changing])

    def _finite_or_raise(self, cnp.ndarray result, double t, x):
        if not np.isfinite(result).all():
            raise SimulationError(self.failure(FB_NOT_FINITE, t, x))
        return result

    def output_jacobian(self, t, x, p=None, r=None):
        """The derivatives of the outputs with respect to the state.

        Accelerations and multipliers in the outputs change by the equations of motion.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_o, n_x)

        Raises
        ------
        ModelError, SimulationError
            As for `rhs`; or if an output contains multipliers that redundant constraints leave undetermined.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.output_jacobian(0.0, four_bar.initial_state()).shape
        (0, 6)
        """
        self.require_output_derivatives(self.layout.outputs)
        t = time_of(t)
        return self._differentiate_outputs(
            FB_STATE_PARTIALS, FB_OUTPUT_STATE_PARTIALS, self.n_x, t, x, p, r)

    def output_parameter_jacobian(self, t, x, p=None, r=None):
        """The derivatives of the outputs with respect to the parameters.

        They are total derivatives, like those of `parameter_jacobian`.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_o, n_p)

        Raises
        ------
        ModelError, SimulationError
            As for `output_jacobian`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.output_parameter_jacobian(0.0, four_bar.initial_state()).shape
        (0, 8)
        """
        self.require_output_derivatives(self.layout.outputs)
        t = time_of(t)
        cdef cnp.ndarray result = self._differentiate_outputs(
            FB_PARAMETER_PARTIALS, FB_OUTPUT_PARAMETER_PARTIALS, self.n_p, t, x, p, r)
        cdef cnp.ndarray wrt_parameters = self._default_input_partials(t, p)
        cdef list changing = self._changing(wrt_parameters, r)
        if not changing:
            return result
        wrt_inputs = self.output_input_jacobian(t, x, p, r)
        return self._finite_or_raise(result + self._through_inputs(wrt_inputs, wrt_parameters, changing), t, x)

    def output_input_jacobian(self, t, x, p=None, r=None):
        """The derivatives of the outputs with respect to the inputs.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Returns
        -------
        ndarray, shape (n_o, n_r)

        Raises
        ------
        ModelError, SimulationError
            As for `output_jacobian`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.output_input_jacobian(0.0, four_bar.initial_state()).shape
        (0, 1)
        """
        self.require_output_derivatives(self.layout.outputs)
        t = time_of(t)
        return self._differentiate_outputs(
            FB_INPUT_PARTIALS, FB_OUTPUT_INPUT_PARTIALS, self.n_r, t, x, p, r)

    def require_output_derivatives(self, names):
        """Raise a ModelError if redundant constraints leave the derivatives of some of these outputs undetermined."""
        left_open = [name for name in names if name in self.layout.undetermined_outputs]
        if left_open:
            raise ModelError(
                f"The outputs {', '.join(left_open)} contain multipliers, which redundant constraints leave "
                "undetermined, and so are their derivatives: leave out the redundant ones.")

    def output_derivatives(self, t, x, p=None, r=None):
        """The derivatives of all outputs with respect to state and inputs; see `require_output_derivatives`."""
        t = time_of(t)
        wrt_state = self._differentiate_outputs(
            FB_STATE_PARTIALS, FB_OUTPUT_STATE_PARTIALS, self.n_x, t, x, p, r)
        return wrt_state, self._differentiate_outputs(
            FB_INPUT_PARTIALS, FB_OUTPUT_INPUT_PARTIALS, self.n_r, t, x, p, r)

    cdef cnp.ndarray _differentiate_outputs(
            self, int role, int outputs, int columns, double t, x, p, r):
        """dy = y_x dx + y_u' du' + y_lambda dlambda, with du' and dlambda from the equations."""
        if self.n_o == 0:
            self._inputs(t, self._parameters(p), r, self.has_inputs)
            self._state(t, x, self.n_x)
            return new_array(0, columns)
        cdef cnp.ndarray of_multipliers = new_array(self.n_l, columns)
        rates = self._differentiate(role, columns, t, x, p, r, of_multipliers)
        solution = self.accelerations(t, x, p, r)
        [result] = self.evaluate(outputs, t, x, p, r, *solution)
        wrt_accelerations, wrt_multipliers = self.evaluate(FB_OUTPUT_SOLUTION_PARTIALS, t, x, p, r, *solution)
        result += np.matmul(wrt_accelerations, rates[self.n_q:self.n_q + self.n_u])
        result += np.matmul(wrt_multipliers, of_multipliers)
        return self._finite_or_raise(result, t, x)

    def input_jacobian(self, t, x, p=None, r=None):
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
        t = time_of(t)
        return self._differentiate(FB_INPUT_PARTIALS, self.n_r, t, x, p, r)

    def jvp(self, t, x, dx=None, dp=None, dr=None, p=None, r=None):
        """The derivatives of the right-hand side along directions: products of its Jacobians with vectors.

        Parameters
        ----------
        t : float
        x : array_like, shape (n_x,)
        dx, dp, dr : array_like, shape (n_x,), (n_p,), (n_r,), or with n columns, optional
            The direction in states, parameters and inputs; 0 for what is left out.
        p, r
            As for `rhs`. Inputs whose expressions are in force change with the parameters, in addition to `dr`.

        Returns
        -------
        ndarray, shape (n_x,) or (n_x, n)

        Raises
        ------
        ModelError
            If an argument has a wrong shape.
        SimulationError
            If the equations have no derivative there, as at a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> import numpy as np
        >>> four_bar = fb.load("four_bar")
        >>> x, dx = four_bar.initial_state(), np.ones(6)
        >>> bool(np.allclose(four_bar.jvp(0.0, x, dx), four_bar.jacobian(0.0, x) @ dx))
        True
        """
        t = time_of(t)
        sizes = ((self.n_x, "states"), (self.n_p, "parameters"), (self.n_r, "inputs"))
        given = [None if part is None else numbers(part, f"A direction in the {what}")
                 for part, (_, what) in zip((dx, dp, dr), sizes)]
        for part, (size, what) in zip(given, sizes):
            if part is not None and (np.ndim(part) not in (1, 2) or len(part) != size):
                raise ModelError(
                    f"A direction in the {what} has the shape ({size},) or ({size}, n), not {np.shape(part)}.")
        counts = {np.shape(part)[1:] for part in given if part is not None} or {()}
        if len(counts) > 1:
            raise ModelError(
                "Directions must all be vectors, or matrices with as many columns as each other, not of the shapes "
                f"{[np.shape(part) for part in given if part is not None]}.")
        count = counts.pop()
        cdef int i, n = count[0] if count else 1
        filled_in = [np.zeros((size, n)) if part is None else np.reshape(part, (size, n))
                     for part, (size, _) in zip(given, sizes)]
        blocks = self._blocks(t, np.vstack(filled_in[:2]), p, r)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray block, rates
        self.function(FB_RESIDUAL_JVP)
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        cdef int status
        result = np.empty((self.n_x, n))
        for i in range(0, n, FB_DIRECTIONS):
            block, rates = blocks[i // FB_DIRECTIONS], new_array(self.n_x, FB_DIRECTIONS)
            block[self.n_x + self.n_p:, :n - i] += filled_in[2][:, i:i + FB_DIRECTIONS]
            status = self.kernel.jvp(self.functions, t, data(state), constants, filled, NULL, FB_DIRECTIONS,
                                     data(block), data(rates), self.work)
            if status != FB_OK:
                raise SimulationError(self.failure(status, t, x))
            result[:, i:i + FB_DIRECTIONS] = rates[:, :n - i]
        return result if count else result[:, 0]

    def vjp(self, t, x, weights, p=None, r=None):
        """The gradient of weights times the right-hand side: the products of a vector with its Jacobians.

        It takes a small multiple of the time of the right-hand side, however many parameters there are.

        Parameters
        ----------
        t : float
        x : array_like, shape (n_x,)
        weights : array_like, shape (n_x,)
        p, r
            As for `rhs`.

        Returns
        -------
        wrt_state : ndarray, shape (n_x,)
        wrt_parameters : ndarray, shape (n_p,)
            Including the parameters' effect through inputs whose expressions are in force.
        wrt_inputs : ndarray, shape (n_r,)

        Raises
        ------
        ModelError
            If an argument has a wrong shape.
        SimulationError
            If the equations have no derivative there, as at a singular position.

        Source: A. Griewank, A. Walther, *Evaluating Derivatives*, 2nd ed., SIAM 2008, section 3.2 (reverse mode).

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> import numpy as np
        >>> four_bar = fb.load("four_bar")
        >>> x, w = four_bar.initial_state(), np.ones(6)
        >>> bool(np.allclose(four_bar.vjp(0.0, x, w)[0], w @ four_bar.jacobian(0.0, x)))
        True
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray given = np.concatenate((vector(weights, self.n_x, "The weights"), np.zeros(self.n_l)))
        cdef cnp.ndarray gradient = new_array(self.n_x + self.n_p + self.n_r)
        self.function(FB_RESIDUAL_JVP)
        in_force = np.array(self.defaults_in_force(r), dtype=bool)
        wrt_parameters = self._default_input_partials(t, p) * in_force[:, None]
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.vjp(
            self.functions, t, data(state), constants, self._fill(t, constants, inputs), data(given), data(gradient),
            self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        wrt_state, wrt_p, wrt_inputs = np.split(gradient, (self.n_x, self.n_x + self.n_p))
        return wrt_state, wrt_p + wrt_inputs @ wrt_parameters, wrt_inputs

    cdef cnp.ndarray _differentiate(self, int role, int columns, double t, x, p, r, cnp.ndarray multipliers=None):
        """The derivatives of x' from the partial Jacobian of a role; those of the multipliers go to an array."""
        self.function(role)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray result = new_array(self.n_x, columns)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.differentiate(
            self.functions, role, columns, t, data(state), constants, self._fill(t, constants, inputs),
            data(result), NULL if multipliers is None else data(multipliers), self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        return result

    def _default_input_partials(self, t, p):
        return self.evaluate(FB_DEFAULT_INPUT_PARTIALS, t, None, p)[0]

    def accelerations(self, t, x, p=None, r=None):
        """u', shape (n_u,), and the multipliers lambda with unknown forces that drive the motion, shape (n_l,)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray accelerations = new_array(self.n_u)
        cdef cnp.ndarray multipliers = new_array(self.n_l)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.accelerations(
            t, data(state), constants, self._fill(t, constants, inputs), data(accelerations), data(multipliers),
            self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        return accelerations, multipliers

    def constraint_jvp(self, t, x, directions, p=None, r=None):
        """The derivatives of the constraint violations along directions of (x, p, r), shape (n_x + n_p + n_r, n).

        Two arrays, of shapes (n_c + n_i, n) and (n_c, n). Without rows of r, inputs whose expressions are in force
        follow the parameters.
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_prescribed)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef int i, n = np.shape(directions)[1]
        cdef cnp.ndarray block, position, velocity
        cdef const fb_function *f = self.function(FB_CONSTRAINT_JVP)
        cdef fb_at at
        cdef const double *given[1]
        cdef double *found[2]
        blocks = self._blocks(t, directions, p, r)
        positions, velocities = np.empty((self.n_c + self.n_i, n)), np.empty((self.n_c, n))
        at.t, at.x, at.n_directions = t, data(state), FB_DIRECTIONS
        at.constants = self._prepare(parameters)
        at.r = self._fill(t, at.constants, inputs)
        at.accelerations = at.multipliers = NULL
        for i in range(0, n, FB_DIRECTIONS):
            block = blocks[i // FB_DIRECTIONS]
            position, velocity = new_array(self.n_c + self.n_i, FB_DIRECTIONS), new_array(self.n_c, FB_DIRECTIONS)
            given[0], found[0], found[1] = data(block), data(position), data(velocity)
            f.call(&at, given, found, self.work)
            positions[:, i:i + FB_DIRECTIONS] = position[:, :n - i]
            velocities[:, i:i + FB_DIRECTIONS] = velocity[:, :n - i]
        return positions, velocities

    def _blocks(self, t, directions, p, r):
        """Directions of (x, p, r), shape (n_x + n_p + n_r, n), as blocks with FB_DIRECTIONS columns."""
        rows, n = np.shape(directions)
        blocks = np.zeros(((n + FB_DIRECTIONS - 1) // FB_DIRECTIONS, self.n_x + self.n_p + self.n_r, FB_DIRECTIONS))
        given = directions
        if rows < self.n_x + self.n_p + self.n_r:
            in_force = np.array(self.defaults_in_force(r), dtype=bool)[:, None]
            of_inputs = (self._default_input_partials(t, p) * in_force) @ directions[self.n_x:]
            given = np.vstack((directions, of_inputs))
        for i in range(n):
            blocks[i // FB_DIRECTIONS, :, i % FB_DIRECTIONS] = given[:, i]
        return blocks

    cdef int _check_columns(self, cnp.ndarray t, cnp.ndarray x, cnp.ndarray r) except -1:
        if np.ndim(t) != 1 or np.shape(x) != (np.size(t), self.n_x) or np.shape(r) != (np.size(t), self.n_r):
            raise ModelError(
                f"{np.size(t)} times need states of shape ({self.n_x}, {np.size(t)}), not {np.shape(x)[::-1]}, and "
                f"inputs of shape ({self.n_r}, {np.size(t)}), not {np.shape(r)[::-1]}.")
        return 0

    def parameter_vector(self, p):
        """The parameters, given as for `rhs`, checked and copied; None for the defaults."""
        cdef cnp.ndarray values = self._parameters(p)
        return None if values is None else np.array(values)

    def evaluate_along(self, wanted, times, states, inputs, p=None):
        """Results of functions of the table for states and inputs in columns.

        Parameters
        ----------
        wanted : mapping of Role to sequence of int
            The functions, and the places of the results that are wanted.
        times : array_like, shape (n_t,)
        states : array_like, shape (n_x, n_t)
        inputs : array_like, shape (n_r, n_t)
        p : array_like or mapping, optional

        Returns
        -------
        multipliers : ndarray, shape (n_l, n_t)
            If a function needs them or u'. NaN where they cannot be evaluated, as are the results of these functions.
        list of ndarray
            In the order in which they are wanted; the last axis is time.
        """
        cdef cnp.ndarray t = numbers(times, "The times")
        cdef cnp.ndarray x = rows(states, "The states")
        cdef cnp.ndarray r = rows(inputs, "The inputs")
        cdef cnp.ndarray parameters = self._parameters(p)
        self._check_columns(t, x, r)
        cdef int n_t = cnp.PyArray_DIM(t, 0), i, j, size, role
        cdef cnp.ndarray multipliers = np.full((n_t, self.n_l), NAN), accelerations = new_array(self.n_u), array
        cdef const fb_function *f
        cdef double *found[FB_ARRAYS]
        cdef int steps[FB_ARRAYS]
        cdef fb_at at
        cdef bint solved
        results = []
        for role, places in wanted.items():
            f = self.function(role)
            if f.n_arguments:
                raise ModelError(f"A function of the role {role} takes arguments, which have no values along a run.")
            if not set(places) <= set(range(f.n_results)):
                raise ModelError(f"A function of the role {role} has {f.n_results} results, not those of {places}.")
            arrays = []
            for j in range(f.n_results):
                size = f.results[j].rows * (1 if f.results[j].columns == FB_VECTOR else f.results[j].columns)
                array = np.full((n_t if j in places else 1, size), NAN)
                steps[j] = size if j in places else 0
                found[j] = data(array)
                arrays.append(array)
            at.n_directions, at.accelerations, at.constants = 0, data(accelerations), self._prepare(parameters)
            for i in range(n_t):
                at.t, at.x, at.r = data(t)[i], data(x) + i * self.n_x, data(r) + i * self.n_r
                at.multipliers = data(multipliers) + i * self.n_l
                solved = not f.needs & (FB_NEEDS_ACCELERATIONS | FB_NEEDS_MULTIPLIERS) or self.kernel.accelerations(
                    at.t, at.x, at.constants, at.r, data(accelerations), data(multipliers) + i * self.n_l,
                    self.work) == FB_OK
                if solved:
                    f.call(&at, NULL, found, self.work)
                for j in range(f.n_results):
                    found[j] += steps[j]
            for j in places:
                array = arrays[j]
                if f.results[j].columns != FB_VECTOR:
                    array = np.reshape(array, (n_t, f.results[j].rows, f.results[j].columns))
                results.append(np.moveaxis(array, 0, -1))
        return multipliers.T, results


def dependent_changes(Evaluator evaluator not None, t, x, directions, int n_qd, int n_ud, p, r):
    """The implicit derivatives of dependent coordinates and speeds, see ``derivatives/dependent_variables.h``.

    Parameters
    ----------
    evaluator : Evaluator
    t : float
    x : ndarray, shape (n_x,)
    directions : ndarray, shape (n_x + n_p + n_r, n)
        Of (x, p, r).
    n_qd, n_ud : int
        The numbers of dependent coordinates and speeds, which are the last ones.

    Returns
    -------
    str
        What is undetermined, "coordinates" or "speeds", or "".
    ndarray, shape (n_x + n_p + n_r, n)
        The directions with dependent rows filled.
    ndarray, shape (n_x,)
        The change of x by a step of Newton's method.
    float
        The least pivot, as a fraction of the largest.
    ndarray, shape (n + 1,)
        By how much redundant constraints are violated, for each direction and for the step, relative to their entries.
    """
    t = time_of(t)
    cdef cnp.ndarray parameters = evaluator._parameters(p)
    cdef cnp.ndarray inputs = evaluator._inputs(t, parameters, r, evaluator.has_prescribed)
    cdef cnp.ndarray state = evaluator._state(t, x, evaluator.n_x), given = numbers(directions, "The directions")
    cdef cnp.ndarray correction = np.zeros(evaluator.n_x), derivatives = given.copy(), memory, left
    evaluator.function(FB_CONSTRAINT_JVP)
    cdef const double *constants = evaluator._prepare(parameters)
    cdef fb_dependent f
    cdef int i, rows = evaluator.n_x + evaluator.n_p + evaluator.n_r, n_d = n_qd + n_ud, found
    f.n_qd, f.n_ud, f.n = n_qd, n_ud, cnp.PyArray_DIM(given, 1)
    memory = new_array(fb_place_dependent(evaluator.kernel, &f, NULL))
    fb_place_dependent(evaluator.kernel, &f, data(memory))
    cdef cnp.ndarray order = np.zeros(n_d + 1, dtype=np.intc)
    f.order = <int *>cnp.PyArray_DATA(order)
    for i in range(rows):
        memcpy(f.directions + i * (n_d + f.n) + n_d, data(given) + i * f.n, f.n * sizeof(double))
    found = fb_implicit_derivatives(
        evaluator.kernel, t, data(state), constants, evaluator._fill(t, constants, inputs), &f)
    for i in range(rows):
        memcpy(data(derivatives) + i * f.n, f.directions + i * (n_d + f.n) + n_d, f.n * sizeof(double))
    memcpy(data(correction) + evaluator.n_q - n_qd, f.corrections, n_qd * sizeof(double))
    memcpy(data(correction) + evaluator.n_q + evaluator.n_u - n_ud, f.corrections + n_qd, n_ud * sizeof(double))
    left = new_array(f.n + 1)
    memcpy(data(left), f.left, (f.n + 1) * sizeof(double))
    return _UNDETERMINED[found], derivatives, correction, f.pivot, left
