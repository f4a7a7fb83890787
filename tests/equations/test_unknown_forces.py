"""Unknown forces that drive the motion: friction and tyres by normal forces, against closed forms, SymPy and SciPy."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.friction import MU, G, J, L, M, T, box, compiled, model_of, rod, rods_rates, system_of
from ecosystem.cases import LONG
from ecosystem.conformance import run
from formulations.complex_steps import complex_steps
from scipy.optimize import brentq
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

# Of local errors, at rtol = 1e-9, over some hundred steps.
METHODS = {"RK45": 1e-8, "DOP853": 1e-8, "Radau": 1e-7, "CVODE": 1e-6, "IDA": 1e-6}


def test_block_with_friction_on_an_accelerated_belt_moves_as_the_closed_form():
    # u' = -mu (g + y''), so that u = u_0 - mu (g t + y' - y'(0)): closed form.
    height = sm.sin(5 * T) / 10
    model = compiled(box(lambda n, u: -MU * n, floor=height, name="belt"))
    assert model.outputs == ("N",)
    run = model.simulate((0.0, 1.0), rtol=1e-11, atol=1e-11, t_eval=np.linspace(0.0, 1.0, 21))
    rise = 0.5 * np.cos(5 * run.t)
    np.testing.assert_allclose(run["u"], 4.0 - 0.3 * (9.81 * run.t + rise - 0.5), rtol=1e-10)
    np.testing.assert_allclose(run["N"], 2.0 * (9.81 - 2.5 * np.sin(5 * run.t)), rtol=1e-13)
    np.testing.assert_allclose(model.forcing(0.3, [0.0, 4.0]), [-0.3 * model.output(0.3, [0.0, 4.0])[0]])
    np.testing.assert_allclose(model.tree_forcing(0.3, [0.0, 4.0]), model.forcing(0.3, [0.0, 4.0]))
    assert model.multipliers(0.0, [0.0, 4.0]).shape == (0,)


@pytest.mark.slow
def test_block_with_friction_on_an_incline_moves_as_the_closed_form():
    """u' = g (sin a - mu cos a), for a block that slides down: closed form."""
    q, u, w, normal = me.dynamicsymbols("q u u_n N")
    slope = sm.Symbol("alpha")
    ground, plane, origin, block = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O"), me.Point("P")
    plane.orient_axis(ground, ground.z, -slope)
    origin.set_vel(ground, 0)
    block.set_pos(origin, q * plane.x)
    block.set_vel(ground, u * plane.x + w * plane.y)
    loads = [me.Force(block, normal * plane.y - MU * normal * plane.x)]
    system = system_of(
        me.Particle("block", block, M), coordinates=[q], speeds=[u], auxiliary=[w], loads=loads, frame=ground,
        origin=origin,
    )  # fmt: skip
    model = compiled((system, {G: 9.81, M: 2.0, MU: 0.3, slope: 0.5}, {q: 0.0, u: 1.0}, "incline"))
    run = model.simulate((0.0, 2.0), rtol=1e-10)
    slide = 9.81 * (np.sin(0.5) - 0.3 * np.cos(0.5))
    np.testing.assert_allclose(run["q"], run.t + slide * run.t**2 / 2, atol=1e-12)
    np.testing.assert_allclose(run["N"], 2.0 * 9.81 * np.cos(0.5), rtol=1e-13)
    by_slope = model.parameter_jacobian(0.0, [0.0, 1.0])[1, model.parameters.index("alpha")]
    assert by_slope == pytest.approx(9.81 * (np.cos(0.5) + 0.3 * np.sin(0.5)), rel=1e-13)


@pytest.mark.parametrize("force", [-50.0, 0.0, 19.6, 19.62, 30.0, 100.0])
def test_friction_of_the_absolute_normal_force_acts_for_either_sign(force):
    # A block in a slot, pulled upwards: N = m g - P has either sign, and friction goes with |N|.
    pull = me.dynamicsymbols("P")

    def made():
        system, *rest, _ = box(lambda n, u: -MU * sm.Abs(n), name="slot")
        system.add_loads(me.Force(system.bodies[0].masscenter, pull * system.frame.y))
        return system, *rest, "slot"

    model = compiled(made(), inputs={pull: 0.0})
    rates, outputs = (f(0.0, [0.0, 4.0], r={"P": force}) for f in (model.rhs, model.output))
    assert outputs[0] == pytest.approx(2.0 * 9.81 - force, abs=1e-12)
    assert rates[1] == pytest.approx(-0.3 * abs(2.0 * 9.81 - force) / 2.0, abs=1e-12)


def test_normal_force_that_vanishes_is_a_terminal_event_at_the_closed_form_time():
    pull = me.dynamicsymbols("P")
    system, values, initial, _ = box(lambda n, u: -MU * n)
    system.add_loads(me.Force(system.bodies[0].masscenter, pull * system.frame.y))
    model = compiled((system, values, initial, "lifted"), inputs={pull: 10 * T})
    run = model.simulate((0.0, 4.0), events=[fb.Event("N", terminal=True)], rtol=1e-9, atol=1e-9)
    assert run.status == 1
    assert run.t_events[0][0] == pytest.approx(2.0 * 9.81 / 10.0, rel=1e-12)


