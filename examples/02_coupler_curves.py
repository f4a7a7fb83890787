# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Coupler curves for different crank lengths
#
# The path of the midpoint of the coupler of a four-bar linkage, over a turn of the crank, for
# several lengths of the crank. This needs no equations of motion, only closed loops. To make a
# notebook of this script: `jupytext --to ipynb 02_coupler_curves.py`.

# %%
# %matplotlib inline
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import fourbar_codegen as fb

four_bar = fb.load("four_bar")
links = {"l1": 0.8, "l3": 0.7, "l4": 0.6}  # ground, coupler, rocker
cranks = np.linspace(0.1, 0.45, 8)  # the shortest link: by Grashof's rule it turns fully
angles = np.linspace(0.0, 2 * np.pi, 181)

# %% [markdown]
# There are two assembly modes. The first one is followed, with each position as the guess for the
# next one.


# %%
def coupler_curve(crank: float) -> np.ndarray:
    """The path of the coupler's midpoint over a turn of the crank, shape (2, 181)."""
    parameters = {**links, "l2": crank}
    state = four_bar.initial_states([angles[0]], [1.0], parameters=parameters)[0]
    places = []
    for angle in angles:
        guess = state[1:3]
        state = four_bar.initial_state([angle], [1.0], guess=guess, parameters=parameters)
        points = four_bar.positions(0.0, state[:3], parameters)
        places.append(points["link3_masscenter"][:2])
    return np.transpose(places)


curves = [coupler_curve(crank) for crank in cranks]

# %%
figure = Figure(figsize=(6.0, 5.0), layout="constrained")
axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="y (m)")
axes.set_title("Paths of the coupler's midpoint")
for crank, curve in zip(cranks, curves, strict=True):
    axes.plot(*curve, label=f"crank {crank:.2f} m")
axes.plot([-0.4, 0.4], [0.0, 0.0], "ko-", label="ground")
axes.legend()
figure

# %% [markdown]
# The coupler oscillates without a full turn, and its other end moves back and forth on an arc. The
# enclosed area of the path of a point of the coupler then changes linearly from one end to the
# other (Holditch's theorem). For the midpoint, it is half the area of the crank's circle.

# %%
for crank, (x, y) in zip(cranks, curves, strict=True):
    area = 0.5 * abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))
    length = np.hypot(np.diff(x), np.diff(y)).sum()
    share = area / (np.pi * crank**2)
    print(f"crank {crank:.2f} m: length {length:.3f} m, area {area:.4f} m^2,", end=" ")
    print(f"{share:.4f} of the crank's circle")

# %%
path = Path("results/02_coupler_curves.png")
path.parent.mkdir(exist_ok=True)
figure.savefig(path)
print(path)
