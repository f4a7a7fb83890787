"""Jacobians and residuals at a batch of states: against single states, differences, and one another."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import of_form
from builders.oscillators import driven_oscillator
from builders.systems import parallelogram

import fourbar_codegen as fb

MODELS = {
    "four_bar": fb.models.four_bar,
    "bicycle": fb.models.whipple_bicycle,
    "closed chain": lambda: fb.models.chain(8, closed=True),
    "redundant": parallelogram,
    "disc": fb.models.rolling_disc,
    "recursive": lambda: of_form("recursive"),
    "sparse": lambda: of_form("sparse"),
}
N = 5


@pytest.fixture(scope="module", params=MODELS)
def points(request):
    """A model, and random arguments of `residual_batch`."""
    model = fb.compile_model(MODELS[request.param]())
    generator = np.random.default_rng(0)
    p = np.array([*model.defaults.values()])[:, np.newaxis] * generator.uniform(0.9, 1.1, (model.n_p, N))
    sizes = {"x": model.n_x, "rates": model.n_x, "multipliers": model.n_l, "r": model.n_r}
    arguments = {name: generator.uniform(-1.0, 1.0, (size, N)) for name, size in sizes.items()}
    return model, generator.uniform(0.0, 1.0, N), {**arguments, "p": p}


@pytest.mark.slow
def test_batch_jacobians_equal_those_of_single_states_to_the_bit(points):
    model, t, arguments = points
    x, p, r = (arguments[name] for name in ("x", "p", "r"))
    batches = [
        (model.jacobian_batch(t, x, p, r, workers=None), model.jacobian),
        (model.parameter_jacobian_batch(t, x, p, r), model.parameter_jacobian),
        (model.input_jacobian_batch(t, x, p, r), model.input_jacobian),
    ]
    for found, single in batches:
        for i in range(N):
            try:
                expected = single(t[i], x[:, i], p[:, i], r[:, i])
            except fb.SimulationError:
                assert np.isnan(found[..., i]).all()
            else:
                np.testing.assert_array_equal(found[..., i], expected)


@pytest.mark.slow(but=["disc-index-3"])
@pytest.mark.parametrize("formulation", ["index-1", "index-3"])
def test_residual_jacobians_equal_differences_and_have_the_stated_sparsity(points, formulation):
    model, t, arguments = points
    found = model.residual_jacobian_batch(t, **arguments, formulation=formulation)
    for wrt in ("x", ("p", "rates"), ("r", "multipliers")):
        some = model.residual_jacobian_batch(t, **arguments, formulation=formulation, wrt=wrt)
        assert tuple(some) == ((wrt,) if wrt == "x" else wrt)
        for name, values in some.items():
            np.testing.assert_array_equal(values, found[name])
    sparsity = model.residual_sparsity(formulation)
    for name, values in arguments.items():
        size = np.abs(found[name]).max(initial=1.0)
        assert np.abs(found[name]).max(axis=2)[~sparsity[name]].max(initial=0.0) <= 1e-15 * size
        for j in range(len(values)):
            moved = [{**arguments, name: values.copy()} for _ in range(2)]
            moved[0][name][j] += 1e-4
            moved[1][name][j] -= 1e-4
            after, before = (model.residual_batch(t, **each, formulation=formulation) for each in moved)
            # The error of central differences: h^2 / 6 times a third derivative of the size of the entries.
            np.testing.assert_allclose(found[name][:, j], (after - before) / 2e-4, rtol=0, atol=1e-7 * size)


def test_residual_of_every_formulation_vanishes_along_a_run(four_bar):
    run = four_bar.simulate((0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 21), rtol=1e-10, atol=1e-10)
    rates = four_bar.rhs_batch(run.t, run.y)
    for formulation in ("index-1", "index-3"):
        residual = four_bar.residual_batch(run.t, run.y, rates, run.multipliers, formulation=formulation)
        assert np.abs(residual).max() < 1e-10


@pytest.mark.slow
def test_parameters_of_an_inputs_expression_enter_jacobians_unless_it_is_given():
    t = me.dynamicsymbols._t
    model = fb.compile_model(driven_oscillator(parameters={"F_0": 3.0}, force=sm.Symbol("F_0") * sm.sin(3 * t)))
    place, times, x = model.parameters.index("F_0"), np.array([0.1, 0.2]), np.ones((2, 2))
    expected = np.sin(3.0 * times)
    np.testing.assert_allclose(model.parameter_jacobian_batch(times, x)[1, place], expected / 2.0, rtol=1e-14)
    found = model.residual_jacobian_batch(times, x, x)
    np.testing.assert_allclose(found["p"][1, place], -expected, rtol=1e-14)
    assert model.residual_sparsity()["p"][1, place]
    held = model.residual_jacobian_batch(times, x, x, r={"F": 1.0})
    np.testing.assert_array_equal(held["p"][1, place], 0.0)


@pytest.mark.slow(but=["disc", "bicycle", "closed chain"])
def test_products_with_vectors_equal_products_with_the_jacobians(points):
    model, t, arguments = points
    x, p, r = (arguments[name][:, 0] for name in ("x", "p", "r"))
    generator = np.random.default_rng(1)
    dx, dp, dr = (generator.normal(size=(size, 11)) for size in (model.n_x, model.n_p, model.n_r))
    w = generator.normal(size=model.n_x)
    try:
        matrices = [f(t[0], x, p, r) for f in (model.jacobian, model.parameter_jacobian, model.input_jacobian)]
    except fb.SimulationError:
        with pytest.raises(fb.SimulationError):
            model.vjp(t[0], x, w, p, r)
        return
    expected = sum(matrix @ part for matrix, part in zip(matrices, (dx, dp, dr), strict=True))
    size = sum(np.abs(matrix) @ np.abs(part) for matrix, part in zip(matrices, (dx, dp, dr), strict=True)).max()
    np.testing.assert_allclose(model.jvp(t[0], x, dx, dp, dr, p, r), expected, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(
        model.jvp(t[0], x, dx[:, 0], p=p, r=r), matrices[0] @ dx[:, 0], rtol=0, atol=1e-12 * size
    )
    for found, matrix in zip(model.vjp(t[0], x, w, p, r), matrices, strict=True):
        np.testing.assert_allclose(found, w @ matrix, rtol=0, atol=1e-12 * np.abs(matrix).sum(axis=0).max(initial=1.0))
