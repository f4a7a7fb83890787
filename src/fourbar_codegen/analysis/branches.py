"""Positions, velocities and accelerations of a mechanism along a drive, in all ways in which its loops close."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.assembly_modes import closed_coordinates
from fourbar_codegen.analysis.continuation import null_space, solve_at, trace
from fourbar_codegen.analysis.drive import Drive, read_drive
from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.arguments import Values
from fourbar_codegen.errors import AssemblyError, ModelError
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.progress import Progress
from fourbar_codegen.results.kinematics import Branch, Kinematics

__all__ = ["kinematics"]

Floats = NDArray[np.float64]

SEEDS = (0.5131, 0.0, 1.0, 0.2417, 0.7689, 0.1201, 0.8773, 0.3718, 0.6329)
"""Places along the drive, of its whole way, where assembly modes are searched: unlikely to be singular. They are also
searched at all given values at which no branch closes."""

SAME = 1e-6
"""Largest distance of scaled coordinates that are the same."""


def kinematics(
    model: Kernel,
    drive: Mapping[Any, Any],
    rates: Mapping[Any, ArrayLike] | None,
    accelerations: Mapping[Any, ArrayLike] | None,
    parameters: Values | None,
    inputs: Mapping[Any, float] | None,
    t: float,
) -> Kinematics:
    """Positions and motions along a drive; see `CompiledModel.kinematics`."""
    path = read_drive(model, drive, rates, accelerations, parameters, inputs, t)
    if (left := model.n_q - len(path.coordinates)) > model.n_h:
        raise ModelError(
            f"A degree of freedom is left: with {', '.join(path.names)} held, {left} coordinates and {model.n_h} "
            "position constraints are left. Drive another one, too."
        )
    parts, folds, is_complete = _search(path)
    n_q, periods = model.n_q, path.periods

    def distance(part: Floats) -> float:
        away = part[:, :n_q] - path.start / path.scales
        return float(np.abs(_within(away, periods[:n_q])).max(axis=1).min())

    branches = tuple(_branch(path, part) for part in sorted(parts, key=distance))
    dead = []
    for fold in folds:
        values = dict(zip(model.coordinates, (fold[:n_q] * path.scales).tolist(), strict=True))
        dead.append({**values, **dict(zip(path.names, path.at(fold[n_q]).tolist(), strict=True))})
    drives = dict(zip(path.names, path.values, strict=True))
    return Kinematics(model, drives, branches, tuple(dead), is_complete)


def _search(path: Drive) -> tuple[list[Floats], list[Floats], bool]:
    """Branches, points in rows; the folds between them; and whether these are all, as far as is known.

    Raises
    ------
    ModelError
        If coordinates can move while the drive is held.
    AssemblyError
        If the loops close nowhere.
    """
    model, (first, last), start = path.model, path.ends, path.start
    parts: list[Floats] = []
    folds: list[Floats] = []
    is_complete, tried, free = True, 0, dict[str, None]()
    order = np.argsort(path.coordinates).astype(int)
    given = tuple(path.coordinates[k] for k in order)
    with Progress(f"{model.name}: positions along the drive") as progress:
        for s in _seeds(path, parts):
            driven = path.at(s)
            loops = Loops(model, path.t, driven[order], path.p, path.inputs(driven), given)
            found, all_found, moving = closed_coordinates(loops, start[loops.dependent], progress)
            tried += bool(found)
            free |= dict.fromkeys(moving)
            is_complete &= all_found or bool(moving)
            for dependent in found:
                z = np.append(loops.coordinates(dependent) / path.scales, s)
                if any(_passes(path, part, z) for part in parts):
                    continue
                if first == last:
                    parts.append(z[None, :])
                elif null_space(path.function(z)[1]).shape[1] == 1:
                    curve = trace(path.function, z, first, last, path.periods)
                    parts += curve.branches()
                    folds += [curve.points[fold] for fold in curve.folds]
                    is_complete &= not curve.ends_early
            if moving and not parts and tried >= 3:
                break
    if not parts and free:
        raise ModelError(
            f"A degree of freedom is left: {', '.join(free)} can move while {', '.join(path.names)} is held. Drive it, "
            "too, or connect what moves."
        )
    if not parts:
        raise AssemblyError(
            f"The loops of {model.name} close at none of the values of {', '.join(path.names)}, nor at "
            f"{len(SEEDS)} places between them."
        )
    return parts, folds, is_complete


def _seeds(path: Drive, parts: Sequence[Floats]) -> Iterator[float]:
    """Places where assembly modes are searched: some on the whole way, then those that no branch passes by then."""
    first, last = path.ends
    tried = {first + fraction * (last - first): None for fraction in SEEDS}
    yield from tried
    for s in path.places.tolist():
        if s not in tried and not any(part[0, -1] <= s <= part[-1, -1] for part in parts):
            yield s


def _passes(path: Drive, part: Floats, z: Floats) -> bool:
    """Whether a branch goes through a position."""
    s = part[:, -1]
    if len(part) == 1 or not s[0] - SAME <= z[-1] <= s[-1] + SAME:
        return False
    near = solve_at(path.function, _between(part, z[-1]), z[-1])
    if near is None:
        return False
    return bool(np.abs(_within(z - near, path.periods)).max() <= SAME)


def _within(away: Floats, periods: Floats) -> Floats:
    """Differences without whole periods."""
    finite = np.where(np.isfinite(periods), periods, 0.0)
    return np.asarray(away - finite * np.round(away / periods))


def _between(part: Floats, s: float) -> Floats:
    """A position on a branch, by linear interpolation."""
    return np.array([np.interp(s, part[:, -1], column) for column in part.T])


def _branch(path: Drive, part: Floats) -> Branch:
    """A branch at the given values of the drive."""
    model, n_q = path.model, path.model.n_q
    n = path.values.shape[1]
    q, qd, qdd = (np.full((n_q, n), np.nan) for _ in range(3))
    u, ud = (np.full((model.n_u, n), np.nan) for _ in range(2))
    r = np.transpose([path.inputs(path.values[:, k], k) for k in range(n)])
    low, high = part[0, -1], part[-1, -1]
    for k, s in enumerate(path.places):
        if low - SAME <= s <= high + SAME:
            near = solve_at(path.function, _between(part, s), s)
            if near is not None:
                q[:, k] = near[:n_q] * path.scales
                motion = path.motion(q[:, k], k)
                if motion is not None:
                    u[:, k], ud[:, k], qd[:, k], qdd[:, k] = motion
    known = np.flatnonzero(np.isfinite(q).all(axis=0))
    for place in np.flatnonzero(path.angles) if known.size else []:
        if place not in path.coordinates:
            q[place] -= 2.0 * np.pi * np.round(q[place, known[0]] / (2.0 * np.pi))
    ends = zip(path.names, path.at(low).tolist(), path.at(high).tolist(), strict=True)
    limits = {name: (begin, end) for name, begin, end in ends}
    drive = dict(zip(path.names, path.values, strict=True))
    return Branch(model, path.t, drive, q, qd, qdd, u, ud, limits, r, path.p, path.without_value)
