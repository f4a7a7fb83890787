"""Systems of many kinds against SymPy's own equations, as the tutorial evaluates them."""

import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import coordinate_free, pendulum, quaternion_top, slider
from scipy.interpolate import CubicSpline
from sympy.physics.mechanics.system import System
from tutorial import Tutorial

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations

EPS = np.finfo(float).eps
t = me.dynamicsymbols._t
m, k, g = sm.symbols("m k g")
q, u = me.dynamicsymbols("q u")


def sliding(force):
    """A block on a line under a force."""
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=m)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    system.add_loads(me.Force(block.masscenter, force * wall.x))
    return system


def chain(joint, count=2):
    """Bodies with full inertia in a row of equal joints."""
    ground = me.RigidBody("ground")
    system = System.from_newtonian(ground)
    parent = ground
    for i in range(count):
        body = me.RigidBody(f"b{i}", mass=(i + 1) * m)
        body.central_inertia = me.inertia(body.frame, 1.1, 1.3, 1.7, 0.1, 0.2, 0.3)
        points = {"parent_point": 0.3 * parent.frame.x, "child_point": -0.4 * body.frame.y}
        system.add_joints(joint(f"j{i}", parent, body, **points))
        parent = body
    system.apply_uniform_gravity(-g * ground.y)
    return system


def absolute_rates(count=8):
    """A planar chain of particles whose speeds are absolute rates: triangular kinematics."""
    frame, point = me.ReferenceFrame("N"), me.Point("O")
    point.set_vel(frame, 0)
    system = System(frame, point)
    qs, us = me.dynamicsymbols(f"q1:{count + 1}"), me.dynamicsymbols(f"u1:{count + 1}")
    for i in range(count):
        link = me.ReferenceFrame(f"L{i}")
        link.orient_axis(frame, frame.z, sum(qs[: i + 1]))
        link.set_ang_vel(frame, us[i] * frame.z)
        tip = point.locatenew(f"P{i}", link.x)
        tip.v2pt_theory(point, frame, link)
        system.add_bodies(me.Particle(f"p{i}", tip, m))
        point = tip
    system.add_coordinates(*qs)
    system.add_speeds(*us)
    system.add_kdes(*(us[i] - sum(qs[: i + 1]).diff(t) for i in range(count)))
    system.apply_uniform_gravity(-g * frame.y)
    return system


