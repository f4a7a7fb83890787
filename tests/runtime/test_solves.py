"""The three solutions of M u' = f + J^T lambda, J u' + gamma = 0 against mpmath: dense, sparse, and by products.

Errors of the references, of 40 digits, are negligible. Where no other reason is given, errors are below 1e-11: systems
of up to 19 unknowns, some 1000 operations with rounding errors of 1e-16, and condition numbers below 100 once rows of J
are scaled, as all three do.
"""

import ctypes
from itertools import chain, pairwise
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest
from harness.shims import Shims

OK, DEPENDENT, MASS_SINGULAR, NOT_FINITE, INDEPENDENT = 0, 1, 2, 3, 5
"""FB_STATUS."""


def reference(M, J, f, gamma):
    """u' and lambda, if these are determined."""
    n_u, n_c = len(M), len(J)
    with mpmath.workdps(40):
        matrix = np.block([[M, -J.T], [J, np.zeros((n_c, n_c))]]).tolist()
        found = mpmath.lu_solve(mpmath.matrix(matrix), mpmath.matrix([*f.tolist(), *(-gamma).tolist()]))
        values = np.array(found, dtype=float)
    return values[:n_u], values[n_u:]


def system(random, n_u, n_c):
    """A positive definite M with eigenvalues from 1 to 4, J of independent rows, f and gamma."""
    basis = np.linalg.qr(random.normal(size=(n_u, n_u)))[0]
    M = basis @ np.diag(np.linspace(1.0, 4.0, n_u)) @ basis.T
    J = np.linalg.qr(random.normal(size=(n_u, n_u)))[0][:n_c] + 0.1 * random.normal(size=(n_c, n_u))
    return (M + M.T) / 2.0, J, random.normal(size=n_u), random.normal(size=n_c)


class Solver:
    """A library for given sizes: `solve` returns the status, u', lambda, the kind of factors and what is left of J."""

    def __init__(self, shared, name, n_u, n_c, rank, *options, rows=None, speeds=None):
        self.n_u, self.n_c, self.rank = n_u, n_c, rank
        tables = {
            "SPEEDS": n_u,
            "CONSTRAINTS": n_c,
            "RANK": rank,
            "PIVOT_ROWS": listed(rows or range(max(n_c, 1))),
            "PIVOT_SPEEDS": listed(speeds or range(n_u)),
        }
        defined = [f"-D{key}={value}" for key, value in tables.items()]
        self.shims = Shims(shared(name, "shims_of_solve.c", options=(*defined, *options)))

    def mass(self, M):
        return np.ascontiguousarray(M)

    def jacobian(self, J):
        return np.ascontiguousarray(J)

    def solve(self, M, J, f, gamma, terms=0.0):
        found = SimpleNamespace(u=np.full(self.n_u, np.nan), multipliers=np.full(self.n_c, np.nan))
        kind, left = np.full(1, -1, dtype=np.intc), np.full(1, np.nan)
        given = (self.mass(M), self.jacobian(J), f, gamma)
        found.status = self.shims.solve(*given, terms, found.u, found.multipliers, kind, left)
        found.kind, found.left = kind[0], left[0]
        return found


class Recursive(Solver):
    """M as the pivots of its elimination, its inverse and itself."""

    def mass(self, M):
        with np.errstate(all="ignore"):
            singular = abs(np.linalg.det(M)) < 1e-12
            pivots = np.diag(M).copy() if not singular else np.append(np.diag(M)[:-1], 0.0)
            inverse = np.full_like(M, np.nan) if singular else np.linalg.inv(M)
        return np.concatenate((pivots, inverse.ravel(), M.ravel()))


