"""Runs of a kernel written by hand, by each method, against the pendulum's motion by elliptic functions.

Tolerances of runs with step size control are bounds of the global error, `bound`: in a step the root mean square of the
error estimates, in units of atol + rtol |x|, is below 1, so that the error of one of 4 entries is below twice that
unit. It is carried on to later times as differences of neighbouring motions are, which is known in closed form.
"""

import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import mpmath
import numpy as np
import pytest
from builders.hand_written_pendulum import GRAVITY, LENGTH, MASS, Swing, Turn, states_at
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.special import ellipk, ellipkinc

import fourbar_codegen as fb

MOTIONS = {"small": Swing(0.2), "wide": Swing(2.8), "turning": Turn(10.5)}
EXPLICIT = ["DOP853", "RK45", "Tsit5"]
TOLERANCES = {"DOP853": 1e-11, "RK45": 1e-11, "Tsit5": 1e-11, "Radau": 1e-7}
"""As small as the order of a method allows in thousands of steps; 1e-9 for the others."""


def neighbours(motion, t):
    """The derivatives of angle and rate by the motion's size and by time, of the shape (n, 2, 2)."""
    step = 1e-6
    sizes, moments = (
        [motion._replace(**{motion._fields[0]: motion[0] + d}) for d in (-step, step)],
        (t - step, t + step),
    )
    by_size = np.subtract(*[other.angles(t) for other in sizes[::-1]])
    wrt_time = np.subtract(*[motion.angles(moment) for moment in moments[::-1]])
    return np.moveaxis(np.array([by_size, wrt_time]) / (2.0 * step), (0, 1, 2), (2, 1, 0))


