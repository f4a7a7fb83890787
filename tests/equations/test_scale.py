"""Long chains and many loops, against other implementations; and counts of operations.

Longer chains are measured by benchmarks/scale.py. Tolerances are the 1e-10 that equations at scale are to hold,
relative to the size of the terms.
"""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import FORMS
from formulations.newton_euler import Link, joint_torques
from scale import spherical_chain
from scipy.optimize import brentq
from sympy.physics.mechanics.models import n_link_pendulum_on_cart
from sympy.physics.mechanics.system import System
from tutorial import Tutorial

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations
from fourbar_codegen.lowering.lower import lower

G = 9.81
X, Y, Z = np.eye(3)


def bars(count):
    return [Link(Z, X, X / 2, 1.0, np.diag([0.0, 0.0, 1 / 12]))] * count


def balls(count):
    inertia = np.diag([0.11, 0.12, 0.03])
    bar = [Link(X), Link(Y), Link(Z, -0.8 * Z, -0.4 * Z, 1.3, inertia)]
    return bar * count


INERTIA = np.diag([0.02, 0.05, 0.03])


def by_positions(count):
    """Links about x, y and z by turns, of which only positions are given; each mass centre stands beside its link."""
    q, u = me.dynamicsymbols(f"q:{count}"), me.dynamicsymbols(f"u:{count}")
    ground, joint = me.ReferenceFrame("N"), me.Point("O")
    joint.set_vel(ground, 0)
    system, before = System(ground, joint), ground
    for number, (angle, speed) in enumerate(zip(q, u, strict=True)):
        axis = (before.x, before.y, before.z)[number % 3]
        link = me.ReferenceFrame(f"A{number}")
        link.orient_axis(before, axis, angle)
        link.set_ang_vel(before, speed * axis)
        center = joint.locatenew(f"C{number}", link.x / 2 + link.y / 5)
        inertia = me.inertia(link, *np.diag(INERTIA))
        system.add_bodies(me.RigidBody(f"link_{number}", center, link, 1, (inertia, center)))
        joint, before = joint.locatenew(f"J{number}", link.x), link
    system.apply_uniform_gravity(-G * ground.z)
    system.q_ind, system.u_ind = q, u
    system.add_kdes(*(speed - angle.diff() for angle, speed in zip(q, u, strict=True)))
    return fb.Model(system, name=f"by_positions_{count}")


def skewed(count):
    return [Link((X, Y, Z)[number % 3], X, X / 2 + Y / 5, 1.0, INERTIA) for number in range(count)]


@pytest.mark.slow
def test_long_spatial_chain_is_read_without_expanded_velocities():
    """SymPy's own, which is differentiated in the inertial frame, does not end for a third of these links."""
    model = by_positions(32)
    assert len(model.mechanism.points) == 1 + 2 * 32 - 1
    assert all(point.velocity is None for point in model.mechanism.points[1:])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "links", "gravity"),
    [
        (lambda: by_positions(7), skewed(7), -G * Z),
        (lambda: fb.models.chain(12), bars(12), -G * Y),
        (lambda: fb.models.chain(16, closed=True), bars(16), -G * Y),
        (lambda: spherical_chain(3), balls(3), -G * Z),
        (lambda: spherical_chain(8), balls(8), -G * Z),
    ],
    ids=["7 links by positions", "12 links", "16 closed links", "3 ball joints", "8 ball joints"],
)
def test_long_chains_balance_the_torques_of_recursive_newton_euler(model, links, gravity):
    compiled = fb.compile_model(model())
    generator = np.random.default_rng(3)
    n = compiled.n_u
    assert len(links) == n
    for _ in range(5):
        q, u = generator.uniform(-1, 1, n), generator.uniform(-1, 1, n)
        x = np.concatenate((q, u))
        # M u' - f for any u', by columns; M and f apart, and so every entry of M.
        mass_matrix, forcing = compiled.tree_mass_matrix(0.0, x), compiled.tree_forcing(0.0, x)
        bias, jacobian = joint_torques(links, gravity, q, u, np.zeros(n))
        np.testing.assert_allclose(-forcing, bias, rtol=0, atol=1e-10 * np.abs(bias).max())
        columns = [joint_torques(links, gravity, q, u, unit)[0] - bias for unit in np.eye(n)]
        np.testing.assert_allclose(mass_matrix, np.array(columns).T, rtol=0, atol=1e-10 * np.abs(mass_matrix).max())
        np.testing.assert_allclose(compiled.rhs(0.0, x)[:n], u, rtol=0, atol=0)
        accelerations, multipliers = compiled.kernel.accelerations(0.0, x)
        torques = joint_torques(links, gravity, q, u, accelerations)[0]
        reactions = jacobian[: compiled.n_c].T @ multipliers
        size = np.abs(bias).max() + np.abs(reactions).max(initial=0.0)
        np.testing.assert_allclose(torques, reactions, rtol=0, atol=1e-10 * size)


