"""A rider on a bicycle, made of SymBRiM's components: 27 coordinates and 17 constraints, assembled from zero.

The hands hold the grips and the feet turn the cranks, so each arm and each leg closes a loop. The dependent coordinates
need no guess: `initial_state` closes one loop after another, within the given ranges of knees and elbows. The rider
leans against a spring in the seat and steers into the fall. The spring and damper coefficients and the steering torque
are functions of time that SymBRiM leaves undefined; they are inputs here.

Needs symbrim: ``pip install symbrim``. Source of the components: T. J. Stienstra, S. G. Brockie, J. K. Moore, "BRiM: A
modular bicycle-rider modeling framework", Bicycle and Motorcycle Dynamics 2023.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace

import numpy as np
import symbrim as sb
import sympy as sm
import sympy.physics.mechanics as me
from symbrim.bicycle import MasslessCranks
from symbrim.brim import HolonomicHandGrips, HolonomicPedals, SideLeanSeat, SideLeanSeatSpringDamper
from symbrim.rider import (
    SphericalLeftHip,
    SphericalLeftShoulder,
    SphericalRightHip,
    SphericalRightShoulder,
    TwoPinStickLeftLeg,
    TwoPinStickRightLeg,
)
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

SPEED = 4.5  # m/s
GEOMETRY = {  # m and rad; lengths and positions on the frames
    "rear_wheel_r": 0.3, "front_wheel_r": 0.35, "pedals_radius": 0.17, "pedals_offset": 0.1, "bicycle_gear_ratio": 2.0,
    "rear_frame_d1": 0.95346, "rear_frame_l1": 0.47073, "rear_frame_l2": -0.47793, "rear_frame_d4": 0.4386,
    "rear_frame_d5": -0.541, "rear_frame_l_bbx": 0.406, "rear_frame_l_bbz": 0.2057, "front_frame_d2": 0.26764,
    "front_frame_d3": 0.03207, "front_frame_l3": -0.00597, "front_frame_l4": -0.36995, "front_frame_d6": -0.15,
    "front_frame_d7": 0.25, "front_frame_d8": -0.65, "pelvis_hip_width": 0.2, "pelvis_com_height": 0.05,
    "torso_shoulder_width": 0.36, "torso_shoulder_height": 0.2, "sacrum_d_p_t": 0.3, "seat_alpha": 0.2, "g": 9.81,
}  # fmt: skip
OF_A_LIMB = {
    "l_forearm": 0.34, "l_forearm_com": 0.15, "l_upper_arm": 0.33, "l_upper_arm_com": 0.15, "l_thigh": 0.42,
    "l_thigh_com": 0.2, "l_shank": 0.42, "l_shank_com": 0.2, "l_foot": 0.12, "l_foot_com": 0.06,
}  # fmt: skip


def value(name: str) -> float:
    """The value of a parameter, from its name: kg, kg m^2, m."""
    is_large = name.startswith(("rear_frame", "torso", "pelvis"))
    if name in GEOMETRY:
        return GEOMETRY[name]
    if name.endswith("mass"):
        return 20.0 if is_large else 2.5
    if name.endswith(("ixx", "iyy", "izz")):
        return 1.0 if is_large else 0.08 if "wheel" in name else 0.03
    if name.endswith(("ixy", "iyz", "izx")):
        return 0.0
    return OF_A_LIMB[name.split("_", 2)[2]]


def rider_on_a_bicycle() -> System:
    """The System; the joint coordinates that the loops determine are declared dependent."""
    bike, rider, both = sb.WhippleBicycle("bicycle"), sb.Rider("rider"), sb.BicycleRider("both")
    bike.ground, bike.cranks = sb.FlatGround("ground"), MasslessCranks("pedals")
    bike.rear_frame, bike.front_frame = sb.RigidRearFrame("rear_frame"), sb.RigidFrontFrame("front_frame")
    bike.rear_wheel, bike.front_wheel = sb.KnifeEdgeWheel("rear_wheel"), sb.KnifeEdgeWheel("front_wheel")
    bike.rear_tire, bike.front_tire = sb.NonHolonomicTire("rear_tire"), sb.NonHolonomicTire("front_tire")
    rider.pelvis, rider.torso, rider.sacrum = (
        sb.PlanarPelvis("pelvis"),
        sb.PlanarTorso("torso"),
        sb.FixedSacrum("sacrum"),
    )
    rider.left_arm, rider.right_arm = sb.PinElbowStickLeftArm("left_arm"), sb.PinElbowStickRightArm("right_arm")
    rider.left_leg, rider.right_leg = TwoPinStickLeftLeg("left_leg"), TwoPinStickRightLeg("right_leg")
    rider.left_hip, rider.right_hip = SphericalLeftHip("left_hip"), SphericalRightHip("right_hip")
    rider.left_shoulder = SphericalLeftShoulder("left_shoulder")
    rider.right_shoulder = SphericalRightShoulder("right_shoulder")
    both.bicycle, both.rider, both.seat = bike, rider, SideLeanSeat("seat")
    both.pedals, both.hand_grips = HolonomicPedals("pedal_joints"), HolonomicHandGrips("hand_grips")
    both.seat.add_load_groups(SideLeanSeatSpringDamper("lean"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        both.define_all()
        system = both.to_system()
    system.apply_uniform_gravity(-sm.Symbol("g") * bike.ground.get_normal(bike.ground.origin))
    frame, fork = bike.rear_frame.steer_hub, bike.front_frame.steer_hub
    system.add_actuators(me.TorqueActuator(me.dynamicsymbols("steer_torque"), frame.axis, frame.frame, fork.frame))
    free, closing = [], []
    for hip, leg in ((rider.left_hip, rider.left_leg), (rider.right_hip, rider.right_leg)):
        free += [(hip, 1), (leg, 1)]  # adduction of the hip, ankle
        closing += [(hip, 0), (hip, 2), (leg, 0)]  # flexion and rotation of the hip, knee
    for shoulder, arm in ((rider.left_shoulder, rider.left_arm), (rider.right_shoulder, rider.right_arm)):
        free += [(shoulder, 2)]
        closing += [(shoulder, 0), (shoulder, 1), (arm, 0)]
    free += [(both.seat, 0)]
    system.q_ind = [*bike.q[:4], *bike.q[5:], *(part.q[i] for part, i in free)]
    system.q_dep = [bike.q[4], *(part.q[i] for part, i in closing)]
    system.u_ind = [bike.u[3], *bike.u[5:7], *(part.u[i] for part, i in free)]
    system.u_dep = [*bike.u[:3], bike.u[4], bike.u[7], *(part.u[i] for part, i in closing)]
    return system


def shapes(rider: fb.CompiledModel) -> dict[str, list]:
    """What the rider looks like: the limbs that are found, in a rider's colours, a trunk and a head."""
    found = rider.shapes
    trunk = next(name for name in found if "torso" in name)
    colors = {"thigh": "blue", "shank": "#d9a98c", "foot": "black", "upper_arm": "red", "forearm": "#d9a98c"}
    of_limbs = {
        name: [replace(shape, color=color) for shape in found[name]]
        for part, color in colors.items()
        for name in found
        if name.endswith(part)
    }
    body = [
        fb.Ellipsoid(0.13, 0.19, 0.3, at=(0, 0, -0.02), color="red"),
        fb.Capsule(0.05, 0.1, at=(0, 0, -0.3), color="#d9a98c"),
        fb.Ellipsoid(0.1, 0.09, 0.12, at=(0.03, 0, -0.44), color="#d9a98c"),
    ]
    return {**of_limbs, trunk.split(" and ")[-1]: body}


