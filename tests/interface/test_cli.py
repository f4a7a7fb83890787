"""The command line, as a user calls it."""

import csv
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from harness.archives import arrays_of

import fourbar_codegen as fb
from fourbar_codegen.cli import main
from fourbar_codegen.files.formats import nc


def run(*arguments):
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.mark.slow
def test_simulate_with_several_outputs_writes_each_file(tmp_path, four_bar):
    paths = [tmp_path / name for name in ("run.csv", "run.npz", "run.png")]
    result = run("simulate", "-p", "l2=0.45", "-t", 0, 2, *(word for path in paths for word in ("-o", path)))
    assert result.exit_code == 0, result.output
    assert all(path.exists() and str(path) in result.output for path in paths)
    expected = four_bar.simulate((0.0, 2.0), parameters={"l2": 0.45}, t_eval=np.linspace(0, 2, 401))
    np.testing.assert_array_equal(arrays_of(paths[1])["q1"], expected["q1"])
    with paths[0].open() as file:
        assert len(list(csv.reader(file))) == 402


@pytest.mark.slow
def test_simulate_with_the_tutorials_options_prints_its_published_numbers():
    output = run("simulate", "--method", "RK45", "--rtol", "1e-3", "--atol", "1e-6", "--constraints", "none").output
    assert "-2.2464155374" in output  # published: q2 of the tutorial's initial state
    assert "122 evaluations" in output  # published: the tutorial's run
    assert "1.56e-02 at the end" in output  # published: how far its loop has opened
    assert "Energy" in output


def test_simulate_with_initial_values_and_guesses_prints_the_closed_state(four_bar):
    result = run("simulate", "-i", "q1=-0.6", "-i", "u1=0.2", "-i", "q2=1.5", "-i", "q3=1.5", "-r", "F=0", "-t", 0, 0.1)
    assert result.exit_code == 0, result.output
    x0 = four_bar.initial_state([-0.6], [0.2], guess=[1.5, 1.5])
    for name, value in zip(four_bar.states, x0, strict=True):
        assert f"  {name:<8} {value:>16.10f}" in result.output


@pytest.mark.slow(
    but=[
        "arguments0-'l9'",
        "arguments1-NAME=VALUE",
        "arguments10-give one, such as -o sweep.png",
        "arguments11-F is an input, not a parameter: give it with -r",
    ]
)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulate", "-p", "l9=1"], "'l9'"),
        (["simulate", "-p", "l2"], "NAME=VALUE"),
        (["simulate", "-p", "l2=long"], "NAME=VALUE"),
        (["simulate", "-p", "l2=0.4:0.5:3"], "fourbar sweep"),
        (["simulate", "-t", "4"], "-t 0 4"),
        (["simulate", "-t", "0", "four"], "-t 0 4"),
        (["simulate", "-r", "F=50*sin(q1)"], "there is no q1"),
        (["simulate", "fourbar"], "Did you mean four_bar?"),
        (["simulate", "-p", "k=1", "-p", "k=2"], "k is given twice"),
        (["simulate", "-i", "F=3", "-r", "F=4"], "F is given twice"),
        (["sweep", "-p", "k=1,2", "--plot", "q1"], "give one, such as -o sweep.png"),
        (["simulate", "-p", "F=3"], "F is an input, not a parameter: give it with -r"),
        (["simulate", "-p", "q1=3"], "q1 is a state, not a parameter: give it with -i"),
        (["simulate", "-p", "L2=3"], "Did you mean l2?"),
        (["generate", "os:getcw"], "os has no function getcw"),
        (["sweep"], "nothing to sweep"),
        (["sweep", "-p", "k=1:2"], "FIRST:LAST:N"),
        (["sweep", "-p", "k=1:2:0"], "FIRST:LAST:N"),
        (["sweep", "-p", "k=1:2:2000", "-p", "l2=0.4:0.5:2000"], "at most 1000000 runs"),
        (["sweep", "-p", "k=1:2:3", "-r", "F=k*t"], "contains k, which the sweep varies"),
        (["sweep", "-p", "l2=0.5,5"], "cannot be closed"),
        (["sweep", "-p", "k=1,2", "-o", "run.gif"], "run.gif"),
        (["simulate", "-p", "l2=5"], "cannot be closed"),
        (["simulate", "-p", "l2=nan"], "finite"),
        (["simulate", "-i", "u2=1"], "u2"),
        (["simulate", "-r", "G=1"], "'G'"),
        (["simulate", "--method", "Euler"], "'Euler'"),
        (["simulate", "--rtol", "-1"], "rtol"),
        (["simulate", "-t", "1", "1"], "t_span"),
        (["simulate", "-o", "run.xyz"], "run.xyz"),
        (["simulate", "-o", "/dev/null/x.csv"], "/dev/null/x.csv"),
        (["simulate", "five_bar"], "'five_bar'"),
        (["info", "no_such_file.py:model"], "no_such_file.py"),
        (["info", "no_such_module:model"], "no_such_module"),
        (["generate", "os:getcwd"], "str"),
        (["generate", "four_bar", "-o", "/dev/null"], "/dev/null"),
        (["build", "four_bar", "-o", "/dev/null"], "/dev/null"),
    ],
)
def test_commands_with_wrong_arguments_end_with_one_paragraph_and_no_traceback(arguments, words):
    result = run(*arguments)
    assert result.exit_code != 0
    assert words in result.output
    assert "Traceback" not in result.output
    assert isinstance(result.exception, SystemExit)


