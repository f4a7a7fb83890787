"""Ensemble: the result of many runs of one mechanism."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import is_integer, name_of
from fourbar_codegen.errors import ModelError
from fourbar_codegen.kernel.inputs import bind, inputs_of
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.results.trajectory import Trajectory

__all__ = ["Ensemble"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Ensemble:
    """Runs of one mechanism over the same time, members in rows.

    Attributes
    ----------
    model : CompiledModel
    t : ndarray, shape (n_t,)
        Times, s.
    y : ndarray, shape (n, n_x, n_t)
        ``y[i]`` are the states of member i as those of a `Trajectory`; NaN from where it failed on.
    success : ndarray of bool, shape (n,)
        Whether each member has reached the end.
    messages : tuple of str
        Why each has ended.
    nfev : ndarray of int, shape (n,)
        Numbers of evaluations of the right-hand side.
    parameters : ndarray, shape (n, n_p)
    inputs : mapping
        Sources of the inputs as they were given, in copies.
    settings : dict
        How the runs were asked for, as of a `Trajectory`.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> ensemble = four_bar.ensemble((0.0, 1.0), parameters={"k": [2.0, 3.0, 4.0]}, t_eval=[0.0, 0.5, 1.0])
    >>> ensemble.y.shape, ensemble["q1"].shape, ensemble.success.all()
    ((3, 6, 3), (3, 3), np.True_)
    """

    model: Kernel
    t: Floats = field(repr=False)
    y: Floats = field(repr=False)
    success: NDArray[np.bool_]
    messages: tuple[str, ...] = field(repr=False)
    nfev: NDArray[np.int_] = field(repr=False)
    parameters: Floats = field(repr=False)
    inputs: Mapping[Any, Any] = field(repr=False)
    settings: Mapping[str, Any] = field(repr=False)

    def __len__(self) -> int:
        return len(self.y)

    def __getitem__(self, key: Any) -> Any:
        """A member as a `Trajectory`, by its number; or a coordinate or speed of all, shape (n, n_t), by its name."""
        if not is_integer(key):
            if isinstance(key, slice):
                raise ModelError("Members are had one by one: slice ensemble.y, or index with a number.")
            if name_of(key) in self.model.states:
                return self.y[:, self.model.states.index(name_of(key))]
            raise ModelError(f"There is no state {name_of(key)!r}; there are {', '.join(self.model.states)}.")
        n = len(self)
        if not -n <= key < n:
            raise IndexError(f"member {key} of {n}")
        member = int(key) % n
        reached = np.isfinite(self.y[member]).all(axis=0)
        t, y = self.t[reached], self.y[member][:, reached]
        parameters, inputs = self.parameters[member].copy(), inputs_of(self.inputs, member)
        ode = bind(self.model, parameters, inputs)
        success = bool(self.success[member])
        return Trajectory(
            model=self.model, parameters=parameters, t=t, y=y, r=ode.inputs_along(t, y), sol=None, t_events=None,
            y_events=None, nfev=int(self.nfev[member]), njev=0, nlu=0, status=0 if success else -1, success=success,
            message=self.messages[member], settings=dict(self.settings), inputs=inputs,
        )  # fmt: skip

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[member] for member in range(len(self)))
