"""States with equations of their own: motors, filters, tyres, against closed forms and SciPy."""

import csv
import pickle
import re

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import of_form
from builders.state_equations import T, cartesian, motor, rotor
from click.testing import CliRunner
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.cli import main

# Of local errors, at rtol = 1e-9, over some hundred steps; ALI3P is of order 2, and takes steps of 1e-3 s.
METHODS = {
    "RK45": ({}, 1e-8),
    "DOP853": ({}, 1e-8),
    "Radau": ({}, 1e-7),
    "CVODE": ({}, 1e-6),
    "IDA": ({}, 1e-6),
    "ALI3P": ({"max_step": 1e-3}, 1e-4),
}
TIGHT = {"rtol": 1e-9, "atol": 1e-11}


MOTOR = np.array([[0.0, 1.0, 0.0], [0.0, -10.0, 1.0], [0.0, -0.02, -2.0]])
VOLTAGE = np.array([[0.0], [0.0], [2.0]])


def motor_at(time, x0):
    """For 1 V, by the matrix exponential of the linear equations."""
    extended = np.zeros((4, 4))
    extended[:3] = np.hstack((MOTOR, VOLTAGE))
    return (expm(extended * time) @ [*x0, 1.0])[:3]


def test_motor_with_a_current_has_it_among_states_names_and_sizes():
    model = motor()
    assert model.auxiliary_states == ("i",)
    assert "1 auxiliary states" in repr(model)
    compiled = fb.compile_model(model)
    assert compiled.states == ("theta", "omega", "i")
    assert (compiled.n_q, compiled.n_u, compiled.n_z, compiled.n_x) == (1, 1, 1, 3)
    assert "auxiliary states i;" in repr(compiled)
    assert compiled.initial_state().tolist() == [0.3, 0.5, 0.2]
    assert compiled.initial_state(auxiliary_states={"i": 0.7}).tolist() == [0.3, 0.5, 0.7]


def test_motor_has_the_rates_jacobian_and_linearization_of_its_matrices():
    compiled = fb.compile_model(motor())
    x = compiled.initial_state()
    np.testing.assert_allclose(compiled.rhs(0.0, x), MOTOR @ x + VOLTAGE[:, 0], rtol=1e-14)
    np.testing.assert_allclose(compiled.jacobian(0.0, x), MOTOR, rtol=1e-14)
    np.testing.assert_allclose(compiled.input_jacobian(0.0, x), VOLTAGE, rtol=1e-14)
    A, B = compiled.linearize(0.0, x)
    np.testing.assert_allclose(A, MOTOR, rtol=1e-14)
    np.testing.assert_allclose(B, VOLTAGE, rtol=1e-14)


@pytest.mark.slow(but=["DOP853", "ALI3P", "Radau"])
@pytest.mark.parametrize("method", METHODS)
def test_motor_by_every_method_moves_as_the_matrix_exponential(method):
    options, tolerance = METHODS[method]
    compiled = fb.compile_model(motor())
    x0 = compiled.initial_state()
    run = compiled.simulate((0.0, 2.0), x0, method=method, **TIGHT, **options)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[:, -1], motor_at(2.0, x0), rtol=0, atol=tolerance)
    np.testing.assert_array_equal(run["i"], run.z[0])
    np.testing.assert_allclose(run["induced"], 1.0 - run["i"] - 0.01 * run["omega"], rtol=0, atol=1e-14)


