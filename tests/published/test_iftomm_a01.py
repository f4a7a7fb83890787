"""The simple pendulum in Cartesian coordinates, in what runs are used for.

Source: IFToMM multibody benchmark A01, https://www.iftomm-multibody.org/benchmark: 1 kg, 1 m, g = 9.81 m/s^2, level and
at rest. Digits beyond the benchmark's by elliptic functions: x = -1 + 2 k^2 sn^2 with k^2 = 1/2 about the lowest point.
"""

import numpy as np
import pytest

import fourbar_codegen as fb

PERIOD = 2.36784194757623745
POSITIONS = {
    1: (0.98629175113186, -0.16501085312554),
    2: (-0.79356619534332, -0.60848393044379),
    5: (-0.94230543504376, -0.33475433841400),
    10: (-0.27508746257612, -0.96141920509913),
    20: (0.99690717399099, -0.07858808080933),
}
"""x and y in m, by time in s."""


@pytest.fixture(scope="module")
def pendulum():
    return fb.compile_model(fb.models.cartesian_pendulum())


def test_run_over_20_s_has_the_published_positions(pendulum):
    """It swings through x = 0, where y cannot be independent. 500 steps have relative errors of 1e-11 each."""
    x0 = pendulum.initial_state({"y": 0.0})
    run = pendulum.simulate((0.0, 20.0), x0, t_eval=[*POSITIONS], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(np.array([run["x"], run["y"]]).T, [*POSITIONS.values()], rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.energy, 0.0, rtol=0, atol=1e-9)
    assert np.abs(run.constraint_residual).max() < 1e-12


def test_events_at_the_lowest_point_come_at_odd_quarters_of_the_period(pendulum):
    run = pendulum.simulate((0.0, 2.5 * PERIOD), events=lambda t, x: x[1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.t_events[0], PERIOD * np.arange(0.25, 2.5, 0.5), rtol=0, atol=1e-9)


def test_derivative_by_gravity_is_that_of_the_published_period(pendulum):
    """T = c sqrt(l / g), so that the lowest point is passed earlier by T / (8 g) dg."""
    run = pendulum.simulate((0.0, 1.0), t_eval=[0.25 * PERIOD], sensitivities=["g"], rtol=1e-12, atol=1e-12)
    expected = run["v_x"][0] * 0.25 * PERIOD / (2 * 9.81)
    np.testing.assert_allclose(run.sensitivity["g"][1, 0], expected, rtol=1e-9)


def test_ensemble_over_gravity_has_the_published_positions_at_scaled_times(pendulum):
    """A fourth of gravity doubles all times."""
    how = {"t_eval": [1, 2, 5, 10], "rtol": 1e-11, "atol": 1e-11}
    runs = pendulum.ensemble((0.0, 10.0), parameters={"g": [9.81, 9.81 / 4]}, **how)
    np.testing.assert_allclose(runs["x"][0], [POSITIONS[t][0] for t in (1, 2, 5, 10)], rtol=0, atol=1e-9)
    np.testing.assert_allclose(runs["x"][1, [1, 3]], [POSITIONS[t][0] for t in (1, 5)], rtol=0, atol=1e-9)


def test_fit_to_the_published_positions_finds_gravity(pendulum):
    """Positions have 14 decimals, and runs errors of 1e-10. A run begins at the first time."""
    positions = {0: (-1.0, 0.0)} | POSITIONS
    x, y = np.array([*positions.values()]).T
    found = fb.fit(pendulum, {"t": [*positions], "x": x, "y": y}, {"g": 9.7}, rtol=1e-10, atol=1e-10)
    assert found.values["g"] == pytest.approx(9.81, rel=1e-9)


def test_drawn_point_is_at_the_published_positions(pendulum):
    run = pendulum.simulate((0.0, 10.0), t_eval=[1, 2, 5, 10], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run["P"][:2].T, [POSITIONS[t] for t in (1, 2, 5, 10)], rtol=0, atol=1e-9)


def test_module_that_is_shipped_has_the_published_positions(tmp_path, unoptimized):
    module = fb.load(fb.build_model(fb.models.cartesian_pendulum(), tmp_path))
    run = module.simulate((0.0, 10.0), t_eval=[1, 2, 5, 10], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run["x"], [POSITIONS[t][0] for t in (1, 2, 5, 10)], rtol=0, atol=1e-9)
