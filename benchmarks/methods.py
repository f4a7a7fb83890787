"""Compare all methods of `simulate`: time, evaluations, errors, constraint violation and energy, case by case.

Each method runs with tolerances from coarse to fine (ALI3P with steps from long to short) until a run takes longer than
a second. The reference is DOP853 at 1e-12, to which Radau and IDA converge. The tables also show by how much the motion
itself amplifies an error, which no method can avoid.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from measure import (
    COLORS,
    DOCS,
    PROJECT,
    call,
    circumstances,
    compare,
    name_curves,
    replace_in_page,
    save_figure,
    timed,
)
from sksundae.ida import IDA

import fourbar_codegen as fb
from fourbar_codegen.models import whipple_bicycle
from fourbar_codegen.runtime.implicit import Residual

sys.path.append(str(PROJECT / "examples"))
driven_four_bar = import_module("08_stiff_drive").driven_four_bar

TOLERANCES = [10.0**-k for k in range(3, 11)]
STEPS = [1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5]  # of ALI3P
SHOWN = 1e-6
MAX_OPERANDS = 1.0  # s
SAMPLES = 41
PERTURBATION = 1e-8  # of each entry of a state
METHODS: dict[str, dict[str, Any]] = {
    "DOP853": {},
    "RK45": {},
    "Tsit5": {},
    "DOP853, Baumgarte": {"method": "DOP853", "constraints": "baumgarte"},
    "ALI3P": {},
    "Radau": {},
    "CVODE": {},
    "IDA, Gear-Gupta-Leimkuhler": {"method": "IDA"},
    "IDA, index 1": {"method": "IDA", "formulation": "index-1"},
    "IDA, index 3": {"method": "IDA", "formulation": "index-3"},
}
EXPLICIT = ("DOP853", "RK45", "Tsit5")
EXACT: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}


@dataclass
class Case:
    """A motion and its reference."""

    name: str
    model: fb.CompiledModel
    end: float
    parameters: dict[str, float] = field(default_factory=dict)
    inputs: dict[str, float] = field(default_factory=dict)
    q: dict[str, float] = field(default_factory=dict)
    u: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.x0 = self.model.initial_state(self.q, self.u, parameters=self.parameters)
        self.times = np.linspace(0.0, self.end, SAMPLES)
        self.reference = self.run(**EXACT, t_eval=self.times)
        assert self.reference.success, self.reference.message

    def run(self, start: float = 0.0, x0: Any = None, **how: Any) -> fb.Trajectory:
        x0 = self.x0 if x0 is None else x0
        return self.model.simulate((start, self.end), x0, parameters=self.parameters, inputs=self.inputs, **how)

    def growth(self) -> tuple[float, float]:
        """The largest error at the end for a relative error of 1 on the way, and the time of that error.

        About `SAMPLES` states of the reference, equally spaced in its steps, are perturbed: each entry by
        `PERTURBATION` of itself, with a random sign.
        """
        steps, signs = self.run(**EXACT), np.random.default_rng(0)
        made = []
        for i in range(0, steps.t.size - 1, max(1, steps.t.size // SAMPLES)):
            t, x = steps.t[i], steps.y[:, i]
            off = x * (1.0 + PERTURBATION * signs.choice([-1.0, 1.0], x.size))
            ends = [self.run(t, start, **EXACT).y[:, -1] for start in (x, off)]
            made.append((float(np.abs(ends[1] - ends[0]).max()) / PERTURBATION, float(t)))
        return max(made)


def cases() -> list[Case]:
    tutorial, driven = fb.load("four_bar"), fb.compile_model(driven_four_bar())
    free = {"k": 0.0, "c": 0.0}
    return [
        Case("The tutorial's case, 4 s", tutorial, 4.0),
        Case("A stiff damper, 4 s", driven, 4.0, {"stiffness": 1e6, "damping": 1e5}),
        Case("A stiff spring, 4 s", driven, 4.0, {"stiffness": 3e7, "damping": 6e3}),
        Case("A long run, 100 s", tutorial, 100.0, free, {"F": 0.0}),
        Case(
            "A falling bicycle, 2.5 s",
            fb.compile_model(whipple_bicycle()),
            2.5,
            q={"q4": 0.0},
            u={"u6": -2.0 / 0.3, "u4": 0.5},
        ),
    ]


def precision(case: Case, rounds: int) -> list[dict[str, Any]]:
    """The runs of all methods at all tolerances; those of one tolerance are measured interleaved."""
    rows = []
    going = dict(METHODS)
    for tolerance, step in zip(TOLERANCES, STEPS, strict=True):
        runs = {}
        for name, how in list(going.items()):
            settings = {"max_step": step} if name == "ALI3P" else {"rtol": tolerance, "atol": tolerance}
            run = partial(case.run, **{"method": name, **how, **settings})
            seconds = timed(run)
            if seconds > MAX_OPERANDS:
                del going[name]
            else:
                runs[name] = run, settings
        medians = compare(*(call(run) for run, _ in runs.values()), rounds=rounds)
        for (name, (run, settings)), seconds in zip(runs.items(), medians, strict=True):
            rows.append({"method": name, **settings, "seconds": seconds, **qualities(case, run)})
            print(f"{case.name}: {json.dumps(rows[-1])}", flush=True)
    return rows


def qualities(case: Case, run: partial[fb.Trajectory]) -> dict[str, Any]:
    """Errors of one run, and its constraint violation with and without projection."""
    sampled = run(t_eval=case.times)
    if not sampled.success:
        return {"message": sampled.message}
    alone = run if run.keywords.get("constraints") else partial(run, constraints="none")
    return {
        "evaluations": run().nfev,
        "error": float(np.abs(sampled.y[:, -1] - case.reference.y[:, -1]).max()),
        "energy error": float(np.abs(sampled.energy - case.reference.energy).max()),
        "open": float(np.abs(sampled.constraint_residual).max()),
        "open alone": float(np.abs(alone(t_eval=case.times).constraint_residual).max()),
    }


def overhead(case: Case, rounds: int) -> dict[str, float]:
    """Seconds of an evaluation of IDA's residual: by itself, in one call of scikit-sundae, and in `simulate`."""
    residual = Residual(case.model.ode(), "gear-gupta-leimkuhler")
    z, z_rate, values = (np.zeros(residual.n_y) for _ in range(3))
    z[: len(case.x0)] = case.x0
    rates, multipliers = case.model.ode().multipliers(0.0, case.x0)
    z[len(case.x0) :][: len(multipliers)], z_rate[: len(rates)] = multipliers, rates
    atol = np.where(np.arange(residual.n_y) < len(case.x0), SHOWN, 1e20)

    def whole() -> Any:
        solver = IDA(
            residual.evaluate, jacfn=residual.jacobian, rtol=SHOWN, atol=atol,
            algebraic_idx=np.arange(len(case.x0), residual.n_y),
        )  # fmt: skip
        solver.init_step(0.0, z, z_rate)
        return solver.step(case.end, method="normal")

    ours = partial(case.run, method="IDA", rtol=SHOWN, atol=SHOWN)
    alone, in_one, in_steps = compare(
        call(residual.evaluate, 0.0, z, z_rate, values), call(whole), call(ours), rounds=rounds
    )
    return {"alone": alone, "in one call": in_one / whole().nfev, "step by step": in_steps / ours().nfev}


