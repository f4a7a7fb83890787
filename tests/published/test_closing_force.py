"""The force in a four-bar's closing joint, of SymPy's documentation."""

import numpy as np
import pytest
from builders.systems import closed_by_auxiliary_speeds

import fourbar_codegen as fb

# SymPy's documentation, four_bar_linkage_example: upright rectangle at rest. Link 4 presses on the ground with
# its own weight and half of that of link 3: 5 * 9.81 * (1 + 2 / 2) N.
RECTANGLE = [np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("unknown_forces", [True, False])
def test_closing_joint_force_of_sympys_documentation(unknown_forces):
    linkage = fb.compile_model(closed_by_auxiliary_speeds(unknown_forces=unknown_forces))
    names = ("F_x", "F_y") if unknown_forces else ("u_x", "u_y")
    assert linkage.outputs == (*names, "closing_x", "closing_y", "closing_z")
    np.testing.assert_allclose(linkage.rhs(0.0, RECTANGLE), 0.0, atol=1e-13)
    by_auxiliary_speeds, by_multipliers = np.split(linkage.output(0.0, RECTANGLE), [2])
    # The force on the end of link 4; the documentation prints the opposite, the force on the ground.
    np.testing.assert_allclose(by_multipliers, [0.0, 98.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(by_auxiliary_speeds, [0.0, 98.1], atol=1e-12)
