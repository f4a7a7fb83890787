"""The models, each as those who know it would have it: a System or a KanesMethod, values, and where a run begins.

SymPy's are formed by its own tests, which come with it, SymBRiM's of its components. Those of PyDy and opty are written
here after their published descriptions, with the same choices of coordinates, speeds and constraints.
"""

from __future__ import annotations

import contextlib
import importlib
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.models import multi_mass_spring_damper, n_link_pendulum_on_cart
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from ecosystem.formed import Formed, taken

T = me.dynamicsymbols._t
SEAT = {"seat_yaw": 0.0, "seat_pitch": -0.3, "seat_roll": 0.0, "bike_gear_ratio": 2.0}
SUSPENSION = {"d9": 0.03207142672761929, "k": 19.4e3, "c": 9e3}
g = sm.Symbol("g")


@dataclass(frozen=True)
class Built:
    """What a case makes: a model of SymPy's, and what it needs to run. What is not named begins at a small number."""

    system: System | me.KanesMethod
    values: Mapping[Any, float] = field(default_factory=dict)
    begin: Mapping[Any, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A model of others.

    Attributes
    ----------
    name, source : str
    build : callable
    is_compared : bool
        Whether SymPy's own equations are formed beside; not where these take very long.
    warned : str
        What is wrong in the model itself, of which there is a warning. Then SymPy's equations are others.
    refused : str
        A part of the sentence that it is refused with.
    """

    name: str
    source: str
    build: Callable[[], Built]
    warned: str = ""
    refused: str = ""
    is_compared: bool = True


def of_sympys_test(module: str, function: str, which: int = 0) -> Callable[[], Built]:
    """The KanesMethod, in its order, that a test of sympy.physics.mechanics forms equations of."""

    def build() -> Built:
        formed: Formed = []
        test = getattr(importlib.import_module(f"sympy.physics.mechanics.tests.{module}"), function)
        with taken(formed, which + 1):
            test()
        return Built(formed[which])

    return build


def rolling_disc(
    *, wheel: str = "KnifeEdgeWheel", tire: str = "NonHolonomicTire", force: bool = False
) -> Callable[[], Built]:
    """SymBRiM's rolling disc."""

    def build() -> Built:
        import symbrim as sb
        from symbrim.other.rolling_disc import RollingDisc

        disc = RollingDisc("disc")
        disc.wheel, disc.ground = getattr(sb, wheel)("wheel"), sb.FlatGround("ground")
        disc.tire = getattr(sb, tire)("tire")
        disc.tire.compute_normal_force = force
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            disc.define_all()
            system = disc.to_system()
        system.apply_uniform_gravity(-g * disc.ground.get_normal(disc.ground.origin))
        dependent = 2 if tire == "NonHolonomicTire" else 0
        system.q_ind, system.u_ind, system.u_dep = disc.q[:], disc.u[dependent:], disc.u[:dependent]
        sizes = {
            disc.wheel.symbols[name]: size
            for name, size in {"r": 0.4, "tr": 0.05}.items()
            if name in disc.wheel.symbols
        }
        return Built(system, {**sizes, g: 9.81}, {disc.u[4]: 5.0})

    return build


def disc_on_a_linear_tyre() -> Built:
    """SymBRiM's rolling disc on a tyre of one's own: a side force and moment by slip, camber and normal force."""
    import symbrim as sb

    class LinearTire(sb.InContactTire):
        def __init__(self, name: str) -> None:
            super().__init__(name)
            self.substitute_loads = self.no_longitudinal_slip = True

        @property
        def load_equations(self) -> dict[sm.Expr, sm.Expr]:
            slip = self.contact_point.vel(self.ground.frame).dot(self.lateral_axis)
            normal, c = self.symbols["Fz"], sm.Symbol("c")
            return {
                self.symbols["Fy"]: normal * (self.camber_angle / 10 - c * slip),
                self.symbols["Mz"]: normal * slip / 20,
                self.symbols["Mx"]: 0,
            }

    with mock.patch.object(sb, "LinearTire", LinearTire, create=True):
        built = rolling_disc(tire="LinearTire", force=True)()
    system = built.system
    system.u_ind, system.u_dep = system.u[1:], system.u[:1]
    return Built(system, {**built.values, sm.Symbol("c"): 4.0}, built.begin)


def stationary_bicycle() -> Built:
    """SymBRiM's bicycle on a stand: a rear wheel with cranks, and a front that steers."""
    import symbrim as sb
    from symbrim.bicycle import MasslessCranks, StationaryBicycle

    bike = StationaryBicycle("bike")
    bike.rear_frame, bike.front_frame = sb.RigidRearFrame("rear_frame"), sb.RigidFrontFrame("front_frame")
    bike.rear_wheel, bike.front_wheel = sb.KnifeEdgeWheel("rear_wheel"), sb.KnifeEdgeWheel("front_wheel")
    bike.cranks = MasslessCranks("cranks")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bike.define_all()
        system = bike.to_system()
    return Built(system, _of_whipple(bike))


def whipple_bicycle(
    *,
    front_frame: str = "RigidFrontFrame",
    wheel: str = "KnifeEdgeWheel",
    normal: str = "-z",
    forces: bool = False,
    ridden: bool = False,
) -> Callable[[], Built]:
    """SymBRiM's Whipple bicycle, with the benchmark's values in Moore's convention.

    Source: P. Basu-Mandal, A. Chatterjee, J. M. Papadopoulos, "Hands-free circular motions of a benchmark bicycle",
    Proceedings of the Royal Society A 463 (2007); the values as SymBRiM's own test has them.
    """

    def build() -> Built:
        import symbrim as sb

        bike = sb.WhippleBicycle("bike")
        bike.ground = sb.FlatGround("ground", normal=normal)
        bike.rear_frame, bike.front_frame = sb.RigidRearFrame("rear_frame"), getattr(sb, front_frame)("front_frame")
        bike.rear_wheel, bike.front_wheel = getattr(sb, wheel)("rear_wheel"), getattr(sb, wheel)("front_wheel")
        bike.rear_tire, bike.front_tire = sb.NonHolonomicTire("rear_tire"), sb.NonHolonomicTire("front_tire")
        bike.rear_tire.compute_normal_force = bike.front_tire.compute_normal_force = forces
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            bike.define_all()
            system = bike.to_system()
        system.apply_uniform_gravity(-g * bike.ground.get_normal(bike.ground.origin))
        if ridden:  # as in SymBRiM's tutorial: somebody pushes the saddle, and the rider steers
            push, torque = me.dynamicsymbols("disturbance steer_torque")
            hub, fork = bike.rear_frame.steer_hub, bike.front_frame.steer_hub
            system.add_loads(me.Force(bike.rear_frame.saddle.point, push * bike.rear_frame.wheel_hub.axis))
            system.add_actuators(me.TorqueActuator(torque, hub.axis, hub.frame, fork.frame))
        more = bike.front_frame
        system.q_ind, system.q_dep = [*bike.q[:4], *bike.q[5:], *more.q], [bike.q[4]]
        system.u_ind = [bike.u[3], *bike.u[5:7], *more.u]
        system.u_dep = [*bike.u[:3], bike.u[4], bike.u[7]]
        begin = {bike.q[4]: 0.3, bike.u[5]: -15.0, bike.u[3]: 0.1}  # 4.5 m/s, where it is stable
        return Built(system, _of_whipple(bike), {**dict.fromkeys([*system.q_ind, *system.u_ind], 0.0), **begin})

    return build


def _of_whipple(bike: Any) -> dict[sm.Expr, float]:
    values = {g: 9.81}
    for part, numbers in {
        bike.rear_wheel: {"r": 0.3, "tr": 0.02},
        bike.front_wheel: {"r": 0.35, "tr": 0.02},
        bike.rear_frame: {
            "d4": 0.4, "d5": -0.5, "d1": 0.9534570696121849, "l1": 0.4707271515135145, "l2": -0.47792881146460797,
        },
        bike.front_frame: {
            "d2": 0.2676445084476887, "d3": 0.03207142672761929, "l3": -0.00597083392418685, "l4": -0.3699518200282974,
            **SUSPENSION,
        },
    }.items():  # fmt: skip
        values.update({part.symbols[name]: number for name, number in numbers.items() if name in part.symbols})
    rear, front = (7.178169776497895, 11.0, 4.821830223502103), (0.05841337700152972, 0.06, 0.007586622998470264)
    for part, mass, diagonal, product in (
        (bike.rear_frame, 85.0, rear, 3.8225535938357873),
        (bike.front_frame, 4.0, front, 0.009119225261946298),
        (bike.rear_wheel, 2.0, (0.0603, 0.12, 0.0603), 0.0),
        (bike.front_wheel, 3.0, (0.1405, 0.28, 0.1405), 0.0),
    ):
        matrix = part.body.central_inertia.to_matrix(part.body.frame)
        values.update({part.body.mass: mass, **{matrix[i, i]: diagonal[i] for i in range(3)}})
        if matrix[0, 2]:
            values[matrix[0, 2]] = product
    return values


def rider_on_a_bicycle() -> Built:
    """The one of the examples."""
    example = importlib.import_module("09_rider_on_a_bicycle")
    system = example.rider_on_a_bicycle()
    speed = -example.SPEED / example.GEOMETRY["rear_wheel_r"]
    begin = {**dict.fromkeys([*system.q_ind, *system.u_ind], 0.0), system.u_ind[1]: speed}
    return Built(system, _by_name(system), begin)


def rider_on_a_stand() -> Built:
    """SymBRiM's bicycle on a stand, and a rider's pelvis and legs on its fixed seat: two loops by the cranks."""
    import symbrim as sb
    from symbrim import rider as of
    from symbrim.bicycle import MasslessCranks, StationaryBicycle
    from symbrim.brim import FixedSeat, HolonomicPedals

    both, bike, rider = sb.BicycleRider("both"), StationaryBicycle("bike"), sb.Rider("rider")
    bike.rear_frame, bike.front_frame = sb.RigidRearFrame("rear_frame"), sb.RigidFrontFrame("front_frame")
    bike.rear_wheel, bike.front_wheel = sb.KnifeEdgeWheel("rear_wheel"), sb.KnifeEdgeWheel("front_wheel")
    bike.cranks, rider.pelvis = MasslessCranks("pedals"), sb.PlanarPelvis("pelvis")
    rider.left_leg, rider.right_leg = of.TwoPinStickLeftLeg("left_leg"), of.TwoPinStickRightLeg("right_leg")
    rider.left_hip, rider.right_hip = of.SphericalLeftHip("left_hip"), of.SphericalRightHip("right_hip")
    both.bicycle, both.rider, both.seat, both.pedals = bike, rider, FixedSeat("seat"), HolonomicPedals("feet")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both.define_all()
        system = both.to_system()
    legs = (rider.left_hip, rider.left_leg), (rider.right_hip, rider.right_leg)
    for kind in ("q", "u"):
        flexion = [getattr(part, kind)[i] for hip, leg in legs for part, i in ((hip, 0), (hip, 2), (leg, 0))]
        free = [getattr(part, kind)[1] for leg in legs for part in leg]  # adduction of the hip, ankle
        setattr(system, f"{kind}_ind", [*getattr(bike, kind), *free])
        setattr(system, f"{kind}_dep", flexion)
    return Built(system, _by_name(system), {**dict.fromkeys([*system.q_ind, *system.u_ind], 0.0), bike.u[0]: -5.0})


def rider_of_the_tutorial() -> Built:
    """That of SymBRiM's tutorial: suspension, fixed seat, arms that the grips determine, torques in the elbows."""
    import symbrim as sb
    from symbrim import rider as of
    from symbrim.brim import FixedSeat, HolonomicHandGrips

    both, bike, rider = sb.BicycleRider("both"), sb.WhippleBicycle("bike"), sb.Rider("rider")
    bike.ground, bike.rear_frame = sb.FlatGround("ground"), sb.RigidRearFrame("rear_frame")
    bike.front_frame = sb.SuspensionRigidFrontFrame("front_frame")
    bike.rear_wheel, bike.front_wheel = sb.KnifeEdgeWheel("rear_wheel"), sb.KnifeEdgeWheel("front_wheel")
    bike.rear_tire, bike.front_tire = sb.NonHolonomicTire("rear_tire"), sb.NonHolonomicTire("front_tire")
    rider.pelvis, rider.torso = sb.PlanarPelvis("pelvis"), sb.PlanarTorso("torso")
    rider.sacrum = sb.FixedSacrum("sacrum")
    rider.left_arm, rider.right_arm = sb.PinElbowStickLeftArm("left_arm"), sb.PinElbowStickRightArm("right_arm")
    rider.left_shoulder = of.FlexRotLeftShoulder("left_shoulder")
    rider.right_shoulder = of.FlexRotRightShoulder("right_shoulder")
    rider.left_arm.add_load_groups(of.PinElbowTorque("left_elbow"))
    rider.right_arm.add_load_groups(of.PinElbowTorque("right_elbow"))
    both.bicycle, both.rider, both.seat, both.hand_grips = bike, rider, FixedSeat("seat"), HolonomicHandGrips("grips")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both.define_all()
        system = both.to_system()
    system.apply_uniform_gravity(-g * bike.ground.get_normal(bike.ground.origin))
    arms = rider.left_shoulder, rider.left_arm, rider.right_shoulder, rider.right_arm
    system.q_ind = [*bike.q[:4], *bike.q[5:], *bike.front_frame.q]
    system.q_dep = [bike.q[4], *(q for part in arms for q in part.q)]
    system.u_ind = [bike.u[3], *bike.u[5:7], *bike.front_frame.u]
    system.u_dep = [*bike.u[:3], bike.u[4], bike.u[7], *(u for part in arms for u in part.u)]
    rolling = {bike.u[5]: -4.5 / 0.3, bike.u[3]: 0.1}
    suspension = {bike.front_frame.symbols[name]: number for name, number in SUSPENSION.items()}
    return Built(
        system, _by_name(system) | suspension, {**dict.fromkeys([*system.q_ind, *system.u_ind], 0.0), **rolling}
    )


def _by_name(system: System) -> dict[sm.Expr, float]:
    """The values of the example's rider, for what has the same name."""
    example = importlib.import_module("09_rider_on_a_bicycle")
    found = {}
    for symbol in fb.Model(system, inputs="auto").parameter_symbols:
        with contextlib.suppress(LookupError):
            found[symbol] = SEAT[symbol.name] if symbol.name in SEAT else example.value(symbol.name)
    return found


def drone() -> Built:
    """opty's drone: a rigid body in quaternions, whose norm has a dependent speed, with four thrusts and air drag."""
    m, length, w, d, c = sm.symbols("m l w d c", real=True)
    position, velocity = me.dynamicsymbols("x y z"), me.dynamicsymbols("v_x v_y v_z")
    e, u0, turning = me.dynamicsymbols("e0:4"), me.dynamicsymbols("u0"), me.dynamicsymbols("w_x w_y w_z")
    thrusts = me.dynamicsymbols("F1:5")
    ground, body, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O"), me.Point("C")
    body.orient_quaternion(ground, e)
    center.set_pos(origin, sum((x * axis for x, axis in zip(position, ground, strict=True)), 0 * ground.x))
    by_rates, moving = body.ang_vel_in(ground), center.pos_from(origin).dt(ground)
    kinematic = [v - moving.dot(axis) for v, axis in zip(velocity, body, strict=True)]
    kinematic += [u0 - e[0].diff(T), *(x - by_rates.dot(axis) for x, axis in zip(turning, body, strict=True))]
    body.set_ang_vel(ground, sum((x * axis for x, axis in zip(turning, body, strict=True)), 0 * body.x))
    origin.set_vel(ground, 0)
    center.set_vel(ground, sum((v * axis for v, axis in zip(velocity, body, strict=True)), 0 * body.x))
    loads = [(center, -m * g * ground.z - c * center.vel(ground))]
    for number, (thrust, right, ahead) in enumerate(zip(thrusts, (1, -1, 1, -1), (1, 1, -1, -1), strict=True)):
        rotor = center.locatenew(f"P{number}", right * length / 2 * body.x + ahead * w / 2 * body.y)
        rotor.v2pt_theory(center, ground, body)
        loads.append((rotor, thrust * body.z))
    inertia = me.inertia(body, m * (w**2 + d**2) / 12, m * (length**2 + d**2) / 12, m * (length**2 + w**2) / 12)
    norm = sm.Matrix([sum(x**2 for x in e) - 1])
    kane = me.KanesMethod(
        ground, [*position, *e[1:]], [*velocity, *turning], kd_eqs=kinematic, q_dependent=[e[0]], u_dependent=[u0],
        configuration_constraints=norm, velocity_constraints=norm.diff(T),
    )  # fmt: skip
    kane.kanes_equations([me.RigidBody("drone", center, body, m, (inertia, center))], loads)
    return Built(kane, {m: 2.0, length: 0.5, w: 0.4, d: 0.1, g: 9.81, c: 0.2}, {e[0]: 1.0})


def crane() -> Built:
    """opty's crane: a load on a pendulum below a trolley, its coordinates and their rates as constraints beside."""
    x, x_load, y_load, q = me.dynamicsymbols("x x_l y_l q")
    speeds = u, u_load, v_load, turn = me.dynamicsymbols("u u_l v_l u_q")
    force = me.dynamicsymbols("F")
    length, m1, m2 = sm.symbols("l m1 m2")
    ground, rope, origin, trolley, load = (
        me.ReferenceFrame("N"),
        me.ReferenceFrame("A"),
        *map(me.Point, ("O", "P1", "P2")),
    )
    origin.set_vel(ground, 0)
    rope.orient_axis(ground, q, ground.z)
    rope.set_ang_vel(ground, turn * ground.z)
    trolley.set_pos(origin, x * ground.x)
    trolley.set_vel(ground, u * ground.x)
    load.set_pos(trolley, -length * rope.y)
    load.v2pt_theory(trolley, ground, rope)
    places = sm.Matrix([x_load - x - length * sm.sin(q), y_load + length * sm.cos(q)])
    coordinates = x, x_load, y_load, q
    kane = me.KanesMethod(
        ground, [x, q], [u, turn], q_dependent=[x_load, y_load], u_dependent=[u_load, v_load],
        kd_eqs=[speed - coordinate.diff(T) for speed, coordinate in zip(speeds, coordinates, strict=True)],
        configuration_constraints=places, velocity_constraints=places.diff(T),
    )  # fmt: skip
    forces = [(trolley, force * ground.x - m1 * g * ground.y), (load, -m2 * g * ground.y)]
    kane.kanes_equations([me.Particle("trolley", trolley, m1), me.Particle("load", load, m2)], forces)
    return Built(kane, {length: 2.0, m1: 5.0, m2: 1.0, g: 9.81}, {q: 0.5})


def sympys(name: str, module: str, function: str, which: int = 0, **more: str) -> Case:
    """A model of one of SymPy's own tests."""
    return Case(name, f"SymPy, {module}.{function}", of_sympys_test(module, function, which), **more)


CONTACT = "a2pt_theory from the contact point, which is not fixed in a body: SymPy has 2 u2 u3 instead of 6/5 u2 u3"
QUICK = (
    sympys("two masses on a line", "test_kane", "test_two_dof"),
    sympys("pendulum by its velocity", "test_kane", "test_pend"),
    sympys("rolling disc, three coordinates", "test_kane", "test_rolling_disc"),
    sympys("rolling disc, auxiliary speeds", "test_kane", "test_aux", 1, warned=CONTACT),
    sympys("rolling disc, five speeds", "test_kane5", "test_kane_rolling_disc_lu"),
    sympys("rolling disc and its height", "test_linearize", "test_linearize_rolling_disc_kane"),
    sympys("pendulum, Cartesian", "test_linearize", "test_linearize_pendulum_kane_nonminimal"),
    sympys("forces with rates q'", "test_kane4", "test_replace_qdots_in_force"),
    sympys("Whipple bicycle, no wheel angles", "test_kane3", "test_bicycle"),
    Case("rolling disc", "SymBRiM, RollingDisc", rolling_disc()),
    Case("drone in quaternions", "opty, plot_drone", drone),
    Case("crane with its load's place", "opty, plot_crane_moving_a_load", crane),
)
"""Those that the tests run, too."""

LONG = (
    Case("Whipple bicycle", "SymBRiM, WhippleBicycle", whipple_bicycle()),
    Case("Whipple bicycle, normal forces", "SymBRiM, compute_normal_force", whipple_bicycle(forces=True)),
    Case("Whipple bicycle, upside down", 'SymBRiM, FlatGround(normal="+z")', whipple_bicycle(normal="+z")),
    Case("Whipple bicycle, thick tyres", "SymBRiM, ToroidalWheel", whipple_bicycle(wheel="ToroidalWheel")),
    Case("bicycle with a suspension", "SymBRiM", whipple_bicycle(front_frame="SuspensionRigidFrontFrame")),
    Case("rolling disc, thick", "SymBRiM, ToroidalWheel", rolling_disc(wheel="ToroidalWheel")),
    Case("rolling disc, normal force", "SymBRiM, compute_normal_force", rolling_disc(force=True)),
    Case("disc that slides", "SymBRiM, InContactTire", rolling_disc(tire="InContactTire")),
    Case(
        "disc that slides, normal force",
        "SymBRiM, InContactTire",
        rolling_disc(tire="InContactTire", force=True),
    ),
    Case("disc on a linear tyre", "SymBRiM, InContactTire with load_equations", disc_on_a_linear_tyre),
    Case("stationary bicycle", "SymBRiM, StationaryBicycle", stationary_bicycle),
    Case("pendulum of five links on a cart", "SymPy, models", lambda: Built(n_link_pendulum_on_cart(5))),
    Case("eight masses, springs, dampers", "SymPy, models", lambda: Built(multi_mass_spring_damper(8, True, True))),
    Case("rider on a stand", "SymBRiM, StationaryBicycle", rider_on_a_stand, is_compared=False),
    Case("rider of the tutorial", "SymBRiM, BicycleRider", rider_of_the_tutorial, is_compared=False),
    Case("rider on a bicycle", "SymBRiM, BicycleRider", rider_on_a_bicycle, is_compared=False),
)
