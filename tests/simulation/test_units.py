"""Units of length, mass and time change nothing but the units of results.

Units are powers of two, so that no number is rounded otherwise: where nothing in the code has a unit of its own, runs
agree to the last bit.
"""

import math
import re

import numpy as np
import pytest

import fourbar_codegen as fb

DIMENSIONS = {"m": (1, 0, 0), "kg": (0, 1, 0), "s": (0, 0, 1), "N": (1, 1, -2), "rad": (0, 0, 0), "": (0, 0, 0)}
UNITS = [(20, 0, 0), (-20, 0, 0), (0, 20, 0), (0, 0, 20), (-20, -20, -10), (20, 10, -20)]
"""Exponents of two: a unit of length of a millionth, a million, and so on."""


def in_units(unit, exponents):
    """What a quantity of this unit, such as kg m^2 or N/(m/s), is multiplied by."""
    total = 0
    above, _, below = unit.partition("/")
    for sign, part in ((1, above), (-1, re.sub(r"[()]", "", below))):
        for position, quotient in enumerate(part.split("/")):
            for factor in quotient.split():
                base, _, power = factor.partition("^")
                dimension = sum(map(math.prod, zip(DIMENSIONS[base], exponents, strict=True)))
                total += sign * (-1) ** position * int(power or 1) * dimension
    return 2.0**total


@pytest.fixture(scope="module")
def slider_crank():
    return fb.compile_model(fb.models.slider_crank())


CASES = {
    "four_bar": ({"F": (3.0, "N")}, ()),
    "slider_crank": ({"torque": (0.5, "N m"), "load": (-1.0, "N")}, ("slide", "slide_rate")),
}


class Scaled:
    """A model in other units."""

    def __init__(self, model, exponents):
        self.model = model
        inputs, lengths = CASES[model.name]
        length, time = 2.0 ** exponents[0], 2.0 ** exponents[2]
        self.time = time
        self.states = np.array(
            [(length if name in lengths else 1.0) / (time if name in model.speeds else 1.0) for name in model.states]
        )
        self.parameters = {n: v * in_units(model.units[n] or "", exponents) for n, v in model.defaults.items()}
        self.inputs = {name: value * in_units(unit, exponents) for name, (value, unit) in inputs.items()}

    def run(self, x0, *, step=None, **how):
        how |= {"max_step": step * self.time} if step else {"rtol": 1e-7, "atol": 1e-7 * self.states}
        span = (0.0, 0.5 * self.time)
        run = self.model.simulate(span, x0 * self.states, parameters=self.parameters, inputs=self.inputs, **how)
        assert run.success, run.message
        return run.y[:, -1] / self.states, run.nfev


METHODS = {
    "DOP853": ({}, 1e-5), "RK45": ({}, 1e-5), "Radau": ({}, 1e-5), "CVODE": ({}, 1e-5), "IDA": ({}, 1e-3),
    "IDA, index 1": ({"formulation": "index-1"}, 1e-5), "IDA, index 3": ({"formulation": "index-3"}, 2e-2),
    "ALI3P": ({"step": 2.0**-9}, 1e-5),
}  # fmt: skip
"""What is more than rounding comes from pivots, which are chosen with a view to units that lengths and angles have in
common, and from SciPy's first step, which takes 1e-6 s where there is nothing better: then the runs' own errors. IDA's
slider-crank errs by 1.4e-4, compared with DOP853 at 1e-12; index 3 as tests/simulation/test_methods.py has it."""


@pytest.mark.slow(but=["four_bar-ALI3P", "four_bar-CVODE", "four_bar-IDA, index 1", "four_bar-IDA, index 3"])
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("which", CASES)
def test_runs_in_other_units_of_length_mass_and_time_give_the_same_motion(which, name, four_bar, slider_crank):
    model = {"four_bar": four_bar, "slider_crank": slider_crank}[which]
    how, error = METHODS[name]
    how = how | {"method": name.partition(",")[0]}
    x0 = model.initial_state()
    expected, nfev = Scaled(model, (0, 0, 0)).run(x0, **how)
    for exponents in UNITS:
        end, evaluations = Scaled(model, exponents).run(x0, **how)
        np.testing.assert_allclose(end, expected, rtol=0, atol=error, err_msg=str(exponents))
        if exponents[2] == 0:  # SciPy's first step in other units of time is followed by as many as it takes to grow
            assert evaluations == pytest.approx(nfev, rel=0.3), exponents
        # In units of mass alone nothing is rounded otherwise, nor where all coordinates are angles.
        if exponents[2] == 0 and (which == "four_bar" or exponents[0] == 0):
            np.testing.assert_array_equal(end, expected, err_msg=str(exponents))


@pytest.mark.parametrize("which", CASES)
def test_initial_states_modes_and_linearizations_in_other_units_are_the_same(which, four_bar, slider_crank):
    """Initial states, assembly modes, and the linear equations about a state; what is open is refused in all units."""
    model = {"four_bar": four_bar, "slider_crank": slider_crank}[which]
    x0 = model.initial_state()
    n_q = model.n_q
    n_i = n_q - model.manifest["n_dependent_coordinates"]
    expected = None
    for exponents in [(0, 0, 0), *UNITS]:
        scaled = Scaled(model, exponents)
        how = {"parameters": scaled.parameters}
        start = x0 * scaled.states
        independent = start[:n_i], start[n_q : n_q + n_i]
        modes = model.initial_states(*independent, **how)
        assert modes.is_complete
        assert len(modes) == 2
        closed = model.initial_state(*independent, guess=start[n_i:n_q], **how)
        a = model.linearize(0.0, start, scaled.parameters, scaled.inputs)[0]
        units = scaled.states[[*range(n_i), *range(n_q, n_q + n_i)]]
        linear = a / units[:, np.newaxis] * units * scaled.time
        found = np.concatenate([(modes.x / scaled.states).ravel(), closed / scaled.states, linear.ravel()])
        expected = found if expected is None else expected
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9, err_msg=str(exponents))
        start[n_q - 1] *= 1.4
        with pytest.raises(fb.ModelError, match="constraints"):
            model.linearize(0.0, start, scaled.parameters, scaled.inputs)
