"""Models as C libraries: built strictly, equal to Python's numbers, and usable without it."""

import ctypes
import os
import re
import runpy
import subprocess
import sys

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.beads import bead_and_wheel, length, vx, vy, x, y
from builders.exported import MODELS
from builders.oscillators import on_a_line
from builders.state_equations import first_order, hires, motor
from builders.systems import (
    pendulum,
    slider,
)
from harness import PROJECT
from harness.c_library import FUNCTION, STRICT, Library
from harness.programs import emulator, require, zig_cc

import fourbar_codegen as fb
from fourbar_codegen.export.c_library import RESERVED, RESERVED_FAMILIES
from fourbar_codegen.runtime.enumerations import EXPLICIT, STEP_CONTROLLED, Status, Watched

STIFF_MODELS = {
    "HIRES": (lambda: first_order("hires", hires, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0057]), 321.8122),
    "four_bar": (fb.models.four_bar, 4.0),
    "stiff drive": (runpy.run_path(str(PROJECT / "examples" / "08_stiff_drive.py"))["driven_four_bar"], 4.0),
}
"""Models with the ends of their runs."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Models with their libraries, by name and compiler."""
    made = {}

    def get(name, compiler="gcc"):
        require(compiler)
        if (name, compiler) not in made:
            model = MODELS[name]()
            folder = tmp_path_factory.mktemp(f"{name}_{compiler}")
            made[name, compiler] = fb.compile_model(model), Library(model, folder, compiler)
        return made[name, compiler]

    return get


def state_of(compiled, inputs):
    """Consistent initial values; independent ones without a default are 0.3 rad and 0.2 rad/s."""
    q, u = compiled.coordinates, compiled.speeds
    q = q[: compiled.n_q - compiled.manifest["n_dependent_coordinates"]]
    u = u[: compiled.n_u - compiled.manifest["n_dependent_speeds"]]
    initial = compiled.manifest["initial"]
    return compiled.initial_state(
        {name: initial.get(name, 0.3) for name in q},
        {name: initial.get(name, 0.2) for name in u},
        inputs=inputs or None,
    )


def set_inputs(compiled, mechanism, value):
    """Values of the inputs without an expression, for Python."""
    entries = compiled.manifest["inputs"]
    for k, entry in enumerate(entries):
        assert mechanism.held[k] == (entry["expression"] is None)
        if entry["expression"] is None:
            mechanism.r[k] = value
    return {entry["name"]: value for entry in entries if entry["expression"] is None}


def random_states(compiled, library, generator):
    """Mechanisms at random times, parameters and inputs, held or by their expressions; and what to give Python.

    States are near the loops' closed ones: the equations hold off the constraints, too, except with redundant ones.
    """
    spread = 0.0 if compiled.name == "parallelogram" else 0.05
    for number in range(6):
        mechanism = library.new()
        p = np.array([*compiled.defaults.values()]) * (1 + spread * generator.uniform(-1, 1, compiled.n_p))
        mechanism.p[: compiled.n_p] = p
        assert library.call("update", mechanism) == 0
        r, is_held = {}, {}
        for k, entry in enumerate(compiled.manifest["inputs"]):
            motion = entry["of"] or entry["name"]  # it is held with its rates
            if is_held.setdefault(motion, entry["expression"] is None or bool(generator.integers(2))):
                mechanism.held[k], mechanism.r[k] = 1, generator.normal()
                r[entry["name"]] = mechanism.r[k]
        t = mechanism.t = generator.uniform(-2, 2)
        start = state_of(compiled, {e["name"]: 0.3 for e in compiled.manifest["inputs"] if e["expression"] is None})
        mechanism.x[:] = start + spread * number * generator.normal(size=compiled.n_x)
        yield mechanism, (t, np.array(mechanism.x), p, r or None)


