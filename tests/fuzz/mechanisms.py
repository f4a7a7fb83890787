"""Systems drawn at random against SymPy's own equations, which are evaluated and solved with 50 digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mpmath
import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from scipy.linalg import qr
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb

EPS = np.finfo(float).eps
DIGITS = 50
t = me.dynamicsymbols._t


class Drawn:
    """A System of 1 to 3 bodies, the numbers of its symbols, and the sources of its inputs.

    Bodies hang on each other by pins, sliders and ball joints, with springs, dampers and forces of time. Constraints
    hold a point on a surface or a velocity to zero, or prescribe the motion of a coordinate. States with equations of
    their own drive forces, and so does an unknown force, by friction.
    """

    def __init__(self, generator: np.random.Generator) -> None:
        self.generator = generator
        self.values: dict[sm.Symbol, float] = {}
        self.inputs: dict[sm.Expr, sm.Expr] = {}
        self.told: list[str] = []
        ground = me.RigidBody("ground")
        self.system = System.from_newtonian(ground)
        self.bodies = [ground]
        for number in range(generator.integers(1, 4)):
            self.hang(number)
        if generator.random() < 0.8:
            self.system.apply_uniform_gravity(-self.symbol("g") * ground.y)
        for number in range(generator.integers(0, 3)):
            self.load(number)
        self.constrain([self.constraint(number) for number in range(generator.integers(0, 4))])
        self.state_equations = self.states(generator.integers(1, 4)) if generator.random() < 0.5 else {}
        self.unknown = [self.friction()] if generator.random() < 0.5 else []
        self.variables = [*self.system.q, *self.system.u, *self.state_equations]
        self.state = np.append(self.state, generator.normal(size=len(self.state_equations)))

    def symbol(self, name: str) -> sm.Symbol:
        """A parameter, with a number around 1."""
        symbol = sm.Symbol(name, positive=True)
        self.values[symbol] = float(np.exp(self.generator.normal()))
        return symbol

    def vector(self, frame: me.ReferenceFrame, name: str = "") -> me.Vector:
        """Of a few components along a frame's axes; with a name, of some length."""
        whole = self.generator.integers(-2, 3, size=3)
        whole[self.generator.integers(3)] = 1
        size = self.symbol(name) if name else 1
        return sum((int(number) * size * axis for number, axis in zip(whole, frame, strict=True)), me.Vector(0))

    def hang(self, number: int) -> None:
        """One more body, on any of the others."""
        parent = self.bodies[self.generator.integers(max(0, number - 1), number + 1)]
        body = me.RigidBody(f"b{number}", mass=self.symbol(f"m{number}"))
        sizes = [self.symbol(f"I{axis}{number}") for axis in "xyz"]
        # Diagonally dominant: positive definite; with products of inertia at times.
        product = min(sizes, key=lambda size: self.values[size]) / 3 if self.generator.random() < 0.5 else 0
        body.central_inertia = me.inertia(body.frame, *sizes, product, -product / 2, 0)
        # SymPy takes a minute for two ball joints.
        kinds = ["Pin", "Prismatic"] if "Spherical" in " ".join(self.told) else ["Pin", "Prismatic", "Spherical"]
        kind = str(self.generator.choice(kinds))
        axis = {} if kind == "Spherical" else {"joint_axis": self.vector(parent.frame)}
        joint = getattr(me, f"{kind}Joint")(
            f"j{number}", parent, body, parent_point=self.vector(parent.frame, f"a{number}"),
            child_point=self.vector(body.frame, f"c{number}"), **axis,
        )  # fmt: skip
        self.system.add_joints(joint)
        if kind != "Spherical" and self.generator.random() < 0.5:
            torque = -self.symbol(f"k{number}") * joint.coordinates[0] - self.symbol(f"d{number}") * joint.speeds[0]
            along = joint.parent_axis
            if kind == "Pin":
                self.system.add_actuators(me.TorqueActuator(torque, along, body.frame, parent.frame))
            else:
                self.system.add_loads(me.Force(body.masscenter, torque * along))
        self.bodies.append(body)
        self.told.append(f"{kind} {parent.name}-{body.name}")

    def load(self, number: int) -> None:
        """A spring and a damper to a point of the ground, or a force of time."""
        body, ground = self.bodies[self.generator.integers(1, len(self.bodies))], self.bodies[0]
        if self.generator.random() < 0.5:
            anchor = ground.masscenter.locatenew(f"S{number}", 3 * self.vector(ground.frame, f"s{number}"))
            anchor.set_vel(ground.frame, 0)
            pathway = me.LinearPathway(anchor, body.masscenter)
            self.system.add_actuators(me.LinearSpring(self.symbol(f"K{number}"), pathway, self.symbol(f"L{number}")))
            self.system.add_actuators(me.LinearDamper(self.symbol(f"D{number}"), pathway))
            self.told.append("spring")
        else:
            size = self.symbol(f"f{number}") * sm.cos(3 * t)
            self.system.add_loads(me.Force(body.masscenter, size * self.vector(body.frame)))
            self.told.append("force")

    def constraint(self, number: int) -> tuple[str, sm.Expr]:
        """What is zero: of positions or of velocities."""
        ground = self.bodies[0]
        body = self.bodies[self.generator.integers(1, len(self.bodies))]
        place = body.masscenter.pos_from(ground.masscenter) + self.vector(ground.frame, f"p{number}")
        kind = self.generator.integers(4)
        if kind == 0:
            return "on a plane", place.dot(self.vector(ground.frame))
        if kind == 1:
            return "on a sphere", place.dot(place) - self.symbol(f"R{number}") ** 2
        if kind == 2:
            speed = body.masscenter.vel(ground.frame).dot(self.vector(body.frame))
            return "no sliding", speed - self.symbol(f"w{number}") * sm.sin(t)
        motion = me.dynamicsymbols(f"z{number}")
        self.inputs[motion] = self.symbol(f"A{number}") * sm.sin(2 * t)
        coordinate = self.system.q[self.generator.integers(len(self.system.q))]
        return "prescribed", coordinate - motion

    def states(self, count: int) -> dict[sm.Expr, sm.Expr]:
        """As many that drive forces, with rates of all that may stand there."""
        found = [sm.Function(f"e{number}")(t) for number in range(count)]
        equations = {}
        for number, state in enumerate(found):
            body = self.bodies[self.generator.integers(1, len(self.bodies))]
            self.system.add_loads(me.Force(body.masscenter, state * self.vector(body.frame, f"g{number}")))
            coordinate, speed = (self.generator.choice(list(group)) for group in (self.system.q, self.system.u))
            rate = sm.sin(coordinate) * found[0] - self.symbol(f"h{number}") * state + sm.cos(t) * speed
            if self.generator.random() < 0.5:
                rate += self.symbol(f"a{number}_") * self.generator.choice(list(self.system.u)).diff(t)
            equations[state] = rate
        self.told.append(f"{count} states")
        return equations

    def friction(self) -> sm.Expr:
        """A force that keeps the last body from leaving in some direction, and drives it in others."""
        point, frame = self.bodies[-1].masscenter, self.bodies[0].frame
        speed, force = me.dynamicsymbols("w_aux N")
        along = self.vector(frame)
        # SymPy leaves auxiliary speeds out of velocity constraints: those were drawn before.
        point.set_vel(frame, point.vel(frame) + speed * along)
        self.system.add_auxiliary_speeds(speed)
        self.system.add_loads(me.Force(point, force * (along + self.vector(frame, "mu") / 3)))
        self.told.append("friction")
        return force

    def numbers(self, state: np.ndarray, time: float) -> dict[Any, float]:
        """All symbols' numbers at a state: rates first, so that they are found before what they are rates of."""
        numbers: dict[Any, float] = {}
        for motion, expression in self.inputs.items():
            for order in (2, 1, 0):
                rate = expression.diff(t, order).subs(self.values).subs(t, time)
                numbers[motion.diff(t, order) if order else motion] = float(rate)
        return {**numbers, **dict(zip(self.variables, state, strict=True)), **self.values, t: time}

    def constrain(self, constraints: list[tuple[str, sm.Expr]]) -> None:
        """Adds those that are independent, and chooses well-conditioned dependent variables, at a state of its own."""
        system, generator = self.system, self.generator
        q, u = list(system.q), list(system.u)
        self.variables = [*q, *u]
        self.state = generator.normal(size=len(q) + len(u))
        self.time = float(generator.uniform(0.0, 2.0))
        numbers = self.numbers(self.state, self.time)

        def evaluated(matrix: sm.Matrix) -> np.ndarray:
            return np.array(matrix.subs(numbers).evalf(), dtype=float).reshape(matrix.shape)

        rates = [coordinate.diff(t) for coordinate in q]
        kinematics = sm.Matrix(system.kdes)
        by_speeds = -np.linalg.solve(evaluated(kinematics.jacobian(rates)), evaluated(kinematics.jacobian(u)))
        rows, of_coordinates = np.empty((0, len(u))), np.empty((0, len(q)))
        for kind, expression in constraints:
            held = sm.Matrix([expression])
            is_position = kind != "no sliding"
            # Rates may stand in velocities beside speeds.
            by_coordinates = evaluated(held.jacobian(q if is_position else rates))
            row = by_coordinates @ by_speeds + (0.0 if is_position else evaluated(held.jacobian(u)))
            # A row that is zero but for rounding errors holds nothing.
            if len(rows) + 1 >= len(u) or np.abs(row).max() < 1e-6 or _condition([rows, row]) > 100:
                continue
            if is_position:
                if _condition([of_coordinates, by_coordinates]) > 100:
                    continue
                of_coordinates = np.vstack((of_coordinates, by_coordinates))
                rows = np.insert(rows, len(of_coordinates) - 1, row, axis=0)
                system.add_holonomic_constraints(expression)
            else:
                rows = np.vstack((rows, row))
                system.add_nonholonomic_constraints(expression)
            self.told.append(kind)
        dependent = [set(_pivots(of_coordinates)), set(_pivots(rows))]
        system.q_ind, system.q_dep = _split(q, dependent[0])
        system.u_ind, system.u_dep = _split(u, dependent[1])
        order = [*system.q, *system.u]
        self.state = np.array([self.state[[*q, *u].index(variable)] for variable in order])
        held = sm.Matrix(system.holonomic_constraints)
        self.inputs = {motion: expression for motion, expression in self.inputs.items() if held.has(motion)}


