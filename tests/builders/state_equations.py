"""Mechanisms with states that have equations of their own."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from builders.oscillators import on_a_line

T = me.dynamicsymbols._t


def rotor():
    """A rotor in a bearing, with its inertia, angle and speed."""
    inertia, (angle, speed) = sm.Symbol("J"), me.dynamicsymbols("theta omega")
    wall, body = me.RigidBody("wall"), me.RigidBody("rotor")
    body.inertia = (me.inertia(body.frame, 0, 0, inertia), body.masscenter)
    system = System.from_newtonian(wall)
    system.add_joints(me.PinJoint("bearing", wall, body, angle, speed, joint_axis=wall.frame.z))
    return system, body, inertia, angle, speed


def motor(**more):
    """A DC motor: J w' = K i - b w, L i' = V - R i - K w."""
    system, body, inertia, angle, speed = rotor()
    constants = dict(zip(sm.symbols("b K L R"), (0.1, 0.01, 0.5, 1.0), strict=True))
    b, k, henry, ohm = constants
    current, voltage = me.dynamicsymbols("i V")
    system.add_loads(me.Torque(body.frame, (k * current - b * speed) * system.frame.z))
    return fb.Model(
        system,
        name="motor",
        parameters={inertia: 0.01, **constants},
        inputs={voltage: 1.0},
        state_equations={current: (voltage - ohm * current - k * speed) / henry},
        initial={angle: 0.3, speed: 0.5, current: 0.2},
        outputs={"induced": henry * current.diff(T), "power": voltage * current},
        **more,
    )


def cartesian():
    model = fb.models.cartesian_pendulum()
    system, (y, x), (vy, _) = model.system, model.mechanism.coordinates, model.mechanism.speeds
    m, length, g = model.parameter_symbols
    tau, (z, w) = sm.Symbol("tau"), me.dynamicsymbols("z w")
    [bob] = system.bodies
    system.add_loads(me.Force(bob.masscenter, z * system.frame.x))
    return fb.Model(
        system,
        name="measured",
        parameters={m: 1.3, length: 1.0, g: 9.81, tau: 0.2},
        state_equations={z: (vy.diff(T) / 10 - z) / tau, w: fb.multiplier(1) * x - w * (1 + z)},
        initial={x: 0.6, y: -0.8, vy: 0.3, z: 0.1, w: 0.2},
    )


def van_der_pol(a, b):
    """E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.10, with a stiffness of 1e6."""
    return [b, 1e6 * ((1 - a**2) * b - a)]


def hires(a, b, c, d, e, f, g, h):
    """The same book's problem HIRES."""
    return [
        -1.71 * a + 0.43 * b + 8.32 * c + 0.0007, 1.71 * a - 8.75 * b, -10.03 * c + 0.43 * d + 0.035 * e,
        8.32 * b + 1.71 * c - 1.12 * d, -1.745 * e + 0.43 * f + 0.43 * g,
        -280 * f * h + 0.69 * d + 1.71 * e - 0.43 * f + 0.69 * g, 280 * f * h - 1.81 * g, -280 * f * h + 1.81 * g,
    ]  # fmt: skip


def robertson(a, b, c):
    """The same book's problem of H. H. Robertson's reactions."""
    return [-0.04 * a + 1e4 * b * c, 0.04 * a - 1e4 * b * c - 3e7 * b**2, 3e7 * b**2]


def first_order(name, rates, start, **more):
    """Equations y' = rates(y), the auxiliary states y1, y2, ... beside a mass at rest."""
    y = me.dynamicsymbols(f"y1:{len(start) + 1}")
    initial = {"x": 0.0, "v": 0.0, **dict(zip(y, start, strict=True))}
    equations = dict(zip(y, rates(*y), strict=True))
    return fb.Model(on_a_line(1, 0), name=name, state_equations=equations, initial=initial, **more)
