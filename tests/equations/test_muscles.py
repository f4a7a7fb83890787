"""Muscles of sympy.physics.biomechanics, against SciPy on functions of lambdify."""

import importlib
import itertools

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from sympy.physics.biomechanics import (
    FirstOrderActivationDeGroote2016,
    MusculotendonDeGroote2016,
    MusculotendonFormulation,
)
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

EXPLICIT = (
    MusculotendonFormulation.RIGID_TENDON,
    MusculotendonFormulation.FIBER_LENGTH_EXPLICIT,
    MusculotendonFormulation.TENDON_FORCE_EXPLICIT,
)
START, ACTIVATION = 0.34, 0.4


class Lift:
    """A weight that hangs on a muscle, with a damper, and its equations as SymPy has them."""

    def __init__(self, formulation):
        q, u = me.dynamicsymbols("q u")
        m, g, d = sm.symbols("m g d")
        ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
        origin.set_vel(ground, 0)
        point.set_pos(origin, q * ground.x)
        point.set_vel(ground, u * ground.x)
        self.muscle = muscle = MusculotendonDeGroote2016.with_defaults(
            "biceps",
            me.LinearPathway(origin, point),
            FirstOrderActivationDeGroote2016.with_defaults("biceps"),
            musculotendon_dynamics=formulation,
        )
        self.system = System(ground, origin)
        self.system.add_coordinates(q)
        self.system.add_speeds(u)
        self.system.add_kdes(u - q.diff())
        self.system.add_bodies(me.Particle("weight", point, m))
        self.system.add_loads(me.Force(point, (m * g - d * u) * ground.x))
        self.system.add_actuators(muscle)
        lengths = {muscle.l_T_slack: 0.2, muscle.F_M_max: 1000.0, muscle.l_M_opt: 0.15}
        self.parameters = {m: 20.0, g: 9.81, d: 50.0, **lengths}
        self.kane = me.KanesMethod(
            ground, [q], [u], kd_eqs=[u - q.diff()], bodies=self.system.bodies,
            forcelist=[*self.system.loads, muscle],
        )  # fmt: skip
        loads = [*self.system.loads, *muscle.to_loads()]
        reference = me.KanesMethod(ground, [q], [u], kd_eqs=[u - q.diff()], bodies=self.system.bodies, forcelist=loads)
        reference.kanes_equations()
        rates = [u, *reference.mass_matrix.LUsolve(reference.forcing), *muscle.rhs().subs(q.diff(), u)]
        numbers = [rate.xreplace(self.parameters) for rate in rates]
        self._rates = sm.lambdify([[q, u, *muscle.x], muscle.e], numbers, cse=True)

    def rates(self, x, excitation):
        with np.errstate(all="ignore"):  # on the way to a start, and in stages that are refused
            return np.array(self._rates(x, excitation), dtype=float)

    def start(self):
        """A state in which the fibre is at rest."""
        if len(self.muscle.x) == 1:
            return np.array([START, 0.0, ACTIVATION])

        def rate(z):
            return self.rates([START, 0.0, z, ACTIVATION], ACTIVATION)[2]

        return np.array([START, 0.0, brentq(rate, *{"l": (0.8, 1.0), "F": (0.3, 0.4)}[str(self.muscle.x[0])[0]]), 0.4])


def excitation(t, x=None):
    return ACTIVATION + 0.3 * np.sin(6.0 * t)


@pytest.fixture(scope="module", params=EXPLICIT, ids=lambda formulation: formulation.name)
def lift(request):
    lift = Lift(request.param)
    return lift, fb.compile_model(fb.Model(lift.system, name="lift", parameters=lift.parameters))


@pytest.mark.slow
def test_system_with_a_muscle_has_its_states_and_sympys_rates(lift):
    lift, compiled = lift
    assert compiled.auxiliary_states == tuple(str(state.func) for state in lift.muscle.x)
    assert compiled.inputs == ("e_biceps",)
    assert compiled.kernel.default_inputs(0.3).tolist() == [0.0]
    x0 = lift.start()
    for x in (x0, x0 * 1.01, x0 * 0.99 + 1e-3):
        expected = lift.rates(x, 0.7)
        np.testing.assert_allclose(compiled.rhs(0.0, x, r=[0.7]), expected, rtol=1e-10, atol=1e-10)
    of_kane = fb.compile_model(fb.Model(lift.kane, name="lift_by_kane", parameters=lift.parameters))
    np.testing.assert_allclose(of_kane.rhs(0.0, x0, r=[0.7]), compiled.rhs(0.0, x0, r=[0.7]), rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "tolerance"), [("DOP853", 1e-10), ("Radau", 1e-10), ("IDA", 1e-7)])
