"""Trajectories as datasets and files, and back."""

import importlib.machinery
import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import h5netcdf
import h5py
import numpy as np
import pytest
import xarray
from builders.systems import pendulum, slider

import fourbar_codegen as fb
from fourbar_codegen.building import toolchain
from fourbar_codegen.files import formats


@pytest.fixture(scope="module")
def run(four_bar):
    return four_bar.simulate(
        (0.0, 2.0), parameters={"l2": 0.45}, inputs={"F": 3.0}, method="RK45", rtol=1e-7, t_eval=np.linspace(0, 2, 21)
    )


def test_dataset_has_the_momentum_beside_a_point_of_that_name():
    """p = m l u across the pendulum, which turns about z."""
    system = pendulum()
    tip = system.fixed_point.locatenew("momentum", 2 * system.bodies[0].masscenter.pos_from(system.fixed_point))
    parameters = {"m": 2.0, "g": 9.81, "l": 0.5}
    model = fb.compile_model(fb.Model(system, name="tip", parameters=parameters, points=[tip]))
    found = model.simulate((0.0, 1.0), [0.3, -0.2])
    dataset = found.to_xarray()
    assert {"momentum"} < {*dataset.point.values}
    q, u = found.q[0], found.u[0]
    expected = 2.0 * 0.5 * u * np.array([-np.sin(q), np.cos(q), 0.0 * q])
    np.testing.assert_allclose(dataset["momentum"].transpose("axis", "time"), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(dataset["position"].sel(point="momentum", axis="x"), np.cos(q), rtol=0, atol=1e-14)


def test_dataset_of_a_run_has_all_quantities_by_name(run):
    dataset = run.to_xarray()
    for name in ("q1", "q2", "q3", "u1", "u2", "u3", "F"):
        np.testing.assert_array_equal(dataset[name], run[name])
        assert dataset[name].dims == ("time",)
    np.testing.assert_array_equal(dataset["time"], run.t)
    np.testing.assert_array_equal(dataset["position"].sel(point="P2", axis="y"), run.points["P2"][1])
    np.testing.assert_array_equal(dataset["multiplier"], run.multipliers)
    np.testing.assert_array_equal(dataset["constraint_residual"], run.constraint_residual)
    assert dataset["kinetic_energy"].attrs["units"] == "J"


def test_dataset_attributes_of_a_run_repeat_it_to_the_bit(run, four_bar):
    attributes = run.to_xarray().attrs
    assert attributes["fingerprint"] == four_bar.manifest["fingerprint"]
    settings = json.loads(attributes["settings"])
    again = four_bar.simulate(
        **settings, parameters=json.loads(attributes["parameters"]), inputs={"F": 3.0}, t_eval=run.t
    )
    np.testing.assert_array_equal(again.y, run.y)
    assert set(json.loads(attributes["versions"])) >= {"fourbar_codegen", "numpy", "scipy", "sympy"}


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_run_saved_and_loaded_has_the_same_values_and_settings(run, four_bar, tmp_path, suffix):
    path = run.save(tmp_path / f"run{suffix}")
    for model in (None, four_bar):
        back = fb.load_trajectory(path, model)
        for name in ("t", "y", "r", "energy", "multipliers"):
            np.testing.assert_array_equal(getattr(back, name), getattr(run, name))
        for name in ("nfev", "njev", "nlu", "status", "success", "message"):
            assert getattr(back, name) == getattr(run, name)
            assert type(getattr(back, name)) is type(getattr(run, name))
        assert back.settings == dict(run.settings)
    np.testing.assert_array_equal(back.resample([0.5]).y, run.resample([0.5]).y)


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_run_that_ended_early_is_loaded_with_its_message(four_bar, tmp_path, suffix):
    run = four_bar.simulate((0.0, 8.0))
    back = fb.load_trajectory(run.save(tmp_path / f"run{suffix}"))
    assert back.success is False
    assert "singular position" in back.message


def test_netcdf_file_of_a_run_is_read_by_xarray(run, tmp_path):
    with xarray.open_dataset(run.save(tmp_path / "run.nc")) as dataset:
        assert float(dataset["q1"].sel(time=2.0)) == run["q1"][-1]


def test_files_that_are_no_trajectories_or_of_other_models_are_refused(run, tmp_path):
    path = run.save(tmp_path / "run.npz")
    with pytest.raises(fb.ModelError, match="another model"):
        fb.load_trajectory(path, fb.compile_model(fb.models.cartesian_pendulum()))
    with pytest.raises(fb.ModelError, match=r"\.nc and \.npz"):
        fb.load_trajectory(run.save(tmp_path / "run.csv"))
    with pytest.raises(fb.ModelError, match="cannot be read"):
        fb.load_trajectory(tmp_path / "none.npz")
    np.savez(tmp_path / "plain.npz", t=[0.0])
    (tmp_path / "text.npz").write_text("text")
    (tmp_path / "text.nc").write_text("text")
    said = {"plain.npz": "holds no trajectory", "text.npz": "is not an NPZ file", "text.nc": "cannot be read"}
    for name, words in said.items():
        with pytest.raises(fb.ModelError, match=f"{name} {words}"):
            fb.load_trajectory(tmp_path / name)


@pytest.fixture(scope="module")
def slider_run():
    """Of a model that does not come with the package."""
    model = fb.compile_model(slider())
    return model.simulate((0.0, 0.1), model.initial_state({"q1": 0.48}, {"u1": 0.0}), inputs={"F": 1.0})


def changed_file(run, path, changed=(), **attributes):
    """The file of a run, with other arrays and attributes."""
    with np.load(run.save(path)) as file:
        arrays = {**file, **{name: np.array(values) for name, values in dict(changed).items()}}
    arrays["run_attributes"] = np.array(json.dumps({**json.loads(str(arrays["run_attributes"])), **attributes}))
    np.savez(path, **arrays)
    return path


def test_trajectory_of_a_cached_model_is_loaded_without_naming_it(slider_run, tmp_path, monkeypatch):
    path = slider_run.save(tmp_path / "run.npz")
    back = fb.load_trajectory(path)
    np.testing.assert_array_equal(back.energy, slider_run.energy)
    model = slider_run.model
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "empty"))
    with pytest.raises(fb.ModelError, match=r"'slider'.*model=compile_model"):
        fb.load_trajectory(path)
    assert fb.load_trajectory(path, model).model is model


