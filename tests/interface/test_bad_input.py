"""Whatever is wrong in a call gets an error of the package's own, which names it and says what is allowed.

The calls with good arguments are those of fuzz/calls.py, which lists every public function. Wrong models are in
test_bad_models.py, drawings of linkages in equations/test_linkage.py, commands in test_cli.py, functions of JAX in
simulation/test_jax.py.
"""

import re
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from fuzz.calls import calls_of

import fourbar_codegen as fb
from fourbar_codegen.errors import shown

MODEL = fb.load("four_bar")
X0, X = MODEL.initial_state(), [0.1] * 6
STATES = np.tile(X0[:, np.newaxis], 3)
T = np.linspace(0.0, 1.0, 11)
K, F = sm.Symbol("k"), me.dynamicsymbols("F")
SHARED = np.zeros(6)

MINIMAL = {
    "simulate": (MODEL.simulate, {"t_span": (0.0, 1.0)}),
    "ensemble": (MODEL.ensemble, {"t_span": (0.0, 1.0)}),
    "initial_state": (MODEL.initial_state, {}),
    "initial_states": (MODEL.initial_states, {}),
    "equilibrium": (MODEL.equilibrium, {}),
    "kinematics": (MODEL.kinematics, {}),
    "page": (lambda **how: MODEL.page("unwritten.html", **how), {}),
    "fit": (fb.fit, {"model": MODEL, "data": {"t": T, "q2": T}, "parameters": ["k"]}),
    "rhs_batch": (MODEL.rhs_batch, {"t": 0.0, "x": STATES}),
    "residual_batch": (MODEL.residual_batch, {"t": 0.0, "x": STATES, "rates": STATES, "multipliers": STATES[:2]}),
    "trajectory.animate": (MODEL.simulate((0.0, 0.1)).animate, {}),
    "trajectory.gradient": (MODEL.simulate((0.0, 0.1), t_eval=[0.0, 0.1], gradient=True).gradient, {}),
}
"""Functions with what they need alone; the others take all arguments of fuzz/calls.py."""

