"""Programs that some tests need and that pip does not install, and what C compilers among them make."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest
from filelock import FileLock

import fourbar_codegen as fb
from fourbar_codegen.building import compiler as compilers
from fourbar_codegen.building import toolchain

PACKAGES = {
    "gcc": "gcc",
    "clang": "clang",
    "chromium": "chromium",
    "ffmpeg": "ffmpeg",
    "ffprobe": "ffmpeg",
    "qemu-aarch64": "qemu-user",
    "qemu-arm": "qemu-user",
    "qemu-x86_64": "qemu-user",
    "wasm-ld": "lld wasi-libc libclang-rt-dev-wasm32",
}
"""By whose name Debian installs them."""


def require(program):
    """The program's path; without it the test is skipped, which on CI fails the run (see conftest.py)."""
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed: apt install {PACKAGES[program]}")
    return path


def compile_c(command, sources, output, include=(), environment=None):
    """Compile C, or take what the same compiler made of the same texts before.

    `command` is the compiler with its options, `include` the folders of headers, `environment` more variables.
    """
    digest = hashlib.sha256(repr((_version(tuple(command)), command)).encode())
    beside = {path for source in sources for path in source.parent.glob("*.[ch]")}
    headers = {path for folder in include for kind in ("h", "inc") for path in Path(folder).rglob(f"*.{kind}")}
    for path in (*sources, *sorted(beside | headers)):
        digest.update(f"\0{path.name}\0".encode() + path.read_bytes())
    kept = Path(os.environ["FOURBAR_CODEGEN_CACHE"]) / "c-of-tests" / digest.hexdigest()
    if not kept.exists():
        words = [*command, *(f"-I{folder}" for folder in include), *map(str, sources), "-o", str(output)]
        done = subprocess.run(
            words, capture_output=True, text=True, check=False, env={**os.environ, **(environment or {})}
        )
        assert done.returncode == 0, done.stderr
        kept.parent.mkdir(parents=True, exist_ok=True)
        partial = kept.with_suffix(f".{os.getpid()}")
        shutil.copy(output, partial)
        partial.replace(kept)
    shutil.copy(kept, output)


@cache
def _version(command):
    words = command[:1] if command[1:2] != ("cc",) else command[:2]
    return subprocess.run([*words, "--version"], capture_output=True, text=True, check=True).stdout


def zig_cc(folder, target, sources, *options):
    """Compile and link with zig, which brings other systems' libraries, as strictly as gcc is asked to."""
    compiler = compilers.cross_compiler(target)
    prepare_zig(compiler)
    command = [*compiler.command, "-std=c99", "-g0", "-O2", "-Wall", "-Wextra", "-Werror", *options]
    include = [*sorted({source.parent for source in sources}), fb.get_include()]
    compile_c(command, sources, folder / "out", include, toolchain._zig_folders(compiler, folder))
    return folder / "out"


def prepare_zig(compiler):
    """Let zig compile a system's C library, which takes a minute or two, once for all processes."""
    if not compiler.is_zig:
        return
    kept = Path(os.environ["FOURBAR_CODEGEN_CACHE"]) / "c-of-tests"
    kept.mkdir(parents=True, exist_ok=True)
    done = kept / hashlib.sha256(repr(compiler.command + compiler.flags).encode()).hexdigest()
    with FileLock(f"{done}.lock"), tempfile.TemporaryDirectory() as folder:
        if not done.exists():
            source = Path(folder) / "empty.c"
            source.write_text("int fourbar_empty(void) { return 0; }\n")
            # The C library is compiled for the level of optimization that is asked for, and with or without symbols.
            arguments = ["-g0", "-O2", *compiler.flags, str(source), *compiler.link_flags]
            toolchain._run_compiler(compiler, arguments, Path(folder) / "library")
            done.touch()


def emulator(machine, libraries):
    """A command that runs programs of another processor, with a C library of it from Debian."""
    if not Path("/usr", libraries).is_dir():
        package = "libc6-arm64-cross" if machine == "aarch64" else "libc6-armhf-cross"
        pytest.skip(f"the C library of {libraries} is not installed: apt install {package}")
    return [require(f"qemu-{machine}"), "-L", f"/usr/{libraries}"]


def complaints(message):
    """What a page says, as a list; not what the driver of WebGL says of a browser without a graphics card."""
    return [] if "GPU stall due to ReadPixels" in message else [message]