def bound(run, motion, steps=None):
    """The largest error of a state: a sum over the steps, at their times or, for a number of them, spread evenly."""
    begin, end = run.settings["t_span"]
    times = np.linspace(begin, end, 100) if steps is not None else run.t
    weight = 1.0 if steps is None else steps / times.size
    rates = motion.angles(times)[1]
    place, speed = motion.length, motion.length * np.abs(rates).max()
    unit = 2.0 * (run.settings["atol"] + run.settings["rtol"] * np.array([place, speed])) / motion.length
    basis = neighbours(motion, times)
    inverse, largest = np.linalg.inv(basis), 0.0
    for last in range(times.size - 1, 0, -max(1, times.size // 20)):
        of_angle, of_rate = weight * (np.abs(basis[last] @ inverse[: last + 1]) @ unit).sum(axis=0)
        largest = max(largest, of_angle, of_rate + np.abs(rates).max() * of_angle)
    return motion.length * largest


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5", "Radau", "CVODE", "IDA"])
def test_runs_follow_the_elliptic_functions_within_their_tolerances(pendulum, motion, method):
    if method in {"CVODE", "IDA"}:
        pytest.importorskip("sksundae")
    motion = MOTIONS[motion]
    rtol = TOLERANCES.get(method, 1e-9)
    run = pendulum.simulate(
        (0.0, 1.5 * motion.period), motion.states(0.0), method=method, rtol=rtol, atol=rtol, progress=False
    )
    assert run.success
    assert run.t[-1] == 1.5 * motion.period
    np.testing.assert_allclose(run.y, motion.states(run.t), rtol=0.0, atol=bound(run, motion))
    # The states returned are projected: Phi is closed to 1e-14 of its terms, of the size 3 l^2.
    assert np.abs(run.constraint_residual).max() < 3e-14


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("method", EXPLICIT)
def test_with_the_constraint_written_twice_runs_follow_the_same_motion(redundant_pendulum, motion, method):
    motion = MOTIONS[motion]
    run = redundant_pendulum.simulate((0.0, motion.period), motion.states(0.0), method=method, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run.y, motion.states(run.t), rtol=0.0, atol=bound(run, motion))
    np.testing.assert_allclose(run.multipliers[0], run.multipliers[1], rtol=1e-14)


@pytest.mark.parametrize("motion", MOTIONS)
def test_writing_the_constraint_twice_changes_steps_of_one_length_by_rounding_errors(
    pendulum, redundant_pendulum, motion
):
    """200 steps with four errors of 1e-15 each, which grow by ten or so."""
    motion = MOTIONS[motion]
    once, twice = (model.stepper(5e-3, motion.states(0.0)) for model in (pendulum, redundant_pendulum))
    for _ in range(200):
        once.step()
        twice.step()
    np.testing.assert_allclose(twice.x, once.x, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("motion", MOTIONS)
def test_runs_backwards_in_time_follow_the_same_motion(pendulum, motion):
    motion = MOTIONS[motion]
    run = pendulum.simulate((1.0, -1.0), motion.states(1.0), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run.y, motion.states(run.t), rtol=0.0, atol=bound(run, motion))


@pytest.mark.parametrize("method", [*EXPLICIT, "Radau"])
@pytest.mark.parametrize("constraints", ["none", "baumgarte"])
def test_runs_without_projection_follow_the_motion_and_leave_the_circle(pendulum, method, constraints):
    motion, rtol = MOTIONS["wide"], TOLERANCES.get(method, 1e-9)
    run = pendulum.simulate(
        (0.0, motion.period), motion.states(0.0), method=method, rtol=rtol, atol=rtol, constraints=constraints
    )
    assert run.success
    limit = bound(run, motion)
    # A drift Phi also changes the period; without projection nothing holds the speeds on the circle, so that Phi grows
    # as the time does: this factor is the length of the run in units of 1 / w.
    drift = 1.0 + motion.period * np.sqrt(GRAVITY / LENGTH) if constraints == "none" else 1.0
    np.testing.assert_allclose(run.y, motion.states(run.t), rtol=0.0, atol=drift * limit)
    assert 1e-13 < np.abs(run.constraint_residual).max() < drift * limit


def test_violations_decay_by_baumgartes_equation(pendulum):
    """Phi'' + 2 a Phi' + a^2 Phi = 0 from Phi = d, Phi' = 0: Phi = d (1 + a t) exp(-a t)."""
    x0 = states_at(LENGTH, 0.5, 0.0)
    x0[1] -= 1e-3
    t = np.linspace(0.0, 0.5, 11)
    ode = pendulum.ode()
    ode.stabilization = 8.0
    run = solve_ivp(ode, (0.0, 0.5), x0, rtol=1e-11, atol=1e-12, t_eval=t)
    violations = (run.y[:2] ** 2).sum(axis=0) - LENGTH**2
    expected = violations[0] * (1.0 + 8.0 * t) * np.exp(-8.0 * t)
    # SciPy's RK45 at rtol = 1e-11: some 300 steps with errors of 1e-11 each.
    np.testing.assert_allclose(violations, expected, rtol=0.0, atol=3e-9)


def test_fixed_steps_of_the_augmented_lagrangian_method_are_of_order_two(either_pendulum):
    motion = MOTIONS["wide"]
    errors = []
    for h in (4e-3, 2e-3, 1e-3):
        run = either_pendulum.simulate(
            (0.0, 1.0), motion.states(0.0), method="ALI3P", max_step=h, t_eval=[0.0, 0.5, 1.0], progress=False
        )
        errors.append(np.abs(run.y - motion.states(run.t)).max())
    # Richardson: of an error c h^2 + O(h^3) or O(h^4) halving leaves a quarter, here up to 2 %.
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.02)


def test_fixed_steps_of_the_stepper_are_of_order_four(either_pendulum):
    motion = MOTIONS["wide"]
    errors = []
    for n in (50, 100, 200):
        stepper = either_pendulum.stepper(1.0 / n, motion.states(0.0))
        for _ in range(n):
            x = stepper.step()
        assert stepper.t == pytest.approx(1.0, rel=1e-15)
        errors.append(np.abs(x - motion.states(1.0)).max())
    # As above, with a sixteenth; the next term of the error is h times as large.
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 16.0, rtol=0.15)


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5", "Radau"])
def test_dense_output_follows_the_motion_between_steps(pendulum, method):
    """Interpolants have an order one less than the methods, so that between steps an error of ten units is added."""
    motion, rtol = MOTIONS["wide"], TOLERANCES.get(method, 1e-9)
    run = pendulum.simulate((0.0, 1.0), motion.states(0.0), method=method, rtol=rtol, atol=rtol, dense_output=True)
    t = np.linspace(0.0, 1.0, 177)
    np.testing.assert_allclose(run.sol(t), motion.states(t), rtol=0.0, atol=10.0 * bound(run, motion))
    # at the steps it is the solution, up to the projection, which changes closed states in the last digits
    np.testing.assert_allclose(run.sol(run.t), run.y, rtol=0.0, atol=1e-12)
    sampled = pendulum.simulate((0.0, 1.0), motion.states(0.0), method=method, rtol=rtol, atol=rtol, t_eval=t)
    np.testing.assert_allclose(sampled.y, run.sol(t), rtol=0.0, atol=1e-12)


def first_slack(motion):
    """When the force in the rod of a swing above the horizontal vanishes first: 3 cos a = 2 cos angle."""
    k = np.sin(motion.angle / 2.0)
    slack = np.arccos(2.0 / 3.0 * np.cos(motion.angle))
    amplitude = np.arcsin(np.sin(slack / 2.0) / k)
    return (ellipk(k**2) - ellipkinc(amplitude, k**2)) * np.sqrt(motion.length / motion.gravity)


@pytest.mark.parametrize("method", [*EXPLICIT, "Radau"])
def test_events_of_outputs_are_found_at_the_times_of_elliptic_integrals(pendulum, method):
    motion = MOTIONS["wide"]
    run = pendulum.simulate(
        (0.0, motion.period),
        motion.states(0.0),
        method=method,
        rtol=TOLERANCES.get(method, 1e-9),
        atol=TOLERANCES.get(method, 1e-9),
        events=[
            fb.Event("tension"),
            fb.Event("tension", direction=1),
            fb.Event("tension", direction=-1),
            lambda t, x: x[0],
        ],
    )
    first = first_slack(motion)
    up, down = [first, motion.period / 2.0 + first], [motion.period / 2.0 - first, motion.period - first]
    # The error of the state, over the slowest rate of these functions along the motion: 3.9 m/s of x, 40 N/s.
    limit = bound(run, motion)
    expected = [sorted(up + down), up, down, [motion.period / 4.0, 0.75 * motion.period]]
    for found, times in zip(run.t_events, expected, strict=True):
        np.testing.assert_allclose(found, times, rtol=0.0, atol=limit)
    np.testing.assert_allclose(run.y_events[1].T, motion.states(np.array(up)), rtol=0.0, atol=2.0 * limit)


@pytest.mark.parametrize(("terminal", "count"), [(True, 1), (2, 2), (3, 3)])
def test_a_terminal_event_ends_the_run_at_its_time(pendulum, terminal, count):
    motion = MOTIONS["small"]

    def level(t, x):
        return x[0]

    level.terminal = terminal
    run = pendulum.simulate((0.0, 10.0), motion.states(0.0), rtol=1e-11, atol=1e-11, events=[level])
    assert run.status == 1
    limit = bound(run, motion)
    assert run.t[-1] == pytest.approx((2 * count - 1) * motion.period / 4.0, abs=limit)
    assert len(run.t_events[0]) == count
    assert run.y[0, -1] == pytest.approx(0.0, abs=1e-12)


def tilted(force):
    """Of a constant force: gravity in the direction of the sum of forces; its angle and its size."""
    return np.arctan2(force, MASS * GRAVITY), np.hypot(GRAVITY, force / MASS)


@pytest.mark.parametrize("given", ["number", "callable", "hold", "linear", "pchip", "cubic"])
def test_a_constant_force_tilts_gravity(pendulum, given):
    """However it is given: a table of constants of each kind is a constant."""
    tilt, gravity = tilted(6.0)
    swing = Swing(1.2, LENGTH, gravity)
    table = ([0.0, 0.3, 0.7, 2.0], [6.0] * 4)
    source = {"number": 6.0, "callable": lambda t, x: 6.0}.get(given, (*table, given))
    x0 = states_at(LENGTH, tilt + 1.2, 0.0)
    run = pendulum.simulate((0.0, 1.5), x0, inputs={"F": source}, rtol=1e-11, atol=1e-11)
    angle, rate = swing.angles(run.t)
    expected = states_at(LENGTH, tilt + angle, rate)
    np.testing.assert_allclose(run.y, expected, rtol=0.0, atol=bound(run, swing))
    np.testing.assert_array_equal(run.r[0], 6.0)


def test_a_stepper_holds_the_force_that_each_step_is_given(pendulum):
    """As before, with the steps of length h of the classical method: its error is of the order of h^4."""
    tilt, gravity = tilted(6.0)
    swing = Swing(1.2, LENGTH, gravity)
    errors = []
    for n in (100, 200):
        stepper = pendulum.stepper(1.0 / n, states_at(LENGTH, tilt + 1.2, 0.0), inputs={"F": -3.0})
        for _ in range(n):
            x = stepper.step({"F": 6.0})
        angle, rate = swing.angles(1.0)
        errors.append(np.abs(x - states_at(LENGTH, tilt + angle, rate)).max())
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.15)
    assert errors[1] < 1e-6


