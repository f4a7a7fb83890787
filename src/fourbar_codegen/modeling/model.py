"""Model: a SymPy System with the values, units and names that its symbols carry."""

from __future__ import annotations

import keyword
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.body_shapes import BodyShape, check_names, named_shapes
from fourbar_codegen.errors import ModelError, nearest, shown
from fourbar_codegen.expressions.convert import is_computable, smooth_sinc, without_impulses
from fourbar_codegen.interface.arguments import finite_number, is_mapping, name_of, slider_range
from fourbar_codegen.interface.registered import Registered
from fourbar_codegen.modeling.mechanism import Mechanism, walk
from fourbar_codegen.modeling.system_reader import read_mechanism
from fourbar_codegen.modeling.visualizations import Visualization, read_visualization

if TYPE_CHECKING:
    from sympy.physics.mechanics import KanesMethod, Point, ReferenceFrame, Vector
    from sympy.physics.mechanics.system import System

__all__ = ["InputEntry", "Model", "Parameter", "joint_force", "multiplier"]

IMPORTED = frozenset({"cpython", "cython", "libc", "numpy", "fb", "fourbar"})
"""Names that the generated module itself imports or includes."""

COLUMNS = re.compile(r"kinetic_energy|potential_energy|constraint_residual_\d+|file|allow_pickle")
"""Names of a trajectory's own columns, and of the arguments of numpy.savez, which takes columns by name."""


@dataclass(frozen=True)
class Parameter:
    """A parameter's default value, unit, description and range.

    Attributes
    ----------
    value : float, Expr or None
        Its default; None if every run has to give it. A parameter whose value is an expression of others always follows
        from them; it is not a parameter of the compiled model.
    unit : str
        As shown to users, for example ``"kg m^2"``.
    description : str
    range : (float, float) or None
        Of its slider in live pages; by default from a fifth of the value to its double, or both signs for zero.

    Examples
    --------
    >>> Parameter(9.81, "m/s^2", "gravitational acceleration").value
    9.81
    """

    value: float | sm.Expr | None = None
    unit: str = ""
    description: str = ""
    range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.range is not None:
            object.__setattr__(self, "range", slider_range(self.range, "a parameter"))
        if self.value is not None and not getattr(self.value, "free_symbols", None):
            object.__setattr__(self, "value", finite_number(self.value, "a parameter"))
        for name in ("unit", "description"):
            if not isinstance(getattr(self, name), str):
                raise ModelError(f"A parameter's {name} must be text, not {shown(getattr(self, name))}.")


@dataclass(frozen=True)
class InputEntry:
    """An entry of the array of inputs r.

    Attributes
    ----------
    name : str
        The input's name, with a prime for each time derivative.
    function : Expr
        The function of time, or its derivative.
    expression : Expr or None
        Its default.
    of : str
        The input's name.
    order : int
        How often it is differentiated: 0, or 1 and 2 for an input that prescribes a motion.
    """

    name: str
    function: sm.Expr
    expression: sm.Expr | None
    of: str
    order: int


def multiplier(number: int) -> sm.Expr:
    """The symbol for a constraint's multiplier in expressions of outputs.

    Parameters
    ----------
    number : int
        Number of the constraint, from 1, in the order of `CompiledModel.multipliers`: holonomic ones first.

    Returns
    -------
    Expr

    Raises
    ------
    ModelError
        If it is not a positive integer.

    Examples
    --------
    >>> multiplier(2)
    multiplier(2)
    """
    if not isinstance(number, int) or isinstance(number, bool) or number < 1:
        raise ModelError(f"A multiplier has the number of its constraint, from 1; not {number!r}.")
    return sm.Function("multiplier", real=True)(sm.Integer(number))


