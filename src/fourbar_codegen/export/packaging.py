"""Models for programs without Python: C libraries and FMUs."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

from fourbar_codegen.building.toolchain import compile_shared, runtime_headers
from fourbar_codegen.errors import BuildError, ModelError, shown
from fourbar_codegen.interface.arguments import is_integer, listed, one_of
from fourbar_codegen.interface.paths import path_of, replacing
from fourbar_codegen.interface.progress import Progress
from fourbar_codegen.modeling.model import Model
from fourbar_codegen.pipeline.check import warn
from fourbar_codegen.pipeline.generate import Generated, generate_derivatives, generate_kernel
from fourbar_codegen.runtime.enumerations import STEP_CONTROLLED, VECTORS
from fourbar_codegen.simulation.events import EventLike, event_row, listed_events, without_callables

__all__ = ["export_c", "export_fmu"]

PLATFORMS = {
    "x86_64-linux": ("x86_64-linux-gnu.2.17", "linux64"),
    "aarch64-linux": ("aarch64-linux-gnu.2.17", None),
    "x86_64-windows": ("x86_64-windows-gnu", "win64"),
    "x86-windows": ("x86-windows-gnu", "win32"),
    "aarch64-windows": ("aarch64-windows-gnu", None),
    "x86_64-darwin": ("x86_64-macos", "darwin64"),
    "aarch64-darwin": ("aarch64-macos", None),
}
"""Kinds of machines by their names in FMI 3: those that zig gives them, and those of FMI 2, if it has one."""

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
        Created if it does not exist; files of these names are replaced, all or none. Only ``main.c`` is left as it is,
        if there is one: the example stands for your program.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ModelError
        If the model has something that cannot be compiled, a parameter without a default, names that C cannot have, or
        initial values of dependent speeds that violate the constraints.
    BuildError
        If the folder cannot be written.

    Warns
    -----
    ModelWarning
        As for `compile_model`.

    Examples
    --------
    >>> import tempfile
    >>> import fourbar_codegen as fb
    >>> folder = fb.export_c(fb.models.four_bar(), tempfile.mkdtemp())
    >>> sorted(path.name for path in folder.iterdir())
    ['CMakeLists.txt', 'README.md', 'four_bar.c', 'four_bar.h', 'four_bar_derivatives.c',
     'four_bar_stiff.c', 'main.c', 'runtime']
    """
    folder = path_of(folder)
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        generated = generate_kernel(model, progress)
        texts = _library_files(generated, progress)
        if os.path.lexists(folder / "main.c"):
            del texts["main.c"]
        _write(texts, folder)
    warn(generated.equations.warnings, 3)
    return folder


def export_fmu(
    model: Model,
    path: str | Path,
    *,
    fmi: int = 3,
    platforms: Sequence[str] = (),
    quantities: Sequence[str] = (),
    method: str = "DOP853",
    events: EventLike | Sequence[EventLike] = (),
) -> Path:
    """Write a model as a Functional Mock-up Unit of FMI 3.0 or 2.0, for model exchange and co-simulation.

    It contains a binary for machines of this kind, and its sources. Co-simulation steps inside by `method`, projected
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
    platforms : sequence of str, optional
        Further kinds of machines that it has binaries for, such as ``x86_64-windows`` or ``aarch64-linux``: see
        `PLATFORMS`. They are compiled by zig, from the extra ``compiler``.
    quantities : sequence of str, optional
        Vectors that are outputs as well, by components such as ``momentum_x``: "momentum", "angular_momentum" and
        "spin", see `CompiledModel.momentum`.
    method : str, optional
        Of co-simulation: one with step control that `CompiledModel.ensemble` has, so Radau for stiff equations.
    events : str, `Event`, or list of these, optional
        Names of states, outputs, energies and vectors' components among the FMU's variables. They are event indicators
        of model exchange. In co-simulation of FMI 3.0 a step ends early at each of them, if the importer allows it; a
        terminal event ends the simulation.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    ModelError
        As for `export_c`, but names of states, parameters, inputs and outputs may have all characters that XML can
        have; if two variables have the same name; or if there is no such version, platform, quantity or
        method.
    BuildError
        If there is no C compiler, or no zig for other platforms; if it fails, with its output; or if the file cannot be
        written.

    Warns
    -----
    ModelWarning
        As for `compile_model`.

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
    if not is_integer(fmi) or fmi not in {2, 3}:
        raise ModelError(f"The version of FMI is 2 or 3, not {shown(fmi)}.")
    several = [_platform(), *listed(platforms, f"platforms= is a sequence of {', '.join(PLATFORMS)}")]
    folders = {name: _folder(name, fmi) for name in several}
    names = [quantity.name for quantity in VECTORS]
    wanted = listed(quantities, f"quantities= is a sequence of {', '.join(names)}")
    for each in wanted:
        one_of(each, names, "quantity")
    one_of(method, STEP_CONTROLLED, "method")
    watched = without_callables(listed_events(events), "an FMU")
    with Progress(f"fourbar_codegen: {getattr(model, 'name', '')}") as progress:
        generated = generate_kernel(model, progress)
        layout = generated.layout
        for vector in chain.from_iterable(generated.equations.quantities.values()):
            if vector.name in wanted and any(entry.is_nan for entry in vector.entries):
                raise ModelError(
                    f"The {vector.name.replace('_', ' ')} of {layout.name} is not known: it contains positions that "
                    "are not known or are relative to a point that moves, the bodies that move have no mass, or it "
                    "contains parameters that the equations of motion do not need, such as products of inertia. Name "
                    "these in Model(parameters=...)."
                )
        from fourbar_codegen.export.fmu import (
            Indicator,
            build_description,
            description,
            fmu_source,
            sources_of,
            variables_of,
            watched_variable,
        )

        variables = variables_of(layout, [_at_start(model, entry.name) for entry in layout.inputs], wanted)
        indicators = []
        for event in watched:
            reference, quantity, number = watched_variable(layout, variables, str(event.function))
            indicators.append(Indicator(reference, event_row(event, quantity, number)))
        name, main = layout.name, fmu_source(fmi, layout, method, indicators)
        files = _library_files(generated, progress, main)
        sources = {
            file: text for file, text in files.items() if file.endswith((".c", ".h", ".inc")) and file != "main.c"
        }
        sources[f"{name}_fmu.c"] = main
        progress.stage("compiling")
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            _write(sources, folder)
            binaries = {}
            for kind, own in folders.items():
                library = folder / own / f"{name}{_suffix(kind)}"
                library.parent.mkdir()
                target = None if kind == _platform() else PLATFORMS[kind][0]
                built = compile_shared(library, folder, sources_of(name), target)
                binaries[f"binaries/{own}/{built.name}"] = built.read_bytes()
        texts = {"modelDescription.xml": description(fmi, layout, variables, indicators, _version())}
        if fmi == 3:
            texts["sources/buildDescription.xml"] = build_description(name)
        texts |= {f"sources/{file}": text for file, text in sources.items()}
        contents = {file: text.encode("utf-8") for file, text in texts.items()}
        _pack(path, contents | binaries)
    warn(generated.equations.warnings, 3)
    return path


def _at_start(model: Model, name: str) -> float:
    """The value of an input's expression at t = 0; NaN without one."""
    expression = next(entry.expression for entry in model.input_entries if entry.name == name)
    if expression is None:
        return float("nan")
    import sympy as sm

    known = {symbol: parameter.value for symbol, parameter in model.parameter_symbols.items()}
    values = {symbol: sm.Float(value) for symbol, value in known.items() if value is not None}
    derived = {symbol: each.xreplace(values) for symbol, each in model.derived_parameters.items()}
    value = sm.sympify(expression).xreplace({**values, **derived}).subs(model.mechanism.time, 0)
    return float(value) if value.is_number and value.is_finite else float("nan")


