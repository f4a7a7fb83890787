"""Fits: against SciPy's curve_fit on closed forms, and measurements that the model made."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import driven_oscillator, loaded, oscillator
from scipy.linalg import expm
from scipy.optimize import curve_fit

import fourbar_codegen as fb

TRUE = {"k": 3.0, "c": 1.5, "l2": 0.45, "q1": -0.4}
GUESS = {"k": 2.0, "c": 1.0, "l2": 0.47, "q1": -0.45}


@pytest.fixture(scope="module")
def noisy():
    """An oscillator, x = a cos(w t), measured with errors."""
    t = np.linspace(0.0, 6.0, 121)
    model = fb.compile_model(oscillator())
    return model, t, 0.3 * np.cos(2.1 * t) + 0.01 * np.random.default_rng(1).normal(size=t.size)


def test_standard_errors_of_a_fit_at_a_steady_motion_equal_the_closed_form():
    """Where x' does not change, S = exp(f_x t) S0, and the error of one estimate is sigma / |S|."""
    model, t = fb.compile_model(fb.models.whipple_bicycle()), np.linspace(0.0, 2.0, 41)
    x0, by = model.initial_state(derivatives=True)
    roll = [(expm(model.jacobian(0.0, x0) * time) @ by["u7"])[model.states.index("q4")] for time in t]
    measured = 1e-3 * np.random.default_rng(0).normal(size=t.size)
    found = fb.fit(model, {"t": t, "q4": measured}, {"u7": 0.0}, sigma={"q4": 1e-3})
    # the motion near the estimate is linear to the square of roll rates of 1e-3
    assert found.stderr["u7"] == pytest.approx(1e-3 / np.linalg.norm(roll), rel=1e-4)
    assert found.values["u7"] == pytest.approx(measured @ roll / (np.transpose(roll) @ roll), rel=1e-3)


@pytest.mark.slow
def test_fit_from_a_tiny_or_zero_guess_finds_the_parameter():
    """The first trust region of SciPy has the size of the guess, below which no change counted as progress."""
    model = fb.compile_model(driven_oscillator(parameters={"F_0": 0.0}, force=sm.Symbol("F_0")))
    t = np.linspace(0.0, 5.0, 51)
    measured = (1.0 - np.cos(2.0 * t)) * 0.2 / 8.0  # x = (F_0 / k) (1 - cos(w t))
    for guess, bounds in ((0.0, None), (1e-12, None), (-1e-9, None), (1e-3, None), (0.0, (0.0, 20.0)), (20.0, (0, 20))):
        how = {} if bounds is None else {"bounds": {"F_0": bounds}}
        found = fb.fit(model, {"t": t, "x": measured}, {"F_0": guess}, **how)
        assert found.success
        assert found.values["F_0"] == pytest.approx(0.2, rel=1e-6)  # the runs' tolerance of 1e-8, accumulated


def test_fit_of_micrometres_finds_stiffness_and_amplitude():
    """The gradient of the sum of squares has units: SciPy's limit of 1e-8 for it left guesses as they were."""
    t = np.linspace(0.0, 6.0, 121)
    small = fb.compile_model(oscillator())
    measured = 1e-6 * np.cos(2.1 * t)  # metres; k = m w^2 = 8.82
    found = fb.fit(small, {"t": t, "x": measured}, {"k": 8.0, "x": 2e-6}, atol=1e-15)
    assert found.values == pytest.approx({"k": 2.0 * 2.1**2, "x": 1e-6}, rel=1e-6)


def test_fit_with_an_estimate_of_zero_reports_finite_standard_errors():
    t = np.linspace(0.0, 6.0, 121)
    found = fb.fit(fb.compile_model(oscillator()), {"t": t, "v": -0.2 * np.sin(2.0 * t)}, {"x": 0.1, "v": 0.3})
    assert found.values["v"] == pytest.approx(0.0, abs=1e-6)
    assert np.isfinite([*found.stderr.values()]).all()
    assert "do not determine" not in found.message


