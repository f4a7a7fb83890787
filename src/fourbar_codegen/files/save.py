"""Results are written to files, in the format that the suffix selects; see `fourbar_codegen.files.formats`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

from fourbar_codegen.errors import ModelError
from fourbar_codegen.files import formats
from fourbar_codegen.interface.paths import path_of, write_whole
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["known_formats", "module_of", "require_format", "save_branch", "save_ensemble", "save_trajectory"]


def _suffixes() -> list[str]:
    return [f".{module.name}" for module in iter_modules(formats.__path__)]


def module_of(path: Path) -> ModuleType | None:
    """The module of the format that a path's suffix selects, or None."""
    suffix = path.suffix.lower()
    return import_module(f"{formats.__name__}{suffix}") if suffix in _suffixes() else None


def known_formats(function: str) -> list[str]:
    """The suffixes of the formats that have a function, such as ``"write_trajectory"``."""
    return [suffix for suffix in _suffixes() if hasattr(import_module(f"{formats.__name__}{suffix}"), function)]


def require_format(path: Path, kind: str) -> Callable[..., None]:
    """The function that writes a kind of result to a path.

    Parameters
    ----------
    path : Path
    kind : {"trajectory", "ensemble", "branch"}

    Raises
    ------
    ModelError
        If no format has the path's suffix, or it needs a package that is missing.
    """
    module = module_of(path)
    write: Callable[..., None] | None = getattr(module, f"write_{kind}", None)
    if module is None or write is None:
        known = ", ".join(known_formats(f"write_{kind}"))
        raise ModelError(
            f"{'An' if kind == 'ensemble' else 'A'} {kind} is saved as {known}; {path.name!r} ends otherwise."
        )
    if hasattr(module, "require"):
        module.require()
    return write


def _save(result: Any, given: str | Path, kind: str) -> Path:
    path = path_of(given)
    return write_whole(path, partial(require_format(path, kind), result))


def save_trajectory(trajectory: Trajectory, path: str | Path) -> Path:
    """Write the trajectory to a file.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: ``.csv`` (a row for each time, all digits: `columns`, and positions of
        points, with the units of energies, momenta and positions in brackets), ``.npz`` (NumPy, an array for
        each name), ``.nc`` (NetCDF of `to_xarray`; needs the extra ``data``), ``.html`` (interactive report),
        ``.png`` (plot), ``.gif`` or ``.mp4`` (animation); these three need the extra ``visual``, ``.mp4`` also
        FFmpeg; ``.glb`` or ``.gltf`` (bodies with an animation, for Blender and slides; needs ``meshes``). Missing
        folders are created. `load_trajectory` reads ``.npz`` and ``.nc``. If writing fails, an existing file is not
        changed.

    Returns
    -------
    Path

    Raises
    ------
    ModelError
        If this is no path, the suffix is unknown, the file cannot be written, or a required package is missing.
    """
    return _save(trajectory, path, "trajectory")


def save_ensemble(ensemble: Ensemble, path: str | Path) -> Path:
    """Write the ensemble to a file.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: ``.csv`` (a row for each member and time: the parameters that differ, states
        and outputs), ``.npz`` (NumPy: ``t``; each state and output, shape (n, n_t); each parameter, ``success``,
        ``messages`` and ``nfev``, shape (n,)), ``.nc`` (NetCDF of `to_xarray`; needs the extra ``data``), ``.png``
        (`plot`; needs the extra ``visual``). Missing folders are created. If writing fails, an existing file is not
        changed.

    Returns
    -------
    Path

    Raises
    ------
    ModelError
        If this is no path, the suffix is unknown, the file cannot be written, or a required package is missing.
    """
    return _save(ensemble, path, "ensemble")


def save_branch(branch: Branch, path: str | Path) -> Path:
    """Write the branch to a file.

    Parameters
    ----------
    path : str or Path
        The suffix selects the format: ``.csv`` (a row for each value of the drive, with the `columns`, all digits)
        or ``.npz`` (NumPy, an array for each of them, and as JSON ``run_attributes``: model, fingerprint, versions,
        parameters and limits). Missing folders are created. If writing fails, an existing file is not changed.

    Returns
    -------
    Path

    Raises
    ------
    ModelError
        If this is no path, the suffix is unknown, or the file cannot be written.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> import numpy as np
    >>> branch = fb.load("four_bar").kinematics({"q1": [-0.5, 0.0, 0.5]})[0]
    >>> np.load(branch.save("branch.npz"))["P2.x"].round(4)  # doctest: +SKIP
    """
    return _save(branch, path, "branch")
