"""Velocity constraints as models state them: which keep the positions, whatever their form, and which do not."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.kanes_methods import kanes_method
from builders.systems import quaternion_top
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations

T = me.dynamicsymbols._t
Y_AFTER_1_S = -0.16501085312554
"""IFToMM multibody benchmark A01, a pendulum of 1 m in Cartesian coordinates that begins level, at rest."""

METHODS = {
    "RK45": {"rtol": 1e-11, "atol": 1e-11},
    "Radau": {"rtol": 1e-10, "atol": 1e-10},
    "IDA": {"rtol": 1e-10, "atol": 1e-10},
    "ALI3P": {"max_step": 1e-4},
}


def bead(*names, holonomic, velocity, dependent):
    """A particle of 2 kg with forces of gravity -m g along the second axis."""
    m, g = sm.symbols("m g")
    q, u = [me.dynamicsymbols(name) for name in names], [me.dynamicsymbols(f"v_{name}") for name in names]
    ground, origin, bob = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    axes = (ground.x, ground.y, ground.z)
    bob.set_pos(origin, sum((x * axis for x, axis in zip(q, axes, strict=False)), 0 * ground.x))
    bob.set_vel(ground, sum((v * axis for v, axis in zip(u, axes, strict=False)), 0 * ground.x))
    system = System(ground, origin)
    system.add_bodies(me.Particle("bob", bob, m))
    system.apply_uniform_gravity(-g * ground.y)
    independent = [place for place in range(len(q)) if place not in dependent]
    system.q_dep, system.q_ind = [q[0]], q[1:]
    system.u_dep, system.u_ind = [u[place] for place in dependent], [u[place] for place in independent]
    system.add_kdes(*(x.diff(T) - v for x, v in zip(q, u, strict=True)))
    phi = holonomic(*q)
    system.add_holonomic_constraints(phi)
    rate = phi.diff(T).xreplace({x.diff(T): v for x, v in zip(q, u, strict=True)})
    system.velocity_constraints = velocity(phi, rate, *q, *u)
    begin = {"x": -1.0, "y": 0.0, "z": 0.2, "v_y": 0.0, "v_z": 0.3}
    initial = {s: begin[s.name] for s in (*q, *system.u_ind)}
    return fb.Model(system, name="bead", parameters={m: 2.0, g: 9.81}, initial=initial)


def pendulum(velocity):
    return bead("x", "y", holonomic=lambda x, y: x**2 + y**2 - 1, velocity=velocity, dependent=[0])


STATED = {
    "negative": lambda phi, rate, x, y, u, v: [-rate],
    "half": lambda phi, rate, x, y, u, v: [x * u + y * v],
    "by_a_parameter": lambda phi, rate, x, y, u, v: [rate / sm.Symbol("g")],
    "of_unit_length": lambda phi, rate, x, y, u, v: [rate / sm.sqrt(x**2 + y**2)],
    "by_a_function": lambda phi, rate, x, y, u, v: [rate * sm.exp(x) / (2 + sm.sin(y))],
    "with_the_violation": lambda phi, rate, x, y, u, v: [rate + 5 * phi],
    "on_closed_loops_alone": lambda phi, rate, x, y, u, v: [rate + phi * u],
}


@pytest.mark.slow(but=["by_a_parameter-ALI3P"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("stated", STATED)
def test_velocity_constraints_in_any_form_keep_the_positions(stated, method):
    model = fb.compile_model(pendulum(STATED[stated]))
    assert model.manifest["position_rows"] == [0]
    run = model.simulate((0.0, 1.0), method=method, **METHODS[method])
    # Tolerances of 1e-10 at a few hundred steps; the fixed steps' own error is of the size of their square.
    assert run["y"][-1] == pytest.approx(Y_AFTER_1_S, abs=1e-6 if method == "ALI3P" else 1e-7)
    assert np.abs(run.constraint_residual).max() < 1e-12
    # J^T lambda is the bar's force, whatever the row's form: along the bar, m (v^2 - g y) for a length of 1.
    x, y, u, v = (run[name][-1] for name in ("x", "y", "v_x", "v_y"))
    force = model.kernel.velocity(1.0, run.y[:, -1])[0].T @ run.multipliers[:, -1]
    tension = 2.0 * (u**2 + v**2 - 9.81 * y)
    np.testing.assert_allclose(force, [-tension * y, -tension * x], rtol=0, atol=1e-8 * tension)


def test_rounding_error_of_a_negative_velocity_constraint_is_positive():
    """That of x^2 + y^2 - 1, by which its violation is measured: 2 x^2 + 2 y^2 + 1, up to 1e-12 for each leaf."""
    equations = form_equations(pendulum(STATED["negative"]))
    [scale] = equations.tape.evaluate(
        equations.positions.violation_scale.entries,
        dict(zip(equations.variables.coordinates, (0.6, -0.9), strict=True)),
    )
    assert scale == pytest.approx(2 * 0.6**2 + 2 * 0.9**2 + 1, abs=1e-11)


@pytest.mark.slow
def test_velocity_constraints_by_a_function_keep_positions_in_ensembles():
    model = fb.compile_model(pendulum(STATED["by_a_function"]))
    ensemble = model.ensemble((0.0, 1.0), parameters={"m": np.linspace(1.0, 2.0, 9)}, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(ensemble["y"][:, -1], Y_AFTER_1_S, rtol=0, atol=1e-9)
    assert np.abs(ensemble["x"] ** 2 + ensemble["y"] ** 2 - 1.0).max() < 1e-13


@pytest.mark.slow
def test_velocity_constraints_with_roots_of_a_norm_keep_the_positions():
    """The rate is the constraint's own, with E^(-1/2) and E^(-3/2) of one E in it."""
    model = fb.compile_model(
        bead(
            "x", "y", dependent=[0], holonomic=lambda x, y: x + y**2 / sm.sqrt(1 + y**2) - 1,
            velocity=lambda phi, rate, *_: [rate],
        )
    )  # fmt: skip
    x0 = model.initial_state({"y": 0.3})
    run = model.simulate((0.0, 2.0), x0, rtol=1e-10, atol=1e-10)
    assert np.abs(run["x"] + run["y"] ** 2 / np.sqrt(1 + run["y"] ** 2) - 1.0).max() < 1e-12
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=1e-7)


