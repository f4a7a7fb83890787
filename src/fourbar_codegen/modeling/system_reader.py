"""System -> Mechanism. This is the only module that reads SymPy's mechanics objects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Literal

import sympy as sm
import sympy.physics.mechanics as me
from sympy.core.function import AppliedUndef
from sympy.physics.mechanics.system import System

from fourbar_codegen.errors import ModelError, meant, shown
from fourbar_codegen.modeling.mechanism import (
    Body,
    DrawnPoint,
    Frame,
    LengthLaw,
    Load,
    Mechanism,
    Point,
    Shape,
    Vector,
    entries_of,
    walk,
)
from fourbar_codegen.modeling.shapes import find_shapes
from fourbar_codegen.modeling.visualizations import NOTHING, Placed, Visualization

__all__ = ["read_mechanism", "wrong_number"]


DRAWN_AS: dict[str, Literal["spring", "damper"]] = {
    "LinearSpring": "spring",
    "DuffingSpring": "spring",
    "LinearDamper": "damper",
    "CoulombKineticFriction": "damper",
}
"""Classes of actuators by name, since older versions of SymPy lack some; others are drawn as actuators."""


def read_mechanism(
    system: System | me.KanesMethod,
    points: Iterable[Any] = (),
    lines: Iterable[Iterable[Any]] = (),
    values: Iterable[sm.Symbol | str] = (),
    seen: Visualization = NOTHING,
) -> Mechanism:
    """Read a System or a KanesMethod.

    Parameters
    ----------
    system : System or KanesMethod
        A System that is ready for its ``form_eoms``, or a KanesMethod with its bodies and loads.
    points : iterable of sympy.physics.mechanics.Point, optional
        Points to be drawn although nothing else needs them.
    lines : iterable of sequence of Point or str, optional
        Points, or names of points, that lines connect in drawings.
    values : iterable of Symbol or str, optional
        Parameters with a number, or their names: points with simple positions that take no others are drawn, too.
    seen : Visualization, optional
        Further lines, points and frames of pictures.

    Returns
    -------
    Mechanism

    Raises
    ------
    ModelError
        If the numbers of coordinates, speeds, kinematic equations and constraints do not match, or a velocity or
        orientation that the equations need is not defined, or points to be drawn have no position.
    """
    if isinstance(system, System):
        description = _of_system(system)
    elif isinstance(system, me.KanesMethod):
        description = _of_kanes_method(system)
    elif isinstance(system, me.LagrangesMethod):
        raise ModelError(
            "A LagrangesMethod cannot be read: equations are formed by Kane's method, from bodies and loads. Make a "
            "System or a KanesMethod from these, with a speed u for each coordinate q and the kinematic equation "
            "u - q' = 0; forces in the Lagrangian's potential become loads."
        )
    else:
        raise ModelError(
            f"A Model needs a System or a KanesMethod of sympy.physics.mechanics, not a {type(system).__name__}."
        )
    _check_counts(description)
    fixed = description.fixed_point
    reader = _Reader(description.frame, fixed, description.u_aux)
    users = [(body.masscenter, f"body {body.name}") for body in description.bodies]
    users += [(place, f"force at point {place.name}") for place, _ in description.loads if isinstance(place, me.Point)]
    reader.read_points(users)
    bodies = tuple(reader.body(body) for body in description.bodies)
    loads = tuple(reader.load(load) for load in description.loads)
    connected = [*_lines(lines), *map(list, seen.lines)]
    named = [*_points(points), *(point for line in connected for point in line if isinstance(point, me.Point))]
    named += [each.point for each in seen.placed]
    q = (*description.q_ind, *description.q_dep)
    rates = (*description.u_ind, *description.u_dep, *(c.diff(me.dynamicsymbols._t) for c in q))
    functions = {function.name for function in (*q, *rates) if isinstance(function, AppliedUndef)}
    own = frozenset(value for value in values if getattr(value, "name", value) not in functions)
    known = _Known(frozenset(q), frozenset(rates), own)
    drawn, of_points, not_drawn = reader.drawn(description.bodies, named, known)
    for frame in seen.frames:
        reader.number(frame, "shapes")
    _check_frames(seen.frames, list(reader.numbers), description.bodies)
    frames = reader.frames()
    pathways = tuple(_pathways(description.actuators, of_points))
    tips, shapes = find_shapes(frames, drawn, bodies, pathways)
    return Mechanism(
        time=me.dynamicsymbols._t,
        coordinates=(*description.q_ind, *description.q_dep),
        speeds=(*description.u_ind, *description.u_dep),
        n_dependent_coordinates=len(description.q_dep),
        n_dependent_speeds=len(description.u_dep),
        auxiliary_speeds=tuple(description.u_aux),
        points=tuple(reader.points),
        frames=frames,
        bodies=bodies,
        loads=loads,
        kinematic_equations=tuple(description.kdes),
        holonomic_constraints=tuple(description.holonomic_constraints),
        velocity_constraints=tuple(description.velocity_constraints),
        velocity_constraints_derived=description.derived,
        fixed_point=None if fixed is None else reader.point_numbers.get(fixed),
        **_actuators(description),
        acceleration_constraints=tuple(description.acceleration_constraints),
        drawn=(*drawn, *tips),
        shapes=(*shapes, *pathways, *_drawn_lines(connected, drawn, of_points)),
        not_drawn=not_drawn,
        length_laws=tuple(_length_laws(description.sources)),
        is_origin_fixed=None if fixed is None else next(iter(of_points), None) is fixed,
        placed=tuple((_owner(each, description), drawn[of_points[each.point]].name) for each in seen.placed),
    )


def _owner(placed: Placed, description: _Description) -> str:
    """The name of the body with the frame whose mass centre is there, or else of the frame."""
    for body in description.bodies:
        if getattr(body, "frame", description.frame) is placed.frame and placed.point is body.masscenter:
            return str(body.name)
    return str(placed.frame.name)


def _check_frames(
    given: Iterable[me.ReferenceFrame], frames: Sequence[me.ReferenceFrame], bodies: Iterable[Any]
) -> None:
    """Shapes are told apart by the names of frames and bodies."""
    for frame in given:
        others = [other.name for other in frames if other is not frame]
        others += [body.name for body in bodies if getattr(body, "frame", None) is not frame]
        if frame.name in others:
            raise ModelError(
                f"A frame with a shape is called {frame.name}, as another frame or body is: give it another name."
            )


SIMPLE = (sm.Add, sm.Mul, sm.Pow, sm.NumberSymbol, sm.sin, sm.cos, sm.tan, sm.asin, sm.acos, sm.atan, sm.atan2)
"""Operations in positions of points that are drawn although nobody named them: they can be compiled in any case."""


@dataclass(frozen=True)
class _Known:
    """What positions of points may depend on that are drawn although nothing needs them and nobody named them.

    Attributes
    ----------
    coordinates : frozenset of Expr
    rates : frozenset of Expr
        Speeds and rates of the coordinates, in angular velocities.
    values : frozenset of Symbol or str
        Parameters with a number, or their names.
    """

    coordinates: frozenset[sm.Expr]
    rates: frozenset[sm.Expr]
    values: frozenset[sm.Symbol | str]

    def simple(self, entries: Iterable[sm.Expr], others: frozenset[sm.Expr] = frozenset()) -> bool:
        """Whether expressions are simple operations on this."""
        for node in walk(entries):
            if isinstance(node, AppliedUndef | sm.Derivative):
                is_simple = node in self.coordinates or node in others
            elif isinstance(node, sm.Symbol):
                is_simple = node in self.values or (node.name in self.values and node == sm.Symbol(node.name))
            else:
                is_simple = isinstance(node, SIMPLE) or (isinstance(node, sm.Number) and node.is_finite is True)
            if not is_simple:
                return False
        return True


def _entries(vector: me.Vector) -> list[sm.Expr]:
    return [component for components, _ in vector.args for component in components]


def _points(given: Iterable[Any]) -> list[me.Point]:
    points = _listed(given)
    for point in points:
        if not isinstance(point, me.Point):
            raise ModelError(f"points= takes Points of sympy.physics.mechanics, not {shown(point)}.")
    return points


def _listed(given: Any) -> list[Any]:
    """The items of a collection; of anything else, itself."""
    return [given] if isinstance(given, str) or not isinstance(given, Iterable) else list(given)


def _lines(given: Iterable[Any]) -> list[list[Any]]:
    """Lines as lists of points and names of points."""
    lines = _listed(given)
    for line in lines:
        ends = list(line) if isinstance(line, list | tuple) else []
        if len(ends) < 2 or not all(isinstance(end, str | me.Point) for end in ends):
            raise ModelError(
                f"lines= takes sequences of two and more points, or of their names, such as [('A', 'B')], not "
                f"{shown(line)}."
            )
    return [list(line) for line in lines]


def _drawn_lines(
    lines: Iterable[Sequence[Any]], drawn: Sequence[DrawnPoint], numbers: Mapping[me.Point, int]
) -> Iterator[Shape]:
    """The lines that were asked for."""
    names = {point.name: number for number, point in reversed([*enumerate(drawn)])}
    for line in lines:
        for end in line:
            if isinstance(end, str) and end not in names:
                raise ModelError(f"lines= names a point {end}, which is not drawn.{meant(end, names)}")
        yield Shape("line", "", tuple(names[end] if isinstance(end, str) else numbers[end] for end in line))


def _distinct(name: str, earlier: set[str], taken: set[str]) -> str:
    """A name, with a number appended if an earlier point has it and others may not take it."""
    if name and name in earlier:
        name = next(other for number in count(2) if (other := f"{name} ({number})") not in earlier | taken)
    earlier.add(name)
    return name


def _pathways(actuators: Iterable[Any], numbers: Mapping[me.Point, int]) -> Iterator[Shape]:
    """Springs, dampers and other actuators that act between drawn points."""
    for actuator in actuators:
        ends = [point for point in getattr(getattr(actuator, "pathway", None), "attachments", ()) if point in numbers]
        if len(ends) > 1:
            classes = (base.__name__ for base in type(actuator).__mro__)
            kind = next((DRAWN_AS[name] for name in classes if name in DRAWN_AS), None)
            yield Shape(kind or "actuator", str(getattr(actuator, "name", "")), tuple(numbers[point] for point in ends))


@dataclass(frozen=True)
class _Description:
    """The common data of a System and a KanesMethod, with the names of a System."""

    frame: me.ReferenceFrame
    fixed_point: me.Point | None
    bodies: Sequence[Any]
    loads: Sequence[Any]
    sources: Sequence[Any]  # of each load, itself or the actuator that it belongs to
    q_ind: Sequence[sm.Expr]
    q_dep: Sequence[sm.Expr]
    u_ind: Sequence[sm.Expr]
    u_dep: Sequence[sm.Expr]
    u_aux: Sequence[sm.Expr]
    kdes: Sequence[sm.Expr]
    holonomic_constraints: Sequence[sm.Expr]
    velocity_constraints: Sequence[sm.Expr]
    actuators: Sequence[Any]
    acceleration_constraints: Sequence[sm.Expr]
    derived: bool  # whether the rates of the holonomic constraints come before the velocity constraints


def _of_system(system: System) -> _Description:
    derived = system._vel_constrs is None  # what the System's own getter asks
    return _Description(
        frame=system.frame,
        fixed_point=system.fixed_point,
        bodies=system.bodies,
        **_loads((*system.loads, *system.actuators)),
        q_ind=system.q_ind[:],
        q_dep=system.q_dep[:],
        u_ind=system.u_ind[:],
        u_dep=system.u_dep[:],
        u_aux=system.u_aux[:],
        kdes=system.kdes[:],
        holonomic_constraints=system.holonomic_constraints[:],
        velocity_constraints=(system.nonholonomic_constraints if derived else system.velocity_constraints)[:],
        actuators=system.actuators,
        acceleration_constraints=(),
        derived=derived,
    )


def _loads(items: Iterable[Any]) -> dict[str, list[Any]]:
    """Loads, with actuators replaced by their loads, and where they come from."""
    pairs = [(x, item) for item in items for x in (item.to_loads() if isinstance(item, me.ActuatorBase) else [item])]
    return {"loads": [load for load, _ in pairs], "sources": [source for _, source in pairs]}


def _length_laws(sources: Sequence[Any]) -> Iterator[LengthLaw]:
    """The forces of actuators along pathways, with the pathways' lengths."""
    for actuator in {id(source): source for source in sources if isinstance(source, me.ForceActuator)}.values():
        ends = (str(getattr(end, "name", end)) for end in actuator.pathway.attachments)
        name = getattr(actuator, "name", None) or f"{type(actuator).__name__} {' - '.join(ends)}"
        loads = tuple(number for number, source in enumerate(sources) if source is actuator)
        yield LengthLaw(str(name), sm.sympify(actuator.force), sm.sympify(actuator.pathway.length), loads)


