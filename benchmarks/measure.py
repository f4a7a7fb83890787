"""Measures taken in turn, so that a busy machine slows all of them alike, and where their tables go."""

from __future__ import annotations

import os
import platform
import statistics
import time
import timeit
from collections.abc import Callable
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

README = Path(__file__).parent.parent / "README.md"


def timed(function: Callable[[], object]) -> float:
    """Seconds of one call."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def evaluation(function: Callable[[float, Any], object], x: Any, number: int) -> Callable[[], float]:
    """A measure of one evaluation, called as an integrator written in Python calls it."""
    timer = timeit.Timer("function(0.5, x)", globals={"function": function, "x": x})
    return lambda: timer.timeit(number) / number


def compare(*measures: Callable[[], float], rounds: int) -> list[float]:
    """Medians of several measures, taken in turn."""
    samples = [[measure() for measure in measures] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*samples, strict=True)]


def circumstances() -> dict[str, Any]:
    """Date, machine and versions."""
    versions = {"python": platform.python_version()}
    for name in ("fourbar_codegen", "sympy", "numpy", "scipy", "cython", "pydy"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
    return {"date": date.today().isoformat(), "machine": machine, "versions": versions}


def replace_in_readme(mark: str, text: str, script: str, report: dict[str, Any]) -> None:
    """Replace what stands between two comments in README.md."""
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    written = f"Written by `python benchmarks/{script} --readme` on {report['date']}; {report['machine']};\n{versions}."
    before, _, rest = README.read_text().partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    README.write_text(f"{before}<!-- {mark} -->\n{text}\n\n{written}\n{end}{after}")
