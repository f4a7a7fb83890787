"""The cache of compiled models: one folder per key, created atomically.

Loading a module runs its code. So nothing is loaded that another user could have put there or may change: entries of
the cache must belong to the user or to root, and others must not be able to write to them.
"""

from __future__ import annotations

import atexit
import errno
import math
import os
import platform
import re
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from fourbar_codegen.building.stored_model import CHECKSUM, agree, checksums_in, digest_of_file
from fourbar_codegen.errors import CacheError
from fourbar_codegen.interface.progress import QUIET_SECONDS, Progress

if TYPE_CHECKING:
    from filelock import BaseFileLock

__all__ = [
    "Entry",
    "cache_folder",
    "cached",
    "clear",
    "entries",
    "find_cached",
    "size_limit",
    "tool_folder",
]

VARIABLE = "FOURBAR_CODEGEN_CACHE"
SIZE_LIMIT = "FOURBAR_CODEGEN_CACHE_SIZE"
"""The environment variable with the size limit in bytes, beyond which the least recently used entries are removed; 2 GB
by default."""

ENTRY = re.compile(r"(?P<name>\w+)-[0-9a-f]{32}(\.\d+\.\d+\.removed)?")
"""Names of the folders in the cache, also of those that a process was removing when it ended."""


@dataclass(frozen=True)
class Entry:
    """A folder in the cache.

    Attributes
    ----------
    folder : Path
    name : str
        The name of the model, or of a part of it.
    size : int
        In bytes.
    used : float
        When it was last used, in seconds since 1970.
    """

    folder: Path
    name: str
    size: int
    used: float


def cache_folder() -> Path:
    """The folder of compiled models: the user's cache folder, or what FOURBAR_CODEGEN_CACHE names."""
    chosen = os.environ.get(VARIABLE)
    if chosen:
        try:
            return Path(chosen).expanduser().absolute()
        except (RuntimeError, OSError) as error:  # no such user, or no current folder
            raise CacheError(f"The environment variable {VARIABLE} is not a folder, {chosen!r}: {error}.") from error
    return _users_folder()


def _users_folder() -> Path:
    import platformdirs

    return platformdirs.user_cache_path("fourbar_codegen", appauthor=False)


def cached(name: str, key: str, build: Callable[[Path], Path]) -> Path:
    """The module built under a key; `build` is called if there is none yet.

    Parameters
    ----------
    name : str
        The module's name, only for readers of the folder; the key alone decides.
    key : str
        Hexadecimal digest of everything that the module depends on.
    build : callable
        Builds the module in the folder that it is given, and returns the module's path there.

    Returns
    -------
    Path

    Raises
    ------
    CacheError
        If the folder cannot be written, or an environment variable is invalid.

    Warns
    -----
    UserWarning
        If others can write to the folder, or to its content. The module is then built in a folder of the user's own.

    Notes
    -----
    A module is built in a temporary folder, under a lock, and moved to its place atomically: other processes see
    the complete module or none, and a failed build leaves nothing behind.
    """
    root, limit = cache_folder(), size_limit()
    try:
        place = _place(root, name, key)
        reason = _distrusted_entry(place)
        if reason:
            root = _own_folder()
            place = _place(root, name, key)
            warnings.warn(
                f"{reason}, and loading a model from there runs its code: {name} is compiled in {root} instead. "
                f"Make that writable for you alone, or set the environment variable {VARIABLE} to another folder.",
                stacklevel=2,
            )
        found = _cached(place, build, limit)
        _note_use(place)
        return found
    except CacheError:  # from a nested build
        raise
    except OSError as error:
        raise _unusable(root, error) from error


def _cached(place: Path, build: Callable[[Path], Path], limit: float) -> Path:
    found = _module_in(place)
    if found is not None:
        return found
    from filelock import FileLock

    root = place.parent
    if not root.exists():
        root.mkdir(parents=True, exist_ok=True)
        _close(root)
    own = f"{place.name}.{_user()}"
    with _held(FileLock(root / f"{own}.lock"), root / f"{own}.holder", place.name.rpartition("-")[0]):
        found = _module_in(place)
        if found is not None:
            return found
        temporary = root / f"{own}.building"
        try:
            _remove(temporary)  # left by a process that was killed
            temporary.mkdir()
            module = build(temporary)
            files = [module, *sorted(path for path in temporary.iterdir() if path != module and path.is_file())]
            lines = [f"{digest_of_file(path)}  {path.name}\n" for path in files]
            (temporary / CHECKSUM).write_text("".join(lines), encoding="utf-8")
            for path in (temporary, *temporary.rglob("*")):
                _close(path)
            _remove(place)  # it is damaged, since it was not found
            temporary.replace(place)
        finally:
            _remove(temporary)
        _keep_within(root, limit, place)
        return place / module.name


