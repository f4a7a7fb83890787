"""Positions, velocities and accelerations of a mechanism along a drive, in all ways in which its loops close."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.assembly_modes import closed_coordinates
from fourbar_codegen.analysis.continuation import null_space, solve_at, trace
from fourbar_codegen.analysis.drive import Drive, read_drive
from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.analysis.mode_counts import NO_COUNT, mode_counts
from fourbar_codegen.errors import AssemblyError, ModelError
from fourbar_codegen.interface.arguments import Values
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.kinematics import Branch, Kinematics

__all__ = ["kinematics"]

Floats = NDArray[np.float64]

SEEDS = (0.5131, 0.0, 1.0, 0.2417, 0.7689, 0.1201, 0.8773, 0.3718, 0.6329)
"""Places along the drive, of its whole way, where assembly modes are searched: unlikely to be singular."""

SAME_ATOL = 1e-6
"""Largest distance of scaled coordinates that are the same."""

MARGIN = 0.2
"""Curves are followed beyond the ends of the drive, since these may be dead points."""

MAX_CHORD_ERROR = 0.05
"""Largest distance of a position from a branch that is drawn straight between the points that were traced."""

AT_LIMIT_ATOL = 1e-9
"""Largest distance of a value from a dead point that is at it."""

CHANGE_POINT_RATIO = 0.0025
"""Ratio of singular values, of the constraints with the drive held, near a change point."""

BESIDE = (0.02, 0.026, 0.006, 0.002, 0.0006, 0.0002)
"""Distances of positions on a branch from which the one at a change point between them is interpolated, tried in turn:
there may be another change point at one of them, or the branch may be curved too much. Rounding errors of accelerations
grow with the inverse third power of the distance from a change point, so the first is well beyond that of
`CHANGE_POINT_RATIO`.
"""

INTERPOLATION_ATOL = 1e-11
"""Largest residual of the scaled constraints at an interpolated position."""

STEPS = np.array([-4, -3, -2, -1, 1, 2, 3, 4])
WEIGHTS = np.array([-1 / 70, 4 / 35, -2 / 5, 4 / 5, 4 / 5, -2 / 5, 4 / 35, -1 / 70])
"""Of values at multiples of that distance h. The error is h^8 / 70 times the eighth derivative, ..."""

FEWER = np.array([0, 1 / 20, -3 / 10, 3 / 4, 3 / 4, -3 / 10, 1 / 20, 0])
"""... and, without the outermost, h^6 / 20 times the sixth: the difference is an estimate of the larger error."""

SMOOTH_RTOL = 1e-6
"""Largest difference, relative to speeds v, and to accelerations and v^2."""


def kinematics(
    model: Kernel,
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
    path = read_drive(model, drive, rates, accelerations, t=t, parameters=parameters, inputs=inputs)
    if (left := model.n_q - len(path.coordinates)) > model.n_h:
        raise ModelError(
            f"A degree of freedom is left: with {', '.join(path.names)} held, {left} coordinates and {model.n_h} "
            "position constraints are left. Drive another one, too."
        )
    found = _search(path)
    n_q, periods = model.n_q, path.periods

    def distance(part: Floats) -> float:
        away = part[:, :n_q] - path.start / path.scales
        return float(np.abs(_within(away, periods[:n_q])).max(axis=1).min())

    parts = sorted(found.parts, key=distance)
    _check_points(path, parts[0][0])
    branches = tuple(_branch(path, part) for part in parts)
    dead = []
    for fold in found.folds:
        values = dict(zip(model.coordinates, (fold[:n_q] * path.scales).tolist(), strict=True))
        dead.append({**values, **dict(zip(path.names, path.at(fold[n_q]).tolist(), strict=True))})
    drives = dict(zip(path.names, path.values, strict=True))
    return Kinematics(model, drives, branches, tuple(dead), found.is_complete)


def _check_points(path: Drive, z: Floats) -> None:
    """Raise a ModelError if points have no positions where the loops are closed."""
    model, n_q = path.model, path.model.n_q
    x = np.concatenate((z[:n_q] * path.scales, np.zeros(model.n_x - n_q)))
    places = model.drawing(path.t, x, path.p, path.inputs(path.at(z[n_q])))[0]
    lost = [name for name, place in zip(model.points, places, strict=False) if not np.isfinite(place).all()]
    if lost:
        raise ModelError(
            f"The loops close, but {', '.join(lost)} have no positions with these parameters: they are not numbers. Do "
            "the distances of three points on a link make a triangle?"
        )


@dataclass
class _Found:
    """What was found by now.

    Attributes
    ----------
    parts : list of ndarray
        Branches, points in rows.
    folds : list of ndarray
        Points between them.
    is_complete : bool
        Whether the branches have all modes at all given values.
    free : dict
        Names of coordinates that can move while the drive is held, as keys.
    """

    parts: list[Floats]
    folds: list[Floats]
    is_complete: bool
    free: dict[str, None]

    def covering(self, s: float) -> int:
        """The number of branches that have a position at a place."""
        return sum(_covers(part, s) for part in self.parts)


def _search(path: Drive) -> _Found:
    """Find the branches: from modes at a few places, then at those given values where there are more modes.

    Raises
    ------
    ModelError
        If coordinates can move while the drive is held.
    AssemblyError
        If the loops close nowhere.
    """
    (first, last), found = path.ends, _Found([], [], True, {})
    places = np.unique(path.places)
    with Progress(f"{path.model.name}: positions along the drive") as progress:
        for number, fraction in enumerate(SEEDS):
            if (found.free and not found.parts and number >= 3) or (first == last and number):
                break
            _add_modes(path, found, first + fraction * (last - first), progress)
        counts = _counts(path, places)
        for s, count in zip(places, counts, strict=True):
            if count == found.covering(s):
                continue
            is_certain = False
            if count != NO_COUNT or not found.covering(s):
                is_certain = _add_modes(path, found, s, progress)
            found.is_complete &= is_certain or count == found.covering(s)
    if not found.parts and found.free:
        raise ModelError(
            f"A degree of freedom is left: {', '.join(found.free)} can move while {', '.join(path.names)} is held. "
            "Drive it, too, or connect what moves."
        )
    if not found.parts:
        prescribed = [name for name in path.model.prescribed if name not in path.names]
        raise AssemblyError(
            f"The loops of {path.model.name} close at none of the values of {', '.join(path.names)}, nor at "
            f"{len(SEEDS)} places between them."
            + (f" Motions are prescribed by {', '.join(prescribed)}: drive these instead." if prescribed else "")
        )
    return found


def _loops(path: Drive, s: float) -> Loops:
    """The loops with the drive held at a place."""
    driven, order = path.at(s), np.argsort(path.coordinates).astype(int)
    given = tuple(path.coordinates[k] for k in order)
    return Loops(path.model, path.t, driven[order], path.p, path.inputs(driven), given)


def _counts(path: Drive, places: Floats) -> NDArray[np.int64]:
    """The number of modes at each place, as far as it is certain."""
    first, last = path.ends
    typical = _loops(path, first + SEEDS[0] * (last - first))
    return mode_counts(typical, [_loops(path, s) for s in places], path.start[typical.dependent])


def _add_modes(path: Drive, found: _Found, s: float, progress: Progress) -> bool:
    """Find assembly modes at a place, and trace the branches through them; whether these have all modes there."""
    (first, last), loops = path.ends, _loops(path, s)
    modes, all_found, moving = closed_coordinates(loops, path.start[loops.dependent], progress)
    found.free |= dict.fromkeys(moving)
    covering = found.covering(s)
    for dependent in modes:
        z = np.append(loops.coordinates(dependent) / path.scales, s)
        if any(_passes(path, part, z) for part in found.parts):
            continue
        if first == last:
            found.parts.append(z[None, :])
        elif null_space(path.function(z)[1]).shape[1] == 1:
            curve = trace(path.function, z, first - MARGIN, last + MARGIN, path.periods)
            # Where a part moves while the drive is at rest, a curve has no extent along it.
            parts = [part for part in curve.branches() if part[-1, -1] - part[0, -1] > SAME_ATOL]
            parts = [part for part in parts if _overlap(path, part) >= -AT_LIMIT_ATOL]
            found.parts += parts
            found.folds += [fold for fold in curve.points[list(curve.folds)] if _is_end(path, fold, parts)]
            found.is_complete &= not curve.ends_early
    # At a special position, such as an end, modes may be all known although that is not sure there.
    return all_found or bool(moving) or 0 < len(modes) == covering


def _covers(part: Floats, s: float) -> bool:
    """Whether a branch has a position at a place, or ends there."""
    return bool(part[0, -1] - AT_LIMIT_ATOL <= s <= part[-1, -1] + AT_LIMIT_ATOL)


def _overlap(path: Drive, part: Floats) -> float:
    """The length of the drive's way that a branch covers; negative if it is beyond the ends."""
    return float(min(path.ends[1], part[-1, -1]) - max(path.ends[0], part[0, -1]))


