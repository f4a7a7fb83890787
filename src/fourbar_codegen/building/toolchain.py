"""Sources -> libraries and extension modules: the only place that runs a compiler, or another tool."""

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
from fourbar_codegen.building.compiler import INSTALL, Compiler, find_compiler, program_of, user_flags
from fourbar_codegen.errors import BuildError
from fourbar_codegen.files import replacing

__all__ = [
    "COMMON_FLAGS",
    "DERIVATIVES_FLAGS",
    "KERNEL_FLAGS",
    "build_extension",
    "compile_library",
    "copied",
    "digest_of",
    "generator",
    "get_include",
    "library_toolchain",
    "run_tool",
    "write_sources",
]

PACKAGE = Path(__file__).parents[1]


class _Running:
    """The tools that run at the moment, for one task; none begins after they were stopped."""

    def __init__(self) -> None:
        self._processes: set[subprocess.Popen[str]] = set()
        self._stopped = False

    def add(self, process: subprocess.Popen[str]) -> None:
        """One that has begun."""
        self._processes.add(process)
        if self._stopped:
            _stop(process)

    def discard(self, process: subprocess.Popen[str]) -> None:
        """One that has ended."""
        self._processes.discard(process)

    def stop(self) -> None:
        """End them; who has started them notices."""
        self._stopped = True
        for process in tuple(self._processes):
            _stop(process)


TIME_LIMIT = "FOURBAR_CODEGEN_TIME_LIMIT"
"""The environment variable with the seconds that a tool may take; an hour, by default."""

LONGEST = 1e6
"""Seconds from which on there is no limit; poll() counts milliseconds in 32 bits."""

PAUSE = 0.5
"""Seconds for which tools are waited for at a time."""

# Without debugging information, which would double the file. Compilers for Windows refuse -fPIC: all code there is.
COMMON_FLAGS = ("-g0",) if os.name == "nt" else ("-fPIC", "-g0")
# Scalar straight-line code stores results that vectorized loops would reload two at a time, which stalls the
# processor: -fno-tree-vectorize takes 10 % off the four-bar's evaluation. The solve's short loops, and those over
# states side by side, need to be unrolled, which -O2 leaves out; the rest of -O3 costs a third of the time, for
# nothing.
KERNEL_FLAGS = (*COMMON_FLAGS, "-O2", "-fpeel-loops", "-fno-tree-vectorize")
# What the compiler does beyond -O1 takes it half as long again, for a few per cent of long straight-line code.
DERIVATIVES_FLAGS = (*COMMON_FLAGS, "-O1")
# Behind the user's flags: a kernel has to notice what is not a number, and so have integrators.
STRICT_FLAGS = ("-fno-fast-math", "-fno-finite-math-only", "-fno-unsafe-math-optimizations")
# With such flags, compilers also link code that takes denormal numbers for zero, in the whole process that loads it.
# Another -O takes the place of -Ofast, which is one of them.
STRICT_LINK_FLAGS = ("-O2", *STRICT_FLAGS)
# Versions of a kernel, of which the fastest that the processor can run is taken when a module is loaded. What else is
# native to a processor makes no difference that could be measured.
_X86 = platform.machine() in {"x86_64", "AMD64"}
AVX2_FLAGS = (*KERNEL_FLAGS, *(("-mavx2", "-mfma") if _X86 else ()))
AVX512_FLAGS = (*AVX2_FLAGS, *(("-mavx512f", "-mavx512dq", "-mavx512vl") if _X86 else ()))
UNITS = {
    "_kernel.c": KERNEL_FLAGS,
    "_batch.c": KERNEL_FLAGS,
    "_kernel_avx2.c": AVX2_FLAGS,
    "_batch_avx2.c": AVX2_FLAGS,
    "_kernel_avx512.c": AVX512_FLAGS,
    "_batch_avx512.c": AVX512_FLAGS,
    "_derivatives.c": DERIVATIVES_FLAGS,
}
"""The sources of an extension module beside its wrapper, by the ends of their names, and their flags."""
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


def library_toolchain() -> dict[str, object]:
    """All that changes a shared library besides the sources: the headers, the compiler, its flags and the processor.

    No process is started: a compiler is known by its path, size and date.
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
    """All that changes a model's sources besides the model: this package and SymPy."""
    return {"package": _package_digest(), "sympy": _sympy_version()}


def digest_of(data: object) -> str:
    """The digest of plain data, as JSON has it: 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def _sympy_version() -> str:
    """Without importing it: what is built from sources does without."""
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
    """Digest of the package's Python files: a change to the generator reaches the models' keys."""
    return _digest(sorted(PACKAGE.rglob("*.py")))


@cache
def _headers_digest() -> str:
    return _digest(sorted(Path(get_include()).glob("*.h")))


def _digest(paths: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _file_identity(path: str) -> list[object]:
    """What tells a file from another one, and from itself after it has changed; of none, nothing."""
    if not path:
        return []
    try:
        resolved = Path(path).resolve(strict=True)
        status = resolved.stat()
    except FileNotFoundError:
        return []
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
    name: str, sources: Mapping[str, str], folder: Path, *, check: Callable[[Path], None] | None = None
) -> Path:
    """Write sources into a folder and compile them to an extension module there, for other machines of this kind.

    Parameters
    ----------
    name : str
        The module's name; `sources` has ``{name}.pyx``, and of `UNITS` what the model has.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist; it is touched only when all has been built.
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
        module = _build(name, sources, Path(temporary))
        if check is not None:
            check(module)
        write_sources(name, sources, folder, module)
        return folder / module.name


