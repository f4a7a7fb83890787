"""CompiledModel: what users call of a compiled model, in one list."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from importlib import import_module
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, TypeVar, cast
from weakref import WeakValueDictionary

from fourbar_codegen.building.loading import kernel_of, load_named
from fourbar_codegen.interface.notebook import Page, names_table
from fourbar_codegen.interface.registered import Registered
from fourbar_codegen.kernel.kernel import Kernel
from fourbar_codegen.layout import Json, Layout

if TYPE_CHECKING:
    from fourbar_codegen.analysis.branches import kinematics as _kinematics
    from fourbar_codegen.analysis.equilibrium import equilibrium as _equilibrium
    from fourbar_codegen.analysis.equilibrium import stability as _stability
    from fourbar_codegen.analysis.initial_state import initial_state as _initial_state
    from fourbar_codegen.analysis.initial_state import initial_state_derivatives as _initial_state_derivatives
    from fourbar_codegen.analysis.initial_state import initial_states as _initial_states
    from fourbar_codegen.analysis.inverse_dynamics import inverse_dynamics as _inverse_dynamics
    from fourbar_codegen.analysis.linearization import linearize as _linearize
    from fourbar_codegen.analysis.linearization import state_space as _state_space
    from fourbar_codegen.body_shapes import BodyShape
    from fourbar_codegen.kernel.inputs import ode as _ode
    from fourbar_codegen.results.samples import trajectory as _trajectory
    from fourbar_codegen.simulation.batch import input_jacobian_batch as _input_jacobian_batch
    from fourbar_codegen.simulation.batch import jacobian_batch as _jacobian_batch
    from fourbar_codegen.simulation.batch import parameter_jacobian_batch as _parameter_jacobian_batch
    from fourbar_codegen.simulation.batch import residual_batch as _residual_batch
    from fourbar_codegen.simulation.batch import residual_jacobian_batch as _residual_jacobian_batch
    from fourbar_codegen.simulation.batch import residual_sparsity as _residual_sparsity
    from fourbar_codegen.simulation.batch import rhs_batch as _rhs_batch
    from fourbar_codegen.simulation.ensemble_run import ensemble as _ensemble
    from fourbar_codegen.simulation.simulate import runner as _runner
    from fourbar_codegen.simulation.simulate import simulate as _simulate
    from fourbar_codegen.simulation.simulate import stepper as _stepper

P = ParamSpec("P")
R = TypeVar("R")

__all__ = ["CompiledModel", "facade_of", "load", "model_of"]


def _of_kernel(function: Callable[Concatenate[Kernel, P], R]) -> Callable[Concatenate[Any, P], R]:
    """A function of a kernel as a method of a model."""

    @wraps(function)
    def method(self: CompiledModel, *args: P.args, **kwargs: P.kwargs) -> R:
        return function(self.kernel, *args, **kwargs)

    return cast(Callable[Concatenate[Any, P], R], method)


class _Later:
    """A method that calls a function with the kernel; its module is imported when the method is first asked for."""

    def __init__(self, module: str) -> None:
        self._module = module

    def __set_name__(self, owner: type, name: str) -> None:
        self._owner, self._name = owner, name

    def __get__(self, model: CompiledModel | None, owner: type) -> Callable[..., Any]:
        method = _of_kernel(getattr(import_module(f"fourbar_codegen.{self._module}"), self._name))
        setattr(self._owner, self._name, method)
        found: Callable[..., Any] = method.__get__(model, owner)
        return found


class CompiledModel:
    """A mechanism's equations of motion, compiled.

    Made by `compile_model` and `load`. Arguments are in the order (t, x, p, r): time, state x = [q; u; z],
    parameters, inputs. Parameters and inputs are arrays, or mappings from names or SymPy symbols; mappings may
    omit entries that have a default. Several threads may use one model at the same time.

    Attributes
    ----------
    name : str
    coordinates, speeds : tuple of str
        Generalized coordinates and speeds, the independent ones first.
    auxiliary_states : tuple of str
        States with first-order differential equations of their own.
    states : tuple of str
        Coordinates, speeds and auxiliary states.
    parameters, inputs, outputs : tuple of str
    points : tuple of str
        The points that are drawn: those with positions in the System, by their names there.
    forced_points : tuple of str
        Points at which forces act that depend on inputs.
    defaults : dict of str to float or None
        Parameter values; None if there is no default.
    units, descriptions : dict of str to str
        Of the parameters.
    prescribed : tuple of str
        Inputs that prescribe motions.
    path : Path
        The extension module, or the library of `compile_model`; an argument for `load`.
    kernel : Kernel
        The compiled functions. Its methods that are not methods here may change without notice.
    layout : Layout
        The description of the model: names, order, what depends on what.
    n_q, n_u, n_z, n_x, n_p, n_r : int
        Numbers of coordinates, speeds, auxiliary states, states, parameters and inputs.
    n_h, n_c, n_l, n_o : int
        Numbers of position constraints, of velocity constraints, of multipliers with unknown forces that drive the
        motion, and of outputs.

    Examples
    --------
    >>> import fourbar_codegen as fb
    >>> four_bar = fb.load("four_bar")
    >>> trajectory = four_bar.simulate((0.0, 1.0))
    >>> trajectory.success
    True
    """

    name: str
    coordinates: tuple[str, ...]
    speeds: tuple[str, ...]
    auxiliary_states: tuple[str, ...]
    states: tuple[str, ...]
    parameters: tuple[str, ...]
    inputs: tuple[str, ...]
    prescribed: tuple[str, ...]
    outputs: tuple[str, ...]
    points: tuple[str, ...]
    forced_points: tuple[str, ...]
    defaults: Mapping[str, float | None]
    units: Mapping[str, str]
    descriptions: Mapping[str, str]
    n_q: int
    n_u: int
    n_z: int
    n_x: int
    n_p: int
    n_r: int
    n_h: int
    n_c: int
    n_l: int
    n_o: int

    rhs = _of_kernel(Kernel.rhs)
    jacobian = _of_kernel(Kernel.jacobian)
    parameter_jacobian = _of_kernel(Kernel.parameter_jacobian)
    input_jacobian = _of_kernel(Kernel.input_jacobian)
    output_jacobian = _of_kernel(Kernel.output_jacobian)
    output_parameter_jacobian = _of_kernel(Kernel.output_parameter_jacobian)
    output_input_jacobian = _of_kernel(Kernel.output_input_jacobian)
    jvp = _of_kernel(Kernel.jvp)
    vjp = _of_kernel(Kernel.vjp)
    mass_matrix = _of_kernel(Kernel.mass_matrix)
    forcing = _of_kernel(Kernel.forcing)
    tree_mass_matrix = _of_kernel(Kernel.tree_mass_matrix)
    tree_forcing = _of_kernel(Kernel.tree_forcing)
    position_constraints = _of_kernel(Kernel.position_constraints)
    velocity_constraints = _of_kernel(Kernel.velocity_constraints)
    constraint_violation = _of_kernel(Kernel.constraint_violation)
    constraint_jacobian = _of_kernel(Kernel.constraint_jacobian)
    multipliers = _of_kernel(Kernel.multipliers)
    output = _of_kernel(Kernel.output)
    positions = _of_kernel(Kernel.positions)
    kinetic_energy = _of_kernel(Kernel.kinetic_energy)
    potential_energy = _of_kernel(Kernel.potential_energy)
    momentum = _of_kernel(Kernel.momentum)
    require_drawing = _of_kernel(Kernel.require_drawing)
    require_derivatives = _of_kernel(Kernel.require_derivatives)
    require_products = _of_kernel(Kernel.require_products)
    require_batch_functions = _of_kernel(Kernel.require_batch_functions)

    if TYPE_CHECKING:
        ode = _of_kernel(_ode)
        initial_state = _of_kernel(_initial_state)
        initial_state_derivatives = _of_kernel(_initial_state_derivatives)
        initial_states = _of_kernel(_initial_states)
        kinematics = _of_kernel(_kinematics)
        inverse_dynamics = _of_kernel(_inverse_dynamics)
        linearize = _of_kernel(_linearize)
        state_space = _of_kernel(_state_space)
        equilibrium = _of_kernel(_equilibrium)
        stability = _of_kernel(_stability)
        simulate = _of_kernel(_simulate)
        runner = _of_kernel(_runner)
        trajectory = _of_kernel(_trajectory)
        ensemble = _of_kernel(_ensemble)
        stepper = _of_kernel(_stepper)
        rhs_batch = _of_kernel(_rhs_batch)
        jacobian_batch = _of_kernel(_jacobian_batch)
        parameter_jacobian_batch = _of_kernel(_parameter_jacobian_batch)
        input_jacobian_batch = _of_kernel(_input_jacobian_batch)
        residual_batch = _of_kernel(_residual_batch)
        residual_jacobian_batch = _of_kernel(_residual_jacobian_batch)
        residual_sparsity = _of_kernel(_residual_sparsity)
    else:
        ode = _Later("kernel.inputs")
        initial_state = _Later("analysis.initial_state")
        initial_state_derivatives = _Later("analysis.initial_state")
        initial_states = _Later("analysis.initial_state")
        kinematics = _Later("analysis.branches")
        inverse_dynamics = _Later("analysis.inverse_dynamics")
        linearize = _Later("analysis.linearization")
        state_space = _Later("analysis.linearization")
        equilibrium = _Later("analysis.equilibrium")
        stability = _Later("analysis.equilibrium")
        simulate = _Later("simulation.simulate")
        runner = _Later("simulation.simulate")
        trajectory = _Later("results.samples")
        ensemble = _Later("simulation.ensemble_run")
        stepper = _Later("simulation.simulate")
        rhs_batch = _Later("simulation.batch")
        jacobian_batch = _Later("simulation.batch")
        parameter_jacobian_batch = _Later("simulation.batch")
        input_jacobian_batch = _Later("simulation.batch")
        residual_batch = _Later("simulation.batch")
        residual_jacobian_batch = _Later("simulation.batch")
        residual_sparsity = _Later("simulation.batch")

    page = Registered[..., Page]()

    def __init__(self, kernel: Kernel) -> None:
        self.__dict__.update({name: getattr(kernel, name) for name in CompiledModel.__annotations__}, _kernel=kernel)
        if type(self) is CompiledModel:  # without a call in between, which takes as long as a right-hand side
            self.__dict__.update({name: getattr(kernel, name) for name in EVALUATED})

    def __setattr__(self, name: str, value: object) -> None:
        if name == "kernel" or name in CompiledModel.__annotations__:
            raise AttributeError(
                f"{name} describes the compiled model {self.name}, and cannot be set: give parameters=, inputs= or "
                "initial values to what is called, or compile another Model."
            )
        super().__setattr__(name, value)

    @property
    def kernel(self) -> Kernel:
        """The compiled functions. Its methods that are not methods here may change without notice."""
        kernel: Kernel = self.__dict__["_kernel"]
        return kernel

    @property
    def path(self) -> Path:
        """The extension module, or the library of `compile_model`."""
        return self.kernel.path

    @property
    def layout(self) -> Layout:
        """The description of the model."""
        return self.kernel.layout

    @property
    def manifest(self) -> dict[str, Json]:
        """The layout as data that JSON can hold, as in the manifest.json of generated sources."""
        return self.layout.to_json()

    @property
    def is_verified(self) -> bool:
        """Whether the compiled equations of motion were compared with those that they were generated from.

        That happens at random states, or at the initial values, right after compilation. It is false with
        ``check=False``, where the equations have no real value at any of these states, and for the models that come
        with the package, which are compiled without SymPy.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.compile_model(fb.models.four_bar()).is_verified
        True
        >>> fb.load("four_bar").is_verified
        False
        """
        return bool(self.layout.compared)

    @property
    def energy_without(self) -> tuple[str, ...]:
        """Springs that the potential energy leaves out, since no antiderivative of their force was found.

        Also loads that depend on coordinates, if the speeds are too few to tell whether they have a potential.
        The energy of a run then changes by their work. Give ``potential_energy=`` to the Model to include them.
        """
        return self.kernel.energy_without

    @property
    def is_portable(self) -> bool:
        """Whether it runs on other machines, and was not built for the processor of one machine."""
        return self.kernel.is_portable

    @property
    def instructions(self) -> str:
        """The instruction set: "native" for the processor of this machine; for a portable module "baseline", "avx2" or
        "avx512", the best that the processor has.
        """
        return self.kernel.instructions

    @property
    def lacks_batch_functions(self) -> bool:
        """Whether the functions for batches of states are not built or loaded yet."""
        return self.kernel.lacks_batch_functions

    @property
    def lacks_drawing(self) -> bool:
        """Whether positions and orientations for pictures are not built or loaded yet."""
        return self.kernel.lacks_drawing

    @property
    def lacks_derivatives(self) -> bool:
        """Whether derivatives are not built or loaded yet."""
        return self.kernel.lacks_derivatives

    @property
    def lacks_products(self) -> bool:
        """Whether products of derivatives with vectors are not built or loaded yet."""
        return self.kernel.lacks_products

    @property
    def shapes(self) -> dict[str, tuple[BodyShape, ...]]:
        """What bodies and links look like in pictures in space, by name: given shapes, and those found by themselves.

        Assign a mapping of the bodies that should look otherwise, as for `Model`. It holds for this object and its
        runs; nothing is compiled. Sizes of found shapes are those of the parameters' default values.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> bicycle = fb.compile_model(fb.models.whipple_bicycle())
        >>> bicycle.shapes["front wheel"]
        (Wheel(radius='rf', at='fo', axis=(0.0, 1.0, 0.0)),)
        >>> bicycle.shapes = {"front wheel": fb.Wheel(0.35, axis=(0, 1, 0), color="red")}
        """
        found: dict[str, tuple[BodyShape, ...]] = self.kernel.shapes
        return found

    @shapes.setter
    def shapes(self, shapes: Mapping[Any, BodyShape | Sequence[BodyShape]]) -> None:
        self.kernel.set_shapes(shapes)

    def __reduce__(self) -> tuple[Any, ...]:
        return facade_of, (self.kernel,)

    def __repr__(self) -> str:
        auxiliary = ", ".join(self.auxiliary_states)
        return (
            f"<{type(self).__name__} {self.name}: coordinates {', '.join(self.coordinates)}; "
            f"speeds {', '.join(self.speeds)}; "
            f"{f'auxiliary states {auxiliary}; ' if auxiliary else ''}"
            f"parameters {', '.join(self.parameters) or 'none'}; inputs {', '.join(self.inputs) or 'none'}>"
        )

    def _repr_html_(self) -> str:
        return names_table(
            f"Compiled model {self.name}: {self.n_h} constraints on positions, {self.n_c} on velocities",
            [
                ("coordinate", self.coordinates, self.layout.n_dependent_coordinates),
                ("speed", self.speeds, self.layout.n_dependent_speeds),
                ("auxiliary state", self.auxiliary_states, 0),
            ],
            {name: (value, self.units[name], self.descriptions[name]) for name, value in self.defaults.items()},
            {entry.name: entry.expression for entry in self.layout.inputs},
            self.outputs,
        )


EVALUATED = tuple(name for name, method in vars(CompiledModel).items() if hasattr(method, "__wrapped__"))
"""Methods that are the kernel's own."""