@pytest.mark.slow
def test_motor_in_ensembles_batches_and_modules_moves_as_the_matrix_exponential(tmp_path):
    compiled = fb.compile_model(motor())
    x0 = compiled.initial_state()
    expected = motor_at(2.0, x0)
    several = compiled.ensemble((0.0, 2.0), np.tile(x0, (9, 1)), **TIGHT)
    np.testing.assert_allclose(several.y[:, :, -1], np.tile(expected, (9, 1)), rtol=0, atol=1e-8)
    states = np.random.default_rng(0).normal(size=(3, 19))
    np.testing.assert_allclose(compiled.rhs_batch(0.0, states), MOTOR @ states + VOLTAGE, rtol=0, atol=1e-13)

    run = compiled.simulate((0.0, 2.0), x0, dense_output=True, events=[lambda t, x: x[2] - 0.5], **TIGHT)
    np.testing.assert_allclose(run.sol(1.234), motor_at(1.234, x0), rtol=0, atol=1e-8)
    [time] = run.t_events[0]
    assert motor_at(time, x0)[2] == pytest.approx(0.5, abs=1e-8)
    for name in ("run.npz", "run.nc"):
        run.save(tmp_path / name)
        np.testing.assert_allclose(fb.load_trajectory(tmp_path / name)["i"], run["i"], rtol=1e-15)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(compiled)).rhs(0.0, x0), compiled.rhs(0.0, x0))
    np.testing.assert_array_equal(run.to_xarray()["i"].values, run.z[0])
    run.save(tmp_path / "report.html")
    assert "Auxiliary states" in (tmp_path / "report.html").read_text()

    stepper = compiled.stepper(1e-2, x0)
    for _ in range(200):
        x = stepper.step()
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-7)  # order 4, time constants of 0.1 s

    loose = compiled.simulate((0.0, 2.0), x0, rtol=1e-9, atol=[1e-9, 1e-9, 1e3])
    assert loose.success
    module = fb.load(fb.build_model(motor(), tmp_path))
    np.testing.assert_allclose(module.simulate((0.0, 2.0), x0, **TIGHT).y[:, -1], expected, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_equilibrium_of_a_motor_against_a_spring_is_the_closed_form():
    system, body, inertia, angle, speed = rotor()
    stiffness, k, ohm, henry, voltage = sm.symbols("c K R L V")
    current = me.dynamicsymbols("i")
    system.add_loads(me.Torque(body.frame, (k * current - stiffness * angle) * system.frame.z))
    model = fb.Model(
        system,
        name="stalled",
        parameters={inertia: 0.01, stiffness: 2.0, k: 0.3, ohm: 4.0, henry: 0.1, voltage: 12.0},
        state_equations={current: (voltage - ohm * current - k * speed) / henry},
    )
    x = fb.compile_model(model).equilibrium()
    np.testing.assert_allclose(x, [0.3 * 3.0 / 2.0, 0.0, 3.0], rtol=1e-12)


@pytest.mark.slow
def test_filter_that_drives_a_mass_moves_it_as_the_closed_form():
    """m v' + c v = k e, RC e' = V - e, from rest."""
    m, c, k, tau = 2.0, 0.7, 3.0, 0.4
    q, u, filtered, volts = me.dynamicsymbols("q u e V")
    symbols = sm.symbols("m c k tau")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, q * frame.x)
    point.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_bodies(me.Particle("mass", point, symbols[0]))
    system.add_loads(me.Force(point, (symbols[2] * filtered - symbols[1] * u) * frame.x))
    model = fb.Model(
        system,
        name="filtered",
        parameters=dict(zip(symbols, (m, c, k, tau), strict=True)),
        inputs={volts: None},
        state_equations={filtered: (volts - filtered) / symbols[3]},
        initial={q: 0.0, u: 0.0, filtered: 0.0},
    )
    compiled = fb.compile_model(model)
    t = np.linspace(0.0, 3.0, 7)

    def speed(tau):
        # Of m v' + c v = k (1 - exp(-t / tau)).
        return k * ((1 - np.exp(-c * t / m)) / c - (np.exp(-t / tau) - np.exp(-c * t / m)) / (c - m / tau))

    for source in (1.0, ([0.0, 5.0], [1.0, 1.0]), lambda t, x: 1.0):
        run = compiled.simulate((0.0, 3.0), inputs={"V": source}, t_eval=t, **TIGHT)
        np.testing.assert_allclose(run["u"], speed(tau), rtol=0, atol=1e-8)
        np.testing.assert_allclose(run["e"], 1 - np.exp(-t / tau), rtol=0, atol=1e-8)
    taus = np.linspace(0.2, 0.9, 11)
    runs = compiled.ensemble((0.0, 3.0), parameters={"tau": taus}, inputs={"V": 1.0}, t_eval=t, **TIGHT)
    np.testing.assert_allclose(runs.y[:, 1], np.array([speed(tau) for tau in taus]), rtol=0, atol=1e-8)


def test_relaxation_of_a_tyre_gives_the_damped_oscillation():
    """m v' = F, (s / V) F' + F = -C v / V: a damped oscillation (Pacejka, Tire and Vehicle Dynamics, section 7.1)."""
    m, length, forward, stiffness = 200.0, 0.4, 10.0, 5e4
    y, v, force = me.dynamicsymbols("y v F")
    symbols = sm.symbols("m s V C")
    wall, body = me.RigidBody("road"), me.RigidBody("wheel", mass=symbols[0])
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("lateral", wall, body, y, v, joint_axis=wall.frame.y))
    system.add_loads(me.Force(body.masscenter, force * wall.frame.y))
    model = fb.Model(
        system,
        name="tyre",
        parameters=dict(zip(symbols, (m, length, forward, stiffness), strict=True)),
        state_equations={force: -(symbols[2] * force + symbols[3] * v) / symbols[1]},
        initial={y: 0.0, v: 0.5, force: 0.0},
    )
    run = fb.compile_model(model).simulate((0.0, 1.0), **TIGHT)
    decay = forward / (2 * length)
    omega = np.sqrt(stiffness / (m * length) - decay**2)
    expected = 0.5 * np.exp(-decay * run.t) * (np.cos(omega * run.t) + decay / omega * np.sin(omega * run.t))
    np.testing.assert_allclose(run["v"], expected, rtol=0, atol=1e-8)


