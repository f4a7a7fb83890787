"""Export and import of results: pandas and xarray, NetCDF and NPZ files."""

from __future__ import annotations

import io
import json
import re
import struct
import sys
from collections.abc import Callable, Mapping
from hashlib import sha256
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from zipfile import is_zipfile

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import FourbarError, ModelError
from fourbar_codegen.files import check_free, path_of
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.results.ensemble import Ensemble, over_members
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.roles import VECTORS

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = [
    "attributes",
    "branch_attributes",
    "ensemble_dataset",
    "read_trajectory",
    "require_netcdf",
    "to_dataframe",
    "to_dataset",
    "versions",
    "write_dataset",
    "write_ensemble_npz",
    "write_npz",
]

Floats = NDArray[np.float64]

ATTRIBUTES = "run_attributes"
"""Name of the array in an NPZ file that contains everything else, as JSON."""

SEAL = b"fourbar_codegen SHA-256 "
"""Marks the SHA-256 digest that is appended to a NetCDF file. HDF5 ignores bytes after its end, but may hang when it
reads damaged data."""

MAX_COMPRESSION = 1100
"""Largest ratio of decompression that is accepted: zlib's limit is 1032."""


def versions() -> dict[str, str]:
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
    return {"model": model.name, "fingerprint": model.layout.fingerprint, "versions": versions()}


