"""Paths given by users, and atomic writing of files: complete, or unchanged."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from fourbar_codegen.errors import ModelError

__all__ = ["path_of", "replacing", "write_whole"]


def path_of(given: object) -> Path:
    """A path given by a user, as text or as a Path.

    Raises
    ------
    ModelError
        If it is neither, or is impossible as a file name.
    """
    if not isinstance(given, str | os.PathLike):
        raise ModelError(f"A path is text or a Path, not {given!r}.")
    try:
        path = Path(given)
        possible = bool(os.fspath(given)) and b"\0" not in os.fsencode(path)
    except (TypeError, UnicodeEncodeError):  # bytes, or a lone surrogate
        possible = False
    if not possible:
        raise ModelError(f"No file can have the path {given!r}: this system does not allow such names.")
    return path


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A new file for writing that replaces a path when the block ends without an error.

    Until then it is in the same folder, under a unique name with the same suffix, so that concurrent writers do not
    interfere. As with an editor, an existing file keeps its mode, a write-protected one is refused, and for a symbolic
    link, its target is written, not the link. Missing folders are made.

    Raises
    ------
    OSError
        If the path is not a file, or it cannot be written.
    """
    target = Path(os.path.realpath(path))
    mode = _mode(target)
    for folder in reversed(target.parents):  # mkdir(parents=True) is recursive, and Python limits recursion
        folder.mkdir(exist_ok=True)
    part = target.with_name(f".{secrets.token_hex(8)}{path.suffix}")

    def create(name: str, flags: int) -> int:
        # A file with restricted access is also restricted while it is written.
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
    """The mode of an existing file, else None."""
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


def write_whole(path: Path, write: Callable[[IO[bytes]], object]) -> Path:
    """Write a file by a function; whatever goes wrong, a file that was there stays.

    Raises
    ------
    ModelError
        If the file cannot be written.
    """
    try:
        with replacing(path) as file:
            write(file)
    except OSError as error:
        raise ModelError(f"{path} cannot be written: {error.strerror or error}.") from error
    return path