@contextmanager
def _held(lock: BaseFileLock, holder: Path, name: str) -> Iterator[None]:
    """A lock, with a file beside it that tells waiting processes which process holds it."""
    from filelock import Timeout

    try:
        lock.acquire(timeout=0.0)
    except Timeout:
        with Progress(f"fourbar_codegen: {name}", unwatched=QUIET_SECONDS) as progress:
            try:
                by = holder.read_text(encoding="utf-8")
            except OSError:  # the process has just begun or ended
                by = "another process"
            progress.stage(f"waiting for {by}, which compiles it; {lock.lock_file} is its lock")
            lock.acquire()
    try:
        holder.write_text(f"process {os.getpid()} on {platform.node()}", encoding="utf-8")
        yield
    finally:
        holder.unlink(missing_ok=True)
        lock.release()


def tool_folder(name: str, key: str) -> Path:
    """A folder in the cache for a tool's own files, which nobody else can read.

    Parameters
    ----------
    name, key : str
        As for `cached`.

    Raises
    ------
    CacheError
        If the folder cannot be made.
    """
    root = cache_folder()
    try:
        if _distrusted(root) or _distrusted(_place(root, name, key)):
            root = _own_folder()
        place = _place(root, name, key)
        place.mkdir(mode=0o700, parents=True, exist_ok=True)
        (place / CHECKSUM).touch()
    except OSError as error:
        raise _unusable(root, error) from error
    return place


def _unusable(root: Path, error: OSError) -> CacheError:
    if isinstance(error, FileNotFoundError) and root in Path(error.filename or "").parents:
        return CacheError(f"{error.filename} was removed by another process while it was needed: compile once more.")
    return CacheError(
        f"The cache folder {root} cannot be used: {error.strerror or error}. Set another one in the environment "
        f"variable {VARIABLE}."
    )


def _note_use(place: Path) -> None:
    with suppress(OSError):  # it belongs to another user, or is read-only
        os.utime(place / CHECKSUM)


def size_limit() -> float:
    """The largest size of the cache in bytes.

    Raises
    ------
    CacheError
        If the environment variable is not a number.
    """
    text = os.environ.get(SIZE_LIMIT) or "2e9"
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not limit >= 0.0:
        raise CacheError(f"The environment variable {SIZE_LIMIT} is a number of bytes, such as 2e9, not {text!r}.")
    return limit


def entries() -> list[Entry]:
    """The entries of the cache, the most recently used first.

    Raises
    ------
    CacheError
        If the folder cannot be read.
    """
    root = cache_folder()
    try:
        if root.exists() and not root.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        return _entries(root)
    except OSError as error:
        raise CacheError(f"The cache folder {root} cannot be read: {error.strerror or error}.") from error


def _entries(root: Path) -> list[Entry]:
    found = []
    for folder in root.iterdir() if root.is_dir() else ():
        known = ENTRY.fullmatch(folder.name)
        if known is None or folder.is_symlink() or not folder.is_dir():
            continue
        with suppress(FileNotFoundError):  # removed just now
            size, checksum = _size(folder), folder / CHECKSUM
            used = (checksum if checksum.exists() else folder).stat().st_mtime
            found.append(Entry(folder, known["name"], size, used))
    return sorted(found, key=lambda entry: entry.used, reverse=True)


def _size(folder: Path) -> int:
    """Of all that is in a folder, in bytes; pathlib takes four times as long."""
    below = (f"{path}/{name}" for path, folders, files in os.walk(folder) for name in (*folders, *files))
    return sum(os.lstat(path).st_size for path in below)


