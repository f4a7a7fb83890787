"""What a kernel written by hand evaluates at single states and in batches, against the pendulum's closed forms.

Eliminating the multiplier of M u' = f + J^T lambda, J u' + gamma = 0 gives, for q = (x, y) and any state,

    lambda = -(q . f + m u . u) / (2 q . q),     u' = f / m + 2 lambda q / m.

Derivatives are those of these formulas by complex steps, which have no truncation error (W. Squire, G. Trapp, "Using
complex variables to estimate derivatives of real functions", SIAM Review 40, 1998). Where no other reason is given, the
tolerance is 1e-13: some 20 operations on numbers of the size 10, each within half a unit in the last place.
"""

import numpy as np
import pytest
from builders.hand_written_pendulum import GRAVITY, LENGTH, MASS, Swing, Turn, states_at

import fourbar_codegen as fb
from fourbar_codegen.runtime.enumerations import Role

PARAMETERS = [LENGTH, GRAVITY, MASS]
STATES = {
    "at rest": states_at(LENGTH, 0.7, 0.0),
    "fast": states_at(LENGTH, -2.1, 9.0),
    "level": states_at(LENGTH, np.pi / 2, 1.0),
    "on top": states_at(LENGTH, np.pi, 5.0),
    "off the circle": np.array([0.9, -0.2, 1.3, 2.1]),
}


def multiplier(x, p, r):
    q, u, force = x[:2], x[2:], np.array([r[0], -p[2] * p[1]])
    return -(q @ force + p[2] * u @ u) / (2.0 * q @ q)


def rates(x, p, r):
    force = np.array([r[0], -p[2] * p[1]])
    return np.concatenate((x[2:], (force + 2.0 * multiplier(x, p, r) * x[:2]) / p[2]))


def outputs(x, p, r):
    return np.array([x[1] + p[0], -2.0 * p[0] * multiplier(x, p, r)])


def derivatives(function, x, p, r):
    """Those with respect to x, p and r, of the shapes (n, 4), (n, 3) and (n, 1)."""
    point = np.concatenate((x, p, r)).astype(complex)
    columns = []
    for i in range(len(point)):
        moved = point.copy()
        moved[i] += 1e-30j
        columns.append(function(moved[:4], moved[4:7], moved[7:]).imag / 1e-30)
    return np.split(np.array(columns).T, [4, 7], axis=1)


@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("force", [0.0, 7.0])
def test_accelerations_and_multipliers_are_those_without_constraint_rows(either_pendulum, name, force):
    """Of equal rows each has half of the multiplier, which is the minimum-norm solution."""
    x, r = STATES[name], [force]
    np.testing.assert_allclose(either_pendulum.rhs(0.0, x, r=r), rates(x, PARAMETERS, r), rtol=1e-13, atol=1e-13)
    rows = either_pendulum.n_c
    expected = np.full(rows, multiplier(x, PARAMETERS, r) / rows)
    np.testing.assert_allclose(either_pendulum.multipliers(0.0, x, r=r), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("angle", "rate"), [(0.0, 0.0), (0.4, -2.0), (2.9, 6.0)])
def test_outputs_of_the_pendulum_are_its_height_and_the_force_in_its_rod(either_pendulum, angle, rate):
    """By the balance of forces along the rod, m l a'^2 = T - m g cos a."""
    tension = MASS * (LENGTH * rate**2 + GRAVITY * np.cos(angle))
    found = either_pendulum.output(0.0, states_at(LENGTH, angle, rate))
    np.testing.assert_allclose(found, [LENGTH * (1.0 - np.cos(angle)), tension], rtol=1e-13, atol=1e-13)


def test_energies_of_the_pendulum_are_those_of_a_point_mass(pendulum):
    x = states_at(LENGTH, 0.4, -2.0)
    assert pendulum.kinetic_energy(0.0, x) == pytest.approx(MASS * (LENGTH * 2.0) ** 2 / 2.0, rel=1e-15)
    assert pendulum.potential_energy(0.0, x) == pytest.approx(-MASS * GRAVITY * LENGTH * np.cos(0.4), rel=1e-15)


def test_momentum_of_the_pendulum_is_that_of_a_point_mass(pendulum):
    x = states_at(LENGTH, 0.4, -2.0)
    momentum, about_pivot, spin = pendulum.momentum(0.0, x)
    np.testing.assert_allclose(momentum, [MASS * x[2], MASS * x[3], 0.0], rtol=1e-15)
    np.testing.assert_allclose(about_pivot, [0.0, 0.0, MASS * LENGTH**2 * -2.0], rtol=1e-15)
    assert spin.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda k: k.evaluate(len(Role), 0.0, [0.0] * k.n_x), "The roles of functions are 0 to"),
        (lambda k: k.evaluate(-1, 0.0, [0.0] * k.n_x), "The roles of functions are 0 to"),
        (lambda k: k.described(10**6), "The roles of functions are 0 to"),
        (lambda k: k.evaluate(Role.COORDINATE_CHANGE, 0.0, [0.0] * k.n_x), "takes 1 arguments, not 0"),
        (
            lambda k: k.evaluate_along({Role.ENERGY: (0, 7)}, [0.0], np.zeros((k.n_x, 1)), np.zeros((k.n_r, 1))),
            "has 1 results",
        ),
    ],
)
def test_functions_and_results_that_the_table_does_not_have_are_refused(pendulum, call, words):
    with pytest.raises(fb.ModelError, match=words):
        call(pendulum.kernel)


