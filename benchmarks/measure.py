"""Interleaved measurements, so that the load of the machine affects all of them alike; and the tables in the docs."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import tempfile
import time
import timeit
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fourbar_codegen as fb

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROJECT = Path(__file__).parent.parent
README = PROJECT / "README.md"
DOCS = PROJECT / "docs"


def timed(function: Callable[[], object]) -> float:
    """Seconds of one call."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def call(function: Callable[..., object], *arguments: Any) -> Callable[[], float]:
    """A measure of a call; short ones are repeated for 20 ms."""
    function(*arguments)  # the first call may compile
    number = max(1, int(0.02 / timed(lambda: function(*arguments))))

    def repeated() -> None:  # results are not kept, as in typical use
        for _ in range(number):
            function(*arguments)

    return lambda: timed(repeated) / number


def evaluation(function: Callable[[float, Any], object], x: Any, number: int) -> Callable[[], float]:
    """A measure of one evaluation, called as an integrator written in Python calls it."""
    timer = timeit.Timer("function(0.5, x)", globals={"function": function, "x": x})
    return lambda: timer.timeit(number) / number


@dataclass(frozen=True)
class Loop:
    """A C program that calls a kernel in a loop; called, it is the measure of one evaluation.

    Attributes
    ----------
    command : tuple of str
    """

    command: tuple[str, ...]

    def run(self) -> tuple[float, float]:
        """Seconds of one evaluation; and the sum over the loop of the last entry of x', or of the first one of f."""
        printed = subprocess.run(self.command, check=True, capture_output=True, text=True).stdout.split()
        return float(printed[0]), float(printed[1])

    def __call__(self) -> float:
        return self.run()[0]


def evaluation_inside_c(
    name: str,
    sources: Mapping[str, str],
    function: str,
    t: float,
    x: Iterable[float],
    p: Iterable[float],
    flags: Sequence[str],
    number: int = 200_000,
) -> Loop:
    """A measure of a model's kernel called in a loop by a C program: `rhs`, or `dynamics`, forming alone."""
    folder = Path(tempfile.mkdtemp())
    for file, text in sources.items():
        (folder / file).write_text(text)
    program = folder / "inside_c"
    command = [os.environ.get("CC", "cc"), "-O3", "-fno-tree-vectorize", *flags, "-D_POSIX_C_SOURCE=199309L"]
    command += ["-I", fb.get_include(), "-I", str(folder), f"-DKERNEL={name}_kernel"]
    command += ["-include", f"{name}_kernel.h", str(Path(__file__).parent / "inside_c.c")]
    subprocess.run([*command, *map(str, folder.glob("*.c")), "-o", str(program), "-lm"], check=True)
    return Loop((str(program), function, str(number), repr(t), *(repr(float(value)) for value in (*x, *p))))


def compare(*measures: Callable[[], float], rounds: int) -> list[float]:
    """Medians of several measures, by interleaved measurements."""
    samples = [[measure() for measure in measures] for _ in range(rounds)]
    return [statistics.median(column) for column in zip(*samples, strict=True)]


def circumstances(others: Iterable[str] = ()) -> dict[str, Any]:
    """Date, machine and versions, of other packages as well."""
    versions = {"python": platform.python_version()}
    for name in ("fourbar_codegen", "sympy", "numpy", "scipy", "cython", "pydy", *map(str.lower, others)):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}"
    return {"date": date.today().isoformat(), "machine": machine, "versions": versions}


def replace_in_page(page: Path, mark: str, text: str, command: str, report: dict[str, Any]) -> None:
    """Replace the text between two comments in a page, and add the command, date and versions."""
    versions = ", ".join(f"{name} {number}" for name, number in report["versions"].items())
    written = f"Written by `{command}` on {report['date']}; {report['machine']};\n{versions}."
    before, _, rest = page.read_text().partition(f"<!-- {mark} -->\n")
    _, end, after = rest.partition(f"<!-- end of {mark} -->")
    page.write_text(f"{before}<!-- {mark} -->\n{text}\n\n{written}\n{end}{after}")


def options_of(description: str | None) -> argparse.Namespace:
    """The options of a benchmark that makes one table."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--docs", action="store_true", help="write the table into the documentation")
    parser.add_argument("--output", type=Path, help="a JSON file")
    return parser.parse_args()


def publish(
    options: argparse.Namespace, name: str, table: str, report: dict[str, Any], page: Path = DOCS / "benchmarks.md"
) -> None:
    """Print the table of benchmarks/{name}.py, and write it and the report where the options say."""
    print(table)
    if options.docs:
        replace_in_page(page, name, table, f"python benchmarks/{name}.py --docs", report)
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(report, indent=2))


COLORS = (
    "#0b57b0", "#b3261e", "#15703c", "#7c3aed", "#a1460c", "#0e6f7f", "#ad1457", "#5b6470", "#6b5a00", "#3949ab",
    "#8e24aa", "#1c1c1c", "#00695c", "#7b3f00",
)  # fmt: skip
"""Of curves and of their names beside them: on white, each has a contrast of 4.5:1 at least."""

LINE = 0.052
"""Height of a name beside a curve, as a share of the axes' height."""


def name_curves(axes: Any, *, at_right: Callable[[Any], Any] = max) -> None:
    """Write the name of each curve beside its end on the right, in its colour, instead of a legend.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    at_right : callable
        `max`, or `min` where the axis is inverted: which end of a curve is the right one.
    """
    axes.figure.draw_without_rendering()  # places the axes and their limits
    ends = []
    for curve in axes.lines:
        points = [point for point in curve.get_xydata() if all(value == value for value in point)]
        if points:
            end = at_right(points, key=lambda point: point[0])
            ends.append((axes.transAxes.inverted().transform(axes.transData.transform(end)), curve))
    ends.sort(key=lambda pair: pair[0][1])
    heights = [min(max(place[1], 0.0), 1.0) for place, _ in ends]
    # From below, none closer than a line to the one before; then the same from above, where they stick out.
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + LINE)
    top = 1.0
    for i in reversed(range(len(heights))):
        heights[i] = top = min(heights[i], top)
        top -= LINE
    for (place, curve), height in zip(ends, heights, strict=True):
        axes.annotate(
            curve.get_label(), xy=place, xytext=(1.03, height), xycoords="axes fraction", textcoords="axes fraction",
            color=curve.get_color(), fontsize="small", va="center", annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": curve.get_color(), "linewidth": 0.6, "shrinkA": 0, "shrinkB": 2},
        )  # fmt: skip


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure, the same file for the same curves."""
    import matplotlib as mpl

    mpl.rcParams["svg.hashsalt"] = "fourbar_codegen"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={"Date": None})
