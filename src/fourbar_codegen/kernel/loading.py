"""Compiled models are found by name, by fingerprint or by path, and loaded; or built from their sources."""

from __future__ import annotations

import ctypes
import hashlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module, machinery, util
from pathlib import Path
from types import ModuleType
from typing import Literal, NamedTuple, TypeVar

from fourbar_codegen.building.cache import cached, find_cached, is_whole
from fourbar_codegen.building.library import (
    LATER,
    MAX_ATTEMPTS,
    PARTS,
    SUFFIXES,
    build_part,
    install,
    numbers_path,
    removed,
)
from fourbar_codegen.building.toolchain import digest_of, generator, library_toolchain
from fourbar_codegen.errors import ModelError
from fourbar_codegen.files import path_of
from fourbar_codegen.layout import Layout
from fourbar_codegen.runtime.evaluator import kernel_at

__all__ = [
    "Loaded",
    "cache_key",
    "generated",
    "is_named",
    "layout_beside",
    "load_cached",
    "load_file",
    "load_from_sources",
    "load_known",
    "load_named",
    "load_part",
    "shipped_sources",
    "sources_beside",
]

_Found = TypeVar("_Found")

# Files that this process loaded: for a path, the system always returns the library that was loaded first.
_LOADED: dict[str, tuple[int, int, int]] = {}


class Loaded(NamedTuple):
    """A compiled model that was loaded.

    Attributes
    ----------
    kernel : object
        The capsule of its kernel, which may have faster versions; see `evaluator.versions`.
    layout : Layout
    path : Path
    sources : dict of str to str or None
        Text by file name, from which other parts of a library are built; None for a module, which has all parts.
    later : bytes or None
        From which `generated` makes those that are missing.
    """

    kernel: object
    layout: Layout
    path: Path
    sources: dict[str, str] | None = None
    later: bytes | None = None


def load_named(name: str | Path) -> Loaded:
    """Load a compiled model by its name or its path.

    Parameters
    ----------
    name : str or Path
        As for `fourbar_codegen.load`.

    Raises
    ------
    ModelError
        If there is no such model, or the file cannot be loaded.
    """
    if not isinstance(name, str | Path):
        raise ModelError(f"A compiled model is loaded by its name or its path, not {name!r}.")
    path = path_of(name)
    try:
        is_file = path.suffix != "" and path.is_file()
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error.strerror}.") from error
    if is_file:
        numbers = numbers_path(path)
        if _is_truncated(path) or not is_whole(path.parent, path.name, numbers.name):
            raise ModelError(
                f"{path}, or {numbers.name} beside it, is damaged, and loading it might crash Python: build it or copy "
                "it again."
            )
        return load_file(path)
    if str(name) in _prebuilt():
        return _of_module(import_module(f"fourbar_codegen.prebuilt.{name}"))
    installed = _installed(str(name))
    if installed is not None:
        return load_file(installed)
    known = ", ".join(_prebuilt()) or "none"
    raise ModelError(
        f"There is no compiled model {str(name)!r}: it is neither in the package ({known}) nor installed "
        "from a wheel, nor the path of an extension module that fourbar build made."
    )


def load_known(name: str, fingerprint: str) -> Loaded | None:
    """Load the model of a name and fingerprint, if it exists already.

    It may come with the package, from a wheel, or from the cache of `compile_model` for this machine. Name and
    fingerprint may come from an untrusted file: neither is used as a path, and only that model is loaded.
    """
    if not name.isidentifier():
        return None
    if name in _prebuilt():
        found = load_named(name)
        if found.layout.fingerprint == fingerprint:
            return found
    path = (
        _installed(name, fingerprint)
        or find_cached(name, cache_key(fingerprint))
        or find_cached(name, cache_key(fingerprint, checked=False))
    )
    return None if path is None else load_file(path)


