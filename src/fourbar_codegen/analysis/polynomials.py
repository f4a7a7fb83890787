"""Constraints as polynomials in some of the coordinates, and their common roots, in extended precision.

The variable of an angle q is z = exp(i q), with negative powers as well; that of a displacement is itself. Coefficients
and roots have enough digits to decide which roots are double, real, or at infinity, despite rounding errors.

Source: the resultant of two polynomials is the determinant of Sylvester's matrix (D. Cox, J. Little, D. O'Shea,
*Ideals, Varieties, and Algorithms*, chapter 3); roots by the method of Durand and Kerner, from mpmath.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import reduce
from itertools import product
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fourbar_codegen.layout import Formulas

__all__ = ["Coefficients", "Constraints", "Polynomial", "at", "real_roots", "reduced", "terms_of"]

ROOT_DIGITS = 25
"""Digits of a root; a root of multiplicity m has only 1/m of the coefficients' digits."""

COEFFICIENT_DIGITS = 100

COEFFICIENT_RTOL = 1e-80
"""A coefficient is zero below this fraction of its bound."""

LINE_RTOL = 1e-18
"""Coefficients on a line through a root, which has `ROOT_DIGITS`, are zero below this fraction of their terms."""

REAL_ROOT_RTOL = 1e-5
"""Relative tolerance for a root to be real. Where two real roots meet, data known to 1e-13 give roots to 3e-7."""

MAX_DEGREE = 64
"""Largest degree of polynomials to be solved, which takes seconds."""

Powers = tuple[int, ...]
Polynomial = dict[Powers, Any]
"""Coefficients by the powers of each unknown."""

Coefficients = dict[int, Any]
"""Coefficients of a polynomial in one unknown, by its powers."""


_OF_THREAD = threading.local()


def _numbers() -> Any:
    """Mpmath's arithmetic, with a precision that other threads and the user's own mpmath do not change."""
    if not hasattr(_OF_THREAD, "numbers"):
        import mpmath

        _OF_THREAD.numbers = mpmath.MPContext()
        _OF_THREAD.numbers.dps = COEFFICIENT_DIGITS
    return _OF_THREAD.numbers


@dataclass(frozen=True)
class _Affine:
    """a . q + b, affine in the unknown angles, with the coefficients a by number of the unknown."""

    slopes: tuple[Any, ...]
    constant: Any


@dataclass(frozen=True)
class _Value:
    """The value of an operation: a polynomial, or affine in the angles, or both, or neither."""

    polynomial: Polynomial | None
    affine: _Affine | None


