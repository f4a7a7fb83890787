"""Initial states and simulations: what goes in, what comes out."""

import copy
import csv
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.integrate
import sympy.physics.mechanics as me
from builders.systems import coordinate_free
from harness.archives import arrays_of
from scipy.integrate import solve_ivp

import fourbar_codegen as fb

METHODS = ["DOP853", "RK45", "Radau"]


@pytest.fixture(scope="module")
def reference(four_bar):
    """The end of the tutorial's run, by SciPy on the right-hand side with tight tolerances."""
    x0 = four_bar.initial_state()
    return solve_ivp(four_bar.ode(), (0, 4), x0, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_from_the_defaults_reaches_the_reference_state(four_bar, reference, method):
    run = four_bar.simulate((0.0, 4.0), method=method, rtol=1e-7, atol=1e-9)
    assert run.success
    assert run.t[-1] == 4.0
    # Tolerances hold for a step; the errors of up to 1000 steps add up.
    np.testing.assert_allclose(run.y[:, -1], reference, rtol=0, atol=1e-4)


@pytest.mark.slow(but=["-3.0-0.001-DOP853", "-3.0-0.001-RK23", "-3.0-0.001-RK45", "-3.0-1e-06-DOP853"])
@pytest.mark.parametrize("method", ["RK23", "RK45", "DOP853"])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-10])
@pytest.mark.parametrize("end", [4.0, -3.0])
def test_solvers_in_solve_ivp_take_scipys_steps_at_every_tolerance(four_bar, method, tolerance, end):
    x0 = np.repeat(four_bar.initial_state(), 2)[::2]
    how = {"rtol": tolerance, "atol": np.full(6, tolerance), "max_step": 0.5, "dense_output": True}
    scipys = solve_ivp(four_bar.ode(), (0.0, end), x0, method=method, **how)
    ours = solve_ivp(four_bar.ode(), (0.0, end), x0, method=getattr(fb.solvers, method), **how)
    assert (ours.nfev, len(ours.t), ours.status) == (scipys.nfev, len(scipys.t), 0)
    # The error estimate is a difference of sums, of the size of the tolerance; its rounding errors, 1e-16 / 1e-10
    # and more where it happens to be small, change the steps.
    np.testing.assert_allclose(ours.t, scipys.t, rtol=0, atol=1e-6)
    # The solutions differ by less than the change of steps, as the truncation errors do: by far less than they are.
    times = np.linspace(0.0, end, 50)
    np.testing.assert_allclose(ours.sol(times), scipys.sol(times), rtol=0, atol=1e-9)


def test_solvers_take_first_step_and_refuse_functions_that_are_not_compiled(four_bar):
    x0 = four_bar.initial_state()
    first = fb.solvers.RK45(four_bar.ode(), 0.0, x0, 4.0, first_step=0.01)
    first.step()
    assert first.t == 0.01
    with pytest.raises(fb.ModelError, match=r"scipy\.integrate\.RK45"):
        solve_ivp(lambda t, x: -x, (0.0, 1.0), [1.0], method=fb.solvers.RK45)


def test_an_error_in_a_callable_input_ends_a_step_in_c(four_bar):
    def force(t, x):
        if t > 1.0:
            raise LookupError("no force beyond 1 s")
        return 0.0

    with pytest.raises(LookupError, match="beyond 1 s"):
        four_bar.simulate((0.0, 4.0), inputs={"F": force})


@pytest.mark.parametrize("method", ["BDF", "LSODA"])
def test_implicit_methods_use_the_compiled_jacobian_unless_there_is_feedback(four_bar, method, monkeypatch):
    given = {}
    scipys = getattr(scipy.integrate, method)
    construct = scipys.__init__
    monkeypatch.setattr(scipys, "__init__", lambda *a, **options: given.update(options) or construct(*a, **options))
    x0, solver = four_bar.initial_state(), getattr(fb.solvers, method)
    solve_ivp(four_bar.ode(), (0.0, 1.0), x0, method=solver)
    np.testing.assert_array_equal(given["jac"](0.5, x0), four_bar.jacobian(0.5, x0))
    # Feedback makes the force depend on the state, which the compiled Jacobian cannot know.
    given.clear()
    solve_ivp(four_bar.ode(inputs={"F": lambda t, x: -x[3]}), (0.0, 1.0), x0, method=solver)
    assert "jac" not in given


