"""The position constraints as functions of the dependent coordinates, and how these are found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.dependent import SINGULAR
from fourbar_codegen.kernel.kernel import Kernel

__all__ = ["Loops", "nearest_closed"]

Floats = NDArray[np.float64]

CLOSED = 1e-10
"""Configurations count as closed if the constraints are violated by no more than this share of their scales."""

ROUNDING = 4.0 * np.finfo(float).eps
"""By what share of their scales rounding errors violate them in any case."""

TURN = 2.0 * np.pi

SAME = 1e-9
"""Positions and slopes that a whole turn changes by no more are those of an angle."""

DEAD = 1e-5
"""Where singular values of slopes have this ratio, two ways to close the loops meet: positions are known to half of all
digits, and speeds to none."""

MAX_CORRECTIONS = 30


@dataclass(frozen=True)
class Loops:
    """The position constraints as functions of the dependent coordinates alone.

    Attributes
    ----------
    model : Kernel
    t : float
    q_i : ndarray
        The independent coordinates.
    p, r : ndarray or None
        Parameters and inputs.
    """

    model: Kernel
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

    @cached_property
    def angles(self) -> NDArray[np.bool_]:
        """Which coordinates the constraints have as angles: whole turns of them change nothing; shape (n_q,)."""
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, self.model.n_q)
        known = np.column_stack(self.model.position(self.t, q, self.p, self.r))
        turned = [
            np.column_stack(self.model.position(self.t, q + TURN * column, self.p, self.r))
            for column in np.eye(self.model.n_q)
        ]
        return np.array([np.allclose(there, known, rtol=SAME, atol=SAME) for there in turned], dtype=bool)

    def scale(self, q: Floats) -> Floats:
        """What each constraint's terms amount to, by which violations are measured, shape (n_h,)."""
        at_rest = np.zeros(self.model.n_x - self.model.n_q)
        scale: Floats = self.model.constraint_scale(self.t, np.concatenate((q, at_rest)), self.p, self.r)[0]
        return scale

    def hold(self, dependent: Floats) -> NDArray[np.bool_]:
        """Which constraints hold, each by its own scale, shape (n_h,).

        The scales are those of rounding errors, which grow with an angle beyond all bounds. What counts is that of
        angles within a turn: a solver that has lost its way may end at one of 1e16, where nothing means anything.
        Rounding errors count for what they are where the independent angles are large.
        """
        if not np.isfinite(dependent).all():
            return np.zeros(self.model.n_h, dtype=bool)
        q = self.coordinates(dependent)
        if np.abs(q).max() <= TURN:
            allowed = CLOSED * self.scale(q)
        else:
            within = np.where(self.angles, np.remainder(q + np.pi, TURN) - np.pi, q)
            with_own = np.concatenate((self.q_i, within[len(self.q_i) :]))
            allowed = CLOSED * self.scale(within) + ROUNDING * self.scale(with_own)
        return np.asarray((np.abs(self.residual(dependent)) <= allowed) & np.isfinite(allowed))

    def uncertainty(self, dependent: Floats) -> Floats:
        """How far rounding errors of the constraints move a solution, shape (n,)."""
        slopes = np.abs(np.linalg.pinv(self.jacobian(dependent)))
        moved: Floats = slopes @ (ROUNDING * self.scale(self.coordinates(dependent)))
        return moved

    def are_closed(self, dependent: Floats) -> bool:
        """Whether all constraints hold."""
        return bool(self.hold(dependent).all())

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


def nearest_closed(model: Kernel, t: float, q: Floats, p: Floats | None, r: Floats | None) -> Floats | None:
    """Coordinates that satisfy the position constraints, by the Gauss-Newton method from some that need not.

    All of them move, by the shortest change, so that redundant constraints are as good as others. None where it does
    not come to an end.
    """
    loops = Loops(model, t, np.empty(0), p, r)
    for _ in range(MAX_CORRECTIONS):
        residual, slopes = loops.position(q)
        if not (np.isfinite(residual).all() and np.isfinite(slopes).all()):
            return None
        if loops.are_closed(q):
            return q
        q = q - np.linalg.lstsq(slopes, residual, rcond=SINGULAR)[0]
    return None
