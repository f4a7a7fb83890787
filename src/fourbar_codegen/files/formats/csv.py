"""CSV: a row of names, and all digits of numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import IO, Any

import numpy as np

from fourbar_codegen.files.reserved_names import check_free
from fourbar_codegen.results.ensemble import Ensemble
from fourbar_codegen.results.kinematics import Branch
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import VECTORS

__all__ = ["write_branch", "write_ensemble", "write_trajectory"]


def write_trajectory(trajectory: Trajectory, file: IO[bytes]) -> None:
    """A row for each time."""
    model, columns = trajectory.kernel, trajectory.columns()
    own = {*model.states, *model.inputs, *model.outputs}
    units = dict.fromkeys(("kinetic_energy", "potential_energy", "energy"), "J")
    units |= {name: vector.unit for vector in VECTORS for name in vector.components}
    for point, rows in trajectory.points.items():
        position = dict(zip((f"{point}.{axis}" for axis in "xyz"), rows, strict=True))
        columns |= {name: row for name, row in position.items() if name not in columns}
        units |= dict.fromkeys(position, "m")
    titles = {name: f"{model.title(name)} [{unit}]" for name, unit in units.items() if name not in own}
    taken = {*columns}  # a state that is called "energy [J]"
    titles = {name: title for name, title in titles.items() if title not in taken}
    _write({titles.get(name, model.title(name)): column for name, column in columns.items()}, file)


def write_branch(branch: Branch, file: IO[bytes]) -> None:
    """A row for each value of the drive."""
    _write(branch.columns(), file)


def write_ensemble(ensemble: Ensemble, file: IO[bytes]) -> None:
    """A row for each member and time."""
    model, varied = ensemble.kernel, ensemble.varied
    of_members = {  # those that differ between members, or from the defaults
        name: values
        for name, values in ensemble.by_member.items()
        if name in varied or (len(values) and values[0] != model.defaults.get(name))
    }
    check_free((*of_members, *model.states, *model.outputs), {"member", "t"})
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(("member", *of_members, "t", *model.states, *model.outputs))
    for number, member in enumerate(ensemble):
        own = [float(values[number]) for values in of_members.values()]
        rows = np.vstack((member.t, member.y, member.outputs)).T.tolist()
        writer.writerows((number, *own, *row) for row in rows)
    text.detach()  # the file stays open


def _write(columns: Mapping[str, Any], file: IO[bytes]) -> None:
    """Arrays of the same length by name as columns, with a row of names, and all digits of numbers."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    text.detach()  # the file stays open
