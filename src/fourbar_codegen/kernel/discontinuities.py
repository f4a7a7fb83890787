"""Discontinuities in time: their detection, and the effect of velocity jumps.

Integrators assume that x' is smooth within a step. Steps therefore end at the points of input tables, and where a
condition in an expression changes (see `breakpoints`). If the rate of a prescribed motion jumps, the speeds jump: an
impulse acts through the constraints, and through the bodies that the motion carries.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import SimulationError
from fourbar_codegen.runtime.enumerations import Threshold
from fourbar_codegen.runtime.integrator import Ode, Run, Table

__all__ = [
    "Boundary",
    "Discontinuity",
    "Pieces",
    "boundaries",
    "boundary",
    "discontinuities",
    "jumping_inputs",
    "speeds_after",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Discontinuity:
    """A time of a jump or a kink.

    Attributes
    ----------
    t, until : float
        The time; or the first and last of several times that differ by rounding errors.
    moves : bool
        Whether a position or velocity may jump; otherwise only forces, and speeds are continuous.
    rounding : float
        Rounding error of the time in conditions.
    varied : bool
        Whether a velocity that does not jump is treated as one that does, since its derivatives may jump: those of a
        prescribed motion whose amplitude is zero, for instance.
    """

    t: float
    until: float
    moves: bool
    rounding: float
    varied: bool = False


@dataclass(frozen=True)
class Boundary:
    """How a run passes a discontinuity.

    Attributes
    ----------
    end, begin : float
        End of one step and start of the next: equal, or neighbouring if the speeds jump.
    last, first : float
        The last time of the values before, and the first time of the values after.
    """

    end: float
    begin: float
    last: float
    first: float


def discontinuities(ode: Ode, begin: float, end: float, *, varied: bool = False) -> list[Discontinuity]:
    """The discontinuities between two times, both included, in the order of the run.

    Parameters
    ----------
    ode : Ode
        With parameters and inputs bound.
    begin, end : float
    varied : bool, optional
        Whether the run is differentiated: velocities then count as jumping that jump with other values of parameters
        and inputs.

    Returns
    -------
    list of Discontinuity
    """
    if not (ode.n_breakpoints or ode.has_tables):
        return []
    n_moves = ode.layout.breakpoints.n_motion_breakpoints
    known = {t: number < n_moves for number, t in reversed(list(enumerate(ode.breakpoints().tolist())))}
    for entry, source in zip(ode.layout.inputs, ode.sources, strict=True):
        if isinstance(source, Table):
            moves = source.jumps(varied) if entry.order == 1 else np.zeros(len(source.times), dtype=bool)
            bends = source.bends(varied)
            for t, jumps in zip(source.times[bends].tolist(), moves[bends].tolist(), strict=True):
                known[t] = known.get(t, False) or jumps
    low, high = min(begin, end), max(begin, end)
    within = sorted((t for t in known if low <= t <= high), reverse=end < begin)
    found: list[Discontinuity] = []
    for t in within:
        # of the latest time of the run, or of itself if that has no end
        same = Threshold.SAME_SPACINGS * math.ulp(max(abs(begin), abs(end if math.isfinite(end) else t)))
        if found and abs(t - found[-1].until) <= same:
            found[-1] = Discontinuity(found[-1].t, t, found[-1].moves or known[t], same)
        else:
            found.append(Discontinuity(t, t, known[t], same))
    return [replace(at, varied=at.moves) for at in found] if varied else found


def boundary(ode: Ode, at: Discontinuity, towards: float, x: Floats) -> Boundary:
    """How a run passes a discontinuity.

    If speeds jump, the value at the time itself belongs to one side or to neither: for tables to the interval between
    their ends, for a Piecewise to the branch whose condition holds; SymPy's Heaviside has the mean of both.

    Parameters
    ----------
    ode : Ode
    at : Discontinuity
    towards : float
        Infinity with the sign of the direction of the run.
    x : ndarray, shape (n_x,)
        A state of the run before the discontinuity.

    Returns
    -------
    Boundary
    """
    rounding = math.copysign(at.rounding, towards)
    before, after = at.t - rounding, at.until + rounding
    if at.moves:
        prescribed = _Prescribed(ode, x)
        jumping = prescribed.velocities(before, after)
        if at.varied:
            jumping.append(prescribed.derivatives(before, after))
        jumping = [(value, jumped) for value, jumped in jumping if jumped.any()]
        if jumping and not np.isfinite(prescribed.inputs(at.t)).all():  # as the derivative of a square root at zero
            return Boundary(before, after, before, after)
        if jumping:
            sides = [_sides(value, before, at.t, after)[:, jumped] for value, jumped in jumping]
            is_before, is_after = (bool(side.all()) for side in np.hstack(sides))
            end, begin = at.t if is_before else before, at.until if is_after else after
            return Boundary(end, begin, end, begin)
    return Boundary(at.t, at.until, before, after)


def snapped(times: Floats, marks: Sequence[Discontinuity]) -> Floats:
    """Times of samples; those that differ from discontinuities by rounding errors are at these."""
    low = np.array([min(at.t, at.until) - at.rounding for at in marks])
    order = np.argsort(low)
    place = order[np.maximum(np.searchsorted(low[order], times, side="right") - 1, 0)]
    high = np.array([max(at.t, at.until) + at.rounding for at in marks])
    return np.where((low[place] <= times) & (times <= high[place]), np.array([at.t for at in marks])[place], times)


def speeds_after(ode: Ode, at: Boundary, x: Floats) -> Floats | None:
    """The speeds after a boundary, shape (n_u,); None if they do not jump.

    With the kinetic energy T = u^T M u / 2 + m(q, t)^T u + T_0 and the constraints J u + b(q, t) = 0, jumps of m and b
    at fixed positions give

        M (u_+ - u_-) = -(m_+ - m_-) + J^T Lambda,    J (u_+ - u_-) = -(b_+ - b_-)

    with the impulses Lambda of the constraints: they change the generalized momenta dT/du.

    Parameters
    ----------
    ode : Ode
    at : Boundary
    x : ndarray, shape (n_x,)
        The state before the boundary.

    Raises
    ------
    SimulationError
        If positions jump, which no finite force can cause, or if no speeds satisfy the constraints afterwards.

    Source: F. Pfeiffer, C. Glocker, *Multibody Dynamics with Unilateral Contacts*, Wiley, 1996, section 8.2.
    """
    prescribed = _Prescribed(ode, x)
    for name in prescribed.jumping_positions(at.last, at.first):
        raise SimulationError(
            f"{name} jumps at t = {at.first:.9g}, which no finite force can cause: prescribe a continuous motion."
        )
    momentum, bias = (
        np.where(jumped, value(at.first) - value(at.last), 0.0)
        for value, jumped in prescribed.velocities(at.last, at.first)
    )
    if not (momentum.any() or bias.any()):
        return None
    mass_matrix, jacobian = prescribed.matrices(at.first)
    # Speeds are scaled by their inertia, constraints by the norm of their row.
    speed = 1.0 / np.sqrt(_positive(np.diag(mass_matrix)))
    row = 1.0 / _positive(np.linalg.norm(jacobian * speed, axis=1))
    scaled = row[:, np.newaxis] * jacobian * speed
    none = np.zeros((len(row), len(row)))
    matrix = np.block([[speed[:, np.newaxis] * mass_matrix * speed, -scaled.T], [scaled, none]])
    wanted = np.concatenate([-speed * momentum, -row * bias])
    change = np.linalg.lstsq(matrix, wanted, rcond=None)[0][: len(speed)]
    if (np.abs(scaled @ change + row * bias) > Threshold.JUMP_RTOL * np.abs(wanted).max()).any():
        raise SimulationError(
            f"The rates of prescribed motions jump at t = {at.first:.9g}, and no speeds satisfy the velocity "
            "constraints after it: the motions contradict each other."
        )
    found: Floats = x[ode.n_q : ode.n_q + ode.n_u] + speed * change
    return found


def jumping_inputs(ode: Ode, at: Boundary, x: Floats) -> tuple[int, ...]:
    """The inputs that make speeds jump; none if an expression of time in the model does so too."""
    if _jump_by_the_model(ode, at, x):
        return ()
    moving = np.array(ode.layout.prescribed_places, dtype=int)

    def inputs(t: float) -> Floats:
        found: Floats = ode.input_values(t, x)[moving]
        return found

    jumped = _jumped(inputs, np.abs(inputs(at.last)) + np.abs(inputs(at.first)), at.last, at.first)
    return tuple(moving[jumped].tolist())


def _jump_by_the_model(ode: Ode, at: Boundary, x: Floats) -> bool:
    """Whether speeds jump by an expression of time in the model, other than by inputs."""
    velocities = _Prescribed(ode, x, held=at.last).velocities(at.last, at.first)
    return any(jumped.any() for _, jumped in velocities)


def _positive(values: Floats) -> Floats:
    return np.where(values > 0.0, values, 1.0)


OfTime = Callable[[float], Floats]


def _jumped(value: OfTime, size: Floats | float, before: float, after: float) -> NDArray[np.bool_]:
    """Which entries jump between two neighbouring times, and do not only change continuously."""
    step = after - before
    earlier, at, then, later = (value(t) for t in (before - step, before, after, after + step))
    around = np.abs(at - earlier) + np.abs(later - then)
    jumped: NDArray[np.bool_] = np.abs(then - at) > Threshold.JUMP_RTOL * size + Threshold.STEADY_RATIO * around
    return jumped


def _sides(value: OfTime, before: float, at: float, after: float) -> NDArray[np.bool_]:
    """Whether the entries at a time are those before a jump there, and those after it, shape (2, n).

    They change until then as they do between neighbouring times on either side.
    """
    step = after - before
    earlier, left, here, right, later = (value(t) for t in (before - step, before, at, after, after + step))
    around = np.abs(left - earlier) + np.abs(later - right)
    to_left, to_right = np.abs(here - left), np.abs(here - right)
    rtol = Threshold.JUMP_RTOL
    return np.array([to_left <= rtol * to_right + around, to_right <= rtol * to_left + around])


class _Prescribed:
    """Prescribed motions at a state, as functions of time."""

    def __init__(self, ode: Ode, x: Floats, held: float | None = None) -> None:
        """With the inputs of each time, or held at those of one."""
        self.ode, self.model, self.p, self.x, self.held = ode, ode.evaluator, ode.parameters, x, held
        self.at_rest = np.concatenate([x[: ode.n_q], np.zeros(ode.n_x - ode.n_q)])

    def inputs(self, t: float) -> Floats:
        return self.ode.input_values(t if self.held is None else self.held, self.x)

    def matrices(self, t: float) -> tuple[Floats, Floats]:
        """M and J."""
        r = self.inputs(t)
        return self.model.dynamics(t, self.x, self.p, r)[1], self.model.velocity(t, self.x, self.p, r)[0]

    def bias(self, t: float) -> Floats:
        """The vector b in J u + b = 0, shape (n_c,)."""
        return self.model.velocity(t, self.x, self.p, self.inputs(t))[1]

    def kinetic_energy(self, t: float, x: Floats) -> float:
        return float(self.model.energy(t, x, self.p, self.inputs(t))[0])

    def velocities(self, before: float, after: float) -> list[tuple[OfTime, NDArray[np.bool_]]]:
        """The momentum m of prescribed motions, shape (n_u,), and b; with the entries that jump."""
        mass = np.diag(self.matrices(after)[0])
        # T >= 0, so m = 0 if T_0 = 0. With these speeds, both parts of T have the same magnitude.
        carried = max(self.kinetic_energy(t, self.at_rest) for t in (before, after))
        speeds = np.sqrt(2.0 * max(carried, 0.0) / np.where(mass > 0.0, mass, np.inf))

        def momentum(t: float) -> Floats:
            """The derivative of T, which is quadratic in u, at u = 0."""
            found = np.zeros(len(speeds))
            for i in np.flatnonzero(speeds):
                change = np.zeros(len(self.x))
                change[self.ode.n_q + i] = speeds[i]
                energies = [self.kinetic_energy(t, self.at_rest + sign * change) for sign in (1.0, -1.0)]
                found[i] = (energies[0] - energies[1]) / (2.0 * speeds[i])
            return found

        measure = self.model.constraint_scale(after, self.x, self.p, self.inputs(after))[2]
        sizes = ((momentum, mass * speeds), (self.bias, measure))
        return [(value, _jumped(value, size, before, after)) for value, size in sizes]

    def derivatives(self, before: float, after: float) -> tuple[OfTime, NDArray[np.bool_]]:
        """What the rates' derivatives jump with: those with respect to parameters, and intervals of tables."""
        tables = [source for source in self.ode.sources if isinstance(source, Table)]

        def value(t: float) -> Floats:
            intervals = [table.interval(t) for table in tables]
            return np.append(self.model.default_input_partials(t, self.p), intervals)

        size = np.abs(value(before)) + np.abs(value(after))
        return value, _jumped(value, size, before, after)

    def jumping_positions(self, before: float, after: float) -> list[str]:
        """Names of the motions, constraints and points that jump."""
        q, entries = self.x[: self.ode.n_q], self.ode.layout.inputs
        places = [place for place, entry in enumerate(entries) if entry.name in self.ode.layout.has_rates]

        tables = [place for place, source in enumerate(self.ode.sources) if isinstance(source, Table)]
        held = self.inputs(before)[tables]

        def inputs(t: float) -> Floats:
            """With tables held, which are continuous: where they pass zero, rounding errors would look like jumps."""
            r = self.inputs(t)
            r[tables] = held
            return r

        def motions(t: float) -> Floats:
            return inputs(t)[places]

        def constraints(t: float) -> Floats:
            return self.model.position(t, q, self.p, inputs(t))[0]

        def points(t: float) -> Floats:
            return self.model.drawing(t, self.x, self.p, inputs(t))[0].ravel()

        jumped = _jumped(motions, np.abs(motions(before)) + np.abs(motions(after)), before, after)
        names = [f"Input {entries[places[i]].name}" for i in np.flatnonzero(jumped)]
        measure = self.model.constraint_scale(after, self.x, self.p, self.inputs(after))[0]
        if _jumped(constraints, measure, before, after).any():
            names.append("A constraint")
        if _jumped(points, np.abs(points(after)).max(initial=0.0), before, after).any():
            names.append("The position of a point")
        return names


