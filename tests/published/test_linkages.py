"""Planar linkages whose inventors or users have published numbers; each test names them."""

from importlib import import_module

import numpy as np
import pytest

import fourbar_codegen as fb

mechanisms = import_module("11_mechanisms")


@pytest.mark.slow
def test_foot_of_klanns_leg_has_the_inventors_stride_and_height():
    """Step height 52.3 % and stride 1.000: http://www.mechanicalspider.com/concept.html."""
    drive, values, _ = mechanisms.MECHANISMS[mechanisms.klann]
    made = mechanisms.klann()
    model = fb.compile_model(made if isinstance(made, fb.Model) else made.model())
    x, y, _ = model.kinematics({drive: values})[0]["H"]
    assert np.ptp(y) / np.ptp(x) == pytest.approx(0.523, abs=5e-4)
    assert abs(x[0] - x[180]) == pytest.approx(1.000, abs=5e-4)


def test_angles_of_a_four_bars_arms_are_those_of_mathgroup():
    """Upper arm's angles for those of the lower arm, degrees, both assemblies: message 64453 (2006)."""
    points = {"A": (0, 0), "C": (13, 0), "F": (13, 7), "D": (5, 7)}
    model = fb.compile_model(fb.Linkage("arms", points=points, ground="AD", links=["AC", "CF", "DF"]).model())
    found = model.kinematics({"q_AC": np.radians([5, 25, 45, 60, 90])})
    table = [(8.14157, 42.7897, 88.0132, 131.266, 182.348), (279.009, 292.171, 327.201, 9.92425, 77.2632)]
    angles = np.degrees([branch["q_DF"] for branch in found])
    for row, expected in zip(angles, table, strict=True):
        away = (row - expected + 180.0) % 360.0 - 180.0
        np.testing.assert_allclose(away, 0.0, atol=6e-4)  # the last printed digit
