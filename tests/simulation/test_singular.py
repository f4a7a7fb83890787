"""ALI3P: singular positions are passed, redundant constraints accepted, and regular motions those of other methods."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.redundant import circle, pendulum, three_uprights
from builders.systems import spatial_four_bar
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def simulate(model, h, *more, **how):
    run = model.simulate((0.0, 10.0), *more, method="ALI3P", max_step=h, **how)
    assert run.success
    return run


def columns(run):
    return zip(run.t, run.y.T, strict=True)


def test_ali3p_turns_a_change_point_linkage_over_with_second_order(four_bar):
    """The tutorial's linkage without spring, damper and force, fast enough to pass positions in which all links lie on
    a line: its energy is conserved, and the mechanism comes to the same place, to second order."""
    free = {"parameters": {"k": 0.0, "c": 0.0}, "inputs": {"F": 0.0}}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": 9.0}, parameters=free["parameters"])
    runs = [simulate(four_bar, h, x0, **free) for h in (4e-3, 2e-3, 1e-3)]
    for run in runs:
        assert np.ptp(run["q1"]) > 2.0 * np.pi
        assert np.abs(run.constraint_residual).max() < 1e-9
    ends = np.array([run.y[:, -1] for run in runs])
    drifts = [np.ptp(run.energy) for run in runs]
    np.testing.assert_allclose(np.log2(drifts[:-1]) - np.log2(drifts[1:]), 2.0, atol=0.2)
    changes = np.abs(np.diff(ends, axis=0)).max(axis=1)
    assert np.log2(changes[0] / changes[1]) == pytest.approx(2.0, abs=0.3)


def test_ali3p_with_redundant_spatial_rows_gives_the_planar_motion(four_bar):
    """Rows that are redundant everywhere, and lose rank on top of that: through the same positions."""
    spatial = fb.compile_model(spatial_four_bar())
    free = {"parameters": {"k": 0.0, "c": 0.0}, "inputs": {"F": 0.0}}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": 9.0}, parameters=free["parameters"])
    run = spatial.simulate((0.0, 1.0), x0, method="ALI3P", max_step=1e-3)
    planar = four_bar.simulate((0.0, 1.0), x0, method="ALI3P", max_step=1e-3, **free)
    assert run.success
    assert run["q1"][0] < np.pi < run["q1"][-1]
    assert np.abs(run.constraint_residual).max() < 1e-9
    # Each step's equations are solved to 1e-9, and the position amplifies what is left.
    np.testing.assert_allclose(run.y[:, -1], planar.y[:, -1], rtol=0, atol=1e-6)


@pytest.mark.slow(but=["cartesian_pendulum-start5-None", "slider_crank-None-None", "rolling_disc-start3-speeds3"])
@pytest.mark.parametrize(
    ("make", "start", "speeds"),
    [
        (fb.models.four_bar, None, None),
        (lambda: fb.models.chain(3), None, None),
        (fb.models.slider_crank, None, None),
        (fb.models.rolling_disc, {"q3": 0.4}, {"u1": 0.2, "u2": 3.0, "u3": 0.1}),
        (fb.models.whipple_bicycle, {"q4": 0.1}, {"u6": -15.0, "u4": 0.3}),
        (fb.models.cartesian_pendulum, {"y": 0.0}, None),
    ],
)
def test_ali3p_on_regular_motions_converges_to_dop853_with_second_order(make, start, speeds):
    """Against SciPy's DOP853 at 1e-11."""
    model = fb.compile_model(make())
    x0 = model.initial_state(start, speeds)
    exact = solve_ivp(model.ode(), (0.0, 1.0), x0, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    errors = []
    for h in (1e-3, 5e-4, 2.5e-4):
        run = model.simulate((0.0, 1.0), x0, method="ALI3P", max_step=h)
        assert run.success
        assert run.t[-1] == 1.0
        errors.append(np.abs(run.y[:, -1] - exact).max())
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), 2.0, atol=0.1)


