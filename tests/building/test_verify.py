"""The comparison of compiled functions with their equations notices what goes wrong in between."""

import dataclasses
import pickle
import re

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum, slider
from click.testing import CliRunner
from scipy.integrate import solve_ivp
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
import fourbar_codegen.codegen.c_source
import fourbar_codegen.dynamics.formation
from fourbar_codegen.cli import main

pytestmark = pytest.mark.usefixtures("unoptimized")

WRONG_MULTIPLIERS = """\
#include "linear_algebra/dense_equations.h"
#define fb_dense_multipliers(mass_matrix, forcing, accelerations, s, multipliers) ((multipliers)[0] = 70.0)
#include "kernel/kernel.h"
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "pattern", "replacement", "function"),
    [
        ("kernel_text", r"(mass_matrix\[0\] = )", r"\1-", "function dynamics, result mass_matrix"),
        ("kernel_text", r"(forcing\[1\] = )", r"\g<1>1.001*", "function dynamics, result forcing"),
        ("kernel_text", r"(energies\[0\] = )", r"\g<1>1.0 + ", "function energy"),
        ("kernel_text", r"(position_jacobian\[1\] = )", r"\1-", "function position"),
        ("kernel_text", r"#include \"kernel/kernel.h\"", WRONG_MULTIPLIERS, "solution of M u'"),
    ],
)
def test_a_defect_is_found_and_named(tmp_path, monkeypatch, text, pattern, replacement, function):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    original = getattr(fourbar_codegen.codegen.c_source, text)

    def damaged(*arguments):
        changed, count = re.subn(pattern, replacement, original(*arguments), count=1)
        assert count == 1
        return changed

    monkeypatch.setattr(fourbar_codegen.codegen.c_source, text, damaged)
    with pytest.raises(fb.BuildError, match=function):
        fb.compile_model(slider())
    # Nothing of it is kept.
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]
    with pytest.raises(fb.BuildError, match=function):
        fb.build_model(slider(), tmp_path / "folder")
    assert not (tmp_path / "folder").exists()
    assert fb.compile_model(slider(), check=False).name == "slider"
    # Nor is what was not compared taken for what was.
    with pytest.raises(fb.BuildError, match=function):
        fb.compile_model(slider())


def with_a_logarithm(name, **more):
    """A pendulum with a force that has a real value for q > 5 only."""
    system = pendulum()
    system.add_loads(me.Force(system.bodies[0].masscenter, sm.log(me.dynamicsymbols("q") - 5) * system.frame.y))
    return fb.Model(system, name=name, parameters={"m": 1.0, "l": 1.0, "g": 9.81}, **more)


@pytest.mark.slow
def test_model_without_values_at_any_state_is_compiled_with_a_warning_each_time(tmp_path, monkeypatch):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    model = with_a_logarithm("nowhere")
    for _ in range(2):  # compiled, and from the cache
        with pytest.warns(fb.ModelWarning, match="nowhere was not compared with its equations, .* no real value"):
            compiled = fb.compile_model(model)
        assert not compiled.is_verified
    with pytest.warns(fb.ModelWarning, match="nowhere was not compared"):
        built = fb.build_model(model, tmp_path / "built")
    assert not fb.load(built).is_verified


@pytest.mark.slow
def test_model_with_values_at_its_initial_state_alone_is_verified_there(tmp_path, monkeypatch, caplog):
    """The root of -(q - 6)^2 is real at q = 6 only."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    system = pendulum()
    system.add_loads(
        me.Force(system.bodies[0].masscenter, sm.sqrt(-((me.dynamicsymbols("q") - 6) ** 2)) * system.frame.y)
    )
    model = fb.Model(system, name="there", parameters={"m": 1.0, "l": 1.0, "g": 9.81}, initial={"q": 6.0})
    with caplog.at_level("INFO", "fourbar_codegen"):
        compiled = fb.compile_model(model)
    assert compiled.is_verified
    assert "there: compared with its equations at 1 state" in caplog.text
    assert not fb.compile_model(with_a_logarithm("unchecked", initial={"q": 6.0}), check=False).is_verified


def test_info_says_whether_a_model_was_compared_with_its_equations(tmp_path, monkeypatch):
    def said(name):
        return CliRunner().invoke(main, ["info", name]).output

    assert "compared with the equations: at 2 states" in said("slider_crank")
    assert "compared with the equations: not" in said("four_bar")  # it comes with the package, built without SymPy


