"""Derivatives of outputs with respect to state, parameters and inputs, against closed forms by complex steps."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.friction import MU, compiled, rod, rods_rates
from formulations.complex_steps import complex_steps
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

T = me.dynamicsymbols._t
G, M, L = sm.symbols("g m l")
DERIVATIVES = ("output_jacobian", "output_parameter_jacobian", "output_input_jacobian")


def hold(model, closed_form, t, x, p, r):
    """All derivatives of the outputs against those of a closed form of (x, p, r)."""
    values = model.output(t, x, p, r)
    np.testing.assert_allclose(values, closed_form(x, p, r), rtol=1e-12, atol=1e-12)
    for name, place in zip(DERIVATIVES, range(3), strict=True):
        arguments = [np.array(a, dtype=float) for a in (x, p, r)]

        def moved(point, arguments=arguments, place=place):
            return closed_form(*arguments[:place], point, *arguments[place + 1 :])

        expected = complex_steps(moved, arguments[place]).reshape(model.n_o, -1)
        got = getattr(model, name)(t, x, p, r)
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max(initial=1.0))


def pendulum_in_cartesian_coordinates(**more):
    """A bob on a rod, pushed by an input: the rod's force and the bob's acceleration as outputs."""
    x, y, u, v, push = me.dynamicsymbols("x y u v F")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, x * frame.x + y * frame.y)
    point.set_vel(frame, u * frame.x + v * frame.y)
    system = System(frame, origin)
    system.add_bodies(me.Particle("bob", point, M))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x], [y], [u], [v]
    system.kdes = [x.diff(T) - u, y.diff(T) - v]
    system.add_holonomic_constraints(x**2 + y**2 - L**2)
    system.apply_uniform_gravity(-G * frame.y)
    system.add_loads(me.Force(point, push * frame.x))
    outputs = {
        "tension": -2 * L * fb.multiplier(1),
        "acceleration": u.diff(T) * sm.sin(v) + M * v.diff(T) ** 2,
        "height": y + push * T,
    }
    values = {G: 9.81, M: 2.0, L: 0.5, sm.Symbol("k"): 3.0}
    return fb.Model(
        system, name="bob", parameters=values, inputs={push: sm.Symbol("k") * M}, outputs=outputs,
        initial={x: 0.3, u: 0.2, y: -0.4}, **more,
    )  # fmt: skip


def bobs_outputs(state, p, r):
    """By hand, also off the circle: m u' = F + J^T lambda with J = 2 (x, y), J u' + 2 (u^2 + v^2) = 0."""
    x, y, u, v = state
    g, m, length, _ = p
    multiplier = -(u**2 + v**2 + (x * r[0] / m - y * g)) / (2 * (x**2 + y**2) / m)
    a, b = r[0] / m + 2 * x * multiplier / m, -g + 2 * y * multiplier / m
    return np.array([-2 * length * multiplier, a * np.sin(v) + m * b**2, y + r[0] * 0.7])


def test_derivatives_of_outputs_with_multipliers_equal_complex_steps():
    model = fb.compile_model(pendulum_in_cartesian_coordinates())
    assert model.parameters == ("g", "m", "l", "k")
    for state in ([0.3, -0.4, 0.8, 0.6], [0.2, 0.5, -1.0, 0.3]):
        hold(model, bobs_outputs, 0.7, state, [9.81, 2.0, 0.5, 3.0], [1.5])
    # Where the input is its expression k m, parameters reach the outputs through it as well.
    p = [9.81, 2.0, 0.5, 3.0]
    state = [0.3, -0.4, 0.8, 0.6]
    expected = complex_steps(lambda p: bobs_outputs(state, p, [p[3] * p[1]]), p)
    np.testing.assert_allclose(model.output_parameter_jacobian(0.7, state, p), expected, rtol=1e-11, atol=1e-9)


def test_derivatives_of_outputs_with_auxiliary_states_equal_complex_steps():
    q, u, z, force = me.dynamicsymbols("q u z F")
    tau, k = sm.symbols("tau k")
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=M)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    system.add_loads(me.Force(block.masscenter, (z - k * q) * wall.x))
    outputs = {"slope": z.diff(T) * u.diff(T), "power": z * u}
    model = fb.compile_model(
        fb.Model(
            system, name="filtered", parameters={M: 2.0, k: 8.0, tau: 0.1}, inputs={force: 1.0}, outputs=outputs,
            state_equations={z: (force - z) / tau + u.diff(T)},
        )
    )  # fmt: skip

    def by_hand(state, p, r):
        q, u, z = state
        m, k, tau = p
        a = (z - k * q) / m
        return np.array([((r[0] - z) / tau + a) * a, z * u])

    hold(model, by_hand, 0.0, [0.3, -0.2, 0.7], [2.0, 8.0, 0.1], [1.5])


def test_derivatives_of_outputs_with_unknown_forces_equal_complex_steps():
    model = compiled(rod(lambda n: MU * n, "sliding_rod"))
    order = [model.parameters.index(name) for name in ("g", "m", "l", "J", "mu")]
    p = np.array([model.defaults[name] for name in model.parameters])
    hold(model, lambda x, p, r: np.array([rods_rates(x, [p[i] for i in order])[1]]), 0.0, [0.2, 0.4, 2.0, -3.0], p, [])


def test_linearization_with_outputs_equals_the_closed_form_of_c_and_d():
    """C and D in the independent coordinates, against the pendulum's own: y follows x on the circle."""
    model = fb.compile_model(pendulum_in_cartesian_coordinates())
    length, g, m, push = 0.5, 9.81, 2.0, 1.5
    state = model.initial_state({"x": 0.3}, {"u": 0.2}, guess={"y": -0.4})
    linear = model.linearize(0.0, state, r=[push], outputs=("tension", "height", "y", "x", "v"))
    A, B, C, D = linear
    assert (A.shape, B.shape, C.shape, D.shape) == ((2, 2), (2, 1), (5, 2), (5, 1))
    assert (linear.states, linear.inputs) == (("x", "u"), ("F",))
    assert linear.outputs == ("tension", "height", "y", "x", "v")

    def along(point):
        x, u, force = point
        y = -np.sqrt(length**2 - x**2)
        v = -x * u / y
        centripetal = m * (u**2 + v**2) / length
        return np.array([centripetal - m * g * y / length + force * x / length, y, y, x, v])

    expected = complex_steps(along, [0.3, 0.2, push])
    np.testing.assert_allclose(np.hstack((C, D)), expected, rtol=1e-11, atol=1e-11)
    for one, other in zip(model.linearize(0.0, state, r=[push]), (A, B), strict=True):
        np.testing.assert_array_equal(one, other)
    of_states = model.linearize(0.0, state, r=[push], outputs=[me.dynamicsymbols("y")])
    np.testing.assert_array_equal(of_states[2], C[2:3])
    assert [part.shape for part in model.linearize(0.0, state, outputs=[])] == [(2, 2), (2, 1), (0, 2), (0, 1)]
    with pytest.raises(
        fb.ModelError, match="no output 'pressure'; there are tension, acceleration, height, and the st"
    ):
        model.linearize(0.0, state, outputs=["pressure"])
    for wrong in ("tension", 5):
        with pytest.raises(fb.ModelError, match="sequence of names"):
            model.linearize(0.0, state, outputs=wrong)


