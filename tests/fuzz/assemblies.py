"""All ways to close loops, against geometry and polynomials that are evaluated with 60 digits.

Lengths are often equal, angles often multiples of 15 degrees, roots many orders of magnitude apart: where two modes
meet, lie at infinity, or are known to half of all digits.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import mpmath
import numpy as np
import sympy as sm
import sympy.physics.mechanics as me
from builders.systems import masses_on_a_line

import fourbar_codegen as fb

DIGITS = 60
MEETING = 1e-9
"""Modes closer than the root of this, in units of the linkage, may be one or two, or none."""

A, B, X, Y = me.dynamicsymbols("a b x y")
P = sm.symbols("p0:8")


def _on_a_line(name: str, constraints: list[sm.Expr], coordinates: list[sm.Expr]) -> fb.CompiledModel:
    return fb.compile_model(fb.Model(masses_on_a_line(constraints, coordinates), name=name), check=False)


@cache
def model_of(kind: str) -> fb.CompiledModel:
    """Each compiled once in a process."""
    crank, ground, coupler, rocker, *_ = P
    loop = [
        crank * sm.cos(A) + coupler * sm.cos(B) - ground - rocker * sm.cos(X),
        crank * sm.sin(A) + coupler * sm.sin(B) - rocker * sm.sin(X),
    ]
    along = [crank * sm.cos(A) - ground + X * sm.cos(B), crank * sm.sin(A) + X * sm.sin(B)]
    slide = [crank * sm.cos(A) + ground * sm.cos(B) - X, crank * sm.sin(A) + ground * sm.sin(B) - coupler]
    gear = [crank * sm.cos(2 * B) + ground * sm.sin(B) - sm.cos(A)]
    cubics = [P[0] + P[1] * X + P[2] * X**3 + A - Y, P[3] + P[4] * Y + P[5] * Y**3 - X]
    return {
        "four-bar": lambda: _on_a_line("loop", loop, [A, B, X]),
        "inverted slider-crank": lambda: _on_a_line("along", along, [A, B, X]),
        "slider-crank": lambda: _on_a_line("slide", slide, [A, B, X]),
        "gear": lambda: _on_a_line("gear", gear, [A, B]),
        "roots": lambda: _on_a_line("roots", [sm.prod([X - p for p in P]) + A], [A, X]),
        "cubics": lambda: _on_a_line("cubics", cubics, [A, X, Y]),
    }[kind]()


def _crossings(square: Any, size: Any) -> tuple[int, int]:
    """The least and the most modes that +- the root of a square stands for."""
    if abs(square) <= MEETING * size:
        return 0, 2
    return (2, 2) if square > 0 else (0, 0)


def _four_bar(p: list[Any], a: Any) -> tuple[int, int]:
    """Circles about the crank's end and about the other pivot."""
    crank, ground, coupler, rocker = p[:4]
    square = crank**2 + ground**2 - 2 * crank * ground * mpmath.cos(a)
    size = max(map(abs, p[:4])) ** 2
    if square <= MEETING * size:  # both centers in one point: none, or infinitely many
        return 0, 10**9
    along = (square + coupler**2 - rocker**2) / 2
    return _crossings(square * coupler**2 - along**2, size**2)


def _inverted(p: list[Any], a: Any) -> tuple[int, int]:
    """Plus and minus the distance of the crank's end from the bar's pivot."""
    square = p[0] ** 2 + p[1] ** 2 - 2 * p[0] * p[1] * mpmath.cos(a)
    return (0, 10**9) if square <= MEETING * max(p[0], p[1]) ** 2 else (2, 2)


def _slider(p: list[Any], a: Any) -> tuple[int, int]:
    """The rod's end on the line, at the offset p2."""
    return _crossings(p[1] ** 2 - (p[0] * mpmath.sin(a) - p[2]) ** 2, max(p[:3]) ** 2)


