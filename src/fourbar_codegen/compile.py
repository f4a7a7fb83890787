"""The pipeline: Model -> Equations -> Program -> C and Cython text -> library or extension module -> CompiledModel."""

from __future__ import annotations

import pickle
import re
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from fourbar_codegen.arguments import flag
from fourbar_codegen.building.cache import cached, find_cached
from fourbar_codegen.building.library import install
from fourbar_codegen.building.toolchain import build_extension
from fourbar_codegen.building.wheel import WHEEL_SUMMARY, pack_wheel
from fourbar_codegen.compiled import CompiledModel
from fourbar_codegen.errors import ModelError, ModelWarning
from fourbar_codegen.expressions.fingerprint import fingerprint
from fourbar_codegen.files import path_of
from fourbar_codegen.kernel.loading import cache_key, load_cached, load_file
from fourbar_codegen.layout import Layout
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.progress import Progress
from fourbar_codegen.runtime.evaluator import versions

if TYPE_CHECKING:
    from fourbar_codegen.dynamics.derivatives import Derivatives
    from fourbar_codegen.dynamics.equations import Equations
    from fourbar_codegen.lowering.program import Program
    from fourbar_codegen.lowering.schedule import Schedule, ScheduledFunction

__all__ = [
    "Generated",
    "build_model",
    "build_wheel",
    "compile_model",
    "generate_derivatives",
    "generate_kernel",
    "generate_sources",
    "key_of",
    "warn",
]


def generate_sources(model: Model) -> dict[str, str]:
    """Generate a model's sources.

    Parameters
    ----------
    model : Model

    Returns
    -------
    dict of str to str
        Text by file name: the C sources and header, the Cython wrapper, and manifest.json. The same
        model gives the same text, on every machine and in every process.

    Raises
    ------
    ModelError
        If the model has something that cannot be compiled.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> sources = fb.generate_sources(fb.models.four_bar())
    >>> sorted(name for name in sources if "avx" not in name)
    ['four_bar.pyx', 'four_bar_batch.c', 'four_bar_derivatives.c', 'four_bar_kernel.c',
     'four_bar_kernel.h', 'four_bar_products.c', 'manifest.json']
    """
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        equations, _, sources = _generate(model, progress)
    warn(equations.warnings, 3)
    return sources


@dataclass(frozen=True)
class Generated:
    """The sources of a kernel, and what derivatives are generated from."""

    equations: Equations
    scheduled: Schedule
    names: dict[str, tuple[str, ...]]
    sources: dict[str, str]
    layout: Layout


def generate_kernel(model: Model, progress: Progress) -> Generated:
    """The equations, and the sources that a simulation needs."""
    _require_model(model)
    # Imported here, since a model in the cache does not need it.
    from fourbar_codegen.codegen.c_source import batch_text, header_text, kernel_text
    from fourbar_codegen.codegen.manifest import layout_of
    from fourbar_codegen.dynamics.formation import form_equations
    from fourbar_codegen.lowering.lower import lower
    from fourbar_codegen.lowering.schedule import schedule

    progress.stage("forming the equations")
    equations = form_equations(model)
    progress.stage("eliminating common subexpressions")
    program = lower(model.name, equations)
    scheduled = schedule(program)
    progress.stage("printing")
    names = {
        "coordinates": model.coordinates,
        "speeds": model.speeds,
        "auxiliary_states": model.auxiliary_states,
        "parameters": tuple(leaf.name for leaf in program.parameters),
        "inputs": tuple(leaf.name for leaf in program.inputs),
        "outputs": model.outputs,
    }
    batch = batch_text(scheduled)
    sources = {
        f"{model.name}_kernel.c": kernel_text(scheduled, names),
        **({f"{model.name}_batch.c": batch} if batch else {}),
        f"{model.name}_kernel.h": header_text(scheduled, names),
    }
    layout = layout_of(model, equations, program, names, fingerprint(_described(model)))
    return Generated(equations, scheduled, names, sources, layout)