def test_trajectory_of_a_run_has_scipys_names_and_shapes(four_bar):
    run = four_bar.simulate((0.0, 1.0), t_eval=np.linspace(0, 1, 11), dense_output=True)
    assert run.t.shape == (11,)
    assert run.y.shape == (6, 11)
    assert run.q.shape == run.u.shape == (3, 11)
    assert run["q2"].tolist() == run.y[1].tolist()
    assert run["u3"].tolist() == run.y[5].tolist()
    assert run[me.dynamicsymbols("q1")].tolist() == run.y[0].tolist()
    assert run.sol(0.5).shape == (6,)
    assert run.constraint_residual.shape == (2, 11)
    assert run.kinetic_energy.shape == run.potential_energy.shape == run.energy.shape == (11,)
    assert (run.status, run.success) == (0, True)
    assert run.t_events is None
    assert run.y_events is None


def test_constraint_residual_of_a_rolling_disc_is_the_slip_of_its_contact():
    """The slip of the disc's contact, m/s: (u4 - r q3' cos q1, u5 - r q3' sin q1)."""
    disc = fb.compile_model(fb.models.rolling_disc())
    run = disc.simulate((0.0, 1.0), constraints="none", rtol=1e-3, atol=1e-3)
    spin = np.array([disc.rhs(t, x)[2] for t, x in zip(run.t, run.y.T, strict=True)])
    slip = np.array([run["u4"] - 0.26 * spin * np.cos(run["q1"]), run["u5"] - 0.26 * spin * np.sin(run["q1"])])
    assert np.abs(slip).max() > 1e-5
    np.testing.assert_allclose(run.constraint_residual, slip, rtol=0, atol=1e-14)
    assert np.abs(disc.simulate((0.0, 1.0)).constraint_residual).max() < 1e-12
    bicycle = fb.compile_model(fb.models.whipple_bicycle()).simulate((0.0, 0.1))
    assert bicycle.constraint_residual.shape == (5, len(bicycle.t))  # a wheel on the ground, and four of slip


def test_residual_and_energies_of_a_run_equal_those_of_the_model_at_its_states(four_bar):
    parameters = {"l2": 0.45}
    run = four_bar.simulate((0.0, 1.0), parameters=parameters, t_eval=[0.0, 0.7, 1.0])
    for i, t in enumerate(run.t):
        residual = four_bar.position_constraints(t, run.q[:, i], parameters)
        np.testing.assert_array_equal(run.constraint_residual[:, i], residual)
        assert run.kinetic_energy[i] == four_bar.kinetic_energy(t, run.y[:, i], parameters)
        assert run.potential_energy[i] == four_bar.potential_energy(t, run.y[:, i], parameters)


def test_terminal_event_ends_the_run_at_the_sign_change(four_bar):
    def lowest(t, x):
        return x[3]

    lowest.terminal = True
    run = four_bar.simulate((0.0, 4.0), events=lowest, rtol=1e-9)
    assert run.status == 1
    assert run.t_events[0].shape == (1,)
    assert abs(run.y_events[0][0, 3]) < 1e-9