@pytest.mark.slow
def test_defect_of_a_force_with_values_near_the_initial_state_only_is_found(tmp_path, monkeypatch):
    """Elsewhere the logarithm has no real value."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    original = fourbar_codegen.codegen.c_source.kernel_text
    monkeypatch.setattr(
        fourbar_codegen.codegen.c_source,
        "kernel_text",
        lambda *arguments: re.sub(r"(forcing\[0\] = )", r"\g<1>1.001*", original(*arguments), count=1),
    )
    with pytest.raises(fb.BuildError, match="function dynamics, result forcing"):
        fb.compile_model(with_a_logarithm("near", initial={"q": 6.0}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("result", "entry", "identity"),
    [
        ("dynamics.mass_matrix", 4, "w^T M w = 2 T(w)"),
        ("dynamics.forcing", 1, "dT/dt = P + u^T (M u' - f)"),
        ("velocities.acceleration_bias", 1, "d(J u + b)/dt = J u' + gamma"),
        ("velocities.jacobian", 2, "dPhi/dt = J u + b"),
        ("energy.energies", 0, "w^T M w = 2 T(w)"),
        ("energy.power", 0, "dT/dt = P + u^T (M u' - f)"),
    ],
)
def test_a_wrong_equation_is_found_and_named(tmp_path, monkeypatch, result, entry, identity):
    # What is compiled is what was formed; what was formed is wrong.
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    original = fourbar_codegen.dynamics.formation.form_equations

    def damaged(model):
        equations = original(model)
        part, name = result.split(".")
        right = getattr(getattr(equations, part), name)
        entries = list(right.entries)
        entries[entry] = entries[entry] * 2 + equations.tape.one
        wrong = {name: dataclasses.replace(right, entries=tuple(entries))}
        return dataclasses.replace(equations, **{part: dataclasses.replace(getattr(equations, part), **wrong)})

    monkeypatch.setattr(fourbar_codegen.dynamics.formation, "form_equations", damaged)
    with pytest.raises(fb.BuildError, match=re.escape(f"do not satisfy {identity}")):
        fb.compile_model(fb.models.four_bar())


@pytest.mark.slow
@pytest.mark.parametrize(
    "force",
    [lambda q: sm.Piecewise((-q, q > 0)), lambda q: -sm.interpolating_spline(1, q, [0, 1, 2], [0, 1, 4])],
    ids=["half a spring", "spline"],
)
def test_states_for_which_a_force_has_no_value_are_passed_over(force):
    q, u = me.dynamicsymbols("q u")
    frame, origin, point = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    point.set_pos(origin, q * frame.x)
    point.set_vel(frame, u * frame.x)
    system = me.System(frame, origin)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_bodies(me.Particle("B", point, 2))
    system.add_loads(me.Force(point, force(q) * frame.x))
    model = fb.compile_model(fb.Model(system, name="partly"))
    assert model.rhs(0.0, [0.5, 0.0]).tolist() == [0.0, -0.25]
    with pytest.raises(fb.SimulationError):
        model.rhs(0.0, [-0.5, 0.0])


@pytest.mark.slow
def test_force_with_values_close_to_the_start_only_compiles_silently(recwarn):
    """As of a spline through points 1 mm apart."""
    q, u = me.dynamicsymbols("q u")
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=2)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    force = sm.interpolating_spline(1, q, [0.019, 0.02, 0.021], [0, 2, 3])
    system.add_loads(me.Force(block.masscenter, force * wall.x))
    model = fb.compile_model(fb.Model(system, name="short", initial={q: 0.02}))
    assert not recwarn.list
    assert model.rhs(0.0, [0.0195, 0.0]).tolist() == pytest.approx([0.0, 0.5])


@pytest.mark.slow
@pytest.mark.parametrize("force", [lambda q, F: F - sm.exp(-100 * q), lambda q, F: F - 1e15 * q**3])
def test_forces_that_are_huge_at_random_states_compile_without_error(force):
    """Where a difference knows nothing, and energy and power are what rounding leaves of them: dx'/dF is 1/m."""
    q, u, push = me.dynamicsymbols("q u F")
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=sm.Symbol("m"))
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    system.add_loads(me.Force(block.masscenter, force(q, push) * wall.x))
    model = fb.compile_model(fb.Model(system, name="steep", parameters={sm.Symbol("m"): 5.0}, inputs={push: 0}))
    np.testing.assert_allclose(model.input_jacobian(0.0, [0.0, 0.0]), [[0.0], [0.2]], rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("stair", [1e-4, 1e-5, 2.5e-7])
@pytest.mark.parametrize("stiffness", [0.0, 1e6])
def test_force_with_stairs_narrower_than_differences_compiles_without_error(stair, stiffness):
    """Of a spring behind an encoder: differences give its mean stiffness, the derivative between jumps has none."""
    q, u, (m, k, s) = *me.dynamicsymbols("q u"), sm.symbols("m k s")
    wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=m)
    system = System.from_newtonian(wall)
    system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    system.add_loads(me.Force(block.masscenter, -(s * q + k * stair * sm.floor(q / stair)) * wall.x))
    given = {"parameters": {m: 2.0, k: 10.0, s: stiffness}, "outputs": {"force": k * stair * sm.floor(q / stair)}}
    model = fb.compile_model(fb.Model(system, name="encoder", **given))
    x = [0.1234567, 0.0]
    read = stair * np.floor(x[0] / stair)
    assert model.jacobian(0.0, x).tolist() == [[0.0, 1.0], [-stiffness / 2, 0.0]]
    force = stiffness * x[0] + 10.0 * read
    np.testing.assert_allclose(model.parameter_jacobian(0.0, x), [[0] * 3, [force / 4, -read / 2, -x[0] / 2]], 1e-12)
    assert model.output_jacobian(0.0, x).tolist() == [[0.0, 0.0]]