class Sparse(Solver):
    """Entries of M and J, in an elimination order, with the tables that linear_algebra/sparse_ldl.inc describes."""

    def __init__(self, shared, name, n_u, mass, jacobian, order, *options):
        self.of_mass, self.of_jacobian = np.array(mass), np.array(jacobian)
        n_c = int(self.of_jacobian[:, 0].max()) + 1
        starts = np.searchsorted(self.of_jacobian[:, 0], range(n_c + 1))
        columns = [self.of_jacobian[begin:end, 1] for begin, end in pairwise(starts)]
        step = {unknown: k for k, unknown in enumerate(order)}
        pairs = [(i, j) for row in columns for place, i in enumerate(row) for j in row[: place + 1]]
        couplings = [*mass, *[(n_u + row, i) for row, i in jacobian], *pairs]
        later = [set() for _ in order]
        for a, b in couplings:
            if a != b:
                later[min(step[a], step[b])].add(max(step[a], step[b]))
        below, targets = [], []
        for k in range(len(order)):
            below.append(sorted(later[k]))
            for place, i in enumerate(below[k]):
                later[i] |= set(below[k][place + 1 :])
        begins = np.cumsum([0, *map(len, below)])

        def place(a, b):
            low, high = sorted((a, b))
            return low if low == high else len(order) + begins[low] + below[low].index(high)

        for each in below:
            for i in range(len(each) - 1, -1, -1):
                targets += [place(each[i], each[j]) for j in range(i + 1)]
        tables = {
            "MASS_ROW": listed(self.of_mass[:, 0]),
            "MASS_COLUMN": listed(self.of_mass[:, 1]),
            "JACOBIAN_ROW": listed(starts),
            "JACOBIAN_COLUMN": listed(self.of_jacobian[:, 1]),
            "UNKNOWN": listed(order),
            "COLUMN": listed(begins),
            "BELOW": listed(chain.from_iterable(below)),
            "MASS_PLACE": listed(place(step[i], step[j]) for i, j in mass),
            "JACOBIAN_PLACE": listed(place(step[n_u + row], step[i]) for row, i in jacobian),
            "PAIR_PLACE": listed(place(step[i], step[j]) for i, j in pairs),
            "TARGET": listed(targets),
        }
        defined = [f"-D{key}={value}" for key, value in tables.items()]
        super().__init__(shared, name, n_u, n_c, n_c, "-DFB_SPARSE", *defined, *options)

    def mass(self, M):
        return M[self.of_mass[:, 0], self.of_mass[:, 1]]

    def jacobian(self, J):
        return J[self.of_jacobian[:, 0], self.of_jacobian[:, 1]]

    def system(self, random):
        """Numbers in the pattern: M is positive definite since its diagonal dominates."""
        M, J = np.zeros((self.n_u, self.n_u)), np.zeros((self.n_c, self.n_u))
        for i, j in self.of_mass:
            M[i, j] = M[j, i] = 3.0 if i == j else random.uniform(-1.0, 1.0)
        for row, i in self.of_jacobian:
            J[row, i] = random.choice([-1.0, 1.0]) * random.uniform(0.5, 1.0)
        return M, J, random.normal(size=self.n_u), random.normal(size=self.n_c)


def listed(values):
    return ",".join(str(value) for value in values)


@pytest.fixture(scope="module")
def solvers(shared):
    """Libraries by name, compiled at their first use."""
    made = {}
    tree = [(i, i) for i in range(6)] + [(i + 1, i) for i in range(5)]
    links = [(0, 0), (0, 2), (0, 3), (1, 3), (1, 5)]
    make = {
        "dense": lambda name: Solver(shared, name, 5, 2, 2, rows=[1, 0], speeds=[3, 0, 1, 2, 4]),
        "dense without static order": lambda name: Solver(shared, name, 10, 9, 9),
        "dense without constraints": lambda name: Solver(shared, name, 4, 0, 0),
        "redundant": lambda name: Solver(shared, name, 5, 3, 2),
        "recursive": lambda name: Recursive(shared, name, 5, 2, 2, "-DFB_RECURSIVE"),
        "recursive without constraints": lambda name: Recursive(shared, name, 4, 0, 0, "-DFB_RECURSIVE"),
        "sparse": lambda name: Sparse(shared, name, 6, tree, links, [1, 0, 2, 3, 6, 4, 5, 7]),
        "sparse, early": lambda name: Sparse(shared, name, 6, tree, links, [0, 1, 6, 2, 5, 7, 3, 4], "-DFB_EARLY"),
    }

    def solver(name):
        if name not in made:
            made[name] = make[name](name.replace(" ", "_").replace(",", ""))
        return made[name]

    return solver


DENSE = ["dense", "dense without static order", "dense without constraints"]
RECURSIVE = ["recursive", "recursive without constraints"]
SPARSE = ["sparse", "sparse, early"]


def random_system(solver, seed):
    random = np.random.default_rng(seed)
    return solver.system(random) if isinstance(solver, Sparse) else system(random, solver.n_u, solver.n_c)


