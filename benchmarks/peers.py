"""Simulation of the tutorial's four-bar linkage with this package and with others, by interleaved measurements.

One evaluation from Python, a batch of 4096 states, one simulation of 4 s, and many with different parameters; computing
time of each integrator against its error, from a reference at 1e-13. For the time of a first simulation, see cold.py.
Packages that are not installed are skipped with a message: ``pip install 'fourbar_codegen[bench]'``.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import os
import tempfile
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sm
from measure import (
    COLORS,
    DOCS,
    call,
    circumstances,
    compare,
    evaluation,
    name_curves,
    replace_in_page,
    save_figure,
)
from scipy.integrate import solve_ivp
from tutorial import Floats, Tutorial, tutorial_four_bar

import fourbar_codegen as fb

BATCH = 4096
END = 4.0
TOLERANCES = [10.0**-k for k in range(3, 14)]
TIGHTEST = {"heyoka, Taylor": 2.3e-16}
"""Tolerances below the last one, where an integrator accepts them."""
MODULES = {
    "heyoka": "heyoka",
    "numba": "numba",
    "CasADi": "casadi",
    "scikit-sundae": "sksundae",
    "JiTCODE": "jitcode",
    "PyDy": "pydy",
}

Simulation = Callable[[float], Floats]
"""The state at the end, for a tolerance."""


def explicit(
    tutorial: Tutorial, functions: Any, x: Sequence[Any], p: Sequence[Any], r: Sequence[Any], t: Any
) -> list[Any]:
    """x' in another package's symbols: the tutorial's matrices, solved by elimination."""
    system = tutorial.system
    arguments = tutorial.x, tutorial.p, tutorial.r, tutorial.t
    evaluate = sm.lambdify(arguments, [*system.mass_matrix, *system.forcing], modules=[functions], cse=True)
    values = evaluate(x, p, r, t)
    matrix, rest = values[: len(system.mass_matrix)], values[len(system.mass_matrix) :]
    n = len(rest)
    rows = [[*matrix[i * n : i * n + n], rest[i]] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    solution: list[Any] = [None] * n
    for k in reversed(range(n)):
        known = sum((rows[k][j] * solution[j] for j in range(k + 1, n)), start=0.0 * rows[k][n])
        solution[k] = (rows[k][n] - known) / rows[k][k]
    return [*x[n:], *solution]


def aligned(array: Floats) -> Floats:
    """A copy that begins where vectors of 64 bytes do not lie across two lines of the cache: by chance, otherwise."""
    memory = np.empty(array.size + 8)
    begin = -memory.ctypes.data // 8 % 8
    copy = memory[begin : begin + array.size].reshape(array.shape)
    copy[...] = array
    return copy


class Case:
    """The tutorial's case: 100 sin(pi t) at the coupler, parameters as it has them."""

    def __init__(self) -> None:
        self.tutorial = tutorial_four_bar()
        self.x0 = self.tutorial.initial_state([-0.5], [-0.1], [-1.5, -1.5], [0.5, -0.5])
        self.p = np.array([float(value) for value in self.tutorial.p_values])
        self.times = aligned(np.full(BATCH, 0.5))
        self.each_p = aligned(np.repeat(self.p[:, np.newaxis], BATCH, axis=1))

    @functools.cached_property
    def four_bar(self) -> fb.CompiledModel:
        return fb.compile_model(fb.models.four_bar())

    @functools.cached_property
    def states(self) -> Floats:
        """States of the case's own motion, and 10 % about them."""
        path = self.four_bar.simulate((0.0, END), self.x0, t_eval=np.linspace(0.0, END, BATCH)).y
        return aligned(path * np.random.default_rng(1).uniform(0.9, 1.1, path.shape))

    @functools.cached_property
    def stiffness(self) -> Floats:
        return self.p[self.four_bar.parameters.index("k")] * np.random.default_rng(2).uniform(0.9, 1.1, 10_000)


def heyoka_system(case: Case, *, literal: bool) -> tuple[list[Any], list[Any]]:
    import heyoka as hy

    x = list(hy.make_vars("q1", "q2", "q3", "u1", "u2", "u3"))
    p = [hy.expression(value) if literal else hy.par[i] for i, value in enumerate(case.p)]
    return x, explicit(case.tutorial, {"sin": hy.sin, "cos": hy.cos}, x, p, [100.0 * hy.sin(np.pi * hy.time)], hy.time)


def by_heyoka(case: Case) -> dict[str, Any]:
    import heyoka as hy

    found: dict[str, Any] = {}

    @functools.cache
    def function(literal: bool) -> Any:
        x, rates = heyoka_system(case, literal=literal)
        return hy.cfunc(rates, vars=x)

    def one(literal: bool) -> Callable[[], float]:
        how = {"outputs": np.empty(6)} | ({} if literal else {"pars": case.p})
        return evaluation(lambda t, x: function(literal)(x, time=t, **how), case.x0, 2000)

    def many(literal: bool) -> Callable[[], float]:
        how = {"outputs": aligned(np.empty((6, BATCH)))} | ({} if literal else {"pars": case.each_p})
        return call(lambda: function(literal)(case.states, time=case.times, **how))

    for literal in (False, True):
        word = "heyoka, numbers in the code" if literal else "heyoka"
        found[f"one: {word}"] = functools.partial(one, literal)
        found[f"batch: {word}"] = functools.partial(many, literal)
    x, rates = heyoka_system(case, literal=False)
    system = list(zip(x, rates, strict=True))

    @functools.cache
    def integrator(tolerance: float) -> Any:
        return hy.taylor_adaptive(system, state=case.x0, pars=case.p, tol=tolerance, time=0.0)

    def simulate(tolerance: float) -> Floats:
        run = integrator(tolerance)
        run.time = 0.0
        run.state[:] = case.x0
        run.propagate_until(END)
        return np.array(run.state)

    found["simulate: heyoka, Taylor"] = simulate
    size = hy.recommended_simd_size()

    @functools.cache
    def batch(tolerance: float) -> Any:
        state = np.repeat(case.x0[:, np.newaxis], size, axis=1)
        pars = np.repeat(case.p[:, np.newaxis], size, axis=1)
        return hy.taylor_adaptive_batch(system, state=state, pars=pars, tol=tolerance)

    def ensemble(tolerance: float, stiffness: Floats) -> Floats:
        run, ends = batch(tolerance), np.empty((len(stiffness), 6))
        place = [symbol.name for symbol in case.tutorial.p].index("k")
        for begin in range(0, len(stiffness), size):
            run.set_time(0.0)
            run.state[:] = case.x0[:, np.newaxis]
            run.pars[place] = np.resize(stiffness[begin : begin + size], size)
            run.propagate_until(END)
            ends[begin : begin + size] = run.state.T[: len(ends) - begin]
        return ends

    found[f"ensemble: heyoka, batches of {size}"] = ensemble
    return found


def by_numba(case: Case) -> dict[str, Any]:
    import numba

    tutorial = case.tutorial
    system, p = tutorial.system, tuple(case.p)
    # A list of numbers of one type, as numba needs it.
    entries = [sm.Float(e) if e.is_number else e for e in (*system.mass_matrix, *system.forcing)]
    evaluate = numba.njit(sm.lambdify((tutorial.x, tutorial.p, tutorial.r, tutorial.t), entries, cse=True))

    @numba.njit
    def rhs(t: float, x: Floats) -> Floats:
        values = np.array(evaluate(x, p, (100.0 * np.sin(np.pi * t),), t))
        rates = np.empty(6)
        rates[:3] = x[3:]
        rates[3:] = np.linalg.solve(values[:9].reshape(3, 3), values[9:])
        return rates

    rhs(0.0, case.x0)
    return {
        "one: numba": lambda: evaluation(rhs, case.x0, 2000),
        "simulate: numba, solve_ivp DOP853": by_scipy(rhs, case),
    }


def by_scipy(function: Callable[[float, Floats], Floats], case: Case, method: Any = "DOP853") -> Simulation:
    return lambda tolerance: solve_ivp(
        function, (0.0, END), case.x0, method=method, rtol=max(tolerance, 1e-13), atol=tolerance
    ).y[:, -1]


def by_pydy(case: Case) -> dict[str, Any]:
    from pydy.codegen.ode_function_generators import generate_ode_function

    system = case.tutorial.system
    (force,) = case.tutorial.r

    @functools.cache
    def function(generator: str) -> Any:
        return generate_ode_function(
            system.forcing_full, system.q[:], system.u[:], list(case.tutorial.p), mass_matrix=system.mass_matrix_full,
            specifieds=[force], generator=generator, constants_arg_type="array", specifieds_arg_type="array",
        )  # fmt: skip

    def rhs(generator: str, t: float, x: Floats) -> Floats:
        return function(generator)(x, t, np.array([100.0 * np.sin(np.pi * t)]), case.p)

    found = {}
    for generator in ("lambdify", "cython"):
        of_generator = functools.partial(rhs, generator)
        found[f"one: PyDy, {generator}"] = functools.partial(evaluation, of_generator, case.x0, 500)
        found[f"simulate: PyDy, {generator}, solve_ivp DOP853"] = by_scipy(of_generator, case)
    return found


def by_casadi(case: Case) -> dict[str, Any]:
    import casadi as ca

    x, t = ca.SX.sym("x", 6), ca.SX.sym("t")
    rates = explicit(
        case.tutorial, {"sin": ca.sin, "cos": ca.cos}, ca.vertsplit(x), list(case.p), [100.0 * ca.sin(np.pi * t)], t
    )
    function = ca.Function("f", [x, t], [ca.vertcat(*rates)])

    @functools.cache
    def integrator(tolerance: float) -> Any:
        problem = {"x": x, "t": t, "ode": ca.vertcat(*rates)}
        options = {"reltol": max(tolerance, 1e-14), "abstol": tolerance, "max_num_steps": 1_000_000}
        return ca.integrator("F", "cvodes", problem, 0.0, END, options)

    return {
        "one: CasADi": lambda: evaluation(lambda t, y: function(y, t), case.x0, 500),
        "simulate: CasADi, CVODES": lambda tolerance: np.array(integrator(tolerance)(x0=case.x0)["xf"])[:, 0],
    }


def by_sundae(case: Case) -> dict[str, Any]:
    from sksundae.cvode import CVODE

    ode = case.four_bar.ode()

    def rates(t: float, y: Floats, yp: Floats) -> None:
        yp[:] = ode(t, y)

    def simulate(tolerance: float) -> Floats:
        solver = CVODE(rates, method="Adams", rtol=max(tolerance, 1e-13), atol=tolerance, max_num_steps=1_000_000)
        return np.asarray(solver.solve(np.array([0.0, END]), case.x0).y)[-1]

    return {"simulate: scikit-sundae, CVODE Adams on our x'": simulate}


def by_jitcode(case: Case) -> dict[str, Any]:
    import jitcode
    import symengine

    x = [jitcode.y(i) for i in range(6)]
    functions = {"sin": symengine.sin, "cos": symengine.cos}
    force = [100.0 * symengine.sin(symengine.pi * jitcode.t)]
    rates = explicit(case.tutorial, functions, x, list(case.p), force, jitcode.t)
    here = Path.cwd()
    os.chdir(tempfile.mkdtemp())
    run = jitcode.jitcode(rates, verbose=False)
    run.generate_f_C(simplify=False, do_cse=True)
    run.compile_C(verbose=False)
    os.chdir(here)
    found = {"one: JiTCODE": lambda: evaluation(lambda t, y: run.f(t, y), case.x0, 2000)}

    def simulate(tolerance: float) -> Floats:
        run.set_integrator("dop853", rtol=max(tolerance, 1e-13), atol=tolerance, nsteps=1_000_000)
        run.set_initial_value(case.x0, 0.0)
        return np.array(run.integrate(END))

    found["simulate: JiTCODE, dop853"] = simulate
    return found


def by_ourselves(case: Case) -> dict[str, Any]:
    four_bar, ode = case.four_bar, case.four_bar.ode()
    batch = functools.partial(four_bar.rhs_batch, out=aligned(np.empty((6, BATCH))))

    def simulate(method: str, constraints: str) -> Simulation:
        def run(tolerance: float) -> Floats:
            how = {"method": method, "constraints": constraints, "t_eval": [END]}
            return four_bar.simulate((0.0, END), case.x0, rtol=tolerance, atol=tolerance, **how).y[:, -1]

        return run

    def ensemble(workers: int) -> Callable[[float, Floats], Floats]:
        def run(tolerance: float, stiffness: Floats) -> Floats:
            how = {"workers": workers, "t_eval": [END], "progress": False}
            return four_bar.ensemble(
                (0.0, END), case.x0, parameters={"k": stiffness}, rtol=tolerance, atol=tolerance, **how
            ).y[:, :, -1]

        return run

    return {
        "one: fourbar_codegen": lambda: evaluation(ode, case.x0, 5000),
        "batch: fourbar_codegen, one set of parameters": lambda: call(batch, case.times, case.states),
        "batch: fourbar_codegen": lambda: call(batch, case.times, case.states, case.each_p),
        "simulate: fourbar_codegen, DOP853, loop kept closed": simulate("DOP853", "project"),
        "simulate: fourbar_codegen, DOP853, loop left to drift": simulate("DOP853", "none"),
        "simulate: fourbar_codegen, RK45, loop kept closed": simulate("RK45", "project"),
        "ensemble: fourbar_codegen, one core": ensemble(1),
        "ensemble: fourbar_codegen, two cores": ensemble(2),
    }


def by_tutorial(case: Case) -> dict[str, Any]:
    rhs = case.tutorial.rhs
    return {
        "one: the tutorial's code": lambda: evaluation(rhs, case.x0, 500),
        "simulate: the tutorial's code, solve_ivp DOP853": by_scipy(rhs, case),
        "simulate: the tutorial's code, solve_ivp RK45": by_scipy(rhs, case, "RK45"),
    }


WAYS = {
    "fourbar_codegen": by_ourselves, "the tutorial's code": by_tutorial, "heyoka": by_heyoka, "numba": by_numba,
    "PyDy": by_pydy, "CasADi": by_casadi, "scikit-sundae": by_sundae, "JiTCODE": by_jitcode,
}  # fmt: skip


def installed() -> dict[str, Any]:
    """The packages that are installed."""
    missing = [name for name in WAYS if name in MODULES and not find_spec(MODULES[name])]
    for name in missing:
        print(f"{name} is not installed: pip install 'fourbar_codegen[bench]'", flush=True)
    return {name: way for name, way in WAYS.items() if name not in missing}


def of_kind(found: dict[str, Any], kind: str) -> dict[str, Any]:
    return {name.partition(": ")[2]: what for name, what in found.items() if name.startswith(f"{kind}: ")}


def precision(case: Case, simulations: dict[str, Simulation], rounds: int) -> list[dict[str, Any]]:
    """For each integrator and tolerance the error at the end, by the reference, and the time."""
    reference = by_scipy(case.tutorial.rhs, case)(1e-13)
    rows = []
    for tolerance in (*TOLERANCES, *TIGHTEST.values()):
        runs = {
            name: run for name, run in simulations.items() if tolerance in TOLERANCES or TIGHTEST.get(name) == tolerance
        }
        errors = {name: float(np.abs(run(tolerance) - reference).max()) for name, run in runs.items()}
        medians = compare(*(call(run, tolerance) for run in runs.values()), rounds=rounds)
        rows += [
            {"integrator": name, "tolerance": tolerance, "error": errors[name], "seconds": seconds}
            for name, seconds in zip(runs, medians, strict=True)
        ]
        print(json.dumps(rows[-len(runs) :]), flush=True)
    return rows


def at_error(rows: list[dict[str, Any]], name: str, error: float) -> float | None:
    """The time of an integrator for an error, between two tolerances; None where it does not get there."""
    own = sorted((row for row in rows if row["integrator"] == name), key=lambda row: -row["error"])
    for before, after in itertools.pairwise(own):
        if before["error"] >= error >= after["error"] > 0.0:
            share = np.log(before["error"] / error) / np.log(before["error"] / after["error"])
            return float(before["seconds"] ** (1 - share) * after["seconds"] ** share)
    return None


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.2, 5.2), layout="constrained")
    axes = figure.add_subplot()
    for color, name in zip(COLORS, dict.fromkeys(row["integrator"] for row in rows), strict=False):
        own = [row for row in rows if row["integrator"] == name and row["error"] > 0.0]  # the reference has none
        width = 2.5 if name.startswith("fourbar") else 1.2
        errors, times = [r["error"] for r in own], [1e3 * r["seconds"] for r in own]
        axes.loglog(errors, times, ".-", color=color, label=name, linewidth=width)
    axes.invert_xaxis()
    axes.set_xlabel("error of the state at 4 s")
    axes.set_ylabel("time of the simulation, ms")
    axes.grid(alpha=0.3)
    name_curves(axes, at_right=min)
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/peers.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/benchmarks.md as well")
    parser.add_argument("--rounds", type=int, default=9, help="number of measurements")
    parser.add_argument("--first", nargs=2, help="a package and an integrator: make a single simulation with it")
    options = parser.parse_args()
    case = Case()
    if options.first:
        package, name = options.first
        of_kind(WAYS[package](case), "simulate")[name](1e-10)
        return
    ways = installed()
    found = {name: what for way in ways.values() for name, what in way(case).items()}

    def together(kind: str, scale: float, unit: str) -> dict[str, float]:
        ways = of_kind(found, kind)
        medians = compare(*(way() for way in ways.values()), rounds=options.rounds)
        for name, median in zip(ways, medians, strict=True):
            print(f"{kind:<10} {name:<55} {median * scale:12.4g} {unit}", flush=True)
        return dict(zip(ways, medians, strict=True))

    one, batch = together("one", 1e6, "us"), together("batch", 1e9 / BATCH, "ns a state")
    rows = precision(case, of_kind(found, "simulate"), options.rounds)

    ensembles = of_kind(found, "ensemble")
    reference = by_scipy(case.tutorial.rhs, case)
    many: list[dict[str, Any]] = []
    for tolerance in (1e-6, 1e-10, 1e-13):
        ends = {name: run(tolerance, case.stiffness[:200]) for name, run in ensembles.items()}
        exact = np.array([_tutorial_end(case, stiffness) for stiffness in case.stiffness[:5]])
        medians = compare(*(call(run, tolerance, case.stiffness) for run in ensembles.values()), rounds=3)
        (slow,) = compare(call(reference, tolerance), rounds=3)
        for name, seconds in zip(ensembles, medians, strict=True):
            error = float(np.abs(ends[name][:5] - exact).max())
            each = seconds / len(case.stiffness)
            many.append({"way": name, "tolerance": tolerance, "error": error, "us": each * 1e6, "ratio": slow / each})
            print(json.dumps(many[-1]), flush=True)
    report = {**circumstances(MODULES), "one": one, "batch": batch, "precision": rows, "many": many}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    picture = DOCS / "peers.svg" if options.docs else options.output.with_suffix(".svg")
    plot(rows, picture)
    print(f"Written: {options.output}, {picture}")
    if options.docs:
        replace_in_page(
            DOCS / "benchmarks.md",
            "peers",
            tables(one, batch, rows, many),
            "python benchmarks/peers.py --docs",
            report,
        )


