"""The core runs without the packages beside it: its tests pass in a copy that does not have them."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import fourbar_codegen as fb

PACKAGE = Path(fb.__file__).parent
TESTS = Path(__file__).parents[1]
BESIDE = ("cli", "export", "files", "fitting", "jax", "linkage", "page", "views")
FOLDERS = ("analysis", "equations", "runtime", "simulation", "unit")
"""Where tests of the core are: files in which no word is of a package beside it."""

WORDS = re.compile(
    r"fb\.(Linkage|fit|Fit|Experiment|to_jax|export_\w+|load_trajectory|build_model|build_wheel)\b"
    r"|\.(save|plot\w*|animate|report|page|to_xarray|to_dataframe)\(|_repr_html_"
    rf"|fourbar_codegen\.({'|'.join(BESIDE)})\b|builders\.(linkages|exported)|harness\.(c_library|archives)"
    r"|runpy|import_module\(|examples"
)


def own_tests():
    found = (path for folder in FOLDERS for path in sorted((TESTS / folder).glob("test_*.py")))
    return [str(path) for path in found if not WORDS.search(path.read_text(encoding="utf-8"))]


@pytest.mark.slow
def test_tests_of_the_core_pass_without_the_packages_beside_it(tmp_path):
    copy = tmp_path / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns(*BESIDE, "__main__.py", "__pycache__"))
    place = "import fourbar_codegen; print(fourbar_codegen.__file__)"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    found = subprocess.run([sys.executable, "-c", place], capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert Path(found.stdout.strip()).parent == copy
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *own_tests()]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=TESTS.parent)
    assert done.returncode == 0, done.stdout[-3000:]
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) > 1000


def lines_of_code(path):
    """Lines that are neither blank nor of a comment or a docstring."""
    text = path.read_text(encoding="utf-8")
    if path.suffix in {".h", ".inc"}:
        return sum(bool(line.strip()) for line in re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).splitlines())
    documented = set()
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                documented.update(range(node.lineno, node.end_lineno + 1))
    else:  # Cython
        text = re.sub(r'""".*?"""', "", text, flags=re.DOTALL)
    lines = enumerate(text.splitlines(), start=1)
    return sum(bool(line.strip()) and not line.strip().startswith("#") and n not in documented for n, line in lines)


def test_core_has_32000_lines_of_code_at_most():
    kinds = {".py", ".pyx", ".pxd", ".pyi", ".h", ".inc"}
    files = [path for path in PACKAGE.rglob("*") if path.suffix in kinds and "prebuilt" not in path.parts]
    apart = {PACKAGE / name for name in BESIDE} | {PACKAGE / "runtime" / "export", PACKAGE / "__main__.py"}
    core = [path for path in files if path not in apart and apart.isdisjoint(path.parents)]
    assert len(core) > 100
    assert sum(map(lines_of_code, core)) <= 32_000