@pytest.mark.slow
def test_friction_not_linear_in_the_normal_force_equals_a_scalar_root():
    """Friction that falls as the contact is pressed harder, and lift that grows with it: one equation by brentq."""
    k = sm.Symbol("k")

    def made():
        system, values, initial, _ = box(lambda n, u: -MU * n / (1 + k * n**2))
        [block], frame = system.bodies, system.frame
        normal = me.dynamicsymbols("N")
        # A vertical force that is a function of N: the row of the auxiliary speed is not linear either.
        system.add_loads(me.Force(block.masscenter, 3 * sm.tanh(normal / 20) * frame.y))
        return system, values | {k: 0.01}, initial, "pressed"

    model = compiled(made())
    n = brentq(lambda n: n + 3 * np.tanh(n / 20) - 2.0 * 9.81, 0.0, 40.0, xtol=1e-14)
    assert model.output(0.0, [0.0, 4.0])[0] == pytest.approx(n, rel=1e-13)
    assert model.rhs(0.0, [0.0, 4.0])[1] == pytest.approx(-0.3 * n / (1 + 0.01 * n**2) / 2.0, rel=1e-13)
    # dn/dm from the equation for n, dx'/dm from the chain rule, both by hand.
    slope = 9.81 / (1 + 3 / 20 / np.cosh(n / 20) ** 2)
    friction = 0.3 * (1 - 0.01 * n**2) / (1 + 0.01 * n**2) ** 2
    expected = -friction * slope / 2.0 + 0.3 * n / (1 + 0.01 * n**2) / 4.0
    derivative = model.parameter_jacobian(0.0, [0.0, 4.0])[1, model.parameters.index("m")]
    assert derivative == pytest.approx(expected, rel=1e-12)


N_OF = 2.0 * 9.81  # of the block, where nothing else acts upwards


@pytest.mark.slow
@pytest.mark.parametrize(
    "law",
    [
        # Jumps and steps, of which derivatives know nothing.
        lambda n: MU * n + 5 * sm.Heaviside(n - 15),
        lambda n: 3 * sm.sign(n),
        lambda n: MU * n + sm.floor(n / 5),
        lambda n: sm.Piecewise((MU * n, n < 15), (MU * n + 5, True)),
        lambda n: sm.Piecewise((0, n <= 0), (3, True)),
        # No slope, or no value, at 0.
        lambda n: MU * n ** sm.Rational(9, 10),
        lambda n: sm.sqrt(n),
        lambda n: sm.log(n),
        lambda n: sm.sqrt((MU * n) ** 2 - 1),
        lambda n: MU * n * sm.sin(1.3 * sm.atan(50 / (0.39 * n))),  # H. B. Pacejka's formula, B = C_a / (C mu n)
    ],
)
def test_friction_laws_with_jumps_in_the_normal_force_give_closed_form_rates(law):
    """Of a known normal force: the law itself, evaluated by SymPy."""
    model = compiled(box(lambda n, u: -law(n), name="lawful"))
    n = sm.Symbol("n")
    expected = -float(law(n).subs({n: N_OF, MU: 0.3})) / 2.0
    assert model.rhs(0.0, [0.0, 4.0])[1] == pytest.approx(expected, rel=1e-13)
    assert model.output(0.0, [0.0, 4.0])[0] == pytest.approx(N_OF, rel=1e-13)
    run = model.simulate((0.0, 0.1), rtol=1e-9)
    assert run["u"][-1] == pytest.approx(4.0 + 0.1 * expected, rel=1e-12)


def test_reaction_with_a_step_of_itself_in_the_loads_is_found():
    """A force that does no work in the motion, and stands in the loads with a step of itself."""
    system, values, initial, _ = box(lambda n, u: 0 * n)
    block, normal = system.bodies[0].masscenter, me.dynamicsymbols("N")
    system.add_loads(me.Force(block, -5 * sm.Heaviside(normal - 15) * system.frame.y))
    assert compiled((system, values, initial, "stepped")).output(0.0, [0.0, 4.0])[0] == pytest.approx(N_OF + 5.0)


def table(friction, name):
    """A block on two legs that slides, with friction at both: heave and pitch are auxiliary speeds."""
    q, u, w, turn, front, rear = me.dynamicsymbols("q u w omega N_1 N_2")
    a, b, h = sm.symbols("a b h")
    ground, body = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, centre = me.Point("O"), me.Point("C")
    origin.set_vel(ground, 0)
    body.orient_axis(ground, ground.z, 0)
    body.set_ang_vel(ground, turn * ground.z)
    centre.set_pos(origin, q * ground.x + h * ground.y)
    centre.set_vel(ground, u * ground.x + w * ground.y)
    loads = []
    for leg, place, force in (("F", a, front), ("R", -b, rear)):
        foot = centre.locatenew(leg, place * ground.x - h * ground.y)
        foot.v2pt_theory(centre, ground, body)
        loads.append(me.Force(foot, force * ground.y - friction(force) * ground.x))
    block = me.RigidBody("block", centre, body, M, (me.inertia(body, 0, 0, J), centre))
    system = system_of(
        block, coordinates=[q], speeds=[u], auxiliary=[w, turn], loads=loads, frame=ground, origin=origin
    )
    return system, {G: 9.81, M: 2.0, MU: 0.3, J: 0.1, a: 0.4, b: 0.7, h: 0.25}, {q: 0.0, u: 1.0}, name


