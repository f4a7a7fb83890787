"""Forces in joints: auxiliary speeds, multipliers, and outputs."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import closed_by_auxiliary_speeds
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

t = me.dynamicsymbols._t
g = sm.Symbol("g")


def test_force_in_a_pivot_by_auxiliary_speeds_equals_the_closed_form():
    # A pendulum whose pivot is given auxiliary speeds. In polar form: the rod pulls the bob with
    # m (l u^2 + g cos q) towards the pivot, and the pivot's force on the rod is the same.
    q, u, ux, uy, fx, fy = me.dynamicsymbols("q u u_x u_y F_x F_y")
    m, length = sm.symbols("m l")
    ground, rod = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, pivot, bob = me.Point("O"), me.Point("P"), me.Point("Q")
    rod.orient_axis(ground, ground.z, q)
    rod.set_ang_vel(ground, u * ground.z)
    origin.set_vel(ground, 0)
    pivot.set_pos(origin, 0 * ground.x)
    pivot.set_vel(ground, ux * ground.x + uy * ground.y)
    bob.set_pos(pivot, -length * rod.y)
    bob.v2pt_theory(pivot, ground, rod)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.add_loads(me.Force(pivot, fx * ground.x + fy * ground.y))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_auxiliary_speeds(ux, uy)
    system.add_kdes(u - q.diff(t))
    along_rod = {"tension": m * (length * u**2 + g * sm.cos(q)), "tangential": m * length * u.diff(t)}
    model = fb.Model(system, name="pivoted", parameters={m: 2.0, length: 0.5, g: 9.81}, outputs=along_rod)
    pendulum = fb.compile_model(model)
    for angle, speed in ((0.0, 0.0), (0.7, -1.3), (2.5, 4.0)):
        force_x, force_y, tension, tangential = pendulum.output(0.0, [angle, speed])
        assert tension == pytest.approx(2.0 * (0.5 * speed**2 + 9.81 * np.cos(angle)), rel=1e-14)
        assert tangential == pytest.approx(-2.0 * 9.81 * np.sin(angle), rel=1e-14)
        np.testing.assert_allclose([force_x, force_y], tension * np.array([-np.sin(angle), np.cos(angle)]), atol=1e-13)


def test_joint_force_along_a_run_equals_the_multipliers(tmp_path):
    linkage = fb.compile_model(closed_by_auxiliary_speeds(unknown_forces=True))
    x0 = linkage.initial_state([2.0], [1.0], guess=[-2.0, -1.0])
    run = linkage.simulate((0.0, 0.3), x0, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(run["F_x"], run["closing_x"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.multipliers, run.outputs[:2], rtol=1e-9, atol=1e-9)
    assert "F_y" in run.save(tmp_path / "run.csv").read_text().splitlines()[0].split(",")


def test_inputs_auto_leaves_unknown_forces_to_auxiliary_speeds():
    """inputs="auto" leaves them to auxiliary speeds, and guesses nothing where there are more."""
    model = closed_by_auxiliary_speeds(unknown_forces=True)
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    automatic = fb.Model(model.system, parameters=values, inputs="auto")
    assert (automatic.outputs, automatic.inputs) == (("F_x", "F_y"), ())
    wind = me.dynamicsymbols("wind")
    body = model.system.bodies[0]
    model.system.add_loads(me.Force(body.masscenter, wind * model.system.frame.x))
    with pytest.raises(fb.ModelError, match=r"3 functions of time .*F_x, F_y, wind.* 2 auxiliary.*Name known"):
        fb.Model(model.system, parameters=values, inputs="auto")
    assert fb.Model(model.system, parameters=values, inputs={wind: 0}).outputs == ("F_x", "F_y")


def test_unknown_forces_that_auxiliary_speeds_do_not_determine_are_refused():
    model = closed_by_auxiliary_speeds(unknown_forces=True)
    system = model.system
    system.velocity_constraints = [entry.subs(me.dynamicsymbols("u_x"), 0) for entry in system.velocity_constraints]
    with pytest.raises(fb.ModelError, match=r"F_x, F_y do not follow from the auxiliary speeds u_x, u_y"):
        fb.generate_sources(fb.Model(system))
    system.u_aux = system.u_aux[:1]
    with pytest.raises(fb.ModelError, match=r"2 functions of time .* for 1 auxiliary"):
        fb.Model(system, inputs={})
