"""Inverse dynamics: the inputs, such as motor torques, that a given motion needs.

In the equations M u' = f(r) + F(n, r) + J^T lambda and 0 = Q(n, r) - M_a u' + J_a^T lambda, the motion is known, and
unknown are some inputs r, the multipliers lambda, and the unknown forces n that drive the motion. The inputs are
determined if they are as many as the degrees of freedom, and no combination of their columns (f_r + F_r; Q_r) is one
of the columns (J^T, F_n; J_a^T, Q_n). The mass matrix is not inverted, so that inertia may vanish, as that of a piston
does at its dead points. One step of Newton's method is exact where inputs and forces enter linearly.

Source: J. Garcia de Jalon and E. Bayo, *Kinematic and Dynamic Simulation of Multibody Systems*, Springer 1994,
chapter 6.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.loop_closure import require_closed, row_scales
from fourbar_codegen.errors import ModelError, ModelWarning, SimulationError, meant, shown
from fourbar_codegen.interface.arguments import Values, is_mapping, named, named_columns, names_of, numbers
from fourbar_codegen.kernel.dependent import solve_redundant
from fourbar_codegen.kernel.inputs import InputSource, bind, by_name, is_by_member
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["inverse_dynamics"]

Floats = NDArray[np.float64]

RANK_RTOL = 1e-10
"""Smallest singular value that counts, relative to the largest, of matrices with scaled rows and columns."""

MIN_COLUMN_SIZE = 1e-3
"""Columns are scaled up from this size, where rows have the size 1: an input at a dead point has a column of rounding
errors, which should not count."""

CONSISTENCY_RTOL = 1e-6
"""Largest violation of the constraints by given accelerations, relative to its terms."""

RESIDUAL_RTOL = 1e-12
"""Largest residual of each equation, relative to its terms, ..."""

LOOSE_RESIDUAL_RTOL = 1e-9
"""... and if rounding errors prevent further progress."""

ROUNDING_RTOL = 1e-13
"""Rounding errors of the largest term of all equations, which may stay in small equations."""

MAX_ITERATIONS = 30

OTHER_TIMES = np.append(np.nan, np.geomspace(1e-3, 1e3, 601))
"""Times later by these, s, are tried with callables that take numbers alone. What is computed from NaN is NaN."""


def inverse_dynamics(
    model: Kernel,
    motion: Branch | Trajectory | tuple[ArrayLike, Any, Any],
    find: str | Sequence[Any] | None = None,
    *,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource | Floats] | None = None,
) -> dict[str, Floats]:
    """The inputs, such as motor torques, that a given motion needs.

    As many inputs are found as there are degrees of freedom. The mass matrix is not inverted, so that parts may
    have no mass.

    Parameters
    ----------
    motion : Branch, Trajectory, or tuple (t, x, accelerations)
        A branch of `kinematics`, with the rates for which it was found. Or a run, also of another model with the
        same coordinates and speeds, such as one where a drive prescribes them. Or times, float or shape (n,);
        states, shape (n_x,) or (n_x, n), or a mapping from names; and rates of the speeds: an array of shape (n_u,)
        or (n_u, n), or a mapping from names of some, from which the constraints determine the others.
    find : str or sequence of str, optional
        Names of the inputs to find; by default all that are not given and prescribe no motion.
    parameters : array_like or mapping, optional
        By default those of the branch or run, otherwise the model's.
    inputs : mapping, optional
        Sources of the other inputs, as for `simulate`, or arrays of shape (n,) with a value for each state. All
        positions of a branch are at its one time, as are states with a time in common: a load that changes along
        them is an array or a callable of (t, x) that depends on x, not a table; where another load depends on time,
        a ModelWarning says so.

    Returns
    -------
    dict of str to ndarray, shape (n,), or () for a single state
        NaN where the motion is not known, and where these inputs cannot bring it about: at their dead points.

    Raises
    ------
    ModelError
        If an argument has a wrong name or shape, the number of inputs is not that of the degrees of freedom, or a
        state or its accelerations violate the constraints.
    SimulationError
        If the inputs are not determined at any of the states.

    Source: J. Garcia de Jalon, E. Bayo, *Kinematic and Dynamic Simulation of Multibody Systems*, Springer 1994.

    Examples
    --------
    The torque that turns a massless crank at 10 rad/s with a piston of 2 kg:

    >>> import fourbar_codegen as fb
    >>> import numpy as np
    >>> points = {"O": (0, 0), "A": (0, 0.1), "C": (0.3, 0)}
    >>> linkage = fb.Linkage("engine", points=points, ground="O", links=["OA", "AC"])
    >>> linkage.slider("C", along=(1, 0), mass=2.0)
    >>> linkage.torque("O", "torque")
    >>> engine = fb.compile_model(linkage.model())
    >>> found = engine.kinematics({"q_OA": np.linspace(0.0, 2 * np.pi, 73)}, rates={"q_OA": 10.0})
    >>> engine.inverse_dynamics(found[0])["torque"].max().round(4)
    np.float64(1.3573)
    """
    without_rates = _names(model)
    sources = named(by_name(model, inputs), without_rates, "input")
    names = _unknown(model, find, sources)
    given = _read_tuple(model, motion) if isinstance(motion, tuple) else _read_result(model, motion)
    if parameters is None or is_mapping(parameters):
        parameters = given.parameters | named(parameters or {}, model.parameters, "parameter")
    p = model.parameter_vector(parameters)
    carried = _carried(model, given, {*sources, *names}) | _by_instant(model, given, sources)
    set_below = [name for name in without_rates if name in names or name in carried]
    ode = bind(model, p, {**sources, **dict.fromkeys(set_below, 0.0)})
    if given.one_time:
        _check_time(model, given, p, sources, names)
    rows, others = ([model.inputs.index(name) for name in group] for group in (names, carried))
    guesses = np.array([given.inputs.get(name, np.full(given.shape, np.nan)) for name in names])
    found, sizes = np.full((len(names), *given.shape), np.nan), None
    is_moving, refused = False, None
    for k in np.ndindex(given.shape):
        t, x, rates = float(given.times[k]), given.states[:, *k], given.rates[:, *k]
        if np.isfinite(x).all() and np.isfinite(rates).all():
            r = ode.input_values(t, x)
            r[others] = [values[k] for values in carried.values()]
            if sizes is None:
                sizes = row_scales(model, t, x[: model.n_q], p, r, np.ones(model.n_q))[1]
            try:
                require_closed(model, t, x, p, r)
                accelerations = _accelerations(_Instant(model, t, x, p, r), given.rows, rates, sizes)
            except ModelError as error:
                if isinstance(motion, tuple):
                    raise
                refused = refused or error  # a result may violate constraints at some states
                continue
            if accelerations is not None:
                is_moving = True
                found[:, *k] = _balance(_Instant(model, t, x, p, r), accelerations, rows, guesses[:, *k])
    if refused is not None and not is_moving:
        raise refused
    if not is_moving:
        raise ModelError(
            f"The motion is known at none of its {found[0].size} states: "
            + (
                "there are none."
                if not found[0].size
                else "give finite states, and rates of speeds that determine all."
            )
        )
    if not np.isfinite(found).any():
        raise SimulationError(
            f"{', '.join(names)} cannot bring about this motion: the equations determine them at none of its states. "
            "Inputs that act through auxiliary states, or in a singular position, do not change accelerations."
        )
    return dict(zip(names, found, strict=True))


@dataclass(frozen=True)
class _Motion:
    """A motion as it was given.

    Attributes
    ----------
    source : str
        Where it comes from.
    one_time : str
        What tells that different states are at one time, in words; empty if they are not.
    times : ndarray, shape (...)
    states : ndarray, shape (n_x, ...)
    rows : list of int
        Numbers of the speeds with given rates.
    rates : ndarray, shape (n_rows, ...)
    parameters : dict of str to float
        Those with values that the model has, too.
    inputs : dict of str to ndarray, shape (...)
        Those with values.
    """

    source: str
    one_time: str
    times: Floats
    states: Floats
    rows: list[int]
    rates: Floats
    parameters: dict[str, float]
    inputs: dict[str, Floats]

    @property
    def shape(self) -> tuple[int, ...]:
        return self.times.shape


def _names(model: Kernel) -> list[str]:
    """The inputs, without rates."""
    return [*model.layout.own_inputs]


def _unknown(model: Kernel, find: Any, given: Mapping[str, InputSource | Floats]) -> list[str]:
    """The names of the inputs to find, as many as there are degrees of freedom."""
    freedom = model.layout.n_independent_speeds
    forces = [name for name in _names(model) if name not in model.prescribed]
    if find is None:
        names = [name for name in forces if name not in given]
    else:
        names = names_of(find, "find= is an input, or a sequence of inputs")
        for name in names:
            if name in model.prescribed:
                raise ModelError(f"{name} cannot be found: it prescribes a motion. Others are {_listed(forces)}.")
            if name not in forces:
                raise ModelError(f"There is no input {name!r}.{meant(name, forces)} There are {_listed(forces)}.")
            if name in given or names.count(name) > 1:
                raise ModelError(f"{name} is given twice: name it once, in find= or in inputs=.")
    if len(names) != freedom or not names:
        if not freedom:
            advice = "What holds prescribed motions is told by their multipliers and outputs."
        elif len(forces) >= freedom:
            advice = "Name them in find=, and give the others in inputs=."
        else:
            advice = "Make forces or torques functions of time, which are inputs."
        raise ModelError(
            f"The motion of {model.name} has {freedom} degrees of freedom, so it determines as many inputs, not "
            f"{len(names)} ({_listed(names)}). {advice}"
        )
    return names


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _carried(model: Kernel, given: _Motion, others: Container[str]) -> dict[str, Floats]:
    """The values of inputs, and of their rates, that the motion brings along."""
    entries = [entry for entry in model.layout.inputs if entry.of not in others]
    carried = {entry.name: given.inputs[entry.name] for entry in entries if entry.name in given.inputs}
    for entry in entries:
        if entry.of in carried and entry.name not in carried:
            raise ModelError(
                f"{given.source} tells {entry.of}, but not {entry.name}, which {model.name} needs: give "
                f"{entry.of} in inputs=."
            )
    return carried


def _by_instant(model: Kernel, given: _Motion, sources: Mapping[str, InputSource | Floats]) -> dict[str, Floats]:
    """The values of inputs that are given as arrays, one for each state of the motion."""
    found: dict[str, Floats] = {}
    for name, source in sources.items():
        if not is_by_member(source):
            continue
        values = np.array(numbers(source, f"The values of input {name}"))
        if name in model.prescribed:
            raise ModelError(f"Input {name} prescribes a motion: an array does not tell its rates, which are needed.")
        if values.shape != given.shape:
            raise ModelError(
                f"An array for input {name} has a value for each state of the motion, so its shape is {given.shape}, "
                f"not {values.shape}."
            )
        if not np.isfinite(values[np.isfinite(given.states).all(axis=0)]).all():
            raise ModelError(f"The values of input {name} must be finite.")
        found[name] = values
    return found


def _check_time(
    model: Kernel,
    given: _Motion,
    p: Floats | None,
    sources: Mapping[str, InputSource | Floats],
    unknown: Container[str],
) -> None:
    """Refuse tables for different states at one time, and warn of other loads that depend on time.

    The mechanism passes the positions of a branch one after the other, although all of them are at one time.
    """
    ways = (
        f"{given.one_time}. Give an array with a value for each position, a callable of (t, x) that depends on x "
        "alone, or the motion as (t, x, accelerations) with the time of each position"
    )
    tables = [name for name, source in sources.items() if isinstance(source, tuple | list)]
    if tables:
        raise ModelError(f"Input {', '.join(tables)} is a table of time, but {ways}.")
    t, known = float(given.times[0]), given.states[:, np.isfinite(given.states).all(axis=0)]
    of_time = dict(zip(model.inputs, _depend_on_time(model, "default_inputs"), strict=True))
    loads = []
    for entry, default in zip(model.layout.inputs, model.default_inputs(t, p), strict=True):
        name, source = entry.name, sources.get(entry.name)
        if callable(source):
            depends = _reads_time(source, t, known)
        else:
            is_load = name not in unknown and entry.of not in model.prescribed
            is_default = source is None and bool(np.all(given.inputs.get(name, default) == default))
            depends = is_load and is_default and of_time[name]
        if depends:
            loads.append(name)
    if loads:
        warnings.warn(f"Input {', '.join(loads)} depends on time, but {ways}.", ModelWarning, stacklevel=4)
    if any(_depend_on_time(model, "residual")):
        warnings.warn(
            f"The equations of {model.name} depend on time, but {given.one_time}. Give the motion as (t, x, "
            "accelerations) with the time of each position.",
            ModelWarning,
            stacklevel=4,
        )


def _depend_on_time(model: Kernel, result: str) -> list[bool]:
    """Which rows of a result depend on time, apart from inputs."""
    place = model.n_x + model.n_p + model.n_r + model.n_u + model.n_l
    return [bool(mask >> place) for mask in model.layout.dependencies.rows[result]]


class _Clock:
    """A time that cannot be read, and notes if that is tried."""

    def __init__(self) -> None:
        self.is_read = False

    def __getattr__(self, name: str) -> NoReturn:
        _read(self)

    def __format__(self, form: str) -> str:
        return "t"  # a message is no result


def _read(clock: _Clock, *_: object) -> NoReturn:
    clock.is_read = True
    raise TypeError("This time cannot be read.")


for _name in {*vars(float)} - {*vars(_Clock)} - {"__new__", "__repr__", "__getattribute__"}:
    setattr(_Clock, _name, _read)


def _reads_time(source: Callable[[float, Floats], float], t: float, states: Floats) -> bool:
    """Whether a callable of (t, x) depends on time at any of the states, in columns.

    At single times, a pulse between them would not be seen.
    """
    clock = _Clock()
    with suppress(Exception):
        for x in states.T:
            source(clock, x.copy())  # type: ignore[arg-type]
        return clock.is_read
    if clock.is_read:
        return True
    # It takes numbers alone, as compiled functions do.
    x = states[:, 0]
    value = source(t, x.copy())
    with suppress(Exception), np.errstate(all="ignore"):
        return any(source(t + later, x.copy()) != value for later in OTHER_TIMES)
    return True


def _read_result(model: Kernel, motion: Any) -> _Motion:
    """A branch or a run, in the order of the model's states."""
    if not isinstance(motion, Branch | Trajectory):
        raise ModelError(f"A motion is a Branch, a Trajectory, or (t, x, accelerations), not {shown(motion)}.")
    source = motion.kernel
    without = motion.without_value if isinstance(motion, Branch) else ()
    if isinstance(motion, Branch):
        states = np.concatenate((motion.q, motion.u, np.full((source.n_z, motion.q.shape[1]), np.nan)))
        times, rates, p = np.full(states.shape[1], motion.t), motion.ud, motion.p
        missing = [*model.auxiliary_states]
    else:
        times, states, missing = motion.t, motion.y, []
        p = parameter_array(source, motion.parameters)
        rates = np.zeros((source.n_u, len(times)))
        for k, (t, x, r) in enumerate(zip(times, states.T, motion.r.T, strict=True)):
            rates[:, k] = source.rhs(t, x, p, r)[source.n_q : source.n_q + source.n_u]
    for own, known in (
        (model.coordinates, source.coordinates),
        (model.speeds, source.speeds),
        (model.auxiliary_states, source.auxiliary_states),
    ):
        missing += [name for name in own if name not in known]
    if missing:
        what = "Positions along a drive do" if isinstance(motion, Branch) else f"The run of {source.name} does"
        raise ModelError(f"{what} not tell {', '.join(missing)} of {model.name}: they tell {', '.join(source.states)}.")
    return _Motion(
        source.name,
        f"all positions of a Branch are at its time, t = {times[0]:g} s"
        if isinstance(motion, Branch) and len(times) > 1
        else "",
        times,
        states[[source.states.index(name) for name in model.states]],
        list(range(model.n_u)),
        rates[[source.speeds.index(name) for name in model.speeds]],
        {
            n: v
            for n, v in zip(source.parameters, p.tolist(), strict=True)
            if n in model.parameters and n not in without
        },
        {name: row for name, row in zip(source.inputs, motion.r, strict=True) if name not in without},
    )


