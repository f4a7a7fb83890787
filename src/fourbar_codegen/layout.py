"""What code generation and simulation know of a compiled model.

`Layout` is its description, the manifest, which JSON text carries from one half to the other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Self, TypeVar

from fourbar_codegen.errors import ModelError

__all__ = [
    "BodyShapes",
    "Breakpoints",
    "Constraints",
    "Dependencies",
    "Drawing",
    "Form",
    "Formulas",
    "Input",
    "Json",
    "Layout",
    "Operations",
    "Parameter",
    "Point",
    "PotentialEnergy",
    "Shape",
    "ShapeKind",
    "StateJump",
]


class Form(StrEnum):
    """How accelerations are solved for."""

    DENSE = "dense"
    SPARSE = "sparse"
    RECURSIVE = "recursive"


class ShapeKind(StrEnum):
    """What is drawn."""

    GROUND = "ground"
    LINK = "link"
    SLIDER = "slider"
    SPRING = "spring"
    DAMPER = "damper"
    ACTUATOR = "actuator"
    LINE = "line"


FORMAT = 23
"""Of the manifest's JSON text."""

NUMBERS = ("fingerprint", "initial", "operations", "operations_before_sharing", "compared", "body_shapes")
"""Parts of the manifest that the C code does not depend on; nor does it on parameters' values, units, descriptions."""

Json = None | bool | int | float | str | Sequence["Json"] | Mapping[str, "Json"]
"""What JSON can hold."""

BodyShapes = Mapping[str, Sequence[Mapping[str, Json]]]
"""Shapes by the names of bodies, as data."""


@dataclass(frozen=True)
class Parameter:
    """A parameter.

    Attributes
    ----------
    name : str
    default : float or None
    unit, description : str
    range : tuple of float or None
        Its least and largest value.
    """

    name: str
    default: float | None
    unit: str
    description: str
    range: tuple[float, float] | None


@dataclass(frozen=True)
class Input:
    """An input, or a rate of one that prescribes a motion.

    Attributes
    ----------
    name : str
    expression : str or None
        What it is where it is not given.
    of : str
        The name of the input of which it is a rate; its own otherwise.
    order : int
        Of the rate: 0 for an input itself.
    is_prescribed : bool
        Whether it prescribes a motion: positions, velocities or constraints depend on it.
    """

    name: str
    expression: str | None
    of: str
    order: int
    is_prescribed: bool


@dataclass(frozen=True)
class Formulas:
    """Expressions as plain data; see ``expressions/formulas.py``.

    Attributes
    ----------
    operations : sequence of list
        Each refers to earlier ones by their numbers.
    results : sequence of list
        An operation and a factor for each expression.
    """

    operations: Sequence[Json]
    results: Sequence[Json]


@dataclass(frozen=True)
class Constraints:
    """Position and velocity constraints.

    Attributes
    ----------
    positions : Formulas
        Phi.
    position_rows : tuple of (int or None)
        For each position constraint the row of J that keeps it; None for invariants and redundant constraints.
    invariants : tuple of int
        The position constraints whose rates are zero for all speeds.
    are_stated : bool
        Whether the model states velocity constraints of its own for position constraints.
    velocity_rows : tuple of int
        The rows of J that keep no position constraint.
    """

    positions: Formulas
    position_rows: tuple[int | None, ...]
    invariants: tuple[int, ...]
    are_stated: bool
    velocity_rows: tuple[int, ...]


@dataclass(frozen=True)
class StateJump:
    """A jump of the equations of motion, or of the expression of an input, where a function of the state switches.

    Attributes
    ----------
    function : str
        Such as "sign of u1".
    input : str
        The name of the input in whose expression it stands, or "".
    by_default : bool
        Whether it jumps with the known values of parameters, not only with others.
    known : bool
        Whether it is known that it jumps: not where the rows have no real value at any of the random states.
    """

    function: str
    input: str
    by_default: bool
    known: bool


@dataclass(frozen=True)
class Breakpoints:
    """Where expressions are not smooth.

    Attributes
    ----------
    n : int
        The number of breakpoints, as far as these follow from parameters.
    n_motion_breakpoints : int
        How many of them, the first ones, are those of positions or velocities.
    conditions : tuple of str
        What the equations of motion jump at, such as "sign of u1 - v", in the order of the values of FB_CONDITIONS.
    state_jumps : tuple of StateJump
        At times that are not known beforehand.
    """

    n: int
    n_motion_breakpoints: int
    conditions: tuple[str, ...]
    state_jumps: tuple[StateJump, ...]


