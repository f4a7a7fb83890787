"""The command line ``fourbar``."""

from __future__ import annotations

import importlib
import importlib.util
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

import fourbar_codegen as fb

if TYPE_CHECKING:
    from fourbar_codegen import CompiledModel, Model, Trajectory

__all__ = ["main"]

MODEL_HELP = (
    "MODEL is the name of a model that comes with the package (four_bar is compiled already), or FILE.py:FUNCTION or "
    "MODULE:FUNCTION, a function without arguments that returns a Model."
)

METHODS = ("DOP853", "RK45", "ALI3P", "RK23", "Radau", "BDF", "LSODA", "CVODE", "IDA")


class _ModelName(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions alone
    """A model's name, or a file with a function that makes one."""

    name = "model"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002  # click's
        """The names of the package's models, read from its files, and files."""
        files = (Path(__file__).parent / "models").glob("[a-z]*.py")
        names = sorted(file.stem for file in files if file.stem.startswith(incomplete))
        return [*map(CompletionItem, names)] or [CompletionItem(incomplete, type="file")]


_MODEL = click.argument("model", default="four_bar", type=_ModelName())


class _Commands(click.Group):
    """Prints the package's errors in a line instead of a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except fb.FourbarError as error:
            raise click.ClickException(str(error)) from error


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fourbar_codegen", prog_name="fourbar")
def main() -> None:
    """Compile SymPy mechanisms to C and simulate them with their loops closed."""


def _pairs(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> dict[str, float]:
    """NAME=VALUE options as a dictionary."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        try:
            pairs[name.strip()] = float(value)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise click.BadParameter(f"{text!r} is not NAME=VALUE with a number, such as NAME=0.45.")
    return pairs


def _steps(_: click.Context, __: click.Parameter, text: str) -> int | str | None:
    """A number of steps, the method's own, or no limit."""
    if text == "none":
        return None
    return int(text) if text.isdecimal() else text


_RUN_OPTIONS = [
    _MODEL,
    click.option(
        "-p", "--parameter", "parameters", multiple=True, callback=_pairs, metavar="NAME=VALUE",
        help="Override a parameter; may be repeated.",
    ),
    click.option(
        "-i", "--initial", multiple=True, callback=_pairs, metavar="NAME=VALUE",
        help="Initial value of an independent coordinate or speed or an auxiliary state, or guess of a dependent "
        "coordinate; repeatable.",
    ),
    click.option(
        "-r", "--input", "inputs", multiple=True, callback=_pairs, metavar="NAME=VALUE",
        help="Hold an input at a number instead of its expression; may be repeated.",
    ),
    click.option(
        "-t", "--time", "t_span", nargs=2, type=float, default=(0.0, 4.0), show_default=True,
        help="First and last time, s.",
    ),
    click.option("--method", type=click.Choice(METHODS), default="DOP853", show_default=True),
    click.option(
        "--formulation", type=click.Choice(["gear-gupta-leimkuhler", "index-1", "index-3"]),
        help="Of IDA; its default is the first.",
    ),
    click.option(
        "--constraints", type=click.Choice(["project", "baumgarte", "none"]), default="project", show_default=True,
        help="How to keep loops closed: project moves each state onto the constraints.",
    ),
    click.option("--rtol", default=1e-6, show_default=True, help="Relative tolerance."),
    click.option("--atol", default=1e-9, show_default=True, help="Absolute tolerance."),
    click.option("--max-step", default=math.inf, help="Longest step, s; ALI3P needs it."),
    click.option(
        "--max-steps", default="auto", show_default=True, metavar="N|auto|none", callback=_steps,
        help="Most steps: by default 1,000,000 of methods in C, 100,000 of others, ten times what --max-step asks for.",
    ),
]  # fmt: skip


def _run_options(command: Callable[..., None]) -> Callable[..., None]:
    """The model and what says how it is to be simulated, for `_simulated`."""
    for option in reversed(_RUN_OPTIONS):
        command = option(command)
    return command


def _simulated(
    times: Callable[[float, float], Any],
    *,
    model: str,
    parameters: dict[str, float],
    initial: dict[str, float],
    inputs: dict[str, float],
    t_span: tuple[float, float],
    **how: Any,
) -> tuple[Trajectory, float]:
    """A run, its states at the times that a function of its span gives, and the seconds that it took."""
    if not all(map(math.isfinite, t_span)):
        raise fb.ModelError(f"The first and last time must be finite, not {t_span}.")
    compiled = _compiled(model)
    x0 = _initial_state(compiled, initial, t_span[0], parameters)
    begin = time.perf_counter()
    trajectory = compiled.simulate(t_span, x0, parameters=parameters, inputs=inputs, t_eval=times(*t_span), **how)
    return trajectory, time.perf_counter() - begin


@main.command(help="Simulate a model and write its trajectory to files.\n\n" + MODEL_HELP)
@_run_options
@click.option(
    "--samples",
    type=click.IntRange(min=2, max=10_000_000),
    default=401,
    show_default=True,
    help="Number of equally spaced times to store.",
)
@click.option(
    "-o",
    "--output",
    "outputs",
    multiple=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the trajectory: .csv, .npz, .nc, .html for a report, .png for a plot, .gif or .mp4; may be repeated.",
)
def simulate(samples: int, outputs: tuple[Path, ...], **run: Any) -> None:
    import numpy as np

    from fourbar_codegen.results.trajectory import check_suffix

    for path in outputs:
        check_suffix(path)
    trajectory, seconds = _simulated(lambda start, end: np.linspace(start, end, samples), **run)
    _report(trajectory, run["method"], seconds)
    for path in outputs:
        click.echo(f"Written: {trajectory.save(path)}")
    _check_end(trajectory)


@main.command(
    help="Simulate a model and write an interactive report: the moving mechanism, plots and a table, in one HTML file "
    "that needs no network.\n\n" + MODEL_HELP
)
@_run_options
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), default=Path("report.html"), show_default=True,
    help="The file, .html.",
)  # fmt: skip
def report(output: Path, **run: Any) -> None:
    _show(output, (".html",), run)


