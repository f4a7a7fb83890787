"""Kernel: a loaded model's names, and everything that it evaluates at a state."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.errors import ModelError, SimulationError
from fourbar_codegen.interface.arguments import (
    Values,
    finite_number,
    is_mapping,
    name_of,
    named,
    named_array,
    named_values,
)
from fourbar_codegen.interface.registered import Registered, RegisteredAttribute
from fourbar_codegen.kernel.dependent import eliminate
from fourbar_codegen.layout import Layout
from fourbar_codegen.runtime.enumerations import Role
from fourbar_codegen.runtime.evaluator import NOT_FINITE, is_finite
from fourbar_codegen.runtime.functions import DYNAMICS, ENERGY, OUTPUT, POSITION, Functions

__all__ = ["Kernel", "parameter_array"]

Floats = NDArray[np.float64]

ENERGIES = {"potential_energy", "energy", "potential energy", "total energy"}
"""Names of quantities with the potential energy, in tables and in plots."""


class Origin(Protocol):
    """Where a kernel came from, which makes the parts that are compiled at their first use."""

    @property
    def path(self) -> Path:
        """Of the extension module or library."""

    def built(self, kernel: Kernel, part: str) -> int:
        """The address of a part's table."""

    def reduced(self, kernel: Kernel) -> tuple[Any, ...]:
        """What a pickle has of a kernel."""


