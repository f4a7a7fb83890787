"""What is taken for the same, and what is not; and sums whose common parts stand in them already."""

import ctypes
import subprocess

import mpmath
import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.derivatives import Rounding, vjp
from fourbar_codegen.expressions.identities import deduplicate, is_zero
from fourbar_codegen.expressions.tape import Tape

q1, q2, u1, u2 = me.dynamicsymbols("q1 q2 u1 u2")
a, b, c, K = sm.symbols("a b c K")
t = me.dynamicsymbols._t


@pytest.fixture
def convert():
    tape = Tape()
    return Conversion(tape, {symbol: tape.leaf("q", symbol.name) for symbol in (a, b, c)})


@pytest.mark.parametrize(
    ("expression", "same"),
    [
        (sm.sin(a) ** 2 + sm.cos(a) ** 2 - 1, True),
        (sm.sin(a + b) ** 2 * c + sm.cos(a + b) ** 2 * c - c, True),
        ((a + b) ** 3 - (a**3 + 3 * a**2 * b + 3 * a * b**2 + b**3), True),
        (1 / a - 1 / b - (b - a) / (a * b), True),
        (sm.exp(a) * (sm.sin(b) ** 2 + sm.cos(b) ** 2) - sm.exp(a), True),
        (sm.cos(0.3) ** 2 * a + sm.sin(0.3) ** 2 * a - a, True),  # to rounding errors
        (a + sm.Float(1e-16) * sm.sin(b) - a, False),
        (sm.exp(-((a / sm.Rational(1, 10)) ** 2)), False),
        (sm.Abs(a) - a, False),
        (sm.Piecewise((a, a < 4), (2 * a, True)) - a, False),
        (sm.atan2(sm.sin(a), sm.cos(a)) - a, False),
        (sm.sqrt(a**2) - a, False),
        (sm.sin(a) ** 2 + sm.cos(b) ** 2 - 1, False),
        (2**127 * a - a + b - b, False),
        ((1 + sm.Integer(2) ** 127 * a) / (1 + a) - 1, False),
    ],
)
def test_identities_of_all_kinds_are_told_from_other_expressions(convert, expression, same):
    scalar = convert(expression)
    assert is_zero(convert.tape, [scalar]) == [same]


def test_expressions_equal_to_known_nodes_are_replaced_by_these(convert):
    # cos(a + b) by the direction cosines of two frames, associated in two ways
    first = convert((sm.cos(a) * sm.cos(b) - sm.sin(a) * sm.sin(b)) * sm.cos(c))
    known = convert.tape.reach([first])
    other = convert(sm.cos(a) * (sm.cos(b) * sm.cos(c)) - sm.sin(a) * (sm.sin(b) * sm.cos(c)))
    assert deduplicate(convert.tape, [2 * other, -other], known) == [2 * first, -first]


def held_on(curve):
    """A particle in a plane that is held on a curve."""
    m, g = sm.symbols("m g")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    point = origin.locatenew("P", q1 * ground.x + q2 * ground.y)
    point.set_vel(ground, u1 * ground.x + u2 * ground.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("particle", point, m))
    system.apply_uniform_gravity(-g * ground.y)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [q1], [q2], [u1], [u2]
    system.add_kdes(u1 - q1.diff(t), u2 - q2.diff(t))
    system.add_holonomic_constraints(q2 - curve)
    return fb.Model(system, name="held", parameters={m: 1.0, g: 9.81, **({K: 1e16} if curve.has(K) else {})})


@pytest.mark.slow(but=["1.0e-16*K*sin(q1(t))"])
@pytest.mark.parametrize(
    "curve",
    [
        sm.exp(-((q1 / sm.Rational(1, 10)) ** 2)) / 10,
        1 / (10 * sm.cosh(100 * q1)),
        q1 / (1 + sm.exp(-1000 * q1)),
        1e-16 * K * sm.sin(q1),
    ],
    ids=str,
)
def test_narrow_or_small_terms_of_a_constraint_stay_in_its_jacobian(curve):
    compiled = fb.compile_model(held_on(curve))
    for x in (0.02, -0.01):
        slope = float(curve.diff(q1).subs({q1: x, K: 1e16}))
        np.testing.assert_allclose(compiled.constraint_jacobian(0.0, [x, 0.1]), [[-slope, 1.0]], rtol=1e-9, atol=1e-12)


