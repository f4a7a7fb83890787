"""The pages of others as they are: SymPy's tests and tutorials, PyDy's and opty's examples.

What they show and optimize with is stood in for, and each KanesMethod or System that they form equations of is taken.
The texts are those of source distributions, which ``pip download`` fetches; SymPy comes with its tests.
"""

from __future__ import annotations

import ast
import contextlib
import doctest
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
import tarfile
import tempfile
import textwrap
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any
from unittest import mock

import sympy as sm
import sympy.physics.mechanics.tests

from ecosystem.cases import CONTACT, Built, Case
from ecosystem.formed import Formed, taken

VERSIONS = {"sympy": "1.14.0", "pydy": "0.9.4", "opty": "1.5.0"}
FOLDERS = {"sympy": "doc/src/tutorials/physics", "pydy": "docs/examples", "opty": "examples-gallery"}
STAND_INS = ("matplotlib", "mpl_toolkits", "opty", "pydy", "pythreejs", "IPython", "symmeplot")
"""What pages show and optimize with."""

FORMS = r"kanes_equations|form_eoms"
CELL = r"^ *\.\. jupyter-execute::.*\n(?: *:.*\n)*((?: *\n| {3,}.*\n)+)"

WARNED = {
    "test_kane.test_aux": CONTACT,
    "test_kane.test_aux (2)": CONTACT,
    "three-link-conical-pendulum": "the angular velocities that are set contradict the orientations",
}
REFUSED = {
    "test_kane.test_issue_24887": "The mass matrix is not positive definite",
    "test_kane2.test_sub_qdot2": "it has no bodies",
    "test_kane2.test_sub_qdot2 (2)": "it has no bodies",
    "test_system_class.TestSystemExamples.test_cart_pendulum_lagrange": "as for LagrangesMethod",
    # Of positions x = r q2 and velocities x' = r u2, where u2 is a rate about an axis of the ball, and not q2'.
    "plot_ball_rolling_on_spinning_disc": "do not keep holonomic constraint",
    "plot_one_legged_time_trial": "Derivative(u1(t), t) in the torque on frame A cannot be compiled",
}
"""What a page's model is refused with: a part of the sentence."""

VALUES = {"test_kane.test_implicit_kinematics": {"J_B_xz": 0.1}}
"""Values by name, of what may not be 1 as all else is that a page gives no value."""

BEGIN = {"four_bar_linkage_example": {"q1": -1.5}}
"""Where a run begins that would soon come to a singular position."""


@dataclass
class _Page:
    """What a page has formed equations of, and the parameters' values that it has."""

    models: Formed = field(default_factory=list)
    values: dict[sm.Symbol, float] = field(default_factory=dict)

    def cases(self, name: str, source: str) -> Iterator[Case]:
        """A case for each model."""
        for number, model in enumerate(self.models, start=1):
            title = name if number == 1 else f"{name} ({number})"
            values = {**self.values, **{sm.Symbol(of): value for of, value in VALUES.get(title, {}).items()}}
            begin = {q: BEGIN[title][q.name] for q in model.q if q.name in BEGIN.get(title, {})}
            yield Case(
                title, source, lambda model=model, values=values, begin=begin: Built(model, values, begin),
                warned=WARNED.get(title, ""), refused=REFUSED.get(title, ""),
            )  # fmt: skip


def sympys_tests() -> Iterator[Case]:
    """Those of SymPy's own tests that form equations."""
    for module in pkgutil.iter_modules(sympy.physics.mechanics.tests.__path__):
        tests = importlib.import_module(f"sympy.physics.mechanics.tests.{module.name}")
        members = [(name, member) for name, member in vars(tests).items() if inspect.isfunction(member)]
        for of in [member for name, member in vars(tests).items() if inspect.isclass(member) and "Test" in name]:
            members += [(f"{of.__name__}.{name}", getattr(of(), name)) for name in vars(of) if "test_" in name]
        for name, test in members:
            if "test_" in name and re.search(FORMS, inspect.getsource(test)):
                page = _Page()
                with taken(page.models):
                    test()
                yield from page.cases(f"{module.name}.{name}", f"SymPy {VERSIONS['sympy']}, tests")