class TestInputs:
    """The force F as expression, number, table and callable."""

    t = np.linspace(0.0, 1.0, 20001)

    def end(self, four_bar, **options):
        return four_bar.simulate((0.0, 1.0), rtol=1e-10, atol=1e-10, **options).y[:, -1]

    def test_callable_input_of_time_gives_the_motion_of_the_same_expression(self, four_bar):
        end = self.end(four_bar, inputs={"F": lambda t, x: 100 * np.sin(np.pi * t)})
        np.testing.assert_allclose(end, self.end(four_bar), rtol=0, atol=1e-12)

    def test_table_input_of_a_sine_gives_the_motion_of_the_expression(self, four_bar):
        table = (self.t, 100 * np.sin(np.pi * self.t))
        # Linear interpolation errs by h^2/8 F'' = 3e-7 N, in accelerations of 10 rad/s^2 from some 100 N.
        np.testing.assert_allclose(self.end(four_bar, inputs={"F": table}), self.end(four_bar), rtol=0, atol=1e-7)

    def test_table_input_at_random_times_equals_numpys_interpolation(self, four_bar):
        generator = np.random.default_rng(1)
        times, values = np.sort(generator.uniform(0, 1, 30)), generator.normal(size=30)
        ode = four_bar.ode(inputs={"F": (times, values)})
        x0 = four_bar.initial_state()
        for t in [*generator.uniform(-0.2, 1.2, 500), times[0], times[-1], *times]:
            assert ode.input_values(t, x0)[0] == pytest.approx(np.interp(t, times, values), rel=1e-12, abs=1e-12)

    def test_constant_input_gives_the_motion_of_a_constant_table(self, four_bar):
        constant = self.end(four_bar, inputs={"F": 30.0})
        as_table = self.end(four_bar, inputs={me.dynamicsymbols("F"): ([0.0, 1.0], [30.0, 30.0])})
        np.testing.assert_allclose(constant, as_table, rtol=0, atol=1e-12)
        assert np.abs(constant - self.end(four_bar)).max() > 0.1

    def test_callable_input_gets_the_state_of_each_evaluation(self, four_bar):
        seen = []
        run = four_bar.simulate((0.0, 0.1), inputs={"F": lambda t, x: seen.append(np.array(x)) or -20 * x[3]})
        assert run.success
        assert len(seen) >= run.nfev
        assert all(x.shape == (6,) for x in seen)
        np.testing.assert_array_equal(seen[0], run.y[:, 0])

    def test_callable_input_of_the_state_with_radau_gives_the_explicit_motion(self, four_bar):
        def feedback(t, x):
            return -200 * x[3]

        implicit = self.end(four_bar, inputs={"F": feedback}, method="Radau")
        np.testing.assert_allclose(implicit, self.end(four_bar, inputs={"F": feedback}), rtol=0, atol=1e-6)

    def test_callable_input_that_raises_ends_simulate_with_its_error(self, four_bar):
        def broken(t, x):
            raise ZeroDivisionError("mine")

        with pytest.raises(ZeroDivisionError, match="mine"):
            four_bar.simulate((0.0, 1.0), inputs={"F": broken})


def test_right_hand_side_called_again_returns_a_new_array(four_bar):
    ode, x0 = four_bar.ode(), four_bar.initial_state()
    first = ode(0.0, x0)
    kept = first.copy()
    second = ode(0.0, 2 * x0)
    assert second is not first
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(ode(0.0, x0), four_bar.rhs(0.0, x0))
    np.testing.assert_array_equal(ode.jac(0.0, x0), four_bar.jacobian(0.0, x0))


def test_state_in_any_memory_layout_gives_the_same_rates(four_bar):
    x0 = four_bar.initial_state()
    expected = four_bar.rhs(0.0, x0)
    strided = np.repeat(x0, 2)[::2]
    column = np.asfortranarray(np.column_stack((x0, x0)))[:, 1]
    backwards = x0[::-1].copy()[::-1]
    for x in (strided, column, backwards, x0.tolist(), tuple(x0), x0.astype(">f8"), np.ma.array(x0)):
        np.testing.assert_array_equal(four_bar.rhs(0.0, x), expected)
        np.testing.assert_array_equal(four_bar.ode()(0.0, x), expected)
    out = np.empty(6)
    assert four_bar.rhs(0.0, x0, out=out) is out
    np.testing.assert_array_equal(out, expected)


