"""Expressions as numbers, without C: by SymPy's own evaluation, with 30 digits."""

import numpy as np
import pytest
import sympy as sm
from sympy.codegen import cfunctions
from sympy.physics.biomechanics import (
    FiberForceLengthActiveDeGroote2016,
    FiberForceVelocityInverseDeGroote2016,
    TendonForceLengthDeGroote2016,
)

import fourbar_codegen as fb
from fourbar_codegen.expressions.convert import Conversion
from fourbar_codegen.expressions.numeric import FUNCTIONS, function
from fourbar_codegen.expressions.tape import Tape

X, Y = sm.symbols("x y", real=True)
WITHIN = {sm.acosh: 1.7, sm.asec: 1.7, sm.acsc: 1.7}
"""Arguments of functions that have no real value at 0.3."""
OF_ONE = [of for of in FUNCTIONS if issubclass(of, sm.Function) and 1 in of.nargs and of is not cfunctions.Cbrt]


def evaluated(expression, *values):
    """By the tape, with the expression converted to it."""
    tape = Tape()
    leaves = {symbol: tape.leaf("q", symbol) for symbol in (X, Y)}
    numbers = dict(zip(leaves.values(), map(np.array, values), strict=False))
    [found] = tape.evaluate_at([Conversion(tape, leaves)(expression)], numbers)
    return found


@pytest.mark.parametrize("of", OF_ONE, ids=str)
def test_functions_of_one_argument_equal_sympys_with_30_digits(of):
    """To a few units in the last place, which libraries for mathematics promise."""
    at = WITHIN.get(of, 0.3)
    expected = float(of(sm.Float(at, 30)).evalf(30))
    assert float(function([X], of(X, evaluate=False))(np.array(at))) == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    "expression",
    [
        sm.atan2(X, Y), X**Y, sm.Max(X, Y, 1), sm.Min(X, Y), cfunctions.hypot(X, Y), sm.cbrt(X), sm.Heaviside(X - Y, 0),
        sm.Piecewise((X, (X < Y) & (X > 0)), (Y, (X > 2) | sm.Ne(X, 1)), (3, True)), sm.factorial(X), sm.sinc(X),
        sm.Mod(X, Y), sm.LambertW(X),
        TendonForceLengthDeGroote2016.with_defaults(X), FiberForceLengthActiveDeGroote2016.with_defaults(X),
        FiberForceVelocityInverseDeGroote2016.with_defaults(X),
    ],
    ids=str,
)  # fmt: skip
def test_expressions_of_two_arguments_at_many_points_equal_sympys(expression):
    points = [(0.3, 0.7), (1.5, 0.2), (0.9, 1.6)]
    expected = [float(expression.doit().subs({X: sm.Float(x, 30), Y: sm.Float(y, 30)}).evalf(30)) for x, y in points]
    found = np.broadcast_to(evaluated(expression, *np.transpose(points)), len(points))
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_functions_without_a_real_value_are_nan_also_in_branches_not_taken():
    """Nor an exception, which would take the values of all others with it; a branch that is not taken does no harm."""
    roots = [sm.sqrt(X), sm.log(X), sm.asin(X - 2), X ** sm.Rational(3, 2), 1 / (X + 1), sm.gamma(X), sm.exp(-1e5 * X)]
    assert not any(np.isfinite(evaluated(root, -1.0)) for root in roots)
    contact = sm.Piecewise((sm.sqrt(X), X > 0), (Y, True))
    assert evaluated(contact, [4.0, -4.0], [1.0, 1.0]).tolist() == [2.0, 1.0]


def test_conditions_of_which_no_value_is_known_are_refused():
    with pytest.raises(fb.ModelError, match="cannot be compiled"):
        function([X], sm.Contains(X, sm.Interval(0, 1)))