_LOCK = Lock()
_MODELS: WeakValueDictionary[int, CompiledModel] = WeakValueDictionary()
"""By the identity of their kernels, which they keep alive."""


def facade_of(kernel: Kernel) -> CompiledModel:
    """The model of a kernel: always the same one, as long as it is in use."""
    with _LOCK:
        model = _MODELS.get(id(kernel))
        if model is None:
            model = _MODELS[id(kernel)] = CompiledModel(kernel)
    return model


def model_of(result: Any) -> CompiledModel:
    """The model of a result."""
    return facade_of(result.kernel)


def load(name: str | Path) -> CompiledModel:
    """Load a compiled model; neither SymPy nor a compiler is needed.

    (A library of `compile_model`, in the cache, needs a compiler once more for its first Jacobian or picture, and for
    its first batch or ensemble.)

    Parameters
    ----------
    name : str or Path
        The name of a model in this package, ``"four_bar"``, or of a model that was installed from a wheel of
        `build_wheel` (not from the current folder); or the path of an extension module of ``fourbar build`` or
        `build_model`, or of a library of `compile_model`. An installed package is only imported if its manifest.json
        identifies it as that model.

    Returns
    -------
    CompiledModel

    Raises
    ------
    ModelError
        If there is no such model, or the file is not a compiled model.

    Examples
    --------
    >>> load("four_bar").coordinates
    ('q1', 'q2', 'q3')
    """
    return facade_of(kernel_of(load_named(name)))
