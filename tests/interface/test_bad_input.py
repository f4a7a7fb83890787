"""Whatever is wrong gets an error of the package's own that names it and says what is allowed."""

import os
import subprocess
import sys
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from sympy.physics.mechanics.system import System
from sympy.physics.units import meter

import fourbar_codegen as fb
from fourbar_codegen.models import four_bar as make_four_bar

pytestmark = pytest.mark.usefixtures("unoptimized")

X = [0.1] * 6


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: m.rhs(0.0, X, {"l9": 1.0}), ["'l9'", "l1, l2, l3, l4"]),
        (lambda m: m.rhs(0.0, X, {"l2": "long"}), ["parameter l2", "'long'"]),
        (lambda m: m.rhs(0.0, X, {"l2": np.inf}), ["parameter l2", "inf"]),
        (lambda m: m.rhs(0.0, X, [1.0, 2.0]), ["parameters p", "(8,)", "(2,)"]),
        (lambda m: m.rhs(0.0, X, [np.nan] * 8), ["parameters p", "finite"]),
        (lambda m: m.rhs(0.0, X, r={"G": 1.0}), ["'G'", "F"]),
        (lambda m: m.rhs(0.0, X, r=[1.0, 2.0]), ["inputs r", "(1,)", "(2,)"]),
        (lambda m: m.rhs(0.0, X, r=[np.nan]), ["inputs r", "finite"]),
        (lambda m: m.rhs(0.0, [0.1] * 5), ["(6,)", "(5,)"]),
        (lambda m: m.rhs(0.0, np.zeros((6, 1))), ["(6,)", "(6, 1)"]),
        (lambda m: m.rhs(0.0, 1.0), ["(6,)", "()"]),
        (lambda m: m.rhs(0.0, ["a"] * 6), ["state x", "real numbers"]),
        (lambda m: m.rhs(0.0, [1j] * 6), ["state x", "real numbers"]),
        (lambda m: m.rhs(0.0, np.array([1j] * 6)), ["state x", "real numbers"]),
        (lambda m: m.rhs(0.0, ["1"] * 6), ["state x", "real numbers"]),
        (lambda m: m.rhs(0.0, [10**400] * 6), ["state x", "real numbers"]),
        (lambda m: m.rhs(0.0, X, {"l2": 10**400}), ["parameter l2"]),
        (lambda m: m.initial_state(parameters="abc"), ["parameters p", "'abc'"]),
        (lambda m: m.constraint_jacobian(0.0, "abc"), ["coordinates", "'abc'"]),
        (lambda m: m.along([0.0, 1.0], [X], [[0.0, 0.0]]), ["(6, 2)", "(1, 6)"]),
        (lambda m: m.simulate((0.0, 1.0), t_eval=[]), ["t_eval"]),
        (lambda m: m.simulate((0.0, 1.0), events=5), ["events", "5"]),
        (lambda m: m.simulate((0.0, 1.0), atol=[1e-3]), ["atol", "(6,)"]),
        (lambda m: m.simulate((0.0, 1.0), inputs=[1.0]), ["inputs", "mapping", "F"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": lambda t, x: None}), ["input F", "None"]),
        (lambda m: m.rhs(0.0, [np.nan, *X[1:]]), ["finite", "nan"]),
        (lambda m: m.rhs(np.inf, X), ["finite", "inf"]),
        (lambda m: m.rhs(0.0, X, out=np.empty(5)), ["out", "6"]),
        (lambda m: m.rhs(0.0, x := np.zeros(6), out=x), ["out", "share memory"]),
        (lambda m: m.jacobian(0.0, [0.1] * 5), ["(6,)", "(5,)"]),
        (lambda m: m.position_constraints(0.0, X), ["(3,)", "(6,)"]),
        (lambda m: m.mass_matrix(0.0, X, {"m": 1.0}), ["'m'", "rho"]),
        (lambda m: m.initial_state({"q2": 1.0}), ["'q2'", "guess=", "independent coordinates (q1)"]),
        (lambda m: m.initial_state([1.0, 2.0]), ["independent coordinates", "(1,)", "(2,)"]),
        (lambda m: m.initial_state([np.nan]), ["finite"]),
        (lambda m: m.initial_state(guess={"q1": 1.0}), ["'q1'", "dependent coordinate", "q2, q3"]),
        (lambda m: m.initial_state(["a"]), ["numbers", "'a'"]),
        (lambda m: m.simulate((0.0, 1.0), X, method="Euler"), ["'Euler'", "DOP853", "Radau"]),
        (lambda m: m.simulate((0.0, 1.0), X, method=np.array(["RK45", "DOP853"])), ["array", "DOP853, "]),
        (lambda m: m.simulate((0.0, 1.0), X, constraints=np.array(["project", "none"])), ["array", "'project'"]),
        (lambda m: m.simulate((0.0, 1.0), method="IDA", formulation=np.array(["index-1"] * 2)), ["array", "index-3"]),
        (lambda m: m.ensemble((0.0, 1.0), method=np.array(["RK45", "DOP853"])), ["array", "DOP853"]),
        (lambda m: m.ensemble((0.0, 1.0), parallel=print), ["joblib.Parallel", "print"]),
        (lambda m: m.ensemble((0.0, 1.0), workers=np.timedelta64(1, "s")), ["workers", "timedelta64"]),
        (lambda m: m.rhs(0.0, X, dict), ["parameters p", "dict"]),
        (lambda m: fb.Parameter(1.0, None), ["unit", "None"]),
        (lambda m: fb.Parameter(1.0, "m", 5), ["description", "5"]),
        (lambda m: m.simulate((0.0, 1.0), X, constraints="glue"), ["'glue'", "'project'", "'none'"]),
        (lambda m: m.simulate((0.0, np.nan), X), ["t_span", "nan"]),
        (lambda m: m.simulate((0.0,), X), ["t_span", "two times"]),
        (lambda m: m.simulate((1.0, 1.0), X), ["t_span", "different"]),
        (lambda m: m.simulate(3.0, X), ["t_span", "3.0"]),
        (lambda m: m.simulate((0.0, 1.0), [0.1] * 5), ["(6,)", "(5,)"]),
        (lambda m: m.simulate((0.0, 1.0), [np.nan] * 6), ["finite"]),
        (lambda m: m.simulate((0.0, 1.0), ["a"] * 6), ["states", "numbers"]),
        (lambda m: m.simulate((0.0, 1.0), t_eval=[0.0, 2.0]), ["t_eval", "2.0"]),
        (lambda m: m.simulate((0.0, 1.0), t_eval=[0.5, 0.2]), ["t_eval", "order"]),
        (lambda m: m.simulate((0.0, 1.0), t_eval="now"), ["t_eval", "'now'"]),
        (lambda m: m.simulate((0.0, 1.0), rtol=np.nan), ["rtol", "nan"]),
        (lambda m: m.simulate((0.0, 1.0), rtol=-1.0), ["rtol", "-1.0"]),
        (lambda m: m.simulate((0.0, 1.0), atol=-1.0), ["atol", "-1.0"]),
        (lambda m: m.simulate((0.0, 1.0), atol=[1e-6] * 5), ["atol", "(6,)"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"G": 1.0}), ["'G'", "F"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": "big"}), ["F", "'big'"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": np.nan}), ["F", "nan"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": ([0, 1], [1])}), ["F", "(2,)", "(1,)"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": ([1, 0], [1, 2])}), ["F", "increasing"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": ([0, 1], [1, np.nan])}), ["F", "finite"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": (1, 2, 3)}), ["F", "table"]),
        (lambda m: m.simulate((0.0, 0.1))["q9"], ["'q9'", "q1, q2, q3"]),
        (lambda m: m.simulate((0.0, 0.1)).save("run.xyz"), [".csv", "run.xyz"]),
        (lambda m: m.simulate((0.0, 0.1)).save("/dev/null/run.csv"), ["/dev/null/run.csv"]),
        (lambda m: fb.load("five_bar"), ["'five_bar'", "four_bar"]),
        (lambda m: fb.load(__file__), ["test_bad_input.py", "compiled model"]),
        (lambda m: fb.compile_model(make_four_bar().system), ["Model", "System"]),
        (lambda m: fb.Parameter(np.nan), ["finite"]),
        (lambda m: fb.Parameter("heavy"), ["'heavy'"]),
        (lambda m: m.rhs(0.0, X, {"k": 1.0, sm.Symbol("k"): 2.0}), ["two values", "parameter k"]),
        (lambda m: m.simulate((0.0, 1.0), inputs={"F": 1.0, me.dynamicsymbols("F"): 2.0}), ["two values", "input F"]),
        (lambda m: m.rhs_batch(0.0, np.zeros((6, 2)), r={"F": 1.0, me.dynamicsymbols("F"): 2.0}), ["two", "input F"]),
        (lambda m: m.simulate((0.0, 0.1)).plot_paths(np.ma.masked), ["Points", "masked"]),
        (lambda m: m.ode().inputs_along([np.nan], np.zeros((6, 1))), ["times", "finite"]),
        (lambda m: fb.Parameter(sm.Lambda(sm.Symbol("k"), sm.Symbol("k"))), ["parameter", "Lambda"]),
        (lambda m: fb.models.chain(3, closed=[]), ["closed", "True or False", "[]"]),
        (lambda m: fb.compile_model(make_four_bar(), check=1), ["check", "True or False", "1"]),
        (lambda m: m.ensemble((0.0, 1.0), progress=np.zeros((0, 0))), ["progress", "True or False", "array"]),
        (lambda m: fb.models.chain(2, closed=True), ["links", "3 to 1000", "2"]),
        (lambda m: fb.models.n_four_bar(10**400), ["loops", "1 to 1000", "10000"]),
        (lambda m: m.initial_states(X[:1])[[1.0, [2.0, 3.0]]], ["mode", "[2.0, 3.0]"]),
    ],
)
def test_errors_of_wrong_arguments_name_what_is_wrong_and_what_is_allowed(four_bar, call, words):
    with pytest.raises(fb.ModelError) as caught:
        call(four_bar)
    for word in words:
        assert word in str(caught.value)


