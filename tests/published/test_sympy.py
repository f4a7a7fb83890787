"""Numbers in SymPy's tests and documentation; each test names the file or page."""

from importlib import import_module

import numpy as np
import pytest
from builders.systems import closed_by_auxiliary_speeds

import fourbar_codegen as fb


def test_matrices_of_the_four_bar_without_loads_are_those_of_sympys_test(four_bar):
    # SymPy, test_jointsmethod.py, test_four_bar_linkage_with_manual_constraints: no gravity, no loads.
    p = {"l1": 0.13, "l2": 0.24, "l3": 0.21, "l4": 0.34, "rho": 997, "g": 0, "k": 0, "c": 0}
    x = [2.1, 0.6655470375077588, 2.527408138024188, 0.2, -0.17963733938852067, 0.1309060540601612]
    mass_matrix = [
        [34.52709815256506, 7.003948798374735, -4.939690970641498],
        [-2.203792703880936e-14, 0.2071702479957077, 0.2842917573033711],
        [-0.1300000000000123, -0.008836934896046506, 0.1864891330060847],
    ]
    forcing = [-0.031211821321648, -0.00066022608181, 0.001813559741243]
    accelerations = [0.004875813576770118, -0.019901808571747004, 0.01218057311407353]
    np.testing.assert_allclose(four_bar.mass_matrix(0.0, x, p), mass_matrix, rtol=0, atol=1e-10)
    np.testing.assert_allclose(four_bar.forcing(0.0, x, p, [0.0]), forcing, rtol=0, atol=1e-10)
    np.testing.assert_allclose(four_bar.rhs(0.0, x, p, [0.0])[3:], accelerations, rtol=0, atol=1e-10)
    np.testing.assert_allclose(four_bar.position_constraints(0.0, x[:3], p), 0.0, atol=1e-10)
    np.testing.assert_allclose(four_bar.velocity_constraints(0.0, x, p), 0.0, atol=1e-10)


@pytest.mark.parametrize(
    ("q", "u", "expected"),
    [
        (
            [0.3, 0.1, 1.97, -0.35, 2.27],
            [-0.2, 1.3, 0.15],
            [
                0.126603940595934,
                0.215942571601660,
                1.28736069604936,
                0.319764288376543,
                0.0989146857254898,
                -0.925848952664489,
                -0.0181350656532944,
                2.91695398184589,
                -0.00992793421754526,
                0.0412861634829171,
            ],
        ),
        (
            [3.97, -0.28, 8.2, -0.35, 2.27],
            [-0.25, -2.2, 0.62],
            [
                0.0259159090798597,
                0.668041660387416,
                -2.19283799213811,
                0.385441810852219,
                0.420109283790573,
                1.45030568179066,
                -0.0110924422400793,
                -8.35617840186040,
                -0.154098542632173,
                -0.146102664410010,
            ],
        ),
    ],
)
def test_rolling_disc_in_motion_has_the_rates_of_sympys_test(q, u, expected):
    # SymPy, test_kane5.py, and its tolerance.
    disc = fb.compile_model(fb.models.rolling_disc())
    x0 = disc.initial_state(q, u)
    np.testing.assert_allclose(disc.rhs(0.0, x0), expected, rtol=0, atol=1e-10)


# SymPy's documentation, four_bar_linkage_example: upright rectangle at rest. Link 4 presses on the ground with
# its own weight and half of that of link 3: 5 * 9.81 * (1 + 2 / 2) N.
RECTANGLE = [np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("unknown_forces", [True, False])
def test_closing_joint_force_of_a_rectangle_is_that_of_sympys_documentation(unknown_forces):
    linkage = fb.compile_model(closed_by_auxiliary_speeds(unknown_forces=unknown_forces))
    names = ("F_x", "F_y") if unknown_forces else ("u_x", "u_y")
    assert linkage.outputs == (*names, "closing_x", "closing_y", "closing_z")
    np.testing.assert_allclose(linkage.rhs(0.0, RECTANGLE), 0.0, atol=1e-13)
    by_auxiliary_speeds, by_multipliers = np.split(linkage.output(0.0, RECTANGLE), [2])
    # The force on the end of link 4; the documentation prints the opposite, the force on the ground.
    np.testing.assert_allclose(by_multipliers, [0.0, 98.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(by_auxiliary_speeds, [0.0, 98.1], atol=1e-12)


def test_arm_with_muscles_has_the_state_mass_matrix_and_forcing_of_sympys_tutorial():
    """SymPy's documentation, "Introduction to Biomechanical Modeling"; half a unit of the last printed digit."""
    arm = fb.compile_model(import_module("10_muscles_of_an_arm").arm())
    x0 = arm.initial_state()
    np.testing.assert_allclose(np.rad2deg(x0[:4]), [5.0, -0.60986636, 9.44918589, 88.68812842], rtol=0, atol=5e-9)
    assert arm.forcing(0.0, x0)[0] == pytest.approx(-0.9121071, abs=5e-8)
    published = [[0.00333333, -0.15174161, -0.00109772, -0.00152436], [0.19923894, 0.31, -0.04923615, 0.00996712],
                 [0.01743115, 0.0, 0.29585191, 0.0011276], [0.0, -0.29256885, -0.0005241, -0.29983226]]  # fmt: skip
    np.testing.assert_allclose(arm.mass_matrix(0.0, x0), published, rtol=0, atol=5e-9)
