"""Runs cases of all kinds in processes of their own and counts what is wrong: ``python -m fuzz.runner``.

A case is known by its kind, a seed and its number: ``python -m fuzz.runner again calls 1 4711`` does one again.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

PROJECT = Path(__file__).parents[2]
PATHS = [PROJECT / name for name in ("tests", "benchmarks", "examples")]
PAGE = PROJECT / "docs" / "robustness.md"

KINDS = {
    "calls": "calls with unusual arguments",
    "mechanisms": "Systems against SymPy's equations",
    "assemblies": "assembly modes, against 60 digits",
    "damage": "damaged files",
    "kills": "killed processes",
}
LONG = {"calls": 100_000, "mechanisms": 1_000, "assemblies": 10_000, "damage": 10_000, "kills": 200}
PATIENCE = {"calls": 60, "mechanisms": 600, "assemblies": 60, "damage": 60, "kills": 300}
"""Seconds after which a case is taken for one that never ends."""
BATCH = {"calls": 500, "mechanisms": 10, "assemblies": 500, "damage": 500, "kills": 10}
"""Cases of a process."""


@dataclass(frozen=True)
class Finding:
    """What a case tried, and what came of it."""

    kind: str
    seed: int
    number: int
    tried: str
    what: str

    @property
    def cause(self) -> str:
        """What findings of one cause have in common: the kind of error, and where in the package it was."""
        lines = [line for line in self.what.splitlines() if re.match(r"\S", line)]
        places = re.findall(r'fourbar_codegen/(\S+?)(?:", line |:)(\d+)', self.what)
        error = next((line for line in reversed(lines) if re.match(r"[\w.]+(Error|Exception)\b|The process", line)), "")
        return f"{error.partition(':')[0]} {':'.join(places[-1]) if places else self.tried.partition(' ')[0]}"

    def __str__(self) -> str:
        again = f"python -m fuzz.runner again {self.kind} {self.seed} {self.number}"
        return f"{again}\n    tried: {self.tried}\n    {self.what.strip().replace(chr(10), chr(10) + '    ')}"


def explore(
    kind: str, seed: int, count: int, environment: dict[str, str] | None = None, workers: int = 1
) -> Iterator[list[Finding]]:
    """What is wrong in the cases 0 to `count` - 1 of a kind, batch by batch, with as many processes at a time."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, PATHS)), **(environment or {})}
    batches = [range(begin, min(begin + BATCH[kind], count)) for begin in range(0, count, BATCH[kind])]
    with ThreadPoolExecutor(workers) as pool:
        yield from pool.map(lambda numbers: list(_batch(kind, seed, numbers, environment)), batches)


def _batch(kind: str, seed: int, numbers: range, environment: dict[str, str]) -> Iterator[Finding]:
    """In one process; in another one behind a case that ended the process."""
    while numbers:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            log = Path(folder) / "log"
            command = [sys.executable, "-m", "fuzz.runner", "work", kind, str(seed), str(numbers.start)]
            command += [str(numbers.stop), str(log)]
            done = subprocess.run(
                command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False
            )
            notes = [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
        yield from (Finding(**note) for note in notes if note["what"])
        if done.returncode == 0:
            return
        if not notes:
            raise RuntimeError(done.stderr.decode(errors="replace"))
        last = notes[-1]
        end = done.stderr[-4000:].decode(errors="replace")
        yield Finding(**{**last, "what": f"{end}\nThe process ended with {done.returncode}."})
        numbers = range(last["number"] + 1, numbers.stop)


def work(kind: str, seed: int, numbers: Iterable[int], log: Path) -> None:
    """Does cases and writes what it is about to do, and what is wrong, to a file, a line each."""
    case = import_module(f"fuzz.{kind}").case
    with log.open("a") as file:
        for number in numbers:
            tried = ""

            def note(tried: str, what: str = "", number: int = number) -> None:
                json.dump(asdict(Finding(kind, seed, number, tried, what)), file)
                file.write("\n")
                file.flush()

            def say(text: str) -> None:
                nonlocal tried
                tried = text
                note(text)

            note("")
            faulthandler.dump_traceback_later(PATIENCE[kind], exit=True)
            try:
                case(np.random.default_rng([seed, number]), say)
            except Exception:
                note(tried, traceback.format_exc())
    faulthandler.cancel_dump_traceback_later()


def sanitized(folder: Path) -> dict[str, str]:
    """Builds the package with sanitizers into a folder; the environment in which it is used, kernels likewise.

    Sanitizers end a process at the first error. Leaks are not looked for: the interpreter has some of its own.
    """
    flags = "-O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer"
    source = folder / "source"
    names = ("src", "generated", "setup.py", "pyproject.toml", "README.md", "LICENSE")
    source.mkdir()
    for name in names:
        path = PROJECT / name
        skipped = shutil.ignore_patterns("*.so", "__pycache__", "*.egg-info")
        shutil.copytree(path, source / name, ignore=skipped) if path.is_dir() else shutil.copy(path, source / name)
    environment = {"CFLAGS": flags, "LDFLAGS": "-fsanitize=address,undefined"}
    command = [sys.executable, "setup.py", "build_ext", "--inplace"]
    subprocess.run(command, cwd=source, env={**os.environ, **environment}, check=True, capture_output=True)
    libraries = [
        subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True).stdout.strip()
        for name in ("libasan.so", "libubsan.so", "libstdc++.so")
    ]
    return {
        **environment,
        "CFLAGS": flags.replace(
            "-O1", "-O0"
        ),  # kernels, which run for a moment: half the time goes into compiling them
        "LD_PRELOAD": ":".join(libraries),
        # Without the stacks of allocations, which take a sixth of the time.
        "ASAN_OPTIONS": "detect_leaks=0:handle_segv=1:malloc_context_size=0:quarantine_size_mb=16",
        "UBSAN_OPTIONS": "print_stacktrace=1",
        "PYTHONPATH": os.pathsep.join(map(str, [source / "src", *PATHS])),
    }


