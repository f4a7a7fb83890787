"""The one door through which files are written for users: each is there whole, or as it was before."""

from __future__ import annotations

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

__all__ = ["replacing"]


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
    target.parent.mkdir(parents=True, exist_ok=True)
    mode = _mode(target)
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
