"""Events of a stepper: within steps, in the parts of steps, and where inputs jump between steps."""

import math
import pickle

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import driven_oscillator

import fourbar_codegen as fb

CUBIC = {"parameters": {"m": 1.0}, "inputs": {"F": ([-8.0, 8.0], [-36.0, 60.0])}}
"""x'' = 6 t + 12: with x(-8) = -120, v(-8) = 92, x = (t + 6) (t + 2) (t - 2)."""


@pytest.fixture(scope="module")
def free():
    """A mass of 2 kg without a spring, x'' = F / m."""
    return fb.compile_model(
        driven_oscillator(parameters={"k": 0.0}, outputs={"acceleration": me.dynamicsymbols("F") / sm.Symbol("m")})
    )


def steps_of(stepper, t_end, inputs=lambda t, x: None):
    """The times of all events up to a time, in the order of the steps."""
    found = [[] for _ in stepper.t_events]
    while stepper.t < t_end - 1e-9 and not stepper.status:
        stepper.step(inputs(stepper.t, stepper.x))
        for all_times, times in zip(found, stepper.t_events, strict=True):
            all_times.extend(times)
    return found


@pytest.mark.parametrize("h", [16.0, 4.0, 1.0])
@pytest.mark.parametrize("function", ["x", lambda t, x: x[0]])
def test_all_roots_of_a_cubic_in_one_step(free, h, function):
    """The method and its interpolant are exact for polynomials of degree 3."""
    stepper = free.stepper(h, [-120.0, 92.0], t=-8.0, events=function, **CUBIC)
    assert steps_of(stepper, 8.0)[0] == pytest.approx([-6.0, -2.0, 2.0], abs=1e-13)
    backwards = free.stepper(-h, [840.0, 284.0], t=8.0, events=function, **CUBIC)
    found = []
    while backwards.t > -8.0:
        backwards.step()
        found.extend(backwards.t_events[0])
    assert found == pytest.approx([2.0, -2.0, -6.0], abs=1e-13)


@pytest.mark.parametrize(
    ("direction", "terminal", "expected"),
    [(1, False, [-6.0, 2.0]), (-1, False, [-2.0]), (0, True, [-6.0]), (0, 2, [-6.0, -2.0]), (1, 2, [-6.0, 2.0])],
)
@pytest.mark.parametrize("h", [16.0, 1.0])
def test_directions_and_counts(free, h, direction, terminal, expected):
    event = fb.Event("x", direction=direction, terminal=terminal)
    stepper = free.stepper(h, [-120.0, 92.0], t=-8.0, events=event, **CUBIC)
    assert steps_of(stepper, 8.0)[0] == pytest.approx(expected, abs=1e-13)
    assert stepper.status == int(bool(terminal))
    if terminal:
        assert stepper.t == stepper.t_events[0][-1]
        np.testing.assert_array_equal(stepper.x, stepper.y_events[0][-1])
        with pytest.raises(fb.SimulationError, match="Event 0 of this stepper, counted from 0, has ended the run"):
            stepper.step()
        again = pickle.loads(pickle.dumps(stepper))
        assert (again.t, again.status, list(again.t_events[0])) == (stepper.t, 1, list(stepper.t_events[0]))
        np.testing.assert_array_equal(again.x, stepper.x)


def test_a_terminal_event_of_several_ends_the_step_that_has_no_later_ones(free):
    events = [fb.Event(lambda t, x, at=at: t - at) for at in (1.0, -3.0, 0.5, -5.0)]
    stepper = free.stepper(16.0, [-120.0, 92.0], t=-8.0, events=[*events, fb.Event("x", terminal=2)], **CUBIC)
    stepper.step()
    assert [list(times) for times in stepper.t_events[:4]] == [[], [-3.0], [], [-5.0]]
    assert stepper.t_events[4] == pytest.approx([-6.0, -2.0], abs=1e-13)
    assert [states.shape for states in stepper.y_events] == [(0, 2), (1, 2), (0, 2), (1, 2), (2, 2)]


def test_times_of_an_oscillator_converge_with_order_4(free):
    """x = cos(w t), w = 2: zero at (k + 1/2) pi / w."""
    exact = (np.arange(6) + 0.5) * math.pi / 2.0
    errors = []
    for h in (0.05, 0.025):
        stepper = free.stepper(h, [1.0, 0.0], parameters={"k": 8.0}, inputs={"F": 0.0}, events=["x", "v"])
        zeros, rests = steps_of(stepper, 10.0)
        assert len(rests) == 6  # not the start, where it rests
        errors.append(np.abs(np.array(zeros[:6]) - exact).max())
    assert errors[0] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.2)