def _is_end(path: Drive, fold: Floats, parts: Sequence[Floats]) -> bool:
    """Whether a fold is the end of a branch, within the ends of the drive."""
    first, last = path.ends
    ends = [part[place] for part in parts for place in (0, -1)]
    is_inside = first - AT_LIMIT_ATOL <= fold[-1] <= last + AT_LIMIT_ATOL
    return is_inside and any(np.abs(_within(fold - end, path.periods)).max() <= AT_LIMIT_ATOL for end in ends)


def _singularity(path: Drive, z: Floats) -> float:
    """The smallest of the singular values with the drive held, relative to the largest."""
    sizes = np.linalg.svd(path.function(z)[1][:, :-1], compute_uv=False)
    return float(sizes[-1] / sizes[0]) if sizes.size and sizes[0] else 0.0


def _passes(path: Drive, part: Floats, z: Floats) -> bool:
    """Whether a branch goes through a position; near a singular one, whether it goes near."""
    if len(part) == 1 or not _covers(part, z[-1]):
        return False
    expected = _between(part, z[-1])
    if np.abs(_within(z - expected, path.periods)).max() > MAX_CHORD_ERROR:
        return False
    near = solve_at(path.function, expected, z[-1])
    if near is not None and np.abs(_within(z - near, path.periods)).max() <= SAME_ATOL:
        return True
    return _singularity(path, z) < CHANGE_POINT_RATIO