def test_muscle_lifts_a_weight_as_scipy_on_lambdify_by_every_method(lift, method, tolerance):
    """To the tolerance of the reference, 1e-11; IDA's errors add up over some thousand steps of 1e-10."""
    lift, compiled = lift
    x0 = lift.start()
    how = {"rtol": 1e-11, "atol": 1e-12}
    expected = solve_ivp(lambda t, x: lift.rates(x, excitation(t)), (0.0, 0.3), x0, method="Radau", **how)
    assert expected.success
    run = compiled.simulate((0.0, 0.3), x0, inputs={"e_biceps": excitation}, method=method, rtol=1e-10, atol=1e-11)
    assert run.success, run.message
    np.testing.assert_allclose(run.y[:, -1], expected.y[:, -1], rtol=0, atol=tolerance)


@pytest.mark.slow
def test_muscle_with_a_step_of_excitation_moves_as_scipy_in_pieces():
    """Of a table, for several weights."""
    lift = Lift(MusculotendonFormulation.RIGID_TENDON)
    compiled = fb.compile_model(fb.Model(lift.system, name="lift", parameters=lift.parameters))
    x0, table = lift.start(), ([0.0, 0.1, 0.1 + 1e-9, 0.3], [0.4, 0.4, 0.8, 0.8])
    runs = compiled.ensemble(
        (0.0, 0.3), x0, parameters={"m": [20.0, 20.0, 25.0]}, inputs={"e_biceps": table}, rtol=1e-10, atol=1e-11
    )
    x = x0
    for begin, end, value in ((0.0, 0.1, 0.4), (0.1, 0.3, 0.8)):
        how = {"method": "Radau", "rtol": 1e-11, "atol": 1e-12}
        x = solve_ivp(lambda t, x, e=value: lift.rates(x, e), (begin, end), x, **how).y[:, -1]
    # The ramp of 1e-9 s changes the activation, of a rate of some 30/s, by 1e-8.
    np.testing.assert_allclose(runs.y[:2, :, -1], [x, x], rtol=0, atol=1e-7)
    assert abs(runs.y[2, 0, -1] - x[0]) > 1e-3


def test_activation_as_a_coordinate_gives_the_rates_of_a_state_equation():
    """The way of SymPy's tutorial: the state is a coordinate, with its equation among the kinematic ones."""
    lift = Lift(MusculotendonFormulation.RIGID_TENDON)
    muscle, system = lift.muscle, lift.system
    dummy = me.dynamicsymbols("v")
    system.add_coordinates(muscle.a)
    system.add_speeds(dummy)
    system.add_kdes(muscle.a.diff() - muscle.rhs()[0])
    idle = me.Particle("idle", me.Point("I"), 1)
    idle.masscenter.set_vel(system.frame, dummy * system.frame.x)
    system.add_bodies(idle)
    model = fb.compile_model(fb.Model(system, name="wrt_coordinates", parameters=lift.parameters))
    assert (model.coordinates, model.auxiliary_states, model.inputs) == (("q", "a_biceps"), (), ("e_biceps",))
    q, u, a = lift.start()
    rates = model.rhs(0.0, [q, a, u, 0.0], r=[0.7])
    np.testing.assert_allclose(rates[[0, 2, 1]], lift.rates([q, u, a], 0.7), rtol=1e-12)


@pytest.mark.slow
def test_arm_of_sympys_tutorial_has_the_printed_numbers_and_scipys_motion():
    """Its two runs, at its 301 times, by SciPy on SymPy's own KanesMethod and lambdify, as the page has it.

    The curves are pictures there; its numbers are in tests/published/test_sympy.py. The excitation of the second run
    jumps at 0.5 and 1.5 s, where SciPy begins anew.
    """
    model = importlib.import_module("10_muscles_of_an_arm").arm()
    compiled = fb.compile_model(model)
    x0 = compiled.initial_state()
    system = model.system
    loads = [*system.loads, *(load for actuator in system.actuators for load in actuator.to_loads())]
    kane = me.KanesMethod(
        system.frame, system.q_ind, system.u_ind, kd_eqs=system.kdes, q_dependent=system.q_dep,
        u_dependent=system.u_dep, configuration_constraints=system.holonomic_constraints,
        velocity_constraints=system.holonomic_constraints.diff(me.dynamicsymbols._t),
    )  # fmt: skip
    kane.kanes_equations(system.bodies, loads)
    activations = sm.Matrix([actuator.x[0] for actuator in system.actuators])
    rates = sm.Matrix([actuator.rhs()[0] for actuator in system.actuators])
    excitations = [actuator.e for actuator in system.actuators]
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    matrices = [matrix.xreplace(values) for matrix in (kane.mass_matrix, kane.forcing, rates)]
    evaluate = sm.lambdify((kane.q, kane.u, activations, excitations), matrices, cse=True)

    def equations(t, x, e):
        m, f, rate = evaluate(x[:4], x[4:8], x[8:], e)
        return np.concatenate((x[4:8], np.linalg.solve(m, f).ravel(), rate.ravel()))

    for pull in (0.0, 0.8):
        ends, x, states = (0.0, 0.5, 1.5, 3.0), x0, [x0[:, np.newaxis]]
        for begin, end in itertools.pairwise(ends):
            times = np.arange(round(100 * begin), round(100 * end) + 1) / 100
            e = [pull if begin == 0.5 else 0.0, 0.0]
            run = solve_ivp(
                equations, (begin, end), x, args=(e,), method="DOP853", t_eval=times, rtol=1e-10, atol=1e-12
            )
            x = run.y[:, -1]
            states.append(run.y[:, 1:])
        table = ([0.5 - 1e-12, 0.5, 1.5 - 1e-12, 1.5], [0.0, pull, pull, 0.0])
        ours = compiled.simulate(
            (0.0, 3.0), x0, inputs={"e_biceps": table}, t_eval=np.arange(301) / 100, rtol=1e-10, atol=1e-12
        )
        # SciPy's run drifts from the constraints by its tolerance, and the two from each other by some more.
        np.testing.assert_allclose(ours.y, np.hstack(states), rtol=0, atol=1e-8)


