"""Parameters and initial values of a mechanism from measurements, by least squares with exact derivatives."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state, nearby_state
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.errors import AssemblyError, ModelError, SimulationError, meant, shown
from fourbar_codegen.interface.arguments import (
    finite_number,
    is_integer,
    is_mapping,
    name_of,
    named,
    names_of,
    numbers,
    one_of,
    positive,
)
from fourbar_codegen.interface.notebook import table
from fourbar_codegen.interface.progress import QUIET_SECONDS, Progress
from fourbar_codegen.kernel.inputs import InputSource
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.sensitivity import (
    Directions,
    corrected,
    directions_of,
    implicit_derivatives,
    independent_states,
    require_fixed_breakpoints,
)
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.simulation.methods import MethodLike
from fourbar_codegen.simulation.run_options import RunOptions, RunStart
from fourbar_codegen.simulation.simulate import run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Experiment", "Fit", "fit"]

Floats = NDArray[np.float64]

TOLERANCES = (1e-8, 1e-10)
"""Of runs by default, relative and absolute."""

RANK_RTOL = 1e-10
"""Singular values of the scaled Jacobian below this fraction of the largest leave parameters undetermined."""

MIN_TRUST_RATIO = 1e-3
"""A trust region below this fraction of the residuals is too small to begin with."""

ROUNDING_RTOL = 1e-11
"""Of simulated values: relative changes of an unknown that change them less are rounding errors of derivatives."""

NAMES = "is a sequence of names, or a mapping from them"

QUIET_FIT_SECONDS = 0.1
"""A fit that takes less, in s, reports no progress."""

Slopes = Callable[[Floats], tuple[Floats, Floats]]

LOSSES: dict[str, Slopes | None] = {
    "linear": None,
    "soft_l1": lambda z: ((1.0 + z) ** -0.5, -0.5 * (1.0 + z) ** -1.5),
    "huber": lambda z: (np.maximum(z, 1.0) ** -0.5, np.where(z > 1.0, -0.5 * np.maximum(z, 1.0) ** -1.5, 0.0)),
    "cauchy": lambda z: (1.0 / (1.0 + z), -((1.0 + z) ** -2)),
    "arctan": lambda z: (1.0 / (1.0 + z**2), -2.0 * z * (1.0 + z**2) ** -2),
}
"""First and second derivatives of `scipy.optimize.least_squares`'s functions of squared residuals."""


@dataclass(frozen=True)
class Experiment:
    """Measurements of one motion, and how it was made.

    Attributes
    ----------
    t : array_like, shape (n,)
        Times of the measurements, increasing, s.
    measured : mapping of name or symbol to array_like, shape (n,)
        Measured states and outputs.
    start : float, optional
        The time at which the motion begins; by default the first measurement's.
    coordinates, speeds, auxiliary_states : mapping, optional
        Known initial values of independent ones, by names or symbols; by default the model's. Those of unknowns are
        first guesses.
    guess : mapping, optional
        Starting values of dependent coordinates, which decide the assembly mode, as for `CompiledModel.initial_state`.
    parameters : mapping, optional
        Known parameters of this experiment, such as a load; by default the model's.
    inputs : mapping, optional
        Sources of inputs, as for `CompiledModel.simulate`.
    """

    t: ArrayLike
    measured: Mapping[Any, ArrayLike]
    start: float | None = None
    coordinates: Mapping[Any, float] = field(default_factory=dict)
    speeds: Mapping[Any, float] = field(default_factory=dict)
    auxiliary_states: Mapping[Any, float] = field(default_factory=dict)
    guess: Mapping[Any, float] | None = None
    parameters: Mapping[Any, float] = field(default_factory=dict)
    inputs: Mapping[Any, InputSource] | None = None


