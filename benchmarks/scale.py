"""Growth of time and operations with the number of bodies: planar and spatial chains, rows of loops.

Closed chains are also measured with SymPy's `form_eoms` and `lambdify` with ``cse=True``, up to the length
``--reference-up-to``: 12 links take SymPy some minutes. Writes a table, JSON and a picture.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from measure import DOCS, circumstances, compare, evaluation, replace_in_page
from models import COMPILED, LAMBDIFIED, in_fresh_process, read_again
from sympy.physics.mechanics.system import System
from tutorial import Tutorial

import fourbar_codegen as fb

__all__ = ["Tutorial", "fb", "read_again", "spherical_chain"]  # what the timed processes need as well


def spherical_chain(bodies: int) -> fb.Model:
    """Bars of different principal inertias on ball joints, one below the other."""
    m, length, g, i_x, i_y, i_z = sm.symbols("m l g i_x i_y i_z")
    ground = me.RigidBody("ground")
    ground.masscenter.set_vel(ground.frame, 0)
    system = System.from_newtonian(ground)
    parent = ground
    for number in range(bodies):
        body = me.RigidBody(f"bar{number}", mass=m)
        body.inertia = (me.inertia(body.frame, i_x, i_y, i_z), body.masscenter)
        start = -length * parent.frame.z if number else None
        system.add_joints(
            me.SphericalJoint(f"ball{number}", parent, body, parent_point=start, child_point=length * body.frame.z)
        )
        parent = body
    system.apply_uniform_gravity(-g * ground.frame.z)
    values = {m: 1.3, length: 0.4, g: 9.81, i_x: 0.11, i_y: 0.12, i_z: 0.03}
    return fb.Model(system, name=f"spherical_chain_{bodies}", parameters=values)


FAMILIES: dict[str, tuple[Callable[[int], fb.Model], tuple[int, ...]]] = {
    "closed chain, links": (lambda n: fb.models.chain(n, closed=True), (4, 6, 8, 12, 16, 24, 32)),
    "N-four-bar, loops": (fb.models.n_four_bar, (1, 2, 5, 10, 20, 40)),
    "ball joints, bodies": (spherical_chain, (2, 4, 8, 16)),
}
MODELS: dict[str, Callable[[], fb.Model]] = {
    f"{family} {n}": functools.partial(make, n) for family, (make, sizes) in FAMILIES.items() for n in sizes
}


def measure_model(family: str, n: int, *, reference: bool, rounds: int) -> dict[str, Any]:
    name = f"{family} {n}"
    model = MODELS[name]()
    compiled = fb.compile_model(model)
    x = np.random.default_rng(1).uniform(-0.5, 0.5, compiled.n_x)
    own = evaluation(compiled.rhs, x, 20000 // compiled.n_x)
    made = in_fresh_process(name, COMPILED, cold=True, script="scale")
    row: dict[str, Any] = {"family": family, "n": n, "speeds": compiled.n_u}
    row["operations"] = compiled.manifest["operations"]["dynamics"]
    counts = compiled.manifest["operations"].items()
    row["operations of derivatives"] = sum(count for name, count in counts if name.startswith("state_partials"))
    if not reference:
        (row["compiled us"],) = (1e6 * seconds for seconds in compare(own, rounds=rounds))
        (row["to module s"],) = compare(made, rounds=3)
        return row
    values = {symbol: float(parameter.value) for symbol, parameter in model.parameter_symbols.items()}
    tutorial = Tutorial(model.system, values, {})
    expected = tutorial.rhs(0.5, x)
    np.testing.assert_allclose(compiled.rhs(0.5, x), expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    slow = evaluation(tutorial.rhs, x, 50)
    row["compiled us"], row["lambdify us"] = (1e6 * seconds for seconds in compare(own, slow, rounds=rounds))
    made_by_sympy = in_fresh_process(name, LAMBDIFIED, cold=True, script="scale")
    row["to module s"], row["to lambdify s"] = compare(made, made_by_sympy, rounds=1 if n > 8 else 3)
    return row


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Both times over n, with logarithmic axes."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for axis, own, other, label in (
        (axes[0], "to module s", "to lambdify s", "System to function (s)"),
        (axes[1], "compiled us", "lambdify us", "one evaluation from Python (us)"),
    ):
        for family in FAMILIES:
            for key, style, words in ((own, "-o", ""), (other, "--s", ", SymPy and lambdify")):
                points = [(row["n"], row[key]) for row in rows if row["family"] == family and key in row]
                if points:
                    axis.loglog(*zip(*points, strict=True), style, label=family.partition(",")[0] + words)
        axis.set_xlabel("links, loops, bodies")
        axis.set_ylabel(label)
        axis.grid(visible=True, which="both", alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def growth(rows: list[dict[str, Any]], family: str, key: str, begin: int, end: int) -> float:
    """The exponent of n between two sizes."""
    value = {row["n"]: row[key] for row in rows if row["family"] == family}
    return math.log(value[end] / value[begin]) / math.log(end / begin)


def line(row: dict[str, Any]) -> str:
    """A row of the table."""
    cells = [row["family"], row["n"], row["speeds"], f"{row['operations']}, {row['operations of derivatives']}"]
    cells += [f"{row['compiled us']:.3g} us", f"{row['to module s']:.3g} s"]
    if "to lambdify s" in row:
        cells += [f"{row['lambdify us']:.3g} us", f"{row['to lambdify s']:.3g} s"]
        cells += [f"{row['to lambdify s'] / row['to module s']:.3g}"]
    else:
        cells += [""] * 3
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/scale.json"), help="where to write JSON")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/benchmarks.md as well")
    parser.add_argument("--rounds", type=int, default=7, help="samples of each evaluation")
    parser.add_argument("--reference-up-to", type=int, default=12, help="longest closed chain to do with SymPy")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for family, (_, sizes) in FAMILIES.items():
        for n in sizes:
            reference = family.startswith("closed chain") and n <= options.reference_up_to
            rows.append(measure_model(family, n, reference=reference, rounds=options.rounds))
            print(json.dumps(rows[-1]), flush=True)
    lines = [
        "| | n | speeds | operations, of derivatives | evaluation | compiled in | lambdify | made in | ratio |",
        "|---|---|---|---|---|---|---|---|---|",
        *map(line, rows),
    ]
    chain, loops, _ = FAMILIES
    exponents = {
        "compile time, closed chain, 8 to 32 links": growth(rows, chain, "to module s", 8, 32),
        "operations, closed chain, 8 to 32 links": growth(rows, chain, "operations", 8, 32),
        "evaluation, N-four-bar, 10 to 40 loops": growth(rows, loops, "compiled us", 10, 40),
    }
    growths = "; ".join(f"{what}: {power:.2f}" for what, power in exponents.items())
    lines += ["", f"Exponents of the growth with n: {growths}."]
    report = circumstances() | {"rounds": options.rounds, "rows": rows, "growth": exponents}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    picture(rows, options.output.with_suffix(".png"))
    print("\n".join([*lines, f"Written: {options.output}, {options.output.with_suffix('.png')}"]))
    if options.docs:
        replace_in_page(DOCS / "benchmarks.md", "scale", "\n".join(lines), "python benchmarks/scale.py --docs", report)


if __name__ == "__main__":
    main()