@pytest.mark.parametrize("formulation", ["index-1", "index-3", "gear-gupta-leimkuhler"])
def test_formulations_of_the_differential_algebraic_equations_follow_the_motion(pendulum, formulation):
    """IDA controls no errors of the speeds in index 3, so that the bound is not theirs: a hundred times that."""
    pytest.importorskip("sksundae")
    motion = MOTIONS["small"]
    run = pendulum.simulate((0.0, 1.0), motion.states(0.0), method="IDA", formulation=formulation, rtol=1e-9, atol=1e-9)
    assert run.success
    limit = bound(run, motion) * (100.0 if formulation == "index-3" else 1.0)
    np.testing.assert_allclose(run.y, motion.states(run.t), rtol=0.0, atol=limit)


@pytest.mark.parametrize("method", [*EXPLICIT, "Radau"])
def test_a_held_force_ends_at_its_time(pendulum, method):
    """It ends when the mass rests on the other side of the tilted vertical: from there, it swings by gravity alone."""
    tilt, gravity = tilted(6.0)
    first = Swing(0.9, LENGTH, gravity)
    end = first.period / 2.0
    second = Swing(tilt - 0.9)
    run = pendulum.simulate(
        (0.0, end + second.period),
        states_at(LENGTH, tilt + 0.9, 0.0),
        method=method,
        inputs={"F": ([0.0, end], [6.0, 0.0], "hold")},
        rtol=TOLERANCES.get(method, 1e-9),
        atol=TOLERANCES.get(method, 1e-9),
    )
    before = run.t < end
    angle, rate = first.angles(run.t[before])
    limit = bound(run, first) + bound(run, second)
    np.testing.assert_allclose(run.y[:, before], states_at(LENGTH, tilt + angle, rate), rtol=0.0, atol=limit)
    np.testing.assert_allclose(run.y[:, ~before], second.states(run.t[~before] - end), rtol=0.0, atol=limit)