@dataclass(frozen=True, repr=False)
class Fit:
    """The result of `fit`.

    Attributes
    ----------
    values : dict of str to float
        Estimates, by the names of the unknowns. Initial values of several experiments have the experiment's number
        appended, as in ``"q1 (2)"``.
    stderr : dict of str to float
        Their standard errors; infinite for those that the measurements do not determine.
    covariance : ndarray, shape (m, m)
        Of the estimates, in the order of `values`.
    residuals : tuple of dict of str to ndarray
        For each experiment, what was simulated minus what was measured, in the quantities' units.
    runs : tuple of Trajectory
        The fitted motion of each experiment at the times of its measurements.
    experiments : tuple of Experiment
    cost : float
        Half the weighted sum of squares of the residuals, or of the loss.
    success : bool
    message : str
        Why the search ended, and which unknowns are not determined.
    nfev, njev : int
        Numbers of simulations of all experiments, without and with derivatives.
    """

    values: dict[str, float]
    stderr: dict[str, float]
    covariance: Floats
    residuals: tuple[dict[str, Floats], ...]
    runs: tuple[Trajectory, ...]
    experiments: tuple[Experiment, ...]
    cost: float
    success: bool
    message: str
    nfev: int
    njev: int

    def plot(self) -> Figure:
        """Plot measurements and the fitted motion over time; needs the extra ``visual``.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ModelError
            If the extra is not installed.
        """
        from fourbar_codegen.views.figures import plot_fit

        measured = [
            {name: self.runs[i][name] - left for name, left in residuals.items()}
            for i, residuals in enumerate(self.residuals)
        ]
        return plot_fit(self.runs, measured)

    def __repr__(self) -> str:
        rows = [f"{name} = {value:.6g} +- {self.stderr[name]:.2g}" for name, value in self.values.items()]
        return f"<Fit: {', '.join(rows)}; {self.message}>"

    def _repr_html_(self) -> str:
        rows = [(name, f"{value:.6g}", f"{self.stderr[name]:.2g}") for name, value in self.values.items()]
        return table(self.message, ("unknown", "estimate", "standard error"), rows)


