"""Models of all kinds that are exported."""

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from builders.forms import of_form
from builders.systems import closed_by_auxiliary_speeds, parallelogram, pendulum, quaternion_top, spatial_four_bar


def driven():
    """A crank with a trapezoidal profile of its speed, whose acceleration jumps."""
    points = {"O": (0, 0), "A": (0.1, 0.05), "C": (0.4, 0)}
    linkage = fb.Linkage("driven", points=points, ground="O", links=["OA", "AC"], density=1.0)
    linkage.slider("C", along=(1, 0))
    t, a, end = me.dynamicsymbols._t, *sm.symbols("a T")
    linkage.drive("O", angle=sm.Piecewise((a * t**2, t < end), (a * end * (2 * t - end), True)))
    return linkage.model(parameters={"a": 10.0, "T": 0.25})


def falling_rod():
    """A rod that slides on the ground without friction: the normal force is unknown, and friction would be its part."""
    q, x, u, v, aux = me.dynamicsymbols("q x u v v_aux")
    m, length, g, mu, normal = *sm.symbols("m l g mu"), me.dynamicsymbols("N_f")
    frame, origin, rod = me.ReferenceFrame("N"), me.Point("O"), me.ReferenceFrame("A")
    foot, center = me.Point("F"), me.Point("C")
    origin.set_vel(frame, 0)
    rod.orient_axis(frame, frame.z, q)
    rod.set_ang_vel(frame, u * frame.z)
    foot.set_pos(origin, x * frame.x)
    foot.set_vel(frame, v * frame.x + aux * frame.y)
    center.set_pos(foot, length / 2 * rod.x)
    center.v2pt_theory(foot, frame, rod)
    system = System(frame, origin)
    inertia = me.inertia(rod, 0, 0, m * length**2 / 12)
    system.add_bodies(me.RigidBody("rod", center, rod, m, (inertia, center)))
    system.add_loads(me.Force(center, -m * g * frame.y), me.Force(foot, normal * frame.y - mu * normal * v * frame.x))
    system.add_coordinates(q, x)
    system.add_speeds(u, v)
    system.u_aux = [aux]
    t = me.dynamicsymbols._t
    system.add_kdes(u - q.diff(t), v - x.diff(t))
    values = {"m": 2.0, "l": 0.6, "g": 9.81, "mu": 0.3}
    return fb.Model(system, name="rod", parameters=values, initial={q: 1.2, x: 0, u: 0, v: 0.2})


def kinked():
    """A mass on a spring that is pushed from t = 0.35 on by f = 1: x = (1 - cos w (t - 0.35)) / w^2, w = 3."""
    q, u = me.dynamicsymbols("q u")
    push, t = me.dynamicsymbols("push"), me.dynamicsymbols._t
    frame, origin, block = me.ReferenceFrame("N"), me.Point("O"), me.Point("B")
    origin.set_vel(frame, 0)
    block.set_pos(origin, q * frame.x)
    block.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("block", block, sm.Symbol("m")))
    system.add_loads(me.Force(block, (push - 9 * q) * frame.x))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(t))
    pushed = sm.Piecewise((0, t < sm.Rational(7, 20)), (sm.Symbol("f"), True))
    return fb.Model(system, name="kinked", parameters={"m": 1.0, "f": 1.0}, inputs={push: pushed})


MODELS = {
    "four_bar": fb.models.four_bar,
    "slider_crank": fb.models.slider_crank,
    "rolling_disc": fb.models.rolling_disc,
    "whipple_bicycle": fb.models.whipple_bicycle,
    "chain": lambda: fb.models.chain(5, closed=True),
    "sparse": lambda: of_form("sparse"),
    "recursive": lambda: of_form("recursive"),
    "recursive_loop": lambda: fb.models.chain(12, closed=True),
    "redundant": parallelogram,
    "quaternion": lambda: fb.Model(
        quaternion_top(), name="top", initial={"e0": 0.8, "e1": 0.6, "e2": 0, "e3": 0, "w1": 1, "w2": 2, "w3": 3}
    ),
    "spatial": spatial_four_bar,
    "unknown_forces": lambda: closed_by_auxiliary_speeds(unknown_forces=True),
    "kinked": kinked,
    "driven_by_unknown_forces": falling_rod,
    "driven": driven,
    "pendulum": lambda: fb.Model(
        pendulum(), name="hanging", parameters={"m": 1.0, "g": 9.81, "l": 0.5}, initial={"q": 0.4}
    ),
}
