"""NetCDF 4, by h5netcdf, with a digest of the whole file behind its end."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Mapping
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from fourbar_codegen.errors import ModelError
from fourbar_codegen.files.pandas_xarray import ensemble_dataset, to_dataset
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.provenance import COUNTS, parsed
from fourbar_codegen.results.trajectory import Trajectory

if TYPE_CHECKING:
    import xarray

__all__ = ["read_trajectory", "require", "write_ensemble", "write_trajectory"]

SEAL = b"fourbar_codegen SHA-256 "
"""Marks the SHA-256 digest that is appended to a NetCDF file. HDF5 ignores bytes after its end, but may hang when it
reads damaged data."""

MAX_COMPRESSION = 1100
"""Largest ratio of decompression that is accepted: zlib's limit is 1032."""


def require() -> None:
    """Raise a ModelError if a package is missing that NetCDF needs."""
    for name in ("xarray", "h5netcdf", "h5py"):
        if find_spec(name) is None:
            raise ModelError(f"NetCDF needs {name}: pip install 'fourbar_codegen[data]'.")


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """The dataset of `Trajectory.to_xarray`."""
    _write(to_dataset(trajectory), file)


def write_ensemble(ensemble: Ensemble, file: IO[bytes]) -> None:
    """The dataset of `Ensemble.to_xarray`."""
    _write(ensemble_dataset(ensemble), file)


def _write(dataset: xarray.Dataset, file: IO[bytes]) -> None:
    require()
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


def read_trajectory(path: Path) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """The attributes and the arrays over time of a file."""
    require()
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
        attributes[name] = parsed(attributes[name])
    attributes["success"] = bool(attributes["success"])
    attributes.update({name: int(attributes[name]) for name in COUNTS})
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
