"""Linearization about a state, in the independent coordinates and speeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.loop_closure import require_closed
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import (
    Values,
    finite_number,
    is_integer,
    is_mapping,
    listed,
    name_of,
    named,
    named_array,
    positive,
)
from fourbar_codegen.interface.registered import Registered
from fourbar_codegen.kernel.dependent import eliminate
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.samples import trajectory
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["Linearization", "linearize", "state_space"]

Floats = NDArray[np.float64]


OSCILLATES = 0.05
"""Least ratio of the parts of an eigenvalue of a motion that is shown for two periods."""

DURATIONS = (0.1, 60.0)
"""Of the motion along a mode by default, s."""

ZERO = 1e-9
"""Largest ratio of an eigenvalue that is zero but for rounding errors, to the largest one."""

STEPS_PER_SECOND, MIN_STEPS = 60.0, 120


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """What a model is linearized about.

    Attributes
    ----------
    model : Kernel
    t : float
    x : ndarray, shape (n_x,)
    p, r : array_like or mapping or None
    directions : ndarray, shape (n_x, n_i)
        The change of the state for changes of the independent coordinates and speeds and of the auxiliary states.
    """

    model: Kernel
    t: float
    x: Floats
    p: Values | None
    r: Values | None
    directions: Floats


@dataclass(frozen=True, eq=False)
class Linearization(Sequence[Floats]):
    """A linear state space model: the sequence of its matrices A and B, and of C and D if outputs are given.

    Attributes
    ----------
    matrices : tuple of ndarray
    states : tuple of str
        The independent coordinates, independent speeds and auxiliary states: rows of A and B, columns of A and C.
    inputs : tuple of str
        The columns of B and D.
    outputs : tuple of str
        The rows of C and D.
    about : OperatingPoint
        The state that it is about.
    """

    matrices: tuple[Floats, ...]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    about: OperatingPoint = field(repr=False)

    # By the pictures, which stand above.
    animate = Registered[..., Any]()

    @cached_property
    def _modes(self) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Eigenvalues and eigenvectors, by decreasing real part, then imaginary part."""
        values, vectors = np.linalg.eig(self.matrices[0].astype(complex))
        size = np.abs(values).max(initial=1.0)
        order = np.lexsort((-values.imag, -np.round(values.real / size, 9)))
        return values[order], vectors[:, order]

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """The eigenvalues of A, 1/s, by decreasing real part: an unstable motion comes first.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> bicycle = fb.compile_model(fb.models.whipple_bicycle())
        >>> linear = bicycle.linearize(0.0, bicycle.initial_state())
        >>> linear.eigenvalues.real.round(3)[-4:].tolist()  # capsize, weave and castering at 5 m/s
        [-0.323, -0.775, -0.775, -14.078]
        """
        return self._modes[0]

    def mode(self, number: int, *, amplitude: float = 0.1, duration: float | None = None) -> Trajectory:
        """The motion along a mode: x(t) = x_0 + x_0' t + a Re(v exp(lambda t)), with v of the eigenvalue lambda.

        The first terms are the motion that the model is linearized about: where speeds are constant, coordinates
        change with them, so that a bicycle rolls on.

        Parameters
        ----------
        number : int
            Of an entry of `eigenvalues`.
        amplitude : float, optional
            The largest change of a coordinate in the motion, in its unit; of a speed if the mode has no coordinates.
        duration : float, optional
            In s; by default two periods, or three times the time constant of a motion that does not oscillate.

        Returns
        -------
        Trajectory
            It satisfies the constraints to first order in the amplitude.

        Raises
        ------
        ModelError
            If there is no such mode, or an argument is not positive.

        Source: J. P. Meijaard, J. M. Papadopoulos, A. Ruina, A. L. Schwab, "Linearized dynamics equations for the
        balance and steer of a bicycle", *Proceedings of the Royal Society A* 463 (2007): weave, capsize and castering.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> linear = four_bar.linearize(0.0, four_bar.initial_state())
        >>> linear.mode(0, duration=1.0).t[-1]
        np.float64(1.0)
        """
        values, vectors = self._modes
        if not is_integer(number) or not -len(values) <= number < len(values):
            raise ModelError(f"There are modes 0 to {len(values) - 1}, not {shown(number)}.")
        positive(amplitude, "amplitude")
        value, about = values[number], self.about
        model, n_q = about.model, about.model.n_q
        if duration is None:
            oscillates = abs(value.imag) > OSCILLATES * abs(value.real) and value.imag
            rate = abs(value.imag) / (4.0 * np.pi) if oscillates else abs(value) / 3.0
            is_zero = abs(value) <= ZERO * np.abs(values).max()
            duration = 1.0 if is_zero else float(np.clip(1.0 / rate, *DURATIONS))
        positive(duration, "duration")
        t = np.linspace(0.0, duration, 1 + max(MIN_STEPS, round(duration * STEPS_PER_SECOND)))
        change = about.directions @ vectors[:, number]
        waves = np.real(np.outer(change, np.exp(value * t)))
        largest = np.abs(waves[:n_q]).max() or np.abs(waves).max()
        rates = np.concatenate((model.rhs(about.t, about.x, about.p, about.r)[:n_q], np.zeros(model.n_x - n_q)))
        states = about.x[:, np.newaxis] + np.outer(rates, t) + amplitude / largest * waves
        inputs = None
        if about.r is not None:  # their rates, which follow them, are zero
            own = set(model.layout.own_inputs)
            held = about.r if is_mapping(about.r) else dict(zip(model.inputs, np.asarray(about.r), strict=True))
            inputs = {name: value for name, value in named(held, model.inputs, "input").items() if name in own}
        return trajectory(model, about.t + t, states, parameters=about.p, inputs=inputs)

    def __len__(self) -> int:
        return len(self.matrices)

    def __getitem__(self, number: Any) -> Any:
        return self.matrices[number]


