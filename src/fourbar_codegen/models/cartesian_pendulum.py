"""A pendulum in Cartesian coordinates: a particle on a circle.

Source: IFToMM multibody benchmark A01 (simple pendulum), https://www.iftomm-multibody.org/benchmark.
"""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.modeling.model import Model, Parameter

__all__ = ["cartesian_pendulum"]


def cartesian_pendulum() -> Model:
    """Model a particle that a massless rod keeps at a constant distance from the origin, y upwards.

    Returns
    -------
    Model
        Coordinates y and x (m), x dependent; speeds v_y and v_x (m/s), their rates. One holonomic constraint.
        It begins at rest at (-1, 0).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.cartesian_pendulum().coordinates
    ('y', 'x')
    """
    x, y, vx, vy = me.dynamicsymbols("x y v_x v_y")
    t = me.dynamicsymbols._t
    m, length, g = sm.symbols("m l g")

    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x + y * ground.y)
    point.set_vel(ground, vx * ground.x + vy * ground.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", point, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.q_ind, system.q_dep = [y], [x]
    system.u_ind, system.u_dep = [vy], [vx]
    system.add_kdes(vy - y.diff(t), vx - x.diff(t))
    system.add_holonomic_constraints(x**2 + y**2 - length**2)
    return Model(
        system,
        name="cartesian_pendulum",
        parameters={
            m: Parameter(1.0, "kg", "mass"),
            length: Parameter(1.0, "m", "length of the rod"),
            g: Parameter(9.81, "m/s^2", "gravitational acceleration"),
        },
        initial={y: 0.0, x: -1.0, vy: 0.0},
        lines=[(origin, point)],
    )
