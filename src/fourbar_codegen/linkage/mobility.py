"""How a linkage can move: degrees of freedom, rigid parts and redundant joints, by rank at closed positions.

Counting (Gruebler) misses special lengths: a parallelogram with a bar too many moves, and three bars can be drawn in
line. The Jacobian of the loops tells the instantaneous mobility at one position; at positions nearby, reached by finite
steps along its null space and closed again, it tells the mobility of the linkage.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.linalg import matrix_rank
from numpy.typing import NDArray

from fourbar_codegen.linkage.tree import GROUND, Tree

__all__ = ["Mobility", "find_mobility"]

Floats = NDArray[np.float64]

RANK_RTOL = 1e-7
"""Smallest singular value that counts, relative to the largest; and smallest component of a motion."""

MIN_COLUMN_RATIO = 0.05
"""Smallest part of a column that is independent of others, for a choice of dependent coordinates far from singular."""

STEPS = (0.02, 0.1, 0.3)
"""Lengths of steps to positions nearby: rad, or lengths relative to the size of the linkage."""

N_ATTEMPTS = 4
"""Of steps of each length."""
MAX_ITERATIONS = 50
CLOSURE_RTOL = 1e-11
"""Largest gap of a closed position, relative to the size of the linkage."""


@dataclass(frozen=True)
class Mobility:
    """How a linkage can move; links and blocks are told by their names.

    Attributes
    ----------
    gruebler : int
        Degrees of freedom by counting: coordinates minus constraints, 3 (n - 1) - 2 j for n links with j pins.
    degrees_of_freedom : int
        By the rank of the constraints at closed positions near the drawn one, drives not counted.
    independent : tuple of str
        Those whose coordinates determine the others; as many as the degrees of freedom that drives leave.
    free : tuple of str
        Those that can move while all drives are held.
    parts : tuple of (tuple of str, int)
        Those that move independently of others, and their degrees of freedom, drives not counted.
    rigid : tuple of tuple of str
        Links that do not move relative to each other, such as bars in a triangle; ``"ground"`` may be among them.
    redundant : tuple of str
        Joints with constraints that follow from others: without one of them, it could move in the same way.
    is_singular : bool
        Whether it is drawn at a singular position, such as a dead point: there the constraints have a smaller rank.
    """

    gruebler: int
    degrees_of_freedom: int
    independent: tuple[str, ...]
    free: tuple[str, ...]
    parts: tuple[tuple[tuple[str, ...], int], ...]
    rigid: tuple[tuple[str, ...], ...]
    redundant: tuple[str, ...]
    is_singular: bool


def find_mobility(
    tree: Tree, size: float, driven: Sequence[str], preferred: Sequence[str], wanted: Sequence[str] = ()
) -> Mobility:
    """Find how a linkage can move.

    Parameters
    ----------
    tree : Tree
    size : float
        Of the linkage, m.
    driven : sequence of str
        Links and blocks that are driven, one for each drive.
    preferred : sequence of str
        All links and blocks, those first whose coordinates should be independent.
    wanted : sequence of str
        Those whose coordinates are independent in any case: if they cannot be, there are too many independent ones.

    Returns
    -------
    Mobility
    """
    names, n = tree.coordinates, len(tree.coordinates)
    scales = np.array([1.0 if name in tree.links else size for name in names])
    drawn = tree.gaps(tree.values)[1] * scales / size
    free = _null_space(drawn)
    # The rank is larger almost everywhere than at singular positions. With no position nearby, nothing moves.
    nearby = list(_nearby(tree, size, scales, free))
    jacobians = [tree.gaps(position)[1] * scales / size for position in nearby]
    if not nearby:
        nearby, jacobians = [tree.values], [np.vstack([drawn, free.T])]
    ranks = [int(matrix_rank(jacobian, rtol=RANK_RTOL)) for jacobian in jacobians]
    rank = max(ranks)
    generic = [k for k, own in enumerate(ranks) if own == rank]
    is_singular = int(matrix_rank(drawn, rtol=RANK_RTOL)) < rank
    drives = np.eye(n)[[names.index(name) for name in driven]]
    held = [np.vstack([jacobians[k], drives]) for k in generic]
    left = n - int(matrix_rank(held[0], rtol=RANK_RTOL))
    as_drawn = np.vstack([drawn, drives])
    chosen = as_drawn if n - int(matrix_rank(as_drawn, rtol=RANK_RTOL)) == left else held[0]
    motions = [_null_space(jacobians[k]) for k in generic]
    order, first = ([names.index(name) for name in group] for group in (preferred, wanted))
    independent = _independent(chosen, left, order, first)
    velocities = [
        _velocities(tree, nearby[k], size, scales[:, None] * m) for k, m in zip(generic, motions, strict=True)
    ]
    return Mobility(
        gruebler=n - len(drawn),
        degrees_of_freedom=n - rank,
        independent=tuple(names[k] for k in independent),
        free=tuple(names[k] for k in _moving(*map(_null_space, held))),
        parts=tuple((tuple(names[k] for k in part), freedom) for part, freedom in _parts(motions)),
        rigid=_rigid(velocities),
        redundant=_redundant(tree, jacobians[generic[0]][: len(drawn)]),
        is_singular=is_singular,
    )


def _null_space(matrix: Floats) -> Floats:
    """An orthonormal basis, in columns."""
    return np.asarray(np.linalg.svd(matrix)[2][matrix_rank(matrix, rtol=RANK_RTOL) :].T)


def _nearby(tree: Tree, size: float, scales: Floats, free: Floats) -> Iterator[Floats]:
    """Closed positions that are reached by steps along random free motions."""
    generator = np.random.default_rng(0)
    for length in STEPS * N_ATTEMPTS * bool(free.size):
        step = free @ generator.standard_normal(free.shape[1])
        moved = tree.values + scales * length * step / np.linalg.norm(step)
        for _ in range(MAX_ITERATIONS):
            gap, jacobian = tree.gaps(moved)
            if np.abs(gap).max(initial=0.0) <= CLOSURE_RTOL * size:
                if np.linalg.norm((moved - tree.values) / scales) > length / 2.0:
                    yield moved
                break
            moved = moved - scales * np.linalg.lstsq(jacobian * scales / size, gap / size, rcond=RANK_RTOL)[0]


def _independent(matrix: Floats, count: int, preferred: Sequence[int], wanted: Sequence[int]) -> tuple[int, ...]:
    """Numbers of columns that determine the others, with those that are wanted, then those first that are preferred.

    The other columns are chosen from the end of the preferred ones, each if it is independent of those chosen by then.
    Near a singular choice, smaller independent parts count.
    """
    for smallest in (MIN_COLUMN_RATIO, RANK_RTOL):
        basis: list[Floats] = []
        dependent = []
        for column in (column for column in reversed(preferred) if column not in wanted):
            rest = matrix[:, column]
            for _ in range(2):  # twice is enough
                rest = rest - sum((b * (b @ rest) for b in basis), np.zeros(len(rest)))
            if np.linalg.norm(rest) > smallest * np.linalg.norm(matrix[:, column]):
                basis.append(rest / np.linalg.norm(rest))
                dependent.append(column)
        independent = tuple(sorted(set(preferred) - set(dependent)))
        if len(independent) == count:
            break
    return independent


def _moving(*motions: Floats) -> list[int]:
    """Numbers of the coordinates that change in a motion at some position."""
    return np.flatnonzero(np.abs(np.hstack(motions)).max(axis=1, initial=0.0) > RANK_RTOL).tolist()


def _parts(motions: Sequence[Floats]) -> list[tuple[list[int], int]]:
    """Coordinates in groups that move independently, with their degrees of freedom.

    The projector on the space of motions is block diagonal, and the trace of a block is its number of freedoms.
    """
    projectors = [basis @ basis.T for basis in motions]
    waiting, parts = _moving(*motions), []
    while waiting:
        part, reached = list[int](), [waiting[0]]
        while reached:
            k = reached.pop()
            if k in waiting:
                waiting.remove(k)
                part.append(k)
                reached += _moving(*(projector[:, [k]] for projector in projectors))
        parts.append((sorted(part), round(float(np.diag(projectors[0])[part].sum()))))
    return parts


def _velocities(tree: Tree, position: Floats, size: float, motions: Floats) -> dict[str, NDArray[np.complex128]]:
    """Of each link in each motion at a position: angular, and of its point that is at the origin."""
    z, dz = tree.positions(position)
    found = {GROUND: np.zeros(2 * motions.shape[1], dtype=complex)}
    for number, (link, points) in enumerate(tree.links.items()):
        place, turn = tree.of_link[link, points[0]], motions[number]
        found[link] = np.concatenate((turn, (dz[place] @ motions - 1j * turn * z[place]) / size))
    return found


def _rigid(velocities: Sequence[dict[str, NDArray[np.complex128]]]) -> tuple[tuple[str, ...], ...]:
    """Links with the same velocities at all positions."""
    groups: list[list[str]] = []
    for link in velocities[0]:
        for group in groups:
            away = [np.abs(own[group[0]] - own[link]).max(initial=0.0) for own in velocities]
            if max(away) <= RANK_RTOL:
                group.append(link)
                break
        else:
            groups.append([link])
    return tuple(tuple(group) for group in groups if len(group) > 1)


def _redundant(tree: Tree, jacobian: Floats) -> tuple[str, ...]:
    """Points of the cut joints whose rows are in linear combinations that vanish."""
    rows = _moving(_null_space(jacobian.T)) if jacobian.size else []
    return tuple(dict.fromkeys(tree.places[tree.cuts[row // 2][0]].point for row in rows))
