"""Positions, velocities and accelerations of a mechanism along a drive, in all ways in which its loops close."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.assembly_modes import closed_coordinates
from fourbar_codegen.analysis.continuation import Curve, null_space, solve_at, trace
from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.arguments import Values, finite_number, is_mapping, named, named_array, numbers
from fourbar_codegen.errors import AssemblyError, ModelError, shown
from fourbar_codegen.kernel.dependent import solve_redundant
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.progress import Progress
from fourbar_codegen.results.kinematics import Branch, Kinematics

__all__ = ["kinematics"]

Floats = NDArray[np.float64]

SEEDS = (0.5131, 0.0, 1.0, 0.2417, 0.7689, 0.1201, 0.8773, 0.3718, 0.6329)
"""Places along the drive, of its whole way, where assembly modes are searched: unlikely to be singular. They are also
searched at all given values at which no branch closes."""

SAME = 1e-6
"""Largest distance of scaled coordinates that are the same."""


@dataclass(frozen=True)
class _Drive:
    """The driven coordinates and inputs, as functions of a parameter s.

    Of one drive, s is its scaled value, in whatever order values are asked for. Of several, it is the length of the way
    from value to value, and they are monotone cubics of it, `curves`: a curve without corners can be traced.
    """

    model: Kernel
    names: tuple[str, ...]
    values: Floats
    places: Floats
    curves: tuple[Any, Any] | None
    unit: float
    rates: Floats
    accelerations: Floats
    coordinates: tuple[int, ...]
    p: Floats
    without_value: tuple[str, ...]
    r: Floats
    t: float
    start: Floats
    scales: Floats
    angles: NDArray[np.bool_]

    @property
    def periods(self) -> Floats:
        """Of the scaled coordinates, and of s."""
        return np.append(np.where(self.angles, 2.0 * np.pi / self.scales, np.inf), np.inf)

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest s."""
        return float(self.places.min()), float(self.places.max())

    def at(self, s: float) -> Floats:
        """The driven values; beyond the ends, by the tangents there."""
        if self.curves is None:
            return np.array([s * self.unit])
        within = np.clip(s, *self.ends)
        return np.asarray(self.curves[0](within) + (s - within) * self.curves[1](within))

    def slope(self, s: float) -> Floats:
        """Their derivatives with respect to s."""
        return np.array([self.unit]) if self.curves is None else np.asarray(self.curves[1](np.clip(s, *self.ends)))

    def inputs(self, driven: Floats, number: int = 0) -> Floats:
        """The inputs with the driven ones, and their rates at one of the places, on which positions do not depend."""
        r = self.r.copy()
        rates, accelerations = self.rates[:, number], self.accelerations[:, number]
        for name, value, rate, acceleration in zip(self.names, driven, rates, accelerations, strict=True):
            if name in self.model.inputs:
                place = self.model.inputs.index(name)
                r[place : place + 3] = value, rate, acceleration
        return r

    def function(self, z: Floats) -> tuple[Floats, Floats]:
        """The position constraints and the drives at scaled coordinates and s, and their Jacobian, with scaled rows."""
        model, n_q = self.model, self.model.n_q
        q, s = z[:n_q] * self.scales, z[n_q]
        driven, slope = self.at(s), self.slope(s)
        r = self.inputs(driven)
        error, slopes = model.position(self.t, q, self.p, r)
        along = np.zeros(len(error))
        if len(self.coordinates) < len(self.names):
            at_rest = np.concatenate((q, np.zeros(model.n_x - n_q)))
            by_inputs = model.constraint_sensitivity(self.t, at_rest, self.p, r)[1]
            for name, rate in zip(self.names, slope, strict=True):
                if name in model.inputs:
                    along += by_inputs[:, model.inputs.index(name)] * rate
        matrix = np.column_stack((slopes * self.scales, along))
        size = np.abs(matrix).max(axis=1, initial=0.0)
        size[size == 0.0] = 1.0
        rows, errors = [matrix / size[:, None]], [error / size]
        for place, value, rate in zip(self.coordinates, driven[: len(self.coordinates)], slope, strict=False):
            row = np.zeros((1, n_q + 1))
            row[0, place], row[0, n_q] = 1.0, -rate / self.scales[place]
            rows.append(row)
            errors.append(np.array([q[place] - value]) / self.scales[place])
        return np.concatenate(errors), np.vstack(rows)

    def motion(self, q: Floats, number: int) -> tuple[Floats, Floats, Floats, Floats] | None:
        """u, u', q' and q'' in a position at one of the places; None where they are not determined."""
        model, driven = self.model, list(self.coordinates)
        r = self.inputs(self.values[:, number], number)
        x = np.concatenate((q, np.zeros(model.n_x - model.n_q)))
        # q' = K u + k, of which the driven rows are given; J u + b = 0.
        by_speeds = np.transpose([model.coordinate_change(self.t, x, row, self.p, r) for row in np.eye(model.n_u)])
        jacobian, bias = model.velocity(self.t, x, self.p, r)
        matrix = np.vstack((jacobian, by_speeds[driven]))
        wanted = self.rates[: len(driven), number] - model.dynamics(self.t, x, self.p, r)[0][driven]
        u = solve_redundant(matrix, np.concatenate((-bias, wanted)))
        if u is None:
            return None
        x[model.n_q : model.n_q + model.n_u] = u
        qd, *_, bias = model.dynamics(self.t, x, self.p, r)
        at_constant_speeds = model.motion(self.t, x, np.zeros(model.n_u), self.p, r)[0]
        wanted = self.accelerations[: len(driven), number] - at_constant_speeds[driven]
        ud = solve_redundant(matrix, np.concatenate((-bias, wanted)))
        return None if ud is None else (u, ud, qd, model.motion(self.t, x, ud, self.p, r)[0])