def test_derivative_of_a_branch_that_is_not_taken_has_no_part():
    # The root's slope is not a number where it is not taken.
    compiled = fb.compile_model(held_on(sm.Piecewise((sm.sqrt(q1), q1 > 0), (0, True))))
    for x, slope in ((0.25, 1.0), (-0.5, 0.0)):
        np.testing.assert_allclose(compiled.constraint_jacobian(0.0, [x, 0.1]), [[-slope, 1.0]], rtol=1e-14)
        assert np.isfinite(compiled.jacobian(0.0, [x, 0.1, 0.3, 0.2])).all()


@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_rounding_error_of_a_sine_is_a_unit_beside_that_of_its_angle(convert, angle):
    """3 sin a - b: 3 (|a cos a| + 1) + |b|, up to 1e-12 for each leaf, which counts if it is zero."""
    error = Rounding(convert.tape)(convert(3 * sm.sin(a) - b))
    leaves = {convert(a): angle, convert(b): -2.0}
    assert convert.tape.evaluate([error], leaves) == pytest.approx([3 * (angle * np.cos(angle) + 1) + 2], abs=1e-11)


@pytest.mark.parametrize(("base", "expected"), [(0.0, 0.0), (2.0, 2.0**1.5 * np.log(2.0))])
def test_derivative_of_a_power_by_its_exponent_is_zero_at_a_base_of_zero(convert, base, expected):
    [slope] = vjp(convert.tape, [(convert(a**b), convert.tape.one)], [convert(b)])
    [found] = convert.tape.evaluate([slope], {convert(a): base, convert(b): 1.5})
    assert found == pytest.approx(expected, rel=1e-15)  # two functions and a product


def test_velocity_equal_to_the_natural_one_in_places_stays_as_set():
    m = sm.Symbol("m")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    point = origin.locatenew("P", q1 * ground.x)
    point.set_vel(ground, u1 * sm.Piecewise((1, q1 < 4), (2, True)) * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("particle", point, m))
    system.add_coordinates(q1)
    system.add_speeds(u1)
    system.add_kdes(u1 - q1.diff(t))
    compiled = fb.compile_model(fb.Model(system, name="geared", parameters={m: 3.0}))
    assert [compiled.tree_mass_matrix(0.0, [q, 1.0])[0, 0] for q in (3.0, 5.0)] == [3.0, 12.0]


def test_sums_with_a_common_part_as_a_term_have_closed_form_rates():
    x, y, z, u, v, w = me.dynamicsymbols("x y z u v w")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    point = origin.locatenew("P", x * ground.x + y * ground.y + z * ground.z)
    point.set_vel(ground, u * ground.x + v * ground.y + w * ground.z)
    system = System(ground, origin)
    system.add_bodies(me.Particle("particle", point, 1))
    system.add_coordinates(x, y, z)
    system.add_speeds(u, v, w)
    system.add_kdes(u - x.diff(t), v - y.diff(t), w - z.diff(t))
    s = x + y
    third = sm.Mul(sm.Rational(4, 3), s, evaluate=False) + x + y + z
    system.add_loads(me.Force(point, sm.sin(s) * ground.x + sm.cos(s + z) * ground.y + third * ground.z))
    compiled = fb.compile_model(fb.Model(system, name="sums"))
    expected = [np.sin(0.3), np.cos(0.7), 4 / 3 * 0.3 + 0.7]
    np.testing.assert_allclose(compiled.rhs(0.0, [0.1, 0.2, 0.4, 0, 0, 0])[3:], expected, rtol=1e-14)


@pytest.mark.slow(but=["1"])
@pytest.mark.parametrize("copies", [1, 10])
def test_dependent_constraints_that_cannot_hold_are_refused(copies):
    # x - y = 0 and x - y + k x^2 = 0 are the same at x = 0, but for the second's rate; few are solved as a full system
    # of equations, many as a sparse one.
    k = 1e-6
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    independent, dependent = ([], []), ([], [])
    for copy in range(copies):
        q, u = me.dynamicsymbols(f"x{copy} y{copy} z{copy}"), me.dynamicsymbols(f"u{copy} v{copy} w{copy}")
        for number in range(3):
            point = origin.locatenew(f"P{copy}{number}", q[number] * ground.x)
            point.set_vel(ground, u[number] * ground.x)
            system.add_bodies(me.Particle(f"particle{copy}{number}", point, 1))
        independent[0].append(q[0]), independent[1].append(u[0])
        dependent[0].extend(q[1:]), dependent[1].extend(u[1:])
        system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
        system.add_holonomic_constraints(q[0] - q[1], q[0] - q[1] + k * q[0] ** 2)
    system.q_ind, system.u_ind = independent
    system.q_dep, system.u_dep = dependent
    compiled = fb.compile_model(fb.Model(system, name="dependent"), check=False)
    x = np.zeros(compiled.n_x)
    x[compiled.n_q : compiled.n_q + copies] = 1.0
    x[compiled.n_q + copies :: 2] = 1.0
    with pytest.raises(fb.SimulationError):
        compiled.rhs(0.0, x)