@dataclass(frozen=True)
class Point:
    """A drawn point.

    Attributes
    ----------
    name : str
        Empty for some.
    body : str or None
        The body whose mass centre it is.
    """

    name: str
    body: str | None


@dataclass(frozen=True)
class Shape:
    """A part of the picture.

    Attributes
    ----------
    kind : ShapeKind
    name : str
        That of the bodies, or of the frame of a link without mass.
    points : tuple of int
        Numbers of drawn points. The ground and links have any number, with constant distances. A slider has three: the
        one that slides, one on its guide, and one in the direction of the guide from there. The others go from point to
        point.
    """

    kind: ShapeKind
    name: str
    points: tuple[int, ...]


@dataclass(frozen=True)
class Drawing:
    """The picture.

    Attributes
    ----------
    points : tuple of Point
    shapes : tuple of Shape
    not_drawn : tuple of str
        Points whose position relative to a fixed point is not known.
    is_at_rest : bool
        Whether the point that positions are relative to stays at rest; a wheel's contact point does not.
    forced_points : tuple of int
        Those on which forces of inputs act.
    bodies : tuple of str
        Those with a frame whose orientation is known, then frames that have shapes of their own.
    gravity : tuple of float or None
        Its direction.
    body_shapes : dict of str to sequence
        The shapes that were given for bodies and frames, as data; see ``body_shapes.py``.
    """

    points: tuple[Point, ...]
    shapes: tuple[Shape, ...]
    not_drawn: tuple[str, ...]
    is_at_rest: bool
    forced_points: tuple[int, ...]
    bodies: tuple[str, ...]
    gravity: tuple[float, ...] | None
    body_shapes: BodyShapes


@dataclass(frozen=True)
class PotentialEnergy:
    """What is known of the potential energy.

    Attributes
    ----------
    is_known : bool
    without : tuple of str
        Springs that it leaves out.
    """

    is_known: bool
    without: tuple[str, ...]


@dataclass(frozen=True)
class Dependencies:
    """What depends on what.

    Attributes
    ----------
    rows : dict of str to tuple of int
        For each row of a result what it depends on, as bits: x, p, r, u', the multipliers, and t.
    timed : tuple of str
        Parameters and inputs in terms that depend on time explicitly, or by an input's expression.
    timed_by : dict of str to tuple of str
        Those in terms that depend on each input.
    """

    rows: Mapping[str, tuple[int, ...]]
    timed: tuple[str, ...]
    timed_by: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True)
class Operations:
    """Numbers of operations of functions, by their names; of products with directions for one direction.

    Attributes
    ----------
    counts : dict of str to int
    before_sharing : dict of str to int
        If every result were written out in full, without common subexpressions.
    """

    counts: Mapping[str, int]
    before_sharing: Mapping[str, int]


