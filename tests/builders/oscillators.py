"""A mass on a spring, with further forces, and one on a circle."""

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me

import fourbar_codegen as fb


def on_a_line(mass, force):
    """A mass at x, with the speed v, and a force along the line."""
    x, v = me.dynamicsymbols("x v")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, x * frame.x)
    point.set_vel(frame, v * frame.x)
    system = me.System(frame, origin)
    system.add_coordinates(x)
    system.add_speeds(v)
    system.add_kdes(v - x.diff())
    system.add_bodies(me.Particle("mass", point, mass))
    system.add_loads(me.Force(point, force * frame.x))
    return system


def oscillator():
    """A mass on a spring, x = a cos(w t) with w^2 = k / m."""
    (x, v), (m, k) = me.dynamicsymbols("x v"), sm.symbols("m k")
    return fb.Model(on_a_line(m, -k * x), name="oscillator", parameters={m: 2.0, k: 8.0}, initial={x: 0.3, v: 0.0})


def driven_oscillator(**more):
    model = oscillator()
    system, force = model.system, me.dynamicsymbols("F")
    system.add_loads(me.Force(system.bodies[0].masscenter, force * system.frame.x))
    parameters = {"m": 2.0, "k": 8.0, **more.pop("parameters", {})}
    inputs = {force: more.pop("force", None)}
    return fb.Model(
        system, name="driven", parameters=parameters, initial={"x": 0.0, "v": 0.0}, inputs=inputs, **more
    )  # fmt: skip


def loaded(load, inputs=None):
    """The oscillator with another force, by its state, time and symbols with the value 0.5."""
    model, (x, v) = oscillator(), me.dynamicsymbols("x v")
    load = load(x, v, me.dynamicsymbols._t)
    symbols = load.free_symbols - {me.dynamicsymbols._t}
    model.system.add_loads(me.Force(model.system.bodies[0].masscenter, load * model.system.frame.x))
    parameters = {"m": 2.0, "k": 8.0, **dict.fromkeys(sorted(map(str, symbols)), 0.5)}
    initial = {"x": 0.3, "v": 0.0}
    return fb.compile_model(
        fb.Model(model.system, name="loaded", parameters=parameters, initial=initial, inputs=inputs)
    )


def circling():
    """A mass on a circle without gravity keeps its speed: x = cos t, y = sin t. The compiled model, its parameters, and
    the states at 0 s and 2 s."""
    given = fb.models.cartesian_pendulum()
    model = fb.compile_model(given)
    parameters = {name: 0.0 if name == "g" else 1.0 for name in model.parameters}
    at = {"x": (np.cos, lambda t: -np.sin(t)), "y": (np.sin, np.cos)}  # position and speed
    motion = [at[str(q.func)][order] for order in (0, 1) for q in given.mechanism.coordinates]
    return model, parameters, *([value(t) for value in motion] for t in (0.0, 2.0))
