"""A DC motor's speed.

Source: Control Tutorials for MATLAB and Simulink (W. Messner, D. Tilbury, J. Aller), "DC Motor Speed: System Modeling"
and "System Analysis": J = 0.01 kg m^2, b = 0.1 N m s, K = 0.01, R = 1 ohm, L = 0.5 H; poles at -2.0025 and -9.9975 per
second, 0.1 rad/s at 1 V.
"""

import numpy as np
import pytest
from builders.state_equations import motor

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def compiled():
    return fb.compile_model(motor())


def test_poles_of_the_motor_are_those_of_the_tutorial(compiled):
    """To half a unit of the last printed digit; the angle has the third pole, at zero."""
    A, _ = compiled.linearize(0.0, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(np.sort(np.linalg.eigvals(A).real), [-9.9975, -2.0025, 0.0], rtol=0, atol=5e-5)


def test_speed_after_a_step_of_the_voltage_is_that_of_the_tutorial(compiled):
    """0.0999 rad/s, K / (b R + K^2); after 10 s, exp(-2.0025 t) has gone to 2e-9."""
    run = compiled.simulate((0.0, 10.0), [0.0, 0.0, 0.0], inputs={"V": 1.0}, rtol=1e-9, atol=1e-12)
    assert run["omega"][-1] == pytest.approx(0.0999, abs=5e-5)
