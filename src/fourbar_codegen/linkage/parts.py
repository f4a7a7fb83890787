"""What a planar linkage is made of, as it was stated: plain data."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field

import sympy as sm

from fourbar_codegen.linkage.tree import GROUND, Slide
from fourbar_codegen.modeling.model import Parameter

__all__ = ["Drive", "Link", "Parts", "PointForce", "Strut", "Torque", "new_symbol"]


@dataclass(frozen=True)
class Link:
    """A rigid link.

    Attributes
    ----------
    points : tuple of str
        Its angle is that of the way from the first to the second.
    density : Expr or None
        Mass by length: of a bar, or of bars along the sides of a plate.
    mass, inertia : Expr or None
        The inertia is about the mass centre.
    center : (Expr, Expr) or None
        The mass centre, m, from the first point, along the link's axes; None for that of uniform bars.
    """

    points: tuple[str, ...]
    density: sm.Expr | None = None
    mass: sm.Expr | None = None
    inertia: sm.Expr | None = None
    center: tuple[sm.Expr, sm.Expr] | None = None


@dataclass(frozen=True)
class PointForce:
    """A force on a point, N."""

    point: str
    x: sm.Expr
    y: sm.Expr


@dataclass(frozen=True)
class Torque:
    """A torque on a link, N m, and the opposite one on another."""

    link: str
    reaction: str
    value: sm.Expr


@dataclass(frozen=True)
class Strut:
    """A spring (with its free length) or a damper between two points."""

    kind: str
    ends: tuple[str, str]
    coefficient: sm.Expr
    length: sm.Expr = sm.S.Zero


@dataclass(frozen=True)
class Drive:
    """A prescribed motion: of a link's angle, or of a block's displacement; from where it is drawn, or not."""

    at: str
    of: str
    function: sm.Expr
    expression: sm.Expr
    start: sm.Expr | None = None


@dataclass
class Parts:
    """All that was stated of a linkage.

    Attributes
    ----------
    points : dict of str to complex
        As drawn, m.
    ground : list of str
    links : dict of str to Link
    slides : dict of str to Slide
    masses : dict of str to Expr
        Of points, kg.
    gravity : Expr or None
        Acceleration in the direction of -y.
    symbols : set of Symbol
        Those in given expressions: new parameters have other names.
    """

    points: dict[str, complex] = field(default_factory=dict)
    ground: list[str] = field(default_factory=list)
    links: dict[str, Link] = field(default_factory=dict)
    slides: dict[str, Slide] = field(default_factory=dict)
    masses: dict[str, sm.Expr] = field(default_factory=dict)
    gravity: sm.Expr | None = None
    forces: list[PointForce] = field(default_factory=list)
    torques: list[Torque] = field(default_factory=list)
    struts: list[Strut] = field(default_factory=list)
    drives: list[Drive] = field(default_factory=list)
    parameters: dict[sm.Symbol, Parameter] = field(default_factory=dict)
    inputs: dict[sm.Expr, sm.Expr | float] = field(default_factory=dict)
    symbols: set[sm.Basic] = field(default_factory=set)

    @property
    def carriers(self) -> dict[str, tuple[str, ...]]:
        """The points of the ground and of each link."""
        return {GROUND: tuple(self.ground), **{name: link.points for name, link in self.links.items()}}


def new_symbol(name: str, *taken: Container[sm.Symbol]) -> sm.Symbol:
    """A symbol that is not taken, with a number behind its name if necessary."""
    symbol, number = sm.Symbol(name), 2
    while any(symbol in symbols for symbols in taken):
        symbol, number = sm.Symbol(f"{name}_{number}"), number + 1
    return symbol