def pages() -> Iterator[Case]:
    """Those of the source distributions."""
    with tempfile.TemporaryDirectory() as temporary:
        for project, version in VERSIONS.items():
            command = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", ":all:"]
            command += ["--no-build-isolation", "-d", temporary, f"{project}=={version}"]
            subprocess.run(command, check=True)
            with tarfile.open(Path(temporary, f"{project}-{version}.tar.gz")) as archive:
                archive.extractall(temporary, filter="data")
            for path in sorted(Path(temporary, f"{project}-{version}", FOLDERS[project]).rglob("*")):
                if path.suffix in {".py", ".rst"} and re.search(FORMS, path.read_text(encoding="utf-8")):
                    yield from _read(path).cases(path.stem, f"{project} {version}, {FOLDERS[project]}")


def _read(path: Path) -> _Page:
    """A page, of whose statements all are run that can be."""
    namespace: dict[str, Any] = {"__name__": "page", "__file__": str(path)}
    modules, finder, page = dict(sys.modules), _StandIns(), _Page()
    for name in filter(_is_stood_in, modules):
        del sys.modules[name]
    sys.meta_path.insert(0, finder)  # type: ignore[arg-type]
    try:
        with contextlib.chdir(path.parent):
            for statement in _statements(path):
                code = compile(ast.Module([statement], []), path.name, "exec")
                with taken(page.models):
                    exec(code, namespace)
    finally:
        sys.meta_path.remove(finder)  # type: ignore[arg-type]
        for name in [*filter(_is_stood_in, sys.modules)]:
            del sys.modules[name]
        sys.modules.update({name: module for name, module in modules.items() if _is_stood_in(name)})
    page.values.update(_values(namespace))
    return page


def _statements(path: Path) -> Iterator[ast.stmt]:
    """The Python of a page: a program, or the examples of doctest and the cells of Jupyter-Sphinx of a text."""
    text = path.read_text(encoding="utf-8")
    pieces = [text]
    if path.suffix == ".rst":
        pieces = [example.source for example in doctest.DocTestParser().get_examples(text)]
        pieces += [textwrap.dedent(cell) for cell in re.findall(CELL, text, re.MULTILINE)]
    for piece in pieces:
        with contextlib.suppress(SyntaxError):
            yield from ast.parse(re.sub("^%.*", "", piece, flags=re.MULTILINE)).body  # but for what is IPython's


def _values(namespace: Mapping[str, Any]) -> dict[sm.Symbol, float]:
    """The numbers of symbols in a page's dictionaries, and in pairs such as p and p_vals."""
    known = [value for value in namespace.values() if isinstance(value, dict)]
    for name, values in namespace.items():
        if name.endswith("_vals"):
            with contextlib.suppress(TypeError, ValueError):
                known.append(dict(zip(namespace.get(name[:-5], ()), values, strict=True)))
    found: dict[sm.Symbol, float] = {}
    for pairs in known:
        for symbol, value in pairs.items():
            with contextlib.suppress(TypeError, ValueError):
                if isinstance(symbol, sm.Symbol):
                    found[symbol] = float(value)
    return found


def _is_stood_in(name: str) -> bool:
    return any(name == known or name.startswith(f"{known}.") for known in STAND_INS)


class _StandIns:
    """Finds modules that do nothing, in place of what pages show and optimize with."""

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        return ModuleSpec(name, self, is_package=True) if _is_stood_in(name) else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> types.ModuleType:
        module: Any = mock.MagicMock(name=spec.name)
        module.__path__ = []
        return module  # type: ignore[no-any-return]

    def exec_module(self, module: types.ModuleType) -> None:
        pass
