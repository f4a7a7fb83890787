"""Batches of states and ensembles of runs: the same as one by one, whatever stands beside them."""

import multiprocessing
import subprocess
import sys
import time

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.forms import of_form
from builders.systems import parallelogram, pendulum, spatial_four_bar
from harness.terminal import on_terminal
from scipy.integrate import solve_ivp
from tutorial import tutorial_four_bar

import fourbar_codegen as fb
from fourbar_codegen.building.cached_models import restored
from fourbar_codegen.building.loading import load_file
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.batch import width
from fourbar_codegen.runtime.evaluator import versions

GENERATOR = np.random.default_rng(20)


def functions_of_the_state():
    """A particle on a spring under forces for which C has scalar functions alone."""
    q, u = me.dynamicsymbols("q u")
    m, k, T = sm.symbols("m k T")
    frame = me.ReferenceFrame("N")
    origin, point = me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, q * frame.x)
    point.set_vel(frame, u * frame.x)
    force = sm.Piecewise((-k * q, q < 0.1), (-k * sm.sqrt(1 + q**2) * sm.tanh(q), True)) + me.dynamicsymbols("F")
    system = me.System(frame, origin)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_bodies(me.Particle("B", point, m))
    system.add_loads(me.Force(point, force * frame.x))
    inputs = {me.dynamicsymbols("F"): sm.Piecewise((sm.exp(-T), T < 1), (0, True)).subs(T, me.dynamicsymbols._t)}
    return fb.Model(system, name="functions", parameters={m: 2.0, k: 3.0}, inputs=inputs)


MODELS = {
    "four_bar": (fb.models.four_bar, True),
    "slider_crank": (fb.models.slider_crank, True),
    "rolling disc": (fb.models.rolling_disc, True),
    "no constraints": (
        lambda: fb.Model(pendulum(), name="pendulum", parameters=dict.fromkeys(sm.symbols("m l g"), 1.3)),
        True,
    ),
    "closed chain": (lambda: fb.models.chain(4, closed=True), True),
    "bicycle": (fb.models.whipple_bicycle, True),
    "functions": (functions_of_the_state, True),
    "sparse": (lambda: of_form("sparse"), True),
    "eight constraints": (lambda: fb.models.n_four_bar(4), True),
    "recursive": (lambda: of_form("recursive"), True),
    "redundant": (spatial_four_bar, True),
}


@pytest.fixture(scope="module", params=MODELS)
def compiled(request):
    model, side_by_side = MODELS[request.param]
    compiled = fb.compile_model(model())
    compiled.require_batch_functions()
    assert (width(compiled.kernel) > 1) == side_by_side
    return compiled


def random_states(model, n):
    return GENERATOR.uniform(-1.0, 1.0, (model.n_x, n))


@pytest.mark.slow(but=["slider_crank"])
def test_batch_of_random_states_equals_the_right_hand_side_of_each(compiled):
    """To rounding errors, which grow with the condition of the equations at a state: the median shows the former."""
    x = random_states(compiled, 203)
    t = GENERATOR.uniform(0.0, 2.0, 203)
    rates = compiled.rhs_batch(t, x)
    errors = []
    for i in range(203):
        expected = compiled.rhs(t[i], x[:, i])
        errors.append(np.abs(rates[:, i] - expected).max() / np.abs(expected).max())
    assert np.median(errors) < 1e-14
    assert max(errors) < 1e-9


@pytest.mark.slow
def test_batch_and_ensemble_with_redundant_constraints_equal_single_states_and_runs():
    compiled = fb.compile_model(parallelogram())
    compiled.require_batch_functions()
    assert width(compiled.kernel) > 1
    (angle,), (speed,) = compiled.coordinates[:1], compiled.speeds[:1]
    x = np.array([compiled.initial_state({angle: q}, {speed: 1.0}) for q in np.linspace(0.3, 1.4, 19)]).T
    opened = x.copy()
    opened[1] += 0.1  # where the constraints are independent, which is told from the violation
    both = np.hstack((x, opened))
    rates = compiled.rhs_batch(0.0, both)
    for found, state in zip(rates.T, both.T, strict=True):
        expected = compiled.rhs(0.0, state)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    how = {"t_eval": [0.1, 0.2], "rtol": 1e-9, "atol": 1e-9}
    together = compiled.ensemble((0.0, 0.2), x.T, **how)
    for member, state in zip(together.y, x.T, strict=True):
        run = compiled.simulate((0.0, 0.2), state, **how)
        np.testing.assert_allclose(member, run.y, rtol=0, atol=1e-9)


