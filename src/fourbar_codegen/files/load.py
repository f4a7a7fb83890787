"""Runs that are read from files."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.building.cached_models import find_kernel
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.errors import FourbarError, ModelError
from fourbar_codegen.files.save import known_formats, module_of
from fourbar_codegen.interface.paths import path_of
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.provenance import COUNTS
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["load_trajectory"]

Floats = NDArray[np.float64]


def load_trajectory(path: str | Path, model: CompiledModel | None = None) -> Trajectory:
    """Read a trajectory from a file of `Trajectory.save`.

    Parameters
    ----------
    path : str or Path
        A ``.nc`` or ``.npz`` file.
    model : CompiledModel, optional
        The simulated model. Without it, the model with the name and fingerprint in the file is searched: in this
        package, among models installed from wheels, and in the cache of this machine.

    Returns
    -------
    Trajectory
        Without interpolant and events; these are not saved.

    Raises
    ------
    ModelError
        If the file cannot be read or has another format, the run is of another model, or the model is not found.

    Notes
    -----
    Files may come from untrusted sources: they contain the name and fingerprint of the model, but no path. A package
    is imported only if its own manifest.json has this name and fingerprint; the cache is searched by a key made of
    both.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> path = run.save("run.npz")  # doctest: +SKIP
    >>> fb.load_trajectory(path).y.shape == run.y.shape  # doctest: +SKIP
    True
    """
    if not (model is None or isinstance(model, CompiledModel)):
        raise ModelError(f"model must be a CompiledModel or None, not {model!r}.")
    path = path_of(path)
    reader = getattr(module_of(path), "read_trajectory", None)
    if reader is None:
        known = " and ".join(known_formats("read_trajectory"))
        raise ModelError(f"Trajectories are read from {known} files, not from {path.name!r}.")
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
        kernel = find_kernel(name, fingerprint) if model is None else model.kernel
        if kernel is None:
            raise ModelError(
                f"{path} is a run of the model {name!r} with the fingerprint {fingerprint[:16]!r}, which "
                "is not in the package, not installed from a wheel, and not in the cache of this machine: pass it, as "
                f"load_trajectory({str(path)!r}, model=compile_model(...)), or as model=load(...) with the path of the "
                "module that build_model made."
            )
        if fingerprint != kernel.layout.fingerprint:
            raise ModelError(
                f"{path} is a run of another model, {name!r} with the fingerprint {fingerprint[:16]!r}: {kernel.name} "
                f"has {kernel.layout.fingerprint[:16]}. Give the model that was run as model=."
            )
        return _trajectory(kernel, attributes, columns)
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
    status = _entry(attributes, "status", int)
    if _entry(attributes, "success", bool) != (status >= 0):
        raise ValueError("its status and its success are not those of a run")
    return Trajectory(
        kernel=model,
        parameters=np.array(values, dtype=float),
        t=t,
        y=np.reshape([rows[name] for name in model.states], (model.n_x, len(t))),
        r=np.reshape([rows[name] for name in model.inputs], (model.n_r, len(t))),
        settings={**settings, "t_span": tuple(_entry(settings, "t_span", list))},
        inputs=None,
        message=_entry(attributes, "message", str),
        **{key: _entry(attributes, key, int) for key in COUNTS},
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
