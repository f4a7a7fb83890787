"""The pendulum of tests/runtime/hand_written_pendulum.c: its manifest, how it is loaded, and its motion in closed form.

Nothing here imports SymPy, since a test asserts that simulations of a kernel do not.
"""

import ctypes
from typing import NamedTuple

import numpy as np
from scipy.special import ellipj, ellipk

from fourbar_codegen.building.loading import Loaded, kernel_of
from fourbar_codegen.compiled_model import facade_of
from fourbar_codegen.layout import Layout
from fourbar_codegen.runtime.evaluator import kernel_at

LENGTH, GRAVITY, MASS = 0.8, 9.81, 1.5
"""Defaults of the parameters, m, m/s^2, kg."""


def manifest(rows):
    """What code generation would say of the model, with its constraint written once or twice."""
    x, y, u_x, u_y, length, gravity, mass, force, a_x, a_y = (1 << place for place in range(10))
    multipliers = sum(1 << place for place in range(10, 10 + rows))
    of_motion = [x | mass | force | a_x | multipliers, y | gravity | mass | a_y | multipliers]
    of_constraint = x | y | u_x | u_y
    return {
        "format": 23,
        "name": "pendulum",
        "fingerprint": f"{rows:064x}",
        "coordinates": ["x", "y"],
        "angles": [],
        "speeds": ["u_x", "u_y"],
        "auxiliary_states": [],
        "n_dependent_coordinates": 1,
        "n_dependent_speeds": 1,
        "parameters": [
            {"name": "l", "default": LENGTH, "unit": "m", "description": "length", "range": None},
            {"name": "g", "default": GRAVITY, "unit": "m/s^2", "description": "gravity", "range": None},
            {"name": "m", "default": MASS, "unit": "kg", "description": "mass", "range": None},
        ],
        "derived_parameters": {},
        "inputs": [{"name": "F", "expression": "0", "of": "F", "order": 0}],
        "prescribed_inputs": [],
        "n_breakpoints": 0,
        "n_motion_breakpoints": 0,
        "outputs": ["height", "tension"],
        "undetermined_outputs": [],
        "position_constraints": {
            "operations": [
                ["q", "x"],
                ["q", "y"],
                ["p", "l"],
                ["*", [0, 0]],
                ["*", [1, 1]],
                ["*", [2, 2]],
                ["+", [[3, 1], [4, 1], [5, -1]], 0],
            ],
            "results": [[6, 1]] * rows,
        },
        "points": [{"name": "pivot", "body": None}, {"name": "bob", "body": "bob"}],
        "geometry": ["l"],
        "shapes": [{"kind": "link", "name": "rod", "points": [0, 1]}],
        "not_drawn": [],
        "is_drawn_at_rest": True,
        "gravity": [0, -1, 0],
        "forced_points": [1],
        "bodies": ["bob"],
        "body_shapes": {},
        "initial": {"x": 0.3, "y": -0.7, "u_x": 0.0},
        "invariants": [],
        "position_rows": [*range(rows)],
        "states_velocity_constraints": False,
        "velocity_rows": [],
        "warnings": [],
        "compared": None,
        "has_potential_energy": True,
        "energy_without": [],
        "form": "dense",
        "conditions": [],
        "state_jumps": [],
        "dependencies": {
            "coordinate_rates": [hex(u_x), hex(u_y)],
            "residual": [*map(hex, of_motion), *[hex(of_constraint | a_x | a_y)] * rows],
            "position_violation": [hex(x | y | length)] * rows,
            "velocity_violation": [hex(of_constraint)] * rows,
            "default_inputs": ["0x0"],
        },
        "timed": [],
        "timed_by": {"F": ["F"]},
        "operations": {},
        "operations_before_sharing": {},
    }


def loaded_pendulum(path, rows=1):
    """The compiled model in a shared library, which stays loaded."""
    kernel = ctypes.addressof(ctypes.c_char.in_dll(ctypes.CDLL(str(path)), "pendulum_kernel"))
    loaded = Loaded(kernel_at(kernel), Layout.from_json(manifest(rows)), path)
    return facade_of(kernel_of(loaded))


class Swing(NamedTuple):
    """The motion from rest at an angle from the downward vertical.

    With k = sin(angle / 2), w = sqrt(g / l), and the angle a at the time t, sin(a / 2) = k sn(K - w t, k) and
    a' = -2 k w cn(K - w t, k). Source: P. F. Byrd, M. D. Friedman, Handbook of Elliptic Integrals, 1971; and E. T.
    Whittaker, A Treatise on the Analytical Dynamics of Particles and Rigid Bodies, 4th ed. 1937, section 44.
    """

    angle: float
    length: float = LENGTH
    gravity: float = GRAVITY

    @property
    def period(self):
        return 4.0 * ellipk(np.sin(self.angle / 2.0) ** 2) * np.sqrt(self.length / self.gravity)

    def angles(self, t):
        """The angle and its rate."""
        k, w = np.sin(self.angle / 2.0), np.sqrt(self.gravity / self.length)
        sn, cn, _, _ = ellipj(ellipk(k**2) - w * np.asarray(t, dtype=float), k**2)
        return 2.0 * np.arcsin(k * sn), -2.0 * k * w * cn

    def states(self, t):
        return states_at(self.length, *self.angles(t))


class Turn(NamedTuple):
    """The motion through the lowest point at a rate with which the mass passes the highest one.

    With k = 2 sqrt(g / l) / rate < 1, a / 2 = am(rate t / 2, k) and a' = rate dn(rate t / 2, k). Sources: as for Swing.
    """

    rate: float
    length: float = LENGTH
    gravity: float = GRAVITY

    @property
    def modulus(self):
        return 2.0 * np.sqrt(self.gravity / self.length) / self.rate

    @property
    def period(self):
        """The time of a turn."""
        return 4.0 * ellipk(self.modulus**2) / self.rate

    def angles(self, t):
        _, _, dn, am = ellipj(self.rate * np.asarray(t, dtype=float) / 2.0, self.modulus**2)
        return 2.0 * am, self.rate * dn

    def states(self, t):
        return states_at(self.length, *self.angles(t))


def states_at(length, angle, rate):
    """The states x, y, u_x, u_y, of shape (4, ...), at angles from the downward vertical."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return length * np.array([sine, -cosine, rate * cosine, rate * sine])
