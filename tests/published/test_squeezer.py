"""Andrews' squeezing mechanism to 0.03 s, where the crank has turned 2.5 times."""

import numpy as np
import pytest
from builders.squeezer import ANGLES_AT_END, END, SPEEDS_AT_END, START, squeezer

import fourbar_codegen as fb


@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_the_squeezer_is_at_the_end_where_the_test_set_has_it(method):
    """To twice what remains at finer tolerances, by both methods alike: 1.1e-9 rad and 5.4e-7 rad/s."""
    model = fb.compile_model(squeezer())
    x0 = model.initial_state()
    np.testing.assert_allclose(x0[: len(START)], START, rtol=0, atol=1e-14)
    run = model.simulate((0.0, END), x0, method=method, rtol=1e-10, atol=1e-10)
    assert run.success, run.message
    angles, speeds = np.split(run.y[:, -1], 2)
    np.testing.assert_allclose(angles, ANGLES_AT_END, rtol=0, atol=2.2e-9)
    np.testing.assert_allclose(speeds, SPEEDS_AT_END, rtol=0, atol=1.1e-6)
