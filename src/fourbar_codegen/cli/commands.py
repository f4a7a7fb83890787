"""The commands of ``fourbar``."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import fourbar_codegen as fb
from fourbar_codegen.cli.models import MODEL, MODEL_HELP, compiled_model, source_model
from fourbar_codegen.cli.options import (
    MAX_MEMBERS,
    PAGE_OPTIONS,
    RUN_OPTIONS,
    SWEEP_OPTIONS,
    initial_state,
    input_sources,
    number,
    with_options,
)
from fourbar_codegen.errors import INTERRUPTED
from fourbar_codegen.interface.paths import write_whole
from fourbar_codegen.interface.progress import QUIET_SECONDS, Progress

if TYPE_CHECKING:
    from fourbar_codegen import CompiledModel, Ensemble, Trajectory

__all__ = ["main"]

FORMS = {
    "dense": "the mass matrix is formed and factored",
    "sparse": "the mass matrix and the constraints are factored in a sparse elimination order",
    "recursive": "solved body by body, without forming the mass matrix",
}
"""How accelerations are found."""


class _Command(click.Command):
    """Explains -t if it is given only one number."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except click.BadOptionUsage as error:
            if error.option_name not in {"-t", "--time"}:
                raise
            message = f"{error.message} Give the first and the last time in s: -t 0 4."
            raise click.BadOptionUsage(error.option_name, message, ctx) from error


class _Commands(click.Group):
    """Prints the package's errors without traceback."""

    command_class = _Command

    def invoke(self, ctx: click.Context) -> Any:
        try:
            with warnings.catch_warnings():
                warnings.showwarning = lambda message, *_, **__: click.echo(f"Warning: {message}", err=True)
                return super().invoke(ctx)
        except fb.FourbarError as error:
            raise click.ClickException(str(error)) from error
        except KeyboardInterrupt:  # which click would announce by an empty line
            click.echo("Interrupted.", err=True)
            raise click.exceptions.Exit(INTERRUPTED) from None


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="fourbar_codegen", prog_name="fourbar")
def main() -> None:
    """Compile SymPy mechanisms to C and simulate them with their loops closed."""


def _help(what: str, *examples: str) -> str:
    """The help text of a command: description, examples and available models."""
    return "\n\n".join([what, "\b\nExamples:\n" + "\n".join(f"  fourbar {e}" for e in examples), MODEL_HELP])


def _model_and_inputs(
    model: str,
    initial: dict[str, str],
    inputs: dict[str, str],
    parameters: Mapping[str, Any],
    t_span: tuple[float, float],
) -> tuple[CompiledModel, dict[str, float], dict[str, Any]]:
    """The compiled model, initial values and sources of inputs, including inputs that were given with --initial."""
    if not all(map(math.isfinite, t_span)):
        raise fb.ModelError(f"The first and last time must be finite, not {t_span}.")
    compiled = compiled_model(model)
    for name in parameters:
        for option, kind, others in (("-r", "an input", compiled.inputs), ("-i", "a state", compiled.states)):
            if name in others:
                raise fb.ModelError(f"{name} is {kind}, not a parameter: give it with {option}.")
    by_initial = {name: text for name, text in initial.items() if name in compiled.inputs}
    twice = sorted(by_initial.keys() & inputs.keys())
    if twice:
        raise fb.ModelError(f"{twice[0]} is given twice, with -i and with -r.")
    values = {name: number(name, text) for name, text in initial.items() if name not in by_initial}
    return compiled, values, input_sources(compiled, inputs | by_initial, parameters, t_span[0])


def _simulated(
    times: Callable[[float, float], Any],
    *,
    model: str,
    parameters: dict[str, float],
    initial: dict[str, str],
    inputs: dict[str, str],
    t_span: tuple[float, float],
    **how: Any,
) -> tuple[Trajectory, float]:
    """A run, with states at the times that a function of the time span returns, and its computing time in s."""
    compiled, values, sources = _model_and_inputs(model, initial, inputs, parameters, t_span)
    x0 = initial_state(compiled, values, t_span[0], parameters, sources)
    begin = time.perf_counter()
    trajectory = compiled.simulate(t_span, x0, parameters=parameters, inputs=sources, t_eval=times(*t_span), **how)
    return trajectory, time.perf_counter() - begin