@main.command(help="Simulate a model and write an animation: .gif, or .mp4 with FFmpeg.\n\n" + MODEL_HELP)
@_run_options
@click.option(
    "-o", "--output", type=click.Path(dir_okay=False, path_type=Path), default=Path("animation.gif"), show_default=True,
    help="The file, .gif or .mp4.",
)  # fmt: skip
def animate(output: Path, **run: Any) -> None:
    _show(output, (".gif", ".mp4"), run)


def _show(output: Path, suffixes: tuple[str, ...], run: dict[str, Any]) -> None:
    """Simulate with a state for each frame, and write these."""
    from fourbar_codegen.presentation.report import frame_times

    if output.suffix.lower() not in suffixes:
        raise fb.ModelError(
            f"{output} must end with {' or '.join(suffixes)}. fourbar animate writes films, report pages, simulate "
            "data."
        )
    trajectory, _ = _simulated(frame_times, **run)
    click.echo(f"Written: {trajectory.save(output)}")
    _check_end(trajectory)


def _check_end(trajectory: Trajectory) -> None:
    if not trajectory.success:
        raise fb.SimulationError(trajectory.message)


def _initial_state(compiled: CompiledModel, initial: dict[str, float], t: float, parameters: dict[str, float]) -> Any:
    """Values by name, handed to the argument that takes them."""
    n_qi = compiled.n_q - compiled.manifest["n_dependent_coordinates"]
    n_ui = compiled.n_u - compiled.manifest["n_dependent_speeds"]
    groups = (
        compiled.coordinates[:n_qi],
        compiled.speeds[:n_ui],
        compiled.coordinates[n_qi:],
        compiled.auxiliary_states,
    )
    unknown = sorted(set(initial) - {name for group in groups for name in group})
    if unknown:
        raise fb.ModelError(
            f"No initial value can be given for {', '.join(unknown)}: give independent coordinates "
            f"({', '.join(groups[0])}), independent speeds ({', '.join(groups[1])}), guesses of dependent "
            f"coordinates ({', '.join(groups[2]) or 'none'}) or auxiliary states ({', '.join(groups[3]) or 'none'})."
        )
    coordinates, speeds, guess, z = ({name: initial[name] for name in group if name in initial} for group in groups)
    return compiled.initial_state(
        coordinates, speeds, t=t, guess=guess, parameters=parameters, auxiliary_states=z or None
    )


