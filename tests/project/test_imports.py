"""Imports go one way, and are quiet and light. ``python tests/project/test_imports.py`` draws the folders anew."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fourbar_codegen

PACKAGE = Path(fourbar_codegen.__file__).parent
TESTS = Path(__file__).parents[1]
DRAWING = TESTS.parent / "docs" / "folders.svg"
ROOT = {
    "errors": "errors", "layout": "errors", "body_shapes": "interface", "compiled_model": "compiled_model",
    "__init__": "all", "__main__": "cli",
}  # fmt: skip
"""The layers of the files that are in no folder; that of the others is their folder."""

CORE = {
    "errors": [],
    "runtime": ["errors"],
    "interface": ["runtime"],
    "expressions": ["interface"],
    "modeling": ["expressions"],
    "dynamics": ["modeling"],
    "lowering": ["dynamics"],
    "codegen": ["lowering"],
    "kernel": ["interface"],
    "building": ["kernel"],
    "results": ["kernel"],
    "analysis": ["results"],
    "solvers": ["kernel"],
    "simulation": ["analysis", "solvers"],
    "compiled_model": ["simulation", "building"],
    "pipeline": ["codegen", "compiled_model"],
    "models": ["modeling"],
}
"""What each layer stands on: it may import that, and what that stands on."""

BESIDE = {
    "linkage": ["modeling"],
    "views": ["analysis"],
    "files": ["views", "compiled_model"],
    "fitting": ["views", "compiled_model"],
    "jax": ["compiled_model"],
    "export": ["pipeline"],
    "page": ["files", "export"],
    "all": ["page", "export", "models", "linkage", "fitting", "jax"],
    "cli": ["all"],
}
"""The packages beside the core, which imports none of them. `__init__` imports by name what is asked of it."""

ON = CORE | BESIDE

GENERATION = {"expressions", "modeling", "models", "linkage", "dynamics", "lowering", "codegen"}
BOTH = {"pipeline", "export", "cli", "all"}
FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
    if path.parent == PACKAGE or path.name != "__init__.py" or path.parent.name == "models"
}


def layer(name):
    """That of a file or a folder, by its name within the package."""
    first = name.partition(".")[0]
    return first if first in ON else ROOT[first]


def below(folder):
    return {folder, *(lower for base in ON.get(folder, ()) for lower in below(base))}


def imports(path):
    """The modules that a file imports, or names from them: also in functions, by `importlib`, and for types."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name} has a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and re.search(r"import_module$|^imported$", ast.unparse(node.func)):
            yield from (name.value for name in node.args[:1] if isinstance(name, ast.Constant))
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "_Later":  # of CompiledModel
            yield from (f"fourbar_codegen.{name.value}" for name in node.args if name.value)


def own(name):
    """The files of the package that one imports, or folders without a file of Python."""
    for module in imports(FILES[name]):
        package, _, rest = module.partition(".")
        if package == "fourbar_codegen":
            parts = rest.split(".")
            found = (".".join(parts[:length]) for length in (len(parts), len(parts) - 1))
            folder = parts[0] if parts[0] in ON else "__init__"
            yield next((file for file in found if file in FILES), folder)


def test_files_of_the_package_are_each_in_a_layer():
    for name in FILES:
        assert layer(name) in ON
    assert set(ROOT) == {name for name in FILES if "." not in name}
    assert len(ROOT) <= 6
    assert all(layer not in below(other) for layer in BESIDE for other in CORE)


@pytest.mark.parametrize("name", sorted(FILES))
def test_files_of_every_layer_import_lower_layers_only(name):
    for imported in own(name):
        assert layer(imported) in below(layer(name)), f"{name} imports {imported}"


@pytest.mark.slow
def test_files_of_the_package_import_each_other_without_cycles():
    """Also within a folder, and counting imports in functions."""
    edges = {name: {*own(name)} for name in FILES}
    while edges:
        ready = {name for name, on in edges.items() if not on & edges.keys()}
        assert ready, f"these import each other: {sorted(edges)}"
        edges = {name: on for name, on in edges.items() if name not in ready}


def test_cython_files_of_the_runtime_import_errors_enumerations_and_types_alone():
    for path in [path for suffix in ("pyx", "pxd", "pyi") for path in PACKAGE.glob(f"runtime/*.{suffix}")]:
        imported = re.findall(r"^\s*from fourbar_codegen\.(\w+)", path.read_text(), flags=re.MULTILINE)
        allowed = {"errors", "runtime", *(["layout"] if path.suffix == ".pyi" else [])}
        assert set(imported) <= allowed, path.name


HEADERS = ("arithmetic", "linear_algebra", "kernel", "steppers", "run", "derivatives", "lanes", "export")
"""The folders of the runtime's headers, each of which includes those before it, besides the interface itself."""


def test_headers_include_lower_folders_only():
    found = [path for suffix in ("h", "inc") for path in PACKAGE.glob(f"runtime/*/*.{suffix}")]
    assert {path.parent.name for path in found} == set(HEADERS)
    for path in found:
        for name in re.findall(r'^ *# *include "([^"]+)"', path.read_text(), flags=re.MULTILINE):
            included = (path.parent / name).resolve()
            assert included.exists(), f"{path.name} includes {name}"
            folder = included.parent.name
            assert folder == "runtime" or HEADERS.index(folder) <= HEADERS.index(path.parent.name), path.name


