"""What results have by name, as tables and as pictures of many runs."""

import csv
import sys

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from harness.archives import arrays_of
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def trajectory(four_bar):
    return four_bar.simulate((0.0, 1.0), rtol=1e-9, atol=1e-9, t_eval=np.linspace(0.0, 1.0, 11))


@pytest.fixture(scope="module")
def ensemble(four_bar):
    """Stiffnesses from 1 to 200 N m/rad, of which some end at the linkage's singular position."""
    stiffness = np.linspace(1.0, 200.0, 40)
    return four_bar.ensemble((0.0, 4.0), parameters={"k": stiffness}, t_eval=np.linspace(0.0, 4.0, 81))


def test_quantities_of_a_run_by_name_equal_its_attributes(four_bar, trajectory):
    np.testing.assert_array_equal(trajectory["t"], trajectory.t)
    np.testing.assert_array_equal(trajectory["energy"], trajectory.kinetic_energy + trajectory.potential_energy)
    np.testing.assert_array_equal(trajectory["lambda2"], trajectory.multipliers[1])
    np.testing.assert_array_equal(trajectory["constraint_residual_1"], trajectory.constraint_residual[0])
    # The end of link 2 is on a circle of 0.5 m about the pin at (0.4, 0).
    np.testing.assert_allclose(np.hypot(*(trajectory["P2"][:2] - [[0.4], [0.0]])), 0.5, atol=1e-12)
    with pytest.raises(fb.ModelError, match=r"no quantity 'q9'; there are t, q1, .*energy, .*P44"):
        trajectory["q9"]
    assert set(trajectory._ipython_key_completions_()) >= {"q1", "F", "energy", "P2"}
    saved = trajectory.columns()
    assert list(saved)[:4] == ["t", "q1", "q2", "q3"]
    assert all(trajectory[name] is not None for name in saved)
    own = fb.compile_model(fb.models.slider_crank()).simulate((0.0, 0.1))
    assert own["pin_x"].shape == own.t.shape