def test_rates_of_a_tendon_force_given_as_state_equations_equal_lambdify():
    """Of the tendon's force, for which SymPy holds the inverse of the tendon's curve to be no real number."""
    lift = Lift(MusculotendonFormulation.TENDON_FORCE_EXPLICIT)
    rates = dict(zip(lift.muscle.x, lift.muscle.rhs(), strict=True))
    given = fb.Model(lift.system, name="given", parameters=lift.parameters, state_equations=rates)
    x = lift.start() * 1.01
    np.testing.assert_allclose(fb.compile_model(given).rhs(0.0, x, r=[0.7]), lift.rates(x, 0.7), rtol=1e-10)


@pytest.mark.slow
def test_muscle_with_curve_constants_as_parameters_has_the_rates_of_numbers():
    """The published ones give the motion of SymPy's muscle with numbers, and the friction beside it is still found."""
    lift = Lift(MusculotendonFormulation.RIGID_TENDON)
    of_numbers = lift.muscle
    given = [of_numbers.l_T_slack, of_numbers.F_M_max, of_numbers.l_M_opt, of_numbers.v_M_max, of_numbers.alpha_opt]
    names = ["tendon_slack_length", "peak_isometric_force", "optimal_fiber_length", "maximal_fiber_velocity"]
    muscle = MusculotendonDeGroote2016(
        "biceps",
        of_numbers.pathway,
        of_numbers.activation_dynamics,
        **dict(zip([*names, "optimal_pennation_angle"], given, strict=True)),
        fiber_damping_coefficient=of_numbers.beta,
    )
    curves = ("_fl_M_pas", "_fl_M_act", "_fv_M")  # a rigid tendon has none
    of_symbols, published = (
        [c for curve in curves for c in getattr(of, curve).args[1:]] for of in (muscle, of_numbers)
    )
    system, friction = lift.system, sm.Symbol("mu")
    system.actuators = [muscle]
    rubbing = -friction * sm.sign(system.u[0]) * system.frame.x
    system.add_loads(me.Force(system.bodies[0].masscenter, rubbing))
    constants = dict(zip(of_symbols, published, strict=True))
    model = fb.compile_model(
        fb.Model(system, name="by_constants", parameters={**lift.parameters, **constants, friction: 2.0})
    )
    x = np.array([START, 0.01, ACTIVATION])
    expected = lift.rates(x, 0.7) - np.array([0.0, 2.0 / 20.0, 0.0])
    np.testing.assert_allclose(model.rhs(0.0, x, r=[0.7]), expected, rtol=1e-10)
    with pytest.warns(fb.ModelWarning, match=r"not known beforehand \(sign of u"):
        model.simulate((0.0, 0.01), x, sensitivities=["mu"])


def test_two_muscles_of_one_name_with_other_activations_are_refused():
    lift = Lift(MusculotendonFormulation.RIGID_TENDON)
    slow = FirstOrderActivationDeGroote2016("biceps", activation_time_constant=0.5)
    other = MusculotendonDeGroote2016.with_defaults("biceps", lift.muscle.pathway, slow)
    lift.system.add_actuators(other)
    with pytest.raises(fb.ModelError, match=r"Two actuators have different equations for the state a_biceps\(t\)"):
        fb.Model(lift.system, parameters=lift.parameters)
