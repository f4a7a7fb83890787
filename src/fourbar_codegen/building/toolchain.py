"""Sources -> libraries and extension modules: the only module that runs a compiler or another tool."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cache, partial
from pathlib import Path

from fourbar_codegen.building.cache import tool_folder
from fourbar_codegen.building.compiler import (
    INSTALL,
    Compiler,
    cross_compiler,
    find_compiler,
    program_of,
    user_flags,
    wasm_compiler,
)
from fourbar_codegen.building.flags import (
    COMMON_FLAGS,
    DERIVATIVES_FLAGS,
    KERNEL_FLAGS,
    STRICT_FLAGS,
    STRICT_LINK_FLAGS,
    UNITS,
    WRAPPER_FLAGS,
)
from fourbar_codegen.errors import BuildError
from fourbar_codegen.interface.paths import replacing

__all__ = [
    "build_extension",
    "compile_library",
    "compile_shared",
    "compile_wasm",
    "copied",
    "digest_of",
    "generator",
    "get_include",
    "library_toolchain",
    "run_tool",
    "runtime_headers",
    "wasm_toolchain",
    "write_sources",
]

PACKAGE = Path(__file__).parents[1]


class _Running:
    """The running tools of one task; after a stop, none is started."""

    def __init__(self) -> None:
        self._processes: set[subprocess.Popen[str]] = set()
        self._stopped = False

    def add(self, process: subprocess.Popen[str]) -> None:
        """Add a process that was started."""
        self._processes.add(process)
        if self._stopped:
            _stop(process)

    def discard(self, process: subprocess.Popen[str]) -> None:
        """Remove a process that has ended."""
        self._processes.discard(process)

    def stop(self) -> None:
        """End all processes; those who started them see that they failed."""
        self._stopped = True
        for process in tuple(self._processes):
            _stop(process)


TIME_LIMIT = "FOURBAR_CODEGEN_TIME_LIMIT"
"""The environment variable with the time limit of a tool in seconds; an hour by default."""

MAX_TIMEOUT = 1e6
"""Time limits from this number of seconds on are ignored; poll() counts milliseconds in 32 bits."""

POLL_INTERVAL = 0.5
"""Seconds between checks for interrupts while waiting for tools."""


def get_include() -> str:
    """The folder of the C headers that generated kernels include.

    Examples
    --------
    >>> import os
    >>> "fourbar_kernel.h" in os.listdir(get_include())
    True
    """
    return str(PACKAGE / "runtime")


def runtime_headers() -> dict[str, Path]:
    """The headers below `get_include`, by what sources include; also those that are included several times."""
    folder = Path(get_include())
    found = (path for kind in ("h", "inc") for path in folder.rglob(f"*.{kind}"))
    return {path.relative_to(folder).as_posix(): path for path in sorted(found)}


def library_toolchain() -> dict[str, object]:
    """Everything that a shared library depends on besides the sources: headers, compiler, flags and processor.

    No process is started: a compiler is identified by its path, size and date.
    """
    compiler = find_compiler()
    return {
        "headers": _headers_digest(),
        "compiler": compiler.command,
        "compiler file": _file_identity(program_of(compiler.command[0])),
        "flags": [
            KERNEL_FLAGS,
            DERIVATIVES_FLAGS,
            STRICT_LINK_FLAGS,
            compiler.flags,
            compiler.machine_flags,
            compiler.link_flags,
            user_flags("CFLAGS"),
            user_flags("LDFLAGS"),
        ],
        "processor": _processor(),
    }


def generator() -> dict[str, object]:
    """Everything that a model's sources depend on besides the model: this package and SymPy."""
    return {"package": _package_digest(), "sympy": _sympy_version()}


def digest_of(data: object) -> str:
    """The digest of plain data that JSON can hold: 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _sympy_version() -> str:
    """SymPy's version without importing it, since builds from sources do not need it."""
    sympy = sys.modules.get("sympy")
    if sympy is not None:
        return str(sympy.__version__)
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("sympy")
    except PackageNotFoundError:
        return ""