def test_unfinished_simulation_exits_with_an_error(tmp_path):
    # The sum of the lengths of two neighbours equals that of the others, and the linkage starts near its
    # singular position, moving towards it.
    source = tmp_path / "falling.py"
    source.write_text(
        "import sympy as sm, sympy.physics.mechanics as me\n"
        "from sympy.physics.mechanics.system import System\n"
        "import fourbar_codegen as fb\n"
        "def model():\n"
        "    q, u = me.dynamicsymbols('q u')\n"
        "    m = sm.Symbol('m')\n"
        "    wall, block = me.RigidBody('wall'), me.RigidBody('block', mass=m)\n"
        "    system = System.from_newtonian(wall)\n"
        "    system.add_joints(me.PrismaticJoint('slide', wall, block, q, u))\n"
        "    system.add_loads(me.Force(block.masscenter, sm.sqrt(1 - q) * wall.x))\n"
        "    return fb.Model(system, name='falling', parameters={m: 1}, initial={q: 0, u: 1})\n"
    )
    target = tmp_path / "run.csv"
    result = run("simulate", f"{source}:model", "-o", target)
    assert result.exit_code == 1
    assert "stopped at t = " in result.output
    assert target.exists()  # what was reached is not lost


@pytest.mark.slow
def test_simulate_of_a_run_that_explodes_reports_progress_and_ends(monkeypatch):
    monkeypatch.setattr("fourbar_codegen.simulation.simulate.QUIET_SECONDS", 0.1)  # a million steps take longer
    # The damper feeds the motion: to 20 s it would be 35 million steps, up to 4e15 J.
    done = run("simulate", "-p", "k=50", "-p", "l2=0.45", "-t", 0, 20)
    assert done.exit_code == 1
    *lines, end = done.stderr.splitlines()
    assert lines
    assert all(re.fullmatch(r"four_bar: simulating, t = [\d.]+ of 20 s, \d+ s", line) for line in lines)
    assert "max_steps = 1000000" in end
    first, last = map(float, re.search(r"grown from (\S+) J to (\S+) J", end).groups())
    printed = re.search(r"Energy: (\S+) J at the start, (\S+) J at the end", done.stdout)
    assert first == pytest.approx(float(printed[1]), rel=1e-5)
    assert last > 0.9 * float(printed[2]) > 1e12  # which is of the last of 401 times that it has reached
    result = run("simulate", "-p", "k=50", "-p", "l2=0.45", "-t", 0, 8, "--max-steps", 100)
    assert "max_steps = 100 " in result.output
    assert run("simulate", "-t", 0, 0.1, "--max-steps", "none").exit_code == 0
    assert "max_steps must be" in run("simulate", "--max-steps", "many").output


