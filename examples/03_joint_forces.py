"""Forces in the pin between rod and slider of a slider-crank, with a speed-controlled motor and a load."""

from __future__ import annotations

import numpy as np

import fourbar_codegen as fb


def main() -> None:
    crank = fb.compile_model(fb.models.slider_crank())
    speed = 30.0  # rad/s
    run = crank.simulate(
        (0.0, 1.0),
        crank.initial_state({"crank": 0.0}, {"crank_rate": speed}),
        inputs={"torque": lambda _, x: 20.0 * (speed - x[3]), "load": -50.0},
        rtol=1e-8,
        atol=1e-8,
        t_eval=np.linspace(0.0, 1.0, 1001),
    )
    print(f"{run.message} The crank turns {run['crank'][-1] / (2 * np.pi):.2f} times.")
    print(f"The largest force in the pin is {np.hypot(run['pin_x'], run['pin_y']).max():.1f} N.")

    # Newton's law for the slider: the load, and the force of the rod, which is opposite to the output.
    mass = crank.defaults["m_slider"]
    rates = np.array([crank.rhs(t, x, r=r) for t, x, r in zip(run.t, run.y.T, run.r.T, strict=True)])
    gap = mass * rates[:, 5] - (-50.0 - run["pin_x"])
    print(f"The largest error of the slider's force balance is {abs(gap).max():.1e} N.")
    print(run.save("results/03_joint_forces.png"))


if __name__ == "__main__":
    main()
