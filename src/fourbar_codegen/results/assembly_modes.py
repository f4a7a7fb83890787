"""AssemblyModes: all ways to close the loops for given independent coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import is_integer
from fourbar_codegen.interface.notebook import table
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.kernel import Kernel

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any

__all__ = ["AssemblyModes"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AssemblyModes:
    """All states for the same independent coordinates and speeds.

    Returned by `CompiledModel.initial_states`. A sequence of states, sorted by their dependent coordinates, with angles
    between -pi and pi.

    Attributes
    ----------
    model : CompiledModel
    t : float
        Time, s.
    x : ndarray, shape (n, n_x)
        The states. Dependent speeds are NaN in a mode where they do not follow from the independent ones.
    is_complete : bool
        Whether there are no other modes. If False, their number is a lower bound.
    parameters, inputs : ndarray or None
        As given, in order.
    free : tuple of str
        The dependent coordinates that can move while the independent ones are held, in at least one of the modes; empty
        if modes are isolated. Otherwise they are infinitely many, and `x` has examples, found until the first that can
        move: isolated modes may be missing. Dependent speeds are NaN in those that can move.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> modes = fb.load("four_bar").initial_states({"q1": -0.5}, {"u1": -0.1})
    >>> modes
    <AssemblyModes of four_bar: 2, and no others>
    >>> modes[0].round(6).tolist()
    [-0.5, -2.246416, -1.497827, -0.1, 0.071583, -0.027469]
    """

    kernel: Kernel
    t: float
    x: Floats
    is_complete: bool
    parameters: Floats | None
    inputs: Floats | None
    free: tuple[str, ...] = ()

    model = RegisteredAttribute()
    plot = Registered[[], Figure]()

    def __getitem__(self, number: int) -> Floats:
        """The state of a mode, or of several, as NumPy selects rows."""
        try:
            if number is None or isinstance(number, bool | np.bool_):  # which would add a dimension
                raise TypeError
            state: Floats = self.x[number]
        except (TypeError, ValueError, IndexError) as error:  # NumPy's, for ragged lists, text and fractions
            if is_integer(number):
                raise  # beyond the last one: the end of an iteration
            raise ModelError(f"A mode is known by its number, below {len(self)}, not by {shown(number)}.") from error
        return state

    def __len__(self) -> int:
        """The number of modes."""
        return len(self.x)

    def __iter__(self) -> Iterator[Floats]:
        """The states of all modes."""
        return iter(self.x)

    def __repr__(self) -> str:
        return f"<AssemblyModes of {self.kernel.name}: {self._number()}>"

    def _number(self) -> str:
        if not len(self):
            return "the loops cannot be closed" if self.is_complete else "none found"
        if self.free:
            return f"{len(self)} of infinitely many; {self.freedom}"
        return f"{len(self)}, and no others" if self.is_complete else f"at least {len(self)}"

    @property
    def freedom(self) -> str:
        """The degree of freedom that is left, in words; empty if `free` is."""
        if not self.free:
            return ""
        held = self.kernel.coordinates[: self.kernel.layout.n_independent_coordinates]
        moving = f"{', '.join(self.free)} move{'s' if len(self.free) == 1 else ''}"
        fixed = f"{', '.join(held) or 'nothing'} {'are' if len(held) > 1 else 'is'} held"
        return f"a degree of freedom is left: {moving} while {fixed}"

    def _repr_html_(self) -> str:
        rows = [(f"{i}", *(f"{value:.6g}" for value in x)) for i, x in enumerate(self.x)]
        return table(f"Assembly modes of {self.kernel.name}: {self._number()}", ("mode", *self.kernel.states), rows)