def test_parameters_by_name_symbol_and_order_give_the_same_rates(four_bar):
    import sympy as sm

    x0 = four_bar.initial_state()
    values = np.array(list(four_bar.defaults.values()))
    values[four_bar.parameters.index("l2")] = 0.45
    expected = four_bar.rhs(0.0, x0, values)
    np.testing.assert_array_equal(four_bar.rhs(0.0, x0, {"l2": 0.45}), expected)
    np.testing.assert_array_equal(four_bar.rhs(0.0, x0, {sm.Symbol("l2"): 0.45}), expected)
    np.testing.assert_array_equal(four_bar.ode({"l2": 0.45})(0.0, x0), expected)
    assert np.abs(four_bar.rhs(0.0, x0) - expected).max() > 0.1


def test_run_keeps_its_inputs_when_the_given_arrays_change(four_bar):
    times, values, number = np.array([0.0, 0.5, 1.0]), np.array([0.0, 10.0, -10.0]), np.array(4.0)
    table = [times, values]
    for source in (table, tuple(table), number):
        given = {"F": source}
        kept = four_bar.simulate((0.0, 1.0), inputs={"F": copy.deepcopy(source)}, dense_output=True)
        run = four_bar.simulate((0.0, 1.0), inputs=given, dense_output=True)
        table[:], values[:], number[...] = [[0.0, 1.0], [7.0, 7.0]], 99.0, 99.0
        del given["F"]
        again, expected = run.resample([0.25, 0.75]), kept.resample([0.25, 0.75])
        np.testing.assert_array_equal(again.r, expected.r)
        np.testing.assert_array_equal(again.multipliers, expected.multipliers)
        np.testing.assert_array_equal(expected.r, [[4.0, 4.0] if source is number else [5.0, 0.0]])
        table[:], values[:], number[...] = [times, values], [0.0, 10.0, -10.0], 4.0


def test_callable_input_of_a_run_is_kept_as_the_same_object(four_bar):
    class Force:
        gain = 1.0

        def __call__(self, t, x):
            return self.gain

    force = Force()
    assert four_bar.simulate((0.0, 0.1), inputs={"F": force}).inputs["F"] is force


def test_inputs_by_order_name_or_default_give_the_same_rates(four_bar):
    x0 = four_bar.initial_state()
    np.testing.assert_array_equal(four_bar.rhs(0.5, x0, r=[100.0]), four_bar.rhs(0.5, x0))
    np.testing.assert_array_equal(four_bar.rhs(0.5, x0, r={"F": 100.0}), four_bar.rhs(0.5, x0))
    np.testing.assert_array_equal(four_bar.rhs(0.5, x0, r={}), four_bar.rhs(0.5, x0))


def test_initial_state_with_a_guess_finds_the_nearest_assembly_mode(four_bar):
    down = four_bar.initial_state({"q1": -0.5}, guess={"q2": -1.5, "q3": -1.5})
    up = four_bar.initial_state({"q1": -0.5}, guess={"q2": 1.5, "q3": 1.5})
    assert down[1] < 0 < up[1]
    for x in (down, up):
        np.testing.assert_allclose(four_bar.position_constraints(0.0, x[:3]), 0.0, atol=1e-14)
        np.testing.assert_allclose(four_bar.velocity_constraints(0.0, x), 0.0, atol=1e-14)


