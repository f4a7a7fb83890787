"""Events: their definition, and their detection in each step of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import finite_number, is_integer, name_of, number, of_time_and_state
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Run

SPACING = 0.01
"""Of the values from which the slope of an event function is found, in fractions of the step."""

CONTINUOUS = 1e-9
"""Of the change over the last step: a smaller one at a discontinuity is a rounding error."""

TOUCHING = 1e-6
"""Of the values next to an event: with a lower slope, a function touches zero, and the time has no derivative."""

MOST_ITERATIONS = 10_000
"""Of Brent's method, which needs thousands at a triple root."""

__all__ = ["Event", "EventLike", "Watch", "events_of"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Event:
    """An event: a sign change of a function.

    Parameters
    ----------
    function : str or callable
        The name of an output, evaluated in C; or a function of (t, x).
    terminal : bool or int, optional
        Whether the event ends the run; with a number n, the n-th event does.
    direction : float, optional
        Positive: only changes from negative to positive; negative: only the opposite; 0: both.
    """

    function: str | Callable[[float, Floats], float]
    terminal: bool | int = False
    direction: float = 0.0

    def __post_init__(self) -> None:
        if callable(self.function):
            of_time_and_state(self.function, "An event")
        elif not isinstance(getattr(self.function, "name", self.function), str):
            raise ModelError(f"events are callables of (t, x) or names of outputs, not {shown(self.function)}.")
        finite_number(self.direction, "an event's direction")
        if not (isinstance(self.terminal, bool | np.bool_) or is_integer(self.terminal)) or self.terminal < 0:
            raise ModelError(
                f"An event's terminal must be True, False or a number of events, not {shown(self.terminal)}."
            )


EventLike = Event | str | Callable[[float, Floats], float]


def events_of(model: Kernel, events: object) -> list[Event] | None:
    """The checked events of a run."""
    if events is None:
        return None
    watched = []
    for event in events if isinstance(events, list | tuple) else [events]:
        if not isinstance(event, Event):
            given: Any = event
            event = Event(given, getattr(given, "terminal", False), getattr(given, "direction", 0.0))
        if not callable(event.function):
            name = name_of(event.function)
            if name not in model.outputs:
                known = ", ".join(model.outputs) or "none"
                raise ModelError(
                    f"events are callables of (t, x) or names of outputs ({known}), not {shown(event.function)}."
                )
            event = replace(event, function=name)
        watched.append(event)
    return watched


class _Slopes(NamedTuple):
    """What changes where an event occurs."""

    sensitivity: Floats
    """The derivatives of the state at a held time, shape (n_x, n)."""
    slope: float
    """Of the event function, over time."""
    rates: Floats
    """x', shape (n_x,): within the piece of the run that ends there, since it may jump."""


class Watch:
    """Event detection as in ``solve_ivp``: in each step, with Brent's method on the interpolant."""

    def __init__(self, model: Kernel, events: Sequence[Event], *, differentiates: bool = False) -> None:
        self.events, self.differentiates = events, differentiates
        self.derivatives: list[list[_Slopes]] = [[] for _ in events]
        self.times: list[Any] = [[] for _ in events]
        self.states: list[Any] = [[] for _ in events]
        self.callables = [(i, e.function) for i, e in enumerate(events) if callable(e.function)]
        self.named = [i for i, e in enumerate(events) if not callable(e.function)]
        self.outputs = [
            (model.outputs.index(events[i].function), int(np.sign(events[i].direction))) for i in self.named
        ]
        self.values = [0.0] * len(events)
        self.ended_by = ""
        """The function of the terminal event that has ended the run: its name."""
        self.went_on = math.nan
        """Start of the current piece of the run, after a discontinuity."""
        self.changes = [0.0] * len(events)
        """Over the last step of the piece before, of functions that are outputs."""
        self.at_end: list[_Slopes] = []
        """At the end of that step, for functions that are outputs."""
        self.left = math.nan
        """The time of that end."""

    def begin(self, run: Run) -> None:
        """Evaluate the functions at the start."""
        for place, i in enumerate(self.named):
            self.values[i] = run.event_values[1][place]
        for i, function in self.callables:
            self.values[i] = self._call(function, run.t, run.x)

    def _call(self, function: Callable[[float, Floats], float], t: float, x: Floats) -> float:
        return number(function(t, x), "The value of an event's callable")

    def look(self, run: Run) -> float | None:
        """Store the events of the last step; returns the fraction of the step at which a terminal event occurs."""
        before = self._move_on(run)
        for share, i in sorted((self._root(run, i, before[i]), i) for i in self._changed(before)):
            if share == 0.0 and self.times[i] and self.times[i][-1] == self.went_on == run.time_within(share):
                continue  # already found at the end of the previous piece
            if self.differentiates:
                self.derivatives[i].append(self._slopes(run, i, share))
            if self._note(i, run.time_within(share), run.state_within(share)):
                return share
        return None

    def leave(self, run: Run) -> None:
        """Keep what `across` needs of the last step before a discontinuity."""
        self.left = run.t
        for i, start, end in zip(self.named, *run.event_values, strict=True):
            self.changes[i] = abs(end - start)
        if self.differentiates:
            self.at_end = [self._slopes(run, i, 1.0) for i in self.named]

    def across(self, run: Run) -> bool:
        """Store the events at a discontinuity, after it; returns whether one of them is terminal."""
        before, self.went_on = self._move_on(run), run.t
        terminal = False
        for i in self._changed(before):
            change = abs(self.values[i] - before[i])
            is_continuous = change <= CONTINUOUS * self.changes[i]
            if change == 0.0 or (is_continuous and self.times[i] and self.times[i][-1] == self.left):
                continue  # found in the step before
            if self.differentiates:
                at = self.at_end[self.named.index(i)]
                # a jump is at a time that depends on nothing
                jump = _Slopes(run.sensitivity_within(1.0), math.inf, run.rates_within(1.0))
                self.derivatives[i].append(at if is_continuous else jump)
            terminal |= self._note(i, run.t, run.x)
        return terminal

    def _slopes(self, run: Run, i: int, share: float) -> _Slopes:
        return _Slopes(run.sensitivity_within(share), self._slope(run, i, share), run.rates_within(share))

    def _slope(self, run: Run, i: int, share: float) -> float:
        """The derivative of an event function over time, by a difference of order 4 along the interpolant.

        Within the step: at its ends, inputs may have discontinuities.
        """
        place = self.named.index(i)
        middle = min(max(share, 2.0 * SPACING), 1.0 - 2.0 * SPACING)
        at = middle + SPACING * np.arange(-2, 3)
        values = [run.event_values_within(each)[place] for each in at]
        # the polynomial through the values, in units of the spacing from the event
        slope = float(np.linalg.solve(np.vander((at - share) / SPACING), values)[-2])
        return slope / (SPACING * run.h) if abs(slope) > TOUCHING * np.abs(values).max() else 0.0

    def _move_on(self, run: Run) -> list[float]:
        """Evaluate the functions at the current state; returns their previous values."""
        before = list(self.values)
        for place, i in enumerate(self.named):  # intermediate steps were not checked
            before[i] = run.event_values[0][place]
        self.begin(run)
        return before

    def _changed(self, before: Sequence[float]) -> list[int]:
        """The events with a sign change."""
        found = []
        for i, event in enumerate(self.events):
            up, down = before[i] <= 0.0 <= self.values[i], before[i] >= 0.0 >= self.values[i]
            if (up and event.direction >= 0) or (down and event.direction <= 0):
                found.append(i)
        return found

    def _note(self, i: int, t: float, x: Floats) -> bool:
        """Store an event; returns whether it ends the run."""
        self.times[i].append(t)
        self.states[i].append(x)
        terminal, function = self.events[i].terminal, self.events[i].function
        ends = bool(terminal) and len(self.times[i]) >= int(terminal)
        if ends:
            self.ended_by = getattr(function, "__name__", str(function))
        return ends

    def _root(self, run: Run, i: int, before: float) -> float:
        """The fraction of the last step at which a function is zero."""
        from scipy.optimize import brentq

        known = {0.0: before, 1.0: self.values[i]}

        def value(share: float) -> float:
            if share in known:
                return known[share]
            if i in self.named:
                return float(run.event_values_within(share)[self.named.index(i)])
            function: Any = self.events[i].function
            return self._call(function, run.time_within(share), run.state_within(share))

        precision = 4 * np.finfo(float).eps
        return float(brentq(value, 0.0, 1.0, xtol=precision, rtol=precision, maxiter=MOST_ITERATIONS))
