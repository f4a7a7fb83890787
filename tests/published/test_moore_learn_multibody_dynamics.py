"""Numbers in J. K. Moore, Learn Multibody Dynamics, https://moorepants.github.io/learn-multibody-dynamics."""

import numpy as np
import pytest
from drift import model as point_mass_four_bar

import fourbar_codegen as fb


@pytest.mark.slow
@pytest.mark.parametrize(("tolerances", "published"), [((1e-3, 1e-6), 8e-3), ((1e-10, 1e-10), 5e-10)])
def test_loops_that_ida_closes_by_itself_are_open_by_no_more_than_published(tolerances, published):
    """ "Equations of Motion with Holonomic Constraints": less than 8 mm in 30 s, and less than 5e-10 m at 1e-10."""
    linkage = fb.compile_model(point_mass_four_bar())
    x0 = linkage.initial_state(np.deg2rad([10.0]), [0.0], guess=np.deg2rad([10.0, -150.0]))
    rtol, atol = tolerances
    run = linkage.simulate((0.0, 30.0), x0, method="IDA", constraints="none", rtol=rtol, atol=atol)
    assert run.success
    assert np.linalg.norm(run.constraint_residual, axis=0).max() < published
