"""The compiled functions against SymPy's own equations, as the tutorial evaluates them."""

import numpy as np
import pytest

EPS = np.finfo(float).eps


def random_states(four_bar, count, *, closed):
    """States with the loop open, or with the loop and the velocities closed."""
    generator = np.random.default_rng(20)
    states = []
    while len(states) < count:
        x = np.concatenate((generator.uniform(-np.pi, np.pi, 3), generator.normal(size=3)))
        if closed:
            q1 = generator.uniform(-3.0, 3.0)
            guess = [-1.5, -1.5] if generator.random() < 0.5 else [1.5, 1.5]
            x = four_bar.initial_state([q1], [x[3]], guess=guess)
        states.append(x)
    return states


@pytest.mark.slow(but=["on the manifold"])
@pytest.mark.parametrize("closed", [False, True], ids=["off the manifold", "on the manifold"])
def test_rates_and_mass_matrix_on_and_off_closed_loops_equal_sympys(four_bar, tutorial, closed):
    # form_eoms eliminates the dependent speeds with J_d, so its rounding errors grow with cond(J_d), squared
    # because J_d appears on both sides of the mass matrix.
    for t, x in zip(np.linspace(0.0, 2.0, 500), random_states(four_bar, 500, closed=closed), strict=True):
        expected = tutorial.rhs(t, x)
        mass_matrix, forcing = tutorial.evaluate(x, tutorial.p_values, tutorial.inputs(t), t)
        condition = np.linalg.cond(four_bar.constraint_jacobian(t, x[:3])[:, 1:])
        tolerance = 1000 * EPS * condition**2
        assert np.abs(four_bar.rhs(t, x) - expected).max() <= tolerance * np.abs(expected).max()
        expected = mass_matrix[3:, 3:]
        assert np.abs(four_bar.mass_matrix(t, x) - expected).max() <= tolerance * np.abs(expected).max()
        expected = forcing[3:].ravel()
        # The forcing is a difference of the bodies' forces, which may cancel: their size counts.
        scale = np.abs(four_bar.tree_forcing(t, x)).max()
        assert np.abs(four_bar.forcing(t, x) - expected).max() <= tolerance * scale


def test_constraints_and_their_jacobian_at_random_states_equal_sympys(four_bar, tutorial):
    import sympy as sm

    system = tutorial.system
    residuals = sm.lambdify((system.q, tutorial.p), system.holonomic_constraints[:], cse=True)
    jacobian = sm.lambdify((system.q, tutorial.p), system.holonomic_constraints.jacobian(system.q), cse=True)
    for x in random_states(four_bar, 100, closed=False):
        # Sums of at most 4 products of lengths around 1: rounding errors of a few eps.
        np.testing.assert_allclose(
            four_bar.position_constraints(0.0, x[:3]), residuals(x[:3], tutorial.p_values), rtol=0, atol=20 * EPS
        )
        expected = jacobian(x[:3], tutorial.p_values)
        np.testing.assert_allclose(four_bar.constraint_jacobian(0.0, x[:3]), expected, rtol=0, atol=40 * EPS)
        np.testing.assert_allclose(four_bar.velocity_constraints(0.0, x), expected @ x[3:], rtol=0, atol=100 * EPS)


def test_jacobian_against_complex_steps_through_sympys_equations(four_bar, tutorial):
    # Im f(x + ih) / h is the derivative without cancellation: no step size to choose (Squire and Trapp 1998).
    step = 1e-30
    for t, x in zip(np.linspace(0.0, 2.0, 50), random_states(four_bar, 50, closed=False), strict=True):
        expected = np.column_stack([tutorial.rhs(t, x + 1j * step * direction).imag / step for direction in np.eye(6)])
        # As above: the derivative of the solution is a solution with the same J_d.
        tolerance = 1000 * EPS * np.linalg.cond(four_bar.constraint_jacobian(t, x[:3])[:, 1:]) ** 2
        assert np.abs(four_bar.jacobian(t, x) - expected).max() <= tolerance * np.abs(expected).max()


def test_multipliers_at_closed_states_balance_the_equations_with_sympys_rates(four_bar, tutorial):
    # M u' = f + J^T lambda and J u' + gamma = 0, with u' from SymPy's equations.
    for x in random_states(four_bar, 100, closed=True):
        accelerations = tutorial.rhs(0.5, x)[3:]
        _, mass_matrix, forcing, jacobian, bias = four_bar.kernel.dynamics(0.5, x)
        multipliers = four_bar.multipliers(0.5, x)
        scale = np.abs(forcing).max() + np.abs(mass_matrix @ accelerations).max()
        residual = mass_matrix @ accelerations - forcing - jacobian.T @ multipliers
        tolerance = 1000 * EPS * np.linalg.cond(jacobian[:, 1:]) ** 2
        assert np.abs(residual).max() <= tolerance * scale
        assert np.abs(jacobian @ accelerations + bias).max() <= tolerance * scale


def test_run_without_projection_takes_the_steps_of_the_tutorials_run(four_bar, tutorial):
    from scipy.integrate import solve_ivp

    x0 = tutorial.initial_state([-0.5], [-0.1], [-1.5, -1.5], [0.5, -0.5])
    expected = solve_ivp(tutorial.rhs, (0, 4), x0)
    run = four_bar.simulate((0.0, 4.0), x0, method="RK45", rtol=1e-3, atol=1e-6, constraints="none")
    assert run.nfev == expected.nfev == 122
    assert len(run.t) == len(expected.t) == 19
    np.testing.assert_allclose(run.t, expected.t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.y, expected.y, rtol=0, atol=1e-9)
