"""What runs are differentiated with respect to: parameters, inputs, initial values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import AssemblyError, ModelError, meant
from fourbar_codegen.interface.arguments import Values, name_of
from fourbar_codegen.kernel.inputs import (
    InputSource,
    arbitrary_changes,
    changes_at,
    input_sources,
    inputs_at,
    own_source,
    source_changes,
)
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.runtime.enumerations import Threshold
from fourbar_codegen.runtime.evaluator import dependent_changes

__all__ = [
    "Directions",
    "corrected",
    "differentiable",
    "directions_of",
    "implicit_derivatives",
    "independent_states",
    "initial_derivatives",
    "locked_parameters",
    "moving_breakpoints",
    "require_derivatives",
    "require_fixed_breakpoints",
    "with_probes",
]

Floats = NDArray[np.float64]

OPEN_FACTOR = 100.0
"""Redundant constraints are satisfied to `Threshold.REDUNDANCY_RTOL` plus this multiple of the violation of the state,
since they may be redundant only where loops are closed."""

MAX_COORDINATE_CHANGE = 1e-2
"""The largest change of a coordinate, after which redundant constraints are examined again."""

MAX_CORRECTIONS = 6
"""Steps of Newton's method from a predicted state."""

CORRECTION_RTOL = 1e-10
"""A step that changes no value by more than this, relative to 1 or the largest value, is the last one: the next one
would change it by the square of this."""

N_PROBES = 2
"""Arbitrary directions of initial states, and as many of parameters and inputs, that choose steps for gradients."""

SMALL_AMPLITUDE_RATIO = 1e-3
"""Amplitudes of terms that depend on time are small below this fraction of the largest parameter or input; ..."""

N_SMALL_AMPLITUDES = 4
"""... so many directions are for them, since JVPs take eight directions at once."""

REGULAR_PIVOT_RATIO = 1e-3
"""Pivots of the constraints' derivatives, relative to the largest, below which a singular position may be nearby."""


@dataclass(frozen=True)
class Directions:
    """Directions of initial states, parameters and inputs.

    Attributes
    ----------
    places : mapping of str to int or slice
        For each name, the column of its direction; for a table of an input, those of its values.
    matrix : ndarray, shape (n_x + n_p, n)
        In columns.
    sources : sequence of length n_r
        For each input None, or the changes of its source, as `source_changes` has them, in n columns.
    """

    places: Mapping[str, int | slice]
    matrix: Floats
    sources: Sequence[Floats | None]

    @property
    def names(self) -> tuple[str, ...]:
        """What these are the directions of."""
        return tuple(self.places)

    def by_name(self, derivatives: Floats) -> dict[str, Floats]:
        """Derivatives along the directions, one after the other in the first axis, by names."""
        return {name: derivatives[place] for name, place in self.places.items()}

    def of_inputs(self, model: Kernel, times: Floats, p: Floats | None, inputs: Mapping[Any, InputSource]) -> Floats:
        """The directions of the inputs at times, shape (n_r, n, n_t)."""
        found = np.zeros((model.n_r, self.matrix.shape[1], len(times)))
        masks = [mask >> model.n_x for mask in model.layout.dependencies.rows["default_inputs"]]
        if any(mask % (1 << model.n_p) for mask in masks):  # expressions of parameters
            of_parameters, given = self.matrix[model.n_x :], input_sources(model, inputs)
            for place, t in enumerate(times):
                found[..., place] = model.default_input_partials(t, p) @ of_parameters
            found[[source is not None for source in given]] = 0.0
        if any(changes is not None for changes in self.sources):
            for row, (source, changes) in enumerate(zip(input_sources(model, inputs), self.sources, strict=True)):
                if changes is not None:
                    found[row] = changes_at(source, changes, times)
        return found