@pytest.mark.slow(but=["0.1", "1e-09", "1e-12"])
@pytest.mark.parametrize("guess", [0.0, 1e-12, 1e-9, 0.1])
def test_fit_of_zero_beside_a_large_offset_is_right_from_any_guess(guess):
    """Also beside a constant that is large: where an oscillator is on a line, with a standard deviation of 0.01."""
    offset, t, x = 1e6, np.linspace(0.0, 6.0, 121), me.dynamicsymbols("x")
    given = {"parameters": {"m": 2.0, "k": 8.0}, "initial": {"x": 0.0, "v": 0.0}, "outputs": {"place": offset + x}}
    model = fb.compile_model(fb.Model(oscillator().system, name="far", **given))
    noise = 0.01 * np.random.default_rng(0).normal(size=t.size)
    by_speed = np.sin(2.0 * t) / 2.0
    found = fb.fit(
        model, fb.Experiment(t, {"place": offset + noise}), {"v": guess}, bounds={"v": (0, 1)}, sigma={"place": 0.01}
    )
    assert found.values["v"] == pytest.approx(max(by_speed @ noise / (by_speed @ by_speed), 0.0), abs=1e-6)
    assert found.stderr["v"] == pytest.approx(0.01 / np.linalg.norm(by_speed), rel=1e-6)


def test_fit_with_an_unknown_without_effect_names_it_and_finds_the_other(four_bar):
    """Without spring, damper and force, the density does not matter: its derivatives are rounding errors."""
    known = {"parameters": {"k": 0.0, "c": 0.0}, "inputs": {"F": 0.0}}
    t = np.linspace(0.0, 2.0, 101)
    falling = four_bar.simulate((0.0, 2.0), t_eval=t, rtol=1e-10, atol=1e-12, **known)
    found = fb.fit(four_bar, fb.Experiment(t, {"q1": falling["q1"]}, **known), {"g": 9.0, "rho": 2.0})
    assert found.values == pytest.approx({"g": 9.81, "rho": 2.0}, rel=1e-6)
    assert found.stderr["rho"] == np.inf
    assert found.stderr["g"] < 1e-5
    assert "do not determine rho" in found.message


def test_fit_of_mass_and_stiffness_finds_their_ratio_with_infinite_errors(noisy):
    """An oscillator's mass and stiffness: the ratio is that of a fit of one of them."""
    model, t, x = noisy
    both = fb.fit(model, {"t": t, "x": x}, {"m": 2.5, "k": 7.0, "x": 0.2})
    one = fb.fit(model, {"t": t, "x": x}, {"k": 7.0, "x": 0.2})
    assert both.values["k"] / both.values["m"] == pytest.approx(one.values["k"] / 2.0, rel=1e-6)
    assert both.stderr["k"] == both.stderr["m"] == np.inf
    assert both.stderr["x"] == pytest.approx(one.stderr["x"], rel=1e-2)  # m - n is one less


@pytest.mark.slow
def test_fit_from_a_guess_without_effect_or_derivative_is_refused():
    t, load = np.linspace(0.0, 1.0, 11), lambda x, v, _: -sm.Symbol("a") * sm.sqrt(x**2 + v**2)
    model = fb.compile_model(oscillator())
    with pytest.raises(fb.ModelError, match="the measured quantities do not change with k: give another guess"):
        fb.fit(model, fb.Experiment(t, {"x": t}, coordinates={"x": 0.0}), ["k"])
    with pytest.raises(fb.SimulationError, match=r"have no derivatives there\..*not finite from t = "):
        fb.fit(loaded(load), {"t": t, "x": 0.0 * t}, {"a": 1.0, "x": 0.0, "v": 0.0})


def closed_form(t, k, x):
    return x * np.cos(np.sqrt(k / 2.0) * t)


