"""One set of promises, kept by every method of `simulate`."""

import dataclasses
from importlib import import_module

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.redundant import circle, pendulum
from builders.systems import spatial_four_bar
from scipy.integrate import solve_ivp

import fourbar_codegen as fb

driven_four_bar = import_module("08_stiff_drive").driven_four_bar
TIGHT = {"rtol": 1e-8, "atol": 1e-8}
# How each is asked for, and the error that it may have in 2 s: that of its order where it has no step control, or
# controls the coordinates alone; otherwise a hundred times the tolerance, or a thousand with many steps.
METHODS = {
    "DOP853": (TIGHT, 1e-6),
    "RK45": (TIGHT, 1e-6),
    "Tsit5": (TIGHT, 1e-6),
    "ALI3P": ({"max_step": 1e-3}, 1e-4),
    "Radau": (TIGHT, 1e-6),
    "CVODE": (TIGHT, 1e-5),
    "IDA": (TIGHT, 1e-5),
    "IDA, index 1": ({**TIGHT, "formulation": "index-1"}, 1e-5),
    "IDA, index 3": ({**TIGHT, "formulation": "index-3"}, 1e-2),
}


@pytest.fixture(params=METHODS)
def method(request):
    how, error = METHODS[request.param]
    return {"method": request.param.partition(",")[0], **how}, error


@pytest.fixture(scope="module")
def exact(four_bar):
    """By SciPy, from the compiled right-hand side, whose loops drift open by 1e-10 m."""
    return solve_ivp(
        four_bar.ode(), (0.0, 2.0), four_bar.initial_state(), method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True
    )


def test_every_method_gives_the_reference_motion_within_its_error(four_bar, exact, method):
    how, error = method
    times = np.linspace(0.0, 2.0, 21)
    run = four_bar.simulate((0.0, 2.0), t_eval=times, **how)
    assert run.success, run.message
    np.testing.assert_array_equal(run.t, times)
    np.testing.assert_allclose(run.y, exact.sol(times), rtol=0, atol=error)
    assert run.nfev > 0
    stepped = four_bar.simulate((0.0, 2.0), **how)
    assert stepped.t[[0, -1]].tolist() == [0.0, 2.0]
    np.testing.assert_allclose(stepped.y[:, -1], run.y[:, -1], rtol=0, atol=1e-12)


@pytest.mark.slow(but=["DOP853", "Radau"])
def test_every_method_closes_loops_at_steps_samples_and_events(four_bar, method):
    how, _ = method
    for more in ({}, {"t_eval": np.linspace(0.0, 2.0, 33)}):
        run = four_bar.simulate((0.0, 2.0), **how, **more)
        assert np.abs(run.constraint_residual).max() < 1e-12
        assert np.abs(run.velocity_residual).max() < 1e-11
    run = four_bar.simulate((0.0, 2.0), **how, events=lambda t, x: x[3], dense_output=True)
    for x in (*run.y_events[0], *run.sol(np.linspace(0.0, 2.0, 33)).T):
        assert np.abs(four_bar.position_constraints(0.0, x[:3])).max() < 1e-12


def test_events_of_all_directions_are_found_at_the_reference_times_by_every_method(four_bar, exact, method):
    how, error = method

    def turns(t, x):
        return x[3]

    run = four_bar.simulate((0.0, 2.0), events=turns, **how)
    reference = solve_ivp(
        four_bar.ode(), (0.0, 2.0), exact.y[:, 0], method="DOP853", rtol=1e-12, atol=1e-12, events=turns
    )
    np.testing.assert_allclose(run.t_events[0], reference.t_events[0], atol=error)
    turns.terminal = True
    ended = four_bar.simulate((0.0, 2.0), events=turns, **how)
    assert ended.status == 1
    assert ended.t[-1] == pytest.approx(reference.t_events[0][0], abs=error)
    turns.terminal, turns.direction = False, -1.0
    falling = four_bar.simulate((0.0, 2.0), events=turns, **how)
    assert len(falling.t_events[0]) < len(run.t_events[0])


