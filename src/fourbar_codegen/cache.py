"""The folder of compiled models: one folder per key, made whole before it is seen."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from fourbar_codegen.errors import CacheError

__all__ = ["cache_folder", "cached", "find_cached"]

VARIABLE = "FOURBAR_CODEGEN_CACHE"
CHECKSUM = "checksum"


def cache_folder() -> Path:
    """The folder of compiled models: the user's cache folder, or what FOURBAR_CODEGEN_CACHE names."""
    chosen = os.environ.get(VARIABLE)
    if chosen:
        try:
            return Path(chosen).expanduser().absolute()
        except (RuntimeError, OSError) as error:  # no such user, or no current folder
            raise CacheError(f"The environment variable {VARIABLE} names no folder, {chosen!r}: {error}.") from error
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
    place = _place(name, key)
    try:
        found = _module_in(place)
        if found is not None:
            return found
        from filelock import FileLock

        root.mkdir(parents=True, exist_ok=True)
        with FileLock(root / f"{place.name}.lock"):
            found = _module_in(place)
            if found is not None:
                return found
            temporary = root / f"{place.name}.building"
            try:
                _remove(temporary)  # of a process that was killed
                temporary.mkdir()
                module = build(temporary)
                (temporary / CHECKSUM).write_text(f"{_digest(module)}  {module.name}\n", encoding="utf-8")
                _remove(place)  # damaged, or it would have been found
                temporary.replace(place)
            finally:
                _remove(temporary)
            return place / module.name
    except OSError as error:
        raise CacheError(
            f"The cache folder {root} cannot be used: {error.strerror or error}. Name another one in the environment "
            f"variable {VARIABLE}."
        ) from error


def find_cached(name: str, key: str) -> Path | None:
    """The module that was built under a key, if it is there and whole."""
    try:
        return _module_in(_place(name, key))
    except OSError:  # of a folder that cannot be read
        return None


def _place(name: str, key: str) -> Path:
    return cache_folder() / f"{name[:32]}-{key[:32]}"


def _module_in(place: Path) -> Path | None:
    """The module in a folder of the cache, if it is there and undamaged: loading a damaged one may end Python."""
    try:
        digest, _, name = (place / CHECKSUM).read_text(encoding="utf-8").strip().partition("  ")
        module = place / name
        return module if _digest(module) == digest else None
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError, UnicodeDecodeError):
        return None


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
