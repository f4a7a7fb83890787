"""Steps of explicit methods alone: coefficients, step control, interpolants and events, against SciPy's integrators.

steppers/runge_kutta.h states that a run without projection takes the same steps as SciPy's. Sums in another order
differ
by some 1e-16 of the state and coefficients up to 50; error estimates, in units of a tolerance of 1e-4, by 1e-12 or so,
and lengths of steps after a rejected attempt by a fraction of that.
"""

import ctypes

import numpy as np
import pytest
import scipy.integrate

RK45, DOP853, RK4, TSIT5 = range(4)
METHODS = {"RK45": RK45, "DOP853": DOP853}
END, PAUSED, FULL, EVENT, TOO_SMALL, INFINITE, COLLAPSED = range(7)
"""FB_RUN."""

RATES = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.c_double, ctypes.POINTER(ctypes.c_double), ctypes.POINTER(ctypes.c_double)
)


class Run:
    """A run of x' = f(t, x)."""

    def __init__(self, shims, f, method, t, x, t_bound, *, max_step=np.inf, rtol=1e-7, atol=1e-7):
        self.shims, self.n, self.times = shims, len(x), np.zeros(0)

        def rates(t, x, result):
            for i, rate in enumerate(f(t, np.array(x[: self.n]))):
                result[i] = rate
            return 0

        self.kept = RATES(rates)
        given = (self.n, float(t), np.array(x, dtype=float), float(t_bound), float(max_step), rtol, atol)
        self.run = ctypes.c_void_p(shims.new_run(self.kept, method, *given, returns=ctypes.c_void_p))
        self.sample_at(self.times, 0)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.shims.free_run(self.run, returns=None)

    def __getattr__(self, name):
        return lambda *arguments: getattr(self.shims, name)(self.run, *arguments)

    def at(self, t):
        x = np.zeros(self.n)
        assert self.state_at(float(t), x) == 0
        return x

    def read(self):
        """t, the last length and the next one, the state, and the numbers of evaluations, steps and samples."""
        times, x, counts = np.zeros(3), np.zeros(self.n), np.zeros(3, dtype=np.intc)
        self.read_run(times, x, counts)
        return times, x, counts

    def samples(self):
        n = self.read()[2][2]
        t, x = np.zeros(n), np.zeros((n, self.n))
        self.read_samples(t, x)
        return t, x


def lotka_volterra(t, x):
    return np.array([x[0] * (1.5 - x[1]), x[1] * (x[0] - 3.0)])


def peak(t, x):
    """A rate with a narrow peak, at which steps are rejected."""
    return np.array([1.0 / (1e-4 + (t - 1.0) ** 2), -x[1]])


def coefficients(shims, method, name, shape):
    values = np.full(1000, np.nan)
    n = shims.tableau(method, ctypes.c_char(name.encode()), values)
    return values[:n].reshape(shape)


def test_coefficients_of_the_methods_are_those_of_scipy(shims):
    """Bit by bit. SciPy's last row of weights is that of x' at the end of a step."""
    from scipy.integrate._ivp.rk import DOP853 as Hairer
    from scipy.integrate._ivp.rk import RK45 as Dormand

    for method, known in ((RK45, Dormand), (DOP853, Hairer)):
        s = known.n_stages
        np.testing.assert_array_equal(coefficients(shims, method, "a", (s, s))[:, : known.A.shape[1]], known.A)
        np.testing.assert_array_equal(coefficients(shims, method, "b", s), known.B)
        np.testing.assert_array_equal(coefficients(shims, method, "c", s), known.C)
    np.testing.assert_array_equal(coefficients(shims, RK45, "e", 7), Dormand.E)
    np.testing.assert_array_equal(coefficients(shims, RK45, "d", (4, 7)), Dormand.P.T)
    np.testing.assert_array_equal(coefficients(shims, DOP853, "e", (2, 13)), [Hairer.E5, Hairer.E3])
    np.testing.assert_array_equal(coefficients(shims, DOP853, "x", (3, 16)), Hairer.A_EXTRA)
    np.testing.assert_array_equal(coefficients(shims, DOP853, "y", 3), Hairer.C_EXTRA)
    np.testing.assert_array_equal(coefficients(shims, DOP853, "d", (4, 16)), Hairer.D)