# Of the pendulum in Cartesian coordinates, x^2 + y^2 = l^2, with a force along x by a state z that follows its
# acceleration, and one w that follows the multiplier.


def cartesian_rates(state, m=1.3, g=9.81, tau=0.2):
    """By hand: m x'' = z + 2 lambda x, m y'' = -m g + 2 lambda y, x x'' + y y'' + v^2 = 0."""
    y, x, vy, vx, z, w = state
    multiplier = (m * (g * y - vx**2 - vy**2) - x * z) / (2 * (x**2 + y**2))
    ax, ay = (z + 2 * multiplier * x) / m, -g + 2 * multiplier * y / m
    return np.array([vy, vx, ay, ax, (ay / 10 - z) / tau, multiplier * x - w * (1 + z)])


def test_state_equations_with_accelerations_and_multipliers_have_closed_form_rates():
    compiled = fb.compile_model(cartesian())
    x0 = compiled.initial_state()
    generator = np.random.default_rng(0)
    for x in (x0, *generator.normal(size=(5, 6))):
        np.testing.assert_allclose(compiled.rhs(0.0, x), cartesian_rates(x), rtol=1e-13, atol=1e-13)
        wrt_state = np.transpose([cartesian_rates(x + 1e-30j * unit).imag / 1e-30 for unit in np.eye(6)])
        np.testing.assert_allclose(compiled.jacobian(0.0, x), wrt_state, rtol=1e-12, atol=1e-12)
        columns = {"m": 1.3, "g": 9.81, "tau": 0.2}
        wrt_parameters = np.transpose(
            [cartesian_rates(x, **{name: value + 1e-30j}).imag / 1e-30 for name, value in columns.items()]
        )
        places = [compiled.parameters.index(name) for name in columns]
        found = compiled.parameter_jacobian(0.0, x)[:, places]
        np.testing.assert_allclose(found, wrt_parameters, rtol=1e-12, atol=1e-12)
    states = generator.normal(size=(6, 19))
    expected = np.transpose([cartesian_rates(x) for x in states.T])
    np.testing.assert_allclose(compiled.rhs_batch(0.0, states), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_state_equations_with_multipliers_by_every_method_move_as_scipy(method):
    options, tolerance = METHODS[method]
    compiled = fb.compile_model(cartesian())
    x0 = compiled.initial_state()
    # Without projection: the constraint drifts by what the tolerance lets it.
    expected = solve_ivp(lambda t, x: cartesian_rates(x), (0.0, 1.0), x0, method="DOP853", rtol=1e-12, atol=1e-13)
    run = compiled.simulate((0.0, 1.0), x0, method=method, **TIGHT, **options)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[:, -1], expected.y[:, -1], rtol=0, atol=tolerance)
    if method != "ALI3P":
        stabilized = compiled.simulate((0.0, 1.0), x0, method=method, constraints="none", **TIGHT)
        np.testing.assert_allclose(stabilized.y[:, -1], expected.y[:, -1], rtol=0, atol=10 * tolerance)


def test_index_3_with_accelerations_in_state_equations_is_refused():
    with pytest.raises(fb.ModelError, match="formulation='index-3' accelerations and multipliers"):
        fb.compile_model(cartesian()).simulate((0.0, 1.0), method="IDA", formulation="index-3")