@pytest.mark.slow
def test_run_saved_as_csv_npz_and_png_holds_the_trajectory(four_bar, tmp_path):
    run = four_bar.simulate((0.0, 1.0), t_eval=np.linspace(0, 1, 5))
    with run.save(tmp_path / "new folder" / "run.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header[:7] == ["t", "q1", "q2", "q3", "u1", "u2", "u3"]
    np.testing.assert_array_equal(np.array(rows, dtype=float).T[1:7], run.y)
    arrays = arrays_of(run.save(tmp_path / "run.npz"))
    np.testing.assert_array_equal(arrays["q3"], run["q3"])
    np.testing.assert_array_equal(arrays["kinetic_energy"], run.kinetic_energy)
    picture = run.save(tmp_path / "run.png").read_bytes()
    assert picture.startswith(b"\x89PNG")


def test_right_hand_side_at_a_singular_position_raises_an_error_that_says_so():
    # Both bars of a parallelogram in line: J loses rank, and the motion cannot go on along the constraint.
    four_bar = fb.load("four_bar")
    parameters = {"l1": 1.0, "l2": 1.0, "l3": 1.0, "l4": 1.0, "k": 0.0, "c": 0.0, "g": 0.0}
    with pytest.raises(fb.SimulationError, match="singular position"):
        four_bar.rhs(0.0, [np.pi, np.pi, np.pi, 1.0, 0.5, 0.25], parameters, [0.0])


@pytest.mark.parametrize("method", METHODS)
def test_run_with_an_input_that_becomes_nan_stops_with_a_message_by_every_method(four_bar, method):
    run = four_bar.simulate((0.0, 1.0), method=method, inputs={"F": lambda t, x: 10.0 if t < 0.5 else np.nan})
    assert not run.success
    assert run.status == -1
    assert run.message.startswith("The integration stopped at t = 0.")
    assert "not finite" in run.message
    assert 0.3 < run.t[-1] <= 0.5
    assert np.isfinite(run.y).all()


def test_pickled_model_and_trajectory_give_the_same_values(four_bar):
    run = four_bar.simulate((0.0, 0.5))
    again = pickle.loads(pickle.dumps(run))
    np.testing.assert_array_equal(again.y, run.y)
    np.testing.assert_array_equal(again.energy, run.energy)
    np.testing.assert_array_equal(again.model.rhs(0.0, run.y[:, 0]), four_bar.rhs(0.0, run.y[:, 0]))


@pytest.mark.parametrize("method", [*METHODS, "ALI3P", "CVODE", "IDA"])
def test_pickled_dense_output_of_every_method_gives_the_same_states(four_bar, method):
    inputs = {"F": ([0.0, 1.0, 2.0], [0.0, 50.0, -50.0])}
    run = four_bar.simulate((0.0, 0.5), method=method, inputs=inputs, dense_output=True, max_step=0.05)
    again = pickle.loads(pickle.dumps(run))
    times = np.linspace(0.0, 0.5, 23)
    np.testing.assert_array_equal(again.sol(times), run.sol(times))
    assert len(again.resample(times).t) == 23


def test_pickled_right_hand_side_and_stepper_go_on_with_the_same_values(four_bar):
    inputs = {"F": ([0.0, 1.0, 2.0], [0.0, 50.0, -50.0])}
    ode, stepper = four_bar.ode({"l2": 0.45}, inputs), four_bar.stepper(0.01, t=0.3, inputs=inputs)
    for _ in range(7):
        stepper.step()
    again, second = pickle.loads(pickle.dumps((ode, stepper)))
    for _ in range(5):
        np.testing.assert_array_equal(second.step(), stepper.step())
        np.testing.assert_array_equal(again(second.t, second.x), ode(stepper.t, stepper.x))
    # What cannot travel is named.
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(four_bar.ode(inputs={"F": lambda t, x: 0.0}))


def test_threads_that_evaluate_one_model_get_their_own_results(four_bar):
    # Mappings and callables run Python in the middle of a call, where another thread may come in.
    x0 = four_bar.initial_state()
    lengths = np.linspace(0.4, 0.5, 8)
    expected = [four_bar.rhs(0.0, x0, {"l2": length}, {"F": 10 * length}) for length in lengths]

    def work(i):
        for _ in range(500):
            rates = four_bar.rhs(0.0, x0.tolist(), {"l2": lengths[i]}, {"F": 10 * lengths[i]})
            np.testing.assert_array_equal(rates, expected[i])

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(8)))


