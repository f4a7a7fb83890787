"""Constraints that repeat each other."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.redundant import circle, pendulum, three_uprights
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


@pytest.mark.slow
@pytest.mark.parametrize("constraints", [(circle, 2 * circle), (circle, 3 * circle, -0.2 * circle)])
def test_repeated_constraints_change_nothing_but_the_multipliers(constraints):
    single = fb.compile_model(fb.models.cartesian_pendulum())
    repeated = fb.compile_model(pendulum(*constraints))
    x0 = single.initial_state([0.6], [0.5])
    np.testing.assert_allclose(repeated.initial_state([0.6], [0.5]), x0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(repeated.rhs(0.0, x0), single.rhs(0.0, x0), rtol=1e-13)
    # J^T lambda = M u' - f has many solutions; NumPy's lstsq gives the shortest.
    _, mass_matrix, forcing, jacobian, _ = repeated.kernel.dynamics(0.0, x0)
    reaction = mass_matrix @ repeated.rhs(0.0, x0)[2:] - forcing
    expected = np.linalg.lstsq(jacobian.T, reaction)[0]
    np.testing.assert_allclose(repeated.multipliers(0.0, x0), expected, rtol=1e-12)
    run = repeated.simulate((0.0, 1.0), x0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(
        run.y[:, -1], single.simulate((0.0, 1.0), x0, rtol=1e-10, atol=1e-10).y[:, -1], atol=1e-7
    )
    np.testing.assert_allclose(
        repeated.jacobian(0.0, x0),
        single.jacobian(0.0, x0),
        rtol=0,
        atol=1e-12 * np.abs(repeated.jacobian(0.0, x0)).max(),
    )


@pytest.mark.slow
def test_redundant_parallelogram_moves_as_an_inverted_pendulum():
    compiled = fb.compile_model(three_uprights())
    x0 = compiled.initial_state({"p0": 0.5}, {"v0": 0.7}, guess=[0.4, 0.6, 0.1])
    np.testing.assert_allclose(x0, [0.5, 0.5, 0.5, 0.0, 0.7, 0.7, 0.7, 0.0], atol=1e-9)
    # All masses swing alike, as inverted pendulums: l p'' = g sin p.
    expected = 9.81 * np.sin(0.5)
    np.testing.assert_allclose(compiled.rhs(0.0, x0)[4:], [expected] * 3 + [0.0], atol=1e-8)
    run = compiled.simulate((0.0, 0.5), x0, rtol=1e-9, atol=1e-9)
    assert run.success
    np.testing.assert_allclose(run["p0"], run["p2"], atol=1e-7)
    # The rows depend on each other on the constraint manifold alone; a run drifts from it.
    for size in (1e-12, 1e-9, 1e-6):
        x = x0 + size * np.array([0.3, -1.0, 0.7, 0.5, 0.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(compiled.rhs(0.0, x)[4:], [expected] * 3 + [0.0], atol=100 * size + 1e-8)
    # Started off it, and with loose tolerances: p'' = g sin p still.
    x0 = compiled.initial_state({"p0": 2.5}, {"v0": 0.3}, guess=[2.5, 2.5, 0.0])
    x0[:4] += 1e-9 * np.array([0.0, 1.0, -1.0, 0.5])
    run = compiled.simulate((0.0, 1.0), x0, rtol=1e-9, atol=1e-9)
    pendulum = solve_ivp(lambda t, y: [y[1], 9.81 * np.sin(y[0])], (0.0, 1.0), [2.5, 0.3], rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose([run["p0"][-1], run["v0"][-1]], pendulum.y[:, -1], atol=1e-6)


@pytest.mark.slow(but=["0.0"])
@pytest.mark.parametrize("g", [9.81, 0.0])
def test_redundant_rows_hold_to_the_size_of_their_terms(g):
    """Upright, or without gravity, p'' = (g / l) sin p = 0, and the terms l v^2 of gamma cancel: nothing is left that a
    violation could be compared with but these terms."""
    compiled = fb.compile_model(three_uprights())
    p = compiled.kernel.parameter_values({"g": g})
    for angle in (0.0, 0.9) if g == 0.0 else (0.0, np.pi):
        for size in (1e-13, 1e-12, 1e-10, 1e-8):
            for v in (1e-3, 1.0, 50.0):
                off = size * np.array([0.3, -1.0, 0.7, 0.5, *(v * np.array([-0.4, 0.2, 1.0, 0.1]))])
                rates = compiled.rhs(0.0, np.array([*[angle] * 3, 0.0, *[v] * 3, 0.0]) + off, p)[4:]
                # The violation times the slopes g / l and v^2 of the equations, some of each; and their rounding.
                np.testing.assert_allclose(rates, 0.0, atol=10 * (size + 1e-15) * (g + v**2))


@pytest.mark.slow
def test_contradictory_constraints_are_an_error():
    contradictory = fb.compile_model(pendulum(circle, circle - me.dynamicsymbols._t))
    with pytest.raises(fb.AssemblyError):
        contradictory.initial_state([0.6], [0.5], t=1.0)
    with pytest.raises(fb.SimulationError, match="no acceleration satisfies"):
        # d^2/dt^2 of the second is the same for t, so a quadratic time is needed for a contradiction in u'.
        fb.compile_model(pendulum(circle, circle - me.dynamicsymbols._t**2)).rhs(0.0, [0.6, -0.8, 0.0, 0.0])


@pytest.mark.slow
def test_independent_constraints_with_too_few_dependent_speeds_are_refused():
    model = pendulum(circle, me.dynamicsymbols("x") - sm.S.Half * me.dynamicsymbols("y"))
    with pytest.raises(fb.ModelError, match=r"2 velocity constraints are independent .* 1 dependent speed \(v_x\)"):
        fb.compile_model(model)
    both = fb.compile_model(model, check=False)
    closing = np.array([0.5, 1.0]) / np.sqrt(1.25)
    with pytest.raises(fb.AssemblyError, match="2 velocity constraints are independent"):
        both.initial_state([closing[1]], [0.0], guess=[closing[0]])
    x = [closing[1], closing[0], 0.0, 0.0]
    for evaluate in (both.rhs, both.multipliers, both.jacobian):
        with pytest.raises(fb.SimulationError, match="More than 1 velocity constraints are independent"):
            evaluate(0.0, x)
    with pytest.raises(fb.SimulationError, match="More than 1 velocity constraints are independent"):
        both.simulate((0.0, 1.0), x)


@pytest.mark.slow
@pytest.mark.parametrize("share", [1e-2, 1e-4, 1e-6])
def test_constraint_that_is_nearly_another_one_counts_as_independent(share):
    """x vx + y vy + w vx = 0 on a circle: with the circle's own rate, vx = 0, however small w is."""
    (x, y), (vx, vy) = me.dynamicsymbols("x y"), me.dynamicsymbols("v_x v_y")
    model = pendulum(circle)
    model.system.add_nonholonomic_constraints(x * vx + y * vy + share * vx)
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    nearly = fb.compile_model(fb.Model(model.system, name="nearly", parameters=values), check=False)
    with pytest.raises(fb.SimulationError, match="More than 1 velocity constraints are independent"):
        nearly.rhs(0.0, [0.6, -0.8, 0.0, 0.0])