def _tutorial_end(case: Case, stiffness: float) -> Floats:
    """By the tutorial's equations with another stiffness, at 1e-13."""
    tutorial = case.tutorial
    values = list(tutorial.p_values)
    values[[str(p) for p in tutorial.p].index("k")] = stiffness

    def rhs(t: float, x: Floats) -> Floats:
        mass_matrix, forcing = tutorial.evaluate(x, values, tutorial.inputs(t), t)
        return np.linalg.solve(mass_matrix, forcing).ravel()

    return by_scipy(rhs, case)(1e-13)


def tables(
    one: dict[str, float],
    batch: dict[str, float],
    rows: list[dict[str, Any]],
    many: list[dict[str, Any]],
) -> str:
    errors = (1e-4, 1e-7, 1e-10)
    slow = one["the tutorial's code"]
    lines = [
        "The tutorial's four-bar linkage with its own code, with this package and with others. One evaluation",
        f"called from Python, and one evaluation of {BATCH} states, each with its own parameters:\n",
        "| | time | speed-up against the tutorial |",
        "|---|---|---|",
        *(
            f"| {name} | {t * 1e6:.3g} us | {slow / t:.3g} |"
            for name, t in sorted(one.items(), key=lambda item: -item[1])
        ),
        *(
            f"| a state of {BATCH}: {name} | {t * 1e9 / BATCH:.3g} ns | {slow * BATCH / t:.4g} |"
            for name, t in sorted(batch.items(), key=lambda item: -item[1])
        ),
        "\nA simulation of 4 s: computing time for a given error of the final state (interpolated between",
        "tolerances; the plot shows all of them):\n",
        "![Computing time against error](peers.svg)\n",
        "| | " + " | ".join(f"{error:.0e}" for error in errors) + " |",
        "|---|" + "---|" * len(errors),
    ]
    names = list(dict.fromkeys(row["integrator"] for row in rows))
    for name in names:
        cells = [at_error(rows, name, error) for error in errors]
        lines.append(f"| {name} | " + " | ".join(f"{cell * 1e3:.3g} ms" if cell else "" for cell in cells) + " |")
    lines += [
        "\nThe same at tolerances of 1e-3, 1e-10 and the smallest that is accepted, with the error:\n",
        "| | 1e-03 | 1e-10 | tightest |",
        "|---|---|---|---|",
    ]
    for name in names:
        own = [row for row in rows if row["integrator"] == name]
        shown = [*(row for row in own if row["tolerance"] in (TOLERANCES[0], 1e-10)), own[-1]]
        cells = [f"{row['seconds'] * 1e3:.3g} ms, {row['error']:.0e}" for row in shown]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += [
        "\n10,000 simulations of 4 s with different stiffnesses; the error is the largest of five of them:\n",
        "| | tolerance | error | time per simulation | speed-up against the tutorial's code |",
        "|---|---|---|---|---|",
        *(
            f"| {row['way']} | {row['tolerance']:.0e} | {row['error']:.1e} | {row['us']:.3g} us | {row['ratio']:.4g} |"
            for row in many
        ),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