def table(seed: int, counts: dict[str, int], found: dict[str, list[Finding]], sanitizers: dict[str, str]) -> str:
    """The figures, for the page."""
    rows = ["| | cases | seed | sanitizers | findings | causes |", "|---|---|---|---|---|---|"]
    for kind, count in counts.items():
        causes = len({finding.cause for finding in found[kind]})
        rows.append(f"| {KINDS[kind]} | {count:,} | {seed} | {sanitizers[kind]} | {len(found[kind])} | {causes} |")
    return "\n".join(rows)


def main() -> None:
    """Of the command line."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.runner", description=__doc__)
    commands = parser.add_subparsers(required=True, dest="command")
    long = commands.add_parser("run", help="many cases of all kinds")
    for kind, count in LONG.items():
        long.add_argument(f"--{kind}", type=int, default=count, metavar="N", help=f"{KINDS[kind]} ({count})")
    long.add_argument("--seed", type=int, default=1)
    long.add_argument("--docs", action="store_true", help=f"write the figures into {PAGE.name}")
    once = commands.add_parser("again", help="one case, in this process")
    worker = commands.add_parser("work", help="what the others start")
    for command, names in ((once, ("seed", "number")), (worker, ("seed", "first", "last"))):
        command.add_argument("kind", choices=KINDS)
        for name in names:
            command.add_argument(name, type=int)
    worker.add_argument("log", type=Path)
    options = parser.parse_args()
    if options.command == "work":
        work(options.kind, options.seed, range(options.first, options.last), options.log)
    elif options.command == "again":
        case = import_module(f"fuzz.{options.kind}").case
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            case(np.random.default_rng([options.seed, options.number]), print)
    else:
        sys.exit(_run(options))


def _run(options: argparse.Namespace) -> int:
    from measure import circumstances, replace_in_page

    found: dict[str, list[Finding]] = {}
    counts = {kind: getattr(options, kind) for kind in KINDS}
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        plain = {"FOURBAR_CODEGEN_CACHE": f"{folder}/cache"}
        watched = {**plain, **sanitized(Path(folder))}
        # Nothing of ours stays in a process that is killed: sanitizers would only make it slow.
        sanitizers = dict.fromkeys(KINDS, "address, undefined") | {"kills": "none"}
        for kind, count in counts.items():
            environment = watched if sanitizers[kind] != "none" else plain
            found[kind], causes = [], set[str]()
            for done, part in enumerate(explore(kind, options.seed, count, environment, os.cpu_count() or 1), 1):
                found[kind] += part
                for finding in part:
                    if finding.cause not in causes:
                        causes.add(finding.cause)
                        print(finding, "\n", flush=True)
                print(f"{kind}: {min(done * BATCH[kind], count)} of {count}", end="\r", file=sys.stderr, flush=True)
            print(f"{KINDS[kind]}: {count} cases, {len(found[kind])} findings of {len(causes)} causes", flush=True)
    if options.docs:
        text = table(options.seed, counts, found, sanitizers)
        replace_in_page(PAGE, "fuzz", text, "make fuzz", circumstances())
    return 1 if any(found.values()) else 0


if __name__ == "__main__":
    main()
