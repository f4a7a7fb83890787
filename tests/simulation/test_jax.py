"""The model in JAX: against the model's own derivatives, closed forms, and both modes against one another."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import driven_oscillator, oscillator

import fourbar_codegen as fb

jax = pytest.importorskip("jax")
jnp = pytest.importorskip("jax.numpy")

TIMES = np.linspace(0.0, 1.0, 11)


@pytest.fixture(autouse=True)
def double_precision():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


def test_to_jax_in_single_precision_is_refused(four_bar):
    jax.config.update("jax_enable_x64", False)
    with pytest.raises(fb.ModelError, match="jax_enable_x64"):
        fb.to_jax(four_bar)


@pytest.mark.slow
def test_jax_derivatives_of_the_rates_equal_the_compiled_ones_in_both_modes(four_bar):
    rhs, x = fb.to_jax(four_bar).rhs, four_bar.initial_state()
    p, r = np.array([*four_bar.defaults.values()]), four_bar.kernel.default_inputs(0.0)
    for mode in (jax.jacfwd, jax.jacrev):
        found = mode(rhs, argnums=(1, 2, 3))(0.0, x, p, r)
        np.testing.assert_array_equal(found[0], four_bar.jacobian(0.0, x, p, r))
        np.testing.assert_array_equal(found[1], four_bar.parameter_jacobian(0.0, x, p, r))
        np.testing.assert_array_equal(found[2], four_bar.input_jacobian(0.0, x, p, r))
    for mode in (jax.jacfwd, jax.jacrev):  # F = 100 sin(pi t)
        wrt_time = four_bar.input_jacobian(0.1, x)[:, 0] * 100.0 * np.pi * np.cos(0.1 * np.pi)
        np.testing.assert_allclose(mode(rhs)(0.1, x), wrt_time, rtol=1e-8)  # differences over 1e-5 s
    states = np.tile(x, (7, 1)) * np.linspace(0.9, 1.1, 7)[:, np.newaxis]
    expected = four_bar.rhs_batch(0.0, states.T).T
    np.testing.assert_array_equal(jax.vmap(lambda x: rhs(0.0, x))(states), expected)
    np.testing.assert_array_equal(jax.jit(jax.vmap(lambda x: rhs(0.0, x)))(states), expected)


def test_jax_functions_refuse_wrong_shapes_and_second_derivatives(four_bar):
    rhs, x = fb.to_jax(four_bar).rhs, four_bar.initial_state()
    for given in ({"x": x * (1 + 1j)}, {"x": 10**400}, {"t": 1j}):
        with pytest.raises(fb.ModelError, match=r"must be (real numbers|an array)"):
            rhs(**{"t": 0.0, "x": x, **given})
    for given in ({"x": x[:3]}, {"x": x[np.newaxis]}, {"x": x, "p": np.ones((8, 1))}, {"x": x, "t": np.zeros(2)}):
        with pytest.raises(fb.ModelError, match=r"must have the shape \(.*use jax\.vmap"):
            rhs(**{"t": 0.0, **given})
    simulate = fb.to_jax(four_bar).simulation((0.0, 0.1), [0.1])
    for function, at in ((lambda x: rhs(0.0, x).sum(), x), (lambda k: simulate({"k": k})["q1"][0], 2.0)):
        with pytest.raises(fb.ModelError, match="no second derivatives"):
            jax.grad(lambda at, function=function: jax.grad(function)(at).sum())(at)


@pytest.mark.slow
def test_jax_right_hand_side_takes_parameters_and_inputs_by_name(four_bar):
    rhs, x = fb.to_jax(four_bar).rhs, four_bar.initial_state()
    np.testing.assert_array_equal(rhs(0.3, x, {"k": 2.0}, {"F": 5.0}), four_bar.rhs(0.3, x, {"k": 2.0}, {"F": 5.0}))
    np.testing.assert_array_equal(rhs(0.3, x, {"k": 2.0}), four_bar.rhs(0.3, x, {"k": 2.0}))
    column = four_bar.parameter_jacobian(0.3, x)[:, four_bar.parameters.index("k")]
    np.testing.assert_array_equal(jax.jacobian(lambda k: rhs(0.3, x, {"k": k}))(four_bar.defaults["k"]), column)
    for given, sentence in (
        ({"p": {"K": 1.0}}, "no parameter 'K'. Did you mean k"),
        ({"r": {"f": 1.0}}, "no input 'f'"),
        ({"p": {"k": "stiff"}}, "k must be an array of the shape"),
        ({"x": {"q1": 1.0}}, r"x must be an array of the shape \(6,\), not {'q1': 1.0}"),
    ):
        with pytest.raises(fb.ModelError, match=sentence):
            rhs(**{"t": 0.0, "x": x, **given})


@pytest.mark.slow
def test_jax_derivatives_pass_through_the_expression_of_an_input():
    a, t = sm.Symbol("a"), me.dynamicsymbols._t
    model = fb.compile_model(driven_oscillator(parameters={"a": 3.0}, force=a * sm.sin(2 * t)))
    x, p = np.array([0.1, 0.2]), np.array([*model.defaults.values()])
    for mode in (jax.jacfwd, jax.jacrev):
        wrt_time, wrt_parameters = mode(fb.to_jax(model).rhs, argnums=(0, 2))(0.3, x, p)
        np.testing.assert_allclose(wrt_time, [0.0, 3.0 * np.cos(0.6)], rtol=1e-8)  # 6 cos(2 t) / m; over 1e-5 s
        np.testing.assert_allclose(wrt_parameters, model.parameter_jacobian(0.3, x), rtol=1e-13)
    simulate = fb.to_jax(model).simulation((0.0, 1.0), TIMES)
    assert np.isnan(simulate({"k": np.nan})["x"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("forward", [False, True])
def test_jax_derivatives_of_an_oscillators_run_equal_closed_forms_in_both_modes(forward):
    # x = a cos(w t): dx/dk = -a t sin(w t) / (2 m w), dx/da = cos(w t)
    simulate = fb.to_jax(fb.compile_model(oscillator())).simulation((0.0, 1.0), TIMES, forward=forward, rtol=1e-11)
    w, a = 2.0, 0.3
    by_k, by_a = jax.jacrev(lambda k, x: simulate({"k": k}, {"x": x})["x"], argnums=(0, 1))(8.0, a)
    np.testing.assert_allclose(by_k, -a * TIMES * np.sin(w * TIMES) / (4.0 * w), rtol=0, atol=1e-9)
    np.testing.assert_allclose(by_a, np.cos(w * TIMES), rtol=0, atol=1e-9)


@pytest.mark.slow
def test_jax_gradients_of_a_closed_loop_equal_differences_in_both_modes(four_bar):
    """Dependent initial values follow from the lengths: differences of runs from consistent states."""
    model = fb.to_jax(four_bar)

    def loss(simulate):
        return lambda parameters, initial: (simulate(parameters, initial)["q2"] ** 2).sum()

    given = {"k": 2.0, "l2": 0.6}, {"q1": -0.5, "u1": -0.1}
    tight = {"rtol": 1e-12, "atol": 1e-12}  # the two modes take different steps
    reverse = loss(model.simulation((0.0, 1.0), TIMES, **tight))
    found = jax.jit(jax.grad(reverse, argnums=(0, 1)))(*given)
    forward = jax.grad(loss(model.simulation((0.0, 1.0), TIMES, forward=True, **tight)), argnums=(0, 1))(*given)
    for place, values in enumerate(given):
        for name, value in values.items():
            # h^2 / 6 times a third derivative; the runs' errors of 1e-12 divided by h
            after, before = (
                reverse(*(each | {name: value + h} if i == place else each for i, each in enumerate(given)))
                for h in (1e-4, -1e-4)
            )
            assert float(found[place][name]) == pytest.approx(float(after - before) / 2e-4, rel=1e-4)
            assert float(found[place][name]) == pytest.approx(float(forward[place][name]), rel=1e-9)
    tangent = jax.jvp(lambda k: model.simulation((0.0, 1.0), TIMES, forward=True)({"k": k})["q2"], (2.0,), (1.0,))[1]
    expected = four_bar.simulate(
        (0.0, 1.0), t_eval=TIMES, parameters={"k": 2.0}, sensitivities=["k"], rtol=1e-8, atol=1e-10
    ).sensitivity["k"]
    np.testing.assert_allclose(tangent, expected[1], rtol=0, atol=1e-8)


def test_jax_simulation_with_a_guess_follows_the_other_assembly_mode(four_bar):
    _, other = four_bar.initial_states({"q1": -0.5}, {"u1": -0.1}).x
    run = four_bar.simulate((0.0, 0.5), other, t_eval=TIMES[:5], rtol=1e-8, atol=1e-10)
    simulate = fb.to_jax(four_bar).simulation((0.0, 0.5), TIMES[:5], guess=other[1:3])
    np.testing.assert_allclose(simulate(initial={"q1": -0.5, "u1": -0.1})["q2"], run["q2"], rtol=0, atol=1e-8)
    with pytest.raises(fb.ModelError, match="dependent coordinate"):
        fb.to_jax(four_bar).simulation((0.0, 1.0), TIMES, guess={"k": 1.0})


@pytest.mark.slow
def test_jax_gradients_by_a_control_table_lead_to_the_minimum_of_a_loss():
    """Values of a table, by gradient descent: the work of a force that brings a mass to rest elsewhere falls."""
    model = fb.compile_model(driven_oscillator(parameters={"k": 0.0}))
    simulate = fb.to_jax(model).simulation((0.0, 1.0), [1.0], inputs={"F": (TIMES, np.zeros(11))})

    def loss(force):
        end = simulate(inputs={"F": force})
        return (end["x"][0] - 0.1) ** 2 + 0.1 * end["v"][0] ** 2 + 1e-3 * (force**2).mean()

    # Linear in the force, so that the loss is quadratic: Newton's method with the Hessian from gradients is exact.
    gradient = jax.grad(loss)
    zero = jnp.zeros(11)
    hessian = np.array([gradient(zero.at[i].set(1.0)) - gradient(zero) for i in range(11)])
    best = -np.linalg.solve(hessian, gradient(zero))
    assert np.abs(gradient(best)).max() < 1e-9
    assert loss(best) < loss(zero)
    table = {"F": (TIMES, np.zeros(11))}
    rows = jax.jacobian(fb.to_jax(model).simulation((0.0, 1.0), [1.0], inputs=table, forward=True), argnums=2)
    forward, end = rows({}, {}, {"F": best}), simulate(inputs={"F": best})
    by_force = 2.0 * (end["x"][0] - 0.1) * forward["x"]["F"][0] + 0.2 * end["v"][0] * forward["v"]["F"][0]
    np.testing.assert_allclose(by_force + 2e-3 * best / 11, gradient(best), rtol=0, atol=1e-11)


@pytest.mark.slow
def test_jax_simulation_whose_loops_do_not_close_gives_nan(four_bar):
    simulate = fb.to_jax(four_bar).simulation((0.0, 1.0), TIMES)
    assert np.isnan(simulate({"l2": 50.0})["q1"]).all()
    assert np.isnan(jax.grad(lambda l2: simulate({"l2": l2})["q1"].sum())(50.0))


def test_jax_simulation_with_wrong_names_or_shapes_is_refused_with_a_message(four_bar):
    model = fb.to_jax(four_bar)
    simulate = model.simulation((0.0, 1.0), TIMES, inputs={"F": ([0.0, 1.0], [1.0, 2.0])})
    for sentence, call in (
        ("no parameter 'kk'. Did you mean k", lambda: simulate({"kk": 1.0})),
        ("no initial value 'q2'", lambda: simulate({}, {"q2": 1.0})),
        (r"parameter k must have the shape \(\), not \(2,\)", lambda: simulate({"k": np.ones(2)})),
        (r"F must have the shape \(2,\), not \(3,\)", lambda: simulate(inputs={"F": np.ones(3)})),
        ("parameter k must be an array of the shape .* not 'a'", lambda: simulate({"k": "a"})),
        ("initial value q1 must be real numbers, not 1j", lambda: simulate({}, {"q1": 1j})),
        ("no output 'zz'", lambda: model.simulation((0.0, 1.0), TIMES, outputs=["zz"])),
        ("a mapping from names, not list", lambda: simulate([1.0])),
        ("no method 'Euler'", lambda: model.simulation((0.0, 1.0), TIMES, method="Euler")),
        ("Radau has no gradient", lambda: model.simulation((0.0, 1.0), TIMES, method="Radau")),
        ("Radau has no sens", lambda: model.simulation((0.0, 1.0), TIMES, method="Radau", forward=True)),
        ("rtol must be a positive", lambda: model.simulation((0.0, 1.0), TIMES, rtol=-1.0)),
        ("constraints must be .* not 'glue'", lambda: model.simulation((0.0, 1.0), TIMES, constraints="glue")),
        ("no input 'G'", lambda: model.simulation((0.0, 1.0), TIMES, inputs={"G": 1.0})),
        ("inputs must be a mapping", lambda: model.simulation((0.0, 1.0), TIMES, inputs="text")),
        ("outputs is a sequence of names, not None", lambda: model.simulation((0.0, 1.0), TIMES, outputs=None)),
    ):
        with pytest.raises(fb.ModelError, match=sentence):
            call()
