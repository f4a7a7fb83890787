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
    "discontinuities",
    "drawing",
    "elimination",
    "ensemble",
    "initial",
    "integrate",
    "linearize",
    "polynomials",
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
    "model", "mechanism", "fingerprint", "tape", "numeric", "convert", "derivatives", "breakpoints", "formulas",
    "identities", "linear", "motion", "composite", "kinematics", "kane", "equations", "angles", "share", "program",
    "structure", "lower", "c_expressions", "c_source", "cython_source",
]  # fmt: skip


GROUND = ["build", "cache", "errors", "files", "progress"]  # both halves stand on it
WHOLE = ["__init__", "__main__", "cli", "compile", "verify"]  # both halves meet in it


def imported(path):
    """Modules, and names from modules, which may be modules as well; without the package's own name."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = node.module.removeprefix("fourbar_codegen").removeprefix(".")
            yield module
            yield from (f"{module}.{alias.name}".removeprefix(".") for alias in node.names)


def test_every_module_has_a_place():
    assert sorted(RUN + GENERATION + GROUND + WHOLE) == sorted(path.stem for path in PACKAGE.glob("*.py"))


@pytest.mark.parametrize("name", RUN)
def test_run_half_knows_no_sympy_and_no_generation(name):
    for module in imported(PACKAGE / f"{name}.py"):
        assert not module.startswith("sympy")
        assert module not in {*GENERATION, *WHOLE}


@pytest.mark.parametrize("name", GENERATION)
def test_generation_half_knows_no_scipy_and_runs_no_process(name):
    for module in imported(PACKAGE / f"{name}.py"):
        assert not module.startswith(("scipy", "subprocess"))
        assert module not in {*RUN, *WHOLE, "build", "cache"} - {"arguments", "tables"}


@pytest.mark.parametrize("name", GROUND)
def test_what_both_stand_on_knows_neither(name):
    for module in imported(PACKAGE / f"{name}.py"):
        assert not module.startswith(("sympy", "scipy"))
        assert module not in {*RUN, *GENERATION, *WHOLE}


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
