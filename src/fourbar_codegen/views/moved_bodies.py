"""The body that each coordinate and speed moves, for legends with many names."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.views.found_shapes import random_states

__all__ = ["moved_bodies"]

Floats = NDArray[np.float64]

STEP = 0.1
"""Of a coordinate, rad or m."""

RTOL = 1e-9
"""Least change of a position or a rotation matrix, relative to the size of the mechanism."""


def moved_bodies(model: Kernel, p: Floats) -> dict[str, str]:
    """For coordinates and speeds, the name of the body that they move.

    Parameters
    ----------
    model : Kernel
    p : ndarray, shape (n_p,)

    Returns
    -------
    dict of str to str
        Of a coordinate, the body that moves with it and with the fewest others: that at the end of its joint. Of a
        speed, that of the coordinates whose rates it changes. Those that move nothing that is drawn are left out.
    """
    random = random_states(model, p)
    if not len(random.t):
        return {}
    t, state, inputs = random.t[0], random.x[:, 0], random.r[:, 0]
    states = np.repeat(state[:, np.newaxis], 1 + model.n_q, axis=1)
    states[np.arange(model.n_q), 1 + np.arange(model.n_q)] += STEP
    columns = np.full(1 + model.n_q, t), states, np.repeat(inputs[:, np.newaxis], 1 + model.n_q, axis=1), p
    positions, rotations = model.drawing_along(*columns)[0], model.orientations_along(*columns)
    moves: dict[str, NDArray[np.bool_]] = {}
    drawing = model.layout.drawing
    entries = [
        (point.body, place / random.size) for point, place in zip(drawing.points, positions, strict=True) if point.body
    ]
    named = {name for name, _ in entries}  # not frames, nor bodies without mass
    turns = zip(drawing.bodies, rotations, strict=True)
    entries += [(name, turn.reshape(9, -1)) for name, turn in turns if name in named]
    for name, values in entries:
        change = np.nan_to_num(np.abs(values[:, 1:] - values[:, :1])).max(axis=0) > RTOL
        moves[str(name)] = moves.get(str(name), np.zeros(model.n_q, dtype=bool)) | change

    def body_of(changed: Iterable[int]) -> str | None:
        moved = {name: by.sum() for name, by in moves.items() if by[list(changed)].any()}
        return min(moved, key=lambda name: int(moved[name])) if moved else None

    found = {name: body_of([number]) for number, name in enumerate(model.coordinates)}
    for number, name in enumerate(model.speeds):
        rates = model.coordinate_change(t, state, np.eye(model.n_u)[number], p, inputs)
        found[name] = body_of(np.flatnonzero(np.nan_to_num(rates)))
    return {name: body for name, body in found.items() if body is not None}