@pytest.mark.slow
def test_threads_that_integrate_one_right_hand_side_get_the_results_of_single_runs():
    # Of many loops: a step takes so long without Python that another thread's begins meanwhile.
    row = fb.compile_model(fb.models.n_four_bar(20))
    ode = row.ode()

    def run(method, angle):
        x0 = np.zeros(row.n_x)
        x0[:21], x0[row.n_q : row.n_q + 21] = angle, 1.0
        solver = getattr(fb.solvers, method)
        return solve_ivp(ode, (0.0, 0.05), x0, method=solver, rtol=1e-8, atol=1e-8, max_step=2e-4).y

    tasks = [(method, angle) for angle in (0.1, 0.2, 0.3, 0.4) for method in ("RK23", "RK45", "DOP853", "CVODE")]
    expected = [run(*task) for task in tasks]
    with ThreadPoolExecutor(4) as pool:
        for found, alone in zip(pool.map(lambda task: run(*task), tasks), expected, strict=True):
            np.testing.assert_array_equal(found, alone)


def test_callable_input_that_evaluates_its_own_model_gives_scipys_motion(four_bar):
    def energy(t, x):
        # Other values, another layout and other parameters than those of the evaluation that asks.
        strided = np.repeat(0.5 * np.array(x), 2)[::2]
        return np.tanh(four_bar.rhs(t, strided, {"l2": 0.45}, {"F": 1.0})[3])

    run = four_bar.simulate((0.0, 0.5), inputs={"F": energy}, t_eval=[0.0, 0.5], constraints="none")
    table_free = solve_ivp(
        lambda t, x: four_bar.rhs(t, x, r=[energy(t, x)]), (0.0, 0.5), run.y[:, 0], "DOP853", rtol=1e-6, atol=1e-9
    )
    # The sums of SciPy's steps are rounded in another order.
    np.testing.assert_allclose(run.y[:, -1], table_free.y[:, -1], rtol=1e-12)


@pytest.mark.parametrize("method", ["RK23", "RK45", "DOP853"])
def test_run_to_infinite_time_ends_where_its_steps_overflow(four_bar, method):
    # In free fall, without gravity, every step is exact and the next one ten times as long.
    block = fb.compile_model(coordinate_free())
    run = solve_ivp(block.ode({"b": 0.0}), (0.0, np.inf), [1.0], method=getattr(fb.solvers, method))
    assert not run.success
    assert "not finite" in run.message
    solver = getattr(fb.solvers, method)(four_bar.ode(), 0.0, four_bar.initial_state(), 1.0)
    solver.step()
    with pytest.raises(fb.ModelError, match="contiguous array of"):
        solver._stepper.step(0.0, 0.1, four_bar.initial_state(), np.zeros((1, 1)))


def test_solver_whose_bound_and_tolerance_change_takes_scipys_steps(four_bar):
    x0 = four_bar.initial_state()
    ends = []
    for solvers in (fb.solvers, scipy.integrate):
        solver = solvers.RK45(four_bar.ode(), 0.0, x0, 1.0)
        solver.step()
        solver.t_bound, solver.max_step, solver.rtol = 2.0, 0.05, 1e-8
        steps = 0
        while solver.status == "running":
            solver.step()
            steps += 1
        ends.append((solver.t, steps, solver.nfev))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("method", ["Radau", "RK45"])
def test_callable_input_that_raises_after_nan_raises_its_own_error(four_bar, method):
    count = 0

    def force(t, x):
        nonlocal count
        if t < 0.3:
            return 0.0
        count += 1
        if count == 1:
            return float("nan")
        raise ValueError("an error of the controller's own")

    with pytest.raises(ValueError, match="the controller's own"):
        four_bar.simulate((0.0, 1.0), method=method, inputs={"F": force})


