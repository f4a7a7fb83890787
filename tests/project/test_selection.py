"""What `make test` runs: a published number for each how-to guide."""

import re
import subprocess
import sys

import pytest
from harness import PROJECT

TABLE = re.findall(
    r"^\| (\w+) \| .* \| (\S+::\S+) \|$", (PROJECT / "tests" / "README.md").read_text(), flags=re.MULTILINE
)


@pytest.mark.slow
def test_each_how_to_guide_has_a_published_number_in_the_quick_tests():
    assert [page for page, _ in TABLE] == sorted(path.stem for path in (PROJECT / "docs" / "howto").glob("*.md"))
    named = [f"tests/{test}" for _, test in TABLE]
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--collect-only", "-q", "-m", "not slow"]
    done = subprocess.run([*command, *named], capture_output=True, text=True, cwd=PROJECT)
    assert done.returncode == 0, done.stdout
    assert {line.split("[")[0] for line in done.stdout.splitlines() if "::" in line} == set(named)
