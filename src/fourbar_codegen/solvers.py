"""SciPy's integrators for a compiled right-hand side; see `fourbar_codegen.simulation.solvers`."""

from fourbar_codegen.simulation.solvers import BDF, CVODE, DOP853, IDA, LSODA, RK23, RK45, Radau

__all__ = ["BDF", "CVODE", "DOP853", "IDA", "LSODA", "RK23", "RK45", "Radau"]
