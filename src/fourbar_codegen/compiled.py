"""CompiledModel: the facade of a kernel, with all methods that users call."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, flag, one_of
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.kernel.loading import load_named
from fourbar_codegen.roles import STEP_CONTROLLED
from fourbar_codegen.runtime.integrator import Ode, Stepper
from fourbar_codegen.simulation.options import RunOptions
from fourbar_codegen.simulation.simulate import make_stepper, simulate

if TYPE_CHECKING:
    from fourbar_codegen.analysis.assembly_modes import AssemblyModes
    from fourbar_codegen.analysis.linearization import Linearization
    from fourbar_codegen.kernel.inputs import InputSource
    from fourbar_codegen.results.ensemble import Ensemble
    from fourbar_codegen.results.kinematics import Branch, Kinematics
    from fourbar_codegen.results.trajectory import Trajectory
    from fourbar_codegen.simulation.events import EventLike
    from fourbar_codegen.tables import Page

__all__ = ["CompiledModel", "load", "load_trajectory"]

Floats = NDArray[np.float64]


def load(name: str | Path) -> CompiledModel:
    """Load a compiled model; neither SymPy nor a compiler is needed.

    (A library of `compile_model`, in the cache, needs a compiler once more for its first Jacobian or picture, and for
    its first batch or ensemble.)

    Parameters
    ----------
    name : str or Path
        The name of a model in this package, ``"four_bar"``, or of a model that was installed from a wheel of
        `build_wheel` (not from the current folder); or the path of an extension module of ``fourbar build`` or
        `build_model`, or of a library of `compile_model`. An installed package is only imported if its manifest.json
        identifies it as that model.

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
    """Read a trajectory from a file of `Trajectory.save`.

    Parameters
    ----------
    path : str or Path
        A ``.nc`` or ``.npz`` file.
    model : CompiledModel, optional
        The simulated model. Without it, the model with the name and fingerprint in the file is searched: in this
        package, among models installed from wheels, and in the cache of this machine.

    Returns
    -------
    Trajectory
        Without interpolant and events; these are not saved.

    Raises
    ------
    ModelError
        If the file cannot be read or has another format, the run is of another model, or the model is not found.

    Notes
    -----
    Files may come from untrusted sources: they contain the name and fingerprint of the model, but no path. A package
    is imported only if its own manifest.json has this name and fingerprint; the cache is searched by a key made of
    both.

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

    Made by `compile_model` and `load`. Arguments are in the order (t, x, p, r): time, state x = [q; u; z],
    parameters, inputs. Parameters and inputs are arrays, or mappings from names or SymPy symbols; mappings may
    omit entries that have a default. Several threads may use one model at the same time.

    Attributes
    ----------
    name : str
    coordinates, speeds : tuple of str
        Generalized coordinates and speeds, the independent ones first.
    auxiliary_states : tuple of str
        States with first-order differential equations of their own.
    states : tuple of str
        Coordinates, speeds and auxiliary states.
    parameters, inputs, outputs : tuple of str
    points : tuple of str
        The points that are drawn: those with positions in the System, by their names there.
    forced_points : tuple of str
        Points at which forces act that depend on inputs.
    defaults : dict of str to float or None
        Parameter values; None if there is no default.
    units, descriptions : dict of str to str
        Of the parameters.
    path : Path
        The extension module, or the library of `compile_model`; an argument for `load`.
    layout : Layout
        The description of the model: names, order, what depends on what.
    manifest : dict
        The same as data for JSON, as in the manifest.json of the generated sources.
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
                ("coordinate", self.coordinates, self.layout.n_dependent_coordinates),
                ("speed", self.speeds, self.layout.n_dependent_speeds),
                ("auxiliary state", self.auxiliary_states, 0),
            ],
            {name: (value, self.units[name], self.descriptions[name]) for name, value in self.defaults.items()},
            {entry.name: entry.expression for entry in self.layout.inputs},
            self.outputs,
        )

    def linearize(
        self,
        t: float,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        outputs: Sequence[Any] | None = None,
    ) -> Linearization:
        """A and B of d(q_i, u_i, z)/dt = A d(q_i, u_i, z) + B dr near a state that satisfies the constraints.

        In the independent coordinates q_i and speeds u_i, as ``KanesMethod.linearize(A_and_B=True)``: the dependent
        ones follow the constraints to first order, including constraints with inputs. With outputs y, also C and D
        of dy = C d(q_i, u_i, z) + D dr.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.
        outputs : sequence of str, optional
            Names of outputs, and of states, dependent ones too; ``model.outputs`` for all outputs.

        Returns
        -------
        Linearization
            A sequence of matrices, with the names of their rows and columns as ``states``, ``inputs`` and ``outputs``:
            A, shape (n_i, n_i), n_i being the number of independent coordinates, independent speeds and auxiliary
            states; B, (n_i, n_r); and, if outputs are given, C, (len(outputs), n_i), and D, (len(outputs), n_r).

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite, or the state violates the constraints; or
            redundant constraints do not determine the derivatives of outputs.
        SimulationError
            If the independent coordinates and speeds do not determine the dependent ones at this state.

        Source: D. L. Peterson, G. Gede, M. Hubbard, "Symbolic linearization of equations of motion of
        constrained multibody systems", *Multibody System Dynamics* 33 (2015).

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> A, B = four_bar.linearize(0.0, four_bar.initial_state())
        >>> A.shape, B.shape
        ((2, 2), (2, 1))
        >>> linear = four_bar.linearize(0.0, four_bar.initial_state(), outputs=["q3"])
        >>> linear.states, linear.inputs, linear.outputs
        (('q1', 'u1'), ('F',), ('q3',))
        """
        from fourbar_codegen.analysis.linearization import linearize

        return linearize(self, t, x, p, r, outputs)

    @overload
    def equilibrium(
        self,
        guess: Values | None = ...,
        *,
        t: float = ...,
        parameters: Values | None = ...,
        inputs: Mapping[Any, InputSource] | None = ...,
        stability: Literal[False] = ...,
    ) -> Floats: ...

    @overload
    def equilibrium(
        self,
        guess: Values | None = ...,
        *,
        t: float = ...,
        parameters: Values | None = ...,
        inputs: Mapping[Any, InputSource] | None = ...,
        stability: Literal[True],
    ) -> tuple[Floats, str]: ...

    def equilibrium(
        self,
        guess: Values | None = None,
        *,
        t: float = 0.0,
        parameters: Values | None = None,
        inputs: Mapping[Any, InputSource] | None = None,
        stability: bool = False,
    ) -> Floats | tuple[Floats, str]:
        """An equilibrium: a state of rest in which all accelerations vanish.

        SciPy's ``least_squares`` solves for constraints and accelerations, with compiled Jacobians, in steps that begin
        with a radian at most, so that angles stay near the guess. If that ends where accelerations are only smallest,
        the mechanism is followed from there as in a viscous medium, downhill along the loops' branch, to a stable
        equilibrium. Otherwise it may be stable or unstable, which `stability` asks for.

        Parameters
        ----------
        guess : array_like, shape (n_q,), or mapping, optional
            Coordinates to start from; by default the model's initial values, or 0.
        t : float, optional
            Time, s, at which inputs are evaluated.
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`, but no callables.
        stability : bool, optional
            Whether "stable", "unstable" or "neutral" is returned, too, by the eigenvalues of the linearized motion.

        Returns
        -------
        ndarray, shape (n_x,)
            The coordinates, and speeds of 0.
        str
            With `stability`: no motion nearby grows, a motion grows, or there are positions of equilibrium beside it.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite.
        SimulationError
            If no equilibrium was found. The message says where the search ended.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 0.0})
        >>> bool(abs(four_bar.rhs(0.0, x, r={"F": 0.0})).max() < 1e-9)
        True
        >>> pendulum = fb.compile_model(fb.models.cartesian_pendulum())
        >>> upright, kind = pendulum.equilibrium([1.0, 0.0], stability=True)
        >>> kind
        'unstable'
        """
        from fourbar_codegen.analysis.equilibrium import equilibrium, stability_of

        x = equilibrium(self, guess, t=t, parameters=parameters, inputs=inputs)
        if not flag(stability, "stability"):
            return x
        return x, stability_of(self, x, t=t, parameters=parameters, inputs=inputs)

    @overload
    def initial_state(
        self,
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
        self,
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
            Whether to return also the derivatives of the state with respect to the independent values, the parameters
            and the given inputs, by the implicit function theorem.

        Returns
        -------
        ndarray, shape (n_x,)
            With `derivatives`, a tuple of it and a dict of arrays of this shape, by names; of the shape (n, n_x) for
            the n values of a table. Parameters are left out that redundant constraints do not let change alone, such as
            one of the lengths of a parallelogram with a bar too many.

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name, or is not finite; or if the state is the model's initial one, and
            its values of dependent speeds violate the constraints.
        AssemblyError
            If the loops do not close, or the dependent speeds are not determined; or if the state has no derivatives,
            at a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> x0 = fb.load("four_bar").initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
        >>> x0.round(6).tolist()
        [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
        >>> x0, by = fb.load("four_bar").initial_state({"q1": -0.5}, {"u1": -0.1}, derivatives=True)
        >>> by["l2"][1].round(4).item()  # dq2/dl2
        -0.826
        """
        from fourbar_codegen.analysis.initial_state import initial_state
        from fourbar_codegen.kernel.sensitivity import initial_derivatives

        x0 = initial_state(
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
        return (x0, initial_derivatives(self, t, x0, parameters, inputs)) if flag(derivatives, "derivatives") else x0

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

    def kinematics(
        self,
        drive: Mapping[Any, ArrayLike],
        *,
        rates: Mapping[Any, ArrayLike] | None = None,
        accelerations: Mapping[Any, ArrayLike] | None = None,
        parameters: Values | None = None,
        inputs: Mapping[Any, float] | None = None,
        t: float = 0.0,
    ) -> Kinematics:
        """Positions, velocities and accelerations along a drive, in all ways in which the loops close.

        Branches are continued by arc length, through the positions where the drive has to turn round: dead points,
        which are also the limits of the range where the loops can close. They are found from the assembly modes at nine
        places along the drive, and at those given values where there are more modes than branches, or where no branch
        closes. Modes can be counted where loops are closed one or two constraints at a time; otherwise a branch may be
        missed, and ``is_complete`` is False. Where branches cross, velocities are limits along them. Masses and forces
        need no values.

        Parameters
        ----------
        drive : mapping of coordinate or prescribed motion to array_like, shape (n,)
            As many as the mechanism has degrees of freedom. Values of several are passed in their order.
        rates, accelerations : mapping of coordinate or prescribed motion to float or array_like, shape (n,), optional
            First and second derivatives of the driven quantities with respect to time; by default 1 and 0, so that
            velocities are derivatives with respect to the drive.
        parameters : array_like or mapping, optional
        inputs : mapping of str to float, optional
            Values of inputs that prescribe other motions, and of their rates.
        t : float, optional
            The time at which constraints are evaluated, s.

        Returns
        -------
        Kinematics
            A sequence of branches with the coordinates, points and their derivatives, and ``dead_points``.

        Raises
        ------
        ModelError
            If an argument has a wrong name or shape, or the drive leaves a degree of freedom.
        AssemblyError
            If the loops close nowhere along the drive.

        Source: E. L. Allgower and K. Georg, *Introduction to Numerical Continuation Methods*, SIAM 2003.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> import numpy as np
        >>> four_bar = fb.load("four_bar")
        >>> lengths = {"l1": 0.8, "l2": 0.2, "l3": 0.7, "l4": 0.6}
        >>> found = four_bar.kinematics({"q1": np.linspace(0.0, 2 * np.pi, 73)}, parameters=lengths)
        >>> len(found), len(found.dead_points), bool(found.closes.all())
        (2, 0, True)
        """
        from fourbar_codegen.analysis.branches import kinematics

        return kinematics(self, drive, rates, accelerations, t=t, parameters=parameters, inputs=inputs)

    def inverse_dynamics(
        self,
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
        from fourbar_codegen.analysis.inverse_dynamics import inverse_dynamics

        return inverse_dynamics(self, motion, find, parameters, inputs)

    def ode(self, parameters: Values | None = None, inputs: Mapping[Any, InputSource] | None = None) -> Ode:
        """The right-hand side as a callable f(t, x), for `scipy.integrate.solve_ivp` and similar integrators.

        Parameters
        ----------
        parameters : array_like or mapping, optional
            The defaults otherwise.
        inputs : mapping, optional
            As for `simulate`.

        Returns
        -------
        Ode
            Callable, with its Jacobian as ``.jac``. The integrators in `fourbar_codegen.solvers` call it in C.
            Several threads may use it at the same time.

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
        method : {"DOP853", "RK45", "Tsit5", "Radau", "ALI3P", "CVODE", "IDA"}, optional
            DOP853, RK45 and Tsit5 are explicit and run in C, with the step size control of SciPy, and its coefficients
            for the first two. Tsit5, of order 5 like RK45, has smaller error coefficients. Source: Ch. Tsitouras,
            "Runge-Kutta pairs of order 5(4) satisfying only the first column simplifying assumption", *Computers &
            Mathematics with Applications* 62 (2011). ALI3P passes singular positions: an augmented Lagrangian
            formulation of index 3 with the trapezoidal rule and projections. It runs in C with steps of `max_step`, and
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
            Relative and absolute tolerance of a step; ALI3P has none.
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
            The longest step, s; required for ALI3P. It must exceed the rounding error of the simulated time.
        max_steps : int, "auto" or None, optional
            The largest number of steps; a run ends after them, with the states up to there. None is no limit. By
            default 1,000,000 for the methods of `ensemble`, and 100,000 for the others, or ten times the
            number that `max_step` requires, if that is more.
        formulation : {"gear-gupta-leimkuhler", "index-1", "index-3"}, optional
            For IDA; the first is the default. It selects what satisfies the constraints in each step: positions and
            velocities; only accelerations, so that the loops drift open; or only positions, with error control of the
            coordinates only. See `fourbar_codegen.solvers.IDA`.
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
            self, t_span=t_span, x0=x0, method=method, parameters=parameters, inputs=inputs, t_eval=t_eval, rtol=rtol,
            atol=atol, events=events, constraints=constraints, stabilization=stabilization, dense_output=dense_output,
            max_step=max_step, max_steps=max_steps, formulation=formulation, progress=progress,
            sensitivities=sensitivities, dx0=dx0, gradient=gradient,
        )  # fmt: skip
        return simulate(self, options)

    def page(
        self,
        path: str | Path | None = None,
        *,
        t_span: Sequence[float] = (0.0, 4.0),
        x0: ArrayLike | None = None,
        parameters: Values | None = None,
        inputs: Mapping[Any, float | tuple[ArrayLike, ArrayLike, str]] | None = None,
        ranges: Mapping[Any, tuple[float, float]] | None = None,
        traces: Sequence[str] | None = None,
        watch: Sequence[tuple[str, str]] | None = None,
        events: EventLike | Sequence[EventLike] | None = None,
        height: int = 900,
        method: str = "DOP853",
    ) -> Page:
        """A live page: one HTML file in which the mechanism is simulated anew while a slider moves.

        It works offline and without Python: it contains the equations of motion, loop closure and a method with step
        control and projection, compiled to WebAssembly. Sliders change parameters, initial values, inputs and the time
        span; a link carries all settings. Scripts call ``window.fourbar.simulate``. Needs the extra ``page``, or clang
        with wasm-ld.

        Parameters
        ----------
        path : str or Path, optional
            The file to write, ``.html``.
        t_span, x0, parameters : optional
            Of the run that it begins with, as for `simulate`.
        inputs : mapping of input to float or table, optional
            What inputs begin as; by default their expressions. Tables are of the kind "hold".
        ranges : mapping of str to (float, float), optional
            Of the sliders of parameters and independent initial values. By default, for parameters `Parameter.range`,
            else from a fifth of the value to its double, or both signs if it is zero; for angles half a turn to both
            sides.
        traces : sequence of str, optional
            Names of points with a trace; by default the moving joints, or the mass centres if there are none.
        watch : sequence of (str, str), optional
            Figures of the shown frames, with their change: pairs of a statistic ("greatest", "least", "greatest
            magnitude", "range", "mean", "last") and the name of a quantity, such as ``("range", "q1")``.
        events : str, Event, or a list of these, optional
            Names of quantities, as for `simulate`: plots have marks where they change their sign, a table has the
            times, and a terminal one ends the run.
        height : int, optional
            Height in a notebook, pixels.
        method : str, optional
            Of its runs: one with step control that `ensemble` has.

        Returns
        -------
        Page
            Displayed if it is the last expression of a cell; ``text`` is the HTML.

        Raises
        ------
        ModelError
            If an argument has a wrong name or shape, a parameter has no value, an input is neither a number nor an
            expression of the model, there is nothing to draw, or the file cannot be written.
        BuildError
            If there is no compiler of WebAssembly, or it fails; with its output.
        AssemblyError, SimulationError
            As for `simulate`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").page(ranges={"l2": (0.3, 0.6)}, traces=["P2"])
        <Live page of four_bar, 900 pixels high>
        """
        from fourbar_codegen.presentation.live_page import TOLERANCE, check_inputs, live_page
        from fourbar_codegen.simulation.events import named_events

        check_inputs(self, inputs)
        one_of(method, STEP_CONTROLLED, "method for pages")
        watched = named_events(self, events, "a page")
        run = self.simulate(
            t_span, x0, method=method, parameters=parameters, inputs=inputs, events=events, rtol=TOLERANCE,
            atol=TOLERANCE,
        )  # fmt: skip
        return live_page(
            run,
            self._page_module,
            path,
            ranges={} if ranges is None else ranges,
            traces=traces,
            watch=watch,
            events=watched,
            height=height,
        )

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
        """The right-hand side x' = f(t, x) at a batch of states, in SIMD lanes.

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
            Array for the result: contiguous, without memory shared with the arguments; a new array otherwise.
        workers : int or None, optional
            Number of threads; None for one per core.

        Returns
        -------
        ndarray, shape (n_x, n)
            x', with NaN in the columns of states at which the equations cannot be evaluated. Results are bitwise
            independent of the other states.

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

    def jacobian_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        workers: int | None = 1,
    ) -> Floats:
        """The derivatives of the right-hand side with respect to the state, at a batch of states.

        Parameters
        ----------
        t, x, p, r, workers
            As for `rhs_batch`.

        Returns
        -------
        ndarray, shape (n_x, n_x, n)
            dx'/dx, with NaN for states at which the equations cannot be evaluated.

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
        >>> four_bar.jacobian_batch(0.0, states).shape
        (6, 6, 1000)
        """
        from fourbar_codegen.simulation.batch import differentiate

        return differentiate(self, "state", t, x, p, r, outputs=False, workers=workers)[0]

    def parameter_jacobian_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        workers: int | None = 1,
    ) -> Floats:
        """The derivatives of the right-hand side with respect to the parameters, at a batch of states.

        Total derivatives, as `parameter_jacobian` has them; parameters, shape and errors are those of `jacobian_batch`.

        Returns
        -------
        ndarray, shape (n_x, n_p, n)

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
        >>> four_bar.parameter_jacobian_batch(0.0, states).shape
        (6, 8, 1000)
        """
        from fourbar_codegen.simulation.batch import differentiate

        return differentiate(self, "parameters", t, x, p, r, outputs=False, workers=workers)[0]

    def input_jacobian_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
        *,
        workers: int | None = 1,
    ) -> Floats:
        """The derivatives of the right-hand side with respect to the inputs, at a batch of states.

        Parameters, shape and errors are those of `jacobian_batch`.

        Returns
        -------
        ndarray, shape (n_x, n_r, n)

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> states = np.tile(four_bar.initial_state(), (1000, 1)).T
        >>> four_bar.input_jacobian_batch(0.0, states).shape
        (6, 1, 1000)
        """
        from fourbar_codegen.simulation.batch import differentiate

        return differentiate(self, "inputs", t, x, p, r, outputs=False, workers=workers)[0]

    def residual_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        rates: ArrayLike,
        multipliers: ArrayLike | None = None,
        p: Values | None = None,
        r: Values | None = None,
        *,
        formulation: str = "index-3",
        workers: int | None = 1,
    ) -> Floats:
        """The residual of the equations of motion at a batch of states, for direct collocation.

        Its rows are q' - K u - k; M u' - f - J^T lambda; z' minus its expression; then for each constraint "index-3"
        Phi, or J u + b if it is nonholonomic, and for "index-1" J u' + gamma; then the rows of unknown forces that
        drive the motion. No matrix is inverted, so that singular positions and massless parts do no harm.

        Parameters
        ----------
        t : float or array_like, shape (n,)
        x, rates : array_like, shape (n_x, n)
            States, and their rates x', such as differences between neighbours.
        multipliers : array_like, shape (n_l, n), optional
            Lagrange multipliers of the constraints, then unknown forces; may be left out if there are none.
        p, r, workers
            As for `rhs_batch`.
        formulation : {"index-3", "index-1"}, optional

        Returns
        -------
        ndarray, shape (n_x + n_l, n)

        Raises
        ------
        ModelError
            If an argument has a wrong shape or name.

        Source: J. T. Betts, *Practical Methods for Optimal Control and Estimation Using Nonlinear Programming*, 2nd
        ed., SIAM 2010, chapter 4.

        Examples
        --------
        >>> import numpy as np
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.initial_state()
        >>> rates, multipliers = four_bar.rhs(0.0, x), four_bar.multipliers(0.0, x)
        >>> residual = four_bar.residual_batch(0.0, x[:, None], rates[:, None], multipliers[:, None])
        >>> residual.shape, bool(np.abs(residual).max() < 1e-12)
        ((8, 1), True)
        """
        from fourbar_codegen.simulation.batch import residual

        found = residual(self, t, x, rates, multipliers, p, r, formulation=formulation, workers=workers)
        return found["residual"]

    def residual_jacobian_batch(
        self,
        t: ArrayLike,
        x: ArrayLike,
        rates: ArrayLike,
        multipliers: ArrayLike | None = None,
        p: Values | None = None,
        r: Values | None = None,
        *,
        formulation: str = "index-3",
        wrt: Sequence[str] = ("x", "rates", "multipliers", "p", "r"),
        workers: int | None = 1,
    ) -> dict[str, Floats]:
        """The Jacobians of `residual_batch`, which has the same other parameters and errors.

        `residual_sparsity` tells which entries are always 0.

        Parameters
        ----------
        wrt : sequence of {"x", "rates", "multipliers", "p", "r"}, optional
            What to differentiate with respect to; by default all, of which parameters take most of the time.

        Returns
        -------
        dict of str to ndarray, shape (n_x + n_l, m, n)
            By each of `wrt`; by "p" also through inputs whose expressions are in force.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x = four_bar.initial_state()[:, None]
        >>> found = four_bar.residual_jacobian_batch(0.0, x, 0.0 * x, [[1.0], [2.0]])
        >>> {name: jacobian.shape for name, jacobian in found.items()}
        {'x': (8, 6, 1), 'rates': (8, 6, 1), 'multipliers': (8, 2, 1), 'p': (8, 8, 1), 'r': (8, 1, 1)}
        """
        from fourbar_codegen.simulation.batch import residual

        return residual(self, t, x, rates, multipliers, p, r, formulation=formulation, workers=workers, wrt=wrt)

    def residual_sparsity(self, formulation: str = "index-3") -> dict[str, NDArray[np.bool_]]:
        """Which entries of the Jacobians of `residual_batch` may differ from 0.

        Parameters
        ----------
        formulation : {"index-3", "index-1"}, optional

        Returns
        -------
        dict of str to ndarray of bool, shape (n_x + n_l, m)
            By the names of `residual_jacobian_batch`.

        Raises
        ------
        ModelError
            If there is no such formulation.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").residual_sparsity()["r"].ravel().tolist()  # a force on two links
        [False, False, False, True, True, False, False, False]
        """
        from fourbar_codegen.simulation.batch import residual_sparsity

        return residual_sparsity(self, formulation)

    def ensemble(
        self,
        t_span: Sequence[float],
        x0: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        *,
        method: str = "DOP853",
        parameters: ArrayLike | Mapping[Any, ArrayLike] | None = None,
        inputs: Mapping[Any, InputSource | Floats] | None = None,
        t_eval: ArrayLike | None = None,
        events: EventLike | Sequence[EventLike] | None = None,
        rtol: float = 1e-6,
        atol: float | ArrayLike = 1e-9,
        constraints: str = "project",
        max_step: float = math.inf,
        max_steps: int | Literal["auto"] | None = "auto",
        workers: int | None = None,
        parallel: Any = None,
        progress: bool = True,
    ) -> Ensemble:
        """Simulate many members over the same time span, in SIMD lanes and on all cores.

        Models with redundant or with many constraints run one member at a time on each core.

        Parameters
        ----------
        t_span : (float, float)
            First and last time, s.
        x0 : array_like, shape (n_x,) or (n, n_x), or mapping, optional
            One initial state for all members, or one for each; in a mapping, numbers or arrays of length n. By default,
            `initial_state` is solved for each set of parameters.
        method : {"DOP853", "RK45", "Tsit5", "Radau", "ALI3P"}, optional
            Radau and ALI3P run one member at a time on each core.
        parameters : array_like, shape (n_p,) or (n, n_p), or mapping, optional
            Likewise; the defaults otherwise.
        inputs : mapping of input to source, optional
            As for `simulate`, or an array of shape (n,) with a number for each member. With callables, members run
            one after another.
        t_eval : array_like, optional
            Times at which to store the states; by default the first and the last one.
        events : str, callable, `Event`, or list of these, optional
            As for `simulate`. A terminal event ends its member alone.
        rtol, atol, constraints, max_step, max_steps
            As for `simulate`.
        workers : int, optional
            Number of threads; by default one per core.
        parallel : joblib.Parallel, optional
            An engine that runs blocks of members in place of threads, with any backend: in processes, or on a cluster.
            A worker that does not find the compiled model builds it from its sources, once on each node.
        progress : bool, optional
            Whether to show a progress bar on a terminal if the simulation takes longer than a second.

        Returns
        -------
        Ensemble
            A member that fails is marked; the others continue. Results are bitwise independent of the batch and of the
            number of threads. They agree with `simulate` up to rounding errors, which kinks of an input or nearby
            singular positions can amplify.

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
            t_span=t_span, method=method, t_eval=t_eval, events=events, rtol=rtol, atol=atol, constraints=constraints,
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
        events: EventLike | Sequence[EventLike] | None = None,
        constraints: str = "project",
        method: str = "RK4",
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
        return make_stepper(
            self, h, x0, t=t, parameters=parameters, inputs=inputs, events=events, constraints=constraints,
            method=method,
        )  # fmt: skip


def _restore(*_: object) -> CompiledModel:
    """The function that pickles of earlier versions refer to."""
    raise ModelError(
        "This pickle of a compiled model is from an earlier version of fourbar_codegen: make it again, or load the "
        "module with fourbar_codegen.load."
    )