@pytest.mark.slow
def test_derivatives_of_outputs_in_a_built_module_equal_complex_steps(tmp_path, unoptimized):
    model = fb.load(fb.build_model(pendulum_in_cartesian_coordinates(), tmp_path))
    hold(model, bobs_outputs, 0.7, [0.3, -0.4, 0.8, 0.6], [9.81, 2.0, 0.5, 3.0], [1.5])


@pytest.mark.slow
def test_derivatives_of_outputs_with_undetermined_multipliers_are_refused():
    made = pendulum_in_cartesian_coordinates()
    system = made.system
    system.add_holonomic_constraints(2 * system.holonomic_constraints[0])
    values = {symbol: parameter.value for symbol, parameter in made.parameter_symbols.items()}
    model = fb.compile_model(
        fb.Model(system, name="twice", parameters=values, inputs={me.dynamicsymbols("F"): 0.0},
                 outputs=made.output_expressions, extra="ignore")
    )  # fmt: skip
    assert np.isfinite(model.output(0.0, [0.3, -0.4, 0.8, 0.6])).all()
    with pytest.raises(fb.ModelError, match="outputs tension contain multipliers, which redundant constraints leave"):
        model.output_jacobian(0.0, [0.3, -0.4, 0.8, 0.6])
    model.jacobian(0.0, [0.3, -0.4, 0.8, 0.6])
    # Of outputs without multipliers there is a linear form: y = -sqrt(l^2 - x^2).
    *_, C, D = model.linearize(0.0, [0.3, -0.4, 0.8, 0.6], outputs=["height", "y"])
    np.testing.assert_allclose(C, [[0.3 / 0.4, 0.0]] * 2, atol=1e-12)
    assert not D.any()
    with pytest.raises(fb.ModelError, match="outputs tension contain"):
        model.linearize(0.0, [0.3, -0.4, 0.8, 0.6], outputs=["height", "tension"])
