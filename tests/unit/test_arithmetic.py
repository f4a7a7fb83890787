"""Expressions of inputs on the command line, against Python's own arithmetic and closed forms."""

import math

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

import fourbar_codegen as fb
from fourbar_codegen.cli import main
from fourbar_codegen.cli.arithmetic import parse


def expressions():
    """Text of expressions in t and k."""
    leaves = st.sampled_from(["t", "k", "pi", "2", "0.5", "1e-3"])

    def larger(inner):
        binary = st.tuples(inner, st.sampled_from(["+", "-", "*", "/"]), inner).map(" ".join).map("({})".format)
        unary = st.tuples(st.sampled_from(["-", "sin", "cos", "exp", "tanh", "abs"]), inner).map(
            "{0[0]}({0[1]})".format
        )
        return binary | unary | st.tuples(inner, inner).map("max({0[0]}, {0[1]})".format)

    return st.recursive(leaves, larger, max_leaves=8)


@given(expressions(), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_random_arithmetic_expressions_have_pythons_values(text, t, k):
    functions = {name: getattr(math, name) for name in ("sin", "cos", "exp", "tanh", "pi")}
    try:
        expected = eval(text, {"__builtins__": {}}, {"t": t, "k": k, "abs": abs, "max": max, **functions})
    except ArithmeticError:
        with pytest.raises(fb.ModelError, match="has no value"):
            parse(text, {"t", "k"})({"t": t, "k": k})
    else:
        assert parse(text, {"t", "k"})({"t": t, "k": k}) == pytest.approx(expected, rel=1e-15, nan_ok=True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("__import__('os').system('true')", "not allowed"),
        ("t.real", "not allowed"),
        ("[t][0]", "not allowed"),
        ("t if t else 1", "not allowed"),
        ("(lambda: t)()", "not allowed"),
        ("f'{t}'", "not allowed"),
        ("sin(x=t)", "not allowed"),
        ("sin()", "not allowed"),
        ("True", "not allowed"),
        ("1j", "not allowed"),
        ("t := 3", "not an arithmetic"),
        ("t +", "not an arithmetic"),
        ("9" * 400, "too large"),
        ("1 + " * 400 + "1", "at most 1000 characters"),
        ("(" * 400 + "1" + ")" * 400, "not an arithmetic"),
        ("2 t", "not an arithmetic"),
        ("-" * 900 + "t", "nested too deeply"),
        ("sin", r"sin is a function: write sin"),
        ("t(3)", r"t is not a function: write t\*"),
        ("t^2", r"write \*\*"),
        ("sine(t)", "Did you mean sin"),
        ("kk", "Did you mean k"),
    ],
)
def test_expressions_that_are_no_arithmetic_are_refused(text, words):
    with pytest.raises(fb.ModelError, match=words):
        parse(text, ("t", "k"))


@pytest.mark.parametrize(
    ("text", "words"),
    [("1/(t - 1)", "at t = 1: .*division"), ("9.0**9**9", "no value"),
     ("(-1)**0.5", "no value"), ("abs((-8)**(1/3))", "no value"),
     ("sqrt(-t)", "at t = 1"), ("sin(t, t)", "no value")],
)  # fmt: skip
def test_expressions_without_a_value_are_refused_with_the_time(text, words):
    with pytest.raises(fb.ModelError, match=words):
        parse(text, {"t"})({"t": 1.0})


def test_command_line_input_expressions_give_the_run_of_the_models_expression(four_bar, tmp_path):
    """The tutorial's F, written once more, with parameters and in -i as well as in -r."""
    expected = four_bar.simulate((0.0, 1.0), rtol=1e-10, atol=1e-10)
    for options in (["-r", "F=100*sin(pi*t)"], ["-i", "F=1000*l2*sin(pi*t)/5"], ["-r", "F=k*sin(t*pi)", "-p", "k=100"]):
        path = tmp_path / "run.npz"
        done = CliRunner().invoke(
            main, ["simulate", "-t", "0", "1", "--rtol", "1e-10", "--atol", "1e-10", *options, "-o", str(path)]
        )
        assert done.exit_code == 0, done.output
        # Both are within 1e-10 of their terms at each of some 30 steps.
        np.testing.assert_allclose(fb.load_trajectory(path).y[:, -1], expected.y[:, -1], rtol=0, atol=1e-8)
    constant = CliRunner().invoke(main, ["simulate", "-t", "0", "1", "-r", "F=2*pi", "-i", "q1=-pi/6"])
    assert "  q1          -0.5235987756" in constant.output
    wrong = CliRunner().invoke(main, ["simulate", "-r", "F=1/t"])
    assert wrong.exit_code == 1
    assert "1/t has no value at t = 0" in wrong.output
