"""Models that are wrong, or cannot be compiled, get an error that names what is wrong and says what is allowed."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from sympy.physics.mechanics.system import System
from sympy.physics.units import meter

import fourbar_codegen as fb

pytestmark = pytest.mark.usefixtures("unoptimized")


def test_initial_state_of_a_loop_that_cannot_close_names_its_constraints(four_bar):
    with pytest.raises(
        fb.AssemblyError, match=r"cannot be closed .* constraints 1, 2, to be closed by q2, q3, stay open by"
    ) as caught:
        four_bar.initial_state(parameters={"l2": 5.0})
    # Links 1, 3 and 4 reach 2.5 m at most: a gap of 2.5 m remains whatever the angles, q1 = -0.5 given more.
    assert np.linalg.norm(caught.value.residual) > 2.5


q, u = me.dynamicsymbols("q u")
F = me.dynamicsymbols("F")
t = me.dynamicsymbols._t
m, g, length = sm.symbols("m g l")


class custom(sm.Function):
    """A function that SymPy does not come with."""


def constrained(expr):
    system = with_constraint(expr)
    system.q_ind, system.q_dep, system.u_ind, system.u_dep = [], [q], [], [u]
    return system


def with_constraint(expr):
    system = pendulum()
    system.add_holonomic_constraints(expr)
    return system


def test_initial_state_that_closes_from_another_guess_names_that_guess():
    # One real root, -2.104, and a local minimum at 1, where a search from 2 ends.
    trap = fb.compile_model(fb.Model(constrained(q**3 - 3 * q + 3), parameters={m: 1.0, g: 9.81, length: 1.0}))
    with pytest.raises(fb.AssemblyError, match="close from other guesses") as caught:
        trap.initial_state(guess=[2.0])
    text = str(caught.value).split("guess=[")[1].split("]")[0]
    closed = trap.initial_state(guess=[float(text)])
    assert closed[0] == pytest.approx(-2.1038034027355366, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fb.Model("system"), ["System", "str"]),
        (lambda: fb.Model(System()), ["no generalized speeds", "no bodies"]),
        (
            lambda: fb.Model(with_constraint(q)),
            ["1 holonomic constraints", "0 dependent coordinates", "0 dependent speeds"],
        ),
        (lambda: fb.Model(pendulum(**{"no orientation": True})), ["B", "not oriented"]),
        (lambda: fb.Model(pendulum(**{"no velocity": True})), ["velocity of point P", "N"]),
        (lambda: fb.Model(pendulum(mass=F)), ["F(t)", "mass of body bob", "inputs"]),
        (lambda: fb.Model(pendulum(mass=F.diff(t, 2)), inputs={F: 1}), ["F(t)", "mass of body bob", "rates"]),
        (lambda: fb.Model(pendulum(mass=F.diff(t, 3)), inputs={F: 1}), ["F(t)", "mass of body bob", "derivatives"]),
        (lambda: fb.Model(pendulum(), parameters={m: sm.Symbol("a"), sm.Symbol("a"): m}), ["a", "of each other"]),
        (lambda: fb.Model(pendulum(), outputs={"q": q}), ["q", "more than one"]),
        (lambda: fb.Model(pendulum(), outputs={"tension": fb.multiplier(1)}), ["multiplier(1)", "output tension"]),
        (lambda: fb.Model(pendulum(), outputs=5), ["outputs=", "5"]),
        (lambda: fb.Model(constrained(q), outputs={"force": fb.multiplier(2)}), ["multiplier(2)", "1 constraints"]),
        (lambda: fb.Model(pendulum(), parameters={m: 1 + q}), ["parameter m", "parameters only"]),
        (lambda: fb.Model(pendulum(), parameters={m: sm.Symbol("a") > g}), ["parameter m"]),
        (lambda: fb.Model(pendulum(), parameters={"M": 1}), ["do not appear", "M (the nearest is m)"]),
        (lambda: fb.Model(pendulum(), parameters={"m": 1, m: 2}), ["two values of m"]),
        (lambda: fb.Model(pendulum(), initial={"phi": 1}), ["phi", "'q', 'u'"]),
        (
            lambda: fb.generate_sources(fb.Model(pendulum(mass=F), inputs={F: sm.floor(t)})),
            ["F", "derivatives", "floor"],
        ),
        (lambda: fb.build_wheel(fb.Model(pendulum(), name="json"), "."), ["'json'", "another name"]),
        (lambda: fb.Model(pendulum(mass=u.diff(t))), ["Derivative(u(t), t)", "mass of body bob"]),
        (lambda: fb.Model(pendulum(mass=sm.Symbol("q"))), ["q", "more than one"]),
        (
            lambda: fb.Model(pendulum(), parameters={sm.Symbol("m_"): 1.0, sm.Symbol("gg"): 1.0}),
            ["m_ (the nearest is m), gg (the nearest is g)", "extra='ignore'"],
        ),
        (
            lambda: fb.Model(pendulum(), parameters={sm.Symbol("m", positive=True): 1.0}, extra="ignore"),
            ["Symbol('m') in the model", "Symbol('m', positive=True)"],
        ),
        (
            lambda: fb.Model(pendulum(mass=F), inputs={F: 0, me.dynamicsymbols("FF"): 0}),
            ["inputs do not appear in the model: FF (the nearest is F)", "extra='ignore'"],
        ),
        (
            lambda: fb.Model(pendulum(mass=F), inputs={me.dynamicsymbols("F", real=True): 0}, extra="ignore"),
            ["F has other assumptions in inputs="],
        ),
        (lambda: fb.Model(pendulum(), extra="keep"), ["'ignore'", "'keep'"]),
        (
            lambda: fb.Model(pendulum(mass=F + me.dynamicsymbols("G"))),
            ["F(t) in the mass", "G(t) in the mass", "'auto'"],
        ),
        (lambda: fb.Model(pendulum(mass=F), inputs="all"), ["inputs=", "'all'"]),
        (lambda: fb.Model(pendulum(), parameters={m: "heavy"}), ["'heavy'"]),
        (lambda: fb.Model(pendulum(), parameters={m: np.inf}), ["finite"]),
        (lambda: fb.Model(pendulum(), initial={F: 1.0}), ["F(t)", "'q', 'u'"]),
        (lambda: fb.Model(constrained(q), initial={q: 0.1, u: np.nan}), ["initial u", "finite"]),
        (lambda: fb.Model(pendulum(), name="my model"), ["'my model'", "underscores"]),
        (lambda: fb.Model(pendulum(), name="import"), ["'import'"]),
        (lambda: fb.Model(pendulum(), name="fb"), ["'fb'"]),
        (lambda: fb.Model(pendulum(), name=5), ["5"]),
        (lambda: fb.Model(pendulum(), parameters=5), ["parameters=", "5"]),
        (lambda: fb.Model(pendulum(mass=F), inputs={"G": 1, "F": 2}), ["inputs do not appear", "G (the nearest is F)"]),
        (lambda: fb.Model(pendulum(mass=F), inputs={F: "a"}), ["F(t)", "'a'"]),
        (lambda: fb.Model(pendulum(mass=F), inputs={F: sm.I}), ["F(t)", "real"]),
        (lambda: fb.Model(pendulum(mass=F), inputs={F: q.diff(t)}), ["input F", "time and parameters"]),
        (lambda: fb.Model(pendulum(), potential_energy="a"), ["potential_energy", "'a'"]),
        (lambda: fb.Model(pendulum(mass=sm.Symbol("kinetic_energy"))), ["columns", "kinetic_energy"]),
        (lambda: fb.Model(constrained(u)), ["Holonomic constraint 1", "u(t)"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(mass=sm.Sum(m, (sm.Symbol("i"), 0, 3))))), ["Sum"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(mass=custom(m)))), ["custom"]),
        (lambda: fb.Model(pendulum(), name="numpy"), ["'numpy'"]),
        (lambda: fb.Model(pendulum(mass=F), inputs={F: q}), ["input F", "time and parameters"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(kde=u - q.diff(t) ** 2))), ["equation 1", "not linear"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(kde=u - q))), ["do not determine", "(q)"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(mass=sm.zoo))), ["zoo", "cannot be compiled"]),
        (lambda: fb.generate_sources(fb.Model(pendulum(mass=sm.zeta(m)))), ["zeta", "C99"]),
    ],
)
def test_models_that_cannot_be_compiled_are_refused_with_a_message(make, words):
    with pytest.raises(fb.ModelError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


def loaded(expr):
    system = pendulum()
    system.add_loads(me.Force(system.bodies[0], expr * system.frame.x))
    return system


PLACES = {
    "the mass of body bob": lambda e: fb.Model(pendulum(mass=e * m)),
    "force at point P": lambda e: fb.Model(loaded(e * q)),
    "kinematic differential equation 1": lambda e: fb.Model(pendulum(kde=u - e * q.diff(t))),
    "holonomic constraint 1": lambda e: fb.Model(constrained(q - e)),
    "output angle": lambda e: fb.Model(pendulum(), outputs={"angle": e * q}),
    "input F(t)": lambda e: fb.Model(loaded(F), inputs={F: e * sm.sin(t)}),
    "parameter m": lambda e: fb.Model(pendulum(), parameters={m: e * g}),
    "potential_energy": lambda e: fb.Model(pendulum(), potential_energy=e * q),
}


@pytest.mark.parametrize("where", PLACES)
@pytest.mark.parametrize(
    "expr",
    [
        sm.nan,
        sm.Integer(10) ** 400,
        sm.Rational(1, 10**400),
        sm.Float("1e400"),
        sm.I,
        sm.MatrixSymbol("A", 2, 2)[0, 1],
        sm.Trace(sm.MatrixSymbol("A", 2, 2)),
        sm.IndexedBase("b")[1],
        sm.Symbol("C", commutative=False),
        meter,
        sm.Limit(sm.sin(m) / m, m, 0),
        sm.Subs(sm.sin(g), g, m),
        sm.Integral(sm.sin(g), (g, 0, m)),
        sm.O(m),
    ],
    ids=str,
)
def test_expressions_that_have_no_value_in_double_are_named_with_their_place(where, expr):
    with pytest.raises(fb.ModelError) as caught:
        PLACES[where](expr)
    words = str(caught.value)
    assert where in words
    number = expr.is_Number and expr.is_finite  # of which the sign is that in its place, the digits are cut
    assert ("0000" if number else "O(m" if expr.is_Order else str(expr)) in words


def test_values_without_default_have_to_be_given():
    model = fb.Model(pendulum(), name="bare", parameters={m: 1.0})
    compiled = fb.compile_model(model)
    assert compiled.defaults == {"m": 1.0, "g": None, "l": None}
    with pytest.raises(fb.ModelError, match="parameters g, l"):
        compiled.rhs(0.0, [0.1, 0.2])
    with pytest.raises(fb.ModelError, match="parameter l"):
        compiled.rhs(0.0, [0.1, 0.2], {"g": 9.81})
    # l q'' = -g sin q, the bar's axis x down along gravity.
    rates = compiled.rhs(0.0, [0.1, 0.2], {"g": 9.81, "l": 2.0})
    np.testing.assert_allclose(rates, [0.2, -9.81 / 2 * np.sin(0.1)], rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("loops", [1, 5])
@pytest.mark.parametrize("unit", [1e-13, 1e-14])
def test_a_constraint_in_units_far_from_another_is_refused_and_not_dropped(loops, unit):
    # Closed chains with one loop constraint in another unit: one for the dense solve, a row of them for the sparse one.
    row = fb.models.n_four_bar(loops)
    system, scale = row.system, sm.Symbol("scale")
    first, *others = system.holonomic_constraints
    scaled = System(system.frame, system.fixed_point)
    scaled.add_bodies(*system.bodies)
    scaled.add_loads(*system.loads)
    scaled.q_ind, scaled.q_dep, scaled.u_ind, scaled.u_dep = system.q_ind, system.q_dep, system.u_ind, system.u_dep
    scaled.add_kdes(*system.kdes)
    scaled.add_holonomic_constraints(scale * first, *others)
    compiled = fb.compile_model(fb.Model(scaled, name="scaled", parameters={**row.parameter_symbols, scale: 1.0}))
    x = np.linspace(0.3, 1.1, compiled.n_x)
    expected = compiled.rhs(0.0, x)
    np.testing.assert_allclose(compiled.rhs(0.0, x, {"scale": 1e-6}), expected, rtol=1e-9)
    with pytest.raises(fb.SimulationError, match="similar units"):
        compiled.rhs(0.0, x, {"scale": unit})
