"""Linearization against SymPy's, and equilibria against energies."""

import itertools

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import coordinate_free, quaternion_top
from scipy.optimize import minimize_scalar
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


# In double precision, what SymPy substitutes for the four-bar cancels to no digit; with 40 digits, it takes the disc's
# matrices for singular.
@pytest.mark.slow(but=["slider_crank-40"])
@pytest.mark.parametrize(("name", "digits"), [("four_bar", 40), ("rolling_disc", 15), ("slider_crank", 40)])
def test_linearization_of_ready_models_equals_that_of_kanes_method(name, digits):
    model = getattr(fb.models, name)()
    compiled = fb.compile_model(model)
    start = {"q3": 0.4, "q1": 0.2, "q4": 0.1, "q5": 0.3} if name == "rolling_disc" else {}
    x = compiled.initial_state(start)
    inputs = list(model.input_expressions)
    r = [0.4 * (i + 1) for i in range(len(inputs))]
    system = model.system
    system.form_eoms(constraint_solver="CRAMER")
    linearizer = system.eom_method.to_linearizer()
    # Inputs that SymPy finds by itself come in its order.
    linearizer.r = sm.Matrix(inputs)
    t = me.dynamicsymbols._t
    values = dict(zip((*model.mechanism.coordinates, *model.mechanism.speeds), x, strict=True))
    values.update(zip((f.diff(t) for f in list(values)), compiled.rhs(0.0, x, r=r), strict=True))
    values.update(zip(inputs, r, strict=True))
    values.update({symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()})
    values[t] = 0.0
    values = {symbol: sm.Float(float(value), digits) for symbol, value in values.items()}
    expected_A, expected_B = linearizer.linearize(op_point=values, A_and_B=True)
    A, B = compiled.linearize(0.0, x, r=r)
    scale = np.abs(A).max()
    # Rounding errors of the entries of the Jacobians and of two solves with them.
    np.testing.assert_allclose(A, np.array(expected_A, dtype=float), rtol=0, atol=1e-9 * scale)
    if inputs:
        np.testing.assert_allclose(B, np.array(expected_B, dtype=float), rtol=0, atol=1e-9 * np.abs(B).max())


def test_linearized_motion_near_equilibrium_follows_the_full_one(four_bar):
    # From x and x + d along the constraints, both motions part as exp(A t) d says, to second order in d.
    x = four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 0.0})
    A, _ = four_bar.linearize(0.0, x, r={"F": 0.0})
    size = 1e-5
    begin = four_bar.initial_state([x[0] + size], [0.0], guess=x[1:3])
    run = four_bar.simulate((0.0, 0.1), begin, inputs={"F": 0.0}, rtol=1e-12, atol=1e-14)
    eigenvalues, vectors = np.linalg.eig(A)
    expected = (vectors @ np.diag(np.exp(0.1 * eigenvalues)) @ np.linalg.inv(vectors) @ [size, 0.0]).real
    np.testing.assert_allclose(run.y[[0, 3], -1] - x[[0, 3]], expected, atol=100 * size**2)


def test_equilibrium_of_the_four_bar_is_at_the_least_potential(four_bar):
    # Without spring and damper, whose torque has no potential: it depends on q2 and acts on q1.
    p = {"k": 0.0, "c": 0.0}

    def potential(q1):
        x = four_bar.initial_state([q1], [0.0], guess=[-2.2, -1.5], parameters=p)
        return four_bar.potential_energy(0.0, x, p)

    least = minimize_scalar(potential, bounds=(-2.5, -0.8), method="bounded", options={"xatol": 1e-9}).x
    guess = four_bar.initial_state([least + 0.2], [0.0], guess=[-2.2, -1.5], parameters=p)[:3]
    x = four_bar.equilibrium(guess, parameters=p, inputs={"F": 0.0})
    assert x[0] == pytest.approx(least, abs=1e-6)  # a minimum is known to the root of the precision of its value
    assert np.abs(four_bar.rhs(0.0, x, p, {"F": 0.0})).max() < 1e-9
    eigenvalues = np.linalg.eigvals(four_bar.linearize(0.0, x, p, {"F": 0.0})[0])
    # Nothing takes energy: the motion around a minimum is an undamped oscillation.
    np.testing.assert_allclose(eigenvalues.real, 0.0, atol=1e-9)
    assert eigenvalues.imag.max() > 1.0


