"""Linkage: a planar mechanism as engineers draw it, by its points."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import sympy as sm
import sympy.physics.mechanics as me
from sympy.core.function import AppliedUndef

from fourbar_codegen.errors import ModelError, meant, shown
from fourbar_codegen.interface.arguments import finite_number, is_finite, is_mapping, listed, numbers
from fourbar_codegen.linkage.checks import SAME_RTOL, check_mobility, check_parts, size_of
from fourbar_codegen.linkage.mobility import Mobility, find_mobility
from fourbar_codegen.linkage.parts import Drive, Link, Parts, PointForce, Strut, Torque, new_symbol
from fourbar_codegen.linkage.read_csv import name_of_file, rows
from fourbar_codegen.linkage.system import build_system, coordinate, geometry, speed
from fourbar_codegen.linkage.tree import GROUND, Slide, Tree, spanning_tree
from fourbar_codegen.modeling.model import Model, Parameter, multiplier

if TYPE_CHECKING:
    from sympy.physics.mechanics.system import System

__all__ = ["Linkage"]

Quantity: TypeAlias = sm.Expr | float | str
"""A number, which becomes a parameter; an expression; or the name of an input."""


POSITIVE = {"kg", "kg/m", "kg m^2"}
"""Units of masses and inertias."""


class Linkage:
    """A planar mechanism by its points, links and joints.

    Links that share a point turn about it. Lengths and first angles are those of the points as they are given, in one
    closed position; lengths become parameters (``l_AB``), so that they can be changed from run to run. Each moving
    link has an angle from the x axis, ``q_AB``, and a block a displacement along its guide, ``q_C``; ``u_AB`` and
    ``u_C`` are their rates. Joints that close loops become constraints; which coordinates are independent is found.

    Parameters
    ----------
    name : str
        Names the model.
    points : mapping of str to (float, float), optional
        Coordinates, m.
    ground : str or sequence of str, optional
        The points that do not move: ``"AD"``, or ``["A1", "A2"]``.
    links : sequence of str or sequence of str, or mapping, optional
        The points of each moving link: ``["AB", "BCD"]``, or ``[("A1", "B1"), ...]``; or these by the links' names:
        ``{"crank": "AB", ...}``.
    density : float, Expr or str, optional
        Mass by length of links without mass or density of their own, kg/m.
    gravity : float, Expr or str, optional
        Gravitational acceleration along -y, m/s^2; none by default.
    independent : str or sequence of str, optional
        Links and blocks whose coordinates are independent, as far as the drives leave a choice. By default links on the
        ground come first, then blocks, in the order of their statements.

    Raises
    ------
    ModelError
        If a point, link or name is stated twice, not known, or of no use: a bar without length, for example.

    Notes
    -----
    Quantities (masses, stiffnesses, forces) are numbers, which become parameters; expressions of SymPy, with parameters
    of any name, functions of time as inputs, and the coordinates `q` and speeds `u`; or a str, the name of a new input.
    A symbol with the name of one of the linkage's parameters, such as ``l_AB``, stands for that.

    Examples
    --------
    >>> points = {"A": (0, 0), "B": (0.1, 0), "C": (0.3, 0.3), "D": (0.4, 0)}
    >>> links = ["AB", "BC", "CD"]
    >>> linkage = Linkage("crank_rocker", points=points, ground="AD", links=links, density=1.0)
    >>> linkage.torque("A", 0.5)
    >>> linkage.mobility.degrees_of_freedom
    1
    >>> linkage.model().coordinates
    ('q_AB', 'q_BC', 'q_CD')
    """

    def __init__(
        self,
        name: str,
        *,
        points: Mapping[str, Sequence[float]] | None = None,
        ground: str | Sequence[str] = (),
        links: Iterable[str | Sequence[str]] | Mapping[str, str | Sequence[str]] = (),
        density: Quantity | None = None,
        gravity: Quantity | None = None,
        independent: str | Sequence[str] = (),
    ) -> None:
        if not isinstance(name, str):
            raise ModelError(f"A linkage's name is text, not {shown(name)}.")
        self.name = name
        several = [independent] if isinstance(independent, str) else independent
        self._wanted = _in_order(several, "independent= is the name of a link or block, or a sequence of these")
        self._parts = Parts()
        self._analysis: tuple[Tree, Mobility] | None = None
        self._system: tuple[System, list[me.Point]] | None = None
        self._density = None if density is None else self._quantity(density, "rho", "kg/m", "mass of links by length")
        if gravity is not None:
            self._parts.gravity = self._quantity(gravity, "g", "m/s^2", "gravitational acceleration")
        if points is not None and not is_mapping(points):
            raise ModelError(f"points= is a mapping from names to coordinates, not {shown(points)}.")
        for point, place in (points or {}).items():
            self.joint(point, place)
        for point in self._points(ground, "ground="):
            self._parts.ground.append(point)
        stated = "links= is a sequence of links, such as ['AB', 'BC'], or a mapping"
        named_links = links.items() if is_mapping(links) else ((None, link) for link in _in_order(links, stated))
        for own_name, link in named_links:
            self.plate(*self._points(link, "Each of links="), name=own_name)

    @classmethod
    def from_csv(cls, path: str | Path, name: str | None = None, **options: Any) -> Linkage:
        """Read points and links from a table.

        Parameters
        ----------
        path : str or Path
            A CSV file with the columns ``point``, ``x``, ``y`` and ``links``, between commas, semicolons or tabs; in
            the last one, the names of all links that the point is on, between spaces: ``ground crank``. Lines that
            begin with # are comments.
        name : str, optional
            By default that of the file.
        **options
            `density`, `gravity` and `independent`.

        Returns
        -------
        Linkage

        Raises
        ------
        ModelError
            If the file cannot be read, or a row is not understood.

        Examples
        --------
        >>> from pathlib import Path
        >>> print(Path("four_bar.csv").read_text())  # doctest: +SKIP
        point,x,y,links
        A,0,0,ground crank
        B,0.1,0,crank coupler
        C,0.3,0.3,coupler rocker
        D,0.4,0,rocker ground
        >>> Linkage.from_csv("four_bar.csv").mobility.independent  # doctest: +SKIP
        ('crank',)
        """
        linkage, links = cls(name_of_file(path) if name is None else name, **options), dict[str, list[str]]()
        for number, row in rows(path):
            try:
                point, x, y = row["point"], float(row["x"]), float(row["y"])
                on = row["links"].split()
            except (KeyError, ValueError, AttributeError, TypeError) as error:
                raise ModelError(
                    f"Row {number} of {path} is not understood: {row}. The columns are point, x, y, links."
                ) from error
            linkage.joint(point, (x, y))
            for link in on:
                links.setdefault(GROUND if link.lower() == GROUND else link, []).append(point)
        linkage._parts.ground += links.pop(GROUND, [])
        for link, members in links.items():
            linkage.plate(*members, name=link)
        return linkage

    def joint(self, name: str, place: Sequence[float], *, mass: Quantity | None = None) -> None:
        """State a point: a pin between links, or a point of one link, such as a tracing point.

        Parameters
        ----------
        name : str
            A letter, then letters, digits and underscores.
        place : (float, float)
            x and y in one closed position of the linkage, m.
        mass : float, Expr or str, optional
            A point mass there, kg.

        Raises
        ------
        ModelError
            If there is such a point, or its name or coordinates are not valid.

        Examples
        --------
        >>> linkage = Linkage("pendulum", points={"A": (0, 0)}, ground="A")
        >>> linkage.joint("B", (0.0, -1.0), mass=2.0)
        >>> linkage.bar("A", "B")
        >>> linkage
        <Linkage pendulum: 2 points, 1 links, 0 blocks>
        """
        parts = self._change()
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
            raise ModelError(
                f"The name of a point is a letter, then letters, digits and underscores, not {shown(name)}."
            )
        if name in parts.links:
            raise ModelError(f"{name} is a link: give the point another name.")
        if name in parts.points:
            raise ModelError(
                f"There are two points {name}. Links that share a point name it once, and are joined there."
            )
        parts.points[name] = _pair(place, f"point {name}")
        if mass is not None:
            self._add_mass(name, mass, f"mass at {name}")

    def ground(self, name: str, place: Sequence[float]) -> None:
        """State a point of the ground, where links are pinned.

        Parameters
        ----------
        name : str
        place : (float, float)
            x and y, m.

        Raises
        ------
        ModelError
            As `joint`.

        Examples
        --------
        >>> linkage = Linkage("pendulum")
        >>> linkage.ground("A", (0.0, 0.0))
        """
        self.joint(name, place)
        self._parts.ground.append(name)

    def bar(self, a: str, b: str, **properties: Any) -> None:
        """State a link with two points; see `plate`.

        Parameters
        ----------
        a, b : str
        **properties
            Those of `plate`.

        Raises
        ------
        ModelError
            As `plate`.

        Examples
        --------
        >>> linkage = Linkage("pendulum", points={"A": (0, 0), "B": (0.3, -0.4)}, ground="A")
        >>> linkage.bar("A", "B", density=2.0)
        >>> [*linkage.q]
        ['AB']
        """
        self.plate(a, b, **properties)

    def plate(
        self,
        *points: str,
        name: str | None = None,
        density: Quantity | None = None,
        mass: Quantity | None = None,
        inertia: Quantity | None = None,
        center: Sequence[float] | None = None,
    ) -> None:
        """State a rigid link with any number of points.

        Its angle is that of the way from its first to its second point. Points are placed by their distances from
        these two, which are parameters.

        Parameters
        ----------
        *points : str
        name : str, optional
            By default the points' names, one after the other.
        density : float, Expr or str, optional
            Mass by length, kg/m, of a bar between two points, or of bars along the sides of a polygon. By default that
            of the linkage, unless there is a mass.
        mass : float, Expr or str, optional
            kg; distributed in the same way.
        inertia : float, Expr or str, optional
            About the mass centre, kg m^2; by default that of the bars.
        center : (float, float), optional
            The mass centre as drawn, m; by default that of the bars.

        Raises
        ------
        ModelError
            If a point is not known or named twice, the link or its name is not valid, or it has a mass and a density.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (0.1, 0), "C": (0.3, 0.3), "D": (0.4, 0), "P": (0.2, 0.4)}
        >>> linkage = Linkage("coupler_curve", points=points, ground="AD", links=["AB", "CD"])
        >>> linkage.plate("B", "C", "P", name="coupler", mass=0.5)
        >>> linkage.mobility.independent
        ('AB',)
        """
        parts = self._change()
        members = tuple(self._known(point) for point in points)
        if len(members) < 2 or len({*members}) < len(members):
            raise ModelError(
                f"Link {'' if name is None else f'{shown(name)} '}needs two and more different points, not "
                f"{', '.join(members) or 'none'}."
            )
        own = name if name is not None else "".join(members) if all(len(m) == 1 for m in members) else "_".join(members)
        if not isinstance(own, str) or not re.fullmatch(r"[A-Za-z]\w*", own, re.ASCII) or own == GROUND:
            raise ModelError(
                f"A link's name is a letter, then letters, digits and underscores, and not {GROUND}; {shown(own)} is "
                "not."
            )
        if own in parts.links:
            raise ModelError(f"There are two links {own}.")
        if own in parts.points:
            raise ModelError(f"{own} is a point: give the link another name.")
        if density is not None and mass is not None:
            raise ModelError(f"Link {own} has a density and a mass: give one of them.")
        if density is None and mass is None:
            density = self._density
        first, second = (parts.points[member] for member in members[:2])
        at = None
        if center is not None:
            if first == second:
                raise ModelError(f"Link {own} has no length: {members[0]} and {members[1]} are at the same place.")
            local = (_pair(center, f"the mass centre of {own}") - first) * abs(second - first) / (second - first)
            what = f"of the mass centre of {own}, from {members[0]}"
            at = (
                self._quantity(local.real, f"x_{own}", "m", f"x {what}"),
                self._quantity(local.imag, f"y_{own}", "m", f"y {what}"),
            )
        parts.links[own] = Link(
            members,
            None if density is None else self._quantity(density, f"rho_{own}", "kg/m", f"mass of {own} by length"),
            None if mass is None else self._quantity(mass, f"m_{own}", "kg", f"mass of {own}"),
            None if inertia is None else self._quantity(inertia, f"I_{own}", "kg m^2", f"inertia of {own}"),
            at,
        )

    def slider(self, point: str, along: Sequence[float] | str | Sequence[str], *, mass: Quantity | None = None) -> None:
        """State a block that moves along a straight guide; a pin joins it to the links with that point.

        Parameters
        ----------
        point : str
        along : (float, float), str or (str, str)
            A direction on the ground, of the guide through the point as drawn; or two points of the link, or of the
            ground, that carries the guide.
        mass : float, Expr or str, optional
            Of the block, kg.

        Raises
        ------
        ModelError
            If there is a block at this point, or it is not on the guide.

        Examples
        --------
        >>> points = {"O": (0, 0), "A": (0, 1), "C": (3, 0)}
        >>> linkage = Linkage("slider_crank", points=points, ground="O", links=["OA", "AC"])
        >>> linkage.slider("C", along=(1, 0), mass=2.0)
        >>> [*linkage.q]
        ['OA', 'AC', 'C']
        """
        parts = self._change()
        point = self._known(point)
        if point in parts.slides:
            raise ModelError(f"There are two blocks at {point}: state one guide for each point.")
        what = f"along= of {point}"
        given = along if isinstance(along, str) else _in_order(along, f"{what} is a direction (x, y), or two points")
        if not isinstance(given, str) and not any(isinstance(x, str) for x in given):
            direction = _pair(given, f"the guide of {point}")
            if not abs(direction):
                raise ModelError(f"The guide of {point} has no direction: along={shown(along)}.")
            parts.slides[point] = Slide(point, GROUND, parts.points[point], direction / abs(direction), None)
        else:
            ends = self._points(given, what)
            on = [name for name, members in parts.carriers.items() if len(ends) == 2 and {*ends} <= {*members}]
            if not on:
                raise ModelError(f"The guide of {point} goes through two points of one link, not {', '.join(ends)}.")
            base, way = parts.points[ends[0]], parts.points[ends[1]] - parts.points[ends[0]]
            across = ((parts.points[point] - base) * way.conjugate()).imag
            if not abs(way) or abs(across) > SAME_RTOL * size_of(self._parts) * abs(way):
                raise ModelError(f"{point} is not on the guide from {ends[0]} to {ends[1]}: draw it there.")
            parts.slides[point] = Slide(point, on[0], base, way / abs(way), (ends[0], ends[1]))
        if mass is not None:
            self._add_mass(point, mass, f"mass of the block at {point}")

    def force(self, point: str, components: Sequence[Quantity]) -> None:
        """State a force on a point.

        Parameters
        ----------
        point : str
        components : (float, Expr or str, float, Expr or str)
            Along x and y, N.

        Raises
        ------
        ModelError
            If a point is not known, or a quantity is no number, expression or name.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (0, -1)}
        >>> linkage = Linkage("pendulum", points=points, ground="A", links=["AB"], density=1.0)
        >>> linkage.force("B", ("push", 0))
        >>> linkage.model().inputs
        ('push',)
        """
        parts = self._change()
        point = self._known(point)
        two = _in_order(components, f"The force on {point} is two components, along x and y")
        if len(two) != 2:
            raise ModelError(f"The force on {point} is two components, along x and y, not {shown(components)}.")
        x, y = (self._component(value, point, axis) for axis, value in zip("xy", two, strict=True))
        parts.forces.append(PointForce(point, x, y))

    def torque(self, at: str, value: Quantity, *, link: str | None = None) -> None:
        """State a torque in a joint, about z: on one link, and the opposite one on the other.

        Parameters
        ----------
        at : str
            A joint, or a link: then the torque acts between this and the ground.
        value : float, Expr or str
            N m.
        link : str, optional
            The link on which it acts as stated, where two moving links are joined.

        Raises
        ------
        ModelError
            If there is no such joint or link, or it is not clear which links the torque acts on.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (0, -1)}
        >>> linkage = Linkage("pendulum", points=points, ground="A", links=["AB"], density=1.0)
        >>> linkage.torque("A", -0.1 * linkage.u["AB"])  # friction in the pin
        """
        on, reaction = self._joined(at, link, "torque")
        self._change().torques.append(
            Torque(on, reaction, self._quantity(value, f"T_{at}", "N m", f"torque on {on} at {at}"))
        )

    def spring(self, a: str, b: str, stiffness: Quantity, length: Quantity | None = None) -> None:
        """State a spring between two points.

        Parameters
        ----------
        a, b : str
        stiffness : float, Expr or str
            N/m.
        length : float, Expr or str, optional
            Its free length, m; by default that as drawn.

        Raises
        ------
        ModelError
            If a point is not known, or both are at one place.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (1, 0), "C": (1, 1)}
        >>> linkage = Linkage("sprung", points=points, ground="AC", links=["AB"], density=1.0)
        >>> linkage.spring("B", "C", 40.0, length=0.8)
        """
        ends, label = self._ends(a, b, "spring")
        drawn = abs(self._parts.points[b] - self._parts.points[a])
        coefficient = self._quantity(stiffness, f"k_{label}", "N/m", f"stiffness of the spring from {a} to {b}")
        free = self._quantity(drawn if length is None else length, f"l0_{label}", "m", "its free length")
        self._change().struts.append(Strut("spring", ends, coefficient, free))

    def damper(self, a: str, b: str, coefficient: Quantity) -> None:
        """State a linear damper between two points.

        Parameters
        ----------
        a, b : str
        coefficient : float, Expr or str
            N s/m.

        Raises
        ------
        ModelError
            As `spring`.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (1, 0), "C": (1, 1)}
        >>> linkage = Linkage("damped", points=points, ground="AC", links=["AB"], density=1.0)
        >>> linkage.damper("B", "C", 5.0)
        """
        ends, label = self._ends(a, b, "damper")
        value = self._quantity(coefficient, f"c_{label}", "N s/m", f"coefficient of the damper from {a} to {b}")
        self._change().struts.append(Strut("damper", ends, value))

    def drive(
        self,
        at: str,
        *,
        angle: Quantity | None = None,
        displacement: Quantity | None = None,
        speed: Quantity | None = None,
    ) -> None:
        """Prescribe the angle of a link, or the displacement of a block.

        The motion is an input, ``drive_A`` unless it is named; the torque or force that it takes is an output,
        ``torque_A`` or ``force_C``.

        Parameters
        ----------
        at : str
            A joint of one moving link with the ground, a link, or the point of a block.
        angle : float, Expr or str, optional
            The angle from the x axis, rad: a number; an expression of time, ``me.dynamicsymbols._t``; or a name for the
            input, which is then held as drawn until it is given.
        displacement : float, Expr or str, optional
            Of a block, m.
        speed : float or Expr, optional
            rad/s or m/s, constant; instead of the others, from the position as drawn.

        Raises
        ------
        ModelError
            If this is no such joint, link or block; it is driven already; or not one of the arguments is given.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (0.1, 0), "C": (0.3, 0.3), "D": (0.4, 0)}
        >>> links = ["AB", "BC", "CD"]
        >>> linkage = Linkage("driven", points=points, ground="AD", links=links, density=1.0)
        >>> linkage.drive("A", speed=10.0)
        >>> linkage.model().outputs
        ('torque_A',)
        """
        parts = self._change()
        is_block = isinstance(at, str) and at in parts.slides
        on = at if is_block else self._joined(at, None, "drive")[0]
        given = [value for value in (displacement if is_block else angle, speed) if value is not None]
        if len(given) != 1 or (angle if is_block else displacement) is not None:
            what = "displacement" if is_block else "angle"
            raise ModelError(f"The drive at {at} has {'a' if is_block else 'an'} {what} or a speed, and nothing else.")
        if any(drive.of == on for drive in parts.drives):
            raise ModelError(f"There are two drives of {on}: one is enough.")
        function, unit, start = me.dynamicsymbols(f"drive_{at}"), "m" if is_block else "rad", None
        is_named = speed is None and isinstance(given[0], str | AppliedUndef)
        if is_named:
            function = self._quantity(given[0], "", unit, f"motion of the drive at {at}")
        if is_named or speed is not None:
            start = self._quantity(0.0, f"start_{at}", unit, f"{on} at t = 0, as drawn")
            expression = start if speed is None else start + self._rate(speed, at, f"{unit}/s") * me.dynamicsymbols._t
        else:
            expression = self._quantity(given[0], f"held_{at}", unit, f"what the drive at {at} holds")
        if all(drive.function != function for drive in parts.drives):
            parts.inputs[function] = expression
        parts.drives.append(Drive(at, on, function, expression, start))

    def _rate(self, value: Any, at: str, unit: str) -> sm.Expr:
        """The speed of a drive, which is constant."""
        if isinstance(value, str) or (isinstance(value, sm.Expr) and me.dynamicsymbols._t in value.free_symbols):
            raise ModelError(
                f"The speed of the drive at {at} is a number or an expression of parameters, not {shown(value)}: give "
                "another motion as an angle or displacement."
            )
        return self._quantity(value, f"speed_{at}", unit, f"speed of the drive at {at}")

    @property
    def q(self) -> dict[str, sm.Expr]:
        """The coordinates: angles of the links from the x axis, rad, and displacements of the blocks, m.

        Examples
        --------
        >>> Linkage("pendulum", points={"A": (0, 0), "B": (0, -1)}, ground="A", links=["AB"]).q
        {'AB': q_AB(t)}
        """
        return {name: coordinate(name) for name in (*self._parts.links, *self._parts.slides)}

    @property
    def u(self) -> dict[str, sm.Expr]:
        """The rates of the coordinates, rad/s and m/s, as `q`."""
        return {name: speed(name) for name in (*self._parts.links, *self._parts.slides)}

    @property
    def mobility(self) -> Mobility:
        """Degrees of freedom by counting and by rank, and which links move independently, which as one.

        Bars that hold each other, as in a triangle, are warned of.

        Raises
        ------
        ModelError
            If the linkage is rigid or not connected, has more drives than degrees of freedom, or a point or bar of no
            use.
        """
        return self._analyzed()[1]

    @property
    def system(self) -> System:
        """The System of SymPy, to go on by hand; it is made once, and anew after further statements.

        Raises
        ------
        ModelError
            As `mobility`.
        """
        self._analyzed()
        return self._built()[0]

    def model(self, **options: Any) -> Model:
        """Make a Model.

        Parameters
        ----------
        **options
            Those of `fourbar_codegen.Model`. Parameters, inputs, initial values and outputs are added to those of the
            linkage, or replace them; keys are symbols or names. Initial angles are those of the drawing, and initial
            speeds zero.

        Returns
        -------
        Model

        Raises
        ------
        ModelError
            As `mobility` and `fourbar_codegen.Model`.

        Examples
        --------
        >>> points = {"A": (0, 0), "B": (0, -1)}
        >>> how = {"density": 1.0, "gravity": 9.81}
        >>> linkage = Linkage("pendulum", points=points, ground="A", links=["AB"], **how)
        >>> linkage.model(initial={"q_AB": 0.5}).coordinates
        ('q_AB',)
        """
        tree, mobility = self._analyzed()
        system, points, parameters = self._built()
        names = tree.coordinates
        initial = {f"q_{name}": float(value) for name, value in zip(names, tree.values, strict=True)}
        initial |= {f"u_{name}": 0.0 for name in mobility.independent}
        first = 2 * len(tree.cuts) + 1
        outputs = {self._effort(drive): multiplier(first + k) for k, drive in enumerate(self._parts.drives)}
        own: dict[str, Mapping[Any, Any]] = {
            "parameters": parameters, "inputs": self._parts.inputs, "initial": initial, "outputs": outputs
        }  # fmt: skip
        for argument, values in own.items():
            options[argument] = _merged(values, options.get(argument), argument)
        return Model(system, **{"name": self.name, "points": points, **options})

    def __repr__(self) -> str:
        parts = self._parts
        return (
            f"<Linkage {self.name}: {len(parts.points)} points, {len(parts.links)} links, {len(parts.slides)} blocks>"
        )

    def _effort(self, drive: Drive) -> str:
        """The name of the output for the torque or force that a drive takes."""
        return f"{'force' if drive.of in self._parts.slides else 'torque'}_{drive.at}"

    def _check_inputs(self, parameters: Iterable[sm.Symbol]) -> None:
        """Raise if an input, such as a drive's motion, is called as something else of the linkage."""
        taken = {symbol.name: "a parameter" for symbol in parameters}
        taken |= dict.fromkeys(map(self._effort, self._parts.drives), "an output")
        taken |= {_label(c): "a coordinate or speed" for c in (*self.q.values(), *self.u.values())}
        for name in map(_label, self._parts.inputs):
            if name in taken:
                raise ModelError(
                    f"The input {name} has the name of {taken[name]} of the linkage: give it another name. Inputs and "
                    "drives follow functions of time, but no coordinates."
                )

    def _change(self) -> Parts:
        """The parts, to be changed: what was found or made of them is no longer valid."""
        self._analysis = self._system = None
        return self._parts

    def _add_mass(self, point: str, mass: Quantity, what: str) -> None:
        added = self._quantity(mass, f"m_{point}", "kg", what)
        self._parts.masses[point] = self._parts.masses.get(point, sm.S.Zero) + added

    def _quantity(self, value: Quantity, name: str, unit: str, description: str) -> sm.Expr:
        """An expression for a quantity: of a number, the symbol of a new parameter; of a name, a new input."""
        if isinstance(value, str):
            if not re.fullmatch(r"[A-Za-z_]\w*", value):
                raise ModelError(
                    f"The {description} is a number, an expression, or the name of an input, made of letters, digits "
                    f"and underscores, not {shown(value)}."
                )
            function = me.dynamicsymbols(value)
            self._parts.inputs.setdefault(function, sm.S.Zero)
            return function
        if isinstance(value, sm.Expr) and not value.is_number:
            self._parts.symbols |= value.free_symbols
            return value
        known = finite_number(value, description)
        if known < 0.0 and unit in POSITIVE:
            raise ModelError(f"The {description} is {known:g} {unit}, but must not be negative.")
        symbol = new_symbol(name, self._parts.parameters, self._parts.symbols)
        self._parts.parameters[symbol] = Parameter(known, unit, description)
        return symbol

    def _component(self, value: Quantity, point: str, axis: str) -> sm.Expr:
        """A component of a force: of the number zero, no parameter."""
        what = f"force on {point} along {axis}"
        is_number = not (isinstance(value, str) or (isinstance(value, sm.Expr) and not value.is_number))
        if is_number and finite_number(value, what) == 0.0:
            return sm.S.Zero
        return self._quantity(value, f"F_{point}_{axis}", "N", what)

    def _known(self, point: Any) -> str:
        points = self._parts.points
        if not isinstance(point, str) or point not in points:
            raise ModelError(f"There is no point {shown(point)}; there are {', '.join(points) or 'none'}.")
        return point

    def _points(self, given: Any, what: str) -> list[str]:
        """Names of points, of a sequence, or of a text without gaps or with them."""
        if not isinstance(given, str):
            return [self._known(point) for point in _in_order(given, f"{what} is a sequence of names of points")]
        if re.search(r"[\s,-]", given.strip()):
            return [self._known(point) for point in re.split(r"[\s,-]+", given.strip())]
        found = _split(given, tuple(self._parts.points))
        if len(found) != 1:
            raise ModelError(
                f"{what} {given!r} is {'not made of names of points' if not found else 'ambiguous'}; there are "
                f"{', '.join(self._parts.points) or 'none'}. Write it as a list of names."
            )
        return list(found[0])

    def _joined(self, at: str, link: str | None, what: str) -> tuple[str, str]:
        """The link that a torque in a joint acts on, and the other one."""
        parts = self._parts
        if not isinstance(at, str) or at not in {*parts.points, *parts.links}:
            known = [*parts.points, *parts.links]
            raise ModelError(f"There is no joint or link {shown(at)} for a {what}.{meant(str(at), known)}")
        if at in parts.links:
            if link is not None:
                raise ModelError(f"A {what} on link {at} acts between it and the ground: name a joint, or no link=.")
            return at, GROUND
        at_joint = [name for name, members in parts.links.items() if at in members.points]
        others = [GROUND] * (at in parts.ground) + at_joint
        if link is None and at_joint and (len(at_joint) == 1 or others == [GROUND, at_joint[-1]]):
            return at_joint[0], GROUND
        if isinstance(link, str) and link in at_joint and len(others) == 2:
            return link, next(name for name in others if name != link)
        given = "" if link is None else f", not {shown(link)}"
        raise ModelError(
            f"The {what} at {at} is between two of {', '.join(others) or 'no links'}: name the link on which it "
            f"acts{given}."
        )

    def _ends(self, a: str, b: str, what: str) -> tuple[tuple[str, str], str]:
        ends = self._known(a), self._known(b)
        if self._parts.points[a] == self._parts.points[b]:
            raise ModelError(f"A {what} from {a} to {b} has no length: they are at the same place.")
        return ends, f"{a}{b}" if len(a) == len(b) == 1 else f"{a}_{b}"

    def _tree(self) -> Tree:
        parts = self._parts
        links = {name: link.points for name, link in parts.links.items()}
        return spanning_tree(parts.points, tuple(dict.fromkeys(parts.ground)), links, list(parts.slides.values()))

    def _analyzed(self) -> tuple[Tree, Mobility]:
        if self._analysis is None:
            self._analysis = self._analyze()
        return self._analysis

    def _analyze(self) -> tuple[Tree, Mobility]:
        parts = self._parts
        check_parts(self.name, parts)
        tree = self._tree()
        if tree.unreached:
            raise ModelError(
                f"Links {', '.join(tree.unreached)} are not connected to the ground ({', '.join(parts.ground)}), not "
                "even through other links."
            )
        pivoted = [name for name in tree.links if {*tree.links[name]} & {*parts.ground}]
        preferred = list(dict.fromkeys([*pivoted, *tree.slides, *tree.coordinates]))
        driven = [drive.of for drive in parts.drives]
        mobility = find_mobility(tree, size_of(parts), driven, preferred)
        check_mobility(self.name, parts, tree, mobility)
        return tree, self._with_wanted(tree, mobility, driven, preferred) if self._wanted else mobility

    def _with_wanted(self, tree: Tree, mobility: Mobility, driven: Sequence[str], preferred: Sequence[str]) -> Mobility:
        """The mobility with the independent coordinates that are asked for."""
        names = [*tree.coordinates]
        for name in self._wanted:
            if not isinstance(name, str) or name not in names:
                raise ModelError(
                    f"independent= names {shown(name)}, which is no link or block.{meant(str(name), names)} There are "
                    f"{', '.join(names)}."
                )
        found = find_mobility(tree, size_of(self._parts), driven, preferred, self._wanted)
        if len(found.independent) != len(mobility.independent):
            held = f" while {', '.join(driven)} is driven" if driven else ""
            those = ", ".join(mobility.independent)
            enough = f"{len(mobility.independent)} coordinates determine the others, such as {those}"
            raise ModelError(
                f"The coordinates of {', '.join(self._wanted)} cannot be independent as {self.name} is drawn{held}: "
                f"{enough if those else 'the drives determine all coordinates'}."
            )
        return found

    def _built(self) -> tuple[System, list[me.Point], dict[sm.Symbol, Parameter]]:
        tree, mobility = self._analyzed()
        shape = geometry(tree, tuple(dict.fromkeys(self._parts.ground)), self._parts.parameters)
        self._check_inputs((*shape.parameters, *self._parts.parameters))
        if self._system is None:
            self._system = build_system(self._parts, tree, shape, mobility.independent, bool(mobility.redundant))
        own = {**self._parts.parameters}
        for drive in self._parts.drives:  # where it is drawn is known when all links are
            if drive.start is not None:
                drawn = float(tree.values[tree.coordinates.index(drive.of)])
                own[drive.start] = replace(own[drive.start], value=drawn)
        if self._density is not None and all(link.density != self._density for link in self._parts.links.values()):
            own.pop(self._density, None)
        return *self._system, {**shape.parameters, **own}