def combined(system, matrix):
    """The velocity constraints of a System, combined."""
    return [*(sm.Matrix(matrix) * system.velocity_constraints)]


@pytest.mark.slow
def test_velocity_constraints_that_combine_rates_give_the_same_motion(four_bar):
    model = fb.models.four_bar()
    q1 = me.dynamicsymbols("q1")
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    matrices = {
        "numbers": lambda q1: [[1, 2], [3, -1]],
        "functions": lambda q1: [[sm.cos(q1), -sm.sin(q1)], [sm.sin(q1), sm.cos(q1)]],
    }
    for name, matrix in matrices.items():
        kane = kanes_method(model.system, velocity_constraints=combined(model.system, matrix(q1)))
        compiled = fb.compile_model(fb.Model(kane, name=name, parameters=values, inputs=model.input_expressions))
        x0 = four_bar.initial_state()
        for method, tolerances in METHODS.items():
            runs = [each.simulate((0.0, 2.0), x0, method=method, **tolerances) for each in (four_bar, compiled)]
            assert np.abs(runs[1].constraint_residual).max() < 1e-12
            np.testing.assert_allclose(runs[1].y[:, -1], runs[0].y[:, -1], rtol=0, atol=2e-7)
            # S = G D, so that D^T mu = S^T lambda is mu = G^T lambda.
            g = np.array(sm.Matrix(matrix(runs[1].y[0, -1])), dtype=float)
            mu = runs[0].multipliers[:, -1]
            np.testing.assert_allclose(g.T @ runs[1].multipliers[:, -1], mu, rtol=0, atol=1e-5 * np.abs(mu).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "velocity",
    [
        lambda phi, rate, x, y, z, u, v, w: [rate, w - x * v],
        lambda phi, rate, x, y, z, u, v, w: [w - x * v, rate],
        lambda phi, rate, x, y, z, u, v, w: [w - x * v + rate / 3, rate - 2 * (w - x * v)],
        lambda phi, rate, x, y, z, u, v, w: [sm.exp(y) * (w - x * v) + rate, (2 + sm.sin(x)) * rate],
    ],
    ids=["rate_first", "rate_last", "combined", "combined_by_functions"],
)
def test_velocity_constraints_mixed_with_nonholonomic_rows_keep_the_positions(velocity):
    """A bead on a sphere on which w = x v, in every order and combination of the two rows."""
    model = fb.compile_model(
        bead("x", "y", "z", holonomic=lambda x, y, z: x**2 + y**2 + z**2 - 1, velocity=velocity, dependent=[0, 2])
    )
    x0 = model.initial_state()
    for method, tolerances in {
        **METHODS, "index-3": {"rtol": 1e-9, "atol": 1e-9}, "index-1": {"rtol": 1e-10, "atol": 1e-10},
    }.items():  # fmt: skip
        formulation = {"method": "IDA", "formulation": method} if method.startswith("index") else {"method": method}
        run = model.simulate((0.0, 1.0), x0, **formulation, **tolerances)
        assert run.success
        x, y, z, v, w = (run[name] for name in ("x", "y", "z", "v_y", "v_z"))
        closed = 1e-7 if method == "index-1" else 1e-11
        assert np.abs(x**2 + y**2 + z**2 - 1).max() < closed
        if method != "index-3":  # where velocities are not controlled
            assert np.abs(w - x * v).max() < 10 * closed
            # No constraint does work: T + V stays.
            np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=2e-5 if method == "ALI3P" else 1e-6)