@pytest.mark.parametrize("name", [*DENSE, *RECURSIVE, *SPARSE])
@pytest.mark.parametrize("seed", range(5))
def test_accelerations_and_multipliers_agree_with_mpmath(solvers, name, seed):
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, seed)
    found, (u, multipliers) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert found.status == OK
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.multipliers, multipliers, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("name", ["dense", "dense without static order", "sparse", "sparse, early"])
@pytest.mark.parametrize("exponent", [-5.0, 5.0])
def test_units_of_constraints_do_not_matter(solvers, name, exponent):
    """A row in other units has a multiplier in the inverse ones."""
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 11)
    unit = np.ones(solver.n_c)
    unit[0] = 10.0**exponent
    u, multipliers = reference(M, J, f, gamma)
    found = solver.solve(M, J * unit[:, np.newaxis], f, gamma * unit)
    assert found.status == OK
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.multipliers * unit, multipliers, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", ["dense", "dense without static order", "sparse", "sparse, early", "recursive"])
@pytest.mark.parametrize("unit", [1e-20, 1e20])
def test_a_unit_that_all_constraints_share_does_not_matter(solvers, name, unit):
    """However small: no entry of J counts as a rounding error but by comparison with others."""
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 15)
    u, multipliers = reference(M, J, f, gamma)
    found = solver.solve(M, J * unit, f, gamma * unit)
    assert found.status == OK
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.multipliers * unit, multipliers, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", ["dense", "recursive", "sparse"])
def test_units_of_masses_do_not_matter(solvers, name):
    """M and f in units of 1e-6: the same accelerations, and multipliers in these units."""
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 12)
    u, multipliers = reference(M, J, f, gamma)
    found = solver.solve(1e-6 * M, J, 1e-6 * f, gamma)
    assert found.status == OK
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.multipliers, 1e-6 * multipliers, rtol=0.0, atol=1e-17)


def test_the_static_order_is_taken_only_if_its_pivots_are_large(solvers):
    """Row 1 is solved for speed 3 first, then row 0 for speed 0; the limit is a quarter of the row's largest entry."""
    solver = solvers("dense")
    M, _, f, gamma = random_system(solver, 3)
    for pivot, kind in ((1.0, 1), (0.3, 1), (0.2, 0), (0.0, 0)):
        J = np.array([[1.0, 0.5, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, pivot, 0.0]])
        found, (u, multipliers) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
        assert (found.status, found.kind) == (OK, kind)
        np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(found.multipliers, multipliers, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(("unit", "kind"), [(1e-5, 1), (1e-7, 0)])
def test_the_static_order_is_taken_only_if_rows_have_similar_units(solvers, unit, kind):
    """FB_NEAR_DEPENDENCE_RTOL = 1e-6: a smaller row may be what is left of two dependent ones."""
    solver = solvers("dense")
    M, _, f, gamma = random_system(solver, 3)
    J = np.array([[unit, 0.5 * unit, 0.0, 0.0, 0.0], [0.0, 0.0, 0.5, 1.0, 0.0]])
    gamma[0] *= unit
    found, (u, _) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert (found.status, found.kind) == (OK, kind)
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)


def test_nearly_dependent_rows_are_solved_by_complete_pivoting(solvers):
    """They differ by 1e-8: the condition number costs as many digits."""
    solver = solvers("dense")
    M, _, f, gamma = random_system(solver, 4)
    J = np.array([[0.3, 1.0, -0.5, 0.2, 0.1], [0.3, 1.0, -0.5, 0.2, 0.1 + 1e-8]])
    found, (u, _) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert (found.status, found.kind) == (OK, 0)
    np.testing.assert_allclose(found.u, u, rtol=1e-6)


@pytest.mark.parametrize("name", ["dense", "dense without static order", "recursive", "sparse", "sparse, early"])
@pytest.mark.parametrize("kind", ["zero", "equal"])
def test_dependent_constraints_have_their_status(solvers, name, kind):
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 5)
    J[-1] = 0.0
    if kind == "equal":
        if isinstance(solver, Sparse):  # rows 0 and 1 have speed 3 in common
            J[0] = 0.0
            J[:, 3] = 0.7
        else:
            J[-1] = -2.0 * J[0]
    assert solver.solve(M, J, f, gamma).status == DEPENDENT


