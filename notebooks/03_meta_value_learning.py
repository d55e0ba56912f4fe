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
# # Meta value learning, step by step
#
# A network that knows the query answers at once; exact trajectories then replace it where the robot
# will be. At each step: the policy's cost against the exact optimum, and where the network's value
# is wrong.

# %%
import matplotlib.pyplot as plt
import numpy as np

from learning import MetaPlanner
from ocp import exact_trajectory
from ocp.eikonal import solve_eikonal
from ocp.query_family import PAPER_FIGURE_STARTS, paper_query
from sims.closed_loop import rollouts
from sims.pictures.plan_figure import draw_plan, least_over_other_coordinates

query = paper_query((1.3, 3.4))
starts = [np.array(s) for s in PAPER_FIGURE_STARTS]
optima = [exact_trajectory(query, s) for s in starts]
best = sum(motion.cost for motion in optima)

# %%
planner = MetaPlanner.pretrained("paper")
state = planner.start(query, starts)
print("step  trajectories   cost over the optimum, all starts")
step, excesses = 0, []
while True:
    loops = rollouts(planner.policy(state), starts)
    reached = [loop.cost for loop in loops if loop.cost is not None]
    assert len(reached) == len(starts)
    excesses.append(sum(reached) / best - 1)
    print(f"{step:4d}  {state.trajectories:12d}   {excesses[-1]:.4%}")
    if state.finished or step == len(starts) + 1:
        break
    state = planner.refine(state)
    step += 1
assert excesses[-1] <= excesses[0] + 1e-4
assert excesses[-1] < 0.005

# %% [markdown]
# ## Where the value is wrong, before and after
#
# Against a fine grid, least over heading. The largest errors lie where two ways are equally good:
# there V has a kink, which a network rounds off and a grid blurs. Adaptation is local: in tubes
# around the exact trajectories V is known to second order. Elsewhere the network stands, or a grid,
# where its closed loops cost less. So the map hardly changes, while the robot's cost does.

# %%
fine = solve_eikonal(query, nodes=240_000).value
x, y, exact = least_over_other_coordinates(query, fine, 61)
outside = exact > 0.5
adapted = planner.value(state)
figure, axes = plt.subplots(1, 3, figsize=(15, 4.6), layout="constrained")
titles = {"network alone": state.network, "after adaptation": adapted}
medians, tails = {}, {}
print("value error          median      95 %")
for panel, (title, value) in zip(axes, titles.items(), strict=False):
    _, _, found = least_over_other_coordinates(query, value, 61)
    error = np.where(outside, 100 * (found / np.where(outside, exact, 1.0) - 1), np.nan)
    medians[title] = float(np.nanmedian(np.abs(error)))
    tails[title] = float(np.nanpercentile(np.abs(error), 95))
    print(f"{title:18s} {medians[title]:7.3f} %  {tails[title]:7.3f} %")
    shown = panel.pcolormesh(x, y, error.T, cmap="RdBu_r", vmin=-5, vmax=5, shading="gouraud")
    draw_plan(panel, query, [])
    panel.set_title(f"value error, {title}")
figure.colorbar(shown, ax=axes[:2], label="over the fine grid (%)", extend="both", shrink=0.9)
draw_plan(axes[2], query, loops, optima)
axes[2].set_title("closed loops after adaptation; optima dashed")
plt.show()
assert max(medians.values()) < 0.2
assert max(tails.values()) < 0.8

# %% [markdown]
# ## Gradient against costate
#
# Along an optimal trajectory the costate is the gradient of V. The network's is off by some per
# cent, most beside obstacles; in the tube of the exact trajectory it is exact.

# %%
motion = optima[0]
assert motion.costates is not None
inside = query.goal_distance(motion.states) > 0.05
scale = np.abs(motion.costates).max()
figure, axes = plt.subplots(1, 2, figsize=(11.5, 3.8), layout="constrained", sharey=True)
differences = {}
for panel, (title, value) in zip(axes, titles.items(), strict=True):
    gradient = np.asarray(value.gradient(motion.states[inside]))
    for i, name in enumerate(("x", "y", "heading")):
        (line,) = panel.plot(motion.times, motion.costates[:, i], label=name)
        panel.plot(motion.times[inside], gradient[:, i], "--", color=line.get_color())
    panel.set(xlabel="time (s)", title=f"costate (lines); gradient, {title} (dashed)")
    off = np.abs(gradient - motion.costates[inside]).max(axis=1) / scale
    differences[title] = float(np.median(off))
axes[0].legend(frameon=False)
plt.show()
print("median difference from the costate, of its largest entry")
for title, difference in differences.items():
    print(f"  {title:18s} {difference:.2e}")
assert differences["after adaptation"] < min(1e-3, 0.1 * differences["network alone"])