def test_velocity_constraints_that_do_not_keep_positions_are_refused():
    with pytest.raises(fb.ModelError, match=r"do not keep holonomic constraint 1, x\(t\)\*\*2.*Phi\.diff\(t\)"):
        pendulum(lambda phi, rate, x, y, u, v: [x * u - y * v])
    # A bias of its own: the bob leaves the circle at a constant rate.
    with pytest.raises(fb.ModelError, match="do not keep holonomic constraint 1"):
        pendulum(lambda phi, rate, x, y, u, v: [rate - sm.Symbol("g")])
    model = fb.models.four_bar()
    rows = [model.system.velocity_constraints[0], sm.Matrix([me.dynamicsymbols("u1")])[0]]
    kane = kanes_method(model.system, velocity_constraints=rows)
    with pytest.raises(fb.ModelError, match="do not keep holonomic constraint 2"):
        fb.Model(kane, inputs=model.input_expressions)


def top_with_norm(*, stated, dependent_speeds=()):
    """A body on a ball joint in quaternions, with their norm as a holonomic constraint."""
    system = quaternion_top()
    e = system.q_ind[:]
    system.q_ind, system.q_dep = e[1:], e[:1]
    system.add_holonomic_constraints(sum(entry**2 for entry in e) - 1)
    system.u_ind, system.u_dep = [w for w in system.u_ind if w not in dependent_speeds], dependent_speeds
    if stated:
        system.velocity_constraints = []
    begin = dict(zip((*e[1:], *system.u_ind), (0.3, 0.1, 0, 1, 0.5, 3), strict=not dependent_speeds))
    return fb.Model(system, name="top", initial=begin)


