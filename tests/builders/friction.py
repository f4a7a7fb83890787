"""Bodies with friction of unknown normal forces."""

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t


G, M, MU, L, J = sm.symbols("g m mu l J")


def system_of(*bodies, coordinates, speeds, auxiliary, loads, frame, origin):
    system = System(frame, origin)
    system.add_bodies(*bodies)
    system.add_coordinates(*coordinates)
    system.add_speeds(*speeds)
    system.add_auxiliary_speeds(*auxiliary)
    system.add_kdes(*(u - q.diff(T) for q, u in zip(coordinates, speeds, strict=True)))
    system.apply_uniform_gravity(-G * frame.y)
    system.add_loads(*loads)
    return system


def box(friction, *, floor=0, push=0, name="box"):
    """A block on a floor that moves up and down: SymPy's test_box_on_ground, with friction of its normal force."""
    q, u, w, normal = me.dynamicsymbols("q u u_n N")
    ground, origin, block = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    block.set_pos(origin, q * ground.x + floor * ground.y)
    block.set_vel(ground, u * ground.x + (sm.diff(floor, T) + w) * ground.y)
    loads = [me.Force(block, normal * ground.y), me.Force(block, push + friction(normal, u) * ground.x)]
    system = system_of(
        me.Particle("block", block, M), coordinates=[q], speeds=[u], auxiliary=[w], loads=loads, frame=ground,
        origin=origin,
    )  # fmt: skip
    return system, {G: 9.81, M: 2.0, MU: 0.3}, {q: 0.0, u: 4.0}, name


def model_of(made, **more):
    system, values, initial, name = made
    return fb.Model(system, name=name, parameters=values, initial=initial, extra="ignore", **more)


def compiled(made, **more):
    return fb.compile_model(model_of(made, **more))


def rod(friction, name):
    """Painleve's rod: its lower end slides on a floor, at the angle theta; friction pushes it along."""
    x, theta, u, omega, w, normal = me.dynamicsymbols("x theta u omega u_n N")
    ground, body = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, end, centre = me.Point("O"), me.Point("P"), me.Point("C")
    body.orient_axis(ground, ground.z, theta)
    body.set_ang_vel(ground, omega * ground.z)
    origin.set_vel(ground, 0)
    end.set_pos(origin, x * ground.x)
    end.set_vel(ground, u * ground.x + w * ground.y)
    centre.set_pos(end, L * body.x)
    centre.v2pt_theory(end, ground, body)
    loads = [me.Force(end, normal * ground.y + friction(normal) * ground.x)]
    link = me.RigidBody("rod", centre, body, M, (me.inertia(body, 0, 0, J), centre))
    system = system_of(
        link, coordinates=[x, theta], speeds=[u, omega], auxiliary=[w], loads=loads, frame=ground, origin=origin
    )
    return (
        system,
        {G: 9.81, M: 2.0, L: 0.5, J: 2.0 * 0.25 / 3, MU: 0.5},
        {x: 0.0, theta: 1.0, u: -1.0, omega: 0.3},
        name,
    )


def rods_rates(state, p):
    """x' and N by hand: m x_C'' = mu N, m y_C'' = N - m g, J theta'' = -l N (cos - mu sin), y_P = 0."""
    g, m, length, inertia, mu = p
    _, theta, u, omega = state
    s, c = np.sin(theta), np.cos(theta)
    normal = (g - length * s * omega**2) / (1 / m + length**2 * c * (c - mu * s) / inertia)
    turn = -length * normal * (c - mu * s) / inertia
    return np.array([u, omega, mu * normal / m + length * (s * turn + c * omega**2), turn]), normal