TABLE = {
    "rhs": [
        ({"t": np.inf}, "finite", "inf"),
        ({"x": [0.1] * 5}, "(6,)", "(5,)"),
        ({"x": np.zeros((6, 1))}, "(6,)", "(6, 1)"),
        ({"x": 1.0}, "(6,)", "()"),
        ({"x": [10**400] * 6}, "state x", "real numbers"),
        ({"x": [np.nan, *X[1:]]}, "finite", "nan"),
        ({"p": {"l9": 1.0}}, "'l9'", "l1, l2, l3, l4"),
        ({"p": {"l2": "long"}}, "parameter l2", "'long'"),
        ({"p": {"l2": np.inf}}, "parameter l2", "inf"),
        ({"p": {"l2": 10**400}}, "parameter l2"),
        ({"p": {"k": 1.0, K: 2.0}}, "two values", "parameter k"),
        ({"p": [1.0, 2.0]}, "parameters p", "(8,)", "(2,)"),
        ({"p": [np.nan] * 8}, "parameters p", "finite"),
        ({"p": dict}, "parameters p", "dict"),
        ({"r": {"G": 1.0}}, "'G'", "F"),
        ({"r": [1.0, 2.0]}, "inputs r", "(1,)", "(2,)"),
        ({"r": [np.nan]}, "inputs r", "finite"),
        ({"out": np.empty(5)}, "out", "6"),
        ({"x": SHARED, "out": SHARED}, "out", "share memory"),
    ],
    "jacobian": [({"x": [0.1] * 5}, "(6,)", "(5,)")],
    "mass_matrix": [({"p": {"m": 1.0}}, "'m'", "rho")],
    "position_constraints": [({"q": X}, "(3,)", "(6,)")],
    "constraint_jacobian": [({"q": "abc"}, "coordinates", "'abc'")],
    "along": [({"times": [0.0, 1.0], "states": [X], "inputs": [[0.0, 0.0]]}, "(6, 2)", "(1, 6)")],
    "jvp": [
        ({"dx": np.ones(5)}, "has the shape (6,) or (6, n), not (5,)"),
        ({"dr": 0.1}, "has the shape (1,) or (1, n), not ()"),
        ({"dx": np.ones((6, 2)), "dp": np.ones((8, 3)), "dr": None}, "as many columns"),
    ],
    "vjp": [({"weights": np.ones(5)}, "The weights")],
    "rhs_batch": [
        ({"x": STATES[:, 0]}, "state"),
        ({"x": STATES[:5]}, "state"),
        ({"x": STATES + 0j}, "state"),
        ({"x": [["a"] * 3] * 6}, "state"),
        ({"x": "states"}, "state"),
        ({"t": [0.0, 1.0]}, "time"),
        ({"t": [[0.0]]}, "time"),
        ({"t": [0.0]}, "time"),
        ({"t": None}, "time"),
        ({"t": np.zeros((3, 1))}, "time"),
        ({"p": np.ones((8, 4))}, "parameter"),
        ({"p": np.ones((8, 1))}, "parameter"),
        ({"p": np.ones((8, 3, 1))}, "parameter"),
        ({"p": {"k": [1.0]}}, "parameter"),
        ({"p": {"k": np.ones(4)}}, "parameter"),
        ({"p": {"stiffness": 1.0}}, "parameter"),
        ({"r": np.ones((1, 1))}, "input"),
        ({"r": {"F": [5.0]}}, "input"),
        ({"r": [1.0, 2.0]}, "input"),
        ({"r": {"F": 1.0, F: 2.0}}, "two", "input F"),
        ({"workers": 0}, "workers"),
        ({"workers": 1.5}, "workers"),
        ({"out": np.empty((6, 4))}, "out must"),
        ({"out": np.empty((6, 3), dtype=np.float32)}, "out must"),
        ({"out": np.empty((3, 6)).T}, "out must"),
    ],
    "jacobian_batch": [({"x": X0}, "must have shape")],
    "residual_batch": [
        ({"rates": STATES[:, :2]}, "rates of the states must have shape (6, 3)"),
        ({"multipliers": None}, "has 2 multipliers"),
        ({"formulation": "index-2"}, "formulation", "index-1, index-3"),
    ],
    "residual_jacobian_batch": [({"wrt": ["x", "u"]}, "wrt"), ({"wrt": ()}, "wrt names nothing")],
    "residual_sparsity": [({"formulation": "index-2"}, "formulation")],
    "initial_state": [
        ({"coordinates": {"q2": 1.0}}, "'q2'", "guess=", "independent coordinates (q1)"),
        ({"coordinates": [1.0, 2.0]}, "independent coordinates", "(1,)", "(2,)"),
        ({"coordinates": [np.nan]}, "finite"),
        ({"coordinates": ["a"]}, "numbers", "'a'"),
        ({"guess": {"q1": 1.0}}, "'q1'", "dependent coordinate", "q2, q3"),
        ({"parameters": "abc"}, "parameters p", "'abc'"),
    ],
    "initial_states": [({"coordinates": {"q2": 1.0}}, "'q2' is a dependent coordinate: give a guess")],
    "modes[]": [
        ({"number": [1.0, [2.0, 3.0]]}, "known by its number", "[2.0, 3.0]"),
        ({"number": "a"}, "known by its number", "'a'"),
        ({"number": 1.5}, "known by its number", "1.5"),
        ({"number": None}, "known by its number", "None"),
        ({"number": True}, "known by its number", "True"),
    ],
    "kinematics": [
        ({"drive": {"q9": [0.0]}}, "q9"),
        ({"drive": {}}, "drive= is a mapping"),
        ({"drive": {"q1": [0.0, np.nan]}}, "finite"),
        ({"drive": {"q1": [[0.0]]}}, "one length"),
        ({"drive": {"q1": [0.0], "q2": [0.0, 1.0]}}, "one length"),
        ({"drive": {"F": [0.0]}}, "F"),
    ],
    "kinematics[]": [
        ({"number": None}, "known by its number", "None"),
        ({"number": True}, "known by its number", "True"),
        ({"number": slice(0, "a")}, "known by its number", "'a'"),
        ({"number": slice(None, None, 0)}, "known by its number", "slice"),
    ],
    "branch.transmission_angle": [({"joint": np.array(["A", "B"])}, "There is no point array")],
    "inverse_dynamics": [({"find": np.array("x")}, "find= is an input, or a sequence of inputs", "array('x'")],
    "equilibrium": [
        ({"guess": [0.0]}, "coordinate"),
        ({"inputs": {"F": lambda t, x: 5.0}}, "not callables"),
    ],
    "simulate": [
        ({"t_span": (0.0, np.nan)}, "t_span", "nan"),
        ({"t_span": (0.0,)}, "t_span", "two times"),
        ({"t_span": (1.0, 1.0)}, "t_span", "different"),
        ({"t_span": 3.0}, "t_span", "3.0"),
        ({"x0": [0.1] * 5}, "(6,)", "(5,)"),
        ({"x0": [np.nan] * 6}, "finite"),
        ({"x0": ["a"] * 6}, "states", "numbers"),
        ({"x0": np.ones(6), "method": "ALI3P", "max_step": 1e-3}, "violates the constraints"),
        ({"method": "Euler"}, "'Euler'", "DOP853", "Radau"),
        (
            {"method": "LSODA"},
            'solve_ivp(ode, t_span, x0, method="LSODA", jac=ode.jac, rtol=..., atol=...)',
            'method="Radau"',
        ),
        ({"method": "RK23"}, 'method="RK23", rtol=..., atol=...) with ode = model.ode(parameters, inputs)'),
        ({"method": np.array(["RK45", "DOP853"])}, "array", "DOP853, "),
        ({"method": "ALI3P"}, "max_step"),
        ({"method": "ALI3P", "max_step": 1e-3, "constraints": "baumgarte"}, "baumgarte"),
        ({"method": "IDA", "formulation": np.array(["index-1"] * 2)}, "array", "index-3"),
        ({"method": "IDA", "formulation": "index-4"}, "index-1"),
        ({"method": "IDA", "constraints": "baumgarte"}, "baumgarte"),
        ({"method": "Radau", "formulation": "index-1"}, "formulation is for IDA; Radau"),
        ({"constraints": "glue"}, "'glue'", "'project'", "'none'"),
        ({"constraints": np.array(["project", "none"])}, "array", "'project'"),
        ({"stabilization": 0.0}, "stabilization", "positive"),
        ({"t_eval": []}, "t_eval"),
        ({"t_eval": [0.0, 2.0]}, "t_eval", "2.0"),
        ({"t_eval": [0.5, 0.2]}, "t_eval", "order"),
        ({"t_eval": "now"}, "t_eval", "'now'"),
        ({"events": 5}, "events", "5"),
        ({"events": int}, "a function of (t, x), not the class int"),
        ({"rtol": np.nan}, "rtol", "nan"),
        ({"rtol": -1.0}, "rtol", "-1.0"),
        ({"atol": -1.0}, "atol", "-1.0"),
        ({"atol": [1e-6] * 5}, "atol", "(6,)"),
        ({"atol": [1e-3]}, "atol", "(6,)"),
        ({"max_step": 0.0}, "max_step"),
        ({"max_step": "long"}, "max_step"),
        ({"max_steps": 0}, "max_steps"),
        ({"max_steps": 1.5}, "max_steps"),
        ({"progress": True}, "progress"),
        ({"inputs": [1.0]}, "inputs", "mapping", "F"),
        ({"inputs": {"G": 1.0}}, "'G'", "F"),
        ({"inputs": {"F": "big"}}, "F", "'big'"),
        ({"inputs": {"F": np.nan}}, "F", "nan"),
        ({"inputs": {"F": lambda t, x: None}}, "input F", "None"),
        ({"inputs": {"F": ([0, 1], [1])}}, "F", "(2,)", "(1,)"),
        ({"inputs": {"F": ([1, 0], [1, 2])}}, "F", "increasing"),
        ({"inputs": {"F": ([0, 1], [1, np.nan])}}, "F", "finite"),
        ({"inputs": {"F": (1, 2, 3)}}, "F", "table"),
        ({"inputs": {"F": 1.0, F: 2.0}}, "two values", "input F"),
        ({"sensitivities": ["kk"]}, "no parameter, initial value or given input 'kk'. Did you mean k"),
        ({"sensitivities": ["q2"]}, "'q2' is dependent"),
        ({"sensitivities": ["k", "k"]}, "given twice"),
        ({"sensitivities": ["F"]}, "Input 'F' is given by its expression"),
        ({"sensitivities": ["F", "F"], "inputs": {"F": 1.0}}, "given twice"),
        ({"sensitivities": ["k"], "method": "Radau"}, "Radau has no sensitivities: use DOP853 or RK45"),
        ({"sensitivities": ["k"], "constraints": "baumgarte"}, 'constraints="baumgarte" has no sensitivities: use'),
        ({"gradient": True, "constraints": "baumgarte"}, 'constraints="baumgarte" has no gradient: use'),
        ({"gradient": True, "method": "CVODE"}, "CVODE has no gradient: use DOP853 or RK45"),
        ({"sensitivities": ["k"], "inputs": {"F": lambda t, x: 1.0}}, "callable, whose derivatives are not known"),
        ({"sensitivities": ["k"], "dx0": {"k": np.zeros(6)}}, "x0, which is not given"),
        ({"sensitivities": ["k"], "x0": X0, "dx0": {"k": np.zeros(5)}}, "must have shape"),
        ({"sensitivities": ["k"], "x0": X0, "dx0": {"c": np.zeros(6)}}, "no name to differentiate with respect to 'c'"),
        (
            {"sensitivities": ["F"], "x0": X0, "inputs": {"F": ([0.0, 1.0], [1.0, 2.0])}, "dx0": {"F": np.zeros(6)}},
            "of the shape (2, 6), not (6,)",
        ),
    ],
    "ensemble": [
        ({"t_span": (0.0, 0.0)}, "t_span"),
        ({"x0": np.zeros((3, 5))}, "x0"),
        ({"x0": np.full((3, 6), np.nan)}, "x0"),
        ({"method": "BDF"}, "method"),
        ({"method": np.array(["RK45", "DOP853"])}, "array", "DOP853"),
        ({"parameters": {"k": [1.0, 2.0], "c": [1.0, 2.0, 3.0]}}, "parameter"),
        ({"parameters": {"k": [1.0, 2.0]}, "x0": np.zeros((3, 6))}, "x0"),
        ({"parameters": {"k": [1.0, np.nan]}}, "parameter"),
        ({"parameters": {"kk": 1.0}}, "parameter"),
        ({"parameters": np.ones((3, 9))}, "parameter"),
        ({"inputs": {"G": 1.0}}, "input"),
        ({"inputs": {"F": np.ones(3)}, "parameters": {"k": [1.0, 2.0]}}, "input"),
        ({"inputs": [1.0]}, "inputs"),
        ({"inputs": {"F": np.array([1.0, np.nan])}}, "input"),
        ({"inputs": {"F": np.array(["1", "b"])}}, "input"),
        ({"inputs": {"F": np.array([1.0, lambda t, x: 1.0])}}, "input"),
        ({"t_eval": [0.0, 2.0]}, "t_eval"),
        ({"rtol": -1.0}, "rtol"),
        ({"rtol": []}, "rtol"),
        ({"atol": [1.0, 2.0]}, "atol"),
        ({"constraints": "baumgarte"}, "constraints"),
        ({"max_step": 0.0}, "max_step"),
        ({"max_step": np.array([1.0, 2.0])}, "max_step"),
        ({"workers": 0}, "workers"),
        ({"workers": np.timedelta64(1, "s")}, "workers", "timedelta64"),
        ({"parallel": 3}, "parallel"),
        ({"parallel": print}, "joblib.Parallel", "print"),
        ({"progress": np.zeros((0, 0))}, "progress", "True or False", "array"),
    ],
    "fit": [
        ({"model": "four_bar"}, "A compiled model is fitted"),
        ({"data": {"t": T, "q2": T[1:]}}, "11 times, and measurements of q2 of shape (10,)"),
        ({"data": {"t": T, "q2": np.where(T == 0.5, np.nan, T)}}, "at t = 0.5 is nan"),
        ({"data": {"q2": T}}, "no times: give them as 't', beside q2"),
        ({"data": {"t": T, "qq": T}}, "no state or output 'qq'"),
        ({"data": {"t": T[::-1], "q2": T}}, "increasing"),
        ({"data": {"t": T, "q2": T, "note": ["a"] * 11}}, "'note'"),
        ({"data": 3}, "not 3"),
        ({"data": fb.Experiment(T, {"q2": T}, coordinates=[-0.4])}, "coordinates of experiment 1 must be a mapping"),
        ({"data": fb.Experiment(T, {"q2": T}, start="a")}, "start of experiment 1 must be a real number"),
        ({"data": fb.Experiment(T, {"q2": T}, start=Fraction(1, 2))}, "start of experiment 1, 0.5, is after its first"),
        ({"data": fb.Experiment(T, {"q2": T}, inputs=np.ones(1))}, "inputs of experiment 1 must be a mapping"),
        ({"data": fb.Experiment(T, {"q2": T}, parameters={"k": 1.0})}, "k is an unknown, and has a known value"),
        ({"data": {"t": T[:2], "q2": T[:2]}, "parameters": ["k", "c", "g"]}, "2 measurements do not determine 3"),
        ({"parameters": ["q2"]}, "'q2' is dependent"),
        ({"parameters": ["kk"]}, "no parameter, initial value or given input 'kk'. Did you mean k"),
        ({"parameters": []}, "nothing to fit"),
        ({"parameters": ["F"]}, "'F' is an input: give its expression a parameter, and fit this"),
        ({"parameters": {"k": -1.0}, "bounds": {"k": (0.0, 1.0)}}, "outside of its bounds"),
        ({"bounds": {"k": (1.0, 0.0)}}, "two increasing numbers"),
        ({"bounds": [(0.0, 1.0)]}, "must be a mapping from names"),
        ({"sigma": {"q2": 0.0}}, "sigma of q2 must be a positive"),
        ({"sigma": {}}, "sigma has no standard deviation of q2"),
        ({"sigma": {"q3": 0.1}}, "sigma has no standard deviation of q2"),
        ({"loss": "huber"}, "tells outliers by their residuals in units of sigma: give sigma"),
        ({"loss": "none"}, "no loss 'none'"),
        ({"outputs": ["q3"]}, "Nothing was measured of 'q3'"),
        ({"constraints": "baumgarte"}, "no option constraints= of a fit 'baumgarte'; there are project, none"),
        ({"max_nfev": 0}, "max_nfev must be a positive integer"),
        ({"method": "CVODE"}, "CVODE has no sensitivities"),
    ],
    "stepper": [
        ({"h": 0.0}, "h must not be 0"),
        ({"x0": X}, "initial_state"),
        ({"r": {"G": 1.0}}, "'G'"),
        ({"r": [np.nan]}, "finite"),
        ({"events": ["q9"]}, "'q9'", "kinetic_energy"),
        ({"method": "DOP853"}, "There is no method 'DOP853'", "RK4, Radau"),
    ],
    "ode.inputs_along": [({"times": [np.nan], "states": np.zeros((6, 1))}, "times", "finite")],
    "trajectory[]": [({"name": "q9"}, "'q9'", "q1, q2, q3")],
    "trajectory.gradient": [
        ({"cost": np.ones((2, 6))}, "must have the shape (6, 2)"),
        ({"cost": {"q1": [1.0, 2.0, 3.0]}}, "must have the shape (2,), not (3,)"),
        ({"cost": {"qq": 1.0}}, "no state or output 'qq'"),
        ({"cost": {"q1": [np.nan, 1.0]}}, "must be finite"),
    ],
    "trajectory.save csv": [
        ({"path": "run.xyz"}, ".csv", "run.xyz"),
        ({"path": "/dev/null/run.csv"}, "/dev/null/run.csv"),
    ],
    "trajectory.animate": [({"speed": 1e-4}, "larger speed"), ({"traces": "P2"}, "sequence of their names")],
    "trajectory.plot_paths": [({"points": ["P9"]}, "no point P9"), ({"points": np.ma.masked}, "Points", "masked")],
    "load_trajectory": [
        ({"path": None}, "path"),
        ({"path": "no-such-file.nc"}, "no such file"),
        ({"model": "four_bar"}, "CompiledModel"),
    ],
    "page": [
        ({"inputs": {"F": lambda t, x: 1.0}}, "Input F of a page is a number, the model's own expression, or a table"),
        ({"inputs": {"F": ([0, 1], [0, 1])}}, "a table that is interpolated cannot be put into a file"),
        ({"inputs": {"F": ([0, 1], [0, 1], "pchip")}}, "a table that is interpolated cannot be put into a file"),
        ({"inputs": {"G": 1.0}}, "There is no input 'G'"),
        ({"traces": ["P9"]}, "There is no point P9"),
        ({"events": ["q9"]}, "'q9'", "kinetic_energy"),
        ({"events": lambda t, x: x[0]}, "An event of a page is the name of a quantity", "output of the model"),
        ({"watch": [("most", "q1")]}, "watch= is a list of pairs"),
        ({"watch": ["q1"]}, "watch= is a list of pairs"),
        ({"ranges": ["l2"]}, "ranges= is a mapping"),
        ({"ranges": {"l9": (0, 1)}}, "There is no parameter or initial value 'l9'"),
        ({"height": 0}, "height must be a positive number of pixels"),
        ({"method": "LSODA"}, "There is no method for pages 'LSODA'", "Radau"),
        ({"t_span": (0.0, np.nan)}, "t_span"),
    ],
    "load": [
        ({"name": "five_bar"}, "'five_bar'", "four_bar"),
        ({"name": __file__}, "test_bad_input.py", "compiled model"),
        ({"name": None}, "None"),
        ({"name": "os"}, "'os'", "four_bar"),
        ({"name": "__main__"}, "'__main__'"),
    ],
    "Parameter": [
        ({"value": np.nan}, "finite"),
        ({"value": "heavy"}, "'heavy'"),
        ({"value": sm.Lambda(K, K)}, "parameter", "Lambda"),
        ({"unit": None}, "unit", "None"),
        ({"description": 5}, "description", "5"),
    ],
    "Event": [
        ({"direction": "up"}, "direction"),
        ({"direction": np.nan}, "direction"),
        ({"terminal": -1}, "terminal"),
        ({"terminal": 2.7}, "terminal"),
        ({"all_roots": 1}, "all_roots must be True or False, not 1"),
        ({"at_start": "yes"}, "at_start must be True or False, not 'yes'"),
        ({"function": 5}, "callables of (t, x) or names of quantities, not 5"),
        ({"function": int}, "a function of (t, x), not the class int"),
        ({"function": lambda t: t}, "called with (t, x)", "its arguments are (t)"),
    ],
    "multiplier": [({"number": 0}, "0", "from 1"), ({"number": "a"}, "'a'")],
    "joint_force": [({"directions": {1: K}}, "joint_force", "vectors"), ({"directions": [K]}, "mapping")],
    "compile_model": [({"model": fb.models.four_bar().system}, "Model", "System"), ({"check": 1}, "check", "1")],
    "generate_sources": [({"model": fb.models.four_bar().system}, "Model", "System")],
    "export_c": [({"model": "four_bar"}, "A Model is needed"), ({"folder": ""}, "No file can have the path ''")],
    "export_fmu": [
        ({"fmi": 1}, "2 or 3, not 1"),
        ({"fmi": [3]}, "2 or 3, not [3]"),
        ({"platforms": ["amiga"]}, "not for 'amiga'"),
        ({"platforms": "aarch64-linux"}, "sequence of x86_64-linux"),
        ({"platforms": ["aarch64-linux"], "fmi": 2}, "FMI 2.0 has no name for aarch64-linux"),
    ],
    "build_wheel": [({"version": "new"}, "version"), ({"model": 5}, "Model", "int")],
    "models.chain": [
        ({"closed": []}, "closed", "True or False", "[]"),
        ({"links": 2, "closed": True}, "links", "3 to 1000", "2"),
    ],
    "Linkage": [
        ({"name": 5}, "name is text, not 5"),
        ({"points": [("A", (0, 0))]}, "mapping from names to coordinates"),
        ({"points": {"A": 1.0}}, "two finite coordinates, (x, y), not 1.0"),
        ({"points": {"A": np.zeros((2, 2))}}, "two finite coordinates"),
        ({"points": {"A": (0.0, np.nan)}}, "two finite coordinates"),
        ({"points": {5: (0.0, 1.0)}}, "The name of a point is a letter", "5"),
        ({"ground": np.array("A")}, "ground= is a sequence of names of points"),
        ({"ground": {"A": 1, "D": 2}}, "ground= is a sequence of names of points"),
        ({"links": {"AB", "CD"}}, "links= is a sequence of links"),
        ({"links": [None]}, "Each of links= is a sequence of names of points, not None"),
        ({"links": [[]]}, "Link needs two and more different points, not none"),
        ({"ground": [["A"]]}, "There is no point ['A']; there are A, B, C, D, P"),
        ({"links": np.array("AB")}, "links= is a sequence of links"),
        ({"density": "a b"}, "made of letters, digits", "'a b'"),
        ({"gravity": np.ones(2)}, "gravitational acceleration must be a real number"),
        ({"independent": np.array("AB")}, "independent= is the name of a link or block, or a sequence of these"),
    ],
    "linkage.joint": [({"place": np.ma.array([0.1, 0.2], mask=[True, False])}, "(x, y) of point E must be real")],
    "linkage.plate": [({"name": 5}, "A link's name is a letter", "5 is not")],
    "linkage.slider": [({"along": 1.0}, "along= of P is a direction (x, y), or two points, not 1.0")],
    "linkage.force": [
        ({"components": {2.0, 1.0}}, "two components, along x and y", "{"),
        ({"components": {"y": 7.0, "x": 5.0}}, "two components, along x and y"),
        ({"components": np.array(1.0)}, "two components, along x and y"),
        ({"components": [np.ones(2), 0.0]}, "force on P along x must be a real number"),
    ],
    "linkage.torque": [
        ({"at": []}, "There is no joint or link [] for a torque"),
        ({"link": np.array(["AB", "CD"])}, "name the link on which it acts, not array"),
    ],
    "linkage.drive": [({"at": ["A"]}, "There is no joint or link ['A'] for a drive")],
    "linkage.model": [({"outputs": {1: 2}}, "mapping from names to expressions, and 1 is no name")],
    "models.n_four_bar": [({"loops": 10**400}, "loops", "1 to 1000", "10000")],
}


