"""Install the package and extras into a virtual environment, as make does: ``python install.py .venv visual``.

What is needed to compile comes first. The other packages are then installed while the extension modules are compiled,
and a second call compiles nothing unless a source has changed. One line tells each step; none lasts five seconds
without a word.
"""

import os
import subprocess
import sys
import tempfile
import time
from itertools import chain
from pathlib import Path

if sys.version_info < (3, 11):
    sys.exit("Python 3.11 or newer is needed; name one: make PYTHON=python3.12")

import tomllib

SILENCE = 4.0
"""Seconds until a step that goes on says so."""

SOURCES = (
    *("pyproject.toml", "setup.py", "src/fourbar_codegen/runtime/enumerations.py"),
    "src/fourbar_codegen/building/flags.py",
    *(f"src/fourbar_codegen/runtime/**/*.{kind}" for kind in ("pyx", "pxd", "h", "inc")),
)
"""What the extension modules are made of, beside the generated models; Python files are used where they stand."""


def main(*arguments: str) -> None:
    """Bring a virtual environment up to date."""
    if not arguments or arguments[0].startswith("-"):
        sys.exit(
            "python install.py FOLDER [EXTRA ...]: the folder of a virtual environment, and extras of the package."
        )
    folder, *extras = arguments
    if Path(folder).exists() and not Path(folder).is_dir():
        sys.exit(f"{folder} is a file: give the folder of a virtual environment.")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # SymPy would be compiled anew in each process, which takes seconds
    home, begin = Path(__file__).parent, time.monotonic()
    with (home / "pyproject.toml").open("rb") as file:
        described = tomllib.load(file)
    to_compile = described["build-system"]["requires"]
    known_extras = described["project"]["optional-dependencies"]
    if unknown := [extra for extra in extras if extra not in known_extras]:
        sys.exit(f"There is no extra {', '.join(unknown)}: pyproject.toml has {', '.join(known_extras)}.")
    more = (known_extras[extra] for extra in extras)
    wanted = sorted({*described["project"]["dependencies"], *chain.from_iterable(more)})

    venv, record = Path(folder), Path(folder) / "installed"
    known = record.read_text(encoding="utf-8").splitlines() if record.exists() else []
    sources = [*chain.from_iterable(map(home.glob, (*SOURCES, "generated/*/*")))]
    is_compiled = bool(known) and max(path.stat().st_mtime for path in sources) <= record.stat().st_mtime
    missing = [requirement for requirement in wanted if requirement not in known]
    if is_compiled and not missing:
        return
    pip = [str(venv / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "install", "--no-compile"]
    if not (venv / "bin" / "python").exists():
        together({f"a virtual environment in {venv}": [sys.executable, "-m", "venv", str(venv)]})
    steps = {f"packages ({len(missing)} and what they need)": [*pip, *missing]} if missing else {}
    if not is_compiled:
        together({"Cython, NumPy and setuptools": [*pip, *to_compile]})
        steps["extension modules"] = [*pip, "--no-build-isolation", "--no-deps", "--editable", str(home)]
    together(steps)
    record.write_text("\n".join([*known, *missing]) + "\n", encoding="utf-8")
    print(f"Installed in {time.monotonic() - begin:.0f} s.", flush=True)


def together(steps: dict[str, list[str]]) -> None:
    """Run commands at the same time; the output of one that fails is shown, and ends the process."""
    begin = said = time.monotonic()
    running = {}
    for name, command in steps.items():
        output = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process
        running[name] = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT), output
    while running:
        time.sleep(0.05)
        now = time.monotonic()
        for name, (process, output) in [*running.items()]:
            if process.poll() is None:
                continue
            del running[name]
            said = now
            print(f"{name}: {now - begin:.0f} s", flush=True)
            if process.returncode:
                for other, _ in running.values():
                    other.terminate()
                output.seek(0)
                sys.exit(f"{output.read().decode(errors='replace')}\nThis failed: {' '.join(steps[name])}")
        if running and now - said >= SILENCE:
            said = now
            print(f"  {', '.join(running)} ... {now - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
