"""Sources of the inputs' values: numbers, tables, callables and the model's own expressions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, finite_number, is_mapping, name_of, named, numbers, of_time_and_state
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Ode, Table

__all__ = [
    "InputSource",
    "along",
    "bind",
    "by_member",
    "by_name",
    "by_values",
    "input_sources",
    "inputs_at",
    "inputs_of",
    "is_by_member",
    "own_source",
]

Floats = NDArray[np.float64]

InputSource = float | tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, str] | Callable[[float, Floats], float]
InterpolationTable = tuple[Floats, Floats] | tuple[Floats, Floats, str]

KINDS = ("linear", "pchip", "cubic")
"""Interpolation of a table: linear; monotone PCHIP cubics, which do not overshoot; a cubic spline."""


def bind(model: Kernel, parameters: Values | None, inputs: Mapping[Any, InputSource] | None) -> Ode:
    """The right-hand side with parameters and inputs bound; see `CompiledModel.ode`."""
    sources = [None] * model.n_r if inputs is None else input_sources(model, inputs)
    if not model.has_inputs:
        missing = [
            entry["name"]
            for entry, source in zip(model.manifest["inputs"], sources, strict=True)
            if entry["expression"] is None and source is None and not entry["order"]
        ]
        if missing:
            raise ModelError(f"Input {', '.join(missing)} has no source and no expression: give a source in inputs=.")
    return Ode(model, parameters, sources)


def along(
    model: Kernel, parameters: Values | None, t: Floats, r: Floats, inputs: Mapping[Any, InputSource] | None
) -> tuple[Ode, bool]:
    """The right-hand side with the inputs of a run, and whether an input that prescribes a motion is interpolated.

    Inputs come from their sources. If these are unknown, an input is given by its expression if that agrees with its
    values r, in columns at times t; otherwise r is interpolated linearly.
    """
    if inputs is not None:
        return bind(model, parameters, inputs), False
    t, forward = np.unique(t, return_index=True)
    r = r[:, forward]
    expressions = np.reshape([model.default_inputs(time, parameters) for time in t], r.T.shape).T
    sources: list[object] = []
    for values, expected in zip(r, expressions, strict=True):
        if np.array_equal(values, expected):
            sources.append(None)
        else:
            sources.append(float(values[0]) if len(t) == 1 else _linear(t, values))
    entries = model.manifest["inputs"]
    interpolated = {entry["of"] for entry, source in zip(entries, sources, strict=True) if source is not None}
    return Ode(model, parameters, sources), not interpolated.isdisjoint(model.prescribed)


def by_name(model: Kernel, inputs: Mapping[Any, Any] | None) -> Mapping[Any, Any]:
    """The inputs' sources, by name."""
    if inputs is not None and not is_mapping(inputs):
        names = ", ".join(entry["name"] for entry in model.manifest["inputs"] if not entry["order"])
        raise ModelError(f"inputs must be a mapping from the inputs' names ({names}), not {shown(inputs)}.")
    return {} if inputs is None else inputs


def input_sources(model: Kernel, inputs: Mapping[Any, InputSource] | None) -> list[object]:
    """For each entry of the inputs r: None (its expression), a float, a Table or a callable."""
    entries = model.manifest["inputs"]
    names = [entry["name"] for entry in entries if not entry["order"]]
    sources: list[object] = [None] * len(entries)
    for name, given in named(by_name(model, inputs), names, "input").items():
        first = model.inputs.index(name)
        orders = [entry["order"] for entry in entries if entry["of"] == name]  # one after the other, from 0 on
        source = own_source(name, given)
        of_orders: list[object]
        if callable(source):
            if len(orders) > 1:
                raise ModelError(
                    f"Input {name} prescribes a motion, so its rates are needed: give a number or a table (times, "
                    "values) or (times, values, kind), not a callable."
                )
            of_orders = [source]
        elif isinstance(source, tuple):
            kind = source[2] if len(source) == 3 else "linear" if len(orders) == 1 else "cubic"
            of_orders = list(_interpolants(source[0], source[1], kind, len(orders)))
        else:
            of_orders = [0.0 if order else source for order in orders]
        sources[first : first + len(orders)] = of_orders
    return sources


def own_source(name: str, source: Any) -> float | InterpolationTable | Callable[[float, Floats], float]:
    """The source of an input, checked and, unless it is a callable, copied."""
    if callable(source):
        of_time_and_state(source, f"The callable of input {name}")
        return source  # type: ignore[no-any-return]
    if isinstance(source, tuple | list):
        return _table(name, source)
    return finite_number(source, f"input {name}")


def _table(name: str, source: Sequence[Any]) -> InterpolationTable:
    """Times and values of a table, and the kind of interpolation if that is given, checked."""
    what = f"Input {name} must be a number, a table (times, values) or (times, values, kind), or a callable of (t, x)."
    if len(source) not in {2, 3}:
        raise ModelError(f"{what} A table has two arrays of numbers, not {len(source)}.")
    if len(source) == 3 and not (isinstance(source[2], str) and source[2] in KINDS):
        raise ModelError(f"{what} A table's kind is one of {', '.join(KINDS)}, not {shown(source[2])}.")
    times, values = (
        numbers(column, f"{what} A table's {part}").copy()
        for column, part in zip(source[:2], ("times", "values"), strict=True)
    )
    if times.shape != values.shape or times.ndim != 1 or len(times) < 2:
        raise ModelError(
            f"{what} A table has two arrays of the same length, two or more, not of the shapes {times.shape} and "
            f"{values.shape}."
        )
    if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise ModelError(f"{what} A table has finite values and strictly increasing times.")
    return (times, values, str(source[2])) if len(source) == 3 else (times, values)