def no_numbers(shape):
    """What is of a shape that would do, and no array of real numbers."""
    yield from (None, "1.0", b"1", {0.3}, object(), sm.Symbol("a"), [[1.0], [1.0, 2.0]], 10**400, 10**5000)
    for value in ("1.0", 1.0 + 0.0j, np.timedelta64(1, "s"), np.datetime64("2020-01-01"), np.complex128(1.0)):
        yield np.full(shape, value)
        yield np.full(shape, value, dtype=object)
        yield np.full(shape, value).tolist()
    yield np.ma.array(np.full(shape, 0.3), mask=True)
    yield [np.ma.masked] * (shape[0] if shape else 1)
    yield np.zeros(shape, dtype=[("x", float)])


P = list(fb.load("four_bar").defaults.values())
SPAN = (0.0, 0.1)
CALLS = {
    "rhs t": ((), lambda m, v: m.rhs(v, X), "time t"),
    "rhs x": ((6,), lambda m, v: m.rhs(0.0, v), "state x"),
    "rhs p": ((8,), lambda m, v: m.rhs(0.0, X, [*P] if v is None else v, [v]), "p|r"),
    "rhs p by name": ((), lambda m, v: m.rhs(0.0, X, {"k": v}), "parameter k"),
    "rhs r": ((1,), lambda m, v: m.rhs(0.0, X, P, [None] if v is None else v), "inputs r"),
    "jacobian t": ((), lambda m, v: m.jacobian(v, X), "time t"),
    "positions t": ((), lambda m, v: m.positions(v, X[:3]), "time t"),
    "positions q": ((3,), lambda m, v: m.positions(0.0, {"q1": 0.0, "q2": 0.0} if v is None else v), "coordinate"),
    "multipliers t": ((), lambda m, v: m.multipliers(v, X), "time t"),
    "linearize t": ((), lambda m, v: m.linearize(v, X), "value of t"),
    "batch t": ((4,), lambda m, v: m.rhs_batch(v, np.ones((6, 4))), "times"),
    "batch x": ((6, 4), lambda m, v: m.rhs_batch(0.0, v), "states"),
    "batch p": ((8, 4), lambda m, v: m.rhs_batch(0.0, np.ones((6, 4)), {"k": None} if v is None else v), "parameter"),
    "batch p by name": ((4,), lambda m, v: m.rhs_batch(0.0, np.ones((6, 4)), {"k": v}), "parameter k"),
    "along": ((2,), lambda m, v: m.along(v, np.ones((6, 2)), np.ones((1, 2))), "times"),
    "t_span": ((2,), lambda m, v: m.simulate(v), "t_span"),
    "end of t_span": ((), lambda m, v: m.simulate((0.0, v)), "t_span"),
    "x0": ((6,), lambda m, v: m.simulate(SPAN, [None] if v is None else v), "states"),
    "t_eval": ((2,), lambda m, v: m.simulate(SPAN, t_eval=[None] if v is None else v), "t_eval"),
    "rtol": ((), lambda m, v: m.simulate(SPAN, rtol=v), "rtol"),
    "atol": ((6,), lambda m, v: m.simulate(SPAN, atol=v), "atol"),
    "max_step": ((), lambda m, v: m.simulate(SPAN, max_step=v), "max_step"),
    "stabilization": ((), lambda m, v: m.simulate(SPAN, constraints="baumgarte", stabilization=v), "stabilization"),
    "input": ((), lambda m, v: m.simulate(SPAN, inputs={"F": v}), "[Ii]nput F"),
    "times of a table": ((2,), lambda m, v: m.simulate(SPAN, inputs={"F": (v, [0.0, 1.0])}), "Input F .* times"),
    "values of a table": ((2,), lambda m, v: m.simulate(SPAN, inputs={"F": ([0.0, 1.0], v)}), "Input F .* values"),
    "value of a callable": ((), lambda m, v: m.simulate(SPAN, inputs={"F": lambda t, x: v}), "callable of input F"),
    "value of an event": ((), lambda m, v: m.simulate(SPAN, events=lambda t, x: v), "value of an event's callable"),
    "direction": ((), lambda m, v: fb.Event("a", direction=v), "direction"),
    "initial coordinates": ((1,), lambda m, v: m.initial_state([None] if v is None else v), "coordinate"),
    "initial t": ((), lambda m, v: m.initial_state(t=v), "time t"),
    "guess": ((2,), lambda m, v: m.initial_state(guess=[None] if v is None else v), "dependent coordinate"),
    "members": ((3, 8), lambda m, v: m.ensemble(SPAN, parameters=[None] if v is None else v), "parameters"),
    "their states": ((3, 6), lambda m, v: m.ensemble(SPAN, [None] if v is None else v), "x0"),
    "their tolerance": ((), lambda m, v: m.ensemble(SPAN, rtol=v), "rtol"),
    "h": ((), lambda m, v: m.stepper(v), "value of h"),
    "t of a stepper": ((), lambda m, v: m.stepper(1e-3, t=v), "value of t"),
    "r of a step": ((1,), lambda m, v: m.stepper(1e-3).step([None] if v is None else v), "inputs r"),
    "t of an ode": ((), lambda m, v: m.ode()(v, X), "time t"),
    "x of an ode": ((6,), lambda m, v: m.ode().jac(0.0, v), "state x"),
    "t of a solution": ((2,), lambda m, v: m.simulate(SPAN, dense_output=True).sol(v), "times"),
    "t of a solver's": ((2,), lambda m, v: m.simulate(SPAN, method="RK23", dense_output=True).sol(v), "times"),
    "t0": ((), lambda m, v: fb.solvers.DOP853(m.ode(), v, X, 1.0), "t0"),
    "y0": ((6,), lambda m, v: fb.solvers.LSODA(m.ode(), 0.0, v, 1.0), "y0"),
    "rtol of a solver": ((), lambda m, v: fb.solvers.RK45(m.ode(), 0.0, X, 1.0, rtol=v), "rtol"),
    "atol of a solver": ((6,), lambda m, v: fb.solvers.LSODA(m.ode(), 0.0, X, 1.0, atol=v), "atol"),
    "value of a parameter": (
        (),
        lambda m, v: fb.Parameter([] if v is None or isinstance(v, sm.Symbol) else v),
        "parameter",
    ),
}


