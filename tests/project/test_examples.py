"""Every example runs, and says what is known from elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from harness import PROJECT

pytestmark = pytest.mark.slow

EXAMPLES = PROJECT / "examples"


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    """Runs an example in a folder of its own; what it prints, and the folder."""

    def run(name):
        folder = tmp_path_factory.mktemp(name)
        command = [sys.executable, "-W", "error", str(EXAMPLES / f"{name}.py")]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        # What takes long says how far it is.
        assert all(re.fullmatch(r".+: .+, \d+ s", line) for line in done.stderr.splitlines()), done.stderr
        written = [line for line in done.stdout.splitlines() if line.startswith("results/")]
        assert {path for path in folder.rglob("*") if path.is_file()} == {folder / path for path in written}
        return done.stdout

    return run


def numbers(text, pattern):
    return [float(number) for number in re.findall(pattern, text)]


def test_every_example_is_run_by_a_test():
    tested = Path(__file__).read_text(encoding="utf-8")
    for path in EXAMPLES.glob("*.py"):
        assert f'said("{path.stem}")' in tested


def test_example_of_the_arm_prints_the_tutorials_angles_and_forcing(said):
    """The tutorial's initial angles and forcing, to the digits that are printed there; its runs are in test_muscles."""
    text = said("10_muscles_of_an_arm")
    assert "angles, degrees: 5.0 -0.60986636 9.44918589 88.68812842" in text
    assert numbers(text, r"forcing: (\S+)") == [-0.9121071]
    gaps = numbers(text, r"violation (\S+) m")
    assert len(gaps) == 2
    assert all(gap < 1e-13 for gap in gaps)


def test_example_of_the_four_bar_keeps_its_loop_closed(said):
    [gap] = numbers(said("01_four_bar"), r"violation is (\S+) m")
    assert gap < 1e-12


def test_example_of_coupler_curves_satisfies_holditchs_theorem(said):
    """Holditch's theorem: half of the crank's circle; of a polygon with 180 corners, and a curve, 2e-4 less."""
    shares = numbers(said("02_coupler_curves"), r"(\S+) of the crank's circle")
    assert len(shares) == 8
    np.testing.assert_allclose(shares, 0.5, rtol=2 * (np.pi / 180) ** 2)


def test_example_of_joint_forces_balances_the_slider(said):
    [gap] = numbers(said("03_joint_forces"), r"error of the slider's force balance is (\S+) N")
    assert gap < 1e-10


def test_example_of_the_bicycle_prints_the_published_speeds(said):
    """To the nine digits that are printed; the published ones have sixteen."""
    found = re.findall(r"speed (\S+) m/s, published (\S+) m/s", said("04_bicycle_eigenvalues"))
    assert len(found) == 2
    assert all(ours == published for ours, published in found)


def test_example_of_the_fit_finds_the_true_values_within_its_errors(said):
    """Within three standard deviations of what the measurement was made with."""
    found = re.findall(r"= (\S+) \+- (\S+), measured with (\S+)", said("05_parameter_fit"))
    assert len(found) == 2
    for value, deviation, true in found:
        assert abs(float(value) - float(true)) < 3 * float(deviation)


def test_example_of_path_synthesis_reaches_its_points_from_several_starts(said):
    """Lengths that the problem allows, a path within 1e-3 of its five points, from several starts."""
    text = said("12_path_synthesis")
    squares = numbers(text, r"sum of squares (\S+) after")
    assert sum(each < 1e-6 for each in squares) > 2
    assert all(0.1 <= length <= 50.0 for length in numbers(text, r"l\d = (\S+),"))


def test_example_of_the_controller_keeps_the_linkage_upright(said):
    text = said("06_feedback_control")
    [error] = numbers(text, r"is (\S+) rad from upright")
    assert error < 1e-3
    assert "4.38] 1/s\nwith it" in text  # it falls without


def test_example_of_the_ensemble_has_the_spread_of_its_slopes(said):
    text = said("07_ensemble")
    assert "10000 successful" in text
    # Three independent lengths: their contributions add up as squares.
    [spread] = numbers(text, r"deviation (\S+) rad")
    slopes = numbers(text, r"longer: (\S+) rad")
    assert np.linalg.norm(slopes) == pytest.approx(spread, abs=2e-4)


def test_example_of_the_stiff_drive_needs_far_fewer_steps_by_radau(said):
    lines = said("08_stiff_drive").splitlines()[1:]
    evaluations = {line.split()[0]: int(line.split()[1]) for line in lines}
    assert evaluations["DOP853"] > 50 * evaluations["Radau"]


def test_example_of_the_rider_assembles_from_zero_and_stays_upright(said):
    """Assembled from zero, with 17 constraints, and upright for 4 s at 4.5 m/s."""
    text = said("09_rider_on_a_bicycle")
    assert "27 coordinates, 17 constraints" in text
    [violation] = numbers(text, r"constraint violation (\S+)")
    [lean] = numbers(text, r"lean angle (\S+) rad")
    [ridden] = numbers(text, r"distance (\S+) m")
    assert violation < 1e-10
    assert lean < 0.2
    assert ridden == pytest.approx(4 * 4.5, rel=0.05)


def test_example_of_mechanisms_prints_the_known_numbers_of_branches(said):
    """Ways in which they close: two for each dyad that closes by itself. More about them is in test_kinematics."""
    text = said("11_mechanisms")
    branches = dict(re.findall(r"(\w+): (\d+) branches", text))
    assert len(branches) == 12
    assert [branches[name] for name in ("crank_rocker", "slider_crank", "quick_return", "peaucellier", "hoeken")] == [
        "2", "2", "2", "4", "2",
    ]  # fmt: skip


def test_example_of_pictures_has_a_top_that_precesses_steadily_and_a_stone_that_turns_back(said):
    text = said("13_pictures_of_bodies")
    found, expected = map(float, re.search(r"precession (\S+) rad/s, by its equation (\S+)", text).groups())
    assert found == pytest.approx(expected, rel=1e-4)
    first, later = map(float, re.search(r"turns at (\S+) rad/s, later at (\S+) rad/s", text).groups())
    assert first < 0.0 < later
    assert text.count("results/") == 18
