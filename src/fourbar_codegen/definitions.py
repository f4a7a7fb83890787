"""What fourbar_library.h has to be told of a model, as C text: for C libraries, FMUs and pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["definitions_text", "motions"]


def motions(manifest: Mapping[str, Any]) -> set[str]:
    """The inputs that prescribe motions: their rates are inputs, too."""
    return {entry["of"] for entry in manifest["inputs"] if entry["order"]}


def definitions_text(manifest: Mapping[str, Any]) -> str:
    """Numbers of dependent coordinates and speeds, defaults, and which inputs prescribe motions.

    Parameters
    ----------
    manifest : mapping
        Defaults that are missing are not numbers.

    Returns
    -------
    str
    """
    names = [*manifest["coordinates"], *manifest["speeds"], *manifest["auxiliary_states"]]
    initial = ", ".join(_number(manifest["initial"].get(name, 0.0)) for name in names)
    defaults = ", ".join(_number(entry["default"]) for entry in manifest["parameters"]) or "0.0"
    given = ", ".join(str(int(entry["expression"] is not None)) for entry in manifest["inputs"]) or "0"
    moving = motions(manifest)
    moves = ", ".join(str(int(e["of"] in moving and e["order"] < 2)) for e in manifest["inputs"]) or "0"
    return f"""
enum {{
    N_DEPENDENT_COORDINATES = {manifest["n_dependent_coordinates"]},
    N_DEPENDENT_SPEEDS = {manifest["n_dependent_speeds"]},
    N_JUMPS = {manifest["n_jumps"]}
}};

static const double default_parameters[] = {{{defaults}}};
static const double initial_state[] = {{{initial}}};
static const int has_expression[] = {{{given}}};
static const int prescribes[] = {{{moves}}}; /* whether an input is a prescribed position or speed */
"""


def _number(value: float | None) -> str:
    """A double that C reads as the same; NaN without a value."""
    return "NAN" if value is None or value != value else repr(float(value))
