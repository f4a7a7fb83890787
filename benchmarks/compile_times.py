"""CPU time of `compile_model` by stage, of ten models: which stage grew when compilation has become slow.

The CPU time of the process and of its compilers, which a loaded machine changes less than the time that passes. Each
model is compiled in a fresh process, with nothing cached.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest.mock import patch

import sympy as sm
import sympy.physics.mechanics as me
from measure import PROJECT, circumstances, publish
from sympy.physics.biomechanics import FirstOrderActivationDeGroote2016, MusculotendonDeGroote2016
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb
from fourbar_codegen.interface.progress import Progress

STAGES = {
    "": "reading",
    "forming the equations": "equations, jumps",
    "eliminating common subexpressions": "subexpressions",
    "printing": "printing",
    "compiling": "writing",
    "checking": "check",
}
"""Columns of the table, for the stages as they are shown."""

COMPILERS = "C compilers"
LATER = "derivatives, later"


def along_a_line(
    name: str, force: Callable[[Any, Any], sm.Expr], values: dict[Any, float], *, muscle: bool
) -> fb.Model:
    """A mass on a line, with a force by its position and speed, and a muscle."""
    q, u, m = *me.dynamicsymbols("q u"), sm.Symbol("m")
    frame, origin, hand = me.ReferenceFrame("N"), me.Point("O"), me.Point("P")
    origin.set_vel(frame, 0)
    hand.set_pos(origin, q * frame.x)
    hand.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_coordinates(q)
    system.add_speeds(u)
    system.add_kdes(u - q.diff())
    system.add_bodies(me.Particle("mass", hand, m))
    system.add_loads(me.Force(hand, force(q, u) * frame.x))
    if muscle:
        activation = FirstOrderActivationDeGroote2016.with_defaults("biceps")
        biceps = MusculotendonDeGroote2016.with_defaults("biceps", me.LinearPathway(origin, hand), activation)
        system.add_actuators(biceps)
        values = {**values, biceps.l_T_slack: 0.2, biceps.F_M_max: 1000.0, biceps.l_M_opt: 0.15}
    return fb.Model(system, name=name, parameters={m: 20.0, **values})


def lift() -> fb.Model:
    """The weight of docs/howto/state_equations.md that a muscle lifts."""
    g, d = sm.symbols("g d")
    return along_a_line("lift", lambda _, u: 20 * g - d * u, {g: 9.81, d: 50.0}, muscle=True)


def spline() -> fb.Model:
    """A spring that is a spline of 50 knots, with conditions as those of SymPy's `interpolating_spline`."""
    pieces = [((i + 1) * (x := sm.Symbol("x")) - x**3 / (i + 1), (x >= i) & (x <= i + 1)) for i in range(49)]
    curve = sm.Piecewise(*pieces)
    return along_a_line("spline", lambda q, _: curve.xreplace({sm.Symbol("x"): q}), {}, muscle=False)