STRANGER = "from pathlib import Path\nPath(__file__).with_name('ran').touch()\n"


@pytest.mark.slow(but=["another", "list", "deep"])
@pytest.mark.parametrize(
    "manifest",
    [None, "[]", "{", "[" * 100_000, '{"name": "stranger", "fingerprint": "another"}', '{"name": "slider"}'],
    ids=["none", "list", "broken", "deep", "another", "no fingerprint"],
)
def test_trajectory_that_names_packages_or_libraries_does_not_run_them(four_bar, tmp_path, monkeypatch, manifest):
    """Neither packages, by their names, nor libraries, by their paths."""
    run = four_bar.simulate((0.0, 0.1))
    package = tmp_path / "stranger"
    package.mkdir()
    for name in ("__init__", "stranger"):
        (package / f"{name}.py").write_text(STRANGER)
    library = package / f"stranger{importlib.machinery.EXTENSION_SUFFIXES[0]}"
    source = '#include <stdio.h>\n__attribute__((constructor)) static void run(void) { fclose(fopen(RAN, "w")); }\n'
    command = ["gcc", "-shared", "-fPIC", f'-DRAN="{package / "ran"}"', "-x", "c", "-", "-o", library]
    subprocess.run(command, input=source, text=True, check=True)
    if manifest is not None:
        (package / "manifest.json").write_text(manifest)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("stranger", str(library), "stranger/stranger", "../stranger", "", "this", "fourbar_codegen"):
        for fingerprint in (four_bar.manifest["fingerprint"], ""):
            path = changed_file(run, tmp_path / "run.npz", model=name, fingerprint=fingerprint)
            with pytest.raises(fb.ModelError, match="is not in the package, not installed from a wheel"):
                fb.load_trajectory(path)
    if manifest is None or "another" not in manifest:  # which is what a model looks like
        with pytest.raises(fb.ModelError, match="no compiled model"):
            fb.load("stranger")
    assert "this" not in sys.modules
    assert "stranger" not in sys.modules
    assert not (package / "ran").exists()
    with pytest.raises(fb.ModelError, match="cannot be loaded"):  # the path is the caller's
        fb.load(library)
    assert (package / "ran").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("unoptimized")
