"""The compiled four-bar against the tutorial's own code, side by side in one run.

Every row measures both, interleaved, so that a busy machine slows both, and compares medians. Prints a table of
ratios and writes them, with the machine and the versions, as JSON.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measure import (
    DOCS,
    README,
    call,
    circumstances,
    compare,
    evaluation,
    evaluation_inside_c,
    replace_in_page,
    save_figure,
    timed,
)
from scipy.integrate import solve_ivp
from tutorial import Floats, tutorial_four_bar

import fourbar_codegen as fb

ROOT = Path(__file__).parent.parent
ROUNDS = 15
STATES = 4096


TUTORIAL_PROCESS = """
import sys
sys.path.insert(0, {folder!r})
from tutorial import tutorial_four_bar
from scipy.integrate import solve_ivp
tutorial = tutorial_four_bar()
x0 = tutorial.initial_state([-0.5], [-0.1], [-1.5, -1.5], [0.5, -0.5])
assert solve_ivp(tutorial.rhs, (0, 4), x0).success
"""

COMPILED_PROCESS = """
import fourbar_codegen as fb
four_bar = fb.load("four_bar")
assert four_bar.simulate((0.0, 4.0), method="RK45", rtol=1e-3, atol=1e-6).success
"""


def process(code: str) -> Callable[[], float]:
    """A measure of a fresh Python process."""
    return lambda: timed(lambda: subprocess.run([sys.executable, "-c", code], check=True))


COMPILE_PROCESS = """
import time
import timeit
import fourbar_codegen as fb
model = fb.models.four_bar()
begin = time.perf_counter()
fb.compile_model(model)
print(time.perf_counter() - begin)
"""


def compile_in_fresh_process(cold: bool) -> Callable[[], float]:
    """A measure of compile_model in a process that has imported SymPy and made the model."""
    kept = tempfile.mkdtemp()

    def measure() -> float:
        folder = tempfile.mkdtemp() if cold else kept
        environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": folder}
        command = [sys.executable, "-c", COMPILE_PROCESS]
        done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
        return float(done.stdout)

    if not cold:
        measure()
    return measure


COMMAND = "python benchmarks/four_bar.py --docs"

SHORT = {
    "evaluation from Python, CompiledModel.rhs(t, x)": "one evaluation of x' from Python",
    f"{STATES} states at once, compiled for this machine": f"x' at {STATES:,} states",
    "simulate, 4 s, RK45 as by default, loop kept closed": "4 s of motion, RK45, `rtol=1e-3`",
    "simulate, 4 s, DOP853 at 1e-10, loop kept closed": "4 s of motion, DOP853, `rtol=1e-10`",
    "fresh process, import to trajectory": "a fresh process, from import to trajectory",
}
"""The rows that README.md shows, and what they are called there."""


def table(rows: list[dict[str, Any]], names: dict[str, str]) -> str:
    lines = ["| | the tutorial's code | fourbar_codegen | ratio |", "|---|---:|---:|---:|"]
    for row in rows:
        left = f"{row['tutorial']:.3g} {row['unit']}" if row["tutorial"] else ""
        lines.append(
            f"| {names[row['name']]} | {left} | {row['compiled']:.3g} {row['unit']} | "
            + (f"{float(format(row['ratio'], '.3g')):,g} |" if row["ratio"] else "|")
        )
    return "\n".join(lines)


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """How many times faster, on a logarithmic axis; each bar has its name and its number beside it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 2.4), layout="constrained")
    axes = figure.add_subplot()
    names = [SHORT[row["name"]].replace("`", "") for row in rows]
    bars = axes.barh(names, [row["ratio"] for row in rows], color="#1f6fb4")
    axes.bar_label(bars, [f"{float(format(row['ratio'], '.2g')):,g} x" for row in rows], padding=4)
    axes.set_xscale("log")
    axes.set_xlim(1.0, 8e3)
    axes.set_xlabel("times faster than the tutorial's code")
    axes.invert_yaxis()
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    save_figure(figure, path)