@pytest.mark.parametrize("name", CALLS)
@pytest.mark.filterwarnings("ignore::UserWarning")  # NumPy's, of masked entries that become nan
def test_arguments_that_are_no_numbers_are_refused_by_name_in_every_call(four_bar, name):
    shape, call, words = CALLS[name]
    for value in no_numbers(shape):
        with pytest.raises(fb.ModelError, match=words):
            call(four_bar, value)


def test_arguments_of_all_classes_of_numbers_give_the_same_rates(four_bar):
    # Exact in float32.
    x = np.array([0.5, 0.25, -0.125, 1.0, 2.0, -3.0])
    rates = four_bar.rhs(1.0, x)
    others = [x.tolist(), tuple(x), x.astype(np.float32), x.astype(np.longdouble), [Fraction(v) for v in x]]
    for given in (*others, [Decimal(v) for v in x], [sm.Float(v) for v in x], x.astype(object)):
        np.testing.assert_array_equal(four_bar.rhs(1.0, given), rates)
    for t in (1, True, np.float32(1.0), np.int8(1), np.array(1), Fraction(1), sm.Integer(1)):
        np.testing.assert_array_equal(four_bar.rhs(t, x), rates)


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
        (lambda: fb.multiplier(0), ["0", "from 1"]),
        (lambda: fb.multiplier("a"), ["'a'"]),
        (lambda: fb.joint_force("pin", {1: q}, me.ReferenceFrame("N")), ["joint_force", "vectors"]),
        (lambda: fb.joint_force("pin", [q], "N"), ["joint_force", "mapping"]),
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
        (lambda: fb.build_wheel(5, "."), ["Model", "int"]),
        (lambda: fb.load(None), ["None"]),
        (lambda: fb.load("os"), ["'os'", "four_bar"]),
        (lambda: fb.load("__main__"), ["'__main__'"]),
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
        (lambda: fb.generate_sources(pendulum()), ["Model", "System"]),
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


