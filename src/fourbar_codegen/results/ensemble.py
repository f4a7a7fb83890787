"""Ensemble: the results of many simulations of one mechanism."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError
from fourbar_codegen.interface.arguments import is_integer, name_of
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.inputs import bind, inputs_of, is_by_member
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from xarray import Dataset
else:
    Figure = Dataset = Any

__all__ = ["Ensemble", "over_members"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Ensemble:
    """Simulations of one mechanism over the same time span, members in rows.

    Attributes
    ----------
    model : CompiledModel
    t : ndarray, shape (n_t,)
        Times, s.
    y : ndarray, shape (n, n_x, n_t)
        ``y[i]`` contains the states of member i, as in a `Trajectory`; NaN after its end.
    n_events : int or None
        The number of events asked for.
    events : ndarray, shape (n_found, 3 + n_x)
        A row for each occurrence: the member, the number of the event, the time (s), and the state; sorted by events,
        members and times. `t_events` and `y_events` have them by event and member.
    status : ndarray of int, shape (n,)
        As in a `Trajectory`: 0 for members that reached the end of the time span, 1 for those that a terminal event
        ended, -1 for those that failed.
    messages : tuple of str
        Why each member ended.
    nfev : ndarray of int, shape (n,)
        Numbers of evaluations of the right-hand side.
    parameters : ndarray, shape (n, n_p)
    inputs : mapping
        Copies of the given sources of inputs.
    settings : dict
        Arguments of the runs, as in a `Trajectory`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> ensemble = four_bar.ensemble((0.0, 1.0), parameters={"k": [2.0, 3.0, 4.0]}, t_eval=[0.0, 0.5, 1.0])
    >>> ensemble.y.shape, ensemble["q1"].shape, ensemble.success.all()
    ((3, 6, 3), (3, 3), np.True_)
    """

    kernel: Kernel
    t: Floats
    y: Floats
    n_events: int | None
    events: Floats
    status: NDArray[np.int_]
    messages: tuple[str, ...]
    nfev: NDArray[np.int_]
    parameters: Floats
    inputs: Mapping[Any, Any]
    settings: Mapping[str, Any]

    model = RegisteredAttribute()
    save = Registered[[str | Path], Path]()
    plot = Registered[..., Figure]()
    to_xarray = Registered[[], Dataset]()

    def __len__(self) -> int:
        return len(self.y)

    def __getitem__(self, key: Any) -> Any:
        """A member by its number, as a `Trajectory`; or a quantity of all members by its name.

        Names are those of a `Trajectory`: a state, input, output, ``"energy"``, ... The shape is (n, n_t), for a point
        (n, 3, n_t), with NaN after the end of a member. ``"t"`` gives the times, shape (n_t,).
        """
        if is_integer(key):
            return self._member(int(key))
        if isinstance(key, slice):
            raise ModelError("Ensembles have no slices: slice ensemble.y, or index one member with a number.")
        name = name_of(key)
        if name in self.kernel.states:
            return self.y[:, self.kernel.states.index(name)]
        if name == "t":
            return self.t
        if not len(self):
            raise ModelError(f"The ensemble has no members, and {name!r} has no values.")
        return over_members(self, lambda member: member[name])

    def __contains__(self, name: object) -> bool:
        """Whether there is a quantity of this name."""
        return len(self) > 0 and name in self[0]

    def _member(self, key: int) -> Trajectory:
        n = len(self)
        if not -n <= key < n:
            raise IndexError(f"member {key} of {n}")
        member = key % n
        reached = np.isfinite(self.y[member]).all(axis=0)
        t, y, status = self.t[reached], self.y[member][:, reached], int(self.status[member])
        t_events, y_events = (
            None if of_all is None else [of_event[member] for of_event in of_all]
            for of_all in (self.t_events, self.y_events)
        )
        if status == 1 and t_events and y_events:  # the last event is the last sample
            direction = np.sign(self.settings["t_span"][1] - self.settings["t_span"][0])
            ends = [direction * times[-1] if len(times) else -np.inf for times in t_events]
            last = int(np.argmax(ends))
            if t_events[last][-1] not in t:
                t, y = np.append(t, t_events[last][-1]), np.column_stack((y, y_events[last][-1]))
        parameters, inputs = self.parameters[member].copy(), inputs_of(self.inputs, member)
        ode = bind(self.kernel, parameters, inputs)
        return Trajectory(
            kernel=self.kernel, parameters=parameters, t=t, y=y, r=ode.inputs_along(t, y), sol=None, t_events=t_events,
            y_events=y_events, nfev=int(self.nfev[member]), njev=0, nlu=0, status=status,
            message=self.messages[member], settings=dict(self.settings), inputs=inputs,
        )  # fmt: skip

    @cached_property
    def t_events(self) -> list[list[Floats]] | None:
        """For each event k and member i its times ``t_events[k][i]``, s; None if events were not asked for."""
        return self._by_event_and_member(self.events[:, 2])

    @cached_property
    def y_events(self) -> list[list[Floats]] | None:
        """For each event k and member i the states ``y_events[k][i]`` at its times, shape (n_times, n_x), or None."""
        return self._by_event_and_member(self.events[:, 3:])

    def _by_event_and_member(self, columns: Floats) -> list[list[Floats]] | None:
        if self.n_events is None:
            return None
        n = len(self)
        places = self.events[:, 1].astype(int) * n + self.events[:, 0].astype(int)
        ends = np.cumsum(np.bincount(places, minlength=self.n_events * n)).tolist()
        parts = [columns[begin:end] for begin, end in itertools.pairwise([0, *ends])]
        return [parts[k * n : (k + 1) * n] for k in range(self.n_events)]

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether each member reached the end, or a terminal event, shape (n,)."""
        return self.status >= 0

    @property
    def varied(self) -> dict[str, Floats]:
        """The parameters and inputs that differ between members, by name, each of shape (n,)."""
        return {name: values for name, values in self.by_member.items() if len(values) and (values != values[0]).any()}

    @property
    def by_member(self) -> dict[str, Floats]:
        """All parameters, and the inputs with a number for each member, by name, each of shape (n,)."""
        return {
            **dict(zip(self.kernel.parameters, self.parameters.T, strict=True)),
            **{name_of(key): source for key, source in self.inputs.items() if is_by_member(source)},
        }

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[member] for member in range(len(self)))

    def __repr__(self) -> str:
        n, name = len(self), self.kernel.name
        span = f"{self.t[0]:g} s to {self.t[-1]:g} s, {len(self.t)} times" if len(self.t) else "no times"
        failed = n - int(self.success.sum())
        varied = ", ".join(self.varied)
        return (
            f"<Ensemble of {name}: {n} members{f', {failed} failed' if failed else ''}, {span}"
            f"{f', different in {varied}' if varied else ''}>"
        )


def over_members(ensemble: Ensemble, quantity: Callable[[Trajectory], Floats]) -> Floats:
    """A quantity of each member over its times, at the times of the ensemble: shape (n, ..., n_t).

    NaN after the end of a member, whose state at a terminal event is at none of these times.
    """
    rows = [quantity(member) for member in ensemble]
    reached = np.isfinite(ensemble.y).all(axis=1).sum(axis=1).tolist()
    values = np.full((len(rows), *rows[0].shape[:-1], len(ensemble.t)), np.nan)
    for place, row, n in zip(values, rows, reached, strict=True):
        place[..., :n] = row[..., :n]
    return values
