"""Other models than the four-bar linkage: evaluation, operations and compile time, by interleaved measurements.

Against `lambdify` with ``cse=True`` and `numpy.linalg.solve` on SymPy's own equations, and against PyDy's Cython
generator with its default solver (NumPy's) where PyDy is installed: ``pip install 'fourbar_codegen[bench]'``.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from measure import (
    DOCS,
    circumstances,
    compare,
    evaluation,
    evaluation_inside_c,
    replace_in_page,
)
from tutorial import Tutorial

import fourbar_codegen as fb

MODELS: dict[str, Callable[[], fb.Model]] = {
    "rolling disc": fb.models.rolling_disc,
    "closed chain of 8 links": lambda: fb.models.chain(8, closed=True),
    "Whipple bicycle": fb.models.whipple_bicycle,
}

PROCESS = """
import sys, time
import sympy.physics.mechanics
sys.path.insert(0, {folder!r})
import {script} as models
model = models.MODELS[{name!r}]()
begin = time.perf_counter()
{statement}
print(time.perf_counter() - begin)
"""

# What each way needs from a System to a function.
COMPILED = "models.fb.compile_model(models.read_again(model))"
LAMBDIFIED = "models.Tutorial(model.system, {s: 1.0 for s in model.parameter_symbols}, {})"


def read_again(model: fb.Model) -> fb.Model:
    """A new Model from the System of another one, where the measured compile time begins."""
    return fb.Model(model.system, name=model.name, parameters=model.parameter_symbols)


def in_fresh_process(name: str, statement: str, *, cold: bool, script: str = "models") -> Callable[[], float]:
    """A measure of the time from a System to a function that evaluates its right-hand side."""
    kept = tempfile.mkdtemp()
    code = PROCESS.format(folder=str(Path(__file__).parent), script=script, name=name, statement=statement)

    def measure() -> float:
        cache = tempfile.mkdtemp() if cold else kept
        environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": cache}
        command = [sys.executable, "-W", "ignore", "-c", code]
        return float(subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout)

    if not cold:
        measure()
    return measure


def pydy_function(reference: Tutorial) -> Callable[[float, Any], Any]:
    """PyDy's Cython right-hand side, in the order (t, x)."""
    from pydy.codegen.ode_function_generators import generate_ode_function

    system = reference.system
    function = generate_ode_function(
        system.forcing_full,
        system.q[:],
        system.u[:],
        list(reference.p),
        mass_matrix=system.mass_matrix_full,
        generator="cython",
        constants_arg_type="array",
    )
    constants = np.array(reference.p_values)
    return lambda t, x: function(x, t, constants)


def measure_model(name: str, rounds: int) -> dict[str, Any]:
    model = MODELS[name]()
    values = {symbol: float(parameter.value) for symbol, parameter in model.parameter_symbols.items()}
    reference = Tutorial(model.system, values, {})
    compiled = fb.compile_model(model)
    x = compiled.initial_state({"q3": 0.4} if name == "rolling disc" else None)
    np.testing.assert_allclose(compiled.rhs(0.5, x), reference.rhs(0.5, x), rtol=1e-6, atol=1e-6)
    measures = [evaluation(reference.rhs, x, 200), evaluation(compiled.rhs, x, 5000)]
    if find_spec("pydy"):
        measures.append(evaluation(pydy_function(reference), x, 1000))
    lambdified, own, *pydy = compare(*measures, rounds=rounds)
    sources, p = fb.generate_sources(model), values.values()
    inside = functools.partial(evaluation_inside_c, model.name, sources, t=0.5, x=x, p=p, flags=["-march=native"])
    whole, forming = compare(inside(function="rhs"), inside(function="dynamics"), rounds=rounds)
    operations = compiled.manifest["operations"]["dynamics"]
    cold = [in_fresh_process(name, statement, cold=True) for statement in (LAMBDIFIED, COMPILED)]
    slow, fast = compare(*cold, rounds=3)
    (warm,) = compare(in_fresh_process(name, COMPILED, cold=False), rounds=3)
    return {
        "model": name,
        "lambdify us": lambdified * 1e6,
        "PyDy us": pydy[0] * 1e6 if pydy else None,
        "compiled us": own * 1e6,
        "against lambdify": lambdified / own,
        "against PyDy": pydy[0] / own if pydy else None,
        "operations": operations,
        "inside C ns": whole * 1e9,
        "forming inside C ns": forming * 1e9,
        "ns per operation": forming * 1e9 / operations,
        "SymPy to function s": slow,
        "System to module s": fast,
        "warm s": warm,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/models.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/benchmarks.md as well")
    parser.add_argument("--rounds", type=int, default=11, help="samples of each evaluation")
    options = parser.parse_args()
    if not find_spec("pydy"):
        print("PyDy is not installed: pip install 'fourbar_codegen[bench]'")
    rows: list[dict[str, Any]] = []
    for name in MODELS:
        rows.append(measure_model(name, options.rounds))
        print(json.dumps(rows[-1]), flush=True)
    lines = [
        "| | lambdify | PyDy, Cython | compiled | ratios | inside C | operations | lambdify in | compiled in | warm |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        pydy = f"{row['PyDy us']:.3g} us" if row["PyDy us"] else ""
        ratios = f"{row['against lambdify']:.3g}" + (f", {row['against PyDy']:.3g}" if pydy else "")
        lines.append(
            f"| {row['model']} | {row['lambdify us']:.3g} us | {pydy} | {row['compiled us']:.3g} us | {ratios} | "
            f"{row['inside C ns']:.3g} ns, {row['forming inside C ns']:.3g} ns, "
            f"{row['ns per operation']:.2g} ns | "
            f"{row['operations']} | {row['SymPy to function s']:.3g} s | {row['System to module s']:.3g} s | "
            f"{row['warm s']:.2g} s |"
        )
    report = circumstances() | {"rounds": options.rounds, "rows": rows}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    print("\n".join([*lines, f"Written: {options.output}"]))
    if options.docs:
        text = (
            "One evaluation called from Python: `lambdify` with `numpy.linalg.solve`, PyDy's Cython generator with\n"
            "its default solver, and the compiled model, with the ratios of both to it. Inside C (`-march=native`):\n"
            "one evaluation, the forming of q', M, f, J and gamma in it, and the latter per operation. Operations\n"
            "are those of forming; a sine counts as one. Times are from the System to a function that evaluates it\n"
            "(warm: from the cache).\n\n"
        )
        replace_in_page(
            DOCS / "benchmarks.md", "models", text + "\n".join(lines), "python benchmarks/models.py --docs", report
        )


if __name__ == "__main__":
    main()
