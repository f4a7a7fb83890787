"""Linkages of uniform bars in natural coordinates, integrated by SciPy: another formulation of the same physics.

The unknowns are the coordinates of the points. A uniform bar from a to b has the constant mass matrix m/6 [2 1; 1 2];
bars are constraints of constant length, plates are bars along their sides. Source: J. Garcia de Jalon and E. Bayo,
Kinematic and Dynamic Simulation of Multibody Systems, Springer 1994, sections 2.1 and 4.2.
"""

import numpy as np
from scipy.integrate import solve_ivp


def simulate(points, bars, fixed, times, *, density, gravity, force, rods=()):
    """Positions of the points at the given times, from rest, shape (n_points, 2, n_t).

    `bars` are pairs of names, `rods` such pairs without mass; `force` is a function of time, positions and velocities,
    (n_points, 2) each.
    """
    names = list(points)
    number = {name: k for k, name in enumerate(names)}
    start = np.array([points[name] for name in names], dtype=float)
    n = len(names)
    mass, weight = np.zeros((n, n)), np.zeros((n, 2))
    pairs = [(number[a], number[b]) for a, b in (*bars, *rods)]
    for a, b in pairs[: len(bars)]:
        m = density * np.linalg.norm(start[a] - start[b])
        mass[np.ix_([a, b], [a, b])] += m / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        weight[[a, b], 1] -= m * gravity / 2
    held = [number[name] for name in fixed]
    full = np.kron(mass, np.eye(2))
    n_rows = len(pairs) + 2 * len(held)

    def rate(t, y):
        x, v = y.reshape(2, n, 2)
        rows, bias = np.zeros((n_rows, n, 2)), np.zeros(n_rows)
        for row, (a, b) in enumerate(pairs):
            rows[row, a], rows[row, b] = x[a] - x[b], x[b] - x[a]
            bias[row] = -np.sum((v[a] - v[b]) ** 2)
        for row, a in enumerate(held):
            rows[len(pairs) + 2 * row + np.arange(2), a] = np.eye(2)
        rows = rows.reshape(n_rows, 2 * n)
        kkt = np.block([[full, rows.T], [rows, np.zeros((n_rows, n_rows))]])
        load = weight + force(t, x, v)
        # Bars too many leave the multipliers undetermined, not the accelerations.
        a = np.linalg.lstsq(kkt, np.concatenate([load.ravel(), bias]), rcond=1e-12)[0][: 2 * n]
        return np.concatenate([v.ravel(), a])

    y0 = np.concatenate([start.ravel(), np.zeros(2 * n)])
    done = solve_ivp(rate, (times[0], times[-1]), y0, method="DOP853", rtol=3e-14, atol=1e-13, t_eval=times)
    assert done.success
    return done.y[: 2 * n].reshape(n, 2, -1)