@pytest.mark.slow(but=["slider_crank"])
def test_batch_is_the_same_to_the_bit_in_any_company(compiled):
    x = random_states(compiled, 1500)
    names = compiled.parameters
    values = np.array([compiled.defaults[name] for name in names])
    p = values[:, np.newaxis] * GENERATOR.uniform(0.9, 1.1, (len(names), 1500))
    rates = compiled.rhs_batch(0.3, x, p)
    order = GENERATOR.permutation(1500)
    for workers in (1, 2, None):
        np.testing.assert_array_equal(
            compiled.rhs_batch(0.3, x[:, order], p[:, order], workers=workers), rates[:, order]
        )
    for i in (0, 700, 1499):
        np.testing.assert_array_equal(compiled.rhs_batch(0.3, x[:, i : i + 1], p[:, i])[:, 0], rates[:, i])
    out = np.empty_like(x)
    assert compiled.rhs_batch(0.3, x, p, out=out) is out
    np.testing.assert_array_equal(out, rates)
    by_name = compiled.rhs_batch(0.3, x, dict(zip(names, p, strict=True)))
    np.testing.assert_array_equal(by_name, rates)


def test_batch_with_states_or_times_not_finite_is_nan_there_and_unchanged_elsewhere(four_bar):
    x = np.tile(four_bar.initial_state(), (11, 1)).T
    x[0, 3] = np.nan
    x[1, 5] = np.inf
    rates = four_bar.rhs_batch(0.0, x)
    assert np.isnan(rates[:, [3, 5]]).all()
    others = [0, 1, 2, 4, 6, 7, 8, 9, 10]
    np.testing.assert_array_equal(rates[:, others], np.tile(four_bar.rhs_batch(0.0, x[:, :1]), 9))
    rates = four_bar.rhs_batch([0.0, np.nan, np.inf, 0.0], x[:, [0, 0, 0, 0]], r=[1.0])
    assert np.isnan(rates).all(axis=0).tolist() == [False, True, True, False]
    assert four_bar.rhs_batch(0.0, x[:, :0]).shape == (6, 0)


def test_batch_with_a_large_angle_in_one_state_leaves_the_others_unchanged(four_bar):
    x = random_states(four_bar, 8)
    alone = four_bar.rhs_batch(0.0, x)
    x[0, 3] = 3e6
    rates = four_bar.rhs_batch(0.0, x)
    assert rates[:, 3] == pytest.approx(four_bar.rhs(0.0, x[:, 3]), rel=1e-9)
    others = [0, 1, 2, 4, 5, 6, 7]
    np.testing.assert_array_equal(rates[:, others], alone[:, others])


def test_batch_with_inputs_by_state_equals_single_evaluations(four_bar):
    x = random_states(four_bar, 9)
    F = np.linspace(-10.0, 10.0, 9)
    rates = four_bar.rhs_batch(0.0, x, r={"F": F})
    for i in range(9):
        assert rates[:, i] == pytest.approx(four_bar.rhs(0.0, x[:, i], r=[F[i]]), rel=1e-9)
    np.testing.assert_array_equal(
        four_bar.rhs_batch(0.0, x, r=[3.0])[:, 4], four_bar.rhs_batch(0.0, x, r=np.full((1, 9), 3.0))[:, 4]
    )


def unaligned(array):
    memory = np.zeros(array.nbytes + 1, dtype=np.uint8)[1:].view(float).reshape(array.shape)
    memory[...] = array
    return memory


def every_other(array):
    return np.repeat(array, 2, axis=-1)[..., ::2]