def directions_of(model: Kernel, names: Sequence[Any], inputs: Mapping[Any, InputSource] | None = None) -> Directions:
    """The unit directions of parameters, of independent states, and of given inputs.

    Raises
    ------
    ModelError
        If a name is unknown, that of a dependent state or of an input that is not given, or repeated.
    """
    independent, given = _independent(model), _given(inputs)
    known, wanted = (*model.states, *model.parameters), tuple(map(name_of, names))
    own = {entry.name: entry.expression for entry in model.layout.inputs if not entry.order}
    places: dict[str, int | slice] = {}
    n, changes = 0, {}
    for name in wanted:
        if name in places:
            raise ModelError(f"{name!r} is given twice.")
        if name in given:
            changes[name] = source_changes(model, name, given[name])
            width = next(iter(changes[name].values())).shape[1]
            places[name] = slice(n, n + width) if isinstance(given[name], tuple) else n
            n += width
            continue
        if name in model.states and name not in independent:
            raise ModelError(
                f"{name!r} is dependent: its initial value follows from {', '.join((*independent, 'the parameters'))}."
            )
        if name in own:
            is_own = f"is given by its expression, {own[name]}" if own[name] else "has no source"
            raise ModelError(f"Input {name!r} {is_own}: give a number or a table of it in inputs=.")
        if name not in known:
            raise ModelError(
                f"There is no parameter, initial value or given input {name!r}.{meant(name, (*known, *own))} There are "
                f"{', '.join((*independent, *model.parameters, *given))}."
            )
        places[name] = n
        n += 1
    matrix = np.zeros((len(known), n))
    sources: list[Floats | None] = [None] * model.n_r
    for name, place in places.items():
        if name not in changes:
            matrix[known.index(name), place] = 1.0
            continue
        for row, of_source in changes[name].items():
            columns = np.zeros((len(of_source), n))
            columns[:, place if isinstance(place, slice) else [place]] = of_source
            sources[row] = columns
    return Directions(places, matrix, sources)


def with_probes(
    model: Kernel,
    directions: Directions | None,
    parameters: Floats | None,
    inputs: Mapping[Any, InputSource] | None,
    locked: Set[str] = frozenset(),
) -> Directions:
    """Directions with further ones, without names, that ask for steps short enough for all derivatives.

    In the first, all initial states change: arbitrary directions have a part in each mode of the motion. In the next,
    all parameters and inputs change, by their size, but for parameters that are locked: which of the redundant
    constraints these violate is a matter of rounding errors, and steps would follow them. Terms that depend on time may
    vary where the motion does not, if their amplitude is zero or small: the smallest of their parameters and inputs are
    directions of their own, and the other small ones change together.
    """
    generator, p = np.random.default_rng(0), parameter_array(model, parameters)
    n_x, n_r = model.n_x, model.n_r
    given = {name_of(key): own_source(name_of(key), source) for key, source in (inputs or {}).items()}
    tables = [name for name, source in given.items() if isinstance(source, tuple)]
    of_time = {*model.layout.dependencies.timed}.union(*(model.layout.dependencies.timed_by[name] for name in tables))
    changes = {name: arbitrary_changes(model, name, source, N_PROBES, generator) for name, source in given.items()}
    together = {place: change for of_name in changes.values() for place, change in of_name.items()}
    states, others = np.zeros((2, n_x + model.n_p, N_PROBES))
    states[:n_x] = generator.standard_normal((n_x, N_PROBES))
    others[n_x:] = np.where(p == 0.0, 1.0, p)[:, np.newaxis] * generator.standard_normal((model.n_p, N_PROBES))
    is_locked = np.isin(model.parameters, list(locked))
    others[n_x:][is_locked] = 0.0
    parts = [] if directions is None else [(directions.matrix, directions.sources)]
    parts += [(states, [None] * n_r), (others, [together.get(place) for place in range(n_r)])]
    sizes = dict(zip(model.parameters, np.abs(p).tolist(), strict=True)) | {
        name: float(np.abs(source[1] if isinstance(source, tuple) else source).max())  # type: ignore[arg-type]
        for name, source in given.items()
    }
    of_time -= locked
    small = [name for name in sizes if name in of_time and sizes[name] <= SMALL_AMPLITUDE_RATIO * max(sizes.values())]
    small.sort(key=sizes.__getitem__)
    for group in filter(None, (*([name] for name in small[: N_SMALL_AMPLITUDES - 1]), small[N_SMALL_AMPLITUDES - 1 :])):
        unit, own = np.zeros((n_x + model.n_p, 1)), {}
        for name in group:
            own.update(changes.get(name, {}))
            if name not in given:
                unit[n_x + model.parameters.index(name)] = generator.choice([-1.0, 1.0])
        parts.append((unit, [own[place][:, :1] if place in own else None for place in range(n_r)]))
    sources: list[Floats | None] = []
    for of_parts in zip(*(each for _, each in parts), strict=True):
        rows = max((len(change) for change in of_parts if change is not None), default=0)
        columns = [
            np.zeros((rows, matrix.shape[1])) if change is None else change
            for change, (matrix, _) in zip(of_parts, parts, strict=True)
        ]
        sources.append(np.hstack(columns) if rows else None)
    places = {} if directions is None else directions.places
    return Directions(places, np.hstack([matrix for matrix, _ in parts]), sources)


