# cython: language_level=3
"""Declarations of integrator.pyx for other extension modules of the runtime."""

cimport numpy as cnp
from libc.stdint cimport int64_t

from fourbar_codegen.runtime.evaluator cimport Evaluator, fb_problem, fb_table

cdef extern from "kernel/breakpoints.h":
    ctypedef struct fb_breaks:
        int n
        const double *times
        const double *before
        const double *after
        double first, last

cdef extern from "steppers/tableaus.h":
    ctypedef struct fb_tableau:
        int n_stages
        const double *a
        const double *b
        const double *c
        int n_errors
        const double *error
        double order
        int n_extra, hermite, n_dense
    const fb_tableau fb_rk4, fb_trapezoid
    const fb_tableau *fb_tableaus[]


cdef extern from "run/run.h":
    ctypedef struct fb_event:
        int quantity, row, direction
        int64_t terminal
        int at_start, all_roots
        double touched


cdef int set_event(fb_event *event, row, int place) except -1
cdef const fb_tableau *tableau_of(str method) except NULL


cdef class Table:
    cdef readonly cnp.ndarray times
    cdef cnp.ndarray coefficients
    cdef fb_table table


cdef class Ode:
    cdef readonly Evaluator evaluator
    cdef fb_problem problem
    cdef readonly tuple sources
    cdef readonly bint has_tables
    cdef list callables
    cdef object error
    cdef readonly object parameters
    cdef public bint projects
    cdef public bint in_pieces
    cdef int _call(self, double t, const double *x) noexcept
    cdef int check(self, int status) except -2
