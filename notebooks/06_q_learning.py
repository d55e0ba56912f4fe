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
# # Q-learning: the printed law, the repaired law, the law that converges
#
# A linear plant nobody has a model of, two seconds of data. Three learners meet the same plant in
# Drake's Simulator; the exact Riccati gain is known to us, not to them.

# %%
import math
from importlib import resources

import matplotlib.pyplot as plt
import numpy as np

from sims.regulation.regulate import HISTORY, LEARNERS, run
from sims.regulation.system_file import SystemFile

path = resources.files("sims") / "systems" / "double-integrator-1d.toml"
system = SystemFile.load(str(path))
runs = {learner: run(system, learner, 0, HISTORY) for learner in LEARNERS}

# %%
print("learner         gain error   cost / optimum   converged")
for learner, result in runs.items():
    error = "none" if result.gain_error is None else f"{result.gain_error:.1e}"
    ratio = "-" if result.cost is None else f"{result.cost / result.optimal_cost:.9f}"
    print(f"{learner:14s}  {error:>10s}   {ratio:>14s}   {result.converged}")
assert runs["q-learning"].converged
assert runs["q-learning"].gain_error is not None
assert runs["q-learning"].gain_error < 1e-6
assert not runs["paper-literal"].converged
assert not runs["paper-repaired"].converged

# %% [markdown]
# The gain error while data come in. u = 0 would score 1.

# %%
figure, axes = plt.subplots(1, 2, figsize=(10.5, 3.8), layout="constrained")
for learner, result in runs.items():
    known = [
        (t, e)
        for t, e in zip(result.history.times, result.history.gain_errors, strict=True)
        if math.isfinite(e)
    ]
    if known:
        axes[0].semilogy(*np.array(known).T, label=learner)
axes[0].axhline(1.0, color="grey", linestyle=":", label="u = 0")
axes[0].set(xlabel="seconds of data", ylabel="gain error over the horizon")
axes[0].set_title("while data come in")
axes[0].legend(frameon=False, loc="lower right", bbox_to_anchor=(1.0, 0.12))
times = np.linspace(0, system.cost.horizon, 200)
learned = runs["q-learning"].gain
assert learned is not None
exact = runs["q-learning"].exact.gain(times)[:, 0]
axes[1].plot(times, exact, label=["K, position", "K, velocity"])
axes[1].plot(times, learned(times)[:, 0], "k--", linewidth=1)
axes[1].set(xlabel="time (s)", ylabel="gain", title="Riccati (colours), learned (dashed)")
axes[1].legend(frameon=False)
plt.show()
