"""Sensitivities of simulations: against closed forms, and differences of runs whose constraints are not projected.

Differences are of order 6. Their rounding errors are those of runs at 1e-13, divided by the change of the parameter:
about 1e-10 of the derivative, and more where it is small beside the state.
"""

import pickle
import warnings
from itertools import pairwise

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import of_form
from builders.oscillators import driven_oscillator, loaded, oscillator
from builders.prescribed import driven_pendulum, driven_slider_crank
from builders.systems import parallelogram
from scipy.integrate import quad
from scipy.interpolate import make_interp_spline
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import fourbar_codegen as fb
from fourbar_codegen.kernel.sensitivity import corrected, directions_of, implicit_derivatives

STEPS = {"closed_chain_8": 3e-4}
"""Of differences, relative, where the error of the order is larger than with the usual 1e-3."""

AT = (0.1, 0.3)
WEIGHTS = ((1, 45.0), (2, -9.0), (3, 1.0))


MODELS = {
    "four_bar": (fb.models.four_bar, {}, {}, ("k", "l2", "l3", "rho", "q1", "u1")),
    "slider_crank": (fb.models.slider_crank, {}, {}, ("r", "l", "m_crank")),
    "rolling disc": (fb.models.rolling_disc, {}, {}, ("r", "g")),
    "bicycle": (fb.models.whipple_bicycle, {"q4": 0.05}, {"u6": -6.0}, ("mc", "ic11", "u6", "q4")),
    "closed chain of 8": (lambda: fb.models.chain(8, closed=True), {}, {}, ("l", "g")),
    "redundant": (parallelogram, {"q_AB": 1.2}, {"u_AB": 2.0}, ("q_AB", "u_AB")),
    "recursive": (lambda: of_form("recursive"), dict.fromkeys(("q1", "q2", "q3", "q4", "q5"), 0.3),
                  dict.fromkeys(("u1", "u2", "u3", "u4", "u5"), 0.5), ("m", "l", "i_xy", "q3", "u2")),
    "sparse": (lambda: of_form("sparse"), {}, {}, ("l", "g")),
}  # fmt: skip


@pytest.fixture(scope="module", params=MODELS)
def case(request):
    make, coordinates, speeds, names = MODELS[request.param]
    return fb.compile_model(make()), coordinates, speeds, names


def start(model, coordinates, speeds, changes=()):
    changes = dict(changes)
    initial = model.manifest["initial"]
    n_qi, n_ui = model.n_q - model.manifest["n_dependent_coordinates"], model.n_u - model.manifest["n_dependent_speeds"]

    def given(names, own):
        return {n: changes.get(n, own.get(n, initial.get(n, 0.0))) for n in names}

    parameters = {n: changes.get(n, value) for n, value in model.defaults.items()}
    q, u = given(model.coordinates[:n_qi], coordinates), given(model.speeds[:n_ui], speeds)
    return {"coordinates": q, "speeds": u, "parameters": parameters}


def value_of(model, name, coordinates, speeds):
    known = {**model.manifest["initial"], **coordinates, **speeds, **model.defaults}
    return known.get(name, 0.0)


def differences(function, value, step):
    h = step * max(abs(value), 0.1)
    return sum(w * (function(value + k * h) - function(value - k * h)) for k, w in WEIGHTS) / (60.0 * h)


@pytest.mark.slow(but=["rolling disc", "slider_crank", "redundant", "four_bar"])
def test_sensitivities_of_runs_without_projection_equal_differences_of_runs(case):
    model, coordinates, speeds, names = case
    tight = {"t_eval": AT, "rtol": 1e-13, "atol": 1e-13, "constraints": "none"}
    given = start(model, coordinates, speeds)
    x0, by = model.initial_state(**given, derivatives=True)

    def run(name, value):
        changed = start(model, coordinates, speeds, {name: value})
        return model.simulate(
            (0.0, AT[-1]), model.initial_state(**changed), parameters=changed["parameters"], **tight
        ).y

    for name in names:
        value = value_of(model, name, coordinates, speeds)
        wanted = differences(lambda v, name=name: run(name, v), value, STEPS.get(model.name, 1e-3))
        # Dependent initial values implicit_derivatives as in the run that begins without x0.
        found = model.simulate((0.0, AT[-1]), x0, sensitivities=[name], dx0={name: by[name]}, **tight)
        size = np.abs(wanted).max()
        np.testing.assert_allclose(found.sensitivity[name], wanted, rtol=0, atol=1e-8 * size)


@pytest.mark.slow(but=["four_bar", "rolling disc", "slider_crank"])
def test_sensitivities_of_projected_runs_equal_differences_and_are_tangent(case):
    model, coordinates, speeds, names = case
    given = start(model, coordinates, speeds)
    x0, by = model.initial_state(**given, derivatives=True)
    dx0 = {name: by[name] for name in names}
    how = {"t_eval": AT, "rtol": 1e-10, "atol": 1e-10}
    run = model.simulate((0.0, AT[-1]), x0, sensitivities=names, dx0=dx0, **how)
    free = model.simulate((0.0, AT[-1]), x0, sensitivities=names, dx0=dx0, constraints="none", **how)

    def projected(name, value):
        changed = start(model, coordinates, speeds, {name: value})
        return model.simulate((0.0, AT[-1]), model.initial_state(**changed), parameters=changed["parameters"], **how).y

    for name in names:
        # Differences of runs at 1e-10, so that rounding of their steps shows as 1e-10 / 1e-3.
        value = value_of(model, name, coordinates, speeds)
        of_runs = differences(lambda v, name=name: projected(name, v), value, 1e-3)
        for wanted in (free.sensitivity[name], of_runs):
            np.testing.assert_allclose(run.sensitivity[name], wanted, rtol=0, atol=1e-6 * np.abs(wanted).max())
    for place, t in enumerate(AT):
        x = run.y[:, place]
        directions = np.zeros((model.n_x + model.n_p, len(names)))
        for k, name in enumerate(names):
            directions[: model.n_x, k] = run.sensitivity[name][:, place]
            if name in model.parameters:
                directions[model.n_x + model.parameters.index(name), k] = 1.0
        size = np.abs(directions).max(initial=1.0) * max(1.0, np.abs(x).max())
        for left in model.kernel.constraint_jvp(t, x, directions):
            assert np.abs(left).max(initial=0.0) <= 1e-11 * size


@pytest.mark.slow(but=["bicycle-0.0001", "bicycle-1e-08", "closed chain of 8-0.0001"])
@pytest.mark.parametrize("rtol", [1e-2, 1e-4, 1e-8])
def test_sensitivities_at_samples_at_every_tolerance_are_tangent_to_constraints(case, rtol):
    """Also where the projections' factors serve for derivatives, and where interpolants are too far away for that."""
    model, coordinates, speeds, names = case
    x0 = model.initial_state(**start(model, coordinates, speeds))
    how = {"t_eval": np.linspace(0.0, AT[-1], 51), "rtol": rtol, "atol": 1e-2 * rtol}
    run = model.simulate((0.0, AT[-1]), x0, sensitivities=names, **how)
    assert run.success
    directions = np.concatenate(
        (np.zeros((model.n_x, len(names))), directions_of(model.kernel, names).matrix[model.n_x :])
    )
    for place, t in enumerate(run.t):
        directions[: model.n_x] = np.array([run.sensitivity[name][:, place] for name in names]).T
        size = np.abs(directions).max(initial=1.0) * max(1.0, np.abs(run.y[:, place]).max())
        for left in model.kernel.constraint_jvp(t, run.y[:, place], directions):
            assert np.abs(left).max(initial=0.0) <= 1e-11 * size


