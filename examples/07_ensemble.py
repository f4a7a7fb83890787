"""Effect of manufacturing tolerances of the links on the motion: an ensemble of ten thousand linkages."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import fourbar_codegen as fb

MEMBERS = 10_000
TOLERANCE = 1e-3  # m


def main() -> None:
    four_bar = fb.load("four_bar")
    generator = np.random.default_rng(0)
    lengths = {name: generator.normal(four_bar.defaults[name], TOLERANCE, MEMBERS) for name in ("l2", "l3", "l4")}
    begin = time.perf_counter()
    times = np.linspace(0.0, 4.0, 81)
    ensemble = four_bar.ensemble((0.0, 4.0), parameters=lengths, t_eval=times, rtol=1e-9, atol=1e-9)
    seconds = time.perf_counter() - begin
    angles = ensemble["q1"]
    print(f"{MEMBERS} simulations of 4 s in {seconds:.2f} s, {ensemble.success.sum()} successful")
    print(f"q1 after 4 s: {angles[:, -1].mean():.4f} rad, standard deviation {angles[:, -1].std():.4f} rad")

    # Sensitivities: the effect of each length by itself, to first order.
    rows = np.array([values - values.mean() for values in lengths.values()])
    slopes = np.linalg.lstsq(rows.T, angles[:, -1] - angles[:, -1].mean(), rcond=None)[0]
    for name, slope in zip(lengths, slopes, strict=True):
        print(f"  {name} 1 mm longer: {1e-3 * slope:+.4f} rad")

    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    axes = figure.add_subplot(xlabel="time (s)", ylabel="q1 (rad)")
    for low, high, shade in ((0.5, 99.5, 0.2), (15.9, 84.1, 0.4)):
        axes.fill_between(
            times, *np.percentile(angles, [low, high], axis=0), color="tab:blue", alpha=shade,
            label=f"{high - low:.0f} % of the linkages",
        )  # fmt: skip
    axes.plot(times, np.median(angles, axis=0), color="black", label="median")
    axes.legend()
    path = Path("results/07_ensemble.png")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path)
    print(path)


if __name__ == "__main__":
    main()
