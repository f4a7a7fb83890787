"""Compile SymPy mechanisms to C and simulate them with their loops closed.

The names below are imported where they are first used: importing the package imports neither SymPy nor SciPy.
"""

from __future__ import annotations

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
from fourbar_codegen.interface.registered import register

if TYPE_CHECKING:
    from fourbar_codegen import models, solvers
    from fourbar_codegen.analysis.linearization import Linearization
    from fourbar_codegen.body_shapes import (
        Arrow,
        Box,
        Capsule,
        Cone,
        CoordinateFrame,
        Cylinder,
        Disc,
        Ellipsoid,
        Line,
        Mesh,
        Plane,
        Sphere,
        Torus,
        Wheel,
    )
    from fourbar_codegen.building.toolchain import get_include
    from fourbar_codegen.compiled_model import CompiledModel, load
    from fourbar_codegen.export.module import build_model, build_wheel
    from fourbar_codegen.export.packaging import export_c, export_fmu
    from fourbar_codegen.files.load import load_trajectory
    from fourbar_codegen.fitting.fit import Experiment, Fit, fit
    from fourbar_codegen.jax.jax_model import JaxModel, to_jax
    from fourbar_codegen.linkage.linkage import Linkage
    from fourbar_codegen.modeling.model import Model, Parameter, joint_force, multiplier
    from fourbar_codegen.pipeline.compile import compile_model
    from fourbar_codegen.pipeline.generate import generate_sources
    from fourbar_codegen.results.assembly_modes import AssemblyModes
    from fourbar_codegen.results.ensemble import Ensemble
    from fourbar_codegen.results.kinematics import Branch, Kinematics
    from fourbar_codegen.results.trajectory import Trajectory
    from fourbar_codegen.simulation.events import Event
    from fourbar_codegen.simulation.methods import ALI3P, CVODE, DOP853, IDA, RK45, Radau, Tsit5
    from fourbar_codegen.simulation.simulate import Runner

__all__ = [
    "ALI3P",
    "CVODE",
    "DOP853",
    "IDA",
    "RK45",
    "Arrow",
    "AssemblyError",
    "AssemblyModes",
    "Box",
    "Branch",
    "BuildError",
    "CacheError",
    "Capsule",
    "CompiledModel",
    "Cone",
    "CoordinateFrame",
    "Cylinder",
    "Disc",
    "Ellipsoid",
    "Ensemble",
    "Event",
    "Experiment",
    "Fit",
    "FourbarError",
    "JaxModel",
    "Kinematics",
    "Line",
    "Linearization",
    "Linkage",
    "Mesh",
    "Model",
    "ModelError",
    "ModelWarning",
    "Parameter",
    "Plane",
    "Radau",
    "Runner",
    "SimulationError",
    "Sphere",
    "Torus",
    "Trajectory",
    "Tsit5",
    "Wheel",
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
    "ALI3P": "simulation.methods",
    "CVODE": "simulation.methods",
    "DOP853": "simulation.methods",
    "IDA": "simulation.methods",
    "RK45": "simulation.methods",
    "Arrow": "body_shapes",
    "AssemblyModes": "results.assembly_modes",
    "Box": "body_shapes",
    "Branch": "results.kinematics",
    "Capsule": "body_shapes",
    "CompiledModel": "compiled_model",
    "Cone": "body_shapes",
    "CoordinateFrame": "body_shapes",
    "Cylinder": "body_shapes",
    "Disc": "body_shapes",
    "Ellipsoid": "body_shapes",
    "Ensemble": "results.ensemble",
    "Event": "simulation.events",
    "Experiment": "fitting.fit",
    "Fit": "fitting.fit",
    "JaxModel": "jax.jax_model",
    "Kinematics": "results.kinematics",
    "Line": "body_shapes",
    "Linearization": "analysis.linearization",
    "Linkage": "linkage.linkage",
    "Mesh": "body_shapes",
    "Model": "modeling.model",
    "Parameter": "modeling.model",
    "Plane": "body_shapes",
    "Radau": "simulation.methods",
    "Runner": "simulation.simulate",
    "Sphere": "body_shapes",
    "Torus": "body_shapes",
    "Trajectory": "results.trajectory",
    "Tsit5": "simulation.methods",
    "Wheel": "body_shapes",
    "build_model": "export.module",
    "build_wheel": "export.module",
    "compile_model": "pipeline.compile",
    "export_c": "export.packaging",
    "export_fmu": "export.packaging",
    "fit": "fitting.fit",
    "generate_sources": "pipeline.generate",
    "get_include": "building.toolchain",
    "joint_force": "modeling.model",
    "load": "compiled_model",
    "load_trajectory": "files.load",
    "multiplier": "modeling.model",
    "to_jax": "jax.jax_model",
}


_METHODS = {
    "StoredModel.built": "building.parts:build",
    "StoredModel.reduced": "building.cached_models:reduced",
    "Model._check_velocity_constraints": "dynamics.formation:check_velocity_constraints",
    "Mechanism.forces_along_auxiliary_speeds": "dynamics.unknown_forces:forces_along_auxiliary_speeds",
    "CompiledModel.page": "page.live_page:page",
    "Runner.model": "compiled_model:model_of",
    "Trajectory.model": "compiled_model:model_of",
    "Kernel.shapes": "views.model_shapes:all_shapes",
    "Kernel.set_shapes": "views.model_shapes:set_shapes",
    "Trajectory.save": "files.save:save_trajectory",
    "Trajectory.plot": "views.figures:plot_trajectory",
    "Trajectory.plot_frames": "views.figures:plot_frames",
    "Trajectory.plot_paths": "views.figures:plot_paths",
    "Trajectory.animate": "views.figures:animate",
    "Trajectory.report": "views.report:report",
    "Trajectory.to_dataframe": "files.pandas_xarray:to_dataframe",
    "Trajectory.to_xarray": "files.pandas_xarray:to_dataset",
    "Trajectory._repr_html_": "views.report:table_of_run",
    "Ensemble.model": "compiled_model:model_of",
    "Ensemble.save": "files.save:save_ensemble",
    "Ensemble.plot": "views.figures:plot_ensemble",
    "Ensemble.to_xarray": "files.pandas_xarray:ensemble_dataset",
    "Branch.model": "compiled_model:model_of",
    "Branch.save": "files.save:save_branch",
    "Branch.plot_paths": "views.figures:plot_branch",
    "Kinematics.model": "compiled_model:model_of",
    "Kinematics.plot": "views.figures:plot_kinematics",
    "Kinematics.plot_paths": "views.figures:plot_branches",
    "Linearization.animate": "views.figures:animate_mode",
    "AssemblyModes.model": "compiled_model:model_of",
    "AssemblyModes.plot": "views.figures:plot_modes",
}
"""Methods whose functions stand above their classes, where these are."""

register({name: f"fourbar_codegen.{home}" for name, home in _METHODS.items()})


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