def exact_states(kind, size, t, gravity=GRAVITY, length=LENGTH, tilt=0.0):
    """The states of a motion by mpmath, in its present precision; gravity may have turned by an angle."""
    g, length = mpmath.mpf(gravity), mpmath.mpf(length)
    if kind is Swing:
        k, w = mpmath.sin(size / 2), mpmath.sqrt(g / length)
        u = mpmath.ellipk(k**2) - w * t
        angle = 2 * mpmath.asin(k * mpmath.ellipfun("sn", u, m=k**2))
        rate = -2 * k * w * mpmath.ellipfun("cn", u, m=k**2)
    else:
        u, m = size * t / 2, 4 * g / (length * size**2)
        sn, cn, dn = (mpmath.ellipfun(name, u, m=m) for name in ("sn", "cn", "dn"))
        angle, rate = 2 * mpmath.atan2(sn, cn), size * dn
    sine, cosine = mpmath.sin(angle + tilt), mpmath.cos(angle + tilt)
    return [length * entry for entry in (sine, -cosine, rate * cosine, rate * sine)]


def slopes_of(states, value, times):
    """The derivatives of states(value, t) by the value, of the shape (4, n), by central differences to 26 digits."""
    with mpmath.workdps(40):
        step, value = mpmath.mpf(10) ** -13, mpmath.mpf(value)
        pairs = [(states(value + step, mpmath.mpf(t)), states(value - step, mpmath.mpf(t))) for t in times]
        return np.array([[float((a - b) / (2 * step)) for a, b in zip(*pair, strict=True)] for pair in pairs]).T


def closed_form_slopes(motion, times):
    """By the angle or rate of a motion."""
    return slopes_of(lambda size, t: exact_states(type(motion), size, t), motion[0], times)


def by_gravity(model, motion, t):
    """Of a swing, positions are functions of w t, and speeds w times such, with w^2 = g / l."""
    x, rates = motion.states(t), motion_rates(model, motion, t)
    return np.concatenate((rates[:2] * t, x[2:] + rates[2:] * t)) / (2.0 * motion.gravity)


