"""Sources -> extension module: the only place that runs a compiler, or another tool."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as distribution_version
from importlib.util import find_spec
from pathlib import Path

from fourbar_codegen.errors import BuildError
from fourbar_codegen.files import replacing

__all__ = [
    "build_batch_functions",
    "build_extension",
    "cache_key",
    "copied",
    "get_include",
    "run_tool",
    "toolchain",
    "write_sources",
]

PACKAGE = Path(__file__).parents[1]

# Position-independent code without debugging information, which would double the file.
COMMON_FLAGS = ("-fPIC", "-g0")
# Scalar straight-line code stores results that vectorized loops would reload two at a time, which stalls the
# processor: -fno-tree-vectorize takes 10 % off the four-bar's evaluation.
KERNEL_FLAGS = (*COMMON_FLAGS, "-O3", "-fno-tree-vectorize")
# States side by side need short loops unrolled, which -O2 leaves out, and nothing else of -O3.
BATCH_FLAGS = (*COMMON_FLAGS, "-O2", "-fpeel-loops", "-fno-tree-vectorize")
# What the compiler does beyond -O1 takes it half as long again, for a few per cent of long straight-line code.
DERIVATIVES_FLAGS = (*COMMON_FLAGS, "-O1")
# Behind the user's flags: a kernel has to notice what is not a number, and so have integrators.
STRICT_FLAGS = ("-fno-fast-math", "-fno-finite-math-only", "-fno-unsafe-math-optimizations")
# With such flags, compilers also link code that takes denormal numbers for zero, in the whole process that loads it.
# Another -O takes the place of -Ofast, which is one of them.
STRICT_LINK_FLAGS = ("-O2", *STRICT_FLAGS)
# For what is built on the machine that it is used on.
MACHINE_FLAGS = ("-march=native",) if platform.machine() == "x86_64" else ()
# The wrapper only passes pointers on; what counts is how long its compilation takes.
WRAPPER_FLAGS = (*COMMON_FLAGS, "-O1", "-DNPY_NO_DEPRECATED_API=NPY_1_7_API_VERSION")


def get_include() -> str:
    """The folder of the C headers that generated kernels include.

    Examples
    --------
    >>> import os
    >>> "fourbar_kernel.h" in os.listdir(get_include())
    True
    """
    return str(PACKAGE / "runtime")


def toolchain() -> dict[str, object]:
    """All that changes a compiled module besides the model: this package, Python and the build tools.

    No process is started: a compiler is known by its path, size and date, Cython by the file that holds its
    version.
    """
    import numpy as np

    cython = find_spec("Cython")
    compiler = _compiler()
    return {
        "package": _package_digest(),
        "python": f"{sys.implementation.cache_tag} {sysconfig.get_config_var('EXT_SUFFIX')}",
        "numpy": np.__version__,
        "sympy": _sympy_version(),
        "cython": _digest([Path(cython.origin).with_name("Shadow.py")]) if cython and cython.origin else "",
        "compiler": compiler,
        "compiler file": _file_identity(shutil.which(compiler[0])),
        "flags": [
            KERNEL_FLAGS,
            BATCH_FLAGS,
            DERIVATIVES_FLAGS,
            STRICT_LINK_FLAGS,
            WRAPPER_FLAGS,
            MACHINE_FLAGS,
            _user_flags("CFLAGS"),
            _link_flags(),
        ],
        "processor": _processor(),
    }


def cache_key(source: object) -> str:
    """The key in the cache of what is built from a source by this toolchain, for this machine.

    Parameters
    ----------
    source : object
        A model's fingerprint, or texts; plain data, as JSON has it.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    return hashlib.sha256(json.dumps([source, toolchain()], sort_keys=True).encode()).hexdigest()


def _sympy_version() -> str:
    """Without importing it: what is built from sources does without."""
    try:
        return distribution_version("sympy")
    except PackageNotFoundError:
        return ""


def _compiler() -> list[str]:
    """The C compiler: the environment's, or the one that Python was built with."""
    return _user_flags("CC") or shlex.split(sysconfig.get_config_var("CC") or "cc")


def _link_flags() -> list[str]:
    """How to link an extension module on this system: what Python's own build adds to its compiler."""
    command = shlex.split(sysconfig.get_config_var("LDSHARED") or "cc -shared")
    own = shlex.split(sysconfig.get_config_var("CC") or "cc")
    flags = command[len(own) :] if command[: len(own)] == own else command[1:]
    return [*flags, *_user_flags("LDFLAGS")]


def _user_flags(variable: str) -> list[str]:
    try:
        return shlex.split(os.environ.get(variable, ""))
    except ValueError as error:
        text = os.environ[variable]
        raise BuildError(f"The environment variable {variable} cannot be read: {error}, in {text!r}.") from error


@cache
def _package_digest() -> str:
    """Digest of the package's own sources, so that a change to the generator reaches the cache's keys."""
    return _digest(sorted(path for path in PACKAGE.rglob("*") if path.suffix in {".py", ".h"}))


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _file_identity(path: str | None) -> list[object]:
    if path is None:
        return []
    resolved = Path(path).resolve()
    status = resolved.stat()
    return [str(resolved), status.st_size, status.st_mtime_ns]