def clear(older_than: float = 0.0) -> list[Entry]:
    """Remove entries of the cache. Loaded models keep working, except for parts that are not compiled yet.

    Parameters
    ----------
    older_than : float, optional
        Only remove entries that were not used for this number of seconds.

    Returns
    -------
    list of Entry
        The removed entries.

    Raises
    ------
    CacheError
        If an entry cannot be removed.
    """
    last = time.time() - older_than
    removed = [entry for entry in entries() if entry.used <= last]
    for entry in removed:
        try:
            with suppress(FileNotFoundError):  # another process is removing it
                _discard(entry.folder)
        except OSError as error:
            raise CacheError(f"{entry.folder} cannot be removed: {error.strerror or error}.") from error
    return removed


_sizes: dict[Path, tuple[int, float]] = {}
"""Of each cache, its size when this process looked last, and what it has added since."""


def _keep_within(root: Path, limit: float, newest: Path) -> None:
    """Remove the least recently used entries, but not the newest.

    Looking at all entries would take longer than compiling a part, where there are thousands. So a process looks when
    it adds its first one, when the limit is reached as far as it knows, and when it has added a sixteenth of the limit,
    for the sake of what other processes add.
    """
    size, added = _sizes.get(root, (0, math.inf))
    added += _size(newest)
    if size + added <= limit and added <= limit / 16:
        _sizes[root] = size, added
        return
    found = _entries(root)
    size = sum(entry.size for entry in found)
    for entry in reversed(found):
        if size <= limit:
            break
        if entry.folder != newest:
            with suppress(OSError):  # it belongs to another user
                _discard(entry.folder)
                size -= entry.size
    _sizes[root] = size, 0.0


def _discard(folder: Path) -> None:
    """Remove a folder of the cache; for other processes it disappears atomically."""
    aside = folder
    if not folder.name.endswith(".removed"):
        aside = folder.with_name(f"{folder.name}.{_user()}.{os.getpid()}.removed")
        folder.replace(aside)
    shutil.rmtree(aside)


def find_cached(name: str, key: str) -> Path | None:
    """The module that was built under a key, if it exists, is undamaged and can be trusted."""
    try:
        place = _place(cache_folder(), name, key)
        return None if _distrusted_entry(place) else _module_in(place)
    except OSError:  # the folder cannot be read
        return None


def _place(root: Path, name: str, key: str) -> Path:
    return root / f"{name[:32]}-{key[:32]}"


def _user() -> int:
    return os.geteuid() if hasattr(os, "geteuid") else 0


def _distrusted(path: Path) -> str:
    """The reason why others could have changed a path, by owner and permissions; empty if they could not."""
    if not hasattr(os, "geteuid"):
        return ""
    try:
        status = path.stat()
    except FileNotFoundError:
        return ""
    if status.st_uid not in {_user(), 0}:
        return f"{path} belongs to another user, {status.st_uid}"
    # A group with the user's own number is private to the user; in a sticky folder, others cannot replace anything.
    others = stat.S_IWOTH | (0 if status.st_gid == status.st_uid else stat.S_IWGRP)
    if status.st_mode & others and not (path.is_dir() and status.st_mode & stat.S_ISVTX):
        return f"Others can write to {path}"
    return ""


def _distrusted_entry(place: Path) -> str:
    """The same for the cache, one of its folders, and the content of that."""
    reason = _distrusted(place.parent)
    if reason or not (place.is_symlink() or place.is_dir()):
        return reason
    for path in (place, *(place.iterdir() if os.access(place, os.R_OK) else ())):
        if path.is_symlink():
            return f"{path} is a symbolic link"
        reason = _distrusted(path)
        if reason:
            return reason
    return ""


def _close(path: Path) -> None:
    """Remove the permission of others to write to new files, whatever the process's umask is."""
    path.chmod(path.stat().st_mode & ~(stat.S_IWGRP | stat.S_IWOTH))


@cache
def _own_folder() -> Path:
    """A folder of the user's own: the usual one, or one for this process."""
    usual = _users_folder()
    try:
        usual.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _distrusted(usual) and os.access(usual, os.W_OK):
            return usual
    except OSError:  # without a home
        pass
    folder = tempfile.mkdtemp(prefix="fourbar_codegen-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _module_in(place: Path) -> Path | None:
    """The module in a folder of the cache, if it exists and is undamaged: loading a damaged one may crash Python."""
    checksums = checksums_in(place)
    return place / next(iter(checksums)) if checksums and agree(place, checksums) else None


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