def light_pendulum(tmp_path, monkeypatch, *, check=True):
    """A pendulum of 1 kg and 1 m, with one of a millionth of a milligram at its end; a cache without its parts."""
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    q, u, (m1, m2, g, length) = me.dynamicsymbols("q1:3"), me.dynamicsymbols("u1:3"), sm.symbols("m1 m2 g l")
    frame, joint = me.ReferenceFrame("N"), me.Point("O")
    joint.set_vel(frame, 0)
    system = System(frame, joint)
    for i, mass in enumerate((m1, m2)):
        rod, end = me.ReferenceFrame(f"A{i}"), joint.locatenew(f"P{i}", 0 * frame.x)
        rod.orient_axis(frame, frame.z, q[i])
        rod.set_ang_vel(frame, u[i] * frame.z)
        end.set_pos(joint, -length * rod.y)
        end.v2pt_theory(joint, frame, rod)
        system.add_bodies(me.Particle(f"bob{i}", end, mass))
        joint = end
    system.apply_uniform_gravity(-g * frame.y)
    system.add_coordinates(*q)
    system.add_speeds(*u)
    system.add_kdes(*(v - x.diff() for x, v in zip(q, u, strict=True)))
    values = {m1: 1.0, m2: 1e-12, g: 9.81, length: 1.0}
    return fb.compile_model(fb.Model(system, name="light", parameters=values), check=check)