def _actuators(system: _Description) -> dict[str, Any]:
    """The equations of actuators with states of their own, such as those of sympy.physics.biomechanics.

    A state that the user made a coordinate, with its equation among the kinematic ones, is left out.
    """
    known = {*system.q_ind, *system.q_dep, *system.u_ind, *system.u_dep}
    equations: dict[sm.Expr, sm.Expr] = {}
    excitations: dict[sm.Expr, None] = {}
    for actuator in system.actuators:
        if hasattr(actuator, "rhs"):
            for state, rate in zip(actuator.x, actuator.rhs(), strict=True):
                if equations.get(state, rate) != rate:
                    raise ModelError(
                        f"Two actuators have different equations for the state {state}: give one of them another name."
                    )
                if state not in known:
                    equations[state] = rate
            excitations.update(dict.fromkeys(actuator.r))
    return {"state_equations": tuple(equations.items()), "excitations": tuple(excitations)}


def _of_kanes_method(kane: me.KanesMethod) -> _Description:
    """KanesMethod stores kinematics and velocity constraints as matrices, without public access."""
    t = me.dynamicsymbols._t
    q, u = sm.Matrix(kane.q), sm.Matrix(kane.u)
    n_qi, n_ui = len(q) - len(kane._qdep), len(u) - len(kane._udep)
    kdes = (
        kane._k_kqdot_implicit * q.diff(t) + kane._k_ku_implicit * u + kane._f_k_implicit
        if len(kane._k_kqdot_implicit)
        else sm.Matrix()
    )
    return _Description(
        frame=kane._inertial,
        fixed_point=None,
        bodies=kane.bodylist or (),
        **_loads(kane.forcelist or ()),
        q_ind=q[:n_qi],
        q_dep=q[n_qi:],
        u_ind=u[:n_ui],
        u_dep=u[n_ui:],
        u_aux=kane._uaux[:],
        kdes=kdes[:],
        holonomic_constraints=kane._f_h[:],
        velocity_constraints=(kane._k_nh * u + kane._f_nh)[:] if kane._udep else (),
        actuators=[item for item in kane.forcelist or () if isinstance(item, me.ActuatorBase)],
        # Those that KanesMethod derives itself have the matrix of the velocity constraints.
        acceleration_constraints=(
            (kane._k_dnh * u.diff(t) + kane._f_dnh)[:] if kane._udep and kane._k_dnh is not kane._k_nh else ()
        ),
        derived=False,
    )


