"""The choice of the form in which accelerations are solved for: dense, sparse or recursive.

All forms are counted in operations, and the one with the fewest is taken.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from fourbar_codegen.dynamics.equations import Equations
from fourbar_codegen.dynamics.recursion import Recursion
from fourbar_codegen.errors import ModelError
from fourbar_codegen.expressions.identities import rank as find_rank
from fourbar_codegen.expressions.tape import Scalar
from fourbar_codegen.lowering.elimination import (
    MAX_CONSTRAINTS,
    find_pivot_order,
    find_structure,
    recursive_cost,
    solution_cost,
)
from fourbar_codegen.lowering.program import PivotOrder, Structure

__all__ = ["Form", "choose_form"]

MIN_PIVOT_RATIO = 1e-9
"""Smallest pivot of M relative to its diagonal; that of the first link of a chain is of the order 1 / n^3."""

# Measured with the models of benchmarks/forms.py: by these, each is printed in its fastest form or in one that takes at
# most a fifth more.
MAX_RECURSIVE_RATIO = 0.87
"""Share of the dense form's operations up to which the recursive form is faster."""
ELIMINATION_COST = 1.5
"""Operations in straight-line code that take the time of one multiplication of a dense elimination, and ..."""
LOOP_COST = 3
"""... of one multiplication in the short loops for constraints of a recursion."""

N_EXAMPLES = 4
"""Points at which sparse Jacobians are evaluated."""

N_POINTS = 8
"""Pairs of random points at which the constraints' Jacobian is evaluated."""


@dataclass(frozen=True)
class Form:
    """How accelerations are solved for.

    Attributes
    ----------
    kind : {"dense", "sparse", "recursive"}
    rank : int
        The number of constraints that are not redundant.
    structure : Structure or None
        Places of the entries of M and J, and their elimination order, of the sparse form.
    pivot_order : PivotOrder
        Of J, for the others.
    """

    kind: str
    rank: int
    structure: Structure | None
    pivot_order: PivotOrder


def choose_form(name: str, equations: Equations, kind: str | None = None) -> Form:
    """The form with the fewest operations, or the one that is asked for.

    Raises
    ------
    ModelError
        If the equations do not have that form.

    Examples
    --------
    >>> from fourbar_codegen.dynamics.formation import form_equations
    >>> from fourbar_codegen.models import chain, four_bar
    >>> [choose_form(m.name, form_equations(m)).kind for m in (four_bar(), chain(20))]
    ['dense', 'recursive']
    """
    rank = _rank(equations)
    structure = _structure(equations, rank)
    costs = _costs(equations, rank, structure)
    found = kind or min(costs, key=costs.__getitem__)
    if found not in costs:
        raise ModelError(f"{name} has no {found} form; it has: {', '.join(costs)}.")
    if found != "sparse":
        structure = None
    return Form(found, rank, structure, _pivot_order(equations, rank, structure))


def _rank(e: Equations) -> int:
    """The number of constraints that are not redundant: that of dependent speeds, or the rank of J if it is smaller.

    The rank is that at a random point. `verify` tests it at states that satisfy the constraints.
    """
    n_u, entries = len(e.variables.speeds), e.velocities.jacobian.entries
    rows = [entries[i : i + n_u] for i in range(0, len(entries), n_u)]
    return min(e.velocities.n_dependent_speeds, find_rank(e.tape, rows))


def _pivot_order(e: Equations, rank: int, structure: Structure | None) -> PivotOrder:
    """A pivot order for J at random points, some of them near zero coordinates, where models often start.

    Constraints may be redundant only where loops are closed: then it is that at closed states, if any are known.
    """
    n_u, n_c = len(e.variables.speeds), len(e.velocities.bias.entries)
    if structure is not None or n_c > MAX_CONSTRAINTS:
        return find_pivot_order(n_c, n_u, rank, [])  # it is not used
    entries = e.velocities.jacobian.entries
    closed = [*_evaluated(e, entries, e.positions.closed_states if rank < n_c else ())]
    jacobians = [
        [numbers[i : i + n_u] for i in range(0, len(numbers), n_u)]
        for numbers in closed or _at_random_points(e, entries)
    ]
    return find_pivot_order(n_c, n_u, rank, jacobians)


