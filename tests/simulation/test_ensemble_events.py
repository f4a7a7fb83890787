"""Events of ensembles are those of single runs; a terminal event ends its member alone."""

import math

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import driven_oscillator, oscillator
from scipy.special import ellipk

import fourbar_codegen as fb
from fourbar_codegen.dynamics.formation import form_equations
from fourbar_codegen.lowering.lower import lower
from fourbar_codegen.lowering.schedule import schedule
from fourbar_codegen.simulation import ensemble_run

T = np.linspace(0.0, 4.0, 9)
STIFFNESS = np.linspace(2.0, 4.0, 13)


@pytest.fixture(scope="module")
def loop():
    """The four-bar linkage with an output of positions alone and one of accelerations."""
    model = fb.models.four_bar()
    q1, q2 = model.system.q[:2]
    outputs = {"sine": sm.sin(q1 + q2), "turning": model.system.u[0].diff()}
    force = {me.dynamicsymbols("F"): 100 * sm.sin(sm.pi * me.dynamicsymbols._t)}
    values = {"parameters": model.parameters, "initial": model.initial, "inputs": force}
    return fb.compile_model(fb.Model(model.system, name="loop", outputs=outputs, **values))


def check(ensemble, runs, atol):
    """Times and states of all events, samples, statuses and messages of members are those of single runs."""
    for member, (got, run) in enumerate(zip(ensemble, runs, strict=True)):
        assert (got.status, got.message) == (run.status, run.message)
        np.testing.assert_allclose(got.t, run.t, rtol=0, atol=atol)
        np.testing.assert_allclose(got.y, run.y, rtol=0, atol=atol)
        for k, (times, states) in enumerate(zip(run.t_events, run.y_events, strict=True)):
            np.testing.assert_allclose(ensemble.t_events[k][member], times, rtol=0, atol=atol)
            np.testing.assert_allclose(ensemble.y_events[k][member], states, rtol=0, atol=atol)
            np.testing.assert_array_equal(got.t_events[k], ensemble.t_events[k][member])


EVENTS = {
    "states": ["u1", fb.Event("q2", direction=-1)],
    "outputs": ["sine", fb.Event("turning", all_roots=False)],
    "others": ["potential_energy", "lambda1", "spin_z", fb.Event("t")],
    "callable": [lambda t, x: math.sin(7.0 * t)],
    "terminal": [fb.Event("u1", terminal=2), "q1"],
    "some terminal": [fb.Event(lambda t, x: x[0] + 0.85, terminal=True, direction=-1)],
}


@pytest.mark.parametrize("events", EVENTS.values(), ids=EVENTS)
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5"])
def test_events_of_members_are_those_of_single_runs(loop, method, events):
    """Rounding errors, of 1e-15 a step, grow by some hundred times in 4 s."""
    how = {"method": method, "t_eval": T, "events": events, "rtol": 1e-8}
    ensemble = loop.ensemble((0.0, 4.0), parameters={"k": STIFFNESS}, **how)
    runs = [loop.simulate((0.0, 4.0), parameters={"k": k}, **how) for k in STIFFNESS]
    check(ensemble, runs, 1e-12)
    assert len(ensemble.t_events) == len(ensemble.y_events) == len(events)


def test_members_backwards_with_tables_and_steps_of_fixed_length_have_the_events_of_single_runs(loop):
    table = (np.linspace(0.0, 4.0, 40), np.sin(np.linspace(0.0, 9.0, 40)))
    for how in (
        {"t_span": (4.0, 0.0), "t_eval": T[::-1]},
        {"t_span": (0.0, 4.0), "t_eval": T, "inputs": {"F": table}},
        {"t_span": (0.0, 1.0), "method": "ALI3P", "max_step": 1e-2},
    ):
        ensemble = loop.ensemble(parameters={"k": STIFFNESS}, events=["u1", "sine"], **how)
        how.setdefault("t_eval", how["t_span"])
        check(ensemble, [loop.simulate(parameters={"k": k}, events=["u1", "sine"], **how) for k in STIFFNESS], 1e-12)


@pytest.mark.parametrize("all_roots", [True, False])
def test_zeros_at_the_end_of_a_run_and_beside_its_start_are_those_of_single_runs(all_roots):
    """F = sin(pi t) is -5e-16 at 4 s; x = 0.3 m is the place of the gap."""
    model = driven_oscillator(
        force=sm.sin(sm.pi * me.dynamicsymbols._t), outputs={"gap": me.dynamicsymbols("x") - sm.Rational(3, 10)}
    )
    compiled = fb.compile_model(model)
    x0 = [[0.3 + k * 5.55e-17, v] for k in (-2, -1, 0, 1, 2) for v in (-0.5, 0.0, 0.5)]
    for at_start in (False, True):
        events = [
            fb.Event("F", terminal=4, all_roots=all_roots),
            fb.Event("gap", all_roots=all_roots, at_start=at_start),
        ]
        ensemble = compiled.ensemble((0.0, 4.0), x0, events=events)
        runs = [compiled.simulate((0.0, 4.0), x, events=events, t_eval=(0.0, 4.0)) for x in x0]
        assert {run.status for run in runs} == {1}
        check(ensemble, runs, 1e-12)