def _read_tuple(model: Kernel, motion: tuple[Any, ...]) -> _Motion:
    """Times, states and accelerations, which may be the same for all."""
    if len(motion) != 3:
        raise ModelError(f"A motion is a Branch, a Trajectory, or (t, x, accelerations), not {shown(motion)}.")
    times, states = numbers(motion[0], "The times"), named_columns(motion[1], model.states, {}, "state")
    names = model.speeds
    if is_mapping(motion[2]):
        given = named(motion[2], model.speeds, "speed")
        names = tuple(name for name in model.speeds if name in given)
    rates = named_columns(motion[2], names, {}, "acceleration")
    try:
        shape = np.broadcast_shapes(times.shape, states.shape[1:], rates.shape[1:])
    except ValueError:
        shape = (0, 0)
    if len(shape) > 1:
        raise ModelError(
            f"Times, states and accelerations must be of as many instants, or of one: their shapes are {times.shape}, "
            f"{states.shape} and {rates.shape}."
        )
    n_states = math.prod(states.shape[1:])
    states, rates = (
        np.broadcast_to(rows.reshape(len(rows), *(rows.shape[1:] or (1,) * len(shape))), (len(rows), *shape))
        for rows in (states, rates)
    )
    return _Motion(
        "The motion",
        f"all states are at one time, t = {times.flat[0]:g} s" if times.size == 1 < n_states else "",
        np.broadcast_to(times, shape),
        states,
        [model.speeds.index(name) for name in names],
        rates,
        {},
        {},
    )