class Constraints:
    """Expressions as data from `formulas`, with values of the known leaves.

    Parameters
    ----------
    formulas : Formulas
    values : mapping of (str, str) to float
        Kind and name of each leaf.
    """

    def __init__(self, formulas: Formulas, values: Mapping[tuple[str, str], float]) -> None:
        self._operations = cast("list[list[Any]]", formulas.operations)
        self._results = cast("list[list[Any]]", formulas.results)
        self._values = dict(values)
        self._reached = [self._reach(node) for node, _ in self._results]
        self._leaves = [
            {tuple(self._operations[n]) for n in nodes if _is_leaf(self._operations[n])} for nodes in self._reached
        ]

    def with_values(self, values: Mapping[tuple[str, str], Any]) -> Constraints:
        """The same expressions with other values of some leaves."""
        other = copy(self)
        other._values = {**self._values, **values}
        return other

    def combined(self, weights: NDArray[np.float64]) -> Constraints:
        """Sums of the expressions with whole numbers as weights, in rows."""
        operations, results = list(self._operations), list[list[Any]]()
        for row in weights:
            terms = [(*self._results[k], int(weight)) for k, weight in enumerate(row) if weight]
            scaled = [
                [node, [factor[0] * w, factor[1]] if isinstance(factor, list) else factor * w]
                for node, factor, w in terms
            ]
            if len(scaled) > 1:
                operations.append(["+", scaled, 0])
                scaled = [[len(operations) - 1, 1]]
            results += scaled
        return Constraints(Formulas(operations, results), self._values)

    def depends(self, row: int, name: str) -> bool:
        """Whether an expression contains a coordinate."""
        return ("q", name) in self._leaves[row]

    def _reach(self, node: int | None) -> list[int]:
        found: set[int] = set()
        stack = [] if node is None else [node]
        while stack:
            node = stack.pop()
            if node not in found:
                found.add(node)
                stack += _operands(self._operations[node])
        return sorted(found)

    def is_periodic(self, row: int, name: str) -> bool:
        """Whether an expression is periodic in a coordinate by 2 pi, as far as its form shows."""
        if not self.depends(row, name):
            return True
        expansion = _Expansion(self._values, [(name, True)], _numbers())
        known: dict[int | None, _Value] = {None: expansion.number(1)}
        periodic: dict[int | None, bool] = {None: True}
        for node in self._reached[row]:
            operation = self._operations[node]
            known[node] = value = expansion.evaluated(operation, known)
            if operation[0] == "tan":  # periodic if the sine is
                value = expansion.evaluated(["sin", operation[1]], known)
            periodic[node] = value.polynomial is not None or (
                operation != ["q", name] and all(periodic[operand] for operand in _operands(operation))
            )
        return periodic[self._results[row][0]]

    def polynomials(
        self, rows: Sequence[int], unknowns: Sequence[tuple[str, bool]], numbers: Any = None
    ) -> list[Polynomial] | None:
        """Expressions as polynomials in coordinates.

        Parameters
        ----------
        rows : sequence of int
        unknowns : sequence of (str, bool)
            The coordinates' names, and whether each is an angle.
        numbers : optional
            Arithmetic of the coefficients, with mpmath's names; mpmath's own by default. Coefficients may be arrays.

        Returns
        -------
        list of Polynomial or None
            None if one of them is no polynomial in these.
        """
        expansion = _Expansion(self._values, unknowns, numbers or _numbers())
        known: dict[int | None, _Value] = {None: expansion.number(1)}
        for node in sorted({node for row in rows for node in self._reached[row]}):
            known[node] = expansion.evaluated(self._operations[node], known)
        found = []
        for node, factor in (self._results[row] for row in rows):
            polynomial = known[node].polynomial
            if polynomial is None or not all(map(expansion.numbers.isfinite, polynomial.values())):
                return None
            scale, largest = expansion.exact(factor), sum(map(abs, polynomial.values()))
            bound = COEFFICIENT_RTOL * largest
            found.append({powers: scale * c for powers, c in polynomial.items() if np.any(abs(c) > bound)})
        return found


def _is_leaf(operation: list[Any]) -> bool:
    return isinstance(operation[1], str)


def _operands(operation: list[Any]) -> list[int]:
    match operation:
        case ["+", terms, _]:
            return [node for node, _ in terms]
        case ["*" | "?", nodes]:
            return [node for node in nodes if node is not None]
        case ["/", node]:
            return [node]
        case [_, str()]:
            return []
    return _mentioned(operation)


def _mentioned(encoded: list[Any]) -> list[int]:
    match encoded:
        case ["@", node]:
            return [node]
        case ["=", _]:
            return []
    return [node for argument in encoded[1] for node in _mentioned(argument)]