class Kernel(Functions):
    """A mechanism's compiled equations of motion, and their evaluation.

    The order of arguments is (t, x, p, r): time, state x = [q; u; z], parameters, inputs. Parameters and inputs are
    arrays in order, or mappings from names or SymPy symbols, which may leave out entries with a default.

    Its other attributes are those of `fourbar_codegen.CompiledModel`.

    Attributes
    ----------
    origin : Origin or None
        What compiles its later parts.
    """

    def __init__(self, capsule: object, layout: Layout, origin: Origin | None = None) -> None:  # noqa: ARG002
        self.origin = origin
        self.name: str = layout.name
        self.coordinates: tuple[str, ...] = layout.coordinates
        self.speeds: tuple[str, ...] = layout.speeds
        self.auxiliary_states: tuple[str, ...] = layout.auxiliary_states
        self.states: tuple[str, ...] = layout.states
        self.parameters: tuple[str, ...] = tuple(entry.name for entry in layout.parameters)
        self.inputs: tuple[str, ...] = tuple(entry.name for entry in layout.inputs)
        self.prescribed: tuple[str, ...] = layout.prescribed
        self.outputs: tuple[str, ...] = layout.outputs
        self.points: tuple[str, ...] = tuple(entry.name for entry in layout.drawing.points if entry.name)
        self.body_shapes = layout.drawing.body_shapes  # as data: their classes are imported for pictures alone
        self.forced_points: tuple[str, ...] = tuple(self.points[place] for place in layout.drawing.forced_points)
        self.defaults: Mapping[str, float | None] = MappingProxyType({e.name: e.default for e in layout.parameters})
        self.units: Mapping[str, str] = MappingProxyType({e.name: e.unit for e in layout.parameters})
        self.ranges: dict[str, tuple[float, float] | None] = {e.name: e.range for e in layout.parameters}
        self.descriptions: Mapping[str, str] = MappingProxyType({e.name: e.description for e in layout.parameters})

    # By the pictures, which stand above.
    shapes = RegisteredAttribute()
    set_shapes = Registered[[Any], None]()

    def __repr__(self) -> str:
        return f"<Kernel of {self.name}>"

    @property
    def path(self) -> Path:
        """The extension module, or the library of `compile_model`."""
        return Path() if self.origin is None else self.origin.path

    def __reduce__(self) -> tuple[Any, ...]:
        if self.origin is None:
            raise ModelError(f"The kernel of {self.name} cannot be pickled: it is not known where it came from.")
        return self.origin.reduced(self)

    def require_batch_functions(self) -> None:
        """Build and load the functions for batches of states, if the model was built without them.

        Portable modules contain them. `compile_model` does not build them; the first batch or ensemble calls this
        method.

        Raises
        ------
        BuildError, CacheError
            As for `compile_model`.
        ModelError
            If the sources are no longer beside the module.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.require_batch_functions()
        >>> four_bar.lacks_batch_functions
        False
        """
        if self.lacks_batch_functions:
            self.attach_batch_functions(self._built("batch_functions"))

    def require_drawing(self) -> None:
        """Build and load positions and orientations for pictures, if the model was built without them.

        As `require_batch_functions`: `compile_model` does not build them; the first picture calls this method.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.require_drawing()
        >>> four_bar.lacks_drawing
        False
        """
        if self.lacks_drawing:
            self.attach(self._built("drawing"))

    def require_derivatives(self) -> None:
        """Build and load derivatives, if the model was built without them.

        As `require_batch_functions`: `compile_model` does not build them; the first Jacobian calls this method.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.require_derivatives()
        >>> four_bar.lacks_derivatives
        False
        """
        if self.lacks_derivatives:
            self.attach(self._built("derivatives"))

    def require_products(self) -> None:
        """Build and load products of derivatives with vectors, if the model was built without them.

        As `require_derivatives`, which it also calls: the first sensitivities or gradients of a run call this method.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.require_products()
        >>> four_bar.lacks_products
        False
        """
        self.require_derivatives()
        if self.lacks_products:
            self.attach(self._built("products"))

    def _built(self, part: str) -> int:
        if self.origin is None:
            raise ModelError(
                f"The {part.replace('_', ' ')} of {self.name} cannot be built: their sources are not known."
            )
        return self.origin.built(self, part)

    @property
    def residual_label(self) -> str:
        """The title of residuals of the constraints in plots and tables."""
        return "Constraint residual" if self.layout.constraints.velocity_rows else "Loop residual"

    @property
    def energy_without(self) -> tuple[str, ...]:
        """Springs that the potential energy leaves out, since no antiderivative of their force was found.

        Also loads that depend on coordinates, if the speeds are too few to tell whether they have a potential.
        The energy of a run then changes by their work. Give ``potential_energy=`` to the Model to include them.
        """
        return self.layout.potential_energy.without

    def title(self, name: str) -> str:
        """The name of a quantity in plots and tables; an energy's says what it leaves out."""
        is_own = name in (*self.states, *self.inputs, *self.outputs)
        if is_own or name not in ENERGIES or not self.energy_without:
            return name
        return f"{name} without {', '.join(self.energy_without)}"

    # Names to arrays.

    def parameter_values(self, p: Values) -> Values:
        """All parameter values in order, for an array or a mapping.

        Raises
        ------
        ModelError
            If a name is not a parameter's, or a parameter has neither value nor default.
        """
        if not is_mapping(p):
            return p
        return named_values(p, self.parameters, self.defaults, "parameter")

    def input_values(self, r: Values, defaults: Sequence[float], all_count: bool = True) -> Values:
        """All input values in order, for an array or a mapping; 0 for those that are not given and do not count."""
        if not is_mapping(r):
            return r
        unknown = [None if all_count or entry.is_prescribed else 0.0 for entry in self.layout.inputs]
        known = {
            name: other if math.isnan(value) else value
            for name, value, other in zip(self.inputs, defaults, unknown, strict=True)
        }
        return named_values(r, self.inputs, known | self.rates_at_rest(r), "input")

    def rates_at_rest(self, r: Mapping[Any, Any]) -> dict[str, float]:
        """Rates of 0 for inputs that r gives without their rates: such an input is at rest."""
        in_force = zip(self.layout.inputs, self.defaults_in_force(r), strict=True)
        return {entry.name: 0.0 for entry, expression in in_force if entry.order and not expression}

    def held_inputs(self, r: Values) -> list[tuple[int, float]] | None:
        """Places and values of the inputs that a mapping names, and of their rates, which are 0 unless it names them.

        None for an array of all inputs.
        """
        if not is_mapping(r):
            return None
        given = {name: finite_number(value, f"input {name}") for name, value in named(r, self.inputs, "input").items()}
        held = self.rates_at_rest(r) | given
        return [(place, held[name]) for place, name in enumerate(self.inputs) if name in held]

    def defaults_in_force(self, r: Values | None) -> list[bool]:
        """For each input, whether its expression is used: r names neither it nor the input that it is a rate of."""
        if r is None or not is_mapping(r):
            return super().defaults_in_force(r)
        given = {name_of(key) for key in r}
        return [given.isdisjoint({entry.name, entry.of}) for entry in self.layout.inputs]

    def missing(self) -> str:
        """The message that names parameters and inputs without a default."""
        parameters = [name for name, value in self.defaults.items() if value is None]
        inputs = [entry.name for entry in self.layout.inputs if entry.expression is None]
        parts = [
            f"{kind} {', '.join(names)}" for kind, names in (("parameters", parameters), ("inputs", inputs)) if names
        ]
        return f"The model {self.name} has no default for its {' and '.join(parts)}: give them in the call."

    # Matrices and vectors.

    def tree_mass_matrix(self, t: float, x: ArrayLike, p: Values | None = None) -> Floats:
        """M of Kane's equations M u' = f with all speeds independent, shape (n_u, n_u).

        Parameters
        ----------
        t, x, p
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").tree_mass_matrix(0.0, [0.0] * 6).shape
        (3, 3)
        """
        return self._finite(self.evaluate(DYNAMICS, t, x, p, np.zeros(self.n_r))[1], t, x)

    def tree_forcing(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The vector f of Kane's equations M u' = f with all speeds independent, shape (n_u,).

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").tree_forcing(0.0, [0.0] * 6).round(1).tolist()
        [-2374.0, -1417.5, -240.3]
        """
        return self._finite(self.dynamics(t, x, p, r)[2] + self._force_effect(t, x, p, r), t, x)

    def _force_effect(self, t: float, x: ArrayLike, p: Values | None, r: Values | None) -> Floats | float:
        """The contribution of unknown forces that drive the motion to f, shape (n_u,)."""
        if self.n_l == self.n_c:
            return 0.0
        effect: Floats = self.unknown_forces(t, x, self.accelerations(t, x, p, r)[1][self.n_c :], p, r)[0]
        return effect

    def mass_matrix(self, t: float, x: ArrayLike, p: Values | None = None) -> Floats:
        """SymPy's ``System.mass_matrix``, shape (n_u, n_u).

        Kane's equations projected onto the model's independent speeds, above the constraints' Jacobian. See `forcing`.

        Parameters
        ----------
        t, x, p
            As for `rhs`.

        Raises
        ------
        SimulationError
            If the model's own dependent speeds do not follow from the independent ones in this configuration.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.mass_matrix(0.0, four_bar.initial_state()).shape
        (3, 3)
        """
        _, mass_matrix, _, jacobian, _ = self.dynamics(t, x, p, np.zeros(self.n_r))
        self._finite(jacobian, t, x)
        return self._finite(np.vstack((self._projection(jacobian).T @ mass_matrix, jacobian)), t, x)

    def forcing(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """SymPy's ``System.forcing``, shape (n_u,): ``mass_matrix @ u' = forcing``.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            If the model's own dependent speeds do not follow from the independent ones in this configuration.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> x0 = four_bar.initial_state()
        >>> residual = four_bar.mass_matrix(0.0, x0) @ four_bar.rhs(0.0, x0)[3:] - four_bar.forcing(0.0, x0)
        >>> bool(abs(residual).max() < 1e-9)
        True
        """
        _, _, forcing, jacobian, bias = self.dynamics(t, x, p, r)
        self._finite(jacobian, t, x)
        forcing = forcing + self._force_effect(t, x, p, r)
        return self._finite(np.concatenate((self._projection(jacobian).T @ forcing, -bias)), t, x)

    def _finite(self, values: Floats, t: float, x: ArrayLike) -> Floats:
        """The values; raises a SimulationError if they are not finite."""
        if not is_finite(values if values.flags.c_contiguous else values.copy()):
            raise SimulationError(self.failure(NOT_FINITE, t, x))
        return values

    def _finite_number(self, value: float, t: float, x: ArrayLike) -> float:
        """The value; raises a SimulationError if it is not finite."""
        if not math.isfinite(value):
            raise SimulationError(self.failure(NOT_FINITE, t, x))
        return value

    def _projection(self, jacobian: Floats) -> Floats:
        """T with u = T u_i + ... for the model's own independent speeds, shape (n_u, n_ui)."""
        n_i = self.layout.n_independent_speeds
        return np.vstack((np.eye(n_i), eliminate(jacobian, n_i, self.speeds[n_i:])))

    def position_constraints(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Residuals of the holonomic constraints, shape (n_h,), in the constraints' units.

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").position_constraints(0.0, [0.0, 0.0, 0.0]).tolist()
        [3.0, 0.0]
        """
        return self._finite(self.evaluate(POSITION, t, q, p, r)[0], t, q)

    def positions(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> dict[str, Floats]:
        """Positions of the mechanism's points, by name, m, each of shape (3,), from the System's fixed point.

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `position_constraints`.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> q = four_bar.initial_state()[:3]
        >>> four_bar.positions(0.0, q)["joint3_link3_joint"].round(3).tolist()
        [-0.084, -0.625, 0.0]
        """
        coordinates = named_array(q, self.coordinates, {}, "coordinate")
        positions, _ = self.drawing(t, np.concatenate((coordinates, np.zeros(self.n_x - self.n_q))), p, r)
        return dict(zip(self.points, positions, strict=False))  # those without names come last

    def velocity_constraints(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Residuals J u + b of the velocity constraints, shape (n_c,), holonomic ones first.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> bool(abs(four_bar.velocity_constraints(0.0, four_bar.initial_state())).max() < 1e-14)
        True
        """
        jacobian, bias = self.velocity(t, x, p, r)
        residual: Floats = jacobian @ np.asarray(x, dtype=float)[self.n_q : self.n_q + self.n_u] + bias
        return self._finite(residual, t, x)

    def constraint_jacobian(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """J of the velocity constraints J u + b = 0, shape (n_c, n_u).

        Parameters
        ----------
        t : float
        q : array_like, shape (n_q,)
        p, r : array_like or mapping, optional
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> abs(fb.load("four_bar").constraint_jacobian(0.0, [0.0, 0.0, 0.0])).round(3).tolist()
        [[0.0, 0.0, 0.0], [2.2, 1.7, 0.7]]
        """
        coordinates = named_array(q, self.coordinates, {}, "coordinate")
        return self._finite(
            self.velocity(t, np.concatenate((coordinates, np.zeros(self.n_x - self.n_q))), p, r)[0], t, q
        )

    def multipliers(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Multipliers lambda of M u' = f + J^T lambda, shape (n_c,).

        They are the generalized reactions conjugate to the constraints in the form they were written: for the
        four-bar, the force (N) of the ground on the end of link 4.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            In a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.multipliers(0.0, four_bar.initial_state()).shape
        (2,)
        """
        return self.accelerations(t, x, p, r)[1][: self.n_c]

    def output(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The outputs, shape (n_o,), in the order of ``outputs``.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`.

        Raises
        ------
        SimulationError
            In a singular position.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> four_bar.outputs, four_bar.output(0.0, four_bar.initial_state()).shape
        ((), (0,))
        """
        output: Floats = self.evaluate(OUTPUT, t, x, p, r, *self.accelerations(t, x, p, r))[0]
        return output

    def kinetic_energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> float:
        """Kinetic energy, J.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").kinetic_energy(0.0, [0.1, 0.2, 0.3, 0.0, 0.0, 0.0])
        0.0
        """
        return self._finite_number(self.evaluate(ENERGY, t, x, p, r)[0].item(0), t, x)

    def potential_energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> float:
        """Potential energy, J: as given with the Model, or of bodies, constant forces, such as gravity, and springs.

        `energy_without` names springs that it leaves out.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Raises
        ------
        ModelError
            If it is unknown (see `potential_energy` of the Model), or depends on an input without expression that is
            not given.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> fb.load("four_bar").potential_energy(0.0, [0.0] * 6)
        0.0
        """
        if not self.layout.potential_energy.is_known:
            raise ModelError(
                f"The potential energy of {self.name} is not known: a constant force acts at a point whose position "
                "relative to a fixed point is not defined, or whose velocity is not the rate of that position; or the "
                "loss of the bodies' potentials is not the work of loads. Give potential_energy= to the Model."
            )
        energy = self.energy(t, x, p, r).item(1)
        if r is None and math.isnan(energy) and not self.has_inputs:
            raise ModelError(self.missing())
        return self._finite_number(energy, t, x)

    def momentum(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Linear and angular momentum of the bodies that move, in the inertial frame.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Returns
        -------
        momentum : ndarray, shape (3,)
            p = sum m v, kg m/s.
        angular_momentum : ndarray, shape (3,)
            L_O = sum (r x m v + I w), kg m^2/s, about the System's fixed point; of a KanesMethod, about the point at
            rest that positions refer to, the first of `points`. NaN if the position of a mass centre relative to it is
            not known, or if it moves, as a wheel's contact point does.
        spin : ndarray, shape (3,)
            L_C = L_O - r x p about the mass centre r of these bodies, kg m^2/s. NaN also if their total mass is zero.

        A component is NaN, too, if it contains a parameter that the equations of motion do not need and the Model does
        not name, such as a product of inertia of a body that turns about one axis.

        Raises
        ------
        ModelError
            As for `rhs`.
        SimulationError
            If p is not finite.

        Source: T. R. Kane and D. A. Levinson, *Dynamics: Theory and Applications*, 1985, section 3.5.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> momentum, about_fixed_point, _ = fb.load("four_bar").momentum(0.0, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
        >>> momentum.round(6).tolist()[1], about_fixed_point.shape
        (242.0, (3,))
        """
        momentum, angular_momentum, spin = self.evaluate(Role.MOMENTA, t, x, p, r)
        return self._finite(momentum, t, x), angular_momentum, spin


def parameter_array(model: Kernel, parameters: Floats | None) -> Floats:
    """Parameters, or the defaults for None, shape (n_p,)."""
    return np.array([*model.defaults.values()], dtype=float) if parameters is None else parameters
