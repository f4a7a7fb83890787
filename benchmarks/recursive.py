"""The recursive form of the equations beside Pinocchio and MuJoCo, and beside the dense or sparse form of a model.

All loops are in C or C++. Chains are those of benchmarks/engines.py. The other form of a model is what is generated
where recursions are left out. Before anything is timed, accelerations are compared.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from engines import CHAINS, address, chain_in_pinocchio, cpu_time, our_functions, pinocchio_functions
from measure import circumstances, compare, evaluation_inside_c, options_of, publish
from models import in_fresh_process, read_again
from sympy.physics.mechanics.models import n_link_pendulum_on_cart
from trees import LINK, humanoid, joined_arms, revolute_chain
from tutorial import Floats

import fourbar_codegen as fb
from fourbar_codegen.codegen.c_source import header_text, kernel_text
from fourbar_codegen.compile import generate_kernel
from fourbar_codegen.lowering.lower import lower
from fourbar_codegen.lowering.schedule import schedule
from fourbar_codegen.progress import Progress

__all__ = ["fb", "os", "read_again"]  # what the timed processes need as well

LINKS = (2, 4, 8, 16, 32, 64)
STATES = 100
FLAGS = ("-O2", "-fpeel-loops", "-fno-tree-vectorize", "-march=native", "-DFB_ONE_MACHINE")
TO_MODULE = """
models.os.sched_setaffinity(0, {max(models.os.sched_getaffinity(0))})
models.fb.compile_model(models.read_again(model)).simulate((0.0, 0.1), [0.1] * (2 * len(model.speeds)))
"""


def pendulum(links: int) -> fb.Model:
    kane = n_link_pendulum_on_cart(links, cart_force=False)
    symbols = sorted(kane.forcing_full.free_symbols | kane.mass_matrix_full.free_symbols, key=str)
    values = {symbol: 0.5 + 0.1 * i for i, symbol in enumerate(s for s in symbols if str(s) != "t")}
    return fb.Model(kane, name=f"pendulum_{links}", parameters=values)


def rider() -> fb.Model:
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    example: Any = importlib.import_module("09_rider_on_a_bicycle")
    system = example.rider_on_a_bicycle()
    names = fb.Model(system, inputs="auto").parameters
    return fb.Model(system, name="rider", inputs="auto", parameters=dict.fromkeys(names, 0.7))


MODELS: Mapping[str, Callable[[], fb.Model]] = {
    "pendulum of 8 links on a cart, absolute angles (SymPy)": lambda: pendulum(8),
    "pendulum of 16 links": lambda: pendulum(16),
    "humanoid, floating base, 30 joints": humanoid,
    "bicycle with a rider (SymBRiM)": rider,
    "4 arms of 8 links, 3 loops": joined_arms,
    "chain of 32 links in the plane": lambda: fb.models.chain(32),
    "closed chain of 8 links": lambda: fb.models.chain(8, closed=True),
    "closed chain of 16 links": lambda: fb.models.chain(16, closed=True),
    "closed chain of 32 links": lambda: fb.models.chain(32, closed=True),
    "5 four-bars side by side": lambda: fb.models.n_four_bar(5),
    "20 four-bars side by side": lambda: fb.models.n_four_bar(20),
    "four-bar": fb.models.four_bar,
    "slider-crank": fb.models.slider_crank,
    "chain of 4 links in the plane": lambda: fb.models.chain(4),
    "bicycle": fb.models.whipple_bicycle,
    **{f"chain of {links} links in space": functools.partial(revolute_chain, links) for links in (32, 64)},
}


# ---- chains beside engines


def derivatives_by_ourselves(links: int) -> Callable[[Floats], Floats]:
    functions, p = our_functions(revolute_chain(links)), np.array(LINK)

    def jacobians(states: Floats) -> Floats:
        n = states.shape[1]
        found = np.empty((len(states), n, n))
        functions.differentiate(len(states), address(states), address(p), address(found))
        return found

    return jacobians


def derivatives_by_pinocchio(links: int) -> Callable[[Floats], Floats] | None:
    functions = pinocchio_functions()
    if functions is None:
        return None
    chain = chain_in_pinocchio(functions, links)

    def jacobians(states: Floats) -> Floats:
        found = np.empty((len(states), 2, links, links))
        functions.aba_derivatives(chain, len(states), address(states), address(found))
        return found

    return jacobians


def chain_rows(rounds: int) -> list[dict[str, Any]]:
    """Times in seconds by the size, and the largest differences from ours."""
    rows = []
    engines = [name for name, module in (("Pinocchio", "pinocchio"), ("MuJoCo", "mujoco")) if find_spec(module)]
    for links in LINKS:
        states = np.ascontiguousarray(np.random.default_rng(links).uniform(-1.0, 1.0, (STATES, 2 * links)))
        ways = {
            engine: way
            for engine in ("fourbar_codegen", *engines)
            for name, way in CHAINS[engine](links).items()
            if name.startswith("in C: ")
        }
        expected = ways["fourbar_codegen"].accelerations(states)
        row: dict[str, Any] = {"links": links, "difference": 0.0}
        for way in ways.values():
            row["difference"] = max(row["difference"], relative(way.accelerations(states), expected))
        seconds = compare(*(way.measure(states) for way in ways.values()), rounds=rounds)
        row.update(zip(ways, seconds, strict=True))
        own, other = (
            derivatives_by_ourselves(links),
            derivatives_by_pinocchio(links) if "Pinocchio" in engines else None,
        )
        measures = [cpu_time("function(states)", {"function": own, "states": states}, 1 / STATES)]
        if other is not None:
            lower_half = own(states)[:, links:]
            theirs = other(states).transpose(0, 3, 1, 2).reshape(STATES, links, 2 * links)
            row["difference of derivatives"] = relative(theirs, lower_half)
            measures.append(cpu_time("function(states)", {"function": other, "states": states}, 1 / STATES))
        seconds = compare(*measures, rounds=rounds)
        row.update(zip(("our derivatives", "computeABADerivatives"), seconds, strict=False))
        rows.append(row)
        print(row, flush=True)
    return rows


def relative(found: Floats, expected: Floats) -> float:
    """The largest difference in a state, relative to its largest number."""
    axes = tuple(range(1, expected.ndim))
    return float((np.abs(found - expected).max(axis=axes) / np.abs(expected).max(axis=axes)).max())


# ---- both forms of models


def both_forms(model: fb.Model) -> tuple[tuple[tuple[str, dict[str, str]], tuple[str, dict[str, str]]], int]:
    """The forms without and with recursions, and their sources; the number of constraints."""
    with Progress("") as progress:
        generated = generate_kernel(model, progress)
    scheduled = schedule(lower(model.name, replace(generated.equations, recursion=None)))
    texts = {
        f"{model.name}_kernel.c": kernel_text(scheduled, generated.names),
        f"{model.name}_kernel.h": header_text(scheduled, generated.names),
    }
    kept = {name: text for name, text in generated.sources.items() if name in texts}
    forms = (scheduled.program.form, texts), (generated.scheduled.program.form, kept)
    return forms, len(generated.equations.velocity_bias.entries)


def form_rows(rounds: int) -> list[dict[str, Any]]:
    rows = []
    for title, make in MODELS.items():
        if "SymBRiM" in title and not find_spec("symbrim"):
            print("SymBRiM is not installed, so its rider is left out: pip install symbrim", flush=True)
            continue
        model = make()
        forms, n_c = both_forms(model)
        row: dict[str, Any] = {"model": title, "speeds": len(model.speeds), "constraints": n_c}
        (row["before"], before), (row["form"], after) = forms
        if before == after:
            row["ratio"] = 1.0
        else:
            x = np.random.default_rng(1).uniform(-0.5, 0.5, len(model.coordinates) + len(model.speeds))
            p = [float(model.parameters[name].value or 0.7) for name in model.parameters]
            measures = [
                evaluation_inside_c(model.name, texts, "rhs", 0.5, x, p, FLAGS, number=20000)
                for texts in (before, after)
            ]
            row["seconds without"], row["seconds"] = compare(*measures, rounds=rounds)
            row["ratio"] = row["seconds without"] / row["seconds"]
        rows.append(row)
        print(row, flush=True)
    return rows


# ---- the table


def module_seconds() -> dict[int, float]:
    """From a Model to a module that has simulated, on one core, in a fresh process without a cache."""
    found = {}
    for links in (32, 64):
        measure = in_fresh_process(f"chain of {links} links in space", TO_MODULE, cold=True, script="recursive")
        found[links] = compare(measure, rounds=3)[0]
    return found


def table(chains: Sequence[Mapping[str, Any]], forms: Sequence[Mapping[str, Any]], modules: Mapping[int, float]) -> str:
    ways = [name for name in ("fourbar_codegen", "Pinocchio", "MuJoCo") if name in chains[0]]
    titles = {"fourbar_codegen": "ours", "Pinocchio": "Pinocchio `aba`", "MuJoCo": "MuJoCo `mj_forward`"}
    columns = [*ways, *(key for key in ("our derivatives", "computeABADerivatives") if key in chains[0])]
    heads = [titles.get(key, key.replace("computeABADerivatives", "`computeABADerivatives`")) for key in columns]
    seconds = {row["links"]: row for row in chains}

    def exponent(key: str) -> float:
        return math.log(seconds[64][key] / seconds[16][key]) / math.log(4.0)

    lines = [
        f"Growth from 16 to 64 links, as a power of n: ours {exponent('fourbar_codegen'):.2f}"
        + "".join(f", {titles[way]} {exponent(way):.2f}" for way in ways[1:])
        + ". Accelerations agree to "
        + f"{max(row['difference'] for row in chains):.0e}, derivatives to "
        + f"{max(row.get('difference of derivatives', 0.0) for row in chains):.0e}, relative to the largest.",
        "",
        f"| links | {' | '.join(heads)} |",
        "|---|" + "---|" * len(columns),
        *(f"| {row['links']} | " + " | ".join(f"{1e6 * row[key]:.3g} us" for key in columns) + " |" for row in chains),
        "",
        "| model | speeds | constraints | form, and without recursions | without | with | ratio |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in forms:
        form = row["form"] if row["form"] == row["before"] else f"{row['form']}, {row['before']}"
        times = [f"{1e6 * row[key]:.3g} us" if key in row else "" for key in ("seconds without", "seconds")]
        ratio = f"{row['ratio']:.2f}" if "seconds" in row else "same code"
        lines.append(
            f"| {row['model']} | {row['speeds']} | {row['constraints']} | {form} | {' | '.join(times)} | {ratio} |"
        )
    lines += [
        "",
        "From a `Model` of a chain in space to a module that has simulated, on one core: "
        + ", ".join(f"{links} links {value:.1f} s" for links, value in modules.items())
        + ".",
    ]
    return "\n".join(lines)


def main() -> None:
    options = options_of(__doc__)
    chains, forms, modules = chain_rows(options.rounds), form_rows(options.rounds), module_seconds()
    report = {**circumstances(("pin", "mujoco", "symbrim")), "chains": chains, "forms": forms, "modules": modules}
    publish(options, "recursive", table(chains, forms, modules), report)


if __name__ == "__main__":
    main()