def generate_derivatives(equations: Equations, program: Program) -> tuple[Derivatives, list[ScheduledFunction]]:
    """The derivatives, and their functions."""
    from fourbar_codegen.dynamics.derivatives import form_derivatives
    from fourbar_codegen.lowering.lower import lower_derivatives
    from fourbar_codegen.lowering.schedule import schedule_function

    derivatives = form_derivatives(equations, by_columns=program.form == "recursive")
    functions = lower_derivatives(program, equations, derivatives)
    return derivatives, [schedule_function(function, inline_angles=False) for function in functions]


def _generate_products(equations: Equations, program: Program) -> list[ScheduledFunction]:
    """Products of derivatives with vectors."""
    from fourbar_codegen.dynamics.products import form_products
    from fourbar_codegen.lowering.lower import lower_products
    from fourbar_codegen.lowering.schedule import schedule_function

    functions = lower_products(program, equations, form_products(equations))
    return [schedule_function(function, inline_angles=True) for function in functions]


def _source_of(equations: Equations, program: Program, names: dict[str, tuple[str, ...]], part: str) -> str:
    """The C source of a part that is compiled at its first use."""
    from fourbar_codegen.codegen.c_source import derivatives_text, products_text

    if part == "derivatives":
        return derivatives_text(program.name, generate_derivatives(equations, program)[1], names)
    return products_text(program.name, _generate_products(equations, program), names)


def _generate(model: Model, progress: Progress) -> tuple[Equations, Derivatives, dict[str, str]]:
    """The equations, their derivatives, and all sources made from them."""
    generated = generate_kernel(model, progress)
    from fourbar_codegen.codegen.c_source import derivatives_text, products_text, version_texts
    from fourbar_codegen.codegen.cython_source import wrapper_text
    from fourbar_codegen.codegen.manifest import operations_of

    equations, program, names = generated.equations, generated.scheduled.program, generated.names
    # On a tape of their own, as at their first use: the text of a part does not depend on what was formed before.
    varied = _generate_products(*pickle.loads(pickle.dumps((equations, program))))
    derivatives, scheduled = generate_derivatives(equations, program)
    functions = (*program.functions, *(f.function for f in (*scheduled, *varied)))
    layout = replace(generated.layout, operations=operations_of(functions))
    return (
        equations,
        derivatives,
        {
            **generated.sources,
            **{f"{model.name}{suffix}": text for suffix, text in version_texts(generated.scheduled).items()},
            f"{model.name}_derivatives.c": derivatives_text(model.name, scheduled, names),
            f"{model.name}_products.c": products_text(model.name, varied, names),
            f"{model.name}.pyx": wrapper_text(model, layout),
            "manifest.json": layout.to_text(),
        },
    )


def key_of(model: Model, *, checked: bool = True) -> str:
    """The cache key of a model: a digest of everything that its compiled module depends on, and of `checked`.

    These are the model (mechanism, names, defaults and inputs, which the fingerprint in the manifest covers), this
    package's own sources, SymPy, the compiler and its flags. The library has its own key, made from its sources and the
    compiler, so that models with the same sources share it.
    """
    return cache_key(fingerprint(_described(model)), checked=checked)


def _described(model: Model) -> tuple[object, ...]:
    """Everything in a model that its equations and their arguments depend on."""
    return (
        model.name,
        model.mechanism,
        model.parameters,
        model.named_parameters,
        model.input_expressions,
        model.derived_parameters,
        model.initial,
        model.reactions,
        model.potential_energy,
        model.output_expressions,
        model.state_equations,
    )


def _require_model(model: object) -> None:
    if not isinstance(model, Model):
        raise ModelError(f"A Model is needed, not a {type(model).__name__}: wrap a System in fourbar_codegen.Model.")


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
    _require_model(model)
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
    _require_model(model)
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
        equations, derivatives, sources = _generate(model, progress)
        progress.stage("compiling")
        build = partial(build_extension, model.name, folder=folder)
        if not compares:
            module, warnings = build(sources), equations.warnings
        else:
            from fourbar_codegen.verify import N_STATES

            compare = _comparison(progress, equations, derivatives)

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


