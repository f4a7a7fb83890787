"""Sources of the inputs' values: numbers, tables, callables and the model's own expressions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import (
    Values,
    finite_number,
    is_mapping,
    name_of,
    named,
    numbers,
    of_time_and_state,
)
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Ode, Table

__all__ = [
    "InputSource",
    "along",
    "arbitrary_changes",
    "bind",
    "by_member",
    "by_name",
    "changes_at",
    "held_inputs",
    "input_sources",
    "inputs_at",
    "inputs_of",
    "is_by_member",
    "is_held",
    "ode",
    "own_source",
    "own_sources",
    "source_changes",
    "wrt_values",
]

Floats = NDArray[np.float64]

InputSource = float | tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, str] | Callable[[float, Floats], float]
InterpolationTable = tuple[Floats, Floats] | tuple[Floats, Floats, str]

KINDS = ("linear", "pchip", "cubic", "hold")
"""Interpolation of a table: linear; monotone PCHIP cubics, which do not overshoot; a cubic spline; a zero-order hold of
the value of the last time that is not later."""


def bind(model: Kernel, parameters: Values | None, inputs: Mapping[Any, InputSource] | None) -> Ode:
    """The right-hand side with parameters and inputs bound; see `CompiledModel.ode`."""
    sources = [None] * model.n_r if inputs is None else input_sources(model, inputs)
    if not model.has_inputs:
        missing = [
            entry.name
            for entry, source in zip(model.layout.inputs, sources, strict=True)
            if entry.expression is None and source is None and not entry.order
        ]
        if missing:
            raise ModelError(f"Input {', '.join(missing)} has no source and no expression: give a source in inputs=.")
    return Ode(model, parameters, sources)


def ode(model: Kernel, parameters: Values | None = None, inputs: Mapping[Any, InputSource] | None = None) -> Ode:
    """The right-hand side as a callable f(t, x), for `scipy.integrate.solve_ivp` and similar integrators.

    Parameters
    ----------
    parameters : array_like or mapping, optional
        The defaults otherwise.
    inputs : mapping, optional
        As for `simulate`.

    Returns
    -------
    Ode
        Callable, with its Jacobian as ``.jac``. The integrators in `fourbar_codegen.solvers` call it in C.
        Several threads may use it at the same time.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> from scipy.integrate import solve_ivp
    >>> four_bar = fb.load("four_bar")
    >>> f = four_bar.ode({"l2": 0.45})
    >>> x0 = four_bar.initial_state(parameters={"l2": 0.45})
    >>> solve_ivp(f, (0.0, 1.0), x0, method="Radau", jac=f.jac).success
    True
    >>> solve_ivp(f, (0.0, 1.0), x0, method=fb.solvers.DOP853).success
    True
    """
    return bind(model, parameters, inputs)


def along(
    model: Kernel,
    parameters: Values | None,
    t: Floats,
    r: Floats,
    inputs: Mapping[Any, InputSource] | None,
    held: Collection[str],
) -> tuple[Ode, bool]:
    """The right-hand side with the inputs of a run, and whether an input that prescribes a motion is interpolated.

    Inputs come from their sources. If these are unknown, an input is given by its expression if that agrees with its
    values r, in columns at times t; otherwise r is interpolated linearly, or held, as the names say.
    """
    if inputs is not None:
        return bind(model, parameters, inputs), False
    t, forward = np.unique(t, return_index=True)
    r = r[:, forward]
    expressions = np.reshape([model.default_inputs(time, parameters) for time in t], r.T.shape).T
    sources: list[object] = []
    for name, values, expected in zip(model.inputs, r, expressions, strict=True):
        if np.array_equal(values, expected):
            sources.append(None)
        elif len(t) == 1:
            sources.append(float(values[0]))
        else:
            sources += _interpolants(t, values, "hold" if name in held else "linear", 1)
    entries = model.layout.inputs
    interpolated = {entry.of for entry, source in zip(entries, sources, strict=True) if source is not None}
    return Ode(model, parameters, sources), not interpolated.isdisjoint(model.prescribed)


def by_name(model: Kernel, inputs: Mapping[Any, Any] | None) -> Mapping[Any, Any]:
    """The inputs' sources, by name."""
    if inputs is not None and not is_mapping(inputs):
        names = ", ".join(model.layout.own_inputs)
        raise ModelError(f"inputs must be a mapping from the inputs' names ({names}), not {shown(inputs)}.")
    return {} if inputs is None else inputs


