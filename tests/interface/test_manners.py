"""What objects say of themselves, and how the command line behaves."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from harness.terminal import on_terminal

import fourbar_codegen as fb


class Table(HTMLParser):
    """The cells of a table, row by row."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.open = [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1] in ("th", "td"):
            self.rows[-1][-1] += data


def test_models_in_notebooks_and_repr_show_names_defaults_and_units(four_bar):
    model = fb.models.four_bar()
    for shown in (model, four_bar):
        rows = {row[0]: row[1:] for row in Table(shown._repr_html_()).rows}
        assert rows["q1"] == ["coordinate", "", "", ""]
        assert rows["u3"] == ["dependent speed", "", "", ""]
        assert rows["k"] == ["parameter", "100", "N m/rad", "stiffness of the spring"]
        assert rows["F"] == ["input", "100*sin(pi*t)", "", ""]
    assert repr(model) == "<Model four_bar: 3 coordinates, 3 speeds, 8 parameters, 1 inputs>"
    assert repr(four_bar).startswith("<CompiledModel four_bar: coordinates q1, q2, q3;")


def test_runs_and_modes_in_notebooks_and_repr_show_their_content(four_bar):
    run = four_bar.simulate((0.0, 4.0), t_eval=[0.0, 1.0, 4.0], parameters={"k": 50.0})
    assert repr(run) == (
        f"<Trajectory of four_bar: 0 s to 4 s, 3 states, {run.nfev} evaluations; "
        "The solver successfully reached the end of the integration interval.>"
    )
    rows = dict(Table(run._repr_html_()).rows)
    assert rows["k"] == "50 N m/rad"
    assert rows["method"] == "DOP853"
    none = four_bar.simulate((0.0, 8.0), t_eval=[7.9, 8.0])
    assert "no states" in repr(none)
    assert dict(Table(none._repr_html_()).rows)["stored states"] == "0"
    modes = Table(four_bar.initial_states()._repr_html_()).rows
    assert modes[0] == ["mode", *four_bar.states]
    assert [row[0] for row in modes[1:]] == ["0", "1"]


def fourbar(*arguments, **environment):
    return on_terminal("-m", "fourbar_codegen", *arguments, **environment)


@pytest.mark.slow
def test_types_of_a_users_file_are_known_to_mypy(tmp_path):
    """What an editor knows of a user's file: by mypy, from the package as it is installed."""
    code = (
        "import fourbar_codegen as fb\n"
        "linkage = fb.load('four_bar')\n"
        "run = linkage.simulate((0.0, 1.0))\n"
        "reveal_type(linkage)\nreveal_type(run)\nreveal_type(run.t)\nreveal_type(linkage.initial_states()[0])\n"
        "linkage.simulate((0.0, 1.0), tolerance=1e-3)\n"
    )
    path = tmp_path / "user.py"
    path.write_text(code)
    command = [sys.executable, "-m", "mypy", "--cache-dir", str(tmp_path / "cache"), "--python-executable"]
    place = str(Path(fb.__file__).parents[1])
    environment = {**os.environ, "MYPYPATH": "" if "site-packages" in place else place}
    done = subprocess.run([*command, sys.executable, str(path)], capture_output=True, text=True, env=environment)
    revealed = re.findall(r'Revealed type is "(.*?)"', done.stdout)
    assert revealed[:2] == [
        "fourbar_codegen.compiled_model.CompiledModel",
        "fourbar_codegen.results.trajectory.Trajectory",
    ]
    assert all(text.startswith("numpy.ndarray") for text in revealed[2:])
    assert len(revealed) == 4
    assert 'Unexpected keyword argument "tolerance"' in done.stdout


@pytest.mark.parametrize("environment", [{"NO_COLOR": "1"}, {}])
def test_output_of_info_on_a_terminal_has_no_colours(environment):
    """Nothing is coloured anyway, on a terminal either."""
    assert "\x1b" not in fourbar("info", **environment)


@pytest.mark.slow
def test_animation_saved_on_a_terminal_shows_its_progress_in_frames(tmp_path):
    """On a terminal, up to all frames; not a word elsewhere. Without patience, however fast they are drawn."""
    code = (
        "import fourbar_codegen as fb; from fourbar_codegen.views import figures; figures.QUIET_SECONDS = 0.0\n"
        f"fb.load('four_bar').simulate((0.0, 1.0)).save({str(tmp_path / 'run.gif')!r})"
    )
    frames = [int(number) for number in re.findall(r"(\d+)/31 ", on_terminal("-c", code))]
    assert frames == sorted(frames)
    assert frames[-1] == 31
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stderr == b""


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("fourbar si", "plain,simulate"),
        ("fourbar info sl", "plain,slider_crank"),
        ("fourbar simulate my_mo", "file,my_mo"),
        ("fourbar simulate --method Ra", "plain,Radau"),
        ("fourbar report --constraints b", "plain,baumgarte"),
    ],
)
def test_completion_of_partial_commands_offers_their_words(words, expected):
    """As bash asks for it, by click."""
    number = len(words.split()) - 1
    asked = {"_FOURBAR_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(number)}
    code = "from fourbar_codegen.cli import main; main(prog_name='fourbar')"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **asked})
    assert expected in result.stdout