def wrt_length(model, motion, t):
    """Positions are l times functions of w t, and speeds l w times such."""
    x, rates = motion.states(t), motion_rates(model, motion, t)
    return np.concatenate((x[:2] - rates[:2] * t / 2.0, x[2:] / 2.0 - rates[2:] * t / 2.0)) / motion.length


def motion_rates(model, motion, t):
    """x' along a motion, of the shape (4, n): the differential equation holds for any closed form."""
    return np.array([model.rhs(0.0, x) for x in motion.states(t).T]).T


def slope_limit(run, motion, n_steps=None):
    """Derivatives have errors of ten times the relative tolerance in a step, relative to their own size, and grow once
    more by the time in units of 1 / w, since the growth of differences does.
    """
    time = np.ptp(run.settings["t_span"]) * np.sqrt(motion.gravity / motion.length)
    return 10.0 * time * bound(run, motion, n_steps)


TIMES = np.array([0.0, 0.4, 1.1, 1.5])


@pytest.mark.parametrize("method", EXPLICIT)
def test_sensitivities_of_a_swing_are_derivatives_of_the_elliptic_functions(either_pendulum, method):
    """The given x0 has the derivatives of a rod of another length at the same angle."""
    motion = Swing(1.9)
    x0 = motion.states(0.0)
    run = either_pendulum.simulate(
        (0.0, 1.5), x0, method=method, rtol=1e-11, atol=1e-12, dense_output=True, t_eval=TIMES,
        sensitivities=["g", "m", "l", "x"],
        dx0={"l": x0 / LENGTH, "x": [1.0, -x0[0] / x0[1], 0.0, 0.0]},
    )  # fmt: skip
    expected = {
        "g": by_gravity(either_pendulum, motion, TIMES),
        "m": np.zeros((4, 4)),
        "l": wrt_length(either_pendulum, motion, TIMES),
        "x": closed_form_slopes(motion, TIMES) / (LENGTH * np.cos(1.9)),
    }
    limit = slope_limit(run, motion, len(run.sol))
    for name, slopes in expected.items():
        size = max(np.abs(slopes).max(), 1.0)
        np.testing.assert_allclose(run.sensitivity[name], slopes, rtol=0.0, atol=limit * size, err_msg=name)
        if name != "l":
            # They are moved onto the tangent of the circle: of their violation, 1e-9 or so remains; see
            # FB_SLIGHT_DRIFT_RTOL.
            q, u, (by_q, by_u) = run.y[:2], run.y[2:], np.split(run.sensitivity[name], 2)
            np.testing.assert_allclose((q * by_q).sum(axis=0), 0.0, atol=1e-13 * size)
            np.testing.assert_allclose((u * by_q + q * by_u).sum(axis=0), 0.0, atol=1e-12 * size)
        dense = run.sol.sensitivity(TIMES)[name]
        np.testing.assert_allclose(dense, run.sensitivity[name], rtol=0.0, atol=1e-9 * size, err_msg=name)


