"""Compiled models are found by name or path, and loaded; nothing is built here."""

from __future__ import annotations

import ctypes
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from importlib import import_module, machinery, util
from pathlib import Path
from types import ModuleType
from typing import Literal

from fourbar_codegen.building.stored_model import LATER, StoredModel, is_whole, numbers_path, sources_beside
from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.paths import path_of
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import Layout
from fourbar_codegen.runtime.evaluator import kernel_at, versions

__all__ = ["Loaded", "installed", "is_named", "kernel_of", "load_file", "load_named", "noexec", "prebuilt"]

PREBUILT = Path(__file__).parents[1] / "prebuilt"

# Files that this process loaded: for a path, the system always returns the library that was loaded first.
_LOADED: dict[str, tuple[int, int, int]] = {}


@dataclass(frozen=True)
class Loaded:
    """A compiled model that was loaded.

    Attributes
    ----------
    capsule : object
        The capsule of its kernel, which may have faster versions; see `evaluator.versions`.
    layout : Layout
    path : Path
    sources : dict of str to str or None
        Text by file name, from which other parts of a library are built; None for a module, which has all parts.
    later : bytes or None
        From which `parts.build` makes those that are missing.
    """

    capsule: object
    layout: Layout
    path: Path
    sources: dict[str, str] | None = None
    later: bytes | None = None


def kernel_of(loaded: Loaded, *, compares: bool = True) -> Kernel:
    """The kernel that was loaded, in the fastest version that the processor can run.

    Parts that are compiled later are compared, or not.
    """
    try:
        capsule = versions(loaded.capsule)[-1]
    except ValueError as error:
        if isinstance(error, ModelError):  # a compiled model, of another layout
            raise
        raise ModelError(f"{loaded.path} is not a compiled model: {error}.") from error
    return Kernel(capsule, loaded.layout, StoredModel(loaded.path, loaded.sources, loaded.later, compares))


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
    if str(name) in prebuilt():
        return _of_module(import_module(f"fourbar_codegen.prebuilt.{name}"))
    found = installed(str(name))
    if found is not None:
        return load_file(found)
    known = ", ".join(prebuilt()) or "none"
    raise ModelError(
        f"There is no compiled model {str(name)!r}: it is neither in the package ({known}) nor installed "
        "from a wheel, nor the path of an extension module that fourbar build made."
    )


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
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error}.{noexec(error)}") from error


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


def is_named(path: Path, name: str, fingerprint: str) -> bool:
    """Whether `load_named` finds a model by its name: one in the package, or one from a wheel."""
    return path.parent == PREBUILT or installed(name, fingerprint) is not None


def _is_held(path: Path) -> bool:
    """Whether the system has loaded a library from this path."""
    try:
        ctypes.CDLL(str(path), mode=getattr(os, "RTLD_NOLOAD", 0))
    except OSError:
        return False
    return True


def noexec(error: Exception) -> str:
    """A sentence, if the system does not allow execution in a folder."""
    if "failed to map segment" not in str(error):
        return ""
    return (
        " Its file system may be mounted with noexec: set the environment variable FOURBAR_CODEGEN_CACHE to a folder "
        "elsewhere, or build elsewhere."
    )


def prebuilt() -> list[str]:
    """The names of the models that come with the package."""
    return sorted({path.name.split(".")[0] for s in machinery.EXTENSION_SUFFIXES for path in PREBUILT.glob(f"*{s}")})


def installed(name: str, fingerprint: str | None = None) -> Path | None:
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
