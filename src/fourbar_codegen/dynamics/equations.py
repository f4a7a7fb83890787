"""The equations of a mechanism over one tape, in parts; ``formation.py`` forms them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from fourbar_codegen.dynamics.drawn_positions import DrawnPositions
from fourbar_codegen.dynamics.recursion import Recursion
from fourbar_codegen.expressions.tape import Leaf, Node, Result, Scalar, Tape
from fourbar_codegen.layout import Formulas
from fourbar_codegen.runtime.enumerations import Role

__all__ = [
    "Drawing",
    "DrawnBodies",
    "DrivingForces",
    "Dynamics",
    "Energy",
    "Equations",
    "Inputs",
    "Jump",
    "PositionConstraints",
    "Variables",
    "VelocityConstraints",
    "matrix",
    "of_known",
    "results_of",
    "vector",
]


@dataclass(frozen=True)
class Variables:
    """The leaves of the tape, in the order of the arrays.

    Attributes
    ----------
    time : Scalar
    coordinates, speeds, auxiliary_states : tuple of Scalar
    parameters : tuple of Scalar
        Those that the model names or the equations need.
    inputs : tuple of Scalar
        Those that prescribe a motion are followed by their rates.
    accelerations : tuple of Scalar
        Leaves for u' in `Dynamics.residual`, `Dynamics.state_rates` and the outputs.
    multipliers : tuple of Scalar
        Leaves for the constraints' multipliers there, then for unknown forces n that drive the motion, (n_c + n_n,).
    """

    time: Scalar
    coordinates: tuple[Scalar, ...]
    speeds: tuple[Scalar, ...]
    auxiliary_states: tuple[Scalar, ...]
    parameters: tuple[Scalar, ...]
    inputs: tuple[Scalar, ...]
    accelerations: tuple[Scalar, ...]
    multipliers: tuple[Scalar, ...]

    @property
    def state(self) -> tuple[Scalar, ...]:
        """X = [q; u; z]."""
        return (*self.coordinates, *self.speeds, *self.auxiliary_states)


@dataclass(frozen=True)
class Inputs:
    """What is known of the inputs.

    Attributes
    ----------
    default : Result
        Their expressions, (n_r,); NaN for inputs without one.
    rates : tuple of (int, int)
        Numbers of the inputs whose rates are inputs too, and of these.
    prescribed : tuple of int
        The inputs that positions, velocities or constraints depend on.
    breakpoints : Result
        Breakpoints of the results, as far as these follow from parameters, (n_breakpoints,).
    n_motion_breakpoints : int
        The number of breakpoints of positions or velocities, which come first.
    """

    default: Result
    rates: tuple[tuple[int, int], ...]
    prescribed: tuple[int, ...]
    breakpoints: Result
    n_motion_breakpoints: int


@dataclass(frozen=True)
class Dynamics:
    """Kinematic and dynamic equations.

    Attributes
    ----------
    coordinate_rates : Result
        q', (n_q,).
    coordinate_change : Result
        K v, (n_q,), the change of the coordinates for a change v of the speeds' integrals; v is in
        `Variables.accelerations`.
    mass_matrix, forcing : Result
        M, (n_u, n_u), and f, (n_u,), without unknown forces.
    recursion : Recursion or None
        f, and products with M and its inverse, without M; None for few speeds, or bodies without mass.
    state_rates : Result
        z', (n_z,), for given u' and multipliers.
    residual : Result
        (f + F - M u' + J^T lambda, -(J u' + gamma), Q - M_a u' + J_a^T lambda, z') for given u' and multipliers,
        (n_u + n_c + n_n + n_z,), to be differentiated.
    """

    coordinate_rates: Result
    coordinate_change: Result
    mass_matrix: Result
    forcing: Result
    recursion: Recursion | None
    state_rates: Result
    residual: Result


@dataclass(frozen=True)
class DrivingForces:
    """Unknown forces n that drive the motion; without such forces F is zero, and the other results are empty.

    Attributes
    ----------
    effect, effect_jacobian : Result
        F(n), (n_u,), their contribution to f, and dF/dn, (n_u, n_n).
    forcing, forcing_jacobian, mass, constraint_jacobian : Result
        Q(n), (n_n,), dQ/dn, (n_n, n_n), M_a, (n_n, n_u), and J_a^T, (n_n, n_c), of the auxiliary speeds' rows
        Q - M_a u' + J_a^T lambda = 0.
    are_linear : bool
        Whether F and Q are linear in n.
    """

    effect: Result
    effect_jacobian: Result
    forcing: Result
    forcing_jacobian: Result
    mass: Result
    constraint_jacobian: Result
    are_linear: bool


@dataclass(frozen=True)
class PositionConstraints:
    """Position constraints, and how violations are corrected.

    Attributes
    ----------
    constraints, jacobian : Result
        Phi, (n_h,), and dPhi/dq, (n_h, n_q).
    formulas : Formulas
        Phi as plain data.
    rows : tuple of (int or None)
        For each constraint the row of J that keeps it; None for invariants and redundant constraints.
    invariants : tuple of int
        The constraints whose rates are zero for all speeds.
    violation : Result
        w of `Corrections` in the rows of J, then the invariants, (n_c + n_i,).
    scale, violation_scale : Result
        Scales of `constraints` and `violation`: their rounding errors, by which violations are measured.
    invariant_correction : Result
        The change of the coordinates that corrects violations of the invariants, (n_q,).
    not_orthonormal : tuple of Scalar
        Scalars that are zero where direction cosines are orthonormal, but not identically.
    closed_states : tuple of dict
        Some states at which the constraints hold, if fewer speeds are dependent than there are constraints.
    """

    constraints: Result
    jacobian: Result
    formulas: Formulas
    rows: tuple[int | None, ...]
    invariants: tuple[int, ...]
    violation: Result
    scale: Result
    violation_scale: Result
    invariant_correction: Result
    not_orthonormal: tuple[Scalar, ...]
    closed_states: tuple[dict[Scalar, float], ...]


@dataclass(frozen=True)
class VelocityConstraints:
    """Velocity constraints J u + b = 0, and J u' + gamma = 0.

    Attributes
    ----------
    jacobian, bias, acceleration_bias : Result
        J, (n_c, n_u); b and gamma, (n_c,). Rows of holonomic constraints first, if they are derived.
    violation, violation_scale : Result
        J u + b, (n_c,), and its scale.
    n_dependent_speeds : int
    are_derived : bool
        Whether they begin with the rates of the position constraints, except invariants.
    """

    jacobian: Result
    bias: Result
    acceleration_bias: Result
    violation: Result
    violation_scale: Result
    n_dependent_speeds: int
    are_derived: bool


@dataclass(frozen=True)
class Energy:
    """Energies.

    Attributes
    ----------
    energies : Result
        Kinetic and potential energy, (2,); the latter NaN if it is not known.
    without : tuple of str
        Springs that the potential energy leaves out, since no antiderivative of their force was found.
    power : Result
        Power of the loads without unknown forces, (1,), only for tests of the other results; see `Kane.power`.
    """

    energies: Result
    without: tuple[str, ...]
    power: Result


@dataclass(frozen=True)
class Drawing:
    """What is drawn.

    Attributes
    ----------
    picture : DrawnPositions
    points : Result
        Positions of its points in the inertial frame, (n_points, 3).
    forced : tuple of int
        Numbers of the points at which forces of inputs act.
    forces : Result
        These forces in the inertial frame, (n_forces, 3).
    """

    picture: DrawnPositions
    points: Result
    forced: tuple[int, ...]
    forces: Result


@dataclass(frozen=True)
class DrawnBodies:
    """The bodies in pictures: those with a frame whose orientation is known.

    Attributes
    ----------
    names : tuple of str
    orientations : Result
        For each of them the rotation matrix that takes components along its axes to the inertial frame, row by row,
        (n_bodies, 9).
    masses : Result
        (n_bodies,).
    inertias : Result
        About their mass centres, along their axes, row by row, (n_bodies, 9).
    """

    names: tuple[str, ...]
    orientations: Result
    masses: Result
    inertias: Result


@dataclass(frozen=True)
class Jump:
    """A jump of the equations of motion, or of the expression of an input, where a condition changes its sign.

    Attributes
    ----------
    function : str
        The name of the function that switches, such as "sign".
    condition : Scalar
    leaves : tuple of Scalar
        Those of the state, the inputs and time that the condition depends on.
    input : int or None
        The number of the input in whose expression it stands.
    by_default : bool
        Whether it jumps with the known values of parameters, not only with others.
    is_known : bool
        Whether it is known that it jumps: not where the rows have no real value at any of the random states.
    """

    function: str
    condition: Scalar
    leaves: tuple[Scalar, ...]
    input: int | None
    by_default: bool
    is_known: bool


@dataclass(frozen=True)
class Equations:
    """The equations of a mechanism over one tape.

    Attributes
    ----------
    tape : Tape
    variables : Variables
    inputs : Inputs
    dynamics : Dynamics
    driving_forces : DrivingForces
    positions : PositionConstraints
    velocities : VelocityConstraints
    outputs : Result
        The outputs, (n_o,), for given u' and multipliers.
    energy : Energy
    quantities : dict of Role to tuple of Result
        Other functions of a state, in the order of `QUANTITIES`.
    drawing : Drawing
    bodies : DrawnBodies
    warnings : tuple of str
        A sentence for each inconsistency of the kinematics.
    jumps : tuple of Jump
        At times that are not known beforehand.
    conditions : Result
        The conditions of jumps that depend on the state or on inputs, each once, (n_conditions,).
    """

    tape: Tape
    variables: Variables
    inputs: Inputs
    dynamics: Dynamics
    driving_forces: DrivingForces
    positions: PositionConstraints
    velocities: VelocityConstraints
    outputs: Result
    energy: Energy
    quantities: Mapping[Role, tuple[Result, ...]]
    drawing: Drawing
    bodies: DrawnBodies
    warnings: tuple[str, ...]
    jumps: tuple[Jump, ...]
    conditions: Result

    @property
    def results(self) -> tuple[Result, ...]:
        """All results."""
        forces, constraints = self.driving_forces, (self.positions, self.velocities)
        parts = (self, self.inputs, self.dynamics, forces, *constraints, self.energy, self.drawing, self.bodies)
        return *results_of(*parts), *chain.from_iterable(self.quantities.values())


def results_of(*parts: object) -> Iterator[Result]:
    """The results in parts of equations."""
    return (value for part in parts for value in vars(part).values() if isinstance(value, Result))


def vector(name: str, entries: Iterable[Scalar]) -> Result:
    """A result of one dimension."""
    entries = tuple(entries)
    return Result(name, (len(entries),), entries)


def matrix(name: str, rows: Sequence[Sequence[Scalar]], columns: int) -> Result:
    """A result with given rows; the number of columns counts where there are none."""
    return Result(name, (len(rows), columns), tuple(entry for row in rows for entry in row))


def of_known(variables: Variables, entries: Sequence[Scalar]) -> list[Scalar]:
    """The entries; NaN for those that contain other parameters or inputs than the variables."""
    tape, known = variables.time.tape, {leaf.node for leaf in (*variables.parameters, *variables.inputs)}
    reached = tape.reach(entries)
    left_out = [Scalar(tape, 1, n) for n in reached if n not in known and _is_argument(tape.nodes[n])]
    unknown = tape.dependent(reached, left_out) if left_out else set()
    return [tape.number(float("nan")) if entry.node in unknown else entry for entry in entries]


def _is_argument(node: Node) -> bool:
    """Whether a node is a parameter or an input."""
    return isinstance(node, Leaf) and node.kind in ("p", "r")
