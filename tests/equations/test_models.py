"""Every ready model against SymPy's own equations, evaluated as the tutorial does it."""

import numpy as np
import pytest
from tutorial import Tutorial

import fourbar_codegen as fb

EPS = np.finfo(float).eps
MODELS = {
    "cartesian pendulum": fb.models.cartesian_pendulum,
    "open chain": lambda: fb.models.chain(4),
    "closed chain": lambda: fb.models.chain(4, closed=True),
    "four-bar": fb.models.four_bar,
    "N-four-bar": lambda: fb.models.n_four_bar(2),
    "rolling disc": fb.models.rolling_disc,
    "slider-crank": fb.models.slider_crank,
    "bicycle": fb.models.whipple_bicycle,
}


def test_every_model_of_the_package_is_tested():
    assert len(MODELS) == len(fb.models.__all__) + 1  # the chain is here twice


@pytest.fixture(scope="module", params=MODELS)
def pair(request):
    """A compiled model and its reference, with inputs of 0.3, 0.6, ..."""
    model = MODELS[request.param]()
    values = {symbol: float(parameter.value) for symbol, parameter in model.parameter_symbols.items()}
    inputs = {function: (lambda t, value=0.3 * i: value) for i, function in enumerate(model.input_expressions, start=1)}
    return fb.compile_model(model), Tutorial(model.system, values, inputs)


def states(compiled, count):
    """States of all sizes around 1, off the constraint manifold, and the model's own initial state, on it."""
    generator = np.random.default_rng(11)
    # SymPy's solution of the disc's kinematics divides by sin(q3).
    spin = {"q3": 0.4} if compiled.name == "rolling_disc" else {}
    return [compiled.initial_state(spin), *(generator.uniform(-1.2, 1.2, compiled.n_x) for _ in range(count - 1))]


def tolerance(compiled, x):
    # SymPy solves with this matrix, which has the constraints' rows in it, and with it again for derivatives of what it
    # solves; a backward stable solution errs by its condition, the factor has room for matrices of eight rows.
    return 1000 * EPS * np.linalg.cond(compiled.mass_matrix(0.3, x))


@pytest.mark.slow(but=["cartesian pendulum", "slider-crank", "rolling disc"])
def test_rates_of_every_ready_model_equal_sympys(pair):
    compiled, reference = pair
    r = reference.inputs(0.3)
    for x in states(compiled, 30):
        expected = reference.rhs(0.3, x)
        error = np.abs(compiled.rhs(0.3, x, r=r) - expected).max()
        assert error <= tolerance(compiled, x) * np.abs(expected).max()


@pytest.mark.slow(but=["cartesian pendulum", "rolling disc", "slider-crank"])
def test_jacobians_of_every_ready_model_equal_complex_steps(pair):
    # Im f(x + ih) / h has no cancellation, whatever the step (Squire and Trapp 1998).
    compiled, reference = pair
    r = np.array(reference.inputs(0.3))
    p = np.array(reference.p_values)
    kept = [i for i, symbol in enumerate(reference.p) if symbol.name in compiled.parameters]
    step = 1e-30

    def rates(x, p, r):
        mass_matrix, forcing = reference.evaluate(x, p, r, 0.3)
        return np.linalg.solve(mass_matrix, forcing).ravel().imag / step

    for x in states(compiled, 6):
        scale = np.abs(reference.rhs(0.3, x)).max() + 1.0
        for derivative, columns in (
            (compiled.jacobian, [(x + 1j * step * e, p, r) for e in np.eye(len(x))]),
            (compiled.parameter_jacobian, [(x, p + 1j * step * np.eye(len(p))[i], r) for i in kept]),
            (compiled.input_jacobian, [(x, p, r + 1j * step * e) for e in np.eye(len(r))]),
        ):
            if columns:
                expected = np.column_stack([rates(*arguments) for arguments in columns])
                error = np.abs(derivative(0.3, x, r=r) - expected).max()
                assert error <= tolerance(compiled, x) * (np.abs(expected).max() + scale)


@pytest.mark.slow(but=["cartesian pendulum", "rolling disc", "slider-crank"])
def test_energy_of_every_ready_model_without_inputs_is_conserved(pair):
    compiled, _ = pair
    # The four-bar's spring and damper are no potential's: test_energy.py has more of it.
    inputs, parameters = ({"F": 0.0}, {"k": 0.0, "c": 0.0}) if compiled.name == "four_bar" else ({}, {})
    run = compiled.simulate((0.0, 0.5), parameters=parameters, inputs=inputs, rtol=1e-10, atol=1e-10)
    assert run.success
    # The error of the energy is that of some 100 steps, each of 1e-10 of the state.
    scale = np.abs(run.kinetic_energy).max() + np.abs(run.potential_energy).max()
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-7 * scale)