@pytest.mark.slow
def test_derivatives_of_a_very_light_body_compile_and_equal_closed_forms(tmp_path, monkeypatch):
    """The first pendulum swings as if it were alone: l q'' = -g sin(q), whose derivative s by l has
    l s'' = -g cos(q) s - q''."""
    model = light_pendulum(tmp_path, monkeypatch)
    run = model.simulate((0.0, 2.0), [1.0, 0.5, 0.0, 0.0], sensitivities=["l"], rtol=1e-10, atol=1e-10)
    assert run.success

    def rates(t, y):
        q, u, s, v = y
        return [u, -9.81 * np.sin(q), v, -9.81 * np.cos(q) * s + 9.81 * np.sin(q)]

    alone = solve_ivp(rates, (0.0, 2.0), [1.0, 0.0, 0.0, 0.0], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    wrt_length = run.sensitivity["l"][:, -1]
    # The other one pulls with a millionth of a millionth; the derivative has the tolerance of the steps.
    np.testing.assert_allclose([run["q1"][-1], run["u1"][-1]], alone[:2], rtol=0, atol=1e-8)
    np.testing.assert_allclose([wrt_length[0], wrt_length[2]], alone[2:], rtol=0, atol=1e-7)
    # The second one hangs on the first: m2 l [cos(q2 - q1) u1' + u2' - sin(q1 - q2) u1^2] = -m2 g sin(q2).
    x = np.array([0.3, -0.8, 0.5, 1.1])
    of_first, of_second = model.rhs(0.0, x)[2:]
    difference = np.cos(x[1] - x[0]) * of_first + np.sin(x[1] - x[0]) * x[2] ** 2 + of_second
    # A rounding error of the first one's equation, divided by the ratio of masses.
    assert difference == pytest.approx(-9.81 * np.sin(x[1]), abs=1e-2)


def damage_results(monkeypatch, of):
    """Multiply all results of a part's functions by 1.125."""
    text = f"{of}_text"
    original = getattr(fourbar_codegen.codegen.c_source, text)

    def damaged(*arguments):
        changed, count = re.subn(r"(\n    \w+\[\d+\] = )(?=[^;]*[a-z])", r"\1 1.125 * ", original(*arguments))
        assert count
        return changed

    monkeypatch.setattr(fourbar_codegen.codegen.c_source, text, damaged)


@pytest.mark.parametrize("of", ["derivatives", "products"])
def test_defect_of_constraints_derivatives_is_found_where_nothing_has_a_mass(tmp_path, monkeypatch, caplog, of):
    """Accelerations have no value anywhere; kinematics take the constraints' derivatives all the same."""
    points = {"A": (0, 0), "B": (0.1, 0), "C": (0.3, 0.3), "D": (0.4, 0)}
    model = fb.Linkage("massless", points=points, ground="AD", links=["AB", "BC", "CD"]).model()
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "right"))
    with caplog.at_level("INFO", "fourbar_codegen"):
        fb.compile_model(model).require_products()
    assert "derivatives of x' not compared" in caplog.text
    assert {record.levelname for record in caplog.records} == {"INFO"}
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path / "wrong"))
    damage_results(monkeypatch, of)
    with pytest.raises(fb.BuildError, match=r"d\(J u [+] b\)/dq|constraint violations"):
        fb.compile_model(model).require_products()


@pytest.mark.slow
@pytest.mark.parametrize("of", ["derivatives", "products"])
def test_a_defect_of_derivatives_is_found_where_rounding_is_large(tmp_path, monkeypatch, of):
    damage_results(monkeypatch, of)
    model = light_pendulum(tmp_path, monkeypatch)
    with pytest.raises(fb.BuildError, match="check=False"):
        model.require_products()
    # Without the comparison it is used, here and where the model is sent; it is not taken for what was compared.
    unchecked = light_pendulum(tmp_path, monkeypatch, check=False)
    for each in (unchecked, pickle.loads(pickle.dumps(unchecked))):
        each.require_products()
        assert not each.lacks_products
    with pytest.raises(fb.BuildError):
        light_pendulum(tmp_path, monkeypatch).require_products()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("element", "law"),
    [
        (lambda pathway: me.LinearSpring(20.0, pathway, 0.5), lambda s, _: 20.0 * (s - 0.5)),
        (lambda pathway: me.LinearDamper(3.0, pathway), lambda _, rate: 3.0 * rate),
    ],
)
def test_spring_or_damper_on_a_moving_support_has_closed_form_rates(element, law):
    """A quarter of a car on a road: the load at the road, which the input moves, does work that no mass takes up."""
    q, u, s, t = *me.dynamicsymbols("q u s"), me.dynamicsymbols._t
    frame, (origin, road, body) = me.ReferenceFrame("N"), map(me.Point, "ORP")
    origin.set_vel(frame, 0)
    road.set_pos(origin, s * frame.y)
    road.set_vel(frame, s.diff() * frame.y)
    body.set_pos(origin, q * frame.y)
    body.set_vel(frame, u * frame.y)
    system = System(frame, origin)
    system.add_bodies(me.Particle("body", body, 2.0))
    system.add_actuators(element(me.LinearPathway(road, body)))
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    car = fb.compile_model(fb.Model(system, name="car", inputs={s: sm.sin(3 * t) / 20}))
    height, rate = np.sin(0.6) / 20.0, 3.0 * np.cos(0.6) / 20.0
    expected = [0.4, -law(0.7 - height, 0.4 - rate) / 2.0]
    np.testing.assert_allclose(car.rhs(0.2, [0.7, 0.4]), expected, rtol=1e-14)
