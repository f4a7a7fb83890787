"""The C compiler: the one in CC, the system's, or clang from the package ziglang."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import sys
import sysconfig
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

from fourbar_codegen.errors import BuildError

__all__ = ["Compiler", "cross_compiler", "find_compiler", "program_of", "user_flags", "wasm_compiler"]

INSTALL = (
    "Install one (gcc or clang, or pip install 'fourbar_codegen[compiler]'), or name one in CC, in quotes where its "
    "path has spaces."
)


OWN_SYMBOLS = ("-Wl,-Bsymbolic",) if sys.platform.startswith(("linux", "freebsd")) else ()
"""Models of the same name have the same symbols. If a process loads libraries with RTLD_GLOBAL, the loader would
resolve both to the first one's."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler that takes the options of gcc.

    Attributes
    ----------
    command : tuple of str
    origin : str
        Where it was found; empty if none was found, and the command is the one that Python was built with.
    flags : tuple of str
        Flags that it always needs.
    machine_flags : tuple of str
        For code that runs on this machine alone.
    portable_flags : tuple of str
        For code that runs on other machines of this kind as well.
    link_flags : tuple of str
        For a shared library that Python may load.
    is_zig : bool
        Whether it is zig, which keeps files of its own in folders given by two environment variables.
    """

    command: tuple[str, ...]
    origin: str
    flags: tuple[str, ...]
    machine_flags: tuple[str, ...]
    portable_flags: tuple[str, ...]
    link_flags: tuple[str, ...]
    is_zig: bool

    def __str__(self) -> str:
        return f"{shlex.join(self.command)} ({self.origin or 'not found'})"


def find_compiler() -> Compiler:
    """The C compiler that is used.

    Raises
    ------
    BuildError
        If an environment variable cannot be read.

    Examples
    --------
    >>> find_compiler().origin
    'the system'
    """
    named = user_flags("CC")
    pythons = shlex.split(sysconfig.get_config_var("CC") or "cc")
    if named:
        return _gnu(named, "the environment variable CC", _pythons_link_flags())
    if program_of(pythons[0]):
        return _gnu(pythons, "the system", _pythons_link_flags())
    for command in ("cc", "gcc", "clang"):
        if program_of(command):
            return _gnu([command], "the system", _own_link_flags())
    zig = _ziglang()
    if zig is not None:
        return _gnu([str(zig), "cc"], "the package ziglang", _own_link_flags())
    return _gnu(pythons, "", _pythons_link_flags())


def cross_compiler(target: str) -> Compiler:
    """The package ziglang as a compiler for other machines, such as ``aarch64-linux-gnu``.

    Raises
    ------
    BuildError
        If it is not installed.
    """
    zig = _ziglang()
    if zig is None:
        raise BuildError(f"To compile for {target}, install ziglang: pip install 'fourbar_codegen[compiler]'.")
    return Compiler(
        (str(zig), "cc", "-target", target),
        "the package ziglang",
        flags=("-fno-sanitize=undefined",),
        machine_flags=(),
        portable_flags=(),
        link_flags=("-shared",),
        is_zig=True,
    )


def wasm_compiler() -> Compiler:
    """A compiler of WebAssembly: the package ziglang, or clang with wasm-ld and a C library for it.

    Raises
    ------
    BuildError
        If there is none.
    """
    zig = _ziglang()
    if zig is None and not (program_of("clang") and program_of("wasm-ld")):
        raise BuildError(
            "A page needs a compiler of WebAssembly: pip install 'fourbar_codegen[page]', or install clang, wasm-ld "
            "and wasi-libc (Debian: apt install clang lld wasi-libc libclang-rt-dev-wasm32)."
        )
    return Compiler(
        (str(zig), "cc") if zig else ("clang",),
        "the package ziglang" if zig else "the system",
        flags=("--target=wasm32-wasi", "-mexec-model=reactor", *(("-fno-sanitize=undefined",) if zig else ())),
        machine_flags=(),
        portable_flags=(),
        # JavaScript lays its arrays behind the heap's beginning. Large models have large matrices on the stack. It is
        # first in memory, as zig has it by itself, so that its overflow is an error.
        link_flags=(
            "-s",
            "-Wl,--export=__heap_base",
            "-Wl,-z,stack-size=8388608",
            *(() if zig else ("-Wl,--stack-first",)),
        ),
        is_zig=zig is not None,
    )


def program_of(command: str) -> str:
    """The path of the program that a command runs; empty if there is none, which is not cached."""
    try:
        return _program(command, os.environ.get("PATH"))
    except FileNotFoundError:
        return ""


@cache  # exceptions are not cached; each folder of PATH may take a millisecond
def _program(command: str, path: str | None) -> str:
    program = shutil.which(command, path=path)
    if program is None:
        raise FileNotFoundError(command)
    return program


def user_flags(variable: str) -> list[str]:
    """The words of an environment variable.

    Raises
    ------
    BuildError
        If it cannot be split into words.
    """
    try:
        return shlex.split(os.environ.get(variable, ""))
    except ValueError as error:
        text = os.environ[variable]
        raise BuildError(f"The environment variable {variable} cannot be read: {error}, in {text!r}.") from error


def _gnu(command: list[str], origin: str, link_flags: list[str]) -> Compiler:
    # zig is clang with other defaults: it compiles for this machine, and checks for undefined behaviour.
    zig = Path(command[0]).stem == "zig" or "ziglang" in command
    native = ("-march=native",) if platform.machine() in {"x86_64", "AMD64"} else ()
    return Compiler(
        tuple(command),
        origin,
        flags=("-fno-sanitize=undefined",) if zig else (),
        machine_flags=() if zig else native,
        portable_flags=("-mcpu=baseline",) if zig else (),
        # Also for linking, since what zig links to every library is compiled for a processor.
        link_flags=(*_own_link_flags(), "-mcpu=baseline", *OWN_SYMBOLS) if zig else (*link_flags, *OWN_SYMBOLS),
        is_zig=zig,
    )


def _pythons_link_flags() -> list[str]:
    """The flags that Python's own build uses to link an extension module."""
    command = shlex.split(sysconfig.get_config_var("LDSHARED") or "cc -shared")
    own = shlex.split(sysconfig.get_config_var("CC") or "cc")
    return command[len(own) :] if command[: len(own)] == own else command[1:]


def _own_link_flags() -> list[str]:
    return ["-shared", *(["-undefined", "dynamic_lookup"] if sys.platform == "darwin" else [])]


def _ziglang() -> Path | None:
    """The program in the package ziglang, if that is installed (https://ziglang.org, https://pypi.org)."""
    spec = find_spec("ziglang")
    folders = map(Path, (spec and spec.submodule_search_locations) or ())
    programs = (folder / ("zig.exe" if os.name == "nt" else "zig") for folder in folders)
    return next((program for program in programs if program.is_file()), None)