def _report(trajectory: Trajectory, method: str, seconds: float) -> None:
    model = trajectory.model
    if not len(trajectory.t):
        return
    click.echo(f"Model {model.name}, {method}, from t = {trajectory.t[0]:g} s to t = {trajectory.t[-1]:g} s")
    click.echo("\nState          initial              final")
    for name, first, last in zip(model.states, trajectory.y[:, 0], trajectory.y[:, -1], strict=True):
        click.echo(f"  {name:<8} {first:>16.10f}  {last:>16.10f}")
    click.echo(
        f"\n{len(trajectory.t)} stored times, {trajectory.nfev} evaluations of the right-hand side, "
        f"{seconds * 1e3:.2f} ms"
    )
    residuals = abs(trajectory.constraint_residual)
    if len(residuals):
        residual = residuals.max(axis=0)
        click.echo(
            f"{trajectory.residual_label}: {residual[0]:.2e} at the start, {residual[-1]:.2e} at the end, "
            f"{residual.max():.2e} at most"
        )
    if model.manifest["has_potential_energy"]:
        click.echo(f"Energy: {trajectory.energy[0]:.6f} J at the start, {trajectory.energy[-1]:.6f} J at the end")


@main.command(help="Write a model's generated C and Cython sources to OUTPUT/NAME.\n\n" + MODEL_HELP)
@_MODEL
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("generated"),
    show_default=True,
    help="Folder in which the model's folder is made.",
)
def generate(model: str, output: Path) -> None:
    from fourbar_codegen.building.toolchain import write_sources

    source = _model(model)
    folder = output / source.name
    texts = fb.generate_sources(source)
    write_sources(source.name, texts, folder)
    for name in texts:
        click.echo(f"Written: {folder / name}")


@main.command(
    help="Compile a model to an extension module in OUTPUT, for fourbar_codegen.load or for use with NumPy alone.\n\n"
    + MODEL_HELP
)
@_MODEL
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("build"),
    show_default=True,
    help="Folder in which the model's folder, or the wheel, is made.",
)
@click.option("--wheel", is_flag=True, help="Make a wheel, to be installed without SymPy or a compiler.")
@click.option("--version", default="0.1.0", show_default=True, help="Version of the wheel.")
def build(model: str, output: Path, wheel: bool, version: str) -> None:
    source = _model(model)
    begin = time.perf_counter()
    made = fb.build_wheel(source, output, version=version) if wheel else fb.build_model(source, output / source.name)
    click.echo(f"Built in {time.perf_counter() - begin:.1f} s: {made}")