@dataclass(frozen=True)
class _Instant:
    """The arguments of the equations at one of the states; inputs to be found are not yet in r."""

    model: Kernel
    t: float
    x: Floats
    p: Floats | None
    r: Floats

    def inputs(self, rows: list[int], values: Floats) -> Floats:
        """The inputs with others in these rows."""
        r = self.r.copy()
        r[rows] = values
        return r


def _accelerations(at: _Instant, rows: list[int], rates: Floats, sizes: Floats) -> Floats | None:
    """All u' with J u' + gamma = 0 and the given ones; None if these do not determine the others.

    `sizes` are typical ones of the rows of J.
    """
    model = at.model
    *_, jacobian, bias = model.dynamics(at.t, at.x, at.p, at.r)
    found: Floats | None = rates
    if len(rows) < model.n_u:
        matrix = np.vstack((jacobian, np.eye(model.n_u)[rows]))
        found = solve_redundant(matrix, np.concatenate((-bias, rates)), np.append(sizes, np.ones(len(rows))))
    if found is None:
        return None
    violation = jacobian @ found + bias
    size = np.abs(jacobian) @ np.abs(found) + np.abs(bias) + sizes
    away = np.abs(found[rows] - rates)
    if (np.abs(violation) > CONSISTENCY_RTOL * size).any() or (away > CONSISTENCY_RTOL * (1.0 + np.abs(rates))).any():
        told = ", ".join(f"{model.speeds[row]}' = {rate:.6g}" for row, rate in zip(rows, rates, strict=True))
        raise ModelError(
            f"The accelerations {told} at t = {at.t:g} violate the constraints: J u' + gamma = {violation}. Give those "
            "of the independent speeds by name: the others follow."
        )
    return found


