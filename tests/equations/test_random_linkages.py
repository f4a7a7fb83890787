"""Linkages drawn at random, against SymPy's own equations."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from sympy.physics.mechanics.system import System
from tutorial import Tutorial

import fourbar_codegen as fb

EPS = np.finfo(float).eps
SIZES = st.floats(0.2, 2.0, allow_nan=False)


@st.composite
def linkages(draw):
    """A tree of 2 to 6 bars with springs, dampers and forces, closed by a loop at times; its values."""
    planar = draw(st.booleans())
    count = draw(st.integers(2, 6 if planar else 3))
    closed = planar and count > 2 and draw(st.booleans())
    values = {}

    def symbol(name, value):
        values[sm.Symbol(name)] = value
        return sm.Symbol(name)

    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    q, u = me.dynamicsymbols(f"q1:{count + 1}"), me.dynamicsymbols(f"u1:{count + 1}")
    g = symbol("g", 9.81)
    frames, ends = [ground], [origin]
    for i in range(count):
        parent = i if closed else draw(st.integers(max(0, i - 1), i))
        axis = "z" if planar else draw(st.sampled_from("xyz"))
        bar, center, end = me.ReferenceFrame(f"B{i}"), me.Point(f"C{i}"), me.Point(f"P{i}")
        bar.orient_axis(frames[parent], getattr(frames[parent], axis), q[i])
        bar.set_ang_vel(frames[parent], u[i] * getattr(frames[parent], axis))
        length, mass = symbol(f"l{i}", draw(SIZES)), symbol(f"m{i}", draw(SIZES))
        for point, distance in ((center, length / 2), (end, length)):
            point.set_pos(ends[parent], distance * bar.x)
            point.v2pt_theory(ends[parent], ground, bar)
        inertia = me.inertia(bar, *(symbol(f"I{letter}{i}", draw(SIZES)) for letter in "xyz"))
        system.add_bodies(me.RigidBody(f"bar{i}", center, bar, mass, (inertia, center)))
        if draw(st.booleans()):
            torque = -symbol(f"k{i}", draw(SIZES)) * q[i] - symbol(f"c{i}", draw(SIZES)) * u[i]
            system.add_actuators(me.TorqueActuator(torque, getattr(frames[parent], axis), bar, frames[parent]))
        if draw(st.booleans()):
            force = symbol(f"f{i}", draw(SIZES)) * sm.cos(3 * me.dynamicsymbols._t)
            system.add_loads(me.Force(end, force * (bar.y if draw(st.booleans()) else ground.x)))
        frames.append(bar)
        ends.append(end)
    system.apply_uniform_gravity(-g * ground.y)
    system.add_kdes(*(ui - qi.diff(me.dynamicsymbols._t) for qi, ui in zip(q, u, strict=True)))
    n_i = count - 2 if closed else count
    if closed:
        gap = ends[-1].pos_from(origin) - symbol("d", draw(SIZES)) * ground.x
        system.add_holonomic_constraints(gap.dot(ground.x), gap.dot(ground.y))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:n_i], q[n_i:], u[:n_i], u[n_i:]
    states = draw(st.lists(st.floats(-1.5, 1.5, allow_nan=False), min_size=2 * count, max_size=2 * count))
    return system, values, np.array(states)


# Each example takes seconds: no shrinking. That most are dropped by what a test assumes is still an error.
@pytest.mark.slow
@settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(linkages())
def test_rates_and_jacobian_of_random_linkages_equal_sympys(linkage):
    system, values, x = linkage
    model = fb.Model(system, name="linkage", parameters={})
    compiled = fb.compile_model(model)
    p = [values[sm.Symbol(name)] for name in compiled.parameters]
    jacobian = compiled.kernel.velocity(0.4, x, p)[0][:, compiled.n_u - compiled.n_c :]
    # SymPy's elimination has no pivoting, and no result in singular positions.
    assume(compiled.n_c == 0 or np.linalg.cond(jacobian) < 1e4)
    # SymPy solves with this matrix, which has the constraints' rows in it, and with it again for derivatives of what it
    # solves; a backward stable solution errs by its condition, the factor has room for matrices of six rows.
    tolerance = 1000 * EPS * np.linalg.cond(compiled.mass_matrix(0.4, x, p))
    reference = Tutorial(system, values, {})
    expected = reference.rhs(0.4, x)
    assert np.abs(compiled.rhs(0.4, x, p) - expected).max() <= tolerance * np.abs(expected).max()
    step = 1e-30
    derivative = np.column_stack([reference.rhs(0.4, x + 1j * step * e).imag / step for e in np.eye(len(x))])
    error = np.abs(compiled.jacobian(0.4, x, p) - derivative).max()
    assert error <= tolerance * (np.abs(derivative).max() + np.abs(expected).max())