def kinematics(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, ArrayLike] | None,
    accelerations: Mapping[Any, ArrayLike] | None,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
    t: float,
) -> Kinematics:
    """Positions and motions along a drive; see `CompiledModel.kinematics`."""
    path = _given(model, drive, rates, accelerations, parameters, inputs, t)
    n_q, (first, last) = model.n_q, path.ends
    start, periods = path.start, path.periods
    if n_q - len(path.coordinates) > model.n_h:
        raise ModelError(
            f"A degree of freedom is left: with {', '.join(path.names)} held, {n_q - len(path.coordinates)} "
            f"coordinates and {model.n_h} position constraints are left. Drive another one, too."
        )
    curves: list[Curve] = []
    parts: list[Floats] = []
    is_complete, tried, free = True, 0, dict[str, None]()
    with Progress(f"{model.name}: positions along the drive") as progress:
        for s in _seeds(path, parts):
            driven = path.at(s)
            order = np.argsort(path.coordinates).astype(int)
            given = tuple(path.coordinates[k] for k in order)
            loops = Loops(model, t, driven[order], path.p, path.inputs(driven), given)
            found, all_found, moving = closed_coordinates(loops, start[loops.dependent], progress)
            tried += bool(found)
            free |= dict.fromkeys(moving) if moving else {}
            is_complete &= all_found or bool(moving)
            for dependent in found:
                z = np.append(loops.coordinates(dependent) / path.scales, s)
                if any(_passes(path, part, z, periods) for part in parts):
                    continue
                if first == last:
                    parts.append(z[None, :])
                elif null_space(path.function(z)[1]).shape[1] == 1:
                    curve = trace(path.function, z, first, last, periods)
                    curves.append(curve)
                    parts += curve.branches()
                    is_complete &= not curve.ends_early
            if moving and not parts and tried >= 3:
                break
    if not parts and free:
        raise ModelError(
            f"A degree of freedom is left: {', '.join(free)} can move while {', '.join(path.names)} is held. Drive it, "
            "too, or connect what moves."
        )
    if not parts:
        raise AssemblyError(
            f"The loops of {model.name} close at none of the values of {', '.join(path.names)}, nor at "
            f"{len(SEEDS)} places between them."
        )

    def distance(part: Floats) -> float:
        away = part[:, :n_q] - start / path.scales
        return float(np.abs(_within(away, periods[:n_q])).max(axis=1).min())

    branches = tuple(_branch(path, part) for part in sorted(parts, key=distance))
    dead = []
    for curve in curves:
        for fold in curve.folds:
            q = curve.points[fold, :n_q] * path.scales
            values = dict(zip(model.coordinates, q.tolist(), strict=True))
            at = path.at(curve.points[fold, n_q])
            dead.append({**values, **dict(zip(path.names, at.tolist(), strict=True))})
    drives = dict(zip(path.names, path.values, strict=True))
    return Kinematics(model, drives, branches, tuple(dead), is_complete)


