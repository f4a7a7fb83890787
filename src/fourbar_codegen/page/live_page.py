"""A model -> a live page: one HTML file that simulates it in the browser, by its equations as WebAssembly."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.analysis.initial_state import initial_state, initial_states
from fourbar_codegen.building.loading import is_named
from fourbar_codegen.compiled_model import CompiledModel
from fourbar_codegen.errors import AssemblyError, ModelError, shown
from fourbar_codegen.files.reserved_names import check_free
from fourbar_codegen.interface.arguments import (
    Values,
    finite_number,
    is_integer,
    is_mapping,
    name_of,
    named,
    slider_range,
)
from fourbar_codegen.interface.notebook import Page
from fourbar_codegen.interface.paths import path_of, write_whole
from fourbar_codegen.kernel.inputs import by_name, is_held
from fourbar_codegen.kernel.kernel import Kernel, parameter_array
from fourbar_codegen.page.webassembly import page_module
from fourbar_codegen.runtime.enumerations import STEP_CONTROLLED, VECTORS, EventRow, Watched
from fourbar_codegen.simulation.events import EventLike, named_events
from fourbar_codegen.simulation.methods import MethodLike, name_alone
from fourbar_codegen.simulation.simulate import simulate
from fourbar_codegen.views.frames import ARROW
from fourbar_codegen.views.html_page import (
    FRAMES_PER_SECOND,
    MAX_FRAMES,
    MIN_FRAMES,
    frame_times,
    html_file,
    html_text,
    scene_data,
)
from fourbar_codegen.views.model_shapes import given_shapes
from fourbar_codegen.views.panels import ENERGY, bodies_of_curves, panel_names, vector_title
from fourbar_codegen.views.scene import Scene, known_points, scene

if TYPE_CHECKING:
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["SCRIPTS", "page"]

Floats = NDArray[np.float64]

TOLERANCE = 1e-11
"""Relative and absolute tolerance of the runs."""

SCRIPTS = (
    "views/svg_pictures.js",
    "views/solid_pictures.js",
    "page/engine.js",
    "page/settings.js",
    "page/page.js",
    "page/controls.js",
    "page/exchange.js",
)

NEARBY = 0.03
"""Relative change of lengths at which it is looked which points stay together, and whether all stay in a plane."""

SAME = 1e-6
"""Largest difference of two states of the same assembly mode."""

LARGEST = 1e300
"""Of the ends of a slider, so that their difference is finite."""

MOST_MODES = 64
"""Assembly modes that a page has; there may be a thousand."""

STATISTICS = ("greatest", "least", "greatest magnitude", "range", "mean", "last")
"""Of a quantity over a run, as in page.js."""


def page(
    compiled: CompiledModel,
    path: str | Path | None = None,
    *,
    t_span: Sequence[float] = (0.0, 4.0),
    x0: ArrayLike | None = None,
    parameters: Values | None = None,
    inputs: Mapping[Any, float | tuple[ArrayLike, ArrayLike, str]] | None = None,
    ranges: Mapping[Any, tuple[float, float]] | None = None,
    traces: Sequence[str] | None = None,
    watch: Sequence[tuple[str, str]] | None = None,
    events: EventLike | Sequence[EventLike] | None = None,
    height: int = 900,
    method: MethodLike = "DOP853",
) -> Page:
    """A live page: one HTML file in which the mechanism is simulated anew while a slider moves.

    It works offline and without Python: it contains the equations of motion, loop closure and a method with step
    control and projection, compiled to WebAssembly. Sliders change parameters, initial values, inputs and the time
    span; a link carries all settings. Scripts call ``window.fourbar.simulate``. Needs the extra ``page``, or clang
    with wasm-ld.

    Parameters
    ----------
    path : str or Path, optional
        The file to write, ``.html``.
    t_span, x0, parameters : optional
        Of the run that it begins with, as for `simulate`.
    inputs : mapping of input to float or table, optional
        What inputs begin as; by default their expressions. Tables are of the kind "hold".
    ranges : mapping of str to (float, float), optional
        Of the sliders of parameters and independent initial values. By default, for parameters `Parameter.range`,
        else from a fifth of the value to its double, or both signs if it is zero; for angles half a turn to both
        sides.
    traces : sequence of str, optional
        Names of points with a trace; by default the moving joints, or the mass centres if there are none.
    watch : sequence of (str, str), optional
        Figures of the shown frames, with their change: pairs of a statistic ("greatest", "least", "greatest
        magnitude", "range", "mean", "last") and the name of a quantity, such as ``("range", "q1")``.
    events : str, Event, or a list of these, optional
        Names of quantities, as for `simulate`: plots have marks where they change their sign, a table has the
        times, and a terminal one ends the run.
    height : int, optional
        Height in a notebook, pixels.
    method : str, optional
        Of its runs: one with step control that `ensemble` has.

    Returns
    -------
    Page
        Displayed if it is the last expression of a cell; ``text`` is the HTML.

    Raises
    ------
    ModelError
        If an argument has a wrong name or shape, a parameter has no value, an input is neither a number nor an
        expression of the model, there is nothing to draw, or the file cannot be written.
    BuildError
        If there is no compiler of WebAssembly, or it fails; with its output.
    AssemblyError, SimulationError
        As for `simulate`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> fb.load("four_bar").page(ranges={"l2": (0.3, 0.6)}, traces=["P2"])
    <Live page of four_bar, 900 pixels high>
    """
    model = compiled.kernel
    if not is_integer(height) or height < 1:
        raise ModelError(f"height must be a positive number of pixels, not {shown(height)}.")
    _check_inputs(model, inputs)
    method = name_alone(method, STEP_CONTROLLED, "method for pages")
    watched = named_events(model, events, "a page")
    file = None if path is None else path_of(path)
    if file is not None and file.suffix.lower() != ".html":
        raise ModelError(f"A live page is saved as .html; {file.name!r} ends otherwise.")
    run = simulate(
        model, t_span, x0, method=method, parameters=parameters, inputs=inputs, events=events, rtol=TOLERANCE,
        atol=TOLERANCE,
    )  # fmt: skip
    text = _text(run, {} if ranges is None else ranges, traces, watch, watched)
    if file is not None:
        write_whole(file, lambda opened: opened.write(text.encode("utf-8")))
    return Page(f"Live page of {model.name}", text, int(height))


def _check_inputs(model: Kernel, inputs: Mapping[Any, Any] | None) -> None:
    """Raise a ModelError if an input is neither a number nor a table that is held."""
    for name, source in by_name(model, inputs).items():
        if callable(source) or (isinstance(source, tuple | list) and not is_held(source)):
            kind = "callable" if callable(source) else "table that is interpolated"
            raise ModelError(
                f"Input {name_of(name)} of a page is a number, the model's own expression, or a table of the kind "
                f'"hold"; a {kind} cannot be put into a file. Give it one of these, or the Model an expression of t '
                "and parameters."
            )


def _event(name: str, row: EventRow, columns: list[str], energies: int) -> dict[str, Any]:
    """An event: its name, numbers for the engine, the column that is zero there, and its text in Python."""
    known = columns.index(name) if name in columns else -1
    column = energies + row.number if row.quantity is Watched.ENERGY else known
    quoted = json.dumps(name, ensure_ascii=False)
    words = {"terminal": row.terminal, "direction": row.direction}
    text = "".join(f", {word}={value}" for word, value in words.items() if value)
    text += "" if row.all_roots else ", all_roots=False"
    text += ", at_start=True" if row.at_start else ""
    return {
        "name": name,
        "numbers": [int(number) for number in row],
        "column": column,
        "python": f"fb.Event({quoted}{text})" if text else quoted,
    }


def _text(
    run: Trajectory,
    ranges: Mapping[Any, tuple[float, float]],
    traces: Sequence[str] | None,
    watch: Sequence[tuple[str, str]] | None,
    events: Sequence[tuple[str, EventRow]],
) -> str:
    model = run.kernel
    parameters = dict(zip(model.parameters, parameter_array(model, run.parameters).tolist(), strict=True))
    found = _scene(run)
    names = [name for _, of_panel, _ in panel_names(model) for name in of_panel]
    names += [name for vector in VECTORS for name in vector.components]
    energies = names.index("kinetic energy", model.n_x + model.n_r + model.n_o)
    check_free(model.outputs, {name for name in names if names.count(name) > 1})
    modes = _modes(run)
    guides = [shape.points for shape in model.layout.drawing.shapes if shape.kind == "slider"]
    forces = model.layout.drawing.forced_points
    n_rows = len(found.positions) + len(forces)
    arrows = {point: len(found.positions) + number for number, point in enumerate(forces)}
    pictured = scene_data(found, arrows, 1.0, is_live=True)
    if traces is not None:
        chosen = known_points(model, traces)
        for point in pictured["points"]:
            point["traced"] = point["name"] in chosen
    initial = {name: value for values in _independent(model, modes[0]).values() for name, value in values.items()}
    if not is_mapping(ranges):
        raise ModelError(f"ranges= is a mapping from names to pairs (low, high), not {shown(ranges)}.")
    known = {
        name: slider_range(ends, name)
        for name, ends in named(ranges, [*parameters, *initial], "parameter or initial value").items()
    }
    data = {
        "name": model.name,
        "states": model.states,
        "angles": model.layout.angles,
        "n_q": model.n_q,
        "n_u": model.n_u,
        "parameters": [
            {"name": name, "unit": model.units[name], "description": model.descriptions[name], "value": value}
            | {"own": model.defaults[name]}
            | _range(known.get(name) or model.ranges[name] or _around(value, model.units[name], found.size))
            for name, value in parameters.items()
        ],
        "initial": [
            {"name": name, "value": value} | _range(known.get(name) or _around_initial(model, name, value, found.size))
            for name, value in initial.items()
        ],
        "inputs": _inputs(run),
        "entries": [{"name": entry.of, "order": entry.order} for entry in model.layout.inputs],
        "modes": [mode.tolist() for mode in modes],
        "frames": {"rate": FRAMES_PER_SECOND, "least": MIN_FRAMES, "most": MAX_FRAMES},
        "arrow": ARROW,
        "t_span": [float(time) for time in run.settings["t_span"]],
        "methods": {name: number for number, name in enumerate(STEP_CONTROLLED)},  # as export/page.h counts them
        "method": run.settings["method"],
        "rtol": run.settings["rtol"],
        "atol": run.settings["atol"],
        "columns": names,
        "panels": _panels(run),
        "energies": energies,
        "figures": _figures(model, names, watch),
        "events": [_event(name, row, names, energies) for name, row in events],
        "turn": found.view.turn.tolist(),
        "points": len(model.layout.drawing.points),
        "bodies": len(model.layout.drawing.bodies),
        "guides": guides,
        "forces": forces,
        "rows": n_rows,
        "size": found.size,
        "scene": pictured,
        "python": _python(model),
        "wasm": base64.b64encode(page_module(model)).decode("ascii"),
    }
    return html_text("page/page.html", model.name, data, SCRIPTS, LAYOUT=html_file("page/page.css"))


def _scene(run: Trajectory) -> Scene:
    """What is drawn: what stays together in the run, and with lengths that are a little different."""
    model, start, end = run.kernel, run.t[0], run.t[-1]
    frames = run.resample(frame_times(start, end))
    positions, _ = model.drawing_along(frames.t, frames.y, frames.r, frames.parameters)
    turns = model.orientations_along(frames.t, frames.y, frames.r, frames.parameters)
    size = scene(model, positions).size
    every = np.concatenate([positions, *_neighbours(run, size)], axis=2)
    # Orientations count only in so far as there are bodies: the page has its own.
    turns = np.concatenate([turns, np.repeat(turns[..., :1], every.shape[2] - turns.shape[3], axis=3)], axis=3)
    p = parameter_array(model, run.parameters)
    return scene(model, every, rotations=turns, p=p, given=given_shapes(model))


def _neighbours(run: Trajectory, size: float) -> list[Floats]:
    """Positions at the initial state with other lengths, as far as the loops close then."""
    model = run.kernel
    found = []
    for share in (NEARBY, -NEARBY / 2.0, NEARBY / 8.0):
        values = dict(zip(model.parameters, parameter_array(model, run.parameters).tolist(), strict=True))
        for number, name in enumerate(model.layout.geometry, start=1):
            values[name] += share * math.sin(number) * (abs(values[name]) or size)
        try:
            x = _closed(run, values)
        except (AssemblyError, ModelError):
            continue
        found.append(model.drawing_along(run.t[:1], x[:, np.newaxis], run.r[:, :1], [*values.values()])[0])
    return found


def _independent(model: Kernel, x: Floats) -> dict[str, Any]:
    """The independent coordinates and speeds and the auxiliary states in a state, as `initial_state` takes them."""
    ends = (model.layout.n_independent_coordinates, model.layout.n_independent_speeds)
    values = dict(zip(model.states, map(float, x), strict=True))
    kinds = {
        "coordinates": model.coordinates[: ends[0]],
        "speeds": model.speeds[: ends[1]],
        "auxiliary_states": model.auxiliary_states,
    }
    return {kind: {name: values[name] for name in names} for kind, names in kinds.items()}


def _closed(run: Trajectory, values: dict[str, float]) -> Floats:
    """The initial state of a run with other parameters."""
    model, x = run.kernel, run.y[:, 0]
    guess = x[model.layout.n_independent_coordinates : model.n_q]
    state: Floats = initial_state(
        model, **_independent(model, x), t=float(run.t[0]), guess=guess, parameters=values, inputs=run.inputs
    )
    return state


def _modes(run: Trajectory) -> list[Floats]:
    """The initial state of the run, and those of the other assembly modes."""
    model, first = run.kernel, run.y[:, 0]
    if not model.layout.n_dependent_coordinates:
        return [first]
    parameters = dict(zip(model.parameters, parameter_array(model, run.parameters).tolist(), strict=True))
    found = initial_states(
        model, **_independent(model, first), t=float(run.t[0]), parameters=parameters, inputs=run.inputs
    )
    angles = np.array([name in model.layout.angles for name in model.coordinates])
    modes = [first]
    for mode in found if not found.free else ():
        difference = mode[: model.n_q] - first[: model.n_q]
        difference = np.where(angles, np.remainder(difference + np.pi, 2.0 * np.pi) - np.pi, difference)
        if np.isfinite(mode).all() and np.abs(difference).max() > SAME:
            modes.append(mode)
    return modes[:MOST_MODES]


def _range(ends: tuple[float, float]) -> dict[str, float]:
    return {"low": float(ends[0]), "high": float(ends[1])}


def _around(value: float, unit: str, size: float) -> tuple[float, float]:
    """The range of a slider about a value: a fifth to double; both signs if it is zero."""
    if value == 0.0:
        half = {"rad": math.pi, "m": _rounded(size / 2.0)}.get(unit, 1.0)
        return (-half, half)
    ends = sorted((_rounded(0.2 * value), _rounded(2.0 * value)))
    return (ends[0], ends[1])


def _around_initial(model: Kernel, name: str, value: float, size: float) -> tuple[float, float]:
    """The range of an initial value: half a turn for angles, the mechanism's size for displacements."""
    if name in model.layout.angles:
        half = math.pi
    elif name in model.coordinates:
        half = _rounded(size)
    else:
        half = _rounded(max(2.0 * abs(value), 5.0 if name in model.speeds else 1.0))
    middle = 0.0 if abs(value) <= half else value
    return (middle - half, middle + half)


def _rounded(value: float) -> float:
    """A value with two digits; not so large that twice of it is infinite."""
    return float(f"{min(max(value, -LARGEST), LARGEST):.1e}")


def _inputs(run: Trajectory) -> list[dict[str, Any]]:
    """Each input: its expression, what it begins as, what it can be, and the size of its values."""
    model, given = run.kernel, {} if run.inputs is None else named(run.inputs, run.kernel.inputs, "input")
    inputs = []
    for place, entry in enumerate(model.layout.inputs):
        if entry.order:
            continue
        name, source = entry.name, given.get(entry.name)
        kinds = ["constant", "line", "sine"] if name in model.prescribed else ["constant", "sine", "step", "ramp"]
        if entry.expression is not None:
            kinds.insert(0, "expression")
        signal: dict[str, Any] = {"kind": "expression", "values": []}
        if isinstance(source, tuple):
            kinds.append("hold")
            signal = {"kind": "hold", "values": np.concatenate(source[:2]).tolist()}
        elif source is not None:
            signal = {"kind": "constant", "values": [finite_number(source, f"input {name}")]}
        values = run.r[place][np.isfinite(run.r[place])]
        scale = _rounded(float(np.abs(values).max(initial=0.0))) or 1.0
        inputs.append(
            {
                "name": name,
                "expression": entry.expression,
                "kinds": kinds,
                "signal": signal,
                "scale": scale,
                "prescribed": name in model.prescribed,
            }
        )
    return inputs


def _panels(run: Trajectory) -> list[dict[str, Any]]:
    """The panels of plots: their curves as numbers of columns, and whether they are shown at first."""
    model, panels, begin = run.kernel, list[dict[str, Any]](), 0
    bodies = bodies_of_curves(model, run.parameters)
    has_energy = np.nan_to_num(run.kinetic_energy).any()
    for title, names, is_logarithmic in panel_names(model):
        columns = list(range(begin, begin + len(names)))
        begin += len(names)
        if title == ENERGY and not model.layout.potential_energy.is_known:
            columns = columns[:1]
        if columns and not (is_logarithmic and not model.n_c + len(model.layout.constraints.invariants)):
            is_open = not panels or (title == ENERGY and has_energy)
            of_curves = [bodies.get(name, "") for name in names]
            panels.append(
                {"title": title, "log": is_logarithmic, "columns": columns, "open": bool(is_open), "bodies": of_curves}
            )
    for vector in VECTORS:
        if np.isfinite(run.vectors[vector.name]).any():
            columns = [begin, begin + 1, begin + 2]
            panels.append(
                {"title": vector_title(vector), "log": False, "columns": columns, "open": False, "bodies": []}
            )
        begin += 3
    return panels


def _figures(model: Kernel, names: list[str], watch: Sequence[tuple[str, str]] | None) -> list[list[str]]:
    """The figures to watch; by default ranges of the first coordinates and magnitudes of the first outputs."""
    if watch is None:
        chosen = [("range", name) for name in model.coordinates[:2]]
        return [list(pair) for pair in (*chosen, *(("greatest magnitude", name) for name in model.outputs[:2]))]
    figures = []
    for pair in watch if isinstance(watch, list | tuple) else [watch]:
        words = [name_of(word) for word in pair] if isinstance(pair, list | tuple) else []
        if len(words) != 2 or words[0] not in STATISTICS or words[1] not in names:
            raise ModelError(
                f"watch= is a list of pairs of a statistic ({', '.join(STATISTICS)}) and the name of a quantity "
                f"({', '.join(names)}), not {shown(pair)}."
            )
        figures.append(words)
    return figures


def _python(model: Kernel) -> str:
    """The line of Python that loads the model."""
    if is_named(model.path, model.name, model.layout.fingerprint):
        return f'model = fb.load("{model.name}")'
    return f"# model is the compiled model {model.name}, fingerprint {model.layout.fingerprint[:16]}."