@pytest.mark.parametrize("command", ["no-such-compiler-here", "false"])
def test_compile_model_with_a_missing_or_failing_compiler_names_it(monkeypatch, tmp_path, command):
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    monkeypatch.setenv("CC", command)
    with pytest.raises(fb.BuildError) as caught:
        fb.compile_model(make_four_bar())
    assert command in str(caught.value)
    assert caught.value.command[0] == command
    assert [path for path in tmp_path.iterdir() if path.is_dir()] == []
    assert fb.load("four_bar").simulate((0.0, 0.1)).success


def test_build_error_of_a_wrong_flag_shows_the_compilers_message(monkeypatch, tmp_path):
    monkeypatch.setenv("CFLAGS", "--no-such-flag")
    monkeypatch.setenv("FOURBAR_CODEGEN_CACHE", str(tmp_path))
    with pytest.raises(fb.BuildError, match="no-such-flag") as caught:
        fb.compile_model(make_four_bar())
    assert caught.value.exit_code == 1
    assert "unrecognized" in caught.value.output


@pytest.mark.slow
def test_failed_build_leaves_the_users_folder_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", "false")
    with pytest.raises(fb.BuildError):
        fb.build_model(make_four_bar(), tmp_path / "built")
    assert not (tmp_path / "built").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variable", "text", "words"),
    [
        ("CC", 'gcc "', "environment variable CC cannot be read"),
        ("CFLAGS", '-O"', "environment variable CFLAGS cannot be read"),
        ("CC", "true", "made no"),
    ],
)
def test_build_with_unreadable_compiler_settings_is_refused_with_their_name(
    monkeypatch, tmp_path, variable, text, words
):
    monkeypatch.setenv(variable, text)
    with pytest.raises(fb.BuildError, match=words):
        fb.build_model(make_four_bar(), tmp_path)


