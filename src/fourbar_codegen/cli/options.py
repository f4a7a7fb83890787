"""Options of runs: numbers, expressions and ranges by name, and their conversion to arguments of `CompiledModel`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

import fourbar_codegen as fb
from fourbar_codegen.cli.arithmetic import Arithmetic, parse
from fourbar_codegen.cli.models import MODEL
from fourbar_codegen.runtime.enumerations import STEP_CONTROLLED

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from fourbar_codegen import CompiledModel

__all__ = [
    "MAX_MEMBERS",
    "METHODS",
    "PAGE_OPTIONS",
    "RUN_OPTIONS",
    "SWEEP_OPTIONS",
    "initial_state",
    "input_sources",
    "number",
    "with_options",
]

SWEEP_METHODS = (*STEP_CONTROLLED, "ALI3P")
"""Of ensembles."""

METHODS = (*SWEEP_METHODS, "CVODE", "IDA")
"""Of single runs."""

MAX_MEMBERS = 1_000_000
"""Largest number of members of a sweep."""

Texts = dict[str, str]


def _pairs(_: click.Context, __: click.Parameter, texts: tuple[str, ...]) -> Texts:
    """NAME=TEXT options as a dictionary."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise click.BadParameter(f"{text!r} is not NAME=VALUE, such as NAME=0.45.")
        if name.strip() in pairs:
            raise click.BadParameter(f"{name.strip()} is given twice.")
        pairs[name.strip()] = value.strip()
    return pairs


def number(name: str, text: str) -> float:
    """The value of a constant expression."""
    try:
        return float(text)
    except ValueError:
        pass
    if ":" in text or "," in text:
        raise click.BadParameter(f"{name}={text} is a range, which only -p of fourbar sweep takes: give a number.")
    try:
        return parse(text, ())({})
    except fb.ModelError as error:
        raise click.BadParameter(
            f"{name}={text} is not NAME=VALUE with a number, such as {name}=0.45: {error}"
        ) from error


def _numbers(context: click.Context, option: click.Parameter, texts: tuple[str, ...]) -> dict[str, float]:
    """NAME=VALUE options, numbers or constant expressions."""
    return {name: number(name, text) for name, text in _pairs(context, option, texts).items()}


def _ranges(
    context: click.Context, option: click.Parameter, texts: tuple[str, ...]
) -> dict[str, float | NDArray[np.float64]]:
    """NAME=VALUE, NAME=FIRST:LAST:N or NAME=VALUE,VALUE,... options."""
    import numpy as np  # not for help and completion, which are quicker without it

    found: dict[str, Any] = {}
    for name, text in _pairs(context, option, texts).items():
        if ":" in text:
            parts = text.split(":")
            if len(parts) != 3 or not parts[2].strip().isdecimal() or not 1 <= int(parts[2]) <= MAX_MEMBERS:
                raise click.BadParameter(f"{name}={text} is not FIRST:LAST:N, such as {name}=0.4:0.5:11.")
            found[name] = np.linspace(number(name, parts[0]), number(name, parts[1]), int(parts[2]))
        elif "," in text:
            found[name] = np.array([number(name, part) for part in text.split(",")])
        else:
            found[name] = number(name, text)
    return found


def _steps(_: click.Context, __: click.Parameter, text: str) -> int | str | None:
    """A number of steps, "auto", or None for no limit."""
    if text.lower() == "none":
        return None
    return int(text) if text.isdecimal() else text