def rows():
    for name, entries in TABLE.items():
        for wrong, *words in entries:
            yield pytest.param(name, wrong, words, id=f"{name}-{', '.join(wrong)}-{words[0]}")


@pytest.mark.parametrize(("name", "wrong", "words"), [*rows()])
def test_errors_of_wrong_arguments_name_what_is_wrong_and_what_is_allowed(name, wrong, words):
    call = calls_of("four_bar").get(name)
    function, arguments = MINIMAL.get(name) or (call.function, call.arguments)
    with pytest.raises(fb.ModelError) as caught:
        function(**{**arguments, **wrong})
    for word in words:
        assert word in str(caught.value)


WORDS = {
    **dict.fromkeys(("accelerations", "multipliers", "weights", "forces", "change", "cost", "states"), "{}"),
    **dict.fromkeys(("rtol", "atol", "t_bound", "first_step", "t0", "y0", "t_eval", "t_span"), "{}"),
    **dict.fromkeys(("fps", "speed", "height", "rates", "bounds", "loss", "sigma", "outputs", "formulation"), "{}"),
    **dict.fromkeys(("constraints", "workers", "progress", "dense_output", "stabilization", "max_steps", "out"), "{}"),
    **dict.fromkeys(("max_nfev", "direction", "terminal", "check", "closed", "version", "drive", "names"), "{}"),
    **dict.fromkeys(("ranges", "watch", "platforms", "initial", "potential_energy", "unit", "description"), "{}"),
    **dict.fromkeys(("links", "loops", "number", "events", "method", "parallel"), "{}"),
    "value": "value",
    "linkage.torque.value": "torque on AB",
    "max_step": r"max_step\b",
    "h": r"of h\b",
    "t": "time t|value of t|times",
    "times": "[Tt]imes",
    "x": "state",
    "x0": "x0|states",
    "q": "coordinates",
    "p": "parameters",
    "r": "inputs",
    "dx": "direction in the states",
    "dp": "direction in the parameters",
    "dr": "direction in the inputs",
    "inputs": "inputs",
    "parameters": "parameters",
    "coordinates": "independent coordinates",
    "speeds": "independent speeds",
    "guess": "coordinate",
    "motion": "A motion is",
    "find": "find=",
    **dict.fromkeys(("a", "b", "joint"), "no point"),
    **dict.fromkeys(("mass", "inertia", "stiffness", "length", "coefficient"), "{} "),
    "density": "by length",
    **dict.fromkeys(("ground", "independent"), "{}="),
    "along": "along= of P|guide of P|no point",
    "at": "no joint or link",
    "link": "name the link",
    "place": "coordinates .* of point",
    "center": "mass centre",
    "components": "force on P",
    "gravity": "gravitational acceleration",
    "angle": "drive",
    "point": "no point",
    "data": "Data are",
    "model": "[Mm]odel",
    "system": "System",
    "name": "name|quantity",
    "key": "quantity",
    "points": "Points",
    "Linkage.points": "points= is a mapping",
    "traces": "Points",
    "path": "path",
    "folder": "path",
    "fmi": "FMI",
    "directions": "mapping",
    "function": "events",
    "frame": "frame",
}
"""What an error names an argument, by default by its name; a regular expression. Of one call, if that is named."""


