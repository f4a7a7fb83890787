"""Events: their definition, and their detection in each step of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.arguments import finite_number, name_of, number, of_time_and_state
from fourbar_codegen.errors import ModelError, shown
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.runtime.integrator import Run
from fourbar_codegen.simulation.run_protocol import Integration

SPACING = 0.01
"""Of the values from which the slope of an event function is found, in fractions of the step."""

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
        finite_number(self.direction, "an event's direction")
        if not isinstance(self.terminal, int) or self.terminal < 0:
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
                    f"events must be callables of (t, x) or names of outputs ({known}), not {shown(event.function)}."
                )
            event = replace(event, function=name)
        else:
            of_time_and_state(event.function, "An event")
        watched.append(event)
    return watched


class Watch:
    """Event detection as in ``solve_ivp``: in each step, with Brent's method on the interpolant."""

    def __init__(self, model: Kernel, events: Sequence[Event], *, differentiates: bool = False) -> None:
        self.events, self.differentiates = events, differentiates
        self.derivatives: list[list[tuple[Floats, float]]] = [[] for _ in events]
        """For each event, the derivatives of the state at a held time, (n_x, n), and the function's slope over time."""
        self.times: list[Any] = [[] for _ in events]
        self.states: list[Any] = [[] for _ in events]
        self.callables = [(i, e.function) for i, e in enumerate(events) if callable(e.function)]
        self.named = [i for i, e in enumerate(events) if not callable(e.function)]
        self.outputs = [
            (model.outputs.index(events[i].function), int(np.sign(events[i].direction))) for i in self.named
        ]
        self.values = [0.0] * len(events)
        self.went_on = math.nan
        """Start of the current piece of the run, after a discontinuity."""

    def begin(self, run: Integration) -> None:
        """Evaluate the functions at the start."""
        for place, i in enumerate(self.named):
            self.values[i] = run.event_values[1][place]
        for i, function in self.callables:
            self.values[i] = self._call(function, run.t, run.x)

    def _call(self, function: Callable[[float, Floats], float], t: float, x: Floats) -> float:
        return number(function(t, x), "The value of an event's callable")

    def look(self, run: Integration) -> float | None:
        """Store the events of the last step; returns the fraction of the step at which a terminal event occurs."""
        before = self._move_on(run)
        for share, i in sorted((self._root(run, i, before[i]), i) for i in self._changed(before)):
            if share == 0.0 and self.times[i] and self.times[i][-1] == self.went_on == run.time_within(share):
                continue  # already found at the end of the previous piece
            if self.differentiates and isinstance(run, Run):
                self.derivatives[i].append((run.sensitivity_within(share), self._slope(run, i, share)))
            if self._note(i, run.time_within(share), run.state_within(share)):
                return share
        return None

    def across(self, run: Integration) -> bool:
        """Store the events of a jump of the state; returns whether one of them is terminal."""
        before, self.went_on = self._move_on(run), run.t
        changed = [i for i in self._changed(before) if before[i] != self.values[i]]
        ends = [self._note(i, run.t, run.x) for i in changed]
        if self.differentiates and isinstance(run, Run):
            for i in changed:  # at a time that depends on nothing
                self.derivatives[i].append((run.sensitivity_within(1.0), math.inf))
        return any(ends)

    def _slope(self, run: Run, i: int, share: float) -> float:
        """The derivative of an event function over time, by a difference of order 4 along the interpolant."""
        place = self.named.index(i)
        far, near = (
            float(run.event_values_within(share + distance)[place] - run.event_values_within(share - distance)[place])
            for distance in (2.0 * SPACING, SPACING)
        )
        return (8.0 * near - far) / (12.0 * SPACING * run.h)

    def _move_on(self, run: Integration) -> list[float]:
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
        terminal = self.events[i].terminal
        return bool(terminal) and len(self.times[i]) >= int(terminal)

    def _root(self, run: Integration, i: int, before: float) -> float:
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
        return float(brentq(value, 0.0, 1.0, xtol=precision, rtol=precision))