@pytest.mark.slow
def test_sweep_over_ranges_runs_all_combinations_and_marks_failures(four_bar, tmp_path):
    ranges = ["-p", "k=50:150:3", "-p", "c=0,5", "-p", "l2=0.45"]
    done = run("sweep", *ranges, "-t", 0, 2, "-i", "q1=-0.6", "-o", tmp_path / "s.npz")
    assert done.exit_code == 0, done.output
    assert "k = 50 ... 150 N m/rad, 3 values" in done.output
    arrays = arrays_of(tmp_path / "s.npz")
    assert list(zip(arrays["k"], arrays["c"], strict=True)) == [(k, c) for k in (50, 100, 150) for c in (0, 5)]
    of_last = {"k": 150.0, "c": 5.0, "l2": 0.45}
    x0 = four_bar.initial_state({"q1": -0.6}, parameters=of_last)
    times = np.linspace(0.0, 2.0, 201)
    alone = four_bar.simulate((0.0, 2.0), x0, parameters=of_last, t_eval=times)
    # The default tolerance 1e-6, in each of some dozen steps on either side.
    np.testing.assert_allclose(arrays["q2"][-1], alone["q2"], rtol=0, atol=1e-4)
    # Stiffer springs reach the linkage's singular position; those runs are kept, and the command fails.
    failed = run("sweep", "-p", "k=100,200", "-o", tmp_path / "f.csv")
    assert failed.exit_code == 1
    assert "1 of 2 runs failed, the first of them at k = 200: The integration stopped" in failed.output
    assert (tmp_path / "f.csv").exists()
    # So are those of lengths for which the loop closes.
    files = ["-o", tmp_path / "o.npz", "-o", tmp_path / "o.png", "--plot", "u1"]
    open_loop = run("sweep", "-p", "l2=0.5,5", "-t", 0, 1, *files)
    assert open_loop.exit_code == 1
    assert "1 of 2 runs failed, the first of them at l2 = 5: The loops do not close" in open_loop.output
    arrays = arrays_of(tmp_path / "o.npz")
    assert arrays["success"].tolist() == [True, False]
    assert np.isnan(arrays["q1"][1]).all()
    assert arrays["l2"].tolist() == [0.5, 5.0]
    assert (tmp_path / "o.png").stat().st_size > 5_000


PENDULUM = """
from fourbar_codegen import models
import lengths
import json
def make():
    return models.cartesian_pendulum() if json.loads("1") == 1 and lengths.L == 1.0 else None
"""


@pytest.mark.slow
@pytest.mark.parametrize("model", ["json.py:make", "folder/json.py:make", "own:make"])
def test_models_in_files_named_as_python_modules_do_not_replace_these(tmp_path, model):
    """Neither a model in a file json.py, nor one beside it; and the neighbours of a file can be imported."""
    for place in (tmp_path, tmp_path / "folder"):
        place.mkdir(exist_ok=True)
        (place / "json.py").write_text(PENDULUM)
        (place / "own.py").write_text(PENDULUM)
        (place / "lengths.py").write_text("L = 1.0")
    code = "import sys; sys.argv[0] = 'fourbar'; from fourbar_codegen.__main__ import main; main()"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, "info", model], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Model cartesian_pendulum")


@pytest.mark.slow
def test_export_command_writes_a_c_library_or_fmu_and_checks_its_options(tmp_path):
    result = run("export", "four_bar", "--to", "c", "-o", tmp_path / "c")
    assert result.stdout == f"Written: {tmp_path / 'c' / 'README.md'} says how to build it\n"
    assert (tmp_path / "c" / "four_bar.h").exists()
    result = run("export", "four_bar", "--to", "fmu", "--fmi", "2", "--event", "u1", "-o", tmp_path / "a.fmu")
    assert result.stdout == f"Written: {tmp_path / 'a.fmu'}\n"
    with zipfile.ZipFile(tmp_path / "a.fmu") as archive:
        assert b'numberOfEventIndicators="1"' in archive.read("modelDescription.xml")
    result = run("export", "four_bar", "--to", "c", "--fmi", "2", "-o", tmp_path / "c")
    assert result.exit_code == 2
    assert "--fmi belongs to --to fmu" in result.output
    result = run("export", "four_bar", "--to", "c", "--event", "u1", "-o", tmp_path / "c")
    assert "--event belongs to --to fmu" in result.output


