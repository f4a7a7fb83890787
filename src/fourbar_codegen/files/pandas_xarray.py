"""Results as tables of pandas and as datasets of xarray."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.files.reserved_names import OF_MEMBERS, check_free
from fourbar_codegen.interface.extras import imported
from fourbar_codegen.results.ensemble import Ensemble, over_members
from fourbar_codegen.results.provenance import attributes, ensemble_attributes
from fourbar_codegen.results.trajectory import Trajectory
from fourbar_codegen.runtime.enumerations import VECTORS

if TYPE_CHECKING:
    import pandas
    import xarray

__all__ = ["ensemble_dataset", "series", "to_dataframe", "to_dataset"]

Floats = NDArray[np.float64]


def to_dataframe(trajectory: Trajectory) -> pandas.DataFrame:
    """The trajectory as a pandas DataFrame; needs the extra ``data``.

    Returns
    -------
    pandas.DataFrame
        A row for each time, which is the index ``t`` (s), and a column for each other entry of `columns`.

    Raises
    ------
    ModelError
        If pandas is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> frame = fb.load("four_bar").simulate((0.0, 1.0), t_eval=[0.0, 0.5, 1.0]).to_dataframe()
    >>> frame["q1"].loc[0.5].round(4), frame.index.name
    (np.float64(-1.3096), 't')
    """
    columns = trajectory.columns()
    return imported("pandas", "Tables", "data").DataFrame(columns).set_index("t")


def to_dataset(trajectory: Trajectory) -> xarray.Dataset:
    """The trajectory as an xarray Dataset; needs the extra ``data``.

    Returns
    -------
    xarray.Dataset
        Over ``time`` (s) a variable for each coordinate, speed, input and output; residuals, multipliers, energies
        (J), momenta, positions of points (m) and forces that depend on inputs (N). The attributes contain the
        information to repeat the run: model and fingerprint, parameters, settings and versions, the latter three as
        JSON; and how the run ended. A state, input or output that is called ``position``, for example, takes the
        place of the positions.

    Raises
    ------
    ModelError
        If xarray is not installed, or a state, input or output has the name of a coordinate, such as ``time``.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> dataset = fb.load("four_bar").simulate((0.0, 1.0), t_eval=[0.0, 0.5, 1.0]).to_xarray()
    >>> dataset["q1"].sel(time=0.5).shape, dataset["position"].dims
    ((), ('point', 'axis', 'time'))
    """
    xarray = imported("xarray", "Datasets", "data")
    model = trajectory.kernel
    described = (
        (model.coordinates, trajectory.q, "coordinate"),
        (model.speeds, trajectory.u, "speed"),
        (model.auxiliary_states, trajectory.z, "auxiliary state"),
        (model.inputs, trajectory.r, "input"),
        (model.outputs, trajectory.outputs, "output"),
    )
    variables = {
        name: ("time", values, {"kind": kind})
        for names, rows, kind in described
        for name, values in zip(names, rows, strict=True)
    }
    check_free(variables, {"time", "constraint", "row", "point", "forced_point", "axis"})
    more = {
        "constraint_residual": (("constraint", "time"), trajectory.constraint_residual, {}),
        "velocity_residual": (("row", "time"), trajectory.velocity_residual, {}),
        "multiplier": (("row", "time"), trajectory.multipliers, {}),
        "kinetic_energy": ("time", trajectory.kinetic_energy, {"units": "J"}),
        "potential_energy": ("time", trajectory.potential_energy, {"units": "J", **_left_out(trajectory)}),
        **{
            vector.name: (("axis", "time"), trajectory.vectors[vector.name], {"units": vector.unit})
            for vector in VECTORS
        },
        "position": (
            ("point", "axis", "time"),
            np.reshape(list(trajectory.points.values()), (len(model.points), 3, len(trajectory.t))),
            {"units": "m"},
        ),
        "force": (
            ("forced_point", "axis", "time"),
            np.reshape(list(trajectory.forces.values()), (len(model.forced_points), 3, len(trajectory.t))),
            {"units": "N"},
        ),
    }
    return xarray.Dataset(
        {**variables, **{name: value for name, value in more.items() if name not in variables}},
        coords={
            "time": ("time", trajectory.t, {"units": "s"}),
            "point": list(model.points),
            "forced_point": list(model.forced_points),
            "axis": ["x", "y", "z"],
        },
        attrs=_texts(attributes(trajectory)),
    )


def _left_out(trajectory: Trajectory) -> dict[str, str]:
    """What the potential energy leaves out, if anything."""
    return {"without": ", ".join(trajectory.energy_without)} if trajectory.energy_without else {}


def _texts(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes as NetCDF takes them: mappings as JSON."""
    return {
        name: json.dumps(value) if isinstance(value, Mapping) else int(value) if isinstance(value, bool) else value
        for name, value in attributes.items()
    }


def ensemble_dataset(ensemble: Ensemble) -> xarray.Dataset:
    """The ensemble as an xarray Dataset; needs the extra ``data``.

    Returns
    -------
    xarray.Dataset
        Over ``member`` and ``time`` (s) a variable for each coordinate, speed, auxiliary state and output; over
        ``member`` each parameter, ``success``, ``message`` and ``nfev``. Attributes as in `Trajectory.to_xarray`.

    Raises
    ------
    ModelError
        If xarray is not installed.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> ensemble = four_bar.ensemble((0.0, 1.0), parameters={"k": [2.0, 3.0]}, t_eval=[0.0, 0.5, 1.0])
    >>> ensemble.to_xarray()["q1"].dims
    ('member', 'time')
    """
    xarray = imported("xarray", "Datasets", "data")
    of_time, of_members = series(ensemble), ensemble.by_member
    check_free((*of_time, *of_members), OF_MEMBERS)
    ends = {"success": ensemble.success, "message": np.array(ensemble.messages, dtype=object), "nfev": ensemble.nfev}
    return xarray.Dataset(
        {name: ("member", values) for name, values in (of_members | ends).items()}
        | {name: (("member", "time"), values) for name, values in of_time.items()},
        coords={"time": ("time", ensemble.t, {"units": "s"}), "member": np.arange(len(ensemble))},
        attrs=_texts(ensemble_attributes(ensemble)),
    )


def series(ensemble: Ensemble) -> dict[str, Floats]:
    """States and outputs of all members by name, each of shape (n, n_t)."""
    model = ensemble.kernel
    has_outputs = model.outputs and len(ensemble)
    nothing = np.empty((len(ensemble), len(model.outputs), len(ensemble.t)))
    outputs = over_members(ensemble, lambda member: member.outputs) if has_outputs else nothing
    return {
        **{name: ensemble.y[:, i] for i, name in enumerate(model.states)},
        **{name: outputs[:, i] for i, name in enumerate(model.outputs)},
    }
