# cython: language_level=3
"""What other extension modules of the runtime need of integrator.pyx."""

cimport numpy as cnp

from fourbar_codegen.runtime.evaluator cimport fb_table

cdef extern from "fourbar_tableau.h":
    ctypedef struct fb_tableau:
        int n_stages
        const double *a
        const double *b
        const double *c
        int n_errors
        const double *error
        double order
        int n_more, n_dense
    const fb_tableau fb_rk4, fb_rk45, fb_dop853


cdef class Table:
    cdef cnp.ndarray times
    cdef cnp.ndarray coefficients
    cdef fb_table table