def words_of(name, argument):
    return WORDS.get(f"{name}.{argument}", WORDS[argument]).format(argument)


def replacing(call, argument):
    return lambda value: call.function(**{**call.arguments, argument: value})


def not_refused(call, value, words):
    """What a value gets instead of an error with the words."""
    try:
        return f"{shown(value)} is accepted: {shown(call(value))}"
    except fb.ModelError as error:
        return None if re.search(words, str(error)) else str(error)


def test_arguments_of_another_kind_are_refused_by_name_in_every_call():
    found = {}
    for name, call in calls_of("four_bar").items():
        for argument in call.arguments.keys() - {"force"}:  # which SymPy refuses
            found[name, argument] = not_refused(replacing(call, argument), object(), words_of(name, argument))
    assert len(found) > 500
    assert not {case: said for case, said in found.items() if said}


def no_numbers(shape):
    """What is of a shape that would do, and no array of real numbers."""
    yield from ("1.0", b"1", {0.3}, sm.Symbol("a"), [[1.0], [1.0, 2.0]], 10**400, 10**5000)
    for value in ("1.0", 1.0 + 0.0j, np.timedelta64(1, "s"), np.datetime64("2020-01-01"), np.complex128(1.0)):
        yield np.full(shape, value)
        yield np.full(shape, value, dtype=object)
        yield np.full(shape, value).tolist()
    yield np.ma.array(np.full(shape, 0.3), mask=True)
    yield [np.ma.masked] * (shape[0] if shape else 1)
    yield np.zeros(shape, dtype=[("x", float)])