class _Expansion:
    """Operations on `_Value`s, with values of the known leaves."""

    def __init__(
        self, values: Mapping[tuple[str, str], Any], unknowns: Sequence[tuple[str, bool]], numbers: Any
    ) -> None:
        self.numbers = numbers
        self.values = values
        self.places = {name: place for place, (name, _) in enumerate(unknowns)}
        self.is_angle = [is_angle for _, is_angle in unknowns]
        self.origin = (0,) * len(unknowns)

    def exact(self, number: Any) -> Any:
        """A number from `formulas`, which may be a fraction."""
        return self.numbers.mpf(number[0]) / number[1] if isinstance(number, list) else self.numbers.mpf(number)

    def number(self, number: Any) -> _Value:
        """A number as a constant polynomial."""
        return _Value({self.origin: number}, _Affine(self.origin, number))

    def evaluated(self, operation: list[Any], known: Mapping[Any, _Value]) -> _Value:
        """The value of one operation on known values."""
        match operation:
            case ["+", terms, constant]:
                terms = [(known[node], self.exact(factor)) for node, factor in terms]
                return self._sum([*terms, (self.number(self.exact(constant)), 1)])
            case ["*", factors]:
                return reduce(self._product, (known[factor] for factor in factors))
            case ["/", node]:
                return self._called(lambda x: 1 / x, [known[node]])
            case ["?", _]:
                return _Value(None, None)
            case [kind, str(name)]:
                return self._leaf(kind, name)
        return self._call_value(operation, known)

    def _leaf(self, kind: str, name: str) -> _Value:
        place = self.places.get(name) if kind == "q" else None
        if place is None:
            return self.number(self.numbers.mpf(self.values[kind, name]))
        unit = tuple(int(other == place) for other in range(len(self.origin)))
        if self.is_angle[place]:
            return _Value(None, _Affine(unit, self.numbers.zero))
        return _Value({unit: self.numbers.one}, None)

    def _sum(self, terms: list[tuple[_Value, Any]]) -> _Value:
        total: Polynomial | None = {}
        slopes, constant, is_affine = [self.numbers.zero for _ in self.origin], self.numbers.zero, True
        for value, factor in terms:
            if value.polynomial is None or total is None:
                total = None
            else:
                for powers, c in value.polynomial.items():
                    total[powers] = total.get(powers, 0) + factor * c
            if value.affine is None:
                is_affine = False
            else:
                slopes = [a + factor * b for a, b in zip(slopes, value.affine.slopes, strict=True)]
                constant = constant + factor * value.affine.constant
        return _Value(total, _Affine(tuple(slopes), constant) if is_affine else None)

    def _product(self, one: _Value, other: _Value) -> _Value:
        for value, factor in ((one, other), (other, one)):
            if value.polynomial is not None and value.polynomial.keys() == {self.origin}:
                return self._sum([(factor, value.polynomial[self.origin])])
        if one.polynomial is None or other.polynomial is None:
            return _Value(None, None)
        return _Value(_times(one.polynomial, other.polynomial), None)

    def _constants(self, values: Sequence[_Value]) -> list[Any] | None:
        """The values as numbers; None if one depends on the unknowns."""
        polynomials = [value.polynomial for value in values]
        if any(polynomial is None or polynomial.keys() != {self.origin} for polynomial in polynomials):
            return None
        return [polynomial[self.origin] for polynomial in polynomials if polynomial is not None]

    def _called(self, function: Callable[..., Any], arguments: Sequence[_Value]) -> _Value:
        """A function of arguments that do not depend on the unknowns."""
        constants = self._constants(arguments)
        if constants is None:
            return _Value(None, None)
        try:
            return self.number(self.numbers.convert(function(*constants)))
        except (ValueError, ZeroDivisionError, OverflowError):
            return self.number(self.numbers.nan)

    def _call_value(self, encoded: list[Any], known: Mapping[Any, _Value]) -> _Value:
        match encoded:
            case ["@", node]:
                return known[node]
            case ["=", number]:
                return self.number(self.exact(number))
        name, arguments = encoded[0], [self._call_value(argument, known) for argument in encoded[1]]
        if name == "+":
            return self._sum([(argument, 1) for argument in arguments])
        if name == "*":
            return reduce(self._product, arguments)
        if name in ("sin", "cos") and self._constants(arguments) is None:
            return _Value(self._harmonic(name, arguments[0].affine), None)
        return self._called(self.numbers.power if name == "^" else getattr(self.numbers, name), arguments)

    def _harmonic(self, name: str, angle: _Affine | None) -> Polynomial | None:
        """cos(k . q + b) = (w + 1/w) / 2, w = exp(i b) z^k; the sine is (w - 1/w) / 2i."""
        if angle is None or not all(self.numbers.isint(slope) for slope in angle.slopes):
            return None
        k = tuple(map(int, angle.slopes))
        turned = self.numbers.expj(angle.constant) / (2 if name == "cos" else 2j)
        back = tuple(-power for power in k)
        return {k: turned, back: self.numbers.conj(turned)}


