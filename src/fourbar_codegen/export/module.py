"""A model as an extension module beside its sources, and as a wheel."""

from __future__ import annotations

import re
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

from fourbar_codegen.building.toolchain import build_extension
from fourbar_codegen.errors import ModelError
from fourbar_codegen.export.wheel import WHEEL_SUMMARY, pack_wheel
from fourbar_codegen.interface.arguments import flag
from fourbar_codegen.interface.paths import path_of
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.layout import Layout
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.pipeline.check import comparison, not_compared, warn
from fourbar_codegen.pipeline.generate import generate_all, require_model

__all__ = ["build_model", "build_wheel"]


def build_model(model: Model, folder: str | Path, *, check: bool = True) -> Path:
    """Compile a model to an extension module in a folder, beside its sources.

    The module runs on other machines of the same kind, with NumPy alone or through `load`.

    Parameters
    ----------
    model : Model
    folder : str or Path
        Created if it does not exist; it changes only after a complete build.
    check : bool, optional
        Whether to compare the compiled functions with the equations, at random states.

    Returns
    -------
    Path
        The extension module.

    Raises
    ------
    ModelError, BuildError
        As for `compile_model`.
    """
    require_model(model)
    return _build(model, path_of(folder), check=check)


def build_wheel(model: Model, folder: str | Path, *, version: str = "0.1.0", check: bool = True) -> Path:
    """Compile a model into a wheel, for ``pip install`` on machines without SymPy or a compiler.

    The package has the model's name. Its ``rhs`` needs only NumPy, the only requirement of the wheel. The extra
    ``simulate`` adds fourbar_codegen, whose ``load`` finds the model by its name.

    Parameters
    ----------
    model : Model
        Its name becomes the wheel's.
    folder : str or Path
        The folder for the wheel; created if it does not exist.
    version : str, optional
        Of the wheel.
    check : bool, optional
        As for `build_model`.

    Returns
    -------
    Path
        The wheel, for the Python and the kind of machine that it was made on.

    Raises
    ------
    ModelError, BuildError
        As for `compile_model`; or if the version is invalid, or the name is not in lower case or belongs to another
        module.

    Source: PEP 427, by setuptools.
    """
    require_model(model)
    pattern = r"[0-9]+(\.[0-9]+)*((a|b|rc|\.post|\.dev)[0-9]+)?"
    if not isinstance(version, str) or not re.fullmatch(pattern, version):
        raise ModelError(f"A version looks like 1.0 or 0.2.1, not {version!r}.")
    folder = path_of(folder)
    if _is_taken(model.name):
        raise ModelError(
            f"A wheel cannot be named {model.name!r}: a module of that name exists. Give the Model another name."
        )
    # https://packaging.python.org/en/latest/specifications/name-normalization
    normal = re.sub("_+", "_", model.name).lower()
    if model.name != normal:
        raise ModelError(
            f"A wheel cannot be named {model.name!r}: for pip that is the same project as {normal!r}, and installing "
            "one would replace the other. Give the Model a name without capitals or consecutive underscores."
        )
    if model.name.strip("_") != model.name:
        raise ModelError(
            f"A wheel cannot be named {model.name!r}: pip refuses underscores at either end of a name. Give the Model "
            "another name."
        )
    from importlib.metadata import version as distribution_version

    import numpy as np

    own = ".".join(distribution_version("fourbar_codegen").split(".")[:2])
    requires = [f"numpy>={np.__version__.split('.')[0]}.0"]
    extras = {"simulate": [f"fourbar_codegen~={own}.0"]}
    with tempfile.TemporaryDirectory() as temporary:
        module = _build(model, Path(temporary) / model.name, check=check)
        return pack_wheel(module, folder, version=version, requires=requires, extras=extras)


def _is_taken(name: str) -> bool:
    """Whether a wheel of this name would hide another module."""
    if name in {"fourbar_codegen", "four_bar", "setup", "test", *sys.stdlib_module_names}:
        return True
    from importlib.metadata import metadata, packages_distributions

    owners = packages_distributions().get(name, [])
    # Wheels of models, which may be replaced by new versions, have the name of their module.
    return any(not (metadata(owner)["Summary"] or "").startswith(WHEEL_SUMMARY) for owner in owners)


def _build(model: Model, folder: Path, *, check: bool) -> Path:
    """An extension module in a folder."""
    compares = flag(check, "check")
    with Progress(f"fourbar_codegen: {model.name}") as progress:
        equations, derivatives, sources = generate_all(model, progress)
        progress.stage("compiling")
        build = partial(build_extension, model.name, folder=folder)
        if not compares:
            module, warnings = build(sources), equations.warnings
        else:
            from fourbar_codegen.pipeline.verify import N_STATES

            compare = comparison(progress, equations, derivatives)

            def compare_anything(module: Path) -> None:
                if not compare(module):
                    raise _NothingComparedError

            try:
                # The module says how it was compared, which is known only after it has been compiled.
                module, warnings = build(_saying(sources, model, N_STATES), check=compare_anything), equations.warnings
            except _NothingComparedError:
                module = build(_saying(sources, model, 0))
                warnings = (*equations.warnings, not_compared(model.name))
    warn(warnings, 4)
    return module


class _NothingComparedError(Exception):
    """The equations of motion have no real value at any of the states."""


def _saying(sources: dict[str, str], model: Model, compared: int) -> dict[str, str]:
    """A module's sources, with the number of states at which it is compared."""
    from fourbar_codegen.codegen.cython_source import wrapper_text

    layout = replace(Layout.from_text(sources["manifest.json"]), compared=compared)
    return {**sources, f"{model.name}.pyx": wrapper_text(model, layout), "manifest.json": layout.to_text()}
