"""Events: all roots within a step, in all methods, and where functions begin at zero."""

import math
import re
import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.oscillators import driven_oscillator

import fourbar_codegen as fb

METHODS = ("DOP853", "RK45", "Tsit5", "ALI3P", "Radau", "CVODE", "IDA")
SPACING = 32.0 * np.spacing(10.0)
"""A time of some seconds by its step's beginning and length, and a root of a function that is evaluated there."""


@pytest.fixture(scope="module")
def cubic():
    """y'' = 6 t + 12: with y(-8) = -120, y'(-8) = 92, y = (t + 6) (t + 2) (t - 2)."""
    t = me.dynamicsymbols._t
    y, v = me.dynamicsymbols("y v")
    m = sm.Symbol("m")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    place = origin.locatenew("P", y * frame.x)
    place.set_vel(frame, v * frame.x)
    method = me.KanesMethod(frame, [y], [v], kd_eqs=[v - y.diff(t)])
    method.kanes_equations([me.Particle("P", place, m)], [(place, m * (6 * t + 12) * frame.x)])
    return fb.compile_model(fb.Model(method, parameters={m: 1.0}, outputs={"place": y}))


@pytest.fixture(scope="module")
def oscillator():
    """x'' = -x, so that x = cos(t), v = -sin(t) from (1, 0)."""
    t = me.dynamicsymbols._t
    x, v = me.dynamicsymbols("x v")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    place = origin.locatenew("P", x * frame.x)
    place.set_vel(frame, v * frame.x)
    method = me.KanesMethod(frame, [x], [v], kd_eqs=[v - x.diff(t)])
    method.kanes_equations([me.Particle("P", place, sm.Integer(1))], [(place, -x * frame.x)])
    return fb.compile_model(fb.Model(method))


def run_of(cubic, method, span, x0, **how):
    given = {"max_step": 0.01} if method == "ALI3P" else {"rtol": 1e-9, "atol": 1e-9}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return cubic.simulate(span, x0, method=method, **given, **how)


@pytest.mark.parametrize("method", METHODS)
def test_all_roots_of_a_cubic_within_few_steps(cubic, method):
    """SciPy's solve_ivp finds the first of three, https://github.com/scipy/scipy/issues/9228."""
    # Steps of 0.01 s by the trapezoidal rule have an error of 6 h^2 / 12 times the time that y takes; the multistep
    # methods' errors are some hundred tolerances, over a least slope of 16.
    atol = 1e-4 if method == "ALI3P" else 1e-6
    for function in ("y", "place", lambda t, x: x[0]):
        ahead = run_of(cubic, method, (-8.0, 8.0), [-120.0, 92.0], events=function)
        back = run_of(cubic, method, (8.0, -8.0), [840.0, 284.0], events=function)
        np.testing.assert_allclose(ahead.t_events[0], [-6.0, -2.0, 2.0], rtol=0.0, atol=atol)
        np.testing.assert_allclose(back.t_events[0], [2.0, -2.0, -6.0], rtol=0.0, atol=atol)
    assert method not in {"DOP853", "RK45", "Tsit5"} or len(ahead.t) < 10


