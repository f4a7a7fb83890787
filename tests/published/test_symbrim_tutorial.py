"""The four-bar linkage of SymBRiM's tutorial, by all ways in which a model is used.

Source: SymBRiM tutorial, "Four-bar Linkage", https://mechmotum.github.io/symbrim/tutorials/four_bar_linkage.html. The
printed numbers have 8 to 15 digits; the full ones come from a code in absolute angles with the constraints in a KKT
matrix, without SymPy.
"""

import ctypes

import fmpy
import numpy as np
import pytest
from harness.c_library import Library
from harness.programs import compile_c

import fourbar_codegen as fb
from fourbar_codegen.page.webassembly import SOURCES, page_source

Q0_PRINTED = [-0.5, -2.24641553739307, -1.49782726919522]
U0_PRINTED = [-0.1, 0.0715829929380234, -0.0274688413154955]
RATES_PRINTED = [-0.1, 0.07158299, -0.02746884, -9.26918156, 6.63703663, -2.55110976]
LAST_DIGIT = 5.1e-9  # half a unit of the last printed one
Q0 = [-0.5, -2.2464155373927537, -1.4978272691959325]
ACCELERATIONS = [-9.26918156051222, 6.637036631995938, -2.5511097559793323]


def test_initial_state_of_the_four_bar_is_that_of_the_tutorial(four_bar):
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, guess=[-1.5, -1.5])
    np.testing.assert_allclose(x0[:3], Q0, rtol=0, atol=1e-9)
    # The tutorial's own fsolve stopped 2e-12 short of the full-precision values.
    np.testing.assert_allclose(x0, [*Q0_PRINTED, *U0_PRINTED], rtol=0, atol=1e-9)


def test_rates_of_the_four_bar_at_its_start_are_those_of_the_tutorial(four_bar):
    x0 = np.array([*Q0, *four_bar.initial_state({"q1": -0.5}, {"u1": -0.1})[3:]])
    rates = four_bar.rhs(0.0, x0)
    np.testing.assert_allclose(rates[3:], ACCELERATIONS, rtol=0, atol=1e-11)
    np.testing.assert_allclose(rates, RATES_PRINTED, rtol=0, atol=LAST_DIGIT)


def test_run_without_projection_takes_the_tutorials_steps_and_opens_its_loop(four_bar):
    """18 steps, 122 evaluations, and 1.56e-2 m at 4 s, with the force F(t) = 100 sin(pi t) on joint 3."""
    run = four_bar.simulate((0.0, 4.0), method="RK45", rtol=1e-3, atol=1e-6, constraints="none")
    assert (len(run.t), run.nfev) == (19, 122)
    assert np.abs(run.constraint_residual[:, -1]).max() == pytest.approx(1.56e-2, abs=5e-5)


def test_residual_of_the_equations_vanishes_at_the_printed_rates(four_bar):
    """For direct collocation. Products of printed rates with masses of 80 kg m^2 have errors of 1e-6."""
    x0 = four_bar.initial_state()
    multipliers = four_bar.multipliers(0.0, x0)
    residual = four_bar.residual_batch(
        [0.0], x0[:, np.newaxis], np.array([RATES_PRINTED]).T, multipliers[:, np.newaxis]
    )
    np.testing.assert_allclose(residual, 0.0, rtol=0, atol=1e-6)


def test_right_hand_side_in_jax_has_the_printed_rates(four_bar):
    jax = pytest.importorskip("jax")
    jax.config.update("jax_enable_x64", True)
    try:
        rates = fb.to_jax(four_bar).rhs(0.0, four_bar.initial_state())
    finally:
        jax.config.update("jax_enable_x64", False)
    np.testing.assert_allclose(rates, RATES_PRINTED, rtol=0, atol=LAST_DIGIT)


def test_c_library_closes_the_loop_and_has_the_printed_rates(tmp_path):
    library = Library(fb.models.four_bar(), tmp_path)
    mechanism, rates = library.new(), np.empty(6)
    assert library.call("close", mechanism) == 0
    np.testing.assert_allclose(mechanism.x, [*Q0_PRINTED, *U0_PRINTED], rtol=0, atol=1e-9)
    assert library.call("rhs", mechanism, 0.0, np.array(mechanism.x), rates) == 0
    np.testing.assert_allclose(rates, RATES_PRINTED, rtol=0, atol=LAST_DIGIT)


def test_fmu_begins_in_the_printed_state_with_the_printed_rates(tmp_path, unoptimized):
    path = str(fb.export_fmu(fb.models.four_bar(), tmp_path / "four_bar.fmu"))
    names = ["q1", "q2", "q3", "u1", "u2", "u3"]
    found = fmpy.simulate_fmu(path, stop_time=0.01, output=[*names, "der(u1)", "der(u2)", "der(u3)"])[0]
    np.testing.assert_allclose([found[name] for name in names], [*Q0_PRINTED, *U0_PRINTED], rtol=0, atol=1e-9)
    rates = [found[f"der({name})"] for name in names[3:]]
    np.testing.assert_allclose(rates, RATES_PRINTED[3:], rtol=0, atol=LAST_DIGIT)


def test_code_of_a_live_page_closes_the_loop_and_has_the_printed_rates(tmp_path, four_bar):
    """The C that a browser runs, compiled for this machine: `export_name` is WebAssembly's, and has no effect here."""
    sources = fb.generate_sources(fb.models.four_bar())
    for suffix in SOURCES:
        (tmp_path / f"four_bar{suffix}").write_text(sources[f"four_bar{suffix}"])
    main = tmp_path / "four_bar_page.c"
    main.write_text(page_source("four_bar", four_bar.layout))
    command = ("gcc", "-std=c11", "-O1", "-fPIC", "-shared", "-Wno-attributes", "-lm")
    compile_c(command, [main], tmp_path / "page.so", [fb.get_include(), tmp_path])
    page = ctypes.CDLL(str(tmp_path / "page.so"))
    page.state.restype = ctypes.POINTER(ctypes.c_double)
    page.reset()
    assert page.update() == 0
    assert page.close_loops(ctypes.c_double(0.0)) == 0
    x0, rates = np.array(page.state()[:6]), np.empty(6)
    np.testing.assert_allclose(x0, [*Q0_PRINTED, *U0_PRINTED], rtol=0, atol=1e-9)
    assert page.evaluate(ctypes.c_double(0.0), *(a.ctypes.data_as(ctypes.c_void_p) for a in (x0, rates))) == 0
    np.testing.assert_allclose(rates, RATES_PRINTED, rtol=0, atol=LAST_DIGIT)