def direction_of_the_top(x0, t):
    """Of the axis to the mass centre, by Euler's equations and R' = R [w]x."""
    e0, e1, e2, e3 = x0[3], *x0[:3]
    skew = np.array([[0, -e3, e2], [e3, 0, -e1], [-e2, e1, 0]])
    rotation = np.eye(3) + 2 * e0 * skew + 2 * skew @ skew
    inertia = np.array([2.0, 3.0, 3.0])  # about the joint; the mass of 1 is 1 from it

    def rates(_, x):
        r, w = x[:9].reshape(3, 3), x[9:]
        torque = np.cross([0.0, 0.0, -1.0], r.T @ [0.0, 0.0, -9.81])
        return [*(r @ np.cross(np.eye(3), w)).ravel(), *((torque - np.cross(w, inertia * w)) / inertia)]

    run = solve_ivp(rates, (0.0, t), [*rotation.ravel(), *x0[4:]], rtol=1e-12, atol=1e-12, method="DOP853")
    return -run.y[:9, -1].reshape(3, 3)[:, 2]


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True])
def test_the_norm_of_a_quaternion_needs_no_velocity_constraint(stated):
    top = fb.compile_model(top_with_norm(stated=stated))
    assert (top.n_h, top.n_c, top.manifest["invariants"]) == (1, 0, [0])
    x0 = top.initial_state(guess={"e0": 1.0})
    expected = direction_of_the_top(x0, 5.0)
    for method, tolerances in {**METHODS, "ALI3P": {"max_step": 1e-3}}.items():
        run = top.simulate((0.0, 5.0), x0, method=method, **tolerances)
        assert np.abs(run.constraint_residual).max() < 1e-13
        e = np.array([run[f"e{i}"][-1] for i in range(4)])
        axis = [2 * (e[1] * e[3] + e[0] * e[2]), 2 * (e[2] * e[3] - e[0] * e[1]), 1 - 2 * (e[1] ** 2 + e[2] ** 2)]
        # A fixed step of 1e-3 errs by its square times the fourth power of rates near 4, over 5 s.
        np.testing.assert_allclose(np.negative(axis), expected, rtol=0, atol=1e-3 if method == "ALI3P" else 1e-7)
    open_run = top.simulate((0.0, 5.0), x0, constraints="none")
    assert np.abs(open_run.constraint_residual).max() > 1e-9  # so that something was corrected above
    ensemble = top.ensemble((0.0, 5.0), np.tile(x0, (9, 1)), rtol=1e-11, atol=1e-11)
    e = np.array([ensemble[f"e{i}"][:, -1] for i in range(4)])
    np.testing.assert_allclose(np.sum(e**2, axis=0), 1.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(2 * (e[1] * e[3] + e[0] * e[2]), -expected[0], rtol=0, atol=1e-8)


def test_dependent_speed_for_the_norm_of_a_quaternion_is_refused():
    with pytest.raises(fb.ModelError, match="0 velocity constraints but 1 dependent speeds"):
        fb.compile_model(top_with_norm(stated=False, dependent_speeds=me.dynamicsymbols("w3:4")))


def test_top_in_quaternions_has_closed_form_equilibrium_and_frequencies():
    top = fb.compile_model(top_with_norm(stated=False))
    hanging = top.equilibrium({"e1": 0.05, "e2": 0.0, "e3": 0.0, "e0": 1.0})
    np.testing.assert_allclose(np.abs(hanging[:2]), 0.0, atol=1e-9)
    a = top.linearize(0.0, hanging)[0]
    # A compound pendulum about x and about y: omega^2 = m g l / I = 9.81 / 2 and 9.81 / 3; about z it turns freely.
    found = np.sort(np.abs(np.linalg.eigvals(a).imag))
    np.testing.assert_allclose(found, [0, 0, *np.sqrt([9.81 / 3] * 2), *np.sqrt([9.81 / 2] * 2)], atol=1e-5)


@pytest.mark.slow
def test_two_bars_in_quaternions_keep_their_norms_and_their_loop():
    """Two bars on ball joints whose ends meet: norms beside constraints that speeds change."""
    t = T
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    system, ends, coordinates, speeds = System(ground, origin), [], [], []
    for number, at in enumerate((0.0, 1.0)):
        e, w = me.dynamicsymbols(f"e{number}_0:4"), me.dynamicsymbols(f"w{number}_1:4")
        bar, joint, center, end = me.ReferenceFrame(f"B{number}"), me.Point(f"J{number}"), me.Point("C"), me.Point("E")
        bar.orient_quaternion(ground, e)
        bar.set_ang_vel(ground, w[0] * bar.x + w[1] * bar.y + w[2] * bar.z)
        joint.set_pos(origin, at * ground.x)
        joint.set_vel(ground, 0)
        center.set_pos(joint, -bar.z / 2)
        end.set_pos(joint, -bar.z)
        center.v2pt_theory(joint, ground, bar)
        system.add_bodies(me.RigidBody(f"bar{number}", center, bar, 1, (me.inertia(bar, 0.1, 0.1, 0.05), center)))
        matrix = [[-e[1], -e[2], -e[3]], [e[0], -e[3], e[2]], [e[3], e[0], -e[1]], [-e[2], e[1], e[0]]]
        system.add_kdes(
            *(x.diff(t) - sum(a * b for a, b in zip(row, w, strict=True)) / 2 for x, row in zip(e, matrix, strict=True))
        )
        system.add_holonomic_constraints(sum(x**2 for x in e) - 1)
        ends.append(end)
        coordinates.append(e)
        speeds.append(w)
    system.apply_uniform_gravity(-9.81 * ground.z)
    gap = ends[1].pos_from(ends[0])
    system.add_holonomic_constraints(*(gap.dot(axis) for axis in ground))
    (first, second), (u, v) = coordinates, speeds
    system.q_ind = [first[1], first[3], second[3]]
    system.q_dep = [first[0], first[2], *second[:3]]
    system.u_ind, system.u_dep = [u[0], u[2], v[2]], [u[1], *v[:2]]
    model = fb.compile_model(fb.Model(system, name="two_bars"))
    assert (model.n_h, model.n_c, model.manifest["invariants"]) == (5, 3, [0, 1])
    assert model.manifest["position_rows"] == [None, None, 0, 1, 2]
    # Both bars lean by 30 degrees towards each other.
    lean, upright = np.sin(np.pi / 12), np.cos(np.pi / 12)
    x0 = model.initial_state(
        dict.fromkeys(("e0_1", "e0_3", "e1_3"), 0.0), {"w0_1": 2.0, "w0_3": 1.0, "w1_3": -1.0},
        guess={"e0_0": upright, "e0_2": -lean, "e1_0": upright, "e1_1": 0.0, "e1_2": lean},
    )  # fmt: skip
    for method, tolerances in {**METHODS, "ALI3P": {"max_step": 1e-3}}.items():
        run = model.simulate((0.0, 2.0), x0, method=method, **tolerances)
        assert np.abs(run.constraint_residual).max() < 1e-12
        np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-3 if method == "ALI3P" else 1e-7)
    # The ends stay on a circle about the line through the joints, of radius sqrt(3)/2: a pendulum.
    e = [run[f"e0_{i}"] for i in range(4)]
    end = -np.array([2 * (e[1] * e[3] + e[0] * e[2]), 2 * (e[2] * e[3] - e[0] * e[1]), 1 - 2 * (e[1] ** 2 + e[2] ** 2)])
    np.testing.assert_allclose(end[0], 0.5, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(end[1], end[2]), np.sqrt(0.75), rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("norm", [False, True])
def test_chain_of_bodies_in_quaternions_has_sympys_rates(norm):
    """Off their norms, velocities depend on the frames that sums go by; the check is at states where they hold."""
    ground, joint = me.ReferenceFrame("N"), me.Point("O")
    joint.set_vel(ground, 0)
    system = System(ground, joint)
    for number in range(2):
        e, w = me.dynamicsymbols(f"e{number}_0:4"), me.dynamicsymbols(f"w{number}_1:4")
        bar, center, end = me.ReferenceFrame(f"B{number}"), me.Point(f"C{number}"), me.Point(f"E{number}")
        bar.orient_quaternion(ground, e)
        bar.set_ang_vel(ground, w[0] * bar.x + w[1] * bar.y + w[2] * bar.z)
        center.set_pos(joint, -bar.z / 2)
        end.set_pos(joint, -bar.z)
        center.v2pt_theory(joint, ground, bar)
        end.v2pt_theory(joint, ground, bar)
        system.add_bodies(me.RigidBody(f"bar{number}", center, bar, 1, (me.inertia(bar, 0.1, 0.1, 0.05), center)))
        matrix = [[-e[1], -e[2], -e[3]], [e[0], -e[3], e[2]], [e[3], e[0], -e[1]], [-e[2], e[1], e[0]]]
        system.add_coordinates(*e[1:])
        system.add_coordinates(e[0], independent=not norm)
        system.add_speeds(*w)
        system.add_kdes(
            *(x.diff(T) - sum(a * b for a, b in zip(row, w, strict=True)) / 2 for x, row in zip(e, matrix, strict=True))
        )
        if norm:
            system.add_holonomic_constraints(sum(x**2 for x in e) - 1)
        joint = end
    system.apply_uniform_gravity(-9.81 * ground.z)
    chain = fb.compile_model(fb.Model(system, name="chain_of_quaternions"))
    x0 = np.zeros(chain.n_x)
    for name, value in {"e0_0": 0.8, "e0_1": 0.6, "e1_0": 0.6, "e1_2": 0.8, "w0_1": 1.0, "w1_3": 2.0}.items():
        x0[chain.states.index(name)] = value
    for method in ("DOP853", "Radau"):  # the latter by compiled derivatives, which are compared then
        run = chain.simulate((0.0, 1.0), x0, method=method, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-5)
    if norm:  # SymPy asks for a dependent speed
        return
    system.form_eoms()
    states = [*system.q, *system.u]
    values = {state: x0[chain.states.index(str(state.func))] for state in states}
    expected = system.mass_matrix_full.xreplace(values).LUsolve(system.forcing_full.xreplace(values))
    found = dict(zip(chain.states, chain.rhs(0.0, x0), strict=True))
    np.testing.assert_allclose(
        [found[str(state.func)] for state in states], np.array(expected, dtype=float).ravel(), rtol=1e-11, atol=1e-11
    )


@pytest.mark.slow
def test_velocity_constraints_that_hold_on_one_side_alone_are_refused():
    """Not where all coordinates are positive alone, and factors that are numbers there are not elsewhere."""
    with pytest.raises(fb.ModelError, match="do not keep"):
        pendulum(lambda phi, rate, x, y, u, v: [sm.Abs(x) * u + sm.Abs(y) * v])
    stepping = fb.compile_model(pendulum(lambda phi, rate, x, y, u, v: [(2 + sm.sign(x)) * rate]))
    run = stepping.simulate((0.0, 1.0), rtol=1e-11, atol=1e-11)
    assert np.abs(run.constraint_residual).max() < 1e-12


def bump(velocity):
    """A bead on a road with a bump at x = 8 m, which no random state of some metres comes close to."""
    x, z, u, w = me.dynamicsymbols("x z u w")
    ground, origin, bob = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    bob.set_pos(origin, x * ground.x + z * ground.z)
    bob.set_vel(ground, u * ground.x + w * ground.z)
    road = z - sm.Rational(3, 10) * sm.exp(-((x - 8) ** 2))
    kane = me.KanesMethod(
        ground, [x], [u], kd_eqs=[u - x.diff(T), w - z.diff(T)], q_dependent=[z], u_dependent=[w],
        configuration_constraints=[road], velocity_constraints=[velocity(road, w)],
        bodies=[me.Particle("bob", bob, sm.Symbol("m"))], forcelist=[(bob, -9.81 * sm.Symbol("m") * ground.z)],
    )  # fmt: skip
    return fb.compile_model(fb.Model(kane, name="bump", parameters={sm.Symbol("m"): 1.0}, initial={x: 0.0, u: 4.0}))


@pytest.mark.slow
def test_run_that_comes_to_where_its_constraints_drift_ends_with_a_message():
    """The rate is that of a flat road: at random states it is right, and the run says where it is not."""
    flat = bump(lambda road, w: w).simulate((0.0, 4.0), rtol=1e-8, atol=1e-8, t_eval=np.linspace(0.0, 4.0, 201))
    assert not flat.success
    assert "do not keep holonomic constraint 1 at zero: at t = " in flat.message
    right = bump(lambda road, w: road.diff(T)).simulate((0.0, 4.0), rtol=1e-8, atol=1e-8)
    assert right.success
    # Energy: as fast behind the bump as before it.
    assert right["u"][-1] == pytest.approx(4.0, abs=1e-6)


@pytest.mark.slow
def test_velocity_constraints_of_time_hold_in_a_run_that_begins_later():
    """A bead on a straight wire, whose speed u is relative to a belt: x' = u + cos t. It slides down as without one."""
    x, y, u, v = me.dynamicsymbols("x y u v")
    ground, origin, bob = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    bob.set_pos(origin, x * ground.x + y * ground.y)
    bob.set_vel(ground, (u + sm.cos(T)) * ground.x + v * ground.y)
    kane = me.KanesMethod(
        ground, [x], [u], kd_eqs=[u + sm.cos(T) - x.diff(T), v - y.diff(T)], q_dependent=[y], u_dependent=[v],
        configuration_constraints=[y - x], velocity_constraints=[v - u - sm.cos(T)],
        bodies=[me.Particle("bob", bob, sm.Symbol("m"))], forcelist=[(bob, -9.81 * sm.Symbol("m") * ground.y)],
    )  # fmt: skip
    model = fb.compile_model(fb.Model(kane, name="belt", parameters={sm.Symbol("m"): 1.0}))
    x0 = model.initial_state({"x": 0.0}, {"u": 1.0 - np.cos(2.0)}, t=2.0)
    run = model.simulate((2.0, 5.0), x0, rtol=1e-10, atol=1e-10)
    assert run.success, run.message
    assert run["x"][-1] == pytest.approx(3.0 - 9.81 / 4.0 * 9.0, abs=1e-8)


@pytest.mark.slow
def test_velocity_constraints_with_poles_are_passed():
    """u_d - A u_i: where the last two bars of a chain are in line, A is infinite, and the loop moves on regularly."""
    model = fb.models.chain(4, closed=True)
    system, dependent = model.system, model.system.u_dep
    rates = system.velocity_constraints.xreplace({x.diff(T): v for x, v in zip(system.q, system.u, strict=True)})
    rest = rates.xreplace(dict.fromkeys(dependent, 0))
    kane = kanes_method(system, velocity_constraints=[*(dependent + rates.jacobian(dependent).LUsolve(rest))])
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    solved = fb.compile_model(fb.Model(kane, name="solved", parameters=values))
    stated = fb.compile_model(model)
    x0 = stated.initial_state(speeds={"u1": 3.0, "u2": -5.0})
    run = solved.simulate((0.0, 10.0), x0, rtol=1e-10, atol=1e-10)
    assert run.success
    in_line = np.sin(run["q4"])
    poles = run.t[1:][in_line[1:] * in_line[:-1] < 0.0]
    assert len(poles) > 10
    assert np.abs(run.constraint_residual).max() < 1e-12
    # The same motion as with the rates as they are, up to the errors of 160 steps; afterwards it is chaotic.
    assert poles[0] < 2.0
    ends = [each.simulate((0.0, 2.0), x0, rtol=1e-10, atol=1e-10).y[:, -1] for each in (solved, stated)]
    np.testing.assert_allclose(*ends, rtol=0, atol=1.6e-8)