@main.command(
    help=_help(
        "Simulate a model and write its trajectory to files.",
        "simulate four_bar -t 0 4 -p l2=0.45 -i q1=-0.6 -o run.csv -o run.png",
        'simulate four_bar -r "F=50*sin(2*pi*t)" --rtol 1e-9',
        "simulate my_model.py:make_model -o run.html",
    )
)
@with_options(RUN_OPTIONS)
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

    from fourbar_codegen.files.save import require_format

    for path in outputs:
        require_format(path, "trajectory")
    trajectory, seconds = _simulated(lambda start, end: np.linspace(start, end, samples), **run)
    _report(trajectory, run["method"], seconds)
    for path in outputs:
        click.echo(f"Written: {trajectory.save(path)}")
    _check_end(trajectory)


@main.command(
    help=_help(
        "Simulate a model for ranges of its parameters, on all cores, and write all runs to files.",
        "sweep four_bar -p k=50:150:101 -o sweep.csv -o sweep.png",
        "sweep four_bar -p l2=0.45,0.5,0.55 -p c=0:10:11 -t 0 2 -o sweep.nc",
    )
)
@with_options(SWEEP_OPTIONS)
@click.option("--samples", type=click.IntRange(min=2, max=1_000_000), default=201, show_default=True,
              help="Number of equally spaced times to store.")  # fmt: skip
@click.option(
    "-o", "--output", "outputs", multiple=True, type=click.Path(dir_okay=False, path_type=Path),
    help="Write the runs: .csv, .npz, .nc, or .png for a plot; may be repeated.",
)  # fmt: skip
@click.option("--plot", "plotted", multiple=True, metavar="NAME",
              help="What a .png shows: a state, input or output, energy, lambda1, ...; may be repeated.")  # fmt: skip
def sweep(
    *,
    samples: int,
    outputs: tuple[Path, ...],
    plotted: tuple[str, ...],
    model: str,
    parameters: dict[str, Any],
    initial: dict[str, str],
    inputs: dict[str, str],
    t_span: tuple[float, float],
    **how: Any,
) -> None:
    import numpy as np

    from fourbar_codegen.files.save import require_format

    for path in outputs:
        require_format(path, "ensemble")
    if plotted and not any(path.suffix.lower() == ".png" for path in outputs):
        raise fb.ModelError("--plot says what a .png shows: give one, such as -o sweep.png.")
    swept = {name: values for name, values in parameters.items() if hasattr(values, "shape")}
    if not swept:
        raise fb.ModelError("There is nothing to sweep: give a parameter a range, such as -p NAME=FIRST:LAST:N.")
    n = math.prod(map(len, swept.values()))
    if n > MAX_MEMBERS:
        raise fb.ModelError(f"A sweep has at most {MAX_MEMBERS} runs, not {n}.")
    compiled, values, sources = _model_and_inputs(model, initial, inputs, parameters, t_span)
    _check_plotted(compiled, plotted)
    grid = np.array(list(itertools.product(*swept.values())))
    members = [parameters | dict(zip(swept, row.tolist(), strict=True)) for row in grid]
    x0 = np.full((n, compiled.n_x), np.nan)
    failures = {}
    with Progress(compiled.name, unwatched=QUIET_SECONDS) as progress:
        for place, member in enumerate(members):
            progress.stage(f"initial state {place + 1} of {n}")
            try:
                x0[place] = initial_state(compiled, values, t_span[0], member, sources)
            except fb.AssemblyError as error:
                failures[place] = str(error)
    assembled = np.array([place for place in range(n) if place not in failures], dtype=int)
    begin = time.perf_counter()
    ran = compiled.ensemble(
        t_span, x0[assembled], parameters=parameters | dict(zip(swept, grid[assembled].T, strict=True)),
        inputs=sources, t_eval=np.linspace(*t_span, samples), **how,
    )  # fmt: skip
    p = np.array([[member.get(name, default) for name, default in compiled.defaults.items()] for member in members])
    ensemble = _with_others(ran, assembled, p, failures)
    _report_sweep(ensemble, swept, how["method"], time.perf_counter() - begin)
    failures |= {int(place): ensemble.messages[place] for place in np.flatnonzero(~ensemble.success)}
    for path in sorted(outputs, key=lambda path: path.suffix.lower() == ".png"):  # data first
        click.echo(f"Written: {_save_sweep(ensemble, path, plotted)}")
    if failures:
        first = min(failures)
        at = ", ".join(f"{name} = {members[first][name]:g}" for name in swept)
        raise fb.SimulationError(f"{len(failures)} of {n} runs failed, the first of them at {at}: {failures[first]}")