@pytest.mark.slow
def test_state_of_a_long_chain_has_rates_and_jacobian_of_the_chain():
    """Equations that are solved by their structure."""
    model = of_form("recursive in the plane")
    z, tau = me.dynamicsymbols("z"), sm.Symbol("tau")
    speeds = model.mechanism.speeds
    values = dict(model.parameter_symbols.items())
    fed = fb.Model(
        model.system, name="fed", parameters={**values, tau: 0.3}, state_equations={z: (speeds[-1].diff(T) - z) / tau}
    )
    compiled, plain = fb.compile_model(fed), fb.compile_model(model)
    x = np.random.default_rng(1).uniform(-1, 1, plain.n_x)
    rates = compiled.rhs(0.0, [*x, 0.7])
    np.testing.assert_allclose(rates[:-1], plain.rhs(0.0, x), rtol=1e-12, atol=1e-12)
    assert rates[-1] == pytest.approx((rates[-2] - 0.7) / 0.3, rel=1e-13)
    jacobian, known = compiled.jacobian(0.0, [*x, 0.7]), plain.jacobian(0.0, x)
    np.testing.assert_allclose(jacobian[-1, :-1], known[-1] / 0.3, rtol=1e-9, atol=1e-9)


def refused(match, system_change=lambda system, z: None, **more):
    system, _body, _, _, _speed = rotor()
    z = me.dynamicsymbols("z")
    system_change(system, z)
    with pytest.raises(fb.ModelError, match=match):
        fb.Model(system, **{"state_equations": {z: -z}, **more})


@pytest.mark.slow
def test_auxiliary_states_in_energies_constraints_or_unknown_names_are_refused():
    speed, z = me.dynamicsymbols("omega z")
    refused("z.* in the potential energy cannot be compiled", potential_energy=z**2)
    refused(
        "z.* in velocity constraint 1 cannot be compiled",
        lambda system, z: (
            system.add_nonholonomic_constraints(speed - z),
            setattr(system, "u_ind", []),
            setattr(system, "u_dep", [speed]),
        ),
    )
    refused("keys that are neither coordinates nor speeds, not omega", state_equations={speed: -speed})
    refused("has functions of t as keys", state_equations={sm.Symbol("z"): 1})
    refused("must be a mapping", state_equations=[z])
    refused("the state equation of z must be an expression", state_equations={z: "-z"})
    refused("the only derivatives allowed", state_equations={z: z.diff(T, 2)})
    refused("stand for more than one symbol: z", inputs={z: 0.0}, state_equations={z: -z})
    refused("y.* in the state equation of z: not among", state_equations={z: -me.dynamicsymbols("y")})


def test_run_from_an_auxiliary_state_without_a_value_is_refused():
    system, _, inertia, angle, speed = rotor()
    z = me.dynamicsymbols("z")
    compiled = fb.compile_model(
        fb.Model(system, parameters={inertia: 1.0}, state_equations={z: -z}, initial={angle: 0, speed: 0})
    )
    with pytest.raises(fb.ModelError, match="No value for auxiliary state z"):
        compiled.simulate((0.0, 1.0))
    run = compiled.simulate((0.0, 1.0), compiled.initial_state(auxiliary_states=[1.0]), **TIGHT)
    assert run["z"][-1] == pytest.approx(np.exp(-1.0), abs=1e-8)


def test_state_equation_with_undetermined_multipliers_is_refused():
    pendulum = fb.models.cartesian_pendulum()
    [circle] = pendulum.system.holonomic_constraints
    pendulum.system.add_holonomic_constraints(2 * circle)
    z, values = me.dynamicsymbols("z"), pendulum.parameter_symbols
    model = fb.Model(pendulum.system, parameters=values, state_equations={z: fb.multiplier(1)})
    with pytest.raises(fb.ModelError, match="multipliers, which redundant constraints leave undetermined"):
        fb.compile_model(model)


def test_command_line_takes_initial_values_of_auxiliary_states(tmp_path):
    """The motor by `fourbar simulate`, its current's initial value given, against the matrix exponential."""
    source = tmp_path / "motors.py"
    source.write_text("from builders.state_equations import motor\n")
    path = tmp_path / "run.csv"
    arguments = ["-i", "i=0.7", "-t", "0", "0.5", "--rtol", "1e-10", "--atol", "1e-12", "-o", str(path)]
    result = CliRunner().invoke(main, ["simulate", f"{source}:motor", *arguments])
    assert result.exit_code == 0, result.output
    with path.open() as file:
        *_, last = csv.DictReader(file)
    # x' = A x + B V with V = 1, as a linear system of x and 1.
    whole = expm(np.block([[MOTOR, VOLTAGE], [np.zeros((1, 4))]]) * 0.5) @ [0.3, 0.5, 0.7, 1.0]
    np.testing.assert_allclose([float(last[name]) for name in ("theta", "omega", "i")], whole[:3], atol=1e-9)
    assert re.search(r"  i +0\.7000000000 ", result.output)
    described = CliRunner().invoke(main, ["info", f"{source}:motor"])
    assert described.exit_code == 0
    assert re.search(r"auxiliary", described.output, re.IGNORECASE)
