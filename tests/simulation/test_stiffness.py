"""Explicit runs whose steps are limited by stability say so: on y' = -k (y - cos t), and on a published problem."""

import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import oscillator
from builders.state_equations import first_order, hires

import fourbar_codegen as fb

STABILITY = {"DOP853": 6.393, "RK45": 3.306, "Tsit5": 3.506}
"""Of x' = -k x: the largest k h of steps that do not grow, from the polynomials that the tableaus give."""

SENTENCE = "The equations are stiff"


@pytest.fixture(scope="module")
def relaxation():
    """y' = -k (y - cos t), whose solution follows cos t for large k."""
    k = sm.Symbol("k")
    model = first_order("relaxation", lambda y: [-k * (y - sm.cos(me.dynamicsymbols._t))], [1.0], parameters={k: 500.0})
    return fb.compile_model(model)


@pytest.mark.parametrize("method", STABILITY)
def test_a_run_that_stability_limits_says_so(relaxation, method):
    """Its steps are those of the border: k t / (k h), which vary by a few per cent."""
    run = relaxation.simulate((0.0, 20.0), method=method, rtol=1e-3, atol=1e-3)
    assert run.success
    assert f"stability limits the steps of {method}" in run.message
    assert 'method="Radau"' in run.message
    assert run.message.count(SENTENCE) == 1
    assert len(run.t) - 1 == pytest.approx(500.0 * 20.0 / STABILITY[method], rel=0.01)


@pytest.mark.parametrize("method", STABILITY)
def test_a_run_that_the_tolerance_limits_does_not(relaxation, method):
    """The eigenvalue is 1/s here, and steps of a fine tolerance are ten times shorter than at the border."""
    run = relaxation.simulate((0.0, 200.0), method=method, rtol=1e-12, atol=1e-13, parameters={"k": 1.0})
    assert len(run.t) - 1 > 1000 or method == "DOP853"
    assert SENTENCE not in run.message


def test_a_published_stiff_problem_that_ends_early():
    """E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.10."""
    model = fb.compile_model(first_order("hires", hires, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057]))
    run = model.simulate((0.0, 321.8122), max_steps=3000)
    assert not run.success
    assert SENTENCE in run.message
    assert "max_steps" in run.message


@pytest.mark.parametrize("method", STABILITY)
def test_fast_vibrations_are_not_stiff_however_their_units_differ(method):
    """x = 0.3 cos 1e4 t, whose speed is 1e4 times as large: steps follow the vibration, and Radau would take more."""
    run = fb.compile_model(oscillator()).simulate(
        (0.0, 1.0), parameters={"k": 2e8}, method=method, rtol=1e-6, atol=1e-6
    )
    assert len(run.t) > 9000
    assert SENTENCE not in run.message


def test_other_runs_do_not(relaxation):
    """One of few steps; one by Radau; one with derivatives, which Radau has not; a mechanism's."""
    assert SENTENCE not in relaxation.simulate((0.0, 1.0)).message
    assert SENTENCE not in relaxation.simulate((0.0, 20.0), method="Radau").message
    assert SENTENCE not in relaxation.simulate((0.0, 20.0), sensitivities=["k"]).message
    chain = fb.compile_model(fb.models.chain(2))
    run = chain.simulate((0.0, 60.0), method="Tsit5", rtol=1e-9, atol=1e-10)
    assert len(run.t) > 3000
    assert SENTENCE not in run.message
