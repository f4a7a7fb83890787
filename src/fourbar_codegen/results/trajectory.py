"""Trajectory: the result of a simulation, with the attribute names of SciPy."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, ModelWarning
from fourbar_codegen.interface.arguments import name_of, sample_times
from fourbar_codegen.interface.notebook import Page
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.gradient import EventSensitivity, KeptSteps, output_sensitivity
from fourbar_codegen.runtime.enumerations import VECTORS

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import Dataset

    from fourbar_codegen.kernel.sensitivity import Directions
else:
    FuncAnimation = Figure = DataFrame = Dataset = Any

__all__ = ["GIVEN", "Trajectory"]

GIVEN = "none: given states"
"""In place of a method, where states were not simulated."""

INTERPOLATION_RTOL = 0.01
"""Interpolation errors of more than this share of a state's range cause a warning."""
MIN_RANGE = 0.01
"""Smaller ranges of states count as this, in rad, m, ..."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """States over time.

    Attributes
    ----------
    t : ndarray, shape (n_t,)
        Times, s.
    y : ndarray, shape (n_x, n_t)
        States in columns: coordinates, speeds, then auxiliary states.
    r : ndarray, shape (n_r, n_t)
        Inputs in columns.
    sol : callable or None
        Interpolant of the state, with ``dense_output=True``.
    t_events, y_events : list of ndarray or None
        Times and states of each event.
    nfev, njev, nlu : int
        Numbers of evaluations of the right-hand side and its Jacobian, and of factorizations.
    status : int
        0: end reached; 1: terminal event; -1: integration failed.
    message : str
        Why the run ended.
    model : CompiledModel
    kernel : Kernel
        Its compiled functions.
    parameters : ndarray or None
        The parameter values, unless they are the defaults.
    settings : dict
        Arguments of the run: method, t_span, rtol, atol, constraints and others that were given.
    inputs : mapping or None
        Copies of the given sources of inputs; None if the run was read from a file.
    sensitivity : mapping of str to ndarray, shape (n_x, n_t), or None
        Derivatives of the states with respect to parameters, initial values and inputs, with ``sensitivities=`` of
        `simulate`; of shape (n, n_x, n_t) for the n values of a table. At other times they are
        ``sol.sensitivity(t)``, with ``dense_output=True``.
    event_sensitivity : list of mapping of str to (t, y), or None
        For each event, derivatives of its times, ``t``, and of the states at these times, ``y``, like `sensitivity`.
    directions : Directions or None
        What `sensitivity` is with respect to.
    steps : KeptSteps or None
        The steps taken, for `gradient`, with ``gradient=True``.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> trajectory = fb.load("four_bar").simulate((0.0, 1.0), t_eval=[0.0, 0.5, 1.0])
    >>> trajectory["q1"].shape, trajectory.q.shape, trajectory.energy.shape
    ((3,), (3, 3), (3,))
    >>> run = fb.load("four_bar").simulate((0.0, 1.0), sensitivities=["k"], dense_output=True)
    >>> run.sol.sensitivity([0.25, 0.5])["k"].shape
    (6, 2)
    """

    kernel: Kernel
    parameters: Floats | None
    t: Floats
    y: Floats
    r: Floats
    settings: Mapping[str, Any]
    inputs: Mapping[Any, Any] | None
    status: int
    message: str
    sol: Any = None
    t_events: list[Floats] | None = None
    y_events: list[Floats] | None = None
    nfev: int = 0
    njev: int = 0
    nlu: int = 0
    sensitivity: Mapping[str, Floats] | None = None
    event_sensitivity: list[dict[str, EventSensitivity]] | None = None
    directions: Directions | None = None
    steps: KeptSteps | None = None

    model = RegisteredAttribute()
    save = Registered[[str | Path], Path]()
    plot = Registered[..., Figure]()
    plot_frames = Registered[..., Figure]()
    plot_paths = Registered[..., Figure]()
    animate = Registered[..., FuncAnimation]()
    report = Registered[..., Page]()
    to_dataframe = Registered[[], DataFrame]()
    to_xarray = Registered[[], Dataset]()
    _repr_html_ = Registered[[], str]()

    @property
    def _is_given(self) -> bool:
        """Whether times and states were given, and not simulated: they need not follow the equations of motion."""
        return self.settings.get("method") == GIVEN

    @property
    def success(self) -> bool:
        """Whether the run reached its end, or a terminal event."""
        return self.status >= 0

    @property
    def q(self) -> Floats:
        """Generalized coordinates, shape (n_q, n_t)."""
        return self.y[: self.kernel.n_q]

    @property
    def u(self) -> Floats:
        """Generalized speeds, shape (n_u, n_t)."""
        return self.y[self.kernel.n_q : self.kernel.n_q + self.kernel.n_u]

    @property
    def z(self) -> Floats:
        """Auxiliary states, shape (n_z, n_t)."""
        return self.y[self.kernel.n_q + self.kernel.n_u :]

    def __getitem__(self, name: Any) -> Floats:
        """A quantity over time, by its name or SymPy symbol.

        A state, input or output, or another quantity of `columns`: ``"t"``, ``"energy"``, ``"lambda1"``, ..., of shape
        (n_t,); or of shape (3, n_t) the position of a point, m, and ``"momentum"``, ``"angular_momentum"`` (about the
        fixed point) and ``"spin"`` (about the mass centre), as `CompiledModel.momentum`. Where names are equal, the
        first in this order counts.

        Raises
        ------
        ModelError
            If there is no such quantity. The message lists the names.
        """
        model, key = self.kernel, name_of(name)
        for names, rows in ((model.states, "y"), (model.inputs, "r"), (model.outputs, "outputs")):
            if key in names:
                values: Floats = getattr(self, rows)[names.index(key)]
                return values
        if key in ("t", "kinetic_energy", "potential_energy", "energy"):  # without all the others
            values = getattr(self, key)
            return values
        columns = self.columns()
        if key in columns:
            return columns[key]
        if key in model.points:
            return self.points[key]
        if key in self.vectors:
            return self.vectors[key]
        raise ModelError(f"There is no quantity {key!r}; there are {', '.join(self._ipython_key_completions_())}.")

    __iter__ = None  # names are those of columns()

    def __contains__(self, name: object) -> bool:
        """Whether there is a quantity of this name."""
        return (name if isinstance(name, str) else getattr(name, "name", None)) in self._ipython_key_completions_()

    def _ipython_key_completions_(self) -> list[str]:
        model = self.kernel
        n_residuals = model.n_h + len(model.layout.constraints.velocity_rows)
        names = ["t", *model.states, *model.inputs, *model.outputs, *(f"lambda{i + 1}" for i in range(model.n_c))]
        names += [f"constraint_residual_{i + 1}" for i in range(n_residuals)]
        names += ["kinetic_energy", "potential_energy", "energy"]
        names += [name for vector in VECTORS for name in vector.components]
        return list(dict.fromkeys((*names, *model.points, *(vector.name for vector in VECTORS))))

    @cached_property
    def _derived(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        return self.kernel.along(self.t, self.y, self.r, self.parameters)

    @property
    def constraint_residual(self) -> Floats:
        """Constraint violation, shape (n, n_t), in the units of the constraints.

        Phi of the position constraints, n_h rows; then J u + b of the nonholonomic constraints.
        """
        positions, velocities, *_ = self._derived
        return np.concatenate((positions, velocities[list(self.kernel.layout.constraints.velocity_rows)]))

    @property
    def residual_label(self) -> str:
        """The title of `constraint_residual` in plots and tables."""
        return self.kernel.residual_label

    @property
    def velocity_residual(self) -> Floats:
        """Residuals of the velocity constraints, J u + b, shape (n_c, n_t), in the constraints' units per second."""
        return self._derived[1]

    @cached_property
    def vectors(self) -> dict[str, Floats]:
        """Momenta over time by name, each of shape (3, n_t), as `CompiledModel.momentum`.

        ``"momentum"`` (kg m/s); ``"angular_momentum"`` (about the fixed point) and ``"spin"`` (about the mass centre),
        kg m^2/s.
        """
        return self.kernel.quantities_along(self.t, self.y, self.r, self.parameters)

    @cached_property
    def _drawing(self) -> list[Floats]:
        return self.kernel.drawing_along(self.t, self.y, self.r, self.parameters)

    @property
    def points(self) -> dict[str, Floats]:
        """Positions of the mechanism's points over time, by name, m, each of shape (3, n_t).

        Relative to the fixed point of the System, in its frame.
        """
        return dict(zip(self.kernel.points, self._drawing[0], strict=False))  # those without names come last

    @cached_property
    def _motion(self) -> list[Floats]:
        found = self.kernel.motion_along(self.t, self.y, self.r, self.parameters)
        return found if self.kernel.layout.drawing.is_at_rest else [np.full_like(rows, np.nan) for rows in found]

    @property
    def velocities(self) -> dict[str, Floats]:
        """Velocities of the mechanism's points over time, by name, m/s, each of shape (3, n_t).

        They are the rates of the positions, in the System's frame, also of points whose velocity was set otherwise.
        NaN at singular positions, since they are evaluated together with accelerations; and where positions are
        relative to a point that moves, such as a wheel's contact point.
        """
        return dict(zip(self.kernel.points, self._motion[0], strict=False))

    @property
    def accelerations(self) -> dict[str, Floats]:
        """Accelerations of the mechanism's points over time, by name, m/s^2, each of shape (3, n_t).

        In the System's frame; NaN where `velocities` are.
        """
        return dict(zip(self.kernel.points, self._motion[1], strict=False))

    @property
    def forces(self) -> dict[str, Floats]:
        """Forces that depend on inputs, over time, by the name of their point, N, each of shape (3, n_t).

        In the frame of the System; the sum of the loads at the point that depend on an input.
        """
        return dict(zip(self.kernel.forced_points, self._drawing[1], strict=True))

    @property
    def kinetic_energy(self) -> Floats:
        """Kinetic energy, J, shape (n_t,)."""
        values: Floats = self._derived[2][0]
        return values

    @property
    def potential_energy(self) -> Floats:
        """Potential energy, J, shape (n_t,); NaN if it is unknown."""
        values: Floats = self._derived[2][1]
        return values

    @property
    def energy(self) -> Floats:
        """Kinetic plus potential energy, J, shape (n_t,)."""
        return self.kinetic_energy + self.potential_energy

    @property
    def energy_without(self) -> tuple[str, ...]:
        """Springs that the potential energy leaves out, since no antiderivative of their force was found."""
        return self.kernel.energy_without

    @property
    def multipliers(self) -> Floats:
        """Lagrange multipliers of the constraints, shape (n_c, n_t); NaN at singular positions."""
        return self._derived[3]

    @property
    def outputs(self) -> Floats:
        """Outputs, shape (n_o, n_t); NaN at singular positions."""
        return self._derived[4]

    def resample(self, times: ArrayLike) -> Trajectory:
        """The same run at other times, for pictures and tables.

        States are interpolated with ``sol`` if it exists, otherwise with cubic Hermite polynomials through the stored
        states and their rates, whose error is proportional to the fourth power of the distance between stored states.
        They are projected onto the constraints if the run was. Given states that do not follow the equations of motion
        are interpolated by monotone cubic polynomials. Inputs are evaluated from their sources. Sensitivities are kept
        if there is ``sol``. For a run that was read from a file, inputs that are not their default expressions are
        held, if they were tables of the kind "hold", or interpolated linearly; if one of these prescribes a motion,
        states are not projected.

        Parameters
        ----------
        times : array_like, shape (n,)
            Times within the run, in its direction, s.

        Returns
        -------
        Trajectory

        Raises
        ------
        ModelError
            If there are no times, they are not sorted, or they lie outside the run; or the run has no states.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> coarse = fb.load("four_bar").simulate((0.0, 1.0))
        >>> coarse.resample([0.0, 0.25, 0.5]).y.shape
        (6, 3)
        """
        from fourbar_codegen.kernel.inputs import along

        if not len(self.t):
            raise ModelError("The run has no states.")
        times = sample_times(times, self.t[0], self.t[-1], "times")
        held = self.settings.get("held", ())
        ode, prescribed = along(self.kernel, self.parameters, self.t, self.r, self.inputs, held)
        stored, places = np.unique(self.t, return_index=True)  # an event at the start is stored in addition to it
        if self.sol is not None:
            states = np.asarray(self.sol(times))
        elif len(stored) == 1:
            states = np.repeat(self.y[:, :1], len(times), axis=1)
        elif not np.isfinite(self.y).all():
            raise ModelError("Some of the states are not numbers: there is nothing to interpolate between.")
        else:
            rates = _rates(ode, stored, self.y.T[places])
            states = _hermite(stored, self.y[:, places], rates, times)
            share, error, worst = _largest_error(ode, stored, self.y[:, places], rates)
            if share > INTERPOLATION_RTOL and self._is_given:
                from scipy.interpolate import PchipInterpolator

                states = PchipInterpolator(stored, self.y[:, places], axis=1)(times)
            elif share > INTERPOLATION_RTOL:
                _warn_of_gaps(self.kernel.states[worst], stored, error)
        if self.settings["constraints"] == "project" and not prescribed:
            states = np.reshape([ode.project(t, x) for t, x in zip(times, states.T, strict=True)], states.T.shape).T
        r = ode.inputs_along(times, states)
        derivatives = None if self.sensitivity is None or self.sol is None else self.sol.sensitivity(times)
        return replace(self, t=times, y=states, r=r, sensitivity=derivatives, steps=None)

    @cached_property
    def output_sensitivity(self) -> dict[str, Floats]:
        """Derivatives of the outputs with respect to the names of `sensitivity`, each of shape (n_o, n_t).

        Of shape (n, n_o, n_t) for the n values of a table.

        Raises
        ------
        ModelError
            If the run was made without ``sensitivities=``, or redundant constraints leave outputs undetermined.
        """
        if self.sensitivity is None or self.directions is None:
            raise ModelError("The run has no sensitivities: simulate(..., sensitivities=[...]) finds them.")
        of_states = np.concatenate([part.reshape(-1, *self.y.shape) for part in self.sensitivity.values()])
        found = output_sensitivity(
            self.kernel,
            self.t,
            self.y,
            self.r,
            parameters=self.parameters,
            inputs=self.inputs or {},
            directions=self.directions,
            sensitivity=of_states,
        )
        return self.directions.by_name(found)

    def gradient(self, cost: ArrayLike | Mapping[Any, ArrayLike]) -> dict[str, Any]:
        """The gradient of a cost of the samples, by one sweep backwards over the steps of the run.

        Its time does not grow with the number of parameters: about three times that of the run. An integral over time
        is a cost of the last sample, if the integrand is the rate of an auxiliary state. Times of samples are held,
        also that of the end by an event without ``t_eval``; `event_sensitivity` has the derivatives of this time, and
        of the state there.

        Parameters
        ----------
        cost : array_like, shape (n_x, n_t), or mapping
            The derivatives of the cost with respect to the states at ``t``; or from names of states and outputs to the
            derivatives with respect to these, each of shape (n_t,), or a number for all samples. A sample at a terminal
            event besides those of ``t_eval`` has none: n_t is then one less, as of ``run.y[:, :-1]``.

        Returns
        -------
        dict of str to float or ndarray
            The derivatives with respect to parameters; to initial values of the independent coordinates and speeds and
            of the auxiliary states, where the others follow from loop closure; and to given inputs: a number, or an
            array with an entry for each value of a table. A given ``x0`` depends on no parameter and no input. Left out
            are parameters on which times of jumps depend, those with other values of which speeds would jump by an
            expression of time in the model, and those that redundant constraints do not let change alone.

        Raises
        ------
        ModelError
            If the run was not made with ``gradient=True``, or failed; if the cost has another shape or an unknown
            name, or is not finite.
        SimulationError
            If the equations have no derivative at a state of the run.

        Source: A. Walther, "Automatic differentiation of explicit Runge-Kutta methods for optimal control",
        *Computational Optimization and Applications* 36 (2007).

        Examples
        --------
        The cost q2(1 s)^2 by stiffness and length:

        >>> import fourbar_codegen as fb
        >>> run = fb.load("four_bar").simulate((0.0, 1.0), t_eval=[1.0], gradient=True)
        >>> gradient = run.gradient({"q2": 2 * run["q2"]})
        >>> round(gradient["k"], 4), round(gradient["l2"], 4)
        (0.0095, -1.5698)
        """
        if self.steps is None:
            raise ModelError("The steps of this run are not known: simulate(..., gradient=True) keeps them.")
        if not self.success:
            raise ModelError(f"There is no gradient of a run that failed. {self.message}")
        return self.steps.gradient(cost)

    def columns(self) -> dict[str, Floats]:
        """All scalar quantities over time by name, each of shape (n_t,).

        ``t`` (s), states, inputs, outputs; multipliers ``lambda1``, ``lambda2``, ... in the order of the constraints;
        ``constraint_residual_1``, ...; ``kinetic_energy``, ``potential_energy`` and ``energy`` (J); ``momentum_x``
        (kg m/s), ``angular_momentum_x``, ``spin_x`` (kg m^2/s), ... A state, input or output with one of these names
        takes precedence.
        """
        model = self.kernel
        columns = {"t": self.t, **dict(zip(model.states, self.y, strict=True))}
        columns.update(zip(model.inputs, self.r, strict=True))
        columns.update(zip(model.outputs, self.outputs, strict=True))
        derived = {f"lambda{i}": row for i, row in enumerate(self.multipliers, start=1)}
        derived.update({f"constraint_residual_{i}": row for i, row in enumerate(self.constraint_residual, start=1)})
        derived["kinetic_energy"] = self.kinetic_energy
        derived["potential_energy"] = self.potential_energy
        derived["energy"] = self.energy
        for vector in VECTORS:
            derived.update(zip(vector.components, self.vectors[vector.name], strict=True))
        return {**columns, **{name: row for name, row in derived.items() if name not in columns}}

    def __repr__(self) -> str:
        n, name = len(self.t), self.kernel.name
        span = f"{self.t[0]:g} s to {self.t[-1]:g} s, {n} states" if n else "no states"
        return f"<Trajectory of {name}: {span}, {self.nfev} evaluations; {self.message}>"


