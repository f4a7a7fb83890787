"""Messages that lead on: what they name, and that what they advise works."""

import functools
import json
import re
import warnings

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def test_message_at_a_singular_position_gives_options_that_pass_it(four_bar):
    """The tutorial's linkage comes to its singular position at t = 5.34 s."""
    run = four_bar.simulate((0.0, 6.0))
    assert not run.success
    method, max_step = re.search(r"method=fb.(\w+)\(step=(\S+)\) passes", run.message).groups()
    assert f"--method {method} --max-step {max_step}" in run.message
    on = four_bar.simulate((0.0, 6.0), method=method, max_step=float(max_step))
    assert on.success
    assert on.t[-1] == 6.0
    # Before it, both are the same motion; ALI3P is of second order, with steps of 1 ms.
    before = run.t < 5.0
    np.testing.assert_allclose(on.resample(run.t[before]).y[:3], run.y[:3, before], rtol=0, atol=1e-2)


def test_message_of_a_step_that_shrinks_to_nothing_asks_for_jumps():
    """A torque that grows beyond all bounds at t = 5 s."""
    system = pendulum()
    T = me.dynamicsymbols("T")
    system.add_loads(me.Torque(system.bodies[0].masscenter.pos_from(system.fixed_point).args[0][1], T * system.frame.z))
    model = fb.Model(system, name="pushed", parameters={"m": 1.0, "g": 9.81, "l": 2.0}, inputs={"T": 0})
    run = fb.compile_model(model).simulate((0.0, 10.0), [0.1, 0.0], inputs={"T": lambda t, _: 1.0 / (5.0 - t) ** 2})
    assert not run.success
    assert "discontinuous there?" in run.message
    assert "CompiledModel.stepper" in run.message


@pytest.mark.parametrize("function", [lambda t: t, lambda: 1.0, lambda t, x, u: t])
def test_callables_with_other_arguments_than_time_and_state_are_refused(four_bar, function):
    with pytest.raises(fb.ModelError, match=r"input F is called with \(t, x\).*its arguments are \("):
        four_bar.simulate((0.0, 0.1), inputs={"F": function})
    with pytest.raises(fb.ModelError, match=r"An event is called with \(t, x\)"):
        four_bar.simulate((0.0, 0.1), events=function)


def test_model_with_names_for_symbols_equals_the_one_with_symbols():
    F = me.dynamicsymbols("F")
    symbols = {symbol.name: symbol for symbol in sm.symbols("m g l")}
    values, states = {"m": 1, "g": 9.81, "l": 2 * symbols["g"]}, {"q": 1, "u": 2}
    system = pendulum(mass=symbols["m"] * (2 + F))
    by_name = fb.Model(system, parameters=values, inputs={"F": 3}, initial=states)
    by_symbol = fb.Model(
        system,
        parameters={symbols[name]: value for name, value in values.items()},
        inputs={F: 3},
        initial={me.dynamicsymbols(name): value for name, value in states.items()},
    )
    own = sm.Symbol("a", positive=True)  # in the expression of a parameter alone
    derived = fb.Model(pendulum(), parameters={"m": own**2, "a": 2.0, "g": 9.81, "l": 1.0})
    assert derived.parameters["a"].value == 2.0
    for name in ("initial", "input_expressions", "parameters", "derived_parameters"):
        assert getattr(by_symbol, name) == getattr(by_name, name)


def test_message_of_an_inconsistent_state_names_the_violated_constraints(four_bar):
    x0 = four_bar.initial_state()
    with pytest.raises(fb.ModelError, match=r"constraints on positions: the nearest consistent state differs by 0\.1"):
        four_bar.simulate((0.0, 0.1), np.add(x0, [0.2, 0, 0, 0, 0, 0]))
    with pytest.raises(fb.ModelError, match=r"constraints on velocities \(those on positions are satisfied\)"):
        four_bar.simulate((0.0, 0.1), np.add(x0, [0, 0, 0, 0, 1.0, 0]))
    with pytest.raises(fb.ModelError, match=r"at t = 0: Phi\(q, t\) = \[.*\] for q1 = -0\.3, .* for u1 = -0\.1, "):
        four_bar.linearize(0.0, np.add(x0, [0.2, 0, 0, 0, 0, 0]))


