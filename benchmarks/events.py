"""What events cost: four-bars with a function that changes its sign nowhere or once, against runs without events."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from measure import call, circumstances, compare, options_of, publish, timed

import fourbar_codegen as fb

MEMBERS, SPAN = 10_000, (0.0, 4.0)
STEP, STEPS = 1e-3, 1000


def linkage() -> fb.CompiledModel:
    """The four-bar linkage, with an output that changes its sign nowhere, and one that does once, at about 2.3 s."""
    model, t = fb.models.four_bar(), me.dynamicsymbols._t
    outputs = {"never": sm.sin(model.system.q[0]) - 2, "once": t - 2.3 + sm.sin(model.system.q[0]) / 10}
    force = {me.dynamicsymbols("F"): 100 * sm.sin(sm.pi * t)}
    how = {"parameters": model.parameters, "initial": model.initial, "inputs": force}
    return fb.compile_model(fb.Model(model.system, name="four_bar_with_outputs", outputs=outputs, **how))


def rows(model: fb.CompiledModel) -> dict[str, dict[str, Callable[[], float]]]:
    """For each kind of run the measures without events, with none found, and with one found."""
    x0, k = model.initial_state(), np.linspace(90.0, 110.0, MEMBERS)
    events = {"without": None, "none": "never", "one": "once"}
    callables = {"without": None, "none": lambda _, x: x[0] - 9.0, "one": lambda t, x: t - 2.3 + 0.1 * np.sin(x[0])}

    def alone(event: Any) -> Callable[[], float]:
        return call(lambda: model.simulate(SPAN, x0, events=event))

    def together(method: str, event: Any) -> Callable[[], float]:
        how: dict[str, Any] = {"parameters": {"k": k}, "method": method, "events": event, "progress": False}
        found = model.ensemble(SPAN, np.tile(x0, (MEMBERS, 1)), **how).t_events
        assert event is None or sum(map(len, found[0])) == (MEMBERS if event == "once" else 0)
        return lambda: timed(lambda: model.ensemble(SPAN, np.tile(x0, (MEMBERS, 1)), **how))

    def steps(event: Any) -> Callable[[], float]:
        def run() -> None:
            stepper = model.stepper(STEP, x0, t=2.0, events=event)
            for _ in range(STEPS):
                stepper.step()

        return lambda: timed(run)

    found = {
        "`simulate`, by an output": {name: alone(event) for name, event in events.items()},
        "`simulate`, by a callable": {name: alone(event) for name, event in callables.items()},
        f"{STEPS} steps of a stepper": {name: steps(event) for name, event in events.items()},
    }
    for method in ("DOP853", "RK45", "Tsit5"):
        found[f"`ensemble` of {MEMBERS} members, {method}"] = {n: together(method, e) for n, e in events.items()}
    return found


def main() -> None:
    options = options_of(__doc__)
    lines = ["| | without | none found | one found | ratios |", "|---|---:|---:|---:|---:|"]
    seconds = {}
    for name, measures in rows(linkage()).items():
        times = seconds[name] = compare(*measures.values(), rounds=options.rounds)
        cells = [f"{1e3 * time:.3g} ms" for time in times] + [f"{times[1] / times[0]:.2f}, {times[2] / times[0]:.2f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    publish(options, "events", "\n".join(lines), {**circumstances(), "seconds": seconds})


if __name__ == "__main__":
    main()