def test_csv_of_a_run_has_positions_of_points_and_the_units_of_what_is_derived(four_bar, tmp_path):
    """The crank's end is at (l1 / 2 + l2 cos q1, l2 sin q1)."""
    run = four_bar.simulate((0.0, 1.0))
    with run.save(tmp_path / "run.csv").open(newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    length, ground = four_bar.defaults["l2"], four_bar.defaults["l1"]
    for row in rows:
        assert row["P2.x [m]"] == pytest.approx(ground / 2 + length * np.cos(row["q1"]), abs=1e-14)
        assert row["P2.y [m]"] == pytest.approx(length * np.sin(row["q1"]), abs=1e-14)
        assert row["energy [J]"] == row["kinetic_energy [J]"] + row["potential_energy [J]"]
    assert {"t", "q1", "F", "lambda1", "momentum_x [kg m/s]", "spin_z [kg m^2/s]"} < set(rows[0])


def test_csv_keeps_a_state_that_has_the_title_of_an_energy(tmp_path):
    q, u = sm.Function("energy [J]")(me.dynamicsymbols._t), me.dynamicsymbols("u")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    system = System(frame, origin)
    point = origin.locatenew("P", q * frame.y)
    point.set_vel(frame, u * frame.y)
    system.add_bodies(me.Particle("p", point, 1.0))
    system.q_ind, system.u_ind = [q], [u]
    system.add_kdes(q.diff(me.dynamicsymbols._t) - u)
    system.add_loads((point, -q * frame.y))
    run = fb.compile_model(fb.Model(system, name="named")).simulate((0.0, 3.0), [1.0, 0.0], rtol=1e-9)
    with run.save(tmp_path / "run.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {"energy [J]", "energy", "kinetic_energy [J]"} < set(rows[0])
    assert float(rows[-1]["energy [J]"]) == pytest.approx(np.cos(3.0), abs=1e-7)  # a spring's motion
    assert float(rows[-1]["energy"]) == pytest.approx(0.5, abs=1e-7)


def test_inputs_by_member_are_in_an_ensembles_files_and_plots(four_bar, tmp_path):
    forces = np.array([1.0, 2.0, 3.0])
    runs = four_bar.ensemble((0.0, 0.5), inputs={"F": forces})
    np.testing.assert_array_equal(runs.varied["F"], forces)
    np.testing.assert_array_equal(arrays_of(runs.save(tmp_path / "f.npz"))["F"], forces)
    with runs.save(tmp_path / "f.csv").open(newline="") as file:
        assert {row["F"] for row in csv.DictReader(file)} == {"1.0", "2.0", "3.0"}
    assert runs.plot("q1").axes[1].get_ylabel() == "F"


@pytest.mark.slow
def test_ensemble_with_names_reserved_in_files_is_refused_there(tmp_path):
    parameters = {"m": 1.0, "g": 9.81, "l": 1.0}
    model = fb.Model(pendulum(), name="named", parameters=parameters, outputs={"success": me.dynamicsymbols("q")})
    runs = fb.compile_model(model).ensemble((0.0, 0.1), [[0.1, 0.0]])
    for kind in ("npz", "nc"):
        with pytest.raises(fb.ModelError, match="names success are reserved"):
            runs.save(tmp_path / f"runs.{kind}")
    assert runs.save(tmp_path / "runs.csv").exists()


def test_ensemble_whose_members_all_fail_can_be_plotted(four_bar):
    parameters = {"k": [100.0, 300.0], "c": [1.0, 2.0]}
    runs = four_bar.ensemble((0.0, 1.0), parameters=parameters, t_eval=[0.5, 1.0], max_steps=1)
    assert not runs.success.any()
    assert len(runs.plot("energy").axes) == 1


def test_plot_of_chosen_quantities_has_a_panel_for_each(trajectory):
    figure = trajectory.plot(["P2", "energy"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["P2 (m)", "energy (J)"]
    assert [line.get_label() for line in figure.axes[0].lines] == ["x", "y", "z"]
    assert len(trajectory.plot("q1").axes) == 1
    with pytest.raises(fb.ModelError, match="no quantity 'q9'"):
        trajectory.plot("q9")


def test_dataframe_of_a_run_has_all_columns_and_needs_pandas(trajectory, monkeypatch):
    frame = trajectory.to_dataframe()
    assert frame.index.name == "t"
    assert frame.loc[0.5, "q1"] == trajectory["q1"][5]
    assert set(frame) == set(trajectory.columns()) - {"t"}
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(fb.ModelError, match=r"need pandas: pip install 'fourbar_codegen\[data\]'"):
        trajectory.to_dataframe()


def test_report_in_a_notebook_is_a_frame_of_its_height(trajectory):
    page = trajectory.report(height=400)
    assert repr(page) == "<Report of four_bar, 400 pixels high>"
    shown = page._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert shown.count('"') == 6  # the page's own are escaped: none of them ends the attribute
    with pytest.raises(fb.ModelError, match="height must be"):
        trajectory.report(height=0)


def test_quantities_of_an_ensemble_by_name_equal_those_of_its_members(ensemble):
    assert 0 < ensemble.success.sum() < len(ensemble)
    failed = int(np.argmin(ensemble.success))
    for name in ("q1", "energy", "lambda1", "F", "P2"):
        values = ensemble[name]
        np.testing.assert_array_equal(values[3], ensemble[3][name])
        reached = len(ensemble[failed].t)
        np.testing.assert_array_equal(values[failed][..., :reached], ensemble[failed][name])
        assert np.isnan(values[failed][..., reached:]).all()
    assert ensemble["P2"].shape == (40, 3, 81)
    np.testing.assert_array_equal(ensemble["t"], ensemble.t)
    none = ensemble.model.ensemble((0.0, 1.0), np.empty((0, 6)))
    assert none["q1"].shape == (0, 2)
    for refused in (lambda: none["energy"], lambda: none.plot()):
        with pytest.raises(fb.ModelError, match="no members"):
            refused()


def test_ensemble_shows_members_failures_and_differences_in_its_repr(ensemble):
    failed = (~ensemble.success).sum()
    assert repr(ensemble) == (
        f"<Ensemble of four_bar: 40 members, {failed} failed, 0 s to 4 s, 81 times, different in k>"
    )


@pytest.mark.slow
def test_ensemble_saved_to_files_has_the_states_of_its_members(ensemble, tmp_path):
    with ensemble.save(tmp_path / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == np.isfinite(ensemble["q1"]).sum()
    assert list(rows[0]) == ["member", "k", "t", *ensemble.model.states]
    of_third = [row for row in rows if row["member"] == "3"]
    np.testing.assert_array_equal([float(row["q2"]) for row in of_third], ensemble[3]["q2"])
    assert {float(row["k"]) for row in of_third} == {ensemble.varied["k"][3]}
    with np.load(ensemble.save(tmp_path / "runs.npz")) as arrays:
        np.testing.assert_array_equal(arrays["u3"], ensemble["u3"])
        np.testing.assert_array_equal(arrays["k"], ensemble.varied["k"])
        assert arrays["messages"][0] == ensemble.messages[0]
    import xarray

    with xarray.open_dataset(ensemble.save(tmp_path / "runs.nc")) as dataset:
        np.testing.assert_array_equal(dataset["q1"].sel(member=3), ensemble["q1"][3])
        assert dataset.attrs["model"] == "four_bar"
        assert dataset["message"].values[0] == ensemble.messages[0]
    assert ensemble.save(tmp_path / "runs.png").stat().st_size > 10_000
    with pytest.raises(fb.ModelError, match=r"An ensemble is saved as \.csv, \.nc, \.npz, \.png"):
        ensemble.save(tmp_path / "runs.gif")
    with pytest.raises(fb.ModelError, match="no trajectory"):
        fb.load_trajectory(tmp_path / "runs.npz")


@pytest.mark.slow
def test_ensemble_as_a_dataset_has_the_outputs_of_its_members():
    crank = fb.compile_model(fb.models.slider_crank())
    runs = crank.ensemble((0.0, 0.5), parameters={"r": [0.1, 0.11]})
    dataset = runs.to_xarray()
    for member in (0, 1):
        np.testing.assert_array_equal(dataset["pin_x"].isel(member=member), runs[member]["pin_x"])


def test_plot_of_members_that_differ_in_one_parameter_is_coloured_by_it(ensemble):
    figure = ensemble.plot("q1")
    axes, bar = figure.axes
    assert bar.get_ylabel() == "k (N m/rad)"
    assert len(axes.lines) == 30
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), ensemble["q1"][0])
    assert len({line.get_color() for line in axes.lines}) == 30
    assert "failed" in figure.get_suptitle()


@pytest.mark.slow
def test_plot_of_members_that_differ_in_several_parameters_has_percentiles(four_bar):
    varied = {"k": np.linspace(1.0, 200.0, 40), "c": np.linspace(0.0, 10.0, 40)}
    ensemble = four_bar.ensemble((0.0, 4.0), parameters=varied, t_eval=np.linspace(0.0, 4.0, 81))
    figure = ensemble.plot(["q1", "energy"])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["q1 (rad)", "energy (J)"]
    median = next(line for line in figure.axes[0].lines if line.get_label() == "median")
    np.testing.assert_array_equal(median.get_ydata(), np.nanmedian(ensemble["q1"], axis=0))
    with pytest.raises(fb.ModelError, match="P2 is not a scalar"):
        ensemble.plot(["P2"])
    with pytest.raises(fb.ModelError, match="names must be"):
        ensemble.plot(5)


def test_names_of_quantities_are_in_results_and_results_are_no_sequences_of_them(four_bar):
    run = four_bar.simulate((0.0, 0.1))
    for name in ("t", "q1", "F", "energy", "lambda2", "constraint_residual_2", "momentum_x", "P2", "spin"):
        assert name in run
        assert len(run[name])
    assert {*run.columns()} <= {*run._ipython_key_completions_()}
    assert "q9" not in run
    with pytest.raises(TypeError, match="not iterable"):
        iter(run)
    ensemble = four_bar.ensemble((0.0, 0.1), parameters={"k": [1.0, 2.0]})
    assert "q1" in ensemble
    assert "q9" not in ensemble
    assert "q2" in four_bar.kinematics({"q1": [-0.5, -0.4]})[0]


def test_description_of_a_compiled_model_cannot_be_set(four_bar):
    for name in ("defaults", "states", "n_x", "kernel"):
        with pytest.raises(AttributeError, match=f"{name} describes the compiled model four_bar"):
            setattr(four_bar, name, None)
    for values in (four_bar.defaults, four_bar.units, four_bar.descriptions):
        with pytest.raises(TypeError):
            values["k"] = 1.0
