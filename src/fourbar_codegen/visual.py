"""Pictures of trajectories: plots with Matplotlib, animations with SymMePlot."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import positive
from fourbar_codegen.drawing import drawing
from fourbar_codegen.errors import ModelError

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.figure import Figure

    from fourbar_codegen.trajectory import Trajectory

__all__ = ["animate", "plot_trajectory", "write_animation"]

Floats = NDArray[np.float64]

FPS = 30.0
"""Pictures per second, where nobody says otherwise."""

MOST_PICTURES = 10_000
"""An animation takes no more: each is some hundredths of a second to draw."""

SMOOTH = 401
"""States that a curve looks smooth with."""


def _imported(name: str, what: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ModelError(f"{what} need {name.split('.')[0]}: pip install 'fourbar_codegen[visual]'.") from error


def plot_trajectory(trajectory: Trajectory) -> Figure:
    """Coordinates, speeds, outputs, loop residual (where there are any) and energy over time, one above the other.

    Parameters
    ----------
    trajectory : Trajectory

    Returns
    -------
    matplotlib.figure.Figure
        Made without pyplot: it appears on no screen by itself and needs not be closed.

    Raises
    ------
    ModelError
        If Matplotlib is not installed.
    """
    figure_class = _imported("matplotlib.figure", "Plots").Figure
    model = trajectory.model
    if len(trajectory.t) < SMOOTH and len(np.unique(trajectory.t)) > 1:
        trajectory = trajectory.resample(np.linspace(trajectory.t[0], trajectory.t[-1], SMOOTH))
    energies = {
        "kinetic": trajectory.kinetic_energy,
        "potential": trajectory.potential_energy,
        "sum": trajectory.energy,
    }
    panels: list[tuple[str, dict[str, Floats]]] = [
        ("coordinates (rad or m)", dict(zip(model.coordinates, trajectory.q, strict=True))),
        ("speeds (rad/s or m/s)", dict(zip(model.speeds, trajectory.u, strict=True))),
        ("outputs", dict(zip(model.outputs, trajectory.outputs, strict=True))),
    ]
    if model.n_h:
        # Zero has no place on a logarithmic axis; half the spacing of doubles around 1 stands for it.
        size = np.abs(trajectory.constraint_residual).max(axis=0)
        panels.append(("loop residual", {"largest": np.maximum(size, np.finfo(float).eps / 2)}))
    panels.append(("energy (J)", {name: values for name, values in energies.items() if np.isfinite(values).any()}))
    panels = [(label, curves) for label, curves in panels if curves]
    figure: Figure = figure_class(figsize=(7.0, 2.2 * len(panels)), layout="constrained")
    for axes, (label, curves) in zip(figure.subplots(len(panels), 1, sharex=True), panels, strict=True):
        for name, values in curves.items():
            axes.plot(trajectory.t, values, label=name.replace("$", r"\$"))
        axes.set_ylabel(label)
        if label == "loop residual":
            axes.set_yscale("log")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes.grid(alpha=0.3)
    axes.set_xlabel("time (s)")
    figure.suptitle(model.name)
    return figure


def animate(trajectory: Trajectory, *, fps: float, speed: float, traces: Sequence[str]) -> FuncAnimation:
    """Animate a trajectory; see `Trajectory.animate`.

    SymMePlot draws vectors whose components are symbols; the compiled positions take the place of these.
    """
    scenes = _imported("symmeplot.matplotlib", "Animations")
    figures = _imported("matplotlib.figure", "Animations")
    me = _imported("sympy.physics.mechanics", "Animations")
    model = trajectory.model
    positive(fps, "fps")
    positive(speed, "speed")
    if isinstance(traces, str):
        raise ModelError(f"traces must be a sequence of points' names, not {traces!r}.")
    unknown = [name for name in traces if name not in model.points]
    if unknown:
        raise ModelError(f"There is no point {', '.join(unknown)} to trace; there are {', '.join(model.points)}.")
    n = abs(np.ptp(trajectory.t)) * fps / speed if len(trajectory.t) else 0.0
    if n > MOST_PICTURES:
        raise ModelError(f"The animation would have {n:.0f} pictures, more than {MOST_PICTURES}: take a greater speed.")
    drawn = drawing(trajectory, fps / speed)
    positions, size = drawn.positions, drawn.size
    symbols = importlib.import_module("sympy").symbols(f"x:{3 * len(positions)}")
    frame, origin = me.ReferenceFrame(""), me.Point("")
    points = [
        origin.locatenew(name, sum((s * axis for s, axis in zip(xyz, frame, strict=True)), me.Vector(0)))
        for name, xyz in zip(model.points, zip(*[iter(symbols)] * 3, strict=True), strict=True)
    ]
    figure = figures.Figure(figsize=(6.0, 6.0))
    axes = figure.add_subplot(projection="3d")
    scene = scenes.Scene3D(frame, origin, ax=axes, scale=0.1 * size)
    for number, name, parent, body in drawn.points():
        if parent is not None:
            scene.add_line([points[parent], points[number]], color="black", linewidth=2.5)
        if body is not None:
            scene.add_point(points[number], color="tab:blue", markersize=6)
        if name in traces:
            scene.add_point_trace(points[number], color="tab:red", s=2)
    scene.lambdify_system(symbols)
    scene.evaluate_system(*positions[:, :, 0].ravel())
    scene.plot(prettify=False)
    low, high = positions.min(axis=(0, 2)), positions.max(axis=(0, 2))
    middle = (low + high) / 2
    for i, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(middle[i] - 0.55 * size, middle[i] + 0.55 * size)
    axes.set_aspect("equal")
    axes.set_proj_type("ortho")
    axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.6)
    axes.set_axis_off()
    if drawn.is_planar:
        axes.view_init(elev=90.0, azim=-90.0)
    animation: FuncAnimation = scene.animate(
        lambda i: tuple(positions[:, :, i].ravel()), positions.shape[2], interval=1000.0 / fps, blit=False
    )
    return animation


def write_animation(trajectory: Trajectory, path: Path, kind: str) -> None:
    """Write an animation to a file, whatever its name, as a GIF or an MP4."""
    animations = _imported("matplotlib.animation", "Animations")
    name = {"gif": "pillow", "mp4": "ffmpeg"}[kind]
    if not animations.writers.is_available(name):
        raise ModelError(f"{kind.upper()} needs {name}, which is not installed.")
    animation = animate(trajectory, fps=FPS, speed=1.0, traces=())
    whole = path.with_name(f"{path.name}.{kind}")  # Matplotlib goes by the ending
    try:
        animation.save(whole, writer=animations.writers[name](fps=FPS))
        whole.replace(path)
    finally:
        whole.unlink(missing_ok=True)
