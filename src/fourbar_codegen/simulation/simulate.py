"""Simulation: makes a right-hand side of the options and passes it to an integrator."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state
from fourbar_codegen.errors import ModelError, ModelWarning
from fourbar_codegen.interface.arguments import Values, finite_number, name_of, named_array
from fourbar_codegen.interface.progress import QUIET_SECONDS, Progress
from fourbar_codegen.interface.registered import RegisteredAttribute
from fourbar_codegen.kernel.consistency import check_start, consistent, projects
from fourbar_codegen.kernel.discontinuities import boundaries, jumping_inputs
from fourbar_codegen.kernel.inputs import InputSource, bind
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.kernel.sensitivity import (
    Directions,
    directions_of,
    implicit_derivatives,
    locked_parameters,
    require_derivatives,
    require_fixed_breakpoints,
)
from fourbar_codegen.layout import StateJump
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import STIFF
from fourbar_codegen.runtime.integrator import Stepper
from fourbar_codegen.simulation.events import EventLike, event_rows, events_of
from fourbar_codegen.simulation.integrate import integrate
from fourbar_codegen.simulation.methods import FIXED_STEP, MethodLike, name_alone
from fourbar_codegen.simulation.run_options import RunOptions, RunStart

__all__ = ["Runner", "run", "runner", "simulate", "stepper"]

Floats = NDArray[np.float64]

STEPPERS = ("RK4", STIFF)
"""Methods of steppers."""


def simulate(
    model: Kernel,
    t_span: Sequence[float],
    x0: ArrayLike | None = None,
    *,
    method: MethodLike = "DOP853",
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
    t_eval: ArrayLike | None = None,
    rtol: float | None = None,
    atol: float | ArrayLike | None = None,
    events: EventLike | Sequence[EventLike] | None = None,
    constraints: str = "project",
    stabilization: float = 10.0,
    dense_output: bool = False,
    max_step: float | None = None,
    max_steps: int | Literal["auto"] | None = "auto",
    formulation: str | None = None,
    progress: Callable[[float], object] | Literal[False] | None = None,
    sensitivities: Any = (),
    dx0: Mapping[Any, ArrayLike] | None = None,
    gradient: bool = False,
) -> Trajectory:
    """Integrate the equations of motion and keep the loops closed.

    Parameters
    ----------
    t_span : (float, float)
        First and last time, s.
    x0 : array_like, shape (n_x,), optional
        Initial state, which must satisfy the constraints (see `initial_state`); by default the one that
        `initial_state` returns for the model's initial values.
    method : {"DOP853", "RK45", "Tsit5", "Radau", "ALI3P", "CVODE", "IDA"}, or an object of these names, optional
        A name, or an object with the method's own options, such as ``fb.DOP853(max_step=0.01)``,
        ``fb.ALI3P(step=1e-3)`` or ``fb.IDA(formulation="index-1")``; an option given there and here is an error.
        DOP853, RK45 and Tsit5 are explicit and run in C, with the step size control of SciPy, and its coefficients
        for the first two. Tsit5, of order 5 like RK45, has smaller error coefficients. Source: Ch. Tsitouras,
        "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption", *Computers &
        Mathematics with Applications* 62 (2011). ALI3P passes singular positions: an augmented Lagrangian
        formulation of index 3 with the trapezoidal rule and projections. It runs in C with steps of fixed length, and
        shorter ones if their equations cannot be solved. At a singular position it follows the branch on which the
        velocities are continuous, since inertia does not let them jump. Radau, for stiff equations, is Radau IIA of
        order 5 in C, with a Jacobian of each step: the compiled one, or difference quotients where callables or a
        stabilization are in the equations. Source: E. Hairer, G. Wanner, *Solving Ordinary Differential Equations
        II*, 2nd ed. 1996, section IV.8. CVODE (BDF, for stiff problems) and IDA (a differential-algebraic solver)
        are SUNDIALS', through scikit-sundae (``pip install 'fourbar_codegen[dae]'``), with compiled functions.
        SciPy's methods take `ode`: ``solve_ivp(ode, t_span, x0, method="LSODA", jac=ode.jac)``.
    parameters : array_like or mapping, optional
        The defaults otherwise.
    inputs : mapping of input to source, optional
        For each input a number, a table ``(times, values)`` or ``(times, values, kind)``, which is held constant
        outside its range, or a callable of (t, x); by default its expression. The kind is "linear", "pchip"
        (monotone cubic, without overshoot), "cubic" (cubic spline) or "hold" (zero-order hold: value i holds from
        times[i], included, until times[i + 1]). The default is "linear"; for prescribed motions, whose rates are
        needed, it is "cubic", and "hold" and callables are refused.
    t_eval : array_like, optional
        Times at which to store the state. If a terminal event ends the run, the state there follows as the last
        one; costs of gradients refer to those before it.
    rtol, atol : float, optional
        Relative and absolute tolerance of a step, by default 1e-6 and 1e-9; ALI3P has none.
    events : sequence, or one of its entries, optional
        Names of scalar quantities, such as states and outputs; callables of (t, x) as for ``solve_ivp``, with
        attributes ``terminal`` and ``direction``; or `Event` objects. All changes of sign within a step are found.
        Quantities are evaluated in C; callables are called at nine or more places of each step.
    constraints : {"project", "baumgarte", "none"}, optional
        Constraint stabilization. "project": mass-orthogonal projection of positions and then of speeds after each
        accepted step, and of every returned state. CVODE and IDA are multistep methods: of them, only the returned
        states are projected. "baumgarte": the accelerations make violations decay; the remaining violation is what
        the integration error adds within 1 / `stabilization`. "none": only the accelerations satisfy the
        constraints, and the integration error makes the loops drift open.
    stabilization : float, optional
        The rate a, 1/s, at which violations decay with "baumgarte": Phi'' + 2 a Phi' + a^2 Phi = 0. Rates above
        1 / (step size) make the equations stiff. Source: J. Baumgarte, "Stabilization of constraints and integrals
        of motion in dynamical systems", *Computer Methods in Applied Mechanics and Engineering* 1 (1972).
    dense_output : bool, optional
        Whether to keep an interpolant as ``trajectory.sol``.
    max_step : float, optional
        The longest step, s; by default there is no limit. It must exceed the rounding error of the simulated time. For
        ALI3P it is the step, another spelling of ``fb.ALI3P(step=...)``.
    max_steps : int, "auto" or None, optional
        The largest number of steps; a run ends after them, with the states up to there. None is no limit. By
        default 1,000,000 for the methods of `ensemble`, and 100,000 for the others, or ten times the
        number that `max_step` requires, if that is more.
    formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
        Of IDA: another spelling of ``fb.IDA(formulation=...)``.
    progress : callable or False, optional
        A callable is called with the time reached, some times per second. By default, a run that takes longer than
        a second reports its progress on stderr: in one line that is removed at the end on a terminal, otherwise in
        one line every 30 s. False turns this off.
    sensitivities : sequence of str or symbols, optional
        Parameters; independent coordinates, speeds and auxiliary states, at the beginning; and inputs given as
        numbers or tables, with respect to whose values the states are differentiated: ``trajectory.sensitivity``,
        and ``trajectory.sol.sensitivity(t)`` with `dense_output`. The steps, of the explicit methods in C, are
        differentiated as they are taken, with their lengths held. Errors of derivatives limit these as those of
        states do, with ten times the relative tolerances; `atol` counts only for rounding errors. After each
        projection they are moved onto the constraints' tangent; what that leaves out is proportional to the
        correction of the state, and below `rtol`. Without `x0`, dependent initial values follow from loop closure;
        a given `x0` depends on no parameter and no input, except for what keeps it on the constraints. Where forces
        jump at times that are not known beforehand, as with the state, the change of the time of the jump is left
        out, with a warning. Times of events by name are differentiated: ``trajectory.event_sensitivity``.
        Source: H. G. Bock, "Numerical treatment of inverse problems in chemical reaction kinetics", in *Modelling
        of Chemical Reaction Systems* (1981): internal numerical differentiation.
    dx0 : mapping from some of these names to arrays of shape (n_x,), or (n, n_x) for n values of a table, optional
        The derivatives of a given `x0`, such as those of `initial_state`; with `gradient` by any of these names.
    gradient : bool, optional
        Whether to keep the steps for `Trajectory.gradient`: 8 (n_x + 2) bytes each. For DOP853, RK45 and Tsit5.
        Their lengths are limited by errors of derivatives along arbitrary directions of initial states, parameters
        and inputs.

    Returns
    -------
    Trajectory
        If the integrator could not finish, for instance at a singular position, where the Jacobian of the
        constraints loses rank, ``success`` is False and ``message`` gives the reason. The message also warns if the
        energy has grown suspiciously: if the final kinetic energy is a thousand times both the largest kinetic
        energy of the stored states in the first half of the run and the range of the potential energy. (A constant
        force causes a factor of four.)

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite; or if there are no sensitivities: with other
        methods, callable inputs, dependent values, or parameters on which times of jumps depend.
    AssemblyError
        If `x0` is left out and the loops do not close; or if redundant constraints would be violated by a change of
        one of the parameters in `sensitivities`.
    SimulationError
        If the equations cannot be evaluated at the initial state.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> trajectory = fb.load("four_bar").simulate((0.0, 4.0), inputs={"F": 0.0}, rtol=1e-8, atol=1e-8)
    >>> bool(abs(trajectory.constraint_residual).max() < 1e-12)
    True
    >>> run = fb.load("four_bar").simulate((0.0, 1.0), t_eval=[0.0, 1.0], sensitivities=["k", "l2"])
    >>> d_length = run.sensitivity["l2"]
    >>> d_length.shape, d_length[1, 0].round(2).item()  # dq2/dl2 of the closed loop
    ((6, 2), -0.83)
    """
    options = RunOptions.of(
        model, t_span, method=method, t_eval=t_eval, rtol=rtol, atol=atol, events=events, constraints=constraints,
        stabilization=stabilization, dense_output=dense_output, max_step=max_step, max_steps=max_steps,
        formulation=formulation, progress=progress, sensitivities=sensitivities, gradient=gradient,
    )  # fmt: skip
    return run(model, options, RunStart.of(model, options, x0, parameters, inputs, dx0))


@dataclass(frozen=True, repr=False)
class Runner:
    """Runs with the same options, which are checked once; made by `CompiledModel.runner`.

    A call takes as long as the run itself; `CompiledModel.simulate` some microseconds more.
    """

    kernel: Kernel
    options: RunOptions

    model = RegisteredAttribute()

    def __repr__(self) -> str:
        begin, end = self.options.t_span
        return f"<Runner of {self.kernel.name}: {self.options.method}, {begin:g} s to {end:g} s>"

    def __call__(
        self,
        x0: ArrayLike | None = None,
        *,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        dx0: Mapping[Any, ArrayLike] | None = None,
    ) -> Trajectory:
        """A run; arguments, result and errors are those of `CompiledModel.simulate`."""
        return run(self.kernel, self.options, RunStart.of(self.kernel, self.options, x0, parameters, inputs, dx0))


def runner(
    model: Kernel,
    t_span: Sequence[float],
    *,
    method: MethodLike = "DOP853",
    t_eval: ArrayLike | None = None,
    rtol: float | None = None,
    atol: float | ArrayLike | None = None,
    events: EventLike | Sequence[EventLike] | None = None,
    constraints: str = "project",
    stabilization: float = 10.0,
    dense_output: bool = False,
    max_step: float | None = None,
    max_steps: int | Literal["auto"] | None = "auto",
    progress: Callable[[float], object] | Literal[False] | None = None,
    sensitivities: Any = (),
    gradient: bool = False,
) -> Runner:
    """A function that simulates with options that are checked once: the fastest way to many runs, one after another.

    Parameters
    ----------
    t_span, method, t_eval, rtol, atol, events, constraints, stabilization, dense_output, max_step, max_steps
        As for `simulate`.
    progress, sensitivities, gradient
        As for `simulate`.

    Returns
    -------
    Runner
        Called with ``(x0, parameters=..., inputs=..., dx0=...)``, as for `simulate`, it returns a `Trajectory`.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> run = four_bar.runner((0.0, 1.0), rtol=1e-8, progress=False)
    >>> [round(float(run(parameters={"k": k})["q1"][-1]), 3) for k in (50.0, 100.0, 150.0)]
    [-1.575, -1.422, -1.166]
    """
    options = RunOptions.of(
        model, t_span, method=method, t_eval=t_eval, rtol=rtol, atol=atol, events=events, constraints=constraints,
        stabilization=stabilization, dense_output=dense_output, max_step=max_step, max_steps=max_steps,
        progress=progress, sensitivities=sensitivities, gradient=gradient,
    )  # fmt: skip
    return Runner(model, options)


def run(model: Kernel, options: RunOptions, start: RunStart, directions: Directions | None = None) -> Trajectory:
    """Integrate the equations of motion; see `simulate`.

    Directions are those of the sensitivities at the beginning, if they are known.
    """
    if options.method == FIXED_STEP and model.n_l > model.n_c:
        names = ", ".join(model.outputs[: model.n_l - model.n_c])
        raise ModelError(
            f"{FIXED_STEP} does not support unknown forces that drive the motion ({names}): all other methods do."
        )
    (begin, end), p, inputs, report = options.t_span, start.parameters, start.inputs, options.progress
    state = initial_state(model, t=begin, parameters=p, inputs=inputs) if start.x0 is None else start.x0
    ode = bind(model, p, inputs)
    if options.stabilization is not None:
        ode.stabilization = options.stabilization
    check_start(model, ode, begin, state, p, passes=options.method == FIXED_STEP)
    if options.sensitivities or options.gradient:
        _check_differentiable(model, options, start.parameters, start.inputs or {})
    if options.sensitivities and directions is None:
        directions = _directions(model, options, start, state)
    if report is not None:
        told = None if report is False else report
        found = integrate(model, ode, state, options, start, progress=told, directions=directions)
    else:
        with Progress(model.name, unwatched=QUIET_SECONDS) as progress:

            def show(t: float) -> None:
                progress.stage(f"simulating, t = {t:.6g} of {end:g} s")

            found = integrate(model, ode, state, options, start, progress=show, directions=directions)
    if directions is not None:
        states = [(begin, state), *zip(found.t[-1:].tolist(), found.y[:, -1:].T, strict=True)]
        locked = locked_parameters(model, states, p, inputs)
        require_derivatives([name for name in directions.names if name in locked])
    return found


def _check_differentiable(
    model: Kernel, options: RunOptions, parameters: Floats | None, inputs: Mapping[Any, Any]
) -> None:
    jumps = _state_jumps(model, parameters, inputs) if model.layout.breakpoints.state_jumps else []
    for sentence, is_known in (
        ("jump at times that are not known beforehand ({})", True),
        ("may jump ({}): where they might, they have no real value at any of the random states that were tried", False),
    ):
        functions = "; ".join(entry.function for entry in jumps if entry.known is is_known)
        if functions:
            warnings.warn(
                f"The equations of {model.name} {sentence.format(functions)}. If the run passes a jump, its "
                "derivatives leave out the change of the time of the jump: make forces continuous, for instance by "
                "tanh instead of sign.",
                ModelWarning,
                stacklevel=4,
            )
    known = (*model.states, *model.outputs)
    if options.sensitivities and not all(event.function in known for event in options.events or ()):
        raise ModelError(
            "Times of events have derivatives if these are of states or outputs: make the function an output of the "
            "model."
        )
    for key, source in inputs.items():
        if callable(source):
            raise ModelError(f"Input {name_of(key)} is a callable, whose derivatives are not known: use a table.")


def _state_jumps(model: Kernel, parameters: Floats | None, inputs: Mapping[Any, Any]) -> list[StateJump]:
    """The jumps that count with these parameters and inputs."""
    given, defaults = {name_of(key) for key in inputs}, parameter_array(model, None)
    has_others = parameters is not None and not np.array_equal(parameters, defaults, equal_nan=True)
    return [
        entry
        for entry in model.layout.breakpoints.state_jumps
        if entry.input not in given and (entry.by_default or has_others)
    ]


def _directions(model: Kernel, options: RunOptions, start: RunStart, state: Floats) -> Directions:
    """The directions of sensitivities at the beginning."""
    found = directions_of(model, options.sensitivities, start.inputs)
    require_fixed_breakpoints(model, start.parameters, [n for n in found.names if n in model.parameters])
    # Parameters and inputs do not move a given initial state, except onto the constraints.
    held = np.zeros(found.matrix.shape[1], dtype=bool)
    if start.x0 is not None:
        held[:] = ~found.matrix[: model.n_x].any(axis=0)
    for name in start.dx0:
        held[found.places[name]] = True
    matrix = found.matrix.copy()
    if not held.all():
        matrix[:, ~held] = implicit_derivatives(model, options.t_span[0], state, found, start.parameters, start.inputs)[
            :, ~held
        ]
    for name, derivative in start.dx0.items():
        matrix[: model.n_x, found.places[name]] = derivative.T
    return Directions(found.places, matrix, found.sources)


def stepper(
    model: Kernel,
    h: float,
    x0: ArrayLike | None = None,
    *,
    t: float = 0.0,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
    events: EventLike | Sequence[EventLike] | None = None,
    constraints: str = "project",
    method: MethodLike = "RK4",
) -> Stepper:
    """A stepper with a fixed step size, for control loops and real time.

    Parameters
    ----------
    h : float
        The step size, s.
    x0 : array_like, shape (n_x,), optional
        Initial state; by default the one that `initial_state` returns for the model's initial values.
    t : float, optional
        Initial time, s.
    parameters : array_like or mapping, optional
        The defaults otherwise.
    inputs : mapping, optional
        As for `simulate`; ``step(r)`` holds those that it names for a step. A step in which a force jumps, or a
        table has a point, is made of several that end there.
    events : Event, str, callable, or a list of these, optional
        As for `simulate`: all roots of each step, at whose beginning inputs may jump. A step ends at a terminal
        event, and the run with it.
    constraints : {"project", "none"}, optional
        As for `simulate`.
    method : {"RK4", "Radau"}, optional
        The classical Runge-Kutta method of order 4, or Radau IIA of order 5 for stiff equations. A step of Radau
        whose equations have no solution is made of shorter ones.

    Returns
    -------
    Stepper
        With the method ``step(r)`` and the attributes ``t`` and ``x``; ``t_events`` and ``y_events`` are the times
        and states of the events within the last step, and ``status`` is 1 once a terminal one has ended the run.
        Each thread needs its own.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite.
    AssemblyError
        If `x0` is left out and the loops do not close.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> stepper = fb.load("four_bar").stepper(1e-3)
    >>> for _ in range(100):
    ...     x = stepper.step({"F": -20.0 * stepper.x[3]})
    >>> round(stepper.t, 9), x.shape
    (0.1, (6,))
    """
    h, t = finite_number(h, "h"), finite_number(t, "t")
    if h == 0.0:
        raise ModelError("The step h must not be 0.")
    method = name_alone(method, STEPPERS, "method")
    watched = event_rows(model, events_of(model, events) or ())
    closes = projects(model, constraints)
    p = model.parameter_vector(parameters)
    if x0 is None:
        state = initial_state(model, t=t, parameters=p, inputs=inputs)
    else:
        state = named_array(x0, model.states, {}, "state")
    ode = bind(model, p, inputs)
    check_start(model, ode, t, state, p)
    start = consistent(ode, t, state) if closes else state
    jumps, kinks = boundaries(ode, t, math.copysign(math.inf, h), start)
    jumping = [(at.end, at.begin, jumping_inputs(ode, at, start)) for at in jumps]
    breakpoints = np.array([(at.end, at.last, at.first) for at in kinks]).reshape(-1, 3).T
    return Stepper(ode, h, t, start, closes, jumps=jumping, breakpoints=breakpoints, events=watched, method=method)
