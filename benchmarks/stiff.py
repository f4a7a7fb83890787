"""Stiff cases at equal final error: Radau in C beside SciPy's Radau, BDF and LSODA, and CVODE and IDA of SUNDIALS.

Those of SciPy are called by solve_ivp with the compiled Jacobian, without what simulate adds.

Each method runs with tolerances from coarse to fine; its time for an error is the shortest one of a run whose error is
at most this. Errors are the largest of a state at the end, relative to its value there for equations with published
values, or to its largest value in the run for mechanisms.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from measure import DOCS, PROJECT, call, circumstances, options_of, publish
from scipy.integrate import solve_ivp
from sympy.physics.biomechanics import FirstOrderActivationDeGroote2016, MusculotendonDeGroote2016

import fourbar_codegen as fb

sys.path += [str(PROJECT / "examples"), str(PROJECT / "tests")]
driven_four_bar = import_module("08_stiff_drive").driven_four_bar
on_a_line = import_module("builders.oscillators").on_a_line
problems = import_module("builders.state_equations")
squeezer = import_module("builders.squeezer")
first_order = problems.first_order

ERRORS = (1e-4, 1e-6, 1e-8)
TOLERANCES = [10.0**-k for k in range(3, 13)]
MOST_SECONDS = 0.5
"""Of a run; those with finer tolerances are left out."""


@dataclass(frozen=True)
class Case:
    """A model and a run, with states at its end that are published."""

    model: fb.CompiledModel
    span: tuple[float, float]
    x0: Any = None
    inputs: Any = None
    expected: dict[int, float] | None = None


def van_der_pol() -> Case:
    """E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, IV.10: y(2) as published with the test set."""
    model = first_order("van_der_pol", problems.van_der_pol, [2.0, 0.0])
    return Case(fb.compile_model(model), (0.0, 2.0), expected={2: 1.706167732170483, 3: -0.892809701024795})


def hires() -> Case:
    """The same book's problem HIRES."""
    model = first_order("hires", problems.hires, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057])
    expected = {2: 0.7371312573325668e-3, 9: 0.2850001604978180e-2}
    return Case(fb.compile_model(model), (0.0, 321.8122), expected=expected)


def robertson(end: float, *values: float) -> Case:
    """H. H. Robertson's reactions (1966)."""
    model = first_order("robertson", problems.robertson, [1.0, 0.0, 0.0])
    return Case(fb.compile_model(model), (0.0, end), expected=dict(enumerate(values, 2)))


def stiff_drive() -> Case:
    """examples/08_stiff_drive.py."""
    return Case(fb.compile_model(driven_four_bar()), (0.0, 4.0))


def muscle() -> Case:
    """The weight of docs/howto/state_equations.md."""
    v, (m, g, d) = me.dynamicsymbols("v"), sm.symbols("m g d")
    system = on_a_line(m, m * g - d * v)
    activation = FirstOrderActivationDeGroote2016.with_defaults("biceps")
    pathway = me.LinearPathway(system.fixed_point, system.bodies[0].masscenter)
    biceps = MusculotendonDeGroote2016.with_defaults("biceps", pathway, activation)
    system.add_actuators(biceps)
    values = {m: 20.0, g: 9.81, d: 50.0, biceps.l_T_slack: 0.2, biceps.F_M_max: 1000.0, biceps.l_M_opt: 0.15}
    model = fb.compile_model(fb.Model(system, name="lift", parameters=values))
    excitation = ([0.0, 0.1, 0.11, 0.5], [0.4, 0.4, 0.8, 0.8])
    return Case(model, (0.0, 0.5), [0.34, 0.0, 0.4], {"e_biceps": excitation})


def bounces() -> Case:
    """1 kg falls from 10 m on a spring of 1e7 N/m with a damper of 1e3 N s/m, twice."""
    x, v = me.dynamicsymbols("x v")
    contact = sm.Piecewise((-1e7 * x - 1e3 * v, x < 0), (0, True))
    model = fb.Model(on_a_line(1, contact - sm.Float(9.81)), name="bounces", initial={x: 10.0, v: 0.0})
    return Case(fb.compile_model(model), (0.0, 5.0))


def motor() -> Case:
    """A DC motor, L/R = 1e-5 s, that turns the slider-crank."""
    given = fb.models.slider_crank()
    system, (torque, load) = given.system, me.dynamicsymbols("torque load")
    current, voltage = me.dynamicsymbols("current voltage")
    system.add_loads(me.Torque(system.bodies[0].frame, 0.5 * current * system.frame.z))
    rate = (voltage - current - 0.5 * system.u[0]) / 1e-5
    model = fb.Model(
        system, name="motor_crank", parameters=given.parameters, initial={**given.initial, current: 0.0},
        inputs={torque: 0.0, load: 0.0, voltage: 12.0}, state_equations={current: rate},
    )  # fmt: skip
    return Case(fb.compile_model(model), (0.0, 1.0))


