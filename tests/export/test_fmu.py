"""Models as FMUs of FMI 2 and 3, in FMPy, an importer by others (https://fmpy.readthedocs.io)."""

import shutil
import subprocess
import sys
import zipfile

import fmpy
import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.exported import MODELS
from builders.prescribed import driven_pendulum
from builders.redundant import three_uprights
from fmpy.build import build_platform_binary
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmpy.fmi3 import FMU3Model, FMU3Slave
from fmpy.validation import validate_fmu
from harness.programs import prepare_zig, require

import fourbar_codegen as fb
from fourbar_codegen.building.compiler import cross_compiler
from fourbar_codegen.runtime.enumerations import STEP_CONTROLLED

pytestmark = pytest.mark.slow

SLAVE, MODEL = {2: FMU2Slave, 3: FMU3Slave}, {2: FMU2Model, 3: FMU3Model}
BOTH = pytest.mark.parametrize("fmi", [2, 3])


@pytest.fixture(scope="module")
def fmus(tmp_path_factory):
    """FMUs by version and model, exported once."""
    made = {}

    def get(fmi, name="four_bar"):
        if (fmi, name) not in made:
            model = MODELS[name]()
            path = tmp_path_factory.mktemp(name) / f"{name}{fmi}.fmu"
            made[fmi, name] = str(fb.export_fmu(model, path, fmi=fmi))
        return made[fmi, name]

    return get


class Instance:
    """An FMU's instance, with its messages, and variables by name."""

    def __init__(self, path, fmi, folder, kind=SLAVE):
        self.description = fmpy.read_model_description(path)
        self.references = {v.name: v.valueReference for v in self.description.modelVariables}
        self.messages, self.fmi = [], fmi
        self.fmu = kind[fmi](
            guid=self.description.guid,
            unzipDirectory=fmpy.extract(path, unzipdir=str(folder)),
            modelIdentifier=self.description.coSimulation.modelIdentifier,
            instanceName="instance",
        )
        if fmi == 2:
            from fmpy.fmi2 import fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

            self.callbacks = fmi2CallbackFunctions()
            self.callbacks.logger = fmi2CallbackLoggerTYPE(lambda *words: self.messages.append(words[-1].decode()))
            self.fmu.instantiate(callbacks=self.callbacks)
        else:
            self.fmu.instantiate(logMessage=lambda *words: self.messages.append(words[-1].decode()))

    def begin(self, t=0.0, tolerance=1e-9, **values):
        if self.fmi == 2:
            self.fmu.setupExperiment(startTime=t, tolerance=tolerance)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=t, tolerance=tolerance)
        self.set(**values)
        self.fmu.exitInitializationMode()

    def set(self, **values):
        setter = self.fmu.setReal if self.fmi == 2 else self.fmu.setFloat64
        if values:
            setter([self.references[name] for name in values], [*values.values()])

    def get(self, *names):
        getter = self.fmu.getReal if self.fmi == 2 else self.fmu.getFloat64
        return np.array(getter([self.references[name] for name in names]))

    def step(self, t, h):
        self.fmu.doStep(currentCommunicationPoint=t, communicationStepSize=h)


@BOTH
@pytest.mark.parametrize(
    "name", ["four_bar", "slider_crank", "whipple_bicycle", "redundant", "unknown_forces", "kinked"]
)
def test_fmus_of_every_model_are_valid_by_fmpy(fmus, fmi, name):
    """FMPy checks against the schema of the standard, and more; it finds no problem."""
    path = fmus(fmi, name)
    assert validate_fmu(path) == []
    subprocess.run([sys.executable, "-m", "fmpy", "validate", path], check=True, capture_output=True)


@BOTH
def test_fmu_in_co_simulation_gives_the_motion_of_simulate(fmus, fmi, four_bar):
    found = fmpy.simulate_fmu(
        fmus(fmi), fmi_type="CoSimulation", stop_time=4.0, output_interval=0.05, relative_tolerance=1e-10,
        output=[*four_bar.states, "der(u1)", "kinetic energy", "potential energy", "P2.x"],
    )  # fmt: skip
    run = four_bar.simulate((0.0, 4.0), t_eval=found["time"].clip(0.0, 4.0), rtol=1e-12, atol=1e-12)
    for name in four_bar.states:
        np.testing.assert_allclose(found[name], run[name], rtol=0, atol=2e-9)  # twenty times the tolerance
    energies = [
        (four_bar.kinetic_energy(t, x), four_bar.potential_energy(t, x)) for t, x in zip(run.t, run.y.T, strict=True)
    ]
    np.testing.assert_allclose(
        np.column_stack([found["kinetic energy"], found["potential energy"]]), energies, rtol=1e-8
    )
    rates = [four_bar.rhs(t, x)[3] for t, x in zip(run.t, run.y.T, strict=True)]
    np.testing.assert_allclose(found["der(u1)"], rates, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["P2.x"], run.points["P2"][0], rtol=0, atol=1e-8)


@pytest.mark.parametrize("method", STEP_CONTROLLED)
def test_fmu_in_co_simulation_steps_by_the_method_of_export(tmp_path, method):
    """Each communication step is a run of `simulate`: at a tolerance of 1e-4 other methods differ by that."""
    model = fb.models.four_bar()
    path = str(fb.export_fmu(model, tmp_path / "four_bar.fmu", method=method))
    compiled = fb.compile_model(model)
    found = fmpy.simulate_fmu(
        path, fmi_type="CoSimulation", stop_time=1.0, output_interval=0.25, relative_tolerance=1e-4,
        output=[*compiled.states],
    )  # fmt: skip
    x = compiled.initial_state()
    for begin, row in zip((0.0, 0.25, 0.5, 0.75), found[1:], strict=True):
        x = compiled.simulate((begin, begin + 0.25), x, method=method, rtol=1e-4, atol=1e-4).y[:, -1]
        np.testing.assert_allclose([row[name] for name in compiled.states], x, rtol=0, atol=1e-12)


