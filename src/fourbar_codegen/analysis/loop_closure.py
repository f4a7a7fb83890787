"""The position constraints as functions of the dependent coordinates, and their numerical solution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.arguments import Values
from fourbar_codegen.kernel.dependent import SINGULAR_RTOL
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["Loops", "mechanism_size", "nearest_closed", "require_closed", "row_scales"]

Floats = NDArray[np.float64]

CLOSURE_RTOL = 1e-10
"""Tolerance of closed loops: constraint violations relative to their scales."""

ROUNDING_RTOL = 4.0 * np.finfo(float).eps
"""Constraint violations by rounding errors, relative to their scales."""

TURN = 2.0 * np.pi

PERIOD_RTOL = 1e-9
"""A coordinate is an angle if a whole turn changes residuals and their derivatives by no more than this."""

SINGULAR_RATIO = 1e-5
"""If singular values of the Jacobian have this ratio, the configuration is singular, since two assembly modes meet:
positions are known only to half of all digits, and speeds are undetermined."""

LOOSE_CLOSURE_RTOL = 1e-6
"""Largest constraint violations of a state that is given, relative to their scales."""

MAX_CORRECTIONS = 30

N_SAMPLES = 16
"""Positions at which the sizes of constraints are looked at."""


@dataclass(frozen=True)
class Loops:
    """The position constraints as functions of the dependent coordinates alone.

    Attributes
    ----------
    model : Kernel
    t : float
    q_i : ndarray
        The coordinates that are given: the independent ones, unless `given` names others.
    p, r : ndarray or None
        Parameters and inputs.
    given : tuple of int or None
        Numbers of the given coordinates, in ascending order; None for the first ones. All others are dependent.
    """

    model: Kernel
    t: float
    q_i: Floats
    p: Floats | None
    r: Floats | None
    given: tuple[int, ...] | None = None

    @cached_property
    def dependent(self) -> list[int]:
        """Numbers of the dependent coordinates."""
        given = range(len(self.q_i)) if self.given is None else self.given
        return [number for number in range(self.model.n_q) if number not in given]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the dependent coordinates."""
        return tuple(self.model.coordinates[number] for number in self.dependent)

    @property
    def n_dependent(self) -> int:
        """Number of dependent coordinates."""
        return self.model.n_q - len(self.q_i)

    def coordinates(self, dependent: Floats) -> Floats:
        """All of them."""
        if self.given is None:
            return np.concatenate((self.q_i, dependent))
        q = np.empty(self.model.n_q)
        q[list(self.given)], q[self.dependent] = self.q_i, dependent
        return q

    def position(self, dependent: Floats) -> tuple[Floats, Floats]:
        """The residual and its derivatives with respect to the dependent coordinates."""
        if not np.isfinite(dependent).all():  # a diverging step of a solver
            return np.full(self.model.n_h, np.inf), np.full((self.model.n_h, len(dependent)), np.inf)
        error, slopes = self.model.position(self.t, self.coordinates(dependent), self.p, self.r)
        return error, slopes[:, self.dependent]

    def residual(self, dependent: Floats) -> Floats:
        """The residual alone."""
        return self.position(dependent)[0]

    def jacobian(self, dependent: Floats) -> Floats:
        """Its derivatives alone."""
        return self.position(dependent)[1]

    @cached_property
    def angles(self) -> NDArray[np.bool_]:
        """Which coordinates are angles, of which whole turns do not change the constraints, shape (n_q,)."""
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, self.model.n_q)
        known = np.column_stack(self.model.position(self.t, q, self.p, self.r))
        turned = [
            np.column_stack(self.model.position(self.t, q + TURN * column, self.p, self.r))
            for column in np.eye(self.model.n_q)
        ]
        return np.array([np.allclose(there, known, rtol=PERIOD_RTOL, atol=PERIOD_RTOL) for there in turned], dtype=bool)

    def scale(self, q: Floats) -> Floats:
        """The scale of each constraint, by which violations are measured, shape (n_h,)."""
        at_rest = np.zeros(self.model.n_x - self.model.n_q)
        scale: Floats = self.model.constraint_scale(self.t, np.concatenate((q, at_rest)), self.p, self.r)[0]
        return scale

    def hold(self, dependent: Floats) -> NDArray[np.bool_]:
        """Which constraints are satisfied, each relative to its own scale, shape (n_h,).

        The scales are rounding errors, which grow without bound with angles. So the scale is that of angles within a
        turn, since a diverging solver may end at an angle of 1e16, where residuals have no meaning. Rounding errors of
        large independent angles are added.
        """
        if not np.isfinite(dependent).all():
            return np.zeros(self.model.n_h, dtype=bool)
        q = self.coordinates(dependent)
        if np.abs(q).max() <= TURN:
            allowed = CLOSURE_RTOL * self.scale(q)
        else:
            within = np.where(self.angles, np.remainder(q + np.pi, TURN) - np.pi, q)
            with_own = self.coordinates(within[self.dependent])
            allowed = CLOSURE_RTOL * self.scale(within) + ROUNDING_RTOL * self.scale(with_own)
        return np.asarray((np.abs(self.residual(dependent)) <= allowed) & np.isfinite(allowed))

    def uncertainty(self, dependent: Floats) -> Floats:
        """The change of a solution by rounding errors of the constraints, shape (n,)."""
        slopes = np.abs(np.linalg.pinv(self.jacobian(dependent)))
        moved: Floats = slopes @ (ROUNDING_RTOL * self.scale(self.coordinates(dependent)))
        return moved

    def are_closed(self, dependent: Floats) -> bool:
        """Whether all constraints are satisfied."""
        return bool(self.hold(dependent).all())

    def newton(self, dependent: Floats) -> Floats | None:
        """A solution by Newton's method; None unless each step halves the residual, down to rounding errors."""
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
        """The last iterate of SciPy's solvers; the loops may be open."""
        from scipy.optimize import fsolve, leastsq

        # The solvers' own convergence test compares steps; here the residual decides.
        # fsolve needs as many independent constraints as unknowns; leastsq solves redundant ones.
        for solve in (fsolve, leastsq) if len(begin) == self.model.n_h else (leastsq,):
            derivative = {"fprime" if solve is fsolve else "Dfun": self.jacobian}
            found: Floats = solve(self.residual, begin, xtol=1e-13, full_output=True, **derivative)[0]
            if self.are_closed(found):
                break
        return found

    def search(self, begin: Floats) -> Floats | None:
        """A solution by Newton's method, else by SciPy's solvers; None if they find none."""
        near = self.newton(begin)
        if near is not None:
            return near
        found = self.closest(begin)
        return found if self.are_closed(found) else None


