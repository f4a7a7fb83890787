"""Bodies in pictures: what is found without being told, and shapes that are given.

Six mechanisms in space, each with a run: a report, a picture of some frames, and glTF for Blender. Their bodies have
shapes of their own; wheels, rods and boxes are found without being told, as in `09_rider_on_a_bicycle.py`.

Needs the extras ``visual`` and ``meshes``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t


def free_body(
    name: str, mass: float, inertia: tuple[float, ...], *, pivot: float | None = None
) -> tuple[System, me.RigidBody, list[sm.Expr], list[sm.Expr]]:
    """A body that turns by angles about z, x and z, and moves unless a point below its mass centre is at rest."""
    ground, point = me.ReferenceFrame("ground"), me.Point("O")
    angles, x = me.dynamicsymbols("psi theta phi"), me.dynamicsymbols("x y z")
    turning, v = me.dynamicsymbols("w_x w_y w_z"), me.dynamicsymbols("v_x v_y v_z")
    frame = ground.orientnew("body", "Body", angles, "ZXZ" if pivot is not None else "ZYX")
    rates = frame.ang_vel_in(ground)
    kdes = [turning[i] - rates.dot(axis) for i, axis in enumerate(frame)]
    frame.set_ang_vel(ground, sum((w * axis for w, axis in zip(turning, frame, strict=True)), me.Vector(0)))
    point.set_vel(ground, 0)
    if pivot is None:
        centre = point.locatenew("C", sum((c * axis for c, axis in zip(x, ground, strict=True)), me.Vector(0)))
        centre.set_vel(ground, sum((c * axis for c, axis in zip(v, ground, strict=True)), me.Vector(0)))
        q, u = [*angles, *x], [*turning, *v]
        kdes += [c.diff(T) - rate for c, rate in zip(x, v, strict=True)]
    else:
        centre = point.locatenew("C", pivot * frame.z)
        centre.v2pt_theory(point, ground, frame)
        q, u = [*angles], [*turning]
    body = me.RigidBody(name, centre, frame, sm.Float(mass), (me.inertia(frame, *map(sm.Float, inertia)), centre))
    system = System(ground, point)
    system.add_bodies(body)
    system.q_ind, system.u_ind = q, u
    system.add_kdes(*kdes)
    system.apply_uniform_gravity(-9.81 * ground.z)
    return system, body, q, u


def state(model: fb.CompiledModel, **values: float) -> list[float]:
    """A state with some values, and zero otherwise."""
    return [values.get(name, 0.0) for name in model.states]


def top() -> Iterator[fb.Trajectory]:
    """A heavy symmetric top, which precesses and nods."""
    system, *_ = free_body("top", 0.5, (0.0006, 0.0006, 0.0012), pivot=0.06)
    shapes = {
        "top": [
            fb.Cone(0.06, 0.07, at=(0, 0, -0.02), axis=(0, 0, -1), color="red"),
            fb.Cylinder(0.06, 0.015, at=(0, 0, 0.0225), color="red"),
            fb.Cylinder(0.006, 0.06, at=(0, 0, 0.06), color="brown"),
            fb.Box(0.115, 0.012, 0.002, at=(0, 0, 0.0305), color="yellow"),
        ],
        "ground": fb.Plane(0.3, color="grey"),
    }
    model = fb.compile_model(fb.Model(system, name="top", shapes=shapes))
    # Steady precession: I1 cos(theta) psi'^2 - I3 w psi' + m g l = 0, with I1 about the tip; the slower of two.
    theta, spin, about_tip, weight = 0.35, 120.0, 0.0006 + 0.5 * 0.06**2, 0.5 * 9.81 * 0.06
    a, b = about_tip * np.cos(theta), 0.0012 * spin
    precession = (b - np.sqrt(b**2 - 4.0 * a * weight)) / (2.0 * a)
    run = model.simulate((0.0, 2.0), state(model, theta=theta, w_y=precession * np.sin(theta), w_z=spin))
    print(f"precession {run['psi'][-1] / 2.0:.9f} rad/s, by its equation {precession:.9f}")
    yield run


def quadcopter() -> Iterator[fb.Trajectory]:
    """A quadcopter that flies a slow turn: four thrusts and their torques."""
    system, body, _, _ = free_body("quadcopter", 1.2, (0.012, 0.012, 0.02))
    thrusts, arm = me.dynamicsymbols("f_1:5"), 0.25
    places = [(arm, 0.0), (0.0, arm), (-arm, 0.0), (0.0, -arm)]
    frame = body.frame
    for number, (thrust, (x, y)) in enumerate(zip(thrusts, places, strict=True), start=1):
        rotor = body.masscenter.locatenew(f"rotor {number}", x * frame.x + y * frame.y)
        rotor.v2pt_theory(body.masscenter, system.frame, frame)
        system.add_loads(me.Force(rotor, thrust * frame.z), me.Torque(frame, 0.02 * (-1) ** number * thrust * frame.z))
    rods = [fb.Cylinder(0.012, 2 * arm, axis=axis, color="grey") for axis in ((1, 0, 0), (0, 1, 0))]
    rotors = [fb.Cylinder(0.13, 0.008, at=(x, y, 0.04), color="blue") for x, y in places]
    motors = [fb.Cylinder(0.022, 0.05, at=(x, y, 0.015), color="black") for x, y in places]
    hull = fb.Box(0.14, 0.14, 0.06, color="orange")
    model = fb.compile_model(
        fb.Model(
            system, name="quadcopter", inputs=dict.fromkeys(thrusts, 0), shapes={body: [hull, *rods, *rotors, *motors]}
        )
    )
    place = {name: number for number, name in enumerate(model.states)}

    def hover(number: int):
        x, y = places[number]

        def thrust(t: float, state: np.ndarray) -> float:
            theta, phi = (state[place[name]] for name in ("theta", "phi"))
            w_x, w_y, w_z = (state[place[name]] for name in ("w_x", "w_y", "w_z"))
            lift = 1.2 * 9.81 / 4 - 1.5 * (state[place["z"]] - 1.0) - 1.5 * state[place["v_z"]]
            roll = 0.25 * np.sin(1.5 * t) - phi
            pitch = 0.25 * np.cos(1.5 * t) - theta
            yaw = 0.3 * (w_z - 0.4) * (-1) ** (number + 1)
            return lift + 4.0 * (y * (roll - 0.5 * w_x) - x * (pitch - 0.5 * w_y)) - yaw

        return thrust

    yield model.simulate(
        (0.0, 6.0), state(model, z=1.0, w_z=0.4), inputs={f"f_{number + 1}": hover(number) for number in range(4)}
    )


def stewart_platform() -> Iterator[fb.Trajectory]:
    """A platform on six struts, driven by the forces of springs and dampers whose rest lengths change."""
    system, platform, _, _ = free_body("platform", 20.0, (1.2, 1.2, 2.4))
    base, lower, upper = system.frame, [], []
    for k in range(6):
        at = np.pi / 3 * (k // 2 * 2) + (0.25 if k % 2 else -0.25)
        over = np.pi / 3 * (k // 2 * 2) + (0.25 if k % 2 else -0.25) * 3.1
        lower.append(system.fixed_point.locatenew(f"A{k + 1}", 0.9 * (sm.cos(at) * base.x + sm.sin(at) * base.y)))
        upper.append(
            platform.masscenter.locatenew(
                f"B{k + 1}", 0.5 * (sm.cos(over) * platform.frame.x + sm.sin(over) * platform.frame.y)
            )
        )
        lower[-1].set_vel(base, 0)
        upper[-1].v2pt_theory(platform.masscenter, base, platform.frame)
        rest = 1.13 + 0.12 * sm.sin(2.0 * T + k * 1.1)
        path = me.LinearPathway(lower[-1], upper[-1])
        system.add_actuators(me.ForceActuator(-8000 * (path.length - rest) - 300 * path.extension_velocity, path))
    shapes = {
        platform: [fb.Cylinder(0.55, 0.05, color="blue")],
        "ground": [fb.Cylinder(0.97, 0.06, at=(0, 0, -0.03), color="grey")],
    }
    model = fb.compile_model(fb.Model(system, name="stewart_platform", points=[*lower, *upper], shapes=shapes))
    yield model.simulate((0.0, 6.0), state(model, z=1.0))


def crane() -> Iterator[fb.Trajectory]:
    """A gantry crane: a trolley under a bridge, and a load on a rope that swings to both sides."""
    ground, origin = me.ReferenceFrame("ground"), me.Point("O")
    origin.set_vel(ground, 0)
    x, alpha, beta = me.dynamicsymbols("x alpha beta")
    v, w_a, w_b = me.dynamicsymbols("v w_a w_b")
    force, height, length = me.dynamicsymbols("F"), 3.0, 2.0
    trolley = origin.locatenew("trolley", x * ground.x + height * ground.z)
    rope = ground.orientnew("rope", "Body", (alpha, beta, 0), "XYZ")
    hook = trolley.locatenew("load", -length * rope.z)
    trolley.set_vel(ground, v * ground.x)
    rope.set_ang_vel(ground, rope.ang_vel_in(ground).xreplace({alpha.diff(T): w_a, beta.diff(T): w_b}))
    hook.v2pt_theory(trolley, ground, rope)
    box = me.RigidBody("box", hook, rope, sm.Float(200), (me.inertia(rope, 8, 8, 8), hook))
    cart = me.Particle("cart", trolley, sm.Float(60))
    system = System(ground, origin)
    system.add_bodies(cart, box)
    system.q_ind, system.u_ind = [x, alpha, beta], [v, w_a, w_b]
    system.add_kdes(x.diff(T) - v, alpha.diff(T) - w_a, beta.diff(T) - w_b)
    system.apply_uniform_gravity(-9.81 * ground.z)
    system.add_loads(me.Force(trolley, force * ground.x))
    legs = [fb.Box(0.15, 0.15, height, at=(a, b, height / 2), color="yellow") for a in (-3, 3) for b in (-0.9, 0.9)]
    beams = [fb.Box(6.4, 0.15, 0.25, at=(0, b, height + 0.1), color="yellow") for b in (-0.9, 0.9)]
    ends = [fb.Box(0.15, 1.9, 0.25, at=(a, 0, height + 0.1), color="yellow") for a in (-3, 3)]
    shapes = {
        "ground": [*legs, *beams, *ends, fb.Box(7.5, 3.0, 0.05, at=(0, 0, -0.025), color="grey")],
        "cart": fb.Box(0.6, 1.9, 0.2, at=(0, 0, 0.25), color="red"),
        "box": [
            fb.Box(0.9, 0.7, 0.6, at=(0, 0, -0.3), color="brown"),
            fb.Line(("trolley", "load"), 0.02, color="black"),
        ],
    }
    model = fb.compile_model(fb.Model(system, name="crane", inputs={force: 0}, shapes=shapes))
    push = ([0.0, 1.4, 1.6, 2.9, 3.1, 8.0], [250.0, 250.0, -250.0, -250.0, 0.0, 0.0], "linear")
    yield model.simulate((0.0, 8.0), state(model, x=-1.8, alpha=0.15), inputs={"F": push})


def robot_arm(folder: Path) -> Iterator[fb.Trajectory]:
    """An arm with three joints, whose links are meshes of files, driven along a path by feedback."""
    import trimesh

    lengths, files = (0.4, 0.35, 0.2), []
    for number, length in enumerate(lengths, start=1):
        tube = trimesh.creation.box((length, 0.06 - 0.012 * number, 0.07 - 0.012 * number))
        ends = [trimesh.creation.cylinder(0.062 - 0.01 * number, 0.11 - 0.012 * number) for _ in range(2)]
        for sign, end in zip((-1, 1), ends, strict=True):
            end.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
            end.apply_translation((sign * length / 2, 0, 0))
        files.append(folder / f"link_{number}.stl")
        trimesh.util.concatenate([tube, *ends]).export(files[-1])
    base, system = me.RigidBody("base"), None
    system = System.from_newtonian(base)
    angles, rates, torques = me.dynamicsymbols("q1:5"), me.dynamicsymbols("u1:5"), me.dynamicsymbols("tau1:5")
    tower = me.RigidBody("tower", mass=sm.Float(8.0))
    tower.central_inertia = me.inertia(tower.frame, 0.1, 0.1, 0.05)
    system.add_joints(
        me.PinJoint("turn", base, tower, angles[0], rates[0], joint_axis=base.z, child_point=-0.25 * tower.z)
    )
    before, at = tower, 0.25 * tower.z
    for number, length in enumerate(lengths, start=1):
        link = me.RigidBody(f"link_{number}", mass=sm.Float(4.0 / number))
        link.central_inertia = me.inertia(link.frame, 0.01, 0.04, 0.04)
        joint = me.PinJoint(
            f"joint_{number}", before, link, angles[number], rates[number], joint_axis=before.y,
            parent_point=at, child_point=-sm.Float(length / 2) * link.x,
        )  # fmt: skip
        system.add_joints(joint)
        before, at = link, sm.Float(length / 2) * link.x
    hand = before.masscenter.locatenew("hand", at)
    for q, u, torque, body in zip(angles, rates, torques, system.bodies[1:], strict=True):
        del q, u
        axis = base.z if body is tower else system.bodies[system.bodies.index(body) - 1].y
        system.add_loads(
            me.Torque(body, torque * axis), me.Torque(system.bodies[system.bodies.index(body) - 1], -torque * axis)
        )
    system.apply_uniform_gravity(-9.81 * base.z)
    shapes = {
        "base": fb.Cylinder(0.16, 0.06, at=(0, 0, -0.03), color="grey"),
        tower: [fb.Cylinder(0.08, 0.5, color="orange"), fb.Cylinder(0.12, 0.04, at=(0, 0, -0.23), color="grey")],
        **{
            f"link_{k}": fb.Mesh(str(file), color=color)
            for k, (file, color) in enumerate(zip(files, ("orange", "orange", "grey"), strict=True), start=1)
        },
    }
    model = fb.compile_model(
        fb.Model(system, name="robot_arm", inputs=dict.fromkeys(torques, 0), points=[hand], shapes=shapes)
    )
    place = {name: number for number, name in enumerate(model.states)}

    def drive(number: int):
        middle, swing, gain = ((0.0, 0.9, 60.0), (-0.9, 0.35, 600.0), (1.3, 0.5, 300.0), (0.4, 0.6, 60.0))[number]

        def torque(t: float, x: np.ndarray) -> float:
            wanted = middle + swing * np.sin((1.0 + 0.3 * number) * t)
            return gain * (wanted - x[place[f"q{number + 1}"]]) - 0.2 * gain * x[place[f"u{number + 1}"]]

        return torque

    start = state(model, q2=-0.9, q3=1.3, q4=0.4)
    yield model.simulate((0.0, 6.0), start, inputs={f"tau{k + 1}": drive(k) for k in range(4)})


def rattleback() -> Iterator[fb.Trajectory]:
    """A half ellipsoid that rolls without slip, and reverses its spin: T. R. Kane, D. A. Levinson 1982."""
    a, b, c, h, mass, g = 0.2, 0.03, 0.02, 0.01, 1.0, 9.81
    ground, frame = me.ReferenceFrame("ground"), me.ReferenceFrame("stone")
    alpha, beta, gamma = me.dynamicsymbols("alpha beta gamma")
    x, y = me.dynamicsymbols("x y")
    w = me.dynamicsymbols("w_1:4")
    frame.orient_body_fixed(ground, (gamma, alpha, beta), "ZXY")
    rates = frame.ang_vel_in(ground)
    frame.set_ang_vel(ground, sum((rate * axis for rate, axis in zip(w, frame, strict=True)), me.Vector(0)))
    # The lowest point of the ellipsoid lies where its normal is vertical.
    mu = [-ground.z.dot(axis) for axis in frame]
    size = sm.sqrt(sum((half * m) ** 2 for half, m in zip((a, b, c), mu, strict=True)))
    touch = [half**2 * m / size for half, m in zip((a, b, c), mu, strict=True)]
    origin = me.Point("O")
    origin.set_vel(ground, 0)
    contact = origin.locatenew("contact", x * ground.x + y * ground.y)
    to_centre = -sum((e * axis for e, axis in zip(touch, frame, strict=True)), me.Vector(0)) - h * frame.z
    centre = contact.locatenew("C", to_centre)
    # No slip: the centre moves as if the stone turned about the contact point.
    centre.set_vel(ground, frame.ang_vel_in(ground).cross(to_centre))
    inertia = me.inertia(frame, 0.0002, 0.0016, 0.0017, -0.00002, 0, 0)
    stone = me.RigidBody("stone", centre, frame, sm.Float(mass), (inertia, centre))
    system = System(ground, origin)
    system.add_bodies(stone)
    system.q_ind, system.u_ind = [alpha, beta, gamma, x, y], [*w]
    moving = centre.pos_from(origin).dt(ground) - centre.vel(ground)
    kdes = [rate - rates.dot(axis) for rate, axis in zip(w, frame, strict=True)]
    system.add_kdes(*kdes, moving.dot(ground.x), moving.dot(ground.y))
    system.apply_uniform_gravity(-g * ground.z)
    shapes = {
        stone: [
            fb.Ellipsoid(a, b, c, at=(0, 0, h), color="green"),
            fb.Box(0.3, 0.012, 0.002, at=(0, 0, h + c), color="yellow"),
        ],
        "ground": fb.Plane(0.6, at=(0, 0, 0), color="grey"),
    }
    model = fb.compile_model(fb.Model(system, name="rattleback", shapes=shapes))
    yield model.simulate((0.0, 4.0), state(model, alpha=0.02, beta=0.02, w_3=-4.0))


def runs(folder: Path) -> Iterator[fb.Trajectory]:
    """All of them; the arm's meshes are written to a folder."""
    for make in (top, quadcopter, stewart_platform, rattleback, crane):
        yield from make()
    yield from robot_arm(folder)


if __name__ == "__main__":
    folder = Path("results")
    with tempfile.TemporaryDirectory() as temporary:
        for run in runs(Path(temporary)):
            name = run.model.name
            if name == "rattleback":
                print(f"the stone turns at {run['w_3'][0]:.1f} rad/s, later at {run['w_3'].max():.1f} rad/s")
            for suffix in ("html", "glb"):
                print(run.save(folder / f"{name}.{suffix}"))
            run.plot_frames().savefig(folder / f"{name}.svg")
            print(folder / f"{name}.svg")