def _check_counts(system: _Description) -> None:
    """Accept as many dependent variables as constraints, or fewer where constraints are redundant."""
    problems = []
    n_velocity = len(system.velocity_constraints) + (len(system.holonomic_constraints) if system.derived else 0)
    if not system.u_ind and not system.u_dep:
        problems.append("it has no generalized speeds: add joints, or call add_speeds")
    if not system.bodies:
        problems.append("it has no bodies: call add_bodies, or add joints; a KanesMethod takes them as bodies=")
    n_q = len(system.q_ind) + len(system.q_dep)
    rates = [u for u in (*system.u_ind, *system.u_dep) if isinstance(u, sm.Derivative)]
    if rates:
        problems.append(
            f"its speeds {', '.join(map(str, rates))} are derivatives, as for LagrangesMethod, but Kane's method is "
            "needed: give each coordinate q a speed u of its own, and the kinematic differential equation "
            "u - q' = 0"
        )
    elif len(system.kdes) != n_q:
        problems.append(
            f"it has {n_q} generalized coordinates {_names((*system.q_ind, *system.q_dep))} but {len(system.kdes)} "
            "kinematic differential equations: give one for each coordinate with add_kdes"
        )
    problems.append(wrong_number("holonomic", len(system.holonomic_constraints), "q", system.q_dep))
    # Holonomic constraints that no speed changes, such as norms of quaternions, need no dependent speed.
    if any(problems) or system.u_dep or system.velocity_constraints:
        problems.append(wrong_number("velocity", n_velocity, "u", system.u_dep))
    if any(problems):
        raise ModelError(f"The System cannot be compiled: {'; '.join(filter(None, problems))}.")