@pytest.mark.parametrize("name", sorted(FILES))
def test_files_of_each_half_import_its_libraries_only(name):
    modules = {module.split(".")[0] for module in imports(FILES[name])}
    if layer(name) in GENERATION:
        assert "scipy" not in modules
    elif layer(name) not in BOTH:
        assert "sympy" not in modules
    assert "subprocess" not in modules or name == "building.toolchain"


@pytest.mark.slow
def test_tests_and_their_helpers_import_no_test_module_even_inside_functions():
    modules = [path.relative_to(TESTS).with_suffix("").parts for path in TESTS.rglob("test_*.py")]
    known = tuple(f"{name}." for parts in modules for name in (parts[-1], ".".join(parts), f"tests.{'.'.join(parts)}"))
    assert [
        f"{path.relative_to(TESTS)} imports {module}"
        for path in sorted(TESTS.rglob("*.py"))
        for module in imports(path)
        if f"{module}.".startswith(known)
    ] == []


def edges_between_layers():
    """What each layer imports, but for what it reaches through others anyway."""
    on = {name: {layer(b) for file in FILES if layer(file) == name for b in own(file)} - {name} for name in ON}
    on["runtime"].add("errors")  # its modules are compiled

    def reached(name):
        return on[name].union(*(reached(lower) for lower in on[name]))

    return {name: {b for b in on[name] if not any(b in reached(c) for c in on[name])} for name in on}


def drawing():
    """The layers, each above those that it imports, as SVG."""
    on, rows = edges_between_layers(), []
    while placed := {name for row in rows for name in row} ^ on.keys():
        ready = [name for name in placed if not on[name] & placed]
        rows.append(sorted(ready, key=lambda name: (name not in GENERATION, name)))
    labels = {name: f"{name}/" for name in ON}
    for kind in set(ROOT.values()):
        folder = [f"{kind}/"] if (PACKAGE / kind).is_dir() else []
        labels[kind] = ", ".join([*folder, *(f"{file}.py" for file in ROOT if ROOT[file] == kind)])
    lines, boxes, center, top = [], [], {}, 64 * len(rows)
    for level, row in enumerate(rows):
        widths = [8 * len(labels[name]) + 24 for name in row]
        gap = (760 - sum(widths)) / (len(row) + 1)
        for place, (name, width) in enumerate(zip(row, widths, strict=True)):
            x, y = gap * (place + 1) + sum(widths[:place]), top - 64 * level - 46
            center[name] = x + width / 2, y + 14
            color = (
                "#e8f0fe"
                if name in GENERATION
                else "#eee"
                if name in BOTH | {"errors", "interface", "runtime"}
                else "#fef3e0"
            )
            border = ' stroke-dasharray="4 3"' if name in BESIDE else ""
            box = f'<rect x="{x:.0f}" y="{y}" width="{width}" height="28" rx="4" fill="{color}" stroke="#444"{border}/>'
            boxes += [
                box,
                f'<text x="{x + width / 2:.0f}" y="{y + 19}" text-anchor="middle">{labels[name]}</text>',
            ]
        for name in row:
            for lower in sorted(on[name]):
                (x, y), (end, low) = center[name], center[lower]
                curve = f"M{x:.0f} {y + 14}C{x:.0f} {y + 40} {end:.0f} {low - 40} {end:.0f} {low - 15}"
                lines.append(f'<path d="{curve}" fill="none" stroke="#666" marker-end="url(#tip)"/>')
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 760 {top}" font-family="monospace" font-size="13">',
        ('<marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#666"/></marker>'),
        f'<rect width="760" height="{top}" fill="white"/>', *lines, *boxes, "</svg>\n",
    ])  # fmt: skip


@pytest.mark.slow
def test_drawing_of_the_folders_is_that_of_the_code():
    assert DRAWING.read_text() == drawing()


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_importing_the_package_is_quiet_and_imports_neither_sympy_nor_scipy():
    done = run("import fourbar_codegen, sys; print([m for m in ('sympy', 'scipy', 'numpy') if m in sys.modules])")
    assert done.stdout == "[]\n"
    assert done.stderr == ""
    done = run("import fourbar_codegen.cli, sys; print([m for m in ('sympy', 'scipy', 'numpy') if m in sys.modules])")
    assert done.stdout == "[]\n"  # help and completion are quick


def test_the_prebuilt_model_needs_neither_sympy_nor_scipy_nor_a_compiler():
    done = run(
        "import sys, os; os.environ['PATH'] = ''\n"
        "for name in ('sympy', 'scipy', 'Cython', 'setuptools'): sys.modules[name] = None\n"
        "import fourbar_codegen as fb\n"
        "run = fb.load('four_bar').simulate((0.0, 1.0))\n"
        "print(run.success, [m for m in sys.modules if m.startswith('fourbar_codegen.building')])"
    )
    loading = ["fourbar_codegen.building", "fourbar_codegen.building.stored_model", "fourbar_codegen.building.loading"]
    assert done.stdout == f"True {loading}\n"
    assert done.stderr == ""


def test_public_names_of_the_package_exist_and_others_raise():
    for name in fourbar_codegen.__all__:
        assert getattr(fourbar_codegen, name) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = fourbar_codegen.nonsense


if __name__ == "__main__":
    DRAWING.write_text(drawing())