@pytest.mark.parametrize("sigma", [None, 0.02])
def test_fit_with_and_without_sigma_equals_curve_fit_with_its_covariance(noisy, sigma):
    model, t, x = noisy
    of_scipy = {} if sigma is None else {"sigma": np.full(t.size, sigma), "absolute_sigma": True}
    expected, covariance = curve_fit(closed_form, t, x, [8.0, 0.2], xtol=1e-12, ftol=1e-12, **of_scipy)
    found = fb.fit(
        model, {"t": t, "x": x}, {"k": 8.0, "x": 0.2}, sigma=None if sigma is None else {"x": sigma}, rtol=1e-10
    )
    assert found.success
    assert [*found.values.values()] == pytest.approx(expected, rel=1e-6)  # where both iterations end
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-4)  # curve_fit's Jacobian is of differences
    assert [*found.stderr.values()] == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
    np.testing.assert_allclose(found.residuals[0]["x"], closed_form(t, *expected) - x, rtol=0, atol=1e-7)
    assert found.runs[0].t.tolist() == t.tolist()


@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy", "arctan"])
def test_fit_with_a_robust_loss_and_outliers_equals_curve_fit(noisy, loss):
    model, t, x = noisy
    spoiled = x.copy()
    spoiled[::20] += 1.0
    how = {"sigma": np.full(t.size, 0.01), "method": "trf", "loss": loss, "xtol": 1e-12, "ftol": 1e-12}
    expected, _ = curve_fit(closed_form, t, spoiled, [8.0, 0.2], **how)
    found = fb.fit(model, {"t": t, "x": spoiled}, {"k": 8.0, "x": 0.2}, loss=loss, sigma={"x": 0.01})
    assert [*found.values.values()] == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_standard_errors_with_outliers_equal_the_scatter_of_many_fits(noisy, loss):
    model, t, _ = noisy
    generator, estimates, errors = np.random.default_rng(2), [], []
    for _ in range(200):
        x = closed_form(t, 8.82, 0.3) + 0.01 * generator.normal(size=t.size)
        x[generator.random(t.size) < 0.05] += 0.3
        found = fb.fit(model, {"t": t, "x": x}, {"k": 8.8, "x": 0.3}, loss=loss, sigma={"x": 0.01})
        estimates.append([*found.values.values()])
        errors.append([*found.stderr.values()])
    # a standard deviation of 200 values is uncertain by 5 %
    np.testing.assert_allclose(np.mean(errors, axis=0), np.std(estimates, axis=0), rtol=0.15)


def measured(model, t, values, speeds, **how):
    p = {name: value for name, value in values.items() if name in model.parameters}
    x0 = model.initial_state({"q1": values["q1"]}, speeds, parameters=p)
    return model.simulate((t[0], t[-1]), x0, parameters=p, t_eval=t, rtol=1e-11, atol=1e-12, **how)


def test_fit_of_several_experiments_finds_common_parameters_and_own_initial_values(four_bar):
    t, later = np.linspace(0.0, 2.0, 81), np.linspace(1.0, 2.0, 31)
    first = measured(four_bar, t, TRUE, {"u1": -0.1})
    second = measured(four_bar, later, TRUE | {"q1": -0.2}, {"u1": 0.1}, inputs={"F": 0.5})
    found = fb.fit(
        four_bar,
        [
            fb.Experiment(t, {"q2": first["q2"], "u3": first["u3"]}, speeds={"u1": -0.1}),
            fb.Experiment(later, {"q3": second["q3"]}, speeds={"u1": 0.1}, inputs={"F": 0.5}),
        ],
        GUESS,
        bounds={"l2": (0.3, 0.6), "q1": (-1.0, 0.0)},
    )
    wanted = {"k": 3.0, "c": 1.5, "l2": 0.45, "q1 (1)": -0.4, "q1 (2)": -0.2}
    assert list(found.values) == list(wanted)
    assert [*found.values.values()] == pytest.approx([*wanted.values()], abs=1e-6)
    assert max(np.abs(left).max() for each in found.residuals for left in each.values()) < 1e-7