@pytest.mark.parametrize(
    ("direction", "terminal", "expected"),
    [
        (0, False, [-6.0, -2.0, 2.0]), (1, False, [-6.0, 2.0]), (-1, False, [-2.0]), (0, True, [-6.0]),
        (0, 2, [-6.0, -2.0]), (0, 3, [-6.0, -2.0, 2.0]), (0, 4, [-6.0, -2.0, 2.0]), (1, 2, [-6.0, 2.0]),
        (-1, True, [-2.0]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("t_eval", [None, np.linspace(-8.0, 8.0, 17)])
@pytest.mark.parametrize("backwards", [False, True])
def test_directions_and_counts_within_one_step(cubic, direction, terminal, expected, t_eval, backwards):
    span, x0, sign = (-8.0, 8.0), [-120.0, 92.0], 1
    if backwards:  # in the mirror t -> -4 - t, y -> -y
        span, x0, sign = (4.0, -12.0), [120.0, 92.0], -1
        expected = [-4.0 - t for t in expected]
        t_eval = None if t_eval is None else -4.0 - t_eval
    event = fb.Event("y", direction=sign * direction, terminal=terminal)
    run = cubic.simulate(span, x0, rtol=1e-9, atol=1e-9, events=event, t_eval=t_eval, dense_output=True)
    np.testing.assert_allclose(run.t_events[0], expected, rtol=0.0, atol=1e-9)
    ends = bool(terminal) and len(expected) == int(terminal)
    assert run.status == int(ends)
    assert run.t[-1] == (run.t_events[0][-1] if ends else span[1])
    np.testing.assert_allclose(run.sol(run.t_events[0])[0], 0.0, rtol=0.0, atol=1e-12 * 840.0)
    if t_eval is not None:
        asked = [t for t in t_eval if abs(t - span[0]) < abs(run.t[-1] - span[0])]
        np.testing.assert_array_equal(run.t[:-1], asked)


def test_events_of_one_step_are_in_the_order_of_times_and_end_at_the_first_terminal_one(cubic):
    times = [1.0, -3.0, 0.5, -5.0, 3.0]
    events = [fb.Event(lambda t, x, at=at: t - at) for at in times]
    run = cubic.simulate((-8.0, 8.0), [-120.0, 92.0], events=[*events, fb.Event("y", terminal=2)])
    assert run.t_events[-1] == pytest.approx([-6.0, -2.0])
    assert [len(found) for found in run.t_events[:-1]] == [0, 1, 0, 1, 0]
    assert run.t[-1] == run.t_events[-1][-1]


def _products(rng, gap):
    """Factors whose product has a pair of roots at a distance, and others; and the roots, from 0 to 10."""
    first = rng.uniform(0.5, 9.0)
    roots = np.array([first, first + gap, *rng.uniform(0.5, 9.5, rng.integers(0, 4))])
    if rng.integers(2):
        return lambda t, x: float(np.prod((t - roots) / 10.0)), np.sort(roots)
    rates = rng.uniform(0.2, 1.5, len(roots))
    more = np.concatenate([roots + k * np.pi / rates for k in range(-10, 11)])
    return lambda t, x: float(np.prod(np.sin(rates * (t - roots)))), np.sort(more[(more > 0.0) & (more < 10.0)])


@pytest.mark.parametrize("share", [0.5, 1e-2, 1e-3, 1e-4])
def test_no_root_of_random_products_is_missed_down_to_a_distance_of_1e_4_of_a_step(oscillator, share):
    """250 polynomials and products of sines of the time for each distance of a pair of roots."""
    steps = np.diff(oscillator.simulate((0.0, 10.0), [1.0, 0.0]).t)
    rng = np.random.default_rng(round(1.0 / share))
    n = 0
    while n < 250:
        function, roots = _products(rng, share * steps.max())
        if np.diff(roots).min() < 0.99 * share * steps.max() or roots[0] < 0.0 or roots[-1] > 10.0:
            continue
        found = oscillator.simulate((0.0, 10.0), [1.0, 0.0], events=function).t_events[0]
        assert len(found) == len(roots)
        np.testing.assert_allclose(found, roots, rtol=0.0, atol=SPACING)
        n += 1


def test_no_root_through_states_is_missed_down_to_a_hundred_times_the_error_of_the_run(oscillator):
    """sin(t - a) sin(t - b) by the states cos(t), -sin(t)."""
    t_end = 20.0
    reached = oscillator.simulate((0.0, t_end), [1.0, 0.0], rtol=1e-8, atol=1e-8).y[:, -1]
    error = np.abs(reached - [np.cos(t_end), -np.sin(t_end)]).max()
    rng = np.random.default_rng(3)
    for _ in range(100):
        a = rng.uniform(0.1, 3.0)
        shifts = np.array([a, a + 100.0 * error])

        def function(t, x, shifts=shifts):
            return float(np.prod(-x[1] * np.cos(shifts) - x[0] * np.sin(shifts)))

        run = oscillator.simulate((0.0, t_end), [1.0, 0.0], rtol=1e-8, atol=1e-8, events=function)
        roots = np.sort(np.concatenate([shifts + k * np.pi for k in range(7)]))
        roots = roots[roots < t_end]
        assert len(run.t_events[0]) == len(roots)
        np.testing.assert_allclose(run.t_events[0], roots, rtol=0.0, atol=2.0 * error)


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Radau"])
@pytest.mark.parametrize("beside", [0.0, 1e-17, -1e-17, 1e-16, -1e-16])
def test_a_start_on_the_surface_is_no_event_from_either_side(oscillator, method, beside):
    """x = sin(t) begins at zero, to within rounding errors, and returns at pi. SciPy's rule counts the start."""
    how = {"method": method, "rtol": 1e-9, "atol": 1e-9}
    run = oscillator.simulate((0.0, 4.0), [beside, 1.0], events=fb.Event("x", terminal=True), **how)
    assert run.t_events[0] == pytest.approx([np.pi], abs=1e-7)
    # with an offset, the function's terms are larger than what it is at the start
    offset = fb.Event(lambda t, x: (x[0] + 0.3) - 0.3, terminal=True)
    assert oscillator.simulate((0.0, 4.0), [beside, 1.0], events=offset, **how).t[-1] == pytest.approx(
        run.t[-1], abs=1e-12
    )
    if beside <= 0.0:
        start = fb.Event("x", terminal=True, at_start=True)
        assert oscillator.simulate((0.0, 4.0), [beside, 1.0], events=start, **how).t_events[0] == pytest.approx(
            [0.0], abs=1e-15
        )


def test_the_first_return_of_many_starts_on_a_surface_is_a_period(oscillator):
    """A return map goes on from where it ended: x rises through c once in 2 pi."""
    rng = np.random.default_rng(5)
    for level in rng.uniform(-0.9, 0.9, 20):
        surface = fb.Event(lambda t, x, level=level: x[0] - level, direction=1, terminal=True)
        t, x = 0.0, [0.0, 1.0]
        times = []
        for _ in range(4):
            run = oscillator.simulate((t, t + 10.0), x, events=surface, rtol=1e-10, atol=1e-10)
            t, x = run.t[-1], run.y[:, -1]
            times.append(t)
        np.testing.assert_allclose(np.diff(times), 2.0 * np.pi, rtol=0.0, atol=1e-7)


def test_a_function_that_touches_zero_is_said(oscillator):
    run = oscillator.simulate((0.0, 4.0), [1.0, 0.0], rtol=1e-10, atol=1e-10, events=lambda t, x: (t - 2.0) ** 2)
    assert run.t_events[0].size == 0
    assert "<lambda> is zero at t = 2" in run.message
    assert "with the same sign before and after" in run.message
    assert "zero at" not in oscillator.simulate((0.0, 4.0), [1.0, 0.0], events="x").message


def test_a_function_with_kinks_and_jumps_has_its_changes_of_sign(oscillator):
    roots = [1.1, 1.3, 3.7]
    for function, expected in (
        (lambda t, x: abs(t - 1.2) - 0.1, roots[:2]),
        (lambda t, x: 1.0 if roots[0] < t < roots[2] else -1.0, [roots[0], roots[2]]),
        (lambda t, x: max(t - roots[2], -0.5), roots[2:]),
    ):
        found = oscillator.simulate((0.0, 10.0), [1.0, 0.0], events=function).t_events[0]
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=SPACING)


def test_an_event_at_the_end_of_a_run_counts(oscillator):
    for t_end in (2.0, 1.0 / 3.0, 0.1):
        run = oscillator.simulate((0.0, t_end), [1.0, 0.0], events=lambda t, x, t_end=t_end: t - t_end)
        np.testing.assert_array_equal(run.t_events[0], [t_end])


def test_the_ends_of_steps_alone_are_looked_at_if_that_is_asked_for(cubic):
    calls = []

    def function(t, x):
        calls.append(t)
        return x[0]

    how = {"rtol": 1e-9, "atol": 1e-9}
    run = cubic.simulate((-8.0, 8.0), [-120.0, 92.0], events=fb.Event(function, all_roots=False), **how)
    few = len(calls)
    calls.clear()
    cubic.simulate((-8.0, 8.0), [-120.0, 92.0], events=function, **how)
    assert len(run.t_events[0]) % 2 == 1  # the sign changes from first to last
    assert few < len(calls)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("x", lambda x, v: x), ("v", lambda x, v: v), ("kinetic_energy", None), ("momentum_x", lambda x, v: v),
        ("t", None),
    ],
)  # fmt: skip
def test_quantities_are_events_by_their_names(oscillator, name, value):
    found = oscillator.simulate((0.0, 10.0), [1.0, 0.5], rtol=1e-10, atol=1e-10, events=name)
    if value is None:  # positive from the start on, or zero at the start alone
        assert found.t_events[0].size == 0
    else:
        called = oscillator.simulate(
            (0.0, 10.0), [1.0, 0.5], rtol=1e-10, atol=1e-10, events=lambda t, x: value(x[0], x[1])
        )
        assert len(found.t_events[0]) > 2
        np.testing.assert_allclose(found.t_events[0], called.t_events[0], rtol=0.0, atol=SPACING)