def fit(
    model: CompiledModel,
    data: Any,
    parameters: Sequence[Any] | Mapping[Any, float],
    *,
    outputs: Sequence[Any] | None = None,
    bounds: Mapping[Any, tuple[float, float]] | None = None,
    sigma: Mapping[Any, ArrayLike] | None = None,
    loss: str = "linear",
    max_nfev: int | None = None,
    method: MethodLike = "DOP853",
    rtol: float | None = None,
    atol: float | None = None,
    constraints: str = "project",
) -> Fit:
    """Fit parameters and initial values to measurements, by nonlinear least squares with exact derivatives.

    Parameters
    ----------
    model : CompiledModel
    data : mapping, pandas.DataFrame, Experiment, or sequence of these
        One experiment or several. Of a mapping or DataFrame, ``"t"`` are the times (for a DataFrame the index, if there
        is no such column), and all other names those of measured states and outputs.
    parameters : sequence of names or symbols, or mapping to first guesses
        The unknowns: parameters, common to all experiments; and initial values of independent coordinates, speeds and
        auxiliary states, one for each experiment. Guesses are otherwise the model's values.
    outputs : sequence of names, optional
        The measured quantities to compare; by default all.
    bounds : mapping of name to (float, float), optional
        Lower and upper bound of unknowns.
    sigma : mapping of name to float or array_like, optional
        Standard deviations of all measured quantities, by which residuals are divided. By default 1, and the covariance
        follows from the scatter of the residuals.
    loss : {"linear", "soft_l1", "huber", "cauchy", "arctan"}, optional
        As for `scipy.optimize.least_squares`, such as "soft_l1" against outliers: residuals above `sigma`, which is
        needed for all but "linear", count less. The covariance then follows from the scatter of those below.
    max_nfev : int, optional
        As for `scipy.optimize.least_squares`.
    method, rtol, atol, constraints
        As for `CompiledModel.simulate` with sensitivities, but tolerances are 1e-8 and 1e-10 by default;
        ``constraints`` is "project" or "none".

    Returns
    -------
    Fit

    Raises
    ------
    ModelError
        If a name is unknown, a dependent state or an expression of others is to be fitted, measurements are not finite
        or of different lengths, there are fewer of them than unknowns, `sigma` leaves one out or is missing for a
        loss, a guess is outside of its bounds, or no unknown changes anything there.
    SimulationError, AssemblyError
        If the first guess cannot be simulated, or has no derivatives.

    Source: K. Schittkowski, *Numerical Data Fitting in Dynamical Systems*, Kluwer 2002; trust region: M. A. Branch, T.
    F. Coleman, Y. Li, *SIAM Journal on Scientific Computing* 21 (1999), by SciPy.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> four_bar, t = fb.load("four_bar"), np.linspace(0.0, 2.0, 101)
    >>> measured = four_bar.simulate((0.0, 2.0), t_eval=t, parameters={"k": 3.0, "c": 1.5})
    >>> found = fb.fit(four_bar, {"t": t, "q2": measured["q2"]}, {"k": 1.0, "c": 0.5})
    >>> {name: round(value, 4) for name, value in found.values.items()}
    {'k': 3.0, 'c': 1.5}
    """
    from scipy.optimize import least_squares

    if not isinstance(model, CompiledModel):
        raise ModelError(f"A compiled model is fitted, as compile_model and load return it, not {shown(model)}.")
    one_of(loss, LOSSES, "loss")
    one_of(constraints, ("project", "none"), "option constraints= of a fit")
    if loss != "linear" and sigma is None:
        raise ModelError(f"loss={loss!r} tells outliers by their residuals in units of sigma: give sigma.")
    if max_nfev is not None and (not is_integer(max_nfev) or max_nfev < 1):
        raise ModelError(f"max_nfev must be a positive integer or None, not {shown(max_nfev)}.")
    experiments = _experiments(data)
    problem = _Problem.of(
        model.kernel,
        experiments,
        parameters,
        outputs,
        sigma,
        method=method,
        rtol=rtol,
        atol=atol,
        constraints=constraints,
    )
    low, high = _bounds(problem, bounds)
    begin = time.monotonic()
    first = problem.simulated(problem.guess)
    if problem.failure:
        raise SimulationError(f"The first guess cannot be used: {problem.failure}")
    if not first[1].any():
        raise ModelError(
            f"At the first guess, the measured quantities do not change with {', '.join(problem.names)}: give another "
            "guess, or other measurements."
        )
    if len(first[0]) < len(problem.guess):
        raise ModelError(f"{len(first[0])} measurements do not determine {len(problem.guess)} unknowns.")
    with Progress(f"{model.name}: fit", unwatched=QUIET_SECONDS) as progress:

        def residual(unknowns: Floats) -> Floats:
            found = problem.simulated(unknowns)[0]
            if time.monotonic() - begin > QUIET_FIT_SECONDS:
                progress.stage(f"sum of squares {found @ found:.6g}")
            return found

        def solve(guess: Floats, origin: Floats | float = 0.0) -> Any:
            """A local minimum, with unknowns measured from an origin."""
            return least_squares(
                lambda changes: residual(origin + changes),
                guess - origin,
                jac=lambda changes: problem.simulated(origin + changes)[1],
                bounds=(low - origin, high - origin),
                x_scale="jac",
                gtol=None,  # it has the units of the measurements
                loss=loss,
                max_nfev=max_nfev,
            )

        origin = _origin(problem.guess, *first)
        if origin is None:
            found = solve(problem.guess)
        else:
            found = solve(np.clip(solve(problem.guess, origin).x + origin, low, high))
    covariance, open_names = _covariance(problem, found.x, LOSSES[loss], absolute=sigma is not None)
    message = found.message
    if open_names:
        message += f" The measurements do not determine {', '.join(open_names)}."
    at_bounds = [name for name, active in zip(problem.names, found.active_mask, strict=True) if active]
    if at_bounds:
        message += f" At a bound: {', '.join(at_bounds)}."
    problem.simulated(found.x)
    runs = problem.runs
    return Fit(
        values=dict(zip(problem.names, found.x.tolist(), strict=True)),
        stderr=dict(zip(problem.names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
        covariance=covariance,
        residuals=tuple(
            {name: run[name] - values for name, values in measured.items()}
            for run, measured in zip(runs, problem.measured, strict=True)
        ),
        runs=runs,
        experiments=experiments,
        cost=float(found.cost),
        success=bool(found.success),
        message=message,
        nfev=problem.n_runs,
        njev=found.njev,
    )


def _origin(guess: Floats, residuals: Floats, jacobian: Floats) -> Floats | None:
    """From where unknowns are measured at first, or None for 0.

    SciPy's first trust region is as large as the guess, in units of its effect. If that is much less than the
    residuals, as for a guess of 1e-9, or of 0 at a bound, the fit could end there. Measured from the origin, the region
    is as large as the residuals; from where that ends, the fit is repeated without it, for criteria of convergence that
    are relative to the unknowns.
    """
    effect = np.linalg.norm(jacobian, axis=0)
    wanted = float(np.linalg.norm(residuals))
    if np.linalg.norm(guess * effect) >= MIN_TRUST_RATIO * wanted:
        return None
    changes: Floats = wanted / math.sqrt(len(guess)) / np.where(effect > 0.0, effect, math.inf)
    return guess - changes


def _experiments(data: Any) -> tuple[Experiment, ...]:
    if isinstance(data, Experiment):
        return (data,)
    if hasattr(data, "columns") and hasattr(data, "index"):  # a DataFrame
        columns = {name: data[name].to_numpy() for name in data.columns}
        times = columns.pop("t") if "t" in columns else data.index.to_numpy()
        return (Experiment(times, columns),)
    if is_mapping(data):
        columns = {name_of(key): values for key, values in data.items()}
        if "t" not in columns:
            raise ModelError(f"The data have no times: give them as 't', beside {', '.join(columns) or 'nothing'}.")
        return (Experiment(columns.pop("t"), columns),)
    if isinstance(data, Sequence) and not isinstance(data, str) and data:
        return tuple(experiment for each in data for experiment in _experiments(each))
    raise ModelError(
        "Data are a mapping with 't' and measured quantities, a DataFrame, an Experiment, or a sequence of these, not "
        f"{shown(data)}."
    )


@dataclass(frozen=True)
class _Start:
    """The options and the start of a run, and the derivatives of the state and parameters, shape (n_x + n_p, n)."""

    options: RunOptions
    start: RunStart
    matrix: Floats


@dataclass
class _Problem:
    """The residuals as a function of the unknowns, with the runs of the last call."""

    model: Kernel
    experiments: tuple[Experiment, ...]
    times: tuple[Floats, ...]
    measured: tuple[dict[str, Floats], ...]
    weights: tuple[dict[str, Floats], ...]
    weighted: Floats
    """All measurements times their weights."""
    names: tuple[str, ...]
    guess: Floats
    natural: Floats
    """Sizes of the model's own values, or 1 for zero: guesses and estimates may be far smaller."""
    own: tuple[str, ...]
    """The names of the unknowns of one experiment: parameters, then initial values."""
    places: list[int]
    """Theirs among states and parameters."""
    n_parameters: int
    directions: Directions
    how: dict[str, Any]
    starts: list[_Start | None]
    """Those of the last run of each experiment."""
    runs: tuple[Trajectory, ...] = ()
    last: tuple[bytes, Floats, Floats] | None = None
    failure: str = ""
    n_runs: int = 0

    @classmethod
    def of(
        cls,
        model: Kernel,
        experiments: tuple[Experiment, ...],
        unknowns: Any,
        outputs: Sequence[Any] | None,
        sigma: Mapping[Any, ArrayLike] | None,
        *,
        method: MethodLike,
        rtol: float | None,
        atol: float | None,
        constraints: str,
    ) -> _Problem:
        names = names_of(unknowns, f"parameters {NAMES}")
        for name in names:
            if name in model.inputs:
                raise ModelError(f"{name!r} is an input: give its expression a parameter, and fit this.")
        parameters = [name for name in names if name in model.parameters]
        initial = [name for name in names if name not in model.parameters]
        directions = directions_of(model, (*parameters, *initial))  # refuses unknown, dependent and repeated names
        guesses = {name_of(key): value for key, value in unknowns.items()} if is_mapping(unknowns) else {}
        if not names:
            raise ModelError("There is nothing to fit: name parameters or initial values.")
        n = len(experiments)
        all_names = (*parameters, *(name if n == 1 else f"{name} ({i + 1})" for i in range(n) for name in initial))
        measured = [_measured(model, i, e, outputs) for i, e in enumerate(experiments)]
        for i, each in enumerate(experiments):
            for name in map(name_of, each.parameters):
                if name in parameters:
                    raise ModelError(
                        f"{name} is an unknown, and has a known value in experiment {i + 1}: leave one out."
                    )
        values = [_number(name, guesses.get(name, model.defaults.get(name)), "parameter") for name in parameters]
        known = [(*e.coordinates.items(), *e.speeds.items(), *e.auxiliary_states.items()) for e in experiments]
        for i in range(n):
            start = {**model.layout.initial, **{name_of(key): value for key, value in known[i]}}
            values += [_number(name, guesses.get(name, start.get(name, 0.0)), "initial value") for name in initial]
        own = [
            *(model.defaults[name] for name in parameters),
            *n * [model.layout.initial.get(name) for name in initial],
        ]
        deviations = (
            {} if sigma is None else named(_mapping(sigma, "sigma"), (*model.states, *model.outputs), "state or output")
        )
        weights = []
        for _, columns in measured:
            weight = {}
            for name, column in columns.items():
                if sigma is not None and name not in deviations:
                    raise ModelError(
                        f"sigma has no standard deviation of {name}: give those of all measured quantities."
                    )
                deviation = numbers(deviations.get(name, 1.0), f"sigma of {name}")
                if deviation.shape not in ((), column.shape) or not (np.isfinite(deviation) & (deviation > 0)).all():
                    raise ModelError(
                        f"sigma of {name} must be a positive number, or an array of the shape of its data."
                    )
                weight[name] = np.broadcast_to(1.0 / deviation, column.shape)
            weights.append(weight)
        how = {
            "method": method,
            "rtol": None if rtol is None else positive(rtol, "rtol"),
            "atol": None if atol is None else positive(atol, "atol"),
            "constraints": constraints,
        }
        return cls(
            model,
            experiments,
            tuple(times for times, _ in measured),
            tuple(columns for _, columns in measured),
            tuple(weights),
            np.concatenate(
                [w[name] * column for w, (_, of) in zip(weights, measured, strict=True) for name, column in of.items()]
            ),
            all_names,
            np.array(values),
            np.array([abs(value or 0.0) or 1.0 for value in own]),
            (*parameters, *initial),
            [(*model.states, *model.parameters).index(name) for name in (*parameters, *initial)],
            len(parameters),
            directions,
            how,
            [None] * n,
        )

    def simulated(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """The weighted residuals and their Jacobian; NaN where a motion cannot be simulated."""
        key = unknowns.tobytes()
        if self.last is not None and self.last[0] == key:
            return self.last[1:]
        counts = [sum(map(len, columns.values())) for columns in self.measured]
        residuals, jacobian = np.full(sum(counts), math.nan), np.zeros((sum(counts), len(unknowns)))
        runs: list[Trajectory] = []
        self.failure = ""
        n_initial = len(self.own) - self.n_parameters
        end = 0
        for i, count in enumerate(counts):
            rows = slice(end, end := end + count)
            begin = self.n_parameters + i * n_initial
            own = [*range(self.n_parameters), *range(begin, begin + n_initial)]
            try:
                run = self._run(i, unknowns[own])
            except (AssemblyError, SimulationError) as error:
                why = str(error)
            else:
                why = "" if run.success else run.message
                runs.append(run)
            if not why:
                residuals[rows], jacobian[rows, own] = self._compared(i, run)
                if not np.isfinite(jacobian[rows]).all():
                    why = f"The measured quantities have no derivatives there. {run.message}"
            if why:
                residuals[rows] = jacobian[rows, own] = math.nan
                self.failure = self.failure or why
        self.runs = tuple(runs)
        if not self.failure:
            jacobian[:, self._have_no_effect(unknowns, residuals, jacobian)] = 0.0
        self.last = key, residuals, jacobian
        return self.last[1:]

    def _have_no_effect(self, unknowns: Floats, residuals: Floats, jacobian: Floats) -> NDArray[np.bool_]:
        """Which unknowns have derivatives that are rounding errors: all of their value changes nothing."""
        change = np.linalg.norm(jacobian, axis=0) * np.maximum(
            np.maximum(np.abs(unknowns), np.abs(self.guess)), self.natural
        )
        found: NDArray[np.bool_] = change <= ROUNDING_RTOL * np.linalg.norm(residuals + self.weighted)
        return found

    def _run(self, i: int, values: Floats) -> Trajectory:
        """A run of an experiment, from the state that follows from values of its unknowns."""
        if not np.isfinite(values).all():  # where SciPy divides by a Jacobian of zeros
            raise SimulationError(f"The unknowns {', '.join(self.own)} are not finite: {shown(values)}.")
        self.n_runs += 1
        start = self.starts[i]
        start = self.starts[i] = self._first(i, values) if start is None else self._next(start, values)
        directions = Directions(self.directions.places, start.matrix, self.directions.sources)
        return run(self.model, start.options, start.start, directions)

    def _first(self, i: int, values: Floats) -> _Start:
        """The start of the first run of an experiment, whose arguments are checked."""
        model, experiment, times = self.model, self.experiments[i], self.times[i]
        start = float(times[0] if experiment.start is None else experiment.start)
        own = dict(zip(self.own, values.tolist(), strict=True))
        known = {name_of(key): value for key, value in experiment.parameters.items()}
        p = model.parameter_vector(known | {name: own[name] for name in self.own[: self.n_parameters]})
        require_fixed_breakpoints(model, p, self.own[: self.n_parameters])
        initial = [
            {name_of(key): value for key, value in given.items()} | {name: own[name] for name in names if name in own}
            for names, given in zip(
                independent_states(model),
                (experiment.coordinates, experiment.speeds, experiment.auxiliary_states),
                strict=True,
            )
        ]
        coordinates, speeds, auxiliary_states = (given or None for given in initial)
        x0 = initial_state(
            model,
            coordinates,
            speeds,
            auxiliary_states=auxiliary_states,
            t=start,
            guess=experiment.guess,
            parameters=p,
            inputs=experiment.inputs,
        )
        options = RunOptions.of(
            model,
            (start, float(times[-1])),
            t_eval=times,
            progress=False,
            sensitivities=self.own,
            tolerances=TOLERANCES,
            **self.how,
        )
        first = RunStart.of(model, options, x0, p, experiment.inputs)
        return _Start(options, first, implicit_derivatives(model, start, x0, self.directions, p, first.inputs))

    def _next(self, last: _Start, values: Floats) -> _Start:
        """The start of the next run: the state is predicted by the derivatives of the last one."""
        model, start, n_x = self.model, last.start, self.model.n_x
        assert start.x0 is not None
        assert start.parameters is not None
        held = np.concatenate((start.x0, start.parameters))
        predicted = held + last.matrix @ (values - held[self.places])
        held[self.places] = predicted[self.places] = values
        p, t, inputs = held[n_x:], last.options.t_span[0], start.inputs
        found = corrected(model, t, predicted[:n_x], self.directions, p, inputs)
        if found is None:
            x0 = nearby_state(model, held[:n_x], t=t, parameters=p, inputs=inputs)
            found = x0, implicit_derivatives(model, t, x0, self.directions, p, inputs)
        return _Start(last.options, replace(start, x0=found[0], parameters=p), found[1])

    def _compared(self, i: int, run: Trajectory) -> tuple[Floats, Floats]:
        """The weighted residuals of an experiment, and their Jacobian."""
        model, residuals, columns = self.model, [], []
        assert run.sensitivity is not None
        for name, values in self.measured[i].items():
            weight = self.weights[i][name]
            residuals.append((run[name] - values) * weight)
            if name in model.states:
                of, place = run.sensitivity, model.states.index(name)
            else:
                of, place = run.output_sensitivity, model.outputs.index(name)
            columns.append(np.array([of[own][place] for own in self.own]) * weight)
        return np.concatenate(residuals), np.hstack(columns).T


def _mapping(given: Any, what: str) -> Mapping[Any, Any]:
    if not is_mapping(given):
        raise ModelError(f"{what} must be a mapping from names, not {shown(given)}.")
    return given


def _number(name: str, value: Any, kind: str) -> float:
    if value is None:
        raise ModelError(f"The {kind} {name} has no value in the model: give a first guess, as in {{{name!r}: 1.0}}.")
    number = numbers(value, f"The first guess of {name}")
    if number.shape or not np.isfinite(number):
        raise ModelError(f"The first guess of {name} must be a finite number, not {shown(value)}.")
    return float(number)


def _measured(
    model: Kernel, i: int, experiment: Experiment, outputs: Sequence[Any] | None
) -> tuple[Floats, dict[str, Floats]]:
    """The times and the measurements to compare of an experiment, checked."""
    which = f"experiment {i + 1}"
    for part in ("coordinates", "speeds", "auxiliary_states", "parameters"):
        _mapping(getattr(experiment, part), f"The {part.replace('_', ' ')} of {which}")
    if experiment.inputs is not None:
        _mapping(experiment.inputs, f"The inputs of {which}")
    times = numbers(experiment.t, f"The times of {which}")
    if times.ndim != 1 or len(times) < 2 or not np.isfinite(times).all() or not (np.diff(times) > 0).all():
        raise ModelError(f"The times of {which} must be finite and increasing, and at least two.")
    if experiment.start is not None and (start := finite_number(experiment.start, f"start of {which}")) > times[0]:
        raise ModelError(f"The start of {which}, {start:g}, is after its first measurement, {times[0]:g}.")
    columns = _mapping(experiment.measured, f"The measurements of {which}")
    if outputs is not None:
        wanted, given = names_of(outputs, f"outputs {NAMES}"), {name_of(key): values for key, values in columns.items()}
        for name in wanted:
            if name not in given:
                raise ModelError(f"Nothing was measured of {name!r} in {which}.{meant(name, given)}")
        columns = {name: given[name] for name in wanted}
    columns = named(columns, (*model.states, *model.outputs), "state or output")
    if not columns:
        raise ModelError(f"In {which} nothing was measured: name states or outputs of the model.")
    found = {}
    for name, values in columns.items():
        column = numbers(values, f"The measurements of {name}")
        if column.shape != times.shape:
            raise ModelError(
                f"In {which} there are {len(times)} times, and measurements of {name} of shape {column.shape}."
            )
        if not np.isfinite(column).all():
            places = np.flatnonzero(~np.isfinite(column))
            raise ModelError(
                f"The measurement of {name} in {which} at t = {times[places[0]]:g} is {column[places[0]]} "
                f"({len(places)} of {len(times)} are not finite): leave such times out."
            )
        found[name] = column
    return times, found


def _bounds(problem: _Problem, bounds: Mapping[Any, tuple[float, float]] | None) -> tuple[Floats, Floats]:
    low, high = np.full(len(problem.guess), -math.inf), np.full(len(problem.guess), math.inf)
    if bounds is None:
        return low, high
    known = dict.fromkeys((*problem.names, *problem.own))
    for name, pair in named(_mapping(bounds, "bounds"), [*known], "unknown").items():
        ends = numbers(pair, f"The bounds of {name}")
        if ends.shape != (2,) or not ends[0] < ends[1]:
            raise ModelError(f"The bounds of {name} must be two increasing numbers, not {shown(pair)}.")
        for place, own in enumerate(problem.names):
            if own == name or own.rpartition(" (")[0] == name:
                low[place], high[place] = ends
                if not ends[0] <= problem.guess[place] <= ends[1]:
                    raise ModelError(
                        f"The first guess {own} = {problem.guess[place]:g} is outside of its bounds {ends.tolist()}."
                    )
    return low, high


def _covariance(
    problem: _Problem, estimate: Floats, slopes: Slopes | None, *, absolute: bool
) -> tuple[Floats, list[str]]:
    """The covariance (J^T J)^-1 s^2, and the unknowns that are not determined.

    Source: J. Nocedal, S. Wright, *Numerical Optimization*, 2nd ed., Springer 2006, chapter 10.
    """
    residuals, jacobian = problem.simulated(estimate)
    m, n = jacobian.shape
    size = np.linalg.norm(jacobian, axis=0)
    scale = np.where(size > 0.0, size, 1.0)
    _, singular, directions = np.linalg.svd(jacobian / scale, full_matrices=False)
    known = singular > RANK_RTOL * singular.max(initial=0.0)
    if slopes is not None:
        variance = _robust_variance(residuals, n, slopes)
    else:
        variance = 1.0 if absolute else float(residuals @ residuals) / (m - n) if m > n else math.inf
    inverse = (directions[known].T / singular[known] ** 2) @ directions[known]
    covariance = inverse / np.outer(scale, scale) * variance
    open_places = np.flatnonzero((np.abs(directions[~known]) > 1e-6).any(axis=0))
    covariance[open_places, :] = covariance[:, open_places] = math.inf
    return covariance, [problem.names[place] for place in open_places]


def _robust_variance(residuals: Floats, n: int, slopes: Slopes) -> float:
    """The variance s^2 of n estimates by a loss rho(f^2) of residuals f.

    With psi = rho' f, and psi' = rho' + 2 rho'' f^2, whose mean is a and variance v:
    s^2 = (1 + n v / (m a^2))^2 (sum psi^2 / (m - n)) / a^2.

    Source: P. J. Huber, *Robust Statistics*, Wiley 1981, section 7.6.
    """
    m, z = len(residuals), residuals**2
    first, second = slopes(z)
    psi, curvature = first * residuals, first + 2.0 * second * z
    mean = float(curvature.mean())
    if m <= n or mean <= 0.0:
        return math.inf
    return float((1.0 + n * curvature.var() / (m * mean**2)) ** 2 * (psi @ psi) / ((m - n) * mean**2))