@cache
def _package_digest() -> str:
    """Digest of the package's Python files, so that a change to the generator changes the models' keys."""
    return _digest(sorted(PACKAGE.rglob("*.py")))


@cache
def _headers_digest() -> str:
    return _digest(runtime_headers().values())


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _file_identity(path: str) -> list[object]:
    """Data that identify a version of a file; empty if there is no file."""
    if not path:
        return []
    try:
        resolved = Path(path).resolve(strict=True)
        status = resolved.stat()
    except FileNotFoundError:
        return []
    return [str(resolved), status.st_size, status.st_mtime_ns]


def _processor() -> str:
    """The meaning of -march=native, since a cache folder may be shared between machines."""
    try:
        with Path("/proc/cpuinfo").open(encoding="utf-8") as file:
            flags = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        flags = ""
    return f"{platform.machine()} {platform.processor()} {flags.strip()}"


def build_extension(
    name: str, sources: Mapping[str, str], folder: Path, *, check: Callable[[Path], None] | None = None
) -> Path:
    """Write sources into a folder and compile them to an extension module there, for other machines of this kind.

    Parameters
    ----------
    name : str
        The module's name; `sources` has ``{name}.pyx`` and the model's sources among `UNITS`.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist; it changes only after a complete build.
    check : callable, optional
        Called with the module before it is moved to the folder; if it raises, the module is discarded.

    Returns
    -------
    Path
        The extension module.

    Raises
    ------
    BuildError
        If the folder cannot be written, or a tool is missing or fails; with the tool's output.
    """
    place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not place.is_dir():  # said before minutes of compilation
        raise BuildError(f"{folder} cannot be written: {place} is no folder.")
    with tempfile.TemporaryDirectory() as temporary:
        module = _build(name, sources, Path(temporary))
        if check is not None:
            check(module)
        write_sources(name, sources, folder, module)
        return folder / module.name


def compile_library(library: Path, sources: Mapping[str, str], units: Mapping[str, Sequence[str]]) -> Path:
    """Compile C sources to a shared library, for this machine alone.

    Parameters
    ----------
    library : Path
    sources : mapping of str to str
        Text by file name.
    units : mapping of str to sequence of str
        The flags of each source to compile.

    Returns
    -------
    Path
        The library.

    Raises
    ------
    BuildError
        If a tool is missing or fails; with the tool's output.
    """
    with tempfile.TemporaryDirectory() as temporary:
        for filename, text in sources.items():
            (Path(temporary) / filename).write_text(text, encoding="utf-8")
        more = ("-DFB_ONE_MACHINE", *find_compiler().machine_flags)
        flags = {Path(temporary) / filename: (*own, *more) for filename, own in units.items()}
        return _link(_concurrently([partial(_compile, *unit) for unit in flags.items()]), library)


def compile_shared(library: Path, folder: Path, sources: Sequence[str], target: str | None = None) -> Path:
    """Compile C sources in a folder to a shared library without Python, for machines of this kind or of another one.

    Only functions that a source marks as visible can be called from outside.

    Parameters
    ----------
    library : Path
    folder : Path
    sources : sequence of str
    target : str, optional
        Another kind of machine, as zig names it.

    Raises
    ------
    BuildError
        If a tool is missing or fails; with the tool's output.
    """
    flags = ("-g0", "-O2", "-std=c99", "-fvisibility=hidden")
    if target is not None:
        compiler = cross_compiler(target)
        words = [*flags, *compiler.flags, *STRICT_FLAGS, *(str(folder / source) for source in sources)]
        return _run_compiler(compiler, [*words, *compiler.link_flags, "-lm"], library)
    own = (*COMMON_FLAGS, *flags, *find_compiler().portable_flags)
    jobs = [partial(_compile, folder / source, own) for source in sources]
    return _link([*_concurrently(jobs), Path("-lm")], library)


WASM_FLAGS = ("-g0", "-O2", "-std=c11", "-fvisibility=hidden")


