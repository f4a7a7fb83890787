"""States of static equilibrium."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.continuation import null_space
from fourbar_codegen.analysis.loop_closure import Loops, mechanism_size, nearest_closed
from fourbar_codegen.errors import ModelError, SimulationError
from fourbar_codegen.interface.arguments import Values, finite_number, flag, named_array
from fourbar_codegen.kernel.inputs import InputSource, bind, input_sources
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["equilibrium", "stability"]

Floats = NDArray[np.float64]

# Tolerance of an equilibrium: for the loops relative to their scales; for accelerations relative to those at the start
# of the search, or to the changes that the coordinates' own magnitudes would cause.
EQUILIBRIUM_RTOL = 1e-9
# Smallest eigenvalue of the mass matrix, relative to the largest.
MIN_MASS_RATIO = 1e-12
# Steps downhill: their number, the first, largest and shortest one, in rad or relative to the unit of displacements;
# and the largest correction that closes loops, relative to the step.
MAX_STEPS, FIRST_STEP_LENGTH, MAX_STEP_LENGTH, MIN_STEP_LENGTH, MAX_CORRECTION_RATIO = 1000, 0.05, 0.2, 1e-7, 0.5
# Largest correction of the position from which they begin, in the same units: a turn.
MAX_FIRST_CORRECTION = 2.0 * np.pi
# Rounding errors of a matrix, relative to its largest eigenvalue; and the largest ones of eigenvalues that follow: a
# double eigenvalue of zero is known to the root of the precision.
ROUNDING_RTOL, EIGENVALUE_RTOL = 10.0 * np.finfo(float).eps, 1e-7


@overload
def equilibrium(
    model: Kernel,
    guess: Values | None = ...,
    *,
    t: float = ...,
    parameters: Values | None = ...,
    inputs: Mapping[Any, InputSource] | None = ...,
    stability: Literal[False] = ...,
) -> Floats: ...


@overload
def equilibrium(
    model: Kernel,
    guess: Values | None = ...,
    *,
    t: float = ...,
    parameters: Values | None = ...,
    inputs: Mapping[Any, InputSource] | None = ...,
    stability: Literal[True],
) -> tuple[Floats, str]: ...


def equilibrium(
    model: Kernel,
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
    x = _found(model, guess, t=t, parameters=parameters, inputs=inputs)
    if not flag(stability, "stability"):
        return x
    return x, _stability_of(model, x, t=t, parameters=parameters, inputs=inputs)


def _found(
    model: Kernel,
    guess: Values | None,
    *,
    t: float,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """A state of static equilibrium."""
    if not model.n_q:
        raise ModelError(f"The model {model.name} has no coordinates, so it has no equilibrium to search for.")
    if model.layout.n_independent_coordinates > model.n_u:
        raise ModelError(
            f"The model {model.name} has more independent coordinates than speeds, so an equilibrium does not "
            "determine them. Make the relation between them (such as the norm of a quaternion) a holonomic constraint."
        )
    t = finite_number(t, "t")
    if any(map(callable, input_sources(model, inputs))):
        raise ModelError(
            "An equilibrium can be searched with inputs that are numbers, tables or expressions, not callables."
        )
    names, n_q = (*model.coordinates, *model.auxiliary_states), model.n_q
    defaults = {**dict.fromkeys(names, 0.0), **model.layout.initial}
    start = named_array(guess, names, {n: defaults[n] for n in names}, "coordinate or auxiliary state")
    p = model.parameter_vector(parameters)
    r = bind(model, p, inputs).input_values(t, np.zeros(model.n_x))
    begin = start
    if model.n_h and model.layout.n_dependent_speeds < model.n_c:
        # Where loops are open, redundant constraints are independent, and the equations have no solution.
        n_qi = model.layout.n_independent_coordinates
        loops = Loops(model, t, start[:n_qi], p, r)
        dependent = loops.search(start[n_qi:n_q])
        begin = start if dependent is None else np.concatenate((loops.coordinates(dependent), start[n_q:]))
    equations = _AtRest.near(model, t, begin, p, r)
    found, errors, is_at_rest = equations.solve(begin)
    for position in () if is_at_rest else (found, begin):
        lower = _downhill(model, t, position, equations.units[:n_q], p, r)
        settled, _, is_at_rest = equations.solve(found if lower is None else lower)
        if is_at_rest:
            found = settled
            break
    if not is_at_rest:
        ended = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, found, strict=True))
        raise SimulationError(
            f"No equilibrium was found from the guess {start.tolist()}: the search ended at {ended}, where up to "
            f"{errors.max():.3g} is left of the scales of constraints and rates, and the way downhill from there leads "
            "to none. Give another guess, or inputs that hold the mechanism."
        )
    return _state_at_rest(model, found)


def _state_at_rest(model: Kernel, unknown: Floats) -> Floats:
    """The state with these coordinates and auxiliary states, and speeds of zero."""
    return np.concatenate((unknown[: model.n_q], np.zeros(model.n_u), unknown[model.n_q :]))


@dataclass(frozen=True)
class _AtRest:
    """The equations of a state at rest, in scales that do not depend on the units of length, mass and time.

    Attributes
    ----------
    model : Kernel
    t : float
    p, r : ndarray or None
    size : ndarray, shape (n_h,)
        Scales of the position constraints.
    weights : ndarray, shape (n_u, n_u)
        Accelerations are in the metric of the mass matrix, relative to their norm at the start of the search.
    units : ndarray, shape (n_q + n_z,)
        Of the unknowns: coordinates, then auxiliary states.
    """

    model: Kernel
    t: float
    p: Floats | None
    r: Floats | None
    size: Floats
    weights: Floats
    units: Floats

    @classmethod
    def near(cls, model: Kernel, t: float, begin: Floats, p: Floats | None, r: Floats | None) -> _AtRest:
        """The equations with the scales of a position."""
        n_q, last, x = model.n_q, model.n_q + model.n_u, _state_at_rest(model, begin)
        size, *_ = model.constraint_scale(t, x, p, r)
        size[~(size > 0.0)] = 1.0
        angles = np.array([name in model.layout.angles for name in model.coordinates], dtype=bool)
        # A displacement's own value may be nearly zero, and components of quaternions have no length.
        displacement = np.abs(begin[:n_q][~angles]).max(initial=mechanism_size(model, t, begin[:n_q], p, r))
        units = np.concatenate((np.where(angles, 1.0, displacement), np.abs(begin[n_q:]) + (begin[n_q:] == 0.0)))
        masses, axes = np.linalg.eigh(model.tree_mass_matrix(t, x, p))
        weights = np.sqrt(np.maximum(masses, MIN_MASS_RATIO * masses.max(initial=0.0)))[:, np.newaxis] * axes.T
        weights /= np.linalg.norm(weights @ model.rhs(t, x, p, r)[n_q:last]) or 1.0
        return cls(model, t, p, r, size, weights, units)

    def residual(self, unknown: Floats) -> Floats:
        """What is left of the equations; infinite where they cannot be evaluated, so that a search steps shorter."""
        model, t, p, r = self.model, self.t, self.p, self.r
        x = _state_at_rest(model, unknown)
        try:
            rates, accelerations, state_rates = np.split(model.rhs(t, x, p, r), [model.n_q, model.n_q + model.n_u])
            loops = model.position_constraints(t, x[: model.n_q], p, r) / self.size
            velocities = model.velocity_constraints(t, x, p, r)
        except SimulationError:
            return np.full(model.n_h + model.n_c + model.n_x, np.inf)
        return np.concatenate((loops, velocities, rates, self.weights @ accelerations, state_rates))

    def slopes(self, unknown: Floats) -> Floats:
        """The derivatives of the residual with respect to the unknowns."""
        model, t, p, r = self.model, self.t, self.p, self.r
        x, n_q, last = _state_at_rest(model, unknown), model.n_q, model.n_q + model.n_u
        wrt_state = np.delete(model.jacobian(t, x, p, r), slice(n_q, last), axis=1)
        rates, accelerations, state_rates = np.split(wrt_state, [n_q, last])
        loops = model.position(t, x[:n_q], p, r)[1] / self.size[:, np.newaxis]
        constraints = np.vstack((loops, model.constraint_partials(t, x, p, r)[0]))
        constraints = np.hstack((constraints, np.zeros((len(constraints), model.n_z))))
        return np.vstack((constraints, rates, self.weights @ accelerations, state_rates))

    def solve(self, unknown: Floats) -> tuple[Floats, Floats, bool]:
        """The end of a search, what is left there, and whether it is an equilibrium."""
        from scipy.optimize import least_squares

        # In changes relative to the units, so that the first step is a radian at most, and later ones twice the last.
        # Where accelerations do not depend on an angle to first order, a Newton step may be millions of turns.
        change = least_squares(
            lambda y: self.residual(unknown + self.units * y),
            np.zeros_like(unknown),
            jac=lambda y: self.slopes(unknown + self.units * y) * self.units,
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        ).x
        end = unknown + self.units * change
        errors, scales = np.abs(self.residual(end)), np.abs(self.slopes(end)) @ np.abs(end)
        return end, errors, bool((errors <= EQUILIBRIUM_RTOL * np.maximum(scales, 1.0)).all())


def _downhill(
    model: Kernel, t: float, begin: Floats, units: Floats, p: Floats | None, r: Floats | None
) -> Floats | None:
    """Coordinates near a stable equilibrium, where a motion comes to rest that begins at others.

    In a medium so viscous that inertia does not count, a mechanism moves along its accelerations from rest,
    -M^-1 dV/dq on the constraints, so that the potential energy V decreases: to a minimum, not to a position where only
    the accelerations are smallest. A step is halved if the accelerations at its end point back, or the loops do not
    close near there. None without closed loops nearby.
    """
    n_q = model.n_q

    def accelerations(q: Floats) -> Floats | None:
        with suppress(SimulationError):
            return model.rhs(t, np.concatenate((q, rest)), p, r)[n_q : n_q + model.n_u]
        return None

    rest = np.concatenate((np.zeros(model.n_u), begin[n_q:]))
    q = nearest_closed(model, t, begin[:n_q], p, r)
    # Where modes meet, a correction by rounding errors of derivatives may be millions of turns.
    is_near = q is not None and np.abs((q - begin[:n_q]) / units).max(initial=0.0) <= MAX_FIRST_CORRECTION
    force = accelerations(q) if q is not None and is_near else None
    if q is None or force is None:
        return None
    length = FIRST_STEP_LENGTH
    for _ in range(MAX_STEPS):
        x = np.concatenate((q, rest))
        way = model.coordinate_change(t, x, force, p, r)
        size = np.abs(way / units).max(initial=0.0)
        if not size or length < MIN_STEP_LENGTH:
            break
        step = length * way / size
        ahead = nearest_closed(model, t, q + step, p, r)
        force_there = None
        if ahead is not None and np.abs((ahead - q - step) / units).max() <= MAX_CORRECTION_RATIO * length:
            force_there = accelerations(ahead)
        if ahead is None or force_there is None or force @ model.tree_mass_matrix(t, x, p) @ force_there < 0.0:
            length /= 2.0
            continue
        q, force, length = ahead, force_there, min(2.0 * length, MAX_STEP_LENGTH)
    return np.concatenate((q, begin[n_q:]))


def stability(
    model: Kernel,
    x: ArrayLike,
    *,
    t: float = 0.0,
    parameters: Values | None = None,
    inputs: Mapping[Any, InputSource] | None = None,
) -> str:
    """Whether an equilibrium is stable, by the eigenvalues of the linearized motion.

    That is along the constraints, in a basis of all positions and speeds that satisfy them to first order, whichever
    coordinates are independent.

    What of an eigenvalue may be rounding errors follows from its condition number, the reciprocal product of its left
    and right unit vectors: little of the slow motion of an overdamped mechanism, whose eigenvalues are far apart.

    Parameters
    ----------
    x : array_like, shape (n_x,)
        The equilibrium, as `equilibrium` returns it.
    t, parameters, inputs
        As for `equilibrium`.

    Returns
    -------
    {"stable", "unstable", "neutral"}
        No motion nearby grows; a motion grows; or there are zero eigenvalues, as where positions of equilibrium lie
        beside it.

    Raises
    ------
    ModelError
        If an argument has a wrong shape or name, or is not finite.

    Source: L. Meirovitch, *Methods of Analytical Dynamics*, 1970 (stability by the first approximation).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> pendulum = fb.compile_model(fb.models.cartesian_pendulum())
    >>> [pendulum.stability(pendulum.equilibrium([y, 0.0])) for y in (1.0, -1.0)]
    ['unstable', 'stable']
    """
    state = named_array(x, model.states, {}, "state")
    return _stability_of(model, state, t=finite_number(t, "t"), parameters=parameters, inputs=inputs)


def _stability_of(
    model: Kernel, x: Floats, *, t: float, parameters: Values | None, inputs: Mapping[Any, InputSource] | None
) -> str:
    from scipy.linalg import eig

    n_q, last, p = model.n_q, model.n_q + model.n_u, model.parameter_vector(parameters)
    r = bind(model, p, inputs).input_values(t, x)
    basis = np.zeros((model.n_x, 0))
    of_constraints = (model.position(t, x[:n_q], p, r)[1], model.velocity(t, x, p, r)[0], np.zeros((0, model.n_z)))
    for rows, begin in zip(of_constraints, (0, n_q, last), strict=True):
        part = null_space(rows) if rows.size else np.eye(rows.shape[1])
        basis = np.hstack((basis, np.zeros((model.n_x, part.shape[1]))))
        if part.size:
            basis[begin : begin + len(part), -part.shape[1] :] = part
    matrix = basis.T @ model.jacobian(t, x, p, r) @ basis
    if not matrix.size:  # the mechanism cannot move; not all versions of SciPy take empty matrices
        return "stable"
    fastest = np.abs(np.linalg.eigvals(matrix)).max(initial=0.0) or 1.0
    # Speeds by the time of the fastest motion, so that they are as large as coordinates.
    scales = np.where(np.abs(basis[n_q:last]).any(axis=0), fastest, 1.0)
    values, left, right = eig(matrix / scales[:, np.newaxis] * scales, left=True)
    known = np.abs((left.conj() * right).sum(axis=0))
    unknown = fastest * ROUNDING_RTOL / np.maximum(known, ROUNDING_RTOL / EIGENVALUE_RTOL)
    # The real part of an oscillation's eigenvalue may be an error of its frequency, too.
    if (values.real > np.maximum(unknown, EIGENVALUE_RTOL * np.abs(values))).any():
        return "unstable"
    return "neutral" if (np.abs(values) <= unknown).any() else "stable"
