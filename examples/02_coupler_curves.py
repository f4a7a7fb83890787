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
# # Coupler curves over crank lengths
#
# A designer turns the crank of a four-bar linkage and looks at the path of a point of the coupler, here its middle. No
# equations of motion are needed for that, only closed loops. As a notebook: `jupytext --to ipynb 02_coupler_curves.py`.

# %%
# %matplotlib inline
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import fourbar_codegen as fb

four_bar = fb.load("four_bar")
links = {"l1": 0.8, "l3": 0.7, "l4": 0.6}  # ground, coupler, rocker
cranks = np.linspace(0.1, 0.45, 8)  # shorter than the others, and by Grashof's rule it turns all the way
angles = np.linspace(0.0, 2 * np.pi, 181)

# %% [markdown]
# The loop closes in two ways; the first mode is followed around, each position being the guess for the next.


# %%
def coupler_curve(crank: float) -> np.ndarray:
    """The path of the coupler's middle over a turn of the crank, shape (2, 181)."""
    parameters = {**links, "l2": crank}
    state = four_bar.initial_states([angles[0]], [1.0], parameters=parameters)[0]
    places = []
    for angle in angles:
        state = four_bar.initial_state([angle], [1.0], guess=state[1:3], parameters=parameters)
        places.append(four_bar.positions(0.0, state[:3], parameters)["link3_masscenter"][:2])
    return np.transpose(places)


curves = [coupler_curve(crank) for crank in cranks]

# %%
figure = Figure(figsize=(6.0, 5.0), layout="constrained")
axes = figure.add_subplot(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="Paths of the coupler's middle")
for crank, curve in zip(cranks, curves, strict=True):
    axes.plot(*curve, label=f"crank {crank:.2f} m")
axes.plot([-0.4, 0.4], [0.0, 0.0], "ko-", label="ground")
axes.legend()
figure

# %% [markdown]
# The coupler swings back and forth without turning over, and its other end goes to and fro on an arc. The areas that
# points of such a bar go around then change in proportion from one end to the other (Holditch's theorem): in the
# middle, half the crank's circle.

# %%
for crank, (x, y) in zip(cranks, curves, strict=True):
    area = 0.5 * abs(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]))
    length = np.hypot(np.diff(x), np.diff(y)).sum()
    share = area / (np.pi * crank**2)
    print(f"crank {crank:.2f} m: length {length:.3f} m, area {area:.4f} m^2, {share:.4f} of the crank's circle")

# %%
path = Path("results/02_coupler_curves.png")
path.parent.mkdir(exist_ok=True)
figure.savefig(path)
print(path)
