"""The pipeline: Model -> Generated (equations, program, sources) -> library -> Kernel -> CompiledModel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fourbar_codegen.body_shapes import data_of
from fourbar_codegen.building.cache import cached, find_cached
from fourbar_codegen.building.cached_models import cache_key, load_cached
from fourbar_codegen.building.kernel_library import install
from fourbar_codegen.building.loading import kernel_of
from fourbar_codegen.compiled_model import CompiledModel, facade_of
from fourbar_codegen.expressions.fingerprint import fingerprint
from fourbar_codegen.interface.arguments import flag
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.pipeline.check import comparison, not_compared, warn
from fourbar_codegen.pipeline.generate import described, generate_kernel, require_model

__all__ = ["compile_model", "key_of"]


def compile_model(model: Model, *, check: bool = True) -> CompiledModel:
    """Compile a model, or load it from the cache if the same model was compiled before.

    The functions that a simulation by an explicit method needs are compiled at once. What pictures need, derivatives,
    and the functions for batches of states are formed and compiled at their first use. The cache is in the user's
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
    require_model(model)
    check = flag(check, "check")

    def build(folder: Path) -> Path:
        with Progress(f"fourbar_codegen: {model.name}") as progress:
            generated = generate_kernel(model, progress)
            progress.stage("compiling")
            compare = comparison(progress, generated.equations) if check else None
            return install(
                model.name, generated.sources, generated.layout, folder, later=generated.later(), check=compare
            )

    key = key_of(model)
    if not check and find_cached(model.name, key) is None:
        key = key_of(model, checked=False)
    loaded = load_cached(lambda: cached(model.name, key, build))
    layout = loaded.layout.with_body_shapes(data_of(model.shapes))
    compiled = facade_of(kernel_of(replace(loaded, layout=layout), compares=check))
    warn(compiled.layout.warnings, 3)
    if check and not compiled.is_verified:
        warn([not_compared(model.name)], 3)
    return compiled


def key_of(model: Model, *, checked: bool = True) -> str:
    """The cache key of a model: a digest of everything that its compiled module depends on, and of `checked`.

    These are the model (mechanism, names, defaults and inputs, which the fingerprint in the manifest covers), this
    package's own sources, SymPy, the compiler and its flags. The library has its own key, made from its sources and the
    compiler, so that models with the same sources share it.
    """
    return cache_key(fingerprint(described(model)), checked=checked)