def nearest_closed(model: Kernel, t: float, q: Floats, p: Floats | None, r: Floats | None) -> Floats | None:
    """Coordinates that satisfy the position constraints, by the Gauss-Newton method from given ones.

    All coordinates change, with minimum-norm steps, so constraints may be redundant. None if it does not converge.
    """
    loops = Loops(model, t, np.empty(0), p, r)
    for _ in range(MAX_CORRECTIONS):
        residual, slopes = loops.position(q)
        if not (np.isfinite(residual).all() and np.isfinite(slopes).all()):
            return None
        if loops.are_closed(q):
            return q
        q = q - np.linalg.lstsq(slopes, residual, rcond=SINGULAR_RTOL)[0]
    return None


def mechanism_size(model: Kernel, t: float, q: Floats, p: Floats | None, r: Floats | None) -> float:
    """The extent of the points at a position, by which displacements are measured; 1 where it is not known."""
    drawn = model.drawing(t, np.concatenate((q, np.zeros(model.n_x - model.n_q))), p, r)[0]
    known = drawn[np.isfinite(drawn).all(axis=1)]
    return float(np.ptp(known, axis=0).max()) or 1.0 if len(known) else 1.0


def row_scales(
    model: Kernel, t: float, q: Floats, p: Floats | None, r: Floats | None, scales: Floats
) -> tuple[Floats, Floats]:
    """Typical sizes of the rows of Phi_q, with columns in units of the coordinates, and of J, shapes (n_h,) and (n_c,).

    They are the largest at random positions. At a change point a row vanishes, and its own size would hide that.

    Parameters
    ----------
    model, t, p, r
    q : ndarray, shape (n_q,)
        A position.
    scales : ndarray, shape (n_q,)
        Units of the coordinates.
    """
    generator = np.random.default_rng(0)
    sizes: list[tuple[Floats, Floats]] = []
    for k in range(N_SAMPLES):
        at = q + scales * generator.uniform(-np.pi, np.pi, model.n_q) * bool(k)
        rows = model.position(t, at, p, r)[1] * scales
        jacobian = model.velocity(t, np.concatenate((at, np.zeros(model.n_x - model.n_q))), p, r)[0]
        sizes.append((np.abs(rows).max(axis=1, initial=0.0), np.abs(jacobian).max(axis=1, initial=0.0)))
    positions, velocities = (np.nanmax([size[part] for size in sizes], axis=0, initial=0.0) for part in (0, 1))
    return np.where(positions > 0.0, positions, 1.0), np.where(velocities > 0.0, velocities, 1.0)


def require_closed(model: Kernel, t: float, x: Floats, p: Values | None, r: Values | None) -> None:
    """Raise if the state violates the constraints, since the mechanism cannot move there."""
    positions = model.position_constraints(t, x[: model.n_q], p, r)
    velocities = model.velocity_constraints(t, x, p, r)
    position_scale, _, velocity_scale = model.constraint_scale(t, x, p, r)
    # At rest, speeds are only rounding errors: the scale takes them as 1 at least.
    velocity_scale = velocity_scale + np.abs(model.velocity(t, x, p, r)[0]).sum(axis=1)
    closed = (
        *(np.abs(positions) <= LOOSE_CLOSURE_RTOL * position_scale),
        *(np.abs(velocities) <= LOOSE_CLOSURE_RTOL * velocity_scale),
    )
    if not all(closed):
        q, u = (", ".join(f"{n} = {v:.6g}" for n, v in zip(names, x[start:], strict=False)) for names, start in
                ((model.coordinates, 0), (model.speeds, model.n_q)))  # fmt: skip
        raise ModelError(
            f"The state x violates the constraints at t = {t:g}: Phi(q, t) = {positions} for {q}; "
            f"J u + b = {velocities} for {u}. initial_state() makes states that satisfy them."
        )
