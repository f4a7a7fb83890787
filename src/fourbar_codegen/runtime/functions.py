"""The functions of a kernel's table as methods, with their names and shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fourbar_codegen.runtime.enumerations import QUANTITIES, VECTORS, Role
from fourbar_codegen.runtime.evaluator import Evaluator

__all__ = ["Functions"]

# Of an enumeration, an attribute takes 0.2 us in Python 3.11, as much as a function at one state.
DYNAMICS, POSITION, VELOCITY, ENERGY, OUTPUT = Role.DYNAMICS, Role.POSITION, Role.VELOCITY, Role.ENERGY, Role.OUTPUT
CONSTRAINT_VIOLATION, CONSTRAINT_SCALE = Role.CONSTRAINT_VIOLATION, Role.CONSTRAINT_SCALE
CONSTRAINT_PARTIALS, COORDINATE_CHANGE = Role.CONSTRAINT_PARTIALS, Role.COORDINATE_CHANGE

Floats = NDArray[np.float64]
Values = ArrayLike | Mapping[Any, float]


class Functions(Evaluator):
    """An `Evaluator` whose table of functions has methods: what they compute is in ``fourbar_enums.h``."""

    def breakpoints(self, p: Values | None = None) -> Floats:
        """The breakpoints, times at which expressions may not be smooth, shape (n_breakpoints,)."""
        return self.evaluate(Role.BREAKPOINTS, 0.0, None, p)[0]

    def default_inputs(self, t: float, p: Values | None = None) -> Floats:
        """The inputs' expressions at one time, shape (n_r,); NaN for inputs without one."""
        return self.evaluate(Role.DEFAULT_INPUTS, t, None, p)[0]

    def default_input_partials(self, t: float, p: Values | None = None) -> Floats:
        """The derivatives of the inputs' expressions with respect to parameters, shape (n_r, n_p); 0 without one."""
        return self.evaluate(Role.DEFAULT_INPUT_PARTIALS, t, None, p)[0]

    def dynamics(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """q', M, f, J and gamma of M u' = f + J^T lambda, J u' + gamma = 0."""
        rates, mass_matrix, forcing, jacobian, bias = self.evaluate(DYNAMICS, t, x, p, r)
        return rates, mass_matrix, forcing, jacobian, bias

    def position(
        self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """The position constraints, shape (n_h,), and their Jacobian, shape (n_h, n_q)."""
        constraints, jacobian = self.evaluate(POSITION, t, q, p, r)
        return constraints, jacobian

    def velocity(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """J, shape (n_c, n_u), and b, shape (n_c,), of the velocity constraints J u + b = 0."""
        jacobian, bias = self.evaluate(VELOCITY, t, x, p, r)
        return jacobian, bias

    def constraint_violation(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """Constraint violations: of positions, in the rows of J and then invariants, and of velocities.

        Parameters
        ----------
        t, x, p, r
            As for `rhs`; the inputs count where they prescribe a motion.

        Returns
        -------
        positions : ndarray, shape (n_c + n_i,)
            Phi, 0 in the rows of nonholonomic constraints, and the n_i invariants, such as norms of quaternions.
        velocities : ndarray, shape (n_c,)
            J u + b.

        Examples
        --------
        >>> import fourbar_codegen as fb
        >>> four_bar = fb.load("four_bar")
        >>> positions, velocities = four_bar.constraint_violation(0.0, four_bar.initial_state())
        >>> bool(max(abs(positions).max(), abs(velocities).max()) < 1e-12)
        True
        """
        positions, velocities = self.evaluate(CONSTRAINT_VIOLATION, t, x, p, r)
        return positions, velocities

    def constraint_scale(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """Scales of the position constraints, shape (n_h,), and of both results of `constraint_violation`."""
        constraints, positions, velocities = self.evaluate(CONSTRAINT_SCALE, t, x, p, r)
        return constraints, positions, velocities

    def coordinate_change(
        self, t: float, x: ArrayLike, change: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> Floats:
        """K v, the change of the coordinates, shape (n_q,), for a change v of the speeds' integrals."""
        return self.evaluate(COORDINATE_CHANGE, t, x, p, r, arguments=(change,))[0]

    def invariant_correction(self, t: float, q: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The change of the coordinates, shape (n_q,), that corrects invariants (constraints that no speed changes)."""
        return self.evaluate(Role.INVARIANT_CORRECTION, t, q, p, r)[0]

    def constraint_partials(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """d(J u + b)/dq, shape (n_c, n_q), dPhi/dr, shape (n_h, n_r), and d(J u + b)/dr, shape (n_c, n_r)."""
        wrt_coordinates, positions, velocities = self.evaluate(CONSTRAINT_PARTIALS, t, x, p, r)
        return wrt_coordinates, positions, velocities

    def constraint_vjp(
        self, t: float, x: ArrayLike, weights: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> Floats:
        """The gradient with respect to x, p and r, shape (n_x + n_p + n_r,), of weights times the constraint
        violations.

        Weights have the shape (2 n_c + n_i,), for both results of `constraint_violation`. Inputs do not follow the
        parameters.
        """
        return self.evaluate(Role.CONSTRAINT_VJP, t, x, p, r, arguments=(weights,))[0]

    def unknown_forces(
        self, t: float, x: ArrayLike, forces: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
        """For unknown forces n: F, (n_u,), dF/dn, Q, (n_n,), dQ/dn, M_a, (n_n, n_u), and J_a^T, (n_n, n_c).

        See ``kernel/unknown_forces.h``.
        """
        effect, wrt_forces, rest, rest_wrt_forces, mass, jacobian = self.evaluate(
            Role.UNKNOWN_FORCES, t, x, p, r, arguments=(forces,)
        )
        return effect, wrt_forces, rest, rest_wrt_forces, mass, jacobian

    def energy(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """Kinetic and potential energy, shape (2,)."""
        return self.evaluate(ENERGY, t, x, p, r)[0]

    def quantities_along(
        self, times: ArrayLike, states: Floats, inputs: Floats, p: Values | None = None
    ) -> dict[str, Floats]:
        """The vectors of `VECTORS` by name, each of shape (3, n_t), for states and inputs in columns."""
        wanted: dict[int, tuple[int, ...]] = {role: (*range(len(of)),) for role, of in QUANTITIES.items()}
        _, found = self.evaluate_along(wanted, times, states, inputs, p)
        return {quantity.name: each for quantity, each in zip(VECTORS, found, strict=True)}

    def drawing(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """Positions of the drawn points, shape (n_points, 3), and the inputs' forces, shape (n_forces, 3)."""
        points, forces = self.evaluate(Role.DRAWING, t, x, p, r)
        return points, forces

    def drawing_along(self, times: ArrayLike, states: Floats, inputs: Floats, p: Values | None = None) -> list[Floats]:
        """The same for states and inputs in columns, shapes (n_points, 3, n_t) and (n_forces, 3, n_t)."""
        return self.evaluate_along({Role.DRAWING: (0, 1)}, times, states, inputs, p)[1]

    def orientations(self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None) -> Floats:
        """The rotation matrices of the drawn bodies, shape (n_bodies, 3, 3)."""
        return self.evaluate(Role.ORIENTATIONS, t, x, p, r)[0].reshape(-1, 3, 3)

    def orientations_along(self, times: ArrayLike, states: Floats, inputs: Floats, p: Values | None = None) -> Floats:
        """The same, shape (n_bodies, 3, 3, n_t), for states and inputs in columns."""
        [rotations] = self.evaluate_along({Role.ORIENTATIONS: (0,)}, times, states, inputs, p)[1]
        return rotations.reshape(-1, 3, 3, rotations.shape[-1])

    def mass_properties(
        self, t: float, x: ArrayLike, p: Values | None = None, r: Values | None = None
    ) -> tuple[Floats, Floats]:
        """Masses of the drawn bodies, shape (n_bodies,), and central inertias along their axes, (n_bodies, 3, 3)."""
        masses, inertias = self.evaluate(Role.MASS_PROPERTIES, t, x, p, r)
        return masses, inertias.reshape(-1, 3, 3)

    def motion_along(self, times: ArrayLike, states: Floats, inputs: Floats, p: Values | None = None) -> list[Floats]:
        """Velocities and accelerations of the drawn points, shape (n_points, 3, n_t), NaN at singular positions."""
        return self.evaluate_along({Role.MOTION: (1, 2)}, times, states, inputs, p)[1]

    def motion(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> tuple[Floats, Floats, Floats]:
        """q'', shape (n_q,), and velocities and accelerations of the drawn points, (n_points, 3), with u' given."""
        second, velocities, of_velocities = self.evaluate(Role.MOTION, t, x, p, r, accelerations)
        return second, velocities, of_velocities

    def outputs_for(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> Floats:
        """The outputs, shape (n_o,), for given u' and lambda."""
        return self.evaluate(OUTPUT, t, x, p, r, accelerations, multipliers)[0]

    def state_rates_for(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> Floats:
        """z', shape (n_z,), for given u' and lambda."""
        return self.evaluate(Role.STATE_RATES, t, x, p, r, accelerations, multipliers)[0]

    def state_rate_partials(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> tuple[Floats, Floats]:
        """dz'/du', shape (n_z, n_u), and dz'/dlambda, shape (n_z, n_l), for given u' and lambda."""
        wrt_accelerations, wrt_multipliers = self.evaluate(
            Role.STATE_RATE_PARTIALS, t, x, p, r, accelerations, multipliers
        )
        return wrt_accelerations, wrt_multipliers

    def partials(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> list[Floats]:
        """The partial Jacobians with respect to x, p and r for given u' and lambda, six arrays.

        They are dq', shape (n_q, n), and d(f - M u' + J^T lambda, -(J u' + gamma), z'), shape (n_u + n_l + n_z, n).
        """
        roles = (Role.STATE_PARTIALS, Role.PARAMETER_PARTIALS, Role.INPUT_PARTIALS)
        return [part for role in roles for part in self.evaluate(role, t, x, p, r, accelerations, multipliers)]

    def output_partials(
        self,
        t: float,
        x: ArrayLike,
        accelerations: ArrayLike,
        multipliers: ArrayLike,
        p: Values | None = None,
        r: Values | None = None,
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """The outputs' derivatives with respect to x, p, r, u' and lambda, each with the others fixed, five arrays."""
        roles = (
            Role.OUTPUT_STATE_PARTIALS,
            Role.OUTPUT_PARAMETER_PARTIALS,
            Role.OUTPUT_INPUT_PARTIALS,
            Role.OUTPUT_SOLUTION_PARTIALS,
        )
        wrt_state, wrt_parameters, wrt_inputs, wrt_accelerations, wrt_multipliers = (
            part for role in roles for part in self.evaluate(role, t, x, p, r, accelerations, multipliers)
        )
        return wrt_state, wrt_parameters, wrt_inputs, wrt_accelerations, wrt_multipliers

    def along(
        self, times: ArrayLike, states: ArrayLike, inputs: ArrayLike, p: Values | None = None
    ) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Position constraints, (n_h, n_t), J u + b, (n_c, n_t), energies, (2, n_t), multipliers, (n_c, n_t), and
        outputs, (n_o, n_t).

        States and inputs are given in columns. Multipliers and outputs are NaN where the accelerations cannot be
        evaluated.
        """
        wanted: dict[int, tuple[int, ...]] = {
            Role.POSITION: (0,),
            CONSTRAINT_VIOLATION: (1,),
            Role.ENERGY: (0,),
            Role.OUTPUT: (0,),
        }
        multipliers, found = self.evaluate_along(wanted, times, states, inputs, p)
        constraints, velocities, energies, outputs = found
        return constraints, velocities, energies, multipliers[: self.n_c], outputs
