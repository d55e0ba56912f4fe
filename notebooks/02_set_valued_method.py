# ---
# jupyter:
#   jupytext:
#     formats: py:percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The set-valued method, and what its radius does
#
# Equation (7) of Xu and Zhu lets a step end at any grid point within $\alpha$ of where the robot
# arrives. Read as printed, $\alpha$ is free motion. Three readings are named options here; all are
# solved to their fixed point, by value iteration and by label setting.

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

from ocp import exact_trajectory
from ocp.query_family import PAPER_START, paper_query
from ocp.set_valued import Image, Method, SetValuedSettings, solve_set_valued
from sims.closed_loop import rollout

query = paper_query((4.0, 4.0))
start = np.array(PAPER_START)
truth = exact_trajectory(query, start).cost
print(f"exact optimum {truth:.4f}")

# %% [markdown]
# ## Two solvers, one fixed point

# %%
values, seconds = {}, {}
for method in (Method.JACOBI, Method.LABEL_SETTING):
    solve_set_valued(query, method=method)
    begun = time.perf_counter()
    values[method] = solve_set_valued(query, method=method).value.values
    seconds[method] = time.perf_counter() - begun
    print(f"{method.name.lower():14s} {seconds[method]:.2f} s")
difference = np.nanmax(np.abs(values[Method.JACOBI] - values[Method.LABEL_SETTING]))
print(f"largest difference {difference:.1e}")
assert difference == 0.0

# %% [markdown]
# ## The readings of alpha
#
# `NEAREST` takes the nearest grid point, `BALL` any within alpha (the printed equation), `LATERAL`
# only those to the side of the motion. A value below the optimum is impossible to drive.

# %%
spacing = 10 / 57
readings = {
    "nearest node": SetValuedSettings(),
    "ball, 0.87 h": SetValuedSettings(image=Image.BALL, radius=0.866 * spacing),
    "ball, 2 h": SetValuedSettings(image=Image.BALL, radius=2 * spacing),
    "lateral, h / 2": SetValuedSettings(image=Image.LATERAL, radius=0.5 * spacing),
}
found = {}
print("reading           value at start   closed loop   over the optimum")
for name, settings in readings.items():
    solution = solve_set_valued(query, settings=settings)
    loop = rollout(solution.policy(), start)
    value = float(solution.value.value(start))
    found[name] = value
    cost = (
        "never arrives"
        if loop.cost is None
        else f"{loop.cost:10.3f}      {loop.cost / truth - 1:+.1%}"
    )
    print(f"{name:16s}  {value:10.3f}     {cost}")
assert found["ball, 2 h"] < 0.6 * truth
assert abs(found["lateral, h / 2"] / truth - 1) < 0.05

# %%
figure, axes = plt.subplots(figsize=(6.4, 3.2), layout="constrained")
axes.barh(list(found), list(found.values()), color="#0072B2")
axes.axvline(truth, color="#D55E00", label="exact optimum")
axes.set(xlabel="value at the paper's start")
axes.legend(frameon=False)
plt.show()
