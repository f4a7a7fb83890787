"""A four-bar linkage with a stiff drive: a comparison of explicit and implicit methods.

A motor turns the crank of the tutorial's linkage, with light links and no other load, through an elastic shaft with a
damper. The faster the vibration of the shaft decays, the shorter the steps of explicit methods must be, even after it
has decayed. The steps of implicit methods are limited by the slow motion only. All methods keep the loop closed.
"""

from __future__ import annotations

import time

import sympy as sm
import sympy.physics.mechanics as me

import fourbar_codegen as fb

SHAFT = {"stiffness": 1e6, "damping": 1e5}  # N m/rad and N m s/rad: its vibration decays in about 1e-6 s
METHODS = {
    "DOP853": {"rtol": 1e-6, "atol": 1e-6},
    "RK45": {"rtol": 1e-6, "atol": 1e-6},
    "ALI3P": {"max_step": 1e-2},
    "Radau": {"rtol": 1e-6, "atol": 1e-6},
    "CVODE": {"rtol": 1e-6, "atol": 1e-6},
    "IDA": {"rtol": 1e-6, "atol": 1e-6},
}


def driven_four_bar() -> fb.Model:
    """The tutorial's linkage with a motor, whose angle is prescribed, and a shaft between motor and crank."""
    system = fb.models.four_bar().system
    stiffness, damping, amplitude, frequency = sm.symbols("stiffness damping amplitude frequency")
    t = me.dynamicsymbols._t
    q1, u1 = system.q[0], system.u[0]
    motor = amplitude * (1 - sm.cos(frequency * t)) - 0.5
    crank = system.bodies[1]
    twist = stiffness * (q1 - motor) + damping * (u1 - motor.diff(t))
    system.add_loads(me.Torque(crank.frame, -twist * system.frame.z))
    rho, l1, l2, l3, l4, g, k, c = sm.symbols("rho l1:5 g k c")
    return fb.Model(
        system,
        name="driven_four_bar",
        parameters={
            rho: 1.0, l1: 0.8, l2: 0.5, l3: 1.0, l4: 0.7, k: 0.0, c: 0.0, g: 9.81,
            **{symbol: SHAFT[symbol.name] for symbol in (stiffness, damping)}, amplitude: 0.5, frequency: 3.0,
        },
        inputs={me.dynamicsymbols("F"): 0.0},
        initial={q1: -0.5, system.q[1]: -1.5, system.q[2]: -1.5, u1: 0.0},
    )  # fmt: skip


def main() -> None:
    linkage = fb.compile_model(driven_four_bar())
    exact = linkage.simulate((0.0, 4.0), method="Radau", rtol=1e-11, atol=1e-11)
    print("method    evaluations        time    error")
    for method, how in METHODS.items():
        begin = time.perf_counter()
        run = linkage.simulate((0.0, 4.0), method=method, **how)
        seconds = time.perf_counter() - begin
        error = abs(run.y[:, -1] - exact.y[:, -1]).max()
        print(f"{method:8s} {run.nfev:12d} {1e3 * seconds:8.1f} ms {error:8.1e}")


if __name__ == "__main__":
    main()