def control() -> Case:
    """Andrews' squeezing mechanism, which is not stiff."""
    return Case(fb.compile_model(squeezer.squeezer()), (0.0, squeezer.END))


CASES: dict[str, Callable[[], Case]] = {
    "stiff drive (examples/08)": stiff_drive,
    "muscle": muscle,
    "two bounces": bounces,
    "van der Pol, 1e-6": van_der_pol,
    "HIRES": hires,
    "Robertson to 40": lambda: robertson(40.0, 0.7158270688, 9.185534765e-6, 0.2841637457),
    "Robertson to 4e10": lambda: robertson(4e10),
    "DC motor on a slider-crank": motor,
    "Andrews' squeezer (not stiff)": control,
}
SCIPYS = {"SciPy's Radau": fb.solvers.Radau, "BDF": fb.solvers.BDF, "LSODA": fb.solvers.LSODA}
METHODS = ("Radau", *SCIPYS, "CVODE", "IDA")
EXPLICIT = "DOP853"
"""Not for stiff equations: for comparison."""


def run_of(case: Case, method: str, x0: Any, rtol: float, atol: Any) -> Callable[[], Any]:
    """A run by a method."""
    if method in SCIPYS:
        ode = case.model.ode(inputs=case.inputs)
        how = {"method": SCIPYS[method], "jac": ode.jac, "rtol": max(rtol, 3e-14), "atol": atol}
        return lambda: solve_ivp(ode, case.span, x0, **how)
    given = {"inputs": case.inputs, "rtol": rtol, "atol": atol, "t_eval": case.span, "method": method}
    return lambda: case.model.simulate(case.span, x0, max_steps=10**7, **given)


def measured(case: Case, rounds: int) -> dict[str, list[float | None]]:
    """For each method its times for the errors; None where no tolerance gives one."""
    x0 = case.model.initial_state() if case.x0 is None else np.asarray(case.x0)
    exact = case.model.simulate(case.span, x0, inputs=case.inputs, method="Radau", rtol=1e-11, atol=1e-14)
    assert exact.success, exact.message
    end = exact.y[:, -1]
    sizes = np.abs(exact.y).max(axis=1) if case.expected is None else np.abs(end)
    sizes[sizes == 0.0] = 1.0
    for i, value in (case.expected or {}).items():
        assert abs(end[i] - value) < 1e-7 * abs(value), (i, end[i], value)
    found: dict[str, list[float | None]] = {}
    for method in (*METHODS, EXPLICIT):
        best: dict[float, float] = {}
        for tolerance in TOLERANCES:
            run = run_of(case, method, x0, tolerance, tolerance * sizes)
            try:
                begin = time.perf_counter()
                result = run()
                once = time.perf_counter() - begin
            except fb.FourbarError:
                continue
            error = float(np.max(np.abs(result.y[:, -1] - end) / sizes)) if result.success else np.inf
            if any(error <= target and once < 2.0 * best.get(target, np.inf) for target in ERRORS):
                measure = call(run)
                seconds = min(measure() for _ in range(1 if once > 0.1 else rounds))
                for target in ERRORS:
                    if error <= target:
                        best[target] = min(seconds, best.get(target, np.inf))
            if once > MOST_SECONDS:
                break
        found[method] = [best.get(target) for target in ERRORS]
    return found


def main() -> None:
    options = options_of(__doc__)
    lines = [f"| | error | {' | '.join(METHODS)} | ratio | {EXPLICIT} |"]
    lines.append(f"|---|---:|{'---:|' * len(METHODS)}---:|---:|")
    report: dict[str, Any] = {}
    for name, make in CASES.items():
        report[name] = found = measured(make(), options.rounds)
        for k, error in enumerate(ERRORS):
            times = [found[method][k] for method in METHODS]
            others = [time for time in times[1:] if time is not None]
            ratio = f"{min(others) / times[0]:.2g}" if others and times[0] else ""
            *cells, explicit = [f"{1e3 * time:.3g} ms" if time else "" for time in (*times, found[EXPLICIT][k])]
            row = [name if k == 0 else "", f"{error:.0e}", *cells, ratio, explicit]
            lines.append(f"| {' | '.join(row)} |")
            print(lines[-1], flush=True)
    circumstance = circumstances(["scikit-sundae"])
    publish(options, "stiff", "\n".join(lines), {**circumstance, "seconds": report}, DOCS / "methods.md")


if __name__ == "__main__":
    main()
