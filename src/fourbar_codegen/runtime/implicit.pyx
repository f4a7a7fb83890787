# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True
"""Functions for implicit solvers: see ``derivatives/implicit_residual.h``. Solvers call them often, with contiguous
arrays of double of the right length, so nothing is checked or allocated."""

cimport cython
cimport numpy as cnp

from fourbar_codegen.runtime.evaluator cimport FB_STATE_PARTIALS, fb_problem, fb_problem_jacobian, fb_problem_rates
from fourbar_codegen.runtime.integrator cimport Ode

import numpy as np

cnp.import_array()

cdef extern from "derivatives/implicit_residual.h":
    int FB_INDEX_1
    int FB_INDEX_2
    int FB_INDEX_3
    ctypedef struct fb_implicit:
        int n_y
    size_t fb_place_implicit(fb_problem *, int, fb_implicit *, double *) noexcept nogil
    int fb_implicit_residual(fb_implicit *, double, const double *, const double *, double *) noexcept nogil
    int fb_implicit_scale(fb_implicit *, double, double, const double *, const double *, const double *,
                          const double *, double *) noexcept nogil
    int fb_implicit_jacobian(fb_implicit *, double, double, const double *, const double *, double *) noexcept nogil

_FORMULATIONS = {"index-1": FB_INDEX_1, "gear-gupta-leimkuhler": FB_INDEX_2, "index-3": FB_INDEX_3}
FORMULATIONS = tuple(_FORMULATIONS)


cdef inline double *_at(cnp.ndarray array) noexcept:
    return <double *>cnp.PyArray_DATA(array)


@cython.final
cdef class Rates:
    """The right-hand side for a solver of x' = f(t, x) that provides the arrays to fill.

    Parameters
    ----------
    ode : Ode
    """

    cdef Ode ode

    def __cinit__(self, Ode ode not None):
        self.ode = ode

    def evaluate(self, double t, cnp.ndarray x, cnp.ndarray rates):
        """x' at (t, x)."""
        self.ode.check(fb_problem_rates(&self.ode.problem, t, _at(x), _at(rates)))

    def jacobian(self, double t, cnp.ndarray x, rates, cnp.ndarray matrix):
        """dx'/dx, (n_x, n_x)."""
        self.ode.evaluator.function(FB_STATE_PARTIALS)
        self.ode.check(fb_problem_jacobian(
            &self.ode.problem, self.ode.evaluator.functions, t, _at(x), _at(matrix)))


@cython.final
cdef class Residual:
    """F of the differential-algebraic equations F(t, y, y') = 0.

    Parameters
    ----------
    ode : Ode
    formulation : {"index-1", "gear-gupta-leimkuhler", "index-3"}

    Attributes
    ----------
    n_y : int
        Length of y: the state, then the multipliers.
    """

    cdef Ode ode
    cdef fb_implicit implicit
    cdef object memory

    def __cinit__(self, Ode ode not None, str formulation):
        cdef int chosen = _FORMULATIONS[formulation]
        ode.evaluator.function(FB_STATE_PARTIALS)
        self.ode = ode
        self.memory = np.zeros(fb_place_implicit(&ode.problem, chosen, &self.implicit, NULL))
        fb_place_implicit(&ode.problem, chosen, &self.implicit, _at(self.memory))

    def scale(self, double t, double c, cnp.ndarray y, cnp.ndarray y_rate, cnp.ndarray weights, cnp.ndarray metric):
        """Scale each equation, for y' = c y and weights of the states at the beginning, and set the diagonal of D."""
        matrix = np.empty((self.implicit.n_y, self.implicit.n_y))
        self.ode.check(fb_implicit_scale(&self.implicit, t, c, _at(y), _at(y_rate), _at(weights), _at(metric),
                                         _at(matrix)))

    @property
    def n_y(self):
        return self.implicit.n_y

    def evaluate(self, double t, cnp.ndarray y, cnp.ndarray y_rate, cnp.ndarray residual):
        """F(t, y, y')."""
        self.ode.check(fb_implicit_residual(&self.implicit, t, _at(y), _at(y_rate), _at(residual)))

    def jacobian(self, double t, cnp.ndarray y, cnp.ndarray y_rate, residual, double c, cnp.ndarray matrix):
        """dF/dy + c dF/dy', (n_y, n_y)."""
        self.ode.check(fb_implicit_jacobian(&self.implicit, t, c, _at(y), _at(y_rate), _at(matrix)))
