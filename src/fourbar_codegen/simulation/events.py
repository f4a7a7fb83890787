"""Events: their definition, and what is kept of those that the driver of a run finds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.interface.arguments import finite_number, is_integer, name_of, of_time_and_state
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.enumerations import QUANTITIES, EventRow, Role, Watched
from fourbar_codegen.runtime.integrator import Run

SPACING = 0.01
"""Of the values from which the slope of an event function is found, in fractions of the step."""

TOUCHING = 1e-6
"""Of the values next to an event: with a lower slope, a function touches zero, and the time has no derivative."""

TOUCHED = (
    " The event function {} is zero at t = {:.9g}, to within rounding errors, with the same sign before and after it, "
    "which is no event."
)

__all__ = [
    "Event",
    "EventLike",
    "Watch",
    "event_row",
    "event_rows",
    "events_of",
    "named_events",
    "touched",
    "watched_quantity",
    "without_callables",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Event:
    """An event: a change of sign of a function of time and state.

    All simple roots within a step are found: the function is known there by a Chebyshev series along the interpolant.
    The function may be zero at the start, to within rounding errors: an event is a change of sign after it has left
    zero.

    Parameters
    ----------
    function : str or callable
        The name of a scalar quantity, evaluated in C: a state, input or output, or another one of
        `Trajectory.columns` that is not a constraint violation; or a function of (t, x), called at nine or more places
        of each step.
    terminal : bool or int, optional
        Whether the event ends the run; with a number n, the n-th event does.
    direction : float, optional
        Positive: only changes from negative to positive; negative: only the opposite; 0: both.
    all_roots : bool, optional
        Whether to find all roots of a step; otherwise only changes of sign between its ends, by one call a step.
    at_start : bool, optional
        Whether a zero at the start is an event, as for ``solve_ivp``, to the last digit.

    References
    ----------
    L. N. Trefethen, *Approximation Theory and Approximation Practice*, SIAM 2013, chapters 3, 4 and 18.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> run = fb.load("four_bar").simulate((0.0, 2.0), events=fb.Event("u1", direction=1), rtol=1e-9)
    >>> run.t_events[0].round(4)
    array([0.78])
    """

    function: str | Callable[[float, Floats], float]
    terminal: bool | int = False
    direction: float = 0.0
    all_roots: bool = True
    at_start: bool = False

    def __post_init__(self) -> None:
        if callable(self.function):
            of_time_and_state(self.function, "An event")
        elif not isinstance(getattr(self.function, "name", self.function), str):
            raise ModelError(f"events are callables of (t, x) or names of quantities, not {shown(self.function)}.")
        finite_number(self.direction, "an event's direction")
        if not (isinstance(self.terminal, bool | np.bool_) or is_integer(self.terminal)) or self.terminal < 0:
            raise ModelError(
                f"An event's terminal must be True, False or a number of events, not {shown(self.terminal)}."
            )
        for name in ("all_roots", "at_start"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise ModelError(f"An event's {name} must be True or False, not {shown(getattr(self, name))}.")


EventLike = Event | str | Callable[[float, Floats], float]


def events_of(model: Kernel, events: object) -> list[Event] | None:
    """The checked events of a run."""
    if events is None:
        return None
    watched = listed_events(events)
    for event in watched:
        if not callable(event.function):
            watched_quantity(model, event.function)
    return watched


def listed_events(given: Any) -> list[Event]:
    """Events, of which one or several may be given, also by names or callables alone."""
    found = []
    for event in given if isinstance(given, list | tuple) else [given]:
        if not isinstance(event, Event):
            own: Any = event
            event = Event(own, getattr(own, "terminal", False), getattr(own, "direction", 0.0))
        found.append(event if callable(event.function) else replace(event, function=name_of(event.function)))
    return found


def without_callables(events: list[Event], what: str) -> list[Event]:
    """The same events, for what contains no Python; a ModelError if one of them is a callable."""
    if any(callable(event.function) for event in events):
        raise ModelError(
            f"An event of {what} is the name of a quantity, not a callable, which cannot be put into a file: make the "
            "function an output of the model."
        )
    return events


def watched_quantity(model: Kernel, name: str) -> tuple[Watched, int]:
    """A scalar quantity by its name in `Trajectory.columns`, where names of states, inputs and outputs come first.

    Raises
    ------
    ModelError
        If there is none, or its value is not known.
    """
    for quantity, names in _quantities(model):
        if name in names:
            row = names.index(name)
            if quantity is Watched.ENERGY and row > 0 and not model.layout.potential_energy.is_known:
                raise ModelError(f"The potential energy of {model.name} is not known: {name} cannot be an event.")
            return quantity, row
    known = ", ".join(dict.fromkeys(each for _, names in _quantities(model) for each in names))
    raise ModelError(f"events are callables of (t, x) or names of quantities ({known}), not {shown(name)}.")


def _quantities(model: Kernel) -> Iterator[tuple[Watched, Sequence[str]]]:
    """The names of all scalar quantities, in the order in which they count."""
    yield Watched.STATE, model.states
    yield Watched.INPUT, model.inputs
    yield Watched.OUTPUT, model.outputs
    yield Watched.TIME, ("t",)
    yield Watched.MULTIPLIER, [f"lambda{i}" for i in range(1, model.n_l + 1)]
    yield Watched.ENERGY, ("kinetic_energy", "potential_energy", "energy")
    yield Watched.MOMENTUM, [component for vector in QUANTITIES[Role.MOMENTA] for component in vector.components]


def event_row(event: Event, quantity: Watched, number: Any) -> EventRow:
    """An event for C, where it watches one of the values of a quantity, or a callable."""
    return EventRow(
        quantity, number, int(np.sign(event.direction)), int(event.terminal), event.at_start, event.all_roots
    )


def event_rows(model: Kernel, events: Sequence[Event]) -> list[EventRow]:
    """The events of a run for C."""
    return [
        event_row(e, *((Watched.CALLABLE, e.function) if callable(e.function) else watched_quantity(model, e.function)))
        for e in events
    ]


def named_events(model: Kernel, events: Any, what: str) -> list[tuple[str, EventRow]]:
    """Events by the names of their quantities, for what contains no Python.

    Raises
    ------
    ModelError
        If one of them is a callable, or the name of no quantity.
    """
    found = without_callables(events_of(model, events) or [], what)
    return [(str(event.function), row) for event, row in zip(found, event_rows(model, found), strict=True)]


class _Slopes(NamedTuple):
    """What changes where an event occurs."""

    sensitivity: Floats
    """The derivatives of the state at a held time, shape (n_x, n)."""
    slope: float
    """Of the event function, over time: infinite where it jumps, at a time that depends on nothing."""
    rates: Floats
    """x', shape (n_x,): within the piece of the run that ends there, since it may jump."""


