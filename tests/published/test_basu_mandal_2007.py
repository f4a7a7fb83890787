"""The Whipple bicycle in a general state, here and in SymBRiM.

Source: P. Basu-Mandal, A. Chatterjee, J. M. Papadopoulos, "Hands-free circular motions of a benchmark bicycle",
Proc. R. Soc. A 463 (2007), Table 1, in the coordinates of J. K. Moore, "Human control of a bicycle", 2012.
"""

import numpy as np
import pytest
from ecosystem.cases import whipple_bicycle

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def bicycle():
    return fb.compile_model(fb.models.whipple_bicycle())


def test_bicycle_in_a_general_state_has_the_accelerations_of_basu_mandal(bicycle):
    # P. Basu-Mandal, A. Chatterjee, J. M. Papadopoulos, "Hands-free circular motions of a benchmark bicycle",
    # Proc. R. Soc. A 463 (2007), Table 1, in the coordinates of Moore 2012.
    q = [0.0, -0.17447337661787718, 0.0, 0.6206670416476966, 0.3300446174593725, 0.0, -0.2311385135743, 0.0]
    u = [
        2.6703213326046784,
        -2.453592884421596e-14,
        -0.7830033527065,
        -0.6068425835418,
        0.0119185528069,
        -8.912989661489,
        -0.4859824687093,
        -8.0133620584155,
    ]
    expected = [
        -0.8353281706376822,
        7.855528112824374,
        -0.12055438978863461,
        -1.8472554144218631,
        4.6198904039391895,
        -2.4548072904552343,
    ]
    values = {f"{letter}{i}": value for letter, row in (("q", q), ("u", u)) for i, value in enumerate(row, start=1)}
    x = [values[name] for name in bicycle.states]
    rates = dict(zip(bicycle.states, bicycle.rhs(0.0, x), strict=True))
    np.testing.assert_allclose([rates[f"u{i}"] for i in range(3, 9)], expected, rtol=0, atol=5e-12)
    # The state satisfies the constraints to its printed digits.
    np.testing.assert_allclose(bicycle.position_constraints(0.0, x[:8]), 0.0, atol=1e-12)
    np.testing.assert_allclose(bicycle.velocity_constraints(0.0, x), 0.0, atol=1e-12)


@pytest.mark.slow
def test_symbrims_bicycle_in_a_general_state_has_the_published_accelerations():
    """Of the benchmark bicycle in a general state: P. Basu-Mandal, A. Chatterjee, J. M. Papadopoulos, Proc. R. Soc. A
    463 (2007), in the convention of J. K. Moore as SymBRiM's test has it."""
    built = whipple_bicycle(forces=True)()
    model = fb.compile_model(fb.Model(built.system, name="benchmark", parameters=built.values, extra="ignore"))
    q = (0.0, -0.17447337661787718, 0.0, 0.6206670416476966, 0.3300446174593725, 0.0, -0.2311385135743, 0.0)
    u = (
        2.6703213326046784, -2.453592884421596e-14, -0.7830033527065, -0.6068425835418, 0.0119185528069,
        -8.912989661489, -0.4859824687093, -8.0133620584155,
    )  # fmt: skip
    published = (
        0.5903429412631302, -2.090870556233152, -0.8353281706376822, 7.855528112824374, -0.12055438978863461,
        -1.8472554144218631, 4.6198904039391895, -2.4548072904552343,
    )  # fmt: skip
    state = {f"bike_q{i}": value for i, value in enumerate(q, 1)} | {
        f"bike_u{i}": value for i, value in enumerate(u, 1)
    }
    x = [state[name] for name in model.states]
    rates = dict(zip(model.states, model.rhs(0.0, x), strict=True))
    # The published state has 13 digits, and rates up to 10.
    np.testing.assert_allclose([rates[f"bike_u{i}"] for i in range(1, 9)], published, rtol=0, atol=1e-10)
    # At rest, upright: the normal forces that SymBRiM's test has.
    upright = model.initial_state(
        dict.fromkeys(model.coordinates[:7], 0.0), dict.fromkeys(model.speeds[:3], 0.0), guess={"bike_q5": 0.3}
    )
    forces = dict(zip(model.outputs, model.output(0.0, upright), strict=True))
    assert abs(forces["rear_tire_Fz"]) == pytest.approx(612.836470588236, rel=1e-9)
    assert abs(forces["front_tire_Fz"]) == pytest.approx(309.303529411765, rel=1e-9)
