"""Models for programs without Python: C libraries and FMUs."""

from __future__ import annotations

import platform
import sys
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path

from fourbar_codegen.building.toolchain import compile_shared, get_include
from fourbar_codegen.compile import Generated, generate_derivatives, generate_kernel
from fourbar_codegen.errors import BuildError, ModelError, shown
from fourbar_codegen.files import path_of, replacing
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.progress import Progress

__all__ = ["export_c", "export_fmu"]

LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""The time of all files in an FMU, so that the same model makes the same FMU."""


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
    ['CMakeLists.txt', 'README.md', 'four_bar.c', 'four_bar.h', 'four_bar_derivatives.c',
     'main.c', 'runtime']
    """
    folder = path_of(folder)
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        _write(_library_files(generate_kernel(model, progress), progress), folder)
    return folder


def export_fmu(model: Model, path: str | Path, *, fmi: int = 3) -> Path:
    """Write a model as a Functional Mock-up Unit of FMI 3.0 or 2.0, for model exchange and co-simulation.

    It contains a binary for machines of this kind, and its sources. Co-simulation steps inside by DOP853, projected
    onto the constraints; in model exchange the importer integrates, and the FMU asks for an event when the constraints
    are violated, at which it projects. The loops are closed at the end of the initialization: start values of dependent
    coordinates are guesses. Inputs with an expression of time follow it until they are set.

    Parameters
    ----------
    model : Model
    path : str or Path
        The file, such as ``four_bar.fmu``; replaced if it exists.
    fmi : {3, 2}, optional
        The version of FMI.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        As for `export_c`; if two variables have the same name; if the speed of a prescribed motion jumps; or if there
        is no such version.
    BuildError
        If there is no C compiler, or it fails, with its output; or the file cannot be written.

    Source: Modelica Association, Functional Mock-up Interface, versions 2.0.5 and 3.0.2, https://fmi-standard.org.

    Examples
    --------
    >>> import tempfile, zipfile
    >>> import fourbar_codegen as fb
    >>> fmu = fb.export_fmu(fb.models.four_bar(), tempfile.mkdtemp() + "/four_bar.fmu")
    >>> sorted({name.split("/")[0] for name in zipfile.ZipFile(fmu).namelist()})
    ['binaries', 'modelDescription.xml', 'sources']
    """
    path = path_of(path)
    if fmi not in {2, 3}:
        raise ModelError(f"The version of FMI is 2 or 3, not {shown(fmi)}.")
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        generated = generate_kernel(model, progress)
        manifest = generated.manifest
        if manifest["n_jumps"]:
            raise ModelError("The speed of a prescribed motion jumps, and an FMU cannot make the speeds jump with it.")
        from fourbar_codegen.codegen.fmu import (
            FMU_HEADERS,
            build_description,
            description,
            fmu_source,
            sources_of,
            variables_of,
        )

        variables = variables_of(manifest, [_at_start(model, entry["name"]) for entry in manifest["inputs"]])
        name = manifest["name"]
        files = _library_files(generated, progress, FMU_HEADERS)
        sources = {file: text for file, text in files.items() if file.endswith((".c", ".h")) and file != "main.c"}
        sources[f"{name}_fmu.c"] = fmu_source(fmi, manifest)
        progress.stage("compiling")
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            _write(sources, folder)
            binary = compile_shared(folder / f"{name}{_suffix()}", folder, sources_of(name)).read_bytes()
        texts = {"modelDescription.xml": description(fmi, manifest, variables, _version())}
        if fmi == 3:
            texts["sources/buildDescription.xml"] = build_description(name)
        texts |= {f"sources/{file}": text for file, text in sources.items()}
        contents = {file: text.encode("utf-8") for file, text in texts.items()}
        _pack(path, contents | {f"binaries/{_platform(fmi)}/{name}{_suffix()}": binary})
    return path


def _at_start(model: Model, name: str) -> float:
    """The value of an input's expression at t = 0; NaN without one."""
    expression = next(entry.expression for entry in model.input_entries if entry.name == name)
    if expression is None:
        return float("nan")
    values = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    derived = {symbol: each.xreplace(values) for symbol, each in model.derived_parameters.items()}
    value = expression.xreplace({**values, **derived}).subs(model.mechanism.time, 0)
    return float(value) if value.is_number and value.is_finite else float("nan")


def _library_files(generated: Generated, progress: Progress, more: tuple[str, ...] = ()) -> dict[str, str]:
    """All files of a library, by their paths, with further headers."""
    from fourbar_codegen.codegen.c_library import FOLDER, HEADERS, library_texts

    progress.stage("printing the library")
    _, functions = generate_derivatives(generated)
    texts = library_texts(generated.scheduled, functions, generated.names, generated.manifest, _version())
    runtime = Path(get_include())
    return texts | {f"{FOLDER}{name}": (runtime / name).read_text("utf-8") for name in (*HEADERS, *more)}


def _version() -> str:
    from importlib.metadata import version

    return version("fourbar_codegen")


def _platform(fmi: int) -> str:
    """The folder of this kind of machine in an FMU."""
    machine = {"AMD64": "x86_64", "arm64": "aarch64", "i386": "x86", "i686": "x86"}.get(
        platform.machine(), platform.machine()
    )
    system = {"win32": "windows", "darwin": "darwin"}.get(sys.platform, "linux")
    if fmi == 2:
        return f"{system.replace('windows', 'win')}{'64' if sys.maxsize > 2**32 else '32'}"
    return f"{machine}-{system}"


def _suffix() -> str:
    """Of a shared library."""
    return {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")


def _pack(path: Path, contents: dict[str, bytes]) -> None:
    """Write a zip file."""
    try:
        with replacing(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in contents.items():
                archive.writestr(zipfile.ZipInfo(name, LONG_AGO), content, zipfile.ZIP_DEFLATED)
    except OSError as error:
        raise BuildError(f"{path} cannot be written: {error.strerror or error}.") from error


def _write(texts: dict[str, str], folder: Path) -> None:
    """Write files; all are written before the first is replaced."""
    try:
        with ExitStack() as stack:
            for name, text in texts.items():
                stack.enter_context(replacing(folder / name)).write(text.encode("utf-8"))
    except OSError as error:
        raise BuildError(f"{folder} cannot be written: {error.strerror or error}.") from error