@pytest.mark.slow
def test_info_on_a_linkage_or_its_function_describes_its_model(tmp_path):
    """A function that returns a Linkage, or one by its name."""
    points = {"A": (0, 0), "B": (0.1, 0.05), "C": (0.3, 0.3), "D": (0.4, 0)}
    made = f'fb.Linkage("rocker", points={points}, ground="AD", links=["AB", "BC", "CD"], density=1.0)'
    text = f"import fourbar_codegen as fb\nlinkage = {made}\ndef make():\n    return linkage\n"
    (tmp_path / "own.py").write_text(text)
    for name in ("linkage", "make"):
        output = run("info", f"{tmp_path / 'own.py'}:{name}").output
        assert output.startswith("Model rocker\ncoordinates: q_AB independent; q_BC, q_CD dependent")


def test_errors_of_a_users_file_name_its_line(tmp_path):
    (tmp_path / "own.py").write_text("def make():\n    x = 1\n    return y\n")
    done = run("info", f"{tmp_path / 'own.py'}:make")
    assert done.exit_code == 1
    assert "own.py, line 3: NameError: name 'y' is not defined" in done.output


COMMAND = [sys.executable, "-m", "fourbar_codegen"]


def test_model_file_that_exits_ends_the_command_with_an_error(tmp_path):
    (tmp_path / "own.py").write_text("raise SystemExit(0)\n")
    done = run("info", f"{tmp_path / 'own.py'}:make")
    assert done.exit_code == 1
    assert "could not be called: own.py, line 1: SystemExit: 0" in done.output


def test_input_expression_without_value_at_zero_is_accepted_for_a_later_run():
    assert run("simulate", "-t", 1, 2, "-r", "F=log(t)").exit_code == 0