UNITS = list(itertools.product((1e-6, 1.0, 1e6), (1e-6, 1.0, 1e6), (1e-6, 1.0, 1e6)))
"""Of length, mass and time."""


def test_equilibrium_in_other_units_of_length_mass_and_time_is_the_same(four_bar):
    """A change of units changes no angle, and a displacement by that of length."""
    start = four_bar.initial_state()[:3]
    angles = four_bar.equilibrium(start, inputs={"F": 3.0})[:3]
    powers = {"kg/m": (-1, 1, 0), "m": (1, 0, 0), "N m/rad": (2, 1, -2), "N m s/rad": (2, 1, -1), "m/s^2": (1, 0, -2)}
    for unit in UNITS:
        values = {name: value * np.prod(np.power(unit, powers[four_bar.units[name]], dtype=float))
                  for name, value in four_bar.defaults.items()}  # fmt: skip
        force = 3.0 * np.prod(np.power(unit, (1.0, 1.0, -2.0)))
        found = four_bar.equilibrium(start, parameters=values, inputs={"F": force})[:3]
        np.testing.assert_allclose(found, angles, rtol=0, atol=1e-9)
    # y under gravity on a ring of radius l: the highest point.
    ring = fb.compile_model(fb.models.cartesian_pendulum())
    for length, mass, time in UNITS:
        values = {"m": mass, "l": length, "g": 9.81 * length / time**2}
        found = ring.equilibrium([0.1 * length, -0.9 * length], parameters=values)
        np.testing.assert_allclose(found / length, [1.0, 0.0, 0.0, 0.0], rtol=0, atol=1e-9)


@pytest.mark.slow
def test_equilibria_of_random_four_bars_are_minima_of_the_potential():
    """From closed positions where least squares end at a minimum of the accelerations that is no equilibrium.

    With the loop a e^(i q1) + b e^(i q2) + c e^(i q3) = d and uniform bars, V / (rho g) = a^2/2 s1 + b (a s1 + b/2 s2)
    - c^2/2 s3. A minimum on the loop has grad V + J^T lambda = 0, and a positive second derivative of V + lambda Phi
    along the loop.
    """
    points = {"A": (0, 0), "B": (0.1, 0.2), "C": (0.5, 0.4), "D": (0.4, 0)}
    linkage = fb.Linkage("bars", points=points, ground="AD", links=["AB", "BC", "CD"], density=1.0, gravity=9.81)
    model = fb.compile_model(linkage.model())
    for (a, b, c, d), begin in (
        ((0.3, 0.9, 0.5, 1.0), -0.6), ((0.9, 0.9, 0.3, 0.6), -1.5), ((0.2, 0.3, 0.4, 0.4), -2.8),
        ((0.4, 0.7, 0.9, 0.5), -0.8), ((0.4, 0.3, 0.4, 0.7), 0.0), ((0.9, 0.6, 0.3, 0.5), 0.2),
        ((0.5, 0.8, 0.8, 0.9), -0.2), ((0.4, 0.9, 0.9, 0.3), -1.8),
    ):  # fmt: skip
        p = {"l_AB": a, "l_BC": b, "l_CD": c, "x_D": d}
        start = model.initial_state({"q_AB": begin}, parameters=p, guess=[0.5, -1.5])
        x, kind = model.equilibrium(start[:3], parameters=p, stability=True)
        sines, cosines, lengths = np.sin(x[:3]), np.cos(x[:3]), np.array([a, b, c])
        np.testing.assert_allclose([lengths @ cosines, lengths @ sines], [d, 0.0], rtol=0, atol=1e-12)
        weights = np.array([a**2 / 2 + a * b, b**2 / 2, -(c**2) / 2])
        jacobian = np.array([-lengths * sines, lengths * cosines])
        reactions = np.linalg.lstsq(jacobian.T, -weights * cosines)[0]
        # The search ends where accelerations are 1e-9 of those at its start.
        np.testing.assert_allclose(jacobian.T @ reactions, -weights * cosines, rtol=0, atol=1e-8)
        along = np.cross(*jacobian)
        second = -weights * sines + lengths * (-reactions[0] * cosines - reactions[1] * sines)
        assert kind == "stable"
        assert along**2 @ second > 0.0