@pytest.mark.slow
@pytest.mark.parametrize("links", [1, 3, 6])
def test_pendulum_on_a_cart_of_several_links_has_sympys_rates(links):
    kane = n_link_pendulum_on_cart(links)
    symbols = sorted(kane.mass_matrix_full.free_symbols | kane.forcing_full.free_symbols, key=str)
    symbols = [symbol for symbol in symbols if symbol != me.dynamicsymbols._t]
    values = [0.5 + 0.1 * i for i in range(len(symbols))]
    force = me.dynamicsymbols("F")
    inputs = {force: 0.7} if force in me.find_dynamicsymbols(kane.forcing_full) else {}
    compiled = fb.compile_model(fb.Model(kane, parameters=dict(zip(symbols, values, strict=True)), inputs=inputs))
    states = [*kane.q, *kane.u]
    evaluate = sm.lambdify([states, symbols, list(inputs)], [kane.mass_matrix_full, kane.forcing_full], cse=True)
    for x in np.random.default_rng(5).uniform(-1, 1, (20, len(states))):
        expected = np.linalg.solve(*evaluate(x, values, list(inputs.values()))).ravel()
        np.testing.assert_allclose(compiled.rhs(0.0, x), expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())


def branches(arms, links):
    """A hub that turns about a pin, and chains of bars on it that turn about axes of two kinds."""
    m, length, g = sm.symbols("m l g")
    ground = me.RigidBody("ground")
    ground.masscenter.set_vel(ground.frame, 0)
    system = System.from_newtonian(ground)
    hub = me.RigidBody("hub", mass=m)
    hub.inertia = (me.inertia(hub.frame, m, m, m), hub.masscenter)
    system.add_joints(me.PinJoint("pin", ground, hub, joint_axis=ground.frame.z))
    for arm in range(arms):
        parent, start = hub, length * sm.Integer(arm + 1) * hub.frame.x
        for number in range(links):
            body = me.RigidBody(f"bar{arm}_{number}", mass=m)
            body.inertia = (me.inertia(body.frame, m / 7, m / 5, m / 6), body.masscenter)
            axis = parent.frame.y if (arm + number) % 2 else parent.frame.x
            system.add_joints(
                me.PinJoint(
                    f"pin{arm}_{number}", parent, body, parent_point=start, child_point=-length * body.frame.x,
                    joint_axis=axis,
                )
            )  # fmt: skip
            parent, start = body, length * body.frame.x
    system.apply_uniform_gravity(-g * ground.frame.y)
    return fb.Model(system, name="branches", parameters={m: 1.1, length: 0.6, g: G})