def joint_force(name: str, directions: Mapping[int, Vector], frame: ReferenceFrame) -> dict[str, sm.Expr]:
    """The force in a joint that is closed by constraints, as outputs of a Model.

    If constraint k keeps the component along e_k of the position (or velocity) of a point B relative to a point A at
    zero, its multiplier is the force along e_k on the body of B, and the opposite force acts on the body of A. This
    holds only if the constraint was not substituted into any velocity.

    Parameters
    ----------
    name : str
        The joint's.
    directions : mapping of int to Vector
        For each of the joint's constraints, its number (see `multiplier`) and the direction e_k that the
        relative position is dotted with.
    frame : ReferenceFrame or Body
        The frame in which the force is resolved, or a body with that frame.

    Returns
    -------
    dict of str to Expr
        Outputs ``{name}_x``, ``{name}_y`` and ``{name}_z``; in the constraints' units, newton for metres.

    Raises
    ------
    ModelError
        If the name is no text, the directions are no mapping to vectors, or are not oriented relative to the frame.

    Source: Kane and Levinson 1985, section 4.9; Featherstone, *Rigid Body Dynamics Algorithms*, 2008, section 8.

    Examples
    --------
    >>> from sympy.physics.mechanics import ReferenceFrame
    >>> N = ReferenceFrame("N")
    >>> joint_force("pin", {1: N.x, 2: N.y}, N)
    {'pin_x': multiplier(1), 'pin_y': multiplier(2), 'pin_z': 0}
    """
    if not isinstance(name, str):
        raise ModelError(f"A joint's name must be text, not {shown(name)}.")
    frame = getattr(frame, "frame", frame)  # of a body
    try:
        return {
            f"{name}_{letter}": sm.Add(*(multiplier(k) * direction.dot(axis) for k, direction in directions.items()))
            for letter, axis in zip("xyz", frame, strict=True)
        }
    except (AttributeError, TypeError, ValueError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(
            f"joint_force takes a mapping from numbers of constraints to vectors, and a frame that these are oriented "
            f"in, not {directions!r} and {frame!r}: {error}"
        ) from error


class Model:
    """A mechanism ready to be compiled.

    Parameters
    ----------
    system : sympy.physics.mechanics.System or KanesMethod
        A System that is ready for its ``form_eoms``, or a KanesMethod with its bodies and loads. It is read once,
        here; later changes to it do not reach the Model. Accelerations follow from the velocities; those set
        with ``Point.set_acc`` are only compared with these, for warnings. If constraints are redundant, name as
        many dependent coordinates and speeds as there are independent constraints.
    name : str, optional
        A Python identifier; names the compiled module.
    parameters : mapping of Symbol to float, Expr or Parameter, optional
        Default values, or expressions of other parameters; keys are symbols or their names, as they are of inputs and
        initial values. Other symbols that the equations need follow in alphabetical order, without a default. (A body's
        automatic inertia symbols often drop out.)
    inputs : mapping of function of time to Expr, float or None, or "auto", optional
        Every function of time that is neither coordinate nor speed, with its default: an expression of time
        and parameters, a number, or None if every run has to give it. An input prescribes a motion if its rates
        appear in the equations, that is, if it stands in an orientation, a position, a velocity or a constraint, or is
        differentiated. Its first and second derivatives are then inputs too; they follow it, are named with primes, and
        have the derivatives of the expression as defaults. An input that stands only in a kinematic differential
        equation prescribes a motion only if velocities or constraints depend on it. "auto" names all of them, with the
        default in ``parameters``, else 0.
    initial : mapping of coordinate, speed or auxiliary state to float, optional
        Default initial values of the independent coordinates and speeds and of auxiliary states, and guesses of the
        dependent coordinates. Dependent speeds follow from the others. Values of them are compared with these when the
        model's initial state is made: constraints hold to 1e-6 of their terms.
    reactions : iterable of Expr or str, or "all", optional
        Unknown forces, or their names, that act between the two bodies of a joint, although the loads have them on one
        body only. Their components along auxiliary speeds stand in the equations of these alone, as if they were zero
        in the equations of motion. By default a `ModelWarning` names unknown forces at points that move along their
        auxiliary speed in the motion, too; these then drive the motion. An empty list says that they do.
    potential_energy : Expr, optional
        In terms of coordinates, parameters and time. By default the sum of the bodies' ``potential_energy`` and of the
        potentials of all forces that are constant in the System's frame, such as gravity, and of springs, unless the
        former include the latter. It is unknown if its loss does not equal the work of these loads. Springs are
        actuators and loads that depend on a length, an angle or coordinates alone; terms with speeds or inputs in the
        same load do not count. `CompiledModel.energy_without` names those for which SymPy finds no antiderivative.
    outputs : mapping of str to Expr, optional
        Further results by name: expressions of time, coordinates, speeds, first derivatives of both, inputs,
        parameters, and multipliers (see `multiplier`, `joint_force`). With auxiliary speeds, the first outputs are the
        forces that keep these zero. They are the functions of time in the loads that are not named otherwise, as many
        as there are auxiliary speeds. If the loads have none, they are the generalized noncontributing forces, under
        the names of the auxiliary speeds.
    state_equations : mapping of function of time to Expr, optional
        States z beside coordinates and speeds, with their rates z': activations of muscles, currents, filters,
        relaxation of tyres. Expressions may contain time, coordinates, speeds, first derivatives of both, these states,
        inputs, parameters and multipliers. Loads and outputs may contain the states; velocities, constraints and the
        potential energy may not. The equations of actuators of ``sympy.physics.biomechanics`` are added by themselves;
        their excitations are inputs, 0 by default.
    points : sequence of sympy.physics.mechanics.Point, optional
        Points that are drawn, and that results list, although no body and no load needs them: tracing points, feet.
        Symbols in their positions are parameters.
    lines : sequence of sequence of Point or str, optional
        Lines to draw between points beside the links that are found (see `fourbar_codegen.Trajectory.animate`), such as
        ``[("B1", "K")]``; points that stand here are drawn like those in `points`.
    shapes : mapping of body, ReferenceFrame or str to shape or sequence of shapes, optional
        What bodies look like in pictures in space: `Sphere`, `Box`, `Cylinder`, `Wheel`, `Mesh` and others. Wheels,
        limbs and other bodies have shapes by themselves; these replace them, and an empty list hides a body. Sizes
        may be parameters that the equations have. They compile nothing. Shapes of pydy.viz are taken as well (with the
        colours that have a name here), a list of its visualization frames or its Scene in place of the mapping, and a
        scene of symmeplot for its lines, such as ``Plotter.from_model(bicycle)`` of SymBRiM.
    extra : {"raise", "ignore"}, optional
        What to do with parameters and inputs that the System does not contain. A symbol or function of the same name
        with different assumptions, such as ``positive=True``, is always an error.

    Raises
    ------
    ModelError
        If the System is inconsistent or incomplete; a symbol is missing, unknown, or named twice; or velocity
        constraints that it states do not keep its position constraints.

    Examples
    --------
    >>> import sympy as sm, sympy.physics.mechanics as me
    >>> from sympy.physics.mechanics.system import System
    >>> m, k = sm.symbols("m k")
    >>> q, u = me.dynamicsymbols("q u")
    >>> wall, block = me.RigidBody("wall"), me.RigidBody("block", mass=m)
    >>> system = System.from_newtonian(wall)
    >>> system.add_joints(me.PrismaticJoint("slide", wall, block, q, u))
    >>> system.add_loads(me.Force(block.masscenter, -k * q * wall.x))
    >>> Model(system, name="oscillator", parameters={m: 2.0, k: 8.0}).coordinates
    ('q',)
    """

    # By the equations, which stand above the Model.
    _check_velocity_constraints = Registered[[], None]()

    def __init__(
        self,
        system: System | KanesMethod,
        *,
        name: str = "model",
        parameters: Mapping[sm.Symbol, float | sm.Expr | Parameter] | None = None,
        inputs: Mapping[sm.Expr, sm.Expr | float | None] | Literal["auto"] | None = None,
        initial: Mapping[sm.Expr, float] | None = None,
        reactions: Iterable[sm.Expr | str] | Literal["all"] | None = None,
        potential_energy: sm.Expr | None = None,
        outputs: Mapping[str, sm.Expr] | None = None,
        state_equations: Mapping[sm.Expr, sm.Expr] | None = None,
        points: Sequence[Point] = (),
        lines: Sequence[Sequence[Point | str]] = (),
        shapes: Mapping[Any, BodyShape | Sequence[BodyShape]] | Any = None,
        extra: Literal["raise", "ignore"] = "raise",
    ) -> None:
        _check_model_name(name)
        self.system = system
        self.name = name
        parameters, outputs = _mapping(parameters, "parameters"), _mapping(outputs, "outputs")
        seen = read_visualization(shapes)
        self.mechanism: Mechanism = read_mechanism(system, points, lines, _known_numbers(parameters, outputs), seen)
        for label, expressions in (*self.mechanism.labelled_loads(), *self.mechanism.labelled_structure()):
            _check_expressions(expressions, label)
        self.state_equations = self._read_state_equations(_mapping(state_equations, "state_equations"))
        is_automatic = isinstance(inputs, str) and inputs == "auto"
        self.input_expressions: dict[sm.Expr, sm.Expr | None] = {}
        self.potential_energy = None if potential_energy is None else _expression(potential_energy, "potential_energy")
        self.output_expressions = {name_of(key): _expression(e, f"output {name_of(key)}") for key, e in outputs.items()}
        if not is_automatic:
            self._read_inputs(_mapping(inputs, "inputs"))
        values = (getattr(value, "value", value) for value in parameters.values())
        others = {symbol.name: symbol for value in values for symbol in getattr(value, "free_symbols", ())}
        parameters = _by_symbol(parameters, others | self._symbols())
        self.noncontributing: tuple[sm.Expr, ...] = self._find_noncontributing()
        self.reactions = self._read_reactions(reactions)
        self._check_appearance(extra)
        undeclared = self._find_undeclared()
        if is_automatic:
            parameters = self._find_inputs(undeclared, parameters, extra)
        elif undeclared:
            raise ModelError(self._neither(undeclared))
        self.input_entries = self._list_inputs()
        self.parameter_symbols, self.derived_parameters = self._collect_parameters(parameters, extra)
        self.named_parameters = tuple(symbol for symbol in parameters if symbol in self.parameter_symbols)
        self._check_names()
        self._check_inputs()
        self._check_holonomic_constraints()
        self._check_auxiliary_states()
        states = {_name(function): function for function in self._states()}
        self.initial = self._check_initial(_by_symbol(_mapping(initial, "initial"), states))
        self.shapes = self._read_shapes(seen)
        if self.mechanism.states_velocity_constraints:
            self._check_velocity_constraints()

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the generalized coordinates, the independent ones first."""
        return tuple(_name(q) for q in self.mechanism.coordinates)

    @property
    def speeds(self) -> tuple[str, ...]:
        """Names of the generalized speeds, the independent ones first."""
        return tuple(_name(u) for u in self.mechanism.speeds)

    @property
    def auxiliary_states(self) -> tuple[str, ...]:
        """Names of the states that have equations of their own."""
        return tuple(map(_name, self.state_equations))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs, and of the rates of those that may prescribe a motion, which the equations decide."""
        return tuple(entry.name for entry in self.input_entries)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, those of the auxiliary speeds first."""
        return (*map(_name, self.noncontributing or self.mechanism.auxiliary_speeds), *self.output_expressions)

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All symbols of the System by name, the ones that were named first."""
        return {symbol.name: parameter for symbol, parameter in self.parameter_symbols.items()}

    def __repr__(self) -> str:
        return (
            f"<Model {self.name}: {len(self.coordinates)} coordinates, {len(self.speeds)} speeds, "
            f"{f'{len(self.state_equations)} auxiliary states, ' * bool(self.state_equations)}"
            f"{len(self.parameter_symbols)} parameters, {len(self.inputs)} inputs>"
        )

    def _repr_html_(self) -> str:
        from fourbar_codegen.interface.notebook import names_table

        return names_table(
            f"Model {self.name}",
            [
                ("coordinate", self.coordinates, self.mechanism.n_dependent_coordinates),
                ("speed", self.speeds, self.mechanism.n_dependent_speeds),
                ("auxiliary state", self.auxiliary_states, 0),
            ],
            {name: (p.value, p.unit, p.description) for name, p in self.parameters.items()},
            {e.name: None if e.expression is None else str(e.expression) for e in self.input_entries},
            self.outputs,
        )

    def _read_shapes(self, seen: Visualization) -> dict[str, tuple[BodyShape, ...]]:
        """Shapes by names of bodies, or of frames that are not those of a body."""
        bodies, frames = self.mechanism.bodies, self.mechanism.frames
        # The inertial frame and those that several bodies have belong to none of these.
        users = Counter(body.frame for body in bodies)
        of_frame = {frames[body.frame].name: body.name for body in bodies if body.frame and users[body.frame] == 1}
        ground = next((shape.name for shape in self.mechanism.shapes if shape.kind == "ground"), frames[0].name)
        of_frame[frames[0].name] = ground
        names = dict.fromkeys([*(body.name for body in bodies), *(frame.name for frame in frames)])
        found: dict[str, tuple[BodyShape, ...]] = {}

        def body_of(name: str) -> str:
            return name if name in self._bodies() else of_frame.get(name, name)

        shapes = {**seen.shapes}
        for (name, point), placed in zip(self.mechanism.placed, seen.placed, strict=True):
            body = body_of(name)
            shapes[body] = (*shapes.get(body, ()), replace(placed.shape, at=point))
        for name, of_body in named_shapes(shapes, names).items():
            body = body_of(name)
            if body in found or self._bodies().count(body) > 1:
                raise ModelError(f"Shapes are given twice for {body}, or two bodies have this name.")
            found[body] = of_body
        drawn = dict.fromkeys(point.name for point in self.mechanism.drawn if point.name)
        check_names(found, [symbol.name for symbol in self.parameter_symbols], drawn)
        return found

    def _bodies(self) -> tuple[str, ...]:
        return tuple(body.name for body in self.mechanism.bodies)

    @property
    def drawn_frames(self) -> tuple[str, ...]:
        """Names of the frames, neither those of bodies nor the inertial one, that have shapes."""
        fixed = self.mechanism.frames[0].name
        return tuple(sorted(name for name in self.shapes if name not in self._bodies() and name != fixed))

    def _read_state_equations(self, equations: Mapping[sm.Expr, sm.Expr]) -> dict[sm.Expr, sm.Expr]:
        states = {*self.mechanism.coordinates, *self.mechanism.speeds, *self.mechanism.auxiliary_speeds}
        for function in equations:
            if not isinstance(function, AppliedUndef) or function.args != (self.mechanism.time,) or function in states:
                raise ModelError(
                    f"state_equations= has functions of {self.mechanism.time} as keys that are neither coordinates nor "
                    f"speeds, not {function!r}."
                )
        given = {f: _expression(e, f"the state equation of {_name(f)}") for f, e in equations.items()}
        own = {f: e for f, e in self.mechanism.state_equations if f not in given}
        for function, expression in own.items():
            _check_expressions([expression], f"the state equation of {_name(function)}")
        return {**own, **given}

    def _read_inputs(self, given: Mapping[Any, sm.Expr | float | None]) -> None:
        """Take the inputs that are named, and motions in the System that appear, which are zero."""
        named = {_name(function): function for function in self._functions()}
        inputs = _by_symbol(given, named, self.mechanism.time)
        for function in inputs:
            if not isinstance(function, AppliedUndef) or function.args != (self.mechanism.time,):
                raise ModelError(f"inputs= has functions of {self.mechanism.time} as keys, not {function!r}.")
        self.input_expressions = {f: None if e is None else _expression(e, f"the input {f}") for f, e in inputs.items()}
        known, appearing = {*self._states(), *self.input_expressions}, self._functions()
        driving = [f for f in self.mechanism.excitations if f in appearing and f not in known]
        self.input_expressions.update(dict.fromkeys(driving, sm.S.Zero))

    def _find_inputs(self, undeclared: Iterable[sm.Expr], parameters: Mapping[Any, Any], extra: str) -> dict[Any, Any]:
        """Take all functions that are not declared for inputs; returns the parameters that are none.

        Users who keep all constants in one mapping may have numbers for some inputs there.
        """
        given = {f: getattr(parameters.get(f, 0), "value", parameters.get(f, 0)) for f in undeclared}
        self.input_expressions = {
            f: None if value is None else _expression(value, f"the input {f}") for f, value in given.items()
        }
        functions = {_name(f): f for f in parameters if isinstance(f, AppliedUndef)}
        _check_unknown(functions, {_name(f): f for f in given}, "parameters", extra)
        return {key: value for key, value in parameters.items() if not isinstance(key, AppliedUndef)}

    def _check_appearance(self, extra: str) -> None:
        """Raise if inputs are given that the model does not have, unless they are to be ignored."""
        functions = self._functions()
        states = {*self._states()}  # for these, the check of names reports duplicates
        given = {_name(f): f for f in self.input_expressions if f not in states}
        known = {_name(f): f for f in functions if f not in states}
        _check_unknown(given, known, "inputs", extra)
        self.input_expressions = {f: e for f, e in self.input_expressions.items() if f in functions}

    def _states(self) -> tuple[sm.Expr, ...]:
        return (*self.mechanism.coordinates, *self.mechanism.speeds, *self.state_equations)

    def _labelled(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        """All expressions of the model, with a description of their place."""
        return chain(self._labelled_equations(), self._labelled_state_equations(), self._labelled_outputs())

    def _labelled_equations(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        yield from self.mechanism.labelled_loads()
        yield from self.mechanism.labelled_structure()
        if self.potential_energy is not None:
            yield "the potential energy", (self.potential_energy,)
        for function, expression in self.input_expressions.items():
            if expression is not None:
                yield f"the expression of input {_name(function)}", (expression,)

    def _labelled_state_equations(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        for function, expression in self.state_equations.items():
            yield f"the state equation of {_name(function)}", (expression,)

    def _labelled_outputs(self) -> Iterator[tuple[str, Iterable[sm.Expr]]]:
        for name, expression in self.output_expressions.items():
            yield f"output {name}", (expression,)

    def _find_noncontributing(self) -> tuple[sm.Expr, ...]:
        """Functions of time in the loads that are not named: the unknown forces of the auxiliary speeds."""
        mechanism = self.mechanism
        if not mechanism.auxiliary_speeds:
            return ()
        known = {*self._states(), *mechanism.auxiliary_speeds, *self.input_expressions}
        loads = chain.from_iterable(expressions for _, expressions in mechanism.labelled_loads())
        found = [node for node in walk(loads) if isinstance(node, AppliedUndef) and node not in known]
        if len(found) > len(mechanism.auxiliary_speeds):
            along = mechanism.forces_along_auxiliary_speeds(found)
            found = [*along] if len(along) == len(mechanism.auxiliary_speeds) else found
        if found and len(found) != len(mechanism.auxiliary_speeds):
            raise ModelError(
                f"The loads have {len(found)} functions of time that are neither coordinates nor speeds nor named in "
                f"inputs= ({', '.join(sorted(map(_name, found)))}), for {len(mechanism.auxiliary_speeds)} auxiliary "
                "speeds: there must be as many unknown forces, or none, or as many must act along these. Name known "
                "forces in inputs=."
            )
        return tuple(sorted(found, key=_name))

    def _read_reactions(self, given: Iterable[sm.Expr | str] | str | None) -> tuple[sm.Expr, ...] | None:
        if given is None:
            return None
        if isinstance(given, str) and given == "all":
            return self.noncontributing
        if isinstance(given, str) or not isinstance(given, Iterable):
            raise ModelError(f"reactions= is 'all' or a list of unknown forces or their names, not {shown(given)}.")
        unknown = {_name(f): f for f in self.noncontributing}
        found = []
        for item in given:
            found.append(unknown.get(item) if isinstance(item, str) else item)
            if found[-1] not in self.noncontributing:
                raise ModelError(
                    f"{shown(item)} in reactions= is none of the unknown forces along auxiliary speeds: "
                    f"{', '.join(unknown) or 'the model has none'}. A force that inputs= names is known."
                )
        return tuple(f for f in self.noncontributing if f in found)

    def _functions(self) -> dict[sm.Expr, str]:
        """Functions of time in all expressions, sorted by name, each with the first place where it appears."""
        found: dict[sm.Expr, str] = {}
        for label, expressions in self._labelled():
            for node in walk(expressions):
                function = node.expr if isinstance(node, sm.Derivative) else node
                if isinstance(function, AppliedUndef) and function.args == (self.mechanism.time,):
                    found.setdefault(function, label)
        return dict(sorted(found.items(), key=lambda item: _name(item[0])))

    def _symbols(self) -> dict[str, sm.Expr]:
        """Functions of time and symbols in all expressions by name; a symbol where both have one name."""
        expressions = chain.from_iterable(expressions for _, expressions in self._labelled())
        symbols = {node.name: node for node in walk(expressions) if isinstance(node, sm.Symbol)}
        return {_name(function): function for function in self._functions()} | symbols

    def _find_undeclared(self) -> dict[sm.Expr, str]:
        """Those of them that are not named."""
        mechanism = self.mechanism
        known = {*self._states(), *mechanism.auxiliary_speeds}
        known |= {*self.input_expressions, *self.noncontributing}
        found = {function: label for function, label in self._functions().items() if function not in known}
        for function, label in found.items():
            self._check_assumptions(function, label)
        return found

    def _check_assumptions(self, function: sm.Expr, label: str) -> None:
        """Raise if a function has the name of a state."""
        if _name(function) in map(_name, self._states()):
            raise ModelError(
                f"{function} in {label} has other assumptions than the state of that name: to SymPy these are two "
                "functions. Use the System's."
            )

    def _neither(self, functions: Mapping[sm.Expr, str]) -> str:
        """The message for unknown functions, given with the places where they appear."""
        names = "; ".join(f"{function} in {label}" for function, label in functions.items())
        return (
            f"{names}: not among the coordinates {self.coordinates}, the speeds {self.speeds} and the inputs "
            f"{tuple(map(_name, self.input_expressions))}. Add such functions of time to the System's coordinates or "
            "speeds, or name them in inputs=; inputs='auto' makes all of them inputs that are 0 by default."
        )

    def _list_inputs(self) -> tuple[InputEntry, ...]:
        """The inputs; those that may prescribe a motion are followed by their first and second rates."""
        t = self.mechanism.time
        structure = walk(chain.from_iterable(expressions for _, expressions in self.mechanism.labelled_structure()))
        prescribed = {node for node in structure if isinstance(node, AppliedUndef)}
        everywhere = walk(chain.from_iterable(expressions for _, expressions in self._labelled()))
        prescribed |= {node.expr for node in everywhere if isinstance(node, sm.Derivative)}
        entries: list[InputEntry] = []
        for function, expression in self.input_expressions.items():
            for order in range(3 if function in prescribed else 1):
                default = expression if order == 0 or expression is None else _rate(entries[-1].expression, t)
                derivative = function if order == 0 else function.diff((t, order))
                entries.append(InputEntry(_name(function) + order * "'", derivative, default, _name(function), order))
        return tuple(entries)

    def _collect_parameters(
        self, given: Mapping[sm.Symbol, float | sm.Expr | Parameter], extra: str
    ) -> tuple[dict[sm.Symbol, Parameter], dict[sm.Symbol, sm.Expr]]:
        """The given symbols in their order, then the others by name; and those that are expressions of others."""
        mechanism, t = self.mechanism, self.mechanism.time
        entries = {entry.function for entry in self.input_entries}
        known = {*self._states(), *mechanism.auxiliary_speeds, *entries, *self.noncontributing}
        rates = {q.diff(t) for q in mechanism.coordinates} | entries
        n_c = len(mechanism.velocity_constraints)
        n_c += len(mechanism.holonomic_constraints) if mechanism.velocity_constraints_derived else 0
        of_solution = {multiplier(number) for number in range(1, n_c + 1)} | {u.diff(t) for u in mechanism.speeds}
        of_outputs = of_solution | {z.diff(t) for z in self.state_equations}
        values = {s: v.value if isinstance(v, Parameter) else v for s, v in given.items()}
        derived = {s: _of_parameters(s, v, t) for s, v in values.items() if getattr(v, "free_symbols", None)}
        found: set[sm.Symbol] = set()
        groups: tuple[tuple[Iterable[tuple[str, Iterable[sm.Expr]]], set[sm.Expr]], ...] = (
            (self._labelled_equations(), set()),
            (self._labelled_state_equations(), of_solution),
            (self._labelled_outputs(), of_outputs),
            (((f"the expression of parameter {s}", (e,)) for s, e in derived.items()), set()),
        )
        for label, expressions, in_outputs in ((*entry, allowed) for group, allowed in groups for entry in group):
            for node in walk(expressions):
                if isinstance(node, sm.Symbol):
                    found.add(node)
                elif isinstance(node, AppliedUndef) and node.func == multiplier(1).func and in_outputs:
                    if node not in in_outputs:
                        raise ModelError(
                            f"{node} in {label}: the model has {n_c} constraints on velocities. Only joints that "
                            "constraints close have multipliers: leave the joint out of add_joints and close it with "
                            "holonomic constraints, or use auxiliary speeds."
                        )
                elif isinstance(node, AppliedUndef) and node not in known | in_outputs:
                    raise ModelError(self._neither({node: label}))
                elif isinstance(node, sm.Derivative) and node not in rates | in_outputs:
                    raise ModelError(
                        f"{node} in {label} cannot be compiled: the only derivatives allowed are the first ones of the "
                        f"coordinates {self.coordinates}, the first and second ones of inputs, and, in outputs and "
                        "state equations, the first ones of the speeds."
                    )
        found.discard(t)
        symbols = [s for s in given if not (isinstance(s, AppliedUndef) and extra == "ignore")]
        for symbol in symbols:
            if not isinstance(symbol, sm.Symbol):
                raise ModelError(f"parameters= has Symbols as keys, not {symbol!r}; functions of time are inputs.")
        _check_unknown({s.name: s for s in symbols}, {s.name: s for s in found}, "parameters", extra)
        derived = {symbol: expression for symbol, expression in derived.items() if symbol in found}
        parameters = {
            symbol: value if isinstance(value, Parameter) else Parameter(value)
            for symbol, value in given.items()
            if symbol in found and symbol not in derived
        }
        for symbol in sorted(found - parameters.keys() - derived.keys(), key=lambda s: s.name):
            parameters[symbol] = Parameter()
        return parameters, _in_order(derived)

    def _check_names(self) -> None:
        names = [*map(_name, self._states()), *self.inputs, *self.outputs]
        names += [symbol.name for symbol in (*self.parameter_symbols, *self.derived_parameters)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ModelError(
                f"These names stand for more than one symbol: {', '.join(repeated)}. Coordinates, speeds, auxiliary "
                "states, inputs, outputs and parameters are found by name, so each needs its own."
            )
        columns = sorted(name for name in names if COLUMNS.fullmatch(name))
        if columns:
            raise ModelError(f"Trajectories have columns named {', '.join(columns)}; give the symbols other names.")
        for name in {self.mechanism.time.name, "t"} & {*names}:  # results call it t, whatever its symbol
            raise ModelError(f"{name} is the name of time; give the other symbol another name.")

    def _check_inputs(self) -> None:
        """Their expressions contain only time and parameters; in velocities, they are differentiated at most once."""
        allowed = {self.mechanism.time, *self.parameter_symbols, *self.derived_parameters}
        for function, expression in self.input_expressions.items():
            if expression is None:
                continue
            functions = any(isinstance(node, AppliedUndef | sm.Derivative) for node in walk([expression]))
            if functions or not expression.free_symbols <= allowed:
                raise ModelError(
                    f"The expression of input {_name(function)} may contain time and parameters only, not "
                    f"{expression}. Put state feedback into the loads, or give it at run time as a callable of (t, x)."
                )
        accelerations = {entry.function for entry in self.input_entries if entry.order == 2}
        for label, expressions in self.mechanism.labelled_structure():
            for node in walk(expressions):
                if node in accelerations:
                    raise ModelError(
                        f"{node} in {label} cannot be compiled: velocities and constraints may contain an input and "
                        "its first derivative, whose rates are then inputs too."
                    )

    def _check_holonomic_constraints(self) -> None:
        speeds = set(self.mechanism.speeds)
        for number, expression in enumerate(self.mechanism.holonomic_constraints, start=1):
            for node in walk([expression]):
                if node in speeds or isinstance(node, sm.Derivative):
                    raise ModelError(
                        f"Holonomic constraint {number} contains {node}: it may depend on coordinates and time only. A "
                        "constraint on speeds goes to add_nonholonomic_constraints."
                    )

    def _check_auxiliary_states(self) -> None:
        """They may appear only in loads, state equations and outputs."""
        structure = [*self.mechanism.labelled_structure()]
        if self.potential_energy is not None:
            structure.append(("the potential energy", (self.potential_energy,)))
        for label, expressions in structure:
            for node in walk(expressions):
                if node in self.state_equations:
                    raise ModelError(
                        f"{node} in {label} cannot be compiled: states with equations of their own may appear only in "
                        "loads, state equations and outputs."
                    )

    def _check_initial(self, given: Mapping[sm.Expr, float]) -> dict[str, float]:
        states = {*self._states()}
        initial = {}
        for function, value in given.items():
            if function not in states:
                if isinstance(function, AppliedUndef):
                    self._check_assumptions(function, "initial=")
                raise ModelError(f"{function} in initial= is none of the states {(*map(_name, self._states()),)}.")
            initial[_name(function)] = finite_number(value, f"initial {_name(function)}")
        return initial


def _check_model_name(name: object) -> None:
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise ModelError(f"A model's name is letters, digits and underscores, a letter first, not {name!r}.")
    if keyword.iskeyword(name) or name in IMPORTED:
        raise ModelError(f"A model cannot be named {name!r}: Python or the generated code needs that name.")


def _known_numbers(parameters: Mapping[Any, Any], outputs: Mapping[Any, Any]) -> set[sm.Symbol | str]:
    """The parameters with values that are numbers, and are no outputs: those that drawings may contain."""
    for key in outputs:
        if not isinstance(getattr(key, "name", key), str) or not name_of(key):
            raise ModelError(f"outputs= is a mapping from names to expressions, and {shown(key)} is no name.")
    taken = set(map(name_of, outputs))
    numbers = (key for key, value in parameters.items() if _is_number(getattr(value, "value", value)))
    return {key for key in numbers if isinstance(key, sm.Symbol | str) and name_of(key) not in taken}


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) or getattr(value, "is_number", False)


def _check_unknown(given: Mapping[str, sm.Expr], known: Mapping[str, sm.Expr], argument: str, extra: str) -> None:
    """Raise if names are given that the model does not have, unless they are to be ignored."""
    if extra not in ("raise", "ignore"):
        raise ModelError(f"extra must be 'raise' or 'ignore', not {shown(extra)}.")
    wrong, unknown = [], []
    for name, symbol in given.items():
        mine = known.get(name)
        if mine is None:
            near = nearest(name, known, cutoff=0.0)
            unknown.append(name if near is None else f"{name} (the nearest is {near})")
        elif mine != symbol:
            texts = sm.srepr(mine), sm.srepr(symbol)  # srepr shows no assumptions of functions
            differ = f"is {texts[0]} in the model and {texts[1]}" if len({*texts}) > 1 else "has other assumptions"
            wrong.append(f"{name} {differ} in {argument}=")
    if wrong:
        raise ModelError(f"{'; '.join(wrong)}: to SymPy these are two symbols. Use the model's.")
    if unknown and extra == "raise":
        raise ModelError(
            f"These {argument} do not appear in the model: {', '.join(unknown)}. extra='ignore' leaves them out."
        )


def _of_parameters(symbol: sm.Symbol, value: Any, time: sm.Symbol) -> sm.Expr:
    """The expression of a parameter, checked."""
    expression = _expression(value, f"the expression of parameter {symbol}")
    if any(node == time or isinstance(node, AppliedUndef | sm.Derivative) for node in walk([expression])):
        raise ModelError(f"The expression of parameter {symbol} may contain parameters only, not {expression}.")
    return expression


def _in_order(derived: Mapping[sm.Symbol, sm.Expr]) -> dict[sm.Symbol, sm.Expr]:
    """Parameters that are expressions of others, in topological order."""
    ordered: dict[sm.Symbol, sm.Expr] = {}
    waiting = dict(derived)
    while waiting:
        ready = [symbol for symbol, e in waiting.items() if not e.free_symbols & waiting.keys()]
        if not ready:
            raise ModelError(f"The parameters {', '.join(s.name for s in waiting)} are expressions of each other.")
        for symbol in ready:
            ordered[symbol] = waiting.pop(symbol)
    return ordered


def _mapping(given: Any, argument: str) -> Mapping[Any, Any]:
    if given is None:
        return {}
    if not is_mapping(given):
        raise ModelError(f"{argument}= must be a mapping from symbols to values, not {given!r}.")
    return given


def _by_symbol(given: Mapping[Any, Any], known: Mapping[str, sm.Expr], time: sm.Symbol | None = None) -> dict[Any, Any]:
    """A mapping with symbols as keys, of one that may have their names.

    A name that is not known becomes a symbol, or a function of time if this is given, which others then refuse.

    Raises
    ------
    ModelError
        If a symbol and its name are both keys.
    """
    found: dict[Any, Any] = {}
    for key, value in given.items():
        if isinstance(key, str):
            unknown = sm.Symbol(key) if time is None else sm.Function(key)(time)
        symbol = known.get(key, unknown) if isinstance(key, str) else key
        if symbol in found:
            raise ModelError(f"There are two values of {symbol}: give one, by its name or its symbol.")
        found[symbol] = value
    return found


def _rate(expression: sm.Expr, t: sm.Symbol) -> sm.Expr:
    """The derivative with respect to time, without jumps: for these, a run applies an impulse when it gets there."""
    smooth = expression.replace(sm.sinc, smooth_sinc)
    # With symbols that might be complex, SymPy differentiates real and imaginary parts of an absolute value.
    real = {s: sm.Dummy(s.name, real=True) for s in smooth.free_symbols} if smooth.has(sm.Abs, sm.sign) else {}
    rate = smooth.xreplace(real).diff(real.get(t, t))
    return without_impulses(rate).xreplace({dummy: symbol for symbol, dummy in real.items()})


def _expression(given: Any, what: str) -> sm.Expr:
    """A SymPy expression; text is not evaluated."""
    try:
        expression = sm.sympify(given, strict=True)
    except (sm.SympifyError, TypeError) as error:  # SymPy raises the latter for some containers
        raise ModelError(f"{what} must be an expression or a number, not {shown(given)}.") from error
    _check_expressions([expression], what)
    # For larger expressions SymPy's answer may be wrong, for example for the inverse of De Groote's tendon curve.
    atoms = (node for node in walk([expression]) if isinstance(node, sm.Symbol | AppliedUndef))
    parts = [*atoms] or [expression]
    if any(part.is_extended_real is False or part.is_finite is False for part in parts):
        raise ModelError(f"{what} must be a real and finite expression, not {shown(given)}.")
    return expression


def _check_expressions(expressions: Iterable[sm.Basic], label: str) -> None:
    """Raise if an expression contains something that is no operation on real numbers."""
    expressions = tuple(expressions)
    for expression in expressions:
        if not isinstance(expression, sm.Expr):
            raise ModelError(f"{label} must be a real and finite expression, not {shown(expression)}.")
    for node in walk(expressions):
        is_value = isinstance(node, AppliedUndef | sm.Derivative) or (
            isinstance(node, sm.Symbol) and node.is_commutative
        )
        if not (is_value or is_computable(node)):
            raise ModelError(
                f"{shown(node)} in {label} cannot be compiled: expressions are made of real numbers within the range "
                "of double, symbols, functions of time, sums, products, powers, and SymPy's functions of these."
            )


def _name(function: sm.Expr) -> str:
    return str(function.func)
