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

cdef extern from "fourbar_follow.h":
    int FB_FOLLOWS
    int FB_COORDINATES_DO_NOT
    int FB_SPEEDS_DO_NOT
    ctypedef struct fb_follow:
        int n_qd, n_ud, n
        double *directions
        double *corrections
        double *left
        double pivot
    size_t fb_place_follow(const fb_kernel *, fb_follow *, double *) noexcept nogil
    int fb_follow_at(const fb_kernel *, const fb_variations *, double, const double *, const double *, const double *,
                     fb_follow *) noexcept nogil

cdef extern from "fourbar_batch.h":
    int fb_batch_functions_agree(const fb_batch_functions *) noexcept nogil

_FOLLOWS = {FB_FOLLOWS: "", FB_COORDINATES_DO_NOT: "coordinates", FB_SPEEDS_DO_NOT: "speeds"}

OK, NOT_CLOSED, NOT_FINITE = FB_OK, FB_NOT_CLOSED, FB_NOT_FINITE


cdef object _other_layout(manifest):
    return ModelError(
        f"The compiled model {manifest['name']} was built with another version of this package (whose kernel "
        f"interface is {FB_ABI_VERSION}), and its data have another layout: build it again.")


cdef bint _agree(int abi_version, size_t size, size_t expected) noexcept:
    """Whether a table was built with these headers."""
    return abi_version == FB_ABI_VERSION and size == expected


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
    manifest : dict
        The manifest of the same module, decoded.
    """

    # All threads share one set of buffers. A method first reads its arguments, which may run Python and switch
    # threads, then fills the buffers and calls the kernel without running Python in between.

    def __cinit__(self, capsule, manifest):
        cdef const fb_kernel *kernel = _kernel_in(capsule)
        if kernel.abi_version != FB_ABI_VERSION or kernel.struct_size != sizeof(fb_kernel):
            raise _other_layout(manifest)
        if kernel.batch_functions != NULL and not fb_batch_functions_agree(kernel.batch_functions):
            raise _other_layout(manifest)
        self.own = kernel[0]  # a copy, to which parts that are built separately are attached
        self.kernel = &self.own
        self.capsule, self.manifest = capsule, manifest
        if kernel.derivatives != NULL:
            self._attach_derivatives(<size_t>kernel.derivatives)
        if kernel.variations != NULL:
            self._attach_variations(<size_t>kernel.variations)
        self.n_q, self.n_u, self.n_p, self.n_r = kernel.n_q, kernel.n_u, kernel.n_p, kernel.n_r
        self.n_h, self.n_c, self.n_l, self.n_i, self.n_o = kernel.n_h, kernel.n_c, kernel.n_l, kernel.n_i, kernel.n_o
        self.n_z, self.n_x, self.states_need_solution = kernel.n_z, kernel.n_x, kernel.states_need_solution
        self.default_constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.constants = <double *>PyMem_Calloc(kernel.n_constants + 1, sizeof(double))
        self.inputs = <double *>PyMem_Calloc(self.n_r + 1, sizeof(double))
        self.work = PyMem_Malloc(kernel.work_size)
        if not (self.default_constants and self.constants and self.inputs and self.work):
            raise MemoryError
        values = [NAN if entry["default"] is None else entry["default"] for entry in manifest["parameters"]]
        self.default_parameters = vector(values, self.n_p, "The default parameters")
        self.has_defaults = fb_finite(data(self.default_parameters), self.n_p)
        unknown = {place for place, entry in enumerate(manifest["inputs"]) if entry["expression"] is None}
        self.has_inputs, self.has_motions = not unknown, not unknown & set(manifest["moving_inputs"])
        kernel.prepare(data(self.default_parameters), self.default_constants)

    def __dealloc__(self):
        PyMem_Free(self.default_constants)
        PyMem_Free(self.constants)
        PyMem_Free(self.inputs)
        PyMem_Free(self.work)

    @property
    def lacks_batch_functions(self):
        """Whether the functions for several states side by side are in a library that is not attached yet."""
        return self.kernel.batch_functions == NULL and self.kernel.batch_functions_apart != 0

    @property
    def lacks_derivatives(self):
        """Whether derivatives and data for drawings are in a library that is not attached yet."""
        return self.kernel.derivatives == NULL

    @property
    def lacks_variations(self):
        """Whether products of derivatives with vectors are in a library that is not attached yet."""
        return self.kernel.variations == NULL

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

    def _attach_batch_functions(self, size_t address):
        """Attach an ``fb_batch_functions`` that was built separately: functions for states side by side.

        Raises
        ------
        ModelError
            If they were built with another version of the package.
        """
        if not fb_batch_functions_agree(<const fb_batch_functions *>address):
            raise _other_layout(self.manifest)
        self.own.batch_functions = <const fb_batch_functions *>address

    def _attach_derivatives(self, size_t address):
        """Attach an ``fb_derivatives``."""
        cdef const fb_derivatives *table = <const fb_derivatives *>address
        if not _agree(table.abi_version, table.struct_size, sizeof(fb_derivatives)):
            raise _other_layout(self.manifest)
        self.own.derivatives = table

    def _attach_variations(self, size_t address):
        """Attach an ``fb_variations``."""
        cdef const fb_variations *table = <const fb_variations *>address
        if not _agree(table.abi_version, table.struct_size, sizeof(fb_variations)):
            raise _other_layout(self.manifest)
        self.own.variations = table

    def require_derivatives(self):
        """Attach the derivatives; a subclass that has their sources builds them."""
        raise ModelError("The derivatives are in a library of their own: attach it.")

    cdef const fb_derivatives *derivatives(self) except NULL:
        """The derivatives of the kernel, built first if necessary."""
        if self.kernel.derivatives == NULL:
            self.require_derivatives()
        return self.kernel.derivatives

    def _attach_parts_of(self, Evaluator other not None):
        """Attach the parts that another evaluator of the same kernel has."""
        self.own.derivatives, self.own.variations = other.own.derivatives, other.own.variations

    def require_variations(self):
        """Attach the products of derivatives with vectors; a subclass that has their sources builds them."""
        raise ModelError("The products of derivatives with vectors are in a library of their own: attach it.")

    cdef const fb_variations *variations(self) except NULL:
        """The products of derivatives with vectors, built first if necessary."""
        if self.kernel.variations == NULL:
            self.require_variations()
        return self.kernel.variations

    def parameter_values(self, p):
        """All parameter values in order; a subclass that knows their names also takes mappings."""
        return p

    def input_values(self, r, defaults):
        """All input values in order; a subclass also takes mappings, with the expressions' values as defaults."""
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
        if status == FB_NOT_CLOSED:
            return f"The loops cannot be closed {where}: no state nearby satisfies the constraints."
        return (
            f"The equations of motion, or their derivatives, are not finite {where}: a division by zero, a coordinate "
            "beyond its range, or an input that is not finite."
        )

    def too_few_dependent(self, where, rank=None):
        """A sentence for a rank of the velocity constraints that is larger than the number of dependent speeds."""
        n = self.manifest["n_dependent_speeds"]
        dependent = self.manifest["speeds"][self.n_u - n:]
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

    cdef cnp.ndarray _inputs(self, double t, cnp.ndarray parameters, object r, bint known):
        """All inputs, or None for their expressions, as far as these are known."""
        cdef cnp.ndarray values
        if r is None:
            if not known:
                raise ModelError(self.missing())
            return None
        if type(r) is not np.ndarray:
            values = new_array(self.n_r)
            self.kernel.default_inputs(t, self._prepare(parameters), data(values))
            r = self.input_values(r, values.tolist())
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
            State: coordinates, then speeds.
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
        return self._differentiate(self.derivatives().sensitivity, self.n_x, t, x, p, r)

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
        cdef cnp.ndarray result = self._differentiate(self.derivatives().parameter_sensitivity, self.n_p, t, x, p, r)
        cdef cnp.ndarray by_inputs
        cdef cnp.ndarray by_parameters = self.default_input_sensitivity(t, p)
        cdef list changing = self._changing(by_parameters, r)
        if not changing:
            return result
        by_inputs = self._differentiate(self.derivatives().input_sensitivity, self.n_r, t, x, p, r)
        return self._finite_or_raise(result + self._through_inputs(by_inputs, by_parameters, changing), t, x)

    def _changing(self, by_parameters, r):
        """The inputs whose expressions change with the parameters; others are skipped, since dx'/dr may be infinite."""
        in_force = self.defaults_in_force(r)
        return [j for j in range(self.n_r) if in_force[j] and by_parameters[j].any()]

    cdef cnp.ndarray _through_inputs(self, cnp.ndarray by_inputs, cnp.ndarray by_parameters, list changing):
        """The derivatives with respect to the parameters through inputs' expressions."""
        return np.matmul(by_inputs[:, changing], by_parameters[changing])

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
        self.require_output_derivatives(self.manifest["outputs"])
        t = time_of(t)
        cdef const fb_derivatives *derivatives = self.derivatives()
        return self._differentiate_outputs(
            derivatives.sensitivity, derivatives.output_sensitivity, self.n_x, t, x, p, r)

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
        self.require_output_derivatives(self.manifest["outputs"])
        t = time_of(t)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef cnp.ndarray result = self._differentiate_outputs(
            derivatives.parameter_sensitivity, derivatives.output_parameter_sensitivity, self.n_p, t, x, p, r)
        cdef cnp.ndarray by_parameters = self.default_input_sensitivity(t, p)
        cdef list changing = self._changing(by_parameters, r)
        if not changing:
            return result
        by_inputs = self.output_input_jacobian(t, x, p, r)
        return self._finite_or_raise(result + self._through_inputs(by_inputs, by_parameters, changing), t, x)

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
        self.require_output_derivatives(self.manifest["outputs"])
        t = time_of(t)
        cdef const fb_derivatives *derivatives = self.derivatives()
        return self._differentiate_outputs(
            derivatives.input_sensitivity, derivatives.output_input_sensitivity, self.n_r, t, x, p, r)

    def require_output_derivatives(self, names):
        """Raise a ModelError if redundant constraints leave the derivatives of some of these outputs undetermined."""
        left_open = [name for name in names if name in self.manifest["open_outputs"]]
        if left_open:
            raise ModelError(
                f"The outputs {', '.join(left_open)} contain multipliers, which redundant constraints leave "
                "undetermined, and so are their derivatives: leave out the redundant ones.")

    def output_derivatives(self, t, x, p=None, r=None):
        """The derivatives of all outputs with respect to state and inputs; see `require_output_derivatives`."""
        t = time_of(t)
        cdef const fb_derivatives *derivatives = self.derivatives()
        by_state = self._differentiate_outputs(
            derivatives.sensitivity, derivatives.output_sensitivity, self.n_x, t, x, p, r)
        return by_state, self._differentiate_outputs(
            derivatives.input_sensitivity, derivatives.output_input_sensitivity, self.n_r, t, x, p, r)

    cdef cnp.ndarray _differentiate_outputs(
            self, fb_sensitivity *function, fb_output_sensitivity *outputs, int columns, double t, x, p, r):
        """dy = y_x dx + y_u' du' + y_lambda dlambda, with du' and dlambda from the equations."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray rates = new_array(self.n_x, columns), multiplier_rates = new_array(self.n_l, columns)
        cdef cnp.ndarray accelerations = new_array(self.n_u), multipliers = new_array(self.n_l)
        cdef cnp.ndarray result = new_array(self.n_o, columns)
        cdef cnp.ndarray by_accelerations = new_array(self.n_o, self.n_u)
        cdef cnp.ndarray by_multipliers = new_array(self.n_o, self.n_l)
        cdef const fb_derivatives *derivatives = self.derivatives()
        if self.n_o == 0:
            return result
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        cdef int status = self.kernel.differentiate(
            derivatives, function, columns, t, data(state), constants, filled, data(rates), data(multiplier_rates),
            self.work)
        if status == FB_OK:
            status = self.kernel.accelerations(
                t, data(state), constants, filled, data(accelerations), data(multipliers), self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        outputs(t, data(state), constants, filled, data(accelerations), data(multipliers), data(result))
        derivatives.output_solution_sensitivity(
            t, data(state), constants, filled, data(accelerations), data(multipliers), data(by_accelerations),
            data(by_multipliers))
        result += np.matmul(by_accelerations, rates[self.n_q:self.n_q + self.n_u])
        result += np.matmul(by_multipliers, multiplier_rates)
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
        return self._differentiate(self.derivatives().input_sensitivity, self.n_r, t, x, p, r)

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
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const fb_variations *variations = self.variations()
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        cdef int status
        result = np.empty((self.n_x, n))
        for i in range(0, n, FB_DIRECTIONS):
            block, rates = blocks[i // FB_DIRECTIONS], new_array(self.n_x, FB_DIRECTIONS)
            block[self.n_x + self.n_p:, :n - i] += filled_in[2][:, i:i + FB_DIRECTIONS]
            status = self.kernel.vary(derivatives, variations, t, data(state), constants, filled, NULL, FB_DIRECTIONS,
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
        by_state : ndarray, shape (n_x,)
        by_parameters : ndarray, shape (n_p,)
            Including the parameters' effect through inputs whose expressions are in force.
        by_inputs : ndarray, shape (n_r,)

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
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const fb_variations *variations = self.variations()
        in_force = np.array(self.defaults_in_force(r), dtype=bool)
        by_parameters = self.default_input_sensitivity(t, p) * in_force[:, None]
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.pull_back(
            derivatives, variations, t, data(state), constants, self._fill(t, constants, inputs), data(given),
            data(gradient), self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        by_state, by_p, by_inputs = np.split(gradient, (self.n_x, self.n_x + self.n_p))
        return by_state, by_p + by_inputs @ by_parameters, by_inputs

    cdef cnp.ndarray _differentiate(self, fb_sensitivity *function, int columns, double t, x, p, r):
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray result = new_array(self.n_x, columns)
        cdef const double *constants = self._prepare(parameters)
        cdef int status = self.kernel.differentiate(
            self.kernel.derivatives, function, columns, t, data(state), constants, self._fill(t, constants, inputs),
            data(result), NULL, self.work)
        if status != FB_OK:
            raise SimulationError(self.failure(status, t, x))
        return result

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

    def unknown_forces(self, t, x, forces, p=None, r=None):
        """For unknown forces n: F, (n_u,), dF/dn, Q, (n_n,), dQ/dn, M_a, (n_n, n_u), and J_a^T, (n_n, n_c).

        See ``fourbar_forces.h``.
        """
        t = time_of(t)
        cdef int n = self.n_l - self.n_c
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray given = vector(forces, n, "The unknown forces")
        cdef cnp.ndarray effect = new_array(self.n_u)
        cdef cnp.ndarray by_forces = new_array(self.n_u, n)
        cdef cnp.ndarray rest = new_array(n)
        cdef cnp.ndarray rest_by_forces = new_array(n, n)
        cdef cnp.ndarray mass = new_array(n, self.n_u)
        cdef cnp.ndarray jacobian = new_array(n, self.n_c)
        cdef const double *constants = self._prepare(parameters)
        if n:
            self.kernel.unknown_forces(
                t, data(state), constants, self._fill(t, constants, inputs), data(given), data(effect), data(by_forces),
                data(rest), data(rest_by_forces), data(mass), data(jacobian))
        else:
            effect[:] = 0.0
        return effect, by_forces, rest, rest_by_forces, mass, jacobian

    def dynamics(self, t, x, p=None, r=None):
        """q', M, f, J and gamma of M u' = f + J^T lambda, J u' + gamma = 0."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray rates = new_array(self.n_q)
        cdef cnp.ndarray mass_matrix = new_array(self.n_u, self.n_u)
        cdef cnp.ndarray forcing = new_array(self.n_u)
        cdef cnp.ndarray jacobian = new_array(self.n_c, self.n_u)
        cdef cnp.ndarray bias = new_array(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.dynamics(t, data(state), constants, self._fill(t, constants, inputs), data(rates),
                             data(mass_matrix), data(forcing), data(jacobian), data(bias))
        return rates, mass_matrix, forcing, jacobian, bias

    def position(self, t, q, p=None, r=None):
        """The position constraints, shape (n_h,), and their Jacobian, shape (n_h, n_q)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray coordinates = self._state(t, q, self.n_q)
        cdef cnp.ndarray constraints = new_array(self.n_h)
        cdef cnp.ndarray jacobian = new_array(self.n_h, self.n_q)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.position(t, data(coordinates), constants, self._fill(t, constants, inputs), data(constraints),
                             data(jacobian))
        return constraints, jacobian

    def velocity(self, t, x, p=None, r=None):
        """J, shape (n_c, n_u), and b, shape (n_c,), of the velocity constraints J u + b = 0."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray jacobian = new_array(self.n_c, self.n_u)
        cdef cnp.ndarray bias = new_array(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.velocity(t, data(state), constants, self._fill(t, constants, inputs), data(jacobian),
                             data(bias))
        return jacobian, bias

    def constraint_violation(self, t, x, p=None, r=None):
        """Constraint violations: of positions, in the rows of J and then invariants, and of velocities.

        Their shapes are (n_c + n_i,) and (n_c,).
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray positions = new_array(self.n_c + self.n_i)
        cdef cnp.ndarray velocities = new_array(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.constraint_violation(
            t, data(state), constants, self._fill(t, constants, inputs), data(positions), data(velocities))
        return positions, velocities

    def constraint_scale(self, t, x, p=None, r=None):
        """Scales of violations.

        Those of the position constraints, shape (n_h,), and of both results of `constraint_violation`.
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray constraints = new_array(self.n_h)
        cdef cnp.ndarray positions = new_array(self.n_c + self.n_i)
        cdef cnp.ndarray velocities = new_array(self.n_c)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.constraint_scale(t, data(state), constants, self._fill(t, constants, inputs), data(constraints),
                                     data(positions), data(velocities))
        return constraints, positions, velocities

    def coordinate_change(self, t, x, change, p=None, r=None):
        """K v, the change of the coordinates, shape (n_q,), for a change v of the speeds' integrals."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray v = vector(change, self.n_u, "The change")
        cdef cnp.ndarray result = new_array(self.n_q)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.coordinate_change(t, data(state), constants, self._fill(t, constants, inputs), data(v),
                                      data(result))
        return result

    def invariant_correction(self, t, q, p=None, r=None):
        """The change of the coordinates, shape (n_q,), that corrects invariants (constraints that no speed changes)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray coordinates = self._state(t, q, self.n_q)
        cdef cnp.ndarray result = new_array(self.n_q)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.invariant_correction(t, data(coordinates), constants, self._fill(t, constants, inputs),
                                         data(result))
        return result

    def constraint_sensitivity(self, t, x, p=None, r=None):
        """d(J u + b)/dq, shape (n_c, n_q), dPhi/dr, shape (n_h, n_r), and d(J u + b)/dr, shape (n_c, n_r)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray by_coordinates = new_array(self.n_c, self.n_q)
        cdef cnp.ndarray positions, velocities
        positions, velocities = new_array(self.n_h, self.n_r), new_array(self.n_c, self.n_r)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        derivatives.constraint_sensitivity(t, data(state), constants, self._fill(t, constants, inputs),
                                           data(by_coordinates), data(positions), data(velocities))
        return by_coordinates, positions, velocities

    def constraint_variation(self, t, x, directions, p=None, r=None):
        """The derivatives of the constraint violations along directions of (x, p, r), shape (n_x + n_p + n_r, n).

        Two arrays, of shapes (n_c + n_i, n) and (n_c, n). Without rows of r, inputs whose expressions are in force
        follow the parameters.
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef int i, n = np.shape(directions)[1]
        cdef cnp.ndarray block, position, velocity
        cdef const fb_variations *variations = self.variations()
        blocks = self._blocks(t, directions, p, r)
        positions, velocities = np.empty((self.n_c + self.n_i, n)), np.empty((self.n_c, n))
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        for i in range(0, n, FB_DIRECTIONS):
            block = blocks[i // FB_DIRECTIONS]
            position, velocity = new_array(self.n_c + self.n_i, FB_DIRECTIONS), new_array(self.n_c, FB_DIRECTIONS)
            variations.constraint_variation(t, data(state), constants, filled, FB_DIRECTIONS, data(block),
                                            data(position), data(velocity))
            positions[:, i:i + FB_DIRECTIONS] = position[:, :n - i]
            velocities[:, i:i + FB_DIRECTIONS] = velocity[:, :n - i]
        return positions, velocities

    def constraint_pullback(self, t, x, weights, p=None, r=None):
        """The gradient by x, p and r, shape (n_x + n_p + n_r,), of weights times the constraint violations.

        Weights have the shape (2 n_c + n_i,), for both results of `constraint_violation`. Inputs do not follow the
        parameters.
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray given = vector(weights, 2 * self.n_c + self.n_i, "The weights")
        cdef cnp.ndarray gradient = new_array(self.n_x + self.n_p + self.n_r)
        cdef const fb_variations *variations = self.variations()
        cdef const double *constants = self._prepare(parameters)
        variations.constraint_pullback(t, data(state), constants, self._fill(t, constants, inputs), data(given),
                                       data(gradient))
        return gradient

    def _blocks(self, t, directions, p, r):
        """Directions of (x, p, r), shape (n_x + n_p + n_r, n), as blocks with FB_DIRECTIONS columns."""
        rows, n = np.shape(directions)
        blocks = np.zeros(((n + FB_DIRECTIONS - 1) // FB_DIRECTIONS, self.n_x + self.n_p + self.n_r, FB_DIRECTIONS))
        given = directions
        if rows < self.n_x + self.n_p + self.n_r:
            in_force = np.array(self.defaults_in_force(r), dtype=bool)[:, None]
            of_inputs = (self.default_input_sensitivity(t, p) * in_force) @ directions[self.n_x:]
            given = np.vstack((directions, of_inputs))
        for i in range(n):
            blocks[i // FB_DIRECTIONS, :, i % FB_DIRECTIONS] = given[:, i]
        return blocks

    def energy(self, t, x, p=None, r=None):
        """Kinetic and potential energy, shape (2,)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray energies = new_array(2)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.energy(t, data(state), constants, self._fill(t, constants, inputs), data(energies))
        return energies

    def drawing(self, t, x, p=None, r=None):
        """Positions of the drawn points, shape (n_points, 3), and the inputs' forces, shape (n_forces, 3)."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray points = new_array(self.kernel.n_points, 3)
        cdef cnp.ndarray forces = new_array(self.kernel.n_forces, 3)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        derivatives.drawing(t, data(state), constants, self._fill(t, constants, inputs), data(points), data(forces))
        return points, forces

    def motion(self, t, x, accelerations, p=None, r=None):
        """q'', shape (n_q,), and velocities and accelerations of the drawn points, (n_points, 3), with u' given."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_motions)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray rates = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray second = new_array(self.n_q)
        cdef cnp.ndarray velocities = new_array(self.kernel.n_points, 3)
        cdef cnp.ndarray of_points = new_array(self.kernel.n_points, 3)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        derivatives.motion(t, data(state), constants, self._fill(t, constants, inputs), data(rates), data(second),
                           data(velocities), data(of_points))
        return second, velocities, of_points

    def drawing_along(self, times, states, inputs, p=None):
        """The same for states and inputs in columns, shapes (n_points, 3, n_t) and (n_forces, 3, n_t)."""
        cdef cnp.ndarray t = numbers(times, "The times")
        cdef cnp.ndarray x = rows(states, "The states")
        cdef cnp.ndarray r = rows(inputs, "The inputs")
        cdef cnp.ndarray parameters = self._parameters(p)
        self._check_columns(t, x, r)
        cdef int i, n_t = np.size(t)
        cdef cnp.ndarray points = new_array(n_t, 3 * self.kernel.n_points)
        cdef cnp.ndarray forces = new_array(n_t, 3 * self.kernel.n_forces)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        for i in range(n_t):
            derivatives.drawing(data(t)[i], data(x) + i * self.n_x, constants, data(r) + i * self.n_r,
                                data(points) + i * 3 * self.kernel.n_points,
                                data(forces) + i * 3 * self.kernel.n_forces)
        return [
            np.moveaxis(points.reshape(n_t, self.kernel.n_points, 3), 0, 2),
            np.moveaxis(forces.reshape(n_t, self.kernel.n_forces, 3), 0, 2),
        ]

    cdef int _check_columns(self, cnp.ndarray t, cnp.ndarray x, cnp.ndarray r) except -1:
        if np.ndim(t) != 1 or np.shape(x) != (np.size(t), self.n_x) or np.shape(r) != (np.size(t), self.n_r):
            raise ModelError(
                f"{np.size(t)} times need states of shape ({self.n_x}, {np.size(t)}), not {np.shape(x)[::-1]}, and "
                f"inputs of shape ({self.n_r}, {np.size(t)}), not {np.shape(r)[::-1]}.")
        return 0

    def outputs_for(self, t, x, accelerations, multipliers, p=None, r=None):
        """The outputs, shape (n_o,), for given u' and lambda."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray lam = vector(multipliers, self.n_l, "The multipliers")
        cdef cnp.ndarray outputs = new_array(self.n_o)
        cdef const double *constants = self._prepare(parameters)
        self.kernel.output(t, data(state), constants, self._fill(t, constants, inputs), data(a), data(lam),
                           data(outputs))
        return outputs

    def state_rates_for(self, t, x, accelerations, multipliers, p=None, r=None):
        """z', shape (n_z,), for given u' and lambda."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray lam = vector(multipliers, self.n_l, "The multipliers")
        cdef cnp.ndarray rates = new_array(self.n_z)
        cdef const double *constants = self._prepare(parameters)
        if self.n_z:
            self.kernel.state_rates(t, data(state), constants, self._fill(t, constants, inputs), data(a), data(lam),
                                    data(rates))
        return rates

    def state_rate_sensitivity(self, t, x, accelerations, multipliers, p=None, r=None):
        """Dz'/du', shape (n_z, n_u), and dz'/dlambda, shape (n_z, n_l), for given u' and lambda."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray lam = vector(multipliers, self.n_l, "The multipliers")
        cdef cnp.ndarray by_accelerations = new_array(self.n_z, self.n_u)
        cdef cnp.ndarray by_multipliers = new_array(self.n_z, self.n_l)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        if self.n_z:
            derivatives.state_rate_sensitivity(t, data(state), constants, self._fill(t, constants, inputs), data(a),
                                               data(lam), data(by_accelerations), data(by_multipliers))
        return by_accelerations, by_multipliers

    def sensitivities(self, t, x, accelerations, multipliers, p=None, r=None):
        """The sensitivities with respect to x, p and r for given u' and lambda, six arrays.

        They are dq', shape (n_q, n), and d(f - M u' + J^T lambda, -(J u' + gamma), z'), shape (n_u + n_l + n_z, n).
        """
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray lam = vector(multipliers, self.n_l, "The multipliers")
        cdef cnp.ndarray rates, residuals
        cdef list results = []
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        cdef fb_sensitivity *functions[3]
        cdef int i
        cdef int columns[3]
        functions[0], columns[0] = derivatives.sensitivity, self.n_x
        functions[1], columns[1] = derivatives.parameter_sensitivity, self.n_p
        functions[2], columns[2] = derivatives.input_sensitivity, self.n_r
        for i in range(3):
            rates = new_array(self.n_q, columns[i])
            residuals = new_array(self.n_u + self.n_l + self.n_z, columns[i])
            functions[i](t, data(state), constants, filled, data(a), data(lam), data(rates), data(residuals))
            results += [rates, residuals]
        return results

    def output_sensitivities(self, t, x, accelerations, multipliers, p=None, r=None):
        """The outputs' derivatives with respect to x, p, r, u' and lambda, each with the others fixed, five arrays."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = self._inputs(t, parameters, r, self.has_inputs)
        cdef cnp.ndarray state = self._state(t, x, self.n_x)
        cdef cnp.ndarray a = vector(accelerations, self.n_u, "The accelerations")
        cdef cnp.ndarray lam = vector(multipliers, self.n_l, "The multipliers")
        cdef cnp.ndarray by_state = new_array(self.n_o, self.n_x)
        cdef cnp.ndarray by_parameters = new_array(self.n_o, self.n_p)
        cdef cnp.ndarray by_inputs = new_array(self.n_o, self.n_r)
        cdef cnp.ndarray by_accelerations = new_array(self.n_o, self.n_u)
        cdef cnp.ndarray by_multipliers = new_array(self.n_o, self.n_l)
        cdef const fb_derivatives *derivatives = self.derivatives()
        cdef const double *constants = self._prepare(parameters)
        cdef const double *filled = self._fill(t, constants, inputs)
        if self.n_o:
            derivatives.output_sensitivity(t, data(state), constants, filled, data(a), data(lam), data(by_state))
            derivatives.output_parameter_sensitivity(
                t, data(state), constants, filled, data(a), data(lam), data(by_parameters))
            derivatives.output_input_sensitivity(t, data(state), constants, filled, data(a), data(lam), data(by_inputs))
            derivatives.output_solution_sensitivity(
                t, data(state), constants, filled, data(a), data(lam), data(by_accelerations), data(by_multipliers))
        return by_state, by_parameters, by_inputs, by_accelerations, by_multipliers

    def parameter_vector(self, p):
        """The parameters, given as for `rhs`, checked and copied; None for the defaults."""
        cdef cnp.ndarray values = self._parameters(p)
        return None if values is None else np.array(values)

    def default_inputs(self, t, p=None):
        """The inputs' expressions at one time, shape (n_r,); NaN for inputs without one."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray inputs = new_array(self.n_r)
        self.kernel.default_inputs(t, self._prepare(parameters), data(inputs))
        return inputs

    def breakpoints(self, p=None):
        """The times at which expressions have a jump or a kink, shape (n_breakpoints,)."""
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray times = new_array(self.kernel.n_breakpoints)
        self.kernel.breakpoints(self._prepare(parameters), data(times))
        return times

    def default_input_sensitivity(self, t, p=None):
        """The derivatives of the inputs' expressions with respect to parameters, shape (n_r, n_p); 0 without one."""
        t = time_of(t)
        cdef cnp.ndarray parameters = self._parameters(p)
        cdef cnp.ndarray result = new_array(self.n_r, self.n_p)
        cdef const fb_derivatives *derivatives = self.derivatives()
        derivatives.default_input_sensitivity(t, self._prepare(parameters), data(result))
        return result

    def along(self, times, states, inputs, p=None):
        """Position constraints, (n_h, n_t), J u + b, (n_c, n_t), energies, (2, n_t), multipliers, (n_c, n_t), and
        outputs, (n_o, n_t).

        States and inputs are given in columns. Multipliers and outputs are NaN where the accelerations cannot be
        evaluated.
        """
        cdef cnp.ndarray t = numbers(times, "The times")
        cdef cnp.ndarray x = rows(states, "The states")
        cdef cnp.ndarray r = rows(inputs, "The inputs")
        cdef cnp.ndarray parameters = self._parameters(p)
        self._check_columns(t, x, r)
        cdef int n_t = cnp.PyArray_DIM(t, 0)
        cdef cnp.ndarray constraints = new_array(n_t, self.n_h)
        cdef cnp.ndarray velocities = new_array(n_t, self.n_c)
        cdef cnp.ndarray positions = new_array(self.n_c + self.n_i)
        cdef cnp.ndarray energies = new_array(n_t, 2)
        cdef cnp.ndarray multipliers = np.full((n_t, self.n_l), NAN)
        cdef cnp.ndarray outputs = np.full((n_t, self.n_o), NAN)
        cdef cnp.ndarray jacobian = new_array(self.n_h, self.n_q)
        cdef cnp.ndarray accelerations = new_array(self.n_u)
        cdef const double *constants = self._prepare(parameters)
        cdef const double *x_i
        cdef const double *r_i
        cdef double *lambda_i
        cdef double t_i
        cdef int i
        for i in range(n_t):
            t_i, x_i, r_i = data(t)[i], data(x) + i * self.n_x, data(r) + i * self.n_r
            lambda_i = data(multipliers) + i * self.n_l
            self.kernel.position(t_i, x_i, constants, r_i, data(constraints) + i * self.n_h, data(jacobian))
            self.kernel.constraint_violation(t_i, x_i, constants, r_i, data(positions), data(velocities) + i * self.n_c)
            self.kernel.energy(t_i, x_i, constants, r_i, data(energies) + 2 * i)
            if self.kernel.accelerations(t_i, x_i, constants, r_i, data(accelerations), lambda_i, self.work) == FB_OK:
                self.kernel.output(t_i, x_i, constants, r_i, data(accelerations), lambda_i,
                                   data(outputs) + i * self.n_o)
        return constraints.T, velocities.T, energies.T, multipliers[:, :self.n_c].T, outputs.T


def dependent_changes(Evaluator evaluator not None, t, x, directions, int n_qd, int n_ud, p, r):
    """How dependent coordinates and speeds follow, see ``fourbar_follow.h``.

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
        What does not follow, "coordinates" or "speeds", or "".
    ndarray, shape (n_x + n_p + n_r, n)
        The directions with dependent rows filled.
    ndarray, shape (n_x,)
        The change of x by a step of Newton's method.
    float
        The least pivot, as a fraction of the largest.
    ndarray, shape (n + 1,)
        What redundant constraints do not follow, for each direction and for the step, relative to their entries.
    """
    t = time_of(t)
    cdef cnp.ndarray parameters = evaluator._parameters(p)
    cdef cnp.ndarray inputs = evaluator._inputs(t, parameters, r, evaluator.has_motions)
    cdef cnp.ndarray state = evaluator._state(t, x, evaluator.n_x), given = numbers(directions, "The directions")
    cdef cnp.ndarray correction = np.zeros(evaluator.n_x), followed = given.copy(), memory, left
    cdef const fb_variations *variations = evaluator.variations()
    cdef const double *constants = evaluator._prepare(parameters)
    cdef fb_follow f
    cdef int i, rows = evaluator.n_x + evaluator.n_p + evaluator.n_r, n_d = n_qd + n_ud, found
    f.n_qd, f.n_ud, f.n = n_qd, n_ud, cnp.PyArray_DIM(given, 1)
    memory = new_array(fb_place_follow(evaluator.kernel, &f, NULL))
    fb_place_follow(evaluator.kernel, &f, data(memory))
    for i in range(rows):
        memcpy(f.directions + i * (n_d + f.n) + n_d, data(given) + i * f.n, f.n * sizeof(double))
    found = fb_follow_at(
        evaluator.kernel, variations, t, data(state), constants, evaluator._fill(t, constants, inputs), &f)
    for i in range(rows):
        memcpy(data(followed) + i * f.n, f.directions + i * (n_d + f.n) + n_d, f.n * sizeof(double))
    memcpy(data(correction) + evaluator.n_q - n_qd, f.corrections, n_qd * sizeof(double))
    memcpy(data(correction) + evaluator.n_q + evaluator.n_u - n_ud, f.corrections + n_qd, n_ud * sizeof(double))
    left = new_array(f.n + 1)
    memcpy(data(left), f.left, (f.n + 1) * sizeof(double))
    return _FOLLOWS[found], followed, correction, f.pivot, left
