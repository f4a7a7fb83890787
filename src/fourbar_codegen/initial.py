"""Consistent initial states: independent values in, a state with the loops closed out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.arguments import Values, named_array
from fourbar_codegen.errors import AssemblyError
from fourbar_codegen.runtime.integrator import Ode
from fourbar_codegen.simulate import input_sources

if TYPE_CHECKING:
    from fourbar_codegen.compiled import CompiledModel
    from fourbar_codegen.simulate import InputSource

__all__ = ["initial_state"]

Floats = NDArray[np.float64]

# Configurations count as closed if the dependent coordinates are right to this, in their units.
COORDINATE_TOLERANCE = 1e-10
# Guesses tried before a loop is said not to close, beside the one that was given.
FURTHER_GUESSES = 40
# Singular values of J_d below this share of the largest count as zero.
SINGULAR = 1e-12
# Rows of J count as independent of each other from this share of the largest singular value on; those that are
# redundant on the constraint manifold alone differ by the error of the position.
INDEPENDENT = 1e-6
# Velocity constraints count as satisfied to this share of their terms.
CONSISTENT = 1e-10


def initial_state(
    model: CompiledModel,
    coordinates: Values | None,
    speeds: Values | None,
    *,
    t: float,
    guess: Values | None,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> Floats:
    """A state that satisfies all constraints; see `CompiledModel.initial_state`."""
    n_qi = model.n_q - model.manifest["n_dependent_coordinates"]
    n_ui = model.n_u - model.manifest["n_dependent_speeds"]
    initial = model.manifest["initial"]
    p = model.parameter_vector(parameters)
    q_i = named_array(coordinates, model.coordinates[:n_qi], initial, "independent coordinate")
    u_i = named_array(speeds, model.speeds[:n_ui], initial, "independent speed")
    dependent = model.coordinates[n_qi:]
    start = named_array(guess, dependent, {**dict.fromkeys(dependent, 0.0), **initial}, "dependent coordinate")
    r = _inputs_at(model, t, p, inputs)
    q = _close(model, t, q_i, start, p, r) if model.n_h else np.concatenate((q_i, start))
    return np.concatenate((q, _dependent_speeds(model, t, q, u_i, p, r)))


def _inputs_at(
    model: CompiledModel, t: float, p: Floats | None, inputs: Mapping[Any, InputSource] | None
) -> Floats | None:
    """The inputs for what depends on configuration and motion alone: those that prescribe it count.

    A callable may ask for the state, which is not known yet; it cannot prescribe a motion, and 0 stands for it.
    """
    if inputs is None:
        return None  # the expressions
    sources = [0.0 if callable(source) else source for source in input_sources(model, inputs)]
    return np.nan_to_num(Ode(model, p, sources).input_values(t, np.zeros(model.n_x)))


def _close(model: CompiledModel, t: float, q_i: Floats, start: Floats, p: ArrayLike | None, r: Floats | None) -> Floats:
    """Coordinates that satisfy the position constraints: by Newton's method close to them, else by fsolve."""
    n_i = len(q_i)

    def assemble(dependent: Floats) -> Floats:
        return np.concatenate((q_i, dependent))

    def residual(dependent: Floats) -> Floats:
        return model.position(t, assemble(dependent), p, r)[0]

    def jacobian(dependent: Floats) -> Floats:
        return model.position(t, assemble(dependent), p, r)[1][:, n_i:]

    def is_closed(error: Floats, slopes: Floats) -> bool:
        # In units of the coordinates.
        return bool(np.abs(error).max() <= COORDINATE_TOLERANCE * np.abs(slopes).max())

    def newton(dependent: Floats) -> Floats | None:
        """Where each step halves the residual at least, until rounding errors are left of it; None elsewhere."""
        error, slopes = model.position(t, assemble(dependent), p, r)
        while len(dependent) == model.n_h:
            size = np.abs(error).max()
            try:
                tried = dependent - np.linalg.solve(slopes[:, n_i:], error)
            except np.linalg.LinAlgError:
                return None
            error_there, slopes_there = model.position(t, assemble(tried), p, r)
            if not np.abs(error_there).max() < 0.5 * size:
                return dependent if is_closed(error, slopes) else None
            dependent, error, slopes = tried, error_there, slopes_there
        return None

    def search(begin: Floats) -> tuple[Floats, Floats, bool]:
        from scipy.optimize import fsolve, leastsq

        # The solvers' own verdict compares steps; what counts here is the residual.
        # fsolve needs as many constraints as unknowns, and these independent: redundant ones are for leastsq.
        for solve in (fsolve, leastsq) if len(begin) == model.n_h else (leastsq,):
            derivative = {"fprime" if solve is fsolve else "Dfun": jacobian}
            found = solve(residual, begin, xtol=1e-13, full_output=True, **derivative)[0]
            error, slopes = model.position(t, assemble(found), p, r)
            closed = is_closed(error, slopes)
            if closed:
                break
        return found, error, closed

    near = newton(start)
    if near is not None:
        return assemble(near)
    found, error, closed = search(start)
    if closed:
        return assemble(found)
    generator = np.random.default_rng(0)
    attempts = [search(start + generator.uniform(-np.pi, np.pi, len(start))) for _ in range(FURTHER_GUESSES)]
    message = (
        f"The loop does not close from the guess {_named(model.coordinates[n_i:], start)} with "
        f"{_named(model.coordinates[:n_i], q_i)}: the position constraints keep the residual {error} "
        f"at {_named(model.coordinates[n_i:], found)}."
    )
    others = [f for f, _, ok in attempts if ok]
    if others:
        message += f" It closes from other guesses, for instance guess={others[0].round(3).tolist()}."
    else:
        error = min((error, *(e for _, e, _ in attempts)), key=lambda e: float(np.abs(e).max()))
        message += (
            f" The loop cannot be closed from {FURTHER_GUESSES} other guesses either; the smallest residual is {error}."
            " Check the parameters (a link may be too long or too short) and the independent coordinates."
        )
    raise AssemblyError(message, error)