def test_initial_states_of_changed_values_corrected_from_predictions_are_closed(case):
    """The states are those of `initial_state`, which finds them by other methods.

    Its derivatives, by which they are predicted, are compared with differences above.
    """
    model, coordinates, speeds, names = case
    given = start(model, coordinates, speeds)
    directions, p = directions_of(model.kernel, names), model.kernel.parameter_vector(given["parameters"])
    x0 = model.initial_state(**given)
    matrix = implicit_derivatives(model.kernel, 0.0, x0, directions, p, None)
    n_qi = model.n_q - model.manifest["n_dependent_coordinates"]
    for k, name in enumerate(names):
        change = 1e-2 * (value_of(model, name, coordinates, speeds) or 1.0)
        changed = start(model, coordinates, speeds, {name: value_of(model, name, coordinates, speeds) + change})
        predicted = np.concatenate((x0, p)) + matrix[:, k] * change
        x, p_there = predicted[: model.n_x], predicted[model.n_x :]
        wanted, by = model.initial_state(**changed, guess=x[n_qi : model.n_q], derivatives=True)
        found, followed = corrected(model.kernel, 0.0, x, directions, p_there, None)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())
        expected = np.array([by[own] for own in names]).T
        # The matrices are those before the last step, of up to 1e-10.
        size = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(followed[: model.n_x], expected, rtol=0, atol=1e-9 * size)


def test_states_of_changed_values_near_singular_positions_are_not_predicted(four_bar):
    """Where coupler and rocker cover each other, the crank can go no further, and their motion does not
    implicit_derivatives."""
    p = four_bar.kernel.parameter_vector({"l4": 0.6})
    ground, crank, coupler, rocker = (dict(zip(four_bar.parameters, p, strict=True))[f"l{i}"] for i in (1, 2, 3, 4))
    limit = np.pi - np.arccos((ground**2 + crank**2 - (coupler - rocker) ** 2) / (2.0 * ground * crank))
    for before, is_regular in ((1e-8, False), (0.1, True)):
        for x in four_bar.initial_states({"q1": limit - before}, parameters=p).x:
            found = corrected(four_bar.kernel, 0.0, x, directions_of(four_bar.kernel, ["l2"]), p, None)
            assert (found is not None) is is_regular


AT_REST = {
    "bicycle straight ahead": (fb.models.whipple_bicycle, {}, "u7"),
    "chain hanging": (lambda: fb.models.chain(3), {"q1": -np.pi / 2, "q2": 0.0, "q3": 0.0}, "u1"),
}


@pytest.mark.slow(but=["chain hanging-DOP853-1e-09", "chain hanging-RK45-1e-06", "bicycle straight ahead-RK45-1e-06"])
@pytest.mark.parametrize(("method", "rtol"), [("DOP853", 1e-6), ("DOP853", 1e-9), ("RK45", 1e-6)])
@pytest.mark.parametrize("motion", AT_REST)
def test_sensitivities_of_steady_motions_limit_the_steps_and_equal_closed_forms(motion, method, rtol):
    """Where x' does not change, neither does f_x, and S = exp(f_x t) S0; errors of x do not limit the steps there.

    Ten steps whose errors may be ten times rtol.
    """
    make, coordinates, name = AT_REST[motion]
    model, t = fb.compile_model(make()), np.array([0.0, 1.0, 2.0])
    x0, by = model.initial_state(coordinates, derivatives=True)
    wanted = np.transpose([expm(model.jacobian(0.0, x0) * time) @ by[name] for time in t])
    how = {"t_eval": t, "method": method, "rtol": rtol, "atol": 1e-3 * rtol}
    run = model.simulate((0.0, 2.0), x0, sensitivities=[name], dx0={name: by[name]}, **how)
    np.testing.assert_allclose(run.sensitivity[name], wanted, rtol=0, atol=100.0 * rtol)
    np.testing.assert_allclose(run.y[model.n_q :] - x0[model.n_q :, np.newaxis], 0.0, rtol=0, atol=1e-12)
    for others in ((), ("g",)):  # on which such motions do not depend
        run, found = model.simulate((0.0, 2.0), x0, sensitivities=others, gradient=True, **how), np.zeros_like(wanted)
        for place in np.ndindex(wanted.shape):
            cost = np.zeros_like(wanted)
            cost[place] = 1.0
            found[place] = run.gradient(cost)[name]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=100.0 * rtol)


@pytest.mark.parametrize("n", [1, 2, 4, 5, 8])
def test_sensitivities_in_few_directions_equal_those_in_many(four_bar, n):
    """Blocks are four or eight directions wide; the last of several is filled with zeros.

    The step is so short that no derivative shortens it.
    """
    names = (*four_bar.parameters, "q1", "u1")
    how = {"t_eval": AT, "rtol": 1e-8, "atol": 1e-10, "max_step": 0.02}
    many = four_bar.simulate((0.0, AT[-1]), sensitivities=names, **how)
    few = four_bar.simulate((0.0, AT[-1]), sensitivities=names[-n:], **how)
    for name in names[-n:]:
        # The same operations, in registers of other widths.
        np.testing.assert_allclose(few.sensitivity[name], many.sensitivity[name], rtol=1e-12, atol=1e-12)


def test_gradients_of_random_costs_equal_those_by_forward_sensitivities(case):
    model, coordinates, speeds, names = case
    given = start(model, coordinates, speeds)
    x0 = model.initial_state(**given)
    generator = np.random.default_rng(0)
    for method, constraints in (("DOP853", "project"), ("RK45", "project"), ("DOP853", "none")):
        how = {"method": method, "constraints": constraints, "rtol": 1e-8, "atol": 1e-8, "gradient": True}
        for t_eval in (np.linspace(0.0, AT[-1], 7), None):  # on the interpolant, and after each step
            run = model.simulate((0.0, AT[-1]), x0, sensitivities=names, t_eval=t_eval, **how)
            cost = generator.normal(size=run.y.shape)
            wanted = {name: (cost * run.sensitivity[name]).sum() for name in names}
            gradient = run.gradient(cost)
            locked = model.parameters if model.name == "parallelogram" else ()  # by redundant constraints
            assert {*names, *model.parameters} - {*locked} <= set(gradient)
            size = max(map(abs, wanted.values()))
            assert [gradient[n] for n in names] == pytest.approx([wanted[n] for n in names], rel=0, abs=1e-11 * size)


def test_gradients_of_joint_forces_equal_the_chain_rule_and_forward_mode():
    """Of joint forces, by all parameters, initial values and inputs, against the chain rule and forward mode."""
    model = fb.compile_model(fb.models.slider_crank())
    crank, rate = model.coordinates[0], model.speeds[0]
    inputs = {"torque": 2.0, "load": ([0.0, 0.2, 1.0], [1.0, -3.0, 2.0])}
    names, parameters = (*model.parameters, crank, rate, *inputs), (*model.parameters, crank, rate)
    how = {"t_eval": np.linspace(0.0, 0.5, 11), "rtol": 1e-10, "atol": 1e-10, "inputs": inputs}
    run = model.simulate((0.0, 0.5), sensitivities=names, gradient=True, **how)
    generator = np.random.default_rng(0)
    cost = {name: generator.normal(size=11) for name in (*model.outputs, model.states[1])}
    gradient, of_outputs = run.gradient(cost), run.output_sensitivity
    for name in names:
        wanted = (cost[model.states[1]] * run.sensitivity[name][..., 1, :]).sum(axis=-1)
        for row, output in enumerate(model.outputs):
            wanted = wanted + (cost[output] * of_outputs[name][..., row, :]).sum(axis=-1)
        np.testing.assert_allclose(gradient[name], wanted, rtol=0, atol=1e-11 * max(1.0, np.abs(wanted).max()))
    for place, (t, x, r) in enumerate(zip(run.t, run.y.T, run.r.T, strict=True)):
        wrt_state, wrt_parameters = model.output_jacobian(t, x, r=r), model.output_parameter_jacobian(t, x, r=r)
        for name in parameters:
            wanted = wrt_state @ run.sensitivity[name][:, place]
            if name in model.parameters:
                wanted = wanted + wrt_parameters[:, model.parameters.index(name)]
            np.testing.assert_allclose(of_outputs[name][:, place], wanted, rtol=1e-9, atol=1e-9)


