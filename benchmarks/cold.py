"""Start-up times: from a finished Model to its first call, and from ``import`` to the first trajectory.

Every figure is the median of fresh processes, by interleaved measurements. ``--against``, the folder of another
version's sources (``.../src``, compiled in place), also measures that version. Packages that are not installed are
skipped with a message: ``pip install 'fourbar_codegen[bench]'``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path

from measure import DOCS, circumstances, compare, replace_in_page, timed

HERE = Path(__file__).parent
PEERS = {
    "heyoka": ("heyoka", "heyoka, Taylor"),
    "numba": ("numba", "numba, solve_ivp DOP853"),
    "PyDy, cython": ("PyDy", "PyDy, cython, solve_ivp DOP853"),
    "CasADi": ("CasADi", "CasADi, CVODES"),
    "JiTCODE": ("JiTCODE", "JiTCODE, dop853"),
    "the tutorial's code": ("the tutorial's code", "the tutorial's code, solve_ivp DOP853"),
}
"""For each package, the integrator of ``peers.py`` whose first simulation is measured."""

OTHER = ", the other version"
"""Suffix of the names of measurements with ``--against``; they are not written into the documentation."""

MODELS = {"four-bar": "four_bar", "Whipple bicycle": "whipple_bicycle", "Cartesian pendulum": "cartesian_pendulum"}

COMPILING = """
import sys, time
sys.path.insert(0, sys.argv[1])
import sympy.physics.mechanics
import fourbar_codegen as fb
if sys.argv[3] == "warm":  # after imports
    fb.compile_model(fb.models.{warmed}())
model = fb.models.{name}()
begin = time.perf_counter()
fb.compile_model(model)
print(time.perf_counter() - begin)
"""

SIMULATING = """
import sys
sys.path.insert(0, sys.argv[1])
import fourbar_codegen as fb
compiled = fb.compile_model(fb.models.four_bar())
assert compiled.simulate((0.0, 4.0), rtol=1e-10, atol=1e-10).success
"""

PENDULUM = """
import numpy as np, sympy as sm, sympy.physics.mechanics as me
m, l, g = sm.symbols("m l g")
q, u = me.dynamicsymbols("q u")
ground, arm = me.ReferenceFrame("N"), me.ReferenceFrame("A")
arm.orient_axis(ground, ground.z, q)
arm.set_ang_vel(ground, u * ground.z)
origin = me.Point("O")
origin.set_vel(ground, 0)
end = origin.locatenew("P", -l * arm.y)
end.v2pt_theory(origin, ground, arm)
system = me.System(ground, fixed_point=origin)
system.add_bodies(me.Particle("bob", end, m))
system.add_coordinates(q)
system.add_speeds(u)
system.add_kdes(u - q.diff())
system.apply_uniform_gravity(-g * ground.y)
"""

PENDULUM_BY = {
    "fourbar_codegen": PENDULUM
    + """
import sys
sys.path.insert(0, sys.argv[1])
import fourbar_codegen as fb
model = fb.Model(system, parameters={m: 1.0, l: 0.5, g: 9.81})
run = fb.compile_model(model).simulate((0.0, 10.0), [1.0, 0.0], rtol=1e-8, atol=1e-8)
print(run.y[0, -1])
""",
    "SymPy's form_eoms, lambdify, solve_ivp": PENDULUM
    + """
from scipy.integrate import solve_ivp
system.form_eoms()
f = sm.lambdify(([q, u], [m, l, g]), (system.mass_matrix_full, system.forcing_full), cse=True)
def rhs(t, x):
    M, forcing = f(x, [1.0, 0.5, 9.81])
    return np.linalg.solve(M, forcing).ravel()