def _dependent_speeds(
    model: CompiledModel, t: float, q: Floats, u_i: Floats, p: ArrayLike | None, r: Floats | None
) -> Floats:
    """All speeds: the dependent ones solve J_d u_d = -(J_i u_i + b); the least ones where that leaves a choice."""
    n_i = len(u_i)
    jacobian, bias = model.velocity(t, np.concatenate((q, np.zeros(model.n_u))), p, r)
    if not model.n_c:
        return u_i
    rank = np.linalg.matrix_rank(jacobian, rtol=INDEPENDENT)
    if rank > model.n_u - n_i:
        raise AssemblyError(
            f"{rank} velocity constraints are independent of each other at {_named(model.coordinates, q)}, but the "
            f"model has {model.n_u - n_i} dependent speeds ({', '.join(model.speeds[n_i:])}): name one for each."
        )
    known = jacobian[:, :n_i] @ u_i + bias
    u_d = np.linalg.lstsq(jacobian[:, n_i:], -known, rcond=SINGULAR)[0]
    error = np.abs(jacobian[:, n_i:] @ u_d + known).max()
    if not error <= CONSISTENT * max(np.abs(jacobian[:, n_i:]).max() * np.abs(u_d).max(), np.abs(known).max()):
        raise AssemblyError(
            f"The dependent speeds ({', '.join(model.speeds[n_i:])}) do not follow from the independent ones at "
            f"{_named(model.coordinates, q)}: the constraints' Jacobian with respect to them is singular. Start from "
            "another configuration, or choose other independent speeds."
        )
    return np.concatenate((u_i, u_d))


def _named(names: tuple[Any, ...], values: Floats) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, values, strict=True)) or "none"
