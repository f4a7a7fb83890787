"""Imports go one way, and are quiet and light."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fourbar_codegen

PACKAGE = Path(fourbar_codegen.__file__).parent
ROOT = {
    "arguments": "ground", "errors": "ground", "files": "ground", "progress": "ground", "tables": "ground",
    "compiled": "compiled", "solvers": "compiled", "compile": "compile", "verify": "compile",
    "__init__": "cli", "__main__": "cli", "cli": "cli",
}  # fmt: skip
"""The layers of the files that are in no folder; that of the others is their folder."""

ON = {
    "runtime": [],
    "ground": ["runtime"],
    "expressions": ["ground"],
    "modeling": ["expressions"],
    "models": ["modeling"],
    "dynamics": ["modeling"],
    "lowering": ["dynamics"],
    "codegen": ["lowering"],
    "building": ["ground"],
    "kernel": ["building"],
    "analysis": ["kernel"],
    "results": ["kernel"],
    "simulation": ["analysis", "results"],
    "presentation": ["analysis", "results"],
    "compiled": ["simulation", "presentation"],
    "compile": ["codegen", "compiled"],
    "cli": ["compile", "models"],
}
"""What each layer stands on: it may import that, and what that stands on."""

GENERATION = {"expressions", "modeling", "models", "dynamics", "lowering", "codegen"}
BOTH = {"compile", "cli"}
FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
    if path.parent == PACKAGE or path.name != "__init__.py" or path.parent.name == "models"
}
DOORS = {
    ("results.trajectory", "presentation.storage"),
    ("results.trajectory", "presentation.figures"),
    ("results.trajectory", "presentation.report"),
    ("analysis.assembly_modes", "presentation.figures"),
}
"""What a result does with itself on request, imported in the function: `Trajectory.save`, `.plot`, and the like."""


def layer(name):
    """That of a file or a folder, by its name within the package."""
    first = name.partition(".")[0]
    return first if first in ON else ROOT[first]


def below(folder):
    return {folder, *(lower for base in ON.get(folder, ()) for lower in below(base))}


def imports(path):
    """The modules that a file imports, or names from modules, and whether it does so in a function."""
    tree = ast.parse(path.read_text())
    within = {id(node) for f in ast.walk(tree) if isinstance(f, ast.FunctionDef) for node in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, id(node) in within) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            yield from ((f"{node.module}.{alias.name}", id(node) in within) for alias in node.names)


def own(name):
    """The files of the package that one imports, or folders without a file of Python, and whether in a function."""
    for module, within in imports(FILES[name]):
        package, _, rest = module.partition(".")
        if package == "fourbar_codegen":
            parts = rest.split(".")
            found = (".".join(parts[:length]) for length in (len(parts), len(parts) - 1))
            yield next((file for file in found if file in FILES), parts[0]), within


def test_every_file_has_a_layer():
    for name in FILES:
        assert layer(name) in ON
    assert set(ROOT) == {name for name in FILES if "." not in name}


@pytest.mark.parametrize("name", sorted(FILES))
def test_imports_go_down(name):
    for imported, within in own(name):
        if not (within and (name, imported) in DOORS) and layer(name) != "cli":
            assert layer(imported) in below(layer(name)), f"{name} imports {imported}"


def test_no_cycles():
    """Also within a folder, and counting imports in functions, but for what results do with themselves."""
    edges = {name: {imported for imported, _ in own(name) if (name, imported) not in DOORS} for name in FILES}
    del edges["__init__"]  # which imports what is asked of it
    while edges:
        ready = {name for name, on in edges.items() if not on & edges.keys()}
        assert ready, f"these import each other: {sorted(edges)}"
        edges = {name: on for name, on in edges.items() if name not in ready}


@pytest.mark.parametrize("name", sorted(FILES))
def test_halves_import_their_own_libraries(name):
    modules = {module.split(".")[0] for module, _ in imports(FILES[name])}
    if layer(name) in GENERATION:
        assert "scipy" not in modules
    elif layer(name) not in BOTH:
        assert "sympy" not in modules
    assert "subprocess" not in modules or name == "building.toolchain"


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