@pytest.mark.slow(but=["1"])
@pytest.mark.parametrize("copies", [1, 10])
def test_constraints_that_are_not_finite_are_refused(copies):
    d = sm.Symbol("d")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system = System(ground, origin)
    q, u = me.dynamicsymbols(f"q:{2 * copies}"), me.dynamicsymbols(f"u:{2 * copies}")
    for number, (q_i, u_i) in enumerate(zip(q, u, strict=True)):
        point = origin.locatenew(f"P{number}", q_i * ground.x)
        point.set_vel(ground, u_i * ground.x)
        system.add_bodies(me.Particle(f"particle{number}", point, 1 + number))
        system.add_loads(me.Force(point, (3 - number) * ground.x))
    system.add_kdes(*(u_i - q_i.diff(t) for q_i, u_i in zip(q, u, strict=True)))
    system.add_nonholonomic_constraints(*(u[2 * i] + u[2 * i + 1] / d for i in range(copies)))
    system.q_ind, system.u_ind, system.u_dep = q, u[::2], u[1::2]
    compiled = fb.compile_model(fb.Model(system, name="divided", parameters={d: 1.0}))
    x = np.zeros(compiled.n_x)
    assert np.isfinite(compiled.rhs(0.0, x)).all()
    for function in (compiled.rhs, compiled.kernel.accelerations, compiled.jacobian):
        with pytest.raises(fb.SimulationError):
            function(0.0, x, {"d": 0.0})


ONE = "{ s[i] = fb_sin(x[i]); c[i] = fb_cos(x[i]); }"
FOUR = """{
        /* each angle in another place of the four, beside others */
        const double a = x[(i + 1) % n], b = i % 7 ? 0.5 : 1e300;
        const fb_angles angles = i % 4 == 0   ? fb_angles_of(x[i], a, b, a)
                                 : i % 4 == 1 ? fb_angles_of(b, x[i], a, a)
                                 : i % 4 == 2 ? fb_angles_of(a, b, x[i], b)
                                              : fb_angles_of(a, a, b, x[i]);
        s[i] = angles.sin[i % 4];
        c[i] = angles.cos[i % 4];
    }"""


@pytest.mark.slow(but=["native-one"])
@pytest.mark.parametrize("loop", [ONE, FOUR], ids=["one", "four"])
@pytest.mark.parametrize("flags", [[], ["-march=native"]], ids=["portable", "native"])
def test_sine_and_cosine_in_loops_are_accurate_at_all_angles(tmp_path, loop, flags):
    (tmp_path / "angle.c").write_text(
        '#include "arithmetic/angle.h"\n'
        f"void angles(const double *x, double *s, double *c, int n)\n{{\n    for (int i = 0; i < n; ++i) {loop}\n}}\n"
    )
    library = tmp_path / "angle.so"
    command = [
        "cc",
        "-O2",
        *flags,
        "-shared",
        "-fPIC",
        "-I",
        fb.get_include(),
        str(tmp_path / "angle.c"),
        "-o",
        str(library),
    ]
    subprocess.run([*command, "-lm"], check=True)
    function = ctypes.CDLL(str(library)).angles
    array = np.ctypeslib.ndpointer(float)
    function.argtypes = [array, array, array, ctypes.c_int]
    generator = np.random.default_rng(0)
    multiples = np.arange(-500, 500) * np.pi / 2
    x = np.concatenate((
        generator.uniform(-10, 10, 3000), generator.uniform(-1e6, 1e6, 3000), multiples, np.nextafter(multiples, 9e9),
        generator.normal(size=500) * 1e-8, [0.0, 1e-320, 1e7, 1e22, -862000.66979239159, -283833.9926388105],
    ))  # fmt: skip
    sine, cosine = np.empty_like(x), np.empty_like(x)
    function(x, sine, cosine, len(x))
    with mpmath.workprec(200):
        for values, exactly in ((sine, mpmath.sin), (cosine, mpmath.cos)):
            for angle, got in zip(x, values, strict=True):
                exact = exactly(angle)
                assert abs(mpmath.mpf(got) - exact) <= 1.6 * np.spacing(abs(float(exact))), angle
    function(np.array([-0.0]), sine[:1], cosine[:1], 1)
    assert np.signbit(sine[0])
    not_finite = np.array([np.inf, -np.inf, np.nan])
    function(not_finite, sine[:3], cosine[:3], 3)
    assert np.isnan(sine[:3]).all()
    assert np.isnan(cosine[:3]).all()
