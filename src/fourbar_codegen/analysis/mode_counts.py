"""Numbers of assembly modes at many values of the given coordinates at once, where double precision tells them.

The groups of `groups` are solved one after another, as for assembly modes, but with arrays as coefficients of the
polynomials: one entry for each value and each solution of earlier groups. Where a root is nearly double, nearly real or
nearly at infinity the number is unknown, and the assembly modes have to be found there with more digits.

Source: the roots of a polynomial are the eigenvalues of its companion matrix (R. A. Horn and C. R. Johnson, *Matrix
Analysis*, 2nd ed., 2013, section 3.3); resultants as in `polynomials`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.analysis.groups import leaf_values, solving_order
from fourbar_codegen.analysis.loop_closure import Loops
from fourbar_codegen.analysis.polynomials import Coefficients, Polynomial, at, reduced

__all__ = ["NO_COUNT", "mode_counts"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Mask = NDArray[np.bool_]

UNCERTAIN, NO_COUNT = -1, -2
"""Instead of a number of modes: double precision does not tell; loops are not solved one after another."""

ROUNDING_RTOL = 1e-11
"""A coefficient is zero below this fraction of its terms."""

REAL, NOT_REAL = 1e-9, 1e-4
"""Relative distances of roots from real numbers, up to which they are real, and from which on they are not."""

DOUBLE_ROOT_RTOL = 1e-5
"""Relative distance of roots that may be double."""

COMMON, NOT_COMMON = 1e-9, 1e-5
"""Values of polynomials relative to their terms, up to which a root is common, and from which on it is not."""

MAX_ENTRIES = 200_000
"""Largest number of values times solutions."""


class _Doubles:
    """The arithmetic of `Constraints.polynomials` on doubles, and arrays of them."""

    zero, one, nan = 0.0, 1.0, np.nan
    conj, convert, power = staticmethod(np.conj), staticmethod(np.asarray), staticmethod(np.power)

    def __getattr__(self, function: str) -> Any:
        return getattr(np, function)

    @staticmethod
    def mpf(number: Any) -> Any:
        return number

    @staticmethod
    def isint(number: Any) -> bool:
        return np.ndim(number) == 0 and bool(number == np.round(number))

    @staticmethod
    def isfinite(numbers: Any) -> bool:
        return bool(np.isfinite(numbers).all())

    @staticmethod
    def expj(angle: Any) -> Any:
        return np.exp(1j * np.asarray(angle))


def mode_counts(typical: Loops, others: Sequence[Loops], start: Floats) -> NDArray[np.int64]:
    """The numbers of ways to close loops that differ in the values of given coordinates, parameters and inputs.

    Parameters
    ----------
    typical : Loops
        Loops whose values are not special: the order in which they are solved is found there.
    others : sequence of Loops
    start : ndarray, shape (n,)
        Typical dependent coordinates.

    Returns
    -------
    ndarray of int, shape (len(others),)
        `UNCERTAIN` where double precision does not tell; `NO_COUNT` if loops are not solved one after another. Modes
        in which a part moves freely are not counted.
    """
    if not typical.model.n_h:
        return np.ones(len(others), dtype=np.int64)
    generator = np.random.default_rng(0)
    chart, groups, rest = solving_order(typical, start, generator)
    if rest:
        return np.full(len(others), NO_COUNT)
    tables = [leaf_values(some) for some in others]
    columns = {key: np.array([table[key] for table in tables]) for key in tables[0]}
    given = {key: values[0] if (values == values[0]).all() else values for key, values in columns.items()}
    place, certain = np.arange(len(others)), np.ones(len(others), dtype=bool)
    known: dict[tuple[str, str], Floats] = {}
    for group in groups:
        unknowns, units = chart.unknowns(group), chart.scales[list(group.unknowns)]
        leaves = {key: values[place] if np.ndim(values) else values for key, values in given.items()} | known
        with np.errstate(all="ignore"):
            polynomials = chart.constraints.with_values(leaves).polynomials(group.rows, unknowns, _Doubles())
            solved = polynomials and _solutions(
                [_in_units(polynomial, units, len(place)) for polynomial in polynomials],
                [is_angle for _, is_angle in unknowns],
            )
        if not solved or solved[1].sum() > MAX_ENTRIES:
            return np.full(len(others), UNCERTAIN)
        roots, holds, sure = solved
        np.logical_and.at(certain, place, sure)
        entries, numbers = np.nonzero(holds)
        place = place[entries]
        known = {key: values[entries] for key, values in known.items()}
        for (name, _), values, unit in zip(unknowns, roots, units, strict=True):
            known["q", name] = values[entries, numbers] * unit
    return np.where(certain, np.bincount(place, minlength=len(others)), UNCERTAIN)


def _in_units(polynomial: Polynomial, units: Floats, n: int) -> Polynomial:
    """A polynomial in unknowns in these units, without coefficients that are rounding errors; arrays of n entries."""
    found = {powers: np.broadcast_to(c * np.prod(units**powers), n) for powers, c in polynomial.items()}
    largest = np.max([np.abs(c) for c in found.values()], axis=0, initial=0.0)
    return {powers: c for powers, c in found.items() if (np.abs(c) > ROUNDING_RTOL * largest).any()}


@dataclass(frozen=True)
class _Roots:
    """Roots of polynomials in one unknown, on the last axis, for arrays of coefficients.

    Attributes
    ----------
    values : ndarray of float, shape (..., n_roots)
        Angles, or real parts.
    points : ndarray of complex, shape (..., n_roots)
        The roots themselves, exponentials of angles.
    are_real, are_certain : ndarray of bool, shape (..., n_roots)
        Which are real, and of which that is certain.
    are_simple : ndarray of bool, shape (...)
        Whether roots are finite and distinct.
    vanishes : ndarray of bool, shape (...)
        Whether the polynomial is zero: all numbers are roots.
    """

    values: Floats
    points: Complexes
    are_real: Mask
    are_certain: Mask
    are_simple: Mask
    vanishes: Mask

    @classmethod
    def of(cls, coefficients: Coefficients, is_angle: bool, size: Any) -> _Roots:
        """The roots, except zero for angles; `size` is that of the terms of which coefficients are sums."""
        powers = range(min(coefficients) if is_angle else 0, max(coefficients) + 1)
        shape = np.broadcast_shapes(*(np.shape(c) for c in coefficients.values()))
        rising = np.stack([np.broadcast_to(coefficients.get(k, 0.0), shape) for k in powers], axis=-1).astype(complex)
        largest, n = np.abs(rising).max(axis=-1), len(powers) - 1
        is_finite = np.asarray(np.abs(rising[..., -1]) > DOUBLE_ROOT_RTOL * np.maximum(largest, size))
        companion = np.zeros((*shape, n, n), dtype=complex)
        companion[..., range(1, n), range(n - 1)] = 1.0
        if n:
            companion[..., -1] = np.where(is_finite[..., None], -rising[..., :-1] / rising[..., -1:], 0.0)
        points = np.asarray(np.linalg.eigvals(companion), dtype=complex)
        sizes = np.maximum(np.abs(points), 1.0)
        gaps = np.abs(points[..., :, None] - points[..., None, :]) + 2.0 * np.eye(n) * sizes[..., None]
        away = np.abs(np.abs(points) - 1.0) if is_angle else np.abs(points.imag) / sizes
        return cls(
            np.angle(points) if is_angle else points.real,
            points,
            away <= REAL,
            (away <= REAL) | (away >= NOT_REAL),
            is_finite & (gaps > DOUBLE_ROOT_RTOL * sizes[..., None]).all(axis=(-2, -1)),
            np.asarray(largest <= ROUNDING_RTOL * size),
        )


def _solutions(polynomials: list[Polynomial], is_angle: list[bool]) -> tuple[list[Floats], Mask, Mask] | None:
    """Common roots of one or two polynomials in as many unknowns.

    Returns
    -------
    list of ndarray, shape (n, n_roots)
        Candidates, for each unknown.
    ndarray of bool, shape (n, n_roots)
        Whether each is a real common root.
    ndarray of bool, shape (n,)
        Whether that is certain.
    None
        If none is isolated.
    """
    if not all(polynomials):
        return None
    if len(is_angle) == 1:
        alone = _Roots.of({power: c for (power,), c in polynomials[0].items()}, is_angle[0], 0.0)
        return [alone.values], alone.are_real, alone.are_simple & alone.are_certain.all(axis=1)
    if is_angle[1] and not is_angle[0]:  # as in `polynomials`
        swapped = _solutions([{(b, a): c for (a, b), c in f.items()} for f in polynomials], is_angle[::-1])
        return None if swapped is None else (swapped[0][::-1], *swapped[1:])
    pair = reduced(polynomials, is_angle[1], ROUNDING_RTOL)
    if not all(pair):
        return None
    resultant, size = _resultant(*pair)
    if not resultant:
        return None
    x = _Roots.of(resultant, is_angle[0], size)
    y = _second(pair, x.points, is_angle[1])
    candidates = [np.repeat(x.values, y.values.shape[-1], axis=1), y.values.reshape(len(size), -1)]
    holds = (x.are_real[..., None] & y.are_real).reshape(len(size), -1)
    sure = x.are_simple & x.are_certain.all(axis=1)
    sure &= (y.are_simple & y.are_certain.all(axis=-1) | ~x.are_real).all(axis=1)
    points = [np.exp(1j * v) if angle else v for v, angle in zip(candidates, is_angle, strict=True)]
    away = np.max([_residual(polynomial, points) for polynomial in polynomials], axis=0)
    sure &= (~holds | (away <= COMMON) | (away >= NOT_COMMON)).all(axis=1)
    holds &= away <= COMMON
    if any(max(f) == len(f[max(f)]) == 1 for f in pair):
        # One is x^k y + g(x), which has no factors: the other is a multiple, and no common root is isolated.
        holds, sure = holds & ~x.vanishes[:, None], sure | x.vanishes
    return candidates, holds, sure


def _second(pair: list[dict[int, Coefficients]], x: Complexes, is_angle: bool) -> _Roots:
    """The second unknown at values of the first, shape (n, n_x, n_y), from the polynomial that determines it best."""
    found = []
    for f in sorted((f for f in pair if max(f)), key=max):
        terms = [np.abs(c[:, None] * x**power) for line in f.values() for power, c in line.items()]
        lines = {k: at({power: c[:, None] for power, c in line.items()}, x) for k, line in f.items()}
        found.append(_Roots.of(lines, is_angle, np.max(terms, axis=0)))
    first, other = found[0], found[-1]
    if first.values.shape != other.values.shape:
        return first
    use = first.are_simple
    return _Roots(
        *(
            np.where(use[..., None] if here.ndim > use.ndim else use, here, there)
            for here, there in ((getattr(first, field.name), getattr(other, field.name)) for field in fields(_Roots))
        )
    )


def _residual(polynomial: Polynomial, points: list[Any]) -> Floats:
    """The value of a polynomial relative to its terms."""
    terms = [c[:, None] * points[0] ** a * points[1] ** b for (a, b), c in polynomial.items()]
    return np.asarray(np.abs(sum(terms)) / np.abs(terms).sum(axis=0))


def _resultant(f: dict[int, Coefficients], g: dict[int, Coefficients]) -> tuple[Coefficients, Floats]:
    """The resultant with respect to the second unknown, by interpolation at roots of unity, and the size of its terms.

    Empty if it vanishes everywhere.
    """
    m, n = max(f), max(g)
    if not m or not n:
        alone = {} if m == n else (f if not m else g)[0]
        return alone, np.asarray(np.max([np.abs(c) for c in alone.values()], axis=0, initial=0.0))
    lowest = [min(min(c) for c in polynomial.values()) for polynomial in (f, g)]
    highest = [max(max(c) for c in polynomial.values()) for polynomial in (f, g)]
    degree = n * (highest[0] - lowest[0]) + m * (highest[1] - lowest[1])
    x = np.exp(2j * np.pi * np.arange(degree + 1) / (degree + 1))
    rows = [
        {k: at({p - low: v[:, None] for p, v in c.items()}, x) for k, c in polynomial.items()}
        for polynomial, low in zip((f, g), lowest, strict=True)
    ]
    matrix = np.zeros((*next(iter(rows[0].values())).shape, m + n, m + n), dtype=complex)
    for row, (line, shift) in enumerate([(rows[0], i) for i in range(n)] + [(rows[1], i) for i in range(m)]):
        for k, values in line.items():
            matrix[..., row, k + shift] = values
    size = np.linalg.norm(matrix, axis=-1).prod(axis=-1).max(axis=-1)
    coefficients = np.fft.fft(np.linalg.det(matrix), axis=-1) / (degree + 1)
    return {k: c for k, c in enumerate(coefficients.T) if (np.abs(c) > ROUNDING_RTOL * size).any()}, size