@pytest.mark.parametrize("layout", [lambda a: a.astype(">f8"), unaligned, every_other, np.asfortranarray])
def test_arguments_of_any_memory_layout_give_the_same_rates_to_the_bit(four_bar, layout):
    x = random_states(four_bar, 9)
    p = np.outer(list(four_bar.defaults.values()), np.linspace(0.9, 1.1, 9))
    arguments = {"t": np.linspace(0.0, 1.0, 9), "x": x, "p": p, "r": np.linspace(-5.0, 5.0, 9)[None]}
    rates = four_bar.rhs_batch(**{name: array.tolist() for name, array in arguments.items()})
    for name, array in arguments.items():
        np.testing.assert_array_equal(four_bar.rhs_batch(**{**arguments, name: layout(array)}), rates)
    alone = {name: arguments[name][:, 3] for name in "xpr"}
    rates = four_bar.rhs(0.0, **{name: array.tolist() for name, array in alone.items()})
    for name, array in alone.items():
        np.testing.assert_array_equal(four_bar.rhs(0.0, **{**alone, name: layout(array)}), rates)


@pytest.mark.parametrize("name", ["t", "x", "p", "r"])
def test_out_that_shares_memory_with_an_argument_is_refused(four_bar, name):
    x = random_states(four_bar, 9)
    p = np.tile(list(four_bar.defaults.values()), (9, 1)).T
    arguments = {"t": np.zeros(9), "x": x, "p": p, "r": np.ones((1, 9))}
    given = arguments[name]
    memory = np.empty(given.size + x.size)
    memory[: given.size] = given.ravel()
    # The last number of the argument is the first of the results; behind it they do not meet.
    before, after = (memory[given.size - shift :][: x.size].reshape(x.shape) for shift in (1, 0))
    arguments[name] = memory[: given.size].reshape(given.shape)
    expected = four_bar.rhs_batch(**arguments)
    with pytest.raises(fb.ModelError, match=f"share memory .*{name}"):
        four_bar.rhs_batch(**arguments, out=before)
    np.testing.assert_array_equal(four_bar.rhs_batch(**arguments, out=after), expected)
    if name != "t":
        alone = {"t": 0.0, "x": x[:, 0].copy(), "p": p[:, 0].copy(), "r": np.ones(1)}
        memory = np.concatenate((alone[name], np.empty(6)))
        n = len(alone[name])
        with pytest.raises(fb.ModelError, match=f"share memory .*{name}"):
            four_bar.rhs(**{**alone, name: memory[:n]}, out=memory[n - 1 : n + 5])
        rates = four_bar.rhs(**{**alone, name: memory[:n]}, out=memory[n:])
        np.testing.assert_array_equal(rates, four_bar.rhs(**alone))


def test_kernels_of_all_instruction_sets_give_the_same_rates(four_bar):
    """Vectors of 2, 4 and 8 doubles: rounding errors, times the condition of the equations at states of the motion."""
    x = np.tile(four_bar.initial_state(), (50, 1)).T + 0.1 * random_states(four_bar, 50)
    reference = np.array([four_bar.rhs(0.3, column) for column in x.T]).T
    for kernel in versions(load_file(four_bar.path).capsule):
        model = CompiledModel(Kernel(kernel, four_bar.layout))
        np.testing.assert_allclose(model.rhs_batch(0.3, x), reference, rtol=1e-11, atol=1e-11)


@pytest.mark.slow(but=["bicycle-none-DOP853", "bicycle-none-RK45", "bicycle-project-RK45"])
@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5"])
@pytest.mark.parametrize("constraints", ["project", "none"])
def test_members_of_an_ensemble_equal_runs_with_the_same_steps(compiled, method, constraints):
    start, name = {"q3": 0.4}, compiled.parameters[0]
    start = {
        key: start.get(key, 0.1)
        for key in compiled.coordinates[: compiled.n_q - compiled.manifest["n_dependent_coordinates"]]
    }
    speeds = dict.fromkeys(compiled.speeds[: compiled.n_u - compiled.manifest["n_dependent_speeds"]], 0.2)
    values = compiled.defaults[name] * np.linspace(0.9, 1.1, 11)
    x0 = np.array([compiled.initial_state(start, speeds, parameters={name: value}) for value in values])
    t = np.linspace(0.0, 0.7, 8)
    how = {"method": method, "t_eval": t, "rtol": 1e-8, "atol": 1e-8, "constraints": constraints}
    ensemble = compiled.ensemble((0.0, 0.7), x0, parameters={name: values}, **how)
    assert ensemble.success.all()
    for i in (0, 4, 10):
        run = compiled.simulate((0.0, 0.7), x0[i], parameters={name: values[i]}, **how)
        # The same steps, whose rounding errors differ.
        assert ensemble.nfev[i] == run.nfev
        np.testing.assert_allclose(ensemble.y[i], run.y, rtol=1e-10, atol=1e-10)
        assert ensemble.messages[i] == run.message