def deprecated_body():
    """The deprecated Body is a RigidBody and a Particle at once."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ground, body = me.RigidBody("ground"), me.Body("b", mass=m)
    body.central_inertia = me.inertia(body.frame, 1, 2, 30)
    system = System.from_newtonian(ground)
    system.add_joints(me.PinJoint("j", ground, body, q, u, joint_axis=ground.frame.z, child_point=-body.frame.x / 2))
    system.apply_uniform_gravity(-g * ground.y)
    return system


SYSTEMS = {
    "pin joints": lambda: chain(me.PinJoint),
    "cylindrical joint": lambda: chain(me.CylindricalJoint, 1),
    "planar joint": lambda: chain(me.PlanarJoint, 1),
    "spherical joint": lambda: chain(me.SphericalJoint, 1),
    "triangular kinematics": absolute_rates,
    "deprecated Body": deprecated_body,
    "holonomic": lambda: slider().system,
    "Max": lambda: sliding(sm.Max(q, u)),
    "clipped": lambda: sliding(k * sm.Min(sm.Max(q, -sm.S.Half), sm.S.Half)),
    "contact": lambda: sliding(sm.Piecewise((1000 * (-q) ** sm.Rational(3, 2), q < 0), (0, True)) - g),
    "two branches with one condition": lambda: sliding(sm.Piecewise((k * q**2, q > 0), (q, True)) * sm.sign(q)),
    "sines of sines": lambda: sliding(
        sm.sin(q + sm.cos(u))
        + k * sm.cos(2 * q - k * t) * sm.sin(sm.sin(q) * k)
        + sm.cos(q * u) * sm.cos(k)
        + sm.sin(u)
    ),
    "Mod": lambda: sliding(sm.Mod(q, 2) + sm.Mod(t, k)),
    "friction": lambda: sliding(-k * sm.Abs(u) ** 1.8 * sm.sign(u)),
    "table by a spline": lambda: sliding(-k * sm.interpolating_spline(3, q, [-2, -1, 0, 1, 2], [3, 1, 0, 2, 1])),
    "atan2, exp, explicit time": lambda: sliding(k * sm.atan2(q, u) * sm.exp(-t) + sm.sqrt(2) * sm.pi),
}


def compiled_and_reference(name):
    system = SYSTEMS[name]()
    model = fb.Model(system, inputs={me.dynamicsymbols("F"): 0} if name == "holonomic" else {})
    compiled = fb.compile_model(model)
    values = {symbol: 0.7 + 0.1 * i for i, symbol in enumerate(model.parameter_symbols)}
    return (
        compiled,
        Tutorial(system, values, dict.fromkeys(model.input_expressions, lambda t: 0.0)),
        {symbol.name: value for symbol, value in values.items() if symbol.name in compiled.parameters},
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:[\\s\\S]*Velocity of:UserWarning")
@pytest.mark.parametrize("name", SYSTEMS)
def test_rates_and_jacobian_of_every_system_equal_sympys(name):
    compiled, reference, p = compiled_and_reference(name)
    generator = np.random.default_rng(7)
    for _ in range(10):
        x = generator.uniform(-1.2, 1.2, compiled.n_x)
        with np.errstate(invalid="ignore"):  # lambdify evaluates the branches that are not taken
            expected = reference.rhs(0.3, x)
            # Central differences err by h^2 f''' / 6 and by eps f / h, both around 1e-10 for h = 1e-6.
            h = 1e-6
            differences = np.column_stack(
                [(reference.rhs(0.3, x + h * e) - reference.rhs(0.3, x - h * e)) / (2 * h) for e in np.eye(len(x))]
            )
        # Both sides solve with this matrix, which has the constraints' rows in it.
        tolerance = 1000 * EPS * np.linalg.cond(compiled.mass_matrix(0.3, x, p))
        scale = np.abs(expected).max() + 1.0
        assert np.abs(compiled.rhs(0.3, x, p) - expected).max() <= tolerance * scale
        error = np.abs(compiled.jacobian(0.3, x, p) - differences).max()
        assert error <= 1e-8 * (np.abs(differences).max() + scale)


@pytest.mark.slow
def test_jacobian_at_an_open_contact_leaves_out_the_branch_not_taken():
    contact = fb.compile_model(fb.Model(SYSTEMS["contact"](), parameters={m: 1.0, g: 9.81}))
    np.testing.assert_array_equal(contact.jacobian(0.0, [1.0, 0.0]), [[0.0, 1.0], [0.0, 0.0]])
    for method in ("Radau", "DOP853"):
        run = contact.simulate((0.0, 1.0), [1.0, 0.0], method=method, rtol=1e-8, atol=1e-8)
        assert run.success
        # m v^2 / 2 + m g q + 1000 m (2/5) (-q)^(5/2), conserved to the tolerances of some 1000 steps
        energy = run["u"] ** 2 / 2 + 9.81 * run["q"] + 400 * np.maximum(-run["q"], 0.0) ** 2.5
        np.testing.assert_allclose(energy, 9.81, atol=1e-3)


@pytest.mark.slow
def test_derivatives_of_sinc_equal_series_also_at_zero():
    F = me.dynamicsymbols("F")
    model = fb.Model(sliding(sm.sinc(q) + F.diff(t, 2)), parameters={m: 1.0}, inputs={F: sm.sinc(t)})
    compiled = fb.compile_model(model)
    # With as many digits as the quotients lose.
    for x in (1e-12, 1e-6, 1e-3, 0.1, 0.999999, 1.000001, 2.0, -30.0):
        values = [sm.diff(sm.sin(t) / t, t, order).subs(t, sm.Rational(x)).evalf(30, maxn=200) for order in range(3)]
        # Beyond the series, from 1 on, the quotients lose less than a digit.
        assert compiled.jacobian(0.0, [x, 0.0])[1, 0] == pytest.approx(float(values[1]), rel=2e-15)
        assert compiled.kernel.default_inputs(x) == pytest.approx([float(value) for value in values], rel=2e-15)
    assert compiled.jacobian(0.0, [0.0, 0.0])[1, 0] == 0.0
    assert compiled.kernel.default_inputs(0.0) == pytest.approx([1.0, 0.0, -1 / 3], rel=1e-15)


HYPERBOLIC = [sm.sech, sm.csch, sm.coth, sm.acoth, sm.asech, sm.acsch]


def test_hyperbolic_functions_that_c_lacks_equal_sympys_from_tiny_to_large():
    """From 1e-9 to 1e5, where quotients of exponentials cancel or overflow."""
    F = me.dynamicsymbols("F:6")
    inputs = {f: function(t) for f, function in zip(F, HYPERBOLIC, strict=True)}
    compiled = fb.compile_model(fb.Model(sliding(sum(F)), parameters={m: 1.0}, inputs=inputs), check=False)
    for x in (1e-9, 1e-3, 0.3, 0.999, 1.5, 5.0, 300.0, 1e5):
        exact = [function(sm.Float(x, 40)).evalf(30) for function in HYPERBOLIC]
        expected = [float(value) if value.is_real else np.nan for value in exact]
        # The functions of the C library err by a few units; acosh(1 / x) at 0.999 by 1 / (2 (1 - x)) of them.
        np.testing.assert_allclose(compiled.kernel.default_inputs(x), expected, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(
    "condition",
    [
        sm.ITE(q > 0, u > 0, u < -1), sm.Implies(q > 0, u > 0), sm.Xor(q > 0, u > 0, q > u),
        sm.Equivalent(q > 0, u > 0), sm.Nand(q > 0, u > 0), sm.Not(sm.Or(q > 0, u > 0), evaluate=False),
    ],
)  # fmt: skip
def test_logical_conditions_of_all_kinds_equal_sympys_logic(condition):
    """Compared with the equations when compiled, and here with SymPy's logic."""
    compiled = fb.compile_model(fb.Model(sliding(sm.Piecewise((10, condition), (20, True))), parameters={m: 1.0}))
    for x in np.random.default_rng(5).uniform(-2.0, 2.0, (40, 2)):
        expected = 10 if condition.subs(dict(zip((q, u), x, strict=True))) else 20
        assert compiled.rhs(0.0, x)[1] == expected