def wasm_toolchain() -> dict[str, object]:
    """Everything that a module of WebAssembly depends on besides the sources.

    Raises
    ------
    BuildError
        If there is no compiler of WebAssembly.
    """
    compiler = wasm_compiler()
    return {
        "headers": _headers_digest(),
        "compiler": compiler.command,
        "compiler file": _file_identity(program_of(compiler.command[0])),
        "flags": [WASM_FLAGS, STRICT_FLAGS, compiler.flags, compiler.link_flags],
    }


def compile_wasm(module: Path, folder: Path, source: str) -> Path:
    """Compile a C source in a folder to a module of WebAssembly that asks for nothing outside of itself.

    Parameters
    ----------
    module : Path
    folder : Path
    source : str
        The name of the source.

    Returns
    -------
    Path
        The module.

    Raises
    ------
    BuildError
        If there is no compiler of WebAssembly, or it fails; with its output.
    """
    compiler = wasm_compiler()
    include = [word for place in (str(folder), get_include()) for word in ("-I", place)]
    words = [*compiler.flags, *WASM_FLAGS, *STRICT_FLAGS, *include, str(folder / source), *compiler.link_flags]
    return _run_compiler(compiler, words, module)


def copied(built: Path, folder: Path) -> Path:
    """A copy of a built file in a folder of the user's; a module that a process has loaded is replaced, not changed."""
    target = folder / built.name
    try:
        with replacing(target) as file, built.open("rb") as source:
            shutil.copyfileobj(source, file)
    except OSError as error:
        raise BuildError(f"{target} cannot be written: {error.strerror or error}.") from error
    return target


def write_sources(name: str, sources: Mapping[str, str], folder: Path, module: Path | None = None) -> None:
    """Write a model's sources, replacing those of an earlier model of its name.

    All are written before the first is replaced.

    Parameters
    ----------
    name : str
        The model's.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist.
    module : Path, optional
        The module built from them, to put beside them.

    Raises
    ------
    BuildError
        If the folder cannot be written.
    """
    contents = {filename: text.encode("utf-8") for filename, text in sources.items()}
    if module is not None:
        contents[module.name] = module.read_bytes()
    try:
        with ExitStack() as stack:
            for filename, content in contents.items():
                file = stack.enter_context(replacing(folder / filename))
                file.write(content)
                file.flush()
        for suffix in UNITS:
            if f"{name}{suffix}" not in sources:  # not every model has all of them
                (folder / f"{name}{suffix}").unlink(missing_ok=True)
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror or error}.") from error


def _build(name: str, sources: Mapping[str, str], folder: Path) -> Path:
    write_sources(name, sources, folder)
    more = find_compiler().portable_flags
    flags = {folder / f"{name}{s}": (*own, *more) for s, own in UNITS.items() if f"{name}{s}" in sources}

    def compile_wrapper(running: _Running) -> Path:
        return _compile(_cythonize(folder / f"{name}.pyx"), (*WRAPPER_FLAGS, *more), running, _python_folders())

    objects = _concurrently([compile_wrapper, *(partial(_compile, *unit) for unit in flags.items())])
    return _link(objects, folder / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}")


def _concurrently(jobs: Sequence[Callable[[_Running], Path]]) -> list[Path]:
    """The results of jobs, run two at a time; if one fails, the tools of the others are stopped."""
    from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

    running = _Running()
    with ThreadPoolExecutor(2) as pool:
        try:
            submitted = [pool.submit(job, running) for job in jobs]
            pending = set(submitted)
            while pending:  # short waits: an interrupt just before a wait is only noticed after it
                done, pending = wait(pending, POLL_INTERVAL, FIRST_COMPLETED)
                for job in done:
                    job.result()
            return [job.result() for job in submitted]
        except BaseException:  # KeyboardInterrupt, for example
            pool.shutdown(wait=False, cancel_futures=True)
            running.stop()
            raise


def _link(objects: Iterable[Path], target: Path) -> Path:
    compiler = find_compiler()
    options = [*compiler.link_flags, *user_flags("LDFLAGS"), *compiler.flags, *STRICT_LINK_FLAGS]
    return _run_compiler(compiler, [*map(str, objects), *options], target)