def _rates(ode: Any, t: Floats, y: Floats) -> Floats:
    """The rates of states in rows at the beginnings and ends of the intervals between them, shape (2, n_x, n_t - 1).

    At a jump of an input, they are those on the interval's own side.
    """
    if not (ode.n_breakpoints or ode.has_tables):
        rates = np.transpose([ode(time, x) for time, x in zip(t, y, strict=True)])
        return np.stack([rates[:, :-1], rates[:, 1:]])
    found, rounding = np.empty((2, y.shape[1], len(t) - 1)), 4.0 * np.spacing(np.abs(t).max())
    for i in range(len(t) - 1):
        ode.clock = 0.0, t[i] + rounding, t[i + 1] - rounding
        found[:, :, i] = ode(t[i], y[i]), ode(t[i + 1], y[i + 1])
    ode.clock = 0.0, -math.inf, math.inf
    return found


def _hermite(t: Floats, y: Floats, rates: Floats, times: Floats) -> Floats:
    """Cubic Hermite interpolation of states in columns; importing SciPy's class would take half a second."""
    i = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    step = t[i + 1] - t[i]
    s = (times - t[i]) / step
    values: Floats = (
        (1.0 + 2.0 * s) * (1.0 - s) ** 2 * y[:, i]
        + s**2 * (3.0 - 2.0 * s) * y[:, i + 1]
        + step * s * (1.0 - s) * ((1.0 - s) * rates[0][:, i] - s * rates[1][:, i])
    )
    return values


