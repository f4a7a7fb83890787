"""KanesMethod as input, read again instead of its projected matrices."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me

import fourbar_codegen as fb


def kanes_method(system, **changes):
    """The KanesMethod that a System makes of itself, with its own velocity constraints spelled out."""
    arguments = {
        "kd_eqs": system.kdes[:],
        "q_dependent": system.q_dep[:],
        "configuration_constraints": system.holonomic_constraints[:],
        "u_dependent": system.u_dep[:],
        "velocity_constraints": system.velocity_constraints[:],
        "bodies": system.bodies,
        "forcelist": [*system.loads, *system.actuators],
        "explicit_kinematics": False,
        "constraint_solver": "CRAMER",
    } | changes
    return me.KanesMethod(system.frame, system.q_ind[:], system.u_ind[:], **arguments)


@pytest.mark.parametrize("name", ["four_bar", "rolling_disc", "whipple_bicycle", "cartesian_pendulum"])
def test_same_as_the_system(name):
    model = getattr(fb.models, name)()
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    kane = kanes_method(model.system)
    from_kane = fb.compile_model(fb.Model(kane, name="from_kane", parameters=values, inputs=model.input_expressions))
    from_system = fb.compile_model(model)
    assert from_kane.states == from_system.states
    generator = np.random.default_rng(3)
    for x in generator.uniform(-1.0, 1.0, (5, from_system.n_x)):
        expected = from_system.rhs(0.3, x)
        # Two solves of the same equations, rounded in another order.
        tolerance = 1e-13 * np.linalg.cond(from_system.mass_matrix(0.3, x)) * np.abs(expected).max()
        np.testing.assert_allclose(from_kane.rhs(0.3, x), expected, rtol=0, atol=tolerance)


def test_against_its_own_equations():
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    t = me.dynamicsymbols._t
    ground, rod, origin, bob = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O"), me.Point("P")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    bob.set_pos(origin, -length * rod.y)
    bob.v2pt_theory(origin, ground, rod)
    particle = me.Particle("bob", bob, m)
    kane = me.KanesMethod(
        ground, [q], [u], kd_eqs=[u - q.diff(t)], bodies=[particle], forcelist=[(bob, -m * g * ground.y)]
    )
    kane.kanes_equations()
    compiled = fb.compile_model(fb.Model(kane, name="simple", parameters={m: 2.0, g: 9.81, length: 0.7}))
    expected = kane.rhs().subs({q: 0.4, u: 1.0, g: 9.81, length: 0.7, m: 2.0})
    np.testing.assert_allclose(compiled.rhs(0.0, [0.4, 1.0]), np.array(expected, dtype=float).ravel(), rtol=1e-14)


def test_what_is_missing_is_said():
    model = fb.models.four_bar()
    with pytest.raises(fb.ModelError, match="no bodies"):
        fb.Model(kanes_method(model.system, bodies=None))
    with pytest.raises(fb.ModelError, match=r"3 generalized coordinates .* but 0 kinematic"):
        fb.Model(kanes_method(model.system, kd_eqs=None))
