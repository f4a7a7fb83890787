"""Calls of every public name with odd arguments.

Only the package's own errors come out, and those that are documented; what is returned is finite, or says why not; and
what means the same gives the same.
"""

from __future__ import annotations

import atexit
import inspect
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import timedelta
from decimal import Decimal
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import pendulum
from sympy.physics.mechanics.system import System
from sympy.physics.units import meter

import fourbar_codegen as fb

# --- what is odd ------------------------------------------------------------------------------------------------------

SCALARS = [
    None, "text", "", "1.0", "nan", b"bytes", True, 1j, 2 + 0j, math.nan, math.inf, -math.inf, 1e308, -1e308, 1e200,
    5e-324, 0.0, -0.0, 1e-300, 10**400, -(10**400), -1, 0, 2.5, Fraction(1, 3), Decimal("0.1"), Decimal("nan"),
    timedelta(1), object(), NotImplemented, Ellipsis, slice(None), print, fb.ModelError, np.float32(0.5),
    np.float64("nan"), np.longdouble(0.5), np.datetime64("2020"), np.timedelta64(1, "s"), np.bool_(True), np.ma.masked,
]  # fmt: skip

CONTAINERS: list[Callable[[], Any]] = [
    list, dict, tuple, set, lambda: [1.0, [2.0, 3.0]], lambda: [None], lambda: [[[]]], lambda: iter([1.0, 2.0]),
    lambda: (i for i in range(3)), lambda: range(3), lambda: {None: 1.0}, lambda: {1.0: 2.0}, lambda: {"": 0.0},
    lambda: {"q1": math.nan}, lambda: {"nonsense": 1.0}, lambda: {"F": "text"}, lambda: {"F": lambda t, x: None},
    lambda: {"F": lambda t, x: math.nan}, lambda: {"F": lambda t, x: x}, lambda: {"F": ([0.0, 1.0], [1.0])},
    lambda: {"F": ([0.0, 0.0], [1.0, 2.0])}, lambda: {"F": ([], [])}, lambda: {"F": ([0.0, math.nan], [1.0, 2.0])},
    lambda: {"F": (["a", "b"], [1.0, 2.0])}, lambda: {"F": 10**400}, lambda: {"F": 1e308}, lambda: np.array(None),
    lambda: np.array("x"), lambda: np.zeros(0), lambda: np.zeros((0, 0)), lambda: np.zeros((2,) * 5),
    lambda: np.array([1, "a"], dtype=object), lambda: np.array([(1.0, 2)], dtype=[("a", float), ("b", int)]),
    lambda: np.array([[1.0], [2.0, 3.0]], dtype=object), lambda: np.matrix([[1.0, 2.0]]),
    lambda: memoryview(b"12345678"),
    lambda: lambda t, x: 1.0, lambda: lambda t, x: "text", lambda: lambda t, x: x, lambda: lambda t, x: math.nan,
]  # fmt: skip

q, t = me.dynamicsymbols("q"), me.dynamicsymbols._t
m = sm.Symbol("m")
EXPRESSIONS = [
    sm.nan, sm.zoo, sm.oo, sm.I, sm.true, sm.S.EmptySet, 10**400 * q, sm.Float("1e400") * q, sm.MatrixSymbol("A", 2,
    2)[0, 0],
    sm.MatrixSymbol("A", 2, 2), sm.IndexedBase("a")[0], sm.IndexedBase("a")[sm.Symbol("i")], meter, 2 * meter * q,
    sm.Limit(sm.sin(q) / m, m, 0), sm.Subs(sm.Function("f")(m), m, q), sm.Subs(m**2, m, q), sm.Integral(m, m),
    sm.Integral(sm.sin(m), (m, 0, q)), sm.Derivative(sm.Function("f")(m), m), sm.Sum(m, (sm.Symbol("i"), 0, 3)),
    sm.Function("custom")(q), sm.Matrix([1, 2]), sm.Tuple(1, 2), q > 0, sm.Eq(q, 0), sm.Lambda(m, m), sm.Dummy("m"),
    sm.Wild("w"), sm.Symbol("\0"), sm.Symbol("\ud800"), sm.Symbol("x" * 5000), sm.Symbol(""), sm.gamma(q),
    sm.Heaviside(q),
    sm.DiracDelta(q), sm.sinc(q), sm.Piecewise((q, q > 0)), sm.Piecewise((1, q > 0), (sm.nan, True)), sm.Mod(q, 0,
    evaluate=False),
    sm.factorial(q), sm.binomial(q, 2), sm.conjugate(q), sm.re(q), sm.arg(q), sm.LambertW(q), sm.erf(q), sm.besselj(1,
    q),
    sm.Max(), sm.Min(q, sm.oo), sm.floor(q), sm.sign(q), q.diff(t, 4), me.dynamicsymbols("F").diff(t), sm.acos(2),
    sm.sqrt(-1 - q**2), sm.log(0), q / sm.Integer(0), sm.Pow(0, -1, evaluate=False), sm.Rational(1, 10**400) * q,
]  # fmt: skip