def cache_key(source: object, *, checked: bool = True) -> str:
    """The cache key of a model that this package and these tools make from a source, for this machine.

    Parameters
    ----------
    source : object
        A model's fingerprint, or texts; plain data that JSON can hold.
    checked : bool, optional
        Whether it was compared with its equations; compared and other models have different keys.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    return digest_of([source, checked, generator(), library_toolchain()])


def load_file(path: Path) -> Loaded:
    """Load a compiled model from a file: an extension module, or the library of a kernel with its numbers beside it.

    Raises
    ------
    ModelError
        If it cannot be loaded, is no compiled model, or this process has loaded an earlier file of that path.
    """
    place = str(path.resolve())
    try:
        status = path.stat()
        identity = (status.st_ino, status.st_size, status.st_mtime_ns)
        if _LOADED.setdefault(place, identity) != identity:
            if numbers_path(path).is_file():  # a library can be loaded again from another path
                with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
                    return _of_library(ctypes.CDLL(shutil.copy(path, temporary)), path)
            raise ModelError(
                f"{path} was built again after this process loaded it, and a module cannot be loaded twice: restart "
                "Python, or build into another folder."
            )
        library = ctypes.CDLL(str(path))  # which stays loaded as long as the process runs
        if hasattr(library, "fourbar_library"):
            return _of_library(library, path)
        return _of_module(_import(path))
    except (ImportError, OSError) as error:
        if not _is_held(path):
            _LOADED.pop(place, None)
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error}.{_noexec(error)}") from error


def load_cached(find: Callable[[], Path]) -> Loaded:
    """Load a model that is in the cache or is built there; retries if another process removes it in between.

    Parameters
    ----------
    find : callable
        Returns the model's path, after building it if necessary.

    Raises
    ------
    ModelError
        If it cannot be loaded.
    CacheError
        If it is removed each time.
    """

    def load(path: Path) -> Loaded:
        loaded = load_file(path)
        if loaded.sources is None and not path.exists():
            raise FileNotFoundError(path)
        return loaded

    return _where_it_stays(find, load)


def _where_it_stays(find: Callable[[], Path], load: Callable[[Path], _Found]) -> _Found:
    for _ in range(MAX_ATTEMPTS):
        path = find()
        try:
            return load(path)
        except (ModelError, OSError):
            if path.exists():
                raise
    raise removed(path)


def _is_truncated(path: Path) -> bool:
    """Whether an ELF file ends before its section header table, which is at the end.

    Source: System V Application Binary Interface, chapter 4 (the header of 64 bits).
    """
    try:
        with path.open("rb") as file:
            header = file.read(64)
            size = file.seek(0, os.SEEK_END)
    except OSError:  # the loader reports more about it
        return False
    if not header.startswith(b"\x7fELF\x02"):
        return False
    order: Literal["little", "big"] = "big" if header[5:6] == b"\x02" else "little"
    begin, entry, count = (int.from_bytes(header[a:b], order) for a, b in ((40, 48), (58, 60), (60, 62)))
    return len(header) < 64 or size < begin + entry * count


def _import(path: Path) -> ModuleType:
    """The extension module in a file, which need not be on Python's path."""
    name = path.name.split(".")[0]
    loader = machinery.ExtensionFileLoader(name, str(path))
    taken = name in sys.modules
    try:
        spec = util.spec_from_file_location(name, path, loader=loader)
        assert spec is not None
        module = util.module_from_spec(spec)
        loader.exec_module(module)
    finally:
        if not taken:  # Cython registers its modules there, and the next import of that name would return this one
            sys.modules.pop(name, None)
    return module


