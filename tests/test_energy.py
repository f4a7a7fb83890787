"""Energies against closed forms and against each other through the motion."""

import numpy as np
import pytest
import sympy as sm
import sympy.physics.mechanics as me
from sympy.physics.mechanics.system import System

import fourbar_codegen as fb


def test_energies_against_closed_form(four_bar):
    # Thin rods of mass rho l: T = sum m v.v / 2 + m l^2/12 w^2 / 2, V = sum m g y, heights from the centre of link 1.
    generator = np.random.default_rng(3)
    rho, g = 100.0, 9.81
    lengths = np.array([0.5, 1.0, 0.7])
    for x in generator.uniform(-2.0, 2.0, (20, 6)):
        angles, rates = np.cumsum(x[:3]), np.cumsum(x[3:])
        along = lengths * np.exp(1j * angles)
        velocities = 1j * rates * along
        centre_velocities = np.cumsum(velocities) - velocities / 2
        heights = (np.cumsum(along) - along / 2).imag
        masses = rho * lengths
        kinetic = (masses * np.abs(centre_velocities) ** 2 / 2 + masses * lengths**2 / 12 * rates**2 / 2).sum()
        potential = (masses * g * heights).sum()
        # A dozen terms of up to 1e4 J.
        assert four_bar.kinetic_energy(0.0, x) == pytest.approx(kinetic, rel=1e-13)
        assert four_bar.potential_energy(0.0, x) == pytest.approx(potential, rel=1e-13, abs=1e-11)


def test_energy_is_conserved_without_loads(four_bar):
    parameters = {"k": 0.0, "c": 0.0}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    run = four_bar.simulate((0.0, 4.0), x0, parameters=parameters, inputs={"F": 0.0}, rtol=1e-11, atol=1e-11)
    assert run.success
    # Steps of relative error 1e-11 in states around 1, energies of several hundred joules.
    np.testing.assert_allclose(run.energy, run.energy[0], rtol=0, atol=1e-6)


def test_energy_changes_by_the_work_of_the_force(four_bar):
    # With the spring-damper off, d(T + V)/dt = F v_x at the third joint.
    parameters = {"k": 0.0, "c": 0.0}
    x0 = four_bar.initial_state({"q1": -0.5}, {"u1": -0.1}, parameters=parameters)
    t = np.linspace(0.0, 1.0, 2001)
    run = four_bar.simulate((0.0, 1.0), x0, parameters=parameters, rtol=1e-11, atol=1e-11, t_eval=t)
    q, u = np.cumsum(run.q, axis=0), np.cumsum(run.u, axis=0)
    velocity = -0.5 * u[0] * np.sin(q[0]) - 1.0 * u[1] * np.sin(q[1])
    power = 100 * np.sin(np.pi * t) * velocity
    work = np.concatenate(([0.0], np.cumsum((power[1:] + power[:-1]) / 2 * np.diff(t))))
    # The trapezoidal rule errs by h^2/12 times the power's second derivative, here below 1e5.
    np.testing.assert_allclose(run.energy - run.energy[0], work, atol=5e-3)


def test_energy_that_a_force_makes_has_not_grown_beyond_reason():
    """A mass from rest by forces t^n has 4^(n + 1) times the kinetic energy at the end that it had half way, though
    its steps grow so that none ends near there; what a negative damping feeds has grown."""
    frame, origin = me.ReferenceFrame("N"), me.Point("O")
    x, u, force = me.dynamicsymbols("x u F")
    place = origin.locatenew("P", x * frame.x)
    origin.set_vel(frame, 0)
    place.set_vel(frame, u * frame.x)
    system = System(frame, origin)
    system.add_bodies(me.Particle("P", place, sm.S.One))
    system.add_coordinates(x)
    system.add_speeds(u)
    system.add_kdes(u - x.diff())
    system.add_loads((place, force * frame.x))
    mass = fb.compile_model(fb.Model(system, name="pushed", inputs={force: 0.0}, initial={x: 0.0, u: 0.0}))
    for n in range(4):
        for span, rtol in (((0.0, 10.0), 1e-6), ((0.0, 10.0), 1e-10), ((0.0, -10.0), 1e-6)):
            run = mass.simulate(span, inputs={"F": lambda t, _, n=n: t**n}, rtol=rtol)
            assert run.kinetic_energy[-1] == pytest.approx((10.0 ** (n + 1) / (n + 1)) ** 2 / 2, rel=1e-4)
            assert "has grown" not in run.message
    fed = mass.simulate((0.0, 10.0), [0.0, 1e-3], inputs={"F": lambda _, x: 2.0 * x[1]})
    assert "has grown" in fed.message