def test_dense_output_of_every_method_equals_the_reference_within_its_error(four_bar, exact, method):
    how, error = method
    run = four_bar.simulate((0.0, 2.0), dense_output=True, **how)
    times = np.linspace(0.0, 2.0, 101)
    np.testing.assert_allclose(run.sol(times), exact.sol(times), rtol=0, atol=5 * error)
    assert run.sol(0.7).shape == (6,)


def test_inputs_of_all_kinds_give_the_same_motion_by_every_method(four_bar, method):
    how, error = method
    times = np.linspace(0.0, 1.0, 3)
    at_rest = four_bar.simulate((0.0, 1.0), inputs={"F": 0.0}, **how).y[:, -1]
    by_table = four_bar.simulate((0.0, 1.0), inputs={"F": (times, np.zeros(3))}, **how).y[:, -1]
    by_callable = four_bar.simulate((0.0, 1.0), inputs={"F": lambda t, x: 0.0}, **how).y[:, -1]
    np.testing.assert_allclose(by_table, at_rest, rtol=0, atol=error)
    np.testing.assert_allclose(by_callable, at_rest, rtol=0, atol=error)
    damped = four_bar.simulate((0.0, 1.0), inputs={"F": lambda t, x: -50.0 * x[3]}, **how)
    exact = solve_ivp(
        four_bar.ode(inputs={"F": lambda t, x: -50.0 * x[3]}), (0.0, 1.0), four_bar.initial_state(), method="DOP853",
        rtol=1e-11, atol=1e-11,
    )  # fmt: skip
    np.testing.assert_allclose(damped.y[:, -1], exact.y[:, -1], rtol=0, atol=error)
    np.testing.assert_allclose(damped["F"], -50.0 * damped["u1"], rtol=1e-12)