KNOTS = np.linspace(-1.0, 1.0, 7)
SPLINE = CubicSpline(KNOTS, np.sin(3 * KNOTS))


def spline(x):
    """SymPy's, which has no value beyond its ends; SPLINE has the same end conditions."""
    return sm.interpolating_spline(3, x, [*KNOTS], [*np.sin(3 * KNOTS)])


def bead(is_constrained):
    """A bead on a wire y = spline(x), which is the path of a point or a constraint."""
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    y, v = me.dynamicsymbols("y v")
    system = System(frame, origin)
    if is_constrained:
        point.set_pos(origin, q * frame.x + y * frame.y)
        system.q_ind, system.q_dep, system.u_ind, system.u_dep = [q], [y], [u], [v]
        system.add_kdes(u - q.diff(t), v - y.diff(t))
        system.add_holonomic_constraints(y - spline(q))
    else:
        point.set_pos(origin, q * frame.x + spline(q) * frame.y)
        system.q_ind, system.u_ind = [q], [u]
        system.add_kdes(u - q.diff(t))
    system.add_bodies(me.Particle("p", point, m))
    system.apply_uniform_gravity(-g * frame.y)
    return system


@pytest.mark.slow
@pytest.mark.parametrize("is_constrained", [False, True])
def test_bead_on_a_spline_moves_as_the_closed_form_within_its_ends(is_constrained):
    """(1 + s'^2) x'' = -s' (s'' x'^2 + g); beyond the ends of the spline s there is no value."""
    compiled = fb.compile_model(fb.Model(bead(is_constrained), parameters={m: 2.0, g: 9.81}))

    def rhs(x):
        return compiled.rhs(0.0, [x, SPLINE(x), 0.7, SPLINE(x, 1) * 0.7] if is_constrained else [x, 0.7])

    for x in (-0.9, -0.4, 0.1, 0.3, 0.55, 0.95):
        slope, curvature = SPLINE(x, 1), SPLINE(x, 2)
        expected = -slope * (curvature * 0.7**2 + 9.81) / (1 + slope**2)
        assert rhs(x)[compiled.n_q] == pytest.approx(expected, rel=1e-11)
    for x in (-1.1, 1.1):
        with pytest.raises(fb.SimulationError):
            rhs(x)


