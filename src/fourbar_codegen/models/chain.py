"""A planar chain of equal links, hanging open or with its end held."""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import flag, is_integer
from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["chain"]

MAX_LINKS = 1_000
"""Larger numbers of links are refused as mistakes."""


def chain(links: int = 3, *, closed: bool = False) -> Model:
    """Model uniform bars, joined end to end by pins, under gravity.

    Parameters
    ----------
    links : int, optional
        Number of moving bars; at least 1, at least 3 in a closed chain, at most 1,000.
    closed : bool, optional
        Whether the last bar's end is pinned to the ground, at the distance d from the first pin; then the last two
        coordinates are dependent.

    Returns
    -------
    Model
        Coordinates q1, q2, ... (rad), the angle of each bar relative to the previous one, of the first to the
        horizontal; speeds u1, u2, ... (rad/s), their rates.

    Raises
    ------
    ModelError
        If there are too few links, or too many.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.chain(5, closed=True).mechanism.n_dependent_coordinates
    2
    """
    fewest = 3 if flag(closed, "closed") else 1
    if not is_integer(links) or not fewest <= links <= MAX_LINKS:
        kind = "closed" if closed else "open"
        raise ModelError(f"The number of links of an {kind} chain is {fewest} to {MAX_LINKS}, not {shown(links)}.")
    q, u = me.dynamicsymbols(f"q1:{links + 1}"), me.dynamicsymbols(f"u1:{links + 1}")
    m, length, d, g = sm.symbols("m l d g")
    t = me.dynamicsymbols._t

    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    parent, joint = ground, origin
    for i, (angle, rate) in enumerate(zip(q, u, strict=True), start=1):
        bar, center, end = me.ReferenceFrame(f"B{i}"), me.Point(f"C{i}"), me.Point(f"P{i}")
        bar.orient_axis(parent, parent.z, angle)
        bar.set_ang_vel(parent, rate * parent.z)
        for point, distance in ((center, length / 2), (end, length)):
            point.set_pos(joint, distance * bar.x)
            point.v2pt_theory(joint, ground, bar)
        inertia = me.inertia(bar, 0, 0, m * length**2 / 12)
        system.add_bodies(me.RigidBody(f"bar{i}", center, bar, m, (inertia, center)))
        parent, joint = bar, end
    system.apply_uniform_gravity(-g * ground.y)
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    n_i = links - 2 if closed else links
    system.q_ind, system.q_dep = q[:n_i], q[n_i:]
    system.u_ind, system.u_dep = u[:n_i], u[n_i:]
    # Half of a regular polygon below the line between the ends, or all bars in line for the open chain.
    turn = sm.pi / links if closed else 0
    initial = dict.fromkeys(q[1:], turn) | {q[0]: turn / 2 - sm.pi / 2 if closed else 0} | dict.fromkeys(u[:n_i], 0)
    parameters = {
        m: Parameter(1.0, "kg", "mass of a bar"),
        length: Parameter(1.0, "m", "length of a bar"),
        g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
    }
    if closed:
        gap = joint.pos_from(origin) - d * ground.x
        system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
        # The diameter of that polygon.
        parameters[d] = Parameter(1 / sm.sin(sm.pi / (2 * links)), "m", "distance of the ends")
    return Model(system, name=f"{'closed' if closed else 'open'}_chain_{links}", parameters=parameters, initial=initial)
