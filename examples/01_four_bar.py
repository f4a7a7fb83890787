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
# The linkage of the [SymBRiM tutorial](https://mechmotum.github.io/symbrim/tutorials/four_bar_linkage.html) comes
# compiled with the package: neither SymPy nor a compiler is needed. As a notebook:
# `jupytext --to ipynb 01_four_bar.py`.

# %%
# %matplotlib inline
import numpy as np

import fourbar_codegen as fb

four_bar = fb.load("four_bar")
four_bar

# %% [markdown]
# Its first angle, q1, is independent. For a value of it the loop closes in two ways.

# %%
modes = four_bar.initial_states({"q1": -0.5}, {"u1": -0.1})
modes

# %%
modes.plot()

# %% [markdown]
# The tutorial begins in the first of them. Four seconds of motion, under gravity, a spring with a damper, and a force:

# %%
run = four_bar.simulate((0.0, 4.0), modes[0], rtol=1e-9, atol=1e-9)
print(run.message)
print(f"The loop is open by {abs(run.constraint_residual).max():.1e} m at most.")
run

# %%
run.plot()

# %% [markdown]
# Without spring, damper and force, the energy stays what it is.

# %%
free = four_bar.simulate((0.0, 4.0), modes[0], parameters={"c": 0.0, "k": 0.0}, inputs={"F": 0.0}, rtol=1e-9, atol=1e-9)
print(f"Energy changes by {np.ptp(free.energy):.1e} J, while up to {free.kinetic_energy.max():.0f} J come and go.")

# %% [markdown]
# Where the joints go, and a page that shows them moving, in one file that opens without a network:

# %%
run.plot_paths(["P2", "link3_masscenter", "joint3_link3_joint"])

# %%
print(run.save("results/01_four_bar.html"))
