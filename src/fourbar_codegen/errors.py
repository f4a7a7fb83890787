"""The package's exceptions: a base class, and a subclass for each stage."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

__all__ = [
    "AssemblyError",
    "BuildError",
    "CacheError",
    "FourbarError",
    "ModelError",
    "ModelWarning",
    "SimulationError",
    "meant",
    "nearest",
    "shown",
]

INTERRUPTED = 130
"""Exit code of a process after Ctrl-C, as shells have it: 128 and the number of the signal."""

MAX_SHOWN = 300
"""Largest number of characters of a given value in a message."""


class FourbarError(Exception):
    """Base class of all errors that this package raises."""


class ModelError(FourbarError, ValueError):
    """A model, or an argument of a compiled model, is invalid.

    The message says what was given and what is allowed.
    """


class ModelWarning(UserWarning):
    """A model can be compiled, but is probably wrong: its kinematics are inconsistent."""


class BuildError(FourbarError, RuntimeError):
    """A build tool could not be run, or failed.

    Parameters
    ----------
    message : str
        What failed, and what to do.
    command : sequence of str, optional
        The failed command.
    exit_code : int or None, optional
        Its exit code; None if it could not be started.
    output : str, optional
        The unchanged output of the tool.
    """

    def __init__(
        self,
        message: str,
        *,
        command: Sequence[str] = (),
        exit_code: int | None = None,
        output: str = "",
    ) -> None:
        self.message = message
        self.command = tuple(command)
        self.exit_code = exit_code
        self.output = output
        details = [message]
        if output.strip():
            details.append(output.strip())
        if exit_code is not None:
            details.append(f"exit code: {exit_code}")
        if self.command:
            details.append("command: " + " ".join(self.command))
        super().__init__("\n".join(details))


class CacheError(FourbarError, OSError):
    """The folder of compiled models cannot be used."""


class SimulationError(FourbarError, ArithmeticError):
    """The equations cannot be evaluated at the given state."""


class AssemblyError(SimulationError):
    """No configuration was found in which the loops are closed.

    Parameters
    ----------
    message : str
        What failed, with the residual.
    residual : sequence of float
        The violation of the position constraints at the best configuration found, in the model's units.
    """

    def __init__(self, message: str, residual: Iterable[float] = ()) -> None:
        self.residual = tuple(float(value) for value in residual)
        super().__init__(message)


def shown(given: object) -> str:
    """The repr of a value for a message, truncated; its class, if repr fails."""
    try:
        text = repr(given)
    except Exception:
        return f"an object of the class {type(given).__name__}"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def nearest(name: str, names: Collection[str], cutoff: float = 0.6) -> str | None:
    """The name that is most like another one: the same but for its case, or by `difflib`."""
    from difflib import get_close_matches  # which only those wait for who have mistyped something

    other_case = [other for other in names if other.lower() == name.lower()]
    return next(iter(other_case or get_close_matches(name, names, 1, cutoff)), None)


def meant(name: str, names: Collection[str]) -> str:
    """A question for the nearest name, if one is near."""
    near = nearest(name, names)
    return "" if near is None else f" Did you mean {near}?"
