"""Consistent initial states from independent coordinates and speeds."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.loop_closure import SINGULAR_RATIO, Loops, nearest_closed
from fourbar_codegen.analysis.staged_closing import OpenLoop, close_in_stages, turned_towards
from fourbar_codegen.errors import AssemblyError, ModelError, ModelWarning, shown
from fourbar_codegen.interface.arguments import Values, flag, is_mapping, name_of, named, named_array
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.kernel.dependent import INDEPENDENCE_RTOL, row_sizes, solve_dependent
from fourbar_codegen.kernel.inputs import InputSource, inputs_at
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.sensitivity import initial_derivatives
from fourbar_codegen.results.assembly_modes import AssemblyModes
from fourbar_codegen.runtime.evaluator import numbers

__all__ = ["check_speeds", "initial_state", "initial_state_derivatives", "initial_states", "nearby_state"]

Floats = NDArray[np.float64]

MAX_FURTHER_GUESSES = 40
"""Further guesses that are tried before a loop counts as open."""

MAX_NAMED = 8
"""Up to this number, messages name all coordinates, also those that are zero."""

FLAT_RATIO = 1e-4
"""If all entries of a column of J_d are below this, in scaled rows, speeds are tested at a neighbouring position."""

MAX_ANGLE = 720.0
"""Largest number of degrees; nobody means more."""

SPEED_RTOL = 0.01
"""If rounding errors of the position change speeds by more than this fraction, they are undetermined."""

VELOCITY_RTOL = 1e-10
"""Tolerance of velocity constraints, relative to their terms."""

GIVEN_VELOCITY_RTOL = 1e-6
"""The same, with dependent speeds as they are given, ..."""

AT_REST_ATOL = 1e-8
"""... which are zero up to this size, m/s or rad/s: at rest, the terms are rounding errors themselves."""


@overload
def initial_state(
    model: Kernel,
    coordinates: Values | None = ...,
    speeds: Values | None = ...,
    *,
    t: float = ...,
    guess: Values | None = ...,
    bounds: Mapping[Any, tuple[float, float]] | None = ...,
    parameters: Values | None = ...,
    inputs: Mapping[Any, InputSource] | None = ...,
    auxiliary_states: Values | None = ...,
    derivatives: Literal[False] = ...,
) -> Floats: ...


@overload
def initial_state(
    model: Kernel,
    coordinates: Values | None = ...,
    speeds: Values | None = ...,
    *,
    t: float = ...,
    guess: Values | None = ...,
    bounds: Mapping[Any, tuple[float, float]] | None = ...,
    parameters: Values | None = ...,
    inputs: Mapping[Any, InputSource] | None = ...,
    auxiliary_states: Values | None = ...,
    derivatives: Literal[True],
) -> tuple[Floats, dict[str, Floats]]: ...


def initial_state(
    model: Kernel,
    coordinates: Values | None = None,
    speeds: Values | None = None,
    *,
    t: float = 0.0,
    guess: Values | None = None,
    bounds: Mapping[Any, tuple[float, float]] | None = None,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
    auxiliary_states: Values | None = None,
    derivatives: bool = False,
) -> Floats | tuple[Floats, dict[str, Floats]]:
    """A state that satisfies all constraints, from the independent coordinates and speeds.

    The position constraints are solved for the dependent coordinates: by Newton's method as long as each step at
    least halves the residual, otherwise by SciPy's ``fsolve`` with the Jacobian, otherwise loop by loop with damped
    least squares. The dependent speeds follow from the velocity constraints, which are linear in them.

    Parameters
    ----------
    coordinates, speeds : array_like or mapping, optional
        Values of the independent ones; by default the model's initial values.
    t : float, optional
        Time, s.
    guess : array_like or mapping, optional
        Starting values of the dependent coordinates; they decide which assembly mode is found. By default the
        model's guess, or 0; if loops do not close from there, further guesses around it are tried, and the nearest
        solution of each loop is taken.
    bounds : mapping, optional
        Ranges (low, high) of dependent coordinates, such as that of a knee; unbounded otherwise.
    parameters : array_like or mapping, optional
        The defaults otherwise.
    inputs : mapping, optional
        As for `simulate`; only those that prescribe a motion matter.
    auxiliary_states : array_like or mapping, optional
        Their values; by default the model's initial values.
    derivatives : bool, optional
        True is another spelling of `initial_state_derivatives`.

    Returns
    -------
    ndarray, shape (n_x,)

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite; or if the state is the model's initial one, and
        its values of dependent speeds violate the constraints.
    AssemblyError
        If the loops do not close, or the dependent speeds are not determined.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> x0 = fb.load("four_bar").initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
    >>> x0.round(6).tolist()
    [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
    """
    find: Any = initial_state_derivatives if flag(derivatives, "derivatives") else _closed
    found: Floats | tuple[Floats, dict[str, Floats]] = find(
        model,
        coordinates,
        speeds,
        t=t,
        guess=guess,
        bounds=bounds,
        parameters=parameters,
        inputs=inputs,
        auxiliary_states=auxiliary_states,
    )
    return found


def initial_state_derivatives(
    model: Kernel,
    coordinates: Values | None = None,
    speeds: Values | None = None,
    *,
    t: float = 0.0,
    guess: Values | None = None,
    bounds: Mapping[Any, tuple[float, float]] | None = None,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
    auxiliary_states: Values | None = None,
) -> tuple[Floats, dict[str, Floats]]:
    """A state that satisfies all constraints, and its derivatives, by the implicit function theorem.

    Parameters
    ----------
    coordinates, speeds, t, guess, bounds, parameters, inputs, auxiliary_states
        As for `initial_state`.

    Returns
    -------
    ndarray, shape (n_x,)
        As of `initial_state`.
    dict of str to ndarray, shape (n_x,)
        The derivatives of the state with respect to the independent values, the parameters and the given inputs, by
        name; of the shape (n, n_x) for the n values of a table. Parameters are left out that redundant constraints do
        not let change alone, such as one of the lengths of a parallelogram with a bar too many.

    Raises
    ------
    ModelError, AssemblyError
        As for `initial_state`; an AssemblyError also if the state has no derivatives, at a singular position.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> x0, by = fb.load("four_bar").initial_state_derivatives({"q1": -0.5}, {"u1": -0.1})
    >>> by["l2"][1].round(4).item()  # dq2/dl2
    -0.826
    """
    x0 = _closed(
        model,
        coordinates,
        speeds,
        t=t,
        guess=guess,
        bounds=bounds,
        parameters=parameters,
        inputs=inputs,
        auxiliary_states=auxiliary_states,
    )
    return x0, initial_derivatives(model, t, x0, parameters, inputs)


def _closed(
    model: Kernel,
    coordinates: Values | None = None,
    speeds: Values | None = None,
    *,
    t: float,
    guess: Values | None = None,
    bounds: Mapping[Any, tuple[float, float]] | None = None,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    auxiliary_states: Values | None = None,
) -> Floats:
    """A state that satisfies all constraints."""
    loops, u_i, start = _given(model, coordinates, speeds, t, guess, parameters=parameters, inputs=inputs)
    if coordinates is not None:
        _warn_of_degrees(model, loops.q_i)
    limits = _limits(bounds, model.coordinates[len(loops.q_i) :])
    x = _state(loops, start, guess is not None, limits, u_i, _auxiliary_values(model, auxiliary_states))
    if coordinates is None and speeds is None and guess is None:
        _check_initial_speeds(loops, x)
    return x


def _check_initial_speeds(loops: Loops, x: Floats) -> None:
    """Raise if the model's initial values of dependent speeds, which are not needed, violate the constraints.

    They belong to its own parameters, prescribed motions and t = 0: with others, they are not looked at.
    """
    model, known, n_q = loops.model, loops.model.layout.initial, loops.model.n_q
    n_ui = model.layout.n_independent_speeds
    dependent = [name for name in model.speeds[n_ui:] if name in known]
    if not dependent or loops.t != 0.0 or not _are_own(loops):
        return
    x = x.copy()
    x[[n_q + model.speeds.index(name) for name in dependent]] = [known[name] for name in dependent]
    jacobian, bias = model.velocity(loops.t, x, loops.p, loops.r)
    check_speeds(jacobian, bias, model.speeds, x[n_q : n_q + model.n_u], n_ui, dependent)


def check_speeds(
    jacobian: Floats, bias: Floats, names: Sequence[str], u: Floats, n_independent: int, given: Sequence[str]
) -> None:
    """Raise a ModelError if initial values of dependent speeds violate the constraints.

    Parameters
    ----------
    jacobian, bias : ndarray, shape (n_c, n_u) and (n_c,)
        J and b at the initial position.
    names : sequence of str
        The speeds' names, the independent ones first.
    u : ndarray, shape (n_u,)
    n_independent : int
    given : sequence of str
        The dependent speeds with an initial value.
    """
    residual, sizes = jacobian @ u + bias, np.abs(jacobian)
    terms = sizes @ np.abs(u) + np.abs(bias)
    excess = np.abs(residual) - GIVEN_VELOCITY_RTOL * terms - AT_REST_ATOL * sizes.sum(axis=1)
    if (excess > 0.0).any():
        row = int(np.argmax(excess))
        raise ModelError(
            f"The speeds in initial= violate velocity constraint {row + 1}: J u + b = {residual[row]:.6g} there, with "
            f"{_named(names, u)}. Correct the dependent ones ({', '.join(given)}), or leave them out: they "
            f"follow from the independent speeds ({', '.join(names[:n_independent]) or 'none'})."
        )


def _are_own(loops: Loops) -> bool:
    """Whether parameters and prescribed motions are the model's own, as far as it has values of them."""
    model = loops.model
    own = np.array([*model.defaults.values()], dtype=float)
    pairs = [] if loops.p is None else [(loops.p, own)]
    if loops.r is not None:
        places = model.layout.prescribed_places
        pairs.append((loops.r[places], model.default_inputs(loops.t, loops.p)[places]))
    return all(bool((np.isnan(expected) | (values == expected)).all()) for values, expected in pairs)


def nearby_state(
    model: Kernel, x: Floats, *, t: float, parameters: Floats, inputs: Mapping[Any, InputSource] | None
) -> Floats:
    """A state that satisfies all constraints, with the independent values of x, and its dependent coordinates as guess.

    Raises
    ------
    AssemblyError
        As `initial_state`.
    """
    n_qi = model.layout.n_independent_coordinates
    n_ui = model.layout.n_independent_speeds
    q, u, z = x[: model.n_q], x[model.n_q : model.n_q + model.n_u], x[model.n_q + model.n_u :]
    loops = Loops(model, t, q[:n_qi], parameters, inputs_at(model, t, parameters, inputs))
    return _state(loops, q[n_qi:], True, None, u[:n_ui], z)


def _state(
    loops: Loops, guess: Floats, is_given: bool, limits: tuple[Floats, Floats] | None, u_i: Floats, z: Floats
) -> Floats:
    q = loops.coordinates(_close(loops, guess, is_given, limits) if loops.model.n_h else guess)
    return np.concatenate((q, _dependent_speeds(loops, q, u_i), z))


def initial_states(
    model: Kernel,
    coordinates: Values | None = None,
    speeds: Values | None = None,
    *,
    t: float = 0.0,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
    auxiliary_states: Values | None = None,
) -> AssemblyModes:
    """All assembly modes: the states that satisfy the constraints for given independent coordinates and speeds.

    The result is complete for chains of dyads: one or two constraints at a time, with no more unknown coordinates
    than constraints, trigonometric in angles and polynomial in displacements. Examples are the four-bar linkage,
    the slider-crank, and combinations of them. Otherwise multistart search is used, and the number of modes is a
    lower bound. If a part can still move while the independent coordinates are held, the search ends, and ``free``
    names the coordinates that move. See `fourbar_codegen.analysis.assembly_modes` for the method.

    Parameters
    ----------
    coordinates, speeds, t, parameters, inputs, auxiliary_states
        As for `initial_state`.

    Returns
    -------
    AssemblyModes
        A sequence of states, empty if the loops cannot be closed, with ``is_complete``, ``free`` and ``plot()``.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> modes = fb.load("four_bar").initial_states({"q1": -0.5})
    >>> len(modes), modes.is_complete
    (2, True)
    """
    from fourbar_codegen.analysis.assembly_modes import closed_coordinates

    loops, u_i, start = _given(model, coordinates, speeds, t, None, parameters=parameters, inputs=inputs)
    with Progress(f"{model.name}: ways to close the loops") as progress:
        found, is_complete, free = closed_coordinates(loops, start, progress) if model.n_h else ([start], True, ())
    z = _auxiliary_values(model, auxiliary_states)
    states = []
    for dependent in found:
        q = loops.coordinates(dependent)
        try:
            u = _dependent_speeds(loops, q, u_i)
        except UndeterminedSpeedsError:
            u = np.concatenate((u_i, np.full(model.n_u - len(u_i), np.nan)))
        states.append(np.concatenate((q, u, z)))
    x = np.reshape(states, (len(states), model.n_x))
    return AssemblyModes(model, loops.t, x, is_complete, loops.p, loops.r, free)


def _warn_of_degrees(model: Kernel, q_i: Floats) -> None:
    """Warn of angles beyond a turn that are a whole number of radians: they are rather degrees."""
    for name, value in zip(model.coordinates, q_i, strict=False):
        if 2.0 * math.pi < abs(value) <= MAX_ANGLE and value == round(value) and name in model.layout.angles:
            warnings.warn(
                f"{name} = {value:g} rad is more than a turn: angles are in radians. If {value:g} degrees are meant, "
                f"give {math.radians(value):.6g}.",
                ModelWarning,
                stacklevel=4,
            )


def _auxiliary_values(model: Kernel, given: Values | None) -> Floats:
    """Values of the auxiliary states: as given, or the model's initial ones."""
    return named_array(given, model.auxiliary_states, model.layout.initial, "auxiliary state")


def _given(
    model: Kernel,
    coordinates: Values | None,
    speeds: Values | None,
    t: float,
    guess: Values | None,
    *,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> tuple[Loops, Floats, Floats]:
    """The loops to be closed, the independent speeds, and the guess of the dependent coordinates."""
    n_qi = model.layout.n_independent_coordinates
    n_ui = model.layout.n_independent_speeds
    initial = model.layout.initial
    p = model.parameter_vector(parameters)
    given = {name_of(key) for key in coordinates} if is_mapping(coordinates) else set()
    misplaced = [name for name in model.coordinates[n_qi:] if name in given]
    if misplaced:
        raise ModelError(
            f"{misplaced[0]!r} is a dependent coordinate: give a guess of it in guess=. Of the independent coordinates "
            f"({', '.join(model.coordinates[:n_qi]) or 'none'}) give values."
        )
    q_i = named_array(coordinates, model.coordinates[:n_qi], initial, "independent coordinate")
    u_i = named_array(speeds, model.speeds[:n_ui], initial, "independent speed")
    return Loops(model, t, q_i, p, inputs_at(model, t, p, inputs)), u_i, dependent_guess(model, guess)


def dependent_guess(model: Kernel, guess: Values | None) -> Floats:
    """Starting values of the dependent coordinates, from those given, of the model, or 0."""
    dependent = model.coordinates[model.layout.n_independent_coordinates :]
    known = {**dict.fromkeys(dependent, 0.0), **model.layout.initial}
    return named_array(guess, dependent, known, "dependent coordinate")


def _limits(bounds: Mapping[Any, tuple[float, float]] | None, names: Sequence[str]) -> tuple[Floats, Floats] | None:
    """The smallest and largest values of the dependent coordinates."""
    if bounds is None:
        return None
    if not is_mapping(bounds):
        raise ModelError(f"bounds= must be a mapping from dependent coordinates to pairs, not {shown(bounds)}.")
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, pair in named(bounds, names, "dependent coordinate").items():
        limits = numbers(pair, f"The bounds of {name}")
        if limits.shape != (2,) or not limits[0] < limits[1]:
            raise ModelError(f"The bounds of {name} must be a smaller and a larger number, not {shown(pair)}.")
        lower[names.index(name)], upper[names.index(name)] = limits
    return lower, upper


def _close(loops: Loops, start: Floats, is_given: bool, limits: tuple[Floats, Floats] | None) -> Floats:
    """Dependent coordinates that satisfy the position constraints, from a guess of them.

    A guess of the user selects the assembly mode; solutions from other guesses are not returned.
    """
    dependent = loops.search(start)
    if dependent is not None:
        dependent = turned_towards(loops, dependent, start)
        if limits is None or ((dependent >= limits[0]) & (dependent <= limits[1])).all():
            return dependent
    model, q_i = loops.model, loops.q_i
    names = model.coordinates[len(q_i) :]
    found, open_loops = close_in_stages(loops, start, 0 if is_given else MAX_FURTHER_GUESSES, limits)
    if not open_loops and loops.are_closed(found):
        return found
    message = f"The loops do not close from the guess {_named(names, start)}"
    prescribed = _prescribed(loops)
    if q_i.size or prescribed:
        held, values = (*model.coordinates[: len(q_i)], *prescribed), np.append(q_i, [*prescribed.values()])
        message += f" with {_named(held, values)}"
    if limits:
        message += " within the bounds"
    other, still_open = close_in_stages(loops, start, MAX_FURTHER_GUESSES, limits) if is_given else (found, open_loops)
    if not still_open and loops.are_closed(other):
        raise AssemblyError(
            f"{message}: {_open(loops, open_loops)}. They close from other guesses, for instance "
            f"guess={other.round(3).tolist()}, or without one; initial_states lists all assembly modes.",
            loops.residual(found),
        )
    causes = [
        "the parameters (a link may be too long or too short)",
        *["the bounds"] * bool(limits),
        *["the prescribed motions"] * bool(prescribed),
        *["the independent coordinates"] * bool(q_i.size),
    ]
    message += (
        f", and cannot be closed from {MAX_FURTHER_GUESSES} other guesses for each loop: {_open(loops, still_open)}. "
        f"Check {' and '.join([', '.join(causes[:-1])] * (len(causes) > 1) + causes[-1:])}"
    )
    near = None
    if q_i.size and not limits:
        near = nearest_closed(model, loops.t, loops.coordinates(other), loops.p, loops.r)
    if near is not None and np.abs(near[: len(q_i)] - q_i).max(initial=0.0) < np.pi:
        message += f"; all loops close, for instance, with {_named(model.coordinates, near[: len(q_i)])}"
    raise AssemblyError(f"{message}.", loops.residual(other))


def _prescribed(loops: Loops) -> dict[str, float]:
    """The prescribed motions that positions depend on, by name."""
    model = loops.model
    r = model.default_inputs(loops.t, loops.p) if loops.r is None else loops.r
    places = [place for place, entry in enumerate(model.layout.inputs) if entry.is_prescribed and not entry.order]
    return {model.inputs[place]: float(r[place]) for place in places}


def _open(loops: Loops, open_loops: Sequence[OpenLoop]) -> str:
    """Which loops remain open, and by how much."""
    model, n_i = loops.model, len(loops.q_i)
    return "; ".join(
        f"constraints {', '.join(str(row + 1) for row in loop.rows)}, to be closed by "
        f"{', '.join(model.coordinates[n_i + column] for column in loop.columns) or 'no coordinate'}, stay open by "
        f"{np.abs(loop.residual).max():.3g}"
        if np.isfinite(loop.residual).all()
        else f"constraints {', '.join(str(row + 1) for row in loop.rows)} have no value there"
        for loop in open_loops
    )


class UndeterminedSpeedsError(AssemblyError):
    """The dependent speeds do not follow from the independent ones in a configuration."""


def _dependent_speeds(loops: Loops, q: Floats, u_i: Floats) -> Floats:
    """All speeds: the dependent ones solve J_d u_d = -(J_i u_i + b), which must determine them.

    Where a column of J_d is small, as in a toggle position, the speeds must be the same at a neighbouring position
    within rounding errors.
    """
    speeds, size = _speeds_at(loops, q, u_i)
    if size < FLAT_RATIO and loops.n_dependent:
        beside = q.copy()
        beside[len(loops.q_i) :] += loops.uncertainty(q[len(loops.q_i) :])
        if np.abs(_speeds_at(loops, beside, u_i)[0] - speeds).max() > SPEED_RTOL * np.abs(speeds).max():
            raise _undetermined(loops, q, u_i)
    return speeds


def _undetermined(loops: Loops, q: Floats, u_i: Floats) -> UndeterminedSpeedsError:
    model = loops.model
    return UndeterminedSpeedsError(
        f"The dependent speeds ({', '.join(model.speeds[len(u_i) :])}) do not follow from the independent ones at "
        f"{_named(model.coordinates, q)}: the constraints' Jacobian with respect to them is singular. Start from "
        "another configuration, or choose other independent speeds."
    )


def _speeds_at(loops: Loops, q: Floats, u_i: Floats) -> tuple[Floats, float]:
    """All speeds at a position, and the size of the smallest column of J_d, with rows scaled by their largest entry."""
    model, n_i = loops.model, len(u_i)
    jacobian, bias = model.velocity(loops.t, np.concatenate((q, np.zeros(model.n_x - model.n_q))), loops.p, loops.r)
    if not model.n_c:
        return u_i, 1.0
    size = row_sizes(jacobian)
    jacobian, bias = jacobian / size, bias / size[:, 0]
    if model.n_c > model.n_u - n_i:
        rank = int(np.linalg.matrix_rank(jacobian, rtol=INDEPENDENCE_RTOL))
        if rank > model.n_u - n_i:
            raise AssemblyError(model.too_few_dependent(f"at {_named(model.coordinates, q)}", rank))
    known = jacobian[:, :n_i] @ u_i + bias
    u_d, determined = solve_dependent(jacobian, n_i, known, SINGULAR_RATIO)
    error = np.abs(jacobian[:, n_i:] @ u_d + known).max()
    terms = max(np.abs(jacobian[:, n_i:]).max() * np.abs(u_d).max(), np.abs(known).max())
    if determined < len(u_d) or not error <= VELOCITY_RTOL * terms:
        raise _undetermined(loops, q, u_i)
    smallest = float(np.abs(jacobian[:, n_i:]).max(axis=0).min(initial=1.0))
    return np.concatenate((u_i, u_d)), smallest


def _named(names: Sequence[str], values: Floats) -> str:
    pairs = [*zip(names, values, strict=False)]
    told = [(name, value) for name, value in pairs if value or len(pairs) <= MAX_NAMED]
    others = [] if len(told) == len(pairs) else [f"{len(pairs) - len(told)} others 0" if told else "all 0"]
    return ", ".join([*(f"{name} = {value:.6g}" for name, value in told), *others]) or "none"
