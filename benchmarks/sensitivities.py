"""Derivatives of the tutorial's simulation by the eight parameters, beside CasADi, heyoka and diffrax; and a fit.

All derivatives are those of the state after 4 s, or of q2 there, for a held initial state. Errors are relative to the
largest entry of a reference, by this package at 1e-13. The others' loops drift open, so ours is also measured without
projection. By lengths, the derivatives of loops that are kept closed are others, so errors are those by the other four
parameters. Packages that are not installed are skipped with a message: ``pip install 'fourbar_codegen[bench]'``.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from measure import call, circumstances, compare, options_of, publish
from peers import END, Case, explicit, heyoka_system
from scipy.optimize import least_squares
from tutorial import Floats

import fourbar_codegen as fb

TOLERANCES = [10.0**-k for k in range(4, 13)]
ERROR = 1e-7
Q2 = 1
MODULES = {"CasADi": "casadi", "heyoka": "heyoka", "diffrax": "diffrax"}

COMPARED = ("rho", "k", "c", "g")

Method = Callable[[float], Floats]
"""The derivatives for a tolerance: (6, 8), or (8,) of q2."""


def by_ourselves(case: Case) -> dict[str, Method]:
    model = case.four_bar
    names = model.parameters

    def forward(constraints: str, tolerance: float) -> Floats:
        run = model.simulate(
            (0.0, END), case.x0, t_eval=[END], sensitivities=names, rtol=tolerance, atol=tolerance,
            constraints=constraints, progress=False,
        )  # fmt: skip
        assert run.sensitivity is not None
        return np.array([run.sensitivity[name][:, 0] for name in names]).T

    def adjoint(constraints: str, tolerance: float) -> Floats:
        run = model.simulate(
            (0.0, END), case.x0, t_eval=[END], gradient=True, rtol=tolerance, atol=tolerance, constraints=constraints,
            progress=False,
        )  # fmt: skip
        gradient = run.gradient({"q2": 1.0})
        return np.array([gradient[name] for name in names])

    found: dict[str, Method] = {}
    for constraints, word in (("project", ""), ("none", ", loop drifting")):
        found[f"forward: fourbar_codegen{word}"] = functools.partial(forward, constraints)
        found[f"gradient: fourbar_codegen{word}"] = functools.partial(adjoint, constraints)
    return found


def by_casadi(case: Case) -> dict[str, Method]:
    import casadi as ca

    x, p, t = ca.SX.sym("x", 6), ca.SX.sym("p", len(case.p)), ca.SX.sym("t")
    functions = {"sin": ca.sin, "cos": ca.cos}
    rates = explicit(
        case.tutorial, functions, ca.vertsplit(x), ca.vertsplit(p), [100.0 * ca.sin(np.pi * t)], t
    )  # fmt: skip

    @functools.cache
    def functions_at(tolerance: float) -> tuple[Any, Any]:
        problem = {"x": x, "p": p, "t": t, "ode": ca.vertcat(*rates)}
        options = {"reltol": tolerance, "abstol": tolerance, "max_num_steps": 1_000_000}
        run = ca.integrator("F", "cvodes", problem, 0.0, END, options)
        return run.factory("J", ["x0", "p"], ["jac:xf:p"]), run.factory("A", ["x0", "p", "adj:xf"], ["adj:p"])

    weights = np.eye(6)[Q2]
    return {
        "forward: CasADi, CVODES": lambda tolerance: np.array(functions_at(tolerance)[0](case.x0, case.p)),
        "gradient: CasADi, CVODES": lambda tolerance: np.array(functions_at(tolerance)[1](case.x0, case.p, weights))[
            :, 0
        ],
    }


def by_heyoka(case: Case) -> dict[str, Method]:
    import heyoka as hy

    x, rates = heyoka_system(case, literal=False)
    used = [i for i in range(len(case.p)) if hy.par[i] in hy.get_params(rates)]  # l1 stands in no acceleration
    system = hy.var_ode_sys(list(zip(x, rates, strict=True)), hy.var_args.params, order=1)

    @functools.cache
    def integrator(tolerance: float) -> Any:
        return hy.taylor_adaptive(
            system, state=case.x0, pars=case.p, tol=tolerance, time=0.0, compact_mode=True
        )  # fmt: skip

    def forward(tolerance: float) -> Floats:
        run = integrator(tolerance)
        run.time = 0.0
        run.state[:6] = case.x0
        run.state[6:] = 0.0
        run.propagate_until(END)
        found = np.zeros((6, len(case.p)))
        found[:, used] = run.state[6:].reshape(6, -1)
        return found

    return {"forward: heyoka, Taylor": forward, "gradient: heyoka, Taylor": lambda t: forward(t)[Q2]}


def by_diffrax(case: Case) -> dict[str, Method]:
    import diffrax
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)

    def rates(t: Any, x: Any, p: Any) -> Any:
        functions = {"sin": jnp.sin, "cos": jnp.cos}
        return jnp.stack(explicit(case.tutorial, functions, list(x), list(p), [100.0 * jnp.sin(jnp.pi * t)], t))

    def end(adjoint: Any, tolerance: float, p: Any) -> Any:
        steps = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        return diffrax.diffeqsolve(
            diffrax.ODETerm(rates), diffrax.Dopri8(), 0.0, END, None, jnp.asarray(case.x0), p, adjoint=adjoint,
            stepsize_controller=steps, max_steps=4096,
        ).ys[-1]  # fmt: skip

    @functools.cache
    def functions_at(tolerance: float) -> tuple[Any, Any]:
        forward, reverse = diffrax.ForwardMode(), diffrax.RecursiveCheckpointAdjoint()
        return (
            jax.jit(jax.jacfwd(functools.partial(end, forward, tolerance))),
            jax.jit(jax.grad(lambda p: end(reverse, tolerance, p)[Q2])),
        )

    return {
        "forward: JAX, diffrax": lambda tolerance: np.asarray(functions_at(tolerance)[0](case.p)),
        "gradient: JAX, diffrax": lambda tolerance: np.asarray(functions_at(tolerance)[1](case.p)),
    }


def at_error(rows: list[tuple[float, float]]) -> float:
    """The time at an error, between two tolerances on a logarithmic scale; NaN if the error is not reached."""
    for (before, slow), (after, slower) in itertools.pairwise(rows):
        if before > ERROR >= after:
            share = math.log(before / ERROR) / math.log(before / after)
            return math.exp((1.0 - share) * math.log(slow) + share * math.log(slower))
    return rows[0][1] if rows[0][0] <= ERROR else math.nan


def own_ratios(case: Case, rounds: int) -> dict[str, float]:
    """Times of derivatives in units of the run that they belong to."""
    model, times, values = case.four_bar, np.linspace(0.0, END, 401), np.zeros(400)
    how = {"rtol": 1e-8, "atol": 1e-8, "progress": False}
    table = {"F": (np.linspace(0.0, END, 400), values)}
    weights = np.ones((6, 401))

    def adjoint(**more: Any) -> None:
        model.simulate((0.0, END), case.x0, t_eval=times, gradient=True, **how, **more).gradient(weights)

    def run(**more: Any) -> None:
        model.simulate((0.0, END), case.x0, t_eval=times, **how, **more)

    medians = compare(
        call(run), call(lambda: run(sensitivities=model.parameters)), call(adjoint),
        call(lambda: run(inputs=table)), call(lambda: adjoint(inputs=table)),
        call(lambda: run(sensitivities=model.parameters[:4])), rounds=rounds,
    )  # fmt: skip
    return {
        "4 parameters, forward": medians[5] / medians[0],
        "8 parameters, forward": medians[1] / medians[0],
        "8 parameters, gradient": medians[2] / medians[0],
        "408 parameters and values of a table, gradient": medians[4] / medians[3],
    }


def a_fit(case: Case, rounds: int) -> tuple[float, float]:
    """Seconds of a fit of 4 unknowns to 401 samples: by 2-point differences, and by `fit`."""
    model, times = case.four_bar, np.linspace(0.0, END, 401)
    true, guess = {"k": 3.0, "c": 1.5, "l2": 0.45, "q1": -0.4}, {"k": 2.0, "c": 1.0, "l2": 0.47, "q1": -0.45}

    def angle(values: dict[str, float]) -> Floats:
        p = {name: values[name] for name in ("k", "c", "l2")}
        x0 = model.initial_state({"q1": values["q1"]}, parameters=p)
        return model.simulate(
            (0.0, END), x0, parameters=p, t_eval=times, rtol=1e-8, atol=1e-10, progress=False
        )["q2"]  # fmt: skip

    measured = angle(true) + np.random.default_rng(0).normal(0.0, 1e-3, 401)

    def by_differences() -> None:
        least_squares(
            lambda values: angle(dict(zip(guess, values, strict=True))) - measured, [*guess.values()], x_scale="jac"
        )

    ours = compare(
        call(by_differences), call(lambda: fb.fit(model, {"t": times, "q2": measured}, guess)), rounds=rounds
    )
    return ours[0], ours[1]


def main() -> None:
    options = options_of(__doc__)
    case = Case()
    functions = {"CasADi": by_casadi, "heyoka": by_heyoka, "diffrax": by_diffrax}
    methods = by_ourselves(case)
    for name, function in functions.items():
        if find_spec(MODULES[name]):
            methods |= function(case)
        else:
            print(f"{name} is not installed.")
    reference = methods["forward: fourbar_codegen, loop drifting"](1e-13)
    compared = [case.four_bar.parameters.index(name) for name in COMPARED]
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
    for tolerance in TOLERANCES:
        medians = compare(
            *(call(functools.partial(method, tolerance)) for method in methods.values()), rounds=options.rounds
        )
        for (name, method), median in zip(methods.items(), medians, strict=True):
            expected = (reference[Q2] if name.startswith("gradient") else reference)[..., compared]
            error = np.abs(method(tolerance)[..., compared] - expected).max() / np.abs(expected).max()
            times[name].append((float(error), median))
    at = {name: at_error(rows) for name, rows in times.items()}
    lines = ["| | all derivatives of the state | gradient of q2 |", "|---|---:|---:|"]
    for name in dict.fromkeys(name.partition(": ")[2] for name in methods):
        cells = [f"{1e3 * at[f'{kind}: {name}']:.3g} ms" for kind in ("forward", "gradient")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    ratios, (differences, ours) = own_ratios(case, options.rounds), a_fit(case, options.rounds)
    lines += ["", "| derivatives of a run with 401 samples | times the run |", "|---|---:|"]
    lines += [f"| {name} | {ratio:.3g} |" for name, ratio in ratios.items()]
    lines += ["", "| a fit of 4 unknowns to 401 samples | |", "|---|---:|"]
    lines.append(f"| `least_squares` with 2-point differences | {1e3 * differences:.3g} ms |")
    lines.append(f"| `fit` | {1e3 * ours:.3g} ms |")
    report = circumstances(MODULES) | {"times": times, "at_error": at, "ratios": ratios, "fit": [differences, ours]}
    publish(options, "sensitivities", "\n".join(lines), report)


if __name__ == "__main__":
    main()