def _seeds(path: _Drive, parts: Sequence[Floats]) -> Iterator[float]:
    """Places where assembly modes are searched: some on the whole way, then those that no branch passes by then."""
    first, last = path.ends
    tried = {first + fraction * (last - first): None for fraction in SEEDS}
    yield from tried
    for s in path.places.tolist():
        if s not in tried and not any(part[0, -1] <= s <= part[-1, -1] for part in parts):
            yield s


def _passes(path: _Drive, part: Floats, z: Floats, periods: Floats) -> bool:
    """Whether a branch goes through a position."""
    s = part[:, -1]
    if len(part) == 1 or not s[0] - SAME <= z[-1] <= s[-1] + SAME:
        return False
    near = solve_at(path.function, _between(part, z[-1]), z[-1])
    if near is None:
        return False
    return bool(np.abs(_within(z - near, periods)).max() <= SAME)


def _within(away: Floats, periods: Floats) -> Floats:
    """Differences without whole periods."""
    finite = np.where(np.isfinite(periods), periods, 0.0)
    return np.asarray(away - finite * np.round(away / periods))


def _between(part: Floats, s: float) -> Floats:
    """A position on a branch, by linear interpolation."""
    return np.array([np.interp(s, part[:, -1], column) for column in part.T])


def _branch(path: _Drive, part: Floats) -> Branch:
    """A branch at the given values of the drive."""
    model, n_q = path.model, path.model.n_q
    n = path.values.shape[1]
    q, qd, qdd = (np.full((n_q, n), np.nan) for _ in range(3))
    u, ud = (np.full((model.n_u, n), np.nan) for _ in range(2))
    r = np.transpose([path.inputs(path.values[:, k], k) for k in range(n)])
    low, high = part[0, -1], part[-1, -1]
    for k, s in enumerate(path.places):
        if low - SAME <= s <= high + SAME:
            near = solve_at(path.function, _between(part, s), s)
            if near is not None:
                q[:, k] = near[:n_q] * path.scales
                motion = path.motion(q[:, k], k)
                if motion is not None:
                    u[:, k], ud[:, k], qd[:, k], qdd[:, k] = motion
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    for place in np.flatnonzero(path.angles) if known.size else []:
        if place not in path.coordinates:
            q[place] -= 2.0 * np.pi * np.round(q[place, known[0]] / (2.0 * np.pi))
    ends = zip(path.names, path.at(low).tolist(), path.at(high).tolist(), strict=True)
    limits = {name: (begin, end) for name, begin, end in ends}
    drive = dict(zip(path.names, path.values, strict=True))
    return Branch(model, path.t, drive, q, qd, qdd, u, ud, limits, r, path.p, path.without_value)


