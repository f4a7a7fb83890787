"""Trajectory -> an interactive report: one HTML file that needs no network and no server."""

from __future__ import annotations

import base64
import html
import json
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.drawing import drawing, equal_times
from fourbar_codegen.storage import versions

if TYPE_CHECKING:
    from fourbar_codegen.trajectory import Trajectory

__all__ = ["picture_times", "report_text"]

Floats = NDArray[np.float64]

PICTURES_PER_SECOND = 60
MOST_PICTURES = 601
"""More than these are not embedded: longer runs are shown at fewer times."""


def report_text(trajectory: Trajectory) -> str:
    """The report as HTML: the moving mechanism, traces of its points, plots that follow, and a table of the run.

    Parameters
    ----------
    trajectory : Trajectory
        It is shown at equally spaced times; see `Trajectory.resample`.

    Returns
    -------
    str

    Raises
    ------
    ModelError
        If there is nothing to show: no points whose positions are known, or no states.
    """
    drawn = drawing(trajectory, PICTURES_PER_SECOND, MOST_PICTURES)
    joined = {parent for _, _, parent, _ in drawn.points()}
    data = {
        "times": _packed(drawn.shown.t, "<f8"),
        # In units of the mechanism's size: single precision has a smaller range.
        "positions": _packed(np.moveaxis(drawn.positions, 2, 0) / drawn.size),
        "planar": drawn.is_planar,
        # The ends of chains that move leave a trace from the beginning.
        "points": [
            {"name": name, "parent": parent, "body": body, "traced": number not in joined and drawn.moves(number)}
            for number, name, parent, body in drawn.points()
        ],
        "plots": _plots(drawn.shown),
        "table": _table(trajectory),
    }
    # "<" would end the element that the data stands in.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    page = resources.files("fourbar_codegen").joinpath("report.html").read_text(encoding="utf-8")
    return page.replace("@TITLE@", html.escape(trajectory.model.name)).replace("@DATA@", text)


def picture_times(start: float, end: float) -> Floats:
    """The times at which a run from start to end is shown."""
    return equal_times(start, end, PICTURES_PER_SECOND, MOST_PICTURES)


def _packed(values: Any, dtype: str = "<f4") -> str:
    """Numbers as the page reads them."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def _plots(shown: Trajectory) -> list[dict[str, Any]]:
    model = shown.model
    groups: list[tuple[str, bool, dict[str, Floats]]] = [
        ("Coordinates", False, dict(zip(model.coordinates, shown.q, strict=True))),
        ("Speeds", False, dict(zip(model.speeds, shown.u, strict=True))),
        ("Inputs", False, dict(zip(model.inputs, shown.r, strict=True))),
        ("Outputs", False, dict(zip(model.outputs, shown.outputs, strict=True))),
    ]
    if model.n_h:
        # Zero has no logarithm; half the spacing of doubles around 1 stands for it.
        largest = np.maximum(np.abs(shown.constraint_residual).max(axis=0), np.finfo(float).eps / 2)
        groups.append(("Loop residual, in the constraints' units", True, {"largest": np.log10(largest)}))
    energies = {"kinetic": shown.kinetic_energy, "potential": shown.potential_energy, "sum": shown.energy}
    known = {name: values for name, values in energies.items() if np.isfinite(values).all()}
    groups.append(("Energy, J", False, known))
    return [
        {
            "title": title,
            "log": log,
            "curves": [{"name": name, "values": _packed(values)} for name, values in curves.items()],
        }
        for title, log, curves in groups
        if curves
    ]


def _table(trajectory: Trajectory) -> list[tuple[str, str]]:
    """What the run was, and what it took."""
    model = trajectory.model
    values = model.defaults.values() if trajectory.parameters is None else trajectory.parameters
    rows = [("model", model.name), ("fingerprint", model.manifest["fingerprint"][:16])]
    rows += [(name, str(value)) for name, value in trajectory.settings.items()]
    rows += [
        ("ended", trajectory.message),
        ("evaluations", str(trajectory.nfev)),
        ("stored states", str(len(trajectory.t))),
    ]
    if model.n_h:
        rows.append(("loop residual at most", f"{np.abs(trajectory.constraint_residual).max():.2e}"))
    rows += [
        (name, " ".join((f"{value:g}", model.units[name])).strip())
        for name, value in zip(model.parameters, values, strict=True)
    ]
    return rows + [(name, number) for name, number in versions().items()]