@pytest.mark.slow
def test_derivatives_of_splines_of_states_and_of_time_equal_scipys():
    F = me.dynamicsymbols("F")
    model = fb.Model(sliding(F - k * spline(q)), parameters={m: 2.0, k: 0.8}, inputs={F: spline(k * t)})
    compiled = fb.compile_model(model)
    p = compiled.kernel.parameter_vector(None)
    for x in (-0.9, -0.4, 0.1, 0.55, 0.95):
        wrt_state, wrt_parameters, _ = compiled.vjp(x, [x, 0.3], [0.0, 1.0])
        assert wrt_state == pytest.approx([-0.8 * SPLINE(x, 1) / 2, 0.0], rel=1e-11)
        rate = (x * SPLINE(0.8 * x, 1) - SPLINE(x)) / 2
        force = SPLINE(0.8 * x) - 0.8 * SPLINE(x)
        assert wrt_parameters == pytest.approx([-force / 4, rate], rel=1e-11)
        partials = compiled.kernel.default_input_partials(x, p)
        assert partials[0] == pytest.approx([0.0, x * SPLINE(0.8 * x, 1)], rel=1e-11)


def test_speed_without_a_coordinate_decays_as_the_closed_form():
    block = fb.compile_model(coordinate_free())
    # m v' = -b v
    assert block.rhs(0.0, [4.0]).tolist() == [-6.0]
    assert block.jacobian(0.0, [4.0]).tolist() == [[-1.5]]
    assert block.simulate((0.0, 1.0), [1.0], rtol=1e-10, atol=1e-12).y[0, -1] == pytest.approx(np.exp(-1.5), rel=1e-9)


def evaluated(model, numbers, *results):
    """Results of a model's equations, for numbers of time, coordinates, speeds and parameters."""
    e = form_equations(model)
    v, of_name = e.variables, {result.name: result for result in e.results}
    at = dict(zip((v.time, *v.coordinates, *v.speeds, *v.parameters), numbers, strict=True))
    found = [of_name[result] for result in results]
    return [np.reshape(e.tape.evaluate(result.entries, at), result.shape) for result in found]


def test_mass_that_varies_with_time_changes_its_momentum_as_the_closed_form():
    """What joins it is at rest: (m + k t) l u has the rate -m g sin q, as in SymPy's KanesMethod."""
    values = {"m": 2.0, "k": 0.5, "g": 9.81, "l": 0.7}
    model = fb.Model(pendulum(mass=m + k * t), name="growing", parameters=values)
    numbers = (1.2, 0.4, 1.5, *(values[name] for name in model.parameters))
    matrix, forcing, power = evaluated(model, numbers, "mass_matrix", "forcing", "power")
    assert matrix == pytest.approx((2.0 + 0.5 * 1.2) * 0.7**2, rel=1e-14)
    assert forcing == pytest.approx((-2.0 * 9.81 * np.sin(0.4) - 0.5 * 0.7 * 1.5) * 0.7, rel=1e-14)
    assert np.isnan(power).all()  # so that no check takes it for the rate of the kinetic energy