def not_compared(name: str) -> str:
    """The warning where a model could not be compared with its equations."""
    from fourbar_codegen.verify import DISTANCES

    return (
        f"The compiled motion of model {name} was not compared with its equations, which have no real value at any of "
        f"{len(DISTANCES)} states: random ones, some near the initial values, and these. Give the Model initial values "
        "(initial=) and parameters (parameters=) at which its expressions have a value."
    )


def warn(sentences: Iterable[str], level: int) -> None:
    """Warn about inconsistent kinematics, on the caller's line."""
    for sentence in sentences:
        warnings.warn(sentence, ModelWarning, stacklevel=level)


def _comparison(
    progress: Progress, equations: Equations, derivatives: Derivatives | None = None
) -> Callable[[Path], int]:
    """A function that compares a compiled model with its equations; it returns at how many states."""

    def compare(module: Path) -> int:
        from fourbar_codegen.kernel.comparison import compare_batch_functions, compare_products
        from fourbar_codegen.verify import verify

        progress.stage("checking")
        loaded, compared = load_file(module), []
        for kernel in versions(loaded.kernel):
            model = CompiledModel(kernel, loaded.layout)
            compared.append(verify(model, equations, derivatives))
            if not model.lacks_batch_functions:
                compare_batch_functions(model)
            if not model.lacks_products:
                compare_products(model)
        return min(compared)

    return compare


def compile_model(model: Model, *, check: bool = True) -> CompiledModel:
    """Compile a model, or load it from the cache if the same model was compiled before.

    The functions that a simulation by an explicit method needs are compiled at once. Derivatives, drawing data, and the
    functions for batches of states are formed and compiled at their first use. The cache is in the user's
    cache folder, or in the folder given by the environment variable ``FOURBAR_CODEGEN_CACHE``.

    Parameters
    ----------
    model : Model
    check : bool, optional
        Whether to compare the compiled functions with the equations, evaluated in Python at random states. A model that
        was compiled with ``check=False`` is compared at a later call with ``check=True``. Functions that are compiled
        later are compared then, or not at all: derivatives with differences, batches of states with single states.

    Returns
    -------
    CompiledModel

    Raises
    ------
    ModelError
        If the model has something that cannot be compiled.
    BuildError
        If there is no C compiler, or it fails, with its output; or the comparison fails.
    CacheError
        If the cache's folder cannot be written.

    Warns
    -----
    ModelWarning
        If kinematics are inconsistent: an angular velocity or velocity that was set differs from the one that follows
        from orientations or positions, or an acceleration from the one that follows from velocities. Also if `check` is
        true and the equations have no real value at any of the states at which they would be compared.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.compile_model(fb.models.four_bar()).n_x
    6
    """
    _require_model(model)
    check = flag(check, "check")

    def build(folder: Path) -> Path:
        with Progress(f"fourbar_codegen: {model.name}") as progress:
            generated = generate_kernel(model, progress)
            progress.stage("compiling")
            equations, program = generated.equations, generated.scheduled.program
            return install(
                model.name,
                generated.sources,
                generated.layout,
                folder,
                later=pickle.dumps(partial(_source_of, equations, program, generated.names)),
                check=_comparison(progress, equations) if check else None,
            )

    key = key_of(model)
    if not check and find_cached(model.name, key) is None:
        key = key_of(model, checked=False)
    compiled = CompiledModel.from_loaded(load_cached(lambda: cached(model.name, key, build)))
    compiled.compares = check
    unsure = (not_compared(model.name),) if check and not compiled.is_verified else ()
    warn((*compiled.layout.warnings, *unsure), 3)
    return compiled