def _with_others(ran: Ensemble, places: Any, parameters: Any, failures: Mapping[int, str]) -> Ensemble:
    """An ensemble with the members that could not be assembled, as failed ones, at their places."""
    import numpy as np

    n = len(parameters)
    y, status, nfev = np.full((n, *ran.y.shape[1:]), np.nan), np.full(n, -1), np.zeros(n, dtype=int)
    y[places], status[places], nfev[places] = ran.y, ran.status, ran.nfev
    messages = {**failures, **dict(zip(places.tolist(), ran.messages, strict=True))}
    return replace(ran, y=y, status=status, nfev=nfev, parameters=parameters,
                   messages=tuple(messages[place] for place in range(n)))  # fmt: skip


def _check_plotted(model: CompiledModel, names: tuple[str, ...]) -> None:
    """Raise an error, before anything is computed, if a name is no quantity over time that a plot can show."""
    import numpy as np

    from fourbar_codegen.results.trajectory import Trajectory

    y, r = np.zeros((model.n_x, 0)), np.zeros((model.n_r, 0))
    nothing = Trajectory(model.kernel, None, np.zeros(0), y, r, settings={}, inputs=None, status=0, message="")
    for name in names:
        if nothing[name].ndim != 1:
            raise fb.ModelError(f"--plot shows scalar quantities over time; {name} has three components.")


def _save_sweep(ensemble: Ensemble, path: Path, plotted: tuple[str, ...]) -> Path:
    """Write an ensemble; a plot of what was named."""
    if path.suffix.lower() != ".png":
        return ensemble.save(path)
    figure = ensemble.plot(plotted)
    return write_whole(path, lambda file: figure.savefig(file, dpi=120))


def _report_sweep(ensemble: Ensemble, swept: Mapping[str, Any], method: str, seconds: float) -> None:
    import numpy as np

    model, (first, last) = ensemble.model, (ensemble.t[0], ensemble.t[-1])
    click.echo(f"Model {model.name}, {method}, from t = {first:g} s to t = {last:g} s")
    for name, values in swept.items():
        click.echo(f"  {name} = {min(values):g} ... {max(values):g} {model.units[name]}, {len(values)} values")
    done = ensemble.y[ensemble.success, :, -1]
    if len(done):
        click.echo(f"\nState at t = {last:g} s     least           median         greatest")
        for name, column in zip(model.states, done.T, strict=True):
            cells = "".join(f"{value:>17.10f}" for value in (column.min(), np.median(column), column.max()))
            click.echo(f"  {name:<8}{cells}")
    nfev = int(ensemble.nfev.sum())
    click.echo(f"\n{len(ensemble)} runs, {nfev} evaluations of the right-hand side, {seconds * 1e3:.2f} ms")


def _output(default: str, text: str) -> Callable[..., Any]:
    """The option of the file to write."""
    kind = click.Path(dir_okay=False, path_type=Path)
    return click.option("-o", "--output", type=kind, default=Path(default), show_default=True, help=text)


@main.command(
    help=_help(
        "Simulate a model and write an interactive report: the moving mechanism, plots and a table, in one HTML file "
        "that needs no network.",
        "report four_bar -o report.html",
        "report my_model.py:make_model -t 0 10",
    )
)
@with_options(RUN_OPTIONS)
@_output("report.html", "The file, .html.")
def report(output: Path, **run: Any) -> None:
    _show(output, (".html",), run)


@main.command(
    help=_help(
        "Write a live page: one HTML file in which the mechanism is simulated anew while a slider moves. It needs no "
        "network; making it needs the extra page.",
        "page four_bar -o page.html",
        "page my_model.py:make_model -t 0 10 -r F=0",
    )
)
@with_options(PAGE_OPTIONS)
@click.option("--event", "events", multiple=True, metavar="NAME",
              help="A quantity, such as a state or output, whose changes of sign are marked; repeatable.")  # fmt: skip
