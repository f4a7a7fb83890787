"""A model of others against SymPy's own equations, and simulated with default settings.

``python -m ecosystem`` in the folder ``tests``, or ``make ecosystem``, writes the table of docs/ecosystem.md.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from measure import call, compare
from numpy.typing import NDArray
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from ecosystem.cases import Built, Case

Floats = NDArray[np.float64]

SPAN = 2.0
CLOSED = 1e-10
ROUNDING = 1e-13
"""Rounding errors of x' as a share of the largest rate: mass matrices have conditions up to 1e3."""
CONTRADICTION = 1e-3
"""And what a contradiction makes of it is no matter of digits."""
MANY = 2000
ROUNDS = 3


@dataclass(frozen=True)
class Found:
    """What was found of a model.

    Attributes
    ----------
    n_q, n_u, n_constraints : int
    operations : int
        Of the right-hand side.
    compile_time, reference_time : float
        From the System to the first x', s, by this package and by SymPy's equations and lambdify.
    error : float
        The largest difference of x' at a consistent state, as a share of the largest rate.
    ratio : float
        How many times longer SymPy's function takes for an evaluation than the compiled one for one of many in C.
    residual : float
        The largest violation of a constraint in a run of 2 s.
    message : str
        The run's, if it did not succeed.
    warned : tuple of str
    """

    n_q: int
    n_u: int
    n_constraints: int
    operations: int
    compile_time: float
    reference_time: float
    error: float
    ratio: float
    residual: float
    message: str
    warned: tuple[str, ...]

    def disagreement(self, case: Case) -> str:
        """What is not as it should be, or nothing."""
        if bool(self.warned) != bool(case.warned):
            return f"warned of: {' '.join(self.warned) or 'nothing'}"
        if self.message:
            return self.message
        if not self.residual < CLOSED:
            return f"constraints are violated by {self.residual:.1e}"
        is_right = self.error > CONTRADICTION if case.warned else self.error < ROUNDING
        return f"differs from SymPy's equations by {self.error:.1e}" if case.is_compared and not is_right else ""


def compiled(case: Case, built: Built) -> tuple[fb.CompiledModel, tuple[str, ...]]:
    """The model as its user would have it, all symbols without a value being 1, and what is warned of."""
    values = {symbol: value for symbol, value in built.values.items() if isinstance(symbol, sm.Symbol)}
    first = fb.Model(built.system, name="others", parameters=values, inputs="auto", extra="ignore")
    values |= {s: 1.0 for s, parameter in first.parameter_symbols.items() if parameter.value is None}
    model = fb.Model(built.system, name="others", parameters=values, inputs="auto", extra="ignore")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made = fb.compile_model(model)
    return made, tuple(str(w.message) for w in caught if issubclass(w.category, fb.ModelWarning))


def begin(model: fb.CompiledModel, built: Built) -> Floats:
    """A consistent state."""
    generator = np.random.default_rng(4)
    given = {str(function.func): value for function, value in built.begin.items()}
    n_q = model.n_q - model.manifest["n_dependent_coordinates"]
    n_u = model.n_u - model.manifest["n_dependent_speeds"]
    q = {name: given.get(name, generator.uniform(0.05, 0.2)) for name in model.coordinates[:n_q]}
    u = {name: given.get(name, generator.uniform(0.05, 0.2)) for name in model.speeds[:n_u]}
    guess = {name: given[name] for name in model.coordinates[n_q:] if name in given}
    return model.initial_state(q, u, guess=guess)


