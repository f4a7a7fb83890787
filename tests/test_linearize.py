"""Linearization against SymPy's, and equilibria against energies."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from scipy.optimize import minimize_scalar

import fourbar_codegen as fb


# In double precision, what SymPy substitutes for the four-bar cancels to no digit; with 40 digits, it takes the disc's
# matrices for singular.
@pytest.mark.parametrize(("name", "digits"), [("four_bar", 40), ("rolling_disc", 15), ("slider_crank", 40)])
def test_linearize_as_kanes_method_does(name, digits):
    model = getattr(fb.models, name)()
    compiled = fb.compile_model(model)
    start = {"q3": 0.4, "q1": 0.2, "q4": 0.1, "q5": 0.3} if name == "rolling_disc" else {}
    x = compiled.initial_state(start)
    inputs = list(model.input_expressions)
    r = [0.4 * (i + 1) for i in range(len(inputs))]
    system = model.system
    system.form_eoms(constraint_solver="CRAMER")
    linearizer = system.eom_method.to_linearizer()
    # Inputs that SymPy finds by itself come in its order.
    linearizer.r = sm.Matrix(inputs)
    t = me.dynamicsymbols._t
    values = dict(zip((*model.mechanism.coordinates, *model.mechanism.speeds), x, strict=True))
    values.update(zip((f.diff(t) for f in list(values)), compiled.rhs(0.0, x, r=r), strict=True))
    values.update(zip(inputs, r, strict=True))
    values.update({symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()})
    values[t] = 0.0
    values = {symbol: sm.Float(float(value), digits) for symbol, value in values.items()}
    expected_A, expected_B = linearizer.linearize(op_point=values, A_and_B=True)
    A, B = compiled.linearize(0.0, x, r=r)
    scale = np.abs(A).max()
    # Rounding errors of the entries of the Jacobians and of two solves with them.
    np.testing.assert_allclose(A, np.array(expected_A, dtype=float), rtol=0, atol=1e-9 * scale)
    if inputs:
        np.testing.assert_allclose(B, np.array(expected_B, dtype=float), rtol=0, atol=1e-9 * np.abs(B).max())


def test_linearized_motion_follows_the_full_one(four_bar):
    # From x and x + d along the constraints, both motions part as exp(A t) d says, to second order in d.
    x = four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 0.0})
    A, _ = four_bar.linearize(0.0, x, r={"F": 0.0})
    size = 1e-5
    begin = four_bar.initial_state([x[0] + size], [0.0], guess=x[1:3])
    run = four_bar.simulate((0.0, 0.1), begin, inputs={"F": 0.0}, rtol=1e-12, atol=1e-14)
    eigenvalues, vectors = np.linalg.eig(A)
    expected = (vectors @ np.diag(np.exp(0.1 * eigenvalues)) @ np.linalg.inv(vectors) @ [size, 0.0]).real
    np.testing.assert_allclose(run.y[[0, 3], -1] - x[[0, 3]], expected, atol=100 * size**2)


def test_equilibrium_is_where_the_potential_is_least(four_bar):
    # Without spring and damper, whose torque has no potential: it depends on q2 and acts on q1.
    p = {"k": 0.0, "c": 0.0}

    def potential(q1):
        x = four_bar.initial_state([q1], [0.0], guess=[-2.2, -1.5], parameters=p)
        return four_bar.potential_energy(0.0, x, p)

    least = minimize_scalar(potential, bounds=(-2.5, -0.8), method="bounded", options={"xatol": 1e-9}).x
    guess = four_bar.initial_state([least + 0.2], [0.0], guess=[-2.2, -1.5], parameters=p)[:3]
    x = four_bar.equilibrium(guess, parameters=p, inputs={"F": 0.0})
    assert x[0] == pytest.approx(least, abs=1e-6)  # a minimum is known to the root of the precision of its value
    assert np.abs(four_bar.rhs(0.0, x, p, {"F": 0.0})).max() < 1e-9
    eigenvalues = np.linalg.eigvals(four_bar.linearize(0.0, x, p, {"F": 0.0})[0])
    # Nothing takes energy: the motion around a minimum is an undamped oscillation.
    np.testing.assert_allclose(eigenvalues.real, 0.0, atol=1e-9)
    assert eigenvalues.imag.max() > 1.0


def test_no_equilibrium(four_bar):
    disc = fb.compile_model(fb.models.rolling_disc())
    # Upright it stands, lying down it falls through the plane: no other place.
    upright = disc.equilibrium({"q2": 0.1, "q3": 0.4})
    assert upright[1] == pytest.approx(0.0, abs=1e-9)
    force = fb.compile_model(fb.models.slider_crank())
    with pytest.raises(fb.SimulationError, match="No equilibrium was found"):
        four_bar.equilibrium(four_bar.initial_state()[:3], inputs={"F": 1e6}, parameters={"l2": 5.0})
    with pytest.raises(fb.ModelError, match="coordinate"):
        force.equilibrium([0.0])