def test_states_at_events_satisfy_the_constraints_and_times_are_those_of_simulate(four_bar):
    run = four_bar.simulate((0.0, 4.0), events=["u1", "u3"], rtol=1e-10, atol=1e-10)
    stepper, found = four_bar.stepper(1e-3, events=["u1", "u3"]), [[], []]
    while stepper.t < 4.0 - 1e-9:
        stepper.step()
        for times, more, states in zip(found, stepper.t_events, stepper.y_events, strict=True):
            times.extend(more)
            for t, x in zip(more, states, strict=True):
                assert abs(four_bar.position_constraints(t, x[:3])).max() < 1e-12
    for times, expected in zip(found, run.t_events, strict=True):
        # the error of the method at this step, 1e-10, over the smallest angular acceleration at rest
        np.testing.assert_allclose(times, expected, rtol=0.0, atol=1e-9)


def test_inputs_that_jump_between_steps_are_events_at_the_beginnings_of_steps(free):
    """The acceleration is F / m: it jumps with F, which a control holds over each step."""
    held = {0: 1.0, 3: -1.0, 4: -2.0, 7: 0.5}
    values = [next(value for k, value in reversed(held.items()) if k <= step) for step in range(10)]
    stepper = free.stepper(0.25, [0.0, 0.0], inputs={"F": 0.0}, events=["F", "acceleration", "v"])
    at_jumps, of_outputs, of_speeds = steps_of(stepper, 2.5, lambda t, x: {"F": values[round(t / 0.25)]})
    assert at_jumps == of_outputs == [0.75, 1.75]
    # v rises by 1/2 m/s^2 up to 0.75 s, and falls by 1/2 in one step and by 1 then
    assert of_speeds == pytest.approx([1.25], abs=1e-14)


def test_events_in_the_parts_of_a_step_that_breakpoints_divide(free):
    """F jumps within a step from 4 N to -8 N at 0.5 s: v = 2 t up to there, then 1 - 4 (t - 0.5), zero at 0.75 s."""
    table = {"F": ([0.0, 0.5], [4.0, -8.0], "hold")}
    stepper = free.stepper(1.0, [0.0, 0.0], inputs=table, events=["v", "F"])
    stepper.step()
    assert stepper.t_events[0] == pytest.approx([0.75], abs=1e-15)
    assert stepper.t_events[1] == pytest.approx([0.5], abs=1e-15)
    # x = t^2 up to 0.25 m, then 0.25 + (t - 0.5) - 2 (t - 0.5)^2
    np.testing.assert_allclose(stepper.y_events[0], [[0.375, 0.0]], rtol=0.0, atol=1e-15)


def test_a_start_on_the_surface_is_no_event_unless_that_is_asked_for(free):
    for at_start, expected in ((False, [2.0]), (True, [0.0, 2.0])):
        event = fb.Event("x", at_start=at_start)
        stepper = free.stepper(0.3, [0.0, 1.0], inputs={"F": -2.0}, events=event)  # x = t - t^2 / 2
        assert steps_of(stepper, 3.0)[0] == pytest.approx(expected, abs=1e-14)


def test_a_stepper_is_unchanged_by_a_step_that_fails(free):
    fails = True

    def early(t, x):
        if fails and t > 0.35:
            raise ValueError("no value")
        return x[0] - 0.5 * 0.45**2 / 2.0

    stepper = free.stepper(0.1, [0.0, 0.0], inputs={"F": 1.0}, events=["v", early])
    for _ in range(3):
        stepper.step()
    before = pickle.dumps((stepper.t, stepper.x, stepper.t_events, stepper.status))
    with pytest.raises(ValueError, match="no value"):
        stepper.step()
    assert pickle.dumps((stepper.t, stepper.x, stepper.t_events, stepper.status)) == before
    fails = False
    assert steps_of(stepper, 1.0)[1] == pytest.approx([0.45], abs=1e-14)


def test_a_pickled_stepper_goes_on_with_its_events(four_bar):
    event = fb.Event("u1", direction=-1, terminal=3)
    stepper = four_bar.stepper(1e-2, events=event)
    for _ in range(100):
        stepper.step()
    other = pickle.loads(pickle.dumps(stepper))
    assert steps_of(stepper, 9.0) == steps_of(other, 9.0)
    assert stepper.status == other.status == 1
    assert stepper.t == other.t


def test_ends_of_steps_alone(free):
    """Two roots within a step: none without `all_roots`, by one call a step and those beside its ends."""
    for all_roots, expected in ((True, [-6.0, -2.0]), (False, [])):
        event = fb.Event("x", all_roots=all_roots)
        stepper = free.stepper(8.5, [-120.0, 92.0], t=-8.0, events=event, **CUBIC)
        stepper.step()
        assert stepper.t_events[0] == pytest.approx(expected, abs=1e-13)
