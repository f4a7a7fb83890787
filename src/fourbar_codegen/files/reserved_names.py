"""Names that files need for themselves."""

from __future__ import annotations

from collections.abc import Iterable

from fourbar_codegen.errors import ModelError

__all__ = ["ATTRIBUTES", "OF_MEMBERS", "check_free"]

ATTRIBUTES = "run_attributes"
"""Name of the array in an NPZ file that contains everything else, as JSON."""

OF_MEMBERS = {"member", "time", "t", "success", "message", "messages", "nfev", ATTRIBUTES}
"""Names in files of ensembles that are not the model's."""


def check_free(names: Iterable[str], reserved: set[str]) -> None:
    """Raise a ModelError if names of a model are reserved in files."""
    taken = reserved & set(names)
    if taken:
        raise ModelError(
            f"In files the names {', '.join(sorted(taken))} are reserved: rename the state, output or parameter."
        )