def test_what_touches_zero_after_the_end_of_a_member_is_not_said():
    model = fb.compile_model(oscillator())
    events = [fb.Event("t", terminal=True), "kinetic_energy"]
    [message] = model.ensemble((-1.5, 3.0), [[0.3, 0.0]], events=events).messages
    assert message == model.simulate((-1.5, 3.0), [0.3, 0.0], events=events).message
    assert message == "A termination event occurred."


def test_an_output_that_cannot_be_evaluated_in_lanes_leaves_the_equations_there():
    """A maximum of six terms has too many arguments; events by it are those of single runs all the same."""
    x, v = me.dynamicsymbols("x v")
    model = driven_oscillator(force=0, outputs={"most": sm.Max(*[i * x + i**2 * v - 1 for i in range(1, 7)])})
    assert schedule(lower(model.name, form_equations(model))).has_batches
    compiled = fb.compile_model(model)
    x0 = [[0.3, speed] for speed in np.linspace(-1.0, 1.0, 9)]
    ensemble = compiled.ensemble((0.0, 4.0), x0, events="most")
    check(ensemble, [compiled.simulate((0.0, 4.0), each, events="most", t_eval=(0.0, 4.0)) for each in x0], 1e-12)
    assert all(times.size for times in ensemble.t_events[0])


def test_a_terminal_event_ends_its_member_alone(loop):
    """Members that end keep their last state; the others reach the end of the time span."""
    x0 = np.tile(loop.initial_state(), (3, 1))
    event = fb.Event(lambda t, x: x[0] - x0[0, 0] - 0.2, terminal=True)
    ensemble = loop.ensemble((0.0, 4.0), x0, parameters={"c": [10.0, 10.1, 0.0]}, events=event, t_eval=T)
    assert ensemble.status.tolist() == [1, 1, 0]
    assert ensemble.success.all()
    assert ensemble.messages[0] == "A termination event occurred."
    for member in (0, 1):
        [time] = ensemble.t_events[0][member]
        run = ensemble[member]
        assert run.t[-1] == time
        assert run["q1"][-1] == pytest.approx(x0[0, 0] + 0.2, abs=1e-12)
        assert np.isnan(ensemble["q1"][member][time < T]).all()
        assert np.isfinite(ensemble["energy"][member][time >= T]).all()
    assert ensemble.t_events[0][2].size == 0
    assert ensemble.y_events[0][2].shape == (0, loop.n_x)
    assert ensemble[2].t_events[0].size == 0


def test_outputs_of_members_that_an_event_ends_are_saved_at_their_times(loop, tmp_path):
    """Neither the time of the event nor later ones have a value; an event after the last sample adds none."""
    event = fb.Event("u1", terminal=2)
    for t in (T, T[:2]):
        ensemble = loop.ensemble((0.0, 4.0), parameters={"k": [2.0, 3.0]}, events=event, t_eval=t)
        ends = np.array([times[-1] for times in ensemble.t_events[0]])
        with np.load(ensemble.save(tmp_path / "runs.npz")) as saved:
            sine = saved["sine"]
        assert (ends > T[1]).all()
        np.testing.assert_array_equal(np.isfinite(sine), t <= ends[:, np.newaxis])
        np.testing.assert_allclose(sine, np.sin(ensemble["q1"] + ensemble["q2"]), rtol=1e-14)
        np.testing.assert_array_equal(ensemble["sine"], sine)


def test_first_flips_of_double_pendulums():
    """J. S. Heyl, "The double pendulum fractal", 2008: from rest, uniform bars with 3 cos a + cos b > 2 never flip.

    Long runs are chaotic: times of single runs are compared where they are below 2 s.
    """
    model = fb.models.chain(2)
    q1, q2 = model.system.q
    upright = {"upright": sm.cos((q1 + q2 + sm.pi / 2) / 2)}
    values = {"parameters": model.parameters, "initial": model.initial}
    compiled = fb.compile_model(fb.Model(model.system, name="double_pendulum", outputs=upright, **values))
    angles = np.linspace(-3.0, 3.0, 21)
    a, b = map(np.ravel, np.meshgrid(angles, angles, indexing="ij"))
    x0 = np.column_stack([a - np.pi / 2.0, b - a, np.zeros((a.size, 2))])
    how = {"events": fb.Event("upright", terminal=True), "rtol": 1e-9, "atol": 1e-9}
    ensemble = compiled.ensemble((0.0, 10.0), x0, **how)
    assert ensemble.success.all()
    first = np.array([times[0] if times.size else np.inf for times in ensemble.t_events[0]])
    assert np.isinf(first[3.0 * np.cos(a) + np.cos(b) > 2.0]).all()
    assert np.isfinite(first).sum() > 150
    np.testing.assert_array_equal(ensemble.status, np.isfinite(first))
    [soon] = np.nonzero(first < 2.0)
    for member in soon[::10]:
        [times] = compiled.simulate((0.0, 10.0), x0[member], **how).t_events
        assert first[member] == pytest.approx(times[0], rel=1e-10)