def _processor() -> str:
    """What -march=native stands for; a cache folder may be shared between machines."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        flags = ""
    return f"{platform.machine()} {platform.processor()} {flags.strip()}"


def build_extension(
    name: str,
    sources: Mapping[str, str],
    folder: Path,
    *,
    portable: bool,
    check: Callable[[Path], None] | None = None,
) -> Path:
    """Write sources into a folder and compile them to an extension module there.

    Parameters
    ----------
    name : str
        The module's name; `sources` has ``{name}.pyx``, ``{name}_kernel.c`` and ``{name}_derivatives.c``.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist; it is touched only when all has been built.
    portable : bool
        Whether the module may be used on another machine of the same kind. If not, `build_batch_functions` makes the
        rest of it.
    check : callable, optional
        Called with the module before it comes to the folder, where it does not come if this raises.

    Returns
    -------
    Path
        The extension module.

    Raises
    ------
    BuildError
        If the folder cannot be written, or a tool is missing or fails; with the tool's output.
    """
    with tempfile.TemporaryDirectory() as temporary:
        module = _build(name, sources, Path(temporary), portable=portable)
        if check is not None:
            check(module)
        write_sources(name, sources, folder)
        return copied(module, folder)


def copied(built: Path, folder: Path) -> Path:
    """A built file in a folder of the user's; a module that a process has loaded does not change under its feet."""
    target = folder / built.name
    try:
        with replacing(target) as file, built.open("rb") as source:
            shutil.copyfileobj(source, file)
    except OSError as error:
        raise BuildError(f"{target} cannot be written: {error.strerror or error}.") from error
    return target


def write_sources(name: str, sources: Mapping[str, str], folder: Path) -> None:
    """Write a model's sources in the place of those that another one of its name may have left.

    Parameters
    ----------
    name : str
        The model's.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist.

    Raises
    ------
    BuildError
        If the folder cannot be written.
    """
    try:
        for filename, text in sources.items():
            with replacing(folder / filename) as file:
                file.write(text.encode("utf-8"))
        batch = f"{name}_batch.c"
        if batch not in sources:  # not every model has that one
            (folder / batch).unlink(missing_ok=True)
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror or error}.") from error


def build_batch_functions(name: str, sources: Mapping[str, str], folder: Path) -> Path:
    """Compile a model's functions for several states side by side, for this machine alone.

    Compilers take as long for them as for all the rest, and only batches and ensembles need them.

    Parameters
    ----------
    name : str
        The model's.
    sources : mapping of str to str
        Text by file name, as for `build_extension`.
    folder : Path
        Where the library comes.

    Returns
    -------
    Path
        A shared library that has the ``fb_batch_functions`` named ``{name}_batch_functions``; see ``fourbar_batch.h``.

    Raises
    ------
    BuildError
        If a tool is missing or fails; with the tool's output.
    """
    with tempfile.TemporaryDirectory() as temporary:
        write_sources(name, sources, Path(temporary))
        compiled = _compile(Path(temporary) / f"{name}_batch.c", (*BATCH_FLAGS, *MACHINE_FLAGS))
        return _link([compiled], folder / f"{name}_batch_functions.so")


def _build(name: str, sources: Mapping[str, str], folder: Path, *, portable: bool) -> Path:
    write_sources(name, sources, folder)
    flags = {"_kernel.c": KERNEL_FLAGS, "_derivatives.c": DERIVATIVES_FLAGS}
    if not portable:
        flags = {suffix: (*chosen, "-DFB_ONE_MACHINE", *MACHINE_FLAGS) for suffix, chosen in flags.items()}
    elif f"{name}_batch.c" in sources:
        flags["_batch.c"] = BATCH_FLAGS
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(2) as pool:
        jobs = [pool.submit(_compile, folder / f"{name}{suffix}", chosen) for suffix, chosen in flags.items()]
        wrapper = _compile(_cythonize(folder / f"{name}.pyx"), WRAPPER_FLAGS)
        objects = [*(job.result() for job in jobs), wrapper]
    return _link(objects, folder / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}")


def _link(objects: Iterable[Path], target: Path) -> Path:
    run_tool([*_compiler(), *map(str, objects), *_link_flags(), *STRICT_LINK_FLAGS, "-o", str(target)], target)
    return target


def _cythonize(source: Path) -> Path:
    from Cython.Build import cythonize
    from Cython.Compiler.Errors import CompileError
    from setuptools import Extension

    # By the name of the file alone: folders above may be packages of someone else.
    module = Extension(source.stem, [str(source)])
    try:
        cythonize([module], include_path=[get_include()], language_level=3, force=True, quiet=True)
    except CompileError as error:
        raise BuildError(f"Cython refused {source}; its messages are above.") from error
    return source.with_suffix(".c")


def _compile(source: Path, flags: Sequence[str]) -> Path:
    import numpy as np

    target = source.with_suffix(".o")
    folders = [str(source.parent), get_include(), np.get_include(), sysconfig.get_path("include")]
    include = [word for folder in folders for word in ("-I", folder)]
    run_tool(
        [*_compiler(), *flags, *_user_flags("CFLAGS"), *STRICT_FLAGS, *include, "-c", str(source), "-o", str(target)],
        target,
    )
    return target


def run_tool(command: Sequence[str], target: Path, tool: str = "the C compiler", cwd: Path | None = None) -> None:
    """Run a tool that is to make a file or folder; its output becomes part of the error if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, cwd=cwd)
    except OSError as error:
        raise BuildError(
            f"The C compiler {command[0]!r} could not be started: {error.strerror}. Install one (for instance gcc or "
            "clang), or name one in the environment variable CC. Models that build_model, fourbar build or a wheel has "
            "brought need none: fourbar_codegen.load.",
            command=command,
        ) from error
    if done.returncode or not target.exists():
        name = tool[0].upper() + tool[1:]
        raise BuildError(
            f"{name} failed." if done.returncode else f"{name} made no {target.name}.",
            command=command,
            exit_code=done.returncode,
            output=done.stdout + done.stderr,
        )
