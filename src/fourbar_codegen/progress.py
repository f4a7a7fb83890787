"""A line on the terminal that says what takes so long."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

__all__ = ["Progress"]

PATIENCE = 1.0
"""Seconds without a word."""


class Progress:
    """Shows the stage that a long task is in, from its second second on, until it ends.

    Only where someone watches: on a terminal, or in a notebook.

    Parameters
    ----------
    task : str

    Examples
    --------
    >>> with Progress("four_bar") as progress:
    ...     progress.stage("compiling")
    """

    def __init__(self, task: str) -> None:
        self._task = task
        self._stage = ""
        self._begin = time.monotonic()
        self._done = threading.Event()
        watched = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
        self._thread = threading.Thread(target=self._show, daemon=True) if watched else None

    def stage(self, name: str) -> None:
        """What is being done from now on."""
        self._stage = name

    def __enter__(self) -> Progress:
        if self._thread is not None:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()

    def _show(self) -> None:
        width = 0
        wait = PATIENCE
        while not self._done.wait(wait):
            text = f"{self._task}: {self._stage}, {time.monotonic() - self._begin:.0f} s"
            width = max(width, len(text))
            self._write(f"\r{text:<{width}}")
            wait = 0.5
        if width:
            self._write(f"\r{'':<{width}}\r")

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
