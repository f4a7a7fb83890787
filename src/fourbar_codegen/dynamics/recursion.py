"""Kane's equations of trees in numbers of operations proportional to the number of bodies.

Instead of M, its products and those of its inverse are formed, by articulated bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.articulated_bodies import MasslessError
from fourbar_codegen.dynamics.kane import Kane
from fourbar_codegen.expressions.derivatives import Jvp
from fourbar_codegen.expressions.tape import Result, Scalar

__all__ = ["MIN_SPEEDS", "Recursion", "form_recursion"]

MIN_SPEEDS = 4
"""Fewest speeds for which products with M are not formed by M itself."""


@dataclass(frozen=True)
class Recursion:
    """Products with M and its inverse.

    Attributes
    ----------
    side : tuple of Scalar
        The leaves of a vector, (n_u,).
    forcing : Result
        f, (n_u,), in the form with the fewest operations together with `solution`.
    pivots : Result
        Positive numbers where M is positive definite, (n_u,).
    solution : Result
        M^-1 times the vector, (n_u,).
    product : Result
        M times the vector, (n_u,).
    is_local : bool
        Whether f is formed in the points' own frames, see `Kane.generalized_forces`.
    """

    side: tuple[Scalar, ...]
    forcing: Result
    pivots: Result
    solution: Result
    product: Result
    is_local: bool


def form_recursion(
    kane: Kane, rate: Jvp, known: Sequence[Scalar], side: Sequence[Scalar], *, complete: bool
) -> Recursion | None:
    """Form the recursions of a mechanism.

    Parameters
    ----------
    kane : Kane
    rate : Jvp
        Differentiation with respect to time, with u' = 0.
    known : sequence of Scalar
        f, formed along inertial axes.
    side : sequence of Scalar
        Leaves of a vector, (n_u,).
    complete : bool
        Whether f has all loads, so that it can be formed anew.

    Returns
    -------
    Recursion or None
        None with fewer than `MIN_SPEEDS` speeds, or if M is singular at all states, since bodies have no mass.
    """
    n_u = len(side)
    if n_u < MIN_SPEEDS:
        return None
    try:
        bodies = kane.articulated_bodies()
    except MasslessError:
        return None
    tape, solution = kane.tape, bodies.solve(side)
    forcings = [known]
    if complete:
        forcings.append(kane.generalized_forces(rate, local=True)[:n_u])
    costs = [tape.count_operations([*forcing, *solution]) for forcing in forcings]
    best = costs.index(min(costs))

    def result(name: str, entries: Sequence[Scalar]) -> Result:
        return Result(name, (n_u,), tuple(entries))

    return Recursion(
        side=tuple(side),
        forcing=result("forcing", forcings[best]),
        pivots=result("pivots", [bodies.pivots[r] for r in range(n_u)]),
        solution=result("solution", solution),
        product=result("product", bodies.multiply(side)),
        is_local=best == 1,
    )