def _balance(at: _Instant, accelerations: Floats, rows: list[int], guess: Floats) -> Floats:
    """The inputs in these rows for which the equations hold; NaN if they are not found.

    Newton's method begins at the guess and the default, if these are known, then at 0 and at 1, since of inputs that
    enter nonlinearly the derivative may vanish or be infinite there. That may be at the solution, as at n = 0 of
    n^3 = 0; so at last these values themselves are tried.
    """
    model, n = at.model, len(rows)
    candidates = (guess, model.default_inputs(at.t, at.p)[rows], np.zeros(n), np.ones(n))
    begins = [inputs for inputs in candidates if np.isfinite(inputs).all()]
    with np.errstate(all="ignore"):
        for method in (_newton, _as_given):
            for inputs in begins:
                found = method(at, accelerations, rows, np.concatenate((inputs, _guessed_reactions(at, rows, inputs))))
                if found is not None:
                    return found
    return np.full(n, np.nan)


def _guessed_reactions(at: _Instant, rows: list[int], inputs: Floats) -> Floats:
    """The multipliers, of which 0 is guess enough, and the unknown forces of a motion with these inputs."""
    if at.model.n_l > at.model.n_c:
        with suppress(SimulationError):
            return at.model.accelerations(at.t, at.x, at.p, at.inputs(rows, inputs))[1]
    return np.zeros(at.model.n_l)