@dataclass(frozen=True)
class Layout:
    """The description of a compiled model: what its arrays hold, in order, and what is known of it.

    Attributes
    ----------
    name : str
    fingerprint : str
        The digest of everything that the model's equations depend on.
    form : Form
    coordinates, speeds : tuple of str
        Names; independent ones first.
    auxiliary_states : tuple of str
    n_dependent_coordinates, n_dependent_speeds : int
    angles : tuple of str
        The coordinates that are angles.
    parameters : tuple of Parameter
    derived_parameters : dict of str to str
        Expressions of other parameters.
    geometry : tuple of str
        The parameters that positions, velocity constraints and q' depend on: lengths, not masses.
    inputs : tuple of Input
    outputs, undetermined_outputs : tuple of str
        Names; those with multipliers that redundant constraints leave undetermined.
    constraints : Constraints
    breakpoints : Breakpoints
    drawing : Drawing
    potential_energy : PotentialEnergy
    initial : dict of str to float
        Values of coordinates, speeds and auxiliary states, as far as the model has them.
    warnings : tuple of str
    compared : int or None
        At how many random states the compiled functions were compared with the equations.
    dependencies : Dependencies
    operations : Operations
    """

    name: str
    fingerprint: str
    form: Form
    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    auxiliary_states: tuple[str, ...]
    n_dependent_coordinates: int
    n_dependent_speeds: int
    angles: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    derived_parameters: Mapping[str, str]
    geometry: tuple[str, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[str, ...]
    undetermined_outputs: tuple[str, ...]
    constraints: Constraints
    breakpoints: Breakpoints
    drawing: Drawing
    potential_energy: PotentialEnergy
    initial: Mapping[str, float]
    warnings: tuple[str, ...]
    compared: int | None
    dependencies: Dependencies
    operations: Operations

    def with_body_shapes(self, shapes: BodyShapes) -> Self:
        """The layout with other shapes of bodies."""
        return replace(self, drawing=replace(self.drawing, body_shapes=shapes))

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the coordinates, the speeds and the auxiliary states."""
        return (*self.coordinates, *self.speeds, *self.auxiliary_states)

    @property
    def n_independent_coordinates(self) -> int:
        """The number of coordinates, which come first, that do not follow from the others."""
        return len(self.coordinates) - self.n_dependent_coordinates

    @property
    def n_independent_speeds(self) -> int:
        """The number of speeds, which come first, that do not follow from the others."""
        return len(self.speeds) - self.n_dependent_speeds

    @cached_property
    def prescribed(self) -> tuple[str, ...]:
        """The inputs that prescribe a motion, in order."""
        prescribed = {entry.of for entry in self.inputs if entry.is_prescribed}
        return tuple(dict.fromkeys(entry.of for entry in self.inputs if entry.order or entry.of in prescribed))

    @property
    def prescribed_places(self) -> list[int]:
        """Numbers of the inputs, also of rates, that positions, velocities or constraints depend on."""
        return [place for place, entry in enumerate(self.inputs) if entry.is_prescribed]

    @property
    def own_inputs(self) -> tuple[str, ...]:
        """The inputs without their rates."""
        return tuple(entry.name for entry in self.inputs if not entry.order)

    @cached_property
    def has_rates(self) -> frozenset[str]:
        """The inputs whose rates are inputs too."""
        return frozenset(entry.of for entry in self.inputs if entry.order)

    @property
    def structure(self) -> dict[str, Json]:
        """What the C code depends on, as data for JSON; see `numbers`."""
        data = self.to_json()
        parameters: list[Json] = [{"name": parameter.name} for parameter in self.parameters]
        return {key: value for key, value in data.items() if key not in NUMBERS} | {"parameters": parameters}

    @property
    def numbers(self) -> dict[str, Json]:
        """The rest, which other models with the same C code may have otherwise."""
        data = self.to_json()
        parameters: list[Json] = [
            {"default": p.default, "unit": p.unit, "description": p.description, "range": _listed(p.range)}
            for p in self.parameters
        ]
        return {key: data[key] for key in NUMBERS} | {"parameters": parameters}

    @classmethod
    def from_parts(cls, structure: str | bytes, numbers: str | bytes) -> Self:
        """That of `structure` and `numbers`, as JSON text.

        Raises
        ------
        ModelError, TypeError, KeyError, ValueError
            If a part is missing or of another kind.
        """
        data, more = _object(json.loads(structure)), _object(json.loads(numbers))
        pairs = zip(_list(data["parameters"]), _list(more["parameters"]), strict=True)
        parameters: list[Json] = [{**_object(name), **_object(values)} for name, values in pairs]
        return cls.from_json({**data, **more, "parameters": parameters})

    @classmethod
    def from_text(cls, text: str | bytes) -> Self:
        """That of JSON text.

        Raises
        ------
        ModelError, TypeError, KeyError, ValueError
            If it is not a manifest, or one of another version of this package.
        """
        return cls.from_json(_object(json.loads(text)))

    @staticmethod
    def identity(text: str | bytes) -> tuple[str, str]:
        """Name and fingerprint in JSON text, also in that of other versions of this package.

        Raises
        ------
        TypeError, KeyError, ValueError
            If it is not a manifest.
        """
        data = _object(json.loads(text))
        return _one(str, data["name"]), _one(str, data["fingerprint"])

    def to_text(self) -> str:
        """JSON text, as written beside the sources."""
        return json.dumps(self.to_json(), indent=2, ensure_ascii=True, allow_nan=False) + "\n"

    def to_json(self) -> dict[str, Json]:
        """The layout as data that JSON can hold."""
        constraints, drawing = self.constraints, self.drawing
        return {
            "format": FORMAT,
            "name": self.name,
            "fingerprint": self.fingerprint,
            "coordinates": [*self.coordinates],
            "angles": [*self.angles],
            "speeds": [*self.speeds],
            "auxiliary_states": [*self.auxiliary_states],
            "n_dependent_coordinates": self.n_dependent_coordinates,
            "n_dependent_speeds": self.n_dependent_speeds,
            "parameters": [
                {"name": p.name, "default": p.default, "unit": p.unit, "description": p.description}
                | {"range": _listed(p.range)}
                for p in self.parameters
            ],
            "derived_parameters": {**self.derived_parameters},
            "inputs": [{"name": e.name, "expression": e.expression, "of": e.of, "order": e.order} for e in self.inputs],
            "prescribed_inputs": [*self.prescribed_places],
            "n_breakpoints": self.breakpoints.n,
            "n_motion_breakpoints": self.breakpoints.n_motion_breakpoints,
            "outputs": [*self.outputs],
            "undetermined_outputs": [*self.undetermined_outputs],
            "position_constraints": {
                "operations": [*constraints.positions.operations],
                "results": [*constraints.positions.results],
            },
            "points": [{"name": point.name, "body": point.body} for point in drawing.points],
            "geometry": [*self.geometry],
            "shapes": [{"kind": s.kind.value, "name": s.name, "points": [*s.points]} for s in drawing.shapes],
            "not_drawn": [*drawing.not_drawn],
            "is_drawn_at_rest": drawing.is_at_rest,
            "gravity": _listed(drawing.gravity),
            "body_shapes": {name: [{**shape} for shape in shapes] for name, shapes in drawing.body_shapes.items()},
            "forced_points": [*drawing.forced_points],
            "bodies": [*drawing.bodies],
            "initial": {**self.initial},
            "invariants": [*constraints.invariants],
            "position_rows": [*constraints.position_rows],
            "states_velocity_constraints": constraints.are_stated,
            "velocity_rows": [*constraints.velocity_rows],
            "warnings": [*self.warnings],
            "compared": self.compared,
            "has_potential_energy": self.potential_energy.is_known,
            "energy_without": [*self.potential_energy.without],
            "form": self.form.value,
            "conditions": [*self.breakpoints.conditions],
            "state_jumps": [
                {"function": j.function, "input": j.input, "by_default": j.by_default, "known": j.known}
                for j in self.breakpoints.state_jumps
            ],
            "dependencies": {name: [*map(hex, rows)] for name, rows in self.dependencies.rows.items()},
            "timed": [*self.dependencies.timed],
            "timed_by": {name: [*others] for name, others in self.dependencies.timed_by.items()},
            "operations_before_sharing": {**self.operations.before_sharing},
            "operations": {**self.operations.counts},
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Json]) -> Self:
        """The layout of data that `to_json` has made.

        Raises
        ------
        ModelError
            If another version of this package has made it.
        TypeError, KeyError, ValueError
            If a part is missing or of another kind.
        """
        if data["format"] != FORMAT:
            raise ModelError(
                f"The compiled model {data['name']} was built with another version of this package, whose manifest has "
                f"format {data['format']!r}, not {FORMAT}: build it again."
            )
        prescribed = _each(int, data["prescribed_inputs"])
        formulas = _object(data["position_constraints"])
        dependencies, timed_by = _object(data["dependencies"]), _object(data["timed_by"])
        gravity = data["gravity"]
        return cls(
            name=_one(str, data["name"]),
            fingerprint=_one(str, data["fingerprint"]),
            form=Form(_one(str, data["form"])),
            coordinates=_each(str, data["coordinates"]),
            speeds=_each(str, data["speeds"]),
            auxiliary_states=_each(str, data["auxiliary_states"]),
            n_dependent_coordinates=_one(int, data["n_dependent_coordinates"]),
            n_dependent_speeds=_one(int, data["n_dependent_speeds"]),
            angles=_each(str, data["angles"]),
            parameters=tuple(_parameter(_object(entry)) for entry in _list(data["parameters"])),
            derived_parameters=_by_name(str, data["derived_parameters"]),
            geometry=_each(str, data["geometry"]),
            inputs=tuple(_input(_object(e), place in prescribed) for place, e in enumerate(_list(data["inputs"]))),
            outputs=_each(str, data["outputs"]),
            undetermined_outputs=_each(str, data["undetermined_outputs"]),
            constraints=Constraints(
                positions=Formulas(_list(formulas["operations"]), _list(formulas["results"])),
                position_rows=tuple(None if r is None else _one(int, r) for r in _list(data["position_rows"])),
                invariants=_each(int, data["invariants"]),
                are_stated=_one(bool, data["states_velocity_constraints"]),
                velocity_rows=_each(int, data["velocity_rows"]),
            ),
            breakpoints=Breakpoints(
                n=_one(int, data["n_breakpoints"]),
                n_motion_breakpoints=_one(int, data["n_motion_breakpoints"]),
                conditions=_each(str, data["conditions"]),
                state_jumps=tuple(_state_jump(_object(entry)) for entry in _list(data["state_jumps"])),
            ),
            drawing=Drawing(
                points=tuple(_point(_object(entry)) for entry in _list(data["points"])),
                shapes=tuple(_shape(_object(entry)) for entry in _list(data["shapes"])),
                not_drawn=_each(str, data["not_drawn"]),
                is_at_rest=_one(bool, data["is_drawn_at_rest"]),
                forced_points=_each(int, data["forced_points"]),
                bodies=_each(str, data["bodies"]),
                gravity=None if gravity is None else _numbers(gravity),
                body_shapes={
                    name: tuple(map(_object, _list(shapes))) for name, shapes in _object(data["body_shapes"]).items()
                },
            ),
            potential_energy=PotentialEnergy(
                is_known=_one(bool, data["has_potential_energy"]), without=_each(str, data["energy_without"])
            ),
            initial={name: _number(value) for name, value in _object(data["initial"]).items()},
            warnings=_each(str, data["warnings"]),
            compared=None if data["compared"] is None else _one(int, data["compared"]),
            dependencies=Dependencies(
                rows={name: tuple(int(row, 16) for row in _each(str, rows)) for name, rows in dependencies.items()},
                timed=_each(str, data["timed"]),
                timed_by={name: _each(str, others) for name, others in timed_by.items()},
            ),
            operations=Operations(
                counts=_by_name(int, data["operations"]),
                before_sharing=_by_name(int, data["operations_before_sharing"]),
            ),
        )


_T = TypeVar("_T", str, int, bool)


def _one(kind: type[_T], value: Json) -> _T:
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value


def _each(kind: type[_T], value: Json) -> tuple[_T, ...]:
    return tuple(_one(kind, entry) for entry in _list(value))


def _by_name(kind: type[_T], value: Json) -> dict[str, _T]:
    return {name: _one(kind, entry) for name, entry in _object(value).items()}


def _list(value: Json) -> list[Json]:
    if not isinstance(value, list):
        raise TypeError(f"{value!r} is no list")
    return value


def _object(value: Json) -> dict[str, Json]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} is no object")
    return value


def _number(value: Json) -> float:
    if not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return value


def _numbers(value: Json) -> tuple[float, ...]:
    return tuple(map(_number, _list(value)))


def _listed(values: Sequence[float] | None) -> Json:
    return None if values is None else [*values]


def _parameter(entry: Mapping[str, Json]) -> Parameter:
    default, span = entry["default"], entry["range"]
    limits = None
    if span is not None:
        least, largest = _numbers(span)
        limits = least, largest
    return Parameter(
        _one(str, entry["name"]),
        None if default is None else _number(default),
        _one(str, entry["unit"]),
        _one(str, entry["description"]),
        limits,
    )


def _input(entry: Mapping[str, Json], is_prescribed: bool) -> Input:
    expression = entry["expression"]
    return Input(
        _one(str, entry["name"]),
        None if expression is None else _one(str, expression),
        _one(str, entry["of"]),
        _one(int, entry["order"]),
        is_prescribed,
    )


def _state_jump(entry: Mapping[str, Json]) -> StateJump:
    by_default, known = _one(bool, entry["by_default"]), _one(bool, entry["known"])
    return StateJump(_one(str, entry["function"]), _one(str, entry["input"]), by_default, known)


def _point(entry: Mapping[str, Json]) -> Point:
    body = entry["body"]
    return Point(_one(str, entry["name"]), None if body is None else _one(str, body))


def _shape(entry: Mapping[str, Json]) -> Shape:
    return Shape(ShapeKind(_one(str, entry["kind"])), _one(str, entry["name"]), _each(int, entry["points"]))