@pytest.mark.parametrize(("method", "stages", "order"), [(RK45, 6, 5), (DOP853, 12, 8), (RK4, 4, 4), (TSIT5, 6, 5)])
def test_coefficients_satisfy_conditions_of_their_order(shims, method, stages, order):
    """Of quadrature, sum b c^k = 1 / (k + 1); of the tree with one branch below, sum b A c^k = 1 / ((k+1) (k+2)); and
    rows of A sum up to c. Source: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
    section II.1. Coefficients are up to 50.
    """
    a, b, c = (coefficients(shims, method, n, s) for n, s in (("a", (stages, stages)), ("b", stages), ("c", stages)))
    np.testing.assert_allclose(a.sum(axis=1), c, rtol=0.0, atol=1e-13)
    for k in range(order):
        assert b @ c**k == pytest.approx(1.0 / (k + 1), abs=1e-14)
    for k in range(order - 1):
        assert b @ (a @ c**k) == pytest.approx(1.0 / ((k + 1) * (k + 2)), abs=1e-13)


def weights_of_trees(a, b, c):
    """Sums over a method's coefficients for the trees up to order 5, and what they are in a method of that order.

    Source: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section II.2, table 2.2.
    """
    once, twice = a @ c, a @ (a @ c)
    of_squares, of_cubes = a @ c**2, a @ c**3
    return {
        1: [(b.sum(), 1)],
        2: [(b @ c, 2)],
        3: [(b @ c**2, 3), (b @ once, 6)],
        4: [(b @ c**3, 4), (b @ (c * once), 8), (b @ of_squares, 12), (b @ twice, 24)],
        5: [(b @ c**4, 5), (b @ (c**2 * once), 10), (b @ (c * of_squares), 15), (b @ (c * twice), 30),
            (b @ once**2, 20), (b @ of_cubes, 20), (b @ (a @ (c * once)), 40), (b @ (a @ of_squares), 60),
            (b @ (a @ twice), 120)],
    }  # fmt: skip


@pytest.mark.parametrize("method", [RK45, TSIT5])
def test_pairs_and_interpolants_satisfy_the_conditions_of_all_trees(shims, method):
    """The method of order 5, the embedded one of order 4, not of order 5; and the interpolant of order 4, along the
    step. Products of coefficients are up to 40, those of the interpolant 90.
    """
    a = np.zeros((7, 7))
    a[:6, :6] = coefficients(shims, method, "a", (6, 6))
    a[6, :6] = b = coefficients(shims, method, "b", 6)
    c, e = a.sum(axis=1), coefficients(shims, method, "e", 7)
    for order, trees in weights_of_trees(a, a[6], c).items():
        for found, density in trees:
            assert found == pytest.approx(1.0 / density, abs=1e-13), order
    missed = []
    for order, trees in weights_of_trees(a, a[6] - e, c).items():
        missed += [abs(found - 1.0 / density) > 1e-5 for found, density in trees if order == 5]
        for found, density in trees if order < 5 else ():
            assert found == pytest.approx(1.0 / density, abs=1e-13), order
    assert any(missed)
    dense = coefficients(shims, method, "d", (4, 7))
    np.testing.assert_allclose(dense.sum(axis=0), [*b, 0.0], rtol=0.0, atol=1e-13)
    for y in (0.25, 0.5, 0.8):
        for order, trees in weights_of_trees(a, y ** np.arange(1, 5) @ dense, c).items():
            for found, density in trees if order < 5 else ():
                assert found == pytest.approx(y**order / density, abs=1e-13), order


@pytest.mark.parametrize(("method", "order"), [(RK45, 5), (DOP853, 8), (TSIT5, 5)])
def test_errors_of_steps_of_equal_length_fall_with_the_order(shims, method, order):
    """x'' = -x has the solution cos t. Halved steps, of which there are enough that roundings do not count."""
    errors = []
    for n in (8, 16):
        h = 4.0 / n
        with Run(
            shims, lambda t, x: [x[1], -x[0]], method, 0.0, [1.0, 0.0], 4.0, max_step=h, rtol=1e3, atol=1e3
        ) as run:
            assert run.begin_run() == 0
            assert run.go_on_from(0.0, np.array([1.0, 0.0]), h) == 0
            assert run.advance(1000) == END
            _, x, (_, steps, _) = run.read()
        assert steps == n
        errors.append(np.abs(x - [np.cos(4.0), -np.sin(4.0)]).max())
    assert order - 0.5 < np.log2(errors[0] / errors[1]) < order + 1.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("f", "x0", "end"), [(lotka_volterra, [4.0, 1.0], 5.0), (peak, [0.0, 1.0], 3.0)])