def test_trajectory_of_an_installed_model_finds_it_but_not_in_the_current_folder(slider_run, tmp_path):
    wheel = fb.build_wheel(slider(), tmp_path / "dist")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    path = slider_run.save(tmp_path / "run.npz")
    code = (
        f"import fourbar_codegen as fb; print(fb.load_trajectory({str(path)!r}).model.path.parent)\n"
        "import slider, slider.slider"  # the package is there as before
    )

    def elsewhere(folder, **environment):
        command = [sys.executable, "-c", code]
        return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)

    environment = {"FOURBAR_CODEGEN_CACHE": str(tmp_path / "empty"), "PATH": ""}
    installed = tmp_path / "installed"
    done = elsewhere(tmp_path, **environment, PYTHONPATH=str(installed))
    assert done.stdout == f"{installed / 'slider'}\n", done.stderr
    assert "is not in the package, not installed from a wheel" in elsewhere(installed, **environment).stderr


@pytest.mark.parametrize("suffix", [".npz", ".nc"])
def test_truncated_files_of_trajectories_are_refused(run, tmp_path, suffix):
    whole = run.save(tmp_path / f"run{suffix}").read_bytes()
    for i, content in enumerate((b"", whole[: len(whole) // 2], whole[:200])):
        path = tmp_path / f"damaged{i}{suffix}"
        path.write_bytes(content)
        with pytest.raises(fb.ModelError, match=r"cannot be read|not an NPZ file|no trajectory") as error:
            fb.load_trajectory(path)
        assert "pickle" not in str(error.value)


WRONG = {
    "times that are text": ({"t": ["a"] * 21}, {}, "its t is no row of real numbers"),
    "times that turn back": ({"t": [0.0, 2.0, 1.0] * 7}, {}, "one direction"),
    "times that are not finite": ({"t": [0.0] * 20 + [np.nan]}, {}, "not finite"),
    "fewer times": ({"t": [0.0, 1.0]}, {}, "21 values for 2 times"),
    "two dimensions": ({"q1": np.zeros((21, 2))}, {}, "its q1 is no row"),
    "complex states": ({"q1": np.zeros(21, complex)}, {}, "its q1 is no row"),
    "states that are text": ({"u2": ["1.0"] * 21}, {}, "its u2 is no row"),
    "settings that are a list": ({}, {"settings": []}, "settings is no dict"),
    "settings that say nothing": ({}, {"settings": {}}, "'constraints' is missing"),
    "no settings": ({}, {"settings": None}, "settings is no dict"),
    "a parameter beyond all floats": ({}, {"parameters": {"l2": 10**400}}, "parameter l2 is no finite number"),
    "a parameter that is text": ({}, {"parameters": {"l2": "1"}}, "parameter l2 is no finite number"),
    "a parameter that is not finite": ({}, {"parameters": {"l2": float("nan")}}, "parameter l2 is no finite number"),
    "a parameter that is a truth": ({}, {"parameters": {"l2": True}}, "parameter l2 is no finite number"),
    "a count beyond all integers": ({}, {"nfev": 10**400}, "nfev is no int"),
    "a success that is text": ({}, {"success": "no"}, "success is no bool"),
    "a name that is a number": ({}, {"model": 3}, "model is no str"),
    "a fingerprint that is a list": ({}, {"fingerprint": [1]}, "fingerprint is no str"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_files_with_entries_that_no_run_has_are_refused(run, tmp_path, wrong):
    changed, entries, sentence = WRONG[wrong]
    parameters = json.loads(run.to_xarray().attrs["parameters"])
    entries = {k: {**parameters, **v} if k == "parameters" else v for k, v in entries.items()}
    path = changed_file(run, tmp_path / "run.npz", changed, **entries)
    with pytest.raises(fb.ModelError, match=f"holds no trajectory that fourbar_codegen has saved: .*{sentence}"):
        fb.load_trajectory(path)


def test_netcdf_file_with_wrong_settings_is_refused(run, tmp_path):
    path = run.save(tmp_path / "run.nc")
    with h5netcdf.File(path, "a") as file:
        file.attrs["settings"] = "[]"
    with pytest.raises(fb.ModelError, match="there is list"):
        fb.load_trajectory(path)


@pytest.mark.parametrize("kind", ["link", "soft link", "external", "virtual"])
def test_netcdf_file_whose_variables_lie_in_other_files_is_refused(run, tmp_path, kind):
    """HDF5 has four ways to say that a variable lies elsewhere."""
    secret = np.full(run.t.shape, 42.0)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["q1"] = secret
    (tmp_path / "raw").write_bytes(secret.tobytes())
    path = run.save(tmp_path / "run.nc")
    with h5py.File(path, "a") as file:
        del file["q1"]
        if kind == "link":
            file["q1"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "q1")
        elif kind == "soft link":
            file["q1"] = h5py.SoftLink("/q2")
        elif kind == "external":
            place = [(str(tmp_path / "raw"), 0, h5py.h5f.UNLIMITED)]
            file.create_dataset("q1", shape=secret.shape, dtype="f8", external=place)
        else:
            layout = h5py.VirtualLayout(shape=secret.shape, dtype="f8")
            layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "q1", shape=secret.shape)
            file.create_virtual_dataset("q1", layout)
    with pytest.raises(fb.ModelError, match="its q1 is"):
        fb.load_trajectory(path)


def test_files_whose_headers_claim_more_than_there_is_are_refused(run, tmp_path):
    """Eight terabytes, in some kilobytes."""
    path = run.save(tmp_path / "run.npz")
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**members, "t.npy": header.getvalue() + bytes(80)}.items():
            archive.writestr(name, content)
    with pytest.raises(fb.ModelError, match="holds no trajectory"):
        fb.load_trajectory(path)

    path = tmp_path / "run.nc"
    with h5netcdf.File(path, "w") as file:
        file.dimensions = {"time": 10**12}
        file.create_variable("time", ("time",), "f8", chunks=(1024,))
    with pytest.raises(fb.ModelError, match="its time claims 1000000000000 values, for which the file is too small"):
        fb.load_trajectory(path)


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_npz_file_with_damaged_compressed_data_is_refused(run, tmp_path, method):
    """Every decoder has an error of its own."""
    path = run.save(tmp_path / "run.npz")
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    np.testing.assert_array_equal(fb.load_trajectory(path).y, run.y)
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        first = archive.getinfo("t.npy")
    start = first.header_offset + 30 + len("t.npy")
    content[start : start + first.compress_size] = b"\xff" * first.compress_size
    path.write_bytes(content)
    with pytest.raises(fb.ModelError, match=r"cannot be read|holds no trajectory"):
        fb.load_trajectory(path)


@pytest.mark.slow
def test_netcdf_file_with_a_damaged_heap_is_refused(run, tmp_path):
    """HDF5 2.0.0 goes through the objects of a global heap for ever if one of them takes no space."""
    path = tmp_path / "run.nc"
    run.to_xarray().to_netcdf(path, engine="h5netcdf")
    fb.load_trajectory(path)
    content = bytearray(path.read_bytes())
    first = content.index(b"GCOL\x01") + 16
    content[first : first + 16] = bytes(16)
    path.write_bytes(content)
    with pytest.raises(fb.ModelError, match="the heap of its texts is damaged"):
        fb.load_trajectory(path)


@pytest.mark.slow
@pytest.mark.usefixtures("unoptimized")
def test_paths_that_no_file_can_have_are_refused_and_odd_ones_written(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for path in (None, 3, b"run.npz", ["run.npz"], "run\0.npz", "run\ud800.npz"):
        for use in (run.save, fb.load_trajectory, fb.load, lambda p: fb.build_model(fb.models.four_bar(), p)):
            with pytest.raises(fb.ModelError, match="path"):
                use(path)
    for path in ("n" * 5000 + ".npz", "n/" * 2500 + "run.npz"):
        for use in (run.save, fb.load_trajectory, fb.load):
            with pytest.raises(fb.ModelError, match="File name too long"):
                use(path)
    with pytest.raises(fb.BuildError, match="File name too long"):
        toolchain.write_sources("model", {"model.c": ""}, Path("n" * 5000))
    assert list(tmp_path.iterdir()) == []
    for suffix in (".csv", ".npz", ".nc", ".html", ".png", ".gif"):
        path = run.resample([0.0, 0.1]).save(os.fsdecode(b"\xff\n" + suffix.encode()))  # a name, if a strange one
        assert path.is_file()
        if suffix in (".npz", ".nc"):
            assert len(fb.load_trajectory(path).t) == 2


def test_settings_of_other_kinds_of_numbers_are_saved_and_loaded(four_bar, tmp_path):
    run = four_bar.simulate((0.0, 0.1), constraints="baumgarte", stabilization=np.float32(10.0))
    assert fb.load_trajectory(run.save(tmp_path / "run.npz")).settings["stabilization"] == 10.0


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of h5netcdf, for files it cannot close
def test_files_with_changed_bits_are_refused_or_read_unchanged(run, tmp_path):
    """Checksums of both kinds of files tell, wherever they are changed, or what is read is the same."""
    generator = np.random.default_rng(0)
    for suffix in (".npz", ".nc"):
        whole = run.save(tmp_path / f"run{suffix}").read_bytes()
        told = 0
        for i in range(40):
            content = bytearray(whole)
            content[generator.integers(len(content))] ^= 1 << int(generator.integers(8))
            path = tmp_path / f"changed{i}{suffix}"
            path.write_bytes(content)
            try:
                back = fb.load_trajectory(path)
            except fb.ModelError:
                told += 1
            else:
                np.testing.assert_array_equal(back.y, run.y)
        assert told > 0


def test_npz_file_with_an_unknown_compression_is_refused(run, tmp_path):
    content = bytearray(run.save(tmp_path / "run.npz").read_bytes())
    content[content.index(b"PK\x01\x02") + 10] = 7
    (tmp_path / "changed.npz").write_bytes(content)
    with pytest.raises(fb.ModelError, match="no trajectory"):
        fb.load_trajectory(tmp_path / "changed.npz")


@pytest.mark.slow
def test_files_that_exceed_the_disk_leave_the_old_ones_with_a_message(tmp_path):
    """Told in a sentence; what was there stays, and nothing comes beside it."""
    code = f"""
import resource, signal
import fourbar_codegen as fb
run = fb.load("four_bar").simulate((0.0, 1.0))
run.to_xarray()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
for suffix in ("csv", "npz", "nc", "html"):
    try:
        run.save(f"{tmp_path}/run.{{suffix}}")
    except fb.ModelError as error:
        print(error)
"""
    suffixes = ("csv", "npz", "nc", "html")
    for suffix in suffixes:
        (tmp_path / f"run.{suffix}").write_text("old")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        f"{tmp_path}/run.{suffix} cannot be written: File too large." for suffix in suffixes
    ]
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {f"run.{e}": "old" for e in suffixes}


def test_failed_write_leaves_the_old_file(four_bar, tmp_path, monkeypatch):
    run = four_bar.simulate((0.0, 0.1))
    path = run.save(tmp_path / "run.csv")
    old = path.read_text()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("csv.writer", full)
    with pytest.raises(fb.ModelError, match="No space left"):
        run.save(path)
    assert path.read_text() == old
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


def test_new_format_of_files_is_one_file(run, tmp_path, monkeypatch):
    folder = tmp_path / "formats"
    folder.mkdir()
    (folder / "count.py").write_text(
        "def write_trajectory(trajectory, file):\n    file.write(str(len(trajectory.t)).encode())\n"
    )
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(folder)])
    monkeypatch.delitem(sys.modules, f"{formats.__name__}.count", raising=False)
    assert run.save(tmp_path / "run.count").read_text() == str(len(run.t))
    with pytest.raises(fb.ModelError, match=r"saved as \.csv, .*\.count"):
        run.save(tmp_path / "run.other")
    sys.modules.pop(f"{formats.__name__}.count")