def _given(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, ArrayLike] | None,
    accelerations: Mapping[Any, ArrayLike] | None,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
    t: float,
) -> _Drive:
    """The arguments, checked, with coordinates before inputs."""
    if model.n_c > len([row for row in model.manifest["position_rows"] if row is not None]):
        raise ModelError(f"{model.name} has nonholonomic constraints: its positions do not follow from a drive.")
    moving = [model.manifest["inputs"][k] for k in model.manifest["moving_inputs"]]
    sources = [entry["of"] for entry in moving if entry["order"] == 0 and f"{entry['of']}''" in model.inputs]
    known = [*model.coordinates, *sources]
    if not is_mapping(drive) or not drive:
        raise ModelError(f"drive= is a mapping from coordinates or prescribed motions to values, not {shown(drive)}.")
    values = {
        name: np.atleast_1d(numbers(value, f"The drive {name}")) for name, value in named(drive, known, "drive").items()
    }
    lengths = {len(value) for value in values.values() if value.ndim == 1}
    if len(lengths) != 1 or any(value.ndim != 1 for value in values.values()) or 0 in lengths:
        raise ModelError("The values of a drive are sequences of one length.")
    if not all(np.isfinite(value).all() for value in values.values()):
        raise ModelError("The values of a drive must be finite.")
    names = tuple(name for name in known if name in values)
    p, without_value = _parameters(model, parameters)
    r = _inputs(model, p, inputs, t, names)
    path = np.array([values[name] for name in names])
    coordinates = tuple(model.coordinates.index(name) for name in names if name in model.coordinates)
    start = np.array([model.manifest["initial"].get(name, 0.0) for name in model.coordinates])
    scales, angles = np.ones(model.n_q), Loops(model, t, start, p, r).angles
    if model.points:
        drawn = model.drawing(t, np.concatenate((start, np.zeros(model.n_x - model.n_q))), p, r)[0]
        size = np.ptp(drawn[np.isfinite(drawn).all(axis=1)], axis=0).max(initial=0.0) or 1.0
        scales = np.where(angles, 1.0, size)
    units = np.array([scales[model.coordinates.index(n)] if n in model.coordinates else 1.0 for n in names])
    scaled = path / units[:, None]
    places, curves = scaled[0], None
    if len(names) > 1:
        places = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(scaled, axis=1), axis=0)))
        curves = _curves(places, path)
    return _Drive(
        model,
        names,
        path,
        places,
        curves,
        float(units[0]),
        _of_drives(rates, names, 1.0, path.shape[1], "rate"),
        _of_drives(accelerations, names, 0.0, path.shape[1], "acceleration"),
        coordinates,
        p,
        without_value,
        r,
        t,
        start,
        scales,
        angles,
    )


def _curves(places: Floats, values: Floats) -> tuple[Any, Any]:
    """Monotone cubics through values at ascending places, and their derivatives."""
    from scipy.interpolate import PchipInterpolator

    nodes, numbers_of = np.unique(places, return_index=True)
    if len(nodes) == 1:  # all values are the same
        nodes, numbers_of = np.array([0.0, 1.0]), np.array([0, 0])
    curve = PchipInterpolator(nodes, values[:, numbers_of], axis=1)
    return curve, curve.derivative()


def _of_drives(
    given: Mapping[Any, ArrayLike] | None, names: Sequence[str], default: float, n: int, what: str
) -> Floats:
    """Rates or accelerations of the drives, shape (n_drives, n); those that are not named are 0."""
    if given is None:
        return np.full((len(names), n), default)
    if not is_mapping(given):
        raise ModelError(f"{what}s= is a mapping from drives to numbers or sequences, not {shown(given)}.")
    known = named(given, names, "drive")
    found = np.zeros((len(names), n))
    for row, name in zip(found, names, strict=True):
        values = numbers(known.get(name, 0.0), f"The {what} of {name}")
        if values.shape not in {(), (n,)} or not np.isfinite(values).all():
            raise ModelError(f"The {what} of {name} is a finite number, or {n} of them, not {shown(known[name])}.")
        row[:] = values
    return found


def _parameters(model: Kernel, given: Values | None) -> tuple[Floats, tuple[str, ...]]:
    """All parameters, and those without a value that positions do not depend on, such as masses: they are 1."""
    if given is not None and not is_mapping(given):
        return named_array(given, model.parameters, {}, "parameter"), ()
    values: dict[str, Any] = {**model.defaults, **named(given or {}, model.parameters, "parameter")}
    without = tuple(name for name, value in values.items() if value is None)
    missing = [name for name in without if name in model.manifest["geometry"]]
    if missing:
        raise ModelError(
            f"Positions depend on {', '.join(missing)}, which have no default: give values in parameters=."
        )
    known = [1.0 if v is None else finite_number(v, f"parameter {name}") for name, v in values.items()]
    return np.array(known), without


def _inputs(model: Kernel, p: Floats, given: Mapping[Any, float] | None, t: float, driven: Sequence[str]) -> Floats:
    """All inputs; those that no position depends on are 0."""
    r = model.default_inputs(t, p)
    moving = set(model.manifest["moving_inputs"])
    for name, value in named(given or {}, model.inputs, "input").items():
        r[model.inputs.index(name)] = finite_number(value, f"input {name}")
    for place, entry in enumerate(model.manifest["inputs"]):
        if place not in moving or entry["of"] in driven:
            r[place] = 0.0 if not np.isfinite(r[place]) else r[place]
        elif not np.isfinite(r[place]):
            raise ModelError(f"Positions depend on the input {entry['name']}: give its value in inputs=.")
    return r
