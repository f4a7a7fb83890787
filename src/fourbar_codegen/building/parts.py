"""Parts of a model that `compile_model` leaves for their first use: what pictures, derivatives and batches need."""

from __future__ import annotations

import ctypes
import hashlib
import pickle
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from fourbar_codegen.building.cache import cached
from fourbar_codegen.building.cached_models import cache_key, where_it_stays
from fourbar_codegen.building.kernel_library import PARTS, build_part
from fourbar_codegen.building.loading import noexec
from fourbar_codegen.building.stored_model import StoredModel, shipped_sources
from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.kernel.comparison import (
    compare_batch_functions,
    compare_derivatives,
    compare_drawing,
    compare_products,
)
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["build", "sources_of"]

COMPARED = {
    "drawing": compare_drawing,
    "derivatives": compare_derivatives,
    "products": compare_products,
    "batch_functions": compare_batch_functions,
}
"""What compares a part when it has been compiled."""

NEEDED_BY = {
    "drawing": "Pictures",
    "derivatives": "Derivatives",
    "products": "Sensitivities and gradients",
    "batch_functions": "Batches and ensembles",
}


def build(origin: StoredModel, kernel: Kernel, part: str) -> int:
    """Build, compare and load a part, unless it is in the cache: the address of its table.

    With ``check=False`` of `compile_model` it is not compared.

    Raises
    ------
    ModelError
        If the sources are no longer beside the module.
    BuildError, CacheError
        If it cannot be built.
    """
    sources = sources_of(
        origin,
        kernel,
        part,
        f"{NEEDED_BY[part]} need functions that compile_model builds later, but their sources beside {origin.path} "
        "were missing or damaged: compile the model again. A module of build_model contains them.",
    )
    with Progress(f"fourbar_codegen: {kernel.name}") as progress:
        progress.stage(f"compiling {part.replace('_', ' ')}")

        def check(address: int) -> None:
            copy = Kernel(kernel.capsule, kernel.layout)
            copy.attach_parts_of(kernel)
            (copy.attach_batch_functions if part == "batch_functions" else copy.attach)(address)
            COMPARED[part](copy)

        return _load_part(kernel.name, part, sources, check if origin.compares else None)


def sources_of(origin: StoredModel, kernel: Kernel, part: str, otherwise: str) -> Mapping[str, str]:
    """All sources, if they have those of a part; otherwise a ModelError with this sentence."""
    name = kernel.name
    sources = origin.sources_now(kernel) or shipped_sources(origin.path, name) or {}
    if f"{name}{PARTS[part][0][0]}" not in sources and origin.later is not None:
        with Progress(f"fourbar_codegen: {name}") as progress:
            progress.stage(f"forming {part}")
            sources = {**sources, **_generated(name, part, origin.later)}
    if any(f"{name}{suffix}" not in sources for suffix in PARTS[part][0]):
        raise ModelError(otherwise)
    return sources


def _generated(name: str, part: str, later: bytes) -> dict[str, str]:
    """The source of a part that is compiled at its first use, from the cache if it was generated before.

    Parameters
    ----------
    name : str
        The model's.
    part : {"drawing", "derivatives", "products"}
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
    return {filename: where_it_stays(find, lambda path: path.read_text(encoding="utf-8"))}


def _load_part(name: str, part: str, sources: Mapping[str, str], check: Callable[[int], None] | None) -> int:
    """Build, check and load a part of a model that `compile_model` builds later: the address of its table."""

    def address(path: Path) -> int:
        return _address(path, f"{name}_{part}")

    checks = None if check is None else lambda built: check(address(built))
    return where_it_stays(lambda: build_part(name, part, sources, check=checks), address)


def _address(path: Path, symbol: str) -> int:
    try:
        library = ctypes.CDLL(str(path))  # which stays loaded as long as the process runs
    except OSError as error:
        raise ModelError(f"{path} cannot be loaded: {error}.{noexec(error)}") from error
    return ctypes.addressof(ctypes.c_char.in_dll(library, symbol))
