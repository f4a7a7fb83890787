"""Plots and animations of trajectories and ensembles with Matplotlib."""

from __future__ import annotations

import importlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import name_of, numbers, positive
from fourbar_codegen.interface.extras import imported
from fourbar_codegen.interface.progress import QUIET_SECONDS
from fourbar_codegen.kernel.kernel import parameter_array
from fourbar_codegen.views.frames import equal_times, frames_of
from fourbar_codegen.views.model_shapes import ShapesLike, given_shapes
from fourbar_codegen.views.panels import FEW, Panel, panels, title_with_unit
from fourbar_codegen.views.scene import Scene, View, known_points, scene, view_of
from fourbar_codegen.views.shaded import Stroke, draw_solids, draw_solids_in_space, ground, seen_obliquely

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

    from fourbar_codegen.analysis.linearization import Linearization
    from fourbar_codegen.results.assembly_modes import AssemblyModes
    from fourbar_codegen.results.ensemble import Ensemble
    from fourbar_codegen.results.kinematics import Branch, Kinematics
    from fourbar_codegen.results.trajectory import Trajectory

__all__ = [
    "animate",
    "animate_mode",
    "plot_branch",
    "plot_branches",
    "plot_ensemble",
    "plot_fit",
    "plot_frames",
    "plot_kinematics",
    "plot_modes",
    "plot_paths",
    "plot_trajectory",
    "require_figures",
    "write_animation",
]

Floats = NDArray[np.float64]

FPS = 30.0
"""Frames per second by default."""

COLORS = 64
"""Of a GIF."""

NEAR_BACKGROUND = 8
"""Difference of colours, of 255, that nobody sees."""

LEGEND = 8
"""Most names of paths beside a drawing."""
WIDTH, HEIGHT = 0.085, 0.2
"""Of a letter and of a line of a legend below a drawing, in inches."""
SMALL, LINE = 0.065, 0.16
"""The same of a legend below curves."""

TICKS = 6
"""Numbers along the longest axis in space."""

MAX_FRAMES = 10_000
"""Largest number of frames of an animation; each takes some hundredths of a second to draw."""

ENDS = np.array([-1.0, 1.0])

FAR = 4.0
"""Way of a mechanism in space, relative to its size, from which on an animation follows it."""

EDGE = 0.08
"""Margin around an animation, relative to the size of the mechanism."""

MAX_PANELS = 24
"""Largest number of assembly modes that are drawn."""

ANIMATED_BY = {"gif": "pillow", "mp4": "ffmpeg"}
"""Matplotlib's writers."""

CURVES = 30
"""Number of members of an ensemble that are drawn as curves."""

TRACE_RATE = 500.0
"""Points of a trace for a second, so that fast motions have round traces."""

SMOOTH = 401
"""Number of states with which a curve looks smooth."""

TRACE = "tab:red"

AMONG_BODIES = ("link", "line", "actuator", "spring", "damper", "arrow")
"""Lines that are drawn among bodies."""

IN_SPACE = ("spring", "damper")
"""Symbols beside bodies with shapes."""

STYLES: dict[str, dict[str, Any]] = {
    "link": {"color": "0.25", "linewidth": 3.0, "solid_capstyle": "round", "solid_joinstyle": "round", "zorder": 2},
    "line": {"color": "0.25", "linewidth": 1.5, "zorder": 2},
    "guide": {"color": "0.6", "linewidth": 1.2, "zorder": 1},
    "actuator": {"color": "tab:red", "linewidth": 2.0, "zorder": 2},
    "spring": {"color": "tab:green", "linewidth": 1.2, "zorder": 2},
    "damper": {"color": "tab:green", "linewidth": 1.2, "zorder": 2},
    "ground": {"color": "0.45", "linewidth": 1.0, "zorder": 2},
    "slider": {"color": "0.25", "linewidth": 1.5, "zorder": 3},
    "pin": {"color": "0.25", "marker": "o", "markersize": 6.0, "markerfacecolor": "white", "zorder": 4},
    "mass": {"color": "tab:blue", "marker": "o", "markersize": 4.0, "zorder": 4},
    "arrow": {"color": "tab:orange", "linewidth": 2.0, "marker": "o", "markersize": 5.0, "markevery": [1], "zorder": 5},
}


def require_figures(kind: str) -> None:
    """Raise a ModelError if something is missing that PNG, GIF or MP4 needs."""
    if kind not in ANIMATED_BY:
        imported("matplotlib.figure", "Plots", "visual")
    elif not imported("matplotlib.animation", "Animations", "visual").writers.is_available(ANIMATED_BY[kind]):
        raise ModelError(f"{kind.upper()} needs {ANIMATED_BY[kind]}, which is not installed.")


