"""The SymBRiM tutorial, and SymPy's four-bar matrices."""

import numpy as np

# The tutorial's numbers: SymBRiM tutorial "Four-bar Linkage". The printed ones have 8 to 15 digits; the full
# ones come from a code in absolute angles with the constraints in a KKT matrix, without SymPy.
Q0_PRINTED = [-0.5, -2.24641553739307, -1.49782726919522]
U0_PRINTED = [-0.1, 0.0715829929380234, -0.0274688413154955]
RATES_PRINTED = [-0.1, 0.07158299, -0.02746884, -9.26918156, 6.63703663, -2.55110976]
Q0 = [-0.5, -2.2464155373927537, -1.4978272691959325]
ACCELERATIONS = [-9.26918156051222, 6.637036631995938, -2.5511097559793323]


def test_initial_state_of_the_tutorial(four_bar):
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
    np.testing.assert_allclose(x0[:3], Q0, rtol=0, atol=1e-9)
    # The tutorial's own fsolve stopped 2e-12 short of the full-precision values.
    np.testing.assert_allclose(x0, [*Q0_PRINTED, *U0_PRINTED], rtol=0, atol=1e-9)


def test_rates_of_the_tutorial(four_bar):
    x0 = np.array([*Q0, *four_bar.initial_state({"q1": -0.5}, {"u1": -0.1})[3:]])
    rates = four_bar.rhs(0.0, x0)
    np.testing.assert_allclose(rates[3:], ACCELERATIONS, rtol=0, atol=1e-11)
    np.testing.assert_allclose(rates, RATES_PRINTED, rtol=0, atol=5.1e-9)  # half a unit of the last printed digit


def test_four_bar_matrices_of_sympy(four_bar):
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