@pytest.mark.slow
def test_equilibria_of_a_block_on_a_guide_satisfy_virtual_work():
    """From closed positions where a Newton step is millions of turns, or the only displacement is nearly zero.

    With a cos q1 + b cos q2 = d, a virtual displacement has a s1 dq1 + b s2 dq2 = 0, and the potential's gradient along
    the angles is (alpha c1, beta c2) by the lever arms of the masses.
    """
    points = {"A": (0, 0), "B": (0.1, 0.1), "C": (0.1, 0.5)}
    linkage = fb.Linkage("vert", points=points, ground="A", links=["AB", "BC"], density=2.0, gravity=9.81)
    linkage.slider("C", along=(0, 1), mass=0.5)
    model = fb.compile_model(linkage.model())
    a, b, d, density, mass = np.sqrt(0.02), 0.4, 0.1, 2.0, 0.5
    alpha, beta = density * (a**2 / 2 + a * b) + mass * a, density * b**2 / 2 + mass * b
    for begin, branch in (
        (np.pi, 1), (-np.pi, 1), (-np.pi, -1), (-3.12413936106985, 1), (-3.0543261909900767, 1),
        (-2.9670597283903604, -1), (0.7766715171374767, 1), (np.pi / 4, 1), (0.79, 1), (0.7941248096574198, 1),
        (0.8, 1), (1.9722220547535922, 1),
    ):  # fmt: skip
        start = model.initial_state({"q_AB": begin}, guess={"q_BC": 1.0 if branch > 0 else -2.0, "q_C": 0.3 * branch})
        x = model.equilibrium(start[:3])
        (s1, s2), (c1, c2) = np.sin(x[:2]), np.cos(x[:2])
        assert np.abs(x[:2] - start[:2]).max() < 2 * np.pi
        assert a * c1 + b * c2 == pytest.approx(d, abs=1e-12)
        assert a * s1 + b * s2 == pytest.approx(0.5 + x[2], abs=1e-12)
        assert alpha * c1 * b * s2 == pytest.approx(beta * c2 * a * s1, abs=1e-9)


def test_stability_of_a_pendulum_and_a_free_particle_is_told():
    """A pendulum hangs or stands, and a particle without forces rests anywhere."""
    ring = fb.compile_model(fb.models.cartesian_pendulum())
    for height, expected in ((0.9, "unstable"), (-0.9, "stable")):  # of q1, upwards
        assert ring.equilibrium([height, 0.1], stability=True)[1] == expected
    assert fb.compile_model(on_a_line(sm.S.Zero)).equilibrium(stability=True)[1] == "neutral"


def pendulum_on_a_block():
    """A particle on a bar of length l below a block on a spring k, with a damper c at the pin; upright at pi / 2."""
    t, (x, q), (v, u) = me.dynamicsymbols._t, me.dynamicsymbols("x q"), me.dynamicsymbols("v u")
    m, block, length, g, k, c = sm.symbols("m M l g k c")
    ground, bar = me.ReferenceFrame("N"), me.ReferenceFrame("A")
    bar.orient_axis(ground, q, ground.z)
    bar.set_ang_vel(ground, u * ground.z)
    origin = me.Point("O")
    origin.set_vel(ground, 0)
    pin = origin.locatenew("P", x * ground.x)
    pin.set_vel(ground, v * ground.x)
    end = pin.locatenew("Q", length * bar.x)
    end.v2pt_theory(pin, ground, bar)
    method = me.KanesMethod(ground, [x, q], [v, u], kd_eqs=[v - x.diff(t), u - q.diff(t)])
    loads = [(pin, -k * x * ground.x), (end, -m * g * ground.y), (bar, -c * u * ground.z)]
    method.kanes_equations([me.Particle("P", pin, block), me.Particle("Q", end, m)], loads)
    values = {m: 1.0, block: 1e-3, length: 1.0, g: 9.81, k: 1e6, c: 0.0}
    return fb.compile_model(fb.Model(method, parameters=values, name="block"))