def test_ali3p_backwards_returns_to_the_start(four_bar):
    x0 = four_bar.initial_state()
    there = four_bar.simulate((0.0, 1.0), x0, method="ALI3P", max_step=1e-3)
    back = four_bar.simulate((1.0, 0.0), there.y[:, -1], method="ALI3P", max_step=1e-3)
    # The trapezoidal rule is symmetric: what remains is of the projections.
    np.testing.assert_allclose(back.y[:, -1], x0, atol=1e-6)


def test_ali3p_with_repeated_constraints_gives_the_motion_of_single_ones():
    single = fb.compile_model(fb.models.cartesian_pendulum())
    repeated = fb.compile_model(pendulum(circle, 3 * circle, -0.2 * circle))
    x0 = single.initial_state([0.6], [0.5])
    runs = [model.simulate((0.0, 2.0), x0, method="ALI3P", max_step=1e-3) for model in (single, repeated)]
    # Newton's method ends where speeds change by 1e-9 of the largest, in either run; steps add up to twice that.
    np.testing.assert_allclose(runs[1].y, runs[0].y, rtol=0, atol=4e-9 * np.abs(runs[0].y[2:]).max())


def test_ali3p_on_redundant_parallelograms_equals_an_inverted_pendulum():
    """Through its level position: l p'' = g sin p, an inverted pendulum."""
    model = fb.compile_model(three_uprights())
    x0 = model.initial_state({"p0": 0.5}, {"v0": 0.7}, guess=[0.5, 0.5, 0.0])
    exact = solve_ivp(lambda t, y: [y[1], 9.81 * np.sin(y[0])], (0.0, 2.0), [0.5, 0.7], rtol=1e-11, atol=1e-11).y[:, -1]
    assert exact[0] > np.pi
    errors = []
    for h in (2e-3, 1e-3):
        run = model.simulate((0.0, 2.0), x0, method="ALI3P", max_step=h)
        assert run.success
        assert np.abs(run.constraint_residual).max() < 1e-9
        errors.append(np.abs([run["p0"][-1] - exact[0], run["v0"][-1] - exact[1]]).max())
    assert errors[1] < 1e-4
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


@pytest.mark.slow(but=["1000.0-0.0001", "0.0-5e-06"])
@pytest.mark.parametrize(("begin", "h"), [(0.0, 5e-6), (1000.0, 1e-4)])
def test_ali3p_with_short_steps_or_late_times_equals_dop853(four_bar, begin, h):
    """Speeds come to rest at t = 0.8; the times' rounding errors leave a sliver of a step at the end."""
    how = {"inputs": {"F": 0.0}, "t_eval": [begin + 1.0]}
    run = four_bar.simulate((begin, begin + 1.0), method="ALI3P", max_step=h, **how)
    exact = four_bar.simulate((begin, begin + 1.0), rtol=1e-12, atol=1e-12, **how)
    assert run.success
    # h^2 times a constant of order one, as test_ali3p_on_regular_motions_converges_to_dop853_with_second_order has it.
    np.testing.assert_allclose(run.y, exact.y, rtol=0, atol=20.0 * h**2)


def test_ali3p_with_max_steps_ends_there_with_a_message(four_bar):
    run = four_bar.simulate((0.0, 1.0), method="ALI3P", max_step=1e-3, max_steps=10)
    assert not run.success
    assert "max_steps = 10" in run.message
    assert run.t[-1] == pytest.approx(0.01)


def level(model, offset, rate):
    """All uprights of a row of parallelograms level but for an offset, or all turning at a rate."""
    n = model.n_q // 2 + 1
    return np.concatenate((np.full(n, np.pi / 2 + offset), np.zeros(n - 1), np.full(n, rate), np.zeros(n - 1)))