def test_callable_input_that_writes_into_its_state_leaves_the_run_unchanged(four_bar):
    def force(t, x):
        x[:] = 0.0
        return 10.0

    expected = four_bar.simulate((0.0, 1.0), inputs={"F": 10.0})
    np.testing.assert_array_equal(four_bar.simulate((0.0, 1.0), inputs={"F": force}).y, expected.y)


def test_lsoda_with_band_options_runs_to_the_end(four_bar):
    x0 = four_bar.initial_state()
    run = solve_ivp(four_bar.ode(), (0.0, 1.0), x0, method=fb.solvers.LSODA, lband=5, uband=5)
    assert run.success


def test_run_that_ends_before_its_first_sample_has_empty_results(four_bar):
    run = four_bar.simulate((0.0, 1.0), t_eval=[0.5], max_steps=1)
    assert run.status == -1
    assert run.t.shape == (0,)
    assert run.y.shape == (6, 0)
    assert run.energy.shape == (0,)
    assert run["q1"].shape == (0,)


def test_velocities_and_accelerations_of_points_in_a_run_are_those_of_a_turning_crank():
    """The pin at radius r moves with r w, and is accelerated by r w' along and r w^2 inwards."""
    slider_crank = fb.compile_model(fb.models.slider_crank())
    run = slider_crank.simulate((0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 11))
    radius, angle, rate = slider_crank.defaults["r"], run["crank"], run["crank_rate"]
    turn = np.array([slider_crank.rhs(t, x)[3] for t, x in zip(run.t, run.y.T, strict=True)])
    along, outwards = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(run.velocities["P"][:2], radius * rate * along, rtol=1e-13, atol=1e-13)
    expected = radius * (turn * along - rate**2 * outwards)
    # Twice evaluated accelerations differ by rounding errors, times the condition of the equations.
    np.testing.assert_allclose(run.accelerations["P"][:2], expected, rtol=1e-11, atol=1e-11)
    assert list(run.velocities) == list(run.accelerations) == list(slider_crank.points)


@pytest.mark.parametrize("method", ["DOP853", "Radau", "ALI3P"])
def test_runner_gives_the_runs_of_simulate_to_the_bit(four_bar, method):
    how = {"method": fb.ALI3P(step=1e-2) if method == "ALI3P" else method, "t_eval": [0.0, 0.5, 1.0], "events": "u1"}
    run = four_bar.runner((0.0, 1.0), **how)
    for k in (50.0, 100.0):
        x0 = four_bar.initial_state({"q1": -0.6}, parameters={"k": k})
        found = run(x0, parameters={"k": k}, inputs={"F": 1.0})
        expected = four_bar.simulate((0.0, 1.0), x0, parameters={"k": k}, inputs={"F": 1.0}, **how)
        np.testing.assert_array_equal(found.y, expected.y)
        np.testing.assert_array_equal(found.t_events[0], expected.t_events[0])
        assert found.settings == expected.settings
    np.testing.assert_array_equal(run().y, four_bar.simulate((0.0, 1.0), **how).y)


def test_runner_refuses_wrong_options_when_it_is_made_and_wrong_starts_when_called(four_bar):
    with pytest.raises(fb.ModelError, match="rtol must be"):
        four_bar.runner((0.0, 1.0), rtol=-1.0)
    run = four_bar.runner((0.0, 1.0), sensitivities=["k"])
    assert run(parameters={"k": 3.0}).sensitivity["k"].shape[0] == 6
    with pytest.raises(fb.ModelError, match="'kk'"):
        run(parameters={"kk": 3.0})


