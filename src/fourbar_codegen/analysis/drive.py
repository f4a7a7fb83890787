"""A drive: which coordinates and inputs are driven, along which values, and what moves with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.loop_closure import Loops, mechanism_size, row_scales
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import Values, finite_number, is_mapping, named, named_array, numbers
from fourbar_codegen.kernel.dependent import solve_redundant
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["Drive", "read_drive"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Drive:
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
    sizes: tuple[Floats, Floats]
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
            wrt_inputs = model.constraint_partials(self.t, at_rest, self.p, r)[1]
            for name, rate in zip(self.names, slope, strict=True):
                if name in model.inputs:
                    along += wrt_inputs[:, model.inputs.index(name)] * rate
        matrix, size = np.column_stack((slopes * self.scales, along)), self.sizes[0]
        rows, errors = [matrix / size[:, None]], [error / size]
        for place, value, rate in zip(self.coordinates, driven[: len(self.coordinates)], slope, strict=False):
            row = np.zeros((1, n_q + 1))
            row[0, place], row[0, n_q] = 1.0, -rate / self.scales[place]
            rows.append(row)
            errors.append(np.array([q[place] - value]) / self.scales[place])
        return np.concatenate(errors), np.vstack(rows)

    def motion(self, q: Floats, s: float, number: int) -> tuple[Floats, Floats, Floats, Floats] | None:
        """u, u', q' and q'' in a position, with the rates at one of the places; None where they are not determined."""
        model, driven = self.model, list(self.coordinates)
        r = self.inputs(self.at(s), number)
        x = np.concatenate((q, np.zeros(model.n_x - model.n_q)))
        # q' = K u + k, of which the driven rows are given; J u + b = 0.
        wrt_speeds = np.transpose([model.coordinate_change(self.t, x, row, self.p, r) for row in np.eye(model.n_u)])
        jacobian, bias = model.velocity(self.t, x, self.p, r)
        matrix = np.vstack((jacobian, wrt_speeds[driven]))
        of_drives = np.abs(wrt_speeds[driven]).max(axis=1, initial=0.0)
        size = np.append(self.sizes[1], np.where(of_drives > 0.0, of_drives, 1.0))
        wanted = self.rates[: len(driven), number] - model.dynamics(self.t, x, self.p, r)[0][driven]
        u = solve_redundant(matrix, np.concatenate((-bias, wanted)), size)
        if u is None:
            return None
        x[model.n_q : model.n_q + model.n_u] = u
        qd, *_, bias = model.dynamics(self.t, x, self.p, r)
        at_constant_speeds = model.motion(self.t, x, np.zeros(model.n_u), self.p, r)[0]
        wanted = self.accelerations[: len(driven), number] - at_constant_speeds[driven]
        ud = solve_redundant(matrix, np.concatenate((-bias, wanted)), size)
        return None if ud is None else (u, ud, qd, model.motion(self.t, x, ud, self.p, r)[0])


def read_drive(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, ArrayLike] | None,
    accelerations: Mapping[Any, ArrayLike] | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
) -> Drive:
    """The arguments of `CompiledModel.kinematics`, checked, with coordinates before inputs."""
    if model.n_c > len([row for row in model.layout.constraints.position_rows if row is not None]):
        raise ModelError(f"{model.name} has nonholonomic constraints: its positions do not follow from a drive.")
    sources = [name for name in model.prescribed if f"{name}''" in model.inputs]
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
    r, unset = _inputs(model, p, inputs, t, names)
    without_value = (*without_value, *unset)
    path = np.array([values[name] for name in names])
    coordinates = tuple(model.coordinates.index(name) for name in names if name in model.coordinates)
    start = np.array([model.layout.initial.get(name, 0.0) for name in model.coordinates])
    angles = Loops(model, t, start, p, r).angles
    scales = np.where(angles, 1.0, mechanism_size(model, t, start, p, r))
    units = np.array([scales[model.coordinates.index(n)] if n in model.coordinates else 1.0 for n in names])
    scaled = path / units[:, None]
    places, curves = scaled[0], None
    if len(names) > 1:
        places = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(scaled, axis=1), axis=0)))
        curves = _curves(places, path)
    return Drive(
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
        row_scales(model, t, start, p, r, scales),
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
    missing = [name for name in without if name in model.layout.geometry]
    if missing:
        raise ModelError(
            f"Positions depend on {', '.join(missing)}, which have no default: give values in parameters=."
        )
    known = [1.0 if v is None else finite_number(v, f"parameter {name}") for name, v in values.items()]
    return np.array(known), without


def _inputs(
    model: Kernel, p: Floats, given: Mapping[Any, float] | None, t: float, driven: Sequence[str]
) -> tuple[Floats, tuple[str, ...]]:
    """All inputs, and those without a value that no position depends on: they are 0."""
    r = model.default_inputs(t, p)
    values = named(given or {}, model.inputs, "input")
    for name, value in (model.rates_at_rest(values) | values).items():
        r[model.inputs.index(name)] = finite_number(value, f"input {name}")
    unset = [place for place, value in enumerate(r) if not np.isfinite(value)]
    entries = [model.layout.inputs[place] for place in unset]
    needed = [e.name for e in entries if e.of in model.prescribed and e.of not in driven]
    if needed:
        raise ModelError(f"Positions and their rates depend on {', '.join(needed)}: give values in inputs=.")
    r[unset] = 0.0
    return r, tuple(entry.name for entry in entries if entry.of not in driven)