def _linear(times: Floats, values: Floats) -> Table:
    [table] = _interpolants(times, values, "linear", 1)
    return table


def _interpolants(times: Floats, values: Floats, kind: str, orders: int) -> Iterator[Table]:
    """The interpolant of a table, and its derivatives; constant outside of the table.

    Source: F. N. Fritsch, J. Butland, "A method for constructing local monotone piecewise cubic interpolants", *SIAM
    Journal on Scientific and Statistical Computing* 5 (1984), as ``scipy.interpolate.PchipInterpolator`` has it.
    """
    if kind == "linear":
        coefficients = np.array([np.diff(values) / np.diff(times), values[:-1]])
    else:
        from scipy.interpolate import CubicSpline, PchipInterpolator

        coefficients = (CubicSpline if kind == "cubic" else PchipInterpolator)(times, values).c
    before, after = values[0], values[-1]
    for _ in range(orders):
        yield Table(times, coefficients, before, after)
        powers = np.arange(len(coefficients) - 1, 0, -1)
        derivative = coefficients[:-1] * powers[:, np.newaxis]
        coefficients = derivative if len(powers) else np.zeros((1, len(times) - 1))
        before = after = 0.0


def by_values(
    model: Kernel, inputs: Mapping[Any, InputSource], by_sources: Sequence[Floats | None]
) -> dict[str, float | Floats]:
    """The derivatives by the values of sources, from those by the coefficients of their interpolants.

    Parameters
    ----------
    model : Kernel
    inputs : mapping
        As for `CompiledModel.simulate`.
    by_sources : sequence of length n_r
        As `Steps.gradient` returns them.

    Returns
    -------
    dict of str to float or ndarray
        A number for a number, an array for a table; none for a monotone interpolant, which is not linear in its values.
    """
    found: dict[str, float | Floats] = {}
    entries = model.manifest["inputs"]
    for key, given in inputs.items():
        name = name_of(key)
        source = own_source(name, given)
        parts = [part for entry, part in zip(entries, by_sources, strict=True) if entry["of"] == name]
        if not isinstance(source, tuple):
            assert parts[0] is not None
            found[name] = float(parts[0][0])
            continue
        kind = source[2] if len(source) == 3 else "linear" if len(parts) == 1 else "cubic"
        if kind != "pchip":
            found[name] = _by_table(source[0], kind, [part for part in parts if part is not None])
    return found


def _by_table(times: Floats, kind: str, parts: Sequence[Floats]) -> Floats:
    """The derivatives by a table's values, which its interpolant and the rates of this are linear in."""
    n = len(times)
    if kind == "linear":
        slopes = np.diff(np.eye(n), axis=0) / np.diff(times)[:, np.newaxis]
        basis = np.array([slopes, np.eye(n)[:-1]])  # (powers, intervals, values)
    else:
        from scipy.interpolate import CubicSpline

        basis = CubicSpline(times, np.eye(n)).c
    result = np.zeros(n)
    result[0], result[-1] = parts[0][-2:]
    for part in parts:
        result += np.einsum("ik,kij->j", part[:-2].reshape(n - 1, -1), basis)
        basis = basis[:-1] * np.arange(len(basis) - 1, 0, -1)[:, np.newaxis, np.newaxis]
        basis = basis if len(basis) else np.zeros((1, n - 1, n))
    return result


def inputs_at(model: Kernel, t: float, p: Floats | None, inputs: Mapping[Any, InputSource] | None) -> Floats | None:
    """The inputs for results of configuration and motion only, where only inputs that prescribe a motion count.

    A callable may depend on the state, which is not known yet. It cannot prescribe a motion, so it is replaced by 0.
    """
    if inputs is None:
        return None  # the expressions
    sources = [0.0 if callable(source) else source for source in input_sources(model, inputs)]
    r = Ode(model, p, sources).input_values(t, np.zeros(model.n_x))
    entries = model.manifest["inputs"]
    missing = dict.fromkeys(entries[i]["of"] for i in model.manifest["moving_inputs"] if np.isnan(r[i]))
    if missing:
        raise ModelError(f"Input {', '.join(missing)} has no value at t = {t:g}: give a source of it in inputs=.")
    return np.nan_to_num(r)


def by_member(name: object, source: Any) -> Any:
    """The source of an input, or an array with a number for each member, checked and copied."""
    if not is_by_member(source):
        return own_source(name_of(name), source)
    values = np.array(numbers(source, f"The values of input {name_of(name)}"))
    if not np.isfinite(values).all():
        raise ModelError(f"The values of input {name_of(name)} must be finite.")
    return values


def is_by_member(source: object) -> bool:
    """Whether it is an array with a number for each member."""
    return isinstance(source, np.ndarray) and source.ndim == 1


def inputs_of(inputs: Mapping[Any, Any], members: Any) -> dict[Any, Any]:
    """The sources of one member, or of some."""
    return {key: value[members] if is_by_member(value) else value for key, value in inputs.items()}
