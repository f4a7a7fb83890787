"""Branch and Kinematics: positions, velocities and accelerations of a mechanism along a drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import name_of
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.kernel import Kernel

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any

__all__ = ["Branch", "Kinematics"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Branch:
    """One way in which the loops close, along the drive.

    Attributes
    ----------
    model : CompiledModel
    t : float
    drive : dict of str to ndarray, shape (n,)
        The driven coordinates or inputs.
    q, qd, qdd : ndarray, shape (n_q, n)
        The coordinates and their first and second derivatives with respect to time; NaN where the loops do not close,
        and of the derivatives at dead points.
    u, ud : ndarray, shape (n_u, n)
        Speeds and their rates.
    limits : dict of str to (float, float)
        Values of the drive where the branch begins and ends: the range in which the loops close in this way. Of
        several drives, the values at both ends of the way.
    r : ndarray, shape (n_r, n)
        Inputs.
    p : ndarray, shape (n_p,)
    without_value : tuple of str
        Parameters and inputs that have none, such as masses and forces, since no position depends on them. They are 1
        in p and 0 in r.
    """

    kernel: Kernel
    t: float
    drive: dict[str, Floats]
    q: Floats
    qd: Floats
    qdd: Floats
    u: Floats
    ud: Floats
    limits: dict[str, tuple[float, float]]
    r: Floats
    p: Floats
    without_value: tuple[str, ...]

    model = RegisteredAttribute()
    save = Registered[[str | Path], Path]()
    plot_paths = Registered[..., Figure]()

    @cached_property
    def _drawn(self) -> Floats:
        """Positions, velocities and accelerations of all drawn points, shape (3, n_points, 3, n)."""
        model, n = self.kernel, self.q.shape[1]
        found = np.full((3, len(model.layout.drawing.points), 3, n), np.nan)
        for k in np.flatnonzero(np.isfinite(self.q).all(axis=0)):
            is_known = np.isfinite(self.ud[:, k]).all()
            state = np.concatenate(
                (self.q[:, k], self.u[:, k] if is_known else np.zeros(model.n_u), np.zeros(model.n_z))
            )
            found[0, :, :, k] = model.drawing(self.t, state, self.p, self.r[:, k])[0]
            if is_known:
                found[1:, :, :, k] = model.motion(self.t, state, self.ud[:, k], self.p, self.r[:, k])[1:]
        return found

    @property
    def positions(self) -> Floats:
        """Positions of all drawn points, those without names last, m, shape (n_points, 3, n)."""
        return np.asarray(self._drawn[0])

    @cached_property
    def points(self) -> dict[str, Floats]:
        """Positions of points by name, m, each of shape (3, n)."""
        return dict(zip(self.kernel.points, self._drawn[0], strict=False))

    @cached_property
    def velocities(self) -> dict[str, Floats]:
        """Velocities of points by name, m/s, each of shape (3, n)."""
        return dict(zip(self.kernel.points, self._drawn[1], strict=False))

    @cached_property
    def accelerations(self) -> dict[str, Floats]:
        """Accelerations of points by name, m/s^2, each of shape (3, n)."""
        return dict(zip(self.kernel.points, self._drawn[2], strict=False))

    def __getitem__(self, name: Any) -> Floats:
        """A coordinate or speed, shape (n,), or the positions of a point, m, shape (3, n), by name or symbol.

        Raises
        ------
        ModelError
            If there is no such quantity. The message lists the names.
        """
        key, model = name_of(name), self.kernel
        if key in model.coordinates:
            return np.asarray(self.q[model.coordinates.index(key)])
        if key in model.speeds:
            return np.asarray(self.u[model.speeds.index(key)])
        if key in model.points:
            return self.points[key]
        known = [*model.coordinates, *model.speeds, *model.points]
        raise ModelError(f"There is no quantity {key!r}; there are {', '.join(known)}.")

    __iter__ = None  # names are those of columns()

    def __contains__(self, name: object) -> bool:
        """Whether there is a quantity of this name."""
        known = (*self.kernel.coordinates, *self.kernel.speeds, *self.kernel.points)
        return (name if isinstance(name, str) else getattr(name, "name", None)) in known

    def columns(self) -> dict[str, Floats]:
        """All scalar quantities along the drive by name, each of shape (n,).

        The drive, coordinates, speeds and inputs; positions of points, such as ``P.x`` (m). A prime at the end of a
        name is for the first derivative with respect to time, two for the second. NaN where the loops do not close.
        """
        model = self.kernel
        columns = {**self.drive}
        for names, rows, primes in (
            (model.coordinates, self.q, ""),
            (model.speeds, self.u, ""),
            (model.inputs, self.r, ""),
            (model.coordinates, self.qd, "'"),
            (model.coordinates, self.qdd, "''"),
            (model.speeds, self.ud, "'"),
        ):
            for name, row in zip(names, rows, strict=True):
                columns.setdefault(name + primes, row)
        for points, primes in ((self.points, ""), (self.velocities, "'"), (self.accelerations, "''")):
            for point, rows in points.items():
                for axis, row in zip("xyz", rows, strict=True):
                    columns.setdefault(f"{point}.{axis}{primes}", row)
        return columns

    def __repr__(self) -> str:
        closed = int(np.isfinite(self.q).all(axis=0).sum())
        ends = "; ".join(f"{name} from {low:.6g} to {high:.6g}" for name, (low, high) in self.limits.items())
        return f"<Branch of {self.kernel.name}: {ends}; closed at {closed} of {self.q.shape[1]} values>"

    def transmission_angle(self, a: str, joint: str, b: str) -> Floats:
        """The angle at a joint between the ways to two other points, such as between coupler and rocker.

        Parameters
        ----------
        a, joint, b : str
            Names of points: for a four-bar the ends of the coupler, then the rocker's joint with the ground.

        Returns
        -------
        ndarray, shape (n,)
            Between 0 and pi; forces are transmitted well near pi/2.

        Raises
        ------
        ModelError
            If a point is not known.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> import numpy as np
        >>> found = fb.load("four_bar").kinematics({"q1": np.linspace(-0.5, 0.5, 11)})
        >>> found[0].transmission_angle("P2", "joint3_link3_joint", "P44").shape
        (11,)
        """
        for name in (a, joint, b):
            if not isinstance(name, str) or name not in self.kernel.points:
                raise ModelError(f"There is no point {shown(name)}; there are {', '.join(self.kernel.points)}.")
        first, second = (self.points[end] - self.points[joint] for end in (a, b))
        return np.asarray(
            np.arctan2(np.linalg.norm(np.cross(first, second, axis=0), axis=0), (first * second).sum(axis=0))
        )


@dataclass(frozen=True, eq=False, repr=False)
class Kinematics(Sequence[Branch]):
    """The branches of a mechanism along a drive: a sequence of `Branch`, the one nearest to the initial values first.

    Attributes
    ----------
    model : CompiledModel
    drive : dict of str to ndarray, shape (n,)
    branches : tuple of Branch
    dead_points : tuple of dict of str to float
        Positions between two branches, where the drive cannot go on: the values of driven quantities and coordinates.
    is_complete : bool
        Whether the branches have all assembly modes at all values of the drive, and none ended where it should go on.
        This is known where loops are closed one or two constraints at a time (see `AssemblyModes`).
    """

    kernel: Kernel
    drive: dict[str, Floats]
    branches: tuple[Branch, ...]
    dead_points: tuple[dict[str, float], ...]
    is_complete: bool

    model = RegisteredAttribute()
    plot = Registered[..., Figure]()
    plot_paths = Registered[..., Figure]()

    def __len__(self) -> int:
        return len(self.branches)

    def __getitem__(self, number: Any) -> Any:
        try:
            if isinstance(number, bool | np.bool_):
                raise TypeError
            return self.branches[number]
        except (TypeError, ValueError) as error:
            raise ModelError(f"A branch is known by its number, below {len(self)}, not by {shown(number)}.") from error

    def __iter__(self) -> Iterator[Branch]:
        return iter(self.branches)

    @property
    def closes(self) -> NDArray[np.bool_]:
        """Where along the drive the loops can close, shape (n,)."""
        return np.asarray(np.isfinite([branch.q for branch in self.branches]).all(axis=1).any(axis=0))

    def __repr__(self) -> str:
        where = "everywhere" if self.closes.all() else f"at {int(self.closes.sum())} of {len(self.closes)} values"
        return (
            f"<Kinematics of {self.kernel.name} along {', '.join(self.drive)}: {len(self)} branches"
            f"{'' if self.is_complete else ' or more'}, {len(self.dead_points)} dead points; the loops close {where}>"
        )