def plot(results: dict[str, list[dict[str, Any]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.2, 5.0 * len(results)), layout="constrained")
    for axes, (title, rows) in zip(figure.subplots(len(results), 1), results.items(), strict=True):
        for i, (name, color) in enumerate(zip(METHODS, COLORS, strict=False)):
            own = [row for row in rows if row["method"] == name and "error" in row]
            errors, times = [row["error"] for row in own], [1e3 * row["seconds"] for row in own]
            axes.loglog(errors, times, ".-", color=color, label=name, linewidth=2.2 if i < 4 else 1.2)
        axes.invert_xaxis()
        axes.set_title(title, loc="left")
        axes.set_xlabel("error of the state at the end")
        axes.set_ylabel("time, ms")
        axes.grid(alpha=0.3)
        name_curves(axes, at_right=min)
    save_figure(figure, path)


def tables(
    results: dict[str, list[dict[str, Any]]], growths: dict[str, tuple[float, float]], calls: dict[str, float]
) -> str:
    lines = []
    for name, rows in results.items():
        growth, time = growths[name]
        lines += [
            f"### {name}\n",
            f"The motion amplifies a relative error at t = {time:.4g} s by {growth:.0e}.\n",
            "| method | time | evaluations | final error | energy error, J | violation, m | without projection, m |",
            "|---|---|---|---|---|---|---|",
        ]
        for method in METHODS:
            setting = ("max_step", 1e-3) if method == "ALI3P" else ("rtol", SHOWN)
            shown = [row for row in rows if row["method"] == method and setting in row.items()]
            if not shown or "message" in shown[0]:
                lines.append(f"| {method} | {'fails' if shown else f'more than {MAX_OPERANDS:g} s'} | | | | | |")
                continue
            (row,) = shown
            lines.append(
                f"| {method} | {1e3 * row['seconds']:.3g} ms | {row['evaluations']} | {row['error']:.1e} | "
                f"{row['energy error']:.1e} | {row['open']:.1e} | {row['open alone']:.1e} |"
            )
        lines.append("")
    lines += [
        "![Computing time against error, for each case](methods.svg)\n",
    ]
    alone, in_one, in_steps = (f"{1e6 * seconds:.2g} us" for seconds in calls.values())
    text = (
        f"Time per evaluation of IDA's residual: {alone} by itself; {in_one} in a single call of scikit-sundae for the",
        f"tutorial's whole case, including Jacobians and linear algebra; {in_steps} in `simulate`, which checks each",
        "step. scikit-sundae accepts callbacks as Python functions only, and makes arrays of their arguments.",
    )
    return "\n".join([*lines, *text])


def explicit(motions: list[Case], rounds: int) -> str:
    """A table of times and errors of the explicit methods, measured alternately at each tolerance."""
    lines = [
        "| motion | rtol = atol |" + "".join(f" {name} | error |" for name in EXPLICIT),
        "|---|---|" + "---|---|" * len(EXPLICIT),
    ]
    for case in motions:
        for tolerance in TOLERANCES[1:7]:
            runs = [partial(case.run, method=name, rtol=tolerance, atol=tolerance) for name in EXPLICIT]
            medians = compare(*(call(run) for run in runs), rounds=rounds)
            errors = [qualities(case, run)["error"] for run in runs]
            cells = "".join(f" {1e3 * t:.3g} ms | {e:.1e} |" for t, e in zip(medians, errors, strict=True))
            lines.append(f"| {case.name} | {tolerance:.0e} |{cells}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/methods.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs/methods.md, the plot beside it")
    parser.add_argument("--explicit", action="store_true", help="compare explicit methods only, for docs/methods.md")
    parser.add_argument("--rounds", type=int, default=3, help="samples of each measure")
    options = parser.parse_args()
    motions = cases()
    if options.explicit:
        text = explicit([motions[0], motions[3], motions[4]], options.rounds)
        replace_in_page(
            DOCS / "methods.md", "explicit", text, "python benchmarks/methods.py --explicit", circumstances()
        )
        return
    results = {case.name: precision(case, options.rounds) for case in motions}
    growths = {case.name: case.growth() for case in motions}
    calls = overhead(motions[0], options.rounds)
    report = {**circumstances(), "results": results, "growths": growths, "calls": calls}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    picture = DOCS / "methods.svg" if options.docs else options.output.with_suffix(".svg")
    plot(results, picture)
    print(f"Written: {options.output}, {picture}")
    if options.docs:
        replace_in_page(
            DOCS / "methods.md",
            "methods",
            tables(results, growths, calls),
            "python benchmarks/methods.py --docs",
            report,
        )


if __name__ == "__main__":
    main()