class _Time(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions alone
    """One of the two times of a run."""

    name = "time"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """A number, or an error that shows what the option looks like."""
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number. Give the first and the last time in s: -t 0 4.", param, ctx)


AN_EXPRESSION = 'An input: a number, or an expression in t and parameters such as -r "F=50*sin(2*pi*t)"; repeatable.'
A_NUMBER = "What an input begins as: a number, such as -r F=0; otherwise the model's own expression. Repeatable."


def _conditions(an_input: str = AN_EXPRESSION) -> list[Callable[..., Any]]:
    """The options that all runs have in common: initial values, inputs and the time."""
    return [
        click.option(
            "-i", "--initial", multiple=True, callback=_pairs, metavar="NAME=VALUE",
            help="Initial value of an independent coordinate or speed or an auxiliary state, or guess of a dependent "
            "coordinate; repeatable. With the name of an input, the same as -r.",
        ),
        click.option(
            "-r", "--input", "inputs", multiple=True, callback=_pairs, metavar="NAME=EXPRESSION",
            help=an_input,
        ),
        click.option(
            "-t", "--time", "t_span", nargs=2, type=_Time(), default=(0.0, 4.0), show_default="0 4",
            metavar="FIRST LAST", help="First and last time, s.",
        ),
    ]  # fmt: skip


def _method(methods: tuple[str, ...]) -> Callable[..., Any]:
    return click.option("--method", type=click.Choice(methods), default="DOP853", show_default=True)


def _accuracy(constraints: tuple[str, ...]) -> list[Callable[..., Any]]:
    return [
        click.option(
            "--constraints", type=click.Choice(constraints), default="project", show_default=True,
            help="Constraint stabilization; project is mass-orthogonal projection of each state.",
        ),
        click.option("--rtol", default=1e-6, show_default=True, help="Relative tolerance."),
        click.option("--atol", default=1e-9, show_default=True, help="Absolute tolerance."),
        click.option("--max-step", default=math.inf, help="Longest step, s; the step of ALI3P."),
        click.option(
            "--max-steps", default="auto", show_default=True, metavar="N|auto|none", callback=_steps,
            help=f"Largest number of steps: by default 1,000,000 for {', '.join(SWEEP_METHODS)}, 100,000 for "
            "others, or ten times the number that --max-step requires, if that is more.",
        ),
    ]  # fmt: skip


_MODEL_AND_PARAMETERS = [
    MODEL,
    click.option(
        "-p", "--parameter", "parameters", multiple=True, callback=_numbers, metavar="NAME=VALUE",
        help="Override a parameter, such as -p l2=0.45; repeatable.",
    ),
]  # fmt: skip

PAGE_OPTIONS = [*_MODEL_AND_PARAMETERS, *_conditions(A_NUMBER), _method(STEP_CONTROLLED)]

RUN_OPTIONS = [
    *_MODEL_AND_PARAMETERS,
    *_conditions(),
    _method(METHODS),
    click.option(
        "--formulation", type=click.Choice(["gear-gupta-leimkuhler", "index-1", "index-3"]),
        help="Formulation of IDA; the first is the default.",
    ),
    *_accuracy(("project", "baumgarte", "none")),
]  # fmt: skip

SWEEP_OPTIONS = [
    MODEL,
    click.option(
        "-p", "--parameter", "parameters", multiple=True, callback=_ranges, metavar="NAME=RANGE",
        help="A parameter as FIRST:LAST:N (N equally spaced values), as VALUE,VALUE,... or as a number; repeatable. "
        "With several ranges, all combinations are run.",
    ),
    *_conditions(),
    _method(SWEEP_METHODS),
    *_accuracy(("project", "none")),
]  # fmt: skip


def with_options(options: list[Callable[..., Any]]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that adds these options to a command."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        for option in reversed(options):
            command = option(command)
        return command

    return decorate


@dataclass(frozen=True)
class InputExpression:
    """An input as an expression of time, with the values of its parameters."""

    expression: Arithmetic
    parameters: Mapping[str, float]

    def __call__(self, t: float, _: object) -> float:
        """The input at a time."""
        return self.expression({**self.parameters, "t": t})


def input_sources(
    compiled: CompiledModel, inputs: Texts, parameters: Mapping[str, Any], t: float
) -> dict[str, float | InputExpression]:
    """Inputs as `CompiledModel.simulate` takes them: numbers, or functions of time, which have a value at the time t.

    Raises
    ------
    ModelError
        If an expression contains a name that is neither t nor a parameter, or a parameter that is swept.
    """
    values = {**compiled.defaults, **parameters}
    sources: dict[str, float | InputExpression] = {}
    for name, text in inputs.items():
        expression = parse(text, ("t", *compiled.parameters))
        used = {parameter: values[parameter] for parameter in expression.names - {"t"}}
        swept = sorted(parameter for parameter, value in used.items() if hasattr(value, "shape"))
        if swept:
            raise fb.ModelError(f"{name}={text} contains {', '.join(swept)}, which the sweep varies: give a number.")
        missing = sorted(parameter for parameter, value in used.items() if value is None)
        if missing:
            raise fb.ModelError(f"{name}={text} contains {', '.join(missing)}, which has no value: give one with -p.")
        source = InputExpression(expression, used)
        first = source(t, None)  # raises if it has no value
        sources[name] = source if "t" in expression.names else first
    return sources


def initial_state(
    compiled: CompiledModel, initial: Mapping[str, float], t: float, parameters: Mapping[str, float], inputs: Any
) -> Any:
    """An initial state from values by name, with the arguments of `CompiledModel.initial_state` that they belong to."""
    n_qi = compiled.layout.n_independent_coordinates
    n_ui = compiled.layout.n_independent_speeds
    groups = (
        compiled.coordinates[:n_qi],
        compiled.speeds[:n_ui],
        compiled.coordinates[n_qi:],
        compiled.auxiliary_states,
    )
    unknown = sorted(set(initial) - {name for group in groups for name in group})
    if unknown:
        raise fb.ModelError(
            f"No initial value can be given for {', '.join(unknown)}: give independent coordinates "
            f"({', '.join(groups[0])}), independent speeds ({', '.join(groups[1])}), guesses of dependent "
            f"coordinates ({', '.join(groups[2]) or 'none'}) or auxiliary states ({', '.join(groups[3]) or 'none'})."
        )
    coordinates, speeds, guess, z = (
        {name: initial[name] for name in group if name in initial} or None for group in groups
    )
    return compiled.initial_state(
        coordinates, speeds, t=t, guess=guess, parameters=parameters, auxiliary_states=z, inputs=inputs
    )
