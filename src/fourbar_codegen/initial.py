"""Consistent initial states: independent values in, a state with the loops closed out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import Values, named_array
from fourbar_codegen.elimination import INDEPENDENT, SINGULAR, row_sizes, solve_dependent
from fourbar_codegen.errors import AssemblyError, ModelError
from fourbar_codegen.progress import Progress
from fourbar_codegen.runtime.integrator import Ode
from fourbar_codegen.simulate import input_sources

if TYPE_CHECKING:
    from fourbar_codegen.assembly import AssemblyModes
    from fourbar_codegen.compiled import CompiledModel
    from fourbar_codegen.simulate import InputSource

__all__ = ["Loops", "given", "initial_state", "initial_states", "nearest_closed"]

Floats = NDArray[np.float64]

# Configurations count as closed if the constraints are violated by no more than this share of their scales.
CLOSED = 1e-10
CORRECTIONS = 30
# Guesses tried before a loop is said not to close, beside the one that was given.
FURTHER_GUESSES = 40
# Velocity constraints count as satisfied to this share of their terms.
CONSISTENT = 1e-10


def given(
    model: CompiledModel,
    coordinates: Values | None,
    speeds: Values | None,
    t: float,
    guess: Values | None,
    parameters: Values | None,
    inputs: Mapping[Any, InputSource] | None,
) -> tuple[Loops, Floats, Floats]:
    """The loops to be closed, the independent speeds, and the guess of the dependent coordinates."""
    n_qi = model.n_q - model.manifest["n_dependent_coordinates"]
    n_ui = model.n_u - model.manifest["n_dependent_speeds"]
    initial = model.manifest["initial"]
    p = model.parameter_vector(parameters)
    q_i = named_array(coordinates, model.coordinates[:n_qi], initial, "independent coordinate")
    u_i = named_array(speeds, model.speeds[:n_ui], initial, "independent speed")
    dependent = model.coordinates[n_qi:]
    start = named_array(guess, dependent, {**dict.fromkeys(dependent, 0.0), **initial}, "dependent coordinate")
    return Loops(model, t, q_i, p, _inputs_at(model, t, p, inputs)), u_i, start


def initial_state(loops: Loops, u_i: Floats, start: Floats) -> Floats:
    """A state that satisfies all constraints; see `CompiledModel.initial_state`."""
    q = loops.coordinates(_close(loops, start) if loops.model.n_h else start)
    return np.concatenate((q, _dependent_speeds(loops, q, u_i)))


def initial_states(loops: Loops, u_i: Floats, start: Floats) -> AssemblyModes:
    """All states with these independent values; see `CompiledModel.initial_states`."""
    from fourbar_codegen.assembly import DISTINCT, AssemblyModes, closed_coordinates

    model = loops.model
    with Progress(f"{model.name}: ways to close the loops") as progress:
        found, is_complete = closed_coordinates(loops, start, progress) if model.n_h else ([start], True)
    states = []
    for dependent in found:
        q = loops.coordinates(dependent)
        try:
            u = _dependent_speeds(loops, q, u_i, DISTINCT)  # in a dead point, positions are right to half of all digits
        except UndeterminedSpeedsError:
            u = np.concatenate((u_i, np.full(model.n_u - len(u_i), np.nan)))
        states.append(np.concatenate((q, u)))
    return AssemblyModes(model, loops.t, np.reshape(states, (len(states), model.n_x)), is_complete, loops.p, loops.r)


def _inputs_at(
    model: CompiledModel, t: float, p: Floats | None, inputs: Mapping[Any, InputSource] | None
) -> Floats | None:
    """The inputs for what depends on configuration and motion alone: those that prescribe it count.

    A callable may ask for the state, which is not known yet; it cannot prescribe a motion, and 0 stands for it.
    """
    if inputs is None:
        return None  # the expressions
    sources = [0.0 if callable(source) else source for source in input_sources(model, inputs)]
    r = Ode(model, p, sources).input_values(t, np.zeros(model.n_x))
    entries = model.manifest["inputs"]
    missing = dict.fromkeys(entries[i]["of"] for i in model.manifest["moving_inputs"] if np.isnan(r[i]))
    if missing:
        raise ModelError(f"Input {', '.join(missing)} has no value at t = {t:g}: give a source of it in inputs=.")
    return np.nan_to_num(r)


@dataclass(frozen=True)
class Loops:
    """The position constraints as functions of the dependent coordinates alone.

    Attributes
    ----------
    model : CompiledModel
    t : float
    q_i : ndarray
        The independent coordinates.
    p, r : ndarray or None
        Parameters and inputs.
    """

    model: CompiledModel
    t: float
    q_i: Floats
    p: Floats | None
    r: Floats | None

    @property
    def n_dependent(self) -> int:
        """Number of dependent coordinates."""
        return self.model.n_q - len(self.q_i)

    def coordinates(self, dependent: Floats) -> Floats:
        """All of them."""
        return np.concatenate((self.q_i, dependent))

    def position(self, dependent: Floats) -> tuple[Floats, Floats]:
        """The residual and its derivatives with respect to the dependent coordinates."""
        if not np.isfinite(dependent).all():  # a step of a solver that has lost its way
            return np.full(self.model.n_h, np.inf), np.full((self.model.n_h, len(dependent)), np.inf)
        error, slopes = self.model.position(self.t, self.coordinates(dependent), self.p, self.r)
        return error, slopes[:, len(self.q_i) :]

    def residual(self, dependent: Floats) -> Floats:
        """The residual alone."""
        return self.position(dependent)[0]

    def jacobian(self, dependent: Floats) -> Floats:
        """Its derivatives alone."""
        return self.position(dependent)[1]

    def are_closed(self, dependent: Floats) -> bool:
        """Whether all constraints hold, each by its own scale."""
        if not np.isfinite(dependent).all():
            return False
        q = self.coordinates(dependent)
        return _holds(self.model, self.t, q, self.model.position(self.t, q, self.p, self.r)[0], self.p, self.r)

    def newton(self, dependent: Floats) -> Floats | None:
        """A solution where each step halves the residual at least, until rounding errors are left; None elsewhere."""
        error, slopes = self.position(dependent)
        while len(dependent) == self.model.n_h:
            size = np.abs(error).max()
            try:
                tried = dependent - np.linalg.solve(slopes, error)
            except np.linalg.LinAlgError:
                return None
            error_there, slopes_there = self.position(tried)
            if not np.abs(error_there).max() < 0.5 * size:
                return dependent if self.are_closed(dependent) else None
            dependent, error, slopes = tried, error_there, slopes_there
        return None

    def closest(self, begin: Floats) -> Floats:
        """Where SciPy's solvers end that begin there; the loops may be open."""
        from scipy.optimize import fsolve, leastsq

        # The solvers' own verdict compares steps; what counts here is the residual.
        # fsolve needs as many constraints as unknowns, and these independent: redundant ones are for leastsq.
        for solve in (fsolve, leastsq) if len(begin) == self.model.n_h else (leastsq,):
            derivative = {"fprime" if solve is fsolve else "Dfun": self.jacobian}
            found: Floats = solve(self.residual, begin, xtol=1e-13, full_output=True, **derivative)[0]
            if self.are_closed(found):
                break
        return found

    def search(self, begin: Floats) -> Floats | None:
        """A solution, by Newton's method close to the beginning, else by SciPy's solvers; None if they find none."""
        near = self.newton(begin)
        if near is not None:
            return near
        found = self.closest(begin)
        return found if self.are_closed(found) else None