def test_unequal_moments_along_axes_that_bodies_turn_in_give_sympys_equations():
    q, u = me.dynamicsymbols("q1:4"), me.dynamicsymbols("u1:4")
    ground, yoke, gimbal, rotor = (me.ReferenceFrame(name) for name in "NABC")
    centre = me.Point("O")
    centre.set_vel(ground, 0)
    for i, (frame, parent, axis) in enumerate(((yoke, ground, "z"), (gimbal, yoke, "x"), (rotor, gimbal, "y"))):
        frame.orient_axis(parent, getattr(parent, axis), q[i])
        frame.set_ang_vel(parent, u[i] * getattr(parent, axis))
    inertia = me.inertia(gimbal, 1, 2, 4), centre
    bodies = [me.RigidBody(frame.name, centre, frame, 1, inertia) for frame in (yoke, rotor)]
    kde = [each - angle.diff(t) for each, angle in zip(u, q, strict=True)]
    kane = me.KanesMethod(ground, q, u, kd_eqs=kde, bodies=bodies, forcelist=[(rotor, k * gimbal.y)])
    kane.kanes_equations()
    at = dict(zip((*q, *u, k), (0.3, 0.4, -0.6, 2.0, 0.5, 3.0, 0.7), strict=True))
    model = fb.Model(kane, name="gimbal")
    matrix, forcing, power = evaluated(model, (0.0, *at.values()), "mass_matrix", "forcing", "power")
    # Sums of a few products of up to 30, to rounding.
    np.testing.assert_allclose(matrix, np.array(kane.mass_matrix.subs(at), dtype=float), rtol=0, atol=1e-13)
    np.testing.assert_allclose(forcing, np.array(kane.forcing.subs(at), dtype=float).ravel(), rtol=0, atol=1e-13)
    assert np.isnan(power).all()  # it is not the rate of the kinetic energy


def test_arm_that_grows_as_it_turns_has_the_closed_form_mass():
    """One speed turns eight masses across the arm and moves them along it: they do not turn as one body about O."""
    frame, arm, origin = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O")
    arm.orient_axis(frame, frame.z, q)
    arm.set_ang_vel(frame, u * frame.z)
    origin.set_vel(frame, 0)
    end = origin.locatenew("P", (1 + k * q) * arm.x)
    end.set_vel(frame, k * u * arm.x + (1 + k * q) * u * arm.y)
    system = System(frame, origin)
    for i in range(8):
        place = end.locatenew(f"P{i}", i * arm.y / 10)
        place.v2pt_theory(end, frame, arm)
        system.add_bodies(me.Particle(f"p{i}", place, 2))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(t))
    [matrix] = evaluated(fb.Model(system, name="growing_arm"), (0.0, 0.8, 0.0, 0.3), "mass_matrix")
    # At 1 + k q along the arm, and i / 10 across it.
    assert matrix == pytest.approx(sum(2.0 * ((0.3 - i / 10) ** 2 + 1.24**2) for i in range(8)), rel=1e-14)


def test_constraint_with_a_part_of_a_direction_cosine_has_the_closed_form_rate():
    """The sine of 2 q is 2 sin(q) cos(q) in the orientation, and the constraint has it without the factor."""
    (x, v), length = me.dynamicsymbols("x v"), sm.Symbol("l")
    ground, arm, origin = me.ReferenceFrame("N"), me.ReferenceFrame("A"), me.Point("O")
    double_sine, double_cosine = 2 * sm.sin(q) * sm.cos(q), sm.cos(q) ** 2 - sm.sin(q) ** 2
    cosines = [[double_cosine, -double_sine, 0], [double_sine, double_cosine, 0], [0, 0, 1]]
    arm.orient_explicit(ground, sm.Matrix(cosines))
    arm.set_ang_vel(ground, 2 * u * ground.z)
    origin.set_vel(ground, 0)
    pin, slider = origin.locatenew("P", length * arm.x), origin.locatenew("S", x * ground.y)
    pin.v2pt_theory(origin, ground, arm)
    slider.set_vel(ground, v * ground.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("pin", pin, m), me.Particle("slider", slider, m))
    system.q_ind, system.u_ind, system.u_dep = [q, x], [u], [v]
    system.add_kdes(u - q.diff(t), v - x.diff(t))
    system.add_nonholonomic_constraints(v - length * (1 + sm.sin(q) * sm.cos(q)) * u)
    equations = form_equations(fb.Model(system, name="half"))
    variables = equations.variables
    leaves = (*variables.coordinates, *variables.speeds, *variables.parameters, *variables.accelerations)
    at = dict(zip(leaves, (0.4, 0.5, 1.5, 0.2, 0.7, 2.0, -3.0, 1.1), strict=True))
    # -(v - l (1 + sin(2 q) / 2) u)'
    expected = -1.1 + 0.7 * (np.cos(0.8) * 1.5**2 - 3.0 * (1 + np.sin(0.8) / 2))
    assert equations.tape.evaluate(equations.dynamics.residual.entries[2:], at) == pytest.approx([expected], rel=1e-14)


