"""The N-four-bar mechanism: a row of parallelograms that passes singular configurations.

Source: IFToMM multibody benchmark A02, https://www.iftomm-multibody.org/benchmark; M. Gonzalez, D. Dopico, U. Lugris,
J. Cuadrado, "A benchmarking system for MBS simulation software", *Multibody System Dynamics* 16 (2006).
"""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_integer
from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["n_four_bar"]

MAX_LOOPS = 1_000
"""Larger numbers of loops are refused as mistakes."""


def n_four_bar(loops: int = 2) -> Model:
    """Model N + 1 upright bars on the ground, N bars across their tops: 2 N + 1 equal bars, one degree of freedom.

    Parameters
    ----------
    loops : int, optional
        N, from 1 to 1,000.

    Returns
    -------
    Model
        Coordinates p0, p1, ... (rad), the angles of the upright bars from the vertical, clockwise; c1, c2, ... (rad),
        those of the bars across from the horizontal, also clockwise. Speeds v0, v1, ... and w1, w2, ... (rad/s), their
        rates. Only p0 and v0 are independent. It begins upright, with the joints at the top moving at 1 m/s.

    Raises
    ------
    ModelError
        If there is no loop, or too many.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.n_four_bar(2).mechanism.n_dependent_coordinates
    4
    """
    if not is_integer(loops) or not 1 <= loops <= MAX_LOOPS:
        raise ModelError(f"The number of loops of an N-four-bar mechanism is 1 to {MAX_LOOPS}, not {shown(loops)}.")
    upright, across = me.dynamicsymbols(f"p0:{loops + 1}"), me.dynamicsymbols(f"c1:{loops + 1}")
    v, w = me.dynamicsymbols(f"v0:{loops + 1}"), me.dynamicsymbols(f"w1:{loops + 1}")
    m, length, g = sm.symbols("m l g")
    t = me.dynamicsymbols._t

    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)

    def bar(name: str, base: me.Point, angle: sm.Expr, rate: sm.Expr, along: str) -> me.Point:
        """A bar from a point along an axis of its own; its other end."""
        frame, center, end = me.ReferenceFrame(name), me.Point(f"C_{name}"), me.Point(f"E_{name}")
        frame.orient_axis(ground, ground.z, -angle)
        frame.set_ang_vel(ground, -rate * ground.z)
        for point, distance in ((center, length / 2), (end, length)):
            point.set_pos(base, distance * getattr(frame, along))
            point.v2pt_theory(base, ground, frame)
        system.add_bodies(me.RigidBody(name, center, frame, m, (me.inertia(frame, 0, 0, m * length**2 / 12), center)))
        return end

    tops = []
    for i in range(loops + 1):
        foot = origin.locatenew(f"A{i}", i * length * ground.x)
        foot.set_vel(ground, 0)
        tops.append(bar(f"upright{i}", foot, upright[i], v[i], "y"))
    for i in range(loops):
        gap = bar(f"across{i + 1}", tops[i], across[i], w[i], "x").pos_from(origin) - tops[i + 1].pos_from(origin)
        system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    system.apply_uniform_gravity(-g * ground.y)
    q, u = (*upright, *across), (*v, *w)
    system.q_ind, system.q_dep = q[:1], q[1:]
    system.u_ind, system.u_dep = u[:1], u[1:]
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    return Model(
        system,
        name=f"n_four_bar_{loops}",
        parameters={
            m: Parameter(1.0, "kg", "mass of a bar"),
            length: Parameter(1.0, "m", "length of a bar"),
            g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
        },
        initial={**dict.fromkeys(q, 0), v[0]: 1.0},
    )