def _library_files(generated: Generated, progress: Progress, main: str | None = None) -> dict[str, str]:
    """All files of a library, by their paths; for others than users of C, with what the source `main` includes."""
    from fourbar_codegen.export.c_library import library_texts

    progress.stage("printing the library")
    _, functions = generate_derivatives(generated.equations, generated.scheduled.program)
    runtime = {name: path.read_text("utf-8") for name, path in runtime_headers().items()}
    texts = library_texts(
        generated.scheduled, functions, generated.names, generated.layout, _version(), runtime, main=main
    )
    _check_initial_speeds(generated)
    return texts


def _check_initial_speeds(generated: Generated) -> None:
    """As `CompiledModel.initial_state` does, without a compiled model: a library overwrites them without a word."""
    import numpy as np

    from fourbar_codegen.analysis.initial_state import check_speeds
    from fourbar_codegen.dynamics.random_states import close

    e, initial, names = generated.equations, generated.layout.initial, generated.layout.speeds
    v = e.variables
    n_qi, n_ui = generated.layout.n_independent_coordinates, generated.layout.n_independent_speeds
    dependent = [name for name in names[n_ui:] if name in initial]
    if not dependent:
        return
    start = zip((*v.coordinates, *v.speeds), (*generated.layout.coordinates, *names), strict=True)
    point = {v.time: 0.0} | {leaf: initial.get(name, 0.0) for leaf, name in start}
    # `library_texts` has refused parameters without a default.
    defaults = [entry.default for entry in generated.layout.parameters if entry.default is not None]
    point |= zip(v.parameters, defaults, strict=True)
    point |= zip(v.inputs, e.tape.evaluate(e.inputs.default.entries, point), strict=True)
    if close(e.tape, e.positions.constraints.entries, v.coordinates[n_qi:], point):
        bias = np.array(e.tape.evaluate(e.velocities.bias.entries, point))
        jacobian = np.reshape(e.tape.evaluate(e.velocities.jacobian.entries, point), e.velocities.jacobian.shape)
        check_speeds(jacobian, bias, names, np.array([point[leaf] for leaf in v.speeds]), n_ui, dependent)


def _version() -> str:
    from importlib.metadata import version

    return version("fourbar_codegen")


def _platform() -> str:
    """The kind of this machine, as FMI 3 names it."""
    names = {"AMD64": "x86_64", "arm64": "aarch64", "i386": "x86", "i686": "x86"}
    machine = names.get(platform.machine(), platform.machine())
    return f"{machine}-{({'win32': 'windows', 'darwin': 'darwin'}).get(sys.platform, 'linux')}"


def _folder(kind: str, fmi: int) -> str:
    """The folder of a kind of machine in an FMU."""
    own = kind == _platform()
    if kind not in PLATFORMS and not own:
        raise ModelError(f"FMUs can have binaries for {', '.join(PLATFORMS)}, not for {shown(kind)}.")
    if fmi == 3:
        return kind
    name = PLATFORMS.get(kind, ("", None))[1]
    if name is None and not own:
        raise ModelError(f"FMI 2.0 has no name for {kind}: use fmi=3.")
    return name or kind


def _suffix(kind: str) -> str:
    """Of a shared library."""
    return {"windows": ".dll", "darwin": ".dylib"}.get(kind.rpartition("-")[2], ".so")


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