@pytest.mark.parametrize("method", ["DOP853", "RK45", "Tsit5"])
def test_a_member_is_the_same_to_the_bit_in_any_company(four_bar, method):
    n = 203
    x0 = four_bar.initial_state()
    values = {"k": GENERATOR.uniform(1.0, 5.0, n), "c": GENERATOR.uniform(0.0, 0.5, n)}
    how = {"method": method, "t_eval": np.linspace(0.0, 4.0, 17), "rtol": 1e-9}
    reference = four_bar.ensemble((0.0, 4.0), x0, parameters=values, workers=1, **how)
    assert reference.success.all()
    order = GENERATOR.permutation(n)
    for workers in (1, 2, 3):
        shuffled = {name: array[order] for name, array in values.items()}
        ensemble = four_bar.ensemble((0.0, 4.0), x0, parameters=shuffled, workers=workers, **how)
        np.testing.assert_array_equal(ensemble.y, reference.y[order])
        np.testing.assert_array_equal(ensemble.nfev, reference.nfev[order])
    for i in (0, 100, 202):
        alone = four_bar.ensemble((0.0, 4.0), x0, parameters={name: a[i] for name, a in values.items()}, **how)
        np.testing.assert_array_equal(alone.y[0], reference.y[i])


@pytest.mark.slow
def test_members_with_different_stiffness_equal_lambdify_with_scipy(four_bar):
    """The tutorial's code at 1e-12, whose own loop drifts open by 1e-9 m in 4 s, for each stiffness."""
    tutorial = tutorial_four_bar()
    x0, stiffness = four_bar.initial_state(), [80.0, 100.0, 120.0]
    place = [symbol.name for symbol in tutorial.p].index("k")
    ensemble = four_bar.ensemble((0.0, 4.0), x0, parameters={"k": stiffness}, rtol=1e-12, atol=1e-12)
    states = np.repeat(x0[:, np.newaxis], 3, axis=1)
    rates = four_bar.rhs_batch(0.3, states, {"k": stiffness})
    for i, k in enumerate(stiffness):
        tutorial.p_values = (*tutorial.p_values[:place], k, *tutorial.p_values[place + 1 :])
        np.testing.assert_allclose(rates[:, i], tutorial.rhs(0.3, x0), rtol=1e-11)
        run = solve_ivp(tutorial.rhs, (0.0, 4.0), x0, method="DOP853", rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(ensemble.y[i, :, -1], run.y[:, -1], atol=1e-8)


def test_members_of_an_ensemble_keep_their_loops_closed(four_bar):
    t = np.linspace(0.0, 4.0, 101)
    ensemble = four_bar.ensemble((0.0, 4.0), parameters={"k": np.linspace(1.0, 5.0, 20)}, t_eval=t)
    for run in ensemble:
        assert np.abs(run.constraint_residual).max() < 1e-12
        assert np.abs(run.velocity_residual).max() < 1e-11


def test_ensemble_run_backwards_from_its_end_returns_to_its_start(four_bar):
    """Back at the beginning, to what the tolerance allows over 4 s."""
    x0 = np.tile(four_bar.initial_state(), (5, 1))
    k = {"k": np.linspace(1.0, 5.0, 5)}
    there = four_bar.ensemble((0.0, 2.0), x0, parameters=k, rtol=1e-11, atol=1e-11)
    back = four_bar.ensemble((2.0, 0.0), there.y[:, :, -1], parameters=k, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(back.y[:, :, -1], x0, atol=1e-8)


def test_failures_are_marked_and_others_go_on():
    """The tutorial's own linkage without its spring folds flat within 20 s; one state does not close its loop."""
    model = fb.compile_model(fb.models.four_bar())
    x0 = np.tile(model.initial_state(), (20, 1))
    t = [0.0, 4.0, 20.0]
    k = np.linspace(1.0, 5.0, 20)
    x0[3, 0] += 0.5
    ensemble = model.ensemble((0.0, 20.0), x0, parameters={"k": k}, t_eval=t)
    assert "violates the constraints" in ensemble.messages[3]
    assert np.isnan(ensemble.y[3]).all()
    singular = 0
    for i in (*range(3), *range(4, 20)):
        run = model.simulate((0.0, 20.0), x0[i], parameters={"k": k[i]}, t_eval=t)
        assert run.success == ensemble.success[i]
        assert np.isfinite(ensemble.y[i]).all(axis=0).tolist() == [time in run.t for time in t]
        assert len(ensemble[i].t) == len(run.t)
        assert ensemble.messages[i] == run.message
        singular += "singular position" in run.message
    assert singular
    assert not ensemble.success[3]


def test_inputs_of_all_kinds_give_each_member_the_motion_of_a_run(four_bar):
    x0 = four_bar.initial_state()
    F = np.linspace(-5.0, 5.0, 7)
    table = ([0.0, 0.5, 2.0], [0.0, 10.0, -10.0])
    for inputs, of in (
        ({"F": F}, lambda i: {"F": F[i]}),
        ({"F": table}, lambda i: {"F": table}),
        ({"F": 3.0}, lambda i: {"F": 3.0}),
        ({"F": lambda t, x: -5.0 * x[3]}, lambda i: {"F": lambda t, x: -5.0 * x[3]}),
    ):
        k = np.linspace(1.0, 5.0, 7)
        ensemble = four_bar.ensemble((0.0, 2.0), x0, parameters={"k": k}, inputs=inputs, rtol=1e-9)
        assert ensemble.success.all()
        for i in (0, 3, 6):
            run = four_bar.simulate((0.0, 2.0), x0, parameters={"k": k[i]}, inputs=of(i), rtol=1e-9)
            np.testing.assert_allclose(ensemble.y[i, :, -1], run.y[:, -1], rtol=1e-9, atol=1e-9)
            np.testing.assert_array_equal(
                ensemble[i].r[:, -1], of(i)["F"] if isinstance(of(i)["F"], float) else run.r[:, -1]
            )


def test_ensemble_of_rows_or_names_has_members_by_index_and_quantities_by_name(four_bar):
    rows = np.tile(list(four_bar.defaults.values()), (4, 1))
    assert len(four_bar.ensemble((0.0, 0.1), parameters=rows)) == 4
    assert len(four_bar.ensemble((0.0, 0.1))) == 1
    ensemble = four_bar.ensemble((0.0, 0.1), np.tile(four_bar.initial_state(), (3, 1)), t_eval=[0.05])
    assert ensemble.y.shape == (3, 6, 1)
    np.testing.assert_array_equal(ensemble["u1"], ensemble.y[:, 3])
    np.testing.assert_array_equal(ensemble[-1].y, ensemble.y[2])
    with pytest.raises(IndexError):
        ensemble[3]
    with pytest.raises(fb.ModelError, match="no quantity 'q9'; there are t, q1"):
        ensemble["q9"]


def test_members_with_different_lengths_start_from_their_own_closed_states(four_bar):
    lengths = np.linspace(0.55, 0.65, 5)
    ensemble = four_bar.ensemble((0.0, 0.1), parameters={"l1": lengths})
    for i in range(5):
        np.testing.assert_allclose(
            ensemble.y[i, :, 0], four_bar.initial_state(parameters={"l1": lengths[i]}), atol=1e-12
        )


def test_ensemble_without_members_has_empty_results(four_bar):
    from joblib import Parallel

    for more in ({}, {"parallel": Parallel(n_jobs=1)}, {"inputs": {"F": np.array([])}}):
        ensemble = four_bar.ensemble((0.0, 1.0), np.empty((0, 6)), **more)
        assert ensemble.y.shape == (0, 6, 2)
        assert len(list(ensemble)) == 0


def test_inputs_changed_after_an_ensemble_leave_its_results_unchanged(four_bar):
    F = np.array([1.0, 2.0])
    ensemble = four_bar.ensemble((0.0, 0.1), inputs={"F": F})
    F[:] = 99.0
    assert ensemble[1].r[0, 0] == 2.0
    table = (np.array([0.0, 0.1]), np.array([1.0, 2.0]))
    given = {"F": table}
    ensemble = four_bar.ensemble((0.0, 0.1), inputs=given)
    table[1][:] = 99.0
    given.clear()
    np.testing.assert_array_equal(ensemble[0].r, [[1.0, 2.0]])


def test_members_share_no_memory_with_arguments_or_each_other(four_bar):
    p, x0 = np.array([list(four_bar.defaults.values())]), four_bar.initial_state()[np.newaxis]
    ensemble = four_bar.ensemble((0.0, 0.1), x0, parameters=p)
    expected = p[0].copy()
    p[:] = 99.0
    np.testing.assert_array_equal(ensemble[0].parameters, expected)
    ensemble[0].parameters[:], ensemble[0].settings["constraints"] = 99.0, "none"
    np.testing.assert_array_equal(ensemble[0].parameters, expected)
    assert ensemble[0].settings["constraints"] == "project"


def test_callables_get_one_member_at_a_time(four_bar):
    inside = []

    def controller(t, x):
        inside.append(1)
        assert sum(inside) == 1
        time.sleep(1e-5)  # another thread may run now
        inside.clear()
        return 0.0

    assert four_bar.ensemble(
        (0.0, 0.1), parameters={"k": np.linspace(1.0, 2.0, 6)}, inputs={"F": controller}
    ).success.all()


@pytest.mark.slow
def test_ensemble_interrupted_from_the_keyboard_ends_with_other_threads_running(four_bar):
    """From the keyboard, in runs of weeks. Another thread of Python's goes on beside them, or there were none."""
    code = """
import _thread, signal, threading, time
import numpy as np
import fourbar_codegen as fb
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell has ignored in its background
four_bar = fb.load("four_bar")
four_bar.ensemble((0.0, 0.1))
ticks = []
def keyboard():
    for _ in range(100):
        ticks.append(time.sleep(0.01))
    _thread.interrupt_main()
threading.Thread(target=keyboard).start()
try:
    four_bar.ensemble((0.0, 1e9), parameters={"l1": 0.9, "k": np.linspace(0.0, 0.1, 50), "c": 0.0}, inputs={"F": INPUT})
except KeyboardInterrupt:
    print("interrupted after", len(ticks))
"""
    for source in ("0.0", "lambda t, x: 0.0"):
        command = [sys.executable, "-c", code.replace("INPUT", source)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
        assert done.stdout == "interrupted after 100\n"


@pytest.mark.slow
def test_a_member_that_cannot_be_assembled_is_named(four_bar):
    with pytest.raises(fb.AssemblyError, match="Member 1: The loops do not close"):
        four_bar.ensemble((0.0, 1.0), parameters={"l1": [0.8, 3.0]})


def test_members_whose_energy_explodes_end_at_max_steps_with_a_message(four_bar):
    # Without a limit, those with k = 50 take 35 million steps.
    given = {"k": [50.0, 60.0, 50.0, 60.0], "l2": [0.45, 0.45, 0.45, 0.45]}
    ensemble = four_bar.ensemble((0.0, 20.0), parameters=given, max_steps=1000)
    for member, found in enumerate(ensemble):
        parameters = {name: values[member] for name, values in given.items()}
        alone = four_bar.simulate((0.0, 20.0), parameters=parameters, max_steps=1000)
        assert found.message == alone.message
        assert not ensemble.success[member]
    assert "max_steps = 1000 " in ensemble.messages[0]
    assert "has grown" in ensemble.messages[0]
    with pytest.raises(fb.ModelError, match="max_steps"):
        four_bar.ensemble((0.0, 1.0), max_steps=0)


@pytest.mark.slow
def test_progress_bar_appears_on_a_terminal_only_in_long_runs_unless_switched_off():
    code = "import fourbar_codegen as fb\n{}fb.load('four_bar').ensemble((0.0, 1.0){})"
    impatient = (
        "import fourbar_codegen.simulation.ensemble_run\nfourbar_codegen.simulation.ensemble_run.QUIET_SECONDS = 0.0\n"
    )
    assert "four_bar: " in on_terminal("-c", code.format(impatient, ""))
    assert on_terminal("-c", code.format(impatient, ", progress=False")).strip() == ""
    assert on_terminal("-c", code.format("", "")).strip() == ""
    # Members that run alone have the bar in common, and nothing without it.
    alone = (
        "import fourbar_codegen as fb\nfrom fourbar_codegen.interface import progress\nprogress.QUIET_SECONDS = 0.0\n"
    )
    alone += "fb.load('four_bar').ensemble((0.0, 200.0), parameters={'l1': 0.9, 'k': 0.0, 'c': 0.0}, "
    alone += "inputs={'F': lambda t, x: 0.0}, progress=False)"
    assert on_terminal("-c", alone).strip() == ""


def test_ensemble_on_joblib_equals_the_one_on_threads(four_bar):
    from joblib import Parallel

    k = {"k": np.linspace(1.0, 5.0, 2100)}
    x0 = four_bar.initial_state()
    reference = four_bar.ensemble((0.0, 1.0), x0, parameters=k)
    for more in ({}, {"backend": "threading"}, {"return_as": "generator"}, {"return_as": "generator_unordered"}):
        ensemble = four_bar.ensemble((0.0, 1.0), x0, parameters=k, parallel=Parallel(n_jobs=2, **more))
        np.testing.assert_array_equal(ensemble.y, reference.y)
        assert ensemble.success.all()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of dask's own
def test_ensemble_on_dask_equals_the_one_on_threads(four_bar):
    from distributed import Client, LocalCluster
    from joblib import Parallel, parallel_config

    k = {"k": np.linspace(1.0, 5.0, 2100)}
    reference = four_bar.ensemble((0.0, 1.0), parameters=k)
    nodes = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with nodes, Client(nodes), parallel_config(backend="dask"):
        ensemble = four_bar.ensemble((0.0, 1.0), parameters=k, parallel=Parallel())
    np.testing.assert_array_equal(ensemble.y, reference.y)


def path_of_restored(arguments):
    return str(restored(*arguments).path)


@pytest.mark.slow
def test_workers_that_do_not_find_the_module_build_it_once_in_their_cache(tmp_path, monkeypatch):
    """Processes that do not find the module share one build in their node's cache."""
    model = fb.compile_model(fb.models.cartesian_pendulum())
    _, (_, layout, sources, *more) = model.kernel.__reduce__()
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        paths = pool.map(path_of_restored, [(str(tmp_path / "elsewhere.so"), layout, sources, *more)] * 3)
    assert len(set(paths)) == 1
    assert paths[0].startswith(str(tmp_path))
    folders = {path.name.rpartition("-")[0] for path in tmp_path.iterdir() if path.is_dir()}
    assert folders == {"cartesian_pendulum", "cartesian_pendulum_kernel"}
    x = random_states(model, 20)
    np.testing.assert_array_equal(fb.load(paths[0]).rhs_batch(0.0, x), model.rhs_batch(0.0, x))


@pytest.mark.slow
def test_model_restored_where_another_has_its_path_is_rebuilt_or_refused(tmp_path, monkeypatch, unoptimized):
    model = fb.load(fb.build_model(fb.models.cartesian_pendulum(), tmp_path / "here"))
    _, (_, layout, sources, *more) = model.kernel.__reduce__()
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "cache"))
    other = str(fb.load("four_bar").path)
    assert restored(other, layout, sources, *more).coordinates == model.coordinates
    with pytest.raises(fb.ModelError, match="only a different one of its name"):
        restored(other, layout, None, *more)


def test_the_shape_of_initial_states_is_named_as_it_is_given(four_bar):
    with pytest.raises(fb.ModelError, match=r"x0 must have shape \(6,\), or \(members, 6\), not \(6, 3\)"):
        four_bar.ensemble((0.0, 1.0), np.zeros((6, 3)))
