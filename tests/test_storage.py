"""Trajectories as datasets and files, and back."""

import json

import numpy as np
import pytest
import xarray

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def run(four_bar):
    return four_bar.simulate(
        (0.0, 2.0), parameters={"l2": 0.45}, inputs={"F": 3.0}, method="RK45", rtol=1e-7, t_eval=np.linspace(0, 2, 21)
    )


def test_a_dataset_has_everything_by_name(run):
    dataset = run.to_xarray()
    for name in ("q1", "q2", "q3", "u1", "u2", "u3", "F"):
        np.testing.assert_array_equal(dataset[name], run[name])
        assert dataset[name].dims == ("time",)
    np.testing.assert_array_equal(dataset["time"], run.t)
    np.testing.assert_array_equal(dataset["position"].sel(point="P2", axis="y"), run.points["P2"][1])
    np.testing.assert_array_equal(dataset["multiplier"], run.multipliers)
    np.testing.assert_array_equal(dataset["constraint_residual"], run.constraint_residual)
    assert dataset["kinetic_energy"].attrs["units"] == "J"


def test_a_datasets_attributes_make_the_run_again(run, four_bar):
    attributes = run.to_xarray().attrs
    assert attributes["fingerprint"] == four_bar.manifest["fingerprint"]
    settings = json.loads(attributes["settings"])
    again = four_bar.simulate(
        **settings, parameters=json.loads(attributes["parameters"]), inputs={"F": 3.0}, t_eval=run.t
    )
    np.testing.assert_array_equal(again.y, run.y)
    assert set(json.loads(attributes["versions"])) >= {"fourbar_codegen", "numpy", "scipy", "sympy"}


@pytest.mark.parametrize("ending", [".npz", ".nc"])
def test_there_and_back(run, four_bar, tmp_path, ending):
    path = run.save(tmp_path / f"run{ending}")
    for model in (None, four_bar):
        back = fb.load_trajectory(path, model)
        for name in ("t", "y", "r", "energy", "multipliers"):
            np.testing.assert_array_equal(getattr(back, name), getattr(run, name))
        for name in ("nfev", "njev", "nlu", "status", "success", "message"):
            assert getattr(back, name) == getattr(run, name)
            assert type(getattr(back, name)) is type(getattr(run, name))
        assert json.dumps(back.settings) == json.dumps(dict(run.settings))
    np.testing.assert_array_equal(back.resample([0.5]).y, run.resample([0.5]).y)


@pytest.mark.parametrize("ending", [".npz", ".nc"])
def test_a_run_that_ended_early(four_bar, tmp_path, ending):
    run = four_bar.simulate((0.0, 8.0))
    back = fb.load_trajectory(run.save(tmp_path / f"run{ending}"))
    assert back.success is False
    assert "singular position" in back.message


def test_netcdf_is_read_by_others(run, tmp_path):
    with xarray.open_dataset(run.save(tmp_path / "run.nc")) as dataset:
        assert float(dataset["q1"].sel(time=2.0)) == run["q1"][-1]


def test_what_cannot_be_read(run, tmp_path):
    path = run.save(tmp_path / "run.npz")
    with pytest.raises(fb.ModelError, match="another model"):
        fb.load_trajectory(path, fb.compile_model(fb.models.cartesian_pendulum()))
    other = fb.compile_model(fb.models.cartesian_pendulum()).simulate((0.0, 0.1))
    with pytest.raises(fb.ModelError, match="cartesian_pendulum"):
        fb.load_trajectory(other.save(tmp_path / "other.npz"))
    with pytest.raises(fb.ModelError, match=r"\.nc and \.npz"):
        fb.load_trajectory(run.save(tmp_path / "run.csv"))
    with pytest.raises(fb.ModelError, match="cannot be read"):
        fb.load_trajectory(tmp_path / "none.npz")
    np.savez(tmp_path / "plain.npz", t=[0.0])
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "text.nc").write_text("text")
    for name in ("plain.npz", "text.npz", "text.nc"):
        with pytest.raises(fb.ModelError, match=r"read|no trajectory|no NPZ file"):
            fb.load_trajectory(tmp_path / name)


@pytest.mark.parametrize("ending", [".npz", ".nc"])
def test_damaged_files(run, tmp_path, ending):
    whole = run.save(tmp_path / f"run{ending}").read_bytes()
    for i, content in enumerate((b"", whole[: len(whole) // 2], whole[:200])):
        path = tmp_path / f"damaged{i}{ending}"
        path.write_bytes(content)
        with pytest.raises(fb.ModelError, match=r"cannot be read|no NPZ file|no trajectory") as error:
            fb.load_trajectory(path)
        assert "pickle" not in str(error.value)


def test_settings_of_other_kinds_of_numbers(four_bar, tmp_path):
    run = four_bar.simulate((0.0, 0.1), constraints="baumgarte", stabilization=np.float32(10.0))
    assert fb.load_trajectory(run.save(tmp_path / "run.npz")).settings["stabilization"] == 10.0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of h5netcdf, for files it cannot close
def test_changed_bits(run, tmp_path):
    """Checksums of both kinds of files tell, wherever they are changed, or what is read is the same."""
    generator = np.random.default_rng(0)
    for ending in (".npz", ".nc"):
        whole = run.save(tmp_path / f"run{ending}").read_bytes()
        told = 0
        for i in range(40):
            content = bytearray(whole)
            content[generator.integers(len(content))] ^= 1 << int(generator.integers(8))
            path = tmp_path / f"changed{i}{ending}"
            path.write_bytes(content)
            try:
                back = fb.load_trajectory(path)
            except fb.ModelError:
                told += 1
            else:
                np.testing.assert_array_equal(back.y, run.y)
        assert told > 0


def test_compression_that_nobody_knows(run, tmp_path):
    content = bytearray(run.save(tmp_path / "run.npz").read_bytes())
    content[content.index(b"PK\x01\x02") + 10] = 7
    (tmp_path / "changed.npz").write_bytes(content)
    with pytest.raises(fb.ModelError, match="no trajectory"):
        fb.load_trajectory(tmp_path / "changed.npz")


def test_what_is_no_path_and_no_model(run, tmp_path):
    with pytest.raises(fb.ModelError, match="path"):
        fb.load_trajectory(None)
    with pytest.raises(fb.ModelError, match="CompiledModel"):
        fb.load_trajectory(run.save(tmp_path / "run.npz"), "four_bar")
    with pytest.raises(fb.ModelError, match="no such file"):
        fb.load_trajectory(tmp_path / "none.nc")