def _in_order(given: Any, what: str) -> list[Any]:
    """The entries of a sequence: a set has no order, and a mapping more than its keys."""
    if isinstance(given, Set | Mapping):
        raise ModelError(f"{what}, not {shown(given)}.")
    return listed(given, what)


def _pair(given: Any, what: str) -> complex:
    """Two finite numbers as a complex one."""
    values = numbers(given, f"The coordinates (x, y) of {what}")
    if values.shape != (2,) or not is_finite(values):
        raise ModelError(f"{what[0].upper()}{what[1:]} has two finite coordinates, (x, y), not {shown(given)}.")
    return complex(*values)


def _split(text: str, names: tuple[str, ...]) -> list[tuple[str, ...]]:
    """All ways to write a text as names, one after the other."""
    if not text:
        return [()]
    return [(name, *rest) for name in names if text.startswith(name) for rest in _split(text[len(name) :], names)]


def _merged(own: Mapping[Any, Any], given: Any, argument: str) -> dict[Any, Any]:
    """The linkage's values with those that are given, which replace those of the same name."""
    if given is None:
        return dict(own)
    if not is_mapping(given):
        raise ModelError(f"{argument}= must be a mapping from symbols to values, not {shown(given)}.")
    names = {_label(key): key for key in own}
    merged = dict(own)
    for key, value in given.items():
        known = names.get(_label(key), key)
        old: Any = merged.get(known)
        keeps_unit = isinstance(old, Parameter) and not isinstance(value, Parameter)
        merged[known] = Parameter(value, old.unit, old.description) if keeps_unit else value
    return merged


def _label(key: Any) -> str:
    return key if isinstance(key, str) else str(getattr(key, "func", key)) if getattr(key, "args", ()) else str(key)