@pytest.mark.slow
def test_loop_with_one_dependent_speed_too_few_is_refused():
    """The tutorial's linkage with u3 alone dependent: SymPy's form_eoms refuses it too."""
    linkage = fb.models.four_bar()
    system = linkage.system
    [q1, q2, q3], [u1, u2, u3] = system.q, system.u
    system.u_dep, system.u_ind, system.q_dep, system.q_ind = [u3], [u1, u2], [q3], [q1, q2]
    values = dict(zip(linkage.parameter_symbols, linkage.parameters.values(), strict=True))
    model = fb.Model(system, name="too_few", parameters=values, inputs=linkage.input_expressions)
    with pytest.raises(fb.ModelError, match=r"2 velocity constraints .* 1 dependent speed \(u3\)"):
        fb.compile_model(model)
    compiled = fb.compile_model(model, check=False)
    with pytest.raises(fb.SimulationError, match=r"dependent speed \(u3\)"):
        compiled.rhs(0.0, fb.load("four_bar").initial_state())


@pytest.mark.slow
def test_particle_with_two_constraints_and_one_dependent_speed_is_refused():
    """y = x and z = -x leave one degree of freedom: the compiler is not to blame."""
    (x, y, z), (vx, vy, vz) = me.dynamicsymbols("x y z"), me.dynamicsymbols("v_x v_y v_z")
    t = me.dynamicsymbols._t
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x + y * ground.y + z * ground.z)
    point.set_vel(ground, vx * ground.x + vy * ground.y + vz * ground.z)
    system = System(ground, origin)
    system.add_bodies(me.Particle("p", point, 1))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x, y], [z], [vx, vy], [vz]
    system.add_kdes(vx - x.diff(t), vy - y.diff(t), vz - z.diff(t))
    system.add_holonomic_constraints(y - x, z + x)
    with pytest.raises(fb.ModelError, match="2 velocity constraints are independent"):
        fb.compile_model(fb.Model(system, name="particle"))


def test_repeated_constraint_with_a_dependent_speed_too_many_has_single_rates():
    """Both speeds of a pendulum dependent, its constraint twice: the second row is dropped as it was."""
    single = fb.compile_model(fb.models.cartesian_pendulum())
    model = pendulum(circle, 2 * circle)
    system = model.system
    speeds = list(system.u)
    system.u_ind, system.u_dep = [], speeds
    values = dict(zip(model.parameter_symbols, model.parameters.values(), strict=True))
    both = fb.compile_model(fb.Model(system, name="both", parameters=values))
    x0 = single.initial_state([0.6], [0.5])
    np.testing.assert_allclose(both.rhs(0.0, x0), single.rhs(0.0, x0), rtol=1e-13)


def test_equilibrium_of_redundant_uprights_is_found_from_open_loops():
    """Away from closed loops nothing is redundant: the uprights hang, or stand, all alike."""
    compiled = fb.compile_model(three_uprights())
    np.testing.assert_allclose(np.sin(compiled.equilibrium([3.0, 3.1, 3.2, 0.1])), 0.0, atol=1e-9)
