"""SymBRiM's tutorial run: a bicycle that is pushed for 2.5 s while its rider steers, both given as callables.

Beside it what the tutorial's Simulator does: the mass matrix and the forcing of `form_eoms`, lambdified with cse,
solved by NumPy in the right-hand side of SciPy's solve_ivp.
"""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import sympy as sm
from measure import compare, timed
from scipy.integrate import solve_ivp
from tutorial import Tutorial

import fourbar_codegen as fb
from ecosystem.cases import whipple_bicycle

TIMES = np.arange(0.0, 2.5, 0.01)
TIGHT = {"rtol": 1e-10, "atol": 1e-10}
ROUNDS = 5


def push(t, _):
    """A growing push from side to side, N."""
    return (30.0 + 30.0 * t) * np.sin(2.0 * np.pi * t)


def steering(place):
    """A torque against the rate of lean, at most 10 N m."""
    return lambda _, x: -10.0 * max(-1.0, min(x[place] / 0.2, 1.0))


def main() -> str:
    """Both runs in turn; a sentence for the page."""
    built = whipple_bicycle(ridden=True)()
    system, values = built.system, {k: v for k, v in built.values.items() if isinstance(k, sm.Symbol)}
    model = fb.Model(system, name="ridden", parameters=values, inputs="auto", extra="ignore")
    bicycle = fb.compile_model(model)
    names = [str(x.func) for x in (*system.q, *system.u)]
    lean_rate = "bike_u4"
    start = {str(f.func): value for f, value in built.begin.items()} | {"bike_u4": 0.0, "bike_u6": -10.0}
    x0 = bicycle.initial_state(
        {name: start[name] for name in bicycle.coordinates[:7]}, {name: start[name] for name in bicycle.speeds[:3]},
        guess={"bike_q5": 0.3}, inputs={"disturbance": 0.0, "steer_torque": 0.0},
    )  # fmt: skip
    inputs = {"disturbance": push, "steer_torque": steering(bicycle.states.index(lean_rate))}

    callables = {"disturbance": push, "steer_torque": steering(names.index(lean_rate))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tutorial = Tutorial(system, values, {f: callables[str(f.func)] for f in model.input_expressions})

    def rates(t, x):
        inputs = [call(t, x) for call in tutorial.r_functions]
        return np.linalg.solve(*tutorial.evaluate(x, tutorial.p_values, inputs, t)).ravel()

    begin = x0[[bicycle.states.index(name) for name in names]]
    span = (0.0, float(TIMES[-1]))
    theirs = partial(solve_ivp, rates, span, begin, t_eval=TIMES, **TIGHT)
    ours = partial(bicycle.simulate, span, x0, inputs=inputs, t_eval=TIMES, **TIGHT)
    reference, run = theirs(), ours()
    before, after = compare(lambda: timed(theirs), lambda: timed(ours), rounds=ROUNDS)
    difference = np.abs(np.array([run[name] for name in names]) - reference.y).max()
    violation = np.abs(run.constraint_residual).max()
    return (
        "The simulation of SymBRiM's tutorial (2.5 s, push and steering torque as callables, tolerances of 1e-10 in "
        f"both cases) takes {before * 1e3:.0f} ms with `solve_ivp` and `lambdify`, as in its Simulator, and "
        f"{after * 1e3:.2f} ms with `simulate`, {before / after:.0f} times less. The states differ by at most "
        f"{difference:.0e}; the constraint violation is at most {violation:.0e}."
    )
