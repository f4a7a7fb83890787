"""Whether a state satisfies the constraints, so that a run may begin there, and whether the motion keeps them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, SimulationError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.evaluator import NOT_CLOSED, OK, is_finite, largest_difference
from fourbar_codegen.runtime.integrator import Ode, Table

__all__ = ["ROUNDING_ATOL", "check_start", "consistent", "is_rounded", "left", "projects"]

Floats = NDArray[np.float64]

PROJECTION_RTOL = 1e-3
"""Largest relative change of the coordinates or speeds by the projection of an initial state."""

N_STATES = 16
"""Number of states of a run at which rates of position constraints are checked."""

TIME_STEP = 1e-6
"""Step of the difference with respect to time, relative to the time, or to a second if it is smaller."""

RATE_RTOL = 1e-5
"""Largest rate of a position constraint, relative to its terms and, per second, to the constraint's scale."""

ROUNDING_ATOL = 1e-12
"""Absolute change of a state that is always accepted as rounding errors."""


def projects(model: Kernel, constraints: str, *, stabilizes: bool = False) -> bool:
    """Whether states are to be projected onto the constraints; `stabilizes` says whether "baumgarte" is allowed."""
    allowed = ("project", "baumgarte", "none") if stabilizes else ("project", "none")
    if not isinstance(constraints, str) or constraints not in allowed:
        raise ModelError(f"constraints must be {' or '.join(map(repr, allowed))}, not {shown(constraints)}.")
    return constraints == "project" and model.n_c + model.n_h > 0


def check_start(model: Kernel, ode: Ode, t: float, state: Floats, p: Floats | None, *, passes: bool = False) -> None:
    """Raise if the first evaluation fails, since an integrator could not even choose a first step.

    Methods that pass singular positions may begin at one.
    """
    if is_finite(state) and is_finite(ode(t, state)):
        return
    r = ode.input_values(t, state)
    if not (passes and all(map(is_finite, model.dynamics(t, state, p, r)))):
        model.rhs(t, state, p, r)


def consistent(ode: Ode, t: float, x0: Floats) -> Floats:
    """The initial state, projected onto the constraints.

    Parameters
    ----------
    ode : Ode
    t : float
        The time of its clock.
    x0 : ndarray, shape (n_x,)

    Returns
    -------
    ndarray, shape (n_x,)

    Raises
    ------
    ModelError
        If it violates them by more than rounding to four digits explains.
    SimulationError
        If the equations cannot be evaluated there.
    """
    status, x = ode.closest(t, x0)
    if status == OK and largest_difference(x, x0) <= ROUNDING_ATOL:
        return x
    t += ode.clock[0]
    if status == NOT_CLOSED or not is_rounded(ode.n_q, ode.n_u, x0, x):
        raise ModelError(
            f"The state x0 = {np.array2string(x0, precision=6, separator=', ')} violates the constraints on "
            + _violated(ode, t, x0, x, is_closed=status == OK)
            + "CompiledModel.initial_state() makes consistent states; constraints='none' takes x0 as it is, unless the "
            "method is ALI3P, or IDA in a formulation other than index-1."
        )
    if status != OK:
        raise SimulationError(ode.explain(status, t, x0))
    return x


def _violated(ode: Ode, t: float, x0: Floats, x: Floats, *, is_closed: bool) -> str:
    """Which constraints a state violates, by how much the nearest consistent one differs, and what prescribes it."""
    n_q = ode.n_q
    positions = not (is_closed and is_rounded(n_q, ode.n_u, x0, np.concatenate((x[:n_q], x0[n_q:]))))
    what = "positions" if positions else "velocities (those on positions are satisfied)"
    change = np.abs(x - x0)[: n_q if positions else None].max()
    text = f"{what}: the nearest consistent state differs by {change:.2g}. " if is_closed else f"{what}. "
    r, entries = ode.input_values(t, x0), ode.layout.inputs
    order = 0 if positions else 1
    given = [
        f"{entry.name} = {r[i]:.6g}{' (the slope of its table)' if order and entry.of in _tables(ode) else ''}"
        for i, entry in enumerate(entries)
        if entry.is_prescribed and entry.order == order
    ]
    if given:
        text += f"At t = {t:g} the prescribed motion has {', '.join(given)}, which x0 has to fit. "
    return text


def _tables(ode: Ode) -> set[str]:
    """The inputs that are interpolated."""
    pairs = zip(ode.layout.inputs, ode.sources, strict=True)
    return {entry.of for entry, source in pairs if isinstance(source, Table)}


def left(model: Kernel, ode: Ode, times: Floats, states: Floats, p: Floats | None) -> str:
    """A sentence if the motion does not keep a position constraint, and only projection did; else an empty text.

    A Model checks this at random states. Here it is checked at some states of a run, given in columns: Phi_q q' + Phi_t
    must be zero, up to the error of the differences for Phi_t.
    """
    n_q, prescribed, every = model.n_q, bool(model.layout.prescribed_places), len(times) // N_STATES + 1
    for t, x in zip(times[::every], states.T[::every], strict=True):
        r, step = ode.input_values(t, x), TIME_STEP * max(abs(t), 1.0)
        rates, slopes = ode(t, x)[:n_q], model.position(t, x[:n_q], p, r)[1]
        ahead, behind = (
            model.position(time, x[:n_q], p, ode.input_values(time, x) if prescribed else r)[0]
            for time in (t + step, t - step)
        )
        of_time = (ahead - behind) / (2.0 * step)
        scale, *_ = model.constraint_scale(t, x, p, r)
        terms = np.abs(slopes) @ np.abs(rates) + np.abs(of_time) + scale
        excess = np.abs(slopes @ rates + of_time) - RATE_RTOL * terms
        if (excess > 0.0).any():
            return (
                f"The velocity constraints do not keep holonomic constraint {int(np.argmax(excess)) + 1} at zero: at "
                f"t = {t:.6g} s, its rate is {(slopes @ rates + of_time)[np.argmax(excess)]:.3g}. Add its rate, "
                "Phi.diff(t), to them; or let a System derive the rates of its holonomic constraints, as it does where "
                "velocity_constraints is not set."
            )
    return ""


def is_rounded(n_q: int, n_u: int, x0: Floats, x: Floats) -> Any:
    """Whether a state, or each of the states in rows, equals a consistent one up to rounding to four digits."""
    moved = np.abs(x - x0)
    if (moved <= ROUNDING_ATOL).all():
        return np.ones(x0.shape[:-1], dtype=bool)[()]
    # Scales: at most 1 for coordinates, since whole turns of angles do not count; less if all values are small.
    size = np.empty_like(x0)
    for part in (slice(None, n_q), slice(n_q, n_q + n_u), slice(n_q + n_u, None)):
        size[..., part] = np.minimum(1.0, np.abs(x0[..., part]).max(axis=-1, keepdims=True, initial=0.0))
    size[..., n_q:] = np.maximum(size[..., n_q:], np.abs(x0[..., n_q:]))
    return (moved <= PROJECTION_RTOL * size + ROUNDING_ATOL).all(axis=-1)