def input_sources(model: Kernel, inputs: Mapping[Any, InputSource] | None) -> list[object]:
    """For each entry of the inputs r: None (its expression), a float, a Table or a callable."""
    entries = model.layout.inputs
    sources: list[object] = [None] * len(entries)
    for name, given in named(by_name(model, inputs), model.layout.own_inputs, "input").items():
        first = model.inputs.index(name)
        orders = _orders(model, name)
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
            kind = _kind(source, len(orders))
            if kind == "hold" and len(orders) > 1:
                raise ModelError(
                    f"Input {name} prescribes a motion, which cannot jump from value to value: a table of it is of the "
                    "kind linear, pchip or cubic, not hold."
                )
            of_orders = list(_interpolants(source[0], source[1], kind, len(orders)))
        else:
            of_orders = [0.0 if order else source for order in orders]
        sources[first : first + len(orders)] = of_orders
    return sources


def own_sources(model: Kernel, inputs: Mapping[Any, Any] | None) -> dict[Any, Any]:
    """The inputs' sources under the keys given, each as `own_source` returns it."""
    return {key: own_source(name_of(key), source) for key, source in by_name(model, inputs).items()}


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


def _kind(source: InterpolationTable, n_orders: int) -> str:
    """The kind of interpolation of a table; where rates are needed, a spline by default."""
    return source[2] if len(source) == 3 else "linear" if n_orders == 1 else "cubic"


def is_held(source: object) -> bool:
    """Whether it is a table of the kind "hold"."""
    return isinstance(source, tuple | list) and len(source) == 3 and isinstance(source[2], str) and source[2] == "hold"


def held_inputs(inputs: Mapping[Any, Any] | None) -> list[str]:
    """The names of inputs whose sources are tables of the kind "hold"."""
    return [name_of(key) for key, source in (inputs or {}).items() if is_held(source)]


def _interpolants(times: Floats, values: Floats, kind: str, orders: int) -> Iterator[Table]:
    """The interpolant of a table, and its derivatives; constant outside of the table."""
    coefficients = _coefficients(times, values, kind)
    before, after = values[0], values[-1]
    ends = np.append(times, np.inf) if kind == "hold" else times
    for _ in range(orders):
        yield Table(ends, coefficients, before, after)
        coefficients = _rate(coefficients)
        before = after = 0.0


def _coefficients(times: Floats, values: Floats, kind: str) -> Floats:
    """The polynomials of an interpolant of values, shape (n_t, ...), the highest power first, and then the intervals.

    Source: F. N. Fritsch, J. Butland, "A method for constructing local monotone piecewise cubic interpolants", *SIAM
    Journal on Scientific and Statistical Computing* 5 (1984), as ``scipy.interpolate.PchipInterpolator`` has it.
    """
    if kind == "linear":
        lengths = np.diff(times).reshape(-1, *(1,) * (values.ndim - 1))
        return np.array([np.diff(values, axis=0) / lengths, values[:-1]])
    if kind == "hold":  # the last interval has no end
        return values[np.newaxis]
    from scipy.interpolate import CubicSpline, PchipInterpolator

    coefficients: Floats = (CubicSpline if kind == "cubic" else PchipInterpolator)(times, values).c
    return coefficients


def _rate(coefficients: Floats) -> Floats:
    """The derivative over time of polynomials with these coefficients, the highest power first."""
    powers = np.arange(len(coefficients) - 1, 0, -1).reshape(-1, *(1,) * (coefficients.ndim - 1))
    rates: Floats = coefficients[:-1] * powers if len(powers) else np.zeros((1, *coefficients.shape[1:]))
    return rates


