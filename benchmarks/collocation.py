"""Direct collocation of poles that swing up on a cart, beside opty: the same mesh, states, cost and Ipopt.

Ours is the class of docs/howto/optimal_control.md, as it stands there. Both take the midpoint rule; opty has inputs at
nodes, ours one in each interval. Times are those of building the problem (equations, code, compilation; without any
cache), of one evaluation of the constraints and their Jacobian, and of one iteration of Ipopt, all of it included.
Needs cyipopt, as docs/howto/optimal_control.md says; opty that is not installed is skipped: ``pip install opty``.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from measure import DOCS, call, circumstances, compare, options_of, publish, timed
from sympy.physics.mechanics.models import n_link_pendulum_on_cart
from tutorial import Floats

import fourbar_codegen as fb

N, END = 400, 2.0
POLES = (1, 2)
BUILDS = 3
"""Builds of which the median is taken; these take seconds."""


@dataclass(frozen=True)
class Measured:
    """A problem's build, in seconds; its evaluation and solution as measures; and the iterations of the last one."""

    build: float
    evaluate: Callable[[], float]
    solve: Callable[[], float]
    iterations: Callable[[], int]


def swing_up(poles: int) -> tuple[me.KanesMethod, dict[sm.Symbol, float], Floats, Floats]:
    """The model of SymPy, its parameters, and the states at the beginning, hanging, and at the end, upright."""
    kane = n_link_pendulum_on_cart(poles)
    symbols = kane.mass_matrix.free_symbols | kane.forcing.free_symbols
    values = {
        symbol: {"m": 1.0 if symbol.name == "m0" else 0.3, "l": 0.5, "g": 9.81}[symbol.name[0]]
        for symbol in symbols
        if symbol != me.dynamicsymbols._t
    }
    begin, end = ([x, *[angle] * poles, *[0.0] * (poles + 1)] for x, angle in ((0.0, np.pi), (1.0, 0.0)))
    return kane, values, np.array(begin), np.array(end)


def guess(begin: Floats, end: Floats) -> Floats:
    """Straight lines between the states, in rows; no speeds."""
    return np.outer(begin, np.linspace(1.0, 0.0, N + 1)) + np.outer(end, np.linspace(0.0, 1.0, N + 1))


def page_class() -> Any:
    """The class of the how-to."""
    cell = (DOCS / "howto" / "optimal_control.md").read_text().split("```{code-cell}\n")[1].partition("```")[0]
    names: dict[str, Any] = {}
    exec(cell, names)  # our own page
    return names["Collocation"]


def by_ourselves(poles: int) -> Measured:
    class Counted(page_class()):  # type: ignore[misc]
        iterations = 0

        def intermediate(self, _: int, iteration: int, *__: float) -> bool:
            self.iterations = iteration
            return True

    def build() -> tuple[Any, Floats]:
        kane, values, begin, end = swing_up(poles)
        with tempfile.TemporaryDirectory() as cache:
            os.environ["FOURBAR_CODEGEN_CACHE"] = cache
            model = fb.compile_model(fb.Model(kane, name="poles", parameters=values, inputs="auto"))
            ends = (dict(zip(model.states, x, strict=True)) for x in (begin, end))
            problem = Counted(model, END, N, 0.5, *ends)
            z = np.concatenate((guess(begin, end).ravel(), np.zeros(sum(problem.sizes[1:]))))
            problem.jacobian(z)
        del os.environ["FOURBAR_CODEGEN_CACHE"]
        return problem, z

    seconds = statistics.median(timed(build) for _ in range(BUILDS))
    problem, z = build()
    x = z[: problem.sizes[0]].reshape(-1, N + 1)

    def solve() -> float:
        begin = time.perf_counter()
        _, _, status, _ = problem.solve(x)
        if status:
            raise RuntimeError(f"Ipopt ended with {status}.")
        return (time.perf_counter() - begin) / problem.iterations

    both = call(lambda: (problem.constraints(z), problem.jacobian(z)))
    return Measured(seconds, both, solve, lambda: problem.iterations)


