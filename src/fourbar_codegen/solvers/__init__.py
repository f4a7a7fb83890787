"""SciPy's integrators for a compiled right-hand side; see `fourbar_codegen.solvers.scipy_classes`."""

from fourbar_codegen.solvers.scipy_classes import BDF, CVODE, DOP853, IDA, LSODA, RK23, RK45, Radau

__all__ = ["BDF", "CVODE", "DOP853", "IDA", "LSODA", "RK23", "RK45", "Radau"]