def _at_random_points(e: Equations, entries: Sequence[Scalar]) -> Iterator[list[float]]:
    """Numbers for scalars at random points; where they have no value, none."""
    return _evaluated(e, entries, _random_points(e))


def _random_points(e: Equations) -> Iterator[dict[Scalar, float]]:
    """Random points, some of them near zero coordinates."""
    v, generator = e.variables, random.Random(0)
    for size in (0.05, 1.0) * N_POINTS:
        values = {leaf: generator.uniform(0.1, 1.0) for leaf in (v.time, *v.speeds, *v.parameters, *v.inputs)}
        yield values | {leaf: generator.uniform(-size, size) for leaf in v.coordinates}


def _evaluated(
    e: Equations, entries: Sequence[Scalar], points: Iterable[Mapping[Scalar, float]]
) -> Iterator[list[float]]:
    for values in points:
        numbers = e.tape.evaluate(entries, values)
        if all(map(math.isfinite, numbers)):  # some expressions have no value there
            yield numbers


def _structure(e: Equations, rank: int) -> Structure | None:
    n_u, n_c = len(e.variables.speeds), len(e.velocities.bias.entries)
    if rank < n_c:
        return None  # redundant constraints need pivoting
    mass = tuple((i, j) for i in range(n_u) for j in range(i + 1) if e.dynamics.mass_matrix.entries[i * n_u + j])
    jacobian = tuple((i, j) for i in range(n_c) for j in range(n_u) if e.velocities.jacobian.entries[i * n_u + j])
    examples = [_example(e, values) for values in itertools.islice(_random_points(e), N_EXAMPLES if n_c else 0)]
    return find_structure(n_u, n_c, mass, jacobian, examples)


def _example(e: Equations, values: Mapping[Scalar, float]) -> list[list[float]]:
    """J at a point, with random entries in rows that have no value there: parameters need not fit each other."""
    n_u, entries, generator = len(e.variables.speeds), e.velocities.jacobian.entries, random.Random(0)
    rows = []
    for row in (entries[i : i + n_u] for i in range(0, len(entries), n_u)):
        found = next(_evaluated(e, row, [values]), None)
        rows.append(found or [generator.uniform(0.5, 1.0) if entry else 0.0 for entry in row])
    return rows


def _costs(e: Equations, rank: int, structure: Structure | None) -> dict[str, float]:
    """The time to form and solve the equations in each form they have, in operations of straight-line code."""
    n_u, n_c = len(e.variables.speeds), len(e.velocities.bias.entries)
    d, count, recursion = e.dynamics, e.tape.count_operations, e.dynamics.recursion
    common = (*d.coordinate_rates.entries, *e.velocities.jacobian.entries, *e.velocities.acceleration_bias.entries)
    formed = count([*common, *d.forcing.entries, *d.mass_matrix.entries])
    costs = {"dense": formed + ELIMINATION_COST * solution_cost(n_u, n_c, None)}
    if structure is not None:
        costs["sparse"] = formed + ELIMINATION_COST * solution_cost(n_u, n_c, structure)
    # Redundant constraints need pivoting, and a recursion a regular M.
    if recursion is not None and rank == n_c and _is_regular(e, recursion):
        n_jacobian = sum(map(bool, e.velocities.jacobian.entries))
        of_solution = count(recursion.solution.entries) - count(recursion.pivots.entries)
        formed = count([*common, *recursion.forcing.entries, *recursion.solution.entries])
        costs["recursive"] = (
            formed + LOOP_COST * recursive_cost(n_u, n_c, n_jacobian, of_solution)
        ) / MAX_RECURSIVE_RATIO
    return costs


def _is_regular(e: Equations, recursion: Recursion) -> bool:
    """Whether M is regular beyond rounding errors at random points: constraints may be substituted into velocities.

    Random numbers need not be the inertia of a body, so pivots may be negative.
    """
    n_u = len(e.variables.speeds)
    diagonal = [e.dynamics.mass_matrix.entries[i * n_u + i] for i in range(n_u)]
    pairs = [
        (pivot, size)
        for numbers in itertools.islice(_at_random_points(e, [*recursion.pivots.entries, *diagonal]), 2)
        for pivot, size in zip(numbers[:n_u], numbers[n_u:], strict=True)
    ]
    return all(abs(pivot) > MIN_PIVOT_RATIO * abs(size) for pivot, size in pairs)