def source_changes(model: Kernel, name: str, source: float | InterpolationTable) -> dict[int, Floats]:
    """The derivatives of an input's sources with respect to its value, or to the values of its table.

    Parameters
    ----------
    model : Kernel
    name : str
    source : float or tuple
        As `own_source` returns it.

    Returns
    -------
    dict of int to ndarray, shape (m, n)
        For each entry of the inputs r that is made of it. Rows are for the source's value; or for the coefficients of
        its `Table`, interval by interval, then for its values before and after. Columns are for the n given values.
    """
    if not isinstance(source, tuple):
        return _changes(model, name, np.ones((1, 1, 1)))
    basis = _value_basis(source[0], source[1], _kind(source, len(_orders(model, name))))
    return _changes(model, name, basis, np.eye(len(source[0]))[[0, -1]])


def arbitrary_changes(
    model: Kernel, name: str, source: Any, n: int, generator: np.random.Generator
) -> dict[int, Floats]:
    """Changes of an input's sources, as those of `source_changes`, by n arbitrary values of the size of its own."""
    own = own_source(name, source)
    given: Any = own[1] if isinstance(own, tuple) else [own]
    values = (np.abs(given).max() or 1.0) * generator.standard_normal((len(given), n))
    if not isinstance(own, tuple):
        return _changes(model, name, values[np.newaxis])
    coefficients = _coefficients(own[0], values, _kind(own, len(_orders(model, name))))
    return _changes(model, name, coefficients, values[[0, -1]])


def _orders(model: Kernel, name: str) -> list[int]:
    """The orders of the entries of r that an input makes, one after the other from 0 on."""
    return [entry.order for entry in model.layout.inputs if entry.of == name]


def _changes(model: Kernel, name: str, coefficients: Floats, outside: Floats | None = None) -> dict[int, Floats]:
    """Changes of an input's source and of its rates, from those of its coefficients, shape (powers, intervals, n), and
    of its values before and after.
    """
    first, found = model.inputs.index(name), {}
    for order in _orders(model, name):
        rows = np.swapaxes(coefficients, 0, 1).reshape(-1, coefficients.shape[2])
        found[first + order] = rows if outside is None else np.vstack((rows, outside))
        coefficients = _rate(coefficients)
        outside = None if outside is None else np.zeros_like(outside)
    return found


def wrt_values(
    model: Kernel, name: str, source: float | InterpolationTable, wrt_sources: Sequence[Floats | None]
) -> float | Floats:
    """The derivatives with respect to an input's value, or to the values of its table, shape (n,), from those with
    respect to its sources.

    Parameters
    ----------
    model : Kernel
    name : str
    source : float or tuple
        As `own_source` returns it.
    wrt_sources : sequence of length n_r
        As `Steps.gradient` returns them.
    """
    first = model.inputs.index(name)
    pairs = zip(model.layout.inputs, wrt_sources, strict=True)
    parts = [part for entry, part in pairs if entry.of == name and part is not None]
    # Of thousands of values, perhaps.
    kind = _kind(source, len(parts)) if isinstance(source, tuple) else None
    if kind == "hold":
        held: Floats = parts[0][:-2].copy()
        held[[0, -1]] += parts[0][-2:]
        return held
    if isinstance(source, tuple) and kind == "linear":
        found = np.zeros(len(source[0]))
        for order, part in enumerate(parts[:2]):
            weights = part[:-2].reshape(len(found) - 1, -1)
            slopes = weights[:, 0] / np.diff(source[0])
            found[1:] += slopes
            found[:-1] -= slopes
            if not order:
                found[:-1] += weights[:, 1]
                found[[0, -1]] += part[-2:]
        return found
    changes = source_changes(model, name, source)
    summed: Floats = np.sum([part @ changes[first + order] for order, part in enumerate(parts)], axis=0)
    return summed if isinstance(source, tuple) else float(summed[0])


