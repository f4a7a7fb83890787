"""Runs end where the equations lead the motion back to a jump from both sides, as dry friction does where it sticks."""

import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import loaded, on_a_line
from harness.c_library import Library

import fourbar_codegen as fb

MU, V = sm.symbols("mu v_0")
JUMP = "lead the motion back to the jump from both sides"
LAWS = {
    "sign of v": lambda x, v, t: -MU * sm.sign(v),
    "Piecewise of v": lambda x, v, t: -MU * sm.Piecewise((1, v > 0), (-1, True)),
    "Heaviside of v": lambda x, v, t: -MU * (2 * sm.Heaviside(v) - 1),
}
METHODS = ["DOP853", "RK45", "Tsit5", "Radau", "CVODE"]


@pytest.fixture(scope="module")
def rubbing():
    """Oscillators with dry friction, by their laws; m = 2 kg, k = 8 N/m, mu = 0.5 N."""
    made = {}

    def get(law):
        if law not in made:
            made[law] = loaded(LAWS[law])
        return made[law]

    return get


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("law", LAWS)
def test_an_oscillator_with_dry_friction_stops_where_it_sticks(rubbing, law, method):
    """Each half turn of pi/2 s ends 2 mu/k = 0.125 m closer: 0.3, -0.175, 0.05 m, where the spring cannot overcome mu.

    The local errors of the two half turns' some ten to a hundred steps are 1e-6 relative to 0.3 m.
    """
    if method == "CVODE":
        pytest.importorskip("sksundae")
    run = rubbing(law).simulate((0.0, 10.0), method=method, rtol=1e-6, atol=1e-9)
    assert run.status == -1
    assert f"The equations jump at {law}, and {JUMP}" in run.message
    assert "tanh" in run.message
    assert run.t[-1] == pytest.approx(np.pi, abs=1e-3)
    assert run["x"][-1] == pytest.approx(0.05, abs=1e-4)
    assert run.nfev < 1e5
    whole = rubbing(law).simulate((0.0, 3.1), method=method, rtol=1e-6, atol=1e-9)
    assert whole.success
    assert whole["x"][-1] == pytest.approx(-0.0625 + 0.1125 * np.cos(2.0 * 3.1), abs=1e-4)


@pytest.mark.parametrize("start", [[0.05, 0.0], [0.05, 1e-12], [-0.03, -1e-6]])
@pytest.mark.parametrize("method", METHODS)
def test_a_run_that_begins_where_friction_sticks_ends_there(rubbing, method, start):
    if method == "CVODE":
        pytest.importorskip("sksundae")
    run = rubbing("sign of v").simulate((0.0, 10.0), start, method=method)
    assert JUMP in run.message
    assert run.t[-1] < 1e-2
    assert run.nfev < 1e5


@pytest.mark.parametrize("how", [{"dense_output": True}, {"t_eval": [0.0, 5.0]}, {"gradient": True}, {"events": ["x"]}])
def test_runs_of_all_kinds_end_where_friction_sticks(rubbing, how):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fb.ModelWarning)  # of derivatives beside jumps
        run = rubbing("sign of v").simulate((0.0, 10.0), **how)
    assert JUMP in run.message
    assert float(run.message.split("t = ")[1].split(":")[0]) == pytest.approx(np.pi, abs=1e-3)


def test_a_run_in_steps_of_fixed_length_ends_where_friction_sticks(rubbing):
    run = rubbing("sign of v").simulate((0.0, 10.0), method="ALI3P", max_step=1e-3)
    assert JUMP in run.message
    assert run.t[-1] == pytest.approx(np.pi, abs=5e-3)  # each jump costs an error of the order of a step


def test_members_of_ensembles_end_where_friction_sticks(rubbing):
    """Those with the same numbers of half turns stop at the same time, others swing on."""
    x0 = np.column_stack([np.linspace(0.2, 2.0, 19), np.zeros(19)])
    ensemble = rubbing("sign of v").ensemble((0.0, 7.0), x0, t_eval=[0.0, 7.0])
    turns = np.ceil((x0[:, 0] - 0.0625) / 0.125)
    np.testing.assert_array_equal(ensemble.success, turns * np.pi / 2.0 > 7.0)
    for message in np.array(ensemble.messages)[~ensemble.success]:
        assert JUMP in message


def test_a_c_library_ends_a_run_where_friction_sticks(tmp_path):
    x, v = me.dynamicsymbols("x v")
    model = fb.Model(on_a_line(2, -8 * x - sm.sign(v) / 2), name="rubbing", initial={x: 0.3, v: 0.0})
    library = Library(model, tmp_path)
    mechanism = library.new()
    status = library.call("simulate", mechanism, 10.0, 1e-6, 1e-9, None, 0, None)
    assert "led back to a jump of the equations from both sides" in library.message(status)
    assert mechanism.t == pytest.approx(np.pi, abs=1e-3)


@pytest.mark.parametrize(
    ("law", "text"),
    [
        (lambda x, v, t: -9 * sm.sign(v - V), "sign of v - v_0"),
        (lambda x, v, t: -4 * sm.sign(2 * x + v), "sign of v + 2*x"),
        (lambda x, v, t: -9 * sm.sign(v - sm.sin(t)), "sign of v - sin(t)"),
    ],
)
def test_belts_and_relays_are_named_by_their_condition(law, text):
    """A mass that a belt takes along, of constant and of changing speed; sliding mode control."""
    run = loaded(law).simulate((0.0, 10.0), [0.0, 0.51])
    assert f"The equations jump at {text}, and {JUMP}" in run.message
    assert run.nfev < 1e5


@pytest.mark.parametrize(
    "law",
    [
        lambda x, v, t: -1000 * sm.sign(x),
        lambda x, v, t: -1e6 * sm.Min(x, 0),
        lambda x, v, t: sm.Piecewise((-1e5 * x, x < 0), (5, True)),
        lambda x, v, t: MU * sm.sign(v),
    ],
    ids=["relay of a place", "contact", "contact with a jump", "driving force"],
)
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Radau"])
def test_jumps_that_the_motion_passes_do_not_end_runs(law, method):
    assert loaded(law).simulate((0.0, 10.0), [0.3, 0.1], method=method).success


@pytest.mark.parametrize("method", ["DOP853", "RK45"])
def test_friction_under_a_fast_square_wave_does_not_stick(method):
    """The force is 60 times the friction, so that the speed changes its sign every 1.6 ms; 2e6 steps to the end."""
    law = loaded(lambda x, v, t: -MU * sm.sign(v) + 30 * sm.sign(sm.cos(2000 * t)))
    run = law.simulate((0.0, 100.0), [0.3, 0.0], method=method, max_steps=200_000)
    assert "max_steps = 200000 is reached" in run.message


def test_a_jump_of_the_integer_part_is_named_by_its_variable():
    run = loaded(lambda x, v, t: -MU * sm.floor(v) - MU / 2).simulate((0.0, 10.0), [0.3, 0.1])
    assert f"The equations jump at floor of v, and {JUMP}" in run.message


def test_motions_that_leave_a_jump_backwards_are_not_ended(rubbing):
    """Backwards in time, dry friction drives the mass away from rest."""
    assert rubbing("sign of v").simulate((5.0, 0.0), [0.04, 1e-9]).success
