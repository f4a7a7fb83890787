"""The folder of compiled models: one folder per key, made whole before it is seen."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from fourbar_codegen.errors import CacheError

__all__ = ["cache_folder", "cached"]

VARIABLE = "FOURBAR_CODEGEN_CACHE"


def cache_folder() -> Path:
    """The folder of compiled models: the user's cache folder, or what FOURBAR_CODEGEN_CACHE names."""
    chosen = os.environ.get(VARIABLE)
    if chosen:
        return Path(chosen)
    import platformdirs

    return platformdirs.user_cache_path("fourbar_codegen", appauthor=False)


def cached(name: str, key: str, build: Callable[[Path], Path]) -> Path:
    """The module built under a key; `build` is called if there is none yet.

    Parameters
    ----------
    name : str
        Of the module; only for the reader of the folder, the key alone decides.
    key : str
        Hexadecimal digest of all that the module depends on.
    build : callable
        Builds the module in the folder that it is given, and returns the module's path there.

    Returns
    -------
    Path

    Raises
    ------
    CacheError
        If the folder cannot be written.

    Notes
    -----
    A module is built in a temporary folder, under a lock, and moved to its place in one step: other
    processes see it whole or not at all, and a failed build leaves nothing behind.
    """
    root = cache_folder()
    place = root / f"{name}-{key[:32]}"
    found = _module_in(place, name)
    if found is not None:
        return found
    from filelock import FileLock

    try:
        root.mkdir(parents=True, exist_ok=True)
        with FileLock(root / f"{place.name}.lock"):
            found = _module_in(place, name)
            if found is not None:
                return found
            temporary = Path(tempfile.mkdtemp(prefix=f"{name}-building-", dir=root))
            try:
                module = build(temporary)
                temporary.replace(place)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
            return place / module.name
    except OSError as error:
        raise CacheError(
            f"The cache folder {root} cannot be used: {error.strerror or error}. Name another one in the environment "
            f"variable {VARIABLE}."
        ) from error


def _module_in(place: Path, name: str) -> Path | None:
    return next((path for suffix in EXTENSION_SUFFIXES if (path := place / f"{name}{suffix}").is_file()), None)