class Watch:
    """The events of a run, which the driver finds: their times and states.

    Parameters
    ----------
    model : Kernel
    events : sequence of Event
    differentiates : bool, optional
        Whether derivatives of times and states are needed.
    """

    def __init__(self, model: Kernel, events: Sequence[Event], *, differentiates: bool = False) -> None:
        self.events, self.differentiates, self.n_x = events, differentiates, model.n_x
        self.derivatives: list[list[_Slopes]] = [[] for _ in events]
        self.times: list[list[float]] = [[] for _ in events]
        self.states: list[list[Floats]] = [[] for _ in events]
        self.rows = event_rows(model, events)

    def look(self, run: Run) -> float | None:
        """Store the events found last; returns the fraction of the step at which one of them ends the run."""
        found = run.found
        for i, share, jumps in found:
            if self.differentiates:
                slope = math.inf if jumps else self._slope(run, i, share)
                self.derivatives[i].append(_Slopes(run.sensitivity_within(share), slope, run.rates_within(share)))
            self.times[i].append(run.time_within(share))
            self.states[i].append(run.state_within(share))
        return found[-1][1] if found and run.ended_by >= 0 else None

    def forget(self, run: Run, direction: float) -> None:
        """Drop what was found in a step that was taken back."""
        for i, times in enumerate(self.times):
            n = sum(direction * (t - run.t) <= 0.0 for t in times)
            del times[n:], self.states[i][n:], self.derivatives[i][n:]

    def state_arrays(self) -> list[Floats]:
        """The states of each event, shape (n_events, n_x)."""
        return [np.reshape(states, (len(states), self.n_x)) for states in self.states]

    def touched(self, run: Run, begin: float, end: float) -> str:
        """Sentences on functions that were zero without a change of sign, in a run from one time to another."""
        named = zip(self.events, run.touched, strict=True)
        return touched([(event, t) for event, t in named if min(begin, end) <= t <= max(begin, end)])

    def _slope(self, run: Run, i: int, share: float) -> float:
        """The derivative of an event function over time, by a difference of order 4 along the interpolant.

        Within the step: at its ends, inputs may have discontinuities.
        """
        middle = min(max(share, 2.0 * SPACING), 1.0 - 2.0 * SPACING)
        at = middle + SPACING * np.arange(-2, 3)
        values = [run.event_values_within(each)[i] for each in at]
        # the polynomial through the values, in units of the spacing from the event
        slope = float(np.linalg.solve(np.vander((at - share) / SPACING), values)[-2])
        return slope / (SPACING * run.h) if abs(slope) > TOUCHING * np.abs(values).max() else 0.0


def touched(found: Sequence[tuple[Event, float]]) -> str:
    """Sentences on functions that were zero at a time without a change of sign."""
    names = [getattr(event.function, "__name__", str(event.function)) for event, _ in found]
    return "".join(dict.fromkeys(TOUCHED.format(name, t) for name, (_, t) in zip(names, found, strict=True)))