def wrong_number(kind: str, n_constraints: int, letter: Literal["q", "u"], dependent: Sequence[sm.Expr]) -> str:
    """An error message if the number of dependent variables is wrong; else an empty text."""
    if len(dependent) <= n_constraints and (dependent or not n_constraints):
        return ""
    what = "coordinates" if letter == "q" else "speeds"
    return (
        f"it has {n_constraints} {kind} constraints but {len(dependent)} dependent {what} {_names(dependent)}: set "
        f"{letter}_ind and {letter}_dep, one dependent variable for each constraint that is not redundant"
    )


def _names(functions: Iterable[Any]) -> str:
    return "(" + ", ".join(str(f.func) for f in functions) + ")"


class _Reader:
    """Reads vectors, and numbers the frames that they refer to."""

    def __init__(
        self, inertial: me.ReferenceFrame, fixed_point: me.Point | None, auxiliary_speeds: Sequence[sm.Expr]
    ) -> None:
        self.inertial = inertial
        self.fixed_point = fixed_point
        self.without_auxiliary = dict.fromkeys(auxiliary_speeds, 0)
        # ``ReferenceFrame.dcm`` lists every path in the graph and multiplies the matrices along it; one breadth-first
        # pass over the neighbours keeps the tree as it was modelled.
        self.parents = _neighbours(inertial, lambda frame: frame._dcm_dict)
        # A frame that no vector is written in needs no orientation, for example a wheel whose angle is not needed.
        self.turning = _neighbours(inertial, lambda frame: frame._ang_vel_dict)
        self.numbers: dict[me.ReferenceFrame, int] = {inertial: 0}
        self.points: list[Point] = []
        self.point_numbers: dict[me.Point, int] = {}

    def number(self, frame: me.ReferenceFrame, used_by: str) -> int:
        if frame not in self.parents:
            raise ModelError(
                f"Frame {frame.name}, used by {used_by}, is not oriented relative to the System's frame "
                f"{self.inertial.name}: call {frame.name}.orient_axis or another of its orient methods, or write "
                "vectors and inertia in a frame that is oriented."
            )
        if frame not in self.numbers:
            self.number(self.parents[frame], used_by)
            self.numbers[frame] = len(self.numbers)
        return self.numbers[frame]

    def number_of_turning(self, frame: me.ReferenceFrame, used_by: str) -> int:
        """The number of a frame of which only the angular velocity is needed."""
        if frame in self.parents or frame not in self.turning:
            return self.number(frame, used_by)
        if frame not in self.numbers:
            self.number_of_turning(self.turning[frame], used_by)
            self.numbers[frame] = len(self.numbers)
        return self.numbers[frame]

    def vector(self, vector: me.Vector, used_by: str) -> Vector:
        # A zero vector has no components; SymPy writes it as 0 in places.
        parts = vector.args if isinstance(vector, me.Vector) else []
        for components, _ in parts:
            if not isinstance(components, sm.MatrixBase):  # nan times a vector
                raise ModelError(f"{shown(components)} in the {used_by} cannot be compiled: it is not a vector.")
        return tuple((self.number(frame, used_by), tuple(matrix)) for matrix, frame in parts)

    def velocity(self, point: me.Point, used_by: str) -> Vector:
        try:
            velocity = point.vel(self.inertial)
        except ValueError as error:
            raise ModelError(
                f"The velocity of point {point.name}, used by {used_by}, is not defined in frame "
                f"{self.inertial.name}: set its position from a moving point, or its velocity."
            ) from error
        return self.vector(velocity, used_by)

    def read_points(self, users: Iterable[tuple[me.Point, str]]) -> None:
        """Read the velocities of points, given with their users, and the tree of positions that connects them."""
        needed: dict[me.Point, str] = {}
        for point, used_by in users:
            needed.setdefault(point, used_by)
        parents: dict[me.Point, me.Point | None] = {}
        for point in needed:
            if point not in parents:
                root = self._at_rest(point) or point
                parents.update(_neighbours(root, _positions))
                parents[root] = None
        # SymPy differentiates the position relative to the nearest point of known velocity in the inertial frame, which
        # practically never ends for spatial chains. `Kinematics` differentiates along the tree, frame by frame.
        derived: set[me.Point] = set()
        for point in needed:
            path = list(_ancestors(point, parents))
            known = next((i for i, member in enumerate(path) if self.inertial in member._vel_dict), None)
            if known and self._nearest_known(point) is path[known]:
                derived.update(path[:known])
        velocities = {point: self.velocity(point, used_by) for point, used_by in needed.items() if point not in derived}
        for point in needed:
            self._add_point(point, parents, velocities, derived)

    def _nearest_known(self, point: me.Point) -> me.Point | None:
        """The nearest point of known velocity, as ``Point.vel`` looks for it."""
        return next((p for p in _neighbours(point, _positions) if self.inertial in p._vel_dict), None)

    def _at_rest(self, point: me.Point) -> me.Point | None:
        """The System's fixed point or another point at rest, if a point's position is known relative to it."""
        component = _neighbours(point, _positions)
        at_rest = [p for p in component if self._rests(p._vel_dict.get(self.inertial))]
        return next((p for p in (self.fixed_point, *at_rest) if p in component), None)

    def _rests(self, velocity: me.Vector | None) -> bool:
        """Whether a velocity is known, and zero: auxiliary speeds are."""
        return velocity is not None and velocity.xreplace(self.without_auxiliary) == 0

    def drawn(
        self, bodies: Iterable[Any], named: Iterable[me.Point], known: _Known
    ) -> tuple[tuple[DrawnPoint, ...], dict[me.Point, int], tuple[str, ...]]:
        """The tree of positions, their numbers in it, and names of points that are left out.

        These have positions in frames that are not numbered by now, since nothing but the drawing needs them. On the
        way to a point that is named, such frames are numbered; likewise to points with simple and known positions.
        """
        names = {body.masscenter: str(body.name) for body in bodies if body.mass != 0}
        asked = dict.fromkeys(named)
        placed = (*(body.masscenter for body in bodies), *asked)
        roots = [found for found in map(self._at_rest, placed) if found is not None]
        root = (self.fixed_point if self.fixed_point in roots else roots[0]) if roots else None
        parents = {} if root is None else _neighbours(root, _positions)
        for point in asked:
            if point not in parents:
                raise ModelError(
                    f"Point {point.name} cannot be drawn: its position is not given from a point at rest that the "
                    "mass centres' positions are given from, too. Call its set_pos."
                )
        on_the_way = {member for point in asked for member in _ancestors(point, {**parents, root: None})}
        numbers: dict[me.Point, int] = {}
        points: list[DrawnPoint] = []
        left_out = []
        taken, earlier = {point.name for point in parents}, set[str]()
        for point, parent in parents.items():
            offset: Vector = ()
            if point is not root:
                position = point._pos_dict[parent]
                frames = [frame for _, frame in position.args] if isinstance(position, me.Vector) else []
                if parent in numbers and self._is_known(position, known):
                    on_the_way.add(point)
                has_frames = all(f in self.numbers and f in self.parents for f in frames)
                if parent not in numbers or not (has_frames or point in on_the_way):
                    left_out.append(point.name)
                    continue
                offset = self.vector(position, f"point {point.name}")
            numbers[point] = len(points)
            before = None if point is root else numbers[parent]
            number = self.point_numbers.get(point)
            name = _distinct(point.name, earlier, taken)
            points.append(DrawnPoint(name, before, offset, names.get(point), number, point in on_the_way))
        return tuple(points), numbers, tuple(left_out)

    def _is_known(self, position: Any, known: _Known) -> bool:
        """Whether a position is simple and known, also in frames that nothing else needs."""
        if not isinstance(position, me.Vector):
            return True
        frames = [frame for _, frame in position.args]
        entries = _entries(position)
        for frame in frames:
            if frame not in self.parents:
                return False
            parent = self.parents[frame]
            if frame not in self.numbers and parent is not frame:
                velocities = frame._ang_vel_dict.values()
                if not all(isinstance(w, me.Vector) and known.simple(_entries(w), known.rates) for w in velocities):
                    return False
                entries += frame.dcm(parent)
                frames += [parent] if parent not in frames else []
        return known.simple(entries)

    def _add_point(
        self,
        point: me.Point,
        parents: dict[me.Point, me.Point | None],
        velocities: dict[me.Point, Vector],
        derived: set[me.Point],
    ) -> None:
        path = [member for member in _ancestors(point, parents) if member not in self.point_numbers]
        for member in reversed(path):
            name = f"point {member.name}"
            parent = parents[member]
            offset: Vector = ()
            velocity = velocities.get(member)
            if velocity is None and self.inertial in member._vel_dict:
                velocity = self.vector(member._vel_dict[self.inertial], name)
            if parent is not None:
                try:
                    offset = self.vector(member._pos_dict[parent], name)
                except ModelError:
                    parent = None  # in a frame that is not oriented
                    if member in derived:
                        raise
            number = None if parent is None else self.point_numbers[parent]
            self.point_numbers[member] = len(self.points)
            self.points.append(Point(member.name, number, offset, velocity, member in derived))

    def angular_velocity(self, frame: me.ReferenceFrame, used_by: str) -> Vector:
        try:
            angular_velocity = frame.ang_vel_in(self.inertial)
        except ValueError as error:
            raise ModelError(
                f"The angular velocity of frame {frame.name}, used by {used_by}, is not defined in frame "
                f"{self.inertial.name}: orient the frame, or call {frame.name}.set_ang_vel."
            ) from error
        return self.vector(angular_velocity, used_by)

    def position(self, point: me.Point, used_by: str) -> Vector | None:
        origin = self.fixed_point or self._at_rest(point)
        if origin is None:
            return None
        try:
            return self.vector(point.pos_from(origin), used_by)
        except ValueError:
            return None

    def acceleration(self, of: me.Point | me.ReferenceFrame) -> Vector | None:
        known = of._ang_acc_dict if isinstance(of, me.ReferenceFrame) else of._acc_dict
        given = known.get(self.inertial)
        try:
            return None if given is None else self.vector(given, f"acceleration of {of.name}")
        except ModelError:
            return None  # written in a frame that nothing else needs

    def body(self, body: me.RigidBody | me.Particle) -> Body:
        name = f"body {body.name}"
        mass, potential_energy = sm.sympify(body.mass), sm.sympify(body.potential_energy)
        point = self.point_numbers[body.masscenter]
        acceleration = self.acceleration(body.masscenter)
        if not isinstance(body, me.RigidBody):  # the deprecated Body is a RigidBody and a Particle
            return Body(body.name, mass, point, None, None, None, potential_energy, acceleration, None)
        self.angular_velocity(body.frame, name)
        # The inertia stays in the frame it was given in, which need not be fixed in the body (for a wheel, a frame
        # that does not spin is simplest). An inertia in mixed frames is converted to the body's own.
        dyadic = body.central_inertia
        frames = {frame for _, *axes in dyadic.args for frame in (axis.args[0][1] for axis in axes)}
        frame = frames.pop() if len(frames) == 1 else body.frame
        self.angular_velocity(frame, name)
        inertia = tuple(dyadic.to_matrix(frame)) if dyadic.args else (sm.S.Zero,) * 9
        return Body(
            body.name,
            mass,
            point,
            self.number_of_turning(body.frame, name),
            self.number(frame, name),
            inertia,
            potential_energy,
            acceleration,
            self.acceleration(body.frame),
        )

    def load(self, load: Any) -> Load:
        location, vector = load
        if isinstance(location, me.ReferenceFrame):
            name = f"torque on frame {location.name}"
            self.angular_velocity(location, name)
            return Load("torque", name, self.vector(vector, name), self.number_of_turning(location, name), None)
        name = f"force at point {location.name}"
        number = self.point_numbers[location]
        return Load("force", name, self.vector(vector, name), number, self.position(location, name))

    def frames(self) -> tuple[Frame, ...]:
        angular_velocities: list[Vector | None] = []
        # An angular velocity may refer to frames that nothing else does; they get the next numbers.
        while len(angular_velocities) < len(self.numbers):
            frame = list(self.numbers)[len(angular_velocities)]
            try:
                angular_velocities.append(self.angular_velocity(frame, f"frame {frame.name}"))
            except ModelError:
                angular_velocities.append(None)
        # The direction cosines between neighbours are those that orient_axis and similar methods stored.
        frames = []
        for (frame, number), velocity in zip(self.numbers.items(), angular_velocities, strict=True):
            is_oriented = frame in self.parents
            neighbour = self.parents[frame] if is_oriented else self.turning[frame]
            parent = self.numbers[neighbour]
            relative = _difference(velocity, angular_velocities[parent])
            frames.append(
                Frame(
                    frame.name,
                    parent,
                    tuple(frame.dcm(neighbour)) if is_oriented else None,
                    *((velocity, 0) if relative is None or not number else (relative, parent)),
                )
            )
        return tuple(frames)