def test_what_cannot_be_an_event_is_refused_with_what_can(oscillator):
    with pytest.raises(fb.ModelError, match=r"names of quantities \(x, v, t, kinetic_energy.*not 'speed'"):
        oscillator.simulate((0.0, 1.0), [1.0, 0.0], events="speed")


@pytest.fixture(scope="module")
def mass():
    """q'' = F / m with m = 1."""
    m = sm.Symbol("m")
    q, u, force = me.dynamicsymbols("q u F")
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    place = origin.locatenew("P", q * frame.x)
    place.set_vel(frame, u * frame.x)
    method = me.KanesMethod(frame, [q], [u], kd_eqs=[u - q.diff()])
    method.kanes_equations([me.Particle("P", place, m)], [(place, force * frame.x)])
    return fb.compile_model(fb.Model(method, parameters={m: 1.0}, inputs={force: 0}))


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5", "Radau"])
def test_a_start_at_rest_on_the_surface_is_no_event_however_slowly_it_is_left(mass, method):
    """x - 0.3 = F t^2 / 2 has a double root at the start, and rounding errors of 0.3 in the first steps."""
    for force in np.geomspace(1e-3, 1e4, 15):
        for start in (0.3, np.nextafter(0.3, 0.0), 0.3 - 2.2e-16):
            how = {"method": method, "inputs": {"F": force}, "events": lambda t, x: x[0] - 0.3}
            assert mass.simulate((0.0, 1.0), [start, 0.0], **how).t_events[0].size == 0