SPAN = (0.0, 0.1)
INSIDE = {
    "parameter by name": ((), lambda v: MODEL.rhs(0.0, X, {"k": v}), "parameter k"),
    "parameters of a batch by name": ((3,), lambda v: MODEL.rhs_batch(0.0, STATES, {"k": v}), "parameter k"),
    "t_span": ((2,), MODEL.simulate, "t_span"),
    "end of t_span": ((), lambda v: MODEL.simulate((0.0, v)), "t_span"),
    "rtol": ((), lambda v: MODEL.simulate(SPAN, rtol=v), "rtol"),
    "atol": ((6,), lambda v: MODEL.simulate(SPAN, atol=v), "atol"),
    "atol of a solver": ((6,), lambda v: fb.solvers.LSODA(MODEL.ode(), 0.0, X, 1.0, atol=v), "atol"),
    "input": ((), lambda v: MODEL.simulate(SPAN, inputs={"F": v}), "[Ii]nput F"),
    "times of a table": ((2,), lambda v: MODEL.simulate(SPAN, inputs={"F": (v, [0.0, 1.0])}), "Input F .* times"),
    "values of a table": ((2,), lambda v: MODEL.simulate(SPAN, inputs={"F": ([0.0, 1.0], v)}), "Input F .* values"),
    "value of a callable": ((), lambda v: MODEL.simulate(SPAN, inputs={"F": lambda t, x: v}), "callable of input F"),
    "value of an event": ((), lambda v: MODEL.simulate(SPAN, events=lambda t, x: v), "value of an event's callable"),
    "independent coordinates": ((1,), lambda v: MODEL.initial_state([None] if v is None else v), "coordinate"),
    "guess": ((2,), lambda v: MODEL.initial_state(guess=[None] if v is None else v), "dependent coordinate"),
    "times of a solver's": ((2,), MODEL.simulate(SPAN, method="CVODE", dense_output=True).sol, "times"),
    "value of a parameter": (
        (),
        lambda v: fb.Parameter([] if v is None or isinstance(v, sm.Symbol) else v),
        "parameter",
    ),
}
"""Shapes of numbers inside of other arguments, calls with them, and what an error names them."""