def _holds(model: CompiledModel, t: float, q: Floats, residual: Floats, p: Floats | None, r: Floats | None) -> bool:
    """Whether the position constraints hold that have this residual, each by its own scale."""
    scale, *_ = model.constraint_scale(t, np.concatenate((q, np.zeros(model.n_u))), p, r)
    return bool((np.abs(residual) <= CLOSED * scale).all() and np.isfinite(scale).all())


def nearest_closed(model: CompiledModel, t: float, q: Floats, p: Floats | None, r: Floats | None) -> Floats | None:
    """Coordinates that satisfy the position constraints, by the Gauss-Newton method from some that need not.

    All of them move, by the shortest change, so that redundant constraints are as good as others. None where it does
    not come to an end.
    """
    for _ in range(CORRECTIONS):
        residual, slopes = model.position(t, q, p, r)
        if not (np.isfinite(residual).all() and np.isfinite(slopes).all()):
            return None
        if _holds(model, t, q, residual, p, r):
            return q
        q = q - np.linalg.lstsq(slopes, residual, rcond=SINGULAR)[0]
    return None


def _close(loops: Loops, start: Floats) -> Floats:
    """Dependent coordinates that satisfy the position constraints, from a guess of them."""
    dependent = loops.search(start)
    if dependent is not None:
        return dependent
    model, q_i = loops.model, loops.q_i
    names = model.coordinates[len(q_i) :]
    generator = np.random.default_rng(0)
    attempts = [loops.closest(start + generator.uniform(-np.pi, np.pi, len(start))) for _ in range(FURTHER_GUESSES)]
    found = loops.closest(start)
    error = loops.residual(found)
    message = (
        f"The loop does not close from the guess {_named(names, start)} with "
        f"{_named(model.coordinates[: len(q_i)], q_i)}: the position constraints keep the residual {error} "
        f"at {_named(names, found)}."
    )
    others = [attempt for attempt in attempts if loops.are_closed(attempt)]
    if others:
        message += (
            f" It closes from other guesses, for instance guess={others[0].round(3).tolist()}; initial_states lists "
            "the ways in which it closes."
        )
    else:
        error = min((error, *map(loops.residual, attempts)), key=lambda e: float(np.abs(e).max()))
        message += (
            f" The loop cannot be closed from {FURTHER_GUESSES} other guesses either; the smallest residual is {error}."
            " Check the parameters (a link may be too long or too short) and the independent coordinates."
        )
    raise AssemblyError(message, error)