@main.command(help="Show a model's names, defaults, sizes and operation counts.\n\n" + MODEL_HELP)
@_MODEL
def info(model: str) -> None:
    from fourbar_codegen.building.cache import cache_folder
    from fourbar_codegen.building.compiler import INSTALL, find_compiler

    compiled = _compiled(model)
    manifest = compiled.manifest
    click.echo(f"Model {compiled.name}")
    for kind, names, dependent in (
        ("coordinates", compiled.coordinates, manifest["n_dependent_coordinates"]),
        ("speeds", compiled.speeds, manifest["n_dependent_speeds"]),
    ):
        split = len(names) - dependent
        click.echo(f"{kind}: {', '.join(names[:split])} independent; {', '.join(names[split:]) or 'none'} dependent")
    if compiled.auxiliary_states:
        click.echo(f"auxiliary states: {', '.join(compiled.auxiliary_states)}")
    click.echo(f"constraints: {compiled.n_h} on positions, {compiled.n_c} on velocities")
    click.echo("parameters:")
    for entry in manifest["parameters"]:
        value = "no default" if entry["default"] is None else f"{entry['default']:g}"
        click.echo(f"  {entry['name']:<8} {value:>10} {entry['unit']:<10} {entry['description']}".rstrip())
    click.echo("inputs:")
    for entry in manifest["inputs"]:
        click.echo(f"  {entry['name']:<8} {entry['expression'] or 'no expression'}")
    driving = compiled.outputs[: compiled.n_l - compiled.n_c]
    if driving:
        click.echo(f"unknown forces that drive the motion: {', '.join(driving)}")
    if compiled.outputs:
        click.echo(f"outputs: {', '.join(compiled.outputs)}")
    click.echo("operations (written out in full):")
    for function, count in manifest["operations"].items():
        click.echo(f"  {function:<22} {count:>7} ({manifest['operations_before_sharing'][function]:.4g})")
    click.echo(f"instructions: {compiled.instructions}")
    compiler = find_compiler()
    click.echo(f"C compiler: {compiler}{'' if compiler.origin else f'. {INSTALL}'}")
    click.echo(f"cache of compiled models: {cache_folder()}")


@main.command()
@click.option("--clear", is_flag=True, help="Remove what is there. Loaded models go on working.")
@click.option(
    "--older-than", type=click.FloatRange(min=0.0), metavar="DAYS", help="Only what was not used for so many days."
)
def cache(clear: bool, older_than: float | None) -> None:
    """List the compiled models in the cache, with their sizes, or remove them."""
    from fourbar_codegen.building import cache as folder

    older = 86400.0 * (older_than or 0.0)
    now = time.time()
    found = folder.clear(older) if clear else [e for e in folder.entries() if now - e.used >= older]
    for entry in found:
        click.echo(f"  {entry.name:<40} {entry.size / 1e6:9.2f} MB, used {(now - entry.used) / 86400.0:.1f} days ago")
    total = sum(entry.size for entry in found) / 1e6
    removed = " removed" if clear else ""
    click.echo(f"{len(found)} libraries and models{removed}, {total:.2f} MB, in {folder.cache_folder()}")
    if not clear:
        click.echo(f"at most {folder.size_limit() / 1e6:g} MB, or what {folder.SIZE_LIMIT} says")


def _compiled(model: str) -> CompiledModel:
    """A model that comes compiled, or one compiled now."""
    if model.endswith(".py"):
        raise fb.ModelError(f"Name the function in {model} that returns the Model: {model}:FUNCTION.")
    if ":" not in model:
        try:
            return fb.load(model)
        except fb.ModelError as error:
            if model not in fb.models.__all__:
                raise fb.ModelError(
                    f"{error} {', '.join(fb.models.__all__)} are compiled on the way, and so is what FILE.py:FUNCTION "
                    "or MODULE:FUNCTION makes."
                ) from error
    return fb.compile_model(_model(model))


def _model(text: str) -> Model:
    """The Model that MODEL names."""
    place, colon, function = text.rpartition(":")
    if not colon:
        if text not in fb.models.__all__:
            raise fb.ModelError(
                f"There is no model {text!r}; there are {', '.join(fb.models.__all__)}, and FILE.py:FUNCTION or "
                "MODULE:FUNCTION for your own."
            )
        return getattr(fb.models, text)()  # type: ignore[no-any-return]
    try:
        model = getattr(_module(place), function)()
    except fb.FourbarError:
        raise
    except Exception as error:  # it is the user's code that runs here
        raise fb.ModelError(f"{text} could not be called: {type(error).__name__}: {error}") from error
    if not isinstance(model, fb.Model):
        raise fb.ModelError(f"{text}() returned a {type(model).__name__}, not a fourbar_codegen.Model.")
    return model


def _module(place: str) -> Any:
    if not place.endswith(".py"):
        sys.path.insert(0, "")  # as for python -m
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    if spec is None or spec.loader is None:
        raise ImportError(f"{place} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
