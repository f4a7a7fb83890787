"""Processes that are killed while they compile into a cache, or save: what they leave behind is whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import fourbar_codegen as fb

COMPILE = """
import fourbar_codegen as fb
from builders.systems import slider
print(fb.compile_model(slider()).rhs(0.0, [0.5, 0.1, 0.2, 0.3]).tolist())
"""

SAVE = """
import sys
import fourbar_codegen as fb
runs = [fb.load("four_bar").simulate((0.0, end)) for end in (0.5, 1.0)]
print(flush=True)
while True:
    for run in runs:
        run.save(sys.argv[1])
"""


def case(generator: np.random.Generator, say: Callable[[str], None]) -> None:
    """One process, killed at some moment."""
    with tempfile.TemporaryDirectory() as folder:
        if generator.random() < 0.5:
            compiling(generator, say, Path(folder))
        else:
            saving(generator, say, Path(folder))


def compiling(generator: np.random.Generator, say: Callable[[str], None], folder: Path) -> None:
    """Up to three processes are killed, with their compilers or without; the next one finds or builds the model."""
    environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": str(folder / "cache")}
    command = [sys.executable, "-c", COMPILE]
    for _ in range(generator.integers(1, 4)):
        delay, alone = float(generator.uniform(0.3, 5.0)), generator.random() < 0.5
        say(f"killed {delay:.2f} s after it began to compile, {'alone' if alone else 'with its compiler'}")
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        time.sleep(delay)
        (os.kill if alone else os.killpg)(process.pid, signal.SIGKILL)
        process.wait()
    for _ in range(2):  # built, and found
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        from builders.systems import slider

        expected = fb.compile_model(slider()).rhs(0.0, [0.5, 0.1, 0.2, 0.3])
        np.testing.assert_array_equal(eval(done.stdout), expected)
    names = sorted(path.name for path in (folder / "cache").iterdir())
    assert not [name for name in names if name.endswith(".building")], names


def saving(generator: np.random.Generator, say: Callable[[str], None], folder: Path) -> None:
    """A process saves two runs in turn over each other; the file is one of them, or was not yet there."""
    suffix = str(generator.choice(["csv", "npz", "nc", "html"]))
    path = folder / f"run.{suffix}"
    process = subprocess.Popen(
        [sys.executable, "-c", SAVE, str(path)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout is not None
    process.stdout.readline()
    delay = float(generator.uniform(0.0, 0.5))
    say(f"killed {delay:.3f} s after it began to save {path.name}")
    time.sleep(delay)
    process.kill()
    process.wait()
    process.stdout.close()
    if not path.exists():
        return
    runs = [fb.load("four_bar").simulate((0.0, end)) for end in (0.5, 1.0)]
    if suffix in ("npz", "nc"):
        back = fb.load_trajectory(path)
        assert any(np.array_equal(back.y, run.y) for run in runs)
    else:
        contents = [run.save(folder / f"whole.{suffix}").read_bytes() for run in runs]
        assert path.read_bytes() in contents