def test_two_contacts_with_absolute_friction_equal_all_choices_of_signs():
    """Against all ways to give the two forces signs: N_1 + N_2 = m g, and moments about the mass centre."""
    model = compiled(table(lambda n: MU * sm.Abs(n), "table"))
    generator, found = np.random.default_rng(0), {0: 0, 1: 0, 2: 0}
    for a, b, h in generator.uniform(0.1, 1.0, (300, 3)):
        solutions = []
        for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            moments = [a - 0.3 * h * signs[0], -b - 0.3 * h * signs[1]]
            n = np.linalg.solve([[1.0, 1.0], moments], [N_OF, 0.0])
            if (n * signs >= 0.0).all():
                solutions.append(n)
        found[len(solutions)] += 1
        arguments = (0.0, [0.0, 1.0], {"a": a, "b": b, "h": h})
        if solutions:
            n = model.output(*arguments)
            assert any(np.allclose(n, solution, rtol=1e-11, atol=1e-11) for solution in solutions)
            assert model.rhs(*arguments)[1] == pytest.approx(-0.3 * np.abs(n).sum() / 2.0, rel=1e-12)
        else:
            with pytest.raises(fb.SimulationError, match="No unknown forces were found"):
                model.rhs(*arguments)
    assert found[1] > 280
    assert found[0] > 0


@pytest.mark.slow
@pytest.mark.parametrize("law", [lambda n: 30 * sm.tanh(n / 100), lambda n: MU * n * (1 - n / 100)])
def test_two_contacts_with_smooth_friction_are_in_balance(law):
    model = compiled(table(law, "smooth_table"))
    n = np.array(model.output(0.0, [0.0, 1.0]))
    friction = sm.lambdify([sm.Symbol("n"), MU], law(sm.Symbol("n")))(n, 0.3)
    assert n.sum() == pytest.approx(N_OF, rel=1e-12)
    assert 0.4 * n[0] - 0.7 * n[1] - 0.25 * friction.sum() == pytest.approx(0.0, abs=1e-11)


@pytest.mark.slow
def test_unknown_forces_of_very_different_units_give_the_same_rates():
    """One in units of 1e-15: pivots are judged by the terms of their rows and columns."""
    system, values, initial, _ = table(lambda n: MU * n, "units")
    expected = compiled((system, values, initial, "units")).rhs(0.0, [0.0, 1.0])
    system, *_ = table(lambda n: MU * n, "units")
    rear = me.dynamicsymbols("N_2")
    scaled = [me.Force(load.point, load.force.subs(rear, 1e15 * rear)) for load in system.loads]
    system.loads = scaled
    found = compiled((system, values, initial, "other_units")).rhs(0.0, [0.0, 1.0])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_unknown_forces_in_energies_or_velocities_are_refused():
    normal = me.dynamicsymbols("N")
    system, values, initial, _ = box(lambda n, u: -MU * n)
    with pytest.raises(fb.ModelError, match="unknown forces N appear in the energies: they may appear only in loads"):
        fb.generate_sources(fb.Model(system, parameters=values, initial=initial, potential_energy=normal * 2))
    point = system.bodies[0].masscenter
    point.set_vel(system.frame, point.vel(system.frame) * (1 + normal))
    with pytest.raises(fb.ModelError, match="unknown forces N appear in the"):
        fb.generate_sources(fb.Model(system, parameters=values, initial=initial))


def test_sliding_rod_has_the_rates_and_jacobians_of_the_closed_form():
    model = compiled(rod(lambda n: MU * n, "sliding_rod"))
    p = [model.defaults[name] for name in ("g", "m", "l", "J", "mu")]
    for state in ([0.0, 1.0, -1.0, 0.3], [0.2, 0.4, 2.0, -3.0], [1.0, 2.5, 0.1, 1.0]):
        rates, normal = rods_rates(state, p)
        np.testing.assert_allclose(model.rhs(0.0, state), rates, rtol=1e-13, atol=1e-13)
        assert model.output(0.0, state)[0] == pytest.approx(normal, rel=1e-13)
        wrt_state = complex_steps(lambda x: rods_rates(x, p)[0], state)
        np.testing.assert_allclose(model.jacobian(0.0, state), wrt_state, rtol=1e-12, atol=1e-11)
        wrt_parameters = complex_steps(lambda p, x=state: rods_rates(x, p)[0], p)
        places = [model.parameters.index(name) for name in ("g", "m", "l", "J", "mu")]
        found = model.parameter_jacobian(0.0, state)[:, places]
        np.testing.assert_allclose(found, wrt_parameters, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("method", METHODS)
def test_sliding_rod_by_every_method_reaches_the_same_state(method):
    model = compiled(rod(lambda n: MU * n, "sliding_rod"))
    reference = model.simulate((0.0, 0.4), method="DOP853", rtol=1e-12, atol=1e-12)
    run = model.simulate((0.0, 0.4), method=method, rtol=1e-9, atol=1e-11)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[:, -1], reference.y[:, -1], rtol=0.0, atol=METHODS[method])


