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
# Every method gets a deadline and drives from the same starts: how far above the exact optimum is
# it, and does it arrive? The set-valued grid and MPC have no deadline to keep and are one point
# each. Times are of this machine, now; read the order of the curves, not their last digit.

# %%
import matplotlib.pyplot as plt
import numpy as np

from ocp import SolveError, deadline, exact_trajectory, plan
from ocp.query_family import PAPER_FIGURE_STARTS, PAPER_GOALS, paper_query
from sims.closed_loop import LoopSettings, rollouts
from sims.methods import METHODS

BUDGETS = (0.002, 0.01, 0.05, 0.1, 0.2)
ANY_TIME = ("adapt", "eikonal", "refmm")
ONE_SHOT = ("set-valued", "mpc")
starts = [np.array(s) for s in PAPER_FIGURE_STARTS[:3]]
queries = [paper_query(goal) for goal in PAPER_GOALS]
best = {query: [exact_trajectory(query, s).cost for s in starts] for query in queries}


# %%
ready_after: dict[str, list[float]] = {}
"""Milliseconds, of each start that arrived; at the shortest deadline."""


def judged(name: str, budget: float | None) -> tuple[float, float, float]:
    """Milliseconds until the policy is ready (median), excess cost in %, share that arrived.

    When each start's policy was ready is kept in `ready_after`, if the start arrived.
    """
    method = METHODS[name]
    ready, cost, optimum, arrived = [], 0.0, 0.0, 0
    for query in queries:
        until = deadline(budget) if budget is not None else None
        try:
            answer = plan(method.planner_for(budget), query, starts, until)
        except SolveError:
            continue  # counted as not arrived
        ready.append(1e3 * answer.reaction_time)
        loops = rollouts(answer.policy, starts, LoopSettings(period=method.period))
        for loop, exact in zip(loops, best[query], strict=True):
            if loop.cost is not None:
                if budget in (None, BUDGETS[0]):
                    ready_after.setdefault(name, []).append(ready[-1])
                cost, optimum, arrived = cost + loop.cost, optimum + exact, arrived + 1
    share = arrived / (len(queries) * len(starts))
    return float(np.median(ready)), 100 * (cost / optimum - 1), share


found: dict[str, list[tuple[float, float, float]]] = {}
print("method        budget   ready, median   excess   arrived")
for name in (*ANY_TIME, *ONE_SHOT):
    METHODS[name].rehearse(queries[0])
    found[name] = []
    for budget in BUDGETS if name in ANY_TIME else (None,):
        ready, excess, arrived = judged(name, budget)
        found[name].append((ready, excess, arrived))
        asked = "-" if budget is None else f"{1e3 * budget:.0f} ms"
        print(f"{name:11s} {asked:>8s} {ready:12.1f} ms {excess:8.3f} % {arrived:8.0%}")

# %%
figure, axes = plt.subplots(1, 2, figsize=(11.5, 4.2), layout="constrained")
for (name, points), marker in zip(found.items(), "osD^v", strict=True):
    times, excesses, _ = np.array(sorted(points)).T
    axes[0].loglog(times, np.maximum(excesses, 1e-4), marker=marker, label=name)
    by_time = np.sort(ready_after[name])
    share = 100 * np.arange(1, len(by_time) + 1) / (len(queries) * len(starts))
    axes[1].step(by_time, share, where="post", marker=marker, ms=4, label=name)
axes[0].set(xlabel="policy ready after (ms)", ylabel="cost over the exact optimum (%)")
axes[1].set(xlabel="milliseconds since the query", ylim=(-4, 104), xscale="log")
axes[1].set(ylabel="starts with a policy that arrives (%)")
for panel in axes:
    panel.grid(which="major", alpha=0.3)
axes[0].legend(frameon=False)
plt.show()
assert found["adapt"][-1][1] < 0.5
assert found["eikonal"][-1][1] < 0.5
assert all(found[name][-1][2] == 1.0 for name in ANY_TIME)