def changes_at(source: object, changes: Floats, times: Floats) -> Floats:
    """The derivatives of an input at times, shape (n, n_t), from those of its source by `source_changes`."""
    if not isinstance(source, Table):
        return np.repeat(changes.T, len(times), axis=1)
    ends, n = source.times, changes.shape[1]
    place = np.clip(np.searchsorted(ends, times, side="right") - 1, 0, len(ends) - 2)
    pieces = changes[:-2].reshape(len(ends) - 1, -1, n)[place]
    powers = (times - ends[place])[:, np.newaxis] ** np.arange(pieces.shape[1] - 1, -1, -1)
    found: Floats = np.einsum("tk,tkn->nt", powers, pieces)
    found[:, times < ends[0]], found[:, times > ends[-1]] = changes[-2][:, np.newaxis], changes[-1][:, np.newaxis]
    return found


def _value_basis(times: Floats, values: Floats, kind: str) -> Floats:
    """The derivatives of a table's coefficients with respect to its values, shape (powers, intervals, values)."""
    n = len(times)
    if kind != "pchip":  # they are linear in the values
        return _coefficients(times, np.eye(n), kind)
    lengths = np.diff(times)[:, np.newaxis]
    slopes: Floats = np.diff(np.eye(n), axis=0) / lengths
    rates = _monotone_rates(times, values)
    begin, end = rates[:-1], rates[1:]
    cubic, square = (begin + end - 2.0 * slopes) / lengths**2, (3.0 * slopes - 2.0 * begin - end) / lengths
    return np.array([cubic, square, begin, np.eye(n)[:-1]])


def _monotone_rates(times: Floats, values: Floats) -> Floats:
    """The derivatives of a monotone interpolant's slopes at its points with respect to its values, (n, n).

    With differences m_k over lengths h_k, the slope between two of the same sign is their weighted harmonic mean d:
    (w + v) / d = w / m_(k-1) + v / m_k, w = 2 h_k + h_(k-1), v = h_k + 2 h_(k-1); otherwise 0. At the ends it is that
    of the parabola through three points, within limits.
    """
    n, h = len(times), np.diff(times)
    slopes = np.diff(np.eye(n), axis=0) / h[:, np.newaxis]
    if n == 2:
        return np.repeat(slopes, 2, axis=0)
    m, rates = np.diff(values) / h, np.zeros((n, n))
    for k in range(1, n - 1):
        if m[k - 1] * m[k] > 0.0:
            w, v = 2.0 * h[k] + h[k - 1], h[k] + 2.0 * h[k - 1]
            d = (w + v) / (w / m[k - 1] + v / m[k])
            rates[k] = d**2 / (w + v) * (w / m[k - 1] ** 2 * slopes[k - 1] + v / m[k] ** 2 * slopes[k])
    for end, first, second in ((0, 0, 1), (n - 1, n - 2, n - 3)):
        near, far = (2.0 * h[first] + h[second]) / (h[first] + h[second]), h[first] / (h[first] + h[second])
        at_end = near * m[first] - far * m[second]
        if at_end * m[first] <= 0.0:
            continue
        if m[first] * m[second] < 0.0 and abs(at_end) > 3.0 * abs(m[first]):
            rates[end] = 3.0 * slopes[first]
        else:
            rates[end] = near * slopes[first] - far * slopes[second]
    return rates


def inputs_at(model: Kernel, t: float, p: Floats | None, inputs: Mapping[Any, InputSource] | None) -> Floats | None:
    """The inputs for results of configuration and motion only, where only inputs that prescribe a motion count.

    A callable may depend on the state, which is not known yet. It cannot prescribe a motion, so it is replaced by 0.
    """
    if not inputs:
        return None  # the expressions
    sources = [0.0 if callable(source) else source for source in input_sources(model, inputs)]
    r = Ode(model, p, sources).input_values(t, np.zeros(model.n_x))
    entries = model.layout.inputs
    missing = dict.fromkeys(entries[i].of for i in model.layout.prescribed_places if np.isnan(r[i]))
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