def test_trajectory_of_the_closed_forms_states_has_its_energy_and_forces():
    """A pendulum that falls from rest at the horizontal has u^2 = 2 g sin(a) and a tension of 3 m g sin(a)."""
    pendulum = fb.compile_model(fb.models.cartesian_pendulum())
    angle = np.linspace(0.0, np.pi / 2, 20)
    sine, cosine = np.sin(angle), np.cos(angle)
    speed = np.sqrt(2.0 * 9.81 * sine)
    states = {"x": cosine, "y": -sine, "v_x": -speed * sine, "v_y": -speed * cosine}
    run = pendulum.trajectory(0.1 * angle, states)
    np.testing.assert_allclose(run.energy, 0.0, atol=1e-14)
    np.testing.assert_allclose(run.constraint_residual, 0.0, atol=1e-15)
    # lambda of x^2 + y^2 - 1 = 0: half of the tension, towards the support.
    np.testing.assert_allclose(run.multipliers[0], -1.5 * 9.81 * sine, atol=1e-13)


def test_trajectory_of_a_control_loop_is_that_of_the_run_with_what_was_held(four_bar, tmp_path):
    """A stepper with forces that a controller holds, and a run with these forces as a table, are the same motion."""
    stepper = four_bar.stepper(1e-3)
    times, states, forces = [0.0], [stepper.x.copy()], []
    for _ in range(500):
        forces.append(-20.0 * stepper.x[3])
        states.append(stepper.step({"F": forces[-1]}))
        times.append(stepper.t)
    held = {"F": (np.array(times), np.array([*forces, forces[-1]]), "hold")}
    run = four_bar.trajectory(times, np.transpose(states), inputs=held)
    exact = four_bar.simulate((0.0, times[-1]), inputs=held, t_eval=times, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(run.y, exact.y, atol=1e-9)  # RK4 with 500 steps: (1e-3)^4 times a derivative of some 1e3
    np.testing.assert_allclose(run["energy"], exact["energy"], rtol=1e-8)
    np.testing.assert_array_equal(run["F"], exact["F"])
    back = fb.load_trajectory(run.save(tmp_path / "loop.npz"))
    np.testing.assert_array_equal(back.y, run.y)
    assert run.save(tmp_path / "loop.html").stat().st_size > 10_000
    np.testing.assert_allclose(run.resample([0.2505]).y, exact.resample([0.2505]).y, atol=1e-9)


@pytest.mark.parametrize(
    ("t", "x", "words"),
    [
        ([0.0, 1.0], np.zeros((6, 3)), "shape"),
        ([0.0, 1.0, 0.5], np.zeros((6, 3)), "one direction"),
        ([0.0, np.nan], np.zeros((6, 2)), r"t\[1\] is not"),
        ([0.0, 1.0], np.full((6, 2), np.inf), r"q1 at t\[0\] is not"),
        ([], np.zeros((6, 0)), "n_t > 0"),
        ([0.0, 1.0], {"q1": [0.0, 1.0]}, "No value for state q2"),
    ],
)
def test_trajectory_of_wrong_times_or_states_is_refused(four_bar, t, x, words):
    with pytest.raises(fb.ModelError, match=words):
        four_bar.trajectory(t, x)


def test_given_states_that_the_model_does_not_follow_are_interpolated_between_themselves(four_bar):
    """Held by hand, where the model would fall; a warning that advises more steps of a simulation would mislead."""
    held = np.tile(four_bar.initial_state(speeds={"u1": 0.0}), (11, 1)).T
    run = four_bar.trajectory(np.linspace(0.0, 1.0, 11), held)
    between = run.resample(np.linspace(0.0, 1.0, 101))
    np.testing.assert_allclose(between.y, held[:, :1] + np.zeros(101), rtol=0, atol=1e-15)
    assert (between["kinetic_energy"] == 0.0).all()


def test_derivatives_of_a_start_without_derivatives_of_the_run_are_refused(four_bar):
    x0 = four_bar.initial_state()
    with pytest.raises(fb.ModelError, match="dx0 counts for derivatives of a run"):
        four_bar.simulate((0.0, 1.0), x0, dx0={"k": np.ones(6)})
