"""Recursive Newton-Euler evaluation of serial chains of revolute joints, in plain NumPy, along inertial axes.

Source: Luh, Walker and Paul, "On-line computational scheme for mechanical manipulators", *J. Dynamic Systems,
Measurement, and Control* 102 (1980).
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Link:
    """A link and the joint it begins with; vectors along the link's own axes.

    A joint with several axes is a chain of links of which all but the last have neither length nor mass.
    """

    axis: np.ndarray
    end: np.ndarray = None
    center: np.ndarray = None
    mass: float = 0.0
    inertia: np.ndarray = None


def rotation(axis, angle):
    """Rodrigues' formula."""
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def joint_torques(links, gravity, q, u, accelerations):
    """The torques about the joints' axes that give these accelerations; and dx/dq of the chain's end, (3, n)."""
    turn, position = np.eye(3), np.zeros(3)
    omega, alpha, acceleration = np.zeros(3), np.zeros(3), -np.asarray(gravity, dtype=float)
    axes, joints, arms, forces, moments = [], [], [], [], []
    for link, angle, speed, rate in zip(links, q, u, accelerations, strict=True):
        turn = turn @ rotation(link.axis, angle)
        axis = turn @ link.axis
        alpha = alpha + axis * rate + np.cross(omega, axis * speed)
        omega = omega + axis * speed
        axes.append(axis)
        joints.append(position)
        if link.mass:
            arm = turn @ link.center
            inertia = turn @ link.inertia @ turn.T
            arms.append(arm)
            forces.append(link.mass * (acceleration + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))))
            moments.append(inertia @ alpha + np.cross(omega, inertia @ omega))
        else:
            arms.append(np.zeros(3))
            forces.append(np.zeros(3))
            moments.append(np.zeros(3))
        if link.end is not None:
            end = turn @ link.end
            acceleration = acceleration + np.cross(alpha, end) + np.cross(omega, np.cross(omega, end))
            position = position + end
    torques = np.zeros(len(links))
    force, moment, above = np.zeros(3), np.zeros(3), position
    for i in reversed(range(len(links))):
        # The moment of what is further out, about this joint.
        moment = moment + np.cross(above - joints[i], force) + moments[i] + np.cross(arms[i], forces[i])
        force = force + forces[i]
        above = joints[i]
        torques[i] = axes[i] @ moment
    jacobian = np.column_stack([np.cross(axis, position - joint) for axis, joint in zip(axes, joints, strict=True)])
    return torques, jacobian