@pytest.mark.slow
def test_sliding_rod_in_painleves_paradox_raises_an_error_that_names_it():
    theta = 1.0
    s, c = np.sin(theta), np.cos(theta)
    critical = (c + 1 / (3 * c)) / s  # for J = m l^2 / 3, where the equation for N has no N in it
    linear = compiled(rod(lambda n: MU * n, "sliding_rod"))
    with pytest.raises(fb.SimulationError, match=r"unknown forces are not determined .* Painleve"):
        linear.rhs(0.0, [0.0, theta, -1.0, 0.0], {"mu": critical})
    run = linear.simulate((0.0, 1.0), [0.0, theta, -1.0, 0.0], parameters={"mu": 0.99 * critical})
    assert not run.success or np.isfinite(run.y).all()
    # With friction of |N|, N > 0 and N < 0 both contradict the equation beyond it.
    absolute = compiled(rod(lambda n: MU * sm.Abs(n), "pushed_rod"))
    state = [0.0, theta, -1.0, 0.0]
    below, _ = rods_rates(state, [9.81, 2.0, 0.5, 2.0 * 0.25 / 3, 0.9 * critical])
    np.testing.assert_allclose(absolute.rhs(0.0, state, {"mu": 0.9 * critical}), below, rtol=1e-11)
    with pytest.raises(fb.SimulationError, match=r"No unknown forces were found .* Painleve"):
        absolute.rhs(0.0, state, {"mu": 1.1 * critical})
    stopped = absolute.simulate((0.0, 1.0), state, parameters={"mu": 0.9 * critical})
    assert stopped.success or "unknown forces" in stopped.message


def cart(*, is_redundant):
    """A bob on a rod on a sledge with friction mu N, N carrying both; in least coordinates, or the bob's own."""
    q, u, w, normal = me.dynamicsymbols("q u u_n N")
    bob_mass = sm.Symbol("m_b")
    ground, arm = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, sledge, bob = me.Point("O"), me.Point("P"), me.Point("Q")
    origin.set_vel(ground, 0)
    sledge.set_pos(origin, q * ground.x)
    sledge.set_vel(ground, u * ground.x + w * ground.y)
    bodies = [me.Particle("sledge", sledge, M), me.Particle("bob", bob, bob_mass)]
    loads = [me.Force(sledge, normal * ground.y - MU * normal * ground.x)]
    values = {G: 9.81, M: 2.0, bob_mass: 1.5, L: 0.5, MU: 0.3}
    if not is_redundant:
        angle, rate = me.dynamicsymbols("phi omega")
        arm.orient_axis(ground, ground.z, angle)
        arm.set_ang_vel(ground, rate * ground.z)
        bob.set_pos(sledge, -L * arm.y)
        bob.v2pt_theory(sledge, ground, arm)
        system = system_of(
            *bodies, coordinates=[q, angle], speeds=[u, rate], auxiliary=[w], loads=loads, frame=ground, origin=origin
        )
        return system, values, {}, "sledge"
    x, y, vx, vy = me.dynamicsymbols("x y v_x v_y")
    bob.set_pos(origin, x * ground.x + y * ground.y)
    bob.set_vel(ground, vx * ground.x + vy * ground.y)
    system = system_of(
        *bodies, coordinates=[x, q, y], speeds=[vx, u, vy], auxiliary=[w], loads=loads, frame=ground, origin=origin
    )
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [x, q], [y], [vx, u], [vy]
    system.add_holonomic_constraints((x - q) ** 2 + y**2 - L**2)
    # Its rate where the auxiliary speed is not zero: the rod carries the bob's weight to the sledge.
    system.velocity_constraints = [2 * (x - q) * (vx - u) + 2 * y * (vy - w)]
    return system, values, {}, "sledge_in_cartesian_coordinates"