@pytest.mark.parametrize("name", ["dense", "dense without static order", "recursive", "sparse", "redundant"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_jacobian_that_is_not_finite_has_its_status(solvers, name, value):
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 6)
    J[0, 0] = value
    assert solver.solve(M, J, f, gamma).status == NOT_FINITE


@pytest.mark.parametrize("name", ["dense", "recursive", "sparse"])
def test_constraints_may_determine_what_a_singular_mass_does_not(solvers, name):
    """M leaves out the last speed, which a constraint sets."""
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 7)
    M[-1] = M[:, -1] = 0.0
    found, (u, multipliers) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert found.status == OK
    if name == "recursive":
        assert found.kind == 1  # the dense solution
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(found.multipliers, multipliers, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("name", ["dense", "recursive", "dense without constraints", "recursive without constraints"])
def test_a_motion_without_mass_has_its_status(solvers, name):
    """Neither M nor a constraint determines the last speed."""
    solver = solvers(name)
    M, J, f, gamma = random_system(solver, 8)
    M[-1] = M[:, -1] = 0.0
    J[:, -1] = 0.0
    assert solver.solve(M, J, f, gamma).status == MASS_SINGULAR


def test_a_sparse_motion_without_mass_has_its_status(solvers):
    solver = solvers("sparse")
    M, J, f, gamma = random_system(solver, 8)
    M[4] = M[:, 4] = 0.0  # in no constraint
    assert solver.solve(M, J, f, gamma).status == MASS_SINGULAR


def test_a_negative_mass_has_its_status(solvers):
    solver = solvers("dense")
    M, J, f, gamma = random_system(solver, 9)
    assert solver.solve(-M, J, f, gamma).status == MASS_SINGULAR


@pytest.mark.parametrize("entry", [0.0, 1e-9, 1e-3])
def test_an_early_constraint_with_a_small_pivot_takes_the_dense_solution(solvers, entry):
    """Of constraint 0 only speed 0 comes before it; its pivot goes with the square, and is compared with 1e-4."""
    solver = solvers("sparse, early")
    M, J, f, gamma = random_system(solver, 10)
    assert solver.solve(M, J, f, gamma).kind == 0
    J[0, 0] = entry
    found, (u, multipliers) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert (found.status, found.kind) == (OK, 1)
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(found.multipliers, multipliers, rtol=0.0, atol=1e-11)


def test_products_take_the_dense_solution_if_constraints_are_nearly_dependent(solvers):
    """The pivot of J M^-1 J^T is below 1e-7 of its diagonal, since it is the square of 1e-5."""
    solver = solvers("recursive")
    M, J, f, gamma = random_system(solver, 13)
    assert solver.solve(M, J, f, gamma).kind == 0
    J[1] = J[0] + 1e-5 * J[1]
    found, (u, _) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert (found.status, found.kind) == (OK, 1)
    np.testing.assert_allclose(found.u, u, rtol=1e-9)


def test_products_are_refined_where_constraints_are_less_nearly_dependent(solvers):
    """The condition number of J M^-1 J^T, 1e6, is that of J squared: refinement leaves the errors of J's, 1e3."""
    solver = solvers("recursive")
    M, J, f, gamma = random_system(solver, 13)
    J[1] = J[0] + 1e-3 * J[1]
    found, (u, _) = solver.solve(M, J, f, gamma), reference(M, J, f, gamma)
    assert (found.status, found.kind) == (OK, 0)
    np.testing.assert_allclose(J @ found.u, -gamma, rtol=0.0, atol=1e-15 * np.abs(u).max() * 10.0)
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-12 * np.abs(u).max())


def redundant(seed, scale=1.0):
    """Row 2 is a combination of the others, with the same weights in J and in gamma."""
    random = np.random.default_rng(seed)
    M, J, f, gamma = system(random, 5, 2)
    weights = scale * random.normal(size=2)
    return M, np.vstack((J, weights @ J)), f, np.append(gamma, weights @ gamma), weights


def shortest(multipliers, weights):
    """The multipliers of minimum norm with the effect of those without the redundant row: with J = W J_2, these are
    W (W^T W)^-1 times them.
    """
    with mpmath.workdps(60):
        W = mpmath.matrix([[1, 0], [0, 1], weights.tolist()])
        return np.array(W * mpmath.lu_solve(W.T * W, mpmath.matrix(multipliers.tolist())), dtype=float)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", [1e-8, 1e-4, 1.0, 1e4, 1e8])