@pytest.mark.parametrize("method", ["CVODE", "IDA"])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_jumps_between_interpolants_of_multistep_methods_are_no_events(four_bar, method, tolerance):
    """Chained runs of one event; the interpolant of a step does not begin where the last one ends."""
    how = {"rtol": tolerance, "atol": tolerance, "method": method}
    for offset in np.linspace(1.1, 1.6, 20):
        event = fb.Event(lambda t, x, offset=offset: x[0] + offset, terminal=True)
        exact = four_bar.simulate((0.0, 4.0), events=event.function, rtol=1e-10, atol=1e-10).t_events[0]
        first = four_bar.simulate((0.0, 4.0), events=event, **how)
        second = four_bar.simulate((first.t[-1], 4.0), first.y[:, -1], events=event, **how)
        # the error of the run over a speed of 0.1 rad/s or more
        np.testing.assert_allclose([first.t[-1], second.t[-1]], exact[:2], rtol=0.0, atol=200.0 * tolerance)


def test_an_event_where_two_runs_meet_is_in_one_of_them(mass):
    for rate in np.linspace(1.0, 20.0, 40):
        for k in (1, 2):
            join, end = k * np.pi / rate, (k + 0.9) * np.pi / rate

            def function(t, x, rate=rate):
                return np.sin(rate * t)

            before = mass.simulate((0.0, join), [0.0, 1.0], events=function).t_events[0]
            after = mass.simulate((join, end), [join, 1.0], events=function).t_events[0]
            assert len(before) + len(after) == k