BY_CLANG = ("four_bar", "sparse", "recursive", "driven_by_unknown_forces")
"""One of each form of the equations; that clang compiles the others without a warning is tested below."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "compiler"), [*((name, "gcc") for name in MODELS), *((name, "clang") for name in BY_CLANG)]
)
def test_c_library_of_every_model_gives_pythons_numbers(exported, name, compiler):
    """Both evaluate the same operations, compiled with other flags: they differ by rounding, times the condition."""
    compiled, library = exported(name, compiler)
    n, n_q, n_p, n_r, n_c = compiled.n_x, compiled.n_q, compiled.n_p, compiled.n_r, compiled.n_c
    for mechanism, at in random_states(compiled, library, np.random.default_rng(7)):
        t, x, p, r = at
        matrices = compiled.kernel.dynamics(*at)
        kkt = np.block([[matrices[1], -matrices[3].T], [matrices[3], np.zeros((n_c, n_c))]])
        sizes = np.linalg.svd(kkt, compute_uv=False)
        condition = sizes[0] / sizes[sizes > 1e-12 * sizes[0]][-1]

        def check(result, expected, condition=condition):
            np.testing.assert_allclose(
                result, expected, rtol=0, atol=1e-14 * condition * np.abs(expected).max(initial=1)
            )

        def matrix(function, columns, mechanism=mechanism):
            result = np.zeros((n, columns))
            assert library.call(function, mechanism, result) == 0
            return result

        rates = np.zeros(n)
        assert library.call("rhs", mechanism, t, x, rates) == 0
        check(rates, compiled.rhs(*at))
        check(matrix("jacobian", n), compiled.jacobian(*at))
        check(matrix("input_jacobian", n_r), compiled.input_jacobian(*at))
        wrt_parameters = matrix("parameter_jacobian", n_p)
        check(wrt_parameters, compiled.parameter_jacobian(*at))
        accelerations, multipliers = np.zeros(compiled.n_u), np.zeros(compiled.n_l)
        assert library.call("solution", mechanism, accelerations, multipliers) == 0
        check(accelerations, rates[n_q : n_q + compiled.n_u])
        check(multipliers, compiled.kernel.accelerations(*at)[1])
        kinetic, potential = ctypes.c_double(), ctypes.c_double()
        library.call("energies", mechanism, ctypes.byref(kinetic), ctypes.byref(potential))
        check([kinetic.value, potential.value], compiled.kernel.energy(*at))
        vectors = np.zeros(3), np.zeros(3), np.zeros(3)
        library.call("momenta", mechanism, *vectors)
        check(np.array(vectors), np.array(compiled.momentum(*at)))
        outputs = np.zeros(compiled.n_o)
        if compiled.n_o:
            assert library.call("outputs", mechanism, outputs) == 0
            check(outputs, compiled.output(*at))
        points = np.zeros((library.sizes["points"], 3))
        library.call("points", mechanism, points)
        check(points, compiled.kernel.drawing(*at)[0])
        inputs = [library.call("input", mechanism, k) for k in range(n_r)]
        check(inputs, compiled.kernel.input_values(r or {}, compiled.kernel.default_inputs(t, p)) if n_r else [])
        check(
            library.call("violation", mechanism),
            max(map(abs, np.concatenate(compiled.kernel.constraint_violation(*at))), default=0),
        )
        times = compiled.kernel.breakpoints(p)
        assert library.call("next_breakpoint", mechanism) == min(times[times > t], default=np.inf)
        # Central differences of the library's own function: their errors are some h^2 = 1e-10 of the change.
        for k in range(n_p):
            h, both = 1e-5 * max(abs(p[k]), 1.0), np.zeros((2, n))
            for side, sign in enumerate((1, -1)):
                mechanism.p[k] = p[k] + sign * h
                library.call("update", mechanism)
                assert library.call("rhs", mechanism, t, x, both[side]) == 0
            mechanism.p[k] = p[k]
            difference = (both[0] - both[1]) / (2 * h)
            size = np.abs(wrt_parameters).max() + np.abs(rates).max()
            np.testing.assert_allclose(wrt_parameters[:, k], difference, rtol=0, atol=1e-7 * size)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_c_library_of_every_model_compiles_by_clang_without_warnings(tmp_path, name):
    folder = fb.export_c(MODELS[name](), tmp_path)
    command = [require("clang"), "-fsyntax-only", *STRICT, f"-I{folder / 'runtime'}"]
    done = subprocess.run([*command, *sorted(folder.glob("*.c"))], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_c_library_differentiates_an_inputs_expression_unless_it_is_held(exported):
    """m u' = f - 9 q, where f is the push: du'/df = 1/m, unless the push is held."""
    compiled, library = exported("kinked")
    for held in (0, 1):
        mechanism, wrt_parameters = library.new(), np.zeros((2, 2))
        mechanism.p[:], mechanism.t, mechanism.x[:] = [4.0, 2.0], 0.5, [0.1, 0.0]
        mechanism.held[0], mechanism.r[0] = held, 3.0
        assert library.call("update", mechanism) == 0
        assert library.call("parameter_jacobian", mechanism, wrt_parameters) == 0
        push = 3.0 if held else 2.0
        expected = {"m": -(push - 0.9) / 16, "f": 0.0 if held else 0.25}
        np.testing.assert_allclose(wrt_parameters[1], [expected[name] for name in compiled.parameters], rtol=1e-15)


@pytest.mark.slow(but=["four_bar"])
@pytest.mark.parametrize("name", MODELS)
def test_c_library_closes_loops_to_the_states_of_initial_state(exported, name):
    """From disturbed guesses, the same states as `initial_state` finds."""
    compiled, library = exported(name)
    mechanism = library.new()
    inputs = set_inputs(compiled, mechanism, 0.3)
    expected = state_of(compiled, inputs)
    n_q, n_dq, n_du = compiled.n_q, *(compiled.manifest[f"n_dependent_{k}"] for k in ("coordinates", "speeds"))
    mechanism.x[:] = expected
    for k in (*range(n_q - n_dq, n_q), *range(n_q + compiled.n_u - n_du, n_q + compiled.n_u)):
        mechanism.x[k] += 0.01
    assert library.call("close", mechanism) == 0
    # Positions are known to 1e-14 of the constraints' terms; the worst condition here is some 1e2.
    np.testing.assert_allclose(mechanism.x, expected, rtol=0, atol=1e-12)
    assert library.call("violation", mechanism) < 1e-12


@pytest.mark.slow(but=["four_bar", "driven_by_unknown_forces"])
@pytest.mark.parametrize("name", MODELS)
def test_c_library_steps_and_runs_as_stepper_and_simulate(exported, name):
    compiled, library = exported(name)
    mechanism = library.new()
    inputs = set_inputs(compiled, mechanism, 0.3) or None
    x = state_of(compiled, inputs)
    stepper = compiled.stepper(2e-3, x, inputs=inputs)
    mechanism.x[:] = x
    for _ in range(50):
        stepper.step()
        assert library.call("step", mechanism, 2e-3, 4) == 0
    assert mechanism.t == pytest.approx(stepper.t, abs=1e-15)
    # Rounding errors grow with the motion's own sensitivity, e^2 to e^6 in these times.
    np.testing.assert_allclose(mechanism.x, stepper.x, rtol=1e-11, atol=1e-11)
    mechanism.t, mechanism.x[:] = 0.0, x
    times = np.linspace(0.0, 0.5, 6)
    states = np.zeros((6, compiled.n_x))
    status = library.call("simulate", mechanism, 0.5, 1e-10, 1e-10, times, 6, states)
    run = compiled.simulate((0.0, 0.5), x, inputs=inputs, t_eval=times, rtol=1e-10, atol=1e-10)
    assert (status == 0) == run.success, library.message(status)
    np.testing.assert_allclose(states[: run.y.shape[1]], run.y.T, rtol=1e-8, atol=1e-8)  # a hundred times the tolerance


@pytest.mark.parametrize("method", STEP_CONTROLLED)
def test_c_library_run_by_each_method_is_that_of_simulate(exported, method):
    """With the same steps: at a tolerance of 1e-4 other ones would differ by that. Rounding errors differ by fused
    instructions; they grow with coefficients up to 50, and with the motion.
    """
    compiled, library = exported("four_bar")
    mechanism, x = library.new(), compiled.initial_state()
    mechanism.x[:] = x
    times = np.linspace(0.0, 2.0, 21)
    states = np.zeros((21, compiled.n_x))
    assert library.simulate(mechanism, method, 2.0, 1e-4, times, states) == 0
    run = compiled.simulate((0.0, 2.0), x, method=method, t_eval=times, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(states, run.y.T, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("name", STIFF_MODELS)
def test_c_library_run_of_stiff_equations_is_that_of_simulate(tmp_path, name):
    """To 1e-13 of the largest state: rounding errors alone, which stiff motions forget."""
    model, end = STIFF_MODELS[name]
    compiled, library = fb.compile_model(model()), Library(model(), tmp_path)
    mechanism, times = library.new(), np.linspace(0.0, end, 11)
    assert library.call("close", mechanism) == 0
    run = compiled.simulate((0.0, end), mechanism.x[:], method="Radau", t_eval=times, rtol=1e-8, atol=1e-8)
    states = np.zeros((11, compiled.n_x))
    assert library.simulate(mechanism, "Radau", end, 1e-8, times, states) == 0
    np.testing.assert_allclose(states, run.y.T, rtol=0, atol=1e-13 * np.abs(run.y).max())


@pytest.mark.parametrize("name", STIFF_MODELS)
def test_c_library_steps_of_stiff_equations_are_those_of_a_stepper(tmp_path, name):
    model, end = STIFF_MODELS[name]
    compiled, library = fb.compile_model(model()), Library(model(), tmp_path)
    mechanism, work = library.new(), (ctypes.c_double * library.stiff_work)()
    assert library.call("close", mechanism) == 0
    stepper = compiled.stepper(end / 100.0, mechanism.x[:], method="Radau")
    for _ in range(100):
        stepper.step()
        assert library.call("step_stiff", mechanism, end / 100.0, work) == 0
    np.testing.assert_allclose(mechanism.x[:], stepper.x, rtol=0, atol=1e-11 * np.abs(stepper.x).max())
    assert mechanism.t == pytest.approx(stepper.t, rel=1e-14)


def test_c_library_run_of_stiff_equations_needs_a_workspace_and_no_events(exported):
    compiled, library = exported("four_bar")
    mechanism = library.new()
    mechanism.x[:] = compiled.initial_state()
    before = bytes(mechanism)
    run = ("simulate_stiff", mechanism, 1.0, 1e-6, 1e-6, None, 0, None, None)
    assert library.message(library.call(*run, None)) == "an argument is outside of its range"
    assert bytes(mechanism) == before
    assert library.call(*run, (ctypes.c_double * library.stiff_work)()) == 0
    assert mechanism.t == 1.0


@pytest.mark.parametrize("method", STEP_CONTROLLED)
def test_c_library_finds_the_events_of_simulate(exported, method):
    """At the same states, whose rounding errors differ by fused instructions, over speeds of some 0.1 rad/s."""
    compiled, library = exported("four_bar")
    x = compiled.initial_state()
    callback = FUNCTION(lambda of, t, state: state[0] + 1.2)
    given = [
        {"quantity": Watched.STATE, "number": 3, "direction": 1},
        {"quantity": Watched.CALLABLE, "function": callback},
        {"quantity": Watched.TIME, "ends_only": 1},
        {"quantity": Watched.STATE, "number": 0, "terminal": 1},
    ]
    times = np.linspace(0.0, 4.0, 41)
    how = {"method": method, "rtol": 1e-6, "atol": 1e-6}
    names = [fb.Event("u1", direction=1), lambda t, state: state[0] + 1.2, fb.Event("t", all_roots=False)]
    run = compiled.simulate((0.0, 4.0), x, events=names, t_eval=times, **how)
    for room in (100, 3):
        mechanism, events, states = library.new(), library.events(*given, room=room), np.zeros((41, compiled.n_x))
        mechanism.x[:] = x
        assert library.simulate(mechanism, method, 4.0, 1e-6, times, states, events) == 0
        assert (events.n_found, events.ended_by, mechanism.t) == (sum(map(len, run.t_events)), -1, 4.0)
        assert events.n_found > 5
        found = [(events.found[k].t, events.found[k].event) for k in range(min(room, events.n_found))]
        expected = sorted((t, i) for i, at in enumerate(run.t_events) for t in at)[:room]
        assert [i for _, i in found] == [i for _, i in expected]
        np.testing.assert_allclose([t for t, _ in found], [t for t, _ in expected], rtol=0, atol=1e-12)
        np.testing.assert_allclose(states, run.y.T, rtol=1e-11, atol=1e-11)
        if room == 3:
            first = run.y_events[expected[0][1]][0]
            np.testing.assert_allclose(events.found[0].x[:], first, rtol=0, atol=1e-11)
            assert events.found[3 - 1].t > 0.0


def test_c_library_has_events_of_all_quantities(exported):
    """Of the slider-crank: a force in its pin, its energy, momentum, and the multipliers of its loop."""
    compiled, library = exported("slider_crank")
    x = compiled.initial_state({"crank": 0.5}, {"crank_rate": 3.0})
    names = ("pin_x", "kinetic_energy", "momentum_y", "lambda1", "slide_rate", "load")
    numbers = [(Watched.OUTPUT, 0), (Watched.ENERGY, 0), (Watched.MOMENTUM, 1), (Watched.MULTIPLIER, 0)]
    numbers += [(Watched.STATE, 5), (Watched.INPUT, 1)]
    mechanism = library.new()
    mechanism.x[:] = x
    events = library.events(*({"quantity": quantity, "number": number} for quantity, number in numbers))
    arguments = (3.0, 1e-9, 1e-9, None, 0, None, ctypes.byref(events))
    assert library.call("simulate_events", mechanism, *arguments) == 0
    run = compiled.simulate((0.0, 3.0), x, events=list(names), rtol=1e-9, atol=1e-9)
    found = [(events.found[k].t, events.found[k].event) for k in range(events.n_found)]
    expected = sorted((t, i) for i, at in enumerate(run.t_events) for t in at)
    assert [i for _, i in found] == [i for _, i in expected]
    assert {0, 2, 4} <= {i for _, i in found}
    np.testing.assert_allclose([t for t, _ in found], [t for t, _ in expected], rtol=0, atol=1e-10)


def test_c_library_tells_of_functions_that_touch_zero(exported):
    """The kinetic energy is zero where the linkage rests; the last time counts, within the run."""
    compiled, library = exported("four_bar")
    x = compiled.initial_state()
    rest = compiled.simulate((0.0, 4.0), x, events="u1", rtol=1e-9, atol=1e-9).t_events[0]
    energy, callback = {"quantity": Watched.ENERGY, "number": 0}, FUNCTION(lambda of, t, state: t - 2.0)
    for terminal, last in ((0, rest[4]), (1, rest[1])):
        until = {"quantity": Watched.CALLABLE, "function": callback, "terminal": terminal}
        mechanism, events = library.new(), library.events(energy, until)
        mechanism.x[:] = x
        assert library.call("simulate_events", mechanism, 4.0, 1e-9, 1e-9, None, 0, None, ctypes.byref(events)) == 0
        found = [library.call("touched", mechanism, ctypes.byref(events), event) for event in (0, 1)]
        np.testing.assert_allclose(found, [last, np.nan], rtol=0, atol=1e-6)
        assert np.isnan(library.call("touched", mechanism, ctypes.byref(events), 2))
        assert np.isnan(library.call("touched", library.new(), ctypes.byref(events), 0))  # it has had no run


def test_c_library_takes_the_sign_of_a_direction_alone(exported):
    compiled, library = exported("four_bar")
    for direction in (-1, -7, -(2**31)):
        mechanism, events = (
            library.new(),
            library.events({"quantity": Watched.STATE, "number": 3, "direction": direction}),
        )
        mechanism.x[:] = compiled.initial_state()
        library.call("simulate_events", mechanism, 4.0, 1e-8, 1e-8, None, 0, None, ctypes.byref(events))
        assert events.n_found == 2


def test_c_library_run_ends_at_a_terminal_event(exported):
    compiled, library = exported("four_bar")
    x, times = compiled.initial_state(), np.linspace(0.0, 4.0, 41)
    mechanism, states = library.new(), np.zeros((41, compiled.n_x))
    mechanism.x[:] = x
    events = library.events({"quantity": Watched.STATE, "number": 3, "terminal": 2})
    assert library.call("simulate_events", mechanism, 4.0, 1e-8, 1e-8, times, 41, states, ctypes.byref(events)) == 0
    run = compiled.simulate((0.0, 4.0), x, events=fb.Event("u1", terminal=2), t_eval=times, rtol=1e-8, atol=1e-8)
    assert (events.n_found, events.ended_by) == (2, 0)
    assert mechanism.t == pytest.approx(run.t[-1], abs=1e-12)
    np.testing.assert_allclose(mechanism.x, run.y[:, -1], rtol=0, atol=1e-11)
    n = np.count_nonzero(times < mechanism.t)
    np.testing.assert_allclose(states[:n], run.y[:, :n].T, rtol=1e-11, atol=1e-11)
    assert not states[n:].any()
    # it goes on from there: a start on the surface is no event
    assert library.call("simulate_events", mechanism, 4.0, 1e-8, 1e-8, None, 0, None, ctypes.byref(events)) == 0
    more = compiled.simulate((run.t[-1], 4.0), run.y[:, -1], events=fb.Event("u1", terminal=2), rtol=1e-8, atol=1e-8)
    assert mechanism.t == pytest.approx(more.t[-1], abs=1e-11)


def test_c_library_refuses_events_that_are_none(exported):
    compiled, library = exported("four_bar")
    wrong = [
        {"quantity": -1}, {"quantity": len(Watched)}, {"quantity": Watched.STATE, "number": compiled.n_x},
        {"quantity": Watched.OUTPUT}, {"quantity": Watched.CALLABLE}, {"quantity": Watched.STATE, "number": -1},
        {"quantity": Watched.TIME, "terminal": -1},
    ]  # fmt: skip
    for members in wrong:
        mechanism, events = library.new(), library.events(members)
        status = library.call("simulate_events", mechanism, 1.0, 1e-6, 1e-6, None, 0, None, ctypes.byref(events))
        assert library.message(status) == Status.INVALID_ARGUMENT.comment
        assert mechanism.t == 0.0
    mechanism, events = library.new(), library.events({"quantity": Watched.TIME})
    events.work = None
    status = library.call("simulate_events", mechanism, 1.0, 1e-6, 1e-6, None, 0, None, ctypes.byref(events))
    assert library.message(status) == Status.INVALID_ARGUMENT.comment


def test_c_library_without_such_a_method_says_so(exported):
    _, library = exported("four_bar")
    for method in (-1, len(EXPLICIT)):
        mechanism = library.new()
        mechanism.method = method
        status = library.call("simulate", mechanism, 1.0, 1e-4, 1e-4, None, 0, None)
        assert library.message(status) == Status.INVALID_ARGUMENT.comment
        assert mechanism.t == 0.0


def test_c_library_steps_converge_with_their_order(exported):
    """Of the pendulum, whose motion is an elliptic function; halved steps give errors of 1/16 and 1/256."""
    from scipy.special import ellipj

    _, library = exported("pendulum")
    amplitude, w = 1.0, np.sqrt(9.81 / 0.5)
    m = np.sin(amplitude / 2) ** 2
    # From the lowest point, with the speed that leads to the amplitude.
    exact = 2 * np.arcsin(np.sqrt(m) * ellipj(w * 1.2, m)[0])
    for order, numbers in ((4, (80, 160)), (8, (4, 8))):
        errors = []
        for n in numbers:
            mechanism = library.new()
            mechanism.x[:] = [0.0, 2 * w * np.sqrt(m)]
            for _ in range(n):
                assert library.call("step", mechanism, 1.2 / n, order) == 0
            errors.append(abs(mechanism.x[0] - exact))
        assert 0.7 < np.log2(errors[0] / errors[1]) / order < 1.4


def test_c_library_run_ends_a_step_at_a_kink_in_time(exported):
    """Steps end at t = 0.35, so that the run is exact to its tolerance."""
    _, library = exported("kinked")
    mechanism = library.new()
    times = np.array([0.0, 0.35, 0.6, 1.0])
    states = np.zeros((4, 2))
    assert library.call("simulate", mechanism, 1.0, 1e-12, 1e-12, times, 4, states) == 0
    expected = np.where(times > 0.35, (1 - np.cos(3 * (times - 0.35))) / 9, 0.0)
    np.testing.assert_allclose(states[:, 0], expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("h", [0.05, 0.04])
def test_c_library_steps_across_a_jump_in_time_are_exact(exported, h):
    """A step that ends at t = 0.35 has the force before it in its last stage; one that passes it is made of two.

    The error of order 8 is below (w h)^9 / 9!, over 20 steps 1e-12.
    """
    _, library = exported("kinked")
    mechanism = library.new()
    while mechanism.t < 0.99:
        assert library.call("step", mechanism, h, 8) == 0
    angle = 3 * (mechanism.t - 0.35)
    np.testing.assert_allclose(mechanism.x[:2], [(1 - np.cos(angle)) / 9, np.sin(angle) / 3], rtol=0, atol=1e-11)


def test_c_library_steps_are_exact_where_the_time_of_a_jump_is_rounded(tmp_path):
    """A unit force on a unit mass from a t = 1 on: v = 1 - 1 / a at t = 1. The time 1 / a is a rounding error away from
    where a t - 1 changes its sign. Methods of order 4 and 8 are exact for forces that are constant on each side; a
    stage on the wrong one would change v by its weight, 1e-2 or more, times the length of a part of a step. Rounding
    errors of 10 steps are 1e-15.
    """
    a, t, (x, v) = sm.Symbol("a"), me.dynamicsymbols._t, me.dynamicsymbols("x v")
    system = on_a_line(sm.Integer(1), sm.Heaviside(a * t - 1))
    model = fb.Model(system, name="pushed", parameters={a: 3.7}, initial={x: 0.0, v: 0.0})
    library = Library(model, tmp_path / "pushed")
    for value in (3.7, 49.0, 7.3, 1.7, 23.9):
        for order in (4, 8):
            mechanism = library.new()
            mechanism.p[0] = value
            assert library.call("update", mechanism) == 0
            for _ in range(10):
                assert library.call("step", mechanism, 0.1, order) == 0
            assert mechanism.x[1] == pytest.approx(1 - 1 / value, abs=1e-14)


def test_c_library_control_loop_equals_a_held_table_in_python(exported):
    """A controller of 1 kHz in C, by steps of order 8, and its forces as a table in Python."""
    compiled, library = exported("four_bar")
    mechanism = library.new()
    assert library.call("close", mechanism) == 0
    start, force, rate = np.array(mechanism.x), compiled.inputs.index("F"), compiled.states.index("u1")
    times, forces, states = [], [], []
    mechanism.held[force] = 1
    for _ in range(500):
        mechanism.r[force] = -50.0 * mechanism.x[rate]
        times.append(mechanism.t)
        forces.append(mechanism.r[force])
        states.append([*mechanism.x])
        assert library.call("step", mechanism, 1e-3, 8) == 0
    inputs = {"F": (times, forces, "hold")}
    run = compiled.simulate((0.0, times[-1]), start, inputs=inputs, t_eval=times, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.y, np.transpose(states), rtol=0, atol=1e-12)


def test_c_library_mechanism_copied_in_memory_goes_on_alike(exported):
    _, library = exported("four_bar")
    mechanism = library.new()
    assert library.call("close", mechanism) == 0
    for _ in range(10):
        library.call("step", mechanism, 1e-3, 8)
    kept = type(mechanism).from_buffer_copy(mechanism)
    results = []
    for each in (mechanism, kept):
        for _ in range(10):
            library.call("step", each, 1e-3, 8)
        results.append((each.t, *each.x))
    assert results[0] == results[1]


def test_c_library_with_changed_parameters_and_inputs_equals_python(exported):
    compiled, library = exported("four_bar")
    mechanism = library.new()
    mechanism.p[compiled.parameters.index("l2")] = 0.4
    assert library.call("update", mechanism) == 0
    assert library.call("close", mechanism) == 0
    np.testing.assert_allclose(mechanism.x, compiled.initial_state(parameters={"l2": 0.4}), rtol=0, atol=1e-13)
    mechanism.held[0], mechanism.r[0] = 1, 7.0
    stepper = compiled.stepper(1e-3, np.array(mechanism.x), parameters={"l2": 0.4}, inputs={"F": 7.0})
    for _ in range(20):
        library.call("step", mechanism, 1e-3, 4)
        stepper.step()
    np.testing.assert_allclose(mechanism.x, stepper.x, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_c_library_refuses_steps_and_runs_across_a_jump_of_speeds(tmp_path):
    """It is refused to pass it, and to stop there: the speeds after it are unknown."""
    points = {"O": (0, 0), "A": (0.1, 0.05), "C": (0.4, 0)}
    linkage = fb.Linkage("jumping", points=points, ground="O", links=["OA", "AC"], density=1.0)
    linkage.slider("C", along=(1, 0))
    t = me.dynamicsymbols._t
    linkage.drive("O", angle=sm.Piecewise((0, t < 0.25), (5 * t - 1.25, True)))
    library = Library(linkage.model(), tmp_path)
    mechanism = library.new()
    assert library.call("close", mechanism) == 0
    assert "jumps" in library.message(library.call("simulate", mechanism, 0.3, 1e-6, 1e-6, None, 0, None))
    assert "jumps" in library.message(library.call("simulate", mechanism, 0.25, 1e-6, 1e-6, None, 0, None))
    assert library.call("simulate", mechanism, 0.24, 1e-6, 1e-6, None, 0, None) == 0
    assert "jumps" in library.message(library.call("step", mechanism, 0.02, 4))


@pytest.mark.slow
def test_c_library_run_of_a_cam_that_returns_to_rest_equals_python(tmp_path):
    """A cubic, whose position and speed are zero at its end, but for rounding errors; its acceleration jumps there."""
    points = {"O": (0, 0), "A": (0.1, 0.05), "C": (0.4, 0)}
    linkage = fb.Linkage("cam", points=points, ground="O", links=["OA", "AC"], density=1.0)
    linkage.slider("C", along=(1, 0))
    h, end, t = *sm.symbols("h T"), me.dynamicsymbols._t
    angle = sm.Piecewise((h * (1 - 3 * (t / end) ** 2 + 2 * (t / end) ** 3), t < end), (0, True))
    linkage.drive("O", angle=angle)
    model = linkage.model(parameters={"T": 0.7, "h": 0.05})
    library, compiled = Library(model, tmp_path), fb.compile_model(model)
    mechanism = library.new()
    assert library.call("close", mechanism) == 0
    x = np.array(mechanism.x)
    assert library.call("simulate", mechanism, 1.0, 1e-9, 1e-9, None, 0, None) == 0
    expected = compiled.simulate((0.0, 1.0), x, rtol=1e-9, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(mechanism.x, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("n", [0, 2, 3001])
def test_c_library_run_ends_at_a_singular_position_between_samples(exported, n):
    """However many samples are taken, the run ends there."""
    compiled, library = exported("slider_crank")
    mechanism = library.new()
    for name in ("r", "l"):
        mechanism.p[compiled.parameters.index(name)] = 0.2
    library.call("update", mechanism)
    mechanism.x[0], mechanism.x[3] = 0.5, 2.0
    assert library.call("close", mechanism) == 0
    times, states = np.linspace(0.0, 3.0, n), np.zeros((n, 6))
    status = library.call("simulate", mechanism, 3.0, 1e-8, 1e-8, times if n else None, n, states if n else None)
    assert "singular position" in library.message(status)
    assert 1.3 < mechanism.x[0] < 1.58
    assert not states[int(np.searchsorted(times, mechanism.t)) + 1 :].any()


@pytest.mark.slow(but=["8"])
@pytest.mark.parametrize("n", [8, 100])
def test_c_library_runs_end_at_the_singular_positions_where_pythons_end(tmp_path, n):
    """Random linkages whose rocker is turned with constant speed; most of them reach dead points."""
    points = {"O": (0, 0), "A": (0.1, 0), "B": (0.22, 0.35), "R": (0.4, 0)}
    linkage = fb.Linkage("driven", points=points, ground="OR", links=["OA", "AB", "BR"], density=2.0)
    linkage.drive("BR", speed=1.0)
    library, compiled = Library(linkage.model(), tmp_path), fb.compile_model(linkage.model())
    rng, ends = np.random.default_rng(7), []
    ranges = {"l_OA": (0.05, 0.5), "l_AB": (0.1, 0.6), "l_BR": (0.1, 0.6), "x_R": (0.2, 0.6), "start_BR": (-3.0, 3.0)}
    while len(ends) < n:
        p = {name: rng.uniform(*bounds) for name, bounds in ranges.items()}
        try:
            x = compiled.initial_state(parameters=p)
        except fb.FourbarError:
            continue
        run = compiled.simulate((0.0, 7.0), x, parameters=p, rtol=1e-6, atol=1e-9)
        mechanism = library.new()
        for name, value in p.items():
            mechanism.p[compiled.parameters.index(name)] = value
        library.call("update", mechanism)
        mechanism.x[:] = x
        status = library.call("simulate", mechanism, 7.0, 1e-6, 1e-9, None, 0, None)
        assert ("singular position" in library.message(status)) == ("singular position" in run.message)
        assert mechanism.t == pytest.approx(run.t[-1], abs=1e-6)
        ends.append(run.t[-1])
    assert sum(end < 7.0 for end in ends) > n / 2


def test_c_library_violation_of_a_state_with_nan_is_nan(exported):
    compiled, library = exported("slider_crank")
    for k in range(compiled.n_x):
        mechanism = library.new()
        library.call("close", mechanism)
        mechanism.x[k] = np.nan
        assert np.isnan(library.call("violation", mechanism))
        assert np.isnan(library.call("relative_violation", mechanism))


def test_c_library_statuses_of_failures_have_their_messages(exported):
    compiled, library = exported("four_bar")

    def status(function, *arguments, **changes):
        mechanism = library.new()
        library.call("close", mechanism)
        for name, value in changes.get("p", {}).items():
            mechanism.p[compiled.parameters.index(name)] = value
        library.call("update", mechanism)
        if "r" in changes:
            mechanism.held[0], mechanism.r[0] = 1, changes["r"]
        before = [*mechanism.x]
        found = library.call(function, mechanism, *arguments)
        if function != "simulate":
            assert [*mechanism.x] == before
        return library.message(found)

    assert status("close", p={"l2": 9.0}) == "no state nearby satisfies the constraints"
    assert "not a number" in status("step", 1e-3, 4, r=np.nan)
    assert "not a number" in status("update", p={"l2": np.inf})
    assert "outside of its range" in status("step", 1e-3, 5)
    assert "outside of its range" in status("step", np.inf, 4)
    assert "outside of its range" in status("simulate", 1.0, 0.0, 1e-9, None, 0, None)
    assert "outside of its range" in status("simulate", 1.0, 1e-6, np.inf, None, 0, None)
    assert "outside of its range" in status("simulate", 1.0, 1e-6, 1e-9, np.array([0.5, 0.2]), 2, np.zeros((2, 6)))
    assert "outside of its range" in status("simulate", 1.0, 1e-6, 1e-9, None, 2, np.zeros((2, 6)))
    assert "outside of its range" in status("simulate", 1.0, 1e-6, 1e-9, np.array([0.5, 0.7]), 2, None)
    assert "singular position" in status("simulate", 6.0, 1e-8, 1e-8, None, 0, None)
    assert library.message(0) == "success"
    assert library.message(99) == "unknown status"


@pytest.mark.slow
def test_c_library_built_by_its_readme_prints_pythons_motion(tmp_path, four_bar):
    """The example prints the motion that Python's stepper finds; a C++ program includes the header."""
    require("gcc")
    folder = fb.export_c(fb.models.four_bar(), tmp_path / "four_bar")
    command = (folder / "README.md").read_text().split("    ")[1].splitlines()[0]
    assert command == "gcc -std=c99 -O2 *.c -o example -lm && ./example"
    strict = command.replace("-std=c99 -O2", " ".join(STRICT))
    printed = subprocess.run(strict, shell=True, cwd=folder, capture_output=True, text=True, check=True).stdout
    found = np.array([[float(word) for word in line.split()] for line in printed.splitlines()])
    stepper = four_bar.stepper(1e-3, four_bar.initial_state())
    expected = [stepper.x[:3]]
    for k in range(1000):
        stepper.step()
        expected += [stepper.x[:3]] if k % 10 == 9 else []
    np.testing.assert_allclose(found[:, 1:], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[:, 0], np.linspace(0, 1, 101), rtol=0, atol=5e-4)
    for words in (["-B", "build"], ["--build", "build"]):
        subprocess.run([sys.executable, "-m", "cmake", *words], cwd=folder, capture_output=True, check=True)
    built = subprocess.run([folder / "build" / "four_bar_example"], capture_output=True, text=True, check=True).stdout
    assert built.splitlines()[:2] == printed.splitlines()[:2]
    user = folder / "user.cpp"
    user.write_text('#include "four_bar.h"\nint size() { return four_bar_n_x + four_bar_x_q1 + four_bar_p_l2; }\n')
    subprocess.run(
        [require("gcc"), "-x", "c++", "-Wall", "-Wextra", "-Werror", "-c", user, "-o", os.devnull], check=True
    )


