"""Paths as users give them, and the one door through which files are written: whole, or as they were before."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from fourbar_codegen.errors import ModelError

__all__ = ["path_of", "replacing", "save", "writer_of"]

T = TypeVar("T")
Writer = Callable[[T, IO[bytes]], None]


def path_of(given: object) -> Path:
    """A path that a user has given, as text or as a Path.

    Raises
    ------
    ModelError
        If it is neither, or no file can have that name.
    """
    if not isinstance(given, str | os.PathLike):
        raise ModelError(f"A path is text or a Path, not {given!r}.")
    try:
        path = Path(given)
        possible = b"\0" not in os.fsencode(path)
    except (TypeError, UnicodeEncodeError):  # bytes, or half a character
        possible = False
    if not possible:
        raise ModelError(f"No file can have the path {given!r}: this system's names are other text.")
    return path


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A new file, to be written, that takes a path's place where the block ends without an error.

    It lies in the same folder until then, under a name of its own that ends like the path's, so that those who write
    at the same time do not meet. As with an editor, a file that is there keeps its mode, one that is write-protected
    is refused, and what a symbolic link points to is written, not the link. Missing folders are made.

    Raises
    ------
    OSError
        If there is something else than a file, or it cannot be written.
    """
    target = Path(os.path.realpath(path))
    mode = _mode(target)
    for folder in reversed(target.parents):  # mkdir(parents=True) is recursive, and Python's recursion limited
        folder.mkdir(exist_ok=True)
    part = target.with_name(f".{secrets.token_hex(8)}{path.suffix}")

    def create(name: str, flags: int) -> int:
        # What only some may read is not shown to others while it is written.
        return os.open(name, flags, 0o666 if mode is None else mode)

    try:
        with open(part, "xb", opener=create) as file:
            yield file
            file.flush()
            if mode is not None:
                os.fchmod(file.fileno(), mode)
            os.fsync(file.fileno())
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)


def _mode(target: Path) -> int | None:
    """The mode of the file that is there, if there is one."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a device, pipe or socket")
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, "it is write-protected")
    return stat.S_IMODE(mode)


def writer_of(path: Path, writers: Mapping[str, Writer[T]], what: str) -> Writer[T]:
    """The writer for a path's suffix.

    Raises
    ------
    ModelError
        If there is none for it.
    """
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise ModelError(f"{what} is saved as {', '.join(writers)}; {path.name!r} ends otherwise.")
    return writer


def save(given: str | Path, result: T, writers: Mapping[str, Writer[T]], what: str) -> Path:
    """Write a result to a file by the writer for its suffix; whatever goes wrong, a file that was there stays.

    Raises
    ------
    ModelError
        If it is no path, there is no writer for its suffix, or the file cannot be written.
    """
    path = path_of(given)
    writer = writer_of(path, writers, what)
    try:
        with replacing(path) as file:
            writer(result, file)
    except OSError as error:
        raise ModelError(f"{path} cannot be written: {error.strerror or error}.") from error
    return path