def ride() -> fb.Trajectory:
    """The run: assembled from zero, then four seconds."""
    system = rider_on_a_bicycle()
    begin = time.perf_counter()
    symbols = fb.Model(system, inputs="auto").parameter_symbols
    values = {symbol: value(symbol.name) for symbol in symbols}
    rider = fb.compile_model(fb.Model(system, name="rider", parameters=values, inputs="auto"))
    print(f"{rider.n_q} coordinates, {rider.n_c} constraints, ready after {time.perf_counter() - begin:.1f} s")

    n_q, n_u = (rider.manifest[f"n_dependent_{kind}"] for kind in ("coordinates", "speeds"))
    joints = [f"{side}_{joint}_flexion" for side in ("left", "right") for joint in ("leg_q_knee", "arm_q_elbow")]
    upright = dict.fromkeys(rider.coordinates[:-n_q], 0.0)
    rolling = {**dict.fromkeys(rider.speeds[:-n_u], 0.0), "bicycle_u6": -SPEED / GEOMETRY["rear_wheel_r"]}
    begin = time.perf_counter()
    x0 = rider.initial_state(upright, {**rolling, "bicycle_u4": 0.1}, bounds=dict.fromkeys(joints, (0.0, 2.6)))
    print(f"assembled in {time.perf_counter() - begin:.2f} s")

    lean, lean_rate = rider.states.index("bicycle_q4"), rider.states.index("bicycle_u4")
    inputs = {"lean_k": 2000.0, "lean_c": 100.0, "steer_torque": lambda _, x: -80.0 * x[lean] - 40.0 * x[lean_rate]}
    begin = time.perf_counter()
    run = rider.simulate((0.0, 4.0), x0, inputs=inputs)
    print(f"4 s in {time.perf_counter() - begin:.3f} s; {run.message}")
    rider.shapes = shapes(rider)
    return run


def main() -> None:
    run = ride()
    print(run.save("results/rider.html"))
    print(f"largest constraint violation {np.abs(run.constraint_residual).max():.1e}")
    print(f"largest lean angle {np.abs(run['bicycle_q4']).max():.3f} rad, distance {run['bicycle_q1'][-1]:.1f} m")


if __name__ == "__main__":
    main()