def _times(one: Polynomial, other: Polynomial) -> Polynomial:
    total: Polynomial = {}
    for (powers, c), (more, d) in product(one.items(), other.items()):
        both = tuple(a + b for a, b in zip(powers, more, strict=True))
        total[both] = total.get(both, 0) + c * d
    return total


def real_roots(polynomials: Sequence[Polynomial], is_angle: Sequence[bool]) -> list[tuple[float, ...]] | None:
    """Candidates for common roots of one or two polynomials in as many unknowns, including all real ones.

    Parameters
    ----------
    polynomials : sequence of Polynomial
    is_angle : sequence of bool
        For each unknown, whether it is an angle; displacements have no negative powers.

    Returns
    -------
    list of tuple of float, or None
        Angles between -pi and pi, and displacements. They include real parts of nearly real roots (see
        `REAL_ROOT_RTOL`) and, for two polynomials, further points on the same lines, so candidates have to be tested.
        None if there are infinitely many roots, or the degree is too high.

    Examples
    --------
    >>> real_roots([{(2,): 1, (0,): -4}], [False])
    [(-2.0,), (2.0,)]
    """
    if not all(polynomials):
        return None
    numbers = _numbers()
    units = [numbers.one if angle else _unit(polynomials, place) for place, angle in enumerate(is_angle)]
    polynomials = [{powers: c * numbers.fprod(map(pow, units, powers)) for powers, c in f.items()} for f in polynomials]
    values: list[tuple[float, ...]] | None
    if len(units) == 1:
        [polynomial] = polynomials
        roots = _roots({power: c for (power,), c in polynomial.items()}, is_angle[0])
        values = None if roots is None else [(value,) for value in _real(roots, is_angle[0])]
    else:
        values = _real_pairs(polynomials, is_angle)
    if values is None:
        return None
    return [tuple(float(value * unit) for value, unit in zip(root, units, strict=True)) for root in values]


def terms_of(polynomial: Polynomial, sizes: Sequence[float]) -> float:
    """The sum of the terms' absolute values, for absolute values of the unknowns (1 for exp(i q))."""
    numbers = _numbers()
    values = [numbers.mpf(size) for size in sizes]
    terms = (abs(c) * numbers.fprod(map(pow, values, powers)) for powers, c in polynomial.items())
    return float(numbers.fsum(terms))


def _unit(polynomials: Sequence[Polynomial], place: int) -> Any:
    """A typical value of a displacement, where the terms of its lowest and highest power have equal magnitude."""
    numbers = _numbers()
    for polynomial in polynomials:
        powers = {key[place] for key in polynomial}
        if max(powers) > min(powers):
            low, high = (
                max(abs(c) for key, c in polynomial.items() if key[place] == power)
                for power in (min(powers), max(powers))
            )
            return numbers.root(low / high, max(powers) - min(powers))
    return numbers.one