class UndeterminedSpeedsError(AssemblyError):
    """The dependent speeds do not follow from the independent ones in a configuration."""


def _dependent_speeds(loops: Loops, q: Floats, u_i: Floats, singular: float = SINGULAR) -> Floats:
    """All speeds: the dependent ones solve J_d u_d = -(J_i u_i + b), and are determined by that."""
    model, n_i = loops.model, len(u_i)
    jacobian, bias = model.velocity(loops.t, np.concatenate((q, np.zeros(model.n_u))), loops.p, loops.r)
    if not model.n_c:
        return u_i
    size = row_sizes(jacobian)
    jacobian, bias = jacobian / size, bias / size[:, 0]
    rank = int(np.linalg.matrix_rank(jacobian, rtol=INDEPENDENT))
    if rank > model.n_u - n_i:
        raise AssemblyError(model.too_few_dependent(f"at {_named(model.coordinates, q)}", rank))
    known = jacobian[:, :n_i] @ u_i + bias
    u_d, determined = solve_dependent(jacobian, n_i, known, singular)
    error = np.abs(jacobian[:, n_i:] @ u_d + known).max()
    terms = max(np.abs(jacobian[:, n_i:]).max() * np.abs(u_d).max(), np.abs(known).max())
    if determined < len(u_d) or not error <= CONSISTENT * terms:
        raise UndeterminedSpeedsError(
            f"The dependent speeds ({', '.join(model.speeds[n_i:])}) do not follow from the independent ones at "
            f"{_named(model.coordinates, q)}: the constraints' Jacobian with respect to them is singular. Start from "
            "another configuration, or choose other independent speeds."
        )
    return np.concatenate((u_i, u_d))


def _named(names: tuple[Any, ...], values: Floats) -> str:
    return ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, values, strict=True)) or "none"
