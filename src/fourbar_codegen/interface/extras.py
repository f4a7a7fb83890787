"""Packages of extras, which may be missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from fourbar_codegen.errors import ModelError

__all__ = ["imported"]


def imported(module: str, what: str, extra: str) -> Any:
    """A module of a package that an extra installs.

    Raises
    ------
    ModelError
        If it is not installed: what needs it, and how it is installed.

    Examples
    --------
    >>> imported("nothing.there", "Plots", "visual")
    Traceback (most recent call last):
    ...
    fourbar_codegen.errors.ModelError: Plots need nothing: pip install 'fourbar_codegen[visual]'.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ModelError(f"{what} need {module.split('.')[0]}: pip install 'fourbar_codegen[{extra}]'.") from error
