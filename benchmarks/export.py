"""The four-bar exported, in C without Python: steps and runs of its C library and its FMU, beside the package's own.

Every figure is the median of interleaved measurements. All C is compiled by one compiler with the same options.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

from measure import call, circumstances, compare, options_of, publish

import fourbar_codegen as fb

TOLERANCE = 1e-10
FLAGS = ("-O2", "-fpeel-loops", "-fno-tree-vectorize", "-fPIC")


def program(folder: Path) -> Callable[..., Callable[[], float]]:
    """The C program, compiled; a function of its arguments that measures, in seconds."""
    exported = fb.export_c(fb.models.four_bar(), folder / "four_bar")
    built = folder / "exported"
    sources = [exported / "four_bar.c", exported / "four_bar_derivatives.c", Path(__file__).parent / "exported.c"]
    command = [
        os.environ.get("CC", "cc"),
        *FLAGS,
        "-D_POSIX_C_SOURCE=200809L",
        f"-I{exported}",
        f"-I{exported / 'runtime'}",
    ]
    subprocess.run([*command, *map(str, sources), "-o", str(built), "-lm", "-ldl"], check=True)

    def measure(*arguments: object) -> Callable[[], float]:
        words = [str(built), *map(str, arguments)]
        return lambda: 1e-6 * float(subprocess.run(words, check=True, capture_output=True, text=True).stdout)

    return measure


def unpacked(folder: Path) -> tuple[Path, str]:
    """The FMU's binary and token."""
    path = fb.export_fmu(fb.models.four_bar(), folder / "four_bar.fmu")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder / "fmu")
    token = ET.parse(folder / "fmu" / "modelDescription.xml").getroot().attrib["instantiationToken"]
    [library] = (folder / "fmu" / "binaries").rglob("four_bar.*")
    return library, token


def measurements(rounds: int) -> dict[str, float]:
    """Seconds, by name."""
    with tempfile.TemporaryDirectory() as temporary:
        in_c, (library, token) = program(Path(temporary)), unpacked(Path(temporary))
        four_bar = fb.load("four_bar")
        x = four_bar.initial_state()
        stepper = four_bar.stepper(1e-6, x)
        measures = {
            "step, C library": in_c("step", 4),
            "step, the package's C": in_c("stepper"),
            "step, from Python": call(stepper.step),
            "step of order 8, C library": in_c("step", 8),
            "run, C library": in_c("run", TOLERANCE),
            "run, one step of the FMU": in_c("fmu", library, token, TOLERANCE, 1),
            "run, 400 steps of the FMU": in_c("fmu", library, token, TOLERANCE, 400),
            "run, from Python": call(lambda: four_bar.simulate((0.0, 4.0), x, rtol=TOLERANCE, atol=TOLERANCE)),
        }
        return dict(zip(measures, compare(*measures.values(), rounds=rounds), strict=True))


def table(found: dict[str, float]) -> str:
    """The table of the page."""
    step, run = found["step, the package's C"], found["run, from Python"]
    rows = ["| | time | ratio |", "|---|---:|---:|"]
    for name, words, beside in (
        ("step, C library", "a step of order 4 by the C library", step),
        ("step, the package's C", "the same by the package's stepper, in C", step),
        ("step, from Python", "the same, called from Python", step),
        ("step of order 8, C library", "a step of order 8 by the C library", step),
        ("run, C library", "4 s by the C library", run),
        ("run, one step of the FMU", "4 s in one step of the FMU", run),
        ("run, 400 steps of the FMU", "4 s in 400 steps of the FMU", run),
        ("run, from Python", "4 s by `simulate`, from Python", run),
    ):
        rows.append(f"| {words} | {found[name] * 1e6:.3g} us | {found[name] / beside:.2f} |")
    return "\n".join(rows)


def main() -> None:
    options = options_of(__doc__)
    report = circumstances() | {"seconds": measurements(options.rounds)}
    publish(options, "export", table(report["seconds"]), report)


if __name__ == "__main__":
    main()
