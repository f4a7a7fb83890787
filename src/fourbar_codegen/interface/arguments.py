"""Checks and conversion of users' arguments: values by name or in order, as finite numbers, or an error message."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, meant, shown
from fourbar_codegen.runtime.evaluator import finite_copy, is_finite, number, numbers

__all__ = [
    "Values",
    "finite_number",
    "flag",
    "is_finite",
    "is_integer",
    "is_mapping",
    "listed",
    "longest_step",
    "name_of",
    "named",
    "named_array",
    "named_columns",
    "named_values",
    "names_of",
    "number",
    "numbers",
    "of_time_and_state",
    "one_of",
    "positive",
    "sample_times",
    "slider_range",
    "time_span",
    "tolerance",
]

_PLAIN = (float, int)
_MAX = sys.float_info.max

Values = ArrayLike | Mapping[Any, float]
"""Numbers in order, or a mapping from names or SymPy symbols."""


def is_mapping(values: Any) -> TypeGuard[Mapping[Any, Any]]:
    """Whether values are given by name: in a dict or a similar object, such as a pandas Series."""
    return hasattr(values, "keys") and hasattr(values, "items") and not isinstance(values, type)


def name_of(key: Any) -> str:
    """The name of a symbol or function of time; a str is a name already."""
    name = key if isinstance(key, str) else getattr(key, "name", key)
    return name if isinstance(name, str) else shown(key)


def named(values: Mapping[Any, Any], names: Collection[str], kind: str) -> dict[str, Any]:
    """A mapping with names as keys.

    Raises
    ------
    ModelError
        If a key is not one of the names, or two keys have the same name.
    """
    found: dict[str, Any] = {}
    for key, value in values.items():
        name = name_of(key)
        if name not in names:
            raise ModelError(
                f"There is no {kind} {name!r}.{meant(name, names)} There are {', '.join(names) or 'none'}."
            )
        if name in found:
            raise ModelError(f"There are two values of {kind} {name}: give one, by its name or its symbol.")
        found[name] = value
    return found


def named_values(
    values: Mapping[Any, float], names: Sequence[str], defaults: Mapping[str, float | None], kind: str
) -> list[float]:
    """Values in the order of the names, from a mapping and defaults.

    Raises
    ------
    ModelError
        If a key is not one of the names, two keys have the same name, or a name has neither value nor default.
    """
    known: dict[str, float | None] = {name: defaults.get(name) for name in names}
    known |= {name: finite_number(value, f"{kind} {name}") for name, value in named(values, names, kind).items()}
    missing = [name for name, value in known.items() if value is None]
    if missing:
        raise ModelError(f"No value for {kind} {', '.join(missing)}: give one, there is no default.")
    return [value for value in known.values() if value is not None]


def finite_number(value: Any, what: str) -> float:
    """A finite float, or a ModelError that names the argument."""
    if type(value) is float and math.isfinite(value):  # the usual case, without preparing an error message
        return value
    known = number(value, f"The value of {what}")
    if not math.isfinite(known):
        raise ModelError(f"The value of {what} must be finite, not {known}.")
    return known


def named_array(
    given: Values | None, names: Sequence[str], defaults: Mapping[str, float], kind: str
) -> NDArray[np.float64]:
    """Finite values in the order of the names, from an array or a mapping."""
    ready = finite_copy(given, len(names))  # without preparing an error message
    if ready is not None:
        return ready
    if given is None or is_mapping(given):
        known = {name: defaults[name] for name in names if name in defaults}
        return np.array(named_values(given or {}, names, known, kind))
    what = f"The values of {kind}s ({', '.join(names)})"
    values = numbers(given, what)
    if values.shape != (len(names),):
        raise ModelError(f"{what} must have shape ({len(names)},), not {values.shape}.")
    if not is_finite(values):
        raise ModelError(f"{what} must be finite, not {values}.")
    return values.copy()


def named_columns(
    given: Any, names: Sequence[str], defaults: Mapping[str, float | None], kind: str, n: int | None = None
) -> NDArray[np.float64]:
    """Values for a batch of states at once, in the order of the names.

    Parameters
    ----------
    given : mapping or array_like
        For each name a number, or an array with one for each state; or an array of shape (len(names),), for all
        states, or (len(names), n).
    names : sequence of str
    defaults : mapping
        Values for names that a mapping omits; None if there is no default.
    kind : str
        The kind of the names, for messages.
    n : int, optional
        The number of states, if known.

    Returns
    -------
    ndarray, shape (len(names),) or (len(names), n)

    Raises
    ------
    ModelError
        If a name or a shape is wrong, or a value is missing. Values that are not finite are accepted.
    """
    if type(given) is not np.ndarray and is_mapping(given):
        known: dict[str, Any] = {name: defaults.get(name) for name in names} | named(given, names, kind)
        missing = [name for name, value in known.items() if value is None]
        if missing:
            raise ModelError(f"No value for {kind} {', '.join(missing)}: give one, there is no default.")
        rows = [numbers(value, f"The values of {kind} {name}") for name, value in known.items()]
        lengths = {len(row) for row in rows if row.ndim}
        if len(lengths) > 1 or any(row.ndim > 1 for row in rows):
            shapes = ", ".join(f"{name} {row.shape}" for name, row in zip(known, rows, strict=True) if row.ndim)
            raise ModelError(f"The {kind}s must be numbers or arrays of one length, not {shapes}.")
        # Values that are the same for all states stay one column.
        values = np.empty((len(rows), *lengths))
        for place, row in enumerate(rows):
            values[place] = row
    else:
        values = numbers(given, f"The values of {kind}s ({', '.join(names)})")
    shape = values.shape
    if not 1 <= len(shape) <= 2 or shape[0] != len(names) or (n is not None and shape[1:] not in {(), (n,)}):
        expected = f"({len(names)},) or ({len(names)}, {'n' if n is None else n})"
        raise ModelError(f"The {kind}s ({', '.join(names)}) must have shape {expected}, not {values.shape}.")
    return values


def time_span(t_span: Sequence[float]) -> tuple[float, float]:
    """The first and last time of a run; they must differ."""
    if type(t_span) is tuple and len(t_span) == 2:  # the usual case of two finite numbers, without an array
        start, end = t_span
        if type(start) in _PLAIN and type(end) in _PLAIN and -_MAX < start < _MAX and -_MAX < end < _MAX:
            start, end = float(start), float(end)
            if start != end:
                return start, end
    span = numbers(t_span, "The times t_span")
    if span.shape != (2,) or not is_finite(span) or span[0] == span[1]:
        raise ModelError(f"t_span must be two times, finite and different, not {shown(t_span)}.")
    return float(span[0]), float(span[1])


def sample_times(t_eval: ArrayLike, start: float, end: float, name: str = "t_eval") -> NDArray[np.float64]:
    """Sample times within a run, in its direction."""
    times = numbers(t_eval, name).copy()
    forward = 1.0 if end > start else -1.0
    if times.ndim != 1 or not times.size or not np.isfinite(times).all() or not (np.diff(forward * times) > 0).all():
        raise ModelError(f"{name} must be a one-dimensional array of distinct times in the order of the run.")
    if not (min(start, end) <= times.min() and times.max() <= max(start, end)):
        raise ModelError(
            f"{name} must lie within t_span ({start:g}, {end:g}); it goes from {times.min()} to {times.max()}."
        )
    return times


def positive(value: float, what: str) -> float:
    """A positive finite number."""
    known = finite_number(value, what)
    if known <= 0.0:
        raise ModelError(f"{what} must be positive, not {known}.")
    return known


def slider_range(ends: Any, what: str) -> tuple[float, float]:
    """The two ends of a slider, or a ModelError that names the argument."""
    values = numbers(ends, f"The range of {what}")
    if values.shape != (2,) or not is_finite(values) or not 0.0 < values[1] - values[0] < math.inf:
        raise ModelError(f"The range of {what} is (low, high) with finite low < high, not {shown(ends)}.")
    return float(values[0]), float(values[1])


def longest_step(value: float) -> float:
    """The longest step: a positive number, or infinity."""
    return math.inf if isinstance(value, float) and value == math.inf else positive(value, "max_step")


def tolerance(value: ArrayLike, name: str, size: int = 0) -> float | NDArray[np.float64]:
    """A positive tolerance: a number for all states, or an array of length `size`."""
    if type(value) is float and 0.0 < value < math.inf:
        return value
    allowed = {(), (size,)} if size else {()}
    known = numbers(value, name).copy()
    if known.shape not in allowed or not (is_finite(known) and (known > 0.0).all()):
        words = "a positive number" + (f" or an array of shape ({size},)" if size else "")
        raise ModelError(f"{name} must be {words}, not {shown(value)}.")
    return known if known.ndim else float(known)


def of_time_and_state(function: Callable[..., Any], what: str) -> None:
    """Raise a ModelError if a callable cannot be called with (t, x)."""
    if isinstance(function, type):
        raise ModelError(f"{what} is a function of (t, x), not the class {function.__name__}.")
    import inspect  # takes some milliseconds, so only if there are callables

    try:
        signature = inspect.signature(function, follow_wrapped=False)
    except Exception:  # some callables that are not written in Python
        return
    try:
        signature.bind(0.0, None)
    except TypeError as error:
        raise ModelError(
            f"{what} is called with (t, x), which {shown(function)} does not take: its arguments are {signature}."
        ) from error


def is_integer(value: object) -> TypeGuard[int]:
    """Whether the type is an integer type; bool and timedelta64 do not count."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)


def flag(value: object, name: str) -> bool:
    """A bool, or a ModelError: other types with a truth value are probably mistakes."""
    if not isinstance(value, bool | np.bool_):
        raise ModelError(f"{name} must be True or False, not {shown(value)}.")
    return bool(value)


def listed(given: Any, what: str) -> list[Any]:
    """The entries of a sequence, or a ModelError that says what it has to be; a str is none."""
    try:
        if not isinstance(given, str | bytes):
            return list(given)
    except TypeError:  # no iterable, or an array without dimensions
        pass
    raise ModelError(f"{what}, not {shown(given)}.")


def names_of(given: Any, what: str) -> list[str]:
    """The names of one symbol, function of time or str, or of several, or of a mapping's keys."""
    several = [given] if isinstance(given, str) or hasattr(given, "name") else given
    return [name_of(key) for key in listed(several, what)]


def one_of(value: object, allowed: Collection[str], kind: str) -> str:
    """One of the allowed words, or a ModelError that lists them."""
    if not isinstance(value, str) or value not in allowed:
        raise ModelError(f"There is no {kind} {shown(value)}; there are {', '.join(allowed)}.")
    return value