def _real_pairs(polynomials: Sequence[Polynomial], is_angle: Sequence[bool]) -> list[tuple[float, ...]] | None:
    """Candidates for common roots of two polynomials, in units of the unknowns."""
    if is_angle[1] and not is_angle[0]:  # eliminate the angle, since roots of displacements may be far apart
        swapped = _real_pairs([{(b, a): c for (a, b), c in f.items()} for f in polynomials], is_angle[::-1])
        return None if swapped is None else [(x, y) for y, x in swapped]
    pair = reduced(polynomials, is_angle[1])
    resultant = _resultant(*pair) if all(pair) else None
    roots = None if resultant is None else _roots(resultant, is_angle[0])
    if roots is None:
        return None
    found: list[tuple[float, ...]] = []
    for x in _near_real(roots, is_angle[0]):
        lines = [{k: at(coefficient, x) for k, coefficient in f.items()} for f in pair]
        terms = [max(_at_size(coefficient, x) for coefficient in f.values()) for f in pair]
        isolating = False
        for line, size in zip(lines, terms, strict=True):
            held = {k: c for k, c in line.items() if abs(c) > LINE_RTOL * size}
            if not held:
                continue
            isolating = True
            others = _roots(held, is_angle[1])
            if others is None:
                return None
            found += [(_value(x, is_angle[0]), y) for y in _real(others, is_angle[1])]
        if not isolating:
            return None
    return found


def _by_second(polynomial: Polynomial, is_angle: bool) -> dict[int, Coefficients]:
    """The coefficients, polynomials in the first unknown, by powers of the second, shifted to begin at 0."""
    lowest = min(power for _, power in polynomial) if is_angle else 0
    found: dict[int, Coefficients] = {}
    for (first, second), c in polynomial.items():
        found.setdefault(second - lowest, {})[first] = c
    return found


def reduced(
    polynomials: Sequence[Polynomial], is_angle: bool, rounding: float = COEFFICIENT_RTOL
) -> list[dict[int, Coefficients]]:
    """Two polynomials with the same common roots, of lower degree in the second unknown, by powers of that.

    If their leading coefficients are multiples of each other, one of them is eliminated; likewise the lowest ones, if
    the second unknown is an angle, since its exponential is not zero. The loop of a dyad, whose components are real and
    imaginary parts of a complex equation, becomes that equation and its conjugate.

    Returns
    -------
    list of dict
        Coefficients, polynomials in the first unknown; the polynomial of higher degree first. Empty for zero.
    """
    by_powers = [_by_second(polynomial, is_angle) for polynomial in polynomials]
    longer, shorter = sorted(by_powers, key=lambda f: -max(f))
    for end in (max, min) if is_angle else (max,):
        while longer and shorter and end(longer) == end(shorter):
            factor = _ratio(longer[end(longer)], shorter[end(shorter)], rounding)
            if factor is None:
                break
            less = {k: _difference(c, shorter.get(k, {}), factor, rounding) for k, c in longer.items()}
            less |= {k: _difference({}, c, factor, rounding) for k, c in shorter.items() if k not in longer}
            less = {k: c for k, c in less.items() if c}
            if is_angle and less:
                lowest = min(less)
                less = {k - lowest: c for k, c in less.items()}
            longer, shorter = sorted((less, shorter), key=lambda f: -max(f, default=-1))
    return [longer, shorter]


def _ratio(one: Coefficients, other: Coefficients, rounding: float) -> Any:
    """The ratio if one is a multiple of the other, or None."""
    place = next(iter(other))
    factor = one.get(place, 0) / other[place]
    return factor if np.any(factor) and not _difference(one, other, factor, rounding) else None


def _difference(one: Coefficients, other: Coefficients, factor: Any, rounding: float) -> Coefficients:
    """One - factor * other, without coefficients that are rounding errors."""
    found = {}
    for power in {*one, *other}:
        a, b = one.get(power, 0), factor * other.get(power, 0)
        if not np.all(abs(a - b) <= rounding * (abs(a) + abs(b))):
            found[power] = a - b
    return found


def at(coefficients: Coefficients, x: Any) -> Any:
    """The value of a polynomial."""
    return sum(c * x**k for k, c in coefficients.items())


def _at_size(coefficients: Coefficients, x: Any) -> Any:
    return sum(abs(c) * abs(x) ** k for k, c in coefficients.items())