def _difference(a: Vector | None, b: Vector | None) -> Vector | None:
    """The difference a - b if it has fewer components than a; else None."""
    if a is None or b is None:
        return None
    parts = dict(a)
    for frame, components in b:
        mine = parts.get(frame, (sm.S.Zero,) * 3)
        parts[frame] = tuple(x - y for x, y in zip(mine, components, strict=True))
    difference = tuple((frame, c) for frame, c in parts.items() if any(c))
    return difference if sum(map(bool, entries_of(difference))) < sum(map(bool, entries_of(a))) else None


def _neighbours(root: Any, links: Callable[[Any], Iterable[Any]]) -> dict[Any, Any]:
    """The parent of everything reachable from a root by links, breadth first; the root is its own parent."""
    parents = {root: root}
    queue = [root]
    for item in queue:
        for neighbour in links(item):
            if neighbour not in parents:
                parents[neighbour] = item
                queue.append(neighbour)
    return parents


def _ancestors(point: me.Point, parents: Mapping[me.Point, me.Point | None]) -> Iterator[me.Point]:
    """A point, its parent, and so on to the root."""
    member: me.Point | None = point
    while member is not None:
        yield member
        member = parents[member]


def _positions(point: me.Point) -> Iterable[me.Point]:
    """The points whose positions are given relative to a point, or the reverse."""
    positions: dict[me.Point, me.Vector] = point._pos_dict
    return positions
