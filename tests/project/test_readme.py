"""What README.md shows is what happens."""

import itertools
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from harness import PROJECT
from harness.programs import PACKAGES

from fourbar_codegen.cli import main

README = (PROJECT / "README.md").read_text()
INSTALLATION = (PROJECT / "docs" / "installation.md").read_text()
BLOCKS = re.findall(r"```(python|text)\n(.*?)```", README, flags=re.DOTALL)
EXAMPLES = [(code, text) for (kind, code), (_, text) in itertools.pairwise(BLOCKS) if kind == "python"]


@pytest.mark.slow
@pytest.mark.parametrize(("code", "text"), EXAMPLES, ids=["own System", "four-bar"])
def test_examples_of_the_readme_print_what_stands_below_them(code, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == text


@pytest.mark.slow
def test_command_of_the_installation_page_prints_what_stands_below_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (shown,) = re.findall(r"```text\n(\$ fourbar.*?)```", INSTALLATION, flags=re.DOTALL)
    command, _, expected = shown.partition("\n")
    result = CliRunner().invoke(main, command.removeprefix("$ fourbar ").split())
    assert result.exit_code == 0

    def comparable(text):
        # Without the time it took, and what is rounding error.
        return re.sub(r"[\d.]+ ms|\d\.\d+e-1\d|0.00e\+00", "...", text)

    assert comparable(result.output) == comparable(expected)


def test_number_of_tests_in_a_whole_run_is_the_one_of_the_readme(request):
    """`make test` prints both; `make test-all` runs their sum."""
    config, count = request.config, request.session.testscollected
    [more, quick] = map(int, re.search(r"^(\d+) more tests take.*\n=+ (\d+) passed in ", README, re.MULTILINE).groups())
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.keyword:
        assert count == (quick if config.option.markexpr == "not slow" else quick + more)


@pytest.mark.slow
@pytest.mark.parametrize("ci", [False, True])
def test_tests_without_their_programs_are_skipped_and_fail_on_ci(ci, tmp_path):
    """On a machine with Python, gcc and make they are skipped and say what to install; on CI that is a failure."""
    (tmp_path / "bin").mkdir()
    for folder in os.get_exec_path():
        for path in Path(folder).glob("*"):
            link = tmp_path / "bin" / path.name
            if path.name not in PACKAGES.keys() - {"gcc"} and not link.exists():
                link.symlink_to(path)
    environment = {**os.environ, "PATH": str(tmp_path / "bin"), "CI": "true" if ci else ""}
    command = ["-m", "pytest", "-p", "no:cacheprovider", "-k", "clang or films or play_moves or manifest"]
    files = ["tests/building/test_generated.py", "tests/interface/test_pictures.py"]
    done = subprocess.run(
        [sys.executable, *command, *files], capture_output=True, text=True, env=environment, cwd=PROJECT
    )
    assert done.returncode == (pytest.ExitCode.TESTS_FAILED if ci else pytest.ExitCode.OK), done.stdout
    said = re.findall(r"^SKIPPED \[(\d+)\] \S+: (.*)$", done.stdout, flags=re.MULTILINE)
    assert said == [
        ("21", "clang is not installed: apt install clang"),
        ("1", "ffmpeg is not installed: apt install ffmpeg"),
        ("1", "chromium is not installed: apt install chromium"),
    ]
    assert ("On CI every test has to run" in done.stdout) == ci
    assert " passed, 23 skipped, " in done.stdout


def test_readme_has_at_most_120_lines():
    assert len(README.splitlines()) <= 120


def test_files_linked_from_the_main_pages_exist():
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        links = re.findall(r"\]\((?!http)([^)#]+)", (PROJECT / page).read_text(encoding="utf-8"))
        assert [link for link in links if not (PROJECT / link).exists()] == []