def _cythonize(source: Path) -> Path:
    from Cython.Build import cythonize
    from Cython.Compiler.Errors import CompileError
    from setuptools import Extension

    # Only the name of the file, since folders above may be other packages.
    module = Extension(source.stem, [str(source)])
    try:
        cythonize([module], include_path=[get_include()], language_level=3, force=True, quiet=True)
    except CompileError as error:
        raise BuildError(f"Cython refused {source}; its messages are above.") from error
    except OSError as error:
        raise BuildError(f"Cython could not translate {source}: {error}.") from error
    return source.with_suffix(".c")


def _python_folders() -> list[str]:
    """The headers that a wrapper needs."""
    import numpy as np

    return [np.get_include(), sysconfig.get_path("include")]


def _compile(source: Path, flags: Sequence[str], running: _Running, folders: Sequence[str] = ()) -> Path:
    include = [word for folder in (str(source.parent), get_include(), *folders) for word in ("-I", folder)]
    compiler = find_compiler()
    options = [*flags, *user_flags("CFLAGS"), *compiler.flags, *STRICT_FLAGS, *include]
    return _run_compiler(compiler, [*options, "-c", str(source)], source.with_suffix(".o"), running)


def _run_compiler(compiler: Compiler, arguments: Sequence[str], target: Path, running: _Running | None = None) -> Path:
    environment = {**os.environ, **_zig_folders(compiler, target.parent)} if compiler.is_zig else None
    tool = f"the C compiler {compiler}"
    run_tool([*compiler.command, *arguments, "-o", str(target)], target, tool, running=running, environment=environment)
    return target


def _zig_folders(compiler: Compiler, once: Path) -> dict[str, str]:
    """Where zig keeps files: the systems' libraries to link against in the cache, the others in a temporary folder."""
    kept = tool_folder("ziglang", digest_of(_file_identity(program_of(compiler.command[0]))))
    return {"ZIG_GLOBAL_CACHE_DIR": str(kept), "ZIG_LOCAL_CACHE_DIR": str(once / "zig-cache")}


def run_tool(
    command: Sequence[str],
    target: Path,
    tool: str,
    *,
    cwd: Path | None = None,
    running: _Running | None = None,
    environment: Mapping[str, str] | None = None,
) -> None:
    """Run a tool that has to make a file or folder; if it fails, its output becomes part of the error.

    It is in `running` as long as it runs, so that another thread can stop it.
    """
    name, limit = tool[0].upper() + tool[1:], _time_limit()
    running = running or _Running()
    try:
        # In a session of its own, since compilers start other programs, which are stopped with them.
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            cwd=cwd,
            env=environment,
            start_new_session=True,
        )
    except OSError as error:
        raise BuildError(
            f"{name} could not be started: {error.strerror}, {command[0]!r}. {INSTALL} Models from build_model, "
            "fourbar build or a wheel need none: use fourbar_codegen.load.",
            command=command,
        ) from error
    running.add(process)
    try:
        output, _ = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired as error:
        _stop(process)
        process.communicate()
        raise BuildError(
            f"{name} has not ended within {limit:g} s and was stopped: the environment variable {TIME_LIMIT} is the "
            "limit, in seconds.",
            command=command,
        ) from error
    except BaseException:
        _stop(process)
        process.communicate()
        raise
    finally:
        running.discard(process)
    if process.returncode or not target.exists():
        raise BuildError(
            f"{name} failed." if process.returncode else f"{name} made no {target.name}.",
            command=command,
            exit_code=process.returncode,
            output=output,
        )


def _time_limit() -> float | None:
    text = os.environ.get(TIME_LIMIT) or "3600"
    try:
        limit = float(text)
    except ValueError:
        limit = 0.0
    if not limit > 0.0:
        raise BuildError(f"The environment variable {TIME_LIMIT} is a positive number of seconds, not {text!r}.")
    return limit if limit < MAX_TIMEOUT else None


def _stop(process: subprocess.Popen[str]) -> None:
    """End a tool, and the programs that it has started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