def test_warning_of_degrees_in_a_command_is_one_line():
    command = [*COMMAND, "simulate", "-i", "q1=30", "-t", "0", "0.1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    first = done.stderr.splitlines()[0]
    assert re.fullmatch(r"Warning: q1 = 30 rad is more than a turn.* give 0\.523599\.", first)
    assert "ModelWarning" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_output_to_a_full_device_ends_the_command_with_an_error():
    with Path("/dev/full").open("w") as full:
        done = subprocess.run([*COMMAND, "simulate"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "Error: the output cannot be written: No space left on device.\n"


def test_command_whose_pipe_is_closed_ends_silently():
    with subprocess.Popen([*COMMAND, "simulate"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        process.stdout.close()  # as `| head -0`
        assert process.stderr
        said = process.stderr.read()
    assert process.returncode == 1
    assert said == ""


@pytest.mark.parametrize("where", ["fourbar_codegen.cli.commands", "click", "numpy"])
def test_command_interrupted_while_importing_ends_with_one_line(where):
    code = f"""
import sys, signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell has ignored in its background
class Finder:
    def find_spec(self, name, *_):
        if name == {where!r}:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.argv = ["fourbar", "simulate"]
from fourbar_codegen.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "Interrupted.\n")


@pytest.mark.slow
def test_command_interrupted_during_a_run_ends_with_one_line():
    code = """
import os, signal, sys, threading
signal.signal(signal.SIGINT, signal.default_int_handler)  # as above
threading.Timer(1.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
sys.argv = ["fourbar", "simulate", "-t", "0", "1e9", "--max-steps", "none", "-p", "c=0"]
from fourbar_codegen.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 130
    assert done.stderr.splitlines()[-1] == "Interrupted."


@pytest.mark.slow
def test_generate_and_build_write_sources_modules_and_wheels_that_load(tmp_path, four_bar, unoptimized):
    assert run("generate", "-o", tmp_path / "sources").exit_code == 0
    assert json.loads((tmp_path / "sources" / "four_bar" / "manifest.json").read_text())["name"] == "four_bar"
    result = run("build", "four_bar", "-o", tmp_path / "built")
    assert result.exit_code == 0, result.output
    module = Path(result.output.split(": ")[-1].strip())
    assert module.parent == tmp_path / "built" / "four_bar"
    assert run("build", "slider_crank", "--wheel", "-o", tmp_path / "dist").exit_code == 0
    assert list((tmp_path / "dist").glob("slider_crank-0.1.0-*.whl"))
    loaded = fb.load(module)
    np.testing.assert_allclose(loaded.rhs(0.0, [0.1] * 6), four_bar.rhs(0.0, [0.1] * 6), rtol=1e-12)


def test_info_on_the_four_bar_lists_names_defaults_and_operations():
    output = run("info").output
    for words in ("q1 independent; q2, q3 dependent", "l2              0.5 m", "100*sin(pi*t)", "dynamics"):
        assert words in output


@pytest.mark.slow
def test_cache_command_lists_and_clears_models_and_keeps_other_files(tmp_path, monkeypatch):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    assert "0 libraries and models, 0.00 MB" in run("cache").output
    path = fb.compile_model(fb.models.cartesian_pendulum()).path
    (tmp_path / "notes.txt").write_text("of somebody else")
    listed = run("cache").output
    assert "2 libraries and models" in listed
    assert "cartesian_pendulum_kernel " in listed
    size = sum(file.stat().st_size for folder in tmp_path.glob("cartesian*/") for file in folder.iterdir())
    assert f"{size / 1e6:.2f} MB, in {tmp_path}" in listed
    assert "0 libraries and models removed" in run("cache", "--clear", "--older-than", "1").output
    assert path.is_file()
    os.utime(path.with_name("checksum"), (0, 0))
    assert "1 libraries and models, " in run("cache", "--older-than", "1").output
    assert "1 libraries and models removed" in run("cache", "--clear", "--older-than", "1").output
    assert not path.exists()
    assert "1 libraries and models removed" in run("cache", "--clear").output
    assert (tmp_path / "notes.txt").is_file()


def test_help_of_every_command_has_an_example_and_the_models():
    for command in ("simulate", "sweep", "report", "animate", "generate", "build", "info"):
        result = run(command, "--help")
        assert result.exit_code == 0
        assert f"  fourbar {command} " in result.output  # an example
        assert set(fb.models.__all__) <= set(re.findall(r"\w+", result.output))
    version = importlib.metadata.version("fourbar_codegen")
    assert version in run("--version").output
    done = subprocess.run(
        [sys.executable, "-m", "fourbar_codegen", "--help"], capture_output=True, text=True, check=True
    )
    assert "simulate" in done.stdout


def test_methods_of_the_command_line_are_those_of_simulate():
    """The command line names them without importing what runs them."""
    from fourbar_codegen.cli.options import METHODS, SWEEP_METHODS
    from fourbar_codegen.simulation import methods

    assert METHODS == methods.NAMES
    assert SWEEP_METHODS == methods.IN_C


def test_info_on_a_model_that_is_not_compiled_yet_describes_it():
    output = run("info", "slider_crank").output
    assert output.startswith("Model slider_crank\ncoordinates: crank independent; rod, slide dependent")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("simulate", "-o", "run.nc"), "NetCDF needs xarray"),
        (("sweep", "-p", "k=1:2:3", "-o", "runs.nc"), "NetCDF needs xarray"),
        (("simulate", "-o", "run.png"), "Plots need matplotlib"),
        (("animate", "-o", "run.gif"), "Animations need matplotlib"),
        (("sweep", "-p", "k=1:2:3", "-o", "runs.png", "--plot", "q9"), "There is no quantity 'q9'; there are t, q1"),
        (("sweep", "-p", "k=1:2:3", "-o", "runs.png", "--plot", "P2"), "P2 has three components"),
    ],
)
def test_commands_whose_files_need_missing_packages_end_before_anything_runs(
    arguments, sentence, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    if "need" in sentence:
        for name in ("xarray", "matplotlib.figure", "matplotlib.animation"):
            monkeypatch.setitem(sys.modules, name, None)
        monkeypatch.setattr(nc, "find_spec", lambda name: None if name == "xarray" else name)
    command, *rest = arguments

    def runs(*_, **__):
        raise AssertionError("it runs")

    for name in ("simulate", "ensemble"):
        monkeypatch.setattr(fb.CompiledModel, name, runs)
    result = run(command, "four_bar", *rest)
    assert result.exit_code == 1
    assert sentence in result.output