def test_stability_with_slow_and_fast_motions_is_that_of_the_slow_one():
    """Whether the slow motion grows, with eigenvalues g / c = 5e-4 / s or sqrt(g / l), does not depend on the fast one.

    Without the spring, the block rests anywhere.
    """
    model = pendulum_on_a_block()
    for values in (
        {}, {"c": 1.0}, {"c": 2e4}, {"c": 1e6, "M": 1e3}, {"k": 1e9}, {"k": 1e12}, {"k": 1e12, "c": 1.0},
        {"k": 100.0, "M": 1e6},
    ):  # fmt: skip
        for angle, expected in ((1.57, "unstable"), (-1.57, "stable")):
            assert model.equilibrium([0.0, angle], parameters=values, stability=True)[1] == expected
    for damping in (0.0, 1.0, 2e4):
        assert model.equilibrium([0.3, -1.57], parameters={"k": 0.0, "c": damping}, stability=True)[1] == "neutral"
        assert model.equilibrium([0.3, 1.57], parameters={"k": 0.0, "c": damping}, stability=True)[1] == "unstable"


def test_equilibrium_that_does_not_exist_is_refused(four_bar):
    # A disc stands upright, and nowhere else.
    disc = fb.compile_model(fb.models.rolling_disc())
    upright = disc.equilibrium({"q2": 0.1, "q3": 0.4})
    assert upright[1] == pytest.approx(0.0, abs=1e-9)
    x0 = four_bar.initial_state()[:3]
    with pytest.raises(fb.SimulationError, match="No equilibrium was found"):
        four_bar.equilibrium(x0, inputs={"F": 1e6}, parameters={"l2": 5.0})
    with pytest.raises(fb.ModelError, match="no coordinates"):
        fb.compile_model(coordinate_free()).equilibrium()


def on_a_line(*forces, kdes=None, constraint=None, **inputs):
    """Particles of 1 kg on a line, each under a force."""
    q, u = me.dynamicsymbols(f"q1:{len(forces) + 1}"), me.dynamicsymbols(f"u1:{len(forces) + 1}")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    for i, force in enumerate(forces):
        point = origin.locatenew(f"P{i}", q[i] * ground.x)
        point.set_vel(ground, u[i] * ground.x)
        system.add_bodies(me.Particle(f"p{i}", point, 1))
        system.add_loads(me.Force(point, force * ground.x))
    system.add_kdes(*(kdes or [ui - qi.diff(me.dynamicsymbols._t) for qi, ui in zip(q, u, strict=True)]))
    system.q_ind, system.u_ind = q, u
    if constraint is not None:
        system.add_holonomic_constraints(constraint)
        system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:-1], q[-1:], u[:-1], u[-1:]
    return fb.Model(system, name="line", inputs={me.dynamicsymbols(name): value for name, value in inputs.items()})


@pytest.mark.slow
def test_equilibrium_of_one_part_alone_is_refused():
    q1, u1, v = me.dynamicsymbols("q1 u1 v")
    stiff = fb.compile_model(on_a_line(-1e9 * q1, sm.Float(9.81)))
    with pytest.raises(fb.SimulationError, match="No equilibrium"):
        stiff.equilibrium()
    with pytest.warns(fb.ModelWarning, match="velocity that was set for point"):  # that of q1 without v
        moving = fb.compile_model(on_a_line(-q1, kdes=[u1 + v - q1.diff(me.dynamicsymbols._t)], v=3))
    with pytest.raises(fb.SimulationError, match="No equilibrium"):
        moving.equilibrium()


def test_linearization_with_an_input_in_constraints_moves_dependent_coordinates_and_speeds():
    # u1' = -4 (q1 - q2) - 3 (u1 - u2), and q2 follows the input s, u2 its rate.
    q1, q2, u1, u2, s = me.dynamicsymbols("q1 q2 u1 u2 s")
    excited = fb.compile_model(on_a_line(-4 * (q1 - q2) - 3 * (u1 - u2), 0 * q2, constraint=q2 - s, s=0))
    A, B = excited.linearize(0.0, [0.0] * 4)
    np.testing.assert_allclose(A, [[0.0, 1.0], [-4.0, -3.0]], atol=1e-14)
    np.testing.assert_allclose(B, [[0.0, 0.0, 0.0], [4.0, 3.0, 0.0]], atol=1e-14)
    with pytest.raises(fb.ModelError, match="violates the constraints"):
        excited.linearize(0.0, [1.0, 2.0, 3.0, 4.0])
    with pytest.raises(fb.ModelError, match="state"):
        excited.linearize(0.0, "abc")


def test_equilibrium_in_quaternions_without_their_norm_is_refused():
    top = fb.compile_model(fb.Model(quaternion_top(), name="top"))
    with pytest.raises(fb.ModelError, match="norm of a quaternion"):
        top.equilibrium([1.0, 0.1, 0.0, 0.0])