def test_a_state_where_the_jacobian_vanishes_is_reported_as_singular(either_pendulum):
    with pytest.raises(fb.SimulationError, match="lost rank"):
        either_pendulum.rhs(0.0, [0.0, 0.0, 1.0, 0.0])


def test_a_mass_of_zero_is_reported(pendulum):
    with pytest.raises(fb.SimulationError, match="mass"):
        pendulum.rhs(0.0, STATES["at rest"], p={"m": 0.0})


@pytest.mark.parametrize("name", STATES)
def test_jacobians_are_complex_steps_of_the_closed_form(either_pendulum, name):
    x, r = STATES[name], [2.0]
    by_x, by_p, by_r = derivatives(rates, x, PARAMETERS, r)
    np.testing.assert_allclose(either_pendulum.jacobian(0.0, x, r=r), by_x, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(either_pendulum.parameter_jacobian(0.0, x, r=r), by_p, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(either_pendulum.input_jacobian(0.0, x, r=r), by_r, rtol=1e-12, atol=1e-12)
    for method, by in zip(
        ("output_jacobian", "output_parameter_jacobian", "output_input_jacobian"),
        derivatives(outputs, x, PARAMETERS, r),
        strict=True,
    ):
        np.testing.assert_allclose(getattr(either_pendulum, method)(0.0, x, r=r), by, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("columns", [1, 3, 8, 11])
def test_products_with_directions_and_weights_are_those_of_the_jacobians(either_pendulum, columns):
    """More directions than FB_DIRECTIONS = 8 are taken in blocks."""
    x, r, random = STATES["fast"], [2.0], np.random.default_rng(columns)
    by_x, by_p, by_r = derivatives(rates, x, PARAMETERS, r)
    dx, dp, dr = (random.normal(size=(n, columns)) for n in (4, 3, 1))
    found = either_pendulum.jvp(0.0, x, dx, dp, dr, r=r)
    np.testing.assert_allclose(found, by_x @ dx + by_p @ dp + by_r @ dr, rtol=1e-12, atol=1e-12)
    weights = random.normal(size=4)
    for part, by in zip(either_pendulum.vjp(0.0, x, weights, r=r), (by_x, by_p, by_r), strict=True):
        np.testing.assert_allclose(part, weights @ by, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 7, 33])
@pytest.mark.parametrize("varied", [False, True])
def test_batches_of_states_have_the_rates_of_each_state(either_pendulum, n, varied):
    """Among the states are level ones, where y, the speed solved for first, does not determine the other."""
    random = np.random.default_rng(n)
    x = states_at(LENGTH, random.uniform(-np.pi, np.pi, n), random.normal(size=n))
    x[:, ::5] = STATES["level"][:, np.newaxis]
    p, r = np.tile(np.array(PARAMETERS)[:, np.newaxis], n), random.normal(size=(1, n))
    if varied:
        p[1:] *= random.uniform(0.5, 2.0, (2, n))
    expected = np.array([rates(*each) for each in zip(x.T, p.T, r.T, strict=True)]).T
    found = either_pendulum.rhs_batch(0.0, x, p if varied else None, r)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    slopes = np.array([derivatives(rates, *each)[0] for each in zip(x.T, p.T, r.T, strict=True)])
    found = either_pendulum.jacobian_batch(0.0, x, p if varied else None, r)
    np.testing.assert_allclose(found, np.moveaxis(slopes, 0, 2), rtol=1e-11, atol=1e-11)


def test_a_batch_marks_its_singular_state_alone(either_pendulum):
    x = np.tile(STATES["fast"][:, np.newaxis], 5)
    x[:2, 3] = 0.0
    found = either_pendulum.rhs_batch(0.0, x)
    assert np.isnan(found[:, 3]).all()
    expected = np.tile(rates(STATES["fast"], PARAMETERS, [0.0])[:, np.newaxis], 4)
    np.testing.assert_allclose(np.delete(found, 3, axis=1), expected, rtol=1e-13)


def residual(x, x_rates, multipliers, p, r, formulation):
    """The equations of motion with everything on one side, for one state."""
    q, u, a = x[:2], x[2:], x_rates[2:]
    force = np.array([r[0], -p[2] * p[1]])
    constraint = q @ q - p[0] ** 2 if formulation == "index-3" else 2.0 * (q @ a + u @ u)
    rows = np.full(len(multipliers), constraint)
    return np.concatenate((x_rates[:2] - u, p[2] * a - force - 2.0 * multipliers.sum() * q, rows))


@pytest.mark.parametrize("formulation", ["index-1", "index-3"])
def test_residuals_at_many_states_are_those_of_the_equations(either_pendulum, formulation):
    """And their Jacobians are complex steps of them; at arbitrary numbers, which satisfy nothing."""
    random, n = np.random.default_rng(4), 5
    rows = either_pendulum.n_c
    x, x_rates, multipliers = (random.normal(size=(k, n)) for k in (4, 4, rows))
    r = random.normal(size=(1, n))
    found = either_pendulum.residual_batch(0.0, x, x_rates, multipliers, r=r, formulation=formulation)
    slopes = either_pendulum.residual_jacobian_batch(0.0, x, x_rates, multipliers, r=r, formulation=formulation)
    for i in range(n):
        given = {"x": x[:, i], "rates": x_rates[:, i], "multipliers": multipliers[:, i]}
        given |= {"p": np.array(PARAMETERS), "r": r[:, i]}
        expected = residual(*given.values(), formulation)
        np.testing.assert_allclose(found[:, i], expected, rtol=0.0, atol=1e-13)
        for name, point in given.items():
            for j in range(len(point)):
                moved = point.astype(complex)
                moved[j] += 1e-30j
                column = residual(*(given | {name: moved}).values(), formulation).imag / 1e-30
                np.testing.assert_allclose(slopes[name][:, j, i], column, rtol=0.0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_initial_state_is_on_the_side_of_its_guess(either_pendulum, sign):
    """y = +- sqrt(l^2 - x^2), u_y = -x u_x / y; Newton's method ends within 1e-14 of the size of Phi."""
    x = either_pendulum.initial_state([0.5], [2.0], guess=[0.7 * sign])
    y = sign * np.sqrt(LENGTH**2 - 0.25)
    np.testing.assert_allclose(x, [0.5, y, 2.0, -0.5 * 2.0 / y], rtol=1e-14)


def test_derivatives_of_the_initial_state_are_those_of_the_circle(pendulum):
    _, by = pendulum.initial_state([0.5], [2.0], guess=[-0.7], derivatives=True)
    y = -np.sqrt(LENGTH**2 - 0.25)
    # dy = -x/y dx + l/y dl; u_y = -x u_x / y, so du_y = -u_x/y dx - x/y du_x + x u_x/y^2 dy
    np.testing.assert_allclose(by["x"], [1.0, -0.5 / y, 0.0, -2.0 / y - 0.25 * 2.0 / y**3], rtol=1e-13)
    np.testing.assert_allclose(by["u_x"], [0.0, 0.0, 1.0, -0.5 / y], rtol=1e-13)
    np.testing.assert_allclose(by["l"], [0.0, LENGTH / y, 0.0, LENGTH * 0.5 * 2.0 / y**3], rtol=1e-13)
    assert not np.any(by["m"])


def test_an_initial_state_outside_of_the_circle_is_refused(pendulum):
    with pytest.raises(fb.AssemblyError):
        pendulum.initial_state([1.01 * LENGTH], [0.0], guess=[-0.1])


@pytest.mark.parametrize("stretch", [1e-9, 1e-4, 0.05])
def test_projection_moves_the_mass_along_its_radius(either_pendulum, stretch):
    """For M = m 1 the mass-orthogonal direction is J^T, the radius at which the factors were taken."""
    x = np.array([0.6, -0.8, 1.0, 2.0])
    x[:2] *= LENGTH * (1.0 + stretch)
    found = either_pendulum.ode().project(0.0, x)
    q = LENGTH * np.array([0.6, -0.8])
    # The violation is closed to 1e-14 of the sizes of its terms.
    np.testing.assert_allclose(found, [*q, *(x[2:] - q * (q @ x[2:]) / (q @ q))], rtol=5e-14)


def test_linearization_at_the_lowest_point_is_that_of_small_oscillations(pendulum):
    A, B = pendulum.linearize(0.0, states_at(LENGTH, 0.0, 0.0))
    np.testing.assert_allclose(A, [[0.0, 1.0], [-GRAVITY / LENGTH, 0.0]], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(B, [[0.0], [1.0 / MASS]], rtol=1e-14, atol=1e-14)


def test_equilibrium_with_a_horizontal_force_is_along_the_sum_of_the_forces(pendulum):
    x = pendulum.equilibrium([0.1, -0.7], inputs={"F": 5.0})
    weight = MASS * GRAVITY
    # The solver ends at accelerations of 1e-9 or so of g.
    np.testing.assert_allclose(x, states_at(LENGTH, np.arctan2(5.0, weight), 0.0), atol=1e-8)


def test_closed_forms_of_the_motions_satisfy_the_equations_of_motion():
    """Of the references: differences of order 4, with h = 1e-3 and derivatives of the order of w^5 = 500."""
    for motion in (Swing(0.3), Swing(3.0), Turn(7.3), Turn(20.0)):
        for t in (0.0, 0.21, 1.3):
            ahead = [motion.states(t + k * 1e-3) for k in (-2, -1, 1, 2)]
            difference = (ahead[0] - 8.0 * ahead[1] + 8.0 * ahead[2] - ahead[3]) / 12e-3
            np.testing.assert_allclose(difference, rates(motion.states(t), PARAMETERS, [0.0]), atol=1e-5)