def plot_trajectory(trajectory: Trajectory, names: str | Sequence[Any] = ()) -> Figure:
    """Plot states, inputs, outputs (such as joint forces), energy, multipliers and constraint violation over time.

    One panel for each; needs the extra ``visual``.

    Parameters
    ----------
    names : str or sequence of str, optional
        Plot only these quantities, each in a panel: names that ``run[name]`` takes.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If there is no such quantity, or Matplotlib is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> figure = run.plot(["q1", "energy"])  # doctest: +SKIP
    """
    if len(trajectory.t) < SMOOTH and len(np.unique(trajectory.t)) > 1:
        trajectory = trajectory.resample(np.linspace(trajectory.t[0], trajectory.t[-1], SMOOTH))
    chosen = [_panel(trajectory, name) for name in _quantities(names)]
    shown = chosen or [panel for panel in panels(trajectory) if panel.is_open]
    figure, cells = _stacked([panel.title for panel in shown], 2.2, "time (s)")
    for axes, panel in zip(cells, shown, strict=True):
        for name, values in panel.curves.items():
            axes.plot(trajectory.t, values, label=_label(name))
        if panel.is_logarithmic:
            axes.set_yscale("log")
        if len(panel.curves) > FEW:
            _name_many(axes, panel)
        else:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(trajectory.kernel.name)
    return figure