def by_opty(poles: int) -> Measured:
    from opty import Problem

    def build() -> Any:
        kane, values, begin, end = swing_up(poles)
        t = me.dynamicsymbols._t
        states = [*kane.q, *kane.u]
        rates = sm.Matrix([q.diff(t) - kane.kindiffdict()[q.diff(t)] for q in kane.q])
        equations = kane.mass_matrix * kane.u.diff(t) - kane.forcing
        inputs = N + 1

        def cost(z: Floats) -> float:
            return float(END / N * (z[-inputs:] ** 2).sum())

        def gradient(z: Floats) -> Floats:
            result = np.zeros_like(z)
            result[-inputs:] = 2.0 * END / N * z[-inputs:]
            return result

        fixed = [state.subs(t, 0.0) - value for state, value in zip(states, begin, strict=True)]
        fixed += [state.subs(t, END) - value for state, value in zip(states, end, strict=True)]
        problem = Problem(
            cost, gradient, rates.col_join(equations), states, N + 1, END / N, known_parameter_map=values,
            instance_constraints=fixed, time_symbol=t, integration_method="midpoint",
        )  # fmt: skip
        z = np.concatenate((guess(begin, end).ravel(), np.zeros(inputs)))
        problem.jacobian(z)
        problem.add_option("print_level", 0)
        problem.add_option("sb", "yes")
        problem.add_option("hessian_approximation", "limited-memory")
        return problem, z

    seconds = statistics.median(timed(build) for _ in range(BUILDS))
    problem, z = build()
    iterations = [0]

    def solve() -> float:
        before = len(problem.obj_value)
        begin = time.perf_counter()
        _, info = problem.solve(z)
        if info["status"]:
            raise RuntimeError(f"Ipopt ended with {info['status']}.")
        iterations[0] = len(problem.obj_value) - before - 1  # the first value is that of the guess
        return (time.perf_counter() - begin) / iterations[0]

    both = call(lambda: (problem.constraints(z), problem.jacobian(z)))
    return Measured(seconds, both, solve, lambda: iterations[0])


def main() -> None:
    options = options_of(__doc__)
    if not find_spec("cyipopt"):
        print("cyipopt is not installed.")
        return
    functions = {"fourbar_codegen": by_ourselves}
    if find_spec("opty"):
        functions["opty"] = by_opty
    else:
        print("opty is not installed.")
    lines = [f"| | {' | '.join(functions)} |", f"|---|{'---:|' * len(functions)}"]
    report: dict[str, Any] = circumstances(("opty", "cyipopt"))
    for poles in POLES:
        found = {name: function(poles) for name, function in functions.items()}
        evaluations = compare(*(each.evaluate for each in found.values()), rounds=options.rounds)
        iterations = compare(*(each.solve for each in found.values()), rounds=options.rounds)
        counts = [each.iterations() for each in found.values()]
        title = f"{poles} pole{'s' * (poles > 1)}"
        for what, cells in (
            ("build", [f"{each.build:.3g} s" for each in found.values()]),
            ("constraints and Jacobian", [f"{1e3 * seconds:.3g} ms" for seconds in evaluations]),
            ("an iteration of Ipopt", [f"{1e3 * seconds:.3g} ms" for seconds in iterations]),
            ("iterations", [str(count) for count in counts]),
            ("solution", [f"{n * seconds:.3g} s" for n, seconds in zip(counts, iterations, strict=True)]),
        ):
            lines.append(f"| {title}: {what} | {' | '.join(cells)} |")
        report[title] = {
            name: {"build": each.build, "evaluation": evaluation, "iteration": iteration, "iterations": count}
            for (name, each), evaluation, iteration, count in zip(
                found.items(), evaluations, iterations, counts, strict=True
            )
        }
    publish(options, "collocation", "\n".join(lines), report)


if __name__ == "__main__":
    main()
