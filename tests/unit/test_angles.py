"""Added angles: the addition theorems, told by the functions that are left and by their values."""

import math

import pytest
import sympy as sm

from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.tape import Call, Tape
from fourbar_codegen.lowering.angles import add_angles

A, B, C = sm.symbols("a b c")
POINT = {"a": 0.3, "b": -1.1, "c": 2.5}


def added(expression):
    """The expression's value with angles added, and the sines and cosines that are left."""
    tape = Tape()
    leaves = {symbol: tape.leaf("q", symbol) for symbol in (A, B, C)}
    (scalar,) = add_angles(tape, [Conversion(tape, leaves)(expression)], lambda node: node == 0)
    (value,) = tape.evaluate([scalar], {leaf: POINT[str(symbol)] for symbol, leaf in leaves.items()})
    calls = [tape.nodes[node] for node in tape.reach([scalar])]
    return value, sorted(str(call.expression.func) for call in calls if isinstance(call, Call))


@pytest.mark.parametrize(
    ("expression", "closed_form"),
    [
        (sm.sin(A) * sm.cos(B) + sm.cos(A) * sm.sin(B), math.sin(0.3 - 1.1)),
        (sm.sin(A) * sm.cos(B) - sm.cos(A) * sm.sin(B), math.sin(0.3 + 1.1)),
        (sm.cos(A) * sm.sin(B) - sm.sin(A) * sm.cos(B), math.sin(-1.1 - 0.3)),
        (sm.cos(A) * sm.cos(B) - sm.sin(A) * sm.sin(B), math.cos(0.3 - 1.1)),
        (sm.cos(A) * sm.cos(B) + sm.sin(A) * sm.sin(B), math.cos(0.3 + 1.1)),
        (sm.sin(A) * sm.sin(B) - sm.cos(A) * sm.cos(B), -math.cos(0.3 - 1.1)),
        (-2 * sm.sin(A) * sm.cos(B) - 2 * sm.cos(A) * sm.sin(B), -2 * math.sin(0.3 - 1.1)),
    ],
)
def test_sums_of_products_of_sines_become_one_sine_of_added_angles(expression, closed_form):
    """Numbers by the closed form; 4 units in the last place for its own rounding and that of the sum."""
    value, calls = added(expression)
    assert value == pytest.approx(closed_form, rel=1e-15)
    assert len(calls) == 1


def test_chain_of_three_angles_becomes_one_sine_of_their_sum():
    sine = sm.sin(A) * sm.cos(B) + sm.cos(A) * sm.sin(B)
    cosine = sm.cos(A) * sm.cos(B) - sm.sin(A) * sm.sin(B)
    value, calls = added(sine * sm.cos(C) + cosine * sm.sin(C))
    assert value == pytest.approx(math.sin(0.3 - 1.1 + 2.5), rel=1e-15)
    assert calls == ["sin"]


@pytest.mark.parametrize(
    "expression",
    [
        sm.sin(A) * sm.cos(B) + sm.cos(A) * sm.cos(B),
        sm.sin(A) * sm.cos(B) + sm.sin(A) * sm.cos(C),
        sm.sin(A) * sm.cos(B) + 2 * sm.cos(A) * sm.sin(B),
        sm.sin(A) * sm.cos(A) + sm.cos(A) * sm.sin(B),
        sm.cos(A) ** 2 - sm.sin(A) ** 2,
        # a third sine, where the two of a and b are needed anyway
        (sm.sin(A) * sm.cos(B) + sm.cos(A) * sm.sin(B)) * sm.sin(A) * sm.sin(B),
    ],
)
def test_sums_of_products_that_no_addition_theorem_fits_stay_as_they_are(expression):
    value, calls = added(expression)
    assert value == pytest.approx(float(expression.subs({A: 0.3, B: -1.1, C: 2.5})), rel=1e-14)
    assert len(calls) == len(expression.atoms(sm.sin, sm.cos))
