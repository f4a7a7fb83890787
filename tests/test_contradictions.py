"""Kinematics that contradict themselves are compiled as they were set, and not without a word."""

import re
import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System
from test_kanes_method import disc_without_an_angle

import fourbar_codegen as fb

T = me.dynamicsymbols._t


def pendulum(*, turns=1, moves=1, acceleration=None, angular=None, name="swing"):
    """A rigid bar on a pin whose angular velocity and velocity are set, times factors that should be 1."""
    q, u = me.dynamicsymbols("q u")
    m, g, length = sm.symbols("m g l")
    ground, bar, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("bar"), me.Point("O"), me.Point("C")
    bar.orient_axis(ground, ground.z, q)
    bar.set_ang_vel(ground, turns * u * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, -length * bar.y)
    center.set_vel(ground, moves * length * u * bar.x)
    if acceleration is not None:
        center.set_acc(ground, acceleration(center, origin, ground, bar))
    if angular is not None:
        bar.set_ang_acc(ground, angular * u.diff(T) * ground.z)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("bar", center, bar, m, (me.inertia(bar, 0, 0, m * length**2 / 12), center)))
    system.apply_uniform_gravity(-g * ground.y)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(T))
    return fb.Model(system, name=name, parameters={m: 1.0, g: 9.81, length: 0.5})


def of_the_point(center, origin, ground, bar):
    return center.a2pt_theory(origin, ground, bar)


def twice(center, origin, ground, bar):
    return 2 * center.a2pt_theory(origin, ground, bar)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"turns": 2}, r"angular velocity of frame bar, which was set, .* orientation"),
        ({"moves": 2}, r"velocity of point C, which was set, .* position"),
        ({"acceleration": twice}, r"acceleration of point C, which was set .*a2pt_theory.* SymPy's the former"),
        ({"angular": 2}, r"angular acceleration of frame bar, which was set, .* SymPy's the former"),
    ],
)
def test_a_contradiction_is_named(changes, sentence, tmp_path):
    model = pendulum(**changes, name=f"contradicts_{next(iter(changes))}")
    for _ in range(2):  # also where it comes from the cache
        with pytest.warns(fb.ModelWarning, match=sentence) as caught:
            fb.compile_model(model)
        assert [warning.filename for warning in caught] == [__file__]
        # The vectors are those of the state: one is twice the other.
        a, b = (np.fromstring(text, sep=",") for text in re.findall(r"\(([-\d., e]+)\)", str(caught[0].message)))
        np.testing.assert_allclose(a, 2 * b, rtol=0.02)
    with pytest.warns(fb.ModelWarning, match=sentence):
        fb.generate_sources(model)
    with pytest.warns(fb.ModelWarning, match=sentence):
        fb.build_model(model, tmp_path)


@pytest.mark.parametrize("changes", [{}, {"acceleration": of_the_point}, {"angular": 1}])
def test_what_is_set_as_it_follows_is_silent(changes):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(pendulum(**changes))


@pytest.mark.parametrize("name", fb.models.__all__)
def test_our_models_are_silent(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(getattr(fb.models, name)())


def test_the_contact_of_a_disc_is_silent_and_its_use_for_accelerations_is_not():
    """Of SymPy's disc, a2pt_theory from the contact, which is fixed in no body, gives equations with 2 u2 u3 in the
    place of 6/5 u2 u3; Kane's own are the latter."""
    kane, values = disc_without_an_angle()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(fb.Model(kane, parameters=values))
    [body] = kane.bodies
    contact = next(iter(body.masscenter._pos_dict))
    body.masscenter.a2pt_theory(contact, kane._inertial, body.frame)
    with pytest.warns(fb.ModelWarning, match="acceleration of point O"):
        fb.generate_sources(fb.Model(kane, parameters=values))


def test_velocities_that_constraints_make_right_are_silent():
    """A wheel whose velocity is that of rolling, beside coordinates of its place and the constraint that it rolls."""
    x, turn, v, spin = me.dynamicsymbols("x turn v spin")
    m, r = sm.symbols("m r")
    ground, wheel, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("W"), me.Point("O"), me.Point("C")
    wheel.orient_axis(ground, ground.z, turn)
    wheel.set_ang_vel(ground, spin * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, x * ground.x + r * ground.y)
    center.set_vel(ground, -r * spin * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("wheel", center, wheel, m, (me.inertia(wheel, 0, 0, m * r**2 / 2), center)))
    system.q_ind, system.u_ind, system.u_dep = [x, turn], [spin], [v]
    system.add_kdes(v - x.diff(T), spin - turn.diff(T))
    system.add_nonholonomic_constraints(v + r * spin)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(fb.Model(system, name="wheel"))
    system.nonholonomic_constraints = [v + 2 * r * spin]
    with pytest.warns(fb.ModelWarning, match="velocity of point C"):
        fb.generate_sources(fb.Model(system, name="wheel"))


def disc_that_slides(*, contact_velocity=1):
    """A disc in its plane on the ground, with friction at the point of it that touches the ground."""
    x, turn, v, spin = me.dynamicsymbols("x turn v spin")
    m, r, b = sm.symbols("m r b")
    ground, disc, origin, center = me.ReferenceFrame("N"), me.ReferenceFrame("D"), me.Point("O"), me.Point("C")
    disc.orient_axis(ground, ground.z, turn)
    disc.set_ang_vel(ground, spin * ground.z)
    origin.set_vel(ground, 0)
    center.set_pos(origin, x * ground.x + r * ground.y)
    center.set_vel(ground, v * ground.x)
    contact = center.locatenew("K", -r * ground.y)
    contact.v2pt_theory(center, ground, disc)
    contact.set_vel(ground, contact_velocity * contact.vel(ground))
    system = System(ground, origin)
    system.add_bodies(me.RigidBody("disc", center, disc, m, (me.inertia(disc, 0, 0, m * r**2 / 2), center)))
    system.add_loads(me.Force(contact, -b * contact.vel(ground)))
    system.add_coordinates(x, turn)
    system.add_speeds(v, spin)
    system.add_kdes(v - x.diff(T), spin - turn.diff(T))
    return fb.Model(system, name="slides")


def test_a_point_of_a_body_for_a_moment_is_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fb.generate_sources(disc_that_slides())
    with pytest.warns(fb.ModelWarning, match="velocity of point K"):
        fb.generate_sources(disc_that_slides(contact_velocity=2))


def test_what_is_wrong_on_one_side_alone():
    q = me.dynamicsymbols("q")
    with pytest.warns(fb.ModelWarning, match="velocity of point C"):
        fb.generate_sources(pendulum(moves=sm.sign(q)))


def test_the_frame_of_a_torque():
    model = pendulum()
    bar = model.system.bodies[0].frame
    handle = bar.orientnew("handle", "Axis", [0.3, bar.z])
    handle.set_ang_vel(model.system.frame, 3 * me.dynamicsymbols("u") * bar.z)
    model.system.add_loads(me.Torque(handle, bar.z))
    with pytest.warns(fb.ModelWarning, match="angular velocity of frame handle"):
        fb.generate_sources(fb.Model(model.system, name="turned"))
