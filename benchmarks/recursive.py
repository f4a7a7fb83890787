"""Chains in the recursive form of the equations beside Pinocchio and MuJoCo.

All loops are in C or C++. Chains are those of benchmarks/engines.py. Before anything is timed, accelerations and
derivatives are compared. benchmarks/forms.py compares the forms.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from engines import CHAINS, address, chain_in_pinocchio, cpu_time, our_functions, pinocchio_functions
from measure import circumstances, compare, options_of, publish
from models import in_fresh_process, read_again
from trees import LINK, revolute_chain
from tutorial import Floats

import fourbar_codegen as fb

__all__ = ["fb", "os", "read_again"]  # what the timed processes need as well

LINKS = (2, 4, 8, 16, 32, 64)
STATES = 100
FLAGS = ("-O2", "-fpeel-loops", "-fno-tree-vectorize", "-march=native", "-DFB_ONE_MACHINE")
TO_MODULE = """
models.os.sched_setaffinity(0, {max(models.os.sched_getaffinity(0))})
models.fb.compile_model(models.read_again(model)).simulate((0.0, 0.1), [0.1] * (2 * len(model.speeds)))
"""


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


# ---- the table


def module_seconds() -> dict[int, float]:
    """From a Model to a module that has simulated, on one core, in a fresh process without a cache."""
    found = {}
    for links in (32, 64):
        measure = in_fresh_process(f"chain of {links} links in space", TO_MODULE, cold=True, script="recursive")
        found[links] = compare(measure, rounds=3)[0]
    return found


def table(chains: Sequence[Mapping[str, Any]], modules: Mapping[int, float]) -> str:
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
        "From a `Model` of a chain in space to a module that has simulated, on one core: "
        + ", ".join(f"{links} links {value:.1f} s" for links, value in modules.items())
        + ".",
    ]
    return "\n".join(lines)


def main() -> None:
    options = options_of(__doc__)
    chains, modules = chain_rows(options.rounds), module_seconds()
    report = {**circumstances(("pin", "mujoco")), "chains": chains, "modules": modules}
    publish(options, "recursive", table(chains, modules), report)


if __name__ == "__main__":
    main()