def test_a_zero_at_a_breakpoint_is_an_event_if_the_sign_changes(mass):
    """Steps end at breakpoints, where a run goes on."""
    kinked = {"F": ([0.0, 0.25, 0.5, 0.75, 1.0], [1.0, 0.0, 1.0, 0.0, -1.0])}
    for begin, end in ((0.0, 1.0), (1.0, 0.0)):
        run = mass.simulate((begin, end), [0.0, 1.0], inputs=kinked, events="F", rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(run.t_events[0], [0.75], rtol=0.0, atol=1e-15)
        assert "F is zero at t = 0.25" in run.message
    touching = fb.Event(lambda t, x: (t - 0.5) ** 2, terminal=True, direction=-1)
    assert mass.simulate((0.0, 1.0), [0.0, 1.0], inputs=kinked, events=touching).t_events[0].size == 0


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5", "Radau"])
def test_a_state_that_touches_zero_at_a_breakpoint_within_rounding_errors_has_no_event(mass, method):
    """u = 1 - 2 t, then slopes of -4, 2 and -1: zero at 0.375, and at 0.75 with negative values on both sides."""
    forces = {"F": ([0.0, 0.25, 0.5, 0.75, 1.0], [-2.0, -4.0, 2.0, -1.0, 0.0], "hold")}
    run = mass.simulate((0.0, 1.0), [0.0, 1.0], inputs=forces, events="u", method=method, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.t_events[0], [0.375], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("max_step", [np.inf, 0.1, 0.01])
def test_a_function_that_becomes_zero_and_stays_so_has_an_event_where_that_begins(mass, max_step):
    run = mass.simulate(
        (0.0, 1.0), [0.0, 1.0], events=fb.Event(lambda t, x: max(0.75 - t, 0.0), terminal=True), max_step=max_step
    )
    np.testing.assert_allclose(run.t_events[0], [0.75], rtol=0.0, atol=SPACING)
    assert run.t[-1] == run.t_events[0][0]


def test_hundreds_of_roots_in_one_step_are_found(mass):
    run = mass.simulate((0.0, 10.0), [0.0, 1.0], events=lambda t, x: np.sin(1000.0 * t))
    assert len(run.t) < 10
    np.testing.assert_allclose(run.t_events[0], np.arange(1, 3184) * np.pi / 1000.0, rtol=0.0, atol=SPACING)


def test_functions_may_have_no_value_beside_the_run_and_within_it(mass):
    """1 - q = 1 + t is never negative, but it is beside the start; NaN is no zero."""
    rooted = mass.simulate((0.0, 1.0), [1.0, -1.0], events=lambda t, x: math.sqrt(1.0 - x[0]) - 0.5)
    np.testing.assert_allclose(rooted.t_events[0], [0.25], rtol=0.0, atol=SPACING)
    holes = mass.simulate((0.0, 1.0), [0.0, 1.0], events=lambda t, x: np.nan if 0.4 < t < 0.6 else 1.0)
    assert "zero" not in holes.message


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5"])
def test_a_terminal_event_before_a_singular_position_ends_the_run_in_the_same_step(four_bar, method):
    """At 5.33697 s all bars are in line; afterwards nothing is known, so that events there do not count."""
    how = {"method": method, "rtol": 1e-3, "atol": 1e-6}
    failed = four_bar.simulate((0.0, 20.0), **how)
    singular = float(re.search(r"singular position at t = (\S+),", failed.message)[1])
    begin = failed.t[-1]
    assert begin < singular
    for share, status in ((0.5, 1), (1.5, -1)):
        at = begin + share * (singular - begin)
        events = [
            fb.Event(lambda t, x, at=at: t - at, terminal=True),
            lambda t, x: t - begin - 1e-3 * (singular - begin),
        ]
        run = four_bar.simulate((0.0, 20.0), events=events, **how)
        assert run.status == status
        assert run.t[-1] == (pytest.approx(at, abs=1e-14) if status == 1 else begin)
        assert [len(found) for found in run.t_events] == ([1, 1] if status == 1 else [0, 0])


def test_what_touches_zero_after_the_end_is_not_said(mass):
    events = [fb.Event(lambda t, x: t - 0.5, terminal=True), lambda t, x: (t - 0.7) ** 2]
    assert mass.simulate((0.0, 1.0), [0.0, 1.0], events=events).message == "A termination event occurred."


@pytest.mark.parametrize(
    ("function", "root"),
    [
        (lambda t, x: np.log(t) + 1.0 if t > 0.0 else -np.inf, math.exp(-1.0)),
        (lambda t, x: 1.0 / t - 2.0 if t > 0.0 else np.inf, 0.5),
        (lambda t, x: np.inf if t == 1.0 else t - 0.5, 0.5),
        (lambda t, x: 1.7e308 * (t - 0.3), 0.3),
        (lambda t, x: 1e-200 * (t - 0.3), 0.3),
    ],
)
@pytest.mark.parametrize("method", ["DOP853", "RK45"])
def test_functions_that_are_infinite_or_huge_at_an_end(oscillator, method, function, root):
    run = oscillator.simulate((0.0, 1.0), [1.0, 0.0], method=method, events=function)
    assert run.t_events[0] == pytest.approx([root], abs=SPACING)


def test_functions_that_are_never_negative_have_no_events(oscillator):
    """At the zeros of x and v, 190 each, they are positive, or zero. Energies are x^2 / 2 and v^2 / 2."""
    functions = [
        "kinetic_energy",
        lambda t, x: x[0] ** 2,
        lambda t, x: (x[0] * x[1]) ** 2,
        lambda t, x: 1.0 - math.sin(t),
    ]
    for method, rtol in (("RK45", 1e-12), ("Tsit5", 1e-9), ("DOP853", 1e-6)):
        run = oscillator.simulate((0.0, 300.0), [1.0, 0.0], method=method, rtol=rtol, events=functions)
        assert [len(times) for times in run.t_events] == [0, 0, 0, 0]
    assert "is zero at t = " in run.message


@pytest.mark.parametrize("rate", [33.0, 40.0, 400.0])
@pytest.mark.parametrize("all_roots", [True, False])
def test_functions_that_decay_have_no_event_at_the_end(oscillator, rate, all_roots):
    """They are small beside what they were, but not beside their own terms there."""
    event = fb.Event(lambda t, x: math.exp(-rate * t), terminal=True, all_roots=all_roots)
    run = oscillator.simulate((0.0, 1.0), [1.0, 0.0], events=event)
    assert (run.status, len(run.t_events[0])) == (0, 0)
    assert "is zero at t = " not in run.message


@pytest.mark.parametrize("start", [0.0, 1e3, 1e6, 1e8])
def test_a_power_of_time_is_not_zero_beside_its_root_at_late_times(start):
    """(t - a)^3 is 1e-9 at the end: much more than a rounding error of t, 2e-8 at most, whose cube it would be."""
    a, t = sm.Symbol("a"), me.dynamicsymbols._t
    model = fb.compile_model(driven_oscillator(force=0, outputs={"cube": (t - a) ** 3}, parameters={"a": 0.1}))
    run = model.simulate((start, start + 3.0), parameters={"a": start + 2.999}, events="cube")
    assert run.t_events[0] - start == pytest.approx([2.999], abs=4.0 * np.spacing(start + 3.0))


@pytest.mark.parametrize("root", [0.1, 0.26393, 0.43, 0.9])
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5"])
def test_roots_that_lie_far_below_the_largest_value_of_a_step(oscillator, method, root):
    """exp(k t) grows by forty decades within 1 s, so that no series of a long step shows them."""
    for rate in (60.0, 93.18, 126.14):

        def grows(t, x, rate=rate):
            return math.exp(rate * t) - math.exp(rate * root)

        run = oscillator.simulate((0.0, 1.0), [1.0, 0.0], method=method, rtol=1e-3, events=grows)
        assert run.t_events[0] == pytest.approx([root], abs=SPACING)


@pytest.mark.parametrize("jump", [1e-10, 1e-8, 1e-6, 1e-4])
def test_times_of_jumps_and_steep_pieces_beside_a_straight_line(oscillator, jump):
    """The jump passes zero at c + d, as does the steep piece, within 1/100 of the jump."""
    rng = np.random.default_rng(9)
    for c, part in zip(rng.uniform(0.1, 0.9, 20), rng.uniform(-0.9, 0.9, 20), strict=True):
        place = c + part * jump
        functions = [
            lambda t, x, at=place, c=c: (t - c) + (jump if t > at else -jump),
            lambda t, x, at=place: (t - at) + jump * math.tanh((t - at) / (jump / 100.0)),
        ]
        run = oscillator.simulate((0.0, 1.0), [1.0, 0.0], events=functions)
        for times in run.t_events:
            # 1e-12 of a step of less than 1 s
            assert times == pytest.approx([place], abs=1e-12)


def test_three_roots_by_a_jump_that_nine_values_cannot_tell_from_a_line(oscillator):
    """(t - c) - D sign(t - c) at c - D, c, c + D, where D is more than 1e-4 of a step."""
    step = np.diff(oscillator.simulate((0.0, 1.0), [1.0, 0.0]).t).max()
    rng = np.random.default_rng(4)
    for c in rng.uniform(0.1, 0.9, 50):
        half = 1.1e-4 * step
        run = oscillator.simulate(
            (0.0, 1.0), [1.0, 0.0], events=lambda t, x, c=c, half=half: (t - c) - half * np.sign(t - c)
        )
        assert run.t_events[0] == pytest.approx([c - half, c, c + half], abs=1e-12)