@dataclass(frozen=True)
class _Equations:
    """What is left of the equations, with inputs and reactions that are given.

    Attributes
    ----------
    residual : ndarray, shape (n,)
    wrt_inputs, wrt_reactions : ndarray, shape (n, ...)
        Its derivatives.
    terms : ndarray, shape (n,)
        Sizes of the terms.
    rounding : ndarray, shape (n,)
        Bounds of rounding errors: changes of all states, parameters, inputs and reactions by some of theirs. Forces
        that balance each other, such as a weight and its spring, are as large as one of them by these alone.
    """

    residual: Floats
    wrt_inputs: Floats
    wrt_reactions: Floats
    terms: Floats
    rounding: Floats

    @property
    def are_finite(self) -> bool:
        return all(np.isfinite(part).all() for part in (self.residual, self.wrt_inputs, self.wrt_reactions))

    @property
    def error(self) -> float:
        """The largest residual, relative to the terms."""
        return float((np.abs(self.residual) / np.where(self.terms > 0.0, self.terms, 1.0)).max(initial=0.0))

    @property
    def are_rounded(self) -> bool:
        """Whether the residual may be rounding errors."""
        return self.error <= LOOSE_RESIDUAL_RTOL or bool((np.abs(self.residual) <= self.rounding).all())