def test_message_of_speeds_that_do_not_fit_a_tables_slope_names_the_slope():
    """A slider at x = s(t): at rest it does not fit a table that begins with a slope."""
    x, v, s = me.dynamicsymbols("x v s")
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=1)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, x, v))
    system.add_holonomic_constraints(x - s)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [], [x], [], [v]
    slider = fb.compile_model(fb.Model(system, name="slider", inputs={s: 0}))
    table = ([0.0, 1.0, 2.0], [0.0, 3.0, 4.0])
    with pytest.raises(fb.ModelError, match=r"on velocities.*motion has s' = \S+ \(the slope of its table\)"):
        slider.simulate((0.0, 1.0), [0.0, 0.0], inputs={"s": table})
    run = slider.simulate((0.0, 1.0), slider.initial_state(inputs={"s": table}), inputs={"s": table})
    assert run["x"][-1] == pytest.approx(3.0)
    with pytest.raises(fb.ModelError, match=r"on positions: .*At t = 0 the prescribed motion has s = 0, which"):
        slider.simulate((0.0, 1.0), [1.0, 0.0], inputs={"s": ([0.0, 1.0], [0.0, 0.0])})


@pytest.mark.parametrize("steepness", [sm.Symbol("k"), 1, sm.Rational(9, 10)])
def test_coordinate_along_a_wire_does_not_count_as_an_angle(steepness):
    """A bead on a wire y = a sin(k x): x is in metres."""
    x, u, a = *me.dynamicsymbols("x u"), sm.Symbol("a")
    ground, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(ground, 0)
    bead = origin.locatenew("P", x * ground.x + a * sm.sin(steepness * x) * ground.y)
    bead.set_vel(ground, u * ground.x + a * steepness * sm.cos(steepness * x) * u * ground.y)
    system = System(ground, origin)
    system.add_bodies(me.Particle("bead", bead, 1))
    system.add_coordinates(x)
    system.add_speeds(u)
    system.add_kdes(u - x.diff())
    model = fb.Model(system, parameters={"a": 0.3, "k": 2.0}, name="wire", extra="ignore")
    assert json.loads(fb.generate_sources(model)["manifest.json"])["angles"] == []


X, RATE, TILT, HEIGHT, ARM = *me.dynamicsymbols("x u"), *sm.symbols("alpha a r")
PLACES = {
    "twice": (2 * X, HEIGHT * sm.sin(X)),
    "inclined": (
        X * sm.cos(TILT) - HEIGHT * sm.sin(X) * sm.sin(TILT),
        X * sm.sin(TILT) + HEIGHT * sm.sin(X) * sm.cos(TILT),
    ),
    "cycloid": (X - sm.sin(X), 1 - sm.cos(X)),
    "spiral": (X * sm.cos(X), X * sm.sin(X)),
    "circle": (ARM * sm.cos(X), ARM * sm.sin(X)),
    "eight": (ARM * sm.cos(X), ARM * sm.sin(X) * sm.cos(X)),
}
"""Places (x, y) that a coordinate tells."""


@pytest.mark.slow(but=["circle-False", "twice-True", "circle-True"])
@pytest.mark.parametrize("has_positions", [True, False])
@pytest.mark.parametrize("name", PLACES)
def test_coordinate_counts_as_an_angle_only_if_its_point_returns_after_a_turn(name, has_positions):
    """As positions tell, or, in a KanesMethod without them, the velocities."""
    ground, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(ground, 0)
    across, along = PLACES[name]
    if has_positions:
        point.set_pos(origin, across * ground.x + along * ground.y)
    else:
        point.set_vel(ground, across.diff(X) * RATE * ground.x + along.diff(X) * RATE * ground.y)
    bodies, equations = [me.Particle("P", point, sm.Symbol("m"))], [RATE - X.diff()]
    if has_positions:
        method = System(ground, origin)
        method.add_bodies(*bodies)
        method.add_coordinates(X)
        method.add_speeds(RATE)
        method.add_kdes(*equations)
    else:
        method = me.KanesMethod(ground, [X], [RATE], kd_eqs=equations, bodies=bodies, forcelist=[])
    values = {"m": 1.0, "alpha": 0.2, "a": 0.1, "r": 0.5}
    model = fb.Model(method, name=name, parameters=values, extra="ignore")
    expected = ["x"] if name in {"circle", "eight"} else []
    assert json.loads(fb.generate_sources(model)["manifest.json"])["angles"] == expected