@_output("page.html", "The file, .html.")
def page(
    output: Path,
    model: str,
    *,
    parameters: dict[str, float],
    initial: dict[str, str],
    inputs: dict[str, str],
    t_span: tuple[float, float],
    method: str,
    events: tuple[str, ...],
) -> None:
    compiled, values, sources = _model_and_inputs(model, initial, inputs, parameters, t_span)
    x0 = initial_state(compiled, values, t_span[0], parameters, sources)
    compiled.page(output, t_span=t_span, x0=x0, parameters=parameters, inputs=sources, method=method, events=events)
    click.echo(f"Written: {output}")


@main.command(
    help=_help(
        "Simulate a model and write an animation: .gif, or .mp4 with FFmpeg.",
        "animate four_bar -o four_bar.gif",
        "animate whipple_bicycle -i u6=-15 -t 0 2 -o bicycle.mp4",
    )
)
@with_options(RUN_OPTIONS)
@_output("animation.gif", "The file, .gif or .mp4.")
def animate(output: Path, **run: Any) -> None:
    _show(output, (".gif", ".mp4"), run)


def _show(output: Path, suffixes: tuple[str, ...], run: dict[str, Any]) -> None:
    """Simulate with a state for each frame, and write the file."""
    from fourbar_codegen.files.save import require_format
    from fourbar_codegen.views.html_page import frame_times

    if output.suffix.lower() not in suffixes:
        raise fb.ModelError(
            f"{output} must end with {' or '.join(suffixes)}: fourbar animate writes animations, report HTML pages, "
            "simulate data."
        )
    require_format(output, "trajectory")
    trajectory, _ = _simulated(frame_times, **run)
    click.echo(f"Written: {trajectory.save(output)}")
    _check_end(trajectory)


def _check_end(trajectory: Trajectory) -> None:
    if not trajectory.success:
        raise fb.SimulationError(trajectory.message)


def _report(trajectory: Trajectory, method: str, seconds: float) -> None:
    model = trajectory.kernel
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
    if model.layout.potential_energy.is_known:
        label, energy = model.title("energy").replace("e", "E", 1), trajectory.energy
        click.echo(f"{label}: {energy[0]:.6f} J at the start, {energy[-1]:.6f} J at the end")


@main.command(
    help=_help("Write a model's generated C and Cython sources to OUTPUT/NAME.", "generate four_bar -o generated")
)
@MODEL
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("generated"),
    show_default=True,
    help="The folder of the model is created in this folder.",
)
def generate(model: str, output: Path) -> None:
    from fourbar_codegen.building.toolchain import write_sources

    source = source_model(model)
    folder = output / source.name
    texts = fb.generate_sources(source)
    write_sources(source.name, texts, folder)
    for name in texts:
        click.echo(f"Written: {folder / name}")


@main.command(
    help=_help(
        "Compile a model to an extension module in OUTPUT, for fourbar_codegen.load or for use with NumPy alone.",
        "build my_model.py:make_model -o build",
        "build my_model.py:make_model --wheel -o dist",
    )
)
@MODEL
@click.option(
    "-o",
    "--output",
    type=click.Path(file_okay=False, path_type=Path),
    default=Path("build"),
    show_default=True,
    help="The folder of the model, or the wheel, is created in this folder.",
)
@click.option("--wheel", is_flag=True, help="Build a wheel, which can be installed without SymPy or a compiler.")
@click.option("--version", default="0.1.0", show_default=True, help="Version of the wheel.")
def build(model: str, output: Path, wheel: bool, version: str) -> None:
    source = source_model(model)
    begin = time.perf_counter()
    made = fb.build_wheel(source, output, version=version) if wheel else fb.build_model(source, output / source.name)
    click.echo(f"Built in {time.perf_counter() - begin:.1f} s: {made}")