@pytest.mark.slow
def test_c_library_controller_of_the_documentation_prints_what_stands_there(tmp_path):
    """It prints what stands there, and what Python's stepper finds with the same torque."""
    folder = fb.export_c(fb.models.slider_crank(), tmp_path / "slider_crank")
    page = (PROJECT / "docs" / "howto" / "c_library.md").read_text()
    (folder / "main.c").write_text(page.split("```c\n")[1].split("```")[0])
    subprocess.run([require("gcc"), *STRICT, *folder.glob("*.c"), "-o", folder / "a", "-lm"], check=True)
    printed = subprocess.run([folder / "a"], capture_output=True, text=True, check=True).stdout.split()
    assert printed[:6] == page.split("```text\n")[1].split()[:6]
    assert printed[-1] == "success"
    engine = fb.compile_model(fb.models.slider_crank())
    given = {"m_slider": 1.2}
    x = engine.initial_state({"crank": 0.5}, {"crank_rate": 0.0}, parameters=given)
    stepper = engine.stepper(1e-3, x, parameters=given)
    for _ in range(2000):
        x = stepper.step({"torque": 2.0 * (10.0 - x[3]), "load": 5.0})
    assert float(printed[2]) == pytest.approx(x[3], abs=1e-6)


@pytest.mark.slow
def test_export_into_a_folder_keeps_the_users_main_c(tmp_path):
    """The page says to save one's controller as main.c: the next export replaces all but it."""
    folder = fb.export_c(fb.models.slider_crank(), tmp_path)
    example = (folder / "main.c").read_text()
    for name in ("main.c", "slider_crank.c"):
        (folder / name).write_text("mine")
    fb.export_c(fb.models.slider_crank(), folder)
    assert (folder / "main.c").read_text() == "mine"
    assert (folder / "slider_crank.c").read_text() != "mine"
    (folder / "main.c").unlink()
    fb.export_c(fb.models.slider_crank(), folder)
    assert (folder / "main.c").read_text() == example


