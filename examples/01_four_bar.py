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
# # The four-bar linkage
#
# The linkage of the
# [SymBRiM tutorial](https://mechmotum.github.io/symbrim/tutorials/four_bar_linkage.html) is
# contained in the package as a compiled model: neither SymPy nor a compiler is needed. To make
# a notebook of this script: `jupytext --to ipynb 01_four_bar.py`.

# %%
# %matplotlib inline
import numpy as np

import fourbar_codegen as fb

four_bar = fb.load("four_bar")
four_bar

# %% [markdown]
# The first angle, q1, is the independent coordinate. At q1 = -0.5 there are two assembly modes.

# %%
modes = four_bar.initial_states({"q1": -0.5}, {"u1": -0.1})
modes

# %%
modes.plot()

# %% [markdown]
# The tutorial starts in the first mode. Simulate four seconds with gravity, a spring, a damper and
# a force:

# %%
run = four_bar.simulate((0.0, 4.0), modes[0], rtol=1e-9, atol=1e-9)
print(run.message)
print(f"The largest constraint violation is {abs(run.constraint_residual).max():.1e} m.")
run

# %%
run.plot()

# %% [markdown]
# Without spring, damper and force, the energy is conserved.

# %%
free = four_bar.simulate(
    (0.0, 4.0),
    modes[0],
    parameters={"c": 0.0, "k": 0.0},
    inputs={"F": 0.0},
    rtol=1e-9,
    atol=1e-9,
)
change, largest = np.ptp(free["energy"]), free["kinetic_energy"].max()
print(f"Energy changes by {change:.1e} J; the kinetic energy reaches {largest:.0f} J.")

# %% [markdown]
# The paths of some points, and an interactive report in one file that works offline:

# %%
run.plot_paths(["P2", "link3_masscenter", "joint3_link3_joint"])

# %%
print(run.save("results/01_four_bar.html"))