@pytest.mark.parametrize("method", EXPLICIT)
def test_sensitivity_of_a_turn_to_its_initial_speed_is_that_of_the_elliptic_functions(either_pendulum, method):
    """Without x0 the dependent values follow from the constraints: at the lowest point they stay where they are."""
    motion = Turn(10.5)
    x0 = motion.states(0.0)
    run = either_pendulum.simulate(
        (0.0, 1.5), x0, method=method, rtol=1e-11, atol=1e-12, t_eval=TIMES, sensitivities=["u_x"],
        dx0={"u_x": [0.0, 0.0, 1.0, 0.0]},
    )  # fmt: skip
    slopes = closed_form_slopes(motion, TIMES) / LENGTH
    limit = slope_limit(run, motion, run.nfev // 6) * np.abs(slopes).max()
    np.testing.assert_allclose(run.sensitivity["u_x"], slopes, rtol=0.0, atol=limit)


@pytest.mark.parametrize("method", EXPLICIT)
def test_the_gradient_backwards_is_that_of_the_elliptic_functions(either_pendulum, method):
    """A cost is a weighted sum of the samples; the derivatives are those of the sensitivities' closed forms."""
    motion = Swing(1.9)
    weights = np.random.default_rng(3).normal(size=(4, TIMES.size))
    run = either_pendulum.simulate(
        (0.0, 1.5), motion.states(0.0), method=method, rtol=1e-11, atol=1e-12, t_eval=TIMES, gradient=True
    )
    gradient = run.gradient(weights)
    of_angle = closed_form_slopes(motion, TIMES) / (LENGTH * np.cos(1.9))
    limit = slope_limit(run, motion, run.nfev // 6)
    for name, slopes in {"g": by_gravity(either_pendulum, motion, TIMES), "m": 0.0 * of_angle, "x": of_angle}.items():
        size = (np.abs(weights) * np.maximum(np.abs(slopes), 1.0)).sum()
        assert gradient[name] == pytest.approx((weights * slopes).sum(), abs=limit * size), name


@pytest.mark.parametrize("method", EXPLICIT)
def test_the_gradient_of_the_distance_from_the_pivot_is_that_of_the_length(pendulum, method):
    """(x^2 + y^2) / 2 = l^2 / 2 at any time, since projections move the given x0 as well: up to FB_SLIGHT_DRIFT_RTOL of
    what the steps leave. And its rate, x u_x + y u_y, is 0.
    """
    motion = Swing(1.9)
    run = pendulum.simulate(
        (0.0, 1.5), motion.states(0.0), method=method, rtol=1e-6, atol=1e-6, t_eval=TIMES, gradient=True
    )
    for place in range(TIMES.size):
        weights = np.zeros((4, TIMES.size))
        weights[:2, place] = run.y[:2, place]
        gradient = run.gradient(weights)
        assert gradient["l"] == pytest.approx(LENGTH, rel=1e-12)
        for name in ("g", "m", "x", "u_x", "F"):
            assert gradient.get(name, 0.0) == pytest.approx(0.0, abs=1e-12), name
        weights[:2, place], weights[2:, place] = run.y[2:, place], run.y[:2, place]
        for name, slope in run.gradient(weights).items():
            assert slope == pytest.approx(0.0, abs=1e-11), name


@pytest.mark.parametrize("method", EXPLICIT)
@pytest.mark.parametrize("kind", ["number", "hold", "linear", "cubic"])
def test_derivatives_by_a_force_are_those_of_the_tilted_motion(pendulum, method, kind):
    """Forwards and backwards, from rest at an angle that the force does not change. Changes
    of all values of a table sum up to one of the constant.
    """

    def states(force, t):
        tilt = mpmath.atan2(force, MASS * mpmath.mpf(GRAVITY))
        gravity = mpmath.sqrt(mpmath.mpf(GRAVITY) ** 2 + (force / mpmath.mpf(MASS)) ** 2)
        return exact_states(Swing, mpmath.mpf(1.2) - tilt, t, gravity, tilt=tilt)

    slopes = slopes_of(states, 6.0, TIMES)
    force = 6.0 if kind == "number" else ([0.0, 0.5, 1.5], [6.0] * 3, kind)
    given = {"method": method, "inputs": {"F": force}, "rtol": 1e-11, "atol": 1e-12, "t_eval": TIMES}
    x0 = states_at(LENGTH, 1.2, 0.0)
    run = pendulum.simulate((0.0, 1.5), x0, sensitivities=["F"], gradient=True, **given)
    swing = Swing(1.2 - tilted(6.0)[0], LENGTH, tilted(6.0)[1])
    limit = slope_limit(run, swing, run.nfev // 6)
    found = run.sensitivity["F"]
    np.testing.assert_allclose(found if kind == "number" else found.sum(axis=0), slopes, rtol=0.0, atol=limit)
    weights = np.random.default_rng(5).normal(size=slopes.shape)
    expected = (weights * slopes).sum()
    assert np.sum(run.gradient(weights)["F"]) == pytest.approx(expected, abs=limit * np.abs(weights).sum())


@pytest.mark.parametrize("method", EXPLICIT)
@pytest.mark.parametrize("kind", ["hold", "linear", "cubic"])
def test_derivatives_by_values_of_a_table_are_those_of_the_equation_of_the_angle(pendulum, method, kind):
    """Forwards and backwards. SciPy integrates m l a'' = F cos a - m g sin a and its derivatives with respect to the
    values. Each of them changes F by a function of time: piece by piece, since these may jump.
    """
    times, values = np.array([0.0, 0.4, 0.9, 1.5]), np.array([3.0, -4.0, 6.0, 2.0])
    spline = CubicSpline(times, np.eye(4))

    def weights(t, begin):
        """Of the values in the force at a time, in the piece from another time on."""
        if kind == "cubic":
            return spline(t)
        if kind == "linear":
            return np.array([np.interp(t, times, row) for row in np.eye(4)])
        return np.eye(4)[np.searchsorted(times, begin, side="right") - 1]

    def rates(t, y, begin):
        a, a_rate, by, wrt_rate = y[0], y[1], y[2:6], y[6:]
        w, unit = weights(t, begin), MASS * LENGTH
        sine, cosine, force = np.sin(a), np.cos(a), weights(t, begin) @ values
        slope = -(force * sine + MASS * GRAVITY * cosine) / unit
        acceleration = (force * cosine - MASS * GRAVITY * sine) / unit
        return np.concatenate(([a_rate, acceleration], wrt_rate, slope * by + w * cosine / unit))

    y = np.concatenate(([1.2, 0.0], np.zeros(8)))
    for begin, end in pairwise(times):
        y = solve_ivp(rates, (begin, end), y, method="DOP853", rtol=1e-11, atol=1e-12, args=(begin,)).y[:, -1]
    a, a_rate, by, wrt_rate = y[0], y[1], y[2:6], y[6:]
    sine, cosine = np.sin(a), np.cos(a)
    slopes = LENGTH * np.array([cosine * by, sine * by, cosine * wrt_rate - a_rate * sine * by,
                                sine * wrt_rate + a_rate * cosine * by])  # fmt: skip
    run = pendulum.simulate(
        (0.0, 1.5), states_at(LENGTH, 1.2, 0.0), method=method, inputs={"F": (times, values, kind)}, t_eval=[1.5],
        rtol=1e-11, atol=1e-12, sensitivities=["F"], gradient=True,
    )  # fmt: skip
    np.testing.assert_allclose(run.y[:, 0], states_at(LENGTH, a, a_rate), rtol=0.0, atol=1e-8)
    # Some 100 steps of RK45 with ten times the tolerance in each, and the growth of differences.
    np.testing.assert_allclose(run.sensitivity["F"][:, :, 0].T, slopes, rtol=0.0, atol=1e-8)
    for i in range(4):
        np.testing.assert_allclose(run.gradient(np.eye(4)[:, i : i + 1])["F"], slopes[i], rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("method", EXPLICIT)
def test_derivatives_of_the_force_in_the_rod_are_those_of_its_closed_form(either_pendulum, method):
    """Forwards and backwards. By energy, T = m g (3 cos a - 2 cos a_0) in a swing from rest at a_0, cos a = -y / l."""
    motion = Swing(1.9)
    run = either_pendulum.simulate(
        (0.0, 1.5), motion.states(0.0), method=method, rtol=1e-11, atol=1e-12, t_eval=TIMES,
        sensitivities=["g", "m", "l"], gradient=True, dx0={"l": motion.states(0.0) / LENGTH},
    )  # fmt: skip
    share = 3.0 * -motion.states(TIMES)[1] / LENGTH - 2.0 * np.cos(1.9)
    by_g = MASS * share - 3.0 * MASS * GRAVITY / LENGTH * by_gravity(either_pendulum, motion, TIMES)[1]
    y, by = motion.states(TIMES)[1], wrt_length(either_pendulum, motion, TIMES)[1]
    by_l = 3.0 * MASS * GRAVITY * (y / LENGTH - by) / LENGTH
    limit = 3.0 * MASS * GRAVITY / LENGTH * slope_limit(run, motion, run.nfev // 6)
    place, weights = either_pendulum.outputs.index("tension"), np.array([1.0, -2.0, 0.5, 3.0])
    gradient = run.gradient({"tension": weights})
    for name, slopes in {"g": by_g, "m": GRAVITY * share, "l": by_l}.items():
        np.testing.assert_allclose(run.output_sensitivity[name][place], slopes, rtol=0.0, atol=limit)
        if name == "l" and either_pendulum.n_c > 1:
            continue  # a parameter that redundant constraints do not let change alone has no gradient
        assert gradient[name] == pytest.approx(weights @ slopes, abs=limit * np.abs(weights).sum())


def test_times_of_events_change_with_gravity_as_its_inverse_root(pendulum):
    """t is proportional to sqrt(l / g) for events at given angles, as where the force in the rod vanishes."""
    motion = Swing(2.8)
    x0 = motion.states(0.0)
    run = pendulum.simulate(
        (0.0, motion.period), x0, rtol=1e-11, atol=1e-12, events=["tension"], sensitivities=["g", "l"],
        dx0={"l": x0 / LENGTH},
    )  # fmt: skip
    (found,) = run.event_sensitivity
    times = run.t_events[0]
    assert times.size == 4
    limit = slope_limit(run, motion)
    np.testing.assert_allclose(found["g"].t, -times / (2.0 * GRAVITY), rtol=0.0, atol=limit)
    np.testing.assert_allclose(found["l"].t, times / (2.0 * LENGTH), rtol=0.0, atol=limit)
    # The state at a given angle: positions are l times, and speeds sqrt(l g) times, functions of the angle.
    x = motion.states(times)
    np.testing.assert_allclose(found["l"].y, x / np.array([[1.0], [1.0], [2.0], [2.0]]) / LENGTH, rtol=0.0, atol=limit)
    still, speeds = np.zeros((2, 4)), x[2:] / (2.0 * GRAVITY)
    np.testing.assert_allclose(found["g"].y, np.concatenate((still, speeds)), rtol=0.0, atol=limit)


@pytest.mark.parametrize("method", EXPLICIT)
@pytest.mark.parametrize("n", [1, 5, 19])
def test_members_of_an_ensemble_follow_their_own_motions(either_pendulum, method, n):
    random = np.random.default_rng(n)
    motions = [Swing(*each) for each in random.uniform([0.2, LENGTH, 5.0], [2.9, LENGTH, 15.0], (n, 3))]
    t = np.linspace(0.0, 1.0, 7)
    ensemble = either_pendulum.ensemble(
        (0.0, 1.0), [motion.states(0.0) for motion in motions], method=method, rtol=1e-11, atol=1e-11, t_eval=t,
        parameters={"g": [motion.gravity for motion in motions]},
    )  # fmt: skip
    assert ensemble.success.all()
    for i, motion in enumerate(motions):
        run = ensemble[i]
        np.testing.assert_allclose(run.y, motion.states(t), rtol=0.0, atol=bound(run, motion, ensemble.nfev[i] // 6))


def test_members_with_forces_of_their_own_swing_about_tilted_directions(pendulum):
    forces = np.linspace(-8.0, 8.0, 9)
    t = np.linspace(0.0, 1.0, 5)
    starts = [states_at(LENGTH, tilted(force)[0] + 1.0, 0.0) for force in forces]
    ensemble = pendulum.ensemble((0.0, 1.0), starts, inputs={"F": forces}, rtol=1e-11, atol=1e-11, t_eval=t)
    for run, force in zip(ensemble, forces, strict=True):
        tilt, gravity = tilted(force)
        swing = Swing(1.0, LENGTH, gravity)
        angle, rate = swing.angles(t)
        expected = states_at(LENGTH, tilt + angle, rate)
        np.testing.assert_allclose(run.y, expected, rtol=0.0, atol=bound(run, swing, 50))


def test_a_run_without_possible_motion_ends_with_its_reason(pendulum):
    """The mass is infinite where it starts: the equations have no finite solution."""
    with pytest.raises(fb.SimulationError):
        pendulum.simulate((0.0, 1.0), MOTIONS["small"].states(0.0), inputs={"F": 1e308}, parameters={"m": 1e-300})


@pytest.mark.slow
def test_a_simulation_of_a_loaded_kernel_does_not_import_sympy(pendulum_path):
    """The half of the package that runs is independent of the one that forms equations."""
    program = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from builders.hand_written_pendulum import Swing, loaded_pendulum
pendulum, motion = loaded_pendulum(Path({str(pendulum_path)!r})), Swing(1.0)
for method in ("DOP853", "Radau"):
    run = pendulum.simulate((0.0, 0.5), motion.states(0.0), method=method, dense_output=True, events=["tension"])
    assert run.success and abs(run.y - motion.states(run.t)).max() < 1e-3
pendulum.initial_state([0.1], [0.0], guess=[-1.0])
pendulum.ensemble((0.0, 0.5), [motion.states(0.0)] * 3)
pendulum.simulate((0.0, 0.5), motion.states(0.0), sensitivities=["g"])
assert "numpy" in sys.modules
assert "sympy" not in sys.modules, sorted(name for name in sys.modules if name.startswith("sympy"))[:5]
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