def _resultant(f: dict[int, Coefficients], g: dict[int, Coefficients]) -> Coefficients | None:
    """The resultant, a polynomial in the first unknown; None if it vanishes.

    Interpolated at roots of unity. If one of the two does not contain the second unknown, it is the resultant.
    """
    numbers = _numbers()
    m, n = max(f), max(g)
    if not m or not n:
        return None if m == n else (f if not m else g)[0]
    lowest = [min(min(c) for c in polynomial.values()) for polynomial in (f, g)]
    highest = [max(max(c) for c in polynomial.values()) for polynomial in (f, g)]
    degree = n * (highest[0] - lowest[0]) + m * (highest[1] - lowest[1])
    if degree > MAX_DEGREE:
        return None
    points = [numbers.expjpi(numbers.mpf(2 * k) / (degree + 1)) for k in range(degree + 1)]
    values, bound = [], numbers.zero
    for x in points:
        rows = [{k: at(c, x) / x**low for k, c in p.items()} for p, low in zip((f, g), lowest, strict=True)]
        shifted = [(rows[0], i) for i in range(n)] + [(rows[1], i) for i in range(m)]
        values.append(
            _determinant([[line.get(k - shift, numbers.zero) for k in range(m + n)] for line, shift in shifted])
        )
        bound = max(bound, sum(map(abs, rows[0].values())) ** n * sum(map(abs, rows[1].values())) ** m)
    coefficients = {
        k: sum(value / x**k for value, x in zip(values, points, strict=True)) / (degree + 1) for k in range(degree + 1)
    }
    held = {k: c for k, c in coefficients.items() if abs(c) > COEFFICIENT_RTOL * bound}
    return held or None


def _determinant(rows: list[list[Any]]) -> Any:
    """By elimination with partial pivoting; mpmath's own raises an error if a column is zero."""
    value = _numbers().one
    for k in range(len(rows)):
        pivot = max(range(k, len(rows)), key=lambda i: abs(rows[i][k]))
        if not rows[pivot][k]:
            return _numbers().zero
        if pivot != k:
            rows[k], rows[pivot], value = rows[pivot], rows[k], -value
        value *= rows[k][k]
        for row in rows[k + 1 :]:
            factor = row[k] / rows[k][k]
            row[k + 1 :] = [a - factor * b for a, b in zip(row[k + 1 :], rows[k][k + 1 :], strict=True)]
    return value


def _roots(coefficients: Coefficients, is_angle: bool) -> list[Any] | None:
    """All roots, with multiplicity; zero only for displacements."""
    lowest, highest = min(coefficients), max(coefficients)
    zeros = [] if is_angle else [_numbers().zero] * lowest
    degree = highest - lowest
    if degree > MAX_DEGREE:
        return None
    if not degree:
        return zeros
    falling = [coefficients.get(k, _numbers().zero) for k in range(highest, lowest - 1, -1)]
    numbers = _numbers()
    bits = numbers.prec
    with numbers.workdps(ROOT_DIGITS):
        try:
            roots = numbers.polyroots(falling, maxsteps=2000, extraprec=bits)
        except numbers.NoConvergence:
            return None
    return [*zeros, *roots]


def _value(root: Any, is_angle: bool) -> float:
    return float(_numbers().arg(root)) if is_angle else float(_numbers().re(root))


def _near_real(roots: list[Any], is_angle: bool) -> list[Any]:
    """The roots that are real up to rounding errors of the data."""
    if is_angle:
        return [root for root in roots if abs(abs(root) - 1) <= REAL_ROOT_RTOL]
    return [root for root in roots if abs(_numbers().im(root)) <= REAL_ROOT_RTOL * max(abs(root), 1)]


def _real(roots: list[Any], is_angle: bool) -> list[float]:
    return sorted({_value(root, is_angle) for root in _near_real(roots, is_angle)})