@pytest.mark.slow
def test_module_built_with_fast_math_keeps_nan_and_denormal_numbers(monkeypatch, tmp_path):
    monkeypatch.setenv("CC", f"{os.environ.get('CC', 'cc')} -Ofast")
    monkeypatch.setenv("CFLAGS", "-ffast-math")
    monkeypatch.setenv("LDFLAGS", "-ffast-math -funsafe-math-optimizations")
    path = fb.build_model(make_four_bar(), tmp_path)
    # The least number of double is one still: with code that compilers link for these flags, it would be zero.
    script = f"import fourbar_codegen as fb\nfb.load({str(path)!r})\nprint(float('5e-324') * 1.0)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "5e-324\n"
    four_bar = fb.load(path)
    ode = four_bar.ode()
    assert np.isnan(ode(0.0, [np.nan] * 6)).all()
    assert "not finite" in ode.failure


@pytest.mark.slow
def test_module_built_again_after_loading_is_refused_in_the_same_process(tmp_path):
    fb.load(fb.build_model(fb.Model(pendulum(), name="again", parameters={m: 1.0}), tmp_path))
    path = fb.build_model(fb.Model(pendulum(), name="again", parameters={m: 2.0}), tmp_path)
    with pytest.raises(fb.ModelError, match="built again"):
        fb.load(path)