class Pieces:
    """The pieces of a run between discontinuities: steps end there, and speeds may jump.

    Parameters
    ----------
    ode : Ode
    span : (float, float)
    later : list of Discontinuity
        The discontinuities in the span, at least one.
    varied : mapping of str to Ode
        For parameters with respect to which the run is differentiated, the right-hand side with another value.

    Attributes
    ----------
    unknown : set of str
        Those of `varied` that would have made speeds jump, where they do not, by an expression of time in the model:
        derivatives with respect to them leave this out.
    """

    def __init__(
        self,
        ode: Ode,
        span: tuple[float, float],
        later: list[Discontinuity],
        varied: Mapping[str, Ode],
    ) -> None:
        self._ode, self._span, self._varied = ode, span, varied
        self.unknown: set[str] = set()
        self._gaps: list[tuple[float, float, float]] = []
        self._towards = math.copysign(math.inf, span[1] - span[0])
        self._direction = math.copysign(1.0, self._towards)
        self._later = later
        self._next: tuple[Discontinuity, Boundary] | None = None

    @property
    def ahead(self) -> bool:
        """Whether there is another piece after the current one."""
        return self._next is not None

    def begin(self, run: Run) -> None:
        """Make the run stop at the end of its first piece."""
        t, x, at = run.t, run.x, self._later[0]
        if abs(at.t - t) > at.rounding:
            self._enter(run, t, -self._towards, x, jumps=False)
            return
        self._later.pop(0)
        here = boundary(self._ode, at, self._towards, x)
        is_earlier = self._direction * (at.t - t) > 0.0
        if here.begin != here.end and (is_earlier or here.end == at.t):  # the initial state is before the jump
            self._next = at, here
            run.enter(t, t, -self._towards, t)
        else:
            self._enter(run, t, here.first, x, jumps=False)

    def go_on(self, run: Run) -> bool:
        """Continue with the next piece; returns whether the state could be projected onto the constraints there.

        Raises
        ------
        SimulationError
            As `speeds_after`.
        """
        assert self._next is not None
        at, here = self._next
        x, t, jumps = run.x, here.begin, here.begin != here.end
        if at.moves:
            speeds = speeds_after(self._ode, here, x)
            if speeds is None:
                self.unknown.update(name for name, ode in self._varied.items() if _jump_by_the_model(ode, here, x))
            else:
                x[self._ode.n_q : self._ode.n_q + self._ode.n_u] = speeds
                if not jumps:  # detected only at this state, not at the start of the piece
                    t, jumps = here.first, True
        if t != here.end:
            self._gaps.append((here.end, t, t))
        return self._enter(run, t, here.first, x, jumps=jumps)

    def input_times(self, times: Floats) -> Floats:
        """The times of the inputs that belong to samples: between the ends of two pieces, that of the second one."""
        found = times.copy()
        for end, begin, at in self._gaps:
            found[(min(end, begin) < times) & (times < max(end, begin))] = at
        return found

    def _enter(self, run: Run, t: float, first: float, x: Floats, *, jumps: bool) -> bool:
        end, last, self._next = self._span[1], self._towards, None
        if self._later:
            at = self._later.pop(0)
            here = boundary(self._ode, at, self._towards, x)
            last = here.last
            if self._direction * (here.begin - self._span[1]) > 0.0:  # the run ends before the jump
                self._gaps.append((here.end, here.begin, here.last))
            elif here.end != self._span[1]:
                self._next, end = (at, here), here.end
        return run.enter(t, end, first, last, x if jumps else None)


def boundaries(ode: Ode, begin: float, end: float, x: Floats) -> tuple[list[Boundary], list[Boundary]]:
    """Where speeds jump between two times, and where they only have a kink, for other integrators.

    The second ones include those at both times. x is a state at the first time.
    """
    towards = math.copysign(math.inf, end - begin)
    jumps, kinks = [], []
    for mark in discontinuities(ode, begin, end):
        at = boundary(ode, mark, towards, x)
        if not (mark.moves and at.begin != at.end):
            kinks.append(at)
        elif abs(end - begin) > abs(at.begin - begin) > 0.0:
            jumps.append(at)
    return jumps, kinks
