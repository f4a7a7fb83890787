"""Imports go one way, and are quiet and light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fourbar_codegen

PACKAGE = Path(fourbar_codegen.__file__).parent
FOLDERS = {
    "": ["errors", "progress", "files", "tables", "arguments"],
    "expressions": [
        "tape", "numeric", "convert", "derivatives", "breakpoints", "formulas", "identities", "linear", "fingerprint",
    ],
    "modeling": ["model", "mechanism"],
    "dynamics": ["motion", "kinematics", "kane", "composite", "equations"],
    "lowering": ["program", "structure", "angles", "share", "lower", "schedule"],
    "codegen": ["c_expressions", "c_source", "cython_source"],
    "building": ["build", "cache"],
    "kernel": ["loading", "elimination", "kernel", "inputs", "consistency"],
    "analysis": ["loop_closure", "polynomials", "initial_state", "assembly", "linearize"],
    "results": ["trajectory", "ensemble"],
    "simulation": [
        "integration", "discontinuities", "events", "singularity", "options", "solver_run", "solvers", "integrate",
        "simulate", "batch", "ensemble_run",
    ],
    "presentation": ["storage", "drawing", "visual", "report"],
    "compiled": ["compiled"],
    "compile": ["compile", "verify"],
    "cli": ["__init__", "__main__", "cli"],
}  # fmt: skip
"""Which folder each file belongs to."""

ON = {
    "": ["runtime"],
    "expressions": [""],
    "modeling": ["expressions"],
    "dynamics": ["modeling"],
    "lowering": ["dynamics"],
    "codegen": ["lowering"],
    "building": [""],
    "kernel": ["building", "runtime"],
    "analysis": ["kernel"],
    "results": ["kernel"],
    "simulation": ["analysis", "results"],
    "presentation": ["analysis", "results"],
    "compiled": ["simulation", "presentation"],
    "compile": ["codegen", "compiled"],
    "cli": ["compile"],
}
"""What each folder stands on: it may import that, and what that stands on."""

GENERATION = {"expressions", "modeling", "dynamics", "lowering", "codegen"}
HOME = {file: folder for folder, files in FOLDERS.items() for file in files}
DOORS = {("trajectory", "storage"), ("trajectory", "visual"), ("trajectory", "report"), ("assembly", "visual")}
"""What a result does with itself on request, imported in the function: `Trajectory.save`, `.plot`, and the like."""


def below(folder):
    return {folder, *(lower for base in ON.get(folder, ()) for lower in below(base))}


def imports(path):
    """The modules that a file imports, and whether it does so in a function; relative imports are not used."""
    tree = ast.parse(path.read_text())
    within = {id(node) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for node in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in within) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            yield from ((f"{node.module}.{alias.name}", id(node) in within) for alias in node.names)


def own(path):
    """The files and folders of the package that a file imports, and whether it does so in a function."""
    for module, within in imports(path):
        if module.startswith("fourbar_codegen."):
            first = module.split(".")[1]
            if first in HOME or first in {"runtime", "models"}:
                yield first, within


def test_every_file_has_a_folder():
    assert sorted(HOME) == sorted(path.stem for path in PACKAGE.glob("*.py"))


@pytest.mark.parametrize("name", sorted(set(HOME) - set(FOLDERS["cli"])))
def test_imports_go_down(name):
    for imported, within in own(PACKAGE / f"{name}.py"):
        folder = HOME.get(imported, imported)
        if not (within and (name, imported) in DOORS):
            assert folder in below(HOME[name]), f"{name} imports {imported}"


def test_no_cycles():
    """Also within a folder, and counting imports in functions, but for what results do with themselves."""
    edges = {name: {b for b, _ in own(PACKAGE / f"{name}.py") if b in HOME and (name, b) not in DOORS} for name in HOME}
    edges |= {name: set() for name in FOLDERS["cli"]}
    while edges:
        ready = {name for name, on in edges.items() if not on & edges.keys()}
        assert ready, f"these import each other: {sorted(edges)}"
        edges = {name: on for name, on in edges.items() if name not in ready}


@pytest.mark.parametrize("name", sorted(HOME))
def test_halves_import_their_own_libraries(name):
    modules = {module.split(".")[0] for module, _ in imports(PACKAGE / f"{name}.py")}
    if HOME[name] in GENERATION:
        assert "scipy" not in modules
    elif HOME[name] not in {"compile", "cli"}:
        assert "sympy" not in modules
    assert "subprocess" not in modules or name == "build"


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