@pytest.mark.parametrize("backwards", [False, True])
def test_each_step_is_that_of_scipy(shims, method, f, x0, end, backwards):
    """From the same state, with the same proposal for the length, also where attempts are rejected."""
    begin, end = (end, 0.0) if backwards else (0.0, end)
    x0 = np.array([2.0, 1.0]) if backwards else np.array(x0)
    known = getattr(scipy.integrate, method)(f, begin, x0, end, rtol=1e-4, atol=1e-4)
    with Run(shims, f, METHODS[method], begin, x0, end, rtol=1e-4, atol=1e-4) as run:
        assert run.begin_run() == 0
        assert run.read()[0][2] == pytest.approx(known.h_abs, rel=1e-12)
        while known.status == "running":
            assert run.go_on_from(float(known.t), known.y, float(known.h_abs)) == 0
            before, known_before, before_end = run.read()[2][0], known.nfev, known.h_abs
            known.step()
            status = run.advance(1)
            (t, h, proposed), x, (evaluations, _, _) = run.read()
            assert status == (END if t == end else PAUSED)
            assert t == pytest.approx(known.t, rel=1e-9)
            assert h == pytest.approx(known.t - known.t_old, rel=1e-9)
            np.testing.assert_allclose(x, known.y, rtol=1e-9, atol=1e-12)
            assert evaluations - before == known.nfev - known_before
            if known.status == "running":
                # Growth tells of a small error, (0.9 / factor)^8, and a rounding error of 1e-12 units more of it.
                assert proposed == pytest.approx(known.h_abs, rel=1e-6 if proposed < 3.0 * abs(h) else 1e-2)
            elif evaluations - before <= known.n_stages + 1:
                # What a step that the end has shortened was to be is kept, for what may follow.
                assert proposed >= before_end * (1.0 - 1e-12)
            dense = known.dense_output()
            for at in np.linspace(known.t_old, known.t, 4):
                np.testing.assert_allclose(run.at(at), dense(at), rtol=1e-9, atol=1e-9)
        assert run.advance(1) == END


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("f", "x0"),
    [
        (lotka_volterra, [4.0, 1.0]),
        (lambda t, x: [1.0], [0.0]),  # from 0: a hundred times a trial step of 1e-6
        (lambda t, x: [0.0], [1.0]),  # at rest: a thousandth of it, or 1e-6
        (lambda t, x: [1e3 * x[0]], [1.0]),
        (lambda t, x: [1e-3 * t], [1.0]),
    ],
)
@pytest.mark.parametrize("end", [10.0, 1e-7, -10.0])
def test_the_first_length_is_that_of_scipy(shims, method, f, x0, end):
    known = getattr(scipy.integrate, method)(f, 0.0, x0, end, rtol=1e-4, atol=1e-4)
    with Run(shims, f, METHODS[method], 0.0, x0, end, rtol=1e-4, atol=1e-4) as run:
        assert run.begin_run() == 0
        assert run.read()[0][2] == pytest.approx(known.h_abs, rel=1e-12)


@pytest.mark.parametrize("max_step", [0.01, 0.1])
def test_steps_are_no_longer_than_allowed(shims, max_step):
    with Run(shims, lotka_volterra, RK45, 0.0, [4.0, 1.0], 1.0, max_step=max_step, rtol=1e-2, atol=1e-2) as run:
        run.begin_run()
        lengths = []
        while run.advance(1) == PAUSED:
            lengths.append(run.read()[0][1])
        assert max(lengths) <= max_step * (1.0 + 1e-12)
        assert run.read()[0][0] == 1.0


@pytest.mark.parametrize(("method", "degree"), [(RK45, 4), (DOP853, 7), (TSIT5, 4)])
def test_interpolants_are_exact_for_polynomials_of_their_order(shims, method, degree):
    """x = t^k is found by quadrature alone; a step of 1 leaves rounding errors of coefficients up to 400."""
    for k in range(1, degree + 1):
        with Run(shims, lambda t, x, k=k: [k * t ** (k - 1)], method, 0.0, [0.0], 1.0, rtol=10.0) as run:
            run.begin_run()
            assert run.advance(1000) == END
            (end, h, _), _, _ = run.read()
            for t in np.linspace(end - h, end, 9):
                assert run.at(t)[0] == pytest.approx(t**k, abs=1e-12)


def test_samples_are_taken_at_their_times(shims):
    """Also at the start, at the end, and twice at one time."""
    times = np.array([0.0, 0.1, 0.1, 0.77, 1.9, 2.0])
    with Run(shims, lambda t, x: [-x[0], 1.0], DOP853, 0.0, [1.0, 0.0], 2.0, rtol=1e-10, atol=1e-10) as run:
        run.begin_run()
        run.sample_at(times, 6)
        assert run.advance(1000) == END
        t, x = run.samples()
    np.testing.assert_array_equal(t, times[1:] if t.size == 5 else times)
    np.testing.assert_allclose(x, np.array([np.exp(-t), t]).T, rtol=0.0, atol=1e-8)  # some 100 steps of 1e-10


def test_without_times_each_step_is_a_sample_until_there_is_no_room(shims):
    with Run(shims, lotka_volterra, RK45, 0.0, [4.0, 1.0], 50.0) as run:
        run.begin_run()
        run.sample_at(None, 0)
        for _ in range(64):
            assert run.advance(1) == PAUSED
            (reached, _, _), x, _ = run.read()
            t, samples = run.samples()
            assert t[-1] == reached
            np.testing.assert_array_equal(samples[-1], x)
        assert run.advance(1) == FULL
        assert run.read()[0][0] > t[-1]  # that step waits for room