def _origin(model: Kernel, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The model, and the settings of the run."""
    return {**_model_of(model), "settings": dict(settings)}


def _named_parameters(model: Kernel, values: Floats | None) -> dict[str, float]:
    return dict(zip(model.parameters, parameter_array(model, values).tolist(), strict=True))


def attributes(trajectory: Trajectory) -> dict[str, Any]:
    """The information to repeat a run, and how it ended."""
    return {
        **_origin(trajectory.model, trajectory.settings),
        "parameters": _named_parameters(trajectory.model, trajectory.parameters),
        **{name: getattr(trajectory, name) for name in ("nfev", "njev", "nlu", "status", "success", "message")},
    }


def branch_attributes(branch: Branch) -> dict[str, Any]:
    """The information to repeat a branch, and its limits."""
    return {
        **_model_of(branch.model),
        "parameters": _named_parameters(branch.model, branch.p),
        **{name: getattr(branch, name) for name in ("t", "limits", "without_value")},
    }


def to_dataframe(trajectory: Trajectory) -> pandas.DataFrame:
    """A trajectory as a DataFrame; see `Trajectory.to_dataframe`."""
    columns = trajectory.columns()
    return _imported("pandas", "Tables").DataFrame(columns).set_index("t")


def _imported(name: str, what: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ModelError(f"{what} need {name}: pip install 'fourbar_codegen[data]'.") from error


def to_dataset(trajectory: Trajectory) -> xarray.Dataset:
    """A trajectory as a dataset; see `Trajectory.to_xarray`."""
    xarray = _imported("xarray", "Datasets")
    model = trajectory.model
    described = (
        (model.coordinates, trajectory.q, "coordinate"),
        (model.speeds, trajectory.u, "speed"),
        (model.auxiliary_states, trajectory.z, "auxiliary state"),
        (model.inputs, trajectory.r, "input"),
        (model.outputs, trajectory.outputs, "output"),
    )
    variables = {
        name: ("time", values, {"kind": kind})
        for names, rows, kind in described
        for name, values in zip(names, rows, strict=True)
    }
    check_free(variables, {"time", "constraint", "row", "point", "forced_point", "axis"})
    more = {
        "constraint_residual": (("constraint", "time"), trajectory.constraint_residual, {}),
        "velocity_residual": (("row", "time"), trajectory.velocity_residual, {}),
        "multiplier": (("row", "time"), trajectory.multipliers, {}),
        "kinetic_energy": ("time", trajectory.kinetic_energy, {"units": "J"}),
        "potential_energy": ("time", trajectory.potential_energy, {"units": "J", **_left_out(trajectory)}),
        **{
            vector.name: (("axis", "time"), trajectory.vectors[vector.name], {"units": vector.unit})
            for vector in VECTORS
        },
        "position": (
            ("point", "axis", "time"),
            np.reshape(list(trajectory.points.values()), (len(model.points), 3, len(trajectory.t))),
            {"units": "m"},
        ),
        "force": (
            ("forced_point", "axis", "time"),
            np.reshape(list(trajectory.forces.values()), (len(model.forced_points), 3, len(trajectory.t))),
            {"units": "N"},
        ),
    }
    return xarray.Dataset(
        {**variables, **{name: value for name, value in more.items() if name not in variables}},
        coords={
            "time": ("time", trajectory.t, {"units": "s"}),
            "point": list(model.points),
            "forced_point": list(model.forced_points),
            "axis": ["x", "y", "z"],
        },
        attrs=_texts(attributes(trajectory)),
    )


def _left_out(trajectory: Trajectory) -> dict[str, str]:
    """What the potential energy leaves out, if anything."""
    return {"without": ", ".join(trajectory.energy_without)} if trajectory.energy_without else {}


def _texts(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes as NetCDF takes them: mappings as JSON."""
    return {
        name: json.dumps(value) if isinstance(value, Mapping) else int(value) if isinstance(value, bool) else value
        for name, value in attributes.items()
    }


OF_MEMBERS = {"member", "time", "t", "success", "message", "messages", "nfev", ATTRIBUTES}
"""Names in files of ensembles that are not the model's."""


def ensemble_dataset(ensemble: Ensemble) -> xarray.Dataset:
    """An ensemble as a Dataset; see `Ensemble.to_xarray`."""
    xarray = _imported("xarray", "Datasets")
    series, of_members = _series(ensemble), ensemble.by_member
    check_free((*series, *of_members), OF_MEMBERS)
    ends = {"success": ensemble.success, "message": np.array(ensemble.messages, dtype=object), "nfev": ensemble.nfev}
    return xarray.Dataset(
        {name: ("member", values) for name, values in (of_members | ends).items()}
        | {name: (("member", "time"), values) for name, values in series.items()},
        coords={"time": ("time", ensemble.t, {"units": "s"}), "member": np.arange(len(ensemble))},
        attrs=_texts(_origin(ensemble.model, ensemble.settings)),
    )


def write_ensemble_npz(ensemble: Ensemble, file: IO[bytes]) -> None:
    """An ensemble as NumPy arrays by name; see `Ensemble.save`."""
    series, of_members = _series(ensemble), ensemble.by_member
    check_free((*series, *of_members), OF_MEMBERS)
    ends = {"success": ensemble.success, "messages": np.array(ensemble.messages, dtype=str), "nfev": ensemble.nfev}
    attributes = np.array(json.dumps(_origin(ensemble.model, ensemble.settings)))
    arrays: dict[str, Any] = {**of_members, **ends, **series, "t": ensemble.t, ATTRIBUTES: attributes}
    np.savez(file, **arrays)


def _series(ensemble: Ensemble) -> dict[str, Floats]:
    """States and outputs of all members by name, each of shape (n, n_t)."""
    model = ensemble.model
    has_outputs = model.outputs and len(ensemble)
    nothing = np.empty((len(ensemble), len(model.outputs), len(ensemble.t)))
    outputs = over_members(ensemble, lambda member: member.outputs) if has_outputs else nothing
    return {
        **{name: ensemble.y[:, i] for i, name in enumerate(model.states)},
        **{name: outputs[:, i] for i, name in enumerate(model.outputs)},
    }


def require_netcdf() -> None:
    """Raise a ModelError if a package is missing that NetCDF needs."""
    for name in ("xarray", "h5netcdf", "h5py"):
        if find_spec(name) is None:
            raise ModelError(f"NetCDF needs {name}: pip install 'fourbar_codegen[data]'.")


def write_dataset(dataset: xarray.Dataset, file: IO[bytes]) -> None:
    """A dataset as NetCDF 4, by h5netcdf."""
    require_netcdf()
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    # With NetCDF's own checksums, so that damaged numbers are detected.
    numbers = (name for name, array in dataset.variables.items() if array.dtype == float and array.size)
    summed = {name: {"fletcher32": True} for name in numbers}
    # In memory, where writing cannot fail: HDF5 may abort the process when it closes a file that it could not write.
    memory = io.BytesIO()
    try:
        with h5netcdf.File(memory, "w") as held:
            dataset.dump_to_store(H5NetCDFStore(held), encoding=summed)
    except ValueError as error:  # outputs may have names that NetCDF does not allow
        raise ModelError(f"NetCDF cannot hold this result: {error}.") from error
    content = memory.getbuffer()
    file.write(content)
    file.write(SEAL + sha256(content).digest())


def write_npz(columns: Mapping[str, Floats], attributes: Mapping[str, Any], file: IO[bytes]) -> None:
    """NumPy arrays by name, with everything else as JSON."""
    if ATTRIBUTES in columns:
        raise ModelError(f"The name {ATTRIBUTES} is reserved in NPZ files: rename the state or output.")
    arrays: dict[str, Any] = {**columns, ATTRIBUTES: np.array(json.dumps(attributes))}
    np.savez(file, **arrays)


def read_trajectory(path: str | Path, model: Kernel | None, find: Callable[[str, str], Kernel | None]) -> Trajectory:
    """Read a saved trajectory; see `fourbar_codegen.load_trajectory`.

    Parameters
    ----------
    path : str or Path
    model : Kernel or None
        The simulated model.
    find : callable
        Returns the model with a name and fingerprint, or None; used if no model is given.
    """
    path = path_of(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ModelError(f"Trajectories are read from {' and '.join(_READERS)} files, not from {path.name!r}.")
    try:
        if not path.is_file():
            raise ModelError(f"{path} cannot be read: there is no such file.")
        attributes, columns = reader(path)
    except ModelError:
        raise
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror or error}.") from error
    except Exception as error:  # any error of the reading libraries on a damaged file
        raise _unreadable(path, error) from error
    try:
        name, fingerprint = (_entry(attributes, key, str) for key in ("model", "fingerprint"))
        model = find(name, fingerprint) if model is None else model
        if model is None:
            raise ModelError(
                f"{path} is a run of the model {name!r} with the fingerprint {fingerprint[:16]!r}, which "
                "is not in the package, not installed from a wheel, and not in the cache of this machine: pass it, as "
                f"load_trajectory({str(path)!r}, model=compile_model(...)), or as model=load(...) with the path of the "
                "module that build_model made."
            )
        if fingerprint != model.layout.fingerprint:
            raise ModelError(
                f"{path} is a run of another model, {name!r} with the fingerprint {fingerprint[:16]!r}: {model.name} "
                f"has {model.layout.fingerprint[:16]}. Give the model that was run as model=."
            )
        return _trajectory(model, attributes, columns)
    except FourbarError:
        raise
    except (KeyError, ValueError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ModelError:
    reason = f"{error} is missing" if isinstance(error, KeyError) else str(error) or type(error).__name__
    return ModelError(f"{path} holds no trajectory that fourbar_codegen has saved: {reason}.")


def _trajectory(model: Kernel, attributes: Mapping[str, Any], columns: Mapping[str, Any]) -> Trajectory:
    """A trajectory from the data of a file; a KeyError or ValueError says what is wrong with them."""
    t = _column(columns, "t")
    steps = np.diff(t)
    if not np.isfinite(t).all() or not ((steps >= 0).all() or (steps <= 0).all()):
        raise ValueError("its times are not finite, or do not go in one direction")
    parameters, settings = (_entry(attributes, key, dict) for key in ("parameters", "settings"))
    _entry(settings, "constraints", str)
    _entry({"held": [], **settings}, "held", list)
    values = [_number(parameters, name) for name in model.parameters]
    rows = {name: _column(columns, name) for name in (*model.states, *model.inputs)}
    for name, row in rows.items():
        if row.shape != t.shape:
            raise ValueError(f"its {name} has {len(row)} values for {len(t)} times")
    return Trajectory(
        model=model,
        parameters=np.array(values, dtype=float),
        t=t,
        y=np.reshape([rows[name] for name in model.states], (model.n_x, len(t))),
        r=np.reshape([rows[name] for name in model.inputs], (model.n_r, len(t))),
        sol=None,
        t_events=None,
        y_events=None,
        settings={**settings, "t_span": tuple(_entry(settings, "t_span", list))},
        inputs=None,
        success=_entry(attributes, "success", bool),
        message=_entry(attributes, "message", str),
        **{key: _entry(attributes, key, int) for key in _COUNTS},
    )


def _entry(attributes: Mapping[str, Any], key: str, kind: type) -> Any:
    value = attributes[key]
    # The largest integers of NetCDF.
    if type(value) is not kind or (isinstance(value, int) and abs(value) >= 2**63):
        raise ValueError(f"its {key} is no {kind.__name__}")
    return value


def _number(parameters: Mapping[str, Any], name: str) -> float:
    value = parameters[name]
    # An int may be too large for a float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise ValueError(f"its parameter {name} is no finite number")
    return float(value)


def _column(columns: Mapping[str, Any], name: str) -> Floats:
    values = np.asarray(columns[name])
    if values.dtype.kind not in "fiu" or values.ndim != 1:
        raise ValueError(f"its {name} is no row of real numbers, but {values.dtype} of shape {values.shape}")
    return np.ascontiguousarray(values, dtype=float)


_Read = tuple[Mapping[str, Any], Mapping[str, Any]]


def _read_npz(path: Path) -> _Read:
    with path.open("rb") as opened:
        if not is_zipfile(opened):  # NumPy would give misleading advice about pickles
            raise ModelError(f"{path} is not an NPZ file, or it is damaged.")
        with np.load(opened, allow_pickle=False) as file:
            arrays = dict(file)
    return _parsed(str(arrays[ATTRIBUTES])), arrays


def _read_netcdf(path: Path) -> _Read:
    require_netcdf()
    import h5netcdf

    content = path.read_bytes()
    end = len(content) - len(SEAL) - sha256().digest_size
    if content[end:].startswith(SEAL) and content[end + len(SEAL) :] != sha256(content[:end]).digest():
        raise ModelError(f"{path} is damaged, or was changed by another program: its digest does not match.")
    _require_whole_heaps(content)
    _require_own_data(io.BytesIO(content))
    most = MAX_COMPRESSION * len(content)
    with h5netcdf.File(io.BytesIO(content), "r") as file:
        attributes = dict(file.attrs)
        variables = {name: v for name, v in file.variables.items() if v.dimensions == ("time",)}
        for name, variable in variables.items():
            if variable.shape[0] * variable.dtype.itemsize > most:  # HDF5 fills missing values
                raise ValueError(f"its {name} claims {variable.shape[0]} values, for which the file is too small")
        columns = {name: variable[...] for name, variable in variables.items()}
    columns["t"] = columns.pop("time")
    for name in ("parameters", "settings"):
        attributes[name] = _parsed(attributes[name])
    attributes["success"] = bool(attributes["success"])
    attributes.update({name: int(attributes[name]) for name in _COUNTS})
    return attributes, columns


def _require_whole_heaps(content: bytes) -> None:
    """Raise a ValueError if a global heap is damaged: HDF5 2.0 may loop forever over its objects.

    Source: The HDF Group, *HDF5 File Format Specification Version 3.0*, section III.E, disk format of global heaps.
    """
    header = struct.Struct("<H6xQ")  # an object's index, and its size; that of free space, index 0, with the header
    for heap in re.finditer(rb"GCOL\x01", content):
        place = heap.start() + header.size
        end = heap.start() + int.from_bytes(content[heap.start() + 8 : place], "little")
        length = header.size
        while place + header.size <= end <= len(content) and length >= header.size:
            index, size = header.unpack_from(content, place)
            length = header.size + (size + 7) // 8 * 8 if index else size
            place += length
        if length < header.size or not place <= end <= len(content):
            raise ValueError("the heap of its texts is damaged")


def _require_own_data(file: IO[bytes]) -> None:
    """Raise a ValueError if a variable refers to another file, which HDF5 would read."""
    import h5py

    with h5py.File(file, "r") as opened:
        for name in opened:
            link = opened.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"its {name} is a link to another place")
            entry = opened[name]
            if isinstance(entry, h5py.Dataset) and (entry.is_virtual or entry.external):
                raise ValueError(f"its {name} is in another file")


def _parsed(text: str) -> dict[str, Any]:
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError(f"where names and values should be, there is {type(value).__name__}")
    return value


_COUNTS = ("nfev", "njev", "nlu", "status")

_READERS: dict[str, Callable[[Path], _Read]] = {".nc": _read_netcdf, ".npz": _read_npz}