def write_docs(report: dict[str, Any]) -> None:
    """The short table in README.md, its plot, and all rows in docs/benchmarks.md."""
    rows = report["rows"]
    shown = [row for row in rows if row["name"] in SHORT]
    plot(shown, DOCS / "speed.svg")
    replace_in_page(README, "benchmark", table(shown, SHORT), COMMAND, report)
    replace_in_page(
        DOCS / "benchmarks.md", "four-bar", table(rows, {row["name"]: row["name"] for row in rows}), COMMAND, report
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/benchmark.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the tables into README.md and docs/benchmarks.md")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="samples of each measure")
    options = parser.parse_args()

    tutorial = tutorial_four_bar()
    four_bar = fb.load("four_bar")
    x0 = tutorial.initial_state([-0.5], [-0.1], [-1.5, -1.5], [0.5, -0.5])
    ode = four_bar.ode()
    rows: list[dict[str, object]] = []

    def row(name: str, unit: str, target: float | None, slow: Callable[[], float], *fast: Callable[[], float]) -> float:
        scale = {"us": 1e6, "ms": 1e3, "s": 1.0}[unit]
        medians = compare(slow, *fast, rounds=options.rounds if unit != "s" else max(3, options.rounds // 3))
        ratio = medians[0] / medians[1] if fast else None
        rows.append(
            {"name": name, "unit": unit, "tutorial": medians[0] * scale if fast else None,
             "compiled": medians[-1] * scale, "ratio": ratio, "target": target}
        )  # fmt: skip
        left = f"{medians[0] * scale:10.4f}" if fast else " " * 10
        right = f"{ratio:8.1f}" if ratio else " " * 8
        print(f"{name:<52} {left} {medians[-1] * scale:10.4f} {unit:<3} {right}   {target or ''}", flush=True)
        return medians[-1]

    def solve(function: Callable[[float, Floats], Floats], **how: object) -> Callable[[], float]:
        return lambda: timed(lambda: solve_ivp(function, (0, 4), x0, **how))

    precise = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-10}
    print(f"{'':<52} {'tutorial':>10} {'compiled':>10}     {'ratio':>8}   target")
    one = evaluation(tutorial.rhs, x0, 500)
    row("evaluation from Python, CompiledModel.rhs(t, x)", "us", 80, one, evaluation(four_bar.rhs, x0, 5000))
    row("evaluation from Python, ode()(t, x)", "us", 80, one, evaluation(ode, x0, 5000))
    sources = {path.name: path.read_text() for path in (ROOT / "generated" / "four_bar").glob("*.[ch]")}
    inside = functools.partial(evaluation_inside_c, "four_bar", sources, t=0.5, x=x0, p=tutorial.p_values)
    row("evaluation inside C, on any processor", "us", 200, one, inside(function="rhs", flags=[]))
    native = ["-march=native"] if platform.machine() == "x86_64" else []
    row("evaluation inside C, for this machine", "us", 200, one, inside(function="rhs", flags=native))
    forming = row("forming q', M, f, J, gamma inside C", "us", None, inside(function="dynamics", flags=native))
    operations = four_bar.manifest["operations"]["dynamics"]
    print(f"{'the same per operation':<52} {'':>10} {1e9 * forming / operations:10.4f} ns")

    own = fb.compile_model(fb.models.four_bar())
    states = np.tile(x0, (STATES, 1)).T + 1e-3 * np.random.default_rng(0).standard_normal((6, STATES))
    each = evaluation(tutorial.rhs, x0, 500)
    for name, model in (("as shipped", four_bar), ("compiled for this machine", own)):
        batch = functools.partial(model.rhs_batch, 0.5, states)
        row(f"{STATES} states at once, {name}", "ms", None, lambda: STATES * each(), call(batch))

    default = {"method": "RK45", "rtol": 1e-3, "atol": 1e-6}
    for name, target, how in (("RK45 as by default", None, default), ("DOP853 at 1e-10", 200, precise)):
        simulate = functools.partial(four_bar.simulate, (0, 4), x0, **how)
        slow = solve(tutorial.rhs, **how)
        row(f"simulate, 4 s, {name}, loop kept closed", "ms", target, slow, call(simulate))
        # Then the processor has to find its code and data anew.
        row("the same, alone after other work", "ms", None, slow, functools.partial(timed, simulate))
        here = functools.partial(own.simulate, (0, 4), x0, **how)
        row("as before, compiled for this machine", "ms", None, slow, call(here))
    shortest = functools.partial(four_bar.simulate, (0.0, 1e-9), x0, **precise)
    row("simulate, a single step: what a run costs at least", "us", None, call(shortest))
    row("solve_ivp, 4 s, default RK45, steps in C", "ms", 7,
        solve(tutorial.rhs), solve(ode, method=fb.solvers.RK45))  # fmt: skip
    row("solve_ivp, 4 s, DOP853 at 1e-10, steps in C", "ms", None,
        solve(tutorial.rhs, **precise), solve(ode, **precise | {"method": fb.solvers.DOP853}))  # fmt: skip
    row("solve_ivp, 4 s, default RK45, SciPy's steps", "ms", None, solve(tutorial.rhs), solve(ode))
    row("solve_ivp, 4 s, DOP853 at 1e-10, SciPy's steps", "ms", None,
        solve(tutorial.rhs, **precise), solve(ode, **precise))  # fmt: skip
    row("fresh process, import to trajectory", "s", 2.5,
        process(TUTORIAL_PROCESS.format(folder=str(ROOT / "benchmarks"))), process(COMPILED_PROCESS))  # fmt: skip
    row("compile_model, cold", "s", None, compile_in_fresh_process(cold=True))
    row("compile_model, warm", "s", None, compile_in_fresh_process(cold=False))

    report = circumstances() | {"rounds": options.rounds, "rows": rows}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    print(f"Written: {options.output}")
    if options.docs:
        write_docs(report)


if __name__ == "__main__":
    main()