@pytest.mark.parametrize(("direction", "expected"), [(0, [1, 2, 3]), (1, [2]), (-1, [1, 3])])
def test_a_run_stops_after_steps_with_a_change_of_sign(shims, direction, expected):
    """cos(pi t / 1 s - pi / 2 + ...): x = cos(pi (t - 1/2)) is zero at whole times, falling at odd ones."""
    with Run(
        shims, lambda t, x: [np.pi * x[1], -np.pi * x[0]], DOP853, 0.5, [1.0, 0.0], 3.5, rtol=1e-8, atol=1e-8
    ) as run:
        run.begin_run()
        assert run.watch_state(0, direction) == 0
        found = []
        while run.advance(1000) == EVENT:
            (t, h, _), _, _ = run.read()
            zeros = [zero for zero in (1, 2, 3) if t - h <= zero <= t]
            assert zeros  # no other step is reported
            found += zeros
        assert found == expected


@pytest.mark.parametrize(
    ("factor", "taken", "rejected", "expected"),
    [
        (3.0, 1, 0, 3.0), (50.0, 1, 0, 10.0), (3.0, 1, 1, 1.0), (0.5, 1, 1, 0.5), (0.5, 0, 0, 0.5), (0.01, 0, 1, 0.2),
        (np.nan, 0, 0, 0.2),
    ],
)  # fmt: skip
def test_the_change_of_a_length_has_the_limits_of_scipy(shims, factor, taken, rejected, expected):
    """Between 0.2 and 10, and no growth after a rejection; an unknown error is the worst."""
    assert shims.change(factor, taken, rejected, returns=ctypes.c_double) == expected


@pytest.mark.parametrize(("h_abs", "expected"), [(0.5, 0.5), (2.0, 1.0), (1e-9, 1e-3)])
def test_the_first_length_is_between_the_least_and_the_longest(shims, h_abs, expected):
    assert shims.first_length(h_abs, 1.0, 1e-3, returns=ctypes.c_double) == expected


@pytest.mark.parametrize(("t", "direction"), [(1.0, 1.0), (1.0, -1.0), (1e6, 1.0), (-3.0, 1.0)])
def test_the_least_length_is_ten_spacings_of_doubles(shims, t, direction):
    expected = 10.0 * abs(np.nextafter(t, direction * np.inf) - t)
    assert shims.least_step(t, direction, returns=ctypes.c_double) == expected


def test_a_rate_without_value_ends_a_run(shims):
    with Run(shims, lambda t, x: [np.nan if t > 0.5 else 1.0], RK45, 0.0, [0.0], 1.0) as run:
        run.begin_run()
        assert run.advance(1000) == COLLAPSED  # told once, since a singular position may be the reason
        assert run.advance(1000) == TOO_SMALL
        assert run.read()[0][0] == pytest.approx(0.5, abs=1e-14)


def test_a_run_without_end_and_motion_has_no_finite_step(shims):
    """Lengths grow tenfold as long as there is no error."""
    with Run(shims, lambda t, x: [0.0], RK45, 0.0, [1.0], np.inf) as run:
        run.begin_run()
        assert run.advance(1000) == INFINITE


def test_fixed_steps_have_the_increment_of_the_classical_method(shims):
    """Of x' = x the taylor series up to h^4 / 24, exactly."""
    h = 0.5
    with Run(shims, lambda t, x: [x[0]], RK4, 1.0, [2.0], np.inf) as run:
        for n in (1, 2, 3):
            assert run.fixed_step(h) == 0
            (t, _, _), x, _ = run.read()
            assert t == 1.0 + n * h
            assert x[0] == pytest.approx(2.0 * (1.0 + h + h**2 / 2.0 + h**3 / 6.0 + h**4 / 24.0) ** n, rel=1e-15)


def test_a_jump_of_the_rates_of_motions_changes_speeds_by_their_accelerations(shims):
    """u' is linear in the second derivatives r_2, r_3 of motions, with the rates r_0, r_1: du = A_2 dr_0 + A_3 dr_1. At
    t = 0.8 the rates are 8 and 9; from t = 1 on, they are 0 and 1.
    """
    matrix = np.array([[1.0, 2.0, 3.0, 5.0], [7.0, 11.0, 13.0, 17.0]])
    found = np.zeros(2)
    assert shims.speed_jump(matrix, 0.8, 1.0, found) == 0
    np.testing.assert_allclose(found, matrix[:, 2:] @ [0.0 - 8.0, 1.0 - 9.0], rtol=1e-13)
