"""Sources -> extension module: the only place that runs a compiler."""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fourbar_codegen.errors import BuildError

__all__ = ["build_extension", "get_include", "toolchain"]

PACKAGE = Path(__file__).parent

# Scalar straight-line code stores results that vectorized loops would reload two at a time, which stalls the
# processor: -fno-tree-vectorize takes 10 % off the four-bar's evaluation.
KERNEL_FLAGS = ("-O3", "-fno-tree-vectorize", "-g0")
# The wrapper only passes pointers on; what counts is how long its compilation takes.
WRAPPER_FLAGS = ("-O1", "-g0", "-Wno-unused-function")


def get_include() -> str:
    """The folder of the C headers that generated kernels include.

    Examples
    --------
    >>> import os
    >>> sorted(name for name in os.listdir(get_include()) if name.endswith(".h"))
    ['fourbar_kernel.h', 'fourbar_model.h', 'fourbar_solve.h']
    """
    return str(PACKAGE / "runtime")


def toolchain() -> dict[str, object]:
    """All that changes a compiled module besides the model: this package, Python and the build tools.

    No process is started: a compiler is known by its path, size and date.
    """
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    return {
        "package": _package_digest(),
        "python": f"{sys.implementation.cache_tag} {sysconfig.get_config_var('EXT_SUFFIX')}",
        "versions": {name: version(name) for name in ("numpy", "sympy", "cython")},
        "compiler": compiler,
        "compiler file": _file_identity(shutil.which(compiler[0])),
        "flags": [*KERNEL_FLAGS, *_machine_flags(), *WRAPPER_FLAGS],
        "environment": {name: os.environ.get(name, "") for name in ("CFLAGS", "CPPFLAGS", "LDFLAGS", "LDSHARED")},
        "processor": _processor(),
    }


@cache
def _package_digest() -> str:
    """Digest of the package's own sources, so that a change to the generator reaches the cache's keys."""
    digest = hashlib.sha256()
    for path in sorted(p for p in PACKAGE.rglob("*") if p.suffix in {".py", ".h"}):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _file_identity(path: str | None) -> list[object]:
    if path is None:
        return []
    resolved = Path(path).resolve()
    status = resolved.stat()
    return [str(resolved), status.st_size, status.st_mtime_ns]


def _machine_flags() -> tuple[str, ...]:
    """Flags for the machine at hand: what is built here is used here."""
    return ("-march=native",) if platform.machine() in {"x86_64", "AMD64"} and os.name == "posix" else ()


def _processor() -> str:
    """What -march=native stands for; a cache folder may be shared between machines."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        flags = ""
    return f"{platform.machine()} {platform.processor()} {flags.strip()}"


def build_extension(name: str, sources: Mapping[str, str], folder: Path) -> Path:
    """Write sources into a folder and compile them to an extension module there.

    Parameters
    ----------
    name : str
        The module's name; `sources` has ``{name}.pyx`` and ``{name}_kernel.c``.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist.

    Returns
    -------
    Path
        The extension module.

    Raises
    ------
    BuildError
        If the folder cannot be written, or a tool is missing or fails; with the tool's output.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for filename, text in sources.items():
            (folder / filename).write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise BuildError(f"The sources cannot be written to {folder}: {error}.") from error
    wrapper = _cythonize(folder / f"{name}.pyx")
    compiler = _Compiler(folder)
    kernel = folder / f"{name}_kernel.c"
    with ThreadPoolExecutor(2) as pool:
        jobs = [
            pool.submit(compiler.compile, kernel, (*KERNEL_FLAGS, *_machine_flags())),
            pool.submit(compiler.compile, wrapper, WRAPPER_FLAGS),
        ]
        objects = [path for job in jobs for path in job.result()]
    module = compiler.link(objects, name)
    for leftover in (wrapper, *map(Path, objects)):
        leftover.unlink()
    return module


def _cythonize(source: Path) -> Path:
    from Cython.Compiler.Errors import CompileError
    from Cython.Compiler.Main import CompilationOptions, compile_single, default_options

    options = CompilationOptions(default_options, language_level=3, include_path=[get_include()])
    try:
        result = compile_single(str(source), options, source.stem)
    except CompileError as error:
        raise BuildError(f"Cython refused {source}.", output=str(error)) from error
    if result.num_errors or not result.c_file:
        raise BuildError(f"Cython refused {source}; its messages are above.")
    return Path(result.c_file)


class _Compiler:
    """The C compiler that Python's build configuration, or the environment variable CC, names."""

    def __init__(self, folder: Path) -> None:
        from distutils import ccompiler
        from distutils import sysconfig as build_configuration

        import numpy as np
        import setuptools  # noqa: F401  # provides distutils

        self.folder = folder
        compiler: Any = ccompiler.new_compiler()
        build_configuration.customize_compiler(compiler)
        compiler.spawn = _run
        self.compiler = compiler
        self.include = [str(folder), get_include(), np.get_include(), sysconfig.get_path("include")]

    def compile(self, source: Path, flags: Sequence[str]) -> list[str]:
        # Objects go beside their sources; distutils would repeat an absolute path below output_dir.
        return self.compiler.compile(  # type: ignore[no-any-return]
            [str(source)],
            output_dir="/" if source.is_absolute() else "",
            include_dirs=self.include,
            macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
            extra_postargs=list(flags),
        )

    def link(self, objects: Sequence[str], name: str) -> Path:
        target = self.folder / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}"
        self.compiler.link_shared_object(list(objects), str(target))
        return target


def _run(command: Sequence[str], **_: object) -> None:
    """Run a tool; its output becomes part of the error if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise BuildError(
            f"The C compiler {command[0]!r} could not be started: {error.strerror}. Install one (for instance gcc or "
            "clang), or name one in the environment variable CC. Models that are built already go on working.",
            command=command,
        ) from error
    if done.returncode:
        raise BuildError(
            "The C compiler failed.", command=command, exit_code=done.returncode, output=done.stdout + done.stderr
        )