def test_members_that_fail_keep_the_events_before(four_bar):
    """The tutorial's linkage without its spring folds flat at 5.34 s."""
    ensemble = four_bar.ensemble((0.0, 20.0), parameters={"k": [0.0, 5.0]}, events="u1")
    runs = [four_bar.simulate((0.0, 20.0), parameters={"k": k}, events="u1", t_eval=(0.0, 20.0)) for k in (0.0, 5.0)]
    assert not ensemble.success[0]
    check(ensemble, runs, 1e-9)
    assert ensemble.t_events[0][0].size


def test_ensembles_without_events_have_none(four_bar):
    ensemble = four_bar.ensemble((0.0, 0.1), parameters={"k": [2.0, 3.0]})
    assert ensemble.t_events is None
    assert ensemble[0].t_events is None
    assert four_bar.ensemble((0.0, 0.1), events=[]).t_events == []


def test_joblib_runs_members_with_events(four_bar, monkeypatch):
    from joblib import Parallel

    monkeypatch.setattr(ensemble_run, "BLOCK", 3)
    how = {"parameters": {"k": STIFFNESS}, "events": ["u1", fb.Event("q1", terminal=1)], "t_eval": T}
    ensemble = four_bar.ensemble((0.0, 4.0), **how)
    found = four_bar.ensemble(
        (0.0, 4.0), parallel=Parallel(2, return_as="generator_unordered", prefer="threads"), **how
    )
    assert len(ensemble) > 6
    np.testing.assert_array_equal(found.events, ensemble.events)


def test_rows_of_events_are_sorted_by_event_member_and_time(four_bar):
    """Members with a callable run one by one, the others in lanes."""
    for first in ("u1", lambda t, x: x[3]):
        ensemble = four_bar.ensemble((0.0, 4.0), parameters={"k": STIFFNESS}, events=[first, "q1"], rtol=1e-8)
        rows = ensemble.events
        assert ensemble.n_events == 2
        assert rows.shape == (sum(len(times) for of in ensemble.t_events for times in of), 3 + len(four_bar.states))
        np.testing.assert_array_equal(np.lexsort((rows[:, 2], rows[:, 0], rows[:, 1])), np.arange(len(rows)))
        for member in (0, len(STIFFNESS) - 1):
            of_first = rows[(rows[:, 0] == member) & (rows[:, 1] == 0)]
            run = four_bar.simulate((0.0, 4.0), parameters={"k": STIFFNESS[member]}, events="u1", rtol=1e-8)
            np.testing.assert_allclose(of_first[:, 2], run.t_events[0], rtol=0, atol=1e-12)
            np.testing.assert_allclose(of_first[:, 3:], run.y_events[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", ["CVODE", "IDA", "BDF"])
def test_methods_that_run_one_after_another_in_python_are_refused(four_bar, method):
    with pytest.raises(fb.ModelError, match=f"no method for ensembles.*{method}.*DOP853.*ALI3P"):
        four_bar.ensemble((0.0, 1.0), method=method)


def test_bad_events_of_ensembles_are_refused(four_bar):
    with pytest.raises(fb.ModelError, match="names of quantities"):
        four_bar.ensemble((0.0, 1.0), events="nothing")


def test_pendulums_pass_the_lowest_point_after_a_quarter_of_their_period():
    """The period of amplitude a is 4 K(sin(a/2)) sqrt(l/g); of a uniform bar, l is 2/3 of its length."""
    model = fb.compile_model(fb.models.chain(1))
    amplitudes = np.linspace(0.2, 2.8, 9)
    x0 = np.column_stack([amplitudes - np.pi / 2.0, np.zeros(9)])
    lowest = fb.Event(lambda t, x: x[0] + np.pi / 2.0, terminal=1)
    ensemble = model.ensemble((0.0, 10.0), x0, events=lowest, rtol=1e-11, atol=1e-12)
    unit = np.sqrt(2.0 / 3.0 * model.defaults["l"] / model.defaults["g"])
    times = np.concatenate(ensemble.t_events[0])
    np.testing.assert_allclose(times, unit * ellipk(np.sin(amplitudes / 2.0) ** 2), rtol=1e-9)
