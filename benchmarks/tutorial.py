"""What the SymBRiM tutorial does with SymPy and SciPy alone: the reference for tests and benchmarks.

Equations by ``System.form_eoms``, functions by ``lambdify`` with ``cse=True``, u' by ``numpy.linalg.solve``,
initial conditions by ``fsolve`` with differenced Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from numpy.typing import NDArray
from scipy.optimize import fsolve

Floats = NDArray[np.float64]


class Tutorial:
    """A System's functions as the tutorial makes them.

    Parameters
    ----------
    system : System
    parameters : dict of Symbol to float
    inputs : dict of function of time to callable of time
    """

    def __init__(self, system: Any, parameters: dict[Any, float], inputs: dict[Any, Callable[[float], float]]) -> None:
        self.system = system
        system.form_eoms(constraint_solver="CRAMER")
        self.p = tuple(parameters)
        self.p_values = tuple(parameters.values())
        self.r = tuple(inputs)
        self.r_functions = tuple(inputs.values())
        self.x = system.q.col_join(system.u)
        self.t = me.dynamicsymbols._t
        self.evaluate = sm.lambdify(
            (self.x, self.p, self.r, self.t), (system.mass_matrix_full, system.forcing_full), cse=True
        )

    def inputs(self, t: float) -> list[float]:
        return [function(t) for function in self.r_functions]

    def rhs(self, t: float, x: Floats) -> Floats:
        mass_matrix, forcing = self.evaluate(x, self.p_values, self.inputs(t), t)
        return np.linalg.solve(mass_matrix, forcing).ravel()

    def initial_state(self, q_ind: list[float], u_ind: list[float], q_dep: list[float], u_dep: list[float]) -> Floats:
        system, p = self.system, self.p
        positions = sm.lambdify((system.q_dep, system.q_ind, p), system.holonomic_constraints[:], cse=True)
        q = [*q_ind, *fsolve(positions, q_dep, args=(q_ind, self.p_values))]
        rates = system.holonomic_constraints.diff(self.t).col_join(system.nonholonomic_constraints)
        rates = rates.xreplace(system.eom_method.kindiffdict())
        velocities = sm.lambdify((system.u_dep, system.u_ind, system.q, p), rates[:], cse=True)
        return np.array([*q, *u_ind, *fsolve(velocities, u_dep, args=(u_ind, q, self.p_values))])


def tutorial_four_bar() -> Tutorial:
    """The tutorial's four-bar, with its numbers."""
    import fourbar_codegen as fb

    model = fb.models.four_bar()
    parameters = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    force = next(iter(model.input_expressions))
    return Tutorial(model.system, parameters, {force: lambda t: 100 * np.sin(np.pi * t)})