def linearize(
    model: Kernel,
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
    t, state = finite_number(t, "t"), named_array(x, model.states, {}, "state")
    names = () if outputs is None else _names(model, outputs)
    n_q, n_r = model.n_q, model.n_r
    n_qi = model.layout.n_independent_coordinates
    n_ui, n_z = model.layout.n_independent_speeds, model.n_z
    require_closed(model, t, state, p, r)
    # Phi_q dq + Phi_r dr = 0 and J du + d(J u + b)/dq dq + d(J u + b)/dr dr = 0 give all coordinates and speeds in
    # terms of the independent ones and the inputs. Each array has a column for each entry of dq_i, du_i, dz and dr.
    velocity_by_q, position_by_r, velocity_by_r = model.constraint_partials(t, state, p, r)
    position_by_q = model.position(t, state[:n_q], p, r)[1]
    n_i = n_qi + n_ui + n_z
    free = np.eye(n_i + n_r)
    dq_i, du_i, dz, dr = np.split(free, [n_qi, n_qi + n_ui, n_i])
    known = position_by_q[:, :n_qi] @ dq_i + position_by_r @ dr
    dq = np.vstack((dq_i, eliminate(np.hstack((known, position_by_q[:, n_qi:])), len(free), model.coordinates[n_qi:])))
    constraints, _ = model.velocity(t, state, p, r)
    known = constraints[:, :n_ui] @ du_i + velocity_by_q @ dq + velocity_by_r @ dr
    du = np.vstack((du_i, eliminate(np.hstack((known, constraints[:, n_ui:])), len(free), model.speeds[n_ui:])))
    dx = np.vstack((dq, du, dz))
    rates = model.jacobian(t, state, p, r) @ dx + model.input_jacobian(t, state, p, r) @ dr
    places = [*range(n_qi), *range(n_q, n_q + n_ui), *range(n_q + model.n_u, model.n_x)]
    matrices = [rates[places]]
    if outputs is not None:
        rows = dict(zip(model.states, dx, strict=True))
        if not rows.keys() >= {*names}:
            wrt_state, wrt_inputs = model.output_derivatives(t, state, p, r)
            rows.update(zip(model.outputs, wrt_state @ dx + wrt_inputs @ dr, strict=True))
        matrices.append(np.reshape([rows[name] for name in names], (len(names), len(free))))
    return Linearization(
        tuple(part for matrix in matrices for part in (matrix[:, :n_i], matrix[:, n_i:])),
        tuple(model.states[place] for place in places),
        model.inputs,
        names,
        OperatingPoint(model, t, np.asarray(state, dtype=float), p, r, dx[:, :n_i]),
    )


def _names(model: Kernel, outputs: Sequence[Any]) -> tuple[str, ...]:
    """The names of outputs and states that are given by name or as SymPy's functions of time."""
    names = tuple(map(name_of, listed(outputs, "outputs is a sequence of names")))
    for name in names:
        if name not in model.outputs and name not in model.states:
            raise ModelError(
                f"There is no output {name!r}; there are {', '.join(model.outputs) or 'none'}, and the states "
                f"{', '.join(model.states)}."
            )
    model.require_output_derivatives([name for name in names if name in model.outputs])
    return names


def state_space(
    model: Kernel,
    t: float,
    x: ArrayLike,
    p: Values | None = None,
    r: Values | None = None,
    *,
    outputs: Sequence[Any] | None = None,
) -> Linearization:
    """The matrices A, B, C and D of the linear state space model near a state that satisfies the constraints.

    As `linearize`, always with outputs: d(q_i, u_i, z)/dt = A d(q_i, u_i, z) + B dr, dy = C d(q_i, u_i, z) + D dr.

    Parameters
    ----------
    t, x, p, r
        As for `rhs`.
    outputs : sequence of str, optional
        Names of outputs, and of states, dependent ones too; by default all states, and then all outputs.

    Returns
    -------
    Linearization
        A, B, C and D, as SciPy's and control's state space models take them, with names.

    Raises
    ------
    ModelError, SimulationError
        As for `linearize`.

    Source: that of `linearize`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> from scipy.signal import StateSpace
    >>> four_bar = fb.load("four_bar")
    >>> matrices = four_bar.state_space(0.0, four_bar.initial_state(), outputs=["q3"])
    >>> StateSpace(*matrices).C.shape
    (1, 2)
    """
    return linearize(model, t, x, p, r, outputs=(*model.states, *model.outputs) if outputs is None else outputs)