@pytest.mark.slow
@pytest.mark.parametrize("loops", [2, 5])  # by pivoting, and in an order chosen in advance
@pytest.mark.parametrize("rate", [0.0, 1.0])
def test_nothing_is_evaluated_at_a_singular_position(loops, rate):
    """At rest as well, where J u' + gamma = 0 has solutions: what they are, the constraints do not say."""
    model = fb.compile_model(fb.models.n_four_bar(loops))
    for offset in (0.0, 1e-15, -1e-15, 1e-14):
        x = level(model, offset, rate)
        for evaluate in (model.rhs, model.multipliers, model.jacobian):
            with pytest.raises(fb.SimulationError, match="singular position"):
                evaluate(0.0, x)
        assert np.isnan(model.rhs_batch(0.0, x[:, np.newaxis])).all()
        for method in ("DOP853", "Radau", "IDA"):
            with pytest.raises(fb.SimulationError, match="singular position"):
                model.simulate((0.0, 1.0), x, method=method)
    # Beside it, all bars swing as one: [(N + 1) / 3 + N] l phi'' = [(N + 1) / 2 + N] g sin(phi).
    x = level(model, 1e-3, rate)
    expected = ((loops + 1) / 2 + loops) / ((loops + 1) / 3 + loops) * 9.81 * np.sin(np.pi / 2 + 1e-3)
    np.testing.assert_allclose(model.rhs(0.0, x)[model.n_q : model.n_q + loops + 1], expected, rtol=1e-10)


def test_ali3p_from_a_singular_position_keeps_energy_and_the_branch():
    """What passes such positions may begin at one; the energy of N + 1 uprights and N bars across stays."""
    parallelograms = fb.compile_model(fb.models.n_four_bar(2))
    run = parallelograms.simulate((0.0, 0.1), level(parallelograms, 0.0, 1.0), method="ALI3P", max_step=1e-3)
    assert run.success
    assert np.ptp(run.energy) < 1e-3
    np.testing.assert_allclose(run["p1"], run["p0"], atol=1e-9)


def knife_edge(repeated=False):
    """A blade that does not slip sideways: -sin(F) vx + cos(F) vy = 0 with vy dependent; repeated, with vx as well."""
    x, y, heading, vx, vy, w = me.dynamicsymbols("x y F v_x v_y w")
    t = me.dynamicsymbols._t
    plane, blade, origin, point = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("O"), me.Point("P")
    origin.set_vel(plane, 0)
    blade.orient_axis(plane, plane.z, heading)
    blade.set_ang_vel(plane, w * plane.z)
    point.set_pos(origin, x * plane.x + y * plane.y)
    point.set_vel(plane, vx * plane.x + vy * plane.y)
    system = System(plane, origin)
    system.add_bodies(me.RigidBody("blade", point, blade, 1, (me.inertia(blade, 0, 0, 1), point)))
    system.q_ind, system.u_ind, system.u_dep = [x, y, heading], [vx, w], [vy]
    system.add_kdes(vx - x.diff(t), vy - y.diff(t), w - heading.diff(t))
    slip = -sm.sin(heading) * vx + sm.cos(heading) * vy
    system.add_nonholonomic_constraints(slip)
    if repeated:
        system.u_ind, system.u_dep = [w], [vx, vy]
        system.add_nonholonomic_constraints(3 * slip)
    return fb.compile_model(fb.Model(system, name="knife_edge"))


@pytest.mark.slow
def test_initial_state_whose_dependent_speeds_are_undetermined_is_refused():
    """A constraint and its double determine one of two dependent speeds: any speed along the blade satisfies them."""
    twice = knife_edge(repeated=True)
    assert twice.rhs(0.0, [0.0, 0.0, 0.3, 0.5, np.cos(0.3), np.sin(0.3)]) == pytest.approx(
        [np.cos(0.3), np.sin(0.3), 0.5, 0.0, -0.5 * np.sin(0.3), 0.5 * np.cos(0.3)], abs=1e-15
    )
    with pytest.raises(fb.AssemblyError, match=r"dependent speeds \(v_x, v_y\) do not follow"):
        twice.initial_state([0.0, 0.0, 0.3], [0.5])