def _within(away: Floats, periods: Floats) -> Floats:
    """Differences without whole periods."""
    finite = np.where(np.isfinite(periods), periods, 0.0)
    return np.asarray(away - finite * np.round(away / periods))


def _between(part: Floats, s: float) -> Floats:
    """A position on a branch, by linear interpolation."""
    return np.array([np.interp(s, part[:, -1], column) for column in part.T])


def _motion(path: Drive, part: Floats, s: float, number: int) -> list[Floats]:
    """Coordinates, u, u', q' and q'' on a branch at a place, NaN where they are not determined.

    At a change point, where branches cross, the constraints determine no velocities. There they are the limits along
    the branch, by interpolation between positions beside it.
    """
    low, high = part[0, -1], part[-1, -1]
    near = solve_at(path.function, _between(part, s), s)
    if near is None and min(s - low, high - s) <= AT_LIMIT_ATOL:
        near = part[0 if s - low < high - s else -1]
    if path.curves is None and (near is None or _singularity(path, near) < CHANGE_POINT_RATIO):
        for length in BESIDE:
            if low + 4 * length <= s <= high - 4 * length:
                places = s + length * STEPS
                beside = [_motion_at(path, solve_at(path.function, _between(part, z), z), number) for z in places]
                rows = [np.array(values) for values in zip(*beside, strict=True)]
                found = [WEIGHTS @ row for row in rows]
                is_known = all(np.isfinite(row).all() for row in found)
                if is_known and _is_smooth(rows) and _is_on_curve(path, found[0], s, near):
                    return found
    return _motion_at(path, near, number)


def _is_smooth(rows: Sequence[Floats]) -> bool:
    """Whether velocities and accelerations beside a change point can be interpolated.

    That the position closes the loops does not tell: where it is an odd function, it is exact for any distance.
    """
    _, u, ud, qd, qdd = rows
    speed = max(np.abs(u).max(initial=0.0), np.abs(qd).max(initial=0.0))
    acceleration = max(np.abs(ud).max(initial=0.0), np.abs(qdd).max(initial=0.0)) + speed**2
    errors = [np.abs((WEIGHTS - FEWER) @ row).max(initial=0.0) for row in (u, qd, ud, qdd)]
    return bool(max(errors[:2]) <= SMOOTH_RTOL * speed and max(errors[2:]) <= SMOOTH_RTOL * acceleration)


def _is_on_curve(path: Drive, q: Floats, s: float, near: Floats | None) -> bool:
    """Whether an interpolated position closes the loops, and is the one that was found, which is less accurate."""
    z = np.append(q / path.scales, s)
    if np.abs(path.function(z)[0]).max(initial=0.0) > INTERPOLATION_ATOL:
        return False
    return near is None or bool(np.abs(_within(z - near, path.periods)).max() <= SAME_ATOL)


def _motion_at(path: Drive, z: Floats | None, number: int) -> list[Floats]:
    n_q, n_u = path.model.n_q, path.model.n_u
    if z is None:
        return [np.full(n, np.nan) for n in (n_q, n_u, n_u, n_q, n_q)]
    q = z[:n_q] * path.scales
    u, ud, qd, qdd = path.motion(q, z[n_q], number) or [np.full(n, np.nan) for n in (n_u, n_u, n_q, n_q)]
    return [q, u, ud, qd, qdd]


def _branch(path: Drive, part: Floats) -> Branch:
    """A branch at the given values of the drive."""
    model, n_q = path.model, path.model.n_q
    n = path.values.shape[1]
    q, qd, qdd = (np.full((n_q, n), np.nan) for _ in range(3))
    u, ud = (np.full((model.n_u, n), np.nan) for _ in range(2))
    r = np.transpose([path.inputs(path.values[:, k], k) for k in range(n)])
    low, high = part[0, -1], part[-1, -1]
    for k, s in enumerate(path.places):
        if _covers(part, s):
            q[:, k], u[:, k], ud[:, k], qd[:, k], qdd[:, k] = _motion(path, part, s, k)
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    for place in np.flatnonzero(path.angles) if known.size else []:
        if place not in path.coordinates:
            q[place] -= 2.0 * np.pi * np.round(q[place, known[0]] / (2.0 * np.pi))
    first, last = path.ends
    ends = zip(path.names, path.at(max(low, first)).tolist(), path.at(min(high, last)).tolist(), strict=True)
    limits = {name: (begin, end) for name, begin, end in ends}
    drive = dict(zip(path.names, path.values, strict=True))
    return Branch(model, path.t, drive, q, qd, qdd, u, ud, limits, r, path.p, path.without_value)
