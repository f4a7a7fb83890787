"""Model: a SymPy System with the values, units and names that its symbols carry."""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import sympy as sm
from sympy.core.function import AppliedUndef

from fourbar_codegen.arguments import finite_number, is_mapping
from fourbar_codegen.errors import ModelError
from fourbar_codegen.mechanism import Mechanism, read_mechanism, walk

if TYPE_CHECKING:
    from sympy.physics.mechanics.system import System

__all__ = ["Model", "Parameter"]

IMPORTED = frozenset({"cpython", "cython", "libc", "numpy", "fb", "fourbar"})
"""What the generated module imports and includes itself."""

COLUMNS = re.compile(r"kinetic_energy|potential_energy|constraint_residual_\d+|file|allow_pickle")
"""Names of a trajectory's own columns, and of the arguments of numpy.savez, which takes columns by name."""


@dataclass(frozen=True)
class Parameter:
    """What is known of a parameter.

    Attributes
    ----------
    value : float or None
        Its default; None if every run has to give it.
    unit : str
        As it is to be shown, for instance ``"kg m^2"``.
    description : str

    Examples
    --------
    >>> Parameter(9.81, "m/s^2", "gravitational acceleration").value
    9.81
    """

    value: float | None = None
    unit: str = ""
    description: str = ""

    def __post_init__(self) -> None:
        if self.value is not None:
            object.__setattr__(self, "value", finite_number(self.value, "a parameter"))


