"""The files of a compiled model in a folder: library or module, numbers, sources, checksums."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fourbar_codegen.interface.registered import Registered
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import Layout

__all__ = [
    "CHECKSUM",
    "LATER",
    "SUFFIXES",
    "StoredModel",
    "agree",
    "checksums_in",
    "digest_of_file",
    "is_whole",
    "layout_beside",
    "numbers_path",
    "shipped_sources",
    "sources_beside",
]

CHECKSUM = "checksum"
"""Name of the file of checksums."""

SUFFIXES = ("_kernel.c", "_kernel.h", "_drawing.c", "_derivatives.c", "_products.c", "_batch.c")
"""Suffixes of the sources of all parts."""

LATER = "_later.pickle"
"""Suffix of the file from which sources of parts are generated at their first use."""


def numbers_path(library: Path) -> Path:
    """The file of a model's numbers beside its library."""
    return library.with_name(f"{library.stem.removesuffix('_kernel')}_numbers.json")


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


def is_whole(folder: Path, *names: str) -> bool:
    """Whether the files of a folder have their checksums; a folder without checksums is accepted.

    All files, or those of some names, as far as the folder has checksums of them.

    Sources are checked too, since they are compiled later for batches of states, and are sent with a model.
    """
    checksums = checksums_in(folder)
    if checksums is not None and names:
        checksums = {name: digest for name, digest in checksums.items() if name in names}
        return all(digest_of_file(folder / name) == digest for name, digest in checksums.items())
    return checksums is None or agree(folder, checksums)


def agree(folder: Path, checksums: dict[str, str | None]) -> bool:
    """Whether there are checksums, and the files have them."""
    return bool(checksums) and all(digest_of_file(folder / name) == digest for name, digest in checksums.items())


def checksums_in(folder: Path) -> dict[str, str | None] | None:
    """Checksums by file name, the module's first; None if there are none."""
    try:
        lines = (folder / CHECKSUM).read_text(encoding="utf-8").splitlines()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, UnicodeDecodeError):
        return None
    pairs = [line.partition("  ") for line in lines]
    return {name: digest if digest and name == Path(name).name else None for digest, _, name in pairs}


def digest_of_file(path: Path) -> str:
    """The digest of a file's content; empty if there is no file."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return ""


@dataclass(frozen=True)
class StoredModel:
    """The files of a kernel, from which later parts are built and other processes load it.

    Attributes
    ----------
    path : Path
        The extension module or library.
    sources : mapping of str to str or None
        The sources beside a library when it was loaded: text by file name.
    later : bytes or None
        From which `parts.build` makes sources that are missing.
    compares : bool
        Whether parts that are compiled later are compared: False after ``compile_model(model, check=False)``.
    """

    path: Path
    sources: Mapping[str, str] | None = None
    later: bytes | None = None
    compares: bool = True

    # From parts.py and cached_models.py, with the toolchain, which loading does not need.
    built = Registered[[Kernel, str], int]()
    reduced = Registered[[Kernel], tuple[Any, ...]]()

    def sources_now(self, kernel: Kernel) -> Mapping[str, str] | None:
        """The sources: those beside a library when it was loaded, or those that are beside a module now.

        None if a module's folder was rebuilt, even in part, since its sources belong to another model then.
        """
        if not kernel.is_portable:
            return self.sources
        return sources_beside(self.path, kernel.name) if layout_beside(self.path) == kernel.layout else None
