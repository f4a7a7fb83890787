"""What README.md shows is what happens."""

import itertools
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from fourbar_codegen.cli import main

README = (Path(__file__).parent.parent / "README.md").read_text()
BLOCKS = re.findall(r"```(python|text)\n(.*?)```", README, flags=re.DOTALL)
EXAMPLES = [(code, text) for (kind, code), (_, text) in itertools.pairwise(BLOCKS) if kind == "python"]


@pytest.mark.parametrize(("code", "text"), EXAMPLES, ids=["four-bar", "own System", "ensemble", "files", "forces"])
def test_examples_print_what_stands_below_them(code, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    assert capsys.readouterr().out == text


def test_command_prints_what_stands_below_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (shown,) = [text for kind, text in BLOCKS if text.startswith("$ fourbar")]
    command, _, expected = shown.partition("\n")
    result = CliRunner().invoke(main, command.removeprefix("$ fourbar ").split())
    assert result.exit_code == 0

    def comparable(text):
        # Without the time it took, and what is rounding error.
        return re.sub(r"[\d.]+ ms|\d\.\d+e-1\d|0.00e\+00", "...", text)

    assert comparable(result.output) == comparable(expected)


def test_number_of_tests_is_the_one_shown(request):
    config = request.config
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.option.keyword:  # the whole suite
        assert f" {request.session.testscollected} passed in " in README
