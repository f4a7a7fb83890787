"""NPZ: arrays of NumPy by name, with everything else as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.files.pandas_xarray import series
from fourbar_codegen.files.reserved_names import ATTRIBUTES, OF_MEMBERS, check_free
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.provenance import attributes, branch_attributes, ensemble_attributes, parsed
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["read_trajectory", "write_branch", "write_ensemble", "write_trajectory"]

Floats = NDArray[np.float64]


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """An array for each of its columns."""
    _write(trajectory.columns(), attributes(trajectory), file)


def write_branch(branch: Branch, file: IO[bytes]) -> None:
    """An array for each of its columns."""
    _write(branch.columns(), branch_attributes(branch), file)


def _write(columns: Mapping[str, Floats], attributes: Mapping[str, Any], file: IO[bytes]) -> None:
    if ATTRIBUTES in columns:
        raise ModelError(f"The name {ATTRIBUTES} is reserved in NPZ files: rename the state or output.")
    arrays: dict[str, Any] = {**columns, ATTRIBUTES: np.array(json.dumps(attributes))}
    np.savez(file, **arrays)


def write_ensemble(ensemble: Ensemble, file: IO[bytes]) -> None:
    """Times; each state and output, shape (n, n_t); each parameter, and how members ended, shape (n,)."""
    of_time, of_members = series(ensemble), ensemble.by_member
    check_free((*of_time, *of_members), OF_MEMBERS)
    ends = {"success": ensemble.success, "messages": np.array(ensemble.messages, dtype=str), "nfev": ensemble.nfev}
    arrays: dict[str, Any] = {**of_members, **ends, **of_time, "t": ensemble.t}
    arrays[ATTRIBUTES] = np.array(json.dumps(ensemble_attributes(ensemble)))
    np.savez(file, **arrays)


def read_trajectory(path: Path) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """The attributes and the arrays of a file."""
    with path.open("rb") as opened:
        if not is_zipfile(opened):  # NumPy would give misleading advice about pickles
            raise ModelError(f"{path} is not an NPZ file, or it is damaged.")
        with np.load(opened, allow_pickle=False) as file:
            arrays = dict(file)
    return parsed(str(arrays[ATTRIBUTES])), arrays