class Model:
    """A mechanism ready to be compiled.

    Parameters
    ----------
    system : sympy.physics.mechanics.System
        As its ``form_eoms`` takes it. It is read once, here: later changes to it do not reach the Model.
        Accelerations follow from the velocities; those set with ``Point.set_acc`` are not read.
    name : str, optional
        A Python identifier; names the compiled module.
    parameters : mapping of Symbol to float or Parameter, optional
        Default values. Symbols of the System that are not named here follow in alphabetical order, without
        a default, as far as the equations need them (a body's automatic inertia symbols often drop out).
    inputs : mapping of function of time to Expr, float or None, optional
        Every function of time in the loads that is neither coordinate nor speed, with its default: an
        expression of time and parameters, a number, or None if every run has to give it.
    initial : mapping of coordinate or speed to float, optional
        Default initial values of the independent coordinates and speeds, and guesses of the dependent
        coordinates.
    potential_energy : Expr, optional
        In terms of coordinates, parameters and time. By default the sum of the bodies' ``potential_energy``
        and the potentials of all forces that are constant in the System's frame, such as gravity.

    Raises
    ------
    ModelError
        If the System's parts do not fit together, or a symbol is missing, unknown, or named twice.

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

    def __init__(
        self,
        system: System,
        *,
        name: str = "model",
        parameters: Mapping[sm.Symbol, float | Parameter] | None = None,
        inputs: Mapping[sm.Expr, sm.Expr | float | None] | None = None,
        initial: Mapping[sm.Expr, float] | None = None,
        potential_energy: sm.Expr | None = None,
    ) -> None:
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
            raise ModelError(f"A model's name is letters, digits and underscores, a letter first; not {name!r}.")
        if keyword.iskeyword(name) or name in IMPORTED:
            raise ModelError(f"A model cannot be named {name!r}: Python or the generated code needs that name.")
        self.system = system
        self.name = name
        self.mechanism: Mechanism = read_mechanism(system)
        self.input_expressions = self._read_inputs(_mapping(inputs, "inputs"))
        self.potential_energy = None if potential_energy is None else _expression(potential_energy, "potential_energy")
        parameters = _mapping(parameters, "parameters")
        self.named_parameters = tuple(parameters)
        self.parameter_symbols = self._collect_parameters(parameters)
        self._check_names()
        self._check_inputs()
        self._check_holonomic_constraints()
        self.initial = self._check_initial(_mapping(initial, "initial"))

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the generalized coordinates, the independent ones first."""
        return tuple(_name(q) for q in self.mechanism.coordinates)

    @property
    def speeds(self) -> tuple[str, ...]:
        """Names of the generalized speeds, the independent ones first."""
        return tuple(_name(u) for u in self.mechanism.speeds)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return tuple(_name(r) for r in self.input_expressions)

    @cached_property
    def parameters(self) -> dict[str, Parameter]:
        """All symbols of the System by name, the ones that were named first."""
        return {symbol.name: parameter for symbol, parameter in self.parameter_symbols.items()}

    def __repr__(self) -> str:
        return (
            f"<Model {self.name}: {len(self.coordinates)} coordinates, {len(self.speeds)} speeds, "
            f"{len(self.parameter_symbols)} parameters, {len(self.inputs)} inputs>"
        )

    def _read_inputs(self, inputs: Mapping[sm.Expr, sm.Expr | float | None]) -> dict[sm.Expr, sm.Expr | None]:
        for function in inputs:
            if not isinstance(function, AppliedUndef) or function.args != (self.mechanism.time,):
                raise ModelError(f"inputs= has functions of {self.mechanism.time} as keys, not {function!r}.")
        return {f: None if e is None else _expression(e, f"the input {f}") for f, e in inputs.items()}

    def _collect_parameters(self, given: Mapping[sm.Symbol, float | Parameter]) -> dict[sm.Symbol, Parameter]:
        """The given symbols in their order, then the others by name; nothing that the model does not use."""
        mechanism = self.mechanism
        known = {*mechanism.coordinates, *mechanism.speeds, *self.input_expressions}
        rates = {q.diff(mechanism.time) for q in mechanism.coordinates}
        found: set[sm.Symbol] = set()
        labelled = [*mechanism.labelled_loads(), *mechanism.labelled_structure()]
        labelled.append(("the potential energy", () if self.potential_energy is None else (self.potential_energy,)))
        for name, expression in zip(self.inputs, self.input_expressions.values(), strict=True):
            if expression is not None:
                labelled.append((f"the expression of input {name}", (expression,)))
        for label, expressions in labelled:
            for node in walk(expressions):
                if isinstance(node, sm.Symbol):
                    found.add(node)
                elif isinstance(node, AppliedUndef) and node not in known:
                    raise ModelError(
                        f"{node} in {label} is neither a coordinate {self.coordinates} nor a speed {self.speeds} nor "
                        f"an input {self.inputs}: add it to the System's coordinates or speeds, or name it in inputs=."
                    )
                elif isinstance(node, sm.Derivative) and node not in rates:
                    raise ModelError(
                        f"{node} in {label} cannot be compiled: of all derivatives, only the first ones of the "
                        f"coordinates {self.coordinates} may appear."
                    )
        found.discard(mechanism.time)
        parameters: dict[sm.Symbol, Parameter] = {}
        for symbol, value in given.items():
            if symbol not in found:
                names = ", ".join(sorted(s.name for s in found))
                raise ModelError(f"Parameter {symbol} does not appear in the model; its symbols are {names}.")
            parameters[symbol] = value if isinstance(value, Parameter) else Parameter(value)
        for symbol in sorted(found - parameters.keys(), key=lambda s: s.name):
            parameters[symbol] = Parameter()
        return parameters

    def _check_names(self) -> None:
        names = [*self.coordinates, *self.speeds, *self.inputs, *(s.name for s in self.parameter_symbols)]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise ModelError(
                f"These names stand for more than one symbol: {', '.join(repeated)}. Coordinates, speeds, inputs and "
                "parameters are found by name, so each needs its own."
            )
        columns = sorted(name for name in names if COLUMNS.fullmatch(name))
        if columns:
            raise ModelError(f"Trajectories have columns named {', '.join(columns)}; give the symbols other names.")
        if self.mechanism.time.name in names:
            raise ModelError(f"{self.mechanism.time.name} is the name of time; give the other symbol another name.")

    def _check_inputs(self) -> None:
        """Inputs stand in loads alone, and their expressions know only time and parameters."""
        inputs = set(self.input_expressions)
        allowed = {self.mechanism.time, *self.parameter_symbols}
        for name, expression in zip(self.inputs, self.input_expressions.values(), strict=True):
            if expression is None:
                continue
            functions = any(isinstance(node, AppliedUndef | sm.Derivative) for node in walk([expression]))
            if functions or not expression.free_symbols <= allowed:
                raise ModelError(
                    f"The expression of input {name} may contain time and parameters only, not {expression}. State "
                    "feedback goes into the loads, or in at run time as a callable of (t, x)."
                )
        potential = [] if self.potential_energy is None else [("the potential energy", (self.potential_energy,))]
        for label, expressions in (*self.mechanism.labelled_structure(), *potential):
            for node in walk(expressions):
                if node in inputs:
                    raise ModelError(
                        f"Input {node} appears in {label}, where its rates would be needed. Write prescribed motion as "
                        "an expression of time and parameters instead of an input."
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

    def _check_initial(self, given: Mapping[sm.Expr, float]) -> dict[str, float]:
        states = {*self.mechanism.coordinates, *self.mechanism.speeds}
        initial = {}
        for function, value in given.items():
            if function not in states:
                raise ModelError(f"{function} in initial= is none of the states {(*self.coordinates, *self.speeds)}.")
            initial[_name(function)] = finite_number(value, f"initial {_name(function)}")
        return initial


def _mapping(given: Any, argument: str) -> Mapping[Any, Any]:
    if given is None:
        return {}
    if not is_mapping(given):
        raise ModelError(f"{argument}= must be a mapping from symbols to values, not {given!r}.")
    return given


def _expression(given: Any, what: str) -> sm.Expr:
    """A SymPy expression; text is not evaluated."""
    try:
        expression = sm.sympify(given, strict=True)
    except sm.SympifyError as error:
        raise ModelError(f"{what} must be an expression or a number, not {given!r}.") from error
    if not isinstance(expression, sm.Expr) or expression.is_extended_real is False or expression.is_finite is False:
        raise ModelError(f"{what} must be a real and finite expression, not {given!r}.")
    return expression


def _name(function: sm.Expr) -> str:
    return str(function.func)
