"""Code, memory and stack of C libraries, for those who have few of them: the table of docs/howto/c_library.md.

Code is what the sections of the objects take, of instructions and constants; the stack is filled before a call, and
looked at after it. Nothing else is needed: the libraries allocate nothing.
"""

from __future__ import annotations

import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from measure import DOCS, circumstances, options_of, publish

import fourbar_codegen as fb
from fourbar_codegen import models

FLAGS = ("-std=c99", "-Os", "-fno-asynchronous-unwind-tables", "-fno-unwind-tables")
COMPILERS = {
    "x86_64": ("gcc",),
    "ARM": (sys.executable, "-m", "ziglang", "cc", "-target", "arm-linux-musleabihf", "-mcpu=cortex_a7", "-mthumb"),
}
"""For this machine, and for 32-bit ARM with Thumb instructions and double precision."""

MODELS: dict[str, Callable[[], fb.Model]] = {
    "slider-crank": models.slider_crank,
    "four-bar": models.four_bar,
    "Whipple's bicycle": models.whipple_bicycle,
    "chain of 5, closed": lambda: models.chain(5, closed=True),
    "12 four-bars": lambda: models.n_four_bar(12),
}
"""By what the table calls them."""


def code_of(path: Path) -> int:
    """Bytes of the sections that a program loads from an object in the format ELF."""
    content = path.read_bytes()
    wide = content[4] == 2
    [offset] = struct.unpack_from("<Q" if wide else "<I", content, 40 if wide else 32)
    size, number = struct.unpack_from("<HH", content, 58 if wide else 46)
    sections = (struct.unpack_from("<IIQQQQ" if wide else "<IIIIII", content, offset + k * size) for k in range(number))
    return sum(length for _, kind, flags, _, _, length in sections if flags & 2 and kind != 8)  # loaded, not of zeros


def footprint(model: fb.Model) -> dict[str, int]:
    """Bytes by name, and the number of states."""
    with tempfile.TemporaryDirectory() as temporary:
        folder, name = fb.export_c(model, temporary), model.name
        found = {}
        for machine, compiler in COMPILERS.items():
            for part, file in (("code", ""), ("derivatives", "_derivatives"), ("stiff", "_stiff")):
                built = folder / "built.o"
                subprocess.run([*compiler, *FLAGS, "-c", folder / f"{name}{file}.c", "-o", built], check=True)
                found[f"{part}, {machine}"] = code_of(built)
        program = folder / "footprint"
        sources = [Path(__file__).with_suffix(".c"), folder / f"{name}.c"]
        defined = [f"-DMODEL={name}", "-include", f"{name}.h", f"-I{folder}"]
        linked = ["-Wl,-z,now", "-o", program, "-lm"]  # no stack for binding functions at their first call
        subprocess.run([*COMPILERS["x86_64"], *FLAGS, *defined, *sources, *linked], check=True)
        printed = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    return found | dict(zip(("states", "struct", "step", "simulate"), map(int, printed), strict=True))


def table(found: dict[str, dict[str, int]]) -> str:
    """The table of the page."""
    rows = [
        "| | states | code, ARM | x86_64 | derivatives, ARM | x86_64 | stiff, ARM | x86_64 | struct | step | run |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    code = [f"{part}, {machine}" for part in ("code", "derivatives", "stiff") for machine in ("ARM", "x86_64")]
    columns = (*code, "struct", "step", "simulate")
    for name, each in found.items():
        rows.append(f"| {name} | {each['states']} | {' | '.join(f'{each[c] / 1024:.1f}' for c in columns)} |")
    return "\n".join(rows)


def main() -> None:
    options = options_of(__doc__)
    report = circumstances(["ziglang"]) | {"bytes": {name: footprint(make()) for name, make in MODELS.items()}}
    [gcc, *_] = subprocess.run(["gcc", "-dumpfullversion"], check=True, capture_output=True, text=True).stdout.split()
    report["versions"]["gcc"] = gcc
    publish(options, "footprint", table(report["bytes"]), report, DOCS / "howto" / "c_library.md")


if __name__ == "__main__":
    main()
