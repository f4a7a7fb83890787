"""What users hand in, by name or in order, as finite numbers; or an error that says what is allowed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError

__all__ = ["Values", "finite_number", "is_mapping", "name_of", "named_array", "named_values"]

Values = ArrayLike | Mapping[Any, float]
"""Numbers in order, or by name or SymPy symbol."""


def is_mapping(values: Any) -> TypeGuard[Mapping[Any, Any]]:
    """Whether values come by name: in a dict, or something like it, such as a pandas Series."""
    return hasattr(values, "keys") and hasattr(values, "items")


def name_of(key: Any) -> str:
    """The name of a symbol or function of time; a name itself."""
    name = key if isinstance(key, str) else getattr(key, "name", key)
    return name if isinstance(name, str) else str(key)


def named_values(
    values: Mapping[Any, float], names: Sequence[str], defaults: Mapping[str, float | None], kind: str
) -> list[float]:
    """Values in the order of the names, from a mapping and defaults.

    Raises
    ------
    ModelError
        If a key is none of the names, or a name has neither value nor default.
    """
    known: dict[str, float | None] = {name: defaults.get(name) for name in names}
    for key, value in values.items():
        name = name_of(key)
        if name not in known:
            raise ModelError(f"There is no {kind} {name!r}; there are {', '.join(names) or 'none'}.")
        known[name] = finite_number(value, f"{kind} {name}")
    missing = [name for name, value in known.items() if value is None]
    if missing:
        raise ModelError(f"No value for {kind} {', '.join(missing)}: give one, there is no default.")
    return [value for value in known.values() if value is not None]


def finite_number(value: Any, what: str) -> float:
    """A finite float, or a ModelError that says what should have been one."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"The value of {what} must be a real number, not {value!r}.") from error
    if not math.isfinite(number):
        raise ModelError(f"The value of {what} must be finite, not {number}.")
    return number


def named_array(
    given: Values | None, names: Sequence[str], defaults: Mapping[str, float], kind: str
) -> NDArray[np.float64]:
    """Finite values in the order of the names, from an array or a mapping."""
    if given is None or is_mapping(given):
        known = {name: defaults[name] for name in names if name in defaults}
        return np.array(named_values(given or {}, names, known, kind))
    try:
        values = np.array(given, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise ModelError(f"The values of {kind}s ({', '.join(names)}) must be numbers, not {given!r}.") from error
    if values.shape != (len(names),):
        raise ModelError(
            f"The values of {kind}s ({', '.join(names)}) must have shape ({len(names)},), not {values.shape}."
        )
    if not np.isfinite(values).all():
        raise ModelError(f"The values of {kind}s ({', '.join(names)}) must be finite, not {values}.")
    return values
