"""IFToMM benchmark A01."""

import numpy as np

import fourbar_codegen as fb


def test_pendulum_in_cartesian_coordinates():
    # IFToMM benchmark A01: 1 kg, 1 m, g = 9.81, from (-1, 0) at rest; positions from elliptic functions.
    pendulum = fb.compile_model(fb.models.cartesian_pendulum())
    x0 = pendulum.initial_state()
    # It swings through x = 0, where y cannot be independent: the solve chooses its own split.
    run = pendulum.simulate((0.0, 10.0), x0, rtol=1e-12, atol=1e-12, t_eval=[1.0, 2.0, 5.0, 10.0])
    expected_x = [0.98629175113186, -0.79356619534332, -0.94230543504376, -0.27508746257612]
    expected_y = [-0.16501085312554, -0.60848393044379, -0.33475433841400, -0.96141920509913]
    # Global error: some 1000 times the tolerance of a step over four periods.
    np.testing.assert_allclose(run["x"], expected_x, atol=1e-8)
    np.testing.assert_allclose(run["y"], expected_y, atol=1e-8)
    np.testing.assert_allclose(run.energy, 0.0, atol=1e-8)