@pytest.mark.slow
def test_branched_tree_in_recursive_form_has_sympys_rates():
    model = branches(5, 2)
    compiled = fb.compile_model(model)
    assert compiled.manifest["form"] == "recursive"
    # The ground's mass and inertia have no values, and no part in the equations.
    values = {symbol: float(parameter.value or 1.0) for symbol, parameter in model.parameter_symbols.items()}
    reference = Tutorial(model.system, values, {})
    for x in np.random.default_rng(6).uniform(-1, 1, (20, compiled.n_x)):
        expected = reference.rhs(0.0, x)
        np.testing.assert_allclose(compiled.rhs(0.0, x), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.slow(but=["1"])
@pytest.mark.parametrize("loops", [1, 3, 20])
def test_row_of_parallelograms_of_any_length_moves_as_the_closed_form(loops):
    # [(N + 1) / 3 + N] L phi'' = [(N + 1) / 2 + N] g sin(phi), the bars across stay level (IFToMM benchmark A02).
    compiled = fb.compile_model(fb.models.n_four_bar(loops))
    upright = loops + 1
    for angle in (0.0, 0.3, 1.2, -2.0):
        x = np.zeros(compiled.n_x)
        x[:upright], x[compiled.n_q : compiled.n_q + upright] = angle, 1.7
        expected = ((loops + 1) / 2 + loops) / ((loops + 1) / 3 + loops) * G * np.sin(angle)
        accelerations, multipliers = compiled.kernel.accelerations(0.0, x)
        np.testing.assert_allclose(accelerations[:upright], expected, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(accelerations[upright:], 0.0, rtol=0, atol=1e-9)
        _, mass_matrix, forcing, jacobian, _ = compiled.kernel.dynamics(0.0, x)
        balance = mass_matrix @ accelerations - forcing - jacobian.T @ multipliers
        np.testing.assert_allclose(balance, 0.0, rtol=0, atol=1e-10 * np.abs(forcing).max())


def operations(model, name="dynamics"):
    (count,) = (each.operations for each in lower("model", form_equations(model)).functions if each.name == name)
    return count


@pytest.mark.slow
def test_operations_of_a_closed_chain_grow_at_most_quadratically():
    counts = [operations(fb.models.chain(links, closed=True)) for links in (5, 10, 20)]
    assert counts[1] < 4 * counts[0]
    assert counts[2] < 4 * counts[1]


@pytest.mark.slow
def test_operations_of_a_row_of_loops_grow_linearly():
    counts = [operations(fb.models.n_four_bar(loops)) for loops in (5, 10, 20)]
    assert counts[1] < 2.05 * counts[0]
    assert counts[2] < 2.05 * counts[1]


def pieces(count):
    """An oscillator whose spring is given by cubics, with conditions on both sides as SymPy's splines have them."""
    q, u = me.dynamicsymbols("q u")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    mass = origin.locatenew("P", q * frame.x)
    mass.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_bodies(me.Particle("mass", mass, 1))
    cubics = [((i + 1) * q - (i + 2) * q**3, (q >= i) & (q <= i + 1)) for i in range(count)]
    system.add_loads(me.Force(mass, sm.Piecewise(*cubics) * frame.x))
    return fb.Model(system, name="pieces")


@pytest.mark.slow
def test_code_of_a_spline_grows_linearly_and_its_values_are_right():
    """With derivatives, along a direction and in reverse: equal numbers of pieces add equal text, but for digits."""
    lengths = [sum(map(len, fb.generate_sources(pieces(count)).values())) for count in (8, 16, 24)]
    assert lengths[2] - lengths[1] == pytest.approx(lengths[1] - lengths[0], rel=0.1)
    model = fb.compile_model(pieces(8))
    for place in (0.5, 3.25, 7.5):
        i = int(place)
        expected = [[0.0, 1.0], [(i + 1) - 3 * (i + 2) * place**2, 0.0]]
        assert model.rhs(0.0, [place, 0.0])[1] == pytest.approx((i + 1) * place - (i + 2) * place**3, rel=1e-14)
        np.testing.assert_allclose(model.jacobian(0.0, [place, 0.0]), expected, rtol=1e-14)
    with pytest.raises(fb.SimulationError, match="not finite"):
        model.rhs(0.0, [8.5, 0.0])


def rockers_on_one_crank(count):
    """Four-bars that share their crank OA: couplers AB, rockers BC."""
    points, links, ground = {"O": (0, 0), "A": (0.2, 0.1)}, [["O", "A"]], ["O"]
    for i in range(count):
        points |= {f"B{i}": (1.0 + 0.1 * i, 0.8), f"C{i}": (1.1 + 0.2 * i, -0.1)}
        links += [["A", f"B{i}"], [f"B{i}", f"C{i}"]]
        ground.append(f"C{i}")
    return fb.Linkage(f"rockers_{count}", points=points, ground=ground, links=links, density=2.0, gravity=9.81).model()


@pytest.mark.slow
def test_elimination_of_loops_on_one_crank_grows_linearly():
    """A loop has 2 speeds and 2 constraints; their columns have those of the loop, and the crank."""
    for count in (4, 12):
        structure = lower("rockers", form_equations(rockers_on_one_crank(count))).structure
        assert sum(map(len, structure.below)) <= count * (4 + 3 + 2 + 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMS)
def test_models_for_tests_of_each_form_have_it(name):
    make, form = FORMS[name]
    assert lower("model", form_equations(make())).form == form


def test_lowering_to_a_form_that_a_model_lacks_is_refused():
    """A four-bar is too small for others; a recursion needs independent constraints."""
    equations = form_equations(fb.models.four_bar())
    assert lower("four_bar", equations, "dense").form == "dense"
    with pytest.raises(fb.ModelError, match=r"four_bar has no recursive form; it has: dense\."):
        lower("four_bar", equations, "recursive")


@pytest.mark.slow
def test_sparse_equations_with_a_loop_at_its_dead_point_hold_to_rounding():
    """Where a coupler is in line with its rocker, its constraints are dependent without the crank's speed."""
    model = fb.compile_model(rockers_on_one_crank(4))
    x = model.initial_state(speeds={model.speeds[0]: 2.0})
    states = [x]
    for offset in (0.0, 1e-9, 1e-3, 1e-2, 0.1):
        dead = x.copy()
        place = model.n_q - 1
        # The last loop's angle at which its two rows are parallel in its two speeds: by bisection of the determinant.

        def determinant(angle, place=place, dead=dead):
            moved = dead.copy()
            moved[place] = angle
            rows = model.kernel.dynamics(0.0, moved, None, [])[3][-2:]
            return np.linalg.det(rows[:, 1:][:, np.abs(rows[:, 1:]).max(axis=0) > 0.0])

        angles = np.linspace(dead[place] - 3.0, dead[place] + 3.0, 601)
        signs = np.array([determinant(angle) for angle in angles])
        first = int(np.flatnonzero(signs[:-1] * signs[1:] < 0.0)[0])
        dead[place] = brentq(determinant, angles[first], angles[first + 1], xtol=1e-15) + offset
        states.append(dead)
    for state in states:
        _, mass, forcing, jacobian, bias = model.kernel.dynamics(0.0, state, None, [])
        whole = np.block([[mass, -jacobian.T], [jacobian, np.zeros((8, 8))]])
        expected = np.linalg.solve(whole, np.concatenate((forcing, -bias)))
        found = np.concatenate(model.kernel.accelerations(0.0, state))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    # Lanes in which it is dead are left to the functions for single states.
    together = model.rhs_batch(0.0, np.column_stack(states))
    for rates, state in zip(together.T, states, strict=True):
        expected = model.rhs(0.0, state)
        np.testing.assert_allclose(rates, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