@pytest.mark.slow
def test_unknown_forces_beside_redundant_coordinates_give_the_same_motion():
    least, redundant = (compiled(cart(is_redundant=is_redundant)) for is_redundant in (False, True))
    for phi, u, omega in ((0.3, 1.0, -2.0), (-1.2, 0.5, 4.0), (2.0, -1.0, 0.5)):
        s, c = np.sin(phi), np.cos(phi)
        state = [0.5 * s, 0.0, -0.5 * c, u + 0.5 * c * omega, u, 0.5 * s * omega]
        expected, found = least.rhs(0.0, [0.0, phi, u, omega]), redundant.rhs(0.0, state)
        assert found[4] == pytest.approx(expected[2], rel=1e-12)
        bob = expected[2] + 0.5 * (c * expected[3] - s * omega**2)
        assert found[3] == pytest.approx(bob, rel=1e-12)
        normal = redundant.output(0.0, state)[0]
        assert normal == pytest.approx(least.output(0.0, [0.0, phi, u, omega])[0], rel=1e-12)
    runs = []
    for method in ("DOP853", "IDA"):
        run = redundant.simulate((0.0, 1.0), [0.0, 0.0, -0.5, 2.0, 1.0, 0.0], method=method, rtol=1e-10, atol=1e-10)
        assert run.success, run.message
        assert abs(run.constraint_residual).max() < 1e-10
        runs.append(run)
    np.testing.assert_allclose(runs[0].y[:, -1], runs[1].y[:, -1], atol=1e-7)
    lone = least.simulate((0.0, 1.0), [0.0, 0.0, 1.0, 2.0], rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(runs[0]["q"][-1], lone["q"][-1], atol=1e-8)
    assert redundant.jacobian(0.0, runs[0].y[:, -1]).shape == (6, 6)  # compared with differences when it was built


def test_sliding_rod_has_the_rates_and_force_of_sympys_linear_equations():
    """KanesMethod's mass matrix, forcing and auxiliary equations, linear in u' and N, solved as one system."""
    system, values, *_ = rod(lambda n: MU * n, "sliding_rod")
    system.form_eoms()
    rates, normal = [u.diff(T) for u in system.u], me.dynamicsymbols("N")
    unknowns = sm.symbols("a:2 n")
    equations = [*(system.mass_matrix * sm.Matrix(rates) - system.forcing), *system.eom_method.auxiliary_eqs]
    equations = [e.subs(dict(zip([*rates, normal], unknowns, strict=True))) for e in equations]
    matrix, rest = sm.linear_eq_to_matrix(equations, unknowns)
    evaluate = sm.lambdify([[*system.q, *system.u], [*values]], [matrix, rest])
    model = compiled(rod(lambda n: MU * n, "sliding_rod"))
    for state in np.random.default_rng(0).uniform(-1.0, 1.0, (20, 4)):
        a, b = evaluate(state, [*values.values()])
        solution = np.linalg.solve(a, b).ravel()
        np.testing.assert_allclose(model.rhs(0.0, state)[2:], solution[:2], rtol=1e-12, atol=1e-12)
        assert model.output(0.0, state)[0] == pytest.approx(solution[2], rel=1e-12)


@pytest.mark.slow
def test_state_equation_with_a_normal_force_moves_as_the_closed_form():
    """A relaxed normal force, such as that of a tyre: tau z' = N - z, with friction of z and of N."""
    z, tau = me.dynamicsymbols("z"), sm.Symbol("tau")
    normal = me.dynamicsymbols("N")
    system, values, initial, _ = box(lambda n, u: -MU * n - MU * me.dynamicsymbols("z"))
    made = system, values | {tau: 0.1}, initial | {z: 0.0}, "relaxed"
    model = compiled(made, state_equations={z: (normal - z) / tau})
    weight = 2.0 * 9.81
    for method in ("DOP853", "Radau", "IDA"):
        run = model.simulate((0.0, 0.5), method=method, rtol=1e-9, atol=1e-10)
        relaxed = weight * (1 - np.exp(-run.t / 0.1))
        np.testing.assert_allclose(run["z"], relaxed, atol=1e-6)
        gone = 0.3 / 2.0 * (2 * weight * run.t - weight * 0.1 * (1 - np.exp(-run.t / 0.1)))
        np.testing.assert_allclose(run["u"], 4.0 - gone, atol=1e-6)
    expected = [[0, 1, 0], [0, 0, -0.15], [0, 0, -10]]
    np.testing.assert_allclose(model.jacobian(0.0, [0.0, 4.0, 1.0]), expected, atol=1e-12)
    by_mass = model.parameter_jacobian(0.0, [0.0, 4.0, 1.0])[:, model.parameters.index("m")]
    np.testing.assert_allclose(by_mass, [0.0, 0.3 / 4.0, 98.1], rtol=1e-12)


def test_ensembles_and_batches_with_unknown_forces_equal_closed_forms():
    model = compiled(box(lambda n, u: -MU * n))
    ensemble = model.ensemble((0.0, 1.0), parameters={"mu": [0.1, 0.2]}, t_eval=[1.0], rtol=1e-9)
    np.testing.assert_allclose(ensemble["u"].ravel(), 4.0 - 9.81 * np.array([0.1, 0.2]), rtol=1e-9)
    np.testing.assert_allclose(model.rhs_batch(0.0, np.array([[0.0, 1.0], [4.0, 3.0]]))[1], -0.3 * 9.81)


def test_forces_along_no_auxiliary_speed_are_inputs_or_refused():
    push = me.dynamicsymbols("F")
    system, values, *_ = box(lambda n, u: -MU * n + push)
    model = fb.Model(system, parameters=values, inputs="auto")
    assert (model.outputs, model.inputs) == (("N",), ("F",))
    assert fb.Model(system, parameters=values, inputs={push: 1}).outputs == ("N",)
    with pytest.raises(fb.ModelError, match=r"F\(t\) in the force at point P: not among"):
        fb.Model(system, parameters=values)
    with pytest.raises(fb.ModelError, match=r"ALI3P does not support unknown forces that drive the motion \(N\)"):
        compiled(box(lambda n, u: -MU * n)).simulate((0.0, 1.0), method="ALI3P", max_step=1e-2)


@pytest.mark.slow
def test_ball_that_slides_on_a_spinning_disc_moves_as_the_closed_form():
    """Coulomb friction mu N against the slip relative to the disc: x'' and w' by hand, for a solid ball."""
    x, y, vx, vy, w, normal = me.dynamicsymbols("x y v_x v_y u_n N")
    spins = me.dynamicsymbols("w_x w_y w_z")
    radius, omega = sm.symbols("r Omega")
    ground, frame = me.ReferenceFrame("N"), me.ReferenceFrame("B")
    origin, centre, contact = me.Point("O"), me.Point("C"), me.Point("P")
    origin.set_vel(ground, 0)
    frame.set_ang_vel(ground, sum((s * e for s, e in zip(spins, ground, strict=True)), 0 * ground.x))
    centre.set_pos(origin, x * ground.x + y * ground.y)
    centre.set_vel(ground, vx * ground.x + vy * ground.y + w * ground.z)
    contact.set_pos(centre, -radius * ground.z)
    contact.set_vel(ground, centre.vel(ground) + frame.ang_vel_in(ground).cross(-radius * ground.z))
    slip = contact.vel(ground).subs({w: 0}) - omega * ground.z.cross(x * ground.x + y * ground.y)
    friction = -MU * normal * slip / sm.sqrt(slip.dot(slip))
    inertia = me.inertia(ground, *[2 * M * radius**2 / 5] * 3)  # the same along all axes
    ball = me.RigidBody("ball", centre, frame, M, (inertia, centre))
    system = System(ground, origin)
    system.add_bodies(ball)
    system.q_ind, system.u_ind, system.u_aux = [x, y], [vx, vy, *spins], [w]
    system.kdes = [x.diff(T) - vx, y.diff(T) - vy]
    system.apply_uniform_gravity(-G * ground.z)
    system.add_loads(me.Force(contact, normal * ground.z + friction))
    values = {G: 9.81, M: 2.0, MU: 0.3, radius: 0.1, omega: 5.0}
    model = fb.compile_model(fb.Model(system, name="ball_on_disc", parameters=values))
    state = np.array([0.4, -0.2, 1.0, 0.3, -2.0, 4.0, 1.5])
    px, py, ux, uy, wx, wy, _ = state
    relative = np.array([ux - 0.1 * wy + 5.0 * py, uy + 0.1 * wx - 5.0 * px])
    force = -0.3 * 9.81 * relative / np.linalg.norm(relative)  # per mass
    turn = np.array([force[1], -force[0], 0.0]) * 2.5 / 0.1  # -r e_z x F / (2/5 m r^2)
    np.testing.assert_allclose(model.rhs(0.0, state), [ux, uy, *force, *turn], rtol=1e-13, atol=1e-13)
    # On a disc at rest the slip keeps its direction and falls by 7/2 mu g, from 1 m/s.
    run = model.simulate((0.0, 0.09), [0.0, 0.0, 0.6, 0.8, 0.0, 0.0, 0.0], parameters={"Omega": 0.0}, rtol=1e-10)
    slipping = np.hypot(run["v_x"] - 0.1 * run["w_y"], run["v_y"] + 0.1 * run["w_x"])
    np.testing.assert_allclose(slipping, 1.0 - 3.5 * 0.3 * 9.81 * run.t, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disc that slides, normal force", "disc on a linear tyre"])
def test_symbrims_tyres_with_normal_forces_agree_with_sympy(name):
    case = next(case for case in LONG if case.name == name)
    assert run(case).disagreement(case) == ""


def elbow(kind, *, opposite=False, friction=False):
    """A double pendulum of particles, absolute angles; the joint between the rods is opened by auxiliary speeds."""
    q1, q2, u1, u2, ax, ay, fx, fy = me.dynamicsymbols("q1 q2 u1 u2 ax ay fx fy")
    ground, upper, lower = (me.ReferenceFrame(name) for name in "NAB")
    upper.orient_axis(ground, ground.z, q1)
    lower.orient_axis(ground, ground.z, q2)
    upper.set_ang_vel(ground, u1 * ground.z)
    lower.set_ang_vel(ground, u2 * ground.z)
    origin, bob, pivot, end = (me.Point(name) for name in ("O", "P1", "P", "P2"))
    origin.set_vel(ground, 0)
    bob.set_pos(origin, -L * upper.y)
    bob.v2pt_theory(origin, ground, upper)
    pivot.set_pos(origin, -L * upper.y)
    pivot.set_vel(ground, bob.vel(ground) + ax * ground.x + ay * ground.y)
    end.set_pos(pivot, -L * lower.y)
    end.v2pt_theory(pivot, ground, lower)
    force = fx * ground.x + fy * ground.y
    loads = [(bob, -M * G * ground.y), (end, -M * G * ground.y), (pivot, force)]
    loads += [(bob, -force)] if opposite else []
    if friction:
        torque = -MU * sm.sqrt(fx**2 + fy**2) * sm.tanh(10 * (u2 - u1)) * ground.z
        loads += [(lower, torque), (upper, -torque)]
    bodies, kdes = [me.Particle("b1", bob, M), me.Particle("b2", end, M)], [u1 - q1.diff(T), u2 - q2.diff(T)]
    if kind == "KanesMethod":
        system = me.KanesMethod(
            ground, [q1, q2], [u1, u2], kd_eqs=kdes, u_auxiliary=[ax, ay], bodies=bodies, forcelist=loads
        )
    else:
        system = System(ground, origin)
        system.add_bodies(*bodies)
        system.add_loads(*loads)
        system.add_coordinates(q1, q2)
        system.add_speeds(u1, u2)
        system.add_auxiliary_speeds(ax, ay)
        system.add_kdes(*kdes)
    values = {M: 1.0, L: 1.0, G: 9.81} | ({MU: 0.2} if friction else {})
    return system, values, {q1: 1.0, q2: 0.5, u1: 0.0, u2: 0.0}, "elbow"


def elbows_rates(state, mu=0.0):
    """x' and the force on the lower rod, from Newton's and Euler's laws for each rod."""
    q, u = np.array(state[:2]), np.array(state[2:])
    s, c = np.sin(q), np.cos(q)

    def left(turns, force, torque):
        (x1, x2), (y1, y2) = np.cumsum(c * turns - s * u**2), np.cumsum(s * turns + c * u**2)
        return np.array([
            x2 - force[0],
            y2 + 9.81 - force[1],
            c[1] * x2 + s[1] * (y2 + 9.81) - torque,
            c[0] * (x1 + force[0]) + s[0] * (y1 + 9.81 + force[1]) + torque,
        ])  # fmt: skip

    force = np.zeros(2)
    for _ in range(100):  # a contraction, since the friction is weak
        torque = -mu * np.hypot(*force) * np.tanh(10 * (u[1] - u[0]))
        rest = left(np.zeros(2), np.zeros(2), torque)
        matrix = np.transpose([left(e[:2], e[2:], torque) - rest for e in np.eye(4)])
        solution = np.linalg.solve(matrix, -rest)
        force = solution[2:]
    return [*u, *solution[:2]], force


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "reactions"), [("System", ["fx", "fy"]), ("KanesMethod", "all")])
def test_joint_force_on_one_body_warns_unless_named_as_a_reaction(kind, reactions):
    made = elbow(kind)
    with pytest.warns(fb.ModelWarning, match=r"fx, fy \(force at point P\).*reactions=\['fx', 'fy'\]"):
        driven = compiled(made)
    run = driven.simulate((0.0, 2.0), rtol=1e-11, atol=1e-11)
    assert run["q2"][-1] == pytest.approx(-2.2268685, abs=1e-7)
    joined = compiled(made, reactions=reactions)
    run = joined.simulate((0.0, 2.0), rtol=1e-11, atol=1e-11)
    assert run["q2"][-1] == pytest.approx(0.0521971909, abs=1e-9)
    np.testing.assert_allclose(run["energy"], run["energy"][0], rtol=1e-10)
    for state in run.y.T[:: run.t.size // 5]:
        rates, force = elbows_rates(state)
        np.testing.assert_allclose(joined.rhs(0.0, state), rates, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(joined.output(0.0, state), force, rtol=1e-12, atol=1e-12)


def test_joint_force_on_both_bodies_is_a_reaction_without_a_name():
    state = [1.0, 0.5, 0.3, -0.7]
    model = compiled(elbow("System", opposite=True))
    rates, force = elbows_rates(state)
    np.testing.assert_allclose(model.rhs(0.0, state), rates, rtol=1e-12)
    np.testing.assert_allclose(model.output(0.0, state), force, rtol=1e-12)
    named = fb.compile_model(model_of(elbow("System", opposite=True), reactions="all"))
    np.testing.assert_allclose(named.rhs(0.0, state), rates, rtol=1e-9)


@pytest.mark.slow
def test_friction_by_a_named_reaction_gives_closed_form_rates():
    """The joint force is named, so the torque that depends on it is all that drives the motion."""
    made = elbow("System", friction=True)
    f, g = me.dynamicsymbols("fx fy")
    model = compiled(made, reactions=[f, g])
    for state in ([1.0, 0.5, 0.3, -0.7], [2.0, -0.5, 1.3, 0.4]):
        rates, force = elbows_rates(state, mu=0.2)
        np.testing.assert_allclose(model.rhs(0.0, state), rates, rtol=1e-12)
        np.testing.assert_allclose(model.output(0.0, state), force, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["System", "KanesMethod"])
@pytest.mark.parametrize("friction", [None, lambda v: MU, lambda v: MU * sm.tanh(v)])
def test_normal_force_along_a_wedge_gives_newtons_accelerations(kind, friction):
    """A block on a wedge that slides, with N at the block alone; accelerations by Newton's law for each body."""
    angle, wedge, block = sm.symbols("alpha M_w m_b")
    x, s, u, v, w, normal = me.dynamicsymbols("x s u v w N")
    ground, (origin, corner, contact) = me.ReferenceFrame("F"), map(me.Point, "OWP")
    along = sm.cos(angle) * ground.x + sm.sin(angle) * ground.y
    across = -sm.sin(angle) * ground.x + sm.cos(angle) * ground.y
    origin.set_vel(ground, 0)
    corner.set_pos(origin, x * ground.x)
    corner.set_vel(ground, u * ground.x)
    contact.set_pos(corner, s * along)
    contact.set_vel(ground, u * ground.x + v * along + w * across)
    bodies = [me.Particle("wedge", corner, wedge), me.Particle("block", contact, block)]
    force = normal * (across - (friction(v) if friction else 0) * along)
    loads = [(corner, -wedge * G * ground.y), (contact, force - block * G * ground.y)]
    # Friction acts between the two bodies; its opposite on the wedge is given, that of N is not.
    loads += [(corner, normal * friction(v) * along)] if friction else []
    kdes = [u - x.diff(T), v - s.diff(T)]
    if kind == "KanesMethod":
        system = me.KanesMethod(ground, [x, s], [u, v], kd_eqs=kdes, u_auxiliary=[w], bodies=bodies, forcelist=loads)
    else:
        system = System(ground, origin)
        system.add_bodies(*bodies)
        system.add_loads(*(me.Force(*load) for load in loads))
        system.add_coordinates(x, s)
        system.add_speeds(u, v)
        system.add_auxiliary_speeds(w)
        system.add_kdes(*kdes)
    values = {wedge: 2.0, block: 1.0, G: 9.81, angle: 0.5} | ({MU: 0.3} if friction else {})
    with pytest.warns(fb.ModelWarning, match=r"The unknown forces N .*reactions=\['N'\]"):
        fb.compile_model(fb.Model(system, name="wedge", parameters=values))
    model = fb.compile_model(fb.Model(system, name="wedge", parameters=values, reactions=["N"]))
    rate = 0.4
    mu = 0.0 if friction is None else 0.3 if friction(v) == MU else 0.3 * np.tanh(rate)
    sine, cosine = np.sin(0.5), np.cos(0.5)
    # M x'' = N (sin + mu cos), N = m (g cos - x'' sin), s'' = -g sin - mu N / m - x'' cos.
    push = sine + mu * cosine
    moved = 9.81 * cosine * push / (2.0 + sine * push)
    force = 9.81 * cosine - moved * sine
    expected = [0.0, rate, moved, -9.81 * sine - mu * force - moved * cosine]
    np.testing.assert_allclose(model.rhs(0.0, [0.0, 0.0, 0.0, rate]), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(model.output(0.0, [0.0, 0.0, 0.0, rate]), force, rtol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [sm.Symbol("beta"), me.dynamicsymbols("beta")])
def test_joint_force_along_turned_axes_gives_the_motion_of_inertial_axes(angle):
    """Which axes a force is counted along makes no difference: see the joint along inertial axes."""
    system, values, initial, _ = elbow("System")
    fx, fy = me.dynamicsymbols("fx fy")
    frame = system.frame
    turned = fx * (sm.cos(angle) * frame.x + sm.sin(angle) * frame.y)
    turned += fy * (sm.cos(angle) * frame.y - sm.sin(angle) * frame.x)
    *others, (pivot, _) = system.loads
    system.loads = [*others, me.Force(pivot, turned)]
    given = {"inputs": {angle: 0.3}} if angle.args else {}
    values = values if given else {**values, angle: 0.3}
    arguments = {"name": "turned", "parameters": values, "initial": initial, **given}
    with pytest.warns(fb.ModelWarning, match="The unknown forces fx, fy"):
        fb.compile_model(fb.Model(system, **arguments))
    run = fb.compile_model(fb.Model(system, **arguments, reactions="all")).simulate((0.0, 2.0), rtol=1e-10, atol=1e-10)
    assert run["q2"][-1] == pytest.approx(0.0521971909, abs=1e-9)


@pytest.mark.slow
def test_reactions_that_name_no_unknown_force_are_refused():
    made = elbow("System")
    compiled(made, reactions=[])  # says that they drive the motion, without a warning
    for reactions in (["fz"], [me.dynamicsymbols("q1")], [3], "fx", 3):
        with pytest.raises(fb.ModelError, match="reactions="):
            model_of(made, reactions=reactions)
    system, values, initial, name = box(lambda n, u: -MU * n)
    with pytest.raises(fb.ModelError, match="unknown forces along auxiliary speeds: N"):
        fb.Model(system, name=name, parameters=values, initial=initial, reactions=["mu"])
    with pytest.raises(fb.ModelError, match="the model has none"):
        fb.Model(system, parameters=values, initial=initial, inputs={"N": 0}, reactions=["N"])
    system.loads = [me.Force(system.bodies[0].masscenter, sm.Abs(me.dynamicsymbols("N")) * system.frame.y)]
    with pytest.raises(fb.ModelError, match=r"N in reactions= acts along no auxiliary speed: .* in laws only"):
        fb.generate_sources(fb.Model(system, parameters=values, initial=initial, reactions=["N"], extra="ignore"))