def test_changed_parameters_give_the_reference_motion_by_every_method(four_bar, method):
    how, error = method
    parameters = {"k": 30.0, "l2": 0.49}
    run = four_bar.simulate((0.0, 1.0), parameters=parameters, **how)
    x0 = four_bar.initial_state(parameters=parameters)
    exact = solve_ivp(four_bar.ode(parameters), (0.0, 1.0), x0, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    np.testing.assert_allclose(run.y[:, -1], exact, rtol=0, atol=error)


def test_callable_input_that_raises_ends_the_run_with_its_error_by_every_method(four_bar, method):
    how, _ = method

    def force(t, x):
        raise RuntimeError("no force")

    with pytest.raises(RuntimeError, match="no force"):
        four_bar.simulate((0.0, 1.0), inputs={"F": force}, **how)


@pytest.mark.parametrize(
    "wrong",
    [
        {"t_span": (0.0, 0.0)},
        {"t_span": (0.0, np.nan)},
        {"x0": np.zeros(5)},
        {"x0": np.full(6, np.nan)},
        {"parameters": {"stiffness": 1.0}},
        {"inputs": {"G": 1.0}},
        {"t_eval": [0.5, 3.0]},
        {"constraints": "closed"},
        {"max_step": -1.0},
        {"atol": 0.0},
        {"events": "nothing"},
        {"progress": 1.0},
    ],
)
def test_wrong_arguments_are_refused_by_name_by_every_method(four_bar, method, wrong):
    how, _ = method
    said = {"x0": "state", "parameters": "parameter", "inputs": "input"}
    with pytest.raises(fb.ModelError, match=said.get(next(iter(wrong)), next(iter(wrong)))):
        four_bar.simulate(**{"t_span": (0.0, 1.0), **how, **wrong})


def test_run_past_the_domain_of_a_force_stops_there_by_every_method(method):
    """A force that has no value behind t = 1: a sentence says where, and what there is before stays."""
    x, u = me.dynamicsymbols("x u")
    m, k = sm.symbols("m k")
    t = me.dynamicsymbols._t
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    point.set_pos(origin, x * ground.x)
    point.set_vel(ground, u * ground.x)
    system = me.System(ground, origin)
    system.add_bodies(me.Particle("B", point, m))
    system.add_loads(me.Force(point, k * sm.sqrt(1 - t) * ground.x))
    system.add_coordinates(x)
    system.add_speeds(u)
    system.add_kdes(u - x.diff(t))
    model = fb.compile_model(fb.Model(system, name="ends", parameters={m: 1.0, k: 1.0}))
    how, _ = method
    run = model.simulate((0.0, 2.0), [0.0, 0.0], **how)
    assert not run.success
    assert "stopped at t = " in run.message
    assert run.t[-1] == pytest.approx(1.0, abs=0.05)
    assert np.isfinite(run.y).all()


def test_singular_position_ends_the_run_of_every_method_but_ali3p(four_bar, method):
    """The tutorial's linkage comes to one at t = 5.337 s, where all its links lie on a line, q1 = pi, and from which it
    may go on in more than one way."""
    how, _ = method
    run = four_bar.simulate((0.0, 6.0), **how)
    if how["method"] == "ALI3P":
        assert run.success
        return
    assert not run.success
    assert "singular position at t = 5.33" in run.message
    # The run ends before the step that came to it.
    assert run.t[-1] == pytest.approx(5.337, abs=1e-2)
    assert np.abs(run.constraint_residual).max() < 1e-12


def test_initial_state_that_violates_constraints_is_refused_by_every_method(four_bar, method):
    how, _ = method
    with pytest.raises(fb.ModelError, match="violates the constraints"):
        four_bar.simulate((0.0, 1.0), np.ones(6), **how)
    if how["method"] in ("ALI3P", "IDA") and how.get("formulation") != "index-1":
        with pytest.raises(fb.ModelError, match="violates the constraints"):
            four_bar.simulate((0.0, 1.0), np.ones(6), constraints="none", **how)


def test_input_that_becomes_nan_ends_the_run_there_by_every_method(four_bar, method):
    how, _ = method
    run = four_bar.simulate((0.0, 1.0), inputs={"F": lambda t, x: 1.0 if t < 0.5 else np.nan}, **how)
    assert not run.success
    assert "or an input that is not finite" in run.message
    assert run.t[-1] == pytest.approx(0.5, abs=0.05)


def test_max_steps_and_progress_are_kept_by_every_method(four_bar, method, monkeypatch):
    how, _ = method
    run = four_bar.simulate((0.0, 1.0), max_steps=5, **how)
    assert not run.success
    assert "max_steps = 5" in run.message
    assert len(run.t) == 6
    for wrong in (0, -1, 2.0, True):
        with pytest.raises(fb.ModelError, match="max_steps"):
            four_bar.simulate((0.0, 1.0), max_steps=wrong, **how)
    monkeypatch.setattr("fourbar_codegen.simulation.integrate.PAUSE_SECONDS", 0.0)
    seen = []
    four_bar.simulate((0.0, 1.0), progress=seen.append, **how)
    assert seen == sorted(seen)
    assert seen
    assert 0.0 < seen[0] <= seen[-1] <= 1.0


def test_keyboard_interrupt_ends_the_run_of_every_method(four_bar, method, monkeypatch):
    def interrupted(t):
        raise KeyboardInterrupt

    how, _ = method
    monkeypatch.setattr("fourbar_codegen.simulation.integrate.PAUSE_SECONDS", 0.0)
    with pytest.raises(KeyboardInterrupt):
        four_bar.simulate((0.0, 1.0), progress=interrupted, **how)


def test_event_that_writes_into_its_state_leaves_the_run_unchanged(four_bar, method):
    how, _ = method

    def event(t, x):
        value = x[3]
        x[:] = 7.0
        return value

    run = four_bar.simulate((0.0, 1.0), events=event, **how)
    np.testing.assert_array_equal(run.y, four_bar.simulate((0.0, 1.0), events=lambda t, x: x[3], **how).y)
    with pytest.raises(fb.ModelError, match="event's callable must be a real number"):
        four_bar.simulate((0.0, 1.0), events=lambda t, x: x, **how)


def test_max_step_below_rounding_errors_is_refused_by_every_method(four_bar, method):
    how, _ = method
    with pytest.raises(fb.ModelError, match="max_step = 1e-17 is below the rounding error"):
        four_bar.simulate((1.0, 2.0), **{**how, "max_step": 1e-17})
    run = four_bar.simulate((1.0, 2.0), **{**how, "max_step": 1e-15, "max_steps": 10})
    assert not run.success
    assert "step" in run.message


@pytest.mark.slow(but=["Radau", "CVODE", "IDA"])
def test_coordinates_close_to_zero_run_with_closed_loops_by_every_method(method):
    """Loops of links of 1 m are closed to rounding errors of these, though the coordinates be 1e-8."""
    loops = fb.compile_model(fb.models.n_four_bar(2))
    how, _ = method
    for span in (1e-8, 3e-8, 1e-6):
        run = loops.simulate((0.0, span), **{**how, "max_step": span / 5})
        assert run.success, run.message
        # All bars turn alike, with 1 rad/s; gravity changes that by 1e-5 in a microsecond.
        np.testing.assert_allclose(run["p0"], run.t, rtol=1e-4, atol=1e-15)


def test_dense_output_takes_no_or_one_time_and_refuses_arrays_of_two_dimensions(four_bar, method):
    how, _ = method
    run = four_bar.simulate((0.0, 1.0), dense_output=True, **how)
    assert run.sol([]).shape == (6, 0)
    assert run.sol([0.5]).shape == (6, 1)
    with pytest.raises(fb.ModelError, match="one dimension"):
        run.sol(np.zeros((2, 2)))


def test_run_backwards_returns_to_the_start_by_every_method(four_bar, method):
    how, error = method
    there = four_bar.simulate((0.0, 1.0), **how)
    back = four_bar.simulate((1.0, 0.0), there.y[:, -1], t_eval=[0.7, 0.2], **how)
    assert back.t.tolist() == [0.7, 0.2]
    ended = four_bar.simulate((1.0, 0.0), there.y[:, -1], **how)
    np.testing.assert_allclose(ended.y[:, -1], there.y[:, 0], rtol=0, atol=5 * error)


@pytest.mark.slow(but=["Radau", "CVODE", "IDA"])
def test_redundant_rows_of_a_spatial_loop_give_the_planar_motion_by_every_method(four_bar, method):
    """Five rows, two of them independent: the motion is that of the planar linkage with its two."""
    how, _ = method
    spatial = fb.compile_model(spatial_four_bar())
    x0 = four_bar.initial_state()
    if how["method"] == "IDA":
        with pytest.raises(fb.ModelError, match="redundant"):
            spatial.simulate((0.0, 1.0), x0, **how)
        return
    run = spatial.simulate((0.0, 1.0), x0, **how)
    planar = four_bar.simulate((0.0, 1.0), x0, parameters={"k": 0.0, "c": 0.0}, inputs={"F": 0.0}, **how)
    assert run.success
    assert np.abs(run.constraint_residual).max() < 1e-12
    # By the same steps: rounding errors, and of ALI3P the share to which it solves its equations, 1e-9.
    np.testing.assert_allclose(run.y[:, -1], planar.y[:, -1], rtol=0, atol=1e-8)


@pytest.fixture(scope="module")
def driven():
    return fb.compile_model(driven_four_bar())


STIFF = {"rtol": 1e-6, "atol": 1e-6}
# How each is asked for; the error that it may have, a hundred times the tolerance, or a thousand where speeds are not
# controlled; and by how much it has fewer evaluations than an explicit method needs.
ON_A_STIFF_DRIVE = {
    "DOP853": (STIFF, 1e-4, None),
    "RK45": (STIFF, 1e-4, None),
    "Tsit5": (STIFF, 1e-4, None),
    "ALI3P": ({"max_step": 1e-2}, 1e-3, 20),
    "Radau": (STIFF, 1e-4, 20),
    "CVODE": (STIFF, 1e-4, 20),
    "IDA": (STIFF, 1e-4, 20),
    "IDA, index 1": ({**STIFF, "formulation": "index-1"}, 1e-4, 20),
    "IDA, index 3": ({**STIFF, "formulation": "index-3"}, 1e-3, 20),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_A_STIFF_DRIVE)
def test_stiff_drive_is_followed_by_every_method_in_few_steps_by_implicit_ones(driven, name):
    """Of a shaft whose own motion dies away in 3 us, explicit methods have to follow what is left of it."""
    how, error, fewer = ON_A_STIFF_DRIVE[name]
    run = driven.simulate((0.0, 1.0), method=name.partition(",")[0], **how)
    assert run.success, run.message
    assert np.abs(run.constraint_residual).max() < 1e-12
    exact = solve_ivp(driven.ode(), (0.0, 1.0), run.y[:, 0], method="Radau", rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(run.y[:, -1], exact.y[:, -1], rtol=0, atol=error)
    # The crank is where the motor is, but for what the shaft gives: its torque is below 100 N m, by 1e6 N m/rad.
    assert run["q1"][-1] == pytest.approx(0.5 * (1.0 - np.cos(3.0)) - 0.5, abs=1e-4)
    explicit = 6.0 * 3.8e5 / 3.3  # RK45: its stages by the least eigenvalue and its bound of stability
    if fewer is None:
        assert run.nfev > explicit / 2
    else:
        assert run.nfev < explicit / fewer


def test_ida_with_index_3_says_that_its_tolerance_holds_for_coordinates_only(four_bar, exact):
    runs = {
        name: four_bar.simulate((0.0, 2.0), method="IDA", formulation=name, t_eval=exact.t, rtol=1e-8, atol=1e-8)
        for name in ("gear-gupta-leimkuhler", "index-3")
    }
    errors = {name: np.abs(run.y - exact.y).max() for name, run in runs.items()}
    assert errors["index-3"] > 20 * errors["gear-gupta-leimkuhler"]
    assert "the tolerance applies to the coordinates only" in runs["index-3"].message
    assert "tolerance" not in runs["gear-gupta-leimkuhler"].message


@pytest.mark.slow(but=["ALI3P-more1"])
@pytest.mark.parametrize(("name", "more"), [("IDA", {"formulation": "index-3"}), ("ALI3P", {"max_step": 1e-2})])
def test_stiff_spring_is_passed_in_long_steps_by_index_3_and_ali3p(driven, name, more):
    """10,000 rad/s; methods that do not control the speeds take steps as long as the motion asks for."""
    parameters = {"stiffness": 3e7, "damping": 6e3}
    how = {"rtol": 1e-6, "atol": 1e-6, **more}
    run = driven.simulate((0.0, 1.0), parameters=parameters, method=name, **how)
    exact = driven.simulate((0.0, 1.0), parameters=parameters, method="DOP853", rtol=1e-10, atol=1e-10)
    assert run.success
    assert len(run.t) < 200
    assert exact.nfev > 30_000
    np.testing.assert_allclose(run.q[:, -1], exact.q[:, -1], rtol=0, atol=1e-5)
    np.testing.assert_allclose(run.u[:, -1], exact.u[:, -1], rtol=0, atol=1e-3)


def test_ida_with_redundant_constraints_is_refused():
    repeated = fb.compile_model(pendulum(circle, 2 * circle))
    with pytest.raises(fb.ModelError, match="redundant"):
        repeated.simulate((0.0, 1.0), [-0.8, 0.6, 0.0, 0.0], method="IDA")
    with pytest.raises(fb.ModelError, match="redundant"):
        solve_ivp(repeated.ode(), (0.0, 1.0), [0.6, -0.8, 0.5, 0.375], method=fb.solvers.IDA)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_long_steps_across_a_singular_position_end_the_run_with_a_message(four_bar, tolerance):
    """Whether they come upon it or, by loops that close in another way, to the other side."""
    for method in ("DOP853", "Radau", "IDA"):
        run = four_bar.simulate((0.0, 6.0), method=method, rtol=tolerance, atol=tolerance)
        assert not run.success
        assert "singular position" in run.message


@pytest.mark.parametrize("name", ["RK45", "BDF", "LSODA", "CVODE", "IDA"])
def test_solvers_in_solve_ivp_refuse_wrong_shapes_and_options(four_bar, name):
    x0 = four_bar.initial_state()
    for wrong in (x0[:5], np.append(x0, 0.0)):
        with pytest.raises(fb.ModelError, match="shape"):
            solve_ivp(four_bar.ode(), (0.0, 1.0), wrong, method=getattr(fb.solvers, name))
    if name in ("CVODE", "IDA"):
        for options in ({"rtol": -1.0}, {"atol": [1e-6]}, {"max_step": np.nan}):
            with pytest.raises(fb.ModelError):
                solve_ivp(four_bar.ode(), (0.0, 1.0), x0, method=getattr(fb.solvers, name), **options)
        with pytest.raises(fb.ModelError, match="finite end"):
            solve_ivp(four_bar.ode(), (0.0, np.inf), x0, method=getattr(fb.solvers, name))


def test_a_failed_step_leaves_the_state_it_began_with(four_bar):
    """At t = -1e308 the step lengths that LSODA tries are beyond the range of double."""
    solver = fb.solvers.LSODA(four_bar.ode(), -1e308, four_bar.initial_state(), 1.0)
    assert "not finite" in solver.step()
    assert solver.status == "failed"
    np.testing.assert_array_equal(solver.y, four_bar.initial_state())


@pytest.mark.slow
def test_error_of_ida_in_a_fall_stays_within_the_tolerance_times_the_growth():
    """A bicycle that falls over, at speeds of 900 rad/s: an error on the way ends some 1e5 times as large."""
    bicycle = fb.compile_model(fb.models.whipple_bicycle())
    x0 = bicycle.initial_state({"q4": 0.0}, {"u6": -2.0 / 0.3, "u4": 0.5})
    exact = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
    reference = bicycle.simulate((0.0, 2.5), x0, **exact)
    # What a relative error of 1e-6, IDA's tolerance, at the worst time ends as.
    lying = (reference.t > 2.003) & (reference.t < 2.004)
    start, fallen = reference.t[lying][0], reference.y[:, lying][:, 0]
    ends = [bicycle.simulate((start, 2.5), fallen * scale, **exact).y[:, -1] for scale in (1.0, 1.0 + 1e-8)]
    growth = np.abs(ends[1] - ends[0]).max() / 1e-8
    assert growth > 1e3
    run = bicycle.simulate((0.0, 2.5), x0, method="IDA")
    assert run.success
    assert np.abs(run.y[:, -1] - reference.y[:, -1]).max() < 1e-6 * growth


OPTIONS = {"rtol": 1e-5, "atol": 1e-7, "max_step": 0.05, "max_steps": 500, "formulation": "index-1", "step": 0.01}


@pytest.mark.parametrize("name", ["DOP853", "RK45", "Tsit5", "Radau", "ALI3P", "CVODE", "IDA"])
def test_method_as_an_object_gives_the_run_of_its_name_and_the_same_options(four_bar, name):
    kind = getattr(fb, name)
    own = {field.name: OPTIONS[field.name] for field in dataclasses.fields(kind)}
    flat = {"max_step" if option == "step" else option: value for option, value in own.items()}
    found, expected = (
        four_bar.simulate((0.0, 1.0), **how) for how in ({"method": kind(**own)}, {"method": name} | flat)
    )
    assert found.settings == expected.settings
    np.testing.assert_array_equal(found.y, expected.y)
    for option, value in own.items():
        place = "max_step" if option == "step" else option
        with pytest.raises(fb.ModelError, match=f"The {option} of {name} is given twice, as {name}"):
            four_bar.simulate((0.0, 1.0), method=kind(**own), **{place: value})


def test_method_has_no_options_of_others():
    for name, option in (("DOP853", "formulation"), ("RK45", "step"), ("ALI3P", "rtol"), ("Radau", "formulation")):
        with pytest.raises(TypeError, match=option):
            getattr(fb, name)(**{option: OPTIONS[option]})


def test_class_of_a_method_stands_for_its_defaults(four_bar):
    run = four_bar.simulate((0.0, 1.0), method=fb.Tsit5)
    np.testing.assert_array_equal(run.y, four_bar.simulate((0.0, 1.0), method="Tsit5").y)


def test_ensembles_fits_and_jax_take_methods_as_objects(four_bar):
    times = np.linspace(0.0, 1.0, 11)
    named = four_bar.ensemble((0.0, 1.0), method="RK45", rtol=1e-5)
    np.testing.assert_array_equal(four_bar.ensemble((0.0, 1.0), method=fb.RK45(rtol=1e-5)).y, named.y)
    measured = {"t": times, "q1": four_bar.simulate((0.0, 1.0), t_eval=times, parameters={"k": 3.0})["q1"]}
    fit = fb.fit(four_bar, measured, ["k"], method=fb.RK45(rtol=1e-9))
    assert fit.values["k"] == pytest.approx(3.0, rel=1e-3)
    assert fit.runs[0].settings["rtol"] == 1e-9
    assert fb.fit(four_bar, measured, ["k"], method=fb.RK45()).runs[0].settings["rtol"] == 1e-8


def test_methods_that_ensembles_do_not_have_are_refused_as_objects_too(four_bar):
    with pytest.raises(fb.ModelError, match="no method for ensembles 'IDA'"):
        four_bar.ensemble((0.0, 1.0), method=fb.IDA())


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("DOP853", {"rtol": -1.0}, "rtol must be a positive"),
        ("RK45", {"atol": [1e-6, 0.0]}, "atol must be a positive number, or an array of positive numbers"),
        ("Radau", {"max_step": 0.0}, "max_step must be positive"),
        ("Tsit5", {"max_steps": 0}, "max_steps must be a positive integer"),
        ("ALI3P", {"step": "x"}, "step must be a real number"),
        ("IDA", {"formulation": "index-2"}, "no formulation 'index-2'"),
    ],
)
def test_options_of_a_method_are_checked_when_it_is_made(name, options, words):
    with pytest.raises(fb.ModelError, match=words):
        getattr(fb, name)(**options)


