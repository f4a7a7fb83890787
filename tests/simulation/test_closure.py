"""What counts as closed: each constraint by its own scale, and nothing that is not a number."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.beads import angle, bead_and_wheel, gap, length, spin, vx, vy, width, x, y
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


@pytest.fixture(scope="module")
def ring():
    return fb.compile_model(bead_and_wheel(x**2 + y**2 - length**2, "ring"))


@pytest.fixture(scope="module")
def root():
    return fb.compile_model(bead_and_wheel(y - sm.sqrt(x), "root"))


@pytest.mark.parametrize("turned", [0.0, 1e6, 1e12])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e9])
def test_a_loop_closes_as_well_beside_a_wheel_that_has_turned_often(ring, turned, size):
    """To 1e-14 of what rounding errors make of the constraint: 2 x**2 + 2 y**2 + 2 l**2 = 4 l**2 for the ring, and
    4 (|x vx| + |y vy|) = 3.84 l**2 for its rate 2 (x vx + y vy)."""
    ode = ring.ode({"l": size})
    closed = ode.project(0.0, [(0.6 + 1e-7) * size, turned, 0.8 * size, 0.0, 0.0, 0.0])
    assert abs(closed[0] ** 2 + closed[2] ** 2 - size**2) <= 4e-14 * size**2
    assert closed[1] == turned
    closed = ode.project(0.0, [0.6 * size, 0.0, 0.8 * size, (-0.8 + 1e-7) * size, turned, 0.6 * size])
    assert abs(closed[0] * closed[3] + closed[2] * closed[5]) <= 2e-14 * size**2
    assert closed[4] == pytest.approx(turned, rel=1e-15)
    np.testing.assert_allclose(closed[[0, 2]], [0.6 * size, 0.8 * size], rtol=2e-7)


@pytest.mark.slow
def test_initial_states_and_linearizations_close_the_loop_at_every_size(ring):
    for size in (1e-9, 1.0, 1e9):
        p = {"l": size}
        state = ring.initial_state({"x": 0.6 * size, "a": 1e6}, [0.0, 0.0], guess=[0.7 * size], parameters=p)
        assert state[2] == pytest.approx(0.8 * size, rel=1e-15)
        ring.linearize(0.0, state, p)
        with pytest.raises(fb.ModelError, match="violates the constraints"):
            ring.linearize(0.0, state * [1.0 + 1e-4, 1.0, 1.0, 1.0, 1.0, 1.0], p)
        with pytest.raises(fb.AssemblyError):
            ring.initial_state({"x": 1.1 * size, "a": 1e6}, [0.0, 0.0], parameters=p)


def test_a_state_that_is_zero_but_for_rounding_errors_is_closed():
    """Where all terms of a constraint vanish with the coordinates, no scale is left but theirs."""
    line = fb.compile_model(bead_and_wheel(y - 2 * x, "line"))
    closed = line.ode().project(0.0, [1e-17, 0.0, -3e-17, 2e-18, 0.0, 1e-18])
    np.testing.assert_allclose(closed, 0.0, atol=1e-16)
    assert line.simulate((0.0, 1.0), closed).success


def test_states_with_constraints_that_are_nan_do_not_count_as_closed(root):
    ode = root.ode()
    for state in ([-1e-9, 0.0, 0.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0, 0.0, 0.0]):
        status, _ = ode.closest(0.0, state)
        assert status != 0
    with pytest.raises(fb.SimulationError, match="not finite"):
        root.simulate((0.0, 1.0), [-1e-9, 0.0, 0.0, 0.0, 0.0, 0.0])


def test_stepper_at_the_end_of_a_constraint_raises_and_keeps_its_state(root):
    """The bead slides towards x = 0, where the curve ends, at 1 m/s and more."""
    stepper = root.stepper(0.05, root.initial_state({"x": 0.04, "a": 0.0}, [-1.0, 0.0], guess=[0.2]))
    stepper.step()
    before = stepper.x
    assert before[0] > 0.0
    with pytest.raises(fb.SimulationError, match="not finite"):
        stepper.step()
    np.testing.assert_array_equal(stepper.x, before)


@pytest.mark.slow
def test_samples_where_a_constraint_has_no_value_are_nan_and_the_run_goes_on():
    """A bead at 1 m/s on a line with a gap between the stages of a step, which nothing but samples can meet."""
    line = sm.Piecewise((y, sm.Abs(x - gap) > width), (sm.sqrt(-1 - y**2), True))
    broken = fb.compile_model(bead_and_wheel(line, "broken"), check=False)
    start = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    whole = broken.simulate((0.0, 10.0), start, parameters={"gap": -1.0, "width": 1e-3}, rtol=1e-6, atol=1e-6)
    longest = int(np.argmax(np.diff(whole.t)[:-1]))
    begin, end = whole.t[longest : longest + 2]
    # The stages of DOP853 leave the shares from 0.34 to 0.59 of a step free.
    middle = begin + 0.46 * (end - begin)
    p = {"gap": middle, "width": 0.05 * (end - begin)}
    times = [0.0, begin, middle, end, 10.0]
    run = broken.simulate((0.0, 10.0), start, parameters=p, rtol=1e-6, atol=1e-6, t_eval=times, dense_output=True)
    assert run.success
    together = broken.ensemble((0.0, 10.0), start, parameters=p, rtol=1e-6, atol=1e-6, t_eval=times)
    for states in (run.y, run.sol(times), together.y[0]):
        assert np.isnan(states[:, 2]).all()
        np.testing.assert_allclose(states[0, [0, 1, 3, 4]], np.array(times)[[0, 1, 3, 4]], atol=1e-9)


@pytest.mark.parametrize("method", ["DOP853", "Radau"])
def test_dense_output_outside_the_run_is_refused(root, method):
    start = root.initial_state({"x": 0.5, "a": 0.0}, [0.0, 0.0], guess=[0.7])
    run = root.simulate((0.0, 0.1), start, dense_output=True, method=method)
    np.testing.assert_allclose(run.sol([0.0, 0.1]).T, run.y[:, [0, -1]].T, atol=1e-9)
    for times in (0.2, -0.1, np.inf, np.nan, [0.05, 5.0]):
        with pytest.raises(fb.ModelError, match=r"goes from t = 0 to 0\.1"):
            run.sol(times)


@pytest.mark.slow(but=["0.001", "1000000.0"])
@pytest.mark.parametrize("size", [1e-9, 1e-3, 1e6])
def test_slider_crank_runs_at_any_size_give_the_same_motion(size):
    """Angles do not depend on the unit of length; neither do singular positions: it has none."""
    crank = fb.compile_model(fb.models.slider_crank())
    usual = crank.initial_state([1.0], [5.0])
    units = np.array([1.0, 1.0, size, 1.0, 1.0, size])
    p = {name: crank.defaults[name] * size for name in ("r", "l")}
    made = crank.initial_state([1.0], [5.0], guess=usual[1:3] * units[1:3], parameters=p)
    np.testing.assert_allclose(made, usual * units, rtol=1e-14)
    how = {"inputs": dict.fromkeys(crank.inputs, 0.0), "rtol": 1e-9}
    run = crank.simulate((0.0, 3.0), made, parameters=p, atol=1e-9 * units, **how)
    assert run.success
    assert crank.ensemble((0.0, 3.0), made, parameters=p, atol=1e-9 * units, **how).success.all()
    expected = crank.simulate((0.0, 3.0), usual, atol=1e-9, **how)
    assert np.ptp(expected["crank"]) > 2 * np.pi
    # A hundred times the tolerance, for some hundred steps.
    np.testing.assert_allclose(run.y[:, -1] / units, expected.y[:, -1], rtol=1e-7, atol=1e-7)


def test_equilibria_found_from_open_loops_are_closed_at_every_size(ring):
    """A bead on a ring of a nanometre, nothing pulls it: every place on the ring is one, and no other."""
    for size in (1e-9, 1.0, 1e6):
        q = ring.equilibrium([0.9 * size, 0.0, 0.1 * size], parameters={"l": size})[:3]
        assert np.hypot(q[0], q[2]) == pytest.approx(size, rel=1e-9)


def test_dependent_speeds_in_initial_are_accepted_only_if_they_fit_the_constraints():
    """x vx + y vy = 0: at (0.6, 0.8) with vx = 0.4 is vy = -0.3; the state is that without it."""
    model = bead_and_wheel(x**2 + y**2 - length**2, "ring")
    how = {"name": "ring", "parameters": {length: 1.0}}
    start = {x: 0.6, angle: 0.0, y: 0.8, vx: 0.4, spin: 1.0}
    given = fb.compile_model(fb.Model(model.system, initial={**start, vy: -0.3000001}, **how))
    expected = [0.6, 0.0, 0.8, 0.4, 1.0, -0.3]
    np.testing.assert_allclose(given.initial_state(), expected, rtol=1e-14)
    np.testing.assert_allclose(given.simulate((0.0, 0.1)).y[:, 0], expected, rtol=1e-14)
    # With others in their place, or another length, the initial values do not belong to the state.
    np.testing.assert_allclose(given.initial_state(speeds={"v_x": 0.8, "w": 1.0})[5], -0.6, rtol=1e-14)
    np.testing.assert_allclose(given.initial_state(parameters={"l": 1.0}), expected, rtol=1e-14)
    np.testing.assert_allclose(given.initial_state(parameters={"l": np.sqrt(0.72)})[5], -0.4, rtol=1e-14)
    wrong = fb.compile_model(fb.Model(model.system, initial={**start, vy: -0.3001}, **how))
    # The rate of the constraint is 2 (x vx + y vy) = 1.6 (0.3 - 0.3001).
    with pytest.raises(fb.ModelError, match=r"violate velocity constraint 1: J u [+] b = -0.00016 .*speeds \(v_x, w\)"):
        wrong.simulate((0.0, 0.1))
    # At rest there are no terms to compare with, and speeds may be rounding errors.
    rest = {**start, vx: 0.0}
    for speed in (1e-17, -6e-17, 1e-9):
        still = fb.compile_model(fb.Model(model.system, initial={**rest, vy: speed}, **how))
        np.testing.assert_allclose(still.initial_state(), [0.6, 0.0, 0.8, 0.0, 1.0, 0.0], rtol=0, atol=1e-16)
    for speed in (1e-7, 0.5):
        moving = fb.compile_model(fb.Model(model.system, initial={**rest, vy: speed}, **how))
        with pytest.raises(fb.ModelError, match=f"violate velocity constraint 1: J u [+] b = {1.6 * speed:g} there"):
            moving.initial_state()
    assert wrong.initial_state(speeds={"v_x": 0.8, "w": 1.0})[5] == pytest.approx(-0.6, rel=1e-14)


def test_loops_without_independent_coordinates_are_closed_or_named_in_an_error():
    """A point on two circles that do not meet: the message names what there is."""
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, x * frame.x + y * frame.y)
    point.set_vel(frame, vx * frame.x + vy * frame.y)
    system = System(frame, origin)
    system.add_bodies(me.Particle("P", point, 1))
    system.q_dep, system.u_dep = [x, y], [vx, vy]
    system.add_kdes(*(u - q.diff(me.dynamicsymbols._t) for q, u in ((x, vx), (y, vy))))
    system.add_holonomic_constraints(x**2 + y**2 - length**2, (x - 3) ** 2 + y**2 - length**2)
    model = fb.compile_model(fb.Model(system, name="apart", parameters={length: 1.0}))
    with pytest.raises(fb.AssemblyError, match=r"the guess x = 0, y = 0, and cannot .* Check [^,]*too short\)[.]$"):
        model.initial_state()
    closed = model.initial_state(guess=[1.0, 1.0], parameters={"l": 2.5})
    np.testing.assert_allclose(closed, [1.5, 2.0, 0.0, 0.0], rtol=1e-14, atol=1e-14)
