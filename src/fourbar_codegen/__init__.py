"""Compile SymPy mechanisms to C and simulate them with their loops closed.

The names below are imported where they are first used: importing the package imports neither SymPy nor SciPy.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fourbar_codegen.errors import (
    AssemblyError,
    BuildError,
    CacheError,
    FourbarError,
    ModelError,
    ModelWarning,
    SimulationError,
)

if TYPE_CHECKING:
    from fourbar_codegen import models, solvers
    from fourbar_codegen.analysis.assembly_modes import AssemblyModes
    from fourbar_codegen.analysis.linearization import Linearization
    from fourbar_codegen.building.toolchain import get_include
    from fourbar_codegen.compile import build_model, build_wheel, compile_model, generate_sources
    from fourbar_codegen.compiled import CompiledModel, load, load_trajectory
    from fourbar_codegen.differentiable import JaxModel, to_jax
    from fourbar_codegen.export import export_c, export_fmu
    from fourbar_codegen.fitting import Experiment, Fit, fit
    from fourbar_codegen.linkage.linkage import Linkage
    from fourbar_codegen.modeling.model import Model, Parameter, joint_force, multiplier
    from fourbar_codegen.results.ensemble import Ensemble
    from fourbar_codegen.results.kinematics import Branch, Kinematics
    from fourbar_codegen.results.trajectory import Trajectory
    from fourbar_codegen.simulation.events import Event

__all__ = [
    "AssemblyError",
    "AssemblyModes",
    "Branch",
    "BuildError",
    "CacheError",
    "CompiledModel",
    "Ensemble",
    "Event",
    "Experiment",
    "Fit",
    "FourbarError",
    "JaxModel",
    "Kinematics",
    "Linearization",
    "Linkage",
    "Model",
    "ModelError",
    "ModelWarning",
    "Parameter",
    "SimulationError",
    "Trajectory",
    "build_model",
    "build_wheel",
    "compile_model",
    "export_c",
    "export_fmu",
    "fit",
    "generate_sources",
    "get_include",
    "joint_force",
    "load",
    "load_trajectory",
    "models",
    "multiplier",
    "solvers",
    "to_jax",
]

_HOME = {
    "AssemblyModes": "analysis.assembly_modes",
    "Branch": "results.kinematics",
    "CompiledModel": "compiled",
    "Ensemble": "results.ensemble",
    "Event": "simulation.events",
    "Experiment": "fitting",
    "Fit": "fitting",
    "JaxModel": "differentiable",
    "Kinematics": "results.kinematics",
    "Linearization": "analysis.linearization",
    "Linkage": "linkage.linkage",
    "Model": "modeling.model",
    "Parameter": "modeling.model",
    "Trajectory": "results.trajectory",
    "build_model": "compile",
    "build_wheel": "compile",
    "compile_model": "compile",
    "export_c": "export",
    "export_fmu": "export",
    "fit": "fitting",
    "generate_sources": "compile",
    "get_include": "building.toolchain",
    "joint_force": "modeling.model",
    "load": "compiled",
    "load_trajectory": "compiled",
    "multiplier": "modeling.model",
    "to_jax": "differentiable",
}


class _EarlierModules:
    """Says in a sentence why a pickle cannot be read that names a module by which its class was once found."""

    NAMES = tuple(f"fourbar_codegen.{name}" for name in ("assembly", "ensemble", "integrate", "model", "trajectory"))

    @classmethod
    def find_spec(cls, name: str, *_: object) -> None:
        if name in cls.NAMES:
            raise ModuleNotFoundError(
                f"There is no module {name} any more. A pickle that names it was made by an earlier version of "
                "fourbar_codegen: make it again. Import the classes from fourbar_codegen itself.",
                name=name,
            )


sys.meta_path.append(_EarlierModules)


def __getattr__(name: str) -> Any:
    if name in {"models", "solvers"}:
        return import_module(f"fourbar_codegen.{name}")
    if name == "__version__":
        from importlib.metadata import version

        return version("fourbar_codegen")
    if name in _HOME:
        return getattr(import_module(f"fourbar_codegen.{_HOME[name]}"), name)
    raise AttributeError(f"module 'fourbar_codegen' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