def compile_library(
    library: Path,
    sources: Mapping[str, str],
    units: Mapping[str, Sequence[str]],
    meanwhile: Callable[[], object] | None = None,
) -> Path:
    """Compile C sources to a shared library, for this machine alone.

    Parameters
    ----------
    library : Path
    sources : mapping of str to str
        Text by file name.
    units : mapping of str to sequence of str
        The flags of each of them that is to be compiled.
    meanwhile : callable, optional
        Called while the compiler works.

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
        return _link(_side_by_side([partial(_compile, *unit) for unit in flags.items()], meanwhile), library)


def copied(built: Path, folder: Path) -> Path:
    """A built file in a folder of the user's; a module that a process has loaded does not change under its feet."""
    target = folder / built.name
    try:
        with replacing(target) as file, built.open("rb") as source:
            shutil.copyfileobj(source, file)
    except OSError as error:
        raise BuildError(f"{target} cannot be written: {error.strerror or error}.") from error
    return target


def write_sources(name: str, sources: Mapping[str, str], folder: Path, module: Path | None = None) -> None:
    """Write a model's sources in the place of those that another one of its name may have left.

    None of them takes its place before all have been written.

    Parameters
    ----------
    name : str
        The model's.
    sources : mapping of str to str
        Text by file name.
    folder : Path
        Created if it does not exist.
    module : Path, optional
        What was built of them, to stand beside them.

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
            if f"{name}{suffix}" not in sources:  # not every model has all
                (folder / f"{name}{suffix}").unlink(missing_ok=True)
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror or error}.") from error


def _build(name: str, sources: Mapping[str, str], folder: Path) -> Path:
    write_sources(name, sources, folder)
    more = find_compiler().portable_flags
    flags = {folder / f"{name}{s}": (*own, *more) for s, own in UNITS.items() if f"{name}{s}" in sources}

    def compile_wrapper(running: _Running) -> Path:
        return _compile(_cythonize(folder / f"{name}.pyx"), (*WRAPPER_FLAGS, *more), running, _python_folders())

    objects = _side_by_side([compile_wrapper, *(partial(_compile, *unit) for unit in flags.items())])
    return _link(objects, folder / f"{name}{sysconfig.get_config_var('EXT_SUFFIX')}")


def _side_by_side(
    jobs: Sequence[Callable[[_Running], Path]], meanwhile: Callable[[], object] | None = None
) -> list[Path]:
    """What jobs make, two at a time; where one fails, what the others run is stopped.

    What is to be called meanwhile is, when the first of them is done: then a core is free. (Before the tools run, it
    would keep Python from starting them.)
    """
    from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait

    running = _Running()
    with ThreadPoolExecutor(2) as pool:
        try:
            submitted = [pool.submit(job, running) for job in jobs]
            pending = set(submitted)
            while pending:  # in turns: what interrupts Python just before it waits is noticed when it goes on
                done, pending = wait(pending, PAUSE, FIRST_COMPLETED)
                for job in done:
                    job.result()
                if done and meanwhile is not None:
                    meanwhile()
                    meanwhile = None
            return [job.result() for job in submitted]
        except BaseException:  # as from the keyboard
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

    # By the name of the file alone: folders above may be packages of someone else.
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
    environment = None
    if compiler.is_zig:  # what it makes once, such as the system's libraries to link against, is kept
        kept, once = tool_folder("ziglang", digest_of(_file_identity(program_of(compiler.command[0])))), target.parent
        environment = {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(kept), "ZIG_LOCAL_CACHE_DIR": str(once / "zig-cache")}
    tool = f"the C compiler {compiler}"
    run_tool([*compiler.command, *arguments, "-o", str(target)], target, tool, running=running, environment=environment)
    return target


def run_tool(
    command: Sequence[str],
    target: Path,
    tool: str,
    *,
    cwd: Path | None = None,
    running: _Running | None = None,
    environment: Mapping[str, str] | None = None,
) -> None:
    """Run a tool that is to make a file or folder; its output becomes part of the error if it fails.

    It is among `running` as long as it runs, so that it can be stopped from another thread.
    """
    name, limit = tool[0].upper() + tool[1:], _time_limit()
    running = running or _Running()
    try:
        # In a session of its own: compilers start other programs, which are stopped with them.
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
            f"{name} could not be started: {error.strerror}, {command[0]!r}. {INSTALL} Models that build_model, "
            "fourbar build or a wheel has brought need none: fourbar_codegen.load.",
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
    return limit if limit < LONGEST else None


def _stop(process: subprocess.Popen[str]) -> None:
    """End a tool, and what it has started."""
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
