"""The rolling disc of SymPy's tests: nonholonomic, with implicit kinematics."""

import numpy as np
import pytest

import fourbar_codegen as fb


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
def test_rolling_disc_of_sympy(q, u, expected):
    # SymPy, test_kane5.py, and its tolerance.
    disc = fb.compile_model(fb.models.rolling_disc())
    x0 = disc.initial_state(q, u)
    np.testing.assert_allclose(disc.rhs(0.0, x0), expected, rtol=0, atol=1e-10)