def test_fit_with_a_guess_near_another_assembly_mode_follows_that_mode(four_bar):
    t, (_, other) = np.linspace(0.0, 2.0, 81), four_bar.initial_states({"q1": -0.4}, {"u1": -0.1}).x
    run = four_bar.simulate((0.0, 2.0), other, t_eval=t, parameters={"k": 3.0}, rtol=1e-11, atol=1e-12)
    how = {"coordinates": {"q1": -0.4}, "speeds": {"u1": -0.1}}
    given = dict(zip(four_bar.coordinates[1:], other[1:3] + 0.2, strict=True))
    found = fb.fit(four_bar, fb.Experiment(t, {"q2": run["q2"]}, guess=given, **how), {"k": 2.0})
    assert found.values["k"] == pytest.approx(3.0, rel=1e-6)
    np.testing.assert_allclose(found.residuals[0]["q2"], 0.0, rtol=0, atol=1e-7)
    assert fb.fit(four_bar, fb.Experiment(t, {"q2": run["q2"]}, **how), {"k": 2.0}).cost > 1.0


@pytest.mark.slow
def test_fit_of_an_output_that_depends_on_the_parameter_finds_it(noisy):
    _, t, _ = noisy
    model = oscillator()
    k, (x,) = sm.Symbol("k"), model.system.q
    spring = fb.compile_model(
        fb.Model(
            model.system,
            name="spring",
            parameters={"m": 2.0, "k": 8.0},
            initial={"x": 0.3, "v": 0.0},
            outputs={"force": -k * x},
        )
    )
    force = -9.0 * 0.3 * np.cos(np.sqrt(9.0 / 2.0) * t)
    found = fb.fit(spring, {"t": t, "force": force}, ["k", "x"])
    assert found.values == pytest.approx({"k": 9.0, "x": 0.3}, rel=1e-6)


def test_fit_of_undetermined_unknowns_names_them_with_infinite_errors(noisy):
    model, t, x = noisy
    found = fb.fit(model, {"t": t, "x": x}, {"k": 8.0, "m": 2.0, "x": 0.3})  # only k / m matters
    assert "do not determine k, m." in found.message
    assert [np.isinf(found.stderr[name]) for name in ("k", "m", "x")] == [True, True, False]


def test_fit_that_ends_at_a_bound_names_the_unknown(noisy):
    model, t, x = noisy
    found = fb.fit(model, {"t": t, "x": x}, ["k", "x"], bounds={"k": (7.0, 8.5)})  # it is 9
    assert "At a bound: k." in found.message
    assert found.values["k"] == pytest.approx(8.5, rel=1e-6)


def test_fit_of_a_data_frame_by_column_or_index_equals_one_of_a_dict(noisy):
    pandas = pytest.importorskip("pandas")
    model, t, x = noisy
    by_column = fb.fit(model, pandas.DataFrame({"t": t, "x": x}), ["k", "x"])
    by_index = fb.fit(model, pandas.DataFrame({"x": x}, index=t), ["k", "x"])
    assert by_column.values == by_index.values == fb.fit(model, {"t": t, "x": x}, ["k", "x"]).values


def test_fit_shows_measurements_run_and_estimates_in_plot_and_repr(noisy):
    pytest.importorskip("matplotlib")
    model, t, x = noisy
    found = fb.fit(model, {"t": t, "x": x}, ["k", "x"])
    dots, line = found.plot().axes[0].lines
    np.testing.assert_allclose(dots.get_ydata(), x, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(line.get_ydata(), found.runs[0]["x"])
    assert "k = " in repr(found)
    assert "<table" in found._repr_html_()


def test_fit_from_a_guess_whose_loops_do_not_close_is_refused(four_bar):
    t = np.linspace(0.0, 1.0, 11)
    with pytest.raises(fb.SimulationError, match="The first guess cannot be used: The loops do not close"):
        fb.fit(four_bar, {"t": t, "q2": t}, {"l2": 50.0})


def test_fit_of_chosen_outputs_takes_data_with_other_columns(four_bar):
    t = np.linspace(0.0, 1.0, 11)
    assert fb.fit(four_bar, {"t": t, "q2": t, "note": ["a"] * 11}, ["k"], outputs=["q2"], max_nfev=1).nfev == 1