def test_methods_with_the_same_options_are_equal_and_pages_and_steppers_take_their_names(four_bar):
    assert fb.DOP853(atol=np.full(6, 1e-8)) == fb.DOP853(atol=[1e-8] * 6)
    assert hash(fb.DOP853(atol=np.full(6, 1e-8))) == hash(fb.DOP853(atol=[1e-8] * 6))
    run = four_bar.simulate((0.0, 1.0), method=fb.DOP853(atol=np.full(6, 1e-8)))
    np.testing.assert_array_equal(run.y, four_bar.simulate((0.0, 1.0), atol=np.full(6, 1e-8)).y)
    stepper, named = (four_bar.stepper(0.01, method=method) for method in (fb.Radau(), "Radau"))
    np.testing.assert_array_equal(stepper.step(), named.step())
    with pytest.raises(fb.ModelError, match="method Radau has no options here, such as rtol"):
        four_bar.stepper(0.01, method=fb.Radau(rtol=1e-3))

    class Mine(fb.DOP853):
        """Somebody's defaults."""

    assert four_bar.simulate((0.0, 0.1), method=Mine(max_step=0.01)).settings["method"] == "DOP853"


def test_class_for_solve_ivp_is_told_apart_from_the_method(four_bar):
    with pytest.raises(fb.ModelError, match=r"fb.solvers.IDA is for solve_ivp; a method of runs is 'IDA', or fb.IDA"):
        four_bar.simulate((0.0, 1.0), method=fb.solvers.IDA)