def _gear(p: list[Any], a: Any) -> tuple[int, int]:
    """A quadratic in sin b: two angles for each root within the unit circle."""
    # p0 (1 - 2 s^2) + p1 s - cos a = 0
    root = p[1] ** 2 + 8 * p[0] * (p[0] - mpmath.cos(a))
    size = (abs(p[0]) + abs(p[1]) + 1) ** 2
    if abs(root) <= MEETING * size:
        return 0, 4
    if root < 0:
        return 0, 0
    least = most = 0
    for sign in (-1, 1):
        fewer, more = _crossings(1 - ((p[1] + sign * mpmath.sqrt(root)) / (4 * p[0])) ** 2, 1)
        least, most = least + fewer, most + more
    return least, most


def _cubics(p: list[Any], a: Any) -> tuple[int, int]:
    """The nonic's real roots."""
    y = sm.Poly(0, X)
    x = sm.Poly(X, X)
    exact = [sm.Float(value, DIGITS) for value in p]
    y = x * exact[1] + x**3 * exact[2] + exact[0] + sm.Float(a, DIGITS)
    nonic = y * exact[4] + y**3 * exact[5] + exact[3] - x
    roots = mpmath.polyroots([mpmath.mpf(c) for c in nonic.all_coeffs()], maxsteps=500, extraprec=400)
    size = max(map(abs, roots))
    close = sum(abs(one - other) <= mpmath.sqrt(MEETING) * size for i, one in enumerate(roots) for other in roots[:i])
    real = sum(abs(mpmath.im(root)) <= mpmath.mpf(10) ** -20 * size for root in roots)
    return real - 2 * close, real + 2 * close


def case(generator: np.random.Generator, say: Callable[[str], None]) -> None:
    """One linkage or polynomial, its modes counted and looked at."""
    kind = str(generator.choice(["four-bar", "inverted slider-crank", "slider-crank", "gear", "roots", "cubics"]))
    regular = generator.random() < 0.5
    angle = float(generator.integers(-12, 13) * np.pi / 12 if regular else generator.uniform(-np.pi, np.pi))
    unit = 10.0 ** generator.integers(-6, 7)
    p = (generator.integers(1, 5, 8) / 2 if generator.random() < 0.5 else generator.uniform(0.1, 2.0, 8)) * unit
    if kind == "roots":
        p = generator.choice([-1.0, 1.0], 8) * 10.0 ** generator.uniform(-4, 4, 8) * unit
        angle = 0.0
    elif kind == "gear":
        p = p / unit * generator.choice([-1.0, 1.0], 8)
    elif kind == "cubics":
        p = 0.3 * generator.normal(size=8) + [0.0, 2.0, -1.0, 0.0, 2.0, -1.0, 0.0, 0.0]
        angle = 0.0
    say(f"{kind} at {angle!r} with {p.tolist()}")
    model = model_of(kind)
    used = {name: float(value) for name, value in zip((s.name for s in P), p, strict=True) if name in model.parameters}
    modes = model.initial_states([angle], [0.0], parameters=used)
    with mpmath.workdps(DIGITS):
        exact, at = [mpmath.mpf(value) for value in p], mpmath.mpf(angle)
        if kind == "roots":
            gaps = np.diff(np.sort(p)) / np.abs(p).max()
            least = most = 8
            if gaps.min() < 1e-12:
                least = 1
        else:
            count = {
                "four-bar": _four_bar, "inverted slider-crank": _inverted, "slider-crank": _slider, "gear": _gear,
                "cubics": _cubics,
            }[kind]  # fmt: skip
            least, most = count(exact, at)
    say(f"{kind} at {angle!r} with {p.tolist()}: {modes!r}, of {least} to {most}")
    assert len(modes) <= most
    assert len(modes) >= least or not modes.is_complete
    assert modes.is_complete or most > 9, "what has a resultant is complete"
    for x in modes:
        x = np.nan_to_num(x)  # speeds that are not determined
        residual = model.position_constraints(0.0, x[: model.n_q], used)
        assert (np.abs(residual) <= 1e-12 * model.kernel.constraint_scale(0.0, x, used)[0]).all()
    if kind == "roots" and least == 8:
        np.testing.assert_allclose(modes.x[:, 1], np.sort(p), rtol=1e-9)
