"""Imports go one way, and are quiet and light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fourbar_codegen

PACKAGE = Path(fourbar_codegen.__file__).parent
RUN = [
    "arguments",
    "assembly",
    "compiled",
    "drawing",
    "elimination",
    "ensemble",
    "initial",
    "integrate",
    "linearize",
    "report",
    "simulate",
    "solver_run",
    "solvers",
    "storage",
    "tables",
    "trajectory",
    "visual",
]
GENERATION = [
    "model", "mechanism", "fingerprint", "tape", "numeric", "convert", "degrees", "derivatives", "identities",
    "linear", "motion", "composite", "kinematics", "kane", "equations", "angles", "share", "program", "lower",
    "c_expressions", "c_source", "cython_source",
]  # fmt: skip


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


def under_type_checking(path):
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            for inner in node.body:
                yield getattr(inner, "module", None)


@pytest.mark.parametrize("name", RUN)
def test_run_half_knows_no_sympy_and_no_generation(name):
    path = PACKAGE / f"{name}.py"
    if path.exists():
        for module in imported(path):
            assert not module.startswith("sympy")
            assert module.removeprefix("fourbar_codegen.") not in GENERATION


@pytest.mark.parametrize("name", GENERATION)
def test_generation_half_knows_no_scipy_and_runs_no_process(name):
    path = PACKAGE / f"{name}.py"
    for module in imported(path):
        assert not module.startswith(("scipy", "subprocess"))
        assert module.removeprefix("fourbar_codegen.") not in {*RUN, "build", "cache"} - {"arguments", "tables"}


def test_only_build_runs_processes():
    users = [p.name for p in PACKAGE.glob("*.py") if "subprocess" in set(imported(p))]
    assert users == ["build.py"]


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_importing_the_package_is_quiet_and_imports_neither_sympy_nor_scipy():
    done = run("import fourbar_codegen, sys; print([m for m in ('sympy', 'scipy', 'numpy') if m in sys.modules])")
    assert done.stdout == "[]\n"
    assert done.stderr == ""


def test_the_prebuilt_model_needs_neither_sympy_nor_scipy_nor_a_compiler():
    done = run(
        "import sys, os; os.environ['PATH'] = ''\n"
        "for name in ('sympy', 'scipy', 'Cython', 'setuptools'): sys.modules[name] = None\n"
        "import fourbar_codegen as fb\n"
        "run = fb.load('four_bar').simulate((0.0, 1.0))\n"
        "print(run.success)"
    )
    assert done.stdout == "True\n"
    assert done.stderr == ""


def test_public_names_exist():
    for name in fourbar_codegen.__all__:
        assert getattr(fourbar_codegen, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = fourbar_codegen.nonsense