@pytest.mark.slow
def test_dependent_speed_with_a_coefficient_of_rounding_size_is_undetermined():
    """cos(pi/2) is 6e-17 in double: vx says nothing of vy there, nor does its change."""
    blade = knife_edge()
    np.testing.assert_allclose(blade.initial_state([0.0, 0.0, 0.3], [1.0, 0.5])[5], np.tan(0.3), rtol=1e-14)
    with pytest.raises(fb.AssemblyError, match=r"dependent speeds \(v_y\) do not follow"):
        blade.initial_state([0.0, 0.0, np.pi / 2], [1.0, 0.5])
    x = [0.0, 0.0, np.pi / 2, 0.0, 0.5, 1.0]
    for evaluate in (blade.linearize, blade.mass_matrix, blade.forcing):
        with pytest.raises(fb.SimulationError, match=r"dependent variables \(v_y\) do not follow"):
            evaluate(0.0, x)
    # The motion itself needs no such choice: a blade at speed v turning at w is pushed sideways, v w to its left.
    np.testing.assert_allclose(blade.rhs(0.0, x), [0.0, 1.0, 0.5, -0.5, 0.0, 0.0], atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_ali3p_with_rows_of_very_different_size_keeps_its_second_order(factor):
    """A bead on a great circle, by a sphere times a factor and a plane: a pendulum, whose second order is kept."""
    names = "x y z"
    q, u = me.dynamicsymbols(names), me.dynamicsymbols("u v w")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, sum((a * e for a, e in zip(q, frame, strict=True)), 0 * frame.x))
    point.set_vel(frame, sum((a * e for a, e in zip(u, frame, strict=True)), 0 * frame.x))
    system = System(frame, origin)
    system.add_bodies(me.Particle("bead", point, sm.Symbol("m")))
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = q[:1], q[1:], u[:1], u[1:]
    system.add_kdes(*(b - a.diff() for a, b in zip(q, u, strict=True)))
    system.add_holonomic_constraints(factor * (sum(a**2 for a in q) - 1), q[0] - q[1])
    system.apply_uniform_gravity(-sm.Symbol("g") * frame.z)
    values = {sm.Symbol("m"): 1.0, sm.Symbol("g"): 9.81}
    start = {q[0]: 0.5, u[0]: 0.0, q[1]: 0.5, q[2]: -0.7}
    model = fb.compile_model(fb.Model(system, name="bead", parameters=values, initial=start))
    exact = model.simulate((0.0, 1.0), rtol=1e-11, atol=1e-11)
    errors = [
        np.abs(model.simulate((0.0, 1.0), method="ALI3P", max_step=h).y[:, -1] - exact.y[:, -1]).max()
        for h in (4e-3, 1e-3)
    ]
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.2)


@pytest.mark.slow
def test_run_with_a_drive_to_its_dead_centre_stops_there_with_a_message():
    """A rocker driven to its end, where crank and coupler are in line: by the law of cosines."""
    points = {"O": (0, 0), "A": (0.1, 0), "B": (0.22, 0.35), "R": (0.4, 0)}
    linkage = fb.Linkage("locked", points=points, ground="OR", links=["OA", "AB", "BR"], density=2.0)
    linkage.drive("BR", speed=1.0)
    run = fb.compile_model(linkage.model()).simulate((0.0, 5.0), rtol=1e-8, atol=1e-8)
    assert not run.success
    a, b, c, d = 0.1, np.hypot(0.12, 0.35), np.hypot(0.18, 0.35), 0.4
    start, end = (np.arccos((c**2 + d**2 - e**2) / (2 * c * d)) for e in (np.hypot(0.22, 0.35), b - a))
    # Near a dead centre the position's error is the square root of the step's, and it stops there.
    assert run.t[-1] == pytest.approx(start - end, abs=1e-4)
    assert "The prescribed motion cannot go on from there" in run.message
    assert "ALI3P" not in run.message


@pytest.mark.slow
def test_run_with_a_drive_that_locks_does_not_report_energy_growth():
    """Their squares are inverse to the distance from the lock, so that the kinetic energy grows beyond all bounds."""
    points = {"O": (0, 0), "A": (0.1, 0.05), "B": (0.22, 0.35), "R": (0.4, 0)}
    linkage = fb.Linkage("fast", points=points, ground="OR", links=["OA", "AB", "BR"], density=2.0, gravity=9.81)
    linkage.drive("R", speed=20.0)
    run = fb.compile_model(linkage.model()).simulate((0.0, 3.0))
    assert run.kinetic_energy[-1] > 1e4 * run.kinetic_energy[0]
    assert "The prescribed motion cannot go on from there" in run.message
    assert "has grown" not in run.message