@BOTH
def test_fmu_events_are_indicators_of_model_exchange(fmi, tmp_path, four_bar):
    """FMPy's CVODE finds their roots; at a tolerance of 1e-9, times agree to a hundred times that."""
    events = [fb.Event("u1"), fb.Event("q1", direction=1), fb.Event("u2", terminal=4)]
    path = str(fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu", fmi=fmi, events=events))
    assert validate_fmu(path) == []
    assert fmpy.read_model_description(path).numberOfEventIndicators == 3
    run = four_bar.simulate((0.0, 4.0), events=events, rtol=1e-12, atol=1e-12)
    assert run.status == 1
    found = fmpy.simulate_fmu(
        path, fmi_type="ModelExchange", stop_time=4.0, output_interval=0.5, relative_tolerance=1e-9, output=["u1"]
    )  # fmt: skip
    assert found["time"][-1] == pytest.approx(run.t[-1], abs=1e-7)
    for time in np.concatenate([run.t_events[0], run.t_events[2]]):
        assert np.abs(found["time"] - time).min() < 1e-7


def test_fmu_steps_end_early_at_events_if_the_importer_allows_it(tmp_path, four_bar):
    """Communication steps of 0.5 s; the tolerance is 1e-10."""
    events = [fb.Event("u1"), fb.Event("kinetic_energy", direction=1), fb.Event("u2", terminal=4)]
    path = str(fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu", events=events))
    run = four_bar.simulate((0.0, 4.0), events=events, rtol=1e-12, atol=1e-12)
    how = {"fmi_type": "CoSimulation", "stop_time": 4.0, "output_interval": 0.5, "relative_tolerance": 1e-10}
    found = fmpy.simulate_fmu(path, early_return_allowed=True, output=["u1", "u2"], **how)
    times = [0.0, *np.arange(0.5, run.t[-1], 0.5), *run.t_events[0]]
    np.testing.assert_allclose(run.t_events[2], run.t_events[0], rtol=0, atol=1e-9)  # all links rest at once
    np.testing.assert_allclose(found["time"], np.sort(times), rtol=0, atol=1e-8)
    assert abs(found["u2"][-1]) < 1e-7
    [at] = [np.abs(found["time"] - time).argmin() for time in run.t_events[0][:1]]
    assert abs(found["u1"][at]) < 1e-9
    whole = fmpy.simulate_fmu(path, output=["u1", "u2"], **how)
    np.testing.assert_allclose(whole["time"][:-1], np.arange(0.0, run.t[-1], 0.5), rtol=0, atol=1e-12)
    assert abs(whole["u2"][-1]) < 1e-7


def test_fmu_of_fmi_2_ends_co_simulation_at_a_terminal_event(tmp_path, four_bar):
    events = fb.Event("u1", terminal=2)
    path = str(fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu", fmi=2, events=events))
    run = four_bar.simulate((0.0, 4.0), events=events, rtol=1e-12, atol=1e-12)
    found = fmpy.simulate_fmu(
        path, fmi_type="CoSimulation", stop_time=4.0, output_interval=0.5, relative_tolerance=1e-10, output=["u1"]
    )  # fmt: skip
    assert found["time"][-1] == pytest.approx(run.t[-1], abs=1e-8)
    assert abs(found["u1"][-1]) < 1e-9


@BOTH
def test_fmu_states_saved_between_events_count_them(fmi, tmp_path, four_bar):
    events = fb.Event("u1", terminal=2)
    path = str(fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu", fmi=fmi, events=events))
    first, second = four_bar.simulate((0.0, 4.0), events=events, rtol=1e-12, atol=1e-12).t_events[0]
    middle = 0.5 * (first + second)
    instance = Instance(path, fmi, tmp_path / "a")
    instance.begin(tolerance=1e-10)
    instance.step(0.0, middle)
    fmu = instance.fmu
    saved = fmu.serializeFMUState(fmu.getFMUState())
    other = Instance(path, fmi, tmp_path / "b")
    other.begin(tolerance=1e-10)
    other.fmu.setFMUState(other.fmu.deserializeFMUState(saved))
    for each in (instance, other):
        if fmi == 3:
            _, is_over, _, time = each.fmu.doStep(currentCommunicationPoint=middle, communicationStepSize=1.0)
            assert is_over
            assert time == pytest.approx(second, abs=1e-8)
        else:
            with pytest.raises(fmpy.fmi1.FMICallException):
                each.step(middle, 1.0)
        assert each.get("time")[0] == pytest.approx(second, abs=1e-8)


@pytest.mark.parametrize(
    ("events", "words"),
    [
        ("t", "name of one of its states, outputs, energies or momenta"),
        ("lambda1", "make others an output of the model"),
        ("momentum_x", "make others an output of the model"),
        ("P2.x", "make others an output of the model"),
        ([lambda t, x: t], "not a callable"),
        (3.0, "events are callables of"),
    ],
)
def test_fmu_of_events_that_it_cannot_have_is_refused(tmp_path, events, words):
    with pytest.raises(fb.ModelError, match=words):
        fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu", events=events)


def test_fmu_of_an_unknown_method_is_refused(tmp_path):
    with pytest.raises(fb.ModelError, match=r"method .*Euler.*DOP853"):
        fb.export_fmu(fb.models.slider_crank(), tmp_path / "a.fmu", method="Euler")


@BOTH
def test_fmu_has_momenta_as_outputs_on_request(fmi, tmp_path):
    model = fb.models.slider_crank()
    path = str(fb.export_fmu(model, tmp_path / "moving.fmu", fmi=fmi, quantities=["momentum", "spin"]))
    assert validate_fmu(path) == []
    names = {variable.name for variable in fmpy.read_model_description(path).modelVariables}
    assert names >= {f"{vector}_{axis}" for vector in ("momentum", "spin") for axis in "xyz"}
    assert "angular_momentum_x" not in names
    found = fmpy.simulate_fmu(
        path, fmi_type="CoSimulation", stop_time=0.5, output_interval=0.1, relative_tolerance=1e-10,
        output=["momentum_x", "momentum_y", "spin_z"],
    )  # fmt: skip
    slider_crank = fb.compile_model(model)
    run = slider_crank.simulate((0.0, 0.5), t_eval=found["time"].clip(0.0, 0.5), rtol=1e-12, atol=1e-12)
    for name in ("momentum_x", "momentum_y", "spin_z"):
        np.testing.assert_allclose(found[name], run[name], rtol=0, atol=1e-8)  # a hundred times the tolerance


@BOTH
def test_fmu_in_model_exchange_keeps_loops_closed_and_gives_the_motion(fmus, fmi):
    """FMPy's integrator, CVODE, knows nothing of the constraints: at events the state is projected onto them."""
    slider_crank = fb.compile_model(fb.models.slider_crank())
    found = fmpy.simulate_fmu(
        fmus(fmi, "slider_crank"), fmi_type="ModelExchange", stop_time=10.0, output_interval=0.01,
        relative_tolerance=1e-9, output=list(slider_crank.states),
    )  # fmt: skip
    states = np.array([found[name] for name in slider_crank.states])
    violations = np.array([np.abs(slider_crank.position_constraints(0.0, x[:3])).max() for x in states.T])
    assert violations.max() < 1e-8
    last = np.append(np.diff(found["time"]) > 0.0, True)  # after the event, if there was one
    early = last & (found["time"] < 1.0)
    run = slider_crank.simulate((0.0, 1.0), t_eval=found["time"][early], rtol=1e-12, atol=1e-12)
    # CVODE's tolerance is that of a step, of which there are some thousand, and speeds are up to 10 rad/s.
    np.testing.assert_allclose(states[:, early], run.y, rtol=0, atol=1e-5)


def test_fmu_with_redundant_constraints_in_model_exchange_turns_steadily(tmp_path):
    """A parallelogram without gravity turns steadily: no acceleration to compare violations with."""
    start = {"p0": 0.3, "p1": 0.3, "p2": 0.3, "c": 0.0, "v0": 2.0}
    model = fb.Model(three_uprights().system, name="level", parameters={"m": 1, "l": 1, "g": 0}, initial=start)
    found = fmpy.simulate_fmu(
        str(fb.export_fmu(model, tmp_path / "level.fmu")), fmi_type="ModelExchange", stop_time=1.0,
        output_interval=0.1, relative_tolerance=1e-8, output=["p0", "p1", "p2", "v0", "v1", "v2"],
    )  # fmt: skip
    run = fb.compile_model(model).simulate((0.0, 1.0))
    for motion in (found, run):
        angles, rates = ([motion[f"{name}{i}"][-1] for i in range(3)] for name in "pv")
        # Tolerances of some tens of steps, in which nothing changes but the angles.
        np.testing.assert_allclose(angles, 0.3 + 2.0, rtol=0, atol=1e-6)
        np.testing.assert_allclose(rates, 2.0, rtol=0, atol=1e-6)


@BOTH
def test_fmu_compiled_from_its_own_sources_gives_the_same_numbers(fmus, fmi, tmp_path):
    """By FMPy, with its own headers and CMake, for this machine; the numbers are the same."""
    path = shutil.copy(fmus(fmi), tmp_path / "own.fmu")
    before = fmpy.simulate_fmu(path, fmi_type="CoSimulation", stop_time=1.0)
    folder = tmp_path / "sources"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder, [name for name in archive.namelist() if not name.startswith("binaries")])
    (tmp_path / "build").mkdir()
    build_platform_binary(folder, tmp_path / "build")
    after = fmpy.simulate_fmu(str(folder), fmi_type="CoSimulation", stop_time=1.0)
    for name in before.dtype.names:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-9, atol=1e-9)


@BOTH
@pytest.mark.parametrize("name", ["four_bar", "kinked"])
def test_fmu_states_saved_and_restored_give_the_same_steps_to_the_bit(fmus, fmi, name, tmp_path):
    """Of `kinked`, just before the time of the push, at the end of a step."""
    one, other = (Instance(fmus(fmi, name), fmi, tmp_path / str(k)) for k in range(2))
    one.begin()
    other.begin()
    one.step(0.0, 0.35)
    saved = one.fmu.getFMUState()
    text = one.fmu.serializeFMUState(saved)
    names = [*one.references]
    results = []

    def go_on(instance):
        before = instance.get(*names)
        for k in range(5):
            instance.step(0.35 + 0.1 * k, 0.1)
        results.append(np.array([before, instance.get(*names)]).tobytes())

    for _ in range(2):
        go_on(one)
        one.fmu.setFMUState(saved)
    restored = other.fmu.deserializeFMUState(text)
    other.fmu.setFMUState(restored)
    assert other.fmu.serializeFMUState(restored) == text
    go_on(other)
    assert len(set(results)) == 1
    one.fmu.freeFMUState(saved)


@BOTH
def test_fmu_states_of_other_models_or_damaged_ones_are_refused(fmus, fmi, tmp_path):
    instance, foreign = (Instance(fmus(fmi, name), fmi, tmp_path / name) for name in ("four_bar", "slider_crank"))
    texts = []
    for each in (instance, foreign):
        each.begin()
        saved = each.fmu.getFMUState()
        texts.append(bytes(each.fmu.serializeFMUState(saved)))
        each.fmu.freeFMUState(saved)
    whole, other = texts
    assert whole.startswith(b"fourbar state 2\0")
    generator = np.random.default_rng(0)
    damaged = []
    for _ in range(300):
        bytes_of = bytearray(whole)
        for place in generator.integers(len(whole), size=generator.integers(1, 4)):
            bytes_of[place] ^= int(generator.integers(1, 256))
        damaged += [bytes(bytes_of)] if bytes_of != whole else []
    cut = [whole[:n] for n in range(1, len(whole), 7)]
    noise = [generator.bytes(n) for n in (1, 15, 16, 60, len(whole), 50000)]
    cases = [
        (other, "one of another model"),
        (whole.replace(b"state 2", b"state 0"), "do not begin with"),
        (whole + b"\0", f"has {len(whole)} bytes, not {len(whole) + 1}"),
        (whole[:-1] + bytes([whole[-1] ^ 1]), "damaged"),
        *((text, "serialized state") for text in (*damaged, *cut, *noise)),
    ]
    for text, words in cases:
        instance.messages.clear()
        with pytest.raises(Exception, match="status 3"):
            instance.fmu.deserializeFMUState(text)
        assert words in instance.messages[-1]
    instance.step(0.0, 0.1)


@BOTH
def test_fmu_directional_derivatives_equal_the_models_jacobians(fmus, fmi, tmp_path, four_bar):
    instance = Instance(fmus(fmi), fmi, tmp_path)
    instance.begin(t=0.3)
    x = instance.get(*four_bar.states)
    knowns, unknowns = [*four_bar.states, "F"], [f"der({name})" for name in four_bar.states]
    seed = np.linspace(-1.0, 1.0, 7)

    def derivative(names):
        references = [[instance.references[n] for n in group] for group in (names, knowns)]
        return np.array(instance.fmu.getDirectionalDerivative(*references, [*seed]))

    r = four_bar.kernel.default_inputs(0.3)
    jacobian = np.hstack([four_bar.jacobian(0.3, x, None, r), four_bar.input_jacobian(0.3, x, None, r)])
    np.testing.assert_allclose(derivative(unknowns), jacobian @ seed, rtol=1e-10)
    h = 1e-6
    points = [
        four_bar.kernel.drawing(0.3, x + side * h * seed[:6], four_bar.kernel.parameter_vector(None), r)[0]
        for side in (-1, 1)
    ]
    expected = (points[1] - points[0])[four_bar.points.index("P44")] / (2 * h)
    np.testing.assert_allclose(derivative(["P44.x", "P44.y"]), expected[:2], rtol=0, atol=1e-8)


@BOTH
def test_fmu_with_start_values_closes_loops_and_holds_set_inputs(fmus, fmi, tmp_path, four_bar):
    instance = Instance(fmus(fmi), fmi, tmp_path)
    instance.begin(q1=-0.4, u1=0.2, l2=0.45)
    expected = four_bar.initial_state({"q1": -0.4}, {"u1": 0.2}, parameters={"l2": 0.45})
    np.testing.assert_allclose(instance.get(*four_bar.states), expected, rtol=0, atol=1e-12)
    # F follows 100 sin(pi t), until it is set.
    instance.step(0.0, 0.25)
    assert instance.get("F")[0] == pytest.approx(100 * np.sin(0.25 * np.pi), rel=1e-14)
    instance.set(F=3.0)
    x = instance.get(*four_bar.states)
    instance.step(0.25, 0.5)
    run = four_bar.simulate((0.25, 0.75), x, parameters={"l2": 0.45}, inputs={"F": 3.0}, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(instance.get(*four_bar.states), run.y[:, -1], rtol=0, atol=1e-7)
    assert instance.get("F")[0] == 3.0


def test_fmu_with_input_derivatives_steps_as_exactly_as_a_table(fmus, tmp_path, four_bar):
    """F = 30 t: with its derivative, steps of 0.1 s are as exact as one run with a table."""
    t = np.array([0.0, 1.0])
    run = four_bar.simulate((0.0, 1.0), inputs={"F": (t, 30.0 * t)}, rtol=1e-12, atol=1e-12)
    errors = []
    for slope in (30.0, 0.0):
        instance = Instance(fmus(2), 2, tmp_path / str(slope))
        instance.begin(tolerance=1e-10)
        for k in range(10):
            instance.set(F=3.0 * k)
            instance.fmu.setRealInputDerivatives([instance.references["F"]], [1], [slope])
            instance.step(0.1 * k, 0.1)
        errors.append(abs(instance.get("q1")[0] - run["q1"][-1]))
    assert errors[0] < 1e-9 < 1e-5 < errors[1]


@BOTH
def test_fmu_with_an_input_set_each_step_equals_a_held_table(fmus, fmi, tmp_path, four_bar):
    """A controller of 1 kHz beside the FMU, and its forces as a table in Python; each step is exact to 1e-13."""
    instance, times, forces, states = Instance(fmus(fmi), fmi, tmp_path), [], [], []
    instance.begin(tolerance=1e-13)
    for k in range(200):
        states.append(instance.get(*four_bar.states))
        times.append(1e-3 * k)
        forces.append(-50.0 * states[-1][3])
        instance.set(F=forces[-1])
        instance.step(times[-1], 1e-3)
    inputs = {"F": (times, forces, "hold")}
    run = four_bar.simulate((0.0, times[-1]), inputs=inputs, t_eval=times, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(run.y, np.transpose(states), rtol=0, atol=1e-12)


@BOTH
def test_fmu_calls_in_wrong_modes_or_with_wrong_values_are_refused(fmus, fmi, tmp_path):
    instance = Instance(fmus(fmi), fmi, tmp_path)

    def says(words, function, *arguments, status=3):
        instance.messages.clear()
        with pytest.raises(Exception, match=rf"status {status}"):
            function(*arguments)
        assert any(words in message for message in instance.messages), instance.messages

    says('in the state "instantiated"', instance.step, 0.0, 0.1)
    says('in the state "instantiated"', instance.fmu.exitInitializationMode)
    says("must not be called here", instance.fmu.terminate)
    instance.begin()
    getter = instance.fmu.getReal if fmi == 2 else instance.fmu.getFloat64
    says("no real variable with the value reference 12345", getter, [12345])
    says("cannot be set after initialization", lambda: instance.set(l2=0.4))
    says("cannot be set", lambda: instance.set(**{"kinetic energy": 1.0}))
    says("cannot be nan", lambda: instance.set(F=np.nan))
    says("the mechanism is at t = 0", instance.step, 0.5, 0.1)
    says("must be positive", instance.step, 0.0, -0.1)
    says("singular position", instance.step, 0.0, 6.0, status=2 if fmi == 2 else 3)  # discarded, in words of FMI 2
    again = Instance(fmus(fmi), fmi, tmp_path / "again")
    with pytest.raises(Exception, match=r"status 3"):
        again.begin(l2=9.0)
    assert "no state nearby satisfies the constraints" in again.messages[-1]


@BOTH
def test_fmu_initialization_keeps_guesses_and_gives_closed_derivatives(fmus, fmi, tmp_path, four_bar):
    """Reading changes nothing; guesses that were set before stay guesses; derivatives are those of closed loops."""
    instance = Instance(fmus(fmi), fmi, tmp_path)
    instance.fmu.setupExperiment(startTime=0.0, stopTime=1.0) if fmi == 2 else None
    instance.fmu.enterInitializationMode(**({} if fmi == 2 else {"startTime": 0.0, "stopTime": 1.0}))
    for angle in (0.2, -0.1, -0.5):
        instance.set(q1=angle)
        instance.get("q2")
    expected = four_bar.initial_state({"q1": -0.5})
    np.testing.assert_allclose(instance.get(*four_bar.coordinates), expected[:3], rtol=0, atol=1e-12)
    change = [four_bar.initial_state({"q1": -0.5 + h})[1] for h in (-1e-5, 1e-5)]
    slope = instance.fmu.getDirectionalDerivative([instance.references["q2"]], [instance.references["q1"]], [1.0])
    assert slope[0] == pytest.approx((change[1] - change[0]) / 2e-5, rel=1e-6)
    longer = [four_bar.initial_state({"q1": -0.5}, parameters={"l2": 0.5 + h})[1] for h in (-1e-5, 1e-5)]
    slope = instance.fmu.getDirectionalDerivative([instance.references["q2"]], [instance.references["l2"]], [1.0])
    assert slope[0] == pytest.approx((longer[1] - longer[0]) / 2e-5, rel=1e-6)
    instance.fmu.exitInitializationMode()
    with pytest.raises(Exception, match="status 3"):
        instance.step(0.0, 1.5)
    assert "after the stop time" in instance.messages[-1]


def test_fmu_of_a_drive_moves_only_if_its_rate_is_set(fmus, tmp_path):
    """Where the angle alone is set, the crank stands; with its rate it moves."""
    points = {"O": (0, 0), "A": (0.1, 0.05), "C": (0.4, 0)}
    linkage = fb.Linkage("geared", points=points, ground="O", links=["OA", "AC"], density=1.0)
    linkage.slider("C", along=(1, 0))
    linkage.drive("O", speed=10.0)
    path = str(fb.export_fmu(linkage.model(), tmp_path / "geared.fmu"))
    assert validate_fmu(path) == []
    model = fb.compile_model(linkage.model())
    [angle, rate, _] = model.inputs
    instance = Instance(path, 3, tmp_path / "one")
    instance.begin(**{angle: 0.3})
    assert instance.get(rate)[0] == 0.0
    np.testing.assert_allclose(instance.get(*model.speeds), 0.0, atol=1e-12)
    other = Instance(path, 3, tmp_path / "other")
    other.begin(**{angle: 0.3, rate: 2.0})
    assert np.abs(other.get(*model.speeds)).max() > 0.1


def test_fmu_of_a_motion_whose_rate_is_set_keeps_its_second_derivative(tmp_path):
    """-a w^2 sin(w t), of the expression, until that is set."""
    t, a, w = me.dynamicsymbols._t, *sm.symbols("a w")
    path = str(fb.export_fmu(driven_pendulum(a * sm.sin(w * t)), tmp_path / "driven.fmu"))
    instance = Instance(path, 3, tmp_path / "one")
    instance.begin(t=0.3, **{"s'": 2.0})
    assert instance.get("s'", "s''") == pytest.approx([2.0, -0.1 * 5.0**2 * np.sin(1.5)], rel=1e-14)


def test_fmu_export_needs_no_values_of_masses_that_drop_out(tmp_path):
    """Of a wheel on an axle, only the inertia about it counts."""
    wall, wheel = me.RigidBody("wall"), me.RigidBody("wheel")
    torque = me.dynamicsymbols("T")
    system = me.system.System.from_newtonian(wall)
    system.add_bodies(wheel)
    system.add_joints(me.PinJoint("axle", wall, wheel, joint_axis=wall.frame.z))
    system.add_actuators(me.TorqueActuator(torque, wall.frame.z, wheel.frame, wall.frame))
    system.form_eoms()
    model = fb.Model(system, name="wheel", parameters={"wheel_izz": 2.0}, inputs={torque: 3.0})
    instance = Instance(str(fb.export_fmu(model, tmp_path / "wheel.fmu")), 3, tmp_path / "a")
    instance.begin()
    assert instance.get("der(u_axle)")[0] == 1.5


def test_fmu_dependencies_of_states_name_no_inputs(fmus):
    """States are no functions of inputs, so that a controller of the speed is no algebraic loop."""
    description = fmpy.read_model_description(fmus(3, "slider_crank"))
    knowns = {u.variable.name: u.dependencies for u in description.outputs}
    assert [v.name for v in knowns["crank_rate"]] == ["crank_rate"]
    names = {v.name for v in knowns["kinetic energy"]}
    assert "torque" not in names
    assert "crank" in names
    assert knowns["pin_x"] is None  # a force depends on everything


@BOTH
def test_fmu_derivatives_name_their_states(fmus, fmi, four_bar):
    variables = fmpy.read_model_description(fmus(fmi)).modelVariables
    found = {variable.name: variable.derivative.name for variable in variables if variable.derivative}
    assert found == {f"der({name})": name for name in four_bar.states}


def test_fmu_inputs_start_with_their_expression_at_zero_or_without_one_as_zero(tmp_path):
    system, (given, free), double = _pushed(), me.dynamicsymbols("F G"), sm.Symbol("double")
    system.add_loads(me.Force(system.bodies[0].masscenter, free * system.frame.x))
    values = {"m": 2.0, double: 2 * sm.Symbol("m")}
    inputs = {given: double * sm.cos(me.dynamicsymbols._t), free: None}
    model = fb.Model(system, name="starting", parameters=values, inputs=inputs)
    variables = fmpy.read_model_description(str(fb.export_fmu(model, tmp_path / "starting.fmu"))).modelVariables
    assert {v.name: float(v.start) for v in variables if v.causality == "input"} == {"F": 4.0, "G": 0.0}


def test_fmu_input_that_nobody_sets_is_zero(tmp_path):
    bare = fb.Model(_pushed(), name="bare", parameters={"m": 2.0}, inputs="auto")
    path = str(fb.export_fmu(bare, tmp_path / "bare.fmu"))
    instance = Instance(path, 3, tmp_path / "a")
    instance.begin(u=1.0)
    assert instance.get("F")[0] == 0.0
    instance.step(0.0, 1.0)
    assert instance.get("q")[0] == pytest.approx(1.0, abs=1e-9)


def _pushed(mass="m", point="P"):
    """A mass on a line, pushed by F."""
    q, u, force = me.dynamicsymbols("q u F")
    system = me.system.System(me.ReferenceFrame("N"), me.Point("O"))
    point = me.Point(point)
    point.set_pos(system.fixed_point, q * system.frame.x)
    point.set_vel(system.frame, u * system.frame.x)
    system.fixed_point.set_vel(system.frame, 0)
    system.add_bodies(me.Particle("a", point, sm.Symbol(mass)))
    system.add_loads(me.Force(point, force * system.frame.x))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff(me.dynamicsymbols._t))
    return system


def test_fmu_values_after_an_event_are_those_after_the_jump(tmp_path):
    """F jumps to 1 at t = 0.3; the condition holds there still, but not after the event."""
    t, force = me.dynamicsymbols._t, me.dynamicsymbols("F")
    jump = sm.Piecewise((0, t <= sm.Rational(3, 10)), (1, True))
    model = fb.Model(_pushed(), name="pushed", parameters={"m": 1.0}, inputs={force: jump})
    path = str(fb.export_fmu(model, tmp_path / "pushed.fmu"))
    instance = Instance(path, 3, tmp_path / "a", MODEL)
    instance.begin()
    fmu = instance.fmu
    *_, has_next, next_time = fmu.updateDiscreteStates()
    assert has_next
    assert next_time == 0.3
    fmu.enterContinuousTimeMode()
    fmu.setTime(0.3)
    assert instance.get("der(u)")[0] == 0.0
    fmu.enterEventMode()
    fmu.updateDiscreteStates()
    fmu.enterContinuousTimeMode()
    assert instance.get("der(u)")[0] == 1.0


def test_fmu_output_that_is_infinite_is_returned_as_a_value(tmp_path):
    u = me.dynamicsymbols("u")
    model = fb.Model(_pushed(), name="slow", parameters={"m": 1.0}, inputs="auto", outputs={"slowness": 1 / u})
    instance = Instance(str(fb.export_fmu(model, tmp_path / "slow.fmu")), 3, tmp_path / "a")
    instance.begin()
    assert np.isinf(instance.get("slowness")[0])
    assert instance.get("der(u)")[0] == 0.0


def test_fmu_binary_with_the_description_of_another_model_is_refused(fmus, tmp_path):
    path = fmus(3)
    description = fmpy.read_model_description(path)
    messages = []
    fmu = FMU3Slave(
        guid="{another}",
        unzipDirectory=fmpy.extract(path, unzipdir=str(tmp_path)),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="a",
    )
    with pytest.raises(Exception, match=r"[Ii]nstantiate"):
        fmu.instantiate(logMessage=lambda *words: messages.append(words[-1]))
    assert b"of different models" in messages[0]


def test_fmu_kink_in_time_is_an_event_at_which_the_solver_stops(fmus):
    """The FMU names the time of the push; CVODE stops there."""
    found = fmpy.simulate_fmu(
        fmus(3, "kinked"), fmi_type="ModelExchange", stop_time=1.0, output_interval=0.1, relative_tolerance=1e-9
    )
    assert 0.35 in found["time"]
    expected = np.where(found["time"] > 0.35, (1 - np.cos(3 * (found["time"] - 0.35))) / 9, 0.0)
    np.testing.assert_allclose(found["q"], expected, rtol=0, atol=1e-7)


def test_fmu_exported_twice_is_the_same_to_the_byte(tmp_path):
    contents = []
    for name in ("one", "two"):
        path = fb.export_fmu(fb.models.slider_crank(), tmp_path / f"{name}.fmu")
        with zipfile.ZipFile(path) as archive:
            contents.append({name: archive.read(name) for name in archive.namelist()})
    assert contents[0] == contents[1]


def test_fmu_export_for_other_platforms_has_their_binaries(tmp_path):
    """By zig: a DLL that exports the functions of the standard, and an object for 64-bit ARM."""
    for target in ("x86_64-windows-gnu", "aarch64-linux-gnu.2.17"):
        prepare_zig(cross_compiler(target))
    path = fb.export_fmu(fb.models.slider_crank(), tmp_path / "a.fmu", platforms=["x86_64-windows", "aarch64-linux"])
    with zipfile.ZipFile(path) as archive:
        windows = archive.read("binaries/x86_64-windows/slider_crank.dll")
        arm = archive.read("binaries/aarch64-linux/slider_crank.so")
        assert f"binaries/{fmpy.platform_tuple}/slider_crank.so" in archive.namelist()
    assert windows[:2] == b"MZ"
    assert b"fmi3DoStep\0" in windows
    assert arm[:4] == b"\x7fELF"
    assert int.from_bytes(arm[18:20], "little") == 183  # EM_AARCH64


def test_fmu_export_without_values_or_to_wrong_paths_is_refused(tmp_path, monkeypatch):
    with pytest.raises(fb.ModelError, match="give m values"):
        fb.export_fmu(fb.Model(_pushed(), name="open", inputs="auto"), tmp_path / "a.fmu")
    (tmp_path / "folder.fmu").mkdir()
    with pytest.raises(fb.BuildError, match="cannot be written"):
        fb.export_fmu(fb.models.four_bar(), tmp_path / "folder.fmu")
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(fb.BuildError, match="no-such-compiler"):
        fb.export_fmu(fb.models.four_bar(), tmp_path / "b.fmu")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.fmu"]


def test_fmu_coupled_to_a_foreign_controller_moves_as_runs_in_python(fmus, tmp_path):
    """An FMU written by hand, which controls the speed, and the slider-crank: torque and speed are exchanged every
    millisecond, and the motion is that of runs in Python with the torque held."""
    folder = tmp_path / "controller"
    library = folder / "binaries" / fmpy.platform / f"controller{fmpy.sharedLibraryExtension}"
    library.parent.mkdir(parents=True)
    (tmp_path / "controller.c").write_text(CONTROLLER)
    subprocess.run([require("gcc"), "-shared", "-fPIC", tmp_path / "controller.c", "-o", library], check=True)
    (folder / "modelDescription.xml").write_text(DESCRIPTION)
    assert fmpy.read_model_description(str(folder)).coSimulation.modelIdentifier == "controller"
    controller = FMU2Slave(
        guid="{c}", unzipDirectory=str(folder), modelIdentifier="controller", instanceName="c", requireFunctions=False
    )
    controller.instantiate()
    engine = Instance(fmus(2, "slider_crank"), 2, tmp_path / "engine")
    engine.begin(crank=0.5, crank_rate=0.0, load=0.0)
    compiled = fb.compile_model(fb.models.slider_crank())
    x = compiled.initial_state({"crank": 0.5}, {"crank_rate": 0.0})
    for k in range(300):
        t = k * 1e-3
        controller.setReal([0], engine.get("crank_rate"))
        controller.doStep(currentCommunicationPoint=t, communicationStepSize=1e-3)
        engine.set(torque=controller.getReal([1])[0])
        engine.step(t, 1e-3)
        x = compiled.simulate(
            (t, t + 1e-3), x, inputs={"torque": 2.0 * (10.0 - x[3]), "load": 0.0}, rtol=1e-11, atol=1e-11
        ).y[:, -1]
    np.testing.assert_allclose(engine.get(*compiled.states), x, rtol=0, atol=1e-7)


DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="controller" guid="{c}">
  <CoSimulation modelIdentifier="controller"/>
  <ModelVariables>
    <ScalarVariable name="speed" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="torque" valueReference="1" causality="output"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2"/></Outputs></ModelStructure>
</fmiModelDescription>
"""

CONTROLLER = """
/* torque = 2 (10 - speed), sampled once a step; variables: 0 speed, 1 torque */
#define OTHER(name) int name(void) { return 3; }
OTHER(fmi2CancelStep) OTHER(fmi2CompletedIntegratorStep) OTHER(fmi2DeSerializeFMUstate)
OTHER(fmi2EnterContinuousTimeMode) OTHER(fmi2EnterEventMode) OTHER(fmi2EnterInitializationMode)
OTHER(fmi2ExitInitializationMode) OTHER(fmi2FreeFMUstate) OTHER(fmi2FreeInstance) OTHER(fmi2GetBoolean)
OTHER(fmi2GetBooleanStatus) OTHER(fmi2GetContinuousStates) OTHER(fmi2GetDerivatives)
OTHER(fmi2GetDirectionalDerivative) OTHER(fmi2GetEventIndicators) OTHER(fmi2GetFMUstate) OTHER(fmi2GetInteger)
OTHER(fmi2GetIntegerStatus) OTHER(fmi2GetNominalsOfContinuousStates) OTHER(fmi2GetRealOutputDerivatives)
OTHER(fmi2GetRealStatus) OTHER(fmi2GetStatus) OTHER(fmi2GetString) OTHER(fmi2GetStringStatus)
OTHER(fmi2NewDiscreteStates) OTHER(fmi2Reset) OTHER(fmi2SerializeFMUstate) OTHER(fmi2SerializedFMUstateSize)
OTHER(fmi2SetBoolean) OTHER(fmi2SetContinuousStates) OTHER(fmi2SetDebugLogging) OTHER(fmi2SetFMUstate)
OTHER(fmi2SetInteger) OTHER(fmi2SetRealInputDerivatives) OTHER(fmi2SetString) OTHER(fmi2SetTime)
OTHER(fmi2SetupExperiment) OTHER(fmi2Terminate)
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
static double speed, torque;
void *fmi2Instantiate(const char *n, int k, const char *g, const char *r, const void *f, int v, int l)
{
    (void)n, (void)k, (void)g, (void)r, (void)f, (void)v, (void)l;
    return &speed;
}
int fmi2SetReal(void *c, const unsigned v[], unsigned long n, const double x[])
{
    (void)c;
    if (n != 1 || v[0] != 0) return 3;
    speed = x[0];
    return 0;
}
int fmi2GetReal(void *c, const unsigned v[], unsigned long n, double x[])
{
    (void)c;
    if (n != 1 || v[0] > 1) return 3;
    x[0] = v[0] ? torque : speed;
    return 0;
}
int fmi2DoStep(void *c, double t, double h, int s)
{
    (void)c, (void)t, (void)h, (void)s;
    torque = 2.0 * (10.0 - speed);
    return 0;
}
"""


def test_fmu_export_of_two_variables_with_one_name_is_refused(tmp_path):
    u = me.dynamicsymbols("u")
    model = fb.Model(_pushed(), name="twice", parameters={"m": 1.0}, inputs="auto", outputs={"kinetic energy": u**2})
    with pytest.raises(fb.ModelError, match="two are called 'kinetic energy'"):
        fb.export_fmu(model, tmp_path / "twice.fmu")


def test_fmu_export_of_texts_that_xml_cannot_have_is_refused(tmp_path):
    """Refused with their place; all others are read back as they were (XML 1.0, https://www.w3.org/TR/xml/#charsets)."""

    def exported(name="m", unit="kg", description="", point="P"):
        mass = {name: fb.Parameter(1.0, unit, description)}
        model = fb.Model(_pushed(name, point), name="marked", parameters=mass, inputs="auto")
        return str(fb.export_fmu(model, tmp_path / "marked.fmu"))

    for letter in ("\x00", "\x0b", "\x1f", "\ufffe", "\uffff", "\ud800", "\udfff"):
        code = rf"U\+{ord(letter):04X}"
        with pytest.raises(fb.ModelError, match=f"description of 'm' has the character {code}"):
            exported(description=f"a{letter}b")
        with pytest.raises(fb.ModelError, match=f"unit of 'm' has the character {code}"):
            exported(unit=f"k{letter}g")
        with pytest.raises(fb.ModelError, match=f"name has the character {code}"):
            exported(point=f"B{letter}C")
    for letter in "\t\n\r":
        with pytest.raises(fb.ModelError, match="name has the character"):
            exported(point=f"B{letter}C")
        with pytest.raises(fb.ModelError, match="unit of 'm' has the character"):
            exported(unit=f"k{letter}g")
    assert not (tmp_path / "marked.fmu").exists()
    description, unit = "\"<one>\" & 'two',\tthree\r\nlines \x7f\x85\u2028\ud7ff\ue000\ufffd\U0001f9be", 'µg·<m>&"'
    path = exported(description=description, unit=unit, point="P₁ <μ>")
    assert validate_fmu(path) == []
    variables = {v.name: v for v in fmpy.read_model_description(path).modelVariables}
    assert (variables["m"].description, variables["m"].unit) == (description, unit)
    assert variables["P₁ <μ>.x"].unit == "m"
    assert "P₁ <μ>.x" in variables


def test_fmu_with_names_that_c_cannot_have_is_valid_and_runs(tmp_path):
    """A parameter is called μ, and the model as functions of its sources; x = t^2 / (2 μ) for F = 1."""
    model = fb.Model(_pushed("μ"), name="motion", parameters={"μ": 2.0}, inputs={"F": 1.0})
    path = str(fb.export_fmu(model, tmp_path / "motion.fmu"))
    assert validate_fmu(path) == []
    found = fmpy.simulate_fmu(path, stop_time=1.0, start_values={"μ": 4.0}, output=["q"])
    assert found["q"][-1] == pytest.approx(0.125, abs=1e-9)
    with pytest.raises(fb.ModelError, match="'fmu' is a name in C or of its library"):
        fb.export_fmu(fb.Model(_pushed(), name="fmu", parameters={"m": 2.0}, inputs="auto"), tmp_path / "fmu.fmu")