def test_gradients_by_numbers_and_tables_of_a_force_equal_closed_forms():
    """Of a mass on a spring that a force drives: x(T) is the integral of h(T - s) F(s), h = sin(w t) / (m w)."""
    model = fb.compile_model(driven_oscillator())
    times, end, (m, k) = np.linspace(0.0, 3.0, 16), 2.9, (2.0, 8.0)
    w = np.sqrt(k / m)
    values = np.cos(1.7 * times)
    how = {"t_eval": [end], "rtol": 1e-11, "atol": 1e-11, "gradient": True, "sensitivities": ["F"]}
    run = model.simulate((0.0, end), inputs={"F": 2.0}, **how)
    for found in (run.gradient({"x": [1.0]})["F"], run.sensitivity["F"][0, 0]):
        assert found == pytest.approx((1.0 - np.cos(w * end)) / k, rel=1e-9)
    for kind, degree in (("linear", 1), ("cubic", 3)):
        basis = make_interp_spline(times, np.eye(16), k=degree)
        run = model.simulate((0.0, end), inputs={"F": (times, values, kind)}, **how)
        by_values = run.gradient({"x": [1.0]})["F"]
        assert run.sensitivity["F"].shape == (16, 2, 1)
        np.testing.assert_allclose(run.sensitivity["F"][:, 0, 0], by_values, rtol=0, atol=1e-11)
        wanted = [
            sum(
                quad(
                    lambda s, j=j, basis=basis: np.sin(w * (end - s)) / (m * w) * basis(s)[j],
                    a,
                    min(b, end),
                    epsabs=1e-13,
                )[0]
                for a, b in pairwise(times)
            )
            for j in range(16)
        ]
        np.testing.assert_allclose(by_values, wanted, rtol=0, atol=1e-9)


def test_sensitivities_of_an_oscillator_equal_closed_forms():
    # x = a cos(w t): dx/dk = -a t sin(w t) / (2 m w), dx/dm = a w t sin(w t) / (2 m), dx/da = cos(w t).
    model = fb.compile_model(oscillator())
    times = np.linspace(0.0, 5.0, 11)
    m, k, a = 2.0, 8.0, 0.3
    w = np.sqrt(k / m)
    wanted = {
        "k": -a * times * np.sin(w * times) / (2.0 * m * w),
        "m": a * w * times * np.sin(w * times) / (2.0 * m),
        "x": np.cos(w * times),
        "v": np.sin(w * times) / w,
    }
    for method in ("DOP853", "RK45", "Tsit5"):
        run = model.simulate((0.0, 5.0), method=method, t_eval=times, rtol=1e-11, atol=1e-11, sensitivities=[*wanted])
        for name, values in wanted.items():
            np.testing.assert_allclose(run.sensitivity[name][0], values, rtol=0, atol=1e-9)