def _name_many(axes: Any, panel: Panel) -> None:
    """A legend of many curves below the axes, in columns, with those of a body after its name."""
    nothing = imported("matplotlib.lines", "Plots", "visual").Line2D([], [], linestyle="none")
    curves = dict(zip(panel.curves, axes.get_lines(), strict=True))
    handles, labels = list[Any](), list[str]()
    for body in dict.fromkeys(panel.bodies.get(name, "") for name in curves):
        own = [name for name in curves if panel.bodies.get(name, "") == body]
        handles += [nothing, *(curves[name] for name in own)] if body else [curves[name] for name in own]
        labels += [f"{body}:", *own] if body else own
    width, height = axes.figure.get_size_inches()
    columns = max(1, int(width / (0.6 + SMALL * max(map(len, labels)))))
    axes.legend(
        handles,
        list(map(_label, labels)),
        loc="upper left",
        bbox_to_anchor=(0.0, -0.1),
        ncols=columns,
        fontsize="x-small",
        frameon=False,
    )
    axes.figure.set_figheight(height + LINE * -(-len(labels) // columns))


def plot_fit(runs: Sequence[Trajectory], measured: Sequence[Mapping[str, Floats]]) -> Figure:
    """Plot measurements, as dots, and fitted runs over time, in a panel for each measured quantity.

    Parameters
    ----------
    runs : sequence of Trajectory
    measured : sequence of mapping of name to ndarray
        For each run, at its times.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If Matplotlib is not installed.
    """
    names = list(dict.fromkeys(name for columns in measured for name in columns))
    figure, cells = _stacked(names, 2.2, "time (s)")
    for axes, name in zip(cells, names, strict=True):
        for number, (run, columns) in enumerate(zip(runs, measured, strict=True)):
            if name in columns:
                label = "" if len(runs) == 1 else f" {number + 1}"
                axes.plot(run.t, columns[name], ".", color=f"C{number}", alpha=0.5, label=f"measured{label}")
                axes.plot(run.t, run[name], color=f"C{number}", label=f"fitted{label}")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(f"Fit of {runs[0].kernel.name}")
    return figure


def _stacked(titles: Sequence[str], height: float, label: str) -> tuple[Figure, list[Any]]:
    """A figure with axes one below the other, of a height in inches, and the label of their common horizontal axis."""
    figure: Figure = imported("matplotlib.figure", "Plots", "visual").Figure(
        figsize=(7.0, height * len(titles)), layout="constrained"
    )
    cells = list(figure.subplots(len(titles), 1, sharex=True, squeeze=False).flat)
    for axes, title in zip(cells, titles, strict=True):
        axes.set_title(title, loc="left", fontsize="medium")
        axes.grid(alpha=0.3)
    cells[-1].set_xlabel(label)
    return figure, cells


def _quantities(names: str | Sequence[Any]) -> list[str]:
    """Names of quantities, of which one may be given by itself."""
    given = [names] if isinstance(names, str) or hasattr(names, "name") else names
    if not isinstance(given, list | tuple):
        raise ModelError(f"names must be a sequence of names, not {shown(names)}.")
    return list(map(name_of, given))


def _panel(trajectory: Trajectory, name: str) -> Panel:
    """A quantity over time, or the three coordinates of a point."""
    values, title = trajectory[name], trajectory.kernel.title(name)
    curves = {title: values} if values.ndim == 1 else dict(zip("xyz", values, strict=True))
    return Panel(title_with_unit(trajectory.kernel, name), curves)


def plot_paths(trajectory: Trajectory, points: Sequence[str] = ()) -> Figure:
    """Draw the paths of points, such as coupler curves, and the initial mechanism; needs the extra ``visual``.

    Parameters
    ----------
    points : sequence of str, optional
        Names of the points; by default the moving joints, or the mass centres if there are none.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If a point does not exist, there is nothing to draw, or Matplotlib is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> figure = run.plot_paths(["link3_masscenter"])  # doctest: +SKIP
    """
    points = known_points(trajectory.kernel, points)
    drawn = frames_of(trajectory, lambda start, end: np.linspace(start, end, SMOOTH if start != end else 1))
    figure, [axes] = _figure(1, drawn.scene.view)
    _draw_paths(axes, drawn.scene, points)
    _name_paths(axes, drawn.scene)
    axes.set_title(trajectory.kernel.name)
    return figure


def _draw_paths(axes: Any, drawn: Scene, points: Sequence[str]) -> None:
    """The mechanism at the first instant, and the paths of points, or of the moving joints."""
    _draw(axes, drawn)
    dimensions = len(drawn.view.axes)
    for name in points or drawn.traced().values():
        axes.plot(*drawn.positions[drawn.names.index(name), :dimensions], label=_label(name), zorder=1)
    axes.set_aspect("equal")
    if not drawn.is_planar:  # fewer numbers along short axes
        lengths = {name: np.ptp(getattr(axes, f"get_{name}lim")()) for name in "xyz"}
        for name, length in lengths.items():
            axes.locator_params(axis=name, nbins=max(1, round(TICKS * length / max(lengths.values()))))


def _name_paths(axes: Any, drawn: Scene) -> None:
    """A legend beside the axes, if there are paths; below them if there are many."""
    names, figure = axes.get_legend_handles_labels()[1], axes.figure
    n = len(names)
    if n > LEGEND:
        columns = max(1, int(figure.get_figwidth() / (0.5 + WIDTH * max(map(len, names)))))
        figure.legend(loc="outside lower center", fontsize="small", ncols=columns)
        figure.set_figheight(figure.get_figheight() + HEIGHT * -(-n // columns))
    elif n:
        axes.legend(loc="center left", bbox_to_anchor=(1.02 if drawn.is_planar else 1.15, 0.5))


def plot_ensemble(ensemble: Ensemble, names: str | Sequence[Any] = ()) -> Figure:
    """Plot some members, and the median and the bands of 50 % and 90 % of all of them; needs ``visual``.

    If members differ in one parameter alone, there are no bands: curves are coloured by its value.

    Parameters
    ----------
    names : str or sequence of str, optional
        Names of scalar quantities, as in `Trajectory`, with a panel for each; by default the coordinates.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If there is no such quantity, or Matplotlib is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> import fourbar_codegen as fb
    >>> times = np.linspace(0.0, 1.0, 101)
    >>> stiffness = np.linspace(1.0, 5.0, 50)
    >>> ensemble = fb.load("four_bar").ensemble((0.0, 1.0), parameters={"k": stiffness}, t_eval=times)
    >>> figure = ensemble.plot(["q1", "energy"])  # doctest: +SKIP
    """
    quantities = _quantities(names) or list(ensemble.kernel.coordinates)
    if not len(ensemble):
        raise ModelError("There is nothing to plot: the ensemble has no members.")
    figure, cells = _stacked([_label(title_with_unit(ensemble.kernel, name)) for name in quantities], 2.6, "time (s)")
    varied = ensemble.varied
    draw = _draw_members if len(varied) == 1 else _draw_bands
    for axes, name in zip(cells, quantities, strict=True):
        values = ensemble[name]
        if values.ndim != 2:
            raise ModelError(f"{name} is not a scalar quantity over time: it has shape {values.shape}.")
        draw(axes, ensemble, values)
    failed = len(ensemble) - int(ensemble.success.sum())
    figure.suptitle(
        f"{ensemble.kernel.name}: {len(ensemble)} members"
        + (f", {failed} of which failed" if failed else "")
        + (": later, percentiles are of the others" if failed and draw is _draw_bands else "")
    )
    return figure


def _some(n: int) -> Any:
    """Numbers of the members that are drawn as curves."""
    return np.unique(np.linspace(0, n - 1, CURVES).round().astype(int))


def _draw_members(axes: Any, ensemble: Ensemble, values: Floats) -> None:
    """Curves of members, coloured by the parameter in which they differ."""
    [(name, of_members)], units = ensemble.varied.items(), ensemble.kernel.units
    mappable = imported("matplotlib.cm", "Plots", "visual").ScalarMappable(cmap="viridis")
    mappable.set_clim(of_members.min(), of_members.max())
    order = np.argsort(of_members)
    for member in order[_some(len(ensemble))]:
        axes.plot(ensemble.t, values[member], color=mappable.to_rgba(of_members[member]), linewidth=1.0)
    unit = units.get(name, "")
    axes.figure.colorbar(mappable, ax=axes, label=f"{_label(name)} ({unit})" if unit else _label(name))


def _draw_bands(axes: Any, ensemble: Ensemble, values: Floats) -> None:
    """Median, the bands of 50 and 90 % of the members, and curves of some."""
    reached = np.isfinite(values).any(axis=0)
    if not reached.any():
        return
    times = ensemble.t[reached]
    low, quarter, median, other, high = np.nanpercentile(values[:, reached], [5, 25, 50, 75, 95], axis=0)
    lines = axes.plot(ensemble.t, values[_some(len(ensemble))].T, color="0.6", linewidth=0.5, zorder=1)
    lines[0].set_label("members")
    axes.fill_between(times, low, high, color="tab:blue", alpha=0.2, linewidth=0.0, label="90 %")
    axes.fill_between(times, quarter, other, color="tab:blue", alpha=0.35, linewidth=0.0, label="50 %")
    axes.plot(times, median, color="tab:blue", label="median")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def plot_modes(modes: AssemblyModes) -> Figure:
    """Draw the mechanism in each of its modes, the first 24 of them; needs the extra ``visual``.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If there is nothing to draw, or Matplotlib is not installed.
    """
    model = modes.kernel
    if not model.points or not len(modes):
        raise ModelError(f"There is nothing to draw: {modes!r} with the points {', '.join(model.points) or 'none'}.")
    states = np.where(np.isfinite(modes.x), modes.x, 0.0)[:MAX_PANELS]
    given = modes.parameters, modes.inputs
    drawn = scene(
        model,
        np.stack([model.drawing(modes.t, x, *given)[0] for x in states], axis=2),
        rotations=np.stack([model.orientations(modes.t, x, *given) for x in states], axis=3),
        p=parameter_array(model, modes.parameters),
        given=given_shapes(model),
    )
    figure, cells = _figure(len(states), replace(drawn.view, is_planar=True))
    figure.suptitle(
        f"{model.name}: {len(modes)} assembly modes"
        + ("" if modes.is_complete else " of infinitely many" if modes.free else ", or more")
        + ("" if len(states) == len(modes) else f"; the first {len(states)}")
        + (f"\n{_label(modes.freedom)}" if modes.free else ""),
        wrap=True,
    )
    show = _draw_modes(cells, drawn)
    n_qi = model.layout.n_independent_coordinates
    for number, axes in enumerate(cells):
        show(number)
        named = zip(model.coordinates[n_qi:], modes.x[number, n_qi : model.n_q], strict=True)
        text = _label(", ".join(f"{name} = {value:.3g}" for name, value in [*named][:3]))
        axes.set_title(f"{number}: {text}", fontsize="small")
    return figure


def _draw_modes(cells: Sequence[Any], drawn: Scene) -> Callable[[int], None]:
    """Draw the mechanism in all modes in windows of the same size; returns a function that shows one in its axes."""
    if not drawn.is_planar:
        seen = seen_obliquely(drawn)
        move = _draw_frames(cells, drawn, seen, {}, {}, _window(drawn, seen, {}))
        return lambda number: move(number, number)
    low, high = (end.reduce(ends, axis=1) for end, ends in zip((np.fmin, np.fmax), drawn.limits(), strict=True))

    def show(number: int) -> None:
        axes = cells[number]
        _draw(axes, drawn)(number)
        for name, begin, end in zip(drawn.view.axes, low, high, strict=False):
            getattr(axes, f"set_{name}lim")(begin - EDGE * drawn.size, end + EDGE * drawn.size)
        axes.set_aspect("equal")

    return show


def plot_kinematics(found: Kinematics, *names: Any) -> Figure:
    """Plot quantities of all branches against the drive; needs the extra ``visual``.

    Parameters
    ----------
    *names : str or Symbol
        Coordinates, speeds, or points; by default all coordinates.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If a name is not known, or Matplotlib is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> import numpy as np
    >>> found = fb.load("four_bar").kinematics({"q1": np.linspace(-0.5, 0.5, 11)})
    >>> figure = found.plot("q2", "P2")  # doctest: +SKIP
    """
    quantities = _quantities(names) or [name for name in found.kernel.coordinates if name not in found.drive]
    unknown = [name for name in quantities if name not in (*found.kernel.states, *found.kernel.points)]
    if unknown:
        known = [*found.kernel.states, *found.kernel.points]
        raise ModelError(f"There is no {', '.join(unknown)}; there are {', '.join(known)}.")
    [(driven, values), *_] = found.drive.items()
    titles = [_label(title_with_unit(found.kernel, name)) for name in (*quantities, driven)]
    figure, cells = _stacked(titles[:-1], 2.4, titles[-1])
    for axes, name in zip(cells, quantities, strict=True):
        for number, branch in enumerate(found):
            for part, letter in zip(np.atleast_2d(branch[name]), "xyz", strict=False):
                label = f"branch {number}" + (f", {letter}" if branch[name].ndim > 1 else "")
                axes.plot(values, part, label=label)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(found.kernel.name)
    return figure


def plot_branch(branch: Branch, points: Sequence[str] = ()) -> Figure:
    """Draw the mechanism with the paths of points; see `Kinematics.plot_paths`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> branch = fb.load("four_bar").kinematics({"q1": [-0.5, 0.0, 0.5]})[0]
    >>> figure = branch.plot_paths(["P2"])  # doctest: +SKIP
    """
    return _plot_branches([branch], points)


def plot_branches(found: Kinematics, points: Sequence[str] = ()) -> Figure:
    """Draw the mechanism in each branch with the paths of points; needs the extra ``visual``.

    Parameters
    ----------
    points : sequence of str, optional
        By default the moving joints.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ModelError
        If a point is not known, there is nothing to draw, or Matplotlib is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> import numpy as np
    >>> found = fb.load("four_bar").kinematics({"q1": np.linspace(-0.5, 0.5, 11)})
    >>> figure = found.plot_paths(["P2"])  # doctest: +SKIP
    """
    return _plot_branches(found.branches, points)


def _plot_branches(branches: Sequence[Branch], points: Sequence[str]) -> Figure:
    """Draw the mechanism in each branch, where it is first closed, with paths; see `Kinematics.plot_paths`."""
    model = branches[0].kernel
    chosen = known_points(model, points)
    # A branch between two of the values of the drive has no position at any of them.
    closed = [branch for branch in branches if np.isfinite(branch.q).all(axis=0).any()]
    if not closed:
        raise ModelError(f"There is nothing of {model.name} to draw: the loops close at none of the drive's values.")
    shown = closed[:MAX_PANELS]
    known = [np.isfinite(branch.q).all(axis=0) for branch in shown]
    positions = [branch.positions[:, :, at] for branch, at in zip(shown, known, strict=True)]
    given = given_shapes(model)
    view = view_of(model, np.concatenate(positions, axis=2)[: len(model.points)], in_space=bool(given))
    scenes = []
    for branch, at, places in zip(shown, known, positions, strict=True):
        q, r = branch.q[:, at], branch.r[:, at]
        states = np.concatenate((q, np.zeros((model.n_u + model.n_z, q.shape[1]))))
        rotations = model.orientations_along(np.full(q.shape[1], branch.t), states, r, branch.p)
        scenes.append(scene(model, places, view, rotations=rotations, p=branch.p, given=given))
    figure, cells = _figure(len(shown), view)
    for number, (axes, drawn) in enumerate(zip(cells, scenes, strict=True)):
        _draw_paths(axes, drawn, chosen)
        if len(shown) > 1:
            axes.set_title(f"branch {number}", fontsize="small")
    if len(shown) == 1:
        _name_paths(cells[0], scenes[0])
    figure.suptitle(model.name)
    return figure


def _label(name: str) -> str:
    """A name as a Matplotlib label: not as a formula, and shown even with a leading underscore."""
    label = name.replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label


def _figure(panels: int, view: View) -> tuple[Figure, list[Any]]:
    """A figure with axes side by side, in rows of four."""
    figure_class = imported("matplotlib.figure", "Plots", "visual").Figure
    columns = min(panels, 4)
    rows = -(-panels // columns)
    side = 5.0 if panels == 1 else 2.8
    width = side * columns * (1.5 if panels == 1 and not view.is_planar else 1.0)  # for the names beside it
    figure: Any = figure_class(figsize=(width, side * rows), layout="constrained")
    how = {} if view.is_planar else {"projection": "3d"}
    axes = [figure.add_subplot(rows, columns, number + 1, **how) for number in range(panels)]
    for each in axes:
        for axis, label in zip(view.axes, view.labels, strict=False):
            getattr(each, f"set_{axis}label")(f"{label} (m)")
        if view.is_planar:
            each.grid(alpha=0.3)
    return figure, axes


def _styled(drawn: Scene, arrows: Mapping[int, int] | None = None) -> list[tuple[str, Floats]]:
    """Lines of a scene: their style, and points of shape (3, n_points, n_t)."""
    shown = [line for line in drawn.lines if not (drawn.solids and line.kind == "link")]
    found = [
        (line.kind, np.moveaxis(drawn.positions[[*line.rows, *line.rows[: line.is_closed]]], 0, 1)) for line in shown
    ]
    for symbol in drawn.symbols:
        if not drawn.solids or symbol.kind in IN_SPACE:
            outline = drawn.outline(symbol) if symbol.outline else drawn.positions[symbol.at][:, None]
            found.append((symbol.kind, outline))
    return found + [("arrow", np.moveaxis(drawn.positions[[*ends]], 0, 1)) for ends in (arrows or {}).items()]


def _draw(axes: Any, drawn: Scene, arrows: Mapping[int, int] | None = None) -> Callable[[int], None]:
    """Draw the mechanism at the first instant, and return a function that shows it at another."""
    dimensions, styled = len(drawn.view.axes), _styled(drawn, arrows)
    lines = [axes.plot(*points[:dimensions, :, 0], **STYLES[kind])[0] for kind, points in styled]
    areas = [line for line in drawn.lines if line.is_closed and drawn.is_planar]
    corners = [drawn.positions[list(area.rows), :2] for area in areas]
    filled = [axes.fill(*points[:, :, 0].T, color="0.25", alpha=0.2)[0] for points in corners]
    show_solids = draw_solids_in_space(axes, drawn) if drawn.solids else None

    def show(instant: int) -> None:
        if show_solids is not None:
            show_solids(instant)
        for line, (_, points) in zip(lines, styled, strict=True):
            (line.set_data if dimensions == 2 else line.set_data_3d)(*points[:dimensions, :, instant])
        for area, points in zip(filled, corners, strict=True):
            area.set_xy(points[:, :, instant])

    return show


def _draw_frames(
    cells: Sequence[Any],
    drawn: Scene,
    seen: Scene,
    arrows: Mapping[int, int],
    traces: Mapping[str, Floats],
    window: tuple[Floats, Floats],
) -> Callable[[int, int], None]:
    """Draw instants without axes, in a plane or as seen from above the side.

    Parameters
    ----------
    cells : sequence of matplotlib.axes.Axes
    drawn, seen : Scene
        And as it is seen.
    arrows : mapping of int to int
    traces : mapping of name to ndarray, shape (3, n)
        Paths of points in the inertial frame.
    window : tuple of ndarray
        As `_window` returns it.

    Returns
    -------
    callable
        Shows an instant, by its number, in one of the cells.
    """
    middle, half = window
    paths = [seen.view(path) for path in traces.values()]
    movers: list[Callable[[int], None]] = []
    for axes in cells:
        axes.set_aspect("equal")
        axes.set_axis_off()
        if drawn.is_planar:
            for path in paths:
                axes.plot(*path[:2], color=TRACE, linewidth=1.0, zorder=1)
            movers.append(_draw(axes, seen, arrows))
        else:
            strokes = [*ground(drawn), *(Stroke(path, TRACE, 1.2) for path in paths)]
            movers.append(_draw_obliquely(axes, seen, arrows, strokes, middle, half))

    def show(cell: int, instant: int) -> None:
        movers[cell](instant)
        cells[cell].set_xlim(*(middle[0, instant] + half[0] * ENDS))
        cells[cell].set_ylim(*(middle[1, instant] + half[1] * ENDS))

    return show


def _draw_obliquely(
    axes: Any, seen: Scene, arrows: Mapping[int, int], still: Sequence[Stroke], middle: Floats, half: Floats
) -> Callable[[int], None]:
    """Draw bodies and lines with a depth buffer; returns a function that shows an instant."""
    styled = _styled(seen, arrows)

    def strokes(instant: int) -> list[Stroke]:
        found = [*still]
        for kind, points in styled:
            if kind in AMONG_BODIES:
                color, width = STYLES[kind]["color"], STYLES[kind]["linewidth"]
                found.append(Stroke(points[:, :, instant], color, width))
                if kind == "arrow":
                    found.append(Stroke(_head(points[:, :, instant], half.max()), color, width))
        return found

    show = draw_solids(axes, seen, strokes)
    return lambda instant: show(instant, middle[:, instant], half)


def _head(ends: Floats, size: float) -> Floats:
    """The head of an arrow from one end to the other, shape (3, 3)."""
    way = ends[:, 1] - ends[:, 0]
    length = float(np.hypot(*way[:2]))
    if not length > 0.0:
        return np.full((3, 3), np.nan)
    along = np.array([*way[:2], 0.0]) / length
    across, back = np.array([-along[1], along[0], 0.0]), min(0.3 * length, 0.05 * size)
    return np.transpose(
        [ends[:, 1] + back * (sign * 0.5 * across - along) if sign else ends[:, 1] for sign in (-1, 0, 1)]
    )


def plot_frames(
    trajectory: Trajectory, times: Sequence[float] | None = None, *, shapes: ShapesLike | None = None
) -> Figure:
    """Draw the mechanism at some instants, each in axes of its own; needs the extra ``visual``.

    Parameters
    ----------
    times : sequence of float, optional
        At most 24; by default the beginning, the middle and the end of the run.
    shapes : mapping of body, frame or str to shape or sequence of shapes, optional
        What bodies look like in space, instead of `CompiledModel.shapes`.

    Returns
    -------
    matplotlib.figure.Figure
        Its ``savefig("frames.svg")`` writes them as SVG, PDF or PNG.

    Raises
    ------
    ModelError
        If a time is not in the run, there is nothing to draw, or Matplotlib is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> figure = run.plot_frames([0.0, 0.25, 0.5])  # doctest: +SKIP
    """
    first, last = (trajectory.t[0], trajectory.t[-1]) if len(trajectory.t) else (0.0, 0.0)
    at = np.linspace(first, last, 3) if times is None else np.atleast_1d(numbers(times, "times"))
    if at.ndim != 1 or not 0 < len(at) <= MAX_PANELS:
        raise ModelError(f"times are 1 to {MAX_PANELS} instants, not {shown(times)}.")
    outside = at[~((min(first, last) <= at) & (at <= max(first, last)))]
    if outside.size:
        raise ModelError(f"times are between {first:g} and {last:g} s, where the run is, not {outside[0]:g}.")
    # Whether it leaves a plane does not depend on the chosen times.
    whole = frames_of(trajectory, lambda start, end: np.linspace(start, end, 50 if start != end else 1), shapes)
    in_space = not whole.scene.is_planar
    drawn = frames_of(trajectory, lambda _, __: at, shapes, in_space=in_space)
    figure, cells = _figure(len(at), replace(drawn.scene.view, is_planar=True))
    seen = _seen(drawn.scene)
    show = _draw_frames(cells, drawn.scene, seen, drawn.arrows, {}, _window(drawn.scene, seen, drawn.arrows))
    for number, axes in enumerate(cells):
        show(number, number)
        axes.set_title(f"t = {at[number]:g} s", fontsize="small")
    figure.suptitle(trajectory.kernel.name)
    return figure


def animate(
    trajectory: Trajectory,
    *,
    fps: float = FPS,
    speed: float = 1.0,
    traces: Sequence[str] | None = None,
    shapes: ShapesLike | None = None,
) -> FuncAnimation:
    """Animate the mechanism with Matplotlib; needs the extra ``visual``.

    A link is the line through the points that are fixed on it, or the polygon about them; pins are where links
    meet, and the ground where they meet points at rest. Arrows are forces that depend on inputs.

    Parameters
    ----------
    fps : float, optional
        Frames per second.
    speed : float, optional
        Simulated seconds per second of the animation.
    traces : sequence of str, optional
        Names of points with a trace; by default the moving joints, or the mass centres if there are none; in space
        contact points, or the ends of open chains.
    shapes : mapping of body, frame or str to shape or sequence of shapes, optional
        What bodies look like in space, instead of `CompiledModel.shapes`.

    Returns
    -------
    matplotlib.animation.FuncAnimation
        `save` writes it as GIF or MP4. In a notebook, prefer `report`: the buttons of Matplotlib's ``to_jshtml()``
        need a network.

    Raises
    ------
    ModelError
        If the extra is not installed, the point of a trace does not exist, or no positions are known.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 1.0))
    >>> animation = run.animate(traces=["P2"])  # doctest: +SKIP
    """
    animations = imported("matplotlib.animation", "Animations", "visual")
    figures = imported("matplotlib.figure", "Animations", "visual")
    model = trajectory.kernel
    positive(fps, "fps")
    positive(speed, "speed")
    chosen = None if traces is None else known_points(model, traces)
    n = abs(np.ptp(trajectory.t)) * fps / speed if len(trajectory.t) else 0.0
    if n > MAX_FRAMES:
        raise ModelError(f"The animation would have {n:.0f} frames, more than {MAX_FRAMES}: use a larger speed.")
    drawn = frames_of(trajectory, lambda start, end: equal_times(start, end, fps / speed), shapes)
    traced = drawn.scene.traced().values() if chosen is None else chosen
    paths: dict[str, Floats] = {}
    if traced:
        start, end = trajectory.t[0], trajectory.t[-1]
        rate = min(TRACE_RATE, MAX_FRAMES / abs(end - start)) if start != end else TRACE_RATE
        finer = trajectory.resample(equal_times(start, end, rate)).points
        paths = {name: finer[name] for name in traced}
    figure = figures.Figure(figsize=(6.0, 6.0))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    seen = _seen(drawn.scene)
    middle, half = _window(drawn.scene, seen, drawn.arrows)
    figure.set_figheight(6.0 * np.clip(half[1] / half[0], 0.4, 1.5))  # as high as needed
    shape = figure.get_size_inches()
    move = _draw_frames([axes], drawn.scene, seen, drawn.arrows, paths, (middle, shape * np.max(half / shape)))
    time = axes.annotate("", (0.02, 0.02), xycoords="axes fraction", fontsize="small", color="0.3")

    def show(frame: int) -> None:
        move(0, frame)
        time.set_text(f"t = {drawn.shown.t[frame]:.2f} s")

    show(0)
    animation: FuncAnimation = animations.FuncAnimation(
        figure, show, frames=len(drawn.shown.t), interval=1000.0 / fps, blit=False
    )
    return animation


def animate_mode(linear: Linearization, number: int, **how: Any) -> FuncAnimation:
    """Animate the motion along a mode with Matplotlib: `animate` of `Linearization.mode`.

    Parameters
    ----------
    number : int
        Of an entry of `Linearization.eigenvalues`.
    **how
        Those of `Linearization.mode` and of `Trajectory.animate`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> animation = four_bar.linearize(0.0, four_bar.initial_state()).animate(0)  # doctest: +SKIP
    """
    of_mode = {name: how.pop(name) for name in ("amplitude", "duration") if name in how}
    return animate(linear.mode(number, **of_mode), **how)


def _seen(drawn: Scene) -> Scene:
    """A scene in a plane, or as it is seen from above the side."""
    return drawn if drawn.is_planar else seen_obliquely(drawn)


def _window(drawn: Scene, seen: Scene, arrows: Mapping[int, int]) -> tuple[Floats, Floats]:
    """The middle of an animation, shape (2, n_t), and half of its sizes, (2,); in space it follows what goes far."""
    tips, follows = [*chain(*arrows.items())], not drawn.is_planar
    low, high = seen.limits([row for row in (*seen.shown, *tips) if not follows or seen.moves(row)])
    ends = np.fmin.reduce(low, axis=1), np.fmax.reduce(high, axis=1)
    size, largest = (ends[1] - ends[0])[:2], np.fmax.reduce(high - low, axis=1)[:2]
    if follows and size.max() > FAR * largest.max():
        middle, size = (low + high)[:2] / 2.0, largest
    else:
        low, high = seen.limits([*seen.shown, *tips])
        ends = np.fmin.reduce(low, axis=1), np.fmax.reduce(high, axis=1)
        size = (ends[1] - ends[0])[:2]
        middle = np.repeat((ends[0] + ends[1])[:2, np.newaxis] / 2.0, seen.positions.shape[2], axis=1)
    half = size / 2.0 + EDGE * (size.max() if follows else seen.size)
    if not np.isfinite(middle).all() or not half.max() > 0.0:  # nothing to see
        return np.nan_to_num(middle), np.full(2, seen.size)
    return middle, half


def write_animation(trajectory: Trajectory, path: Path, kind: str) -> None:
    """Write an animation as GIF or MP4; the suffix of the file matches."""
    require_figures(kind)
    animations, name = imported("matplotlib.animation", "Animations", "visual"), ANIMATED_BY[kind]
    animation = animate(trajectory, fps=FPS, speed=1.0, traces=None)
    from tqdm import tqdm

    with tqdm(desc=f"{trajectory.kernel.name}, {kind.upper()}", unit="frame", delay=QUIET_SECONDS, disable=None) as bar:

        def advance(_: int, total: int) -> None:
            bar.total = total
            bar.update()

        writer = _gif_writer(animations) if kind == "gif" else animations.writers[name](fps=FPS)
        animation.save(path, writer=writer, progress_callback=advance)


def _gif_writer(animations: Any) -> Any:
    """A writer of GIFs with one palette, that of the first frame, in which the background is exact.

    Matplotlib's leaves it to Pillow to choose a palette for each frame, which takes most of the time.
    """
    images = importlib.import_module("PIL.Image")

    class Writer(animations.AbstractMovieWriter):
        frames: list[Any]
        palette: Any

        def setup(self, fig: Any, outfile: Any, dpi: Any = None) -> None:
            super().setup(fig, outfile, dpi=dpi)
            self.frames, self.palette = [], None

        def grab_frame(self, **how: Any) -> None:
            buffer = io.BytesIO()
            self.fig.savefig(buffer, **{**how, "format": "rgba", "dpi": self.dpi})
            frame = images.frombuffer("RGBA", self.frame_size, buffer.getbuffer(), "raw", "RGBA", 0, 1).convert("RGB")
            if self.palette is None:
                self.palette = frame.quantize(COLORS, kmeans=3)
                colors = np.reshape(self.palette.getpalette(), (-1, 3))
                background = frame.getpixel((0, 0))
                # Pillow takes colours that are nearly the nearest, so none is near the background.
                colors[np.abs(colors - background).max(axis=1) < NEAR_BACKGROUND] = background
                self.palette.putpalette(colors.ravel().tolist())
            self.frames.append(frame.quantize(palette=self.palette, dither=images.Dither.NONE))

        def finish(self) -> None:
            first, *others = self.frames
            first.save(self.outfile, save_all=True, append_images=others, duration=round(1000.0 / self.fps), loop=0)

    return Writer(fps=FPS)