SAME: dict[str, Callable[[np.ndarray], Any]] = {
    "list": lambda a: a.tolist(),
    "tuple": lambda a: tuple(a.tolist()),
    "big endian": lambda a: a.astype(">f8"),
    "strided": lambda a: np.repeat(a, 2, axis=-1)[..., ::2],
    "turned around": lambda a: np.flip(np.flip(a).copy()),
    "unaligned": lambda a: np.frombuffer(b"\0" + a.tobytes(), dtype=np.uint8)[1:].view(float).reshape(a.shape),
    "columns": np.asfortranarray,
    "read only": lambda a: np.frombuffer(a.tobytes()).reshape(a.shape),
    "objects": lambda a: a.astype(object),
    "long double": lambda a: a.astype(np.longdouble),
    "masked by nothing": np.ma.array,
}

OTHER: dict[str, Callable[[np.ndarray], Any]] = {
    "one less": lambda a: a[:-1],
    "one more": lambda a: np.concatenate((a, a[:1])),
    "a row": lambda a: a[np.newaxis],
    "a column": lambda a: a[..., np.newaxis],
    "transposed twice": lambda a: np.stack((a, a), axis=-1),
    "not a number": lambda a: np.where(np.arange(a.size).reshape(a.shape) == a.size // 2, np.nan, a),
    "infinite": lambda a: np.where(np.arange(a.size).reshape(a.shape) == a.size // 2, np.inf, a),
    "huge": lambda a: a * 1e300,
    "large": lambda a: a * 1e150,
    "tiny": lambda a: a * 1e-300,
    "zero": np.zeros_like,
    "complex": lambda a: a + 0j,
    "text": lambda a: a.astype(str),
    "bytes": lambda a: a.astype("S"),
    "times": lambda a: a.astype("M8[s]"),
    "masked": lambda a: np.ma.array(a, mask=np.arange(a.size).reshape(a.shape) == 0),
    "truth": lambda a: a.astype(bool),
    "half": lambda a: a.astype(np.float16),
    "nothing": lambda a: a[:0],
    "nested": lambda a: [*a.tolist()[1:], [1.0, [2.0]]],
    "with none": lambda a: [*a.tolist()[1:], None],
    "beyond double": lambda a: [*a.tolist()[1:], 10**400],
    "matrix": lambda a: np.matrix(a) if a.ndim < 3 else a,
}


def odd(generator: np.random.Generator, good: Any) -> tuple[Any, str, bool]:
    """What stands in the place of a good argument, what it is, and whether it means the same."""
    kind = generator.random()
    if isinstance(good, np.ndarray) and kind < 0.6:
        changes = SAME if kind < 0.3 else OTHER
        name = str(generator.choice(list(changes)))
        return changes[name](good), name, changes is SAME
    if isinstance(good, dict) and good and kind < 0.6:
        key = list(good)[generator.integers(len(good))]
        value, name, _ = odd(generator, good[key])
        if kind < 0.4:
            return {**good, key: value}, f"{key}: {name}", False
        strange = SCALARS[generator.integers(len(SCALARS))]
        try:
            return {**good, strange: 1.0}, f"with {strange!r}", False
        except TypeError:  # it cannot be a key
            return value, name, False
    if isinstance(good, str | Path) and kind < 0.4:
        text = str(good)
        strange = [f"{text}\0", f"\ud800{text}", f"{'x' * 5000}{text}", f"{text}/{text}", f"/dev/null/{text}", text[1:]]
        value = strange[generator.integers(len(strange))]
        return value, repr(value[:40]), False
    if isinstance(good, sm.Basic) and kind < 0.7:
        value = EXPRESSIONS[generator.integers(len(EXPRESSIONS))]
        return value, repr(value)[:60], False
    if kind < 0.8:
        value = SCALARS[generator.integers(len(SCALARS))]
    else:
        value = CONTAINERS[generator.integers(len(CONTAINERS))]()
    return value, repr(value)[:200], False


# --- what is called ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Call:
    """A function with good arguments, by name; and what its documentation says besides."""

    function: Callable[..., Any]
    arguments: dict[str, Any]
    errors: tuple[type[Exception], ...] = ()
    may_be_nan: bool = False
    share: float = 1.0
    """How often it is called, where 1 is usual; less for what takes long."""


@dataclass
class Calls:
    """All calls of a model and of what comes with it."""

    model: fb.CompiledModel
    all: dict[str, Call] = field(default_factory=dict)

    def add(self, name: str, function: Callable[..., Any], /, *, errors: Any = (), may_be_nan: bool = False,
            share: float = 1.0, **arguments: Any) -> None:  # fmt: skip
        """One more; `arguments` are good ones."""
        self.all[name] = Call(
            function, arguments, errors if isinstance(errors, tuple) else (errors,), may_be_nan, share
        )


NOT_FOR_USERS = {
    "lacks_batch_functions", "lacks_derivatives", "lacks_drawing", "lacks_products",
    "require_batch_functions", "require_derivatives", "require_drawing", "require_products",
}  # fmt: skip
"""Names of `CompiledModel` without arguments of a user."""


@cache
def calls_of(name: str) -> dict[str, Call]:
    """Every public name: of the package, of the model that is named, and of what its functions return."""
    model = fb.load("four_bar") if name == "four_bar" else fb.compile_model(fb.models.slider_crank())
    calls = Calls(model)
    kernel, x0 = model.kernel, model.initial_state()
    p, r = np.array(list(model.defaults.values())), kernel.default_inputs(0.3)
    state = {"t": 0.3, "x": x0}
    values = {"p": p, "r": r}
    for function in (
        "rhs", "jacobian", "parameter_jacobian", "input_jacobian", "forcing", "tree_forcing",
        "velocity_constraints", "multipliers", "output", "output_jacobian", "output_parameter_jacobian",
        "output_input_jacobian", "kinetic_energy", "potential_energy", "linearize", "state_space",
    ):  # fmt: skip
        calls.add(function, getattr(model, function), **state, **values)
    # What these are made of, as it comes.
    for function in (
        "accelerations", "output_derivatives", "dynamics", "velocity", "constraint_scale",
        "energy", "drawing", "constraint_partials",
    ):  # fmt: skip
        calls.add(function, getattr(kernel, function), **state, **values, may_be_nan=True)
    for function in ("momentum", "constraint_violation"):
        calls.add(function, getattr(model, function), **state, **values, may_be_nan=True)
    calls.add("jvp", model.jvp, **state, dx=np.ones(model.n_x), dp=np.ones(model.n_p), dr=np.ones(model.n_r), **values)
    calls.add("vjp", model.vjp, **state, weights=np.ones(model.n_x), **values)
    calls.add("rhs into", model.rhs, **state, **values, out=np.empty(model.n_x))
    for function in ("mass_matrix", "tree_mass_matrix"):
        calls.add(function, getattr(model, function), **state, p=p)
    for function in ("position", "invariant_correction", "position_constraints", "positions", "constraint_jacobian"):
        raw = function in {"position", "invariant_correction"}
        calls.add(
            function, getattr(kernel if raw else model, function), t=0.3, q=x0[: model.n_q], **values, may_be_nan=raw
        )
    acceleration, multipliers = kernel.accelerations(0.3, x0)
    change = x0[model.n_q :]
    calls.add("motion", kernel.motion, **state, accelerations=acceleration, **values, may_be_nan=True)
    calls.add("coordinate_change", kernel.coordinate_change, **state, change=change, **values, may_be_nan=True)
    held = {"accelerations": acceleration, "multipliers": multipliers}
    for function in (
        "outputs_for",
        "output_partials",
        "partials",
        "state_rates_for",
        "state_rate_partials",
    ):
        calls.add(function, getattr(kernel, function), **state, **held, **values, may_be_nan=True)
    forces = multipliers[model.n_c :]
    calls.add("unknown_forces", kernel.unknown_forces, **state, forces=forces, **values, may_be_nan=True)
    calls.add("default_inputs", kernel.default_inputs, t=0.3, p=p, may_be_nan=True)
    calls.add("parameter_vector", kernel.parameter_vector, p=p)
    states, inputs = np.tile(x0[:, np.newaxis], 3), np.tile(r[:, np.newaxis], 3)
    for function in ("along", "drawing_along"):
        along = getattr(kernel, function)
        calls.add(function, along, times=np.linspace(0.0, 1.0, 3), states=states, inputs=inputs, p=p, may_be_nan=True)
    batch = {"t": np.linspace(0.0, 1.0, 3), "x": states, "p": np.tile(p[:, np.newaxis], 3), "r": inputs}
    calls.add("rhs_batch", model.rhs_batch, **batch, workers=2, may_be_nan=True)
    for function in ("jacobian_batch", "parameter_jacobian_batch", "input_jacobian_batch"):
        calls.add(function, getattr(model, function), **batch, workers=2, may_be_nan=True)
    for function in ("residual_batch", "residual_jacobian_batch"):
        calls.add(
            function, getattr(model, function), **batch, rates=np.ones((model.n_x, 3)),
            multipliers=np.ones((model.n_l, 3)), formulation="index-1", workers=2, may_be_nan=True,
        )  # fmt: skip
    calls.add("residual_sparsity", model.residual_sparsity, formulation="index-1")
    times, first, unknown = np.linspace(0.0, 0.1, 5), model.states[0], model.parameters[0]
    measured = {"t": times, first: model.simulate((0.0, 0.1), x0, t_eval=times)[first]}
    calls.add(
        "fit", fb.fit, model=model, data=measured, parameters=[unknown], outputs=[first], bounds={unknown: (0.0, 1e3)},
        sigma={first: 0.1}, loss="linear", max_nfev=3, method="DOP853", rtol=1e-6, atol=1e-8, constraints="project",
        share=0.2,
    )  # fmt: skip
    calls.add("rhs_batch into", model.rhs_batch, **batch, out=np.empty((model.n_x, 3)), may_be_nan=True)

    first, speed, source = model.coordinates[0], model.speeds[0], model.inputs[0]
    named = {model.parameters[0]: float(p[0])}
    sources = {source: (np.linspace(0.0, 1.0, 3), np.zeros(3))}
    start = {"coordinates": {first: float(x0[0])}, "speeds": {speed: 0.1}, "t": 0.0}
    given = {"parameters": named, "inputs": {source: 1.0}}
    guess = x0[1 : model.n_q]
    bounds = {model.coordinates[-1]: (-4.0, 4.0)}
    calls.add("initial_state", model.initial_state, **start, guess=guess, bounds=bounds, **given, share=0.3)
    calls.add("initial_state_derivatives", model.initial_state_derivatives, **start, guess=guess, **given, share=0.3)
    calls.add("initial_states", model.initial_states, **start, **given, may_be_nan=True, share=0.3)
    along = {"drive": {first: x0[0] + np.array([0.0, 0.1])}, "rates": {first: 1.0}, "accelerations": {first: 0.0}}
    calls.add("kinematics", model.kinematics, **along, parameters=p, t=0.0, may_be_nan=True, share=0.05)
    motion = (np.linspace(0.0, 1.0, 3), states, dict.fromkeys(model.speeds[: model.n_u - model.n_c], 0.1))
    calls.add("inverse_dynamics", model.inverse_dynamics, motion=motion, find=[source], parameters=p, may_be_nan=True)
    calls.add("equilibrium", model.equilibrium, guess=x0[: model.n_q], t=0.0, **given, share=0.1)
    calls.add("stability", model.stability, x=x0, t=0.0, **given, share=0.1)
    run = {"t_span": (0.0, 0.05), "x0": x0, "parameters": p, "inputs": sources, "rtol": 1e-6, "atol": 1e-9}
    times = np.linspace(0.0, 0.05, 3)
    how = {"t_eval": times, "constraints": "project", "max_step": math.inf}
    more = {
        "events": fb.Event(lambda t, x: x[0]),
        "dense_output": True,
        "stabilization": 10.0,
        "progress": lambda t: None,
    }
    for method in ("DOP853", "RK45", "Tsit5", "ALI3P", "Radau", "CVODE", "IDA"):
        own = how | ({"max_step": 0.01} if method == "ALI3P" else {})
        own |= {"formulation": "index-3"} if method == "IDA" else {}
        calls.add(f"simulate {method}", model.simulate, **run, method=method, **own, **more, max_steps=200, share=0.3)
    calls.add(
        "ensemble", model.ensemble, **run | {"x0": np.tile(x0, (3, 1)), "parameters": np.tile(p, (3, 1))}, **how,
        method="RK45", workers=2, progress=False, parallel=None, may_be_nan=True, share=0.5,
    )  # fmt: skip
    calls.add(
        "ode", lambda t, x, **given: model.ode(**given)(t, x), **state, parameters=p, inputs=sources, may_be_nan=True
    )
    calls.add("ode.jac", lambda t, x, **given: model.ode(**given).jac(t, x), **state, parameters=p, inputs=sources,
              may_be_nan=True)  # fmt: skip
    ode = model.ode()
    for function in ("input_values", "multipliers", "project"):
        calls.add(f"ode.{function}", getattr(ode, function), **state, may_be_nan=True)
    calls.add("ode.inputs_along", ode.inputs_along, times=times, states=states)

    def step(r: Any, **given: Any) -> Any:
        stepper = model.stepper(**given)
        return stepper.step(r), stepper.t, stepper.x, stepper.t_events, stepper.y_events, stepper.status

    for name, method in {"stepper": "RK4", "stepper Radau": "Radau"}.items():
        calls.add(name, step, h=1e-3, x0=x0, t=0.0, parameters=p, inputs=sources, events=["u1"],
                  constraints="project", method=method, r=r)  # fmt: skip
    for solver in fb.solvers.__all__:
        # SciPy's classes have checks of their own.
        calls.add(f"solvers.{solver}", _solve(model, solver), t0=0.0, y0=x0, t_bound=0.05, max_step=math.inf, rtol=1e-6,
                  atol=1e-9, first_step=1e-3, errors=(ValueError, TypeError), share=0.3)  # fmt: skip

    trajectory = model.simulate((0.0, 0.1), x0, dense_output=True)
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    kept = model.simulate((0.0, 0.1), x0, t_eval=[0.05, 0.1], gradient=True)
    calls.add("trajectory.gradient", kept.gradient, cost=np.ones((model.n_x, 2)))
    saved = trajectory.save(folder / "run.npz")
    calls.add("trajectory[]", trajectory.__getitem__, name=first)
    calls.add("trajectory.sol", trajectory.sol, t=times)
    calls.add("trajectory.resample", trajectory.resample, times=times)
    for suffix, share in (("csv", 0.3), ("npz", 0.3), ("nc", 0.1), ("html", 0.05), ("png", 0.01)):
        calls.add(f"trajectory.save {suffix}", lambda path: trajectory.save(path), path=f"run.{suffix}", share=share)
    calls.add("trajectory.animate", trajectory.animate, fps=30.0, speed=1.0, traces=[model.points[0]], share=0.02)
    calls.add("trajectory.report", trajectory.report, height=500, share=0.05)
    page = {"t_span": (0.0, 0.1), "x0": x0, "ranges": {"k": (1.0, 2.0)}, "traces": ["P2"], "watch": [("range", "q1")]}
    calls.add("page", model.page, **page, parameters={"k": 100.0}, inputs={"F": 0.0}, height=500, share=0.05)
    calls.add("trajectory.plot_frames", trajectory.plot_frames, times=[0.0, float(trajectory.t[-1])], share=0.02)
    calls.add("trajectory.plot_paths", trajectory.plot_paths, points=[model.points[0]], share=0.02)
    calls.add("trajectory", model.trajectory, t=times, x=states, parameters=p, inputs=sources, share=0.3)
    calls.add(
        "runner", lambda t_span, rtol, **given: model.runner(t_span, rtol=rtol)(**given), t_span=(0.0, 0.05), rtol=1e-6,
        x0=x0, parameters=p, inputs=sources, share=0.3,
    )  # fmt: skip
    calls.add("load_trajectory", fb.load_trajectory, path=saved, model=model, share=0.5)
    several = model.ensemble((0.0, 0.1), np.tile(x0, (2, 1)))
    calls.add("ensemble.plot", several.plot, names=[model.states[0]], share=0.02)
    for suffix in ("csv", "npz", "nc"):
        calls.add(f"ensemble.save {suffix}", lambda path: several.save(path), path=f"runs.{suffix}", share=0.1)
    calls.add("ensemble[]", several.__getitem__, key=1, errors=(IndexError,), may_be_nan=True)
    modes = model.initial_states()
    calls.add("modes[]", modes.__getitem__, number=0, errors=(IndexError,), may_be_nan=True)
    calls.add("modes.plot", modes.plot, share=0.01)
    branches = model.kinematics({first: x0[0] + np.array([0.0, 0.1])})
    branch, three = branches[0], dict(zip(("a", "joint", "b"), model.points[-3:], strict=True))
    calls.add("kinematics[]", branches.__getitem__, number=0, errors=(IndexError,))
    calls.add("kinematics.plot_paths", branches.plot_paths, points=[model.points[0]], share=0.02)
    calls.add("branch[]", branch.__getitem__, name=first, may_be_nan=True)
    calls.add("branch.transmission_angle", branch.transmission_angle, **three, may_be_nan=True)
    calls.add("branch.plot_paths", branch.plot_paths, points=[model.points[0]], share=0.02)
    for suffix in ("csv", "npz"):
        calls.add(f"branch.save {suffix}", lambda path: branch.save(path), path=f"branch.{suffix}", share=0.1)
    _add_linkages(calls, folder)

    pushed, force = _pushed(me.dynamicsymbols("F")), me.dynamicsymbols("F")
    of_user = fb.Model(pushed, name="pushed", inputs={force: 1.0})
    calls.add("load", fb.load, name="four_bar")
    calls.add("Parameter", fb.Parameter, value=1.0, unit="m", description="length")
    calls.add("Event", fb.Event, function=lambda t, x: 1.0, terminal=True, direction=0.0)
    calls.add("multiplier", fb.multiplier, number=1)
    calls.add("joint_force", fb.joint_force, name="pin", directions={1: pushed.frame.x}, frame=pushed.frame)
    calls.add(
        "Model", fb.Model, system=pushed, name="made", parameters={m: sm.Integer(1)}, inputs={force: sm.sin(t)},
        initial={q: 0.1}, potential_energy=m * q, outputs={"o": m * q}, share=0.3,
    )  # fmt: skip
    calls.add("export_c", fb.export_c, model=of_user, folder=folder / "c", share=0.01)
    calls.add("export_fmu", fb.export_fmu, model=of_user, path=folder / "a.fmu", fmi=3, platforms=(), share=0.002)
    calls.add("generate_sources", fb.generate_sources, model=of_user, share=0.02)
    calls.add(
        "generate_sources of a force",
        lambda force: fb.generate_sources(fb.Model(_pushed(force))),
        force=m * q,
        errors=NotASystemError,
        share=0.3,
    )
    calls.add("compile_model", fb.compile_model, model=of_user, check=True, share=0.1)
    calls.add(
        "compile_model of a force",
        lambda force: fb.compile_model(fb.Model(_pushed(force))),
        force=m * q,
        errors=NotASystemError,
        share=0.005,
    )
    calls.add("build_model", fb.build_model, model=of_user, folder=folder / "built", check=True, share=0.003)
    calls.add(
        "build_wheel", fb.build_wheel, model=of_user, folder=folder / "dist", version="1.0", check=True, share=0.002
    )
    calls.add("models.chain", fb.models.chain, links=2, closed=False, share=0.1)
    calls.add("models.n_four_bar", fb.models.n_four_bar, loops=1, share=0.1)
    return calls.all


def _add_linkages(calls: Calls, folder: Path) -> None:
    """A four-bar by its points, and statements about it."""
    drawn: dict[str, Any] = {
        "points": {"A": (0.0, 0.0), "B": (0.1, 0.0), "C": (0.3, 0.3), "D": (0.4, 0.0), "P": (0.2, 0.4)},
        "ground": ["A", "D"],
        "links": ["AB", "CD"],
    }

    def state(kind: str) -> Callable[..., Any]:
        def stated(**arguments: Any) -> Any:
            linkage = fb.Linkage("drawn", **drawn)
            if kind == "plate":
                return linkage.plate("B", "C", arguments.pop("point"), **arguments)
            if kind != "bar":
                linkage.plate("B", "C", "P", name="BCP")
            return getattr(linkage, kind)(**arguments)

        return stated

    calls.add("Linkage", fb.Linkage, name="drawn", **drawn, density=1.0, gravity=9.81, independent=["AB"])
    calls.add("linkage.joint", state("joint"), name="E", place=np.array([0.1, 0.2]), mass=1.0)
    calls.add("linkage.ground", state("ground"), name="E", place=np.array([0.1, 0.2]))
    calls.add("linkage.bar", state("bar"), a="B", b="C", density=1.0)
    plate = {"mass": 0.5, "inertia": 0.1, "center": np.array([0.2, 0.3])}
    calls.add("linkage.plate", state("plate"), point="P", name="coupler", **plate)
    calls.add("linkage.slider", state("slider"), point="P", along=np.array([1.0, 0.0]), mass=1.0)
    calls.add("linkage.force", state("force"), point="P", components=np.array([1.0, 0.0]))
    calls.add("linkage.torque", state("torque"), at="B", value=1.0, link="AB")
    calls.add("linkage.spring", state("spring"), a="A", b="C", stiffness=1.0, length=0.3)
    calls.add("linkage.damper", state("damper"), a="A", b="C", coefficient=1.0)
    calls.add("linkage.drive", state("drive"), at="A", angle=1.0)
    calls.add("linkage.drive at a speed", state("drive"), at="A", speed=1.0)
    own = {"initial": {"q_AB": 0.1}, "outputs": {"o": m}}
    calls.add("linkage.model", state("model"), name="made", parameters={"l_AB": 0.1}, inputs={}, **own, share=0.1)
    table = folder / "linkage.csv"
    table.write_text("point,x,y,links\nA,0,0,ground AB\nB,0.1,0,AB\n")
    calls.add("linkage.from_csv", fb.Linkage.from_csv, path=table, name="drawn")


def _solve(model: fb.CompiledModel, name: str) -> Callable[..., Any]:
    def solve(**arguments: Any) -> Any:
        solver = getattr(fb.solvers, name)(model.ode(), **arguments)
        for _ in range(5):
            if solver.status == "running":
                solver.step()
        return solver.t, solver.y

    return solve


def _pushed(force: Any) -> System:
    system = pendulum()
    try:
        system.add_loads(me.Force(system.bodies[0].masscenter, force * system.frame.x))
    except Exception as error:
        raise NotASystemError from error
    return system


class NotASystemError(Exception):
    """SymPy has no such force."""


# --- what has to hold -------------------------------------------------------------------------------------------------


def is_finite(result: Any) -> bool:
    """Whether all numbers in a result are; of a run that failed and says so it does not matter."""
    if isinstance(result, fb.Trajectory):
        return bool(result.message) and is_finite((result.t, result.y))
    if isinstance(result, np.ndarray):
        return result.dtype.kind != "f" or bool(np.isfinite(result).all())
    if isinstance(result, float):
        return math.isfinite(result)
    if isinstance(result, dict):
        return all(map(is_finite, result.values()))
    return not isinstance(result, list | tuple) or all(map(is_finite, result))


def is_same(result: Any, expected: Any) -> bool:
    """Whether two results are the same, as far as they are numbers: sums may be rounded in another order."""
    if isinstance(expected, fb.Trajectory):
        return is_same((result.t, result.y, result.r), (expected.t, expected.y, expected.r))
    if isinstance(expected, fb.Ensemble):
        return is_same((result.t, result.y), (expected.t, expected.y))
    if isinstance(expected, dict):
        return is_same(list(result.values()), list(expected.values()))
    if isinstance(expected, list | tuple):
        return len(result) == len(expected) and all(map(is_same, result, expected))
    if isinstance(expected, np.ndarray | float):
        return np.allclose(result, expected, rtol=1e-12, atol=1e-12, equal_nan=True)
    return True


CLASSES = {
    "branch": fb.Branch,
    "ensemble": fb.Ensemble,
    "fit": fb.Fit,
    "kinematics": fb.Kinematics,
    "linkage": fb.Linkage,
    "modes": fb.AssemblyModes,
    "trajectory": fb.Trajectory,
}
"""What functions return, or users make, by the name that it has in calls."""


def missing() -> set[str]:
    """Public names that no call has."""
    called = {name.split(" ")[0].removesuffix("[]") for name in calls_of("four_bar")}
    results = {
        f"{name}.{method}"
        for name, kind in CLASSES.items()
        for method, _ in inspect.getmembers(kind, lambda member: inspect.isfunction(member) or inspect.ismethod(member))
        if method not in dir(Sequence)  # index() and count()
    }
    methods = {name for name in dir(fb.CompiledModel) if callable(getattr(fb.CompiledModel, name))} - NOT_FOR_USERS
    solvers = {f"solvers.{name}" for name in fb.solvers.__all__}
    functions = {name for name in fb.__all__ if inspect.isfunction(getattr(fb, name))}
    public = {name for name in results | methods | solvers | functions if not name.rpartition(".")[2].startswith("_")}
    doors = {f"trajectory.{name}" for name in ("plot", "columns", "to_xarray", "to_dataframe")}
    doors |= {"ensemble.to_xarray", "branch.columns", "fit.plot", "kinematics.plot"}
    without_arguments = {*doors, "get_include"}
    elsewhere = {"to_jax"}  # tests/simulation/test_jax.py: JAX has settings of its own
    return public - called - without_arguments - elsewhere


def case(generator: np.random.Generator, say: Callable[[str], None]) -> None:
    """One call, of which one argument is odd, or two."""
    calls = calls_of(str(generator.choice(["four_bar", "slider_crank"])))
    shares = np.array([call.share for call in calls.values()])
    name = list(calls)[generator.choice(len(calls), p=shares / shares.sum())]
    call = calls[name]
    arguments, same = dict(call.arguments), True
    told = []
    for place in generator.permutation(len(arguments))[: 1 + (generator.random() < 0.3)]:
        key = list(arguments)[place]
        arguments[key], what, alike = odd(generator, arguments[key])
        told.append(f"{key} = {what}")
        same &= alike
    say(f"{name} with {' and '.join(told)}")
    with np.errstate(all="ignore"):
        try:
            result = call.function(**arguments)
        except (fb.FourbarError, *call.errors):
            return
        assert call.may_be_nan or is_finite(result), f"not finite, without a word: {result!r}"
        if same:
            expected = call.function(**call.arguments)
            assert is_same(result, expected), f"{result!r} instead of {expected!r}"