def reference(system: System | me.KanesMethod, model: fb.CompiledModel) -> Callable[[Floats], Floats]:
    """X' by SymPy's own equations: form_eoms or kanes_equations, lambdify with cse, and NumPy's solve."""
    if isinstance(system, System):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            system.form_eoms(constraint_solver="CRAMER")
        kane = system.eom_method
    else:
        kane = system
        kane.kanes_equations(kane.bodies, kane.forcelist)
    states = [*kane.q, *kane.u]
    matrix, forcing = kane.mass_matrix_full, kane.forcing_full
    rates_of_states = [s.diff(me.dynamicsymbols._t) for s in states]
    functions = me.find_dynamicsymbols(forcing) - {*states, *rates_of_states}
    driving = model.outputs[: model.n_l - model.n_c]
    unknown = sorted((f for f in functions if str(f.func) in driving), key=str)
    if unknown:  # with their own equations, linear in x' and in them
        equations = [*(matrix * sm.Matrix(rates_of_states) - forcing), *kane.auxiliary_eqs]
        matrix = sm.Matrix(equations).jacobian([*rates_of_states, *unknown])
        forcing = -me.msubs(sm.Matrix(equations), dict.fromkeys([*rates_of_states, *unknown], 0))
    zero = dict.fromkeys((f for f in functions if f not in unknown), 0)
    matrix, forcing = me.msubs(matrix, zero), me.msubs(forcing, zero)
    values = {entry["name"]: entry["default"] for entry in model.manifest["parameters"]}
    symbols = [s for s in (matrix.free_symbols | forcing.free_symbols) if s.name in values]
    others = {s: 1.0 for s in (matrix.free_symbols | forcing.free_symbols) if s.name not in values}
    stand_ins = {state: sm.Dummy() for state in states}
    expressions = [me.msubs(e, stand_ins).xreplace(others) for e in (matrix, forcing)]
    function = sm.lambdify([[*stand_ins.values()], symbols], expressions, cse=True)
    p = [values[s.name] for s in symbols]
    order = [model.states.index(str(state.func)) for state in states]

    def rates(x: Floats) -> Floats:
        a, b = function(x[order], p)
        result = np.empty(len(order))
        solution = np.linalg.solve(np.asarray(a, dtype=float), np.asarray(b, dtype=float).ravel())
        result[order] = solution[: len(order)]
        return result

    return rates


def times_faster(model: fb.CompiledModel, rates: Callable[[Floats], Floats], x: Floats) -> float:
    """SymPy's time for an evaluation by that of a compiled one, of many states in C on one core; both in turn."""
    states = np.repeat(x[:, np.newaxis], MANY, axis=1)
    ours = call(partial(model.rhs_batch, 0.0, states, workers=1))
    before, after = compare(call(rates, x), ours, rounds=ROUNDS)
    return MANY * before / after


def refusal(case: Case) -> str:
    """The sentence that a case is refused with, when it is compiled or at its beginning; or nothing."""
    built = case.build()
    try:
        model, _ = compiled(case, built)
        model.rhs(0.0, begin(model, built))
    except fb.FourbarError as error:
        return str(error)
    return ""


def run(case: Case, *, is_timed: bool = False) -> Found:
    """Compile a case, compare it, and simulate it; and say how many times faster it is evaluated, if asked."""
    built = case.build()
    start = time.perf_counter()
    model, warned = compiled(case, built)
    x0 = begin(model, built)
    ours = model.rhs(0.0, x0)
    compile_time = time.perf_counter() - start
    built = case.build()  # as nobody has touched it
    trajectory = model.simulate((0.0, SPAN), x0)
    error = ratio = reference_time = float("nan")
    if case.is_compared:
        start = time.perf_counter()
        rates = reference(built.system, model)
        theirs = rates(x0)
        reference_time = time.perf_counter() - start
        error = float(np.abs(theirs - ours).max() / np.abs(ours).max())
        ratio = times_faster(model, rates, x0) if is_timed else ratio
    return Found(
        model.n_q, model.n_u, model.n_c + model.kernel.n_i, model.manifest["operations"]["dynamics"], compile_time,
        reference_time, error, ratio, float(np.abs(trajectory.constraint_residual).max(initial=0.0)),
        "" if trajectory.success else trajectory.message, warned,
    )  # fmt: skip