def discs(count: int = 4) -> fb.Model:
    """Discs in a plane that collide (Hunt and Crossley), with friction."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    origin.set_vel(frame, 0)
    system = System(frame, origin)
    radius, k, d, m, mu, slow = sm.symbols("R k d m mu v_s")
    found = []
    for i in range(count):
        x, y, turn, u, v, w = me.dynamicsymbols(f"x{i} y{i} turn{i} u{i} v{i} w{i}")
        own, centre = me.ReferenceFrame(f"A{i}"), me.Point(f"P{i}")
        own.orient_axis(frame, frame.z, turn)
        own.set_ang_vel(frame, w * frame.z)
        centre.set_pos(origin, x * frame.x + y * frame.y)
        centre.set_vel(frame, u * frame.x + v * frame.y)
        system.add_coordinates(x, y, turn)
        system.add_speeds(u, v, w)
        system.add_kdes(u - x.diff(), v - y.diff(), w - turn.diff())
        inertia = me.inertia(own, 0, 0, m * radius**2 / 2)
        system.add_bodies(me.RigidBody(f"B{i}", centre, own, m, (inertia, centre)))
        found.append((centre, own, sm.Matrix([x, y]), sm.Matrix([u, v]), w))
    for (one, first, *a, turning), (other, second, *b, spinning) in combinations(found, 2):
        way, speed = b[0] - a[0], b[1] - a[1]
        distance = sm.sqrt(way.dot(way))
        normal = way / distance
        depth = sm.Max(2 * radius - distance, 0)
        push = sm.Max(k * depth ** sm.Rational(3, 2) * (1 - d * speed.dot(normal)), 0) * sm.Heaviside(depth)
        slip = speed[1] * normal[0] - speed[0] * normal[1] - radius * (turning + spinning)
        rub = mu * push * slip / (sm.Abs(slip) + slow)
        force = (push * normal[0] + rub * normal[1]) * frame.x + (push * normal[1] - rub * normal[0]) * frame.y
        system.add_loads(me.Force(other, force), me.Force(one, -force))
        system.add_loads(me.Torque(first, radius * rub * frame.z), me.Torque(second, radius * rub * frame.z))
    values = {radius: 0.1, k: 1e5, d: 0.2, m: 1.0, mu: 0.3, slow: 0.01}
    return fb.Model(system, name="discs", parameters=values)


def example(name: str) -> Any:
    """A module of examples/."""
    sys.path.insert(0, str(PROJECT / "examples"))
    return importlib.import_module(name)


def rider() -> fb.Model:
    """SymBRiM's rider on a bicycle."""
    module = example("09_rider_on_a_bicycle")
    system = module.rider_on_a_bicycle()
    symbols = fb.Model(system, inputs="auto").parameter_symbols
    values = {symbol: module.value(symbol.name) for symbol in symbols}
    return fb.Model(system, name="rider", parameters=values, inputs="auto")


MODELS: dict[str, Callable[[], fb.Model]] = {
    "four-bar": fb.models.four_bar,
    "rolling disc": fb.models.rolling_disc,
    "closed chain of 8 links": lambda: fb.models.chain(8, closed=True),
    "10 four-bars": lambda: fb.models.n_four_bar(10),
    "Whipple bicycle": fb.models.whipple_bicycle,
    "weight on a muscle": lift,
    "arm with two muscles": lambda: example("10_muscles_of_an_arm").arm(),
    "4 colliding discs": discs,
    "spline of 50 knots": spline,
    "rider on a bicycle (SymBRiM)": rider,
}


def spent() -> tuple[float, float]:
    """CPU time of this process, and of those that it started and waited for."""
    times = os.times()
    return times.user + times.system, times.children_user + times.children_system


def by_stage(model: fb.Model) -> dict[str, float]:
    """CPU times of `compile_model`, and of all derivatives at their first use, in s."""
    found = dict.fromkeys(STAGES.values(), 0.0)
    stage, (before, of_compilers) = "", spent()

    def enter(_: Progress, name: str) -> None:
        nonlocal stage, before
        now, _children = spent()
        found[STAGES[stage]] += now - before
        stage, before = name, now

    with warnings.catch_warnings(), patch.object(Progress, "stage", enter):
        warnings.simplefilter("ignore")
        compiled = fb.compile_model(model)
    now, children = spent()
    found[STAGES[stage]] += now - before
    compiled.require_products()
    return {**found, COMPILERS: children - of_compilers, LATER: sum(spent()) - now - children}


def measure(name: str) -> dict[str, float]:
    """The same in a fresh process."""
    environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": tempfile.mkdtemp()}
    command = [sys.executable, str(Path(__file__)), "--model", name]
    run = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return dict(json.loads(run.stdout))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", action="store_true", help="write the table into docs/benchmarks.md")
    parser.add_argument("--output", type=Path, help="a JSON file")
    parser.add_argument("--model", choices=MODELS, help="compile this one here, and print its times as JSON")
    options = parser.parse_args()
    if options.model:
        print(json.dumps(by_stage(MODELS[options.model]())))
        return
    rows = {name: measure(name) for name in MODELS if find_spec("symbrim") or MODELS[name] is not rider}
    columns = [*STAGES.values(), COMPILERS]
    lines = [f"| CPU time, s | {' | '.join(columns)} | all | {LATER} |", f"|---|{'---:|' * (len(columns) + 2)}"]
    for name, row in rows.items():
        cells = [row[column] for column in columns]
        cells += [sum(cells), row[LATER]]
        lines.append(f"| {name} | {' | '.join(f'{seconds:.2f}' for seconds in cells)} |")
    publish(options, "compile_times", "\n".join(lines), {**circumstances(), "seconds": rows})


if __name__ == "__main__":
    main()
