"""Compiled models that exist already, by fingerprint or from a pickle; or are built from their sources."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from fourbar_codegen.building.cache import cached, find_cached
from fourbar_codegen.building.kernel_library import MAX_ATTEMPTS, install, removed
from fourbar_codegen.building.loading import Loaded, installed, kernel_of, load_file, load_named, prebuilt
from fourbar_codegen.building.stored_model import StoredModel
from fourbar_codegen.building.toolchain import digest_of, generator, library_toolchain
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import Layout

__all__ = [
    "cache_key",
    "find_kernel",
    "load_cached",
    "load_from_sources",
    "load_known",
    "reduced",
    "restored",
    "where_it_stays",
]

_Found = TypeVar("_Found")


def find_kernel(name: str, fingerprint: str) -> Kernel | None:
    """The kernel of a name and fingerprint, if it exists already; see `load_known`."""
    found = load_known(name, fingerprint)
    return None if found is None else kernel_of(found)


def load_known(name: str, fingerprint: str) -> Loaded | None:
    """Load the model of a name and fingerprint, if it exists already.

    It may come with the package, from a wheel, or from the cache of `compile_model` for this machine. Name and
    fingerprint may come from an untrusted file: neither is used as a path, and only that model is loaded.
    """
    if not name.isidentifier():
        return None
    if name in prebuilt():
        found = load_named(name)
        if found.layout.fingerprint == fingerprint:
            return found
    path = (
        installed(name, fingerprint)
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

    return where_it_stays(find, load)


def where_it_stays(find: Callable[[], Path], load: Callable[[Path], _Found]) -> _Found:
    """What is loaded from an entry of the cache, which other processes may remove in between."""
    for _ in range(MAX_ATTEMPTS):
        path = find()
        try:
            return load(path)
        except (ModelError, OSError):
            if path.exists():
                raise
    raise removed(path)


def load_from_sources(name: str, sources: Mapping[str, str], layout: Layout, later: bytes | None) -> Loaded:
    """Load the model of generated sources and a layout, built for this machine in the cache."""
    key = cache_key([sources, layout.to_json()])

    def build(folder: Path) -> Path:
        return install(name, sources, layout, folder, later=later)

    return load_cached(lambda: cached(name, key, build))


def reduced(origin: StoredModel, kernel: Kernel) -> tuple[Any, ...]:
    """What a pickle has of a kernel, for `restored`."""
    path = str(origin.path) if kernel.is_portable else None
    layout = kernel.layout.with_body_shapes(kernel.body_shapes)
    return restored, (path, layout, origin.sources_now(kernel), origin.later, origin.compares)


def restored(
    path: str | None, layout: Layout, sources: Mapping[str, str] | None, later: bytes | None, compares: bool
) -> Kernel:
    """A kernel from another process, possibly on another machine.

    A portable module is loaded from its path. A library that was built for one machine comes without a path: another
    machine may see the same folder, but lack the instructions, which the cache's key accounts for. A model that is
    missing, differs or cannot be loaded is built from the sources that came with it.

    Raises
    ------
    ModelError
        If it is not found, and came without sources.
    """
    return kernel_of(_found(path, layout, sources, later), compares=compares)


def _is_of(loaded: Loaded, layout: Layout) -> bool:
    """Whether a model has a layout, but for the shapes of its pictures."""
    return loaded.layout.with_body_shapes(layout.drawing.body_shapes) == layout


def _found(path: str | None, layout: Layout, sources: Mapping[str, str] | None, later: bytes | None) -> Loaded:
    if path is not None and Path(path).is_file():
        with suppress(ModelError):
            loaded = load_file(Path(path))
            if _is_of(loaded, layout):
                return replace(loaded, layout=layout)
    with suppress(ModelError):
        found = load_known(layout.name, layout.fingerprint)
        if found is not None and _is_of(found, layout):
            return replace(found, layout=layout)
    if sources is None:
        raise ModelError(
            f"The model {layout.name} that was sent is not found here, or only a different one of its name, and its "
            "sources were not beside it, or are those of a later build. Install its wheel, or send the module of "
            "build_model from the folder that has its sources."
        )
    return load_from_sources(layout.name, sources, layout, later)