def test_redundant_constraints_have_the_accelerations_without_them_and_the_shortest_multipliers(solvers, seed, scale):
    """In any unit of the redundant row: each multiplier times its row is part of the force of the constraints."""
    M, J, f, gamma, weights = redundant(seed, scale)
    found, (u, multipliers) = solvers("redundant").solve(M, J, f, gamma), reference(M, J[:2], f, gamma[:2])
    assert found.status == OK
    assert found.left < 1e-14
    np.testing.assert_allclose(found.u, u, rtol=0.0, atol=1e-11)
    units = np.abs(J).max(axis=1)
    expected = shortest(multipliers, weights)
    np.testing.assert_allclose(found.multipliers * units, expected * units, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize(("error", "status"), [(1e-2, DEPENDENT), (1e-5, OK)])
def test_redundant_rows_must_be_satisfied_up_to_the_drift_of_a_run(solvers, error, status):
    """FB_DRIFT_RTOL = 1e-3 of gamma, whose entries are about 1 here."""
    M, J, f, gamma, _ = redundant(1)
    gamma[2] += error
    assert solvers("redundant").solve(M, J, f, gamma).status == status


def test_terms_of_gamma_that_cancel_widen_the_tolerance_of_redundant_rows(solvers):
    M, J, f, gamma, _ = redundant(1)
    gamma[2] += 1e-2
    assert solvers("redundant").solve(M, J, f, gamma, terms=100.0).status == OK


@pytest.mark.parametrize(("size", "status"), [(1e-1, INDEPENDENT), (1e-5, OK)])
def test_a_third_direction_of_redundant_rows_is_reported(solvers, size, status):
    M, J, f, gamma, _ = redundant(2)
    J[2] += size * np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    found = solvers("redundant").solve(M, J, f, gamma)
    assert found.status == status
    assert found.left > 1e-2 * size


def test_a_lost_rank_of_redundant_constraints_has_its_status(solvers):
    M, J, f, gamma, _ = redundant(3)
    J[1], J[2] = 2.0 * J[0], -J[0]
    assert solvers("redundant").solve(M, J, f, gamma).status == DEPENDENT


@pytest.mark.parametrize("name", ["dense", "dense without static order", "recursive", "redundant"])
@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_columns_of_right_hand_sides_are_solved_as_one_by_one(solvers, name, n):
    """(f, -gamma) in each; an odd number of columns leaves lanes of the vectors empty."""
    solver = solvers(name)
    M, J = (redundant(4) if name == "redundant" else random_system(solver, 14))[:2]
    random = np.random.default_rng(n)
    f, gamma = random.normal(size=(solver.n_u, n)), random.normal(size=(solver.n_c, n))
    if name == "redundant":
        gamma[2] = np.linalg.lstsq(J[:2].T, J[2], rcond=None)[0] @ gamma[:2]
    found = np.full((solver.n_u, n), np.nan)
    sides = np.vstack((f, -gamma))
    assert solver.shims.solve_columns(solver.mass(M), solver.jacobian(J), n, sides, found) == OK
    expected = [reference(M, J[: solver.rank], f[:, j], gamma[: solver.rank, j])[0] for j in range(n)]
    np.testing.assert_allclose(found, np.array(expected).T, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("seed", range(6))
def test_the_signed_pivot_has_the_sign_of_the_determinant(solvers, seed):
    solver = solvers("dense without static order")
    J = np.random.default_rng(seed).normal(size=(9, 10))
    found = solver.shims.signed_pivot(1, J, J, np.zeros(1), returns=ctypes.c_double)
    assert np.sign(found) == np.sign(np.linalg.det(J[:, :9]))


def test_the_signed_pivot_is_the_least_pivot_in_the_units_of_the_run(solvers):
    """Columns of a run had the largest entries 2 and 4; those of J are 1 and 3, so that its pivots are 1/2 and 3/4."""
    solver = solvers("dense")
    run = np.array(
        [[[2.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 4.0, 0.0, 0.0, 0.0]]]
    )
    J = np.array([[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, -3.0, 0.0, 0.0, 0.0]])
    factor = np.zeros(1)
    assert solver.shims.signed_pivot(2, run, J, factor, returns=ctypes.c_double) == -0.5
    # The unit of the second column has grown fourfold since.
    assert factor[0] == 4.0
    J[1, 1] = 0.0
    assert solver.shims.signed_pivot(2, run, J, factor, returns=ctypes.c_double) == 0.0


@pytest.mark.parametrize(("difference", "expected"), [(1e-3, 0), (1e-7, 1), (0.0, 1)])
def test_a_jacobian_close_to_losing_rank_is_told_by_its_least_pivot(solvers, difference, expected):
    """FB_NEAR_SINGULAR_RATIO = 1e-5 of the largest of the run, 1 here."""
    solver = solvers("dense")
    J = np.array([[1.0, 0.5, 0.0, 0.0, 0.0], [1.0, 0.5 + difference, 0.0, 0.0, 0.0]])
    assert solver.shims.is_close_by(J, 1.0) == expected


LAW = ctypes.CFUNCTYPE(None, *[ctypes.POINTER(ctypes.c_double)] * 5)


class Forces:
    """Unknown forces n: F(n) and Q(n) with their derivatives, and the rows M_a and J_a^T of the auxiliary speeds."""

    def __init__(self, seed, law=None):
        random = np.random.default_rng(seed)
        self.B, self.C, self.c = random.normal(size=(5, 2)), random.normal(size=(2, 2)), random.normal(size=2)
        self.M_a, self.J_a = random.normal(size=(2, 5)), random.normal(size=(2, 2))
        self.law = law or (lambda n: (self.B @ n, self.B, self.c + self.C @ n, self.C))
        self.rows = np.concatenate((self.M_a.ravel(), self.J_a.ravel()))

        def given(n, *results):
            for result, value in zip(results, self.law(np.array(n[:2])), strict=True):
                for i, entry in enumerate(np.ravel(value)):
                    result[i] = entry

        self.callback = LAW(given)


@pytest.fixture(scope="module")
def forced(shared):
    return Solver(shared, "forced", 5, 2, 2, "-DFORCES=2")


def with_forces(forced, forces, M, J, f, gamma):
    u, multipliers = np.full(5, np.nan), np.full(4, np.nan)
    status = forced.shims.solve_with_forces(forces.callback, forces.rows, M, J, f, gamma, u, multipliers)
    return status, u, multipliers


def coupled(forces, M, J):
    """The matrix of all equations, with u', lambda and linear forces as unknowns."""
    return np.block(
        [[M, -J.T, -forces.B], [J, np.zeros((2, 4))], [-forces.M_a, forces.J_a, forces.C]],
    )


@pytest.fixture(scope="module")
def forced_linear(shared):
    """For laws that one step of Newton's method solves."""
    return Solver(shared, "forced_linear", 5, 2, 2, "-DFORCES=2", "-DFB_FORCES_LINEAR")


@pytest.mark.parametrize("library", ["forced", "forced_linear"])
@pytest.mark.parametrize("seed", range(5))
def test_forces_that_keep_auxiliary_speeds_zero_solve_all_equations_at_once(request, library, seed):
    forced = request.getfixturevalue(library)
    M, J, f, gamma = random_system(forced, seed)
    forces = Forces(seed)
    status, u, multipliers = with_forces(forced, forces, M, J, f, gamma)
    expected = np.linalg.solve(coupled(forces, M, J), np.concatenate((f, -gamma, -forces.c)))
    assert status == OK
    # The condition number of the equations is below 1e3 here.
    np.testing.assert_allclose(
        np.concatenate((u, multipliers)), expected, rtol=0.0, atol=1e-11 * np.abs(expected).max()
    )


@pytest.mark.parametrize("seed", range(5))
def test_forces_with_friction_satisfy_their_equations(forced, seed):
    """F has a term of |n|, as of friction, and Q a cubic one: residuals are those of the rows, put in."""
    M, J, f, gamma = random_system(forced, seed)
    forces = Forces(seed)

    def law(n):
        effect = forces.B @ n + 0.1 * np.abs(n).sum()
        slopes = forces.B + 0.1 * np.sign(n)
        return effect, slopes, forces.c + 3.0 * n + n**3, np.diag(3.0 + 3.0 * n**2)

    forces.law = law
    status, u, multipliers = with_forces(forced, forces, M, J, f, gamma)
    assert status == OK
    n, effect, forcing = multipliers[2:], law(multipliers[2:])[0], law(multipliers[2:])[2]
    # FB_FORCES_RTOL = 1e-13 of the terms, which are below 100.
    np.testing.assert_allclose(M @ u - f - effect - J.T @ multipliers[:2], 0.0, atol=1e-11)
    np.testing.assert_allclose(J @ u + gamma, 0.0, atol=1e-12)
    np.testing.assert_allclose(forcing - forces.M_a @ u + forces.J_a @ multipliers[:2], 0.0, atol=1e-11)
    assert np.abs(n).max() < 100.0


def test_forces_without_effect_on_their_rows_are_undetermined(forced):
    M, J, f, gamma = random_system(forced, 1)
    forces = Forces(1)
    forces.B[:, 1], forces.C[:, 1] = 0.0, 0.0
    assert with_forces(forced, forces, M, J, f, gamma)[0] == 6  # FB_FORCES_UNDETERMINED


def test_forces_without_solution_are_not_found(forced):
    """exp(n_0) = 0, apart from the other equations: each step of Newton's method reduces n_0 by 1."""
    M, J, f, gamma = random_system(forced, 1)
    forces = Forces(1)
    forces.B[:], forces.rows[:] = 0.0, 0.0

    def law(n):
        value = np.exp(min(n[0], 700.0))
        return forces.B @ n, forces.B, [value, n[1] - 4.0], np.diag([value, 1.0])

    forces.law = law
    assert with_forces(forced, forces, M, J, f, gamma)[0] == 7  # FB_FORCES_NOT_FOUND


def test_forces_are_found_from_a_start_where_their_law_has_a_derivative(forced):
    """At 0, where Newton's method begins, that of n^2 vanishes."""
    M, J, f, gamma = random_system(forced, 1)
    forces = Forces(1)
    forces.B[:], forces.rows[:] = 0.0, 0.0
    forces.law = lambda n: (forces.B @ n, forces.B, n**2 - [9.0, 4.0], np.diag(2.0 * n))
    status, _, multipliers = with_forces(forced, forces, M, J, f, gamma)
    assert status == OK
    np.testing.assert_allclose(np.abs(multipliers[2:]), [3.0, 2.0], rtol=1e-13)


def test_forces_are_found_by_shortened_steps_where_whole_ones_lead_away(forced):
    """d / sqrt(1 + d^2) = 0 for the distance d from the root: whole steps of Newton's method take d to -d^3."""
    M, J, f, gamma = random_system(forced, 1)
    forces, root = Forces(1), -1.0001
    forces.B[:], forces.rows[:] = 0.0, 0.0

    def law(n):
        size = np.sqrt(1.0 + (n - root) ** 2)
        return forces.B @ n, forces.B, (n - root) / size, np.diag(size**-3.0)

    forces.law = law
    status, _, multipliers = with_forces(forced, forces, M, J, f, gamma)
    assert status == OK
    np.testing.assert_allclose(multipliers[2:], root, rtol=1e-12)


def test_weights_of_forces_are_those_of_the_transposed_equations(forced):
    """With weights a of u', l of lambda and g of n, the weights v, m and w of all rows solve the transposed system."""
    M, J, _, _ = random_system(forced, 2)
    forces, random = Forces(2), np.random.default_rng(0)
    a, l_and_g = random.normal(size=5), random.normal(size=4)
    expected = np.linalg.solve(coupled(forces, M, J).T, np.concatenate((a, l_and_g)))
    of_u, of_multipliers, of_rows = a.copy(), l_and_g.copy(), np.full(2, np.nan)
    given = (forces.callback, forces.rows, M, J, np.zeros(2), of_u, of_multipliers, of_rows)
    assert forced.shims.forces_vjp(*given) == OK
    # A residual is what is added to a row, on the other side than right-hand sides.
    np.testing.assert_allclose(of_rows, -expected[7:], rtol=1e-10)
    # What is left for u' and lambda with held forces: M v + J^T m = a', -J v = l'.
    v, m = expected[:5], expected[5:7]
    np.testing.assert_allclose(of_u, M @ v + J.T @ m, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(of_multipliers[:2], -J @ v, rtol=0.0, atol=1e-10)