@pytest.mark.slow
def test_module_built_after_a_failed_load_is_loaded(tmp_path):
    model = fb.Model(pendulum(), name="mended", parameters={m: 1.0})
    path = fb.build_model(model, tmp_path)
    path.unlink()
    path.write_text("Not a library.")
    with pytest.raises(fb.ModelError, match="cannot be loaded"):
        fb.load(path)
    path.unlink()
    assert fb.load(fb.build_model(model, tmp_path)).name == "mended"


def test_failed_write_leaves_the_old_file(four_bar, tmp_path, monkeypatch):
    run = four_bar.simulate((0.0, 0.1))
    path = run.save(tmp_path / "run.csv")
    old = path.read_text()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("csv.writer", full)
    with pytest.raises(fb.ModelError, match="No space left"):
        run.save(path)
    assert path.read_text() == old
    assert [p.name for p in tmp_path.iterdir()] == ["run.csv"]


def test_run_that_ends_before_its_first_sample_has_empty_results(four_bar):
    def now(t, x):
        return t - 0.1

    now.terminal = True
    run = four_bar.simulate((0.0, 1.0), t_eval=[0.5], events=now)
    assert run.status == 1
    assert run.t.shape == (0,)
    assert run.y.shape == (6, 0)
    assert run.energy.shape == (0,)
    assert run["q1"].shape == (0,)


def test_series_as_parameters_or_inputs_are_read_by_their_index(four_bar):
    class Series:
        """As of pandas: named values that are not a Mapping."""

        def __init__(self, values):
            self.values = values

        def keys(self):
            return self.values.keys()

        def items(self):
            return self.values.items()

    values = dict(reversed(four_bar.defaults.items()))
    np.testing.assert_array_equal(four_bar.rhs(0.0, X, Series(values)), four_bar.rhs(0.0, X))
    assert four_bar.simulate((0.0, 0.1), method="Radau", inputs=Series({"F": 1.0})).success


@pytest.mark.slow
@pytest.mark.parametrize("loops", [1, 4])
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
