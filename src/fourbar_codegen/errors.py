"""The package's exceptions: one base class, and a subclass for each stage that may fail."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

__all__ = [
    "AssemblyError",
    "BuildError",
    "CacheError",
    "FourbarError",
    "ModelError",
    "ModelWarning",
    "SimulationError",
    "shown",
]

MAX_SHOWN = 300
"""Characters that a message spends on what was given."""


class FourbarError(Exception):
    """Base class of every error that this package raises on purpose."""


class ModelError(FourbarError, ValueError):
    """A model, or a value handed to a compiled model, does not fit.

    The message names what was given and what is allowed.
    """


class ModelWarning(UserWarning):
    """A model can be compiled, and may not mean what was meant: its kinematics contradict themselves."""


class BuildError(FourbarError, RuntimeError):
    """A build tool could not be run, or refused its input.

    Parameters
    ----------
    message : str
        What was attempted, and what to do.
    command : sequence of str, optional
        The command that failed.
    exit_code : int or None, optional
        Its exit code; None if it could not be started.
    output : str, optional
        What the tool printed, unchanged.
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
    """The equations cannot be evaluated at the state that was given."""


class AssemblyError(SimulationError):
    """No configuration was found in which the loops close.

    Parameters
    ----------
    message : str
        What failed, with the residual.
    residual : sequence of float
        The position constraints at the best configuration found, in the model's units.
    """

    def __init__(self, message: str, residual: Iterable[float] = ()) -> None:
        self.residual = tuple(float(value) for value in residual)
        super().__init__(message)


def shown(given: object) -> str:
    """What was given, as a message has it: its repr, without what is beyond a few lines; its class, if it has none."""
    try:
        text = repr(given)
    except Exception:
        return f"an object of the class {type(given).__name__}"
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."
