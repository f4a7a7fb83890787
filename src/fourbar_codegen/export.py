"""Models for programs without Python: C libraries."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from fourbar_codegen.building.toolchain import get_include
from fourbar_codegen.compile import generate_derivatives, generate_kernel
from fourbar_codegen.errors import BuildError
from fourbar_codegen.files import path_of, replacing
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.progress import Progress

__all__ = ["export_c"]


def export_c(model: Model, folder: str | Path) -> Path:
    """Write a model as a C library: C99 without memory allocation, which needs neither Python nor fourbar_codegen.

    Its functions close the loops, evaluate the equations of motion and their derivatives, and advance the mechanism by
    steps of fixed length or with step control. The header says how to call them, README.md how to build them.

    Parameters
    ----------
    model : Model
    folder : str or Path
        Created if it does not exist; files of these names are replaced, all or none.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ModelError
        If the model has something that cannot be compiled, a parameter without a default, or names that C cannot have.
    BuildError
        If the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import fourbar_codegen as fb
    >>> folder = fb.export_c(fb.models.four_bar(), tempfile.mkdtemp())
    >>> sorted(path.name for path in folder.iterdir())
    ['CMakeLists.txt', 'README.md', 'four_bar.c', 'four_bar.h', 'four_bar_derivatives.c', 'main.c', 'runtime']
    """
    folder = path_of(folder)
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        _write(_library_files(model, progress), folder)
    return folder


def _library_files(model: Model, progress: Progress) -> dict[str, str]:
    """All files of a library, by their paths."""
    generated = generate_kernel(model, progress)
    from importlib.metadata import version

    from fourbar_codegen.codegen.c_library import FOLDER, HEADERS, library_texts

    progress.stage("printing the library")
    _, functions = generate_derivatives(generated)
    own = version("fourbar_codegen")
    texts = library_texts(generated.scheduled, functions, generated.names, generated.manifest, own)
    runtime = Path(get_include())
    return texts | {f"{FOLDER}{name}": (runtime / name).read_text("utf-8") for name in HEADERS}


def _write(texts: dict[str, str], folder: Path) -> None:
    """Write files; all are written before the first is replaced."""
    try:
        with ExitStack() as stack:
            for name, text in texts.items():
                stack.enter_context(replacing(folder / name)).write(text.encode("utf-8"))
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror or error}.") from error
