"""Positions, velocities and accelerations of a mechanism along a drive, in all ways in which its loops close."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.assembly_modes import closed_coordinates
from fourbar_codegen.analysis.continuation import Curve, null_space, solve_at, trace
from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.arguments import Values, finite_number, is_mapping, name_of, named, named_array, numbers
from fourbar_codegen.errors import AssemblyError, ModelError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.progress import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Branch", "Kinematics", "kinematics"]

Floats = NDArray[np.float64]

SEEDS = (0.5131, 0.0, 1.0, 0.2417, 0.7689, 0.1201, 0.8773, 0.3718, 0.6329)
"""Places along the drive, of its whole way, where assembly modes are searched: unlikely to be singular."""

SINGULAR = 1e-7
"""Smallest singular value with which velocities are determined, relative to the largest."""

SAME = 1e-6
"""Largest distance of scaled coordinates that are the same."""


@dataclass(frozen=True)
class Branch:
    """One way in which the loops close, along the drive.

    Attributes
    ----------
    model : CompiledModel
    t : float
    drive : dict of str to ndarray, shape (n,)
        The driven coordinates or inputs.
    q, qd, qdd : ndarray, shape (n_q, n)
        The coordinates and their first and second derivatives with respect to time; NaN where the loops do not close,
        and of the derivatives at dead points.
    u, ud : ndarray, shape (n_u, n)
        Speeds and their rates.
    limits : dict of str to (float, float)
        Values of the drive where the branch begins and ends: the range in which the loops close in this way.
    r : ndarray, shape (n_r, n)
        Inputs.
    p : ndarray, shape (n_p,)
    """

    model: Kernel
    t: float
    drive: dict[str, Floats]
    q: Floats
    qd: Floats
    qdd: Floats
    u: Floats
    ud: Floats
    limits: dict[str, tuple[float, float]]
    r: Floats
    p: Floats

    @cached_property
    def _drawn(self) -> Floats:
        """Positions, velocities and accelerations of all drawn points, shape (3, n_points, 3, n)."""
        model, n = self.model, self.q.shape[1]
        found = np.full((3, len(model.manifest["points"]), 3, n), np.nan)
        for k in np.flatnonzero(np.isfinite(self.q).all(axis=0)):
            is_known = np.isfinite(self.ud[:, k]).all()
            state = np.concatenate(
                (self.q[:, k], self.u[:, k] if is_known else np.zeros(model.n_u), np.zeros(model.n_z))
            )
            found[0, :, :, k] = model.drawing(self.t, state, self.p, self.r[:, k])[0]
            if is_known:
                found[1:, :, :, k] = model.motion(self.t, state, self.ud[:, k], self.p, self.r[:, k])[1:]
        return found

    @property
    def positions(self) -> Floats:
        """Positions of all drawn points, those without names last, m, shape (n_points, 3, n)."""
        return np.asarray(self._drawn[0])

    @cached_property
    def points(self) -> dict[str, Floats]:
        """Positions of points by name, m, each of shape (3, n)."""
        return dict(zip(self.model.points, self._drawn[0], strict=False))

    @cached_property
    def velocities(self) -> dict[str, Floats]:
        """Velocities of points by name, m/s, each of shape (3, n)."""
        return dict(zip(self.model.points, self._drawn[1], strict=False))

    @cached_property
    def accelerations(self) -> dict[str, Floats]:
        """Accelerations of points by name, m/s^2, each of shape (3, n)."""
        return dict(zip(self.model.points, self._drawn[2], strict=False))

    def __getitem__(self, name: Any) -> Floats:
        """A coordinate, shape (n,), or the positions of a point, (3, n), by name or symbol."""
        key, model = name_of(name), self.model
        if key in model.coordinates:
            return np.asarray(self.q[model.coordinates.index(key)])
        if key in model.speeds:
            return np.asarray(self.u[model.speeds.index(key)])
        if key in model.points:
            return self.points[key]
        known = [*model.coordinates, *model.speeds, *model.points]
        raise KeyError(f"{key!r} is none of {', '.join(known)}")

    def transmission_angle(self, a: str, joint: str, b: str) -> Floats:
        """The angle at a joint between the ways to two other points, such as between coupler and rocker.

        Parameters
        ----------
        a, joint, b : str
            Names of points: for a four-bar the ends of the coupler, then the rocker's joint with the ground.

        Returns
        -------
        ndarray, shape (n,)
            Between 0 and pi; forces are transmitted well near pi/2.

        Raises
        ------
        ModelError
            If a point is not known.
        """
        for name in (a, joint, b):
            if name not in self.model.points:
                raise ModelError(f"There is no point {shown(name)}; there are {', '.join(self.model.points)}.")
        first, second = (self.points[end] - self.points[joint] for end in (a, b))
        return np.asarray(
            np.arctan2(np.linalg.norm(np.cross(first, second, axis=0), axis=0), (first * second).sum(axis=0))
        )

    def plot_paths(self, points: Sequence[str] = ()) -> Figure:
        """Draw the mechanism with the paths of points; see `Kinematics.plot_paths`."""
        from fourbar_codegen.presentation.figures import plot_branches

        return plot_branches([self], points)


@dataclass(frozen=True)
class Kinematics(Sequence[Branch]):
    """The branches of a mechanism along a drive: a sequence of `Branch`, the one nearest to the initial values first.

    Attributes
    ----------
    model : CompiledModel
    drive : dict of str to ndarray, shape (n,)
    branches : tuple of Branch
    dead_points : tuple of dict of str to float
        Positions between two branches, where the drive cannot go on: the values of driven quantities and coordinates.
    is_complete : bool
        Whether all modes were found at the places where they were looked for, and no branch ended where it should go
        on.
    """

    model: Kernel
    drive: dict[str, Floats]
    branches: tuple[Branch, ...]
    dead_points: tuple[dict[str, float], ...]
    is_complete: bool

    def __len__(self) -> int:
        return len(self.branches)

    def __getitem__(self, number: Any) -> Any:
        return self.branches[number]

    def __iter__(self) -> Iterator[Branch]:
        return iter(self.branches)

    @property
    def closes(self) -> NDArray[np.bool_]:
        """Where along the drive the loops can close, shape (n,)."""
        return np.asarray(np.isfinite([branch.q for branch in self.branches]).all(axis=1).any(axis=0))

    def __repr__(self) -> str:
        where = "everywhere" if self.closes.all() else f"at {int(self.closes.sum())} of {len(self.closes)} values"
        return (
            f"<Kinematics of {self.model.name} along {', '.join(self.drive)}: {len(self)} branches"
            f"{'' if self.is_complete else ' or more'}, {len(self.dead_points)} dead points; the loops close {where}>"
        )

    def plot(self, *names: Any) -> Figure:
        """Plot quantities of all branches against the drive; needs the extra ``visual``.

        Parameters
        ----------
        *names : str or Symbol
            Coordinates, speeds, or points; by default all coordinates.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ModelError
            If a name is not known, or Matplotlib is not installed.
        """
        from fourbar_codegen.presentation.figures import plot_kinematics

        return plot_kinematics(self, names)

    def plot_paths(self, points: Sequence[str] = ()) -> Figure:
        """Draw the mechanism in each branch with the paths of points; needs the extra ``visual``.

        Parameters
        ----------
        points : sequence of str, optional
            By default the moving joints.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ModelError
            If a point is not known, there is nothing to draw, or Matplotlib is not installed.
        """
        from fourbar_codegen.presentation.figures import plot_branches

        return plot_branches(self.branches, points)


@dataclass(frozen=True)
class _Drive:
    """The driven coordinates and inputs, as functions of a parameter s: piecewise linear between nodes.

    Of one drive, s is its value, in whatever order values are asked for; of several, the length of the way.
    """

    model: Kernel
    names: tuple[str, ...]
    values: Floats
    places: Floats
    nodes: Floats
    at_nodes: Floats
    rates: Floats
    accelerations: Floats
    coordinates: tuple[int, ...]
    p: Floats
    r: Floats
    t: float
    start: Floats
    scales: Floats
    angles: NDArray[np.bool_]

    @property
    def periods(self) -> Floats:
        """Of the scaled coordinates, and of s."""
        return np.append(np.where(self.angles, 2.0 * np.pi / self.scales, np.inf), np.inf)

    def at(self, s: float) -> Floats:
        """The driven values; beyond the ends, by the lines there."""
        before = self._before(s)
        return np.asarray(self.at_nodes[:, before] + (s - self.nodes[before]) * self.slope(s))

    def slope(self, s: float) -> Floats:
        """Their derivatives with respect to s."""
        if len(self.nodes) == 1:
            return np.zeros(len(self.values))
        before, after = self._before(s), self._before(s) + 1
        way = self.at_nodes[:, after] - self.at_nodes[:, before]
        return np.asarray(way / (self.nodes[after] - self.nodes[before]))

    def _before(self, s: float) -> int:
        """The number of the node before s."""
        return int(np.clip(np.searchsorted(self.nodes, s, side="right") - 1, 0, max(0, len(self.nodes) - 2)))

    def inputs(self, driven: Floats) -> Floats:
        """The inputs with the driven ones."""
        r = self.r.copy()
        for name, value, rate, acceleration in zip(self.names, driven, self.rates, self.accelerations, strict=True):
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

    def motion(self, q: Floats, s: float) -> tuple[Floats, Floats, Floats, Floats] | None:
        """u, u', q' and q'' in a position; None where they are not determined."""
        model, driven = self.model, list(self.coordinates)
        r = self.inputs(self.at(s))
        x = np.concatenate((q, np.zeros(model.n_x - model.n_q)))
        # q' = K u + k, of which the driven rows are given; J u + b = 0.
        by_speeds = np.transpose([model.coordinate_change(self.t, x, row, self.p, r) for row in np.eye(model.n_u)])
        jacobian, bias = model.velocity(self.t, x, self.p, r)
        matrix = np.vstack((jacobian, by_speeds[driven]))
        wanted = self.rates[: len(driven)] - model.dynamics(self.t, x, self.p, r)[0][driven]
        u = _solve(matrix, np.concatenate((-bias, wanted)))
        if u is None:
            return None
        x[model.n_q : model.n_q + model.n_u] = u
        qd, *_, bias = model.dynamics(self.t, x, self.p, r)
        wanted = self.accelerations[: len(driven)] - model.motion(self.t, x, np.zeros(model.n_u), self.p, r)[0][driven]
        ud = _solve(matrix, np.concatenate((-bias, wanted)))
        return None if ud is None else (u, ud, qd, model.motion(self.t, x, ud, self.p, r)[0])


def _solve(matrix: Floats, right: Floats) -> Floats | None:
    """The solution of equations that may be redundant; None if it is not determined."""
    size = np.abs(matrix).max(axis=1, initial=0.0)
    size[size == 0.0] = 1.0
    units = np.abs(matrix).max(axis=0, initial=0.0)
    if not np.isfinite(matrix).all() or not units.all():
        return None
    solution, _, rank, _ = np.linalg.lstsq(matrix / size[:, None] / units, right / size, rcond=SINGULAR)
    return solution / units if rank == matrix.shape[1] else None


def kinematics(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, float] | None,
    accelerations: Mapping[Any, float] | None,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
    t: float,
) -> Kinematics:
    """Positions and motions along a drive; see `CompiledModel.kinematics`."""
    path = _given(model, drive, rates, accelerations, parameters, inputs, t)
    n_q, first, last = model.n_q, path.nodes[0], path.nodes[-1]
    start, periods = path.start, path.periods
    if n_q - len(path.coordinates) > model.n_h:
        raise ModelError(
            f"A degree of freedom is left: with {', '.join(path.names)} held, the other {n_q - len(path.coordinates)} "
            f"coordinates have {model.n_h} constraints. Drive another one, too."
        )
    curves: list[Curve] = []
    parts: list[Floats] = []
    is_complete, tried, free = True, 0, dict[str, None]()
    with Progress(f"{model.name}: positions along the drive") as progress:
        for fraction in SEEDS if last > first else (0.0,):
            s = first + fraction * (last - first)
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
        raise AssemblyError(f"The loops of {model.name} do not close anywhere along {', '.join(path.names)}.")

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
    r = np.transpose([path.inputs(path.values[:, k]) for k in range(n)])
    low, high = part[0, -1], part[-1, -1]
    for k, s in enumerate(path.places):
        if low - SAME <= s <= high + SAME:
            near = solve_at(path.function, _between(part, s), s)
            if near is not None:
                q[:, k] = near[:n_q] * path.scales
                motion = path.motion(q[:, k], s)
                if motion is not None:
                    u[:, k], ud[:, k], qd[:, k], qdd[:, k] = motion
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    for place in np.flatnonzero(path.angles) if known.size else []:
        if place not in path.coordinates:
            q[place] -= 2.0 * np.pi * np.round(q[place, known[0]] / (2.0 * np.pi))
    ends = zip(path.names, path.at(low).tolist(), path.at(high).tolist(), strict=True)
    limits = {name: (begin, end) for name, begin, end in ends}
    drive = dict(zip(path.names, path.values, strict=True))
    return Branch(model, path.t, drive, q, qd, qdd, u, ud, limits, r, path.p)


def _given(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, float] | None,
    accelerations: Mapping[Any, float] | None,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
    t: float,
) -> _Drive:
    """The arguments, checked, with coordinates before inputs."""
    if not model.n_h:
        raise ModelError(f"{model.name} has no position constraints: its coordinates are independent of each other.")
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
    speeds = dict.fromkeys(names, 1.0) if rates is None else named(rates, names, "drive")
    second = {} if accelerations is None else named(accelerations, names, "drive")
    p = _parameters(model, parameters)
    r = _inputs(model, p, inputs, t, names)
    path = np.array([values[name] for name in names])
    coordinates = tuple(model.coordinates.index(name) for name in names if name in model.coordinates)
    start = np.array([model.manifest["initial"].get(name, 0.0) for name in model.coordinates])
    scales, angles = np.ones(model.n_q), Loops(model, t, start, p, r).angles
    if model.points:
        drawn = model.drawing(t, np.concatenate((start, np.zeros(model.n_x - model.n_q))), p, r)[0]
        size = np.ptp(drawn[np.isfinite(drawn).all(axis=1)], axis=0).max(initial=0.0) or 1.0
        scales = np.where(angles, 1.0, size)
    units = [scales[model.coordinates.index(name)] if name in model.coordinates else 1.0 for name in names]
    scaled = path / np.array(units)[:, None]
    way = np.linalg.norm(np.diff(scaled, axis=1), axis=0)
    places = scaled[0] if len(names) == 1 else np.concatenate(([0.0], np.cumsum(way)))
    nodes, numbers_of = np.unique(places, return_index=True)
    if len(names) == 1:  # straight on, also where values are far apart
        nodes, numbers_of = nodes[[0, -1]][: len(nodes)], numbers_of[[0, -1]][: len(nodes)]
    return _Drive(
        model,
        names,
        path,
        places,
        nodes,
        path[:, numbers_of],
        np.array([finite_number(speeds.get(name, 0.0), f"the rate of {name}") for name in names]),
        np.array([finite_number(second.get(name, 0.0), f"the acceleration of {name}") for name in names]),
        coordinates,
        p,
        r,
        t,
        start,
        scales,
        angles,
    )


def _parameters(model: Kernel, given: Values | None) -> Floats:
    """All parameters; those without a value that positions do not depend on, such as masses, are 1."""
    if given is not None and not is_mapping(given):
        return named_array(given, model.parameters, {}, "parameter")
    values: dict[str, Any] = {**model.defaults, **named(given or {}, model.parameters, "parameter")}
    missing = [name for name in model.manifest["geometry"] if values[name] is None]
    if missing:
        raise ModelError(
            f"Positions depend on {', '.join(missing)}, which have no default: give values in parameters=."
        )
    return np.array([1.0 if v is None else finite_number(v, f"parameter {name}") for name, v in values.items()])


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
