"""Linkages of uniform bars in natural coordinates, integrated by SciPy: another formulation of the same physics.

The unknowns are the coordinates of the points. The mass matrix of a uniform bar from a to b is constant, m/6 [2 1; 1 2];
bars are constraints of constant length, plates are bars along their sides. Source: J. Garcia de Jalon and E. Bayo,
Kinematic and Dynamic Simulation of Multibody Systems, Springer 1994, sections 2.1 and 4.2.
"""

import numpy as np
from scipy.integrate import solve_ivp


def simulate(
    points, bars, fixed, times, *, density=1.0, gravity=0.0, rates=None, force=None, guides=None, masses=None, rods=()
):
    """Positions of the points at the given times, shape (n_points, 2, n_t).

    `bars` are pairs of names; `rates` an initial velocity, made consistent; `force` a function of time, positions and
    velocities, (n_points, 2) each; `guides` maps points to the normals of the lines
    through them, `masses` to theirs; `rods` are bars without mass.
    """
    names = list(points)
    number = {name: k for k, name in enumerate(names)}
    start = np.array([points[name] for name in names], dtype=float)
    n = len(names)
    mass = np.zeros((n, n))
    weight = np.zeros((n, 2))
    pairs = [(number[a], number[b]) for a, b in (*bars, *rods)]
    lengths = [np.linalg.norm(start[a] - start[b]) for a, b in pairs]
    for (a, b), length in zip(pairs[: len(bars)], lengths, strict=False):
        m = density * length
        mass[np.ix_([a, b], [a, b])] += m / 6 * np.array([[2.0, 1.0], [1.0, 2.0]])
        weight[[a, b], 1] -= m * gravity / 2
    for name, m in (masses or {}).items():
        mass[number[name], number[name]] += m
        weight[number[name], 1] -= m * gravity
    lines = [(number[name], np.array(normal, dtype=float)) for name, normal in (guides or {}).items()]
    held = [number[name] for name in fixed]
    full = np.kron(mass, np.eye(2))
    n_rows = len(pairs) + len(lines) + 2 * len(held)

    def jacobian(x):
        rows = np.zeros((n_rows, n, 2))
        for row, (a, b) in enumerate(pairs):
            rows[row, a] = x[a] - x[b]
            rows[row, b] = x[b] - x[a]
        for row, (a, normal) in enumerate(lines, start=len(pairs)):
            rows[row, a] = normal
        for row, a in enumerate(held):
            rows[len(pairs) + len(lines) + 2 * row + np.arange(2), a] = np.eye(2)
        return rows.reshape(n_rows, 2 * n)

    def rate(t, y):
        x, v = y.reshape(2, n, 2)
        rows = jacobian(x)
        bias = np.zeros(n_rows)
        bias[: len(pairs)] = [-np.sum((v[a] - v[b]) ** 2) for a, b in pairs]
        load = weight + (0.0 if force is None else force(t, x, v))
        kkt = np.block([[full, rows.T], [rows, np.zeros((n_rows, n_rows))]])
        # Bars too many leave the multipliers undetermined, not the accelerations.
        a = np.linalg.lstsq(kkt, np.concatenate([load.ravel(), bias]), rcond=1e-12)[0][: 2 * n]
        return np.concatenate([v.ravel(), a])

    v = np.zeros(2 * n) if rates is None else np.asarray(rates, dtype=float).ravel()
    y0 = np.concatenate([start.ravel(), v])
    done = solve_ivp(rate, (times[0], times[-1]), y0, method="DOP853", rtol=3e-14, atol=1e-13, t_eval=times)
    assert done.success
    return done.y[: 2 * n].reshape(n, 2, -1)