def _condition(parts: list[np.ndarray]) -> float:
    matrix = np.vstack(parts)
    return float(np.linalg.cond(matrix)) if len(matrix) <= matrix.shape[1] else np.inf


def _pivots(matrix: np.ndarray) -> np.ndarray:
    """The columns that make the best conditioned square of them."""
    return qr(matrix, mode="r", pivoting=True)[1][: len(matrix)] if len(matrix) else np.array([], dtype=int)


def _split(variables: list[Any], dependent: set[int]) -> tuple[list[Any], list[Any]]:
    return (
        [variable for place, variable in enumerate(variables) if place not in dependent],
        [variable for place, variable in enumerate(variables) if place in dependent],
    )


class Reference:
    """x' by SymPy's matrices, with many digits."""

    def __init__(self, drawn: Drawn) -> None:
        self.drawn, system = drawn, drawn.system
        system.form_eoms(constraint_solver="CRAMER")
        self.names = list(drawn.numbers(drawn.state, drawn.time))
        # z' = g + G u', below the matrices of q' and u'.
        rates = sm.Matrix(list(drawn.state_equations.values()))
        accelerations = sm.Matrix([speed.diff(t) for speed in system.u])
        slopes = rates.jacobian(accelerations) if len(rates) else sm.zeros(0, len(accelerations))
        n_q, n_z = len(system.q), len(rates)
        lower = sm.zeros(n_z, n_q).row_join(-slopes).row_join(sm.eye(n_z))
        mass_matrix = system.mass_matrix_full.row_join(sm.zeros(system.mass_matrix_full.rows, n_z)).col_join(lower)
        rest = rates.xreplace(dict.fromkeys(accelerations, sm.S.Zero)) if n_z else sm.zeros(0, 1)
        forcing = system.forcing_full.col_join(rest)
        if drawn.unknown:  # with the auxiliary speeds' equations, linear in x' and in the forces
            derivatives = [variable.diff(t) for variable in drawn.variables]
            auxiliary = sm.Matrix(system.eom_method.auxiliary_eqs)
            none = dict.fromkeys([*derivatives, *drawn.unknown], sm.S.Zero)
            below = auxiliary.jacobian(derivatives).row_join(auxiliary.jacobian(drawn.unknown))
            mass_matrix = mass_matrix.row_join(-forcing.jacobian(drawn.unknown)).col_join(below)
            forcing = me.msubs(forcing.col_join(-auxiliary), none)
        matrices = [mass_matrix, forcing]
        self.matrices = sm.lambdify([self.names], matrices, modules="mpmath", cse=True)
        self.in_double = sm.lambdify([self.names], matrices, modules="numpy", cse=True)

    def _numbers(self, state: Any, time: float) -> list[Any]:
        numbers = self.drawn.numbers(np.zeros(len(state)), time)
        numbers.update(zip(self.drawn.variables, state, strict=True))
        return [numbers[name] for name in self.names]

    def rounding(self, state: np.ndarray, time: float, generator: np.random.Generator) -> float:
        """By how much x' errs in double precision, relative to its largest entry: the most of some states close by."""
        errors = []
        for _ in range(8):
            close = state * (1.0 + 1e-9 * generator.normal(size=len(state)))
            mass_matrix, forcing = self.in_double([float(number) for number in self._numbers(close, time)])
            with mpmath.workdps(DIGITS):
                exact = np.array(self.solved(close, time)[1], dtype=float).ravel()
            errors.append(np.abs(np.linalg.solve(mass_matrix, np.ravel(forcing)) - exact).max() / np.abs(exact).max())
        return float(max(errors))

    def equations(self, state: Any, time: float) -> tuple[Any, Any]:
        """The full mass matrix and forcing."""
        mass_matrix, forcing = self.matrices([mpmath.mpf(number) for number in self._numbers(state, time)])
        return mpmath.matrix(mass_matrix.tolist()), mpmath.matrix(forcing.tolist())

    def solved(self, state: Any, time: float) -> tuple[Any, Any]:
        """The full mass matrix and x', with unknown forces behind it."""
        mass_matrix, forcing = self.equations(state, time)
        return mass_matrix, mpmath.lu_solve(mass_matrix, forcing)