@pytest.mark.slow
def test_jacobian_of_friction_at_rest_has_no_infinite_slope():
    friction = fb.compile_model(fb.Model(SYSTEMS["friction"](), parameters={m: 1.0, k: 2.0}))
    np.testing.assert_array_equal(friction.jacobian(0.0, [0.0, 0.0]), [[0.0, 1.0], [0.0, 0.0]])


@pytest.mark.slow
def test_jacobian_that_does_not_exist_is_an_error():
    cone = fb.compile_model(fb.Model(sliding(-k * sm.sqrt(q**2 + u**2)), parameters={m: 1.0, k: 2.0}))
    assert cone.rhs(0.0, [0.0, 0.0]).tolist() == [0.0, 0.0]
    with pytest.raises(fb.SimulationError, match="derivatives"):
        cone.jacobian(0.0, [0.0, 0.0])


@pytest.mark.slow
def test_quaternion_top_that_sympy_does_not_validate_has_sympys_rates():
    system = quaternion_top()
    with pytest.raises(ValueError, match="number of generalized coordinates 4"):
        system.validate_system()
    top = fb.compile_model(fb.Model(system, name="top"))
    reference = Tutorial(quaternion_top(), {}, {})
    generator = np.random.default_rng(5)
    for _ in range(10):
        x = generator.normal(size=7)
        x[:4] /= np.linalg.norm(x[:4])  # off the unit sphere, SymPy's direction cosines are none
        # Some 50 products of numbers around 1, on both sides.
        np.testing.assert_allclose(top.rhs(0.0, x), reference.rhs(0.0, x), rtol=0, atol=1000 * EPS)


@pytest.mark.slow
def test_potential_energy_of_gravity_in_a_tilted_frame_equals_the_closed_form():
    ground, tilted = me.ReferenceFrame("N"), me.ReferenceFrame("T")
    tilted.orient_axis(ground, ground.z, sm.pi / 6)
    origin, point = me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, q * ground.x)
    point.set_vel(ground, u * ground.x)
    system = System(ground, origin)
    system.add_bodies(me.Particle("p", point, m))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(t))
    system.add_loads(me.Force(point, -m * g * tilted.y))
    plane = fb.compile_model(fb.Model(system, parameters={m: 1.0, g: 9.81}))
    # Along the plane, the force is m g sin(30 deg).
    assert plane.rhs(0.0, [1.0, 0.0])[1] == pytest.approx(9.81 / 2, rel=1e-15)
    assert plane.potential_energy(0.0, [1.0, 0.0]) == pytest.approx(-9.81 / 2, rel=1e-15)


@pytest.mark.slow
def test_parameters_with_names_of_all_kinds_compile_and_keep_their_names():
    names = ["lambda", "I", "in", "double", "x1", "I_{xx}", "z0", "k3", "M_PI", "EOF", "N_Q", "math_errhandling", "a'"]
    names += ["unix", "constants", "\u03b8", "a b", "a_b", "A_B", "*/ abort(); /*", '"', "\\", "new\nline", "pow", "x"]
    names += ["fb_sin", "fb_angle_of", "target", "unknown"]
    symbols = [sm.Symbol(name) for name in names]
    values = {symbol: 1.0 + 0.1 * i for i, symbol in enumerate(symbols)}
    polynomial = sum(symbol * q**i for i, symbol in enumerate(symbols))
    compiled = fb.compile_model(fb.Model(sliding(polynomial + sm.sin(q)), parameters={m: 1.0, **values}))
    assert compiled.parameters == ("m", *names)
    expected = np.polyval([*values.values()][::-1], 0.5) + np.sin(0.5)
    assert compiled.rhs(0.0, [0.5, 0.0])[1] == pytest.approx(expected, rel=1e-14)