@pytest.mark.parametrize(("turn", "expected"), [(X, ["x"]), (sm.atan(HEIGHT * sm.cos(X)), [])])
@pytest.mark.parametrize("radius", [1, ARM])
def test_coordinate_of_a_rolling_wheel_counts_as_an_angle_and_of_a_wave_not(turn, expected, radius):
    """A wheel that rolls, whose angle it is, and a carriage along the tangent of a wave."""
    ground, frame, origin, point = *map(me.ReferenceFrame, "NB"), me.Point("O"), me.Point("P")
    frame.orient_axis(ground, ground.z, turn)
    point.set_pos(origin, radius * X * ground.x)
    system = System(ground, origin)
    end = point.locatenew("E", ARM * frame.x)
    system.add_bodies(me.RigidBody("body", end, frame, 1, (me.inertia(frame, 1, 1, 2), end)))
    system.add_coordinates(X)
    system.add_speeds(RATE)
    system.add_kdes(RATE - X.diff())
    model = fb.Model(system, name="rolling", parameters={"a": 0.1, "r": 0.5}, extra="ignore")
    assert json.loads(fb.generate_sources(model)["manifest.json"])["angles"] == expected


def test_initial_angles_that_look_like_degrees_give_a_warning():
    arm = fb.compile_model(fb.Model(pendulum(), parameters={"m": 1.0, "g": 9.81, "l": 2.0}, name="arm"))
    assert arm.manifest["angles"] == ["q"]
    with pytest.warns(fb.ModelWarning, match=r"q = 30 rad is more than a turn.*30 degrees are meant, give 0\.523599"):
        arm.initial_state({"q": 30}, [0.0])
    disc = fb.compile_model(fb.models.rolling_disc())
    assert set(disc.manifest["angles"]) <= {"q1", "q2", "q3"}  # q4 and q5 are displacements
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        arm.initial_state({"q": 7.123}, [0.0])  # a wheel that has turned
        arm.initial_state({"q": 3}, [0.0])


def test_resampling_a_run_with_samples_too_far_apart_gives_a_warning(four_bar):
    """With 9 times in 4 s, cubic polynomials err by 0.026 rad in q1, of 1.8; with 33 by 1e-4."""
    exact = four_bar.simulate((0.0, 4.0), rtol=1e-12, atol=1e-12, dense_output=True)
    times = np.linspace(0.0, 4.0, 1001)
    coarse = four_bar.simulate((0.0, 4.0), t_eval=np.linspace(0.0, 4.0, 9), rtol=1e-9, atol=1e-9)
    with pytest.warns(fb.ModelWarning, match=r"up to 0\.5 s apart. Between them u3 is interpolated with errors"):
        shown = coarse.resample(times)
    assert 0.01 < np.abs(shown["q1"] - exact.sol(times)[0]).max() < 0.05
    fine = four_bar.simulate((0.0, 4.0), t_eval=np.linspace(0.0, 4.0, 33), rtol=1e-9, atol=1e-9)
    assert np.abs(fine.resample(times)["q1"] - exact.sol(times)[0]).max() < 1e-3


def test_callables_with_wrapped_or_unknown_signatures_are_called_as_given(four_bar):
    """Not as the functions that they wrap; and what has no signature is left to its call."""

    def force(t):
        return 3.0 * t

    @functools.wraps(force)
    def adapter(t, x):
        return force(t)

    class Odd:
        def __call__(self, t, x):
            return 3.0 * t

        def __getattr__(self, name):
            raise RuntimeError(name)

    ends = [four_bar.simulate((0.0, 0.5), inputs={"F": given}).y[:, -1] for given in (adapter, Odd())]
    np.testing.assert_array_equal(*ends)


def test_build_error_shows_the_compilers_output_before_its_command():
    error = fb.BuildError("gcc refused it.", command=["gcc", "-O2"], exit_code=1, output="x.c:1: error: y")
    assert str(error).splitlines() == ["gcc refused it.", "x.c:1: error: y", "exit code: 1", "command: gcc -O2"]
