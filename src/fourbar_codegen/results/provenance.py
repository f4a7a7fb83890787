"""How a result came about: the model, its parameters, the settings, and the versions that computed it."""

from __future__ import annotations

import json
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["COUNTS", "attributes", "branch_attributes", "ensemble_attributes", "parsed"]

Floats = NDArray[np.float64]

COUNTS = ("nfev", "njev", "nlu", "status")
"""Attributes of a run that are integers."""


def _versions() -> dict[str, str]:
    """Versions of this package and of the packages it computes with, if installed."""
    found = {}
    for name in ("fourbar_codegen", "numpy", "scipy", "sympy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _model_of(model: Kernel) -> dict[str, Any]:
    """The model, and what computed with it."""
    return {"model": model.name, "fingerprint": model.layout.fingerprint, "versions": _versions()}


def ensemble_attributes(ensemble: Ensemble) -> dict[str, Any]:
    """The model, and the settings of the runs."""
    return {**_model_of(ensemble.kernel), "settings": dict(ensemble.settings)}


def _named_parameters(model: Kernel, values: Floats | None) -> dict[str, float]:
    return dict(zip(model.parameters, parameter_array(model, values).tolist(), strict=True))


def attributes(trajectory: Trajectory) -> dict[str, Any]:
    """The information to repeat a run, and how it ended."""
    return {
        **_model_of(trajectory.kernel),
        "settings": dict(trajectory.settings),
        "parameters": _named_parameters(trajectory.kernel, trajectory.parameters),
        **{name: getattr(trajectory, name) for name in ("nfev", "njev", "nlu", "status", "success", "message")},
    }


def branch_attributes(branch: Branch) -> dict[str, Any]:
    """The information to repeat a branch, and its limits."""
    return {
        **_model_of(branch.kernel),
        "parameters": _named_parameters(branch.kernel, branch.p),
        **{name: getattr(branch, name) for name in ("t", "limits", "without_value")},
    }


def parsed(text: str) -> dict[str, Any]:
    """A mapping from a text of JSON; a ValueError for anything else."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError(f"where names and values should be, there is {type(value).__name__}")
    return value