@pytest.mark.filterwarnings("ignore::UserWarning")  # NumPy's, of masked entries that become nan
def test_arguments_that_are_no_numbers_are_refused_by_name_in_every_call():
    found = {}
    for name, call in calls_of("four_bar").items():
        for argument, good in call.arguments.items():
            of_numbers = isinstance(good, float | np.ndarray) and np.size(good)
            for value in no_numbers(np.shape(good)) if of_numbers else ():
                may_be_symbol = name == "Parameter" or name.lower().startswith("linkage")
                if not (may_be_symbol and isinstance(value, sm.Symbol)):
                    said = not_refused(replacing(call, argument), value, words_of(name, argument))
                    found[name, argument, shown(value)] = said
    assert len(found) > 5000
    assert not {case: said for case, said in found.items() if said}


@pytest.mark.parametrize("case", INSIDE)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_is_no_number_inside_of_an_argument_is_refused_by_its_name(case):
    shape, call, words = INSIDE[case]
    values = no_numbers(shape) if case in ("rtol", "atol") else (*no_numbers(shape), None)  # whose default is None
    found = {shown(value): not_refused(call, value, words) for value in values}
    assert not {value: said for value, said in found.items() if said}


def test_arguments_of_all_classes_of_numbers_give_the_same_rates():
    # Exact in float32.
    x = np.array([0.5, 0.25, -0.125, 1.0, 2.0, -3.0])
    rates = MODEL.rhs(1.0, x)
    others = [x.tolist(), tuple(x), x.astype(np.float32), x.astype(np.longdouble), [Fraction(v) for v in x]]
    for given in (*others, [Decimal(v) for v in x], [sm.Float(v) for v in x], x.astype(object)):
        np.testing.assert_array_equal(MODEL.rhs(1.0, given), rates)
    for t in (1, True, np.float32(1.0), np.int8(1), np.array(1), Fraction(1), sm.Integer(1)):
        np.testing.assert_array_equal(MODEL.rhs(t, x), rates)


def test_series_as_parameters_or_inputs_are_read_by_their_index():
    class Series:
        """As of pandas: named values that are not a Mapping."""

        def __init__(self, values):
            self.values = values

        def keys(self):
            return self.values.keys()

        def items(self):
            return self.values.items()

    values = dict(reversed(MODEL.defaults.items()))
    np.testing.assert_array_equal(MODEL.rhs(0.0, X, Series(values)), MODEL.rhs(0.0, X))
    assert MODEL.simulate(SPAN, method="Radau", inputs=Series({"F": 1.0})).success