def test_sensitivities_beside_many_others_after_each_step_equal_those_alone(four_bar):
    names = [*four_bar.parameters, "q1", "u1"]
    how = {"rtol": 1e-8, "atol": 1e-8, "max_step": 0.01}  # so short that no derivative shortens it
    run = four_bar.simulate((0.0, 1.0), sensitivities=names, **how)
    assert all(run.sensitivity[name].shape == run.y.shape for name in names)
    one = four_bar.simulate((0.0, 1.0), sensitivities="u1", **how)
    np.testing.assert_array_equal(one.y, run.y)
    np.testing.assert_allclose(one.sensitivity["u1"], run.sensitivity["u1"], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(four_bar.simulate((0.0, 1.0), **how).y, run.y)


def test_sensitivities_of_dependent_initial_values_follow_unless_x0_is_given(four_bar):
    x0, by = four_bar.initial_state(derivatives=True)
    run = four_bar.simulate((0.0, 0.1), t_eval=[0.0], sensitivities=["l2", "q1", "k"])
    for name in ("l2", "q1", "k"):
        np.testing.assert_allclose(run.sensitivity[name][:, 0], by[name], rtol=0, atol=1e-13)
    assert by["l2"][1] == pytest.approx(-0.826035, abs=1e-6)
    held = four_bar.simulate((0.0, 0.1), x0, t_eval=[0.0], sensitivities=["k"])
    np.testing.assert_array_equal(held.sensitivity["k"][:, 0], 0.0)


@pytest.mark.slow(but=["t_eval1"])
@pytest.mark.parametrize("t_eval", [None, [0.5, 1.0, 2.4]])
def test_sensitivities_of_an_oscillators_events_equal_closed_forms(t_eval):
    """An oscillator passes x = 0.1 at cos(w t) = 0.1 / a, where x depends on nothing, and v^2 = w^2 (a^2 - 0.01)."""
    model = oscillator()
    (x,), (v,) = model.system.q, model.system.u
    level = fb.Model(
        model.system, name="level", parameters={"m": 2.0, "k": 8.0}, initial={"x": 0.3, "v": 0.0},
        outputs={"above": x - sm.Rational(1, 10), "speed": v},
    )  # fmt: skip
    names = ["k", "m", "x"]
    run = fb.compile_model(level).simulate(
        (0.0, 3.0), events=[fb.Event("above", terminal=2), "speed"], sensitivities=names, t_eval=t_eval, rtol=1e-11,
        atol=1e-12,
    )  # fmt: skip
    times, (found, at_rest) = run.t_events[0], run.event_sensitivity
    w, a, m, speed = 2.0, 0.3, 2.0, 2.0 * np.sqrt(0.09 - 0.01)
    np.testing.assert_allclose(found["k"].t, -times / (2.0 * m * w**2), rtol=1e-8)
    np.testing.assert_allclose(found["m"].t, times / (2.0 * m), rtol=1e-8)
    np.testing.assert_allclose(found["x"].t[0], 0.1 / (a**2 * w * np.sqrt(1.0 - 1.0 / 9.0)), rtol=1e-8)
    signs = np.array([-1.0, 1.0])
    for name, wanted in (("k", speed / (2.0 * m * w**2)), ("x", w**2 * a / speed)):
        np.testing.assert_allclose(found[name].y, [[0.0, 0.0], signs * wanted], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(at_rest["x"].y[:, -1], [-1.0, 0.0], atol=1e-8)


@pytest.mark.slow(but=["1000000.0", "4.0"])
@pytest.mark.parametrize("t_0", [-3.0, 4.0, 1e6])
def test_sensitivities_of_an_event_in_a_driven_run_at_any_start_equal_closed_forms(t_0):
    """By Duhamel's integral, x = c at S_x + v dt/dF_0 = 0, where v changes by S_v + v' dt/dF_0, m v' = F - k x.

    Up to the spacing of times, and the root of an interpolant.
    """
    t, (x, *_) = me.dynamicsymbols._t, me.dynamicsymbols("x v")
    force = sm.Symbol("F_0") * sm.sin(3 * t)
    model = fb.compile_model(driven_oscillator(parameters={"F_0": 3.0}, force=force, outputs={"above": x - 0.2}))
    w, m, k, f_0, level = 2.0, 2.0, 8.0, 3.0, 0.2

    def of_force(until, response):
        return quad(lambda s: response(w * (until - s)) * np.sin(3.0 * (t_0 + s)) / m, 0.0, until, epsabs=1e-13)[0]

    def by_force(until):  # S_x, S_v
        return of_force(until, lambda angle: np.sin(angle) / w), of_force(until, np.cos)

    at_rest, once = [0.0, 0.0], fb.Event("above", terminal=True)
    run = model.simulate((t_0, t_0 + 3.0), at_rest, events=once, sensitivities=["F_0"], rtol=1e-11, atol=1e-12)
    near = run.t_events[0][0] - t_0
    until = brentq(lambda s: f_0 * by_force(s)[0] - level, near - 0.01, near + 0.01)
    s_x, s_v = by_force(until)
    found = run.event_sensitivity[0]["F_0"]
    assert found.t == pytest.approx(-s_x / (f_0 * s_v), rel=1e-7)
    rate = (f_0 * np.sin(3.0 * (t_0 + until)) - k * level) / m
    np.testing.assert_allclose(found.y[:, 0], [0.0, s_v - rate * s_x / (f_0 * s_v)], rtol=1e-7, atol=1e-7)


@pytest.mark.slow(but=["0.0-cubic", "0.001-cubic", "0.001-linear", "0.01-cubic"])
@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("before", [0.0, 1e-12, 1e-6, 1e-3, 1e-2])
def test_sensitivities_of_events_at_or_near_points_of_a_table_equal_closed_forms(kind, before):
    """F rises in a straight line, and is 2 at a point or shortly before it: dt/dF_i is minus the weight over the slope.

    Linear weights are those of the two values beside; those of a cubic interpolant have the same sum.
    """
    model = fb.compile_model(driven_oscillator(outputs={"load": me.dynamicsymbols("F") - 2}))
    at, slope = np.array([0.0, 0.5, 0.75, 1.5, 2.0]), 8.0 / 3.0
    inputs = {"F": (at, 2.0 + slope * (at - 0.75 + before), kind)}
    run = model.simulate((0.0, 2.0), [0.1, 0.0], events=["load"], inputs=inputs, sensitivities=["F"])
    [time] = run.t_events[0]
    assert time == pytest.approx(0.75 - before, abs=1e-14)
    [by_values] = run.event_sensitivity[0]["F"].t.T
    assert by_values.sum() == pytest.approx(-1.0 / slope, rel=1e-8)  # of a difference over hundredths of a step
    if kind == "linear":
        share = 1.0 - before / 0.25
        np.testing.assert_allclose(by_values, -np.array([0.0, 1.0 - share, share, 0.0, 0.0]) / slope, atol=1e-8)


@pytest.mark.slow
def test_event_at_a_triple_root_has_a_time_and_no_sensitivity():
    """A triple root, at t = 1 for a speed of 0.2: the time is found, and has no derivative."""
    outputs = {"cube": (me.dynamicsymbols("x") - sm.Rational(1, 5)) ** 3}
    parameters = {"m": 2.0, "k": 0.0}
    model = fb.compile_model(fb.Model(oscillator().system, name="free", parameters=parameters, outputs=outputs))
    run = model.simulate((0.0, 2.0), [0.0, 0.2], events=["cube"], sensitivities=["v"])
    assert run.t_events[0] == pytest.approx([1.0], abs=1e-5)  # the cube is below 1e-16 there
    assert np.isnan(run.event_sensitivity[0]["v"].t).all()


def test_sensitivities_of_events_in_a_closed_loop_equal_differences(four_bar):
    """Against differences of order 6 of the times of runs at 1e-13: rounding errors divided by the change."""
    compiled = fb.compile_model(fb.models.slider_crank())
    how = {"events": ["pin_x"], "rtol": 1e-13, "atol": 1e-13}

    def times(length):
        x0 = compiled.initial_state(speeds={"crank_rate": 10.0}, parameters={"l": length})
        return compiled.simulate((0.0, 0.5), x0, parameters={"l": length}, **how).t_events[0][:3]

    x0, dx0 = compiled.initial_state(speeds={"crank_rate": 10.0}, derivatives=True)
    run = compiled.simulate((0.0, 0.5), x0, sensitivities=["l"], dx0={"l": dx0["l"]}, **how)
    wanted = differences(times, compiled.defaults["l"], 1e-3)
    np.testing.assert_allclose(run.event_sensitivity[0]["l"].t[:3], wanted, rtol=1e-6)
    with pytest.raises(fb.ModelError, match="have derivatives if these are of states or outputs"):
        four_bar.simulate((0.0, 1.0), events=lambda t, x: x[0], sensitivities=["k"])


@pytest.mark.parametrize("values", [[0.0, 1.0, 1.5, 1.4, 2.0, 2.6], [0.0, 0.1, 2.0, 2.0, -1.0, 3.0], [0.5, 2.0]])
def test_sensitivities_by_values_of_a_pchip_table_equal_differences(values):
    """Between extrema, where an interpolant has slopes by the harmonic mean; its kinks are at equal values."""
    model, at = fb.compile_model(driven_oscillator()), np.linspace(0.0, 3.0, len(values))
    times = np.array([1.0, 2.9, 3.4])
    how = {"t_eval": times, "rtol": 1e-12, "atol": 1e-12}
    run = model.simulate((0.0, 3.4), inputs={"F": (at, values, "pchip")}, sensitivities="F", gradient=True, **how)
    for place in (i for i in range(len(values)) if values.count(values[i]) == 1):

        def of(value, place=place):
            changed = np.array(values)
            changed[place] = value
            return model.simulate((0.0, 3.4), inputs={"F": (at, changed, "pchip")}, **how).y

        if 2.0 in (values[place - 1 : place] + values[place + 1 : place + 2]) and values.count(2.0) > 1:
            continue  # it has a neighbour at a kink
        wanted = differences(of, values[place], 1e-3)
        np.testing.assert_allclose(run.sensitivity["F"][place], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    cost = np.array([[1.0, -2.0, 0.5], [0.3, 1.0, 2.0]])
    forward = (run.sensitivity["F"] * cost).sum(axis=(1, 2))
    np.testing.assert_allclose(run.gradient(cost)["F"], forward, rtol=0, atol=1e-11 * np.abs(forward).max())


DRIVEN = {
    "pendulum": (lambda: driven_pendulum(None), {"coordinates": {"q": 0.4}, "speeds": {"u": -0.7}}),
    "slider-crank": (lambda: driven_slider_crank(None), {"guess": [0.5, -0.4]}),
}
KINDS = {"cubic": 1e-8, "pchip": 1e-8, "linear": 1e-7}
"""Of tables, and tolerances: with linear ones, runs end a step at each of the jumps of the speeds."""


@pytest.mark.slow(but=["pendulum-linear", "pendulum-pchip"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", DRIVEN)
def test_sensitivities_by_values_of_a_prescribed_motion_equal_differences(name, kind):
    """The initial state follows the motion, and speeds jump with its rate where it is linear."""
    make, more = DRIVEN[name]
    model = fb.compile_model(make())
    at = np.array([0.0, 0.11, 0.3, 0.42, 0.6])
    values = 0.3 + 0.1 * np.array([0.0, 0.2, 0.5, 0.55, 0.9])
    times = [0.05, 0.2, 0.3, 0.5]
    how = {"t_eval": times, "rtol": 1e-12, "atol": 1e-12}
    names = ["s", *model.parameters]

    def run(changed, parameters=None, **extra):
        inputs = {"s": (at, changed, kind)}
        x0, dx0 = model.initial_state(inputs=inputs, parameters=parameters, derivatives=True, **more)
        if extra:
            extra["dx0"] = {key: dx0[key] for key in names}
        return model.simulate((0.0, 0.5), x0, inputs=inputs, parameters=parameters, **how, **extra)

    found = run(values, sensitivities=names, gradient=True)
    assert found.sensitivity["s"].shape == (5, model.n_x, 4)
    for place in range(5):

        def of(value, place=place):
            return run(np.where(np.arange(5) == place, value, values)).y

        wanted = differences(of, values[place], 1e-3)
        size = np.abs(wanted).max()
        np.testing.assert_allclose(found.sensitivity["s"][place], wanted, rtol=0, atol=KINDS[kind] * size)
    for key in model.parameters:
        wanted = differences(lambda v, key=key: run(values, {key: v}).y, model.defaults[key], 1e-3)
        size = max(np.abs(wanted).max(), 1e-3)
        np.testing.assert_allclose(found.sensitivity[key], wanted, rtol=0, atol=KINDS[kind] * size)
    cost = np.random.default_rng(0).normal(size=found.y.shape)
    gradient = found.gradient(cost)
    for key in names:
        forward = (found.sensitivity[key] * cost).sum(axis=(-2, -1))
        size = np.abs([(part * cost).sum(axis=(-2, -1)).max() for part in found.sensitivity.values()]).max()
        np.testing.assert_allclose(gradient[key], forward, rtol=0, atol=1e-10 * size)


@pytest.mark.slow
def test_sensitivities_by_a_parameter_of_a_prescribed_motion_equal_closed_forms():
    """Its rate w moves the initial state of a driven crank; the crank's angle is w t + w / 10."""
    w = sm.Symbol("w")
    model = fb.compile_model(driven_slider_crank(w * (me.dynamicsymbols._t + sm.Rational(1, 10))))
    parameters = {"w": 4.0}
    x0, by = model.initial_state(parameters=parameters, guess=[0.4, 0.9], derivatives=True)
    angle, rod = 0.4, np.sqrt(0.49 - 0.04 * np.sin(0.4) ** 2)
    slope = -0.2 * np.sin(angle) - 0.04 * np.sin(angle) * np.cos(angle) / rod  # of the slider's place by the angle
    np.testing.assert_allclose(by["w"][:3], [0.1, 0.1 * slope, 1.0], rtol=1e-12)
    run = model.simulate(
        (0.0, 1.0), x0, parameters=parameters, sensitivities="w", dx0={"w": by["w"]}, t_eval=[0.5, 1.0], gradient=True
    )
    np.testing.assert_allclose(run.sensitivity["w"][:1], [run.t + 0.1], rtol=1e-9)
    assert run.gradient({"x": 1.0})["w"] == pytest.approx(run.sensitivity["w"][1].sum(), rel=1e-9)


@pytest.mark.parametrize("forwards", [True, False])
@pytest.mark.parametrize("kind", ["linear", "cubic"])
def test_sensitivities_at_jumps_of_a_resting_motion_equal_differences(kind, forwards):
    """Where a pivot rests, its rate does not jump, but the derivatives of its rate do: also at samples there."""
    model, at = fb.compile_model(driven_pendulum(None)), np.array([0.0, 1.0, 2.0])
    span = (-0.5, 2.5) if forwards else (2.5, -0.5)
    how = {"t_eval": np.unique([*span, *at])[:: 1 if forwards else -1], "rtol": 1e-12, "atol": 1e-12}

    def run(values, **more):
        return model.simulate(span, [0.1, 0.0], inputs={"s": (at, values, kind)}, **how, **more)

    found = run(np.zeros(3), sensitivities=["s"], gradient=True)
    for place, unit in enumerate(np.eye(3)):
        wanted = differences(lambda value, unit=unit: run(value * unit).y, 0.0, 1e-3)
        np.testing.assert_allclose(found.sensitivity["s"][place], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    for i, name in enumerate(model.states):
        wanted = found.sensitivity["s"][:, i].sum(axis=1)
        np.testing.assert_allclose(found.gradient({name: 1.0})["s"], wanted, rtol=1e-10)


@pytest.mark.parametrize("size", [0.0, 0.1])
def test_sensitivities_of_runs_that_end_where_a_rate_jumps_equal_differences(size):
    """The last sample is the state after the jump, and so are its derivatives, also of a pivot that rests."""
    model, at = fb.compile_model(driven_pendulum(None)), np.array([0.0, 1.0, 2.0, 3.0])
    values = size * np.array([0.0, 1.0, 0.0, 2.0])

    def run(values, **more):
        how = {"t_eval": [1.5, 2.0], "rtol": 1e-12, "atol": 1e-12, "inputs": {"s": (at, values)}}
        return model.simulate((0.0, 2.0), [0.1, 0.0], **how, **more)

    found = run(values, sensitivities=["s"], gradient=True)
    for place, unit in enumerate(np.eye(4)):
        wanted = differences(lambda value, unit=unit: run(values + value * unit).y, 0.0, 1e-3)
        np.testing.assert_allclose(found.sensitivity["s"][place], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    np.testing.assert_allclose(found.gradient({"u": [0.0, 1.0]})["s"], found.sensitivity["s"][:, 1, 1], rtol=1e-10)


@pytest.mark.slow(but=["False"])
@pytest.mark.parametrize("forwards", [True, False])
def test_sensitivities_of_outputs_where_a_force_jumps_are_those_after_the_jump(forwards):
    """A sample there has the force after the jump in time: d(force)/dA = 1 before 1 s, and 2 from then on."""
    t, a, force, x = me.dynamicsymbols._t, sm.Symbol("A"), *me.dynamicsymbols("F x")
    steps, outputs = a * sm.Piecewise((1, t < 1), (2, True)), {"load": force, "both": force - 8 * x}
    model = fb.compile_model(driven_oscillator(parameters={"A": 1.0}, force=steps, outputs=outputs))
    times = np.array([0.0, 0.5, 1.0, 1.5])[:: 1 if forwards else -1]
    run = model.simulate(times[[0, -1]], [0.1, 0.0], t_eval=times, sensitivities=["A"], gradient=True)
    for unit, load in zip(np.eye(4), np.where(times < 1.0, 1.0, 2.0), strict=True):
        assert run.gradient({"load": unit})["A"] == pytest.approx(load)
        wanted = (run.output_sensitivity["A"][1] * unit).sum()
        assert run.gradient({"both": unit})["A"] == pytest.approx(wanted, rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 0.0])
def test_sensitivities_at_a_jump_by_an_expression_equal_closed_forms_or_are_refused(rate):
    """Where the rate of a pivot's motion jumps from 0 to a, the speed jumps by -a cos(q) / l, which by a is known."""
    t, a = me.dynamicsymbols._t, sm.Symbol("a")
    motion = a * sm.Piecewise((0, t < sm.Rational(1, 2)), (t - sm.Rational(1, 2), True))
    given = {"sensitivities": ["a"], "t_eval": [0.5 + 1e-12], "rtol": 1e-12, "atol": 1e-12, "parameters": {"a": rate}}
    system, s = driven_pendulum(None).system, me.dynamicsymbols("s")
    values = {"m": 2.0, "l": 0.5, "g": 9.81, "a": 0.1}
    wrt_input = fb.compile_model(fb.Model(system, name="moved", parameters=values, inputs={s: motion}))
    run = wrt_input.simulate((0.0, 1.0), [0.4, 0.0], gradient=True, **given)
    assert run.success
    assert run.sensitivity["a"][1, 0] == pytest.approx(-np.cos(run["q"][0]) / 0.5, rel=1e-10)
    assert run.gradient({"u": 1.0})["a"] == pytest.approx(run.sensitivity["a"][1, 0], rel=1e-11)
    of_time = fb.compile_model(fb.Model(driven_pendulum(None, s=motion).system, name="of_time", parameters=values))
    failed = of_time.simulate((0.0, 1.0), [0.4, 0.0], **given | {"parameters": {"a": 0.1}})
    assert not failed.success
    refused = "by an expression of time in the model, which has no derivatives: prescribe the motion"
    assert refused in failed.message
    failed = of_time.simulate((0.0, 1.0), [0.4, 0.0], **given | {"parameters": {"a": 0.0}})
    assert not failed.success
    assert f"With another value of a the speeds would jump {refused}" in failed.message
    others = {**given, "parameters": {"a": 0.0}, "sensitivities": ["l"], "gradient": True}
    run = of_time.simulate((0.0, 1.0), [0.4, 0.0], **others)
    assert set(run.gradient({"u": 1.0})) == {"q", "u", "m", "l", "g"}
    assert run.gradient({"u": 1.0})["l"] == pytest.approx(run.sensitivity["l"][1, 0], rel=1e-11)


def test_gradients_with_a_sample_within_rounding_of_a_jump_count_all_samples():
    """A sample within rounding errors of a jump does not hide the others before it."""
    model, at = fb.compile_model(driven_pendulum(None)), 0.3
    inputs = {"s": ([0.0, at, 1.0], [0.0, 0.1, 0.1], "linear")}
    for near in (np.nextafter(at, 0.0), at, np.nextafter(at, 1.0)):
        run = model.simulate(
            (0.0, 0.5), [0.4, 0.0], inputs=inputs, t_eval=[0.1, 0.2, near, 0.4], sensitivities=["l", "s"], gradient=True
        )
        gradient = run.gradient({"q": 1.0})
        assert gradient["l"] == pytest.approx(run.sensitivity["l"][0].sum(), rel=1e-11)
        np.testing.assert_allclose(gradient["s"], run.sensitivity["s"][:, 0].sum(axis=1), rtol=1e-11)


def test_sensitivities_of_dense_output_equal_those_at_samples_and_of_another_run(four_bar):
    """The interpolant's derivatives: at the samples those of the samples, between them those of another run."""
    table = {"F": (np.linspace(0.0, 1.0, 5), np.arange(5.0))}
    how = {"inputs": table, "sensitivities": ["k", "l2", "F", "q1"], "rtol": 1e-9, "atol": 1e-9}
    times = np.linspace(0.0, 1.0, 23)
    for method in ("DOP853", "RK45", "Tsit5"):
        run = four_bar.simulate((0.0, 1.0), dense_output=True, method=method, **how)
        other = four_bar.simulate((0.0, 1.0), t_eval=times, method=method, **how)
        at_samples, between, coarse = run.sol.sensitivity(run.t), run.sol.sensitivity(times), run.resample(times)
        for name, values in other.sensitivity.items():
            size = np.abs(values).max()
            np.testing.assert_allclose(at_samples[name], run.sensitivity[name], rtol=0, atol=1e-12 * size)
            np.testing.assert_allclose(between[name], values, rtol=0, atol=1e-12 * size)
            np.testing.assert_array_equal(coarse.sensitivity[name], between[name])
            np.testing.assert_array_equal(run.sol.sensitivity(times[3])[name], between[name][..., 3])
    restored = pickle.loads(pickle.dumps(run.sol))
    np.testing.assert_array_equal(restored.sensitivity(0.3)["F"], run.sol.sensitivity(0.3)["F"])
    with pytest.raises(fb.ModelError, match="The run has no sensitivities"):
        four_bar.simulate((0.0, 1.0), dense_output=True).sol.sensitivity(0.5)
    with pytest.raises(fb.ModelError, match="it has no states at the times"):
        run.sol.sensitivity(2.0)


def test_sensitivities_of_joint_forces_by_a_torque_equal_differences():
    """Joint forces by a torque that drives a crank, against differences of order 6."""
    model = fb.compile_model(fb.models.slider_crank())
    how = {"t_eval": [0.1, 0.2], "rtol": 1e-13, "atol": 1e-13}

    def outputs(torque):
        return model.simulate((0.0, 0.2), inputs={"torque": torque}, **how).outputs

    run = model.simulate((0.0, 0.2), inputs={"torque": 3.0}, sensitivities=["torque"], **how)
    wanted = differences(outputs, 3.0, 1e-3)
    np.testing.assert_allclose(run.output_sensitivity["torque"], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())
    at, values = [0.0, 0.15, 0.4], np.array([3.0, 1.0, -2.0])
    run = model.simulate((0.0, 0.2), inputs={"torque": (at, values)}, sensitivities=["torque"], **how)
    for place in range(3):

        def of(value, place=place):
            return outputs((at, np.where(np.arange(3) == place, value, values)))

        wanted = differences(of, values[place], 1e-3)
        found = run.output_sensitivity["torque"][place]
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


@pytest.mark.slow
def test_sensitivities_of_a_pendulums_period_equal_elliptic_integrals():
    """T = 4 sqrt(l / g) K(k), k = sin(a / 2), by the length, gravity and amplitude a: with K the elliptic integral."""
    model, a, length, g = fb.compile_model(swinging_pendulum()), 2.0, 0.5, 9.81
    run = model.simulate(
        (0.0, 9.0), {"q": a, "u": 0.0}, events=fb.Event("angle", terminal=True, direction=1), t_eval=[9.0],
        sensitivities=["l", "g", "m", "q"], rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    # From rest at the amplitude, the first upward passage is at three quarters of a period.
    k2 = np.sin(a / 2.0) ** 2
    period = 4.0 * np.sqrt(length / g) * ellipk(k2)
    assert run.t_events[0][0] == pytest.approx(0.75 * period, rel=1e-10)
    # dK/d(k^2) = (E - (1 - k^2) K) / (2 k^2 (1 - k^2)), d(k^2)/da = sin(a) / 2
    slope = (ellipe(k2) - (1.0 - k2) * ellipk(k2)) / (2.0 * k2 * (1.0 - k2)) * np.sin(a) / 2.0
    wanted = {"l": period / (2.0 * length), "g": -period / (2.0 * g), "m": 0.0, "q": 4.0 * np.sqrt(length / g) * slope}
    for name, value in wanted.items():
        found = run.event_sensitivity[0][name].t[0]
        assert found == pytest.approx(0.75 * value, rel=1e-8, abs=1e-10)
        assert run.sensitivity[name].shape == (2, 1)  # at the event alone


def swinging_pendulum():
    model = driven_pendulum(None, s=sm.Integer(0))
    (q,) = model.system.q
    return fb.Model(model.system, name="swinging", parameters={"m": 2.0, "l": 0.5, "g": 9.81}, outputs={"angle": q})


def test_sensitivities_by_a_force_amplitude_equal_closed_forms_unless_it_is_given():
    t = me.dynamicsymbols._t
    driven = driven_oscillator(parameters={"F_0": 3.0}, force=sm.Symbol("F_0") * sm.sin(3 * t))
    compiled = fb.compile_model(driven)
    times = np.linspace(0.0, 4.0, 9)
    how = {"t_eval": times, "rtol": 1e-11, "atol": 1e-11, "sensitivities": ["F_0"], "gradient": True}
    run = compiled.simulate((0.0, 4.0), **how)
    np.testing.assert_allclose(run.sensitivity["F_0"], run.y / 3.0, rtol=0, atol=1e-10)  # it is linear
    assert run.gradient({"x": 1.0})["F_0"] == pytest.approx(run["x"].sum() / 3.0, abs=1e-9)
    table = compiled.simulate((0.0, 4.0), inputs={"F": ([0.0, 4.0], [1.0, 2.0])}, **how)
    np.testing.assert_array_equal(table.sensitivity["F_0"], 0.0)
    assert table.gradient({"x": 1.0})["F_0"] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("of", ["parameter", "input", "beside an input", "beside a steady motion"])
def test_sensitivities_by_an_amplitude_that_is_zero_equal_closed_forms(of):
    """m x'' = A sin(w t) - k x from rest, dx/dA = (sin(w t) - w / w0 sin(w0 t)) / (m (w0^2 - w^2)) with w0^2 = k / m.

    Only the derivative follows the force, over 120 steps whose errors may be ten times rtol.
    """
    t, w, w0, model = me.dynamicsymbols._t, 20.0, 2.0, oscillator()
    system, amplitude = model.system, me.dynamicsymbols("A") if of == "input" else sm.Symbol("A")
    f, y, v = me.dynamicsymbols("F y v_y")
    wave, inputs, initial = sm.sin(20 * t), {}, {"x": 0.0, "v": 0.0}
    if of == "beside an input":
        wave, inputs = f, {f: sm.sin(20 * t)}
    elif of == "beside a steady motion":
        other = system.fixed_point.locatenew("Q", y * system.frame.y)
        other.set_vel(system.frame, v * system.frame.y)
        system.add_bodies(me.Particle("other", other, sm.Symbol("m")))
        system.add_coordinates(y)
        system.add_speeds(v)
        system.add_kdes(v - y.diff())
        wave, initial = sm.sin(y), initial | {"y": 0.0, "v_y": 20.0}
    system.add_loads(me.Force(system.bodies[0].masscenter, amplitude * wave * system.frame.x))
    parameters = {"m": 2.0, "k": 8.0} | ({} if of == "input" else {"A": 0.0})
    inputs |= {amplitude: None} if of == "input" else {}
    model = fb.compile_model(fb.Model(system, name="shaken", parameters=parameters, initial=initial, inputs=inputs))
    times = np.linspace(0.0, 10.0, 6)
    wanted = (np.sin(w * times) - w / w0 * np.sin(w0 * times)) / (2.0 * (w0**2 - w**2))
    how = {"t_eval": times, "rtol": 1e-8, "atol": 1e-8, "inputs": {"A": 0.0} if of == "input" else {}}
    near = {"rtol": 0, "atol": 1e-5 * np.abs(wanted).max()}
    run = model.simulate((0.0, 10.0), sensitivities=["A"], **how)
    np.testing.assert_array_equal(run["x"], 0.0)
    np.testing.assert_allclose(run.sensitivity["A"][0], wanted, **near)
    run = model.simulate((0.0, 10.0), gradient=True, **how)
    np.testing.assert_allclose([run.gradient({"x": unit})["A"] for unit in np.eye(6)], wanted, **near)


@pytest.mark.slow
def test_gradients_by_many_small_force_amplitudes_equal_closed_forms():
    """The same with a sum of forces, over 380 periods of the fastest, whose errors may be ten times rtol."""
    w0, frequencies, amplitudes = 2.0, np.array([*range(1, 10), 100, 200, 340]), sm.symbols("a1:13")
    force = sum(a * sm.sin(int(w) * me.dynamicsymbols._t) for a, w in zip(amplitudes, frequencies, strict=True))
    frequencies = frequencies + 1e-9 * (frequencies == w0)  # its limit at resonance
    model = fb.compile_model(driven_oscillator(parameters={str(a): 1e-9 for a in amplitudes}, force=force))
    run = model.simulate((0.0, 7.0), t_eval=[7.0], gradient=True)
    gradient = run.gradient({"x": 1.0})
    wanted = np.sin(frequencies * 7.0) - frequencies / w0 * np.sin(w0 * 7.0)
    wanted /= 2.0 * (w0**2 - frequencies**2)
    np.testing.assert_allclose([gradient[str(a)] for a in amplitudes], wanted, rtol=10 * 1e-6 * 380)


A, B, S = sm.symbols("a b s")
F = me.dynamicsymbols("F")
JUMPING = [
    ("sign of v", lambda x, v, t: -A * sm.sign(v)),
    ("sign of v", lambda x, v, t: -1e-7 * sm.sign(v)),
    ("Abs of v", lambda x, v, t: -A * v / sm.Abs(v)),
    ("Abs of v", lambda x, v, t: -A * v / sm.sqrt(v**2)),
    ("Piecewise of x", lambda x, v, t: sm.Piecewise((A, x > 50), (0, True))),
    ("Piecewise of x", lambda x, v, t: sm.Piecewise((-A * (x - B) - S * v, x > B), (0, True))),
    ("Piecewise of x, t", lambda x, v, t: sm.Piecewise((A, t > x + 4), (0, True))),
    ("atan2 of x", lambda x, v, t: A * sm.atan2(x, v)),
    ("Heaviside of t", lambda x, v, t: A * sm.Heaviside(sm.sin(S * t) - B)),
    ("floor of t", lambda x, v, t: A * (S * t - sm.floor(S * t))),
    ("Heaviside of x", lambda x, v, t: 1e7 * A * sm.Heaviside(x - 2e7)),
    ("acot of x", lambda x, v, t: A * sm.acot(x / B)),
    ("atan of x", lambda x, v, t: A * sm.atan(B / x)),
    ("Heaviside of F", lambda x, v, t: A * sm.Heaviside(F - B)),
    # A root that has no real value where its branch is not taken.
    ("Piecewise of x", lambda x, v, t: sm.Piecewise((A + sm.sqrt(-x), x < 0), (0, True))),
]
STEADY = {
    "a stop": lambda x, v, t: -A * sm.Max(0, x - B),
    "drag": lambda x, v, t: -A * v * sm.Abs(v),
    "a root": lambda x, v, t: -A * sm.sqrt(sm.Abs(x)) * sm.sign(x),
    "a triangular wave": lambda x, v, t: A * sm.Abs(S * t - sm.floor(S * t) - sm.Rational(1, 2)),
    "a known time": lambda x, v, t: A * sm.Heaviside(t - 1),
}


@pytest.mark.slow
@pytest.mark.parametrize(("function", "load"), JUMPING)
def test_sensitivities_with_jumps_at_unknown_times_warn_of_the_function(function, load):
    """By the time of such a jump states have derivatives that are left out: a warning names the function."""
    model = loaded(load, {F: 0.0} if function.endswith("F") else None)
    with pytest.warns(fb.ModelWarning, match=f"not known beforehand \\({function}\\).*leave out the change"):
        model.simulate((0.0, 0.1), [0.3, 0.1], sensitivities=["k"])


@pytest.mark.slow
def test_sensitivities_warn_of_jumps_that_only_changed_parameters_cause():
    """With equal defaults nothing jumps."""
    model = loaded(lambda x, v, t: sm.Piecewise((A, x < S), (B, True)))
    assert model.simulate((0.0, 0.1), sensitivities=["k"]).success
    with pytest.warns(fb.ModelWarning, match="Piecewise of x"):
        model.simulate((0.0, 0.1), sensitivities=["k"], parameters={"a": 1.0})


def test_force_without_real_values_has_a_jump_that_is_stated_as_unknown():
    """The force has no real value anywhere, on neither side of v = 0: whether it jumps there is said to be unknown."""
    with pytest.warns(fb.ModelWarning, match="was not compared with its equations"):
        model = loaded(lambda x, v, t: A * sm.sign(v) * sm.sqrt(-1 - x**2))
    entry = {"function": "sign of v", "input": "", "by_default": True, "known": False}
    assert model.manifest["state_jumps"] == [entry]


@pytest.mark.slow(but=["1000000.0"])
@pytest.mark.parametrize("stiffness", [1e5, 1e6])
def test_sensitivities_through_a_contact_equal_closed_forms(stiffness):
    """A fall from rest onto a spring, y + g / w^2 = R cos(w t - phase), and up again with the same speed.

    A derivative that is zero in the fall, of the speed by the height, grows from the kink on. At default tolerances,
    its error is ten times rtol times its size in the contact, w, and a few steps.
    """
    g, k = sm.symbols("g k")
    y, model = me.dynamicsymbols("x"), oscillator()
    load = -g + k * y + k * sm.Max(-y, 0)  # instead of the spring
    model.system.add_loads(me.Force(model.system.bodies[0].masscenter, load * model.system.frame.x))
    given = {"parameters": {"m": 1.0, "k": stiffness, "g": 9.81}, "initial": {"x": 0.1, "v": 0.0}}
    model = fb.compile_model(fb.Model(model.system, name="ball", **given))

    def speed(height):
        fall, w = np.sqrt(2.0 * height / 9.81), np.sqrt(stiffness)
        phase = np.arctan2(9.81 * fall / w, 9.81 / w**2)
        return 9.81 * fall - 9.81 * (0.25 - fall - 2.0 * (np.pi - phase) / w)

    h = 1e-4
    wanted = (speed(0.1 + h) - speed(0.1 - h)) / (2.0 * h)  # to 1e-6
    how = {"t_eval": [0.25], "sensitivities": ["x"]}
    run = model.simulate((0.0, 0.25), rtol=1e-10, atol=1e-12, **how)
    assert run["v"][0] == pytest.approx(speed(0.1), rel=1e-7)
    assert run.sensitivity["x"][1, 0] == pytest.approx(wanted, rel=1e-5)
    run = model.simulate((0.0, 0.25), **how)
    assert run.sensitivity["x"][1, 0] == pytest.approx(wanted, abs=10 * 1e-5 * np.sqrt(stiffness))


@pytest.mark.slow
@pytest.mark.parametrize("name", STEADY)
def test_sensitivities_with_continuous_forces_give_no_warning(name):
    model = loaded(STEADY[name])
    assert model.simulate((0.0, 0.1), sensitivities=["k"]).success


def test_sensitivities_warn_of_jumps_of_an_input_unless_it_is_given():
    model = fb.compile_model(driven_oscillator(force=sm.sign(sm.sin(5 * me.dynamicsymbols._t))))
    with pytest.warns(fb.ModelWarning, match="sign of t"):
        model.simulate((0.0, 0.1), [0.3, 0.1], sensitivities=["k"])
    assert model.simulate((0.0, 0.1), sensitivities=["k"], inputs={"F": 1.0}).success


@pytest.mark.slow
@pytest.mark.parametrize(
    "load",
    [
        lambda x, v, t: A * sm.Max(0, -v) ** (1 + B),  # by the exponent, x^b log(x) at 0
        lambda x, v, t: -A * sm.Abs(v) ** (1 + B) * sm.sign(v),
        lambda x, v, t: -A * v * sm.sqrt(v**2),
    ],
)
def test_sensitivities_with_powers_of_zero_speeds_equal_differences(load):
    """From rest, where derivatives of powers are limits."""
    model, h = loaded(load), 1e-5
    names = [name for name in ("a", "b", "x") if name in (*model.parameters, "x")]
    how = {"t_eval": [1.0], "rtol": 1e-10, "atol": 1e-10}
    run = model.simulate((0.0, 1.0), [0.3, 0.0], sensitivities=names, gradient=True, **how)
    for name in names:

        def at(value, name=name):
            x0 = [value, 0.0] if name == "x" else [0.3, 0.0]
            return model.simulate((0.0, 1.0), x0, parameters={} if name == "x" else {name: value}, **how).y[0, 0]

        value = 0.3 if name == "x" else 0.5
        wanted = (at(value + h) - at(value - h)) / (2.0 * h)
        assert run.sensitivity[name][0, 0] == pytest.approx(wanted, rel=1e-5, abs=1e-7)  # errors of 1e-11 over h
        assert run.gradient({"x": 1.0})[name] == pytest.approx(run.sensitivity[name][0, 0], rel=1e-10)


def test_gradients_of_runs_without_them_are_refused(four_bar):
    run = four_bar.simulate((0.0, 0.1), t_eval=[0.0, 0.1])
    with pytest.raises(fb.ModelError, match="gradient=True"):
        run.gradient({"q1": 1.0})
    kept = four_bar.simulate((0.0, 0.1), t_eval=[0.0, 0.1], gradient=True)
    with pytest.raises(fb.ModelError, match="gradient=True"):
        kept.resample([0.05]).gradient({"q1": 1.0})


@pytest.mark.slow
def test_sensitivities_by_parameters_locked_by_redundant_constraints_are_refused():
    """With a bar too many, loops close only if all bars have the same length, and are where they are."""
    model = fb.compile_model(parallelogram())
    given = {"coordinates": {"q_AB": 1.2}, "speeds": {"u_AB": 2.0}}
    with pytest.raises(fb.AssemblyError, match="do not close"):
        model.initial_state(**given, parameters={"l_AB": 1.001})
    x0, by = model.initial_state(**given, derivatives=True)
    assert {*by} == {"q_AB", "u_AB", "rho"}
    for start in (None, x0):
        for name in ("l_AB", "y_E", "x_A"):
            with pytest.raises(fb.AssemblyError, match=f"not stay satisfied if {name} alone changes"):
                model.simulate((0.0, 0.3), start, sensitivities=[name])
    # Upright and at rest, places along the ground open loops only to second order.
    at_rest, by = model.initial_state(derivatives=True)
    assert at_rest[0] == pytest.approx(np.pi / 2.0)
    assert {*by} == {"q_AB", "u_AB", "rho"}
    assert {*model.simulate((0.0, 0.3), gradient=True).gradient({"q_AB": 1.0})} == {"q_AB", "u_AB", "rho"}
    assert model.simulate((0.0, 0.3), x0, sensitivities=["rho", "u_AB"]).success
    assert {*model.simulate((0.0, 0.3), x0, gradient=True).gradient({"q_AB": 1.0})} == {"q_AB", "u_AB", "rho"}
    t = np.linspace(0.0, 0.3, 31)
    with pytest.raises(fb.SimulationError, match="if l_AB alone changes"):
        fb.fit(model, {"t": t, "q_AB": 1.2 + 2.0 * t}, ["l_AB", "u_AB"])


@pytest.mark.slow(but=["start0-how0"])
@pytest.mark.parametrize("how", [{"gradient": True}, {"sensitivities": ["q_AB"]}, {"gradient": True, "rtol": 1e-5}])
@pytest.mark.parametrize("start", [(0.5, -1.0), (1.2, -2.0)])
def test_run_with_derivatives_into_a_singular_position_ends_before_it(start, how):
    """All bars come to lie along the ground, where no derivative exists: the run ends before, after some hundred steps.

    Rounding errors of derivatives grow there, whatever the length of steps.
    """
    model, (angle, rate) = fb.compile_model(parallelogram()), start
    x0 = model.initial_state({"q_AB": angle}, {"u_AB": rate})
    run = model.simulate((0.0, 3.0), x0, inputs={"M": 3.0}, **{"rtol": 1e-9, "atol": 1e-9} | how)
    assert "singular position" in run.message
    assert "no derivative there" in run.message
    assert abs(np.sin(run["q_AB"][-1])) < 0.05
    assert run.t.size < 1000


def test_run_with_derivatives_at_a_singular_position_fails_with_a_message(four_bar):
    for how in ({"sensitivities": ["k"]}, {"gradient": True}):
        run = four_bar.simulate((0.0, 8.0), rtol=1e-8, atol=1e-8, **how)
        assert not run.success
        assert run.message.endswith("The motion has no derivative there, and ALI3P no sensitivities.")
    with pytest.raises(fb.ModelError, match="There is no gradient of a run that failed"):
        run.gradient({"q1": 1.0})
    chain = fb.compile_model(parallelogram())
    with pytest.raises(fb.AssemblyError):
        chain.initial_state({"q_AB": 0.0}, {"u_AB": 0.0}, derivatives=True)
    with pytest.raises(fb.AssemblyError, match="singular position"):  # all links on a line: 0.8 + 0.9 = 1 + 0.7
        four_bar.initial_state({"q1": 0.0}, {"u1": 0.7}, parameters={"l2": 0.9}, derivatives=True)


def test_sensitivities_of_a_chaotic_motion_that_overflow_are_reported():
    """A chaotic motion: they grow by e in about a second, up to 1e308."""
    model = fb.compile_model(fb.models.chain(2))
    run = model.simulate((0.0, 1000.0), sensitivities=["q1"], t_eval=[1.0, 500.0, 1000.0])
    assert run.success
    assert np.isfinite(run.sensitivity["q1"]).all(axis=0).tolist() == [True, True, False]
    assert "Sensitivities are not finite from t = 1000 on" in run.message


def test_an_output_that_is_always_zero_has_no_events():
    model = fb.compile_model(fb.models.slider_crank())
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        run = model.simulate((0.0, 0.1), t_eval=[0.1], events=["pin_z"], sensitivities=["r"])
    assert run.t_events[0].size == run.event_sensitivity[0]["r"].t.size == 0
