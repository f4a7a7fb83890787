"""Sources -> shared libraries for this machine, for `compile_model`: only C, without Python.

A model consists of parts. A simulation needs the kernel; positions and orientations, derivatives, their products with
vectors and the functions for batches of states are compiled at their first use. The kernel's library contains the
model's structure: names, order, formulas. Its numbers are in a file beside it (defaults, units, initial values, also
the fingerprint and operation counts), so models that differ only in these share a library.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from fourbar_codegen.building.cache import SIZE_LIMIT, cached, find_cached
from fourbar_codegen.building.flags import COMMON_FLAGS, DERIVATIVES_FLAGS, KERNEL_FLAGS
from fourbar_codegen.building.stored_model import LATER, SUFFIXES, numbers_path
from fourbar_codegen.building.toolchain import (
    compile_library,
    digest_of,
    library_toolchain,
)
from fourbar_codegen.errors import CacheError
from fourbar_codegen.layout import Json, Layout

__all__ = ["MAX_ATTEMPTS", "PARTS", "build_part", "install", "removed"]

PARTS = {
    "kernel": (("_kernel.c", "_kernel.h"), KERNEL_FLAGS),
    "drawing": (("_drawing.c", "_kernel.h"), DERIVATIVES_FLAGS),
    "derivatives": (("_derivatives.c", "_kernel.h"), DERIVATIVES_FLAGS),
    "products": (("_products.c", "_kernel.h"), DERIVATIVES_FLAGS),
    "batch_functions": (("_batch.c", "_kernel.c", "_kernel.h"), KERNEL_FLAGS),
}
"""The sources of each part by their suffixes, first the one to compile, and the flags."""

INLINED = "#define FB_SHORT\n"
"""A line of short kernels, in which all functions that the right-hand side calls are also inlined into it."""

MAX_ATTEMPTS = 5
"""Attempts to use an entry of the cache that other processes remove."""


def build_part(
    name: str,
    part: str,
    sources: Mapping[str, str],
    structure: Mapping[str, Json] | None = None,
    *,
    check: Callable[[Path], object] | None = None,
) -> Path:
    """The shared library of a part, from the cache if it was built there before.

    Its key depends only on the sources' text, the headers, the flags and the compiler, and on whether it was checked: a
    library that was checked serves in both cases.

    Parameters
    ----------
    name : str
        The model's.
    part : {"kernel", "drawing", "derivatives", "products", "batch_functions"}
    sources : mapping of str to str
        Text by file name.
    structure : mapping, optional
        The structure to put into the kernel's library.
    check : callable, optional
        Called with a new library before it is moved to the cache; if it raises, the library is discarded.

    Returns
    -------
    Path
        A shared library with the part's table: ``{name}_kernel`` (and ``fourbar_library``, if a structure is given),
        ``{name}_drawing``, ``{name}_derivatives``, ``{name}_products``, ``{name}_batch_functions``.

    Raises
    ------
    BuildError
        If a tool is missing or fails; with the tool's output.
    CacheError
        If the cache cannot be written.
    """
    suffixes, flags = PARTS[part]
    texts = {f"{name}{suffix}": sources[f"{name}{suffix}"] for suffix in suffixes}
    units = {f"{name}{suffixes[0]}": flags}
    if part == "kernel" and INLINED in texts[f"{name}_kernel.c"]:  # in two units, for two cores
        texts[f"{name}_rhs.c"] = f'#define FB_RHS_ONLY\n#include "{name}_kernel.c"\n'
        units = {f"{name}_kernel.c": (*flags, "-DFB_WITHOUT_RHS"), f"{name}_rhs.c": flags}
    if structure is not None:
        texts[f"{name}_structure.c"] = structure_text(name, structure)
        units[f"{name}_structure.c"] = COMMON_FLAGS

    def build(folder: Path) -> Path:
        with tempfile.TemporaryDirectory() as temporary:
            # In a path of its own, since for a path the system always returns the library that was loaded first.
            library = compile_library(Path(temporary) / f"{name}_{part}.so", texts, units)
            if check is not None:
                check(library)
            return Path(shutil.copy(library, folder))

    what, key = f"{name}_{part}", digest_of([part, texts, library_toolchain()])
    if check is None and find_cached(what, key) is None:
        key = digest_of([part, texts, library_toolchain(), "unchecked"])
    return cached(what, key, build)


def install(
    name: str,
    sources: Mapping[str, str],
    layout: Layout,
    folder: Path,
    *,
    later: bytes | None,
    check: Callable[[Path], int] | None = None,
) -> Path:
    """Put a model's library into a folder, with its sources and numbers beside it.

    Parameters
    ----------
    name : str
    sources : mapping of str to str
        Text by file name: those of the kernel at least.
    layout : Layout
    folder : Path
        An existing folder.
    later : bytes or None
        From which `parts.build` makes the sources of other parts.
    check : callable, optional
        Called with the library before it is moved to the folder; if it raises, the library is discarded. It returns
        at how many states the library was compared with the equations, which becomes one of the numbers.

    Returns
    -------
    Path
        The kernel's library.

    Raises
    ------
    BuildError, CacheError
        As `build_part`.
    """
    checked = False

    def complete(built: Path) -> None:
        nonlocal checked
        for filename, text in sources.items():
            if filename.removeprefix(name) in SUFFIXES:
                (folder / filename).write_text(text, encoding="utf-8")
        if later is not None:
            (folder / f"{name}{LATER}").write_bytes(later)
        _write_numbers(layout, built)
        compared = None if check is None else check(built)
        for library in (built, folder / built.name):
            _write_numbers(replace(layout, compared=compared), library)
        checked = True

    for _ in range(MAX_ATTEMPTS):
        library = build_part(name, "kernel", sources, layout.structure, check=complete)
        with suppress(FileNotFoundError):  # if another process has removed it in between, to keep the cache small
            if not checked:  # it existed, for a model with other numbers, or one that was not checked
                with tempfile.TemporaryDirectory() as temporary:
                    complete(Path(shutil.copy(library, temporary)))
            return Path(shutil.copy(library, folder))
    raise removed(library)


def removed(path: Path) -> CacheError:
    """The error if other processes keep removing a new entry of the cache."""
    return CacheError(
        f"{path} was removed {MAX_ATTEMPTS} times right after it was built: allow a larger cache, by the environment "
        f"variable {SIZE_LIMIT}, and clear it only when nothing is compiled."
    )


def _write_numbers(layout: Layout, library: Path) -> None:
    """Write the part of a layout that is in the file beside the library."""
    numbers_path(library).write_text(json.dumps(layout.numbers, indent=2) + "\n", encoding="utf-8")


def structure_text(name: str, structure: Mapping[str, Json]) -> str:
    """The C source that puts a structure into a library, line by line, since C99 limits the length of strings."""
    text = json.dumps(structure, indent=1, ensure_ascii=True, allow_nan=False)
    lines = "\n".join(f"    {json.dumps(line)}," for line in text.splitlines())
    return f"""\
/* The structure of the model "{name}", as JSON, generated by fourbar_codegen. Do not edit. */
#include "{name}_kernel.h"

static const char *const structure[] = {{
{lines}
    NULL,
}};

const fb_library fourbar_library = {{&{name}_kernel, structure}};
"""
