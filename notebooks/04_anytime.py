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
# # Any time: excess against milliseconds
#
# Every method gets a deadline and drives from the same starts. How far above the exact optimum is
# it? Times are of this machine, now; read the order of the curves, not their last digit.

# %%
import matplotlib.pyplot as plt
import numpy as np

from ocp import SolveError, deadline, exact_trajectory, plan
from ocp.query_family import PAPER_FIGURE_STARTS, PAPER_GOALS, paper_query
from sims.closed_loop import LoopSettings, rollouts
from sims.methods import METHODS

BUDGETS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
NAMES = ("adapt", "eikonal", "refmm")
starts = [np.array(s) for s in PAPER_FIGURE_STARTS[:3]]
queries = [paper_query(goal) for goal in PAPER_GOALS]
best = {query: [exact_trajectory(query, s).cost for s in starts] for query in queries}

# %%
found: dict[str, list[tuple[float, float]]] = {name: [] for name in NAMES}
print("method    budget     ready, median   excess   reached")
for name in NAMES:
    method = METHODS[name]
    method.rehearse(queries[0])
    for budget in BUDGETS:
        ready, costs, optimum, lost = [], 0.0, 0.0, 0
        for query in queries:
            try:
                planner = method.planner_for(budget)
                answer = plan(planner, query, starts, deadline(budget))
            except SolveError:
                lost += len(starts)
                continue
            ready.append(answer.reaction_time)
            loops = rollouts(answer.policy, starts, LoopSettings(period=method.period))
            for loop, exact in zip(loops, best[query], strict=True):
                if loop.cost is None:
                    lost += 1
                else:
                    costs, optimum = costs + loop.cost, optimum + exact
        total = len(queries) * len(starts)
        excess = costs / optimum - 1
        found[name].append((1e3 * float(np.median(ready)), 100 * excess))
        print(f"{name:8s}  {1e3 * budget:5.0f} ms   {1e3 * np.median(ready):8.1f} ms"
              f"   {excess:8.3%}   {total - lost}/{total}")  # fmt: skip

# %%
figure, axes = plt.subplots(figsize=(6.8, 4.2), layout="constrained")
for (name, points), marker in zip(found.items(), "osD", strict=True):
    times, excesses = np.array(points).T
    axes.loglog(times, np.maximum(excesses, 1e-4), marker=marker, label=name)
axes.set(xlabel="policy ready after (ms)", ylabel="cost over the exact optimum (%)")
axes.grid(which="both", alpha=0.25)
axes.legend(frameon=False)
plt.show()
assert found["adapt"][-1][1] < 0.5
assert found["eikonal"][-1][1] < 0.5
