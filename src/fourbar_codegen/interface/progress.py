"""Progress of long tasks, on the terminal."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

__all__ = ["QUIET_SECONDS", "Progress"]

QUIET_SECONDS = 1.0
"""Seconds before the first output."""

LOG_INTERVAL = 30.0
"""Seconds between two lines where stderr is no terminal, and lines stay."""


class Progress:
    """Shows the stage of a long task, from one second after its start until its end.

    On a terminal or in a notebook this is one line that disappears at the end. The time of each stage is logged to
    ``fourbar_codegen``, at the level INFO.

    Parameters
    ----------
    task : str
    unwatched : float, optional
        Seconds before the first output if stderr is a file or another process; then a line every 30 s. By default a
        minute.

    Examples
    --------
    >>> with Progress("four_bar") as progress:
    ...     progress.stage("compiling")
    """

    _stage: str | None = None
    _entered = 0.0
    _thread: threading.Thread | None = None

    def __init__(self, task: str, *, unwatched: float = 60.0) -> None:
        self._task, self._unwatched = task, unwatched
        self._begin = time.monotonic()

    def stage(self, name: str) -> None:
        """Begin a stage."""
        if self._stage is None:  # a task that ends before its first stage needs no thread
            watched = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
            show = self._show if watched else self._print if sys.stderr is not None else None
            if show is not None:
                self._done = threading.Event()
                self._thread = threading.Thread(target=show, daemon=True)
                self._thread.start()
        self._log()
        self._stage, self._entered = name, time.monotonic()

    def _log(self) -> None:
        if self._stage is not None:
            import logging  # takes some milliseconds, and only long tasks have stages

            took = time.monotonic() - self._entered
            logging.getLogger("fourbar_codegen").info("%s: %s took %.3f s", self._task, self._stage, took)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._stage is None:
            return
        self._log()
        if self._thread is not None:
            self._done.set()
            self._thread.join()

    def _show(self) -> None:
        width = 0
        wait = QUIET_SECONDS
        while not self._done.wait(wait):
            text = self._text()
            width = max(width, len(text))
            self._write(f"\r{text:<{width}}")
            wait = 0.5
        if width:
            self._write(f"\r{'':<{width}}\r")

    def _print(self) -> None:
        wait = self._unwatched
        while not self._done.wait(wait):
            self._write(f"{self._text()}\n")
            wait = LOG_INTERVAL

    def _text(self) -> str:
        return f"{self._task}: {self._stage}, {time.monotonic() - self._begin:.0f} s"

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