def _equations(at: _Instant, accelerations: Floats, rows: list[int], unknown: Floats) -> _Equations:
    """The equations, with inputs, multipliers and unknown forces."""
    model, t, x = at.model, at.t, at.x
    n_u, n_c, k = model.n_u, model.n_c, len(rows)
    multipliers, forces, r = unknown[k : k + n_c], unknown[k + n_c :], at.inputs(rows, unknown[:k])
    _, mass, forcing, jacobian, _ = model.dynamics(t, x, at.p, r)
    effect, wrt_forces, rest, rest_wrt_forces, other_mass, other_jacobian = model.unknown_forces(t, x, forces, at.p, r)
    wrt_reactions = np.block([[jacobian.T, wrt_forces], [other_jacobian, rest_wrt_forces]])
    known, inertial = np.concatenate((forcing + effect, rest)), np.vstack((mass, other_mass)) @ accelerations
    derivatives = model.partials(t, x, accelerations, unknown[k:], at.p, r)[1::2]
    wrt_data = np.hstack(derivatives)[[*range(n_u), *range(n_u + n_c, n_u + model.n_l)]]
    wrt_inputs = wrt_data[:, wrt_data.shape[1] - model.n_r :][:, rows]
    data = np.abs(np.concatenate((x, parameter_array(model, at.p), r)))
    # Inputs may balance other forces within `forcing`.
    terms = np.abs(known) + np.abs(inertial) + np.abs(np.hstack((wrt_inputs, wrt_reactions))) @ np.abs(unknown)
    rounding = np.maximum(np.nan_to_num(np.abs(wrt_data) * data, posinf=0.0).sum(axis=1), terms.max(initial=0.0))
    return _Equations(
        known + wrt_reactions[:, :n_c] @ multipliers - inertial,
        wrt_inputs,
        wrt_reactions,
        terms,
        ROUNDING_RTOL * rounding,
    )


def _newton(at: _Instant, accelerations: Floats, rows: list[int], unknown: Floats) -> Floats | None:
    """The inputs, from a guess of them, the multipliers and the unknown forces."""
    before = np.inf
    for iteration in range(MAX_ITERATIONS):
        equations = _equations(at, accelerations, rows, unknown)
        if not equations.are_finite:
            return None
        error = equations.error
        if iteration and (error <= RESIDUAL_RTOL or (error > 0.5 * before and equations.are_rounded)):
            return unknown[: len(rows)]
        step, before = _step(equations), error
        if step is None:
            return None
        unknown = unknown + step
    return None


def _as_given(at: _Instant, accelerations: Floats, rows: list[int], unknown: Floats) -> Floats | None:
    """The inputs that are given, if the equations hold with these, and others beside them are determined."""
    inputs, reactions = unknown[: len(rows)], unknown[len(rows) :]
    beside = _equations(at, accelerations, rows, np.concatenate((inputs + 1.0, reactions)))
    if not beside.are_finite or _step(beside) is None:
        return None
    held = replace(at, r=at.inputs(rows, inputs))
    return None if _newton(held, accelerations, [], reactions) is None else inputs


def _step(equations: _Equations) -> Floats | None:
    """The change of inputs and reactions that balances the residual; None if inputs are not determined.

    They are if no combination of their columns is one of the reactions' columns. Reactions of redundant constraints are
    those of minimum norm.
    """
    matrix, k = np.hstack((equations.wrt_inputs, equations.wrt_reactions)), equations.wrt_inputs.shape[1]
    rows = np.abs(matrix).max(axis=1, initial=0.0)
    rows[rows == 0.0] = 1.0
    columns = np.maximum(np.abs(matrix / rows[:, None]).max(axis=0, initial=0.0), MIN_COLUMN_SIZE)
    scaled = matrix / rows[:, None] / columns
    step, _, rank, _ = np.linalg.lstsq(scaled, -equations.residual / rows, rcond=RANK_RTOL)
    if rank < k + np.linalg.matrix_rank(scaled[:, k:], rtol=RANK_RTOL):
        return None
    return np.asarray(step / columns)
