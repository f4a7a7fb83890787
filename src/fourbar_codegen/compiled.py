"""CompiledModel: a kernel, and all that can be done with it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.loading import load_named
from fourbar_codegen.runtime.integrator import Ode, Stepper
from fourbar_codegen.simulation.options import RunOptions
from fourbar_codegen.simulation.simulate import make_stepper, simulate

if TYPE_CHECKING:
    from fourbar_codegen.analysis.assembly_modes import AssemblyModes
    from fourbar_codegen.kernel.inputs import InputSource
    from fourbar_codegen.results.ensemble import Ensemble
    from fourbar_codegen.results.trajectory import Trajectory
    from fourbar_codegen.simulation.events import EventLike

__all__ = ["CompiledModel", "load", "load_trajectory"]

Floats = NDArray[np.float64]


def load(name: str | Path) -> CompiledModel:
    """Load a model that is compiled already; neither SymPy nor a compiler is needed.

    (For a library of `compile_model`, in the cache, a compiler is needed once more by its first Jacobian or picture,
    and by its first batch or ensemble.)

    Parameters
    ----------
    name : str or Path
        The name of a model that comes with the package, ``"four_bar"``, or that was installed from a wheel
        of `build_wheel` (not what lies in the current folder); or the path of an extension module that
        ``fourbar build`` or `build_model` made, or of a library of `compile_model`. Of an installed package, nothing
        runs that does not say in its manifest.json that it is that model.

    Returns
    -------
    CompiledModel

    Raises
    ------
    ModelError
        If there is no such model, or the file is not a compiled model.

    Examples
    --------
    >>> load("four_bar").coordinates
    ('q1', 'q2', 'q3')
    """
    return CompiledModel.from_loaded(load_named(name))


def load_trajectory(path: str | Path, model: CompiledModel | None = None) -> Trajectory:
    """Read a trajectory from a file that `Trajectory.save` has written.

    Parameters
    ----------
    path : str or Path
        A ``.nc`` or ``.npz`` file.
    model : CompiledModel, optional
        The model that was run. Without it, the one of the name and fingerprint that the file has: among those that come
        with the package, that were installed from wheels, or that `compile_model` left in the cache on this machine.

    Returns
    -------
    Trajectory
        Without interpolant and events, which are not saved.

    Raises
    ------
    ModelError
        If the file cannot be read, is none of these, the run was another model's, or that model is not found.

    Notes
    -----
    Files may come from anywhere: they say which model was run, and never where it lies. A package is imported if its
    own manifest.json has the name and fingerprint, and the cache is asked by a key that is made of them.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> path = run.save("run.npz")  # doctest: +SKIP
    >>> fb.load_trajectory(path).y.shape == run.y.shape  # doctest: +SKIP
    True
    """
    if not (model is None or isinstance(model, CompiledModel)):
        raise ModelError(f"model must be a CompiledModel or None, not {model!r}.")
    from fourbar_codegen.presentation.storage import read_trajectory

    return read_trajectory(path, model, CompiledModel.find)


class CompiledModel(Kernel):
    """A mechanism's equations of motion, compiled.

    Made by `compile_model` and `load`. Arguments stand in the order (t, x, p, r): time, state x = [q; u; z],
    parameters, inputs. Parameters and inputs are arrays in order, or mappings from names or SymPy symbols
    that may leave out what has a default. Several threads may use one model at the same time.

    Attributes
    ----------
    name : str
    coordinates, speeds : tuple of str
        Generalized coordinates and speeds, the independent ones first.
    auxiliary_states : tuple of str
        The states that have equations of their own.
    states : tuple of str
        All of these.
    parameters, inputs, outputs : tuple of str
    points : tuple of str
        The points that are drawn: those whose positions the System gives, as its own points are called.
    forced_points : tuple of str
        Those of them on which forces act that depend on inputs.
    defaults : dict of str to float or None
        Parameter values; None where every call has to give one.
    units, descriptions : dict of str to str
        Of the parameters.
    path : Path
        The extension module, or the library that `compile_model` made; `load` takes it.
    manifest : dict
        All that is known of the model, as in the manifest.json beside the generated sources.
    n_q, n_u, n_z, n_x, n_p, n_r : int
        Numbers of coordinates, speeds, auxiliary states, states, parameters and inputs.
    n_h, n_c, n_o : int
        Numbers of position constraints, of velocity constraints, and of outputs.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> trajectory = four_bar.simulate((0.0, 1.0))
    >>> trajectory.success
    True
    """

    def _repr_html_(self) -> str:
        from fourbar_codegen.tables import names_table

        return names_table(
            f"Compiled model {self.name}: {self.n_h} constraints on positions, {self.n_c} on velocities",
            [
                ("coordinate", self.coordinates, self.manifest["n_dependent_coordinates"]),
                ("speed", self.speeds, self.manifest["n_dependent_speeds"]),
                ("auxiliary state", self.auxiliary_states, 0),
            ],
            {name: (value, self.units[name], self.descriptions[name]) for name, value in self.defaults.items()},
            {entry["name"]: entry["expression"] for entry in self.manifest["inputs"]},
            self.outputs,
        )

    @overload
    def linearize(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None, *, outputs: None = None
    ) -> tuple[Floats, Floats]: ...

    @overload
    def linearize(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None, *, outputs: Sequence[Any]
    ) -> tuple[Floats, Floats, Floats, Floats]: ...

    def linearize(
        self,
        t: float,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        outputs: Sequence[Any] | None = None,
    ) -> tuple[Floats, ...]:
        """A and B of d(q_i, u_i, z)/dt = A d(q_i, u_i, z) + B dr near a state that satisfies the constraints.

        In the independent coordinates q_i and speeds u_i, as ``KanesMethod.linearize(A_and_B=True)``: the
        dependent ones follow the constraints to first order, also where inputs stand in these. And C and D of
        dy = C d(q_i, u_i, z) + D dr, if outputs y are given.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.
        outputs : sequence of str, optional
            Names of outputs; ``model.outputs`` for all.

        Returns
        -------
        A : ndarray, shape (n_i, n_i)
            n_i is the number of independent coordinates, independent speeds and auxiliary states.
        B : ndarray, shape (n_i, n_r)
        C : ndarray, shape (len(outputs), n_i)
            C and D are there where outputs are given.
        D : ndarray, shape (len(outputs), n_r)

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite, or the state violates the constraints; or
            redundant constraints leave the derivatives of outputs open.
        SimulationError
            If the dependent coordinates or speeds do not follow from the independent ones at this state.

        Source: D. L. Peterson, G. Gede, M. Hubbard, "Symbolic linearization of equations of motion of
        constrained multibody systems", *Multibody System Dynamics* 33 (2015).

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> A, B = four_bar.linearize(0.0, four_bar.initial_state())
        >>> A.shape, B.shape
        ((2, 2), (2, 1))
        """
        from fourbar_codegen.analysis.linearization import linearize

        return linearize(self, t, x, p, r, outputs)

    def equilibrium(
        self,
        guess: Values | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
    ) -> Floats:
        """A state of rest in which the mechanism stays.

        Found by SciPy's ``least_squares`` on constraints and accelerations with compiled Jacobians. It may be
        stable or not: the eigenvalues of `linearize` tell.

        Parameters
        ----------
        guess : array_like, shape (n_q,), or mapping, optional
            Coordinates at which to begin; the model's initial values, or 0, where left out.
        t : float, optional
            Time, s, at which inputs are taken.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`, but no callables.

        Returns
        -------
        ndarray, shape (n_x,)
            The coordinates, and speeds of 0.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        SimulationError
            If no equilibrium was found; with where the search ended.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 0.0})
        >>> bool(abs(four_bar.rhs(0.0, x, r={"F": 0.0})).max() < 1e-9)
        True
        """
        from fourbar_codegen.analysis.equilibrium import equilibrium

        return equilibrium(self, guess, t=t, parameters=parameters, inputs=inputs)

    def initial_state(
        self,
        coordinates: Values | None = None,
        speeds: Values | None = None,
        *,
        t: float = 0.0,
        guess: Values | None = None,
        bounds: Mapping[Any, tuple[float, float]] | None = None,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        auxiliary_states: Values | None = None,
    ) -> Floats:
        """A state that satisfies all constraints, from the independent coordinates and speeds.

        The dependent coordinates are found by Newton's method where each of its steps halves the residual at least,
        otherwise by SciPy's ``fsolve``, on the position constraints with their Jacobian; or loop by loop, each by
        damped least squares. The dependent speeds follow from the velocity constraints, which are linear in them.

        Parameters
        ----------
        coordinates, speeds : array_like or mapping, optional
            Values of the independent ones; the model's initial values where left out.
        t : float, optional
            Time, s.
        guess : array_like or mapping, optional
            Where to start the search for the dependent coordinates; it decides which of several ways to close the
            loops is found. Without it, the model's guess, or 0, and if loops do not close from there, others about it:
            each loop in the way that is nearest.
        bounds : mapping, optional
            The range of dependent coordinates, (low, high), such as that of a knee; any value otherwise.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`; those count that prescribe a motion.
        auxiliary_states : array_like or mapping, optional
            Their values; the model's initial values where left out.

        Returns
        -------
        ndarray, shape (n_x,)

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If the loops do not close, or the dependent speeds are not determined.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> x0 = fb.load("four_bar").initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
        >>> x0.round(6).tolist()
        [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
        """
        from fourbar_codegen.analysis.initial_state import initial_state

        return initial_state(
            self,
            coordinates,
            speeds,
            t=t,
            guess=guess,
            bounds=bounds,
            parameters=parameters,
            inputs=inputs,
            auxiliary_states=auxiliary_states,
        )

    def initial_states(
        self,
        coordinates: Values | None = None,
        speeds: Values | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        auxiliary_states: Values | None = None,
    ) -> AssemblyModes:
        """The assembly modes: all states that satisfy the constraints with these independent coordinates and speeds.

        They are complete where the loops are those of dyads, one after another: constraints, one or two at a time, in
        no more unknown coordinates, that are trigonometric in angles and polynomial in displacements. So are the
        four-bar linkage, the slider-crank, and chains of them. Other loops are searched from many starting points, and
        the number of modes is a lower bound. See `fourbar_codegen.analysis.assembly_modes` for the method.

        Parameters
        ----------
        coordinates, speeds, t, parameters, inputs, auxiliary_states
            As for `initial_state`.

        Returns
        -------
        AssemblyModes
            A sequence of states, empty if the loops cannot be closed; with ``is_complete``, and ``plot()``.

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
        from fourbar_codegen.analysis.initial_state import initial_states

        return initial_states(
            self,
            coordinates,
            speeds,
            t=t,
            parameters=parameters,
            inputs=inputs,
            auxiliary_states=auxiliary_states,
        )

    def ode(self, parameters: Values | None = None, inputs: Mapping[Any, InputSource] | None = None) -> Ode:
        """The right-hand side as a callable f(t, x), for `scipy.integrate.solve_ivp` and its like.

        Parameters
        ----------
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`.

        Returns
        -------
        Ode
            Callable, with its Jacobian as ``.jac``. The integrators in `fourbar_codegen.solvers` call it from C.
            Several threads may use one at the same time.

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
        from fourbar_codegen.kernel.inputs import bind

        return bind(self, parameters, inputs)

    def simulate(
        self,
        t_span: Sequence[float],
        x0: ArrayLike | None = None,
        *,
        method: str = "DOP853",
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        t_eval: ArrayLike | None = None,
        rtol: float = 1e-6,
        atol: float | ArrayLike = 1e-9,
        events: EventLike | Sequence[EventLike] | None = None,
        constraints: str = "project",
        stabilization: float = 10.0,
        dense_output: bool = False,
        max_step: float = math.inf,
        max_steps: int | Literal["auto"] | None = "auto",
        formulation: str | None = None,
        progress: Callable[[float], object] | Literal[False] | None = None,
    ) -> Trajectory:
        """Integrate the equations of motion, with the loops closed.

        Parameters
        ----------
        t_span : (float, float)
            First and last time, s.
        x0 : array_like, shape (n_x,), optional
            Initial state, taken as it is (`initial_state` makes consistent ones); the one that follows from
            the model's initial values otherwise.
        method : {"DOP853", "RK45", "ALI3P", "RK23", "Radau", "BDF", "LSODA", "CVODE", "IDA"}, optional
            The first two run in C, with the coefficients and the step control of SciPy's. ALI3P passes singular
            positions: an augmented Lagrangian of index 3, by the trapezoidal rule, with projections; it runs in C and
            takes steps of `max_step`, shorter ones where their equations cannot be solved. At a singular position,
            where a mechanism may go on in more than one way, it takes the one on which its velocities are continuous,
            since inertia does not let them jump. The next are SciPy's by `fourbar_codegen.solvers`: of RK23 the steps
            are in C, the implicit ones are given the compiled Jacobian. CVODE, for what is stiff, and IDA, which keeps
            the constraints as equations, are SUNDIALS' by scikit-sundae (``pip install 'fourbar_codegen[dae]'``), with
            compiled functions.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping of input to source, optional
            For each input a number, a table ``(times, values)`` or ``(times, values, kind)``, held constant beyond its
            ends, or a callable of (t, x); its expression otherwise. The kinds are "linear", "pchip" and "cubic":
            lines, monotone cubics, which do not overshoot, and a cubic spline. By default it is the first, and the last
            where an input prescribes a motion and its rates are needed; a callable is refused there.
        t_eval : array_like, optional
            Times at which to store the state.
        rtol, atol : float, optional
            Relative and absolute tolerance of the integrator; ALI3P has none.
        events : sequence, or one of its entries, optional
            Names of outputs, callables of (t, x) as for ``solve_ivp``, with attributes ``terminal`` and ``direction``,
            or `Event` objects, which have these. Each change of sign is located on the interpolant. Outputs are
            evaluated in C; callables after each step.
        constraints : {"project", "baumgarte", "none"}, optional
            How to keep the loops closed. With "project", the positions and then the speeds are moved onto the
            constraints after each accepted step, by the change that is least in the metric of the mass matrix; so is
            every state that is handed out. With "baumgarte", the
            accelerations are such that violations decay, and these stay as large as what an integrator's error adds
            within 1 / `stabilization`. With "none", only the accelerations satisfy the constraints, and the loops
            drift open by the integrator's error. LSODA, CVODE and IDA have a history of their own, so that only the
            states that they hand out are moved.
        stabilization : float, optional
            The rate a, 1/s, at which "baumgarte" lets violations decay: Phi'' + 2 a Phi' + a^2 Phi = 0. Rates beyond
            one by the step make the equations stiff. Source: J. Baumgarte, "Stabilization of constraints and integrals
            of motion in dynamical systems", *Computer Methods in Applied Mechanics and Engineering* 1 (1972).
        dense_output : bool, optional
            Whether to keep an interpolant as ``trajectory.sol``.
        max_step : float, optional
            The longest step, s; ALI3P needs it. One that is lost in the rounding of the run's length is refused.
        max_steps : int, "auto" or None, optional
            The most steps: a run that has taken them ends there, with what it has. None is no limit. By default
            1,000,000 of the methods in C (DOP853, RK45, ALI3P) and 100,000 of the others, or ten times those that
            `max_step` asks for, where that is more.
        formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
            For IDA, the first one if left out: whether positions and velocities satisfy the constraints in each step;
            or accelerations alone, so that the loops drift open; or positions alone, with only the coordinates under
            the step control. See `fourbar_codegen.solvers.IDA`.
        progress : callable or False, optional
            A callable is called with the time reached, some times a second. Without one, a run that takes longer than a
            second says on stderr how far it is: on a terminal in a line that vanishes, elsewhere in a line a second,
            after a minute in fewer. False is silence.

        Returns
        -------
        Trajectory
            With ``success`` False and a sentence in ``message`` if the integrator could not finish: for instance at a
            singular position, where the constraints' Jacobian loses rank. Another sentence says from what to what the
            energy has grown, where it ends with a thousand times the largest kinetic energy of the states that are
            stored of the run's first half, and the range of its potential energy; a constant force makes four times.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If `x0` is left out and the loops do not close.
        SimulationError
            If the equations cannot be evaluated at the initial state.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> trajectory = fb.load("four_bar").simulate((0.0, 4.0), inputs={"F": 0.0}, rtol=1e-8, atol=1e-8)
        >>> bool(abs(trajectory.constraint_residual).max() < 1e-12)
        True
        """
        options = RunOptions.of(
            self, t_span=t_span, x0=x0, method=method, parameters=parameters, inputs=inputs, t_eval=t_eval, rtol=rtol,
            atol=atol, events=events, constraints=constraints, stabilization=stabilization, dense_output=dense_output,
            max_step=max_step, max_steps=max_steps, formulation=formulation, progress=progress,
        )  # fmt: skip
        return simulate(self, options)

    def rhs_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        out: Floats | None = None,
        workers: int | None = 1,
    ) -> Floats:
        """The right-hand side x' = f(t, x) at many states, side by side in vectors.

        Parameters
        ----------
        t : float or array_like, shape (n,)
        x : array_like, shape (n_x, n)
            States in columns; or a mapping from names to arrays.
        p : array_like, shape (n_p,) or (n_p, n), or mapping to numbers or arrays of length n, optional
            Parameters; the defaults otherwise.
        r : array_like, shape (n_r,) or (n_r, n), or mapping, optional
            Inputs; their expressions otherwise.
        out : ndarray, shape (n_x, n), optional
            Where the results come, contiguous, without memory shared with the arguments; a fresh array otherwise.
        workers : int or None, optional
            Number of threads; None for one on each core.

        Returns
        -------
        ndarray, shape (n_x, n)
            x', NaN in the columns of states at which the equations cannot be evaluated. A state's rates are the same
            to the bit whatever stands beside it.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name.

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
        >>> four_bar.rhs_batch(0.0, states, {"k": np.linspace(1.0, 5.0, 1000)}).shape
        (6, 1000)
        """
        from fourbar_codegen.simulation.batch import evaluate

        return evaluate(self, t, x, p, r, out=out, workers=workers)

    def ensemble(
        self,
        t_span: Sequence[float],
        x0: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        *,
        method: str = "DOP853",
        parameters: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        inputs: Mapping[Any, InputSource | Floats] | None = None,
        t_eval: ArrayLike | None = None,
        rtol: float = 1e-6,
        atol: float | ArrayLike = 1e-9,
        constraints: str = "project",
        max_step: float = math.inf,
        max_steps: int | Literal["auto"] | None = "auto",
        workers: int | None = None,
        parallel: Any = None,
        progress: bool = True,
    ) -> Ensemble:
        """Many runs over the same time, several side by side in vectors, and on all cores.

        Models with redundant or with many constraints run one member at a time on each core.

        Parameters
        ----------
        t_span : (float, float)
            First and last time, s.
        x0 : array_like, shape (n_x,) or (n, n_x), or mapping, optional
            Initial states of all members, or of each; by name, numbers or arrays of length n. Where they are left out,
            `initial_state` makes one for each set of parameters.
        method : {"DOP853", "RK45"}, optional
        parameters : array_like, shape (n_p,) or (n, n_p), or mapping, optional
            Likewise; the defaults otherwise.
        inputs : mapping of input to source, optional
            As for `simulate`, or an array of shape (n,) with a number for each member. With a callable, members run
            one after the other.
        t_eval : array_like, optional
            Times at which to store the states; the first and the last one otherwise.
        rtol, atol, constraints, max_step, max_steps
            As for `simulate`.
        workers : int, optional
            Number of threads; one on each core otherwise.
        parallel : joblib.Parallel, optional
            An engine that runs blocks of members instead of threads, with any of its backends: in processes, or on a
            cluster. Where a worker does not find the compiled model, it builds it from its sources, once on each node.
        progress : bool, optional
            Whether a bar on the terminal says how far it is, where it takes longer than a second.

        Returns
        -------
        Ensemble
            A member that fails is marked there; the others go on. What a member gives is the same to the bit whatever
            runs beside it, on however many threads. `simulate` gives the same up to rounding errors, which kinks of an
            input, or a position close to a singular one, can make large.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        AssemblyError
            If `x0` is left out and the loops of a member do not close.

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> ensemble = fb.load("four_bar").ensemble((0.0, 4.0), parameters={"k": np.linspace(2.0, 4.0, 100)})
        >>> ensemble.success.all(), ensemble["q1"].shape
        (np.True_, (100, 2))
        """
        from fourbar_codegen.simulation.ensemble_run import run

        return run(
            self, x0, parameters, inputs, workers=workers, parallel=parallel, progress=progress,
            t_span=t_span, method=method, t_eval=t_eval, rtol=rtol, atol=atol, constraints=constraints,
            max_step=max_step, max_steps=max_steps,
        )  # fmt: skip

    def stepper(
        self,
        h: float,
        x0: ArrayLike | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        constraints: str = "project",
    ) -> Stepper:
        """An object that advances the mechanism by steps of one length, for control loops and real time.

        Parameters
        ----------
        h : float
            The step, s.
        x0 : array_like, shape (n_x,), optional
            The state to begin from; the one that follows from the model's initial values otherwise.
        t : float, optional
            Time to begin at, s.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`; ``step(r)`` holds others.
        constraints : {"project", "none"}, optional
            As for `simulate`.

        Returns
        -------
        Stepper
            With the method ``step(r)`` and the attributes ``t`` and ``x``; each thread needs one of its own.

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
        return make_stepper(self, h, x0, t=t, parameters=parameters, inputs=inputs, constraints=constraints)


def _restore(*_: object) -> CompiledModel:
    """What a compiled model's pickle named, before `kernel` had a function for it."""
    raise ModelError(
        "This pickle of a compiled model was made by an earlier version of fourbar_codegen: make it again, or load the "
        "module by fourbar_codegen.load."
    )