@main.command(
    help=_help(
        "Write a model for programs without Python: as a C library, or as an FMU for simulators of systems.",
        "export four_bar --to c -o four_bar_c",
        "export four_bar --to fmu -o four_bar.fmu",
    )
)
@MODEL
@click.option(
    "--to",
    "form",
    type=click.Choice(["c", "fmu"]),
    required=True,
    help="c: a folder with a C library; fmu: a Functional Mock-up Unit.",
)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The folder, or the file.")
@click.option("--fmi", type=click.Choice(["3", "2"]), help="The version of FMI, 3.0 by default.")
@click.option(
    "--platform",
    multiple=True,
    help="Another kind of machine that an FMU has a binary for, such as x86_64-windows; by zig. Repeatable.",
)
@click.option(
    "--quantity",
    multiple=True,
    help="A vector that an FMU has as outputs: momentum, angular_momentum, spin. Repeatable.",
)
@click.option(
    "--event", multiple=True, help="A state, output or energy whose changes of sign an FMU tells. Repeatable."
)
def export(model: str, form: str, output: Path, **of_fmu: Any) -> None:
    if form == "fmu":
        fmi, platform, quantity, event = (of_fmu[name] for name in ("fmi", "platform", "quantity", "event"))
        path = fb.export_fmu(
            source_model(model), output, fmi=int(fmi or 3), platforms=platform, quantities=quantity, events=event
        )
        click.echo(f"Written: {path}")
        return
    given = [name for name, value in of_fmu.items() if value]
    if given:
        raise click.UsageError(f"--{given[0]} belongs to --to fmu.")
    folder = fb.export_c(source_model(model), output)
    click.echo(f"Written: {folder / 'README.md'} says how to build it")


@main.command(
    help=_help("Show a model's names, defaults, sizes and operation counts.", "info four_bar", "info slider_crank")
)
@MODEL
def info(model: str) -> None:
    from fourbar_codegen.building.cache import cache_folder
    from fourbar_codegen.building.compiler import INSTALL, find_compiler

    compiled = compiled_model(model)
    layout = compiled.layout
    click.echo(f"Model {compiled.name}")
    for kind, names, dependent in (
        ("coordinates", compiled.coordinates, layout.n_dependent_coordinates),
        ("speeds", compiled.speeds, layout.n_dependent_speeds),
    ):
        split = len(names) - dependent
        click.echo(f"{kind}: {', '.join(names[:split])} independent; {', '.join(names[split:]) or 'none'} dependent")
    if compiled.auxiliary_states:
        click.echo(f"auxiliary states: {', '.join(compiled.auxiliary_states)}")
    click.echo(f"constraints: {compiled.n_h} on positions, {compiled.n_c} on velocities")
    click.echo(f"equations: {layout.form}, {FORMS[layout.form]}")
    click.echo("parameters:")
    for parameter in layout.parameters:
        value = "no default" if parameter.default is None else f"{parameter.default:g}"
        click.echo(f"  {parameter.name:<8} {value:>10} {parameter.unit:<10} {parameter.description}".rstrip())
    click.echo("inputs:")
    for entry in layout.inputs:
        click.echo(f"  {entry.name:<8} {entry.expression or 'no expression'}")
    driving = compiled.outputs[: compiled.n_l - compiled.n_c]
    if driving:
        click.echo(f"unknown forces that drive the motion: {', '.join(driving)}")
    if compiled.outputs:
        click.echo(f"outputs: {', '.join(compiled.outputs)}")
    click.echo("operations (written out in full):")
    for function, count in layout.operations.counts.items():
        click.echo(f"  {function:<22} {count:>7} ({layout.operations.before_sharing[function]:.4g})")
    click.echo(f"instructions: {compiled.instructions}")
    compared = f"at {layout.compared} states" if compiled.is_verified else "not"
    click.echo(f"compared with the equations: {compared}")
    compiler = find_compiler()
    click.echo(f"C compiler: {compiler}{'' if compiler.origin else f'. {INSTALL}'}")
    click.echo(f"cache of compiled models: {cache_folder()}")


@main.command()
@click.option("--clear", is_flag=True, help="Remove the entries. Loaded models continue to work.")
@click.option(
    "--older-than", type=click.FloatRange(min=0.0), metavar="DAYS", help="Only entries unused for this number of days."
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
        click.echo(f"size limit {folder.size_limit() / 1e6:g} MB; {folder.SIZE_LIMIT} sets another one")