def _largest_error(ode: Any, t: Floats, y: Floats, rates: Floats) -> tuple[float, float, int]:
    """The largest error of the interpolation, relative to the range of a state, and absolute; and the state's number.

    With the fourth derivative D and steps h, the polynomial errs by D h^4 / 384 in the middle of an interval, and its
    derivative by D h^3 / 128 at a quarter of it, which the right-hand side tells.
    """
    h = np.diff(t)
    quarters = _hermite(t, y, rates, t[:-1] + h / 4.0)
    slopes = 1.125 * np.diff(y) / h + 0.1875 * rates[0] - 0.3125 * rates[1]
    exact = np.transpose([ode(time, x) for time, x in zip(t[:-1] + h / 4.0, quarters.T, strict=True)])
    errors = np.nan_to_num(np.abs(slopes - exact) * h / 3.0).max(axis=1)
    share = errors / np.maximum(np.ptp(y, axis=1), MIN_RANGE)
    worst = int(np.argmax(share))
    return float(share[worst]), float(errors[worst]), worst


def _warn_of_gaps(name: str, t: Floats, error: float) -> None:
    """Warn that stored times are too far apart for the interpolation between them."""
    warnings.warn(
        f"Stored times are up to {np.diff(t).max():.3g} s apart. Between them {name} is interpolated with errors of "
        f"about {error:.2g}: store more times by t_eval, or take dense_output=True.",
        ModelWarning,
        stacklevel=3,
    )
