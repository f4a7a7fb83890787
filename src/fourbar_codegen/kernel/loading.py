"""Where compiled models lie: found by name, by fingerprint or by path, and loaded; or built from their sources."""

from __future__ import annotations

import ctypes
import json
import os
import sys
from collections.abc import Callable, Mapping
from importlib import import_module, machinery, util
from pathlib import Path
from types import ModuleType

from fourbar_codegen.building.cache import cached, find_cached
from fourbar_codegen.building.toolchain import build_batch_functions, build_extension, cache_key
from fourbar_codegen.errors import ModelError
from fourbar_codegen.files import path_of

__all__ = ["build_from_sources", "find_module", "load_batch_functions", "module_at", "module_of"]

# What this process loaded from files: the system goes on giving out the first module of a path.
_LOADED: dict[str, tuple[int, int, int]] = {}


def module_of(name: str | Path) -> ModuleType:
    """The extension module of a model, by its name or its path.

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
        raise ModelError(f"A compiled model is known by its name or its path, not {name!r}.")
    path = path_of(name)
    try:
        is_module = path.suffix != "" and path.is_file()
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error.strerror}.") from error
    if is_module:
        return module_at(path)
    if str(name) in _prebuilt():
        return import_module(f"fourbar_codegen.prebuilt.{name}")
    installed = _installed(str(name))
    if installed is not None:
        return module_at(installed)
    known = ", ".join(_prebuilt()) or "none"
    raise ModelError(
        f"There is no compiled model {str(name)!r}: it is neither one of the package's ({known}) nor one installed "
        "from a wheel, nor the path of an extension module that fourbar build made."
    )


def find_module(name: str, fingerprint: str) -> ModuleType | None:
    """The extension module of a name and fingerprint, if it can be had without building it.

    It is one that comes with the package, was installed from a wheel, or is in the cache of `compile_model`, built for
    this machine. Name and fingerprint may come from a stranger's file: neither becomes a path, and nothing is loaded
    but what is known to be that model.
    """
    if not name.isidentifier():
        return None
    if name in _prebuilt():
        module = module_of(name)
        if json.loads(module.manifest)["fingerprint"] == fingerprint:
            return module
    path = _installed(name, fingerprint) or find_cached(name, cache_key(fingerprint))
    return None if path is None else module_at(path)


def module_at(path: Path) -> ModuleType:
    """The extension module in a file, which need not be on Python's path.

    Raises
    ------
    ModelError
        If it cannot be loaded, or this process has loaded what was there before.
    """
    name = path.name.split(".")[0]
    status = path.stat()
    identity = (status.st_ino, status.st_size, status.st_mtime_ns)
    place = str(path.resolve())
    if _LOADED.setdefault(place, identity) != identity:
        raise ModelError(
            f"{path} was built again after this process loaded it, and a module cannot be loaded anew: restart "
            "Python, or build into another folder."
        )
    loader = machinery.ExtensionFileLoader(name, str(path))
    taken = name in sys.modules
    try:
        spec = util.spec_from_file_location(name, path, loader=loader)
        assert spec is not None
        module = util.module_from_spec(spec)
        loader.exec_module(module)
    except ImportError as error:
        if not _is_held(path):
            del _LOADED[place]
        raise ModelError(f"{path} cannot be loaded as a compiled model: {error}.{_noexec(error)}") from error
    finally:
        if not taken:  # Cython enters its modules there, and the next import of that name would end at this one
            sys.modules.pop(name, None)
    return module


def build_from_sources(name: str, sources: Mapping[str, str]) -> ModuleType:
    """The extension module of generated sources, built for this machine, in the cache."""
    return module_at(_built(name, sources, lambda folder: build_extension(name, sources, folder, portable=False)))


def load_batch_functions(model: str, sources: Mapping[str, str]) -> int:
    """Build and load a model's functions for several states side by side: the address of their table."""
    name = f"{model}_batch_functions"
    path = _built(name, sources, lambda folder: build_batch_functions(model, sources, folder))
    try:
        library = ctypes.CDLL(str(path))  # which stays loaded as long as the process runs
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded: {error}.{_noexec(error)}") from error
    return ctypes.addressof(ctypes.c_char.in_dll(library, name))


def _built(name: str, sources: Mapping[str, str], build: Callable[[Path], Path]) -> Path:
    return cached(name, cache_key([name, sources]), build)


def _is_held(path: Path) -> bool:
    """Whether the system has loaded a library from this path."""
    try:
        ctypes.CDLL(str(path), mode=os.RTLD_NOLOAD)
    except OSError:
        return False
    return True


def _noexec(error: Exception) -> str:
    """A sentence, if the system refuses to run what is in a folder."""
    if "failed to map segment" not in str(error):
        return ""
    return (
        " Its file system may be mounted with noexec: name a folder elsewhere in the environment variable "
        "FOURBAR_CODEGEN_CACHE, or build elsewhere."
    )


def _prebuilt() -> list[str]:
    """The names of the models that come with the package."""
    folder = Path(__file__).parents[1] / "prebuilt"
    return sorted({path.name.split(".")[0] for s in machinery.EXTENSION_SUFFIXES for path in folder.glob(f"*{s}")})


def _installed(name: str, fingerprint: str | None = None) -> Path | None:
    """The extension module in a package as `build_wheel` packs it; nothing is imported to find it."""
    if not name.isidentifier():
        return None
    # A data file may come with a folder beside it, which then is in the current one.
    spec = machinery.PathFinder.find_spec(name, [place for place in sys.path if not _is_current(place)])
    for folder in map(Path, (spec and spec.submodule_search_locations) or ()):
        try:
            manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
            found = manifest["name"], manifest["fingerprint"]
        except (OSError, ValueError, TypeError, KeyError, RecursionError):  # a package, but no model
            continue
        if found[0] == name and fingerprint in (None, found[1]):
            modules = (folder / f"{name}{suffix}" for suffix in machinery.EXTENSION_SUFFIXES)
            return next((module for module in modules if module.is_file()), None)
    return None


def _is_current(place: str) -> bool:
    try:
        return Path(place or ".").samefile(".")
    except OSError:  # it is not there
        return False
