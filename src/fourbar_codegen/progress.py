"""Progress of long work, on the terminal."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

__all__ = ["PATIENCE", "Progress"]

PATIENCE = 1.0
"""Seconds without a word, and between two lines where these stay."""

SHARE = 60.0
"""The share of the time so far that lies between two lines that stay, once that is longer: of an hour, 300 lines."""


class Progress:
    """Shows the stage that a long task is in, from its second second on, until it ends.

    Where someone watches, on a terminal or in a notebook, in one line that vanishes. How long each stage has taken goes
    to the logger ``fourbar_codegen``, at the level INFO.

    Parameters
    ----------
    task : str
    unwatched : float, optional
        After how many seconds it is said elsewhere as well, where stderr goes to a file or to another process: in a
        line a second, after a minute in fewer. A minute, by default.

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
        """What is being done from now on."""
        if self._stage is None:  # what is over before its first stage costs nothing
            watched = sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules)
            show = self._show if watched else self._print if sys.stderr is not None else None
            if show is not None:
                self._done = threading.Event()
                self._thread = threading.Thread(target=show, daemon=True)
                self._thread.start()
        self._log()
        self._stage, self._entered = name, time.monotonic()

    def _log(self) -> None:
        logging = sys.modules.get("logging")  # without which nobody listens
        if logging is not None and self._stage is not None:
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
        wait = PATIENCE
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
            wait = max(PATIENCE, (time.monotonic() - self._begin) / SHARE)

    def _text(self) -> str:
        return f"{self._task}: {self._stage}, {time.monotonic() - self._begin:.0f} s"

    @staticmethod
    def _write(text: str) -> None:
        sys.stderr.write(text)
        sys.stderr.flush()