def case(generator: np.random.Generator, say: Callable[[str], None]) -> None:
    """One System at three states: x' and its derivative in some direction."""
    drawn = Drawn(generator)
    say(", ".join(drawn.told))
    reference = Reference(drawn)
    model = fb.Model(drawn.system, name="drawn", inputs=drawn.inputs, state_equations=drawn.state_equations)
    compiled = fb.compile_model(model)
    named = {symbol.name: number for symbol, number in drawn.values.items()}
    p = [named.get(name, 1.0) for name in compiled.parameters]  # the ground's mass is anything
    for number in range(3):
        state = drawn.state + 0.1 * number * generator.normal(size=len(drawn.state))
        direction = generator.normal(size=len(state))
        with mpmath.workdps(DIGITS):
            mass_matrix, exact = reference.solved(state, drawn.time)
            condition = np.linalg.cond(np.array(mass_matrix.tolist(), dtype=float))
            # M x'' = f' - M' x' in this direction. Central differences err by h^2.
            h = mpmath.mpf(10) ** (-DIGITS // 3)
            ahead, behind = (
                reference.equations([x + sign * h * v for x, v in zip(state, direction, strict=True)], drawn.time)
                for sign in (1, -1)
            )
            of_matrix, of_forcing = ((a - b) / (2 * h) for a, b in zip(ahead, behind, strict=True))
            terms = [mpmath.lu_solve(mass_matrix, term) for term in (of_forcing, of_matrix * exact)]
        expected, of_forcing, of_matrix = (np.array(part, dtype=float).ravel() for part in (exact, *terms))
        rates = np.append(compiled.rhs(drawn.time, state, p), compiled.output(drawn.time, state, p))
        error = np.abs(rates - expected).max() / np.abs(expected).max()
        slopes = compiled.jacobian(drawn.time, state, p), compiled.output_jacobian(drawn.time, state, p)
        turned = np.vstack(slopes) @ direction
        # What is left of the two terms is known as well as these.
        size = sum(np.abs(term).max() for term in (expected, of_forcing, of_matrix))
        slope = np.abs(turned - (of_forcing - of_matrix)).max() / size
        told = f"x' errs by {error / EPS / condition:.2g}, its derivative by {slope / EPS / condition:.2g} eps cond"
        say(f"{', '.join(drawn.told)}: {told}, condition {condition:.2g}")
        # Backward stable solutions err by the condition; the factor has room for matrices of 20 rows.
        # Where forces cancel, x' is small beside what rounding leaves of them, also by SymPy's own equations.
        if error > 20 * EPS * condition:
            assert error <= 3 * reference.rounding(state, drawn.time, generator), told
        assert slope <= 20 * EPS * condition, told
