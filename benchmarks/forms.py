"""The forms of the equations beside each other: dense, sparse, recursive, each that a model has, at a closed state.

All loops are in C. Before anything is timed, the rates of speeds in all forms are compared.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from compile_times import rider
from measure import Loop, circumstances, compare, evaluation_inside_c, options_of, publish
from sympy.physics.mechanics.models import n_link_pendulum_on_cart
from trees import humanoid, joined_arms, revolute_chain
from tutorial import Floats

import fourbar_codegen as fb
from fourbar_codegen.codegen.c_source import header_text, kernel_text
from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.lowering.lower import lower
from fourbar_codegen.lowering.schedule import schedule
from fourbar_codegen.pipeline.compile import generate_kernel

FORMS = ("dense", "sparse", "recursive")
FLAGS = ("-O2", "-fpeel-loops", "-fno-tree-vectorize", "-march=native", "-DFB_ONE_MACHINE")
NUMBER = 20_000
"""Evaluations of one measurement."""


def legs(count: int) -> fb.Model:
    """Theo Jansen's legs around one crank, each turned against the one before: https://www.strandbeest.com/explains."""
    leg = {
        "G": (-38.0, -7.8), "A": (15.0, 0.0), "C": (-24.013535097127793, 31.272097454842683),
        "E": (-74.79436538093606, 8.143170205896139), "D": (-26.952107031572965, -45.51517017008116),
        "F": (-59.23151496141502, -28.052930230747776), "H": (-43.1601105241047, -91.75693292612323),
    }  # fmt: skip
    points: dict[str, tuple[float, float]] = {"O": (0.0, 0.0)}
    ground, crank, links = ["O"], ["O"], []
    for i in range(count):
        c, s = math.cos(2.0 * math.pi * i / count), math.sin(2.0 * math.pi * i / count)
        points |= {f"{name}{i}": ((c * x - s * y) / 100.0, (s * x + c * y) / 100.0) for name, (x, y) in leg.items()}
        links += [[f"{name}{i}" for name in link] for link in ("AC", "AD", "GCE", "GD", "EF", "FDH")]
        ground.append(f"G{i}")
        crank.append(f"A{i}")
    linkage = fb.Linkage(
        f"legs_{count}", points=points, ground=ground, links=[crank, *links], density=1.0, gravity=9.81
    )
    return linkage.model()


def pendulum(links: int) -> fb.Model:
    kane = n_link_pendulum_on_cart(links, cart_force=False)
    symbols = sorted(kane.forcing_full.free_symbols | kane.mass_matrix_full.free_symbols, key=str)
    values = {symbol: 0.5 + 0.1 * i for i, symbol in enumerate(s for s in symbols if str(s) != "t")}
    return fb.Model(kane, name=f"pendulum_{links}", parameters=values)


def seated(model: fb.CompiledModel) -> Floats:
    """The state in which the rider's loops are closed, see examples/09_rider_on_a_bicycle.py."""
    n_q, n_u = (model.manifest[f"n_dependent_{kind}"] for kind in ("coordinates", "speeds"))
    joints = [f"{side}_{joint}_flexion" for side in ("left", "right") for joint in ("leg_q_knee", "arm_q_elbow")]
    upright = dict.fromkeys(model.coordinates[:-n_q], 0.0)
    rolling = {**dict.fromkeys(model.speeds[:-n_u], 0.0), "bicycle_u6": -15.0, "bicycle_u4": 0.1}
    return model.initial_state(upright, rolling, bounds=dict.fromkeys(joints, (0.0, 2.6)))


MODELS: Mapping[str, Callable[[], fb.Model]] = {
    "four-bar": fb.models.four_bar,
    "slider-crank": fb.models.slider_crank,
    "bicycle": fb.models.whipple_bicycle,
    "bicycle with a rider (SymBRiM)": rider,
    **{f"chain of {n} links in the plane": functools.partial(fb.models.chain, n) for n in (4, 8, 32)},
    **{f"closed chain of {n} links": functools.partial(fb.models.chain, n, closed=True) for n in (8, 12, 16, 32)},
    **{f"chain of {n} links in space": functools.partial(revolute_chain, n) for n in (8, 32)},
    **{f"pendulum of {n} links on a cart (SymPy)": functools.partial(pendulum, n) for n in (8, 16)},
    "humanoid, floating base, 30 joints": humanoid,
    "4 arms of 8 links, 3 loops": joined_arms,
    **{f"{n} four-bars side by side": functools.partial(fb.models.n_four_bar, n) for n in (2, 5, 20, 36)},
    "Jansen's leg": functools.partial(legs, 1),
    **{f"{n} of Jansen's legs on one crank": functools.partial(legs, n) for n in (2, 4, 6, 12)},
}


def state_of(model: fb.CompiledModel) -> Floats:
    """A state in which loops are closed; that of a tree is random."""
    if model.name == "rider":
        return seated(model)
    if model.n_c == 0:
        return np.random.default_rng(1).uniform(-0.5, 0.5, model.n_x)
    independent = model.speeds[: model.n_u - model.manifest["n_dependent_speeds"]]
    return model.initial_state(speeds=dict.fromkeys(independent, 0.1))


def rows(rounds: int) -> list[dict[str, Any]]:
    found = []
    for title, make in MODELS.items():
        if "SymBRiM" in title and not find_spec("symbrim"):
            print("SymBRiM is not installed, so its rider is left out: pip install symbrim", flush=True)
            continue
        model = make()
        with Progress("") as progress:
            generated = generate_kernel(model, progress)
        compiled = fb.compile_model(model)
        x = state_of(compiled)
        p = [float(model.parameters[name].value) for name in compiled.parameters]
        row: dict[str, Any] = {"model": title, "speeds": len(model.speeds), "constraints": compiled.n_c}
        row["form"] = generated.scheduled.program.form
        loops: dict[str, Loop] = {}
        for form in FORMS:
            try:
                scheduled = schedule(lower(model.name, generated.equations, form))
            except ModelError:
                continue  # not one of this model's
            texts = {
                f"{model.name}_kernel.c": kernel_text(scheduled, generated.names),
                f"{model.name}_kernel.h": header_text(scheduled, generated.names),
            }
            loops[form] = evaluation_inside_c(model.name, texts, "rhs", 0.5, x, p, FLAGS, NUMBER)
        sums = [loop.run()[1] for loop in loops.values()]
        np.testing.assert_allclose(sums, sums[0], rtol=1e-8)
        row |= dict(zip(loops, compare(*loops.values(), rounds=rounds), strict=True))
        found.append(row)
        print(row, flush=True)
    return found


def table(found: Sequence[Mapping[str, Any]]) -> str:
    lines = [
        f"| model | speeds | constraints | {' | '.join(FORMS)} | printed | against the fastest |",
        "|---|---|---|" + "---|" * (len(FORMS) + 2),
    ]
    for row in found:
        times = [f"{1e6 * row[form]:.3g} us" if form in row else "" for form in FORMS]
        ratio = row[row["form"]] / min(row[form] for form in FORMS if form in row)
        cells = (row["model"], row["speeds"], row["constraints"], *times, row["form"], f"{ratio:.2f}")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def main() -> None:
    options = options_of(__doc__)
    found = rows(options.rounds)
    publish(options, "forms", table(found), {**circumstances(("symbrim",)), "forms": found})


if __name__ == "__main__":
    main()
