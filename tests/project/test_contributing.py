"""The tables of CONTRIBUTING.md name the files that there are."""

import re
from collections import Counter

from harness import PROJECT

PACKAGE = PROJECT / "src" / "fourbar_codegen"
SUFFIXES = {".py", ".pyx", ".h", ".inc", ".js", ".html", ".css"}
INSTALLED = PACKAGE / "prebuilt"
"""Here, an installation builds the models of generated/, with copies of their sources."""


def rows():
    """The paths that first cells of tables name, each under the folder in the heading above it."""
    folder = None
    for line in (PROJECT / "CONTRIBUTING.md").read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            heading = re.fullmatch(r"### `([\w/]+)/`", line)
            folder = heading and (PACKAGE if (PACKAGE / heading[1]).is_dir() else PROJECT) / heading[1]
        elif line.startswith("|") and folder:
            yield from (folder / name for name in re.findall(r"`([^`]+)`", line.split("|")[1]))


def wanted():
    """Files of the package, and folders and helpers of the tests."""
    tests = PROJECT / "tests"
    helpers = [path for path in tests.rglob("*.py") if not path.name.startswith("test_")]
    yield from {path.parent for path in tests.rglob("*.py")} - {tests}
    for path in [*PACKAGE.rglob("*"), *helpers]:
        if path.suffix in SUFFIXES and path.name != "__init__.py" and INSTALLED not in path.parents:
            yield path


def names(paths):
    return sorted(str(path.relative_to(PROJECT)) for path in paths)


def test_each_file_of_the_package_and_helper_of_the_tests_has_exactly_one_row():
    count = Counter(rows())
    assert names(path for path in wanted() if count[path] == 0) == [], "have no row"
    assert names(path for path, n in count.items() if n > 1) == [], "have several rows"


def test_each_file_that_a_table_names_exists():
    assert names(path for path in rows() if not path.exists()) == []