def _of_module(module: ModuleType) -> Loaded:
    try:
        return Loaded(module.kernel, Layout.from_text(module.manifest), Path(str(module.__file__)))
    except ModelError:  # of another version
        raise
    except (AttributeError, ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{module.__name__} is not a compiled model: {error}.") from error


class _Library(ctypes.Structure):
    """``fb_library`` of fourbar_kernel.h."""

    _fields_ = (("kernel", ctypes.c_void_p), ("structure", ctypes.POINTER(ctypes.c_char_p)))


def _of_library(library: ctypes.CDLL, path: Path) -> Loaded:
    table = _Library.in_dll(library, "fourbar_library")
    lines: list[bytes] = []
    while (line := table.structure[len(lines)]) is not None:
        lines.append(line)
    try:
        layout = Layout.from_parts(b"".join(lines), numbers_path(path).read_text(encoding="utf-8"))
    except ModelError:  # of another version
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ModelError(
            f"{path} is a model without its numbers: {numbers_path(path).name} beside it must contain its defaults, "
            f"units and initial values ({error})."
        ) from error
    name = layout.name
    later = path.with_name(f"{name}{LATER}")
    sources = sources_beside(path, name)
    known = later.read_bytes() if sources is not None and later.is_file() else None
    return Loaded(kernel_at(table.kernel), layout, path, sources, known)


def layout_beside(path: Path) -> Layout | None:
    """The layout beside a module, or None where there is none."""
    try:
        return Layout.from_text(path.with_name("manifest.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def sources_beside(path: Path, name: str) -> dict[str, str] | None:
    """The sources beside a compiled model of a name, or None where they are missing or damaged."""
    if not is_whole(path.parent):
        return None
    files = [file for suffix in SUFFIXES if (file := path.with_name(f"{name}{suffix}")).is_file()]
    return {file.name: file.read_text(encoding="utf-8") for file in files} or None


def shipped_sources(path: Path, name: str) -> dict[str, str] | None:
    """The sources of a model that comes with the package."""
    return sources_beside(path.parent / f"{name}_sources" / name, name)


def is_named(path: Path, name: str, fingerprint: str) -> bool:
    """Whether `load_named` finds a model by its name: one in the package, or one from a wheel."""
    return path.parent == Path(__file__).parents[1] / "prebuilt" or _installed(name, fingerprint) is not None


def load_from_sources(name: str, sources: Mapping[str, str], layout: Layout, later: bytes | None) -> Loaded:
    """Load the model of generated sources and a layout, built for this machine in the cache."""
    key = cache_key([sources, layout.to_json()])

    def build(folder: Path) -> Path:
        return install(name, sources, layout, folder, later=later)

    return load_cached(lambda: cached(name, key, build))


def generated(name: str, part: str, later: bytes) -> dict[str, str]:
    """The source of a part that is compiled at its first use, from the cache if it was generated before.

    Parameters
    ----------
    name : str
        The model's.
    part : {"derivatives", "products"}
    later : bytes
        A pickled function, which takes the part to the text. It comes with the model's library, which can run any code.

    Returns
    -------
    dict of str to str
        Text by file name.

    Raises
    ------
    ModelError
        If another version has made it.
    """
    filename = f"{name}{PARTS[part][0][0]}"

    def build(folder: Path) -> Path:
        try:
            source_of = pickle.loads(later)
        except Exception as error:  # which one depends on what the versions differ in
            raise ModelError(
                f"The {part} of {name} cannot be formed ({error!r}): the model was compiled by another version of "
                "fourbar_codegen, SymPy or Python. Compile it again."
            ) from error
        path = folder / filename
        path.write_text(source_of(part), encoding="utf-8")
        return path

    key = cache_key([part, hashlib.sha256(later).hexdigest()])
    find = partial(cached, f"{name}_{part}_source", key, build)
    return {filename: _where_it_stays(find, lambda path: path.read_text(encoding="utf-8"))}


def load_part(name: str, part: str, sources: Mapping[str, str], check: Callable[[int], None] | None) -> int:
    """Build, check and load a part of a model that `compile_model` builds later: the address of its table."""

    def address(path: Path) -> int:
        return _address(path, f"{name}_{part}")

    checks = None if check is None else lambda built: check(address(built))
    return _where_it_stays(lambda: build_part(name, part, sources, check=checks), address)


def _address(path: Path, symbol: str) -> int:
    try:
        library = ctypes.CDLL(str(path))  # which stays loaded as long as the process runs
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded: {error}.{_noexec(error)}") from error
    return ctypes.addressof(ctypes.c_char.in_dll(library, symbol))


def _is_held(path: Path) -> bool:
    """Whether the system has loaded a library from this path."""
    try:
        ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD)
    except OSError:
        return False
    return True


def _noexec(error: Exception) -> str:
    """A sentence, if the system does not allow execution in a folder."""
    if "failed to map segment" not in str(error):
        return ""
    return (
        " Its file system may be mounted with noexec: set the environment variable FOURBAR_CODEGEN_CACHE to a folder "
        "elsewhere, or build elsewhere."
    )


def _prebuilt() -> list[str]:
    """The names of the models that come with the package."""
    folder = Path(__file__).parents[1] / "prebuilt"
    return sorted({path.name.split(".")[0] for s in machinery.EXTENSION_SUFFIXES for path in folder.glob(f"*{s}")})


def _installed(name: str, fingerprint: str | None = None) -> Path | None:
    """The extension module in a package as `build_wheel` packs it; nothing is imported to find it."""
    if not name.isidentifier():
        return None
    # Not from the current folder: a data file may come with a folder of the model's name beside it.
    spec = machinery.PathFinder.find_spec(name, [place for place in sys.path if not _is_current(place)])
    for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
        try:
            own_name, own = Layout.identity((folder / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError, TypeError, KeyError, RecursionError):  # a package, but no model
            continue
        if own_name == name and fingerprint in (None, own):
            modules = (folder / f"{name}{suffix}" for suffix in machinery.EXTENSION_SUFFIXES)
            return next((module for module in modules if module.is_file()), None)
    return None


def _is_current(place: str) -> bool:
    try:
        return Path(place or ".").samefile(".")
    except OSError:  # it is not there
        return False