def implicit_derivatives(
    model: Kernel,
    t: float,
    x: Floats,
    directions: Directions,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """Directions of (x, p) with the implicit derivatives of the dependent coordinates and speeds in them.

    With dPhi/dq_d dq_d = -(dPhi/dq_i dq_i + dPhi/dp dp + dPhi/dr dr), and the same for the speeds by J u + b = 0.
    Redundant constraints are satisfied as well.

    Parameters
    ----------
    model : Kernel
    t : float
    x : ndarray, shape (n_x,)
        A state that satisfies the constraints.
    directions : Directions
        Zero in the rows of dependent coordinates and speeds.
    parameters, inputs
        As for `CompiledModel.simulate`.

    Returns
    -------
    ndarray, shape (n_x + n_p, n)

    Raises
    ------
    AssemblyError
        If the dependent values cannot be differentiated: at a singular position, or since redundant constraints do not
        stay satisfied.
    """
    found, locked = _implicit_derivatives(model, t, x, directions, parameters, inputs)
    require_derivatives(locked)
    return found


def require_derivatives(locked: Sequence[str]) -> None:
    """Raise an AssemblyError if redundant constraints lock something; see `locked_parameters`."""
    if locked:
        raise AssemblyError(
            f"Redundant constraints do not stay satisfied if {' or '.join(locked)} alone changes: there are no "
            "derivatives with respect to it."
        )


def _implicit_derivatives(
    model: Kernel,
    t: float,
    x: Floats,
    directions: Directions,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> tuple[Floats, list[str]]:
    """Implicit derivatives, and the names of directions that violate redundant constraints."""
    if not model.layout.n_dependent_coordinates + model.layout.n_dependent_speeds:
        return directions.matrix.copy(), []
    p = model.parameter_vector(parameters)
    dependent = _Dependent.of(model, t, directions, p, inputs)
    missing, found, change, _, left = dependent.at(x)
    if missing:
        raise AssemblyError(
            f"The dependent {missing} have no derivative at the initial state, which is a singular position: start "
            "from another one, or choose other independent values."
        )
    return found, _locked(directions, dependent, x, found, change, left)


def locked_parameters(
    model: Kernel,
    states: Sequence[tuple[float, Floats]],
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> set[str]:
    """The parameters that redundant constraints do not let change alone, such as a length in a parallelogram with a bar
    too many: at one of these times and states they would be violated.
    """
    if model.n_c <= model.layout.n_dependent_speeds:
        return set()
    directions, p = directions_of(model, model.parameters), model.parameter_vector(parameters)
    found: set[str] = set()
    for t, x in states:
        if np.isfinite(x).all():
            dependent = _Dependent.of(model, t, directions, p, inputs)
            _, derivatives, change, _, left = dependent.at(x)
            found.update(_locked(directions, dependent, x, derivatives, change, left))
    return found


def _locked(
    directions: Directions, dependent: _Dependent, x: Floats, found: Floats, change: Floats, left: Floats
) -> list[str]:
    """The names of directions for which redundant constraints are left violated, for results of `_Dependent.at`.

    Where they are satisfied at this state, they may be so to first order alone, as where parallel bars are upright:
    then they are violated after a finite change.
    """
    allowed = Threshold.REDUNDANCY_RTOL + OPEN_FACTOR * max(np.abs(change).max(initial=0.0), left[-1])
    is_left = left[:-1] > allowed
    if dependent.model.n_c > dependent.model.layout.n_dependent_speeds:
        is_left |= [dependent.opens(x, found, j, allowed) for j in range(len(is_left))]
    return [name for name, place in directions.places.items() if np.any(is_left[place])]


def corrected(
    model: Kernel,
    t: float,
    x: Floats,
    directions: Directions,
    parameters: Floats,
    inputs: Mapping[Any, InputSource] | None,
) -> tuple[Floats, Floats] | None:
    """A state near a predicted one that satisfies the constraints, and what `implicit_derivatives` finds there.

    By Newton's method for the dependent values, whose matrices are those of `implicit_derivatives`.

    Returns
    -------
    tuple of ndarray, shapes (n_x,) and (n_x + n_p, n), or None
        None unless it converges quadratically, away from singular positions.
    """
    dependent, size = _Dependent.of(model, t, directions, parameters, inputs), np.inf
    for _ in range(MAX_CORRECTIONS):
        missing, found, change, pivot, left = dependent.at(x)
        last, size = size, np.abs(change).max(initial=0.0)
        if missing or pivot < REGULAR_PIVOT_RATIO or not size <= 0.5 * last:
            return None
        x = x + change
        if size <= CORRECTION_RTOL * (1.0 + np.abs(x).max(initial=0.0)):
            return (x, found) if left.max() <= Threshold.REDUNDANCY_RTOL else None
    return None


@dataclass(frozen=True)
class _Dependent:
    """What dependent values follow from, but for the state."""

    model: Kernel
    t: float
    directions: Floats
    """Of (x, p, r)."""
    p: Floats | None
    r: Floats | None

    @classmethod
    def of(
        cls,
        model: Kernel,
        t: float,
        directions: Directions,
        p: Floats | None,
        inputs: Mapping[Any, InputSource] | None,
    ) -> _Dependent:
        of_inputs = directions.of_inputs(model, np.array([t]), p, inputs or {})[..., 0]
        return cls(model, t, np.concatenate((directions.matrix, of_inputs)), p, inputs_at(model, t, p, inputs))

    def opens(self, x: Floats, found: Floats, j: int, allowed: float) -> bool:
        """Whether redundant constraints are violated after a finite change along a direction, which the others follow.

        Parameters
        ----------
        x : ndarray, shape (n_x,)
        found : ndarray, shape (n_x + n_p, n)
            As `at` returns it there.
        j : int
            The direction.
        allowed : float
            The largest violation that is none.
        """
        n_x, n_q = self.model.n_x, self.model.n_q
        rate = np.abs(found[:n_q, j]).max(initial=0.0)
        if rate == 0.0:
            return False
        h, size = MAX_COORDINATE_CHANGE / rate, np.inf
        p = parameter_array(self.model, self.p) + h * found[n_x:, j]
        r = None if self.r is None else self.r + h * self.directions[n_x + len(p) :, j]
        changed, x = replace(self, p=p, r=r), x + h * found[:n_x, j]
        for _ in range(MAX_CORRECTIONS):
            missing, _, change, pivot, left = changed.at(x)
            last, size = size, float(np.abs(change).max(initial=0.0))
            if missing or pivot < REGULAR_PIVOT_RATIO or not size <= 0.5 * last:
                return False
            if size <= CORRECTION_RTOL * (1.0 + np.abs(x).max(initial=0.0)):
                return bool(left[-1] > allowed)
            x = x + change
        return False

    def at(self, x: Floats) -> tuple[str, Floats, Floats, float, Floats]:
        """As `dependent_changes`, without rows of the inputs."""
        model, layout = self.model, self.model.layout
        n_qd, n_ud = layout.n_dependent_coordinates, layout.n_dependent_speeds
        found = dependent_changes(model, self.t, x, self.directions, n_qd, n_ud, self.p, self.r)
        missing, derivatives, change, pivot, left = found
        return missing, derivatives[: model.n_x + model.n_p], change, pivot, left


def initial_derivatives(
    model: Kernel,
    t: float,
    x: Floats,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
    names: Sequence[str] | None = None,
) -> dict[str, Floats]:
    """The derivatives of an initial state with respect to names, by default all of `differentiable`.

    Returns
    -------
    dict of str to ndarray, shape (n_x,), or (n, n_x) for the n values of a table
        Without those for which redundant constraints do not stay satisfied.
    """
    names = differentiable(model, inputs) if names is None else names
    entries, given = model.layout.inputs, _given(inputs)
    prescribed = {entry.of for entry in entries if entry.is_prescribed}
    none = {  # no state depends on a force
        name: np.zeros((len(source[0]), model.n_x) if isinstance(source, tuple) else model.n_x)
        for name, source in given.items()
        if name not in prescribed
    }
    directions = directions_of(model, [name for name in names if name not in none], inputs)
    derivatives, locked = _implicit_derivatives(model, t, x, directions, parameters, inputs)
    found = none | directions.by_name(derivatives[: model.n_x].T)
    return {name: found[name] for name in names if name not in locked}


def moving_breakpoints(model: Kernel, parameters: Floats | None, names: Sequence[str]) -> list[str]:
    """The parameters on which the times of jumps and kinks of the model's expressions depend."""
    p = parameter_array(model, parameters)
    before, found = model.breakpoints(p), []
    for name in names if before.size else ():
        changed, place = p.copy(), model.parameters.index(name)
        changed[place] += 1e-6 * (abs(p[place]) or 1.0)
        if not np.array_equal(before, model.breakpoints(changed), equal_nan=True):
            found.append(name)
    return found


def require_fixed_breakpoints(model: Kernel, parameters: Floats | None, names: Sequence[str]) -> None:
    """Raise a ModelError if times of jumps and kinks depend on one of these parameters."""
    for name in moving_breakpoints(model, parameters, names):
        raise ModelError(
            f"Expressions of the model have a jump or a kink at times that depend on {name}: there are no "
            "sensitivities with respect to it."
        )


def independent_states(model: Kernel) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """The names of the independent coordinates and speeds, and of the auxiliary states."""
    n_qi, n_ui = model.layout.n_independent_coordinates, model.layout.n_independent_speeds
    return model.coordinates[:n_qi], model.speeds[:n_ui], model.auxiliary_states


def differentiable(model: Kernel, inputs: Mapping[Any, InputSource] | None = None) -> tuple[str, ...]:
    """The names of independent and auxiliary states, of parameters, and of inputs given as numbers or tables."""
    return (*_independent(model), *model.parameters, *_given(inputs))


def _given(inputs: Mapping[Any, InputSource] | None) -> dict[str, Any]:
    """The inputs given as numbers or tables, by name, checked."""
    sources = {name_of(key): own_source(name_of(key), source) for key, source in (inputs or {}).items()}
    return {name: source for name, source in sources.items() if not callable(source)}


def _independent(model: Kernel) -> tuple[str, ...]:
    """The names of `independent_states` in one."""
    q, u, z = independent_states(model)
    return (*q, *u, *z)
