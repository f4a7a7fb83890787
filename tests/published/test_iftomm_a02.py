"""A row of parallelograms that passes positions where the constraints lose rank.

Source: IFToMM multibody benchmark A02, N-four-bar mechanism, N = 2, https://www.iftomm-multibody.org/benchmark. On the
branch where the bars stay parallel, [(N + 1) / 3 + N] l phi'' = [(N + 1) / 2 + N] g sin(phi), integrated to the digits
below.
"""

import numpy as np
import pytest

import fourbar_codegen as fb

# x, y, vx, vy of the first joint at the top.
JOINT = {
    1.0: (-0.19502030195, -0.98079920566, -6.67667803688, 1.32757832516),
    10.0: (0.32845811154, 0.94451853818, 1.42305147020, -0.49486884548),
}


@pytest.fixture(scope="module")
def parallelograms():
    return fb.compile_model(fb.models.n_four_bar(2))


def joint(run, t):
    """x, y, vx, vy of the first joint at the top."""
    place = run.t.tolist().index(t)
    angle, rate = run["p0"][place], run["v0"][place]
    return np.array([np.sin(angle), np.cos(angle), rate * np.cos(angle), -rate * np.sin(angle)])


def simulated(model, h, **how):
    run = model.simulate((0.0, 10.0), method="ALI3P", max_step=h, **how)
    assert run.success
    return run


def test_parallelograms_pass_their_level_positions_on_the_branch_of_parallel_bars(parallelograms):
    """At each of these the constraints' Jacobian loses rank."""
    run = simulated(parallelograms, 1e-3, t_eval=[1.0, 10.0])
    for t, expected in JOINT.items():
        np.testing.assert_allclose(joint(run, t), expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(run["p1"], run["p0"], atol=1e-9)
    np.testing.assert_allclose(run["c1"], 0.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("t", JOINT)
def test_parallelograms_converge_with_second_order(parallelograms, t):
    errors = [
        np.abs(joint(simulated(parallelograms, h, t_eval=[1.0, 10.0]), t) - JOINT[t]).max()
        for h in (4e-3, 2e-3, 1e-3, 5e-4)
    ]
    np.testing.assert_allclose(np.log2(errors[:-1]) - np.log2(errors[1:]), 2.0, atol=0.1)


def test_energy_of_parallelograms_stays_within_the_benchmarks_0_1_joule(parallelograms):
    run = simulated(parallelograms, 1e-2)
    energies = [
        parallelograms.kinetic_energy(t, x) + parallelograms.potential_energy(t, x)
        for t, x in zip(run.t, run.y.T, strict=True)
    ]
    assert np.ptp(energies) < 0.1
    assert np.abs(run.constraint_residual).max() < 1e-9
    assert np.abs(run.velocity_residual).max() < 1e-9


@pytest.mark.slow
def test_parallelograms_with_exudyns_step_come_as_near_as_exudyn(parallelograms):
    """EXUDYN's documentation, NfourBar.py, h = 1.25e-4: 1.4e-6 m off, and an energy error of 1.795e-5 J."""
    run = simulated(parallelograms, 1.25e-4, t_eval=[10.0])
    theirs = np.hypot(0.3284573768 - JOINT[10.0][0], 0.9445187937 - JOINT[10.0][1])
    assert np.linalg.norm(joint(run, 10.0)[:2] - JOINT[10.0][:2]) < 10.0 * theirs