print(solve_ivp(rhs, (0.0, 10.0), [1.0, 0.0], method="DOP853", rtol=1e-8, atol=1e-8).y[0, -1])
""",
}


def process(code: str, source: str, *, cache: str | None, arguments: tuple[str, ...] = ()) -> Callable[[], str]:
    """A fresh process; with a cache of its own, or one that is filled already."""

    def run() -> str:
        environment = {**os.environ, "FOURBAR_CODEGEN_CACHE": cache or tempfile.mkdtemp()}
        command = [sys.executable, "-c", code, source, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout

    return run


def compiling(name: str, source: str, *, warm: bool) -> Callable[[], float]:
    """A measure of `compile_model`, in a fresh process."""
    warmed = next(other for other in MODELS.values() if other != name)
    code = COMPILING.format(name=name, warmed=warmed)
    cache = tempfile.mkdtemp() if warm else None
    run = process(code, source, cache=cache, arguments=(name, "warm" if warm else "cold"))
    if warm:
        run()
    return lambda: float(run())


def simulating(source: str, *, warm: bool) -> Callable[[], float]:
    """A measure of a fresh process up to its first trajectory."""
    run = process(SIMULATING, source, cache=tempfile.mkdtemp() if warm else None)
    if warm:
        run()
    return lambda: timed(run)


def peer(package: str, name: str) -> Callable[[], float]:
    """The same of a peer."""
    command = [sys.executable, str(HERE / "peers.py"), "--first", package, name]

    def measure() -> float:
        environment = {**os.environ, "NUMBA_CACHE_DIR": tempfile.mkdtemp()}
        return timed(lambda: subprocess.run(command, check=True, capture_output=True, env=environment))

    return measure


def main() -> None:
    """Measure, print, and write results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--against", help="the folder of another version's sources")
    parser.add_argument("--output", type=Path, default=Path("results/cold.json"))
    parser.add_argument("--docs", action="store_true", help="also write the tables in docs/benchmarks.md")
    options = parser.parse_args()
    own = str(HERE.parent / "src")
    versions = {"": own} | ({OTHER: options.against} if options.against else {})
    hows = {"nothing cached": False, "compiled before": True}
    tables: dict[str, dict[str, Callable[[], float]]] = {
        "from a finished Model to its first call": {
            f"{title}, {how}{version}": compiling(name, source, warm=warm)
            for title, name in MODELS.items()
            for how, warm in hows.items()
            for version, source in versions.items()
        },
        "the four-bar, from import to the first trajectory": {
            f"fourbar_codegen, {how}{version}": simulating(source, warm=warm)
            for how, warm in hows.items()
            for version, source in versions.items()
        },
        "a pendulum, from import to the first trajectory": {
            name: partial(timed, process(code, own, cache=None)) for name, code in PENDULUM_BY.items()
        },
    }
    sys.path.insert(0, str(HERE))
    from peers import MODULES

    for name, (package, integrator) in PEERS.items():
        if package in MODULES and not find_spec(MODULES[package]):
            print(f"{package} is not installed: pip install 'fourbar_codegen[bench]'", flush=True)
        else:
            tables["the four-bar, from import to the first trajectory"][name] = peer(package, integrator)
    found: dict[str, dict[str, float]] = {}
    for title, measures in tables.items():
        medians = compare(*measures.values(), rounds=options.rounds)
        found[title] = dict(zip(measures, medians, strict=True))
        for name, seconds in found[title].items():
            print(f"{title}: {name:<50} {seconds:8.4f} s", flush=True)
    report = {**circumstances(), "seconds": found}
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(report, indent=2) + "\n")
    print(f"Written: {options.output}")
    if options.docs:
        rows = [
            line
            for title, seconds in found.items()
            for line in (
                f"\n{title[0].upper()}{title[1:]}:\n",
                "| | |",
                "|---|---|",
                *(
                    f"| {name} | {seconds[name]:.3g} s |"
                    for name in sorted(seconds, key=seconds.__getitem__)
                    if OTHER not in name
                ),
            )
        ]
        command = "python benchmarks/cold.py --docs"
        replace_in_page(DOCS / "benchmarks.md", "cold", "\n".join(rows).strip("\n"), command, report)


if __name__ == "__main__":
    main()
