"""A slider-crank: crank, connecting rod, and a slider on a line."""

from __future__ import annotations

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

from fourbar_codegen.modeling.model import Model, Parameter, joint_force

__all__ = ["slider_crank"]


def slider_crank() -> Model:
    """Model the crank mechanism of a piston engine, in a horizontal plane.

    Returns
    -------
    Model
        Coordinates crank and rod (rad), the angles of both relative to the line of the slider; slide (m), the
        slider's position, which two holonomic constraints tie to the rod's end. Speeds are their rates. Inputs
        torque (N m) on the crank and load (N) on the slider, outputs pin_x, pin_y and pin_z (N), the force of the
        slider on the rod (pin_z is zero).

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.models.slider_crank().outputs
    ('pin_x', 'pin_y', 'pin_z')
    """
    crank_angle, rod_angle, slide = q = me.dynamicsymbols("crank rod slide")
    crank_rate, rod_rate, slide_rate = u = me.dynamicsymbols("crank_rate rod_rate slide_rate")
    torque, load = me.dynamicsymbols("torque load")
    r, length, m_crank, m_rod, m_slider = sm.symbols("r l m_crank m_rod m_slider")
    t = me.dynamicsymbols._t

    ground, crank, rod = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.ReferenceFrame("B")
    for frame, angle, rate in ((crank, crank_angle, crank_rate), (rod, rod_angle, rod_rate)):
        frame.orient_axis(ground, ground.z, angle)
        frame.set_ang_vel(ground, rate * ground.z)
    origin, crank_center, crank_pin, rod_center, rod_end, slider = map(me.Point, ("O", "CA", "P", "CB", "E", "S"))
    origin.set_vel(ground, 0)
    for point, base, position, frame in (
        (crank_center, origin, r / 2 * crank.x, crank),
        (crank_pin, origin, r * crank.x, crank),
        (rod_center, crank_pin, length / 2 * rod.x, rod),
        (rod_end, crank_pin, length * rod.x, rod),
    ):
        point.set_pos(base, position)
        point.v2pt_theory(base, ground, frame)
    slider.set_pos(origin, slide * ground.x)
    slider.set_vel(ground, slide_rate * ground.x)

    system = System(ground, origin)
    for name, center, frame, mass, size in (
        ("crank", crank_center, crank, m_crank, r),
        ("rod", rod_center, rod, m_rod, length),
    ):
        inertia = me.inertia(frame, 0, 0, mass * size**2 / 12)
        system.add_bodies(me.RigidBody(name, center, frame, mass, (inertia, center)))
    system.add_bodies(me.Particle("slider", slider, m_slider))
    system.add_loads(me.Torque(crank, torque * ground.z), me.Force(slider, load * ground.x))
    pin = rod_end.pos_from(slider)
    system.add_holonomic_constraints(pin.dot(ground.x), pin.dot(ground.y))
    system.q_ind, system.q_dep = q[:1], q[1:]
    system.u_ind, system.u_dep = u[:1], u[1:]
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    return Model(
        system,
        name="slider_crank",
        parameters={
            r: Parameter(0.1, "m", "length of the crank"),
            length: Parameter(0.3, "m", "length of the rod"),
            m_crank: Parameter(1.0, "kg", "mass of the crank, a uniform bar"),
            m_rod: Parameter(0.5, "kg", "mass of the rod, a uniform bar"),
            m_slider: Parameter(0.8, "kg", "mass of the slider"),
        },
        inputs={torque: 0, load: 0},
        initial={crank_angle: 0.5, rod_angle: -0.2, slide: 0.4, crank_rate: 10.0},
        outputs=joint_force("pin", {1: ground.x, 2: ground.y}, ground),
    )