def test_export_of_contradictory_kinematics_gives_a_warning(tmp_path):
    """A velocity that does not follow from the position, as `compile_model` tells."""
    with pytest.warns(fb.ModelWarning, match="velocity"):
        fb.export_c(slider("velocity"), tmp_path)


@pytest.mark.slow
def test_c_libraries_of_two_models_work_in_one_program(tmp_path):
    gcc = require("gcc")
    for model in (fb.models.four_bar(), fb.models.slider_crank()):
        fb.export_c(model, tmp_path / model.name)
    (tmp_path / "main.c").write_text(
        """
        #include "four_bar/four_bar.h"
        #include "slider_crank/slider_crank.h"
        int main(void)
        {
            static four_bar a;
            static slider_crank b;
            four_bar_init(&a);
            slider_crank_init(&b);
            return four_bar_close(&a) + slider_crank_close(&b);
        }
        """
    )
    sources = [tmp_path / "main.c", *(tmp_path / name / f"{name}.c" for name in ("four_bar", "slider_crank"))]
    subprocess.run([gcc, *STRICT, *sources, "-o", tmp_path / "both", "-lm"], check=True)
    subprocess.run([tmp_path / "both"], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("target", ["aarch64-linux-gnu", "arm-linux-gnueabihf"])
def test_c_library_on_emulated_arm_processors_gives_pythons_states(tmp_path, four_bar, target):
    """Cross-compiled, and run by an emulator: the state after a second of steps."""
    command = emulator(target.partition("-")[0], target)
    folder = fb.export_c(fb.models.four_bar(), tmp_path / "four_bar")
    program = zig_cc(tmp_path, f"{target}.2.17", sorted(folder.glob("*.c")), "-lm")
    done = subprocess.run([*command, program], capture_output=True, text=True, check=True)
    last = [float(word) for word in done.stdout.splitlines()[-1].split()]
    stepper = four_bar.stepper(1e-3, four_bar.initial_state())
    for _ in range(1000):
        stepper.step()
    np.testing.assert_allclose(last[1:], stepper.x[:3], rtol=0, atol=1e-12)


def test_header_of_a_library_has_auxiliary_states_last_and_counts_unknown_forces(tmp_path):
    header = (fb.export_c(motor(), tmp_path / "motor") / "motor.h").read_text()
    assert re.findall(r"motor_x_(\w+) = (\d)", header) == [("theta", "0"), ("omega", "1"), ("i", "2")]
    # No constraint, and a normal force beside the multipliers.
    header = (fb.export_c(MODELS["driven_by_unknown_forces"](), tmp_path / "rod") / "rod.h").read_text()
    assert "rod_n_l = 1," in header


@pytest.mark.slow
def test_export_twice_gives_equal_texts_without_global_variables(tmp_path):
    texts = []
    for name in ("one", "two"):
        folder = fb.export_c(fb.models.slider_crank(), tmp_path / name)
        texts.append({str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()})
    assert texts[0] == texts[1]
    # Sections of variables are empty.
    subprocess.run([require("gcc"), *STRICT, "-c", "slider_crank.c", "-o", "a.o"], cwd=tmp_path / "one", check=True)
    sizes = subprocess.run(["size", "a.o"], cwd=tmp_path / "one", capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, sizes.splitlines()[1].split()[:3])
    undefined = subprocess.run(["nm", "-u", "a.o"], cwd=tmp_path / "one", capture_output=True, text=True, check=True)
    assert not {"malloc", "calloc", "free", "printf"} & set(undefined.stdout.split())
    assert text > 0
    assert bss == 0
    assert data < 1000  # pointers of the constant table, which the linker fills in


@pytest.mark.slow
@pytest.mark.parametrize("optimization", ["-Os", "-O3"])
def test_c_library_without_inputs_compiles_without_warnings(tmp_path, optimization):
    """gcc follows arrays without entries, such as those of the derivatives with respect to inputs, into functions."""
    folder = fb.export_c(fb.models.chain(5), tmp_path)
    for source in folder.glob("*.c"):
        subprocess.run([require("gcc"), *STRICT, optimization, "-c", source, "-o", os.devnull], check=True)


@pytest.mark.slow(but=["energy", "m0", "model", "motion"])
@pytest.mark.parametrize("name", ["model", "motion", "state", "step", "x", "m0", "energy", "next"])
def test_c_library_compiles_with_names_that_its_sources_use(tmp_path, name):
    """Functions and variables of the sources may have the model's name, which is a type in C and C++ for its users."""
    named = {} if name == "model" else {"name": name}  # which it is called without a name
    model = fb.Model(pendulum(), parameters={"m": 1.0, "g": 9.81, "l": 0.5}, **named)
    folder = fb.export_c(model, tmp_path)
    (folder / "user.cpp").write_text(
        f'#include "{name}.h"\nint size() {{ {name} one; {name}_init(&one); return {name}_n_x; }}\n'
    )
    for language, sources in (("c", folder.glob("*.c")), ("c++", [folder / "user.cpp"])):
        flags = STRICT[2:] if language == "c++" else STRICT
        subprocess.run([require("gcc"), "-x", language, *flags, "-fsyntax-only", *sources], check=True)


@pytest.mark.parametrize("speed", [-0.3, -0.2])
def test_export_with_wrong_dependent_initial_speeds_is_refused(tmp_path, speed):
    """x vx + y vy = 0: at (0.6, 0.8), which is found from y = 0.7, with vx = 0.4 is vy = -0.3."""
    system = bead_and_wheel(x**2 + y**2 - length**2, "ring").system
    model = fb.Model(system, name="ring", parameters={length: 1.0}, initial={x: 0.6, y: 0.7, vx: 0.4, vy: speed})
    if speed == -0.3:
        fb.export_c(model, tmp_path / "ring")
        assert (tmp_path / "ring" / "ring.c").exists()
        return
    for export, path in ((fb.export_c, tmp_path / "ring"), (fb.export_fmu, tmp_path / "ring.fmu")):
        # The rate of the constraint is 2 (x vx + y vy).
        with pytest.raises(fb.ModelError, match=r"violate velocity constraint 1: J u [+] b = 0.16 there"):
            export(model, path)
        assert not path.exists()


def test_names_of_all_macros_of_standard_headers_are_reserved():
    """All that the compiler's own headers define; others begin with an underscore."""
    headers = ("float", "limits", "math", "stdarg", "stddef", "stdint", "stdio", "stdlib", "string", "time")
    command = [require("gcc"), "-std=c99", "-dM", "-E", "-x", "c", "-"]
    source = "".join(f"#include <{header}.h>\n" for header in headers)
    text = subprocess.run(command, input=source, capture_output=True, text=True, check=True).stdout
    macros = set(re.findall(r"#define ([A-Za-z]\w*)", text))
    assert {"NAN", "INT_FAST16_MIN", "HUGE_VALL"} <= macros
    assert {name for name in macros - RESERVED if not RESERVED_FAMILIES.fullmatch(name)} == set()
    assert not any(RESERVED_FAMILIES.fullmatch(name) for name in ("M1", "SCARA", "FD", "L_shaped", "M_arm", "RRR_2"))


@pytest.mark.slow
def test_export_of_models_without_values_or_with_reserved_names_is_refused(tmp_path):
    with pytest.raises(fb.ModelError, match="begins with defaults: give m"):
        fb.export_c(fb.Model(pendulum(), name="open", parameters={"g": 9.81, "l": 0.5}), tmp_path / "a")
    of_c = ("double", "template", "math", "time", "y1", "uint32_t", "NAN", "FILE", "M_PI", "DBL_MAX", "va_list")
    for name in (*of_c, "constraint", "fb_kernel", "FB_MODEL"):
        with pytest.raises(fb.ModelError, match=f"'{name}' is a name in C"):
            fb.export_c(fb.Model(pendulum(), name=name, parameters={"m": 1.0, "g": 9.81, "l": 0.5}), tmp_path / "a")
    greek = pendulum(mass=sm.Symbol("μ"))
    with pytest.raises(fb.ModelError, match="is no name in C"):
        fb.export_c(fb.Model(greek, name="pend", parameters={"μ": 1.0, "m": 1.0, "g": 9.81, "l": 0.5}), tmp_path / "a")
    twice = pendulum(mass=sm.Symbol("l^") + sm.Symbol("l_"))
    with pytest.raises(fb.ModelError, match="are the same name in C"):
        fb.export_c(
            fb.Model(twice, name="pend", parameters={"l^": 1.0, "l_": 1.0, "m": 1.0, "g": 9.81, "l": 0.5}),
            tmp_path / "a",
        )
    assert not (tmp_path / "a").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(fb.BuildError, match="cannot be written"):
        fb.export_c(fb.models.four_bar(), tmp_path / "file")
