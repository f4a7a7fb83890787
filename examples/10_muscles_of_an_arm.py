"""An arm whose biceps turns a lever: the model of SymPy's tutorial on biomechanics, simulated.

The upper arm rotates about two axes in the shoulder, the lower arm about one in the elbow. The hand holds a lever with
a spring and a damper. The closed loop makes three of the four coordinates dependent. Biceps and triceps are SymPy's
muscles after De Groote et al. 2016, with rigid tendons; the triceps wraps around the elbow. Their activations are
states, with differential equations from the System; their excitations are inputs.

Source: SymPy 1.14, "Biomechanical Model Example",
https://docs.sympy.org/latest/tutorials/physics/biomechanics/biomechanical-model-example.html
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import sympy as sm
import sympy.physics.biomechanics as bm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t


class AroundJoint(me.PathwayBase):
    """A muscle that wraps around a cylinder on the axis of a joint, between points of both bodies in one plane.

    Its straight parts are tangents of the cylinder: at the angle asin(r/d) to the line from a point at distance d to
    the axis.
    """

    def __init__(self, origin, insertion, centre, axis, to_origin, to_insertion, radius, angle):
        super().__init__(origin, insertion)
        self.centre, self.axis, self.radius, self.angle = centre, axis, radius, angle
        self.ends = []
        for point, direction, sign in ((origin, to_origin, 1), (insertion, to_insertion, -1)):
            distance = centre.pos_from(point).magnitude()
            turn = sm.asin(radius / distance)
            pull = sm.cos(turn) * direction + sign * sm.sin(turn) * direction.cross(axis)
            self.ends.append((point, distance * sm.cos(turn), turn, pull.normalize()))

    @property
    def length(self):
        """Length of both straight parts and of the arc between them."""
        (_, first, before, _), (_, last, after, _) = self.ends
        return first + self.radius * (before + self.angle + after) + last

    @property
    def extension_velocity(self):
        """Rate of the length of the arc; the straight parts are constant."""
        return self.radius * self.angle.diff(T)

    def to_loads(self, force):
        """Forces at both ends, and the reaction on the cylinder."""
        loads = [me.Force(point, force * pull) for point, _, _, pull in self.ends]
        return [*loads, me.Force(self.centre, -(loads[0].vector + loads[1].vector))]


def muscle(name: str, pathway: me.PathwayBase) -> bm.MusculotendonDeGroote2016:
    activation = bm.FirstOrderActivationDeGroote2016.with_defaults(name)
    return bm.MusculotendonDeGroote2016.with_defaults(name, pathway, activation)


def arm() -> fb.Model:
    """The tutorial's arm."""
    q = me.dynamicsymbols("q1:5", real=True)
    u = me.dynamicsymbols("u1:5", real=True)
    dx, dy, dz, lA, lC, lD, mA, mC, mD, g, k, c, r = sm.symbols("dx dy dz lA lC lD mA mC mD g k c r", real=True)
    N, A, B, C, D = (me.ReferenceFrame(name) for name in "NABCD")
    for frame, parent, axis, angle, rate in (
        (A, N, N.z, q[0], u[0]), (B, N, N.y, q[1], u[1]), (C, B, B.z, q[2], u[2]), (D, C, C.y, q[3], u[3]),
    ):  # fmt: skip
        frame.orient_axis(parent, axis, angle)
        frame.set_ang_vel(parent, rate * axis)

    ground = me.Point("O")
    axle, grip = ground.locatenew("Ao", dx * N.x), me.Point("P1")
    shoulder = ground.locatenew("P2", dy * N.y + dz * N.z)
    for fixed in (ground, axle, shoulder):
        fixed.set_vel(N, 0)
    grip.set_pos(axle, lA * A.y)
    elbow, hand = shoulder.locatenew("P3", lC * C.z), me.Point("P4")
    hand.set_pos(elbow, lD * D.z)
    upper, lower = shoulder.locatenew("Co", lC / 2 * C.z), elbow.locatenew("Do", lD / 2 * D.z)
    on_upper, on_lower = shoulder.locatenew("Cm", lC / 3 * C.z), elbow.locatenew("Dm", lD / 3 * D.z)
    for points, base, frame in (
        ((grip,), axle, A), ((elbow, upper, on_upper), shoulder, C), ((hand, lower, on_lower), elbow, D),
    ):  # fmt: skip
        for point in points:
            point.v2pt_theory(base, N, frame)

    system = System(N, ground)
    for name, centre, frame, mass, inertia in (
        ("lever", axle, A, mA, (lA**2 / 12, lA**2 / 2, lA**2 / 12)),
        ("upper_arm", upper, C, mC, (lC**2 / 12, lC**2 / 12, lC**2 / 2)),
        ("lower_arm", lower, D, mD, (lD**2 / 12, lD**2 / 12, lD**2 / 2)),
    ):
        moments = me.inertia(frame, *(mass * moment for moment in inertia))
        system.add_bodies(me.RigidBody(name, centre, frame, mass, (moments, centre)))
    system.add_loads(
        me.Torque(A, (-k * q[0] - c * u[0]) * N.z), me.Force(upper, mC * g * N.z), me.Force(lower, mD * g * N.z)
    )
    biceps = muscle("biceps", me.LinearPathway(on_upper, on_lower))
    # As in the tutorial, about B.y, although the axis of the elbow is C.y.
    around = AroundJoint(on_upper, on_lower, elbow, B.y, -C.z, D.z, r, q[3])
    triceps = muscle("triceps", around)
    system.add_actuators(biceps, triceps)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:1], q[1:], u[:1], u[1:]
    system.kdes = [speed - angle.diff(T) for speed, angle in zip(u, q, strict=True)]
    system.add_holonomic_constraints(*(hand.pos_from(ground) - grip.pos_from(ground)).to_matrix(N))
    guess = np.deg2rad([5.0, -10.0, 0.0, 75.0])
    return fb.Model(
        system,
        name="arm",
        parameters={
            dx: 0.31, dy: 0.15, dz: -0.31, lA: 0.2, lC: 0.3, lD: 0.3, mA: 1.0, mC: 2.3, mD: 1.7, g: 9.81, k: 5.0,
            c: 0.5, r: 0.03, biceps.F_M_max: 500.0, biceps.l_M_opt: 0.6 * 0.3, biceps.l_T_slack: 0.55 * 0.3,
            triceps.F_M_max: 500.0, triceps.l_M_opt: 0.6 * 0.3, triceps.l_T_slack: 0.65 * 0.3,
        },
        initial={**dict(zip(q, guess, strict=True)), u[0]: 0.0, biceps.a: 0.0, triceps.a: 0.0},
    )  # fmt: skip


def main() -> None:
    model = fb.compile_model(arm())
    x0 = model.initial_state()
    print("angles, degrees:", *np.rad2deg(x0[:4]).round(8))
    print("forcing:", model.forcing(0.0, x0)[0].round(8))
    times = np.linspace(0.0, 3.0, 301)
    for name, inputs in (
        ("at rest", {}),
        ("pulled", {"e_biceps": ([0.5, 0.5 + 1e-9, 1.5, 1.5 + 1e-9], [0.0, 0.8, 0.8, 0.0])}),
    ):
        run = model.simulate((0.0, 3.0), x0, inputs=inputs, t_eval=times, rtol=1e-8, atol=1e-8, dense_output=True)
        lever = np.rad2deg(run["q1"])
        print(f"{name}: lever at {lever[0]:.3f}, {lever[100]:.3f}, {lever[-1]:.3f} degrees after 0, 1 and 3 s")
        print(f"  largest activation of the biceps {run['a_biceps'].max():.3f}, constraint violation", end=" ")
        print(f"{abs(run.constraint_residual).max():.1e} m")
    path = Path("results/arm.png")
    run.save(path)
    print(path)


if __name__ == "__main__":
    main()
